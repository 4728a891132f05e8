"""Make the meshes and textures of the built-in scenes: python tools/make_scenes.py [FILE].

They are written to ``chdstat/scenes/builtin/arrays.npz``, compressed by LZMA. Cameras, lights and
materials, and which mesh and texture a part has, stand in ``chdstat/scenes/builtin/NAME.json``.
"""

from __future__ import annotations

import io
import itertools
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from models import furniture, textures
from models.furniture import Parts, hanging, paving, placed, walls, window_frame
from models.shapes import (
    Array,
    Mesh,
    ball,
    box,
    circle,
    join,
    quad,
    revolve,
    ring,
    rotate,
    sheet,
    surface,
    translate,
    tube,
)
from models.shapes import tiles as tiling

# --- textures -------------------------------------------------------------------------------------

RED, CREAM, BLACK = (0.5, 0.05, 0.035), (0.80, 0.77, 0.68), (0.03, 0.03, 0.03)
OCHRE, TEAL, ROSE = (0.6, 0.34, 0.06), (0.04, 0.2, 0.22), (0.62, 0.3, 0.25)
PAINTING = ((RED, BLACK, CREAM, TEAL), (CREAM, OCHRE, BLACK, CREAM), (BLACK, CREAM, ROSE, RED))
"""Panes from a twenty-fifth to four fifths of reflectance, side by side under the same light."""
SPINES = (
    *[(0.55, 0.08, 0.05), (0.72, 0.62, 0.45), (0.05, 0.13, 0.24), (0.09, 0.24, 0.14)],
    *[(0.62, 0.36, 0.07), (0.03, 0.03, 0.035), (0.78, 0.76, 0.71), (0.30, 0.06, 0.10)],
)
"""Colours of the books."""
SUNSET = (
    *[(0.0, (0.05, 0.03, 0.025)), (0.3, (0.09, 0.05, 0.04)), (0.33, (1.0, 0.36, 0.12))],
    *[(0.5, (0.95, 0.42, 0.24)), (0.75, (0.75, 0.42, 0.38)), (1.0, (0.6, 0.42, 0.48))],
)
"""From the dark ground over the glow at the horizon to the sky above it."""
DAWN = (
    *[(0.0, (0.55, 0.36, 0.28)), (0.1, (1.0, 0.6, 0.36)), (0.22, (0.75, 0.55, 0.50))],
    *[(0.5, (0.3, 0.36, 0.5)), (1.0, (0.12, 0.18, 0.34))],
)
"""From the horizon to the zenith."""
WALNUT = (0.085, 0.036, 0.016), (0.36, 0.185, 0.085)
TEAK = (0.16, 0.08, 0.04), (0.45, 0.27, 0.14)
GLAZE = [(0.045, 0.17, 0.19) if row in (11, 12) else (0.78, 0.81, 0.79) for row in range(14)]
BRICKS = [(0.36, 0.15, 0.09) if row % 6 else (0.24, 0.09, 0.06) for row in range(42)]
WICKER = [(k / 32, (k + 0.5) / 32) for k in range(32)]


def images() -> dict[str, textures.Image]:
    """Return all textures by name."""
    wood, checks, bands = textures.wood, textures.checks, textures.bands
    return {
        "bathroom/basket-texture": bands((0.52, 0.37, 0.21), (0.27, 0.17, 0.085), edges=WICKER),
        "bathroom/door-texture": wood(*WALNUT, seed=2),
        "bathroom/floor-texture": textures.planks((0.24, 0.135, 0.07), (0.56, 0.38, 0.23), seed=5),
        "bathroom/tiles-back-texture": textures.tile_colors(GLAZE, columns=5, spread=0.08, seed=5),
        "bathroom/tiles-right-texture": textures.tile_colors(
            GLAZE, columns=18, spread=0.08, seed=18
        ),
        "bathroom/towel-texture": bands(
            (0.62, 0.33, 0.055), (0.78, 0.72, 0.62), edges=[(0.12, 0.16), (0.19, 0.21)]
        ),
        "bathroom/vanity-texture": wood(*WALNUT, seed=7),
        "caustic/cloth-texture": checks(
            (0.028, 0.036, 0.05), (0.78, 0.75, 0.69), rows=6, columns=8
        ),
        "caustic/table-texture": wood((0.10, 0.045, 0.02), (0.38, 0.2, 0.095), seed=12, rings=6),
        "fog/bench-texture": wood(*TEAK, seed=15),
        "fog/dawn-texture": np.float32(1.6 * textures.gradient(DAWN)),
        "fog/path-texture": checks((0.05, 0.05, 0.055), (0.5, 0.49, 0.46), rows=52, columns=6),
        "gallery/slabs-texture": checks(
            (0.05, 0.05, 0.052), (0.72, 0.71, 0.69), rows=32, columns=8
        ),
        "living-room/books-texture": textures.panes([SPINES]),
        "living-room/floor-texture": textures.planks((0.28, 0.17, 0.09), (0.6, 0.41, 0.25), seed=8),
        "living-room/painting-texture": textures.panes(PAINTING),
        "living-room/sky-0-texture": np.float32(14.0 * textures.gradient(SUNSET)),
        "living-room/sofa-feet-texture": wood(*WALNUT, seed=3),
        "many-lights/bricks-texture": textures.tile_colors(BRICKS, columns=28, spread=0.3, seed=3),
        "many-lights/chairs-texture": wood(*TEAK, seed=9),
        "many-lights/pergola-texture": wood(*TEAK, seed=6),
        "many-lights/tiles-texture": checks(
            (0.035, 0.04, 0.05), (0.62, 0.58, 0.52), rows=20, columns=14
        ),
    }


