"""Histograms of samples: linear and log10 bins, with everything outside them counted separately.

Use `histogram` on an array or a whole image, and `StreamingHistogram` on samples that come in
blocks. The defaults are those of Elek, Thomas and Forbes (2019): 100 bins; a linear support that
fits the first 50 samples of each pixel; a log support of [1e-5, 1e5].

Null and bad samples do not enter the bins. Negative samples enter linear bins; on the log scale,
they are underflow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, overload

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import (
    Counts,
    Floats,
    Mask,
    all_good,
    as_samples,
    chunks,
    is_bad,
    is_null,
    label_variables,
    warn_left_out,
)
from chdstat._core.positive import PositiveHistogram, sample_mask
from chdstat._core.statistic import RADIANCE, Result, result, variable
from chdstat.errors import InputError, Reason, check_option
from chdstat.samples import ImageLike, Mapped, SampleBlocks, Samples, opened, reduce_tiles

if TYPE_CHECKING:
    import xarray as xr

Scale: TypeAlias = Literal["linear", "log"]

SCALES: tuple[Scale, ...] = ("linear", "log")
FIRST_DRAWS = 50
"""Draws whose span sets the linear support."""
LOG_SUPPORT = (1e-5, 1e5)
"""Support of log histograms, in radiance."""
_OF_LOG = ("counts", "low", "high", "underflow", "overflow", "negative")
LOG_VARIABLES = (*(f"log_{name}" for name in _OF_LOG), "null_count", "bad_count")
"""Variables that make up the log histogram in the dataset of an image."""

PADDING = 0.25
_ROUNDING = 1e-3
"""Padding of samples that are all to be in bins, however these round."""


@dataclass(frozen=True)
class Support:
    """Where the bins are: [low, high) in radiance, each with the batch's shape.

    A pixel whose samples set no support has NaN there, and `reason` says why.
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
    ends. If all values equal v, or are too close for floating point to tell the bins apart, the
    support is [0.75 v, 1.25 v]. There is no support without such samples, or if v = 0.

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
    null, bad = _checked_masks(first, null, bad)
    if bad is None:
        bad = np.zeros(first.shape, dtype=np.bool_)
    used = ~(null | bad)
    low = np.where(used, first, np.inf).min(axis=-1).astype(np.float64)
    high = np.where(used, first, -np.inf).max(axis=-1).astype(np.float64)
    return _around(low, high, PADDING, first.dtype, all_bad=np.asarray(bad.all(axis=-1)))


def _around(
    low: Floats, high: Floats, padding: float, dtype: npt.DTypeLike, *, all_bad: Mask
) -> Support:
    """Return the support around samples from `low` to `high`, infinite where there are none."""
    empty = low > high
    low, high = np.where(empty, 0, low), np.where(empty, 0, high)
    # A span of fewer than 128 floats would only show how floats are spaced.
    size = np.maximum(np.abs(low), np.abs(high))
    point = high - low <= 128 * np.finfo(dtype).eps * size
    room = np.where(point, PADDING * size, padding * (high - low))
    nothing = empty | (size == 0)
    reason = np.select(
        [~empty & nothing, empty & all_bad, empty],
        [Reason.CONSTANT, Reason.ALL_BAD, Reason.ALL_NULL],
        Reason.OK,
    )
    return Support(
        np.where(nothing, np.nan, low - room),
        np.where(nothing, np.nan, high + room),
        reason.astype(np.int8),
    )


# --- what is drawn --------------------------------------------------------------------------------

_SHOWN, _ONE_OF = 0.995, 16
"""Share of the samples that an axis holds, and samples from which it may leave out one."""
_APART, _BULK, _FURTHER = 100.0, 0.9, 10.0
"""Ratio of radiance between what most samples of pixels share from which they share no axis; what
most samples are; and how far beyond these a shared axis goes."""
_NEAR = 0.5
"""Decades from the others within which no sample is left out; a quarter of their linear range."""
_PER_DECADE = 10
"""Bins of a decade, as on the log scale of Elek, Thomas and Forbes (2019)."""


