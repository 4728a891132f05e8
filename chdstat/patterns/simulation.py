"""Simulation: CHDs that are known exactly, images and populations of them, and scores of flags.

A `CHD` is a mixture of `Component` distributions of radiance, one for each kind of light path, with
nulls, a tail and fireflies. `CHDS` are clear cases, and `_random_chd` draws one. `truth` says which
patterns a CHD has, with None within the indifference zone of a pattern. `simulate` draws an image
whose regions have given CHDs. `random_chds` draws CHDs with every pattern and combination, outside
these zones. `flag_scores` counts how often `classify` is right about them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import LUMINANCE, Floats, Seed, flag_attributes, generator, spans
from chdstat._core.display import Shown
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import RADIANCE
from chdstat.errors import InputError, check_option
from chdstat.fit.tail import effective_tail_index
from chdstat.patterns.classification import Classification, Label
from chdstat.patterns.definitions import PATTERNS, Thresholds, firefly_limit
from chdstat.samples import Samples
from chdstat.summary.runner import measured

if TYPE_CHECKING:
    import xarray as xr

# --- CHDs -----------------------------------------------------------------------------------------


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
        """Return the density; infinite at a constant."""
        if self.family == "gamma":
            z = x / self.scale
            log = special.xlogy(self.shape - 1, z) - z - special.gammaln(self.shape)
            return np.asarray(np.exp(log) / self.scale)
        if self.family == "lognormal":
            log = -0.5 * self._z(x) ** 2 - np.log(np.sqrt(2 * np.pi) * self.shape * x)
            return np.asarray(np.exp(log))
        return np.where(x == self.median, np.inf, 0.0)

    def mean_below(self, x: float) -> float:
        """Return E[X; X <= x]: the part of the expectation up to `x`."""
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
"""Steps of a bisection over the logarithm of radiance; they shrink the bracket to rounding."""
_REACH = 300.0
"""Natural logarithm of the radiance from which the bisection starts, in both directions."""
_GRID = 1000
"""Points at which maxima of the density are counted."""
_WIDE = 5.0
"""Standard deviations up to which the points reach."""


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

    def separations(self) -> Floats:
        """Return Ashman's D of neighbouring components, for logarithms."""
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

        Within a grafted tail, it is the tail index itself; elsewhere, see
        `chdstat.fit.tail.effective_tail_index`.
        """
        if self.is_constant:
            return np.nan
        if self.tail_index is not None and share <= self.tail_share:
            return self.tail_index
        body = replace(self, tail_index=None, null_share=0.0)
        return float(effective_tail_index(body, share))

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


def _random_chd(rng: np.random.Generator) -> CHD:
    """Draw a CHD; see `chdstat.patterns.random_chds` for the table and indifference zones."""
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
        tail_index=rng.choice([rng.uniform(0, 0.5), rng.uniform(1, 1.5)]) if has_tail else None,
        tail_share=rng.uniform(0.1, most),
        null_share=null_share,
        firefly_share=rng.uniform(0.25, 0.75) if rng.random() < 0.15 else 0.0,
    )


def _random_body(number: int, brightness: float, rng: np.random.Generator) -> tuple[Component, ...]:
    """Draw components, the darkest first, with a drawn separation of neighbours."""
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


# --- images, populations and scores ---------------------------------------------------------------


NULL_ZONE = (0.45, 0.55)
"""Shares of nulls that are neither heavy nor light."""
TAIL_ZONE = (0.5, 1.0)
"""Tail indices with a mean but no variance, whose error bars hold or fail."""
BODY_ZONE = (0.1, 0.3)
"""Tail indices of a body that is neither plain nor not."""
SEPARATION_ZONE = (1.5, 2.5)
"""Ashman's D at which two components are neither two modes nor one."""
INDISTINCT_SPREAD = 0.365
"""Standard deviation of log x below which gamma and log-normal are nearly the same."""
FIREFLY_ZONE = (0.0, 0.2)
"""Planted shares of the sum that neither dominate a pixel nor leave it alone."""


