"""A bathroom lit through one window.

What light enters comes from a patch of sky and a soft sun outside the only opening, so most
connections from inside to a light are blocked: null samples, long indirect tails, a penumbra
across floor and tub, and a mirror that shows it all again. Every mesh and texture is made here.

The room is 2.6 m wide (x), 3.7 m deep (y) and 2.5 m high (z). The window is in the left wall, the
washbasin at the back, the tub at the right, and the camera at the front.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from chdstat.scenes.props import furniture, textures
from chdstat.scenes.props.living_room import walls, window_frame
from chdstat.scenes.props.shapes import box, join, quad, surface, tiles
from chdstat.scenes.props.textures import Entry, glossy, matte, rgb
from chdstat.scenes.scene import rotate, translate

__all__ = ["build"]

_WIDTH, _DEPTH, _HEIGHT = 2.6, 3.7, 2.5
_WINDOW_Y, _WINDOW_Z = (1.55, 3.2), (0.9, 2.25)
_REVEAL = 0.16

_BLACK = matte(rgb(0.0, 0.0, 0.0))
_PLASTER = matte(rgb(0.88, 0.865, 0.83))
_LACQUER = glossy(rgb(0.80, 0.79, 0.76), roughness=0.15)


def build() -> Entry:
    """Return the scene dict of the bathroom."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 9},
        "sensor": furniture.camera((1.80, 0.15, 1.52), (1.28, 3.05, 0.92), fov=64.0),
        **_outside(),
        **_room(),
        **_window(),
        **_tiled_walls(),
        **_furniture(),
    }


def _outside() -> Entry:
    """Return a part of the sky and a sun that is larger and softer than the real one."""
    middle = np.array([0.0, np.mean(_WINDOW_Y), np.mean(_WINDOW_Z)])
    sun = middle + np.array([-3.6, 0.18, 2.7])
    # The part of a dome which the room can see, facing inwards.
    radius, azimuth = 6.0, np.deg2rad(np.linspace(262, 118, 14))
    height = np.deg2rad(np.linspace(-8, 42, 7))[:, None]
    level = np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), np.tan(height)), axis=-1)
    # Flat: Mitsuba takes the shading normal of a smooth emitter for its true one, which is biased.
    sky = replace(surface(radius * np.cos(height)[..., None] * level), normals=None)
    return {
        "sky": {
            **sky.moved(translate(0, middle[1], 0)).shape(_BLACK),
            "emitter": {"type": "area", "radiance": rgb(2.6, 2.8, 3.05)},
        },
        # Chosen half as often as the sky: less of the room sees it.
        "sun": furniture.spot(sun, middle, 0.2, rgb(3500.0, 2980.0, 2280.0), weight=0.5),
    }


def _room() -> Entry:
    boards = textures.planks((0.24, 0.135, 0.07), (0.56, 0.38, 0.23), seed=5)
    floor = quad((0, 0, 0), (_WIDTH, 0, 0), (0, _DEPTH, 0)).mapped(scale=(1 / 1.6, 1 / 0.9))
    shell = walls((_WIDTH, _DEPTH, _HEIGHT), [_WINDOW_Y], _WINDOW_Z, reveal=_REVEAL)
    skirting = join(
        box((0, _DEPTH - 0.015, 0), (_WIDTH, _DEPTH, 0.09), bevel=0.004),
        box((0, 0, 0), (0.015, _DEPTH - 0.015, 0.09), bevel=0.004),
    )
    return {
        "floor": floor.shape(glossy(textures.bitmap(boards), roughness=0.18)),
        "walls": join(*shell).shape(_PLASTER),
        "skirting": skirting.shape(_LACQUER),
    }


def _window() -> Entry:
    """Return frame, glazing bar and sill."""
    (y0, y1), z0 = _WINDOW_Y, _WINDOW_Z[0]
    frame = window_frame(_WINDOW_Y, _WINDOW_Z, reveal=_REVEAL, bar=0.045, middle=0.045)
    sill = box((-_REVEAL, y0 - 0.06, z0 - 0.02), (0.08, y1 + 0.06, z0 + 0.015), bevel=0.006)
    return {"window": join(*frame, sill).shape(_LACQUER)}


def _tiled_walls() -> Entry:
    """Return staggered tiles on the right wall and behind the tub."""
    right = translate(_WIDTH - 0.004, _DEPTH, 0) @ rotate("z", -90) @ rotate("x", 90)
    back = translate(_WIDTH - 1.0, _DEPTH - 0.004, 0) @ rotate("x", 90)
    return {**_tiling("right", 18, right), **_tiling("back", 5, back)}


def _tiling(name: str, columns: int, place: furniture.Matrix) -> Entry:
    """Return 14 rows of tiles, two of them dark, and the joints behind them."""
    width, height, rows = 0.2, 0.1, 14
    pale, dark = (0.78, 0.81, 0.79), (0.045, 0.17, 0.19)
    colors = [dark if row in (11, 12) else pale for row in range(rows)]
    image = textures.tile_colors(colors, columns=columns, spread=0.08, seed=columns)
    field = tiles(columns, rows, size=(width, height), gap=0.006, depth=0.003, stagger=0.5)
    joints = quad((0, 0, 0), (columns * width, 0, 0), (0, rows * height, 0))
    glaze = glossy(textures.bitmap(image, sharp=True), roughness=0.08)
    return {
        f"tiles-{name}": field.moved(place).shape(glaze),
        f"joints-{name}": joints.moved(place).shape(matte(rgb(0.42, 0.41, 0.39))),
    }


def _furniture() -> Entry:
    basin_x, lamp_z, top = 0.85, 1.62, 0.87
    mat = box((1.13, 2.05, 0.0), (1.63, 2.85, 0.018), bevel=0.008)
    to_room = rotate("z", 180)
    return {
        **furniture.vanity(translate(basin_x, _DEPTH, 0)),
        **furniture.mirror(translate(basin_x, _DEPTH - 0.03, lamp_z), radius=0.44),
        **furniture.wall_lamp(translate(basin_x - 0.59, _DEPTH, lamp_z), name="left-lamp"),
        **furniture.wall_lamp(translate(basin_x + 0.59, _DEPTH, lamp_z), name="right-lamp"),
        **furniture.vase(translate(0.42, _DEPTH - 0.19, top)),
        **furniture.tumbler(translate(1.15, _DEPTH - 0.13, top)),
        **furniture.dispenser(translate(1.27, _DEPTH - 0.16, top)),
        **furniture.tub(translate(2.16, 2.62, 0)),
        **furniture.tub_tap(translate(_WIDTH, 2.72, 0.80) @ rotate("z", -90)),
        **furniture.towel_rail(translate(2.02, _DEPTH, 1.42)),
        **furniture.towel(translate(0.65, 0.075, 1.75) @ to_room, color=rgb(0.52, 0.10, 0.07)),
        **furniture.door(translate(0.65, 0, 0) @ to_room),
        **furniture.basket(translate(0.33, 2.62, 0)),
        **furniture.plant(translate(-0.02, 2.98, _WINDOW_Z[0] + 0.015)),
        "mat": mat.shape(matte(rgb(0.07, 0.22, 0.24))),
    }
