"""Layout of a store: where a chunk lies in the zarr v3 group, and what a file of it holds.

The group::

    zarr.json           provenance, and the manifest of everything below
    radiance/zarr.json  (y, x, channel, sample), float32; once more the manifest
    radiance/c/Y/X/0/B  a chunk: the tile of pixels in row Y and column X, the batch B of samples
    features/           albedo, normal, position (y, x, component); depth (y, x)
    direct/             a store of its own: emission and direct light of the same samples
    .lock               while a process writes

A chunk is a tile of 64 x 64 pixels times a batch of 64 samples: one file, replaced as a whole.
Inside it is a shard of zarr: blocks of 16 x 16 pixels, each compressed with a checksum, so that
zarr reads a single pixel without its tile (1024 spp in 19 ms of processor time). The file ends in a
*label*, which zarr does not look at: the identity of the store whose samples these are, which
chunk, how many samples of each pixel, and the checksum of all that is before it. What is read has
its label checked first, so no file counts in another place than its own, nor an older file for a
newer one. Two stores of one identity hold equal chunks, as samples depend on nothing else.

**Other places than a folder.** All that is asked of a place is to replace, read and list small
files by name, and a lock; nothing is renamed but by `replacing`, no folder is moved, nothing is
appended. A store of objects would put a chunk with one request, and need a lease for the lock.
"""

from __future__ import annotations

import itertools
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
from zarr.storage import StorePath

from chdstat._core.arrays import spans
from chdstat._core.files import checksum
from chdstat.samples.manifest import DamageError, brief

__all__ = [
    "ALL",
    "BATCH",
    "BLOCK",
    "DIRECT",
    "TILE",
    "Chunk",
    "Image",
    "Shape",
    "array",
    "chunk_file",
    "chunk_grid",
    "chunks_within",
    "empty_ledger",
    "feature_file",
    "feature_metadata",
    "grid",
    "labelled",
    "metadata_files",
    "radiance_metadata",
    "read_label",
]

TILE = 64
"""Edge of a tile in pixels; 64 x 64 lanes are one render pass."""
BATCH = 64
"""Samples of a pixel in one chunk."""
BLOCK = 16
"""Edge in pixels of what is compressed separately within a chunk."""
DIRECT = "direct"
"""Folder of the store of direct light."""
ALL = slice(None)
_LABEL = struct.Struct("<8s8s4IQII")
"""Mark, identity, tile_y, tile_x, batch, samples, length and checksum of what is before the label,
and the checksum of the label itself."""
_MARK = b"chdstat2"
_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c"}

Image = npt.NDArray[np.float32]
Shape = tuple[int, int, int, int]
"""(y, x, channel, sample)."""


@dataclass(frozen=True)
class Chunk:
    """One unit of work: a tile of pixels times a batch of samples."""

    batch: int
    tile_y: int
    tile_x: int
    ys: slice
    xs: slice
    ss: slice

    @property
    def index(self) -> tuple[int, int, int]:
        """Position in the ledger."""
        return self.tile_y, self.tile_x, self.batch

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and number of samples."""
        height, width, samples = (s.stop - s.start for s in (self.ys, self.xs, self.ss))
        return height, width, samples

    @property
    def size(self) -> int:
        """Samples in the chunk, over all its pixels."""
        return math.prod(self.shape)


def chunk_grid(height: int, width: int, spp: int) -> Iterator[Chunk]:
    """Yield all chunks of an image, batch by batch: an interrupted render holds whole images."""
    cuts = [list(spans(n, step)) for n, step in ((spp, BATCH), (height, TILE), (width, TILE))]
    for (b, ss), (ty, ys), (tx, xs) in itertools.product(*(enumerate(s) for s in cuts)):
        yield Chunk(b, ty, tx, ys, xs, ss)


def chunks_within(
    shape: Sequence[int], ys: slice = ALL, xs: slice = ALL, ss: slice = ALL
) -> Iterator[Chunk]:
    """Yield the chunks that a part of a store lies in."""
    height, width, _, spp = shape
    cuts = []
    for part, length, step in ((ss, spp, BATCH), (ys, height, TILE), (xs, width, TILE)):
        start, stop, _ = part.indices(length)
        firsts = range(start // step, -(-stop // step)) if stop > start else range(0)
        cuts.append([(i, slice(i * step, min((i + 1) * step, length))) for i in firsts])
    for (b, s), (ty, y), (tx, x) in itertools.product(*cuts):
        yield Chunk(b, ty, tx, y, x, s)


def chunk_file(path: Path, chunk: Chunk) -> Path:
    """Return the file of a store that holds a chunk."""
    return path / f"radiance/c/{chunk.tile_y}/{chunk.tile_x}/0/{chunk.batch}"


def feature_file(name: str, shape: Sequence[int]) -> str:
    """Return the file that holds a first-hit feature, within the store."""
    return f"features/{name}/c" + "/0" * len(shape)


def grid(shape: Sequence[int]) -> tuple[int, int, int]:
    """Return (tile_y, tile_x, batch) of a store."""
    height, width, _, spp = shape
    return -(-height // TILE), -(-width // TILE), -(-spp // BATCH)


def empty_ledger(shape: Sequence[int]) -> npt.NDArray[np.int32]:
    """Return the ledger of a store without samples, shape (tile_y, tile_x, batch)."""
    return np.zeros(grid(shape), np.int32)


# --- labels -------------------------------------------------------------------------------------


def labelled(content: bytes, identity: str, chunk: Chunk) -> bytes:
    """Return the content of a chunk's file: encoded samples, and their label behind them."""
    label = _LABEL.pack(
        _MARK,
        bytes.fromhex(identity),
        *chunk.index,
        chunk.shape[2],
        len(content),
        checksum(content),
        0,
    )[:-4]
    return content + label + checksum(label).to_bytes(4, "little")


