"""Store: the samples of an image in a folder, a zarr v3 group that many processes may read.

`chdstat.samples.layout` describes the files of a store, and `chdstat.samples.ledger` which of its
samples there should be and are. `open` returns the samples of a store, `inspect` its content, and
`save` writes samples to one.

**Many writers.** A chunk and its label are one file, which is replaced in one step without reading
anything else. Any process may therefore write chunks, such as the workers of a cluster, which
receive the path of the store. Only the process that holds the lock rewrites ``zarr.json`` and its
copy.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image
from chdstat._core.files import (
    Lock,
    checksum,
    exists,
    is_path,
    is_remote,
    locked,
    place_of,
    remove,
    shown,
    zarr_store,
)
from chdstat._core.progress import track
from chdstat.errors import InputError, StoreError
from chdstat.samples import layout
from chdstat.samples.costs import COSTS, SampleCosts, with_times
from chdstat.samples.dependence import (
    check_independent,
    check_sequences,
    check_single,
    sequence_of,
)
from chdstat.samples.film_steps import FILM_STEPS, of_steps, to_steps
from chdstat.samples.layout import FOREIGN, DamageError, is_store
from chdstat.samples.ledger import Ledger, PixelCounts, counts_of
from chdstat.samples.samples import ImageLike, Samples
from chdstat.samples.tiles import ALL, DIRECT_DEPTH, FILM, Chunk, LightPart, is_depth

_SAME = ("scene_hash", "size", "seed", "backend", "mitsuba_version")
"""Attributes that decide whether the samples of two stores share random numbers."""
_FILES = (".exr", ".npy", ".npz", ".nc", ".pfm", ".png", ".hdr", ".jpg")
"""Suffixes of files that are no stores."""
_OF_A_STORE = (
    *("scene_hash", "scene_code", "scene_files", "plugins"),
    *("appended", "manifest", "schema_version"),
)
"""Attributes of a store itself, which are not copied when its samples are saved elsewhere."""


class Store:
    """An open store of samples, (y, x, channel, sample).

    Writing raises a `StoreError` if the disk is full or not writable; stored samples stay.

    Attributes
    ----------
    path
        Path of the store.
    shape
        Room of the store, (y, x, channel, sample).
    ledger
        The chunks that there should be, and what is stored of them.
    density
        In an adaptive render, samples of each pixel over the mean, shape (y, x); None until it is
        decided.
    """

    frames = False

    _timed: SampleCosts | None

    def __init__(self, path: Path, attributes: Mapping[str, Any], lock: Lock | None = None) -> None:
        self.path, self._attributes, self._lock = path.absolute(), dict(attributes), lock
        height, width, channels, spp = self._manifest["shape"]
        self.shape = (height, width, channels, spp)
        self.density, self._timed = self._decided(), None
        self.ledger = self._stored()
        self._lay_out()

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        shape: tuple[int, int, int, int],
        attrs: Mapping[str, Any],
        features: Mapping[str, Image] | None = None,
    ) -> Store:
        """Create a store with room for a shape (y, x, channel, sample), open until `close`.

        The folder must not exist or must be empty. The store exists once its manifest does. If its
        maker is killed before that, the next one makes it; after that, `restore` completes it.

        Raises
        ------
        InputError
            If the folder would be called like a file of another kind.
        StoreError
            If something else is there, another process makes a store there, or it cannot be
            written.
        """
        if path.suffix.lower() in _FILES:
            message = (
                f"a store of samples is a folder, such as {path.with_suffix('.zarr').name}, got "
                f"{path.name}; 'chdstat estimate' and chdstat.io.write_image write images"
            )
            raise InputError(message)
        kept = {**attrs, "schema_version": layout.SCHEMA_VERSION}
        kept.pop("manifest", None)
        manifest = {"shape": list(shape), "complete": 0, "features": {}, "direct": False}
        manifest["identity"] = layout.identity(kept, shape)
        with layout.disk_errors(path):
            if exists(path) and not path.is_dir():
                raise layout.occupied(path)
            path.mkdir(parents=True, exist_ok=True)
            layout.check_free(path)
        with layout.disk_errors(path), locked(path, layout.LOCK) as lock:
            layout.check_free(path)
            attributes = json.loads(layout.canonical({**kept, "manifest": manifest}))
            store = cls(path, attributes, lock)
            store._save()
            store.restore(features or {})
        return store

    @classmethod
    def open(cls, path: Path, *, writable: bool = False) -> Store:
        """Open an existing store, and check that it has a schema that this version reads.

        A writable store is locked until `close`. Leftovers of killed writers are removed and all
        chunks are read; damaged ones count as not rendered, so that they are rendered again.

        Raises
        ------
        StoreError
            If there is none, or its manifest is damaged. For a writable one, also if another
            process writes to it, or it cannot be written.
        """
        if not exists(path):
            message = f"no store at {path}; render one with: chdstat render SCENE -o {path}"
            raise StoreError(message)
        if not writable:
            return cls(path, layout.attributes_of(path))
        with layout.disk_errors(path), locked(path, layout.LOCK) as lock:
            store = cls(path, layout.attributes_of(path), lock)
            store._save()
            for chunk in store._damaged_chunks():
                store.ledger.note(chunk, 0)
        return store

    @property
    def place(self) -> tuple[Any, ...]:
        """Arguments that another process needs for `reopened`."""
        held = self._manifest
        return self.path, held["identity"], held["complete"], self.shape

    def __reduce__(self) -> tuple[Any, ...]:
        return reopened, self.place

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock, so that others can write."""
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

    @property
    def adaptive(self) -> dict[str, Any] | None:
        """How an adaptive render decides counts; None for other renders."""
        found = self._attributes.get("adaptive") if "scene_hash" in self._attributes else None
        return cast("dict[str, Any] | None", found)

    def _decided(self) -> Image | None:
        """Return the density; None if there is none or it is damaged.

        If it is damaged, `counts` tells readers; a writer decides again from the first samples.
        """
        held = self._manifest["features"]
        if self.adaptive is None or layout.DENSITY not in held:
            return None
        try:
            return self._read_feature(layout.DENSITY)
        except StoreError:
            self.shape = (*self.shape[:3], self.adaptive["first"])
            if self._lock is not None:
                features = {n: about for n, about in held.items() if n != layout.DENSITY}
                self._change({"shape": list(self.shape), "complete": 0, "features": features})
            return None

    def counts(self) -> PixelCounts | None:
        """Return the number of samples of each pixel, shape (y, x), if they differ."""
        if self.adaptive is not None and layout.DENSITY in self._manifest["features"]:
            density = self.density
            if density is None:  # it is damaged; reading raises the error
                density = self._read_feature(layout.DENSITY)
            return counts_of(density, self._attributes["spp"], self.adaptive["first"])
        if layout.COUNTS not in self._manifest["features"]:
            return None
        return self._read_feature(layout.COUNTS).astype(np.int32)

    def _wanted(self) -> PixelCounts | None:
        """Return the samples that each pixel should have, if counts differ on purpose."""
        if self.adaptive is None:
            return None
        counts = None if self.density is None else self.counts()
        # The first samples, which all pixels have, decide about the others.
        return np.full(self.shape[:2], self.shape[3], np.int32) if counts is None else counts

    def _stored(self) -> Ledger:
        """Return the ledger: the leading samples that are known, and those with labels."""
        known, ledger = int(self._manifest["complete"]), Ledger(self.shape, self._wanted())
        ledger.note_first(known)
        for chunk in ledger.chunks(ss=slice(known, self.shape[3])):
            if self.chunk_file(chunk).exists():
                # A damaged chunk counts as stored, so that reading it reports the damage.
                ledger.note(chunk)
                with contextlib.suppress(DamageError):
                    ledger.note(chunk, self._label(chunk)[0])
        return ledger

    def _lay_out(self) -> None:
        """Make the arrays that decode and encode chunks, without reading."""
        from zarr.storage import MemoryStore

        metadata = self._layout_of({})
        self._radiance = layout.array(zarr_store(self.path), "radiance", metadata)
        self._encoded: dict[str, Any] = {}
        self._encoder = layout.array(MemoryStore(self._encoded), "radiance", metadata)

    @property
    def _is_film(self) -> bool:
        return FILM_STEPS in self._attributes

    def _layout_of(self, attributes: Mapping[str, Any]) -> dict[str, Any]:
        of_kind = layout.film_metadata if self._is_film else layout.radiance_metadata
        return of_kind(self.shape, attributes)

    def pending(self) -> list[Chunk]:
        """Return the chunks that are not safely stored yet, in the order of rendering."""
        return self.ledger.pending()

    def to_draw(self, chunk: Chunk) -> Chunk:
        """Return a chunk with its missing samples marked, if counts differ on purpose."""
        return self.ledger.to_draw(chunk, lambda c: self.read(c.ys, c.xs, c.ss))

    def chunk_file(self, chunk: Chunk) -> Path:
        """Return the file that holds a chunk."""
        return self.path / f"radiance/c/{chunk.tile_y}/{chunk.tile_x}/0/{chunk.batch}"

    def parts(self) -> dict[LightPart, Store]:
        """Open the stores of the same samples with a part of their light: depths, then lights.

        Raises
        ------
        StoreError
            If one cannot be read, or has other samples.
        """
        return {part: self._part(part) for part in layout.parts_in(self.path, self._manifest)}

    def _part(self, which: LightPart) -> Store:
        path = self.path / layout.part_folder(which)
        part = Store.open(path)
        ours, theirs = self._same, part._same
        if names := layout.differing(ours, theirs):
            detail = "; ".join(f"{n}: {theirs[n]}, not {ours[n]}" for n in names)
            message = (
                f"{path} is not of the same samples as {self.path} ({detail}); move it away, and "
                "render it with: chdstat render --direct, --by-depth, --light or --film"
            )
            raise StoreError(message)
        return part

    @property
    def _same(self) -> dict[str, Any]:
        """Attributes that must agree if samples only differ by a part of their light."""
        attrs = self.attrs
        integrator = attrs.get("integrator") or {}
        equal = {name: attrs.get(name) for name in _SAME}
        equal["integrator"] = {k: v for k, v in integrator.items() if k != "max_depth"}
        return {"shape": self.shape[:2], **equal}

    # --- reading --------------------------------------------------------------------------------

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Read a part of the radiance, NaN where nothing was rendered yet.

        Raises
        ------
        StoreError
            If a chunk is damaged, missing or in the wrong place; the message says where.
        """
        try:
            for chunk in self.ledger.chunks(ys, xs, ss):
                if self.ledger.held[chunk.index]:
                    self._check(chunk)
            found = self._radiance[ys, xs, :, ss]
            return of_steps(found) if self._is_film else np.asarray(found, dtype=np.float32)
        except FOREIGN as error:
            files = [self.chunk_file(c) for c in self._damaged_chunks(ys, xs, ss)]
            raise self._damage(files, layout.brief(error)) from error

    def _label(self, chunk: Chunk) -> tuple[int, int, int]:
        return layout.read_label(self.chunk_file(chunk), self._manifest["identity"], chunk)

    def _check(self, chunk: Chunk, *, content: bool = False) -> None:
        """Raise `DamageError` unless a chunk's file is the right one, with all its samples.

        With `content`, its checksum is compared, too.
        """
        samples, length, told = self._label(chunk)
        if samples < self.ledger.held[chunk.index]:
            message = "it is an older one, with fewer samples"
            raise DamageError(message)
        if content and checksum(self.chunk_file(chunk).read_bytes()[:length]) != told:
            message = "its checksum does not match"
            raise DamageError(message)

    def _damaged_chunks(
        self, ys: slice = ALL, xs: slice = ALL, ss: slice = ALL, *, content: bool = True
    ) -> list[Chunk]:
        """Return the stored chunks in a part that are damaged, by their labels or their content."""
        damaged = []
        for chunk in self.ledger.chunks(ys, xs, ss):
            try:
                if self.ledger.held[chunk.index]:
                    self._check(chunk, content=content)
            except FOREIGN:
                damaged.append(chunk)
        return damaged

    def damaged(self, *, content: bool = True) -> list[Path]:
        """Return the files that are missing, damaged or in the wrong place.

        All chunks are read; without `content`, only their labels.
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
        """Return the first-hit features that are stored, by name, and the costs of samples.

        Raises
        ------
        StoreError
            If one is damaged.
        """
        costs = {COSTS} & self._manifest["features"].keys()
        return {name: self._read_feature(name) for name in [*self.feature_names, *costs]}

    @property
    def feature_names(self) -> list[str]:
        """Names of the first-hit features that belong to the store."""
        apart = {layout.COUNTS, layout.DENSITY, COSTS, *layout.GUIDE, layout.FORMER_GUIDE}
        return sorted(self._manifest["features"].keys() - apart)

    @property
    def has_costs(self) -> bool:
        """Whether samples were timed."""
        return COSTS in self._manifest["features"]

    def guide(self) -> dict[str, Image] | None:
        """Return the arrays of the samples' guide; None if there is none that can be read.

        Raises
        ------
        StoreError
            If an earlier version made the guide.
        """
        if layout.FORMER_GUIDE in self._manifest["features"]:
            message = (
                f"{self.path}: an earlier chdstat made the guide of its samples, which this one "
                "cannot draw by; render into a new store, or continue this one with that version"
            )
            raise StoreError(message)
        try:
            return {name: self._read_feature(name) for name in layout.GUIDE}
        except (KeyError, StoreError):
            return None

    def _read_feature(self, name: str) -> Image:
        about = self._manifest["features"][name]
        file = self.path / layout.feature_file(name, about["shape"])
        try:
            if checksum(file.read_bytes()) not in (about["checksum"], about.get("former")):
                message = "its checksum does not match"
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
        """Return the error that names damaged files and says how to repair them."""
        named = ", ".join(map(str, files)) or self.path
        return StoreError(
            f"cannot read {named} ({why}); run the same 'chdstat render' or import again to repair "
            "it ('chdstat info --verify' lists all that is damaged)"
        )

    def _metadata(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the metadata files and their right content, the manifest first."""
        # Times are left out, so that equal samples are equal files.
        copy = {k: v for k, v in self._attributes.items() if k != "render_seconds"}
        features = {k: v for k, v in self._manifest["features"].items() if k != COSTS}
        copy["manifest"] = {**self._manifest, "features": features}
        yield "zarr.json", layout.group_metadata(layout.signed(self._attributes))
        yield "radiance/zarr.json", self._layout_of(layout.signed(copy))
        features = self._manifest["features"]
        if features:
            yield "features/zarr.json", layout.group_metadata({})
        for name, about in features.items():
            yield f"features/{name}/zarr.json", layout.feature_metadata(about["shape"])

    # --- writing --------------------------------------------------------------------------------

    def write(self, chunk: Chunk, block: Image) -> None:
        """Store one chunk, or add its missing samples; `block` is (y, x, channel, sample)."""
        if chunk.missing is not None and self.ledger.held[chunk.index]:
            held = self.read(chunk.ys, chunk.xs, chunk.ss)
            block = np.where(chunk.missing[:, :, np.newaxis], block, held)
        self.put(chunk, block)
        self.note(chunk)

    def put(self, chunk: Chunk, block: Image) -> None:
        """Write the file of one chunk, as any process may."""
        self._encoder[chunk.ys, chunk.xs, :, chunk.ss] = to_steps(block) if self._is_film else block
        key = self.chunk_file(chunk).relative_to(self.path).as_posix()
        content = self._encoded.pop(key).to_bytes()
        with layout.disk_errors(self.path):
            samples = int(self.ledger.full[chunk.index])
            labelled = layout.labelled(content, self._manifest["identity"], chunk, samples)
            layout.put(self.path / key, labelled)

    def note(self, chunk: Chunk) -> None:
        """Count a chunk as stored, whoever wrote its file."""
        self.ledger.note(chunk)
        if self.ledger.complete_spp > self._manifest["complete"]:
            self.update()

    def update(self, *, parts: Iterable[LightPart] = (), **attrs: Any) -> None:
        """Change attributes, and record the samples that every pixel has, and the parts."""
        before = self._attributes
        complete = max(self._manifest["complete"], self.ledger.complete_spp)
        held = {**self._manifest, "shape": list(self.shape), "complete": complete}
        self._change(layout.with_parts(held, parts), **attrs)
        if self._attributes != before:
            with layout.disk_errors(self.path):
                self._save()

    def timed(self, chunk: Chunk, costs: SampleCosts) -> None:
        """Take note of what the samples of a chunk took; `spent` writes it."""
        self._timed = with_times(self._timed, self.shape, chunk, costs)

    def spent(self, seconds: float) -> None:
        """Add to the rendering time, unless the disk is full, which `write` has reported."""
        before = float(self.attrs.get("render_seconds", 0.0))
        with contextlib.suppress(StoreError):
            self.update(render_seconds=round(before + seconds, 3))
            if self._timed is not None:
                self.add_costs(self._timed)
                self._timed = None

    def add_costs(self, costs: SampleCosts) -> None:
        """Add times of samples to those that are stored; damaged ones are lost."""
        if COSTS in self._manifest["features"]:
            with contextlib.suppress(StoreError):
                costs = SampleCosts.of_array(self._read_feature(COSTS)).merge(costs)
        self.renew({COSTS: costs.to_array()})

    def finish(self, parts: Mapping[LightPart, Samples] | None = None) -> Samples:
        """Return the samples that every pixel has, with the parts of their light."""
        self.update(parts=parts or ())
        return _of_store(self, parts)

    def discard(self) -> None:
        """Remove the store, if no samples were written to it."""
        if self._stored().held.any():
            return
        if is_remote(self.path):
            with layout.disk_errors(self.path):
                cast("Any", self.path).rmdir(recursive=True)
        else:
            remove(self.path)

    def extend(self, spp: int) -> None:
        """Make room for more samples per pixel; stored samples stay."""
        if spp > self.shape[3]:
            self._attributes["spp"] = spp
            self._grow(spp)

    def fit(self, held: int, spp: int) -> None:
        """Keep the first `held` samples of every pixel, and make room for `spp` in all.

        Others that are there, such as those of a killed writer, will be overwritten.
        """
        self.shape, self.ledger = (*self.shape[:3], spp), Ledger((*self.shape[:3], spp), None)
        self.ledger.note_first(held)
        self._lay_out()
        self._change({"shape": list(self.shape), "complete": held}, spp=spp)
        with layout.disk_errors(self.path):
            self._save()

    def _grow(self, spp: int) -> None:
        """Make room for more samples of every pixel, or of some pixels."""
        self.shape = (*self.shape[:3], max(spp, self.shape[3]))
        self.ledger = self.ledger.grown(self.shape, self._wanted())
        self._lay_out()
        complete = self.ledger.complete_spp  # of counts that grew, fewer than before
        self._change({"shape": list(self.shape), "complete": complete})
        with layout.disk_errors(self.path):
            self._save()

    def decide(self, density: Image, spp: float, noise: Mapping[str, Any]) -> None:
        """Let pixels have different numbers of samples from now on, `spp` on average."""
        if self.density is not None and spp <= self._attributes["spp"]:
            return
        if self.density is None or not np.array_equal(self.density, density):
            with layout.disk_errors(self.path):
                self._write_feature(layout.DENSITY, density)
        self.density = density
        self._attributes |= {"noise": dict(noise), "spp": spp}
        self._grow(int(cast("Any", self.counts()).max()))

    @property
    def lacks_features(self) -> bool:
        """Whether first-hit features are missing or damaged."""
        return not self.feature_names or bool(self._damaged_features())

    def restore(self, features: Mapping[str, Image], why_none: str = "") -> None:
        """Write features that are missing or damaged, or why there are none."""
        if self.lacks_features:
            if COSTS in self._damaged_features():  # lost
                held = self._manifest["features"]
                self._change({"features": {n: a for n, a in held.items() if n != COSTS}})
            with layout.disk_errors(self.path):
                for name, image in features.items():
                    self._write_feature(name, image)
                self._save()
            if why_none:
                self.update(why_no_features=why_none)

    def _write_feature(self, name: str, image: Image) -> None:
        key, content = _encoded_feature(name, image)
        layout.put(self.path / key, content)
        about = {"shape": list(image.shape), "checksum": checksum(content)}
        self._change({"features": {**self._manifest["features"], name: about}})

    def renew(self, features: Mapping[str, Image], **attrs: Any) -> None:
        """Replace features by others of the same names, and change attributes.

        If the writer is killed meanwhile, each of them is the former or the new one.
        """
        if features.keys() - self._manifest["features"].keys():
            with layout.disk_errors(self.path):
                for name, image in features.items():
                    self._write_feature(name, image)
                self._change({}, **attrs)
                self._save()
            return
        before, made = self._manifest["features"], {}
        for name, image in features.items():
            key, content = _encoded_feature(name, image)
            made[name] = {**before[name], "checksum": checksum(content)}, self.path / key, content
        with layout.disk_errors(self.path):
            former = {n: a | {"former": before[n]["checksum"]} for n, (a, *_) in made.items()}
            self._change({"features": {**before, **former}}, **attrs)
            self._save()
            for _, file, content in made.values():
                layout.put(file, content)
            self._change({"features": {**before, **{n: a for n, (a, *_) in made.items()}}})
            self._save()

    def _change(self, held: Mapping[str, Any], **attrs: Any) -> None:
        """Change the manifest and attributes; `_save` writes them."""
        self._attributes = {**self._attributes, **attrs, "manifest": {**self._manifest, **held}}

    def _save(self) -> None:
        """Write metadata that differs from what it should be, the manifest first."""
        for name, content in self._metadata():
            if layout.loaded(self.path / name) != content:
                layout.put(self.path / name, json.dumps(content, indent=2, sort_keys=True).encode())


def _encoded_feature(name: str, image: Image) -> tuple[str, bytes]:
    """Return the file of a first-hit feature within its store, and its content."""
    from zarr.storage import MemoryStore

    held: dict[str, Any] = {}
    metadata = layout.feature_metadata(image.shape)
    layout.array(MemoryStore(held), f"features/{name}", metadata)[...] = image
    ((key, encoded),) = held.items()
    return key, encoded.to_bytes()


# --- opening ------------------------------------------------------------------------------------


def open(path: str | Path) -> Samples:  # noqa: A001 - chdstat.open reads like open
    """Open a store of samples.

    A store whose render is running or was stopped opens with the samples that every pixel has;
    ``attrs["spp"]`` is the number that was asked for.

    Parameters
    ----------
    path
        The store, as written by `chdstat.render` or ``chdstat render``: a folder, or any URL that
        fsspec reaches, such as ``s3://bucket/room.zarr``.

    Raises
    ------
    StoreError
        If there is no store, it is damaged or has another schema, it holds no complete batch, or
        its folder ``direct`` holds other samples.
    """
    store = Store.open(place_of(path))
    if not store.ledger.complete_spp:
        message = (
            f"{path} holds no sample that every pixel has: its rendering was stopped early. "
            "Run the same 'chdstat render' or import again to resume it"
        )
        raise StoreError(message)
    parts = store.parts().items()
    return _of_store(store, {k: _of_store(part) for k, part in parts if part.ledger.complete_spp})


def _of_store(store: Store, parts: Mapping[LightPart, Samples] | None = None) -> Samples:
    """Return the samples that every pixel of an open store has, and as many of their parts."""
    height, width, _, _ = store.shape
    spp = store.ledger.complete_spp
    known = {
        which: found if found.spp <= spp else found.isel(sample=slice(spp))
        for which, found in (parts or {}).items()
    }
    return Samples(
        store,
        attrs=store.attrs,
        parts=known,
        part=(range(height), range(width), range(spp)),
        path=store.path,
        counts=store.counts(),
    )


@functools.lru_cache(maxsize=8)
def reopened(path: Path, identity: str, complete: int, shape: tuple[int, ...]) -> Store:
    """Return a store in another process than the one that sent its path; it is opened once.

    Raises
    ------
    StoreError
        If this process does not see the store, or sees another one.
    """
    try:
        store = Store.open(path)
    except StoreError as error:
        message = f"a worker cannot read {path}, which all workers must see there: {error}"
        raise StoreError(message) from error
    _, own, done, size = store.place
    if own != identity or done < complete or size[3] < shape[3]:
        message = f"a worker sees another store at {path} than is read here"
        raise StoreError(message)
    return store


def cache_key(samples: Samples) -> str:
    """Return a key that identifies samples of a store, for a `Cache`; "" for samples in memory.

    It holds all attributes of the store, including the rendering time, since another render may
    take its place and name.
    """
    if samples.path is None:
        return ""
    attrs = json.dumps(samples.attrs, sort_keys=True).encode()
    return f"{samples.path.stem}-{hashlib.sha256(attrs).hexdigest()[:12]}-{samples.spp}"


def checkpoint_key(samples: Samples) -> str:
    """Return a text that identifies samples; for those in memory, by their content.

    Examples
    --------
    >>> one, two = (Samples.from_array(np.full((4, 4, 8), value)) for value in (1, 2))
    >>> checkpoint_key(one) == checkpoint_key(two), checkpoint_key(one) == checkpoint_key(one)
    (False, True)
    """
    known = [samples.attrs, samples.shape, repr(samples.part), _content(samples)]
    text = json.dumps(known, sort_keys=True, default=str).encode()
    return hashlib.sha256(text).hexdigest()[:16]


def inspect(path: str | Path, *, verify: bool = False) -> dict[str, Any]:
    """Return the content of a store, finished or not, ready for JSON.

    Parameters
    ----------
    path
        The store.
    verify
        Read everything and compare checksums. Otherwise, only check that files are there and in
        their places. ``damaged`` lists the files that fail.

    Raises
    ------
    StoreError
        If there is no store.
    """
    store = Store.open(place_of(path))
    parts, counts = store.parts(), store.counts()
    height, width, channels, spp = store.shape
    files = [f for f in store.path.rglob("*") if f.is_file()]
    found = {
        **store.attrs,
        "path": str(shown(store.path)),
        "shape": {"y": height, "x": width, "channel": channels, "sample": spp},
        "complete_spp": store.ledger.complete_spp,
        "pending_chunks": len(store.pending()),
        "direct_spp": parts[DIRECT_DEPTH].ledger.complete_spp if DIRECT_DEPTH in parts else 0,
        "depths": {str(k): p.ledger.complete_spp for k, p in parts.items() if is_depth(k)},
        "film_spp": parts[FILM].ledger.complete_spp if FILM in parts else 0,
        "lights": {k: p.ledger.complete_spp for k, p in parts.items() if isinstance(k, str)},
        "features": store.feature_names,
        "costs": store.has_costs,
        "counts": None if counts is None else [int(counts.min()), int(counts.max())],
        "bytes": sum(f.stat().st_size for f in files),
    }
    damaged = store.damaged(content=verify)
    if verify or damaged:
        found["damaged"] = [str(file) for file in damaged]
    return found


def opened(
    x: ImageLike | npt.ArrayLike, *, averages: bool = False, dependent: bool = False
) -> Samples | npt.ArrayLike:
    """Return the samples of a store from its path; everything else is returned as it is.

    Raises
    ------
    InputError
        If it holds averages of batches and the caller does not take `averages`, or samples that
        depend on each other and the caller does not take `dependent` ones.
    StoreError
        If there is no store at the path, or `open` refuses it.
    """
    found = open(x) if is_path(x) else cast("Samples | npt.ArrayLike", x)
    if isinstance(found, Samples):
        if not averages:
            check_single(found.attrs)
        if not dependent:
            check_independent(found.attrs)
    return found


def samples_of(
    source: ImageLike | npt.ArrayLike, *, averages: bool = False, dependent: bool = False
) -> Samples:
    """Return the samples of an image from `Samples`, an array or a store's path.

    Raises
    ------
    InputError
        If it is none of these, or `opened` or `Samples.from_array` refuses it.
    StoreError
        As for `opened`.
    """
    found = opened(source, averages=averages, dependent=dependent)
    if isinstance(found, Samples):
        return found
    if hasattr(found, "__array__"):  # NumPy, xarray, Dask, torch
        return Samples.from_array(found)
    message = (
        "expected Samples, an array (y, x, channel, sample) or the path of a store, "
        f"got {type(source).__name__}"
    )
    raise InputError(message)


# --- saving -------------------------------------------------------------------------------------


def save(samples: Samples, path: Path, *, append: bool, progress: bool) -> Samples:
    """Write samples to a new store, or append them to an existing one; see `Samples.save`."""
    attrs = _described(samples)
    if not is_store(path):
        if append:
            message = f"there is no store at {path} to append to; leave out append= to make one"
            raise StoreError(message)
        shape = samples.shape
        features = dict(samples.features)
        if samples.costs is not None:
            features[COSTS] = samples.costs.to_array()
        if samples.unequal:
            features[layout.COUNTS] = samples.counts.astype(np.float32)
        store = Store.create(path, shape=shape, attrs=attrs, features=features)
        first = 0
    elif append:
        appended = _appended(samples, path, attrs)
        store, first = Store.open(path, writable=True), int(appended[-1]["first"])
    else:
        store, first = _interrupted(samples, path, attrs), 0
    with store:
        if append:
            store.extend(first + samples.spp)
            store.update(appended=appended)
        _fill(store, samples, first, progress)
        if append and samples.costs is not None:
            store.add_costs(samples.costs)
        if append:
            store.finish()
            return open(path)  # with the parts of the samples that were there
        parts = {
            which: save(part, path / layout.part_folder(which), append=False, progress=progress)
            for which, part in samples.parts.items()
        }
        return store.finish(parts)


def _described(samples: Samples) -> dict[str, Any]:
    """Return the attributes that a store keeps of samples: their origin and identity."""
    check_sequences(samples.attrs, samples.part[2])
    attrs = {k: v for k, v in samples.attrs.items() if k not in _OF_A_STORE}
    height, width, _, spp = samples.shape
    moved = any(r.start or r.step != 1 for r in samples.part)
    if moved or attrs.get("size", [width, height]) != [width, height]:
        # Pixels in another place have other random numbers.
        attrs = {k: v for k, v in attrs.items() if k not in ("seed", "streams")}
    return {
        "scene": samples.name,
        **attrs,
        "size": [width, height],
        "spp": spp,
        "chdstat_version": importlib.metadata.version("chdstat"),
        "content": _content(samples),
    }


def _content(samples: Samples) -> str:
    """Return a hash that recognises the same samples when saving is repeated."""
    if samples.source is None:
        digest = hashlib.blake2b(digest_size=16)
        for *_, block in samples.blocks():
            digest.update(np.ascontiguousarray(block).data)
        return digest.hexdigest()
    about = [str(samples.source.path), samples.attrs, list(samples.shape), repr(samples.part)]
    return hashlib.blake2b(layout.canonical(about), digest_size=16).hexdigest()


def _interrupted(samples: Samples, path: Path, attrs: Mapping[str, Any]) -> Store:
    """Return a store of the same samples that lacks some: it was interrupted or is damaged.

    Raises
    ------
    StoreError
        If it holds other samples, or lacks none.
    """
    held, what = Store.open(path), "other samples"
    if held.attrs.get("content") == attrs["content"] and held.shape == samples.shape:
        store, what = Store.open(path, writable=True), "these samples already"
        if store.pending():
            return store
        store.close()
    message = (
        f"{path} holds {what}; nothing was changed. Give another path, or append to add these "
        "to those that are there"
    )
    raise StoreError(message)


def _appended(samples: Samples, path: Path, attrs: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what was appended to a store and where it begins, with these samples as the last."""
    held = Store.open(path)
    appended = list(held.attrs.get("appended", []))
    begun = bool(appended) and bool(held.pending()) and appended[-1]["content"] == attrs["content"]
    if held.shape[:3] != samples.shape[:3]:
        message = (
            f"{path} holds samples of shape (y, x, channel) = {held.shape[:3]}, those to append "
            f"have {samples.shape[:3]}"
        )
        raise InputError(message)
    if held.pending() and not begun:
        message = f"{path} is not complete: repeat first what was interrupted"
        raise StoreError(message)
    if held.counts() is not None or samples.unequal:
        message = (
            "samples can be appended where each pixel has as many as the others; import those of "
            "different numbers together"
        )
        raise InputError(message)
    length = sequence_of(held.attrs)
    if length != sequence_of(samples.attrs) or held.shape[3] % length:
        message = (
            f"{path} holds {held.shape[3]} samples in sequences of {length}, those to append are "
            f"in sequences of {sequence_of(samples.attrs)} (1: independent); save them to a store "
            "of their own"
        )
        raise InputError(message)
    if not begun:
        before = [held.attrs, *appended]
        if attrs["content"] in {a.get("content") for a in before}:
            message = f"{path} holds these samples already; nothing was changed"
            raise InputError(message)
        seed = attrs.get("seed")
        if seed is not None and seed in [a.get("seed") for a in before]:
            message = (
                f"{path} holds samples of seed {seed} already: these would repeat them, and make "
                "errors look smaller than they are. Render with another seed"
            )
            raise InputError(message)
        named = {k: attrs[k] for k in ("content", "seed", "scene_source") if k in attrs}
        appended.append({**named, "first": held.shape[3]})
    return appended


def _fill(store: Store, samples: Samples, first: int, progress: bool) -> None:
    """Write the missing chunks; the samples begin at number `first`."""
    chunks = store.pending()
    by_frame = samples.source is not None and samples.source.frames
    if not by_frame:  # all samples of a pixel lie together: go through them tile by tile
        chunks.sort(key=lambda c: (c.tile_y, c.tile_x, c.batch))
    description, size = f"writing {store.path.name}", sum(c.size for c in chunks)
    with track(description, size, unit="S", show=progress) as advance:
        for chunk in chunks:
            begun, stop = chunk.ss.start, chunk.ss.stop
            new = samples.read(chunk.ys, chunk.xs, slice(max(0, begun - first), stop - first))
            if begun < first:  # the chunk holds samples already
                old = store.read(chunk.ys, chunk.xs, slice(begun, first))
                new = np.concatenate([old, new], axis=-1)
            store.write(chunk, new)
            advance(chunk.size)
