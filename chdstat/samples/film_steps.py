"""Film steps: the places in a pixel where samples fell, as whole numbers of one byte each.

A pixel is 16 x 16 steps: the finest split of the variance, `chdstat.patterns.film_split`, has as
many cells, and a step lies in one of them. Two steps hold one byte of information, which costs a
store 1.0 byte a sample; with 64 steps, it would be 1.5.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image

STEPS = 16
"""Steps along each edge of a pixel."""
FILM_STEPS = "film_steps"
"""The attribute of samples that are places in a pixel: how many steps."""
NO_STEP = 255
"""Where there is no sample."""


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
