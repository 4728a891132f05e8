"""The living room that the day and the night share: its shell, furniture and camera.

The room is 5.0 m wide (x), 6.2 m deep (y) and 2.75 m high (z). Three tall windows are in the left
wall, the sofa and the shelf at the back, a dark red carpet in the middle, the camera at the front.
What is outside the windows, and what burns inside, the scenes add.
"""

from __future__ import annotations

from chdstat.scenes import furniture, lounge, textures
from chdstat.scenes.cameras import camera
from chdstat.scenes.lights import lamp
from chdstat.scenes.materials import Entry, glossy, matte, rgb
from chdstat.scenes.shapes import Mesh, box, join, quad
from chdstat.scenes.transforms import rotate, translate

__all__ = ["WINDOWS", "living_room"]

_WIDTH, _DEPTH, _HEIGHT = 5.0, 6.2, 2.75
_SILL, _HEAD, _REVEAL = 0.45, 2.4, 0.18

WINDOWS = ((2.12, 3.18), (3.42, 4.48), (4.72, 5.78))
"""Where each window begins and ends along y, in metres."""

_PLASTER = matte(rgb(0.87, 0.85, 0.81))
_LACQUER = glossy(rgb(0.78, 0.77, 0.74), roughness=0.15)

_RED, _CREAM, _BLACK = (0.5, 0.05, 0.035), (0.80, 0.77, 0.68), (0.03, 0.03, 0.03)
_OCHRE, _TEAL, _ROSE = (0.6, 0.34, 0.06), (0.04, 0.2, 0.22), (0.62, 0.3, 0.25)
_PICTURE = (
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
        **_windows(),
        **_furniture(),
        **_lamps(bulb),
        **_small_things(),
    }


def _shell() -> Entry:
    boards = textures.planks((0.28, 0.17, 0.09), (0.6, 0.41, 0.25), seed=8)
    floor = quad((0, 0, 0), (_WIDTH, 0, 0), (0, _DEPTH, 0)).mapped(scale=(1 / 1.8, 1 / 0.9))
    walls = [
        quad((0, _DEPTH, _HEIGHT), (_WIDTH, 0, 0), (0, -_DEPTH, 0)),
        quad((0, _DEPTH, 0), (_WIDTH, 0, 0), (0, 0, _HEIGHT)),
        quad((_WIDTH, 0, 0), (-_WIDTH, 0, 0), (0, 0, _HEIGHT)),
        quad((_WIDTH, _DEPTH, 0), (0, -_DEPTH, 0), (0, 0, _HEIGHT)),
    ]
    skirting = join(
        box((0.015, _DEPTH - 0.015, 0), (_WIDTH, _DEPTH, 0.11), bevel=0.004),
        box((0, 0, 0), (0.015, _DEPTH, 0.11), bevel=0.004),
    )
    cornice = join(
        box((0, _DEPTH - 0.09, _HEIGHT - 0.07), (_WIDTH, _DEPTH, _HEIGHT), bevel=0.02),
        box((0, 0, _HEIGHT - 0.07), (0.09, _DEPTH - 0.09, _HEIGHT), bevel=0.02),
    )
    return {
        "floor": floor.shape(glossy(textures.bitmap(boards), roughness=0.2)),
        "walls": join(*walls, *_window_wall()).shape(_PLASTER),
        "skirting": join(skirting, cornice).shape(_LACQUER),
    }


def _window_wall() -> list[Mesh]:
    """Return the left wall around the windows: inside, outside, and the sides of the openings.

    Outside it reaches beyond the room, so that no light slips in where the walls meet.
    """
    pieces = []
    for x, low, high in ((0.0, 0.0, 0.0), (-_REVEAL, -1.0, 1.0)):
        edges = [low, *(y for window in WINDOWS for y in window), _DEPTH + high]
        piers = zip(edges[::2], edges[1::2], strict=True)
        pieces += [_wall_piece(x, (a, b), (low, _HEIGHT + high)) for a, b in piers]
        for window in WINDOWS:
            pieces += [
                _wall_piece(x, window, (low, _SILL)),
                _wall_piece(x, window, (_HEAD, _HEIGHT + high)),
            ]
    for y0, y1 in WINDOWS:
        wide, high_, deep = (0, y1 - y0, 0), (0, 0, _HEAD - _SILL), (-_REVEAL, 0, 0)
        pieces += [
            quad((-_REVEAL, y0, _SILL), (_REVEAL, 0, 0), wide),
            quad((0, y0, _HEAD), deep, wide),
            quad((0, y0, _SILL), deep, high_),
            quad((-_REVEAL, y1, _SILL), (_REVEAL, 0, 0), high_),
        ]
    return pieces


