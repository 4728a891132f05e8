"""Session: one page, its commands, its image and the results of its selection.

Every command is checked; errors become messages on the page. Results of the selection are computed
in the thread of clicks: panels are shown before tables are finished, only the newest selection is
computed, and slow estimates follow after a pause. A pixel of a scene gets more samples as long as
it is selected.
"""

from __future__ import annotations

import base64
import json
import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Executor, Future
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from bokeh.document import Document

from chdstat.errors import ChdstatError, InputError
from chdstat.explorer.address import BATCHES, LOOKS, View, box_between, check_pixel, parse_view
from chdstat.explorer.batch_estimates import PlaceEstimates
from chdstat.explorer.bokeh_document import Page, coarse_png, colorbar, isolated, rgba
from chdstat.explorer.export import EXPORTS, exported
from chdstat.explorer.image_sources import MOST_SPP, ImageSource, SceneSource, StoreSource
from chdstat.explorer.overlays import Map, map_kind, map_of_view
from chdstat.explorer.panels import encode_panels, image_panel, mark_colors
from chdstat.explorer.selection import SelectionPlots, SelectionResults
from chdstat.explorer.tables import Table, errors_line, errors_table, headline, why
from chdstat.explorer.workspace import Workspace, first_pixel

_log = logging.getLogger("chdstat")

_PAUSE = 250
"""Milliseconds without a click before slow estimators begin."""
_LOOK = 0.4
"""Seconds of sampling between two updates of the selected pixel of a scene."""
_OWN_ACCORD = -1
"""Number of an update that does not follow from a command."""

T = TypeVar("T")
Found = tuple[SelectionPlots, dict[str, Table], list[PlaceEstimates]] | None
Check = Callable[[], None]


class _Stopped(Exception):  # noqa: N818 - not an error
    """The result is no longer needed."""


