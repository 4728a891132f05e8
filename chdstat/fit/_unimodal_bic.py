"""Distributions of one mode that a mixture has to beat before modes are counted.

Scores are log-likelihoods of log radiance less half of log n for each parameter, n being the
positive samples: BIC over -2, of what the fits describe. Nulls are no part of a shape, and do not
make modes harder to find. The share of zeros counts as a parameter of every fit alike.

A hard edge is not a mode: families that begin at zero radiance cannot follow one, and mixtures of
them imitate it with a narrow component. So `edge_scores` has rivals whose ends are free: gamma
distributions above a floor, and all that are log-concave in log radiance, or in the logarithm of
the distance from either end. The likelihood of an end is not a regular one (Cheng and Traylor,
"Non-regular maximum likelihood problems", 1995, doi:10.1111/j.2517-6161.1995.tb02012.x), and a
log-concave density has no fixed number of parameters. What they count as here was measured.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy import special

from chdstat._positive import Counts, Floats, Mask, PositivePart
from chdstat.fit._cells import SPREAD_FLOOR
from chdstat.fit._components import COMPONENTS
from chdstat.fit._log_concave import log_concave_likelihood
from chdstat.fit.families import get_family
from chdstat.fit.mle import fit_part, zero_log_likelihood
from chdstat.fit.results import Fit

__all__ = ["edge_scores", "log_samples", "unimodal_scores"]

_SINGLE = ("gamma", "lognormal", "weibull", "burr")
_BOUNDED = 5
"""Of a distribution between two ends: the estimate of an end converges like 1/n, not 1/sqrt(n),
so that it costs log n in the expansion that BIC is from: as much as two regular parameters."""
_ABOVE_FLOOR, _BELOW_CEILING, _LOG_CONCAVE = 3.5, 5.0, 9.2
"""Parameters that the rivals of `edge_scores` count as: as few, or as much likelihood, as it takes
to find more than one mode in at most 5 % of the samples of hard-edged distributions, and as many as
it takes to find nearly all that are there (``tests/benchmarks/test_modes.py``)."""
_FEW = 128
"""BIC is an expansion for many samples: of fewer than these, a mixture fits chance."""
_FLOORS = (0.03, 0.12, 0.4, 1.5)
"""Distances of a floor from the smallest sample, in ranges of the samples."""
_NEXT = 3
"""Samples that say how dense a distribution is at its end."""
_CLOSEST = 1e-12


def log_samples(n: Counts) -> Floats:
    """Return the log n of a score: at least that of 128 samples."""
    return np.asarray(np.log(np.maximum(n, _FEW)))


def unimodal_scores(
    part: PositivePart, usable: Mask, bounded: Mask, *, fits: Iterable[Fit] | None = None
) -> Floats:
    """Return the largest score of distributions of one mode, shape (...); NaN where not usable.

    They are `fits`, or else the fits of four families; Pareto distributions above a floor, and the
    like below a ceiling; and, for the rows that may be `bounded`, the uniform and the log-uniform
    distribution.
    """
    # What likelihoods of radiance have beside those of log radiance of positive samples.
    rest = zero_log_likelihood(part) - part.n * part.log_statistics.log_mean
    log_n = log_samples(part.n)
    fits = (fit_part(part, get_family(name)) for name in _SINGLE) if fits is None else fits
    scores = [fit.log_likelihood - rest - 0.5 * (len(fit.parameters) + 1) * log_n for fit in fits]
    low, high = _ends(part, usable)
    scores += [
        np.where(bounded, value - 0.5 * _BOUNDED * log_n, -np.inf)
        for value in _between_ends(part, low, high)
    ]
    scores += [value - 0.5 * (_BOUNDED - 1) * log_n for value in _from_an_end(part, low, high)]
    return np.where(usable, np.fmax.reduce(scores), np.nan)


def edge_scores(ascending: Floats, n: Counts, bar: Floats) -> Floats:
    """Return the largest score of distributions of one mode with free ends, shape (row,).

    Where gamma distributions reach the `bar`, the rest is not computed.

    Parameters
    ----------
    ascending
        Log radiance in ascending order, shape (row, sample), not all equal.
    n
        How many of them count, shape (row,), at least 20.
    bar
        Score to be beaten, shape (row,).
    """
    log_n = log_samples(n)
    mirrored = _mirrored(ascending, n)
    best = np.fmax(
        _gamma_above_a_floor(ascending, n) - 0.5 * _ABOVE_FLOOR * log_n,
        _gamma_above_a_floor(mirrored, n) - 0.5 * _BELOW_CEILING * log_n,
    )
    for likelihood, values in (
        (log_concave_likelihood, ascending),
        (_log_concave_above_a_floor, ascending),
        (_log_concave_above_a_floor, mirrored),
    ):
        rows = np.flatnonzero(best < bar)
        value = likelihood(values[rows], n[rows]) - 0.5 * _LOG_CONCAVE * log_n[rows]
        best[rows] = np.fmax(best[rows], value)
    return best


def _ends(part: PositivePart, usable: Mask) -> tuple[Floats, Floats]:
    """Return log radiance of the smallest and the largest sample; 0 and 1 where not usable."""
    last = np.maximum(part.n - 1, 0)[..., np.newaxis]
    high = np.take_along_axis(part.log_sorted, last, axis=-1)[..., 0]
    return np.where(usable, part.log_sorted[..., 0], 0.0), np.where(usable, high, 1.0)


def _between_ends(part: PositivePart, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return log-likelihoods of log x under a log-uniform and a uniform distribution.

    They are -n log(log b - log a) and sum(log x) - n log(b - a), between the extremes a and b.
    """
    # log(b - a) without b or a, which may be as large as there are numbers.
    log_range = high + np.log(-np.expm1(low - high))
    n = part.n.astype(np.float64)
    return -n * np.log(high - low), n * (part.log_statistics.log_mean - log_range)