def _wall_piece(x: float, y: tuple[float, float], z: tuple[float, float]) -> Mesh:
    return quad((x, y[0], z[0]), (0, y[1] - y[0], 0), (0, 0, z[1] - z[0]))


def _windows() -> Entry:
    """Return frames with a cross of glazing bars, and sills."""
    x0, x1, bar, into = 0.02 - _REVEAL, 0.07 - _REVEAL, 0.05, 0.01
    parts = []
    for y0, y1 in WINDOWS:
        middle, transom = (y0 + y1) / 2, _HEAD - 0.6
        parts += [
            box((x0, y0 - into, _SILL - into), (x1, y0 + bar, _HEAD + into), bevel=0.005),
            box((x0, y1 - bar, _SILL - into), (x1, y1 + into, _HEAD + into), bevel=0.005),
            box((x0, y0 + bar, _SILL - into), (x1, y1 - bar, _SILL + bar), bevel=0.005),
            box((x0, y0 + bar, _HEAD - bar), (x1, y1 - bar, _HEAD + into), bevel=0.005),
            box((x0, middle - 0.02, _SILL + bar), (x1, middle + 0.02, _HEAD - bar), bevel=0.005),
            box((x0, y0 + bar, transom), (x1, middle - 0.02, transom + 0.04), bevel=0.005),
            box((x0, middle + 0.02, transom), (x1, y1 - bar, transom + 0.04), bevel=0.005),
            box((-_REVEAL, y0 - 0.05, _SILL - 0.03), (0.1, y1 + 0.05, _SILL + 0.012), bevel=0.006),
        ]
    return {"windows": join(*parts).shape(_LACQUER)}


def _furniture() -> Entry:
    carpet = box((1.15, 2.6, 0.0), (3.75, 4.85, 0.016), bevel=0.006)
    pile = matte(rgb(0.30, 0.028, 0.022))
    return {
        "carpet": carpet.shape(pile),
        **lounge.sofa(
            translate(2.2, _DEPTH - 0.12, 0),
            color=rgb(0.10, 0.22, 0.13),
            accents=(rgb(0.62, 0.36, 0.07), rgb(0.76, 0.72, 0.64), rgb(0.5, 0.06, 0.04)),
        ),
        **lounge.armchair(translate(0.62, 3.15, 0) @ rotate("z", 62), color=rgb(0.55, 0.44, 0.32)),
        **lounge.coffee_table(translate(2.45, 3.95, 0.016)),
        **lounge.bookshelf(translate(4.2, _DEPTH, 0), width=1.0),
        **lounge.painting(translate(1.75, _DEPTH, 1.76), _PICTURE),
        **furniture.mirror(translate(3.15, _DEPTH - 0.02, 1.72), radius=0.36),
    }


def _lamps(bulb: Entry | None) -> Entry:
    return {
        **lamp(
            translate(0.55, 5.6, 0),
            name="floor-lamp",
            height=1.62,
            shade=rgb(0.9, 0.72, 0.5),
            light=bulb,
        ),
        **lounge.side_table(translate(3.5, 5.6, 0)),
        **lamp(
            translate(3.5, 5.6, 0.55),
            name="table-lamp",
            height=0.55,
            shade=rgb(0.9, 0.5, 0.35),
            light=bulb,
        ),
    }


def _small_things() -> Entry:
    table = 0.416
    curtains: Entry = {}
    for i, y in enumerate((1.98, 3.3, 4.6, 5.92)):
        hanging = translate(0.09, y, 2.55) @ rotate("z", 90)
        curtains |= lounge.curtain(
            hanging, name=f"curtain-{i}", width=0.3, height=2.5, color=rgb(0.55, 0.07, 0.05)
        )
    books = join(
        box((2.62, 3.8, table), (2.84, 4.12, table + 0.03), bevel=0.003),
        box((2.64, 3.84, table + 0.03), (2.84, 4.1, table + 0.055), bevel=0.003),
    )
    return {
        **curtains,
        **lounge.bowl(translate(2.15, 3.98, table), color=rgb(0.75, 0.74, 0.7)),
        **furniture.vase(translate(2.5, 4.08, table)),
        **furniture.plant(translate(-0.06, 3.95, _SILL + 0.012)),
        "table-books": books.shape(matte(rgb(0.08, 0.16, 0.3))),
    }
