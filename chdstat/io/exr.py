"""EXR files: images of linear radiance for Nuke, tev and other programs, with their layers.

`write_exr` puts certainties, intervals and other layers beside the image in one file; `read_exr`
reads such files, and those of other programs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, warn_caller
from chdstat._core.display import Card, Shown, png
from chdstat._core.files import replacing
from chdstat._core.image_scales import tonemap
from chdstat.errors import InputError, StoreError, check_option
from chdstat.io.exr_planes import OF_THE_FORMAT, read_planes
from chdstat.io.primaries import REC709

__all__ = ["ExrImage", "read_exr", "read_feature", "write_exr"]


_USUAL = {1: ("Y",), 3: ("R", "G", "B")}
_TYPES: dict[str, type[np.floating[Any]]] = {"float": np.float32, "half": np.float16}
_LONGEST_NAME = 255


@dataclass(frozen=True, repr=False)
class ExrImage(Shown):
    """An image as an EXR file holds it.

    Attributes
    ----------
    image
        Linear radiance, float32, shape (y, x, channel).
    channels
        Names of its channels.
    extra
        Other layers by name, shape (y, x); or (y, x, channel) where a layer has a channel for each
        one of the image. float32, or uint32 where the file holds whole numbers.
    attributes
        Text in the header of the file.
    """

    image: npt.NDArray[np.float32]
    channels: tuple[str, ...]
    extra: Mapping[str, Array]
    attributes: Mapping[str, str]

    def _card(self) -> Card:
        known = self.image.shape[-1] in (1, 3)
        shown = {"image": png(tonemap(self.image))} if known else {}
        return replace(super()._card(), images=shown)


def write_exr(
    path: str | Path,
    image: npt.ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    extra: Mapping[str, npt.ArrayLike] | None = None,
    attributes: Mapping[str, str] | None = None,
    pixel_type: Literal["float", "half"] = "float",
) -> Path:
    """Write an image and its layers to an EXR file, compressed without loss.

    The file is written as a whole or not at all: one that is there already is replaced at the end.

    Parameters
    ----------
    path
        The file.
    image
        Linear radiance, shape (y, x, channel). NaN and infinite values are kept.
    channels
        Names of the channels; None for R, G, B, or for Y where there is one. Viewers take R, G, B
        for an image, and linear sRGB for its colours.
    extra
        Layers by name: of shape (y, x), one channel of that name; of shape (y, x, channel), a
        layer, whose channels are called as in ``low.R``, ``low.G``, ``low.B``. uint32 stays, as
        for object numbers.
    attributes
        Text for the header, such as the provenance of the image.
    pixel_type
        'float' for 32 bits, or 'half' for 16, which hold 11 significant bits, up to 65504.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    InputError
        If a shape, a name or an option is wrong, or a finite value is too large for the type.
    StoreError
        If the file cannot be written.

    References
    ----------
    Academy Software Foundation, "OpenEXR file layout", https://openexr.com.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> image = np.random.default_rng(0).gamma(2.0, size=(4, 6, 3))
    >>> layers = {"certainty": np.full((4, 6), 0.9), "low": image / 2}
    >>> with TemporaryDirectory() as folder:
    ...     file = write_exr(f"{folder}/image.exr", image, extra=layers)
    ...     read = read_exr(file)
    >>> read.channels, sorted(read.extra), read.extra["low"].shape
    (('R', 'G', 'B'), ['certainty', 'low'], (4, 6, 3))
    """
    check_option("pixel_type", pixel_type, _TYPES)
    array = _real("image", image)
    if array.ndim != 3 or 0 in array.shape:
        message = f"image must have shape (y, x, channel), got {array.shape}"
        raise InputError(message)
    array = array if array.dtype.kind == "f" else array.astype(np.float64)
    names = _channel_names(channels, array.shape[-1])
    planes = _planes(array, names, extra or {})
    stored = {name: _stored(name, plane, pixel_type) for name, plane in planes.items()}
    import OpenEXR

    _check_attributes(attributes or {})
    header = {
        **(attributes or {}),
        **({"chromaticities": REC709} if names == _USUAL[3] else {}),
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    target = Path(path)
    try:
        with replacing(target) as partial, OpenEXR.File(header, stored) as file:
            file.write(str(partial))
    except (OSError, RuntimeError, ValueError) as error:
        message = f"cannot write an EXR file to {target}: {error}"
        raise StoreError(message) from error
    return target


def read_exr(path: str | Path, *, channels: Sequence[str] | None = None) -> ExrImage:
    """Read an image and its layers from an EXR file.

    The image is the display window: 0 where the file holds nothing, and without what lies outside.
    Its colours are brought to linear Rec. 709; a `chdstat.errors.InputWarning` tells of it, and of
    what else is not as usual.

    Parameters
    ----------
    path
        The file.
    channels
        Which channels or layers are the image; None for red, green and blue, in capitals or not;
        else for Y, or the only layer of colours. All others become `ExrImage.extra`, as they are in
        the file. The channel X of a part "normal" is called normal.X, that of the first part X.

    Returns
    -------
    ExrImage
        What the file's display window holds.

    Raises
    ------
    InputError
        If the file holds no such channels.
    StoreError
        If there is no such file, it is damaged, or the image is of a kind that is not read here:
        deep, of luminance and chroma, of lower resolution, or outside of the display window.

    References
    ----------
    SMPTE RP 177-1993, "Derivation of basic television color equations"; the white point is adapted
    as in K. M. Lam, "Metamerism and colour constancy", PhD thesis, University of Bradford, 1985.

    Examples
    --------
    >>> read_exr("nowhere.exr")
    Traceback (most recent call last):
        ...
    chdstat.errors.StoreError: no EXR file at nowhere.exr
    """
    planes = read_planes(Path(path))
    if channels is None:
        names = planes.main("name those of the image with channels=, out of")
    else:
        names = tuple(name for given in channels for name in planes.layer(given))
    image = planes.image(names, colours=True if channels is None else None)
    if planes.unread:
        name, why = next(iter(planes.unread.items()))
        planes.notes["unread"] = f"{path}: channel {name!r} is left out, for it {why}"
    for note in planes.notes.values():
        warn_caller(note)
    shown = _USUAL[3] if "xyz" in planes.notes else names
    return ExrImage(
        image=image, channels=shown, extra=planes.others(names), attributes=planes.texts()
    )


def read_feature(path: Path, name: str) -> npt.NDArray[np.float32]:
    """Return a first-hit feature from a file: the layer of its name, or else the image in it.

    Raises
    ------
    InputError
        If it is not clear which channels are the feature.
    StoreError
        As `read_exr` does.
    """
    planes = read_planes(path)
    advice = f"rename one to {name}, or give features the array of read_exr(..., channels=) of"
    held = {name.rpartition(".")[0] for name in planes.channels} | planes.channels.keys()
    names = planes.layer(name) if name in held else planes.main(advice, radiance=False)
    image = planes.image(names, colours=name == "albedo")
    for note in planes.notes.values():
        warn_caller(note)
    return image


def _real(name: str, values: npt.ArrayLike) -> Array:
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        message = f"{name} must hold real numbers, got dtype {array.dtype}"
        raise InputError(message)
    return array


def _channel_names(channels: Sequence[str] | None, count: int) -> tuple[str, ...]:
    if channels is None and count not in _USUAL:
        message = f"name the {count} channels of the image with channels=: only 1 or 3 are usual"
        raise InputError(message)
    names = _USUAL[count] if channels is None else tuple(channels)
    if len(names) != count or len(set(names)) != count:
        message = f"channels must be {count} different names, as the image has, got {names}"
        raise InputError(message)
    if any("." in name for name in names):
        message = f"channels must be names without a dot, which marks layers, got {names}"
        raise InputError(message)
    return names


def _planes(
    image: Array, names: tuple[str, ...], extra: Mapping[str, npt.ArrayLike]
) -> dict[str, Array]:
    """Return all channels of the file by name, each of shape (y, x)."""
    planes = dict(zip(names, np.moveaxis(image, -1, 0), strict=True))
    for layer, values in extra.items():
        array = _real(layer, values)
        if array.shape not in (image.shape, image.shape[:2]):
            message = (
                f"extra {layer!r} must have shape {image.shape[:2]} or {image.shape}, "
                f"as the image, got {array.shape}"
            )
            raise InputError(message)
        parts = {layer: array}
        if array.ndim == 3:
            parts = {f"{layer}.{name}": array[..., i] for i, name in enumerate(names)}
        if twice := planes.keys() & parts.keys():
            message = f"extra {layer!r} gives a second channel {min(twice)!r}; rename it"
            raise InputError(message)
        planes |= parts
    for name in planes:
        _check_name("channel", name)
    return planes


def _check_name(what: str, name: str) -> None:
    if not (name and name.isprintable() and len(name.encode()) <= _LONGEST_NAME):
        message = (
            f"a name of a {what} must have 1 to {_LONGEST_NAME} printable characters, got {name!r}"
        )
        raise InputError(message)


def _stored(name: str, plane: Array, pixel_type: str) -> Array:
    """Convert to what the file holds; infinity stays, but nothing finite may become it."""
    if plane.dtype == np.uint32:
        return np.ascontiguousarray(plane)
    kind = _TYPES[pixel_type]
    with np.errstate(over="ignore", under="ignore"):
        # The writer does not look at strides: what is not contiguous would come out scrambled.
        stored = np.ascontiguousarray(plane, dtype=kind)
    lost = np.isinf(stored) & np.isfinite(plane)
    if lost.any():
        message = (
            f"channel {name!r} must be at most {np.finfo(kind).max:.6g} to be written as "
            f"{pixel_type}, got {np.abs(plane[lost]).max():.6g}"
        )
        raise InputError(message)
    return stored


def _check_attributes(attributes: Mapping[str, Any]) -> None:
    for name, value in attributes.items():
        _check_name("header attribute", name)
        if name in OF_THE_FORMAT:
            message = f"attribute {name!r} belongs to the format; choose another name"
            raise InputError(message)
        if not isinstance(value, str):
            message = f"attribute {name!r} must be text, got {type(value).__name__}"
            raise InputError(message)
