"""Components of mixtures, and expectation-maximisation: all rows at once, on groups of samples.

The density of y = log x of a component is ``exp(a0 + a1 y + a2 t(y))``. t(y) is y^2 for a
log-normal component and exp(y) for a gamma component. The state of a component is (log weight,
location, log scale). For log-normal components, location is the mean of y and log scale the log
standard deviation of y; for gamma components, location is the log mean of x and log scale the log
shape. States and coefficients have shape (3, component, row).

All samples of a group share their responsibilities, computed from the means of the group's
sufficient statistics. No other shared responsibilities give a larger lower bound of the
log-likelihood, and every step raises the bound (Verbeek, Nunnink and Vlassis, "Accelerated EM-based
clustering of large data sets", 2006, doi:10.1007/s10618-005-0033-3). SQUAREM extrapolates the steps
(Varadhan and Roland, "Simple and globally convergent methods for accelerating the convergence of
any EM algorithm", 2008, doi:10.1111/j.1467-9469.2007.00585.x, scheme S3); an extrapolation that
lowers the bound is undone.

The bound is penalised: each of several components counts a part of a sample beside its own samples,
see `state_of`. That is a conjugate prior of its spread (Fraley and Raftery, "Bayesian
regularization for normal mixture estimation and model-based clustering", 2007,
doi:10.1007/s00357-007-0004-5). Without it, two or three samples that happen to lie close would be a
spike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from scipy import special

from chdstat._core.arrays import Floats, Mask
from chdstat.fit.distributions import gap_of_shape
from chdstat.fit.groups import SPREAD_FLOOR, RowsLast, SampleGroups, take_last

MixtureFamily = Literal["lognormal", "gamma"]

_BRIGHTEST = 700.0
"""Largest logarithm of x, in scales, whose exponential is a number."""
_DARKEST = 1e-280
"""Least mean of exp(y) of a component: a component without samples keeps a finite state."""
_LOG_ROOT_TAU = 0.5 * np.log(2 * np.pi)


@dataclass(frozen=True)
class ComponentFamily:
    """A family of components: an exponential family.

    Attributes
    ----------
    name
        What users call it.
    statistic
        Returns the mean of t(y) per group.
    transform
        t(y) as a function.
    location
        Returns the location of maximum likelihood, from mean y and mean t(y) of each component.
    variance
        Returns about the variance of y, which sets the scale, from the same two means.
    log_scale
        Returns the log scale of maximum likelihood, from this variance.
    log_density
        Returns the largest mean log density of samples of y, from the log scale and their variance.
    cdf
        Distribution function of y, from y and a state whose shapes broadcast.
    coefficients
        Returns (a0 + log weight, a1, a2) of a state.
    power
        Power of the scale that is about the standard deviation of y.
    moments
        Mean and standard deviation of y of each component, shape (component, row).
    median
        Median of y of each component, shape (component, row).
    parameters
        Returns the parameters that users see, in the order of the family's units, from a state and
        the origin of y; each has shape (component, row).
    scores
        Returns the derivatives of the log density by these parameters, or by their logarithms, at
        the groups, for a state of shape (3, component, 1, row).
    logarithmic
        For which parameters the scores are derivatives by the logarithm.
    directions
        How location and log scale change with each parameter of the scores.
    """

    name: MixtureFamily
    statistic: Callable[[SampleGroups], Floats]
    transform: Callable[[Floats], Floats]
    location: Callable[[Floats, Floats], Floats]
    variance: Callable[[Floats, Floats], Floats]
    log_scale: Callable[[Floats], Floats]
    log_density: Callable[[Floats, Floats], Floats]
    cdf: Callable[[Floats, Floats], Floats]
    coefficients: Callable[[Floats], Floats]
    power: float
    moments: Callable[[Floats], tuple[Floats, Floats]]
    median: Callable[[Floats], Floats]
    parameters: Callable[[Floats, Floats], tuple[Floats, Floats]]
    scores: Callable[[SampleGroups, Floats], tuple[Floats, Floats]]
    logarithmic: tuple[bool, bool]
    directions: tuple[tuple[int, int], tuple[int, int]]

    def spread(self, state: Floats) -> Floats:
        """Return about the standard deviation of y of each component, shape (component, row)."""
        return np.asarray(np.exp(self.power * state[2]))

    def narrowed(self, log_scale: Floats, part: float) -> Floats:
        """Return the log scale of components whose spread is a given part of what it was."""
        return np.asarray(log_scale + np.log(part) / self.power)

    def bounded(self, state: Floats, floor: Floats) -> Floats:
        """Return the state with its log scale changed so that the spread is at least the floor."""
        log_spread = np.maximum(self.power * state[2], np.log(floor))
        return np.stack([state[0], state[1], log_spread / self.power])


def _lognormal_coefficients(state: Floats) -> Floats:
    log_weight, mean, log_deviation = state
    precision = np.exp(-2 * log_deviation)
    constant = log_weight - log_deviation - _LOG_ROOT_TAU - 0.5 * precision * mean * mean
    return np.stack([constant, precision * mean, -0.5 * precision])


def _lognormal_log_density(log_deviation: Floats, variance: Floats) -> Floats:
    precision = np.exp(-2 * log_deviation)
    return np.asarray(-log_deviation - _LOG_ROOT_TAU - 0.5 * variance * precision)


def _lognormal_scores(groups: SampleGroups, state: Floats) -> tuple[Floats, Floats]:
    _, mean, log_deviation = state
    precision = np.exp(-2 * log_deviation)
    square = groups.square - 2 * mean * groups.log + mean**2
    return (groups.log - mean) * precision, square * precision - 1


def _gamma_location(_log: Floats, ratio: Floats) -> Floats:
    return np.asarray(np.log(np.maximum(ratio, _DARKEST)))


def _gamma_log_density(log_shape: Floats, variance: Floats) -> Floats:
    shape = np.exp(log_shape)
    return np.asarray(shape * (log_shape - 1 - 0.5 * variance) - special.gammaln(shape))


def _gamma_coefficients(state: Floats) -> Floats:
    log_weight, log_mean, log_shape = state
    shape = np.exp(log_shape)
    constant = log_weight - special.gammaln(shape) + shape * (log_shape - log_mean)
    return np.stack([constant, shape, -np.exp(log_shape - log_mean)])


def _gamma_moments(state: Floats) -> tuple[Floats, Floats]:
    shape = np.exp(state[2])
    mean = state[1] - state[2] + special.digamma(shape)
    return mean, np.sqrt(special.polygamma(1, shape))


def _gamma_median(state: Floats) -> Floats:
    shape = np.exp(state[2])
    return np.asarray(state[1] + np.log(special.gammaincinv(shape, 0.5) / shape))


def _gamma_scores(groups: SampleGroups, state: Floats) -> tuple[Floats, Floats]:
    _, log_mean, log_shape = state
    shape, log_scale = np.exp(log_shape), log_mean - log_shape
    by_log_shape = shape * (groups.log - log_scale - special.digamma(shape))
    return by_log_shape, groups.ratio * np.exp(-log_scale) - shape


def _log_shape(gap: Floats) -> Floats:
    """Solve log(k) - digamma(k) = gap for log(k), to 1e-7, by interpolation in a table."""
    return np.interp(np.log(gap), *_log_gaps_and_shapes())


@cache
def _log_gaps_and_shapes() -> tuple[Floats, Floats]:
    log_shape = np.linspace(np.log(2 / SPREAD_FLOOR**2), np.log(1e-4), 16384)
    return np.log(gap_of_shape(np.exp(log_shape))), log_shape


COMPONENTS = {
    family.name: family
    for family in (
        ComponentFamily(
            name="lognormal",
            statistic=lambda groups: groups.square,
            transform=np.square,
            location=lambda log, _square: log,
            variance=lambda log, square: square - log * log,
            log_scale=lambda variance: 0.5 * np.log(variance),
            log_density=_lognormal_log_density,
            cdf=lambda y, state: special.ndtr((y - state[1]) * np.exp(-state[2])),
            coefficients=_lognormal_coefficients,
            power=1.0,
            moments=lambda state: (state[1], np.exp(state[2])),
            median=lambda state: state[1],
            parameters=lambda state, origin: (state[1] + origin, np.exp(state[2])),
            scores=_lognormal_scores,
            logarithmic=(False, True),
            directions=((1, 0), (0, 1)),
        ),
        ComponentFamily(
            name="gamma",
            statistic=lambda groups: groups.ratio,
            transform=np.exp,
            location=_gamma_location,
            # Where both are small, the variance is near 1 / shape and the gap near 1 / (2 shape).
            variance=lambda log, ratio: 2 * (_gamma_location(log, ratio) - log),
            log_scale=lambda variance: _log_shape(0.5 * variance),
            log_density=_gamma_log_density,
            cdf=lambda y, state: special.gammainc(
                np.exp(state[2]), np.exp(np.minimum(state[2] + y - state[1], _BRIGHTEST))
            ),
            coefficients=_gamma_coefficients,
            power=-0.5,
            moments=_gamma_moments,
            median=_gamma_median,
            parameters=lambda state, origin: (
                np.exp(state[2]),
                np.exp(state[1] - state[2] + origin),
            ),
            scores=_gamma_scores,
            logarithmic=(True, True),
            directions=((1, 1), (1, 0)),
        ),
    )
}
"""Families of components by name."""


_MORE, _APART = 0.3, 3.5
"""Samples that each component counts beside its own, and their distance from its centre in median
distances of neighbouring samples."""
_LEAST_SIZE = 1e-10
"""Least share of a component: it keeps a place and a width."""
_VANISHING = -80.0
"""Log of a share that is as good as 0."""
_REACH = 64.0
"""Longest extrapolation, in steps."""


@dataclass(frozen=True)
class Solution(RowsLast):
    """A mixture for each row, with one family and one number of components.

    Attributes
    ----------
    family
        Family of the components.
    state
        State of the components, shape (3, component, row).
    origin
        Origin of y = log x - origin, shape (row,).
    log_likelihood
        Log-likelihood of log x, without the Jacobian of the logarithm, shape (row,). From `run`, it
        is the penalised bound.
    converged
        Whether the last cycle gained less than the tolerance, shape (row,).
    """

    family: ComponentFamily
    state: Floats
    origin: Floats
    log_likelihood: Floats
    converged: Mask


def run(
    groups: SampleGroups, family: ComponentFamily, state: Floats, *, cycles: int, tolerance: float
) -> Solution:
    """Raise the bound until a cycle of three steps gains less than `tolerance` per sample.

    One component is at its maximum from the start.
    """
    if state.shape[1] == 1:
        value, there = bound_at(groups, family, state), np.ones(state.shape[-1], dtype=bool)
        return Solution(family, state, groups.origin, value, there)
    state = state.copy()
    bound = np.full(state.shape[-1], -np.inf)
    converged = np.zeros(state.shape[-1], dtype=bool)
    active, here = np.arange(state.shape[-1]), groups
    for _ in range(cycles):
        # An extrapolation may overflow; it is then not taken.
        state[..., active], value = _cycle(here, family, take_last(state, active))
        done = value - bound[active] < tolerance * here.n
        bound[active], converged[active] = value, done
        if done.all():
            break
        # A row that is done does not change, however long the others take.
        if done.any():
            active = active[~done]
            here = here.take(~done)
    return Solution(family, state, groups.origin, bound, converged)


def responsibilities(groups: SampleGroups, family: ComponentFamily, state: Floats) -> Floats:
    """Return how many samples of each group belong to each component, (component, group, row)."""
    return _expect(groups, family, state)[0]


def bound_at(groups: SampleGroups, family: ComponentFamily, state: Floats) -> Floats:
    """Return the bound at a state: the log-likelihood of y, if each group is one sample."""
    coefficients = family.coefficients(state)[:, :, np.newaxis]
    density = log_density(groups.log, family.statistic(groups), coefficients)
    return np.asarray((groups.count * density).sum(axis=0))


def refit(
    groups: SampleGroups, solution: Solution, onto: SampleGroups, family: ComponentFamily
) -> Floats:
    """Return the state of maximum likelihood for other groups or another family.

    The components keep the responsibilities that they have for the groups under a solution.
    """
    shares, _ = _expect(groups, solution.family, solution.state)
    return _maximise(onto, family, shares)


def log_density(log: Floats, statistic: Floats, coefficients: Floats) -> Floats:
    """Return the log density of y, from y, t(y) and their coefficients (3, component, ...)."""
    exponent, top = _exponents(log, statistic, coefficients)
    total = np.log(np.exp(exponent, out=exponent).sum(axis=0))
    # Far beyond every component, all terms and their sum are minus infinity.
    return np.where(top == -np.inf, -np.inf, total + top)


def _cycle(groups: SampleGroups, family: ComponentFamily, state: Floats) -> tuple[Floats, Floats]:
    """Take two steps, extrapolate them, and take a third one from there."""
    one, _ = _step(groups, family, state)
    two, before = _step(groups, family, one)
    far = _extrapolate(state, one, two)
    three, bound = _step(groups, family, family.bounded(far, groups.floor))
    fell = ~(bound >= before)
    three[..., fell] = two[..., fell]
    return three, np.where(fell, before, bound)


def _extrapolate(state: Floats, one: Floats, two: Floats) -> Floats:
    step = one - state
    change = two - one - step
    length = np.sqrt((step * step).sum(axis=(0, 1)) / (change * change).sum(axis=(0, 1)))
    length = np.clip(np.nan_to_num(length, nan=1.0), 1.0, _REACH)
    far = np.asarray(state + 2 * length * step + length**2 * change)
    far[0] -= far[0].max(axis=0)
    far[0] -= np.log(np.exp(far[0]).sum(axis=0))
    return far


def _step(groups: SampleGroups, family: ComponentFamily, state: Floats) -> tuple[Floats, Floats]:
    """Return the next state, and the penalised bound at this one."""
    shares, bound = _expect(groups, family, state)
    return _maximise(groups, family, shares), bound + penalty(family, state, groups.spacing)


def _expect(groups: SampleGroups, family: ComponentFamily, state: Floats) -> tuple[Floats, Floats]:
    """Return responsibilities, shape (component, group, row), and the bound."""
    coefficients = family.coefficients(state)[:, :, np.newaxis]
    exponent, top = _exponents(groups.log, family.statistic(groups), coefficients)
    shares = np.exp(exponent, out=exponent)
    total = shares.sum(axis=0)
    shares *= groups.count / total
    np.log(total, out=total)
    total += top
    total *= groups.count
    return shares, total.sum(axis=0)


def _exponents(log: Floats, statistic: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Return log(weight times density) of the components minus the largest, and the largest."""
    constant, slope, curvature = coefficients
    # In any other order, sums over components and groups take several times as long.
    exponent = np.multiply(slope, log, order="C")
    exponent += np.multiply(curvature, statistic, order="C")
    exponent += constant
    top = exponent.max(axis=0)
    exponent -= top
    # The exponential function is slow where its result vanishes.
    np.maximum(exponent, _VANISHING, out=exponent)
    return exponent, top


