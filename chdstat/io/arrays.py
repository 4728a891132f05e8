"""Arrays of samples in files: NumPy's, netCDF, HDF5 and zarr, and noisebase's, read in parts.

An array is never read whole: one in a .npy file is mapped into memory, those of xarray are lazy,
and a member of a compressed .npz archive is unpacked to a temporary file first.

A sample set of noisebase is a zarr group in a zip file, with what each sample has hit. ``color``
holds radiance as uint8, shape (4, y, x, sample): red, green, blue, and an exponent E that they
share. Between ``exposure``, the least and the largest logarithm of radiance in the frame, the
exponent stands for a radiance ``exp(least + (E + 1) / 256 (largest - least))``, of which red is
R / 255. The colours are rounded at random, without bias; two samples of a pixel may be equal for
it. ``position`` (float32), ``normal`` and ``diffuse`` (float16) have the shape (3, y, x, sample).
In files of training data, all arrays have one axis more, the first, of frames.

Sources: A. Balint et al., "Neural partitioning pyramids for denoising Monte Carlo renderings",
SIGGRAPH 2023, doi:10.1145/3588432.3591562; balintio/noisebase (docs/formats/sample_test_v1.md,
docs/formats/sample_training_v1.md, noisebase/compression.py).
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import shutil
import tempfile
import tokenize
import weakref
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image
from chdstat._core.files import check_claim
from chdstat.errors import InputError, StoreError, brief
from chdstat.io.frames import Frame, Frames
from chdstat.io.reading import Opened, ReadOptions
from chdstat.samples.layout import FOREIGN
from chdstat.samples.samples import axes_of, single

__all__ = [
    "DAMAGED",
    "ArraySource",
    "Joined",
    "Remapped",
    "load_npy",
    "open_noisebase",
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
        sources.append(ArraySource(array, axes_of(array, path.name, options.axes), path))
    return Opened(joined(sources))


def open_npz(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open .npz archives: their largest array, or `variable`, and features by their names."""
    sources = []
    for path in paths:
        arrays = _unpacked(path)
        name = _variable(path, arrays, options.variable)
        features = {n: _named(path, arrays, inside) for n, inside in options.features.items()}
        axes = axes_of(arrays[name], path.name, options.axes)
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
            raise StoreError(_why_not(path, error)) from error
        name = _variable(path, {str(n): v for n, v in dataset.data_vars.items()}, options.variable)
        features = {n: _named(path, dataset, inside) for n, inside in options.features.items()}
        array = dataset[name]
        letters = {dim: letter for letter, dim in _DIMS.items()}
        if options.axes is None and set(map(str, array.dims)) <= letters.keys():
            axes = "".join(letters[str(dim)] for dim in array.dims)
        else:
            axes = axes_of(array, path.name, options.axes)
        sources.append(ArraySource(array.variable, axes, path, features=features))
        attrs = {str(k): v for k, v in dataset.attrs.items() if isinstance(v, str | int | float)}
        attrs |= {"unit": str(array.attrs["units"])} if "units" in array.attrs else {}
    return Opened(joined(sources), attrs)


def _why_not(path: Path, error: BaseException) -> str:
    """Return why xarray cannot open a file, which may lack a package for it."""
    with contextlib.suppress(OSError), path.open("rb") as start:
        if start.read(8) == b"\x89HDF\r\n\x1a\n" and importlib.util.find_spec("h5netcdf") is None:
            return (
                f"{path} is a file of HDF5, or of netCDF 4, which the package h5netcdf reads: pip "
                "install h5netcdf, or write it as netCDF 3 or zarr"
            )
    why = "no such file is known" if isinstance(error, ValueError) else brief(error)
    return f"xarray cannot open {path} as netCDF or zarr: {why}"


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


def _variable(path: Path, arrays: Mapping[str, Any], wanted: str | None) -> str:
    """Return the name of the array of samples: that which is wanted, or the largest."""
    fit = {
        name: int(array.size)
        for name, array in arrays.items()
        if len(array.shape) in (3, 4) and array.dtype.kind in "fiu"
    }
    if not fit:
        held = ", ".join(f"{name} {tuple(a.shape)}" for name, a in arrays.items()) or "nothing"
        message = f"{path} holds no array of 3 or 4 axes, as samples have, but {held}"
        raise StoreError(message)
    if wanted and wanted not in arrays:
        message = f"{path} holds no array {wanted!r}, but {', '.join(fit)}"
        raise InputError(message)
    return wanted or max(fit, key=lambda name: fit[name])


def _named(path: Path, arrays: Any, name: str) -> npt.NDArray[Any]:
    """Return the array of a feature by its name in a file."""
    if name not in arrays:
        message = f"{path} holds no array {name!r}, but {', '.join(map(str, arrays))}"
        raise InputError(message)
    return np.asarray(arrays[name][...])


# --- sample sets of noisebase -------------------------------------------------------------------

