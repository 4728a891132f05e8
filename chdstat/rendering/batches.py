"""Batches: a scene rendered batch by batch, while nothing is kept."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from chdstat._core.arrays import Image, spans, whole
from chdstat._core.display import Card
from chdstat._core.progress import track
from chdstat._core.work import Interrupts
from chdstat.rendering.backend import activate
from chdstat.rendering.jobs import Job, RenderSettings, with_settings
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.rendering.renders import checked_renderer
from chdstat.rendering.workers import at_once, render_remote, rendered
from chdstat.samples import Samples
from chdstat.samples.samples import provenance
from chdstat.samples.tiles import BATCH, TILE, Chunk, chunk_grid, gathered
from chdstat.scenes import SceneLike

_AT_ONCE = 4
"""Samples that a scalar thread draws of a tile, so that few tiles keep all threads busy."""


@with_settings
def render_batches(
    scene: SceneLike,
    *,
    batch: int = 16,
    progress: bool = True,
    **options: Unpack[RenderSettings],
) -> Rendering:
    """Render a scene batch by batch and keep nothing; memory holds one batch.

    The samples are those of `render` with the same scene, backend and seed, to the bit.

    Parameters
    ----------
    scene
        As for `render`.
    batch
        Samples per pixel in a batch; the last one may have fewer.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.
    **options
        As for `render`: `spp`, the total samples per pixel, `size`, `seed`, `max_depth`, `sensor`,
        `integrator`, `crop`, `color`, `sampler`, `sequence` and `backend`.

    Returns
    -------
    Rendering
        To loop over: each step renders a batch, shape (y, x, channel, sample), float32.

    Raises
    ------
    InputError
        If `batch` or an option is out of range.
    SceneError, RenderError
        If the scene cannot be read, or cannot be rendered as asked.

    Examples
    --------
    >>> rendering = render_batches("cornell-box", spp=40, size=(8, 8), backend="scalar")
    >>> [batch.shape for batch in rendering]
    [(8, 8, 3, 16), (8, 8, 3, 16), (8, 8, 3, 8)]
    """
    batch, job = whole("batch", batch, least=1), Job.of(scene, **options)
    renderer = checked_renderer(job, kept=min(job.options["spp"], batch), out=None)
    return Rendering(renderer, batch=batch, progress=progress)


class Rendering:
    """A scene that is rendered during a loop; made by `chdstat.rendering.render_batches`.

    Each step of the loop gives the next batch, shape (y, x, channel, sample), linear radiance. Each
    loop starts again with the same samples. A wavefront (llvm, cuda) draws 64 samples at once,
    however small the batches are.

    Attributes
    ----------
    spp
        Total samples per pixel.
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

    def __init__(self, renderer: MitsubaRenderer, *, batch: int, progress: bool) -> None:
        self._job, self._renderer, self._progress = renderer.job, renderer, progress
        self.spp, self.batch, self._seconds = renderer.job.options["spp"], batch, 0.0

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
        """Provenance, as `Samples.attrs`, with the rendering time so far."""
        return self._renderer.provenance | {"render_seconds": round(self._seconds, 3)}

    @cached_property
    def features(self) -> dict[str, Image]:
        """First-hit features, as `Samples.features`, rendered on first use."""
        with activate(self._job.backend):
            return self._renderer.features()[0]

    @contextlib.contextmanager
    def on_demand(self) -> Iterator[tuple[Samples, int]]:
        """Yield samples that are drawn when they are read, and how many to read at once.

        Only the last chunks are kept; if samples are read tile by tile, each is drawn once. The
        workers of a cluster receive the scene, which they must see.

        Yields
        ------
        samples : Samples
            To read while the context lasts.
        workers : int
            Threads that may read at once.
        """
        with activate(self._job.backend), Interrupts() as interrupts, at_once(self._job) as threads:
            draw = partial(self._renderer.chunk, before_pass=interrupts.before_pass)
            source = _Drawn(self._job, self._renderer.identity, self.shape, draw)
            yield Samples(source, attrs=self.attrs, features={}), threads

    def _repr_html_(self) -> str:
        return Card("Rendering", provenance(self.attrs, self.shape)).html()

    def __repr__(self) -> str:
        height, width, _, spp = self.shape
        return (
            f"<Rendering {self.name!r} {width} x {height} pixels, {spp} spp in batches of "
            f"{self.batch}>"
        )

    def passes(self) -> Iterator[Iterator[tuple[Chunk, Image]]]:
        """Yield passes over the image, each as chunks and their samples (y, x, channel, sample).

        A pass has at most one chunk of each pixel, and ends before the next pass begins, so that
        memory holds less than a batch of the whole image.
        """
        step = self._step(min(self.batch, _AT_ONCE))
        with self._tracked() as advance:
            yield from (self._drawn([ss], advance) for ss in spans(self.spp, step))

    def __iter__(self) -> Iterator[Image]:
        step, few = self._step(self.batch), self._step(_AT_ONCE)
        with self._tracked() as advance:
            yield from _cut(
                (self._block(ss, few, advance) for ss in spans(self.spp, step)), self.batch
            )

    def _tracked(self) -> contextlib.AbstractContextManager[Callable[[float], None]]:
        height, width, _, spp = self.shape
        if not self._progress:  # whoever iterates shows what they want between two batches
            return contextlib.nullcontext(lambda _: None)
        about = f"rendering {self.name}"
        return track(about, height * width * spp, unit="S", show=self._progress)

    def _step(self, few: int) -> int:
        """Return how many samples of a pixel to draw together; `few` if any number will do."""
        sequences = self._job.sequences
        if sequences is not None:
            return sequences.span
        return few if self._job.backend.name == "scalar" else BATCH

    def _block(self, ss: slice, few: int, advance: Callable[[float], None]) -> Image:
        """Draw some samples of all pixels, with `few` of a tile at a time."""
        block = np.empty((*self.shape[:3], ss.stop - ss.start), np.float32)
        cuts = [slice(k, min(k + few, ss.stop)) for k in range(ss.start, ss.stop, few)]
        for chunk, part in self._drawn(cuts, advance):
            here = slice(chunk.ss.start - ss.start, chunk.ss.stop - ss.start)
            block[chunk.ys, chunk.xs, :, here] = part
        return block

    def _drawn(
        self, cuts: Sequence[slice], advance: Callable[[float], None]
    ) -> Iterator[tuple[Chunk, Image]]:
        """Draw samples tile by tile.

        Samples do not depend on the cuts, except for a wavefront, which draws chunks as they are
        stored.
        """
        start, tiles = time.monotonic(), list(chunk_grid(*self.shape[:2], 1))
        chunks = [replace(t, batch=cut.start // BATCH, ss=cut) for cut in cuts for t in tiles]
        with activate(self._job.backend):
            for chunk, part in rendered(self._renderer, chunks):
                assert part is not None, "without a store, samples are yielded"
                yield chunk, part
                advance(chunk.size)
        self._seconds += time.monotonic() - start


def _cut(blocks: Iterator[Image], batch: int) -> Iterator[Image]:
    """Cut blocks of samples into batches of another size; the last one may have fewer samples."""
    rest: Image | None = None
    for block in blocks:
        rest = block if rest is None else np.concatenate([rest, block], axis=-1)
        while rest.shape[-1] >= batch:
            yield rest[..., :batch]
            rest = rest[..., batch:]
    if rest is not None and rest.shape[-1]:
        yield rest


class _Drawn:
    """A `chdstat.samples.tiles.SampleSource` that draws the chunks that are read.

    `draw` draws a chunk. It is not sent to the workers of a cluster, which build the scene
    themselves.
    """

    frames = False

    def __init__(
        self,
        job: Job,
        identity: dict[str, Any],
        shape: tuple[int, int, int, int],
        draw: Callable[[Chunk], Image] | None = None,
    ) -> None:
        self.path, self.shape, self._last = Path(job.scene.name), shape, threading.local()
        self._job, self._identity, self._draw = job, identity, draw

    def __reduce__(self) -> tuple[Any, ...]:
        return _Drawn, (self._job, self._identity, self.shape)

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples."""
        height, width, _, spp = self.shape
        grid = chunk_grid(height, width, spp, ys=ys, xs=xs, ss=ss)
        chunks = {chunk.index: chunk for chunk in grid}
        return gathered(
            self.shape, (ys, xs, ss), (TILE, TILE, BATCH), lambda *index: self._chunk(chunks[index])
        )

    def read_features(self) -> dict[str, Image]:
        """Return no features."""
        return {}

    def _chunk(self, chunk: Chunk) -> Image:
        if getattr(self._last, "chunk", None) != chunk:
            if self._draw is None:
                ((_, block),) = render_remote(self._job, self._identity, None, (chunk, [chunk]))
            else:
                block = self._draw(chunk)
            self._last.block, self._last.chunk = block, chunk
        return np.asarray(self._last.block)
