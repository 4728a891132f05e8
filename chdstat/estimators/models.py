"""Models: the registered estimators that learn, trained by name, and read from any model file.

>>> from chdstat.estimators import load_model, train_model
>>> # train_model(samples, "elek2019").save("scene.safetensors"); load_model("scene.safetensors")
"""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, as_pixels, seed_number
from chdstat.errors import InputError, StoreError
from chdstat.estimators.mlp import MLP, PRESETS
from chdstat.estimators.progressive.inputs import Features, Input
from chdstat.estimators.progressive.model import Progressive
from chdstat.estimators.registry import LearnedEstimator, lookup, names, register, register_learned
from chdstat.estimators.training import read_model
from chdstat.estimators.validation import reordered
from chdstat.samples import Image, Samples, samples_of

__all__ = ["AnyModel", "check_choice", "first_samples", "load_model", "self_trained", "train_model"]

AnyModel = MLP | Progressive
"""What can be trained and saved."""

_KINDS: dict[str, type[AnyModel]] = {kind.kind: kind for kind in (MLP, Progressive)}
_SOURCE = "this library, after Zirr et al. 2018, doi:10.1111/cgf.13335"
_PIXELS = 8192
"""That a progressive estimator wants to train on."""


_ELEK = PRESETS["elek2019"]


def _train_elek(samples: Samples, **options: Any) -> MLP:
    return MLP(_ELEK).train(samples, **options)


def _train_progressive(inputs: Collection[Input], samples: Samples, **options: Any) -> Progressive:
    return Progressive(inputs=inputs).train(samples, **options)


register_learned(
    LearnedEstimator(
        _ELEK.name,
        _train_elek,
        _ELEK.source,
        inputs=_ELEK.inputs,
        pixels=_ELEK.pixels,
        about="Network of the paper: 32 samples of a channel in, its radiance out.",
        label="Elek et al. 2019",
        place=8,
    )
)
_PROGRESSIVE = "Network that weighs any number of samples by their luminance"
_ROWS: tuple[tuple[str, str, float, tuple[Input, ...]], ...] = (
    ("progressive", "progressive", 0.5, ()),
    ("progressive_mse", "progressive, for MSE", 0.0, ()),
    ("progressive_relmse", "progressive, for relMSE", 1.0, ()),
    ("progressive_features", "progressive, with features", 0.5, ("features",)),
    ("progressive_direct", "progressive, with direct light", 0.5, ("direct",)),
)
"""Name, label, loss weight and inputs of each; those of the same inputs share a training."""
_TRAININGS = {inputs: partial(_train_progressive, inputs) for *_, inputs in _ROWS}
for _name, _label, _loss_weight, _inputs in _ROWS:
    register_learned(
        LearnedEstimator(
            _name,
            _TRAININGS[_inputs],
            _SOURCE,
            inputs=None,
            pixels=_PIXELS,
            about=_PROGRESSIVE + _label.removeprefix(Progressive.name) + ".",
            label=_label,
            place=9,
            options={"loss_weight": _loss_weight},
            uses_features="features" in _inputs,
            joint_channels=True,
            uses_direct="direct" in _inputs,
        )
    )


@register(
    "self_trained",
    source="this library, after Lehtinen et al. 2018",
    label="self-trained",
    place=9,
    minimum_samples=4,
    uses_neighbours=True,
    joint_channels=True,
    uses_features=True,
    learns=True,
)
def self_trained(
    x: npt.ArrayLike,
    *,
    features: Features | None = None,
    seed: int = 0,
    iterations: int | None = None,
    progress: bool | None = False,
) -> npt.NDArray[np.float32]:
    """Train a progressive estimator on an image's own samples, and estimate from all of them.

    No reference and no second render is needed. It learns from splits of each pixel's samples, so
    that the truth is the expectation of what it learns from, with features and neighbours
    for inputs. In which order the samples come makes no difference.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), at least 4.
    features
        First-hit features of the image, as of `Samples.features`.
    seed, iterations, progress
        As for `Progressive.train`.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit of `x`.

    Raises
    ------
    InputError
        If `x` is no image, or has less than 4 samples.

    References
    ----------
    J. Lehtinen et al., "Noise2Noise: learning image restoration without clean data", ICML 2018.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> image = rng.exponential(size=(16, 16, 3, 16))
    >>> self_trained(image, iterations=5).shape
    (16, 16, 3)
    """
    samples = as_pixels(x, minimum=2, image=True)
    image = Samples.from_array(reordered(samples)[0], features=features, axes="yxcs")
    model = Progressive(inputs=["features", "neighbours"] if features else ["neighbours"])
    model.train(image, seed=seed, iterations=iterations, progress=progress)
    return model.predict(image.read(), features=features, trust=1.0)


