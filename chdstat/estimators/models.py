"""Models: estimators that learn, trained by name, and read from files whatever they are.

>>> from chdstat.estimators import load_model, train_model
>>> # train_model(samples, "elek2019").save("scene.safetensors"); load_model("scene.safetensors")
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, TypeGuard

import numpy.typing as npt

from chdstat._core.arrays import Seed, seed_number
from chdstat.errors import InputError, StoreError
from chdstat.estimators.mlp import MLP
from chdstat.estimators.model_files import read_model
from chdstat.estimators.progressive import Progressive
from chdstat.estimators.progressive.inputs import Input
from chdstat.estimators.registry import Estimator, LearnedEstimator, lookup, names
from chdstat.samples import Image, Samples, samples_of

__all__ = ["AnyModel", "check_choice", "first_samples", "load_model", "train_model"]

AnyModel = MLP | Progressive
"""What can be trained, saved, and asked for estimates."""

_KINDS: dict[str, type[AnyModel]] = {"mlp": MLP, "progressive": Progressive}


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
    options: dict[str, Any] = {
        "seed": seed_number(seed),
        "iterations": iterations,
        "progress": progress,
    }
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
    if not _can_be_kept(entry):
        kept = [other for other in names("learned") if _can_be_kept(lookup(other))]
        message = f"{name} trains no network that could be kept; give one of {', '.join(kept)}"
        raise InputError(message)
    if name != Progressive.name and (inputs or not reference):
        message = (
            f"inputs, and training without a reference, are for {Progressive.name!r}, not {name!r}"
        )
        raise InputError(message)
    return entry


def _can_be_kept(entry: Estimator | LearnedEstimator) -> TypeGuard[LearnedEstimator]:
    return isinstance(entry, LearnedEstimator)


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
