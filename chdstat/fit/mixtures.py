"""Mixtures: several families of light paths in one pixel, each a log-normal or gamma component."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np
import numpy.typing as npt

from chdstat._positive import Floats, Mask, PositivePart
from chdstat._reasons import Reason
from chdstat._routes import Part, Source, run
from chdstat.errors import InputError
from chdstat.fit._chosen_mixtures import ChosenMixtures, allowed_components
from chdstat.fit._components import COMPONENTS, MixtureFamily
from chdstat.fit._grounds import log_likelihood
from chdstat.fit._search import EFFORTS, Effort, search
from chdstat.fit.mixture_results import (
    Mixture,
    MixtureCriterion,
    finish_mixture,
    mixture_variables,
)
from chdstat.histograms import Histogram
from chdstat.samples import Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["mixture", "mixture_of_part"]

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
    not random, on cells of neighbouring samples (see `chdstat.fit._cells`), so that the cost hardly
    depends on spp. Its log-likelihood is of linear radiance and compares with that of any family.

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
        'thorough', or 'fast' for a quarter of the time: fewer starts and cells, a looser tolerance.

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
        mixture_variables,
        null=null,
        description=f"fitting {family} mixtures",
        progress=progress,
    )
    return result if isinstance(result, Mixture) else finish_mixture(result, family)


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
    allowed = allowed_components(part, largest)
    least = allowed[..., 0 if k is None else k - 1]
    reason[(reason == Reason.OK) & ~least] = Reason.TOO_FEW
    held_out = None
    if criterion == "held_out":
        held_out = _held_out(_samples_of(part), reason == Reason.OK, family, largest, effort)
    chosen = ChosenMixtures.of(part, reason, largest, k=k, held_out=held_out)
    for found in search(part, reason == Reason.OK, family, largest, effort=effort):
        chosen.enter(found)
    return chosen.result(family)


def _samples_of(part: Part) -> PositivePart:
    if isinstance(part, PositivePart):
        return part
    message = "held-out likelihood needs samples: a histogram has lost their order; use 'bic'"
    raise InputError(message)


def _held_out(
    part: PositivePart, usable: Mask, family: MixtureFamily, largest: int, effort: Effort
) -> Floats:
    """Return held-out log-likelihoods per sample, shape (row, component)."""
    halves = [_half(part, start) for start in (0, 1)]
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


def _half(part: PositivePart, start: int) -> PositivePart:
    positive = part.positive[..., start::2]
    n = np.asarray(np.count_nonzero(positive, axis=-1), dtype=np.int64)
    none = np.zeros_like(n)
    return PositivePart(part.x[..., start::2], positive, n, none, none, none, none)


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
