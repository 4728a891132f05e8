"""Standard errors of mixtures, from the information of the samples, where they hold.

The errors are those of maximum likelihood for many samples, and of the number of components that
there are. Few samples in a component, components that overlap, and a number of components that the
samples barely ask for make them too small; then there are none. What is asked for was measured:
`tests/benchmarks/test_mixture.py` prints how often 1.96 errors hold the truth.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats
from chdstat.errors import Reason
from chdstat.fit import em
from chdstat.fit.em import ComponentFamily, Solution
from chdstat.fit.families import get_family
from chdstat.fit.groups import Summaries

__all__ = ["covariance", "directions", "standard_errors"]

_SMALLEST = 1e-150
_WORST = 1e-12
"""Reciprocal condition at or below which an information matrix counts as singular."""
_FEWEST, _TIMES, _CLEAR = 30, 10, 18.0
"""Least samples of each of several components; how many times those that the family asks for there
must be of all; and least score by which there are that many components."""
_FALL, _FLATTER, _STEEPER = 0.5 * 1.96**2, 0.7, 2.0
"""Fall of the log-likelihood at either end of an interval of 95 %, and how much of it there must be
at least and at most."""
_WIDER = 1.1
"""Of errors of several components, for what is left of all this."""


def standard_errors(
    solution: Solution, summaries: Summaries, gain: Floats
) -> tuple[Floats, npt.NDArray[np.int8]]:
    """Return standard errors of weights and both parameters, and why some are missing.

    Inverse of the empirical information, the sum of the outer products of the scores of the samples
    (McLachlan and Peel, "Finite mixture models", 2000, doi:10.1002/0471721182, equation 2.62), here
    with the mean scores of the groups. Of several components, there are errors where the likelihood
    falls along every one of them about as a parabola does, as it should for them to mean anything
    (Meeker and Escobar, "Teaching about approximate confidence regions based on maximum likelihood
    estimation", 1995, doi:10.1080/00031305.1995.10476112).

    Parameters
    ----------
    solution, summaries
        The mixtures, and groups of the samples.
    gain
        By how much their score is above those of fewer components, shape (row,).

    Returns
    -------
    ndarray
        Errors, shape (3, component, row).
    ndarray
        `Reason` codes, shape (row,).
    """
    family, k = solution.family, solution.state.shape[1]
    found = covariance(solution, summaries)
    with np.errstate(invalid="ignore", over="ignore"):
        own = np.sqrt(np.diagonal(found, axis1=-2, axis2=-1)).T
        last = np.sqrt(found[:, : k - 1, : k - 1].sum(axis=(-2, -1)))
    described = get_family(family.name)
    errors = [np.vstack([own[: k - 1], np.where(k > 1, last, 0.0)])]
    size, few = np.exp(solution.state[0]) * summaries.n, np.zeros(len(gain), dtype=bool)
    for name, error, parameter, logarithmic in zip(
        described.units,
        own[k - 1 :].reshape(2, k, -1),
        family.parameters(solution.state, solution.origin),
        family.logarithmic,
        strict=True,
    ):
        least = described.errors_from.get(name, 0)
        enough = (size >= least) & ((k == 1) | (summaries.n >= _TIMES * least))
        few |= ~enough.all(axis=0)
        error = error * parameter if logarithmic else error
        errors.append(np.where(enough, error, np.nan))
    reason = np.where(few, Reason.TOO_FEW, Reason.OK)
    table = np.stack(errors)
    if k > 1:
        reason[(size < _FEWEST).any(axis=0)] = Reason.TOO_FEW
        irregular = (gain < _CLEAR) | ~_is_parabolic(solution, summaries, found)
        reason[(reason == Reason.OK) & irregular] = Reason.NOT_REGULAR
        table[..., irregular | (size < _FEWEST).any(axis=0)] = np.nan
        table *= _WIDER
    reason[(reason == Reason.OK) & np.isnan(table).any(axis=(0, 1))] = Reason.NOT_REGULAR
    return table, reason.astype(np.int8)


def _is_parabolic(solution: Solution, summaries: Summaries, found: Floats) -> npt.NDArray[np.bool_]:
    """Say where the log-likelihood falls as errors say, along the profile of each parameter."""
    family, k = solution.family, solution.state.shape[1]
    moves = directions(family, k)
    top = em.bound_at(summaries, family, solution.state)
    state = np.stack([np.exp(solution.state[0]), *solution.state[1:]])
    good = np.ones(len(top), dtype=bool)
    with np.errstate(all="ignore"):
        for parameter in range(3 * k - 1):
            along = found[:, parameter] / np.sqrt(found[:, parameter, parameter])[:, np.newaxis]
            step = 1.96 * np.einsum("rp,pik->ikr", along, moves)
            for end in (state + step, state - step):
                there = np.stack([np.log(end[0]), *end[1:]])
                fall = (top - em.bound_at(summaries, family, there)) / _FALL
                good &= (fall > _FLATTER) & (fall < _STEEPER)
    return good


def directions(family: ComponentFamily, k: int) -> Floats:
    """Return how weight, location and log scale move with each parameter of `covariance`.

    The result has shape (parameter, 3, component).
    """
    moves, one = np.zeros((3 * k - 1, 3, k)), np.eye(k)
    moves[: k - 1, 0] = one[:-1] - one[-1]
    both = np.reshape(family.directions, (2, 1, 2, 1)) * one[:, np.newaxis]
    moves[k - 1 :, 1:] = both.reshape(2 * k, 2, k)
    return moves


def covariance(solution: Solution, summaries: Summaries) -> Floats:
    """Return the covariance that the information gives, shape (row, parameter, parameter).

    Parameters are all weights but the last; then what the family's scores are by: the first of
    each component, then the second.
    """
    shares = em.responsibilities(summaries, solution.family, solution.state)
    share = shares / np.maximum(summaries.count, 1)
    weight = np.exp(solution.state[0])[..., np.newaxis]
    of_weights = share[:-1] / weight[:-1] - share[-1] / weight[-1]
    first, second = solution.family.scores(summaries, solution.state[..., np.newaxis])
    scores = np.concatenate([of_weights, share * first, share * second])
    information = np.einsum("irc,jrc,rc->rij", scores, scores, summaries.count, optimize=True)
    return _inverse(information)


def _inverse(information: Floats) -> Floats:
    """Invert symmetric matrices, scaled to a unit diagonal; NaN where they are singular."""
    size = np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    size = np.where(size > _SMALLEST, size, 1.0)
    scaled = information / (size[:, :, np.newaxis] * size[:, np.newaxis, :])
    values, vectors = np.linalg.eigh(np.nan_to_num(scaled))
    singular = values[:, :1] <= _WORST * values[:, -1:]
    inverse = np.where(singular, np.nan, 1 / np.where(singular, 1.0, values))
    unscaled = (vectors * inverse[:, np.newaxis, :]) @ vectors.transpose(0, 2, 1)
    with np.errstate(over="ignore"):
        return np.asarray(unscaled / size[:, :, np.newaxis] / size[:, np.newaxis, :])
