"""Worker: computes what a page shows of its selection, in the thread of clicks.

Panels are shown while tables are still computed; only the newest selection is worked on. Slow
estimates follow after a pause. A pixel of a scene gets more samples for as long as it is selected.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from typing import Any

from chdstat.errors import ChdstatError, InputError
from chdstat.explorer.exports import Shown
from chdstat.explorer.images import MOST_SPP, SceneSource
from chdstat.explorer.page import PageConnection, encode_panels
from chdstat.explorer.selection import SelectionPlots, SelectionResults, SelectionTables
from chdstat.explorer.shared import Shared, Stopped
from chdstat.explorer.view import View

__all__ = ["Worker"]

_log = logging.getLogger("chdstat")

_PAUSE = 250
"""Milliseconds without a click before slow estimators begin."""
_LOOK = 0.4
"""Seconds of sampling between two updates of a pixel that is looked at."""
_OWN_ACCORD = -1
"""Instead of the number of a command, where an update follows from none."""

Found = tuple[SelectionPlots, SelectionTables] | None


class Worker:
    """Computes results of the selection and sends them to the page.

    Parameters
    ----------
    shared
        Sources and threads.
    connection
        Of the page.

    Attributes
    ----------
    shown
        What the page shows now; None for nothing.
    """

    def __init__(self, shared: Shared, connection: PageConnection) -> None:
        self._shared, self._connection = shared, connection
        self._results = SelectionResults(shared)
        self.shown: Shown | None = None
        self._view = View()
        self._plots: SelectionPlots | None = None
        self._generation = 0
        self._live_spp: int | None = None
        self._paused = False
        self._visible = True

    def compute(self, view: View, seq: int = _OWN_ACCORD) -> None:
        """Compute what a view shows; `seq` is the number of the command."""
        self._generation += 1
        self._plots = None
        self._view = view
        self._shared.urgent(1)

        def work() -> Found:
            try:
                return self._found(view, generation)
            finally:
                self._shared.urgent(-1)

        generation = self._generation
        if not self._submit(work, generation, seq):
            self._shared.urgent(-1)

    def pause(self) -> None:
        """Stop to draw more samples of what is looked at, or go on."""
        self._paused = not self._paused
        self._tell_live()
        self._look_on()

    def see(self, visible: bool) -> None:
        """Take note of whether anyone can see the page."""
        self._visible = visible
        self._look_on()

    def try_fits(self) -> None:
        """Test the fits of the active place, which takes seconds; tell how far it is.

        Raises
        ------
        InputError
            If nothing is selected.
        """
        plots, generation = self._plots, self._generation
        if plots is None or not plots.shown.places:
            message = "nothing is selected: click a pixel before testing its fits"
            raise InputError(message)

        def step(share: float) -> None:
            if generation != self._generation:
                raise Stopped
            self._connection.next(
                partial(self._connection.send, {"kind": "goodness", "share": share})
            )

        work = partial(self._results.goodness, plots, step)
        self._add_later(work, "goodness", generation)

    def close(self) -> None:
        """Drop what is being worked on."""
        self._generation += 1

    # --- in the thread of clicks ----------------------------------------------------------------

    def _found(self, view: View, generation: int) -> Found:
        """Compute what a view shows, panels before tables; None where a newer one is waiting."""
        if generation != self._generation:
            return None
        plots = self._results.plots(view)
        if plots.shown.places:
            self._connection.next(partial(self._draw, _drawn(plots), generation))
        return plots, self._results.describe(plots)

    def _found_with_more(self, view: View, generation: int) -> Found:
        """Draw samples of the active pixel for a while, then draw again."""
        source, start = self._shared.source, time.monotonic()
        assert isinstance(source, SceneSource)
        y, x = view.pixels[view.active]
        while time.monotonic() - start < _LOOK and not self._paused:
            if generation != self._generation:
                return None
            if source.more(y, x).shape[1] >= MOST_SPP:
                break
        return self._found(view, generation)

    # --- in the page's own thread ---------------------------------------------------------------

    def _submit(self, work: Callable[[], Found], generation: int, seq: int) -> bool:
        start = time.perf_counter()
        try:
            future = self._shared.clicks.submit(work)
        except RuntimeError:  # the explorer is closing
            return False
        finish = partial(self._finished, generation=generation, seq=seq, start=start)
        future.add_done_callback(lambda f: self._connection.next(partial(finish, f)))
        return True

    def _draw(self, drawn: Mapping[str, Any], generation: int) -> None:
        if generation == self._generation:
            self._connection.send(drawn)

    def _finished(self, future: Future[Found], *, generation: int, seq: int, start: float) -> None:
        if future.cancelled() or generation != self._generation:
            return
        done = {"kind": "done", "seq": seq}
        if error := future.exception():
            self._connection.alert(_explained(error))
            self._connection.send({**done, "took": 0})
            return
        found = future.result()
        if found is None:
            return
        plots, quick = found
        done["took"] = time.perf_counter() - start
        self._plots = plots
        self.shown = plots.shown if plots.shown.places else None
        self._connection.send(
            *([{"kind": "tables", "tables": quick.tables}] if self.shown else []), done
        )
        self._live_spp = plots.live_spp
        self._tell_live()
        self._look_on()
        self._add_estimates(plots, quick, generation)

    def _add_estimates(
        self, plots: SelectionPlots, quick: SelectionTables, generation: int
    ) -> None:
        """Add what takes longer than a click may, after a pause."""
        if not plots.shown.places or plots.live_spp is not None:
            return  # nothing is selected, or what is selected changes all the time

        def step() -> None:
            if generation != self._generation:
                raise Stopped

        def begin() -> None:
            if generation == self._generation:
                work = partial(self._results.slow_estimates, plots, quick, step)
                self._add_later(work, "estimates", generation)

        self._connection.later(begin, _PAUSE)

    def _add_later(self, work: Callable[[], dict[str, Any]], name: str, generation: int) -> None:
        """Compute a table in another thread, and show it if the selection is still the same."""

        def add(future: Future[dict[str, Any]]) -> None:
            if future.cancelled() or generation != self._generation:
                return
            error = future.exception()
            if error is None:
                self._connection.send({"kind": "tables", "tables": {name: future.result()}})
            elif not isinstance(error, Stopped):
                self._connection.alert(_explained(error))

        with contextlib.suppress(RuntimeError):  # the explorer is closing
            future = self._shared.additions.submit(work)
            future.add_done_callback(lambda f: self._connection.next(partial(add, f)))

    def _look_on(self) -> None:
        """Draw more samples of the active pixel, unless paused, hidden, or done."""
        spp = self._live_spp
        if self._paused or not self._visible or spp is None or spp >= MOST_SPP:
            return
        self._live_spp = None  # until the plots are here
        generation = self._generation
        work = partial(self._found_with_more, self._view, generation)
        self._submit(work, generation, _OWN_ACCORD)

    def _tell_live(self) -> None:
        if not isinstance(self._shared.source, SceneSource):
            return
        if (spp := self._live_spp) is None:
            if not self._view.pixels:
                self._connection.send({"kind": "live", "shown": False})
            return
        text = f"{spp:,} of {MOST_SPP:,} samples".replace(",", " ")
        state = {"share": spp / MOST_SPP, "text": text, "paused": self._paused}
        self._connection.send({"kind": "live", "shown": True, **state})


def _drawn(plots: SelectionPlots) -> dict[str, Any]:
    notes = {name: list(panel.notes) for name, panel in plots.panels.items()}
    return {
        "kind": "panels",
        **encode_panels(plots.panels),
        "notes": notes,
        "legend": plots.legend,
    }


def _explained(error: BaseException) -> str:
    if isinstance(error, ChdstatError):
        return str(error)
    _log.error("the explorer could not answer", exc_info=error)
    return f"{type(error).__name__}: {error}"
