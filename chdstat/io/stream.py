"""Streams: samples in the order in which a renderer wrote them with ``chdstat_writer.h``.

A stream is a header and blocks; the page "Format of a stream" of the reference describes each byte.
A block of samples belongs to a tile of 64 x 64 pixels, and says which pixels have how many samples
in it. Threads write blocks as they are ready, so that the samples of a tile lie all over the file,
and those of a pixel in several blocks. Opening a stream reads the heads of the blocks; the samples
are read tile by tile, on demand.
"""

from __future__ import annotations

import enum
import itertools
import math
import os
import struct
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Image, Indices, warn_caller
from chdstat._core.files import checksum
from chdstat._core.work import check_memory
from chdstat.errors import InputError, StoreError
from chdstat.io.sources import Opened, ReadOptions, readable
from chdstat.samples.tiles import BATCH, gathered

_VERSION = 1
_EDGE = 64
"""Edge of the tiles of a stream, in pixels."""
_PIXELS = _EDGE * _EDGE
_COMPONENTS = {"albedo": 3, "normal": 3, "position": 3, "depth": 1}
"""Features that a stream may have, and their numbers of components."""
_MAGIC, _LITTLE = b"\x89CHDS\r\n\x1a", b"\x04\x03\x02\x01"
_HEADER, _BLOCK = struct.Struct("<8sI4s4I"), struct.Struct("<4s7I")
_HEAD = 4 * _PIXELS
"""Most bytes of a head."""
_MOST_PIXELS = 2**28
_LONGEST = 64
"""Most bytes of the names of features, with the checksum after them."""
_HELD = 2**25
"""Bytes of samples of a tile that are decoded together, unless `BATCH` of each pixel are more."""
_SHORT = 16
"""Samples of a pixel in a block up to which they are written one by one."""
_STRETCHES = 16
"""Stretches of pixels with equal numbers of samples up to which each is written at once."""
_KNOWN = ("scene", "renderer", "integrator", "unit")
_WHOLE = ("seed", "averaged")

_Tile = tuple[int, int]
"""Row and column of a tile."""


def get_include() -> Path:
    """Return the folder of ``chdstat_writer.h``, with which a C++ renderer writes its samples.

    The command ``g++ -I$(chdstat include)`` finds it.

    Examples
    --------
    >>> [header.name for header in get_include().iterdir()]
    ['chdstat_writer.h']
    """
    return Path(__file__).parent / "include"


