"""The sample mean, which every other estimator is measured against, and order statistics.

`median` ignores all but the middle, `trimmed_mean` leaves the ends out, `winsorized_mean` pulls
them in. All treat both ends equally, and radiance is skewed to the right: they come out too dark,
and black where at least half of the samples are null (the median) or all but the trimmed ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_samples, is_bad
from chdstat.estimators.registry import register
from chdstat.estimators.rows import Floats, check_share, estimate_rows, median_of_sorted, row_sums

__all__ = ["mean", "mean_of_good", "median", "trimmed_mean", "winsorized_mean"]


@register("mean", source="Metropolis and Ulam 1949, doi:10.1080/01621459.1949.10483310")
def mean(x: npt.ArrayLike) -> npt.NDArray[np.floating[Any]]:
    """Sample mean, (1/N) sum x_i: unbiased, and at the mercy of fireflies.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample.

    References
    ----------
    N. Metropolis and S. Ulam, "The Monte Carlo method", Journal of the American Statistical
    Association 44(247), 1949, doi:10.1080/01621459.1949.10483310.

    Examples
    --------
    >>> float(mean([0.0, 1.0, 5.0]))
    2.0
    """
    samples = as_samples(x)
    return mean_of_good(samples).astype(samples.dtype)


def mean_of_good(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Average the good samples of (..., sample) in float64; NaN where there is none."""
    with np.errstate(invalid="ignore"):
        found = np.asarray(x.mean(axis=-1, dtype=np.float64))
        if np.isfinite(found).all():
            return found
        bad = is_bad(x)
        total = np.where(bad, 0, x).sum(axis=-1, dtype=np.float64)
        return np.asarray(total / (~bad).sum(axis=-1))


@register("median", source="Hampel 1974, doi:10.1080/01621459.1974.10482962")
def median(x: npt.ArrayLike) -> npt.NDArray[np.floating[Any]]:
    """Median of the samples: unmoved by fireflies in less than half of them.

    It estimates the median of the distribution, not its mean, so its bias does not vanish with more
    samples: ``median_of_means`` is what tends to the mean.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample.

    References
    ----------
    F. R. Hampel, "The influence curve and its role in robust estimation", Journal of the American
    Statistical Association 69(346), 1974, doi:10.1080/01621459.1974.10482962.

    Examples
    --------
    >>> float(median([1.0, 2.0, 900.0]))
    2.0
    """
    return estimate_rows(as_samples(x), median_of_sorted, ordered=True)


@register("trimmed_mean", source="Tukey 1962, doi:10.1214/aoms/1177704711")
def trimmed_mean(x: npt.ArrayLike, *, share: float = 0.1) -> npt.NDArray[np.floating[Any]]:
    """Mean of the samples without the g smallest and the g largest, g = floor(share N).

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out; N counts the
        others.
    share
        Share of the samples to leave out at each end, 0 (the mean) to less than 0.5.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, or `share` leaves none.

    References
    ----------
    J. W. Tukey, "The future of data analysis", Annals of Mathematical Statistics 33(1), 1962,
    doi:10.1214/aoms/1177704711.

    Examples
    --------
    >>> float(trimmed_mean([0.0, 1.0, 2.0, 3.0, 900.0], share=0.2))
    2.0
    """
    check_share(share)

    def kernel(rows: Floats) -> Floats:
        cut = int(share * rows.shape[-1])
        inner = rows[:, cut : rows.shape[-1] - cut]
        return np.asarray(row_sums(inner) / inner.shape[-1])

    return estimate_rows(as_samples(x), kernel, ordered=True)


@register("winsorized_mean", source="Dixon 1960, doi:10.1214/aoms/1177705900")
def winsorized_mean(x: npt.ArrayLike, *, share: float = 0.1) -> npt.NDArray[np.floating[Any]]:
    """Mean of the samples with the g smallest and largest set to those next to them.

    With the samples in ascending order, ``((g + 1) (x_(g+1) + x_(N-g)) + sum of those between) /
    N`` and g = floor(share N).

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out; N counts the
        others.
    share
        Share of the samples to pull in at each end, 0 (the mean) to less than 0.5.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, or `share` leaves none.

    References
    ----------
    W. J. Dixon, "Simplified estimation from censored normal samples", Annals of Mathematical
    Statistics 31(2), 1960, doi:10.1214/aoms/1177705900.

    Examples
    --------
    >>> float(winsorized_mean([0.0, 1.0, 2.0, 3.0, 900.0], share=0.2))
    2.0
    """
    check_share(share)

    def kernel(rows: Floats) -> Floats:
        m = rows.shape[-1]
        cut = int(share * m)
        ends = cut * (rows[:, cut] + rows[:, m - 1 - cut])
        return np.asarray((row_sums(rows[:, cut : m - cut]) + ends) / m)

    return estimate_rows(as_samples(x), kernel, ordered=True)
