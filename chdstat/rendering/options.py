"""Options of a render, checked before any work, and the job that renders a scene with them."""

from __future__ import annotations

import contextlib
import hashlib
import math
import numbers
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NoReturn, TypedDict, cast

import numpy as np

from chdstat._core.arrays import Seed, seed_number, whole
from chdstat.errors import InputError, RenderError
from chdstat.rendering.backend import BACKENDS, Backend, Color, TriedBackend, activate, resolve
from chdstat.rendering.seeds import SEEDS, SamplerName, Sequences
from chdstat.scenes import Scene, SceneLike, load_scene
from chdstat.scenes.plugins import Plugin, code_of, loaded, register
from chdstat.scenes.scene import LiveScene, is_built
from chdstat.scenes.settings import GUIDED, LONGEST, Asked, asked_for

if TYPE_CHECKING:
    from chdstat.rendering.guiding import Guide

IntegratorLike = str | Mapping[str, Any] | Any
"""An integrator by Mitsuba's name, as a dict with its settings, or as a Mitsuba object."""
Crop = tuple[int, int, int, int]
"""(x, y, width, height) in pixels of the image."""


class RenderSettings(TypedDict, total=False):
    """The fields of `RenderOptions` that a caller gives."""

    spp: int
    size: tuple[int, int] | None
    seed: Seed
    max_depth: int | None
    sensor: int
    integrator: IntegratorLike | None
    crop: Crop | None
    color: Color
    sampler: SamplerName
    sequence: int | None
    backend: Backend


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Everything that samples depend on, except the scene.

    Parameters
    ----------
    spp, size, seed, max_depth, sensor, integrator, crop, color, sampler, sequence, backend
        As for `chdstat.render`.

    Raises
    ------
    InputError
        If a value is out of range; it is raised before any work.

    Examples
    --------
    >>> RenderOptions(spp=16, integrator="direct").integrator
    {'type': 'direct'}
    """

    spp: int = 256
    size: tuple[int, int] | None = None
    seed: Seed = 0
    max_depth: int | None = None
    sensor: int = 0
    integrator: IntegratorLike | None = None
    crop: Crop | None = None
    color: Color = "rgb"
    sampler: SamplerName = "independent"
    sequence: int | None = None
    backend: Backend = "auto"

    def __post_init__(self) -> None:
        checked = {
            "spp": whole("spp", self.spp, least=1),
            "size": _checked_size(self.size),
            "max_depth": _checked_depth(self.max_depth),
            "seed": _checked_seed(self.seed),
            "sensor": whole("sensor", self.sensor, least=0),
            "integrator": _checked_integrator(self.integrator),
            "crop": _checked_crop(self.crop),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        _ = self.sequences

    @property
    def sequences(self) -> Sequences | None:
        """The sequences of dependent samples; None for independent ones."""
        return Sequences.of(self.sampler, self.sequence)


def refuse_render(source: object, settings: Mapping[str, Any]) -> None:
    """Refuse settings of a render, by name, if samples already exist.

    None and the backend "auto" count as not given.

    Raises
    ------
    InputError
        If a setting was given.
    """
    asked = [name for name, value in settings.items() if value not in (None, "auto")]
    if asked:
        message = (
            f"{', '.join(asked)}: a setting of a render, but {source} holds finished samples; "
            "leave it out, or give the scene"
        )
        raise InputError(message)


def _checked_size(size: Any) -> tuple[int, int] | None:
    if size is None:
        return None
    if not isinstance(size, Sequence) or len(size) != 2:
        message = f"size must be (width, height) in pixels, got {size!r}"
        raise InputError(message)
    width, height = whole("width", size[0], least=1), whole("height", size[1], least=1)
    if (longest := max(width, height)) > LONGEST:
        message = f"width and height must be at most {LONGEST} pixels, got {longest:.4g}"
        raise InputError(message)
    return width, height


def _checked_depth(max_depth: Any) -> int | None:
    if max_depth is None:
        return None
    depth = whole("max_depth", max_depth, least=-1)
    if depth == 0:
        message = "max_depth must be at least 1 segment, or -1 for no limit, got 0"
        raise InputError(message)
    return depth


def _checked_seed(seed: Seed) -> int:
    number = seed_number(seed, span=SEEDS)
    if number >= SEEDS:
        message = f"seed must be below 2^31, which all give different samples, got {number}"
        raise InputError(message)
    return number


def _checked_crop(crop: Any) -> Crop | None:
    if crop is None:
        return None
    if isinstance(crop, str) or len(crop) != 4:
        message = f"crop must be (x, y, width, height) in pixels of the image, got {crop!r}"
        raise InputError(message)
    x, y = whole("x of the crop", crop[0], least=0), whole("y of the crop", crop[1], least=0)
    width = whole("width of the crop", crop[2], least=1)
    return x, y, width, whole("height of the crop", crop[3], least=1)


def _checked_integrator(given: IntegratorLike | None) -> Any:
    """Return an integrator as a dict of plain settings, which can be stored, or as an object."""
    if given is None or isinstance(given, IntegratorObject) or is_built(given):
        return given
    settings = {"type": given} if isinstance(given, str) else given
    if not isinstance(settings, Mapping) or not isinstance(settings.get("type"), str):
        got = repr(given) if isinstance(given, Mapping) else f"a {type(given).__qualname__}"
        message = (
            "integrator must be a name such as 'path', or a dict such as "
            f"{{'type': 'path', 'rr_depth': 100}}, got {got}; register a "
            "class of your own in a plugin (chdstat.scenes.load_plugin), and give its name"
        )
        raise InputError(message)
    for name, value in settings.items():
        number = isinstance(value, numbers.Real) and math.isfinite(value)
        if not number and not isinstance(value, str):
            message = (
                f"settings of an integrator must be numbers, strings or booleans, which can be "
                f"stored beside the samples; got {name}={value!r}"
            )
            raise InputError(message)
    return dict(settings)


# --- jobs ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """A scene and everything else that samples depend on; without Mitsuba objects, it can be sent.

    Attributes
    ----------
    scene, options
        The scene, and how to render it.
    backend
        The backend that renders.
    light
        Name or pattern of the lights that are on; None for all.
    plugins
        Plugins that the scene may name.
    guide
        Guide of the directions; None without one, or if it is still to be trained.
    """

    scene: Scene
    options: RenderOptions
    backend: TriedBackend
    light: str | None = None
    plugins: tuple[Plugin, ...] = field(default_factory=loaded)
    guide: Guide | None = None

    @property
    def guided(self) -> str | None:
        """Which of `GUIDED` is asked for, if any: always guided, or if it pays."""
        given = self.options.integrator
        kind = given["type"] if isinstance(given, Mapping) else None
        return kind if kind in GUIDED else None

    @classmethod
    def of(cls, scene: SceneLike, options: RenderOptions) -> Job:
        """Return the job that renders a scene, on the backend in which Mitsuba built it, if it did.

        Raises
        ------
        InputError, SceneError, RenderError
            If the scene cannot be loaded, or the backend does not fit it or does not work here.
        """
        found, backend, integrator = load_scene(scene), options.backend, options.integrator
        if isinstance(found.source, LiveScene):
            live = found.source.value
            backend = _own_backend("scene is one", live, backend, options.color)
            integrator = live.integrator() if integrator is None else integrator
        if is_built(integrator):
            integrator = IntegratorObject(integrator)
            what = f"integrator is a {integrator.kind}"
            backend = _own_backend(what, integrator.value, backend, options.color)
            if options.max_depth is not None:
                message = (
                    f"max_depth={options.max_depth} cannot be given to a {integrator.kind} that is "
                    "there already; make the integrator with it, or give it as a dict"
                )
                raise InputError(message)
        options = replace(options, integrator=integrator, backend=backend)
        job = cls(found, options, resolve(backend, options.color))
        needs_waves = job.guided == "guided" and job.backend.name == "scalar"
        if needs_waves or (job.guided and isinstance(found.source, LiveScene)):
            message = (
                f"integrator {job.guided!r} renders files and dicts with the llvm and cuda "
                f"backends, got {backend=} and {found.name!r}; see: chdstat doctor"
            )
            raise RenderError(message)
        return job

    def asked(self) -> Asked:
        """Return what the scene asks for, as Mitsuba reads its description with the plugins.

        Raises
        ------
        InputError, SceneError, RenderError
            If there is no such sensor, or its film, the integrator or a plugin cannot be used.
        """
        from chdstat.scenes.parsing import parse

        register(self.plugins, self.backend.variant)
        parsed, instead = parse(self.scene), None
        given: Any = self.options.integrator
        if given is not None and not self.guided:
            instead = parsed.sole(given if isinstance(given, Mapping) else {"type": "path"})
        asked = asked_for(parsed, self.options.sensor, instead, self.options.sampler)
        if self.guided:  # the scene's own integrator, with what was given for it
            for name in given.keys() - {"type"}:
                asked.integrator.node(0).props[name] = given[name]
        return asked


def scene_size(scene: SceneLike) -> tuple[int, int]:
    """Return the (width, height) in pixels of a scene's own film.

    Examples
    --------
    >>> scene_size("cornell-box")
    (256, 256)
    """
    return _view_of(scene)[0]


def scene_integrator(scene: SceneLike) -> str:
    """Return Mitsuba's name of the integrator of a scene.

    Examples
    --------
    >>> scene_integrator("fog")
    'volpath'
    """
    return _view_of(scene)[1]


def _view_of(scene: SceneLike) -> tuple[tuple[int, int], str]:
    job = Job(load_scene(scene), RenderOptions(), resolve("scalar"))
    with activate(job.backend):
        asked = job.asked()
        return asked.film.crop_size, asked.integrator.plugin(0)


# --- integrators that are objects ---------------------------------------------------------------

_UNLIMITED = 2**32 - 1
"""Mitsuba's integrators print a max_depth of -1 as this number."""
_LONGEST = 16
"""Numbers of an array that are written out; longer arrays are written as a digest."""


