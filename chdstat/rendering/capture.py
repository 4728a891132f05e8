"""Capture: a scene to samples, chunk by chunk, every sample kept.

`render` fills a store (or memory) and can be stopped and resumed at any moment; `render_batches`
hands the samples on as they are rendered and keeps none; `render_pixels` draws samples of a few
pixels on demand.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import whole
from chdstat._core.executor import memory, track
from chdstat._core.files import free_disk, unused
from chdstat.errors import InputError, RenderError, StoreError
from chdstat.rendering.backend import Backend, activate, resolve
from chdstat.rendering.live import Rendering
from chdstat.rendering.renderer import Job, Renderer, film_size, integrator_type
from chdstat.rendering.seeds import SEEDS, max_spp
from chdstat.rendering.workers import rendered
from chdstat.rendering.writers import MemorySink, Sink, StoreSink, existing_store, provenance
from chdstat.samples import store
from chdstat.samples.samples import Samples
from chdstat.samples.samples import open as open_samples
from chdstat.samples.store import DIRECT
from chdstat.scenes import Scene, load_scene
from chdstat.scenes.loading import LONGEST

if TYPE_CHECKING:
    from distributed import Client

__all__ = [
    "convert",
    "job_of",
    "refuse_render",
    "render",
    "render_batches",
    "render_pixels",
    "scene_integrator",
    "scene_size",
]

_log = logging.getLogger("chdstat")

_MOST_COMPRESSION = 10
"""Stores shrink to between a third and nine tenths; a tenth leaves room for darker scenes."""
_DIRECT_DEPTH = 2
"""Segments of a path from the camera to a light that shines on what it sees."""

_PROOF = 16
"""Samples of each pixel by which a store is known to be of a scene."""
_OF_SCENE = ("scene_hash", "scene_files", "scene_code", "sensor", "crop")
"""Attributes by which the same scene is known."""

Image = npt.NDArray[np.float32]


def render(
    scene: str | Path | dict[str, Any] | Scene,
    *,
    spp: int = 256,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    sensor: int = 0,
    direct: bool = False,
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
        An integer from 0 to 2^31 - 1; another one gives independent samples.
    max_depth
        Longest path in segments; None takes the scene's own.
    sensor
        Which of the scene's sensors sees the image, counted from 0.
    direct
        Render every sample once more with no more than two segments, for what is emission and
        direct light of it: `Samples.direct`. The rest is indirect. This takes a tenth more time in
        rooms, and more where paths are short anyway. An `out` that has it goes on with it.
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
    loaded, spp = load_scene(scene), whole("spp", spp, least=1)
    existing = existing_store(out)
    if existing is not None:
        direct = existing.direct() is not None or direct  # one of other samples is refused here
        backend = existing.attrs["backend"] if backend == "auto" else backend
        size = size or tuple(existing.attrs["size"])
    job = job_of(loaded, backend, size, seed, max_depth, sensor)
    with activate(job.verdict):
        renderer = Renderer(job)
        _check_streams(job, renderer, spp)
        _check_room(renderer.size, spp * (1 + direct), out)
        shorter = _shorter(job, renderer) if direct else None
        for note in renderer.notes:
            _log.warning("%s", note)
        attrs = provenance(job, renderer, spp)
        sink = (
            StoreSink.open(out, existing, attrs, renderer, spp)
            if out
            else MemorySink(attrs, renderer, spp)
        )
        if existing is not None and spp < existing.complete_spp() == existing.shape[3]:
            message = "nothing to render: %s holds %d samples per pixel, %d were asked for"
            _log.warning(message, out, existing.shape[3], spp)
        with contextlib.closing(sink):
            _fill(job, renderer, sink, client, progress)
            if shorter is None:
                return sink.finish()
            del renderer  # kernels are frozen where one scene is alive only
            return sink.finish(_direct(shorter, spp, out, client, progress))


def render_batches(
    scene: str | Path | dict[str, Any] | Scene,
    *,
    spp: int = 256,
    batch: int = 16,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    sensor: int = 0,
    backend: Backend = "auto",
    progress: bool | None = None,
) -> Rendering:
    """Render a scene batch by batch and keep nothing: memory is that of a batch.

    The samples are those of `render` with the same scene, backend and seed, to the bit.

    Parameters
    ----------
    scene, size, seed, max_depth, sensor, backend
        As for `render`.
    spp
        Samples per pixel in all.
    batch
        Samples per pixel in a batch; the last one may have fewer.
    progress
        Show a progress bar while batches are drawn; None shows it on a terminal.

    Returns
    -------
    Rendering
        To loop over: each turn renders a batch, shape (y, x, channel, sample), float32.

    Raises
    ------
    InputError
        If `spp`, `batch`, `size` or `seed` is out of range.
    SceneError, RenderError
        If the scene cannot be read, or not be rendered as asked.

    Examples
    --------
    >>> from chdstat.rendering.capture import render_batches
    >>> rendering = render_batches("cornell-box", spp=40, size=(8, 8), backend="scalar")
    >>> [batch.shape for batch in rendering]
    [(8, 8, 3, 16), (8, 8, 3, 16), (8, 8, 3, 8)]
    """
    spp, batch = whole("spp", spp, least=1), whole("batch", batch, least=1)
    job = job_of(scene, backend, size, seed, max_depth, sensor)
    with activate(job.verdict):
        renderer = Renderer(job)
    _check_streams(job, renderer, spp)
    _check_room(renderer.size, min(spp, batch), None)
    for note in renderer.notes:
        _log.warning("%s", note)
    return Rendering(job, renderer, spp=spp, batch=batch, progress=progress)


def render_pixels(
    scene: str | Path | dict[str, Any] | Scene,
    pixels: npt.ArrayLike,
    *,
    spp: int = 2048,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    sensor: int = 0,
    backend: Backend = "scalar",
) -> Image:
    """Draw samples of a few pixels, without rendering the rest of the image.

    Parameters
    ----------
    scene, size, seed, max_depth, sensor, backend
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
    spp = whole("spp", spp, least=1)
    job = job_of(scene, backend, size, seed, max_depth, sensor)
    with activate(job.verdict):
        renderer = Renderer(job)
        return renderer.pixels(_checked_pixels(pixels, renderer.size), spp)


