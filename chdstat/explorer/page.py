"""The Bokeh document of a page: images that are linked, and panels that the page fills.

Bokeh draws and carries; the shell around the plots is the HTML page in ``web/``. Besides images
and panels, the document has two hidden text fields: the inbox receives what a person does, the
outbox what the shell is to show, both as JSON. Only the page's own thread may change a document;
other threads go through `Page.next`.
"""

from __future__ import annotations

import base64
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from functools import cache, partial
from importlib import resources
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from bokeh import models
from bokeh.core.templates import get_env
from bokeh.document import Document
from bokeh.plotting import figure

from chdstat.explorer.estimators import fixed
from chdstat.explorer.maps import IMAGES, MAPS, Map, ramp
from chdstat.explorer.panels import DASHES, PANELS, PanelData, Trace, extent
from chdstat.explorer.selection import EXPORTS
from chdstat.explorer.sources import Source, StoreSource
from chdstat.explorer.view import BATCH_SIZES, FITS
from chdstat.reporting.typst import NAMES

__all__ = ["FAINT", "GROUND", "TEXT", "Page", "colorbar", "encode_panels"]

T = TypeVar("T")

GROUND = "#1c1e21"
TEXT = "#e8e9ea"
FAINT = "#b4b8bd"
_LINES = "#3a3e44"
_MISSING = "#000000"
# A click soon after another, and one that is held for a while, are clicks as well.
_EVENTS = {
    "tap": "tap",
    "doubletap": "tap",
    "press": "press",
    "pressup": "pressup",
    "mousemove": "hover",
    "selectiongeometry": "box",
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


class Page:
    """The models of one document, and the way to them from other threads.

    Parameters
    ----------
    document
        Where the models go.
    source, other
        What the page shows; `other` beside it, or None.
    gone
        Called once, when the page turns out to be gone.

    Attributes
    ----------
    inbox, outbox
        Fields of what a person does, and of what the shell is to show.
    """

    def __init__(
        self, document: Document, source: Source, other: Source | None, gone: Callable[[], None]
    ) -> None:
        self._document, self._gone, self._closed = document, gone, False
        self._size, self._channels = source.size, source.channels
        self._titles = [shown.name for shown in (source, other) if shown is not None]
        self._numbers = itertools.count(1)
        with document.models.freeze():  # else, all models are gathered anew after each change
            self.inbox = models.TextInput(name="inbox", visible=False)
            self.outbox = models.TextInput(name="outbox", visible=False)
            # What all images have in common: what is in view, map colours, and the selection.
            height, width = self._size
            self._x_range, self._y_range = models.Range1d(0, width), models.Range1d(height, 0)
            self._mapper = models.LinearColorMapper(palette=list(ramp()), nan_color=_MISSING)
            self._marks, self._region = (
                models.ColumnDataSource({name: [] for name in names})
                for names in (("x", "y", "color", "text"), ("left", "right", "top", "bottom"))
            )
            self._images = [self._image(f"image{i}") for i in range(len(self._titles))]
            self._panels = {name: _panel(name) for name in PANELS}
            plots = [image["figure"] for image in self._images]
            plots += [panel for panel, _ in self._panels.values()]
            for root in (*plots, self.inbox, self.outbox):
                document.add_root(root)
            heading = " and ".join(self._titles)
            document.title = f"{heading} · chdstat"
            document.template = _template()
            variables = self._variables(in_store=isinstance(source, StoreSource))
            document.template_variables.update({"heading": heading, **variables})
            self._connect()
        document.on_session_destroyed(lambda _: self.close())

    def _image(self, name: str) -> dict[str, Any]:
        """Return the figure of an image, its tools, its sources and its map."""
        pan, box, wheel = (
            models.PanTool(),
            models.BoxSelectTool(renderers=[]),
            models.WheelZoomTool(),
        )
        plot: Any = figure(
            name=name,
            x_range=self._x_range,
            y_range=self._y_range,
            tools=[pan, box, wheel],
            active_drag=pan,
            active_scroll=wheel,
            toolbar_location=None,
            sizing_mode="stretch_both",
            min_border=0,
            outline_line_color=None,
            background_fill_color="#000000",
            border_fill_color="#000000",
        )
        plot.axis.visible = plot.grid.visible = False
        place = {"x": 0, "y": 0, "dw": self._size[1], "dh": self._size[0]}
        image, of_map = (models.ColumnDataSource({"image": []}) for _ in range(2))
        plot.add_glyph(image, models.ImageRGBA(image="image", **place))
        shown = plot.image(image="image", source=of_map, color_mapper=self._mapper, **place)
        shown.visible = False
        sides = {side: side for side in ("left", "right", "top", "bottom")}
        for color, line in (("#000000", 4), (TEXT, 1.6)):
            look = {"fill_alpha": 0, "line_color": color, "line_width": line}
            plot.quad(**sides, source=self._region, **look)
        for color, line in (("#000000", 3.5), ("color", 1.5)):
            look = {"fill_alpha": 0, "line_color": color, "line_width": line}
            plot.rect(x="x", y="y", width=1, height=1, source=self._marks, **look)
            plot.scatter("x", "y", source=self._marks, size=15, marker="circle", **look)
        plot.text(
            "x", "y", "text", source=self._marks, x_offset=9, y_offset=-7, text_color="color",
            text_font_size="13px", text_font_style="bold", background_fill_color="#000000",
            background_fill_alpha=0.75, padding=1,
        )  # fmt: skip
        return {"figure": plot, "pan": pan, "box": box, "source": image, "map": shown}

    def _connect(self) -> None:
        given: dict[str, Any] = {
            "inbox": self.inbox,
            "outbox": self.outbox,
            "radiance": self._images[0]["source"],
            "map": self._images[0]["map"].data_source,
            "x_range": self._x_range,
            "y_range": self._y_range,
            "pans": [image["pan"] for image in self._images],
            "boxes": [image["box"] for image in self._images],
            "marks": self._marks,
            "region": self._region,
            "panels": {name: filled for name, (_, filled) in self._panels.items()},
            "width": self._size[1],
            "height": self._size[0],
            "channels": list(self._channels),
        }
        code = f"window.chdstat.start({{{', '.join(given)}}})"
        self._document.js_on_event("document_ready", models.CustomJS(args=given, code=code))
        lost = models.CustomJS(code="window.chdstat.lost()")
        self._document.js_on_event("connection_lost", lost)
        for image, (event, call) in itertools.product(self._images, _EVENTS.items()):
            code = f"window.chdstat.{call}(cb_obj)"
            image["figure"].js_on_event(event, models.CustomJS(code=code))

    def _variables(self, *, in_store: bool) -> dict[str, Any]:
        """Return what the template of the shell is filled with."""
        channels = [(str(i), name) for i, name in enumerate(self._channels)]
        return {
            "style": _web("page.css"),
            "script": _web("page.js"),
            "aspect": self._size[1] / self._size[0],
            "exports": list(EXPORTS),
            "maps": [(k.name, k.title) for k in MAPS.values() if in_store or k.name in IMAGES],
            "errors": [(f"error:{n}", NAMES.get(n, n)) for n in fixed()] if in_store else [],
            "families": [(name, NAMES.get(name, name), DASHES.get(name)) for name in FITS],
            "channels": [*channels, ("luminance", "luminance")] if len(channels) > 1 else [],
            "batches": BATCH_SIZES,
            "titles": self._titles,
            "panel_titles": {name: kind.title for name, kind in PANELS.items()},
        }

    # --- what is shown --------------------------------------------------------------------------

    def send(self, *items: Mapping[str, Any]) -> None:
        """Send what the shell is to show."""
        self.outbox.value = json.dumps({"number": next(self._numbers), "items": items})

    def alert(self, text: str) -> None:
        """Send a message on what went wrong."""
        self.send({"kind": "alert", "text": text})

    def show_image(
        self, index: int, packed: npt.NDArray[np.uint32], mean: npt.NDArray[np.float32]
    ) -> None:
        """Show an image, packed RGBA (y, x), with the radiance (y, x, channel) to be read."""
        radiance = {
            name: [np.ascontiguousarray(mean[..., i], np.float32)]
            for i, name in enumerate(self._channels)
        }
        self._images[index]["source"].data = {"image": [packed], **radiance}

    def show_map(self, shown: Map | None) -> None:
        """Put a map in the place of the first image; None takes it away."""
        renderer = self._images[0]["map"]
        renderer.visible = shown is not None
        if shown is None:
            return
        palette, (low, high) = list(ramp()), shown.limits
        if shown.kind.names:
            palette = shown.colors
            low, high = min(shown.kind.names) - 0.5, max(shown.kind.names) + 0.5
        self._mapper.update(palette=palette, low=low, high=high)
        renderer.data_source.data = {"image": [np.ascontiguousarray(shown.values, np.float32)]}

    # --- other threads --------------------------------------------------------------------------

    def close(self) -> None:
        """Carry nothing more."""
        if not self._closed:
            self._closed = True
            self._gone()

    def next(self, callback: Callable[[], None], milliseconds: int | None = None) -> None:
        """Call something in the page's own thread, soon or after a while."""
        if self._closed:
            return
        try:
            if milliseconds is None:
                self._document.add_next_tick_callback(callback)
            else:
                self._document.add_timeout_callback(callback, milliseconds)
        except (RuntimeError, AttributeError):  # the page is gone, and its document dissolved
            self.close()

    def run(
        self, pool: Executor, work: Callable[[], T], finish: Callable[[Future[T]], None]
    ) -> None:
        """Work in another thread, then call `finish` with the result in the page's own."""

        def done(future: Future[T]) -> None:
            if not future.cancelled():
                self.next(partial(finish, future))

        with suppress(RuntimeError):  # the explorer is closing
            pool.submit(work).add_done_callback(done)


def _panel(name: str) -> tuple[Any, list[models.Model]]:
    """Return a plot with areas, lines and vertical marks, and what the shell fills of it.

    That is: areas, lines, marks, the ranges across and up.
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
        border_fill_color=GROUND,
        outline_line_color=_LINES,
    )
    _style(plot)
    columns = (("xs", "ys", "color"), ("xs", "ys", "color", "dash", "width"), ("x", "color"))
    areas, lines, marks = (
        models.ColumnDataSource({name: [] for name in names}) for names in columns
    )
    plot.patches("xs", "ys", source=areas, color="color", fill_alpha=0.2, line_alpha=0)
    plot.multi_line(
        "xs", "ys", source=lines, line_color="color", line_dash="dash", line_width="width"
    )
    plot.vspan(x="x", source=marks, line_color="color", line_dash="dashed", line_alpha=0.9)
    return plot, [areas, lines, marks, *ranges]


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
                room = {"room": _LETTERS if across else _ROWS, "few": _FEW, "longest": _LONGEST}
                axis.ticker = models.CustomJSTicker(
                    major_code=_LOG_TICKS, args={"across": across, **room}
                )
                axis.formatter.args |= {"most": _LETTERS}


@cache
def _template() -> Any:
    return get_env().from_string(_web("page.html"))


@cache
def _web(name: str) -> str:
    return (resources.files("chdstat.explorer") / "web" / name).read_text(encoding="utf-8")


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

    found = {
        name: {
            "areas": packed(panel.areas),
            "lines": packed(panel.lines),
            "marks": {"x": [m[0] for m in panel.marks], "color": [m[1] for m in panel.marks]},
            "extent": extent(name, panel),
        }
        for name, panel in panels.items()
    }
    whole = np.concatenate(numbers) if numbers else np.empty(0)
    return {"panels": found, "numbers": base64.b64encode(whole.tobytes()).decode("ascii")}


def colorbar(shown: Map | None) -> dict[str, Any] | None:
    """Return what the shell needs to draw the scale of a map."""
    if shown is None:
        return None
    kind = shown.kind
    bar: dict[str, Any] = {"title": kind.title, "unit": kind.unit}
    if kind.names:
        codes, counts = np.unique(shown.values[np.isfinite(shown.values)], return_counts=True)
        share = dict(zip(codes.astype(int).tolist(), counts / max(1, counts.sum()), strict=True))
        colors = dict(zip(sorted(kind.names), shown.colors, strict=True))
        texts = {code: NAMES.get(name.replace(" ", "_"), name) for code, name in kind.names.items()}
        bar["names"] = {str(code): text for code, text in texts.items()}
        bar["codes"] = [
            (f"{texts[code]} {100 * share[code]:.0f} %", colors[code])
            for code in (sorted(share) if kind.ordered else sorted(share, key=lambda c: -share[c]))
            if code in texts
        ]
        return bar
    low, high = shown.limits
    bar["ramp"] = ramp()[::16]
    bar["ticks"] = [f"{low + (high - low) * i / 4:.3g}" for i in range(5)]
    return bar
