"""A terrace on a summer night under strings of coloured bulbs.

A hundred and twelve small bulbs of eight colours and a row of paper lanterns light it directly;
a path tracer picks one of them at random for every connection, so a pixel's distribution is a
mixture of as many parts as there are lights, of all colours, distances and angles.

The terrace is 7 m wide (x from -3.5 to 3.5) and 8 m deep (y), with a brick wall at the back.
"""

from __future__ import annotations

import numpy as np

from chdstat.scenes.props import furniture, living_room, textures
from chdstat.scenes.props.furniture import bulb, camera, paving
from chdstat.scenes.props.shapes import Mesh, box, join, quad, revolve, tiles, tube
from chdstat.scenes.props.textures import Entry, glossy, matte, metal, rgb, translucent
from chdstat.scenes.scene import rotate, translate

__all__ = ["build"]

_HALF, _DEPTH = 3.5, 8.0
_STRINGS, _BULBS = 8, 14
_COLORS = (
    *[(1.0, 0.07, 0.04), (1.0, 0.30, 0.03), (1.0, 0.62, 0.10), (0.42, 0.9, 0.08)],
    *[(0.05, 0.8, 0.45), (0.06, 0.45, 1.0), (0.16, 0.10, 1.0), (0.8, 0.06, 0.75)],
)
_RADIANCE = 55.0

_IRON = glossy(rgb(0.03, 0.03, 0.035), roughness=0.2)
_TEAK = (0.16, 0.08, 0.04), (0.45, 0.27, 0.14)


