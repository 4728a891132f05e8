"""Planes: the channels of EXR files, in the display window, and which of them are the image.

A file has the pixels of its data window, which may be a part of the display window, the image, or
reach beyond it. Its colours are of the primaries that `chromaticities` name, those of Rec. 709 by
default.

Source: Academy Software Foundation, "Technical introduction to OpenEXR", "OpenEXR file layout" and
"Standard attributes", https://openexr.com.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array
from chdstat._core.files import check_claim
from chdstat.errors import InputError, StoreError
from chdstat.io.primaries import AP0, REC709, from_xyz, named, to_rec709

__all__ = ["OF_THE_FORMAT", "Planes", "read_planes"]


_MAGIC = b"\x76\x2f\x31\x01"
"""What every EXR file begins with."""
OF_THE_FORMAT = frozenset(
    (
        "channels",
        "chromaticities",
        "chunkCount",
        "compression",
        "dataWindow",
        "displayWindow",
        "lineOrder",
        "name",
        "pixelAspectRatio",
        "screenWindowCenter",
        "screenWindowWidth",
        "tiles",
        "type",
        "version",
        "view",
    )
)
"""Attributes that say how the file is laid out: nobody else's."""


Window = tuple[int, int, int, int]
"""Left, top, right and bottom of the pixels of an image, all of them inside."""

_LARGEST = 2**26
"""Pixels of a display window up to which a file need not be large to be believed."""
_OVERFLOW = float(np.finfo(np.float16).max)
_COLOURS = (("r", "g", "b"), ("red", "green", "blue"))
_CIE = ("x", "y", "z")
_ORDERS = (*_COLOURS, _CIE, ("u", "v"), ("y",), ("z",))
"""Channels of a layer in their order, in capitals or not; files have them in the alphabet's."""
_SPACES = ("colorinteropid", "colorspace")
"""Names of attributes, in whatever namespace, that name a colour space."""


@dataclass(frozen=True)
class Planes:
    """The channels of an EXR file, brought to its display window.

    Attributes
    ----------
    path
        The file.
    attributes
        Those of its first part.
    window
        The display window.
    channels
        Shape (y, x) each, by name, of the types of the file. Those of other parts than the first
        are called as layers are: ``normal.X`` is the channel X of the part "normal".
    unread
        Why other channels cannot be read, by name.
    notes
        What a user is to be told of the file, by kinds of which one is told once.
    """

    path: Path
    attributes: Mapping[str, Any]
    window: Window
    channels: Mapping[str, Array]
    unread: Mapping[str, str]
    notes: dict[str, str]

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x)."""
        return _shape(self.window)

    def layer(self, name: str) -> tuple[str, ...]:
        """Return the channels of a layer in their usual order, without alpha; or of that name.

        Raises
        ------
        InputError
            If there is no such layer or channel.
        StoreError
            If it is of a kind that is not read.
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

        Where these are missing, they are those of the only layer of colours. Of what is no
        `radiance`, such as normals, they may be other channels, too.

        Raises
        ------
        InputError
            If it is not clear which they are; the message ends with `advice` and names of layers.
        StoreError
            If they are of a kind that is not read.
        """
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

    def _holds_numbers(self, name: str) -> bool:
        """Return whether a layer or channel can be read as samples."""
        names = self._inside(name).values() or [name]
        return all(n in self.channels and self.channels[n].dtype.kind == "f" for n in names)

    def _readable(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return names of channels, all of which are read."""
        for name in names:
            if name in self.unread:
                message = f"{self.path}: channel {name!r} {self.unread[name]}"
                raise StoreError(message)
        return tuple(names)

    def image(self, names: Sequence[str], *, colours: bool | None) -> npt.NDArray[np.float32]:
        """Return channels as an image (y, x, channel); `colours` in linear Rec. 709.

        None takes for colours what is called R, G and B.

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
        known = named(space)
        aces = AP0 if self.attributes.get("acesImageContainerFlag") == 1 else ()
        given = self.attributes.get("chromaticities") or aces or known or REC709
        try:
            matrix = to_rec709(given)
        except ValueError as error:
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
        """Return the other channels; as one layer (y, x, channel) those called as `names` are."""
        kept = {name: _single(p) for name, p in self.channels.items() if name not in names}
        own = _own(names)
        layers = {name.rpartition(".")[0] for name in kept} - {"", *kept}
        for layer in layers:
            inside = self._inside(layer)
            if inside.keys() == set(own):
                kept[layer] = np.stack([kept.pop(inside[name]) for name in own], axis=-1)
        return kept

    def texts(self) -> dict[str, str]:
        """Return the attributes that are text and do not belong to the format."""
        return {
            name: value
            for name, value in self.attributes.items()
            if isinstance(value, str) and name not in OF_THE_FORMAT
        }

    def _inside(self, layer: str) -> dict[str, str]:
        """Return the full names of the channels of a layer, by their own."""
        of = "" if layer == self.attributes.get("name") else layer
        split = ((name.rpartition("."), name) for name in (*self.channels, *self.unread))
        return {own: name for (layer, _, own), name in split if layer == of}


def _own(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of channels without those of their layers."""
    return tuple(name.rpartition(".")[2] for name in names)


