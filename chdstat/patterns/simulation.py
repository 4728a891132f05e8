"""Simulation: CHDs that are known exactly, and images of them.

A `CHD` is a mixture of `Component` distributions of radiance, one for each kind of light path, with
nulls, a tail and fireflies. `CHDS` are clear cases. `simulate` draws an image whose regions have
given CHDs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy import special, stats

from chdstat._core.arrays import LUMINANCE, Floats, Seed, generator
from chdstat.errors import InputError, check_option
from chdstat.samples import Samples

Kind = Literal["gamma", "lognormal", "constant"]


@dataclass(frozen=True)
class Component:
    """One kind of light path: a distribution of positive radiance.

    Attributes
    ----------
    family
        'gamma', 'lognormal' or 'constant'.
    shape
        Shape of a gamma distribution, or standard deviation of the logarithm for a log-normal one;
        without meaning for a constant.
    median
        Median, in W sr-1 m-2.
    weight
        Share of the component in the CHD; the weights need not add up to 1.
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

    @cached_property
    def _law(self) -> Any:
        """SciPy's distribution, of what is not a constant."""
        if self.family == "gamma":
            return stats.gamma(self.shape, scale=self.scale)
        return stats.lognorm(self.shape, scale=self.median)

    def cdf(self, x: Floats) -> Floats:
        """Return P(X <= x)."""
        constant = self.family == "constant"
        return np.asarray(x >= self.median if constant else self._law.cdf(x), dtype=np.float64)

    def pdf(self, x: Floats) -> Floats:
        """Return the density; infinite at a constant."""
        if self.family == "constant":
            return np.where(x == self.median, np.inf, 0.0)
        return np.asarray(self._law.pdf(x))

    def mean_below(self, x: float) -> float:
        """Return E[X; X <= x]: the part of the expectation up to `x`."""
        if self.family == "gamma":
            # x f(x; k) is the density of shape k + 1, times the mean.
            share = special.gammainc(self.shape + 1, x / self.scale)
            return float(self.shape * self.scale * share)
        if self.family == "lognormal":
            z = np.log(x / self.median) / self.shape
            return float(self._law.mean() * special.ndtr(z - self.shape))
        return self.median if x >= self.median else 0.0

    def draw(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw samples, shape (count,)."""
        if self.family == "gamma":
            return np.asarray(rng.gamma(self.shape, self.scale, size=count))
        if self.family == "lognormal":
            return np.asarray(rng.lognormal(np.log(self.median), self.shape, size=count))
        return np.full(count, self.median)


_HALVINGS = 60
"""Steps of a bisection over the logarithm of radiance; they shrink the bracket to rounding."""
_REACH = 300.0
"""Natural logarithm of the radiance from which the bisection starts, in both directions."""


@dataclass(frozen=True)
class CHD:
    """A characteristic distribution of one pixel: nulls, a body, a tail, and a planted firefly.

    Samples are null with probability `null_share`. The others follow the mixture of the components
    up to its quantile ``1 - tail_share``. If there is a `tail_index`, a generalised Pareto
    distribution takes over from there, with the scale that makes the density continuous:
    ``sigma = (1 - F(u)) / f(u)``.

    Attributes
    ----------
    body
        The components, at least one.
    tail_index
        Tail index xi of the grafted tail; None for no tail.
    tail_share
        Share of the non-null samples in the tail.
    null_share
        Probability of a null sample.
    firefly_share
        If above 0, one sample of each pixel is replaced by one with this share of the sum of all.
        It is planted in drawn samples and is not part of the distribution.
    color
        Colour of all samples. Only ratios count, as `chdstat.simulate` scales luminance to 1.

    Raises
    ------
    InputError
        If a number is out of range, or a constant has other components beside it.

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
        """Whether every non-null sample has the same radiance."""
        return self.body[0].family == "constant"

    @cached_property
    def _weights(self) -> Floats:
        weights = np.array([component.weight for component in self.body])
        return np.asarray(weights / weights.sum())

    @cached_property
    def threshold(self) -> float:
        """Radiance above which the tail is grafted; infinite without a tail."""
        if self.tail_index is None:
            return np.inf
        return float(_quantile(partial(self._of_body, "cdf"), np.asarray(1 - self.tail_share)))

    @cached_property
    def tail_scale(self) -> float:
        """Scale of the generalised Pareto tail; NaN without a tail."""
        if self.tail_index is None:
            return np.nan
        return float(self.tail_share / self._of_body("pdf", np.asarray(self.threshold)))

    def pdf(self, x: npt.ArrayLike) -> Floats:
        """Return the density of non-null samples, which integrates to 1."""
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
        """Return the expectation, with nulls and without a planted firefly."""
        parts = [component.mean_below(self.threshold) for component in self.body]
        mean = float(np.dot(self._weights, parts))
        if self.tail_index is not None:
            above = self.tail_scale / (1 - self.tail_index) if self.tail_index < 1 else np.inf
            mean += self.tail_share * (self.threshold + above)
        return float((1 - self.null_share) * mean)

    def draw(self, shape: int | tuple[int, ...] = (), *, samples: int, seed: Seed = None) -> Floats:
        """Draw radiance, shape ``(*shape, samples)``, including nulls."""
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

    def _of_body(self, what: Literal["pdf", "cdf"], x: Floats) -> Floats:
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
    "long-tail": CHD((Component("gamma", 2.0),), tail_index=1.0, tail_share=0.2),
    "firefly": CHD((Component("gamma", 2.0),), firefly_share=0.5),
    "constant": CHD((Component("constant"),)),
    "black": CHD((Component("constant"),), null_share=1.0),
}
"""A clear case of each pattern, by name."""