def drawn_histograms(
    x: npt.NDArray[Any], *, null: Mask | None = None, bad: Mask | None = None
) -> dict[Scale, Histogram]:
    """Return the linear and the log histogram of rows that are drawn together, by scale.

    Every positive sample is in a bin of the log histogram, a tenth of a decade wide. The linear
    histogram of each row has 100 bins on the range that an axis shows of it.

    Parameters
    ----------
    x
        Radiance, shape (row, sample).
    null, bad
        As for `histogram`.

    Examples
    --------
    >>> found = drawn_histograms(np.array([[0.0, 0.5, 0.7, 2e-9]]))
    >>> int(found["log"].counts.sum()), found["linear"].high.round(2)
    (3, array([0.7]))
    """
    null, bad = _checked_masks(x, null, bad)
    bad = np.zeros(x.shape, dtype=np.bool_) if bad is None else bad
    used = ~np.broadcast_to(null, x.shape) & ~bad
    seen = x[used & (x > 0)]
    ends = (seen.min(), seen.max()) if seen.size else (1.0, 1.0)
    least, most = (math.floor(math.log10(end)) for end in ends)
    decades = float(f"1e{least}"), float(f"1e{most + 1}")
    held = [_held("linear", row[mask], row[mask]) for row, mask in zip(x, used, strict=True)]
    low, high = np.array(held, np.float64).reshape(-1, 2).T
    kind = x.dtype if x.dtype.kind == "f" else np.dtype(np.float64)
    linear = _around(low, high, _ROUNDING, kind, all_bad=np.asarray(bad.all(axis=-1)))
    linear.low[low >= 0] = np.maximum(linear.low[low >= 0], 0)
    bins = _PER_DECADE * (most + 1 - least)
    return {
        "linear": histogram(x, scale="linear", support=linear, null=null, bad=bad),
        "log": histogram(x, support=decades, bins=bins, null=null, bad=bad),
    }


def shown_range(
    found: Sequence[Histogram], means: Sequence[float] = (), *, share: float = _SHOWN
) -> tuple[float, float] | None:
    """Return the range of radiance that an axis of histograms shows; None without samples in bins.

    It is the shortest range of bins, on the scale of the histograms, that holds 99.5 % of all their
    samples, or all but one. It goes on to the last sample at either end, and to means, if these are
    near: up to half a decade or a quarter of its width away, and twice as far for means.

    Parameters
    ----------
    found
        Histograms of one scale that share the axis, of any shape.
    means
        Where means are marked; NaN for none.
    share
        Another share of the samples than 99.5 %.

    Examples
    --------
    >>> x = np.append(np.random.default_rng(0).lognormal(size=511), 1e-15)
    >>> low, high = shown_range([histogram(x, bins=360, support=(1e-16, 1e20))])
    >>> 0.01 < low < 0.1, 10 < high < 100
    (True, True)
    """
    scale, parts = found[0].scale, [(h.edges[..., :-1], h.edges[..., 1:], h.counts) for h in found]
    low, high, counts = (np.concatenate([p[k].ravel() for p in parts]) for k in range(3))
    # On the log scale, what is below the bins may be zeros, which have no place on the axis.
    beyond = sum(int(h.overflow.sum() + (scale == "linear") * h.underflow.sum()) for h in found)
    filled = counts > 0
    if not filled.any():
        return None
    return _held(scale, low[filled], high[filled], counts[filled], beyond, means, share)


def shared_ranges(
    found: Sequence[Sequence[Histogram]], means: Sequence[Sequence[float]]
) -> list[tuple[float, float] | None]:
    """Return the range of radiance of each of several pixels that share a log axis.

    It is that of all their samples, but it ends a decade beyond what holds 90 % of each pixel: the
    tail of one must not take the room of all. Pixels whose 90 % are two decades or more away from
    those of the others share a range among themselves.

    Parameters
    ----------
    found, means
        Log histograms and means of each pixel, as for `shown_range`.
    """
    bulks = [shown_range(those, share=_BULK) for those in found]
    ranges: list[tuple[float, float] | None] = [None] * len(found)
    groups: list[list[int]] = []
    top = 0.0
    for low, high, i in sorted((*span, i) for i, span in enumerate(bulks) if span):
        if groups and low < _APART * top:
            groups[-1].append(i)
        else:
            groups.append([i])
        top = max(top, high)
    for group in groups:
        pooled = [h for i in group for h in found[i]]
        whole = shown_range(pooled, [mean for i in group for mean in means[i]])
        ends = [span for i in group if (span := bulks[i])]
        low, high = min(end[0] for end in ends) / _FURTHER, max(end[1] for end in ends) * _FURTHER
        for i in group:
            ranges[i] = whole and (max(low, whole[0]), min(high, whole[1]))
    return ranges


