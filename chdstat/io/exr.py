"""EXR files: images of linear radiance for Nuke, tev and other programs, with their layers.

`write_exr` puts certainties, intervals and other layers beside the image in one file. `read_exr`
reads such files, and those of other programs. `open_exr` opens stacks of files, each with one
sample, or an average of samples, of every pixel. A file has the pixels of its data window. The data
window may be a part of the display window, which is the image, or reach beyond it. `chromaticities`
name the primaries of the colours; the default is Rec. 709.

Source: Academy Software Foundation, "Technical introduction to OpenEXR", "OpenEXR file layout" and
"Standard attributes", https://openexr.com. The attributes that count samples are those of pbrt-v4
(``samplesPerPixel``, src/pbrt/util/image.cpp) and of Blender's Cycles (``cycles.<layer>.samples``).

**Colours.** A colour (r, g, b) has the tristimulus value ``P diag(s) (r, g, b)``. The columns of P
are the chromaticities (x, y, 1 - x - y) of the primaries, and s makes (1, 1, 1) the white point
(SMPTE RP 177). A white point other than that of Rec. 709 is adapted by the matrix of Bradford.
Sources: SMPTE RP 177-1993, "Derivation of basic television color equations"; K. M. Lam,
"Metamerism and colour constancy", PhD thesis, University of Bradford, 1985, as in ISO 15076-1:2010,
annex E; ITU-R BT.709-6 and BT.2020-2; SMPTE ST 2065-1:2012 (ACES); Academy S-2014-004 (ACEScg);
SMPTE EG 432-1:2010 (P3); Adobe RGB (1998) color image encoding. Names of colour spaces are those of
the Color Interop Forum, "Color space encodings for texture assets and CG rendering", 2024.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Image, warn_caller
from chdstat._core.display import Card, Shown, png
from chdstat._core.files import check_claim, replacing
from chdstat._core.image_scales import tonemap
from chdstat.errors import InputError, StoreError, check_option
from chdstat.io.sources import Frame, Frames, Opened, ReadOptions

Rectangle = tuple[int, int, int, int]
"""Left, top, right and bottom of the pixels of an image, all inclusive."""

_USUAL = {1: ("Y",), 3: ("R", "G", "B")}
_IMAGE_CHANNELS = "imageChannels"
"""Attribute that names the channels of the image, in JSON, if they have unusual names."""
_TYPES: dict[str, type[np.floating[Any]]] = {"float": np.float32, "half": np.float16}
_LONGEST_NAME = 255
_MAGIC = b"\x76\x2f\x31\x01"
"""First bytes of every EXR file."""
_OF_THE_FORMAT = {
    *("channels", "chromaticities", "chunkCount", "compression", "dataWindow", "displayWindow"),
    *(
        _IMAGE_CHANNELS,
        "lineOrder",
        "name",
        "pixelAspectRatio",
        "screenWindowCenter",
        "screenWindowWidth",
    ),
    *("tiles", "type", "version", "view"),
}
"""Attributes that describe the layout of the file, and nothing else."""
_LARGEST = 2**26
"""Pixels of a display window up to which a small file is believed."""
_OVERFLOW = float(np.finfo(np.float16).max)
_COLOURS = (("r", "g", "b"), ("red", "green", "blue"))
_CIE = ("x", "y", "z")
_BEAUTY = re.compile(
    r"|(.*\W)?(rgba?|beauty|colou?r|combined|main|default|left|c|ci)", re.IGNORECASE
)
"""Names of the first of several parts that mark it as the image."""
_ORDERS = (*_COLOURS, _CIE, ("u", "v"), ("y",), ("z",))
"""Channels of a layer in their usual order, in any case; files have them in alphabetical order."""
_SPACES = ("colorinteropid", "colorspace")
"""Names of attributes, in any namespace, that name a colour space."""


@dataclass(frozen=True, repr=False)
class ExrImage(Shown):
    """The image in an EXR file.

    Attributes
    ----------
    image
        Linear radiance, float32, shape (y, x, channel).
    channels
        Names of its channels.
    extra
        Other layers by name, shape (y, x); or (y, x, channel) for a layer with the channels of the
        image. float32, or uint32 if the file holds whole numbers.
    attributes
        Text in the header of the file.
    averaged
        Samples of each pixel that the header says the image to be the mean of; 1 if it says none.
    """

    image: Image
    channels: tuple[str, ...]
    extra: Mapping[str, Array]
    attributes: Mapping[str, str]
    averaged: int = 1

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> Array:
        """Return the image."""
        return np.array(self.image, dtype, copy=copy)

    def _card(self) -> Card:
        known = self.image.shape[-1] in (1, 3)
        shown = {"image": png(tonemap(self.image))} if known else {}
        return replace(super()._card(), images=shown)


def read_exr(path: str | Path, *, channels: Sequence[str] | None = None) -> ExrImage:
    """Read an image and its layers from an EXR file.

    The image is the display window: 0 where the file has no pixels, without pixels outside. Colours
    are converted to linear Rec. 709. A `chdstat.errors.InputWarning` says so, and says what else is
    unusual.

    Parameters
    ----------
    path
        The file.
    channels
        Channels or layers of the image. None takes red, green and blue, in any case; or else Y, or
        the only layer of colours. All others become `ExrImage.extra`, as they are in the file. The
        channel X of a part "normal" is called normal.X; that of the first part is called X.

    Returns
    -------
    ExrImage
        The display window of the file.

    Raises
    ------
    InputError
        If the file holds no such channels.
    StoreError
        If there is no such file, it is damaged, or the image is of a kind that cannot be read:
        deep, luminance and chroma, at lower resolution, or outside the display window.

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
    planes = _read_planes(Path(path))
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
        image=image,
        channels=shown,
        extra=planes.others(names),
        attributes=planes.texts(),
        averaged=_averaged(planes.attributes),
    )


