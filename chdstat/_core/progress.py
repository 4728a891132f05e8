"""Progress of long work: a bar with rate and time left on a terminal, lines where there is none.

A log gets a line every ten seconds if progress is asked for, and nothing otherwise.
"""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from chdstat._core.display import duration

if TYPE_CHECKING:
    from rich.progress import ProgressColumn, Task
    from rich.text import Text

__all__ = ["track"]

_LINE_EVERY = 10.0
"""Seconds between two lines of progress where no terminal is attached."""


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