@dataclass(frozen=True, eq=False)
class IntegratorObject:
    """An integrator object, made by Mitsuba or of the user's own class.

    It cannot be pickled to another process.

    Attributes
    ----------
    value
        The object.
    """

    value: Any

    @property
    def kind(self) -> str:
        """Name of its class."""
        return type(self.value).__qualname__ if self.in_python else str(self.value.class_name())

    @property
    def in_python(self) -> bool:
        """Whether its class is written in Python."""
        return not type(self.value).__module__.startswith("mitsuba")

    @property
    def code(self) -> dict[str, str]:
        """Digest of its code by the name of its class, if the class is written in Python."""
        return code_of([self.value]) if self.in_python else {}

    @property
    def description(self) -> dict[str, Any]:
        """Its class and settings, ready for JSON: those that it prints, traverses and holds."""
        import mitsuba as mi

        settings: dict[str, Any] = {"type": self.kind}
        if self.in_python:
            settings |= vars(self.value)
        else:
            printed = re.findall(r"^\s*(\w+) = (.*?),?$", str(self.value), re.MULTILINE)
            settings |= {name: _number(text) for name, text in printed}
        with contextlib.suppress(RuntimeError, TypeError):  # a class that does not say
            settings |= dict(mi.traverse(self.value))
        return told(settings)

    def __reduce__(self) -> NoReturn:
        message = (
            "an integrator that is an object can only render in this process; for other ones, give "
            "it as a dict, and register a class of your own in a plugin "
            "(chdstat.scenes.load_plugin)"
        )
        raise InputError(message)


