"""Interrupts: Ctrl-C ends a render in several threads, all of them, and is never lost."""

from __future__ import annotations

import ctypes
import signal
import threading
from types import FrameType, TracebackType

__all__ = ["Interrupted", "Interrupts"]

# Those of the signal module may be called in the main thread only.
_get_handler = ctypes.pythonapi.PyOS_getsig
_get_handler.argtypes, _get_handler.restype = [ctypes.c_int], ctypes.c_void_p
_set_handler = ctypes.pythonapi.PyOS_setsig
_set_handler.argtypes, _set_handler.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_void_p


class Interrupted(Exception):  # noqa: N818 - like KeyboardInterrupt, for which it stands
    """A pass was cancelled, by Mitsuba or before it began; its samples are worthless."""


class Interrupts:
    """While it is entered, Ctrl-C stops passes; its own handler is called once it is left.

    Two things would go wrong without it. KeyboardInterrupt may be raised anywhere, also where
    threads are waited for, and passes that nobody waits for hang the next render. And a scalar pass
    puts a handler of Mitsuba's in the place of Python's: on Ctrl-C that one cancels the pass, puts
    back what the pass had found, and has it called, too. Of passes in several threads one would
    find Mitsuba's, and the signal be lost: so `before_pass` has each of them find Python's.
    """

    def __enter__(self) -> Interrupts:
        self._stopped = threading.Event()
        self._caught: tuple[int, FrameType | None] | None = None
        self._before = signal.getsignal(signal.SIGINT)
        self._defers = (
            callable(self._before) and threading.current_thread() is threading.main_thread()
        )
        if self._defers:
            signal.signal(signal.SIGINT, self._note)
        self._handler = _get_handler(signal.SIGINT)
        return self

    def before_pass(self) -> None:
        """Raise `Interrupted` if no pass shall begin; to be called in the thread that renders."""
        _set_handler(signal.SIGINT, self._handler)
        if self._stopped.is_set():
            raise Interrupted

    def stop(self) -> None:
        """Let no pass begin any more."""
        self._stopped.set()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        _set_handler(signal.SIGINT, self._handler)
        if self._defers:
            signal.signal(signal.SIGINT, self._before)
        if self._caught and callable(self._before):
            self._before(*self._caught)
        if self._caught or isinstance(error, Interrupted):
            raise KeyboardInterrupt from error

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._caught = number, frame
        self._stopped.set()