# --- Cornell box ----------------------------------------------------------------------------------


def cornell_box() -> Parts:
    """Return the box measured at Cornell, in metres.

    C. M. Goral, K. E. Torrance, D. P. Greenberg, B. Battaile, "Modeling the interaction of light
    between diffuse surfaces", SIGGRAPH 1984, doi:10.1145/964965.808601.
    """
    wide, deep, high, half = 0.5528, 0.5592, 0.5488, 0.165 / 2
    blocks = {
        name: box((-half, -half, 0), (half, half, height)).moved(
            translate(x, y, 0) @ rotate("z", turn)
        )
        for name, x, y, turn, height in (
            ("tall-block", 0.1855, 0.351, 17.0, 0.330),
            ("short-block", 0.368, 0.169, -17.0, 0.165),
        )
    }
    floor = quad((0, 0, 0), (wide, 0, 0), (0, deep, 0))
    ceiling = quad((0, deep, high), (wide, 0, 0), (0, -deep, 0))
    back = quad((0, deep, 0), (wide, 0, 0), (0, 0, high))
    return {
        "shell": join(floor, ceiling, back),
        "left-wall": quad((0, 0, 0), (0, deep, 0), (0, 0, high)),
        "right-wall": quad((wide, deep, 0), (0, -deep, 0), (0, 0, high)),
        **blocks,
    }


# --- bathroom -------------------------------------------------------------------------------------


def bathroom() -> Parts:
    """Return a room 2.6 m wide (x), 3.7 m deep (y) and 2.5 m high (z).

    The window is in the left wall, the washbasin at the back, the tub at the right, and the camera
    at the front.
    """
    wide, deep, high, reveal = 2.6, 3.7, 2.5, 0.16
    (y0, y1), (z0, _) = window = (1.55, 3.2), (0.9, 2.25)
    frame = window_frame(*window, reveal=reveal, bar=0.045, middle=0.045)
    sill = box((-reveal, y0 - 0.06, z0 - 0.02), (0.08, y1 + 0.06, z0 + 0.015), bevel=0.006)
    skirting = join(
        box((0, deep - 0.015, 0), (wide, deep, 0.09), bevel=0.004),
        box((0, 0, 0), (0.015, deep - 0.015, 0.09), bevel=0.004),
    )
    floor = quad((0, 0, 0), (wide, 0, 0), (0, deep, 0)).mapped(scale=(1 / 1.6, 1 / 0.9))
    basin_x, lamp_z, top, to_room = 0.85, 1.62, 0.87, rotate("z", 180)
    towel, basket = hanging(0.5, front=0.9, back=0.3), revolve(furniture.BASKET, crease=70.0)
    tumbler, vase = revolve(furniture.TUMBLER), revolve(furniture.VASE)
    return {
        "sky": _dome().moved(translate(0, np.mean(window[0]), 0)),
        "floor": floor,
        "walls": walls((wide, deep, high), [window[0]], window[1], reveal=reveal),
        "skirting": skirting,
        "window": join(*frame, sill),
        **_tiles("right", 18, translate(wide - 0.004, deep, 0) @ rotate("z", -90)),
        **_tiles("back", 5, translate(wide - 1.0, deep - 0.004, 0)),
        **furniture.vanity(translate(basin_x, deep, 0)),
        "mirror-frame": furniture.mirror_frame(0.44).moved(translate(basin_x, deep - 0.03, lamp_z)),
        **furniture.wall_lamp(translate(basin_x - 0.59, deep, lamp_z), name="left-lamp"),
        **furniture.wall_lamp(translate(basin_x + 0.59, deep, lamp_z), name="right-lamp"),
        "vase": vase.moved(translate(0.42, deep - 0.19, top)),
        "tumbler": tumbler.moved(translate(1.15, deep - 0.13, top)),
        **furniture.dispenser(translate(1.27, deep - 0.16, top)),
        **furniture.tub(translate(2.16, 2.62, 0)),
        **furniture.tub_tap(translate(wide, 2.72, 0.80) @ rotate("z", -90)),
        **furniture.towel_rail(translate(2.02, deep, 1.42)),
        "bath-towel": towel.moved(translate(0.65, 0.075, 1.75) @ to_room),
        **furniture.door(translate(0.65, 0, 0) @ to_room),
        "basket": basket.mapped(scale=(24.0, 1.0)).moved(translate(0.33, 2.62, 0)),
        **furniture.plant(translate(-0.02, 2.98, z0 + 0.015)),
        "mat": box((1.13, 2.05, 0.0), (1.63, 2.85, 0.018), bevel=0.008),
    }


