"""Sample arrays: what every statistic assumes of its input, checked in one place; and seeds.

Samples lie on the last axis; leading axes are a batch (pixels, channels). Channels and luminance
are analysed together, as rows of one batch; `take_rows` separates results of any type again.
`chunks` and `rows_by_count` cut rows for the cache. `generator` and `seed_number` turn users' seeds
into random numbers.
"""

from __future__ import annotations

import copy
import enum
import functools
import json
import logging
import operator
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any, SupportsIndex, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError, InputWarning, LeftOutWarning, Reason

if TYPE_CHECKING:
    import xarray as xr

LUMINANCE = np.array([0.212671, 0.715160, 0.072169], dtype=np.float32)
"""Weights of linear sRGB in luminance (ITU-R BT.709)."""

Array: TypeAlias = npt.NDArray[Any]
Floats: TypeAlias = npt.NDArray[np.float64]
Reals: TypeAlias = npt.NDArray[np.floating[Any]]
"""Numbers of single or double precision, as the caller gave them."""
Image: TypeAlias = npt.NDArray[np.float32]
"""Radiance or features, shape (y, x, ...), in the single precision of samples."""
Mapped: TypeAlias = Mapping[str, tuple[tuple[str, ...], npt.NDArray[Any]]]
"""Variables of a tile by name: the dims after (y, x), and an array (y, x, ...)."""
Counts: TypeAlias = npt.NDArray[np.int64]
Indices: TypeAlias = npt.NDArray[np.signedinteger[Any]]
Mask: TypeAlias = npt.NDArray[np.bool_]

Result = TypeVar("Result")

Seed: TypeAlias = int | np.random.Generator | None
"""Seed of a random function: a whole number from 0, a generator, or None for a new one."""

_CACHED = 2**17
"""Samples worked on together: their float64 copies stay in the cache."""
_TOLERATED = 0.01
"""Share of the samples that may be left out without a warning."""


def generator(seed: Seed | Sequence[int]) -> np.random.Generator:
    """Turn a seed into a random generator; a generator is returned as it is.

    Raises
    ------
    InputError
        If the seed is neither a whole number from 0, several of them, a generator, nor None.
    """
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError) as error:
        message = f"seed must be a whole number from 0, a generator or None, got {seed!r}"
        raise InputError(message) from error


def seed_number(seed: Seed, *, span: int = 2**63) -> int:
    """Return a seed as a whole number: itself, or a random number below `span`.

    Functions that draw the same numbers several times, or keep their seed, need a number.

    Examples
    --------
    >>> seed_number(7), seed_number(np.random.default_rng(7))
    (7, 5765488047046174021)
    """
    if seed is None or isinstance(seed, np.random.Generator):
        return int(generator(seed).integers(span))
    return whole("seed", seed, least=0)


def whole(name: str, value: object, *, least: int) -> int:
    """Return a whole number of any type as an int.

    Raises
    ------
    InputError
        If it is not a whole number, is a truth value, or is less than `least`.

    Examples
    --------
    >>> whole("n", np.int32(3), least=1)
    3
    """
    if not isinstance(value, SupportsIndex) or isinstance(value, bool):
        message = f"{name} must be a whole number, got {value!r}"
        raise InputError(message)
    number = operator.index(value)
    if number < least:
        message = f"{name} must be at least {least}, got {number}"
        raise InputError(message)
    return number


def block_numbers(height: int, width: int, *, across: int) -> npt.NDArray[np.int64]:
    """Return the block of each pixel, shape (y, x), with `across` blocks along each side.

    Blocks are numbered in reading order and have nearly equal sizes. A side with fewer pixels has
    as many blocks as pixels.

    Examples
    --------
    >>> block_numbers(2, 4, across=2)
    array([[0, 0, 1, 1],
           [2, 2, 3, 3]])
    """
    rows, columns = min(height, across), min(width, across)
    y = np.arange(height) * rows // height
    x = np.arange(width) * columns // width
    return np.asarray(y[:, np.newaxis] * columns + x, dtype=np.int64)


def block_sums(image: Reals, edge: int) -> npt.NDArray[Any]:
    """Return sums of an image (..., y, x, channel) over blocks; those at far edges are smaller.

    Examples
    --------
    >>> block_sums(np.ones((2, 3, 1)), 2)[..., 0]
    array([[4., 2.]])
    """
    rows, columns = (np.arange(0, size, edge) for size in image.shape[-3:-1])
    return np.asarray(np.add.reduceat(np.add.reduceat(image, rows, axis=-3), columns, axis=-2))