def _ordered(inside: Mapping[str, str], order: Sequence[str]) -> tuple[str, ...]:
    """Return the full names of channels in an order, in capitals or not; () if one is missing."""
    for spelled in (str.upper, str.lower, str.capitalize):
        if {*map(spelled, order)} <= inside.keys():
            return tuple(inside[spelled(name)] for name in order)
    return ()


def _coloured(inside: Iterable[str]) -> bool:
    return any(_ordered(dict.fromkeys(inside, ""), order) for order in _COLOURS)


def _single(plane: Array) -> Array:
    """Return half floats as floats."""
    return plane.astype(np.float32, copy=False) if plane.dtype.kind == "f" else plane


def read_planes(path: Path) -> Planes:
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
            data = [_window(header["dataWindow"]) for header in headers]
            display = _window(headers[0]["displayWindow"])
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
    return Planes(
        path, attributes, display, channels, unread, _notes(path, attributes, data, display)
    )


def _window(box: Any) -> Window:
    (left, top), (right, bottom) = box
    return int(left), int(top), int(right), int(bottom)


def _shape(window: Window) -> tuple[int, int]:
    left, top, right, bottom = window
    return bottom - top + 1, right - left + 1


def _pixels(window: Window) -> int:
    height, width = _shape(window)
    return max(height, 0) * max(width, 0)


def _unreadable(channel: Any, data: Window, display: Window) -> str:
    """Return why a channel is not one value for each pixel; "" if it is."""
    if channel.pixels.dtype.kind not in "fu":
        return "is deep, with any number of values in each pixel: flatten it first"
    if (channel.xSampling, channel.ySampling) != (1, 1) or channel.pixels.shape != _shape(data):
        return (
            f"is of a resolution of its own; expected one value for each of {_shape(data)} pixels"
        )
    if any(data[i] > display[i + 2] or data[i + 2] < display[i] for i in (0, 1)):
        return f"has the data window {data} outside of the display window {display}"
    return ""


def _placed(plane: Array, data: Window, display: Window) -> Array:
    """Return the part of a channel in the display window, 0 where the file holds nothing."""
    if data == display:
        return plane
    ys, xs = (slice(max(data[i], display[i]), min(data[i + 2], display[i + 2]) + 1) for i in (1, 0))
    whole = np.zeros(_shape(display), plane.dtype)
    (to_y, to_x), (of_y, of_x) = (
        (slice(ys.start - w[1], ys.stop - w[1]), slice(xs.start - w[0], xs.stop - w[0]))
        for w in (display, data)
    )
    whole[to_y, to_x] = plane[of_y, of_x]
    return whole


def _notes(
    path: Path, attributes: Mapping[str, Any], data: Sequence[Window], display: Window
) -> dict[str, str]:
    """Return what is to be told of windows and pixels."""
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
