"""Binning: where the bins of a histogram lie, and the table that counts.

`chdstat.summary.histograms` is the public face of this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import all_good, as_samples, is_bad, is_null, spans
from chdstat.errors import InputError, Reason
from chdstat.samples import Samples

__all__ = [
    "FIRST_DRAWS",
    "LOG_SUPPORT",
    "SCALES",
    "Counts",
    "Floats",
    "GivenSupport",
    "Mask",
    "Scale",
    "Support",
    "Table",
    "axis_ends",
    "checked_support",
    "linear_support",
    "sample_masks",
    "tile_support",
]

Scale: TypeAlias = Literal["linear", "log"]
Floats: TypeAlias = npt.NDArray[np.float64]
Counts: TypeAlias = npt.NDArray[np.int64]
Mask: TypeAlias = npt.NDArray[np.bool_]

SCALES: tuple[Scale, ...] = ("linear", "log")
FIRST_DRAWS = 50
"""Draws whose span sets the linear support."""
LOG_SUPPORT = (1e-5, 1e5)
"""Support of log histograms, in radiance."""

_PADDING = 0.25
_CHUNK = 2**16
"""Samples binned at once: the temporaries stay in the cache."""


@dataclass(frozen=True)
class Support:
    """Where the bins are: [low, high) in radiance, each of the batch's shape.

    A pixel whose samples set no support has NaN there and says why in `reason`.
    """

    low: Floats
    high: Floats
    reason: npt.NDArray[np.int8]


GivenSupport: TypeAlias = Support | tuple[npt.ArrayLike, npt.ArrayLike]


def linear_support(
    x: npt.ArrayLike, *, null: Mask | None = None, bad: Mask | None = None
) -> Support:
    """Return the linear support that the first 50 draws set.

    It is the interval that their good, non-null samples span, padded by 25 % of its length at both
    ends. One value v, or values too near to each other for bins that floating point distinguishes,
    give [0.75 v, 1.25 v]; where there is no sample to go by, or v = 0, there is no support.

    Parameters
    ----------
    x
        Radiance, shape (..., sample).
    null, bad
        As for `histogram`.

    Examples
    --------
    >>> support = linear_support([[1.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    >>> support.low, support.high
    (array([0.5, nan]), array([3.5, nan]))
    >>> Reason(support.reason[1]).name
    'ALL_NULL'

    References
    ----------
    Elek, Thomas, Forbes 2019, section on the instrumentation.
    """
    first = as_samples(x)[..., :FIRST_DRAWS]
    null, bad = (part if part is None else part[..., :FIRST_DRAWS] for part in (null, bad))
    null, bad = _masks(first, null, bad)
    if bad is None:
        bad = np.zeros(first.shape, dtype=np.bool_)
    used = ~(null | bad)
    empty = ~used.any(axis=-1)
    low = np.where(used, first, np.inf).min(axis=-1).astype(np.float64)
    high = np.where(used, first, -np.inf).max(axis=-1).astype(np.float64)
    low, high = np.where(empty, 0, low), np.where(empty, 0, high)
    # A span of fewer than 128 floats would only show how floats are spaced.
    size = np.maximum(np.abs(low), np.abs(high))
    point = high - low <= 128 * np.finfo(first.dtype).eps * size
    padding = _PADDING * np.where(point, size, high - low)
    nothing = empty | (size == 0)
    reason = np.select(
        [~empty & nothing, empty & bad.all(axis=-1), empty],
        [Reason.CONSTANT, Reason.ALL_BAD, Reason.ALL_NULL],
        Reason.OK,
    )
    return Support(
        np.where(nothing, np.nan, low - padding),
        np.where(nothing, np.nan, high + padding),
        reason.astype(np.int8),
    )


def tile_support(samples: Samples, ys: slice, xs: slice) -> Support:
    """Return the linear support of a tile, whatever the batches in which it is stored."""
    first = samples.read(ys, xs, slice(FIRST_DRAWS))
    null, bad = sample_masks(first)
    return linear_support(first, null=null, bad=bad)


def checked_support(support: GivenSupport, shape: tuple[int, ...], scale: Scale) -> Support:
    """Return a support of the batch shape, or raise InputError if it cannot hold bins."""
    if not isinstance(support, Support):
        start, stop = (np.asarray(end, dtype=np.float64) for end in support)
        support = Support(start, stop, np.array(Reason.OK, dtype=np.int8))
    try:
        low = np.broadcast_to(support.low, shape)
        high = np.broadcast_to(support.high, shape)
        reason = np.broadcast_to(support.reason, shape)
    except ValueError as error:
        message = (
            f"the support must fit the batch shape {shape}, "
            f"got low and high of shapes {support.low.shape} and {support.high.shape}"
        )
        raise InputError(message) from error
    positive = (low > 0) | (scale == "linear")
    if not ((positive & np.isfinite(low) & np.isfinite(high) & (low < high)) | (reason > 0)).all():
        message = (
            f"the support of a {scale} histogram must be finite with "
            f"{'0 < ' if scale == 'log' else ''}low < high, got low={low} and high={high}"
        )
        raise InputError(message)
    return Support(low.copy(), high.copy(), reason.copy())


def axis_ends(scale: Scale, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the support in the coordinate that the bins divide evenly."""
    return (np.log(low), np.log(high)) if scale == "log" else (low, high)


def sample_masks(block: npt.NDArray[Any]) -> tuple[Mask, Mask | None]:
    """Return which whole samples are null and bad, shape (..., 1, sample); None for none bad."""
    null = is_null(block)[..., np.newaxis, :]
    if all_good(block):
        return null, None
    return null, np.asarray(is_bad(block).any(axis=-2, keepdims=True))


class Table:
    """Counts of every row (pixel and channel) in slots: underflow, bins, overflow, bad."""

    def __init__(self, scale: Scale, bins: int, support: Support) -> None:
        self.scale = scale
        self.bins = bins
        self.support = support
        self.n = 0
        rows = support.low.size
        self._counts = np.zeros((rows, bins + 3), dtype=np.int64)
        self.null_count = np.zeros(support.low.shape, dtype=np.int64)
        self.negative = np.zeros(support.low.shape, dtype=np.int64)
        low, high = axis_ends(scale, support.low.reshape(-1, 1), support.high.reshape(-1, 1))
        # Without a support, every sample lies above it, but for the zeros of a log scale.
        self._origin = np.where(np.isnan(low), -np.inf if scale == "linear" else -1e30, low)
        with np.errstate(divide="ignore"):
            self._steps = np.where(np.isnan(low), np.inf, bins / (high - low))

    def update(self, block: npt.NDArray[Any], null: Mask | None, bad: Mask | None) -> None:
        """Count a block, shape (..., sample)."""
        shape, n = block.shape[:-1], block.shape[-1]
        if shape != self.support.low.shape:
            message = (
                f"every block must have the batch shape of the support, {self.support.low.shape}, "
                f"before its samples; got {shape}"
            )
            raise InputError(message)
        null, bad = _masks(block, null, bad)
        # Nulls are zeros and all fall where a zero falls: count them in and take them out again,
        # which is many times faster than sorting them out one by one.
        nulls = np.broadcast_to(np.count_nonzero(null, axis=-1), shape)
        rows = block.reshape(-1, n)
        bads = None if bad is None else bad.reshape(-1, n)
        for part in spans(len(rows), max(1, _CHUNK // n)):
            for columns in spans(n, _CHUNK):
                some = None if bads is None else bads[part, columns]
                slots = self._slots(rows[part, columns], part, some)
                slots += np.arange(part.start, part.stop)[:, np.newaxis] * self._counts.shape[1]
                np.add.at(self._counts.reshape(-1), slots.ravel(), 1)
        zeros = np.zeros((len(rows), 1), block.dtype)
        self._counts[np.arange(len(rows)), self._slots(zeros, slice(None))[:, 0]] -= nulls.ravel()
        self.null_count += nulls
        if not block.min(initial=0) >= 0:
            negative = block < 0 if bad is None else (block < 0) & ~bad
            self.negative += np.count_nonzero(negative, axis=-1)
        self.n += n

    def merge(self, other: Table) -> None:
        """Add the counts of a table with the same support."""
        mine, theirs = self.support, other.support
        if not all(
            np.array_equal(a, b, equal_nan=True)
            for a, b in ((mine.low, theirs.low), (mine.high, theirs.high))
        ):
            message = (
                "histograms merge only with the same support, and these differ; "
                "give both the support of the first draws (linear_support)"
            )
            raise InputError(message)
        self._counts += other._counts
        self.null_count += other.null_count
        self.negative += other.negative
        self.n += other.n

    def counts(self) -> Counts:
        """Return a copy of the counts, shape (..., slot)."""
        return self._counts.reshape(*self.support.low.shape, self._counts.shape[-1]).copy()

    def _slots(
        self, x: npt.NDArray[Any], part: slice, bad: Mask | None = None
    ) -> npt.NDArray[np.intp]:
        largest = np.finfo(x.dtype).max
        origin = self._origin[part].astype(x.dtype)
        steps = np.minimum(self._steps[part], largest).astype(x.dtype)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
            # The logarithm of 0 is minus infinity: below every bin, as negative samples are.
            position = (np.log(np.maximum(x, 0)) if self.scale == "log" else x) - origin
            position *= steps
            position += 1
        np.clip(position, 0, self.bins + 1, out=position)
        if bad is not None:
            position[bad] = self.bins + 2
        slots: npt.NDArray[np.intp] = position.astype(np.intp)
        return slots


def _masks(x: npt.NDArray[Any], null: Mask | None, bad: Mask | None) -> tuple[Mask, Mask | None]:
    for name, mask in (("null", null), ("bad", bad)):
        if mask is None:
            continue
        try:
            np.broadcast_to(mask, x.shape)
        except ValueError as error:
            expected = f"the {name} mask must broadcast to the samples' shape {x.shape}"
            message = f"{expected}, got {mask.shape}"
            raise InputError(message) from error
    # Two reductions tell the usual case, no bad sample at all, from the rest.
    if not all_good(x):
        bad = is_bad(x) if bad is None else bad | is_bad(x)
    if null is None:
        null = x == 0
    elif (null & (x != 0)).any():
        message = "the null mask marks samples that are not 0; null samples are exactly 0"
        raise InputError(message)
    return (null, None) if bad is None else (null & ~bad, np.broadcast_to(bad, x.shape))
