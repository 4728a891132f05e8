"""Fits: distributions for the positive part of a CHD, with the share of nulls separately.

`fit` fits a family; each of `FAMILIES` also has a function of its name: `gamma`, `lognormal` and so
on. `select` compares families. `goodness` tests whether a family describes the samples at all.
`mixture` adds up several components. `tail_index` looks at the largest samples only.

All take one pixel, a batch with the samples on the last axis, or a whole `Samples`. Families and
mixtures can also be fitted to log histograms.
"""

from chdstat.fit.families import FAMILIES, Fit, family_fit, fit
from chdstat.fit.family import Family
from chdstat.fit.goodness_of_fit import Goodness, goodness
from chdstat.fit.mixtures import Mixture, mixture
from chdstat.fit.selection import HeldOut, Selection, select
from chdstat.fit.tail import Tail, tail_index
from chdstat.summary.runner import OfSource

__all__ = [
    "FAMILIES",
    "Family",
    "Fit",
    "Goodness",
    "HeldOut",
    "Mixture",
    "Selection",
    "Tail",
    "fit",
    "goodness",
    "mixture",
    "select",
    "tail_index",
    *FAMILIES,
]


def __getattr__(name: str) -> OfSource[..., Fit]:
    if name in FAMILIES:
        return family_fit(name)
    message = f"module 'chdstat.fit' has no attribute {name!r}"
    raise AttributeError(message)


def __dir__() -> list[str]:
    return sorted(__all__)
