"""Component: one kind of light path of a simulated CHD, a known distribution of radiance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy import special

from chdstat._positive import Floats
from chdstat.errors import InputError

__all__ = ["Component", "Kind"]

Kind = Literal["gamma", "lognormal", "constant"]


@dataclass(frozen=True)
class Component:
    """One kind of light path: a distribution of positive radiance.

    Attributes
    ----------
    family
        'gamma', 'lognormal' or 'constant'.
    shape
        Shape of a gamma distribution, or standard deviation of the logarithm of a log-normal one;
        of no meaning for a constant.
    median
        Its median, in W sr-1 m-2.
    weight
        Share of the component among all of a CHD; they need not add up to 1.
    """

    family: Kind
    shape: float = 1.0
    median: float = 1.0
    weight: float = 1.0

    def __post_init__(self) -> None:
        numbers = (self.shape, self.median, self.weight)
        if self.family not in get_args(Kind) or not all(0 < v < np.inf for v in numbers):
            message = (
                f"a component needs a family of {', '.join(get_args(Kind))}, and shape, median and "
                f"weight above 0; got {self}"
            )
            raise InputError(message)

    @property
    def scale(self) -> float:
        """Scale of a gamma distribution."""
        return float(self.median / special.gammaincinv(self.shape, 0.5))

    @property
    def log_mean(self) -> float:
        """Expectation of log x."""
        if self.family != "gamma":
            return float(np.log(self.median))
        return float(np.log(self.scale) + special.digamma(self.shape))

    @property
    def log_deviation(self) -> float:
        """Standard deviation of log x."""
        if self.family == "gamma":
            return float(np.sqrt(special.polygamma(1, self.shape)))
        return self.shape if self.family == "lognormal" else 0.0

    def cdf(self, x: Floats) -> Floats:
        """Return P(X <= x)."""
        if self.family == "gamma":
            return np.asarray(special.gammainc(self.shape, x / self.scale))
        if self.family == "lognormal":
            return np.asarray(special.ndtr(self._z(x)))
        return np.asarray(x >= self.median, dtype=np.float64)

    def pdf(self, x: Floats) -> Floats:
        """Return the density, infinite at a constant."""
        if self.family == "gamma":
            z = x / self.scale
            log = special.xlogy(self.shape - 1, z) - z - special.gammaln(self.shape)
            return np.asarray(np.exp(log) / self.scale)
        if self.family == "lognormal":
            log = -0.5 * self._z(x) ** 2 - np.log(np.sqrt(2 * np.pi) * self.shape * x)
            return np.asarray(np.exp(log))
        return np.where(x == self.median, np.inf, 0.0)

    def slope(self, x: Floats) -> Floats:
        """Return the derivative of the density."""
        if self.family == "gamma":
            return np.asarray(self.pdf(x) * ((self.shape - 1) / x - 1 / self.scale))
        return np.asarray(-self.pdf(x) * (1 + self._z(x) / self.shape) / x)

    def mean_below(self, x: float) -> float:
        """Return E[X; X <= x]: the part of the expectation that lies up to `x`."""
        if self.family == "gamma":
            # x f(x; k) is the density of shape k + 1, times the mean.
            share = special.gammainc(self.shape + 1, x / self.scale)
            return float(self.shape * self.scale * share)
        if self.family == "lognormal":
            mean = self.median * np.exp(self.shape**2 / 2)
            return float(mean * special.ndtr(self._z(np.asarray(x)) - self.shape))
        return self.median if x >= self.median else 0.0

    def draw(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw samples, shape (count,)."""
        if self.family == "gamma":
            return np.asarray(rng.gamma(self.shape, self.scale, size=count))
        if self.family == "lognormal":
            return np.asarray(rng.lognormal(np.log(self.median), self.shape, size=count))
        return np.full(count, self.median)

    def _z(self, x: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(x / self.median) / self.shape)
