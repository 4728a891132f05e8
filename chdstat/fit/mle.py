"""Maximum likelihood: fit a family to the samples of a pixel, a batch or an image.

Use `gamma` and `lognormal`; `fit` takes any row of `chdstat.fit.families.FAMILIES`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, overload

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._multiplicity import wilson
from chdstat._positive import Floats, Mask, PositivePart
from chdstat._reasons import Reason
from chdstat.fit.families import Family, Parameters, get_family
from chdstat.fit.results import Fit, fit_variables, label_fit
from chdstat.samples import Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["fit", "fit_part", "gamma", "lognormal"]


@overload
def fit(x: Samples, family: str | Family, *, progress: bool | None = None) -> xr.Dataset: ...
@overload
def fit(x: npt.ArrayLike, family: str | Family, *, null: npt.ArrayLike | None = None) -> Fit: ...
def fit(
    x: Samples | npt.ArrayLike,
    family: str | Family,
    *,
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Fit | xr.Dataset:
    """Fit a zero-inflated family by maximum likelihood.

    The share of nulls is estimated apart; the family is fitted to the samples that are good, not
    null and larger than 0.

    Parameters
    ----------
    x
        Radiance of a pixel, shape (sample,), of a batch, shape (..., sample), or all samples of an
        image. Of an array, exact zeros are nulls and NaN, infinite or negative numbers are bad.
        Of `Samples`, a sample is null where all channels are 0 and bad where any channel is; a 0 of
        one channel in another sample cannot enter a positive family: it is left out of the fit of
        that channel and counted as `n_zero`.
    family
        'gamma', 'lognormal', or a `Family`.
    null
        Which samples of an array are null, broadcastable to it, where the caller knows better.
    progress
        For `Samples`: show a progress bar; None shows it on a terminal.

    Returns
    -------
    Fit or xarray.Dataset
        `Fit` for an array. For `Samples`, its fields as variables over (y, x, channel): named after
        the family, as ``gamma_shape``, ``gamma_shape_se``, ``gamma_bic``, ``gamma_reason``, except
        what all families share, as ``null_share``.

    Raises
    ------
    InputError
        If there is no such family, or `x` or `null` has the wrong shape.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(1).gamma(2.0, 3.0, size=(5, 4096))
    >>> result = fit(x, "gamma")
    >>> result.parameters["shape"].round(1)
    array([2., 2., 2., 2., 2.])
    """
    family = get_family(family)
    if not isinstance(x, Samples):
        return fit_part(PositivePart.of(x, null=null), family)
    dataset = x.map(
        lambda block: fit_variables(fit_part(PositivePart.of_pixels(block), family)),
        description=f"fitting {family.name}",
        progress=progress,
    )
    return label_fit(dataset, family.name)


@overload
def gamma(x: Samples, *, progress: bool | None = None) -> xr.Dataset: ...
@overload
def gamma(x: npt.ArrayLike, *, null: npt.ArrayLike | None = None) -> Fit: ...
def gamma(
    x: Samples | npt.ArrayLike,
    *,
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Fit | xr.Dataset:
    """Fit a zero-inflated gamma distribution: what the paper sees most often.

    ``f(x) = x^(shape-1) exp(-x/scale) / (Gamma(shape) scale^shape)``: Newton's method on
    ``log(shape) - digamma(shape) = log(mean) - mean(log x)``.

    Parameters
    ----------
    x, null, progress
        As for `fit`.

    Returns
    -------
    Fit or xarray.Dataset
        As of `fit`, with parameters ``shape`` (1) and ``scale`` (radiance).

    References
    ----------
    Minka, "Estimating a Gamma distribution", technical report, 2002.

    Examples
    --------
    >>> result = gamma([0.0, 0.0, 1.0, 2.0, 3.0])
    >>> float(result.null_share), round(float(result.parameters["shape"]), 3)
    (0.4, 5.375)
    """
    if isinstance(x, Samples):
        return fit(x, "gamma", progress=progress)
    return fit(x, "gamma", null=null)


@overload
def lognormal(x: Samples, *, progress: bool | None = None) -> xr.Dataset: ...
@overload
def lognormal(x: npt.ArrayLike, *, null: npt.ArrayLike | None = None) -> Fit: ...
def lognormal(
    x: Samples | npt.ArrayLike,
    *,
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Fit | xr.Dataset:
    """Fit a zero-inflated log-normal distribution: Gaussian in the log domain.

    ``mu = mean(log x)``, ``sigma^2 = mean((log x - mu)^2)``, natural logarithms; the likelihood is
    that of linear radiance, so that it compares with other families.

    Parameters
    ----------
    x, null, progress
        As for `fit`.

    Returns
    -------
    Fit or xarray.Dataset
        As of `fit`, with parameters ``mu`` and ``sigma`` of the natural logarithm of radiance.

    Examples
    --------
    >>> result = lognormal([1.0, 10.0, 100.0])
    >>> round(float(np.exp(result.parameters["mu"])), 6)
    10.0
    """
    if isinstance(x, Samples):
        return fit(x, "lognormal", progress=progress)
    return fit(x, "lognormal", null=null)


def fit_part(part: PositivePart, family: Family) -> Fit:
    """Fit a family to samples that are already split; several families share one part."""
    estimate = family.estimate(part)
    reason = part.reason()
    reason[(reason == Reason.OK) & ~estimate.converged] = Reason.NOT_CONVERGED
    ok = reason == Reason.OK
    parameters = _keep(estimate.parameters, ok)
    log_likelihood = family.log_likelihood(part, parameters) + _bernoulli(part)
    count = len(parameters) + 1
    with np.errstate(invalid="ignore", divide="ignore"):
        null_share = np.asarray(part.n_null / part.n_good)
        bic = np.asarray(count * np.log(part.n_good) - 2 * log_likelihood)
    return Fit(
        family=family.name,
        parameters=parameters,
        standard_errors=_keep(estimate.standard_errors, ok),
        null_share=null_share,
        null_interval=wilson(part.n_null, part.n_good),
        n=part.n,
        n_null=part.n_null,
        n_zero=part.n_zero,
        n_bad=part.n_bad,
        log_likelihood=log_likelihood,
        aic=2 * count - 2 * log_likelihood,
        bic=bic,
        converged=estimate.converged & ok,
        reason=reason,
    )


def _keep(values: Parameters, ok: Mask) -> dict[str, Floats]:
    return {name: np.where(ok, value, np.nan) for name, value in values.items()}


def _bernoulli(part: PositivePart) -> Floats:
    zeros = part.n_null + part.n_zero
    total = np.maximum(part.n_good, 1)
    return np.asarray(special.xlogy(zeros, zeros / total) + special.xlogy(part.n, part.n / total))