def read_feature(path: Path, name: str) -> Image:
    """Return a first-hit feature from a file: the layer of its name, or else the image.

    Raises
    ------
    InputError
        If it is not clear which channels are the feature.
    StoreError
        As `read_exr` does.
    """
    planes = _read_planes(path)
    advice = f"rename one to {name}, or give features the array of read_exr(..., channels=) of"
    held = {name.rpartition(".")[0] for name in planes.channels} | planes.channels.keys()
    names = planes.layer(name) if name in held else planes.main(advice, radiance=False)
    image = planes.image(names, colours=name == "albedo")
    for note in planes.notes.values():
        warn_caller(note)
    return image


@dataclass(frozen=True)
class _Planes:
    """The channels of an EXR file in its display window.

    Attributes
    ----------
    path
        The file.
    attributes
        Attributes of its first part.
    window
        The display window.
    channels
        Channels by name, each (y, x), in the types of the file. Channels of other parts than the
        first are named like layers: ``normal.X`` is the channel X of the part "normal".
    unread
        Why other channels cannot be read, by name.
    parts
        Names of the parts with colours.
    notes
        Warnings about the file by kind; one of each kind is shown.
    """

    path: Path
    attributes: Mapping[str, Any]
    window: Rectangle
    channels: Mapping[str, Array]
    unread: Mapping[str, str]
    parts: Sequence[str]
    notes: dict[str, str]

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x)."""
        return _shape(self.window)

    def layer(self, name: str) -> tuple[str, ...]:
        """Return the channels of a layer in their usual order, without alpha, or one channel.

        Raises
        ------
        InputError
            If there is no such layer or channel.
        StoreError
            If it is of a kind that cannot be read.
        """
        if name in self.channels or name in self.unread:
            return self._readable([name])
        inside = self._inside(name)
        if not inside:
            held = ", ".join(self.channels)
            message = f"{self.path} has no layer {name!r}, but the channels {held}"
            raise InputError(message)
        found = next((f for order in _ORDERS[:-2] if (f := _ordered(inside, order))), ())
        without_alpha = tuple(full for own, full in inside.items() if own not in "Aa")
        return self._readable(found or without_alpha or tuple(inside.values()))

    def main(self, advice: str, *, radiance: bool = True) -> tuple[str, ...]:
        """Return the channels of the image: red, green and blue, X, Y and Z, or Y.

        Without these, they are those of the only layer of colours. If the image is not `radiance`,
        such as normals, they may also be other channels.

        Raises
        ------
        InputError
            If it is not clear which; the message ends with `advice` and names of layers.
        StoreError
            If they are of a kind that cannot be read.
        """
        if radiance and (named := self._named()):
            return self._readable(named)
        every = [*self.channels, *self.unread]
        top, layers = self._inside(""), sorted({n.rpartition(".")[0] for n in every} - {""})
        coloured = [layer for layer in layers if _coloured(self._inside(layer))]
        if radiance and {"RY", "BY"} & top.keys():
            message = (
                f"{self.path} holds luminance and chroma, Y, RY and BY, which are not put together "
                f"here: write it with R, G and B; or for the luminance alone {advice} Y"
            )
            raise StoreError(message)
        orders: Sequence[Sequence[str]] = (*_COLOURS, _CIE, ("y",)) if radiance else _ORDERS
        if radiance and coloured and _ordered(top, _CIE):  # which may be positions
            orders = _COLOURS
        if found := next((f for order in orders if (f := _ordered(top, order))), ()):
            image, *others = self.parts or [""]
            if radiance and others and not _BEAUTY.fullmatch(image):
                self.notes["parts"] = (
                    f"{self.path} has {len(self.parts)} parts of colours: the first, {image!r}, is "
                    f"taken for the image; {advice} {', '.join(others)} for another"
                )
            return self._readable(found)
        only = coloured or ([] if radiance or top else layers)
        if len(only) == 1:
            return self.layer(only[0])
        if len(every) == 1 and not radiance:
            return self._readable(every)
        offered = ", ".join(n for n in coloured or [*layers, *top] if self._holds_numbers(n))
        if not offered:
            self._readable(every)
            advice = "its channels are whole numbers, as those of objects are"
        message = f"{self.path} has no channels R, G, B or Y; {advice} {offered}".rstrip()
        raise InputError(message)

    def _named(self) -> tuple[str, ...]:
        """Return the channels that the header names as those of the image; () if it names none."""
        with contextlib.suppress(TypeError, ValueError):
            names = tuple(json.loads(self.attributes.get(_IMAGE_CHANNELS, "")))
            return names if names and {*names} <= {*self.channels, *self.unread} else ()
        return ()

    def _holds_numbers(self, name: str) -> bool:
        """Return whether a layer or channel can be read as samples."""
        names = self._inside(name).values() or [name]
        return all(n in self.channels and self.channels[n].dtype.kind == "f" for n in names)

    def _readable(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return names of channels, after checking that all of them can be read."""
        for name in names:
            if name in self.unread:
                message = f"{self.path}: channel {name!r} {self.unread[name]}"
                raise StoreError(message)
        return tuple(names)

    def image(self, names: Sequence[str], *, colours: bool | None) -> Image:
        """Return channels as an image (y, x, channel), `colours` in linear Rec. 709.

        With None, channels called R, G and B are colours.

        Raises
        ------
        StoreError
            If colours are whole numbers.
        """
        planes = [self.channels[name] for name in names]
        found = np.stack([_single(plane) for plane in planes], axis=-1).astype(np.float32)
        if not (_coloured(_own(names)) if colours is None else colours):
            return found
        if any(plane.dtype.kind == "u" for plane in planes):
            message = (
                f"{self.path}: {', '.join(names)} holds whole numbers, as those of objects are; "
                "expected radiance"
            )
            raise StoreError(message)
        if any(p.dtype == np.float16 and (np.abs(p) >= _OVERFLOW).any() for p in planes):
            self.notes["half"] = (
                f"{self.path} holds half floats of {_OVERFLOW:g}, the most that they can be, or "
                "infinite ones: what is brighter was cut. Write float to keep it"
            )
        matrix = self._matrix(names)
        if matrix is None:
            return found
        with np.errstate(invalid="ignore", over="ignore"):  # of infinite values
            return np.asarray(found @ matrix.T.astype(np.float32))

    def _matrix(self, names: Sequence[str]) -> npt.NDArray[np.float64] | None:
        """Return the matrix from channels to linear Rec. 709, None for none, and note why."""
        kinds, note = tuple(map(str.casefold, _own(names))), f"{self.path}: its colours are "
        if kinds == _CIE and "." not in names[0]:
            self.notes["xyz"] = f"{note}X, Y and Z of CIE 1931, converted to linear Rec. 709"
            return from_xyz()
        if kinds not in _COLOURS:
            return None
        texts = {re.split("[:/]", n)[-1].casefold(): v for n, v in self.texts().items()}
        space = next((texts[name] for name in _SPACES if name in texts), "")
        known = _colours_named(space)
        aces = AP0 if self.attributes.get("acesImageContainerFlag") == 1 else ()
        given = self.attributes.get("chromaticities") or aces or known or REC709
        try:
            matrix = _to_rec709(given)
        except (TypeError, ValueError) as error:  # TypeError: of a kind that is not known
            self.notes["chromaticities"] = f"{note}taken for linear Rec. 709: {error}"
            return None
        if matrix is not None:
            text = ", ".join(f"{value:.4g}" for value in given)
            self.notes[text] = (
                f"{note}converted to linear Rec. 709; x and y of their red, green, blue and white "
                f"are {text}"
            )
        elif known is None or (known and known != REC709):
            self.notes[space] = (
                f"{note}taken for linear Rec. 709, but the file names the colour space {space!r}"
            )
        return matrix

    def others(self, names: Sequence[str]) -> dict[str, Array]:
        """Return the other channels; those named like `names` become one layer (y, x, channel)."""
        kept = {name: _single(p) for name, p in self.channels.items() if name not in names}
        own = _own(names)
        layers = {name.rpartition(".")[0] for name in kept} - {"", *kept}
        for layer in layers:
            inside = self._inside(layer)
            if inside.keys() == set(own):
                kept[layer] = np.stack([kept.pop(inside[name]) for name in own], axis=-1)
        return kept

    def texts(self) -> dict[str, str]:
        """Return the attributes that are text and not part of the format."""
        return {
            name: value
            for name, value in self.attributes.items()
            if isinstance(value, str) and name not in _OF_THE_FORMAT
        }

    def _inside(self, layer: str) -> dict[str, str]:
        """Return the full names of the channels of a layer, by their own names."""
        # Channels of the first part may have its name, or none.
        of = {"", layer} if layer == self.attributes.get("name") else {layer}
        split = ((name.rpartition("."), name) for name in (*self.channels, *self.unread))
        return {own: name for (layer, _, own), name in split if layer in of}


