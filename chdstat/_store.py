"""The sample store on disk: layout, ledger and integrity of the zarr v3 group behind `Samples`.

Layout of the group::

    radiance   (y, x, channel, sample)  float32, NaN where nothing was rendered yet
    ledger     (tile_y, tile_x, batch)  int32, samples of that chunk that are safely stored
    features/  albedo, normal, position (y, x, component); depth (y, x)

One chunk, a tile of 64 x 64 pixels times a batch of 64 samples, is one shard: one file, replaced
as a whole. Inside, blocks of 16 x 16 pixels are compressed apart with a checksum, so that a single
pixel is read without its tile. The ledger is marked after the chunk is on disk, so a render that
is killed at any moment repeats at most the chunks that were in flight.
"""

from __future__ import annotations

import itertools
import math
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
import zarr.errors
from zarr.codecs import BloscCodec, Crc32cCodec

from chdstat._arrays import spans
from chdstat.errors import StoreError

__all__ = ["BATCH", "TILE", "Chunk", "Store", "chunk_grid"]

SCHEMA_VERSION = 1
TILE = 64
"""Edge of a tile in pixels; 64 x 64 lanes are one render pass."""
BATCH = 64
"""Samples of a pixel in one chunk."""
_BLOCK = 16
_FEATURES = ("albedo", "normal", "depth", "position")


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


