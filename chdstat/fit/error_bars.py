"""Error bars: how often the 95 % interval that n samples give for their mean holds.

The interval ``mean ± 1.96 s / sqrt(n)`` misses where n samples rarely contain the paths that carry
the light. The samples of one pixel hardly show that, since a pixel that is about to be wrong has
mostly not drawn those paths; its neighbours have. The shape of a pixel is therefore pooled over the
pixels around it, and the coverage of the interval follows from the pooled shape:

- The shape is the histogram of log radiance, relative to the geometric mean of the positive samples
  times their share, so that brightness and albedo do not matter.
- Samples that are so rare that fewer than `_RARE` of them are expected among n arrive as a Poisson
  process; they are grouped by their expected numbers. The sum of the others is Gaussian, and so is
  the sum of their squares.
- Fixed draws of both give means and error bars of n samples, of which a share holds the true mean.
- Logits of that coverage are averaged over a wider window, and calibrated.

An array has no neighbours: its `ErrorBars.coverage_own` follows from its own samples alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import special, stats

from chdstat._core.arrays import (
    Array,
    Counts,
    Floats,
    Mapped,
    Mask,
    first_of,
    label_variables,
    spans,
)
from chdstat._core.positive import PositivePart
from chdstat._core.resampling import Z_95
from chdstat._core.statistic import Result, Statistic, result, variable
from chdstat.errors import Reason

if TYPE_CHECKING:
    import xarray as xr

FAILS, HOLDS = 0.8, 0.9
"""An error bar of 95 % fails below the first coverage, and holds from the second one on."""
LEAST = 64
"""Samples that a verdict needs."""

_RARE = np.array([0, 1 / 8, 1 / 4, 1 / 2, 1, 2, 4, 8, 16, 32])
"""Expected numbers of samples, from the brightest on, between which rare ones are grouped."""
_FEW = 256
"""With fewer samples, the expected numbers are smaller, so that rare samples stay rare."""
_DRAWS = 256
_ROWS = 128
"""Rows whose draws stay in the cache together."""
_DECADES, _WIDTH = (-3.0, 7.2), 0.2
"""Support of a shape in decades, and the width of its bins."""
_BINS = round((_DECADES[1] - _DECADES[0]) / _WIDTH)
_CENTERS = 10 ** (_DECADES[0] + _WIDTH * (np.arange(_BINS) + 0.5))
_POWERS = _CENTERS[:, np.newaxis] ** np.arange(1, 5)
_ROUNDING = 1e-9
_POOL, _AROUND = 1, 3
"""Radii in pixels of the window of shapes, and of that of logits."""
_CLOSE = 0.004
"""Draws cannot tell a coverage from 1, or 0, if it is this close."""


class _Calibration(NamedTuple):
    """``logit(coverage) = shift + slope logit(predicted)``, and its deviation between pixels."""

    shift: float
    slope: float
    deviation: float


_OWN = _Calibration(0.18, 0.813, 0.74)
_POOLED = _Calibration(-0.24, 1.171, 0.63)
"""Fitted to the certified pixels of the eight built-in scenes by ``tools/judge_error_bars.py``."""


@result
class ErrorBars(Result):
    """How often the error bars of pixels hold, from their own samples; arrays of shape (...).

    Attributes
    ----------
    coverage_own, coverage_own_interval
        Share of such intervals of 95 % that hold the true mean, and the interval that holds this
        share for 95 % of path-traced pixels, shape (..., 2). NaN where `reason` says why.
    samples
        Good samples; 0 where all are equal, since these tell nothing of others.
    shape
        Histogram of the positive samples, shape (..., bin).
    reason
        `Reason` codes.
    """

    coverage_own: Floats = variable("share of 95 % error bars that hold, by own samples")
    coverage_own_interval: Floats = variable("interval of that share", "bound")
    samples: Counts = variable("samples of the shape")
    shape: npt.NDArray[np.int32] = variable("samples by relative log radiance", "shape_bin")
    reason: npt.NDArray[np.int8] = variable("why the error bars are not known")


@dataclass(frozen=True)
class Bar(Statistic[ErrorBars]):
    """The error bars of rows of samples, from these samples alone."""

    result: ClassVar = ErrorBars
    description: ClassVar = "judging error bars"

    def measure(self, part: PositivePart) -> ErrorBars:
        """Return the shape of each row, and the coverage that follows from it."""
        logs, n = part.log_statistics, part.n_good
        equal = np.asarray(logs.constant & (part.n == n))
        reason = first_of(
            {
                Reason.ALL_BAD: n == 0,
                Reason.ALL_NULL: (part.n == 0) & (part.n_negative == 0),
                Reason.NONE_POSITIVE: part.n == 0,
                Reason.CONSTANT: equal,
                Reason.TOO_FEW: n < LEAST,
            }
        )
        shape = _shape(part, logs.log_mean + np.log(part.n / np.maximum(n, 1)))
        coverage = np.full(n.shape, np.nan)
        known = np.asarray(reason == Reason.OK)
        predicted = _predicted(shape[known], n[known])
        coverage[known], interval = _calibrated(_logit(predicted), _OWN)
        ends = np.full((*n.shape, 2), np.nan)
        ends[known] = interval
        samples = np.where(equal, 0, n)
        shape[equal] = 0
        return ErrorBars(coverage, ends, samples, shape.astype(np.int32), reason)


def _shape(part: PositivePart, log_level: Floats) -> Counts:
    """Count the positive samples by their logarithm relative to a level, shape (..., bin)."""
    samples = part.x.shape[-1]
    logs, level = part.log_sorted.reshape(-1, samples), log_level.reshape(-1, 1)
    counts = np.zeros((len(logs), _BINS), dtype=np.int64)
    first, step = _DECADES[0] * np.log(10), _WIDTH * np.log(10)
    for rows in spans(len(logs), max(1, 2**18 // max(samples, 1))):
        place = (logs[rows] - level[rows] - first) / step
        # Padding is infinite, and falls into a bin of its own.
        bins = np.where(place < np.inf, np.clip(place, 0, _BINS - 1), _BINS)
        bins = np.where(np.isnan(place), _BINS, bins).astype(np.int64)
        bins += (_BINS + 1) * np.arange(len(bins))[:, np.newaxis]
        found = np.bincount(bins.ravel(), minlength=(_BINS + 1) * len(bins))
        counts[rows] = found.reshape(-1, _BINS + 1)[:, :_BINS]
    return counts.reshape(*part.n.shape, _BINS)


class _PooledBars(NamedTuple):
    """How often the error bars of an image hold, by pixels and those around; shape (y, x, ...).

    Attributes
    ----------
    coverage, interval
        As in `ErrorBars`. NaN where all samples of a pixel are equal, where neither it nor the
        pixels around have a positive sample, and with fewer than 64 samples.
    """

    coverage: Floats
    interval: Floats


def pooled_bars(shape: npt.NDArray[np.int32], samples: Counts) -> _PooledBars:
    """Return how often the error bars of an image hold.

    Shapes are pooled over 3 x 3 pixels, and the logits of the coverages that follow from them are
    averaged over 7 x 7 pixels. Pixels whose samples are all equal do not count.

    Parameters
    ----------
    shape, samples
        As in `ErrorBars`, shapes (y, x, ..., bin) and (y, x, ...).
    """
    used = samples > 0
    counts, total = (_window_sum(a, _POOL) for a in (shape, samples))
    known = used & (counts.sum(axis=-1) > 0) & (samples >= LEAST)
    logit = np.zeros(samples.shape)
    frequent = counts[known] * (samples[known] / total[known])[:, np.newaxis]
    logit[known] = _logit(_predicted(frequent, samples[known]))
    weight = _window_sum(known.astype(np.int64), _AROUND)
    mean = _window_sum(logit, _AROUND) / np.maximum(weight, 1)
    coverage, interval = _calibrated(np.where(known, mean, np.nan), _POOLED)
    return _PooledBars(coverage, interval)


def _window_sum(image: Array, radius: int) -> Array:
    """Return the sums over windows of 2 radius + 1 pixels along y and x, smaller at borders."""
    for axis in (0, 1):
        size = image.shape[axis]
        sums = np.zeros((size + 1, *np.delete(image.shape, axis)), image.dtype)
        np.cumsum(np.moveaxis(image, axis, 0), axis=0, out=sums[1:])
        at = np.arange(size)
        image = sums[np.minimum(at + radius + 1, size)] - sums[np.maximum(at - radius, 0)]
        image = np.moveaxis(image, 0, axis)
    return image


def _logit(coverage: Floats) -> Floats:
    return np.log((coverage + _CLOSE) / (1 + _CLOSE - coverage))


def _calibrated(logit: Floats, by: _Calibration) -> tuple[Floats, Floats]:
    """Return the coverage and its interval, shape (..., 2)."""
    middle = by.shift + by.slope * logit
    ends = [middle + sign * Z_95 * by.deviation for sign in (-1, 1)]
    return special.expit(middle), special.expit(np.stack(ends, axis=-1))


@cache
def _draws(scale: float) -> tuple[Floats, Floats, Floats]:
    """Return numbers of rare samples by group, their scatter, and two of the others, (..., draw).

    The groups have `scale` times the numbers of `_RARE`.

    A scrambled Sobol sequence is even in all dimensions at once.
    """
    rare = scale * np.diff(_RARE)[:, np.newaxis]
    sequence = stats.qmc.Sobol(2 * len(rare) + 2, rng=np.random.default_rng(0))
    level = sequence.random_base2(_DRAWS.bit_length() - 1).T
    normal = special.ndtri(np.clip(level, 1e-9, 1 - 1e-9))
    numbers = stats.poisson.ppf(level[2 : 2 + len(rare)], rare)
    return numbers, np.sqrt(numbers) * normal[2 + len(rare) :], normal[:2]


def _predicted(counts: Floats | Counts, n: Counts) -> Floats:
    """Return the coverage of error bars of n samples, n of which are expected in `counts`.

    Parameters
    ----------
    counts
        Expected numbers of samples by bin, shape (row, bin).
    n
        Number of samples, shape (row,).
    """
    coverage = np.empty(len(n))
    scale = np.minimum(2.0 ** np.floor(np.log2(np.maximum(n, 1) / _FEW)), 1)
    for of in np.unique(scale):
        alike = np.flatnonzero(scale == of)
        for part in spans(len(alike), _ROWS):
            rows = alike[part]
            coverage[rows] = _predicted_rows(counts[rows].astype(np.float64), n[rows], float(of))
    return coverage


def _predicted_rows(counts: Floats, n: Counts, scale: float) -> Floats:
    numbers, scatter, normal = _draws(scale)
    rare = scale * _RARE
    group, size = np.diff(rare), n[:, np.newaxis].astype(np.float64)
    first, second, third, fourth = _sums_above(counts, rare)
    others = size - rare[-1]
    rest = np.maximum(counts @ _POWERS - np.stack([first, second, third, fourth])[..., -1].T, 0)
    mean, square, cube, power = (rest / others).T[..., np.newaxis]
    deviation = np.sqrt(np.maximum(square - mean**2, 0))
    # The sum of squares of the other samples correlates with their sum.
    shared = (cube - mean * square) / np.where(deviation > 0, deviation, np.inf)
    own = np.sqrt(np.maximum(power - square**2 - shared**2, 0))
    first, second = np.diff(first, axis=1) / group, np.diff(second, axis=1) / group
    within = np.sqrt(np.maximum(second - first**2, 0))
    # Columns that multiply the draws: rare samples, their scatter, and two of the others.
    drawn, root, none = numbers.sum(axis=0), np.sqrt(others), np.zeros_like(mean)
    basis = np.vstack([numbers, scatter, normal, np.ones_like(drawn)])
    total = [first - mean, within, root * deviation, none, size * mean]
    squares = [second - square, np.zeros_like(within), root * shared, root * own, size * square]
    average = np.hstack(total) @ basis / size
    variance = np.maximum(np.hstack(squares) @ basis / size - average**2, 0) / (size - 1)
    true = ((first @ group)[:, np.newaxis] + mean * others) / size
    holds = np.abs(average - true) <= Z_95 * np.sqrt(variance) + _ROUNDING * true
    return np.asarray(np.mean(holds, axis=1))


def _sums_above(counts: Floats, numbers: Floats) -> Floats:
    """Return sums of powers 1 to 4 over the brightest samples, shape (power, row, number).

    The samples of a bin are equal.
    """
    from_top = counts[:, ::-1]
    below = np.zeros((len(counts), _BINS + 1))
    np.cumsum(from_top, axis=1, out=below[:, 1:])
    at = np.stack([(below <= k).sum(axis=1) - 1 for k in numbers], axis=1)
    at = np.minimum(at, _BINS - 1)
    part = numbers - np.take_along_axis(below, at, axis=1)
    part = np.minimum(part, np.take_along_axis(from_top, at, axis=1))
    found = np.empty((4, *at.shape))
    for i, values in enumerate(_POWERS[::-1].T):
        np.cumsum(from_top * values, axis=1, out=below[:, 1:])
        found[i] = np.take_along_axis(below, at, axis=1) + part * values[at]
    return found


def verdicts(coverage: Floats) -> tuple[Mask, Mask]:
    """Return where error bars fail, and where they hold; neither where that is not known."""
    return np.asarray(coverage < FAILS), np.asarray(coverage >= HOLDS)


def spp_in_words(samples: Counts) -> str:
    """Return the numbers of samples that verdicts are about: "128 spp", or "64 to 128 spp"."""
    counted = samples[samples > 0]
    if not counted.size:
        return "no samples"
    low, high = int(counted.min()), int(counted.max())
    return f"{low} spp" if low == high else f"{low} to {high} spp"


# --- in the dataset of an image -------------------------------------------------------------------

_BIN = "shape_bin"


def shape_variables(bars: ErrorBars, dims: tuple[str, ...], prefix: str) -> Mapped:
    """Return the variables that `with_pooled_bars` takes from the dataset of an image."""
    return {
        f"{prefix}shape": ((*dims, _BIN), bars.shape),
        f"{prefix}shape_samples": (dims, bars.samples),
    }


def with_pooled_bars(dataset: xr.Dataset, prefix: str) -> xr.Dataset:
    """Replace the shapes of an image by ``coverage`` and ``coverage_interval``, with a prefix."""
    shape, samples = (dataset[f"{prefix}{name}"] for name in ("shape", "shape_samples"))
    bars = pooled_bars(shape.to_numpy(), samples.to_numpy())
    named = {
        f"{prefix}coverage": (samples.dims, bars.coverage),
        f"{prefix}coverage_interval": ((*samples.dims, "bound"), bars.interval),
    }
    of = "95 % error bars that hold, by the pixels around, too"
    labels = {
        f"{prefix}coverage": (f"share of {of}", "1"),
        f"{prefix}coverage_interval": (f"interval of the share of {of}", "1"),
    }
    left = dataset.drop_vars([f"{prefix}shape", f"{prefix}shape_samples"])
    return label_variables(left.assign(named), labels)
