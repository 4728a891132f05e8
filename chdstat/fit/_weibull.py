"""Weibull: an exponential, stretched or squeezed; the light-tailed limit of Burr distributions.

``f(x) = (k/s) (x/s)^(k-1) exp(-(x/s)^k)``, where k is the shape and s the scale. Newton's method
solves ``mean(x^k log x) / mean(x^k) - 1/k = mean(log x)``; then ``s = mean(x^k)^(1/k)``.

References
----------
Johnson, Kotz and Balakrishnan, "Continuous univariate distributions", vol. 1, 1994, chap. 21.

Examples
--------
>>> import chdstat as chd
>>> x = 3 * np.random.default_rng(1).weibull(0.7, size=4096)
>>> result = chd.fit.weibull(x)
>>> {name: round(float(value), 1) for name, value in result.parameters.items()}
{'shape': 0.7, 'scale': 3.0}
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from chdstat._core.arrays import Floats, Mask
from chdstat._core.positive import Part
from chdstat._core.statistic import RADIANCE
from chdstat.fit.family import Estimate, Family, Parameters, WeightedSamples, summed
from chdstat.fit.mle import maximise


def _profile(points: WeightedSamples, at: Floats) -> Floats:
    """Profile log-likelihood per sample, ``log k + k mean(log x) - log mean(x^k)``, by log k."""
    k, top = np.exp(at[0]), points.log_top
    total, first, second = points.moments(_powers(points, k, top))
    first, second = first / total, second / total
    second -= first**2
    value = at[0] - np.log(total) - k * top
    return np.stack([value, 1 - k * first, -k * first - k**2 * second])


def _start(points: WeightedSamples) -> Floats:
    """Match the standard deviation of log x, which is pi / (sqrt(6) k)."""
    spread = np.sqrt(points.average(points.log**2))
    return np.stack([np.log(np.pi / np.sqrt(6) / spread), np.zeros_like(spread)])


def _finish(points: WeightedSamples, at: Floats, converged: Mask) -> Floats:
    """Return shape, scale and convergence; the scale is profiled out, ``mean(x^k)^(1/k)``."""
    shape = np.exp(at[0])
    power = points.average(_powers(points, shape, points.log_top))
    log_scale = points.log_mean + points.log_top + np.log(power) / shape
    return np.stack([shape, np.exp(log_scale), converged])


def _powers(points: WeightedSamples, k: Floats, top: Floats) -> Floats:
    """Return (x / largest x)^k, which is at most 1 for any k."""
    power = points.log - top[:, np.newaxis]
    power *= k[:, np.newaxis]
    return np.exp(power, out=power)


def _estimate(part: Part, near: Parameters | None, tolerance: float) -> Estimate:
    shape, scale, converged = maximise(
        part,
        _profile,
        start=_start,
        finish=_finish,
        names=3,
        minimum=WEIBULL.minimum,
        near=None if near is None else (np.log(near["shape"]), np.zeros(part.n.shape)),
        tolerance=tolerance,
    )
    # Inverse of the Fisher information, in closed form: Johnson, Kotz and Balakrishnan,
    # "Continuous univariate distributions", vol. 1, 1994, chapter 21.
    root = np.sqrt(6 / part.n) / np.pi
    scale_factor = np.sqrt(np.pi**2 / 6 + (1 - np.euler_gamma) ** 2)
    # The mean of (x/s)^k is 1.
    log_mean = part.log_statistics.log_mean
    likelihood = np.log(shape) + shape * (log_mean - np.log(scale)) - 1 - log_mean
    return Estimate(
        parameters={"shape": shape, "scale": scale},
        standard_errors={"shape": shape * root, "scale": scale / shape * root * scale_factor},
        converged=converged == 1,
        log_likelihood=part.n * likelihood,
    )


def _log_density(points: WeightedSamples, parameters: Parameters) -> Floats:
    shape = parameters["shape"]
    power = points.log - (np.log(parameters["scale"]) - points.log_mean)[:, np.newaxis]
    power *= shape[:, np.newaxis]
    density = power - np.exp(power)
    density += np.log(shape)[:, np.newaxis]
    return density


WEIBULL = Family(
    name="weibull",
    label="Weibull",
    documentation=__doc__,
    units={"shape": "1", "scale": RADIANCE},
    estimate=_estimate,
    log_likelihood=summed(_log_density),
    log_density=_log_density,
    distribution=lambda p: stats.weibull_min(p["shape"], scale=p["scale"]),
    errors_from={"scale": 20},
    density="(k/s) (x/s)^{k-1} e^{-(x/s)^k}",
    tail_index="0",
    error_formula="expected information",
)
