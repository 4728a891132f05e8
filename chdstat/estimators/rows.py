"""What estimators of one row of samples share: the walk over rows, and root finding.

An estimator is written as a kernel on rows of good samples. `estimate_rows` hands them over in
float64, with their mean size brought to about 1 by a power of two, which changes no digit: squares
and cubes of a radiance of 1e30 or of subnormal radiance neither overflow nor vanish. Rows that miss
samples are gathered by how many they have, so that a kernel never sees a mask.

Roots are where a decreasing sum over the samples of a row crosses zero, found by Newton's steps
inside a bracket that shrinks with every one of them; rows that have arrived drop out. They serve
every M-estimator whose influence function is monotone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import all_good, generator, is_bad, spans
from chdstat.errors import InputError

__all__ = [
    "Floats",
    "balance",
    "check_positive",
    "check_probability",
    "estimate_rows",
    "median_of_sorted",
    "reordered",
    "row_sums",
]

Floats = npt.NDArray[np.float64]

_CHUNK = 2**15
"""Samples worked on at once: their float64 copies, and those of a kernel, stay in the cache."""


def estimate_rows(
    x: npt.NDArray[np.floating[Any]],
    kernel: Callable[..., Floats],
    *beside: npt.NDArray[np.floating[Any]],
    ordered: bool = False,
) -> npt.NDArray[Any]:
    """Estimate from the good samples of each row.

    Parameters
    ----------
    x
        Samples, shape (..., sample).
    kernel
        ``kernel(rows, *beside) -> (row,)`` for rows (row, m) of m >= 1 good samples and what stands
        beside them (row,). Equivariant under a change of the unit of radiance.
    beside
        Radiances that belong to the rows, shape (...).
    ordered
        Whether the kernel wants ascending samples. Without, a row that misses samples is sorted,
        too, so the kernel must not depend on their order.

    Returns
    -------
    ndarray
        Shape (...), dtype of `x`; NaN where no sample is good.
    """
    rows = x.reshape(-1, x.shape[-1])
    others = [other.reshape(-1) for other in beside]
    result = np.full(len(rows), np.nan)
    for where, good in _good_rows(rows, ordered):
        relative = good.astype(np.float64)
        m = relative.shape[-1]
        _, exponent = np.frexp(np.abs(relative) @ np.full(m, 1 / m))
        # The unit and its inverse are finite for every mean, 0 included.
        unit = np.ldexp(1.0, exponent - 1)
        relative /= unit[:, np.newaxis]
        result[where] = kernel(relative, *(other[where] / unit for other in others)) * unit
    return result.astype(x.dtype).reshape(x.shape[:-1])


def _good_rows(rows: npt.NDArray[Any], ordered: bool) -> Iterator[tuple[Any, npt.NDArray[Any]]]:
    """Yield the good samples of some rows, as many of each, and the places of these rows."""
    for part in spans(len(rows), max(1, _CHUNK // rows.shape[-1])):
        chunk = rows[part]
        if all_good(chunk):
            yield part, np.sort(chunk) if ordered else chunk
            continue
        # Bad samples sort behind the others.
        ascending = np.sort(np.where(is_bad(chunk), np.inf, chunk))
        count = np.count_nonzero(np.isfinite(ascending), axis=-1)
        for m in np.unique(count[count > 0]):
            same = np.flatnonzero(count == m)
            yield part.start + same, ascending[same, :m]


def row_sums(rows: Floats) -> Floats:
    """Return the sums of rows; a product with ones adds short rows up faster than a sum does."""
    return np.asarray(rows @ np.ones(rows.shape[-1]))


def median_of_sorted(rows: Floats) -> Floats:
    """Return the medians of ascending rows."""
    m = rows.shape[-1]
    return np.asarray(0.5 * (rows[:, (m - 1) // 2] + rows[:, m // 2]))


def check_positive(**options: float) -> None:
    """Refuse options, by name, that are not larger than 0."""
    for name, value in options.items():
        if not value > 0:
            message = f"{name} must be larger than 0, got {value}"
            raise InputError(message)


def check_probability(**options: float) -> None:
    """Refuse options, by name, that do not lie between 0 and 1."""
    for name, value in options.items():
        if not 0 < value < 1:
            message = f"{name} must lie between 0 and 1, got {value}"
            raise InputError(message)


def reordered(
    x: npt.NDArray[np.floating[Any]], *beside: npt.NDArray[np.floating[Any]]
) -> list[npt.NDArray[np.floating[Any]]]:
    """Return samples (..., channel, sample) in a random order that theirs does not change.

    What splits samples by their places then finds the same parts in whatever order they come, and
    in whatever unit. They are sorted, and then shuffled in each pixel: the parts would else be of
    bright samples, or of dark ones.

    Parameters
    ----------
    x, beside
        Arrays of one shape, which come into one order.

    Examples
    --------
    >>> one, two = (reordered(np.array([[3.0, 1.0, 2.0][::step]]))[0] for step in (1, -1))
    >>> bool((one == two).all())
    True
    """
    arrays = [array.reshape(-1, *array.shape[-2:]) for array in (x, *beside)]
    ordered, rng = [np.empty_like(array) for array in arrays], generator(0)
    for part in spans(len(arrays[0]), max(1, _CHUNK // x.shape[-1])):
        keys = np.concatenate([array[part] for array in arrays], axis=1)
        rank = np.lexsort(np.moveaxis(keys, 1, 0), axis=-1)
        places = np.take_along_axis(rank, rng.random(rank.shape).argsort(axis=-1), axis=-1)
        for array, own in zip(arrays, ordered, strict=True):
            own[part] = np.take_along_axis(array[part], places[:, np.newaxis], axis=-1)
    return [own.reshape(array.shape) for own, array in zip(ordered, (x, *beside), strict=True)]


_TOLERANCE = 1e-12
"""Of a step, relative to the sample of the row that is farthest from 0."""
_STEPS = 100
"""Bisection alone arrives in half as many."""


def balance(
    influence: Callable[..., tuple[Floats, Floats]], rows: Floats, start: Floats, *beside: Floats
) -> Floats:
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