def _dome() -> Mesh:
    """Return the part of a sky which the bathroom can see, facing inwards."""
    radius, azimuth = 6.0, np.deg2rad(np.linspace(262, 118, 14))
    height = np.deg2rad(np.linspace(-8, 42, 7))[:, None]
    level = np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), np.tan(height)), axis=-1)
    # Flat: Mitsuba takes the shading normal of a smooth emitter for its true one, which is biased.
    return replace(surface(radius * np.cos(height)[..., None] * level), normals=None)


def _tiles(name: str, columns: int, place: Array) -> Parts:
    """Return 14 rows of staggered tiles, and the joints behind them."""
    field = tiling(columns, 14, size=(0.2, 0.1), gap=0.006, depth=0.003, stagger=0.5)
    joints = quad((0, 0, 0), (columns * 0.2, 0, 0), (0, 14 * 0.1, 0))
    return placed({f"tiles-{name}": field, f"joints-{name}": joints}, place @ rotate("x", 90))


# --- caustic --------------------------------------------------------------------------------------

# Profiles are (radius, height): up the outside, then down the inside.
GOBLET = [
    *[(0.0, 0.0), (0.04, 0.0), (0.042, 0.003), (0.02, 0.008), (0.006, 0.02), (0.0055, 0.06)],
    *[(0.007, 0.085), (0.02, 0.096), (0.038, 0.115), (0.046, 0.145), (0.044, 0.18), (0.038, 0.21)],
    *[(0.036, 0.21), (0.0418, 0.18), (0.0436, 0.145), (0.036, 0.118), (0.018, 0.1), (0.0, 0.095)],
]
LEMON = [
    *[(0.0, -0.042), (0.006, -0.038), (0.016, -0.03), (0.026, -0.014), (0.029, 0.0)],
    *[(0.026, 0.014), (0.016, 0.03), (0.006, 0.038), (0.0, 0.042)],
]


def caustic() -> Parts:
    """Return a table about 1.4 m wide, the origin in the middle of its top, and what is on it.

    A drape rises behind it; the book gives the crystal its height.
    """
    top = box((-1.1, -0.75, -0.05), (1.1, 0.62, -0.002), bevel=0.004)
    cloth = quad((-0.4, -0.3, 0.0), (0.8, 0, 0), (0, 0.6, 0)).mapped(scale=(1 / 0.8, 1 / 0.6))
    width = np.linspace(-1.8, 1.8, 60)
    folds = 0.035 * np.sin(9 * width) + 0.012 * np.sin(23 * width + 1)
    radius, high, thick = 0.085, 0.045, 0.003
    outline = [(radius, 0), (radius, high), (radius - thick, high), (radius - thick, 0)]
    lemon = revolve(LEMON, segments=48, crease=180.0)
    lying = [
        translate(0.27, 0.03, 0.03) @ rotate("z", 35) @ rotate("y", 90),
        translate(0.31, 0.1, 0.03) @ rotate("z", -50) @ rotate("y", 90),
    ]
    book = box((-0.46, -0.2, -0.002), (-0.3, 0.04, 0.028), bevel=0.002)
    goblet = revolve(GOBLET, segments=96, crease=40.0)
    golden = revolve([*outline, outline[0]], segments=128)
    return {
        "table": top.mapped(scale=(0.7, 1.2)),
        "cloth": cloth.moved(rotate("z", 9)),
        "drape": sheet(width, 0.9 + folds, np.linspace(-0.6, 1.6, 12)[:, None]),
        "goblet": goblet.moved(translate(0.1, 0.14, 0.001)),
        "ring": golden.moved(translate(0.15, -0.09, 0.001)),
        "tumbler": revolve(furniture.TUMBLER).moved(translate(-0.24, 0.2, 0.001)),
        "lemons": join(*(lemon.moved(m) for m in lying)),
        "book": book.moved(rotate("z", -6)),
    }


