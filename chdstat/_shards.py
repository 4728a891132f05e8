"""Shards: one block of 16 x 16 pixels of a store, straight from its files.

Use it where single pixels are read as a person waits: zarr takes a millisecond for each of the
files that a pixel lies in, this a third. It knows one layout, that of `chdstat._store`, checks it,
and leaves everything else to zarr, which also explains what is damaged.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import numpy.typing as npt
from numcodecs import blosc

from chdstat._arrays import spans
from chdstat._store import BATCH, BLOCK, TILE

__all__ = ["Block", "Shards"]

_CHECKSUM = 4
_ENTRY = 16
_THREADS = 2
_CODECS = ["bytes", "blosc", "crc32c"]

Image = npt.NDArray[np.float32]
Block = Sequence[Image]


class Shards:
    """The files of a store's radiance.

    Parameters
    ----------
    path
        The store.
    shape
        (y, x, channel, sample) of what is complete in it.
    """

    def __init__(self, path: Path, shape: tuple[int, int, int, int]) -> None:
        self._folder = path / "radiance"
        self._shape = shape
        self._known = _is_known(self._folder / "zarr.json", shape[2])

    def block(self, row: int, column: int) -> Block | None:
        """Return all samples of a block, batch by batch, each (y, x, channel, sample).

        They are not joined, which would take as long as reading them. None where the layout is
        another, or a file is missing or fails its checksum.
        """
        if not self._known:
            return None
        height, width, channels, spp = self._shape
        per_tile = TILE // BLOCK
        (tile_y, y), (tile_x, x) = divmod(row, per_tile), divmod(column, per_tile)
        inside = np.s_[: height - row * BLOCK, : width - column * BLOCK]
        batches = list(spans(spp, BATCH))
        folder = self._folder / f"c/{tile_y}/{tile_x}/0"
        # Unpacking leaves the interpreter to others: a person waits for half of it.
        with ThreadPoolExecutor(_THREADS) as pool:
            read = list(
                pool.map(
                    lambda i: _inner(folder / str(i), y * per_tile + x, per_tile**2),
                    range(len(batches)),
                )
            )
        parts: list[Image] = []
        for part, ss in zip(read, batches, strict=True):
            if part is None or len(part) != BLOCK * BLOCK * channels * BATCH * 4:
                return None
            samples = np.frombuffer(part, "<f4").reshape(BLOCK, BLOCK, channels, BATCH)
            parts.append(samples[*inside, :, : ss.stop - ss.start])
        return parts


def _inner(file: Path, index: int, count: int) -> bytes | None:
    """Return what an inner chunk of a shard holds; the table at its end says where it lies."""
    length = count * _ENTRY + _CHECKSUM
    try:
        with file.open("rb") as stream:
            stream.seek(-length, 2)
            table = _checked(stream.read(length))
            if table is None:
                return None
            offset, size = struct.unpack_from("<QQ", table, index * _ENTRY)
            if size >= 2**63:  # an inner chunk that was never written
                return None
            stream.seek(offset)
            packed = _checked(stream.read(size))
    except OSError:
        return None
    if packed is None:
        return None
    try:
        return bytes(blosc.decompress(packed))
    except (RuntimeError, ValueError):
        return None


def _checked(data: bytes) -> bytes | None:
    """Return data without its checksum, None where that fails."""
    content, checksum = data[:-_CHECKSUM], data[-_CHECKSUM:]
    sound = len(data) > _CHECKSUM and google_crc32c.value(content).to_bytes(4, "little") == checksum
    return content if sound else None


def _is_known(file: Path, channels: int) -> bool:
    try:
        meta: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        grid = meta["chunk_grid"]["configuration"]["chunk_shape"]
        (shard,) = meta["codecs"]
        inner = shard["configuration"]
        names = [[codec["name"] for codec in inner[kind]] for kind in ("codecs", "index_codecs")]
        return (
            meta["data_type"] == "float32"
            and grid == [TILE, TILE, channels, BATCH]
            and shard["name"] == "sharding_indexed"
            and inner["chunk_shape"] == [BLOCK, BLOCK, channels, BATCH]
            and names == [_CODECS, ["bytes", "crc32c"]]
            and inner["index_location"] == "end"
        )
    except (OSError, ValueError, KeyError, TypeError):
        return False
