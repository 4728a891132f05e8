"""Film places: where in its pixel each sample falls, from the random numbers that decide it.

The first two random numbers of a sample are its place in the pixel, whatever the scene. A wavefront
returns them. Mitsuba's scalar passes do not: their numbers are those of PCG32 (O'Neill 2014,
https://www.pcg-random.org), whose stream in each pixel `stream_numbers` finds out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image
from chdstat.errors import RenderError
from chdstat.rendering.rays import BLOCK

_MULTIPLIER, _INCREMENT = np.uint64(0x5851F42D4C957F2D), np.uint64(0xB47C73972972B7B7)
_EXACT = 2e-5
"""Largest error of a place in a pixel that single precision makes."""


def of_passes(offsets: npt.NDArray[np.int64], firsts: Sequence[int]) -> npt.NDArray[np.float32]:
    """Return where in its pixel each sample of scalar passes falls, shape (y, x, 2, sample).

    Parameters
    ----------
    offsets
        Number of each pixel's stream after the first of a pass, shape (y, x).
    firsts
        Number of the first stream of each pass.
    """
    places = np.empty((*offsets.shape, 2, len(firsts)), np.float32)
    for i, first in enumerate(firsts):  # pass by pass, since that fits into the processor's cache
        numbers = ((offsets + first) % 2**32).astype(np.uint64)
        places[..., i] = np.stack(_first_two(numbers), axis=-1)
    return places


def _first_two(seeds: npt.NDArray[np.uint64]) -> list[npt.NDArray[np.float32]]:
    """Return the first two numbers from 0 to 1 that PCG32 draws with each seed."""
    state = (_INCREMENT + seeds) * _MULTIPLIER + _INCREMENT
    drawn = []
    for _ in range(2):
        mixed = (((state >> np.uint64(18)) ^ state) >> np.uint64(27)).astype(np.uint32)
        turn = (state >> np.uint64(59)).astype(np.uint32)
        bits = (mixed >> turn) | (mixed << (-turn & np.uint32(31)))
        drawn.append(((bits >> np.uint32(9)) * np.float32(2**-23)).astype(np.float32))
        state = state * _MULTIPLIER + _INCREMENT
    return drawn


def stream_numbers(mi: Any, extent: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return the number of each pixel's stream after the first of a scalar pass, shape (y, x).

    A camera that faces a square draws a pass: where its rays hit the square tells in which order
    Mitsuba numbers the pixels, and that PCG32 draws the numbers.

    Raises
    ------
    RenderError
        If Mitsuba draws other numbers.
    """
    from scipy.spatial import KDTree

    width, height = extent
    places = _of_square(mi, extent)
    blocks = -(-width // BLOCK) * -(-height // BLOCK)
    known = np.stack(_first_two(np.arange(blocks * BLOCK**2, dtype=np.uint64)), axis=-1)
    distance, found = KDTree(known).query(places.reshape(-1, 2))
    if distance.max() > _EXACT or len(np.unique(found)) < found.size:
        message = "this version of Mitsuba does not tell where scalar samples fall; leave out film"
        raise RenderError(message)
    return np.asarray(found.reshape(height, width), np.int64)


def _of_square(mi: Any, extent: tuple[int, int]) -> Image:
    """Return where in its pixel each sample of the first pass falls, shape (y, x, 2).

    The longer edge of the film shows the whole square, from -1 to 1.
    """
    width, height = extent
    wide, longer = min(1.0, width / height), max(width, height)
    facing = mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb"}
    film |= {"component_format": "float32", "rfilter": {"type": "box"}}
    to_world = facing @ mi.ScalarTransform4f().scale([wide, wide, 1])
    sensor = mi.load_dict({"type": "orthographic", "to_world": to_world, "film": film})
    aov = mi.load_dict({"type": "aov", "aovs": "place:position", "block_size": BLOCK})
    scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
    hits = np.asarray(aov.render(scene, sensor, seed=0, spp=1))[..., -3:]
    x = (width + longer * hits[..., 0]) / 2 - np.arange(width)
    y = (height - longer * hits[..., 1]) / 2 - np.arange(height)[:, np.newaxis]
    return np.stack([x, y], axis=-1)
