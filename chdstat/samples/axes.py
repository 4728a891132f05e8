"""Axes of samples: arrays brought to (y, x, channel, sample), others refused; parts of an axis."""

from __future__ import annotations

import importlib
import operator
import uuid
from collections.abc import Callable, Mapping
from typing import Any, SupportsIndex

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_samples
from chdstat.errors import InputError

__all__ = ["as_image", "as_slice", "check_features", "cut", "lazily"]

_MOST_CHANNELS = 4
"""More than these are probably samples, unless the caller says that they are channels."""


def as_image(array: npt.ArrayLike, name: str, axes: str | None) -> npt.NDArray[np.float32]:
    """Return samples (y, x, channel, sample) in single precision.

    Raises
    ------
    InputError
        If the axes are probably others, or single precision would change what is null or infinite.
    """
    named = hasattr(array, "dims")
    data = as_samples(array, minimum=1 if axes is None else 0, name=name)
    if axes is not None:
        if named:
            message = f"the dims of {name} have names, which decide: leave axes={axes!r} out"
            raise InputError(message)
        data = _ordered(data, name, axes)
    if named and ("channel" in array.dims) != (data.ndim == 4):  # type: ignore[union-attr]
        message = f"{name} must have the dims y, x, sample and perhaps channel, got {array.dims}"  # type: ignore[union-attr]
        raise InputError(message)
    if data.ndim not in (3, 4) or 0 in data.shape:
        message = f"{name} must have shape (y, x, channel, sample), got {data.shape}"
        raise InputError(message)
    if axes is None and not named:
        _check_plausible(name, data.shape)
    if data.ndim == 3:
        data = data[:, :, np.newaxis, :]
    return _single(data, name)


def check_features(features: Mapping[str, npt.ArrayLike], shape: tuple[int, ...]) -> None:
    """Refuse first-hit features of another image than samples of this shape."""
    for name, image in features.items():
        if np.ndim(image) not in (2, 3) or np.shape(image)[:2] != shape[:2]:
            message = (
                f"feature {name} must have shape {shape[:2]} or (*{shape[:2]}, component), "
                f"as the samples, got {np.shape(image)}"
            )
            raise InputError(message)


def lazily(
    read: Callable[[slice, slice, slice], npt.NDArray[np.float32]],
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
) -> Any:
    """Return samples (y, x, channel, sample) as a dask array that reads its chunks when needed."""
    da: Any = importlib.import_module("dask.array")

    def block(block_info: Any) -> npt.NDArray[np.float32]:
        ys, xs, _, ss = (slice(*ends) for ends in block_info[None]["array-location"])
        return read(ys, xs, ss)

    named = {"name": f"radiance-{uuid.uuid4()}", "meta": np.empty((0, 0, 0, 0), np.float32)}
    return da.map_blocks(block, chunks=da.core.normalize_chunks(chunks, shape), **named)


def cut(dim: str, places: range, index: slice | SupportsIndex) -> slice:
    """Return an index of places along a dim as a slice that goes forward, an integer as one."""
    length = len(places)
    if isinstance(index, slice):
        kept = range(length)[index]
    else:
        place = operator.index(index)
        kept = range(place % length, place % length + 1) if -length <= place < length else range(0)
    if not kept or kept.step < 0:
        message = f"{dim} must lie within {-length} to {length - 1} and go forward, got {index!r}"
        raise InputError(message)
    return as_slice(kept)


def as_slice(places: range) -> slice:
    """Return places along an axis as a slice."""
    return slice(places.start, places.stop, places.step)


def _ordered(data: npt.NDArray[Any], name: str, axes: str) -> npt.NDArray[Any]:
    """Return an array whose axes are named by letters as (y, x, channel, sample)."""
    letters = "yxcs" if data.ndim == 4 else "yxs"
    if not isinstance(axes, str) or sorted(axes) != sorted(letters) or data.ndim not in (3, 4):
        message = (
            "axes must name each axis of the samples once, by the letters y, x, s (sample) and, of "
            f"four axes, c (channel), such as 'yxsc'; got {axes!r} for {name} of shape {data.shape}"
        )
        raise InputError(message)
    return np.ascontiguousarray(data.transpose([axes.index(letter) for letter in letters]))


def _check_plausible(name: str, shape: tuple[int, ...]) -> None:
    """Refuse samples whose axes are probably in another order than (y, x, channel, sample)."""
    *_, channels, spp = shape
    if len(shape) == 3 and spp > _MOST_CHANNELS:
        return
    if len(shape) == 3:
        message = (
            f"{name} of shape {shape} would be {spp} samples of one channel in each pixel; it "
            "looks like an image, of means of samples. If it holds samples, give axes='yxs'"
        )
        raise InputError(message)
    if channels <= _MOST_CHANNELS and spp >= channels:
        return
    short = next((i for i in (3, 0, 1) if shape[i] <= _MOST_CHANNELS), None)
    likely = {
        3: "axes='yxsc' if it is (y, x, sample, channel), 'syxc' if (sample, y, x, channel)",
        0: "axes='cyxs' if it is (channel, y, x, sample)",
        1: "axes='scyx' if it is (sample, channel, y, x)",
        None: "axes, such as 'yxsc' if it is (y, x, sample, channel)",
    }[short]
    message = (
        f"{name} of shape {shape} would have {channels} channels of {spp} samples; say what the "
        f"axes are: {likely}, or 'yxcs' if this is right"
    )
    raise InputError(message)


def _single(data: npt.NDArray[np.floating[Any]], name: str) -> npt.NDArray[np.float32]:
    """Return samples in single precision, unless that makes nulls or infinite ones of them."""
    with np.errstate(over="ignore", under="ignore"):
        single = data.astype(np.float32, copy=False)
    changed = ((single == 0) != (data == 0)) | (np.isinf(single) != np.isinf(data))
    if changed.any():
        message = (
            f"{name} holds {data[changed][0]:.6g}, but samples are kept in single precision, from "
            "1.5e-45 to 3.4e38: scale the radiance, such as by 1e30, or give 0 for what is too "
            "small to matter"
        )
        raise InputError(message)
    return single
