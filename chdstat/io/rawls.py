"""Rawls files: images, each a sample or an average of some.

A file begins with ``IHDR``, the size of what follows in bytes, and width, height and number of
channels, three uint32, apart by spaces or not; ``COMMENTS`` and lines of text, of which
``#Samples n`` says how many samples the image is the average of; then ``DATA``, its size, and rows
of pixels of float32, with a line break behind every pixel or behind every row. Numbers are little
endian.

Sources: the writers of the format, prise-3d/pbrt-v3 (src/core/imageio.cpp) and
prise-3d/Pbrt-rawls-reader (rawls/rawls.cpp), which break lines behind pixels, and the Python
package rawls 1.1.7 (rawls/rawls.py), which does behind rows and gives the size in binary.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chdstat._core.arrays import Image
from chdstat.errors import InputError, StoreError
from chdstat.io.lazy import Frame, Frames, Opened, ReadOptions, readable

__all__ = ["open_rawls"]

_LONGEST_HEADER = 2**16
_BEGIN = re.compile(
    rb"IHDR\n\d{1,9}\n(?:(.{4}) (.{4}) (.{4})|(.{4})(.{4})(.{4}))\nCOMMENTS\n", re.DOTALL
)


@dataclass(frozen=True)
class _Rawls:
    """A file: shape (y, x, channel), samples that it is the average of, where its lines are."""

    path: Path
    shape: tuple[int, int, int]
    samples: int
    integrator: str
    start: int
    lines: int

    def image(self) -> Image:
        values = int(np.prod(self.shape)) // self.lines
        line = np.dtype([("values", "<f4", (values,)), ("break", "u1")])
        with readable(self.path, "a rawls file"):
            lines = np.fromfile(self.path, line, count=self.lines, offset=self.start)
        if len(lines) < self.lines or (lines["break"] != ord("\n")).any():
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
            yield files[number].image(), {}

    attrs: dict[str, object] = {"averaged": first.samples} if first.samples > 1 else {}
    if first.integrator:
        attrs["integrator"] = first.integrator
    return Opened(Frames(paths[0].parent, (*first.shape, len(paths)), decode), attrs)


def _parsed(path: Path) -> _Rawls:
    """Return where the pixels of a file are, whose size must be what its header says."""
    with readable(path, "a rawls file"), path.open("rb") as file:
        head, size = file.read(_LONGEST_HEADER), path.stat().st_size
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
    lines = 0 if start is None else size - start - values
    if start is None or not values or lines not in (width * height, height):
        why = f"of {size} bytes, it cannot hold {width} x {height} pixels of {channels} channels"
        raise _damaged(path, why)
    comments = head[begun.end() : stop].decode("utf-8", errors="replace")
    found = {str(k): str(v) for k, v in re.findall(r"^#(Samples|Integrator) (\w+)", comments, re.M)}
    count = found.get("Samples", "1")
    samples = max(int(count), 1) if count.isdecimal() and len(count) < 10 else 1
    shape = (height, width, channels)
    return _Rawls(path, shape, samples, found.get("Integrator", ""), start, lines)


def _damaged(path: Path, why: str) -> StoreError:
    return StoreError(f"cannot read {path} as a rawls file: {why}")
