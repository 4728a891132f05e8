"""Writing: images and estimates by the suffix of their file, maps as EXR layers or netCDF."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat import __version__
from chdstat._core.arrays import plain_attributes
from chdstat._core.display import channel_names, png
from chdstat._core.files import checked_target, local, writing
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.errors import InputError, StoreError
from chdstat.io.exr import write_exr
from chdstat.samples import ImageLike
from chdstat.samples.samples import SampleStream

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

    from chdstat.estimators.estimates import AnyModel, Estimated

_log = logging.getLogger("chdstat")
_USUAL_CHANNELS = (1, 3)
"""Numbers of channels that EXR has names for."""
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


# --- estimates ---


def write_estimates(
    path: str | Path,
    samples: ImageLike | SampleStream | npt.ArrayLike,
    model: AnyModel | str | Path | None = None,
    *,
    spp: int | None = None,
    level: float = 0.9,
    denoise: bool = False,
    progress: bool = True,
    client: Client | None = None,
    checkpoint: str | Path | None = None,
    seconds: float | None = None,
    relative_error: float | None = None,
) -> Path:
    """Estimate the radiance of every pixel and write it to a file: .exr, .npy, .pfm or .png.

    The image is the estimate; a PNG file is tone-mapped. An EXR file has the further layers
    ``certainty``, ``low``, ``high`` and ``mean``. Without a model it also has the ``weight`` of
    each candidate, and with `denoise` the ``estimate`` before denoising. Its header records the
    scene, the samples and the options.

    Parameters
    ----------
    path
        The file, as for `chdstat.io.write_image`. An existing file is replaced at the end; for a
        rendering, it is replaced at each doubling of the number of samples.
    samples, model, spp, level, denoise, progress, client, checkpoint
        As for `estimate`.
    seconds, relative_error
        Stop a rendering after so many seconds, or as soon as the estimated relative error of the
        image (`Combination.relative_error`) is at most this, and at most a tenth larger in nine of
        ten images. Each pass logs the error and the samples that the wanted one takes, or half of
        the present one.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    InputError, StoreError
        As for `estimate`; or if the file cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> image = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 16)))
    >>> with TemporaryDirectory() as folder:
    ...     file = write_estimates(f"{folder}/a.exr", image, progress=False)
    ...     sorted(chd.io.read_exr(file).extra)[:4]
    ['certainty', 'high', 'low', 'mean']
    """
    # Estimators are not loaded to write an image.
    from chdstat.estimators.estimates import Combination, EstimateOptions, estimates_of
    from chdstat.estimators.registry import check_positive

    target = checked_target(path, *IMAGES)
    options = EstimateOptions(spp, level, denoise, progress, client, checkpoint)
    if relative_error is not None:
        check_positive(relative_error=relative_error)
    rendered, begin = hasattr(samples, "batch"), time.monotonic()
    if not rendered and (seconds, relative_error) != (None, None):
        message = "seconds= and relative_error= stop a rendering; these samples are there already"
        raise InputError(message)
    reached = relative_error is None
    for image in estimates_of(samples, model, options, seconds, relative_error):
        write_image(
            target,
            image.final.radiance,
            channels=None if image.mean.shape[-1] in _USUAL_CHANNELS else image.source.channels,
            extra=_layers(image),
            attributes=_header(image),
        )
        if rendered and isinstance(image.found, Combination):
            error, spent = image.found.error, time.monotonic() - begin
            _log.info("%d spp: %s", image.found.spp, error.told(relative_error, spent))
            reached = relative_error is None or error.reaches(relative_error)
    if not reached and seconds is None:
        _log.warning("the relative error of %g was not reached in all samples", relative_error)
    return target


def _layers(image: Estimated) -> dict[str, npt.NDArray[Any]]:
    from chdstat.estimators.estimates import Combination

    layers: dict[str, npt.NDArray[Any]] = {"mean": image.mean}
    if not np.isnan(image.found.level):
        layers |= {name: getattr(image.found, name) for name in ("certainty", "low", "high")}
    if isinstance(image.found, Combination):
        weights = image.found.weights.items()
        layers |= {f"weight_{name.replace(' ', '_')}": image for name, image in weights}
    return layers | ({"estimate": image.found.radiance} if image.options.denoise else {})


def _header(image: Estimated) -> dict[str, str]:
    from chdstat.estimators.estimates import Combination

    found, model = image.found, image.model
    training, known = "before", {} if model is None else model.provenance
    if isinstance(found, Combination):
        training = "before, on built-in scenes with references"
        known = {"bias": found.bias, "bias_error": found.bias_error}
    about = {
        "software": f"chdstat {__version__}",
        "scene": image.source.name,
        "spp": getattr(found, "spp", image.source.spp),
        "estimator": "combination" if model is None else model.name,
        "training": training,
        "level": "none" if np.isnan(found.level) else found.level,
        "denoiser": "Open Image Denoise" if image.options.denoise else "none",
        "samples": image.source.attrs,
        "model": known,
    }
    return {k: v if isinstance(v, str) else json.dumps(v, default=str) for k, v in about.items()}
