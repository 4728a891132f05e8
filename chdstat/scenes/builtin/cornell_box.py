"""The Cornell box: two blocks between a red and a green wall, under one area light.

Dimensions after the box measured at Cornell (Goral, Torrance, Greenberg, Battaile 1984,
doi:10.1145/964965.808601), in units of a metre; reflectances are its usual RGB stand-ins.
"""

from __future__ import annotations

from chdstat.scenes.props.shapes import box, join, quad
from chdstat.scenes.props.textures import Entry, rgb
from chdstat.scenes.scene import look_at, rotate, translate

__all__ = ["build"]

_WHITE = {"type": "diffuse", "reflectance": rgb(0.725, 0.71, 0.68)}
_RED = {"type": "diffuse", "reflectance": rgb(0.63, 0.065, 0.05)}
_GREEN = {"type": "diffuse", "reflectance": rgb(0.14, 0.45, 0.091)}

_WIDTH, _DEPTH, _HEIGHT = 0.5528, 0.5592, 0.5488


def build() -> Entry:
    """Return the scene dict of the Cornell box."""
    floor = quad((0, 0, 0), (_WIDTH, 0, 0), (0, _DEPTH, 0))
    ceiling = quad((0, _DEPTH, _HEIGHT), (_WIDTH, 0, 0), (0, -_DEPTH, 0))
    back = quad((0, _DEPTH, 0), (_WIDTH, 0, 0), (0, 0, _HEIGHT))
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "sensor": _sensor(),
        "light": _light(),
        "shell": join(floor, ceiling, back).shape(_WHITE),
        "left-wall": quad((0, 0, 0), (0, _DEPTH, 0), (0, 0, _HEIGHT)).shape(_RED),
        "right-wall": quad((_WIDTH, _DEPTH, 0), (0, -_DEPTH, 0), (0, 0, _HEIGHT)).shape(_GREEN),
        "tall-block": _block(0.1855, 0.351, 17.0, height=0.330),
        "short-block": _block(0.368, 0.169, -17.0, height=0.165),
    }


def _sensor() -> Entry:
    return {
        "type": "perspective",
        "fov": 39.3,
        "to_world": look_at((_WIDTH / 2, -0.8, 0.273), (_WIDTH / 2, 0.0, 0.273)),
        "film": {"type": "hdrfilm", "width": 256, "height": 256, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }


def _light() -> Entry:
    """Return the lamp, a hair below the ceiling so that the two do not coincide."""
    # Mitsuba's rectangle spans [-1, 1]^2 and shines along its own +z.
    place = look_at((_WIDTH / 2, 0.2795, _HEIGHT - 1e-4), (_WIDTH / 2, 0.2795, 0.0), up=(0, 1, 0))
    place[:3, 0] *= 0.065
    place[:3, 1] *= 0.0525
    emitter = {"type": "area", "radiance": rgb(17.0, 12.0, 4.0)}
    return {"type": "rectangle", "to_world": place, "emitter": emitter, "bsdf": _WHITE}


def _block(x: float, y: float, degrees: float, *, height: float) -> Entry:
    """Return a block that stands with the middle of its foot at (x, y), turned about the z axis."""
    half = 0.165 / 2
    block = box((-half, -half, 0), (half, half, height))
    return block.moved(translate(x, y, 0) @ rotate("z", degrees)).shape(_WHITE)
