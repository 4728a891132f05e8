"""Streams: samples that a renderer wrote with ``chdstat_writer.h``, as they came.

A stream is a header and blocks. A block of samples belongs to a tile of 64 x 64 pixels and says
which of them have how many samples in it; its place in the file is when a thread wrote it, so the
samples of a tile lie all over the file, and of a pixel some may lie in one block, some in another.
Opening a stream reads what blocks say of themselves, one after the other; their samples are read
tile by tile, when they are asked for.
"""

from __future__ import annotations

import itertools
import math
import os
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, warn_caller
from chdstat._core.work import check_memory
from chdstat.errors import InputError, StoreError
from chdstat.io.reading import Opened, ReadOptions
from chdstat.io.stream_blocks import (
    COMPONENTS,
    EDGE,
    PIXELS,
    Block,
    Indices,
    Kind,
    damaged,
    opened,
    read_block,
    read_body,
    read_header,
    text,
)
from chdstat.samples.tiles import BATCH

__all__ = ["StreamSource", "get_include", "open_stream"]

_HELD = 2**25
"""Bytes of samples of a tile that are decoded at once, unless `BATCH` of each pixel are more."""
_SHORT = 16
"""Samples of a pixel in a block up to which they are written one by one."""
_STRETCHES = 16
"""Stretches of pixels with equally many samples in a block up to which each is written at once."""
_KNOWN = ("scene", "renderer", "integrator", "unit")
_WHOLE = ("seed", "averaged")

Tile = tuple[int, int]
"""Row and column of a tile."""
_Tiles = dict[Tile, npt.NDArray[Any]]


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
    """Open streams of one image, whose samples follow each other in every pixel."""
    source = StreamSource(paths)
    for name in options.features.values():
        if name not in source.header.features:
            held = ", ".join(source.header.features) or "none"
            message = f"{paths[0]} holds no feature {name!r}; it has {held}"
            raise InputError(message)
    equal = bool((source.counts == source.shape[3]).all())
    return Opened(source, source.attrs, None if equal else source.counts)


