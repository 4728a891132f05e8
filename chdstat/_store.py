"""The sample store on disk: layout, ledger and integrity of the zarr v3 group behind `Samples`.

Layout of the group::

    radiance   (y, x, channel, sample)  float32, NaN where nothing was rendered yet
    ledger     (tile_y, tile_x, batch)  int32, samples of that chunk that are safely stored
    features/  albedo, normal, position (y, x, component); depth (y, x)
    direct/    a store of its own: emission and direct light of the same samples, where wanted

One chunk, a tile of 64 x 64 pixels times a batch of 64 samples, is one shard: one file, replaced
as a whole. Inside, blocks of 16 x 16 pixels are compressed apart with a checksum, so that a single
pixel is read without its tile. The ledger is marked after the chunk is on disk, so a render that
is killed at any moment repeats at most the chunks that were in flight.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
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

__all__ = ["BATCH", "BLOCK", "DIRECT", "TILE", "Chunk", "Store", "chunk_grid"]

SCHEMA_VERSION = 1
TILE = 64
"""Edge of a tile in pixels; 64 x 64 lanes are one render pass."""
BATCH = 64
"""Samples of a pixel in one chunk."""
BLOCK = 16
"""Edge in pixels of what is compressed apart within a chunk."""
DIRECT = "direct"
"""Folder of the store of direct light."""
_SAME = ("scene_hash", "size", "seed", "backend", "mitsuba_version")
"""Attributes by which the samples of two stores begin with the same random numbers."""
_FEATURES = ("albedo", "normal", "depth", "position")
_READ_ERRORS = (OSError, ValueError, RuntimeError, KeyError, zarr.errors.BaseZarrError)
_ALL = slice(None)


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
    group: Any
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
        features: Mapping[str, npt.NDArray[np.float32]] | None = None,
    ) -> Store:
        """Create a store without samples; the folder must not exist or be empty.

        It is made beside its place and moved there at once, so that a store is never seen half
        made, whenever its maker is killed.
        """
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            message = (
                f"{path} exists and is not a chdstat store; nothing was overwritten. "
                "Give another path or move it away"
            )
            raise StoreError(message)
        partial = path.with_name(f".{path.name}.partial")
        try:
            group = zarr.open_group(partial, mode="w", zarr_format=3)
            _create_arrays(group, (height, width, channels, spp))
            _create_features(group, features or {})
            group.attrs.update({"schema_version": SCHEMA_VERSION, **attrs})
            partial.replace(path)
        except OSError as error:
            message = f"cannot create a store at {path}: {error.strerror or error}"
            raise StoreError(message) from error
        return cls.open(path, writable=True)

    @classmethod
    def open(cls, path: Path, *, writable: bool = False) -> Store:
        """Open an existing store and check that it is one, of a schema this version reads."""
        if not path.exists():
            message = f"no store at {path}; render one with: chdstat render SCENE -o {path}"
            raise StoreError(message)
        try:
            group = zarr.open_group(path, mode="r+" if writable else "r", zarr_format=3)
            version = group.attrs["schema_version"]
            # A chunk of nothing but NaN is a result; unless told at each opening, zarr drops it.
            with zarr.config.set({"array.write_empty_chunks": True}):
                radiance = group["radiance"]
            ledger = _read(group["ledger"])
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
        return [c for c in chunk_grid(height, width, spp) if self._stored(c) < c.shape[2]]

    def complete_spp(self) -> int:
        """Return the number of leading samples that every pixel has."""
        ends = (c.ss.start + self._stored(c) for c in self.pending())
        return min(ends, default=self.shape[3])

    def direct(self) -> Store | None:
        """Open the store of emission and direct light of the same samples; None where it lacks.

        Raises
        ------
        StoreError
            If it cannot be read, or is not of the same samples.
        """
        path = self.path / DIRECT
        if not (path / "zarr.json").exists():
            return None
        part = Store.open(path)
        ours, theirs = self._same, part._same
        differing = [name for name in ours if ours[name] != theirs[name]]
        if differing:
            detail = "; ".join(f"{n}: {theirs[n]}, not {ours[n]}" for n in differing)
            message = (
                f"{path} is not the direct part of {self.path} ({detail}); move it away, and "
                "render it with: chdstat render --direct"
            )
            raise StoreError(message)
        return part

    @property
    def _same(self) -> dict[str, Any]:
        """What must agree for samples to be the same but for the length of their paths."""
        attrs = self.attrs
        integrator = attrs.get("integrator") or {}
        alike = {name: attrs.get(name) for name in _SAME}
        alike["integrator"] = {k: v for k, v in integrator.items() if k != "max_depth"}
        return {"shape": self.shape[:3], **alike}

    def _stored(self, chunk: Chunk) -> int:
        """Return how many samples of a chunk are safely on disk."""
        return int(self.ledger[chunk.index]) if self._exists(chunk) else 0

    def _exists(self, chunk: Chunk) -> bool:
        file = self.chunk_file(chunk)
        # A machine that lost power can leave an empty file behind.
        return file.exists() and file.stat().st_size > 0

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
        # The ledger first: were this stopped between the two, it would only be too long.
        self.group["ledger"].resize((*self.ledger.shape[:2], -(-spp // BATCH)))
        self.radiance.resize((height, width, channels, spp))
        self.ledger = _read(self.group["ledger"])

    def read(self, ys: slice, xs: slice, ss: slice) -> npt.NDArray[np.float32]:
        """Read a part of the radiance.

        Raises
        ------
        StoreError
            If a chunk is damaged; the message names its file and how to repair it.
        """
        try:
            return self._read(ys, xs, ss)
        except _READ_ERRORS as error:
            files = ", ".join(map(str, self.damaged(ys, xs, ss))) or self.path
            message = (
                f"cannot read {files} ({_brief(error)}); delete the damaged file (all are listed "
                "by 'chdstat info --verify') and run the same 'chdstat render' again to repair it"
            )
            raise StoreError(message) from error

    def _read(self, ys: slice, xs: slice, ss: slice) -> npt.NDArray[np.float32]:
        return np.asarray(self.radiance[ys, xs, :, ss], dtype=np.float32)

    def damaged(self, ys: slice = _ALL, xs: slice = _ALL, ss: slice = _ALL) -> list[Path]:
        """Read every stored chunk in a part and return the files that are gone or damaged."""
        height, width, _, spp = self.shape
        part = [s.indices(n)[:2] for s, n in ((ys, height), (xs, width), (ss, spp))]
        chunks = (c for c in chunk_grid(height, width, spp) if self.ledger[c.index])
        return [self.chunk_file(c) for c in chunks if _overlaps(c, part) and not self._reads(c)]

    def _reads(self, chunk: Chunk) -> bool:
        try:
            self._read(chunk.ys, chunk.xs, chunk.ss)
        except _READ_ERRORS:
            return False
        # What is not there reads as NaN.
        return self._exists(chunk)

    def read_features(self) -> dict[str, npt.NDArray[np.float32]]:
        """Return the first-hit features that are stored, by name."""
        folder = self.group["features"]
        return {name: _read(folder[name]) for name in _FEATURES if name in folder}


def _create_arrays(group: zarr.Group, shape: tuple[int, int, int, int]) -> None:
    height, width, channels, spp = shape
    group.create_array(
        "radiance",
        shape=shape,
        dtype="float32",
        chunks=(BLOCK, BLOCK, channels, BATCH),
        shards=(TILE, TILE, channels, BATCH),
        # Paths that end alike give equal numbers: unshuffled, zstd finds them (a fifth smaller).
        compressors=[BloscCodec(cname="zstd", clevel=1, shuffle="noshuffle"), Crc32cCodec()],
        fill_value=float("nan"),
        dimension_names=("y", "x", "channel", "sample"),
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


def _create_features(group: zarr.Group, features: Mapping[str, npt.NDArray[np.float32]]) -> None:
    folder = group.create_group("features")
    for name, image in features.items():
        folder.create_array(name, data=image, dimension_names=("y", "x", "component")[: image.ndim])


def _overlaps(chunk: Chunk, part: Sequence[tuple[int, int]]) -> bool:
    axes = zip((chunk.ys, chunk.xs, chunk.ss), part, strict=True)
    return all(s.start < stop and start < s.stop for s, (start, stop) in axes)


def _read(array: Any) -> Any:
    return np.asarray(array[...])


def _brief(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no detail'}"
