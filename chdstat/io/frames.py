"""Stacks of images: samples in files of one image each, decoded a batch at a time.

What is decoded is kept in temporary files, so that memory holds no more than an image, however
many samples there are, and parts of many images are read without decoding these again.

`open_exr` reads stacks of EXR files. Sources: Academy Software Foundation, "OpenEXR file layout",
https://openexr.com; the attributes that count samples are those that pbrt-v4 (``samplesPerPixel``,
src/pbrt/util/image.cpp) and Blender's Cycles (``cycles.<layer>.samples``) write.

`open_rawls` reads stacks of rawls files. Such a file begins with ``IHDR``, the size of what follows
in bytes, and width, height and number of channels, three uint32, apart by spaces or not;
``COMMENTS`` and lines of text, of which ``#Samples n`` says how many samples the image is the
average of; then ``DATA``, its size, and rows of pixels of float32, with a line break behind every
pixel or behind every row. Numbers are little endian. Sources: the writers of the format,
prise-3d/pbrt-v3 (src/core/imageio.cpp) and prise-3d/Pbrt-rawls-reader (rawls/rawls.cpp), which
break lines behind pixels, and the Python package rawls 1.1.7 (rawls/rawls.py), which does behind
rows and gives the size in binary.
"""

from __future__ import annotations

import itertools
import re
import struct
import tempfile
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, warn_caller
from chdstat.errors import InputError, StoreError
from chdstat.io.exr_planes import Planes, read_planes
from chdstat.io.reading import Opened, ReadOptions
from chdstat.samples.tiles import BATCH

__all__ = ["Frame", "Frames", "open_exr", "open_rawls"]

Frame = tuple[Image, Mapping[str, Image]]
"""One sample of each pixel, shape (y, x, channel), and features by name."""

_KEPT = 2**31
"""Bytes of decoded samples that temporary files keep, and one batch in any case."""
_COUNTED = re.compile(r"samplesPerPixel|cycles\..*\.samples")
"""Attributes that say how many samples an image is the average of."""


class Frames:
    """Samples that are decoded image by image, and features that are averages over the images.

    Parameters
    ----------
    path
        Where they lie, for messages.
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
        numbers = np.arange(self.shape[3])[ss]
        step = int(numbers[1] - numbers[0]) if len(numbers) > 1 else 1
        rows, columns = (range(n)[part] for n, part in zip(self.shape, (ys, xs), strict=False))
        found = np.empty((len(rows), len(columns), self.shape[2], len(numbers)), np.float32)
        for number in np.unique(numbers // BATCH):
            start, stop = np.searchsorted(numbers // BATCH, [number, number + 1])
            first, last = numbers[[start, stop - 1]] - number * BATCH
            batch = self._batch(int(number))[first : last + 1 : step, ys, xs]
            found[..., start:stop] = np.moveaxis(batch, 0, -1)
        return found

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
        # It has no name, so that it is gone when the process ends, in whatever way.
        try:
            file: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - kept open
        except OSError as error:
            raise self._without_room(error) from error
        try:
            for image, features in self._decode(samples):
                file.write(np.ascontiguousarray(image, np.float32).data)
                if number not in self._summed:
                    for name, feature in features.items():
                        self._sums[name] = self._sums.get(name, 0.0) + feature.astype(np.float64)
            file.flush()
        except OSError as error:
            file.close()
            raise self._without_room(error) from error
        except BaseException:
            file.close()
            raise
        self._summed.add(number)
        return file

    def _without_room(self, error: OSError) -> StoreError:
        return StoreError(
            f"cannot decode {self.path} into the temporary folder {tempfile.gettempdir()}: "
            f"{error.strerror or error}; TMPDIR names another"
        )


def _close(files: Mapping[int, IO[bytes]]) -> None:
    for file in files.values():
        file.close()


# --- EXR -----------------------------------------------------------------------------------------


def open_exr(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open EXR files of one sample, or one average, of each pixel.

    The samples are the colours of the image, or the layer `variable`; alpha is left out. Features
    are layers, and averages over all files, for what a pixel sees differs from sample to sample.
    """
    first, told = read_planes(paths[0]), set[str]()
    names = (
        first.layer(options.variable)
        if options.variable
        else first.main("give the layer of the samples as variable, one of")
    )
    layers = {name: first.layer(inside) for name, inside in options.features.items()}
    averaged = _averaged(first.attributes)

    def frame(planes: Planes) -> Frame:
        _check_equal(planes, first, [*names, *itertools.chain(*layers.values())])
        image = planes.image(names, colours=True)
        features = {n: planes.image(of, colours=n == "albedo") for n, of in layers.items()}
        for kind in planes.notes.keys() - told:
            told.add(kind)
            warn_caller(planes.notes[kind])
        return image, features

    def decode(samples: range) -> Iterator[Frame]:
        for number in samples:
            yield frame(read_planes(paths[number]) if number else first)

    shape = (*first.shape, len(names), len(paths))
    frame(first)  # what is to be said of it, is said now
    attrs = {"averaged": averaged} if averaged > 1 else {}
    return Opened(Frames(paths[0].parent, shape, decode, featured=bool(layers)), attrs)


