"""Writing: images by the suffix of their file, and results per pixel as EXR layers or netCDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import plain_attributes
from chdstat._core.display import channel_names, png
from chdstat._core.files import checked_target, local, writing
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.errors import InputError, StoreError
from chdstat.io.exr import write_exr

if TYPE_CHECKING:
    import xarray as xr

IMAGES: Mapping[str, str] = {
    ".exr": "linear radiance with all layers, for an EXR viewer",
    ".npy": "linear radiance of shape (y, x, channel) without layers, for numpy.load",
    ".pfm": "linear radiance without layers, for a viewer of PFM files",
    ".png": "tone-mapped to 8 bits of sRGB, for the screen: radiances cannot be read from it",
}
"""Content of an image file, by its suffix."""


def write_image(
    path: str | Path,
    image: npt.ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    extra: Mapping[str, npt.ArrayLike] | None = None,
    attributes: Mapping[str, str] | None = None,
    exposure: float | None = None,
) -> Path:
    """Write an image to a file whose suffix is its format: .exr, .npy, .pfm or .png.

    An EXR file holds everything that is given; .npy and PFM files hold the radiances alone. A PNG
    file is tone-mapped, and its text says by how many stops.

    Parameters
    ----------
    path
        The file; an existing one is replaced when the new one is complete.
    image
        Linear radiance, shape (y, x, channel); PFM and PNG take 1 or 3 channels.
    channels, extra, attributes
        As for `write_exr`; other formats have no place for them.
    exposure
        Exposure of a PNG file, in stops; None as in `chdstat.viz.tonemap`.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    InputError
        If the suffix is none of these, or the format does not take such an image.
    StoreError
        If the file cannot be written.

    References
    ----------
    P. Debevec, "PFM portable float map", https://www.pauldebevec.com/Research/HDR/PFM/.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> image = np.random.default_rng(0).gamma(2.0, size=(4, 6, 3)).astype(np.float32)
    >>> with TemporaryDirectory() as folder:
    ...     file = write_image(f"{folder}/image.npy", image)
    ...     bool((np.load(file) == image).all())
    True
    """
    target = checked_target(path, *IMAGES)
    suffix = target.suffix.lower()
    if suffix == ".exr":
        return write_exr(target, image, channels=channels, extra=extra, attributes=attributes)
    array = np.asarray(image, np.float32)
    if array.ndim != 3 or (suffix != ".npy" and array.shape[2] not in {1, 3}):
        message = f"{suffix} takes an image of 1 or 3 channels, got shape {array.shape}: use .exr"
        raise InputError(message)
    stops = display_stops(array) if exposure is None else exposure
    with writing(target) as partial:
        if suffix == ".npy":
            with partial.open("wb") as file:
                np.save(file, array)
        elif suffix == ".pfm":
            height, width, number = array.shape
            head = f"{'PF' if number == 3 else 'Pf'}\n{width} {height}\n-1.0\n"
            # Rows go up, and a negative scale means little-endian numbers.
            partial.write_bytes(head.encode() + array[::-1].astype("<f4").tobytes())
        else:
            about = f"tone-mapped by {stops:+.2f} stops and the sRGB curve: no linear radiance"
            partial.write_bytes(png(tonemap(array, exposure=stops), about))
    return target


def open_maps(path: str | Path) -> xr.Dataset:
    """Open a dataset of maps that was written as a zarr store, such as by ``chdstat analyze -o``.

    Raises
    ------
    StoreError
        If there is none, or it is a store of samples.
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

    A variable with dims (y, x) becomes a channel; one with dims (y, x, channel) becomes a layer.
    Variables with other dims are left out.

    Parameters
    ----------
    dataset
        Results per pixel, such as those of `chdstat.summarize` or `chdstat.analyze`.
    path
        The file, .exr. Its image is ``mean``, or else the first variable.

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
    channels = None if image.shape[2] == 1 else channel_names(image.shape[2])
    layers = {name: values.to_numpy() for name, values in usual.items()}
    return write_exr(target, image, channels=channels, extra=layers, attributes=text)


def write_netcdf(dataset: xr.Dataset, path: str | Path) -> Path:
    """Write a dataset of results as netCDF 3, whole or not at all.

    Attributes without a netCDF type, such as tables, become JSON.

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
    plain = dataset.drop_encoding().assign_attrs(plain_attributes(dataset.attrs))
    for name, variable in plain.variables.items():
        plain[name].attrs = plain_attributes(variable.attrs)
    with writing(target) as partial:
        plain.to_netcdf(partial, engine="scipy")  # the same file, whatever else is installed
    return target
