"""Training of networks: by name, its result, and model files.

>>> from chdstat.estimators import load_model, train_model
>>> # train_model(samples, "elek2019").save("scene.safetensors"); load_model("scene.safetensors")

A file holds named arrays and JSON in the safetensors format, which runs no code when it is read.
Torch is imported when something trains.
"""

from __future__ import annotations

import contextlib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar, cast

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from chdstat._core.arrays import Seed, seed_number
from chdstat._core.display import Card, Shown, number
from chdstat._core.files import checksum, replacing
from chdstat.errors import InputError, StoreError
from chdstat.estimators.registry import LearnedEstimator, lookup, names
from chdstat.samples import ImageLike, Samples, samples_of

Arrays = dict[str, npt.NDArray[Any]]

_KEY = "chdstat"
"""Header entry that marks a file of chdstat. It holds a checksum and the JSON; other entries are
ignored."""
_FOREIGN = (
    AttributeError,
    LookupError,
    OSError,
    RecursionError,
    SafetensorError,
    TypeError,
    ValueError,
)
"""Errors that the reading libraries raise for damaged bytes."""
_UNFIT = (AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""Errors that a network raises for arrays that do not fit it."""


@dataclass(frozen=True, repr=False)
class History(Shown):
    """How the training went; every field has shape (record,).

    _Losses are in squared radiance.

    Attributes
    ----------
    iteration
        Iterations done.
    train_loss
        Mean loss of the minibatches since the previous record.
    validation_loss
        Loss on held-out rows.
    train_baseline, validation_baseline
        Loss of the sample mean on the same rows.
    """

    iteration: npt.NDArray[np.float64]
    train_loss: npt.NDArray[np.float64]
    validation_loss: npt.NDArray[np.float64]
    train_baseline: npt.NDArray[np.float64]
    validation_baseline: npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Trained:
    """A trained network, with its provenance.

    Attributes
    ----------
    history
        Rows of `History`.
    train_pixels
        Pixels used, rows (y, x).
    train_shape
        Height and width of the training image.
    provenance
        How and from what it was trained, ready for JSON.
    """

    history: npt.NDArray[np.float64]
    train_pixels: npt.NDArray[np.int64]
    train_shape: tuple[int, int]
    provenance: Mapping[str, Any]


State = TypeVar("State", bound=Trained)


class TrainedModel(Shown, ABC, Generic[State]):
    """An estimator that is trained once, then estimates, and can be saved."""

    kinds: ClassVar[dict[str, type[TrainedModel[Any]]]] = {}
    """The classes of trained models, by their kind in model files."""
    name: str
    inputs: int | None = None
    """Samples per estimate; None for any number."""
    kind: ClassVar[str]
    """Name of its kind in model files."""
    _trained: State | None

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        TrainedModel.kinds[cls.kind] = cls

    def _card(self) -> Card:
        if self._trained is None:
            return Card(repr(self))
        iterations, _, loss, _, baseline = self.state.history[-1].tolist()
        known = {k: v for k, v in self.provenance.items() if isinstance(v, str | int | float)}
        facts = {name.replace("_", " "): value for name, value in known.items()} | {
            "iterations": f"{iterations:.0f}",
            "trained on": f"{len(self.train_pixels)} pixels",
            "validation loss": f"{number(loss)}, where the sample mean has {number(baseline)}",
        }
        return Card(repr(self), facts)

    @property
    def train_pixels(self) -> npt.NDArray[np.int64]:
        """Pixels that it was trained on, rows (y, x)."""
        return self.state.train_pixels

    @property
    def train_shape(self) -> tuple[int, int]:
        """Height and width of the training image."""
        return self.state.train_shape

    @property
    def history(self) -> History:
        """How the training went."""
        return History(*self.state.history.T)

    @property
    def provenance(self) -> dict[str, Any]:
        """How it was trained: scene, seed, pixels, iterations, chdstat version."""
        return dict(self.state.provenance)

    def save(self, path: str | Path) -> None:
        """Write the trained network and its provenance to a safetensors file.

        Raises
        ------
        InputError
            If nothing was trained yet.
        StoreError
            If the file cannot be written.
        """
        state = self.state
        arrays, about = self._to_file(state)
        arrays |= {"history": state.history, "train_pixels": state.train_pixels}
        common = {"train_shape": state.train_shape, "provenance": state.provenance}
        write_model(Path(path), arrays, {"kind": self.kind, **about, **common})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a trained network; this runs no code from the file.

        Raises
        ------
        StoreError
            If there is no such file, it is damaged, or it holds something else.
        """
        arrays, about = read_model(Path(path))
        kind = about.get("kind") if isinstance(about, dict) else None
        known = [name for name, one in TrainedModel.kinds.items() if issubclass(one, cls)]
        if kind not in known:
            message = f"{path} holds a model of kind {kind!r}, not {' or '.join(map(repr, known))}"
            raise StoreError(message)
        try:
            common = {
                "history": arrays["history"],
                "train_pixels": arrays["train_pixels"].astype(np.int64, copy=False),
                "train_shape": (int(about["train_shape"][0]), int(about["train_shape"][1])),
                "provenance": dict(about["provenance"]),
            }
            own = cast("type[Self]", TrainedModel.kinds[kind])
            return own._from_file(arrays, about, common)
        except _UNFIT as error:
            message = f"{path} does not hold a whole network ({error!r}); train or copy it again"
            raise StoreError(message) from error

    @abstractmethod
    def predict(self, x: npt.ArrayLike, /) -> npt.NDArray[np.float32]:
        """Estimate radiance."""

    @abstractmethod
    def _to_file(self, state: State) -> tuple[Arrays, dict[str, Any]]:
        """Return the arrays and the JSON of a file, without the fields of `Trained`."""

    @classmethod
    @abstractmethod
    def _from_file(cls, arrays: Arrays, about: Mapping[str, Any], common: dict[str, Any]) -> Self:
        """Return the estimator from a file; `common` are the fields of `Trained`."""

    @property
    def state(self) -> State:
        """The result of training.

        Raises
        ------
        InputError
            If nothing was trained yet.
        """
        if self._trained is None:
            known = f"call train(samples) or {type(self).__name__}.load(path)"
            message = f"{self.name} is not trained yet; {known}"
            raise InputError(message)
        return self._trained


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch use so many threads while the context lasts."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def write_model(path: Path, arrays: Mapping[str, npt.NDArray[Any]], about: Any) -> None:
    """Write a model file; an existing one is replaced as a whole or not at all.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    text = json.dumps(about, default=str)
    # One entry only: the order of several would be random.
    header = {_KEY: f"{_checksum(text, contiguous)} {text}"}
    try:
        with replacing(path) as partial:
            save_file(contiguous, partial, metadata=header)
    except (OSError, SafetensorError) as error:
        message = f"cannot write a model to {path}: {error}"
        raise StoreError(message) from error


def read_model(path: Path) -> tuple[Arrays, Any]:
    """Read the arrays and the JSON of a model file.

    Raises
    ------
    StoreError
        If there is no such file, it is damaged, or chdstat has not written it.
    """
    if not path.is_file():
        message = f"no model at {path}; train one with: chdstat train SCENE -o {path}"
        raise StoreError(message)
    try:
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            if _KEY not in header:
                message = f"{path} is a safetensors file, but not a chdstat model"
                raise StoreError(message)
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        expected, _, text = header[_KEY].partition(" ")
        if expected != _checksum(text, arrays):
            message = (
                f"{path} is damaged, or of an earlier chdstat that wrote no checksum: weights and "
                "header do not agree with it; train or copy it again"
            )
            raise StoreError(message)
        return arrays, json.loads(text)
    except _FOREIGN as error:
        message = f"{path} is damaged or not a chdstat model ({error}); train or copy it again"
        raise StoreError(message) from error


def _checksum(text: str, arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Return the checksum of a header and of all arrays, in any order."""
    parts = [text.encode()]
    for name, array in sorted(arrays.items()):
        parts += [f"{name} {array.dtype.str} {array.shape}".encode(), array.tobytes()]
    return f"{checksum(b''.join(parts)):08x}"


def train_model(
    samples: ImageLike | npt.ArrayLike,
    name: str = "elek2019",
    *,
    spp: int | None = None,
    seed: Seed = 0,
    iterations: int | None = None,
    progress: bool = True,
) -> TrainedModel[Any]:
    """Train an estimator on an image.

    The other samples of each pixel are its reference, so there must be many more samples than one
    estimate takes.

    Parameters
    ----------
    samples
        The image.
    name
        A registered estimator that learns, as `chdstat.estimators.names` lists them.
    spp
        Use the first so many samples; None uses all.
    seed
        Draws pixels, first weights and minibatches.
    iterations
        Minibatches; None for the estimator's default.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

    Returns
    -------
    TrainedModel
        `MLP` for "elek2019"; its ``save`` writes it to a file.

    Raises
    ------
    InputError
        If no estimator of that name learns, or there are too few samples.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> image = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 64)))
    >>> train_model(image, iterations=5, progress=False)
    <MLP 'elek2019', 32 samples, scene 'samples'>
    """
    entry = check_choice(name)
    used = first_samples(samples, spp)
    options: Any = {"seed": seed_number(seed), "iterations": iterations, "progress": progress}
    found = entry.train(used, **options)
    if not isinstance(found, TrainedModel):
        message = f"{name} trains a {type(found).__name__}, which is no model of this library"
        raise InputError(message)
    return found


def check_choice(name: str) -> LearnedEstimator:
    """Return the entry of an estimator that learns.

    Raises
    ------
    InputError
        If it does not learn.
    """
    entry = lookup(name)
    if not isinstance(entry, LearnedEstimator):
        trainable = [n for n in names("learned") if isinstance(lookup(n), LearnedEstimator)]
        message = f"{name} trains no network; give one of {', '.join(trainable)}"
        raise InputError(message)
    return entry


def load_model(path: str | Path) -> TrainedModel[Any]:
    """Read a trained estimator of any kind; this runs no code from the file.

    Raises
    ------
    StoreError
        If there is no such file, it is damaged, or it holds something else.

    Examples
    --------
    >>> load_model("nowhere.safetensors")
    Traceback (most recent call last):
        ...
    chdstat.errors.StoreError: no model at nowhere.safetensors; train one with: ...
    """
    found: TrainedModel[Any] = TrainedModel.load(path)
    return found


def first_samples(samples: ImageLike | npt.ArrayLike, spp: int | None) -> Samples:
    """Return the first samples of each pixel, in memory; None returns all as they are.

    Raises
    ------
    InputError
        If there are fewer samples, or `spp` is less than one.
    """
    image = samples_of(samples)
    return image if spp is None or spp == image.spp else image.first(spp)
