"""Progress: how much of long work is done, in a terminal, a notebook or a log.

`track` counts a piece of work, and shows a bar in a terminal or a notebook, and elsewhere a line
every ten seconds. Work within work shares that bar or line. `portion` counts parts of a piece that
a thread computes at once, such as a tile.
"""

from __future__ import annotations

import contextlib
import html
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from chdstat._core.display import duration, percent

if TYPE_CHECKING:
    from rich.progress import ProgressColumn, Task
    from rich.text import Text

_LINE_EVERY = 10.0
"""Seconds between two lines of progress, and before the first one."""
_BAR_EVERY = 1.0
"""Seconds between two states of a notebook's bar, and before the first one."""
_PAUSE = 1.0
"""Seconds without work after which new work begins."""


@dataclass(eq=False)
class _TrackedWork:
    """A piece of work: what it is, how much there is in all, and how much is done."""

    what: str
    total: float
    unit: str = "it"
    began: float = 0.0
    done: float = 0.0
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def share(self) -> float:
        """The share that is done, at most 1; 0 if the total is not known."""
        return min(self.done / self.total, 1.0) if self.total else 0.0


def _told(jobs: list[_TrackedWork], now: float) -> str:
    """Return what is being done, its share, and the time left.

    Examples
    --------
    >>> study = _TrackedWork("studying scenes", 8, began=0, done=2)
    >>> _told([study, _TrackedWork("rendering fog", 100, began=50, done=5)], now=60)
    'studying scenes: 25 %, about 3 min left; rendering fog: 5.0 %'
    """
    texts, is_left_told = [], False
    for job in jobs:
        passed = now - job.began
        text = job.what
        if job.total:
            text += f": {percent(job.share)}".replace("\N{NO-BREAK SPACE}", " ")
        if job.share and not is_left_told:
            left, is_left_told = passed * (1 / job.share - 1), True
            text += f", about {duration(round(left))} left" if left >= 1 else ", nearly done"
        texts.append(text)
    if not is_left_told:
        texts[-1] += f" after {duration(max(passed, 1))}"
    return "; ".join(texts)


class _Display(Protocol):
    """Shows the jobs under way from the first one's begin to the last one's end."""

    def begin(self, job: _TrackedWork) -> None: ...

    def advance(self, job: _TrackedWork, amount: float) -> None: ...

    def end(self, job: _TrackedWork) -> None: ...

    def close(self) -> None: ...


_silent: ContextVar[bool] = ContextVar("silent", default=False)
"""Whether work around this shows nothing; threads of a pool get it with their work."""


class _Here(threading.local):
    """What this thread computes."""

    portion: _Portion | None = None


_here = _Here()
_jobs: list[_TrackedWork] = []
"""The pieces of work under way, the outermost first."""
_display: _Display | None = None
_changing = threading.Lock()
_line_before = _ended = -float("inf")
"""When the last line of progress was written, and when work ended, so that many short pieces of
work have lines, too."""


@contextlib.contextmanager
def track(
    description: str, total: float, *, unit: str = "it", show: bool = True
) -> Iterator[Callable[[float], None]]:
    """Show the progress of a piece of work while the context lasts.

    Parameters
    ----------
    description
        What is being done, a few words.
    total
        Total amount, in `unit`; 0 if it is not known.
    unit
        What is counted; the rate is shown in units per second.
    show
        Show the progress: as a bar in a terminal or a notebook, elsewhere as a line every ten
        seconds. Where it is not shown, that of work within is not, either.

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
    if _silent.get():  # a generator within may end after what silences it
        yield lambda _: None
        return
    if not show:
        _silent.set(True)
        try:
            yield lambda _: None
        finally:
            _silent.set(False)
        return
    job = _TrackedWork(description, total, unit, time.monotonic())
    display = _begin(job)

    def advance(amount: float) -> None:
        with job.lock:
            job.done += amount
        display.advance(job, amount)

    try:
        yield advance
    finally:
        _end(job)


def _begin(job: _TrackedWork) -> _Display:
    """Add a job to those under way, and show it."""
    global _display
    with _changing:
        if _display is None:
            _display = _Html() if _in_notebook() else _Bars() if _in_terminal() else _Lines()
        _jobs.append(job)
        _display.begin(job)
        return _display


def _end(job: _TrackedWork) -> None:
    """Take a job from those under way; the display ends with the last one."""
    global _display, _ended
    with _changing:
        _jobs.remove(job)
        assert _display is not None, "a job is shown"
        _display.end(job)
        if not _jobs:
            _ended = time.monotonic()
            _display.close()
            _display = None


def _in_notebook() -> bool:
    """Return whether a Jupyter kernel runs this process."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


def _in_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()  # windowed programs have none


