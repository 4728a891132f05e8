"""Arrays of samples in netCDF, HDF5 and zarr: files of named arrays in groups, with attributes.

Each library opens its own files. Parts are read on demand, and decoded by the conventions of
netCDF (CF), of which xarray knows the details.
"""

from __future__ import annotations

import base64
import contextlib
import math
import os
import struct
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import Array, warn_caller
from chdstat.errors import InputError, StoreError, brief
from chdstat.io.array_files import chosen, features_of
from chdstat.io.sources import DAMAGED, ArraySource, Joined, Opened, ReadOptions
from chdstat.samples.samples import axes_of

ZARR = ("zarr.json", ".zgroup", ".zarray")
"""Files that mark a folder as an array or group of zarr."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
"""First bytes of HDF5, and so of netCDF 4."""
_PACKED = ("scale_factor", "add_offset")
_CODE = (*_PACKED, "_FillValue", "missing_value", "_Unsigned")
"""Attributes that say how values are stored."""
_LETTERS = {"y": "y", "x": "x", "channel": "c", "sample": "s"}


def open_xarray(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open netCDF, HDF5 and zarr: the largest array or `variable`, and features by name.

    Notes
    -----
    Read
        The largest array of 3 or 4 axes, or ``variable``, in any group (``frames/beauty``), by the
        names of its dims or ``axes``; attributes of the file and of the array's groups, and the
        array's ``units``, as provenance; features by name.
    Converted
        By the conventions of netCDF: packed values (``scale_factor``, ``add_offset``); to NaN what
        equals ``_FillValue`` or ``missing_value``. The fill value of zarr 2 counts as
        ``_FillValue`` where xarray may have written it: the dims have names, and it is not 0. All
        other fill values only stand for what was never written.
    Warned of
        Copies; chunks that are absent, since they were never written or are lost; a fill value of
        zarr 2 that counts as ``_FillValue`` and may be a sample, since it is positive and nothing
        is packed.
    Ignored
        Other arrays, coordinates, consolidated metadata.
    Refused
        As of arrays; several largest arrays, as of archives; arrays that cannot be opened, unless
        ``variable`` names another; stores of chdstat; HDF5 and netCDF 4 without the package
        ``h5py``.
    """
    sources, attrs = [], {}
    options = replace(
        options,
        variable=options.variable and options.variable.strip("/"),
        features={name: at.strip("/") for name, at in options.features.items()},
    )
    for path in paths:
        held = _held(path)
        arrays = held.readable(path, options.variable)
        name = chosen(path, arrays, options.variable)
        about = held.attrs_of(name)
        if "manifest" in about:
            message = f"{path} is a store of samples already: open it with chdstat.open"
            raise InputError(message)
        array, features = arrays[name], features_of(path, arrays, options)
        for used in (name, *options.features.values()):
            for doubt in held.doubts.get(used, tuple)():
                warn_caller(f"{path}: {doubt}")
        letters = "".join(_LETTERS.get(dim, "") for dim in array.dims)
        named = letters if len(letters) == len(array.shape) else None
        axes = axes_of(array, path.name, options.axes or named)
        sources.append(ArraySource(array, axes, path, features))
        plain = {k: v for k, v in about.items() if isinstance(v, str | int | float)}
        attrs = {k: v for k, v in plain.items() if not k.startswith("_")}  # of libraries
        attrs |= {"unit": str(array.attrs["units"])} if "units" in array.attrs else {}
    return Opened(Joined(sources), attrs)


class _Stored:
    """An array in a file, whose parts are read and decoded when they are asked for.

    Parameters
    ----------
    like
        The array, or what has its shape and data type.
    part
        Reads a part of it.
    dims
        Names of its axes, as far as they have names.
    attrs
        Its attributes.
    """

    def __init__(
        self,
        like: Any,
        part: Callable[[Any], Array],
        dims: Iterable[Any],
        attrs: Mapping[str, Any],
    ) -> None:
        self._part, self.dims, self.attrs = part, [*map(str, dims)], attrs
        self._code = {key: value for key, value in attrs.items() if key in _CODE}
        self.shape, self.size = tuple(like.shape), math.prod(like.shape)
        self.dtype = self._decoded(np.empty(0, like.dtype)).dtype

    def __getitem__(self, index: Any) -> Array:
        return self._decoded(np.asarray(self._part(index)))

    def _decoded(self, part: Array) -> Array:
        if not self._code or part.dtype.kind not in "fiu":
            return part
        from xarray import Variable
        from xarray.conventions import decode_cf_variable

        coded = Variable([f"axis {number}" for number in range(part.ndim)], part, self._code)
        with warnings.catch_warnings(action="ignore"):  # of several missing values
            return np.asarray(decode_cf_variable("part", coded).values)