def _held(
    scale: Scale,
    low: npt.NDArray[Any],
    high: npt.NDArray[Any],
    counts: Counts | None = None,
    beyond: int = 0,
    means: Sequence[float] = (),
    share: float = _SHOWN,
) -> tuple[float, float]:
    """Return the shortest range that holds most of the samples that were counted in some cells."""
    if not low.size:
        return np.inf, -np.inf
    order = np.argsort(low)
    low, high = _axis_ends(scale, low[order].astype(float), np.maximum.accumulate(high[order]))
    total = np.arange(1, low.size + 1) if counts is None else counts[order].cumsum()
    number = int(total[-1]) + beyond
    spare = max((1 - share) * number, float(number >= _ONE_OF)) - beyond
    before = np.concatenate([[0], total[:-1]])
    first = np.flatnonzero(before <= max(spare, 0))
    last = np.searchsorted(total, total[-1] - max(spare, 0) + before[first])
    first, last = first[last < low.size], last[last < low.size]
    best = np.argmin(high[last] - low[first])
    start, stop = low[first[best]], high[last[best]]
    near = _NEAR * np.log(10) if scale == "log" else _NEAR / 2 * (stop - start)
    marks = np.array([m for m in means if m > 0 or (scale == "linear" and np.isfinite(m))])
    for points, reach in (
        (np.array([low[0], high[-1]]), near),
        (_axis_ends(scale, marks, marks)[0], 2 * near),
    ):
        inside = points[(points >= start - reach) & (points <= stop + reach)]
        start, stop = min([start, *inside]), max([stop, *inside])
    ends = np.exp([start, stop]) if scale == "log" else (start, stop)
    return float(ends[0]), float(ends[1])


def tile_support(tile: Samples) -> Support:
    """Return the linear support of a tile, for any division of its store into batches."""
    first = tile.read(ss=slice(FIRST_DRAWS))
    null, bad = sample_masks(first)
    return linear_support(first, null=null, bad=bad)


def _checked_support(support: GivenSupport, shape: tuple[int, ...], scale: Scale) -> Support:
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