def simulate(
    chds: str | CHD | Sequence[str | CHD],
    *,
    shape: tuple[int, int] = (64, 64),
    spp: int = 512,
    seed: Seed = 0,
) -> Samples:
    """Draw an image whose regions have given CHDs.

    Regions are the cells of a grid that is as square as possible, in reading order. Cells that are
    left over have the last CHD.

    Parameters
    ----------
    chds
        One or more `CHD`, or names of `CHDS`.
    shape
        (height, width) in pixels.
    spp
        Samples of each pixel, including nulls.
    seed
        Seed of the draws.

    Returns
    -------
    Samples
        Samples in memory, with three channels in the ratios of each CHD's colour, so that luminance
        follows the CHD.

    Raises
    ------
    InputError
        If a name is unknown, or a region has no pixel.

    Examples
    --------
    >>> samples = simulate(["gamma", "bimodal"], shape=(2, 4), spp=64)
    >>> samples
    <Samples 'simulated' 4 x 2 pixels, 3 channels, 64 spp, in memory>
    """
    given = [chds] if isinstance(chds, (str, CHD)) else list(chds)
    for name in given:
        if isinstance(name, str):
            check_option("CHD", name, CHDS)
    chosen = [CHDS[chd] if isinstance(chd, str) else chd for chd in given]
    if len(shape) != 2 or min(shape) < 1 or spp < 1 or not chosen:
        message = f"simulate needs a CHD, a shape (height, width) and spp >= 1; got {shape}, {spp}"
        raise InputError(message)
    region = _regions(len(chosen), shape)
    image = np.empty((*shape, 3, spp), dtype=np.float32)
    streams = generator(seed).spawn(len(chosen))
    for index, (chd, rng) in enumerate(zip(chosen, streams, strict=True)):
        here = region == index
        radiance = chd.draw(int(np.count_nonzero(here)), samples=spp, seed=rng)
        color = np.array(chd.color) / (LUMINANCE @ np.array(chd.color))
        image[here] = radiance[:, np.newaxis] * color[:, np.newaxis]
    return Samples.from_array(image, axes="yxcs", scene="simulated")


def _regions(count: int, shape: tuple[int, int]) -> npt.NDArray[np.intp]:
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    if rows > shape[0] or columns > shape[1]:
        message = f"{count} regions need at least {rows} x {columns} pixels, got {shape}"
        raise InputError(message)
    y, x = (
        np.arange(edge) * cells // edge for edge, cells in zip(shape, (rows, columns), strict=True)
    )
    return np.asarray(np.minimum(y[:, np.newaxis] * columns + x, count - 1))
