"""Renders of the bench of bugs: each made once and kept in a folder.

``CHDSTAT_BUGS``
    Folder that keeps them, about 5 GB; without it, a run makes its own.
``CHDSTAT_BUGS_SCENES``
    Some of the scenes, apart by semicolons.

``python -m benchmarks.bug_renders`` makes those that are missing: 380 renders of 2e6 samples, of
about 4 seconds of processor time each.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import chdstat as chd
from benchmarks.renderer_bugs import EDGE, FAULTS, SCENES, TOGETHER, Fault, described
from chdstat.rendering import render_batches
from chdstat.scenes import load_scene

SPP = 480
"""Samples per pixel, 2e6 in an image, as in the tests of Mitsuba."""
TENTH = 48
"""Samples of a tenth of it: the first ones."""
TERMS = 48
"""Batches of a render that are kept, beside the samples of its tenth."""
TIMES = 3
"""Samples of a reference over those of a render."""
RIGHT = 6
"""Right renders of a scene, beside its reference."""
AT_ONCE = 60
"""Samples of a pixel in a wavefront."""
WITH_MEDIA = ("fog",)
"""Scenes with media, which the faulty path tracer does not know."""
SEED = 1000
"""Of the first right render; those of faults go on from 2000, that of a reference is 1."""


@dataclass(frozen=True)
class Render:
    """What tests need of a render.

    Attributes
    ----------
    batches
        Means of batches, shape (y, x, channel, 48), float32.
    first
        Its first samples, a tenth, same shape.
    """

    batches: np.ndarray
    first: np.ndarray

    @classmethod
    def of(cls, samples: np.ndarray) -> Render:
        size = samples.shape[3] // TERMS
        batches = samples.reshape(*samples.shape[:3], TERMS, size).mean(axis=-1, dtype=float)
        return cls(batches.astype(np.float32), samples[..., :TENTH])


@dataclass(frozen=True)
class Scene:
    """A scene, its reference, its right and its faulty renders.

    Attributes
    ----------
    name
        One of `benchmarks.renderer_bugs.SCENES`.
    folder
        Where renders are kept.
    """

    name: str
    folder: Path

    def right(self, number: int) -> np.ndarray:
        """Return all samples of a right render by its number, shape (y, x, channel, sample)."""
        path = self.folder / f"{self.name}-right-{number}.npy"
        if not path.exists():
            np.save(path, self._drawn(self.described(), SEED + number))
        return np.load(path)

    @cached_property
    def reference(self) -> np.ndarray:
        """All samples of the reference, in single precision."""
        path = self.folder / f"{self.name}-reference.npy"
        if not path.exists():
            np.save(path, self._drawn(self.described(), 1, TIMES * SPP))
        return np.load(path)

    def control(self) -> Render | None:
        """Return the render of the path tracer without a fault; None if it knows no medium."""
        if self.name in WITH_MEDIA:
            return None
        return self._kept("control", lambda: self._drawn(self.described(), 1999, fault=""))

    def faulty(self, fault: Fault) -> Render | None:
        """Return the render with a fault; None if the scene has nothing of the kind."""
        if not self.has(fault):
            return None
        number = [f.name for f in FAULTS].index(fault.name)
        if fault.kind == "samples":
            rng = np.random.default_rng(number)
            return Render.of(fault.change(self.right(number % RIGHT), rng))
        if (k := self._group(fault)) is not None:
            self._keep_together(k)
        return self._kept(fault.name, lambda: self._rendered(fault, 2000 + number))

    def unchanged(self, fault: Fault) -> Render | None:
        """Return the right render of the same samples as that of a fault; None if there is none."""
        if fault.kind == "samples":
            number = [f.name for f in FAULTS].index(fault.name)
            return Render.of(self.right(number % RIGHT))
        if (k := self._group(fault)) is None:
            return None
        self._keep_together(k)
        return self._kept(f"together {k}", tuple)

    def _group(self, fault: Fault) -> int | None:
        """Return the number of the group in `TOGETHER` that a fault is rendered with."""
        found = [k for k, group in enumerate(TOGETHER) if fault.name in group]
        return found[0] if found and self.name not in WITH_MEDIA else None

    def has(self, fault: Fault) -> bool:
        """Return whether the scene has what a fault changes."""
        if fault.kind == "integrator":
            outside = fault.name != "no sine in the environment" or self.name == "courtyard"
            return self.name not in WITH_MEDIA and outside
        if fault.name == "lens":
            return self.name == "courtyard"
        return fault.kind != "scene" or fault.change(self.described(), self.folder) is not None

    def described(self) -> dict[str, Any]:
        return described(self.name, self.folder)

    def _rendered(self, fault: Fault, seed: int) -> np.ndarray:
        if fault.kind == "scene":
            return self._drawn(fault.change(self.described(), self.folder), seed)
        kind = "moved" if fault.kind == "camera" else "faulty"
        return self._drawn(self.described(), seed, kind=kind, fault=fault.name)

    def _drawn(
        self,
        scene: dict[str, Any],
        seed: int,
        spp: int = SPP,
        *,
        kind: str = "faulty",
        fault: str | None = None,
    ) -> np.ndarray:
        own = scene["integrator"]
        integrator = dict(own)
        if fault is not None:
            chd.scenes.load_plugin(Path(__file__).with_name("faulty_path.py"))
            integrator = {"type": kind, "fault": fault, "max_depth": own["max_depth"]}
            integrator |= {"inside": own["type"]} if kind == "moved" else {}
        batches = render_batches(
            scene,
            spp=spp,
            batch=SPP,
            size=(EDGE, EDGE),
            seed=seed,
            integrator=integrator,
            backend="llvm",
            progress=False,
        )
        return np.concatenate(list(batches), axis=-1)

    def _kept(self, name: str, draw: Callable[[], np.ndarray]) -> Render:
        path = self._path(name)
        if not path.exists():
            self._keep(name, draw())
        with np.load(path) as kept:
            return Render(*(kept[name] for name in ("batches", "first")))

    def _keep_together(self, k: int) -> None:
        """Render what is missing of a group, and the same paths without a fault."""
        names = {f.name: f.name for f in FAULTS if f.name in TOGETHER[k] and self.has(f)}
        names[f"together {k}"] = ""
        missing = [name for name in names if not self._path(name).exists()]
        samples = drawn_together(self, [names[name] for name in missing], 3000 + k)
        for name, drawn in zip(missing, samples, strict=True):
            self._keep(name, drawn)

    def _keep(self, name: str, samples: np.ndarray) -> None:
        made = Render.of(samples)
        np.savez(self._path(name), batches=made.batches, first=made.first)

    def _path(self, name: str) -> Path:
        return self.folder / f"{self.name}-{''.join(c if c.isalnum() else '_' for c in name)}.npz"


def drawn_together(scene: Scene, faults: Sequence[str], seed: int) -> list[np.ndarray]:
    """Return the samples of faults that leave paths as they are, along the same paths."""
    if not faults:
        return []
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from benchmarks.faulty_path import Faulty

    described = scene.described()
    described["sensor"]["film"] |= {"width": EDGE, "height": EDGE}
    loaded = load_scene(described).load()
    settings = mi.Properties("faulty")
    settings["max_depth"] = described["integrator"]["max_depth"]
    integrator = Faulty(settings)
    integrator.faults, drawn = tuple(faults), []
    for start in range(0, SPP, AT_ONCE):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed * SPP + start, EDGE**2 * AT_ONCE)
        pixel = dr.arange(mi.UInt32, EDGE**2 * AT_ONCE) // AT_ONCE
        place = mi.Point2f(pixel % EDGE, pixel // EDGE) + sampler.next_2d()
        ray, weight = loaded.sensors()[0].sample_ray_differential(
            0, sampler.next_1d(), place / EDGE, sampler.next_2d()
        )
        lights, _ = integrator.lights(loaded, sampler, ray)
        lights = [weight * light for light in lights]
        dr.eval(lights)
        shape = (3, EDGE, EDGE, AT_ONCE)
        drawn.append([np.moveaxis(np.array(x).reshape(shape), 0, 2) for x in lights])
    return [np.concatenate(parts, axis=-1) for parts in zip(*drawn, strict=True)]


def scenes(temporary: Path) -> list[Scene]:
    """Return the scenes; what is not kept elsewhere is put into a folder."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    names = os.environ.get("CHDSTAT_BUGS_SCENES")
    folder = Path(os.environ.get("CHDSTAT_BUGS", temporary))
    return [Scene(name, folder) for name in (names.split(";") if names else SCENES)]


def _steps(every: list[Scene]) -> Iterator[tuple[str, Any]]:
    for scene in every:
        yield f"{scene.name}: reference", lambda s=scene: s.reference
        yield f"{scene.name}: control", scene.control
        for i in range(RIGHT):
            yield f"{scene.name}: right {i}", lambda s=scene, n=i: s.right(n)
    for fault in FAULTS:
        for scene in every:
            if fault.kind != "samples":
                yield f"{scene.name}: {fault.name}", lambda s=scene, f=fault: s.faulty(f)


def main() -> None:
    """Make what is missing."""
    for name, make in _steps(scenes(Path(os.environ["CHDSTAT_BUGS"]))):
        start = time.monotonic()
        try:
            make()
        except Exception as error:  # noqa: BLE001 - the others are made all the same
            sys.stdout.write(f"{name}: {error!r}\n")
        sys.stdout.write(f"{name} {time.monotonic() - start:.1f} s\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
