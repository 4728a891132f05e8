"""Cost: how long an estimator takes, and how much memory while it works.

Both are measured on one part of a picture, outside of any comparison: the first call warms up and
is traced for memory, the next ones are timed. A comparison that is timed while it runs would count
what else the machine does.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Cost", "measure_cost"]

_TIMED = 2
"""Calls that are timed; the fastest counts, as others only add to it."""
_STATM = Path("/proc/self/statm")
_WATCH_SECONDS = 1e-3


@dataclass(frozen=True)
class Cost:
    """What estimating costs.

    Attributes
    ----------
    time
        Seconds for each estimate, that is, for each channel of a pixel.
    peak_memory
        Bytes held at most beyond the samples, with the estimates themselves: what Python and NumPy
        allocate, or, where that is more, the growth of resident memory (for PyTorch, on Linux).
    estimates
        How many estimates were asked for at once.
    """

    time: float
    peak_memory: int
    estimates: int


def measure_cost(
    function: Callable[[npt.ArrayLike], npt.NDArray[Any]], samples: npt.NDArray[np.floating[Any]]
) -> Cost:
    """Measure an estimator on samples, shape (..., sample).

    Examples
    --------
    >>> cost = measure_cost(lambda x: np.mean(x, axis=-1), np.ones((100, 100, 3, 8)))
    >>> cost.estimates, cost.peak_memory >= 8 * 30000, 0 < cost.time < 1e-3
    (30000, True, True)
    """
    with _traced() as traced:
        estimates = int(np.size(function(samples)))
    with _watched() as grown:
        seconds = min(_timed(function, samples) for _ in range(_TIMED))
    return Cost(seconds / estimates, max(traced(), grown()), estimates)


def _timed(
    function: Callable[[npt.ArrayLike], npt.NDArray[Any]], samples: npt.NDArray[np.floating[Any]]
) -> float:
    start = time.perf_counter()
    function(samples)
    return time.perf_counter() - start


@contextlib.contextmanager
def _traced() -> Iterator[Callable[[], int]]:
    """Yield a function that says how many bytes were held at most beyond those of the start.

    Whoever traces already goes on tracing, with the peak reset.
    """
    running = tracemalloc.is_tracing()
    if running:
        tracemalloc.reset_peak()
    else:
        tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    found = [0]
    try:
        yield lambda: found[0]
    finally:
        found[0] = max(0, tracemalloc.get_traced_memory()[1] - before)
        if not running:
            tracemalloc.stop()


@contextlib.contextmanager
def _watched() -> Iterator[Callable[[], int]]:
    """Yield a function that says by how many bytes resident memory grew at most.

    It is looked at from time to time: memory that was free to begin with is not seen to be used,
    so that this is a lower bound. Where the system does not tell, it is 0.
    """
    before, done = _resident(), threading.Event()
    seen = [before]

    def watch() -> None:
        while not done.wait(_WATCH_SECONDS):
            seen[0] = max(seen[0], _resident())

    watcher = threading.Thread(target=watch, name="chdstat-memory", daemon=True)
    watcher.start()
    try:
        yield lambda: seen[0] - before
    finally:
        done.set()
        watcher.join()


def _resident() -> int:
    if not _STATM.is_file():
        return 0
    return int(_STATM.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