def build() -> Entry:
    """Return the scene dict of the terrace."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6},
        "sensor": camera((-1.5, -1.3, 1.65), (0.3, 6.0, 1.3), fov=54.0),
        # The last of dusk, so that what faces the sky alone is not black.
        "dusk": {"type": "constant", "radiance": rgb(0.008, 0.013, 0.032)},
        **_paving(),
        **_wall(),
        **_fence(),
        **_pergola(),
        **_lights(),
        **_lanterns(),
        **_tables(),
        **_plants(),
    }


def _paving() -> Entry:
    """Return dark and pale tiles, wet, on mortar."""
    mortar = quad((-_HALF, -2.0, -0.001), (2 * _HALF, 0, 0), (0, 10.0, 0))
    lawn = quad((-30.0, -10.0, -0.02), (60.0, 0, 0), (0, 40.0, 0))
    colors = (0.035, 0.04, 0.05), (0.62, 0.58, 0.52)
    return {
        "tiles": paving((-_HALF, -2.0), (14, 20), colors, edge=0.5, roughness=0.14),
        "mortar": mortar.shape(matte(rgb(0.2, 0.19, 0.18))),
        "lawn": lawn.shape(matte(rgb(0.06, 0.12, 0.04))),
    }


def _wall() -> Entry:
    """Return a brick wall with a door and two dark windows, and pale joints behind the bricks."""
    rows, columns = 42, 28
    colors = [(0.36, 0.15, 0.09) if row % 6 else (0.24, 0.09, 0.06) for row in range(rows)]
    image = textures.tile_colors(colors, columns=columns, spread=0.3, seed=3)
    bricks = tiles(columns, rows, size=(0.25, 0.08), gap=0.01, depth=0.008, stagger=0.5)
    upright = translate(-_HALF, _DEPTH - 0.01, 0) @ rotate("x", 90)
    joints = quad((-_HALF, _DEPTH, 0), (2 * _HALF, 0, 0), (0, 0, 3.36))
    panes = join(*(quad((x, _DEPTH - 0.045, 0.95), (1.1, 0, 0), (0, 0, 1.2)) for x in (-2.7, 1.6)))
    frames = join(*(bar for x in (-2.7, 1.6) for bar in _window_bars(x)))
    return {
        "bricks": bricks.moved(upright).shape(matte(textures.bitmap(image, sharp=True))),
        "joints": joints.shape(matte(rgb(0.45, 0.42, 0.38))),
        "panes": panes.shape(glossy(rgb(0.01, 0.012, 0.015), roughness=0.05)),
        "frames": frames.shape(glossy(rgb(0.75, 0.73, 0.68), roughness=0.2)),
        **furniture.door(translate(0.0, _DEPTH - 0.02, 0)),
    }


def _window_bars(x: float) -> list[Mesh]:
    """Return frame and glazing bars of a window whose left lower corner is at `x`."""
    y0, y1, z0, wide, high, bar = _DEPTH - 0.09, _DEPTH - 0.02, 0.95, 1.1, 1.2, 0.06
    upright = [
        box((x + s, y0, z0), (x + s + bar, y1, z0 + high), bevel=0.006)
        for s in (0.0, (wide - bar) / 2, wide - bar)
    ]
    level = [
        box((x - 0.03, y0 - 0.02, z0 + s), (x + wide + 0.03, y1, z0 + s + bar), bevel=0.006)
        for s in (-bar, high)
    ]
    return [*upright, *level]


def _fence() -> Entry:
    """Return white pales at the right of the house, and a hedge behind them."""
    pales = [
        box((x, _DEPTH - 0.03, 0.05), (x + 0.09, _DEPTH, 1.0 + 0.08 * (k % 2)), bevel=0.008)
        for k, x in enumerate(np.arange(_HALF + 0.05, 9.0, 0.14).round(6).tolist())
    ]
    rails = [box((_HALF, _DEPTH, z), (9.2, _DEPTH + 0.03, z + 0.07)) for z in (0.25, 0.75)]
    hedge = box((_HALF - 1.0, _DEPTH + 1.2, 0.0), (14.0, _DEPTH + 2.0, 1.9), bevel=0.3)
    return {
        "fence": join(*pales, *rails).shape(matte(rgb(0.72, 0.71, 0.67))),
        "hedge": hedge.shape(matte(rgb(0.07, 0.14, 0.05))),
    }


def _pergola() -> Entry:
    """Return posts at both sides and a beam along each row of them."""
    posts = [
        box((x - 0.06, y - 0.06, 0), (x + 0.06, y + 0.06, 2.9), bevel=0.008, grain="z")
        for x in (-3.2, 3.2)
        for y in (1.2, 4.2, 7.2)
    ]
    beams = [
        box((x - 0.05, 0.6, 2.9), (x + 0.05, 7.9, 3.04), bevel=0.008, grain="y")
        for x in (-3.2, 3.2)
    ]
    wood = textures.wood(*_TEAK, seed=6)
    return {"pergola": join(*posts, *beams).shape(matte(textures.bitmap(wood)))}


def _lights() -> Entry:
    """Return sagging wires from beam to beam with bulbs along them."""
    entries: Entry = {}
    wires = []
    for k in range(_STRINGS):
        y = 0.9 + k * 0.9
        path = _sag(y, np.linspace(-3.2, 3.2, 33), k)
        wires.append(tube(path, 0.006, segments=6))
        spots = _sag(y, np.linspace(-2.95, 2.95, _BULBS), k) - [0.0, 0.0, 0.05]
        for i, spot in enumerate(spots.tolist()):
            color = np.multiply(_COLORS[(i + k % 3) // 2 % len(_COLORS)], _RADIANCE)
            entries[f"bulb-{k}-{i}"] = bulb(spot, 0.05, rgb(*color.tolist()))
    return {"wires": join(*wires).shape(_IRON), **entries}


def _sag(y: float, x: np.ndarray, k: int) -> np.ndarray:
    """Return points on the k-th wire, which hangs lower in the middle."""
    depth = 0.38 + 0.12 * np.sin(2.1 * k)
    z = 2.92 - depth * (1 - (x / 3.2) ** 2)
    return np.stack([x, np.full_like(x, y), z], axis=-1)


def _lanterns() -> Entry:
    """Return paper globes with a candle in each, on the ground along the wall."""
    turn = np.linspace(-1.2, 1.2, 15)
    profile = np.column_stack([0.15 * np.cos(turn), 0.15 + 0.15 * np.sin(turn) / np.sin(1.2)])
    paper = translucent(rgb(0.92, 0.85, 0.7), through=0.6)
    entries: Entry = {}
    for i, (x, y) in enumerate(((-2.9, 7.4), (-0.75, 7.5), (0.8, 7.5), (2.9, 7.3))):
        globe = revolve(profile, segments=32, crease=180.0)
        entries[f"lantern-{i}"] = globe.moved(translate(x, y, 0.02)).shape(paper)
        entries[f"candle-{i}"] = bulb((x, y, 0.17), 0.03, rgb(260.0, 150.0, 50.0))
    return entries


def _tables() -> Entry:
    """Return two set tables and their chairs."""
    cloth = rgb(0.8, 0.79, 0.75)
    top = revolve([(0, 0.7), (0.54, 0.7), (0.55, 0.715), (0.54, 0.73), (0, 0.73)], segments=64)
    foot = revolve([(0, 0), (0.26, 0), (0.26, 0.02), (0.03, 0.05), (0.03, 0.7), (0, 0.7)])
    spots = ((0.55, 2.5), (-1.35, 5.1))
    chairs = [
        _chair().moved(translate(x + dx, y + dy, 0) @ rotate("z", turn))
        for x, y in spots
        for dx, dy, turn in ((0.62, 0.3, -65), (-0.62, 0.35, 60))
    ]
    return {
        "table-tops": join(*(top.moved(translate(x, y, 0)) for x, y in spots)).shape(matte(cloth)),
        "table-feet": join(*(foot.moved(translate(x, y, 0)) for x, y in spots)).shape(_IRON),
        "chairs": join(*chairs).shape(matte(textures.bitmap(textures.wood(*_TEAK, seed=9)))),
        **living_room.bowl(translate(0.55, 2.62, 0.73), color=rgb(0.07, 0.2, 0.3)),
        **furniture.vase(translate(0.3, 2.38, 0.73)),
        "carafe": {
            **furniture.tumbler(translate(0.78, 2.36, 0.73))["tumbler"],
            "bsdf": metal("Cr", roughness=0.05),
        },
    }


def _chair() -> Mesh:
    """Return a slatted garden chair that faces -y."""
    seat = [box((-0.22, y, 0.43), (0.22, y + 0.06, 0.45)) for y in np.linspace(-0.24, 0.16, 6)]
    back = [
        box((x, 0.2, 0.45), (x + 0.05, 0.22, 0.9), grain="z") for x in np.linspace(-0.22, 0.17, 6)
    ]
    legs = [
        box((x, y, 0.0), (x + 0.04, y + 0.04, 0.43), grain="z")
        for x in (-0.22, 0.18)
        for y in (-0.24, 0.18)
    ]
    rail = box((-0.24, 0.19, 0.88), (0.24, 0.23, 0.96))
    return join(*seat, *back, *legs, rail)


def _plants() -> Entry:
    """Return three big pots of plants."""
    entries: Entry = {}
    for i, (x, y, size) in enumerate(((2.5, 4.6, 2.6), (-2.7, 3.0, 2.4), (2.6, 1.6, 2.2))):
        stretch = np.diag([size, size, size, 1.0])
        grown = furniture.plant(translate(x, y, 0) @ stretch)
        entries |= {f"{name}-{i}": entry for name, entry in grown.items()}
    return entries
