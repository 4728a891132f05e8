"""Trained state of the progressive estimator: what training leaves, its provenance, and its file.

The file is in the safetensors format, which runs no code when read. Beside the network it holds how
far to trust it, its error model, and a `Fingerprint`: some of the samples that trained it, by which
it recognises their image, as an array has no provenance. A model of another scene is followed only
as far as it pays, which is measured with noise; for its own image that is not measured again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat.errors import StoreError
from chdstat.estimators.model_files import read_model, write_model
from chdstat.estimators.progressive.dataset import TrainingSet
from chdstat.estimators.progressive.error_model import ErrorModel
from chdstat.estimators.progressive.inputs import (
    GROUPS,
    LOSSES,
    MOST_TRUST,
    Architecture,
    InputConfig,
)
from chdstat.estimators.progressive.splits import SampleSplits
from chdstat.samples import Samples

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network

__all__ = [
    "Estimates",
    "Fingerprint",
    "Learned",
    "Origin",
    "Trust",
    "provenance_of",
    "read_learned",
    "write_learned",
]

_SAMPLES, _TRIED = 2048, 2**15
_ENOUGH = 0.5
"""Of the marks that are expected among the samples of an image: some pixels may be bad."""
_FEWEST = 4
_SAME = 1e-6
"""Logarithm of a ratio up to which samples are the same, in whatever unit."""


@dataclass(frozen=True)
class Fingerprint:
    """Samples, and the pixels that drew them.

    Attributes
    ----------
    places
        Number of the image, y and x, shape (mark, 3).
    samples
        In units of the image's radiance, shape (mark, channel).
    """

    places: npt.NDArray[np.int64]
    samples: npt.NDArray[np.float32]

    @classmethod
    def none(cls, channels: int) -> Self:
        """Return no marks."""
        return cls(np.zeros((0, 3), np.int64), np.zeros((0, channels), np.float32))

    @classmethod
    def of(cls, training_set: TrainingSet, channels: int, rng: np.random.Generator) -> Self:
        """Draw samples that no other pixel has."""
        if not isinstance(training_set.splits, SampleSplits):
            return cls.none(channels)
        rows, drawn = training_set.splits.some(_TRIED, rng)
        _, first, count = np.unique(drawn, axis=0, return_index=True, return_counts=True)
        chosen = rng.permutation(first[(count == 1) & drawn[first].all(axis=1)])[:_SAMPLES]
        image = np.repeat(np.arange(len(training_set.parts)), training_set.parts)[rows[chosen]]
        places = np.column_stack([image, training_set.pixels[rows[chosen]]])
        return cls(places, drawn[chosen])

    def match(self, x: npt.NDArray[Any], scenes: Sequence[dict[str, Any]]) -> bool:
        """Return whether samples (y, x, channel, sample) are of an image that trained.

        Parameters
        ----------
        x
            The samples, in any order and unit.
        scenes
            Of the provenance: shapes of the images.
        """
        return any(self._match(x, number, scene) for number, scene in enumerate(scenes))

    def _match(self, x: npt.NDArray[Any], number: int, scene: dict[str, Any]) -> bool:
        own = self.places[:, 0] == number
        height, width, channels, spp = scene["samples_shape"]
        if x.ndim != 4 or x.shape[:3] != (height, width, channels) or not own.any():
            return False
        _, ys, xs = self.places[own].T
        drawn = x[ys, xs].mean(axis=1, dtype=np.float64)
        known = self.samples[own].mean(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.round(np.log(drawn / known[:, np.newaxis]) / _SAME)
        # One factor, that of the units, leads from many marks to a sample of their pixel.
        near = np.concatenate([ratio, ratio + 1], axis=1)
        found = np.concatenate([np.unique(row[np.isfinite(row)]) for row in near])
        most = np.unique(found, return_counts=True)[1].max(initial=0)
        expected = own.sum() * min(1.0, x.shape[-1] / spp)
        return bool(most >= max(_ENOUGH * expected, _FEWEST))


@dataclass(frozen=True)
class Estimates:
    """Estimates of a progressive estimator.

    Attributes
    ----------
    radiance
        Shape (..., channel), in the unit of the samples; NaN where no sample is good.
    certainty
        How far the estimate rests on what was learned, 0 to 1, shape (...): where it is 0, nothing
        was known of such a pixel, and the estimate is the mean of its samples.
    low, high
        Ends of the interval that contains the radiance with probability `level`, shape (...,
        channel).
    level
        Probability of the interval, on pixels like those that trained the network; of another
        scene it is not calibrated.
    """

    radiance: npt.NDArray[np.float32]
    certainty: npt.NDArray[np.float32]
    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    level: float


@dataclass(frozen=True)
class Trust:
    """How far to go from the mean to what a network estimates.

    Attributes
    ----------
    sizes
        Numbers of samples that shares are known for, ascending; between them they are
        interpolated along the logarithm, beyond them they go on.
    shares
        0 for the mean, 1 for the estimate; shape (size, loss, group), groups of pixels as of
        `trust.grouped`. Beyond 1 where others are held back.
    """

    sizes: npt.NDArray[np.float64]
    shares: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.shares.shape != (len(self.sizes), len(LOSSES), GROUPS) or not len(self.sizes):
            message = (
                f"shares must have shape (size, {len(LOSSES)}, {GROUPS}), size {len(self.sizes)}, "
                f"got {self.shares.shape}"
            )
            raise ValueError(message)
        if not ((self.shares >= 0) & (self.shares <= MOST_TRUST)).all():
            message = f"trust must lie between 0 and {MOST_TRUST}"
            raise ValueError(message)

    @classmethod
    def even(cls, share: float) -> Self:
        """Return the same share for all pixels."""
        return cls(np.ones(1), np.full((1, len(LOSSES), GROUPS), share))

    def fixed(self, count: int) -> Self:
        """Return the shares for a number of samples, whatever the number."""
        return replace(self, sizes=np.ones(1), shares=self.at(np.array([count])))

    def at(self, count: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Return the shares for numbers of samples, shape (row, loss, group)."""
        last = len(self.sizes) - 1
        place = np.interp(np.log2(np.maximum(count, 1)), np.log2(self.sizes), np.arange(last + 1))
        below = np.floor(place).astype(np.int64)
        part = (place - below)[:, np.newaxis, np.newaxis]
        above = np.minimum(below + 1, last)
        return np.asarray((1 - part) * self.shares[below] + part * self.shares[above])


