"""Families: the distributions that can be fitted to the positive part of a CHD, and their fits.

`FAMILIES` lists them; each is a class of `chdstat.fit.distributions`, which says how to estimate
the parameters from the positive part, gives the log-likelihood, and uses SciPy's distribution for
everything else. Families share the sums over the positive part.

`fit` fits any family by maximum likelihood to the samples of a pixel, a batch or an image, or to a
log histogram. `family_fit` makes functions that fit one family, such as `chdstat.fit.gamma`.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import Counts, Floats, Mapped, Mask, Seed, generator, label_variables
from chdstat._core.display import (
    Card,
    Width,
    each,
    in_unit,
    reasons,
    with_error,
    with_interval,
    written,
)
from chdstat._core.doors import draw
from chdstat._core.positive import Part
from chdstat._core.resampling import wilson
from chdstat._core.statistic import Result, Statistic, result, variable
from chdstat.errors import Reason, check_option
from chdstat.fit.distributions import Burr, Gamma, LogNormal, Weibull
from chdstat.fit.family import TIGHT, Estimate, Family, Parameters
from chdstat.summary.runner import OfSource, Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


FAMILIES: Mapping[str, Family] = {
    family.name: family for family in (Gamma(), LogNormal(), Weibull(), Burr())
}
"""Families by name."""


def get_family(family: str | Family) -> Family:
    """Return a family by its name; a `Family` is returned as it is.

    Raises
    ------
    InputError
        If there is no family of this name.
    """
    if isinstance(family, Family):
        return family
    given = type(family).__name__ if isinstance(family, Result) else family
    check_option("family", given, FAMILIES)
    return FAMILIES[family]


@result
class Fit(Result):
    """A zero-inflated family: a point mass at 0, and a density on the positive radiances.

    ``P(X = 0) = zero_share``; otherwise X follows the family. Every array has the batch's shape, ()
    for a single pixel. A row that could not be fitted is NaN, and `reason` says why.

    Attributes
    ----------
    family
        Name of the family.
    parameters, standard_errors
        Estimates and their asymptotic standard errors, by name.
    log_likelihood
        Log-likelihood of all good samples: of the positive ones in linear radiance, plus the
        Bernoulli part of zeros.
    aic, bic
        Information criteria; the zero share counts as a parameter of every family.
    null_share, null_interval
        Share of nulls among the good samples, shape (...), and its interval, shape (..., 2).
    n, n_null, n_zero, n_negative, n_bad
        Numbers of samples: fitted; null; zero in one channel of a sample that is not null;
        negative, which the model leaves out; bad.
    converged
        Whether the estimate met its tolerance.
    reason
        `Reason` codes.
    error_reason
        `Reason` codes of why standard errors are NaN: as `reason`; `TOO_FEW` if there are fewer
        samples than `Family.errors_from`, so that errors would not hold; or `NOT_REGULAR`.
    """

    name_of: ClassVar[str] = "{}"
    """Format of the name, from that of the family."""

    family: str
    parameters: Parameters
    standard_errors: Parameters
    log_likelihood: Floats = variable("log-likelihood of the zero-inflated model")
    aic: Floats = variable("Akaike information criterion")
    bic: Floats = variable("Bayesian information criterion")
    null_share: Floats = variable("share of null samples among the good ones", name="null_share")
    null_interval: Floats = variable(
        "Wilson interval of the share of null samples", "bound", name="null_interval"
    )
    n: Counts = variable("samples that the family was fitted to", name="n")
    n_null: Counts = variable("null samples: all channels are 0", name="n_null")
    n_zero: Counts = variable("zeros of this channel in samples that are not null", name="n_zero")
    n_negative: Counts = variable(
        "negative samples of this channel, left out: they have no logarithm", name="n_negative"
    )
    n_bad: Counts = variable("samples left out: a channel is NaN or infinite", name="n_bad")
    converged: Mask = variable("{} fit converged")
    reason: npt.NDArray[np.int8] = variable("why there is no {} fit")
    error_reason: npt.NDArray[np.int8] = variable("why {} has no standard errors")
    _drawn: ClassVar[str] = "density per decade of radiance"

    @property
    def name(self) -> str:
        """Name of the family, or of its mixture."""
        return self.name_of.format(self.family)

    @property
    def zero_share(self) -> Floats:
        """Mass at 0: the nulls, and the zeros of this channel in other samples; shape (...)."""
        zeros = self.n_null + self.n_zero
        return np.where(np.isnan(self.null_share), np.nan, zeros / np.maximum(zeros + self.n, 1))

    def pdf(self, x: npt.ArrayLike) -> Floats:
        """Return the density of the positive part alone.

        It integrates to 1, or in a mixture to 1 minus the share of the atoms. Multiply it by
        ``1 - zero_share`` for the density of the whole model away from 0.

        `x` are radiances of any shape; the result has the shape of the batch followed by that of
        `x`.
        """
        x = np.asarray(x, dtype=np.float64)
        with np.errstate(all="ignore"):
            return np.asarray(self._distribution(x.ndim).pdf(x))

    def cdf(self, x: npt.ArrayLike) -> Floats:
        """Return P(X <= x) of the zero-inflated model; shape of the batch, then of `x`."""
        x = np.asarray(x, dtype=np.float64)
        zero = expand(self.zero_share, x.ndim)
        with np.errstate(all="ignore"):
            positive = self._distribution(x.ndim).cdf(x)
        return np.where(x < 0, 0 * zero, zero + (1 - zero) * positive)

    def ppf(self, q: npt.ArrayLike) -> Floats:
        """Return quantiles of the zero-inflated model; shape of the batch, then of `q`."""
        q = np.asarray(q, dtype=np.float64)
        return self._quantile(q, q.ndim)

    def rvs(self, size: int, *, seed: Seed = None) -> Floats:
        """Draw samples of the zero-inflated model, shape (..., size)."""
        return self._quantile(generator(seed).random((*self.null_share.shape, size)), 1)

    def mean(self) -> Floats:
        """Return the expectation of the zero-inflated model, shape (...).

        It is infinite where the family has no expectation (a tail index of 1 or more), and where a
        very wide log-normal distribution has one that is too large for double precision.
        """
        with np.errstate(all="ignore"):
            return np.asarray((1 - self.zero_share) * self._mean())

    def plot(self, *, width: Width = "column", fig: Figure | None = None) -> Figure:
        """Draw the density, as `chdstat.viz.fit_curve`.

        Raises
        ------
        InputError
            If there are more than six rows.
        """
        return draw(self, width=width, fig=fig)

    def _card(self) -> Card:
        errors = {name: np.full_like(v, np.nan) for name, v in self.parameters.items()}
        errors |= self.standard_errors
        units = get_family(self.family).units
        facts = {
            name: in_unit(each(with_error, v, errors[name]), units[name])
            for name, v in self.parameters.items()
        }
        ends = np.moveaxis(self.null_interval, -1, 0)
        facts["null share"] = each(with_interval, self.null_share, *ends)
        facts |= {"n": written(self.n), "BIC": written(self.bic)}
        facts["not fitted"] = reasons(self.reason)
        return Card(f"{type(self).__name__} {self.name}", facts)

    def _mean(self) -> Floats:
        """Return the expectation of the positive part, shape (...)."""
        return get_family(self.family).mean(self.parameters)

    def _distribution(self, trailing: int) -> Any:
        """Return the distribution of the positive part, with `trailing` axes after the batch's."""
        expanded = {name: expand(value, trailing) for name, value in self.parameters.items()}
        return get_family(self.family).distribution(expanded)

    def _quantile(self, q: Floats, trailing: int) -> Floats:
        zero = expand(self.zero_share, trailing)
        # Every family has its quantile 0 at radiance 0, and so has the model up to its mass at 0.
        with np.errstate(all="ignore"):
            level = np.clip((q - zero) / (1 - zero), 0, 1)
            return np.asarray(self._distribution(trailing).ppf(level))


