"""Datasets of certified pixels: the library's own, and files of others.

`certified` loads one. `SCHEMA` names what each variable is besides the certified numbers, which
`chdstat.certification.reduction.Numbers` declares. A file is a compressed ``.npz`` with an array
for each variable, and the attributes as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.arrays import Array, flag_attributes
from chdstat._core.files import checked_target, replacing, shown
from chdstat._core.statistic import RADIANCE
from chdstat.certification.reduction import (
    AVERAGED,
    BANDWIDTHS,
    MOST_MODES,
    QUANTILES,
    SIZES,
    TAIL_SHARES,
    TOPS,
    Numbers,
)
from chdstat.errors import StoreError

if TYPE_CHECKING:
    import xarray as xr

_VERSION = 1
"""Version of the schema."""
SUFFIX = ".npz"
_FILE = Path(__file__).parent / "certified.npz"
_SE_BITS = 8
"""Bits of the mantissa of a standard error that are kept: more do not mean anything."""

COORDINATES: dict[str, tuple[tuple[Any, ...], str, str]] = {
    "q": (QUANTILES, "probability of a quantile", "1"),
    "top": (TOPS, "share of the samples that are the largest", "1"),
    "size": (SIZES, "samples of an error bar", "1"),
    "averaged": (AVERAGED, "samples of an average", "1"),
    "bound": (("low", "high"), "end of an interval", ""),
    "share": (TAIL_SHARES, "share of the positive samples in the tail", "1"),
    "bandwidth": (BANDWIDTHS, "standard deviation of the kernel in decades", "1"),
    "mode": (tuple(range(1, MOST_MODES + 1)), "rank of a mode by excess mass", "1"),
}
"""Coordinates of the dims after pixel and channel: values, label, unit."""

SCHEMA: dict[str, tuple[tuple[str, ...], str, str]] = {
    "scene": (("pixel",), "name of the scene", ""),
    "y": (("pixel",), "row of the pixel", "1"),
    "x": (("pixel",), "column of the pixel", "1"),
    "pattern": (("pixel",), "pattern of the pixel when it was chosen", ""),
    "noise": (("pixel",), "relative standard deviation of luminance when it was chosen", "1"),
    "weight": (("pixel",), "pixels of the image that it stands for", "1"),
    "source": (("pixel",), "file of the scene, or 'chdstat'", ""),
    "scene_hash": (("pixel",), "SHA-256 of the scene", ""),
    "width": (("pixel",), "width of the image in pixels", "1"),
    "height": (("pixel",), "height of the image in pixels", "1"),
    "seed": (("pixel",), "seed of the samples", "1"),
    "backend": (("pixel",), "backend that drew the samples", ""),
    "mitsuba_version": (("pixel",), "version of Mitsuba that drew the samples", ""),
    "first_mean": (("pixel", "channel"), "mean of the first 4096 samples", RADIANCE),
    "checksum": (("pixel",), "CRC-32 of the first 4096 samples as float32 (channel, sample)", "1"),
}
"""What is known of each pixel before its numbers: dims, label, unit."""
_PLACES = ("scene", "y", "x", "pattern", "noise", "weight")
"""Variables that are coordinates of the pixel."""


def certified(path: str | Path | None = None) -> xr.Dataset:
    """Load pixels of real scenes with certified answers.

    The library's own are 512 pixels of the eight built-in scenes, 64 of each. A million samples
    of each pixel (2^20) give the numbers and their standard errors: mean, variance, quantiles, how
    often error bars hold, tail index, modes and more. Try your own statistic on the same pixels:
    `chdstat.certification.draw` draws any number of samples of them again.

    Parameters
    ----------
    path
        A file of other pixels, written by ``chdstat bench --certified SCENE --folder FOLDER`` or by
        `chdstat.certification.save`; by default, the library's own.

    Returns
    -------
    xarray.Dataset
        Variables over (pixel, channel, ...), with scene, y, x, pattern, noise and weight as
        coordinates of the pixel. The channels are R, G, B and luminance. NaN where a reason says
        why.

    Raises
    ------
    StoreError
        If there is no such file, or it holds something else.

    See Also
    --------
    chdstat.certification.certify : Certify pixels of another scene.
    chdstat.certification.bench : What this library's own answers score.

    Examples
    --------
    >>> import chdstat as chd
    >>> truth = chd.certified()
    >>> dict(truth.sizes)["pixel"], sorted(set(truth.scene.to_numpy().tolist()))[:3]
    (512, ['bathroom', 'caustic', 'cornell-box'])
    >>> bars = truth.coverage.sel(channel="luminance", size=128)
    >>> print(f"95 % error bars of 128 samples hold the mean in {float(bars.mean()):.0%}")
    95 % error bars of 128 samples hold the mean in 85%
    """
    place = _FILE if path is None else Path(path)
    try:
        with np.load(place, allow_pickle=False) as held:
            arrays = {name: held[name] for name in held.files}
        attrs = json.loads(str(arrays.pop("attrs")))
        if attrs["schema_version"] != _VERSION:
            message = (
                f"{shown(place)} has certified pixels of schema {attrs['schema_version']}, and this"
                f" version reads {_VERSION}; certify them again, or install the version that did"
            )
            raise StoreError(message)
        return _labelled(arrays, attrs)
    except FileNotFoundError as error:
        message = f"there is no file of certified pixels at {shown(place)}"
        raise StoreError(message) from error
    except (OSError, KeyError, ValueError, EOFError) as error:
        message = (
            f"{shown(place)} holds no certified pixels; expected a file that chdstat bench "
            "--certified wrote"
        )
        raise StoreError(message) from error


def dataset_of(
    numbers: Numbers, known: Mapping[str, Array], attrs: Mapping[str, Any]
) -> xr.Dataset:
    """Return a dataset of the numbers of pixels and what is `known` of them, see `SCHEMA`."""
    arrays = {name: getattr(numbers, own) for name, (own, _) in Numbers.declared().items()}
    return _labelled({**known, **arrays}, {"schema_version": _VERSION, **attrs})


def save(dataset: xr.Dataset, path: str | Path) -> Path:
    """Write certified pixels to an ``.npz`` file, from which `certified` reads them.

    Numbers are in single precision; standard errors keep three digits.

    Raises
    ------
    InputError
        If the file has another suffix.
    """
    target = checked_target(path, SUFFIX)
    arrays: dict[str, Any] = {"attrs": np.array(json.dumps(dataset.attrs))}
    for name in (*SCHEMA, *Numbers.declared()):
        values = dataset[name].to_numpy()
        if values.dtype.kind == "f":
            values = values.astype(np.float32)
            values = _rounded(values) if name.endswith("_se") else values
        elif values.dtype.kind == "O":
            values = values.astype(np.str_)
        arrays[name] = values
    with replacing(target) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return target


def _rounded(values: Array) -> Array:
    """Return single-precision numbers with fewer bits, which are smaller when compressed."""
    drop = 23 - _SE_BITS
    bits = values.view(np.uint32).astype(np.uint64) + (1 << (drop - 1))
    cut = (bits >> drop << drop).astype(np.uint32).view(np.float32)
    return np.where(np.isfinite(values), cut, values)


def _labelled(arrays: Mapping[str, Array], attrs: Mapping[str, Any]) -> xr.Dataset:
    import xarray as xr

    declared = {
        name: (("pixel", *about.dims), about.label, about.unit)
        for name, (_, about) in Numbers.declared().items()
    }
    variables = {}
    for name, (dims, label, unit) in (SCHEMA | declared).items():
        values = arrays[name]
        about: dict[str, Any] = {"long_name": label} | ({"units": unit} if unit else {})
        if name.endswith("_reason"):
            about |= flag_attributes()
        if values.dtype.kind == "f":
            values = values.astype(np.float64)
        variables[name] = dims, values, about
    channels = variables["mean"][1].shape[1]
    names = ("R", "G", "B", "luminance") if channels == 4 else ("luminance",)
    coords: dict[str, Any] = {"channel": list(names)}
    for name, (values_of, label, unit) in COORDINATES.items():
        coords[name] = name, np.array(values_of), {"long_name": label, "units": unit}
    dataset = xr.Dataset(variables, coords=coords, attrs=dict(attrs))
    return dataset.set_coords(_PLACES)
