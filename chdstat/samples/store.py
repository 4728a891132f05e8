"""The sample store on disk: layout, manifest and integrity of the zarr v3 group behind `Samples`.

Layout of the group::

    zarr.json           provenance, and the manifest of everything below
    radiance/zarr.json  (y, x, channel, sample), float32; once more the manifest
    radiance/c/Y/X/0/B  a chunk: the tile of pixels in row Y and column X, the batch B of samples
    features/           albedo, normal, position (y, x, component); depth (y, x)
    direct/             a store of its own: emission and direct light of the same samples
    .lock               while a process writes

**A chunk** is a tile of 64 x 64 pixels times a batch of 64 samples: one file, replaced as a whole.
Inside it is a shard of zarr: blocks of 16 x 16 pixels, each compressed with a checksum, so that
zarr reads a single pixel without its tile (1024 spp in 19 ms of processor time). The file ends in a
*label*, which zarr does not look at: the identity of the store whose samples these are, which
chunk, how many samples of each pixel, and the checksum of all that is before it. What is read has
its label checked first, so no file counts in another place than its own, nor an older file for a
newer one. Two stores of one identity hold equal chunks, as samples depend on nothing else.

**The manifest** is the attribute of that name: shape, identity, the samples that every pixel is
known to have, the checksum of each feature, whether there is a direct part, and a checksum of all
attributes. A chunk among the samples that every pixel has is damaged if it is not there; any other
is not rendered yet, or counts by its label: a render that is killed at any moment repeats at most
the chunks that were in flight. The metadata of arrays follows from the manifest and is never
believed. The manifest lies in two files, so that damage to one of them loses nothing.

**Many writers.** A chunk and its label are one file that is replaced at once, written without a
look at anything else: any number of processes may write chunks of one store. Only ``zarr.json`` and
its copy are rewritten, by who holds the lock. Today that one writes the chunks, too.

**Other places than a folder.** All that is asked of a place is to replace, read and list small
files by name, and a lock; nothing is renamed but by `replacing`, no folder is moved, nothing is
appended. A store of objects would put a chunk with one request, and need a lease for the lock.

Stores of schema 1 are read. They had a ledger of the samples in each chunk in place of labels, no
checksums of features or attributes, and are not written to any more: `convert` makes a new one.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import math
import os
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
import zarr.errors
from zarr.storage import LocalStore, MemoryStore, StorePath

from chdstat._core.arrays import spans
from chdstat._core.files import Lock, checksum, replacing, sweep, unused
from chdstat.errors import StoreError

__all__ = [
    "BATCH",
    "BLOCK",
    "DIRECT",
    "TILE",
    "Chunk",
    "Store",
    "check_schema",
    "chunk_grid",
    "convert",
]

SCHEMA_VERSION = 2
TILE = 64
"""Edge of a tile in pixels; 64 x 64 lanes are one render pass."""
BATCH = 64
"""Samples of a pixel in one chunk."""
BLOCK = 16
"""Edge in pixels of what is compressed separately within a chunk."""
DIRECT = "direct"
"""Folder of the store of direct light."""
_FIRST_SCHEMA = 1
_LOCK = ".lock"
_SAME = ("scene_hash", "size", "seed", "backend", "mitsuba_version")
"""Attributes by which the samples of two stores begin with the same random numbers."""
_GROWING = ("spp", "render_seconds")
"""Attributes that change while samples are added; all others are the identity of a store."""
_LABEL = struct.Struct("<8s8s4IQII")
"""Mark, identity, tile_y, tile_x, batch, samples, length and checksum of what is before the label,
and the checksum of the label itself."""
_MARK = b"chdstat2"
_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c"}
_MOST_CHANNELS = 64
_FEATURES = ("albedo", "normal", "depth", "position")
_FOREIGN = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    zarr.errors.BaseZarrError,
)
"""What damaged bytes may raise in the libraries that read them."""
_ALL = slice(None)

Image = npt.NDArray[np.float32]


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


class _WriteError(StoreError):
    """The system does not let a store be written to."""


class _DamageError(ValueError):
    """What is wrong with a file."""


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
    _lock: Lock | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._encoded: dict[str, Any] = {}
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
            "identity": _identity(kept, shape),
            "complete": 0,
            "features": {},
            "direct": False,
        }
        with _writing(path):
            if not path.is_dir():
                if path.exists():
                    raise _occupied(path)
                path.mkdir(parents=True, exist_ok=True)
            _check_free(path)
            lock = Lock(path / _LOCK, path)
            _check_free(path)
            sweep(path)
            attributes = json.loads(_canonical({**kept, "manifest": manifest}))
            store = cls(path, shape, _empty_ledger(shape), attributes, lock)
            store._save()
            for name, image in (features or {}).items():
                store._write_feature(name, image)
            store._save()
        return store

    @classmethod
    def exists(cls, path: Path) -> bool:
        """Whether there is, or was, a store at a path."""
        return any((path / name).exists() for name in ("zarr.json", "radiance/zarr.json"))

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
            with _writing(path):
                lock = Lock(path / _LOCK, path)
                sweep(path)
                store = cls._read(path, lock)
                store._save()
                for chunk in store._damaged_chunks():
                    store.ledger[chunk.index] = 0
            return store
        return cls._read(path)

    @classmethod
    def _read(cls, path: Path, lock: Lock | None = None) -> Store:
        attributes = _attributes_of(path)
        if attributes["schema_version"] == _FIRST_SCHEMA:
            return _FirstStore.of(path, attributes)
        shape = tuple(attributes["manifest"]["shape"])
        store = cls(path, shape, _empty_ledger(shape), attributes, lock)
        store._take_stock()
        return store

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
        metadata = _radiance(self.shape, {})
        self._radiance = _array(LocalStore(self.path, read_only=True), "radiance", metadata)
        self._encoder = _array(MemoryStore(self._encoded), "radiance", metadata)

    # --- what is stored -------------------------------------------------------------------------

    def pending(self) -> list[Chunk]:
        """Chunks that are not safely stored yet, in the order to render them."""
        height, width, _, spp = self.shape
        stored = self.ledger
        return [c for c in chunk_grid(height, width, spp) if stored[c.index] < c.shape[2]]

    def complete_spp(self) -> int:
        """Return the number of leading samples that every pixel has."""
        spp = self.shape[3]
        stored = self.ledger.min(axis=(0, 1))
        starts = BATCH * np.arange(len(stored))
        short = stored < np.minimum(BATCH, spp - starts)
        return int(starts[short][0] + stored[short][0]) if short.any() else spp

    def _take_stock(self) -> None:
        """Fill the ledger: from the manifest, and beyond what it knows from what is there."""
        spp = self.shape[3]
        known = int(self._manifest["complete"])
        starts = BATCH * np.arange(self.ledger.shape[2])
        self.ledger[...] = np.clip(known - starts, 0, np.minimum(BATCH, spp - starts))
        if known >= spp:
            return
        there = {
            (y, x): set(_listed(self.path / f"radiance/c/{y}/{x}/0"))
            for y, x in np.ndindex(self.ledger.shape[:2])
        }
        for chunk in self._chunks(_ALL, _ALL, slice(known, spp)):
            if str(chunk.batch) in there[chunk.index[:2]]:
                # What cannot be told counts, so that who reads it learns of it.
                with contextlib.suppress(_DamageError):
                    self.ledger[chunk.index] = min(self._label(chunk)[0], chunk.shape[2])
                    continue
                self.ledger[chunk.index] = chunk.shape[2]

    def _chunks(self, ys: slice, xs: slice, ss: slice) -> Iterator[Chunk]:
        """Yield the chunks that a part lies in."""
        height, width, _, spp = self.shape
        cuts = []
        for part, length, step in ((ss, spp, BATCH), (ys, height, TILE), (xs, width, TILE)):
            start, stop, _ = part.indices(length)
            firsts = range(start // step, -(-stop // step)) if stop > start else range(0)
            cuts.append([(i, slice(i * step, min((i + 1) * step, length))) for i in firsts])
        for (b, s), (ty, y), (tx, x) in itertools.product(*cuts):
            yield Chunk(b, ty, tx, y, x, s)

    def chunk_file(self, chunk: Chunk) -> Path:
        """Return the file that holds a chunk."""
        return self.path / f"radiance/c/{chunk.tile_y}/{chunk.tile_x}/0/{chunk.batch}"

    def direct(self) -> Store | None:
        """Open the store of emission and direct light of the same samples; None where it lacks.

        Raises
        ------
        StoreError
            If it cannot be read, or is not of the same samples.
        """
        path = self.path / DIRECT
        if not Store.exists(path) and not self._manifest["direct"]:
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
            for chunk in self._chunks(ys, xs, ss):
                if self.ledger[chunk.index]:
                    self._check(chunk)
            return np.asarray(self._radiance[ys, xs, :, ss], dtype=np.float32)
        except _FOREIGN as error:
            files = [self.chunk_file(c) for c in self._damaged_chunks(ys, xs, ss)]
            raise self._damage(files, _brief(error)) from error

    def lazy(self) -> Any:
        """Return the radiance as a Dask array; each of its chunks is read when it is computed."""
        import dask.array as da

        chunks = (TILE, TILE, self.shape[2], BATCH)
        lazily: Any = da.from_array
        return lazily(_Lazy(self), chunks=chunks, name=False, asarray=False)

    def _check(self, chunk: Chunk) -> None:
        """Raise `_DamageError` unless the file of a chunk is its own."""
        if self._label(chunk)[0] < self.ledger[chunk.index]:
            message = "it is an older one, with fewer samples"
            raise _DamageError(message)

    def _label(self, chunk: Chunk) -> tuple[int, int, int]:
        """Return how many samples a chunk holds, its length and its checksum."""
        try:
            with self.chunk_file(chunk).open("rb") as file:
                length = file.seek(-_LABEL.size, os.SEEK_END)
                label = file.read(_LABEL.size)
        except OSError as error:
            raise _DamageError(_brief(error)) from error
        mark, identity, y, x, batch, samples, told, content, own = _LABEL.unpack(label)
        if mark != _MARK or own != checksum(label[:-4]) or told != length:
            message = "it is cut off or overwritten"
            raise _DamageError(message)
        if identity.hex() != self._manifest["identity"]:
            message = "it is of other samples"
            raise _DamageError(message)
        if (y, x, batch) != chunk.index:
            message = f"it is the chunk of tile ({y}, {x}), batch {batch}"
            raise _DamageError(message)
        return samples, length, content

    def _damaged_chunks(
        self, ys: slice = _ALL, xs: slice = _ALL, ss: slice = _ALL, *, content: bool = True
    ) -> list[Chunk]:
        """Return the stored chunks in a part that are damaged; by their labels alone or whole."""

        def sound(chunk: Chunk) -> bool:
            try:
                self._check(chunk)
                return not content or self._is_whole(chunk)
            except _FOREIGN:
                return False

        return [c for c in self._chunks(ys, xs, ss) if self.ledger[c.index] and not sound(c)]

    def _is_whole(self, chunk: Chunk) -> bool:
        _, length, told = self._label(chunk)
        return checksum(self.chunk_file(chunk).read_bytes()[:length]) == told

    def damaged(self, *, content: bool = True) -> list[Path]:
        """Return the files that are gone, damaged or in the place of others.

        Parameters
        ----------
        content
            Read all chunks; False looks only at their labels.
        """
        metadata = ((self.path / name, content) for name, content in self._metadata())
        files = [file for file, content in metadata if _loaded(file) != content]
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
        found = {}
        for name, about in self._manifest["features"].items():
            file = self.path / _feature_file(name, about["shape"])
            content = _bytes(file)
            if content is None or checksum(content) != about["checksum"]:
                raise self._damage([file], "its checksum is another")
            place = LocalStore(self.path, read_only=True)
            array = _array(place, f"features/{name}", _feature(about["shape"]))
            found[name] = np.asarray(array[...], dtype=np.float32)
        return found

    @property
    def feature_names(self) -> list[str]:
        """Names of the first-hit features that belong to the store."""
        return sorted(self._manifest["features"])

    def _damaged_features(self) -> list[str]:
        told = self._manifest["features"].items()
        return [
            name
            for name, about in told
            if (content := _bytes(self.path / _feature_file(name, about["shape"]))) is None
            or checksum(content) != about["checksum"]
        ]

    def _damage(self, files: list[Path], why: str) -> StoreError:
        named = ", ".join(map(str, files)) or self.path
        return StoreError(
            f"cannot read {named} ({why}); run the same 'chdstat render' again to repair it "
            "('chdstat info --verify' lists all that is damaged)"
        )

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
        samples = chunk.shape[2]
        label = _LABEL.pack(
            _MARK,
            bytes.fromhex(self._manifest["identity"]),
            *chunk.index,
            samples,
            len(content),
            checksum(content),
            0,
        )[:-4]
        with _writing(self.path):
            _put(self.path / key, content + label + checksum(label).to_bytes(4, "little"))
        self.ledger[chunk.index] = samples
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
            with _writing(self.path):
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
        before, self.ledger = self.ledger, _empty_ledger(self.shape)
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
            with _writing(self.path):
                for name, image in features().items():
                    if name in damaged or name not in self.feature_names:
                        self._write_feature(name, image)
                self._save()

    def _write_feature(self, name: str, image: Image) -> None:
        held: dict[str, Any] = {}
        array = _array(MemoryStore(held), f"features/{name}", _feature(image.shape))
        array[...] = image
        ((key, encoded),) = held.items()
        content = encoded.to_bytes()
        _put(self.path / key, content)
        manifest = self._manifest
        about = {"shape": list(image.shape), "checksum": checksum(content)}
        manifest["features"] = {**manifest["features"], name: about}
        self._attributes = {**self._attributes, "manifest": manifest}

    def _save(self) -> None:
        """Write the metadata that differs from what it should be, the manifest first."""
        for name, content in self._metadata():
            if _loaded(self.path / name) != content:
                _put(self.path / name, json.dumps(content, indent=2, sort_keys=True).encode())

    def _metadata(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the metadata files of the group and its arrays, with what belongs into them."""
        yield "zarr.json", _group(_signed(self._attributes))
        # All but the time, so that equal samples are equal files.
        copy = {k: v for k, v in self._attributes.items() if k != "render_seconds"}
        yield "radiance/zarr.json", _radiance(self.shape, _signed(copy))
        features = self._manifest["features"]
        if features:
            yield "features/zarr.json", _group({})
        for name, about in features.items():
            yield f"features/{name}/zarr.json", _feature(about["shape"])


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


