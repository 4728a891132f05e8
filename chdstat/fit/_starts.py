"""Starts: where the fits of k components begin; none of them is random.

Likelihoods of mixtures have many maxima. Three kinds of start find the best one of nearly all
pixels: cutting the row into k segments; inserting a component into a fit of k - 1 (greedy EM:
Verbeek, Vlassis and Kröse, "Efficient greedy learning of Gaussian mixture models", 2003,
doi:10.1162/089976603762553004), from narrow windows, for the spikes of renders, to wide ones; and
splitting the broadest component of that fit, for bodies beside spikes.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import combinations, pairwise
from math import comb

import numpy as np

from chdstat._positive import Counts, Floats
from chdstat.fit._cells import Cells
from chdstat.fit._components import ComponentFamily
from chdstat.fit._em import log_density

__all__ = ["insertions", "segmentations", "single", "split"]

_CHOICES = 150
"""Most segmentations that are compared."""
_LEAST = 1e-9
_APART, _NARROWER = 0.8, 0.6
"""Of the halves of a split component: their distance from it, and their spread, in spreads."""
_LARGEST = 0.9
"""Largest weight of an inserted component."""
_LOG_PEAK = -0.5 * (1 + np.log(2 * np.pi))
"""Mean log density of a Gaussian sample of variance 1, at maximum likelihood."""


def single(cells: Cells, family: ComponentFamily) -> Floats:
    """Return the state of one component, which is its fit."""
    below = _sums_below(cells, family)
    return _state(cells, family, below[:, :, -1:].transpose(0, 2, 1))


def segmentations(cells: Cells, family: ComponentFamily, k: int) -> Iterator[Floats]:
    """Yield the best cut of each row into k segments, by two criteria.

    The likelihood of a Gaussian for each segment, and the sum of squares within them (k-means):
    the first favours narrow segments.
    """
    if cells.count.shape[-1] < k:
        return
    below = _sums_below(cells, family)
    edges = _cuts(cells.count.shape[-1], k)
    sizes = [below[0][:, b] - below[0][:, a] for a, b in pairwise(edges)]
    spread = [_variance(below, cells.floor, a, b) for a, b in pairwise(edges)]
    pairs = list(zip(sizes, spread, strict=True))
    possible = np.where(np.min(sizes, axis=0) >= 1, 0.0, -np.inf)
    likelihood = sum((n * (np.log(n + _LEAST) - 0.5 * np.log(v)) for n, v in pairs), possible)
    compactness = sum((-n * v for n, v in pairs), possible)
    rows = np.arange(len(cells.floor))
    for score in (likelihood, compactness):
        chosen = edges[:, score.argmax(axis=-1)]
        ends = below[:, rows, chosen]
        yield _state(cells, family, np.diff(ends, axis=1))


def insertions(
    cells: Cells, family: ComponentFamily, state: Floats, groups: tuple[tuple[int, ...], ...]
) -> Iterator[Floats]:
    """Yield, for each group of window lengths, the state with one component more.

    It is that of the window, in cells, whose samples gain most from a Gaussian of their own.
    """
    below = _sums_below(cells, family)
    old = log_density(cells.log, family.statistic(cells), family.coefficients(state))
    old_below = _cumulative(cells.count * old)
    for group in groups:
        start, stop = _best_window(below, old_below, cells.floor, group)
        ends = np.stack([start, stop])
        sums = np.diff(below[:, np.arange(len(start)), ends], axis=1)
        share = np.clip(sums[0] / cells.n, _LEAST, _LARGEST)
        new = _state(cells, family, sums)
        new[0] = np.log(share)
        shrunk = state.copy()
        shrunk[0] += np.log1p(-share)
        yield np.concatenate([shrunk, new], axis=1)


def split(cells: Cells, family: ComponentFamily, state: Floats) -> Floats:
    """Return the state with its broadest component, by weight times spread, split into two.

    The halves lie 0.8 spreads to either side and have 0.6 of the spread, so that mean and variance
    of both together stay about the same.
    """
    spread = family.spread(state)
    rows = np.arange(state.shape[-1])
    broadest = (np.exp(state[0]) * spread).argmax(axis=0)
    log_weight, location, log_scale = state[:, broadest, rows]
    half = np.stack([log_weight - np.log(2), location, family.narrowed(log_scale, _NARROWER)])
    shift = np.zeros_like(half)
    shift[1] = _APART * spread[broadest, rows]
    whole = np.concatenate([state, (half + shift)[:, np.newaxis]], axis=1)
    whole[:, broadest, rows] = half - shift
    return family.bounded(whole, cells.floor)


def _best_window(
    below: Floats, old_below: Floats, floor: Floats, lengths: tuple[int, ...]
) -> tuple[Counts, Counts]:
    cells = below.shape[-1] - 1
    best = np.full(len(floor), -np.inf)
    start, stop = np.zeros((2, len(floor)), dtype=np.int64)
    for length in lengths:
        if length > cells:
            continue
        a, b = np.arange(cells - length + 1), np.arange(length, cells + 1)
        n = below[0][:, b] - below[0][:, a]
        peak = _LOG_PEAK - 0.5 * np.log(_variance(below, floor, a, b))
        share = np.maximum(n, _LEAST) / below[0][:, -1:]
        gain = n * (np.log(share) + peak) - (old_below[:, b] - old_below[:, a])
        gain[n == 0] = -np.inf
        place = gain.argmax(axis=-1)
        value = np.take_along_axis(gain, place[:, np.newaxis], axis=-1)[:, 0]
        start, stop = (np.where(value > best, p, q) for p, q in ((place, start), (b[place], stop)))
        best = np.maximum(best, value)
    return start, stop


def _state(cells: Cells, family: ComponentFamily, sums: Floats) -> Floats:
    """Return the state of components whose counts, sums of y and of t(y) are given."""
    n = np.maximum(sums[0], _LEAST)
    return family.maximise(n / cells.n, sums[1] / n, sums[2] / n, cells.floor)


def _sums_below(cells: Cells, family: ComponentFamily) -> Floats:
    """Return sums of 1, y, t(y) and y^2 over the cells below each edge, shape (4, row, edge)."""
    means = (1.0, cells.log, family.statistic(cells), cells.square)
    return np.stack([_cumulative(cells.count * mean) for mean in means])


def _cumulative(values: Floats) -> Floats:
    sums = np.zeros((values.shape[0], values.shape[1] + 1))
    np.cumsum(values, axis=-1, out=sums[:, 1:])
    return sums


def _variance(below: Floats, floor: Floats, start: Counts, stop: Counts) -> Floats:
    n, log, square = (below[i][:, stop] - below[i][:, start] for i in (0, 1, 3))
    np.maximum(n, _LEAST, out=n)
    square /= n
    log /= n
    square -= log * log
    return np.asarray(np.maximum(square, (floor * floor)[:, np.newaxis]))


@cache
def _cuts(cells: int, k: int) -> Counts:
    """Return edges of k segments, shape (k + 1, choice), on as fine a grid as there is time for."""
    grid = next(g for g in range(cells - 1, 0, -1) if comb(g, k - 1) <= _CHOICES or g <= k)
    places = np.unique(np.linspace(1, cells - 1, grid).round().astype(np.int64))
    inner = np.array(list(combinations(places, k - 1))).T
    outer = np.zeros((1, inner.shape[-1]), dtype=np.int64)
    return np.concatenate([outer, inner, outer + cells])
