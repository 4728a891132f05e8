"""CHDs that are known exactly, to draw samples from and to compare with.

A `CHD` is a mixture of `Component` distributions of radiance, one for each kind of light path, with
nulls, a tail and fireflies; `CHDS` are clear cases, and `random_chd` draws one. `chdstat.patterns`
makes images and populations of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import Floats, Seed, generator
from chdstat.errors import InputError

__all__ = ["CHD", "CHDS", "Component", "random_chd"]

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


_HALVINGS = 60
"""Steps of a bisection over the logarithm of radiance: the bracket shrinks to rounding."""
_REACH = 300.0
"""Natural logarithm of the radiance that the bisection starts from, both ways."""
_GRID = 1000
"""Points at which maxima of the density are counted, up to so many standard deviations away:"""
_WIDE = 5.0


@dataclass(frozen=True)
class CHD:
    """A characteristic distribution of one pixel: nulls, a body, a tail, and a planted firefly.

    Samples are null with probability `null_share`. The others follow the mixture of the components
    up to its quantile ``1 - tail_share``, and from there on, if there is a `tail_index`, a
    generalised Pareto distribution whose scale makes the density continuous:
    ``sigma = (1 - F(u)) / f(u)``.

    Attributes
    ----------
    body
        One component or more.
    tail_index
        Tail index xi of the grafted tail; None for none.
    tail_share
        Share of the samples that are not null in it.
    null_share
        Probability of a null sample.
    firefly_share
        If above 0, one sample of each pixel is replaced by one that carries this share of the sum
        of all. It is planted in what is drawn, and no part of the distribution.
    color
        Colour of all samples; only ratios count, as `chdstat.simulate` scales luminance to 1.

    Raises
    ------
    InputError
        If a number is out of range, or a constant is not alone.

    References
    ----------
    Scarrott and MacDonald, "A review of extreme value threshold estimation and uncertainty
    quantification", REVSTAT 10, 2012, pages 33-60: spliced tails.

    Examples
    --------
    >>> from chdstat.patterns import Component
    >>> chd = CHD((Component("gamma", 2.0),), tail_index=0.5, tail_share=0.1, null_share=0.3)
    >>> chd.draw((4,), samples=512, seed=1).shape
    (4, 512)
    >>> float(chd.cdf(0.0)), float(chd.cdf(chd.ppf(0.9)).round(6))
    (0.3, 0.9)
    """

    body: tuple[Component, ...]
    tail_index: float | None = None
    tail_share: float = 0.1
    null_share: float = 0.0
    firefly_share: float = 0.0
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        constant = any(component.family == "constant" for component in self.body)
        if not self.body or (constant and (len(self.body) > 1 or self.tail_index is not None)):
            message = f"body needs components, a constant stands alone without a tail; got {self}"
            raise InputError(message)
        inside = 0 < self.tail_share < 1 and 0 <= self.null_share <= 1
        if not inside or not 0 <= self.firefly_share < 1 or (self.tail_index or 0) < 0:
            message = (
                "a CHD needs tail_share in (0, 1), null_share in [0, 1], firefly_share in [0, 1), "
                f"and tail_index >= 0; got {self}"
            )
            raise InputError(message)
        if len(self.color) != 3 or min(self.color) < 0 or max(self.color) <= 0:
            message = f"color must be three numbers >= 0, not all of them 0; got {self.color}"
            raise InputError(message)

    @property
    def is_constant(self) -> bool:
        """Whether every sample that is not null has the same radiance."""
        return self.body[0].family == "constant"

    @cached_property
    def _weights(self) -> Floats:
        weights = np.array([component.weight for component in self.body])
        return np.asarray(weights / weights.sum())

    @cached_property
    def threshold(self) -> float:
        """Radiance above which the tail is grafted, infinite without one."""
        if self.tail_index is None:
            return np.inf
        return float(_quantile(partial(self._of_body, "cdf"), np.asarray(1 - self.tail_share)))

    @cached_property
    def tail_scale(self) -> float:
        """Scale of the generalised Pareto tail, NaN without one."""
        if self.tail_index is None:
            return np.nan
        return float(self.tail_share / self._of_body("pdf", np.asarray(self.threshold)))

    def pdf(self, x: npt.ArrayLike) -> Floats:
        """Return the density of what is not null: it integrates to 1."""
        x = np.asarray(x, dtype=np.float64)
        inside = np.maximum(x, np.finfo(np.float64).tiny)
        density = self._of_body("pdf", np.minimum(inside, self.threshold))
        if self.tail_index is not None:
            power = -(1 + self.tail_index) * self._log_survival(inside)
            density = np.where(x > self.threshold, density * np.exp(power), density)
        return np.where(x > 0, density, 0.0)

    def cdf(self, x: npt.ArrayLike) -> Floats:
        """Return P(X <= x), nulls included."""
        x = np.asarray(x, dtype=np.float64)
        positive = self._positive_cdf(np.maximum(x, 0))
        return np.where(x < 0, 0.0, self.null_share + (1 - self.null_share) * positive)

    def ppf(self, q: npt.ArrayLike) -> Floats:
        """Return quantiles, 0 up to the share of nulls."""
        q = np.asarray(q, dtype=np.float64)
        level = (q - self.null_share) / max(1 - self.null_share, np.finfo(np.float64).tiny)
        quantile = _quantile(self._positive_cdf, np.clip(level, 0, 1))
        return np.where(level <= 0, 0.0, quantile)

    def mean(self) -> float:
        """Return the expectation, nulls included and a planted firefly left out."""
        parts = [component.mean_below(self.threshold) for component in self.body]
        mean = float(np.dot(self._weights, parts))
        if self.tail_index is not None:
            above = self.tail_scale / (1 - self.tail_index) if self.tail_index < 1 else np.inf
            mean += self.tail_share * (self.threshold + above)
        return float((1 - self.null_share) * mean)

    def draw(self, shape: int | tuple[int, ...] = (), *, samples: int, seed: Seed = None) -> Floats:
        """Draw radiance, shape ``(*shape, samples)``, nulls among them."""
        rng = generator(seed)
        x = np.empty((*(shape if isinstance(shape, tuple) else (shape,)), samples))
        which = np.searchsorted(np.cumsum(self._weights)[:-1], rng.random(x.shape))
        for index, component in enumerate(self.body):
            here = which == index
            x[here] = component.draw(int(np.count_nonzero(here)), rng)
        if self.tail_index is not None:
            above = x > self.threshold
            # The quantile function of the generalised Pareto, at an exponential variate -log U.
            rise = rng.standard_exponential(np.count_nonzero(above))
            if self.tail_index > 0:
                rise = np.expm1(self.tail_index * rise) / self.tail_index
            x[above] = self.threshold + self.tail_scale * rise
        x[rng.random(x.shape) < self.null_share] = 0
        if self.firefly_share:
            place = rng.integers(samples, size=x.shape[:-1])[..., np.newaxis]
            np.put_along_axis(x, place, 0, axis=-1)
            others = x.sum(axis=-1, keepdims=True)
            firefly = others * self.firefly_share / (1 - self.firefly_share)
            np.put_along_axis(x, place, firefly, axis=-1)
        return x

    def separations(self) -> Floats:
        """Return Ashman's D of neighbouring components in the domain of logarithms."""
        ordered = sorted(self.body, key=lambda component: component.log_mean)
        distance = np.diff([component.log_mean for component in ordered])
        square = np.array([component.log_deviation**2 for component in ordered])
        return np.asarray(np.sqrt(2) * distance / np.sqrt(square[1:] + square[:-1]))

    def maxima(self) -> int:
        """Count the maxima of the density of log x."""
        if self.is_constant:
            return 1
        low = min(c.log_mean - _WIDE * c.log_deviation for c in self.body)
        high = max(c.log_mean + _WIDE * c.log_deviation for c in self.body)
        x = np.exp(np.linspace(low, high, _GRID))
        rising = np.diff(x * self.pdf(x)) > 0
        return int(np.count_nonzero(rising[:-1] & ~rising[1:]))

    def penultimate_index(self, share: float = 0.1) -> float:
        """Return the tail index that excesses over the quantile ``1 - share`` show.

        ``xi(u) = d/du (1 - F(u)) / f(u) = -1 - (1 - F(u)) f'(u) / f(u)^2``, the index of the
        generalised Pareto distribution that comes closest at a finite threshold; within a grafted
        tail, it is the tail index itself.

        References
        ----------
        Smith, "Estimating tails of probability distributions", 1987, doi:10.1214/aos/1176350499.
        """
        if self.is_constant:
            return np.nan
        if self.tail_index is not None and share <= self.tail_share:
            return self.tail_index
        u = _quantile(partial(self._of_body, "cdf"), np.asarray(1 - share))
        return float(-1 - share * self._of_body("slope", u) / self._of_body("pdf", u) ** 2)

    def _of_body(self, what: Literal["pdf", "cdf", "slope"], x: Floats) -> Floats:
        parts = [getattr(component, what)(x) for component in self.body]
        return np.tensordot(self._weights, parts, axes=1)

    def _positive_cdf(self, x: Floats) -> Floats:
        body = self._of_body("cdf", np.minimum(x, self.threshold))
        if self.tail_index is None:
            return body
        above = 1 - self.tail_share * np.exp(-self._log_survival(x))
        return np.where(x > self.threshold, above, body)

    def _log_survival(self, x: Floats) -> Floats:
        """Return -log of the share of the tail beyond `x`."""
        xi = self.tail_index or 0.0
        z = np.maximum(x - self.threshold, 0) / self.tail_scale
        return np.asarray(np.log1p(xi * z) / xi if xi > 0 else z)


