"""Roots: the location at which a decreasing sum over the samples of a row crosses zero.

Newton's steps, kept inside a bracket that shrinks with every one of them; rows that have arrived
drop out. Serves every M-estimator whose influence function is monotone.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from chdstat.estimators._rows import Floats

__all__ = ["balance"]

Balance = Callable[..., tuple[Floats, Floats]]

_TOLERANCE = 1e-12
"""Of a step, relative to the sample of the row that is farthest from 0."""
_STEPS = 100
"""Bisection alone arrives in half as many."""


def balance(influence: Balance, rows: Floats, start: Floats, *beside: Floats) -> Floats:
    """Solve sum_i psi(x_i - theta) = 0 for theta in each row.

    Parameters
    ----------
    influence
        ``influence(rows, theta, *beside)`` returns the sum and minus its derivative by theta,
        shape (row,). The sum decreases with theta.
    rows
        Samples, shape (row, m).
    start
        First guesses within the range of their row, shape (row,).
    beside
        Whatever else belongs to the rows, shape (row,).
    """
    theta = start.copy()
    low, high = rows.min(axis=-1), rows.max(axis=-1)
    near = _TOLERANCE * np.maximum(high, -low)
    left = np.flatnonzero(low < high)
    rows, near, low, high = rows[left], near[left], low[left], high[left]
    beside = tuple(other[left] for other in beside)
    for _ in range(_STEPS):
        if not left.size:
            break
        here = theta[left]
        total, slope = influence(rows, here, *beside)
        low, high = np.where(total > 0, here, low), np.where(total < 0, here, high)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            there = here + total / slope
        # A bracket also catches the steps that a flat piece sends anywhere, NaN included.
        there = np.where((there >= low) & (there <= high), there, 0.5 * (low + high))
        there = np.where(total == 0, here, there)
        theta[left] = there
        going = np.abs(there - here) > near
        if not going.all():
            left, rows, near = left[going], rows[going], near[going]
            low, high = low[going], high[going]
            beside = tuple(other[going] for other in beside)
    return theta
