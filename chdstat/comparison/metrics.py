"""Error measures: how far estimates are from a reference, per channel, and how sure that is.

`mse` and `relmse` measure the error, `improved` counts the estimates that beat the sample mean, and
`bias` belongs next to each of them: an estimator that darkens the image can have a small error.
`bootstrap` gives any of them a standard error and an interval over pixels, or blocks of them.
Arrays hold channels on the last axis; every leading axis (pixels, batches) is averaged over.

`MEASURES` are what a comparison reports. Each is a ratio of sums over units, so that one bootstrap
over the units serves all of them: `errors_of` returns what is summed, `measures_of` the measures of
the sums. A unit is a block of pixels with all their batches, or a batch with all its pixels.
Neighbours see the same light and gain or lose together; therefore, intervals are over blocks
(Künsch 1989, doi:10.1214/aos/1176347265).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._core.arrays import Array, generator, spans, whole
from chdstat._core.resampling import Interval
from chdstat.errors import InputError
from chdstat.estimators.registry import check_probability

__all__ = [
    "MEASURES",
    "SUMS",
    "bias",
    "bootstrap",
    "counts",
    "errors_of",
    "improved",
    "measures_of",
    "mse",
    "relative_squared_error",
    "relmse",
    "squared_error",
    "stacked",
]


_EPSILON = 0.01
"""Share of the squared scene mean that keeps relMSE finite in the dark."""
_REPLICATES_AT_ONCE = 64


def squared_error(estimate: npt.ArrayLike, reference: npt.ArrayLike) -> Array:
    """Return (p - y)^2 of every estimate p and its reference y, in float64."""
    return np.square(_difference(estimate, reference))


def relative_squared_error(
    estimate: npt.ArrayLike, reference: npt.ArrayLike, *, scene_mean: npt.ArrayLike | None = None
) -> Array:
    """Return (p - y)^2 / (y^2 + 0.01 m^2) of every estimate p and its reference y.

    Parameters
    ----------
    estimate, reference
        Radiance, shape (..., channel).
    scene_mean
        m, the mean reference of the whole scene per channel; None takes the mean of `reference`.

    Returns
    -------
    ndarray
        Shape of `estimate`; 0 where estimate and reference are equal, even if both are 0 in a
        scene without light.
    """
    error = squared_error(estimate, reference)
    y = np.asarray(reference, np.float64)
    m = _over_pixels(y) if scene_mean is None else np.asarray(scene_mean, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = error / (y**2 + _EPSILON * m**2)
    return np.where(error == 0, 0.0, relative)


def mse(estimate: npt.ArrayLike, reference: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Mean squared error, mean((p - y)^2).

    Parameters
    ----------
    estimate, reference
        Radiance, shape (..., channel); leading axes are averaged over.

    Returns
    -------
    ndarray
        Squared radiance, shape (channel,).

    Raises
    ------
    InputError
        If the shapes differ.

    Examples
    --------
    >>> mse([[1.0], [3.0]], [[1.0], [1.0]])
    array([2.])
    """
    return _over_pixels(squared_error(estimate, reference))


def relmse(
    estimate: npt.ArrayLike, reference: npt.ArrayLike, *, scene_mean: npt.ArrayLike | None = None
) -> npt.NDArray[np.float64]:
    """Relative mean squared error, mean((p - y)^2 / (y^2 + 0.01 m^2)).

    Parameters
    ----------
    estimate, reference
        Radiance, shape (..., channel); leading axes are averaged over.
    scene_mean
        m, the mean reference of the whole scene per channel; None takes the mean of `reference`.
        Give it where `reference` is only a part of the image.

    Returns
    -------
    ndarray
        A pure number, shape (channel,).

    Raises
    ------
    InputError
        If the shapes differ.

    Examples
    --------
    >>> relmse([[2.0], [2.0]], [[1.0], [1.0]]).round(3)
    array([0.99])
    """
    return _over_pixels(relative_squared_error(estimate, reference, scene_mean=scene_mean))


def improved(
    estimate: npt.ArrayLike, reference: npt.ArrayLike, mean: npt.ArrayLike
) -> npt.NDArray[np.float64]:
    """Share of estimates whose squared error is smaller than that of the sample mean.

    A tie is no improvement, so the mean itself scores 0.

    Parameters
    ----------
    estimate, reference, mean
        Radiance, shape (..., channel); `mean` is the average of the samples that `estimate` saw.

    Returns
    -------
    ndarray
        Between 0 and 1, shape (channel,).

    Raises
    ------
    InputError
        If the shapes differ.

    Examples
    --------
    >>> improved([[1.1], [2.0]], [[1.0], [1.0]], [[1.5], [1.5]])
    array([0.5])
    """
    better = squared_error(estimate, reference) < squared_error(mean, reference)
    return _over_pixels(better)


