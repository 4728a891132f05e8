"""Denoiser: denoises estimates with Open Image Denoise, with features and certainty.

A denoiser starts from one value per pixel. Any estimator of `chdstat.estimators` gives it a better
value than the sample mean: fewer fireflies to smear, and less noise to mistake for texture.
"""

from __future__ import annotations

import contextlib
import importlib
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Floats, Image
from chdstat._core.image_scales import exposure_unit
from chdstat.errors import ChdstatError, InputError, brief

_MEMORY = 400
"""Megabytes for the network; large images are denoised in tiles, with the same result."""


def denoise(
    estimate: npt.ArrayLike,
    *,
    albedo: npt.ArrayLike | None = None,
    normal: npt.ArrayLike | None = None,
    certainty: npt.ArrayLike | None = None,
    hdr: bool = True,
) -> npt.NDArray[np.floating[Any]]:
    """Denoise an image of estimates with Open Image Denoise.

    With a certainty c, the result is ``c estimate + (1 - c) denoised``: a certainty of 1 keeps the
    pixel, 0 replaces it by the denoised one. The network itself has no input for a certainty.

    Linear radiance is scaled to the exposure that the network was trained for, so that the unit of
    radiance does not matter.

    Parameters
    ----------
    estimate
        Radiance, shape (y, x, channel), 1 or 3 channels.
    albedo
        First-hit albedo, at least 0, shape (y, x, 3). Values above 1, as emitters may have, count
        as 1, and values that are not finite as 0.
    normal
        First-hit normals in world or camera space, -1 to 1, shape (y, x, 3). Only with `albedo`.
    certainty
        How certain each estimate is, 0 to 1, shape (y, x) or (y, x, channel); None for 0.
    hdr
        Whether `estimate` is linear radiance; otherwise, it holds display values from 0 to 1.

    Returns
    -------
    ndarray
        The denoised image, with the shape, unit and floating-point dtype of `estimate`. A pixel
        with a NaN, infinite or negative channel is filled from its neighbours for the network, and
        is NaN in the result.

    Raises
    ------
    InputError
        If Open Image Denoise cannot be loaded, a shape is wrong, or a value is out of range.
    ChdstatError
        If Open Image Denoise fails.

    References
    ----------
    A. T. Afra, "Intel Open Image Denoise", https://www.openimagedenoise.org. The blend with the
    input is that of J. Firmino, J. R. Frisvad and H. W. Jensen, "Progressive denoising of Monte
    Carlo rendered images", Computer Graphics Forum 41(2), 2022, doi:10.1111/cgf.14454. They learn
    its weight; here it is the certainty.

    Examples
    --------
    >>> import chdstat as chd
    >>> from chdstat.io import denoise
    >>> rng = np.random.default_rng(0)
    >>> estimate = chd.estimators.zirr2018(rng.exponential(size=(64, 64, 3, 8)))
    >>> smooth = denoise(estimate)  # doctest: +SKIP
    """
    image = _image(estimate, hdr=hdr)
    features = _features(image.shape, albedo, normal)
    keep = _certainty(image.shape, certainty)
    _loaded()  # refuses before the work
    known = np.asarray((np.isfinite(image) & (image >= 0)).all(axis=-1))
    filled = _without_holes(image, known)
    unit = exposure_unit(filled.mean(axis=-1)) if hdr else 1.0
    colour = np.broadcast_to(filled / unit, (*image.shape[:2], 3)).astype(np.float32)
    smooth = run_network({"color": colour, **features}, hdr=hdr).astype(np.float64) * unit
    if image.shape[-1] == 1:
        smooth = smooth.mean(axis=-1, keepdims=True)
    result = keep * filled + (1 - keep) * smooth
    result[~known] = np.nan
    kind = np.asarray(estimate).dtype
    return np.asarray(result.astype(kind if kind.kind == "f" else np.float64))


def library() -> str:
    """Return which Open Image Denoise is loaded, or why none is.

    Examples
    --------
    >>> library()
    'Open Image Denoise 2...'
    """
    try:
        found = _loaded()
    except InputError as error:
        return str(error)
    return f"Open Image Denoise {found.version.oidn_version}"


def works() -> bool:
    """Return whether Open Image Denoise can be loaded.

    Examples
    --------
    >>> works()
    True
    """
    with contextlib.suppress(InputError):
        return bool(_loaded())
    return False


