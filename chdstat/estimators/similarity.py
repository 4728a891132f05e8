"""Similarity: compare the samples of two pixels, and sum over windows of similar pixels.

Pixels are compared by means of transformed samples and their standard errors (Welch's test), or by
histograms (chi-square distance). Only samples that are good in all channels count; where there are
too few, errors are NaN and histograms empty.

A `Window` averages the pixels around each pixel, weighted by similarity. For each offset within the
window it shifts the image and compares all pairs of pixels at once. Weights are symmetric, so each
pair is compared only once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from chdstat._core.arrays import Floats, spans
from chdstat._core.image_scales import exposure_unit
from chdstat.estimators.registry import mean_of_good, whole_samples

_BINS = 20
"""Bins of a histogram (BCD)."""

_GAMMA = 2.2
_HIGHEST = 2.5
"""Radiance, after the gamma, at which the last but one bin begins (BCD)."""
_SATURATION = 2.0
"""Multiple of `_HIGHEST` from which samples fall entirely into the last bin (BCD)."""
_CHUNK = 2**16
"""Samples that are transformed at once."""
_PIXELS = 2**15
"""Pixels that are compared at once."""


@dataclass(frozen=True)
class ScaledSamples:
    """Samples of an image, and a unit in which its radiance is near 1.

    Attributes
    ----------
    samples
        Shape (y, x, channel, sample), 0 where a channel is bad.
    good
        Whether a sample is good in all channels, shape (y, x, sample).
    count
        Number of samples that are good in all channels, shape (y, x).
    unit
        A power of two, so that dividing by it does not round.
    """

    samples: npt.NDArray[np.floating[Any]]
    good: npt.NDArray[np.bool_]
    count: npt.NDArray[np.int64]
    unit: float

    @classmethod
    def of(cls, x: npt.NDArray[np.floating[Any]]) -> ScaledSamples:
        """Find the bad samples among (y, x, channel, sample), and the unit."""
        kept, good = whole_samples(x)
        _, exponent = np.frexp(exposure_unit(mean_of_good(kept).mean(axis=-1)))
        unit = float(np.ldexp(1.0, int(exponent) - 1))
        return cls(kept, good, np.count_nonzero(good, axis=-1), unit)

    def mean(self) -> Floats:
        """Return the mean of the good samples in units of `unit`, shape (y, x, channel)."""
        with np.errstate(invalid="ignore", over="ignore"):
            total = self.samples.sum(axis=-1, dtype=np.float64) / self.unit
            return np.asarray(total / self.count[..., np.newaxis])

    def radiance(self, estimate: Floats) -> Floats:
        """Return estimates in units of `unit` as radiance, NaN where no whole sample is good."""
        return np.where(self.count[..., np.newaxis] > 0, estimate * self.unit, np.nan)

    def walk(
        self, work: Callable[..., tuple[Floats, ...]], *beside: npt.NDArray[Any]
    ) -> tuple[Floats, ...]:
        """Apply ``work(rows, mask, count, *beside)`` to pixels that stay in the cache together.

        Rows have shape (pixel, channel, sample), in units of `unit`; masks (pixel, 1, sample);
        counts (pixel, 1). What stands beside the samples, (y, x, ...), becomes (pixel, ...).
        """
        height, width, channels, n = self.samples.shape
        rows = self.samples.reshape(-1, channels, n)
        good, count = self.good.reshape(-1, 1, n), self.count.reshape(-1, 1)
        others = [other.reshape(-1, *other.shape[2:]) for other in beside]
        found = [
            work(
                rows[part] / np.float64(self.unit),
                good[part],
                count[part],
                *(o[part] for o in others),
            )
            for part in spans(len(rows), max(1, _CHUNK // (channels * n)))
        ]
        return tuple(
            np.concatenate(kind).reshape(height, width, *kind[0].shape[1:])
            for kind in zip(*found, strict=True)
        )


Means = tuple[Floats, ...]
"""Means of transformed samples, shape (y, x, statistic), and their squared standard errors, NaN for
fewer than 2 samples."""


def root(x: Floats, power: float = 0.5) -> Floats:
    """Return samples to a power; for a negative sample x, ``-(-x)^power``."""
    if power == 1:
        return x
    size = np.abs(x) if x.min() < 0 else x
    found = np.sqrt(size) if power == 0.5 else size**power
    return found if size is x else np.copysign(found, x)


def corrected_means(image: ScaledSamples, transform: Callable[[Floats], Floats] = root) -> Means:
    """Return means of transformed samples, corrected for their skewness, and standard errors.

    The transform maps samples (pixel, channel, sample) to values (pixel, statistic, sample).

    ``mu + mu_3 / (6 s^2 n)``: Johnson 1978, doi:10.1080/01621459.1978.10480051, with mu_3 = M_3 / n
    and s^2 = M_2 / (n - 1), as in the code of Sakai et al. 2024.
    """

    def work(
        rows: Floats, good: npt.NDArray[np.bool_], n: npt.NDArray[np.int64]
    ) -> tuple[Floats, Floats]:
        # If radiances of one image differ by a factor of 1e100, errors may be infinite.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            y = transform(rows)
            mean = y.sum(axis=-1) / n
            deviation = (y - mean[..., np.newaxis]) * good
            square = deviation * deviation
            second, third = square.sum(axis=-1), np.vecdot(square, deviation)
            shift = third * (n - 1) / (6 * second * n**2)
            # Equal samples need no correction.
            shift = np.where((second > 0) & np.isfinite(shift), shift, 0)
            return mean + shift, second / (n * np.where(n > 1, n - 1, np.nan))

    return image.walk(work)


def histograms(image: ScaledSamples, unit: float) -> Floats:
    """Return the histograms of all channels, one after the other, shape (y, x, channel x bin).

    A sample is split linearly between the two nearest bins along ``v = (x / unit)^(1/2.2) / 2.5``.
    Bins 0 to 18 are spaced evenly from v = 0 to 1; the last bin takes larger samples, and negative
    samples fall into the first. This follows the code of Bayesian collaborative denoising, Boughida
    and Boubekeur 2017, doi:10.1111/cgf.13231.
    """
    channels = image.samples.shape[2]

    def work(rows: Floats, good: npt.NDArray[np.bool_], _: object) -> tuple[Floats]:
        with np.errstate(over="ignore"):
            v = (np.maximum(rows, 0) * (image.unit / unit)) ** (1 / _GAMMA) / _HIGHEST
        v = np.minimum(v, _SATURATION)
        place = v * (_BINS - 2)
        low = np.minimum(place.astype(np.intp), _BINS - 2)
        high = np.where(v < 1, place - low, v - 1)
        start = _BINS * np.arange(len(rows) * channels).reshape(len(rows), channels, 1)
        where = (low + start).reshape(-1)
        size = _BINS * len(rows) * channels
        low_bins = np.bincount(where, (good * (1 - high)).reshape(-1), size)
        found = low_bins + np.bincount(where + 1, (good * high).reshape(-1), size)
        return (np.asarray(found, dtype=np.float64).reshape(len(rows), -1),)

    return image.walk(work)[0]


def chi_square(h: Floats, n: Floats, other: Floats, m: Floats) -> tuple[Floats, Floats]:
    """Return the chi-square distance of histograms of n and m samples, and the bins used.

    ``sum (m h - n h')^2 / (n m (h + h'))``: Delbracio et al. 2014, doi:10.1145/2532708. Bins with
    at most one sample of the two together are not used, as in the code of Boughida and Boubekeur
    2017.
    """
    both = h + other
    used = (both > 1) & (n > 0) & (m > 0)
    apart = np.sqrt(m / np.maximum(n, 1)) * h - np.sqrt(n / np.maximum(m, 1)) * other
    terms = np.divide(apart * apart, both, out=np.zeros_like(both), where=used)
    return terms.sum(axis=-1), np.count_nonzero(used, axis=-1).astype(np.float64)


def significance(
    means: Means, count: npt.NDArray[np.number[Any]], alpha: float
) -> tuple[Floats, Floats]:
    """Return the means and the squares of t SE, which `not_different` compares.

    t is the two-sided quantile for 2 n - 2 degrees of freedom, as in the code of Sakai et al. 2024.
    """
    found, places = np.unique(np.maximum(count, 2), return_inverse=True)
    t = stdtrit(2.0 * found - 2, 1 - alpha / 2)[places.reshape(count.shape)]
    mean, variance = means
    return mean, t[..., np.newaxis] ** 2 * variance


def not_different(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
    """Return 1 where no statistic differs significantly, and 0 where one does or is unknown."""
    (mean, bound), (other, its) = here, there
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(((mean - other) ** 2 <= bound + its).all(axis=-1), np.float64)


_Weigh = Callable[[tuple[Floats, ...], tuple[Floats, ...]], Floats]
"""Weights (y, x) of pixels, from the fields here and the fields at an offset, each (y, x, ...)."""


@dataclass(frozen=True)
class Window:
    """The pixels around each pixel, weighted by their similarity to it.

    Attributes
    ----------
    weigh
        Weights of pairs; the pixel itself counts with weight 1.
    fields
        What `weigh` compares, each of shape (y, x, ...).
    radius
        Pixels up to this far in y and in x belong to the window.
    reach
        Number of rows around a pair on which its weight depends.
    """

    weigh: _Weigh
    fields: tuple[Floats, ...]
    radius: int
    reach: int = 0

    def sums(self, values: Floats, squares: Floats | None = None) -> tuple[Floats, Floats]:
        """Sum over the window, each pixel with its weight.

        Parameters
        ----------
        values, squares
            Summands, shape (y, x, value): values are multiplied by the weights, squares (such as
            variances of the values) by the squared weights.

        Returns
        -------
        tuple of ndarray
            Both sums, shape (y, x, value), over the part of the window inside the image.
        """
        squares = values[..., :0] if squares is None else squares
        height, width = values.shape[:2]
        sums, squared = np.empty_like(values), np.empty_like(squares)
        halo = self.radius + self.reach
        for rows in spans(height, max(halo, _PIXELS // max(width, 1), 1)):
            # Strips with enough rows around them give the same result as the whole image.
            strip = slice(max(rows.start - halo, 0), rows.stop + halo)
            own, own_squares = values[strip], squares[strip]
            compared = [field[strip] for field in self.fields]
            total, total_squares = own.copy(), own_squares.copy()
            for pair in pairs(len(own), width, self.radius):
                here, there = (tuple(field[place] for field in compared) for place in pair)
                weight = self.weigh(here, there)[..., np.newaxis]
                if not weight.any():
                    continue
                for target, source in (pair, pair[::-1]):
                    total[target] += weight * own[source]
                    total_squares[target] += weight**2 * own_squares[source]
            inner = slice(rows.start - strip.start, rows.stop - strip.start)
            sums[rows], squared[rows] = total[inner], total_squares[inner]
        return sums, squared

    def average(
        self, values: Floats, weight: npt.NDArray[Any], variance: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Average over the window, each pixel with its own weight times the weight of the pair.

        Parameters
        ----------
        values, variance
            Values, shape (y, x, value), and their squared errors.
        weight
            Weight of each pixel, shape (y, x, 1), or of each value.

        Returns
        -------
        tuple of ndarray
            Averages, NaN where nothing has weight, and their squared errors.
        """
        known = (weight > 0) & np.isfinite(values).all(axis=-1, keepdims=True)
        parts = np.where(known, values * weight, 0), np.where(known, weight, 0)
        sums, squared = self.sums(np.concatenate(parts, axis=-1, dtype=np.float64), variance)
        total, weights = np.split(sums, [values.shape[-1]], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return total / weights, squared / weights[..., : squared.shape[-1]] ** 2


def pairs(
    height: int, width: int, radius: int
) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Yield the slices of both pixels of all pairs, for each offset in one half of the window."""
    most = min(radius, width - 1)
    for dy in range(min(radius, height - 1) + 1):
        for dx in range(-most if dy else 1, most + 1):
            left = slice(max(-dx, 0), width - max(dx, 0))
            right = slice(max(dx, 0), width + min(dx, 0))
            yield (slice(0, height - dy), left), (slice(dy, height), right)


def window_sum(
    values: Floats, radius: int, *, mode: Literal["constant", "edge"] = "constant"
) -> Floats:
    """Add up (..., y, x) over windows of (2 radius + 1)^2 pixels.

    The image ends at its border; with the mode "edge", the border repeats.
    """
    if radius == 0:
        return values
    height, width = values.shape[-2:]
    padded = np.pad(
        values, (*((0, 0),) * (values.ndim - 2), (radius, radius), (radius, radius)), mode
    )
    steps = range(1, 2 * radius + 1)
    rows = sum((padded[..., k : k + height, :] for k in steps), padded[..., :height, :])
    return np.asarray(sum((rows[..., k : k + width] for k in steps), rows[..., :width]))
