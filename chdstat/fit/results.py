"""Results of fits of families and of mixtures: frozen types for one pixel or a whole batch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, generator
from chdstat._core.positive import Counts, Floats, Mask
from chdstat._core.reasons import label_variables
from chdstat._core.resampling import wilson
from chdstat.fit.components import MixtureFamily
from chdstat.fit.families import Parameters, get_family
from chdstat.summary.dispatch import Part

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples.samples import Mapped

__all__ = ["Fit", "Mixture", "MixtureCriterion", "counts_of", "fit_variables", "label_fit"]

MixtureCriterion = Literal["bic", "held_out"]

_SHARED = {
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
    "converged": "{} fit converged",
    "reason": "why there is no {} fit",
    "error_reason": "why {} has no standard errors",
}
_OF_MIXTURE = {
    "k": "number of components",
    "weights": "weights of the components",
    "log_likelihood": "log-likelihood of the zero-inflated mixture",
    "aic": "Akaike information criterion",
    "bic": "Bayesian information criterion",
    "bics": "Bayesian information criterion for each number of components",
    "held_out": "held-out log-likelihood per sample for each number of components",
    "converged": "the chosen fit converged",
    "reason": "why there is no {} mixture",
}
_HALVINGS = 70
"""Of the logarithmic interval that a quantile lies in: more than its 64 bits."""
_DARKEST = 1e-320


@dataclass(frozen=True)
class _ZeroInflated(ABC):
    """What fits of families and mixtures share: a point mass at 0, a density on the positive rest.

    The attributes are those of `Fit`.
    """

    family: str
    parameters: Parameters
    standard_errors: Parameters
    log_likelihood: Floats
    aic: Floats
    bic: Floats
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
        with np.errstate(all="ignore"):
            return self._mixed(self._distribution(x.ndim).pdf(x), x.ndim)

    def cdf(self, x: npt.ArrayLike) -> Floats:
        """Return P(X <= x) of the zero-inflated model, shape of the batch, then that of `x`."""
        x = np.asarray(x, dtype=np.float64)
        zero = _expand(self.zero_share, x.ndim)
        with np.errstate(all="ignore"):
            positive = self._mixed(self._distribution(x.ndim).cdf(x), x.ndim)
        return np.where(x < 0, 0 * zero, zero + (1 - zero) * positive)

    def ppf(self, q: npt.ArrayLike) -> Floats:
        """Return quantiles of the zero-inflated model, shape of the batch, then that of `q`."""
        q = np.asarray(q, dtype=np.float64)
        return self._quantile(q, q.ndim)

    @abstractmethod
    def rvs(self, size: int, *, seed: Seed = None) -> Floats:
        """Draw samples of the zero-inflated model, shape (..., size)."""

    def mean(self) -> Floats:
        """Return the expectation of the zero-inflated model, shape (...).

        It is infinite where the family has none (a tail index of 1 or more), and where that of a
        very wide log-normal is too large for double precision.
        """
        own = get_family(self.family).mean
        with np.errstate(all="ignore"):
            mean = self._distribution(0).mean() if own is None else own(self.parameters)
            return np.asarray((1 - self.zero_share) * self._mixed(mean, 0))

    def _distribution(self, trailing: int) -> Any:
        expanded = {name: _expand(value, trailing) for name, value in self.parameters.items()}
        return get_family(self.family).distribution(expanded)

    def _quantile(self, q: Floats, trailing: int) -> Floats:
        zero = _expand(self.zero_share, trailing)
        # Every family puts its quantile 0 at radiance 0: up to the mass at 0, the answer is 0.
        with np.errstate(all="ignore"):
            return self._positive_quantile(np.clip((q - zero) / (1 - zero), 0, 1), trailing)

    @abstractmethod
    def _positive_quantile(self, level: Floats, trailing: int) -> Floats:
        """Return quantiles of the positive part, whose axes after the batch's are `trailing`."""

    @abstractmethod
    def _mixed(self, values: Floats, trailing: int) -> Floats:
        """Return values of the positive part from those of its distribution."""


