"""Caches: what was computed of a store, kept beside it until the samples or the code change."""

from __future__ import annotations

import glob
import hashlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from chdstat._code import code_digest
from chdstat._core.files import read_record, write_record
from chdstat.analysis import analyze, save
from chdstat.comparison import Comparison, compare
from chdstat.errors import StoreError
from chdstat.estimators import LearnedEstimator, lookup
from chdstat.estimators.registry import Model
from chdstat.models import AnyModel, load_model
from chdstat.samples import Samples
from chdstat.studies.stores import Stores
from chdstat.summary import summarize

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["analysis_of", "comparison_of", "record_of", "summary_of"]

T = TypeVar("T")

_MODEL, _RECORD = ".safetensors", ".npz"
_N = 32
"""Samples of one estimate, as in Elek et al. 2019."""


def analysis_of(samples: Samples, stores: Stores, *, progress: bool | None) -> xr.Dataset:
    """Return what `chdstat.analyze` says of samples, from the cache where it is there."""

    def analysed() -> xr.Dataset:
        return analyze(_at_hand(samples), progress=progress)

    return _dataset(samples, stores, ".analysis", analysed)


def summary_of(samples: Samples, stores: Stores, *, progress: bool | None) -> xr.Dataset:
    """Return what `chdstat.summarize` says of samples, from the cache where it is there."""
    return _dataset(samples, stores, ".summary", lambda: summarize(samples, progress=progress))


def comparison_of(
    samples: Samples,
    estimators: Sequence[str],
    labels: xr.DataArray,
    stores: Stores,
    *,
    progress: bool | None,
) -> Comparison:
    """Return what `chdstat.compare` says; what was trained on these samples serves again.

    Raises
    ------
    InputError
        If the samples cannot judge the estimators.
    """
    places = {name: _place(samples, stores, f"{name}-", _MODEL) for name in estimators}
    kept = {name: place for name, place in places.items() if place is not None}
    read = {name: _read_model(place) for name, place in kept.items()}
    known = {name: model for name, model in read.items() if model is not None}
    models: dict[str, Model] = {**known}

    def compared() -> Comparison:
        found = compare(
            _at_hand(samples), estimators, n=_N, model=known, labels=labels, progress=progress
        )
        models.update(found.models)
        for name in found.models.keys() & kept.keys() - known.keys():
            model = found.models[name]
            if isinstance(model, AnyModel):
                _forget_others(kept[name])
                model.save(kept[name])
        return replace(found, models={})  # a record holds no network

    learned = {name for name in estimators if isinstance(lookup(name), LearnedEstimator)}
    found = record_of(
        samples,
        stores,
        "comparison",
        Comparison,
        compared,
        needs=[estimators],
        afresh=not learned <= known.keys(),
    )
    return replace(found, models=models)


def record_of(
    samples: Samples,
    stores: Stores,
    name: str,
    kind: type[T],
    work: Callable[[], T],
    *,
    needs: Sequence[object] = (),
    afresh: bool = False,
) -> T:
    """Return what was found in samples, from the cache where it is there.

    Parameters
    ----------
    samples, stores
        Where it was found, and the folder that holds it.
    name
        What it is.
    kind
        Its type, such as ``tuple[Finding, ...]``.
    work
        Finds it.
    needs
        What else it depends on, each with a `repr` that tells it from others; None if one of these
        has nothing that would tell it, so that nothing is kept.
    afresh
        Find it again, though it may be there: something that goes with it is not.
    """
    told = hashlib.sha256(repr(needs).encode()).hexdigest()[:12]
    place = None if None in needs else _place(samples, stores, f"{name}-{told}-", _RECORD)
    if place is None:
        return work()
    if place.is_file() and not afresh:
        try:
            return read_record(place, kind)
        except StoreError:  # damaged: find it again
            place.unlink()
    found = work()
    _forget_others(place)
    # Read as it will be, so that no study differs from the one before.
    return read_record(write_record(place, found), kind)


def _at_hand(samples: Samples) -> Samples:
    """Read samples once that are walked several times, if they fit in memory with ease."""
    return samples.load() if samples.nbytes <= 2**29 else samples


def _place(samples: Samples, stores: Stores, name: str, suffix: str) -> Path | None:
    return stores.beside(samples, f"-{name}{code_digest()}{suffix}")


def _dataset(
    samples: Samples, stores: Stores, suffix: str, work: Callable[[], xr.Dataset]
) -> xr.Dataset:
    place = _place(samples, stores, "", suffix)
    found = None if place is None else _read_dataset(place)
    if found is not None:
        return found
    found = work()
    if place is not None:
        _forget_others(place)
        try:
            save(found, place)
        except StoreError:
            if not place.exists():  # else another study has kept the same
                raise
    return found


def _read_dataset(place: Path) -> xr.Dataset | None:
    import xarray as xr

    if not place.is_dir():
        return None
    try:
        # Without chunks: all of it is read at once, for which Dask would take three times as long.
        found: xr.Dataset = xr.open_zarr(place, consolidated=False, chunks=None).load()
    except (OSError, ValueError, KeyError, RuntimeError):  # damaged: compute it again
        shutil.rmtree(place, ignore_errors=True)
        return None
    return found


def _read_model(place: Path) -> AnyModel | None:
    if not place.is_file():
        return None
    try:
        return load_model(place)
    except StoreError:  # damaged: train it again
        return None


def _forget_others(place: Path) -> None:
    """Delete what earlier code kept of the same samples."""
    prefix = glob.escape(place.stem.removesuffix(code_digest()))
    for old in place.parent.glob(f"{prefix}*{place.suffix}"):
        if old.is_dir():
            shutil.rmtree(old, ignore_errors=True)
        else:
            old.unlink(missing_ok=True)
