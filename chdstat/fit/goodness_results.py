"""Results of tests of fit: one frozen type for every family, and its variables over an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._multiplicity import q_values, rejections
from chdstat._positive import Counts, Floats
from chdstat._reasons import flag_attributes
from chdstat.fit._distances import DISTANCES, FitTest

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples import Mapped

__all__ = ["FIT_TESTS", "Goodness", "finish_goodness", "goodness_variables"]

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


@dataclass(frozen=True)
class Goodness:
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
    for name, text in _LABELS.items():
        if f"{prefix}_{name}" in dataset:
            dataset[f"{prefix}_{name}"].attrs.update(long_name=f"{family}: {text}", units="1")
    dataset[f"{prefix}_reason"].attrs.update(
        long_name=f"why there is no test of {family}", units="1", **flag_attributes()
    )
    return dataset.assign_coords(fit_test=np.array(tests, dtype=object))
