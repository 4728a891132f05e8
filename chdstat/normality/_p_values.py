"""P-values of statistics of normality, mean and variance estimated, by the number of samples.

They are interpolated between simulated quantiles (`chdstat.normality._tables`), since the published
approximations are not uniform under the null: of 100 samples, p = 0.001 by chi-square happens in
0.004 of the cases for D'Agostino and Pearson; Stephens' formulas for Anderson-Darling are off by
0.03 near p = 0.6. Those of Royston for Shapiro-Wilk are within 0.013 of
p, and 7 % of it down to 0.01, for 30 to 2000 samples, and used there.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from chdstat._null_quantiles import interpolated_p
from chdstat._positive import Counts, Floats
from chdstat.normality._statistics import SCALES
from chdstat.normality._tables import LEVELS, QUANTILES

__all__ = [
    "anderson_darling_p",
    "dagostino_p",
    "shapiro_wilk_p",
]

_FLOOR = 1e-16
"""Smallest p-value told: a bound."""
_ROYSTON = (30, 2000)
"""Samples for which the formulas of Shapiro-Wilk hold: at 5000, their 0.05 happens in 0.044."""


def anderson_darling_p(statistic: Floats, n: Counts) -> Floats:
    """Return p-values of A*^2 (D'Agostino and Stephens 1986, chapter 4), by simulation."""
    return _simulated("anderson_darling", statistic, n)


def dagostino_p(statistic: Floats, n: Counts) -> Floats:
    """Return p-values by simulation: the two normal scores are uncorrelated, not independent."""
    return _simulated("dagostino", statistic, n)


def shapiro_wilk_p(statistic: Floats, n: Counts) -> Floats:
    """Return p-values of W (Royston 1995, AS R94), by simulation where his formulas are worse."""
    log_n = np.log(n)
    mean = np.polyval([0.0038915, -0.083751, -0.31082, -1.5861], log_n)
    deviation = np.exp(np.polyval([0.0030302, -0.082676, -0.4803], log_n))
    p = _floored(special.ndtr((mean - np.log1p(-statistic)) / deviation))
    outside = (n < _ROYSTON[0]) | (n > _ROYSTON[1])
    if outside.any():
        p[outside] = _simulated("shapiro_wilk", statistic[outside], n[outside])
    return p


def _simulated(name: str, statistic: Floats, n: Counts) -> Floats:
    scaled = SCALES[name](statistic, n.astype(np.float64))
    return interpolated_p(scaled, n, LEVELS, QUANTILES[name], _FLOOR)


def _floored(p: Floats) -> Floats:
    return np.asarray(np.where(p < _FLOOR, _FLOOR, p))
