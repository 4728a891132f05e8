"""Sources: samples in files, read part by part, and how damage is reported.

`ArraySource` reads an array that slices index; it never reads an array whole. `Frames` reads files
of one image each, and decodes a batch at a time. Temporary files keep the decoded samples, so that
memory holds no more than one image, however many samples there are. Parts of many images can then
be read without decoding again.
"""

from __future__ import annotations

import contextlib
import tempfile
import threading
import tokenize
import weakref
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Image
from chdstat.errors import ChdstatError, InputError, StoreError
from chdstat.samples.layout import FOREIGN
from chdstat.samples.samples import single
from chdstat.samples.tiles import BATCH, SampleSource, gathered

DAMAGED = (
    *FOREIGN,
    EOFError,
    MemoryError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""Errors that damaged files may raise in NumPy, and in its readers of headers and archives."""
_KEPT = 2**31
"""Bytes of decoded samples that temporary files keep, but at least one batch."""

Frame = tuple[Image, Mapping[str, Image]]
"""One sample of every pixel, shape (y, x, channel), and features by name."""


@dataclass(frozen=True)
class ReadOptions:
    """A caller's options for reading files.

    Attributes
    ----------
    axes
        Order of the axes, as letters y, x, c and s; None if the files say it.
    variable
        Array or layer that holds the samples, if a file has several; None to find it.
    features
        Names of the features within the files, by their names here.
    """

    axes: str | None = None
    variable: str | None = None
    features: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Opened:
    """Samples in files: their source, and what the files say about them.

    Attributes
    ----------
    source
        Reads parts of the samples.
    attrs
        Provenance in the files; ``averaged`` if each value is an average of so many samples.
    counts
        Samples of each pixel, shape (y, x), if they differ.
    """

    source: SampleSource
    attrs: Mapping[str, Any] = field(default_factory=dict)
    counts: npt.NDArray[np.int32] | None = None


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn the errors of a damaged or missing file into one that names the file."""
    try:
        yield
    except ChdstatError:
        raise
    except DAMAGED as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        message = f"cannot read {path}: {why}"
        raise StoreError(message) from error


class ArraySource:
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


class Joined:
    """Samples of several sources of one size, concatenated."""

    def __init__(self, sources: Sequence[ArraySource]) -> None:
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


class Remapped:
    """An array in a file that is mapped into memory anew for each part that is read.

    Pages of a lasting map count as memory of the process, until the whole file does.
    """

    def __init__(self, mapped: Callable[[], Array]) -> None:
        self._mapped, array = mapped, mapped()
        self.shape, self.dtype, self.size = array.shape, array.dtype, array.size

    def __getitem__(self, index: Any) -> Array:
        return np.asarray(self._mapped()[index])


class Frames:
    """Samples that are decoded image by image, and features averaged over the images.

    Parameters
    ----------
    path
        Path of the images, for messages.
    shape
        (y, x, channel, sample).
    decode
        Returns the images of consecutive samples one by one.
    featured
        Whether the images have features.
    """

    frames = True

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int, int, int],
        decode: Callable[[range], Iterator[Frame]],
        *,
        featured: bool = False,
    ) -> None:
        self.path, self.shape = path, shape
        self._decode, self._featured = decode, featured
        self._files: OrderedDict[int, IO[bytes]] = OrderedDict()
        self._sums: dict[str, npt.NDArray[np.float64]] = {}
        self._summed: set[int] = set()
        self._lock = threading.Lock()
        weakref.finalize(self, _close, self._files)

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, shape (y, x, channel, sample)."""
        edges = *self.shape[:2], BATCH
        return gathered(
            self.shape, (ys, xs, ss), edges, lambda _y, _x, s: np.moveaxis(self._batch(s), 0, -1)
        )

    def read_features(self) -> dict[str, Image]:
        """Return features by name, each the average over all images."""
        if not self._featured:
            return {}
        for number in range(-(-self.shape[3] // BATCH)):
            if number not in self._summed:
                self._batch(number)
        return {n: (s / self.shape[3]).astype(np.float32) for n, s in self._sums.items()}

    def _batch(self, number: int) -> npt.NDArray[np.float32]:
        """Return decoded samples, shape (sample, y, x, channel), mapped from a temporary file."""
        samples = range(number * BATCH, min((number + 1) * BATCH, self.shape[3]))
        shape = (len(samples), *self.shape[:3])
        with self._lock:
            if number not in self._files:
                most = _KEPT // max(4 * int(np.prod(shape)), 1)
                while len(self._files) >= max(most, 1):
                    self._files.popitem(last=False)[1].close()
                self._files[number] = self._decoded(number, samples)
            self._files.move_to_end(number)
            return np.memmap(self._files[number], np.float32, mode="r", shape=shape)

    def _decoded(self, number: int, samples: range) -> IO[bytes]:
        """Return a nameless file of decoded samples, which disappears with the process."""
        try:
            with contextlib.ExitStack() as opened:
                file = opened.enter_context(tempfile.TemporaryFile())
                for image, features in self._decode(samples):
                    file.write(np.ascontiguousarray(image, np.float32).data)
                    if number not in self._summed:
                        for name, feature in features.items():
                            self._sums[name] = self._sums.get(name, 0.0) + feature.astype(float)
                file.flush()
                opened.pop_all()
        except OSError as error:
            message = (
                f"cannot decode {self.path} into the temporary folder {tempfile.gettempdir()}: "
                f"{error.strerror or error}; TMPDIR names another"
            )
            raise StoreError(message) from error
        self._summed.add(number)
        return file


def _close(files: Mapping[int, IO[bytes]]) -> None:
    for file in files.values():
        file.close()
