"""Arrays of samples in files of NumPy, read in parts.

A .npy file is mapped into memory, and a member of a .npz archive is unpacked to a temporary file
first.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import Array
from chdstat.errors import InputError, StoreError
from chdstat.io.sources import ArraySource, Joined, Opened, ReadOptions, Remapped, readable
from chdstat.samples.samples import axes_of

_SAMPLES = ("samples", "radiance")
"""Names of arrays that hold the samples."""


def load_npy(path: Path) -> Array:
    """Return the array in a .npy file, mapped into memory.

    Raises
    ------
    StoreError
        If there is none, or it is damaged.
    """
    with readable(path):
        found: Any = np.lib.format.open_memmap(path, mode="r")
    if found.offset + found.nbytes < path.stat().st_size:
        message = f"{path} holds more than an array of shape {found.shape}; expected one array"
        raise StoreError(message)
    return np.asarray(found)


def open_npy(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open .npy files, whose samples are concatenated.

    Notes
    -----
    Read
        As of arrays; several files are concatenated.
    Converted
        As of arrays; any order of bytes and of axes in memory.
    Warned of
        Copies.
    Ignored
        Nothing.
    Refused
        As of arrays; pickled objects; several arrays in a file; files of other sizes; ``variable``,
        features by name.
    """
    arrays = [Remapped(partial(load_npy, path)) for path in paths]
    given = zip(arrays, paths, strict=True)
    sources = [ArraySource(a, axes_of(a, path.name, options.axes), path) for a, path in given]
    return Opened(Joined(sources))


def open_npz(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open .npz archives: the largest array or `variable`, and features by name.

    Notes
    -----
    Read
        The largest array of 3 or 4 axes, or ``variable``; features by name.
    Converted
        As of arrays.
    Warned of
        Copies.
    Ignored
        Other arrays, Python objects, and members that are not arrays.
    Refused
        As of arrays; several largest arrays, unless exactly one is called "samples" or "radiance";
        missing names.
    """
    sources = []
    for path in paths:
        arrays = _unpacked(path)
        array = arrays[chosen(path, arrays, options.variable)]
        axes = axes_of(array, path.name, options.axes)
        sources.append(ArraySource(array, axes, path, features_of(path, arrays, options)))
    return Opened(Joined(sources))


class _Folder:
    """A temporary folder, which is removed with its last reference."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="chdstat-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)

    def load(self, name: str) -> Array:
        """Return the array in one of its .npy files, mapped into memory."""
        return load_npy(self.path / name)


def _unpacked(path: Path) -> dict[str, Remapped]:
    """Return the arrays of an archive, each mapped from a temporary file."""
    folder, arrays = _Folder(), {}
    with readable(path), zipfile.ZipFile(path) as archive:
        for number, member in enumerate(archive.namelist()):
            name = f"{number}.npy"
            with archive.open(member) as packed, (folder.path / name).open("wb") as plain:
                shutil.copyfileobj(packed, plain, 2**20)
            with contextlib.suppress(StoreError):  # Python objects and other files
                arrays[member.removesuffix(".npy")] = Remapped(partial(folder.load, name))
    return arrays


def chosen(path: Path, arrays: Mapping[str, Any], wanted: str | None) -> str:
    """Return the name of the array of samples: the wanted one, or the largest."""
    fit = {
        name: int(array.size)
        for name, array in arrays.items()
        if len(array.shape) in (3, 4) and array.dtype.kind in "fiu"
    }
    if not fit:
        held = ", ".join(f"{k} {a.dtype} {tuple(a.shape)}" for k, a in arrays.items()) or "none"
        message = f"{path} holds no real numbers with 3 or 4 axes, as samples; its arrays: {held}"
        raise StoreError(message)
    if wanted and wanted not in arrays:
        message = f"{path} holds no array {wanted!r}, but {', '.join(fit)}"
        raise InputError(message)
    largest = [name for name in fit if fit[name] == max(fit.values())]
    named = [name for name in largest if name.rpartition("/")[2] in _SAMPLES]
    if not wanted and len(named or largest) > 1:
        message = (
            f"{path} holds {len(largest)} arrays that could be the samples; give one as variable: "
            f"{', '.join(largest)}"
        )
        raise InputError(message)
    return wanted or (named or largest)[0]


def features_of(path: Path, arrays: Any, options: ReadOptions) -> dict[str, Array]:
    """Return the arrays of the features by their names in a file."""
    for name in options.features.values():
        if name not in arrays:
            message = f"{path} holds no array {name!r}, but {', '.join(map(str, arrays))}"
            raise InputError(message)
    with readable(path):
        return {n: np.asarray(arrays[name][...]) for n, name in options.features.items()}
