"""Plug-in means: of fitted families, which the sample mean is pulled towards.

`gamma_shrinkage` shows that the family that most CHDs look like has nothing to offer,
`lognormal_shrinkage` and `mixture_shrinkage` what longer tails and several kinds of light paths do.
All are combinations by `chdstat.estimators.james_stein`. Negative samples count as
zeros in the fits, and what they contribute to the mean is added.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._positive import PositivePart
from chdstat.estimators._rows import Floats, estimate_rows
from chdstat.estimators.classical import mean_of_good
from chdstat.estimators.registry import register
from chdstat.estimators.shrinkage import SOURCE, shrink_mean, whole_samples
from chdstat.fit.families import FAMILIES
from chdstat.fit.mixture_results import Mixture
from chdstat.fit.mixtures import mixture
from chdstat.fit.mle import fit_part
from chdstat.fit.results import Fit

__all__ = ["gamma_shrinkage", "lognormal_shrinkage", "mixture_shrinkage"]


@register("gamma_shrinkage", source=SOURCE, joint_channels=True)
def gamma_shrinkage(x: npt.ArrayLike) -> npt.NDArray[np.floating[Any]]:
    """James-Stein combination of the mean with that of a fitted zero-inflated gamma.

    It is the mean: of a gamma distribution, the maximum-likelihood estimate of the expectation is
    the sample mean, and so it is with the share of nulls. The family that most CHDs look like has
    nothing to offer here. Kept so that a comparison shows it.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample). A sample of which any channel is NaN or infinite
        is left out.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), in the unit and dtype of `x`; the mean of a channel's good
        samples where no whole sample is good, NaN where there are none of these.

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
    samples = whole_samples(x)
    return shrink_mean(samples, _mean_of_fit(samples, _of_family("gamma")))


@register("lognormal_shrinkage", source=SOURCE, joint_channels=True)
def lognormal_shrinkage(x: npt.ArrayLike) -> npt.NDArray[np.floating[Any]]:
    """James-Stein combination of the mean with that of a fitted zero-inflated log-normal.

    The plug-in ``(1 - null share) exp(mu + sigma^2 / 2)`` weighs the largest samples less than the
    mean does where sigma is small, but extrapolates a tail where it is large; then the two are far
    apart and the mean counts. Where no log-normal can be fitted it is the mean.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample). A sample of which any channel is NaN or infinite
        is left out.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), in the unit and dtype of `x`; the mean of a channel's good
        samples where no whole sample is good, NaN where there are none of these.

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
    samples = whole_samples(x)
    return shrink_mean(samples, _mean_of_fit(samples, _of_family("lognormal")))


@register("mixture_shrinkage", source=SOURCE, joint_channels=True)
def mixture_shrinkage(x: npt.ArrayLike, *, max_k: int = 3) -> npt.NDArray[np.floating[Any]]:
    """James-Stein combination of the mean with that of a fitted zero-inflated log-normal mixture.

    The plug-in ``(1 - null share) sum_j w_j exp(mu_j + sigma_j^2 / 2)`` extrapolates less than that
    of one log-normal, as its components are narrower. The components are not gamma ones: those
    have, like one gamma distribution, the sample mean for their plug-in. The likelihood of a
    mixture has no maximum, so that among few samples BIC mostly takes the largest number of
    components, and some of these are single samples: the plug-in then stays near the mean, and it
    does not depend on the order of the samples, as a choice by held-out likelihood would. Where no
    mixture can be fitted it is the mean.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    max_k
        Largest number of components, at most 8; BIC chooses.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), in the unit and dtype of `x`; the mean of a channel's good
        samples where no whole sample is good, NaN where there are none of these.

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
    (94.6875, 96.5)
    """
    samples = whole_samples(x)

    def kernel(rows: Floats) -> Floats:
        return _mean_of_fit(rows, lambda x: mixture(x, max_k=max_k, effort="fast"))

    # Near 1, logarithms are exact enough for the narrowest components, of a width of 1e-3.
    with np.errstate(over="ignore"):
        plug_in = estimate_rows(samples.astype(np.float64, copy=False), kernel)
    return shrink_mean(samples, plug_in)


def _of_family(name: str) -> Callable[[Floats], Fit]:
    return lambda x: fit_part(PositivePart.of(x), FAMILIES[name])


def _mean_of_fit(
    samples: npt.NDArray[np.floating[Any]], fit: Callable[[Floats], Fit | Mixture]
) -> Floats:
    """Return the mean of a fit, for which negative samples are zeros, and add their values."""
    # A very wide log-normal has no finite mean in doubles; then the sample mean stands.
    with np.errstate(over="ignore", invalid="ignore"):
        mean = fit(np.maximum(samples, 0)).mean()
        return mean if samples.min(initial=0) >= 0 else mean + mean_of_good(np.minimum(samples, 0))
