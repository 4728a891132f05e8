"""Maximum likelihood: fit a family to the samples of a pixel, a batch or an image.

`fit` takes any row of `chdstat.fit.families.FAMILIES`; `gamma`, `lognormal`, `weibull`, `burr` and
`pareto` name one each. All take samples, or a log histogram of them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, cast, overload

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.positive import Counts, Floats, Mask
from chdstat._core.reasons import Reason
from chdstat._core.resampling import wilson
from chdstat.fit.families import Estimate, Family, Parameters, get_family
from chdstat.fit.results import Fit, fit_variables, label_fit
from chdstat.samples import Samples
from chdstat.summary.dispatch import Part, Source, run
from chdstat.summary.histograms import Histogram

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "burr",
    "estimate_part",
    "fit",
    "fit_part",
    "gamma",
    "lognormal",
    "pareto",
    "weibull",
    "zero_log_likelihood",
]

_SECTIONS = """Parameters
----------
x, null, progress
    As for `fit`.

Returns
-------
Fit or xarray.Dataset
    As of `fit`, with the parameters {parameters}.

Raises
------
InputError
    As `fit` does.

References
"""


@overload
def fit(
    x: Samples | xr.Dataset, family: str | Family, *, progress: bool | None = None
) -> xr.Dataset: ...
@overload
def fit(
    x: Histogram | npt.ArrayLike, family: str | Family, *, null: npt.ArrayLike | None = None
) -> Fit: ...
def fit(
    x: Source,
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
        image. Of an array, exact zeros are nulls and NaN or infinite numbers are bad.
        Of `Samples`, a sample is null where all channels are 0 and bad where any channel is; a 0 of
        one channel in another sample cannot enter a positive family: it is left out of the fit of
        that channel and counted as `n_zero`. Or a `Histogram` of log scale, or the dataset that
        `chdstat.histogram` makes of an image: see below what is lost.
    family
        'gamma', 'lognormal', 'weibull', 'burr', 'pareto', or a `Family`.
    null
        Which samples of an array are null, broadcastable to it, where the caller knows better.
    progress
        For `Samples`: show a progress bar; None shows it on a terminal.

    Returns
    -------
    Fit or xarray.Dataset
        `Fit` for an array or a `Histogram`. For an image, its fields as variables over (y, x,
        channel): named after the family, as ``gamma_shape``, ``gamma_shape_se``, ``gamma_bic``,
        ``gamma_reason``, except what all families share, as ``null_share``.

    Raises
    ------
    InputError
        If there is no such family, or `x` or `null` has the wrong shape or goes without the other.

    Notes
    -----
    A fit from a histogram costs the same whatever the spp. It takes the bins for what they are by
    Sheppard's corrections of the log moments; parameters are those of the samples as long as the
    log radiance spreads over more than a bin. What is lost: a distribution within one bin (0.1
    decades by default) is constant; a zero of one channel cannot be told from radiance below the
    support (1e-5 by default), both are `n_zero`; radiance above the support counts as the last
    bin; and the likelihood is that at the centres of the bins.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(1).gamma(2.0, 3.0, size=(5, 4096))
    >>> result = fit(x, "gamma")
    >>> result.parameters["shape"].round(1)
    array([2., 2., 2., 2., 2.])
    """
    chosen = get_family(family)
    result = run(
        x,
        lambda part: fit_part(part, chosen),
        fit_variables,
        null=null,
        description=f"fitting {chosen.name}",
        progress=progress,
    )
    return result if isinstance(result, Fit) else label_fit(result, chosen.name)


class _FamilyFit(Protocol):
    """Type of the function that fits one family: the overloads of `fit` without `family`."""

    @overload
    def __call__(self, x: Samples | xr.Dataset, *, progress: bool | None = None) -> xr.Dataset: ...
    @overload
    def __call__(
        self, x: Histogram | npt.ArrayLike, *, null: npt.ArrayLike | None = None
    ) -> Fit: ...


def _of_family(described: Callable[[], None]) -> _FamilyFit:
    """Return `fit` for the family that has the name of a function, documented by it."""
    family = get_family(described.__name__)

    def function(
        x: Source, *, null: npt.ArrayLike | None = None, progress: bool | None = None
    ) -> Fit | xr.Dataset:
        # Which of the two overloads holds is known only when it runs.
        call = cast("Callable[..., Fit | xr.Dataset]", fit)
        return call(x, family, null=null, progress=progress)

    names = ", ".join(f"``{name}`` ({unit})" for name, unit in family.units.items())
    document = inspect.cleandoc(described.__doc__ or "")
    function.__doc__ = document.replace("References\n", _SECTIONS.format(parameters=names), 1)
    function.__name__ = function.__qualname__ = family.name
    return cast("_FamilyFit", function)


@_of_family
def gamma() -> None:
    """Fit a zero-inflated gamma distribution: what the paper sees most often.

    ``f(x) = x^(shape-1) exp(-x/scale) / (Gamma(shape) scale^shape)``: Newton's method on
    ``log(shape) - digamma(shape) = log(mean) - mean(log x)``.

    References
    ----------
    Minka, "Estimating a Gamma distribution", technical report, 2002.

    Examples
    --------
    >>> result = gamma([0.0, 0.0, 1.0, 2.0, 3.0])
    >>> float(result.null_share), round(float(result.parameters["shape"]), 3)
    (0.4, 5.375)
    """


