"""Caches: what was computed of a store, kept beside it until the samples or the code change."""

from __future__ import annotations

import functools
import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from chdstat.analysis import analyze, save
from chdstat.comparison import Comparison, compare
from chdstat.errors import StoreError
from chdstat.models import AnyModel, load_model
from chdstat.samples import Samples
from chdstat.studies.stores import Stores

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["analysis_of", "comparison_of"]

_ANALYSIS, _MODEL = ".analysis", ".safetensors"
_N = 32
"""Samples of one estimate, as in Elek et al. 2019."""


def analysis_of(samples: Samples, stores: Stores, *, progress: bool | None) -> xr.Dataset:
    """Return what `chdstat.analyze` says of samples, from the cache where it is there."""
    place = _place(samples, stores, "", _ANALYSIS)
    found = None if place is None else _read_analysis(place)
    if found is not None:
        return found
    found = analyze(_at_hand(samples), progress=progress)
    if place is not None:
        _forget_others(place)
        # Complete or absent: a cache that was interrupted is never read.
        partial = place.with_name(f".{place.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        save(found, partial).replace(place)
    return found


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
    found = compare(
        _at_hand(samples), estimators, n=_N, model=known, labels=labels, progress=progress
    )
    for name in found.models.keys() & kept.keys() - known.keys():
        model = found.models[name]
        if isinstance(model, AnyModel):
            _forget_others(kept[name])
            model.save(kept[name])
    return found


def _at_hand(samples: Samples) -> Samples:
    """Read samples once that are walked several times, if they fit in memory with ease."""
    return samples.load() if samples.nbytes <= 2**29 else samples


def _place(samples: Samples, stores: Stores, name: str, suffix: str) -> Path | None:
    return stores.beside(samples, f"-{name}{_code()}{suffix}")


@functools.cache
def _code() -> str:
    """Return a digest of the package's own code: what another version computed is not read."""
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _read_analysis(place: Path) -> xr.Dataset | None:
    import xarray as xr

    if not place.is_dir():
        return None
    try:
        found: xr.Dataset = xr.open_zarr(place, consolidated=False).load()
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
    prefix = place.stem.removesuffix(_code())
    for old in place.parent.glob(f"{prefix}*{place.suffix}"):
        if old.is_dir():
            shutil.rmtree(old, ignore_errors=True)
        else:
            old.unlink(missing_ok=True)
