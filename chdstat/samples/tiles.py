"""Images in tiles: those that samples are cut into, and datasets that are assembled from them."""

from __future__ import annotations

import functools
import importlib
import itertools
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, SupportsIndex, TypedDict, TypeVar, Unpack

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, LeftOut, spans, whole
from chdstat._core.files import release, room
from chdstat._core.statistic import Mapped
from chdstat._core.work import Cache, check_memory, in_order, track
from chdstat.errors import InputError

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

__all__ = [
    "BATCH",
    "DIRECT_DEPTH",
    "TILE",
    "Mapped",
    "Part",
    "Source",
    "Work",
    "assemble",
    "attrs_of",
    "check_independent",
    "check_place",
    "check_sequences",
    "check_single",
    "dataset_of",
    "labelled",
    "lazily",
    "mapped",
    "over_tiles",
    "read_part",
    "sequence_means",
    "sequence_of",
    "tiles",
]

TILE, BATCH = 64, 64
"""Edge in pixels and number of samples of a chunk, in which samples are drawn, kept and read."""
DIRECT_DEPTH = 2
"""Segments of a path from the camera to a light that shines on what it sees."""
_MOST_BYTES = 16 * 2**20
"""Size of a tile with all its samples at most, unless 16 x 16 pixels are larger."""

_ALWAYS_READ = 2**26
"""Bytes that are read without a look at how much memory there is."""
_OF_BAD = ("bad_count", "nan_count", "n_bad")
"""Counts of bad samples: of those that a pixel lacks, which read as NaN, they are cleared."""

Part = int | str
"""A part of the light of samples: paths up to so many segments, or the lights of such names."""


class Work(TypedDict, total=False):
    """How tiles are worked on, see `over_tiles`."""

    progress: bool | None
    workers: int | None
    client: Client | None
    checkpoint: Cache | None


