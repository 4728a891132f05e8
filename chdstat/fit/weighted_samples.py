"""Weighted samples: logarithms with weights, a block of rows at a time, of samples or of bins.

A family that is fitted from sums over the samples sees `WeightedSamples` only: samples have weight
1, bins of a log histogram the count of their samples. Rows are taken in the order of their number
of samples, so that a block is as wide as its rows need: null-heavy pixels cost what they hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.positive import SMALLEST, Floats, LogStatistics, Mask, PositivePart
from chdstat.errors import Reason
from chdstat.summary.dispatch import Part, PositiveHistogram

__all__ = ["Halves", "WeightedSamples", "blocks", "of_rows", "sum_over_samples"]

_CHUNK = 2**17
"""WeightedSamples worked on at once: three or four arrays of them stay in the cache."""
_THIN = 32
_EDGES = np.sin(np.linspace(0, np.pi / 2, _THIN + 1)) ** 2
"""Quantiles at which the samples are parted: close at both ends, where single samples count."""


@dataclass(frozen=True)
class WeightedSamples:
    """Weighted points of some rows.

    Attributes
    ----------
    rows
        Which rows of the flattened part these are, shape (row,).
    log
        Log radiance relative to its mean in the row, shape (row, point); 0 where there is no point.
    weight
        Samples at each point, same shape; 0 where there is no point.
    n
        Samples of each row: the sum of its weights.
    log_mean
        Mean of log radiance, by which `log` is shifted: magnitudes drop out.
    log_top
        The largest of `log`, shape (row,); of bins, the upper edge of the highest that holds any,
        which no sample exceeds.
    single
        Whether every point is one sample: its weight is 1.
    """

    rows: npt.NDArray[np.intp]
    log: Floats
    weight: Floats
    n: Floats
    log_mean: Floats
    log_top: Floats
    single: bool = False

    @cached_property
    def log_weight(self) -> Floats:
        """Weight times `log`, shape of `log`."""
        return self.log if self.single else self.weight * self.log

    @cached_property
    def square_weight(self) -> Floats:
        """Weight times the square of `log`, shape of `log`."""
        return self.log_weight * self.log

    def take(self, rows: npt.NDArray[Any]) -> WeightedSamples:
        """Return some rows of these."""
        names = ("rows", "log", "weight", "n", "log_mean", "log_top")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def average(self, values: Floats) -> Floats:
        """Average over the samples of each row, shape (row,)."""
        return np.asarray(np.vecdot(self.weight, values) / self.n)

    def moments(self, values: Floats) -> tuple[Floats, Floats, Floats]:
        """Return averages of values, and of their products with `log` and with its square."""
        zero = np.vecdot(self.weight, values)
        one = np.vecdot(self.log_weight, values)
        two = np.vecdot(self.square_weight, values)
        return zero / self.n, one / self.n, two / self.n


@dataclass(frozen=True)
class Halves(PositivePart):
    """Halves of the samples of some rows, all in one block, whose logarithms are known.

    Attributes
    ----------
    points
        The samples, in stored order: `WeightedSamples.rows` counts from 0.
    sums
        Their `log_statistics`.
    """

    points: WeightedSamples
    sums: LogStatistics

    @cached_property
    def log_statistics(self) -> LogStatistics:
        """Mean, log-mean and log-variance of the samples."""
        return self.sums

    @classmethod
    def of_samples(cls, x: Floats, n: npt.NDArray[np.int64]) -> Halves:
        """Take the first n of each row of `x`, shape (row, sample), which is overwritten."""
        points, sums = _of_ragged(x, n)
        none = np.zeros_like(n)
        valid = points.weight > 0
        return cls(x, valid, n, none, none, none, none, points=points, sums=sums)


def blocks(part: Part, usable: Mask, *, thin: bool = False) -> Iterator[WeightedSamples]:
    """Cut the usable rows of a part into blocks.

    With `thin`, samples are replaced by 32 of them, each with the weight of its neighbours: enough
    to come close to what all of them say, for a sixteenth of the cost at 512.
    """
    if isinstance(part, Halves):
        if usable.any():
            yield part.points if usable.all() else part.points.take(usable)
        return
    n = part.n.ravel()
    rows = np.flatnonzero(usable)
    rows = rows[np.argsort(n[rows], kind="stable")]
    held = part.counts if isinstance(part, PositiveHistogram) else part.x
    width = _THIN if thin else held.shape[-1]
    start = 0
    while start < len(rows):
        # A block has as many rows as there may be of the widest in it.
        least = max(1, int(n[rows[start]]))
        widest = int(n[rows[min(start + _CHUNK // least, len(rows) - 1)]])
        step = max(1, _CHUNK // min(width, widest))
        here = rows[start : start + step]
        if isinstance(part, PositiveHistogram):
            yield _bins(part, here)
        else:
            yield _some_samples(part, here) if thin else _samples(part, here)
        start += step


def of_rows(
    part: Part,
    minimum: int,
    names: int,
    of_points: Callable[[WeightedSamples], Floats],
    *,
    thin: bool = False,
    among: Mask | None = None,
) -> Floats:
    """Compute `names` numbers per row from its points, shape (name, row); NaN where unusable."""
    results = np.full((names, part.n.size), np.nan)
    usable = part.reason(minimum).ravel() == Reason.OK
    usable = usable if among is None else usable & among
    for points in blocks(part, usable, thin=thin):
        results[:, points.rows] = of_points(points)
    return results


def sum_over_samples(
    part: Part, known: Mask, of_points: Callable[[WeightedSamples], Floats]
) -> Floats:
    """Sum a value per point over the samples of a row, shape (...); NaN where not `known`."""
    total = np.full(part.n.size, np.nan)
    for points in blocks(part, known.ravel() & (part.n.ravel() > 0)):
        total[points.rows] = np.vecdot(points.weight, of_points(points))
    return total.reshape(part.n.shape)


def _samples(part: PositivePart, rows: npt.NDArray[np.intp]) -> WeightedSamples:
    n = part.n.ravel()[rows]
    log_mean = part.log_statistics.log_mean.ravel()[rows]
    log = part.log_sorted.reshape(-1, part.x.shape[-1])[rows, : int(n.max(initial=1))]
    log -= log_mean[:, np.newaxis]
    weight = _ones(n, log.shape[-1])
    _clear(log, weight, n)
    return WeightedSamples(
        rows=rows,
        log=log,
        weight=weight,
        n=n.astype(np.float64),
        log_mean=log_mean,
        log_top=log[np.arange(len(rows)), n - 1],
        single=True,
    )


def _of_ragged(x: Floats, n: npt.NDArray[np.int64]) -> tuple[WeightedSamples, LogStatistics]:
    """Return points and sums of the first n of each row, where the others are 0; works in `x`."""
    weight = _ones(n, x.shape[-1])
    count = np.maximum(n, 1).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        mean = x.sum(axis=-1) / n
        # Ratios to the mean have small, hence exact, logarithms where samples are nearly equal.
        x /= np.where(n > 0, mean, 1)[:, np.newaxis]
        np.maximum(x, SMALLEST, out=x)
        _clear(x, weight, n, 1)
        log = np.log(x, out=x)
        gap = -log.sum(axis=-1) / n
        log += np.where(n > 0, gap, 0)[:, np.newaxis]
        _clear(log, weight, n)
        log_variance = np.vecdot(log, log) / n
    sums = LogStatistics(n=n, mean=mean, gap=gap, log_variance=log_variance)
    points = WeightedSamples(
        rows=np.arange(len(n)),
        log=log,
        weight=weight,
        n=count,
        log_mean=sums.log_mean,
        log_top=log.max(axis=-1, initial=-np.inf),
        single=True,
    )
    return points, sums


def _ones(n: npt.NDArray[np.int64], width: int) -> Floats:
    """Return 1 for the first n of each row and 0 for the others, shape (row, width)."""
    weight = np.ones((len(n), width))
    least = int(n.min(initial=width))
    weight[:, least:] = np.arange(least, width) < n[:, np.newaxis]
    return weight


def _clear(values: Floats, weight: Floats, n: npt.NDArray[np.int64], by: float = 0) -> None:
    """Set what is beyond the first n of each row: in a block of similar rows, few columns."""
    least = int(n.min(initial=values.shape[-1]))
    np.copyto(values[:, least:], by, where=weight[:, least:] == 0)


def _some_samples(part: PositivePart, rows: npt.NDArray[np.intp]) -> WeightedSamples:
    """Part the sorted samples into groups, and let the middle one of each stand for its group."""
    n = part.n.ravel()[rows]
    log_mean = part.log_statistics.log_mean.ravel()[rows]
    edges = np.rint(n[:, np.newaxis] * _EDGES).astype(np.intp)
    middle = np.minimum((edges[:, 1:] + edges[:, :-1]) // 2, n[:, np.newaxis] - 1)
    log = part.log_sorted.reshape(-1, part.x.shape[-1])[rows[:, np.newaxis], middle]
    log -= log_mean[:, np.newaxis]
    return WeightedSamples(
        rows=rows,
        log=log,
        weight=np.diff(edges, axis=-1).astype(np.float64),
        n=n.astype(np.float64),
        log_mean=log_mean,
        log_top=log[:, -1],
    )


def _bins(part: PositiveHistogram, rows: npt.NDArray[np.intp]) -> WeightedSamples:
    """Draw the centres together until they have the log variance that the samples had.

    The bins spread the samples by h^2 / 12 (see `PositiveHistogram.log_statistics`); contracting
    the centres about their mean by one factor takes that back, and leaves the weights alone.
    """
    bins = part.counts.shape[-1]
    weight = part.counts.reshape(-1, bins)[rows]
    centers = part.log_centers.reshape(-1, bins)
    centers = centers if len(centers) == 1 else centers[rows]
    n = part.n.ravel()[rows].astype(np.float64)
    log_mean = np.vecdot(weight, centers) / n
    half = np.broadcast_to(part.width, part.n.shape).ravel()[rows] / 2
    centered = centers - log_mean[:, np.newaxis]
    spread = np.vecdot(weight, centered**2) / n
    wanted = part.log_statistics.log_variance.ravel()[rows]
    centered *= np.sqrt(wanted / spread)[:, np.newaxis]
    empty = weight == 0
    # The edge, not the contracted centre: a family of bounded support must hold every sample.
    edge = np.where(empty, -np.inf, centers).max(axis=-1) + half - log_mean
    centered[empty] = 0
    return WeightedSamples(
        rows=rows, log=centered, weight=weight, n=n, log_mean=log_mean, log_top=edge
    )
