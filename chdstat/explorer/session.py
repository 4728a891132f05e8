"""Session: one page, its commands, the image that it shows and the results of its selection.

Every command is checked, and what it cannot do becomes a message on the page. A `Worker` computes
the results of the selection in the thread of clicks: panels are shown while tables are still
computed, only the newest selection is worked on, and slow estimates follow after a pause. A pixel
of a scene gets more samples for as long as it is selected.
"""

from __future__ import annotations

import base64
import json
import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from bokeh.document import Document

from chdstat.errors import ChdstatError, InputError
from chdstat.explorer.estimators import ScoredEstimate
from chdstat.explorer.maps import IMAGES, map_kind, of_overall, rgba
from chdstat.explorer.page import Page, colorbar, encode_panels
from chdstat.explorer.panels import PIXEL_COLORS
from chdstat.explorer.selection import EXPORTS, SelectionPlots, SelectionResults, exported
from chdstat.explorer.shared import Shared, Stopped
from chdstat.explorer.sources import MOST_SPP, Overall, SceneSource, StoreSource
from chdstat.explorer.statistics import Table
from chdstat.explorer.view import View, box_between, check_pixel, parse_view

__all__ = ["Session"]

_log = logging.getLogger("chdstat")

_PAUSE = 250
"""Milliseconds without a click before slow estimators begin."""
_LOOK = 0.4
"""Seconds of sampling between two updates of the selected pixel of a scene."""
_OWN_ACCORD = -1
"""In place of the number of a command, for an update that follows from none."""

Found = tuple[SelectionPlots, dict[str, Table], list[ScoredEstimate]] | None


class Worker:
    """Computes results of the selection and sends them to the page.

    Parameters
    ----------
    shared
        Sources and threads.
    page
        The page.

    Attributes
    ----------
    shown
        Results that the page shows; None for nothing.
    """

    def __init__(self, shared: Shared, page: Page) -> None:
        self._shared, self._page = shared, page
        self._results = SelectionResults(shared)
        self.shown: SelectionPlots | None = None
        self._view = View()
        self._is_new = True
        self._generation = 0
        self._live_spp: int | None = None
        self._paused = False
        self._visible = True

    def compute(self, view: View, seq: int = _OWN_ACCORD) -> None:
        """Compute the results of a view; `seq` is the number of the command."""
        self._generation += 1
        self._view, self._is_new = view, True
        self._shared.urgent(1)
        generation = self._generation

        def work() -> Found:
            try:
                return self._found(view, generation)
            finally:
                self._shared.urgent(-1)

        self._run(work, seq)

    def pause(self) -> None:
        """Stop drawing more samples of the selected pixel, or go on."""
        self._paused = not self._paused
        self._tell_live()
        self._draw_more()

    def see(self, visible: bool) -> None:
        """Take note of whether anyone can see the page."""
        self._visible = visible
        self._draw_more()

    def test_fits(self) -> None:
        """Test the fits of the active place, which takes seconds; send the share that is done.

        Raises
        ------
        InputError
            If nothing is selected.
        """
        if self.shown is None or self._is_new:
            message = "nothing is selected: click a pixel before testing its fits"
            raise InputError(message)
        generation = self._generation

        def step(share: float) -> None:
            self._check(generation)
            message = {"kind": "goodness", "share": share}
            self._page.next(partial(self._page.send, message))

        self._add("goodness", partial(self._results.goodness, self.shown, step))

    def close(self) -> None:
        """Drop what is being worked on."""
        self._generation += 1

    # --- in the thread of clicks ----------------------------------------------------------------

    def _found(self, view: View, generation: int) -> Found:
        """Compute the results of a view, panels first; None where a newer view is waiting."""
        if generation != self._generation:
            return None
        plots = self._results.plots(view)
        if plots.places:
            notes = {name: list(panel.notes) for name, panel in plots.panels.items()}
            drawn = {"kind": "panels", **encode_panels(plots.panels), "notes": notes}
            self._page.next(partial(self._draw, {**drawn, "legend": plots.legend}, generation))
        return plots, *self._results.describe(plots)

    def _found_with_more(self, view: View, generation: int) -> Found:
        """Sample the active pixel for a while, then compute the results again."""
        source, start = self._shared.source, time.monotonic()
        assert isinstance(source, SceneSource)
        while time.monotonic() - start < _LOOK and not self._paused:
            if generation != self._generation:
                return None
            if source.more(*view.pixels[view.active]).shape[1] >= MOST_SPP:
                break
        return self._found(view, generation)

    def _check(self, generation: int) -> None:
        """Raise `Stopped` if there is a newer selection."""
        if generation != self._generation:
            raise Stopped

    # --- in the page's own thread ---------------------------------------------------------------

    def _run(self, work: Callable[[], Found], seq: int) -> None:
        finish = partial(self._finished, self._generation, seq, time.perf_counter())
        self._page.run(self._shared.clicks, work, finish)

    def _draw(self, drawn: Mapping[str, Any], generation: int) -> None:
        if generation == self._generation:
            self._page.send(drawn)

    def _finished(self, generation: int, seq: int, start: float, future: Future[Found]) -> None:
        if generation != self._generation:
            return
        done = {"kind": "done", "seq": seq}
        if error := future.exception():
            self._alert(error)
            self._page.send({**done, "took": 0})
            return
        found = future.result()
        if found is None:
            return
        plots, tables, quick = found
        done["took"] = time.perf_counter() - start
        self.shown, self._is_new = (plots if plots.places else None), False
        self._page.send(*([{"kind": "tables", "tables": tables}] if tables else []), done)
        self._live_spp = plots.live_spp
        self._tell_live()
        self._draw_more()
        if plots.places and plots.live_spp is None:  # else it changes all the time
            begin = partial(self._add_estimates, plots, quick, generation)
            self._page.next(begin, _PAUSE)

    def _add_estimates(
        self, plots: SelectionPlots, quick: list[ScoredEstimate], generation: int
    ) -> None:
        """Add the estimates that take longer than a click may."""
        if generation == self._generation:
            step = partial(self._check, generation)
            self._add("estimates", partial(self._results.slow_estimates, plots, quick, step))

    def _add(self, name: str, work: Callable[[], Table]) -> None:
        """Compute a table in another thread, and show it if the selection is still the same."""
        generation = self._generation

        def add(future: Future[Table]) -> None:
            error = future.exception()
            if generation != self._generation or isinstance(error, Stopped):
                return
            if error is None:
                self._page.send({"kind": "tables", "tables": {name: future.result()}})
            else:
                self._alert(error)

        self._page.run(self._shared.additions, work, add)

    def _draw_more(self) -> None:
        """Draw more samples of the active pixel, unless paused, hidden, or done."""
        spp = self._live_spp
        if self._paused or not self._visible or spp is None or spp >= MOST_SPP:
            return
        self._live_spp = None  # until the plots are here
        self._run(partial(self._found_with_more, self._view, self._generation), _OWN_ACCORD)

    def _tell_live(self) -> None:
        if not isinstance(self._shared.source, SceneSource):
            return
        if (spp := self._live_spp) is None:
            if not self._view.pixels:
                self._page.send({"kind": "live", "shown": False})
            return
        text = f"{spp:,} of {MOST_SPP:,} samples".replace(",", " ")
        state = {"share": spp / MOST_SPP, "text": text, "paused": self._paused}
        self._page.send({"kind": "live", "shown": True, **state})

    def _alert(self, error: BaseException) -> None:
        text = str(error)
        if not isinstance(error, ChdstatError):
            _log.error("the explorer could not answer", exc_info=error)
            text = f"{type(error).__name__}: {error}"
        self._page.alert(text)


