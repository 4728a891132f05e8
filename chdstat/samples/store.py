"""Store: the samples of an image in a folder, a zarr v3 group that many processes may read.

`chdstat.samples.layout` says where everything lies and what a file of it holds.

**Many writers.** A chunk and its label are one file, replaced at once without a look at anything
else: any process may write chunks, as workers of a cluster do, to which a store travels as its
path. Only ``zarr.json`` and its copy are rewritten, by who holds the lock.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from zarr.storage import MemoryStore

from chdstat._core.arrays import Image
from chdstat._core.files import Lock, checksum, exists, is_remote, locked, remove, zarr_store
from chdstat.errors import StoreError
from chdstat.samples import layout
from chdstat.samples.access import of_store, reopened
from chdstat.samples.layout import ALL, BATCH, FOREIGN, Chunk, DamageError, Part, Shape
from chdstat.samples.samples import Samples

__all__ = ["Store"]

_SAME = ("scene_hash", "size", "seed", "backend", "mitsuba_version")
"""Attributes by which the samples of two stores begin with the same random numbers."""


class Store:
    """An open store of samples, (y, x, channel, sample).

    What writes to it raises a `StoreError` if the disk is full or not writable; what was stored
    before stays.

    Attributes
    ----------
    path
        Where it lies.
    shape
        (y, x, channel, sample) that it has room for.
    ledger
        Samples of each pixel that are stored in a chunk, shape (tile_y, tile_x, batch).
    """

    frames = False
    path: Path
    shape: Shape
    _index_location = "start"

    def __init__(self, path: Path, attributes: Mapping[str, Any], lock: Lock | None = None) -> None:
        self.path, self._attributes, self._lock = path, dict(attributes), lock
        height, width, channels, spp = self._manifest["shape"]
        self.shape = (height, width, channels, spp)
        self.ledger = self._stored()
        self._lay_out()

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        shape: Shape,
        attrs: Mapping[str, Any],
        features: Mapping[str, Image] | None = None,
    ) -> Store:
        """Create a store with room for a shape (y, x, channel, sample), open until `close`.

        The folder must not exist or be empty. The store is there once its manifest is; if its maker
        is killed before that, the next one makes it, and after that, `restore` completes it.

        Raises
        ------
        StoreError
            If something else is there, another makes a store there, or it cannot be written.
        """
        kept = {**attrs, "schema_version": layout.SCHEMA_VERSION}
        kept.pop("manifest", None)
        manifest = {"shape": list(shape), "complete": 0, "features": {}, "direct": False}
        manifest["identity"] = layout.identity(kept, shape)
        with layout.writing(path):
            if exists(path) and not path.is_dir():
                raise layout.occupied(path)
            path.mkdir(parents=True, exist_ok=True)
            layout.check_free(path)
            lock = locked(path, layout.LOCK)
            layout.check_free(path)
            attributes = json.loads(layout.canonical({**kept, "manifest": manifest}))
            store = cls(path, attributes, lock)
            store._save()
        store.restore(features or {})
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
        if not exists(path):
            message = f"no store at {path}; render one with: chdstat render SCENE -o {path}"
            raise StoreError(message)
        if not writable:
            attributes = layout.attributes_of(path)
            if attributes["schema_version"] != layout.FIRST_SCHEMA:
                return cls(path, attributes)
            from chdstat.samples.first_schema import FirstStore

            return FirstStore(path, attributes)
        layout.check_appendable(path)
        with layout.writing(path):
            lock = locked(path, layout.LOCK)
            store = cls(path, layout.attributes_of(path), lock)
            store._save()
        for chunk in store._damaged_chunks():
            store.ledger[chunk.index] = 0
        return store

    @property
    def place(self) -> tuple[Any, ...]:
        """What another process needs for `reopened`."""
        held = self._manifest
        return self.path.absolute(), held.get("identity"), held["complete"], self.shape

    def __reduce__(self) -> tuple[Any, ...]:
        return reopened, self.place

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

    def _stored(self) -> npt.NDArray[np.int32]:
        """Return the ledger: as many leading samples as are known, and those that have labels."""
        known, spp = int(self._manifest["complete"]), self.shape[3]
        starts = np.arange(0, spp, BATCH)
        ledger = np.zeros(layout.grid(self.shape), np.int32)
        ledger[...] = np.clip(known - starts, 0, np.minimum(BATCH, spp - starts))
        for chunk in self._chunks(ss=slice(known, spp)):
            if self.chunk_file(chunk).exists():
                # A damaged chunk counts as stored, so that reading it reports the damage.
                ledger[chunk.index] = chunk.shape[2]
                with contextlib.suppress(DamageError):
                    ledger[chunk.index] = min(self._label(chunk)[0], chunk.shape[2])
        return ledger

    def _lay_out(self) -> None:
        """Make the arrays that chunks are decoded and encoded with; nothing is read for it."""
        metadata = layout.radiance_metadata(self.shape, {}, index=self._index_location)
        self._radiance = layout.array(zarr_store(self.path), "radiance", metadata)
        self._encoded: dict[str, Any] = {}
        self._encoder = layout.array(MemoryStore(self._encoded), "radiance", metadata)

    def _chunks(self, ys: slice = ALL, xs: slice = ALL, ss: slice = ALL) -> Iterator[Chunk]:
        height, width, _, spp = self.shape
        return layout.chunk_grid(height, width, spp, ys=ys, xs=xs, ss=ss)

    def pending(self) -> list[Chunk]:
        """Return the chunks that are not safely stored yet, in the order to render them."""
        return [c for c in self._chunks() if self.ledger[c.index] < c.shape[2]]

    def complete_spp(self) -> int:
        """Return the number of leading samples that every pixel has."""
        spp = self.shape[3]
        stored = self.ledger.min(axis=(0, 1))
        starts = BATCH * np.arange(len(stored))
        short = stored < np.minimum(BATCH, spp - starts)
        return int(starts[short][0] + stored[short][0]) if short.any() else spp

    def chunk_file(self, chunk: Chunk) -> Path:
        """Return the file that holds a chunk."""
        return self.path / f"radiance/c/{chunk.tile_y}/{chunk.tile_x}/0/{chunk.batch}"

    def parts(self) -> dict[Part, Store]:
        """Open the stores of the same samples with a part of their light: by depth, then by light.

        Raises
        ------
        StoreError
            If one cannot be read, or is not of the same samples.
        """
        return {part: self._part(part) for part in layout.parts_in(self.path, self._manifest)}

    def _part(self, which: Part) -> Store:
        path = self.path / layout.part_folder(which)
        part = Store.open(path)
        ours, theirs = self._same, part._same
        if names := layout.differing(ours, theirs):
            detail = "; ".join(f"{n}: {theirs[n]}, not {ours[n]}" for n in names)
            message = (
                f"{path} is not of the same samples as {self.path} ({detail}); move it away, and "
                "render it with: chdstat render --direct, --by-depth or --light"
            )
            raise StoreError(message)
        return part

    @property
    def _same(self) -> dict[str, Any]:
        """What must agree for samples to be the same but for a part of their light."""
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
            If a chunk is damaged, missing or in the place of another; the message says where.
        """
        try:
            for chunk in self._chunks(ys, xs, ss):
                if self.ledger[chunk.index]:
                    self._check(chunk)
            return np.asarray(self._radiance[ys, xs, :, ss], dtype=np.float32)
        except FOREIGN as error:
            files = [self.chunk_file(c) for c in self._damaged_chunks(ys, xs, ss)]
            raise self._damage(files, layout.brief(error)) from error

    def _label(self, chunk: Chunk) -> tuple[int, int, int]:
        return layout.read_label(self.chunk_file(chunk), self._manifest["identity"], chunk)

    def _check(self, chunk: Chunk) -> None:
        """Raise `DamageError` unless the file of a chunk is its own, with the samples it had."""
        if self._label(chunk)[0] < self.ledger[chunk.index]:
            message = "it is an older one, with fewer samples"
            raise DamageError(message)

    def _check_content(self, chunk: Chunk) -> None:
        """Raise an error of `FOREIGN` unless the content of a chunk has its checksum."""
        _, length, told = self._label(chunk)
        if checksum(self.chunk_file(chunk).read_bytes()[:length]) != told:
            message = "its checksum is another"
            raise DamageError(message)

    def _damaged_chunks(
        self, ys: slice = ALL, xs: slice = ALL, ss: slice = ALL, *, content: bool = True
    ) -> list[Chunk]:
        """Return the stored chunks in a part that are damaged; by their labels alone or whole."""
        damaged = []
        for chunk in self._chunks(ys, xs, ss):
            try:
                if self.ledger[chunk.index]:
                    self._check(chunk)
                    if content:
                        self._check_content(chunk)
            except FOREIGN:
                damaged.append(chunk)
        return damaged

    def damaged(self, *, content: bool = True) -> list[Path]:
        """Return the files that are gone, damaged or in the place of others.

        All chunks are read; without `content`, their labels only.
        """
        expected = [(self.path / name, content) for name, content in self._metadata()]
        found = [file for file, content in expected if layout.loaded(file) != content]
        found += [self.path / "features" / name for name in self._damaged_features()]
        found += [self.chunk_file(chunk) for chunk in self._damaged_chunks(content=content)]
        for part in layout.parts_in(self.path, self._manifest):
            try:
                found += self._part(part).damaged(content=content)
            except StoreError:
                found.append(self.path / layout.part_folder(part))
        return found

    def read_features(self) -> dict[str, Image]:
        """Return the first-hit features that are stored, by name.

        Raises
        ------
        StoreError
            If one is damaged.
        """
        return {name: self._read_feature(name) for name in self.feature_names}

    @property
    def feature_names(self) -> list[str]:
        """Names of the first-hit features that belong to the store."""
        return sorted(self._manifest["features"].keys() - {layout.COUNTS})

    def counts(self) -> npt.NDArray[np.int32] | None:
        """Return how many samples each pixel has, shape (y, x), where they differ."""
        if layout.COUNTS not in self._manifest["features"]:
            return None
        return self._read_feature(layout.COUNTS).astype(np.int32)

    def _read_feature(self, name: str) -> Image:
        about = self._manifest["features"][name]
        file = self.path / layout.feature_file(name, about["shape"])
        try:
            if checksum(file.read_bytes()) != about["checksum"]:
                message = "its checksum is another"
                raise DamageError(message)
            place, metadata = zarr_store(self.path), layout.feature_metadata(about["shape"])
            return np.asarray(layout.array(place, f"features/{name}", metadata)[...])
        except FOREIGN as error:
            raise self._damage([file], layout.brief(error)) from error

    def _damaged_features(self) -> list[str]:
        damaged = []
        for name in self._manifest["features"]:
            try:
                self._read_feature(name)
            except StoreError:
                damaged.append(name)
        return damaged

    def _damage(self, files: list[Path], why: str) -> StoreError:
        """Return the error that names damaged files and how to repair them."""
        named = ", ".join(map(str, files)) or self.path
        return StoreError(
            f"cannot read {named} ({why}); run the same 'chdstat render' again to repair it "
            "('chdstat info --verify' lists all that is damaged)"
        )

    def _metadata(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the metadata files, with what belongs into them, the manifest first."""
        # All but the time, so that equal samples are equal files.
        copy = {k: v for k, v in self._attributes.items() if k != "render_seconds"}
        yield "zarr.json", layout.group_metadata(layout.signed(self._attributes))
        yield "radiance/zarr.json", layout.radiance_metadata(self.shape, layout.signed(copy))
        features = self._manifest["features"]
        if features:
            yield "features/zarr.json", layout.group_metadata({})
        for name, about in features.items():
            yield f"features/{name}/zarr.json", layout.feature_metadata(about["shape"])

    # --- writing --------------------------------------------------------------------------------

    def write(self, chunk: Chunk, block: Image) -> None:
        """Store one chunk; `block` is (y, x, channel, sample)."""
        self.put(chunk, block)
        self.note(chunk)

    def put(self, chunk: Chunk, block: Image) -> None:
        """Write the file of one chunk, as any process may."""
        self._encoder[chunk.ys, chunk.xs, :, chunk.ss] = block
        key = self.chunk_file(chunk).relative_to(self.path).as_posix()
        content = self._encoded.pop(key).to_bytes()
        with layout.writing(self.path):
            layout.put(self.path / key, layout.labelled(content, self._manifest["identity"], chunk))

    def note(self, chunk: Chunk) -> None:
        """Count a chunk as stored, whoever wrote its file."""
        self.ledger[chunk.index] = chunk.shape[2]
        if self.complete_spp() > self._manifest["complete"]:
            self.update()

    def update(self, *, parts: Iterable[Part] = (), **attrs: Any) -> None:
        """Change attributes, and note what samples every pixel has, and of which parts."""
        manifest = self._manifest
        manifest["complete"] = max(manifest["complete"], self.complete_spp())
        manifest["shape"] = list(self.shape)
        manifest = layout.with_parts(manifest, parts)
        changed = {**self._attributes, **attrs, "manifest": manifest}
        if changed != self._attributes:
            self._attributes = changed
            with layout.writing(self.path):
                self._save()

    def spent(self, seconds: float) -> None:
        """Add to the time that rendering took, unless the disk is full: `write` has said so."""
        before = float(self.attrs.get("render_seconds", 0.0))
        with contextlib.suppress(StoreError):
            self.update(render_seconds=round(before + seconds, 3))

    def finish(self, parts: Mapping[Part, Samples] | None = None) -> Samples:
        """Return the samples that every pixel has, with the parts of their light."""
        self.update(parts=parts or ())
        return of_store(self, parts)

    def discard(self) -> None:
        """Remove the store, if no samples were written to it."""
        if self._stored().any():
            return
        if is_remote(self.path):
            with layout.writing(self.path):
                cast("Any", self.path).rmdir(recursive=True)
        else:
            remove(self.path)

    def extend(self, spp: int) -> None:
        """Make room for more samples per pixel; what is stored stays."""
        height, width, channels, old = self.shape
        if spp <= old:
            return
        self.shape = (height, width, channels, spp)
        before, self.ledger = self.ledger, np.zeros(layout.grid(self.shape), np.int32)
        self.ledger[..., : before.shape[2]] = before
        self._lay_out()
        self.update(spp=spp)

    @property
    def lacks_features(self) -> bool:
        """Whether there are no first-hit features, or damaged ones."""
        return not self.feature_names or bool(self._damaged_features())

    def restore(self, features: Mapping[str, Image], why_none: str = "") -> None:
        """Write the features that are missing or damaged, or why there are none."""
        if self.lacks_features:
            with layout.writing(self.path):
                for name, image in features.items():
                    self._write_feature(name, image)
                self._save()
            if why_none:
                self.update(why_no_features=why_none)

    def _write_feature(self, name: str, image: Image) -> None:
        held: dict[str, Any] = {}
        metadata = layout.feature_metadata(image.shape)
        encoder = layout.array(MemoryStore(held), f"features/{name}", metadata)
        encoder[...] = image
        ((key, encoded),) = held.items()
        content = encoded.to_bytes()
        layout.put(self.path / key, content)
        manifest = self._manifest
        about = {"shape": list(image.shape), "checksum": checksum(content)}
        manifest["features"] = {**manifest["features"], name: about}
        self._attributes = {**self._attributes, "manifest": manifest}

    def _save(self) -> None:
        """Write the metadata that differs from what it should be, the manifest first."""
        for name, content in self._metadata():
            if layout.loaded(self.path / name) != content:
                layout.put(self.path / name, json.dumps(content, indent=2, sort_keys=True).encode())