@_of_family
def lognormal() -> None:
    """Fit a zero-inflated log-normal distribution: Gaussian in the log domain.

    ``mu = mean(log x)``, ``sigma^2 = mean((log x - mu)^2)``, natural logarithms; the likelihood is
    that of linear radiance, so that it compares with other families.

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


@_of_family
def weibull() -> None:
    """Fit a zero-inflated Weibull distribution: an exponential, stretched or squeezed.

    ``f(x) = (k/s) (x/s)^(k-1) exp(-(x/s)^k)`` with k the shape and s the scale: Newton's method on
    ``mean(x^k log x) / mean(x^k) - 1/k = mean(log x)``, ``s = mean(x^k)^(1/k)``.

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


@_of_family
def burr() -> None:
    """Fit a zero-inflated Burr XII distribution: a body of any width, a power tail.

    ``f(x) = (c d / s) (x/s)^(c-1) (1 + (x/s)^c)^(-d-1)``, known to economists as Singh-Maddala; its
    tail index is ``1 / (c d)``. It has two limits, where rows are NaN with a reason of their own.
    As d grows without bound, it becomes a Weibull distribution: where the likelihood rises towards
    that, the reason is `AT_LIMIT`, and the Weibull fit is the answer. As c grows without bound and
    c d does not, it becomes a power law that begins at the smallest sample: where that is likelier
    than any, as it is above a floor of ambient light, the reason is `AT_PARETO_LIMIT`, and no
    family of this library is the answer; `chdstat.fit.tail_index` has the index of the tail.
    Standard errors are those of the observed information.

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


@_of_family
def pareto() -> None:
    """Fit a zero-inflated generalised Pareto distribution that begins at 0.

    ``P(X > x) = (1 + xi x / scale)^(-1/xi)``: excesses over a threshold, or a CHD whose density
    falls from the start. From xi = -1/2 down the standard errors are NaN, since the likelihood is
    not regular there; below -1 it has no maximum, and the reason is `AT_LIMIT`. That of xi is
    ``max(1 + xi, 0.9) / sqrt(n)``, and there is none below 128 samples: it would be too small.

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


def fit_part(part: Part, family: Family) -> Fit:
    """Fit a family to samples that are already split; several families share one part."""
    estimate, reason = estimate_part(part, family)
    parameters = estimate.parameters
    log_likelihood = np.asarray(family.log_likelihood(part, parameters) + zero_log_likelihood(part))
    count = len(parameters) + 1
    with np.errstate(invalid="ignore", divide="ignore"):
        null_share = np.asarray(part.n_null / part.n_good)
        # Nulls say nothing about the shape: only their own share is estimated from all samples.
        of_shape = len(parameters) * np.log(part.n)
        bic = np.asarray(of_shape + np.log(part.n_good) - 2 * log_likelihood)
    return Fit(
        family=family.name,
        parameters=parameters,
        standard_errors=estimate.standard_errors,
        null_share=null_share,
        null_interval=wilson(part.n_null, part.n_good),
        n=part.n,
        n_null=part.n_null,
        n_zero=part.n_zero,
        n_negative=part.n_negative,
        n_bad=part.n_bad,
        log_likelihood=log_likelihood,
        aic=np.asarray(2 * count - 2 * log_likelihood),
        bic=bic,
        converged=estimate.converged,
        reason=reason,
        error_reason=_why_no_errors(part.n, reason, family, estimate.standard_errors),
    )


def _why_no_errors(
    n: Counts, reason: npt.NDArray[np.int8], family: Family, errors: Parameters
) -> npt.NDArray[np.int8]:
    """Return the code of why one or more standard errors are NaN, shape (...)."""
    none = np.isnan(list(errors.values())).any(axis=0)
    few = n < max(family.errors_from.values(), default=0)
    why = np.where(few, Reason.TOO_FEW, np.where(none, Reason.NOT_REGULAR, Reason.OK))
    return np.asarray(np.where(reason == Reason.OK, why, reason), dtype=np.int8)


def estimate_part(
    part: Part, family: Family, near: Parameters | None = None
) -> tuple[Estimate, npt.NDArray[np.int8]]:
    """Return parameters and standard errors, NaN where there are none, and `Reason` codes.

    The search begins at `near`, where that is given and known: it is faster, and the same in the
    end.
    """
    estimate = family.estimate(part, near)
    reason = part.reason(family.minimum)
    failed = (reason == Reason.OK) & ~estimate.converged
    reason[failed] = Reason.NOT_CONVERGED
    if estimate.limit is not None:
        at_limit = failed & (estimate.limit != Reason.OK)
        reason[at_limit] = estimate.limit[at_limit]
    ok = np.asarray(reason == Reason.OK)
    kept = Estimate(
        parameters=_keep(estimate.parameters, ok),
        standard_errors={
            name: np.where(ok & (part.n >= family.errors_from.get(name, 0)), value, np.nan)
            for name, value in estimate.standard_errors.items()
        },
        converged=ok,
    )
    return kept, reason


def zero_log_likelihood(part: Part) -> Floats:
    """Return the log-likelihood of which good samples are 0, shape (...)."""
    zeros = part.n_null + part.n_zero
    total = np.maximum(part.n_good, 1)
    return np.asarray(special.xlogy(zeros, zeros / total) + special.xlogy(part.n, part.n / total))


def _keep(values: Parameters, ok: Mask) -> dict[str, Floats]:
    return {name: np.where(ok, value, np.nan) for name, value in values.items()}
