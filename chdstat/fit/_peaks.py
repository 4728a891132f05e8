"""Peaks: the modes of fitted mixtures in log radiance, and how far they stand apart.

A component makes a mode of its own where its weight is at least `LEAST_WEIGHT` and, on the way to
every higher mode, the density falls below `DEPTH` of its height; otherwise it belongs to the mode
that it is least separated from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from chdstat._positive import Counts, Floats
from chdstat.fit._cells import Cells
from chdstat.fit._em import log_density, responsibilities
from chdstat.fit._grounds import Solution

__all__ = ["DEPTH", "LEAST_WEIGHT", "Peaks", "peaks_of"]

DEPTH = 0.98
"""A valley is a valley where the density falls below this share of the lower peak."""
LEAST_WEIGHT = 0.08
"""Least weight of a component that makes a mode: a few outliers are none."""

_EVEN = np.linspace(0, 1, 34)[1:-1, np.newaxis]
_NEAR = np.array([0.5, 1.0, 2.0, 3.0, 4.0])[:, np.newaxis]


@dataclass(frozen=True)
class Peaks:
    """Modes of the mixtures of some rows, the darkest first; NaN beyond those that there are.

    Attributes
    ----------
    count
        Modes, shape (row,).
    place, weight
        Log of radiance at the top of the mode, and its mass: of its component and of those that
        belong to it; shape (row, component).
    ashman_d, ashman_d_se
        Separation of neighbouring modes and its standard error, shape (row, component - 1).
    """

    count: Counts
    place: Floats
    weight: Floats
    ashman_d: Floats
    ashman_d_se: Floats


@dataclass(frozen=True)
class _Lobes:
    """Components by their place, shape (component, row); valleys between any two of them."""

    place: Floats
    weight: Floats
    mean: Floats
    spread: Floats
    height: Floats
    valley: Floats


def peaks_of(solution: Solution, cells: Cells) -> Peaks:
    """Count the modes of mixtures, and measure their separation."""
    lobes = _lobes(solution)
    owner = _owners(lobes)
    return _describe(
        lobes, owner, responsibilities(cells, solution.family, solution.state), solution
    )


def _lobes(solution: Solution) -> _Lobes:
    log_weight, place, log_scale = solution.state
    mean, spread = place, np.exp(log_scale)
    if solution.family.name == "gamma":
        mean = place - log_scale + special.digamma(spread)
        spread = np.sqrt(special.polygamma(1, np.exp(log_scale)))
    height = _density(solution, place)
    return _Lobes(place, np.exp(log_weight), mean, spread, height, _valleys(solution, spread))


def _density(solution: Solution, y: Floats) -> Floats:
    """Return the log density of the mixtures at y, shape (point, row)."""
    with np.errstate(over="ignore"):
        statistic = solution.family.transform(y.T)
        coefficients = solution.family.coefficients(solution.state)
        return log_density(y.T, statistic, coefficients).T


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


def _owners(lobes: _Lobes) -> Counts:
    """Return to which component's mode each component belongs, shape (component, row)."""
    small = lobes.weight < np.minimum(LEAST_WEIGHT, lobes.weight.max(axis=0))
    rank = np.argsort(np.where(small, -np.inf, lobes.height), axis=0)[::-1]
    rows = np.arange(rank.shape[-1])
    owner = np.empty_like(rank)
    mode = np.zeros(rank.shape, dtype=bool)
    for j in rank:
        saddle = np.where(mode, lobes.valley[j, :, rows].T, -np.inf)
        apart = (saddle < lobes.height[j, rows] + np.log(DEPTH)).all(axis=0)
        mode[j, rows] = apart & ~small[j, rows] | ~mode.any(axis=0)
        owner[j, rows] = np.where(mode[j, rows], j, saddle.argmax(axis=0))
    return owner


def _describe(lobes: _Lobes, owner: Counts, belonging: Floats, solution: Solution) -> Peaks:
    count = len(owner)
    member = owner == np.arange(count)[:, np.newaxis, np.newaxis]
    share = np.where(member, lobes.weight, 0.0)
    weight = share.sum(axis=1)
    used = np.where(weight > 0, weight, np.nan)
    mean = (share * lobes.mean).sum(axis=1) / used
    square = (share * (lobes.spread**2 + lobes.mean**2)).sum(axis=1) / used
    variance = square - mean**2
    known = np.einsum("mkr,krc->mrc", member, belonging)
    total = np.maximum(belonging.sum(axis=0), 1e-9)
    samples = (known * known / total).sum(axis=-1)
    place = np.where(weight > 0, lobes.place, np.nan)
    order = np.argsort(place, axis=0)
    place, used, mean, variance, samples = (
        np.take_along_axis(values, order, axis=0)
        for values in (place, used, mean, variance, samples)
    )
    ashman_d, error = _ashman(mean, variance, samples)
    modes = np.count_nonzero(weight > 0, axis=0)
    return Peaks(modes, (place + solution.origin).T, used.T, ashman_d.T, error.T)


def _ashman(mean: Floats, variance: Floats, samples: Floats) -> tuple[Floats, Floats]:
    """Return Ashman's D of neighbours and its standard error, by the delta method.

    With S = s1^2 + s2^2, D = sqrt(2) d / sqrt(S): var D = 2 var(d) / S + D^2 var(S) / (4 S^2),
    where var(d) = s1^2 / n1 + s2^2 / n2 and var(S) = 2 s1^4 / n1 + 2 s2^4 / n2. A sample that is of
    a mode with probability r counts as r^2 samples of it, as it tells as little.
    """
    both = variance[1:] + variance[:-1]
    d = np.sqrt(2) * np.diff(mean, axis=0) / np.sqrt(both)
    of_mean, of_variance = variance / samples, 2 * variance**2 / samples
    of_mean, of_variance = (v[1:] + v[:-1] for v in (of_mean, of_variance))
    return d, np.sqrt(2 * of_mean / both + d**2 * of_variance / (4 * both**2))
