"""Jobs: a scene and everything else that its samples depend on, checked before any work."""

from __future__ import annotations

import contextlib
import inspect
import math
import numbers
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, TypedDict, TypeVar, Unpack, cast, get_type_hints

from chdstat._core.arrays import Seed, seed_number, whole
from chdstat.errors import InputError, RenderError, did_you_mean
from chdstat.recording.renderers import source_of
from chdstat.rendering.backend import BACKENDS, Backend, Color, TriedBackend, activate, resolve
from chdstat.rendering.seeds import SEEDS, SamplerName, Sequences
from chdstat.scenes import Scene, SceneLike, load_scene
from chdstat.scenes.plugins import Plugin, loaded, register
from chdstat.scenes.scene import MITSUBA, LiveScene
from chdstat.scenes.settings import GUIDED, LONGEST, Asked, asked_for

if TYPE_CHECKING:
    from chdstat.rendering.guiding import Guide

_IntegratorLike = str | Mapping[str, Any]
"""An integrator by Mitsuba's name, or as a dict with its settings."""
_Crop = tuple[int, int, int, int]
"""(x, y, width, height) in pixels of the image."""
Function = TypeVar("Function", bound=Callable[..., Any])


def _checked_size(size: Any) -> tuple[int, int]:
    if not isinstance(size, Sequence) or len(size) != 2:
        message = f"size must be (width, height) in pixels, got {size!r}"
        raise InputError(message)
    width, height = whole("width", size[0], least=1), whole("height", size[1], least=1)
    if (longest := max(width, height)) > LONGEST:
        message = f"width and height must be at most {LONGEST} pixels, got {longest:.4g}"
        raise InputError(message)
    return width, height


def _checked_depth(max_depth: Any) -> int:
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


def _checked_crop(crop: Any) -> _Crop:
    if isinstance(crop, str) or len(crop) != 4:
        message = f"crop must be (x, y, width, height) in pixels of the image, got {crop!r}"
        raise InputError(message)
    x, y = whole("x of the crop", crop[0], least=0), whole("y of the crop", crop[1], least=0)
    width = whole("width of the crop", crop[2], least=1)
    return x, y, width, whole("height of the crop", crop[3], least=1)


def _checked_integrator(given: Any) -> dict[str, Any]:
    """Return an integrator as a dict of plain settings, which can be stored."""
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


@dataclass(frozen=True)
class _Setting:
    """The default of a setting, which needs no check, and what checks other values.

    `typed` is the type of its value on the command line, if the annotation does not tell.
    `of_integrator` says that it is a setting of the integrator, which then holds its value.
    """

    default: Any = None
    check: Callable[[Any], Any] = lambda value: value
    typed: type | None = None
    of_integrator: bool = False


class RenderSettings(TypedDict, total=False):
    """Settings of a render: everything that samples depend on, except the scene.

    They are declared here only: the signature of `chdstat.render` and the options of the command
    line are made from this class, and from this text.

    Parameters
    ----------
    spp : int, default 256 of a scene, all of a store
        Number of samples per pixel; from a store, the first ones.
    size : WxH, default the scene's own
        Image size in pixels.
    seed : int, default 0
        Random seed, a non-negative integer.
    max_depth : int, default the scene's own
        Maximum path length in segments.
    sensor : int, default 0
        Number of the scene's sensor, from 0.
    integrator : NAME|JSON, default the scene's own
        Integrator in place of the scene's: its name, or JSON with its settings, such as
        {"type": "path", "rr_depth": 100}.
    crop : X,Y,WxH, default all of it
        Part of the image to render, in pixels.
    color : str, default rgb
        How light is transported; samples are linear sRGB.
    sampler : NAME, default independent
        Mitsuba's sampler: independent, stratified, multijitter, orthogonal, ldsampler. With any but
        independent, samples of a sequence depend on each other: only averages of sequences have
        standard errors.
    sequence : N, default 16
        Samples that such a sampler spreads together; --spp is a multiple of it.
    backend : NAME, default auto
        auto, scalar, llvm or cuda.
    """

    spp: Annotated[int, _Setting(256, partial(whole, "spp", least=1))]
    size: Annotated[tuple[int, int] | None, _Setting(check=_checked_size)]
    seed: Annotated[Seed, _Setting(0, _checked_seed)]
    max_depth: Annotated[int | None, _Setting(check=_checked_depth, of_integrator=True)]
    sensor: Annotated[int, _Setting(0, partial(whole, "sensor", least=0))]
    integrator: Annotated[_IntegratorLike | None, _Setting(check=_checked_integrator)]
    crop: Annotated[_Crop | None, _Setting(check=_checked_crop)]
    color: Annotated[Color, _Setting("rgb")]
    sampler: Annotated[SamplerName, _Setting("independent")]
    sequence: Annotated[int | None, _Setting()]
    backend: Annotated[Backend, _Setting("auto", typed=str)]


