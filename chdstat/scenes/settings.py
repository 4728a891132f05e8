"""Settings that a scene asks for: its sensor, film and integrator, from Mitsuba's parser state.

The renderer replaces some of them (sampler and filter, so that samples are independent and
unmixed), and says so in notes; nothing that the scene asks for is left out in silence.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chdstat.errors import InputError, RenderError, SceneError

__all__ = ["LONGEST", "Asked", "asked_for"]

_INTEGRATOR = "path"
"""What renders a scene that names no integrator."""
LONGEST = 2**20
"""Most pixels of a film in width and in height."""
_WRAPPERS = ("aov", "moment")
"""Integrators that record more about the samples of the one within."""


@dataclass(frozen=True)
class Film:
    """A film and the part of it that is rendered, in pixels.

    Parameters
    ----------
    size
        (width, height) of the whole film.
    corner
        (x, y) of the first pixel of the image on it.
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
        """Return the film at which the image has a size, and a note if the crop moves for it."""
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
    """What a scene asks for.

    Parameters
    ----------
    state
        Mitsuba's parser state of the scene.
    sensor, integrator
        Mitsuba's properties of the sensor and of the integrator; of a wrapper, of that within.
    film
        The film of the sensor.
    plugins
        Names of all plugins of the scene.
    notes
        What is not as the scene asks for it.
    """

    state: Any
    sensor: Any
    integrator: Any
    film: Film
    plugins: set[str]
    notes: list[str]


def asked_for(
    name: str, state: Any, sensor: int, instead: Any = None, sampler: str = "independent"
) -> Asked:
    """Return what a scene asks for, of the sensor of a number.

    The parser state `instead` is of a scene whose integrator takes the place of its own; `sampler`
    is the one that is used.

    Raises
    ------
    InputError, SceneError, RenderError
        If there is no such sensor, or its film or the integrator cannot be used.
    """
    nodes = _Nodes(state)
    sensors = nodes.of("Sensor")
    if not sensors:
        message = f"scene {name!r} has no sensor; add a <sensor> to it"
        raise SceneError(message)
    if sensor >= len(sensors):
        message = f"sensor must be below {len(sensors)}, the sensors of {name!r}, got {sensor}"
        raise InputError(message)
    chosen = sensors[sensor]
    if chosen.props.plugin_name() == "irradiancemeter":
        message = (
            "sensor 'irradiancemeter' measures what falls on a shape, and sees no image; use one "
            "that does, such as perspective"
        )
        raise RenderError(message)
    notes = []
    if len(sensors) > 1:
        number = f"sensor {sensor}" + (f" ({chosen.props.id()!r})" if chosen.props.id() else "")
        notes.append(f"the scene has {len(sensors)} sensors; {number} is used")
    films = nodes.within(chosen, "Film")
    filters = [f for film in films for f in nodes.within(film, "ReconstructionFilter")]
    notes += _replaced("filter", filters, "box")
    if sampler == "independent":  # another one was chosen by name
        notes += _replaced("sampler", nodes.within(chosen, "Sampler"), sampler)
    if instead is None:
        integrator, more = nodes.integrator()
    else:
        nodes.forget_integrators()
        integrator, more = _Nodes(instead).integrator(alone=True)
    return Asked(
        state=state,
        sensor=chosen.props,
        integrator=integrator,
        film=_film(name, films[0].props if films else {}),
        plugins={str(node.props.plugin_name()) for node in state.nodes} - {"", "scene"}
        | {str(integrator.plugin_name())},
        notes=notes + more,
    )


class _Nodes:
    """The nodes of a parser state, by kind and by what holds them."""

    def __init__(self, state: Any) -> None:
        import mitsuba as mi

        self._mi, self._nodes = mi, list(state.nodes)

    def of(self, kind: str) -> list[Any]:
        """Return the nodes of a kind, in the order of the scene."""
        return [n for n in self._nodes if n.type == getattr(self._mi.ObjectType, kind)]

    def within(self, node: Any, kind: str) -> list[Any]:
        """Return the nodes of a kind that a node holds."""
        wanted = getattr(self._mi.ObjectType, kind)
        held = (self._nodes[index] for index in self._held(node))
        return [n for n in held if n.type == wanted]

    def integrator(self, *, alone: bool = False) -> tuple[Any, list[str]]:
        """Return the properties of the integrator that draws the samples, and notes on it.

        One that is `alone` is all of a scene, and must be one.
        """
        others = self.of("Unknown") if alone else self._of_other_variants()
        found = [*self.of("Integrator"), *others]
        if alone and not found:
            names = [str(n.props.plugin_name()) for n in self._nodes]
            message = (
                f"{names[1]!r} is no integrator; give one that samples pixel by pixel, such as "
                "path, volpath or direct"
            )
            raise RenderError(message)
        inner = {id(i) for node in found for i in self.within(node, "Integrator")}
        outer = [node for node in found if id(node) not in inner]
        if not outer:
            return self._mi.Properties(_INTEGRATOR), []
        node, notes = outer[0], []
        while node.props.plugin_name() in _WRAPPERS:
            name, within = node.props.plugin_name(), self.within(node, "Integrator")
            if len(within) != 1:
                message = (
                    f"integrator {name!r} must hold one integrator whose samples are to be kept, "
                    f"such as path or volpath, got {len(within)}"
                )
                raise RenderError(message)
            (node,) = within
            notes.append(
                f"the scene asks for the {name} integrator; the {node.props.plugin_name()} "
                "integrator within it is used, whose samples are kept"
            )
        if any(True for _ in self._held(node)):
            message = (
                f"integrator {node.props.plugin_name()!r} wraps another integrator or object; "
                "name the inner one (such as path or volpath) in the scene"
            )
            raise RenderError(message)
        return node.props, notes

    def forget_integrators(self) -> None:
        """Make those integrators usable that this variant does not know, when none is used."""
        for node in self._of_other_variants():
            node.props.set_plugin_name(_INTEGRATOR)

    def _of_other_variants(self) -> list[Any]:
        """Return integrators of Mitsuba's in Python that this variant does not know."""
        folder = Path(self._mi.__file__).parent / "python" / "ad" / "integrators"
        names = {path.stem for path in folder.glob("*.py")}
        return [n for n in self.of("Unknown") if n.props.plugin_name() in names]

    def _held(self, node: Any) -> Iterator[int]:
        kinds, props = self._mi.Properties.Type, node.props
        for key in props.keys():  # noqa: SIM118 - Mitsuba's properties are no mapping
            if props.type(key) == kinds.ResolvedReference:
                yield props[key].index()


def _replaced(word: str, found: list[Any], used: str) -> list[str]:
    asked = {n.props.plugin_name() for n in found} - {used}
    if not asked:
        return []
    return [
        f"the scene asks for the {', '.join(sorted(asked))} {word}; "
        f"the {used} {word} is used, so that samples are independent and unmixed"
    ]


def _film(name: str, properties: Any) -> Film:
    """Return the film of its properties, with Mitsuba's own defaults."""
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
