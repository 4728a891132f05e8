"""Mixtures: several kinds of light paths in one pixel, each a log-normal or gamma component.

One search finds the mixtures of all numbers of components; `chdstat.fit.mixture` and
`chdstat.modality` share it, and choose among them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.positive import Counts, Floats, Mask, PositivePart
from chdstat.errors import InputError, Reason
from chdstat.fit.components import COMPONENTS, MixtureFamily
from chdstat.fit.families import Estimate, Family, Parameters, get_family
from chdstat.fit.family import summed
from chdstat.fit.mle import zero_log_likelihood
from chdstat.fit.peaks import standard_errors
from chdstat.fit.results import Mixture, MixtureCriterion, counts_of, fit_variables, label_fit
from chdstat.fit.search import EFFORTS, Effort, Found, Solution, log_likelihood, search
from chdstat.fit.weighted_samples import WeightedSamples
from chdstat.samples import Samples
from chdstat.summary.dispatch import Part, Source, run
from chdstat.summary.histograms import Histogram

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["ChosenMixtures", "mixture", "mixture_family", "mixture_of_part", "mixture_parameters"]


class ChosenMixtures:
    """Mixtures that a search finds, piece by piece, of the chosen numbers of components.

    Parameters
    ----------
    part
        What the search is of.
    reason
        Why rows are not searched, shape (...).
    largest
        Most components.
    k
        The number of components, or None for that of the best score.
    held_out
        What the score is, shape (row, component), or None for BIC.
    """

    def __init__(
        self,
        part: Part,
        reason: npt.NDArray[np.int8],
        largest: int,
        *,
        k: int | None = None,
        held_out: Floats | None = None,
    ) -> None:
        rows = part.n.size
        allowed = _allowed_components(part, largest) & (reason == Reason.OK)[..., np.newaxis]
        self._part, self._reason, self._chosen = part, reason, k
        self._allowed = allowed.reshape(rows, largest)
        self._held_out = None if held_out is None else np.where(self._allowed, held_out, np.nan)
        self._k = np.zeros(rows, dtype=np.int8)
        self._values, self._errors = np.full((2, 3, rows, largest), np.nan)
        self._likelihoods = np.full((rows, largest), np.nan)
        self._converged = np.zeros(rows, dtype=bool)

    def enter(self, found: Found) -> None:
        """Take over what was found of some rows."""
        solutions, allowed = found.solutions, self._allowed[found.rows]
        values = np.stack([s.log_likelihood for s in solutions], axis=-1)
        # Minus infinity stands for what the search did not try.
        self._likelihoods[found.rows] = np.where(allowed & (values > -np.inf), values, np.nan)
        if self._chosen is not None:
            best = np.full(len(found.rows), self._chosen - 1)
        elif self._held_out is not None:
            best = _highest(self._held_out[found.rows], allowed)
        else:
            parameters = 3 * np.arange(1, len(solutions) + 1)
            best = _highest(
                values - parameters * np.log(found.summaries.n)[:, np.newaxis] / 2, allowed
            )
        for k in np.unique(best):
            at = np.flatnonzero(best == k)
            rows, solution = found.rows[at], solutions[k].take(at)
            errors = standard_errors(solution, found.summaries.take(at))
            order = np.argsort(_median(solution), axis=-1)
            for i, (name, value) in enumerate(_parameters(solution).items()):
                self._values[i, rows, : k + 1] = np.take_along_axis(value, order, axis=-1)
                self._errors[i, rows, : k + 1] = np.take_along_axis(errors[name], order, axis=-1)
            self._k[rows] = k + 1
            self._converged[rows] = solution.converged

    def result(self, family: MixtureFamily) -> Mixture:
        """Return all of it."""
        part, largest = self._part, self._likelihoods.shape[-1]
        shape = part.n.shape
        rest = (zero_log_likelihood(part) - part.n * part.log_statistics.log_mean)[..., np.newaxis]
        values = self._likelihoods.reshape(*shape, largest) + rest
        k = self._k.reshape(shape)
        at = np.maximum(k, 1).astype(np.int64)[..., np.newaxis] - 1
        chosen = np.where(k > 0, np.take_along_axis(values, at, axis=-1)[..., 0], np.nan)
        none = np.full(values.shape, np.nan)
        of_shape = 3 * np.arange(1, largest + 1) - 1
        with np.errstate(invalid="ignore", divide="ignore"):
            log_n, log_good = np.log(part.n), np.log(part.n_good)
            bics = of_shape * log_n[..., np.newaxis] + log_good[..., np.newaxis] - 2 * values
            bic = np.asarray((3.0 * k - 1) * log_n + log_good - 2 * chosen)
        names = ("weight", *get_family(family).units)
        estimates = dict(zip(names, self._values.reshape(3, *shape, largest), strict=True))
        errors = dict(zip(names, self._errors.reshape(3, *shape, largest), strict=True))
        return Mixture(
            family=family,
            criterion="bic" if self._held_out is None else "held_out",
            k=k,
            weights=estimates.pop("weight"),
            parameters=estimates,
            standard_errors=errors,
            log_likelihood=chosen,
            aic=np.asarray(6.0 * k - 2 * chosen),
            bic=bic,
            bics=bics,
            held_out=none if self._held_out is None else self._held_out.reshape(none.shape),
            **counts_of(part),
            converged=self._converged.reshape(shape),
            reason=self._reason,
        )


def _allowed_components(part: Part, largest: int) -> Mask:
    """Say how many components a row may have: with as many samples as parameters, or more.

    Nor may there be more components than distinct values, shape (..., component).
    """
    k = np.arange(1, largest + 1)
    if isinstance(part, PositivePart):
        rises = part.sorted[..., 1:] > part.sorted[..., :-1]
        distinct = np.count_nonzero(rises & part.valid[..., 1:], axis=-1) + (part.n > 0)
    else:
        distinct = np.count_nonzero(part.counts > 0, axis=-1)
    enough = part.n[..., np.newaxis] >= 3 * k - 1
    return np.asarray(enough & (distinct[..., np.newaxis] >= k))


def _highest(score: Floats, allowed: Mask) -> Counts:
    """Return the index of the highest score of those that are allowed and known, shape (row,)."""
    return np.asarray(np.where(allowed & ~np.isnan(score), score, -np.inf).argmax(axis=-1))


def _parameters(solution: Solution) -> dict[str, Floats]:
    """Return weights and parameters by name, in the order of the family, (row, component)."""
    log_weight, location, log_scale = solution.state.transpose(0, 2, 1)
    origin = solution.origin[:, np.newaxis]
    weight = np.exp(log_weight)
    weight /= weight.sum(axis=-1, keepdims=True)
    if solution.family.name == "lognormal":
        return {"weight": weight, "mu": location + origin, "sigma": np.exp(log_scale)}
    scale = np.exp(location - log_scale + origin)
    return {"weight": weight, "shape": np.exp(log_scale), "scale": scale}


def _median(solution: Solution) -> Floats:
    """Return the medians of the components as log radiance less origin, shape (row, component)."""
    _, location, log_scale = solution.state.transpose(0, 2, 1)
    if solution.family.name == "lognormal":
        return np.asarray(location)
    shape = np.exp(log_scale)
    with np.errstate(divide="ignore"):
        return np.asarray(location + np.log(special.gammaincinv(shape, 0.5) / shape))


_LARGEST_K = 8


@overload
def mixture(
    x: Samples | xr.Dataset,
    k: int | None = ...,
    *,
    family: MixtureFamily = ...,
    criterion: MixtureCriterion = ...,
    max_k: int = ...,
    effort: Effort = ...,
    progress: bool | None = None,
) -> xr.Dataset: ...
@overload
def mixture(
    x: Histogram | npt.ArrayLike,
    k: int | None = ...,
    *,
    family: MixtureFamily = ...,
    criterion: MixtureCriterion = ...,
    max_k: int = ...,
    effort: Effort = ...,
    null: npt.ArrayLike | None = None,
) -> Mixture: ...
def mixture(
    x: Source,
    k: int | None = None,
    *,
    family: MixtureFamily = "lognormal",
    criterion: MixtureCriterion = "bic",
    max_k: int = 3,
    effort: Effort = "thorough",
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Mixture | xr.Dataset:
    """Fit a zero-inflated mixture of log-normal or gamma components by maximum likelihood.

    ``f(x) = sum_j w_j f_j(x)`` on the positive part: expectation-maximisation from starts that are
    not random, on groups of neighbouring samples (see `chdstat.fit.components`), so that the cost
    hardly depends on spp. Its log-likelihood is of linear radiance and compares with that of any
    family.

    The likelihood of a mixture has no maximum: a component may shrink to one sample. Its standard
    deviation in log x is therefore at least 1e-3, as in scikit-learn, whose `reg_covar` is 1e-6.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`. A log histogram loses components narrower than a bin: their
        standard deviation in log x is at least 0.28 of a bin's width h, 0.063 by default. Its
        log-likelihood is that of the bins, per h, shifted by what binning costs one component.
    k
        Number of components; None to choose it among 1 to `max_k`.
    family
        Of the components: 'lognormal' or 'gamma'.
    criterion
        What chooses k: 'bic', or 'held_out', the log-likelihood of each half of the samples (even
        and odd ones) under the fit of the other half. The latter needs samples.
    max_k
        Largest number of components that is tried, at most 8.
    effort
        'thorough', or 'fast' for a quarter of the time: fewer starts, a looser tolerance.

    Returns
    -------
    Mixture or xarray.Dataset
        `Mixture` for an array or a `Histogram`. For an image, its fields as variables over (y, x,
        channel) and (y, x, channel, component), named as ``lognormal_mixture_k``,
        ``lognormal_mixture_mu``, ``lognormal_mixture_mu_se``, except those that all fits share.

    Raises
    ------
    InputError
        If an option is unknown or out of range, or a histogram is asked for held-out likelihood.

    References
    ----------
    Dempster, Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", 1977,
    doi:10.1111/j.2517-6161.1977.tb01600.x. Verbeek, Nunnink and Vlassis, "Accelerated EM-based
    clustering of large data sets", 2006, doi:10.1007/s10618-005-0033-3. Smyth, "Model selection for
    probabilistic clustering using cross-validated likelihood", 2000, doi:10.1023/A:1008940618127.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> x = np.concatenate([rng.lognormal(-4, 0.5, size=300), rng.lognormal(1, 0.3, size=700)])
    >>> result = mixture(x)
    >>> int(result.k), result.weights.round(2), result.parameters["mu"].round(1)
    (2, array([0.3, 0.7, nan]), array([-4.1,  1. ,  nan]))
    """
    _check(k, family, criterion, max_k, effort)
    result = run(
        x,
        lambda part: mixture_of_part(
            part, k, family=family, criterion=criterion, max_k=max_k, effort=effort
        ),
        fit_variables,
        null=null,
        description=f"fitting {family} mixtures",
        progress=progress,
    )
    return result if isinstance(result, Mixture) else label_fit(result, family, mixture=True)


def mixture_of_part(
    part: Part,
    k: int | None = None,
    *,
    family: MixtureFamily = "lognormal",
    criterion: MixtureCriterion = "bic",
    max_k: int = 3,
    effort: Effort = "thorough",
) -> Mixture:
    """Fit a mixture to samples that are already split; options as of `mixture`."""
    largest = max_k if k is None else k
    reason = part.reason()
    allowed = _allowed_components(part, largest)
    least = allowed[..., 0 if k is None else k - 1]
    reason[(reason == Reason.OK) & ~least] = Reason.TOO_FEW
    held_out = None
    if criterion == "held_out":
        if not isinstance(part, PositivePart):
            message = (
                "held-out likelihood needs samples: a histogram has lost their order; use 'bic'"
            )
            raise InputError(message)
        held_out = _held_out(part, reason == Reason.OK, family, largest, effort)
    chosen = ChosenMixtures(part, reason, largest, k=k, held_out=held_out)
    for found in search(part, reason == Reason.OK, family, largest, effort=effort):
        chosen.enter(found)
    return chosen.result(family)


def _held_out(
    part: PositivePart, usable: Mask, family: MixtureFamily, largest: int, effort: Effort
) -> Floats:
    """Return held-out log-likelihoods per sample, shape (row, component)."""
    halves = []
    for parity in (slice(0, None, 2), slice(1, None, 2)):
        x, positive = part.x[..., parity], part.positive[..., parity]
        n = np.asarray(np.count_nonzero(positive, axis=-1), dtype=np.int64)
        halves.append(PositivePart(x, positive, n, *[np.zeros_like(n)] * 4))
    smallest = np.minimum(halves[0].n, halves[1].n)
    both = usable & (smallest >= 2)
    for half in halves:
        both &= half.reason() == Reason.OK
    total = np.full((part.n.size, largest), np.nan)
    total[both.reshape(-1)] = 0.0
    for fitted, scored in (halves, halves[::-1]):
        n, ascending = scored.n.reshape(-1), scored.log_sorted.reshape(-1, scored.x.shape[-1])
        for found in search(fitted, both, family, largest, effort=effort):
            for i, solution in enumerate(found.solutions):
                rows, fit = found.rows, (solution.family, solution.state, solution.origin)
                total[rows, i] += log_likelihood(ascending[rows], n[rows], *fit)
    enough = smallest.reshape(-1, 1) >= 3 * np.arange(1, largest + 1) - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        per_sample = total / part.n.reshape(-1, 1) - part.log_statistics.log_mean.reshape(-1, 1)
    return np.where(enough, per_sample, np.nan)


def _check(k: Any, family: str, criterion: str, max_k: Any, effort: str) -> None:
    tables = {
        "family": (family, tuple(COMPONENTS)),
        "criterion": (criterion, ("bic", "held_out")),
        "effort": (effort, tuple(EFFORTS)),
    }
    for name, (given, choices) in tables.items():
        if given not in choices:
            message = f"{name} must be one of {', '.join(choices)}, got {given!r}"
            raise InputError(message)
    for name, number in (("k", k), ("max_k", max_k)):
        whole = isinstance(number, (int, np.integer)) and 1 <= cast("int", number) <= _LARGEST_K
        if not whole and not (name == "k" and number is None):
            message = f"{name} must be a whole number from 1 to {_LARGEST_K}, got {number!r}"
            raise InputError(message)


def mixture_family(component: MixtureFamily, k: int) -> Family:
    """Return mixtures of a fixed number of components as a family, for the bootstrap.

    Its parameters are those of each component, numbered: ``mu_1``, ``sigma_1``, ``weight_1``, ...
    """
    base = get_family(component)

    def estimate(part: Part, _near: Parameters | None) -> Estimate:
        found = mixture_of_part(part, k, family=component)
        return Estimate(
            parameters=mixture_parameters(found, k),
            standard_errors=_numbered(found.standard_errors, k),
            converged=found.converged,
        )

    def log_density(points: WeightedSamples, parameters: Parameters) -> Floats:
        densities = [
            base.log_density(points, one) + np.log(weight)[:, np.newaxis]
            for weight, one in _components(parameters, k)
        ]
        return np.asarray(np.logaddexp.reduce(densities))

    return Family(
        name=f"{component}_mixture",
        label=f"mixture of {base.label}",
        documentation=None,
        units={
            f"{name}_{i + 1}": unit
            for i in range(k)
            for name, unit in {**base.units, "weight": "1"}.items()
        },
        estimate=estimate,
        log_likelihood=summed(log_density),
        log_density=log_density,
        distribution=lambda parameters: _MixtureDistribution(base, parameters, k),
    )


def mixture_parameters(mixture: Mixture, k: int) -> dict[str, Floats]:
    """Return the parameters of the first `k` components by numbered name, each of shape (...)."""
    return _numbered({**mixture.parameters, "weight": mixture.weights}, k)


@dataclass(frozen=True)
class _MixtureDistribution:
    """Distribution of a mixture of `k` components: what the bootstrap needs of SciPy's."""

    base: Family
    parameters: Parameters
    k: int

    def cdf(self, x: Floats) -> Floats:
        """Return P(X <= x)."""
        return self._mix("cdf", x)

    def sf(self, x: Floats) -> Floats:
        """Return P(X > x)."""
        return self._mix("sf", x)

    def rvs(self, size: tuple[int, ...], random_state: np.random.Generator) -> Floats:
        """Draw samples."""
        # A sample is of the component in whose share of (0, 1) its number lies.
        number, drawn = random_state.random(size), np.zeros(size)
        below = np.zeros(1)
        for i, (weight, one) in enumerate(_components(self.parameters, self.k)):
            values = self.base.distribution(one).rvs(size=size, random_state=random_state)
            drawn = np.where(number >= below, values, drawn) if i else values
            below = below + weight
        return np.asarray(drawn)

    def _mix(self, name: str, x: Floats) -> Floats:
        return np.asarray(
            sum(
                weight * getattr(self.base.distribution(one), name)(x)
                for weight, one in _components(self.parameters, self.k)
            )
        )


def _numbered(values: Mapping[str, Floats], k: int) -> dict[str, Floats]:
    return {f"{name}_{i + 1}": v[..., i] for i in range(k) for name, v in values.items()}


def _components(parameters: Parameters, k: int) -> list[tuple[Floats, dict[str, Floats]]]:
    """Return the weight and the parameters of each component."""
    components = []
    for i in range(1, k + 1):
        mark = f"_{i}"
        one = {n.removesuffix(mark): v for n, v in parameters.items() if n.endswith(mark)}
        components.append((one.pop("weight"), one))
    return components