class _FirstStore(Store):
    """A store of schema 1: read as it says, as far as that agrees with itself."""

    @classmethod
    def of(cls, path: Path, attributes: dict[str, Any]) -> _FirstStore:
        try:
            width, height = attributes["size"]
            shape = tuple(_loaded(path / "radiance/zarr.json")["shape"])  # type: ignore[index]
            stored = zarr.open_array(LocalStore(path, read_only=True), path="ledger", mode="r")
            names = [n for n in _FEATURES if (path / "features" / n / "zarr.json").exists()]
            agrees = (
                shape[:2] == (height, width)
                and all(type(n) is int and n > 0 for n in shape)
                and shape[2] <= _MOST_CHANNELS
                and shape[3] <= attributes["spp"]
                and stored.shape[:2] == _grid(shape)[:2]
                and stored.shape[2] >= _grid(shape)[2]  # it grew before the samples did
                and not np.any(stored[..., _grid(shape)[2] :])
                and isinstance(attributes.get("integrator", {}), dict)
            )
            if not agrees:
                message = "its attributes, samples and ledger disagree"
                raise _DamageError(message)
            ledger = np.asarray(stored[..., : _grid(shape)[2]], dtype=np.int32)
            manifest = {"features": {name: {} for name in names}, "direct": False}
            store = cls(path, shape, ledger, {**attributes, "manifest": manifest})
            for chunk in store._chunks(_ALL, _ALL, _ALL):
                file = store.chunk_file(chunk)
                there = file.is_file() and file.stat().st_size > 0
                ledger[chunk.index] = np.clip(ledger[chunk.index], 0, there * chunk.shape[2])
        except _FOREIGN as error:
            raise _incomplete(path, _brief(error)) from error
        return store

    def _lay_out(self) -> None:
        metadata = _radiance(self.shape, {}, index="end")
        self._radiance = _array(LocalStore(self.path, read_only=True), "radiance", metadata)

    def _check(self, chunk: Chunk) -> None:
        if not self.chunk_file(chunk).is_file():
            message = "it is gone"
            raise _DamageError(message)

    def _is_whole(self, chunk: Chunk) -> bool:
        self._radiance[chunk.ys, chunk.xs, :, chunk.ss]
        return True

    def _damage(self, files: list[Path], why: str) -> StoreError:
        named = ", ".join(map(str, files)) or self.path
        return StoreError(
            f"cannot read {named} ({why}); delete the damaged file (all are listed by "
            "'chdstat info --verify'), and keep the rest with: "
            f"chdstat convert {self.path} -o NEW"
        )

    def read_features(self) -> dict[str, Image]:
        return {name: self._read_feature(name) for name in self.feature_names}

    def _read_feature(self, name: str) -> Image:
        folder = self.path / "features" / name
        try:
            array = zarr.open_array(LocalStore(folder, read_only=True), mode="r")
            if array.shape not in (self.shape[:2], (*self.shape[:2], 3)):
                message = f"its shape is {array.shape}"
                raise _DamageError(message)
            return np.asarray(array[...], dtype=np.float32)
        except _FOREIGN as error:
            raise self._damage([folder], _brief(error)) from error

    def _damaged_features(self) -> list[str]:
        found = []
        for name in self.feature_names:
            try:
                self._read_feature(name)
            except StoreError:
                found.append(name)
        return found

    def _metadata(self) -> Iterator[tuple[str, dict[str, Any]]]:
        return iter(())


