"""Classical estimators: the sample mean, which every other one is measured against."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import as_samples, is_bad
from chdstat.estimators.registry import register

__all__ = ["mean", "mean_of_good"]


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
