"""Multiplicity: shares with their intervals, and p-values of many pixels at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy import special, stats

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["holm", "q_values", "rejections", "wilson"]

Floats = npt.NDArray[np.float64]


def q_values(p: npt.NDArray[np.floating[Any]]) -> Floats:
    """Return Benjamini-Hochberg q-values over the image, for each further axis apart.

    The expected share of false ones among the pixels with q <= alpha is at most alpha. Pixels
    without a p-value (NaN) take no part and stay NaN.

    Parameters
    ----------
    p
        p-values, shape (y, x, ...).

    References
    ----------
    Benjamini and Hochberg, "Controlling the false discovery rate: a practical and powerful
    approach to multiple testing", 1995, doi:10.1111/j.2517-6161.1995.tb02031.x.

    Examples
    --------
    >>> q_values(np.array([[0.01, np.nan], [0.04, 0.5]])).round(3)
    array([[0.03, nan], [0.06, 0.5 ]])
    """
    q = np.full(p.shape, np.nan)
    for index in np.ndindex(p.shape[2:]):
        here = (slice(None), slice(None), *index)
        tested = np.isfinite(p[here])
        if tested.any():
            adjusted = np.full(tested.shape, np.nan)
            adjusted[tested] = stats.false_discovery_control(p[here][tested])
            q[here] = adjusted
    return q


def rejections(q_value: xr.DataArray, alpha: float) -> xr.DataArray:
    """Return 1 where a q-value is at most `alpha`, 0 where it is not, NaN where nothing was tested.

    Its mean is the share of the pixels that were tested.
    """
    rejected = (q_value <= alpha).astype(np.float32)
    return rejected.where(q_value.notnull()).drop_attrs()


def holm(p: npt.NDArray[np.floating[Any]]) -> Floats:
    """Return p-values of a family of tests, adjusted; those that are NaN count for none.

    Holm, "A simple sequentially rejective multiple test procedure", 1979.

    Examples
    --------
    >>> holm(np.array([0.04, np.nan, 0.01, 0.03]))
    array([0.06,  nan, 0.03, 0.06])
    """
    found = np.asarray(p, dtype=np.float64).copy()
    order = np.argsort(found)[: np.count_nonzero(np.isfinite(found))]  # NaN is sorted last
    left = np.arange(len(order), 0, -1)
    found[order] = np.minimum(np.maximum.accumulate(left * found[order]), 1)
    return found


def wilson(
    count: npt.NDArray[Any], n: npt.NDArray[Any], *, level: float = 0.95
) -> npt.NDArray[np.float64]:
    """Return the Wilson score interval of a share, low and high on a new last axis.

    NaN where `n` is 0.

    References
    ----------
    Wilson, "Probable inference, the law of succession, and statistical inference", 1927,
    doi:10.1080/01621459.1927.10502953.

    Examples
    --------
    >>> wilson(np.array(10), np.array(20)).round(4)
    array([0.2993, 0.7007])
    """
    z = special.ndtri(0.5 + level / 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.asarray(count / n)
        scale = 1 / (1 + z**2 / n)
        centre = (share + z**2 / (2 * n)) * scale
        half = z * np.sqrt(share * (1 - share) / n + (z / (2 * n)) ** 2) * scale
    # The interval ends at 0 and 1 there; rounding would leave it a little inside or outside.
    low = np.where(share == 0, 0, centre - half)
    high = np.where(share == 1, 1, centre + half)
    return np.stack([low, high], axis=-1)
