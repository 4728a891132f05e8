"""Jobs: all that samples depend on, checked, and without objects of Mitsuba's."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from chdstat._core.arrays import Seed, seed_number, whole
from chdstat.errors import InputError
from chdstat.rendering.backend import Backend, Color, Verdict, activate, resolve
from chdstat.rendering.instances import IntegratorObject, own_backend
from chdstat.rendering.seeds import SEEDS
from chdstat.rendering.sequences import SamplerName, Sequences
from chdstat.scenes import Scene, SceneLike, load_scene
from chdstat.scenes.plugins import Plugin, loaded, register
from chdstat.scenes.scene import LiveScene, is_built
from chdstat.scenes.settings import LONGEST, Asked, asked_for

__all__ = ["Crop", "IntegratorLike", "Job", "scene_integrator", "scene_size"]

IntegratorLike = str | Mapping[str, Any] | Any
"""An integrator by Mitsuba's name, as a dict with its settings, or as an object of Mitsuba's."""
Crop = tuple[int, int, int, int]
"""(x, y, width, height) in pixels of the image."""


@dataclass(frozen=True)
class Job:
    """All that the samples depend on, without Mitsuba objects: it can travel to another process."""

    scene: Scene
    verdict: Verdict
    size: tuple[int, int] | None = None
    seed: int = 0
    max_depth: int | None = None
    sensor: int = 0
    integrator: Mapping[str, Any] | IntegratorObject | None = None
    crop: Crop | None = None
    sequences: Sequences | None = None
    light: str | None = None
    plugins: tuple[Plugin, ...] = field(default_factory=loaded)

    @classmethod
    def of(
        cls,
        scene: SceneLike,
        *,
        size: tuple[int, int] | None = None,
        seed: Seed = 0,
        max_depth: int | None = None,
        sensor: int = 0,
        integrator: IntegratorLike | None = None,
        crop: Crop | None = None,
        sampler: SamplerName = "independent",
        sequence: int | None = None,
        color: Color = "rgb",
        backend: Backend = "auto",
    ) -> Job:
        """Return a job whose settings are checked, so that no work is done for wrong ones."""
        if size is not None:
            pair = isinstance(size, Sequence) and len(size) == 2
            if not pair:
                message = f"size must be (width, height) in pixels, got {size!r}"
                raise InputError(message)
            size = whole("width", size[0], least=1), whole("height", size[1], least=1)
            if max(size) > LONGEST:
                message = f"width and height must be at most {LONGEST} pixels, got {max(size):.4g}"
                raise InputError(message)
        if max_depth is not None:
            max_depth = whole("max_depth", max_depth, least=-1)
            if max_depth == 0:
                message = "max_depth must be at least 1 segment, or -1 for no limit, got 0"
                raise InputError(message)
        seed = seed_number(seed, span=SEEDS)
        if seed >= SEEDS:
            message = f"seed must be below 2^31, which all give different samples, got {seed}"
            raise InputError(message)
        sensor = whole("sensor", sensor, least=0)
        found = load_scene(scene)
        if isinstance(found.source, LiveScene):
            live = found.source.value
            backend = own_backend("scene is one", live, backend, color)
            integrator = live.integrator() if integrator is None else integrator
        if is_built(integrator):
            integrator = IntegratorObject.of(integrator, backend, color, max_depth)
            backend = cast("Backend", integrator.backend)
        elif integrator is not None:
            integrator = _described(integrator)
        return cls(
            found,
            resolve(backend, color),
            size,
            seed,
            max_depth,
            sensor,
            integrator,
            None if crop is None else _checked_crop(crop),
            Sequences.of(sampler, sequence),
        )

    @property
    def settings(self) -> tuple[Any, ...]:
        """What the samples depend on besides the scene."""
        given = self.integrator
        integrator = repr(sorted(given.items())) if isinstance(given, Mapping) else given
        return (
            self.verdict.variant,
            self.size,
            self.seed,
            self.max_depth,
            self.sensor,
            integrator,
            self.crop,
            self.sequences,
            self.light,
            self.plugins,
        )

    @property
    def sampler(self) -> str:
        """Mitsuba's name of the sampler."""
        return "independent" if self.sequences is None else self.sequences.sampler

    def asked(self) -> Asked:
        """Return what the scene asks for, as Mitsuba reads its description with the plugins.

        Raises
        ------
        InputError, SceneError, RenderError
            If there is no such sensor, or its film, the integrator or a plugin cannot be used.
        """
        from chdstat.scenes.loading import parse

        register(self.plugins, self.verdict.variant)
        parsed, instead = parse(self.scene), None
        if self.integrator is not None:
            given = self.integrator if isinstance(self.integrator, Mapping) else {"type": "path"}
            instead = parsed.sole(given)
        return asked_for(parsed, self.sensor, instead, self.sampler)


def scene_size(scene: SceneLike) -> tuple[int, int]:
    """Return the (width, height) in pixels that a scene's own film has.

    Examples
    --------
    >>> scene_size("cornell-box")
    (256, 256)
    """
    job = Job(load_scene(scene), resolve("scalar"))
    with activate(job.verdict):
        return job.asked().film.crop_size


def scene_integrator(scene: SceneLike) -> str:
    """Return Mitsuba's name of the integrator that a scene asks for.

    Examples
    --------
    >>> scene_integrator("fog")
    'volpath'
    """
    job = Job(load_scene(scene), resolve("scalar"))
    with activate(job.verdict):
        return job.asked().integrator.plugin(0)


def _described(integrator: IntegratorLike) -> dict[str, Any]:
    """Return an integrator as a dict of plain settings, which can be stored and sent."""
    if isinstance(integrator, str):
        integrator = {"type": integrator}
    if not isinstance(integrator, Mapping) or not isinstance(integrator.get("type"), str):
        kind = type(integrator).__qualname__
        message = (
            "integrator must be a name such as 'path', or a dict such as "
            f"{{'type': 'path', 'rr_depth': 100}}, got {_brief(integrator, kind)}; register a "
            "class of your own in a plugin (chdstat.scenes.load_plugin), and give its name"
        )
        raise InputError(message)
    for name, value in integrator.items():
        number = isinstance(value, numbers.Real) and math.isfinite(value)
        if not number and not isinstance(value, str):
            message = (
                f"settings of an integrator must be numbers, strings or booleans, which can be "
                f"stored beside the samples; got {name}={value!r}"
            )
            raise InputError(message)
    return dict(integrator)


def _brief(value: object, kind: str) -> str:
    return repr(value) if isinstance(value, Mapping) else f"a {kind}"


def _checked_crop(crop: Crop) -> Crop:
    numbers_of_pixels: Any = crop
    if isinstance(numbers_of_pixels, str) or len(numbers_of_pixels) != 4:
        message = f"crop must be (x, y, width, height) in pixels of the image, got {crop!r}"
        raise InputError(message)
    x, y = whole("x of the crop", crop[0], least=0), whole("y of the crop", crop[1], least=0)
    width = whole("width of the crop", crop[2], least=1)
    return x, y, width, whole("height of the crop", crop[3], least=1)