def convert(old: Path, new: Path, told: Mapping[str, Any]) -> None:
    """Write the samples of a store of schema 1 into a new one.

    See `chdstat.rendering.capture.convert`.

    `told` is what is known better now of its attributes, and of those of its direct part.
    """
    store = Store.open(old)
    if not isinstance(store, _FirstStore):
        message = f"{old} is of schema {SCHEMA_VERSION} already: there is nothing to convert"
        raise StoreError(message)
    direct = store.direct()
    try:
        new.parent.mkdir(parents=True, exist_ok=True)
        with (
            replacing(unused(new), folder=True) as partial,
            _converted(store, partial, told) as made,
        ):
            if direct is not None:
                _converted(direct, partial / DIRECT, told).close()
                made.update(direct=True)
    except (_WriteError, OSError) as error:
        cause: Any = error.__cause__ if isinstance(error, _WriteError) else error
        message = f"cannot write to {new}: {cause.strerror or cause}; nothing was kept of it"
        raise StoreError(message) from error


def _converted(old: Store, path: Path, told: Mapping[str, Any]) -> Store:
    height, width, channels, _ = old.shape
    spp = old.complete_spp()
    if spp == 0:
        message = f"{old.path} holds no sample that every pixel has: there is nothing to convert"
        raise StoreError(message)
    new = Store.create(
        path,
        height=height,
        width=width,
        channels=channels,
        spp=spp,
        attrs={**old.attrs, **told, "spp": spp},
        features=old.read_features(),
    )
    for chunk in new.pending():
        new.write(chunk, old.read(chunk.ys, chunk.xs, chunk.ss))
    return new


