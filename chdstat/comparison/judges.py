r"""Judges: what held-out samples tell of the true radiance, in parts of independent noise.

A squared error against a noisy reference holds the noise of the reference, and a relative error
divided by a noisy reference is large wherever the reference missed light. So the samples that do
not belong to an estimate p are divided into four parts, by their number modulo 4. Their means
:math:`y_1, ..., y_4` have independent noise, and for two of them

.. math:: E\,(p - y_a)(p - y_b) = E\,(p - \mu)^2,

where :math:`\mu` is the true radiance. Relative errors take their denominators from the other two
parts: :math:`E\,w(y_c, y_d)\,(p - y_a)(p - y_b) = E\,w(y_c, y_d) \cdot E\,(p - \mu)^2`. All pairs
are averaged. This is cross-fitting, as in Chernozhukov et al. 2018, "Double/debiased machine
learning", doi:10.1111/ectj.12097.

Noise still makes denominators :math:`w(y) = 1 / (y^2 + 0.01 m^2)` too large on average where light
is rare. So y is smoothed by the filter of Lee 1980, "Digital image enhancement and noise filtering
by use of local statistics", doi:10.1109/TPAMI.1980.4766994, and relative errors are returned twice:
with denominators from both other parts, and from one of them, which is twice as noisy. What changes
little between the two may be extrapolated to no noise; what changes much is not known.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Array, Floats, LeftOut
from chdstat._core.image_scales import relative_scale
from chdstat._core.work import finished
from chdstat.errors import InputError
from chdstat.estimators.held_out import without
from chdstat.estimators.registry import whole_samples
from chdstat.samples import Samples
from chdstat.samples.dependence import check_independent

PARTS = 4
"""Parts of a reference. More would use the samples little better: the noise of all pairs of four
has 1.33 times the variance of that of very many."""
_PAIRS = tuple(combinations(range(PARTS), 2))
_WINDOW = 7
"""Edge of the filter's window, in pixels, as in Lee 1980."""
_TINY = 1e-30
"""Least squared radiance, in units of the scene: errors in a scene without light are finite."""
_PASSES = 2
"""The second pass takes the noise at the radiance that the first one found."""


@dataclass(frozen=True)
class Judge:
    """Judge of estimates: the true radiance of pixels, from samples that no estimate has seen.

    Attributes
    ----------
    mean
        Mean of the four parts, shape (..., channel).
    error
        Its standard error, same shape; 0 if it is unknown.
    variance
        Its variance without bias, from the differences of the parts, same shape.
    relative_terms
        Terms of the relative squared error of an estimate p, from p - mean to the powers 0, 1 and
        2: with denominators from two parts, and from one; shape (2, 3, ..., channel).
    """

    mean: Floats
    error: Floats
    variance: Floats
    relative_terms: Array

    @classmethod
    def of_image(cls, parts: Floats, error: Floats, scene_mean: Floats) -> Self:
        """Return the judge of an image from the parts of its samples.

        Parameters
        ----------
        parts
            Means of disjoint samples, shape (4, y, x, channel). Where one is no number, nothing is
            known of the pixel. Of an image whose noise is unknown, all parts are the image.
        error
            Standard error of their mean, shape (y, x, channel).
        scene_mean
            Mean radiance of the scene, shape (channel,).
        """
        known = np.asarray(np.isfinite(parts).all(axis=(0, -1)))[..., np.newaxis]
        unit = float(np.abs(scene_mean).max(initial=0)) or 1.0
        light = np.where(known, parts, 0) / unit
        mean = light.mean(axis=0)
        apart = light - mean
        terms = np.zeros((2, 3, *mean.shape))
        for (a, b), weights in zip(_PAIRS, _weights(light, scene_mean / unit), strict=True):
            # (p - a)(p - b) = (p - mean)^2 - (p - mean)(a + b) + a b, for parts a and b minus mean.
            for power, factor in enumerate((apart[a] * apart[b], -(apart[a] + apart[b]), 1.0)):
                terms[:, power] += weights * factor / len(_PAIRS)
        terms *= (unit ** -np.arange(3.0))[:, np.newaxis, np.newaxis, np.newaxis]
        return cls(np.where(known, mean * unit, np.nan), error, _variance(apart) * unit**2, terms)

    def __getitem__(self, pixels: Any) -> Self:
        """Return the judge of some pixels."""
        chosen = pixels if isinstance(pixels, tuple) else (pixels,)
        terms = self.relative_terms[:, :, *chosen]
        return type(self)(self.mean[chosen], self.error[chosen], self.variance[chosen], terms)

    def squared(self, estimate: Array) -> Floats:
        """Return squared errors of estimates, shape (..., channel), without bias.

        Single values may be negative.
        """
        # The mean of (p - a)(p - b) over all pairs of parts.
        return np.asarray(np.square(estimate - self.mean) - self.variance)

    def relative(self, estimate: Array) -> Floats:
        """Return relative squared errors, with denominators from two parts, and from one.

        Shape (2, ..., channel).
        """
        apart, terms = estimate - self.mean, self.relative_terms
        return np.asarray(terms[:, 0] + apart * (terms[:, 1] + apart * terms[:, 2]))