def bias(estimate: npt.ArrayLike, reference: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Energy gained or lost, mean(p - y) / mean(y).

    Parameters
    ----------
    estimate, reference
        Radiance, shape (..., channel); leading axes are averaged over.

    Returns
    -------
    ndarray
        A pure number, negative where energy is lost, shape (channel,); NaN where the reference is
        black.

    Raises
    ------
    InputError
        If the shapes differ.

    Examples
    --------
    >>> bias([[0.9], [1.0]], [[1.0], [1.0]]).round(3)
    array([-0.05])
    """
    lost = _over_pixels(_difference(estimate, reference))
    with np.errstate(divide="ignore", invalid="ignore"):
        return lost / _over_pixels(np.asarray(reference, np.float64))


def bootstrap(
    values: npt.ArrayLike,
    statistic: Callable[[Array], Array] | None = None,
    *,
    replicates: int = 1000,
    level: float = 0.95,
    seed: int | np.random.Generator | None = 0,
) -> Interval[Array]:
    r"""Bootstrap a statistic of pixel means: draw pixels with replacement, ask for its spread.

    Pixels are drawn whole, with all their batches and channels. The interval assumes that pixels
    are independent, as their noise is. Neighbours share the gain of an estimator: give means over
    blocks of pixels for it.

    Parameters
    ----------
    values
        What is averaged, pixels on the first axis: shape (pixel, ...).
    statistic
        Maps means, shape (replicate, ...), to the statistic, shape (replicate, \*result); None
        takes the means themselves. A ratio of means is a statistic, a mean of ratios is not.
    replicates
        Number of bootstrap draws.
    level
        Coverage of the interval.
    seed
        Where the draws start.

    Returns
    -------
    Interval
        Of the shape of one result.

    Raises
    ------
    InputError
        If there is no pixel, fewer than 2 replicates, or `level` is not between 0 and 1.

    References
    ----------
    B. Efron, "Bootstrap methods: another look at the jackknife", Annals of Statistics 7(1), 1979,
    doi:10.1214/aos/1176344552.

    Examples
    --------
    >>> interval = bootstrap([0.0, 1.0, 2.0, 3.0], seed=1)
    >>> float(interval.value), bool(interval.low < 1.5 < interval.high)
    (1.5, True)
    """
    data = np.asarray(values, np.float64)
    if data.ndim == 0 or data.shape[0] == 0:
        message = f"bootstrap needs pixels on the first axis, got shape {data.shape}"
        raise InputError(message)
    whole("replicates", replicates, least=2)
    check_probability(level=level)
    of_means = statistic or (lambda means: means)
    rng, pixels = generator(seed), len(data)
    draws = []
    for part in spans(replicates, _REPLICATES_AT_ONCE):
        drawn = rng.integers(pixels, size=(part.stop - part.start, pixels))
        weights = np.stack([np.bincount(row, minlength=pixels) for row in drawn]) / pixels
        draws.append(of_means((weights @ data.reshape(pixels, -1)).reshape(-1, *data.shape[1:])))
    with np.errstate(invalid="ignore"):
        error = np.concatenate(draws).std(axis=0, ddof=1)
        ends = [(1 - level) / 2, (1 + level) / 2]
        low, high = np.quantile(np.concatenate(draws), ends, axis=0)
    value = of_means(data.mean(axis=0, keepdims=True))[0]
    return Interval(value, low, high, level, error)


def _difference(estimate: npt.ArrayLike, reference: npt.ArrayLike) -> Array:
    p, y = np.asarray(estimate, np.float64), np.asarray(reference, np.float64)
    if p.shape != y.shape or p.ndim == 0:
        message = (
            "estimate and reference must have the same shape (..., channel), "
            f"got {p.shape} and {y.shape}"
        )
        raise InputError(message)
    return p - y


def _over_pixels(values: Array) -> npt.NDArray[np.float64]:
    return np.asarray(values.mean(axis=tuple(range(values.ndim - 1))), np.float64)


# --- measures of a comparison -------------------------------------------------------------------

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
"""What is summed over the estimates of every estimator and channel; the last is 1 for each."""

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

    y being the reference and m the mean reference of the scene: at least two stops too bright,
    and bright enough to be seen in the scene. The scale is that of relMSE: a firefly has a relative
    squared error above 9. We know of no published threshold; this one is ours.

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
        # The error of the mean of equal samples is rounding: no ratio is taken of it.
        exact = relative[:, :1] <= _SAME**2
        ratios = [np.where(exact, np.nan, part / part[:, :1]) for part in (squared, relative)]
        ratios.append(firefly / firefly[:, :1])
    measures = [squared, relative, improved, unchanged, bias, firefly, *ratios]
    return np.stack(measures, axis=1)[:, :, 1:]
