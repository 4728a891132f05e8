"""Film steps: the places in a pixel where samples fell, as whole numbers of one byte each.

A pixel is 16 x 16 steps: the finest split of the variance, `chdstat.patterns.film_split`, has as
many cells, and a step lies in one of them. Two steps hold one byte of information, which costs a
store 1.0 byte a sample; with 64 steps, it would be 1.5.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, check_real
from chdstat.errors import InputError

STEPS = 16
"""Steps along each edge of a pixel."""
FILM_STEPS = "film_steps"
"""The attribute of samples that are places in a pixel: how many steps."""
OF_FILM = {FILM_STEPS: STEPS, "units": "pixels"}
"""Attributes of samples that are places in a pixel."""
NO_STEP = 255
"""Where there is no sample."""
_CELLS = 4


def to_steps(places: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Return the steps in which places lie, from 0 to 1 in a pixel; NaN is `NO_STEP`.

    Examples
    --------
    >>> to_steps(np.array([0.0, 0.5, 1.0, np.nan])).tolist()
    [0, 8, 15, 255]
    """
    with np.errstate(invalid="ignore"):
        steps = (places * np.float32(STEPS)).astype(np.uint8)
    np.minimum(steps, STEPS - 1, out=steps)
    steps[np.isnan(places)] = NO_STEP
    return steps


def of_steps(steps: npt.NDArray[np.uint8]) -> Image:
    """Return the middles of steps, as places from 0 to 1 in a pixel; NaN where there is none.

    Examples
    --------
    >>> of_steps(np.array([0, 8, 15, 255], np.uint8)).tolist()
    [0.03125, 0.53125, 0.96875, nan]
    """
    middles = np.full(256, np.nan, np.float32)
    middles[:STEPS] = (np.arange(STEPS) + 0.5) / STEPS
    return np.asarray(middles[steps])


def in_steps(places: npt.NDArray[np.floating]) -> npt.NDArray[np.float16]:
    """Return places as the middles of their steps, which half precision holds exactly.

    Examples
    --------
    >>> in_steps(np.array([0.0, 0.51, np.nan])).tolist()
    [0.03125, 0.53125, nan]
    """
    return of_steps(to_steps(places)).astype(np.float16)


def checked_places(
    given: npt.ArrayLike, shape: Sequence[int], name: str
) -> npt.NDArray[np.float16]:
    """Return places in a pixel, in steps.

    Raises
    ------
    InputError
        If they have another shape, or lie outside the pixel.

    Examples
    --------
    >>> checked_places([[[0.5, 1.0]]], (1, 1, 2), "film").tolist()
    [[[0.53125, 0.96875]]]
    """
    array = np.asarray(given)
    check_real(array.dtype, name)
    if array.shape != tuple(shape):
        message = (
            f"{name} must be where in its pixel each sample fell, across and down, of shape "
            f"{tuple(shape)}; got {array.shape}"
        )
        raise InputError(message)
    if ((array < 0) | (array > 1)).any():
        low, high = np.nanmin(array), np.nanmax(array)
        message = (
            f"{name} must be from 0 to 1, as a sample counts for the pixel in which it fell; got "
            f"{low:.6g} to {high:.6g}. Give places within the pixel, x - floor(x) of a coordinate "
            "x in pixels, and draw with a box filter of one pixel"
        )
        raise InputError(message)
    return in_steps(array)


def unevenness(places: npt.NDArray[np.floating]) -> str:
    """Return what is wrong with places that are not everywhere in a pixel alike; "" if they are.

    The places (..., 2, sample) are counted in 4 x 4 cells. Chi-squared must be 8 of its standard
    deviations above its mean, and a cell off by a twentieth.

    Examples
    --------
    >>> places = np.random.default_rng(0).random((4, 4, 2, 512))
    >>> unevenness(places), unevenness(places**1.2)[:21]
    ('', 'samples are in some p')
    """
    across, down = np.moveaxis(to_steps(places) // (STEPS // _CELLS), -2, 0)
    known = (across < _CELLS) & (down < _CELLS)
    counts = np.bincount((_CELLS * down + across)[known].ravel(), minlength=_CELLS**2)
    expected = max(counts.mean(), 1.0)
    off = counts / expected - 1
    free = _CELLS**2 - 1
    if (off**2).sum() * expected < free + 8 * (2 * free) ** 0.5 or np.abs(off).max() < 0.05:
        return ""
    return (
        f"samples are in some parts of a pixel more often (up to {1 + off.max():.2g} times the "
        "mean), so that the variance between places is of another weight than a box filter's; draw "
        "with a box filter of one pixel"
    )