@dataclass(frozen=True, repr=False)
class Truth(Shown):
    """The true properties of a simulated CHD.

    Attributes
    ----------
    flags
        Whether the CHD has each flag of `chdstat.patterns`, by name; None in the flag's
        indifference zone.
    label
        The first `Label` that holds; UNDETERMINED if a label before it is None.
    tail_index
        Tail index of the excesses over the 0.9 quantile of non-null samples; NaN for a constant.
    modes
        Number of components; 0 for a black pixel.
    mean
        Expectation of radiance without a planted firefly, in W sr-1 m-2.
    """

    flags: Mapping[str, bool | None]
    label: Label
    tail_index: float
    modes: int
    mean: float


def truth(chd: CHD) -> Truth:
    """Return what is true of a CHD.

    Around the threshold of a label lies an indifference zone; inside, the label is neither true nor
    false, and its flag is None:

    - null-heavy: a share of nulls within 0.05 of 1/2 (`NULL_ZONE`), which 512 samples do not
      decide.
    - long tail: a tail index in (0.5, 1), `TAIL_ZONE`. From 1 on, there is no mean that an error
      bar could hold; below 1/2, error bars of 512 samples hold. A body without a grafted tail has
      its penultimate index at its 0.9 quantile. A planted firefly is a long tail.
    - modes: neighbouring components with Ashman's D below 2.5, the end of `SEPARATION_ZONE`, or
      components that do not show as many maxima of the density of log x.
    - gamma-like and log-normal-like: bodies whose logarithm has a standard deviation below 0.365
      (`INDISTINCT_SPREAD`), that of a gamma distribution of shape 8, since both families describe
      them; or a tail index in (0.1, 0.3), `BODY_ZONE`, such as a log-normal's for a sigma of 0.65
      to 1. With a light grafted tail, a body is neither.
    - firefly-dominated: a planted share of the sum below 0.2, `FIREFLY_ZONE`. A heavy tail may grow
      a firefly by chance: the label is one of the samples, and the drawn samples decide.

    References
    ----------
    Smith, "Estimating tails of probability distributions", 1987, doi:10.1214/aos/1176350499.
    Ashman, Bird and Zepf, "Detecting bimodality in astronomical datasets", 1994,
    doi:10.1086/117248.

    Examples
    --------
    >>> from chdstat.patterns import Component
    >>> found = truth(CHD((Component("gamma", 2.0),), tail_index=1.0, null_share=0.7))
    >>> found.label.name, found.flags["null_heavy"], found.flags["bimodal"]
    ('LONG_TAIL', True, False)
    """
    black = chd.null_share == 1
    tail_index = np.nan if black else chd.penultimate_index()
    flags = _flags(chd, tail_index)
    return Truth(
        flags=flags,
        label=Label.BLACK if black else _label(flags),
        tail_index=tail_index,
        modes=0 if black else len(chd.body),
        mean=chd.mean(),
    )


def _flags(chd: CHD, tail_index: float) -> dict[str, bool | None]:
    if chd.null_share == 1:
        return {pattern.name: pattern.name == "null_heavy" for pattern in PATTERNS}
    first, count = chd.body[0], len(chd.body)
    modes: bool | None = count > 1
    if modes and (chd.separations().min() < SEPARATION_ZONE[1] or chd.maxima() != count):
        modes = None
    exponential = chd.tail_index is None and all(c.family == "gamma" for c in chd.body)
    light = chd.is_constant or exponential
    firefly = chd.firefly_share > 0 and _above(chd.firefly_share, FIREFLY_ZONE)
    heavy = False if light else _above(tail_index, BODY_ZONE)
    plain = count == 1 and not chd.is_constant and not heavy
    either = heavy is None or first.log_deviation < INDISTINCT_SPREAD

    def is_like(family: Kind) -> bool | None:
        if plain and (either or chd.tail_index is not None):
            return None
        return plain and first.family == family

    return {
        "null_heavy": _above(chd.null_share, NULL_ZONE),
        "constant": chd.is_constant and not chd.firefly_share,
        "firefly_dominated": firefly,
        "long_tail": firefly if firefly is not False or light else _above(tail_index, TAIL_ZONE),
        "bimodal": modes and count == 2,
        "multimodal": modes and count > 2,
        "gamma_like": is_like("gamma"),
        "lognormal_like": is_like("lognormal"),
    }