def _axis_ends(scale: Scale, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the support in the coordinate that the bins divide evenly."""
    return (np.log(low), np.log(high)) if scale == "log" else (low, high)


def sample_masks(block: npt.NDArray[Any]) -> tuple[Mask, Mask | None]:
    """Return which whole samples are null and bad, shape (..., 1, sample); None if none is bad."""
    null = is_null(block)[..., np.newaxis, :]
    if all_good(block):
        return null, None
    return null, np.asarray(is_bad(block).any(axis=-2, keepdims=True))


def _checked_masks(
    x: npt.NDArray[Any], null: Mask | None, bad: Mask | None
) -> tuple[Mask, Mask | None]:
    """Return which samples are null and bad, from the caller's masks; None if none is bad."""
    for mask in (null, bad):
        if mask is not None:
            sample_mask(mask, x.shape)
    # Two reductions detect the usual case of no bad sample.
    if not all_good(x):
        bad = is_bad(x) if bad is None else bad | is_bad(x)
    if null is None:
        null = x == 0
    elif (null & (x != 0)).any():
        message = "the null mask marks samples that are not 0; null samples are exactly 0"
        raise InputError(message)
    return (null, None) if bad is None else (null & ~bad, np.broadcast_to(bad, x.shape))


@result
class Histogram(Result):
    """How many samples fell into each bin, and how many fell elsewhere.

    For every pixel, bins + underflow + overflow + null_count + bad_count = n.

    Attributes
    ----------
    scale
        "linear" or "log": whether the bins divide radiance or its logarithm evenly.
    counts
        Samples per bin, shape (..., bin).
    low, high
        Support in radiance, shape (...); NaN where there is none.
    underflow, overflow
        Good, non-null samples below and above the support, shape (...).
    negative
        Good samples that are negative, shape (...). On the log scale, they are part of the
        underflow.
    null_count, bad_count
        Null and bad samples, which are not in the bins, shape (...).
    reason
        `Reason` codes of why there is no support, shape (...).
    n
        Draws per pixel.
    """

    scale: Scale
    counts: Counts = variable("samples per bin", "bin")
    low: Floats = variable("lower end of the support", unit=RADIANCE)
    high: Floats = variable("upper end of the support", unit=RADIANCE)
    underflow: Counts = variable("samples below the support")
    overflow: Counts = variable("samples above the support")
    negative: Counts = variable("negative samples, wherever they were counted")
    null_count: Counts
    bad_count: Counts
    reason: npt.NDArray[np.int8] = variable("why there is no support")
    n: int

    @property
    def edges(self) -> Floats:
        """Bin edges in radiance, shape (..., bin + 1)."""
        return self._at(np.arange(self.counts.shape[-1] + 1))

    @property
    def centers(self) -> Floats:
        """Bin centres in radiance, shape (..., bin); geometric ones on the log scale."""
        return self._at(np.arange(self.counts.shape[-1]) + 0.5)

    @property
    def density(self) -> Floats:
        """Density of the good, non-null samples, shape (..., bin); NaN where there are none.

        It is per unit of radiance, or per decade on the log scale. It integrates to the share of
        these samples that lie within the support.
        """
        total = self.counts.sum(axis=-1) + self.underflow + self.overflow
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.counts / (total * self.bin_width)[..., np.newaxis])

    @property
    def bin_width(self) -> Floats:
        """Width of the bins in radiance, or in decades on the log scale, shape (...)."""
        low, high = _axis_ends(self.scale, self.low, self.high)
        width = (high - low) / self.counts.shape[-1]
        return np.asarray(width / np.log(10) if self.scale == "log" else width)

    def outside(self, low: float, high: float) -> tuple[Counts, Counts]:
        """Return how many samples lie below and above a range of radiance, each of shape (...).

        Bins count where their centre is; null and bad samples do not count.
        """
        below, above = self.centers < low, self.centers > high
        return (
            self.underflow + np.where(below, self.counts, 0).sum(axis=-1),
            self.overflow + np.where(above, self.counts, 0).sum(axis=-1),
        )

    def variables(self) -> dict[str, tuple[tuple[str, ...], npt.NDArray[Any]]]:
        """Return the fields of a dataset: by name, the dims after y and x, and the array."""
        variables: dict[str, tuple[tuple[str, ...], npt.NDArray[Any]]] = {}
        for name, (own, about) in self.declared(f"{self.scale}_").items():
            value = getattr(self, own)
            # Counts of one image fit into 32 bits.
            value = value.astype(np.int32) if value.dtype == np.int64 else value
            variables[name] = ("channel", *(f"{self.scale}_{dim}" for dim in about.dims)), value
        return variables

    @classmethod
    def of_dataset(cls, dataset: xr.Dataset) -> Histogram:
        """Return the log histogram in the dataset of an image, over (y, x, channel).

        Raises
        ------
        InputError
            If the dataset lacks one of its variables.
        """
        missing = [name for name in LOG_VARIABLES if name not in dataset]
        if missing:
            message = (
                "expected the dataset of chdstat.histogram(samples, scale='log'), "
                f"got one without {', '.join(missing)}"
            )
            raise InputError(message)
        return cls(
            scale="log",
            **{name: dataset[f"log_{name}"].to_numpy() for name in _OF_LOG},
            null_count=dataset["null_count"].to_numpy()[..., np.newaxis],
            bad_count=dataset["bad_count"].to_numpy()[..., np.newaxis],
            reason=np.zeros(dataset["log_low"].shape, dtype=np.int8),
            n=0,
        )

    @property
    def positive(self) -> PositiveHistogram:
        """The positive samples in the bins of a log histogram, for fits.

        Raises
        ------
        InputError
            If the bins divide radiance, not its logarithm.
        """
        if self.scale != "log":
            message = f"a fit needs a log histogram, got one of {self.scale} scale"
            raise InputError(message)
        bins = self.counts.shape[-1]
        # Most histograms have one support for all rows.
        with np.errstate(invalid="ignore"):
            ends = np.log(self.low), np.log(self.high)
        first = (slice(0, 1),) * self.low.ndim
        start, stop = (end[first] if (end == end[first]).all() else end for end in ends)
        width = (stop - start) / bins
        filled = self.counts.astype(np.float64)
        filled[..., -1] += self.overflow
        n = filled.sum(axis=-1).astype(np.int64)
        null, bad = (
            np.broadcast_to(count, n.shape).astype(np.int64)
            for count in (self.null_count, self.bad_count)
        )
        return PositiveHistogram(
            counts=filled,
            log_centers=start[..., np.newaxis] + width[..., np.newaxis] * (np.arange(bins) + 0.5),
            width=width,
            n=n,
            n_null=null,
            n_zero=(self.underflow - self.negative).astype(np.int64),
            n_negative=self.negative.astype(np.int64),
            n_bad=bad,
            n_above=self.overflow,
        )

    def _at(self, position: npt.NDArray[Any]) -> Floats:
        low, high = (end[..., np.newaxis] for end in _axis_ends(self.scale, self.low, self.high))
        value = low + (high - low) * (position / self.counts.shape[-1])
        return np.asarray(np.exp(value) if self.scale == "log" else value)


