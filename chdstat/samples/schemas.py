"""Schemas of a store: how its files are checked and read, today's (2) and the first (1).

Stores of schema 1 are read only. They had a ledger of the samples in each chunk in place of labels,
and no checksums of features or attributes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
from zarr.storage import LocalStore

from chdstat._core.files import checksum
from chdstat.errors import StoreError
from chdstat.samples.layout import (
    BATCH,
    Chunk,
    Image,
    Shape,
    array,
    chunk_file,
    chunks_within,
    empty_ledger,
    feature_file,
    feature_metadata,
    grid,
    metadata_files,
    radiance_metadata,
    read_label,
)
from chdstat.samples.manifest import (
    FOREIGN,
    DamageError,
    brief,
    content_of,
    incomplete,
    listed,
    loaded,
    signed,
)

__all__ = ["FirstSchema", "Schema", "SecondSchema"]

_MOST_CHANNELS = 64
_FEATURES = ("albedo", "normal", "depth", "position")


class SecondSchema:
    """Files of a store of schema 2: chunks with labels, features with checksums.

    Parameters
    ----------
    path
        The store.
    identity
        Hash of all that its samples depend on, as the labels of its chunks have it.
    """

    def __init__(self, path: Path, identity: str) -> None:
        self.path, self.identity = path, identity

    def radiance(self, shape: Shape) -> Any:
        """Return the array that decodes chunks; nothing is read for it."""
        place = LocalStore(self.path, read_only=True)
        return array(place, "radiance", radiance_metadata(shape, {}))

    def ledger(self, shape: Shape, known: int) -> npt.NDArray[np.int32]:
        """Return the samples in each chunk: as known, and beyond that from what is there."""
        spp = shape[3]
        ledger = empty_ledger(shape)
        starts = BATCH * np.arange(ledger.shape[2])
        ledger[...] = np.clip(known - starts, 0, np.minimum(BATCH, spp - starts))
        if known >= spp:
            return ledger
        there = {
            (y, x): set(listed(self.path / f"radiance/c/{y}/{x}/0"))
            for y, x in np.ndindex(ledger.shape[:2])
        }
        for chunk in chunks_within(shape, ss=slice(known, spp)):
            if str(chunk.batch) in there[chunk.index[:2]]:
                # A damaged chunk counts as stored, so that reading it reports the damage.
                ledger[chunk.index] = chunk.shape[2]
                with contextlib.suppress(DamageError):
                    ledger[chunk.index] = min(self._label(chunk)[0], chunk.shape[2])
        return ledger

    def _label(self, chunk: Chunk) -> tuple[int, int, int]:
        return read_label(chunk_file(self.path, chunk), self.identity, chunk)

    def check(self, chunk: Chunk, samples: int) -> None:
        """Raise `DamageError` unless the file of a chunk is its own, with so many samples."""
        if self._label(chunk)[0] < samples:
            message = "it is an older one, with fewer samples"
            raise DamageError(message)

    def is_whole(self, chunk: Chunk, _radiance: Any) -> bool:
        """Return whether the content of a chunk has its checksum."""
        _, length, told = self._label(chunk)
        return checksum(chunk_file(self.path, chunk).read_bytes()[:length]) == told

    def read_feature(self, name: str, about: Mapping[str, Any]) -> Image:
        """Return a first-hit feature; a `StoreError` if it is damaged."""
        if self.feature_is_damaged(name, about):
            file = self.path / feature_file(name, about["shape"])
            raise self.damage([file], "its checksum is another")
        place = LocalStore(self.path, read_only=True)
        image = array(place, f"features/{name}", feature_metadata(about["shape"]))
        return np.asarray(image[...], dtype=np.float32)

    def feature_is_damaged(self, name: str, about: Mapping[str, Any]) -> bool:
        """Return whether a feature is gone or has another checksum."""
        content = content_of(self.path / feature_file(name, about["shape"]))
        return content is None or checksum(content) != about["checksum"]

    def damage(self, files: list[Path], why: str) -> StoreError:
        """Return the error that names damaged files and how to repair them."""
        named = ", ".join(map(str, files)) or self.path
        return StoreError(
            f"cannot read {named} ({why}); run the same 'chdstat render' again to repair it "
            "('chdstat info --verify' lists all that is damaged)"
        )

    def metadata(
        self, attributes: Mapping[str, Any], shape: Shape
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the metadata files of the group and its arrays, with what belongs into them."""
        # All but the time, so that equal samples are equal files.
        copy = {k: v for k, v in attributes.items() if k != "render_seconds"}
        return metadata_files(signed(attributes), signed(copy), shape)