@dataclass(frozen=True)
class PartialSums:
    """Sums over the good samples of every pixel, in four parts by their number.

    Attributes
    ----------
    total
        Sums of the radiance, float64, shape (y, x, channel, 4).
    count
        Good samples, shape (y, x, 1, 4).
    square
        Sum of the squared radiance of all parts, shape (y, x, channel).
    """

    total: Floats
    count: npt.NDArray[np.int64]
    square: Floats

    @classmethod
    def of(cls, samples: Samples) -> Self:
        """Sum over an image in one pass through its blocks."""
        return finished(cls.adding(samples))

    @classmethod
    def adding(cls, samples: Samples) -> Generator[tuple[str, float], None, Self]:
        """Do the same in steps; yield what is being done, and the share that is done."""
        height, width, channels, spp = samples.shape
        total = np.zeros((height, width, channels, PARTS))
        count = np.zeros((height, width, 1, PARTS), np.int64)
        square = np.zeros((height, width, channels))
        left_out, done = LeftOut(), 0
        for ys, xs, ss, block in samples.blocks():
            yield f"reading all of {samples.name}", done / (height * width * spp)
            done += block[:, :, 0].size
            left_out.see(block, channel_axis=-2, absent=samples.absent(ys, xs, ss))
            kept, sums, number = _sums_of(block, ss.start or 0)
            total[ys, xs] += sums
            count[ys, xs] += number
            square[ys, xs] += np.vecdot(kept, kept)
        left_out.warn()
        return cls(total, count, square)

    @cached_property
    def mean(self) -> Floats:
        """Mean of the good samples, shape (y, x, channel); NaN where there is none."""
        return _ratio(self.total.sum(axis=-1), self.count.sum(axis=-1))

    @cached_property
    def scene_mean(self) -> Floats:
        """Mean over the pixels that have a good sample, shape (channel,)."""
        return np.asarray(self.mean[self.count.any(axis=(2, 3))].mean(axis=0))

    @cached_property
    def variance(self) -> Floats:
        """Variance of the samples, shape (y, x, channel); NaN for less than two."""
        number = self.count.sum(axis=-1)
        variance = _ratio(self.square, number) - np.square(self.mean)
        return np.maximum(variance, 0) * _ratio(number, number - 1)

    @property
    def halves(self) -> Floats:
        """Means of two halves of the samples, shape (2, y, x, channel)."""
        pairs = (
            _ratio(*(x[..., k::2].sum(axis=-1) for x in (self.total, self.count))) for k in (0, 1)
        )
        return np.stack([*pairs])

    def judge(self, batch: Array | None = None, *, first: int = 0) -> Judge:
        """Return the judge from all samples, or from all but those of a batch.

        Parameters
        ----------
        batch
            Samples of the image, shape (y, x, channel, n), whose estimate is to be measured.
        first
            Number of its first sample.

        Returns
        -------
        Judge
            Unknown (NaN) where the batch holds a bad sample, or a part has no sample.
        """
        return Judge.of_image(*self._parts(batch, first), self.scene_mean)

    def _parts(self, batch: Array | None, first: int) -> tuple[Floats, Floats]:
        """Return the means of the parts, and the standard error of their mean."""
        total, count = self.total, self.count
        if batch is not None:
            _, sums, number = _sums_of(batch, first)
            bad = number.sum(axis=-1, keepdims=True) < batch.shape[-1]
            total, count = without(total, sums), np.where(bad, 0, count - number)
        # The batch is part of the variance: else a pixel whose light it alone found seems certain.
        error = np.sqrt(_ratio(self.variance, count.sum(axis=-1)))
        return np.moveaxis(_ratio(total, count), -1, 0), error


