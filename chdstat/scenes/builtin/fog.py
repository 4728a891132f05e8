"""A park in fog at dawn, its two rows of lamps still lit.

The air is a homogeneous medium that scatters the light on its way to the camera: every lamp has a
halo, trees fade with distance, and a sample can end anywhere on its line of sight. Needs
`volpath`, which also counts scattering in the air as a bounce.

The path runs along y; the camera stands in the fog, so that the first surface which it sees is one
of the park and not the edge of the fog.
"""

from __future__ import annotations

import numpy as np

from chdstat.scenes.props import textures
from chdstat.scenes.props.furniture import bulb, camera, glow, paving
from chdstat.scenes.props.shapes import Mesh, box, circle, join, quad, revolve, surface, tube
from chdstat.scenes.props.textures import Entry, glossy, matte, rgb
from chdstat.scenes.scene import rotate, scale, translate

__all__ = ["build"]

_IRON = glossy(rgb(0.03, 0.035, 0.035), roughness=0.25)
_BARK = matte(rgb(0.11, 0.085, 0.065))
_DAWN = (
    *[(0.0, (0.55, 0.36, 0.28)), (0.1, (1.0, 0.6, 0.36)), (0.22, (0.75, 0.55, 0.50))],
    *[(0.5, (0.3, 0.36, 0.5)), (1.0, (0.12, 0.18, 0.34))],
)
"""From the horizon to the zenith."""
_HAZE = {"type": "ref", "id": "haze"}
# Profile of a lamp post, (radius, height).
_POST = [
    *[(0, 0), (0.11, 0), (0.11, 0.06), (0.06, 0.12)],
    *[(0.05, 0.5), (0.03, 0.55), (0.028, 2.62), (0, 2.62)],
]
_LAMPS = (3.0, 7.5, 12.0, 16.5)


def build() -> Entry:
    """Return the scene dict of the park."""
    return {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 5},
        **_air(),
        "sensor": {**camera((0.55, -2.2, 1.55), (-0.1, 8.0, 2.0), fov=52.0), "medium": _HAZE},
        **_terrain(),
        **_lamps(),
        **_trees(),
        **_bench(),
    }


def _air() -> Entry:
    """Return the fog: denser than real fog, for the park is small; its light comes forward."""
    backdrop = quad((-15.9, 23.8, 0.0), (31.8, 0, 0), (0, 0, 16.8))
    backdrop = backdrop.mapped(scale=(1 / 31.8, 1 / 16.8))
    return {
        "haze": {
            "type": "homogeneous",
            "sigma_t": 0.055,
            "albedo": rgb(0.93, 0.94, 0.96),
            "phase": {"type": "hg", "g": 0.35},
        },
        "air": {
            "type": "cube",
            "to_world": translate(0.0, 9.9, 8.4) @ scale(16.0, 14.0, 8.5),
            "bsdf": {"type": "null"},
            "interior": _HAZE,
        },
        "dawn": glow(backdrop, textures.light(_DAWN, 1.6), weight=4.0),
        "sky": {"type": "constant", "radiance": rgb(0.02, 0.028, 0.045)},
    }


def _terrain() -> Entry:
    """Return pale and dark pavers, wet, between lawns."""
    lawn = quad((-20.0, -6.0, -0.004), (40.0, 0, 0), (0, 40.0, 0))
    kerbs = [box((x - 0.05, -1.5, -0.02), (x + 0.05, 22.0, 0.07), bevel=0.015) for x in (-1.4, 1.4)]
    colors = (0.05, 0.05, 0.055), (0.5, 0.49, 0.46)
    return {
        "path": paving((-1.35, -1.5), (6, 52), colors, edge=0.45, roughness=0.2),
        "kerbs": join(*kerbs).shape(matte(rgb(0.4, 0.4, 0.38))),
        "lawn": lawn.shape(matte(rgb(0.035, 0.07, 0.025))),
    }


