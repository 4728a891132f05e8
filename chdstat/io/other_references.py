"""References of other programs: their images, and what they say of their noise.

`KINDS` lists what is recognised, by the layers of a file, by its name, and by the files beside it.
What a file cannot show is said by the `limits` of the reference. Sources of what the layers mean:

- Mitsuba 3, ``src/integrators/moment.cpp`` (means of X, Y and Z of samples and of their squares)
  and ``src/render/tests/test_renders.py`` (differences of these, rounded to half floats, converted
  from X, Y, Z to R, G, B as if they were colours, of 32,000 spp unless said otherwise).
- pbrt-v4, ``GBufferFilm`` in ``src/pbrt/film.cpp`` and ``VarianceEstimator`` in
  ``src/pbrt/util/math.h``: the unbiased variance of the samples that hit a surface, as the sensor
  measures them, whose R, G and B are X, Y and Z unless a camera is named; half floats by default.
- Sakai et al., "A statistical approach to Monte Carlo denoising", SIGGRAPH Asia 2024, StatMC,
  ``README.md``: ``film-mean`` and ``film-m2`` are the mean and the sum of squared deviations of
  samples, ``n`` is their number; ``mean``, ``m2`` and ``m3`` are of transformed samples.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from chdstat._core.arrays import LUMINANCE, Array, Floats
from chdstat._core.display import percent
from chdstat._core.files import is_file
from chdstat.errors import InputError, StoreError
from chdstat.inference.references import Reference
from chdstat.io.exr import ExrImage, from_xyz, read_exr
from chdstat.io.sources import readable

_HALF = 2.0**-11
"""Relative rounding error of half floats."""
_MOST = 0.5
"""Share of negative values of which an image is not taken for variances."""
_FILTER = (
    "If its filter is wider than a pixel, it mixes samples of neighbours, and its mean differs."
)
_COLOURS = (
    "Variances of R, G and B are estimated from those of X, Y and Z, whose covariances are unknown."
)
_ROUNDED = (
    "Its variances are differences of half floats: below .1 % of the squared mean, they are "
    "rounding errors."
)
_SURFACES = "Its variances leave out samples that hit no surface, and are those of another sensor."


def read_image(path: Path) -> ExrImage:
    """Return the image in an EXR or PFM file, with its layers.

    Raises
    ------
    StoreError
        If the file is missing or damaged.
    """
    return _read_pfm(path) if path.suffix.lower() == ".pfm" else read_exr(path)


def of_image(path: Path, image: ExrImage, variance: str | Path | None) -> Reference:
    """Return the reference of an image, with variances as given, or found in or beside its file.

    Raises
    ------
    InputError
        If variances are given and the file has some, they are of another size, or most are below 0.
    StoreError
        If something is missing or damaged.
    """
    if (found := _first(_WITHIN, path, image)) is None:
        beside = _of_pair(path, image, Path(variance)) if variance is not None else None
        return beside or _first(_BESIDE, path, image) or _alone(image)
    if variance is not None:
        message = f"{path} has variances itself: leave out variance={variance}"
        raise InputError(message)
    return found


_Reader = Callable[[Path, ExrImage], Reference | None]


def _first(readers: Mapping[str, _Reader], path: Path, image: ExrImage) -> Reference | None:
    return next(
        (found for reader in readers.values() if (found := reader(path, image)) is not None), None
    )


def _alone(image: ExrImage, variance: Array | None = None) -> Reference:
    """Return an image of which its file says no more, or with variances of a sample."""
    return Reference(
        image.image,
        variance,
        image.averaged if image.averaged > 1 else None,
        attrs={"renderer": renderer} if (renderer := image.attributes.get("generatedBy")) else {},
        limits=(_FILTER,),
    )


# --- variances in the file ------------------------------------------------------------------------


def _of_moments(path: Path, image: ExrImage) -> Reference | None:
    """Return the mean and the variance in output of Mitsuba's integrator ``moment``.

    Of several nested integrators, it is the one whose mean is the image.
    """
    names = [n[3:-2] for n in image.extra if n.startswith("m2_") and n.endswith(".Y")]
    if not names:
        return None
    found = [(_xyz(path, image, name), _xyz(path, image, f"m2_{name}")) for name in names]
    light = image.image[..., 0] if image.image.shape[2] == 1 else image.image @ LUMINANCE
    first, second = min(found, key=lambda pair: float(np.nansum(np.abs(pair[0][..., 1] - light))))
    halves = _are_halves(first) and _are_halves(second)
    variance = np.maximum(second - first**2, 0) + (_HALF * second if halves else 0)
    return replace(
        _alone(image, _of_bands(image.image, variance)),
        precision=_HALF if halves else 0.0,
        limits=(_COLOURS, *([_ROUNDED] if halves else []), _FILTER),
    )


def _of_pbrt(_: Path, image: ExrImage) -> Reference | None:
    """Return the mean and the variance of a ``gbuffer`` film of pbrt-v4."""
    variance = image.extra.get("Variance")
    if variance is None or "RelativeVariance" not in image.extra:
        return None
    limits = (_COLOURS, _SURFACES, _FILTER)
    return replace(_alone(image, _of_bands(image.image, variance)), limits=limits)


def _of_variance(_: Path, image: ExrImage) -> Reference | None:
    """Return an image with the layer ``variance``, of a sample in the channels of the image."""
    variance = image.extra.get("variance")
    if variance is None:
        return None
    spp = image.attributes.get("spp", "")
    number = int(spp) if spp.isdecimal() and int(spp) else None
    found = _alone(image, np.atleast_3d(variance))
    return replace(found, spp=number or found.spp)


def _xyz(path: Path, image: ExrImage, name: str) -> Array:
    """Return the channels X, Y and Z of a layer."""
    planes = [image.extra.get(f"{name}.{axis}") for axis in "XYZ"]
    if missing := [axis for axis, plane in zip("XYZ", planes, strict=True) if plane is None]:
        message = f"{path} has the layer {name} without {', '.join(missing)}; write it again"
        raise StoreError(message)
    return np.stack([plane for plane in planes if plane is not None], axis=-1).astype(float)


# --- files beside it ------------------------------------------------------------------------------

_MITSUBA = re.compile(r".*_ref_(mono|rgb|spectral|spectral_polarized)")
_STATMC = re.compile(r"(.*-t\d+-b\d+)-film-mean")


def _of_named_pair(path: Path, image: ExrImage) -> Reference | None:
    """Return an image with variances of a sample; of ``_ref_rgb``, Mitsuba's, those of X, Y, Z."""
    variance = path.with_name(f"{path.stem}_var{path.suffix}")
    return _of_pair(path, image, variance) if is_file(variance) else None