@dataclass(frozen=True)
class _Held:
    """What a file holds, by paths in it.

    Attributes
    ----------
    arrays
        The arrays.
    attrs
        Attributes of the groups.
    failed
        Errors of arrays that cannot be opened.
    doubts
        Functions that tell what of an array may not be read as it was meant.
    """

    arrays: dict[str, _Stored] = field(default_factory=dict)
    attrs: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    failed: dict[str, BaseException] = field(default_factory=dict)
    doubts: dict[str, Callable[[], Iterable[str]]] = field(default_factory=dict)

    def readable(self, path: Path, wanted: str | None) -> Mapping[str, _Stored]:
        """Return the arrays, unless one that failed is wanted or may hold the samples."""
        for name, error in self.failed.items():
            if wanted in (None, name):
                others = f"; give another as variable: {', '.join(self.arrays)}" * bool(self.arrays)
                message = f"cannot open the array {name!r} of {path}: {brief(error)}{others}"
                raise StoreError(message)
        return self.arrays

    def attrs_of(self, name: str) -> dict[str, Any]:
        """Return the attributes of the file and of the groups that an array is in."""
        ends = [0, *(place for place, letter in enumerate(name) if letter == "/")]
        return {k: v for end in ends for k, v in self.attrs.get(name[:end], {}).items()}


def _held(path: Path) -> _Held:
    """Return what a file, or a folder of zarr, holds."""
    with warnings.catch_warnings(action="ignore"):  # of arrays that need not hold the samples
        try:
            if path.is_dir():
                return _of_zarr(path)
            with path.open("rb") as file:
                hdf5 = file.read(len(_HDF5)) == _HDF5
            return _of_hdf5(path) if hdf5 else _of_netcdf3(path)
        except ImportError as error:
            message = (
                f"{path} is a file of HDF5, or of netCDF 4, which the package h5py reads: pip "
                "install h5py, or write it as netCDF 3 or zarr"
            )
            raise StoreError(message) from error
        except DAMAGED as error:
            why = "it is none, or cut off" if isinstance(error, ValueError) else brief(error)
            message = f"cannot open {path} as netCDF, HDF5 or zarr: {why}"
            raise StoreError(message) from error


# --- netCDF 3 -------------------------------------------------------------------------------------


def _of_netcdf3(path: Path) -> _Held:
    import xarray as xr

    dataset = xr.open_dataset(path, engine="scipy", decode_cf=False, cache=False)
    held = _Held(attrs={"": dataset.attrs})
    for name, found in dataset.variables.items():
        held.arrays[str(name)] = _Stored(found, partial(_values, found), found.dims, found.attrs)
    return held


def _values(variable: Any, index: Any) -> Array:
    return np.asarray(variable[index].values)


# --- HDF5 -----------------------------------------------------------------------------------------


def _of_hdf5(path: Path) -> _Held:
    import h5py

    held = _Held()

    def visit(place: str | bytes, node: Any) -> None:
        name = os.fsdecode(place)  # bytes where it is no text
        if isinstance(node, h5py.Group):
            held.attrs[name] = _attrs_of_hdf5(node)
        elif isinstance(node, h5py.Dataset):
            try:
                held.arrays[name] = _Stored(
                    node,
                    partial(_part_of_hdf5, path, place),
                    (a[0].name.rpartition("/")[2] if len(a) else a.label for a in node.dims),
                    _attrs_of_hdf5(node),
                )
                held.doubts[name] = partial(_unwritten_of_hdf5, path, place)
            except DAMAGED as error:
                held.failed[name] = error

    with h5py.File(path) as file:
        visit("", file)
        file.visititems(visit)
    return held


