"""Progress of long work: one bar, with rate and time left, on the terminal's error stream.

Where no terminal is attached nothing is drawn, so logs stay clean.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import ProgressColumn, Task
    from rich.text import Text

__all__ = ["track"]


@contextlib.contextmanager
def track(
    description: str, total: float, *, unit: str = "it", show: bool | None = None
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
        Draw the bar; None draws it if the error stream is a terminal.

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
    if show is False or (show is None and not sys.stderr.isatty()):
        yield lambda _: None
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