def _of_pair(path: Path, image: ExrImage, variance: Path) -> Reference:
    """Return an image and variances of a sample in two files.

    Those of Mitsuba's tests are variances of X, Y and Z, converted as if they were colours.
    """
    held = read_image(variance).image
    if held.shape != image.image.shape:
        message = (
            f"variances must have the shape of their image, {image.image.shape}, got {held.shape} "
            f"in {variance}"
        )
        raise InputError(message)
    kind = _MITSUBA.fullmatch(path.stem)
    if kind is None or held.shape[2] != 3:
        if (held < 0).mean() > _MOST:  # a few are rounding errors
            message = (
                f"expected variances of a sample in {variance}, got {percent((held < 0).mean())} "
                "negative values"
            )
            raise InputError(message)
        return _alone(image, held)
    to_xyz = np.linalg.inv(from_xyz()).T
    xyz = np.maximum(held @ to_xyz, 0)
    xyz += _HALF * (xyz + (image.image @ to_xyz) ** 2)
    if kind[1] == "mono":  # X = Y = Z there, which is no grey
        image = replace(image, image=(image.image @ to_xyz)[..., 1:2].astype(np.float32))
    limits = (*([_COLOURS] if kind[1] != "mono" else []), _ROUNDED, _FILTER)
    return replace(_alone(image, _of_bands(image.image, xyz)), limits=limits)


