"""Search for the best mixtures of 1, 2, ... components that EM finds, for all rows of a part.

`chdstat.fit.mixture` and `chdstat.modality` share `search`, which maximises the likelihood of
samples, or of bins. EM works on groups of samples. If samples are at hand, they judge the
solutions, and EM goes on with them where the groups have blurred too much. If only bins are at
hand, their width is removed at the end.

Likelihoods of mixtures have many maxima. Three kinds of start, none of them random, find the best
one for nearly all pixels:

- cutting the row into k segments;
- inserting a component into a fit of k - 1 (greedy EM: Verbeek, Vlassis and Kröse, "Efficient
  greedy learning of Gaussian mixture models", 2003, doi:10.1162/089976603762553004), from narrow
  windows, for the spikes of renders, to wide ones;
- splitting the broadest component of that fit, for bodies beside spikes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from math import comb
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, chunks, spans
from chdstat._core.positive import Part, PositiveHistogram
from chdstat.fit import em
from chdstat.fit.em import COMPONENTS, ComponentFamily, MixtureFamily, Solution
from chdstat.fit.family import take_part
from chdstat.fit.groups import (
    SampleGroups,
    cumulative,
    groups_of_bins,
    groups_of_each,
    groups_of_samples,
    take_last,
)

_LEAST_MASS = 1e-300
_BINS = 16
"""Histograms are padded to a multiple of this many filled bins."""
_SAMPLE_CYCLES, _TOLERANCE = 40, 1e-6
"""Cycles and tolerance of EM on the samples themselves."""

Effort = Literal["fast", "thorough"]


@dataclass(frozen=True)
class Plan:
    """How hard to search.

    Attributes
    ----------
    rows
        Rows worked on at once: many, so that there are few calls, but no more than the cache holds.
    groups
        Most groups of a row, equally filled.
    windows
        Tuples of window lengths, in groups of samples, for inserted components.
    rounds
        (cycles, starts kept afterwards) before the final run of EM.
    cycles, tolerance
        Limits of the final run.
    loss
        Log-likelihood per sample that groups may lose; where they lose more, the run ends on
        samples.
    """

    rows: int
    groups: int
    windows: tuple[tuple[int, ...], ...]
    rounds: tuple[tuple[int, int], ...]
    cycles: int
    tolerance: float
    loss: float


EFFORTS: dict[Effort, Plan] = {
    "fast": Plan(
        rows=4096,
        groups=32,
        windows=((1, 2, 4), (8, 16)),
        rounds=((1, 1),),
        cycles=6,
        tolerance=2e-4,
        loss=np.inf,
    ),
    "thorough": Plan(
        rows=1024,
        groups=64,
        windows=((1,), (2,), (4,), (8,), (16,), (32,)),
        rounds=((4, 2), (8, 1)),
        cycles=60,
        tolerance=1e-6,
        loss=3e-3,
    ),
}
"""The plans of each `effort`."""


@dataclass(frozen=True)
class Piece:
    """Rows of a part, and the data whose likelihood a search maximises: samples or bins.

    Attributes
    ----------
    rows
        Which rows of the part, with its batch flattened.
    plan
        How hard to search.
    groups
        Data of EM: groups of samples, or bins as they are. The likelihood of binned data is right
        for bins: with corrected bins, EM would favour components that hide within one bin.
    corrected
        Groups as close to the samples as possible: for bins, with Sheppard's corrections.
    samples, n
        Logarithms of samples in ascending order, shape (row, sample), of which the first `n` count;
        None if there are only bins.
    width
        Width of the bins, shape (row,); None if there are samples.
    """

    rows: Counts
    plan: Plan
    groups: SampleGroups
    corrected: SampleGroups
    samples: Floats | None = None
    n: Counts | None = None
    width: Floats | None = None

    def take(self, at: npt.NDArray[Any]) -> Piece:
        """Select some of the rows."""
        samples, n, width = (v if v is None else v[at] for v in (self.samples, self.n, self.width))
        groups, corrected = self.groups.take(at), self.corrected.take(at)
        return Piece(self.rows[at], self.plan, groups, corrected, samples, n, width)

    def maximise(self, family: ComponentFamily, state: Floats) -> Solution:
        """Run EM to the end of the plan; return the likelihood closest to that of the samples."""
        cycles, tolerance = self.plan.cycles, self.plan.tolerance
        solution = em.run(self.groups, family, state, cycles=cycles, tolerance=tolerance)
        if state.shape[1] > 1:
            taken = em.penalty(family, solution.state, self.groups.spacing)
            solution = replace(solution, log_likelihood=solution.log_likelihood - taken)
        if self.width is not None:
            return self._of_bins(solution, self.width)
        if self.samples is None or self.n is None or state.shape[1] == 1:
            # Sums over groups are sums over samples.
            return solution
        return self._of_samples(solution, self.samples, self.n)

    def refit(self, family: MixtureFamily, solutions: list[Solution]) -> list[Solution]:
        """Fit another family, starting from the solutions of one."""
        kind, refitted = COMPONENTS[family], []
        for model in solutions:
            solution = self.maximise(kind, em.refit(self.groups, model, self.groups, kind))
            value = np.where(np.isinf(model.log_likelihood), -np.inf, solution.log_likelihood)
            refitted.append(replace(solution, log_likelihood=value))
        return refitted

    def _of_bins(self, solution: Solution, width: Floats) -> Solution:
        """Apply Sheppard's corrections in the last maximisation.

        The likelihood is that of the bins: the mass in each over its width.
        """
        family = solution.family
        state = em.refit(self.groups, solution, self.corrected, family)
        y, each = self.groups.log, state[:, :, np.newaxis]
        mass = np.exp(each[0]) * (family.cdf(y + width / 2, each) - family.cdf(y - width / 2, each))
        log = np.log(np.maximum(mass.sum(axis=0), _LEAST_MASS) / width)
        value = (self.groups.count * log).sum(axis=0)
        return replace(solution, state=state, log_likelihood=value)

    def _of_samples(self, solution: Solution, samples: Floats, n: Counts) -> Solution:
        """Continue on the samples where groups lose more than the plan's `loss` per sample."""
        family, state = solution.family, solution.state.copy()
        converged = solution.converged.copy()
        value = log_likelihood(samples, n, solution)
        blurred = np.flatnonzero(value - solution.log_likelihood > self.plan.loss * n)
        for piece in chunks(len(blurred), samples.shape[-1]):
            rows = blurred[piece]
            singles, start = groups_of_each(samples[rows], n[rows]), take_last(state, rows)
            further = em.run(singles, family, start, cycles=_SAMPLE_CYCLES, tolerance=_TOLERANCE)
            state[..., rows], converged[rows] = further.state, further.converged
            value[rows] = em.bound_at(singles, family, further.state)
        return replace(solution, state=state, log_likelihood=value, converged=converged)


