"""Rivals: the distributions of one mode that a mixture has to beat before modes are counted.

Scores are log-likelihoods of log radiance less half of log n for each parameter, n being the
positive samples: BIC over -2, of what the fits describe. Nulls are no part of a shape, and do not
make modes harder to find. The share of zeros counts as a parameter of every fit alike.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from chdstat._positive import Floats, Mask, PositivePart
from chdstat.fit.families import get_family
from chdstat.fit.mle import fit_part, zero_log_likelihood
from chdstat.fit.results import Fit

__all__ = ["rival_scores"]

_SINGLE = ("gamma", "lognormal", "weibull", "burr")
_BOUNDED = 5
"""Of a distribution between two ends: the estimate of an end converges like 1/n, not 1/sqrt(n),
so that it costs log n in the expansion that BIC is from: as much as two regular parameters."""


def rival_scores(
    part: PositivePart,
    usable: Mask,
    bounded: Mask,
    *,
    fits: Iterable[Fit] | None = None,
    single_bic: Floats | None = None,
) -> Floats:
    """Return the largest score of distributions of one mode, shape (...); NaN where not usable.

    They are `fits`, or else what the smallest BIC of some fits, `single_bic`, says, or else the
    fits of four families; and, for the rows that may be `bounded`, the uniform and the log-uniform
    distribution.
    """
    # What likelihoods of radiance have beside those of log radiance of positive samples.
    rest = zero_log_likelihood(part) - part.n * part.log_statistics.log_mean
    log_n, log_good = (np.log(np.maximum(n, 1)) for n in (part.n, part.n_good))
    if single_bic is not None and fits is None:
        scores = [0.5 * (log_good - log_n) - 0.5 * single_bic - rest]
    else:
        fits = (fit_part(part, get_family(name)) for name in _SINGLE) if fits is None else fits
        scores = [
            fit.log_likelihood - rest - 0.5 * (len(fit.parameters) + 1) * log_n for fit in fits
        ]
    for value in _between_ends(part, usable):
        scores.append(np.where(bounded, value - 0.5 * _BOUNDED * log_n, -np.inf))
    return np.where(usable, np.fmax.reduce(scores), np.nan)


def _between_ends(part: PositivePart, usable: Mask) -> tuple[Floats, Floats]:
    """Return log-likelihoods of log x under a log-uniform and a uniform distribution.

    They are -n log(log b - log a) and sum(log x) - n log(b - a), between the extremes a and b.
    """
    last = np.maximum(part.n - 1, 0)[..., np.newaxis]
    high = np.take_along_axis(part.log_sorted, last, axis=-1)[..., 0]
    spread = np.where(usable, high - np.where(usable, part.log_sorted[..., 0], 0), 1.0)
    # log(b - a) without b or a, which may be as large as there are numbers.
    log_range = high + np.log(-np.expm1(-spread))
    n = part.n.astype(np.float64)
    return -n * np.log(spread), n * (part.log_statistics.log_mean - log_range)
