"""Search: the best mixtures of 1, 2, ... components that EM finds, for all rows of a part.

`search` is what `chdstat.fit.mixture` and `chdstat.modality` share.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from chdstat._arrays import spans
from chdstat._binned import BinnedPart
from chdstat._positive import Counts, Floats, Mask
from chdstat._routes import Part
from chdstat.fit._cells import Cells, cells_of_bins, cells_of_samples
from chdstat.fit._components import COMPONENTS, ComponentFamily, MixtureFamily
from chdstat.fit._em import Climb, bound_at, climb, maximise, responsibilities
from chdstat.fit._grounds import Bins, Ground, SampleRows, Solution
from chdstat.fit._starts import insertions, segmentations, single, split

__all__ = ["EFFORTS", "Effort", "Found", "score", "search"]

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
    ground
        What was climbed on.
    plan
        How hard it was searched.
    """

    rows: Counts
    solutions: list[Solution]
    ground: Ground
    plan: _Plan

    @property
    def cells(self) -> Cells:
        """Cells of the rows."""
        return self.ground.sharp

    def also(self, family: MixtureFamily, rows: Counts) -> list[Solution]:
        """Fit another family to some of the rows, from where the solutions of this one are."""
        kind, ground, solutions = COMPONENTS[family], self.ground.take(rows), []
        for model in (solution.take(rows) for solution in self.solutions):
            belonging = responsibilities(ground.cells, model.family, model.state)
            solution = _climb(ground, kind, maximise(ground.cells, kind, belonging), self.plan)
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
    for rows, ground in _pieces(part, usable, plan):
        bar = None if rival is None else rival.reshape(-1)[rows]
        yield Found(rows, _fit(ground, COMPONENTS[family], max_k, plan, bar), ground, plan)


def score(solution: Solution, n: Floats) -> Floats:
    """Return log-likelihood less half of log n for each parameter, shape (row,)."""
    parameters = 3 * solution.state.shape[1]
    return np.asarray(solution.log_likelihood - 0.5 * parameters * np.log(n))


def _pieces(part: Part, usable: Mask, plan: _Plan) -> Iterator[tuple[Counts, Ground]]:
    chosen = np.flatnonzero(usable.reshape(-1))
    if isinstance(part, BinnedPart):
        yield from _binned_pieces(part, chosen, plan)
        return
    n = part.n.reshape(-1)
    ascending = part.log_sorted.reshape(-1, part.x.shape[-1])
    for rows in _alike(chosen, n[chosen], plan):
        log_sorted = ascending[rows, : n[rows[-1]]]
        cells = cells_of_samples(log_sorted, n[rows], plan.cells)
        yield rows, SampleRows(cells, log_sorted, n[rows], plan.loss, plan.sample_cycles)


def _binned_pieces(
    part: BinnedPart, chosen: Counts, plan: _Plan
) -> Iterator[tuple[Counts, Ground]]:
    bins = part.counts.shape[-1]
    counts = part.counts.reshape(-1, bins)
    centers = np.broadcast_to(part.log_centers, part.counts.shape).reshape(-1, bins)
    width = np.broadcast_to(part.width, part.n.shape).reshape(-1)
    for rows in _alike(chosen, np.count_nonzero(counts[chosen], axis=-1), plan):
        yield rows, Bins(*cells_of_bins(counts[rows], centers[rows], width[rows]))


def _alike(rows: Counts, lengths: Counts, plan: _Plan) -> Iterator[Counts]:
    """Yield pieces of rows of about the same length: little padding, the longest row last."""
    ordered = rows[np.argsort(lengths, kind="stable")]
    for piece in spans(len(ordered), plan.rows):
        yield ordered[piece]


def _fit(
    ground: Ground, family: ComponentFamily, max_k: int, plan: _Plan, rival: Floats | None
) -> list[Solution]:
    solutions = [_climb(ground, family, single(ground.cells, family), plan)]
    rows = np.arange(len(ground.cells.n))
    for k in range(2, max_k + 1):
        if rival is not None and k > 2:
            rows = _worth_it(solutions, rival, ground.cells.n)
        here = ground if rows.size == len(ground.cells.n) else ground.take(rows)
        starts = [
            *segmentations(here.cells, family, k),
            *insertions(here.cells, family, solutions[-1].state[..., rows], plan.windows),
            split(here.cells, family, solutions[-1].state[..., rows]),
        ]
        solution = _climb(here, family, _choose(here.cells, family, starts, plan), plan)
        solutions.append(solution.put(rows, ground.cells.origin))
    return solutions


def _climb(ground: Ground, family: ComponentFamily, state: Floats, plan: _Plan) -> Solution:
    if state.shape[1] == 1:
        # One component is at its maximum at once.
        there = np.ones(state.shape[-1], dtype=bool)
        return ground.finish(family, Climb(state, bound_at(ground.cells, family, state), there))
    end = climb(ground.cells, family, state, cycles=plan.cycles, tolerance=plan.tolerance)
    return ground.finish(family, end)


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
