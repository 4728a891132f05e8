"""Peaks: the modes of fitted mixtures in log radiance, and how far they are separated.

A component makes a mode of its own where its weight is at least `LEAST_WEIGHT` and, on the way to
every higher mode, the density falls below `_DEPTH` of its height; otherwise it belongs to the mode
that it is least separated from. The covariance of the parameters gives the separation's error.

The peaks of a row are those of the mixture of 2 or more log-normal or gamma components that has the
smallest BIC, unless a single family describes it better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask
from chdstat._core.positive import PositivePart
from chdstat.fit import em
from chdstat.fit.em import Solution
from chdstat.fit.groups import Summaries
from chdstat.fit.mixture_errors import covariance, directions
from chdstat.fit.search import Found, log_samples, score, search
from chdstat.fit.unimodal_bic import edge_scores

__all__ = ["LEAST_WEIGHT", "best_peaks"]

_DEPTH = 0.98
"""A valley is a valley where the density falls below this share of the lower peak."""
LEAST_WEIGHT = 0.08
"""Least weight of a component that makes a mode: a few outliers are none."""

_CYCLES, _TOLERANCE = 40, 1e-6
"""Of the run of EM that goes on where there is more than one mode."""
_STEP = 1e-4
"""Of a parameter, for a derivative."""

_FEW = 70
"""Among few samples, modes are found where they happen to look separate: errors count as
``1 + (70/n)^2`` times as large, so that 1.96 of them hold the separation in 90 % of those that are
found, as ``tests/benchmarks/test_modes.py`` prints."""

_EVEN = np.linspace(0, 1, 34)[1:-1, np.newaxis]
_NEAR = np.array([0.5, 1.0, 2.0, 3.0, 4.0])[:, np.newaxis]


def _peaks_of(solution: Solution, summaries: Summaries) -> tuple[Counts, Floats]:
    """Count the modes of mixtures, and measure their separation.

    Returns
    -------
    ndarray
        Modes, shape (row,).
    ndarray
        The `_FIELDS` of each mode, shape (field, row, component), the darkest first; NaN beyond
        those that there are. The last separation is not used.
    """
    owner = _owners(solution)
    modes = np.count_nonzero(owner == np.arange(len(owner))[:, np.newaxis], axis=0)
    several = np.flatnonzero(modes > 1)
    some = summaries.take(several)
    if several.size:
        # A few steps count modes, but their places and widths would still move.
        state, family = solution.state.copy(), solution.family
        further = em.run(some, family, state[..., several], cycles=_CYCLES, tolerance=_TOLERANCE)
        state[..., several] = further.state
        solution = replace(solution, state=state)
    share, moments = np.exp(solution.state[0]), solution.family.moments(solution.state)
    mean, variance, weight = _of_modes(owner, share, *moments)
    weight = np.where(weight > 0, weight, np.nan)
    place = np.where(weight > 0, solution.state[1], np.nan)
    order = np.argsort(place, axis=0)
    place, weight, mean, variance = (
        np.take_along_axis(v, order, axis=0) for v in (place, weight, mean, variance)
    )
    fields = np.full((_FIELDS, *place.T.shape), np.nan)
    fields[:2] = (place + solution.origin).T, weight.T
    fields[2, :, :-1] = _ashman(mean, variance).T
    if several.size:
        chosen = solution.take(several)
        fields[3, several, :-1] = _errors(chosen, some, owner[:, several], order[:, several]).T
    fields[3, np.isnan(fields[2])] = np.nan
    return modes, fields


def _density(solution: Solution, y: Floats) -> Floats:
    """Return the log density of the mixtures at y, shape (point, row)."""
    with np.errstate(over="ignore"):
        statistic = solution.family.transform(y.T)
        coefficients = solution.family.coefficients(solution.state)
        return em.log_density(y.T, statistic, coefficients).T


def _valleys(solution: Solution, spread: Floats) -> Floats:
    """Return the least log density between any two components, (component, component, row)."""
    place = solution.state[1]
    count = len(place)
    valley = np.full((count, count, place.shape[-1]), np.inf)
    for i in range(count):
        for j in range(i):
            a, b = place[i], place[j]
            low, high = np.minimum(a, b), np.maximum(a, b)
            toward = np.sign(b - a)
            near = np.concatenate([a + toward * _NEAR * spread[i], b - toward * _NEAR * spread[j]])
            points = np.concatenate([low + (high - low) * _EVEN, np.clip(near, low, high)])
            valley[i, j] = valley[j, i] = _density(solution, points).min(axis=0)
    return valley


def _owners(solution: Solution) -> Counts:
    """Return to which component's mode each component belongs, shape (component, row)."""
    weight, spread = np.exp(solution.state[0]), solution.family.moments(solution.state)[1]
    height, valley = _density(solution, solution.state[1]), _valleys(solution, spread)
    small = weight < np.minimum(LEAST_WEIGHT, weight.max(axis=0))
    rank = np.argsort(np.where(small, -np.inf, height), axis=0)[::-1]
    rows = np.arange(rank.shape[-1])
    owner = np.empty_like(rank)
    mode = np.zeros(rank.shape, dtype=bool)
    for j in rank:
        saddle = np.where(mode, valley[j, :, rows].T, -np.inf)
        separate = (saddle < height[j, rows] + np.log(_DEPTH)).all(axis=0)
        mode[j, rows] = separate & ~small[j, rows] | ~mode.any(axis=0)
        owner[j, rows] = np.where(mode[j, rows], j, saddle.argmax(axis=0))
    return owner


