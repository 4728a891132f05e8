"""Maps: datasets of results per pixel, written as EXR layers or netCDF, read from zarr."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.files import checked_target, local, writing
from chdstat.errors import InputError, StoreError
from chdstat.io.exr import write_exr

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["open_maps", "write_maps", "write_netcdf"]


def open_maps(path: str | Path) -> xr.Dataset:
    """Open a dataset of maps that was written as a zarr store, such as by ``chdstat analyze -o``.

    Raises
    ------
    StoreError
        If there is none, or one of samples.
    """
    import xarray as xr

    asked = "give what 'chdstat analyze STORE -o MAPS' wrote"
    try:
        found: xr.Dataset = xr.open_zarr(local(path), consolidated=False, chunks=None)
        _ = found.sizes["y"], found.sizes["x"]
    except (OSError, ValueError, KeyError) as error:
        message = f"no maps at {path}: {asked}"
        raise StoreError(message) from error
    if "sample" in found.sizes:
        message = f"{path} holds samples, not maps: {asked}"
        raise StoreError(message)
    return found


def write_maps(dataset: xr.Dataset, path: str | Path) -> Path:
    """Write the maps of a dataset as layers of an EXR file.

    A variable of dims (y, x) becomes a channel, one of dims (y, x, channel) a layer; variables of
    other dims have no place in an image, and are left out.

    Parameters
    ----------
    dataset
        Results per pixel, such as those of `chdstat.summarize` or `chdstat.analyze`.
    path
        The file, .exr. The image in it is ``mean``, or else the first variable.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    InputError
        If there is no map, or a value is too large for single precision.
    StoreError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import chdstat as chd
    >>> found = chd.summarize(np.random.default_rng(0).gamma(2.0, size=(4, 6, 3, 32)))
    >>> file = write_maps(found, Path(tempfile.mkdtemp()) / "maps.exr")
    >>> chd.io.read_exr(file).extra["variance"].shape
    (4, 6, 3)
    """
    target = checked_target(path, ".exr")
    usual = {
        str(name): values.transpose("y", "x", ...)
        for name, values in dataset.data_vars.items()
        if set(values.dims) in ({"y", "x"}, {"y", "x", "channel"}) and values.dtype.kind in "biuf"
    }
    with_channels = [name for name, values in usual.items() if values.ndim == 3]
    shown = next((name for name in ("mean", *with_channels, *usual) if name in usual), None)
    if shown is None:
        message = f"the dataset has no map of dims (y, x), only {', '.join(map(str, dataset))}"
        raise InputError(message)
    image = np.atleast_3d(usual.pop(shown).to_numpy())
    text = {str(k): str(v) for k, v in dataset.attrs.items() if isinstance(v, str | int | float)}
    text["image"] = shown
    channels = None if image.shape[2] in (1, 3) else [f"channel{i}" for i in range(image.shape[2])]
    layers = {name: values.to_numpy() for name, values in usual.items()}
    return write_exr(target, image, channels=channels, extra=layers, attributes=text)


def write_netcdf(dataset: xr.Dataset, path: str | Path) -> Path:
    """Write a dataset of results as netCDF, whole or not at all.

    Attributes that netCDF has no type for, such as tables, become JSON.

    Parameters
    ----------
    dataset
        Results of any dims.
    path
        The file, .nc.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    StoreError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import chdstat as chd
    >>> found = chd.summarize(np.random.default_rng(0).gamma(2.0, size=(4, 6, 3, 32)))
    >>> write_netcdf(found, Path(tempfile.mkdtemp()) / "maps.nc").name
    'maps.nc'
    """
    target = checked_target(path, ".nc")
    plain = dataset.drop_encoding().assign_attrs(_plain(dataset.attrs))
    for name, variable in plain.variables.items():
        plain[name].attrs = _plain(variable.attrs)
    with writing(target) as partial:
        plain.to_netcdf(partial)
    return target


def _plain(attrs: Mapping[Any, Any]) -> dict[str, str | int | float | list[int | float]]:
    """Return attributes as text, numbers and lists of numbers."""
    return {
        str(name): value
        if isinstance(value, str | float) or _numbers(value)
        else json.dumps(value, default=str)
        for name, value in attrs.items()
    }


def _numbers(value: Any) -> bool:
    """Return whether a value is a number, or a list of some, of a type that netCDF has."""
    values = value if isinstance(value, list | tuple) else [value]
    if isinstance(value, np.ndarray):
        values = value.tolist() if value.ndim == 1 else [None]
    return all(
        isinstance(v, float | np.floating)
        or (isinstance(v, int | np.integer) and not isinstance(v, bool) and abs(int(v)) < 2**31)
        for v in values
    )
