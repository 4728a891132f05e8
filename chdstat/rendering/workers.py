"""Workers that render chunks: the threads of this process, or the workers of a cluster."""

from __future__ import annotations

import contextlib
import functools
import itertools
import threading
from asyncio import CancelledError as AsyncCancelledError
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any

from chdstat._core.executor import Interrupts, cores
from chdstat.errors import RenderError
from chdstat.rendering.backend import activate
from chdstat.rendering.instances import IntegratorObject
from chdstat.rendering.job import Job
from chdstat.rendering.renderer import Renderer
from chdstat.rendering.sequences import grouped
from chdstat.samples.layout import Chunk, Image, differing

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["rendered"]

_PATIENCE = 8
"""Seconds to wait for the first worker of a cluster."""
_VERSIONED = ("chdstat", "mitsuba")
"""Packages on whose version samples depend."""


def rendered(
    job: Job, renderer: Renderer, chunks: Sequence[Chunk], client: Client | None
) -> Iterator[tuple[Chunk, Image]]:
    """Yield chunks with their samples, in the order they are done.

    Ctrl-C ends it with KeyboardInterrupt once no thread is at work any more.
    """
    groups = list(grouped(chunks, job.sequences))
    together = [whole for whole, _ in groups]
    for number, block in _drawn(job, renderer, together, client):
        whole, parts = groups[number]
        for chunk in parts:
            first = chunk.ss.start - whole.ss.start
            yield chunk, block[..., first : first + chunk.shape[2]]


def _drawn(
    job: Job, renderer: Renderer, chunks: Sequence[Chunk], client: Client | None
) -> Iterator[tuple[int, Image]]:
    """Yield numbers of chunks with their samples, in the order they are done."""
    if client is not None:
        yield from _remotely(job, renderer.identity, chunks, client)
        return
    with Interrupts() as interrupts, _workers(job) as workers, ThreadPoolExecutor(workers) as pool:
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
        alone = isinstance(job.integrator, IntegratorObject) and job.integrator.in_python
        yield 1 if alone else cores()  # a class in Python may keep what it draws with
    finally:
        dr.set_thread_count(before)


def _collect(
    submit: Callable[[Chunk], Future[Image]], chunks: Sequence[Chunk], window: int
) -> Iterator[tuple[int, Image]]:
    """Keep at most `window` chunks in flight, so that memory stays bounded; yield their numbers."""
    waiting = enumerate(chunks)
    running = {submit(c): number for number, c in itertools.islice(waiting, window)}
    try:
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), future.result()
            for number, chunk in itertools.islice(waiting, len(done)):
                running[submit(chunk)] = number
    finally:
        for future in running:
            future.cancel()


# --- workers of a cluster -----------------------------------------------------------------------

_REMOTE: dict[tuple[Any, ...], Renderer] = {}
"""The last renderer of a worker process: building a scene costs more than a chunk."""
_REMOTE_LOCK = threading.Lock()


def _remotely(
    job: Job, identity: dict[str, Any], chunks: Sequence[Chunk], client: Client
) -> Iterator[tuple[int, Image]]:
    """Let the workers of a cluster draw chunks; what happens to it becomes an error that says so.

    Futures of Dask raise no error of their own when their scheduler dies; they are cancelled.
    """
    from distributed import KilledWorker

    try:
        _check_workers(client)
        remote = client.get_executor(pure=False)
        window = 2 * max(1, sum(client.ncores().values()))
        yield from _collect(
            lambda c: remote.submit(_render_remote, job, identity, c), chunks, window
        )
    except (CancelledError, AsyncCancelledError, KilledWorker, OSError) as error:
        message = (
            "the Dask cluster was lost while it rendered; what is stored is kept: start it again, "
            "or render here, with the same command to resume"
        )
        raise RenderError(message) from error


def _check_workers(client: Client) -> None:
    """Refuse a cluster that has no workers, or workers of other versions.

    Raises
    ------
    RenderError
        If there are none within a few seconds, or their versions differ from those here.
    """
    try:
        client.wait_for_workers(1, timeout=_PATIENCE)
    except TimeoutError as error:
        address = client.scheduler.address
        message = (
            f"the Dask scheduler at {address} has no workers after {_PATIENCE} seconds; "
            f"start some with: dask worker {address}"
        )
        raise RenderError(message) from error
    versions = client.get_versions(packages=list(_VERSIONED))
    ours = versions["client"]["packages"]
    for address, worker in versions["workers"].items():
        theirs = worker["packages"]
        differing = [n for n in _VERSIONED if theirs.get(n) != ours.get(n)]
        if differing:
            detail = ", ".join(f"{n} {theirs.get(n)}, here {ours.get(n)}" for n in differing)
            message = (
                f"the Dask worker at {address} has other versions ({detail}), with which samples "
                "differ; install the same ones there"
            )
            raise RenderError(message)


def _render_remote(job: Job, identity: dict[str, Any], chunk: Chunk) -> Image:
    """Render one chunk in a Dask worker, of the very scene that the client has."""
    key = (identity["scene_hash"], str(identity["scene_code"]), *job.settings)
    with activate(job.verdict), _REMOTE_LOCK:
        if key not in _REMOTE:
            _REMOTE.clear()
            renderer = Renderer(job)
            _check_same(identity, renderer.identity)
            _REMOTE[key] = renderer
        # One at a time: a pass uses all cores, and Mitsuba's signal handler is not reentrant.
        return _REMOTE[key].chunk(chunk)


def _check_same(here: dict[str, Any], there: dict[str, Any]) -> None:
    """Refuse a worker whose files or plugins are others than those of the client."""
    parts = ("scene_files", "scene_code")
    names = [name for part in parts for name in sorted(differing(here[part], there[part]))]
    if here["scene_hash"] != there["scene_hash"] or names:
        message = (
            f"a Dask worker reads another scene than is read here ({', '.join(names[:5])} "
            "differ); give it the same files and plugins, and start it again"
        )
        raise RenderError(message)
