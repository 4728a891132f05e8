"""Peaks: the modes of fitted mixtures in log radiance, and how far they are separated.

A component is a mode of its own if its weight is at least `LEAST_WEIGHT` and, on the way to every
higher mode, the density falls below `_DEPTH` of its height. Otherwise it belongs to the mode from
which it is least separated. The error of the separation comes from the covariance of the
parameters.

The peaks of a row are those of the mixture with the smallest BIC among the mixtures of 2 or more
log-normal or gamma components, unless a distribution with one mode describes the row better. The
score of a fit is the log-likelihood of log radiance minus half of log n for each parameter, with n
positive samples: BIC over -2, for the positive samples only. Nulls are not part of a shape, and do
not make modes harder to find. The share of zeros counts as a parameter of every fit.

A hard edge is not a mode. Families that begin at zero radiance cannot follow one, and their
mixtures imitate it with a narrow component. Therefore the distributions of `_edge_scores` have free
ends: gamma above a floor, and all distributions that are log-concave in log radiance, or in the
logarithm of the distance from either end. The likelihood of an end is not regular (Cheng and
Traylor, "Non-regular maximum likelihood problems", 1995, doi:10.1111/j.2517-6161.1995.tb02012.x),
and a log-concave density has no fixed number of parameters. The number that they count as here was
measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import Counts, Floats, Mask
from chdstat._core.positive import PositivePart
from chdstat.fit import em
from chdstat.fit.em import COMPONENTS, Solution
from chdstat.fit.families import FAMILIES, FamilyFit, zero_log_likelihood
from chdstat.fit.groups import SPREAD_FLOOR, SampleGroups, take_last
from chdstat.fit.log_concave import log_concave_likelihood
from chdstat.fit.mixtures import covariance, directions
from chdstat.fit.search import Piece, log_samples, score, search
from chdstat.summary.runner import measured

_DEPTH = 0.98
"""A valley counts where the density falls below this share of the lower peak."""
LEAST_WEIGHT = 0.08
"""Least weight of a component that makes a mode: a few outliers make none."""

_CYCLES, _TOLERANCE = 40, 1e-6
"""Cycles and tolerance of EM, which goes on where there is more than one mode."""
_STEP = 1e-4
"""Step of a parameter for a derivative."""

_FEW = 70
"""With few samples, modes are found where they happen to look separate. Errors are therefore
multiplied by ``1 + (70/n)^2``, so that 1.96 errors hold the separation for 90 % of the modes that
are found (``tests/inference/test_modes.py``)."""

_EVEN = np.linspace(0, 1, 34)[1:-1, np.newaxis]
_NEAR = np.array([0.5, 1.0, 2.0, 3.0, 4.0])[:, np.newaxis]


def _fields_of(solution: Solution, owner: Counts, groups: SampleGroups) -> Floats:
    """Return the `_FIELDS` of each mode of mixtures, shape (field, row, component).

    The darkest mode is first; NaN where there are fewer modes. The last separation is not used.
    """
    several = np.flatnonzero(_modes(owner) > 1)
    some = groups.take(several)
    if several.size:
        # After a few steps, modes can be counted, but their places and widths would still move.
        state, family = solution.state.copy(), solution.family
        start = take_last(state, several)
        further = em.run(some, family, start, cycles=_CYCLES, tolerance=_TOLERANCE)
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
    return fields


def _density(solution: Solution, y: Floats) -> Floats:
    """Return the log density of the mixtures at y, shape (point, row)."""
    coefficients = solution.family.coefficients(solution.state)[:, :, np.newaxis]
    return em.log_density(y, solution.family.transform(y), coefficients)


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
    """Return the component to whose mode each component belongs, shape (component, row)."""
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


def _modes(owner: Counts) -> Counts:
    """Count the components that own a mode, shape (row,)."""
    return np.asarray((owner == np.arange(len(owner))[:, np.newaxis]).sum(axis=0))


def _of_modes(
    owner: Counts, share: Floats, mean: Floats, spread: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return mean, variance and weight of each component's mode; (component, row), else NaN."""
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


