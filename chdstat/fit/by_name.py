"""By name: one function per family, for whoever knows which one to fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast, overload

import numpy.typing as npt

from chdstat._routes import Source
from chdstat.fit.mle import fit
from chdstat.fit.results import Fit
from chdstat.histograms import Histogram
from chdstat.samples import Samples

if TYPE_CHECKING:
    from collections.abc import Callable

    import xarray as xr

__all__ = ["burr", "gamma", "lognormal", "pareto", "weibull"]


@overload
def gamma(x: Samples | xr.Dataset, *, progress: bool | None = None) -> xr.Dataset: ...
@overload
def gamma(x: Histogram | npt.ArrayLike, *, null: npt.ArrayLike | None = None) -> Fit: ...
def gamma(
    x: Source, *, null: npt.ArrayLike | None = None, progress: bool | None = None
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
    return _fit(x, "gamma", null, progress)


@overload
def lognormal(x: Samples | xr.Dataset, *, progress: bool | None = None) -> xr.Dataset: ...
@overload
def lognormal(x: Histogram | npt.ArrayLike, *, null: npt.ArrayLike | None = None) -> Fit: ...
def lognormal(
    x: Source, *, null: npt.ArrayLike | None = None, progress: bool | None = None
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

    References
    ----------
    Johnson, Kotz and Balakrishnan, "Continuous univariate distributions", vol. 1, 1994, chap. 14.

    Examples
    --------
    >>> import numpy as np
    >>> result = lognormal([1.0, 10.0, 100.0])
    >>> round(float(np.exp(result.parameters["mu"])), 6)
    10.0
    """
    return _fit(x, "lognormal", null, progress)


@overload
def weibull(x: Samples | xr.Dataset, *, progress: bool | None = None) -> xr.Dataset: ...
@overload
def weibull(x: Histogram | npt.ArrayLike, *, null: npt.ArrayLike | None = None) -> Fit: ...
def weibull(
    x: Source, *, null: npt.ArrayLike | None = None, progress: bool | None = None
) -> Fit | xr.Dataset:
    """Fit a zero-inflated Weibull distribution: an exponential, stretched or squeezed.

    ``f(x) = (k/s) (x/s)^(k-1) exp(-(x/s)^k)`` with k the shape and s the scale: Newton's method on
    ``mean(x^k log x) / mean(x^k) - 1/k = mean(log x)``, ``s = mean(x^k)^(1/k)``.

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
    Johnson, Kotz and Balakrishnan, "Continuous univariate distributions", vol. 1, 1994, chap. 21.

    Examples
    --------
    >>> import numpy as np
    >>> x = 3 * np.random.default_rng(1).weibull(0.7, size=4096)
    >>> result = weibull(x)
    >>> {name: round(float(value), 1) for name, value in result.parameters.items()}
    {'shape': 0.7, 'scale': 3.0}
    """
    return _fit(x, "weibull", null, progress)


@overload
def burr(x: Samples | xr.Dataset, *, progress: bool | None = None) -> xr.Dataset: ...
@overload
def burr(x: Histogram | npt.ArrayLike, *, null: npt.ArrayLike | None = None) -> Fit: ...
def burr(
    x: Source, *, null: npt.ArrayLike | None = None, progress: bool | None = None
) -> Fit | xr.Dataset:
    """Fit a zero-inflated Burr XII distribution: a body of any width, a power tail.

    ``f(x) = (c d / s) (x/s)^(c-1) (1 + (x/s)^c)^(-d-1)``, known to economists as Singh-Maddala; its
    tail index is ``1 / (c d)``. As d grows without bound it becomes a Weibull distribution. Where
    the samples are likeliest there, or at the other end, there is no maximum: the row is NaN with
    the reason `AT_LIMIT`, and the Weibull fit is the answer.

    Parameters
    ----------
    x, null, progress
        As for `fit`.

    Returns
    -------
    Fit or xarray.Dataset
        As of `fit`, with parameters ``c``, ``d`` (1) and ``scale`` (radiance), whose standard
        errors are those of the observed information.

    References
    ----------
    Burr, "Cumulative frequency functions", 1942, doi:10.1214/aoms/1177731607. Singh and Maddala, "A
    function for size distribution of incomes", 1976, doi:10.2307/1911538. Shao, "Notes on maximum
    likelihood estimation for the three-parameter Burr XII distribution", 2004,
    doi:10.1016/S0167-9473(02)00367-5.

    Examples
    --------
    >>> from scipy import stats
    >>> x = stats.burr12(2.0, 0.5, scale=3.0).rvs(4096, random_state=1)
    >>> result = burr(x)
    >>> round(1 / float(result.parameters["c"] * result.parameters["d"]), 1)
    1.0
    """
    return _fit(x, "burr", null, progress)


@overload
def pareto(x: Samples | xr.Dataset, *, progress: bool | None = None) -> xr.Dataset: ...
@overload
def pareto(x: Histogram | npt.ArrayLike, *, null: npt.ArrayLike | None = None) -> Fit: ...
def pareto(
    x: Source, *, null: npt.ArrayLike | None = None, progress: bool | None = None
) -> Fit | xr.Dataset:
    """Fit a zero-inflated generalised Pareto distribution that begins at 0.

    ``P(X > x) = (1 + xi x / scale)^(-1/xi)``: excesses over a threshold, or a CHD whose density
    falls from the start. From xi = -1/2 down the standard errors are NaN, since the likelihood is
    not regular there; below -1 it has no maximum, and the reason is `AT_LIMIT`.

    Parameters
    ----------
    x, null, progress
        As for `fit`.

    Returns
    -------
    Fit or xarray.Dataset
        As of `fit`, with parameters ``xi`` (1), the tail index, and ``scale`` (radiance).

    References
    ----------
    Grimshaw, "Computing maximum likelihood estimates for the generalized Pareto distribution",
    1993, doi:10.1080/00401706.1993.10485040. Smith, "Maximum likelihood estimation in a class of
    nonregular cases", 1985, doi:10.1093/biomet/72.1.67.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(1).pareto(2.0, size=4096)
    >>> round(float(pareto(x).parameters["xi"]), 1)
    0.5
    """
    return _fit(x, "pareto", null, progress)


def _fit(
    x: Source, family: str, null: npt.ArrayLike | None, progress: bool | None
) -> Fit | xr.Dataset:
    # Which of the two calls holds is known only when it runs.
    call = cast("Callable[..., Fit | xr.Dataset]", fit)
    return call(x, family, null=null, progress=progress)
