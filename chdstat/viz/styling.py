"""Style: one look for all figures, as a context that leaves the user's settings alone.

What users have named is drawn as they wrote it, in fonts that have its letters: `verbatim` is for
every name that is not the library's own, `families` has the fonts, and `spelt` goes around what
saves figures.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import re
import warnings
from collections.abc import Iterator
from typing import Any

import matplotlib as mpl
from matplotlib import colormaps, font_manager
from matplotlib.colors import Colormap, to_hex, to_rgb

__all__ = [
    "CHANNELS",
    "HEIGHT",
    "MISSING",
    "PALETTE",
    "WIDTH",
    "families",
    "qualitative",
    "sequential",
    "spelt",
    "style",
    "verbatim",
]

WIDTH = 6.7
"""Width of a figure that fills the text of an A4 page, in inches."""

HEIGHT = 8.0
"""What leaves room on that page for a heading and a caption."""

PALETTE = (
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#CC79A7",
    "#0072B2",
    "#D55E00",
    "#F0E442",
    "#7F7F7F",
)
"""Eight colours that colour-blind readers tell apart (Okabe and Ito 2008), grey for black."""

MISSING = "#DDDDDD"
"""Colour of pixels without a number."""

CHANNELS = {"R": "#C8423B", "G": "#2F9E62", "B": "#3B6FC9"}
"""Colours of the radiance channels; they differ in lightness too."""

_SETTINGS: dict[Any, Any] = {
    "axes.edgecolor": "#444444",
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 8.5,
    "figure.dpi": 110,
    "figure.facecolor": "white",
    "font.size": 8,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "mathtext.fontset": "stix",
    "savefig.dpi": 200,
    "svg.fonttype": "path",
    "svg.hashsalt": "chdstat",
    "xtick.color": "#444444",
    "xtick.labelsize": 7,
    "xtick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.color": "#444444",
    "ytick.labelsize": 7,
    "ytick.major.width": 0.6,
    "ytick.minor.width": 0.4,
}


@contextlib.contextmanager
def style() -> Iterator[None]:
    """Apply the style of chdstat's figures while the context lasts.

    Examples
    --------
    >>> import matplotlib as mpl
    >>> from chdstat.viz import style
    >>> before = mpl.rcParams["font.size"]
    >>> with style():
    ...     mpl.rcParams["font.size"]
    8.0
    >>> mpl.rcParams["font.size"] == before
    True
    """
    with mpl.rc_context(_SETTINGS | {"font.family": list(families())}):
        yield


def qualitative(number: int) -> list[str]:
    """Return colours for labels: those of `PALETTE`, then darker ones, then all of them again.

    Examples
    --------
    >>> len(set(qualitative(16)))
    16
    """
    colors = [*PALETTE, *(_darker(color) for color in PALETTE)]
    return [colors[i % len(colors)] for i in range(number)]


def _darker(color: str) -> str:
    red, green, blue = (0.55 * part for part in to_rgb(color))
    return to_hex((red, green, blue))


def sequential() -> Colormap:
    """Return the colour map of magnitudes; pixels without a number are light grey."""
    return colormaps["viridis"].with_extremes(bad=MISSING)


_log = logging.getLogger("chdstat")

_LATIN = ("STIXGeneral", "DejaVu Serif")
"""Matplotlib brings them along."""
_EAST_ASIAN = (
    "Noto Serif CJK SC",
    "Noto Serif CJK JP",
    "Noto Sans CJK SC",
    "Noto Sans CJK JP",
    "Source Han Serif SC",
    "Source Han Sans SC",
    "IPAexMincho",
    "IPAMincho",
    "AR PL UMing CN",
    "WenQuanYi Zen Hei",
    "WenQuanYi Micro Hei",
    "NanumMyeongjo",
    "Droid Sans Fallback",
    "Songti SC",
    "Hiragino Mincho ProN",
    "Apple SD Gothic Neo",
    "Arial Unicode MS",
    "SimSun",
    "Yu Mincho",
    "MS Gothic",
    "Malgun Gothic",
)
"""What Linux, macOS and Windows have for Chinese, Japanese and Korean."""
_SHOWN = 10
_MISSING = re.compile(r"Glyph (\d+) .*missing from")


def verbatim(text: str) -> str:
    r"""Return what makes Matplotlib draw a text as it is: a dollar sign begins no formula.

    Examples
    --------
    >>> print(verbatim("a $x^$ b"))
    a \$x^\$ b
    """
    return text.replace("$", r"\$")


@functools.cache
def families() -> tuple[str, ...]:
    """Return families of fonts that this machine has; a later one has what those before lack."""
    known = set(font_manager.get_font_names())
    return (*_LATIN, *(name for name in _EAST_ASIAN if name in known))


@contextlib.contextmanager
def spelt() -> Iterator[None]:
    """Log in one line which letters no font has, where Matplotlib warns of each and each time."""
    with _silent_fonts(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    letters: dict[str, None] = {}
    for warning in caught:
        if found := _MISSING.match(str(warning.message)):
            letters[chr(int(found[1]))] = None
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    if letters:
        _log.warning(
            "no font has the letters %s: boxes stand in their place. Install one that has, such as "
            "Noto Serif CJK for Chinese, Japanese and Korean, and delete Matplotlib's list of "
            "fonts in %s",
            " ".join([*letters][:_SHOWN]) + " …" * (len(letters) > _SHOWN),
            mpl.get_cachedir(),
        )


@contextlib.contextmanager
def _silent_fonts() -> Iterator[None]:
    """Keep quiet about fonts that have no bold letters: their plain ones are drawn."""
    log = logging.getLogger(font_manager.__name__)
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)
