"""Capture: a scene to samples, chunk by chunk, every sample kept.

`render` fills a store (or memory) and can be stopped and resumed at any moment; `render_pixels`
draws samples of a few pixels on demand.
"""

from __future__ import annotations

import contextlib
import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, whole
from chdstat._core.executor import track
from chdstat.errors import InputError, RenderError
from chdstat.rendering.backend import Backend, activate
from chdstat.rendering.jobs import check_room, check_streams, job_of
from chdstat.rendering.renderer import Job, Renderer
from chdstat.rendering.workers import rendered
from chdstat.rendering.writers import (
    MemoryWriter,
    StoreWriter,
    Writer,
    existing_store,
    provenance,
)
from chdstat.samples import Samples
from chdstat.samples.layout import DIRECT
from chdstat.scenes import Scene, load_scene

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["render", "render_pixels"]

_log = logging.getLogger("chdstat")

_DIRECT_DEPTH = 2
"""Segments of a path from the camera to a light that shines on what it sees."""

Image = npt.NDArray[np.float32]


def render(
    scene: str | Path | dict[str, Any] | Scene,
    *,
    spp: int = 256,
    size: tuple[int, int] | None = None,
    seed: Seed = 0,
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
        check_streams(job, renderer, spp)
        check_room(renderer.size, spp * (1 + direct), out)
        shorter = _shorter(job, renderer) if direct else None
        for note in renderer.notes:
            _log.warning("%s", note)
        attrs = provenance(job, renderer, spp)
        writer = (
            StoreWriter.open(out, existing, attrs, renderer, spp)
            if out
            else MemoryWriter(attrs, renderer, spp)
        )
        if existing is not None and spp < existing.complete_spp() == existing.shape[3]:
            message = "nothing to render: %s holds %d samples per pixel, %d were asked for"
            _log.warning(message, out, existing.shape[3], spp)
        with contextlib.closing(writer):
            _fill(job, renderer, writer, client, progress)
            if shorter is None:
                return writer.finish()
            del renderer  # kernels are frozen where one scene is alive only
            return writer.finish(_direct(shorter, spp, out, client, progress))


def render_pixels(
    scene: str | Path | dict[str, Any] | Scene,
    pixels: npt.ArrayLike,
    *,
    spp: int = 2048,
    size: tuple[int, int] | None = None,
    seed: Seed = 0,
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
    >>> chd.rendering.render_pixels("cornell-box", [(4, 4)], spp=16, size=(8, 8)).shape
    (1, 3, 16)
    """
    spp = whole("spp", spp, least=1)
    job = job_of(scene, backend, size, seed, max_depth, sensor)
    with activate(job.verdict):
        renderer = Renderer(job)
        return renderer.pixels(_checked_pixels(pixels, renderer.size), spp)


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


def _direct(
    job: Job, spp: int, out: str | Path | None, client: Client | None, progress: bool | None
) -> Samples:
    """Render the direct part, into a store within that of the samples or into memory."""
    renderer = Renderer(job)
    attrs = provenance(job, renderer, spp)
    writer: Writer
    if out is None:
        writer = MemoryWriter(attrs, renderer, spp, features=False)
    else:
        path = Path(out) / DIRECT
        writer = StoreWriter.open(path, existing_store(path), attrs, renderer, spp, features=False)
    with contextlib.closing(writer):
        _fill(job, renderer, writer, client, progress)
        return writer.finish()


def _fill(
    job: Job,
    renderer: Renderer,
    writer: Writer,
    client: Client | None,
    progress: bool | None,
) -> None:
    """Render what is missing, writing each chunk as it arrives."""
    chunks = writer.pending()
    if not chunks:
        return
    start = time.monotonic()
    with track(
        f"rendering {job.scene.name}", sum(c.size for c in chunks), unit="S", show=progress
    ) as advance:
        try:
            for chunk, block in rendered(job, renderer, chunks, client):
                writer.write(chunk, block)
                advance(chunk.size)
        finally:
            writer.spent(time.monotonic() - start)
