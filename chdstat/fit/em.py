"""Expectation-maximisation: mixtures of exponential families, fitted to groups, all rows at once.

The responsibilities of a group are those of its mean sufficient statistics: of all that do not
differ within groups, they give the largest lower bound of the log-likelihood, and every step raises
it (Verbeek, Nunnink and Vlassis, "Accelerated EM-based clustering of large data sets", 2006,
doi:10.1007/s10618-005-0033-3). Steps are extrapolated by SQUAREM (Varadhan and Roland, "Simple and
globally convergent methods for accelerating the convergence of any EM algorithm", 2008,
doi:10.1111/j.1467-9469.2007.00585.x, scheme S3), which is undone wherever the bound falls.

Likelihoods of mixtures have many maxima. Three kinds of start, none of them random, find the best
one of nearly all pixels: cutting the row into k segments; inserting a component into a fit of k - 1
(greedy EM: Verbeek, Vlassis and Kröse, "Efficient greedy learning of Gaussian mixture models",
2003, doi:10.1162/089976603762553004), from narrow windows, for the spikes of renders, to wide ones;
and splitting the broadest component of that fit, for bodies beside spikes.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import combinations, pairwise
from math import comb
from typing import NamedTuple

import numpy as np

from chdstat._core.positive import Counts, Floats, Mask
from chdstat.fit.components import ComponentFamily, Summaries, cumulative

__all__ = [
    "Optimum",
    "bound_at",
    "insertions",
    "log_density",
    "maximise",
    "responsibilities",
    "run",
    "segmentations",
    "single",
    "split",
]

_LEAST_SIZE = 1e-10
"""Least share of a component, so that it keeps a place and a width."""
_VANISHING = -80.0
"""Log of a share that is as good as none."""
_REACH = 64.0
"""Longest extrapolation, in steps."""


class Optimum(NamedTuple):
    """Where EM ended: state (3, component, row), bound (row,), converged (row,)."""

    state: Floats
    bound: Floats
    converged: Mask


class _Data(NamedTuple):
    """What a step needs of groups: samples, y, t(y), shape (group, row); floor, n, shape (row,).

    There are many more rows than groups: with rows last, loops are long, and take half the time.
    """

    samples: Floats
    log: Floats
    statistic: Floats
    floor: Floats
    n: Floats

    @classmethod
    def of(cls, summaries: Summaries, family: ComponentFamily) -> _Data:
        by_group = (summaries.count, summaries.log, family.statistic(summaries))
        samples, log, statistic = (np.ascontiguousarray(values.T) for values in by_group)
        return cls(samples, log, statistic, summaries.floor, summaries.n)

    def take(self, rows: Mask) -> _Data:
        """Return some of the rows."""
        return _Data(*(values[..., rows] for values in self))


def run(
    summaries: Summaries, family: ComponentFamily, state: Floats, *, cycles: int, tolerance: float
) -> Optimum:
    """Raise the bound until a cycle of three steps gains less than `tolerance` per sample."""
    state = state.copy()
    bound = np.full(state.shape[-1], -np.inf)
    converged = np.zeros(state.shape[-1], dtype=bool)
    active = np.arange(state.shape[-1])
    data = _Data.of(summaries, family)
    for _ in range(cycles):
        # Extrapolation may leave the numbers; what it reached is then not taken.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            state[..., active], value = _cycle(data, family, state[..., active])
        done = value - bound[active] < tolerance * data.n
        bound[active], converged[active] = value, done
        if done.all():
            break
        # Leaving out rows costs a copy: it pays only for many of them.
        if 8 * np.count_nonzero(done) > done.size:
            active = active[~done]
            data = data.take(~done)
    return Optimum(state, bound, converged)


def responsibilities(summaries: Summaries, family: ComponentFamily, state: Floats) -> Floats:
    """Return how many samples of each group belong to each component, (component, row, group)."""
    return _expect(_Data.of(summaries, family), family.coefficients(state))[0].transpose(0, 2, 1)


def bound_at(summaries: Summaries, family: ComponentFamily, state: Floats) -> Floats:
    """Return the bound at a state: the log-likelihood of y, if each group is one sample."""
    return _expect(_Data.of(summaries, family), family.coefficients(state))[1]


def maximise(summaries: Summaries, family: ComponentFamily, shares: Floats) -> Floats:
    """Return the state of maximum likelihood, given responsibilities."""
    return _maximise(_Data.of(summaries, family), family, shares.transpose(0, 2, 1))


def log_density(log: Floats, statistic: Floats, coefficients: Floats) -> Floats:
    """Return the log density of y at groups or samples, shape (row, group)."""
    with np.errstate(over="ignore", invalid="ignore"):
        exponent, top = _exponents(log, statistic, coefficients[..., np.newaxis])
        total = np.log(np.exp(exponent, out=exponent).sum(axis=0))
        # Far beyond every component, all terms are minus infinity, and so is their sum.
        return np.where(top == -np.inf, -np.inf, total + top)


def _cycle(data: _Data, family: ComponentFamily, state: Floats) -> tuple[Floats, Floats]:
    """Take two steps, extrapolate them, and take a third one from there."""
    one, _ = _step(data, family, state)
    two, before = _step(data, family, one)
    far = _extrapolate(state, one, two)
    three, bound = _step(data, family, family.bounded(far, data.floor))
    fell = ~(bound >= before)
    three[..., fell] = two[..., fell]
    return three, np.where(fell, before, bound)


def _extrapolate(state: Floats, one: Floats, two: Floats) -> Floats:
    step = one - state
    change = two - one - step
    length = np.sqrt((step * step).sum(axis=(0, 1)) / (change * change).sum(axis=(0, 1)))
    length = np.clip(np.nan_to_num(length, nan=1.0), 1.0, _REACH)
    far = np.asarray(state + 2 * length * step + length**2 * change)
    far[0] -= far[0].max(axis=0)
    far[0] -= np.log(np.exp(far[0]).sum(axis=0))
    return far


def _step(data: _Data, family: ComponentFamily, state: Floats) -> tuple[Floats, Floats]:
    """Return the next state, and the bound at this one."""
    shares, bound = _expect(data, family.coefficients(state))
    return _maximise(data, family, shares), bound


def _expect(data: _Data, coefficients: Floats) -> tuple[Floats, Floats]:
    """Return responsibilities, shape (component, group, row), and the bound."""
    exponent, top = _exponents(data.log, data.statistic, coefficients[:, :, np.newaxis])
    shares = np.exp(exponent, out=exponent)
    total = shares.sum(axis=0)
    shares *= data.samples / total
    np.log(total, out=total)
    total += top
    total *= data.samples
    return shares, total.sum(axis=0)


def _exponents(log: Floats, statistic: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Return the logs of weight times density of the components less their largest, and that."""
    constant, slope, curvature = coefficients
    # In this order, or else sums over components and groups take several times as long.
    exponent = np.multiply(slope, log, order="C")
    exponent += np.multiply(curvature, statistic, order="C")
    exponent += constant
    top = exponent.max(axis=0)
    exponent -= top
    # The exponential function is slow where it vanishes.
    np.maximum(exponent, _VANISHING, out=exponent)
    return exponent, top