def _own_backend(what: str, value: Any, backend: str, color: str) -> Backend:
    """Return the backend of the variant in which a Mitsuba object was made.

    Raises
    ------
    InputError
        If another backend or another colour is asked for.
    """
    own = str(value.variant_name())
    wanted = TriedBackend(
        own.partition("_")[0] if backend == "auto" else backend, True, "", color=color
    )
    if wanted.name not in BACKENDS or own != wanted.variant:
        message = (
            f"{what} of the variant {own}, which cannot render with the {wanted.name} backend "
            f"in {color}; make it in the variant of these (see mitsuba.set_variant), give backend "
            "and color of its own, or give it as a dict"
        )
        raise InputError(message)
    return cast("Backend", wanted.name)


def _number(text: str) -> str | int | float:
    if text.isdecimal():
        return -1 if int(text) == _UNLIMITED else int(text)
    with contextlib.suppress(ValueError):
        return float(text)
    return text


def told(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings ready for JSON: texts, numbers and arrays; parts with others are left out."""
    found = {name: _told(value) for name, value in settings.items()}
    return {name: value for name, value in found.items() if value is not None}


def _told(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, str | int | float):
        return value
    with contextlib.suppress(TypeError, ValueError, RuntimeError):
        array = np.asarray(value.matrix if "Transform" in type(value).__name__ else value)
        if array.dtype.kind in "biuf":
            if array.size <= _LONGEST and np.isfinite(array).all():
                return array.tolist()
            return "SHA-256 " + hashlib.sha256(array.tobytes()).hexdigest()[:16]
    return None