class _Timed:
    """A display that writes now and then, even if work stands still."""

    def __init__(self) -> None:
        self._over = threading.Event()
        self._writer = threading.Thread(target=self._run, name="chdstat-progress", daemon=True)
        self._writer.start()

    def begin(self, job: _TrackedWork) -> None:
        """Nothing is written before it is due."""

    def advance(self, job: _TrackedWork, amount: float) -> None:
        """Nothing is written before it is due."""

    def end(self, job: _TrackedWork) -> None:
        """Nothing is written before it is due."""

    def close(self) -> None:
        """Stop writing."""
        self._over.set()
        self._writer.join()

    def _run(self) -> None:
        while not self._over.wait(self._due()):
            # The list may change meanwhile; a writer that waits for its lock could not be joined.
            if jobs := [*_jobs]:
                self._write(jobs)

    def _due(self) -> float:
        """Return the seconds until the next writing."""
        raise NotImplementedError

    def _write(self, jobs: list[_TrackedWork]) -> None:
        raise NotImplementedError


class _Lines(_Timed):
    """Lines in a log; a line is due ten seconds after the one before, or after work began."""

    def __init__(self) -> None:
        global _line_before
        if time.monotonic() > _ended + _PAUSE:
            _line_before = time.monotonic()
        super().__init__()

    def _due(self) -> float:
        return max(0.0, _line_before + _LINE_EVERY - time.monotonic())

    def _write(self, jobs: list[_TrackedWork]) -> None:
        global _line_before
        _line_before = time.monotonic()
        with contextlib.suppress(OSError, ValueError, AttributeError):  # the log is gone
            sys.stderr.write(f"{_told(jobs, _line_before)}\n")
            sys.stderr.flush()


class _Html(_Timed):
    """A bar in a notebook, which goes when the work is done."""

    def __init__(self) -> None:
        self._shown: Any = None
        super().__init__()

    def close(self) -> None:
        super().close()
        if self._shown is not None:
            self._shown.update({"text/html": "", "text/plain": ""}, raw=True)

    def _due(self) -> float:
        return _BAR_EVERY

    def _write(self, jobs: list[_TrackedWork]) -> None:
        text = _told(jobs, time.monotonic())
        share = next((job.share for job in jobs if job.share), None)
        value = "" if share is None else f' value="{share:.4f}"'
        bar = f'<progress{value} style="vertical-align: middle"></progress>'
        content = {"text/html": f"<div>{bar} {html.escape(text)}</div>", "text/plain": text}
        if self._shown is None:
            self._shown = sys.modules["IPython"].display.display(content, raw=True, display_id=True)
        else:
            self._shown.update(content, raw=True)


class _Bars:
    """Bars in a terminal, the outermost job's first."""

    def __init__(self) -> None:
        from rich import progress as bars
        from rich.console import Console

        columns = (
            bars.TextColumn("{task.description}"),
            bars.BarColumn(),
            bars.TaskProgressColumn(),
            _rate_column(),
            bars.TimeRemainingColumn(),
        )
        self._bars = bars.Progress(*columns, console=Console(stderr=True))
        self._tasks: dict[_TrackedWork, Any] = {}
        self._bars.start()

    def begin(self, job: _TrackedWork) -> None:
        self._tasks[job] = self._bars.add_task(job.what, total=job.total or None, unit=job.unit)

    def advance(self, job: _TrackedWork, amount: float) -> None:
        self._bars.advance(self._tasks[job], amount)

    def end(self, job: _TrackedWork) -> None:
        task = self._tasks.pop(job)
        if self._tasks:  # what stays on the screen is the outermost bar
            self._bars.remove_task(task)

    def close(self) -> None:
        self._bars.stop()


def _rate_column() -> ProgressColumn:
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
            return Text(f"{speed / scale:.2f} {suffix}{task.fields['unit']}/s")

    return Rate()


# --- parts of a piece of work -------------------------------------------------------------------


@dataclass
class _Portion:
    """What a thread is computing: its size, and how much of it was counted."""

    advance: Callable[[float], None]
    size: float
    counted: float = 0.0


@contextlib.contextmanager
def portion(size: float, advance: Callable[[float], None] | None = None) -> Iterator[None]:
    """Count a part of the work of this thread: parts within it as they end, the rest at its end.

    Parameters
    ----------
    size
        What it counts: an amount with `advance`, otherwise a share of the part around it. Without
        any around it, nothing is counted.
    advance
        What `track` yields.

    Examples
    --------
    >>> counted = []
    >>> with portion(100, counted.append):
    ...     with portion(0.25):
    ...         pass
    >>> counted
    [25.0, 75.0]
    """
    around = _here.portion
    if advance is not None:
        own = _Portion(advance, size)
    elif around is not None:
        own = _Portion(around.advance, around.size * size)
    else:
        yield
        return
    _here.portion = own
    try:
        yield
        own.advance(own.size - own.counted)
        if advance is None and around is not None:
            around.counted += own.size
    finally:
        _here.portion = around