@overload
def histogram(  # type: ignore[overload-overlap]  # a str is an ArrayLike, but no radiance
    x: ImageLike, *, scale: Scale = ..., bins: int = ..., support: GivenSupport | None = ...
) -> xr.Dataset: ...
@overload
def histogram(
    x: npt.ArrayLike,
    *,
    scale: Scale = ...,
    bins: int = ...,
    support: GivenSupport | None = ...,
    null: Mask | None = ...,
    bad: Mask | None = ...,
) -> Histogram: ...
def histogram(
    x: npt.ArrayLike | ImageLike,
    *,
    scale: Scale = "log",
    bins: int = 100,
    support: GivenSupport | None = None,
    null: Mask | None = None,
    bad: Mask | None = None,
) -> Histogram | xr.Dataset:
    """Count samples in evenly spaced bins of radiance or of its logarithm.

    Bin k of a linear histogram is [low + k w, low + (k + 1) w) with w = (high - low) / bins. A log
    histogram divides log10 of the radiance in the same way. Samples within rounding of an edge may
    fall on either side of it.

    Parameters
    ----------
    x
        Radiance, shape (..., sample); or the samples of an image, or the path of their store.
    scale
        Whether the bins divide the radiance or its logarithm evenly.
    bins
        Number of bins.
    support
        (low, high) in radiance, as numbers or arrays of shape (...); for an image, as numbers or
        one per channel. The default is [1e-5, 1e5] for the log scale, and `linear_support` of the
        first 50 draws for the linear scale.
    null
        Mask of the zeros that are null samples, broadcastable to `x`; by default, every zero is
        null. A sample is null if all its channels are 0, which an array does not show. A zero in
        another sample has no logarithm: on the log scale, it is underflow, as negative samples are.
    bad
        Mask of samples to leave out because one of their channels is bad, broadcastable to `x`. NaN
        and infinite numbers are always bad.

    Returns
    -------
    Histogram or xarray.Dataset
        `Histogram` for an array. For an image, a dataset with ``{scale}_counts`` (y, x, channel,
        bin); ``{scale}_underflow``, ``{scale}_overflow``, ``{scale}_negative``, ``{scale}_low``,
        ``{scale}_high`` and ``{scale}_reason`` (y, x, channel); and ``null_count`` and
        ``bad_count`` (y, x).

    Raises
    ------
    InputError
        If `x` has no samples, or the support, the bins or a mask do not fit.

    References
    ----------
    Elek, Thomas, Forbes, "Learning Patterns in Sample Distributions for Monte Carlo Variance
    Reduction", 2019.

    Examples
    --------
    >>> h = histogram([0.0, 0.2, 0.3, 5.0, 2e5], bins=10)
    >>> h.counts
    array([0, 0, 0, 0, 2, 1, 0, 0, 0, 0])
    >>> int(h.null_count), int(h.overflow)
    (1, 1)
    >>> h.centers[4:6].round(3)
    array([0.316, 3.162])
    """
    given = opened(x, dependent=True)
    if not isinstance(given, Samples):
        stream = StreamingHistogram(scale=scale, bins=bins, support=support)
        array = as_samples(given)
        if bad is None:
            warn_left_out(array)
        return stream.update(array, null=null, bad=bad).read()
    if null is not None or bad is not None:
        message = "null and bad are for arrays: Samples know which samples are null or bad"
        raise InputError(message)
    return _image_histogram(given, scale, bins, support)


