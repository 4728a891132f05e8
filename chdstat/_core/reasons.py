"""Arrays of reason codes, and labels of variables that hold them; see `chdstat.errors.Reason`."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import Reason

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["first_of", "flag_attributes", "label_variables"]


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
