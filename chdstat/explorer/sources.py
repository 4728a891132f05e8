"""Sources: where the samples of a pixel come from, a store that is never loaded as a whole.

`chdstat.explorer.images` has the other kind, a scene that is sampled on demand.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Protocol

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator, spans
from chdstat.errors import ChdstatError, StoreError
from chdstat.explorer.view import check_pixel
from chdstat.samples import Samples, is_store
from chdstat.samples import open as open_store
from chdstat.samples.layout import BLOCK

__all__ = ["Source", "StoreSource", "mixed", "pooled"]

_BLOCK_BYTES = 16 * 2**20
_KEPT_BYTES = 96 * 2**20
_AROUND = 10
"""Pixels to each side that estimators look at."""
_MOST_POOLED = 2**15
"""Samples of a region: as many as fits look at."""

Image = npt.NDArray[np.float32]
Box = tuple[int, int, int, int]


class Source(Protocol):
    """Samples of an image, as the explorer reads them."""

    @property
    def name(self) -> str:
        """What the page is headed with."""

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""

    def describe(self) -> str:
        """Say in one line what there is to see."""

    def pixel(self, y: int, x: int) -> Image:
        """Return samples, shape (channel, sample)."""

    def region(self, box: Box) -> Image:
        """Return pooled samples of a region, shape (channel, sample)."""


class StoreSource:
    """Samples of an image, read where they are looked at.

    Blocks of 16 x 16 pixels are kept for a while, as neighbours are often looked at next.
    """

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        self._blocks: OrderedDict[tuple[int, int], Image] = OrderedDict()
        self._reading: dict[tuple[int, int], Future[Image]] = {}
        self._lock = threading.Lock()

    @property
    def name(self) -> str:
        """Name of the store, or of the scene where it is in memory."""
        return self.samples.path.name if self.samples.path else self.samples.name

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.samples.shape[:2]

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""
        return self.samples.channels

    @property
    def asked_spp(self) -> int:
        """Samples per pixel that the rendering was asked for."""
        return int(self.samples.attrs.get("spp", self.samples.spp))

    @property
    def complete(self) -> bool:
        """Whether every pixel has as many samples as were asked for."""
        return self.samples.spp >= self.asked_spp

    def describe(self) -> str:
        """Say in one line what there is to see."""
        height, width, _, spp = self.samples.shape
        of = "" if self.complete else f" of {self.asked_spp} (not finished)"
        attrs = self.samples.attrs
        depth = attrs.get("max_depth")
        integrator = attrs.get("integrator")
        kind = integrator.get("type") if isinstance(integrator, dict) else integrator
        parts = [f"{width} × {height} px", f"{spp}{of} spp"]
        parts += [str(kind)] if kind else []
        parts += [f"depth {depth}"] if depth is not None else []
        return " · ".join(parts)

    def refreshed(self) -> StoreSource | None:
        """Return the source with the samples that were added since, None where there are none."""
        path = self.samples.path
        if path is None:
            return None
        try:
            samples = open_store(path)
        except ChdstatError:
            return None
        return StoreSource(samples) if samples.spp > self.samples.spp else None

    def pixel(self, y: int, x: int) -> Image:
        """Return all samples of a pixel, shape (channel, sample).

        Raises
        ------
        InputError
            If it is outside the image.
        StoreError
            If the store is damaged or gone.
        """
        height, width, channels, spp = self.samples.shape
        check_pixel(y, x, height, width)
        if BLOCK**2 * channels * spp * 4 > _BLOCK_BYTES:
            found: Image = self.read(slice(y, y + 1), slice(x, x + 1))[0, 0]
            return found
        block = self._block(y // BLOCK, x // BLOCK)
        self._check()
        return np.asarray(block[y % BLOCK, x % BLOCK])

    def around(
        self, y: int, x: int, spp: int, *, radius: int = _AROUND
    ) -> tuple[Image, tuple[int, int], tuple[slice, slice]]:
        """Return the first samples of the pixels around one.

        With them come the place of the pixel among them, and theirs in the image.
        """
        height, width = self.size
        top, left = max(0, y - radius), max(0, x - radius)
        ys = slice(top, min(height, y + radius + 1))
        xs = slice(left, min(width, x + radius + 1))
        return self.read(ys, xs, slice(0, spp)), (y - top, x - left), (ys, xs)

    def region(self, box: Box, spp: int | None = None) -> Image:
        """Return pooled samples of a region, as many of each pixel, shape (channel, sample).

        Of the first `spp` samples of each pixel; None pools from all.
        """
        top, left, bottom, right = box
        each, step = pooled(bottom - top, right - left, spp or self.samples.spp)
        parts = []
        for start in range(top, bottom, BLOCK * step):
            rows = slice(start, min(start + BLOCK * step, bottom))
            part = self.read(rows, slice(left, right), slice(0, each))[::step, ::step]
            parts.append(part.reshape(-1, *part.shape[2:]))
        return mixed(np.concatenate(parts))

    def read(self, ys: slice, xs: slice, ss: slice = slice(None)) -> Image:
        """Read a part, and make sure that it was there: what is gone reads as NaN."""
        try:
            found = self.samples.read(ys, xs, ss)
        except StoreError:
            self._check()
            raise
        self._check()
        return found

    def tiles(self, edge: int | None = None) -> Iterator[tuple[slice, slice]]:
        """Yield rows and columns of tiles that are small enough to be read with all samples."""
        height, width, channels, spp = self.samples.shape
        if edge is None:
            edge = 64
            while edge > BLOCK and edge * edge * channels * spp * 4 > _BLOCK_BYTES:
                edge //= 2
        for ys in spans(height, edge):
            for xs in spans(width, edge):
                yield ys, xs

    def _block(self, row: int, column: int) -> Image:
        """Return the block of 16 x 16 pixels, read once even if two threads ask for it."""
        key = (row, column)
        with self._lock:
            if key in self._blocks:
                return self._blocks[key]
            coming = self._reading.get(key)
            mine = coming is None
            if coming is None:
                coming = self._reading[key] = Future()
        if mine:
            top, left = row * BLOCK, column * BLOCK
            try:
                block = self.read(slice(top, top + BLOCK), slice(left, left + BLOCK))
                self._keep(key, block)
                coming.set_result(block)
            except StoreError as error:
                coming.set_exception(error)
            finally:
                with self._lock:
                    del self._reading[key]
        return coming.result()

    def _keep(self, key: tuple[int, int], block: Image) -> None:
        with self._lock:
            self._blocks[key] = block
            while sum(b.nbytes for b in self._blocks.values()) > _KEPT_BYTES:
                self._blocks.popitem(last=False)

    def _check(self) -> None:
        path = self.samples.path
        if path is not None and not is_store(path):
            message = f"the store {path} is gone: it was deleted or moved; open it again"
            raise StoreError(message)


def mixed(x: Image) -> Image:
    """Return samples of several pixels, (pixel, channel, sample), as those of one place.

    They are shuffled, always in the same way: what looks at consecutive samples, such as averages
    of N, is to see the region and not one pixel after the other.

    Examples
    --------
    >>> mixed(np.arange(4, dtype=np.float32).reshape(2, 1, 2))
    array([[2., 0., 1., 3.]], dtype=float32)
    """
    pool = np.ascontiguousarray(x.swapaxes(0, 1)).reshape(x.shape[1], -1)
    order = generator(0).permutation(pool.shape[1])
    return np.asarray(pool[:, order])


def pooled(height: int, width: int, spp: int) -> tuple[int, int]:
    """Return how many samples to pool of every `step`-th pixel of a region, and `step`.

    Examples
    --------
    >>> pooled(8, 8, 1024), pooled(512, 512, 1024)
    ((512, 1), (2, 4))
    """
    step = max(1, math.ceil(math.sqrt(height * width / (_MOST_POOLED / 2))))
    pixels = -(-height // step) * -(-width // step)
    return max(1, min(spp, _MOST_POOLED // pixels)), step