def convert(
    old: str | Path,
    new: str | Path,
    *,
    scene: str | Path | dict[str, Any] | Scene | None = None,
    progress: bool | None = None,
) -> Samples:
    """Write the samples of a store of an earlier schema into a new one, with its direct part.

    Samples that only some pixels have are left out; a render that resumes draws them again.

    Parameters
    ----------
    old
        The store; it stays as it is.
    new
        Where to write; nothing may be there. It is there when it is complete.
    scene
        What `old` was rendered of, needed to append to `new` if that was an XML file: earlier
        versions told scenes apart by other files. The first samples of each pixel, 16 at most, are
        rendered again, and must be equal to the bit.
    progress
        Show a progress bar while they are; None shows it on a terminal.

    Returns
    -------
    Samples
        Those of the new store.

    Raises
    ------
    StoreError
        If `old` is damaged, of the present schema already or of another scene, or `new` is there
        or cannot be written.
    SceneError, RenderError
        If the scene cannot be read, or not be rendered as it was.
    """
    target = unused(new)
    told = {} if scene is None else _proved(open_samples(old), scene, progress)
    store.convert(Path(old), target, told)
    return open_samples(target)


def _proved(
    samples: Samples, scene: str | Path | dict[str, Any] | Scene, progress: bool | None
) -> dict[str, Any]:
    """Return what stores keep of a scene that gives these samples again, to the bit."""
    attrs = samples.attrs
    again = render(
        scene,
        spp=min(samples.spp, _PROOF),
        size=attrs["size"],
        seed=attrs.get("seed", 0),
        max_depth=attrs.get("integrator", {}).get("max_depth"),
        sensor=attrs.get("sensor", 0),
        backend=attrs.get("backend", "auto"),
        progress=progress,
    )
    if not np.array_equal(again.read(), samples.read(ss=slice(0, again.spp)), equal_nan=True):
        message = (
            f"{samples.path} holds other samples than {again.name!r} gives now; nothing was "
            "written. Give the scene as it was, or convert without one: what comes of it is read, "
            "but not appended to"
        )
        raise StoreError(message)
    return {name: again.attrs[name] for name in _OF_SCENE}


def scene_size(scene: str | Path | dict[str, Any] | Scene) -> tuple[int, int]:
    """Return the (width, height) in pixels that a scene's own film has.

    Examples
    --------
    >>> from chdstat.rendering.capture import scene_size
    >>> scene_size("cornell-box")
    (256, 256)
    """
    job = Job(load_scene(scene), resolve("scalar"))
    return film_size(job)


def scene_integrator(scene: str | Path | dict[str, Any] | Scene) -> str:
    """Return Mitsuba's name of the integrator that a scene asks for.

    Examples
    --------
    >>> from chdstat.rendering.capture import scene_integrator
    >>> scene_integrator("fog")
    'volpath'
    """
    return integrator_type(Job(load_scene(scene), resolve("scalar")))


