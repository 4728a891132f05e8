"""Shrinkage: the mean, moved towards a biased estimate; the more they differ, the less.

`james_stein` combines any two estimates. `gmon_shrinkage` moves the mean towards a robust estimate,
the others towards the mean of a fitted family. `gamma_shrinkage` changes nothing, although most
CHDs resemble a gamma distribution; `lognormal_shrinkage` allows longer tails, `mixture_shrinkage`
several kinds of light paths. In the fits, negative samples count as zeros; their contribution to
the mean is added afterwards.

The channels of a pixel are shrunk together, by one factor. So a pixel needs no other pixel, and its
hue lies between the hues of the two estimates. With fewer than three channels nothing is shrunk. To
share the factor between pixels too, call `james_stein` with their axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Reals, all_good, is_bad
from chdstat._core.positive import PositivePart
from chdstat.errors import InputError
from chdstat.estimators.registry import estimate_rows, mean_of_good, register
from chdstat.estimators.robust_means import gmon_adaptive
from chdstat.fit.families import FAMILIES, FamilyFit, Fit
from chdstat.fit.mixtures import Mixture, mixture
from chdstat.summary.runner import measured

_SOURCE = "Green and Strawderman 1991, doi:10.1080/01621459.1991.10475144"


def james_stein(
    unbiased: npt.ArrayLike,
    biased: npt.ArrayLike,
    variance: npt.ArrayLike,
    *,
    axis: int | Sequence[int] = -1,
) -> Floats:
    """Combine an unbiased and a biased estimate of k values, with one weight.

    ``b + rho (y - b)``, ``rho = max(0, 1 - (k - 2) sigma^2 / sum (y - b)^2)``. The biased estimate
    b counts more if it is close to the unbiased y, compared with the noise of y. The expected
    squared error is at most that of y if k is at least 3 and the k errors are independent of each
    other and of b, and normal with variance sigma^2. For k below 3 the result is y. The channels of
    a pixel are strongly correlated, and b often comes from the same samples as y: the weight is
    then a rule of thumb.

    Parameters
    ----------
    unbiased
        y, any shape.
    biased
        b, broadcastable to y. Where it is not finite, the result is y, and the value does not count
        among the k.
    variance
        sigma^2 of y, broadcastable to it, averaged over the k values.
    axis
        Axis or axes of the k values.

    Returns
    -------
    ndarray
        Shape of y.

    Raises
    ------
    InputError
        If the shapes do not fit.

    References
    ----------
    E. J. Green and W. E. Strawderman, "A James-Stein type estimator for combining unbiased and
    possibly biased estimators", Journal of the American Statistical Association 86(416), 1991,
    doi:10.1080/01621459.1991.10475144. W. James and C. Stein, "Estimation with quadratic loss",
    Fourth Berkeley Symposium, 1961.

    Examples
    --------
    >>> james_stein([1.0, 2.0, 3.0], [1.0, 1.0, 1.0], 1.0).round(2).tolist()
    [1.0, 1.8, 2.6]
    >>> james_stein([1.0, 2.0], [1.0, 1.0], 1.0).tolist()
    [1.0, 2.0]
    """
    y = np.asarray(unbiased, dtype=np.float64)
    try:
        b = np.broadcast_to(np.asarray(biased, dtype=np.float64), y.shape)
        noise = np.broadcast_to(np.asarray(variance, dtype=np.float64), y.shape)
    except ValueError:
        message = (
            f"biased and variance must be broadcastable to unbiased, shape {y.shape}, "
            f"got {np.shape(biased)} and {np.shape(variance)}"
        )
        raise InputError(message) from None
    axes = tuple(np.atleast_1d(axis))
    known = np.isfinite(b) & np.isfinite(y)
    # Add 1 - rho times the difference to y: a distant b of little weight then costs no digits.
    difference = np.where(known, b, 0) - np.where(known, y, 0)
    k = np.count_nonzero(known, axis=axes, keepdims=True)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore"):
        mean_noise = np.where(known, noise, 0).sum(axis=axes, keepdims=True) / k
        pull = (k - 2) * mean_noise / np.square(difference).sum(axis=axes, keepdims=True)
    pull = np.where(np.isfinite(pull) | (pull == np.inf), np.clip(pull, 0, 1), 0)
    return np.asarray(y + pull * difference)


@register(
    "gmon_shrinkage",
    _SOURCE,
    label="shrinkage to G-MoN",
    place=5,
    minimum_samples=11,
    joint_channels=True,
)
def gmon_shrinkage(x: Reals, *, buckets: int = 11) -> Reals:
    """James-Stein combination of the mean with the adaptive G-MoN, see `james_stein`.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample). Samples with a NaN or infinite channel are left out.
    buckets
        Buckets of the G-MoN.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` has no channels, or fewer samples than buckets.

    References
    ----------
    E. J. Green and W. E. Strawderman, "A James-Stein type estimator for combining unbiased and
    possibly biased estimators", Journal of the American Statistical Association 86(416), 1991,
    doi:10.1080/01621459.1991.10475144.

    Examples
    --------
    >>> x = np.ones((3, 32))
    >>> x[:, 0] = 900.0
    >>> gmon_shrinkage(x).round(1).tolist()
    [19.7, 19.7, 19.7]
    """
    return _shrink_mean(x, partial(gmon_adaptive, buckets=buckets))


@register("gamma_shrinkage", _SOURCE, label="shrinkage to gamma", place=5, joint_channels=True)
def gamma_shrinkage(x: Reals) -> Reals:
    """James-Stein combination of the sample mean with the mean of a fitted zero-inflated gamma.

    It equals the sample mean: for a gamma distribution, with or without nulls, the
    maximum-likelihood estimate of the expectation is the sample mean. It is kept to show this in
    comparisons, since most CHDs look like a gamma distribution.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample). Samples with a NaN or infinite channel are left out.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` has no channels, or holds no sample.

    References
    ----------
    E. J. Green and W. E. Strawderman, "A James-Stein type estimator for combining unbiased and
    possibly biased estimators", Journal of the American Statistical Association 86(416), 1991,
    doi:10.1080/01621459.1991.10475144.

    Examples
    --------
    >>> gamma_shrinkage([[1.0, 2.0, 6.0], [2.0, 1.0, 6.0], [6.0, 1.0, 2.0]]).round(9).tolist()
    [3.0, 3.0, 3.0]
    """
    return _shrink_mean(x, partial(_mean_of_family, name="gamma"))


@register(
    "lognormal_shrinkage", _SOURCE, label="shrinkage to log-normal", place=5, joint_channels=True
)
def lognormal_shrinkage(x: Reals) -> Reals:
    """James-Stein combination of the sample mean with that of a fitted zero-inflated log-normal.

    The fitted mean is ``(1 - null share) exp(mu + sigma^2 / 2)``. For small sigma it gives the
    largest samples less weight than the sample mean does. For large sigma it extrapolates a tail;
    then the two means are far apart and the sample mean counts. Where no log-normal can be fitted,
    the result is the sample mean.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample). Samples with a NaN or infinite channel are left out.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` has no channels, or holds no sample.

    References
    ----------
    E. J. Green and W. E. Strawderman, "A James-Stein type estimator for combining unbiased and
    possibly biased estimators", Journal of the American Statistical Association 86(416), 1991,
    doi:10.1080/01621459.1991.10475144.

    Examples
    --------
    >>> x = np.tile([0.5, 1.0, 2.0, 4.0], (3, 1))
    >>> float(x.mean()), lognormal_shrinkage(x)[0].round(2).item()
    (1.875, 1.91)
    """
    return _shrink_mean(x, partial(_mean_of_family, name="lognormal"))


@register("mixture_shrinkage", _SOURCE, label="shrinkage to mixture", place=5, joint_channels=True)
def mixture_shrinkage(x: Reals, *, max_k: int = 3) -> Reals:
    """James-Stein combination of the sample mean with that of a zero-inflated log-normal mixture.

    The fitted mean is ``(1 - null share) sum_j w_j exp(mu_j + sigma_j^2 / 2)``. It extrapolates
    less than one log-normal, as its components are narrower. Gamma components would change nothing,
    see `gamma_shrinkage`. For few samples, BIC mostly chooses one component; the result is then
    that of `lognormal_shrinkage`. Unlike held-out likelihood, BIC does not depend on the order of
    the samples. Where no mixture can be fitted, the result is the sample mean.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample). Samples with a NaN or infinite channel are left out.
    max_k
        Largest number of components, at most 8; BIC chooses.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` has no channels, or holds no sample, or `max_k` is out of range.

    References
    ----------
    E. J. Green and W. E. Strawderman, "A James-Stein type estimator for combining unbiased and
    possibly biased estimators", Journal of the American Statistical Association 86(416), 1991,
    doi:10.1080/01621459.1991.10475144. G. McLachlan and D. Peel, "Finite mixture models", Wiley,
    2000, doi:10.1002/0471721182. G. Schwarz, "Estimating the dimension of a model", Annals of
    Statistics 6(2), 1978, doi:10.1214/aos/1176344136.

    Examples
    --------
    >>> dark, bright = [0.5, 1.0, 2.0, 4.0], [50.0, 100.0, 200.0, 400.0]
    >>> x = np.tile(np.concatenate([dark, bright] * 4), (3, 1))
    >>> float(x.mean()), mixture_shrinkage(x)[0].round(1).item()
    (94.6875, 98.0)
    """

    def kernel(rows: Floats) -> Floats:
        return _mean_of_fit(rows, lambda x: mixture(x, max_k=max_k, effort="fast"))

    def plug_in(x: Reals) -> Reals:
        # Near 1, logarithms are exact enough for the narrowest components (width 1e-3).
        with np.errstate(over="ignore"):
            return estimate_rows(x.astype(np.float64, copy=False), kernel)

    return _shrink_mean(x, plug_in)


def _shrink_mean(x: Reals, towards: Callable[[Reals], Reals]) -> Reals:
    """Move the mean of samples (..., channel, sample) towards another estimate from them.

    Samples with a bad channel are left out.
    """
    if not all_good(x):
        x = np.where(is_bad(x).any(axis=-2, keepdims=True), x.dtype.type(np.nan), x)

    def standard_error(rows: Floats) -> Floats:
        return np.asarray(rows.std(axis=-1) / np.sqrt(max(rows.shape[-1] - 1, 1)))

    mean, error = mean_of_good(x), estimate_rows(x, standard_error).astype(np.float64)
    # In units of the pixel's brightest channel, squares of the radiance cannot overflow.
    unit = np.fmax.reduce(np.fmax(np.abs(mean), error), axis=-1, keepdims=True, initial=0)
    unit[unit == 0] = 1
    biased = towards(x)
    with np.errstate(over="ignore"):
        return james_stein(mean / unit, biased / unit, (error / unit) ** 2) * unit


def _mean_of_fit(x: Reals, fit: Callable[[Reals], Fit | Mixture]) -> Floats:
    """Return the mean of a fit with negative samples as zeros, plus their contribution."""
    # The mean of a very wide log-normal overflows; the sample mean then remains.
    with np.errstate(over="ignore", invalid="ignore"):
        mean = fit(np.maximum(x, 0)).mean()
        return mean if x.min(initial=0) >= 0 else mean + mean_of_good(np.minimum(x, 0))


def _mean_of_family(x: Reals, name: str) -> Floats:
    return _mean_of_fit(x, lambda x: measured(PositivePart.of(x), FamilyFit(FAMILIES[name])))