# --- metadata -----------------------------------------------------------------------------------


def _group(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)}


def _radiance(
    shape: tuple[int, int, int, int], attributes: Mapping[str, Any], *, index: str = "start"
) -> dict[str, Any]:
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


def _feature(shape: Sequence[int]) -> dict[str, Any]:
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


def _array(store: Any, name: str, metadata: Any) -> Any:
    """Return an array of known metadata, whatever a file says of it."""
    # A chunk of nothing but NaN is a result; unless told at each opening, zarr drops it.
    with zarr.config.set({"array.write_empty_chunks": True}):
        return zarr.Array(zarr.AsyncArray(metadata, StorePath(store, name)))


def _feature_file(name: str, shape: Sequence[int]) -> str:
    return f"features/{name}/c" + "/0" * len(shape)


def _grid(shape: Sequence[int]) -> tuple[int, int, int]:
    """Return (tile_y, tile_x, batch) of a store."""
    height, width, _, spp = shape
    return -(-height // TILE), -(-width // TILE), -(-spp // BATCH)


def _empty_ledger(shape: Sequence[int]) -> npt.NDArray[np.int32]:
    return np.zeros(_grid(shape), np.int32)


def _identity(attrs: Mapping[str, Any], shape: Sequence[int]) -> str:
    """Return what tells samples from all others but for their number."""
    told = {k: v for k, v in attrs.items() if k not in _GROWING}
    return hashlib.blake2b(_canonical([told, list(shape[:3])]), digest_size=8).hexdigest()


def _signed(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes with their checksum in the manifest."""
    manifest = {k: v for k, v in attributes["manifest"].items() if k != "checksum"}
    told = {**attributes, "manifest": manifest}
    return {**told, "manifest": {**manifest, "checksum": checksum(_canonical(told))}}


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _attributes_of(path: Path) -> dict[str, Any]:
    """Return the attributes of a store, from the first of its two manifests that is sound."""
    found = []
    for name in ("zarr.json", "radiance/zarr.json"):
        attributes: Any = (_loaded(path / name) or {}).get("attributes")
        try:
            if attributes["schema_version"] == SCHEMA_VERSION and _signed(attributes) == attributes:
                return dict(attributes)
        except _FOREIGN:
            pass
        found.append(attributes)
    version = found[0].get("schema_version") if isinstance(found[0], dict) else None
    if version == _FIRST_SCHEMA:
        return dict(found[0])
    if version not in (None, SCHEMA_VERSION):
        message = (
            f"{path} has schema version {version}, this chdstat reads "
            f"{_FIRST_SCHEMA} and {SCHEMA_VERSION}"
        )
        raise StoreError(message)
    raise _incomplete(path, "zarr.json and its copy radiance/zarr.json are damaged or of others")


def check_schema(path: Path) -> None:
    """Refuse to write to a store of schema 1.

    Raises
    ------
    StoreError
        If it is one; the message says how to convert it.
    """
    attributes = _attributes_of(path)
    if attributes["schema_version"] == _FIRST_SCHEMA:
        name, source = (attributes.get(key) for key in ("scene", "scene_source"))
        scene = name if source in (None, "chdstat") else source
        message = (
            f"{path} is of schema {_FIRST_SCHEMA}, which is only read; to append, convert it "
            f"first: chdstat convert {path} -o NEW --scene {scene}"
        )
        raise StoreError(message)


# --- files --------------------------------------------------------------------------------------


def _loaded(file: Path) -> dict[str, Any] | None:
    """Return the JSON in a file; None if it is damaged."""
    content = _bytes(file)
    if content is None:
        return None
    try:
        found = json.loads(content, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _refuse(constant: str) -> None:
    message = f"{constant} is no JSON"
    raise ValueError(message)


def _bytes(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except OSError:
        return None


def _listed(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)  # noqa: PTH208 - names alone
    except OSError:
        return []


def _put(file: Path, content: bytes) -> None:
    """Replace a file of a store, or a folder without files in its place."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.is_dir():
        for folder in (*sorted(file.rglob("*"), reverse=True), file):
            folder.rmdir()
    with replacing(file) as partial:
        partial.write_bytes(content)


def _check_free(path: Path) -> None:
    """Refuse a folder with anything in it but what a killed maker of a store leaves."""
    if Store.exists(path):
        message = f"{path} was made by another process just now; run the command again to go on"
        raise StoreError(message)
    for name in _listed(path):
        if name != _LOCK and not (name.startswith(".zarr.") and ".partial" in name):
            raise _occupied(path)


def _occupied(path: Path) -> StoreError:
    return StoreError(
        f"{path} exists and is not a chdstat store; nothing was overwritten. "
        "Give another path or move it away"
    )


def _incomplete(path: Path, why: str) -> StoreError:
    return StoreError(f"{path} is not a complete chdstat store ({why})")


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn what the system says of a disk into what a user can do."""
    try:
        yield
    except OSError as error:
        message = (
            f"cannot write to {path}: {error.strerror or error}. "
            "What is stored is kept; run the same command again to resume"
        )
        raise _WriteError(message) from error


def _brief(error: BaseException) -> str:
    said = str(error).splitlines()[0] if str(error) else "no detail"
    return said if isinstance(error, _DamageError) else f"{type(error).__name__}: {said}"
