"""Model files: named arrays and JSON in a safetensors file, which holds data and no code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from chdstat._core.files import checksum, replacing
from chdstat.errors import StoreError

__all__ = ["read_model", "write_model"]

_KEY = "chdstat"
"""Header entry that marks a file as ours: a checksum of it and the arrays, and the JSON. What else
a file holds is not looked at."""
_FOREIGN = (
    AttributeError,
    LookupError,
    OSError,
    RecursionError,
    SafetensorError,
    TypeError,
    ValueError,
)
"""What damaged bytes may raise in the libraries that read them."""

Arrays = dict[str, npt.NDArray[Any]]


def write_model(path: Path, arrays: Mapping[str, npt.NDArray[Any]], about: Any) -> None:
    """Write a model file; an existing one is replaced as a whole or not at all.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    text = json.dumps(about, default=str)
    header = {
        _KEY: f"{_told(text, contiguous)} {text}"
    }  # one entry: of several the order is chance
    try:
        with replacing(path) as partial:
            save_file(contiguous, partial, metadata=header)
    except (OSError, SafetensorError) as error:
        message = f"cannot write a model to {path}: {error}"
        raise StoreError(message) from error


def read_model(path: Path) -> tuple[Arrays, Any]:
    """Read the arrays and the JSON of a model file.

    Raises
    ------
    StoreError
        If there is no such file, it is damaged, or chdstat has not written it.
    """
    if not path.is_file():
        message = f"no model at {path}; train one with: chdstat train SCENE -o {path}"
        raise StoreError(message)
    try:
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            if _KEY not in header:
                message = f"{path} is a safetensors file, but not a chdstat model"
                raise StoreError(message)
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        told, _, text = header[_KEY].partition(" ")
        if told != _told(text, arrays):
            message = (
                f"{path} is damaged, or of an earlier chdstat that wrote no checksum: weights and "
                "header do not agree with it; train or copy it again"
            )
            raise StoreError(message)
        return arrays, json.loads(text)
    except _FOREIGN as error:
        message = f"{path} is damaged or not a chdstat model ({error}); train or copy it again"
        raise StoreError(message) from error


def _told(text: str, arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Return the checksum of a header and of all arrays, in whatever order they lie."""
    parts = [text.encode()]
    for name, array in sorted(arrays.items()):
        parts += [f"{name} {array.dtype.str} {array.shape}".encode(), array.tobytes()]
    return f"{checksum(b''.join(parts)):08x}"
