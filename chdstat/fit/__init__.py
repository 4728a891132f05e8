"""Fits: distributions for the positive part of a CHD, the share of nulls apart.

`gamma`, `lognormal`, `weibull`, `burr` and `pareto` fit a family, `select` compares families,
`goodness` tests whether a family describes the samples at all; `mixture` adds several components
up, `tail_index` looks at the largest samples only. All take one pixel, a batch with the samples on
the last axis, or a whole `Samples`; families and mixtures can be fitted to log histograms, too.
"""

from chdstat.fit.families import FAMILIES, Family
from chdstat.fit.goodness_of_fit import Goodness, goodness
from chdstat.fit.mixtures import mixture
from chdstat.fit.mle import burr, fit, gamma, lognormal, pareto, weibull
from chdstat.fit.results import Fit, Mixture
from chdstat.fit.selection import HeldOut, Selection, family_shares, select
from chdstat.fit.tail import Tail, tail_index

__all__ = [
    "FAMILIES",
    "Family",
    "Fit",
    "Goodness",
    "HeldOut",
    "Mixture",
    "Selection",
    "Tail",
    "burr",
    "family_shares",
    "fit",
    "gamma",
    "goodness",
    "lognormal",
    "mixture",
    "pareto",
    "select",
    "tail_index",
    "weibull",
]
