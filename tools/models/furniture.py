"""Furniture of the built-in scenes: meshes by name.

A piece takes the matrix that places it: it stands on, or hangs at, its own origin with its back
towards +y. Lengths are metres. Materials and lights stand in the scenes' own files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from models.shapes import (
    Array,
    Mesh,
    ball,
    box,
    join,
    loft,
    quad,
    revolve,
    ring,
    rotate,
    rounded_rectangle,
    sheet,
    tiles,
    translate,
    tube,
)

Parts = dict[str, Mesh]
Span = tuple[float, float]

# Profiles are (radius, height): up the outside, then down the inside.
BASIN = [
    *[(0.0, 0.0), (0.11, 0.0), (0.135, 0.012), (0.18, 0.06), (0.208, 0.115), (0.212, 0.135)],
    *[(0.207, 0.140), (0.2, 0.135), (0.185, 0.1), (0.15, 0.055), (0.1, 0.03), (0.0, 0.024)],
]
BASKET = [
    *[(0.0, 0.0), (0.15, 0.0), (0.19, 0.2), (0.205, 0.46)],
    *[(0.195, 0.46), (0.18, 0.2), (0.14, 0.02), (0.0, 0.02)],
]
BOWL = [
    *[(0.0, 0.0), (0.05, 0.0), (0.06, 0.012), (0.13, 0.06), (0.155, 0.1)],
    *[(0.15, 0.1), (0.125, 0.065), (0.055, 0.02), (0.0, 0.016)],
]
DISPENSER = [
    *[(0.0, 0.0), (0.034, 0.0), (0.037, 0.004), (0.037, 0.11), (0.03, 0.126), (0.013, 0.134)],
    *[(0.013, 0.15), (0.0, 0.15)],
]
JAR = [
    *[(0.0, 0.0), (0.06, 0.0), (0.1, 0.05), (0.115, 0.12), (0.1, 0.19), (0.05, 0.25)],
    *[(0.03, 0.27), (0.0, 0.27)],
]
LAMP_FOOT = [(0.0, 0.0), (0.14, 0.0), (0.14, 0.012), (0.02, 0.028), (0.0, 0.028)]
POT = [(0.0, 0.0), (0.05, 0.0), (0.066, 0.12), (0.06, 0.12), (0.058, 0.105), (0.0, 0.105)]
TUMBLER = [(0.0, 0.0), (0.034, 0.0), (0.038, 0.1), (0.035, 0.1), (0.031, 0.006), (0.0, 0.006)]
VASE = [
    *[(0.0, 0.0), (0.04, 0.0), (0.052, 0.03), (0.05, 0.08), (0.022, 0.13), (0.026, 0.16)],
    *[(0.0225, 0.16), (0.0185, 0.13), (0.046, 0.08), (0.048, 0.03), (0.036, 0.008), (0.0, 0.008)],
]

# Width, length, corner radius and height of a tub's outlines: up the outside, down the inside.
TUB = [
    *[(0.50, 1.34, 0.22, 0.0), (0.54, 1.40, 0.25, 0.02), (0.62, 1.52, 0.29, 0.20)],
    *[(0.70, 1.62, 0.33, 0.42), (0.75, 1.68, 0.36, 0.545), (0.78, 1.71, 0.375, 0.565)],
    *[(0.78, 1.71, 0.375, 0.575), (0.76, 1.69, 0.365, 0.585), (0.70, 1.63, 0.335, 0.585)],
    *[(0.675, 1.605, 0.325, 0.57), (0.62, 1.52, 0.30, 0.42), (0.54, 1.36, 0.26, 0.22)],
    *[(0.44, 1.20, 0.21, 0.15), (0.30, 1.00, 0.14, 0.135)],
]


def placed(parts: Parts, place: Array) -> Parts:
    """Return all parts of a piece where a matrix places them."""
    return {name: mesh.moved(place) for name, mesh in parts.items()}


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
) -> Mesh:
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
    return join(*pieces)


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


def paving(corner: Span, fields: tuple[int, int], edge: float) -> Mesh:
    """Return square slabs with open joints on z = 0: their corner, numbers along x and y, edge."""
    slabs = tiles(*fields, size=(edge, edge), gap=0.024 * edge, depth=0.008 * edge)
    return slabs.moved(translate(*corner, 0.0))


def door(place: Array) -> Parts:
    """Return a door, 0.8 m by 2.05 m, closed in the wall at its back."""
    leaf = box((-0.4, -0.03, 0), (0.4, 0.05, 2.05), bevel=0.008, grain="z")
    knob = ball(0.03).moved(translate(-0.32, -0.07, 1.02))
    return placed({"door": leaf.mapped(scale=(0.5, 2.0)), "door-knob": knob}, place)


def mirror_frame(radius: float) -> Mesh:
    """Return the frame of a round mirror about its origin that faces -y."""
    frame = ring(radius, 0.0, wire=(0.012, 0.016), sides=16, segments=96)
    return frame.moved(rotate("x", 90))


# --- bathroom -------------------------------------------------------------------------------------


def vanity(place: Array) -> Parts:
    """Return a hanging cabinet with two drawers, a vessel basin and its tap."""
    half, front, low, top = 0.57, -0.52, 0.46, 0.84
    drawers = [
        box((a, front - 0.02, low), (b, front, top - 0.012), bevel=0.003)
        for a, b in ((-half, -0.003), (0.003, half))
    ]
    body = box((0.004 - half, front, low + 0.002), (half - 0.004, 0.0, top), bevel=0.002)
    handles = [
        tube([(x + dx, front - 0.045, 0.71) for dx in (-0.11, 0.0, 0.11)], 0.007, segments=12)
        for x in (-half / 2, half / 2)
    ]
    parts = {
        "vanity": join(body, *drawers).mapped(scale=(0.8, 2.2)),
        "vanity-top": box(
            (-half - 0.015, front - 0.035, top), (half + 0.015, 0.0, top + 0.03), bevel=0.005
        ),
        "vanity-handles": join(*handles),
        "basin": revolve(BASIN, crease=70.0).moved(translate(0, -0.28, top + 0.03)),
        "tap": _swan_neck().moved(translate(0, -0.06, top + 0.03)),
    }
    return placed(parts, place)


def _swan_neck() -> Mesh:
    """Return a tap that stands at the origin and pours towards -y."""
    turn = np.linspace(0, np.pi, 13)
    arc = np.column_stack([0 * turn, 0.07 * np.cos(turn) - 0.07, 0.27 + 0.07 * np.sin(turn)])
    path = np.concatenate([[(0, 0, 0), (0, 0, 0.1), (0, 0, 0.2)], arc, [(0, -0.14, 0.22)]])
    foot = revolve([(0, 0), (0.028, 0), (0.028, 0.012), (0.016, 0.02), (0, 0.02)])
    lever = tube([(0.0, 0, 0.075), (0.03, 0, 0.078), (0.075, 0, 0.085)], 0.006)
    return join(tube(path, 0.014), foot, lever)


def tub(place: Array) -> Parts:
    """Return a free-standing tub that lies along y."""
    outlines = [rounded_rectangle(width, length, radius) for width, length, radius, _ in TUB]
    return {"tub": loft(outlines, [height for *_, height in TUB], crease=60.0).moved(place)}


def tub_tap(place: Array) -> Parts:
    """Return a spout between two knobs, on a wall."""
    spout = tube(
        [(0, 0, 0), (0, -0.13, 0), (0, -0.17, -0.005), (0, -0.195, -0.03), (0, -0.2, -0.08)], 0.017
    )
    knobs = [tube([(x, 0, 0), (x, -0.03, 0), (x, -0.05, 0)], 0.026) for x in (-0.13, 0.13)]
    return {"tub-tap": join(spout, *knobs).moved(place)}


def towel_rail(place: Array) -> Parts:
    """Return a rail with a towel, 0.08 m in front of the wall."""
    rail = tube([(-0.3, 0, 0), (0.0, 0, 0), (0.3, 0, 0)], 0.009).moved(translate(0, -0.08, 0))
    arms = [tube([(x, -0.08, 0), (x, -0.04, 0), (x, 0, 0)], 0.007) for x in (-0.28, 0.28)]
    return {
        "towel-rail": join(rail, *arms).moved(place),
        "towel": hanging(0.44, front=0.62, back=0.45).moved(place @ translate(0, -0.08, 0)),
    }


def hanging(width: float, *, front: float, back: float) -> Mesh:
    """Return cloth over a bar along x at the origin, with soft folds in its front."""
    radius, bend = 0.014, np.linspace(0, np.pi, 9)[1:-1]
    profile = np.concatenate(
        [
            [(-radius, z) for z in np.linspace(-front, 0, 24)],
            radius * np.column_stack([-np.cos(bend), np.sin(bend)]),
            [(radius, z) for z in np.linspace(0, -back, 12)],
        ]
    )
    y, z = profile[:, :1], profile[:, 1:]
    x = np.linspace(-width / 2, width / 2, 60)
    fall = np.clip(-z / front, 0, 1)
    wave = np.sin(2 * np.pi * 3.2 * x / width + 0.6) + 0.4 * np.sin(61 * x)
    fold = np.where(y < 0, 0.013 * fall**0.6 * wave - 0.008 * fall, 0)
    narrowed = x * (1 - 0.05 * fall)
    return sheet(narrowed, y + fold, z)


def dispenser(place: Array) -> Parts:
    """Return a soap dispenser with a pump."""
    pump = tube([(0, 0, 0.15), (0, 0, 0.185), (-0.003, -0.005, 0.19), (-0.03, -0.03, 0.19)], 0.005)
    return placed({"dispenser": revolve(DISPENSER), "dispenser-pump": pump}, place)


def wall_lamp(place: Array, *, name: str) -> Parts:
    """Return a globe on an arm."""
    plate = tube([(0, 0, -0.09), (0, -0.006, -0.09), (0, -0.012, -0.09)], 0.035)
    bend = [(0, 0, -0.09), (0, -0.09, -0.09), (0, -0.12, -0.085), (0, -0.13, -0.06)]
    globe = ball(0.075).moved(translate(0, -0.13, 0))
    return placed({f"{name}-globe": globe, f"{name}-arm": join(plate, tube(bend, 0.008))}, place)


# --- small pieces ---------------------------------------------------------------------------------


def plant(place: Array) -> Parts:
    """Return a leafy plant in a pot."""
    rng = np.random.default_rng(11)
    lengths, lifts = 0.17 + 0.1 * rng.random(18), np.linspace(80, 25, 18)
    turns = 137.5 * np.arange(18) + 20 * rng.random(18)
    leaves = [
        _leaf(length, lift).moved(rotate("z", turn) @ translate(0.012, 0, 0.1))
        for length, lift, turn in zip(lengths, lifts, turns, strict=True)
    ]
    return placed({"plant-pot": revolve(POT), "plant": join(*leaves)}, place)


def _leaf(length: float, lift: float) -> Mesh:
    """Return a leaf that grows from the origin towards +x, rises by `lift` degrees and droops."""
    along = np.linspace(0, 1, 9)[:, None]
    across = np.array([-1.0, 0.0, 1.0])
    angle = np.deg2rad(lift - 65 * along)
    step = length / 8 * np.concatenate([[[0.0]], np.ones((8, 1))])
    half = 0.13 * length * np.sin(np.pi * along**0.7) ** 0.8 + 0.002
    x = np.cumsum(step * np.cos(angle), axis=0)
    z = np.cumsum(step * np.sin(angle), axis=0)
    # Folded a little along the midrib.
    return sheet(x, half * across, z + 0.35 * half * np.abs(across))


def bowl(place: Array) -> Parts:
    """Return a bowl with three fruits in it."""
    orange = ball(0.042, segments=24)
    spots = [(0.045, 0.02, 0.07), (-0.04, 0.035, 0.07), (-0.005, -0.045, 0.075)]
    fruit = join(*(orange.moved(translate(*spot)) for spot in spots))
    return placed({"bowl": revolve(BOWL), "fruit": fruit}, place)


def lamp(place: Array, name: str, *, height: float) -> Parts:
    """Return a standing lamp; the shade, open at both ends, has its upper rim at `height`."""
    wide, narrow, low = 0.2, 0.14, height - 0.28
    rims = ((wide, low), (narrow, height))
    stem = revolve([(0, 0.02), (0.011, 0.02), (0.011, low + 0.04), (0, low + 0.04)], segments=16)
    wires = [ring(*rim, wire=(0.004, 0.004), sides=8) for rim in rims]
    parts = {
        f"{name}-shade": revolve(np.linspace(*rims, 3), crease=180.0),
        f"{name}-foot": join(revolve(LAMP_FOOT), stem, *wires),
    }
    return placed(parts, place)


# --- living room ----------------------------------------------------------------------------------


def sofa(place: Array) -> Parts:
    """Return a sofa for three, 2.1 m wide, with three scatter cushions."""
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
    meshes = {
        "sofa": join(*parts).moved(place),
        "sofa-feet": _feet(0.9, 0.75, 0.1).moved(place @ translate(0, -0.45, 0)),
    }
    for i, (x, turn) in enumerate(((-0.7, 12), (0.66, -14), (0.36, 9))):
        standing = translate(x, -0.36, 0.64) @ rotate("z", turn) @ rotate("x", 68)
        meshes[f"cushion-{i}"] = cushion.moved(standing @ translate(0, 0, -0.03)).moved(place)
    return meshes


def armchair(place: Array) -> Parts:
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
        "armchair": join(*parts).moved(place),
        "armchair-feet": _feet(0.3, 0.6, 0.13).moved(feet),
    }


def _feet(half: float, depth: float, height: float) -> Mesh:
    """Return four turned feet under the corners of a piece."""
    foot = revolve([(0, 0), (0.018, 0), (0.028, height), (0, height)], segments=16)
    corners = [(x, y) for x in (-half, half) for y in (-depth / 2, depth / 2)]
    return join(*(foot.moved(translate(x, y, 0)) for x, y in corners))


def coffee_table(place: Array) -> Parts:
    """Return a long low table on thin legs."""
    top = box((-0.6, -0.32, 0.36), (0.6, 0.32, 0.4), bevel=0.006)
    leg = np.array([(0.52, 0.25, 0.37), (0.55, 0.275, 0.18), (0.57, 0.29, 0)])
    legs = [tube(leg * (i, j, 1), 0.012) for i in (-1, 1) for j in (-1, 1)]
    return placed({"table": top.mapped(scale=(0.8, 1.6)), "table-legs": join(*legs)}, place)


def side_table(place: Array) -> Parts:
    """Return a round table, 0.55 m high."""
    top = revolve([(0, 0.52), (0.23, 0.52), (0.24, 0.535), (0.23, 0.55), (0, 0.55)])
    stem = revolve([(0, 0), (0.15, 0), (0.15, 0.012), (0.016, 0.03), (0.016, 0.52), (0, 0.52)])
    return placed({"side-table": top, "side-table-stem": stem}, place)


def bookshelf(place: Array, *, spines: int) -> Parts:
    """Return an open shelf full of books over a fireplace, 0.38 m a storey, with a jar on it.

    Each book shows one of `spines` panes of a texture.
    """
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
        for book in _books(rng, 0.62 if k == first else 1.0, spines)
    ]
    parts = {
        "shelf": join(*boards, *sides, back),
        "books": join(*books),
        "jar": revolve(JAR).moved(translate(half - 0.17, -0.16, first * storey + 0.075)),
        **_fireplace(width=2 * half, height=0.05 + first * storey),
    }
    return placed(parts, place)


def _fireplace(*, width: float, height: float) -> Parts:
    """Return an open fireplace, swept and unlit: a stone surround, a sooty firebox, three logs."""
    a, b, sill, lintel = width / 2, width / 2 - 0.13, 0.05, height - 0.16
    surround = [
        box((-a, -0.42, 0), (a, -0.03, sill), bevel=0.006),
        box((-a, -0.33, lintel), (a, -0.03, height), bevel=0.006),
        box((-a, -0.33, sill), (-b, -0.03, lintel), bevel=0.006),
        box((b, -0.33, sill), (a, -0.03, lintel), bevel=0.006),
    ]
    logs = [
        [(-0.24, -0.2, 0.1), (0.2, -0.13, 0.1)],
        [(-0.2, -0.1, 0.1), (0.24, -0.21, 0.1)],
        [(-0.22, -0.15, 0.18), (0.2, -0.17, 0.18)],
    ]
    return {
        "fireplace": join(*surround),
        "firebox": box((-b, -0.03, sill), (b, -0.014, lintel)),
        "logs": join(*(tube(np.array(log), 0.045) for log in logs)),
    }


def _books(rng: np.random.Generator, length: float, spines: int) -> list[Mesh]:
    """Return a row of books from the origin along +x."""
    books, x = [], 0.0
    while (x := x + 0.003) < length - 0.05:
        thick = 0.018 + 0.03 * rng.random()
        book = box((x, -0.17 - 0.05 * rng.random(), 0), (x + thick, 0, 0.2 + 0.11 * rng.random()))
        pane = (rng.integers(spines) + 0.5) / spines
        books.append(replace(book, uv=np.full_like(book.uv, 0.5) * [2 * pane, 1.0]))
        x += thick
    return books


def painting(place: Array, *, rows: int, columns: int) -> Parts:
    """Return a canvas of panes, 0.4 m each, in a thin frame about its origin."""
    high, wide = 0.4 * rows, 0.4 * columns
    canvas = quad((-wide / 2, -0.03, -high / 2), (wide, 0, 0), (0, 0, high))
    a, b = wide / 2, high / 2
    frame = [
        box((-a - 0.025, -0.04, s * b - 0.012), (a + 0.025, 0.0, s * b + 0.012)) for s in (-1, 1)
    ] + [box((s * a - 0.012, -0.04, -b), (s * a + 0.012, 0.0, b)) for s in (-1, 1)]
    parts = {
        "painting": canvas.mapped(scale=(1 / wide, 1 / high)),
        "painting-frame": join(*frame),
    }
    return placed(parts, place)