def _errors(solution: Solution, groups: SampleGroups, owner: Counts, order: Counts) -> Floats:
    """Return standard errors of Ashman's D by the delta method, shape (pair, row).

    They come from the information of the mixture, to which ambiguous samples add little.
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
    gradient, found = np.stack(slopes), covariance(solution, groups)
    error = np.sqrt(np.einsum("ipr,rij,jpr->pr", gradient, found, gradient))
    return np.asarray(error * (1 + (_FEW / groups.n) ** 2))


_FIELDS = 4
"""Numbers of a mode: place, weight, separation from the next mode, and its standard error."""


def best_peaks(
    part: PositivePart,
    usable: Mask,
    unimodal: Floats,
    max_k: int,
    *,
    doubtful: Mask,
    also: Callable[[Piece, list[Solution]], None] = lambda *_: None,
) -> tuple[npt.NDArray[np.int8], Floats, Floats]:
    """Find the peaks of the usable rows.

    `unimodal` is the best score of distributions with one mode, see `unimodal_scores`, shape (...).
    In rows that are `doubtful`, where one mode is not out of the question, a mixture must also beat
    the distributions of `_edge_scores`. `also` is called with the log-normal mixtures as they are
    found.

    Returns
    -------
    ndarray
        Number of peaks, shape (...); 0 where the row is not usable.
    ndarray
        Fields of each peak, shape (field, ..., mode), NaN where there is none: its top in log
        radiance; its mass, that of all components that belong to it; its separation from the next
        peak (Ashman's D); and the standard error of the separation, NaN where the information of
        the mixture is singular. The last separation is not used.
    ndarray
        Twice the score of the best mixture minus that of one mode, shape (...).
    """
    shape, size = part.n.shape, part.n.size
    log_n, one_mode = log_samples(part.n).reshape(-1), unimodal.reshape(-1)
    count, delta = np.zeros(size, dtype=np.int8), np.full(size, np.nan)
    table = np.full((_FIELDS, size, max_k), np.nan)
    for piece, solutions in search(
        part, usable, "lognormal", max_k, effort="fast", unimodal=unimodal
    ):
        rows = piece.rows
        count[rows], table[:, rows], gain = _of_piece(
            piece, solutions, one_mode[rows], log_n[rows], doubtful.reshape(-1)[rows]
        )
        delta[rows] = np.where(np.isfinite(gain), 2 * gain, np.nan)
        also(piece, solutions)
    return count.reshape(shape), table.reshape(_FIELDS, *shape, max_k), delta.reshape(shape)


def _of_piece(
    piece: Piece, solutions: list[Solution], unimodal: Floats, log_n: Floats, doubtful: Mask
) -> tuple[Counts, Floats, Floats]:
    """Return the numbers of modes, the fields of their peaks (4, row, mode), and the gain over one.

    Log-normal components come first. Where they make more than one mode, gamma components may make
    fewer, and distributions with hard edges may make it one.
    """
    one = np.full((_FIELDS, len(unimodal), len(solutions)), np.nan)
    one[0, :, 0] = solutions[0].state[1, 0] + piece.groups.origin
    one[1, :, 0] = 1.0
    count, table = np.ones(len(unimodal), dtype=np.int64), one
    best, everyone = unimodal.copy(), np.arange(len(unimodal))
    entered: list[tuple[Solution, Counts, Counts]] = []
    last = np.full(len(unimodal), -1)

    def enter(solutions: list[Solution], rows: Counts) -> Floats:
        """Enter the modes of rows where one of these is the best so far; return its gain."""
        scores = np.stack([score(solution, log_n[rows]) for solution in solutions[1:]])
        which, highest = scores.argmax(axis=0), scores.max(axis=0)
        for i, solution in enumerate(solutions[1:]):
            at = np.flatnonzero((which == i) & (highest > best[rows]))
            mixture, here = solution.take(at), rows[at]
            owner = _owners(mixture)
            count[here], last[here] = _modes(owner), len(entered)
            entered.append((mixture, owner, here))
        best[rows] = np.maximum(best[rows], highest)
        return np.asarray(highest - unimodal[rows])

    gain = enter(solutions, everyone)
    several = np.flatnonzero(count > 1)
    some = [solution.take(several) for solution in solutions]
    of_gamma = piece.take(several).refit("gamma", some)
    gain[several] = np.maximum(gain[several], enter(of_gamma, several))
    several = several[doubtful[several] & (count[several] > 1)]
    samples, n = piece.samples, piece.n
    assert samples is not None
    assert n is not None
    edge = _edge_scores(samples[several], n[several], best[several])
    gain[several] -= np.maximum(edge - unimodal[several], 0)
    beaten = several[edge >= best[several]]
    count[beaten], last[beaten] = 1, -1
    for i, (mixture, owner, rows) in enumerate(entered):
        at = np.flatnonzero(last[rows] == i)
        stays = rows[at]
        fields = _fields_of(mixture.take(at), owner[:, at], piece.corrected.take(stays))
        table[:, stays] = np.nan
        table[:, stays, : fields.shape[-1]] = fields
    return count, table, gain


_BOUNDED = 5
"""Parameters of a distribution between two ends. The estimate of an end converges like 1/n, not
1/sqrt(n), so that it costs log n in the expansion behind BIC: as much as two regular parameters."""
_ABOVE_FLOOR, _BELOW_CEILING, _LOG_CONCAVE = 3.5, 5.0, 9.2
"""Parameters that the distributions of `_edge_scores` count as. With these numbers, at most 5 % of
samples of hard-edged distributions show more than one mode, and nearly all true modes are found
(``tests/inference/test_modes.py``)."""
_FLOORS = (0.03, 0.12, 0.4, 1.5)
"""Distances of a floor from the smallest sample, in units of the range of the samples."""
_NEXT = 3
"""Samples that the density at an end is estimated from."""
_LEAST_ABOVE = 1e-12


def unimodal_scores(part: PositivePart, usable: Mask, bounded: Mask) -> Floats:
    """Return the largest score of distributions with one mode, shape (...); NaN where not usable.

    The distributions are the `FAMILIES`; Pareto distributions above a floor, and their mirror
    images in log radiance below a ceiling; and, in rows that may be `bounded`, the uniform and the
    log-uniform distribution.
    """
    # The difference between log-likelihoods of radiance and of the log radiance of positive
    # samples.
    rest = zero_log_likelihood(part) - part.n * part.log_statistics.log_mean
    log_n = log_samples(part.n)
    fits = [measured(part, FamilyFit(family)) for family in FAMILIES.values()]
    scores = [fit.log_likelihood - rest - 0.5 * (len(fit.parameters) + 1) * log_n for fit in fits]
    low = np.where(usable, part.log_sorted[..., 0], 0.0)
    high = np.where(usable, np.log(part.largest), 1.0)
    mean, n = part.log_statistics.log_mean, part.n.astype(np.float64)
    # Between the extremes a and b, the log-likelihood of log-uniform is -n log(log b - log a), that
    # of uniform sum(log x) - n log(b - a). Neither takes b or a alone, which may be huge.
    log_range = high + np.log(-np.expm1(low - high))
    scores += [
        np.where(bounded, value - 0.5 * _BOUNDED * log_n, -np.inf)
        for value in (-n * np.log(high - low), n * (mean - log_range))
    ]
    # Exponential above the smallest sample, or below the largest.
    scores += [
        -part.n * (np.log(distance) + 1) - 0.5 * (_BOUNDED - 1) * log_n
        for distance in (mean - low, high - mean)
    ]
    return np.where(usable, np.fmax.reduce(scores), np.nan)


def _edge_scores(ascending: Floats, n: Counts, bar: Floats) -> Floats:
    """Return the largest score of distributions with one mode and free ends, shape (row,).

    Where gamma distributions reach the `bar`, the others are not computed.

    Parameters
    ----------
    ascending
        Log radiance in ascending order, shape (row, sample), not all equal.
    n
        How many of the values count, shape (row,), at least 20.
    bar
        Score to be beaten, shape (row,).
    """
    log_n = log_samples(n)
    # Log 1/x, in ascending order.
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    mirrored = np.sort(np.where(valid, -ascending, np.inf), axis=-1)
    best = np.fmax(
        _gamma_above_a_floor(ascending, n) - 0.5 * _ABOVE_FLOOR * log_n,
        _gamma_above_a_floor(mirrored, n) - 0.5 * _BELOW_CEILING * log_n,
    )
    rows = np.flatnonzero(best < bar)
    some = n[rows]
    ends = [_above_a_floor(values[rows], some) for values in (ascending, mirrored)]
    # All at once: for few rows, three searches would take three times as long.
    values = np.concatenate([ascending[rows], *(rest for rest, _ in ends)])
    value = log_concave_likelihood(values, np.concatenate([some, some - 1, some - 1]))
    value = value.reshape(3, -1)
    value[1:] += [more for _, more in ends]
    best[rows] = np.fmax(best[rows], np.fmax.reduce(value) - 0.5 * _LOG_CONCAVE * log_n[rows])
    return best


def _gamma_above_a_floor(ascending: Floats, n: Counts) -> Floats:
    """Return the log-likelihood of log x where x less a floor has a gamma distribution.

    The floors lie at a few distances below the smallest sample. The nearest is half the mean
    distance between samples away: the likelihood rises without bound towards the sample itself.
    """
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    last = np.take_along_axis(ascending, n[:, np.newaxis] - 1, axis=-1)
    log = np.where(valid, ascending - last, 0.0)
    x = np.exp(log)
    above = x - x[:, :1]
    gamma = COMPONENTS["gamma"]
    best = np.full(len(n), -np.inf)
    for distance in (0.5 / n, *_FLOORS):
        z = above + (distance * (1 - x[:, 0]))[:, np.newaxis]
        mean = np.vecdot(z, valid) / n
        z /= mean[:, np.newaxis]
        log_z = np.vecdot(np.log(z, out=z), valid) / n
        log_shape = gamma.log_scale(np.maximum(-2 * log_z, SPREAD_FLOOR**2))
        k = np.exp(log_shape)
        value = (k - 1) * log_z + k * (log_shape - 1) - special.gammaln(k) - np.log(mean)
        best = np.fmax(best, n * value)
    return np.asarray(best + log.sum(axis=-1))


def _above_a_floor(ascending: Floats, n: Counts) -> tuple[Floats, Floats]:
    """Return log(x - a) of all but the smallest sample, a, and the rest of the log-likelihood.

    The log-likelihood of log x is that of these n - 1 values plus the rest, shape (row,). The rest
    is the Jacobian, and the density at a, which follows from the distance to its neighbours.
    """
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    above = np.where(valid, np.maximum(ascending - ascending[:, :1], _LEAST_ABOVE), 1.0)
    log_share = np.log(-np.expm1(-above))
    rest = np.pad(np.where(valid, ascending + log_share, np.inf)[:, 1:], ((0, 0), (0, 1)))
    jacobian = np.where(valid, log_share, 0.0)[:, 1:].sum(axis=-1)
    first = np.log(_NEXT / n / np.expm1(above[:, _NEXT]))
    return rest, first - jacobian
