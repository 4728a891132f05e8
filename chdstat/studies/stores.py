"""Stores of a study: its renders in one folder, and what was computed of them, each made once.

The name of a store tells its scene and, as a digest, everything else that its samples depend on but
for their number: a render that was stopped resumes, and more samples append. Analyses, summaries
and comparisons are kept beside the store until the samples or the code change.
"""

from __future__ import annotations

import glob
import hashlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from chdstat._core.files import code_digest, read_record, write_record
from chdstat.analysis import analyze, save
from chdstat.comparison import Comparison, compare
from chdstat.errors import StoreError
from chdstat.estimators import LearnedEstimator, lookup
from chdstat.estimators.models import AnyModel, load_model
from chdstat.estimators.registry import Model
from chdstat.rendering.backend import Backend
from chdstat.rendering.capture import render
from chdstat.samples import Samples
from chdstat.samples import open as open_samples
from chdstat.scenes import Scene
from chdstat.studies.config import Subject
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "ROULETTE",
    "SHORT",
    "Renders",
    "Stores",
    "analysis_of",
    "comparison_of",
    "record_of",
    "summary_of",
]

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


SHORT = 3
"""Longest path, in segments, of the shorter ones: two bounces, as in the case study of Elek et al.
2019, which compares two with five."""
ROULETTE = 1
"""Segment from which on the other integrator plays Russian roulette: it solves the same equation
with other samples. `volpath` in place of `path` would not do: without media, its shapes of CHDs are
those of `path`.
"""
_PLAYED = ("path", "volpath")
_FEWER, _FEWEST = 2, 4
"""Samples of renders to compare with are this much fewer, but at least these:"""
_LEAST = 128


@dataclass(frozen=True)
class Renders:
    """All samples of one scene.

    Attributes
    ----------
    samples
        The image.
    shorter, integrator, again
        The same view with shorter paths, by another integrator, and with another seed; None where
        there is no such render.
    """

    samples: Samples
    shorter: Samples | None = None
    integrator: Samples | None = None
    again: Samples | None = None


@dataclass(frozen=True)
class Stores:
    """The folder that holds the renders of a study.

    Attributes
    ----------
    folder
        Where they lie; None keeps them in memory.
    backend, progress
        As for `chdstat.render`.
    """

    folder: Path | None
    backend: Backend = "auto"
    progress: bool | None = None

    def renders(self, subject: Subject) -> Renders:
        """Render what is not there yet; samples that were given stand alone."""
        if subject.samples is not None or subject.scene is None:
            return Renders(subject.samples)  # type: ignore[arg-type]
        scene, settings = subject.scene, dict(subject.settings)
        spp = int(settings["spp"])
        fewer, fewest = (max(min(spp, _LEAST), spp // by) for by in (_FEWER, _FEWEST))
        samples = self._rendered(scene, settings)

        def seed(further: int) -> dict[str, int]:
            # Tests of a difference take the samples of all renders for independent.
            return {"seed": int(settings["seed"]) + further}

        other = _by_another(scene, samples)
        return Renders(
            samples,
            shorter=self._rendered(scene, settings | {"max_depth": SHORT, "spp": fewer, **seed(3)})
            if _is_longer(samples)
            else None,
            integrator=self._rendered(other, settings | {"spp": fewest, **seed(2)})
            if other
            else None,
            again=self._rendered(scene, settings | {"spp": fewer, **seed(1)}),
        )

    def beside(self, samples: Samples, suffix: str) -> Path | None:
        """Return where to keep what was computed of samples; None without a place."""
        told = self.told(samples)
        return None if self.folder is None or told is None else self.folder / f"{told}{suffix}"

    def told(self, samples: Samples | None) -> str | None:
        """Return what tells samples from all others; "" of no samples, None without a place.

        All that a store says of itself is in it: another render may take its place and name.
        """
        if samples is None:
            return ""
        if self.folder is None or samples.path is None:
            return None
        attrs = json.dumps(samples.attrs, sort_keys=True)
        return f"{samples.path.stem}-{_digest(attrs)}-{samples.spp}"

    def _rendered(self, scene: Scene, settings: Mapping[str, Any]) -> Samples:
        out = None if self.folder is None else self.folder / f"{_name(scene, settings)}.zarr"
        done = None if out is None else _finished(out, scene, int(settings["spp"]))
        if done is not None:
            return done
        return render(scene, **settings, out=out, backend=self.backend, progress=self.progress)


def _name(scene: Scene, settings: Mapping[str, Any]) -> str:
    told = {name: settings.get(name) for name in ("size", "seed", "max_depth")}
    return f"{scene.name}-{_digest(repr((scene.hash, sorted(told.items()))))}"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _finished(path: Path, scene: Scene, spp: int) -> Samples | None:
    """Return the samples of a store that needs no renderer any more; None of any other."""
    if not path.exists():
        return None
    try:
        samples = open_samples(path)
    except StoreError:
        return None  # `render` resumes it, or says what is wrong
    # The code of plugins is known to the renderer only, which compares it before it appends.
    plugins = samples.attrs.get("scene_code")
    same = samples.attrs.get("scene_hash") == scene.hash and not plugins
    return samples if same and samples.spp >= spp else None


def _is_longer(samples: Samples) -> bool:
    depth = dict(samples.attrs["integrator"]).get("max_depth", -1)
    return int(depth) < 0 or int(depth) > SHORT


def _by_another(scene: Scene, samples: Samples) -> Scene | None:
    """Return the scene with another integrator: of a scene in Python only, as files are fixed."""
    used: dict[str, Any] = dict(samples.attrs["integrator"])
    kind = used.get("type")
    if kind not in _PLAYED or not isinstance(scene.source, Mapping):
        return None
    if used.get("rr_depth") == ROULETTE:
        return None
    rest = {
        name: value
        for name, value in scene.source.items()
        if not (isinstance(value, Mapping) and value.get("type") == kind)
    }
    return Scene(scene.name, {**rest, "integrator": {**used, "rr_depth": ROULETTE}})
