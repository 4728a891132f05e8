"""Fits: distributions for the positive part of a CHD, the share of nulls apart.

`gamma` and `lognormal` fit a family, `select` compares families, `tail_index` looks at the largest
samples only. All take one pixel, a batch with the samples on the last axis, or a whole `Samples`.
"""

from chdstat.fit.families import FAMILIES, Family
from chdstat.fit.mle import fit, gamma, lognormal
from chdstat.fit.results import Fit
from chdstat.fit.selection import Selection, select
from chdstat.fit.tail import Tail, tail_index

__all__ = [
    "FAMILIES",
    "Family",
    "Fit",
    "Selection",
    "Tail",
    "fit",
    "gamma",
    "lognormal",
    "select",
    "tail_index",
]