def check_samples_for_judge(samples: Samples, n: int) -> None:
    """Check that there are enough samples for estimates from n and their references.

    Raises
    ------
    InputError
        If some pixel has fewer than 2 n or n + 7 samples, or samples depend on each other.
    """
    check_independent(samples.attrs)
    # The parts of n + 7 samples without n consecutive ones have one sample at least.
    least = max(2 * n, n + 2 * PARTS - 1)
    if samples.fewest < least:
        message = (
            f"estimates from {n} samples and a reference from as many others, in {PARTS} parts, "
            f"need at least {least} spp, got {samples.fewest}; render more samples per pixel, or "
            "take a smaller n"
        )
        raise InputError(message)


def _sums_of(x: Array, first: int) -> tuple[Floats, Floats, Array]:
    """Return the good samples of a block in float64, their sums and their numbers in each part."""
    whole, good = whole_samples(x)
    kept = whole.astype(np.float64)
    of_part = (first + np.arange(x.shape[-1])) % PARTS == np.arange(PARTS)[:, np.newaxis]
    number = good @ of_part.T.astype(np.int64)
    return kept, kept @ of_part.T.astype(np.float64), number[..., np.newaxis, :]


def _variance(apart: Floats) -> Floats:
    """Return the variance of the mean of parts, from their deviations (4, ...) from it."""
    return np.asarray(np.square(apart).sum(axis=0) / (PARTS * (PARTS - 1)))


def _ratio(total: Array, count: Array) -> Floats:
    """Return totals over numbers; NaN where there is none."""
    return np.asarray(total / np.where(count > 0, count, np.nan))


def _weights(parts: Floats, scene_mean: Array) -> Iterator[Array]:
    """Yield the inverse denominators of each pair of parts, from both others, and from one.

    Shape (2, y, x, channel).
    """
    images = [part.astype(np.float32) for part in parts]
    single = [_Local.of(image) for image in images]
    for pair in _PAIRS:
        one, other = (i for i in range(PARTS) if i not in pair)
        noise = np.maximum(_around(np.square(images[one] - images[other])), 0) / 2
        half = _Local.of((images[one] + images[other]) / 2).weight(noise / 2, scene_mean)
        each = [single[i].weight(noise, scene_mean) for i in (one, other)]
        yield np.stack([half, np.mean(each, axis=0)])


@dataclass(frozen=True)
class _Local:
    """An image with its mean and mean square in the window around each pixel."""

    image: Array
    mean: Array
    square: Array

    @classmethod
    def of(cls, image: Array) -> Self:
        # Running sums may leave a rounding below 0.
        return cls(image, _around(image), np.maximum(_around(np.square(image)), 0))

    def weight(self, noise: Array, scene_mean: Array) -> Array:
        """Return the inverse denominator of each pixel, whose window has such noise."""
        variance = np.maximum(self.square - np.square(self.mean) - noise, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(self.square > 0, noise / self.square, 0)
            own = noise
            for _ in range(_PASSES):
                share = np.where(own > 0, variance / (variance + own), 1)
                smooth = self.mean + share * (self.image - self.mean)
                own = relative * np.square(smooth)
            return np.asarray(1 / np.maximum(relative_scale(smooth, scene_mean), _TINY))


def _around(image: Array) -> Array:
    """Return means of an image (y, x, channel) over the window around each pixel."""
    return np.asarray(ndimage.uniform_filter(image, (_WINDOW, _WINDOW, 1), mode="nearest"))
