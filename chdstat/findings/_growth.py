"""Growth: how much larger a moment would be, were there more samples.

Skewness and kurtosis rest on the rare bright samples of a tail, most of which a pixel has not seen:
they are too small, and grow with the number of samples. That they lie above a border is then safe
to say, that they lie below one is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import reduce

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._moments import Moments
from chdstat.findings.resampling import Spread

__all__ = ["growing", "with_room"]

Floats = npt.NDArray[np.float64]
Growing = tuple[Floats, Floats, Floats]

_SLOWEST = 0.8
"""Ratio of successive gains that is believed, at least: with gamma and log-normal samples it lies
between 0.6 and 0.9, and smaller where noise makes it so."""
_REACH = 2.0
"""Standard errors up to which a gain may be noise."""


def growing(
    x: npt.NDArray[np.floating], good: npt.NDArray[np.bool_], statistic: Callable[[Moments], Floats]
) -> Growing:
    """Return a moment of quarters, of halves and of all of the samples.

    Parameters
    ----------
    x, good
        Samples, shape (pixel, ..., sample), and those that count.
    statistic
        Reads it off the moments.

    Returns
    -------
    tuple
        Shapes (4 pixel, ...), (2 pixel, ...) and (pixel, ...).
    """
    quarters = [Moments.of(x[..., i::4], good[..., i::4]) for i in range(4)]
    halves = [quarters[0].merge(quarters[2]), quarters[1].merge(quarters[3])]
    levels = (quarters, halves, [reduce(Moments.merge, halves)])
    first, second, third = (np.concatenate([statistic(m) for m in level]) for level in levels)
    return first, second, third


def with_room(found: Spread, grown: Growing) -> Spread:
    """Return a median over pixels with room above for the samples that are missing.

    Of a quarter, half and all of the samples, the median gains d1 and then d2. If each doubling
    gains d2 / d1 = r of the one before, all that are to come gain d2 r / (1 - r): Aitken's
    extrapolation ("On Bernoulli's numerical solution of algebraic equations", 1926,
    doi:10.1017/S0370164600022070). Where gains do not shrink, there is no upper end. The noise of
    the median counts as a gain, too.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.lognormal(0, 0.75, size=(2000, 384))
    >>> grown = growing(x, x > 0, lambda moments: moments.skewness)
    >>> found = with_room(Spread(np.median(grown[-1]), 2.6, 2.7, 0.95), grown)
    >>> found.high > 3.26 > 2.7  # the skewness of that distribution
    True
    """
    quarter, half, whole = (_median(values) for values in grown)
    before, gain = half - quarter, whole - half
    if not math.isfinite(before + gain):
        return found
    noise = _REACH * _error(grown[-1])
    ratio = _SLOWEST
    if gain > noise:
        ratio = max(gain / before, ratio) if before > 0 else math.inf
    room = (max(gain, 0.0) + noise) * ratio / (1 - ratio) if ratio < 1 else math.inf
    return replace(found, high=found.high + room)


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def _error(values: Floats) -> float:
    """Return the standard error of the median of independent normal values, shape (pixel, ...)."""
    known = values[np.isfinite(values)]
    deviation = stats.median_abs_deviation(known, scale="normal")
    return float(deviation * math.sqrt(math.pi / 2 / len(values)))
