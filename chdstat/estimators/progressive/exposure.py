"""Exposure: the radiance that a picture is measured in."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["picture_unit"]

_GROUPS = 64


def picture_unit(means: npt.NDArray[np.floating[Any]]) -> float:
    """Return the mean radiance of a picture, which a few fireflies do not change.

    The median over 64 parts of the picture of their means: it follows the unit of radiance exactly
    and hardly depends on the number of samples.

    Parameters
    ----------
    means
        Radiance of pixels, shape (..., channel); those that are not finite are left out.

    Returns
    -------
    float
        1 for a black picture.
    """
    pixels = means.reshape(-1, means.shape[-1]).astype(np.float64).mean(axis=-1)
    pixels = pixels[np.isfinite(pixels)]
    # Every 64th pixel belongs to a group, so that all groups cover the whole picture.
    groups = [pixels[start::_GROUPS].mean() for start in range(min(_GROUPS, len(pixels)))]
    unit = float(np.median(groups)) if groups else 0.0
    if not 0 < unit < np.inf:
        unit = float(pixels.mean()) if len(pixels) else 0.0
    if not 0 < unit < np.inf:
        return 1.0
    # Samples are measured in it in single precision.
    limits = np.finfo(np.float32)
    return float(np.clip(unit, limits.tiny, limits.max))
