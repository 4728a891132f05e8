"""Similarity: statistics that tell whether the samples of two pixels come from one distribution.

Means of transformed samples with their standard errors, as Welch's test compares them, and the
histograms that a chi-square distance compares. Only samples that are good in all channels count;
where there are too few, errors are NaN and histograms empty. Topics are distributions that many
histograms are mixtures of, found from the histograms alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from chdstat._core.arrays import all_good, is_bad, spans
from chdstat._core.image_scales import exposure_unit
from chdstat.estimators.order import mean_of_good
from chdstat.estimators.rows import Floats

__all__ = [
    "BINS",
    "Means",
    "ScaledSamples",
    "chi_square",
    "corrected_means",
    "histograms",
    "not_different",
    "root",
    "shape_means",
    "significance",
    "topic_histograms",
    "without_largest",
]

BINS = 20
"""Bins of a histogram (BCD)."""

_GAMMA = 2.2
_HIGHEST = 2.5
"""Radiance, after the gamma, at which the last but one bin begins (BCD)."""
_SATURATION = 2.0
"""Multiple of that from which all counts in the last bin (BCD)."""
_CHUNK = 2**16
"""Samples transformed at once."""

Transform = Callable[[Floats], Floats]
"""From samples (pixel, channel, sample) to values (pixel, statistic, sample)."""


@dataclass(frozen=True)
class Means:
    """Means of transformed samples.

    Attributes
    ----------
    value
        Shape (y, x, statistic).
    variance
        Squared standard error of `value`, same shape; NaN of less than 2 samples.
    """

    value: Floats
    variance: Floats


@dataclass(frozen=True)
class ScaledSamples:
    """Samples of an image, and the unit that brings its exposure near 1.

    Attributes
    ----------
    samples
        Shape (y, x, channel, sample); 0 where they are bad.
    good
        Marks samples of which all channels are good, shape (y, x, sample); None where all are.
    count
        Number of these, shape (y, x).
    unit
        A power of two, which changes no digit.
    """

    samples: npt.NDArray[np.floating[Any]]
    good: npt.NDArray[np.bool_] | None
    count: npt.NDArray[np.int64]
    unit: float

    @classmethod
    def of(cls, x: npt.NDArray[np.floating[Any]]) -> ScaledSamples:
        """Tell good and bad samples (y, x, channel, sample) apart."""
        good, kept = None, x
        if not all_good(x):
            good = ~np.asarray(is_bad(x).any(axis=-2))
            kept = np.where(good[..., np.newaxis, :], x, 0)
        count = np.full(x.shape[:2], x.shape[-1], np.int64)
        if good is not None:
            count = np.count_nonzero(good, axis=-1)
        _, exponent = np.frexp(exposure_unit(mean_of_good(kept).mean(axis=-1)))
        return cls(kept, good, count, float(np.ldexp(1.0, int(exponent) - 1)))

    def mean(self) -> Floats:
        """Return the mean of the good samples in units of `unit`, shape (y, x, channel)."""
        with np.errstate(invalid="ignore", over="ignore"):
            total = self.samples.sum(axis=-1, dtype=np.float64) / self.unit
            return np.asarray(total / self.count[..., np.newaxis])

    def mean_below_zero(self) -> Floats:
        """Return what negative samples contribute to `mean`, same shape."""
        if self.samples.min() >= 0:
            return np.zeros(self.samples.shape[:-1])
        below = np.minimum(self.samples, 0).sum(axis=-1, dtype=np.float64) / self.unit
        return np.asarray(below / np.maximum(self.count, 1)[..., np.newaxis])

    def walk(self, work: Callable[..., tuple[Floats, ...]]) -> tuple[Floats, ...]:
        """Apply ``work(rows, mask, count)`` to pixels that stay in the cache together.

        Rows have shape (pixel, channel, sample), in units of `unit`; masks (pixel, 1, sample), None
        where all is good; counts (pixel, 1).
        """
        height, width, channels, n = self.samples.shape
        rows = self.samples.reshape(-1, channels, n)
        good = None if self.good is None else self.good.reshape(-1, 1, n)
        count = self.count.reshape(-1, 1)
        found = [
            work(
                rows[part] / np.float64(self.unit),
                None if good is None else good[part],
                count[part],
            )
            for part in spans(len(rows), max(1, _CHUNK // (channels * n)))
        ]
        return tuple(
            np.concatenate(kind).reshape(height, width, *kind[0].shape[1:])
            for kind in zip(*found, strict=True)
        )


def corrected_means(image: ScaledSamples, transform: Transform) -> Means:
    """Return means of transformed samples, corrected for their skewness, and standard errors.

    ``mu + mu_3 / (6 s^2 n)``: Johnson 1978, doi:10.1080/01621459.1978.10480051, with mu_3 = M_3 / n
    and s^2 = M_2 / (n - 1), as in the code of Sakai et al. 2024.
    """

    def work(
        rows: Floats, good: npt.NDArray[np.bool_] | None, n: npt.NDArray[np.int64]
    ) -> tuple[Floats, Floats]:
        # Where radiances of one image differ by a factor of 1e100, errors may be infinite.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            y = transform(rows)
            mean = y.sum(axis=-1) / n
            deviation = y - mean[..., np.newaxis]
            if good is not None:
                deviation *= good
            square = deviation * deviation
            second, third = square.sum(axis=-1), np.vecdot(square, deviation)
            shift = third * (n - 1) / (6 * second * n**2)
            # Equal samples need no correction.
            shift = np.where((second > 0) & np.isfinite(shift), shift, 0)
            return mean + shift, second / (n * np.where(n > 1, n - 1, np.nan))

    return Means(*image.walk(work))


def root(x: Floats) -> Floats:
    """Return the root of samples; of negative ones, minus the root of their size."""
    return np.sqrt(x) if x.min() >= 0 else np.copysign(np.sqrt(np.abs(x)), x)


def shape_means(image: ScaledSamples) -> Means:
    """Return ``mean(x^(1/4)) / mean(x^(1/2))^(1/2)`` of every channel, and its standard error.

    Negative samples count as 0.

    The largest sample is left out, so that a firefly does not set a pixel apart.

    A number without a scale: 1 of equal samples, and the smaller, the more they differ or are null;
    NaN of nulls alone. Its error is that of a smooth function of two means (the delta method).
    """

    def work(rows: Floats, _: object, n: npt.NDArray[np.int64]) -> tuple[Floats, Floats]:
        kept, m = np.maximum(without_largest(rows), 0), np.maximum(n - 1, 0)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            v = np.sqrt(np.sqrt(kept))
            w = v * v
            a, b, c, d = (k.sum(axis=-1) / m for k in (v, w, v * w, kept))
            # var(v) / b - a cov(v, v^2) / b^2 + a^2 var(v^2) / (4 b^3), with a = E v and b = E v^2.
            relative = (b - a * a) / b - a * (c - a * b) / b**2 + a * a * (d - b * b) / (4 * b**3)
            return a / np.sqrt(b), np.maximum(relative, 0) / np.where(m > 1, m - 1, np.nan)

    return Means(*image.walk(work))


def without_largest(rows: Floats) -> Floats:
    """Set the largest sample of every row to 0."""
    kept = rows.copy()
    np.put_along_axis(kept, rows.argmax(axis=-1)[..., np.newaxis], 0, axis=-1)
    return kept


def histograms(image: ScaledSamples, unit: float) -> Floats:
    """Return the histograms of all channels, one after the other, shape (y, x, channel x bin).

    A sample is split between the two bins that it lies between, ``v = (x / unit)^(1/2.2) / 2.5``:
    bins 0 to 18 are even in v up to 1, and the last begins to count there; negative samples fall
    into the first. As in the code of
    Bayesian collaborative denoising, Boughida and Boubekeur 2017, doi:10.1111/cgf.13231.
    """
    channels = image.samples.shape[2]

    def work(rows: Floats, good: npt.NDArray[np.bool_] | None, _: object) -> tuple[Floats]:
        with np.errstate(over="ignore"):
            v = (np.maximum(rows, 0) * (image.unit / unit)) ** (1 / _GAMMA) / _HIGHEST
        v = np.minimum(v, _SATURATION)
        place = v * (BINS - 2)
        low = np.minimum(place.astype(np.intp), BINS - 2)
        high = np.where(v < 1, place - low, v - 1)
        counted = np.ones(rows.shape) if good is None else np.broadcast_to(good, rows.shape)
        start = BINS * np.arange(len(rows) * channels).reshape(len(rows), channels, 1)
        where = (low + start).reshape(-1)
        size = BINS * len(rows) * channels
        low_bins = np.bincount(where, (counted * (1 - high)).reshape(-1), size)
        found = low_bins + np.bincount(where + 1, (counted * high).reshape(-1), size)
        return (np.asarray(found, dtype=np.float64).reshape(len(rows), -1),)

    return image.walk(work)[0]


def significance(means: Means, count: npt.NDArray[np.int64], alpha: float) -> tuple[Floats, Floats]:
    """Return the means and the squares of t SE, by which `not_different` compares pixels.

    t is the two-sided quantile for 2 n - 2 degrees of freedom, as in the code of Sakai et al. 2024.
    """
    found, places = np.unique(np.maximum(count, 2), return_inverse=True)
    t = stdtrit(2.0 * found - 2, 1 - alpha / 2)[places.reshape(count.shape)]
    return means.value, t[..., np.newaxis] ** 2 * means.variance


def not_different(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
    """Return 1 where no statistic differs significantly, else 0; 0 where one is unknown."""
    (mean, bound), (other, its) = here, there
    with np.errstate(over="ignore", invalid="ignore"):
        alike = ((mean - other) ** 2 <= bound + its).all(axis=-1)
    return np.asarray(alike, dtype=np.float64)


def chi_square(h: Floats, n: Floats, other: Floats, m: Floats) -> tuple[Floats, Floats]:
    """Return the chi-square distance of histograms of n and m samples, and the bins used.

    ``sum (m h - n h')^2 / (n m (h + h'))``: Delbracio et al. 2014, doi:10.1145/2532708. Bins with
    no more than one sample of both are not used, as in the code of Boughida and Boubekeur 2017.
    """
    both = h + other
    used = (both > 1) & (n > 0) & (m > 0)
    apart = np.sqrt(m / np.maximum(n, 1)) * h - np.sqrt(n / np.maximum(m, 1)) * other
    terms = np.divide(apart * apart, both, out=np.zeros_like(both), where=used)
    return terms.sum(axis=-1), np.count_nonzero(used, axis=-1).astype(np.float64)


Counts = npt.NDArray[np.float32]

_ROWS_AT_ONCE = 512
"""Histograms worked on at once: they and their ratios stay in the cache."""
_POOLED = 0.2
"""Share of the pooled histogram in a first topic; without it no topic could take up a new bin."""
_LEAST = 1e-3
"""Weight of the pooled histogram among the counts of a topic: no probability becomes 0."""


def topic_histograms(
    counts: Counts, *, topics: int, iterations: int, rng: np.random.Generator
) -> Counts:
    r"""Describe every histogram as a mixture of a few topics that all of them share.

    Maximises ``sum_jb c_jb log sum_k theta_jk phi_kb`` by expectation-maximisation, from topics
    that are histograms drawn at random. What only noise tells apart becomes equal.

    Parameters
    ----------
    counts
        c, shape (row, bin), not negative; every row and the first topics drawn hold a count.
    topics
        How many; no more than there are rows.
    iterations
        Of expectation-maximisation.
    rng
        Draws the rows that are the first topics.

    Returns
    -------
    ndarray
        Probabilities theta phi, shape (row, bin); each row adds up to 1.

    References
    ----------
    T. Hofmann, "Probabilistic latent semantic indexing", SIGIR 1999, doi:10.1145/312624.312649,
    equations 3 to 6.
    """
    number = min(topics, len(counts))
    pooled = counts.mean(axis=0)
    first = counts[rng.choice(len(counts), number, replace=False)]
    phi = _normalised(first + _POOLED * pooled + _LEAST)
    theta = np.full((len(counts), number), 1 / number, np.float32)
    for _ in range(iterations):
        found = np.zeros_like(phi)
        for part in spans(len(counts), _ROWS_AT_ONCE):
            ratio = counts[part] / _positive(theta[part] @ phi)
            found += theta[part].T @ ratio
            theta[part] = _normalised(theta[part] * (ratio @ phi.T))
        phi = _normalised(phi * found + _LEAST * pooled)
    return np.asarray(theta @ phi)


def _positive(values: Counts) -> Counts:
    return np.maximum(values, np.float32(1e-20))


def _normalised(rows: npt.NDArray[Any]) -> Counts:
    return np.asarray(rows / _positive(rows.sum(axis=-1, keepdims=True)), np.float32)
