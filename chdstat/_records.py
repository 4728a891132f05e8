"""Records: results, which are dataclasses of numbers, words and arrays, in a file and back.

A record is an ``.npz`` file: arrays by number, and a tree in JSON that says where they belong.
Nothing in it runs when it is read, unlike in a pickle: a folder of renders can be passed on.
"""

from __future__ import annotations

import functools
import json
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_origin

import numpy as np
import numpy.typing as npt

from chdstat._targets import replacing
from chdstat.errors import StoreError

if TYPE_CHECKING:
    from cattrs import Converter

__all__ = ["read_record", "write_record"]

T = TypeVar("T")

_ARRAY = "array number"


def write_record(path: Path, value: Any) -> Path:
    """Write results; what was there is replaced when the new file is complete.

    Parameters
    ----------
    path
        An ``.npz`` file.
    value
        A dataclass, or tuples and mappings of such. Numbers of NumPy that stand alone become
        Python's.

    Raises
    ------
    StoreError
        If it cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from chdstat.metrics import Interval
    >>> found = Interval(*np.arange(8.0).reshape(4, 2))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = write_record(Path(folder, "found.npz"), {"mse": found})
    ...     read_record(path, dict[str, Interval])["mse"].high
    array([6., 7.])
    """
    arrays: list[npt.NDArray[Any]] = []

    def written(item: Any) -> Any:
        if isinstance(item, np.ndarray) and not item.dtype.hasobject:
            arrays.append(item)
            return {_ARRAY: len(arrays) - 1}
        if isinstance(item, np.generic):
            return item.item()
        message = f"a record holds numbers, words and arrays, not {type(item).__name__}"
        raise TypeError(message)

    tree = json.dumps(_converter().unstructure(value), default=written)
    try:
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez(file, *arrays, tree=np.array(tree))
    except OSError as error:
        message = f"cannot write {path}: {error.strerror or error}"
        raise StoreError(message) from error
    return path


def read_record(path: Path, kind: type[T]) -> T:
    """Read results of a kind, such as ``tuple[Finding, ...]``.

    Raises
    ------
    StoreError
        If the file is missing or damaged, or holds something else.
    """
    from cattrs.errors import BaseValidationError

    try:
        with np.load(path, allow_pickle=False) as file:

            def found(item: dict[str, Any]) -> Any:
                return file[f"arr_{item[_ARRAY]}"] if item.keys() == {_ARRAY} else item

            tree = json.loads(str(file["tree"]), object_hook=found)
        return _converter().structure(tree, kind)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile, BaseValidationError) as error:
        message = f"{path} is no record of {kind}: {error}"
        raise StoreError(message) from error


@functools.cache
def _converter() -> Converter:
    from cattrs import Converter

    # What cannot be in a record can still be a type of what an empty mapping would hold.
    converter = Converter(structure_fallback_factory=lambda _: _refused)
    # Arrays are found while the tree is read.
    converter.register_structure_hook_func(_is_array, _checked)
    return converter


def _is_array(kind: Any) -> bool:
    return get_origin(kind) is np.ndarray


def _checked(item: Any, kind: Any) -> Any:
    return item if isinstance(item, np.ndarray) else _refused(item, kind)


def _refused(item: Any, kind: Any) -> Any:
    message = f"expected {kind}, got {type(item).__name__}"
    raise ValueError(message)