_FEATURES = {"albedo": "diffuse", "normal": "normal", "position": "position"}


def open_noisebase(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open one frame: that of number `variable`, the first of a sequence if there is none given.

    Albedo, normal and position are the averages of what the samples have hit.
    """
    if len(paths) > 1:
        message = "each file of noisebase is a scene or frame of its own: read them one by one"
        raise InputError(message)
    path, wanted = paths[0], {**_FEATURES, **options.features}
    with _Group(path) as group:
        colour = group.array("color")
        frame = _frame(path, colour.shape, options.variable)
        height, width, spp = colour.shape[-3:]
        inside = {
            n: name
            for n, name in wanted.items()
            if n in options.features or group.has(name, (3, height, width, spp))
        }
        for name in inside.values():
            group.array(name, (3, height, width, spp))
        exposure = np.asarray(group.array("exposure")[frame], np.float32)
    if colour.dtype != np.uint8 or exposure.shape != (2,) or not np.isfinite(exposure).all():
        message = f"{path} is no sample set of noisebase: its colours are not encoded as such"
        raise StoreError(message)

    def decode(samples: range) -> Iterator[Frame]:
        with _Group(path) as group:
            step = max(1, min(int(group.array("color").chunks[-1]), len(samples)))
            for start in range(samples.start, samples.stop, step):
                part = slice(start, min(start + step, samples.stop))
                radiance = _decoded(group.read("color", frame, part), exposure)
                features = {n: group.read(name, frame, part) for n, name in inside.items()}
                for index in range(part.stop - part.start):
                    yield (
                        _image(radiance, index),
                        {name: _image(feature, index) for name, feature in features.items()},
                    )

    shape = (height, width, 3, spp)
    return Opened(Frames(path, shape, decode, featured=bool(inside)))


class _Group:
    """The arrays in a file, for as long as it is entered; all that fails says which file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> _Group:
        import zarr

        try:
            self._store = zarr.storage.ZipStore(self._path, mode="r")
            self._group: Any = zarr.open_group(self._store, mode="r")
        except DAMAGED as error:
            raise self._damaged(error) from error
        return self

    def __exit__(self, *_: object) -> None:
        self._store.close()

    def has(self, name: str, shape: tuple[int, ...]) -> bool:
        """Return whether there is an array whose last axes are of this shape."""
        try:
            return tuple(self._group[name].shape[-len(shape) :]) == shape
        except DAMAGED:
            return False

    def array(self, name: str, shape: tuple[int, ...] = ()) -> Any:
        """Return an array that the file can hold, not yet read."""
        try:
            found = self._group[name]
            there, chunks = tuple(found.shape), tuple(found.chunks)
            check_claim(self._path, found.dtype.itemsize * math.prod(there))
            check_claim(self._path, found.dtype.itemsize * math.prod(chunks))
        except DAMAGED as error:
            raise self._damaged(error) from error
        if there[len(there) - len(shape) :] != shape or found.dtype.kind not in "fu":
            message = (
                f"{self._path}: array {name!r} must hold numbers of shape {shape}, got "
                f"{found.dtype} of {there}"
            )
            raise InputError(message)
        return found

    def read(self, name: str, frame: tuple[int, ...], samples: slice) -> npt.NDArray[Any]:
        """Return some samples of an array in a frame, shape (component, y, x, sample)."""
        try:
            return np.asarray(self._group[name][(*frame, ..., samples)])
        except DAMAGED as error:
            raise self._damaged(error) from error

    def _damaged(self, error: BaseException) -> StoreError:
        return StoreError(f"cannot read {self._path} as a sample set of noisebase: {error}")


def _frame(path: Path, shape: Sequence[int], frame: str | None) -> tuple[int, ...]:
    """Return the index of a frame: none where the file has but one."""
    frames = shape[0] if len(shape) == 5 else 1
    number = 0 if frame is None else int(frame) if frame.isdecimal() and len(frame) < 10 else -1
    if len(shape) not in (4, 5) or shape[-4] != 4 or 0 in shape:
        message = f"{path} is no sample set of noisebase: its colours have shape {tuple(shape)}"
        raise StoreError(message)
    if not 0 <= number < frames:
        message = (
            f"{path} has the frames 0 to {frames - 1}; give the number of one as variable, not "
            f"{frame!r}"
        )
        raise InputError(message)
    return (number,) if len(shape) == 5 else ()


def _decoded(colour: npt.NDArray[np.uint8], exposure: npt.NDArray[np.float32]) -> Image:
    """Return radiance, shape (3, y, x, sample)."""
    least, largest = exposure
    steps = np.exp(least + np.arange(1, 257, dtype=np.float32) / 256 * (largest - least))
    unit: Image = (steps / 255).astype(np.float32)[colour[3]]
    return np.asarray(colour[:3] * unit)


def _image(values: npt.NDArray[Any], sample: int) -> Image:
    return np.moveaxis(values[..., sample], 0, -1).astype(np.float32)