def train_model(
    samples: Image | npt.ArrayLike,
    name: str = "progressive",
    *,
    inputs: Collection[Input] = (),
    reference: bool = True,
    spp: int | None = None,
    seed: Seed = 0,
    iterations: int | None = None,
    progress: bool | None = None,
) -> AnyModel:
    """Train an estimator on an image.

    Parameters
    ----------
    samples
        The image.
    name
        A registered estimator that learns, as `chdstat.estimators.names` lists them.
    inputs
        What it sees beside the samples of a pixel, as for `Progressive`; only "progressive".
    reference
        True learns from the other samples of each pixel, which must be many more than will be
        estimated from. False learns from splits of the samples, and adds neighbours to the inputs;
        only "progressive".
    spp
        Use the first so many samples; None uses all.
    seed
        Draws pixels, first weights and minibatches.
    iterations
        Minibatches; None for what the estimator is meant to take.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    MLP or Progressive
        Trained; its ``save`` writes it to a file.

    Raises
    ------
    InputError
        If no estimator of that name learns, an option is not for it, or the samples are too few.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> image = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 16)))
    >>> train_model(image, reference=False, iterations=5, progress=False).inputs.names
    ('neighbours',)
    """
    entry = check_choice(name, inputs=inputs, reference=reference)
    used = first_samples(samples, spp)
    options: Any = {"seed": seed_number(seed), "iterations": iterations, "progress": progress}
    if name == Progressive.name:
        around: tuple[Input, ...] = () if reference else ("neighbours",)
        model = Progressive(inputs=[*inputs, *around])
        return model.train(used, reference=reference, **options)
    found = entry.train(used, **options)
    if not isinstance(found, AnyModel):
        message = f"{name} trains a {type(found).__name__}, which is no model of this library"
        raise InputError(message)
    return found


def check_choice(
    name: str, *, inputs: Collection[Input] = (), reference: bool = True
) -> LearnedEstimator:
    """Return the entry of an estimator that learns, if it can learn so.

    Raises
    ------
    InputError
        If it learns nothing, or sees no such inputs, or needs a reference.
    """
    entry = lookup(name)
    if not isinstance(entry, LearnedEstimator):
        learned = names("learned")
        kept = [other for other in learned if isinstance(lookup(other), LearnedEstimator)]
        message = f"{name} trains no network that could be kept; give one of {', '.join(kept)}"
        raise InputError(message)
    if name != Progressive.name and (inputs or not reference):
        message = (
            f"inputs, and training without a reference, are for {Progressive.name!r}, not {name!r}"
        )
        raise InputError(message)
    return entry


def load_model(path: str | Path) -> AnyModel:
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
    _, about = read_model(Path(path))
    kind = about.get("kind") if isinstance(about, dict) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        message = f"{path} holds a model of kind {kind!r}; this version knows {', '.join(_KINDS)}"
        raise StoreError(message)
    return _KINDS[kind].load(path)


def first_samples(samples: Image | npt.ArrayLike, spp: int | None) -> Samples:
    """Return the first samples of each pixel, in memory; None returns all as they are.

    Raises
    ------
    InputError
        If there are not so many, or less than one is wanted.
    """
    image = samples_of(samples)
    return image if spp is None or spp == image.spp else image.first(spp)