class Source(Protocol):
    """What samples are read from when they are needed: a store, or files of another program."""

    frames: bool
    """Whether samples of one number lie together, and those of a pixel apart."""

    @property
    def path(self) -> Path:
        """Where it lies."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample)."""

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, NaN where a pixel has no more."""

    def read_features(self) -> dict[str, Image]:
        """Return the first-hit features by name."""


class _Attributed(Protocol):
    """What says where it comes from."""

    @property
    def attrs(self) -> dict[str, Any]: ...


class _Image(_Attributed, Protocol):
    """What a dataset of samples takes its coordinates and attributes from."""

    @property
    def shape(self) -> tuple[int, int, int, int]: ...
    @property
    def part(self) -> tuple[range, range, range]: ...
    @property
    def channels(self) -> tuple[str, ...]: ...
    @property
    def features(self) -> dict[str, Image]: ...
    @property
    def counts(self) -> npt.NDArray[np.int32] | None: ...
    @property
    def source(self) -> Source | None: ...
    def isel(self, *, y: slice, x: slice) -> Self: ...
    def load(self) -> Self: ...
    def read(
        self, ys: slice = slice(None), xs: slice = slice(None), ss: slice = slice(None)
    ) -> Image: ...
    def absent(
        self, ys: slice = slice(None), xs: slice = slice(None), ss: slice = slice(None)
    ) -> int: ...


def check_single(image: _Attributed) -> None:
    """Refuse averages of batches where single samples are needed.

    Raises
    ------
    InputError
        If that is what these are.
    """
    averaged = int(image.attrs.get("averaged", 1))
    if averaged > 1:
        message = (
            f"expected single samples, got averages of {averaged}, whose distribution is another; "
            "summarize and contrast take them"
        )
        raise InputError(message)


def sequence_of(attrs: Mapping[str, Any]) -> int:
    """Return how many samples of a pixel depend on each other; 1 where they are independent.

    Raises
    ------
    InputError
        If it is no integer from 1.

    Examples
    --------
    >>> sequence_of({"sampler": "stratified", "sequence": 16}), sequence_of({})
    (16, 1)
    """
    length = attrs.get("sequence")
    return 1 if length is None else whole("sequence", length, least=1)


def check_independent(image: _Attributed) -> None:
    """Refuse samples that depend on each other where independent ones are needed.

    Raises
    ------
    InputError
        If those of a sequence do; the message says how to go on.
    """
    length = sequence_of(image.attrs)
    if length > 1:
        named = f"the {image.attrs['sampler']} sampler" if "sampler" in image.attrs else "a sampler"
        message = (
            f"expected independent samples, got those of {named}, which spreads {length} at a time "
            "over a pixel: summarize and contrast take them, by the averages of these sequences, "
            "which samples.sequence_means() returns; for anything else, render with the "
            "independent sampler"
        )
        raise InputError(message)


def check_sequences(image: _Image) -> None:
    """Refuse a part of dependent samples that does not begin with a sequence.

    Raises
    ------
    InputError
        If it does not, or leaves some samples out.
    """
    length, places = sequence_of(image.attrs), image.part[2]
    if length > 1 and (places.start % length or places.step != 1):
        message = (
            f"expected whole sequences of {length} samples, got each {places.step} from number "
            f"{places.start} on: begin at a multiple of {length}, without a step"
        )
        raise InputError(message)


def sequence_means(image: _Image) -> Image:
    """Return averages of the whole sequences of samples, shape (y, x, channel, sequence).

    Raises
    ------
    InputError
        If the samples are independent, do not begin with a sequence, or hold none.
    """
    length = sequence_of(image.attrs)
    height, width, channels, spp = image.shape
    count = spp // length
    if length == 1 or not count:
        message = (
            f"expected samples in sequences, got {spp} of a sequence of {length}"
            if length > 1
            else "expected samples in sequences, as samplers that spread them draw, got "
            "independent ones, which need no averages"
        )
        raise InputError(message)
    check_sequences(image)
    advice = "take some rows of the image, with isel"
    check_memory(4 * height * width * channels * count, "averages of these sequences", advice)
    means = np.empty((height, width, channels, count), np.float32)
    for ys, xs in tiles(image.shape):
        block = image.read(ys, xs, slice(0, count * length))
        sequences = block.reshape(*block.shape[:3], count, length)
        with np.errstate(invalid="ignore"):  # of infinite samples
            means[ys, xs] = sequences.mean(axis=-1, dtype=np.float64)
    return means


def check_place(pixel: Any) -> None:
    """Refuse what is neither a pixel (y, x) nor slices of rows and columns."""
    pair = isinstance(pixel, tuple) and len(pixel) == 2
    if not pair or not all(isinstance(place, SupportsIndex | slice) for place in pixel):
        message = f"expected a pixel (y, x) or slices of rows and columns, got {pixel!r}"
        raise InputError(message)


def read_part(source: Source, rows: range, columns: range, samples: range) -> Image:
    """Read some samples, unless they are more than the memory of this machine holds."""
    size = 4 * source.shape[2] * len(rows) * len(columns) * len(samples)
    if size > _ALWAYS_READ:
        advice = "read them in parts, such as read(ys, xs), or walk through blocks()"
        check_memory(size, "these samples", advice)
    return source.read(*(slice(r.start, r.stop, r.step) for r in (rows, columns, samples)))


def tiles(
    shape: tuple[int, int, int, int], *, streamed: bool = False
) -> Iterator[tuple[slice, slice]]:
    """Cut an image (y, x, channel, sample) into rows and columns small enough to hold at once.

    Those whose samples are `streamed`, batch by batch, are as large as the chunks of a store.
    """
    height, width, channels, spp = shape
    edge = TILE
    while not streamed and edge > 16 and edge * edge * channels * spp * 4 > _MOST_BYTES:
        edge //= 2
    yield from itertools.product(spans(height, edge), spans(width, edge))


def assemble(
    image: _Image,
    parts: Iterable[tuple[slice, slice, Mapped]],
    *,
    description: str = "analysing",
    progress: bool | None = None,
    folder: Path | None = None,
) -> xr.Dataset:
    """Return the dataset of an image from variables that were computed tile by tile.

    `parts` are rows, columns and variables of each tile; they are consumed one by one. With a
    folder, variables are in files there, and need not fit into memory.
    """
    height, width = image.shape[:2]
    results: dict[str, tuple[tuple[str, ...], npt.NDArray[Any]]] = {}
    with track(description, height * width, unit="px", show=progress) as advance:
        for ys, xs, variables in parts:
            for name, (dims, part) in variables.items():
                if name not in results:
                    whole = room((height, width, *part.shape[2:]), part.dtype, folder)
                    results[name] = (("y", "x", *dims), whole)
                results[name][1][ys, xs] = part
                release(results[name][1])
            advance((ys.stop - ys.start) * (xs.stop - xs.start))
    if image.counts is not None:
        absent = image.shape[3] - image.counts
        for name, (_, found) in results.items():
            if name.rpartition("/")[2] in _OF_BAD:
                found -= absent.reshape(absent.shape + (1,) * (found.ndim - 2)).astype(found.dtype)
    return labelled(image, results)


def mapped(
    image: _Image,
    function: Callable[[Image], Mapped],
    *,
    logarithms: bool,
    dependent: bool,
    description: str,
    **work: Unpack[Work],
) -> xr.Dataset:
    """Apply a function to tiles with all their samples; see `Samples.map`."""
    check_single(image)
    if not dependent:
        check_independent(image)

    def of_tile(part: _Image, left_out: LeftOut) -> Mapped:
        block = part.read()
        left_out.see(block, channel_axis=-2, absent=part.absent())
        return function(block)

    shown: Any = {"logarithms": logarithms, "description": description}
    return over_tiles(image, of_tile, tiles(image.shape), **shown, **work)


Tile = TypeVar("Tile", bound=_Image)


def over_tiles(
    image: Tile,
    function: Callable[[Tile, LeftOut], Mapped],
    places: Iterable[tuple[slice, slice]],
    *,
    logarithms: bool = False,
    description: str = "analysing",
    **work: Unpack[Work],
) -> xr.Dataset:
    """Compute variables tile by tile and assemble the image.

    Parameters
    ----------
    image
        The samples.
    function
        Takes the samples of a tile, and what counts those that are left out; returns variables.
    places
        Rows and columns of each tile.
    logarithms
        As for `Samples.map`.
    description, progress
        Label of a progress bar, and whether to show it; None shows it on a terminal.
    workers
        Tiles at a time; None takes as many as there are cores.
    client
        A Dask client, whose workers compute tiles in place of threads. They read a store from its
        path, which they must see; other samples travel to them.
    checkpoint
        Keeps tiles as soon as they are computed, and has earlier ones; the dataset is in its files.
    """
    left_out, client = LeftOut(logarithms=logarithms), work.get("client")
    checkpoint, workers = work.get("checkpoint"), work.get("workers")
    task = functools.partial(_of_tile, function, logarithms, description, checkpoint)
    sent = client is not None and image.source is not None and image.source.frames

    def items() -> Iterator[tuple[slice, slice, Tile]]:
        for ys, xs in places:
            part = image.isel(y=ys, x=xs)
            yield ys, xs, part.load() if sent else part

    def parts() -> Iterator[tuple[slice, slice, Mapped]]:
        for ys, xs, found, counts in in_order(task, items(), workers=workers, client=client):
            left_out.add(counts)
            yield ys, xs, found

    about: Any = {"progress": work.get("progress"), "folder": checkpoint and checkpoint.folder}
    dataset = assemble(image, parts(), description=description, **about)
    left_out.warn()
    return dataset


_Variables = dict[str, tuple[tuple[str, ...], npt.NDArray[Any]]]


def _of_tile(
    function: Callable[[Any, LeftOut], Mapped],
    logarithms: bool,
    description: str,
    checkpoint: Cache | None,
    item: tuple[slice, slice, Any],
) -> tuple[slice, slice, Mapped, tuple[int, ...]]:
    """Return the variables of a tile, and how many of its samples were left out."""
    ys, xs, part = item

    def compute() -> tuple[_Variables, tuple[int, ...]]:
        left_out = LeftOut(logarithms=logarithms)
        return dict(function(part, left_out)), left_out.counts

    if checkpoint is None:
        return ys, xs, *compute()
    name = f"{description}-{ys.start}-{xs.start}"
    return ys, xs, *checkpoint.record(name, tuple[_Variables, tuple[int, ...]], compute)


def labelled(image: _Image, variables: Mapping[str, Any]) -> xr.Dataset:
    """Return variables of an image as a dataset with its coordinates."""
    import xarray as xr

    coords = {"y": np.arange(image.shape[0]), "x": np.arange(image.shape[1])}
    dataset = xr.Dataset(dict(variables), coords, image.attrs)
    if "channel" in dataset.dims:
        # Strings of variable length: zarr v3 has no stable type for those of fixed length.
        dataset = dataset.assign_coords(channel=np.array(image.channels, dtype=object))
    return dataset


def dataset_of(image: _Image) -> xr.Dataset:
    """Return samples, features and counts as a dataset, lazily (dask) where on disk."""
    dims = ("y", "x", "component")
    variables: dict[str, Any] = {n: (dims[: i.ndim], i) for n, i in image.features.items()}
    if image.counts is not None:
        variables["counts"] = (dims[:2], image.counts, {"long_name": "samples", "units": "1"})
    radiance = image.read() if image.source is None else lazily(image.read, image.shape)
    about = {"long_name": "linear radiance", "units": image.attrs.get("unit", "W sr-1 m-2")}
    variables["radiance"] = (("y", "x", "channel", "sample"), radiance, about)
    return labelled(image, variables)


def lazily(
    read: Callable[[slice, slice, slice], npt.NDArray[np.float32]], shape: tuple[int, ...]
) -> Any:
    """Return samples (y, x, channel, sample) as a dask array that reads its chunks when needed."""
    da: Any = importlib.import_module("dask.array")

    def block(block_info: Any) -> npt.NDArray[np.float32]:
        ys, xs, _, ss = (slice(*ends) for ends in block_info[None]["array-location"])
        return read(ys, xs, ss)

    named = {"name": f"radiance-{uuid.uuid4()}", "meta": np.empty((0, 0, 0, 0), np.float32)}
    chunks = da.core.normalize_chunks((TILE, TILE, -1, BATCH), shape)
    return da.map_blocks(block, chunks=chunks, **named)


def attrs_of(attrs: dict[str, Any], spp: int, kept: int) -> dict[str, Any]:
    """Return the attributes of some samples of each pixel, and of the time that they took.

    Examples
    --------
    >>> attrs_of({"spp": 64, "render_seconds": 8.0}, 64, 16)
    {'spp': 16, 'render_seconds': 2.0}
    """
    if kept == spp:
        return attrs
    seconds = attrs.get("render_seconds")
    return {**attrs, "spp": kept, **({"render_seconds": seconds * kept / spp} if seconds else {})}
