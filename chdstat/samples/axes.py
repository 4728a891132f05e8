"""Axes of samples: arrays brought to (y, x, channel, sample), others refused; parts of an axis."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any, SupportsIndex

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_samples, check_real
from chdstat.errors import InputError

__all__ = [
    "as_image",
    "as_slice",
    "check_counts",
    "check_features",
    "counted",
    "cut",
    "ordered",
    "same_numbers",
    "single",
]

_MOST_CHANNELS = 4
"""More than these are probably samples, unless the caller says that they are channels."""
_DECADES, _LARGEST = 70, 38
"""Decades that single precision surely has, and the logarithm of its largest number."""


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
    return single(data, name)


def as_images(
    array: npt.ArrayLike,
    direct: npt.ArrayLike | None,
    counts: npt.ArrayLike | None,
    axes: str | None,
) -> tuple[list[npt.NDArray[np.float32]], npt.NDArray[np.int32] | None]:
    """Return samples and perhaps their direct part as images, and how many each pixel has.

    Raises
    ------
    InputError
        If they are not of one shape, or counts or axes do not fit them.
    """
    parts = [as_image(array, "samples", axes)]
    if direct is not None:
        parts.append(as_image(direct, "direct", axes))
    if parts[-1].shape != parts[0].shape:
        message = (
            f"direct must have the shape of the samples, {parts[0].shape}, got {parts[1].shape}"
        )
        raise InputError(message)
    if counts is None:
        return parts, None
    found = check_counts(counts, parts[0].shape)
    absent = np.arange(parts[0].shape[3]) >= found[..., np.newaxis, np.newaxis]
    return [np.where(absent, np.float32(np.nan), part) for part in parts], found


def check_features(features: Mapping[str, npt.ArrayLike], shape: tuple[int, ...]) -> None:
    """Refuse first-hit features of another image than samples of this shape."""
    for name, image in features.items():
        if name == "counts":
            message = (
                "a feature must not be called counts: give the samples of each pixel as counts="
            )
            raise InputError(message)
        if np.ndim(image) not in (2, 3) or np.shape(image)[:2] != shape[:2]:
            message = (
                f"feature {name} must have shape {shape[:2]} or (*{shape[:2]}, component), "
                f"as the samples, got {np.shape(image)}"
            )
            raise InputError(message)


def check_counts(counts: npt.ArrayLike, shape: tuple[int, ...]) -> npt.NDArray[np.int32]:
    """Return how many of the samples of this shape each pixel has, shape (y, x).

    Raises
    ------
    InputError
        If they are no whole numbers from 0 to the number of samples, or of another image.
    """
    found = np.asarray(counts)
    if found.dtype.kind not in "iu" or found.shape != shape[:2]:
        message = (
            f"counts must be whole numbers, the samples of each pixel, of shape {shape[:2]}; got "
            f"{found.dtype} of shape {found.shape}"
        )
        raise InputError(message)
    if found.min() < 0 or found.max() > shape[3]:
        message = (
            f"counts must be from 0 to {shape[3]}, the samples that there are, got {found.min()} "
            f"to {found.max()}"
        )
        raise InputError(message)
    return np.asarray(found, np.int32)


def counted(counts: npt.NDArray[np.int32], samples: range) -> npt.NDArray[np.int32]:
    """Return how many of some samples each pixel has, of which it has the first `counts`.

    Examples
    --------
    >>> counted(np.array([[0, 5, 9]], np.int32), range(2, 8, 2))
    array([[0, 2, 3]], dtype=int32)
    """
    last = np.minimum(counts, samples.stop) - samples.start
    return np.asarray(np.maximum(-(-last // samples.step), 0), np.int32)


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


def same_numbers(
    attrs: Mapping[str, Any],
    part: tuple[range, range, range],
    other: Mapping[str, Any],
    other_part: tuple[range, range, range],
) -> bool:
    """Return whether parts of two renders with these attributes drew the same random numbers."""
    (*places, first), (*others, second) = part, other_part
    if attrs.get("seed") is None or places != others:
        return False
    # What compiles draws in wavefronts, with numbers of their own.
    kinds = {about.get("backend") == "scalar" for about in (attrs, other)}
    named = {"seed": None, "streams": None, "sampler": "independent", "sequence": 1, "averaged": 1}
    return (
        (first.start, first.step) == (second.start, second.step)
        and len(kinds) == 1
        and all(attrs.get(name, value) == other.get(name, value) for name, value in named.items())
    )


def as_slice(places: range) -> slice:
    """Return places along an axis as a slice."""
    return slice(places.start, places.stop, places.step)


def ordered(array: Any, name: str, axes: str | None) -> str:
    """Return the letters of the axes of an array in a file, as asked for or as is plausible.

    Raises
    ------
    InputError
        If it holds no real numbers, is empty, or the axes are not, or probably not, its own.
    """
    check_real(array.dtype, name)
    shape = tuple(map(int, array.shape))
    if axes is None and len(shape) in (3, 4) and 0 not in shape:
        _check_plausible(name, shape)
    axes = "yxcs" if axes is None and len(shape) == 4 else "yxs" if axes is None else axes
    _check_letters(shape, name, axes)
    return axes


def _ordered(data: npt.NDArray[Any], name: str, axes: str) -> npt.NDArray[Any]:
    """Return an array whose axes are named by letters as (y, x, channel, sample)."""
    _check_letters(data.shape, name, axes)
    letters = "yxcs" if data.ndim == 4 else "yxs"
    return np.ascontiguousarray(data.transpose([axes.index(letter) for letter in letters]))


def _check_letters(shape: tuple[int, ...], name: str, axes: str) -> None:
    if len(shape) not in (3, 4) or 0 in shape:
        message = (
            f"{name} has the shape {shape}; samples have 3 axes, y, x and sample, or 4 with a "
            "channel, of at least one element each"
        )
        raise InputError(message)
    letters = "yxcs" if len(shape) == 4 else "yxs"
    if not isinstance(axes, str) or sorted(axes) != sorted(letters):
        named = "y, x, s (sample) and c (channel)" if len(shape) == 4 else "y, x and s (sample)"
        message = (
            f"axes must name each axis of the samples once, by the letters {named}, such as "
            f"{letters[:2] + letters[:1:-1]!r}; got {axes!r} for {name} of shape {shape}"
        )
        raise InputError(message)


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


def single(data: npt.NDArray[np.floating[Any]], name: str) -> npt.NDArray[np.float32]:
    """Return samples in single precision, unless that makes nulls or infinite ones of them."""
    if data.dtype in (np.float32, np.float16):
        return data.astype(np.float32, copy=False)
    with np.errstate(over="ignore", under="ignore"):
        kept = data.astype(np.float32)
    changed = ((kept == 0) != (data == 0)) | (np.isinf(kept) != np.isinf(data))
    if changed.any():
        message = (
            f"{name} holds {data[changed][0]:.6g}, but samples are kept in single precision, from "
            f"1.5e-45 to 3.4e38: {_in_range(np.abs(data))}"
        )
        raise InputError(message)
    return kept


def _in_range(size: npt.NDArray[np.floating[Any]]) -> str:
    """Return how absolute values may be brought to the range of single precision."""
    low, high = np.log10([f(size[(size > 0) & np.isfinite(size)]) for f in (np.min, np.max)])
    if high - low < _DECADES:
        return f"scale the radiance, such as by 1e{-round((low + high) / 2)}"
    if high < _LARGEST:
        return "give 0 for what is too small to matter"
    return f"scale the radiance by 1e{-round(high)}, and give 0 for what is then too small"
