"""Capture: a scene to samples, chunk by chunk, every sample kept.

`render` fills a store (or memory) and can be stopped and resumed at any moment; `render_pixels`
draws samples of a few pixels on demand.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._machine import free_disk, memory
from chdstat._renderer import Interrupted, Job, Renderer, film_size
from chdstat._sinks import MemorySink, Sink, StoreSink, existing_store, provenance
from chdstat._store import Chunk
from chdstat._streams import max_spp
from chdstat._workers import cores
from chdstat.backend import Backend, activate, resolve
from chdstat.errors import InputError
from chdstat.progress import track
from chdstat.samples import Samples
from chdstat.scenes import Scene, load_scene

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["render", "render_pixels", "scene_size"]

_log = logging.getLogger("chdstat")

_MOST_COMPRESSION = 10
"""Stores shrink to between a third and nine tenths; a tenth leaves room for darker scenes."""

Image = npt.NDArray[np.float32]


def render(
    scene: str | Path | dict[str, Any] | Scene,
    *,
    spp: int = 256,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    out: str | Path | None = None,
    backend: Backend = "auto",
    client: Client | None = None,
    progress: bool | None = None,
) -> Samples:
    """Render a scene and keep every sample.

    The samples of a chunk (a tile of pixels times a batch of samples) depend only on scene,
    backend, seed, tile and batch. So a render that was stopped resumes, more `spp` append, any
    worker may render any chunk, and the result is the same to the bit.

    Parameters
    ----------
    scene
        Anything that `chdstat.load_scene` takes.
    spp
        Samples per pixel. Where `out` holds fewer, the missing ones are appended.
    size
        (width, height) in pixels; None takes that of `out`, else the scene's own.
    seed
        Any non-negative integer; small seeds give independent images.
    max_depth
        Longest path in segments; None takes the scene's own.
    out
        Where to store the samples; None keeps them in memory.
    backend
        "auto" takes the fastest backend that has proved itself on this machine.
    client
        A Dask client; its workers render, one chunk a task.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    Samples
        All samples, with first-hit features and provenance.

    Raises
    ------
    InputError
        If `spp`, `size` or `seed` is out of range.
    SceneError, RenderError
        If the scene cannot be read, or not be rendered as asked.
    StoreError
        If `out` holds something else, or cannot be written to.

    Examples
    --------
    >>> import chdstat as chd
    >>> samples = chd.render("cornell-box", spp=2, size=(8, 8), backend="scalar")
    >>> samples
    <Samples 'cornell-box' 8 x 8 pixels, 3 channels, 2 spp, in memory>
    """
    loaded = load_scene(scene)
    _check(spp, size, seed)
    existing = existing_store(out)
    if existing is not None:
        backend = existing.attrs["backend"] if backend == "auto" else backend
        size = size or tuple(existing.attrs["size"])
    job = Job(loaded, resolve(backend), size, seed, max_depth)
    with activate(job.verdict):
        renderer = Renderer(job)
        _check_streams(job, renderer, spp)
        _check_room(renderer.size, spp, out)
        for note in renderer.notes:
            _log.warning("%s", note)
        attrs = provenance(job, renderer, spp)
        sink = (
            StoreSink.open(out, existing, attrs, renderer, spp)
            if out
            else MemorySink(attrs, renderer, spp)
        )
        _fill(job, renderer, sink, client, progress)
        return sink.finish()


def render_pixels(
    scene: str | Path | dict[str, Any] | Scene,
    pixels: npt.ArrayLike,
    *,
    spp: int = 2048,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    backend: Backend = "scalar",
) -> Image:
    """Draw samples of a few pixels, without rendering the rest of the image.

    Parameters
    ----------
    scene, size, seed, max_depth, backend
        As for `render`. The samples are independent of those that `render` draws.
    pixels
        (y, x) of each pixel, shape (pixel, 2); a single pair is taken as one pixel.
    spp
        Samples per pixel.

    Returns
    -------
    ndarray
        Linear radiance, shape (pixel, channel, sample), float32.

    Raises
    ------
    InputError
        If a pixel lies outside the image, or `spp` or `seed` is out of range.

    Examples
    --------
    >>> import chdstat as chd
    >>> chd.render_pixels("cornell-box", [(4, 4)], spp=16, size=(8, 8)).shape
    (1, 3, 16)
    """
    _check(spp, size, seed)
    job = Job(load_scene(scene), resolve(backend), size, seed, max_depth)
    with activate(job.verdict):
        renderer = Renderer(job)
        return renderer.pixels(_checked_pixels(pixels, renderer.size), spp)


def scene_size(scene: str | Path | dict[str, Any] | Scene) -> tuple[int, int]:
    """Return the (width, height) in pixels that a scene's own film has.

    Examples
    --------
    >>> from chdstat.capture import scene_size
    >>> scene_size("cornell-box")
    (256, 256)
    """
    job = Job(load_scene(scene), resolve("scalar"))
    return film_size(job)


# --- checks -------------------------------------------------------------------------------------


def _check(spp: int, size: tuple[int, int] | None, seed: int) -> None:
    if spp < 1:
        message = f"spp must be at least 1, got {spp}"
        raise InputError(message)
    if size is not None and (len(size) != 2 or min(size) < 1):
        message = f"size must be (width, height) in pixels, each at least 1, got {size}"
        raise InputError(message)
    if seed < 0:
        message = f"seed must not be negative, got {seed}"
        raise InputError(message)


def _check_streams(job: Job, renderer: Renderer, spp: int) -> None:
    most = max_spp(job.verdict.backend, *renderer.size)
    if spp > most:
        width, height = renderer.size
        message = (
            f"spp must be at most {most} for {width} x {height} pixels with the "
            f"{job.verdict.backend} backend (then its random streams repeat), got {spp}"
        )
        raise InputError(message)


def _check_room(size: tuple[int, int], spp: int, out: str | Path | None) -> None:
    """Refuse samples that could never be kept, however well they compress."""
    needed = 12 * size[0] * size[1] * spp
    if out is None:
        there, where, advice = memory() or needed, "memory", "give a store to write to"
    else:
        there, where, advice = _MOST_COMPRESSION * free_disk(Path(out)), "disk", "free some space"
    if needed > there:
        message = (
            f"{spp} samples for each of {size[0]} x {size[1]} pixels take {needed / 1e9:.3g} GB, "
            f"more than the {where} can hold; use fewer samples or pixels, or {advice}"
        )
        raise InputError(message)


def _checked_pixels(pixels: npt.ArrayLike, size: tuple[int, int]) -> npt.NDArray[np.intp]:
    array = np.atleast_2d(np.asarray(pixels))
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in "iu":
        message = f"pixels must be integers (y, x), shape (pixel, 2), got shape {array.shape}"
        raise InputError(message)
    width, height = size
    outside = (array < 0).any(axis=1) | (array[:, 0] >= height) | (array[:, 1] >= width)
    if outside.any():
        y, x = array[outside][0]
        message = f"pixel (y={y}, x={x}) is outside the image of {width} x {height} pixels"
        raise InputError(message)
    return array.astype(np.intp)


# --- the work -----------------------------------------------------------------------------------


def _fill(
    job: Job,
    renderer: Renderer,
    sink: Sink,
    client: Client | None,
    progress: bool | None,
) -> None:
    """Render what is missing, writing each chunk as it arrives."""
    chunks = sink.pending()
    if not chunks:
        return
    start = time.monotonic()
    with track(
        f"rendering {job.scene.name}", sum(c.size for c in chunks), unit="S", show=progress
    ) as advance:
        try:
            with _python_interrupts():
                for chunk, block in _rendered(job, renderer, chunks, client):
                    sink.write(chunk, block)
                    advance(chunk.size)
        finally:
            sink.spent(time.monotonic() - start)


@contextlib.contextmanager
def _python_interrupts() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, whatever Mitsuba does to the signal's handler.

    A scalar render puts a handler of its own in place that cancels a pass, and puts back what it
    found: of renders in several threads, one finds the handler of another, and Python's is lost.
    """
    try:
        yield
    except Interrupted as interrupted:
        raise KeyboardInterrupt from interrupted
    finally:
        if threading.current_thread() is threading.main_thread():
            handler = signal.getsignal(signal.SIGINT)
            if handler is not None:
                signal.signal(signal.SIGINT, handler)


def _rendered(
    job: Job, renderer: Renderer, chunks: Sequence[Chunk], client: Client | None
) -> Iterator[tuple[Chunk, Image]]:
    """Yield chunks with their samples, in the order they are done."""
    if client is not None:
        remote = client.get_executor(pure=False)
        window = 2 * max(1, sum(client.ncores().values()))
        yield from _collect(lambda c: remote.submit(_render_remote, job, c), chunks, window)
        return
    stop = threading.Event()
    draw = functools.partial(renderer.chunk, stopped=stop.is_set)
    with _workers(job) as workers, ThreadPoolExecutor(workers) as pool:
        try:
            yield from _collect(lambda c: pool.submit(draw, c), chunks, workers + 1)
        finally:
            stop.set()


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
