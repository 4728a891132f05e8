"""Inquiry: what a page asks about its selection, answered in the thread of clicks.

Panels are shown while tables are still computed; only the newest selection is worked on. After a
pause comes what is too slow for a click. A pixel of a scene gets more samples while one looks.
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
from chdstat.explorer.page import Wire, cargo
from chdstat.explorer.selection import Answer, Answers, Told
from chdstat.explorer.shared import Shared, Stopped
from chdstat.explorer.view import View

__all__ = ["Inquiry"]

_log = logging.getLogger("chdstat")

_PAUSE = 250
"""Milliseconds without a click before slow estimators begin."""
_LOOK = 0.4
"""Seconds of sampling between two updates of a pixel that is looked at."""
_OWN_ACCORD = -1
"""Instead of the number of a command, where a page is told what it did not ask for."""

Found = tuple[Answer, Told] | None


class Inquiry:
    """Asks, and shows what there is to say.

    Parameters
    ----------
    shared
        Sources and threads.
    wire
        Of the page.

    Attributes
    ----------
    shown
        What the page shows now; None for nothing.
    """

    def __init__(self, shared: Shared, wire: Wire) -> None:
        self._shared, self._wire = shared, wire
        self._answers = Answers(shared)
        self.shown: Shown | None = None
        self._view = View()
        self._answer: Answer | None = None
        self._generation = 0
        self._live_spp: int | None = None
        self._paused = False
        self._visible = True

    def ask(self, view: View, seq: int = _OWN_ACCORD) -> None:
        """Find what there is to say about a view; `seq` is the number of the command."""
        self._generation += 1
        self._answer = None
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
        answer, generation = self._answer, self._generation
        if answer is None or not answer.shown.places:
            message = "nothing is selected: click a pixel before testing its fits"
            raise InputError(message)

        def step(share: float) -> None:
            if generation != self._generation:
                raise Stopped
            self._wire.next(partial(self._wire.say, {"kind": "fitness", "share": share}))

        work = partial(self._answers.fitness, answer, step)
        self._add_later(work, "fitness", generation)

    def close(self) -> None:
        """Drop what is being worked on."""
        self._generation += 1

    # --- in the thread of clicks ----------------------------------------------------------------

    def _found(self, view: View, generation: int) -> Found:
        """Compute what a view shows, panels before tables; None where a newer one is waiting."""
        if generation != self._generation:
            return None
        answer = self._answers.answer(view)
        if answer.shown.places:
            self._wire.next(partial(self._draw, _drawn(answer), generation))
        return answer, self._answers.told(answer)

    def _found_with_more(self, view: View, generation: int) -> Found:
        """Draw samples of the active pixel for a while, then answer again."""
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
        answered = partial(self._answered, generation=generation, seq=seq, start=start)
        future.add_done_callback(lambda f: self._wire.next(partial(answered, f)))
        return True

    def _draw(self, drawn: Mapping[str, Any], generation: int) -> None:
        if generation == self._generation:
            self._wire.say(drawn)

    def _answered(self, future: Future[Found], *, generation: int, seq: int, start: float) -> None:
        if future.cancelled() or generation != self._generation:
            return
        done = {"kind": "done", "seq": seq}
        if error := future.exception():
            self._wire.alert(_explained(error))
            self._wire.say({**done, "took": 0})
            return
        found = future.result()
        if found is None:
            return
        answer, told = found
        done["took"] = time.perf_counter() - start
        self._answer = answer
        self.shown = answer.shown if answer.shown.places else None
        self._wire.say(*([{"kind": "tables", "tables": told.tables}] if self.shown else []), done)
        self._live_spp = answer.live_spp
        self._tell_live()
        self._look_on()
        self._think_on(answer, told, generation)

    def _think_on(self, answer: Answer, told: Told, generation: int) -> None:
        """Add what takes longer than a click may, after a pause."""
        if not answer.shown.places or answer.live_spp is not None:
            return  # nothing is selected, or what is selected changes all the time

        def step() -> None:
            if generation != self._generation:
                raise Stopped

        def begin() -> None:
            if generation == self._generation:
                work = partial(self._answers.afterthought, answer, told, step)
                self._add_later(work, "estimates", generation)

        self._wire.later(begin, _PAUSE)

    def _add_later(self, work: Callable[[], dict[str, Any]], name: str, generation: int) -> None:
        """Compute a table apart from clicks, and show it if the selection is still the same."""

        def add(future: Future[dict[str, Any]]) -> None:
            if future.cancelled() or generation != self._generation:
                return
            error = future.exception()
            if error is None:
                self._wire.say({"kind": "tables", "tables": {name: future.result()}})
            elif not isinstance(error, Stopped):
                self._wire.alert(_explained(error))

        with contextlib.suppress(RuntimeError):  # the explorer is closing
            future = self._shared.thoughts.submit(work)
            future.add_done_callback(lambda f: self._wire.next(partial(add, f)))

    def _look_on(self) -> None:
        """Draw more samples of the active pixel, unless paused, hidden, or done."""
        spp = self._live_spp
        if self._paused or not self._visible or spp is None or spp >= MOST_SPP:
            return
        self._live_spp = None  # until the answer is here
        generation = self._generation
        work = partial(self._found_with_more, self._view, generation)
        self._submit(work, generation, _OWN_ACCORD)

    def _tell_live(self) -> None:
        if not isinstance(self._shared.source, SceneSource):
            return
        if (spp := self._live_spp) is None:
            if not self._view.pixels:
                self._wire.say({"kind": "live", "shown": False})
            return
        text = f"{spp:,} of {MOST_SPP:,} samples".replace(",", " ")
        told = {"share": spp / MOST_SPP, "text": text, "paused": self._paused}
        self._wire.say({"kind": "live", "shown": True, **told})


def _drawn(answer: Answer) -> dict[str, Any]:
    notes = {name: list(panel.notes) for name, panel in answer.panels.items()}
    return {"kind": "panels", **cargo(answer.panels), "notes": notes, "legend": answer.legend}


def _explained(error: BaseException) -> str:
    if isinstance(error, ChdstatError):
        return str(error)
    _log.error("the explorer could not answer", exc_info=error)
    return f"{type(error).__name__}: {error}"