def log_likelihood(log_sorted: Floats, n: Counts, solution: Solution) -> Floats:
    """Return the log-likelihood of log x of samples in ascending order, shape (row,)."""
    values, family = np.empty(len(n)), solution.family
    coefficients = family.coefficients(solution.state)[..., np.newaxis]
    for part in chunks(len(n), log_sorted.shape[-1]):
        valid = np.arange(log_sorted.shape[-1]) < n[part, np.newaxis]
        y = np.where(valid, log_sorted[part] - solution.origin[part, np.newaxis], 0.0)
        density = em.log_density(y, family.transform(y), coefficients[:, :, part])
        values[part] = np.vecdot(density, valid)
    return values


_FEW = 160
"""BIC is an expansion for many samples: with fewer than these, mixtures would fit chance."""


def log_samples(n: Counts | Floats) -> Floats:
    """Return the log n of a score, but at least that of 160 samples."""
    return np.asarray(np.log(np.maximum(n, _FEW)))


def score(solution: Solution, log_n: Floats) -> Floats:
    """Return the log-likelihood minus half of log n for each parameter, shape (row,)."""
    return np.asarray(solution.log_likelihood - 1.5 * solution.state.shape[1] * log_n)


def search(
    part: Part,
    usable: Mask,
    family: MixtureFamily,
    max_k: int,
    *,
    effort: Effort = "thorough",
    unimodal: Floats | None = None,
) -> Iterator[tuple[Piece, list[Solution]]]:
    """Fit mixtures of 1 to `max_k` components to the usable rows, piece by piece.

    `unimodal` is the `score` of distributions with one mode, with the batch's shape. If it is given
    and k >= 2 components beat neither it nor fewer components, the row is not tried with more.
    Solutions that were not tried have the log-likelihood minus infinity.
    """
    for piece in _pieces(part, np.flatnonzero(usable.reshape(-1)), EFFORTS[effort]):
        bar = None if unimodal is None else unimodal.reshape(-1)[piece.rows]
        yield piece, _solutions(piece, COMPONENTS[family], max_k, bar)