def _from_an_end(part: PositivePart, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return log-likelihoods of log x, exponential above the smallest, or below the largest."""
    mean = part.log_statistics.log_mean
    with np.errstate(invalid="ignore", divide="ignore"):
        return -part.n * (np.log(mean - low) + 1), -part.n * (np.log(high - mean) + 1)


def _mirrored(ascending: Floats, n: Counts) -> Floats:
    """Return log 1/x in ascending order."""
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    return np.sort(np.where(valid, -ascending, np.inf), axis=-1)


def _gamma_above_a_floor(ascending: Floats, n: Counts) -> Floats:
    """Return the log-likelihood of log x where x less a floor has a gamma distribution.

    Of floors at a few distances below the smallest sample, the nearest at half the mean distance
    between samples: the likelihood rises without bound towards the sample itself.
    """
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    last = np.take_along_axis(ascending, n[:, np.newaxis] - 1, axis=-1)
    log = np.where(valid, ascending - last, 0.0)
    x = np.exp(log)
    above = x - x[:, :1]
    gamma, one = COMPONENTS["gamma"], np.ones(len(n))
    best = np.full(len(n), -np.inf)
    for distance in (0.5 / n, *_FLOORS):
        z = above + (distance * (1 - x[:, 0]))[:, np.newaxis]
        mean = np.vecdot(z, valid) / n
        z /= mean[:, np.newaxis]
        log_z = np.vecdot(np.log(z, out=z), valid) / n
        _, _, log_shape = gamma.maximise(one, log_z, one, one * SPREAD_FLOOR)
        k = np.exp(log_shape)
        value = (k - 1) * log_z + k * (log_shape - 1) - special.gammaln(k) - np.log(mean)
        best = np.fmax(best, n * value)
    return np.asarray(best + log.sum(axis=-1))


def _log_concave_above_a_floor(ascending: Floats, n: Counts) -> Floats:
    """Return the log-likelihood of log x where log(x - a) is log-concave, a the smallest sample.

    That one is as likely as the distance to its neighbours says.
    """
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    above = np.where(valid, np.maximum(ascending - ascending[:, :1], _CLOSEST), 1.0)
    log_share = np.log(-np.expm1(-above))
    rest = np.where(valid, ascending + log_share, np.inf)[:, 1:]
    jacobian = np.where(valid, log_share, 0.0)[:, 1:].sum(axis=-1)
    first = np.log(_NEXT / n / np.expm1(above[:, _NEXT]))
    return np.asarray(log_concave_likelihood(rest, n - 1) - jacobian + first)
