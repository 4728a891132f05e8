"""Tiles and other parts of an image: how it is cut for drawing, keeping and computing.

A `Chunk` is what is drawn, kept and read at once. A `Region` is a part of the image that shows
something. `chdstat.samples.assembly` computes tile by tile.
"""

from __future__ import annotations

import itertools
import math
import reprlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypedDict, TypeGuard

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, Mapped, spans
from chdstat._core.files import Cache
from chdstat._core.progress import portion
from chdstat.errors import InputError

if TYPE_CHECKING:
    from distributed import Client

    from chdstat.samples.costs import SampleCosts

TILE, BATCH = 64, 64
"""Edge in pixels and number of samples of a chunk, the unit of drawing, keeping and reading."""
DIRECT_DEPTH = 2
"""Segments of a path from the camera to a light that shines on what the camera sees."""
_EDGE = TILE
"""Largest edge in pixels of a tile for computing."""
_MOST_BYTES = 8 * 2**20
"""Largest size of a tile with all its samples, unless that of a single pixel is larger."""
_AT_ONCE = 3 * 2**20
"""Most bytes of samples that statistics take at once, as their work holds many times as much."""
ALL = slice(None)

FILM = 0
"""The part of a sample before its path begins: where it fell in its pixel."""

LightPart = int | str
"""A part of samples: paths of up to this many segments, lights of this name, or `FILM`."""
SampleBlocks = Iterator[Image]
"""Samples of a tile, batch by batch, each (y, x, channel, sample)."""


def is_depth(part: LightPart) -> TypeGuard[int]:
    """Return whether a part holds paths of up to so many segments.

    Examples
    --------
    >>> [is_depth(part) for part in (2, "lamp", FILM)]
    [True, False, False]
    """
    return isinstance(part, int) and part != FILM


class Work(TypedDict, total=False):
    """How to work on tiles, see `over_tiles`."""

    progress: bool
    workers: int | None
    client: Client | None
    checkpoint: Cache | None


class SampleSource(Protocol):
    """A source that samples are read from on demand: a store, or files of another program."""

    frames: bool
    """Whether samples of one number lie together, and those of a pixel apart."""

    @property
    def path(self) -> Path:
        """Path of the source."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample)."""

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, NaN where a pixel has no more."""

    def read_features(self) -> dict[str, Image]:
        """Return the first-hit features by name."""


@dataclass(frozen=True)
class Region:
    """A part of the image that shows one phenomenon.

    Parameters
    ----------
    name
        A short name.
    phenomenon
        One of `chdstat.rendering.recipes.PHENOMENA`, or the name of a pattern for a region that the
        library chose.
    rectangle
        Left, top, right, bottom as fractions of the image, origin at the top left.
    note
        What can be seen there.
    """

    name: str
    phenomenon: str
    rectangle: tuple[float, float, float, float]
    note: str = ""

    def __post_init__(self) -> None:
        given = tuple(self.rectangle)
        numbers = len(given) == 4 and all(type(v) in (int, float) for v in given)
        if not (numbers and 0 <= given[0] < given[2] <= 1 and 0 <= given[1] < given[3] <= 1):
            message = (
                f"rectangle of region {self.name!r} must be (left, top, right, bottom) as "
                "fractions of the image, 0 <= left < right <= 1, top < bottom alike, got "
                f"{reprlib.repr(given)}"
            )
            raise InputError(message)
        object.__setattr__(self, "rectangle", tuple(map(float, given)))

    def pixels(self, height: int, width: int) -> tuple[slice, slice]:
        """Return the rows and columns that the region covers, at least one of each.

        Examples
        --------
        >>> Region("wall", "diffuse", (0.5, 0.25, 0.75, 0.5)).pixels(8, 16)
        (slice(2, 4, None), slice(8, 12, None))
        """
        left, top, right, bottom = self.rectangle
        return _covered(top, bottom, height), _covered(left, right, width)

    def center(self, height: int, width: int) -> tuple[int, int]:
        """Return (y, x) of the pixel in the middle."""
        ys, xs = self.pixels(height, width)
        return (ys.start + ys.stop - 1) // 2, (xs.start + xs.stop - 1) // 2


def _covered(low: float, high: float, length: int) -> slice:
    start = min(round(low * length), length - 1)
    return slice(start, min(max(round(high * length), start + 1), length))


@dataclass(frozen=True)
class Chunk:
    """One unit of rendering and storage: a tile of pixels times a batch of samples.

    `missing`, shape (y, x, sample), marks the samples to be drawn, if they are not all. `costs` is
    what they took, once they are drawn and if they were timed.
    """

    batch: int
    tile_y: int
    tile_x: int
    ys: slice
    xs: slice
    ss: slice
    missing: npt.NDArray[np.bool_] | None = field(default=None, compare=False, repr=False)
    costs: SampleCosts | None = field(default=None, compare=False, repr=False)

    @property
    def index(self) -> tuple[int, int, int]:
        """Place in an array (tile_y, tile_x, batch)."""
        return self.tile_y, self.tile_x, self.batch

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and number of samples."""
        height, width, samples = (s.stop - s.start for s in (self.ys, self.xs, self.ss))
        return height, width, samples

    @property
    def size(self) -> int:
        """Samples to be drawn, over all its pixels."""
        return math.prod(self.shape) if self.missing is None else int(self.missing.sum())


