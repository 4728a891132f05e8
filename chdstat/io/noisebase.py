"""Sample sets of noisebase: a zarr group in a zip file, with what each sample has hit.

``color`` holds radiance as uint8, shape (4, y, x, sample): red, green, blue, and an exponent E that
they share. Between ``exposure``, the least and the largest logarithm of radiance in the frame, the
exponent stands for a radiance ``exp(least + (E + 1) / 256 (largest - least))``, of which red is
R / 255. The colours are rounded at random, without bias; two samples of a pixel may be equal for
it. ``position`` (float32), ``normal`` and ``diffuse`` (float16) have the shape (3, y, x, sample).
In files of training data, all arrays have one axis more, the first, of frames.

Sources: A. Balint et al., "Neural partitioning pyramids for denoising Monte Carlo renderings",
SIGGRAPH 2023, doi:10.1145/3588432.3591562; balintio/noisebase (docs/formats/sample_test_v1.md,
docs/formats/sample_training_v1.md, noisebase/compression.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.files import check_claim
from chdstat.errors import InputError, StoreError
from chdstat.io.arrays import DAMAGED
from chdstat.io.frames import Frame, Frames
from chdstat.io.reading import Opened, ReadOptions
from chdstat.samples.tiles import Image

__all__ = ["open_noisebase"]

_FEATURES = {"albedo": "diffuse", "normal": "normal", "position": "position"}


def open_noisebase(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open one frame: that of number `variable`, the first of a sequence if there is none given.

    Albedo, normal and position are the averages of what the samples have hit.
    """
    if len(paths) > 1:
        message = "each file of noisebase is a scene or frame of its own: read them one by one"
        raise InputError(message)
    path, wanted = paths[0], {**_FEATURES, **options.features}
    with _Group(path) as group:
        colour = group.array("color")
        frame = _frame(path, colour.shape, options.variable)
        height, width, spp = colour.shape[-3:]
        inside = {
            n: name
            for n, name in wanted.items()
            if n in options.features or group.has(name, (3, height, width, spp))
        }
        for name in inside.values():
            group.array(name, (3, height, width, spp))
        exposure = np.asarray(group.array("exposure")[frame], np.float32)
    if colour.dtype != np.uint8 or exposure.shape != (2,) or not np.isfinite(exposure).all():
        message = f"{path} is no sample set of noisebase: its colours are not encoded as such"
        raise StoreError(message)

    def decode(samples: range) -> Iterator[Frame]:
        with _Group(path) as group:
            step = max(1, min(int(group.array("color").chunks[-1]), len(samples)))
            for start in range(samples.start, samples.stop, step):
                part = slice(start, min(start + step, samples.stop))
                radiance = _decoded(group.read("color", frame, part), exposure)
                features = {n: group.read(name, frame, part) for n, name in inside.items()}
                for index in range(part.stop - part.start):
                    yield (
                        _image(radiance, index),
                        {name: _image(feature, index) for name, feature in features.items()},
                    )

    shape = (height, width, 3, spp)
    return Opened(Frames(path, shape, decode, featured=bool(inside)))


class _Group:
    """The arrays in a file, for as long as it is entered; all that fails says which file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> _Group:
        import zarr

        try:
            self._store = zarr.storage.ZipStore(self._path, mode="r")
            self._group: Any = zarr.open_group(self._store, mode="r")
        except DAMAGED as error:
            raise self._damaged(error) from error
        return self

    def __exit__(self, *_: object) -> None:
        self._store.close()

    def has(self, name: str, shape: tuple[int, ...]) -> bool:
        """Return whether there is an array whose last axes are of this shape."""
        try:
            return tuple(self._group[name].shape[-len(shape) :]) == shape
        except DAMAGED:
            return False

    def array(self, name: str, shape: tuple[int, ...] = ()) -> Any:
        """Return an array that the file can hold, not yet read."""
        try:
            found = self._group[name]
            there, chunks = tuple(found.shape), tuple(found.chunks)
            check_claim(self._path, found.dtype.itemsize * math.prod(there))
            check_claim(self._path, found.dtype.itemsize * math.prod(chunks))
        except DAMAGED as error:
            raise self._damaged(error) from error
        if there[len(there) - len(shape) :] != shape or found.dtype.kind not in "fu":
            message = (
                f"{self._path}: array {name!r} must hold numbers of shape {shape}, got "
                f"{found.dtype} of {there}"
            )
            raise InputError(message)
        return found

    def read(self, name: str, frame: tuple[int, ...], samples: slice) -> npt.NDArray[Any]:
        """Return some samples of an array in a frame, shape (component, y, x, sample)."""
        try:
            return np.asarray(self._group[name][(*frame, ..., samples)])
        except DAMAGED as error:
            raise self._damaged(error) from error

    def _damaged(self, error: BaseException) -> StoreError:
        return StoreError(f"cannot read {self._path} as a sample set of noisebase: {error}")


def _frame(path: Path, shape: Sequence[int], frame: str | None) -> tuple[int, ...]:
    """Return the index of a frame: none where the file has but one."""
    frames = shape[0] if len(shape) == 5 else 1
    number = 0 if frame is None else int(frame) if frame.isdecimal() and len(frame) < 10 else -1
    if len(shape) not in (4, 5) or shape[-4] != 4 or 0 in shape:
        message = f"{path} is no sample set of noisebase: its colours have shape {tuple(shape)}"
        raise StoreError(message)
    if not 0 <= number < frames:
        message = (
            f"{path} has the frames 0 to {frames - 1}; give the number of one as variable, not "
            f"{frame!r}"
        )
        raise InputError(message)
    return (number,) if len(shape) == 5 else ()


def _decoded(colour: npt.NDArray[np.uint8], exposure: npt.NDArray[np.float32]) -> Image:
    """Return radiance, shape (3, y, x, sample)."""
    least, largest = exposure
    steps = np.exp(least + np.arange(1, 257, dtype=np.float32) / 256 * (largest - least))
    unit: Image = (steps / 255).astype(np.float32)[colour[3]]
    return np.asarray(colour[:3] * unit)


def _image(values: npt.NDArray[Any], sample: int) -> Image:
    return np.moveaxis(values[..., sample], 0, -1).astype(np.float32)
