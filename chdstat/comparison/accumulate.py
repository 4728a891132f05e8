"""Errors of many estimators on the same batches, added up, and the measures that follow from them.

`judge` lets every estimator estimate from each batch and returns an `ErrorAccumulator`. Every
measure is a ratio of sums over units, so that one bootstrap over the units serves them all. A unit
is a block of pixels with all their batches, or a batch with all its pixels. Neighbours see the same
light and gain or lose together, so that intervals are over blocks, not pixels (Künsch 1989,
doi:10.1214/aos/1176347265).

Memory is bounded: one batch of the image, one estimate of it, and sums over blocks of pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._core.arrays import block_numbers
from chdstat._core.executor import track
from chdstat._core.resampling import Interval
from chdstat.comparison.candidates import Candidates
from chdstat.comparison.metrics import bootstrap, relative_squared_error
from chdstat.errors import InputError
from chdstat.estimators.order import mean
from chdstat.estimators.validation import batches

__all__ = [
    "MEASURES",
    "SUMS",
    "ErrorAccumulator",
    "ErrorSums",
    "EstimateImages",
    "PixelEstimates",
    "Units",
    "errors_of",
    "judge",
    "stack_measures",
]

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

    def measures(self, *, seed: int) -> dict[str, Interval[Array]]:
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


def _stretched(found: Interval[Array], units: int) -> Interval[Array]:
    """Return an interval that is right for few units, too; of a single one there is none.

    Of k units, percentiles are too close by sqrt((k - 1) / k), and by the normal quantile in place
    of Student's (Hesterberg 2015, doi:10.1080/00031305.2015.1089789).
    """
    if units == 1:
        unknown = np.full_like(found.value, np.nan)
        return Interval(found.value, unknown, unknown, found.level, unknown)
    spread = float(np.sqrt(units / (units - 1)))
    reach = spread * float(stats.t.ppf(0.975, units - 1) / stats.norm.ppf(0.975))
    low, high = (found.value + reach * (end - found.value) for end in (found.low, found.high))
    return Interval(found.value, low, high, found.level, spread * found.standard_error)


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
    mean = mean.astype(np.float64)
    error = p - reference
    relative = relative_squared_error(p, reference, scene_mean=scene_mean)
    unchanged = np.abs(p - mean) <= _SAME * np.abs(mean)
    improved = (np.abs(error) < np.abs(mean - reference)) & ~unchanged
    firefly = (error > 0) & (relative > _FIREFLY**2)
    return np.stack([error**2, relative, improved, unchanged, firefly, error], axis=1)


def stack_measures(parts: Sequence[Mapping[str, Interval[Array]]]) -> dict[str, Interval[Array]]:
    """Return the measures of several parts as one, along a new first axis."""

    def stacked(name: str, field: str) -> Array:
        return np.stack([getattr(part[name], field) for part in parts])

    return {
        name: Interval(
            stacked(name, "value"),
            stacked(name, "low"),
            stacked(name, "high"),
            standard_error=stacked(name, "standard_error"),
        )
        for name in MEASURES
    }


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


_ACROSS = 8
"""Blocks along each side of the image."""


@dataclass(frozen=True)
class Units:
    """Pixels that judge, gathered into units: those of a label in a block of the image.

    Attributes
    ----------
    ys, xs
        The pixels, unit by unit, shape (pixel,).
    starts
        Where each unit begins, shape (unit,).
    label, block
        Of each unit, shape (unit,).
    pixels
        Pixels in each unit, shape (unit,).
    """

    ys: npt.NDArray[np.intp]
    xs: npt.NDArray[np.intp]
    starts: npt.NDArray[np.intp]
    label: npt.NDArray[np.int64]
    block: npt.NDArray[np.int64]
    pixels: npt.NDArray[np.int64]

    @classmethod
    def of(cls, test: npt.NDArray[np.bool_], labels: npt.NDArray[np.int64] | None = None) -> Units:
        """Gather the pixels of `test`, in 8 x 8 blocks of the image."""
        ys, xs = np.nonzero(test)
        label = np.zeros(len(ys), np.int64) if labels is None else labels[ys, xs]
        block = block_numbers(*test.shape, across=_ACROSS)[ys, xs]
        order = np.lexsort((block, label))
        label, block = label[order], block[order]
        new = (np.diff(label, prepend=-1) != 0) | (np.diff(block, prepend=-1) != 0)
        starts = np.flatnonzero(new)
        pixels = np.diff(starts, append=len(ys))
        return cls(ys[order], xs[order], starts, label[starts], block[starts], pixels)

    def __call__(self, image: Array) -> Array:
        """Return an image's values at the pixels, shape (pixel, ...)."""
        return np.asarray(image[self.ys, self.xs])

    def sum(self, values: Array) -> Array:
        """Add up values (pixel, ...) within each unit."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))


@dataclass(frozen=True)
class EstimateImages:
    """The first batch over the whole image, radiance.

    Attributes
    ----------
    estimates
        Shape (estimator, y, x, channel).
    squared_error
        Of the estimates against the reference, same shape.
    mean
        Sample mean of the batch, shape (y, x, channel).
    reference
        Mean of all other samples, shape (y, x, channel).
    """

    estimates: npt.NDArray[np.float32]
    squared_error: npt.NDArray[np.float32]
    mean: npt.NDArray[np.float32]
    reference: npt.NDArray[np.float64]

    @classmethod
    def of(cls, estimates: Sequence[Array], mean: Array, reference: Array) -> EstimateImages:
        """Add the squared errors; float32 is what an image holds, and 1e30 squared is beyond it."""
        with np.errstate(over="ignore"):
            squared = [np.square(one - reference).astype(np.float32) for one in estimates]
        return cls(np.stack(estimates), np.stack(squared), mean.astype(np.float32), reference)


@dataclass(frozen=True)
class PixelEstimates:
    """A few pixels that no estimator was trained on, one batch each.

    Attributes
    ----------
    pixels
        Rows (y, x), from dark to bright, shape (pixel, 2).
    estimators, channels
        Names.
    reference
        Mean of all other samples, radiance, shape (pixel, channel).
    mean
        Sample mean of the batch, radiance, shape (pixel, channel).
    estimates
        Radiance, shape (estimator, pixel, channel).
    n
        Samples per estimate.
    """

    pixels: npt.NDArray[np.int64]
    estimators: tuple[str, ...]
    channels: tuple[str, ...]
    reference: npt.NDArray[np.float64]
    mean: npt.NDArray[np.float32]
    estimates: npt.NDArray[np.float32]
    n: int

    def table(self) -> list[dict[str, Any]]:
        """Return one row per pixel and channel: where, reference, mean, every estimate."""
        return [
            {
                "y": int(y),
                "x": int(x),
                "channel": channel,
                "reference": float(self.reference[k, c]),
                "sample_mean": float(self.mean[k, c]),
                **{name: float(self.estimates[e, k, c]) for e, name in enumerate(self.estimators)},
            }
            for k, (y, x) in enumerate(self.pixels)
            for c, channel in enumerate(self.channels)
        ]


@dataclass(frozen=True)
class ErrorAccumulator:
    """What many estimators did on the same batches.

    Attributes
    ----------
    by_unit, by_block
        Sums over batches, one row a unit of pixels, or a block, whatever the labels in it.
    by_batch
        Sums over pixels, one row a batch.
    excluded
        Batches of test pixels without a reference.
    images
        Images of the first batch.
    """

    by_unit: ErrorSums
    by_block: ErrorSums
    by_batch: ErrorSums
    excluded: int
    images: EstimateImages


def judge(
    candidates: Candidates, units: Units, *, n: int, limit: int | None, progress: bool | None = None
) -> ErrorAccumulator:
    """Let every estimator that takes n samples estimate from the same batches; add up its errors.

    The image is read with n samples at a time and estimated by one estimator at a time.

    Parameters
    ----------
    candidates
        The estimators and the image.
    units
        The pixels that judge.
    n, limit
        Samples per batch, and batches at most.
    progress
        Show a progress bar; None shows it on a terminal.

    Raises
    ------
    InputError
        If an estimator returns another shape, or no batch has a reference.
    """
    functions, samples, totals = candidates.taking(n), candidates.samples, candidates.totals
    height, width, channels, spp = samples.shape
    rounds = spp // n if limit is None else min(limit, spp // n)
    by_unit = ErrorSums.empty(len(units.starts), len(functions), channels)
    by_batch = ErrorSums.empty(rounds, len(functions), channels)
    scene_mean = totals.mean()[totals.count > 0].mean(axis=0)
    first: list[Array] = []
    excluded = 0
    direct = candidates.direct
    parts = repeat(None) if direct is None else batches(direct, n, limit=limit)
    work = rounds * height * width * len(functions)
    with track(f"comparing at N = {n}", work, unit="px", show=progress) as advance:
        images = batches(samples, n, limit=limit)
        for index, (x, part) in enumerate(zip(images, parts, strict=False)):
            average, reference = mean(x), totals.mean_without(x)
            truth, of_mean = units(reference), units(average)
            usable = np.asarray(np.isfinite(truth).all(axis=-1))
            excluded += int((~usable).sum())
            total = units.sum(np.where(usable[:, np.newaxis], truth, 0))
            count = units.sum(usable.astype(np.int64))
            by_unit.reference[:] += total
            by_unit.count[:] += count
            by_batch.reference[index], by_batch.count[index] = total.sum(axis=0), count.sum()
            if index == 0:
                first_mean, first_reference = average, reference
            for k, name in enumerate(["mean", *functions]):
                estimate = average if k == 0 else np.asarray(functions[name](x, part))
                if estimate.shape != average.shape:
                    message = (
                        f"{name} must return one estimate for each pixel and channel, shape "
                        f"{average.shape}, got {estimate.shape}"
                    )
                    raise InputError(message)
                found = np.zeros((len(usable), len(SUMS), channels))
                found[usable] = errors_of(
                    units(estimate)[usable], of_mean[usable], truth[usable], scene_mean=scene_mean
                )
                sums = units.sum(found)
                by_unit.sums[:, :, k] += sums
                by_batch.sums[index, :, k] = sums.sum(axis=0)
                if index == 0 and k > 0:
                    first.append(estimate.astype(np.float32))
                advance(height * width if k > 0 else 0)
    if by_unit.count.sum() == 0:
        message = (
            f"every batch of {n} samples of the test pixels holds a bad sample; none can judge"
        )
        raise InputError(message)
    shown = EstimateImages.of(first, first_mean, first_reference)
    return ErrorAccumulator(by_unit, by_unit.joined(units.block), by_batch, excluded, shown)