def _own(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of channels without the names of their layers."""
    return tuple(name.rpartition(".")[2] for name in names)


def _ordered(inside: Mapping[str, str], order: Sequence[str]) -> tuple[str, ...]:
    """Return the full names of channels in an order, in any case; () if one is missing."""
    for spelled in (str.upper, str.lower, str.capitalize):
        if {*map(spelled, order)} <= inside.keys():
            return tuple(inside[spelled(name)] for name in order)
    return ()


def _coloured(inside: Iterable[str]) -> bool:
    return any(_ordered(dict.fromkeys(inside, ""), order) for order in _COLOURS)


def _single(plane: Array) -> Array:
    """Return half floats as floats."""
    return plane.astype(np.float32, copy=False) if plane.dtype.kind == "f" else plane


def _read_planes(path: Path) -> _Planes:
    """Return the channels of an EXR file.

    Raises
    ------
    StoreError
        As `read_exr` does.
    """
    import OpenEXR

    try:
        with path.open("rb") as start:
            magic = start.read(len(_MAGIC))
    except OSError as error:
        why = f"cannot read {path}: {error.strerror or error}"
        message = why if path.is_file() else f"no EXR file at {path}"
        raise StoreError(message) from error
    if magic != _MAGIC:
        message = f"{path} is not an EXR file: it does not begin as one"
        raise StoreError(message)
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            headers = [part.header for part in file.parts]
            data = [_window(header, "dataWindow") for header in headers]
            display = _window(headers[0], "displayWindow")
            claimed = [_pixels(w) * len(h["channels"]) for w, h in zip(data, headers, strict=True)]
            check_claim(path, 4 * sum(claimed))
            if _pixels(display) > _LARGEST:
                check_claim(path, 4 * _pixels(display))
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [(str(part.name()), dict(part.channels)) for part in file.parts]
            attributes = dict(file.header())
            channels: dict[str, Array] = {}
            unread: dict[str, str] = {}
            for (part, held), window in zip(parts, data, strict=True):
                for name, channel in held.items():
                    outside = part != parts[0][0] and not name.startswith(f"{part}.")
                    full = f"{part}.{name}" if outside else name
                    if why := _unreadable(channel, window, display):
                        unread[full] = why
                    else:
                        channels[full] = _placed(channel.pixels, window, display)
    except (OSError, RuntimeError, ValueError, MemoryError) as error:
        message = f"{path} is damaged or cut off; write or copy it again ({error})"
        raise StoreError(message) from error
    coloured = [part for part, held in parts if _coloured(_own([*held]))]
    notes = _notes(path, attributes, data, display)
    return _Planes(path, attributes, display, channels, unread, coloured, notes)


def _window(header: Mapping[str, Any], name: str) -> Rectangle:
    left, top, right, bottom = (int(edge) for corner in header[name] for edge in corner)
    return left, top, right, bottom


def _shape(window: Rectangle) -> tuple[int, int]:
    left, top, right, bottom = window
    return bottom - top + 1, right - left + 1


def _pixels(window: Rectangle) -> int:
    height, width = _shape(window)
    return max(height, 0) * max(width, 0)


def _unreadable(channel: Any, data: Rectangle, display: Rectangle) -> str:
    """Return why a channel is not one value per pixel; "" if it is."""
    if channel.pixels.dtype.kind not in "fu":
        return "is deep, with any number of values in each pixel: flatten it first"
    if (channel.xSampling, channel.ySampling) != (1, 1) or channel.pixels.shape != _shape(data):
        return (
            f"is of a resolution of its own; expected one value for each of {_shape(data)} pixels"
        )
    if any(data[i] > display[i + 2] or data[i + 2] < display[i] for i in (0, 1)):
        return f"has the data window {data} outside of the display window {display}"
    return ""


def _placed(plane: Array, data: Rectangle, display: Rectangle) -> Array:
    """Return a channel in the display window, 0 where the file has no pixels."""
    if data == display:
        return plane
    whole = np.zeros(_shape(display), plane.dtype)
    begins = [data[1] - display[1], data[0] - display[0]]
    to = tuple(
        slice(max(begin, 0), min(begin + n, size))
        for begin, n, size in zip(begins, plane.shape, whole.shape, strict=True)
    )
    whole[to] = plane[
        tuple(slice(s.start - b, s.stop - b) for s, b in zip(to, begins, strict=True))
    ]
    return whole


def _notes(
    path: Path, attributes: Mapping[str, Any], data: Sequence[Rectangle], display: Rectangle
) -> dict[str, str]:
    """Return warnings about windows and pixels."""
    notes = {}
    outside = [
        w for w in data if any(np.less(w[:2], display[:2])) or any(np.greater(w[2:], display[2:]))
    ]
    if outside:
        notes["overscan"] = (
            f"{path} has pixels outside of its display window (left, top, right, bottom = "
            f"{display}; data: {outside[0]}): they were left out"
        )
    if (aspect := float(attributes.get("pixelAspectRatio", 1))) != 1:
        notes["aspect"] = (
            f"{path} has pixels of {aspect:.4g} times their height in width: they are kept as they "
            "are, and shown as squares"
        )
    return notes


# --- colours --------------------------------------------------------------------------------------

Matrix = npt.NDArray[np.float64]
_Chromaticities = tuple[float, ...]
"""x and y of red, green, blue and white."""

_D65, _ACES_WHITE = (0.3127, 0.3290), (0.32168, 0.33767)
REC709: _Chromaticities = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *_D65)
"""Linear Rec. 709, which is linear sRGB."""
AP0: _Chromaticities = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, *_ACES_WHITE)
_AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES_WHITE)
_NAMED: Mapping[str, _Chromaticities] = {
    "acescg": _AP1,
    "ap1": _AP1,
    "aces2065": AP0,
    "ap0": AP0,
    "rec2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    "p3d65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    "adobergb": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65),
    "rec709": REC709,
    "srgb": REC709,
}
_SAYS_NOTHING = frozenset(("", "linear", "scenelinear", "raw", "data", "unknown", "none"))
_CLOSE = 5e-4
"""Difference of chromaticities that were rounded in different ways."""
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def _colours_named(space: str) -> _Chromaticities | None:
    """Return the chromaticities of a linear colour space by name; () if the name says nothing.

    None means that the name is not understood, or the space is not linear.

    Examples
    --------
    >>> _colours_named("lin_ap1_scene") == _colours_named("ACES - ACEScg")
    True
    >>> _colours_named("Linear"), _colours_named("sRGB")
    ((), None)
    """
    plain = re.sub(r"[^a-z0-9]", "", space.casefold())
    if plain in _SAYS_NOTHING:
        return ()
    linear = re.search("(?<!non)lin", plain) or "acescg" in plain or "aces2065" in plain
    return next((c for name, c in _NAMED.items() if linear and name in plain), None)


def _to_rec709(chromaticities: Sequence[Any]) -> Matrix | None:
    """Return the matrix that converts colours to linear Rec. 709; None if they are Rec. 709.

    Raises
    ------
    ValueError
        If no colours have such chromaticities.

    References
    ----------
    SMPTE RP 177-1993; the adaptation of the white point is that of Lam (1985).

    Examples
    --------
    >>> np.round(_to_rec709((0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290))[0], 4)
    array([ 1.6605, -0.5876, -0.0728])
    """
    given = np.asarray(chromaticities, dtype=float)
    if given.shape == (8,) and np.abs(given - REC709).max() <= _CLOSE:
        return None
    if given.shape != (8,) or not np.isfinite(given).all() or given[7] <= 0:
        message = f"{chromaticities} are no chromaticities"
        raise ValueError(message)
    ours, white = _to_xyz(np.array(REC709))
    theirs, other = _to_xyz(given)
    cone = (_BRADFORD @ white) / (_BRADFORD @ other)
    adapted = np.linalg.solve(_BRADFORD, cone[:, np.newaxis] * _BRADFORD)
    same = np.abs(given[6:] - REC709[6:]).max() <= _CLOSE
    found = np.asarray(np.linalg.solve(ours, theirs if same else adapted @ theirs), float)
    if not np.isfinite(found).all():
        message = f"{chromaticities} are no chromaticities"
        raise ValueError(message)
    return found


def from_xyz() -> Matrix:
    """Return the matrix from tristimulus values of CIE 1931 to linear Rec. 709, white unadapted.

    Examples
    --------
    >>> from_xyz()[0].round(4)
    array([ 3.241 , -1.5374, -0.4986])
    """
    return np.asarray(np.linalg.inv(_to_xyz(np.array(REC709))[0]), float)


def _to_xyz(chromaticities: Matrix) -> tuple[Matrix, Matrix]:
    """Return the matrix to tristimulus values, and the white point with Y = 1."""
    x, y = chromaticities.reshape(4, 2).T
    columns = np.stack([x, y, 1 - x - y])
    if abs(np.linalg.det(columns[:, :3])) < 1e-6:
        message = f"primaries {chromaticities[:6]} lie on a line"
        raise ValueError(message)
    white = columns[:, 3] / y[3]
    return columns[:, :3] * np.linalg.solve(columns[:, :3], white), white


# --- stacks ---------------------------------------------------------------------------------------

_COUNTED = re.compile(r"samplesPerPixel|cycles\..*\.samples")
"""Attributes that say how many samples an image is the average of."""


def open_exr(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open EXR files, each with one sample, or one average, of every pixel.

    The samples are the colours of the image, or the layer `variable`, without alpha. Features are
    layers, averaged over all files, since each sample of a pixel sees something else.

    Notes
    -----
    Read
        Float and half; scanlines and tiles; every lossless or lossy compression; several parts; R,
        G and B, in any case, also as ``red``, ``green``, ``blue``; else ``Y``; else the only
        layer of such channels, or ``variable``; the number of averaged samples.
    Converted
        Data windows: placed in the display window, 0 outside. Colours of other primaries: to linear
        Rec. 709. ``X``, ``Y``, ``Z`` without a layer: CIE XYZ to linear Rec. 709.
    Warned of
        Both conversions of colours; several parts with colours, if the name of the first does not
        mark it as the image; overscan, which is cut; a colour space that is unknown or not linear;
        invalid chromaticities; pixels that are not square; half floats of 65504 or infinity;
        copies.
    Ignored
        Alpha, other layers, levels but the first of mipmaps, ``whiteLuminance``, ``expTime``,
        ``adoptedNeutral`` and other attributes.
    Refused
        Several layers that could be the image; luminance and chroma (``RY``, ``BY``); whole numbers
        as radiance; deep channels and those of lower resolution, if they are asked for; data
        windows outside of the display window; files of one stack that differ in display window,
        channels, or number of averaged samples; damaged files.
    """
    first, told = _read_planes(paths[0]), set[str]()
    names = (
        first.layer(options.variable)
        if options.variable
        else first.main("give the layer of the samples as variable, one of")
    )
    layers = {name: first.layer(inside) for name, inside in options.features.items()}
    averaged = _averaged(first.attributes)

    def frame(planes: _Planes) -> Frame:
        _check_equal(planes, first, [*names, *itertools.chain(*layers.values())])
        image = planes.image(names, colours=True)
        features = {n: planes.image(of, colours=n == "albedo") for n, of in layers.items()}
        for kind in planes.notes.keys() - told:
            told.add(kind)
            warn_caller(planes.notes[kind])
        return image, features

    def decode(samples: range) -> Iterator[Frame]:
        for number in samples:
            yield frame(_read_planes(paths[number]) if number else first)

    shape = (*first.shape, len(names), len(paths))
    frame(first)  # what is to be said of it, is said now
    attrs = {"averaged": averaged} if averaged > 1 else {}
    return Opened(Frames(paths[0].parent, shape, decode, featured=bool(layers)), attrs)


def _check_equal(planes: _Planes, first: _Planes, names: Sequence[str]) -> None:
    """Refuse a file that is not another sample of the first file's image."""
    path, counts = planes.path, [_averaged(p.attributes) for p in (planes, first)]
    if counts[0] != counts[1]:
        message = (
            f"{path} is an average of {counts[0]} samples, {first.path.name} of {counts[1]}: read "
            "them apart"
        )
        raise InputError(message)
    if not set(names) <= planes.channels.keys():
        held = ", ".join(planes.channels)
        message = f"{path} has channels {held}, but the first file {', '.join(names)}"
        raise InputError(message)
    if planes.window != first.window:
        shapes = [f"{p.shape} pixels" for p in (planes, first)]
        if planes.shape == first.shape:
            shapes = [f"a display window that begins at {p.window[:2]}" for p in (planes, first)]
        message = f"{path} has {shapes[0]}, but the first file {shapes[1]}"
        raise InputError(message)


def _averaged(attributes: Mapping[str, Any]) -> int:
    """Return how many samples an image is the average of, by its attributes, or 1."""
    for name, value in attributes.items():
        if _COUNTED.fullmatch(name) and str(value).isdecimal():
            return max(int(value), 1)
    return 1


# --- writing --------------------------------------------------------------------------------------


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

    The file is written as a whole or not at all; an existing one is replaced at the end.

    Parameters
    ----------
    path
        The file.
    image
        Linear radiance, shape (y, x, channel). NaN and infinite values are kept.
    channels
        Names of the channels; by default R, G, B, or Y for one channel. Viewers show R, G, B as an
        image in linear sRGB. The header keeps other names, so that `read_exr` finds the image.
    extra
        Layers by name. Shape (y, x) makes a channel of that name. Shape (y, x, channel) makes a
        layer with channels such as ``low.R``, ``low.G``, ``low.B``. float16 is kept, and uint32,
        for object numbers.
    attributes
        Text for the header, such as the provenance of the image.
    pixel_type
        'float' for 32 bits, or 'half' for 16 bits: 11 significant bits, up to 65504.

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
        **({} if names in _USUAL.values() else {_IMAGE_CHANNELS: json.dumps(names)}),
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
    """Convert to the type of the file; infinity stays, but no finite value may become infinite."""
    if plane.dtype in (np.uint32, np.float16):
        return np.ascontiguousarray(plane)
    kind = _TYPES[pixel_type]
    with np.errstate(over="ignore", under="ignore"):
        # The writer ignores strides: arrays that are not contiguous would be scrambled.
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
    """Refuse attributes that are not text, or that the format sets itself."""
    for name, value in attributes.items():
        _check_name("header attribute", name)
        if name in _OF_THE_FORMAT:
            message = f"attribute {name!r} belongs to the format; choose another name"
            raise InputError(message)
        if not isinstance(value, str):
            message = f"attribute {name!r} must be text, got {type(value).__name__}"
            raise InputError(message)
