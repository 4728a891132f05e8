"""Workers: the same function on many pieces at once, one thread for each core of the machine.

NumPy lets go of Python's lock while it computes, so that threads, which share memory, are enough.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from chdstat.errors import InputError

__all__ = ["cores", "in_order", "memory"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def memory() -> int | None:
    """Return the memory of the machine, or of the container, in bytes; None where none tells."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return None
    limit = _container_limit()
    return total if limit is None else min(limit, total)


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


def _container_limit() -> int | None:
    try:
        text = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None
