"""Stores of the first schema, which earlier versions wrote: they are read and converted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
from zarr.storage import LocalStore

from chdstat._core.arrays import Image
from chdstat.errors import StoreError
from chdstat.samples import layout
from chdstat.samples.layout import FOREIGN, Chunk, DamageError, brief
from chdstat.samples.store import Store

__all__ = ["FirstStore"]

_MOST_CHANNELS = 64
_FEATURES = ("albedo", "normal", "depth", "position")


class FirstStore(Store):
    """A store of the first schema, which is read only, as it says, as far as that agrees.

    It has a ledger of the samples in each chunk in place of labels, and no checksums of features
    or attributes.
    """

    _index_location = "end"

    def __init__(self, path: Path, attributes: Mapping[str, Any]) -> None:
        try:
            width, height = attributes["size"]
            shape = tuple(layout.loaded(path / "radiance/zarr.json")["shape"])  # type: ignore[index]
            grid = layout.grid(shape)
            self._ledger = zarr.open_array(
                LocalStore(path, read_only=True), path="ledger", mode="r"
            )
            agrees = (
                shape[:2] == (height, width)
                and all(type(n) is int and n > 0 for n in shape)
                and shape[2] <= _MOST_CHANNELS
                and shape[3] <= attributes["spp"]
                and self._ledger.shape[:2] == grid[:2]
                and self._ledger.shape[2] >= grid[2]  # it grew before the samples did
                and not np.any(self._ledger[..., grid[2] :])
                and isinstance(attributes.get("integrator", {}), dict)
            )
            if not agrees:
                message = "its attributes, samples and ledger disagree"
                raise DamageError(message)
            names = [n for n in _FEATURES if (path / "features" / n / "zarr.json").exists()]
            features = dict.fromkeys(names)
            manifest = {"shape": shape, "complete": 0, "features": features, "direct": False}
            super().__init__(path, {**attributes, "manifest": manifest})
        except FOREIGN as error:
            raise layout.incomplete(path, brief(error)) from error

    def _stored(self) -> npt.NDArray[np.int32]:
        ledger = np.asarray(self._ledger[..., : layout.grid(self.shape)[2]], dtype=np.int32)
        for chunk in self._chunks():
            file = self.chunk_file(chunk)
            there = file.is_file() and file.stat().st_size > 0
            ledger[chunk.index] = np.clip(ledger[chunk.index], 0, there * chunk.shape[2])
        return ledger

    def _check(self, chunk: Chunk) -> None:
        if not self.chunk_file(chunk).is_file():
            message = "it is gone"
            raise DamageError(message)

    def _check_content(self, chunk: Chunk) -> None:
        self._radiance[chunk.ys, chunk.xs, :, chunk.ss]  # its blocks have checksums

    def _read_feature(self, name: str) -> Image:
        folder, size = self.path / "features" / name, self.shape[:2]
        try:
            image = zarr.open_array(LocalStore(folder, read_only=True), mode="r")
            if image.shape not in (size, (*size, 3)):
                message = f"its shape is {image.shape}"
                raise DamageError(message)
            return np.asarray(image[...], dtype=np.float32)
        except FOREIGN as error:
            raise self._damage([folder], brief(error)) from error

    def _damage(self, files: list[Path], why: str) -> StoreError:
        named = ", ".join(map(str, files)) or self.path
        return StoreError(
            f"cannot read {named} ({why}); delete the damaged file (all are listed by "
            "'chdstat info --verify'), and keep the rest with: "
            f"chdstat convert {self.path} -o NEW"
        )

    def _metadata(self) -> Iterator[tuple[str, dict[str, Any]]]:
        return iter(())  # it is not known what belongs into them