class Session:
    """One page.

    Parameters
    ----------
    document
        The Bokeh document of the page.
    shared
        State that it has in common with other pages.
    arguments
        The query of its address: values by name.
    """

    def __init__(
        self, document: Document, shared: Shared, arguments: Mapping[str, list[str]]
    ) -> None:
        self._shared = shared
        self._size = shared.source.size
        self._seq = _OWN_ACCORD
        self.view, self._notes = parse_view(arguments, *self._size)
        self._page = Page(document, shared.source, shared.other, self._gone)
        self._worker = Worker(shared, self._page)
        self._page.inbox.on_change("value", self._received)
        self._end = shared.listen(lambda what: self._page.next(partial(self._heard, what)))

    def _gone(self) -> None:
        self._worker.close()
        self._end()

    # --- commands -------------------------------------------------------------------------------

    def _received(self, _attribute: str, _old: str, new: str) -> None:
        try:
            message = json.loads(new)
            command, self._seq = str(message.pop("command")), int(message.pop("seq"))
            handle = self._commands[command]
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            self._page.alert("the page sent something that is no command; reload it")
            return
        try:
            handle(self, **message)
        except ChdstatError as error:
            self._page.alert(str(error))
        except (TypeError, ValueError, OverflowError, AttributeError) as error:
            self._page.alert(f"the command {command!r} was not understood: {error}")

    def _ready(self) -> None:
        source, other = self._shared.source, self._shared.other
        parts = [source.describe()]
        if other is not None:
            parts.append(f"against {other.name}: {other.describe()}")
        self._page.send({"kind": "described", "text": "  |  ".join(parts)})
        self._show_image()
        notes = list(self._notes)
        if self.view.map != "image":
            try:
                self._want_map(self.view.map)
            except InputError as error:
                notes.append(str(error))
                self.view = self.view.changed("map", "image")
        self._show_map()
        if notes:
            self._page.alert("; ".join(notes))
        self._heard("working")
        self._go(self.view)

    def _pick(self, *, y: int, x: int, add: bool = False) -> None:
        y, x = int(y), int(x)
        check_pixel(y, x, *self._size)
        self._go(self.view.pick(y, x, add=bool(add)))

    def _box(self, *, box: list[float]) -> None:
        top, left, bottom, right = (float(v) for v in box)
        self._go(self.view.box(box_between((top, left), (bottom, right), *self._size)))

    def _move(self, *, dy: int, dx: int) -> None:
        self._go(self.view.move(int(dy), int(dx), *self._size))

    def _activate(self, *, index: int) -> None:
        self._go(self.view.activate(int(index)))

    def _drop(self, *, index: int) -> None:
        self._go(self.view.drop(int(index)))

    def _set(self, *, option: str, value: Any) -> None:
        if option == "map" and value != "image":
            self._want_map(str(value))
        view = self.view.changed(str(option), value)
        if option not in {"map", "exposure", "tone"}:
            self._go(view)
            return
        self.view = view
        if option == "map":
            self._show_map()
        else:
            self._show_image()
        self._show_view()

    def _export(self, *, format: str) -> None:  # noqa: A002 - its name on the page
        if format not in EXPORTS:
            message = f"exports are {', '.join(EXPORTS)}; got {format!r}"
            raise InputError(message)
        if self._worker.shown is None:
            message = "nothing is selected: click a pixel before exporting"
            raise InputError(message)
        self._page.send({"kind": "working", "text": f"exporting {format}"})
        name, exposure = self._shared.source.name, self._exposure
        work = partial(exported, format, name, self._worker.shown, self._overall, exposure)
        self._page.run(self._shared.exports, work, self._exported)

    def _near(self, *, y: int, x: int) -> None:
        """Read the pixels around the pointer, so that they are there when one is clicked."""
        source = self._shared.source
        if isinstance(source, StoreSource):
            with suppress(RuntimeError):  # the explorer is closing
                self._shared.exports.submit(source.pixel, int(y), int(x))

    _commands: Mapping[str, Callable[..., None]] = {
        "ready": _ready,
        "pick": _pick,
        "box": _box,
        "move": _move,
        "near": _near,
        "activate": _activate,
        "drop": _drop,
        "set": _set,
        "export": _export,
        "pause": lambda self: self._worker.pause(),
        "visible": lambda self, on: self._worker.see(bool(on)),
        "goodness": lambda self: self._worker.test_fits(),
    }

    # --- what they change -----------------------------------------------------------------------

    def _go(self, view: View) -> None:
        """Show the selection at once, and its results when they are computed."""
        self.view = view
        self._show_view()
        self._worker.compute(view, self._seq)

    def _heard(self, what: str) -> None:
        """Show news of the passes over the image, or of the source."""
        if what == "working":
            self._page.send({"kind": "working", "text": self._shared.working})
            if self._shared.failed:
                self._page.alert(self._shared.failed)
        elif what == "image":
            self._show_image()
            self._show_view()
            self._show_map()
        elif what == "source":
            self._page.send({"kind": "described", "text": self._shared.source.describe()})
            self._show_view()
            self._worker.compute(self.view)
        elif what == self.view.map:
            self._show_map()

    def _show_view(self) -> None:
        view = {"view": asdict(self.view), "query": self.view.query(), "exposure": self._exposure}
        self._page.send({"kind": "view", **view, "colors": PIXEL_COLORS})

    @property
    def _overall(self) -> Overall:
        """The image so far."""
        source = self._shared.source
        return self._shared.overall or Overall.empty(*source.size, len(source.channels))

    @property
    def _exposure(self) -> float:
        """Stops that the image is shown with."""
        exposure = self.view.exposure
        return self._overall.exposure if exposure is None else exposure

    def _show_image(self) -> None:
        """Show the image, or both."""
        mean = self._overall.mean
        if not np.isfinite(mean).any():  # nothing is drawn yet, which is no error
            mean = np.zeros_like(mean)
        other = self._shared.other_overall
        for i, image in enumerate([mean] if other is None else [mean, other.mean]):
            self._page.show_image(i, rgba(image, self._exposure, self.view.tone), image)

    def _want_map(self, name: str) -> None:
        """Start to compute a map, or refuse one that needs a store where there is none."""
        if isinstance(self._shared.source, StoreSource):
            self._shared.want(name)
        elif (kind := map_kind(name)).name not in IMAGES:
            how = "render the scene with 'chdstat render SCENE -o STORE'"
            message = f"{kind.title!r} needs a store: {how}"
            raise InputError(message)

    def _show_map(self) -> None:
        """Show what there is of the map, or take it away."""
        name, overall = self.view.map, self._shared.overall
        found = of_overall(overall, name) if overall is not None else None
        found = found or self._shared.maps.get(name)
        self._page.show_map(found)
        self._page.send({"kind": "colorbar", "bar": colorbar(found)})

    def _exported(self, future: Future[tuple[str, bytes]]) -> None:
        self._page.send({"kind": "working", "text": ""})
        if error := future.exception():
            self._page.alert(f"the export failed: {error}")
            return
        name, content = future.result()
        data = base64.b64encode(content).decode("ascii")
        kind = EXPORTS[name.rpartition(".")[2]]
        self._page.send({"kind": "file", "name": name, "type": kind, "data": data})