class FirstSchema:
    """Files of a store of schema 1: read as it says, as far as that agrees with itself."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def contents(
        self, attributes: Mapping[str, Any]
    ) -> tuple[Shape, npt.NDArray[np.int32], dict[str, Any]]:
        """Return the shape of the samples, the ledger and what stands for a manifest.

        Raises
        ------
        StoreError
            If attributes, samples and ledger disagree.
        """
        path = self.path
        try:
            width, height = attributes["size"]
            shape = tuple(loaded(path / "radiance/zarr.json")["shape"])  # type: ignore[index]
            stored = zarr.open_array(LocalStore(path, read_only=True), path="ledger", mode="r")
            names = [n for n in _FEATURES if (path / "features" / n / "zarr.json").exists()]
            agrees = (
                shape[:2] == (height, width)
                and all(type(n) is int and n > 0 for n in shape)
                and shape[2] <= _MOST_CHANNELS
                and shape[3] <= attributes["spp"]
                and stored.shape[:2] == grid(shape)[:2]
                and stored.shape[2] >= grid(shape)[2]  # it grew before the samples did
                and not np.any(stored[..., grid(shape)[2] :])
                and isinstance(attributes.get("integrator", {}), dict)
            )
            if not agrees:
                message = "its attributes, samples and ledger disagree"
                raise DamageError(message)
            ledger = np.asarray(stored[..., : grid(shape)[2]], dtype=np.int32)
            for chunk in chunks_within(shape):
                file = chunk_file(path, chunk)
                there = file.is_file() and file.stat().st_size > 0
                ledger[chunk.index] = np.clip(ledger[chunk.index], 0, there * chunk.shape[2])
        except FOREIGN as error:
            raise incomplete(path, brief(error)) from error
        features = {name: {"size": shape[:2]} for name in names}
        return shape, ledger, {"features": features, "direct": False}

    def radiance(self, shape: Shape) -> Any:
        """Return the array that decodes chunks; nothing is read for it."""
        place = LocalStore(self.path, read_only=True)
        return array(place, "radiance", radiance_metadata(shape, {}, index="end"))

    def check(self, chunk: Chunk, _samples: int) -> None:
        """Raise `DamageError` if the file of a chunk is gone."""
        if not chunk_file(self.path, chunk).is_file():
            message = "it is gone"
            raise DamageError(message)

    def is_whole(self, chunk: Chunk, radiance: Any) -> bool:
        """Decode a chunk, whose blocks have checksums."""
        radiance[chunk.ys, chunk.xs, :, chunk.ss]
        return True

    def read_feature(self, name: str, about: Mapping[str, Any]) -> Image:
        """Return a first-hit feature; a `StoreError` if it is damaged."""
        folder = self.path / "features" / name
        try:
            image = zarr.open_array(LocalStore(folder, read_only=True), mode="r")
            if image.shape not in (about["size"], (*about["size"], 3)):
                message = f"its shape is {image.shape}"
                raise DamageError(message)
            return np.asarray(image[...], dtype=np.float32)
        except FOREIGN as error:
            raise self.damage([folder], brief(error)) from error

    def feature_is_damaged(self, name: str, about: Mapping[str, Any]) -> bool:
        """Return whether a feature cannot be read."""
        try:
            self.read_feature(name, about)
        except StoreError:
            return True
        return False

    def damage(self, files: list[Path], why: str) -> StoreError:
        """Return the error that names damaged files and what to do."""
        named = ", ".join(map(str, files)) or self.path
        return StoreError(
            f"cannot read {named} ({why}); delete the damaged file (all are listed by "
            "'chdstat info --verify'), and keep the rest with: "
            f"chdstat convert {self.path} -o NEW"
        )

    def metadata(
        self, _attributes: Mapping[str, Any], _shape: Shape
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield nothing: it is not known what belongs into them."""
        return iter(())


Schema = SecondSchema | FirstSchema
