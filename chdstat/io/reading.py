"""Reading: samples in the files of other programs, opened as `chdstat.Samples`.

`read` finds the format. Samples are read on demand, except some that show whether passes repeat
each other. `FORMATS` lists the formats: each is a function from paths and `ReadOptions` to an
`Opened`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import reprlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, warn_caller
from chdstat._core.files import is_path, local
from chdstat.errors import InputError, StoreError
from chdstat.io.array_files import ZARR, load_npy, open_npy, open_npz, open_xarray
from chdstat.io.exr import open_exr, read_feature
from chdstat.io.sources import Opened, ReadOptions
from chdstat.io.stream import open_stream
from chdstat.samples import Samples
from chdstat.samples.dependence import warn_of_repeats
from chdstat.samples.layout import canonical
from chdstat.samples.samples import check_counts, check_features, checked_attrs
from chdstat.samples.tiles import BATCH, SampleSource


@dataclass(frozen=True)
class Format:
    """A kind of files that hold samples.

    Attributes
    ----------
    name
        Name for ``format=``.
    suffixes
        Suffixes of its files, with the dot.
    title
        Title for help and documentation.
    opener
        Function that opens its files.
    takes
        Fields of `ReadOptions` that the caller may set.

    Notes
    -----
    The notes of the opener say what is read, converted, warned of, ignored and refused. The
    documentation quotes them.
    """

    name: str
    suffixes: tuple[str, ...]
    title: str
    opener: Callable[[Sequence[Path], ReadOptions], Opened]
    takes: tuple[str, ...] = ()

    def open(self, paths: Sequence[Path], options: ReadOptions) -> Opened:
        """Open files of this format."""
        for option in fields(options):
            if getattr(options, option.name) and option.name not in self.takes:
                instead = "; give features as arrays or files" if option.name == "features" else ""
                message = (
                    f"files of the format {self.name} come without {option.name} to choose: leave "
                    f"{option.name} out{instead}"
                )
                raise InputError(message)
        return self.opener(paths, options)


_NAMED = ("variable", "features")
FORMATS = (
    Format("npy", (".npy",), "NumPy arrays", open_npy, ("axes",)),
    Format("npz", (".npz",), "NumPy archives", open_npz, ("axes", *_NAMED)),
    Format(
        "xarray",
        (".nc", ".nc4", ".h5", ".hdf5", ".zarr"),
        "Arrays of netCDF, HDF5 and zarr",
        open_xarray,
        ("axes", *_NAMED),
    ),
    Format("exr", (".exr",), "EXR images, each a sample or average", open_exr, _NAMED),
    Format("stream", (".chds",), "Streams of chdstat_writer.h", open_stream, ("features",)),
)
"""Formats in the order in which they are tried."""


def read(
    source: str | Path,
    *more: str | Path,
    format: str | None = None,  # noqa: A002 - what users call it
    axes: str | None = None,
    variable: str | None = None,
    features: Mapping[str, str | Path | npt.ArrayLike] | None = None,
    counts: str | Path | npt.ArrayLike | None = None,
    **attrs: Any,
) -> Samples:
    """Open samples in files of other programs; `Samples.save` makes a store of them.

    A `chdstat.errors.InputWarning` reports anything unusual, such as passes that repeat each other,
    converted colours, or pixels outside the image.

    Parameters
    ----------
    source, *more
        The files, in the order of their samples; or a folder of files, in the order of their names.
    format
        One of `FORMATS`; None to go by the names of the files.
    axes
        Order of the axes of arrays, as letters y, x, s (sample) and perhaps c (channel), such as
        "syxc" for a stack of images. None if the dims have names, or for "yxcs".
    variable
        Array that holds the samples, if a file has several, with its groups, such as
        "frames/beauty"; None for the largest. For EXR files, the layer; None for red, green and
        blue, or Y.
    features
        First-hit features by name (albedo, normal, position, depth): arrays (y, x) or (y, x,
        component), files of them (.npy, .exr), or their names within the source. EXR layers are
        averaged over all files.
    counts
        Samples of each pixel, shape (y, x), if they differ, or a .npy file of these numbers.
    **attrs
        Provenance: ``scene="name"``, ``renderer="mine 1.2"``, ``seed=7``, or ``unit`` of radiance.
        ``averaged=16`` if each value is the average of 16 samples, ``sequence=16`` if 16 at a time
        depend on each other, as stratified samples do.

    Returns
    -------
    Samples
        Samples that are read from the files on demand.

    Raises
    ------
    InputError
        If the format is unknown, or the files do not hold what they should.
    StoreError
        If a file is missing, damaged or cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "radiance.npy")
    >>> np.save(path, np.ones((32, 4, 6, 3)))  # 32 images of 6 x 4 pixels
    >>> read(path, axes="syxc")
    <Samples 'radiance' 6 x 4 pixels, 3 channels, 32 spp, part of ...radiance.npy>
    """
    paths = _files([source, *more])
    given = dict(features or {})
    named = {n: str(v) for n, v in given.items() if isinstance(v, str | Path) and not _is_file(v)}
    opened = _format(paths, format).open(paths, ReadOptions(axes, variable, named))
    shape = opened.source.shape
    images = opened.source.read_features()
    images |= {n: _feature(n, v) for n, v in given.items() if n not in named}
    images = {n: x[..., 0] if x.ndim == 3 and x.shape[2] == 1 else x for n, x in images.items()}
    check_features(images, shape)
    found = opened.counts
    if counts is not None:
        found = check_counts(_loaded(counts), shape)
    # Identifies the files when an interrupted import is repeated.
    stated = [[p.name, p.stat().st_size, p.stat().st_mtime_ns] for p in paths]
    about = {
        "scene": paths[0].stem,
        "scene_source": paths[0].name,
        **opened.attrs,
        "files": len(paths),
        "files_hash": hashlib.blake2b(canonical(stated), digest_size=16).hexdigest(),
        **attrs,
    }
    about = checked_attrs(about)
    held = opened.source if found is None else _Counted(opened.source, found)
    _warn_of_copies(paths, held)
    return Samples(held, attrs=about, features=images, counts=found)


_LOOKED = 2**29
"""Bytes of images to decode in search of repetitions, but at least one batch."""


def _warn_of_copies(paths: Sequence[Path], source: SampleSource) -> None:
    """Warn of samples that occur twice, by the names of the files or by their content."""
    file, times = Counter(path.resolve() for path in paths).most_common(1)[0]
    if times > 1:
        message = (
            f"{file} is given {times} times: its samples count as often, "
            "and errors look smaller than they are. Give each file once"
        )
        warn_caller(message)
        return
    height, width, channels, spp = source.shape
    if source.frames:
        spp = min(spp, max(BATCH, _LOOKED // (4 * height * width * channels)))
    names = [path.name for path in paths] if len(paths) == source.shape[3] else []
    with contextlib.suppress(StoreError):  # which is raised again when the samples are needed
        warn_of_repeats(source.read, (height, width, channels, spp), f"{source.path}", names)


class _Counted:
    """Samples with a different number for each pixel; beyond it, they read as NaN."""

    def __init__(self, source: SampleSource, counts: npt.NDArray[np.int32]) -> None:
        self._source, self._counts = source, counts
        self.path, self.shape, self.frames = source.path, source.shape, source.frames

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples."""
        absent = np.arange(self.shape[3])[ss] >= self._counts[ys, xs, np.newaxis, np.newaxis]
        return np.where(absent, np.float32(np.nan), self._source.read(ys, xs, ss))

    def read_features(self) -> dict[str, Image]:
        """Return the features of the source."""
        return self._source.read_features()


