"""Moments of samples in constant memory, and means of consecutive batches of them.

Use `Moments.of` on samples, and `Moments.merge` to join parts without loss. Use `PixelMoments` on
the samples of an image that come in blocks; it also counts the bad ones. Batch means show how the
mean drifts over consecutive samples. Batches double in size when there would be too many of them.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, chunks
from chdstat.errors import InputError

COUNTS = ("null_count", "bad_count", "nan_count", "inf_count", "negative_count")
"""Names of the counts of samples that `PixelMoments` keeps."""

_LONG = 256


@dataclass(frozen=True)
class Moments:
    """Count, mean, sums of powers of deviations and extremes, each with the batch's shape.

    ``m2``, ``m3`` and ``m4`` are sum((x - mean)^k); without samples, the mean is stored as 0.
    """

    count: Floats
    mean: Floats
    m2: Floats
    m3: Floats
    m4: Floats
    minimum: Floats
    maximum: Floats

    @classmethod
    def of(
        cls, x: npt.NDArray[np.floating[Any]], good: npt.NDArray[np.bool_] | None = None
    ) -> Moments:
        """Return the moments of samples, shape (..., sample), in two passes and double precision.

        `good`, broadcastable to `x`, marks the samples that count; None counts all.
        """
        n = x.shape[-1]
        rows = x.reshape(-1, n)
        masks = None if good is None else np.broadcast_to(good, x.shape).reshape(-1, n)
        fields = np.empty((7, len(rows)))
        for part in chunks(len(rows), n):
            fields[:, part] = _fields(rows[part], None if masks is None else masks[part])
        return cls(*fields.reshape(7, *x.shape[:-1]))

    def merge(self, other: Moments) -> Moments:
        """Return the moments of both sets of samples together (Pebay 2008, SAND2008-6212)."""
        a, b = self, other
        n = np.maximum(a.count + b.count, 1)
        p, q = a.count / n, b.count / n
        d = np.where((a.count > 0) & (b.count > 0), b.mean - a.mean, 0)
        with np.errstate(over="ignore", invalid="ignore"):
            between = n * p * q * d**2
            m2 = a.m2 + b.m2 + between
            m3 = a.m3 + b.m3 + between * d * (p - q) + 3 * d * (p * b.m2 - q * a.m2)
            m4 = (
                (a.m4 + b.m4)
                + between * d**2 * (p**2 - p * q + q**2)
                + 6 * d**2 * (p**2 * b.m2 + q**2 * a.m2)
                + 4 * d * (p * b.m3 - q * a.m3)
            )
        return Moments(
            a.count + b.count,
            np.where(a.count > 0, a.mean + q * d, b.mean),
            m2,
            m3,
            m4,
            np.minimum(a.minimum, b.minimum),
            np.maximum(a.maximum, b.maximum),
        )

    @property
    def variance(self) -> Floats:
        """Unbiased variance, exactly 0 for equal samples; NaN below two samples."""
        spread = np.where(self._constant, 0, self.m2)
        return _divide(spread, self.count - 1, where=self.count > 1)

    @property
    def standard_error(self) -> Floats:
        """Standard error of the mean."""
        return _divide(np.sqrt(self.variance), np.sqrt(self.count), where=self.count > 1)

    @property
    def skewness(self) -> Floats:
        """Skewness sqrt(n) m3 / m2^(3/2); NaN for equal samples."""
        return _divide(np.sqrt(self.count) * self.m3, self.m2**1.5, where=~self._constant)

    @property
    def kurtosis(self) -> Floats:
        """Excess kurtosis n m4 / m2^2 - 3; NaN for equal samples."""
        return _divide(self.count * self.m4, self.m2**2, where=~self._constant) - 3

    def seen(self, values: Floats) -> Floats:
        """Return `values` where there are samples, NaN elsewhere."""
        return np.where(self.count > 0, values, np.nan)

    @property
    def _constant(self) -> npt.NDArray[np.bool_]:
        # Rounding of the mean leaves a tiny m2 even if all samples are equal.
        return np.asarray(self.minimum >= self.maximum)


def _fields(rows: npt.NDArray[Any], good: npt.NDArray[np.bool_] | None) -> tuple[Any, ...]:
    count = np.full(len(rows), float(rows.shape[-1]))
    # NumPy compares along short rows one by one, but across columns many at once.
    minima = maxima = rows if rows.shape[-1] >= _LONG else np.asfortranarray(rows)
    if good is not None:
        count = np.count_nonzero(good, axis=-1).astype(np.float64)
        minima, maxima = np.where(good, rows, np.inf), np.where(good, rows, -np.inf)
        rows = np.where(good, rows, 0)
    deviation = rows.astype(np.float64)
    mean = deviation.sum(axis=-1) / np.maximum(count, 1)
    deviation -= mean[:, np.newaxis]
    if good is not None:
        deviation *= good
    with np.errstate(over="ignore"):
        square = deviation * deviation
        m2 = square.sum(axis=-1)
        m3, m4 = np.vecdot(deviation, square), np.vecdot(square, square)
    return count, mean, m2, m3, m4, minima.min(axis=-1), maxima.max(axis=-1)


def _divide(a: Floats, b: Floats, *, where: npt.NDArray[np.bool_]) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(where, np.divide(a, b), np.nan)


class PixelMoments:
    """Counts and moments of each pixel's samples, which come in blocks: update, merge, read.

    Attributes
    ----------
    moments
        Moments of the good samples, shape (..., channel); None before the first block.
    counts
        Numbers of samples by name, each of shape (...): null; bad; with a NaN channel; with an
        infinite channel; good with a negative channel.
    """

    def __init__(self) -> None:
        self.moments: Moments | None = None
        self.counts: dict[str, Counts] = {}

    def update(self, x: npt.NDArray[Any], null: Mask, bad: Mask | None) -> None:
        """Add the next samples, shape (..., channel, sample).

        `null` and `bad` mark whole samples, shape (..., 1, sample); None if none is bad.
        """

        def count(mask: Mask) -> Counts:
            return np.asarray(np.count_nonzero(mask.any(axis=-2), axis=-1), dtype=np.int64)

        counts = dict.fromkeys(COUNTS, np.zeros(x.shape[:-2], dtype=np.int64))
        counts["null_count"] = count(null)
        if bad is not None:
            counts["bad_count"] = count(bad)
            counts["nan_count"] = count(np.isnan(x))
            counts["inf_count"] = count(np.isinf(x))
        if not x.min(initial=0) >= 0:
            counts["negative_count"] = count(x < 0 if bad is None else (x < 0) & ~bad)
        self._add(Moments.of(x, None if bad is None else ~bad), counts)

    def merge(self, other: PixelMoments) -> None:
        """Add the samples of `other`."""
        if other.moments is not None:
            self._add(other.moments, other.counts)

    def _add(self, moments: Moments, counts: dict[str, Counts]) -> None:
        if self.moments is not None:
            moments = self.moments.merge(moments)
            counts = {name: self.counts[name] + counts[name] for name in COUNTS}
        self.moments, self.counts = moments, counts


class Batches:
    """Sums of samples over consecutive batches of `size` draws, at most `limit` of them.

    The slot after the last complete batch is open for the next samples. When the draws outgrow the
    slots, neighbours merge pairwise and `size` doubles.
    """

    def __init__(self, shape: tuple[int, ...], *, size: int, limit: int) -> None:
        if size < 1 or limit < 2 or limit % 2:
            message = (
                "batch means need batch_size >= 1 and an even max_batches >= 2, "
                f"got batch_size={size} and max_batches={limit}"
            )
            raise InputError(message)
        self._options = (size, limit)
        self.size = size
        self.draws: npt.NDArray[np.int64] = np.zeros(limit, dtype=np.int64)
        """Draws per slot, good or not: `size` in a complete one, or more after a merge."""
        self._sums = np.zeros((*shape, limit))
        self._counts = np.zeros((*shape, limit), dtype=np.int64)

    def update(
        self, x: npt.NDArray[np.floating[Any]], good: npt.NDArray[np.bool_] | None = None
    ) -> None:
        """Add the next samples, shape (..., sample); `good` marks those that count."""
        n = x.shape[-1]
        while self.total + n > self.size * len(self.draws):
            self._double()
        complete = self._complete
        first = self.size - self.draws[complete]
        starts = np.concatenate([[0], np.arange(first, n, self.size)]).astype(np.intp)
        lengths = np.diff(starts, append=n)
        slots = slice(complete, complete + len(starts))
        if good is not None:
            x = np.where(good, x, 0)
            good = np.broadcast_to(good, x.shape)
            lengths_good = np.add.reduceat(good, starts, axis=-1, dtype=np.int64)
        self.draws[slots] += lengths
        self._counts[..., slots] += lengths if good is None else lengths_good
        self._sums[..., slots] += np.add.reduceat(x, starts, axis=-1, dtype=np.float64)

    def check(self, other: Batches) -> None:
        """Raise InputError unless `other` began with the same size and limit."""
        if self._options != other._options:
            message = (
                "summaries merge only with the same batch_size and max_batches, "
                f"got {self._options} and {other._options}"
            )
            raise InputError(message)

    def merge(self, other: Batches) -> None:
        """Append the batches of `other`; the two open batches become one."""
        self.check(other)
        other = copy.deepcopy(other)
        while self.size != other.size:
            (self if self.size < other.size else other)._double()
        while self.total + other.total > self.size * len(self.draws):
            self._double()
            other._double()
        self._append(other)

    def read(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Return the batch means, shape (..., batch), and the draws of each batch, shape (batch,).

        An incomplete batch is left out, unless it is the only one.
        """
        used = slice(max(self._complete, 1))
        sums, counts = self._sums[..., used], self._counts[..., used]
        means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
        return means, self.draws[used].copy()

    def empty(self, shape: tuple[int, ...]) -> Batches:
        """Return empty batches with the same options, for another shape."""
        size, limit = self._options
        return Batches(shape, size=size, limit=limit)

    @property
    def total(self) -> int:
        """Draws so far, good or not."""
        return int(self.draws.sum())

    @property
    def _complete(self) -> int:
        return int(np.count_nonzero(self.draws >= self.size))

    def _double(self) -> None:
        self.size *= 2
        for array in self._arrays:
            half = array.shape[-1] // 2
            array[..., :half] = array[..., ::2] + array[..., 1::2]
            array[..., half:] = 0

    def _append(self, other: Batches) -> None:
        # All fit: a complete batch holds at least `size` draws, and the draws fit the slots.
        mine, theirs = self._complete, other._complete
        both = mine + theirs
        for ours, others in zip(self._arrays, other._arrays, strict=True):
            tail = ours[..., mine:].sum(axis=-1) + others[..., theirs:].sum(axis=-1)
            ours[..., mine:both] = others[..., :theirs]
            ours[..., both:] = 0
            if both < ours.shape[-1]:
                ours[..., both] = tail

    @property
    def _arrays(self) -> tuple[npt.NDArray[Any], ...]:
        return self.draws, self._counts, self._sums