def refuse_render(source: object, settings: Mapping[str, Any]) -> None:
    """Refuse settings of a render, by name, where samples are there already.

    What is None, and the backend "auto", was not asked for.

    Raises
    ------
    InputError
        If any was.
    """
    asked = [name for name, value in settings.items() if value not in (None, "auto")]
    if asked:
        message = (
            f"{', '.join(asked)}: a setting of a render, but {source} holds finished samples; "
            "leave it out, or give the scene"
        )
        raise InputError(message)


# --- checks -------------------------------------------------------------------------------------


def job_of(
    scene: str | Path | dict[str, Any] | Scene,
    backend: Backend,
    size: tuple[int, int] | None,
    seed: int,
    max_depth: int | None,
    sensor: int = 0,
) -> Job:
    """Return a job whose settings are checked, so that no work is done for wrong ones."""
    if size is not None:
        pair = isinstance(size, Sequence) and len(size) == 2
        if not pair:
            message = f"size must be (width, height) in pixels, got {size!r}"
            raise InputError(message)
        size = whole("width", size[0], least=1), whole("height", size[1], least=1)
        if max(size) > LONGEST:
            message = f"width and height must be at most {LONGEST} pixels, got {max(size):.4g}"
            raise InputError(message)
    if max_depth is not None:
        max_depth = whole("max_depth", max_depth, least=-1)
        if max_depth == 0:
            message = "max_depth must be at least 1 segment, or -1 for no limit, got 0"
            raise InputError(message)
    seed = whole("seed", seed, least=0)
    if seed >= SEEDS:
        message = f"seed must be below 2^31, the most that give samples of their own, got {seed}"
        raise InputError(message)
    sensor = whole("sensor", sensor, least=0)
    return Job(load_scene(scene), resolve(backend), size, seed, max_depth, sensor)


def _check_streams(job: Job, renderer: Renderer, spp: int) -> None:
    backend = job.verdict.backend
    most = max_spp(backend, *renderer.size)
    if spp <= most:
        return
    width, height = renderer.size
    message = (
        f"spp must be at most {most} for {width} x {height} pixels with the {backend} backend "
        f"(then its random streams repeat), got {spp}"
        if most
        else f"{width} x {height} pixels are more than the {backend} backend has random streams"
    )
    if backend == "scalar":
        more = max_spp("llvm", width, height)
        message += f"; the llvm and cuda backends draw up to {more}, see: chdstat doctor"
    raise InputError(message)


def _check_room(size: tuple[int, int], spp: int, out: str | Path | None) -> None:
    """Refuse samples that could never be kept, however well they compress."""
    needed = 12 * size[0] * size[1] * spp
    if out is None:
        there, where, advice = memory() or needed, "memory", "give a store to write to"
    else:
        free = free_disk(Path(out))
        there = needed if free is None else _MOST_COMPRESSION * free
        where, advice = "disk", "free some space"
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


def _shorter(job: Job, renderer: Renderer) -> Job:
    """Return the same job for emission and direct light alone.

    A sample of it is that of the whole but for the light that its path meets later: both draw the
    same random numbers in the same order.
    """
    longest = renderer.depth
    if longest is None:
        message = (
            f"integrator {renderer.integrator['type']!r} has no max_depth, so that direct light "
            "cannot be told apart; use one that has, such as path or volpath, or direct=False"
        )
        raise RenderError(message)
    depth = _DIRECT_DEPTH if longest < 0 else min(_DIRECT_DEPTH, longest)
    return replace(job, max_depth=depth)


# --- the work -----------------------------------------------------------------------------------


def _direct(
    job: Job, spp: int, out: str | Path | None, client: Client | None, progress: bool | None
) -> Samples:
    """Render the direct part, into a store within that of the samples or into memory."""
    renderer = Renderer(job)
    attrs = provenance(job, renderer, spp)
    sink: Sink
    if out is None:
        sink = MemorySink(attrs, renderer, spp, features=False)
    else:
        path = Path(out) / DIRECT
        sink = StoreSink.open(path, existing_store(path), attrs, renderer, spp, features=False)
    with contextlib.closing(sink):
        _fill(job, renderer, sink, client, progress)
        return sink.finish()


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
            for chunk, block in rendered(job, renderer, chunks, client):
                sink.write(chunk, block)
                advance(chunk.size)
        finally:
            sink.spent(time.monotonic() - start)
