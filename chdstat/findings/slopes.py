"""Slopes: straight lines and correlations over pixels, with their intervals.

Use `slope_of` for how one quantity follows another; with an instrument where that other is noisy.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat.findings.resampling import Blocks, Spread, interval_of

__all__ = ["correlation_of", "logs", "slope_of"]

Floats = npt.NDArray[np.float64]


def slope_of(
    x: Floats, y: Floats, blocks: Blocks, *, instrument: Floats | None = None, level: float
) -> Spread:
    """Return the slope of y on x, ``cov(y, z) / cov(x, z)``.

    Least squares take x itself for the instrument z. Noise in x flattens that slope; an instrument
    that follows x and shares no noise with x and y does not let it.

    Parameters
    ----------
    x, y
        Shape (pixel,) or (pixel, channel); NaN takes no part.
    blocks
        Blocks of the pixels.
    instrument
        Shape of `x`; None for `x`.
    level
        Coverage of the interval.

    References
    ----------
    Durbin, "Errors in variables", 1954, doi:10.2307/1401917.

    Examples
    --------
    >>> x = np.arange(64.0)
    >>> slope_of(x, 3 * x + 1, Blocks.grid(8, 8), level=0.95).value
    3.0
    """
    sums = _sums(x, y, x if instrument is None else instrument, blocks)

    def slope(weights: Floats) -> Floats:
        n, a, b, c, ac, bc, *_ = (weights @ sums).T
        return np.asarray((bc - b * c / n) / (ac - a * c / n))

    return interval_of(slope, blocks, level=level)


def correlation_of(x: Floats, y: Floats, blocks: Blocks, *, level: float) -> Spread:
    """Return Pearson's correlation of x and y, shapes as for `slope_of`."""
    sums = _sums(x, y, x, blocks)

    def correlate(weights: Floats) -> Floats:
        n, a, b, _, aa, ab, bb = (weights @ sums).T
        spread = np.sqrt((aa / n - a**2 / n**2) * (bb / n - b**2 / n**2))
        return np.asarray((ab / n - a * b / n**2) / spread)

    return interval_of(correlate, blocks, level=level, bounds=(-1.0, 1.0))


def logs(values: npt.NDArray[np.float64]) -> Floats:
    """Return logarithms to base 10; NaN where they are not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.log10(values)
    return np.asarray(np.where(np.isfinite(found), found, np.nan))


def _sums(x: Floats, y: Floats, z: Floats, blocks: Blocks) -> Floats:
    """Return number and sums of x, y, z, xz, yz, yy of each block, where all are known."""
    known = np.isfinite(x + y + z)
    x, y, z = (np.where(known, v, 0) for v in (x, y, z))
    columns = np.stack([known, x, y, z, x * z, y * z, y * y], axis=-1)
    return blocks.sums(columns.reshape(len(x), -1, columns.shape[-1]).sum(axis=1))
