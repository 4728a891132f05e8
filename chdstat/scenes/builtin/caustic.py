"""A still life of glass and polished metal under one small lamp.

Light reaches the cloth behind the glass, and inside the ring, only by way of a smooth surface,
which no connection to the lamp can follow: a path has to meet the lamp by chance. So the caustics
are made of rare, very bright samples, and the shadows that they lie in are full of null samples.

The table is about 1.4 m wide; lengths are metres, the origin lies in the middle of its top.
"""

from __future__ import annotations

import numpy as np

from chdstat.scenes.props import furniture, textures
from chdstat.scenes.props.furniture import camera, sphere, spot
from chdstat.scenes.props.shapes import box, join, quad, revolve, sheet
from chdstat.scenes.props.textures import Entry, glass, glossy, matte, metal, rgb
from chdstat.scenes.scene import rotate, translate

__all__ = ["build"]

_DARK, _PALE = (0.028, 0.036, 0.05), (0.78, 0.75, 0.69)

# Profiles are (radius, height): up the outside, then down the inside.
_GOBLET = [
    *[(0.0, 0.0), (0.04, 0.0), (0.042, 0.003), (0.02, 0.008), (0.006, 0.02), (0.0055, 0.06)],
    *[(0.007, 0.085), (0.02, 0.096), (0.038, 0.115), (0.046, 0.145), (0.044, 0.18), (0.038, 0.21)],
    *[(0.036, 0.21), (0.0418, 0.18), (0.0436, 0.145), (0.036, 0.118), (0.018, 0.1), (0.0, 0.095)],
]
_LEMON = [
    *[(0.0, -0.042), (0.006, -0.038), (0.016, -0.03), (0.026, -0.014), (0.029, 0.0)],
    *[(0.026, 0.014), (0.016, 0.03), (0.006, 0.038), (0.0, 0.042)],
]


def build() -> Entry:
    """Return the scene dict of the still life."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 10},
        "sensor": camera((0.1, -1.0, 0.60), (0.0, 0.02, 0.06), fov=31.0),
        **_lights(),
        **_table(),
        **_glass(),
        **_metal(),
        **_others(),
    }


def _lights() -> Entry:
    """Return the lamp, behind and to the left, and a weak wide sky over the camera."""
    table = (0.0, 0.0, 0.0)
    return {
        "lamp": spot((-0.85, 0.62, 0.95), table, 0.1, rgb(300.0, 250.0, 185.0)),
        "fill": spot((0.9, -1.6, 2.0), table, 0.65, rgb(1.3, 1.5, 1.8), weight=0.5),
    }


def _table() -> Entry:
    """Return wood, a chequered cloth on it, and a wall that rises behind."""
    top = box((-1.1, -0.75, -0.05), (1.1, 0.62, -0.002), bevel=0.004)
    wood = textures.wood((0.10, 0.045, 0.02), (0.38, 0.2, 0.095), seed=12, rings=6)
    checks = textures.checks(_DARK, _PALE, rows=6, columns=8)
    cloth = quad((-0.4, -0.3, 0.0), (0.8, 0, 0), (0, 0.6, 0)).mapped(scale=(1 / 0.8, 1 / 0.6))
    height = np.linspace(-0.6, 1.6, 12)[:, None]
    width = np.linspace(-1.8, 1.8, 60)
    folds = 0.035 * np.sin(9 * width) + 0.012 * np.sin(23 * width + 1)
    drape = sheet(width, 0.9 + folds, height)
    return {
        "table": top.mapped(scale=(0.7, 1.2)).shape(glossy(textures.bitmap(wood), roughness=0.15)),
        "cloth": cloth.moved(rotate("z", 9)).shape(matte(textures.bitmap(checks, sharp=True))),
        "drape": drape.shape(matte(rgb(0.10, 0.24, 0.28))),
    }


def _glass() -> Entry:
    return {
        "crystal": sphere((-0.13, 0.02, 0.0805), 0.08, glass()),
        "goblet": revolve(_GOBLET, segments=96, crease=40.0)
        .moved(translate(0.1, 0.14, 0.001))
        .shape(glass()),
    }


def _metal() -> Entry:
    """Return a wide gold ring, a silver ball and a chrome cup."""
    radius, high, thick = 0.085, 0.045, 0.003
    ring = revolve(
        [(radius, 0), (radius, high), (radius - thick, high), (radius - thick, 0), (radius, 0)],
        segments=128,
    )
    return {
        "ring": ring.moved(translate(0.15, -0.09, 0.001)).shape(metal("Au", roughness=0.03)),
        "pearl": sphere((-0.02, -0.16, 0.0255), 0.025, metal("Ag")),
        **furniture.tumbler(translate(-0.24, 0.2, 0.001)),
    }


def _others() -> Entry:
    """Return lemons, and a book that gives the crystal its height."""
    lemon = revolve(_LEMON, segments=48, crease=180.0)
    lying = [
        translate(0.27, 0.03, 0.03) @ rotate("z", 35) @ rotate("y", 90),
        translate(0.31, 0.1, 0.03) @ rotate("z", -50) @ rotate("y", 90),
    ]
    book = box((-0.46, -0.2, -0.002), (-0.3, 0.04, 0.028), bevel=0.002)
    return {
        "lemons": join(*(lemon.moved(m) for m in lying)).shape(
            glossy(rgb(0.78, 0.52, 0.03), roughness=0.25)
        ),
        "book": book.moved(rotate("z", -6)).shape(matte(rgb(0.32, 0.05, 0.05))),
    }
