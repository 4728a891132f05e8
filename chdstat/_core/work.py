"""Long work: threads or a Dask cluster, and interrupts.

NumPy releases Python's lock while it computes, so that one thread per core, with shared memory, is
enough. With a Dask client, the workers of a cluster replace the threads. Ctrl-C ends the work in
all threads and is never lost.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import signal
import threading
import warnings
from asyncio import CancelledError as AsyncCancelledError
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextvars import copy_context
from multiprocessing import resource_tracker
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

from chdstat._core.arrays import Result
from chdstat._core.progress import portion
from chdstat.errors import ClusterError, InputError

if TYPE_CHECKING:
    from distributed import Client

# Functions of the signal module may only be called in the main thread.
_get_handler = ctypes.pythonapi.PyOS_getsig
_get_handler.argtypes, _get_handler.restype = [ctypes.c_int], ctypes.c_void_p
_set_handler = ctypes.pythonapi.PyOS_setsig
_set_handler.argtypes, _set_handler.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_void_p


class Interrupted(Exception):  # noqa: N818 - like KeyboardInterrupt, for which it stands
    """A pass was cancelled, by Mitsuba or before it began; its samples are worthless."""


class Interrupts:
    """A context in which Ctrl-C stops passes; the former handler is called at its end.

    It prevents two problems. KeyboardInterrupt may be raised anywhere, even while threads are
    waited for, and passes that nobody waits for hang the next render. And a scalar pass replaces
    Python's handler by one of Mitsuba's, which on Ctrl-C cancels the pass, restores the handler
    that it replaced, and calls that. If passes run in several threads, one of them would restore
    Mitsuba's handler, and the signal would be lost. So `before_pass` restores Python's handler
    first.
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
        """Raise `Interrupted` if no pass may begin; call it in the thread that renders."""
        _set_handler(signal.SIGINT, self._handler)
        if self._stopped.is_set():
            raise Interrupted

    def stop(self) -> None:
        """Allow no further passes."""
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


_Item = TypeVar("_Item")


def finished(work: Generator[Any, None, Result]) -> Result:
    """Do all steps of some work, and return its result.

    Examples
    --------
    >>> def work():
    ...     yield "half of it is done"
    ...     return 42
    >>> finished(work())
    42
    """
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: Result = end.value
            return result


def cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def memory() -> int | None:
    """Return the memory of the machine or container in bytes; None if it is unknown."""
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
    """Refuse work that needs more memory than the machine has, before it begins.

    Raises
    ------
    InputError
        If more bytes are needed than there are in all; less may still fail.

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
    function: Callable[[_Item], Result],
    items: Iterable[_Item],
    *,
    workers: int | None = None,
    client: Client | None = None,
    advance: Callable[[float], None] | None = None,
    size: Callable[[_Item], float] = lambda _: 1.0,
) -> Iterator[Result]:
    """Yield the results of a function in the order of its items, computed by `workers` threads.

    About as many results wait for their turn, so that memory stays bounded. An exception of the
    function is raised in place of its result, and no further work begins. With a Dask client, its
    workers compute instead of threads. `advance` gets the sizes of items that are done; in threads,
    those of portions within them, too.

    Raises
    ------
    ClusterError
        If the client's cluster is lost, or fails `_check_workers`.

    Examples
    --------
    >>> list(in_order(abs, [-1, 2, -3], workers=2))
    [1, 2, 3]
    """

    def counted(item: _Item) -> Result:
        with portion(size(item), advance):
            return function(item)

    waiting: deque[tuple[float, Future[Result]]] = deque()

    def first() -> Result:
        amount, future = waiting.popleft()
        result = at_work.result(future)
        if advance is not None and client is not None:
            advance(amount)
        return result

    with pool(workers, client) as at_work:
        try:
            for item in items:
                given = (function,) if client is not None else (copy_context().run, counted)
                waiting.append((size(item), at_work.submit(*given, item)))
                if len(waiting) > at_work.window:
                    yield first()
            while waiting:
                yield first()
        finally:
            for _, future in waiting:
                future.cancel()


# --- clusters -----------------------------------------------------------------------------------

_PATIENCE = 6
"""Seconds to wait for a scheduler, its first worker, or a replacement of its last worker."""
_VERSIONED = ("chdstat", "mitsuba", "numpy", "scipy")
"""Packages whose versions affect results."""
_LOST = (
    "the Dask cluster was lost while it worked; what is stored is kept: start it again, or work "
    "here, with the same command to resume"
)


class Pool:
    """Workers: threads of this process, or those of a cluster.

    Attributes
    ----------
    window
        Pieces of work to keep under way.
    """

    def __init__(self, executor: Executor, window: int, client: Client | None = None) -> None:
        self._executor, self.window, self._client = executor, window, client

    def submit(
        self, function: Callable[..., Result], *arguments: Any, **options: Any
    ) -> Future[Result]:
        """Begin a piece of work."""
        return self._executor.submit(function, *arguments, **options)

    def result(self, future: Future[Result]) -> Result:
        """Return the result of a piece of work when it is done."""
        self.first_done([future])
        return future.result()

    def first_done(self, futures: Collection[Future[Result]]) -> set[Future[Result]]:
        """Return the futures that are done, at least one, unless nothing works on them."""
        while not (
            done := wait(futures, None if self._client is None else _PATIENCE, FIRST_COMPLETED).done
        ):
            if self._client is not None:
                _wait_for_workers(self._client)
        return done


@contextlib.contextmanager
def pool(workers: int | None = None, client: Client | None = None) -> Iterator[Pool]:
    """Yield threads, one per core if `workers` is None, or the workers of a cluster.

    Raises
    ------
    ClusterError
        If the cluster is lost while the context lasts, or fails `_check_workers`. Futures of Dask
        raise no error of their own when their scheduler dies; they are cancelled.
    """
    if client is None:
        workers = workers or cores()
        threads = ThreadPoolExecutor(workers, thread_name_prefix="chdstat")
        try:
            yield Pool(threads, workers)
        finally:
            threads.shutdown(wait=True, cancel_futures=True)
        return
    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    try:
        _check_workers(client)
        window = 2 * max(1, sum(client.ncores().values()))
        with warnings.catch_warnings():
            # Samples in memory have to be sent.
            warnings.filterwarnings("ignore", "Sending large graph")
            yield Pool(client.get_executor(pure=False), window, client)
    except KilledWorker as error:
        message = (
            "workers of the Dask cluster were killed again and again by the same piece of work: "
            "most likely they have too little memory; give them more, or fewer threads"
        )
        raise ClusterError(message) from error
    except (CancelledError, AsyncCancelledError, CommClosedError) as error:
        raise ClusterError(_LOST) from error


@contextlib.contextmanager
def client_of(scheduler: str | None, workers: int | None) -> Iterator[Client | None]:
    """Yield a client of a Dask scheduler, or of local workers, or None.

    Raises
    ------
    InputError
        If both are given, or there is no scheduler at the address.
    """
    if scheduler is None and workers is None:
        yield None
        return
    if scheduler is not None and workers is not None:
        message = "workers are started here, a scheduler has its own; give one of them"
        raise InputError(message)
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors come as such
    address: Any = scheduler
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            threads = {"n_workers": workers, "threads_per_worker": 1}
            quiet = {"dashboard_address": ":0", "silence_logs": logging.CRITICAL}
            with _unheard_by_children():
                address = stack.enter_context(LocalCluster(**threads, **quiet))
        try:
            client = Client(address, timeout=_PATIENCE)
        except (OSError, ValueError) as error:
            message = f"cannot reach a Dask scheduler at {scheduler}: {error}"
            raise InputError(message) from error
        yield stack.enter_context(client)


@contextlib.contextmanager
def _unheard_by_children() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which a terminal sends to all of them.

    Here, Ctrl-C is handled when the context ends: a cluster that is interrupted while it starts may
    never end, and its workers would print tracebacks.
    """
    with Interrupts():
        if not hasattr(signal, "pthread_sigmask"):
            yield
            return
        resource_tracker.ensure_running()  # it would clear the mask, which processes inherit
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _check_workers(client: Client) -> None:
    """Refuse a cluster without workers, or with workers of other versions.

    Raises
    ------
    ClusterError
        If there are none within a few seconds, or their versions differ from those here.
    """
    _wait_for_workers(client)
    versions = client.get_versions(packages=list(_VERSIONED))
    ours = versions["client"]["packages"]
    for address, worker in versions["workers"].items():
        theirs = worker["packages"]
        differing = [n for n in _VERSIONED if theirs.get(n) != ours.get(n)]
        if differing:
            detail = ", ".join(f"{n} {theirs.get(n)}, here {ours.get(n)}" for n in differing)
            message = (
                f"the Dask worker at {address} has other versions ({detail}), with which results "
                "differ; install the same ones there"
            )
            raise ClusterError(message)


def _wait_for_workers(client: Client) -> None:
    if client.status in ("closed", "closing"):
        raise ClusterError(_LOST)
    try:
        client.wait_for_workers(1, timeout=_PATIENCE)
    except TimeoutError as error:
        address = client.scheduler.address if client.scheduler is not None else "its address"
        message = (
            f"the Dask scheduler at {address} has no workers after {_PATIENCE} seconds; "
            f"start some with: dask worker {address}"
        )
        raise ClusterError(message) from error
