"""Summaries and components: what mixtures are fitted to, and the families that they are made of.

Summaries describe groups of neighbouring samples. What an exponential family needs of a group is
its size and the means of its sufficient statistics. With a bounded number of groups per pixel, the
cost of a fit does not depend on spp; with groups as narrow as the samples are dense, hardly
anything is lost. The bins of a log histogram are groups, too.

The density of y = log x of a component is ``exp(a0 + a1 y + a2 t(y))``, with t(y) = y^2 for a
log-normal component and t(y) = exp(y) for a gamma one. Its state is (log weight, location, log
scale): mean and log standard deviation of y for log-normal, log mean of x and log shape for gamma
components. States and coefficients have shape (3, component, row).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from scipy import special

from chdstat._core.arrays import spans, take_rows
from chdstat._core.positive import Counts, Floats
from chdstat.fit._gamma import gap_of_shape

__all__ = [
    "COMPONENTS",
    "SPREAD_FLOOR",
    "ComponentFamily",
    "MixtureFamily",
    "Summaries",
    "cumulative",
    "summaries_of_bins",
    "summaries_of_each",
    "summaries_of_samples",
]

SPREAD_FLOOR = 1e-3
"""Least standard deviation of a component in log x: its square is scikit-learn's `reg_covar`."""

_ENDS = 4
"""Samples at each end of a row that are groups by themselves: tails are sparse."""
_SPIKE_EDGES = 4
"""Edges of groups that are set where spikes begin and end."""
_CHUNK = 2**17
"""Samples worked on at once: they stay in the cache."""


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
    """

    count: Floats
    log: Floats
    square: Floats
    ratio: Floats
    origin: Floats
    floor: Floats

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
    step = max(1, _CHUNK // log_sorted.shape[-1])
    pieces = []
    for part in spans(len(n), step):
        y, origin = _relative(log_sorted[part], n[part])
        edges = _edges(y, n[part], most)
        count = np.diff(edges, axis=-1).astype(np.float64)
        below = (np.take_along_axis(cumulative(v), edges, axis=-1) for v in (y, y * y, np.exp(y)))
        means = (np.diff(sums, axis=-1) / np.maximum(count, 1) for sums in below)
        pieces.append((count, *means, origin))
    count, log, square, ratio, origin = map(np.concatenate, zip(*pieces, strict=True))
    return Summaries(count, log, square, ratio, origin, np.full(len(n), SPREAD_FLOOR))


def summaries_of_each(log_sorted: Floats, n: Counts) -> Summaries:
    """Make each sample a group, which loses nothing; arguments as of `summaries_of_samples`."""
    y, origin = _relative(log_sorted, n)
    count = (np.arange(log_sorted.shape[-1]) < n[:, np.newaxis]).astype(np.float64)
    return Summaries(count, y, y * y, np.exp(y), origin, np.full(len(n), SPREAD_FLOOR))


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
    as_they_are = Summaries(count, y, square, ratio, origin[:, 0], least)
    ratio = ratio * (h / 2) / np.sinh(h / 2)
    return as_they_are, Summaries(count, y, square - h * h / 12, ratio, origin[:, 0], corrected)


def _relative(log_sorted: Floats, n: Counts) -> tuple[Floats, Floats]:
    """Return y = log x - origin, 0 beyond the samples, and the origin: the largest log x."""
    origin = np.take_along_axis(log_sorted, n[:, np.newaxis] - 1, axis=-1)
    valid = np.arange(log_sorted.shape[-1]) < n[:, np.newaxis]
    return np.where(valid, log_sorted - origin, 0.0), origin[:, 0]


def _edges(y: Floats, n: Counts, most: int) -> Counts:
    """Return where groups begin and end, shape (row, edge)."""
    step = 2 ** np.maximum(np.ceil(np.log2(np.maximum(n, 1) / most)), 0).astype(np.int64)
    gaps = np.zeros(y.shape)
    np.subtract(y[:, 1:], y[:, :-1], out=gaps[:, 1:])
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
    padded = np.zeros((rows, runs * width))
    kept = min(samples, runs * width)
    padded[:, :kept] = gaps[:, :kept]
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


def cumulative(values: Floats) -> Floats:
    """Return sums of the values before each, and of all of them, shape (row, value + 1)."""
    sums = np.zeros((values.shape[0], values.shape[1] + 1))
    np.cumsum(values, axis=-1, out=sums[:, 1:])
    return sums


MixtureFamily = Literal["lognormal", "gamma"]

_DARKEST = 1e-280
"""Least mean of exp(y) of a component: a component without samples keeps a finite state."""
_LOG_ROOT_TAU = 0.5 * np.log(2 * np.pi)


@dataclass(frozen=True)
class ComponentFamily:
    """An exponential family of components.

    Attributes
    ----------
    name
        What users call it.
    statistic
        Mean of t(y) per group.
    transform
        t(y) itself.
    maximise
        State of maximum likelihood from the share of samples, mean y and mean t(y) of each
        component, and the least spread of a component.
    coefficients
        (a0 + log weight, a1, a2) of a state.
    bounded
        The state with its log scale moved to where the spread is at least the floor.
    spread
        About the standard deviation of y of each component, shape (component, row).
    narrowed
        The log scale of components of a given part of the spread.
    """

    name: MixtureFamily
    statistic: Callable[[Summaries], Floats]
    transform: Callable[[Floats], Floats]
    maximise: Callable[[Floats, Floats, Floats, Floats], Floats]
    coefficients: Callable[[Floats], Floats]
    bounded: Callable[[Floats, Floats], Floats]
    spread: Callable[[Floats], Floats]
    narrowed: Callable[[Floats, float], Floats]


def _maximise_lognormal(share: Floats, log: Floats, square: Floats, floor: Floats) -> Floats:
    variance = np.maximum(square - log * log, floor * floor)
    return np.stack([np.log(share), log, 0.5 * np.log(variance)])


def _lognormal_coefficients(state: Floats) -> Floats:
    log_weight, mean, log_deviation = state
    precision = np.exp(-2 * log_deviation)
    constant = log_weight - log_deviation - _LOG_ROOT_TAU - 0.5 * precision * mean * mean
    return np.stack([constant, precision * mean, -0.5 * precision])


def _bounded_lognormal(state: Floats, floor: Floats) -> Floats:
    return np.stack([state[0], state[1], np.maximum(state[2], np.log(floor))])


def _maximise_gamma(share: Floats, log: Floats, ratio: Floats, floor: Floats) -> Floats:
    log_mean = np.log(np.maximum(ratio, _DARKEST))
    # The variance of y is near 1 / shape, and the gap near 1 / (2 shape), where both are small.
    gap = np.maximum(log_mean - log, 0.5 * floor * floor)
    return np.stack([np.log(share), log_mean, _log_shape(gap)])


def _gamma_coefficients(state: Floats) -> Floats:
    log_weight, log_mean, log_shape = state
    shape = np.exp(log_shape)
    constant = log_weight - special.gammaln(shape) + shape * (log_shape - log_mean)
    return np.stack([constant, shape, -np.exp(log_shape - log_mean)])


def _bounded_gamma(state: Floats, floor: Floats) -> Floats:
    return np.stack([state[0], state[1], np.minimum(state[2], -2 * np.log(floor))])


def _log_shape(gap: Floats) -> Floats:
    """Solve log(k) - digamma(k) = gap for log(k), to 1e-7, by interpolation in a table."""
    return np.interp(np.log(gap), *_log_gaps_and_shapes())


@cache
def _log_gaps_and_shapes() -> tuple[Floats, Floats]:
    log_shape = np.linspace(np.log(2 / SPREAD_FLOOR**2), np.log(1e-4), 16384)
    return np.log(gap_of_shape(np.exp(log_shape))), log_shape


COMPONENTS = {
    family.name: family
    for family in (
        ComponentFamily(
            name="lognormal",
            statistic=lambda summaries: summaries.square,
            transform=np.square,
            maximise=_maximise_lognormal,
            coefficients=_lognormal_coefficients,
            bounded=_bounded_lognormal,
            spread=lambda state: np.exp(state[2]),
            narrowed=lambda log_deviation, part: log_deviation + np.log(part),
        ),
        ComponentFamily(
            name="gamma",
            statistic=lambda summaries: summaries.ratio,
            transform=np.exp,
            maximise=_maximise_gamma,
            coefficients=_gamma_coefficients,
            bounded=_bounded_gamma,
            spread=lambda state: np.exp(-0.5 * state[2]),
            narrowed=lambda log_shape, part: log_shape - 2 * np.log(part),
        ),
    )
}
"""Families of components by name."""
