"""Generalised Pareto: excesses over a threshold, or a CHD whose density falls from the start.

``P(X > x) = (1 + xi x / scale)^(-1/xi)``. For xi <= -1/2, the likelihood is not regular and
standard errors are NaN. For xi < -1, it has no maximum, and the reason is `AT_LIMIT`. The standard
error of xi is ``max(1 + xi, 0.9) / sqrt(n)``; with fewer than 128 samples that is too small, and
the error is NaN.

References
----------
Grimshaw, "Computing maximum likelihood estimates for the generalized Pareto distribution",
1993, doi:10.1080/00401706.1993.10485040. Smith, "Maximum likelihood estimation in a class of
nonregular cases", 1985, doi:10.1093/biomet/72.1.67.

Examples
--------
>>> import chdstat as chd
>>> x = np.random.default_rng(1).pareto(2.0, size=4096)
>>> round(float(chd.fit.pareto(x).parameters["xi"]), 1)
0.5
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from chdstat._core.arrays import Floats, Mask
from chdstat._core.positive import Part
from chdstat._core.statistic import RADIANCE
from chdstat.errors import Reason
from chdstat.fit.family import Estimate, Family, Parameters, WeightedSamples, summed
from chdstat.fit.mle import maximise

_GRID = np.r_[-7.0, -5:-1:5j, -0.5, 0.25, 1:4, 4:12:2, 14:46:4]
"""Starts s: the ratio xi / scale is (e^s - 1) / largest x."""
_LEAST = -0.99
"""A search that has not ended and is below this xi was on its way past xi = -1."""
_AT_EDGE = -6.0
"""Below this s, the support ends within 0.3 % of the largest x, and the profile is flat."""
_LEAST_ERROR = 0.9
"""Least standard error of xi times sqrt(n), as in `chdstat.fit.tail_index`."""
_SMALL = 1e-2
_TERMS = 9
"""Terms of the series about xi = 0; the first omitted term is below double precision."""


def _estimate(part: Part, *_search: object) -> Estimate:
    """Maximise the profile likelihood of Grimshaw 1993 in s of `_GRID`.

    ``xi = mean log(1 + theta x)`` for theta = xi / scale. The likelihood has no bound as theta goes
    to -1 / max x, where xi < -1. The search therefore looks for the local maximum above that
    (doi:10.1080/00401706.1993.10485040).
    """
    xi, scale, converged, limit = maximise(
        part, _profile, start=_best_of_grid, finish=_finish, names=4, minimum=PARETO.minimum
    )
    # Smith 1987, doi:10.1214/aos/1176350499; for xi <= -1/2, the errors no longer hold.
    regular = np.where(xi > -0.5, 1 + xi, np.nan)
    errors = {
        # For bounded tails, errors do not fall with xi as theory says.
        "xi": np.maximum(regular, _LEAST_ERROR) / np.sqrt(part.n),
        "scale": scale * np.sqrt(2 * regular / part.n),
    }
    return Estimate(
        {"xi": xi, "scale": scale}, errors, converged == 1, np.nan_to_num(limit).astype(np.int8)
    )


def _finish(points: WeightedSamples, at: Floats, converged: Mask) -> Floats:
    """Return xi, scale, convergence, and the code where there is no maximum, shape (4, row)."""
    u = np.expm1(at[0])
    relative, _, _ = _moments(points, _ratio(points), u)
    xi = u * relative
    scale = np.exp(points.log_mean + points.log_top) * relative
    # No sample of a bin lies at its edge: a support that ends there may be likeliest.
    bounded = np.zeros_like(converged) if points.single else at[0] < _AT_EDGE
    converged = (converged | bounded) & (xi > -1)
    # A search that reaches xi = -1 cannot end: beyond it, the likelihood has no bound.
    limit = np.where(~converged & (xi < _LEAST), Reason.AT_LIMIT, Reason.OK)
    return np.stack([xi, scale, converged, limit])


def _best_of_grid(points: WeightedSamples) -> Floats:
    ratio, values = _ratio(points), []
    for u in np.expm1(_GRID):
        xi = points.average(np.log1p(u * ratio))
        values.append(np.where(xi > -1, -np.log(xi / u) - xi, -np.inf))
    best = _GRID[np.argmax(values, axis=0)]
    return np.stack([best, np.zeros_like(best)])


def _profile(points: WeightedSamples, at: Floats) -> Floats:
    """Profile log-likelihood per sample, ``-log scale - xi``, by s."""
    u, ratio = np.expm1(at[0]), _ratio(points)
    # g = xi / u is the scale relative to the largest sample.
    g, slope, curvature = _moments(points, ratio, u)
    xi = u * g
    value = np.where(xi > -1, -np.log(g) - xi, np.nan)
    by_u = -slope / g - g - u * slope
    by_u_u = -curvature / g + (slope / g) ** 2 - 2 * slope - u * curvature
    return np.stack([value, (1 + u) * by_u, (1 + u) ** 2 * by_u_u + (1 + u) * by_u])


def _ratio(points: WeightedSamples) -> Floats:
    ratio = points.log - points.log_top[:, np.newaxis]
    return np.asarray(np.exp(ratio, out=ratio))


def _moments(points: WeightedSamples, ratio: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
    """Return g(u) = mean log(1 + u r) / u with its first two derivatives, shape (3, row)."""
    power = u[:, np.newaxis] * ratio
    tilted = ratio / (1 + power)
    g = points.average(np.log1p(power)) / u
    first = points.average(tilted)
    slope = (first - g) / u
    curvature = (-points.average(tilted**2) - 2 * slope) / u
    small = np.abs(u) < _SMALL
    if small.any():
        series = _series(points.take(small), ratio[small], u[small])
        g[small], slope[small], curvature[small] = series
    return g, slope, curvature


def _series(points: WeightedSamples, ratio: Floats, u: Floats) -> Floats:
    """Sum the series of log(1 + u r) / u, whose closed form loses its digits near u = 0."""
    result, power = np.zeros((3, len(u))), np.ones_like(ratio)
    for j in range(_TERMS):
        power = power * ratio
        term = (-1) ** j * points.average(power) / (j + 1)
        result[0] += term * u**j
        result[1] += term * j * u ** max(j - 1, 0)
        result[2] += term * j * (j - 1) * u ** max(j - 2, 0)
    return result


def _log_density(points: WeightedSamples, parameters: Parameters) -> Floats:
    xi, scale = parameters["xi"], parameters["scale"]
    log = points.log + (points.log_mean - np.log(scale))[:, np.newaxis]
    x = np.exp(log)
    product = xi[:, np.newaxis] * x
    # Near xi = 0, log(1 + xi x) / xi is x less a term of second order.
    ratio = np.where(np.abs(product) < 1e-9, x, np.log1p(product) / xi[:, np.newaxis])
    density = np.where(product <= -1, -np.inf, log - (1 + xi)[:, np.newaxis] * ratio)
    return np.asarray(density)


PARETO = Family(
    name="pareto",
    label="generalised Pareto",
    documentation=__doc__,
    units={"xi": "1", "scale": RADIANCE},
    estimate=_estimate,
    log_likelihood=summed(_log_density),
    log_density=_log_density,
    distribution=lambda p: stats.genpareto(p["xi"], scale=p["scale"]),
    errors_from={"xi": 128, "scale": 128},
    density=r"(1 + \xi x / s)^{-1/\xi - 1} / s",
    tail_index=r":math:`\xi`",
    error_formula=r":math:`\max(1 + \xi, 0.9) / \sqrt{n}` of :math:`\xi`, if :math:`\xi > -1/2`",
    typical={"xi": (-0.4, 1.0), "scale": (1.0, 1.0)},
)