def counts_of(part: Part) -> dict[str, Any]:
    """Return the fields that all fits to the same samples share."""
    null_share = np.asarray(part.n_null / part.n_good)
    names = ("n", "n_null", "n_zero", "n_negative", "n_bad")
    counts: dict[str, Any] = {name: getattr(part, name) for name in names}
    return {
        "null_share": null_share,
        "null_interval": wilson(part.n_null, part.n_good),
        **counts,
    }


Fitted = TypeVar("Fitted", bound=Fit, covariant=True)


class ParametricFit(Statistic[Fitted]):
    """Fits with parameters; each parameter and its standard error is a variable."""

    binned: ClassVar = True
    prefix: ClassVar = "{}_"
    of_components: ClassVar[bool] = False
    """Whether the parameters belong to components of a mixture."""

    def variables(self, found: Fit) -> Mapped:
        """Return the fields of a fit, its parameters and their errors."""
        errors = {f"{name}_se": value for name, value in found.standard_errors.items()}
        dims = ("channel", "component") if self.of_components else ("channel",)
        prefix = self.prefix.format(self.subject)
        own = {f"{prefix}{n}": (dims, v) for n, v in {**found.parameters, **errors}.items()}
        return {**own, **super().variables(found)}

    def finish(self, dataset: xr.Dataset) -> xr.Dataset:
        """Set names and units of all variables and parameters."""
        labels, of = {}, self.subject
        prefix, units = self.prefix.format(of), get_family(vars(self)["family"]).units
        for name, unit in {**units, "weight": "1"}.items():
            named = f"{name} of the {of} components" if self.of_components else f"{of} {name}"
            labels[f"{prefix}{name}"] = named, unit
            labels[f"{prefix}{name}_se"] = f"standard error of the {named}", unit
        return label_variables(super().finish(dataset), labels)


