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

from chdstat._core.arrays import Image, luminance
from chdstat._core.display import png
from chdstat._core.image_scales import tonemap
from chdstat.explorer.address import BATCH_SIZES, FITS, LOOKS
from chdstat.explorer.export import EXPORTS
from chdstat.explorer.image_sources import AnySource, StoreSource
from chdstat.explorer.overlays import (
    CONTRASTS,
    COST,
    DIFFERENCES,
    IMAGES,
    MAPS,
    OF_FILM,
    Map,
    ramp,
)
from chdstat.explorer.panels import DASHES, LIGHT, PANELS, TEXT, panel_plot
from chdstat.explorer.render_process import COARSE
from chdstat.patterns import Label
from chdstat.patterns.cures import renderer_of
from chdstat.samples import Samples
from chdstat.viz.styling import MAGNITUDES, SIGNED, bar_ticks, called

T = TypeVar("T")

_MISSING = "#00000080"
# A click soon after another, and one that is held for a while, are clicks as well.
_EVENTS = {
    "tap": "tap",
    "doubletap": "tap",
    "press": "press",
    "pressup": "pressup",
    "mousemove": "hover",
    "selectiongeometry": "box",
}


class Page:
    """The models of one document, and the way to them from other threads.

    Parameters
    ----------
    document
        Where the models go.
    sources, names
        What the page shows, and what each is called.
    given
        Maps that were computed before.
    coarse
        PNG images in base64 of what is shown, seen until Bokeh has drawn; none for nothing.
    gone
        Called once, when the page turns out to be gone.

    Attributes
    ----------
    inbox, outbox
        Fields of what a person does, and of what the shell is to show.
    """

    def __init__(
        self,
        document: Document,
        sources: Sequence[AnySource],
        names: Sequence[str],
        given: Mapping[str, Map],
        coarse: Sequence[str],
        gone: Callable[[], None],
    ) -> None:
        self._document, self._gone, self._closed = document, gone, False
        self._size, self._channels = sources[0].size, sources[0].channels
        self._titles = list(names)
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
            self._panels = {name: panel_plot(name) for name in PANELS}
            plots = [image["figure"] for image in self._images]
            plots += [panel for panel, _ in self._panels.values()]
            for root in (*plots, self.inbox, self.outbox):
                document.add_root(root)
            heading = sources[0].title if len(sources) == 1 else ", ".join(names)
            document.title = f"{heading} · chdstat"
            document.template = _template()
            document.config.notify_connection_status = False  # the shell says it
            document.config.reconnect_session = False  # it loads the page again
            stores = [s.samples for s in sources if isinstance(s, StoreSource)]
            variables = self._variables(given, stores)
            variables |= {"heading": heading, "coarse": coarse}
            document.template_variables.update(variables)
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
            background_fill_color=None,  # the coarse image is seen through it until there is one
            border_fill_color=None,
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
        values = models.ColumnDataSource({"x": [], "y": [], "text": []})
        plot.text(
            "x", "y", "text", source=values, text_color="#ffffff", text_outline_color="#000000",
            text_font_size="11px", text_align="center", text_baseline="middle",
        )  # fmt: skip
        parts = {"figure": plot, "source": image, "values": values}
        return {**parts, "pan": pan, "box": box, "map": shown}

    def _connect(self) -> None:
        given: dict[str, Any] = {
            "inbox": self.inbox,
            "outbox": self.outbox,
            "figures": [image["figure"] for image in self._images],
            "radiances": [image["source"] for image in self._images],
            "values": [image["values"] for image in self._images],
            "maps": [image["map"].data_source for image in self._images],
            "overs": [image["map"].glyph for image in self._images],
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

    def _variables(self, given: Mapping[str, Map], stores: Sequence[Samples]) -> dict[str, Any]:
        """Return what the template of the shell is filled with, for samples of these stores."""
        about = [samples.attrs for samples in stores]
        drawn = about[0] if len(set(map(renderer_of, about))) == 1 else {}
        known = MAPS if stores else IMAGES
        left = OF_FILM if all(samples.film is None for samples in stores) else set[str]()
        left = left | {COST.name} if all(samples.costs is None for samples in stores) else left
        channels = [(str(i), name) for i, name in enumerate(self._channels)]
        return {
            "style": _web("page.css"),
            "script": _web("page.js"),
            "aspect": self._size[1] / self._size[0],
            "exports": list(EXPORTS),
            "maps": [(k.name, k.title) for k in known.values() if k.name not in left],
            "differences": [(k.name, k.title) for k in {**DIFFERENCES, **CONTRASTS}.values()],
            "cmaps": {"cmap": MAGNITUDES, "signed": SIGNED},
            "light": LIGHT,
            "looks": LOOKS,
            "labels": [(called(x.name.lower()), x, x.cure_by(drawn)) for x in Label],
            "given": [(name, found.title) for name, found in given.items()],
            "families": [(name, called(name), DASHES.get(name)) for name in FITS],
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

    def show_map(self, shown: Map | None, index: int) -> None:
        """Put a map in the place of an image; None takes it away."""
        for i, image in enumerate(self._images):
            image["map"].visible = shown is not None and i == index
        if shown is None:
            return
        renderer = self._images[index]["map"]
        low, high = map(float, shown.scaled(shown.limits))
        self._mapper.update(palette=shown.colors, low=low, high=high)
        # A pass goes on to write into its values: Bokeh would see no change.
        renderer.data_source.data = {"image": [np.array(shown.scaled(shown.values), np.float32)]}

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


@cache
def _template() -> Any:
    return get_env().from_string(_web("page.html"))


@cache
def _web(name: str) -> str:
    return (resources.files("chdstat.explorer") / "web" / name).read_text(encoding="utf-8")


def colorbar(shown: Map | None) -> dict[str, Any] | None:
    """Return what the shell needs to draw the scale of a map."""
    if shown is None:
        return None
    bar: dict[str, Any] = {"title": shown.title, "unit": shown.unit, "note": shown.note}
    if shown.names:
        codes, counts = np.unique(shown.values[np.isfinite(shown.values)], return_counts=True)
        share = dict(zip(codes.astype(int).tolist(), counts / max(1, counts.sum()), strict=True))
        colors = dict(zip(sorted(shown.names), shown.colors, strict=True))
        bar["names"] = {str(code): text for code, text in shown.names.items()}
        bar["codes"] = [
            (shown.names[code], f"{100 * share[code]:.0f}\N{NO-BREAK SPACE}%", colors[code])
            for code in (sorted(share) if shown.ordered else sorted(share, key=lambda c: -share[c]))
            if code in shown.names
        ]
        return bar
    low, high = shown.limits
    bar["ramp"], bar["limits"] = shown.colors[::15], [float(f"{v:.4g}") for v in (low, high)]
    start, end = map(float, shown.scaled((low, high)))
    bar |= {"log": shown.log, "signed": shown.diverging}
    bar["ticks"] = [
        (float(shown.scaled(v) - start) / (end - start), text)
        for v, text in bar_ticks(low, high, log=shown.log)
    ]
    return bar


# --- images as a browser shows them -------------------------------------------------------------

_FILMIC = (0.15, 0.50, 0.10, 0.20, 0.02, 0.30)
_WHITE = 11.2


def isolated(mean: Image, channel: str) -> Image:
    """Return an image of one channel, or of luminance, as a grey one; of "all" the image itself."""
    if channel == "all" or mean.shape[-1] == 1:
        return mean
    grey = luminance(mean, channel_axis=-1) if channel == "luminance" else mean[..., int(channel)]
    return np.repeat(grey[..., np.newaxis], mean.shape[-1], axis=-1).astype(np.float32)


def rgba(mean: Image, exposure: float, tone: str, gamma: float = 1.0) -> npt.NDArray[np.uint32]:
    """Return an image as a browser wants it: packed RGBA, shape (y, x).

    Parameters
    ----------
    mean
        Linear radiance, shape (y, x, channel); what is not finite becomes magenta.
    exposure
        Stops.
    tone
        'srgb' clips, 'reinhard' maps v to v / (1 + v), 'filmic' is Hable's curve.
    gamma
        What is shown is raised to 1 / gamma.

    References
    ----------
    Reinhard, Stark, Shirley and Ferwerda, "Photographic tone reproduction for digital images",
    2002, doi:10.1145/566654.566575, equation 3. Hable, "Uncharted 2: HDR lighting", Game Developers
    Conference 2010.

    Examples
    --------
    >>> hex(rgba(np.ones((1, 1, 3), np.float32), 0, "srgb")[0, 0])
    '0xffffffff'
    """
    with np.errstate(invalid="ignore", over="ignore"):
        value = mean * np.float32(2.0**exposure)
        if tone == "reinhard":
            value = np.where(np.isfinite(value), value / (1 + value), value)
        elif tone == "filmic":
            value = np.where(
                np.isfinite(value), _hable(2 * value) / _hable(np.float32(_WHITE)), value
            )
    shown = tonemap(value, exposure=0)
    packed = np.full((*shown.shape[:2], 4), 255, np.uint8)
    packed[..., :3] = np.round(255 * shown ** (1 / gamma))
    return packed.view(np.uint32)[..., 0]


def coarse_png(mean: Image, exposure: float, tone: str, gamma: float = 1.0) -> str:
    """Return an image with few pixels, as a PNG file in base64; parameters as for `rgba`."""
    step = -(-max(mean.shape[:2]) // COARSE)
    packed = np.ascontiguousarray(rgba(mean[::step, ::step], exposure, tone, gamma))
    colors = packed.view(np.uint8).reshape(*packed.shape, 4)[..., :3]
    return base64.b64encode(png(colors / 255)).decode("ascii")


def _hable(v: npt.NDArray[np.float32] | np.float32) -> npt.NDArray[np.float32]:
    a, b, c, d, e, f = _FILMIC
    v = np.minimum(v, np.float32(1e15))  # v squared stays within float32
    return np.asarray((v * (a * v + c * b) + d * e) / (v * (a * v + b) + d * f) - e / f, np.float32)
