"""Rows: take some rows out of a result, whatever its type, as indexing an array takes them.

Channels and luminance are analysed together, as rows of one batch; afterwards they part again.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any, TypeVar, cast

import numpy as np

__all__ = ["take_rows"]

Result = TypeVar("Result")


def take_rows(result: Result, rows: int | slice, *, axis: int) -> Result:
    """Return a result with only some rows along one of its batch axes.

    Every array with that axis is indexed: those of dataclasses, what they have cached included, and
    of mappings. What has fewer dimensions describes all rows alike and stays.

    Examples
    --------
    >>> take_rows({"mean": np.arange(6).reshape(2, 3), "n": np.array([7, 8])}, 2, axis=1)
    {'mean': array([2, 5]), 'n': array([7, 8])}
    """
    return cast("Result", _take(result, (slice(None),) * axis + (rows,)))


def _take(value: Any, index: tuple[int | slice, ...]) -> Any:
    if isinstance(value, np.ndarray):
        return value[index] if value.ndim >= len(index) else value
    if isinstance(value, Mapping):
        return {name: _take(item, index) for name, item in value.items()}
    if is_dataclass(value):
        taken = copy.copy(value)
        # Cached properties lie beside the fields; a frozen dataclass guards only its attributes.
        vars(taken).update({name: _take(item, index) for name, item in vars(value).items()})
        return taken
    return value