@dataclass(frozen=True)
class FamilyFit(ParametricFit[Fit]):
    """Fits of a family by maximum likelihood."""

    result: ClassVar = Fit
    description: ClassVar = "fitting {}"

    family: Family

    @property
    def subject(self) -> str:
        """Name of the family."""
        return self.family.name

    def measure(self, part: Part) -> Fit:
        """Fit the family to each row."""
        family = self.family
        estimate, reason = estimate_part(part, family)
        parameters = estimate.parameters
        of_positive = estimate.log_likelihood
        if of_positive is None:
            of_positive = family.log_likelihood(part, parameters)
        log_likelihood = np.asarray(of_positive + zero_log_likelihood(part))
        count = len(parameters) + 1
        no_error = np.isnan(list(estimate.standard_errors.values())).any(axis=0)
        few = part.n < max(family.errors_from.values(), default=0)
        why = np.where(few, Reason.TOO_FEW, np.where(no_error, Reason.NOT_REGULAR, Reason.OK))
        # Nulls say nothing about the shape; they only enter the null share, estimated from all
        # samples.
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


def expand(value: npt.NDArray[Any], trailing: int) -> npt.NDArray[Any]:
    """Append axes of length 1 to the batch's, to broadcast against an argument."""
    return np.asarray(value).reshape((*np.shape(value), *(1,) * trailing))


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