def open_stream(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open streams of one image; the samples of each pixel are concatenated.

    Notes
    -----
    Read
        Samples of 1 to 64 channels, as many as each pixel has; features; attributes.
    Converted
        Sums of features to averages.
    Warned of
        A stream without an end, whose whole blocks are read; copies.
    Ignored
        Blocks of kinds that are not known.
    Refused
        Bytes that are not what was written; streams of other sizes; one seed in two files;
        ``axes``, ``variable``.
    """
    source = _StreamSource(paths)
    for name in options.features.values():
        if name not in source.header.features:
            held = ", ".join(source.header.features) or "none"
            message = f"{paths[0]} holds no feature {name!r}; it has {held}"
            raise InputError(message)
    equal = bool((source.counts == source.shape[3]).all())
    return Opened(source, source.attrs, None if equal else source.counts)


class _StreamSource:
    """Samples in streams, decoded tile by tile.

    Attributes
    ----------
    header
        Size and features.
    counts
        Samples of each pixel, shape (y, x).
    attrs
        Provenance that all files share.
    """

    frames = False

    def __init__(self, paths: Sequence[Path]) -> None:
        self.path = paths[0]
        with _File(self.path) as file:
            self.header = file.header
        self._components = sum(_COMPONENTS[name] for name in self.header.features)
        self._begins: dict[_Tile, dict[Path, array[int]]] = {}
        self._sums: dict[_Tile, Array] = {}
        told, total = [], dict[_Tile, Array]()
        seeds: dict[tuple[int, _Tile], npt.NDArray[np.bool_]] = {}
        for path in paths:
            attrs, counts = self._add(path)
            told.append(attrs)
            if "seed" in attrs:
                _check_seeds(seeds, attrs["seed"], counts, path)
            for tile, number in counts.items():
                total[tile] = total.get(tile, 0) + number
        self.attrs = {k: v for k, v in told[0].items() if all(o.get(k) == v for o in told)}
        self.counts = self._image(total).astype(np.int32)
        self._features = self._averages()
        height, width = self.counts.shape
        self.shape = (height, width, self.header.channels, int(self.counts.max()))
        if not self.shape[3]:
            message = f"{self.path} holds no samples"
            raise StoreError(message)
        self._window = max(_HELD // (4 * _PIXELS * self.shape[2]) // BATCH, 1) * BATCH
        self._last: tuple[tuple[int, int, int], Image] | None = None

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, shape (y, x, channel, sample), NaN where there are none."""
        return gathered(self.shape, (ys, xs, ss), (_EDGE, _EDGE, self._window), self._decoded)

    def read_features(self) -> dict[str, Image]:
        """Return the first-hit features: averages of added values, 0 where there are none."""
        return dict(self._features)

    def _decoded(self, y: int, x: int, window: int) -> Image:
        """Return a tile with a window of its samples; another part of it may be read next."""
        last = self._last
        if last is None or last[0] != (y, x, window):
            last = self._last = (y, x, window), self._decode(y, x, window)
        return last[1]

    def _decode(self, y: int, x: int, window: int) -> Image:
        channels, spp = self.shape[2:]
        low = window * self._window
        high = min(low + self._window, spp)
        rows, columns = slice(y * _EDGE, (y + 1) * _EDGE), slice(x * _EDGE, (x + 1) * _EDGE)
        counts = self.counts[rows, columns]
        tile = np.empty((_PIXELS, channels, high - low), np.float32)
        if counts.min() < high:
            tile.fill(np.nan)
        seen = np.zeros(_PIXELS, np.intp)
        for path, begins in self._begins[y, x].items() if counts.max() > low else ():
            with _File(path) as file:
                for begin in begins:
                    block = file.block(begin)
                    if block is None:
                        raise file.damaged(begin, "it has changed since it was opened")
                    pixels, numbers = block.pixels()
                    first = seen[pixels]
                    seen[pixels] += numbers
                    if first.min() < high and (first + numbers).max() > low:
                        values = np.frombuffer(file.body(block), "<f4")
                        _place(tile, values, pixels, numbers, first - low)
        tile.flags.writeable = False  # parts of it are handed out
        return tile.reshape(_EDGE, _EDGE, channels, high - low)

    def _add(self, path: Path) -> tuple[dict[str, Any], dict[_Tile, Array]]:
        """Add the blocks of a file; return its provenance and the samples per pixel."""
        told: dict[str, str] = {}
        counts: dict[_Tile, Array] = {}
        ended, total = False, -1
        with _File(path) as file:
            if file.header != self.header:
                message = (
                    f"{path} is of another image, {file.header}, than the first, {self.header}"
                )
                raise InputError(message)
            begin = file.begin
            while not ended and (block := file.block(begin)):
                if block.kind in (_Kind.SAMPLES, _Kind.FEATURES):
                    self._count(block, begin, counts, file)
                elif block.kind == _Kind.ATTRIBUTE:
                    told[_text(block.head)] = _text(file.body(block))
                elif block.kind == _Kind.END:
                    ended, total = True, int.from_bytes(block.head, "little")
                begin = block.body + block.size
        count = sum(int(of_tile.sum()) for of_tile in counts.values())
        if not ended:
            message = (
                f"{path} has no end: its renderer was stopped, or is at work. The {count} samples "
                "that are there are read"
            )
            warn_caller(message)
        elif begin != file.size or total != count:
            raise file.damaged(begin, f"it does not end with its {count} samples")
        return _provenance(told), counts

    def _count(self, block: _Block, begin: int, counts: dict[_Tile, Array], file: _File) -> None:
        """Count the samples, or add the features, of a block."""
        tile = block.y // _EDGE, block.x // _EDGE
        inside = block.y < self.header.height and block.x < self.header.width
        beside = block.x % _EDGE or block.y % _EDGE
        if not inside or beside or not block.head or len(block.head) % 4:
            raise file.damaged(begin, "a block does not fit the image")
        pixels, numbers = block.pixels()
        samples = block.kind == _Kind.SAMPLES
        values = numbers.sum() * self.header.channels if samples else len(pixels) * self._components
        if block.size != 4 * values or pixels[-1] >= _PIXELS or (np.diff(pixels) <= 0).any():
            raise file.damaged(begin, "a block does not fit its pixels")
        if samples:
            counts.setdefault(tile, np.zeros(_PIXELS, np.int64))[pixels] += numbers
            self._begins.setdefault(tile, {}).setdefault(file.path, array("Q")).append(begin)
        else:
            sums = np.frombuffer(file.body(block), "<f4").reshape(len(pixels), -1)
            empty = np.zeros((_PIXELS, self._components + 1))
            self._sums.setdefault(tile, empty)[pixels] += np.column_stack([sums, numbers])

    def _averages(self) -> dict[str, Image]:
        """Return averages of the features, (y, x, component), depth (y, x)."""
        if not self.header.features:
            return {}
        *sums, weights = np.moveaxis(self._image(self._sums, self._components + 1), -1, 0)
        means = np.stack(sums, axis=-1) / np.maximum(weights, 1)[..., np.newaxis]
        ends = np.cumsum([_COMPONENTS[name] for name in self.header.features])
        parts = np.split(means.astype(np.float32), ends[:-1], axis=-1)
        named = zip(self.header.features, parts, strict=True)
        return {n: x[..., 0] if x.shape[2] == 1 else x for n, x in named}

    def _image(self, tiles: dict[_Tile, Array], *components: int) -> Array:
        """Return an image (y, x, ...) of the existing tiles, zero elsewhere."""
        height, width = self.header.height, self.header.width
        size = 8 * math.prod((height, width, *components))
        check_memory(3 * size, f"{width} x {height} pixels", "render a part of them")
        image = np.zeros((height, width, *components))
        for (y, x), values in tiles.items():
            part = image[y * _EDGE : (y + 1) * _EDGE, x * _EDGE : (x + 1) * _EDGE]
            tile = values.reshape(_EDGE, _EDGE, *components)
            part[:] = tile[: part.shape[0], : part.shape[1]]
            if tile[part.shape[0] :].any() or tile[:, part.shape[1] :].any():
                message = "a stream has samples outside of its image"
                raise StoreError(message)
        return image


def _check_seeds(
    seeds: dict[tuple[int, _Tile], npt.NDArray[np.bool_]],
    seed: int,
    counts: Mapping[_Tile, Array],
    path: Path,
) -> None:
    """Refuse a file with the random numbers of another file, and note its seed."""
    for tile, number in counts.items():
        before = seeds.get((seed, tile), np.zeros(_PIXELS, bool))
        if (before & (number > 0)).any():
            message = (
                f"{path} repeats pixels of seed {seed}, which are in another of the files: "
                "errors would look smaller than they are. Render with another seed"
            )
            raise InputError(message)
        seeds[seed, tile] = before | (number > 0)


def _place(tile: Image, values: Image, pixels: Indices, numbers: Indices, first: Indices) -> None:
    """Write samples of a block into a tile (pixel, channel, sample), from `first` of each pixel."""
    changes = np.flatnonzero(np.diff(numbers) | np.diff(first)) + 1
    if len(changes) > _STRETCHES:
        _place_each(tile, values, pixels, numbers, first)
        return
    ends = tile.shape[1] * np.cumsum(numbers)
    for a, b in itertools.pairwise([0, *changes, len(pixels)]):
        some = values[ends[a - 1] if a else 0 : ends[b - 1]].reshape(-1, numbers[a])
        _place_equal(tile, some, pixels[a:b], int(first[a]))


def _place_equal(tile: Image, values: Image, pixels: Indices, first: int) -> None:
    """Write equal numbers of samples; `values` has a row for each pixel and channel."""
    _, channels, spp = tile.shape
    where: Any = slice(pixels[0] * channels, (pixels[-1] + 1) * channels)
    if len(pixels) <= pixels[-1] - pixels[0]:  # there are gaps
        where = (pixels[:, np.newaxis] * channels + np.arange(channels)).ravel()
    low, high = max(first, 0), min(first + values.shape[1], spp)
    rows, values = tile.reshape(-1, spp), values[:, max(low - first, 0) : max(high - first, 0)]
    if values.shape[1] > _SHORT:
        rows[where, low:high] = values
    else:  # a column at a time: NumPy is slow with short rows
        for column in range(low, high):
            rows[where, column] = values[:, column - low]


def _place_each(
    tile: Image, values: Image, pixels: Indices, numbers: Indices, first: Indices
) -> None:
    """Write numbers of samples that differ from pixel to pixel."""
    _, channels, spp = tile.shape
    # Each pixel and channel is a row of values, cut where the tile's samples begin and end.
    skipped, kept = np.clip(-first, 0, numbers), np.clip(spp - first, 0, numbers)
    lengths, channel = np.repeat(kept - skipped, channels), np.arange(channels)
    ends = np.cumsum(lengths)
    begins, places = ends - lengths, np.arange(ends[-1], dtype=np.int32)
    if ends[-1] < len(values):
        of = channels * (np.cumsum(numbers) - numbers) + skipped
        of_each = (of[:, np.newaxis] + numbers[:, np.newaxis] * channel).ravel()
        values = values[places + np.repeat((of_each - begins).astype(np.int32), lengths)]
    to = (pixels[:, np.newaxis] * channels + channel) * spp + (first + skipped)[:, np.newaxis]
    places += np.repeat((to.ravel() - begins).astype(np.int32), lengths)
    tile.reshape(-1)[places] = values


def _provenance(told: Mapping[str, str]) -> dict[str, Any]:
    """Return attributes that identify samples, and all others as settings of the renderer."""
    attrs: dict[str, Any] = {k: told[k] for k in _KNOWN if k in told}
    for name in _WHOLE:
        text = told.get(name, "")
        if text.removeprefix("-").isascii() and text.removeprefix("-").isdigit():
            attrs[name] = int(text[:20])
    others = {k: v for k, v in told.items() if k not in attrs}
    return {**attrs, "renderer_settings": others} if others else attrs


# --- blocks ---------------------------------------------------------------------------------------


class _Kind(enum.IntEnum):
    """Kinds of blocks."""

    SAMPLES = 1
    FEATURES = 2
    ATTRIBUTE = 3
    END = 4


class Header(NamedTuple):
    """The common properties of all blocks of a stream."""

    width: int
    height: int
    channels: int
    features: tuple[str, ...]


class _Block(NamedTuple):
    """A block without its body, and the place of the body in the file."""

    kind: int
    x: int
    y: int
    head: bytes
    body: int
    size: int
    checksum: int

    def pixels(self) -> tuple[Indices, Indices]:
        """Return pixels within the tile, and how many samples each has."""
        pairs = np.frombuffer(self.head, "<u2").reshape(-1, 2).astype(np.intp)
        return pairs[:, 0], pairs[:, 1]


class _File:
    """A stream that is open while it is entered: its size, header, and where blocks begin."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with readable(path):
            self._file = path.open("rb", buffering=0)

    def __enter__(self) -> _File:
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            self.header, self.begin = self._header()
        except BaseException:
            self._file.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _header(self) -> tuple[Header, int]:
        start = self._file.read(_HEADER.size + _LONGEST)
        if len(start) < _HEADER.size + 4 or not start.startswith(_MAGIC):
            message = f"{self.path} is no stream of samples, as chdstat_writer.h writes it"
            raise StoreError(message)
        _, version, order, width, height, channels, length = _HEADER.unpack_from(start)
        if order != _LITTLE:
            message = f"{self.path} was written with another order of bytes than little-endian"
            raise StoreError(message)
        if version != _VERSION:
            message = f"{self.path} has version {version}, this chdstat reads {_VERSION}"
            raise StoreError(message)
        end = _HEADER.size + length
        held = start[end : end + 4]
        if len(held) < 4 or int.from_bytes(held, "little") != checksum(start[:end]):
            raise self.damaged(0, "its header is not what was written")
        features = tuple(_text(start[_HEADER.size : end]).split())
        sizes = (1 <= size <= 2**16 for size in (width, height, channels * 2**10))
        named = set(features) <= set(_COMPONENTS) and len(set(features)) == len(features)
        if not all(sizes) or width * height > _MOST_PIXELS or not named:
            raise self.damaged(0, "its header describes no image")
        return Header(width, height, channels, features), end + 4

    def block(self, begin: int) -> _Block | None:
        """Return the block at a place, without its body; None if the file ends before it."""
        self._file.seek(begin)
        start = self._file.read(_BLOCK.size + _HEAD)
        if len(start) < _BLOCK.size:
            return None
        mark, kind, x, y, head, body, of_head, of_body = _BLOCK.unpack_from(start)
        end = _BLOCK.size + head
        if mark != b"CHDB" or head > _HEAD:
            raise self.damaged(begin, "there is no block")
        if len(start) < end:
            return None
        if checksum(start[: _BLOCK.size - 8] + start[_BLOCK.size : end]) != of_head:
            raise self.damaged(begin, "a block is not what was written")
        found = _Block(kind, x, y, start[_BLOCK.size : end], begin + end, body, of_body)
        return found if found.body + body <= self.size else None

    def body(self, block: _Block) -> bytes:
        """Return the body of a block."""
        self._file.seek(block.body)
        found = self._file.read(block.size)
        if len(found) != block.size or checksum(found) != block.checksum:
            raise self.damaged(block.body, "samples are not what was written")
        return found

    def damaged(self, begin: int, what: str) -> StoreError:
        """Return the error for a file that was changed after writing."""
        return StoreError(f"{self.path} is damaged at byte {begin}: {what}")


def _text(found: bytes) -> str:
    """Return UTF-8 text, with a mark for each byte that is not UTF-8."""
    return found.decode("utf-8", errors="replace")
