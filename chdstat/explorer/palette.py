"""Palette: colours on the explorer's dark ground.

Those of channels, pixels and text contrast with `GROUND` by 4.5 to 1 or more (WCAG 2.2, AA).
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from itertools import cycle

from chdstat.fit.families import FAMILIES

__all__ = [
    "BLENDED",
    "CHANNEL_COLORS",
    "DASHES",
    "FAINT",
    "GROUND",
    "LINES",
    "MAP_MISSING",
    "PIXEL_COLORS",
    "TEXT",
    "contrast",
    "label_colors",
    "ramp",
]

GROUND = "#1c1e21"
TEXT = "#e8e9ea"
FAINT = "#b4b8bd"
LINES = "#3a3e44"
BLENDED = "#d0d3d6"
"""Luminance, and whatever is no channel."""
MAP_MISSING = "#000000"

_LABELS = (
    *("#f0b429", "#62c4f5", "#3fd0a4", "#e39ac8", "#f4ea5c", "#ff8f5e", "#2f6fb7", "#8a5a9e"),
    *("#8f9296", "#9c3b3b", "#5b7f2b", "#c8c9ca"),
)

CHANNEL_COLORS = {"R": "#ff7b72", "G": "#56d18b", "B": "#79b8ff"}
PIXEL_COLORS = ("#f0b429", "#62c4f5", "#3fd0a4", "#e39ac8", "#f4ea5c", "#ff8f5e")
"""After Okabe and Ito (2008), lightened: colour-blind readers tell them apart."""
_PATTERNS = ("solid", "6 6", "2 4 6 4", "2 4", "12 4", "6 4 2 4 2 4", "12 4 2 4")
DASHES = {**dict(zip(FAMILIES, cycle(_PATTERNS), strict=False)), "mixture": "6 4 2 4"}
"""Line dashes of fits by name: lengths of lines and gaps, as Bokeh and SVG read them."""


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of two colours (WCAG 2.2, relative luminance).

    Examples
    --------
    >>> round(contrast("#000000", "#ffffff"), 1)
    21.0
    """
    high, low = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@cache
def ramp() -> tuple[str, ...]:
    """Return 256 colours of magnitudes, dark to bright, distinct for the colour-blind: viridis."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return tuple(to_hex(color) for color in colormaps["viridis"](range(256)))


def label_colors(codes: Iterable[int], *, ordered: bool = False) -> list[str]:
    """Return a colour for each label code, in ascending order; those of `ramp` if they have one.

    Examples
    --------
    >>> label_colors([0, 1])
    ['#f0b429', '#62c4f5']
    """
    count = len(set(codes))
    if ordered:
        return [ramp()[255 * i // max(1, count - 1)] for i in range(count)]
    return [_LABELS[i % len(_LABELS)] for i in range(count)]


def _luminance(color: str) -> float:
    parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return sum(w * p for w, p in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
