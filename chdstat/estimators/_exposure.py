"""Exposure: what radiance a picture shows as 1.

Some estimators were published with thresholds in absolute radiance and mean that of a picture that
is exposed as usual. Here they measure in the unit of the picture at hand, so that they scale with
the radiance as all others do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError

__all__ = ["exposure_unit"]

_MIDDLE_GREY = 0.18


def exposure_unit(pixels: npt.NDArray[np.floating[Any]], unit: float | None = None) -> float:
    """Return the radiance that counts as 1: the log-average of the picture is middle grey, 0.18.

    As in the tone reproduction of Reinhard et al. 2002, doi:10.1145/566654.566575, equation 1 and
    2, with black pixels left out. 1 for a black picture.

    Parameters
    ----------
    pixels
        Luminances, any shape; those that are not positive and finite are left out.
    unit
        Passed through where the caller knows better.

    Raises
    ------
    InputError
        If `unit` is not positive and finite.
    """
    if unit is not None:
        if not 0 < unit < np.inf:
            message = f"unit must be a positive radiance, got {unit}"
            raise InputError(message)
        return float(unit)
    lit = pixels[(pixels > 0) & np.isfinite(pixels)].astype(np.float64)
    return float(np.exp(np.log(lit).mean()) / _MIDDLE_GREY) if lit.size else 1.0
