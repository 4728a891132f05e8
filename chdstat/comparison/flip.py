"""FLIP: how visible the differences of two images are, at exposures that are chosen here.

HDR-FLIP shows both images at several exposures and keeps the largest difference. Its automatic
exposures follow from the median of the reference: for an object before a black background they are
infinite, and the program ends. So the exposures are given, from the part of the reference that
light reaches.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
from typing import Any

import numpy as np

from chdstat._core.arrays import Array

HAS_FLIP = importlib.util.find_spec("flip_evaluator") is not None
"""Whether the package that measures it is installed."""
_LUMINANCE = (0.2126, 0.7152, 0.0722)
_LIT = 1e-3
"""Share of the mean radiance from which a pixel is lit."""
_SHOWN = 0.999
"""Quantile of the lit pixels that the least exposure shows: a few lamps may stay white."""
_WHITE = 2.1189
"""Radiance that the tone curve of HDR-FLIP (ACES) shows at 85 % of white."""
_MOST = 16
"""Most exposures, a stop apart if they suffice."""


def exposures(reference: Array) -> tuple[float, float]:
    """Return the least and the largest exposure for a reference (y, x, channel), in stops.

    At the least, the brightest lit pixels but one in a thousand are shown at 85 % of white; at the
    largest, half of the lit pixels are at least as bright. HDR-FLIP takes the maximum and the
    median of all pixels instead.

    Examples
    --------
    >>> image = np.zeros((8, 8, 3))
    >>> image[:2] = 2.1189  # three quarters are black
    >>> exposures(image), exposures(image / 2), exposures(0 * image)
    ((0.0, 0.0), (1.0, 1.0), (0.0, 0.0))
    """
    light = np.broadcast_to(np.maximum(reference, 0), (*reference.shape[:2], 3)) @ _LUMINANCE
    lit = light[light > _LIT * light.mean()]
    if not lit.size:
        return 0.0, 0.0
    start, stop = (
        round(math.log2(_WHITE) - math.log2(float(x)), 4) + 0.0
        for x in np.quantile(lit, (_SHOWN, 0.5))
    )
    return start, stop


def flip(image: Array, reference: Array, *, stops: tuple[float, float] | None = None) -> Array:
    """Return the FLIP error of every pixel of linear radiance, shape (y, x), from 0 to 1.

    Parameters
    ----------
    image, reference
        Radiance, shape (y, x, channel), 1 or 3 channels; what is negative or no number is black.
    stops
        Least and largest exposure; None takes the `exposures` of the reference.

    References
    ----------
    P. Andersson, J. Nilsson, P. Shirley and T. Akenine-Möller, "Visualizing errors in rendered high
    dynamic range images", Eurographics Short Papers 2021, doi:10.2312/egs.20211015; with 67 pixels
    per degree.
    """
    evaluator: Any = importlib.import_module("flip_evaluator")
    start, stop = exposures(reference) if stops is None else stops
    shape = (*reference.shape[:2], 3)
    # Both images at the least exposure, so that radiance of any unit is a usual number.
    lit = (np.nan_to_num(x.clip(0) * 2.0**start, posinf=0) for x in (reference, image))
    shown = (np.array(np.broadcast_to(x, shape), np.float32, order="C") for x in lit)
    count = min(max(2, math.ceil(stop - start)), _MOST)  # of a single one, errors are 0
    how = {"startExposure": 0.0, "stopExposure": stop - start, "numExposures": count}
    found, _, _ = evaluator.evaluate(
        *shown, "HDR", applyMagma=False, computeMeanError=False, parameters=how
    )
    return np.asarray(found, np.float64).reshape(shape[:2])