class StreamingHistogram:
    """A histogram that takes its samples block by block and merges with others.

    The first block fixes the linear support, so it should hold 50 draws or more; otherwise, give a
    `support`. Only histograms with the same support merge.

    Parameters
    ----------
    scale, bins, support
        As for `histogram`.

    Examples
    --------
    >>> stream = StreamingHistogram(support=(0.1, 10), bins=2)
    >>> stream.update([0.5, 2.0]).update([3.0, 40.0]).read().counts
    array([1, 2])
    """

    def __init__(
        self, *, scale: Scale = "log", bins: int = 100, support: GivenSupport | None = None
    ) -> None:
        check_option("scale", scale, SCALES)
        if bins < 1:
            message = f"bins must be at least 1, got {bins}"
            raise InputError(message)
        self.scale: Scale = scale
        self.bins = bins
        self._given = LOG_SUPPORT if support is None and scale == "log" else support
        self._support: Support | None = None

    def _begin(self, support: GivenSupport, shape: tuple[int, ...]) -> Support:
        """Make empty bins for rows of this shape."""
        self._support = found = _checked_support(support, shape, self.scale)
        self._n = 0
        # Slots of every row: underflow, bins, overflow, bad.
        self._counts = np.zeros((found.low.size, self.bins + 3), dtype=np.int64)
        self._null_count, self._negative = np.zeros((2, *shape), dtype=np.int64)
        low, high = _axis_ends(self.scale, found.low.reshape(-1, 1), found.high.reshape(-1, 1))
        # Without a support, every sample is overflow, except the zeros of a log scale.
        self._origin = np.where(np.isnan(low), -np.inf if self.scale == "linear" else -1e30, low)
        with np.errstate(divide="ignore"):
            self._steps = np.where(np.isnan(low), np.inf, self.bins / (high - low))
        return found

    def update(
        self, x: npt.ArrayLike, *, null: Mask | None = None, bad: Mask | None = None
    ) -> StreamingHistogram:
        """Count the next samples, shape (..., sample); masks as for `histogram`."""
        block = as_samples(x)
        shape, n = block.shape[:-1], block.shape[-1]
        support = self._support
        if support is None:
            given = self._given or linear_support(block, null=null, bad=bad)
            support = self._begin(given, shape)
        if shape != support.low.shape:
            message = (
                f"every block must have the batch shape of the support, {support.low.shape}, "
                f"before its samples; got {shape}"
            )
            raise InputError(message)
        null, bad = _checked_masks(block, null, bad)
        # Nulls are zeros. Counting them where zeros fall and subtracting them is many times faster
        # than sorting them out one by one.
        nulls = np.broadcast_to(np.count_nonzero(null, axis=-1), shape)
        rows = block.reshape(-1, n)
        bads = None if bad is None else bad.reshape(-1, n)
        for part in chunks(len(rows), n):
            for columns in chunks(n, 1):
                some = None if bads is None else bads[part, columns]
                slots = self._slots(rows[part, columns], part, some)
                slots += np.arange(part.start, part.stop)[:, np.newaxis] * self._counts.shape[1]
                np.add.at(self._counts.reshape(-1), slots.ravel(), 1)
        zeros = np.zeros((len(rows), 1), block.dtype)
        self._counts[np.arange(len(rows)), self._slots(zeros, slice(None))[:, 0]] -= nulls.ravel()
        self._null_count += nulls
        if not block.min(initial=0) >= 0:
            negative = block < 0 if bad is None else (block < 0) & ~bad
            self._negative += np.count_nonzero(negative, axis=-1)
        self._n += n
        return self

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

    def merge(self, other: StreamingHistogram) -> StreamingHistogram:
        """Add the counts of `other`.

        Raises
        ------
        InputError
            If the two differ in scale, bins or support.
        """
        if (self.scale, self.bins) != (other.scale, other.bins):
            message = (
                f"histograms merge only with the same bins: these have {self.bins} {self.scale} "
                f"and {other.bins} {other.scale} bins"
            )
            raise InputError(message)
        theirs = other._support
        if theirs is None:
            return self
        mine = self._support or self._begin(self._given or theirs, theirs.low.shape)
        ends = (mine.low, theirs.low), (mine.high, theirs.high)
        if not all(np.array_equal(a, b, equal_nan=True) for a, b in ends):
            message = (
                "histograms merge only with the same support, and these differ; "
                "give both the support of the first draws (linear_support)"
            )
            raise InputError(message)
        self._counts += other._counts
        self._null_count += other._null_count
        self._negative += other._negative
        self._n += other._n
        return self

    def read(self) -> Histogram:
        """Return the histogram of all samples so far.

        Raises
        ------
        InputError
            If there are none.
        """
        if self._support is None:
            message = "the histogram has seen no samples; call update first"
            raise InputError(message)
        shape = self._support.low.shape
        counts = self._counts.reshape(*shape, self._counts.shape[-1]).copy()
        return Histogram(
            scale=self.scale,
            counts=counts[..., 1:-2],
            low=self._support.low,
            high=self._support.high,
            underflow=counts[..., 0],
            overflow=counts[..., -2],
            negative=self._negative.copy(),
            null_count=self._null_count.copy(),
            bad_count=counts[..., -1],
            reason=self._support.reason,
            n=self._n,
        )


