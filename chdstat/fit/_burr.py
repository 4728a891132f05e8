"""Burr XII: a body of any width with a power tail; Weibull is its light-tailed limit.

``f(x) = (c d / s) (x/s)^(c-1) (1 + (x/s)^c)^(-d-1)``, which economists call Singh-Maddala. Its tail
index is ``1 / (c d)``. The likelihood has no maximum where it rises towards one of two limits; such
rows are NaN:

- `AT_LIMIT`: as d grows without bound, the distribution becomes a Weibull distribution. The Weibull
  fit describes the row.
- `AT_PARETO_LIMIT`: as c grows without bound while c d does not, the distribution becomes a power
  law that begins at the smallest sample, as above a floor of ambient light. No family of this
  library describes the row; `chdstat.fit.tail_index` estimates the index of its tail.

Standard errors come from the observed information.

References
----------
Burr, "Cumulative frequency functions", 1942, doi:10.1214/aoms/1177731607. Singh and Maddala, "A
function for size distribution of incomes", 1976, doi:10.2307/1911538. Shao, "Notes on maximum
likelihood estimation for the three-parameter Burr XII distribution", 2004,
doi:10.1016/S0167-9473(02)00367-5.

Examples
--------
>>> import chdstat as chd
>>> x = stats.burr12(2.0, 0.5, scale=3.0).rvs(4096, random_state=1)
>>> result = chd.fit.burr(x)
>>> round(1 / float(result.parameters["c"] * result.parameters["d"]), 1)
1.0
"""

from __future__ import annotations

import numpy as np
from scipy import special, stats

from chdstat._core.arrays import Floats, Mask
from chdstat._core.positive import Part
from chdstat._core.statistic import RADIANCE
from chdstat.errors import Reason
from chdstat.fit.family import Estimate, Family, Parameters, WeightedSamples, summed
from chdstat.fit.mle import maximise

_LEAST = 1e-4
"""Floor of b: below it, d is about 1e4 or more, which no sample can tell from the Weibull limit."""
_NEAR_LIMIT = 0.01
_SHAPES = np.exp(np.linspace(np.log(0.02), np.log(100), 200))
"""Shapes d at which the skewness of log x is tabulated for the start."""
_SKEWNESS = (special.polygamma(2, 1) - special.polygamma(2, _SHAPES)) / (
    special.polygamma(1, 1) + special.polygamma(1, _SHAPES)
) ** 1.5


def _estimate(part: Part, near: Parameters | None, tolerance: float) -> Estimate:
    """Maximise the profile likelihood of a = log c and b = log(1 + q), q = log(1 + e^rho).

    With v = c (log x - log scale), rho is v at the log mean. d is profiled out: ``1 / d = mean
    log(1 + e^v)``.

    At the Weibull limit, d and the scale go to infinity together, q goes to 0, and the profile
    stays smooth. If it rises all the way to q = 0, no Burr distribution attains the maximum (Shao
    2004, doi:10.1016/S0167-9473(02)00367-5).

    Nor does one if the profile rises while c goes to infinity and c d stays: that limit is a power
    law above the smallest sample. On the way there, q grows with c, so that the ridge of the
    profile is straight in a and b.
    """
    start = None
    if near is not None:
        rho = near["c"] * (part.log_statistics.log_mean - np.log(near["scale"]))
        start = np.log(near["c"]), np.maximum(np.log1p(np.logaddexp(0, rho)), _LEAST)
    c, d, scale, c_error, d_error, scale_error, converged, limit = maximise(
        part,
        _profile,
        start=_start,
        finish=_finish,
        names=8,
        minimum=BURR.minimum,
        floor=_LEAST,
        near=start,
        tolerance=tolerance,
    )
    log_mean = part.log_statistics.log_mean
    # The mean of log(1 + (x/s)^c) is 1 / d.
    likelihood = np.log(c * d) + c * (log_mean - np.log(scale)) - 1 - 1 / d - log_mean
    return Estimate(
        parameters={"c": c, "d": d, "scale": scale},
        standard_errors={"c": c_error, "d": d_error, "scale": scale_error},
        converged=converged == 1,
        limit=np.nan_to_num(limit).astype(np.int8),
        log_likelihood=part.n * likelihood,
    )


def _finish(points: WeightedSamples, at: Floats, converged: Mask) -> Floats:
    """Return parameters, standard errors, convergence, and the code of a limit, (8, row)."""
    c, rho = np.exp(at[0]), _log_expm1(np.expm1(at[1]))
    level, rest = _logistic(points, c, rho)
    d = 1 / level
    scale = np.exp(points.log_mean - rho / c)
    errors = _standard_errors(points, rest, c, d, rho)
    errors[2] *= scale
    # A maximum at the floor is the Weibull limit. Any other maximum is a local one if the power law
    # above the smallest sample, the limit of growing c, is likelier.
    reached = at[0] + rho - np.log(level) - level
    weibull = converged & (at[1] <= 2 * _LEAST)
    # The limit of the profile as c goes to infinity, -log mean log(x / smallest x).
    power_law = -np.log(-np.where(points.weight > 0, points.log, 0).min(axis=-1))
    limit = np.where(weibull, Reason.AT_LIMIT, Reason.OK)
    limit = np.where(power_law >= reached, Reason.AT_PARETO_LIMIT, limit)
    interior = (limit == Reason.OK) & np.isfinite(errors).all(axis=0)
    return np.stack([c, d, scale, *errors, converged & interior, limit])