def _loaded() -> Any:
    """Return the module of Open Image Denoise, with its shared library loaded.

    Raises
    ------
    InputError
        If it cannot be loaded.
    """
    try:
        return importlib.import_module("pyoidn")
    except (ImportError, OSError, RuntimeError) as error:
        message = (
            f"Open Image Denoise cannot be loaded ({brief(error)}); install it anew with: pip "
            "install --force-reinstall pyoidn"
        )
        raise InputError(message) from error


def run_network(images: dict[str, Image], *, hdr: bool) -> Image:
    """Denoise ``color`` in little memory, and release all of it.

    Parameters
    ----------
    images
        ``color``, and ``albedo`` and ``normal`` if there are any, each float32 (y, x, 3).
    hdr
        Whether ``color`` is linear radiance.
    """
    library = _loaded()
    # The library takes addresses only: of arrays without gaps, which live until it has run.
    held = {name: np.ascontiguousarray(image, np.float32) for name, image in images.items()}
    held["output"] = found = np.empty(images["color"].shape, np.float32)
    with library.Device() as device:
        device.commit()
        with library.Filter(device) as network:
            for name, image in held.items():
                network.set_image(name, image, library.OIDN_FORMAT_FLOAT3)
            network.set_bool("hdr", hdr)
            network.set_quality(library.OIDN_QUALITY_HIGH)
            network.set_int("maxMemoryMB", _MEMORY)
            network.commit()
            network.execute()
        error = device.get_error()
    if error is not None:
        message = f"Open Image Denoise failed on an image of shape {found.shape}: {error}"
        raise ChdstatError(message)
    return found


def _image(estimate: npt.ArrayLike, *, hdr: bool) -> Floats:
    image = np.asarray(estimate)
    if image.ndim != 3 or image.shape[-1] not in (1, 3) or 0 in image.shape:
        message = f"estimate must be an image (y, x, 1 or 3 channels), got shape {image.shape}"
        raise InputError(message)
    if image.dtype.kind not in "fiu":
        message = f"estimate must hold real numbers, got dtype {image.dtype}"
        raise InputError(message)
    if not hdr and image[np.isfinite(image)].max(initial=0) > 1:
        message = (
            "with hdr=False, estimate must hold display values from 0 to 1, "
            f"got up to {image[np.isfinite(image)].max()}"
        )
        raise InputError(message)
    return image.astype(np.float64)


def _features(
    shape: tuple[int, ...], albedo: npt.ArrayLike | None, normal: npt.ArrayLike | None
) -> dict[str, Image]:
    if albedo is None and normal is not None:
        message = "Open Image Denoise takes normals only beside albedo; give albedo, too"
        raise InputError(message)
    found = {}
    for name, values, low, high in (("albedo", albedo, 0.0, np.inf), ("normal", normal, -1.0, 1.0)):
        if values is None:
            continue
        feature = np.asarray(values, dtype=np.float64)
        if feature.shape != (*shape[:2], 3):
            expected = f"{(*shape[:2], 3)}, as the estimate"
            message = f"{name} must have shape {expected}, got {feature.shape}"
            raise InputError(message)
        known = np.where(np.isfinite(feature), feature, 0)
        # Interpolated normals exceed their range by rounding.
        if known.min() < low - 1e-3 or known.max() > high + 1e-3:
            message = (
                f"{name} must lie between {low} and {high}, got {known.min()} to {known.max()}"
            )
            raise InputError(message)
        found[name] = np.clip(known, low, 1).astype(np.float32)
    return found


def _certainty(shape: tuple[int, ...], certainty: npt.ArrayLike | None) -> Floats:
    if certainty is None:
        return np.zeros((1, 1, 1))
    keep = np.asarray(certainty, dtype=np.float64)
    if keep.shape not in (shape, shape[:2]):
        message = f"certainty must have shape {shape[:2]} or {shape}, got {keep.shape}"
        raise InputError(message)
    if not ((keep >= 0) & (keep <= 1)).all():
        message = f"certainty must lie between 0 and 1, got {keep.min()} to {keep.max()}"
        raise InputError(message)
    return keep if keep.ndim == 3 else keep[..., np.newaxis]


def _without_holes(image: Floats, known: npt.NDArray[np.bool_]) -> Floats:
    """Fill unknown pixels with the average of the known pixels beside them, or 0."""
    if known.all():
        return image
    lit, weights = np.where(known[..., np.newaxis], image, 0), np.ones((3, 3, 1))
    total = ndimage.convolve(lit, weights, mode="constant")
    count = ndimage.convolve(known[..., np.newaxis].astype(np.float64), weights, mode="constant")
    return np.where(known[..., np.newaxis], image, total / np.maximum(count, 1))
