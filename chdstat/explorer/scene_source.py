"""Source of a scene that has no store: the image coarsely, and a pixel when it is picked.

A pixel gets more samples for as long as it stays selected. The renderer has a process of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from chdstat.errors import SceneError
from chdstat.explorer.render_process import RenderProcess
from chdstat.explorer.sources import (
    KEPT_BYTES,
    ImageAccumulator,
    Overall,
    StoreSource,
    mixed,
    pooled,
    tiles,
)
from chdstat.explorer.startup import COARSE
from chdstat.explorer.view import Box, Pixel, check_pixel
from chdstat.samples.layout import TILE, Chunk

__all__ = ["FIRST_SPP", "MOST_SPP", "SceneSource", "Source"]

Image = npt.NDArray[np.float32]

FIRST_SPP = 2048
MOST_SPP = 10**6
_PIECE = 4096
"""Samples drawn at once while a pixel is selected: a tenth of a second, which a click waits for."""
_COARSE_SPP = 4
"""Samples per pixel of the coarse image in the end."""
_PASSES = (1, 1, 2, 2, 2, 2, 2, 2, 2)
"""Samples per pixel of the passes over the image."""


class SceneSource:
    """A scene, sampled on demand.

    Parameters
    ----------
    render
        The process that renders it.
    coarse
        The image with at most `COARSE` pixels a side, shape (y, x, channel), to be seen until it is
        drawn; None for none.
    """

    channels = ("R", "G", "B")

    def __init__(self, render: RenderProcess, coarse: Image | None = None) -> None:
        self._seed, self._render = render.job.seed, render
        (width, height), self._integrator = self._render.described
        self.size: tuple[int, int] = (height, width)
        self.name = self.title = render.job.scene.name
        self._coarse = coarse
        self._preview = np.full((height, width, len(self.channels)), np.nan, np.float32)
        if coarse is not None:
            self._preview = self._enlarged(coarse)
        self._pixels: dict[Pixel, Image] = {}
        self._tiles = [
            (ys, xs, ImageAccumulator(ys.stop - ys.start, xs.stop - xs.start))
            for ys, xs in tiles(self.size, TILE)
        ]
        self._drawn = 0

    def describe(self) -> str:
        """Return size and integrator in one line."""
        height, width = self.size
        return f"{width} × {height} px · {self._integrator} · sampled where you click"

    @property
    def origin(self) -> dict[str, str | int]:
        """Scene and seed."""
        return {"scene": self.name, "seed": self._seed}

    def close(self) -> None:
        """End the process that renders."""
        self._render.close()

    def pixel(self, y: int, x: int) -> Image:
        """Return the samples that a pixel has; the first of them are drawn on the first call."""
        check_pixel(y, x, *self.size)
        if (y, x) not in self._pixels:
            self._draw(y, x, FIRST_SPP)
        return self._pixels[y, x]

    def more(self, y: int, x: int) -> Image:
        """Draw as many samples again, a limited piece at a time, up to `MOST_SPP`."""
        spp = self.pixel(y, x).shape[1]
        if spp < MOST_SPP:
            self._draw(y, x, min(_PIECE, spp, MOST_SPP - spp))
        return self._pixels[y, x]

    def some(self, pixels: Sequence[Pixel], spp: int) -> Image:
        """Draw samples of several pixels, shape (pixel, channel, sample)."""
        drawn: Image = self._render("pixels", np.array(pixels), spp)
        return drawn

    def region(self, box: Box) -> Image:
        """Return pooled samples of a region, as many of each pixel, shape (channel, sample)."""
        top, left, bottom, right = box
        each, step = pooled(bottom - top, right - left, 64)
        at = [(y, x) for y in range(top, bottom, step) for x in range(left, right, step)]
        return mixed(self._render("pixels", np.array(at), each))

    def passes(self) -> Iterator[float]:
        """Draw the image better and better; yield the share that is done after each tile."""
        if self._coarse is not None:
            rest = _COARSE_SPP - 1
            further: Image = self._render("preview", COARSE, rest, seed=1)
            self._coarse += rest / _COARSE_SPP * (further - self._coarse)
            self._preview = self._enlarged(self._coarse)
            yield 0.0
        columns, total = -(-self.size[1] // TILE), len(self._tiles) * len(_PASSES)
        start = 0
        for spp in _PASSES:
            samples = slice(start, start + spp)
            start += spp
            for i, (ys, xs, sums) in enumerate(self._tiles):
                chunk = Chunk(0, i // columns, i % columns, ys, xs, samples)
                sums.add(self._render("chunk", chunk))
                self._drawn += 1
                yield self._drawn / total
        if not np.nan_to_num(self.overall().mean).any():
            message = f"the image of {self.name!r} is black: does it have an emitter?"
            raise SceneError(message)

    def overall(self) -> Overall:
        """Return the image as far as it is drawn."""
        whole = replace(Overall.empty(*self.size, len(self.channels)), mean=self._preview.copy())
        for ys, xs, sums in self._tiles[: self._drawn]:
            whole.put(ys, xs, sums.overall())
        return whole

    def _enlarged(self, coarse: Image) -> Image:
        ys, xs = (np.arange(n) * m // n for n, m in zip(self.size, coarse.shape[:2], strict=True))
        return np.asarray(coarse[ys[:, np.newaxis], xs], np.float32)

    def _draw(self, y: int, x: int, spp: int) -> None:
        there = self._pixels.get((y, x))
        # The seed moves a pixel's stream by a golden section: its pieces never meet.
        seed = self._seed + (0 if there is None else -(-there.shape[1] // FIRST_SPP))
        drawn: Image = self._render("pixels", np.array([[y, x]]), spp, seed=seed)[0]
        self._pixels.pop((y, x), None)
        self._pixels[y, x] = drawn if there is None else np.concatenate([there, drawn], axis=1)
        held = sum(x.nbytes for x in self._pixels.values())
        while len(self._pixels) > 1 and held > KEPT_BYTES:
            held -= self._pixels.pop(next(iter(self._pixels))).nbytes


Source = StoreSource | SceneSource
