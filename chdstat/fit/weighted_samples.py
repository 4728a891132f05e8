"""Weighted samples: logarithms with weights, a block of rows at a time, of samples or of bins.

A family that is fitted from sums over the samples sees `WeightedSamples` only: samples have weight
1, bins of a log histogram the count of their samples. Rows are taken in the order of their number
of samples, so that a block is as wide as its rows need: null-heavy pixels cost what they hold.

Mixtures see `Summaries` only, of groups of neighbouring samples. What an exponential family needs
of a group is its size and the means of its sufficient statistics. With a bounded number of groups
per pixel, the cost of a fit does not depend on spp; with groups as narrow as the samples are dense,
hardly anything is lost. The bins of a log histogram are groups, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, spans, take_rows
from chdstat._core.positive import SMALLEST, LogStatistics, PositivePart
from chdstat.errors import Reason
from chdstat.summary.dispatch import Part, PositiveHistogram

__all__ = [
    "SPREAD_FLOOR",
    "Halves",
    "Summaries",
    "WeightedSamples",
    "blocks",
    "cumulative",
    "of_rows",
    "sum_over_samples",
    "summaries_of_bins",
    "summaries_of_each",
    "summaries_of_samples",
    "take_part",
]

_CHUNK = 2**17
"""Samples worked on at once: three or four arrays of them stay in the cache."""
_THIN = 32
_EDGES = np.sin(np.linspace(0, np.pi / 2, _THIN + 1)) ** 2
"""Quantiles at which the samples are parted: close at both ends, where single samples count."""


AnyPart = TypeVar("AnyPart", bound=Part)


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
        """As given."""
        return self.sums

    @classmethod
    def of_rows(cls, part: PositivePart, rows: npt.NDArray[np.intp]) -> Halves:
        """Take the even samples of some rows, in stored order, and below them the odd ones."""
        samples = part.x.shape[-1]
        x, positive = (values.reshape(-1, samples)[rows] for values in (part.x, part.positive))
        parity = [slice(first, None, 2) for first in (0, 1)]
        counts = [np.count_nonzero(positive[:, half], axis=-1) for half in parity]
        packed = np.zeros((2, len(rows), max(1, int(np.max(counts)))))
        columns = np.arange(packed.shape[-1])
        for to, half, count in zip(packed, parity, counts, strict=True):
            # Positions cost a fifth of what masks do, where nulls and others alternate at random.
            place = np.flatnonzero(columns < count[:, np.newaxis])
            to.reshape(-1)[place] = x[:, half].reshape(-1)[np.flatnonzero(positive[:, half])]
        n = np.concatenate(counts)
        both, none = packed.reshape(len(n), -1), np.zeros_like(n)
        points, sums = _of_ragged(both, n)
        return cls(both, points.weight > 0, n, none, none, none, none, points, sums)


def blocks(part: Part, usable: Mask, *, thin: bool = False) -> Iterator[WeightedSamples]:
    """Cut the usable rows of a part into blocks.

    With `thin`, samples are replaced by 32 of them, each with the weight of its neighbours: enough
    to come close to the maximum of all of them, for a sixteenth of the cost at 512.
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
            yield _samples(part, here, thin=thin)
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


