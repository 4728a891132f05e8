"""The Bokeh document of a page, and the connection to it from other threads.

Bokeh draws and carries; the shell around the plots is the HTML page in ``web/``. Besides images
and panels, the document has two hidden text fields: the inbox receives what a person does, the
outbox what the shell is to show, both as JSON. Only the page's own thread may change a document;
other threads go through `PageConnection`.
"""

from __future__ import annotations

import base64
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import numpy.typing as npt
from bokeh.document import Document
from bokeh.models import CustomJS, TextInput
from jinja2 import Environment

from chdstat.explorer.maps import Map, MapKind
from chdstat.explorer.palette import DASHES, ramp
from chdstat.explorer.panels import PanelData, Trace, extent
from chdstat.explorer.plots import ImagePlot, Linked, PanelPlot
from chdstat.explorer.view import BATCH_SIZES, FITS
from chdstat.reporting.typst import NAMES

__all__ = ["EXPORTS", "Page", "PageConnection", "colorbar", "encode_panels"]


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


EXPORTS = ("csv", "npz", "png", "svg", "pdf")
_PANELS = {
    "linear": "Linear histogram",
    "log": "Log10 histogram",
    "qq": "Quantiles",
    "running": "Running mean",
    "averages": "Averages of N samples",
}
# A click soon after another, and one that is held for a while, are clicks as well.
_EVENTS = {
    "tap": "tap",
    "doubletap": "tap",
    "press": "press",
    "pressup": "pressup",
    "mousemove": "hover",
    "selectiongeometry": "box",
}

Image = npt.NDArray[Any]


class Page:
    """The models of one document.

    Parameters
    ----------
    document
        Where they go.
    titles
        Of the images: one, or two that are compared.
    size
        (height, width) of the image in pixels.
    channels
        Names of the channels.
    heading
        Of the page.
    maps
        What can be shown in the place of the image.
    errors
        Estimators whose error can be mapped.
    """

    def __init__(
        self,
        document: Document,
        *,
        titles: Sequence[str],
        size: tuple[int, int],
        channels: Sequence[str],
        heading: str,
        maps: Sequence[MapKind],
        errors: Sequence[str],
    ) -> None:
        self._document, self._size, self._channels = document, size, channels
        self._numbers = itertools.count(1)
        with document.models.freeze():  # else, all models are gathered anew after each change
            self._fill(titles)
            document.title = f"{heading} · chdstat"
            document.template = _template()
            document.template_variables.update(
                _variables(titles, size, channels, heading, maps, errors)
            )
            self._connect()

    def _fill(self, titles: Sequence[str]) -> None:
        self.inbox = TextInput(name="inbox", visible=False)
        self.outbox = TextInput(name="outbox", visible=False)
        self._linked = Linked.of(*self._size)
        self._images = [
            ImagePlot(f"image{i}", self._size, self._linked) for i in range(len(titles))
        ]
        self._panels = {name: PanelPlot(name) for name in _PANELS}
        roots = [p.figure for p in self._images] + [p.figure for p in self._panels.values()]
        for root in (*roots, self.inbox, self.outbox):
            self._document.add_root(root)

    # --- what is shown --------------------------------------------------------------------------

    def send(self, *items: Mapping[str, Any]) -> None:
        """Send what the shell is to show."""
        self.outbox.value = json.dumps({"number": next(self._numbers), "items": items})

    def show_image(self, index: int, packed: npt.NDArray[np.uint32], mean: Image) -> None:
        """Show an image, packed RGBA (y, x), with the radiance (y, x, channel) to be read."""
        radiance = {
            name: [np.ascontiguousarray(mean[..., i], np.float32)]
            for i, name in enumerate(self._channels)
        }
        self._images[index].source.data = {"image": [packed], **radiance}

    def show_map(self, shown: Map | None) -> None:
        """Put a map in the place of the first image; None takes it away."""
        first = self._images[0]
        first.map.visible = shown is not None
        if shown is None:
            return
        values = np.ascontiguousarray(shown.values, np.float32)
        if shown.kind.names:
            low, high = min(shown.kind.names) - 0.5, max(shown.kind.names) + 0.5
            self._linked.mapper.update(palette=shown.colors, low=low, high=high)
        else:
            low, high = shown.limits
            self._linked.mapper.update(palette=list(ramp()), low=low, high=high)
        first.map_source.data = {"image": [values]}

    # --- wiring ---------------------------------------------------------------------------------

    def _connect(self) -> None:
        models: dict[str, Any] = {
            "inbox": self.inbox,
            "outbox": self.outbox,
            "radiance": self._images[0].source,
            "map": self._images[0].map_source,
            "x_range": self._linked.x_range,
            "y_range": self._linked.y_range,
            "pans": [p.pan for p in self._images],
            "boxes": [p.box for p in self._images],
            "marks": self._linked.marks,
            "region": self._linked.region,
            "panels": {name: panel.filled for name, panel in self._panels.items()},
            "width": self._size[1],
            "height": self._size[0],
            "channels": list(self._channels),
        }
        names = ", ".join(models)
        start = CustomJS(args=models, code=f"window.chdstat.start({{{names}}})")
        self._document.js_on_event("document_ready", start)
        self._document.js_on_event("connection_lost", CustomJS(code="window.chdstat.lost()"))
        for image in self._images:
            for event, call in _EVENTS.items():
                image.figure.js_on_event(event, CustomJS(code=f"window.chdstat.{call}(cb_obj)"))


