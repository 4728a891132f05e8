"""The living room by night, lit by two lamps.

The bulbs burn inside translucent shades that are open at both ends: what sees neither end gets
its light through the shade, which so acts as a virtual source, or from the pools of light on
ceiling, wall and floor. Most connections to a bulb are blocked: more than half of the samples are
null.
"""

from __future__ import annotations

from chdstat.scenes.props.living_room import living_room
from chdstat.scenes.props.shapes import quad
from chdstat.scenes.props.textures import Entry, matte, rgb

__all__ = ["build"]


def build() -> Entry:
    """Return the scene dict of the living room by night."""
    outside = quad((-0.7, 0.0, -0.5), (0, 8.0, 0), (0, 0, 4.0))
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "night": outside.shape(matte(rgb(0.004, 0.005, 0.008))),
        **living_room(bulb=rgb(900.0, 640.0, 350.0)),
    }