def _lamps() -> Entry:
    """Return posts at both sides of the path, a warm globe on each under a small roof."""
    post = revolve(_POST, segments=24)
    roof = revolve([(0, 2.98), (0.2, 2.96), (0.17, 3.0), (0.04, 3.08), (0, 3.1)], segments=32)
    arms = [
        tube([(x, y, 2.6), (1.5 * x, 1.5 * y, 2.78), (x, y, 2.97)], 0.008, segments=8)
        for x, y in ((0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1))
    ]
    entries: Entry = {}
    posts = []
    for i, y in enumerate(_LAMPS):
        for name, x in (("left", -1.75), ("right", 1.75)):
            posts.append(join(post, roof, *arms).moved(translate(x, y, 0)))
            entries[f"globe-{name}-{i}"] = bulb((x, y, 2.8), 0.1, rgb(70.0, 42.0, 15.0))
    return {"posts": join(*posts).shape(_IRON), **entries}


def _trees() -> Entry:
    """Return bare trees on both lawns."""
    rng = np.random.default_rng(21)
    west = [(-3.1, 2.2), (-3.6, 6.4), (-3.0, 10.6), (-3.9, 14.5)]
    east = [(3.3, 4.4), (3.0, 9.0), (3.8, 13.4)]
    limbs = []
    for x, y in sorted(west + east, key=lambda spot: spot[1]):
        up = np.array([0.12 * rng.normal(), 0.12 * rng.normal(), 1.0])
        tree = _grow(rng, np.zeros(3), up, length=1.7, radius=0.15, left=4)
        limbs += [limb.moved(translate(x, y, -0.05)) for limb in tree]
    return {"trees": join(*limbs).shape(_BARK)}


def _grow(
    rng: np.random.Generator,
    start: np.ndarray,
    heading: np.ndarray,
    *,
    length: float,
    radius: float,
    left: int,
) -> list[Mesh]:
    """Return one limb, bent and tapering, and those that fork from its end, `left` times."""
    steps = np.linspace(0, 1, 5)[:, None]
    bend = 0.18 * rng.normal(size=3)
    heading = heading / np.linalg.norm(heading)
    path = start + length * (steps * heading + steps**2 * bend)
    limbs = [_taper(path, radius, 0.68 * radius)]
    forks = 3 if left > 2 else 2
    for _ in range(forks if left else 0):
        fork = heading + bend + 0.62 * rng.normal(size=3) + [0.0, 0.0, 0.12]
        shorter = length * (0.62 + 0.18 * rng.random())
        limbs += _grow(rng, path[-1], fork, length=shorter, radius=0.6 * radius, left=left - 1)
    return limbs


def _taper(path: np.ndarray, first: float, last: float) -> Mesh:
    """Return an open pipe along a path, its radius falling from `first` to `last`."""
    heading = path[-1] - path[0]
    side = np.cross(heading, np.eye(3)[np.abs(heading).argmin()])
    frame = np.stack([side, np.cross(heading, side)])
    frame /= np.linalg.norm(frame, axis=1, keepdims=True)
    radius = np.linspace(first, last, len(path))
    return surface(path[:, None] + radius[:, None, None] * (circle(8) @ frame))


def _bench() -> Entry:
    """Return a slatted bench beside the path that faces it."""
    slats = [
        box((-0.8, y, 0.44), (0.8, y + 0.08, 0.47), bevel=0.006)
        for y in (-0.42, -0.32, -0.22, -0.12)
    ]
    back = [box((-0.8, -0.02, z), (0.8, 0.01, z + 0.08), bevel=0.006) for z in (0.56, 0.68, 0.80)]
    legs = [
        tube([(x, y, 0.0), (x, y, 0.22), (x, y, 0.45)], 0.02, segments=10)
        for x in (-0.65, 0.65)
        for y in (-0.4, -0.08)
    ] + [
        tube([(x, -0.06, 0.4), (x, 0.0, 0.6), (x, 0.03, 0.9)], 0.018, segments=10)
        for x in (-0.65, 0.65)
    ]
    place = translate(-1.65, 4.9, 0) @ rotate("z", 90)
    wood = textures.wood((0.16, 0.08, 0.04), (0.45, 0.27, 0.14), seed=15)
    return {
        "bench": join(*slats, *back).moved(place).shape(matte(textures.bitmap(wood))),
        "bench-legs": join(*legs).moved(place).shape(_IRON),
    }