@dataclass(frozen=True)
class Learned:
    """All that training leaves behind.

    Attributes
    ----------
    network, error_model
        What estimates, and what says how large its errors are.
    unit
        Mean radiance of the image that it was trained on.
    history
        Rows of `History`, losses in units of that of the sample mean.
    train_pixels, train_shape
        Pixels used, rows (y, x), and height and width of the image that they lie in.
    provenance
        Where it comes from, ready for JSON.
    trust
        How far to go from the mean to what the network estimates.
    fingerprint
        Samples that trained it.
    """

    network: Network
    error_model: ErrorModel
    unit: float
    history: npt.NDArray[np.float64]
    train_pixels: npt.NDArray[np.int64]
    train_shape: tuple[int, int]
    provenance: Mapping[str, Any]
    trust: Trust
    fingerprint: Fingerprint


@dataclass(frozen=True)
class Origin:
    """An image that trained.

    Attributes
    ----------
    scene
        Its name.
    attrs
        Provenance of its samples.
    shape
        Of its samples, (y, x, channel, sample).
    unit
        Its mean radiance.
    """

    scene: str
    attrs: Mapping[str, Any]
    shape: tuple[int, ...]
    unit: float

    @classmethod
    def of(cls, image: Samples, unit: float) -> Self:
        """Return that of samples."""
        return cls(image.name, image.attrs, image.shape, unit)

    def to_dict(self, pixels_used: int) -> dict[str, Any]:
        """Return the fields, and how many of its pixels were used, ready for JSON."""
        return {
            "scene": self.scene,
            "samples": dict(self.attrs),
            "samples_shape": list(self.shape),
            "unit": self.unit,
            "pixels_used": pixels_used,
        }


