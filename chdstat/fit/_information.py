"""Information: standard errors of the parameters of mixtures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from chdstat._positive import Floats
from chdstat.fit._cells import Cells
from chdstat.fit._em import responsibilities
from chdstat.fit._grounds import Solution

__all__ = ["covariance", "standard_errors"]

_SMALLEST = 1e-150
_WORST = 1e-12
"""Reciprocal condition at or below which an information matrix says nothing."""


def standard_errors(solution: Solution, cells: Cells) -> dict[str, Floats]:
    """Return standard errors of weights and parameters, by name, shape (row, component).

    Inverse of the empirical information, the sum of the outer products of the scores of the samples
    (McLachlan and Peel, "Finite mixture models", 2000, doi:10.1002/0471721182, equation 2.62), here
    with the mean scores of the cells. NaN where it is singular.
    """
    k = solution.state.shape[1]
    found = covariance(solution, cells)
    with np.errstate(invalid="ignore", over="ignore"):
        own = np.sqrt(np.diagonal(found, axis1=-2, axis2=-1))
        weights = np.sqrt(found[:, : k - 1, : k - 1].sum(axis=(-2, -1)))
    first, second = own[:, k - 1 : 2 * k - 1], own[:, 2 * k - 1 :]
    last = np.where(k > 1, weights, 0.0)[:, np.newaxis]
    errors = {"weight": np.concatenate([own[:, : k - 1], last], axis=-1)}
    if solution.family.name == "lognormal":
        return errors | {"mu": first, "sigma": second * np.exp(solution.state[2]).T}
    _, log_mean, log_shape = solution.state
    scale = np.exp(log_mean - log_shape + solution.origin).T
    return errors | {"shape": first, "scale": second * scale}


def covariance(solution: Solution, cells: Cells) -> Floats:
    """Return the covariance that the information gives, shape (row, parameter, parameter).

    Parameters are all weights but the last; mu of each component, then log sigma; or shape, then
    log scale.
    """
    belonging = responsibilities(cells, solution.family, solution.state)
    share = belonging / np.maximum(cells.count, 1)
    scores = np.stack(
        [*_weight_scores(solution, share), *_parameter_scores(solution, cells, share)]
    )
    information = np.einsum("irc,jrc,rc->rij", scores, scores, cells.count, optimize=True)
    return _inverse(information)


def _weight_scores(solution: Solution, share: Floats) -> Iterator[Floats]:
    weight = np.exp(solution.state[0])[..., np.newaxis]
    for j in range(len(weight) - 1):
        yield share[j] / weight[j] - share[-1] / weight[-1]


def _parameter_scores(solution: Solution, cells: Cells, share: Floats) -> Iterator[Floats]:
    """Yield scores of mu of each component, then of log sigma; or of shape, then of log scale."""
    _, location, log_scale = solution.state[..., np.newaxis]
    if solution.family.name == "lognormal":
        precision = np.exp(-2 * log_scale)
        yield from share * (cells.log - location) * precision
        square = cells.square - 2 * location * cells.log + location**2
        yield from share * (square * precision - 1)
    else:
        shape, log_theta = np.exp(log_scale), location - log_scale
        yield from share * (cells.log - log_theta - special.digamma(shape))
        yield from share * (cells.ratio * np.exp(-log_theta) - shape)


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
