"""View: what one page of the explorer shows, as a value that fits into an address.

A view holds the selected pixels or region and all display options, but no samples. Each user action
is a function from a view to the next view. `View.query` writes an address and `parse_view` reads
it; invalid parts of an address become a note, and the other parts are used.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal
from urllib.parse import urlencode

from chdstat.errors import InputError
from chdstat.fit.families import FAMILIES
from chdstat.viz.styling import MAGNITUDES, SIGNED

MOST_PIXELS = 6
_MOST_IMAGES = 9
"""Most images: one for each digit key."""
FITS = ("best", *FAMILIES, "mixture")
"""Fits that can be drawn over the histograms."""
TONES = ("srgb", "reinhard", "filmic")
BATCH_SIZES = (1, 2, 4, 8, 16, 32, 64, 128, 256)
"""Numbers N of samples for averages and estimates."""
BATCHES = 4
"""Fewest averages of N: with fewer, there is no distribution."""
_CHOICES: Mapping[str, Sequence[object]] = {
    "families": FITS,
    "batch": BATCH_SIZES,
    "tone": TONES,
    "cmap": MAGNITUDES,
    "signed": SIGNED,
    "channel": ("all", "luminance", "0", "1", "2"),
    "shown": range(_MOST_IMAGES),
    "reference": (None, *range(_MOST_IMAGES)),
}
_RANGES = {"exposure": (-32.0, 32.0, "stops"), "gamma": (0.1, 10.0, "as an exponent")}
"""Ends and unit of options that are any number in a range."""
_MAP_CHARACTERS = set("abcdefghijklmnopqrstuvwxyz0123456789_:")

PixelIndex = tuple[int, int]
Box = tuple[int, int, int, int]
NULLS: Final = "null"
Brush = tuple[float | None, float | None] | Literal["null"]
"""Radiance from and to, None for no end; or the null samples."""
BRUSHED = "brushed"
"""Name of the map of the samples of a brush."""
LOOKS = ("map", "brush", "limits", "cmap", "signed", "exposure", "tone", "gamma")
"""Options that change the image, but not the results of the selection."""


@dataclass(frozen=True)
class View:
    """What a page shows.

    Attributes
    ----------
    pixels
        (y, x) of the selected pixels, at most six.
    active
        Index of the pixel that tables describe and that arrow keys move.
    region
        (top, left, bottom, right) of the selected box, the last two exclusive; then `pixels` is
        empty.
    map
        Name of the map that is shown instead of the image; "image" for the image itself.
    limits
        Ends of the colour bar of a map of numbers; None for automatic ends.
    cmap, signed
        Names of the colour maps of numbers, and of numbers to both sides of a middle.
    brush
        Samples whose pixels are shown instead of the map; None for none.
    channel
        "all", "luminance", or the number of a channel. Several pixels show luminance for "all".
    families
        Some of `FITS`, drawn over the histograms.
    batch
        N of the averages.
    exposure
        Stops; None for automatic.
    tone, gamma
        One of `TONES`, and a gamma exponent after it, 1 for none.
    shown, reference
        Indices of the shown image and of the one to compare with, from 0; None for the last image.

    Examples
    --------
    >>> view = View().pick(3, 5).pick(4, 9, add=True).move(1, 0, 32, 32)
    >>> view.pixels, view.active
    (((3, 5), (5, 9)), 1)
    >>> view.query()
    'p=3%2C5&p=5%2C9'
    """

    pixels: tuple[PixelIndex, ...] = ()
    active: int = 0
    region: Box | None = None
    map: str = "image"
    limits: tuple[float, float] | None = None
    cmap: str = MAGNITUDES[0]
    signed: str = SIGNED[0]
    brush: Brush | None = None
    channel: str = "all"
    families: tuple[str, ...] = ("best",)
    batch: int = 32
    exposure: float | None = None
    tone: str = "srgb"
    gamma: float = 1.0
    shown: int = 0
    reference: int | None = None

    def pick(self, y: int, x: int, *, add: bool = False) -> View:
        """Select a pixel; with `add`, add it to the selection, or remove it if it is selected.

        Raises
        ------
        InputError
            If six are selected already.
        """
        pixel = (y, x)
        if not add:
            return replace(self, pixels=(pixel,), active=0, region=None)
        if pixel in self.pixels:
            return self.drop(self.pixels.index(pixel))
        if len(self.pixels) == MOST_PIXELS:
            message = f"at most {MOST_PIXELS} pixels can be selected; shift-click one to drop it"
            raise InputError(message)
        pixels = (*self.pixels, pixel)
        return replace(self, pixels=pixels, active=len(pixels) - 1, region=None)

    def drop(self, index: int) -> View:
        """Remove a pixel from the selection, or the region."""
        pixels = self.pixels[:index] + self.pixels[index + 1 :]
        active = max(0, min(self.active, len(pixels) - 1))
        return replace(self, pixels=pixels, active=active, region=None)

    def activate(self, index: int) -> View:
        """Choose the pixel that tables describe."""
        return replace(self, active=index) if 0 <= index < len(self.pixels) else self

    def box(self, region: Box) -> View:
        """Select a region; a region of one pixel selects the pixel."""
        top, left, bottom, right = region
        if (bottom - top, right - left) == (1, 1):
            return self.pick(top, left)
        return replace(self, pixels=(), active=0, region=region)

    def move(self, dy: int, dx: int, height: int, width: int) -> View:
        """Move the active pixel inside the image, not onto another one; if none, to the centre."""
        if not self.pixels:
            return self if self.region else self.pick(height // 2, width // 2)
        y, x = self.pixels[self.active]
        moved = min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)
        if moved in self.pixels:
            return self
        pixels = tuple(moved if i == self.active else p for i, p in enumerate(self.pixels))
        return replace(self, pixels=pixels)

    def changed(self, option: str, value: Any) -> View:
        """Set one of `_OPTIONS`.

        Raises
        ------
        InputError
            If there is no such option, or the value is out of range.
        """
        known = _CHOICES.get(option)
        if known is not None:
            many = option == "families"
            if not (set(value) <= set(known) if many else value in known):
                message = f"{option} must be one of {', '.join(map(str, known))}; got {value!r}"
                raise InputError(message)
            chosen: Any = tuple(family for family in FITS if many and family in value)
            value = chosen if many else known[known.index(value)]
        elif option in _RANGES:
            low, high, unit = _RANGES[option]
            automatic = value is None and option == "exposure"
            if not (automatic or low <= value <= high):
                message = f"{option} must be from {low:g} to {high:g} {unit}, got {value}"
                raise InputError(message)
        elif option == "limits":
            value = None if value is None else tuple(map(float, value))
            if value is not None and not (len(value) == 2 and value[0] < value[1] < math.inf):
                message = f"limits must be two numbers, the smaller first, got {value}"
                raise InputError(message)
        elif option == "brush":
            value = _checked_brush(value)
        elif option != "map" or not set(value) <= _MAP_CHARACTERS:
            message = f"there is no option {option!r} with the value {value!r}"
            raise InputError(message)
        return replace(self, **{option: value})

    @property
    def overlay(self) -> str:
        """Name of the map that is shown: that of the brush, if there is one."""
        return self.map if self.brush is None else BRUSHED

    def of_results(self) -> View:
        """Return the view without what changes the image, but not the results of the selection."""
        return replace(self, **{name: getattr(_DEFAULT, name) for name in LOOKS})

    def of_samples(self, spp: int) -> View:
        """Lower N to the largest number that so many samples allow.

        Examples
        --------
        >>> View(batch=32).of_samples(64).batch
        16
        """
        allowed = [n for n in BATCH_SIZES if n <= min(self.batch, spp // BATCHES)]
        return replace(self, batch=max(allowed, default=1))

    def of_images(self, count: int) -> tuple[int, int]:
        """Return the indices of the shown image and of the one to compare with, of `count` images.

        Examples
        --------
        >>> View().of_images(3), View(shown=5, reference=1).of_images(3)
        ((0, 2), (2, 1))
        """
        last = count - 1
        return min(self.shown, last), last if self.reference is None else min(self.reference, last)

    def query(self) -> str:
        """Return the part of the address after '?', without default values."""
        pairs: list[tuple[str, object]] = [("p", f"{y},{x}") for y, x in self.pixels]
        if self.pixels and self.active != len(self.pixels) - 1:
            pairs.append(("a", self.active))
        if self.region is not None:
            pairs.append(("r", ",".join(map(str, self.region))))
        for key, (name, _) in _OPTIONS.items():
            value = getattr(self, name)
            if value != getattr(_DEFAULT, name):
                text = value
                if isinstance(value, tuple):
                    text = ",".join("" if v is None else str(v) for v in value)
                pairs.append((key, text))
        return urlencode(pairs)


def row_of(channel: str, names: Sequence[str]) -> int:
    """Return the row of a pixel, of these names, that a channel of a view stands for.

    That is luminance for "all" of several pixels.

    Examples
    --------
    >>> [row_of(channel, ("R", "G", "B", "luminance")) for channel in ("all", "luminance", "1")]
    [3, 3, 1]
    """
    last = len(names) - 1
    return last if channel in ("all", "luminance") else min(int(channel), max(0, last - 1))


def channel_name(channel: str, channels: Sequence[str]) -> str:
    """Return the name of the channel that a brush counts by: luminance for "all" of three."""
    names = (*channels, "luminance") if len(channels) > 1 else channels
    return names[row_of(channel, names)]


def box_between(
    one: tuple[float, float], other: tuple[float, float], height: int, width: int
) -> Box:
    """Return the pixels that a drawn box touches, from two opposite corners (y, x).

    Raises
    ------
    InputError
        If it is outside the image.

    Examples
    --------
    >>> box_between((3.2, 9.9), (0.5, -4.0), 8, 8)
    (0, 0, 4, 8)
    """
    (top, bottom), (left, right) = (sorted(pair) for pair in zip(one, other, strict=True))
    y0, y1 = math.floor(max(top, 0)), math.ceil(min(bottom, height))
    x0, x1 = math.floor(max(left, 0)), math.ceil(min(right, width))
    if y0 >= y1 or x0 >= x1:
        message = "the box is outside the image; the selection stays"
        raise InputError(message)
    return y0, x0, y1, x1


def check_sources(sources: Sequence[object]) -> None:
    """Check that there is at least one image, and no more than there are keys.

    Raises
    ------
    InputError
        If there are none, or too many.
    """
    if not 1 <= len(sources) <= _MOST_IMAGES:
        message = (
            f"the explorer shows from 1 to {_MOST_IMAGES} stores or images, got {len(sources)}"
        )
        raise InputError(message)


def check_pixel(y: int, x: int, height: int, width: int) -> None:
    """Refuse a pixel outside the image.

    Raises
    ------
    InputError
        If it is.
    """
    if not (0 <= y < height and 0 <= x < width):
        message = f"pixel (y={y}, x={x}) is outside the image of {width} x {height} pixels"
        raise InputError(message)


def _checked_brush(value: Any) -> Brush | None:
    if value is None or value == NULLS:
        return None if value is None else NULLS
    ends = tuple(None if v is None else float(v) for v in value)
    numbers = [v for v in ends if v is not None]
    if (
        len(ends) == 2
        and numbers
        and all(map(math.isfinite, numbers))
        and numbers[0] <= numbers[-1]
    ):
        return ends
    message = (
        "a range of radiance must be two numbers, the smaller first, of which one may be left out, "
        f"or {NULLS!r} for the null samples; got "
        + ",".join("" if v is None else f"{v:g}" for v in ends)
    )
    raise InputError(message)


def _brush(text: str) -> Any:
    if text == NULLS:
        return text
    parts = text.split(",")
    return [_numbers(p, "a range of radiance must be numbers")[0] if p else None for p in parts]


def _integers(text: str, count: int) -> tuple[int, ...]:
    parts = text.split(",")
    if len(parts) != count or not all(re.fullmatch(r"\s*[0-9]{1,9}\s*", p) for p in parts):
        message = f"expected {count} whole number(s) of at most 9 digits, got {text!r}"
        raise InputError(message)
    return tuple(int(p) for p in parts)


def _numbers(text: str, what: str) -> tuple[float, ...]:
    try:
        return tuple(map(float, text.split(",")))
    except ValueError:
        message = f"{what}, got {text!r}"
        raise InputError(message) from None


_DEFAULT = View()
_OPTIONS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "map": ("map", str),
    "lim": ("limits", lambda text: _numbers(text, "limits must be numbers")),
    "cm": ("cmap", str),
    "cs": ("signed", str),
    "b": ("brush", _brush),
    "c": ("channel", str),
    "f": ("families", lambda text: tuple(part for part in text.split(",") if part)),
    "n": ("batch", lambda text: _integers(text, 1)[0]),
    "ev": ("exposure", lambda text: _numbers(text, "exposure must be a number of stops")[0]),
    "tone": ("tone", str),
    "g": ("gamma", lambda text: _numbers(text, "gamma must be a number")[0]),
    "i": ("shown", lambda text: _integers(text, 1)[0]),
    "ref": ("reference", lambda text: _integers(text, 1)[0]),
}
"""Options by name in an address, and how their text is read."""


def parse_view(
    arguments: Mapping[str, Sequence[str]], height: int, width: int
) -> tuple[View, list[str]]:
    """Return the view of an address, and notes on its invalid parts.

    Parameters
    ----------
    arguments
        The values of each name in the query.
    height, width
        Size of the image in pixels.

    Examples
    --------
    >>> parse_view({"p": ["1,2", "99,2"], "n": ["64"]}, 8, 8)[1]
    ['pixel (y=99, x=2) is outside the image of 8 x 8 pixels']
    """
    view, notes = View(), list[str]()
    keys = ("p", "r", "a", *_OPTIONS)
    for key in keys:
        texts = arguments.get(key, ())
        for text in texts if key == "p" else texts[:1]:
            try:
                view = _followed(view, key, text, height, width)
            except InputError as error:
                notes.append(str(error))
    # Zoom, opacity of maps and side-by-side display are handled by the page itself.
    unknown = sorted(arguments.keys() - {*keys, "z", "o", "side"})
    notes += [f"the address has {name!r}, which means nothing here" for name in unknown]
    return view, notes


def _followed(view: View, key: str, text: str, height: int, width: int) -> View:
    """Return the view after one part of an address."""
    if key == "p":
        y, x = _integers(text, 2)
        check_pixel(y, x, height, width)
        return view if (y, x) in view.pixels else view.pick(y, x, add=True)
    if key == "r":
        top, left, bottom, right = _integers(text, 4)
        if not (0 <= top < bottom <= height and 0 <= left < right <= width):
            message = f"region {text} is not inside the image of {width} x {height} pixels"
            raise InputError(message)
        return view.box((top, left, bottom, right))
    if key == "a":
        return view.activate(_integers(text, 1)[0])
    option, read = _OPTIONS[key]
    return view.changed(option, read(text))
