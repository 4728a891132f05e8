"""Series: the rows of samples that panels show, in their colours, and what a panel is made of.

One place shows its channels, several show luminance (or one channel) in a colour each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy.typing as npt

from chdstat.explorer.measured import Measured
from chdstat.explorer.palette import BLENDED, CHANNEL_COLORS, PIXEL_COLORS
from chdstat.explorer.view import View

__all__ = ["Panel", "Series", "Trace", "series_of"]

Floats = npt.NDArray[Any]


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
    name
        What it shows.
    """

    x: Floats
    y: Floats
    color: str
    dash: str = "solid"
    width: float = 1.3
    name: str = ""


@dataclass(frozen=True)
class Panel:
    """What one panel draws.

    Attributes
    ----------
    areas, lines
        Filled and drawn.
    marks
        x and colour of vertical lines.
    notes
        What is said beside the title.
    """

    areas: Sequence[Trace] = ()
    lines: Sequence[Trace] = ()
    marks: Sequence[tuple[float, str]] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Series:
    """One row of samples that panels show.

    Attributes
    ----------
    measured, row
        Where it comes from.
    color
        Of the channel or of the pixel.
    name
        As in the legend.
    other
        Whether it belongs to the store that is compared with: drawn as dashed outlines.
    """

    measured: Measured
    row: int
    color: str
    name: str
    other: bool = field(default=False)


def series_of(
    view: View, places: Sequence[Measured], others: Sequence[Measured] = ()
) -> list[Series]:
    """Return what the panels show of the selected places, those of a second store beside them."""
    found = []
    for is_other, group in ((False, places), (True, others)):
        for i, place in enumerate(group):
            if len(places) == 1 and view.channel == "all":
                rows = range(len(place.channels))
                colors = [CHANNEL_COLORS.get(c, BLENDED) for c in place.channels]
            else:
                rows = range(
                    r := place.row("luminance" if view.channel == "all" else view.channel), r + 1
                )
                colors = [PIXEL_COLORS[i]] if len(places) > 1 else [_color_of_row(place, r)]
            found += [
                Series(place, row, color, _name(place, row, i, len(places)), is_other)
                for row, color in zip(rows, colors, strict=True)
            ]
    return found


def _color_of_row(place: Measured, row: int) -> str:
    return CHANNEL_COLORS.get(place.names[row], BLENDED)


def _name(place: Measured, row: int, index: int, count: int) -> str:
    return place.names[row] if count == 1 else f"pixel {index + 1}"
