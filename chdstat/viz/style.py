"""Style: one look for all figures, as a context that leaves the user's settings alone."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import matplotlib as mpl
from matplotlib import colormaps
from matplotlib.colors import Colormap, to_hex, to_rgb

from chdstat.viz.lettering import families

__all__ = [
    "CHANNELS",
    "HEIGHT",
    "MISSING",
    "PALETTE",
    "WIDTH",
    "qualitative",
    "sequential",
    "style",
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
