"""Silverman's test: how far samples must be smoothed until only so many modes are left.

`critical_bandwidth` is the statistic, `silverman_p` its p-value. Both look at rows of log samples,
through a kernel density on a grid: its values come from the Fourier transform of binned samples,
for all rows and any bandwidth at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import fft

from chdstat._arrays import generator, spans
from chdstat._positive import Counts, Floats

__all__ = ["count_modes", "critical_bandwidth", "silverman_p"]

_GRID, _MARGIN = 256, 4
"""Points of the grid, and those of them beyond the smallest and the largest sample."""
_PERIOD = 3 * _GRID
"""Images of the samples, which the transform repeats, are at least twice their range away."""
_LEAST = 1.0
"""Smallest bandwidth, in cells of the grid."""
_HALVINGS = 11
"""Of the logarithm of the bandwidth: the last interval is 0.3 % wide."""
_LOWEST = 0.1
"""Lowest mode, relative to what a single sample adds to the highest: the rest is rounding."""
_CHUNK = 2**17
"""Samples, or points of the grid, worked on at once."""


@dataclass(frozen=True)
class _Binned:
    """Rows of samples on a grid of their own.

    Attributes
    ----------
    spectrum
        Fourier transform of the counts, shape (row, frequency).
    cell
        Distance of the points of the grid, in units of the samples, shape (row,).
    n
        Samples, shape (row,).
    """

    spectrum: npt.NDArray[np.complex128]
    cell: Floats
    n: Counts

    def modes(self, bandwidth: Floats) -> Counts:
        """Count the maxima of the Gaussian kernel density, shape (row,); bandwidths in cells."""
        frequency = 2 * np.pi / _PERIOD * np.arange(self.spectrum.shape[-1])
        kernel = np.exp(-0.5 * (bandwidth[:, np.newaxis] * frequency) ** 2)
        density = fft.irfft(self.spectrum * kernel, _PERIOD, axis=-1)[:, :_GRID]
        rises = density[:, 1:] > density[:, :-1]
        peaks = rises[:, :-1] & ~rises[:, 1:]
        peaks &= density[:, 1:-1] * self.n[:, np.newaxis] > _LOWEST * density.max(
            axis=-1, keepdims=True
        )
        return np.asarray(np.count_nonzero(peaks, axis=-1), dtype=np.int64)


def critical_bandwidth(log_sorted: Floats, n: Counts, modes: int) -> Floats:
    """Return the smallest bandwidth at which a Gaussian kernel density has at most `modes` maxima.

    The number of maxima falls as the bandwidth grows (Silverman 1981), so that it can be found by
    bisection, here to 0.3 %; a bandwidth below 1/250 of the range of the samples is not resolved.

    Parameters
    ----------
    log_sorted
        Log samples in ascending order, shape (row, sample), padded with infinity.
    n
        How many of them count, shape (row,).
    modes
        At least 1.

    Returns
    -------
    ndarray
        Shape (row,), in units of the samples; NaN for fewer than 2 samples, or equal ones.

    References
    ----------
    Silverman, "Using kernel density estimates to investigate multimodality", 1981,
    doi:10.1111/j.2517-6161.1981.tb01155.x.

    Examples
    --------
    >>> two = np.array([[0.0, 1.0]])
    >>> critical_bandwidth(two, np.array([2]), 1).round(2)  # half of their distance
    array([0.5])
    """
    result = np.full(len(n), np.nan)
    usable = np.flatnonzero(_spread(log_sorted, n) > 0)
    for part in spans(len(usable), max(1, _CHUNK // max(_GRID, log_sorted.shape[-1]))):
        rows = usable[part]
        binned = _bin(log_sorted[rows], n[rows])
        result[rows] = _bisect(binned, modes) * binned.cell
    return result


def count_modes(log_sorted: Floats, n: Counts, bandwidth: Floats) -> Counts:
    """Count the modes of a Gaussian kernel density; arguments as of `critical_bandwidth`.

    `bandwidth` has shape (row,); rows whose samples are not all equal are assumed.
    """
    binned = _bin(log_sorted, n)
    return binned.modes(np.maximum(bandwidth / binned.cell, _LEAST))


def silverman_p(
    log_sorted: Floats,
    n: Counts,
    modes: int,
    *,
    resamples: int = 99,
    seed: int | np.random.Generator | None = 0,
    bandwidth: Floats | None = None,
) -> Floats:
    """Return p-values of the hypothesis that there are at most `modes` modes.

    The smoothed bootstrap draws from the kernel density at the critical bandwidth, scaled to the
    variance of the samples (Efron and Tibshirani 1993, section 16.5); p = (b + 1) / (B + 1), where
    b of B replicates need a larger bandwidth, which they do if they have more modes at this one.

    These p-values are a second opinion, not calibrated ones. Hall and York give the asymptotic
    level of the test for one mode, but only away from the ends of the support, where single samples
    make modes. With 256 samples, p <= 0.05 happens to 1 % of Gaussian ones, 2 % of logarithms of
    gamma ones of shape 3, 10 % of shape 0.5, whose left tail is long, and 31 % of uniform ones.

    Parameters
    ----------
    log_sorted, n, modes
        As of `critical_bandwidth`.
    resamples
        Replicates B.
    seed
        Of the draws; replicates are consecutive draws of one generator.
    bandwidth
        Critical bandwidths, for whoever has them.

    Returns
    -------
    ndarray
        Shape (row,); NaN where there is no critical bandwidth.

    References
    ----------
    Silverman, "Using kernel density estimates to investigate multimodality", 1981,
    doi:10.1111/j.2517-6161.1981.tb01155.x. Hall and York, "On the calibration of Silverman's test
    for multimodality", Statistica Sinica 11, 2001, 515-536. Davison and Hinkley, "Bootstrap methods
    and their application", 1997, equation 4.11, doi:10.1017/CBO9780511802843.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> x = np.sort(rng.normal([[0.0], [0.0]], 1, size=(2, 300)))
    >>> x[1, 150:] += 8
    >>> silverman_p(x, np.array([300, 300]), 1) > 0.05
    array([ True, False])
    """
    rng = generator(seed)
    h = critical_bandwidth(log_sorted, n, modes) if bandwidth is None else bandwidth
    result = np.full(len(n), np.nan)
    usable = np.flatnonzero(np.isfinite(h))
    for part in spans(len(usable), max(1, _CHUNK // max(_GRID, log_sorted.shape[-1]))):
        rows = usable[part]
        more = np.zeros(len(rows), dtype=np.int64)
        for _ in range(resamples):
            drawn = _replicate(log_sorted[rows], n[rows], h[rows], rng)
            more += count_modes(drawn, n[rows], h[rows]) > modes
        result[rows] = (more + 1) / (resamples + 1)
    return result


def _bisect(binned: _Binned, modes: int) -> Floats:
    """Return critical bandwidths in cells: no density of a bandwidth of its range has two modes."""
    low, high = np.full(len(binned.n), np.log(_LEAST)), np.full(len(binned.n), np.log(_GRID))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        enough = binned.modes(np.exp(middle)) <= modes
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return np.asarray(np.exp(high))


def _spread(log_sorted: Floats, n: Counts) -> Floats:
    last = np.take_along_axis(log_sorted, np.maximum(n - 1, 0)[:, np.newaxis], axis=-1)[:, 0]
    with np.errstate(invalid="ignore"):
        return np.where(n > 1, last - log_sorted[:, 0], 0.0)


def _bin(log: Floats, n: Counts) -> _Binned:
    """Share each sample between the two points next to it; samples may have any order."""
    present = np.arange(log.shape[-1]) < n[:, np.newaxis]
    low = np.where(present, log, np.inf).min(axis=-1)
    high = np.where(present, log, -np.inf).max(axis=-1)
    cell = (high - low) / (_GRID - 1 - 2 * _MARGIN)
    place = (np.where(present, log, low[:, np.newaxis]) - low[:, np.newaxis]) / cell[:, np.newaxis]
    left = np.minimum(place.astype(np.int64), _GRID - 2 - 2 * _MARGIN)
    right = place - left
    index = (left + _MARGIN + np.arange(len(log))[:, np.newaxis] * _GRID).ravel()
    size = len(log) * _GRID
    counts = np.bincount(index, (present - present * right).ravel(), size)
    counts += np.bincount(index + 1, (present * right).ravel(), size)
    spectrum = fft.rfft(counts.reshape(-1, _GRID), _PERIOD, axis=-1)
    return _Binned(spectrum=spectrum, cell=cell, n=n)


def _replicate(log: Floats, n: Counts, h: Floats, rng: np.random.Generator) -> Floats:
    """Draw as many samples from the kernel density, in no order, with the samples' variance."""
    present = np.arange(log.shape[-1]) < n[:, np.newaxis]
    known = np.where(present, log, 0.0)
    mean = (known.sum(axis=-1) / n)[:, np.newaxis]
    variance = np.where(present, (known - mean) ** 2, 0.0).sum(axis=-1) / n
    shrink = 1 / np.sqrt(1 + h**2 / variance)
    which = (rng.random(log.shape) * n[:, np.newaxis]).astype(np.int64)
    noise = h[:, np.newaxis] * rng.standard_normal(log.shape)
    drawn = np.take_along_axis(known, which, axis=-1) - mean + noise
    return np.asarray(mean + drawn * shrink[:, np.newaxis])
