"""Groups of neighbouring samples: mixtures are fitted to groups, not to single samples.

An exponential family needs two things of a group: its size and the means of its sufficient
statistics. The number of groups per pixel is bounded, so that the cost of a fit does not depend on
spp. Groups are narrow where samples are dense, so that hardly anything is lost. The bins of a log
histogram are groups, too. Rows come last: there are many more rows than groups, and long loops take
half the time.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, chunks

SPREAD_FLOOR = 1e-3
"""Least standard deviation of a component in log x: the root of scikit-learn's `reg_covar`."""
_ENDS = 4
"""Samples at each end of a row that are groups of their own: tails are sparse."""
_SPIKE_EDGES = 4
"""Most edges of groups that are set where spikes begin and end."""


@dataclass(frozen=True)
class RowsLast:
    """Arrays whose last axis is rows, and fields that all rows share."""

    def take(self, rows: npt.NDArray[Any]) -> Self:
        """Select some of the rows, by their numbers or by a mask."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays = {n: take_last(v, rows) for n, v in values.items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)


@dataclass(frozen=True)
class SampleGroups(RowsLast):
    """Rows of groups, each in ascending order.

    Attributes
    ----------
    count
        Samples per group, shape (group, row); 0 for a group that is not used.
    log, square, ratio
        Means of y, y^2 and exp(y) within the group, shape (group, row), where y = log x - origin.
    origin
        Shape (row,): log of the largest sample, so that exp(y) cannot overflow.
    floor
        Least standard deviation of a component, shape (row,).
    spacing
        Median distance of neighbouring samples in y, shape (row,).
    """

    count: Floats
    log: Floats
    square: Floats
    ratio: Floats
    origin: Floats
    floor: Floats
    spacing: Floats

    @cached_property
    def n(self) -> Floats:
        """Samples per row."""
        return np.asarray(self.count.sum(axis=0))


def groups_of_samples(log_sorted: Floats, n: Counts, most: int = 64) -> SampleGroups:
    """Group the first `n` samples of each row; their logarithms ascend, shape (row, sample).

    There are up to `most` groups of equally many samples; the groups at both ends are divided.
    Edges lie at the widest gap near each quantile, or where a spike begins or ends. Equal or nearly
    equal samples thus get groups of their own.
    """
    pieces = []
    for part in chunks(len(n), log_sorted.shape[-1]):
        y, origin = _relative(log_sorted[part], n[part])
        edges = _edges(y, n[part], most)
        count = np.diff(edges, axis=-1).astype(np.float64)
        means = (_sums(v, edges) / np.maximum(count, 1) for v in (y, y * y, np.exp(y)))
        pieces.append((count, *means, origin, _spacing(y, n[part])))
    count, log, square, ratio, origin, spacing = (
        np.ascontiguousarray(np.concatenate(v).T) for v in zip(*pieces, strict=True)
    )
    return SampleGroups(count, log, square, ratio, origin, np.full(len(n), SPREAD_FLOOR), spacing)


def groups_of_each(log_sorted: Floats, n: Counts) -> SampleGroups:
    """Make each sample a group, without loss; arguments as in `groups_of_samples`."""
    y, origin = _relative(log_sorted, n)
    count = (np.arange(log_sorted.shape[-1])[:, np.newaxis] < n).astype(np.float64)
    floor, spacing, log = np.full(len(n), SPREAD_FLOOR), _spacing(y, n), np.ascontiguousarray(y.T)
    return SampleGroups(count, log, log * log, np.exp(log), origin, floor, spacing)


def groups_of_bins(
    counts: Floats, log_centers: Floats, width: Floats, most: int
) -> tuple[SampleGroups, SampleGroups]:
    """Return the bins of log histograms as groups, twice; shape (row, bin), width h (row,).

    There are as many groups as bins, but at most `most`; filled bins come first.

    The first result has all samples at the centres of the bins. No component may be denser than the
    samples of one bin, spread over it: its standard deviation is at least h / sqrt(2 pi).

    The second result has Sheppard's corrections (see `PositiveHistogram.log_statistics`): mean
    squares are less by h^2 / 12, and means of exp(y) are multiplied by (h / 2) / sinh(h / 2).
    """
    filled = counts > 0
    last = np.count_nonzero(filled, axis=-1) - 1
    order = np.argsort(~filled, axis=-1, kind="stable")[:, :most]
    count, centers = (np.take_along_axis(v, order, axis=-1) for v in (counts, log_centers))
    origin = np.take_along_axis(centers, last[:, np.newaxis], axis=-1)
    # Half of the samples lie in bins that hold at least as many samples as this bin.
    fullest = -np.sort(-count, axis=-1)
    half = 2 * np.cumsum(fullest, axis=-1) < count.sum(axis=-1, keepdims=True)
    typical = np.take_along_axis(fullest, half.sum(axis=-1, keepdims=True), axis=-1)[:, 0]
    count, y, h = (
        np.ascontiguousarray(v.T) for v in (count, np.minimum(centers - origin, 0), width)
    )
    least = np.maximum(h / np.sqrt(2 * np.pi), SPREAD_FLOOR)
    corrected = np.maximum(h * np.sqrt(1 / (2 * np.pi) - 1 / 12), SPREAD_FLOOR)
    as_they_are = SampleGroups(count, y, y * y, np.exp(y), origin[:, 0], least, h / typical)
    square, ratio = y * y - h * h / 12, np.exp(y) * (h / 2) / np.sinh(h / 2)
    return as_they_are, SampleGroups(count, y, square, ratio, origin[:, 0], corrected, h / typical)


def _relative(log_sorted: Floats, n: Counts) -> tuple[Floats, Floats]:
    """Return y = log x - origin, 0 beyond the samples, and the origin: the largest log x."""
    origin = np.take_along_axis(log_sorted, n[:, np.newaxis] - 1, axis=-1)
    valid = np.arange(log_sorted.shape[-1]) < n[:, np.newaxis]
    return np.where(valid, log_sorted - origin, 0.0), origin[:, 0]


def _spacing(y: Floats, n: Counts) -> Floats:
    """Return the median distance of neighbouring samples, shape (row,); 0 for a single sample."""
    # Sorting in single precision takes a seventh of the time.
    gaps = np.diff(y, axis=-1).astype(np.float32)
    gaps[np.arange(1, y.shape[-1]) >= n[:, np.newaxis]] = np.inf
    gaps.sort(axis=-1)
    middle = np.maximum(n - 2, 0)[:, np.newaxis] // 2
    spacing = (
        np.zeros(len(y)) if gaps.shape[-1] == 0 else np.take_along_axis(gaps, middle, -1)[:, 0]
    )
    return np.where(n > 1, spacing, 0.0).astype(np.float64)


def _edges(y: Floats, n: Counts, most: int) -> Counts:
    """Return where groups begin and end, shape (row, edge)."""
    step = 2 ** np.maximum(np.ceil(np.log2(np.maximum(n, 1) / most)), 0).astype(np.int64)
    gaps = np.diff(y, axis=-1, prepend=y[:, :1])
    widest = np.empty((len(y), most), dtype=np.int64)
    for width in np.unique(step):
        here = step == width
        widest[here] = _widest(gaps[here], int(width), most)
    rank, count = np.arange(_ENDS), n[:, np.newaxis]
    first = np.broadcast_to(rank + 1, (len(y), _ENDS))
    edges = np.concatenate([widest, first, _spikes(gaps, n), count - rank - 1, count], axis=-1)
    np.clip(edges, 0, count, out=edges)
    edges.sort(axis=-1)
    return edges


def _widest(gaps: Floats, width: int, most: int) -> Counts:
    """Return 0, the place of the widest gap in each run of `width`, and the last place, padded."""
    rows, samples = gaps.shape
    edges = np.full((rows, most), samples, dtype=np.int64)
    runs = min(-(-samples // width), most)
    kept = gaps[:, : runs * width]
    padded = np.pad(kept, ((0, 0), (0, runs * width - kept.shape[-1])))
    places = padded.reshape(rows, runs, width).argmax(axis=-1)
    edges[:, :runs] = places + np.arange(runs) * width
    edges[:, 0] = 0
    return edges


def _spikes(gaps: Floats, n: Counts) -> Counts:
    """Return where spikes begin or end: a gap far wider than the four gaps on one side of it."""
    valid = np.arange(gaps.shape[-1]) < n[:, np.newaxis]
    ends = np.where(valid, gaps, np.inf)
    padded = np.pad(ends, ((0, 0), (4, 4)), constant_values=np.inf)
    pairs = np.maximum(padded[:, 1:], padded[:, :-1])
    fours = np.maximum(pairs[:, 2:], pairs[:, :-2])
    denser = np.minimum(fours[:, :-5], fours[:, 5:])
    contrast = np.where(valid, gaps / (denser + SPREAD_FLOOR), -1.0)
    found = np.empty((len(n), _SPIKE_EDGES), dtype=np.int64)
    # The largest are found one by one: a partition of places takes ten times as long.
    for edge in found.T:
        edge[:] = contrast.argmax(axis=-1)
        np.put_along_axis(contrast, edge[:, np.newaxis], -1.0, axis=-1)
    return found


def _sums(values: Floats, edges: Counts) -> Floats:
    """Return the sums of values between edges that do not descend, shape (row, group)."""
    starts = edges + values.shape[-1] * np.arange(len(values))[:, np.newaxis]
    sums = np.add.reduceat(np.append(values, 0.0), starts.reshape(-1)).reshape(edges.shape)
    return np.where(edges[:, 1:] > edges[:, :-1], sums[:, :-1], 0.0)


def take_last(values: npt.NDArray[Any], rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Select rows along the last axis, by their numbers or by a mask.

    The rows stay next to each other in memory. `values[..., rows]` would put the axis first, and
    every operation on the result would take up to three times as long.
    """
    return np.take(values, np.flatnonzero(rows) if rows.dtype == bool else rows, axis=-1)


def cumulative(values: npt.NDArray[Any], axis: int = -1) -> Floats:
    """Return the sums of the values before each place along an axis, and the sum of all."""
    none = np.zeros_like(np.take(values, [0], axis=axis), dtype=np.float64)
    return np.concatenate([none, np.cumsum(values, axis=axis, dtype=np.float64)], axis=axis)