def _above(value: float, zone: tuple[float, float]) -> bool | None:
    """Return whether a value is above a zone; None inside."""
    return None if zone[0] < value < zone[1] else value >= zone[1]


def _label(flags: Mapping[str, bool | None]) -> Label:
    for label in Label:
        holds = flags.get(label.name.lower(), False)
        if holds is None or holds:
            return Label.UNDETERMINED if holds is None else label
    return Label.UNDETERMINED


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
        follows the CHD. `truth_of` returns what is true of each pixel.

    Raises
    ------
    InputError
        If a name is unknown, or a region has no pixel.

    Examples
    --------
    >>> samples = simulate(["gamma", "bimodal"], shape=(2, 4), spp=64)
    >>> samples
    <Samples 'simulated' 4 x 2 pixels, 3 channels, 64 spp, in memory>
    >>> truth_of(samples)["modes"].to_numpy()
    array([[1, 1, 2, 2],
           [1, 1, 2, 2]], dtype=int8)
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
    described = json.dumps([asdict(chd) for chd in chosen])
    return Samples.from_array(image, axes="yxcs", scene="simulated", simulated_chds=described)


def truth_of(samples: Samples) -> xr.Dataset:
    """Return what is true of each pixel of an image that `simulate` made.

    Returns
    -------
    xarray.Dataset
        Over (y, x): ``region``; each flag by its name, 1, 0, or -1 in an indifference zone;
        ``label``; ``tail_index``; ``modes``; ``mean`` of luminance, without a planted firefly.

    Raises
    ------
    InputError
        If the samples were not simulated.
    """
    if "simulated_chds" not in samples.attrs:
        message = f"truth_of needs samples made by chdstat.simulate, got {samples!r}"
        raise InputError(message)
    import xarray as xr

    truths = []
    for chd in json.loads(samples.attrs["simulated_chds"]):
        body = tuple(Component(**component) for component in chd.pop("body"))
        truths.append(truth(CHD(body, color=tuple(chd.pop("color")), **chd)))
    region = _regions(len(truths), samples.shape[:2])
    values: dict[str, npt.NDArray[Any]] = dict(_codes(truths))
    for field, kind in (("label", "i1"), ("tail_index", "f8"), ("modes", "i1"), ("mean", "f8")):
        values[field] = np.array([getattr(found, field) for found in truths], dtype=kind)
    maps = {"region": region, **{name: value[region] for name, value in values.items()}}
    dataset = xr.Dataset({name: (("y", "x"), value) for name, value in maps.items()})
    for name, variable in dataset.data_vars.items():
        variable.attrs.update(long_name=f"true {name}".replace("_", " "), units="1")
    dataset["mean"].attrs["units"] = RADIANCE
    dataset["label"].attrs.update(flag_attributes(Label))
    return dataset


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


def _codes(truths: Sequence[Truth]) -> dict[str, npt.NDArray[np.int8]]:
    """Return 1 where a flag holds, 0 where not, -1 in its indifference zone; by name."""
    return {
        name: np.array([-1 if t.flags[name] is None else t.flags[name] for t in truths], np.int8)
        for name in truths[0].flags
    }


_ROWS = 256
"""CHDs drawn and classified together."""


