"""Capture: a scene to samples, chunk by chunk.

`render` keeps every sample, in a store or in memory, and can be stopped and resumed at any moment;
`render_batches` hands samples over as they are drawn, and keeps none; `render_pixels` draws those
of a few pixels on demand.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, spans, whole
from chdstat._core.display import Card
from chdstat._core.executor import track
from chdstat.errors import InputError, StoreError
from chdstat.rendering.backend import Backend, activate
from chdstat.rendering.renderer import Job, Renderer, cut_paths
from chdstat.rendering.seeds import check_spp
from chdstat.rendering.workers import rendered
from chdstat.rendering.writers import MemoryWriter, Writer, check_room, opened_store, provenance
from chdstat.samples import Samples, description, is_store
from chdstat.samples.layout import BATCH, Chunk, Image, chunk_grid, depth_folder
from chdstat.samples.store import Store
from chdstat.samples.tiles import DIRECT_DEPTH
from chdstat.scenes import Scene, load_scene

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["Rendering", "refuse_render", "render", "render_batches", "render_pixels"]

_log = logging.getLogger("chdstat")

_AT_ONCE = 4
"""Samples that a scalar thread draws of a tile: few tiles shall keep all threads busy."""


def render(
    scene: str | Path | dict[str, Any] | Scene,
    *,
    spp: int = 256,
    size: tuple[int, int] | None = None,
    seed: Seed = 0,
    max_depth: int | None = None,
    sensor: int = 0,
    direct: bool = False,
    by_depth: int | None = None,
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
    by_depth
        Render every sample once more with no more than 2, 3, ... and so many segments:
        `Samples.depths`. Their differences are the light of each sample by the length of its path,
        which `chdstat.patterns.attribute` makes shares of the mean, the variance and the tail of.
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
    deepest = DIRECT_DEPTH if by_depth is None else whole("by_depth", by_depth, least=DIRECT_DEPTH)
    depths = set(range(DIRECT_DEPTH, deepest + 1)) if direct or by_depth else set()
    existing = Store.open(Path(out)) if out is not None and is_store(out) else None
    if existing is not None:
        depths |= existing.depths().keys()  # parts of other samples are refused here
        if "scene_hash" not in existing.attrs:
            message = (
                f"{out} holds samples that were saved or imported, to which no render can be "
                "added; nothing was changed. Give another path"
            )
            raise StoreError(message)
        backend = existing.attrs["backend"] if backend == "auto" else backend
        size = size or tuple(existing.attrs["size"])
    job = Job.of(loaded, size=size, seed=seed, max_depth=max_depth, sensor=sensor, backend=backend)
    with activate(job.verdict):
        renderer = _renderer(job, spp, kept=spp * (1 + len(depths)), out=out)
        shorter = cut_paths(job, renderer, depths)
        if existing is not None and spp < existing.complete_spp() == existing.shape[3]:
            message = "nothing to render: %s holds %d samples per pixel, %d were asked for"
            _log.warning(message, out, existing.shape[3], spp)
        with _writer(job, renderer, spp, out) as writer:
            _fill(job, renderer, writer, client, progress)
            parts = {}
            for depth, cut in shorter.items():
                del renderer  # kernels are frozen where one scene is alive only
                renderer = Renderer(cut)
                folder = None if out is None else Path(out) / depth_folder(depth)
                with _writer(cut, renderer, spp, folder, features=False) as part:
                    _fill(cut, renderer, part, client, progress)
                    parts[depth] = part.finish()
            return writer.finish(parts)


def render_batches(
    scene: str | Path | dict[str, Any] | Scene,
    *,
    spp: int = 256,
    batch: int = 16,
    size: tuple[int, int] | None = None,
    seed: Seed = 0,
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
    >>> rendering = render_batches("cornell-box", spp=40, size=(8, 8), backend="scalar")
    >>> [batch.shape for batch in rendering]
    [(8, 8, 3, 16), (8, 8, 3, 16), (8, 8, 3, 8)]
    """
    spp, batch = whole("spp", spp, least=1), whole("batch", batch, least=1)
    job = Job.of(scene, size=size, seed=seed, max_depth=max_depth, sensor=sensor, backend=backend)
    renderer = _renderer(job, spp, kept=min(spp, batch), out=None)
    return Rendering(job, renderer, spp=spp, batch=batch, progress=progress)


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
    job = Job.of(scene, size=size, seed=seed, max_depth=max_depth, sensor=sensor, backend=backend)
    with activate(job.verdict):
        renderer = Renderer(job)
        return renderer.pixels(_checked_pixels(pixels, renderer.size), spp)


