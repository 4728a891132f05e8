"""Passes: long work over the image, the latest request first, in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator

from chdstat.errors import ChdstatError

_EVERY = 0.4
"""Seconds between two reports."""

Pass = Iterator[tuple[str, float]]
"""After each step, what is being done, and the share that is done."""


class Passes:
    """The passes that somebody waits for, and the thread that works on them.

    Parameters
    ----------
    busy
        Whether something more urgent is being worked on: passes stand still meanwhile.
    tell
        Called with the name of a pass now and then while it goes on, and at its end; then with
        "working".

    Attributes
    ----------
    working
        What is being done, as text; empty for nothing.
    shares
        By the name of a pass that has begun, the share that is done.
    failures
        By the name of a pass, why it ended early.

    Examples
    --------
    >>> ended = threading.Event()
    >>> passes = Passes(lambda: False, lambda what: ended.set() if what == "map" else None)
    >>> passes.ask("page", "map", iter([("mapping", 0.5), ("mapping", 1.0)]))
    >>> ended.wait(10)
    True
    >>> passes.stop()
    """

    def __init__(self, busy: Callable[[], bool], tell: Callable[[str], None]) -> None:
        self._busy, self._tell = busy, tell
        self._work: dict[str, Pass] = {}
        self._asked: dict[Hashable, str] = {}
        self._stopping, self._told = False, 0.0
        self.working, self.shares, self.failures = "", dict[str, float](), dict[str, str]()
        self._changed = threading.Condition()
        threading.Thread(target=self._run, name="chdstat-passes", daemon=True).start()

    def ask(self, who: Hashable, name: str, work: Pass, *, patient: bool = False) -> None:
        """Let somebody wait for a pass, instead of what they waited for before.

        `work` is taken where the pass has not begun. What is patient waits for all others.
        """
        with self._changed:
            self._asked.pop(who, None)
            self._asked = {who: name, **self._asked} if patient else {**self._asked, who: name}
            self._work.setdefault(name, work)
            self.failures.pop(name, None)
            self._changed.notify()

    def leave(self, who: Hashable) -> None:
        """Let somebody wait no more."""
        with self._changed:
            self._asked.pop(who, None)

    @property
    def idle(self) -> bool:
        """Whether nobody waits for a pass."""
        with self._changed:
            return not any(name in self._work for name in self._asked.values())

    def drop(self, kind: str) -> None:
        """Drop the passes that nobody waits for, of names that begin alike."""
        with self._changed:
            waited = set(self._asked.values())
            for name in [n for n in self._work if n.startswith(kind) and n not in waited]:
                del self._work[name]
                self.shares.pop(name, None)

    def forget(self) -> None:
        """Drop all passes, begun or not."""
        with self._changed:
            self._work.clear()
            self.shares.clear()
            self.failures.clear()
            self._asked.clear()

    def stop(self) -> None:
        """End the thread after the step that it is at."""
        with self._changed:
            self._stopping = True
            self._changed.notify()

    def _run(self) -> None:
        while (latest := self._latest()) is not None:
            name, work = latest
            while self._busy() and not self._stopping:
                time.sleep(0.005)
            try:
                text, share = next(work)
            except StopIteration:
                self._end(name, work)
            except ChdstatError as error:
                self._end(name, work, str(error))
            except Exception as error:  # noqa: BLE001 - told to who waits; the next pass goes on
                self._end(name, work, f"{type(error).__name__}: {error}")
            else:
                self.shares[name] = share
                if time.monotonic() - self._told >= _EVERY:
                    self._told = time.monotonic()
                    self._say(f"{text}, {100 * share:.0f} %", name)

    def _latest(self) -> tuple[str, Pass] | None:
        """Wait for something to do; return None at the end."""
        with self._changed:
            while not self._stopping:
                for name in reversed(self._asked.values()):
                    if name in self._work:
                        return name, self._work[name]
                if self.working:
                    self._say("")
                self._changed.wait()
            return None

    def _end(self, name: str, work: Pass, why: str = "") -> None:
        with self._changed:
            if self._work.get(name) is work:
                del self._work[name]
                self.shares.pop(name, None)
            self._asked = {who: asked for who, asked in self._asked.items() if asked != name}
            if why:
                self.failures[name] = why
        self._tell(name)

    def _say(self, text: str, name: str = "") -> None:
        self.working = text
        for what in (name, "working"):
            self._tell(what)