def read_label(file: Path, identity: str, chunk: Chunk) -> tuple[int, int, int]:
    """Return how many samples the file of a chunk holds, its length and its checksum."""
    try:
        with file.open("rb") as opened:
            length = opened.seek(-_LABEL.size, os.SEEK_END)
            label = opened.read(_LABEL.size)
    except OSError as error:
        raise DamageError(brief(error)) from error
    mark, held, y, x, batch, samples, told, content, own = _LABEL.unpack(label)
    if mark != _MARK or own != checksum(label[:-4]) or told != length:
        message = "it is cut off or overwritten"
        raise DamageError(message)
    if held.hex() != identity:
        message = "it is of other samples"
        raise DamageError(message)
    if (y, x, batch) != chunk.index:
        message = f"it is the chunk of tile ({y}, {x}), batch {batch}"
        raise DamageError(message)
    return samples, length, content


# --- metadata of zarr ---------------------------------------------------------------------------


def metadata_files(
    signed: Mapping[str, Any], copy: Mapping[str, Any], shape: Sequence[int]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the metadata files of a store, with what belongs into them, the manifest first."""
    yield "zarr.json", _group(signed)
    yield "radiance/zarr.json", radiance_metadata(shape, copy)
    features = signed["manifest"]["features"]
    if features:
        yield "features/zarr.json", _group({})
    for name, about in features.items():
        yield f"features/{name}/zarr.json", feature_metadata(about["shape"])


def _group(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)}


def radiance_metadata(
    shape: Sequence[int], attributes: Mapping[str, Any], *, index: str = "start"
) -> dict[str, Any]:
    """Return the metadata of the samples; the index of a shard is before or behind its blocks."""
    # Paths that end alike give equal numbers: unshuffled, zstd finds them (a fifth smaller).
    blosc = {"cname": "zstd", "clevel": 1, "shuffle": "noshuffle", "typesize": 4, "blocksize": 0}
    shard = {
        "chunk_shape": [BLOCK, BLOCK, shape[2], BATCH],
        "codecs": [_LITTLE, {"name": "blosc", "configuration": blosc}, _CRC],
        "index_codecs": [_LITTLE, _CRC],
        "index_location": index,
    }
    codecs = [{"name": "sharding_indexed", "configuration": shard}]
    names = ["y", "x", "channel", "sample"]
    return _array_metadata(shape, [TILE, TILE, shape[2], BATCH], codecs, names, attributes)


def feature_metadata(shape: Sequence[int]) -> dict[str, Any]:
    """Return the metadata of a first-hit feature."""
    zstd = {"name": "zstd", "configuration": {"level": 0, "checksum": False}}
    names = ["y", "x", "component"][: len(shape)]
    return _array_metadata(shape, list(shape), [_LITTLE, zstd], names, {})


def _array_metadata(
    shape: Sequence[int],
    chunk: Sequence[int],
    codecs: list[dict[str, Any]],
    names: list[str],
    attributes: Mapping[str, Any],
) -> dict[str, Any]:
    """Return what a zarr.json holds for an array; see https://zarr-specs.readthedocs.io v3."""
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": list(shape),
        "data_type": "float32",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": "NaN",
        "codecs": codecs,
        "attributes": dict(attributes),
        "dimension_names": names,
        "storage_transformers": [],
    }


def array(store: Any, name: str, metadata: Any) -> Any:
    """Return an array of known metadata, whatever a file says of it."""
    # A chunk of nothing but NaN is a result; unless told at each opening, zarr drops it.
    with zarr.config.set({"array.write_empty_chunks": True}):
        return zarr.Array(zarr.AsyncArray(metadata, StorePath(store, name)))