# --- living room ----------------------------------------------------------------------------------


def living_room() -> Parts:
    """Return the room that day and night share, 5.0 m wide, 6.2 m deep and 2.75 m high.

    Three tall windows are in the left wall, the sofa and the shelf at the back, a carpet in the
    middle, the camera at the front. By day a panel of sky stands behind each window, by night a
    dark one behind all.
    """
    deep, sill, table = 6.2, 0.45, 0.416
    books = join(
        box((2.62, 3.8, table), (2.84, 4.12, table + 0.03), bevel=0.003),
        box((2.64, 3.84, table + 0.03), (2.84, 4.1, table + 0.055), bevel=0.003),
    )
    shelf = furniture.bookshelf(translate(4.2, deep, 0), spines=len(SPINES))
    image = furniture.painting(
        translate(1.75, deep, 1.76), rows=len(PAINTING), columns=len(PAINTING[0])
    )
    return {
        **_skies(),
        "night": quad((-0.7, 0.0, -0.5), (0, 8.0, 0), (0, 0, 4.0)),
        **_living_shell(),
        "carpet": box((1.15, 2.6, 0.0), (3.75, 4.85, 0.016), bevel=0.006),
        **furniture.sofa(translate(2.2, deep - 0.12, 0)),
        **furniture.armchair(translate(0.62, 3.15, 0) @ rotate("z", 62)),
        **furniture.coffee_table(translate(2.45, 3.95, 0.016)),
        **shelf,
        **image,
        "mirror-frame": furniture.mirror_frame(0.36).moved(translate(3.15, deep - 0.02, 1.72)),
        **furniture.lamp(translate(0.55, 5.6, 0), "floor-lamp", height=1.62),
        **furniture.side_table(translate(3.5, 5.6, 0)),
        **furniture.lamp(translate(3.5, 5.6, 0.55), "table-lamp", height=0.55),
        **_curtains(),
        **furniture.bowl(translate(2.15, 3.98, table)),
        "vase": revolve(furniture.VASE).moved(translate(2.5, 4.08, table)),
        **furniture.plant(translate(-0.06, 3.95, sill + 0.012)),
        "table-books": books,
    }


def _skies() -> Parts:
    high = 2.12
    panels = {}
    for i, (a, b) in enumerate(itertools.pairwise((2.15, 3.5, 4.85, 6.3))):
        panel = quad((-0.44, a, 0.3), (0, b - a, 0), (0, 0, high))
        panels[f"sky-{i}"] = panel.mapped(scale=(1 / (b - a), 1 / high))
    return panels


def _living_shell() -> Parts:
    """Return floor, walls, skirting with cornice, and windows with a cross of glazing bars."""
    wide, deep, high, reveal, bar = 5.0, 6.2, 2.75, 0.18, 0.05
    windows, (z0, z1) = ((2.12, 3.18), (3.42, 4.48), (4.72, 5.78)), (0.45, 2.4)
    skirting = [
        box((0.015, deep - 0.015, 0), (wide, deep, 0.11), bevel=0.004),
        box((0, 0, 0), (0.015, deep, 0.11), bevel=0.004),
        box((0, deep - 0.09, high - 0.07), (wide, deep, high), bevel=0.02),
        box((0, 0, high - 0.07), (0.09, deep - 0.09, high), bevel=0.02),
    ]
    x0, x1, transom = 0.02 - reveal, 0.07 - reveal, z1 - 0.6
    bars = []
    for y0, y1 in windows:
        middle = (y0 + y1) / 2
        bars += [
            *window_frame((y0, y1), (z0, z1), reveal=reveal, bar=bar, middle=0.04),
            box((x0, y0 + bar, transom), (x1, middle - 0.02, transom + 0.04), bevel=0.005),
            box((x0, middle + 0.02, transom), (x1, y1 - bar, transom + 0.04), bevel=0.005),
            box((-reveal, y0 - 0.05, z0 - 0.03), (0.1, y1 + 0.05, z0 + 0.012), bevel=0.006),
        ]
    floor = quad((0, 0, 0), (wide, 0, 0), (0, deep, 0)).mapped(scale=(1 / 1.8, 1 / 0.9))
    return {
        "floor": floor,
        "walls": walls((wide, deep, high), windows, (z0, z1), reveal=reveal),
        "skirting": join(*skirting),
        "windows": join(*bars),
    }


