"""Reason codes: why a pixel has no number.

A pixel that cannot be computed is data: NaN in the result and one of these codes beside it.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Reason", "first_of", "flag_attributes", "label_variables"]


class Reason(enum.IntEnum):
    """Why a value is missing; `OK` where it is not."""

    OK = 0
    ALL_NULL = 1
    """Every good sample is null: there is nothing to fit."""
    TOO_FEW = 2
    """Fewer usable samples than the method needs."""
    CONSTANT = 3
    """The usable samples are equal, or too nearly so for the numbers at hand."""
    NOT_CONVERGED = 4
    """An iteration ended before its tolerance was met."""
    ALL_BAD = 5
    """Every sample is NaN or infinite."""
    AT_LIMIT = 6
    """The likelihood has no maximum: it rises towards a limit of the family. Of Burr, that is the
    Weibull distribution; of the generalised Pareto, one that ends at the largest sample."""
    NONE_POSITIVE = 7
    """No sample is positive, and some are negative: they have no logarithm."""
    TIED = 8
    """Several samples share the largest value: they were clamped, rounded, or are a few atoms."""
    UNTESTED = 9
    """No test was asked for: there is a statistic and no p-value."""
    FEW_REPLICATES = 10
    """Fewer than half of the bootstrap replicates could be fitted: they are no p-value."""
    AT_PARETO_LIMIT = 11
    """No Burr distribution is as likely as a power law that begins at the smallest sample."""
    UNIDENTIFIED = 12
    """The samples do not decide: the answer rests on a tail that may be too heavy for it."""
    NOT_REGULAR = 13
    """The likelihood is not regular there, or has no curvature: there are no standard errors."""


def first_of(
    cases: Mapping[Any, npt.NDArray[np.bool_]], default: enum.IntEnum = Reason.OK
) -> npt.NDArray[np.int8]:
    """Return the code of the first case that holds, `default` where none does, shape (...).

    Examples
    --------
    >>> n = np.array([0, 1, 50])
    >>> first_of({Reason.ALL_NULL: n == 0, Reason.TOO_FEW: n < 20})
    array([1, 2, 0], dtype=int8)
    """
    codes: list[Any] = [np.int8(code) for code in cases]
    return np.asarray(np.select([*cases.values()], codes, np.int8(default)), dtype=np.int8)


def flag_attributes(kind: type[enum.IntEnum] = Reason) -> dict[str, Any]:
    """Return CF-convention attributes that explain an integer-coded variable.

    Examples
    --------
    >>> flag_attributes()["flag_meanings"].split()[:2]
    ['ok', 'all_null']
    """
    return {
        "flag_values": [int(code) for code in kind],
        "flag_meanings": " ".join(code.name.lower() for code in kind),
    }


def label_variables(
    dataset: xr.Dataset, labels: Mapping[str, tuple[str, str]], *, bounds: bool = True
) -> xr.Dataset:
    """Set long name and units of the variables that a dataset has, and what reason codes mean.

    With `bounds`, the ends of intervals, dimension ``bound``, get their names, too.
    """
    for name, (long_name, units) in labels.items():
        if name in dataset:
            flags = flag_attributes() if name.endswith("reason") else {}
            dataset[name].attrs.update(long_name=long_name, units=units, **flags)
    if bounds:
        return dataset.assign_coords(bound=np.array(["low", "high"], dtype=object))
    return dataset