@dataclass
class Store:
    """An open store; `radiance` reads and writes like an array."""

    path: Path
    group: zarr.Group
    radiance: Any
    ledger: npt.NDArray[np.int32]

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        height: int,
        width: int,
        channels: int,
        spp: int,
        attrs: Mapping[str, Any],
    ) -> Store:
        """Create an empty store; the folder must not exist or be empty."""
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            message = (
                f"{path} exists and is not a chdstat store; nothing was overwritten. "
                "Give another path or move it away"
            )
            raise StoreError(message)
        try:
            group = zarr.open_group(path, mode="w-", zarr_format=3)
            _create_arrays(group, (height, width, channels, spp))
            group.attrs.update({"schema_version": SCHEMA_VERSION, **attrs})
        except OSError as error:
            message = f"cannot create a store at {path}: {error.strerror or error}"
            raise StoreError(message) from error
        return cls(path, group, group["radiance"], _read(group["ledger"]))

    @classmethod
    def open(cls, path: Path, *, writable: bool = False) -> Store:
        """Open an existing store and check that it is one, of a schema this version reads."""
        if not path.exists():
            message = f"no store at {path}; render one with: chdstat render SCENE -o {path}"
            raise StoreError(message)
        try:
            group = zarr.open_group(path, mode="r+" if writable else "r", zarr_format=3)
            version = group.attrs.get("schema_version")
            radiance, ledger = group["radiance"], _read(group["ledger"])
        except (
            FileNotFoundError,
            KeyError,
            ValueError,
            OSError,
            zarr.errors.BaseZarrError,
        ) as error:
            message = f"{path} is not a complete chdstat store ({_brief(error)})"
            raise StoreError(message) from error
        if version != SCHEMA_VERSION:
            message = f"{path} has schema version {version}, this chdstat reads {SCHEMA_VERSION}"
            raise StoreError(message)
        return cls(path, group, radiance, ledger)

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes of the store: scene, seed, backend and the rest of its provenance."""
        return dict(self.group.attrs)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample) that the store has room for."""
        height, width, channels, spp = self.radiance.shape
        return height, width, channels, spp

    def pending(self) -> list[Chunk]:
        """Chunks that are not safely stored yet, in the order to render them."""
        height, width, _, spp = self.shape
        return [c for c in chunk_grid(height, width, spp) if not self._holds(c)]

    def complete_spp(self) -> int:
        """Return the number of leading samples that every pixel has."""
        height, width, _, spp = self.shape
        missing = [c.ss.start + int(self.ledger[c.index]) for c in self.pending()]
        return min(missing, default=spp) if height * width else 0

    def _holds(self, chunk: Chunk) -> bool:
        present = self.ledger[chunk.index] >= chunk.shape[2]
        return bool(present) and self.chunk_file(chunk).exists()

    def chunk_file(self, chunk: Chunk) -> Path:
        """Return the file that holds a chunk."""
        return self.path / f"radiance/c/{chunk.tile_y}/{chunk.tile_x}/0/{chunk.batch}"

    def write(self, chunk: Chunk, block: npt.NDArray[np.float32]) -> None:
        """Store one chunk, then mark it; `block` is (y, x, channel, sample).

        Raises
        ------
        StoreError
            If the disk is full or not writable; what was stored before stays.
        """
        try:
            self.radiance[chunk.ys, chunk.xs, :, chunk.ss] = block
            self.ledger[chunk.index] = chunk.shape[2]
            self.group["ledger"][...] = self.ledger
        except OSError as error:
            message = (
                f"cannot write to {self.path}: {error.strerror or error}. "
                "What is stored is kept; run the same command again to resume"
            )
            raise StoreError(message) from error

    def extend(self, spp: int) -> None:
        """Make room for more samples per pixel; what is stored stays."""
        height, width, channels, old = self.shape
        if spp <= old:
            return
        batches = -(-spp // BATCH)
        self.radiance.resize((height, width, channels, spp))
        self.group["ledger"].resize((*self.ledger.shape[:2], batches))
        self.ledger = _read(self.group["ledger"])

    def read(self, ys: slice, xs: slice, ss: slice) -> npt.NDArray[np.float32]:
        """Read a part of the radiance.

        Raises
        ------
        StoreError
            If a chunk is damaged or gone; the message names how to repair it.
        """
        try:
            return np.asarray(self.radiance[ys, xs, :, ss], dtype=np.float32)
        except (OSError, ValueError, RuntimeError, KeyError, zarr.errors.BaseZarrError) as error:
            message = (
                f"{self.path} is damaged ({_brief(error)}); remove the damaged files named by "
                "'chdstat info --verify' and run the same 'chdstat render' again to repair it"
            )
            raise StoreError(message) from error

    def damaged(self) -> list[Path]:
        """Read every stored chunk and return the files that fail their checksum."""
        height, width, _, spp = self.shape
        bad = []
        for chunk in chunk_grid(height, width, spp):
            if self.ledger[chunk.index] == 0:
                continue
            try:
                block = self.read(chunk.ys, chunk.xs, chunk.ss)
            except StoreError:
                bad.append(self.chunk_file(chunk))
            else:
                if not self.chunk_file(chunk).exists() and np.isnan(block).all():
                    bad.append(self.chunk_file(chunk))
        return bad

    def write_features(self, features: Mapping[str, npt.NDArray[np.float32]]) -> None:
        """Store first-hit features: (y, x) or (y, x, component) each."""
        folder = self.group.require_group("features")
        for name, image in features.items():
            dims = ("y", "x", "component")[: image.ndim]
            array = folder.create_array(
                name, shape=image.shape, dtype="float32", dimension_names=dims, overwrite=True
            )
            array[...] = image

    def read_features(self) -> dict[str, npt.NDArray[np.float32]]:
        """Return the first-hit features that are stored, by name."""
        if "features" not in self.group:
            return {}
        folder = self.group["features"]
        return {name: _read(folder[name]) for name in _FEATURES if name in folder}

    def remove(self) -> None:
        """Delete the store from disk."""
        shutil.rmtree(self.path)


def _create_arrays(group: zarr.Group, shape: tuple[int, int, int, int]) -> None:
    height, width, channels, spp = shape
    group.create_array(
        "radiance",
        shape=shape,
        dtype="float32",
        chunks=(_BLOCK, _BLOCK, channels, BATCH),
        shards=(TILE, TILE, channels, BATCH),
        compressors=[BloscCodec(cname="zstd", clevel=1, shuffle="shuffle"), Crc32cCodec()],
        fill_value=float("nan"),
        dimension_names=("y", "x", "channel", "sample"),
        # A tile of nulls is a result, not an absence.
        config={"write_empty_chunks": True},
    )
    grid = (-(-height // TILE), -(-width // TILE), -(-spp // BATCH))
    group.create_array(
        "ledger",
        shape=grid,
        dtype="int32",
        chunks=(*grid[:2], max(grid[2], 1024)),
        fill_value=0,
        dimension_names=("tile_y", "tile_x", "batch"),
    )


def _read(array: Any) -> Any:
    return np.asarray(array[...])


def _brief(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no detail'}"