def _pieces(part: Part, rows: Counts, plan: Plan) -> Iterator[Piece]:
    """Cut rows into pieces of similar length, with little padding; the longest row is last."""
    if not isinstance(part, PositiveHistogram):
        rows = rows[np.argsort(part.n.reshape(-1)[rows], kind="stable")]
        for span in spans(len(rows), plan.rows):
            n = part.n.reshape(-1)[rows[span]]
            samples = part.log_sorted.reshape(-1, part.x.shape[-1])[rows[span], : n[-1]]
            groups = groups_of_samples(samples, n, plan.groups)
            yield Piece(rows[span], plan, groups, groups, samples, n)
        return
    # Starts depend on the number of groups, which must not depend on other rows.
    filled = np.count_nonzero(part.counts, axis=-1).reshape(-1)[rows]
    most = _BINS * -(-filled // _BINS)
    for width in np.unique(most).tolist():
        alike = rows[most == width]
        for span in spans(len(alike), plan.rows):
            some = take_part(part, alike[span])
            bins = groups_of_bins(some.counts, some.log_centers, some.width, width)
            yield Piece(alike[span], plan, *bins, width=some.width)


def _solutions(
    piece: Piece, family: ComponentFamily, max_k: int, unimodal: Floats | None
) -> list[Solution]:
    """Return the mixtures of 1, 2, ... components; untried ones are infinitely unlikely."""
    groups, windows, rows = piece.groups, piece.plan.windows, np.arange(len(piece.rows))
    below = sums_below(groups, family)
    # One component is a single segment.
    solutions = [piece.maximise(family, _state(groups, family, below[:, -1:]))]
    log_n = log_samples(groups.n)
    for k in range(2, max_k + 1):
        if unimodal is not None and k > 2:
            # One component more may pay where the last one did.
            scores = [score(solution, log_n) for solution in solutions]
            rows = np.flatnonzero(scores[-1] > np.maximum(unimodal, np.max(scores[:-1], axis=0)))
        here = piece if rows.size == len(piece.rows) else piece.take(rows)
        last, sums = take_last(solutions[-1].state, rows), take_last(below, rows)
        starts = [
            *segmentations(here.groups, family, sums, k),
            *_insertions(here.groups, family, sums, last, windows),
            _split(here.groups, family, last),
        ]
        found = here.maximise(family, _best_start(here, family, starts))
        if here is not piece:
            state = np.zeros((3, k, len(piece.rows)))
            value, converged = np.full(state.shape[-1], -np.inf), np.zeros(state.shape[-1], bool)
            state[..., rows] = found.state
            value[rows], converged[rows] = found.log_likelihood, found.converged
            found = Solution(family, state, groups.origin, value, converged)
        solutions.append(found)
    return solutions


def _best_start(piece: Piece, family: ComponentFamily, states: list[Floats]) -> Floats:
    """Return the state that EM raises highest in a few cycles, row by row."""
    groups, tolerance = piece.groups, piece.plan.tolerance
    for cycles, kept in piece.plan.rounds:
        if len(states) == 1:
            break
        ends = [em.run(groups, family, s, cycles=cycles, tolerance=tolerance) for s in states]
        ranked = np.argsort([-end.log_likelihood for end in ends], axis=0, kind="stable")[:kept]
        reached = np.stack([end.state for end in ends])
        states = [np.take_along_axis(reached, r.reshape(1, 1, 1, -1), axis=0)[0] for r in ranked]
    return states[0]


_CHOICES = 150
"""Most segmentations to compare."""
_LEAST = 1e-9
_APART, _NARROWER = 0.8, 0.6
"""Distance of the halves of a split component from it, and their spread, in units of its spread."""
_LARGEST = 0.9
"""Largest weight of an inserted component."""
_LOG_PEAK = -0.5 * (1 + np.log(2 * np.pi))
"""Mean log density of a Gaussian sample of variance 1, at maximum likelihood."""


def segmentations(
    groups: SampleGroups, family: ComponentFamily, below: Floats, k: int
) -> Iterator[Floats]:
    """Yield the best cut of each row into k segments, by two criteria, from its `sums_below`.

    The criteria are the likelihood of a Gaussian in each segment, which favours narrow segments,
    and the sum of squares within segments (k-means).
    """
    if len(groups.count) < k:
        return
    edges, (start, stop), segments = _cuts(len(groups.count), k)
    n, variance = below[0, stop] - below[0, start], _variance(below, groups.floor, start, stop)
    for value in (n * (np.log(n + _LEAST) - 0.5 * np.log(variance)), -n * variance):
        value[n < 1] = -np.inf
        best = sum((value[each] for each in segments[1:]), value[segments[0]]).argmax(axis=0)
        ends = below[:, edges[:, best], np.arange(len(best))]
        yield _state(groups, family, np.diff(ends, axis=1))


def _insertions(
    groups: SampleGroups,
    family: ComponentFamily,
    below: Floats,
    state: Floats,
    windows: tuple[tuple[int, ...], ...],
) -> Iterator[Floats]:
    """Yield, for each group of window lengths, the state with one more component.

    The component comes from the window of groups whose samples gain most from their own Gaussian.
    """
    coefficients = family.coefficients(state)[:, :, np.newaxis]
    old = em.log_density(groups.log, family.statistic(groups), coefficients)
    old_below = cumulative(groups.count * old, axis=0)
    for lengths in windows:
        start, stop = _best_window(below, old_below, groups.floor, lengths)
        ends = below[:, np.stack([start, stop]), np.arange(len(start))]
        sums = np.diff(ends, axis=1)
        share = np.clip(sums[0] / groups.n, _LEAST, _LARGEST)
        new = _state(groups, family, sums)
        new[0] = np.log(share)
        shrunk = state.copy()
        shrunk[0] += np.log1p(-share)
        yield np.concatenate([shrunk, new], axis=1)


def _split(groups: SampleGroups, family: ComponentFamily, state: Floats) -> Floats:
    """Return the state with its broadest component, by weight times spread, split into two.

    The halves lie 0.8 spreads to either side and have 0.6 of the spread, so that the mean and
    variance of both together stay about the same.
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
    return family.bounded(whole, groups.floor)


def _best_window(
    below: Floats, old_below: Floats, floor: Floats, lengths: tuple[int, ...]
) -> tuple[Counts, Counts]:
    last = below.shape[1] - 1
    best = np.full(len(floor), -np.inf)
    start, stop = np.zeros((2, len(floor)), dtype=np.int64)
    for length in (length for length in lengths if length <= last):
        a, b = slice(last - length + 1), slice(length, last + 1)
        n = below[0, b] - below[0, a]
        peak = _LOG_PEAK - 0.5 * np.log(_variance(below, floor, a, b))
        gain = n * (np.log(np.maximum(n, _LEAST) / below[0, -1]) + peak)
        gain -= old_below[b] - old_below[a]
        gain[n == 0] = -np.inf
        place, value = gain.argmax(axis=0), gain.max(axis=0)
        start = np.where(value > best, place, start)
        stop = np.where(value > best, place + length, stop)
        best = np.maximum(best, value)
    return start, stop


def _state(groups: SampleGroups, family: ComponentFamily, sums: Floats) -> Floats:
    """Return the state of components from their counts, sums of y and sums of t(y)."""
    n = np.maximum(sums[0], _LEAST)
    return em.state_of(family, n, sums[1] / n, sums[2] / n, groups.floor, groups.spacing)


def sums_below(groups: SampleGroups, family: ComponentFamily) -> Floats:
    """Return sums of 1, y, t(y) and y^2 over the groups below each edge, shape (4, edge, row)."""
    means = (1.0, groups.log, family.statistic(groups), groups.square)
    return np.stack([cumulative(groups.count * mean, axis=0) for mean in means])


def _variance(below: Floats, floor: Floats, start: Counts | slice, stop: Counts | slice) -> Floats:
    n, log, square = (below[i, stop] - below[i, start] for i in (0, 1, 3))
    np.maximum(n, _LEAST, out=n)
    square /= n
    log /= n
    square -= log * log
    return np.asarray(np.maximum(square, floor * floor))


@cache
def _cuts(groups: int, k: int) -> tuple[Counts, Counts, Counts]:
    """Return edges of k segments, on as fine a grid as there is time for, shape (k + 1, choice).

    Also return the start and stop of each segment that occurs, shape (2, segment), and the segments
    of each choice, shape (k, choice).
    """
    grid = next(g for g in range(groups - 1, 0, -1) if comb(g, k - 1) <= _CHOICES or g <= k)
    places = np.unique(np.linspace(1, groups - 1, grid).round().astype(np.int64))
    inner = np.array(list(combinations(places, k - 1))).T
    outer = np.zeros((1, inner.shape[-1]), dtype=np.int64)
    edges = np.concatenate([outer, inner, outer + groups])
    ends = np.stack([edges[:-1].reshape(-1), edges[1:].reshape(-1)])
    segments, which = np.unique(ends, axis=1, return_inverse=True)
    return edges, segments, which.reshape(k, -1)
