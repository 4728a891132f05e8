"""Results of a fit: one frozen type for every family, for one pixel or a whole batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator
from chdstat._positive import Counts, Floats, Mask
from chdstat._reasons import flag_attributes
from chdstat.fit.families import Parameters, get_family

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples import Mapped

__all__ = ["SHARED", "Fit", "expand", "fit_variables", "label_fit"]

SHARED = {
    "null_share": "share of null samples among the good ones",
    "null_interval": "Wilson interval of the share of null samples",
    "n": "samples that the family was fitted to",
    "n_null": "null samples: all channels are 0",
    "n_zero": "zeros of this channel in samples that are not null",
    "n_negative": "negative samples of this channel, left out: they have no logarithm",
    "n_bad": "samples left out: a channel is NaN or infinite",
}
"""Variables that all fits of the same samples share, with their long names."""
_OF_FAMILY = {
    "log_likelihood": "log-likelihood of the zero-inflated model",
    "aic": "Akaike information criterion",
    "bic": "Bayesian information criterion",
}


@dataclass(frozen=True)
class Fit:
    """A zero-inflated family: a point mass at 0, and a density on the positive radiances.

    ``P(X = 0) = zero_share``; otherwise X follows the family. Every array has the batch's shape,
    () for a single pixel; a row that could not be fitted holds NaN and says why in `reason`.

    Attributes
    ----------
    family
        Name of the family.
    parameters, standard_errors
        Estimates and their asymptotic standard errors, by name.
    null_share, null_interval
        Share of nulls among the good samples, shape (...), and its interval, shape (..., 2).
    n, n_null, n_zero, n_negative, n_bad
        Samples fitted; null ones; zeros of one channel in samples that are not null; negative ones,
        which the model leaves out; bad ones.
    log_likelihood
        Of all good samples: the positive ones in linear radiance, and the Bernoulli part of zeros.
    aic, bic
        Information criteria; the zero share counts as a parameter of every family alike.
    converged
        Whether the estimate met its tolerance.
    reason
        `Reason` codes.
    error_reason
        `Reason` codes of why one or more standard errors are NaN: as `reason`; `TOO_FEW` samples
        for them to hold, fewer than `Family.errors_from`; or `NOT_REGULAR`.
    """

    family: str
    parameters: Parameters
    standard_errors: Parameters
    null_share: Floats
    null_interval: Floats
    n: Counts
    n_null: Counts
    n_zero: Counts
    n_negative: Counts
    n_bad: Counts
    log_likelihood: Floats
    aic: Floats
    bic: Floats
    converged: Mask
    reason: npt.NDArray[np.int8]
    error_reason: npt.NDArray[np.int8]

    @property
    def zero_share(self) -> Floats:
        """Mass at 0: the nulls, and the zeros of this channel in other samples; shape (...)."""
        zeros = self.n_null + self.n_zero
        return np.where(np.isnan(self.null_share), np.nan, zeros / np.maximum(zeros + self.n, 1))

    def pdf(self, x: npt.ArrayLike) -> Floats:
        """Return the density of the positive part alone: it integrates to 1.

        Multiply by ``1 - zero_share`` for the density of the whole model away from 0.

        Parameters
        ----------
        x
            Radiances, of any shape.

        Returns
        -------
        ndarray
            Shape of the batch followed by that of `x`.
        """
        x = np.asarray(x, dtype=np.float64)
        with np.errstate(all="ignore"):
            return np.asarray(self._distribution(x.ndim).pdf(x))

    def cdf(self, x: npt.ArrayLike) -> Floats:
        """Return P(X <= x) of the zero-inflated model, shape of the batch, then that of `x`."""
        x = np.asarray(x, dtype=np.float64)
        zero = expand(self.zero_share, x.ndim)
        with np.errstate(all="ignore"):
            positive = self._distribution(x.ndim).cdf(x)
        return np.where(x < 0, 0 * zero, zero + (1 - zero) * positive)

    def ppf(self, q: npt.ArrayLike) -> Floats:
        """Return quantiles of the zero-inflated model, shape of the batch, then that of `q`."""
        q = np.asarray(q, dtype=np.float64)
        return self._quantile(q, q.ndim)

    def rvs(self, size: int, *, seed: int | np.random.Generator | None = None) -> Floats:
        """Draw samples of the zero-inflated model, shape (..., size)."""
        return self._quantile(generator(seed).random((*self.null_share.shape, size)), 1)

    def mean(self) -> Floats:
        """Return the expectation of the zero-inflated model, shape (...).

        It is infinite where the family has none (a tail index of 1 or more), and where that of a
        very wide log-normal is too large for double precision.
        """
        with np.errstate(all="ignore"):
            own = get_family(self.family).mean
            mean = self._distribution(0).mean() if own is None else own(self.parameters)
            return np.asarray((1 - self.zero_share) * mean)

    def _distribution(self, trailing: int) -> Any:
        expanded = {name: expand(value, trailing) for name, value in self.parameters.items()}
        return get_family(self.family).distribution(expanded)

    def _quantile(self, q: Floats, trailing: int) -> Floats:
        zero = expand(self.zero_share, trailing)
        # Every family puts its quantile 0 at radiance 0: up to the mass at 0, the answer is 0.
        with np.errstate(all="ignore"):
            level = np.clip((q - zero) / (1 - zero), 0, 1)
            return np.asarray(self._distribution(trailing).ppf(level))


def fit_variables(fit: Fit) -> Mapped:
    """Return a fit over (y, x, channel) as variables for `Samples.map`."""
    estimates = {f"{fit.family}_{name}": value for name, value in fit.parameters.items()}
    errors = {f"{fit.family}_{name}_se": value for name, value in fit.standard_errors.items()}
    own = {f"{fit.family}_{name}": getattr(fit, name) for name in _OF_FAMILY}
    states = {
        f"{fit.family}_converged": fit.converged,
        f"{fit.family}_reason": fit.reason,
        f"{fit.family}_error_reason": fit.error_reason,
    }
    shared = {name: getattr(fit, name) for name in SHARED}
    variables = estimates | errors | own | states | shared
    return {
        name: (("channel", "bound") if name == "null_interval" else ("channel",), value)
        for name, value in variables.items()
    }


def label_fit(dataset: xr.Dataset, family: str) -> xr.Dataset:
    """Set long names, units and flag meanings of the variables of a family."""
    for name, units in get_family(family).units.items():
        for suffix, what in (("", ""), ("_se", "standard error of the ")):
            dataset[f"{family}_{name}{suffix}"].attrs.update(
                long_name=f"{what}{family} {name}", units=units
            )
    names: Mapping[str, str] = {f"{family}_{name}": text for name, text in _OF_FAMILY.items()}
    for name, text in {**names, **SHARED}.items():
        dataset[name].attrs.update(long_name=text, units="1")
    dataset[f"{family}_converged"].attrs.update(long_name=f"{family} fit converged", units="1")
    dataset[f"{family}_reason"].attrs.update(
        long_name=f"why there is no {family} fit", units="1", **flag_attributes()
    )
    dataset[f"{family}_error_reason"].attrs.update(
        long_name=f"why {family} has no standard errors", units="1", **flag_attributes()
    )
    return dataset.assign_coords(bound=np.array(["low", "high"], dtype=object))


def expand(value: npt.NDArray[Any], trailing: int) -> npt.NDArray[Any]:
    """Append axes of length 1 to the batch's, to broadcast against an argument."""
    return np.asarray(value).reshape((*np.shape(value), *(1,) * trailing))
