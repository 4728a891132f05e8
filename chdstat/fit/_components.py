"""Components: the exponential families that mixtures are made of.

The density of y = log x of a component is ``exp(a0 + a1 y + a2 t(y))``, with t(y) = y^2 for a
log-normal component and t(y) = exp(y) for a gamma one. Its state is (log weight, location, log
scale): mean and log standard deviation of y for log-normal, log mean of x and log shape for gamma
components. States and coefficients have shape (3, component, row).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from scipy import special

from chdstat._positive import Floats
from chdstat.fit._cells import SPREAD_FLOOR, Cells

__all__ = ["COMPONENTS", "ComponentFamily", "MixtureFamily"]

MixtureFamily = Literal["lognormal", "gamma"]

_DARKEST = 1e-280
"""Least mean of exp(y) of a component: a component without samples keeps a finite state."""
_LOG_ROOT_TAU = 0.5 * np.log(2 * np.pi)


@dataclass(frozen=True)
class ComponentFamily:
    """An exponential family of components.

    Attributes
    ----------
    name
        What users call it.
    statistic
        Mean of t(y) per cell.
    transform
        t(y) itself.
    maximise
        State of maximum likelihood from the share of samples, mean y and mean t(y) of each
        component, and the least spread of a component.
    coefficients
        (a0 + log weight, a1, a2) of a state.
    bounded
        The state with its log scale moved to where the spread is at least the floor.
    spread
        About the standard deviation of y of each component, shape (component, row).
    narrowed
        The log scale of components of a given part of the spread.
    """

    name: MixtureFamily
    statistic: Callable[[Cells], Floats]
    transform: Callable[[Floats], Floats]
    maximise: Callable[[Floats, Floats, Floats, Floats], Floats]
    coefficients: Callable[[Floats], Floats]
    bounded: Callable[[Floats, Floats], Floats]
    spread: Callable[[Floats], Floats]
    narrowed: Callable[[Floats, float], Floats]


def _maximise_lognormal(share: Floats, log: Floats, square: Floats, floor: Floats) -> Floats:
    variance = np.maximum(square - log * log, floor * floor)
    return np.stack([np.log(share), log, 0.5 * np.log(variance)])


def _lognormal_coefficients(state: Floats) -> Floats:
    log_weight, mean, log_deviation = state
    precision = np.exp(-2 * log_deviation)
    constant = log_weight - log_deviation - _LOG_ROOT_TAU - 0.5 * precision * mean * mean
    return np.stack([constant, precision * mean, -0.5 * precision])


def _bounded_lognormal(state: Floats, floor: Floats) -> Floats:
    return np.stack([state[0], state[1], np.maximum(state[2], np.log(floor))])


def _maximise_gamma(share: Floats, log: Floats, ratio: Floats, floor: Floats) -> Floats:
    log_mean = np.log(np.maximum(ratio, _DARKEST))
    # The variance of y is near 1 / shape, and the gap near 1 / (2 shape), where both are small.
    gap = np.maximum(log_mean - log, 0.5 * floor * floor)
    return np.stack([np.log(share), log_mean, _log_shape(gap)])


def _gamma_coefficients(state: Floats) -> Floats:
    log_weight, log_mean, log_shape = state
    shape = np.exp(log_shape)
    constant = log_weight - special.gammaln(shape) + shape * (log_shape - log_mean)
    return np.stack([constant, shape, -np.exp(log_shape - log_mean)])


def _bounded_gamma(state: Floats, floor: Floats) -> Floats:
    return np.stack([state[0], state[1], np.minimum(state[2], -2 * np.log(floor))])


def _log_shape(gap: Floats) -> Floats:
    """Solve log(k) - digamma(k) = gap for log(k), to 1e-7, by interpolation in a table."""
    log_gap, log_shape = _shapes()
    return np.interp(np.log(gap), log_gap, log_shape)


@cache
def _shapes() -> tuple[Floats, Floats]:
    log_shape = np.linspace(np.log(2 / SPREAD_FLOOR**2), np.log(1e-4), 16384)
    k = np.exp(log_shape)
    series = (1 + (1 - 0.1 / k**2) / (6 * k)) / (2 * k)
    return np.log(np.where(k > 1e3, series, np.log(k) - special.digamma(k))), log_shape


COMPONENTS = {
    family.name: family
    for family in (
        ComponentFamily(
            name="lognormal",
            statistic=lambda cells: cells.square,
            transform=np.square,
            maximise=_maximise_lognormal,
            coefficients=_lognormal_coefficients,
            bounded=_bounded_lognormal,
            spread=lambda state: np.exp(state[2]),
            narrowed=lambda log_deviation, part: log_deviation + np.log(part),
        ),
        ComponentFamily(
            name="gamma",
            statistic=lambda cells: cells.ratio,
            transform=np.exp,
            maximise=_maximise_gamma,
            coefficients=_gamma_coefficients,
            bounded=_bounded_gamma,
            spread=lambda state: np.exp(-0.5 * state[2]),
            narrowed=lambda log_shape, part: log_shape - 2 * np.log(part),
        ),
    )
}
"""Families of components by name."""