def _maximise(groups: SampleGroups, family: ComponentFamily, shares: Floats) -> Floats:
    sizes = np.maximum(shares.sum(axis=1), _LEAST_SIZE)
    log = np.einsum("kcr,cr->kr", shares, groups.log) / sizes
    statistic = np.einsum("kcr,cr->kr", shares, family.statistic(groups)) / sizes
    return state_of(family, sizes, log, statistic, groups.floor, groups.spacing)


def state_of(
    family: ComponentFamily,
    sizes: Floats,
    log: Floats,
    statistic: Floats,
    floor: Floats,
    spacing: Floats,
) -> Floats:
    """Return the state that maximises the penalised likelihood of components.

    Parameters
    ----------
    family
        Family of the components.
    sizes, log, statistic
        Number of samples, mean y and mean t(y) of each component, shape (component, row).
    floor, spacing
        As in `SampleGroups`.
    """
    variance = family.variance(log, statistic)
    if len(sizes) > 1:  # One component has a maximum of its own.
        variance = (sizes * variance + _MORE * (_APART * spacing) ** 2) / (sizes + _MORE)
    log_scale = family.log_scale(np.maximum(variance, floor * floor))
    return np.stack([np.log(sizes / sizes.sum(axis=0)), family.location(log, statistic), log_scale])


def penalty(family: ComponentFamily, state: Floats, spacing: Floats) -> Floats:
    """Return the log density of the samples that components count beside their own, (row,)."""
    each = family.log_density(state[2], (_APART * spacing) ** 2)
    return np.asarray(_MORE * each.sum(axis=0))
