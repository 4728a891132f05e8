"""Crew: who draws the chunks of a render, the threads of this process or workers of a cluster."""

from __future__ import annotations

import contextlib
import functools
import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._interrupts import Interrupts
from chdstat._renderer import Job, Renderer
from chdstat._store import Chunk
from chdstat._workers import cores
from chdstat.backend import activate

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["rendered"]

Image = npt.NDArray[np.float32]


def rendered(
    job: Job, renderer: Renderer, chunks: Sequence[Chunk], client: Client | None
) -> Iterator[tuple[Chunk, Image]]:
    """Yield chunks with their samples, in the order they are done.

    Ctrl-C ends it with KeyboardInterrupt once no thread is at work any more.
    """
    if client is not None:
        remote = client.get_executor(pure=False)
        window = 2 * max(1, sum(client.ncores().values()))
        yield from _collect(lambda c: remote.submit(_render_remote, job, c), chunks, window)
        return
    with (
        Interrupts() as interrupts,
        _workers(job) as workers,
        ThreadPoolExecutor(workers) as pool,
    ):
        draw = functools.partial(renderer.chunk, before_pass=interrupts.before_pass)
        try:
            yield from _collect(lambda c: pool.submit(draw, c), chunks, workers + 1)
        finally:
            interrupts.stop()


@contextlib.contextmanager
def _workers(job: Job) -> Iterator[int]:
    """Yield how many chunks to render at once, with Mitsuba's own threads set to match.

    A scalar pass is too short to be shared among threads: one chunk per core, each pass in the
    thread that asked for it, keeps the caches warm. A wavefront uses all cores by itself.
    """
    if job.verdict.backend != "scalar":
        yield 1
        return
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield cores()
    finally:
        dr.set_thread_count(before)


def _collect(
    submit: Callable[[Chunk], Future[Image]],
    chunks: Sequence[Chunk],
    window: int,
) -> Iterator[tuple[Chunk, Image]]:
    """Keep at most `window` chunks in flight, so that memory stays bounded."""
    waiting = iter(chunks)
    running: dict[Future[Image], Chunk] = {submit(c): c for c in itertools.islice(waiting, window)}
    try:
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), future.result()
            for chunk in itertools.islice(waiting, len(done)):
                running[submit(chunk)] = chunk
    finally:
        for future in running:
            future.cancel()


_REMOTE: dict[tuple[Any, ...], Renderer] = {}
"""The last renderer of a worker process: building a scene costs more than a chunk."""
_REMOTE_LOCK = threading.Lock()


def _render_remote(job: Job, chunk: Chunk) -> Image:
    """Render one chunk in a Dask worker."""
    with activate(job.verdict), _REMOTE_LOCK:
        if job.key not in _REMOTE:
            _REMOTE.clear()
            _REMOTE[job.key] = Renderer(job)
        # One at a time: a pass uses all cores, and Mitsuba's signal handler is not reentrant.
        return _REMOTE[job.key].chunk(chunk)
