"""Search for the best mixtures of 1, 2, ... components that EM finds, for all rows of a part.

`chdstat.fit.mixture` and `chdstat.modality` share `search`. Its objective is the likelihood of
samples, or of bins. EM works on groups of samples; where samples are at hand, solutions are judged
by them, and improved on them where the groups have blurred too much. Where only bins are, their
width is taken out again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from chdstat._core.arrays import spans, take_rows
from chdstat._core.positive import Counts, Floats, Mask
from chdstat.fit import em
from chdstat.fit.components import (
    COMPONENTS,
    ComponentFamily,
    MixtureFamily,
    Summaries,
    summaries_of_bins,
    summaries_of_each,
    summaries_of_samples,
)
from chdstat.summary.dispatch import Part, PositiveHistogram

__all__ = ["EFFORTS", "Effort", "Found", "Solution", "log_likelihood", "score", "search"]

_CHUNK = 2**17
"""Samples worked on at once: they stay in the cache."""
_TOLERANCE = 1e-6


Effort = Literal["fast", "thorough"]


@dataclass(frozen=True)
class Plan:
    """How hard to search.

    Attributes
    ----------
    rows
        Rows worked on at once: many, so that calls are few, but no more than the cache holds.
    groups
        Most equally filled groups of a row.
    windows
        Groups of window lengths, in groups, for inserted components.
    rounds
        (cycles, starts kept after them) before the final run of EM.
    cycles, tolerance
        Of the final run.
    loss
        Where groups lose more log-likelihood per sample than this, the run ends on the samples.
    sample_cycles
        Cycles of that.
    """

    rows: int
    groups: int
    windows: tuple[tuple[int, ...], ...]
    rounds: tuple[tuple[int, int], ...]
    cycles: int
    tolerance: float
    loss: float
    sample_cycles: int


EFFORTS: dict[Effort, Plan] = {
    "fast": Plan(
        rows=4096,
        groups=32,
        windows=((1, 2, 4), (8, 16)),
        rounds=((1, 1),),
        cycles=6,
        tolerance=2e-4,
        loss=np.inf,
        sample_cycles=0,
    ),
    "thorough": Plan(
        rows=512,
        groups=64,
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


@dataclass(frozen=True)
class Objective:
    """What a search maximises: the likelihood of samples, or of bins.

    Attributes
    ----------
    plan
        How hard to search.
    summaries
        What EM works on: summaries of samples, or bins as they are. Their likelihood is one of
        binned data: with corrected bins, EM would be rewarded for components that hide within one.
    corrected
        Groups as close to the samples as there are: bins with Sheppard's corrections.
    samples, n
        Logarithms of samples in ascending order, shape (row, sample), of which `n` count; None
        where only bins are.
    """

    plan: Plan
    summaries: Summaries
    corrected: Summaries
    samples: Floats | None = None
    n: Counts | None = None

    def take(self, rows: Counts) -> Objective:
        """Return some of the rows."""
        some = {name: value for name, value in vars(self).items() if name != "plan"}
        return Objective(self.plan, **take_rows(some, rows, axis=0))

    def maximise(self, family: ComponentFamily, state: Floats) -> Solution:
        """Run EM to the end of the plan, and judge where it ends by what is closest to the samples.

        Where groups lose more than the plan's `loss` per sample, EM goes on with the samples. Of
        bins, the last maximisation takes Sheppard's corrections into account. Moving the samples to
        the centres of bins costs all mixtures about the same, so the likelihoods are shifted by
        what it costs one component.
        """
        summaries, plan, origin = self.summaries, self.plan, self.summaries.origin
        if state.shape[1] == 1:
            # One component is at its maximum at once.
            there = np.ones(state.shape[-1], dtype=bool)
            end = em.Optimum(state, em.bound_at(summaries, family, state), there)
        else:
            end = em.run(summaries, family, state, cycles=plan.cycles, tolerance=plan.tolerance)
        if self.samples is None or self.n is None:
            shares = em.responsibilities(summaries, family, end.state)
            of_one, of_corrected = (
                em.bound_at(c, family, em.single(c, family)) for c in (summaries, self.corrected)
            )
            state = em.maximise(self.corrected, family, shares)
            shifted = end.bound + (of_corrected - of_one)
            return Solution(family, state, origin, shifted, end.converged)
        state, converged = end.state.copy(), end.converged.copy()
        if state.shape[1] == 1:
            # Without a choice of component, sums over groups are those over samples.
            return Solution(family, state, origin, end.bound, converged)
        value = log_likelihood(self.samples, self.n, family, state, origin)
        blurred = np.flatnonzero(value - end.bound > plan.loss * self.n)
        for piece in spans(len(blurred), _rows(self.samples)):
            rows = blurred[piece]
            singles = summaries_of_each(self.samples[rows], self.n[rows])
            further = em.run(
                singles, family, state[..., rows], cycles=plan.sample_cycles, tolerance=_TOLERANCE
            )
            state[..., rows], converged[rows] = further.state, further.converged
            value[rows] = em.bound_at(singles, family, further.state)
        return Solution(family, state, origin, value, converged)


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
            density = em.log_density(y, family.transform(y), coefficients[..., part])
        values[part] = np.vecdot(density, valid)
    return values


def _rows(samples: Floats) -> int:
    return max(1, _CHUNK // int(samples.shape[-1]))


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
        What was maximised.
    """

    rows: Counts
    solutions: list[Solution]
    objective: Objective

    @property
    def summaries(self) -> Summaries:
        """Groups of the rows, as close to the samples as there are."""
        return self.objective.corrected

    def also(self, family: MixtureFamily, rows: Counts) -> list[Solution]:
        """Fit another family to some of the rows, from where the solutions of this one are."""
        kind, objective, solutions = COMPONENTS[family], self.objective.take(rows), []
        for model in (solution.take(rows) for solution in self.solutions):
            shares = em.responsibilities(objective.summaries, model.family, model.state)
            start = em.maximise(objective.summaries, kind, shares)
            solution = objective.maximise(kind, start)
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
    unimodal: Floats | None = None,
) -> Iterator[Found]:
    """Fit mixtures of 1 to `max_k` components to the usable rows, piece by piece.

    `unimodal`, of the batch's shape, is the `score` of distributions of one mode. With it, rows
    where k >= 2 components beat neither that nor fewer components are not tried with more; the
    log-likelihood of what was not tried is minus infinity.
    """
    for rows, objective in _pieces(part, usable, EFFORTS[effort]):
        bar = None if unimodal is None else unimodal.reshape(-1)[rows]
        yield Found(rows, _fit(objective, COMPONENTS[family], max_k, bar), objective)


