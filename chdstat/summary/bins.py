"""Binning: where the bins of a histogram lie, and which samples they count.

`chdstat.summary.histograms` is the public face of this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Mask, all_good, as_samples, is_bad, is_null
from chdstat.errors import InputError, Reason
from chdstat.samples import Samples

__all__ = [
    "LOG_SUPPORT",
    "SCALES",
    "GivenSupport",
    "Scale",
    "Support",
    "axis_ends",
    "checked_masks",
    "checked_support",
    "linear_support",
    "sample_masks",
    "tile_support",
]

Scale: TypeAlias = Literal["linear", "log"]

SCALES: tuple[Scale, ...] = ("linear", "log")
FIRST_DRAWS = 50
"""Draws whose span sets the linear support."""
LOG_SUPPORT = (1e-5, 1e5)
"""Support of log histograms, in radiance."""

_PADDING = 0.25


@dataclass(frozen=True)
class Support:
    """Where the bins are: [low, high) in radiance, each of the batch's shape.

    A pixel whose samples set no support has NaN there and says why in `reason`.
    """

    low: Floats
    high: Floats
    reason: npt.NDArray[np.int8]


GivenSupport: TypeAlias = Support | tuple[npt.ArrayLike, npt.ArrayLike]


def linear_support(
    x: npt.ArrayLike, *, null: Mask | None = None, bad: Mask | None = None
) -> Support:
    """Return the linear support that the first 50 draws set.

    It is the interval that their good, non-null samples span, padded by 25 % of its length at both
    ends. One value v, or values too near to each other for bins that floating point distinguishes,
    give [0.75 v, 1.25 v]; where there is no sample to go by, or v = 0, there is no support.

    Parameters
    ----------
    x
        Radiance, shape (..., sample).
    null, bad
        As for `histogram`.

    Examples
    --------
    >>> support = linear_support([[1.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    >>> support.low, support.high
    (array([0.5, nan]), array([3.5, nan]))
    >>> Reason(support.reason[1]).name
    'ALL_NULL'

    References
    ----------
    Elek, Thomas, Forbes 2019, section on the instrumentation.
    """
    first = as_samples(x)[..., :FIRST_DRAWS]
    null, bad = (part if part is None else part[..., :FIRST_DRAWS] for part in (null, bad))
    null, bad = checked_masks(first, null, bad)
    if bad is None:
        bad = np.zeros(first.shape, dtype=np.bool_)
    used = ~(null | bad)
    empty = ~used.any(axis=-1)
    low = np.where(used, first, np.inf).min(axis=-1).astype(np.float64)
    high = np.where(used, first, -np.inf).max(axis=-1).astype(np.float64)
    low, high = np.where(empty, 0, low), np.where(empty, 0, high)
    # A span of fewer than 128 floats would only show how floats are spaced.
    size = np.maximum(np.abs(low), np.abs(high))
    point = high - low <= 128 * np.finfo(first.dtype).eps * size
    padding = _PADDING * np.where(point, size, high - low)
    nothing = empty | (size == 0)
    reason = np.select(
        [~empty & nothing, empty & bad.all(axis=-1), empty],
        [Reason.CONSTANT, Reason.ALL_BAD, Reason.ALL_NULL],
        Reason.OK,
    )
    return Support(
        np.where(nothing, np.nan, low - padding),
        np.where(nothing, np.nan, high + padding),
        reason.astype(np.int8),
    )


def tile_support(tile: Samples) -> Support:
    """Return the linear support of a tile, whatever the batches in which it is stored."""
    first = tile.read(ss=slice(FIRST_DRAWS))
    null, bad = sample_masks(first)
    return linear_support(first, null=null, bad=bad)


def checked_support(support: GivenSupport, shape: tuple[int, ...], scale: Scale) -> Support:
    """Return a support of the batch shape, or raise InputError if it cannot hold bins."""
    if not isinstance(support, Support):
        start, stop = (np.asarray(end, dtype=np.float64) for end in support)
        support = Support(start, stop, np.array(Reason.OK, dtype=np.int8))
    try:
        low = np.broadcast_to(support.low, shape)
        high = np.broadcast_to(support.high, shape)
        reason = np.broadcast_to(support.reason, shape)
    except ValueError as error:
        message = (
            f"the support must fit the batch shape {shape}, "
            f"got low and high of shapes {support.low.shape} and {support.high.shape}"
        )
        raise InputError(message) from error
    positive = (low > 0) | (scale == "linear")
    if not ((positive & np.isfinite(low) & np.isfinite(high) & (low < high)) | (reason > 0)).all():
        message = (
            f"the support of a {scale} histogram must be finite with "
            f"{'0 < ' if scale == 'log' else ''}low < high, got low={low} and high={high}"
        )
        raise InputError(message)
    return Support(low.copy(), high.copy(), reason.copy())


def axis_ends(scale: Scale, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the support in the coordinate that the bins divide evenly."""
    return (np.log(low), np.log(high)) if scale == "log" else (low, high)


def sample_masks(block: npt.NDArray[Any]) -> tuple[Mask, Mask | None]:
    """Return which whole samples are null and bad, shape (..., 1, sample); None for none bad."""
    null = is_null(block)[..., np.newaxis, :]
    if all_good(block):
        return null, None
    return null, np.asarray(is_bad(block).any(axis=-2, keepdims=True))


def checked_masks(
    x: npt.NDArray[Any], null: Mask | None, bad: Mask | None
) -> tuple[Mask, Mask | None]:
    """Return which samples are null and bad, by masks that a caller gives; None for none bad."""
    for name, mask in (("null", null), ("bad", bad)):
        if mask is None:
            continue
        try:
            np.broadcast_to(mask, x.shape)
        except ValueError as error:
            expected = f"the {name} mask must broadcast to the samples' shape {x.shape}"
            message = f"{expected}, got {mask.shape}"
            raise InputError(message) from error
    # Two reductions tell the usual case, no bad sample at all, from the rest.
    if not all_good(x):
        bad = is_bad(x) if bad is None else bad | is_bad(x)
    if null is None:
        null = x == 0
    elif (null & (x != 0)).any():
        message = "the null mask marks samples that are not 0; null samples are exactly 0"
        raise InputError(message)
    return (null, None) if bad is None else (null & ~bad, np.broadcast_to(bad, x.shape))