_DECLARED: dict[str, _Setting] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(RenderSettings, include_extras=True).items()
}
SETTINGS = {
    name: inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=_DECLARED[name].default, annotation=kind
    )
    for name, kind in get_type_hints(RenderSettings).items()
}
"""Parameters of functions that take `RenderSettings`, by name, with defaults and types."""
TYPED = {name: setting.typed or SETTINGS[name].annotation for name, setting in _DECLARED.items()}
"""Types of the settings on the command line, where they may be texts of that."""
# Settings that the integrator of a render holds, by the same names.
OF_INTEGRATOR = {name for name, setting in _DECLARED.items() if setting.of_integrator}


def with_settings(function: Function) -> Function:
    """Show the settings of a render in the signature of a function that takes them by keyword.

    Editors know them from `RenderSettings`; this is for `help`, notebooks and the documentation.
    """
    own = inspect.signature(function)
    first, *others, _ = own.parameters.values()
    parameters = [first, *SETTINGS.values(), *others]
    function.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    return function


def checked_settings(given: RenderSettings) -> RenderSettings:
    """Return all settings of a render: those that were given, checked, and defaults.

    Raises
    ------
    InputError
        If a value is out of range.
    TypeError
        If a render has no such setting.

    Examples
    --------
    >>> checked_settings({"spp": 16, "integrator": "direct"})["integrator"]
    {'type': 'direct'}
    """
    for name in given:
        if name not in SETTINGS:
            message = f"render() got an unexpected keyword argument {name!r}"
            raise TypeError(message + did_you_mean(name, SETTINGS))
    values: dict[str, Any] = {name: setting.default for name, setting in _DECLARED.items()}
    values |= {
        name: value if value is (setting := _DECLARED[name]).default else setting.check(value)
        for name, value in given.items()
    }
    Sequences.of(values["sampler"], values["sequence"])
    return cast("RenderSettings", values)


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