def take_part(part: AnyPart, rows: npt.NDArray[np.intp]) -> AnyPart:
    """Return some rows of the flattened batch."""

    def taken(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        trailing = values.shape[part.n.ndim :]
        return np.broadcast_to(values, part.n.shape + trailing).reshape(-1, *trailing)[rows]

    return type(part)(**{field.name: taken(getattr(part, field.name)) for field in fields(part)})


def _samples(part: PositivePart, rows: npt.NDArray[np.intp], *, thin: bool) -> WeightedSamples:
    """Return all samples of some rows, or the middle one of each group for its neighbours."""
    n, log_mean = part.n.ravel()[rows], part.log_statistics.log_mean.ravel()[rows]
    ascending = part.log_sorted.reshape(-1, part.x.shape[-1])
    if thin:
        edges = np.rint(n[:, np.newaxis] * _EDGES).astype(np.intp)
        middle = np.minimum((edges[:, 1:] + edges[:, :-1]) // 2, n[:, np.newaxis] - 1)
        log, weight = ascending[rows[:, np.newaxis], middle], np.diff(edges).astype(np.float64)
        log -= log_mean[:, np.newaxis]
    else:
        log = ascending[rows, : int(n.max(initial=1))]
        log -= log_mean[:, np.newaxis]
        weight = _ones(n, log.shape[-1])
        _clear(log, weight, n)
    return WeightedSamples(
        rows=rows,
        log=log,
        weight=weight,
        n=n.astype(np.float64),
        log_mean=log_mean,
        log_top=log.max(axis=-1),
        single=not thin,
    )


def _of_ragged(x: Floats, n: npt.NDArray[np.int64]) -> tuple[WeightedSamples, LogStatistics]:
    """Return points and sums of the first n of each row, where the others are 0; works in `x`."""
    weight = _ones(n, x.shape[-1])
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
        n=np.maximum(n, 1).astype(np.float64),
        log_mean=sums.log_mean,
        log_top=log.max(axis=-1),
        single=True,
    )
    return points, sums


def _ones(n: npt.NDArray[np.int64], width: int) -> Floats:
    """Return 1 for the first n of each row and 0 for the others, shape (row, width)."""
    return (np.arange(width) < n[:, np.newaxis]).astype(np.float64)


def _clear(values: Floats, weight: Floats, n: npt.NDArray[np.int64], by: float = 0) -> None:
    """Set what is beyond the first n of each row: in a block of similar rows, few columns."""
    least = int(n.min(initial=values.shape[-1]))
    np.copyto(values[:, least:], by, where=weight[:, least:] == 0)


def _bins(part: PositiveHistogram, rows: npt.NDArray[np.intp]) -> WeightedSamples:
    """Draw the centres together until they have the log variance that the samples had.

    The bins spread the samples by h^2 / 12 (see `PositiveHistogram.log_statistics`); contracting
    the centres about their mean by one factor takes that back, and leaves the weights alone.
    """
    some = take_part(part, rows)
    weight, centers = some.counts, some.log_centers
    n = some.n.astype(np.float64)
    log_mean = np.vecdot(weight, centers) / n
    centered = centers - log_mean[:, np.newaxis]
    spread = np.vecdot(weight, centered**2) / n
    wanted = part.log_statistics.log_variance.ravel()[rows]
    centered *= np.sqrt(wanted / spread)[:, np.newaxis]
    empty = weight == 0
    # The edge, not the contracted centre: a family of bounded support must hold every sample.
    edge = np.where(empty, -np.inf, centers).max(axis=-1) + some.width / 2 - log_mean
    centered[empty] = 0
    return WeightedSamples(
        rows=rows, log=centered, weight=weight, n=n, log_mean=log_mean, log_top=edge
    )


SPREAD_FLOOR = 1e-3
"""Least standard deviation of a component in log x: its square is scikit-learn's `reg_covar`."""
_ENDS = 4
"""Samples at each end of a row that are groups by themselves: tails are sparse."""
_SPIKE_EDGES = 4
"""Edges of groups that are set where spikes begin and end."""


@dataclass(frozen=True)
class Summaries:
    """Rows of groups, each in ascending order.

    Attributes
    ----------
    count
        Samples per group, shape (row, group); 0 for a group that is not used.
    log, square, ratio
        Means of y, y^2 and exp(y) within the group, shape (row, group), where y = log x - origin.
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

    def take(self, rows: Counts) -> Summaries:
        """Return some of the rows."""
        return take_rows(self, rows, axis=0)

    @property
    def n(self) -> Floats:
        """Samples per row."""
        return np.asarray(self.count.sum(axis=-1))


def summaries_of_samples(log_sorted: Floats, n: Counts, most: int = 64) -> Summaries:
    """Group samples, their logarithms in ascending order, shape (row, sample), `n` of which count.

    There are up to `most` groups of equally many samples; those at both ends are divided. Edges lie
    at the widest gap near each quantile, or where a spike begins or ends, so that equal samples, or
    nearly equal ones, come into groups of their own.
    """
    pieces = []
    for part in spans(len(n), max(1, _CHUNK // log_sorted.shape[-1])):
        y, origin = _relative(log_sorted[part], n[part])
        edges = _edges(y, n[part], most)
        count = np.diff(edges, axis=-1).astype(np.float64)
        below = (np.take_along_axis(cumulative(v), edges, axis=-1) for v in (y, y * y, np.exp(y)))
        means = (np.diff(sums, axis=-1) / np.maximum(count, 1) for sums in below)
        pieces.append((count, *means, origin, _spacing(y, n[part])))
    count, log, square, ratio, origin, spacing = map(np.concatenate, zip(*pieces, strict=True))
    return Summaries(count, log, square, ratio, origin, np.full(len(n), SPREAD_FLOOR), spacing)


def summaries_of_each(log_sorted: Floats, n: Counts) -> Summaries:
    """Make each sample a group, which loses nothing; arguments as of `summaries_of_samples`."""
    y, origin = _relative(log_sorted, n)
    count = (np.arange(log_sorted.shape[-1]) < n[:, np.newaxis]).astype(np.float64)
    floor, spacing = np.full(len(n), SPREAD_FLOOR), _spacing(y, n)
    return Summaries(count, y, y * y, np.exp(y), origin, floor, spacing)


def summaries_of_bins(
    counts: Floats, log_centers: Floats, width: Floats
) -> tuple[Summaries, Summaries]:
    """Take over the bins of log histograms, shape (row, bin), of width h, shape (row,).

    The first have all samples at the centres of the bins. No component may be denser than the
    samples of one bin, spread over it: its standard deviation is at least h / sqrt(2 pi).

    The second have Sheppard's corrections (see `PositiveHistogram.log_statistics`): h^2 / 12
    less of mean squares, and means of exp(y) times (h / 2) / sinh(h / 2).
    """
    # Filled bins come first: the width is that of the row that has most of them.
    filled = counts > 0
    most = int(np.count_nonzero(filled, axis=-1).max())
    order = np.argsort(~filled, axis=-1, kind="stable")[:, :most]
    count, centers = (np.take_along_axis(v, order, axis=-1) for v in (counts, log_centers))
    last = np.count_nonzero(filled, axis=-1) - 1
    origin = np.take_along_axis(centers, last[:, np.newaxis], axis=-1)
    y, h = np.minimum(centers - origin, 0.0), width[:, np.newaxis]
    square, ratio = y * y, np.exp(y)
    least = np.maximum(width / np.sqrt(2 * np.pi), SPREAD_FLOOR)
    corrected = np.maximum(width * np.sqrt(1 / (2 * np.pi) - 1 / 12), SPREAD_FLOOR)
    # Half of the samples lie in bins that hold as many as this one, or more.
    fullest = -np.sort(-count, axis=-1)
    half = 2 * np.cumsum(fullest, axis=-1) < count.sum(axis=-1, keepdims=True)
    typical = np.take_along_axis(fullest, half.sum(axis=-1, keepdims=True), axis=-1)[:, 0]
    spacing = width / typical
    as_they_are = Summaries(count, y, square, ratio, origin[:, 0], least, spacing)
    ratio, square = ratio * (h / 2) / np.sinh(h / 2), square - h * h / 12
    return as_they_are, Summaries(count, y, square, ratio, origin[:, 0], corrected, spacing)


def _relative(log_sorted: Floats, n: Counts) -> tuple[Floats, Floats]:
    """Return y = log x - origin, 0 beyond the samples, and the origin: the largest log x."""
    origin = np.take_along_axis(log_sorted, n[:, np.newaxis] - 1, axis=-1)
    valid = np.arange(log_sorted.shape[-1]) < n[:, np.newaxis]
    return np.where(valid, log_sorted - origin, 0.0), origin[:, 0]


def _spacing(y: Floats, n: Counts) -> Floats:
    """Return the median distance of neighbours, shape (row,); 0 for a single sample."""
    gaps = np.diff(y, axis=-1)
    gaps[np.arange(1, y.shape[-1]) >= n[:, np.newaxis]] = np.inf
    gaps.sort(axis=-1)
    middle = np.maximum(n - 2, 0)[:, np.newaxis] // 2
    spacing = (
        np.zeros(len(y)) if gaps.shape[-1] == 0 else np.take_along_axis(gaps, middle, -1)[:, 0]
    )
    return np.where(n > 1, spacing, 0.0)


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
    edges = np.concatenate([widest, first, _spikes(gaps), count - rank - 1, count], axis=-1)
    np.clip(edges, 0, count, out=edges)
    edges.sort(axis=-1)
    return edges


def _widest(gaps: Floats, width: int, most: int) -> Counts:
    """Return 0 and the place of the widest gap in each run of `width`, padded with a last place."""
    rows, samples = gaps.shape
    edges = np.full((rows, most), samples, dtype=np.int64)
    runs = min(-(-samples // width), most)
    kept = gaps[:, : runs * width]
    padded = np.pad(kept, ((0, 0), (0, runs * width - kept.shape[-1])))
    places = padded.reshape(rows, runs, width).argmax(axis=-1)
    edges[:, :runs] = places + np.arange(runs) * width
    edges[:, 0] = 0
    return edges


def _spikes(gaps: Floats) -> Counts:
    """Return where spikes begin or end: the gap before is far wider than four on one side of it."""
    padded = np.pad(gaps, ((0, 0), (4, 4)), constant_values=np.inf)
    pairs = np.maximum(padded[:, 1:], padded[:, :-1])
    fours = np.maximum(pairs[:, 2:], pairs[:, :-2])
    denser = np.minimum(fours[:, :-5], fours[:, 5:])
    contrast = gaps / (denser + SPREAD_FLOOR)
    kept = min(_SPIKE_EDGES, gaps.shape[-1])
    return np.argpartition(contrast, -kept, axis=-1)[:, -kept:]


def cumulative(values: npt.NDArray[Any]) -> Floats:
    """Return sums of the values before each, and of all of them, shape (row, value + 1)."""
    sums = np.zeros((values.shape[0], values.shape[1] + 1))
    np.cumsum(values, axis=-1, out=sums[:, 1:])
    return sums
