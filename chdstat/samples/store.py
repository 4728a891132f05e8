"""Store: the samples of an image in a folder, a zarr v3 group that many processes may read.

`layout` says where everything lies, `manifest` what belongs to a store, and `schemas` how today's
schema differs from the first.

**Many writers.** A chunk and its label are one file that is replaced at once, written without a
look at anything else: any number of processes may write chunks of one store. Only ``zarr.json`` and
its copy are rewritten, by who holds the lock. Today that one writes the chunks, too.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from zarr.storage import MemoryStore

from chdstat._core.files import Lock, checksum, sweep
from chdstat.errors import StoreError
from chdstat.samples.layout import (
    ALL,
    BATCH,
    DIRECT,
    TILE,
    Chunk,
    Image,
    array,
    chunk_file,
    chunk_grid,
    chunks_within,
    empty_ledger,
    feature_metadata,
    labelled,
    radiance_metadata,
)
from chdstat.samples.manifest import (
    FIRST_SCHEMA,
    FOREIGN,
    LOCK,
    SCHEMA_VERSION,
    attributes_of,
    brief,
    canonical,
    check_free,
    check_schema,
    identity,
    loaded,
    occupied,
    put,
    store_exists,
    writing,
)
from chdstat.samples.schemas import FirstSchema, Schema, SecondSchema

__all__ = ["Store"]

_SAME = ("scene_hash", "size", "seed", "backend", "mitsuba_version")
"""Attributes by which the samples of two stores begin with the same random numbers."""


@dataclass
class Store:
    """An open store of samples, (y, x, channel, sample).

    Attributes
    ----------
    path
        Where it lies.
    shape
        (y, x, channel, sample) that it has room for.
    ledger
        Samples of each pixel that are stored in a chunk, shape (tile_y, tile_x, batch).
    """

    path: Path
    shape: tuple[int, int, int, int]
    ledger: npt.NDArray[np.int32]
    _attributes: dict[str, Any] = field(repr=False)
    _schema: Schema = field(repr=False)
    _lock: Lock | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._lay_out()

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
        features: Mapping[str, Image] | None = None,
    ) -> Store:
        """Create a store without samples, to be written to until `close`.

        The folder must not exist or be empty. The store is there once its manifest is; if its maker
        is killed before that, the next one makes it, and after that, `restore` completes it.

        Raises
        ------
        StoreError
            If something else is there, another process makes a store there, or it cannot be
            written.
        """
        shape = (height, width, channels, spp)
        kept = {k: v for k, v in attrs.items() if k != "manifest"} | {
            "schema_version": SCHEMA_VERSION
        }
        manifest = {
            "shape": list(shape),
            "identity": identity(kept, shape),
            "complete": 0,
            "features": {},
            "direct": False,
        }
        with writing(path):
            if not path.is_dir():
                if path.exists():
                    raise occupied(path)
                path.mkdir(parents=True, exist_ok=True)
            check_free(path)
            lock = Lock(path / LOCK, path)
            check_free(path)
            sweep(path)
            attributes = json.loads(canonical({**kept, "manifest": manifest}))
            schema = SecondSchema(path, identity(kept, shape))
            store = cls(path, shape, empty_ledger(shape), attributes, schema, lock)
            store._save()
            for name, image in (features or {}).items():
                store._write_feature(name, image)
            store._save()
        return store

    @classmethod
    def open(cls, path: Path, *, writable: bool = False) -> Store:
        """Open an existing store and check that it is one, of a schema this version reads.

        One that is writable is locked until `close`, has what killed writers left removed, and has
        all its chunks read: those that are damaged count as not rendered, so that they are rendered
        again.

        Raises
        ------
        StoreError
            If there is none, its manifest is damaged, or, for one that is writable, another process
            writes to it, or it is of schema 1 or cannot be written to.
        """
        if not path.exists():
            message = f"no store at {path}; render one with: chdstat render SCENE -o {path}"
            raise StoreError(message)
        if writable:
            check_schema(path)
            with writing(path):
                lock = Lock(path / LOCK, path)
                sweep(path)
                store = cls._read(path, lock)
                store._save()
                for chunk in store._damaged_chunks():
                    store.ledger[chunk.index] = 0
            return store
        return cls._read(path)

    @classmethod
    def _read(cls, path: Path, lock: Lock | None = None) -> Store:
        attributes = attributes_of(path)
        if attributes["schema_version"] == FIRST_SCHEMA:
            first = FirstSchema(path)
            shape, ledger, manifest = first.contents(attributes)
            return cls(path, shape, ledger, {**attributes, "manifest": manifest}, first)
        manifest = attributes["manifest"]
        shape = tuple(manifest["shape"])
        schema = SecondSchema(path, manifest["identity"])
        ledger = schema.ledger(shape, int(manifest["complete"]))
        return cls(path, shape, ledger, attributes, schema, lock)

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let others write."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes of the store: scene, seed, backend and the rest of its provenance."""
        return {k: v for k, v in self._attributes.items() if k != "manifest"}

    @property
    def _manifest(self) -> dict[str, Any]:
        return dict(self._attributes["manifest"])

    def _lay_out(self) -> None:
        """Make the arrays that chunks are decoded and encoded with; nothing is read for it."""
        self._radiance = self._schema.radiance(self.shape)
        self._encoded: dict[str, Any] = {}
        metadata = radiance_metadata(self.shape, {})
        self._encoder = array(MemoryStore(self._encoded), "radiance", metadata)

    def pending(self) -> list[Chunk]:
        """Chunks that are not safely stored yet, in the order to render them."""
        height, width, _, spp = self.shape
        return [c for c in chunk_grid(height, width, spp) if self.ledger[c.index] < c.shape[2]]

    def complete_spp(self) -> int:
        """Return the number of leading samples that every pixel has."""
        spp = self.shape[3]
        stored = self.ledger.min(axis=(0, 1))
        starts = BATCH * np.arange(len(stored))
        short = stored < np.minimum(BATCH, spp - starts)
        return int(starts[short][0] + stored[short][0]) if short.any() else spp

    def chunk_file(self, chunk: Chunk) -> Path:
        """Return the file that holds a chunk."""
        return chunk_file(self.path, chunk)

    def direct(self) -> Store | None:
        """Open the store of emission and direct light of the same samples; None where it lacks.

        Raises
        ------
        StoreError
            If it cannot be read, or is not of the same samples.
        """
        path = self.path / DIRECT
        if not store_exists(path) and not self._manifest["direct"]:
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
        equal = {name: attrs.get(name) for name in _SAME}
        equal["integrator"] = {k: v for k, v in integrator.items() if k != "max_depth"}
        return {"shape": self.shape[:3], **equal}

    # --- reading --------------------------------------------------------------------------------

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Read a part of the radiance, NaN where nothing was rendered yet.

        Raises
        ------
        StoreError
            If a chunk is damaged, missing or in the place of another; the message names its file
            and how to repair it.
        """
        try:
            for chunk in chunks_within(self.shape, ys, xs, ss):
                if samples := self.ledger[chunk.index]:
                    self._schema.check(chunk, samples)
            return np.asarray(self._radiance[ys, xs, :, ss], dtype=np.float32)
        except FOREIGN as error:
            files = [self.chunk_file(c) for c in self._damaged_chunks(ys, xs, ss)]
            raise self._schema.damage(files, brief(error)) from error

    def lazy(self) -> Any:
        """Return the radiance as a Dask array; each of its chunks is read when it is computed."""
        import dask.array as da

        chunks = (TILE, TILE, self.shape[2], BATCH)
        lazily: Any = da.from_array
        return lazily(_Lazy(self), chunks=chunks, name=False, asarray=False)

    def _damaged_chunks(
        self, ys: slice = ALL, xs: slice = ALL, ss: slice = ALL, *, content: bool = True
    ) -> list[Chunk]:
        """Return the stored chunks in a part that are damaged; by their labels alone or whole."""

        def sound(chunk: Chunk) -> bool:
            try:
                self._schema.check(chunk, self.ledger[chunk.index])
                return not content or self._schema.is_whole(chunk, self._radiance)
            except FOREIGN:
                return False

        within = chunks_within(self.shape, ys, xs, ss)
        return [c for c in within if self.ledger[c.index] and not sound(c)]

    def damaged(self, *, content: bool = True) -> list[Path]:
        """Return the files that are gone, damaged or in the place of others.

        Parameters
        ----------
        content
            Read all chunks; False looks only at their labels.
        """
        metadata = (
            (self.path / name, content)
            for name, content in self._schema.metadata(self._attributes, self.shape)
        )
        files = [file for file, content in metadata if loaded(file) != content]
        files += [self.path / "features" / name for name in self._damaged_features()]
        files += [self.chunk_file(chunk) for chunk in self._damaged_chunks(content=content)]
        try:
            direct = self.direct()
        except StoreError:
            return [*files, self.path / DIRECT]
        return files if direct is None else files + direct.damaged(content=content)

    def read_features(self) -> dict[str, Image]:
        """Return the first-hit features that are stored, by name.

        Raises
        ------
        StoreError
            If one is damaged.
        """
        features = self._manifest["features"].items()
        return {name: self._schema.read_feature(name, about) for name, about in features}

    @property
    def feature_names(self) -> list[str]:
        """Names of the first-hit features that belong to the store."""
        return sorted(self._manifest["features"])

    def _damaged_features(self) -> list[str]:
        features = self._manifest["features"].items()
        return [name for name, about in features if self._schema.feature_is_damaged(name, about)]

    # --- writing --------------------------------------------------------------------------------

    def write(self, chunk: Chunk, block: Image) -> None:
        """Store one chunk; `block` is (y, x, channel, sample).

        Raises
        ------
        StoreError
            If the disk is full or not writable; what was stored before stays.
        """
        self._encoder[chunk.ys, chunk.xs, :, chunk.ss] = block
        key = self.chunk_file(chunk).relative_to(self.path).as_posix()
        content = self._encoded.pop(key).to_bytes()
        with writing(self.path):
            put(self.path / key, labelled(content, self._manifest["identity"], chunk))
        self.ledger[chunk.index] = chunk.shape[2]
        if self.complete_spp() > self._manifest["complete"]:
            self.update()

    def update(self, *, direct: bool | None = None, **attrs: Any) -> None:
        """Change attributes, and note what samples every pixel has.

        Raises
        ------
        StoreError
            If it cannot be written.
        """
        manifest = self._manifest
        manifest["complete"] = max(manifest["complete"], self.complete_spp())
        manifest["shape"] = list(self.shape)
        if direct is not None:
            manifest["direct"] = direct
        changed = {**self._attributes, **attrs, "manifest": manifest}
        if changed != self._attributes:
            self._attributes = changed
            with writing(self.path):
                self._save()

    def extend(self, spp: int) -> None:
        """Make room for more samples per pixel; what is stored stays.

        Raises
        ------
        StoreError
            If it cannot be written.
        """
        height, width, channels, old = self.shape
        if spp <= old:
            return
        self.shape = (height, width, channels, spp)
        before, self.ledger = self.ledger, empty_ledger(self.shape)
        self.ledger[..., : before.shape[2]] = before
        self._lay_out()
        self.update(spp=spp)

    def restore(self, features: Callable[[], Mapping[str, Image]]) -> None:
        """Write what is damaged of the features again.

        Raises
        ------
        StoreError
            If it cannot be written.
        """
        damaged = self._damaged_features()
        if damaged or not self.feature_names:
            with writing(self.path):
                for name, image in features().items():
                    if name in damaged or name not in self.feature_names:
                        self._write_feature(name, image)
                self._save()

    def _write_feature(self, name: str, image: Image) -> None:
        held: dict[str, Any] = {}
        encoder = array(MemoryStore(held), f"features/{name}", feature_metadata(image.shape))
        encoder[...] = image
        ((key, encoded),) = held.items()
        content = encoded.to_bytes()
        put(self.path / key, content)
        manifest = self._manifest
        about = {"shape": list(image.shape), "checksum": checksum(content)}
        manifest["features"] = {**manifest["features"], name: about}
        self._attributes = {**self._attributes, "manifest": manifest}

    def _save(self) -> None:
        """Write the metadata that differs from what it should be, the manifest first."""
        for name, content in self._schema.metadata(self._attributes, self.shape):
            if loaded(self.path / name) != content:
                put(self.path / name, json.dumps(content, indent=2, sort_keys=True).encode())


@dataclass(frozen=True)
class _Lazy:
    """The radiance of a store, as much of an array as Dask needs."""

    store: Store
    dtype = np.dtype(np.float32)
    ndim = 4

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample)."""
        return self.store.shape

    def __getitem__(self, part: tuple[slice, slice, slice, slice]) -> Image:
        ys, xs, channels, ss = part
        return self.store.read(ys, xs, ss)[:, :, channels]