def _of_modes(
    owner: Counts, share: Floats, mean: Floats, spread: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return mean, variance and weight of each component's mode, (component, row); NaN of none."""
    member = owner == np.arange(len(owner))[:, np.newaxis, np.newaxis]
    share = np.where(member, share, 0.0)
    weight = share.sum(axis=1)
    used = np.where(weight > 0, weight, np.nan)
    center = (share * mean).sum(axis=1) / used
    square = (share * (spread**2 + mean**2)).sum(axis=1) / used
    return center, square - center**2, weight


def _ashman(mean: Floats, variance: Floats) -> Floats:
    """Return ``sqrt(2) |m1 - m2| / sqrt(s1^2 + s2^2)`` of neighbours, shape (pair, row)."""
    both = variance[1:] + variance[:-1]
    return np.asarray(np.sqrt(2) * np.abs(np.diff(mean, axis=0)) / np.sqrt(both))


def _errors(solution: Solution, summaries: Summaries, owner: Counts, order: Counts) -> Floats:
    """Return standard errors of Ashman's D by the delta method, shape (pair, row).

    From the information of the mixture, to which samples that may be of either mode add little.
    """
    family, k = solution.family, solution.state.shape[1]
    state = np.stack([np.exp(solution.state[0]), *solution.state[1:]])

    def separation(state: Floats) -> Floats:
        mean, variance, _ = _of_modes(owner, state[0], *family.moments(state))
        return _ashman(*(np.take_along_axis(v, order, axis=0) for v in (mean, variance)))

    moves = directions(family, k)
    steps = np.full((3 * k - 1, state.shape[-1]), _STEP)
    steps[: k - 1] *= np.minimum(state[0, :-1], state[0, -1])
    slopes = []
    for step, move in zip(steps, moves[..., np.newaxis], strict=True):
        rise = separation(state + step * move) - separation(state - step * move)
        slopes.append(rise / (2 * step))
    with np.errstate(invalid="ignore"):
        gradient, found = np.stack(slopes), covariance(solution, summaries)
        error = np.sqrt(np.einsum("ipr,rij,jpr->pr", gradient, found, gradient))
    return np.asarray(error * (1 + (_FEW / summaries.n) ** 2))


_FIELDS = 4
"""Numbers of a mode: place, weight, separation from the next mode, and its standard error."""


@dataclass(frozen=True)
class Peaks:
    """Modes of every row; NaN where there are none.

    Attributes
    ----------
    count
        Modes, shape (...); 0 where the row is not usable.
    place
        Top of each mode in log radiance, shape (..., mode).
    weight
        Its mass, that of its component and of those that belong to it, shape (..., mode).
    ashman_d, ashman_d_se
        Its separation from the next mode, and the standard error of that, NaN where the information
        of the mixture is singular; shape (..., mode), of which the last is not used.
    delta_bic
        Twice what the score of the best mixture is above that of one mode, shape (...).
    """

    count: npt.NDArray[np.int8]
    place: Floats
    weight: Floats
    ashman_d: Floats
    ashman_d_se: Floats
    delta_bic: Floats


def best_peaks(
    part: PositivePart,
    usable: Mask,
    unimodal: Floats,
    max_k: int,
    *,
    doubtful: Mask,
    also: Callable[[Found], None] = lambda _: None,
) -> Peaks:
    """Find the peaks of the usable rows.

    `unimodal` is the best score of distributions of one mode, see `unimodal_scores`, shape (...).
    Where one mode is not out of the question, `doubtful`, a mixture of more has to beat those of
    `edge_scores`, too. `also` gets to see the log-normal mixtures as they are found.
    """
    shape, size = part.n.shape, part.n.size
    log_n, one_mode = log_samples(part.n).reshape(-1), unimodal.reshape(-1)
    count, delta = np.zeros(size, dtype=np.int8), np.full(size, np.nan)
    table = np.full((_FIELDS, size, max_k), np.nan)
    for found in search(part, usable, "lognormal", max_k, effort="fast", unimodal=unimodal):
        rows = found.rows
        count[rows], table[:, rows], gain = _of_piece(
            found, one_mode[rows], log_n[rows], max_k, doubtful.reshape(-1)[rows]
        )
        delta[rows] = np.where(np.isfinite(gain), 2 * gain, np.nan)
        also(found)
    place, weight, ashman_d, error = table.reshape(_FIELDS, *shape, max_k)
    return Peaks(count.reshape(shape), place, weight, ashman_d, error, delta.reshape(shape))


def _of_piece(
    found: Found, unimodal: Floats, log_n: Floats, max_k: int, doubtful: Mask
) -> tuple[Counts, Floats, Floats]:
    """Return modes, the fields of their peaks (4, row, mode), and the gain over one mode.

    Log-normal components come first. Where they make more than one mode, gamma components get the
    chance to make fewer, and distributions of one mode with hard edges that to make one.
    """
    one = np.full((_FIELDS, len(unimodal), max_k), np.nan)
    one[0, :, 0] = found.solutions[0].state[1, 0] + found.summaries.origin
    one[1, :, 0] = 1.0
    count, table = np.ones(len(unimodal), dtype=np.int64), one.copy()
    best = unimodal.copy()
    everyone = np.arange(len(unimodal))
    gain = _enter(found.solutions, found.summaries, everyone, log_n, best, count, table) - unimodal
    several = np.flatnonzero(count > 1)
    of_gamma = found.also("gamma", several)
    also = _enter(of_gamma, found.summaries, several, log_n, best, count, table) - unimodal[several]
    gain[several] = np.maximum(gain[several], also)
    several = several[doubtful[several] & (count[several] > 1)]
    samples, n = found.objective.samples, found.objective.n
    assert samples is not None
    assert n is not None
    edge = edge_scores(samples[several], n[several], best[several])
    gain[several] -= np.maximum(edge - unimodal[several], 0)
    beaten = several[edge >= best[several]]
    count[beaten], table[:, beaten] = 1, one[:, beaten]
    return count, table, gain


def _enter(
    solutions: list[Solution],
    summaries: Summaries,
    rows: Counts,
    log_n: Floats,
    best: Floats,
    count: Counts,
    table: Floats,
) -> Floats:
    """Enter the peaks of those of the rows whose best mixture raises `best`; return its score."""
    mixed = solutions[1:]
    scores = np.stack([score(solution, log_n[rows]) for solution in mixed])
    which, highest = scores.argmax(axis=0), scores.max(axis=0)
    for i, solution in enumerate(mixed):
        at = np.flatnonzero((which == i) & (highest > best[rows]))
        count[rows[at]], fields = _peaks_of(solution.take(at), summaries.take(rows[at]))
        table[:, rows[at]] = np.nan
        table[:, rows[at], : fields.shape[-1]] = fields
    best[rows] = np.maximum(best[rows], highest)
    return np.asarray(highest)
