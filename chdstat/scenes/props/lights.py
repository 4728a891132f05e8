"""Lights for the built-in scenes, as plain scene entries.

Use `glow` for a mesh that shines, `bulb` for a ball, `spot` for a disk, `lamp` for a piece of
furniture with a bulb in it. All but `lamp` are black where they do not shine.

`radiance` is in linear RGB or a texture; `weight` tells how often, relative to the other lights, a
path tracer chooses this one.

Cameras of the built-in scenes, as plain scene entries.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat.scenes.props.shapes import Mesh, join, revolve, surface
from chdstat.scenes.props.textures import Entry, matte, metal, rgb, translucent
from chdstat.scenes.scene import Vector, look_at, scale

__all__ = ["bulb", "camera", "glow", "lamp", "spot"]

Matrix = npt.NDArray[np.float64]

_BLACK = matte(rgb(0.0, 0.0, 0.0))
_BRASS = metal("Au", roughness=0.25)
_FOOT = [(0.0, 0.0), (0.14, 0.0), (0.14, 0.012), (0.02, 0.028), (0.0, 0.028)]


def glow(mesh: Mesh, radiance: Entry, *, weight: float = 1.0) -> Entry:
    """Return a mesh that shines to the side which it faces."""
    return {**mesh.shape(_BLACK), "emitter": _area(radiance, weight)}


def bulb(center: Vector, radius: float, radiance: Entry | None, *, weight: float = 1.0) -> Entry:
    """Return a ball that shines, or a white one where the radiance is None."""
    ball: Entry = {"type": "sphere", "center": np.round(center, 6).tolist(), "radius": radius}
    if radiance is None:
        return {**ball, "bsdf": matte(rgb(0.8, 0.8, 0.8))}
    return {**ball, "bsdf": _BLACK, "emitter": _area(radiance, weight)}


def spot(
    origin: Vector,
    target: Vector,
    radius: float,
    radiance: Entry,
    *,
    weight: float = 1.0,
) -> Entry:
    """Return a disk at `origin` that shines towards `target`."""
    return {
        "type": "disk",
        "to_world": look_at(origin, target) @ scale(radius, radius, 1.0),
        "bsdf": _BLACK,
        "emitter": _area(radiance, weight),
    }


def lamp(place: Matrix, *, name: str, height: float, shade: Entry, light: Entry | None) -> Entry:
    """Return a standing lamp whose paper shade is open at both ends.

    Parameters
    ----------
    place
        Where it stands.
    name
        What the names of its entries begin with.
    height
        Of the upper rim of the shade, in metres.
    shade
        Colour of the shade.
    light
        Radiance of the bulb, or None for a lamp that is off.
    """
    wide, narrow, low = 0.2, 0.14, height - 0.28
    rims = ((wide, low), (narrow, height))
    stem = revolve([(0, 0.02), (0.011, 0.02), (0.011, low + 0.04), (0, low + 0.04)], segments=16)
    metal_parts = join(revolve(_FOOT), stem, *(_rim(*rim) for rim in rims))
    return {
        f"{name}-shade": _sleeve(*rims).moved(place).shape(translucent(shade, through=0.55)),
        f"{name}-foot": metal_parts.moved(place).shape(_BRASS),
        f"{name}-bulb": bulb((place @ [0, 0, low + 0.13, 1])[:3], 0.045, light),
    }


def _area(radiance: Entry, weight: float) -> Entry:
    return {"type": "area", "radiance": radiance, "sampling_weight": weight}


def _sleeve(low: tuple[float, float], high: tuple[float, float]) -> Mesh:
    """Return a cone between two rings of (radius, height), open at both ends."""
    turn = np.linspace(0, 2 * np.pi, 49)
    turn[-1] = 0.0
    radius, height = np.linspace(low, high, 3)[:, :, np.newaxis].swapaxes(0, 1)
    circle = (radius * np.cos(turn), radius * np.sin(turn), height)
    return surface(np.stack(np.broadcast_arrays(*circle), axis=-1))


def _rim(radius: float, height: float) -> Mesh:
    turn = np.linspace(0, 2 * np.pi, 9)
    wire = 0.004 * np.column_stack([np.cos(turn), np.sin(turn)])
    return revolve(wire + np.array([radius, height]), crease=180.0)


def camera(origin: Vector, target: Vector, *, fov: float) -> Entry:
    """Return a camera that looks from `origin` at `target`; `fov` is in degrees across."""
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.01,
        "far_clip": 100.0,
        "to_world": look_at(origin, target),
        "film": {"type": "hdrfilm", "width": 512, "height": 512, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }
