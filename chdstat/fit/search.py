"""Search for the best mixtures of 1, 2, ... components that EM finds, for all rows of a part.

`chdstat.fit.mixture` and `chdstat.modality` share `search`. Its objective is the likelihood of
samples, or of bins. EM works on weighted cells in place of the samples; where samples are at hand,
solutions are judged by them, and improved on them where the cells have blurred too much. Where only
bins are, their width is taken out again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from chdstat._core.arrays import spans
from chdstat._core.positive import Counts, Floats, Mask
from chdstat.fit.components import (
    COMPONENTS,
    Cells,
    ComponentFamily,
    MixtureFamily,
    cells_of_bins,
    cells_of_samples,
    single_cells,
)
from chdstat.fit.em import (
    Climb,
    bound_at,
    climb,
    insertions,
    log_density,
    maximise,
    responsibilities,
    segmentations,
    single,
    split,
)
from chdstat.summary.dispatch import Part
from chdstat.summary.positive_histogram import BinnedPart

__all__ = [
    "EFFORTS",
    "Bins",
    "Effort",
    "Found",
    "Objective",
    "SampleRows",
    "Solution",
    "log_likelihood",
    "score",
    "search",
]

_CHUNK = 2**17
"""Samples worked on at once: they stay in the cache."""
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Solution:
    """The best mixture found for a family and a number of components, for each row.

    Attributes
    ----------
    family
        Of the components.
    state
        As in `chdstat.fit.components`, shape (3, component, row).
    origin
        Of y = log x - origin, shape (row,).
    log_likelihood
        Of log x, shape (row,): without the Jacobian of the logarithm.
    converged
        Shape (row,).
    """

    family: ComponentFamily
    state: Floats
    origin: Floats
    log_likelihood: Floats
    converged: Mask

    def take(self, rows: Counts) -> Solution:
        """Return some of the rows."""
        return Solution(
            self.family,
            self.state[..., rows],
            self.origin[rows],
            self.log_likelihood[rows],
            self.converged[rows],
        )

    def put(self, rows: Counts, origin: Floats) -> Solution:
        """Return the solution with these rows where they belong, and no others."""
        if len(rows) == len(origin):
            return self
        state = np.zeros((*self.state.shape[:2], len(origin)))
        value = np.full(len(origin), -np.inf)
        converged = np.zeros(len(origin), dtype=bool)
        state[..., rows], value[rows], converged[rows] = (
            self.state,
            self.log_likelihood,
            self.converged,
        )
        return Solution(self.family, state, origin, value, converged)


class Objective(Protocol):
    """What a search climbs on."""

    @property
    def cells(self) -> Cells:
        """What to climb on."""

    @property
    def sharp(self) -> Cells:
        """Cells as close to the samples as there are."""

    def take(self, rows: Counts) -> Objective:
        """Return some of the rows."""

    def finish(self, family: ComponentFamily, end: Climb) -> Solution:
        """Turn where a climb ended into a solution."""


@dataclass(frozen=True)
class SampleRows:
    """Logarithms of samples in ascending order, of which `n` count, and their cells.

    Where the cells lose more than `loss` of log-likelihood per sample, the climb goes on for up to
    `cycles` on the samples.
    """

    cells: Cells
    log_sorted: Floats
    n: Counts
    loss: float
    cycles: int

    @property
    def sharp(self) -> Cells:
        """Cells as close to the samples as there are."""
        return self.cells

    def take(self, rows: Counts) -> SampleRows:
        """Return some of the rows."""
        cells, log_sorted, n = self.cells.take(rows), self.log_sorted[rows], self.n[rows]
        return SampleRows(cells, log_sorted, n, self.loss, self.cycles)

    def finish(self, family: ComponentFamily, end: Climb) -> Solution:
        """Climb on where cells are too coarse, and return the solution."""
        state, converged, origin = end.state.copy(), end.converged.copy(), self.cells.origin
        if state.shape[1] == 1:
            # Without a choice of component, sums over cells are those over samples.
            return Solution(family, state, origin, end.bound, converged)
        value = log_likelihood(self.log_sorted, self.n, family, state, origin)
        blurred = np.flatnonzero(value - end.bound > self.loss * self.n)
        for piece in spans(len(blurred), _rows(self.log_sorted)):
            rows = blurred[piece]
            singles = single_cells(self.log_sorted[rows], self.n[rows])
            further = climb(
                singles, family, state[..., rows], cycles=self.cycles, tolerance=_TOLERANCE
            )
            state[..., rows], converged[rows] = further.state, further.converged
            value[rows] = bound_at(singles, family, further.state)
        return Solution(family, state, origin, value, converged)


@dataclass(frozen=True)
class Bins:
    """Cells that are bins, and the same cells with Sheppard's corrections.

    EM climbs on the bins as they are, whose likelihood is one of binned data: with corrected ones,
    it would be rewarded for components that hide within a bin. The last maximisation takes the
    corrected ones. Moving the samples to the centres of bins costs all mixtures alike about the
    same, so the likelihoods are shifted by what it costs one component.
    """

    cells: Cells
    sharp: Cells

    def take(self, rows: Counts) -> Bins:
        """Return some of the rows."""
        return Bins(self.cells.take(rows), self.sharp.take(rows))

    def finish(self, family: ComponentFamily, end: Climb) -> Solution:
        """Take Sheppard's corrections into account, and return the solution."""
        state = maximise(self.sharp, family, responsibilities(self.cells, family, end.state))
        one, sharp_one = single(self.cells, family), single(self.sharp, family)
        shift = bound_at(self.sharp, family, sharp_one) - bound_at(self.cells, family, one)
        return Solution(family, state, self.cells.origin, end.bound + shift, end.converged)


