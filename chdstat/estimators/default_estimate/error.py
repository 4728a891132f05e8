"""Error of an estimate, from held-out halves of the samples, and the samples that reach a smaller.

The error of an image is the root of its relMSE: `chdstat._core.image_scales.relative_error`. Nobody
knows the truth, but each half of the samples has a mean without bias. Let a and b be the estimates
from the halves, y and z their means, and mu the truth. Then two terms make up the squared error of
the estimate from all samples:

- **Noise**: ``E (a - b)^2 / 4``, half of the variance of a half.
- **Bias**: ``E (a - y)(b - z)``. The halves are independent, so that this is the product of two
  expectations ``E a - mu``. Noise that a and y share cancels, and the estimate that is the mean has
  the bias 0 exactly. No variance of samples needs to be known, which heavy tails make impossible.

The noise of the bias is that of the means, though, which may be a hundred times the error of the
estimate. So the image is cut into details of 1, 2, 4, ... pixels (a Haar transform), and its bias
into as many sums: a bias that is smooth stands out at coarse scales, and fine details of which
nothing is seen do not drown it. At each scale, the bias is expected to be as large as the noise
of the estimate there, within a factor of a few, unless the products say otherwise: smoothing that
minimises the error balances both. The posterior mean of this normal likelihood and log-normal prior
is never negative, follows the products where they are certain and the noise where they are not.

Forecast
--------

The squared error M of the mean falls as 1 / n. That of what it is combined with, P, falls more
slowly, since a bias falls only where less is smoothed. Weights that suit both reach the squared
error ``F = 1 / (1 / M + 1 / P)``, so that P follows from F and M. From half of the samples to all,
an error of these parts falls from bias + 2 noise to bias + noise: at the rate ``log2(1 + noise /
F)``, with which P would fall as n to the minus this power. For images whose radiance changes at a
bounded rate, that power is 1/2 (Stone 1982, "Optimal global rates of convergence for nonparametric
regression", doi:10.1214/aos/1176345969). The forecast takes the average of both.

Intervals of pixels
-------------------

An interval has three parts: that of the mean and that of the proposal, each as far as the estimate
consists of it, and that of the light that is given back. The first two are what is expected of a
pixel with such samples. What held-out halves show makes them wider or narrower, so that they hold
on average over pixels that are alike, whatever was expected (Armstrong, Kolesar and
Plagborg-Moller 2022, "Robust empirical Bayes confidence intervals", doi:10.3982/ECTA18597, bound
the second moment of a bias to this end).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from chdstat._core.arrays import Floats, Reals, block_sums, spans
from chdstat._core.display import about, duration, percent, with_interval
from chdstat._core.image_scales import TOLERANCE, relative_scale
from chdstat._core.resampling import LEVEL
from chdstat.estimators.default_estimate.weights import Proposal

_USUAL, _WIDTH = 1.0, 1.0
"""Median of the squared bias over the noise, and standard deviation of the logarithm of this ratio,
before any evidence."""
_UNUSUAL = 1e-3
"""Probability of any other ratio, per unit of its logarithm."""
_CERTAIN = 10.0
"""Standard errors from which a product is certain."""
_BAND = 2**15
"""Pixels that are compared at once."""
_EDGE = 8
"""Edge in pixels of the blocks whose squared errors count as independent, and of the smallest image
that is cut into details: fewer would not tell how certain they are."""
_OTHERWISE = 0.3
"""Standard deviation of the squared error, relative to it, for what halves do not tell: they smooth
more than all samples do."""
_VARIES = 0.5
"""Largest relative variance of the truth around a smooth estimate: of more, no mean exists."""
_SURE = 0.9
"""Probability that the error is not larger than `ErrorOfEstimate.surely`."""
_RATE = 0.5
"""Rate at which the error of smoothing falls if the image is Lipschitz."""
_SHARE = 0.98
"""Largest share of the mean's squared error that an estimate has in a forecast."""
_FACTOR = 40.0
"""Logarithm of the largest factor by which the number of samples may have to grow."""


