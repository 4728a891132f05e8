"""Density: samples that are alone in image and colour space are outliers.

`decoro2010` leaves out samples with too few like them in the pixels around, and averages the rest.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels, is_bad, spans
from chdstat._core.image_scales import exposure_unit
from chdstat.errors import InputError
from chdstat.estimators.order import mean_of_good
from chdstat.estimators.registry import register
from chdstat.estimators.rows import Floats

__all__ = ["decoro2010", "dense"]

_BLACK = 1e-2
"""Radiance, of an image exposed as usual, below which colours are as good as black."""
_FAR = 1e30
"""Half a squared distance that is never bridged."""
_CHUNK = 2**17
"""Distances computed at once."""


@register(
    "decoro2010",
    source="DeCoro et al. 2010, doi:10.1111/j.1467-8659.2010.01799.x",
    uses_neighbours=True,
    joint_channels=True,
)
def decoro2010(
    x: npt.ArrayLike,
    *,
    neighbours: int = 4,
    bandwidth: float = 1.0,
    radius: int = 1,
    unit: float | None = None,
) -> npt.NDArray[np.floating[Any]]:
    """Mean of the samples that are not alone in joint image and colour space.

    A sample stays if at least k others are less than 1 away, ``d^2 = (dx^2 + dy^2) / (r + 1)^2 +
    mean_c (log x_c - log x'_c)^2 / h^2``. That is the same as a bound on the distance to its k-th
    nearest neighbour, the classical estimate of a density.

    Reconstructed from the paper's abstract, which characterises outliers by their density among
    nearby paths in joint image and colour space; metric, bounds and defaults are ours. Colours are
    those of an image exposed as usual, and what is darker than 0.01 of that is black: dim samples
    and negative ones are not outliers. Bias is to the dark, more where a bright event is rare but
    real.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    neighbours
        k, at least 1.
    bandwidth
        h, the difference of natural logarithms that counts as 1, larger than 0.
    radius
        r, in pixels: samples up to r pixels away count; 0 for those of the pixel alone.
    unit
        Radiance that is exposed as 1; None makes the log-average of the image 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Where all samples of a pixel
        are alone, and where no whole sample is good, the mean of a channel's good samples; NaN
        where there are none of these.

    Raises
    ------
    InputError
        If `x` is no image, or an option is out of range.

    References
    ----------
    C. DeCoro, T. Weyrich and S. Rusinkiewicz, "Density-based outlier rejection in Monte Carlo
    rendering", Computer Graphics Forum 29(7), 2010, doi:10.1111/j.1467-8659.2010.01799.x.
    D. O. Loftsgaarden and C. P. Quesenberry, "A nonparametric estimate of a multivariate density
    function", Annals of Mathematical Statistics 36(3), 1965, doi:10.1214/aoms/1177700079.

    Examples
    --------
    >>> image = np.ones((3, 3, 3, 8))
    >>> image[1, 1, :, 0] = 900.0
    >>> decoro2010(image)[1, 1].tolist()
    [1.0, 1.0, 1.0]
    """
    if neighbours < 1 or not bandwidth > 0 or radius < 0:
        message = (
            "neighbours must be at least 1, bandwidth larger than 0 and radius at least 0, "
            f"got {neighbours}, {bandwidth} and {radius}"
        )
        raise InputError(message)
    samples = as_pixels(x, image=True)
    bad = np.asarray(is_bad(samples).any(axis=-2))
    kept = dense(samples, bad, neighbours, bandwidth, radius, unit) & ~bad
    alone = ~kept.any(axis=-1)
    count = np.maximum(np.count_nonzero(kept, axis=-1), 1)[..., np.newaxis]
    # A product with the mask would turn what is left out, infinite or NaN, into NaN.
    chosen = np.where(kept[..., np.newaxis, :], samples, 0)
    found = chosen.sum(axis=-1, dtype=np.float64) / count
    found[alone] = mean_of_good(samples[alone])
    return np.asarray(found.astype(samples.dtype))


def dense(
    x: npt.NDArray[np.floating[Any]],
    bad: npt.NDArray[np.bool_],
    neighbours: int,
    bandwidth: float,
    radius: int,
    unit: float | None,
) -> npt.NDArray[np.bool_]:
    """Mark the samples (y, x, channel, sample) with enough others near; shape (y, x, sample)."""
    height, width, channels, n = x.shape
    colours = _log_colours(x, bad, unit) / (bandwidth * np.sqrt(channels))
    # a . b - |b|^2 / 2 + limit / 2 > |a|^2 / 2 is |a - b|^2 < limit: one product tells.
    half = 0.5 * np.vecdot(colours, colours)
    here = np.concatenate([colours, np.ones((*half.shape, 1))], axis=-1)
    edge = ((radius, radius), (radius, radius), (0, 0))
    # Bad samples, and what lies outside the image, are far from everything.
    far = np.pad(np.where(bad, _FAR, half), edge, constant_values=_FAR)
    padded = np.concatenate([np.pad(colours, (*edge, (0, 0))), -far[..., np.newaxis]], axis=-1)
    found = np.empty((height, width, n), dtype=bool)
    for y in range(height):
        for part in spans(width, max(1, _CHUNK // (n**2 * (2 * radius + 1) ** 2))):
            there = _window(padded[y : y + 2 * radius + 1], part, radius)
            near = here[y, part] @ there.swapaxes(-1, -2) > half[y, part, :, np.newaxis]
            # The sample itself is always near.
            found[y, part] = np.count_nonzero(near, axis=-1) > neighbours
    return found


def _window(strip: Floats, part: slice, radius: int) -> Floats:
    """Return what lies around some pixels of the middle row of a strip, shape (pixel, -1, :)."""
    offsets = range(2 * radius + 1)
    pieces = [strip[dy, part.start + dx : part.stop + dx] for dy in offsets for dx in offsets]
    for place, piece in enumerate(pieces):
        dy, dx = divmod(place, 2 * radius + 1)
        distance = ((dx - radius) ** 2 + (dy - radius) ** 2) / (radius + 1) ** 2
        pieces[place] = piece + np.append(np.zeros(piece.shape[-1] - 1), 0.5 * (1 - distance))
    return np.concatenate(pieces, axis=1)


def _log_colours(
    x: npt.NDArray[Any], bad: npt.NDArray[np.bool_], unit: float | None
) -> npt.NDArray[np.float64]:
    """Return log(max(x / unit, 0) + black), shape (y, x, sample, channel)."""
    good = np.where(bad[..., np.newaxis, :], 0, x) if bad.any() else x
    found = exposure_unit(good.mean(axis=(-1, -2), dtype=np.float64), unit)
    relative = np.ascontiguousarray(good.swapaxes(-1, -2)) / np.float64(found)
    np.maximum(relative, 0, out=relative)
    relative += _BLACK
    return np.asarray(np.log(relative, out=relative))