def _maximise(data: _Data, family: ComponentFamily, shares: Floats) -> Floats:
    sizes = np.maximum(shares.sum(axis=1), _LEAST_SIZE)
    log = np.einsum("kcr,cr->kr", shares, data.log) / sizes
    statistic = np.einsum("kcr,cr->kr", shares, data.statistic) / sizes
    return family.maximise(sizes / data.n, log, statistic, data.floor)


_CHOICES = 150
"""Most segmentations that are compared."""
_LEAST = 1e-9
_APART, _NARROWER = 0.8, 0.6
"""Of the halves of a split component: their distance from it, and their spread, in spreads."""
_LARGEST = 0.9
"""Largest weight of an inserted component."""
_LOG_PEAK = -0.5 * (1 + np.log(2 * np.pi))
"""Mean log density of a Gaussian sample of variance 1, at maximum likelihood."""


def single(summaries: Summaries, family: ComponentFamily) -> Floats:
    """Return the state of one component, which is its fit."""
    below = _sums_below(summaries, family)
    return _state(summaries, family, below[:, :, -1:].transpose(0, 2, 1))


def segmentations(summaries: Summaries, family: ComponentFamily, k: int) -> Iterator[Floats]:
    """Yield the best cut of each row into k segments, by two criteria.

    The likelihood of a Gaussian for each segment, and the sum of squares within them (k-means):
    the first favours narrow segments.
    """
    if summaries.count.shape[-1] < k:
        return
    below = _sums_below(summaries, family)
    edges = _cuts(summaries.count.shape[-1], k)
    sizes = [below[0][:, b] - below[0][:, a] for a, b in pairwise(edges)]
    spread = [_variance(below, summaries.floor, a, b) for a, b in pairwise(edges)]
    pairs = list(zip(sizes, spread, strict=True))
    possible = np.where(np.min(sizes, axis=0) >= 1, 0.0, -np.inf)
    likelihood = sum((n * (np.log(n + _LEAST) - 0.5 * np.log(v)) for n, v in pairs), possible)
    compactness = sum((-n * v for n, v in pairs), possible)
    rows = np.arange(len(summaries.floor))
    for score in (likelihood, compactness):
        chosen = edges[:, score.argmax(axis=-1)]
        ends = below[:, rows, chosen]
        yield _state(summaries, family, np.diff(ends, axis=1))


