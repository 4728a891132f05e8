"""Furniture of the living room, as plain scene entries.

Each function takes the matrix that places the piece and returns its entries, as in
`chdstat.scenes.furniture`: a piece stands on its own origin with its back towards +y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from chdstat.scenes import textures
from chdstat.scenes.furniture import Matrix
from chdstat.scenes.materials import Entry, glossy, matte, metal, rgb, translucent, walnut
from chdstat.scenes.shapes import (
    Mesh,
    ball,
    box,
    join,
    loft,
    quad,
    revolve,
    rounded_rectangle,
    surface,
    tube,
)
from chdstat.scenes.transforms import rotate, translate

__all__ = [
    "armchair",
    "bookshelf",
    "bowl",
    "coffee_table",
    "curtain",
    "pad",
    "painting",
    "side_table",
    "sofa",
]

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


# --- seats ----------------------------------------------------------------------------------------


def sofa(place: Matrix, *, color: Entry, accents: Sequence[Entry]) -> Entry:
    """Return a sofa for three, 2.1 m wide, with a scatter cushion of each accent colour."""
    seats = [
        pad(0.59, 0.68, 0.17, radius=0.05).moved(translate(x, -0.57, 0.27))
        for x in (-0.6, 0.0, 0.6)
    ]
    backs = [
        pad(0.59, 0.44, 0.17, radius=0.06).moved(translate(x, -0.12, 0.62) @ rotate("x", 78))
        for x in (-0.6, 0.0, 0.6)
    ]
    frame = [
        pad(1.86, 0.86, 0.2, radius=0.03).moved(translate(0, -0.45, 0.09)),
        pad(2.1, 0.16, 0.74, radius=0.06).moved(translate(0, -0.08, 0.09)),
        *[pad(0.17, 0.92, 0.52, radius=0.06).moved(translate(x, -0.46, 0.09)) for x in (-1, 1)],
    ]
    entries = {
        f"cushion-{i}": _scatter_cushion(x, turn).moved(place).shape(matte(accent))
        for i, (x, turn, accent) in enumerate(
            zip((-0.7, 0.66, 0.36), (12, -14, 9), accents, strict=False)
        )
    }
    return {
        "sofa": join(*seats, *backs, *frame).moved(place).shape(matte(color)),
        "sofa-feet": _feet(0.9, 0.75, 0.1).moved(place @ translate(0, -0.45, 0)).shape(walnut(3)),
        **entries,
    }


def armchair(place: Matrix, *, color: Entry) -> Entry:
    """Return a deep chair on turned feet."""
    parts = [
        pad(0.56, 0.62, 0.18, radius=0.06).moved(translate(0, -0.42, 0.27)),
        pad(0.56, 0.5, 0.16, radius=0.06).moved(translate(0, -0.13, 0.6) @ rotate("x", 74)),
        pad(0.72, 0.76, 0.18, radius=0.04).moved(translate(0, -0.4, 0.12)),
        pad(0.74, 0.14, 0.78, radius=0.06).moved(translate(0, -0.06, 0.12) @ rotate("x", -6)),
        *[
            pad(0.13, 0.78, 0.46, radius=0.055).moved(translate(x, -0.4, 0.12))
            for x in (-0.37, 0.37)
        ],
    ]
    return {
        "armchair": join(*parts).moved(place).shape(matte(color)),
        "armchair-feet": _feet(0.3, 0.6, 0.13)
        .moved(place @ translate(0, -0.4, 0))
        .shape(walnut(3)),
    }


def _scatter_cushion(x: float, turn: float) -> Mesh:
    standing = translate(x, -0.36, 0.64) @ rotate("z", turn) @ rotate("x", 68)
    return pad(0.4, 0.4, 0.13, radius=0.06).moved(standing @ translate(0, 0, -0.03))


def _feet(half: float, depth: float, height: float) -> Mesh:
    """Return four turned feet under the corners of a piece."""
    foot = revolve([(0, 0), (0.018, 0), (0.028, height), (0, height)], segments=16)
    corners = [(x, y) for x in (-half, half) for y in (-depth / 2, depth / 2)]
    return join(*(foot.moved(translate(x, y, 0)) for x, y in corners))


# --- tables and shelves ---------------------------------------------------------------------------


def coffee_table(place: Matrix) -> Entry:
    """Return a long low table of walnut under a clear coat, on brass legs."""
    top = box((-0.6, -0.32, 0.36), (0.6, 0.32, 0.4), bevel=0.006)
    legs = [
        tube(
            [(0.52 * i, 0.25 * j, 0.37), (0.55 * i, 0.275 * j, 0.18), (0.57 * i, 0.29 * j, 0)],
            0.012,
        )
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    return {
        "table": top.mapped(scale=(0.8, 1.6)).moved(place).shape(walnut(7, roughness=0.1)),
        "table-legs": join(*legs).moved(place).shape(_BRASS),
    }


def side_table(place: Matrix) -> Entry:
    """Return a round table of lacquer, 0.55 m high."""
    top = revolve([(0, 0.52), (0.23, 0.52), (0.24, 0.535), (0.23, 0.55), (0, 0.55)])
    stem = revolve([(0, 0), (0.15, 0), (0.15, 0.012), (0.016, 0.03), (0.016, 0.52), (0, 0.52)])
    lacquer = glossy(rgb(0.035, 0.035, 0.04), roughness=0.1)
    return {
        "side-table": top.moved(place).shape(lacquer),
        "side-table-stem": stem.moved(place).shape(_BRASS),
    }


def bookshelf(place: Matrix, *, width: float = 1.0, shelves: int = 5, seed: int = 4) -> Entry:
    """Return an open shelf full of books, 0.38 m a storey, with a jar on one of them."""
    rng = np.random.default_rng(seed)
    half, storey, depth = width / 2, 0.38, 0.3
    top = shelves * storey + 0.06
    boards = [
        box((-half, -depth, z), (half, -0.012, z + 0.025), bevel=0.002)
        for z in 0.05 + storey * np.arange(shelves + 1)
    ]
    sides = [
        box((a, -depth, 0), (a + 0.025, -0.012, top + 0.05), bevel=0.002, grain="z")
        for a in (-half - 0.025, half)
    ]
    back = box((-half, -0.012, 0), (half, 0.0, top + 0.05))
    lengths = [0.62 * width if k == 2 else width for k in range(shelves)]
    books = [
        book.moved(translate(-half, -0.02, 0.075 + k * storey))
        for k, length in enumerate(lengths)
        for book in _books(rng, length)
    ]
    jar = revolve(_JAR).moved(translate(half - 0.17, -0.16, 2 * storey + 0.075))
    spines = textures.bitmap(textures.panes([_SPINES]), sharp=True)
    return {
        "shelf": join(*boards, *sides, back).moved(place).shape(walnut(2)),
        "books": join(*books).moved(place).shape(matte(spines)),
        "jar": jar.moved(place).shape(glossy(rgb(0.06, 0.2, 0.25), roughness=0.06)),
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


def painting(place: Matrix, colors: Sequence[Sequence[tuple[float, float, float]]]) -> Entry:
    """Return a picture of coloured panes, 0.4 m each, in a thin frame about its origin."""
    high, wide = 0.4 * len(colors), 0.4 * len(colors[0])
    canvas = quad((-wide / 2, -0.03, -high / 2), (wide, 0, 0), (0, 0, high))
    canvas = canvas.mapped(scale=(1 / wide, 1 / high))
    a, b = wide / 2, high / 2
    frame = [
        box((-a - 0.025, -0.04, s * b - 0.012), (a + 0.025, 0.0, s * b + 0.012)) for s in (-1, 1)
    ] + [box((s * a - 0.012, -0.04, -b), (s * a + 0.012, 0.0, b)) for s in (-1, 1)]
    image = textures.bitmap(textures.panes(colors), sharp=True)
    return {
        "painting": canvas.moved(place).shape(matte(image)),
        "painting-frame": join(*frame)
        .moved(place)
        .shape(glossy(rgb(0.03, 0.03, 0.03), roughness=0.2)),
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


def curtain(place: Matrix, *, name: str, width: float, height: float, color: Entry) -> Entry:
    """Return cloth that hangs in folds from its origin, which is the middle of its upper edge."""
    x = np.linspace(-width / 2, width / 2, 70)
    z = np.linspace(-height, 0, 6)[:, None]
    fall = 0.6 + 0.4 * (-z / height)
    fold = fall * (0.045 * np.sin(2 * np.pi * x / 0.13) + 0.012 * np.sin(37 * x + 1.0))
    sheet = surface(np.stack(np.broadcast_arrays(x, fold, z), axis=-1))
    return {name: sheet.moved(place).shape(translucent(color, through=0.25))}
