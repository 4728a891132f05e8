"""Gamma: what the paper sees most often.

``f(x) = x^(shape-1) exp(-x/scale) / (Gamma(shape) scale^shape)``. Newton's method solves
``log(shape) - digamma(shape) = log(mean) - mean(log x)``.

References
----------
Minka, "Estimating a Gamma distribution", technical report, 2002.

Examples
--------
>>> import chdstat as chd
>>> result = chd.fit.gamma([0.0, 0.0, 1.0, 2.0, 3.0])
>>> float(result.null_share), round(float(result.parameters["shape"]), 3)
(0.4, 5.375)
"""

from __future__ import annotations

import numpy as np
from scipy import special, stats

from chdstat._core.arrays import Floats, Mask
from chdstat._core.positive import Part
from chdstat._core.statistic import RADIANCE
from chdstat.fit.family import Estimate, Family, Parameters, WeightedSamples

_ITERATIONS = 20
_TOLERANCE = 1e-12


def _estimate(part: Part, *_search: object) -> Estimate:
    sums = part.log_statistics
    shape, converged = gamma_shape(sums.gap)
    scale = np.asarray(sums.mean / shape)
    # Inverse of the Fisher information; excess = shape * trigamma(shape) - 1.
    excess = shape * _gap_slope(shape)
    shape_error = np.sqrt(shape / (sums.n * excess))
    scale_error = scale * np.sqrt((1 + excess) / shape / (sums.n * excess))
    return Estimate(
        parameters={"shape": shape, "scale": scale},
        standard_errors={"shape": shape_error, "scale": scale_error},
        converged=converged,
    )


def gamma_shape(gap: Floats) -> tuple[Floats, Mask]:
    """Solve log(k) - digamma(k) = gap (Minka 2002, "Estimating a Gamma distribution")."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        k = np.asarray((3 - gap + np.sqrt((gap - 3) ** 2 + 24 * gap)) / (12 * gap))
        step = np.full_like(k, np.inf)
        for _ in range(_ITERATIONS):
            # Newton in 1/k, in which the equation is nearly linear.
            inverse = 1 / k + (gap - gap_of_shape(k)) / (k**2 * _gap_slope(k))
            step = np.abs(k * inverse - 1)
            k = 1 / inverse
            if not (step > _TOLERANCE).any():
                break
    return k, np.asarray(step <= 1e-9)


def gap_of_shape(k: Floats) -> Floats:
    """Return log(k) - digamma(k)."""
    # Both terms grow while their difference falls; the asymptotic series keeps its digits.
    series = (1 + (1 - 0.1 / k**2) / (6 * k)) / (2 * k)
    return np.where(k > 1e3, series, np.log(k) - special.digamma(k))


def _gap_slope(k: Floats) -> Floats:
    """Return trigamma(k) - 1/k, minus the derivative of the gap by k."""
    series = (1 + (1 - 0.2 / k**2) / (3 * k)) / (2 * k**2)
    return np.where(k > 1e3, series, special.polygamma(1, k) - 1 / k)


def _log_likelihood(part: Part, parameters: Parameters) -> Floats:
    sums, k = part.log_statistics, parameters["shape"]
    # Written around mean = k * scale, where the maximum is, so that large terms cancel first.
    ratio = sums.mean / (k * parameters["scale"])
    off = k * (np.log(ratio) - (ratio - 1))
    per_sample = off + _peak(k) - (k - 1) * sums.gap - np.log(sums.mean)
    return np.asarray(sums.n * per_sample)


def _peak(k: Floats) -> Floats:
    """Return k log(k) - k - log(Gamma(k)), by Stirling's series where the terms are large."""
    series = 0.5 * np.log(k / (2 * np.pi)) - 1 / (12 * k)
    return np.where(k > 1e3, series, special.xlogy(k, k) - k - special.gammaln(k))


def _log_density(points: WeightedSamples, parameters: Parameters) -> Floats:
    shape = parameters["shape"]
    # With z = x / mean, log f(log x) = k (log z - z + 1) + peak: large terms cancel in the peak.
    log_mean = np.log(shape * parameters["scale"]) - points.log_mean
    log = points.log - log_mean[:, np.newaxis]
    density = log - np.expm1(log)
    density *= shape[:, np.newaxis]
    density += _peak(shape)[:, np.newaxis]
    return density


GAMMA = Family(
    name="gamma",
    label="gamma",
    documentation=__doc__,
    units={"shape": "1", "scale": RADIANCE},
    estimate=_estimate,
    log_likelihood=_log_likelihood,
    log_density=_log_density,
    distribution=lambda p: stats.gamma(p["shape"], scale=p["scale"]),
    errors_from={"scale": 60},
    density=r"x^{k-1} e^{-x/s} / (\Gamma(k)\, s^k)",
    tail_index="0",
    error_formula="expected information",
)