def insertions(
    summaries: Summaries,
    family: ComponentFamily,
    state: Floats,
    windows: tuple[tuple[int, ...], ...],
) -> Iterator[Floats]:
    """Yield, for each group of window lengths, the state with one component more.

    It is that of the window, in groups, whose samples gain most from a Gaussian of their own.
    """
    below = _sums_below(summaries, family)
    old = log_density(summaries.log, family.statistic(summaries), family.coefficients(state))
    old_below = cumulative(summaries.count * old)
    for lengths in windows:
        start, stop = _best_window(below, old_below, summaries.floor, lengths)
        ends = np.stack([start, stop])
        sums = np.diff(below[:, np.arange(len(start)), ends], axis=1)
        share = np.clip(sums[0] / summaries.n, _LEAST, _LARGEST)
        new = _state(summaries, family, sums)
        new[0] = np.log(share)
        shrunk = state.copy()
        shrunk[0] += np.log1p(-share)
        yield np.concatenate([shrunk, new], axis=1)


def split(summaries: Summaries, family: ComponentFamily, state: Floats) -> Floats:
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
    return family.bounded(whole, summaries.floor)


def _best_window(
    below: Floats, old_below: Floats, floor: Floats, lengths: tuple[int, ...]
) -> tuple[Counts, Counts]:
    groups = below.shape[-1] - 1
    best = np.full(len(floor), -np.inf)
    start, stop = np.zeros((2, len(floor)), dtype=np.int64)
    for length in lengths:
        if length > groups:
            continue
        a, b = np.arange(groups - length + 1), np.arange(length, groups + 1)
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


def _state(summaries: Summaries, family: ComponentFamily, sums: Floats) -> Floats:
    """Return the state of components whose counts, sums of y and of t(y) are given."""
    n = np.maximum(sums[0], _LEAST)
    return family.maximise(n / summaries.n, sums[1] / n, sums[2] / n, summaries.floor)


def _sums_below(summaries: Summaries, family: ComponentFamily) -> Floats:
    """Return sums of 1, y, t(y) and y^2 over the groups below each edge, shape (4, row, edge)."""
    means = (1.0, summaries.log, family.statistic(summaries), summaries.square)
    return np.stack([cumulative(summaries.count * mean) for mean in means])


def _variance(below: Floats, floor: Floats, start: Counts, stop: Counts) -> Floats:
    n, log, square = (below[i][:, stop] - below[i][:, start] for i in (0, 1, 3))
    np.maximum(n, _LEAST, out=n)
    square /= n
    log /= n
    square -= log * log
    return np.asarray(np.maximum(square, (floor * floor)[:, np.newaxis]))


@cache
def _cuts(groups: int, k: int) -> Counts:
    """Return edges of k segments, shape (k + 1, choice), on as fine a grid as there is time for."""
    grid = next(g for g in range(groups - 1, 0, -1) if comb(g, k - 1) <= _CHOICES or g <= k)
    places = np.unique(np.linspace(1, groups - 1, grid).round().astype(np.int64))
    inner = np.array(list(combinations(places, k - 1))).T
    outer = np.zeros((1, inner.shape[-1]), dtype=np.int64)
    return np.concatenate([outer, inner, outer + groups])
