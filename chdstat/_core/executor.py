"""Threads, interrupts and progress of long work.

One function runs on many pieces at once, one thread for each core: NumPy releases Python's lock
while it computes, so threads, which share memory, are enough. Ctrl-C ends the work in all threads
and is never lost. One progress bar shows rate and time left on the terminal's error stream; a log
gets a line every ten seconds if progress is asked for, and nothing otherwise.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TypeVar

from chdstat._core.display import duration
from chdstat.errors import InputError

if TYPE_CHECKING:
    from rich.progress import ProgressColumn, Task
    from rich.text import Text

__all__ = ["Interrupted", "Interrupts", "check_memory", "cores", "in_order", "memory", "track"]

_LINE_EVERY = 10.0
"""Seconds between two lines of progress where no terminal is attached."""

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

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
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


Item = TypeVar("Item")
Result = TypeVar("Result")


def cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def memory() -> int | None:
    """Return the memory of the machine, or of the container, in bytes; None where it is unknown."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return None
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return total
    return min(int(limit), total) if limit.isdecimal() else total


def check_memory(needed: float, what: str, advice: str) -> None:
    """Refuse what the memory of the machine cannot hold, in words and before the work.

    Raises
    ------
    InputError
        If more bytes are needed than there are in all; more than that would not be known to fail.

    Examples
    --------
    >>> check_memory(1e18, "the samples", "use fewer")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    chdstat.errors.InputError: the samples take 1e+09 GB of memory, of which there are ...
    """
    there = memory()
    if there is not None and needed > there:
        message = (
            f"{what} take {needed / 1e9:.3g} GB of memory, of which there are {there / 1e9:.3g}; "
            f"{advice}"
        )
        raise InputError(message)


def in_order(
    function: Callable[[Item], Result], items: Iterable[Item], *, workers: int | None = None
) -> Iterator[Result]:
    """Yield the results of a function in the order of its items, `workers` of them at work.

    No more than `workers` results wait for their turn, so that memory stays bounded. An exception
    of the function is raised where its result would be; nothing new is begun after it.

    Examples
    --------
    >>> list(in_order(abs, [-1, 2, -3], workers=2))
    [1, 2, 3]
    """
    workers = workers or cores()
    pool = ThreadPoolExecutor(workers, thread_name_prefix="chdstat")
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def track(
    description: str,
    total: float,
    *,
    unit: str = "it",
    show: bool | None = None,
    line_every: float = _LINE_EVERY,
) -> Iterator[Callable[[float], None]]:
    """Show the progress of a piece of work while the context lasts.

    Parameters
    ----------
    description
        What is being done, a few words.
    total
        How much there is to do, in `unit`.
    unit
        What is counted; the rate is shown in it per second.
    show
        Show the progress, as a bar if the error stream is a terminal and as lines otherwise; None
        draws the bar only.
    line_every
        Seconds between two lines.

    Yields
    ------
    callable
        Call it with the amount done since the last call.

    Examples
    --------
    >>> with track("counting", 3, show=False) as advance:
    ...     for _ in range(3):
    ...         advance(1)
    """
    terminal = sys.stderr.isatty()
    if not (terminal if show is None else show):
        yield lambda _: None
        return
    if not terminal:
        with _lines(description, total, line_every) as advance:
            yield advance
        return
    from rich import progress as bars
    from rich.console import Console

    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.TaskProgressColumn(),
        _rate_column(unit),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(description, total=total)
        yield lambda amount: bar.advance(task, amount)


_PAUSE = 1.0
"""Seconds without work after which new work begins."""
_line_before = _ended = -math.inf
"""When the last line of progress was written, and when work ended: work of many short pieces has
lines, too."""


@contextlib.contextmanager
def _lines(description: str, total: float, every: float) -> Iterator[Callable[[float], None]]:
    """Write a line of progress now and then while the context lasts, also where work stands."""
    global _line_before, _ended
    start, ended, done = time.monotonic(), threading.Event(), 0.0
    if start > _ended + _PAUSE:
        _line_before = start

    def advance(amount: float) -> None:
        nonlocal done
        done += amount

    def write() -> None:
        global _line_before
        while not ended.wait(max(0, _line_before + every - time.monotonic())):
            _line_before = time.monotonic()
            share, passed = done / total if total else 1.0, duration(max(1, _line_before - start))
            sys.stderr.write(f"{description}: {share:.0%} after {passed}\n")
            sys.stderr.flush()

    writer = threading.Thread(target=write, name="chdstat-progress", daemon=True)
    writer.start()
    try:
        yield advance
    finally:
        ended.set()
        writer.join()
        _ended = time.monotonic()


def _rate_column(unit: str) -> ProgressColumn:
    """Return a rich column that shows the speed as 1.2 M unit/s."""
    from rich.filesize import pick_unit_and_suffix
    from rich.progress import ProgressColumn
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            if speed is None:
                return Text("")
            scale, suffix = pick_unit_and_suffix(int(speed), ["", "k", "M", "G"], 1000)
            return Text(f"{speed / scale:.2f} {suffix}{unit}/s")

    return Rate()