@dataclass(frozen=True)
class Fit(_ZeroInflated):
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
        Information criteria; the zero share counts as a parameter of every family.
    converged
        Whether the estimate met its tolerance.
    reason
        `Reason` codes.
    error_reason
        `Reason` codes of why one or more standard errors are NaN: as `reason`; `TOO_FEW` samples
        for them to hold, fewer than `Family.errors_from`; or `NOT_REGULAR`.
    """

    error_reason: npt.NDArray[np.int8]

    def rvs(self, size: int, *, seed: Seed = None) -> Floats:
        """Draw samples of the zero-inflated model, shape (..., size)."""
        return self._quantile(generator(seed).random((*self.null_share.shape, size)), 1)

    def _positive_quantile(self, level: Floats, trailing: int) -> Floats:
        return np.asarray(self._distribution(trailing).ppf(level))

    def _mixed(self, values: Floats, _trailing: int) -> Floats:
        return np.asarray(values)


@dataclass(frozen=True)
class Mixture(_ZeroInflated):
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
    bics: Floats
    held_out: Floats

    def rvs(self, size: int, *, seed: Seed = None) -> Floats:
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

    def _positive_quantile(self, level: Floats, trailing: int) -> Floats:
        """Bisect between the quantiles of the components, which it lies between."""
        axis, distribution = -1 - trailing, self._distribution(trailing)
        # The ends of the range are known; half stands in for them.
        inside = np.where((level > 0) & (level < 1), level, 0.5)
        each = distribution.ppf(np.expand_dims(inside, axis=axis))
        used = _expand(~np.isnan(self.weights), trailing) & ~np.isnan(each)
        largest = np.finfo(np.float64).max
        low = np.clip(np.where(used, each, np.inf).min(axis=axis), _DARKEST, largest)
        high = np.clip(np.where(used, each, 0.0).max(axis=axis), _DARKEST, largest)
        for _ in range(_HALVINGS):
            middle = np.sqrt(low) * np.sqrt(high)
            each = distribution.cdf(np.expand_dims(middle, axis=axis))
            below = self._mixed(each, trailing) < inside
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        ends = np.where(level == 0, 0.0, np.where(level == 1, np.inf, high))
        return np.where(np.isnan(level + _expand(self.weights[..., 0], trailing)), np.nan, ends)

    def _mixed(self, values: Floats, trailing: int) -> Floats:
        """Add up the values of the components, weighted; NaN where there are none."""
        weighted = _expand(self.weights, trailing) * values
        used = _expand(~np.isnan(self.weights), trailing)
        mixed = np.sum(np.where(used, weighted, 0.0), axis=-1 - trailing)
        return np.where(_expand(self.k > 0, trailing), mixed, np.nan)


def counts_of(part: Part) -> dict[str, Any]:
    """Return the fields that all fits to the same samples share."""
    with np.errstate(invalid="ignore", divide="ignore"):
        null_share = np.asarray(part.n_null / part.n_good)
    names = ("n", "n_null", "n_zero", "n_negative", "n_bad")
    return {
        "null_share": null_share,
        "null_interval": wilson(part.n_null, part.n_good),
        **{name: getattr(part, name) for name in names},
    }


def fit_variables(fit: Fit | Mixture) -> Mapped:
    """Return a fit over (y, x, channel) as variables for `Samples.map`."""
    mixture = isinstance(fit, Mixture)
    own = {name: getattr(fit, name) for name in (_OF_MIXTURE if mixture else _OF_FAMILY)}
    errors = {f"{name}_se": value for name, value in fit.standard_errors.items()}
    prefix = f"{fit.family}_mixture" if mixture else fit.family
    variables = {f"{prefix}_{name}": v for name, v in {**fit.parameters, **errors, **own}.items()}
    variables |= {name: getattr(fit, name) for name in _SHARED}
    further = {name: ("component",) if v.ndim > fit.n.ndim else () for name, v in variables.items()}
    further["null_interval"] = ("bound",)
    return {name: (("channel", *further[name]), value) for name, value in variables.items()}


def label_fit(dataset: xr.Dataset, family: str, *, mixture: bool = False) -> xr.Dataset:
    """Set long names, units and flag meanings of the variables of a family or its mixtures."""
    prefix = f"{family}_mixture" if mixture else family
    labels = {name: (text, "1") for name, text in _SHARED.items()}
    for name, text in (_OF_MIXTURE if mixture else _OF_FAMILY).items():
        labels[f"{prefix}_{name}"] = text.format(family), "1"
    units = get_family(family).units
    for name, unit in {**units, "weight": "1"}.items() if mixture else units.items():
        named = f"{name} of the {family} components" if mixture else f"{family} {name}"
        labels[f"{prefix}_{name}"] = named, unit
        labels[f"{prefix}_{name}_se"] = f"standard error of the {named}", unit
    if mixture:
        components = np.arange(1, dataset.sizes["component"] + 1)
        dataset = dataset.assign_coords(component=components)
    return label_variables(dataset, labels)


def _expand(value: npt.NDArray[Any], trailing: int) -> npt.NDArray[Any]:
    """Append axes of length 1 to the batch's, to broadcast against an argument."""
    return np.asarray(value).reshape((*np.shape(value), *(1,) * trailing))
