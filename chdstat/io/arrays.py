"""Arrays of samples in files: NumPy's, netCDF, HDF5 and zarr, read in parts.

An array is never read whole: one in a .npy file is mapped into memory, those of xarray are lazy,
and a member of a compressed .npz archive is unpacked to a temporary file first.
"""

from __future__ import annotations

import shutil
import tempfile
import tokenize
import weakref
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError, StoreError
from chdstat.io.reading import Opened, ReadOptions
from chdstat.samples.axes import ordered, single
from chdstat.samples.layout import FOREIGN
from chdstat.samples.tiles import Image

__all__ = [
    "DAMAGED",
    "ArraySource",
    "Joined",
    "Remapped",
    "load_npy",
    "open_npy",
    "open_npz",
    "open_xarray",
]

DAMAGED = (
    *FOREIGN,
    EOFError,
    MemoryError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What damaged files may raise in NumPy, and in what it reads headers and archives with."""
_DIMS = {"y": "y", "x": "x", "c": "channel", "s": "sample"}


class ArraySource:
    """Samples in an array that is indexed when they are needed.

    Parameters
    ----------
    array
        Anything of real numbers with a shape that slices index.
    axes
        The letters of its axes.
    path
        The file that it is from.
    """

    def __init__(
        self,
        array: Any,
        axes: str,
        path: Path,
        *,
        features: Mapping[str, npt.NDArray[Any]] | None = None,
    ) -> None:
        self._array, self._axes, self.path = array, axes, path
        self._features = features or {}
        sizes = dict(zip(axes, array.shape, strict=True))
        self.shape = (sizes["y"], sizes["x"], sizes.get("c", 1), sizes["s"])
        self.frames = axes.index("s") < axes.index("y")

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, shape (y, x, channel, sample)."""
        index = {"y": ys, "x": xs, "s": ss, "c": slice(None)}
        try:
            block = np.asarray(self._array[tuple(index[letter] for letter in self._axes)])
        except DAMAGED as error:
            message = f"cannot read {self.path}: {error}"
            raise StoreError(message) from error
        block = block.transpose([self._axes.index(i) for i in "yxcs" if i in self._axes])
        if "c" not in self._axes:
            block = block[:, :, np.newaxis]
        return np.ascontiguousarray(single(block, self.path.name))

    def read_features(self) -> dict[str, Image]:
        """Return the first-hit features that are in the file."""
        return {name: np.asarray(image, np.float32) for name, image in self._features.items()}


class Joined:
    """Samples of several sources of one size, one behind the other."""

    def __init__(self, sources: Sequence[Any]) -> None:
        self._sources, first = sources, sources[0]
        self.path, self.frames = first.path, True
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
        options = np.arange(self.shape[3])[ss]
        place = np.searchsorted(self._ends, options, side="right")
        parts = []
        for number in np.unique(place):
            source = self._sources[number]
            own = options[place == number] - (self._ends[number] - source.shape[3])
            step = int(own[1] - own[0]) if len(own) > 1 else 1
            parts.append(source.read(ys, xs, slice(int(own[0]), int(own[-1]) + 1, step)))
        return np.concatenate(parts, axis=-1)

    def read_features(self) -> dict[str, Image]:
        """Return the features of the first source."""
        return dict(self._sources[0].read_features())


class Remapped:
    """An array in a file that is mapped into memory anew for each part that is options for.

    Pages of a map that stays count as memory of the process, until the whole file does.
    """

    def __init__(self, mapped: Callable[[], npt.NDArray[Any]]) -> None:
        self._mapped, array = mapped, mapped()
        self.shape, self.dtype, self.size = array.shape, array.dtype, array.size

    def __getitem__(self, index: Any) -> npt.NDArray[Any]:
        return np.asarray(self._mapped()[index])


def joined(sources: Sequence[ArraySource]) -> Any:
    """Return one source of the samples of all."""
    return sources[0] if len(sources) == 1 else Joined(sources)


def load_npy(path: Path) -> npt.NDArray[Any]:
    """Return the array in a .npy file, mapped into memory.

    Raises
    ------
    StoreError
        If there is none, or it is damaged.
    """
    try:
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    except DAMAGED as error:
        message = f"cannot read {path}: {error}"
        raise StoreError(message) from error
    if not isinstance(found, np.ndarray):
        message = f"{path} is no .npy file of one array"
        raise StoreError(message)
    return found


def open_npy(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open .npy files, whose samples follow each other."""
    sources = []
    for path in paths:
        array = Remapped(partial(load_npy, path))
        sources.append(ArraySource(array, ordered(array, path.name, options.axes), path))
    return Opened(joined(sources))


def open_npz(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open .npz archives: their largest array, or `variable`, and features by their names."""
    sources = []
    for path in paths:
        arrays = _unpacked(path)
        name = _variable(path, {n: a.size for n, a in arrays.items()}, options.variable)
        features = {n: _named(path, arrays, inside) for n, inside in options.features.items()}
        axes = ordered(arrays[name], path.name, options.axes)
        sources.append(ArraySource(arrays[name], axes, path, features=features))
    return Opened(joined(sources))


def open_xarray(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open what xarray opens: the largest variable or `variable`, and features by their names."""
    import xarray as xr

    sources, attrs = [], {}
    for path in paths:
        try:
            if path.is_dir():
                dataset = xr.open_zarr(path, chunks=None, decode_times=False, consolidated=False)
            else:
                dataset = xr.open_dataset(path, decode_times=False)
        except DAMAGED as error:
            message = f"xarray cannot open {path}: {error}"
            raise StoreError(message) from error
        sizes = {str(n): int(v.size) for n, v in dataset.data_vars.items()}
        name = _variable(path, sizes, options.variable)
        features = {n: _named(path, dataset, inside) for n, inside in options.features.items()}
        array = dataset[name]
        letters = {dim: letter for letter, dim in _DIMS.items()}
        if options.axes is None and set(map(str, array.dims)) <= letters.keys():
            axes = "".join(letters[str(dim)] for dim in array.dims)
        else:
            axes = ordered(array, path.name, options.axes)
        sources.append(ArraySource(array.variable, axes, path, features=features))
        attrs = {str(k): v for k, v in dataset.attrs.items() if isinstance(v, str | int | float)}
    return Opened(joined(sources), attrs)


class _Folder:
    """A temporary folder, which is removed with the last that refers to it."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="chdstat-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)

    def load(self, name: str) -> npt.NDArray[Any]:
        """Return the array in a .npy file in it, mapped into memory."""
        return load_npy(self.path / name)


def _unpacked(path: Path) -> dict[str, Remapped]:
    """Return the arrays of an archive, each mapped from a temporary file."""
    folder, arrays = _Folder(), {}
    try:
        with zipfile.ZipFile(path) as archive:
            for number, member in enumerate(archive.namelist()):
                name = f"{number}.npy"
                with archive.open(member) as packed, (folder.path / name).open("wb") as plain:
                    shutil.copyfileobj(packed, plain, 2**20)
                arrays[member.removesuffix(".npy")] = Remapped(partial(folder.load, name))
    except (*DAMAGED, StoreError) as error:
        message = f"cannot read {path}: {error}"
        raise StoreError(message) from error
    return arrays


def _variable(path: Path, sizes: Mapping[str, int], options: str | None) -> str:
    """Return the name of the array of samples: as options, or the largest."""
    if not sizes:
        message = f"{path} holds no array"
        raise StoreError(message)
    name = options or max(sizes, key=lambda n: sizes[n])
    if name not in sizes:
        message = f"{path} holds no array {name!r}, but {', '.join(sizes)}"
        raise InputError(message)
    return name


def _named(path: Path, arrays: Any, name: str) -> npt.NDArray[Any]:
    """Return the array of a feature by its name in a file."""
    if name not in arrays:
        message = f"{path} holds no array {name!r}, but {', '.join(map(str, arrays))}"
        raise InputError(message)
    return np.asarray(arrays[name][...])
