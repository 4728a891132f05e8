"""Estimators that give the largest samples less weight, or resample.

`bayesian_median_of_means` corrects by the skewness, smoothly and by little; `lee_valiant` takes
weight off the samples that are far from the median of means, and tends to the mean as fast as any
estimator can. `jung2015` draws bootstrap means of a pixel and takes a robust location of them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_samples, whole
from chdstat.errors import InputError
from chdstat.estimators.buckets import median_of_means
from chdstat.estimators.m_estimators import huber
from chdstat.estimators.registry import register
from chdstat.estimators.rows import Floats, estimate_rows, median_of_sorted, row_sums

__all__ = ["bayesian_median_of_means", "bootstrap_counts", "jung2015", "lee_valiant"]


@register("bayesian_median_of_means", source="Orenstein 2019, doi:10.48550/arXiv.1906.01204")
def bayesian_median_of_means(
    x: npt.ArrayLike, *, alpha: float = 1.0
) -> npt.NDArray[np.floating[Any]]:
    """Approximate Bayesian median of means (aBMM): the mean, corrected by the skewness.

    ``mean - sigma g / (3 (N alpha + 2))`` with the standard deviation sigma (divisor N) and the
    skewness g of the samples: the median of the means that Dirichlet(alpha) weights give, without
    drawing any. The correction vanishes as 1/N, faster than the error of the mean.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.
    alpha
        Concentration of the weights, larger than 0; the mean for alpha to infinity.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`, within the range of the samples; NaN
        where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, or `alpha` is not positive.

    References
    ----------
    P. Orenstein, "Robust mean estimation with the Bayesian median of means", 2019,
    doi:10.48550/arXiv.1906.01204.

    Examples
    --------
    >>> x = [1.0] * 31 + [33.0]
    >>> float(np.mean(x)), round(float(bayesian_median_of_means(x)), 3)
    (2.0, 1.706)
    """
    if not alpha > 0:
        message = f"alpha must be larger than 0, got {alpha}"
        raise InputError(message)

    def kernel(rows: Floats) -> Floats:
        mean = row_sums(rows) / rows.shape[-1]
        deviation = rows - mean[:, np.newaxis]
        square = deviation * deviation
        second, third = row_sums(square), np.vecdot(square, deviation)
        # sigma times skewness is M3 / M2. Equal samples have neither.
        shift = np.divide(third, second, out=np.zeros_like(mean), where=second > 1e-30)
        # A tiny alpha would correct by more than there is: means with weights have bounds.
        found = mean - shift / (3 * (rows.shape[-1] * alpha + 2))
        return np.asarray(np.clip(found, rows.min(axis=-1), rows.max(axis=-1)))

    return estimate_rows(as_samples(x), kernel)


@register(
    "lee_valiant",
    source="Lee and Valiant 2021, doi:10.1109/FOCS52979.2021.00071",
    minimum_samples=5,
)
def lee_valiant(
    x: npt.ArrayLike, *, delta: float = 0.01, buckets: int | None = None
) -> npt.NDArray[np.floating[Any]]:
    """Lee and Valiant's mean: take a set amount of weight off the samples far from the centre.

    With kappa the `median_of_means`, ``w_i = min(a (x_i - kappa)^2, 1)`` with a such that ``sum w_i
    = log(1 / delta) / 3``; the estimate is ``kappa + (1/N) sum (x_i - kappa) (1 - w_i)``.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.
    delta
        Probability of a large error, between 0 and 1: the smaller, the more weight is taken off.
        Where fewer samples differ from kappa than that amount, all of these lose all of theirs.
    buckets
        Of the median of means; None takes log(1 / delta) of them, rounded up, as the authors do.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If there are fewer samples than buckets, no bucket, or `delta` is no probability.

    References
    ----------
    J. C. H. Lee and P. Valiant, "Optimal sub-Gaussian mean estimation in R", Foundations of
    Computer Science, 2021, doi:10.1109/FOCS52979.2021.00071.

    Examples
    --------
    >>> float(lee_valiant([1.0] * 31 + [900.0]))
    1.0
    """
    if not 0 < delta < 1:
        message = f"delta must lie between 0 and 1, got {delta}"
        raise InputError(message)
    amount = float(np.log(1 / delta)) / 3

    def kernel(rows: Floats, centre: Floats) -> Floats:
        deviation = rows - centre[:, np.newaxis]
        square = deviation * deviation
        weight = square * _strength(square, amount)[:, np.newaxis]
        np.minimum(weight, 1, out=weight)
        np.subtract(1, weight, out=weight)
        return np.asarray(centre + np.vecdot(deviation, weight) / rows.shape[-1])

    samples = as_samples(x)
    count = max(1, int(np.ceil(3 * amount))) if buckets is None else buckets
    return estimate_rows(samples, kernel, median_of_means(samples, buckets=count))


def _strength(square: Floats, amount: float) -> Floats:
    """Solve sum_i min(a s_i, 1) = amount for a in each row."""
    largest = np.sort(square)[:, ::-1]
    rest = row_sums(square)
    # Where not enough samples deviate, every one of them is to lose all: as good as infinite.
    found = np.full(len(square), 1e300)
    open_ = np.ones(len(square), dtype=bool)
    for full in range(min(int(np.ceil(amount)), square.shape[-1])):
        # With the `full` largest at 1, the others share what remains of the amount.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            a = (amount - full) / rest
            fits = open_ & (rest > 0) & (a * largest[:, full] <= 1)
        found[fits] = a[fits]
        open_ &= ~fits
        rest = largest[:, full + 1 :].sum(axis=-1)
    return found


Location = Literal["median", "huber"]


@register(
    "jung2015", source="Jung, Meyer and DeLong 2015, Computer Graphics Forum 34(2), pages 585-596"
)
def jung2015(
    x: npt.ArrayLike, *, resamples: int = 128, location: Location = "median", seed: int = 0
) -> npt.NDArray[np.floating[Any]]:
    """Robust location of the bootstrap distribution of the mean.

    ``location(mean_1 .. mean_B)`` of B resamples of the N samples, drawn with replacement. Where a
    few samples make up the mean, that distribution is skewed and its centre lies below the mean.

    Reconstructed from the paper's abstract, which names the two steps; number and kind of the
    resamples and the location are ours. Resamples are balanced (each sample occurs B times in all),
    so that their mean is the sample mean, and the same for every pixel.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.
    resamples
        B, at least 1.
    location
        'median', or 'huber' for Huber's location.
    seed
        Of the resamples; the estimate depends on it, and on the order of the samples, by about the
        standard error of the mean over sqrt(B).

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, there is no resample or no such location.

    References
    ----------
    J. W. Jung, G. Meyer and R. DeLong, "Robust statistical pixel estimation", Computer Graphics
    Forum 34(2), 2015. A. C. Davison, D. V. Hinkley and E. Schechtman, "Efficient bootstrap
    simulation", Biometrika 73(3), 1986, doi:10.1093/biomet/73.3.555.

    Examples
    --------
    >>> x = np.arange(8.0) ** 4
    >>> float(x.mean()), bool(jung2015(x) < x.mean())
    (584.5, True)
    """
    resamples, seed = whole("resamples", resamples, least=1), whole("seed", seed, least=0)
    if location not in ("median", "huber"):
        message = f"location must be 'median' or 'huber', got {location!r}"
        raise InputError(message)

    def kernel(rows: Floats) -> Floats:
        m = rows.shape[-1]
        means = rows @ bootstrap_counts(m, resamples, seed) / m
        if location == "median":
            return median_of_sorted(np.sort(means))
        return huber(means).astype(np.float64)

    return estimate_rows(as_samples(x), kernel)


@lru_cache(maxsize=64)
def bootstrap_counts(samples: int, resamples: int, seed: int) -> Floats:
    """Return how often each sample occurs in each balanced resample, shape (sample, resample).

    Rows add up to the number of resamples, columns to that of samples.

    Examples
    --------
    >>> counts = bootstrap_counts(4, 6, 0)
    >>> counts.sum(axis=0).tolist(), counts.sum(axis=1).tolist()
    ([4.0, 4.0, 4.0, 4.0, 4.0, 4.0], [6.0, 6.0, 6.0, 6.0])
    """
    deck = np.random.default_rng(seed).permutation(np.tile(np.arange(samples), resamples))
    counts = np.zeros((samples, resamples))
    np.add.at(counts, (deck, np.repeat(np.arange(resamples), samples)), 1)
    return counts
