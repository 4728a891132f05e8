"""Inverse Gaussian: more skewed than gamma, less than log-normal; its estimates are in closed form.

``f(x) = sqrt(lambda / (2 pi x^3)) exp(-lambda (x - mu)^2 / (2 mu^2 x))``, where mu is the
expectation. The estimates are ``mu = mean(x)`` and ``1 / lambda = mean(1/x - 1/mu)``. Standard
errors come from the expected information.

References
----------
Johnson, Kotz and Balakrishnan, "Continuous univariate distributions", vol. 1, 1994, chap. 15.

Examples
--------
>>> import chdstat as chd
>>> x = np.random.default_rng(1).wald(3.0, 2.0, size=40_000)
>>> result = chd.fit.inverse_gaussian(x)
>>> {name: round(float(value), 1) for name, value in result.parameters.items()}
{'mu': 3.0, 'lambda': 2.0}
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from chdstat._core.arrays import Floats
from chdstat._core.positive import Part
from chdstat._core.statistic import RADIANCE
from chdstat.fit.family import (
    Estimate,
    Family,
    Parameters,
    WeightedSamples,
    of_rows,
    summed,
)

_NARROW = 1e-6
"""Squared coefficient of variation below which quantiles are those of a log-normal distribution."""


def _estimate(part: Part, *_search: object) -> Estimate:
    mu, inverse = of_rows(part, INVERSE_GAUSSIAN.minimum, 2, _moments).reshape(2, *part.n.shape)
    shape = mu / inverse
    return Estimate(
        parameters={"mu": mu, "lambda": shape},
        standard_errors={
            "mu": mu * np.sqrt(inverse / part.n),
            "lambda": shape * np.sqrt(2 / part.n),
        },
        converged=np.isfinite(mu) & np.isfinite(shape) & (shape > 0),
    )


def _moments(points: WeightedSamples) -> Floats:
    """Return the mean, and mean(mu / x - 1), which is mu / lambda; shape (2, row)."""
    mean = points.average(np.exp(points.log))
    # For nearly equal samples, mu / x - 1 cancels. Its mean equals the mean of (x - mu)^2 / (mu x).
    half = 0.5 * (points.log - np.log(mean)[:, np.newaxis])
    return np.stack([np.exp(points.log_mean) * mean, points.average(4 * np.sinh(half) ** 2)])


def _log_density(points: WeightedSamples, parameters: Parameters) -> Floats:
    mu, shape = parameters["mu"], parameters["lambda"]
    log = points.log + (points.log_mean - np.log(mu))[:, np.newaxis]
    # (x - mu)^2 / (mu x) = 4 sinh(log(x / mu) / 2)^2.
    density = -2 * (shape / mu)[:, np.newaxis] * np.sinh(log / 2) ** 2
    density -= log / 2
    density += 0.5 * np.log(shape / mu / (2 * np.pi))[:, np.newaxis]
    return np.asarray(density)


class _InverseGaussian(type(stats.invgauss)):  # type: ignore[misc]
    """SciPy's distribution has a NaN density where a factor overflows a double; here it is 0.

    Its quantiles are far off where samples are nearly equal; those of a log-normal are exact there.
    """

    def _pdf(self, x: Floats, mu: Floats) -> Floats:
        return np.asarray(np.exp(self._logpdf(x, mu)))

    def _ppf(self, q: Floats, mu: Floats) -> Floats:
        narrow = stats.lognorm.ppf(q, np.sqrt(np.log1p(mu)), scale=mu / np.sqrt(1 + mu))
        return np.asarray(np.where(mu < _NARROW, narrow, super()._ppf(q, mu)))


_DISTRIBUTION = _InverseGaussian(name="invgauss", a=0.0)

INVERSE_GAUSSIAN = Family(
    name="inverse_gaussian",
    label="inverse Gaussian",
    documentation=__doc__,
    units={"mu": RADIANCE, "lambda": RADIANCE},
    estimate=_estimate,
    log_likelihood=summed(_log_density),
    log_density=_log_density,
    distribution=lambda p: _DISTRIBUTION(p["mu"] / p["lambda"], scale=p["lambda"]),
    errors_from={"mu": 60},
    density=r"\sqrt{\lambda / (2 \pi x^3)}\; e^{-\lambda (x - \mu)^2 / (2 \mu^2 x)}",
    tail_index="0",
    error_formula=r":math:`\sqrt{\mu^3 / (\lambda n)}` and :math:`\lambda \sqrt{2 / n}`",
    typical={"mu": (1.0, 1.0), "lambda": (0.3, 10.0)},
)