@dataclass(frozen=True)
class ErrorOfEstimate:
    """Error of an estimate, and how it depends on the number of samples.

    Attributes
    ----------
    bias, noise
        Parts of the relMSE of the estimate: what an average over many renders would keep, and what
        it would lose. NaN if nothing is known.
    of_mean
        relMSE of the mean of the samples.
    spread
        Standard error of the relMSE of the estimate.
    spp
        Mean number of samples of a pixel.

    Examples
    --------
    Half of the error takes four times the samples where the estimate is the mean, and more where
    smoothing has made its error smaller:

    >>> mean = ErrorOfEstimate(bias=0.0, noise=0.01, of_mean=0.01, spread=0.001, spp=100)
    >>> round(mean.relative, 3), round(mean.spp_for(0.05))
    (0.1, 402)
    >>> smooth = ErrorOfEstimate(bias=0.005, noise=0.005, of_mean=0.1, spread=0.001, spp=100)
    >>> round(smooth.relative, 3), round(smooth.spp_for(0.05))
    (0.1, 949)
    """

    bias: float = math.nan
    noise: float = math.nan
    of_mean: float = math.nan
    spread: float = math.nan
    spp: float = math.nan

    @property
    def relative(self) -> float:
        """Relative error of the image, the root of its relMSE; NaN if it is not known."""
        return math.sqrt(self.bias + self.noise)

    @property
    def surely(self) -> float:
        """Relative error that nine of ten such images do not exceed; NaN if it is not known."""
        return self._at(_SURE)

    @property
    def interval(self) -> tuple[float, float]:
        """Interval of the relative error that holds it in 95 of 100 such images."""
        return self._at((1 - LEVEL) / 2), self._at((1 + LEVEL) / 2)

    def _at(self, probability: float) -> float:
        """Return the relative error that such images do not exceed with a probability."""
        if not self.relative > 0:
            return self.relative
        # Of a log-normal distribution of the squared error with this mean and standard deviation.
        spread = math.sqrt(math.log1p((self.spread / self.relative**2) ** 2))
        return self.relative * math.exp((stats.norm.ppf(probability) * spread - spread**2 / 2) / 2)

    def reaches(self, error: float) -> bool:
        """Return whether a relative error is reached, with a tenth to spare in nine of ten images.

        A render that stops at the first estimate whose error seems small enough would otherwise
        stop where the error seems smaller than it is.
        """
        return self.relative <= error and self.surely <= TOLERANCE * error

    def spp_to_reach(self, error: float) -> float:
        """Return the samples per pixel at which an error is expected to be reached."""
        sure = TOLERANCE * self.relative / self.surely if self.surely else 1.0
        return self.spp_for(min(error, sure * error))

    def told(self, wanted: float | None = None, seconds: float = math.nan) -> str:
        """Return the relative error in words, and what a smaller one takes.

        Parameters
        ----------
        wanted
            The error that is wanted; None for half of the present one.
        seconds
            Time that the samples so far took.

        Examples
        --------
        >>> found = ErrorOfEstimate(bias=0.0, noise=0.01, of_mean=0.01, spread=0.001, spp=100)
        >>> found.told(0.02, seconds=10.0).replace("\N{NO-BREAK SPACE}", " ")
        'relative error 10 % [9.0 %, 11 %]; 2.0 % takes about 2,500 spp, 2,000 to 3,100, 4 min more'
        """
        if not self.relative >= 0:
            return "the samples do not tell the relative error"
        told = f"relative error {self.in_words()}"
        if wanted is None and not self.relative:
            return told
        wanted = self.relative / 2 if wanted is None else wanted
        if self.relative <= wanted:
            return told + ("" if self.reaches(wanted) else f"; {percent(wanted)} is not yet sure")
        spp = self.spp_for(wanted)
        if not math.isfinite(spp):
            return f"{told}; no number of samples gives {percent(wanted)}"
        more = seconds * (spp / self.spp - 1)
        after = f", {duration(more)} more" if math.isfinite(more) else ""
        return f"{told}; {percent(wanted)} takes {self.spp_in_words(wanted)}{after}"

    def in_words(self) -> str:
        """Return the relative error with its interval."""
        return with_interval(self.relative, *self.interval, percent)

    def spp_in_words(self, error: float) -> str:
        """Return the samples per pixel that a relative error takes, with their range.

        Examples
        --------
        >>> found = ErrorOfEstimate(bias=0.0, noise=0.01, of_mean=0.01, spread=0.003, spp=100)
        >>> found.spp_in_words(0.05)
        'about 400 spp, 220 to 690'
        """
        return about(self.spp_for(error), *self.spp_range(error), "spp")

    def spp_for(self, error: float) -> float:
        """Return the samples per pixel at which this estimate has a relative error.

        NaN if the error is not known, and infinite if no number of samples is enough.
        """
        return self._spp_for(error, self.relative**2, sum(self._rates) / 2)

    def spp_range(self, error: float) -> tuple[float, float]:
        """Return the range of `spp_for`.

        The ends take the present error to be at the ends of its interval, and smoothing to gain at
        the faster and the slower of both rates. Fireflies that no sample has shown are in no range.
        """
        (low, high), rates = self.interval, self._rates
        return (
            self._spp_for(error, low**2, max(rates)),
            self._spp_for(error, high**2, min(rates)),
        )

    @property
    def _rates(self) -> tuple[float, float]:
        """Powers of the number of samples with which the error of smoothing may fall."""
        squared = self.relative**2
        return _RATE, math.log2(1 + self.noise / squared) if squared > 0 else _RATE

    def _spp_for(self, error: float, squared: float, rate: float) -> float:
        if not squared > 0:
            return self.spp if squared == 0 else math.nan
        of_mean = max(self.of_mean, squared / _SHARE)
        smooth = 1 / (1 / squared - 1 / of_mean)

        def above(factor: float) -> float:
            now = math.exp(factor) / of_mean + math.exp(rate * factor) / smooth
            return -math.log(now) - 2 * math.log(error)

        if above(_FACTOR) > 0:
            return math.inf
        return self.spp * math.exp(optimize.brentq(above, -_FACTOR, _FACTOR))