def _check_equal(planes: Planes, first: Planes, names: Sequence[str]) -> None:
    """Refuse a file that is no further sample of what the first file shows."""
    path, counts = planes.path, [_averaged(p.attributes) for p in (planes, first)]
    if counts[0] != counts[1]:
        message = (
            f"{path} is an average of {counts[0]} samples, {first.path.name} of {counts[1]}: read "
            "them apart"
        )
        raise InputError(message)
    if not set(names) <= planes.channels.keys():
        held = ", ".join(planes.channels)
        message = f"{path} has channels {held}, but the first file {', '.join(names)}"
        raise InputError(message)
    if planes.window != first.window:
        shapes = [f"{p.shape} pixels" for p in (planes, first)]
        if planes.shape == first.shape:
            shapes = [f"a display window that begins at {p.window[:2]}" for p in (planes, first)]
        message = f"{path} has {shapes[0]}, but the first file {shapes[1]}"
        raise InputError(message)


def _averaged(attributes: Mapping[str, Any]) -> int:
    """Return how many samples an image says that it is the average of, or 1."""
    for name, value in attributes.items():
        if _COUNTED.fullmatch(name) and str(value).isdecimal():
            return max(int(value), 1)
    return 1


# --- rawls --------------------------------------------------------------------------------------

_LONGEST_HEADER = 2**16
_BEGIN = re.compile(
    rb"IHDR\n\d{1,9}\n(?:(.{4}) (.{4}) (.{4})|(.{4})(.{4})(.{4}))\nCOMMENTS\n", re.DOTALL
)


@dataclass(frozen=True)
class _Rawls:
    """A file: shape (y, x, channel), samples that it is the average of, where its pixels are."""

    path: Path
    shape: tuple[int, int, int]
    samples: int
    integrator: str
    start: int
    by_pixel: bool

    def image(self) -> Image:
        height, width, channels = self.shape
        rows, columns = (height * width, channels) if self.by_pixel else (height, width * channels)
        line = np.dtype([("values", "<f4", (columns,)), ("break", "u1")])
        lines = np.fromfile(self.path, line, count=rows, offset=self.start)
        if len(lines) < rows or (lines["break"] != ord("\n")).any():
            raise _damaged(self.path, "its lines do not end where they should")
        return lines["values"].reshape(self.shape).astype(np.float32)


def open_rawls(paths: Sequence[Path], _: ReadOptions) -> Opened:
    """Open .rawls files, each a sample or an average of some."""
    files = [_parsed(path) for path in paths]
    first = files[0]
    for file in files:
        if (file.shape, file.samples) != (first.shape, first.samples):
            message = (
                f"{file.path.name} holds averages of {file.samples} samples of shape (y, x, "
                f"channel) = {file.shape}, {first.path.name} of {first.samples}, {first.shape}"
            )
            raise InputError(message)

    def decode(samples: range) -> Iterator[Frame]:
        for number in samples:
            try:
                yield files[number].image(), {}
            except OSError as error:
                raise _damaged(paths[number], error.strerror or str(error)) from error

    attrs: dict[str, object] = {"averaged": first.samples} if first.samples > 1 else {}
    if first.integrator:
        attrs["integrator"] = first.integrator
    return Opened(Frames(paths[0].parent, (*first.shape, len(paths)), decode), attrs)


def _parsed(path: Path) -> _Rawls:
    """Return where the pixels of a file are, whose size must be what its header says."""
    try:
        with path.open("rb") as file:
            head = file.read(_LONGEST_HEADER)
        size = path.stat().st_size
    except OSError as error:
        raise _damaged(path, error.strerror or str(error)) from error
    begun = _BEGIN.match(head)
    stop = -1 if begun is None else head.find(b"\nDATA\n", begun.end() - 1)
    if begun is None or stop < 0:
        raise _damaged(path, "its header is none of this format")
    width, height, channels = (
        struct.unpack("<I", number)[0] for number in begun.groups() if number is not None
    )
    values = 4 * width * height * channels
    stop += len(b"\nDATA\n")
    sizes = (b"%d\n" % values, struct.pack("<Q", values)[:4] + b"\n")
    start = next((stop + len(s) for s in sizes if head.startswith(s, stop)), None)
    breaks = {values + width * height: True, values + height: False}
    if start is None or not values or size - start not in breaks:
        why = f"of {size} bytes, it cannot hold {width} x {height} pixels of {channels} channels"
        raise _damaged(path, why)
    comments = head[begun.end() : stop].decode("utf-8", errors="replace")
    found = {str(k): str(v) for k, v in re.findall(r"^#(Samples|Integrator) (\w+)", comments, re.M)}
    samples = found.get("Samples", "1")
    return _Rawls(
        path,
        (height, width, channels),
        max(int(samples), 1) if samples.isdecimal() and len(samples) < 10 else 1,
        found.get("Integrator", ""),
        start,
        breaks[size - start],
    )


def _damaged(path: Path, why: str) -> StoreError:
    return StoreError(f"cannot read {path} as a rawls file: {why}")
