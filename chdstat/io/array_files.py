"""Arrays of samples in files of NumPy, netCDF, HDF5 and zarr, read in parts.

A .npy file is mapped into memory, and a member of a .npz archive is unpacked to a temporary file
first. netCDF, HDF5 and zarr hold named arrays in groups, with attributes. Each library opens its
own files; what they hold is decoded by the conventions of netCDF (CF), of which xarray knows the
details.
"""

from __future__ import annotations

import base64
import contextlib
import math
import os
import shutil
import struct
import tempfile
import warnings
import weakref
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import Array, Image, warn_caller
from chdstat.errors import InputError, StoreError, brief
from chdstat.io.sources import DAMAGED, Opened, ReadOptions, readable
from chdstat.samples.samples import axes_of, single

ZARR = ("zarr.json", ".zgroup", ".zarray")
"""Files that mark a folder as an array or group of zarr."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
"""First bytes of HDF5, and so of netCDF 4."""
_PACKED = ("scale_factor", "add_offset")
_CODE = (*_PACKED, "_FillValue", "missing_value", "_Unsigned")
"""Attributes that say how values are stored."""
_LETTERS = {"y": "y", "x": "x", "channel": "c", "sample": "s"}
_SAMPLES = ("samples", "radiance")
"""Names of arrays that hold the samples."""


# --- formats --------------------------------------------------------------------------------------


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
    arrays = [_mapped(path) for path in paths]
    given = zip(arrays, paths, strict=True)
    sources = [_ArraySource(a, axes_of(a, path.name, options.axes), path) for a, path in given]
    return Opened(_Joined(sources))


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
        sources.append(_ArraySource(array, axes, path, _features_of(path, arrays, options)))
    return Opened(_Joined(sources))


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
        array, features = arrays[name], _features_of(path, arrays, options)
        for used in (name, *options.features.values()):
            for caveat in held.caveats.get(used, tuple)():
                warn_caller(f"{path}: {caveat}")
        letters = "".join(_LETTERS.get(dim, "") for dim in array.dims)
        named = letters if len(letters) == len(array.shape) else None
        axes = axes_of(array, path.name, options.axes or named)
        sources.append(_ArraySource(array, axes, path, features))
        plain = {k: v for k, v in about.items() if isinstance(v, str | int | float)}
        attrs = {k: v for k, v in plain.items() if not k.startswith("_")}  # of libraries
        attrs |= {"unit": str(array.attrs["units"])} if "units" in array.attrs else {}
    return Opened(_Joined(sources), attrs)


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


def _features_of(path: Path, arrays: Any, options: ReadOptions) -> dict[str, Array]:
    """Return the arrays of the features by their names in a file."""
    for name in options.features.values():
        if name not in arrays:
            message = f"{path} holds no array {name!r}, but {', '.join(map(str, arrays))}"
            raise InputError(message)
    with readable(path):
        return {n: np.asarray(arrays[name][...]) for n, name in options.features.items()}


# --- sources --------------------------------------------------------------------------------------


class _ArraySource:
    """Samples in an array that is indexed on demand.

    Parameters
    ----------
    array
        An array-like of real numbers with a shape, indexed by slices.
    axes
        The letters of its axes.
    path
        File of the array.
    features
        First-hit features in the file.
    """

    def __init__(
        self, array: Any, axes: str, path: Path, features: Mapping[str, Array] | None = None
    ) -> None:
        self._array, self._axes, self.path = array, axes, path
        self._features = features or {}
        sizes = dict(zip(axes, array.shape, strict=True))
        self.shape = (sizes["y"], sizes["x"], sizes.get("c", 1), sizes["s"])
        self.frames = axes.index("s") < axes.index("y")

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, shape (y, x, channel, sample)."""
        index = {"y": ys, "x": xs, "s": ss, "c": slice(None)}
        with readable(self.path):
            block = np.asarray(self._array[tuple(index[letter] for letter in self._axes)])
        block = block.transpose([self._axes.index(i) for i in "yxcs" if i in self._axes])
        if "c" not in self._axes:
            block = block[:, :, np.newaxis]
        return np.ascontiguousarray(single(block, self.path.name))

    def read_features(self) -> dict[str, Image]:
        """Return the first-hit features that are in the file."""
        return {name: np.asarray(image, np.float32) for name, image in self._features.items()}


