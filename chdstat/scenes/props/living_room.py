"""Walls and windows of rooms, and the living room that the day and the night share.

The living room is 5.0 m wide (x), 6.2 m deep (y) and 2.75 m high (z). Three tall windows are in the
left wall, the sofa and the shelf at the back, a dark red carpet in the middle, the camera at the
front. What is outside the windows, and what burns inside, the scenes add.

A function that returns furniture takes the matrix that places the piece, as in
`chdstat.scenes.props.furniture`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from chdstat.scenes.props import furniture, textures
from chdstat.scenes.props.furniture import Matrix, camera, lamp
from chdstat.scenes.props.shapes import (
    Mesh,
    ball,
    box,
    join,
    loft,
    quad,
    revolve,
    rounded_rectangle,
    sheet,
    tube,
)
from chdstat.scenes.props.textures import Entry, glossy, matte, metal, rgb, translucent, walnut
from chdstat.scenes.scene import rotate, translate

__all__ = ["bowl", "living_room", "walls", "window_frame"]

Span = tuple[float, float]

_BRASS = metal("Au", roughness=0.25)
_BOWL = [
    *[(0.0, 0.0), (0.05, 0.0), (0.06, 0.012), (0.13, 0.06), (0.155, 0.1)],
    *[(0.15, 0.1), (0.125, 0.065), (0.055, 0.02), (0.0, 0.016)],
]
_JAR = [
    *[(0.0, 0.0), (0.06, 0.0), (0.1, 0.05), (0.115, 0.12), (0.1, 0.19), (0.05, 0.25)],
    *[(0.03, 0.27), (0.0, 0.27)],
]

_SPINES = (
    *[(0.55, 0.08, 0.05), (0.72, 0.62, 0.45), (0.05, 0.13, 0.24), (0.09, 0.24, 0.14)],
    *[(0.62, 0.36, 0.07), (0.03, 0.03, 0.035), (0.78, 0.76, 0.71), (0.30, 0.06, 0.10)],
)
"""Colours of the books."""


def pad(width: float, depth: float, height: float, *, radius: float) -> Mesh:
    """Return a soft-edged block that stands on the origin; no side is under 3.2 radii."""
    turn = np.linspace(-np.pi / 2, 0, 6)
    inset, rise = radius * (1 - np.cos(turn)), radius * (1 + np.sin(turn))
    outlines = [
        rounded_rectangle(width - 2 * i, depth - 2 * i, 1.6 * radius - i)
        for i in (*inset, *inset[::-1])
    ]
    return loft(outlines, [*rise, *(height - rise[::-1])], crease=60.0)


# --- rooms ----------------------------------------------------------------------------------------


def walls(
    size: tuple[float, float, float], windows: Sequence[Span], height: Span, *, reveal: float
) -> list[Mesh]:
    """Return ceiling and walls of a room with windows at its left, and the sides of the openings.

    The left wall has an outside, which reaches beyond the room: a path that bounces in a corner of
    the room, closer than rounding to the inside, would slip through a wall without thickness.

    Parameters
    ----------
    size
        Width, depth and height of the room, in metres.
    windows
        Where each window begins and ends along y, in metres.
    height
        Where the windows begin and end along z, in metres.
    reveal
        Thickness of the left wall, in metres.
    """
    wide, deep, high = size
    sill, head = height
    pieces = [
        quad((0, deep, high), (wide, 0, 0), (0, -deep, 0)),
        quad((0, deep, 0), (wide, 0, 0), (0, 0, high)),
        quad((wide, 0, 0), (-wide, 0, 0), (0, 0, high)),
        quad((wide, deep, 0), (0, -deep, 0), (0, 0, high)),
    ]
    for x, beyond in ((0.0, 0.0), (-reveal, 1.0)):
        low, top = -beyond, high + beyond
        edges = [low, *(y for window in windows for y in window), deep + beyond]
        parts = [(a, b, low, top) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        for y0, y1 in windows:
            parts += [(y0, y1, low, sill), (y0, y1, head, top)]
        pieces += [quad((x, a, c), (0, b - a, 0), (0, 0, d - c)) for a, b, c, d in parts]
    for y0, y1 in windows:
        along, up, out = (0, y1 - y0, 0), (0, 0, head - sill), (-reveal, 0, 0)
        pieces += [
            quad((-reveal, y0, sill), (reveal, 0, 0), along),
            quad((0, y0, head), out, along),
            quad((0, y0, sill), out, up),
            quad((-reveal, y1, sill), (reveal, 0, 0), up),
        ]
    return pieces


def window_frame(
    window: Span, height: Span, *, reveal: float, bar: float, middle: float
) -> list[Mesh]:
    """Return the frame of a window in `walls`, `bar` wide, with a glazing bar `middle` wide.

    The frame reaches into the wall on all sides.
    """
    (y0, y1), (z0, z1) = window, height
    x0, x1, into, centre = 0.02 - reveal, 0.07 - reveal, 0.01, (y0 + y1) / 2
    bars = [
        (y0 - into, y0 + bar, z0 - into, z1 + into),
        (y1 - bar, y1 + into, z0 - into, z1 + into),
        (y0 + bar, y1 - bar, z0 - into, z0 + bar),
        (y0 + bar, y1 - bar, z1 - bar, z1 + into),
        (centre - middle / 2, centre + middle / 2, z0 + bar, z1 - bar),
    ]
    return [box((x0, a, c), (x1, b, d), bevel=0.005) for a, b, c, d in bars]


# --- seats ----------------------------------------------------------------------------------------


def _sofa(place: Matrix) -> Entry:
    """Return a green sofa for three, 2.1 m wide, with three scatter cushions."""
    across = (-0.6, 0.0, 0.6)
    seat, back = pad(0.59, 0.68, 0.17, radius=0.05), pad(0.59, 0.44, 0.17, radius=0.06)
    arm, cushion = pad(0.17, 0.92, 0.52, radius=0.06), pad(0.4, 0.4, 0.13, radius=0.06)
    parts = [
        *[seat.moved(translate(x, -0.57, 0.27)) for x in across],
        *[back.moved(translate(x, -0.12, 0.62) @ rotate("x", 78)) for x in across],
        pad(1.86, 0.86, 0.2, radius=0.03).moved(translate(0, -0.45, 0.09)),
        pad(2.1, 0.16, 0.74, radius=0.06).moved(translate(0, -0.08, 0.09)),
        *[arm.moved(translate(x, -0.46, 0.09)) for x in (-1, 1)],
    ]
    entries = {
        "sofa": join(*parts).moved(place).shape(matte(rgb(0.10, 0.22, 0.13))),
        "sofa-feet": _feet(0.9, 0.75, 0.1).moved(place @ translate(0, -0.45, 0)).shape(walnut(3)),
    }
    cushions = (
        (-0.7, 12, rgb(0.62, 0.36, 0.07)),
        (0.66, -14, rgb(0.76, 0.72, 0.64)),
        (0.36, 9, rgb(0.5, 0.06, 0.04)),
    )
    for i, (x, turn, color) in enumerate(cushions):
        standing = translate(x, -0.36, 0.64) @ rotate("z", turn) @ rotate("x", 68)
        leaning = cushion.moved(standing @ translate(0, 0, -0.03)).moved(place)
        entries[f"cushion-{i}"] = leaning.shape(matte(color))
    return entries


def _armchair(place: Matrix) -> Entry:
    """Return a deep chair on turned feet."""
    arm, feet = pad(0.13, 0.78, 0.46, radius=0.055), place @ translate(0, -0.4, 0)
    parts = [
        pad(0.56, 0.62, 0.18, radius=0.06).moved(translate(0, -0.42, 0.27)),
        pad(0.56, 0.5, 0.16, radius=0.06).moved(translate(0, -0.13, 0.6) @ rotate("x", 74)),
        pad(0.72, 0.76, 0.18, radius=0.04).moved(translate(0, -0.4, 0.12)),
        pad(0.74, 0.14, 0.78, radius=0.06).moved(translate(0, -0.06, 0.12) @ rotate("x", -6)),
        *[arm.moved(translate(x, -0.4, 0.12)) for x in (-0.37, 0.37)],
    ]
    return {
        "armchair": join(*parts).moved(place).shape(matte(rgb(0.55, 0.44, 0.32))),
        "armchair-feet": _feet(0.3, 0.6, 0.13).moved(feet).shape(walnut(3)),
    }


def _feet(half: float, depth: float, height: float) -> Mesh:
    """Return four turned feet under the corners of a piece."""
    foot = revolve([(0, 0), (0.018, 0), (0.028, height), (0, height)], segments=16)
    corners = [(x, y) for x in (-half, half) for y in (-depth / 2, depth / 2)]
    return join(*(foot.moved(translate(x, y, 0)) for x, y in corners))


# --- tables and shelves ---------------------------------------------------------------------------


def _coffee_table(place: Matrix) -> Entry:
    """Return a long low table of walnut under a clear coat, on brass legs."""
    top = box((-0.6, -0.32, 0.36), (0.6, 0.32, 0.4), bevel=0.006)
    leg = np.array([(0.52, 0.25, 0.37), (0.55, 0.275, 0.18), (0.57, 0.29, 0)])
    legs = [tube(leg * (i, j, 1), 0.012) for i in (-1, 1) for j in (-1, 1)]
    return {
        "table": top.mapped(scale=(0.8, 1.6)).moved(place).shape(walnut(7, roughness=0.1)),
        "table-legs": join(*legs).moved(place).shape(_BRASS),
    }


def _side_table(place: Matrix) -> Entry:
    """Return a round table of lacquer, 0.55 m high."""
    top = revolve([(0, 0.52), (0.23, 0.52), (0.24, 0.535), (0.23, 0.55), (0, 0.55)])
    stem = revolve([(0, 0), (0.15, 0), (0.15, 0.012), (0.016, 0.03), (0.016, 0.52), (0, 0.52)])
    lacquer = glossy(rgb(0.035, 0.035, 0.04), roughness=0.1)
    return {
        "side-table": top.moved(place).shape(lacquer),
        "side-table-stem": stem.moved(place).shape(_BRASS),
    }


def _bookshelf(place: Matrix) -> Entry:
    """Return an open shelf full of books over a fireplace, 0.38 m a storey, with a jar on it."""
    rng = np.random.default_rng(4)
    half, first, shelves, storey, depth, top = 0.5, 2, 5, 0.38, 0.3, 1.96
    boards = [
        box((-half, -depth, z), (half, -0.012, z + 0.025), bevel=0.002)
        for z in 0.05 + storey * np.arange(first, shelves + 1)
    ]
    sides = [
        box((a, -depth, 0), (a + 0.025, -0.012, top + 0.05), bevel=0.002, grain="z")
        for a in (-half - 0.025, half)
    ]
    back = box((-half, -0.012, 0), (half, 0.0, top + 0.05))
    books = [
        book.moved(translate(-half, -0.02, 0.075 + k * storey))
        for k in range(first, shelves)
        for book in _books(rng, 0.62 if k == first else 1.0)
    ]
    jar = revolve(_JAR).moved(translate(half - 0.17, -0.16, first * storey + 0.075))
    spines = textures.bitmap(textures.panes([_SPINES]), sharp=True)
    return {
        "shelf": join(*boards, *sides, back).moved(place).shape(walnut(2)),
        "books": join(*books).moved(place).shape(matte(spines)),
        "jar": jar.moved(place).shape(glossy(rgb(0.06, 0.2, 0.25), roughness=0.06)),
        **_fireplace(place, width=2 * half, height=0.05 + first * storey),
    }


def _fireplace(place: Matrix, *, width: float, height: float) -> Entry:
    """Return an open fireplace, swept and unlit: a stone surround, a sooty firebox, three logs."""
    a, b, sill, lintel = width / 2, width / 2 - 0.13, 0.05, height - 0.16
    surround = [
        box((-a, -0.42, 0), (a, -0.03, sill), bevel=0.006),
        box((-a, -0.33, lintel), (a, -0.03, height), bevel=0.006),
        *[box((min(s * a, s * b), -0.33, sill), (max(s * a, s * b), -0.03, lintel), bevel=0.006)
          for s in (-1, 1)],
    ]  # fmt: skip
    lining = box((-b, -0.03, sill), (b, -0.014, lintel))
    ends = [(-0.24, -0.2, 0.1), (0.2, -0.13, 0.1)], [(-0.2, -0.1, 0.1), (0.24, -0.21, 0.1)]
    logs = [
        tube(np.array(log), 0.045) for log in (*ends, [(-0.22, -0.15, 0.18), (0.2, -0.17, 0.18)])
    ]
    return {
        "fireplace": join(*surround)
        .moved(place)
        .shape(glossy(rgb(0.5, 0.47, 0.43), roughness=0.3)),
        "firebox": lining.moved(place).shape(matte(rgb(0.05, 0.04, 0.035))),
        "logs": join(*logs).moved(place).shape(matte(rgb(0.3, 0.21, 0.13))),
    }


def _books(rng: np.random.Generator, length: float) -> list[Mesh]:
    """Return a row of books from the origin along +x; each shows one pane of the palette."""
    books, x = [], 0.0
    while (x := x + 0.003) < length - 0.05:
        thick = 0.018 + 0.03 * rng.random()
        book = box((x, -0.17 - 0.05 * rng.random(), 0), (x + thick, 0, 0.2 + 0.11 * rng.random()))
        pane = (rng.integers(len(_SPINES)) + 0.5) / len(_SPINES)
        books.append(replace(book, uv=np.full_like(book.uv, 0.5) * [2 * pane, 1.0]))
        x += thick
    return books


# --- small pieces ---------------------------------------------------------------------------------


def _painting(place: Matrix) -> Entry:
    """Return an image of coloured panes, 0.4 m each, in a thin frame about its origin."""
    high, wide = 0.4 * len(_IMAGE), 0.4 * len(_IMAGE[0])
    canvas = quad((-wide / 2, -0.03, -high / 2), (wide, 0, 0), (0, 0, high))
    canvas = canvas.mapped(scale=(1 / wide, 1 / high))
    a, b = wide / 2, high / 2
    frame = [
        box((-a - 0.025, -0.04, s * b - 0.012), (a + 0.025, 0.0, s * b + 0.012)) for s in (-1, 1)
    ] + [box((s * a - 0.012, -0.04, -b), (s * a + 0.012, 0.0, b)) for s in (-1, 1)]
    image = textures.bitmap(textures.panes(_IMAGE), sharp=True)
    black = glossy(rgb(0.03, 0.03, 0.03), roughness=0.2)
    return {
        "painting": canvas.moved(place).shape(matte(image)),
        "painting-frame": join(*frame).moved(place).shape(black),
    }


def bowl(place: Matrix, *, color: Entry) -> Entry:
    """Return a glazed bowl with three fruits in it."""
    orange = ball(0.042, segments=24)
    spots = [(0.045, 0.02, 0.07), (-0.04, 0.035, 0.07), (-0.005, -0.045, 0.075)]
    fruit = join(*(orange.moved(translate(*spot)) for spot in spots))
    return {
        "bowl": revolve(_BOWL).moved(place).shape(glossy(color, roughness=0.05)),
        "fruit": fruit.moved(place).shape(glossy(rgb(0.62, 0.22, 0.03), roughness=0.25)),
    }


_WIDTH, _DEPTH, _HEIGHT = 5.0, 6.2, 2.75
_OPEN, _REVEAL = (0.45, 2.4), 0.18

WINDOWS = ((2.12, 3.18), (3.42, 4.48), (4.72, 5.78))
"""Where each window begins and ends along y, in metres."""

_PLASTER = matte(rgb(0.87, 0.85, 0.81))
_LACQUER = glossy(rgb(0.78, 0.77, 0.74), roughness=0.15)

_RED, _CREAM, _BLACK = (0.5, 0.05, 0.035), (0.80, 0.77, 0.68), (0.03, 0.03, 0.03)
_OCHRE, _TEAL, _ROSE = (0.6, 0.34, 0.06), (0.04, 0.2, 0.22), (0.62, 0.3, 0.25)
_IMAGE = (
    (_RED, _BLACK, _CREAM, _TEAL),
    (_CREAM, _OCHRE, _BLACK, _CREAM),
    (_BLACK, _CREAM, _ROSE, _RED),
)
"""Panes from a twenty-fifth to four fifths of reflectance, side by side under the same light."""


def living_room(*, bulb: Entry | None) -> Entry:
    """Return all but the integrator and the outside; the lamps burn with `bulb`, or not at all."""
    return {
        "sensor": camera((4.6, 0.3, 1.6), (1.45, 5.0, 0.95), fov=60.0),
        **_shell(),
        **_furniture(bulb),
        **_small_things(),
    }


def _shell() -> Entry:
    boards = textures.planks((0.28, 0.17, 0.09), (0.6, 0.41, 0.25), seed=8)
    floor = quad((0, 0, 0), (_WIDTH, 0, 0), (0, _DEPTH, 0)).mapped(scale=(1 / 1.8, 1 / 0.9))
    shell = walls((_WIDTH, _DEPTH, _HEIGHT), WINDOWS, _OPEN, reveal=_REVEAL)
    skirting = [
        box((0.015, _DEPTH - 0.015, 0), (_WIDTH, _DEPTH, 0.11), bevel=0.004),
        box((0, 0, 0), (0.015, _DEPTH, 0.11), bevel=0.004),
    ]
    cornice = [
        box((0, _DEPTH - 0.09, _HEIGHT - 0.07), (_WIDTH, _DEPTH, _HEIGHT), bevel=0.02),
        box((0, 0, _HEIGHT - 0.07), (0.09, _DEPTH - 0.09, _HEIGHT), bevel=0.02),
    ]
    # Frames with a cross of glazing bars, and sills.
    (z0, z1), bar = _OPEN, 0.05
    x0, x1, transom = 0.02 - _REVEAL, 0.07 - _REVEAL, z1 - 0.6
    windows = []
    for y0, y1 in WINDOWS:
        middle = (y0 + y1) / 2
        windows += [
            *window_frame((y0, y1), _OPEN, reveal=_REVEAL, bar=bar, middle=0.04),
            box((x0, y0 + bar, transom), (x1, middle - 0.02, transom + 0.04), bevel=0.005),
            box((x0, middle + 0.02, transom), (x1, y1 - bar, transom + 0.04), bevel=0.005),
            box((-_REVEAL, y0 - 0.05, z0 - 0.03), (0.1, y1 + 0.05, z0 + 0.012), bevel=0.006),
        ]
    return {
        "floor": floor.shape(glossy(textures.bitmap(boards), roughness=0.2)),
        "walls": join(*shell).shape(_PLASTER),
        "skirting": join(*skirting, *cornice).shape(_LACQUER),
        "windows": join(*windows).shape(_LACQUER),
    }


def _furniture(bulb: Entry | None) -> Entry:
    warm, rose = rgb(0.9, 0.72, 0.5), rgb(0.9, 0.5, 0.35)
    carpet = box((1.15, 2.6, 0.0), (3.75, 4.85, 0.016), bevel=0.006)
    pile = matte(rgb(0.30, 0.028, 0.022))
    return {
        "carpet": carpet.shape(pile),
        **_sofa(translate(2.2, _DEPTH - 0.12, 0)),
        **_armchair(translate(0.62, 3.15, 0) @ rotate("z", 62)),
        **_coffee_table(translate(2.45, 3.95, 0.016)),
        **_bookshelf(translate(4.2, _DEPTH, 0)),
        **_painting(translate(1.75, _DEPTH, 1.76)),
        **furniture.mirror(translate(3.15, _DEPTH - 0.02, 1.72), radius=0.36),
        **lamp(translate(0.55, 5.6, 0), "floor-lamp", height=1.62, shade=warm, light=bulb),
        **_side_table(translate(3.5, 5.6, 0)),
        **lamp(translate(3.5, 5.6, 0.55), "table-lamp", height=0.55, shade=rose, light=bulb),
    }


def _small_things() -> Entry:
    table = 0.416
    # Cloth in folds, which spread towards the floor.
    x, z = np.linspace(-0.15, 0.15, 70), np.linspace(-2.5, 0, 6)[:, None]
    fall = 0.6 + 0.4 * (-z / 2.5)
    fold = fall * (0.045 * np.sin(2 * np.pi * x / 0.13) + 0.012 * np.sin(37 * x + 1.0))
    curtain = sheet(x, fold, z).moved(rotate("z", 90))
    cloth = translucent(rgb(0.55, 0.07, 0.05), through=0.25)
    curtains = {
        f"curtain-{i}": curtain.moved(translate(0.09, y, 2.55)).shape(cloth)
        for i, y in enumerate((1.98, 3.3, 4.6, 5.92))
    }
    books = join(
        box((2.62, 3.8, table), (2.84, 4.12, table + 0.03), bevel=0.003),
        box((2.64, 3.84, table + 0.03), (2.84, 4.1, table + 0.055), bevel=0.003),
    )
    return {
        **curtains,
        **bowl(translate(2.15, 3.98, table), color=rgb(0.75, 0.74, 0.7)),
        **furniture.vase(translate(2.5, 4.08, table)),
        **furniture.plant(translate(-0.06, 3.95, _OPEN[0] + 0.012)),
        "table-books": books.shape(matte(rgb(0.08, 0.16, 0.3))),
    }