@cache
def _template() -> Any:
    from bokeh.core.templates import get_env

    environment: Environment = get_env()
    return environment.from_string(_web("page.html"))


@cache
def _web(name: str) -> str:
    return (resources.files("chdstat.explorer") / "web" / name).read_text(encoding="utf-8")


def _variables(
    titles: Sequence[str],
    size: tuple[int, int],
    channels: Sequence[str],
    heading: str,
    maps: Sequence[MapKind],
    errors: Sequence[str],
) -> dict[str, Any]:
    chosen = [(str(i), name) for i, name in enumerate(channels)] if len(channels) > 1 else []
    return {
        "style": _web("page.css"),
        "script": _web("page.js"),
        "heading": heading,
        "aspect": size[1] / size[0],
        "exports": EXPORTS,
        "maps": [(kind.name, kind.title) for kind in maps],
        "errors": [(f"error:{name}", NAMES.get(name, name)) for name in errors],
        "families": [(name, NAMES.get(name, name), DASHES.get(name)) for name in FITS],
        "channels": [*chosen, ("luminance", "luminance")] if chosen else [],
        "batches": BATCH_SIZES,
        "titles": list(titles),
        "panel_titles": _PANELS,
    }


class PageConnection:
    """The connection to one page, until the page is gone.

    Parameters
    ----------
    document, page
        The page, which receives everything that is sent.
    gone
        Called once, when the page turns out to be gone, or `close` is called.
    """

    def __init__(self, document: Document, page: Page, gone: Callable[[], None]) -> None:
        self._document, self._page, self._gone = document, page, gone
        self.closed = False

    def close(self) -> None:
        """Carry nothing more."""
        if not self.closed:
            self.closed = True
            self._gone()

    def send(self, *items: Mapping[str, Any]) -> None:
        """Send what the shell is to show; in the page's own thread."""
        self._page.send(*items)

    def alert(self, text: str) -> None:
        """Send a message on what went wrong; in the page's own thread."""
        self.send({"kind": "alert", "text": text})

    def next(self, callback: Callable[[], None]) -> None:
        """Call something in the page's own thread, soon."""
        self._add(self._document.add_next_tick_callback, callback)

    def later(self, callback: Callable[[], None], milliseconds: int) -> None:
        """Call something in the page's own thread, after a while."""
        self._add(self._document.add_timeout_callback, callback, milliseconds)

    def _add(self, add: Callable[..., Any], callback: Callable[[], None], *when: int) -> None:
        if self.closed:
            return
        try:
            add(callback, *when)
        except (RuntimeError, AttributeError):  # the page is gone, and its document dissolved
            self.close()
