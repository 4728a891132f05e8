"""Workers that render chunks: the threads of this process, or the workers of a cluster."""

from __future__ import annotations

import contextlib
import functools
import itertools
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from chdstat._core.arrays import Image
from chdstat._core.work import Interrupts, Pool, cores, pool
from chdstat.errors import RenderError, StoreError
from chdstat.rendering.backend import activate, one_thread
from chdstat.rendering.jobs import Job, in_python
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.rendering.seeds import grouped
from chdstat.samples.layout import differing
from chdstat.samples.store import reopened
from chdstat.samples.tiles import Chunk

if TYPE_CHECKING:
    from distributed import Client

    from chdstat.samples.store import Store

Group = tuple[Chunk, Sequence[Chunk]]
"""Samples that are drawn together, and the chunks in which they are stored."""
Drawn = Sequence[tuple[Chunk, Image | None]]
"""Chunks with their samples; None for chunks that are already stored."""


def rendered(
    renderer: MitsubaRenderer,
    chunks: Iterable[Chunk],
    client: Client | None = None,
    store: Store | None = None,
) -> Generator[tuple[Chunk, Image | None], None, None]:
    """Yield chunks with their samples, in the order in which they are done.

    Workers of a cluster write directly to a `store` that they see; None is yielded instead of the
    samples. Ctrl-C raises KeyboardInterrupt once no thread is at work any more.
    """
    job = renderer.job
    groups = grouped(chunks, job.sequences)
    if client is None:
        with Interrupts() as interrupts, at_once(job) as workers, pool(workers) as threads:
            draw = functools.partial(_samples_of, renderer, before_pass=interrupts.before_pass)
            try:
                yield from _collect(lambda g: threads.submit(draw, g), groups, threads)
            finally:
                interrupts.stop()
        return
    identity, place = renderer.identity, None if store is None else store.place
    with pool(client=client) as cluster:
        yield from _collect(
            lambda g: cluster.submit(render_remote, job, identity, place, g), groups, cluster
        )


def _samples_of(
    renderer: MitsubaRenderer, group: Group, **options: Any
) -> list[tuple[Chunk, Image]]:
    """Return the samples of chunks that are drawn together."""
    whole, (one, *others) = group
    block, first = renderer.chunk(whole, **options), whole.ss.start
    parts = [replace(one, costs=renderer.costs), *others]
    return [(c, block[..., c.ss.start - first : c.ss.stop - first]) for c in parts]


@contextlib.contextmanager
def at_once(job: Job) -> Iterator[int]:
    """Yield how many chunks to render at once, with Mitsuba's own threads set to match.

    A scalar pass is too short to share among threads: one chunk per core, with each pass in its
    calling thread, keeps the caches warm. A wavefront uses all cores by itself.
    """
    if job.backend.name != "scalar":
        yield 1
        return
    built = job.built_integrator
    alone = built is not None and in_python(built)
    with one_thread():
        yield 1 if alone else cores()  # a class in Python may keep what it draws with


def _collect(
    submit: Callable[[Group], Future[Drawn]], groups: Iterator[Group], at_work: Pool
) -> Iterator[tuple[Chunk, Image | None]]:
    """Keep a bounded number of chunks in flight, so that memory stays bounded."""
    running = {submit(group) for group in itertools.islice(groups, at_work.window + 1)}
    try:
        while running:
            for future in at_work.first_done(running):
                running.remove(future)
                yield from future.result()
                running.update(map(submit, itertools.islice(groups, 1)))
    finally:
        for future in running:
            future.cancel()


# --- workers of a cluster -----------------------------------------------------------------------

_REMOTE: dict[tuple[Any, ...], MitsubaRenderer] = {}
"""The last renderer of a worker process: building a scene costs more than a chunk."""
_REMOTE_LOCK = threading.Lock()


def render_remote(
    job: Job, identity: dict[str, Any], place: tuple[Any, ...] | None, group: Group
) -> Drawn:
    """Render chunks in a Dask worker, after checking that its scene is the client's.

    The chunks are written to the store, if there is one and this worker sees it.
    """
    with _remote(job, identity) as renderer:
        drawn = _samples_of(renderer, group)
        store = None
        if place is not None:
            with contextlib.suppress(StoreError):
                store = reopened(*place)
        if store is None:
            return drawn
        for chunk, block in drawn:
            store.put(chunk, block)
        return [(chunk, None) for chunk, _ in drawn]


def features_remote(job: Job, identity: dict[str, Any]) -> tuple[Mapping[str, Image], str]:
    """Render first-hit features in a Dask worker, after checking that its scene is the client's."""
    with _remote(job, identity) as renderer:
        return renderer.features()


@contextlib.contextmanager
def _remote(job: Job, identity: dict[str, Any]) -> Iterator[MitsubaRenderer]:
    """Yield the renderer of this worker, in one thread at a time.

    A pass uses all cores, and Mitsuba's signal handler is not reentrant.
    """
    options = job.options | {"spp": 1}  # any number of samples takes the same renderer
    parts = identity["scene_hash"], identity["scene_code"], options, job.backend, job.light
    key = (str(parts), job.film, job.plugins, job.guide and job.guide.digest)
    with activate(job.backend), _REMOTE_LOCK:
        if key not in _REMOTE:
            _REMOTE.clear()
            _limit_threads()
            renderer = MitsubaRenderer(job)
            _check_same(identity, renderer.identity)
            _REMOTE[key] = renderer
        yield _REMOTE[key]


def _limit_threads() -> None:
    """Let Mitsuba use as many threads as this worker has, if it is a process of its own."""
    import drjit as dr
    from distributed import get_worker

    with contextlib.suppress(ValueError):  # outside a worker
        worker = get_worker()
        if worker.nanny is not None:
            dr.set_thread_count(worker.state.nthreads)


def _check_same(here: dict[str, Any], there: dict[str, Any]) -> None:
    """Refuse a worker whose files or plugins differ from the client's."""
    parts = ("scene_files", "scene_code")
    names = [name for part in parts for name in sorted(differing(here[part], there[part]))]
    if here["scene_hash"] != there["scene_hash"] or names:
        message = (
            f"a Dask worker reads another scene than is read here ({', '.join(names[:5])} "
            "differ); give it the same files and plugins, and start it again"
        )
        raise RenderError(message)
