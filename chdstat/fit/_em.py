"""Expectation-maximisation: mixtures of exponential families, fitted to cells, all rows at once.

The responsibilities of a cell are those of its mean sufficient statistics: of all that do not
differ within cells, they give the largest lower bound of the log-likelihood, and every step raises
it (Verbeek, Nunnink and Vlassis, "Accelerated EM-based clustering of large data sets", 2006,
doi:10.1007/s10618-005-0033-3). Steps are extrapolated by SQUAREM (Varadhan and Roland, "Simple and
globally convergent methods for accelerating the convergence of any EM algorithm", 2008,
doi:10.1111/j.1467-9469.2007.00585.x, scheme S3), which is undone wherever the bound falls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chdstat._positive import Floats, Mask
from chdstat.fit._cells import Cells
from chdstat.fit._components import ComponentFamily

__all__ = ["Climb", "bound_at", "climb", "log_density", "maximise", "responsibilities"]

_LEAST = 1e-10
"""Least share of a component, so that it keeps a place and a width."""
_VANISHING = -80.0
"""Log of a share that is as good as none."""
_REACH = 64.0
"""Longest extrapolation, in steps."""


class Climb(NamedTuple):
    """Where a climb ended: state (3, component, row), bound (row,), converged (row,)."""

    state: Floats
    bound: Floats
    converged: Mask


class _Data(NamedTuple):
    """What a step needs of cells: samples, y, t(y), shape (cell, row); floor, n, shape (row,).

    There are many more rows than cells: with rows last, loops are long, and take half the time.
    """

    samples: Floats
    log: Floats
    statistic: Floats
    floor: Floats
    n: Floats

    @classmethod
    def of(cls, cells: Cells, family: ComponentFamily) -> _Data:
        by_cell = (cells.count, cells.log, family.statistic(cells))
        samples, log, statistic = (np.ascontiguousarray(values.T) for values in by_cell)
        return cls(samples, log, statistic, cells.floor, cells.n)

    def take(self, rows: Mask) -> _Data:
        """Return some of the rows."""
        return _Data(*(values[..., rows] for values in self))


def climb(
    cells: Cells, family: ComponentFamily, state: Floats, *, cycles: int, tolerance: float
) -> Climb:
    """Raise the bound until a cycle of three steps gains less than `tolerance` per sample."""
    state = state.copy()
    bound = np.full(state.shape[-1], -np.inf)
    converged = np.zeros(state.shape[-1], dtype=bool)
    active = np.arange(state.shape[-1])
    data = _Data.of(cells, family)
    for _ in range(cycles):
        # Extrapolation may leave the numbers; what it reached is then not taken.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            state[..., active], value = _cycle(data, family, state[..., active])
        done = value - bound[active] < tolerance * data.n
        bound[active], converged[active] = value, done
        if done.all():
            break
        # Leaving out rows costs a copy: it pays only for many of them.
        if 8 * np.count_nonzero(done) > done.size:
            active = active[~done]
            data = data.take(~done)
    return Climb(state, bound, converged)


def responsibilities(cells: Cells, family: ComponentFamily, state: Floats) -> Floats:
    """Return how many samples of each cell belong to each component, (component, row, cell)."""
    return _expect(_Data.of(cells, family), family.coefficients(state))[0].transpose(0, 2, 1)


def bound_at(cells: Cells, family: ComponentFamily, state: Floats) -> Floats:
    """Return the bound at a state: the log-likelihood of y, if each cell is one sample."""
    return _expect(_Data.of(cells, family), family.coefficients(state))[1]


def maximise(cells: Cells, family: ComponentFamily, belonging: Floats) -> Floats:
    """Return the state of maximum likelihood, given responsibilities."""
    return _maximise(_Data.of(cells, family), family, belonging.transpose(0, 2, 1))


def log_density(log: Floats, statistic: Floats, coefficients: Floats) -> Floats:
    """Return the log density of y at cells or samples, shape (row, cell)."""
    with np.errstate(over="ignore", invalid="ignore"):
        exponent, top = _exponents(log, statistic, coefficients[..., np.newaxis])
        total = np.log(np.exp(exponent, out=exponent).sum(axis=0))
        # Far beyond every component, all terms are minus infinity, and so is their sum.
        return np.where(top == -np.inf, -np.inf, total + top)


def _cycle(data: _Data, family: ComponentFamily, state: Floats) -> tuple[Floats, Floats]:
    """Take two steps, extrapolate them, and take a third one from there."""
    one, _ = _step(data, family, state)
    two, before = _step(data, family, one)
    far = _extrapolate(state, one, two)
    three, bound = _step(data, family, family.bounded(far, data.floor))
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


def _step(data: _Data, family: ComponentFamily, state: Floats) -> tuple[Floats, Floats]:
    """Return the next state, and the bound at this one."""
    belonging, bound = _expect(data, family.coefficients(state))
    return _maximise(data, family, belonging), bound


def _expect(data: _Data, coefficients: Floats) -> tuple[Floats, Floats]:
    """Return responsibilities, shape (component, cell, row), and the bound."""
    exponent, top = _exponents(data.log, data.statistic, coefficients[:, :, np.newaxis])
    belonging = np.exp(exponent, out=exponent)
    total = belonging.sum(axis=0)
    belonging *= data.samples / total
    np.log(total, out=total)
    total += top
    total *= data.samples
    return belonging, total.sum(axis=0)


def _exponents(log: Floats, statistic: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Return the logs of weight times density of the components less their largest, and that."""
    constant, slope, curvature = coefficients
    # In this order, or else sums over components and cells take several times as long.
    exponent = np.multiply(slope, log, order="C")
    exponent += np.multiply(curvature, statistic, order="C")
    exponent += constant
    top = exponent.max(axis=0)
    exponent -= top
    # The exponential function is slow where it vanishes.
    np.maximum(exponent, _VANISHING, out=exponent)
    return exponent, top


def _maximise(data: _Data, family: ComponentFamily, belonging: Floats) -> Floats:
    sizes = np.maximum(belonging.sum(axis=1), _LEAST)
    log = np.einsum("kcr,cr->kr", belonging, data.log) / sizes
    statistic = np.einsum("kcr,cr->kr", belonging, data.statistic) / sizes
    return family.maximise(sizes / data.n, log, statistic, data.floor)
