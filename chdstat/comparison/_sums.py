"""Sums: what is added up of the errors of estimators, and the measures that it comes to.

Every measure is a ratio of sums over units, so that one bootstrap over the units serves them all.
A unit is a block of pixels with all their batches, or a batch with all its pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat.metrics import Interval, bootstrap, relative_squared_error

__all__ = ["MEASURES", "SUMS", "ErrorSums", "errors_of", "is_mean", "stack_intervals"]

Array = npt.NDArray[Any]

MEASURES = {
    "mse": ("mean squared error", "(W sr-1 m-2)^2"),
    "relmse": ("relative mean squared error", "1"),
    "improved": ("share of estimates closer to the reference than the sample mean", "1"),
    "unchanged": ("share of estimates equal to the sample mean", "1"),
    "bias": ("mean error over mean reference", "1"),
    "fireflies": ("share of estimates far brighter than the reference", "1"),
    "mse_ratio": ("mean squared error over that of the sample mean", "1"),
    "relmse_ratio": ("relative mean squared error over that of the sample mean", "1"),
    "fireflies_left": ("fireflies over those of the sample mean", "1"),
}
"""Long name and unit of every measure."""

SUMS = ("squared", "relative", "improved", "unchanged", "firefly", "error")
"""What is added up for every estimator and channel."""

_SAME = 1e-6
"""Relative difference below which an estimate is the mean, summed in another order."""
_FIREFLY = 3.0
"""Excess over the reference, in units of it, from which an estimate is a firefly: two stops."""


@dataclass(frozen=True)
class ErrorSums:
    """Sums of errors, one row a unit.

    Attributes
    ----------
    sums
        By the names of `SUMS`, shape (unit, sum, 1 + estimator, channel); the sample mean is
        estimator 0.
    reference
        Sum of the references, radiance, shape (unit, channel).
    count
        Estimates of each channel that were added, shape (unit,).
    """

    sums: npt.NDArray[np.float64]
    reference: npt.NDArray[np.float64]
    count: npt.NDArray[np.int64]

    @classmethod
    def empty(cls, units: int, estimators: int, channels: int) -> ErrorSums:
        """Return zeros for a number of estimators beside the sample mean."""
        return cls(
            np.zeros((units, len(SUMS), 1 + estimators, channels)),
            np.zeros((units, channels)),
            np.zeros(units, np.int64),
        )

    def __getitem__(self, units: Any) -> ErrorSums:
        """Return the sums of some units."""
        return ErrorSums(self.sums[units], self.reference[units], self.count[units])

    def joined(self, groups: npt.NDArray[np.int64]) -> ErrorSums:
        """Return the sums of units of the same group, in the order of the groups' numbers."""
        _, group = np.unique(groups, return_inverse=True)
        found = ErrorSums.empty(
            group.max(initial=-1) + 1, self.sums.shape[2] - 1, self.sums.shape[3]
        )
        np.add.at(found.sums, group, self.sums)
        np.add.at(found.reference, group, self.reference)
        np.add.at(found.count, group, self.count)
        return found

    def measures(self, *, seed: int) -> dict[str, Interval]:
        """Return every measure with its interval over units, shape (estimator, channel + 1).

        The last place of the channel axis is the average over channels. The measures of a single
        unit have no interval.
        """
        used = self[self.count > 0]
        units, channels = used.reference.shape
        parts = used.sums.reshape(units, -1), used.reference, used.count[:, np.newaxis]

        def statistic(means: Array) -> Array:
            sums, reference, count = np.split(means, [-1 - channels, -1], axis=1)
            return _measure(sums.reshape(-1, *used.sums.shape[1:]), reference, count)

        found = _stretched(bootstrap(np.concatenate(parts, axis=1), statistic, seed=seed), units)
        return {name: found[index] for index, name in enumerate(MEASURES)}


def _stretched(found: Interval, units: int) -> Interval:
    """Return an interval that is right for few units, too; of a single one there is none.

    Of k units, percentiles are too close by sqrt((k - 1) / k), and by the normal quantile in place
    of Student's (Hesterberg 2015, doi:10.1080/00031305.2015.1089789).
    """
    if units == 1:
        unknown = np.full_like(found.value, np.nan)
        return Interval(found.value, unknown, unknown, unknown)
    spread = float(np.sqrt(units / (units - 1)))
    reach = spread * float(stats.t.ppf(0.975, units - 1) / stats.norm.ppf(0.975))
    low, high = (found.value + reach * (end - found.value) for end in (found.low, found.high))
    return Interval(found.value, spread * found.standard_error, low, high)


def errors_of(estimate: Array, mean: Array, reference: Array, *, scene_mean: Array) -> Array:
    r"""Return what `SUMS` names of every estimate, shape (pixel, sum, channel).

    An estimate p with :math:`|p - \bar x| \le 10^{-6} \bar x` is the sample mean, neither better
    nor worse. It is a *firefly* where

    .. math:: p - y > 3 \sqrt{y^2 + 0.01\, m^2},

    y being the reference and m the mean reference of the scene: at least two stops too bright, and
    no matter of a faint pixel in a bright scene. The scale is that of relMSE, so that a firefly has
    a relative squared error above 9. We know of no published threshold; this one is ours.

    Parameters
    ----------
    estimate, mean, reference
        Radiance, shape (pixel, channel); the mean is that of the samples that the estimate saw.
    scene_mean
        Mean reference of the scene, shape (channel,).
    """
    # An estimate without end would make NaN of all pixels that are drawn 0 times.
    p = np.where(np.isfinite(estimate), estimate, np.nan).astype(np.float64)
    error = p - reference
    relative = relative_squared_error(p, reference, scene_mean=scene_mean)
    unchanged = is_mean(p, mean)
    improved = (np.abs(error) < np.abs(mean - reference)) & ~unchanged
    firefly = (error > 0) & (relative > _FIREFLY**2)
    return np.stack([error**2, relative, improved, unchanged, firefly, error], axis=1)


def is_mean(estimate: Array, mean: Array) -> npt.NDArray[np.bool_]:
    """Say where an estimate is the sample mean, be it summed in another order."""
    return np.asarray(np.abs(estimate - mean) <= _SAME * np.abs(mean))


def stack_intervals(intervals: Sequence[Interval]) -> Interval:
    """Return several intervals as one, along a new first axis."""
    fields = ("value", "standard_error", "low", "high")
    return Interval(*(np.stack([getattr(i, field) for i in intervals]) for field in fields))


def _measure(sums: Array, reference: Array, count: Array) -> Array:
    """Return measures (replicate, measure, estimator, channel + 1) of sums over units."""
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = _with_average(sums[:, :5] / count[:, :, np.newaxis, np.newaxis])
        squared, relative, improved, unchanged, firefly = np.moveaxis(shares, 1, 0)
        bias = _with_average(sums[:, 5] / reference[:, np.newaxis])
        ratios = [part / part[:, :1] for part in (squared, relative, firefly)]
    found = [squared, relative, improved, unchanged, bias, firefly, *ratios]
    return np.stack(found, axis=1)[:, :, 1:]


def _with_average(values: Array) -> Array:
    return np.concatenate([values, values.mean(axis=-1, keepdims=True)], axis=-1)