def _attrs_of_hdf5(node: Any) -> dict[str, Any]:
    """Return the attributes that are text or numbers, arrays of one value as this value."""
    found = {}
    for name in node.attrs:
        with contextlib.suppress(*DAMAGED):
            value = np.asarray(node.attrs[name])
            plain = value.item() if value.size == 1 else value
            plain = plain.decode() if isinstance(plain, bytes) else plain
            if isinstance(plain, str | int | float) or value.dtype.kind in "fiu":
                found[name] = plain
    return found


def _part_of_hdf5(path: Path, name: str | bytes, index: Any) -> Array:
    """Return a part of an array from a file that is opened for it, in whatever process."""
    import h5py

    with h5py.File(path) as file:
        return np.asarray(file[name][index])


def _unwritten_of_hdf5(path: Path, name: str | bytes) -> Iterator[str]:
    import h5py

    with h5py.File(path) as file:
        array = file[name]
        if array.is_virtual or array.external:
            return
        chunks = array.chunks or array.shape
        count = math.prod(-(-n // c) for n, c in zip(array.shape, chunks, strict=True))
        held = array.id.get_num_chunks() if array.chunks else bool(array.id.get_storage_size())
        # The fill value is left out: in some damaged files it ends the process.
        yield from _absent(os.fsdecode(name), count - held, count)


def _absent(name: str, lacking: int, count: int, fill: Any = "") -> Iterator[str]:
    """Say that chunks are absent, and what their samples read as."""
    if lacking:
        yield (
            f"{lacking} of {count} chunks of {name} are absent, and their samples read as its fill "
            f"value {fill}".rstrip()
            + ": unless they are this value, they were lost or not written"
        )


# --- zarr -----------------------------------------------------------------------------------------


def _of_zarr(path: Path) -> _Held:
    import zarr

    held = _Held()
    for place, folders, files in os.walk(path):
        folders.sort()
        if not {*files} & {*ZARR}:
            continue
        name = Path(place).relative_to(path).as_posix().removeprefix(".")
        try:
            node = zarr.open(place, mode="r", use_consolidated=False)
            if isinstance(node, zarr.Group):
                held.attrs[name] = dict(node.attrs)
                continue
            name = name or "array"
            held.arrays[name], held.doubts[name] = _of_zarr_array(node, name, Path(place))
        except DAMAGED as error:
            held.failed[name or "array"] = error
        folders.clear()
    return held


def _of_zarr_array(
    array: Any, name: str, folder: Path
) -> tuple[_Stored, Callable[[], Iterable[str]]]:
    """Return an array, and a function that tells what of it is in doubt."""
    attrs, fill = dict(array.attrs), array.fill_value
    dims = attrs.pop("_ARRAY_DIMENSIONS", None) or getattr(array.metadata, "dimension_names", None)
    if isinstance(attrs.get("_FillValue"), str) and array.dtype.kind == "f":
        attrs["_FillValue"] = struct.unpack("<d", base64.b64decode(attrs["_FillValue"]))[0]
    # xarray keeps its _FillValue in zarr 2 as the fill value, which zarr itself sets to 0.
    by_fill = array.metadata.zarr_format == 2 and dims and fill is not None
    if by_fill and (fill or attrs.get("add_offset")):
        attrs.setdefault("_FillValue", fill)

    def doubts() -> Iterator[str]:
        edges = array.shards or array.chunks
        grid = [range(-(-n // edge)) for n, edge in zip(array.shape, edges, strict=True)]
        places = [folder / array.metadata.encode_chunk_key(at) for at in product(*grid)]
        yield from _absent(name, sum(not at.exists() for at in places), len(places), fill)
        if by_fill and fill > 0 and not attrs.keys() & {*_PACKED}:
            yield (
                f"{name} marks missing samples by its fill value, as xarray does in zarr 2: what "
                f"is {fill} reads as NaN; if these are samples, write it with fill_value=None"
            )

    return _Stored(array, array.__getitem__, (dim or "" for dim in dims or ()), attrs), doubts
