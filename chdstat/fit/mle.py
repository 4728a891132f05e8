"""Maximum likelihood: fit a family to the samples of a pixel, a batch or an image.

`fit` takes any row of `chdstat.fit.families.FAMILIES`; `family_fit` makes functions that fit one of
them, as `chdstat.fit.gamma` does. All take samples, or a log histogram of them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Protocol, cast, overload

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.positive import Floats
from chdstat.errors import Reason
from chdstat.fit.families import Estimate, Family, Parameters, get_family
from chdstat.fit.results import Fit, counts_of, fit_variables, label_fit
from chdstat.samples import Samples
from chdstat.summary.dispatch import Part, Source, run
from chdstat.summary.histograms import Histogram

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["FamilyFit", "estimate_part", "family_fit", "fit", "fit_part", "zero_log_likelihood"]

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

    The share of nulls is estimated separately; the family is fitted to the samples that are good,
    not null and larger than 0.

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
        A `Family`, or the name of one of `FAMILIES`, such as 'gamma'.
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


class FamilyFit(Protocol):
    """Type of the function that fits one family: the overloads of `fit` without `family`."""

    @overload
    def __call__(self, x: Samples | xr.Dataset, *, progress: bool | None = None) -> xr.Dataset: ...
    @overload
    def __call__(
        self, x: Histogram | npt.ArrayLike, *, null: npt.ArrayLike | None = None
    ) -> Fit: ...


@cache
def family_fit(name: str) -> FamilyFit:
    """Return `fit` for the family of this name, with the documentation of its module."""
    family = get_family(name)

    def function(
        x: Source, *, null: npt.ArrayLike | None = None, progress: bool | None = None
    ) -> Fit | xr.Dataset:
        # Which of the two overloads holds is known only when it runs.
        call = cast("Callable[..., Fit | xr.Dataset]", fit)
        return call(x, family, null=null, progress=progress)

    names = ", ".join(f"``{name}`` ({unit})" for name, unit in family.units.items())
    text = (family.documentation or "").partition(": ")[2]
    text = text.replace("References\n", _SECTIONS.format(parameters=names), 1)
    function.__doc__ = f"Fit a zero-inflated {family.label} distribution: {text}"
    function.__name__ = function.__qualname__ = name
    function.__module__ = "chdstat.fit"
    return cast("FamilyFit", function)


def fit_part(part: Part, family: Family) -> Fit:
    """Fit a family to samples that are already split; several families share one part."""
    estimate, reason = estimate_part(part, family)
    parameters = estimate.parameters
    log_likelihood = np.asarray(family.log_likelihood(part, parameters) + zero_log_likelihood(part))
    count = len(parameters) + 1
    no_error = np.isnan(list(estimate.standard_errors.values())).any(axis=0)
    few = part.n < max(family.errors_from.values(), default=0)
    why = np.where(few, Reason.TOO_FEW, np.where(no_error, Reason.NOT_REGULAR, Reason.OK))
    with np.errstate(invalid="ignore", divide="ignore"):
        # Nulls say nothing about the shape: only their own share is estimated from all samples.
        of_shape = len(parameters) * np.log(part.n)
        bic = np.asarray(of_shape + np.log(part.n_good) - 2 * log_likelihood)
    return Fit(
        family=family.name,
        parameters=parameters,
        standard_errors=estimate.standard_errors,
        **counts_of(part),
        log_likelihood=log_likelihood,
        aic=np.asarray(2 * count - 2 * log_likelihood),
        bic=bic,
        converged=estimate.converged,
        reason=reason,
        error_reason=np.where(reason == Reason.OK, why, reason).astype(np.int8),
    )


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
        parameters={n: np.where(ok, value, np.nan) for n, value in estimate.parameters.items()},
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
