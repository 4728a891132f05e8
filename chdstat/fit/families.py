"""Families: the distributions that the positive part of a CHD can be fitted with.

`FAMILIES` is the table. A family is a row of it: how its parameters are estimated from a
`PositivePart` (whose sums are shared between the families), its log-likelihood, and SciPy's
distribution for everything else. The engine that runs a family is in `chdstat.fit.mle`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special, stats

from chdstat._positive import Floats, Mask, PositivePart
from chdstat.errors import InputError

__all__ = ["FAMILIES", "Estimate", "Family", "Parameters", "get_family"]

Parameters = Mapping[str, Floats]

_ITERATIONS = 20
_TOLERANCE = 1e-12
_RADIANCE = "W sr-1 m-2"


@dataclass(frozen=True)
class Estimate:
    """Parameters and standard errors by name, and where the iteration converged."""

    parameters: Parameters
    standard_errors: Parameters
    converged: Mask


@dataclass(frozen=True)
class Family:
    """A parametric family on the positive numbers.

    Attributes
    ----------
    name
        What users call it.
    units
        Names of its parameters, with their units.
    estimate
        Maximum likelihood. Rows that cannot be fitted may hold anything but must not warn.
    log_likelihood
        Sum over the positive samples of the log density in linear radiance, at given parameters.
    distribution
        SciPy's frozen distribution with given parameters, which may be arrays.
    """

    name: str
    units: Mapping[str, str]
    estimate: Callable[[PositivePart], Estimate]
    log_likelihood: Callable[[PositivePart, Parameters], Floats]
    distribution: Callable[[Parameters], Any]


def get_family(family: str | Family) -> Family:
    """Return a family by its name; a family passes through.

    Raises
    ------
    InputError
        If there is no family of this name.
    """
    if isinstance(family, Family):
        return family
    if family not in FAMILIES:
        message = f"family must be one of {', '.join(FAMILIES)}, got {family!r}"
        raise InputError(message)
    return FAMILIES[family]


def _estimate_gamma(part: PositivePart) -> Estimate:
    sums = part.log_statistics
    shape, converged = _gamma_shape(sums.gap)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
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


def _gamma_shape(gap: Floats) -> tuple[Floats, Mask]:
    """Solve log(k) - digamma(k) = gap (Minka 2002, "Estimating a Gamma distribution")."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        k = np.asarray((3 - gap + np.sqrt((gap - 3) ** 2 + 24 * gap)) / (12 * gap))
        step = np.full_like(k, np.inf)
        for _ in range(_ITERATIONS):
            # Newton in 1/k, in which the equation is nearly linear.
            inverse = 1 / k + (gap - _gap_of_shape(k)) / (k**2 * _gap_slope(k))
            step = np.abs(k * inverse - 1)
            k = 1 / inverse
            if not (step > _TOLERANCE).any():
                break
    return k, np.asarray(step <= 1e-9)


def _gap_of_shape(k: Floats) -> Floats:
    # Both terms grow while their difference falls: the asymptotic series keeps its digits.
    series = (1 + (1 - 0.1 / k**2) / (6 * k)) / (2 * k)
    return np.where(k > 1e3, series, np.log(k) - special.digamma(k))


def _gap_slope(k: Floats) -> Floats:
    """Return trigamma(k) - 1/k, minus the derivative of the gap by k."""
    series = (1 + (1 - 0.2 / k**2) / (3 * k)) / (2 * k**2)
    return np.where(k > 1e3, series, special.polygamma(1, k) - 1 / k)


def _gamma_log_likelihood(part: PositivePart, parameters: Parameters) -> Floats:
    sums, k = part.log_statistics, parameters["shape"]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        # Written around mean = k * scale, where the maximum is, so that large terms cancel first.
        ratio = sums.mean / (k * parameters["scale"])
        off = k * (np.log(ratio) - (ratio - 1))
        per_sample = off + _gamma_peak(k) - (k - 1) * sums.gap - np.log(sums.mean)
        return np.asarray(sums.n * per_sample)


def _gamma_peak(k: Floats) -> Floats:
    """Return k log(k) - k - log(Gamma(k)), by Stirling's series where the terms are large."""
    series = 0.5 * np.log(k / (2 * np.pi)) - 1 / (12 * k)
    return np.where(k > 1e3, series, special.xlogy(k, k) - k - special.gammaln(k))


def _estimate_lognormal(part: PositivePart) -> Estimate:
    sums = part.log_statistics
    with np.errstate(invalid="ignore", divide="ignore"):
        mu, sigma = sums.log_mean, np.sqrt(sums.log_variance)
        return Estimate(
            parameters={"mu": mu, "sigma": sigma},
            standard_errors={"mu": sigma / np.sqrt(sums.n), "sigma": sigma / np.sqrt(2 * sums.n)},
            converged=np.isfinite(mu),
        )


def _lognormal_log_likelihood(part: PositivePart, parameters: Parameters) -> Floats:
    sums, mu, sigma = part.log_statistics, parameters["mu"], parameters["sigma"]
    with np.errstate(invalid="ignore", divide="ignore"):
        misfit = (sums.log_variance + (sums.log_mean - mu) ** 2) / (2 * sigma**2)
        # Minus log x is the Jacobian of the logarithm: likelihoods compare in linear radiance.
        per_sample = -misfit - np.log(sigma) - 0.5 * np.log(2 * np.pi) - sums.log_mean
        return np.asarray(sums.n * per_sample)


FAMILIES: Mapping[str, Family] = {
    family.name: family
    for family in (
        Family(
            name="gamma",
            units={"shape": "1", "scale": _RADIANCE},
            estimate=_estimate_gamma,
            log_likelihood=_gamma_log_likelihood,
            distribution=lambda p: stats.gamma(p["shape"], scale=p["scale"]),
        ),
        Family(
            name="lognormal",
            units={"mu": "1", "sigma": "1"},
            estimate=_estimate_lognormal,
            log_likelihood=_lognormal_log_likelihood,
            distribution=lambda p: stats.lognorm(p["sigma"], scale=np.exp(p["mu"])),
        ),
    )
}
"""Families by name. A new one is a new row."""