def label_histogram(dataset: xr.Dataset, scale: Scale) -> xr.Dataset:
    """Give the variables of `Histogram.variables` names, units and a bin coordinate.

    The coordinate of log bins is their centre in radiance, if all pixels share one support. For
    other bins, it is their relative position in the support.
    """
    low, high = dataset[f"{scale}_low"], dataset[f"{scale}_high"]
    name = f"{scale}_bin"
    bins = dataset.sizes[name]
    center = (np.arange(bins) + 0.5) / bins
    described = {"long_name": "bin centre, relative to the support", "units": "1"}
    if scale == "log" and low.min() == low.max() and high.min() == high.max():
        start, stop = np.log(low.values.flat[0]), np.log(high.values.flat[0])
        center = np.exp(start + (stop - start) * center)
        described = {"long_name": "bin centre", "units": RADIANCE}
    labels = {
        name: (f"{scale} histogram: {about.label}", about.unit)
        for name, (_, about) in Histogram.declared(f"{scale}_").items()
    }
    label_variables(dataset, labels)
    return dataset.assign_coords({name: (name, center, described)})


def _image_histogram(
    samples: Samples, scale: Scale, bins: int, support: GivenSupport | None
) -> xr.Dataset:
    def of_tile(tile: Samples, blocks: SampleBlocks) -> Mapped:
        chosen = tile_support(tile) if support is None and scale == "linear" else support
        stream = StreamingHistogram(scale=scale, bins=bins, support=chosen)
        for block in blocks:
            null, bad = sample_masks(block)
            stream.update(block, null=null, bad=bad)
        read = stream.read()
        return {
            "null_count": ((), read.null_count[..., 0].astype(np.int32)),
            "bad_count": ((), read.bad_count[..., 0].astype(np.int32)),
            **read.variables(),
        }

    dataset = reduce_tiles(samples, of_tile, description=f"{scale} histograms")
    counted = {"null_count": "null samples", "bad_count": "bad samples"}
    return label_histogram(label_variables(dataset, counted), scale)
