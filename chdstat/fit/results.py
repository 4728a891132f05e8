"""Results of fits of families and of mixtures: frozen types for one pixel or a whole batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator
from chdstat._core.positive import Counts, Floats, Mask
from chdstat._core.reasons import flag_attributes
from chdstat.fit.components import MixtureFamily
from chdstat.fit.families import Parameters, get_family

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples import Mapped

__all__ = [
    "SHARED",
    "Fit",
    "Mixture",
    "MixtureCriterion",
    "expand",
    "finish_mixture",
    "fit_variables",
    "label_fit",
    "mixture_variables",
]

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


MixtureCriterion = Literal["bic", "held_out"]

_HALVINGS = 70
"""Of the logarithmic interval that a quantile lies in: more than its 64 bits."""
_DARKEST = 1e-320
_OWN = {
    "k": "number of components",
    "weights": "weights of the components",
    "log_likelihood": "log-likelihood of the zero-inflated mixture",
    "aic": "Akaike information criterion",
    "bic": "Bayesian information criterion",
    "bics": "Bayesian information criterion for each number of components",
    "held_out": "held-out log-likelihood per sample for each number of components",
    "converged": "the chosen fit converged",
}
_BY_COMPONENT = ("weights", "bics", "held_out")


@dataclass(frozen=True)
class Mixture:
    """A zero-inflated mixture: a point mass at 0, and K or fewer components on the rest.

    ``P(X = 0) = zero_share``; otherwise X follows ``sum_j weights_j f(x; parameters_j)``. Arrays
    have the batch's shape, () for a single pixel, and (..., K) for components: those of a row are
    sorted by their median, and NaN beyond its `k`. A row that could not be fitted holds NaN, has
    `k` 0 and says why in `reason`.

    Attributes
    ----------
    family
        Of the components: 'lognormal' or 'gamma'.
    criterion
        What the number of components was chosen by: 'bic' or 'held_out'.
    k
        Number of components, shape (...).
    weights
        Shape (..., K); they add up to 1.
    parameters
        By name, shape (..., K): ``mu`` and ``sigma`` of the natural logarithm of radiance, or
        ``shape`` (1) and ``scale`` (radiance).
    standard_errors
        By the names of the parameters, and ``weight``, shape (..., K); NaN where the information
        matrix is singular, as it is for components at the least spread.
    log_likelihood
        Of all good samples: the positive ones in linear radiance, and the Bernoulli part of zeros.
    aic, bic
        Of the chosen mixture. It has 3 k parameters: those of k components, k - 1 weights, and the
        zero share, as `Fit` counts them.
    bics
        For 1 to K components, shape (..., K); NaN where there are too few samples for so many.
    held_out
        Log-likelihood per positive sample in linear radiance, each half of the samples under the
        fit of the other half, shape (..., K); NaN unless it is the criterion.
    null_share, null_interval
        Share of nulls among the good samples, shape (...), and its interval, shape (..., 2).
    n, n_null, n_zero, n_negative, n_bad
        Samples fitted; null ones; zeros of one channel in samples that are not null; negative ones,
        which the model leaves out; bad ones.
    converged
        Whether the last cycle of the chosen fit raised its log-likelihood by less than the
        tolerance; where not, it is the best that was reached.
    reason
        `Reason` codes.
    """

    family: MixtureFamily
    criterion: MixtureCriterion
    k: npt.NDArray[np.int8]
    weights: Floats
    parameters: Parameters
    standard_errors: Parameters
    log_likelihood: Floats
    aic: Floats
    bic: Floats
    bics: Floats
    held_out: Floats
    null_share: Floats
    null_interval: Floats
    n: Counts
    n_null: Counts
    n_zero: Counts
    n_negative: Counts
    n_bad: Counts
    converged: Mask
    reason: npt.NDArray[np.int8]

    @property
    def zero_share(self) -> Floats:
        """Mass at 0: the nulls, and the zeros of this channel in other samples; shape (...)."""
        zeros = self.n_null + self.n_zero
        return np.where(np.isnan(self.null_share), np.nan, zeros / np.maximum(zeros + self.n, 1))

    def pdf(self, x: npt.ArrayLike) -> Floats:
        """Return the density of the positive part alone: it integrates to 1.

        Multiply by ``1 - zero_share`` for the density of the whole model away from 0. The result
        has the shape of the batch followed by that of `x`, which are radiances of any shape.
        """
        x = np.asarray(x, dtype=np.float64)
        return self._mix(self._distribution(x.ndim).pdf(x), x.ndim)

    def cdf(self, x: npt.ArrayLike) -> Floats:
        """Return P(X <= x) of the zero-inflated model, shape of the batch, then that of `x`."""
        x = np.asarray(x, dtype=np.float64)
        zero = expand(self.zero_share, x.ndim)
        return np.where(x < 0, 0 * zero, zero + (1 - zero) * self._positive_cdf(x, x.ndim))

    def ppf(self, q: npt.ArrayLike) -> Floats:
        """Return quantiles of the zero-inflated model, shape of the batch, then that of `q`.

        A quantile of a mixture lies between those of its components: it is found by bisection.
        """
        q = np.asarray(q, dtype=np.float64)
        zero = expand(self.zero_share, q.ndim)
        with np.errstate(invalid="ignore", divide="ignore"):
            level = np.clip((q - zero) / (1 - zero), 0, 1)
        # The ends of the range are known; half stands in for them.
        inside = np.where((level > 0) & (level < 1), level, 0.5)
        low, high = self._bracket(inside, q.ndim)
        for _ in range(_HALVINGS):
            middle = np.sqrt(low) * np.sqrt(high)
            below = self._positive_cdf(middle, q.ndim, of_batch=True) < inside
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        ends = np.where(level == 0, 0.0, np.where(level == 1, np.inf, high))
        return np.where(np.isnan(level + expand(self.weights[..., 0], q.ndim)), np.nan, ends)

    def rvs(self, size: int, *, seed: int | np.random.Generator | None = None) -> Floats:
        """Draw samples of the zero-inflated model, shape (..., size)."""
        rng = generator(seed)
        shape = (*self.null_share.shape, size)
        below = np.cumsum(np.nan_to_num(self.weights), axis=-1)[..., np.newaxis, :-1]
        which = (rng.random(shape)[..., np.newaxis] > below).sum(axis=-1)
        which = np.minimum(which, np.maximum(self.k, 1)[..., np.newaxis] - 1)
        chosen = {n: np.take_along_axis(v, which, axis=-1) for n, v in self.parameters.items()}
        drawn = get_family(self.family).distribution(chosen).ppf(rng.random(shape))
        zero = self.zero_share[..., np.newaxis]
        return np.asarray(np.where(rng.random(shape) < zero, 0 * drawn, drawn))

    def mean(self) -> Floats:
        """Return the expectation of the zero-inflated model, shape (...)."""
        return np.asarray((1 - self.zero_share) * self._mix(self._distribution(0).mean(), 0))

    def _distribution(self, trailing: int) -> Any:
        expanded = {name: expand(value, trailing) for name, value in self.parameters.items()}
        return get_family(self.family).distribution(expanded)

    def _mix(self, values: Floats, trailing: int) -> Floats:
        """Add up what components say, weighted; NaN where there are none."""
        weighted = expand(self.weights, trailing) * values
        used = expand(~np.isnan(self.weights), trailing)
        mixed = np.sum(np.where(used, weighted, 0.0), axis=-1 - trailing)
        return np.where(expand(self.k > 0, trailing), mixed, np.nan)

    def _positive_cdf(self, x: Floats, trailing: int, *, of_batch: bool = False) -> Floats:
        if of_batch:
            x = np.expand_dims(x, axis=-1 - trailing)
        return self._mix(self._distribution(trailing).cdf(x), trailing)

    def _bracket(self, level: Floats, trailing: int) -> tuple[Floats, Floats]:
        axis = -1 - trailing
        each = self._distribution(trailing).ppf(np.expand_dims(level, axis=axis))
        used = expand(~np.isnan(self.weights), trailing) & ~np.isnan(each)
        low = np.where(used, each, np.inf).min(axis=axis)
        high = np.where(used, each, 0.0).max(axis=axis)
        largest = np.finfo(np.float64).max
        return np.clip(low, _DARKEST, largest), np.clip(high, _DARKEST, largest)


def mixture_variables(mixture: Mixture) -> Mapped:
    """Return a mixture over (y, x, channel) as variables for `Samples.map`."""
    prefix = f"{mixture.family}_mixture"
    own = {f"{prefix}_{name}": getattr(mixture, name) for name in (*_OWN, "reason")}
    estimates = {f"{prefix}_{name}": value for name, value in mixture.parameters.items()}
    errors = {f"{prefix}_{name}_se": value for name, value in mixture.standard_errors.items()}
    shared = {name: getattr(mixture, name) for name in SHARED}
    by_component = {*estimates, *errors, *(f"{prefix}_{name}" for name in _BY_COMPONENT)}
    return {
        name: (("channel", *_further(name, by_component)), value)
        for name, value in {**own, **estimates, **errors, **shared}.items()
    }


def finish_mixture(dataset: xr.Dataset, family: MixtureFamily) -> xr.Dataset:
    """Set long names, units and flag meanings of the variables of a mixture."""
    prefix = f"{family}_mixture"
    for name, text in {**{f"{prefix}_{n}": t for n, t in _OWN.items()}, **SHARED}.items():
        dataset[name].attrs.update(long_name=text, units="1")
    units: Mapping[str, str] = {**get_family(family).units, "weight": "1"}
    for name, unit in units.items():
        for suffix, what in (("", ""), ("_se", "standard error of the ")):
            if f"{prefix}_{name}{suffix}" in dataset:
                dataset[f"{prefix}_{name}{suffix}"].attrs.update(
                    long_name=f"{what}{name} of the {family} components", units=unit
                )
    dataset[f"{prefix}_reason"].attrs.update(
        long_name=f"why there is no {family} mixture", units="1", **flag_attributes()
    )
    components = np.arange(1, dataset.sizes["component"] + 1)
    return dataset.assign_coords(
        bound=np.array(["low", "high"], dtype=object), component=components
    )


def _further(name: str, by_component: set[str]) -> tuple[str, ...]:
    if name == "null_interval":
        return ("bound",)
    return ("component",) if name in by_component else ()