class _Joined:
    """Samples of several sources of one size, concatenated."""

    def __init__(self, sources: Sequence[_ArraySource]) -> None:
        self._sources, first = sources, sources[0]
        self.path, self.frames = first.path, len(sources) > 1 or first.frames
        for source in sources:
            if source.shape[:3] != first.shape[:3]:
                message = (
                    f"{source.path.name} holds samples of shape (y, x, channel) = "
                    f"{source.shape[:3]}, {first.path.name} of {first.shape[:3]}"
                )
                raise InputError(message)
        self._ends = np.cumsum([source.shape[3] for source in sources])
        self.shape = (*first.shape[:3], int(self._ends[-1]))

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, shape (y, x, channel, sample)."""
        if len(self._sources) == 1:
            return self._sources[0].read(ys, xs, ss)
        numbers = np.arange(self.shape[3])[ss]
        place = np.searchsorted(self._ends, numbers, side="right")
        parts = []
        for i in np.unique(place):
            source = self._sources[i]
            own = numbers[place == i] - (self._ends[i] - source.shape[3])
            step = int(own[1] - own[0]) if len(own) > 1 else 1
            parts.append(source.read(ys, xs, slice(int(own[0]), int(own[-1]) + 1, step)))
        return np.concatenate(parts, axis=-1)

    def read_features(self) -> dict[str, Image]:
        """Return the features of the first source."""
        return self._sources[0].read_features()


class _Stored:
    """An array in a file, whose parts are read and decoded when they are asked for.

    Nothing of a file stays open or mapped: pages of a lasting map count as memory of the process,
    until the whole file does.

    Parameters
    ----------
    like
        The array, or what has its shape and data type.
    part
        Reads a part of it.
    dims
        Names of its axes, as far as they have names.
    attrs
        Its attributes, which say how values are stored.
    """

    def __init__(
        self,
        like: Any,
        part: Callable[[Any], Array],
        dims: Iterable[Any] = (),
        attrs: Mapping[str, Any] | None = None,
    ) -> None:
        self._part, self.dims, self.attrs = part, [*map(str, dims)], attrs or {}
        self._code = {key: value for key, value in self.attrs.items() if key in _CODE}
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


def _mapped(path: Path, folder: _Folder | None = None) -> _Stored:
    """Return the array in a .npy file, which may lie in a temporary folder."""
    return _Stored(load_npy(path), partial(_part_of_npy, path, folder))


def _part_of_npy(path: Path, _: _Folder | None, index: Any) -> Array:
    return np.asarray(load_npy(path)[index])


# --- NumPy archives -------------------------------------------------------------------------------


class _Folder:
    """A temporary folder, which is removed with its last reference."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="chdstat-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


def _unpacked(path: Path) -> dict[str, _Stored]:
    """Return the arrays of an archive, each mapped from a temporary file."""
    folder, arrays = _Folder(), {}
    with readable(path), zipfile.ZipFile(path) as archive:
        for number, member in enumerate(archive.namelist()):
            place = folder.path / f"{number}.npy"
            with archive.open(member) as packed, place.open("wb") as plain:
                shutil.copyfileobj(packed, plain, 2**20)
            with contextlib.suppress(StoreError):  # Python objects and other files
                arrays[member.removesuffix(".npy")] = _mapped(place, folder)
    return arrays


# --- netCDF, HDF5 and zarr ------------------------------------------------------------------------


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
    caveats
        Functions that tell what of an array may not be read as it was meant.
    """

    arrays: dict[str, _Stored] = field(default_factory=dict)
    attrs: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    failed: dict[str, BaseException] = field(default_factory=dict)
    caveats: dict[str, Callable[[], Iterable[str]]] = field(default_factory=dict)

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
                held.caveats[name] = partial(_unwritten_of_hdf5, path, place)
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
            held.arrays[name], held.caveats[name] = _of_zarr_array(node, name, Path(place))
        except DAMAGED as error:
            held.failed[name or "array"] = error
        folders.clear()
    return held


def _of_zarr_array(
    array: Any, name: str, folder: Path
) -> tuple[_Stored, Callable[[], Iterable[str]]]:
    """Return an array, and a function that tells what of it is uncertain."""
    attrs, fill = dict(array.attrs), array.fill_value
    dims = attrs.pop("_ARRAY_DIMENSIONS", None) or getattr(array.metadata, "dimension_names", None)
    if isinstance(attrs.get("_FillValue"), str) and array.dtype.kind == "f":
        attrs["_FillValue"] = struct.unpack("<d", base64.b64decode(attrs["_FillValue"]))[0]
    # xarray keeps its _FillValue in zarr 2 as the fill value, which zarr itself sets to 0.
    by_fill = array.metadata.zarr_format == 2 and dims and fill is not None
    if by_fill and (fill or attrs.get("add_offset")):
        attrs.setdefault("_FillValue", fill)

    def caveats() -> Iterator[str]:
        edges = array.shards or array.chunks
        grid = [range(-(-n // edge)) for n, edge in zip(array.shape, edges, strict=True)]
        places = [folder / array.metadata.encode_chunk_key(at) for at in product(*grid)]
        yield from _absent(name, sum(not at.exists() for at in places), len(places), fill)
        if by_fill and fill > 0 and not attrs.keys() & {*_PACKED}:
            yield (
                f"{name} marks missing samples by its fill value, as xarray does in zarr 2: what "
                f"is {fill} reads as NaN; if these are samples, write it with fill_value=None"
            )

    return _Stored(array, array.__getitem__, (dim or "" for dim in dims or ()), attrs), caveats
