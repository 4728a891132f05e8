"""The living room by day, lit through three windows.

A red evening sky stands right outside the windows, and a low sun over it reaches the carpet; with
the dark red carpet and curtains that gives the room its red cast. Large windows and pale walls
make it easy for a path tracer: few null samples, and direct light nearly everywhere.
"""

from __future__ import annotations

import itertools

import numpy as np

from chdstat.scenes.props import textures
from chdstat.scenes.props.furniture import glow, spot
from chdstat.scenes.props.living_room import living_room
from chdstat.scenes.props.shapes import quad
from chdstat.scenes.props.textures import Entry, rgb

__all__ = ["build"]

_SKY = (
    *[(0.0, (0.05, 0.03, 0.025)), (0.3, (0.09, 0.05, 0.04)), (0.33, (1.0, 0.36, 0.12))],
    *[(0.5, (0.95, 0.42, 0.24)), (0.75, (0.75, 0.42, 0.38)), (1.0, (0.6, 0.42, 0.48))],
)
"""From the dark ground over the glow at the horizon to the sky above it."""
_HIGH = 2.12


def build() -> Entry:
    """Return the scene dict of the living room by day."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        **_outside(),
        **living_room(bulb=None),
    }


def _outside() -> Entry:
    """Return one panel of sky for each window, seen through it from the room, and the sun."""
    sky = textures.light(_SKY, 14.0)
    panels: Entry = {}
    for i, (a, b) in enumerate(itertools.pairwise((2.15, 3.5, 4.85, 6.3))):
        panel = quad((-0.44, a, 0.3), (0, b - a, 0), (0, 0, _HIGH))
        panels[f"sky-{i}"] = glow(panel.mapped(scale=(1 / (b - a), 1 / _HIGH)), sky)
    target = np.array([0.0, 3.95, 2.0])
    sun = target + 6.0 * np.array([-0.56, 0.2, 0.80])
    light = rgb(5200.0, 3500.0, 2100.0)
    return {**panels, "sun": spot(sun, target, 0.22, light, weight=0.2)}