class Rendering:
    """A scene that is rendered while one loops over it; made by `chdstat.rendering.render_batches`.

    Each turn of the loop gives the next batch, shape (y, x, channel, sample), linear radiance; each
    loop starts anew with the same samples. A wavefront (llvm, cuda) draws 64 samples at once,
    however small the batches.

    Attributes
    ----------
    spp
        Samples per pixel in all.
    batch
        Samples per pixel in a batch.

    Examples
    --------
    >>> rendering = render_batches("cornell-box", spp=4, size=(8, 8), backend="scalar")
    >>> rendering
    <Rendering 'cornell-box' 8 x 8 pixels, 4 spp in batches of 16>
    >>> sum(batch.sum(axis=-1) for batch in rendering).shape
    (8, 8, 3)
    """

    def __init__(
        self, job: Job, renderer: Renderer, *, spp: int, batch: int, progress: bool | None
    ) -> None:
        self._job, self._renderer, self._progress = job, renderer, progress
        self.spp, self.batch, self._seconds = spp, batch, 0.0

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self._job.scene.name

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample) of all batches together."""
        width, height = self._renderer.size
        return height, width, len(self.channels), self.spp

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""
        return "R", "G", "B"

    @property
    def attrs(self) -> dict[str, Any]:
        """Provenance, as `Samples.attrs`; the seconds of rendering are those until now."""
        told = provenance(self._job, self._renderer, self.spp)
        return told | {"render_seconds": round(self._seconds, 3)}

    @cached_property
    def features(self) -> dict[str, Image]:
        """First-hit features, as `Samples.features`; rendered when they are first asked for."""
        with activate(self._job.verdict):
            return self._renderer.features()

    def _repr_html_(self) -> str:
        return Card("Rendering", description.provenance(self.attrs, self.shape)).html()

    def __repr__(self) -> str:
        height, width, _, spp = self.shape
        return (
            f"<Rendering {self.name!r} {width} x {height} pixels, {spp} spp in batches of "
            f"{self.batch}>"
        )

    def __iter__(self) -> Iterator[Image]:
        height, width, _, spp = self.shape
        step = self.batch if self._scalar else BATCH
        with track(
            f"rendering {self.name}", height * width * spp, unit="S", show=self._progress
        ) as advance:
            yield from _cut((self._draw(ss, advance) for ss in spans(spp, step)), self.batch)

    @property
    def _scalar(self) -> bool:
        return self._job.verdict.backend == "scalar"

    def _draw(self, ss: slice, advance: Callable[[float], None]) -> Image:
        """Draw some samples of all pixels; nothing of the renderer is left at work after it."""
        start = time.monotonic()
        block = np.empty((*self.shape[:3], ss.stop - ss.start), np.float32)
        with activate(self._job.verdict):
            for chunk, part in rendered(self._job, self._renderer, self._chunks(ss), None):
                here = slice(chunk.ss.start - ss.start, chunk.ss.stop - ss.start)
                block[chunk.ys, chunk.xs, :, here] = part
                advance(chunk.size)
        self._seconds += time.monotonic() - start
        return block

    def _chunks(self, ss: slice) -> list[Chunk]:
        """Return the chunks of some samples: what a sample is does not depend on how they are cut.

        But for a wavefront, which draws chunks as they are stored.
        """
        height, width = self.shape[:2]
        step = _AT_ONCE if self._scalar else BATCH
        cuts = [slice(k, min(k + step, ss.stop)) for k in range(ss.start, ss.stop, step)]
        tiles = list(chunk_grid(height, width, 1))
        return [replace(t, batch=cut.start // BATCH, ss=cut) for cut in cuts for t in tiles]


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


def _renderer(job: Job, spp: int, *, kept: int, out: str | Path | None) -> Renderer:
    """Return the renderer of a job, if so many samples can be drawn, and those kept be held."""
    renderer = Renderer(job)
    check_spp(job.verdict.backend, *renderer.size, spp)
    check_room(renderer.size, kept, out)
    for note in renderer.notes:
        _log.warning("%s", note)
    return renderer


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


@contextlib.contextmanager
def _writer(
    job: Job, renderer: Renderer, spp: int, out: str | Path | None, *, features: bool = True
) -> Iterator[Writer]:
    """Yield what keeps samples: a store, which may be there already, or memory."""
    attrs = provenance(job, renderer, spp)
    if out is None:
        yield MemoryWriter(attrs, renderer, spp, features=features)
        return
    with opened_store(Path(out), attrs, renderer, spp, features=features) as store:
        yield store


def _fill(
    job: Job, renderer: Renderer, writer: Writer, client: Client | None, progress: bool | None
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


def _cut(blocks: Iterator[Image], batch: int) -> Iterator[Image]:
    """Cut blocks of samples into batches of another size; of what is left, fewer."""
    rest: Image | None = None
    for block in blocks:
        rest = block if rest is None else np.concatenate([rest, block], axis=-1)
        while rest.shape[-1] >= batch:
            yield rest[..., :batch]
            rest = rest[..., batch:]
    if rest is not None and rest.shape[-1]:
        yield rest
