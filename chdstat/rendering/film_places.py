"""Film places: where in its pixel each sample falls, from the random numbers that decide it.

The first two random numbers of a sample are its place in the pixel, whatever the scene and the
sampler. A wavefront returns them. Mitsuba's scalar passes do not: there, a camera that faces a
square draws a pass with the same random numbers, and where its rays hit the square tells them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from chdstat._core.arrays import Image
from chdstat.rendering.rays import BLOCK

_STEPS = 64
"""Places that are told apart along each edge of a pixel; four times as many take a third more
room."""


def in_steps(places: Image) -> Image:
    """Return places in a pixel, from 0 to 1, as the middle of the step in which they lie.

    Examples
    --------
    >>> in_steps(np.array([0.0, 0.5, 1.0])).tolist()
    [0.0078125, 0.5078125, 0.9921875]
    """
    steps = np.clip(np.floor(places * _STEPS), 0, _STEPS - 1)
    return np.asarray((steps + 0.5) / _STEPS, np.float32)


def square(mi: Any, extent: tuple[int, int]) -> tuple[Any, Any, Any]:
    """Return a scene of one square, a camera that faces it, and what renders where rays hit it.

    The film of the camera has a size in pixels; its longer edge shows the whole square.
    """
    wide = min(1.0, extent[0] / extent[1])
    facing = mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": extent[0], "height": extent[1], "pixel_format": "rgb"}
    film |= {"component_format": "float32", "rfilter": {"type": "box"}}
    to_world = facing @ mi.ScalarTransform4f().scale([wide, wide, 1])
    sensor = {"type": "orthographic", "to_world": to_world, "film": film}
    aov = {"type": "aov", "aovs": "place:position", "block_size": BLOCK}
    scene = {"type": "scene", "shape": {"type": "rectangle"}}
    return mi.load_dict(scene), mi.load_dict(sensor), mi.load_dict(aov)


def of_square(hits: Image) -> Image:
    """Return where in its pixel each sample fell, from where its ray hit the square.

    `hits` is (y, x, component, sample), from -1 to 1; the places are (y, x, 2, sample), from 0 to
    1.
    """
    height, width = hits.shape[:2]
    rows, columns = np.arange(height)[:, np.newaxis, np.newaxis], np.arange(width)[:, np.newaxis]
    longer = max(height, width)
    x = (width + longer * hits[:, :, 0]) / 2 - columns
    y = (height - longer * hits[:, :, 1]) / 2 - rows
    return np.stack([x, y], axis=2)
