"""Log-normal: Gaussian in the log domain.

``mu = mean(log x)``, ``sigma^2 = mean((log x - mu)^2)``, with natural logarithms. The likelihood is
that of linear radiance, so that it compares with other families.

References
----------
Johnson, Kotz and Balakrishnan, "Continuous univariate distributions", vol. 1, 1994, chap. 14.

Examples
--------
>>> import chdstat as chd
>>> result = chd.fit.lognormal([1.0, 10.0, 100.0])
>>> round(float(np.exp(result.parameters["mu"])), 6)
10.0
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from chdstat._core.arrays import Floats
from chdstat._core.positive import Part
from chdstat._core.statistic import RADIANCE
from chdstat.fit.family import Estimate, Family, Parameters, WeightedSamples


def _estimate(part: Part, *_search: object) -> Estimate:
    sums = part.log_statistics
    mu, sigma = sums.log_mean, np.sqrt(sums.log_variance)
    return Estimate(
        parameters={"mu": mu, "sigma": sigma},
        standard_errors={"mu": sigma / np.sqrt(sums.n), "sigma": sigma / np.sqrt(2 * sums.n)},
        converged=np.isfinite(mu),
    )


def _log_likelihood(part: Part, parameters: Parameters) -> Floats:
    sums, mu, sigma = part.log_statistics, parameters["mu"], parameters["sigma"]
    misfit = (sums.log_variance + (sums.log_mean - mu) ** 2) / (2 * sigma**2)
    # Minus log x is the Jacobian of the logarithm: likelihoods are compared in linear radiance.
    per_sample = -misfit - np.log(sigma) - 0.5 * np.log(2 * np.pi) - sums.log_mean
    return np.asarray(sums.n * per_sample)


def _log_density(points: WeightedSamples, parameters: Parameters) -> Floats:
    sigma = parameters["sigma"]
    density = points.log + (points.log_mean - parameters["mu"])[:, np.newaxis]
    density /= sigma[:, np.newaxis]
    np.square(density, out=density)
    density *= -0.5
    density -= (np.log(sigma) + 0.5 * np.log(2 * np.pi))[:, np.newaxis]
    return density


LOGNORMAL = Family(
    name="lognormal",
    label="log-normal",
    documentation=__doc__,
    units={"mu": f"ln({RADIANCE})", "sigma": "1"},
    estimate=_estimate,
    log_likelihood=_log_likelihood,
    log_density=_log_density,
    distribution=lambda p: stats.lognorm(p["sigma"], scale=np.exp(p["mu"])),
    errors_from={"mu": 12, "sigma": 20},
    density=r"e^{-(\log x - \mu)^2 / 2 \sigma^2} / (\sqrt{2\pi}\, \sigma x)",
    tail_index="0, but only far out",
    error_formula=r":math:`\sigma / \sqrt{n}` and :math:`\sigma / \sqrt{2n}`",
)