def _quantile(cdf: Callable[[Floats], Floats], q: Floats) -> Floats:
    """Invert a distribution function by bisection over the logarithm of radiance."""
    low, high = np.full(q.shape, -_REACH), np.full(q.shape, _REACH)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        below = cdf(np.exp(middle)) < q
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(np.exp(high))


_TWO = (Component("lognormal", 0.5, 0.02, 0.4), Component("lognormal", 0.4, 1.0, 0.6))
CHDS: Mapping[str, CHD] = {
    "gamma": CHD((Component("gamma", 2.0),)),
    "lognormal": CHD((Component("lognormal", 0.5),)),
    "null-heavy": CHD((Component("gamma", 2.0),), null_share=0.8),
    "bimodal": CHD(_TWO),
    "multimodal": CHD((*_TWO, Component("lognormal", 0.3, 20.0, 0.5))),
    "long-tail": CHD((Component("gamma", 2.0),), tail_index=0.6, tail_share=0.2),
    "firefly": CHD((Component("gamma", 2.0),), firefly_share=0.5),
    "constant": CHD((Component("constant"),)),
    "black": CHD((Component("constant"),), null_share=1.0),
}
"""A clear case of each pattern, by name."""


def random_chd(rng: np.random.Generator) -> CHD:
    """Draw a CHD; `chdstat.patterns.random_chds` has the table, and tells what is undecided."""
    number = rng.choice(4, p=[0.1, 0.56, 0.17, 0.17])
    null_share = rng.choice([0.0, rng.uniform(0, 0.5), rng.uniform(0.5, 0.95)], p=[0.4, 0.3, 0.3])
    brightness = 10 ** rng.uniform(-3, 1)
    if number == 0:
        return CHD((Component("constant", median=brightness),), null_share=null_share)
    body = _random_body(int(number), brightness, rng)
    has_tail = rng.random() < (0.5 if number == 1 else 0.25)
    most = min(0.25, 0.5 * body[-1].weight)
    return CHD(
        body,
        tail_index=rng.uniform(0, 0.75) if has_tail else None,
        tail_share=rng.uniform(0.1, most),
        null_share=null_share,
        firefly_share=rng.uniform(0.25, 0.75) if rng.random() < 0.15 else 0.0,
    )


def _random_body(number: int, brightness: float, rng: np.random.Generator) -> tuple[Component, ...]:
    """Draw components, the darkest first, whose neighbours have a drawn separation."""
    family: Kind = "gamma" if rng.random() < 0.5 else "lognormal"
    weights = np.ones(1)
    if number > 1:
        least = 0.25 if number == 2 else 0.2
        weights = least + (1 - number * least) * rng.dirichlet(np.ones(number))
    body: list[Component] = []
    for weight in weights:
        if family == "gamma":
            shape = math.exp(rng.uniform(math.log(0.5 if number == 1 else 1.0), math.log(6)))
        else:
            shape = rng.uniform(0.3, 1.2 if number == 1 else 0.8)
        new = Component(family, shape, brightness, weight)
        if body:
            spread = math.hypot(body[-1].log_deviation, new.log_deviation) / math.sqrt(2)
            place = body[-1].log_mean + rng.uniform(2.5, 6) * spread
            new = replace(new, median=brightness * math.exp(place - new.log_mean))
        body.append(new)
    return tuple(body)
