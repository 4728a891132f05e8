"""Traces: the table of panels, and the lines, areas and labels that each of them draws.

One place shows its channels, several places show luminance or one channel, each in its colour.
Colours contrast with the dark ground, and those of `LIGHT` with the light one, by 4.5 to 1 or more
(WCAG 2.2, AA).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Literal

import numpy.typing as npt

from chdstat.explorer.statistics import PlaceStatistics
from chdstat.explorer.view import View
from chdstat.fit.families import FAMILIES

__all__ = [
    "BLENDED",
    "CHANNEL_COLORS",
    "DASHES",
    "LIGHT",
    "PANELS",
    "PIXEL_COLORS",
    "PanelData",
    "PanelKind",
    "Series",
    "Trace",
    "series_of",
]

BLENDED = "#d0d3d6"
"""Luminance, and whatever is no channel."""
CHANNEL_COLORS = {"R": "#ff7b72", "G": "#56d18b", "B": "#79b8ff"}
PIXEL_COLORS = ("#f0b429", "#62c4f5", "#3fd0a4", "#e39ac8", "#f4ea5c", "#ff8f5e")
"""After Okabe and Ito (2008), lightened: colour-blind readers tell them apart."""
LIGHT = {
    BLENDED: "#4a4f55",
    **dict(zip(CHANNEL_COLORS.values(), ("#b3261e", "#0f7039", "#1257b0"), strict=True)),
    **dict(
        zip(
            PIXEL_COLORS,
            ("#855700", "#0a6390", "#006b56", "#9a3577", "#655f00", "#a83e0b"),
            strict=True,
        )
    ),
}
"""What these colours are on a light ground."""
_PATTERNS = ("solid", "6 6", "2 4 6 4", "2 4", "12 4", "6 4 2 4 2 4", "12 4 2 4")
DASHES = {**dict(zip(FAMILIES, cycle(_PATTERNS), strict=False)), "mixture": "6 4 2 4"}
"""Line dashes of fits by name: lengths of lines and gaps, as Bokeh and SVG read them."""

Floats = npt.NDArray[Any]
Scale = Literal["linear", "log"]
Extent = tuple[float, float]


@dataclass(frozen=True)
class PanelKind:
    """A row of `PANELS`.

    Attributes
    ----------
    title, x, y
        Text above the panel and along its axes.
    x_scale, y_scale
        Scales of the axes.
    from_zero
        Whether it stands on the axis, as densities do.
    """

    title: str
    x: str
    y: str
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"
    from_zero: bool = False


PANELS = {
    "linear": PanelKind("Linear histogram", "radiance", "density", from_zero=True),
    "log": PanelKind("Log10 histogram", "radiance", "density per decade", "log", from_zero=True),
    "qq": PanelKind("Quantiles", "quantiles of the family", "of the samples", "log", "log"),
    "running": PanelKind("Running mean", "spp", "radiance", "log"),
    "averages": PanelKind("Averages of N samples", "radiance", "density", from_zero=True),
}


@dataclass(frozen=True)
class Trace:
    """A line, or the outline of an area.

    Attributes
    ----------
    x, y
        Vertices, shape (point,).
    color
        As "#rrggbb".
    dash
        Line dash in Bokeh's words.
    width
        In screen pixels.
    """

    x: Floats
    y: Floats
    color: str
    dash: str = "solid"
    width: float = 1.3


@dataclass(frozen=True)
class PanelData:
    """What one panel draws.

    Attributes
    ----------
    areas, lines
        Filled and drawn.
    marks
        x, lower and upper end, and colour of vertical lines; they span the panel where the ends
        are None.
    texts
        Side ("left" or "right"), y, text and colour of labels inside the panel.
    notes
        Text beside the title.
    rows
        How many pixels stand above each other, each over its own peak; 0 for one common axis.
    own_x
        Whether each of the rows has its own range of x, which a label states.
    y
        Label of the vertical axis, where it is not that of the panel's kind.
    """

    areas: Sequence[Trace] = ()
    lines: Sequence[Trace] = ()
    marks: Sequence[tuple[float, float | None, float | None, str]] = ()
    texts: Sequence[tuple[str, float, str, str]] = ()
    notes: Sequence[str] = ()
    rows: int = 0
    own_x: bool = False
    y: str = ""


@dataclass(frozen=True)
class Series:
    """One row of samples that panels show.

    Attributes
    ----------
    place, row
        Where it comes from.
    color
        Of the channel or of the pixel.
    name
        As in the legend.
    other
        Whether it belongs to the store that is compared with: drawn as dashed outlines.
    pixel
        Number of the pixel, from 1, where there are several; else 0.
    """

    place: PlaceStatistics
    row: int
    color: str
    name: str
    other: bool
    pixel: int = 0

    @property
    def dash(self) -> str:
        """Dash of its lines."""
        return "dashed" if self.other else "solid"

    @property
    def constant(self) -> float | None:
        """Value of samples that are nearly equal, None where they are not."""
        if not self.place.constant[self.row]:
            return None
        return float(self.place.moments.maximum[self.row])


def series_of(
    view: View, places: Sequence[PlaceStatistics], others: Sequence[PlaceStatistics] = ()
) -> list[Series]:
    """Return what the panels show of the selected places, those of a second store beside them."""
    found = []
    several = len(places) > 1
    for is_other, group in ((False, places), (True, others)):
        for i, place in enumerate(group):
            rows = [place.row("luminance" if view.channel == "all" else view.channel)]
            if view.channel == "all" and not several:
                rows = list(range(len(place.channels)))
            for row in rows:
                name, color = f"pixel {i + 1}", PIXEL_COLORS[i]
                if not several:
                    name = place.names[row]
                    color = CHANNEL_COLORS.get(name, BLENDED)
                found.append(Series(place, row, color, name, is_other, (i + 1) * several))
    return found
