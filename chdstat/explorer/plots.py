"""Plots: the table of panels, what each of them draws, and their Bokeh figures.

One place shows its channels, several places show luminance or one channel, each in its colour.
Colours contrast with the dark ground, and those of `LIGHT` with the light one, by 4.5 to 1 or more
(WCAG 2.2, AA).

The ranges of the axes are computed here, since Bokeh's own data ranges send each of their changes
to the server, eighteen messages a click.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from bokeh import models
from bokeh.plotting import figure

from chdstat._core.arrays import Array
from chdstat.explorer.statistics import PlaceStatistics
from chdstat.explorer.view import View
from chdstat.fit.families import FAMILIES

__all__ = [
    "BLENDED",
    "CHANNEL_COLORS",
    "DASHES",
    "FAINT",
    "GROUND",
    "LIGHT",
    "PANELS",
    "PIXEL_COLORS",
    "TEXT",
    "PanelData",
    "PanelKind",
    "Series",
    "Trace",
    "encode_panels",
    "extent",
    "panel_plot",
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

    x: Array
    y: Array
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


# --- figures, and how what they draw travels to the page ----------------------------------------

GROUND = "#1c1e21"
TEXT = "#e8e9ea"
FAINT = "#b4b8bd"
_LINES = "#3a3e44"

# No more labels than there is room for, of one size: when an axis grows or shrinks, Bokeh lays the
# plot out anew and paints twice.
_LABEL = """
if (index % Math.ceil(ticks.length / most)) return "";
const largest = Math.max(...ticks.map(Math.abs));
const steps = ticks.slice(1).map((t, i) => Math.abs(t - ticks[i])).filter((d) => d > 0);
const digits = steps.length ? 1 + Math.ceil(Math.log10(largest / Math.min(...steps))) : 3;
const rounded = Number(tick.toPrecision(Math.min(Math.max(digits, 1), 9)));
const size = Math.abs(rounded), plain = size === 0 || (size >= 1e-3 && size < 1e5);
const text = plain ? String(rounded) : rounded.toExponential().replace("+", "");
return text.replaceAll("-", "\\u2212").padStart(width, "\\u00a0");
"""
# Bokeh's own ticks of less than two decades are evenly spaced: all of them at the upper end.
_LOG_TICKS = """
const low = Math.min(cb_data.start, cb_data.end), high = Math.max(cb_data.start, cb_data.end);
if (!(low > 0 && high < Infinity)) return [];
const span = Math.log10(high / low);
const { inner_width: width, inner_height: height } = plot.properties;
const room = width.is_unset ? few : across ? width.get_value() / 6.4 : height.get_value() / 16;
const size = (tick) => across ? 1 + Math.min(String(tick).length, longest) : 1;
const apart = (ticks) => ticks.slice(1).every((tick, i) =>
  Math.log10(tick / ticks[i]) / span * room >= Math.max(size(tick), size(ticks[i])));
const decades = (mantissas, every) => {
  const ticks = [];
  for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++)
    if (k % every === 0) ticks.push(...mantissas.map((m) => Number(`${m}e${k}`)));
  return ticks.filter((tick) => low <= tick && tick <= high);
};
let ticks = decades([1, 2, 5], 1);
if (ticks.length < few) {
  const widest = (high - low) / few, unit = 10 ** Math.floor(Math.log10(widest));
  const step = unit * [5, 2, 1].find((m) => m * unit <= widest);
  ticks = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) ticks.push(i * step);
  return apart(ticks) ? ticks : ticks.filter((_, i) => i % 2 === 0);
}
if (!apart(ticks)) ticks = decades([1, 3], 1);
for (const every of [1, 2, 5, 10, 20, 50, 100, 200, 500])
  if (!apart(ticks)) ticks = decades([1], every);