def error_of(
    estimate: Reals, error: Reals, halves: Sequence[tuple[Reals, Reals]], count: Reals
) -> ErrorOfEstimate:
    """Return the error of an estimate, from the same estimate of each half of the samples.

    Parameters
    ----------
    estimate
        The estimate from all samples, shape (y, x, channel), in any unit; pixels that are NaN are
        left out.
    error
        Standard error of the mean of all samples, shape (y, x, channel).
    halves
        For each half, the estimate from it and the mean of its samples, shape (y, x, channel). The
        more of an estimate depends on its own half alone, the better: weights that both halves
        have decided make the error seem smaller than it is.
    count
        Number of samples of each pixel, shape (y, x, channel).

    Examples
    --------
    A mean that is multiplied by .9 has a bias of .1, and .81 of the mean's variance:

    >>> x = np.random.default_rng(0).exponential(size=(2, 64, 64, 1, 50))
    >>> halves = [(0.9 * y, y) for y in x.mean(axis=-1)]
    >>> mean = x.mean(axis=(0, -1))
    >>> found = error_of(0.9 * mean, np.full(mean.shape, 0.1), halves, np.full(mean.shape, 100))
    >>> truth = ((0.9 * mean - 1) ** 2).mean() / 0.9**2 / 1.01  # relative to the estimate
    >>> round(float(truth) ** 0.5, 2), round(found.relative, 2)
    (0.15, 0.15)
    """
    known = np.isfinite(estimate)
    number = np.maximum(known.sum(axis=(0, 1)), 1)
    mean = np.sum(estimate, axis=(0, 1), where=known, dtype=np.float64) / number
    found = _Found()
    for rows in spans(len(estimate), max(_BAND // (_EDGE * estimate.shape[1]), 1) * _EDGE):
        band = [[image[rows] for image in half] for half in halves]
        found.add(estimate[rows], error[rows], band, mean)
    if not found.pixels:
        return ErrorOfEstimate(spp=float(np.mean(count)))
    noise, of_noise = found.noise()
    bias, variance = np.sum([_bias(*scale) for scale in found.scales()], axis=0)
    larger = found.larger(float(bias), noise)
    spread = math.sqrt(variance + of_noise + (_OTHERWISE * (bias + noise)) ** 2)
    of_mean = found.of_mean / found.pixels
    bias, noise, of_mean, spread = (larger * float(x) for x in (bias, noise, of_mean, spread))
    return ErrorOfEstimate(bias, noise, of_mean, spread, float(np.mean(count)))


class _Found:
    """Sums over the bands of an image, which keep its memory small.

    Attributes
    ----------
    pixels
        Number of known pixels and channels.
    of_mean
        Sum of the squared errors of the mean, relative to the estimate.
    products
        Sums of the squares of what the halves of estimates and of means differ in, and of their
        products.
    blocks
        Per block: the sum of the squares of what the halves differ in, of the share of the
        estimate's own square in the denominator, and the number of pixels.
    finest
        Sums of the finest scale: see `_within`.
    coarser
        Means of blocks of 2 x 2 pixels, shape (image, y, x, channel), and how many are known.
    """

    def __init__(self) -> None:
        self.pixels, self.of_mean, self.products = 0, 0.0, np.zeros(3)
        self.blocks: list[Floats] = []
        self.finest = np.zeros(4)
        self.coarser: list[tuple[Floats, Floats]] = []

    def add(
        self, estimate: Reals, error: Reals, halves: Sequence[Sequence[Reals]], mean: Floats
    ) -> None:
        """Add a band of rows."""
        (a, y), (b, z) = ([image.astype(np.float64) for image in half] for half in halves)
        known = np.isfinite(estimate) & np.isfinite(error) & np.isfinite(a + b + y + z)
        image = np.where(known, estimate, 0).astype(np.float64)
        scale = relative_scale(image, mean)
        root = np.divide(1, np.sqrt(scale), out=np.zeros_like(scale), where=known & (scale > 0))
        mine, other, apart, of_means = (
            np.where(known, part, 0) * root for part in (a - y, b - z, (a - b) / 2, (y - z) / 2)
        )
        self.pixels += int(known.sum())
        self.of_mean += float(np.square(np.where(known, error, 0) * root).sum())
        self.products += [
            np.vdot(apart, apart),
            np.vdot(of_means, of_means),
            np.vdot(apart, of_means),
        ]
        self.blocks.append(
            block_sums(np.stack([apart**2, (image * root) ** 2, known]), _EDGE).reshape(3, -1)
        )
        images, count = np.stack([mine, other, apart]), known.astype(np.float64)
        means, number, details = _halved(images, count)
        self.finest += _within(details, count)
        self.coarser.append((means, number))

    def noise(self) -> tuple[float, float]:
        """Return the relMSE of what two halves differ in, and the variance of this number.

        As far as it is in proportion to the difference of the means, their standard error is known
        from many samples, and not from two halves only.
        """
        apart, of_means, both = self.products
        share = both / of_means if of_means > 0 else 0.0
        noise = max(apart - share**2 * of_means, 0.0) + share**2 * self.of_mean
        variance = sum(np.square(squared).sum() for squared, *_ in self.blocks)
        return float(noise / self.pixels), float(variance) / self.pixels**2

    def scales(self) -> Iterator[tuple[float, float, float]]:
        """Yield the product of the halves at each scale, its standard error, and the noise there.

        The details of blocks of 2 x 2 pixels are one scale, those of the means of the blocks the
        next one, until few blocks are left. The sum over all scales is the mean over the pixels.
        """
        yield self._scale(self.finest)
        images, count = (
            np.concatenate(parts, axis=-3) for parts in zip(*self.coarser, strict=True)
        )
        while max(count.shape[:2]) > _EDGE:
            means, number, details = _halved(images, count)
            yield self._scale(_within(details, count))
            images, count = means, number
        yield self._scale(_within(images, count, edge=1))

    def _scale(self, sums: Floats) -> tuple[float, float, float]:
        product, squares, differences, noise = sums / self.pixels
        return product, math.sqrt(min(squares, differences) / self.pixels), noise

    def larger(self, bias: float, noise: float) -> float:
        """Return the factor by which an error relative to the truth exceeds that to the estimate.

        A smooth estimate is too bright where the truth is dark, and errors there are large relative
        to the truth. Where the truth is gamma distributed around the estimate, with the variance t
        relative to its square, the mean of ``(1 - x)^2 / x^2`` is ``t (1 + 5 t)``, to second order.
        """
        squared, own, number = np.concatenate(self.blocks, axis=-1)
        if not squared.any():
            return 1.0
        number = np.maximum(number, 1)
        local = squared / number * (bias + noise) * self.pixels / squared.sum()
        varies = np.minimum(bias / (bias + noise) * local, _VARIES) * own / number
        return float(np.average(1 + 5 * varies, weights=squared))


def _halved(images: Floats, count: Floats) -> tuple[Floats, Floats, Floats]:
    """Return means of blocks of 2 x 2 pixels, how many are known, and what the means leave."""
    number = block_sums(count, 2)
    means = block_sums(count * images, 2) / np.maximum(number, 1)
    height, width = count.shape[:2]
    around = np.repeat(np.repeat(means, 2, axis=1), 2, axis=2)[:, :height, :width]
    return means, number, images - around


def _within(images: Floats, count: Floats, edge: int = 2) -> Floats:
    """Return sums over blocks: of products of two images, and of squares that tell their variance.

    Of normal noise, the squares of the products and those of half of the difference of the squares
    have the same mean. What two images share is in the first only, and a bright sample counts more
    in the second. The last sum is that of the squares of the third image.
    """
    one, other, apart = images
    products, differences = (
        block_sums((count * parts).sum(axis=-1, keepdims=True), edge)
        for parts in (one * other, (one**2 - other**2) / 2)
    )
    sums = [products.sum(), np.square(products).sum(), np.square(differences).sum()]
    return np.array([*sums, (count * apart**2).sum()])


def _bias(product: float, error: float, noise: float) -> tuple[float, float]:
    """Return the expected squared bias at one scale, and its variance."""
    if product > _CERTAIN * error or error == 0:
        return max(product, 0.0), error**2
    usual, width = math.log(max(_USUAL * noise, 1e-9 * error)), _WIDTH
    ends = math.log(error) + np.array((math.log(1e-3), math.log(2 * _CERTAIN)))
    grid = np.arange(min(usual - 4 * width, ends[0]), max(usual + 4 * width, ends[1]), 0.05)
    squared = np.exp(grid)
    likely = -np.square((squared - product) / error) / 2
    prior = stats.norm.pdf(grid, usual, width) + _UNUSUAL
    weight = prior * np.exp(likely - likely.max())
    mean = float(np.average(squared, weights=weight))
    return mean, float(np.average((squared - mean) ** 2, weights=weight))


# --- intervals ------------------------------------------------------------------------------------


_MARGIN = 0.5
"""Standard errors within which what held-out halves show may be noise."""
_KEPT = 0.95
"""Weight of the mean from which an estimate is the mean."""
_RANGE = 0.05, 100.0
"""Least and largest factor of a squared error."""


def interval_around(
    radiance: Reals,
    weight: Reals,
    reach: Sequence[Reals],
    half: Reals,
    light: Reals,
    proposals: Sequence[Proposal],
    halves: Sequence[Reals],
    level: float,
) -> tuple[Reals, Reals]:
    """Return the lower and upper end of the intervals of an estimate, shape (y, x, channel).

    Parameters
    ----------
    radiance, weight
        The estimate, and the weight of the mean in it.
    reach
        How far the interval of the mean reaches below and above it.
    half
        Half of the width of the interval of the proposal.
    light
        How far the light that is given back may be from what is lost.
    proposals
        Proposals of all samples, of one half of them and of the other.
    halves
        Estimates of the halves.
    level
        Probability of the interval.
    """
    # The best weight of a mean of variance v leaves the variance weight v (James and Stein 1961).
    normal = stats.norm.ppf(0.5 + level / 2)
    # Few samples that are all equal, as of visibility, may be equal by chance where others vary.
    chance = np.where(proposals[0].known, normal * proposals[0].around, 0)
    sides = [
        np.hypot((1 - weight) * half, np.sqrt(weight) * np.maximum(side, chance)) for side in reach
    ]
    factor = _shown_over_expected(sum(sides) / (2 * normal), weight, proposals, halves)
    below, above = (np.hypot(factor * side, normal * light) for side in sides)
    return radiance - below, radiance + above


def _shown_over_expected(
    error: Reals, weight: Reals, proposals: Sequence[Proposal], halves: Sequence[Reals]
) -> Reals:
    """Return the error that held-out halves show over the one that is expected of each pixel.

    The product of what the estimates of the halves differ in from the means of the same halves is,
    on average, the square of their bias; see `default_estimate.error`. With half of the squared
    difference of the estimates, their noise, it is averaged over pixels of the same channel, place
    and noise. As long as its own noise explains it, what is expected stands.
    """
    whole, one, other = proposals
    grid, unit = whole.groups, whole.unit
    # The error of a pixel that keeps its mean is known from its samples.
    counted = (weight < _KEPT) / unit**2
    bias = counted * (halves[0] - one.mean) * (halves[1] - other.mean)
    noise = counted * np.square(halves[0] - halves[1]) / 4
    bias, squares, noise, expected = grid.sums(bias, bias**2, noise, counted * error**2)
    margin = _MARGIN * np.sqrt(squares)
    least, most = np.maximum(bias - margin, 0) + noise, np.maximum(bias, 0) + margin + noise
    shown = np.clip(expected, least, most)
    found = np.divide(shown, expected, out=np.ones_like(shown), where=expected > 0)
    return np.asarray(np.where(weight < _KEPT, np.sqrt(grid.at(np.clip(found, *_RANGE))), 1))
