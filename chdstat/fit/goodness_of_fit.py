"""Goodness of fit: whether a fitted family describes the samples, and how large the misfit is.

`goodness` gives, for each test, a p-value that allows for the parameters being estimated, and an
effect size: with thousands of samples every family is rejected, and the effect shows whether it
matters.
Use `chdstat.fit.select` to compare families with each other.

Anderson-Darling has the most power against tails that differ, which decide noise; Cramer-von Mises
weighs the body, Kolmogorov-Smirnov takes the largest gap, whose size is the easiest to read;
chi-square at all cells equally, whatever their order, and is the weakest of the four.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, Seed, seed_number, whole
from chdstat._core.display import Shown
from chdstat._core.reasons import label_variables
from chdstat._core.resampling import q_values, rejections
from chdstat.errors import InputError, Reason
from chdstat.fit.atoms import split
from chdstat.fit.distances import DISTANCES, FitTest, bootstrap, mixture_family
from chdstat.fit.families import Fit, fit_part, get_family, zero_log_likelihood
from chdstat.fit.family import Family, Parameters
from chdstat.fit.mixtures import Mixture
from chdstat.fit.selection import Selection
from chdstat.samples import Samples
from chdstat.summary.dispatch import Part, PositiveHistogram, Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples import Mapped

__all__ = [
    "FIT_TESTS",
    "FitTest",
    "Goodness",
    "finish_goodness",
    "goodness",
    "goodness_of_part",
    "goodness_variables",
]

FIT_TESTS: tuple[FitTest, ...] = tuple(DISTANCES)
"""Names of the tests."""

_LABELS = {
    "statistic": "statistic of goodness of fit",
    "p_value": "bootstrap p-value of the family",
    "q_value": "q-value of the family over the image",
    "effect": "misfit, whatever the number of samples",
    "resamples": "bootstrap replicates that could be fitted",
    "rejected": "1 where not of this family, at the false discovery rate of the dataset",
}


@dataclass(frozen=True, repr=False)
class Goodness(Shown):
    """Goodness of fit of a family; arrays of shape (..., test), NaN where `reason` says why.

    With the reasons `UNTESTED` and `FEW_REPLICATES`, there is a statistic and an effect.

    Attributes
    ----------
    family, tests
        What was tested, and how: the names along the last axis.
    statistic
        Kolmogorov's D, Cramer and von Mises' W^2, Anderson and Darling's A^2, Pearson's X^2.
    p_value
        Of the hypothesis that the samples are of the family; NaN where fewer than half of the
        replicates could be fitted.
    effect
        D; sqrt(W^2 / n), the mean distance of the distribution functions; sqrt(A^2 / n), the same
        relative to its standard deviation; and Cohen's w, sqrt(X^2 / n).
    resamples
        Bootstrap replicates that could be fitted.
    n
        Samples that were tested, shape (...).
    reason
        `Reason` codes.
    """

    family: str
    tests: tuple[FitTest, ...]
    statistic: Floats
    p_value: Floats
    effect: Floats
    resamples: Counts
    n: Counts
    reason: npt.NDArray[np.int8]


def goodness_variables(result: Goodness) -> Mapped:
    """Return tests over (y, x, channel) as variables for `Samples.map`."""
    names = ("statistic", "p_value", "effect", "resamples", "reason")
    dims = ("channel", "fit_test") if result.n.ndim == 3 else ("fit_test",)
    return {f"{result.family}_goodness_{n}": (dims, getattr(result, n)) for n in names}


def finish_goodness(
    dataset: xr.Dataset,
    family: str,
    *,
    tests: Sequence[FitTest] = FIT_TESTS,
    resamples: int,
    alpha: float = 0.05,
) -> xr.Dataset:
    """Add q-values and ``rejected``, coordinates and the names and units of the variables.

    Without replicates nothing was tested: p-values and what follows from them are left out.
    """
    prefix = f"{family}_goodness"
    p_value = dataset[f"{prefix}_p_value"]
    if not resamples:
        dataset = dataset.drop_vars([f"{prefix}_p_value", f"{prefix}_resamples"])
    else:
        q_value = p_value.copy(data=q_values(p_value.to_numpy()))
        rejected = rejections(q_value, alpha).assign_attrs(false_discovery_rate=alpha)
        dataset = dataset.assign({f"{prefix}_q_value": q_value, f"{prefix}_rejected": rejected})
    labels = {f"{prefix}_{name}": f"{family}: {text}" for name, text in _LABELS.items()}
    labels[f"{prefix}_reason"] = f"why there is no test of {family}"
    dataset = label_variables(dataset, labels)
    return dataset.assign_coords(fit_test=np.array(tests, dtype=object))


Fitted: TypeAlias = Fit | Mixture | Selection
"""What was fitted, and can be tested."""

_MINIMUM = 8
_SAME = 1e-6
"""Difference of two log-likelihoods per sample, above which they are of different samples: that of
other samples is about 1 / sqrt(n), that of the same in single precision below 1e-7."""


@of_source
def goodness(
    x: Source,
    fit: str | Family | Fitted,
    *,
    tests: Sequence[FitTest] = FIT_TESTS,
    resamples: int = 99,
    seed: Seed = 0,
    alpha: float = 0.05,
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Goodness | xr.Dataset:
    """Test whether the positive samples are of a family whose parameters are estimated from them.

    Estimated parameters make the distance between samples and family smaller than that to the true
    one, so that textbook tables do not hold. The parametric bootstrap does: B times, as many
    samples are drawn from the fitted family and fitted again; ``p = (b + 1) / (B + 1)`` where b of
    them are as far from their fit as the samples are from theirs. It is never 0.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`.
    fit
        Name of a family, a `Family`, or, for an array or a `Histogram`, a `Fit`, a `Mixture` or a
        `Selection` that was fitted to it. Replicates of a mixture are fitted with as many
        components as it has, and its atoms are left out; of a selection, the best family of each
        pixel is tested.
    tests
        Some of 'kolmogorov-smirnov', 'cramer-von-mises', 'anderson-darling', 'chi-square'.
    resamples
        Replicates B; 0 for statistics and effects alone.
    seed
        Of the replicates. The random numbers of a pixel are made of the seed and of its positive
        samples: its p-value is the same whichever pixels are tested with it, and equal samples have
        equal p-values.
    alpha
        For an image: false discovery rate of ``rejected``.

    Returns
    -------
    Goodness or xarray.Dataset
        `Goodness` for an array or a `Histogram`. For an image, its fields over (y, x, channel,
        fit_test), as ``gamma_goodness_p_value``; the q-value of Benjamini and Hochberg over the
        image, for each channel and test separately; and ``gamma_goodness_rejected``: 1 where it is
        at most `alpha`, 0 where it is not, NaN without a p-value. Without replicates, there is none
        of these.

    Raises
    ------
    InputError
        If there is no such family or test, a number is out of range, or a fit is not one to `x`.

    Notes
    -----
    Chi-square counts samples in ``2 n^(2/5)`` equiprobable cells of the fitted family. Of a log
    histogram, it counts bins, merged until 5 samples are expected in each; the other statistics are
    sums over bins there, and replicates are histograms. Replicates that cannot be fitted, as the
    samples could, do not count.

    References
    ----------
    Stute, Gonzalez Manteiga and Presedo Quindimil, "Bootstrap based goodness-of-fit-tests", 1993,
    doi:10.1007/BF02613687. Davison and Hinkley, "Bootstrap methods and their application", 1997,
    equation 4.11, doi:10.1017/CBO9780511802843. Anderson and Darling, "Asymptotic theory of certain
    goodness of fit criteria", 1952, doi:10.1214/aoms/1177729437. Cohen, "Statistical power analysis
    for the behavioral sciences", 1988, chapter 7, doi:10.4324/9780203771587.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=500)
    >>> gamma, lognormal = goodness(x, "gamma"), goodness(x, "lognormal")
    >>> gamma.p_value > 0.05
    array([ True,  True,  True,  True])
    >>> lognormal.p_value[:3], bool(lognormal.effect[0] > gamma.effect[0])
    (array([0.01, 0.01, 0.01]), True)
    """
    if isinstance(tests, str) or not tests or not set(tests) <= set(FIT_TESTS):
        message = f"tests must be some of {', '.join(FIT_TESTS)}, got {tests!r}"
        raise InputError(message)
    if not 0 < alpha < 1:
        message = f"alpha must lie in (0, 1), got {alpha}"
        raise InputError(message)
    resamples = whole("resamples", resamples, least=0)
    root = seed_number(seed)
    image = isinstance(x, Samples) or hasattr(x, "data_vars")
    if image and not isinstance(fit, (str, Family)):
        message = "an image needs the name of a family, got a fit"
        raise InputError(message)

    fit = get_family(fit) if isinstance(fit, (str, Family)) else fit
    name = _name(fit)

    def of_part(part: Part) -> Goodness:
        if not isinstance(fit, Family):
            _check_fit(part, fit)
        return goodness_of_part(part, fit, tests=tests, resamples=resamples, seed=root)

    result = run(
        x, of_part, goodness_variables, null=null, description=f"testing {name}", progress=progress
    )
    if isinstance(result, Goodness):
        return result
    return finish_goodness(result, name, tests=tests, resamples=resamples, alpha=alpha)


def goodness_of_part(
    part: Part,
    fit: Family | Fitted,
    *,
    tests: Sequence[FitTest] = FIT_TESTS,
    resamples: int = 0,
    seed: Seed = 0,
) -> Goodness:
    """Test samples that are already split; a `Family` is fitted to them first, a fit is theirs.

    Of a `Selection`, each row is tested for the family that is best there. Its p-value then is a
    little too large, as replicates are fitted with that family alone.
    """
    root = seed_number(seed)
    given = fit if isinstance(fit, Family) else None
    if isinstance(fit, Mixture):
        part = split(part).rest
    fit = fit_part(part, fit) if isinstance(fit, Family) else fit
    reason = fit.reason.copy()
    values = np.full((3, *part.n.shape, len(tests)), np.nan)
    for family, parameters, rows, _ in _cases(fit, given):
        few = rows & (reason == Reason.OK) & (part.n < max(_MINIMUM, family.minimum + 1))
        reason[few] = Reason.TOO_FEW
        usable = rows & (reason == Reason.OK)
        found = bootstrap(part, usable, family, parameters, tests, resamples, root)
        values[:, usable] = found.reshape(values.shape)[:, usable]
    statistic, p_value, fitted = values
    effect = np.sqrt(np.maximum(statistic, 0) / np.maximum(part.n, 1)[..., np.newaxis])
    # Kolmogorov's D is a distance already, whatever the number of samples.
    effect = np.where(np.array(tests) == "kolmogorov-smirnov", statistic, effect)
    reasons = np.repeat(reason[..., np.newaxis], len(tests), axis=-1)
    reasons[(reasons == Reason.OK) & np.isnan(statistic)] = Reason.TOO_FEW
    untested = Reason.FEW_REPLICATES if resamples else Reason.UNTESTED
    reasons[(reasons == Reason.OK) & np.isnan(p_value)] = untested
    return Goodness(
        family=_name(fit),
        tests=tuple(tests),
        statistic=statistic,
        p_value=p_value,
        effect=effect,
        resamples=np.nan_to_num(fitted).astype(np.int64),
        n=part.n,
        reason=reasons,
    )


def _check_fit(part: Part, fit: Fitted) -> None:
    """Raise InputError if a fit is not one to these samples: these have another likelihood.

    That of a mixture in bins spreads the samples within them, and that of one with atoms is of the
    rest: there, only numbers are compared.
    """
    if fit.reason.shape != part.n.shape:
        message = f"expected a fit of batch shape {part.n.shape}, got {fit.reason.shape}"
        raise InputError(message)
    other = np.zeros(part.n.shape, dtype=bool)
    for family, parameters, rows, one in _cases(fit):
        found = family.log_likelihood(part, parameters) + zero_log_likelihood(part)
        with np.errstate(invalid="ignore"):
            far = np.abs(found - one.log_likelihood) > _SAME * (part.n + np.abs(found))
        if isinstance(one, Mixture):
            far &= ~(split(part).tied | isinstance(part, PositiveHistogram))
        other |= rows & ((one.n != part.n) | (one.n_null != part.n_null) | far)
    if other.any():
        message = (
            f"the fit is not one to x: {np.count_nonzero(other)} of {other.size} rows have other "
            "samples; fit x itself, with the same null, or give the family's name"
        )
        raise InputError(message)


def _name(fit: Family | Fitted) -> str:
    return "best" if isinstance(fit, Selection) else fit.name


def _cases(
    fit: Fitted, given: Family | None = None
) -> Iterator[tuple[Family, Parameters, Mask, Fit | Mixture]]:
    """Yield each family that there is, its parameters, its rows, and their fit."""
    if isinstance(fit, Selection):
        for i, name in enumerate(fit.families):
            one = fit.fits[name]
            yield get_family(name), one.parameters, np.asarray(fit.best == i), one
        return
    if isinstance(fit, Fit):
        family = given or get_family(fit.family)
        yield family, fit.parameters, np.ones(fit.n.shape, dtype=bool), fit
        return
    for k in np.unique(fit.k[fit.k > 0]).tolist():
        rows = np.asarray(fit.k == k)
        yield *mixture_family(fit, k), rows, fit
