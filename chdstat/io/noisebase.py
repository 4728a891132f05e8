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

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import Array
from chdstat._core.files import check_claim
from chdstat.errors import InputError, StoreError
from chdstat.io.lazy import Frame, Frames, Opened, ReadOptions, readable

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
    with _group(path) as group:
        colour = _array(path, group, "color")
        frame = _frame(path, colour.shape, options.variable)
        height, width, spp = colour.shape[-3:]
        shape = (3, height, width, spp)
        inside = {
            n: name
            for n, name in wanted.items()
            if n in options.features or (name in group and group[name].shape[-4:] == shape)
        }
        for name in inside.values():
            _array(path, group, name, shape)
        exposure = np.asarray(_array(path, group, "exposure")[frame], np.float32)
    if colour.dtype != np.uint8 or exposure.shape != (2,) or not np.isfinite(exposure).all():
        message = f"{path} is no sample set of noisebase: its colours are not encoded as such"
        raise StoreError(message)
    least, largest = exposure
    steps = np.exp(least + np.arange(1, 257, dtype=np.float32) / 256 * (largest - least))
    units = (steps / 255).astype(np.float32)

    def decode(samples: range) -> Iterator[Frame]:
        with _group(path) as group:
            step = max(1, min(int(group["color"].chunks[-1]), len(samples)))
            for start in range(samples.start, samples.stop, step):
                stop = min(start + step, samples.stop)
                part = (*frame, ..., slice(start, stop))
                held = {n: np.asarray(group[name][part]) for n, name in inside.items()}
                colours = np.asarray(group["color"][part])
                radiance = colours[:3] * units[colours[3]]
                for i in range(stop - start):
                    yield _image(radiance, i), {n: _image(x, i) for n, x in held.items()}

    return Opened(Frames(path, (height, width, 3, spp), decode, featured=bool(inside)))


@contextlib.contextmanager
def _group(path: Path) -> Iterator[Any]:
    """Open a file as a group of zarr; what fails in it is an error that names the file."""
    import zarr

    with readable(path, "a sample set of noisebase"), zarr.storage.ZipStore(path, mode="r") as file:
        yield zarr.open_group(file, mode="r")


def _array(path: Path, group: Any, name: str, shape: tuple[int, ...] = ()) -> Any:
    """Return an array that the file can hold, whose last axes are of a shape; not yet read."""
    found = group[name]
    there = tuple(found.shape)
    for claimed in (there, found.chunks):
        check_claim(path, found.dtype.itemsize * math.prod(claimed))
    if there[len(there) - len(shape) :] != shape or found.dtype.kind not in "fu":
        message = (
            f"{path}: array {name!r} must hold numbers of shape {shape}, got {found.dtype} of "
            f"{there}"
        )
        raise InputError(message)
    return found


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


def _image(values: Array, sample: int) -> Array:
    return np.moveaxis(values[..., sample], 0, -1).astype(np.float32)
