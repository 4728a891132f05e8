"""Tally: errors of many estimators, added up per pixel over batches, and what they come to.

Every measure is a ratio of sums over pixels, so one bootstrap over pixels serves them all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.estimators import mean
from chdstat.estimators.heldout import Totals, batches
from chdstat.metrics import Interval, bootstrap, relative_squared_error, squared_error
from chdstat.progress import track
from chdstat.samples import Samples

__all__ = ["MEASURES", "Function", "Tally", "judge"]

Array = npt.NDArray[Any]
Function = Callable[[npt.ArrayLike], Array]

MEASURES = {
    "mse": ("mean squared error", "(W sr-1 m-2)^2"),
    "relmse": ("relative mean squared error", "1"),
    "improved": ("share of estimates closer to the reference than the sample mean", "1"),
    "bias": ("mean error over mean reference", "1"),
    "mse_ratio": ("mean squared error over that of the sample mean", "1"),
    "relmse_ratio": ("relative mean squared error over that of the sample mean", "1"),
}
"""Long name and unit of every measure."""

_SUMS = 4
"""Squared error, relative squared error, estimates improved, error."""


@dataclass
class Tally:
    """Sums over the batches of every test pixel.

    Attributes
    ----------
    sums
        Squared error, relative squared error, improved, error; shape
        (pixel, 4, 1 + estimator, channel), the sample mean being estimator 0.
    reference
        Sum of the references, shape (pixel, channel).
    count
        Batches that count, shape (pixel,).
    excluded
        Batches of test pixels without a reference.
    estimates, squared_error
        Of the first batch, over the whole picture, shape (estimator, y, x, channel).
    """

    sums: npt.NDArray[np.float64]
    reference: npt.NDArray[np.float64]
    count: npt.NDArray[np.int64]
    excluded: int
    estimates: npt.NDArray[np.float32]
    squared_error: npt.NDArray[np.float32]

    def measures(self, *, seed: int) -> dict[str, Interval]:
        """Return every measure with its interval, shape (estimator, channel + 1).

        The last place of the channel axis is the average over channels.
        """
        pixels, _, estimators, channels = self.sums.shape
        parts = self.sums.reshape(pixels, -1), self.reference, self.count[:, np.newaxis]

        def statistic(means: Array) -> Array:
            sums, reference, count = np.split(means, [-1 - channels, -1], axis=1)
            sums = sums.reshape(-1, _SUMS, estimators, channels)
            return _measure(sums, reference, count)

        interval = bootstrap(np.concatenate(parts, axis=1), statistic, seed=seed)
        return {name: interval[index] for index, name in enumerate(MEASURES)}


def judge(
    functions: Mapping[str, Function],
    samples: Samples,
    totals: Totals,
    test: npt.NDArray[np.bool_],
    *,
    n: int,
    limit: int | None,
    progress: bool | None,
) -> Tally:
    """Let every estimator estimate from the same batches and add up its errors.

    The picture is read with n samples at a time, so memory does not grow with spp.
    """
    height, width, _, spp = samples.shape
    scene_mean = totals.mean()[totals.count > 0].mean(axis=0)
    tested = totals[test]
    tally = _empty(len(functions), samples.shape[:3], len(tested.count))
    rounds = spp // n if limit is None else min(limit, spp // n)
    with track("comparing", rounds * height * width, unit="px", show=progress) as advance:
        for index, picture in enumerate(batches(samples, n, limit=limit)):
            estimates = [mean(picture), *(function(picture) for function in functions.values())]
            if index == 0:
                tally.estimates[:] = estimates[1:]
                tally.squared_error[:] = tally.estimates - totals.mean_without(picture)
                tally.squared_error **= 2
            reference = tested.mean_without(picture[test])
            _add(tally, np.stack([e[test] for e in estimates], axis=1), reference, scene_mean)
            advance(height * width)
    return tally


def _empty(estimators: int, picture: tuple[int, int, int], pixels: int) -> Tally:
    channels = picture[2]
    return Tally(
        sums=np.zeros((pixels, _SUMS, 1 + estimators, channels)),
        reference=np.zeros((pixels, channels)),
        count=np.zeros(pixels, np.int64),
        excluded=0,
        estimates=np.empty((estimators, *picture), np.float32),
        squared_error=np.empty((estimators, *picture), np.float32),
    )


def _add(tally: Tally, estimates: Array, references: Array, scene_mean: Array) -> None:
    """Add one batch: estimates (pixel, 1 + estimator, channel), references (pixel, channel)."""
    usable = np.isfinite(references).all(axis=-1)
    reference = references[usable, np.newaxis]
    estimate = estimates[usable].astype(np.float64)
    everywhere = np.broadcast_to(reference, estimate.shape)
    error = squared_error(estimate, everywhere)
    relative = relative_squared_error(estimate, everywhere, scene_mean=scene_mean)
    better = error < error[:, :1]
    tally.sums[usable] += np.stack([error, relative, better, estimate - reference], axis=1)
    tally.reference[usable] += reference[:, 0]
    tally.count += usable
    tally.excluded += int((~usable).sum())


def _measure(sums: Array, reference: Array, count: Array) -> Array:
    """Return measures (replicate, measure, estimator, channel + 1) of sums over pixels."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error, relative, better = (
            _with_average(sums[:, k] / count[:, :, np.newaxis]) for k in range(3)
        )
        bias = _with_average(sums[:, 3] / reference[:, np.newaxis])
        ratios = [a / a[:, :1] for a in (error, relative)]
    return np.stack([error, relative, better, bias, *ratios], axis=1)[:, :, 1:]


def _with_average(values: Array) -> Array:
    return np.concatenate([values, values.mean(axis=-1, keepdims=True)], axis=-1)
