"""Arrays of reason codes, and labels of variables that hold them; see `chdstat.errors.Reason`."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import Reason

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["first_of", "flag_attributes", "flag_names", "label_variables", "place_attributes"]


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


def place_attributes(names: Sequence[str]) -> dict[str, Any]:
    """Return CF-convention attributes of a variable of places in a list of names, -1 for none."""
    return {
        "flag_values": [-1, *range(len(names))],
        "flag_meanings": " ".join(["none", *names]),
    }


def flag_names(attrs: Mapping[str, Any]) -> dict[int, str]:
    """Return the names of the values of an integer-coded variable from its attributes.

    Examples
    --------
    >>> flag_names(place_attributes(["gamma", "burr"]))
    {-1: 'none', 0: 'gamma', 1: 'burr'}
    """
    codes = np.atleast_1d(attrs["flag_values"]).tolist()
    return dict(zip(codes, str(attrs["flag_meanings"]).split(), strict=True))


def label_variables(dataset: xr.Dataset, labels: Mapping[str, str | tuple[str, str]]) -> xr.Dataset:
    """Set long name and units of the variables that a dataset has, and what reason codes mean.

    A name alone is one of a number without unit. The ends of intervals, dimension ``bound``, get
    their names, too.
    """
    for name, label in labels.items():
        if name in dataset:
            long_name, units = (label, "1") if isinstance(label, str) else label
            flags = flag_attributes() if name.endswith("reason") else {}
            dataset[name].attrs.update(long_name=long_name, units=units, **flags)
    if "bound" in dataset.dims:
        return dataset.assign_coords(bound=np.array(["low", "high"], dtype=object))
    return dataset