def _curtains() -> Parts:
    """Return cloth in folds, which spread towards the floor."""
    x, z = np.linspace(-0.15, 0.15, 70), np.linspace(-2.5, 0, 6)[:, None]
    fall = 0.6 + 0.4 * (-z / 2.5)
    fold = fall * (0.045 * np.sin(2 * np.pi * x / 0.13) + 0.012 * np.sin(37 * x + 1.0))
    curtain = sheet(x, fold, z).moved(rotate("z", 90))
    return {
        f"curtain-{i}": curtain.moved(translate(0.09, y, 2.55))
        for i, y in enumerate((1.98, 3.3, 4.6, 5.92))
    }


# --- fog ------------------------------------------------------------------------------------------


def fog() -> Parts:
    """Return a park whose path of wet pavers runs along y, between lawns."""
    backdrop = quad((-15.9, 23.8, 0.0), (31.8, 0, 0), (0, 0, 16.8))
    kerbs = [box((x - 0.05, -1.5, -0.02), (x + 0.05, 22.0, 0.07), bevel=0.015) for x in (-1.4, 1.4)]
    return {
        "dawn": backdrop.mapped(scale=(1 / 31.8, 1 / 16.8)),
        "path": paving((-1.35, -1.5), (6, 52), 0.45),
        "kerbs": join(*kerbs),
        "lawn": quad((-20.0, -6.0, -0.004), (40.0, 0, 0), (0, 40.0, 0)),
        "posts": _posts(),
        "trees": _trees(),
        **_park_bench(translate(-1.65, 4.9, 0) @ rotate("z", 90)),
    }


def _posts() -> Mesh:
    """Return lamp posts at both sides of the path, with a small roof for the globe on each."""
    profile = [
        *[(0, 0), (0.11, 0), (0.11, 0.06), (0.06, 0.12)],
        *[(0.05, 0.5), (0.03, 0.55), (0.028, 2.62), (0, 2.62)],
    ]
    roof = revolve([(0, 2.98), (0.2, 2.96), (0.17, 3.0), (0.04, 3.08), (0, 3.1)], segments=32)
    arms = [
        tube([(x, y, 2.6), (1.5 * x, 1.5 * y, 2.78), (x, y, 2.97)], 0.008, segments=8)
        for x, y in ((0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1))
    ]
    post = join(revolve(profile, segments=24), roof, *arms)
    places = [(x, y) for y in (3.0, 7.5, 12.0, 16.5) for x in (-1.75, 1.75)]
    return join(*(post.moved(translate(x, y, 0)) for x, y in places))


def _trees() -> Mesh:
    """Return bare trees on both lawns."""
    rng = np.random.default_rng(21)
    west = [(-3.1, 2.2), (-3.6, 6.4), (-3.0, 10.6), (-3.9, 14.5)]
    east = [(3.3, 4.4), (3.0, 9.0), (3.8, 13.4)]
    limbs = []
    for x, y in sorted(west + east, key=lambda spot: spot[1]):
        up = np.array([0.12 * rng.normal(), 0.12 * rng.normal(), 1.0])
        tree = _grow(rng, np.zeros(3), up, length=1.7, radius=0.15, left=4)
        limbs += [limb.moved(translate(x, y, -0.05)) for limb in tree]
    return join(*limbs)


