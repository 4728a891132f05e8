"""Errors of many estimators on the same batches, added up, and the measures that follow from them.

`judge` lets every estimator estimate from each batch and returns `BatchErrors`. Every
measure is a ratio of sums over units, so that one bootstrap over the units serves them all. A unit
is a block of pixels with all their batches, or a batch with all its pixels. Neighbours see the same
light and gain or lose together, so that intervals are over blocks, not pixels (Künsch 1989,
doi:10.1214/aos/1176347265).

Memory is bounded: one batch of the image, one estimate of it, and sums over blocks of pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._core.arrays import Array, block_numbers
from chdstat._core.display import Shown
from chdstat._core.reasons import flag_attributes
from chdstat._core.resampling import Interval
from chdstat._core.work import in_order, track
from chdstat.comparison.candidates import Candidates
from chdstat.comparison.metrics import bootstrap, relative_squared_error
from chdstat.errors import InputError
from chdstat.estimators.order import mean
from chdstat.patterns import Label, classify
from chdstat.samples import Samples

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

__all__ = [
    "MEASURES",
    "SUMS",
    "PixelEstimates",
    "Units",
    "counts",
    "errors_of",
    "judge",
    "labels_of",
    "measures_of",
    "stacked",
]


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

SUMS = ("squared", "relative", "improved", "unchanged", "firefly", "error", "reference", "count")
"""What is added up for every estimator and channel: of estimates that count, the last is 1."""

_SAME = 1e-6
"""Relative difference below which an estimate is the mean, summed in another order."""
_FIREFLY = 3.0
"""Excess over the reference, in units of it, from which an estimate is a firefly: two stops."""


def counts(sums: Array) -> npt.NDArray[np.int64]:
    """Return how many estimates of each channel were added, shape (unit,)."""
    return np.asarray(sums[:, -1, 0, 0], np.int64)


def measures_of(sums: Array, *, seed: int) -> dict[str, Interval[Array]]:
    """Return every measure with its interval over units, shape (estimator, channel + 1).

    The last place of the channel axis is the average over channels. The measures of a single unit
    have no interval. Of k units, percentiles are too close by sqrt((k - 1) / k), and by the normal
    quantile in place of Student's (Hesterberg 2015, doi:10.1080/00031305.2015.1089789); they are
    moved apart by as much.

    Parameters
    ----------
    sums
        By the names of `SUMS`, shape (unit, sum, 1 + estimator, channel); the sample mean is
        estimator 0.
    seed
        Of the bootstrap.
    """
    used = sums[counts(sums) > 0]
    found, units = bootstrap(used, _measures, seed=seed), len(used)
    spread = float(np.sqrt(units / (units - 1))) if units > 1 else np.nan
    reach = spread * float(stats.t.ppf(0.975, units - 1) / stats.norm.ppf(0.975))
    low, high = (found.value + reach * (end - found.value) for end in (found.low, found.high))
    found = Interval(found.value, low, high, found.level, spread * found.standard_error)
    return {name: found[index] for index, name in enumerate(MEASURES)}


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
    ones = np.ones_like(p)
    parts = [error**2, relative, improved, unchanged, firefly, error, reference, ones]
    return np.stack(parts, axis=1)


def stacked(parts: Sequence[Mapping[str, Interval[Array]]]) -> dict[str, Interval[Array]]:
    """Return the measures of several parts, averaged over channels, along a new first axis."""
    found = {}
    for name in MEASURES:
        value, low, high, error = (
            np.stack([getattr(part[name], field)[:, -1] for part in parts])
            for field in ("value", "low", "high", "standard_error")
        )
        found[name] = Interval(value, low, high, standard_error=error)
    return found


def _measures(sums: Array) -> Array:
    """Return measures (replicate, measure, estimator, channel + 1) of sums over units."""
    *shares, error, reference, count = np.moveaxis(sums, 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.stack([*(part / count for part in shares), error / reference])
        found = np.concatenate([found, found.mean(axis=-1, keepdims=True)], axis=-1)
        squared, relative, improved, unchanged, firefly, bias = found
        # What is left of the mean's error of equal samples is rounding, and divides nothing.
        exact = relative[:, :1] <= _SAME**2
        ratios = [np.where(exact, np.nan, part / part[:, :1]) for part in (squared, relative)]
        ratios.append(firefly / firefly[:, :1])
    measures = [squared, relative, improved, unchanged, bias, firefly, *ratios]
    return np.stack(measures, axis=1)[:, :, 1:]


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
    """

    ys: npt.NDArray[np.intp]
    xs: npt.NDArray[np.intp]
    starts: npt.NDArray[np.intp]
    label: npt.NDArray[np.int64]
    block: npt.NDArray[np.int64]

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
        return cls(ys[order], xs[order], starts, label[starts], block[starts])

    def __call__(self, image: Array) -> Array:
        """Return an image's values at the pixels, shape (pixel, ...)."""
        return np.asarray(image[self.ys, self.xs])

    def sum(self, values: Array) -> Array:
        """Add up values (pixel, ...) within each unit."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))


def labels_of(
    given: npt.ArrayLike | xr.DataArray | xr.Dataset | str,
    samples: Samples,
    *,
    progress: bool | None = None,
) -> tuple[npt.NDArray[np.int64], dict[int, str]]:
    """Return the labels of an image as codes (y, x), and the names of the codes.

    Parameters
    ----------
    given
        Codes of `Label`, shape (y, x); a labelled map of other codes with the attributes
        ``flag_values`` and ``flag_meanings``; a dataset with such a map as ``label``; or
        "classify".

    Raises
    ------
    InputError
        If it is neither, has another shape, or holds codes without a name.
    """
    found: Any = given
    if isinstance(given, str):
        if given != "classify":
            message = f"labels must be a map of labels or 'classify', got {given!r}"
            raise InputError(message)
        found = classify(samples, progress=progress)
    if hasattr(found, "data_vars"):
        if "label" not in found:
            message = f"a dataset of labels has a variable 'label'; this one has {list(found)}"
            raise InputError(message)
        found = found["label"]
    codes = np.asarray(found)
    if codes.shape != samples.shape[:2] or codes.dtype.kind not in "iu":
        message = (
            f"labels must be integers of shape {samples.shape[:2]}, one for each pixel; "
            f"got {codes.dtype} of shape {codes.shape}"
        )
        raise InputError(message)
    attrs = getattr(found, "attrs", {})
    flags = attrs if "flag_meanings" in attrs else flag_attributes(Label)
    values = np.atleast_1d(flags["flag_values"]).tolist()
    names = dict(zip(values, flags["flag_meanings"].split(), strict=True))
    unknown = set(np.unique(codes).tolist()) - set(names)
    if unknown:
        message = f"labels must be among {names}, got {sorted(unknown)} too"
        raise InputError(message)
    return codes.astype(np.int64), names


@dataclass(frozen=True, repr=False)
class PixelEstimates(Shown):
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
class BatchErrors:
    """What many estimators did on the same batches.

    Attributes
    ----------
    by_unit, by_block, by_batch
        Sums, see `measures_of`: over batches, one row a unit of pixels, or a block, whatever the
        labels in it, and over pixels, one row a batch; NaN for estimators that do not take so many
        samples.
    excluded
        Batches of test pixels without a reference.
    estimates
        Of the whole image from the first batch, of those that take as many, shape (estimator, y, x,
        channel).
    mean, reference
        Of the first batch and of all other samples, shape (y, x, channel).
    """

    by_unit: npt.NDArray[np.float64]
    by_block: npt.NDArray[np.float64]
    by_batch: npt.NDArray[np.float64]
    excluded: int
    estimates: npt.NDArray[np.float32]
    mean: npt.NDArray[np.float32]
    reference: npt.NDArray[np.float64]


def judge(
    candidates: Candidates,
    units: Units,
    *,
    n: int,
    limit: int | None,
    progress: bool | None = None,
    client: Client | None = None,
) -> BatchErrors:
    """Let every estimator that takes n samples estimate from the same batches; add up its errors.

    The image is read with n samples at a time and estimated by one estimator at a time; with a
    client, each of its workers does so with a batch of its own.

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
    client
        A Dask client.

    Raises
    ------
    InputError
        If an estimator returns another shape, or no batch has a reference.
    """
    samples = candidates.samples
    height, width, channels, spp = samples.shape
    rounds = spp // n if limit is None else min(limit, spp // n)
    sums = len(SUMS), 1 + len(candidates.entries), channels
    by_unit, by_batch = np.zeros((len(units.starts), *sums)), np.zeros((rounds, *sums))
    excluded = 0

    def items() -> Iterator[_Batch]:
        for index in range(rounds):
            batch = slice(index * n, (index + 1) * n)
            yield _Batch(samples.isel(sample=batch), shown=index == 0)

    # What travels to workers with every batch holds no samples of others.
    light = replace(candidates, samples=samples.isel(sample=slice(1)))
    task = partial(_errors_of_batch, light, units, n)
    with track(f"comparing at N = {n}", rounds * height * width, unit="px", show=progress) as told:
        for index, found in enumerate(in_order(task, items(), workers=1, client=client)):
            if index == 0:
                first = found
            by_unit += found.sums
            by_batch[index] = found.sums.sum(axis=0)
            excluded += found.excluded
            told(height * width)
    if not counts(by_unit).any():
        message = (
            f"every batch of {n} samples of the test pixels holds a bad sample; none can judge"
        )
        raise InputError(message)
    blocks, block = np.unique(units.block, return_inverse=True)
    by_block = np.zeros((len(blocks), *sums))
    np.add.at(by_block, block, by_unit)
    first_mean, *estimates = first.estimates
    shown = np.stack(estimates), first_mean, first.reference
    return BatchErrors(by_unit, by_block, by_batch, excluded, *shown)


class _Batch(NamedTuple):
    """Samples to estimate from, and whether the images are wanted, too."""

    samples: Samples
    shown: bool


class _OfBatch(NamedTuple):
    """Sums over each unit, test pixels without a reference, and images if they are wanted."""

    sums: Array
    excluded: int
    estimates: list[npt.NDArray[np.float32]]
    reference: Array


def _errors_of_batch(candidates: Candidates, units: Units, n: int, batch: _Batch) -> _OfBatch:
    """Let every estimator that takes n samples estimate from one batch."""
    x = batch.samples.read()
    functions, totals = candidates.taking(n), candidates.totals
    scene_mean = totals.mean()[totals.count > 0].mean(axis=0)
    average, reference = mean(x), totals.mean_without(x)
    truth, of_mean = units(reference), units(average)
    usable = np.asarray(np.isfinite(truth).all(axis=-1))
    names = ["mean", *candidates.entries]
    sums = np.full((len(units.starts), len(SUMS), len(names), average.shape[-1]), np.nan)
    estimates = []
    for k, name in enumerate(names):
        if k > 0 and name not in functions:
            continue
        estimate = average if k == 0 else np.asarray(functions[name](x))
        if estimate.shape != average.shape:
            message = (
                f"{name} must return one estimate for each pixel and channel, shape "
                f"{average.shape}, got {estimate.shape}"
            )
            raise InputError(message)
        found = np.zeros((len(usable), *sums.shape[1::2]))
        found[usable] = errors_of(
            units(estimate)[usable], of_mean[usable], truth[usable], scene_mean=scene_mean
        )
        sums[:, :, k] = units.sum(found)
        if batch.shown:
            estimates.append(estimate.astype(np.float32))
    return _OfBatch(sums, int((~usable).sum()), estimates, reference)
