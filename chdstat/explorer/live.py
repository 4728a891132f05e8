"""Live: a scene that was never rendered, sampled where it is looked at.

The picture is drawn coarsely, tile by tile; a pixel gets its own samples when it is picked, and
more for as long as one looks at it. Only the thread that owns the renderer draws.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat._renderer import Renderer
from chdstat._store import TILE, Chunk
from chdstat.backend import activate
from chdstat.capture import job_of
from chdstat.errors import SceneError
from chdstat.explorer.images import Overall, Tally
from chdstat.explorer.sources import Box, mixed, pooled
from chdstat.explorer.view import check_pixel
from chdstat.scenes import Scene

__all__ = ["FIRST_SPP", "MOST_SPP", "SceneSource"]

FIRST_SPP = 2048
MOST_SPP = 10**6
_PIECE = 4096
"""Samples drawn at once while one looks at a pixel: a tenth of a second, so that a click waits for
no more."""
_PASSES = (1, 1, 2, 2, 2, 2, 2, 2, 2)
"""Samples per pixel of the passes over the picture."""
_KEPT_BYTES = 128 * 2**20

Image = npt.NDArray[np.float32]


class SceneSource:
    """A scene, sampled on demand.

    Parameters
    ----------
    scene
        What `chdstat.load_scene` returns.
    size, seed, max_depth
        As for `chdstat.render`.

    Raises
    ------
    InputError, SceneError, RenderError
        If the scene cannot be rendered so.
    """

    channels = ("R", "G", "B")

    def __init__(
        self,
        scene: Scene,
        *,
        size: tuple[int, int] | None = None,
        seed: int = 0,
        max_depth: int | None = None,
    ) -> None:
        self._job = job_of(scene, "scalar", size, seed, max_depth)
        with activate(self._job.verdict):
            self._renderer = Renderer(self._job)
        width, height = self._renderer.size
        self.size = (height, width)
        self.name = scene.name
        self._pixels: dict[tuple[int, int], Image] = {}
        self._lock = threading.Lock()
        self._tallies: dict[tuple[int, int], tuple[slice, slice, Tally]] = {}
        self._spp = 0

    def describe(self) -> str:
        """Say in one line what there is to see."""
        height, width = self.size
        kind = self._renderer.integrator["type"]
        return f"{width} × {height} px · {kind} · sampled where you click"

    def pixel(self, y: int, x: int) -> Image:
        """Return the samples that a pixel has; the first of them are drawn when first asked for."""
        check_pixel(y, x, *self.size)
        with self._lock:
            found = self._pixels.get((y, x))
        return self._draw(y, x, FIRST_SPP) if found is None else found

    def more(self, y: int, x: int) -> Image:
        """Draw as many samples again, a limited piece at a time, up to `MOST_SPP`."""
        there = self.pixel(y, x)
        spp = there.shape[1]
        return there if spp >= MOST_SPP else self._draw(y, x, min(_PIECE, spp, MOST_SPP - spp))

    def region(self, box: Box) -> Image:
        """Return pooled samples of a region, as many of each pixel, shape (channel, sample)."""
        top, left, bottom, right = box
        each, step = pooled(bottom - top, right - left, 64)
        at = [(y, x) for y in range(top, bottom, step) for x in range(left, right, step)]
        with activate(self._job.verdict):
            return mixed(self._renderer.pixels(np.array(at), each))

    def passes(self) -> Iterator[float]:
        """Draw the picture better and better; yield the share that is done after each tile."""
        height, width = self.size
        tiles = [(ys, xs) for ys in spans(height, TILE) for xs in spans(width, TILE)]
        start, done, total = 0, 0, len(tiles) * len(_PASSES)
        for spp in _PASSES:
            for i, (ys, xs) in enumerate(tiles):
                columns = -(-width // TILE)
                chunk = Chunk(0, i // columns, i % columns, ys, xs, slice(start, start + spp))
                with activate(self._job.verdict):
                    block = self._renderer.chunk(chunk)
                *_, tally = self._tallies.setdefault((ys.start, xs.start), (ys, xs, Tally()))
                tally.add(block)
                self._spp = start + spp
                done += 1
                yield done / total
            start += spp
        if not np.nan_to_num(self.overall().mean).any():
            message = f"the picture of {self.name!r} is black: does it have an emitter?"
            raise SceneError(message)

    def overall(self) -> Overall:
        """Return the picture as far as it is drawn."""
        whole = Overall.empty(*self.size, 3)
        for ys, xs, tally in self._tallies.values():
            whole.put(ys, xs, tally.overall())
        return replace(whole, spp=self._spp)

    def _draw(self, y: int, x: int, spp: int) -> Image:
        with self._lock:
            there = self._pixels.get((y, x))
        number = 0 if there is None else -(-there.shape[1] // FIRST_SPP)
        with activate(self._job.verdict):
            # The seed moves a pixel's stream by a golden section: its pieces never meet.
            seed = self._job.seed + number
            drawn: Image = self._renderer.pixels(np.array([[y, x]]), spp, seed=seed)[0]
        found = drawn if there is None else np.concatenate([there, drawn], axis=1)
        with self._lock:
            self._pixels.pop((y, x), None)
            self._pixels[y, x] = found
            while len(self._pixels) > 1 and _size(self._pixels) > _KEPT_BYTES:
                self._pixels.pop(next(iter(self._pixels)))
        return found


def _size(pixels: dict[tuple[int, int], Image]) -> int:
    return sum(samples.nbytes for samples in pixels.values())
