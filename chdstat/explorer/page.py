"""The Bokeh document of a page: images that are linked, and panels that the page fills.

Bokeh draws and carries; the shell around the plots is the HTML page in ``web/``. Besides images
and panels, the document has two hidden text fields: the inbox receives what a person does, the
outbox what the shell is to show, both as JSON. Only the page's own thread may change a document;
other threads go through `Page.next`.
"""

from __future__ import annotations

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
from chdstat.explorer.maps import DIFFERENCES, IMAGES, MAPS, Map
from chdstat.explorer.plots import DASHES, LIGHT, PANELS, TEXT, panel_plot
from chdstat.explorer.selection import EXPORTS
from chdstat.explorer.sources import Source, StoreSource
from chdstat.explorer.startup import ramp
from chdstat.explorer.view import BATCH_SIZES, FITS
from chdstat.viz.estimators import NAMES

__all__ = ["HELP", "Page", "colorbar"]

HELP = {
    "headline": "Five numbers of the luminance of the selected pixel. The mean is given with its "
    "standard error. A null sample is one of a path that found no light. The tail index ξ is that "
    "of a generalised Pareto distribution fitted to the largest samples: from ½ on the variance is "
    "infinite, and the standard error means nothing. Where one sample dominates, the index without "
    "it stands below; the patterns go by that one. The last number is how many samples bring the "
    "standard error down to 1 % of the mean, if the variance is finite.",
    "linear": "Density of the positive samples over radiance. The bins cover the range of the "
    "first 50 samples and a quarter more at both ends, as in Elek, Thomas and Forbes (2019); "
    "samples beyond them, nulls and bad ones are counted in the line above. Dashed vertical lines "
    "are means. Curves are the fits that are switched on.",
    "log": "The same samples over the decimal logarithm of radiance, where log-normal samples "
    "look Gaussian and tails can be seen. Nulls have no logarithm; their share is given above.",
    "qq": "Quantiles of the positive samples against those of the first family that is switched "
    "on. On the dotted diagonal the family describes the samples; where the upper end bends above "
    "it, the tail of the samples is heavier than that of the family.",
    "running": "Mean of the first n samples, with the 95 % interval that the central limit theorem "
    "gives. Jumps are fireflies. With a tail index of ½ or more the interval is too short, however "
    "many samples there are.",
    "averages": "Distribution of averages of N consecutive samples, the values that a render with "
    "N samples per pixel would have, with the Gaussian of the same moments. p is that of a test of "
    "normality; a small p says that averages of N samples are not Gaussian yet.",
    "patterns": "What the distribution looks like, decided by the statistic and the threshold in "
    "each row. A pixel may have several patterns; the heading names the first that counts. Point "
    "at a row to read how it is measured and tested.",
    "estimates": "What each estimator gives from N samples, averaged over batches of this pixel, "
    "and its mean squared error over that of the sample mean: below 1 is better. Bias is the mean "
    "error over the mean; improved is the share of batches in which the estimate is nearer to the "
    "reference than the mean is.",
    "statistics": "Moments, the best family by BIC with its parameters, the tail, modes and tests "
    "of normality. A dash stands for what cannot be computed; the margin is the difference of BIC "
    "to the next best family.",
    "goodness": "Parametric bootstrap: each family is fitted, samples are drawn from the fit, "
    "fitted again, and compared with the fit as the pixel's samples are. A small p says that the "
    "family does not describe the samples; D is the largest gap of the distribution functions.",
    "compared": "Distances between the distributions of the pixel in the two stores, with a "
    "permutation test. Pixels that were picked because they look different make its p too small "
    "too often.",
    "paths": "Light that comes by paths of each length, known from the same samples with their "
    "paths cut: its share of the mean, of the variance, and of what the samples of each mode and "
    "of the tail carry.",
    "lights": "Light that comes from each of the lights, known from the same samples with the "
    "others switched off: its share of the mean, of the variance, and of what the samples of each "
    "mode and of the tail carry.",
}
"""Text by the part of the page that it explains."""

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
    source, other
        What the page shows; `other` beside it, or None.
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
        source: Source,
        other: Source | None,
        given: Mapping[str, Map],
        coarse: Sequence[str],
        gone: Callable[[], None],
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
            self._panels = {name: panel_plot(name) for name in PANELS}
            plots = [image["figure"] for image in self._images]
            plots += [panel for panel, _ in self._panels.values()]
            for root in (*plots, self.inbox, self.outbox):
                document.add_root(root)
            heading = " and ".join([*self._titles[:-1], (other or source).title])
            document.title = f"{heading} · chdstat"
            document.template = _template()
            variables = self._variables(given, in_store=isinstance(source, StoreSource))
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
            "map": self._images[0]["map"].data_source,
            "over": self._images[0]["map"].glyph,
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

    def _variables(self, given: Mapping[str, Map], *, in_store: bool) -> dict[str, Any]:
        """Return what the template of the shell is filled with."""
        channels = [(str(i), name) for i, name in enumerate(self._channels)]
        return {
            "style": _web("page.css"),
            "script": _web("page.js"),
            "aspect": self._size[1] / self._size[0],
            "exports": list(EXPORTS),
            "maps": [(k.name, k.title) for k in MAPS.values() if in_store or k.name in IMAGES],
            "differences": [(k.name, k.title) for k in DIFFERENCES.values()],
            "light": LIGHT,
            "given": [(name, found.kind.title) for name, found in given.items()],
            "errors": [(f"error:{n}", NAMES.get(n, n)) for n in fixed()] if in_store else [],
            "families": [(name, NAMES.get(name, name), DASHES.get(name)) for name in FITS],
            "channels": [*channels, ("luminance", "luminance")] if len(channels) > 1 else [],
            "batches": BATCH_SIZES,
            "titles": self._titles,
            "help": HELP,
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
        palette, (low, high) = list(shown.kind.ramp), shown.limits
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
    bar["ramp"], bar["limits"] = kind.ramp[::16], [float(f"{v:.4g}") for v in (low, high)]
    bar["ticks"] = [f"{low + (high - low) * i / 4:.3g}" for i in range(5)]
    return bar
