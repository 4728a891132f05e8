"""Assembly: what is computed tile by tile becomes one dataset of the image.

`over_tiles` gives a function each tile with all its samples; `reduce_tiles` gives it batch by
batch, in constant memory.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from chdstat._core.arrays import Array, LeftOut, Mapped, plain_attributes
from chdstat._core.files import Cache, release, room
from chdstat._core.progress import portion, track
from chdstat._core.work import in_order
from chdstat.samples.tiles import SampleBlocks, Work, tiles

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples.samples import Samples

_OF_BAD = ("bad_count", "nan_count", "n_bad")
"""Counts of bad samples; samples that a pixel lacks read as NaN and are subtracted from them."""


def over_tiles(
    image: Samples,
    function: Callable[[Samples, LeftOut], Mapped],
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
        Takes the samples of a tile, and an object that counts left-out samples; returns variables.
    places
        Rows and columns of each tile.
    logarithms
        As for `Samples.map`.
    description, progress
        What is done, and whether to show its progress, counted in pixels.
    workers
        Tiles at a time; None for one per core.
    client
        A Dask client, whose workers compute tiles instead of threads. They read a store from its
        path, which they must see; other samples are sent to them.
    checkpoint
        Keeps tiles as soon as they are computed, and has earlier ones. The dataset is in its files.
    """
    left_out, client = LeftOut(logarithms=logarithms), work.get("client")
    checkpoint, show = work.get("checkpoint"), work.get("progress", True)
    task = functools.partial(_of_tile, function, logarithms, description, checkpoint)
    sent = client is not None and image.source is not None and image.source.frames

    def items() -> Iterator[tuple[slice, slice, Samples]]:
        for ys, xs in places:
            part = image.isel(y=ys, x=xs)
            yield ys, xs, part.load() if sent else part

    with track(description, math.prod(image.shape[:2]), unit="px", show=show) as advance:
        at: Any = {"workers": work.get("workers"), "client": client}
        at |= {"advance": advance, "size": lambda item: math.prod(item[2].shape[:2])}

        def parts() -> Iterator[tuple[slice, slice, Mapped]]:
            for ys, xs, found, counts in in_order(task, items(), **at):
                left_out.add(counts)
                yield ys, xs, found

        dataset = assemble(image, parts(), folder=checkpoint.folder if checkpoint else None)
    left_out.warn()
    return dataset


_Variables = dict[str, tuple[tuple[str, ...], Array]]


def _of_tile(
    function: Callable[[Samples, LeftOut], Mapped],
    logarithms: bool,
    description: str,
    checkpoint: Cache | None,
    item: tuple[slice, slice, Samples],
) -> tuple[slice, slice, Mapped, tuple[int, ...]]:
    """Return the variables of a tile, and the number of its samples that were left out."""
    ys, xs, part = item

    def compute() -> tuple[_Variables, tuple[int, ...]]:
        left_out = LeftOut(logarithms=logarithms)
        return dict(function(part, left_out)), left_out.counts

    if checkpoint is None:
        return ys, xs, *compute()
    name = f"{description}-{ys.start}-{ys.stop}-{xs.start}-{xs.stop}"
    return ys, xs, *checkpoint.record(name, tuple[_Variables, tuple[int, ...]], compute)


def reduce_tiles(
    samples: Samples,
    function: Callable[[Samples, SampleBlocks], Mapped],
    *,
    description: str,
    **work: Unpack[Work],
) -> xr.Dataset:
    """Reduce the sample blocks of every tile and assemble the image.

    `function` takes the samples of a tile and its blocks in stored order, and returns variables.
    The other parameters are those of `over_tiles`.
    """

    def of_tile(part: Samples, left_out: LeftOut) -> Mapped:
        def blocks() -> SampleBlocks:
            for *place, block in part.blocks():
                left_out.see(block, channel_axis=-2, absent=part.absent(*place))
                with portion(block.nbytes / part.nbytes):
                    yield block

        return function(part, blocks())

    places = tiles(samples.shape, streamed=True)
    return over_tiles(samples, of_tile, places, description=description, **work)


def assemble(
    image: Samples,
    parts: Iterable[tuple[slice, slice, Mapped]],
    *,
    folder: Path | None = None,
) -> xr.Dataset:
    """Return the dataset of an image from variables that were computed tile by tile.

    `parts` are rows, columns and variables of each tile; they are consumed one by one. With a
    folder, variables lie in files there and need not fit into memory.
    """
    height, width = image.shape[:2]
    results: dict[str, tuple[tuple[str, ...], Array]] = {}
    for ys, xs, variables in parts:
        for name, (dims, part) in variables.items():
            if name not in results:
                whole = room((height, width, *part.shape[2:]), part.dtype, folder)
                results[name] = (("y", "x", *dims), whole)
            results[name][1][ys, xs] = part
            release(results[name][1])
    if image.unequal:
        absent = image.shape[3] - image.counts
        for name, (_, found) in results.items():
            if name.rpartition("/")[2] in _OF_BAD:
                found -= absent.reshape(absent.shape + (1,) * (found.ndim - 2)).astype(found.dtype)
    return labelled(image, results)


def labelled(image: Samples, variables: Mapping[str, Any]) -> xr.Dataset:
    """Return variables of an image as a dataset with its coordinates and attributes."""
    import xarray as xr

    coords = {"y": np.arange(image.shape[0]), "x": np.arange(image.shape[1])}
    known = {name: value for name, value in image.attrs.items() if value is not None}
    dataset = xr.Dataset(dict(variables), coords, plain_attributes(known))
    if "channel" in dataset.dims:
        # Strings have variable length: zarr v3 has no stable type for fixed length.
        dataset = dataset.assign_coords(channel=np.array(image.channels, dtype=object))
    return dataset
