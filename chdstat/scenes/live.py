"""Scenes that Mitsuba has built already, for renders in this process."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NoReturn

import numpy as np

from chdstat.errors import InputError, SceneError
from chdstat.scenes.files import code_of

__all__ = ["LiveScene", "is_built"]

_SENSORS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic",
}
"""Plugins by the name of their class."""
_SETTINGS = (
    "near_clip",
    "far_clip",
    "shutter_open",
    "aperture_radius",
    "focus_distance",
    "principal_point_offset_x",
    "principal_point_offset_y",
)
_ADDRESS = re.compile(r"\b(?:object_|0x)[0-9a-f]+\b")
"""What Mitsuba calls objects without a name: by where they are in memory."""
_ELSEWHERE = (
    "a scene that Mitsuba has built can only be rendered in this process; for other ones, give the "
    "file or dict that it was made of"
)


def is_built(value: object) -> bool:
    """Return whether a value is an object of Mitsuba's."""
    mi: Any = sys.modules.get("mitsuba")
    return mi is not None and mi.variant() is not None and isinstance(value, mi.Object)


@dataclass(frozen=True, eq=False)
class LiveScene:
    """A scene that was built by Mitsuba, as it is now; it is pickled to no other process.

    Attributes
    ----------
    value
        The object.
    """

    value: Any

    @staticmethod
    def fits(value: object) -> bool:
        """Return whether a value is a scene of Mitsuba's, of any variant."""
        scene: Any = value
        return is_built(value) and bool(scene.class_name() == "Scene")

    def parts(self) -> list[Any]:
        """Return what each object prints and its parameters, which tell a scene from another one.

        Mitsuba builds objects in parallel, so that their order is another each time.
        """
        import mitsuba as mi

        found = []
        for part in (*self._objects(), *self.value.sensors(), self.value.integrator()):
            if part is not None:
                held = [(_ADDRESS.sub("object", name), value) for name, value in mi.traverse(part)]
                found.append([_ADDRESS.sub("object", str(part)), sorted(held, key=itemgetter(0))])
        return found

    @property
    def code(self) -> dict[str, str]:
        """Digests of the classes of its objects that are written in Python, by name."""
        unique = {id(part): part for part in self._objects() if part is not None}.values()
        return code_of([p for p in unique if not type(p).__module__.startswith("mitsuba")])

    def _objects(self) -> list[Any]:
        shapes = self.value.shapes()
        return [*shapes, *(shape.bsdf() for shape in shapes), *self.value.emitters()]

    def description(self) -> dict[str, Any]:
        """Return a scene dict of its sensors and films, which are built anew for each tile.

        Raises
        ------
        SceneError
            If it has a sensor that cannot be described.
        """
        sensors = {f"sensor_{i}": _sensor(s) for i, s in enumerate(self.value.sensors())}
        return {"type": "scene", "integrator": {"type": "path"}, **sensors}

    def __reduce__(self) -> NoReturn:
        raise InputError(_ELSEWHERE)


def _sensor(sensor: Any) -> dict[str, Any]:
    import mitsuba as mi

    name = sensor.class_name()
    if name not in _SENSORS:
        message = (
            f"a scene that Mitsuba has built can be rendered with {', '.join(_SENSORS.values())}, "
            f"but it has a sensor {name}; give the file or dict that it was made of"
        )
        raise SceneError(message)
    held, film = mi.traverse(sensor), sensor.film()

    def number(key: str) -> float:
        return float(np.ravel(np.array(held[key]))[0])

    size, crop, corner = film.size(), film.crop_size(), film.crop_offset()
    found: dict[str, Any] = {"type": _SENSORS[name]}
    found |= {key: number(key) for key in _SETTINGS if key in held}
    found["shutter_close"] = number("shutter_open") + number("shutter_open_time")
    found["to_world"] = np.array(held["to_world"].matrix, np.float64).reshape(4, 4)
    if "x_fov" in held:
        found |= {"fov": number("x_fov"), "fov_axis": "x"}
    found["film"] = {
        "type": "hdrfilm",
        "width": int(size[0]),
        "height": int(size[1]),
        "crop_width": int(crop[0]),
        "crop_height": int(crop[1]),
        "crop_offset_x": int(corner[0]),
        "crop_offset_y": int(corner[1]),
        "filter": {"type": film.rfilter().class_name().removesuffix("Filter").lower()},
    }
    return found