@dataclass(frozen=True)
class FlagScore:
    """How often a flag is right.

    Attributes
    ----------
    hits, false, missed
        Numbers of CHDs with pattern and flag; with the flag only; with the pattern only.
    """

    hits: int
    false: int
    missed: int

    @property
    def precision(self) -> float:
        """Share of the flags that are right; NaN without a flag."""
        return self.hits / (self.hits + self.false) if self.hits + self.false else math.nan

    @property
    def recall(self) -> float:
        """Share of the patterns that are found; NaN without a pattern."""
        return self.hits / (self.hits + self.missed) if self.hits + self.missed else math.nan

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; NaN with neither flag nor pattern."""
        total = 2 * self.hits + self.false + self.missed
        return 2 * self.hits / total if total else math.nan


def random_chds(count: int, *, seed: Seed = None) -> tuple[CHD, ...]:
    """Draw CHDs from a population that has every pattern and their combinations.

    ===============  ===============================================================================
    body             one component 56 %, two 17 %, three 17 %, constant 10 %; all of a CHD gamma or
                     all log-normal; brightness log-uniform over four decades
    one component    gamma shape 0.5 to 6, log-uniform; log-normal sigma 0.3 to 1.2
    two, three       gamma shape 1 to 6, log-uniform; log-normal sigma 0.3 to 0.8; Ashman's D of
                     neighbours 2.5 to 6; weights 0.25 to 0.75 of two, at least 0.2 of three
    tail             grafted to half of those with one component and a quarter of the others; xi 0
                     to 0.75; share 0.1 to 0.25, at most half the weight of the brightest component
    nulls            none 40 %, a share below one half 30 %, from there to 0.95 30 %
    firefly          15 %, not of constants: carries 0.25 to 0.75 of the sum of a pixel
    ===============  ===============================================================================

    Numbers are uniform unless stated otherwise. CHDs in an indifference zone are drawn again,
    except that a light grafted tail alone leaves the family of the body open.

    Parameters
    ----------
    count
        Number of CHDs.
    seed
        Seed of the draws.

    Examples
    --------
    >>> sorted({len(chd.body) for chd in random_chds(50, seed=1)})
    [1, 2, 3]
    """
    rng = generator(seed)
    chosen: list[CHD] = []
    while len(chosen) < count:
        chd = _random_chd(rng)
        undecided = {name for name, holds in truth(chd).flags.items() if holds is None}
        if chd.tail_index is not None and len(chd.body) == 1:
            undecided -= {"gamma_like", "lognormal_like"}
        if not undecided:
            chosen.append(chd)
    return tuple(chosen)


def flag_scores(
    chds: Sequence[CHD], samples: int, *, thresholds: Thresholds | None = None, seed: Seed = 0
) -> Mapping[str, FlagScore]:
    """Draw one pixel of each CHD, classify it, and compare the flags with the truth.

    A CHD in the indifference zone of a flag does not count for that flag. Whether a firefly
    dominates is decided by the samples: shares between half and twice the threshold do not count.

    Parameters
    ----------
    chds
        Distributions, such as those of `random_chds`.
    samples
        Non-null samples of each pixel. The number of nulls is random, as if sampling went on until
        there are so many.
    thresholds
        Thresholds of the patterns; None for the defaults.
    seed
        Seed of the draws.

    Returns
    -------
    dict
        `FlagScore` by the name of the flag.

    Raises
    ------
    InputError
        If `samples` is not positive, or a CHD has only nulls.

    Examples
    --------
    >>> scores = flag_scores(random_chds(100, seed=1), 512)
    >>> scores["null_heavy"].f1 > 0.9
    True
    """
    if samples < 1 or any(chd.null_share == 1 for chd in chds):
        message = f"flag_scores needs samples >= 1 and CHDs that are not black, got {samples}"
        raise InputError(message)
    thresholds = thresholds or Thresholds()
    rng = generator(seed)
    totals = {pattern.name: np.zeros(3, dtype=int) for pattern in PATTERNS}
    limit = firefly_limit(np.array(samples), thresholds)
    for some in spans(len(chds), _ROWS):
        these = chds[some]
        draws = [replace(chd, null_share=0.0).draw(samples=samples, seed=rng) for chd in these]
        x = np.stack(draws)
        nulls = rng.negative_binomial(samples, [1 - chd.null_share for chd in these])
        none = np.zeros_like(nulls)
        part = PositivePart(x, np.asarray(x > 0), none + samples, nulls, none, none, none)
        patterns = measured(part, Classification(thresholds))
        wanted = _codes([truth(chd) for chd in these])
        ratio = patterns.statistics["firefly_dominated"] / limit
        wanted["firefly_dominated"] = np.select([ratio >= 2, ratio <= 0.5], [1, 0], -1)
        for name, code in wanted.items():
            flag = patterns.flags[name]
            cases = flag & (code == 1), flag & (code == 0), ~flag & (code == 1)
            totals[name] += [np.count_nonzero(case) for case in cases]
    return {name: FlagScore(*(int(count) for count in counts)) for name, counts in totals.items()}