class Session:
    """One page: its view, the image or map it shows, and the results of its selection.

    Parameters
    ----------
    document
        The Bokeh document of the page.
    workspace
        State that all pages share.
    arguments
        The query of its address: values by name.
    """

    def __init__(
        self, document: Document, workspace: Workspace, arguments: Mapping[str, list[str]]
    ) -> None:
        self._workspace = workspace
        self._size = workspace.sources[0].size
        self._results = SelectionResults(workspace)
        self._shown: SelectionPlots | None = None
        self._is_new = True
        self._generation = 0
        self._live_spp: int | None = None
        self._paused, self._visible = True, True
        self._makes_image = self._image_is_old = False
        self._seq, self._waited, self._refused = _OWN_ACCORD, _OWN_ACCORD, ""
        self.view, self._notes = parse_view(arguments, *self._size)
        if not self.view.pixels and self.view.region is None:
            self.view = self.view.pick(*first_pixel(workspace.overalls[0]))
        # A map or a part of the image has another look: then there is nothing to be seen at first.
        coarse = [] if self.view.overlay != "image" or "z" in arguments else self._coarse()
        self._page = Page(
            document, workspace.sources, workspace.names, workspace.given, coarse, self._gone
        )
        self._guessed = self.view
        self._page.inbox.on_change("value", self._received)
        self._end = workspace.listen(lambda what: self._page.next(partial(self._heard, what)))

    def _gone(self) -> None:
        self._generation += 1  # drops what is being worked on
        self._workspace.passes.leave(self)
        self._workspace.passes.leave((self, "errors"))
        self._end()

    # --- commands: the page sends the name of a method, without its `_on_`, and its arguments ---

    def _received(self, _attribute: str, _old: str, new: str) -> None:
        try:
            message = json.loads(new)
            command, self._seq = str(message.pop("command")), int(message.pop("seq"))
            handle = getattr(self, f"_on_{command}")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            self._page.alert("the page sent something that is no command; reload it")
            return
        try:
            handle(**message)
        except ChdstatError as error:
            self._refuse(str(error))
        except (TypeError, ValueError, OverflowError, AttributeError) as error:
            self._refuse(f"the command {command!r} was not understood: {error}")

    def _refuse(self, text: str) -> None:
        """Say why a command changes nothing."""
        self._page.alert(text)
        self._page.send({"kind": "done", "seq": self._seq, "refused": True})

    def _on_ready(self) -> None:
        self._describe()
        self._show_image()
        self._show_histogram()
        notes = list(self._notes)
        try:
            self._workspace.want(self, self.view)
        except InputError as error:
            notes.append(str(error))
            self.view = self.view.changed("map", "image")
        self._show_map()
        self._want_errors()
        if notes:
            self._page.alert("; ".join(notes))
        self._heard("working")
        self._heard("suggested")
        self._go(self.view)

    def _on_pick(self, *, y: int, x: int, add: bool = False) -> None:
        y, x = int(y), int(x)
        check_pixel(y, x, *self._size)
        self._go(self.view.pick(y, x, add=bool(add)))

    def _on_box(self, *, box: list[float]) -> None:
        top, left, bottom, right = (float(v) for v in box)
        self._go(self.view.box(box_between((top, left), (bottom, right), *self._size)))

    def _on_move(self, *, dy: int, dx: int) -> None:
        self._go(self.view.move(int(dy), int(dx), *self._size))

    def _on_activate(self, *, index: int) -> None:
        self._go(self.view.activate(int(index)))

    def _on_drop(self, *, index: int) -> None:
        self._go(self.view.drop(int(index)))

    def _on_set(self, *, option: str, value: Any) -> None:
        view = self.view.changed(str(option), value)
        if option == "limits" and view.limits and view.limits[0] <= 0 and map_kind(view.map).log:
            message = f"the ends of a logarithmic colour bar must be above 0, got {view.limits[0]}"
            raise InputError(message)
        if option == "map":
            view = replace(view, limits=None, brush=None)
            self._workspace.want(self, view)
        if option in LOOKS:
            self.view = view
            self._show_view()
        else:
            self._go(view)
        if option in {"exposure", "tone", "gamma", "channel"}:
            self._show_image()
        if option == "channel":
            self._show_histogram()
        if option in {"shown", "reference", "brush", "channel"}:
            self._want()
            self._want_errors()
        elif option in {"map", "limits", "cmap", "signed"}:
            self._show_map()

    def _want(self) -> None:
        """Request the map of the view, or say why there is none."""
        self._refused = ""
        try:
            self._workspace.want(self, self.view if self._visible else View())
        except InputError as error:
            self._refused = str(error)
        self._show_map()

    def _want_errors(self) -> None:
        """Request the errors of the images against the reference, and show what there is."""
        workspace = self._workspace
        if len(workspace.sources) == 1:
            return
        shown, reference = self.view.of_images(len(workspace.sources))
        workspace.want_errors(self, reference)
        said = workspace.passes.failures.get(f"errors {reference}", "being measured")
        found = workspace.errors.get(reference)
        if found and reference not in workspace.outdated:
            said = ""
        names = workspace.names[shown], workspace.names[reference]
        table = errors_table(found, names[1], said)
        self._page.send(
            {"kind": "tables", "tables": {"errors": table}},
            {"kind": "scores", "text": errors_line(table, *names)},
        )

    def _on_export(self, *, format: str) -> None:  # noqa: A002 - its name on the page
        if format not in EXPORTS:
            message = f"exports are {', '.join(EXPORTS)}; got {format!r}"
            raise InputError(message)
        if self._shown is None:
            message = "nothing is selected: click a pixel before exporting"
            raise InputError(message)
        self._page.send({"kind": "working", "text": f"exporting {format}"})
        images = dict(zip(self._workspace.names, self._means, strict=True))
        work = partial(exported, format, self._shown, images, self._exposure, self._map())
        self._page.run(self._workspace.exports, work, self._exported)

    def _on_pause(self) -> None:
        """Stop drawing more samples of the selected pixel, or go on."""
        self._paused = not self._paused
        self._tell_live()
        self._draw_more()

    def _on_visible(self, *, on: bool) -> None:
        """Note whether the page is visible, and so needs its map."""
        self._visible = bool(on)
        self._want()
        self._draw_more()

    def _on_goodness(self) -> None:
        """Test the fits of the active place, which takes seconds, and send the progress."""
        plots = self._shown
        if plots is None or self._is_new:
            message = "nothing is selected: click a pixel before testing its fits"
            raise InputError(message)

        def work(check: Check) -> Table:
            def step(share: float) -> None:
                check()
                self._page.next(
                    _guarded(check, self._page.send, {"kind": "goodness", "share": share})
                )

            return self._results.goodness(plots, step)

        self._add("goodness", work)

    def _on_near(self, *, y: int, x: int) -> None:
        """Read the pixels around the pointer, and compute what a click on it would show.

        A click ends this work at its next step; what is known of the pixel by then is kept.
        """
        y, x, workspace = int(y), int(x), self._workspace
        check_pixel(y, x, *self._size)
        stores = [one for one in workspace.sources if isinstance(one, StoreSource)]
        self._guessed = view = self.view.pick(y, x)

        def step() -> None:
            if view is not self._guessed or workspace.is_urgent:
                raise _Stopped

        def guess(_: object) -> None:
            with suppress(_Stopped, ChdstatError):
                step()
                self._results.guess(view, step)

        def read() -> None:
            for store in stores:
                store.pixel(y, x)

        with suppress(RuntimeError):  # the explorer is closing
            reading = workspace.exports.submit(read)
            if not any(isinstance(one, SceneSource) for one in workspace.sources):
                reading.add_done_callback(partial(_submitted, workspace.clicks, guess))

    # --- what they change -----------------------------------------------------------------------

    def _go(self, view: View) -> None:
        """Show the selection at once, and its results when they are computed."""
        self.view = view
        self._show_view()
        self._waited = self._seq
        self._compute()

    def _heard(self, what: str) -> None:
        """Show news of the passes over the image, or of the source."""
        if what == "working":
            self._page.send({"kind": "working", "text": self._workspace.passes.working})
        elif what == "start" and (failed := self._workspace.passes.failures.get(what)):
            self._page.alert(failed)
        elif what == "suggested":
            self._page.send({"kind": "suggested", "pixels": self._workspace.suggested})
        elif what == "drawn" or what.startswith("errors "):
            self._want_errors()
        elif what == "image":
            self._show_image()
            self._show_histogram()
            self._show_view()
            self._show_map()
        elif what == "source":
            self._want()
            self._describe()
            self._show_view()
            self._compute()
        elif what == self._workspace.key(self.view):
            self._show_map()

    def _describe(self) -> None:
        texts = [source.describe() for source in self._workspace.sources]
        sampled = any(not isinstance(source, ImageSource) for source in self._workspace.sources)
        self._page.send({"kind": "described", "texts": texts, "samples": sampled})

    def _show_view(self) -> None:
        view = {"view": asdict(self.view), "query": self.view.query(), "exposure": self._exposure}
        view["images"] = self.view.of_images(len(self._workspace.sources))
        colors = mark_colors(len(self._workspace.sources))
        self._page.send({"kind": "view", **view, "colors": colors})

    @property
    def _exposure(self) -> float:
        """Exposure of the image, in stops."""
        exposure = self.view.exposure
        return self._workspace.overalls[0].exposure if exposure is None else exposure

    @property
    def _means(self) -> list[Any]:
        """Mean radiance of the images, shape (y, x, channel)."""
        means = [overall.mean for overall in self._workspace.overalls]
        # Parts without samples yet have no error.
        return [m if np.isfinite(m).any() else np.zeros_like(m) for m in means]

    def _coarse(self) -> list[str]:
        """Return the images for the HTML of the page, as PNG files in base64."""
        look = self._exposure, self.view.tone, self.view.gamma
        return [coarse_png(isolated(m, self.view.channel), *look) for m in self._means]

    def _show_image(self) -> None:
        """Show the images; while they are made, only the latest request is kept."""
        self._image_is_old = True
        if self._makes_image:
            return
        self._image_is_old, self._makes_image = False, True
        look = self._exposure, self.view.tone, self.view.gamma
        means, channel = self._means, self.view.channel

        def work() -> list[tuple[Any, Any]]:
            return [(rgba(isolated(mean, channel), *look), mean) for mean in means]

        self._page.run(self._workspace.images, work, self._made_image)

    def _made_image(self, future: Future[list[tuple[Any, Any]]]) -> None:
        for i, (packed, mean) in enumerate(future.result()):
            self._page.show_image(i, packed, mean)
        self._makes_image = False
        if self._image_is_old:
            self._show_image()

    def _map(self) -> Map | None:
        """Return what there is of the map, as it is shown."""
        found = None if self.view.overlay == "image" else self._workspace.map(self.view)
        if found is None:
            return None
        cmap = self.view.signed if found.diverging else self.view.cmap
        limits = self.view.limits if self.view.brush is None else None
        return replace(found, ends=limits or found.ends, cmap=cmap)

    def _show_map(self) -> None:
        """Show the finished part of the map and its progress, or remove the map."""
        said = self._refused
        found = None if said else self._map()
        if self.view.overlay != "image" and not said and (found is None or found.done < 1):
            passes, key = self._workspace.passes, self._workspace.key(self.view)
            share = passes.shares.get(key)
            done = "being computed" if share is None else f"{100 * share:.0f} %"
            said = f"{map_of_view(self.view).title}: {passes.failures.get(key, done)}"
        told = ""
        if found is not None and self.view.brush is not None:
            told, found = found.note, replace(found, note="")
        self._page.show_map(found, self.view.of_images(len(self._workspace.sources))[0])
        bar = {"kind": "colorbar", "bar": colorbar(found), "said": said}
        self._page.send(bar, {"kind": "brushed", "text": told})

    def _show_histogram(self) -> None:
        """Show the histogram of the images as far as they are read."""
        named = dict(zip(self._workspace.names, self._workspace.overalls, strict=True))
        panel = image_panel(self.view, named, self._workspace.sources[0].channels)
        notes = {"image": list(panel.notes)}
        self._page.send({"kind": "histogram", **encode_panels({"image": panel}), "notes": notes})

    def _exported(self, future: Future[tuple[str, bytes]]) -> None:
        self._page.send({"kind": "working", "text": ""})
        if error := future.exception():
            self._page.alert(f"the export failed: {error}")
            return
        name, content = future.result()
        data = base64.b64encode(content).decode("ascii")
        kind = EXPORTS[name.rpartition(".")[2]]
        self._page.send({"kind": "file", "name": name, "type": kind, "data": data})

    # --- results of the selection ---------------------------------------------------------------

    def _compute(self) -> None:
        """Compute the results of the view, for the command that waits for them."""
        self._generation += 1
        self._is_new = True
        self._workspace.urgent(1)
        view, seq = self.view, self._waited

        def work(check: Check) -> Found:
            try:
                return self._found(view, seq, check)
            finally:
                self._workspace.urgent(-1)

        self._start(self._workspace.clicks, work, partial(self._finished, seq, time.perf_counter()))

    def _found(self, view: View, seq: int, check: Check) -> Found:
        """Compute results in the thread of clicks; send the panels before there are tables."""
        check()

        def show(plots: SelectionPlots) -> None:
            notes = {name: list(panel.notes) for name, panel in plots.panels.items()}
            drawn = {**encode_panels(plots.panels), "notes": notes, "legend": plots.legend}
            spp = min(place.spp for place in plots.places)
            drawn["names"] = self._workspace.names
            drawn |= {"seq": seq, "batch": plots.view.batch, "most": spp // BATCHES}
            self._page.next(_guarded(check, self._page.send, {"kind": "panels", **drawn}))

        return self._results.results(view, show)

    def _found_with_more(self, source: SceneSource, view: View, check: Check) -> Found:
        """Sample the active pixel for a while, then compute the results again."""
        start = time.monotonic()
        while time.monotonic() - start < _LOOK and not self._paused:
            check()
            if source.more(*view.pixels[view.active]).shape[1] >= MOST_SPP:
                break
        return self._found(view, _OWN_ACCORD, check)

    def _check(self) -> Check:
        """Return a function that raises `_Stopped` once there is a newer selection."""
        generation = self._generation

        def check() -> None:
            if generation != self._generation:
                raise _Stopped

        return check

    def _start(
        self, pool: Executor, work: Callable[[Check], T], finish: Callable[[Future[T]], None]
    ) -> None:
        """Work in another thread, then finish in the page's, while the selection is the same."""
        check = self._check()
        self._page.run(pool, partial(work, check), _guarded(check, finish))

    def _finished(self, seq: int, start: float, future: Future[Found]) -> None:
        done = {"kind": "done", "seq": seq, "took": 0.0}
        if seq == self._waited:
            self._waited = _OWN_ACCORD
        if error := future.exception():
            self._alert(error)
            self._page.send({**done, "failed": f"The samples could not be read: {error}"})
            return
        found, self._is_new = future.result(), False
        done["took"] = time.perf_counter() - start
        self._shown = self._live_spp = None
        if found is None:
            self._page.send({"kind": "live", "shown": False}, done)
            return
        plots, tables, quick = found
        self._shown, self._live_spp = plots, plots.live_spp
        numbers, label = headline(plots.place), why(plots.place)
        shown = {"kind": "headline", "numbers": numbers, "label": label, "title": plots.title}
        self._page.send(shown, {"kind": "tables", "tables": tables}, done)
        self._tell_live()
        self._draw_more()
        if plots.live_spp is None or self._paused:  # else it changes all the time
            work = partial(self._results.slow_estimates, plots, quick)
            self._page.next(_guarded(self._check(), self._add, "estimates", work), _PAUSE)

    def _add(self, name: str, work: Callable[[Check], Table]) -> None:
        """Compute a table that takes longer than a click may, and show it."""

        def add(future: Future[Table]) -> None:
            if error := future.exception():
                self._alert(error)
            else:
                self._page.send({"kind": "tables", "tables": {name: future.result()}})

        self._start(self._workspace.additions, work, add)

    def _draw_more(self) -> None:
        """Draw more samples of the active pixel, unless paused, hidden, or done."""
        spp, plots = self._live_spp, self._shown
        if self._paused or not self._visible or spp is None or spp >= MOST_SPP or plots is None:
            return
        assert isinstance(plots.source, SceneSource)
        self._live_spp = None  # until the plots are here
        finish = partial(self._finished, _OWN_ACCORD, time.perf_counter())
        work = partial(self._found_with_more, plots.source, self.view)
        self._start(self._workspace.clicks, work, finish)

    def _tell_live(self) -> None:
        if self._shown is None or self._shown.live_spp is None:
            self._page.send({"kind": "live", "shown": False})
            return
        spp = self._shown.live_spp
        of = "" if self._paused else f" of {MOST_SPP:,}"
        text = f"{spp:,} samples{of}".replace(",", " ")
        state = {"share": spp / MOST_SPP, "text": text, "paused": self._paused}
        self._page.send({"kind": "live", "shown": True, **state})

    def _alert(self, error: BaseException) -> None:
        text = str(error)
        if not isinstance(error, ChdstatError):
            _log.error("the explorer failed", exc_info=error)
            text = f"{type(error).__name__}: {error}"
        self._page.alert(text)


def _submitted(pool: Executor, work: Callable[[object], None], read: Future[None]) -> None:
    """Work on what was read in another thread."""
    with suppress(RuntimeError, CancelledError):  # the explorer is closing
        if read.exception() is None:
            pool.submit(work, read)


def _guarded(check: Check, action: Callable[..., None], *first: Any) -> Callable[..., None]:
    """Return an action that does nothing once there is a newer selection."""

    def act(*further: Any) -> None:
        with suppress(_Stopped):
            check()
            action(*first, *further)

    return act
