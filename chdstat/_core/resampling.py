"""Intervals over the pixels of an image, which are many and not independent; and many p-values.

Multiple testing: q-values for p-values of many pixels, and Wilson's interval for a share. Block
bootstrap: neighbouring pixels see the same light, so that they are not independent draws. Blocks of
pixels are drawn with replacement instead, separately within each region.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from scipy import special, stats

from chdstat._core.arrays import Counts, Floats, block_numbers, generator, spans
from chdstat._core.display import NumberWriter, ends_in_words, number, with_interval, written

if TYPE_CHECKING:
    import xarray as xr

Z_95 = float(special.ndtri(0.975))
"""Standard errors on each side of a normal interval of 95 %."""


def q_values(p: npt.NDArray[np.floating[Any]]) -> Floats:
    """Return Benjamini-Hochberg q-values over the image, separately for each further axis.

    Among the pixels with q <= alpha, the expected share of false rejections is at most alpha.
    Pixels without a p-value (NaN) are ignored and stay NaN.

    Parameters
    ----------
    p
        p-values, shape (y, x, ...).

    References
    ----------
    Benjamini and Hochberg, "Controlling the false discovery rate: a practical and powerful
    approach to multiple testing", 1995, doi:10.1111/j.2517-6161.1995.tb02031.x.

    Examples
    --------
    >>> q_values(np.array([[0.01, np.nan], [0.04, 0.5]])).round(3)
    array([[0.03, nan], [0.06, 0.5 ]])
    """
    q = np.full(p.shape, np.nan)
    for index in np.ndindex(p.shape[2:]):
        here = (slice(None), slice(None), *index)
        tested = np.isfinite(p[here])
        if tested.any():
            adjusted = np.full(tested.shape, np.nan)
            adjusted[tested] = stats.false_discovery_control(p[here][tested])
            q[here] = adjusted
    return q


def rejections(q_value: xr.DataArray, alpha: float) -> xr.DataArray:
    """Return 1 where a q-value is at most `alpha`, 0 where it is not, NaN where nothing was tested.

    The mean is the share of rejections among the tested pixels.
    """
    rejected = (q_value <= alpha).astype(np.float32)
    return rejected.where(q_value.notnull()).drop_attrs()


def wilson(count: npt.NDArray[Any], n: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the 95 % Wilson score interval of a share, low and high on a new last axis.

    It is NaN where `n` is 0.

    References
    ----------
    Wilson, "Probable inference, the law of succession, and statistical inference", 1927,
    doi:10.1080/01621459.1927.10502953.

    Examples
    --------
    >>> wilson(np.array(10), np.array(20)).round(4)
    array([0.2993, 0.7007])
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.asarray(count / n)
        scale = 1 / (1 + Z_95**2 / n)
        centre = (share + Z_95**2 / (2 * n)) * scale
        half = Z_95 * np.sqrt(share * (1 - share) / n + (Z_95 / (2 * n)) ** 2) * scale
    # The interval ends at 0 and 1 there; rounding would put it a little inside or outside.
    low = np.where(share == 0, 0, centre - half)
    high = np.where(share == 1, 1, centre + half)
    return np.stack([low, high], axis=-1)


LEVEL = 0.95
"""Coverage of the intervals of a finding, all its parts together."""
_REPLICATES = 1000
_LEAST_BLOCKS = 6
"""Fewest blocks in all: fewer show nothing of their spread."""
_KNOWN = (0.05, 0.95)
"""Percentiles that the replicates give to a few per cent of the interval."""
_AT_ONCE = 64
_ACROSS = 4
"""Most blocks along each side of a region: pixels of one block share light."""


Value = TypeVar("Value")


@dataclass(frozen=True)
class Interval(Generic[Value]):
    """A number, or an array of numbers, with its interval; NaN if there is none.

    Attributes
    ----------
    value
        The statistic of all data, a float or an array.
    low, high
        Ends of the interval, with the shape of `value`.
    level
        Coverage of the interval.
    standard_error
        Standard deviation of the bootstrap replicates, with the shape of `value`; NaN if it was not
        computed.
    """

    value: Value
    low: Value
    high: Value
    level: float = LEVEL
    standard_error: Any = math.nan

    def __str__(self) -> str:
        if isinstance(self.value, np.ndarray):
            return f"{written(self.value)}, with intervals"
        ends: Any = self.value, self.low, self.high
        return with_interval(*ends)

    @staticmethod
    def unknown(value: float = math.nan, *, level: float = LEVEL) -> Interval[float]:
        """Return a number without an interval."""
        return Interval(value, math.nan, math.nan, level)

    def to_dict(self) -> dict[str, Value]:
        """Return the number and the ends of its interval by name."""
        return {"value": self.value, "low": self.low, "high": self.high}

    def ends(self: Interval[float], write: NumberWriter, *, beside: Sequence[float] = ()) -> str:
        """Return the ends in words, formatted by `write`; "" without an interval.

        None that lies beside one of the numbers `beside` is rounded to it.

        Examples
        --------
        >>> from chdstat._core.display import percent
        >>> Interval(1.0, 0.5, math.inf).ends(percent).replace("\N{NO-BREAK SPACE}", " ")
        '50 % or more'
        """
        return ends_in_words(self.low, self.high, write, beside=beside)

    def shown(
        self: Interval[float], write: NumberWriter = number, *, beside: Sequence[float] = ()
    ) -> str:
        """Return the value with its interval, with the digits that this supports."""
        return with_interval(self.value, self.low, self.high, write, beside=beside)

    def root(self: Interval[float]) -> Interval[float]:
        """Return the interval of the square root; squares that noise made negative give 0."""
        return Interval(_root(self.value), _root(self.low), _root(self.high), self.level)

    def map(self: Interval[Floats], change: Callable[[Floats], Floats]) -> Interval[Floats]:
        """Return the interval with a function applied to each of its arrays."""
        value, low, high = change(self.value), change(self.low), change(self.high)
        return Interval(value, low, high, self.level, change(self.standard_error))

    def __getitem__(self: Interval[Floats], index: Any) -> Interval[Floats]:
        """Return the part that `index` selects of every array."""
        return self.map(lambda part: part[index])


@dataclass(frozen=True)
class Blocks:
    """Pixels in blocks, blocks in regions.

    Attributes
    ----------
    of_pixel
        Block of each pixel, shape (pixel,).
    region
        Region of each block, shape (block,).
    """

    of_pixel: Counts
    region: Counts

    @classmethod
    def grid(cls, height: int, width: int, *, across: int = _ACROSS) -> Blocks:
        """Cut a rectangle of pixels, in reading order, into blocks of nearly equal size.

        Examples
        --------
        >>> Blocks.grid(2, 4, across=2).of_pixel
        array([0, 0, 1, 1, 2, 2, 3, 3])
        """
        of_pixel = block_numbers(height, width, across=across).ravel()
        return cls(of_pixel, np.zeros(min(height, across) * min(width, across), dtype=np.int64))

    @classmethod
    def strata(cls, height: int, width: int) -> Blocks:
        """Cut an image into regions, and each region into blocks.

        Of one image, what is asked is a number of this image, and not one of others like it. Parts
        of it that differ are then no chance: only what differs within a region is.

        Examples
        --------
        >>> blocks = Blocks.strata(64, 64)
        >>> len(blocks), len(np.unique(blocks.region))
        (256, 16)
        """
        rows, columns = (min(size, _ACROSS**2) for size in (height, width))
        of_pixel = block_numbers(height, width, across=_ACROSS**2).ravel()
        y = np.arange(rows) // _ACROSS
        x = np.arange(columns) // _ACROSS
        region = y[:, np.newaxis] * _ACROSS + x
        return cls(of_pixel, region.ravel())

    @classmethod
    def join(cls, parts: list[Blocks]) -> Blocks:
        """Concatenate the pixels of several regions."""
        firsts = np.cumsum([0, *(len(part.region) for part in parts)])
        return cls(
            np.concatenate([p.of_pixel + first for p, first in zip(parts, firsts, strict=False)]),
            np.concatenate([np.full(len(p.region), i) for i, p in enumerate(parts)]),
        )

    def __getitem__(self, pixels: Any) -> Blocks:
        """Return the blocks of some pixels, without empty blocks."""
        _, number = np.unique(self.of_pixel[pixels], return_inverse=True)
        return Blocks(number, self.region[np.unique(self.of_pixel[pixels])])

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self.region)

    def sums(self, values: npt.NDArray[Any]) -> Floats:
        """Return the sums of values (pixel, ...) over each block, shape (block, ...)."""
        flat = np.reshape(values, (len(values), math.prod(values.shape[1:])))
        columns = [np.bincount(self.of_pixel, column, len(self)) for column in flat.T]
        sums = np.stack(columns, axis=-1).reshape(len(self), *values.shape[1:])
        return np.asarray(sums, dtype=np.float64)

    def draw(self, replicates: int, rng: np.random.Generator) -> Floats:
        """Draw how often each block counts, shape (replicate, block)."""
        weights = np.zeros((replicates, len(self)))
        for region in np.unique(self.region):
            here = np.flatnonzero(self.region == region)
            weights[:, here] = rng.multinomial(
                len(here), np.full(len(here), 1 / len(here)), replicates
            )
        return weights


def interval_of(
    statistic: Callable[[Floats], Floats],
    blocks: Blocks,
    *,
    level: float = LEVEL,
    bounds: tuple[float, float] = (-math.inf, math.inf),
) -> Interval[float]:
    """Return a statistic of weighted blocks, or the least of several, with its interval.

    Percentile intervals of few blocks are too short, and a thousand replicates do not tell the
    extreme percentiles that they would need. The distances from the value to the percentiles at 5 %
    and 95 % keep the skew of the distribution. They are therefore stretched: with b blocks in r
    regions, by Student's t with b - r degrees of freedom at `level`, times sqrt(b / (b - r)), over
    1.645, the normal quantile at 95 %.

    The least of several noisy numbers is too small if they are nearly equal, and so are the
    percentiles of its replicates. The low end is therefore the least of the statistics' own low
    ends. It lies above the true least only if the low end of that statistic does. The high end is
    the least of high ends that hold for all statistics at once, from the largest of their
    deviations in each replicate.

    Parameters
    ----------
    statistic
        Maps how often each block counts, shape (replicate, block), to shape (replicate,), or to
        (replicate, statistic) for the least of several.
    blocks
        At least 6 blocks; with fewer, there is no interval.
    level
        Coverage.
    bounds
        Least and largest possible value of the statistic.

    References
    ----------
    Künsch, "The jackknife and the bootstrap for general stationary observations", 1989,
    doi:10.1214/aos/1176347265: blocks. Hesterberg, "What teachers should know about the
    bootstrap", 2015, doi:10.1080/00031305.2015.1089789: expanded percentiles, of which this is a
    variant. Berger, "Multiparameter hypothesis testing and acceptance sampling", 1982,
    doi:10.2307/1267823: the low end of the least of several. Romano and Wolf, "Stepwise multiple
    testing as formalized data snooping", 2005, doi:10.1111/j.1468-0262.2005.00615.x: its high end.

    Examples
    --------
    >>> blocks, values = Blocks.grid(4, 4), np.arange(16.0)
    >>> found = interval_of(lambda weights: weights @ values / 16, blocks)
    >>> found.value, found.low < 5.5, found.high > 9.5
    (7.5, True, True)
    """

    def of_replicates(weights: Floats) -> Floats:
        return statistic(weights).reshape(len(weights), -1)

    if not len(blocks):
        return Interval.unknown(level=level)
    with np.errstate(all="ignore"):
        values = of_replicates(np.ones((1, len(blocks))))[0].astype(np.float64)
        value = float(values.min())
        degrees = len(blocks) - len(np.unique(blocks.region))
        if len(blocks) < _LEAST_BLOCKS or degrees < 2 or not np.isfinite(values).all():
            return Interval.unknown(value, level=level)
        rng = generator(0)
        sizes = (part.stop - part.start for part in spans(_REPLICATES, _AT_ONCE))
        draws = np.concatenate([of_replicates(blocks.draw(size, rng)) for size in sizes])
    moves = draws[np.isfinite(draws).all(axis=1)] - values
    if len(moves) < _REPLICATES / 2:
        return Interval.unknown(value, level=level)
    # A statistic that resampling shifts as a whole must not lie outside its own interval.
    below, above = (
        np.maximum(side, 0) for side in np.quantile(moves, _KNOWN, axis=0) * [[-1], [1]]
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        largest = np.where(above > 0, moves / above, 0).max(axis=1)
    together = max(float(np.quantile(largest, _KNOWN[1])), 1.0)
    reach = float(stats.t.ppf((1 + level) / 2, degrees)) * math.sqrt(len(blocks) / degrees)
    stretch = reach / float(stats.norm.ppf(_KNOWN[1]))
    low, high = values - stretch * below, values + stretch * together * above
    return Interval(
        value, max(float(low.min()), bounds[0]), min(float(high.min()), bounds[1]), level
    )


def largest_of(
    statistics: Callable[[Floats], Floats], blocks: Blocks, *, level: float = LEVEL
) -> Interval[float]:
    """Return the largest of several statistics of weighted blocks; see `interval_of`."""
    least = interval_of(lambda weights: -statistics(weights), blocks, level=level)
    return Interval(-least.value, -least.high, -least.low, level)


def mean_of(values: npt.NDArray[Any], blocks: Blocks, *, level: float = LEVEL) -> Interval[float]:
    """Return the mean over pixels (pixel,) or (pixel, ...), ignoring NaN.

    Where all values are 0, or all are 1, they are a share, and blocks that are alike do not say how
    rare the others are. The open side is then that of a share that none of as many blocks shows.

    References
    ----------
    Clopper and Pearson, "The use of confidence or fiducial limits illustrated in the case of the
    binomial", 1934, doi:10.1093/biomet/26.4.404.

    Examples
    --------
    >>> round(float(mean_of(np.zeros(16), Blocks.grid(4, 4)).high), 2)
    0.21
    """
    values = values.reshape(len(values), math.prod(values.shape[1:]))
    known = np.isfinite(values)
    total = blocks.sums(np.where(known, values, 0).sum(axis=1))
    count = blocks.sums(known.sum(axis=1))
    least, most = _range(values)
    found = interval_of(
        lambda w: (w @ total) / (w @ count), blocks, level=level, bounds=(least, most)
    )
    if least == most and most in (0, 1):
        unseen = 1 - ((1 - level) / 2) ** (1 / np.count_nonzero(count))
        low, high = found.low - unseen * most, found.high + unseen * (1 - most)
        return replace(found, low=low, high=high)
    return found


def quantile_of(
    values: npt.NDArray[Any], blocks: Blocks, share: float = 0.5, *, level: float = LEVEL
) -> Interval[float]:
    """Return the quantile over pixels (pixel,) or (pixel, ...), ignoring NaN.

    Parameters
    ----------
    values, blocks, level
        As for `mean_of`.
    share
        Share of the values up to the quantile; a half for the median.
    """
    flat = np.asarray(values, dtype=np.float64).reshape(len(values), math.prod(values.shape[1:]))
    of_value = np.repeat(blocks.of_pixel, flat.shape[1])
    known = np.isfinite(flat.ravel())
    order = np.argsort(flat.ravel()[known], kind="stable")
    ordered, block = flat.ravel()[known][order], of_value[known][order]
    if not len(ordered):
        return Interval.unknown(level=level)

    def quantile(weights: Floats) -> Floats:
        total = np.cumsum(weights[:, block], axis=1)
        place = (total < share * total[:, -1:]).sum(axis=1)
        return np.asarray(ordered[np.minimum(place, len(ordered) - 1)])

    return interval_of(quantile, blocks, level=level, bounds=_range(ordered))


def _range(values: npt.NDArray[Any]) -> tuple[float, float]:
    """Return the smallest and largest value: no mean or quantile lies outside."""
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if known.size else (-math.inf, math.inf)


def _root(square: float) -> float:
    return math.sqrt(max(square, 0.0)) if math.isfinite(square) else square