def as_samples(
    x: npt.ArrayLike, *, minimum: int = 1, name: str = "x"
) -> npt.NDArray[np.floating[Any]]:
    """Return `x` as a floating-point array with at least `minimum` samples on its last axis.

    float32 and float64 are not copied; signed integers become float64. Masked samples become NaN,
    which is bad. The named dims of an `xarray.DataArray` are ordered as (..., y, x, channel,
    sample).

    Raises
    ------
    InputError
        If `x` has no axis, is not real, or has fewer than `minimum` samples; if its dims have names
        and none is "sample"; or if it holds unsigned integers, as encoded images do.
    """
    array = _unmasked(_in_order(x, name), name)
    check_real(array.dtype, name)
    if array.ndim == 0:
        message = f"{name} must have its samples on the last axis, got a single number"
        raise InputError(message)
    if array.shape[-1] < minimum:
        message = (
            f"{name} needs at least {minimum} sample(s) on its last axis, "
            f"got shape {array.shape} with {array.shape[-1]}"
        )
        raise InputError(message)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


def check_real(dtype: np.dtype[Any], name: str) -> None:
    """Refuse arrays without real numbers, or of unsigned integers, as encoded images have."""
    if dtype.kind == "u":
        message = (
            f"{name} holds unsigned integers, {dtype}, as images for a display do: samples "
            "are linear radiance. Decode them (sRGB to linear); numbers that are linear already "
            "pass as floating point, x.astype(float)"
        )
        raise InputError(message)
    if dtype.kind not in "fi":
        message = f"{name} must hold real numbers, got dtype {dtype}"
        raise InputError(message)


def as_pixels(
    x: npt.ArrayLike, *, minimum: int = 1, name: str = "x", image: bool = False
) -> npt.NDArray[np.floating[Any]]:
    """Return samples (..., channel, sample) as `as_samples` does.

    An `xarray.DataArray` with named dims, none of them "channel", gets one channel.

    Raises
    ------
    InputError
        If `x` has no axis of channels, does not have the shape (y, x, channel, sample) of an
        `image` where one is needed, or is refused by `as_samples`.
    """
    array = as_samples(x, minimum=minimum, name=name)
    if hasattr(x, "dims") and "channel" not in x.dims:
        array = array[..., np.newaxis, :]
    if image and (array.ndim != 4 or 0 in array.shape):
        message = f"{name} must be an image of shape (y, x, channel, sample), got {array.shape}"
        raise InputError(message)
    if array.ndim < 2 or array.shape[-2] == 0:
        message = f"{name} must have shape (..., channel, sample), got {array.shape}"
        raise InputError(message)
    return array


def is_bad(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.bool_]:
    """Mark bad samples: NaN or infinite.

    Negative samples are good: control variates, spectral conversion and ratio estimators are
    unbiased because of them.
    """
    return np.asarray(~np.isfinite(x))


def all_good(x: npt.NDArray[np.floating[Any]]) -> bool:
    """Return whether no sample is bad, several times faster than marking the bad ones."""
    # A NaN is both the smallest and the largest sample, and fails both comparisons.
    return x.size == 0 or bool(x.min() > -np.inf and x.max() < np.inf)


