"""Error measures: how far estimates are from a reference, per channel, and how sure that is.

`mse` and `relmse` measure the error, `improved` counts the estimates that beat the sample mean, and
`bias` belongs next to each of them: an estimator that darkens the image can have a small error.
`bootstrap` gives any of them a standard error and an interval over pixels, or blocks of them.

Arrays hold channels on the last axis; every leading axis (pixels, batches) is averaged over.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, generator, spans, whole
from chdstat._core.resampling import Interval
from chdstat.errors import InputError
from chdstat.estimators.registry import check_probability

__all__ = [
    "bias",
    "bootstrap",
    "improved",
    "mse",
    "relative_squared_error",
    "relmse",
    "squared_error",
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

    Pixels are the unit that is drawn, so whatever varies within a pixel (batches, channels) stays
    together. The interval takes pixels for independent draws of the image, as their noise is; for
    what neighbours share, such as the gain of an estimator, give means over blocks in their place.

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