class StreamSource:
    """Samples in streams, decoded tile by tile.

    Attributes
    ----------
    header
        Size and features.
    counts
        Samples of each pixel, shape (y, x).
    attrs
        Provenance: what all the files say.
    """

    frames = False

    def __init__(self, paths: Sequence[Path]) -> None:
        self.path = paths[0]
        index = _Index(self.path)
        for path in paths:
            index.add(path)
        self.header, self._begins, self.attrs = index.header, index.begins, index.attrs()
        self.counts, self._features = index.counts(), index.features()
        height, width = self.counts.shape
        self.shape = (height, width, self.header.channels, int(self.counts.max()))
        if not self.shape[3]:
            message = f"{self.path} holds no samples"
            raise StoreError(message)
        self._window = max(_HELD // (4 * PIXELS * self.shape[2]) // BATCH, 1) * BATCH
        self._last: tuple[tuple[int, int, int], Image] | None = None

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, shape (y, x, channel, sample), NaN where there are none."""
        height, width, channels, spp = self.shape
        rows, columns, samples = range(height)[ys], range(width)[xs], range(spp)[ss]
        cuts = (_cuts(rows, EDGE), _cuts(columns, EDGE), _cuts(samples, self._window))
        part = np.empty((len(rows), len(columns), channels, len(samples)), np.float32)
        for (y, to_y, of_y), (x, to_x, of_x), (window, to_s, of_s) in itertools.product(*cuts):
            found = self._decoded(y, x, window)[of_y, of_x, :, of_s]
            if found.shape == part.shape:
                return found  # without a copy
            part[to_y, to_x, :, to_s] = found
        return part

    def read_features(self) -> dict[str, Image]:
        """Return the first-hit features: averages of what was added, 0 where nothing was."""
        return dict(self._features)

    def _decoded(self, y: int, x: int, window: int) -> Image:
        """Return a tile with a window of its samples, of which another part may be asked next."""
        last = self._last
        if last is None or last[0] != (y, x, window):
            last = self._last = (y, x, window), self._decode(y, x, window)
        return last[1]

    def _decode(self, y: int, x: int, window: int) -> Image:
        channels, spp = self.shape[2:]
        low = window * self._window
        high = min(low + self._window, spp)
        rows, columns = slice(y * EDGE, (y + 1) * EDGE), slice(x * EDGE, (x + 1) * EDGE)
        counts = self.counts[rows, columns]
        shape = (PIXELS, channels, high - low)
        tile = np.empty(shape, np.float32)
        if counts.min() < high:
            tile.fill(np.nan)
        seen = np.zeros(PIXELS, np.intp)
        for path, begins in self._begins[y, x].items() if counts.max() > low else ():
            with opened(path) as file:
                size = os.fstat(file.fileno()).st_size
                for begin in begins:
                    block = read_block(file, begin, size, path)
                    if block is None:
                        raise damaged(path, begin, "it has changed since it was opened")
                    pixels, numbers = block.pixels()
                    first = seen[pixels]
                    seen[pixels] += numbers
                    if first.min() < high and (first + numbers).max() > low:
                        values = np.frombuffer(read_body(file, block, path), "<f4")
                        _place(tile, values, pixels, numbers, first - low)
        tile.flags.writeable = False  # parts of it are handed out
        return tile.reshape(EDGE, EDGE, channels, high - low)


class _Index:
    """What the blocks of streams say of themselves, read one after the other, by tile."""

    def __init__(self, path: Path) -> None:
        with opened(path) as file:
            self.header, _ = read_header(file, path)
        self._components = sum(COMPONENTS[name] for name in self.header.features)
        self._counts: _Tiles = {}
        self._features: _Tiles = {}
        self._attrs: list[dict[str, Any]] = []
        self._seeds: dict[tuple[int, Tile], npt.NDArray[np.bool_]] = {}
        self.begins: dict[Tile, dict[Path, array[int]]] = {}

    def add(self, path: Path) -> None:
        """Add the blocks of a file."""
        told: dict[str, str] = {}
        counts: _Tiles = {}
        ended, total = False, -1
        with opened(path) as file:
            header, begin = read_header(file, path)
            if header != self.header:
                message = f"{path} is of another image, {header}, than the first, {self.header}"
                raise InputError(message)
            size = os.fstat(file.fileno()).st_size
            while not ended and (block := read_block(file, begin, size, path)):
                if block.kind in (Kind.SAMPLES, Kind.FEATURES):
                    self._add(block, begin, counts, file, path)
                elif block.kind == Kind.ATTRIBUTE:
                    told[text(block.head)] = text(read_body(file, block, path))
                elif block.kind == Kind.END:
                    ended, total = True, int.from_bytes(block.head, "little")
                begin = block.body + block.size
        count = sum(int(of_tile.sum()) for of_tile in counts.values())
        if not ended:
            message = (
                f"{path} has no end: its renderer was stopped, or is at work. The {count} samples "
                "that are there are read"
            )
            warn_caller(message)
        elif begin != size or total != count:
            raise damaged(path, begin, f"it does not end with its {count} samples")
        self._attrs.append(_provenance(told))
        self._merge(counts, path)

    def _add(self, block: Block, begin: int, counts: _Tiles, file: BinaryIO, path: Path) -> None:
        """Count the samples, or add the features, of a block."""
        tile = block.y // EDGE, block.x // EDGE
        inside = block.y < self.header.height and block.x < self.header.width
        if not inside or block.x % EDGE or block.y % EDGE or not block.head or len(block.head) % 4:
            raise damaged(path, begin, "a block does not fit the image")
        pixels, numbers = block.pixels()
        samples = block.kind == Kind.SAMPLES
        values = numbers.sum() * self.header.channels if samples else len(pixels) * self._components
        if block.size != 4 * values or pixels[-1] >= PIXELS or (np.diff(pixels) <= 0).any():
            raise damaged(path, begin, "a block does not fit its pixels")
        if samples:
            counts.setdefault(tile, np.zeros(PIXELS, np.int64))[pixels] += numbers
            self.begins.setdefault(tile, {}).setdefault(path, array("Q")).append(begin)
        else:
            sums = np.frombuffer(read_body(file, block, path), "<f4").reshape(len(pixels), -1)
            added = np.column_stack([sums, numbers])
            empty = np.zeros((PIXELS, self._components + 1))
            self._features.setdefault(tile, empty)[pixels] += added

    def _merge(self, counts: _Tiles, path: Path) -> None:
        """Add the samples of a file, unless its random numbers are those of another."""
        seed = self._attrs[-1].get("seed")
        for tile, number in counts.items():
            self._counts[tile] = self._counts.get(tile, 0) + number
            if seed is not None:
                before = self._seeds.get((seed, tile), np.zeros(PIXELS, bool))
                if (before & (number > 0)).any():
                    message = (
                        f"{path} repeats pixels of seed {seed}, which are in another of the files: "
                        "errors would look smaller than they are. Render with another seed"
                    )
                    raise InputError(message)
                self._seeds[seed, tile] = before | (number > 0)

    def attrs(self) -> dict[str, Any]:
        """Return what all files say of where they come from."""
        first, *others = self._attrs
        return {k: v for k, v in first.items() if all(o.get(k) == v for o in others)}

    def counts(self) -> npt.NDArray[np.int32]:
        """Return the samples of each pixel, shape (y, x)."""
        return self._image(self._counts).astype(np.int32)

    def features(self) -> dict[str, Image]:
        """Return averages of the features, (y, x, component), depth (y, x)."""
        if not self.header.features:
            return {}
        *sums, weights = np.moveaxis(self._image(self._features, self._components + 1), -1, 0)
        means = np.stack(sums, axis=-1) / np.maximum(weights, 1)[..., np.newaxis]
        found, first = {}, 0
        for name in self.header.features:
            last = first + COMPONENTS[name]
            image = means[..., first:last].astype(np.float32)
            found[name], first = image[..., 0] if last == first + 1 else image, last
        return found

    def _image(self, tiles: _Tiles, *components: int) -> npt.NDArray[Any]:
        """Return an image (y, x, ...) of the tiles that there are, zero elsewhere."""
        height, width = self.header.height, self.header.width
        size = 8 * math.prod((height, width, *components))
        check_memory(3 * size, f"{width} x {height} pixels", "render a part of them")
        image = np.zeros((height, width, *components))
        for (y, x), values in tiles.items():
            part = image[y * EDGE : (y + 1) * EDGE, x * EDGE : (x + 1) * EDGE]
            tile = values.reshape(EDGE, EDGE, *components)
            part[:] = tile[: part.shape[0], : part.shape[1]]
            if tile[part.shape[0] :].any() or tile[:, part.shape[1] :].any():
                message = "a stream has samples outside of its image"
                raise StoreError(message)
        return image


def _place(tile: Image, values: Image, pixels: Indices, numbers: Indices, first: Indices) -> None:
    """Write samples of a block into a tile (pixel, channel, sample): those of each from `first`."""
    changes = np.flatnonzero(np.diff(numbers) | np.diff(first)) + 1
    if len(changes) > _STRETCHES:
        _place_each(tile, values, pixels, numbers, first)
        return
    ends = tile.shape[1] * np.cumsum(numbers)
    for a, b in itertools.pairwise([0, *changes, len(pixels)]):
        some = values[ends[a - 1] if a else 0 : ends[b - 1]].reshape(-1, numbers[a])
        _place_equal(tile, some, pixels[a:b], int(first[a]))


def _place_equal(tile: Image, values: Image, pixels: Indices, first: int) -> None:
    """Write as many samples of each pixel: `values` has a row for each pixel and channel."""
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
    # Each pixel and channel is a row of values, cut where the samples of the tile begin and end.
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


def _cuts(places: range, edge: int) -> Iterator[tuple[int, slice, slice]]:
    """Cut places along an axis into tiles: yield the tile, and where they lie in both."""
    for tile in range(places[0] // edge, places[-1] // edge + 1) if places else ():
        ends = (tile * edge, (tile + 1) * edge)
        i, j = (min(max(-((places.start - e) // places.step), 0), len(places)) for e in ends)
        if i < j:
            inside = slice(places[i] - ends[0], places[j - 1] - ends[0] + 1, places.step)
            yield tile, slice(i, j), inside


def _provenance(told: Mapping[str, str]) -> dict[str, Any]:
    """Return attributes by which samples are known, and all others as settings of the renderer."""
    attrs: dict[str, Any] = {k: told[k] for k in _KNOWN if k in told}
    for name in _WHOLE:
        text = told.get(name, "")
        if text.removeprefix("-").isascii() and text.removeprefix("-").isdigit():
            attrs[name] = int(text[:20])
    others = {k: v for k, v in told.items() if k not in attrs}
    return {**attrs, "renderer_settings": others} if others else attrs
