"""Positive part: the samples that a distribution of radiance is fitted to, and what is left out.

Nulls are a point mass at 0, bad samples are not numbers, and negative ones have no logarithm.
Everything about the shape of a CHD (fits, tests, modes, tails) looks at the other samples. Build a
`PositivePart` once and share it: its sorted samples, its sums and its statistics are computed on
first use and kept.

A `PositiveHistogram` answers the same questions, at a cost and in a memory that do not depend on
spp. A streamed render can thus be fitted without its samples. It does not know three things:

- where a sample lies within its bin: a distribution narrower than a bin (0.1 decades by default) is
  constant;
- samples outside the support: those above it count as the last bin; those below it cannot be told
  from zeros of one channel, and count as zeros;
- the order of the samples.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import (
    Counts,
    Floats,
    Image,
    Mask,
    as_samples,
    chunks,
    first_of,
    is_bad,
    is_null,
    luminance,
    take_rows,
)
from chdstat._core.statistic import Statistic
from chdstat.errors import InputError, Reason

CONSTANT_SPREAD = 1e-6
"""Standard deviation of log x at or below which samples count as equal: 8 float32 spacings."""

_SMALLEST = 5e-324
"""The smallest positive number in double precision."""


@dataclass(frozen=True)
class LogStatistics:
    """Sums that gamma and log-normal fits share, each with the batch's shape.

    Attributes
    ----------
    n
        Positive samples.
    mean
        Their mean.
    gap
        log(mean) - mean(log x) >= 0: with the mean, sufficient for a gamma distribution.
    log_variance
        Variance of log x, with divisor n.
    """

    n: Counts
    mean: Floats
    gap: Floats
    log_variance: Floats

    @property
    def log_mean(self) -> Floats:
        """Mean of log x."""
        return np.asarray(np.log(self.mean) - self.gap)

    @property
    def constant(self) -> Mask:
        """Where the positive samples are equal, or too nearly equal for double precision."""
        return np.asarray((self.n > 0) & (self.log_variance <= CONSTANT_SPREAD**2))


class _Rows:
    """Rows of samples, split by their use in a fit to the positive ones."""

    n: Counts
    n_null: Counts
    n_zero: Counts
    n_negative: Counts
    n_bad: Counts

    @cached_property
    def found(self) -> dict[Statistic[Any], Any]:
        """The statistics that were measured for these rows."""
        return {}

    def rows(self, rows: int | slice) -> Self:
        """Return some rows of each pixel, -1 for luminance, with the statistics of all rows."""
        return take_rows(self, rows, axis=self.n.ndim - 1)

    @property
    def log_statistics(self) -> LogStatistics:
        """Mean, log-mean and log-variance of the positive samples."""
        raise NotImplementedError

    @property
    def n_good(self) -> Counts:
        """Good samples, including null and negative ones."""
        return np.asarray(self.n + self.n_null + self.n_zero + self.n_negative)

    def reason(self, minimum: int = 2) -> npt.NDArray[np.int8]:
        """Return `Reason` codes of rows without a usable positive part, shape (...).

        A channel that is 0 in every good sample counts as null, whatever the other channels are.
        """
        positive = self.log_statistics
        return first_of(
            {
                Reason.ALL_BAD: self.n_good == 0,
                Reason.NONE_POSITIVE: (positive.n == 0) & (self.n_negative > 0),
                Reason.ALL_NULL: positive.n == 0,
                Reason.TOO_FEW: positive.n < minimum,
                Reason.CONSTANT: positive.constant,
            }
        )


@dataclass(frozen=True)
class PositivePart(_Rows):
    """Samples with the mask of those that are good, not null and larger than 0.

    Attributes
    ----------
    x
        All samples, shape (..., sample); bad ones are NaN or infinite.
    positive
        Which samples are positive, same shape.
    n, n_null, n_zero, n_negative, n_bad
        Numbers of samples, shape (...): positive; null; zero in one channel of a sample that is not
        null; negative; bad. They add up to the number of samples.
    places
        Where in its pixel each sample fell, across and down from 0 to 1, each of the shape of `x`;
        None if unknown.
    """

    x: npt.NDArray[np.floating[Any]]
    positive: Mask
    n: Counts
    n_null: Counts
    n_zero: Counts
    n_negative: Counts
    n_bad: Counts
    places: tuple[Image, Image] | None = field(default=None, kw_only=True)

    @classmethod
    def of(
        cls,
        x: npt.ArrayLike,
        *,
        null: npt.ArrayLike | None = None,
        bad: npt.ArrayLike | None = None,
    ) -> PositivePart:
        """Split samples, shape (..., sample).

        `null` and `bad`, broadcastable to `x`, mark whole samples. Without them, every exact 0 is
        null, and every NaN or infinite number is bad.
        """
        x = as_samples(x)
        if bad is not None and np.any(bad):
            x = np.where(sample_mask(bad, x.shape), x.dtype.type(np.nan), x)
        bad = is_bad(x)
        good = ~bad
        zero = (x == 0) & good
        null = zero if null is None else sample_mask(null, x.shape) & good
        positive = (x > 0) & good & ~null
        n, n_null, n_bad = (_count(mask) for mask in (positive, null, bad))
        # Most samples have none, and another mask costs time; NaN is not at least 0.
        some = x.size > 0 and not x.min() >= 0
        n_negative = _count((x < 0) & good & ~null) if some else np.zeros_like(n)
        n_zero = np.asarray(x.shape[-1] - n - n_null - n_negative - n_bad, dtype=np.int64)
        return cls(x, positive, n, n_null, n_zero, n_negative, n_bad)

    @classmethod
    def of_pixels(
        cls,
        block: npt.NDArray[np.floating[Any]],
        *,
        rows: Literal["channels", "luminance", "both"] = "channels",
        places: Image | None = None,
    ) -> PositivePart:
        """Split samples by whole samples, shape (..., channel, sample).

        A sample is null if all its channels are 0, and bad if any is bad. The rows of the part are
        the channels; or only the luminance, shape (..., sample); or both, with luminance last. A
        single channel is its own luminance. `places` says where samples fell, (..., 2, sample).

        Raises
        ------
        InputError
            If luminance is asked for with neither 1 nor 3 channels.
        """
        null, bad = is_null(block), np.asarray(is_bad(block).any(axis=-2))
        if rows == "luminance":
            part = cls.of(_luminance(block), null=null, bad=bad)
        else:
            x = block
            if rows == "both" and block.shape[-2] > 1:
                x = np.concatenate([block, _luminance(block)[..., np.newaxis, :]], axis=-2)
            part = cls.of(x, null=null[..., np.newaxis, :], bad=bad[..., np.newaxis, :])
        if places is None:
            return part
        of_rows = places if rows == "luminance" else places[..., np.newaxis, :, :]
        across, down = (np.broadcast_to(of_rows[..., i, :], part.x.shape) for i in (0, 1))
        return replace(part, places=(across, down))

    @cached_property
    def log_statistics(self) -> LogStatistics:
        """Mean, log-mean and log-variance of the positive samples."""
        samples = self.x.shape[-1]
        rows, masks = self.x.reshape(-1, samples), self.positive.reshape(-1, samples)
        sums = np.empty((3, len(rows)))
        for part in chunks(len(rows), samples):
            sums[:, part] = _log_sums(rows[part], masks[part])
        mean, gap, log_variance = sums.reshape(3, *self.n.shape)
        return LogStatistics(n=self.n, mean=mean, gap=gap, log_variance=log_variance)

    @cached_property
    def sorted(self) -> npt.NDArray[np.floating[Any]]:
        """Positive samples in ascending order, shape of `x`, padded with infinity."""
        ascending = np.where(self.positive, self.x, self.x.dtype.type(np.inf))
        ascending.sort(axis=-1)
        return ascending

    @cached_property
    def log_sorted(self) -> Floats:
        """Natural logarithm of `sorted`, always float64, padded with infinity.

        It takes twice the memory of float32 samples, once for all users.
        """
        return np.asarray(np.log(self.sorted, dtype=np.float64))

    @property
    def largest(self) -> Floats:
        """The largest positive sample, infinite if there is none; shape (...)."""
        last = np.maximum(self.n - 1, 0)[..., np.newaxis]
        return np.take_along_axis(self.sorted, last, axis=-1)[..., 0].astype(np.float64)

    @property
    def largest_share(self) -> Floats:
        """Share of the sum of the positive samples in the largest one; NaN if there is none."""
        with np.errstate(invalid="ignore"):
            share = self.largest / self.log_statistics.mean / self.n
        return np.where(self.n > 0, share, np.nan)

    @property
    def valid(self) -> Mask:
        """Which entries of `sorted` are samples: the first `n` of each row."""
        return np.asarray(np.arange(self.x.shape[-1]) < self.n[..., np.newaxis])


@dataclass(frozen=True)
class PositiveHistogram(_Rows):
    """Counts of positive samples in bins that divide log radiance evenly.

    Attributes
    ----------
    counts
        Samples per bin, shape (..., bin).
    log_centers
        Natural logarithm of radiance at the centre of each bin, shape (..., bin) or (1, ..., bin).
    width
        Width of a bin in natural logarithm, shape (...) or (1, ...).
    n, n_null, n_zero, n_negative, n_bad
        Numbers of samples, shape (...): in the bins; null; too dark for the bins, or 0 only in this
        channel; negative; bad.
    n_above
        Those in the last bin that are too bright for it, shape (...).
    """

    counts: Floats
    log_centers: Floats
    width: Floats
    n: Counts
    n_null: Counts
    n_zero: Counts
    n_negative: Counts
    n_bad: Counts
    n_above: Counts

    def reason(self, minimum: int = 2) -> npt.NDArray[np.int8]:
        """Say which rows have no usable positive part, as `Reason` codes, shape (...).

        What is too dark for the bins may as well be 0, but where none or the first of them is used.
        """
        dark = (self.n_zero > self.n) & ((self.counts[..., 0] > 0) | (self.n == 0))
        outside = dark | (2 * self.n_above > self.n)
        return np.where(outside, np.int8(Reason.OUTSIDE), super().reason(minimum))

    @cached_property
    def log_statistics(self) -> LogStatistics:
        """Mean, log-mean and log-variance of the positive samples, corrected for the bins.

        Moving samples to the centres of bins of width h adds h^2 / 12 to the variance, and
        multiplies the moment generating function at t by (2 / (h t)) sinh(h t / 2). That holds for
        densities that are smooth at the scale of a bin: Sheppard, "On the calculation of the most
        probable values of frequency-constants", 1898, doi:10.1112/plms/s1-29.1.353. Both are
        undone.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            log_mean = np.vecdot(self.counts, self.log_centers) / self.n
            centered = self.log_centers - log_mean[..., np.newaxis]
            log_variance = np.vecdot(self.counts, centered**2) / self.n - self.width**2 / 12
            ratio = np.vecdot(self.counts, np.exp(centered)) / self.n
            ratio *= (self.width / 2) / np.sinh(self.width / 2)
            # A distribution within one bin: the correction exceeds the variance.
            variance = np.where(log_variance > 0, log_variance, np.where(self.n > 0, 0, np.nan))
            gap = np.where(variance > 0, np.log(ratio), np.where(self.n > 0, 0, np.nan))
            mean = np.exp(log_mean + gap)
        return LogStatistics(n=self.n, mean=mean, gap=gap, log_variance=variance)


