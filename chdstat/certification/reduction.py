"""Reduction: from about a million samples of a pixel to certified numbers with their own errors.

`reduce` takes the samples of pixels. `Numbers` declares what it returns: each field is a variable
of the dataset that `chdstat.certified` returns.

**Errors.** Names that end in ``_se`` are standard errors. Samples are independent, so that those of
moments and of shares of the variance come from influence functions (Hampel 1974, "The influence
curve and its role in robust estimation", doi:10.1080/01621459.1974.10482962), and those of
quantiles from the binomial ranks that hold them.

**What is not determined is NaN.** An error estimated from samples is itself wrong where a few of
them decide it. The terms of a sum S count as many as ``S^2 / sum of their squares`` equal ones
would (Kish, "Survey sampling", 1965). A number is NaN and its reason is `UNIDENTIFIED` where its
squared influences count as fewer than `_LEAST_SHARING` and its standard error is more than
`_SMALL_ERROR` of it. Of 2^20 log-normal samples with sigma up to 1.5, and of Pareto samples with
exponent 2.5, the means and variances that remain are 3 standard errors off in at most 2 of 60
trials, where all variances of that Pareto distribution and of sigma = 2 are so in 16 of 60. No
number of samples excludes light that none has met: light of probability p is missed by 2^20 samples
with probability ``(1 - p)^(2^20)``, which is above 0.05 for p below 2.9e-6.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage, optimize

from chdstat._core.arrays import Array, Counts, Floats, is_bad, luminance
from chdstat._core.positive import CONSTANT_SPREAD, PositivePart
from chdstat._core.resampling import Z_95
from chdstat._core.statistic import RADIANCE, Result, result, variable
from chdstat.errors import InputError, Reason
from chdstat.fit.tail import Tail, TailIndex
from chdstat.inference.averages import N_MEANS, n_of_shape
from chdstat.inference.normality import TESTS, run_tests
from chdstat.summary.runner import measured

LEAST = 2**13
"""Fewest samples that can be certified: two batches of the largest of `SIZES`."""
_LEAST_SHARING = 10.0
"""Fewest equal samples that the squared error of a certified number may rest on."""
_SMALL_ERROR = 0.03
"""Standard error, as a share of the number, that may rest on fewer."""
QUANTILES = (0.001, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999, 0.9999)
TOPS = (1e-3, 1e-4)
"""Shares of the largest samples whose part of the variance is certified."""
SIZES = tuple(2**k for k in range(5, 13))
"""Numbers of samples whose error bars are judged."""
AVERAGED = tuple(2**k for k in range(11))
"""Numbers of samples whose averages are tested for normality."""
TAIL_SHARES = (
    *(0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01, 0.005, 0.002, 0.001, 5e-4),
    *(2e-4, 1e-4),
)
"""Shares of the positive samples that make a tail: depths at which its index is certified."""
BANDWIDTHS = (0.025, 0.05, 0.1)
"""Standard deviations of the smoothing kernel of a density, in decades of radiance."""
MOST_MODES = 6
"""Modes of a pixel that are kept."""

_SETS = 256
"""Most sets of averages that are tested for each size."""
_ALPHA, _PASSES = 0.05, 0.1
"""Level of a test of averages, and the share of sets up to which they pass: twice the level."""
_LEAST_EXCESSES = 100
"""Fewest samples of a tail with numbers of its own: the standard error of its index is 0.1."""
_WIDE, _ENOUGH = 0.05, 2**16
"""Samples that are enough for tails of 5 % and more: the time of a fit grows with their number to
the power of 1.5, and 3277 of them leave a standard error of 0.02."""
_BATCHES = 16
_MOST_ERROR = 0.05
"""Largest standard error of a coverage that is certified."""
_BINS = 0.005
"""Width in decades of the bins that are smoothed: a fifth of the narrowest kernel."""
_LEAST_EXCESS = 0.005
"""Least excess mass of a mode that is kept; among a million samples, it is 60 standard errors."""
_COUNTED = 0.02
"""Least excess mass of a mode that counts."""


_Int8 = npt.NDArray[np.int8]


def _of_channel(label: str, *dims: str, unit: str = "1") -> Any:
    """Declare a number of each channel; `dims` follow that of the channels."""
    return variable(label, "channel", *dims, unit=unit)


@result
class Numbers(Result):
    """Certified numbers of pixels; arrays of shape (pixel, channel, ...).

    The channels are those of the samples and, of three, their luminance. NaN where a reason says
    why.

    Attributes
    ----------
    n
        Good samples of each pixel, shape (pixel,).
    mean, mean_se, mean_reason
        The mean of all samples, nulls included.
    variance, variance_se, variance_reason
        The variance of the samples.
    skewness, skewness_se, kurtosis, kurtosis_se, kurtosis_reason
        Skewness and excess kurtosis of the samples; one reason for both.
    null_share, null_share_se
        Share of samples that are exactly 0 in the channel; for luminance, in all channels.
    quantile, quantile_se
        Quantiles of all samples at the probabilities `QUANTILES`. The standard error is half the
        distance of the order statistics one binomial standard deviation of rank to either side.
    tail_variance_share, tail_variance_share_se
        Share of the variance in the `TOPS` largest samples: their squared deviations from the mean
        over those of all. NaN where these are fewer than 100, or there is no variance.
    largest_variance_share
        Part of the squared deviations of all samples in the largest one: near 1 / n for light
        tails. It describes the samples that were drawn, and has no error.
    coverage, coverage_se, missed_low, missed_high, coverage_reason
        How often mean +- 1.96 s / sqrt(n) of n samples holds the true mean, for n in `SIZES`: the
        share of all disjoint batches, and the shares of those whose interval lies below the truth
        and above it. The error includes that of the mean of all samples, which stands for the
        truth.
    variance_seen
        Median of the variances of n samples over the variance, for n in `SIZES`: 1 where n samples
        see all of the variance, and near 0 where rare samples make it.
    n_gaussian, n_gaussian_se
        Smallest N from which on averages of N samples pass as Gaussian: absolute skewness and
        excess kurtosis are below two standard errors of those of 32 Gaussian averages, as
        `n_predicted` of `chdstat.inference.gaussianity_of_means` says. Where no reason stands in
        ``kurtosis_reason``.
    rejected, rejected_se
        Share of sets of 32 averages of N samples that Shapiro and Wilk's test rejects at 5 %, for N
        in `AVERAGED`; 0.05 where averages are Gaussian. All averages are of disjoint samples.
    n_passing, n_passing_interval
        Smallest N in `AVERAGED` from which on at most 10 % of the sets are rejected, and the N for
        shares 1.96 standard errors lower and higher; infinite where there is none. Unlike
        `n_gaussian`, it exists for every tail: averages pass although a kurtosis is infinite, if
        what makes it so is too rare for 32 averages to show.
    tail_index, tail_index_se, tail_index_reason
        Index xi of the generalised Pareto distribution that fits the largest samples, by the share
        of the positive samples that they are (`TAIL_SHARES`), fitted as by
        `chdstat.fit.tail_index`. It is what a fit to the same share of fewer samples estimates.
    modes, modes_reason
        Modes of the density of log10 radiance of the positive samples, smoothed by Gaussian kernels
        of `BANDWIDTHS` decades, with an excess mass of 0.02 or more. A reason stands where the
        error of an excess mass leaves the count open.
    mode_place, mode_mass, mode_excess, mode_excess_se
        Modes at the middle bandwidth, with the largest excess mass first: log10 radiance; mass up
        to the valleys beside; and excess mass, which is the mass above the level of the valley
        where the mode joins a higher one (Müller and Sawitzki, "Excess mass estimates and tests for
        multimodality", 1991, doi:10.1080/01621459.1991.10475103).
    """

    n: Counts = variable("good samples")
    mean: Floats = _of_channel("mean", unit=RADIANCE)
    mean_se: Floats = _of_channel("standard error of the mean", unit=RADIANCE)
    mean_reason: _Int8 = _of_channel("why there is no mean")
    variance: Floats = _of_channel("variance of the samples", unit=f"({RADIANCE})2")
    variance_se: Floats = _of_channel("standard error of the variance", unit=f"({RADIANCE})2")
    variance_reason: _Int8 = _of_channel("why there is no variance")
    skewness: Floats = _of_channel("skewness of the samples")
    skewness_se: Floats = _of_channel("standard error of the skewness")
    kurtosis: Floats = _of_channel("excess kurtosis of the samples")
    kurtosis_se: Floats = _of_channel("standard error of the kurtosis")
    kurtosis_reason: _Int8 = _of_channel("why there are no skewness, kurtosis and n_gaussian")
    null_share: Floats = _of_channel("share of samples that are 0")
    null_share_se: Floats = _of_channel("standard error of the share of nulls")
    quantile: Floats = _of_channel("quantiles of the samples", "q", unit=RADIANCE)
    quantile_se: Floats = _of_channel("standard errors of the quantiles", "q", unit=RADIANCE)
    tail_variance_share: Floats = _of_channel("share of the variance in the largest samples", "top")
    tail_variance_share_se: Floats = _of_channel(
        "standard error of that share of the variance", "top"
    )
    largest_variance_share: Floats = _of_channel(
        "share of the squared deviations in the largest sample"
    )
    coverage: Floats = _of_channel(
        "share of 95 % error bars of so many samples that hold the mean", "size"
    )
    coverage_se: Floats = _of_channel("standard error of the coverage", "size")
    missed_low: Floats = _of_channel("share of error bars that lie below the mean", "size")
    missed_high: Floats = _of_channel("share of error bars that lie above the mean", "size")
    coverage_reason: _Int8 = _of_channel("why there is no coverage", "size")
    variance_seen: Floats = _of_channel(
        "median variance of so many samples, over the variance", "size"
    )
    n_gaussian: Floats = _of_channel("samples from which on averages pass as Gaussian")
    n_gaussian_se: Floats = _of_channel("standard error of n_gaussian")
    rejected: Floats = _of_channel(
        "share of sets of 32 averages that are not Gaussian at 5 %", "averaged"
    )
    rejected_se: Floats = _of_channel("standard error of that share", "averaged")
    n_passing: Floats = _of_channel("samples from which on few sets of averages are rejected")
    n_passing_interval: Floats = _of_channel("95 % interval of n_passing", "bound")
    tail_index: Floats = _of_channel("generalised Pareto tail index", "share")
    tail_index_se: Floats = _of_channel("standard error of the tail index", "share")
    tail_index_reason: _Int8 = _of_channel("why there is no tail index", "share")
    modes: _Int8 = _of_channel("modes of log10 radiance", "bandwidth")
    modes_reason: _Int8 = _of_channel("why modes were not counted", "bandwidth")
    mode_place: Floats = _of_channel("modes, log10 of radiance in W sr-1 m-2", "mode")
    mode_mass: Floats = _of_channel("mass of the modes", "mode")
    mode_excess: Floats = _of_channel("excess mass of the modes", "mode")
    mode_excess_se: Floats = _of_channel("standard error of the excess mass", "mode")


def reduce(x: npt.ArrayLike) -> Numbers:
    """Reduce the samples of pixels to certified numbers.

    Parameters
    ----------
    x
        Independent samples of linear radiance, shape (pixel, channel, sample), with 1 or 3
        channels.

    Returns
    -------
    Numbers

    Raises
    ------
    InputError
        If the shape is another one, or there are fewer than `LEAST` samples.

    Examples
    --------
    >>> x = np.random.default_rng(1).exponential(size=(1, 1, 2**16))
    >>> found = reduce(x)
    >>> float(found.mean[0, 0].round(2)), float(found.mean_se[0, 0].round(4))
    (1.0, 0.0039)
    >>> found.coverage[0, 0, [0, 3]].round(2), int(found.modes[0, 0, 1])
    (array([0.92, 0.96]), 1)
    """
    samples = np.asarray(x)
    if samples.ndim != 3 or samples.shape[1] not in (1, 3) or samples.shape[2] < LEAST:
        message = (
            f"samples to certify need shape (pixel, channel, sample) with 1 or 3 channels and at "
            f"least {LEAST} samples, got shape {samples.shape}"
        )
        raise InputError(message)
    pixels = [_of_pixel(pixel) for pixel in samples]
    names = [f.name for f in fields(Numbers)]
    return Numbers(**{name: np.stack([pixel[name] for pixel in pixels]) for name in names})


def _of_pixel(pixel: Array) -> dict[str, Array]:
    """Return the fields of `Numbers` of one pixel, shape (channel, sample)."""
    good = ~is_bad(pixel).any(axis=0)
    rows = pixel[:, good]
    if len(rows) > 1:
        rows = np.concatenate([rows, luminance(rows)[np.newaxis]])
    if rows.shape[-1] < LEAST // 2:
        why = Reason.TOO_FEW if good.any() else Reason.ALL_BAD
        found = [_nothing(why) for _ in rows]
    else:
        found = [_of_row(row) for row in rows]
    named = {name: np.stack([row[name] for row in found]) for name in found[0]}
    return {"n": np.asarray(rows.shape[-1], np.int64), **named}


def _shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of each field of `Numbers` for one channel."""
    lengths = {
        "q": len(QUANTILES),
        "top": len(TOPS),
        "size": len(SIZES),
        "averaged": len(AVERAGED),
        "bound": 2,
        "share": len(TAIL_SHARES),
        "bandwidth": len(BANDWIDTHS),
        "mode": MOST_MODES,
    }
    declared = Numbers.declared()
    return {
        name: tuple(lengths[dim] for dim in about.dims[1:])
        for name, (_, about) in declared.items()
        if name != "n"
    }


def _nothing(reason: Reason) -> dict[str, Array]:
    """Return the fields of a row without any number."""
    return {
        name: np.full(shape, reason, np.int8)
        if name.endswith("reason")
        else np.zeros(shape, np.int8)
        if name == "modes"
        else np.full(shape, np.nan)
        for name, shape in _shapes().items()
    }


def _of_row(x: Array) -> dict[str, Array]:
    """Return the fields of `Numbers` of one channel, shape (sample,), without bad samples."""
    n = x.size
    low, high = float(x.min()), float(x.max())
    null_share = np.count_nonzero(x == 0) / n
    scale = max(high, -low)
    if scale == 0:
        return _nothing(Reason.ALL_NULL) | {
            "null_share": np.ones(()),
            "null_share_se": np.zeros(()),
        }
    found = _nothing(Reason.CONSTANT)
    found["null_share"] = np.asarray(null_share)
    found["null_share_se"] = np.sqrt(null_share * (1 - null_share) / n)
    z = x.astype(np.float64) / scale
    mean = z.mean()
    z -= mean
    ascending = np.sort(x)
    found["quantile"], found["quantile_se"] = _quantiles(ascending)
    if high - low <= CONSTANT_SPREAD * scale:
        found |= {"mean": mean * scale, "mean_se": np.zeros(()), "mean_reason": _code(Reason.OK)}
        return {name: np.asarray(value) for name, value in found.items()}
    found |= _moments(z, scale, mean)
    found |= _tops(z, ascending / scale - mean)
    found |= _coverages(z, float(found["mean_se"]) / scale)
    found |= _rejections(z)
    with np.errstate(all="ignore"):
        found |= _tails(x)
    found |= _modes(ascending)
    if found["variance_reason"] != Reason.OK:
        for name in ("tail_variance_share", "tail_variance_share_se", "variance_seen"):
            found[name] = np.full_like(found[name], np.nan)
    return {name: np.asarray(value) for name, value in found.items()}


def _code(reason: Reason) -> _Int8:
    return np.asarray(reason, np.int8)


def _error(influence: Floats, value: float) -> tuple[float, bool]:
    """Return the standard error of a number, and whether the samples determine both."""
    square = influence * influence
    total, fourth = float(square.sum()), float(np.vecdot(square, square))
    error = np.sqrt(total) / influence.size
    is_shared = total**2 >= _LEAST_SHARING * fourth
    return error, bool(is_shared or error <= _SMALL_ERROR * abs(value))


def _error_of_share(hits: float, count: int) -> float:
    """Return the standard error of a share: 0 or 1 of few is not certain (Agresti, Coull 1998)."""
    smoothed = (hits + 2) / (count + 4)
    return float(np.sqrt(smoothed * (1 - smoothed) / (count + 4)))


def _moments(z: Floats, scale: float, mean: float) -> dict[str, Any]:
    """Return moments from deviations in units of `scale`."""
    n = z.size
    error, known = _error(z, mean)
    found: dict[str, Any] = {
        "mean": mean * scale if known else np.nan,
        "mean_se": error * scale if known else np.nan,
        "mean_reason": _code(Reason.OK if known else Reason.UNIDENTIFIED),
    }
    square = z * z
    variance = square.mean()
    error, own = _error(square - variance, variance)
    known &= own
    found |= {
        "variance": variance * n / (n - 1) * scale**2 if known else np.nan,
        "variance_se": error * scale**2 if known else np.nan,
        "variance_reason": _code(Reason.OK if known else Reason.UNIDENTIFIED),
        "largest_variance_share": square.max() / square.sum(),
    }
    s = z / np.sqrt(variance)
    square = s * s
    cube, fourth = square * s, square * square
    a, b = cube.mean(), fourth.mean()
    # Influence functions of skewness and kurtosis, as in chdstat.inference.averages.
    skewness_se, _ = _error(cube - a - 3 * s - 1.5 * a * (square - 1), a)
    kurtosis_se, own = _error(fourth - b - 4 * a * s - 2 * b * (square - 1), b)
    known &= own  # one sample that decides the variance bounds its own influence on the kurtosis
    needed = n_of_shape(*np.abs([[a], [b - 3]]), n_means=N_MEANS)[0]
    by_skewness = 2 * abs(a) * skewness_se / (4 * 6 / N_MEANS)
    by_kurtosis = kurtosis_se / (2 * np.sqrt(24 / N_MEANS))
    is_of_skewness = a * a / (4 * 6 / N_MEANS) > abs(b - 3) / (2 * np.sqrt(24 / N_MEANS))
    values = {
        "skewness": a,
        "skewness_se": skewness_se,
        "kurtosis": b - 3,
        "kurtosis_se": kurtosis_se,
        "n_gaussian": needed,
        "n_gaussian_se": by_skewness if is_of_skewness else by_kurtosis,
    }
    found["kurtosis_reason"] = _code(Reason.OK if known else Reason.UNIDENTIFIED)
    return found | {name: value if known else np.nan for name, value in values.items()}


def _quantiles(ascending: Array) -> tuple[Floats, Floats]:
    """Return quantiles of ascending samples, and their standard errors."""
    n, q = ascending.size, np.array(QUANTILES)
    spread = np.sqrt(q * (1 - q) / n)
    low, value, high = (
        ascending[np.clip(np.floor(at * n).astype(int), 0, n - 1)].astype(np.float64)
        for at in (q - spread, q, q + spread)
    )
    return value, (high - low) / 2


def _tops(z: Floats, ascending: Floats) -> dict[str, Any]:
    """Return shares of the variance in the largest samples; `ascending` are sorted deviations."""
    n, total = z.size, float(np.vecdot(z, z)) / z.size
    values, errors = np.full((2, len(TOPS)), np.nan)
    for i, top in enumerate(TOPS):
        k = round(top * n)
        if k < _LEAST_EXCESSES:
            continue
        limit, largest = ascending[-k], ascending[-k:]
        part = float(np.vecdot(largest, largest)) / n
        share = part / total
        # The influence of a sample on a sum of the largest, on the mean that it is about, and on
        # the sum of all.
        inside = np.where(z >= limit, z * z - limit**2, 0) + k / n * limit**2 - part
        inside -= 2 * largest.sum() / n * z
        values[i] = share
        errors[i], _ = _error((inside - share * (z * z - total)) / total, share)
    return {"tail_variance_share": values, "tail_variance_share_se": errors}


def _coverages(z: Floats, mean_se: float) -> dict[str, Any]:
    """Return how often error bars of disjoint batches hold 0, the mean of all deviations."""
    sizes, found = len(SIZES), {}
    below, above, error, seen = np.full((4, sizes), np.nan)
    for i, size in enumerate(SIZES):
        count = z.size // size
        batches = z[: count * size].reshape(count, size)
        mean = batches.mean(axis=-1)
        variance = np.maximum(np.vecdot(batches, batches) / size - mean**2, 0) * size / (size - 1)
        half = Z_95 * np.sqrt(variance / size)
        if np.isfinite(mean_se):
            # Of the mean of all samples, and one standard error below and above it.
            shares = [
                ((mean + half < t).mean(), (mean - half > t).mean())
                for t in (0.0, -mean_se, mean_se)
            ]
            (below[i], above[i]), *others = shares
            held = 1 - below[i] - above[i]
            moved = max(abs(1 - low - high - held) for low, high in others)
            error[i] = np.hypot(_error_of_share(held * count, count), moved)
        seen[i] = np.median(variance) / (np.vecdot(z, z) / z.size)
    unknown = ~(error <= _MOST_ERROR)
    for name, values in (
        ("coverage", 1 - below - above),
        ("coverage_se", error),
        ("missed_low", below),
        ("missed_high", above),
    ):
        found[name] = np.where(unknown, np.nan, values)
    found["coverage_reason"] = np.where(unknown, Reason.UNIDENTIFIED, Reason.OK).astype(np.int8)
    return found | {"variance_seen": seen}


def _rejections(z: Floats) -> dict[str, Any]:
    """Return how often Shapiro and Wilk's test rejects sets of averages of disjoint samples."""
    share, error = np.full((2, len(AVERAGED)), np.nan)
    test = TESTS["shapiro-wilk"]
    for i, size in enumerate(AVERAGED):
        sets = min(_SETS, z.size // (size * N_MEANS))
        if sets < 1:
            continue
        batches = z[: sets * N_MEANS * size].reshape(sets, N_MEANS, size)
        averages = np.sort(batches.mean(axis=-1), axis=-1)
        spread = averages[:, -1] - averages[:, 0]
        usable = spread > CONSTANT_SPREAD * np.abs(averages).max(axis=-1)
        tested = run_tests(averages, np.full(sets, N_MEANS), usable, ("linear",), (test,))
        # Averages that are all equal although samples are not are not Gaussian.
        rejected = ~usable | (tested["p_value"][:, 0, 0] <= _ALPHA)
        share[i] = rejected.mean()
        error[i] = _error_of_share(rejected.sum(), sets)
    passing, interval = _passing_n(share, error)
    return {
        "rejected": share,
        "rejected_se": error,
        "n_passing": passing,
        "n_passing_interval": interval,
    }


def _passing_n(rejected: Floats, error: Floats) -> tuple[Floats, Floats]:
    """Return the N from which on averages pass, and its 95 % interval, on a new last axis.

    Shares of rejections fall with N, but those of few sets are noisy: where they rise, neighbours
    are averaged (isotonic regression, weighted by their errors; Barlow, Bartholomew, Bremner and
    Brunk, "Statistical inference under order restrictions", 1972).

    Examples
    --------
    >>> _passing_n(np.array([0.9, 0.3, 0.08, 0.11] + 7 * [0.05]), np.full(11, 0.01))
    (array(4.), array([ 4., 16.]))
    """
    shape = rejected.shape[:-1]
    rows = zip(rejected.reshape(-1, len(AVERAGED)), error.reshape(-1, len(AVERAGED)), strict=True)
    found = np.reshape([_passing(share, own) for share, own in rows], (*shape, 3))
    return np.asarray(found[..., 1]), found[..., [0, 2]]


def _passing(rejected: Floats, error: Floats) -> list[float]:
    """Return low end, value and high end of the N of one row; infinite if it passes nowhere."""
    known = np.isfinite(rejected)
    if not known.any():
        return [np.nan] * 3
    weights, ends = error[known] ** -2, []
    for side in (-Z_95, 0, Z_95):
        shares = rejected[known] + side * error[known]
        falling = optimize.isotonic_regression(shares, weights=weights, increasing=False).x
        often = np.count_nonzero(falling > _PASSES)
        ends.append(float(AVERAGED[often]) if often < falling.size else np.inf)
    return ends


def _tails(x: Array) -> dict[str, Any]:
    """Return tail indices by the share of positive samples."""
    shares, n = np.array(TAIL_SHARES), x.size
    xi, error = np.full((2, len(shares)), np.nan)
    reason = np.full(len(shares), Reason.TOO_FEW, np.int8)
    for used, which in ((min(n, _ENOUGH), shares >= _WIDE), (n, shares < _WIDE)):
        whole = _Tops.of(x[np.newaxis, :used], shares[which].max())
        cut = used // _BATCHES * _BATCHES
        batches = _Tops.of(x[:cut].reshape(_BATCHES, -1), shares[which].max())
        for i in np.flatnonzero(which):
            found = whole.tail(shares[i])
            if found is None:
                continue
            xi[i], reason[i], error[i] = found.xi[0], found.reason[0], found.standard_error[0]
            if (several := batches.tail(shares[i])) is not None:
                # Where the tail is no generalised Pareto distribution, its error is another one.
                error[i] = np.fmax(error[i], several.xi.std(ddof=1) / np.sqrt(_BATCHES))
    return {"tail_index": xi, "tail_index_se": error, "tail_index_reason": reason}


@dataclass(frozen=True)
class _Tops:
    """The largest samples of rows, and the number of all positive samples, shape (row,)."""

    part: PositivePart
    n: Counts

    @classmethod
    def of(cls, rows: Array, share: float) -> _Tops:
        """Take a little more than a share of the samples, so that there is a threshold."""
        kept = rows.shape[-1] - min(rows.shape[-1], int(1.1 * share * rows.shape[-1]) + 2)
        largest = np.sort(rows, axis=-1)[:, kept:]  # np.partition takes ten times as long on nulls
        return cls(PositivePart.of(largest), np.count_nonzero(rows > 0, axis=-1))

    def tail(self, share: float) -> Tail | None:
        """Fit the largest `share` of the positive samples of each row; None if they are few."""
        excesses = share * self.n.min()
        if excesses < _LEAST_EXCESSES:
            return None
        of_kept = float(share * self.n.mean() / self.part.n.mean())
        return measured(self.part, TailIndex(share=of_kept))


# --- modes --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Mode:
    """A maximum of a density: its bin, the bins it owns, and its excess mass with its error."""

    peak: int
    start: int
    stop: int
    excess: float
    error: float


def _modes(ascending: Array) -> dict[str, Any]:
    """Return the modes of the density of log10 of the positive samples."""
    positive = ascending[np.searchsorted(ascending, 0, "right") :]
    names = ("mode_place", "mode_mass", "mode_excess", "mode_excess_se")
    kept = np.full((len(names), MOST_MODES), np.nan)
    counts = np.zeros(len(BANDWIDTHS), np.int8)
    if positive.size < LEAST:
        reason = np.full(len(BANDWIDTHS), Reason.TOO_FEW, np.int8)
        return {"modes": counts, "modes_reason": reason, **dict(zip(names, kept, strict=True))}
    reason = np.zeros(len(BANDWIDTHS), np.int8)
    log = np.log10(positive, dtype=np.float64)
    margin = 4 * max(BANDWIDTHS)
    start = log[0] - margin
    bins = int(np.ceil((log[-1] + margin - start) / _BINS))
    histogram = np.bincount(((log - start) / _BINS).astype(np.int64), minlength=bins)
    mass = histogram / positive.size
    for i, bandwidth in enumerate(BANDWIDTHS):
        smooth = ndimage.gaussian_filter1d(mass, bandwidth / _BINS, mode="constant", truncate=5)
        modes = _separated(smooth, positive.size, bandwidth / _BINS)
        counts[i] = sum(mode.excess >= _COUNTED for mode in modes)
        if any(abs(mode.excess - _COUNTED) < 2 * mode.error for mode in modes):
            reason[i] = Reason.UNIDENTIFIED
            counts[i] = 0
        if i == len(BANDWIDTHS) // 2:
            for j, mode in enumerate(modes[:MOST_MODES]):
                own = mass[mode.start : mode.stop].sum()
                place = start + (mode.peak + 0.5) * _BINS
                kept[:, j] = place, own, mode.excess, mode.error
    return {"modes": counts, "modes_reason": reason, **dict(zip(names, kept, strict=True))}


def _separated(density: Floats, n: int, width: float) -> list[_Mode]:
    """Return the modes of a density over bins, with the largest excess mass first.

    Valleys are filled from the highest down. Each joins two hills, of which the lower one ends
    there. `width` is that of the kernel in bins, and `n` the number of samples.
    """
    slope = np.sign(np.diff(density))
    turns = np.flatnonzero(slope)
    rising = slope[turns] > 0
    # A plateau, between the last rise and the next fall, turns at its beginning.
    peaks = turns[:-1][rising[:-1] & ~rising[1:]] + 1
    valleys = turns[:-1][~rising[:-1] & rising[1:]] + 1
    ends = np.concatenate([[0], valleys, [density.size]])
    # A hill lies between two valleys that are not yet filled; it is found by either of them.
    hills = {
        int(end): (int(end), int(stop), int(peak))
        for end, stop, peak in zip(ends, ends[1:], peaks, strict=False)
    }
    ending = {stop: start for start, stop, _ in hills.values()}
    found = []
    for valley in valleys[np.argsort(-density[valleys], kind="stable")].tolist():
        left, right = hills[ending[valley]], hills.pop(valley)
        level = float(density[valley])
        lower, higher = sorted((left, right), key=lambda hill: float(density[hill[2]]))
        mode = _above(density[lower[0] : lower[1]], level, n, width)
        if mode[0] >= _LEAST_EXCESS:
            found.append((lower[2], *mode))
        hills[left[0]] = left[0], right[1], higher[2]
        ending[right[1]] = left[0]
    found.append((int(density.argmax()), 1.0, 0.0))
    found.sort()
    places = [peak for peak, *_ in found]
    cuts = [a + int(density[a:b].argmin()) for a, b in itertools.pairwise(places)]
    sides = zip([0, *cuts], [*cuts, density.size], strict=True)
    modes = [
        _Mode(peak, start, stop, excess, error)
        for (peak, excess, error), (start, stop) in zip(found, sides, strict=True)
    ]
    return sorted(modes, key=lambda mode: -mode.excess)


def _above(hill: Floats, level: float, n: int, width: float) -> tuple[float, float]:
    """Return the mass of a hill above a level, and its standard error."""
    over = np.maximum(hill - level, 0)
    bins, excess = np.count_nonzero(over), float(over.sum())
    inside = excess + level * bins
    # That of the mass of the bins, and of the level in each of them: the variance of a kernel
    # density is the density over n and over 2 sqrt(pi) widths.
    of_level = level / (n * width * 2 * np.sqrt(np.pi))
    return excess, float(np.hypot(np.sqrt(inside * (1 - inside) / n), bins * np.sqrt(of_level)))
