"""Plots: the Bokeh figures of a page: images that are linked, and panels that the page fills."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bokeh.models import (
    BoxSelectTool,
    ColumnDataSource,
    CustomJSTicker,
    CustomJSTickFormatter,
    ImageRGBA,
    LinearColorMapper,
    LogAxis,
    PanTool,
    Range1d,
    WheelZoomTool,
)
from bokeh.plotting import figure

from chdstat.explorer.palette import FAINT, GROUND, LINES, MAP_MISSING, TEXT, ramp
from chdstat.explorer.panels import LOG_X, LOG_Y

__all__ = ["ImagePlot", "Linked", "PanelPlot"]

_AXES = {
    "linear": ("radiance", "density"),
    "log": ("radiance", "density per decade"),
    "qq": ("quantiles of the family", "of the samples"),
    "running": ("spp", "radiance"),
    "averages": ("radiance", "density"),
}

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
for (let every = 1; !apart(ticks); every++) ticks = decades([1], every);
return ticks;
"""
_FEW = 3
"""Labels that a logarithmic axis has at least."""
_LONGEST = 6
"""Characters of a label of a logarithmic axis, such as 0.0015; longer ones become 1e-4."""
_LETTERS, _ROWS = 42, 10
"""What there is room for along a horizontal and a vertical axis."""
_LABEL_WIDTH = 7
"""Characters of the labels of a vertical axis."""


@dataclass(frozen=True)
class Linked:
    """What all images of a page have in common.

    Attributes
    ----------
    x_range, y_range
        The part of the image that is shown.
    mapper
        Colours of a map.
    marks, region
        The selected pixels and the selected box.
    """

    x_range: Range1d
    y_range: Range1d
    mapper: LinearColorMapper
    marks: ColumnDataSource
    region: ColumnDataSource

    @classmethod
    def of(cls, height: int, width: int) -> Linked:
        """Show the whole image and no selection."""
        return cls(
            x_range=Range1d(0, width),
            y_range=Range1d(height, 0),
            mapper=LinearColorMapper(palette=list(ramp()), nan_color=MAP_MISSING),
            marks=ColumnDataSource({"x": [], "y": [], "color": [], "text": []}),
            region=ColumnDataSource({"left": [], "right": [], "top": [], "bottom": []}),
        )


class ImagePlot:
    """One image with its map and its marks.

    Parameters
    ----------
    name
        Of the figure, for the template.
    size
        (height, width) of the image in pixels.
    linked
        What it has in common with other images.
    """

    def __init__(self, name: str, size: tuple[int, int], linked: Linked) -> None:
        height, width = size
        self.pan, self.box, wheel = PanTool(), BoxSelectTool(renderers=[]), WheelZoomTool()
        self.figure: Any = figure(
            name=name,
            x_range=linked.x_range,
            y_range=linked.y_range,
            tools=[self.pan, self.box, wheel],
            active_drag=self.pan,
            active_scroll=wheel,
            toolbar_location=None,
            sizing_mode="stretch_both",
            min_border=0,
            outline_line_color=None,
            background_fill_color="#000000",
            border_fill_color="#000000",
        )
        self.figure.axis.visible = False
        self.figure.grid.visible = False
        place = {"x": 0, "y": 0, "dw": width, "dh": height}
        self.source = ColumnDataSource({"image": []})
        self.figure.add_glyph(self.source, ImageRGBA(image="image", **place))
        self.map_source = ColumnDataSource({"image": []})
        self.map = self.figure.image(
            image="image", source=self.map_source, color_mapper=linked.mapper, **place
        )
        self.map.visible = False
        self._mark(linked)

    def _mark(self, linked: Linked) -> None:
        box = {"left": "left", "right": "right", "top": "top", "bottom": "bottom"}
        for color, line in (("#000000", 4), (TEXT, 1.6)):
            self.figure.quad(
                **box, source=linked.region, fill_alpha=0, line_color=color, line_width=line
            )
        pixel = {"x": "x", "y": "y", "width": 1, "height": 1}
        for color, line in (("#000000", 3.5), ("color", 1.5)):
            self.figure.rect(
                **pixel, source=linked.marks, fill_alpha=0, line_color=color, line_width=line
            )
            self.figure.scatter(
                "x", "y", source=linked.marks, size=15, fill_alpha=0, line_color=color,
                line_width=line, marker="circle",
            )  # fmt: skip
        self.figure.text(
            "x", "y", "text", source=linked.marks, x_offset=9, y_offset=-7, text_color="color",
            text_font_size="13px", text_font_style="bold", background_fill_color="#000000",
            background_fill_alpha=0.75,
            padding=1,
        )  # fmt: skip


class PanelPlot:
    """A plot with areas, lines and vertical marks, whatever they mean; by the name of its panel."""

    def __init__(self, name: str) -> None:
        across, up = _AXES[name]
        self._ranges = Range1d(0.1, 1), Range1d(0.1, 1)
        self.figure: Any = figure(
            name=name,
            x_axis_type="log" if name in LOG_X else "linear",
            y_axis_type="log" if name in LOG_Y else "linear",
            x_range=self._ranges[0],
            y_range=self._ranges[1],
            x_axis_label=across,
            y_axis_label=up,
            tools="",
            toolbar_location=None,
            sizing_mode="stretch_both",
            min_border_left=52,
            min_border_right=20,
            min_border_top=4,
            background_fill_color=GROUND,
            border_fill_color=GROUND,
            outline_line_color=LINES,
        )
        self._style()
        nothing: dict[str, list[Any]] = {name: [] for name in ("xs", "ys", "color")}
        self._areas = ColumnDataSource(nothing)
        self._lines = ColumnDataSource({**nothing, "dash": [], "width": []})
        self._marks = ColumnDataSource({"x": [], "color": []})
        self.figure.patches(
            "xs", "ys", source=self._areas, color="color", fill_alpha=0.2, line_alpha=0
        )
        self.figure.multi_line(
            "xs", "ys", source=self._lines, line_color="color", line_dash="dash", line_width="width"
        )
        self.figure.vspan(
            x="x", source=self._marks, line_color="color", line_dash="dashed", line_alpha=0.9
        )

    def _style(self) -> None:
        for axis in self.figure.axis:
            axis.update(
                formatter=CustomJSTickFormatter(code=_LABEL),
                axis_label_text_color=FAINT,
                axis_label_text_font_size="11px",
                axis_label_text_font_style="normal",
                axis_label_standoff=2,
                major_label_text_color=TEXT,
                major_label_text_font="monospace",
                major_label_text_font_size="10.5px",
                major_tick_line_color=FAINT,
                minor_tick_line_color=None,
                axis_line_color=LINES,
            )
        self.figure.grid.grid_line_color = "#2c2f34"
        for axis in self.figure.xaxis:
            axis.ticker.desired_num_ticks = 5
            axis.formatter.args = {"width": 0, "most": 6}
        for axis in self.figure.yaxis:
            axis.ticker.desired_num_ticks = 4
            axis.formatter.args = {"width": _LABEL_WIDTH, "most": 8}
        for axis in self.figure.select(LogAxis):
            across = axis in self.figure.xaxis
            args = {"across": across, "room": _LETTERS if across else _ROWS}
            args |= {"few": _FEW, "longest": _LONGEST}
            axis.ticker = CustomJSTicker(major_code=_LOG_TICKS, args=args)
            axis.formatter.args |= {"most": _LETTERS}

    @property
    def filled(self) -> list[ColumnDataSource | Range1d]:
        """What the shell fills: areas, lines, marks, the extents across and up."""
        return [self._areas, self._lines, self._marks, *self._ranges]