def _files(given: Sequence[str | Path]) -> list[Path]:
    """Return the files; those of a single folder in the order of their names."""
    paths = []
    for path in given:
        if not is_path(path):
            message = f"expected paths, one by one as in read(*files), got {path!r}"
            raise InputError(message)
        place = local(path)
        if not (os.path.isfile(place) or os.path.isdir(place)):  # noqa: PTH112, PTH113 - any text
            piped = ", but a pipe: write what it gives to a file" * os.path.exists(place)  # noqa: PTH110
            message = f"there is no file or folder at {reprlib.repr(str(path))}{piped}"
            raise StoreError(message)
        paths.append(Path(path).absolute())
    folder = paths[0]
    if len(paths) > 1 or folder.is_file() or _suffix(folder) == ".zarr":
        return list(paths)
    found = [f for f in sorted(folder.iterdir()) if f.is_file() and not f.name.startswith(".")]
    if not found:
        message = f"{folder} is an empty folder, expected files of samples"
        raise StoreError(message)
    return found


def _suffix(path: Path) -> str:
    """Return the suffix that tells the format of a file, or of a folder of any name."""
    return ".zarr" if any((path / name).exists() for name in ZARR) else path.suffix.lower()


def _format(paths: Sequence[Path], name: str | None) -> Format:
    """Return the format of a name, or the one whose suffix all files have."""
    found = set(map(_suffix, paths))
    for known in FORMATS:
        if known.name == name or (name is None and found <= {*known.suffixes}):
            return known
    if name is None and len(found) > 1:
        others = ", ".join(sorted(kind or "none" for kind in found))
        message = f"{paths[0].parent} gives files of several kinds, {others}: read those of one"
        raise InputError(message)
    kinds = ", ".join(f"{f.name} ({' '.join(f.suffixes)})" for f in FORMATS)
    asked = f"format {name!r}" if name else f"files such as {paths[0].name}"
    message = f"cannot read {asked}; known formats are {kinds}. Name one as format"
    raise InputError(message)


def _is_file(value: str | Path) -> bool:
    return Path(value).suffix.lower() in (".npy", ".exr") and Path(value).is_file()


def _feature(name: str, value: str | Path | npt.ArrayLike) -> Image:
    """Return a feature from an array or a file."""
    if isinstance(value, str | Path) and Path(value).suffix.lower() == ".exr":
        return read_feature(Path(value), name)
    return np.asarray(_loaded(value), np.float32)


def _loaded(value: str | Path | npt.ArrayLike) -> npt.ArrayLike:
    """Return an array, or the array in a .npy file."""
    return load_npy(Path(value)) if isinstance(value, str | Path) else value