def score(solution: Solution, log_n: Floats) -> Floats:
    """Return log-likelihood less half of log n for each parameter, shape (row,)."""
    return np.asarray(solution.log_likelihood - 1.5 * solution.state.shape[1] * log_n)


def _pieces(part: Part, usable: Mask, plan: Plan) -> Iterator[tuple[Counts, Objective]]:
    """Yield pieces of rows of about the same length: little padding, the longest row last."""
    chosen = np.flatnonzero(usable.reshape(-1))
    n = part.n.reshape(-1)
    if isinstance(part, PositiveHistogram):
        counts, centers = (
            np.broadcast_to(v, part.counts.shape).reshape(-1, part.counts.shape[-1])
            for v in (part.counts, part.log_centers)
        )
        width = np.broadcast_to(part.width, part.n.shape).reshape(-1)
        lengths = np.count_nonzero(counts[chosen], axis=-1)
    else:
        ascending, lengths = part.log_sorted.reshape(-1, part.x.shape[-1]), n[chosen]
    ordered = chosen[np.argsort(lengths, kind="stable")]
    for piece in spans(len(ordered), plan.rows):
        rows = ordered[piece]
        if isinstance(part, PositiveHistogram):
            yield (
                rows,
                Objective(plan, *summaries_of_bins(counts[rows], centers[rows], width[rows])),
            )
        else:
            samples = ascending[rows, : n[rows[-1]]]
            summaries = summaries_of_samples(samples, n[rows], plan.groups)
            yield rows, Objective(plan, summaries, summaries, samples, n[rows])


def _fit(
    objective: Objective, family: ComponentFamily, max_k: int, unimodal: Floats | None
) -> list[Solution]:
    summaries, windows = objective.summaries, objective.plan.windows
    solutions = [objective.maximise(family, em.single(summaries, family))]
    rows, log_n = np.arange(len(summaries.n)), np.log(summaries.n)
    for k in range(2, max_k + 1):
        if unimodal is not None and k > 2:
            # One component more may pay where the last one did.
            scores = [score(solution, log_n) for solution in solutions]
            rows = np.flatnonzero(scores[-1] > np.maximum(unimodal, np.max(scores[:-1], axis=0)))
        here = objective if rows.size == len(summaries.n) else objective.take(rows)
        last = solutions[-1].state[..., rows]
        starts = [
            *em.segmentations(here.summaries, family, k),
            *em.insertions(here.summaries, family, last, windows),
            em.split(here.summaries, family, last),
        ]
        solution = here.maximise(family, _best_start(here, family, starts))
        solutions.append(_put_back(solution, rows, summaries.origin))
    return solutions


def _put_back(solution: Solution, rows: Counts, origin: Floats) -> Solution:
    """Return a solution with its rows where they belong, and none in the others."""
    if len(rows) == len(origin):
        return solution
    state = np.zeros((*solution.state.shape[:2], len(origin)))
    value = np.full(len(origin), -np.inf)
    converged = np.zeros(len(origin), dtype=bool)
    state[..., rows] = solution.state
    value[rows], converged[rows] = solution.log_likelihood, solution.converged
    return Solution(solution.family, state, origin, value, converged)


def _best_start(objective: Objective, family: ComponentFamily, states: list[Floats]) -> Floats:
    """Return the state that EM raises highest in a few cycles, row by row."""
    summaries, tolerance = objective.summaries, objective.plan.tolerance
    for cycles, kept in objective.plan.rounds:
        if len(states) == 1:
            break
        ends = [em.run(summaries, family, s, cycles=cycles, tolerance=tolerance) for s in states]
        ranked = np.argsort([-end.bound for end in ends], axis=0, kind="stable")[:kept]
        reached = np.stack([end.state for end in ends])
        states = [
            np.take_along_axis(reached, place[np.newaxis, np.newaxis, np.newaxis], axis=0)[0]
            for place in ranked
        ]
    return states[0]