def provenance_of(
    origins: Sequence[Origin],
    training_set: TrainingSet,
    *,
    inputs: InputConfig,
    seed: int,
    trust: Trust,
) -> dict[str, Any]:
    """Return what is known of a training.

    Parameters
    ----------
    origins
        What trained.
    training_set
        What was made of it.
    inputs
        Of the estimator.
    seed
        Of the training.
    trust
        How far to go from the mean to what the network estimates; its average is noted.
    """
    scenes = [one.to_dict(used) for one, used in zip(origins, training_set.parts, strict=True)]
    return {
        "scene": ", ".join(one.scene for one in origins),
        "scenes": scenes,
        "samples": scenes[0]["samples"],
        "samples_shape": scenes[0]["samples_shape"],
        "reference": training_set.config.reference,
        "inputs": list(inputs.names),
        "seed": seed,
        "pixels_used": len(training_set.pixels),
        "pixels_excluded": training_set.excluded,
        "sizes": sorted(set(training_set.config.sizes)),
        "iterations": training_set.config.iterations,
        "trust": float(trust.shares.mean()),
        "chdstat": chdstat.__version__,
    }


_KIND = "progressive"

Arrays = Mapping[str, npt.NDArray[Any]]


def write_learned(path: str | Path, learned: Learned, inputs: Sequence[str]) -> None:
    """Write what was learned, and from which inputs.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    about = {
        "kind": _KIND,
        "shape": learned.network.architecture.to_dict(),
        "inputs": list(inputs),
        "unit": learned.unit,
        "train_shape": learned.train_shape,
        "provenance": learned.provenance,
    }
    arrays: dict[str, npt.NDArray[Any]] = {
        f"network.{name}": w for name, w in learned.network.to_arrays().items()
    }
    arrays |= {f"spread.{name}": a for name, a in vars(learned.error_model).items()}
    arrays |= {f"trust.{name}": a for name, a in vars(learned.trust).items()}
    arrays |= {f"marks.{name}": a for name, a in vars(learned.fingerprint).items()}
    arrays |= {"history": learned.history, "train_pixels": learned.train_pixels}
    write_model(Path(path), arrays, about)


def read_learned(path: str | Path) -> tuple[Learned, InputConfig]:
    """Read what was learned, and from which inputs.

    Raises
    ------
    StoreError
        If there is no such file, it is damaged, or it holds something else.
    """
    arrays, about = read_model(Path(path))
    if about.get("kind") != _KIND:
        message = f"{path} holds a model of kind {about.get('kind')!r}, not {_KIND!r}"
        raise StoreError(message)
    if "trust.shares" not in arrays:
        message = (
            f"{path} was trained by an earlier version, which did not measure how far it pays to "
            "follow the network; train it again"
        )
        raise StoreError(message)
    try:
        return _learned(arrays, about), InputConfig.of(about["inputs"])
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
        message = f"{path} does not hold a whole network ({error!r}); train or copy it again"
        raise StoreError(message) from error


def _learned(arrays: Arrays, about: Mapping[str, Any]) -> Learned:
    from chdstat.estimators.progressive.network import Network

    network = Network(Architecture(**about["shape"]))
    network.load_arrays(_below("network.", arrays))
    provenance = dict(about["provenance"])
    used = sum(int(scene["pixels_used"]) for scene in provenance["scenes"])
    if arrays["train_pixels"].shape != (used, 2):
        message = f"its scenes have {used} pixels, got {arrays['train_pixels'].shape}"
        raise ValueError(message)
    return Learned(
        network=network.eval(),
        error_model=ErrorModel(**_below("spread.", arrays)),
        unit=float(about["unit"]),
        history=arrays["history"],
        train_pixels=arrays["train_pixels"].astype(np.int64, copy=False),
        train_shape=(int(about["train_shape"][0]), int(about["train_shape"][1])),
        provenance=provenance,
        trust=Trust(**_below("trust.", arrays)),
        fingerprint=Fingerprint(**_below("marks.", arrays)),
    )


def _below(prefix: str, arrays: Arrays) -> dict[str, npt.NDArray[Any]]:
    return {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}