class LeftOut:
    """Counts the samples that a function leaves out, to warn if they are many.

    Parameters
    ----------
    logarithms
        Whether the function needs logarithms, which negative samples do not have.

    Examples
    --------
    >>> left_out = LeftOut()
    >>> left_out.see(np.array([1.0, np.nan, 2.0]))
    >>> with warnings.catch_warnings(record=True, action="always") as caught:
    ...     left_out.warn()
    >>> print(caught[0].message)
    33.3 % of the samples (1 of 3) are bad and were left out: 1 NaN or masked, 0 infinite
    """

    def __init__(self, *, logarithms: bool = False) -> None:
        self._logarithms = logarithms
        # Samples, bad ones, those with NaN, with infinite channels; values, negative values. A list
        # may grow in several threads.
        self._counts: list[tuple[int, ...]] = []

    def see(
        self,
        x: npt.NDArray[np.floating[Any]],
        *,
        channel_axis: int | None = None,
        absent: int = 0,
    ) -> None:
        """Count samples (..., sample), or whole samples if there is an axis of channels.

        `absent` of them are NaN because pixels have fewer samples than others.
        """
        axes = () if channel_axis is None else (channel_axis,)
        samples = x.size if channel_axis is None else x.size // max(1, x.shape[channel_axis])
        masks: list[npt.NDArray[np.bool_]] = []
        if not all_good(x):
            masks = [mask(x) for mask in (is_bad, np.isnan, np.isinf)]
        marked = [int(mask.any(axis=axes).sum()) for mask in masks] or [0, 0, 0]
        negative = 0
        if self._logarithms and x.size and not x.min() >= 0:
            negative = int(((x < 0) & np.isfinite(x)).sum())
        values = x.size - absent * (x.size // max(1, samples))
        bad, nan, infinite = marked[0] - absent, marked[1] - absent, marked[2]
        self._counts.append((samples - absent, bad, nan, infinite, values, negative))

    @property
    def counts(self) -> tuple[int, ...]:
        """The counts, for `add`."""
        return tuple(map(sum, zip(*self._counts, strict=True))) or (0,) * 6

    def add(self, counts: Iterable[int]) -> None:
        """Add the counts of another object, from another process or an earlier time."""
        self._counts.append(tuple(counts))

    def warn(self) -> None:
        """Warn the caller of the library if more than 1 % of the samples were left out."""
        samples, bad, nan, infinite, values, negative = self.counts
        if bad > _TOLERATED * samples:
            _warn(bad, samples, f"bad and were left out: {nan} NaN or masked, {infinite} infinite")
        if negative > _TOLERATED * values:
            _warn(negative, values, "negative and were left out: they have no logarithm")


def warn_left_out(
    x: npt.NDArray[np.floating[Any]],
    *,
    channel_axis: int | None = None,
    logarithms: bool = False,
    within: str | tuple[str, ...] = "",
) -> None:
    """Warn if a function leaves out more than 1 % of samples; see `LeftOut`.

    `within` names parts of the library that warn about a whole image themselves. When they call
    other functions pixel by pixel or batch by batch, there are no further warnings.
    """
    *inside, _ = _callers(sys._getframe(1))
    if within and any(not frame.f_globals["__name__"].startswith(within) for frame in inside):
        return
    left_out = LeftOut(logarithms=logarithms)
    left_out.see(x, channel_axis=channel_axis)
    left_out.warn()


def _warn(count: int, total: int, what: str) -> None:
    message = f"{100 * count / total:.1f} % of the samples ({count} of {total}) are {what}"
    warn_caller(message, LeftOutWarning)


@functools.cache
def say_once(message: str) -> None:
    """Log a warning, once in a process: another render of the same scene would repeat it."""
    logging.getLogger("chdstat").warning(message)


def warn_caller(message: str, category: type[Warning] = InputWarning) -> None:
    """Warn the caller of the library."""
    warnings.warn(message, category, stacklevel=1 + len(_callers(sys._getframe(1))))


def _callers(frame: FrameType) -> list[FrameType]:
    """Return a frame and its callers, up to the first one outside the library."""
    found = [frame]
    while frame.f_back and frame.f_globals.get("__name__", "").split(".")[0] == "chdstat":
        frame = frame.f_back
        found.append(frame)
    return found


def is_null(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.bool_]:
    """Mark null samples, those whose channels are all exactly zero.

    From samples of shape (..., channel, sample) to shape (..., sample).
    """
    return np.asarray((x == 0).all(axis=-2))


def luminance(
    x: npt.NDArray[np.floating[Any]], *, channel_axis: int = -2
) -> npt.NDArray[np.floating[Any]]:
    """Return the luminance of RGB samples, or the channel itself if there is only one.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample), with 1 or 3 channels.
    channel_axis
        Axis of the channels.

    Returns
    -------
    ndarray
        Luminance, with the shape of `x` without the channel axis.

    Raises
    ------
    InputError
        If there are neither 1 nor 3 channels.
    """
    channels = x.shape[channel_axis]
    if channels == 1:
        return np.asarray(x.take(0, axis=channel_axis))
    if channels != 3:
        message = (
            f"luminance needs 1 or 3 channels, got {channels} in shape {x.shape}; samples lie on "
            "the last axis, channels before them: keep one or three of these"
        )
        raise InputError(message)
    return np.asarray(np.moveaxis(x, channel_axis, -1) @ LUMINANCE.astype(x.dtype))


def plain(value: Any) -> Any:
    """Return a value ready for JSON: arrays as lists, numbers that are not finite as None.

    Examples
    --------
    >>> plain({"a": np.array([1.0, np.nan]), 2: np.float32(0.5)})
    {'a': [1.0, None], '2': 0.5}
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def spans(length: int, step: int) -> Iterator[slice]:
    """Cut an axis into consecutive slices of `step`; the last may be shorter.

    Examples
    --------
    >>> list(spans(5, 2))
    [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    for start in range(0, length, step):
        yield slice(start, min(start + step, length))


def chunks(rows: int, width: int) -> Iterator[slice]:
    """Cut rows of `width` samples into slices whose float64 copies stay in the cache.

    Examples
    --------
    >>> list(chunks(3, 2**16))
    [slice(0, 2, None), slice(2, 3, None)]
    """
    return spans(rows, max(1, _CACHED // max(1, width)))


def rows_by_count(n: Counts, usable: Mask, width: int) -> Iterator[npt.NDArray[np.intp]]:
    """Yield the usable rows in pieces that stay in the cache, rows with the fewest samples first.

    A piece has as many columns as its rows have samples `n`, at most `width`, so that pixels with
    many nulls cost little.

    Examples
    --------
    >>> n = np.array([2**16, 1, 2**16, 0, 2**16])
    >>> [rows.tolist() for rows in rows_by_count(n, n > 0, 2**17)]
    [[1, 0], [2, 4]]
    """
    rows = np.flatnonzero(usable)
    rows = rows[np.argsort(n[rows], kind="stable")]
    start = 0
    while start < len(rows):
        # As many rows as fit if all had the width of the widest of them.
        least = max(1, int(n[rows[start]]))
        widest = int(n[rows[min(start + _CACHED // least, len(rows) - 1)]])
        stop = start + max(1, _CACHED // max(1, min(width, widest)))
        yield rows[start:stop]
        start = stop


def _in_order(x: Any, name: str) -> Any:
    """Return a DataArray with its dims in the usual order; others are returned as they are."""
    dims = getattr(x, "dims", None)
    if not isinstance(dims, tuple) or not hasattr(x, "transpose"):
        return x
    if "sample" not in dims:
        message = (
            f"{name} has the dims {dims}, and none is called 'sample': rename them to y, x, "
            "channel and sample, or give the bare array, x.to_numpy()"
        )
        raise InputError(message)
    last = [dim for dim in ("y", "x", "channel", "sample") if dim in dims]
    return x.transpose(..., *last)


def _unmasked(x: Any, name: str) -> npt.NDArray[Any]:
    """Return an array with NaN for the samples that a masked array hides."""
    try:
        array = np.asarray(x)
    except (RuntimeError, TypeError, ValueError) as error:
        message = f"{name} must be an array, with as many samples in every row: {error}"
        raise InputError(message) from error
    if isinstance(x, np.ma.MaskedArray) and np.ma.is_masked(x) and array.dtype.kind in "fi":
        array = array.astype(array.dtype if array.dtype.kind == "f" else np.float64)
        array[np.ma.getmaskarray(x)] = np.nan
    return array


def batch_rows(values: Array, batch: tuple[int, ...], rows: Array, *behind: Any) -> Array:
    """Select rows of a batch by their flat numbers, and index each row by `behind`.

    Flattening first would copy all values of a view.

    Examples
    --------
    >>> batch_rows(np.arange(12).reshape(2, 2, 3), (2, 2), np.array([3, 0]), slice(2))
    array([[ 9, 10],
           [ 0,  1]])
    """
    some = batch or (1,)
    values = values.reshape(*some, *values.shape[len(batch) :])
    return np.asarray(values[(*np.unravel_index(rows, some), *behind)])


def take_rows(result: Result, rows: int | slice | npt.NDArray[Any], *, axis: int) -> Result:
    """Return a result with only some rows along one of its batch axes.

    Every array with that axis is indexed: those of dataclasses, including cached ones, and of
    mappings. Values with fewer dimensions describe all rows and stay.

    Examples
    --------
    >>> take_rows({"mean": np.arange(6).reshape(2, 3), "n": np.array([7, 8])}, 2, axis=1)
    {'mean': array([2, 5]), 'n': array([7, 8])}
    """
    return cast("Result", _take(result, (slice(None),) * axis + (rows,)))


def _take(value: Any, index: tuple[Any, ...]) -> Any:
    if isinstance(value, np.ndarray):
        return value[index] if value.ndim >= len(index) else value
    if isinstance(value, Mapping):
        return {name: _take(item, index) for name, item in value.items()}
    if isinstance(value, tuple):
        return tuple(_take(item, index) for item in value)
    if is_dataclass(value):
        taken = copy.copy(value)
        # Cached properties lie beside the fields; a frozen dataclass only guards its attributes.
        vars(taken).update({name: _take(item, index) for name, item in vars(value).items()})
        return taken
    return value


# --- reason codes, and labels of variables --------------------------------------------------------


def first_of(
    cases: Mapping[Any, npt.NDArray[np.bool_]], default: enum.IntEnum = Reason.OK
) -> npt.NDArray[np.int8]:
    """Return the code of the first case that holds, or `default`, shape (...).

    Examples
    --------
    >>> n = np.array([0, 1, 50])
    >>> first_of({Reason.ALL_NULL: n == 0, Reason.TOO_FEW: n < 20})
    array([1, 2, 0], dtype=int8)
    """
    codes: list[Any] = [np.int8(code) for code in cases]
    return np.asarray(np.select([*cases.values()], codes, np.int8(default)), dtype=np.int8)


def flag_attributes(kind: type[enum.IntEnum] = Reason) -> dict[str, Any]:
    """Return CF-convention attributes that explain an integer-coded variable.

    Examples
    --------
    >>> flag_attributes()["flag_meanings"].split()[:2]
    ['ok', 'all_null']
    """
    return {
        "flag_values": [int(code) for code in kind],
        "flag_meanings": " ".join(code.name.lower() for code in kind),
    }


def place_attributes(names: Sequence[str]) -> dict[str, Any]:
    """Return CF-convention attributes of a variable of places in a list of names; -1 is none."""
    return {
        "flag_values": [-1, *range(len(names))],
        "flag_meanings": " ".join(["none", *names]),
    }


def flag_names(attrs: Mapping[str, Any]) -> dict[int, str]:
    """Return the names of the values of an integer-coded variable from its attributes.

    Examples
    --------
    >>> flag_names(place_attributes(["gamma", "burr"]))
    {-1: 'none', 0: 'gamma', 1: 'burr'}
    """
    codes = np.atleast_1d(attrs["flag_values"]).tolist()
    return dict(zip(codes, str(attrs["flag_meanings"]).split(), strict=True))


def plain_attributes(attrs: Mapping[Any, Any]) -> dict[str, str | int | float | list[int | float]]:
    """Return attributes in the types that netCDF and zarr have; those without one become JSON.

    Examples
    --------
    >>> plain_attributes({"seed": 7, "size": [6, 4], "noise": {"value": 0.5}, "whole": True})
    {'seed': 7, 'size': [6, 4], 'noise': '{"value": 0.5}', 'whole': 'true'}
    """
    return {
        str(name): value
        if isinstance(value, str | float) or _numbers(value)
        else json.dumps(value, default=str)
        for name, value in attrs.items()
    }


def _numbers(value: Any) -> bool:
    """Return whether a value is a number, or a list of numbers, of a netCDF type."""
    values = value if isinstance(value, list | tuple) else [value]
    if isinstance(value, np.ndarray):
        values = value.tolist() if value.ndim == 1 else [None]
    return all(
        isinstance(v, float | np.floating)
        or (isinstance(v, int | np.integer) and not isinstance(v, bool) and abs(int(v)) < 2**31)
        for v in values
    )


def label_variables(dataset: xr.Dataset, labels: Mapping[str, str | tuple[str, str]]) -> xr.Dataset:
    """Set long names and units of the variables of a dataset, and explain reason codes.

    A label without unit is dimensionless. The ends of intervals, dimension ``bound``, get names,
    too.
    """
    for name, label in labels.items():
        if name in dataset:
            long_name, units = (label, "1") if isinstance(label, str) else label
            flags = flag_attributes() if name.endswith("reason") else {}
            dataset[name].attrs.update(long_name=long_name, units=units, **flags)
    if "bound" in dataset.dims:
        return dataset.assign_coords(bound=np.array(["low", "high"], dtype=object))
    return dataset
