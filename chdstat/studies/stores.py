"""Stores: the renders of a study in one folder, each made once and found again.

The name of a store tells its scene and, as a digest, everything else that its samples depend on but
for their number: a render that was stopped resumes, and more samples append.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chdstat.backend import Backend
from chdstat.capture import render
from chdstat.errors import StoreError
from chdstat.samples import Samples
from chdstat.samples import open as open_samples
from chdstat.scenes import Scene
from chdstat.studies.subjects import Subject

__all__ = ["ROULETTE", "SHORT", "Renders", "Stores"]

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