def chunk_grid(
    height: int, width: int, spp: int, *, ys: slice = ALL, xs: slice = ALL, ss: slice = ALL
) -> Iterator[Chunk]:
    """Yield the chunks of an image, or of a part of it.

    They come batch by batch, so that an interrupted render holds whole images.
    """
    cuts = []
    for part, length, step in ((ss, spp, BATCH), (ys, height, TILE), (xs, width, TILE)):
        start, stop, _ = part.indices(length)
        numbers = range(start // step, -(-stop // step)) if stop > start else range(0)
        cuts.append([(i, slice(i * step, min((i + 1) * step, length))) for i in numbers])
    for (b, samples), (ty, rows), (tx, columns) in itertools.product(*cuts):
        yield Chunk(b, ty, tx, rows, columns, samples)


def pieces(places: range, edge: int) -> Iterator[tuple[int, slice, slice]]:
    """Cut places along an axis into pieces of `edge`; yield numbers and places in piece and part.

    Examples
    --------
    >>> list(pieces(range(50, 130, 20), 64))
    [(0, slice(0, 1, None), slice(50, 51, 20)), (1, slice(1, 4, None), slice(6, 47, 20))]
    """
    for number in range(places[0] // edge, places[-1] // edge + 1) if places else ():
        ends = (number * edge, (number + 1) * edge)
        i, j = (min(max(-((places.start - e) // places.step), 0), len(places)) for e in ends)
        if i < j:
            inside = slice(places[i] - ends[0], places[j - 1] - ends[0] + 1, places.step)
            yield number, slice(i, j), inside


def gathered(
    shape: Sequence[int],
    places: Sequence[slice],
    edges: Sequence[int],
    piece: Callable[[int, int, int], Image],
) -> Image:
    """Assemble a part of the samples from pieces that are read or drawn as a whole.

    Parameters
    ----------
    shape
        Shape of all samples, (y, x, channel, sample).
    places, edges
        Rows, columns and samples of the part, and the size of a piece along each.
    piece
        Takes the numbers of a piece along these axes; returns the piece, (y, x, channel, sample).
    """
    lengths = shape[0], shape[1], shape[3]
    kept = [range(length)[place] for length, place in zip(lengths, places, strict=True)]
    ys, xs, ss = map(len, kept)
    part = np.empty((ys, xs, shape[2], ss), np.float32)
    for (y, to_y, of_y), (x, to_x, of_x), (s, to_s, of_s) in itertools.product(
        *map(pieces, kept, edges)
    ):
        found = piece(y, x, s)[of_y, of_x, :, of_s]
        if found.shape == part.shape:
            return found  # without a copy
        part[to_y, to_x, :, to_s] = found
    return part


def tiles(
    shape: tuple[int, int, int, int], *, streamed: bool = False
) -> Iterator[tuple[slice, slice]]:
    """Cut an image (y, x, channel, sample) into tiles small enough to hold at once.

    If samples are `streamed` batch by batch, tiles are as large as the chunks of a store.
    """
    height, width, channels, spp = shape
    edge = _EDGE
    while not streamed and edge > 1 and edge * edge * channels * spp * 4 > _MOST_BYTES:
        edge //= 2
    yield from itertools.product(spans(height, edge), spans(width, edge))


def by_pixels(function: Callable[..., Mapped], *blocks: Image) -> Mapped:
    """Apply a function of a tile's samples to as many pixels at a time as memory should hold.

    It may take more than the samples of each pixel, such as where they fell.
    """
    size = blocks[0].shape[:2]
    rows = [block.reshape(1, -1, *block.shape[2:]) for block in blocks]
    count = rows[0].shape[1]
    most = max(_AT_ONCE // max(rows[0][:, :1].nbytes, 1), 1)
    parts = []
    for part in spans(count, most):
        with portion((part.stop - part.start) / count):
            parts.append(function(*(row[:, part] for row in rows)))
    found = {}
    for name, (dims, _) in parts[0].items():
        values = np.concatenate([part[name][1] for part in parts], axis=1)
        found[name] = dims, values.reshape(*size, *values.shape[2:])
    return found