@dataclass(frozen=True)
class Job:
    """A scene and everything else that samples depend on; without Mitsuba objects, it can be sent.

    Attributes
    ----------
    scene, options
        The scene, and how to render it: all of `RenderSettings`.
    backend
        The backend that renders.
    light
        Name or pattern of the lights that are on; None for all.
    plugins
        Plugins that the scene may name.
    guide
        Guide of the directions; None without one, or if it is still to be trained.
    film
        Whether to draw where in its pixel each sample falls, instead of its light.
    cost
        Whether to time samples.
    """

    scene: Scene
    options: RenderSettings
    backend: TriedBackend
    light: str | None = None
    plugins: tuple[Plugin, ...] = field(default_factory=loaded)
    guide: Guide | None = None
    film: bool = False
    cost: bool = False

    @classmethod
    def of(cls, scene: SceneLike, **options: Unpack[RenderSettings]) -> Job:
        """Return the job that renders a scene, on the backend in which Mitsuba built it, if it did.

        Raises
        ------
        InputError, SceneError, RenderError
            If an option is out of range, the scene cannot be loaded, or the backend does not fit it
            or does not work here.
        """
        found, settings = load_scene(scene), checked_settings(options)
        if found.renderer != MITSUBA:
            message = (
                f"expected a scene of Mitsuba, got {found.name}, which {found.renderer} renders: "
                f"first keep its samples with: chdstat render {found.source} -o {found.name}.zarr"
            )
            raise InputError(message)
        if isinstance(found.source, LiveScene):
            settings["backend"] = _own_backend(found.source.value, settings)
        job = cls(found, settings, resolve(settings["backend"], settings["color"]))
        if (built := job.built_integrator) is not None and job.for_integrator:
            message = (
                f"{', '.join(f'{n}={v}' for n, v in job.for_integrator.items())} cannot be given "
                f"to a {built_kind(built)} that is there already; build the scene with it, or give "
                "an integrator as a dict"
            )
            raise InputError(message)
        needs_waves = job.guided == "guided" and job.backend.name == "scalar"
        if needs_waves or (job.guided and isinstance(found.source, LiveScene)):
            message = (
                f"integrator {job.guided!r} renders files and dicts with the llvm and cuda "
                f"backends, got backend={settings['backend']!r} and {found.name!r}; see: "
                "chdstat doctor"
            )
            raise RenderError(message)
        return job

    @property
    def sequences(self) -> Sequences | None:
        """The sequences of dependent samples; None for independent ones."""
        return Sequences.of(self.options["sampler"], self.options["sequence"])

    @property
    def guided(self) -> str | None:
        """Which of `GUIDED` is asked for, if any: always guided, or if it pays."""
        given: Any = self.options["integrator"] or {"type": None}
        return given["type"] if given["type"] in GUIDED else None

    @property
    def for_integrator(self) -> dict[str, Any]:
        """Settings of the render that the integrator holds, where they are given, by name."""
        return {n: v for n, v in self.options.items() if n in OF_INTEGRATOR and v is not None}

    @property
    def built_integrator(self) -> Any:
        """The integrator of a scene that Mitsuba has built, unless another one is asked for."""
        live, given = self.scene.source, self.options["integrator"]
        return live.value.integrator() if isinstance(live, LiveScene) and given is None else None

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
        given: Any = self.options["integrator"]
        if given is not None and not self.guided:
            instead = parsed.sole(given)
        asked = asked_for(parsed, self.options["sensor"], instead, self.options["sampler"])
        # If guided, it is the scene's own integrator, with what was given for it.
        changes = {**(given if self.guided else {}), **self.for_integrator}
        for name in changes.keys() - {"type"}:
            asked.integrator.node(0).props[name] = changes[name]
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
    loaded = load_scene(scene)
    if loaded.renderer != MITSUBA:
        with contextlib.closing(source_of(loaded)) as source:
            width, height = source.attrs["size"]
            return (width, height), source.attrs["integrator"]["type"]
    job = Job(loaded, checked_settings({}), resolve("scalar"))
    with activate(job.backend):
        asked = job.asked()
        return asked.film.crop_size, asked.integrator.plugin(0)


def _own_backend(scene: Any, settings: RenderSettings) -> Backend:
    """Return the backend of the variant in which a Mitsuba scene was made.

    Raises
    ------
    InputError
        If another backend or another colour is asked for.
    """
    own, backend, color = str(scene.variant_name()), settings["backend"], settings["color"]
    wanted = TriedBackend(
        own.partition("_")[0] if backend == "auto" else backend, True, "", color=color
    )
    if wanted.name not in BACKENDS or own != wanted.variant:
        message = (
            f"scene is one of the variant {own}, which cannot render with the {wanted.name} "
            f"backend in {color}; make it in the variant of these (see mitsuba.set_variant), give "
            "backend and color of its own, or give it as a dict"
        )
        raise InputError(message)
    return cast("Backend", wanted.name)


def built_kind(value: Any) -> str:
    """Return the name of the class of a Mitsuba object."""
    return type(value).__qualname__ if in_python(value) else str(value.class_name())


def in_python(value: Any) -> bool:
    """Return whether the class of a Mitsuba object is written in Python."""
    return not type(value).__module__.startswith("mitsuba")
