"""Windows: sums over the pixels around, weighted by how alike each of them is.

`pool` walks over the offsets of a window and shifts the picture by each, so that all pixels of an
offset are compared at once. A pair of pixels is compared once and counts both ways: what one pixel
takes from another, that one takes from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans, whole
from chdstat.errors import InputError
from chdstat.estimators._rows import Floats
from chdstat.estimators.classical import mean_of_good

__all__ = [
    "Weigh",
    "check_window",
    "patch_mean",
    "patch_sum",
    "pool",
    "quotient",
    "with_own",
    "with_weight",
]

Weigh = Callable[[tuple[Floats, ...], tuple[Floats, ...]], Floats]
"""Weights (y, x) of pixels, from the fields here and the fields at an offset, each (y, x, ...)."""

_PIXELS = 2**15
"""Pixels compared at once."""


def pool(
    weigh: Weigh,
    fields: tuple[Floats, ...],
    values: Floats,
    squares: Floats | None = None,
    *,
    radius: int,
    reach: int = 0,
) -> tuple[Floats, Floats]:
    """Add up what lies within a window, each pixel by its weight.

    Parameters
    ----------
    weigh
        Weights of pairs; the pixel itself counts with weight 1.
    fields
        What `weigh` compares, each of shape (y, x, ...).
    values, squares
        What is added up, shape (y, x, value): values by the weights, squares by the squared
        weights, as variances of the former are.
    radius
        Pixels up to this far in y and in x belong to the window.
    reach
        How many rows around a pair its weight depends on.

    Returns
    -------
    tuple of ndarray
        Both sums, shape (y, x, value); outside the picture there is nothing.
    """
    beside = np.zeros((*values.shape[:2], 0)) if squares is None else squares
    height, width = values.shape[:2]
    sums, squared = np.empty_like(values), np.empty_like(beside)
    halo = radius + reach
    for rows in spans(height, max(halo, _PIXELS // max(width, 1), 1)):
        # Strips with what they depend on around them give what the whole picture does.
        strip = slice(max(rows.start - halo, 0), rows.stop + halo)
        found = _pool(weigh, [f[strip] for f in fields], values[strip], beside[strip], radius)
        inner = slice(rows.start - strip.start, rows.stop - strip.start)
        sums[rows], squared[rows] = found[0][inner], found[1][inner]
    return sums, squared


def patch_sum(values: Floats, radius: int) -> Floats:
    """Add up (y, x) over patches of (2 radius + 1)^2 pixels; outside, there is nothing."""
    if radius == 0:
        return values
    height, width = values.shape
    padded = np.pad(values, radius)
    rows = padded[:height].copy()
    for step in range(1, 2 * radius + 1):
        rows += padded[step : step + height]
    total = rows[:, :width].copy()
    for step in range(1, 2 * radius + 1):
        total += rows[:, step : step + width]
    return total


def patch_mean(values: Floats, known: npt.NDArray[np.bool_], radius: int) -> Floats:
    """Average what is known of (y, x) over patches; infinite where nothing is."""
    count = patch_sum(known.astype(values.dtype), radius)
    total = patch_sum(np.where(known, values, 0), radius)
    return np.divide(total, count, out=np.full_like(total, np.inf), where=count > 0)


def with_weight(values: Floats, weight: npt.NDArray[Any]) -> Floats:
    """Return values (y, x, value) times weights (y, x), and these behind; 0 if unknown."""
    weights = weight[..., np.newaxis].astype(np.float64)
    known = (weights > 0) & np.isfinite(values).all(axis=-1, keepdims=True)
    parts = np.where(known, values * weights, 0), np.where(known, weights, 0)
    return np.concatenate(parts, axis=-1)


def quotient(sums: Floats) -> Floats:
    """Return the averages of what `with_weight` has prepared; NaN where nothing has weight."""
    weight = sums[..., -1:]
    return np.divide(
        sums[..., :-1], weight, out=np.full_like(sums[..., :-1], np.nan), where=weight > 0
    )


def with_own(
    estimate: Floats, samples: npt.NDArray[np.floating[Any]], count: npt.NDArray[np.int64]
) -> npt.NDArray[Any]:
    """Put the mean of a channel's own good samples where there is no estimate, or no count."""
    missing = (count == 0) | ~np.isfinite(estimate).all(axis=-1)
    if missing.any():
        estimate[missing] = mean_of_good(samples[missing])
    return estimate.astype(samples.dtype)


def check_window(
    radius: int,
    *,
    patch: int = 0,
    alpha: float = 0.5,
    above_zero: Mapping[str, float] | None = None,
) -> None:
    """Refuse options of a shared estimator that are out of range."""
    whole("radius", radius, least=0)
    whole("patch", patch, least=0)
    if not 0 < alpha < 1:
        message = f"alpha must lie between 0 and 1, got {alpha}"
        raise InputError(message)
    for name, value in (above_zero or {}).items():
        if not value > 0:
            message = f"{name} must be larger than 0, got {value}"
            raise InputError(message)


def _pool(
    weigh: Weigh, fields: list[Floats], values: Floats, squares: Floats, radius: int
) -> tuple[Floats, Floats]:
    sums, squared = values.copy(), squares.copy()
    height, width = values.shape[:2]
    for here, there in _pairs(height, width, radius):
        weight = weigh(tuple(f[here] for f in fields), tuple(f[there] for f in fields))
        weight = weight[..., np.newaxis]
        for target, source in ((here, there), (there, here)):
            sums[target] += weight * values[source]
            squared[target] += weight**2 * squares[source]
    return sums, squared


def _pairs(
    height: int, width: int, radius: int
) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Yield, for every offset in one half of the window, the places of both pixels of the pairs."""
    for dy in range(min(radius, height - 1) + 1):
        most = min(radius, width - 1)
        for dx in range(-most if dy else 1, most + 1):
            left, right = (
                slice(max(-dx, 0), width - max(dx, 0)),
                slice(max(dx, 0), width + min(dx, 0)),
            )
            yield (slice(0, height - dy), left), (slice(dy, height), right)