def _grow(
    rng: np.random.Generator,
    start: Array,
    heading: Array,
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


def _taper(path: Array, first: float, last: float) -> Mesh:
    """Return an open pipe along a path, its radius falling from `first` to `last`."""
    heading = path[-1] - path[0]
    side = np.cross(heading, np.eye(3)[np.abs(heading).argmin()])
    frame = np.stack([side, np.cross(heading, side)])
    frame /= np.linalg.norm(frame, axis=1, keepdims=True)
    radius = np.linspace(first, last, len(path))
    return surface(path[:, None] + radius[:, None, None] * (circle(8) @ frame))


def _park_bench(place: Array) -> Parts:
    """Return a slatted bench."""
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
    return placed({"bench": join(*slats, *back), "bench-legs": join(*legs)}, place)


# --- gallery --------------------------------------------------------------------------------------

HALF, BAY, START, NAVE = 4.0, 2.6, 1.2, 2.3
"""Half the width of the hall, depth of a bay, where the first begins, half the width between the
columns."""


def gallery() -> Parts:
    """Return a hall 8 m wide (x from -4 to 4), 18 m deep (y) and 5.6 m high (z), in six bays.

    The camera stands on the axis at the front; white panels are at the far end, behind the camera
    and above the aisles.
    """
    deep, high = 18.0, 5.6
    shell = join(
        quad((-HALF, deep, high), (2 * HALF, 0, 0), (0, -deep, 0)),
        quad((-HALF, deep, 0), (2 * HALF, 0, 0), (0, 0, high)),
        quad((HALF, 0, 0), (-2 * HALF, 0, 0), (0, 0, high)),
        quad((HALF, deep, 0), (0, -deep, 0), (0, 0, high)),
        quad((-HALF, 0, 0), (0, deep, 0), (0, 0, high)),
    )
    middles = [START + (k + 0.5) * BAY for k in range(6)]
    panels = {
        f"panel-{name}-{k}": quad((x, y + 0.9, 5.15), (0.6, 0, 0), (0, -1.8, 0))
        for k, y in enumerate(middles)
        for name, x in (("left", -3.35), ("right", 2.75))
    }
    plinths = [box((x - 0.28, 4.6, 0), (x + 0.28, 5.16, 0.95), bevel=0.015) for x in (-1.35, 1.35)]
    torus = ring(0.26, 0.0, wire=(0.075, 0.075), sides=24, segments=64)
    tilted = translate(1.35, 4.88, 1.285) @ rotate("z", 20) @ rotate("x", 90)
    bench = join(
        box((-0.5, 7.6, 0.36), (0.5, 9.4, 0.43), bevel=0.01),
        box((-0.4, 7.9, 0.0), (0.4, 8.0, 0.36), bevel=0.01),
        box((-0.4, 9.0, 0.0), (0.4, 9.1, 0.36), bevel=0.01),
    )
    return {
        "walls": shell,
        "slabs": paving((-NAVE, 0.0), (8, 32), NAVE / 4),
        "base": quad((-HALF, 0, -0.002), (2 * HALF, 0, 0), (0, deep, 0)),
        **_bays(middles),
        "portal": _portal(deep),
        "far-panel": quad((-1.15, deep - 0.05, 0.3), (2.3, 0, 0), (0, 0, 2.8)),
        "near-panel": quad((2.2, 0.05, 0.6), (-4.4, 0, 0), (0, 0, 3.6)),
        **panels,
        "plinths": join(*plinths),
        "ball": ball(0.3, rows=32, segments=64).moved(translate(-1.35, 4.88, 1.25)),
        "ring": torus.moved(tilted),
        "bench": bench,
    }


def _bays(middles: list[float]) -> Parts:
    """Return the columns, the arches that join them over the nave, fins and beams."""
    columns, collars, arches, fins, beams = [], [], [], [], []
    column = _column()
    collar = join(*(ring(*at, wire=(0.03, 0.03), sides=12) for at in ((0.235, 0.22), (0.225, 3.2))))
    turn, reach = np.linspace(0, np.pi, 33), NAVE + 0.25
    path = np.column_stack([reach * np.cos(turn), 0 * turn, 3.45 + 1.75 * np.sin(turn)])
    arch, fin = tube(path, 0.085, segments=12), _fins()
    beam = join(
        *[box((-HALF, y - 0.06, 5.2), (HALF, y + 0.06, 5.6)) for y in (-0.65, 0.0, 0.65)],
        *[box((x - 0.06, -1.3, 5.26), (x + 0.06, 1.3, 5.6)) for x in (-2.8, -1.4, 0.0, 1.4, 2.8)],
    )
    for k in range(len(middles) + 1):
        along = translate(0, START + k * BAY, 0)
        for side in (translate(NAVE + 0.25, 0, 0), translate(-NAVE - 0.25, 0, 0)):
            columns.append(column.moved(along @ side))
            collars.append(collar.moved(along @ side))
        arches += [arch.moved(along @ translate(0, y, 0)) for y in (-0.16, 0.16)]
    for y in middles:
        middle = translate(0, y, 0)
        # Symmetric in y, the other side of the hall is the first one turned.
        fins += [fin.moved(middle), fin.moved(rotate("z", 180)).moved(middle)]
        beams.append(beam.moved(middle))
    kinds = {"columns": columns, "collars": collars, "arches": arches, "fins": fins, "beams": beams}
    return {name: join(*meshes) for name, meshes in kinds.items()}


def _column() -> Mesh:
    """Return a fluted shaft that widens at foot and head."""
    height = np.array([0.0, 0.12, 0.2, 0.6, 1.4, 2.4, 3.0, 3.3, 3.5])
    radius = np.array([0.3, 0.3, 0.24, 0.22, 0.205, 0.2, 0.205, 0.25, 0.34])
    turn = np.append(np.linspace(0, 2 * np.pi, 97)[:-1], 0.0)
    x, y = circle(96).T * (1 - 0.09 * np.abs(np.sin(6 * turn)))
    return sheet(radius[:, None] * x, radius[:, None] * y, height[:, None])


def _fins() -> Mesh:
    """Return the side wall of one bay: upright slats that stand out more towards its middle."""
    slats = []
    for k in range(9):
        y = (k - 4) * 0.27
        out = 0.25 + 0.42 * np.cos(np.pi * (k - 4) / 10)
        slats.append(box((HALF - out, y - 0.035, 0.5), (HALF, y + 0.035, 4.4), bevel=0.01))
    return join(*slats, box((HALF - 0.85, -1.2, 0.0), (HALF, 1.2, 0.42), bevel=0.02))


def _portal(deep: float) -> Mesh:
    """Return nested frames before the far panel."""
    frames = []
    for k in range(4):
        half, high, y = 2.1 - 0.3 * k, 4.4 - 0.42 * k, deep - 0.5 - 0.35 * (3 - k) * 0.8
        t = 0.09
        frames += [
            box((-half - t, y - 0.1, 0.0), (-half, y + 0.1, high + t), bevel=0.015),
            box((half, y - 0.1, 0.0), (half + t, y + 0.1, high + t), bevel=0.015),
            box((-half, y - 0.1, high), (half, y + 0.1, high + t), bevel=0.015),
        ]
    return join(*frames)


# --- many lights ----------------------------------------------------------------------------------


def many_lights() -> Parts:
    """Return a terrace 7 m wide (x from -3.5 to 3.5) and 8 m deep (y), a brick wall at the back."""
    half, deep = 3.5, 8.0
    bricks = tiling(28, 42, size=(0.25, 0.08), gap=0.01, depth=0.008, stagger=0.5)
    upright = translate(-half, deep - 0.01, 0) @ rotate("x", 90)
    wires = [
        tube(_sag(0.9 + k * 0.9, np.linspace(-3.2, 3.2, 33), k), 0.006, segments=6)
        for k in range(8)
    ]
    panes = [quad((x, deep - 0.045, 0.95), (1.1, 0, 0), (0, 0, 1.2)) for x in (-2.7, 1.6)]
    tumbler = revolve(furniture.TUMBLER)
    return {
        "tiles": paving((-half, -2.0), (14, 20), 0.5),
        "mortar": quad((-half, -2.0, -0.001), (2 * half, 0, 0), (0, 10.0, 0)),
        "lawn": quad((-30.0, -10.0, -0.02), (60.0, 0, 0), (0, 40.0, 0)),
        "bricks": bricks.moved(upright),
        "joints": quad((-half, deep, 0), (2 * half, 0, 0), (0, 0, 3.36)),
        "panes": join(*panes),
        "frames": join(*(bar for x in (-2.7, 1.6) for bar in _window_bars(x, deep))),
        **furniture.door(translate(0.0, deep - 0.02, 0)),
        **_fence(half, deep),
        "pergola": _pergola(),
        "wires": join(*wires),
        **_lanterns(),
        **_tables(),
        **furniture.bowl(translate(0.55, 2.62, 0.73)),
        "vase": revolve(furniture.VASE).moved(translate(0.3, 2.38, 0.73)),
        "carafe": tumbler.moved(translate(0.78, 2.36, 0.73)),
        **_plants(),
    }


def _sag(y: float, x: Array, k: int) -> Array:
    """Return points on the k-th wire, which hangs lower in the middle."""
    depth = 0.38 + 0.12 * np.sin(2.1 * k)
    z = 2.92 - depth * (1 - (x / 3.2) ** 2)
    return np.stack([x, np.full_like(x, y), z], axis=-1)


def _window_bars(x: float, deep: float) -> list[Mesh]:
    """Return frame and glazing bars of a window whose left lower corner is at `x`."""
    y0, y1, z0, wide, high, bar = deep - 0.09, deep - 0.02, 0.95, 1.1, 1.2, 0.06
    upright = [
        box((x + s, y0, z0), (x + s + bar, y1, z0 + high), bevel=0.006)
        for s in (0.0, (wide - bar) / 2, wide - bar)
    ]
    level = [
        box((x - 0.03, y0 - 0.02, z0 + s), (x + wide + 0.03, y1, z0 + s + bar), bevel=0.006)
        for s in (-bar, high)
    ]
    return [*upright, *level]


def _fence(half: float, deep: float) -> Parts:
    """Return pales at the right of the house, and a hedge behind them."""
    pales = [
        box((x, deep - 0.03, 0.05), (x + 0.09, deep, 1.0 + 0.08 * (k % 2)), bevel=0.008)
        for k, x in enumerate(np.arange(half + 0.05, 9.0, 0.14).round(6).tolist())
    ]
    rails = [box((half, deep, z), (9.2, deep + 0.03, z + 0.07)) for z in (0.25, 0.75)]
    hedge = box((half - 1.0, deep + 1.2, 0.0), (14.0, deep + 2.0, 1.9), bevel=0.3)
    return {"fence": join(*pales, *rails), "hedge": hedge}


def _pergola() -> Mesh:
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
    return join(*posts, *beams)


def _lanterns() -> Parts:
    """Return paper globes on the ground along the wall."""
    turn = np.linspace(-1.2, 1.2, 15)
    profile = np.column_stack([0.15 * np.cos(turn), 0.15 + 0.15 * np.sin(turn) / np.sin(1.2)])
    globe = revolve(profile, segments=32, crease=180.0)
    places = ((-2.9, 7.4), (-0.75, 7.5), (0.8, 7.5), (2.9, 7.3))
    return {f"lantern-{i}": globe.moved(translate(x, y, 0.02)) for i, (x, y) in enumerate(places)}


def _tables() -> Parts:
    """Return two tables and their chairs."""
    top = revolve([(0, 0.7), (0.54, 0.7), (0.55, 0.715), (0.54, 0.73), (0, 0.73)], segments=64)
    foot = revolve([(0, 0), (0.26, 0), (0.26, 0.02), (0.03, 0.05), (0.03, 0.7), (0, 0.7)])
    spots, chair = ((0.55, 2.5), (-1.35, 5.1)), _chair()
    chairs = [
        chair.moved(translate(x + dx, y + dy, 0) @ rotate("z", turn))
        for x, y in spots
        for dx, dy, turn in ((0.62, 0.3, -65), (-0.62, 0.35, 60))
    ]
    return {
        "table-tops": join(*(top.moved(translate(x, y, 0)) for x, y in spots)),
        "table-feet": join(*(foot.moved(translate(x, y, 0)) for x, y in spots)),
        "chairs": join(*chairs),
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
    return join(*seat, *back, *legs, box((-0.24, 0.19, 0.88), (0.24, 0.23, 0.96)))


def _plants() -> Parts:
    """Return three big pots of plants."""
    parts = {}
    for i, (x, y, size) in enumerate(((2.5, 4.6, 2.6), (-2.7, 3.0, 2.4), (2.6, 1.6, 2.2))):
        grown = furniture.plant(translate(x, y, 0) @ np.diag([size, size, size, 1.0]))
        parts |= {f"{name}-{i}": mesh for name, mesh in grown.items()}
    return parts


# --- file -----------------------------------------------------------------------------------------

SCENES = (bathroom, caustic, cornell_box, fog, gallery, living_room, many_lights)


def made() -> dict[str, Array]:
    """Return all arrays by their names."""
    arrays = dict(images())
    for scene in SCENES:
        for part, mesh in scene().items():
            name = f"{scene.__name__.replace('_', '-')}/{part}"
            arrays |= {f"{name}.{kind}": values for kind, values in mesh.arrays().items()}
    return dict(sorted(arrays.items()))


def main(path: Path) -> None:
    """Write all arrays to one file."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, values in made().items():
            content = io.BytesIO()
            np.save(content, np.ascontiguousarray(values))
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue(), zipfile.ZIP_LZMA)


if __name__ == "__main__":
    here = Path(__file__).parent.parent / "chdstat/scenes/builtin/arrays.npz"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else here)