return ticks;
"""
_FEW = 3
"""Labels that a logarithmic axis has at least."""
_LONGEST = 6
"""Characters of a label of a logarithmic axis, such as 0.0015; longer ones become 1e-4."""
_LETTERS = 42
"""Characters that there is room for at most along a horizontal axis."""
_LABEL_WIDTH = 7
"""Characters of the labels of a vertical axis."""


def panel_plot(name: str) -> tuple[Any, list[models.Model]]:
    """Return a plot of areas, lines, vertical marks and labels, and what the shell fills of it.

    That is: the sources of these four, the ranges across and up, axes, grids, and the plot.
    """
    kind = PANELS[name]
    ranges = models.Range1d(0.1, 1), models.Range1d(0.1, 1)
    plot: Any = figure(
        name=name,
        x_axis_type=kind.x_scale,
        y_axis_type=kind.y_scale,
        x_range=ranges[0],
        y_range=ranges[1],
        x_axis_label=kind.x,
        y_axis_label=kind.y,
        tools="",
        toolbar_location=None,
        sizing_mode="stretch_both",
        min_border_left=52,
        min_border_right=20,
        min_border_top=4,
        background_fill_color=GROUND,
        border_fill_color=None,
        outline_line_color=_LINES,
    )
    _style(plot)
    columns = (
        ("xs", "ys", "color"),
        ("xs", "ys", "color", "dash", "width"),
        ("x", "low", "high", "color"),
        ("x", "y", "text", "color", "align", "offset"),
    )
    sources = [models.ColumnDataSource({name: [] for name in names}) for names in columns]
    areas, lines, marks, texts = sources
    plot.patches("xs", "ys", source=areas, color="color", fill_alpha=0.2, line_alpha=0)
    plot.multi_line(
        "xs", "ys", source=lines, line_color="color", line_dash="dash", line_width="width"
    )
    plot.segment(
        "x", "low", "x", "high", source=marks, line_color="color", line_dash="dashed",
        line_alpha=0.9,
    )  # fmt: skip
    plot.text(
        "x", "y", "text", source=texts, text_color="color", text_align="align", x_offset="offset",
        text_font_size="11px", y_offset=-1,
    )  # fmt: skip
    return plot, [*sources, *ranges, plot.xaxis[0], plot.yaxis[0], *plot.grid, plot]


def _style(plot: Any) -> None:
    plot.grid.grid_line_color = "#2c2f34"
    for axes, ticks, args in (
        (plot.xaxis, 5, {"width": 0, "most": 6}),
        (plot.yaxis, 4, {"width": _LABEL_WIDTH, "most": 8}),
    ):
        for axis in axes:
            axis.update(
                formatter=models.CustomJSTickFormatter(code=_LABEL, args=args),
                axis_label_text_color=FAINT,
                axis_label_text_font_size="11px",
                axis_label_text_font_style="normal",
                axis_label_standoff=2,
                major_label_text_color=TEXT,
                major_label_text_font="monospace",
                major_label_text_font_size="10.5px",
                major_tick_line_color=FAINT,
                minor_tick_line_color=None,
                axis_line_color=_LINES,
            )
            axis.ticker.desired_num_ticks = ticks
            if isinstance(axis, models.LogAxis):
                across = axis in plot.xaxis
                args = {"across": across, "plot": plot, "few": _FEW, "longest": _LONGEST}
                axis.ticker = models.CustomJSTicker(major_code=_LOG_TICKS, args=args)
                axis.formatter.args |= {"most": _LETTERS}


def encode_panels(panels: Mapping[str, PanelData]) -> dict[str, Any]:
    """Return panels as one piece of text: a hundred small arrays would be as many messages.

    All numbers are one array of float64 in base64; traces say how many of them are theirs, x before
    y.
    """
    numbers: list[npt.NDArray[np.float64]] = []

    def packed(traces: Sequence[Trace]) -> list[dict[str, Any]]:
        for trace in traces:
            numbers.extend((np.asarray(trace.x, np.float64), np.asarray(trace.y, np.float64)))
        return [{"n": len(t.x), "color": t.color, "dash": t.dash, "width": t.width} for t in traces]

    found = {}
    for name, panel in panels.items():
        (left, right), (bottom, top) = shown = extent(name, panel) or ((0, 1), (0, 1))
        ends = {"left": (left, 4), "right": (right, -4)}
        marks = [
            (x, bottom if low is None else low, top if high is None else high, color)
            for x, low, high, color in panel.marks
        ]
        texts = [
            (ends[side][0], y, text, color, side, ends[side][1])
            for side, y, text, color in panel.texts
        ]
        found[name] = {
            "areas": packed(panel.areas),
            "lines": packed(panel.lines),
            "marks": _columns(("x", "low", "high", "color"), marks),
            "texts": _columns(("x", "y", "text", "color", "align", "offset"), texts),
            "extent": shown,
            "rows": panel.rows > 0,
            "own_x": panel.own_x,
            "y": panel.y or PANELS[name].y,
        }
    whole = np.concatenate(numbers) if numbers else np.empty(0)
    return {"panels": found, "numbers": base64.b64encode(whole.tobytes()).decode("ascii")}


def _columns(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> dict[str, list[Any]]:
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


_MARGIN = 0.04
_NUMBERS, _LABELS, _BELOW = 0.06, 0.36, 0.15
"""Room for the numbers of rows and for their labels, of the room for the densities, and below."""
_TINY = 1e-300


def extent(name: str, panel: PanelData) -> tuple[Extent, Extent] | None:
    """Return what a panel shows across and up: all that it draws, and a margin; None for nothing.

    Examples
    --------
    >>> line = Trace(np.array([0.0, 10.0]), np.array([1.0, 2.0]), "#ffffff")
    >>> extent("linear", PanelData(lines=[line]))
    ((-0.4, 10.4), (0.0, 2.08))
    """
    kind, traces = PANELS[name], (*panel.areas, *panel.lines)
    marks = np.array([mark[0] for mark in panel.marks])
    across = _span([*(t.x for t in traces), marks], kind.x_scale)
    up = _span([t.y for t in traces], kind.y_scale)
    if across is None or up is None:
        return None
    if panel.own_x:
        return (-_NUMBERS, 1 + _LABELS), (-_BELOW, panel.rows)
    if panel.rows:  # room for labels at both sides
        low, high = np.log10(_padded(across, "log"))
        ends = low - _NUMBERS * (high - low), high + _LABELS * (high - low) / 2
        return (float(10.0 ** ends[0]), float(10.0 ** ends[1])), (-_BELOW, panel.rows)
    vertical = (0.0, up[1] * (1 + _MARGIN)) if kind.from_zero else _padded(up, kind.y_scale)
    return _padded(across, kind.x_scale), vertical


def _span(parts: Iterable[npt.ArrayLike], scale: str) -> Extent | None:
    whole = np.concatenate([np.empty(0), *(np.asarray(part, np.float64) for part in parts)])
    shown = whole[np.isfinite(whole) & ((whole > _TINY) if scale == "log" else True)]
    return (float(shown.min()), float(shown.max())) if shown.size else None


def _padded(span: Extent, scale: str) -> Extent:
    """Return a span with a margin; one value alone gets a tenth, or a factor of two, around it."""
    low, high = np.log10(span) if scale == "log" else span
    alone = np.log10(2) if scale == "log" else 0.1 * abs(low) or 1.0
    margin = _MARGIN * (high - low) if high > low else alone
    ends = np.array([low - margin, high + margin])
    start, end = 10.0**ends if scale == "log" else ends
    return float(start), float(end)
