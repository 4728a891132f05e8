"""Arrays of samples in files: NumPy, netCDF, HDF5 and zarr, read in parts.

A .npy file is mapped into memory, the arrays of xarray are lazy, and a member of a .npz archive is
unpacked to a temporary file first.
"""

from __future__ import annotations

import contextlib
import importlib.util
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
from chdstat.errors import InputError, StoreError, brief
from chdstat.io.lazy import DAMAGED, ArraySource, Joined, Opened, ReadOptions, Remapped, readable
from chdstat.samples.samples import axes_of

__all__ = ["load_npy", "open_npy", "open_npz", "open_xarray"]

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
        array = arrays[_variable(path, arrays, options.variable)]
        axes = axes_of(array, path.name, options.axes)
        sources.append(ArraySource(array, axes, path, _features(path, arrays, options)))
    return Opened(Joined(sources))


def open_xarray(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open files with xarray: the largest variable or `variable`, and features by name.

    Notes
    -----
    Read
        The largest variable of 3 or 4 axes, or ``variable``, by the names of its dims or ``axes``,
        also a zarr array without names of dims;
        attributes of the file, and the variable's ``units``, as provenance; features by name.
    Converted
        Packed values (``scale_factor``, ``add_offset``); ``_FillValue`` to NaN.
    Warned of
        Copies.
    Ignored
        Other variables, coordinates.
    Refused
        As of arrays; several largest variables, as of archives; stores of chdstat; HDF5 and
        netCDF 4 without the package ``h5netcdf``.
    """
    import xarray as xr

    sources, attrs = [], {}
    letters = {"y": "y", "x": "x", "channel": "c", "sample": "s"}
    for path in paths:
        dataset: Any
        try:
            if path.is_dir():
                dataset = xr.open_zarr(path, chunks=None, decode_times=False, consolidated=False)
            else:
                dataset = xr.open_dataset(path, decode_times=False)
        except DAMAGED as error:
            dataset = _without_dims(path)
            if not dataset:
                raise StoreError(_why_not(path, error)) from error
        about, held = getattr(dataset, "attrs", {}), getattr(dataset, "data_vars", dataset)
        if "manifest" in about:
            message = f"{path} is a store of samples already: open it with chdstat.open"
            raise InputError(message)
        array = held[_variable(path, held, options.variable)]
        dims = getattr(array, "dims", ())
        named = "".join(letters[str(d)] for d in dims) if {*dims} <= letters.keys() else ""
        axes = axes_of(array, path.name, options.axes or named or None)
        lazy = getattr(array, "variable", array)
        sources.append(ArraySource(lazy, axes, path, _features(path, dataset, options)))
        attrs = {str(k): v for k, v in about.items() if isinstance(v, str | int | float)}
        attrs |= {"unit": str(array.attrs["units"])} if "units" in array.attrs else {}
    return Opened(Joined(sources), attrs)


def _without_dims(path: Path) -> Mapping[str, Any]:
    """Return the arrays in a folder of zarr whose dims have no names, which xarray asks for."""
    import zarr

    with contextlib.suppress(*DAMAGED):
        node = zarr.open(path, mode="r")
        return dict(node.arrays()) if isinstance(node, zarr.Group) else {"array": node}
    return {}


def _why_not(path: Path, error: BaseException) -> str:
    """Return why xarray cannot open a file; it may lack a package."""
    with contextlib.suppress(OSError), path.open("rb") as start:
        if start.read(8) == b"\x89HDF\r\n\x1a\n" and importlib.util.find_spec("h5netcdf") is None:
            return (
                f"{path} is a file of HDF5, or of netCDF 4, which the package h5netcdf reads: pip "
                "install h5netcdf, or write it as netCDF 3 or zarr"
            )
    why = "it is none, or cut off" if isinstance(error, ValueError) else brief(error)
    return f"xarray cannot open {path} as netCDF or zarr: {why}"


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


def _variable(path: Path, arrays: Mapping[str, Any], wanted: str | None) -> str:
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
    named = [name for name in largest if name in _SAMPLES]
    if not wanted and len(named or largest) > 1:
        message = (
            f"{path} holds {len(largest)} arrays that could be the samples; give one as variable: "
            f"{', '.join(largest)}"
        )
        raise InputError(message)
    return wanted or (named or largest)[0]


def _features(path: Path, arrays: Any, options: ReadOptions) -> dict[str, Array]:
    """Return the arrays of the features by their names in a file."""
    for name in options.features.values():
        if name not in arrays:
            message = f"{path} holds no array {name!r}, but {', '.join(map(str, arrays))}"
            raise InputError(message)
    return {n: np.asarray(arrays[name][...]) for n, name in options.features.items()}