def log_likelihood(
    log_sorted: Floats, n: Counts, family: ComponentFamily, state: Floats, origin: Floats
) -> Floats:
    """Return the log-likelihood of log x of samples in ascending order, shape (row,)."""
    values = np.empty(len(n))
    coefficients = family.coefficients(state)
    for part in spans(len(n), _rows(log_sorted)):
        valid = np.arange(log_sorted.shape[-1]) < n[part, np.newaxis]
        y = np.where(valid, log_sorted[part] - origin[part, np.newaxis], 0.0)
        with np.errstate(over="ignore"):
            density = log_density(y, family.transform(y), coefficients[..., part])
        values[part] = np.vecdot(density, valid)
    return values


def _rows(samples: Floats) -> int:
    return max(1, _CHUNK // int(samples.shape[-1]))


Effort = Literal["fast", "thorough"]


@dataclass(frozen=True)
class _Plan:
    """How hard to search.

    Attributes
    ----------
    rows
        Rows worked on at once: many, so that calls are few, but no more than the cache holds.
    cells
        Most equally filled cells of a row.
    windows
        Groups of window lengths, in cells, for inserted components.
    rounds
        (cycles, starts kept after them) before the final climb.
    cycles, tolerance
        Of the final climb.
    loss
        Where cells lose more log-likelihood per sample than this, the climb ends on the samples.
    sample_cycles
        Cycles of that.
    """

    rows: int
    cells: int
    windows: tuple[tuple[int, ...], ...]
    rounds: tuple[tuple[int, int], ...]
    cycles: int
    tolerance: float
    loss: float
    sample_cycles: int


EFFORTS: dict[Effort, _Plan] = {
    "fast": _Plan(
        rows=4096,
        cells=32,
        windows=((1, 2, 4), (8, 16)),
        rounds=((1, 1),),
        cycles=6,
        tolerance=2e-4,
        loss=np.inf,
        sample_cycles=0,
    ),
    "thorough": _Plan(
        rows=512,
        cells=64,
        windows=((1,), (2,), (4,), (8,), (16,), (32,)),
        rounds=((4, 2), (8, 1)),
        cycles=60,
        tolerance=1e-6,
        loss=3e-3,
        sample_cycles=40,
    ),
}
"""What `effort` stands for."""


@dataclass(frozen=True)
class Found:
    """Some rows, and their mixtures of 1, 2, ... components.

    Attributes
    ----------
    rows
        Which rows of the part, its batch flattened.
    solutions
        From one component up.
    objective
        What was climbed on.
    plan
        How hard it was searched.
    """

    rows: Counts
    solutions: list[Solution]
    objective: Objective
    plan: _Plan

    @property
    def cells(self) -> Cells:
        """Cells of the rows."""
        return self.objective.sharp

    def also(self, family: MixtureFamily, rows: Counts) -> list[Solution]:
        """Fit another family to some of the rows, from where the solutions of this one are."""
        kind, objective, solutions = COMPONENTS[family], self.objective.take(rows), []
        for model in (solution.take(rows) for solution in self.solutions):
            belonging = responsibilities(objective.cells, model.family, model.state)
            solution = _climb(
                objective, kind, maximise(objective.cells, kind, belonging), self.plan
            )
            value = np.where(np.isinf(model.log_likelihood), -np.inf, solution.log_likelihood)
            solutions.append(replace(solution, log_likelihood=value))
        return solutions


def search(
    part: Part,
    usable: Mask,
    family: MixtureFamily,
    max_k: int,
    *,
    effort: Effort = "thorough",
    rival: Floats | None = None,
) -> Iterator[Found]:
    """Fit mixtures of 1 to `max_k` components to the usable rows, piece by piece.

    `rival`, of the batch's shape, is the `score` that a mixture has to beat. With it, rows where
    k >= 2 components beat neither the rival nor fewer components are not tried with more; the
    log-likelihood of what was not tried is minus infinity.
    """
    plan = EFFORTS[effort]
    for rows, objective in _pieces(part, usable, plan):
        bar = None if rival is None else rival.reshape(-1)[rows]
        yield Found(rows, _fit(objective, COMPONENTS[family], max_k, plan, bar), objective, plan)


def score(solution: Solution, n: Floats) -> Floats:
    """Return log-likelihood less half of log n for each parameter, shape (row,)."""
    parameters = 3 * solution.state.shape[1]
    return np.asarray(solution.log_likelihood - 0.5 * parameters * np.log(n))


def _pieces(part: Part, usable: Mask, plan: _Plan) -> Iterator[tuple[Counts, Objective]]:
    chosen = np.flatnonzero(usable.reshape(-1))
    if isinstance(part, BinnedPart):
        yield from _binned_pieces(part, chosen, plan)
        return
    n = part.n.reshape(-1)
    ascending = part.log_sorted.reshape(-1, part.x.shape[-1])
    for rows in _similar_lengths(chosen, n[chosen], plan):
        log_sorted = ascending[rows, : n[rows[-1]]]
        cells = cells_of_samples(log_sorted, n[rows], plan.cells)
        yield rows, SampleRows(cells, log_sorted, n[rows], plan.loss, plan.sample_cycles)


def _binned_pieces(
    part: BinnedPart, chosen: Counts, plan: _Plan
) -> Iterator[tuple[Counts, Objective]]:
    bins = part.counts.shape[-1]
    counts = part.counts.reshape(-1, bins)
    centers = np.broadcast_to(part.log_centers, part.counts.shape).reshape(-1, bins)
    width = np.broadcast_to(part.width, part.n.shape).reshape(-1)
    for rows in _similar_lengths(chosen, np.count_nonzero(counts[chosen], axis=-1), plan):
        yield rows, Bins(*cells_of_bins(counts[rows], centers[rows], width[rows]))


def _similar_lengths(rows: Counts, lengths: Counts, plan: _Plan) -> Iterator[Counts]:
    """Yield pieces of rows of about the same length: little padding, the longest row last."""
    ordered = rows[np.argsort(lengths, kind="stable")]
    for piece in spans(len(ordered), plan.rows):
        yield ordered[piece]


def _fit(
    objective: Objective, family: ComponentFamily, max_k: int, plan: _Plan, rival: Floats | None
) -> list[Solution]:
    solutions = [_climb(objective, family, single(objective.cells, family), plan)]
    rows = np.arange(len(objective.cells.n))
    for k in range(2, max_k + 1):
        if rival is not None and k > 2:
            rows = _worth_it(solutions, rival, objective.cells.n)
        here = objective if rows.size == len(objective.cells.n) else objective.take(rows)
        starts = [
            *segmentations(here.cells, family, k),
            *insertions(here.cells, family, solutions[-1].state[..., rows], plan.windows),
            split(here.cells, family, solutions[-1].state[..., rows]),
        ]
        solution = _climb(here, family, _choose(here.cells, family, starts, plan), plan)
        solutions.append(solution.put(rows, objective.cells.origin))
    return solutions


def _climb(objective: Objective, family: ComponentFamily, state: Floats, plan: _Plan) -> Solution:
    if state.shape[1] == 1:
        # One component is at its maximum at once.
        there = np.ones(state.shape[-1], dtype=bool)
        return objective.finish(
            family, Climb(state, bound_at(objective.cells, family, state), there)
        )
    end = climb(objective.cells, family, state, cycles=plan.cycles, tolerance=plan.tolerance)
    return objective.finish(family, end)


def _worth_it(solutions: list[Solution], rival: Floats, n: Floats) -> Counts:
    """Return the rows where one component more may pay, given the scores so far."""
    scores = [score(solution, n) for solution in solutions]
    return np.flatnonzero(scores[-1] > np.maximum(rival, np.max(scores[:-1], axis=0)))


def _choose(cells: Cells, family: ComponentFamily, states: list[Floats], plan: _Plan) -> Floats:
    """Return the state that climbs highest in a few cycles, row by row."""
    for cycles, kept in plan.rounds:
        if len(states) == 1:
            break
        ends = [climb(cells, family, s, cycles=cycles, tolerance=plan.tolerance) for s in states]
        ranked = np.argsort([-end.bound for end in ends], axis=0, kind="stable")[:kept]
        reached = np.stack([end.state for end in ends])
        states = [
            np.take_along_axis(reached, place[np.newaxis, np.newaxis, np.newaxis], axis=0)[0]
            for place in ranked
        ]
    return states[0]