@of_source
def fit(
    x: Source,
    family: str | Family,
    *,
    null: npt.ArrayLike | None = None,
    progress: bool = True,
) -> Fit | xr.Dataset:
    """Fit a zero-inflated family by maximum likelihood.

    The share of nulls is estimated separately. The family is fitted to the good samples that are
    not null and larger than 0.

    Parameters
    ----------
    x
        Radiance of a pixel, shape (sample,), or of a batch, shape (..., sample); or all samples of
        an image. In an array, exact zeros are null, and NaN and infinite numbers are bad. In
        `Samples`, a sample is null where all channels are 0 and bad where any channel is bad. If
        only one channel is 0, a positive family cannot describe it: the fit of that channel leaves
        it out and counts it as `n_zero`.

        `x` may also be a `Histogram` of log scale, or the dataset that `chdstat.histogram` makes of
        an image; the notes say what is lost.
    family
        A `Family`, or the name of one of `FAMILIES`, such as 'gamma'.
    null
        Mask of the null samples of an array, broadcastable to it; by default, its exact zeros.
    progress
        For `Samples`: show progress, as a bar in a terminal or notebook, elsewhere as a line every
        ten seconds.

    Returns
    -------
    Fit or xarray.Dataset
        `Fit` for an array or a `Histogram`. For an image, the same fields as variables over (y, x,
        channel). Their names begin with the family, such as ``gamma_shape``, ``gamma_shape_se``,
        ``gamma_bic`` and ``gamma_reason``, except for fields that all families share, such as
        ``null_share``.

    Raises
    ------
    InputError
        If there is no such family, or `x` or `null` has the wrong shape, or `null` comes without an
        array.

    Notes
    -----
    A fit from a histogram costs the same for any spp. Sheppard's corrections of the log moments
    account for the width of the bins: parameters are those of the samples as long as the log
    radiance spreads over more than one bin. A histogram loses four things:

    - A distribution within one bin (0.1 decades by default) is constant.
    - A zero of one channel and radiance below the support (1e-5 by default) are the same: both
      count as `n_zero`.
    - Radiance above the support counts as the last bin.
    - The likelihood is that at the centres of the bins.

    If most samples lie outside the support, there is no fit (`OUTSIDE`).

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(1).gamma(2.0, 3.0, size=(5, 4096))
    >>> result = fit(x, "gamma")
    >>> result.parameters["shape"].round(1)
    array([2., 2., 2., 2., 2.])
    """
    return run(FamilyFit(get_family(family)), x, null=null, progress=progress)


@cache
def family_fit(name: str) -> OfSource[..., Fit]:
    """Return `fit` for the family of this name, with the documentation of its module."""
    family = get_family(name)

    def function(
        x: Source, *, null: npt.ArrayLike | None = None, progress: bool = True
    ) -> Fit | xr.Dataset:
        return fit(x, family, null=null, progress=progress)

    names = ", ".join(f"``{name}`` ({unit})" for name, unit in family.units.items())
    text = (inspect.getdoc(family) or "").partition(": ")[2]
    text = text.replace("References\n", _SECTIONS.format(parameters=names), 1)
    function.__doc__ = f"Fit a zero-inflated {family.label} distribution: {text}"
    function.__name__ = function.__qualname__ = name
    function.__module__ = "chdstat.fit"
    return of_source(function)


def estimate_part(
    part: Part, family: Family, near: Parameters | None = None, tolerance: float = TIGHT
) -> tuple[Estimate, npt.NDArray[np.int8]]:
    """Return parameters and standard errors, NaN where there are none, and `Reason` codes.

    If `near` is given, the search begins there and leaves out rows where `near` is NaN. It ends
    when Newton steps are below `tolerance`.
    """
    estimate = family.estimate(part, near, tolerance)
    reason = part.reason(family.minimum)
    failed = (reason == Reason.OK) & ~estimate.converged
    limit = np.broadcast_to(estimate.limit, reason.shape)
    reason[failed] = np.where(limit == Reason.OK, Reason.NOT_CONVERGED, limit)[failed]
    ok, value = np.asarray(reason == Reason.OK), estimate.log_likelihood
    kept = Estimate(
        parameters={n: np.where(ok, value, np.nan) for n, value in estimate.parameters.items()},
        standard_errors={
            name: np.where(ok & (part.n >= family.errors_from.get(name, 0)), value, np.nan)
            for name, value in estimate.standard_errors.items()
        },
        converged=ok,
        log_likelihood=None if value is None else np.where(ok, value, np.nan),
    )
    return kept, reason


def zero_log_likelihood(part: Part) -> Floats:
    """Return the log-likelihood of which good samples are 0, shape (...)."""
    zeros = part.n_null + part.n_zero
    total = np.maximum(part.n_good, 1)
    return np.asarray(special.xlogy(zeros, zeros / total) + special.xlogy(part.n, part.n / total))