def _start(points: WeightedSamples) -> Floats:
    """Match mean, variance and skewness of log x: cumulants of v are polygamma functions of d.

    If the samples form two heaps, the likelihood may have one maximum there and one in the Weibull
    limit. A second start therefore lies close to that limit.
    """
    square = points.log**2
    variance = points.average(square)
    square *= points.log
    skewness = points.average(square) / variance**1.5
    # Tables must ascend; the skewness falls as d grows.
    d = np.interp(skewness, _SKEWNESS[::-1], _SHAPES[::-1])
    c = np.sqrt((special.polygamma(1, 1) + special.polygamma(1, d)) / variance)
    rho = special.digamma(1) - special.digamma(d)
    weibull = np.log(np.pi / np.sqrt(6 * variance))
    cumulants = np.stack([np.log(c), np.log1p(np.logaddexp(0, rho))])
    return np.stack([cumulants, np.stack([weibull, np.full_like(weibull, _NEAR_LIMIT)])])


def _profile(points: WeightedSamples, at: Floats) -> Floats:
    """Profile log-likelihood per sample, ``log c + mean v - log L - L`` with L = 1 / d."""
    c, rho = np.exp(at[0]), _log_expm1(np.expm1(at[1]))
    level, rest = _logistic(points, c, rho)
    l_rho, l_c, _ = points.moments(1 - rest)
    l_rho_rho, l_rho_c, l_c_c = points.moments(_slope(rest))
    f, g = 1 + 1 / level, 1 / level**2
    by_c, by_rho = 1 / c - f * l_c, 1 - f * l_rho
    by_c_c = -1 / c**2 + g * l_c**2 - f * l_c_c
    by_rho_c = g * l_c * l_rho - f * l_rho_c
    by_rho_rho = g * l_rho**2 - f * l_rho_rho
    # From (c, rho) to (a, b): d rho / d q = 1 + e^-rho, and d q / d b = e^b.
    rise, more = np.exp(at[1]), np.exp(-rho)
    stretch = rise * (1 + more)
    value = at[0] + rho - np.log(level) - level
    mixed = c * stretch * by_rho_c
    by_b_b = stretch**2 * by_rho_rho + (1 - more * rise) * stretch * by_rho
    curvatures = c**2 * by_c_c + c * by_c, mixed, by_b_b
    return np.stack([value, c * by_c, stretch * by_rho, *curvatures])


def _standard_errors(
    points: WeightedSamples, rest: Floats, c: Floats, d: Floats, rho: Floats
) -> Floats:
    """Return standard errors of c, d and log scale, shape (3, row), from observed information."""
    offset = rho / c
    # Moments of the logistic function and its derivative by t = log x - log scale.
    mean, first, _ = points.moments(1 - rest)
    zero, one, two = points.moments(_slope(rest))
    two = two + 2 * offset * one + offset**2 * zero
    one = one + offset * zero
    cc, cs, ss = 1 / c**2 + (d + 1) * two, -(d + 1) * c * one, (d + 1) * c**2 * zero
    cd, sd, dd = first + offset * mean, -c * mean, 1 / d**2
    determinant = cc * (ss * dd - sd**2) - cs * (cs * dd - sd * cd) + cd * (cs * sd - ss * cd)
    inverse = np.stack([ss * dd - sd**2, cc * ss - cs**2, cc * dd - cd**2]) / determinant
    return np.asarray(np.sqrt(np.where(inverse > 0, inverse, np.nan) / points.n))


def _logistic(points: WeightedSamples, c: Floats, rho: Floats) -> tuple[Floats, Floats]:
    """Return mean log(1 + e^v), and 1 / (1 + e^v) at every point."""
    v = points.log * c[:, np.newaxis]
    v += rho[:, np.newaxis]
    power = np.exp(v, out=v)
    power += 1
    rest = np.reciprocal(power)
    return points.average(np.log(power, out=power)), rest


def _slope(rest: Floats) -> Floats:
    """Return the derivative of the logistic function, e^v / (1 + e^v)^2; works in `rest`."""
    square = rest * rest
    return np.subtract(rest, square, out=rest)


def _log_expm1(q: Floats) -> Floats:
    """Return log(e^q - 1), the inverse of log(1 + e^rho)."""
    return np.asarray(q + np.log(-np.expm1(-q)))


def _log_density(points: WeightedSamples, parameters: Parameters) -> Floats:
    c, d = parameters["c"], parameters["d"]
    shift = (points.log_mean - np.log(parameters["scale"])) * c
    v = points.log * c[:, np.newaxis]
    v += shift[:, np.newaxis]
    # A row without a fit is NaN; it must not hide that another row is too large for exp.
    if np.fmax.reduce(v, axis=None, initial=0) > 700:
        density = np.logaddexp(0, v)
    else:
        density = np.log1p(np.exp(v))
    density *= -(d + 1)[:, np.newaxis]
    density += v
    density += np.log(c * d)[:, np.newaxis]
    return np.asarray(density)


def _mean(parameters: Parameters) -> Floats:
    """Return ``s d B(1 + 1/c, d - 1/c)``, infinite where c d <= 1; SciPy has NaN there."""
    c, d = parameters["c"], parameters["d"]
    log_mean = np.log(parameters["scale"]) + np.log(d) + special.betaln(1 + 1 / c, d - 1 / c)
    return np.asarray(np.where(c * d <= 1, np.inf, np.exp(log_mean)))


BURR = Family(
    name="burr",
    label="Burr",
    documentation=__doc__,
    units={"c": "1", "d": "1", "scale": RADIANCE},
    estimate=_estimate,
    log_likelihood=summed(_log_density),
    log_density=_log_density,
    distribution=lambda p: stats.burr12(p["c"], p["d"], scale=p["scale"]),
    mean=_mean,
    errors_from={"c": 60, "d": 60, "scale": 60},
    density="(cd/s) (x/s)^{c-1} (1 + (x/s)^c)^{-d-1}",
    tail_index=":math:`1 / (cd)`",
    error_formula="observed information",
)