def _of_statmc(path: Path, image: ExrImage) -> Reference | None:
    """Return the mean in a buffer of StatMC, with its variance and its number of samples."""
    name = _STATMC.fullmatch(path.stem)
    if name is None:
        return None
    squares, number = (
        path.with_name(f"{name[1]}-{kind}{path.suffix}") for kind in ("film-m2", "n")
    )
    if missing := [str(file) for file in (squares, number) if not is_file(file)]:
        message = f"{path} is a mean of StatMC; put its moments beside it, {' and '.join(missing)}"
        raise StoreError(message)
    count = read_image(number).image[..., :1].astype(float)
    m2 = read_image(squares).image
    if m2.shape != image.image.shape or count.shape[:2] != m2.shape[:2] or not count.min() >= 2:
        message = (
            f"moments of StatMC must have the shape of their mean, {image.image.shape}, and at "
            f"least 2 samples, got {m2.shape} in {squares} and {count.min():g} in {number}"
        )
        raise InputError(message)
    spp = int(count.min())
    # Where there are more samples, the variance of the mean is smaller.
    return Reference(image.image, m2 / (count - 1) * (spp / count), spp, precision=0)


def _are_halves(x: Array) -> bool:
    with np.errstate(over="ignore"):
        return bool(np.array_equal(x, x.astype(np.float16), equal_nan=True))


@np.errstate(all="ignore")
def _of_bands(mean: Array, xyz: Floats) -> Floats:
    """Return variances of the channels of an image from those of X, Y and Z.

    Covariances are unknown. The standard deviation of R is 3.24 X - 1.54 Y - 0.50 Z of theirs if
    all samples of a pixel have one colour, and more otherwise. Where samples have the colour of
    their mean, it is that of Y, times R over Y. The larger one counts.
    """
    if mean.shape[2] == 1:
        return xyz[..., 1:2]
    deviation = np.sqrt(np.maximum(xyz, 0))
    light = mean @ LUMINANCE.astype(float)
    usual = deviation[..., 1:2] * np.abs(mean / light[..., np.newaxis])
    alike = np.abs(deviation @ from_xyz().T)
    return np.fmax(alike, np.where(np.isfinite(usual), usual, 0)) ** 2


def _read_pfm(path: Path) -> ExrImage:
    """Return the image in a PFM file, of 1 or 3 channels.

    References
    ----------
    P. Debevec, "PFM portable float map", https://www.pauldebevec.com/Research/HDR/PFM/.
    """
    with readable(path):
        content = path.read_bytes()
    head = re.match(rb"P([Ff])\s+(\d+)\s+(\d+)\s+([-+.\deE]+)\s", content)
    if head is None:
        message = f"{path} is not a PFM file: it does not begin as one"
        raise StoreError(message)
    channels = 3 if head[1] == b"F" else 1
    shape = int(head[3]), int(head[2]), channels
    if len(content) - head.end() != 4 * math.prod(shape):
        message = f"{path} is damaged or cut off; write or copy it again"
        raise StoreError(message)
    order = "<f4" if head[4].startswith(b"-") else ">f4"
    # Rows go up.
    pixels = np.frombuffer(content, order, offset=head.end()).reshape(shape)[::-1]
    names = ("R", "G", "B") if channels == 3 else ("Y",)
    return ExrImage(pixels.astype(np.float32), names, {}, {})


_WITHIN: Mapping[str, _Reader] = {
    "``m2_NAME.X``, ``.Y``, ``.Z`` beside ``NAME.X``": _of_moments,
    "``Variance.R``, ``RelativeVariance.R``": _of_pbrt,
    "``variance.R``": _of_variance,
}
"""Readers of files with variances, by their layers."""
_BESIDE: Mapping[str, _Reader] = {
    "``NAME_var.exr`` beside ``NAME.exr``": _of_named_pair,
    "``NAME-film-m2`` and ``NAME-n`` beside ``NAME-film-mean``": _of_statmc,
}
"""Readers of images with variances in other files, by their names."""
KINDS: Mapping[str, _Reader] = {**_WITHIN, **_BESIDE}
