"""Families: the distributions that the positive part of a CHD can be fitted with.

`FAMILIES` is the table. A family is a row of it: how its parameters are estimated from the positive
part (whose sums are shared between the families), its log-likelihood, SciPy's distribution for
everything else, and what documentation, reports and tests say of it. Each has a module of its own;
the engine that runs one is in `chdstat.fit.mle`.
"""

from __future__ import annotations

from collections.abc import Mapping

from chdstat.errors import InputError
from chdstat.fit._burr import BURR
from chdstat.fit._gamma import GAMMA
from chdstat.fit._inverse_gaussian import INVERSE_GAUSSIAN
from chdstat.fit._lognormal import LOGNORMAL
from chdstat.fit._pareto import PARETO
from chdstat.fit._weibull import WEIBULL
from chdstat.fit.family import Estimate, Family, Parameters

__all__ = ["FAMILIES", "SELECTED", "Estimate", "Family", "Parameters", "get_family"]

FAMILIES: Mapping[str, Family] = {
    family.name: family for family in (GAMMA, LOGNORMAL, WEIBULL, BURR, PARETO, INVERSE_GAUSSIAN)
}
"""Families by name. A new one is a new row."""
SELECTED = tuple(family.name for family in FAMILIES.values() if family.selected)
"""Families that `select` compares by default."""


def get_family(family: str | Family) -> Family:
    """Return a family by its name; a family passes through.

    Raises
    ------
    InputError
        If there is no family of this name.
    """
    if isinstance(family, Family):
        return family
    if family not in FAMILIES:
        message = f"family must be one of {', '.join(FAMILIES)}, got {family!r}"
        raise InputError(message)
    return FAMILIES[family]