Part: TypeAlias = PositivePart | PositiveHistogram
"""Positive samples, as they are or in bins."""


def _luminance(block: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
    with np.errstate(invalid="ignore", over="ignore"):
        return luminance(block)


def sample_mask(mask: npt.ArrayLike, shape: tuple[int, ...]) -> Mask:
    """Return a mask of samples in their shape, or raise InputError."""
    try:
        return np.broadcast_to(np.asarray(mask, dtype=bool), shape)
    except ValueError:
        message = f"a mask of samples must be broadcastable to {shape}, got shape {np.shape(mask)}"
        raise InputError(message) from None


def _count(mask: Mask) -> Counts:
    return np.asarray(np.count_nonzero(mask, axis=-1), dtype=np.int64)


def _log_sums(rows: npt.NDArray[Any], positive: Mask) -> tuple[Floats, Floats, Floats]:
    n = np.count_nonzero(positive, axis=-1)
    left_out = ~positive
    ratio = rows.astype(np.float64)
    if np.count_nonzero(ratio) > n.sum():
        np.copyto(ratio, 0, where=left_out)
    # Left-out samples are 0 by now, become the ratio 1, and have the logarithm 0: arithmetic with
    # masks takes a quarter of the time of assignments through them.
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        mean = ratio.sum(axis=-1) / n
        # Ratios to the mean have small, hence exact, logarithms if samples are nearly equal.
        ratio /= np.where(n > 0, mean, 1)[:, np.newaxis]
        if rows.dtype == np.float64:
            # The ratio of 1e-300 to 1e30 underflows, and its logarithm is infinite.
            np.maximum(ratio, _SMALLEST, out=ratio)
        ratio += left_out
        log = np.log(ratio, out=ratio)
        gap = -log.sum(axis=-1) / n
        log += gap[:, np.newaxis]
        log *= positive
        log_variance = np.vecdot(log, log) / n
    return mean, gap, log_variance
