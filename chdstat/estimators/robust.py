"""Robust estimators: less moved by a firefly than the mean, at the price of a bias."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import as_samples, is_bad, spans
from chdstat.errors import InputError
from chdstat.estimators.classical import all_good
from chdstat.estimators.registry import register

__all__ = ["bucket_means", "median_of_means"]


@register("median_of_means", source="Nemirovsky and Yudin 1983", minimum_samples=11)
def median_of_means(x: npt.ArrayLike, buckets: int = 11) -> npt.NDArray[np.floating[Any]]:
    """Median of means: deal the samples into M buckets, take the median of the buckets' means.

    A firefly spoils one bucket, so fewer than M/2 of them do not move the estimate far. Radiance is
    skewed to the right, so the estimate is too dark: by 5 % for gamma(2), by 40 % where most
    samples are null (32 samples, 11 buckets).

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN, infinite and negative samples are left out of their
        bucket; a bucket without a good sample is left out of the median.
    buckets
        M. Sample i falls into bucket i mod M, so consecutive samples are spread.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If there are fewer samples than buckets, or no bucket.

    References
    ----------
    A. Nemirovsky and D. Yudin, "Problem Complexity and Method Efficiency in Optimization", 1983.

    Examples
    --------
    >>> float(median_of_means([1.0, 1.0, 1.0, 1.0, 1.0, 900.0], buckets=3))
    1.0
    """
    samples = as_samples(x)
    means = np.sort(bucket_means(samples, buckets), axis=-1)
    # NaN sorts last, so the buckets that have a mean come first.
    present = np.isfinite(means).sum(axis=-1, keepdims=True)
    middle = np.concatenate([np.maximum(present - 1, 0) // 2, present // 2], axis=-1)
    median = np.take_along_axis(means, middle, axis=-1).mean(axis=-1)
    return np.asarray(median.astype(samples.dtype))


def bucket_means(x: npt.NDArray[np.floating[Any]], buckets: int) -> npt.NDArray[np.float64]:
    """Return the means of round-robin buckets, shape (..., bucket); NaN for one without samples.

    Raises
    ------
    InputError
        If there are fewer samples than buckets, or no bucket.
    """
    if not 1 <= buckets <= x.shape[-1]:
        message = (
            f"buckets must lie between 1 and the number of samples, {x.shape[-1]}; got {buckets}. "
            "Give more samples or fewer buckets"
        )
        raise InputError(message)
    total = np.zeros((*x.shape[:-1], buckets))
    count = np.zeros(total.shape, np.int32)
    bad = None if all_good(x) else is_bad(x)
    for part in spans(x.shape[-1], buckets):
        dealt = np.s_[..., : part.stop - part.start]
        total[dealt] += x[..., part] if bad is None else np.where(bad[..., part], 0, x[..., part])
        count[dealt] += 1 if bad is None else ~bad[..., part]
    with np.errstate(invalid="ignore"):
        return np.asarray(total / count)
