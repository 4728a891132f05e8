"""Null quantiles: p-values between simulated quantiles, by the number of samples.

A table of quantiles is a row for each level, the probability above the quantile, of coefficients of
a polynomial in 1 / sqrt(n): smooth in n, it holds for any number of samples. The tables are written
by tools/make_normality_tables.py and tools/make_dip_table.py.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from chdstat._positive import Counts, Floats

__all__ = ["interpolated_p"]


def interpolated_p(
    scaled: Floats, n: Counts, levels: Floats, coefficients: Floats, floor: float
) -> Floats:
    """Return P(larger statistic), at least `floor`: a bound there.

    Log odds of p are linear in the statistic between quantiles, and beyond the table.

    Parameters
    ----------
    scaled
        Statistics, as they were scaled for the table, shape (row,).
    n
        Samples, shape (row,).
    levels
        Descending, shape (level,).
    coefficients
        Of the quantiles, shape (level, power of 1 / sqrt(n)).
    """
    powers = n[:, np.newaxis] ** (-0.5 * np.arange(coefficients.shape[-1]))
    quantiles = np.maximum.accumulate(powers @ coefficients.T, axis=-1)
    right = np.count_nonzero(quantiles <= scaled[:, np.newaxis], axis=-1)
    right = np.clip(right, 1, len(levels) - 1)
    row = np.arange(len(right))
    low, high = quantiles[row, right - 1], quantiles[row, right]
    odds = special.logit(levels)
    slope = (odds[right] - odds[right - 1]) / (high - low)
    p = special.expit(odds[right - 1] + slope * (scaled - low))
    return np.asarray(np.where(p < floor, floor, p))
