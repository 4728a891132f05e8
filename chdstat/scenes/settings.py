"""Settings of a scene: what it asks for, and what is changed so that its samples can be kept.

Sampler and filter are replaced, so that samples are independent and unmixed. The film is replaced,
so that it gives linear sRGB at the rendered size. Notes name each setting that is replaced or left
out. A setting is refused if samples would mean something else without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chdstat.errors import InputError, RenderError, SceneError

if TYPE_CHECKING:
    from chdstat.scenes.parsing import ParsedScene

_INTEGRATOR = "path"
"""Integrator of a scene that names none."""
GUIDED = ("guided", "auto")
"""Names for the scene's own integrator, guided by earlier paths: always, or if that pays."""
LONGEST = 2**20
"""Most pixels of a film in width and in height."""
_WRAPPERS = ("aov", "moment")
"""Integrators that record more about the samples of the integrator within."""
_CROPPING = ("perspective", "thinlens", "orthographic")
"""Sensors that show the part of the image to which their film is cropped. Others map their
measurement to any crop."""
_SIZES = ("width", "height", "crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
_UNUSED = ("samples_per_pass", "timeout")
"""Settings of integrators that do not apply to samples drawn chunk by chunk."""
_SAME_SAMPLES = ("block_size",)
"""Settings of integrators that samples do not depend on."""
_REPLACED = {"Film": ("hdrfilm", _SIZES), "Sampler": ("independent", ())}
"""Plugin that replaces those of a kind, and the settings that stay."""
_INSTEAD = "samples are linear sRGB"
_SAME_FILM = ("file_format", "component_format", "sample_border", "compensate", "banner")
"""Settings of films that samples do not depend on."""


@dataclass(frozen=True)
class Film:
    """A film and the part of it to render, in pixels.

    Parameters
    ----------
    size
        (width, height) of the whole film.
    corner
        (x, y) of the image's first pixel on the film.
    crop_size
        (width, height) of the image.
    """

    size: tuple[int, int]
    corner: tuple[int, int]
    crop_size: tuple[int, int]

    @property
    def crop(self) -> list[int] | None:
        """Place of the image on the film: x, y, width and height of the film; None for all."""
        return None if self.size == self.crop_size else [*self.corner, *self.size]

    def cropped(self, crop: tuple[int, int, int, int]) -> Film:
        """Return the film of a part (x, y, width, height) of the image.

        Raises
        ------
        InputError
            If the part lies outside.
        """
        x, y, *extent = crop
        width, height = self.crop_size
        if x + extent[0] > width or y + extent[1] > height:
            message = (
                f"a crop of {extent[0]} x {extent[1]} pixels at ({x}, {y}) must lie within the "
                f"image of {width} x {height} pixels"
            )
            raise InputError(message)
        return Film(self.size, (self.corner[0] + x, self.corner[1] + y), (extent[0], extent[1]))

    def resized(self, size: tuple[int, int] | None) -> tuple[Film, list[str]]:
        """Return the film for an image of some size, and a note if that moves the crop."""
        if size is None or size == self.crop_size:
            return self, []
        scale = [new / old for new, old in zip(size, self.crop_size, strict=True)]
        exact = [s * v for s, v in zip((*scale, *scale), (*self.corner, *self.size), strict=True)]
        x, y, width, height = map(round, exact)
        film = Film((max(width, x + size[0]), max(height, y + size[1])), (x, y), size)
        if film.crop is None or [*film.corner, *film.size] == exact:
            return film, []
        note = (
            f"the film's crop, enlarged to {size[0]} x {size[1]} pixels, is moved to whole pixels "
            f"of a film of {film.size[0]} x {film.size[1]}"
        )
        return film, [note]


@dataclass(frozen=True)
class Asked:
    """What a scene asks for, and the parts of it that are made on demand.

    Parameters
    ----------
    scene
        The scene without its integrator.
    sensor
        The sensor with its children, without film, sampler and medium.
    number
        Its place among the scene's sensors.
    integrator
        The integrator that draws the samples; for a wrapper, the one within.
    film
        The film of the sensor.
    plugins
        Names of all plugins of the scene.
    notes
        Requests of the scene that are not met.
    """

    scene: ParsedScene
    sensor: ParsedScene
    number: int
    integrator: ParsedScene
    film: Film
    plugins: set[str]
    notes: list[str]

    @property
    def crops(self) -> bool:
        """Whether the sensor shows the part of the image to which its film is cropped."""
        return self.sensor.plugin(0) in _CROPPING


def asked_for(
    parsed: ParsedScene,
    sensor: int,
    instead: ParsedScene | None = None,
    sampler: str = "independent",
) -> Asked:
    """Return what a scene asks for, for the sensor of a number.

    The integrator `instead` replaces the scene's own; `sampler` is the one that is used.

    Raises
    ------
    InputError, SceneError, RenderError
        If there is no such sensor, or its film or the integrator cannot be used.
    """
    sensors = _sensors(parsed)
    if not sensors:
        parsed.make()  # where a plugin is misspelt, Mitsuba says which
        message = f"scene {parsed.name!r} has no sensor; add a <sensor> to it"
        raise SceneError(message)
    if sensor >= len(sensors):
        message = f"sensor must be below {len(sensors)}, those of {parsed.name!r}, got {sensor}"
        raise InputError(message)
    chosen, notes = sensors[sensor], []
    if len(sensors) > 1:
        name = parsed.node(chosen).props.id()
        number = f"sensor {sensor}" + (f" ({name!r})" if name else "")
        notes.append(f"the scene has {len(sensors)} sensors; {number} is used")
    films = parsed.held(chosen, "Film")
    filters = [f for film in films for f in parsed.held(film, "ReconstructionFilter")]
    notes += _of_film(parsed, films)
    notes += _replaced(parsed, "filter", filters, "box")
    if sampler == "independent":  # another one was chosen by name
        notes += _replaced(parsed, "sampler", parsed.held(chosen, "Sampler"), sampler)
    own = _integrators(parsed)
    integrator, more = _sampled(parsed, own) if instead is None else _sampled(instead, [0])
    plugins = {parsed.plugin(i) for i in range(len(parsed.nodes))} - {"", "scene"}
    part = parsed.branch(chosen)
    part.drop(i for kind in ("Film", "Sampler", "Medium") for i in part.held(0, kind))
    film = _film(parsed.name, parsed.node(films[0]).props if films else {})
    parsed.drop(own)
    _plain(parsed)
    return Asked(
        scene=parsed,
        sensor=part,
        number=sensor,
        integrator=integrator,
        film=film,
        plugins=plugins | {integrator.plugin(0)},
        notes=notes + more,
    )


def _sensors(parsed: ParsedScene) -> list[int]:
    """Return the sensors of a scene in Mitsuba's order, including those of shapes."""
    found = []
    for index in parsed.held(0):
        kind = parsed.node(index).type.name
        if kind == "Sensor" and parsed.plugin(index) == "irradiancemeter":
            message = (
                "sensor 'irradiancemeter' measures what falls on a shape; put it into one, or use "
                "one that sees an image, such as perspective"
            )
            raise RenderError(message)
        if kind == "Sensor":
            found.append(index)
        elif kind == "Shape":
            found += parsed.held(index, "Sensor")
    return found


def _integrators(parsed: ParsedScene) -> list[int]:
    """Return the integrators of a scene, including those that Mitsuba only has in other variants.

    If a class was first registered in another variant than a scalar one, Mitsuba does not know its
    kind before it makes an object.
    """
    import mitsuba as mi

    found = []
    for index in parsed.held(0):
        kind = parsed.node(index).type.name
        if kind == "Unknown" and not _in_python(parsed.plugin(index)):
            is_integrator = isinstance(parsed.branch(index).make(), mi.Integrator)
        else:
            is_integrator = kind == "Integrator" or _in_python(parsed.plugin(index))
        if is_integrator:
            found.append(index)
    return found


def _in_python(plugin: str) -> bool:
    """Return whether an integrator is one of Mitsuba's in Python, which no scalar variant has."""
    import mitsuba as mi

    return (Path(mi.__file__).parent / f"python/ad/integrators/{plugin}.py").is_file()


def check_variant(integrator: ParsedScene) -> None:
    """Refuse an integrator that the current variant does not have.

    Raises
    ------
    RenderError
        If it is one of Mitsuba's in Python, and the variant scalar.
    """
    import mitsuba as mi

    name = integrator.plugin(0)
    if str(mi.variant()).startswith("scalar") and _in_python(name):
        message = (
            f"integrator {name!r} is there with Mitsuba's llvm and cuda backends only; use one of "
            "these, or another integrator such as path"
        )
        raise RenderError(message)


def _sampled(parsed: ParsedScene, found: list[int]) -> tuple[ParsedScene, list[str]]:
    """Return which of the found integrators draws the samples, and notes on it.

    Raises
    ------
    SceneError
        If there are several.
    RenderError
        If there is none, or it wraps integrators whose samples cannot be kept.
    """
    if not found:
        return parsed.sole({"type": _INTEGRATOR}), []
    if len(found) > 1:
        names = ", ".join(parsed.plugin(i) for i in found)
        message = f"scene {parsed.name!r} must have one integrator, got {len(found)}: {names}"
        raise SceneError(message)
    index, notes = found[0], []
    while (name := parsed.plugin(index)) in _WRAPPERS:
        within = parsed.held(index, "Integrator")
        if len(within) != 1:
            message = (
                f"integrator {name!r} must hold one integrator whose samples are to be kept, "
                f"such as path or volpath, got {len(within)}"
            )
            raise RenderError(message)
        (index,) = within
        notes.append(
            f"the scene asks for the {name} integrator; the {parsed.plugin(index)} integrator "
            "within it is used, whose samples are kept"
        )
    kind = parsed.node(index).type.name
    if kind not in ("Integrator", "Unknown"):
        message = (
            f"{name!r} is no integrator; give one that samples pixel by pixel, such as path, "
            "volpath or direct"
        )
        raise RenderError(message)
    if parsed.held(index, "Integrator"):
        message = (
            f"integrator {name!r} wraps another integrator; name the inner one (such as path or "
            "volpath) in the scene"
        )
        raise RenderError(message)
    properties = parsed.node(index).props
    unused = [key for key in _UNUSED if key in properties]
    if unused:
        notes.append(f"{', '.join(unused)} of the {name} integrator: not used")
    for key in (*unused, *_SAME_SAMPLES):
        if key in properties:
            del properties[key]
    return parsed.branch(index), notes


def _of_film(parsed: ParsedScene, films: list[int]) -> list[str]:
    """Return notes on a film's requests that samples meet in another form."""
    if not films:
        return []
    properties, name = parsed.node(films[0]).props, parsed.plugin(films[0])
    same, held = (*_SIZES, *_SAME_FILM, "pixel_format"), dict(parsed.references(films[0]))
    filters = parsed.held(films[0], "ReconstructionFilter")
    keys = [key for key in properties.keys() if key not in same]  # noqa: SIM118
    others = ", ".join(key for key in keys if held.get(key) not in filters)
    if name == "hdrfilm":
        form = str(properties.get("pixel_format", "rgb")).lower()
        notes = [] if form in ("rgb", "rgba") else [f"the film's pixel_format {form}: {_INSTEAD}"]
        return notes + ([f"the film's {others}: not used"] if others else [])
    settings = f" and its {others}" if others else ""
    return [f"the scene asks for the {name} film{settings}: {_INSTEAD}"]


def _plain(parsed: ParsedScene) -> None:
    """Replace films and samplers, which are made anew for each tile, by ones without settings.

    Their plugins and settings may be unknown, or, as those of spectral films, need wavelengths.
    """
    for index in range(len(parsed.nodes)):
        kind, properties = parsed.node(index).type.name, parsed.node(index).props
        if kind in _REPLACED:
            plugin, kept = _REPLACED[kind]
            for key in set(properties.keys()) - set(kept):
                del properties[key]
            properties.set_plugin_name(plugin)


def _replaced(parsed: ParsedScene, word: str, found: list[int], used: str) -> list[str]:
    asked = {parsed.plugin(index) for index in found} - {used}
    if not asked:
        return []
    return [
        f"the scene asks for the {', '.join(sorted(asked))} {word}; "
        f"the {used} {word} is used, so that samples are independent and unmixed"
    ]


def _film(name: str, properties: Any) -> Film:
    """Return the film of some properties, with Mitsuba's own defaults."""
    width = _whole(name, properties, "width", 768, least=1)
    height = _whole(name, properties, "height", 576, least=1)
    left = _whole(name, properties, "crop_offset_x", 0, least=0)
    top = _whole(name, properties, "crop_offset_y", 0, least=0)
    across = _whole(name, properties, "crop_width", width, least=1)
    down = _whole(name, properties, "crop_height", height, least=1)
    if left + across > width or top + down > height:
        message = (
            f"the film's crop of {across} x {down} pixels at ({left}, {top}) must lie within its "
            f"{width} x {height} pixels; change it in scene {name!r}"
        )
        raise SceneError(message)
    return Film((width, height), (left, top), (across, down))


def _whole(scene: str, properties: Any, key: str, default: int, *, least: int) -> int:
    value = properties.get(key, default)
    if type(value) is not int or not least <= value <= LONGEST:
        message = (
            f"{key} of the film of scene {scene!r} must be a whole number of pixels from {least} "
            f"to {LONGEST}, got {value!r}"
        )
        raise SceneError(message)
    return value
