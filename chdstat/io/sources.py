"""Sources: samples in files, read part by part, and how damage is reported.

`Frames` reads files of one image each, and decodes a batch at a time. Temporary files keep the
decoded samples, so that memory holds no more than one image, however many samples there are. Parts
of many images can then be read without decoding again.
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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image
from chdstat.errors import ChdstatError, StoreError
from chdstat.samples.layout import FOREIGN
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
