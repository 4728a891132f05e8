"""Sources of samples: a store that is never loaded as a whole, and the image that is made of it.

`stream` makes the image in constant memory.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator, is_bad, is_null, luminance, spans
from chdstat._core.image_scales import RadianceSums, display_stops, mean_of_pixels
from chdstat._core.moments import Moments
from chdstat.errors import ChdstatError, StoreError
from chdstat.explorer.view import Box, Pixel, check_pixel
from chdstat.samples import Samples, is_store
from chdstat.samples import open as open_store
from chdstat.samples.layout import BLOCK
from chdstat.samples.tiles import sequence_of

__all__ = [
    "KEPT_BYTES",
    "ImageAccumulator",
    "Overall",
    "StoreSource",
    "mixed",
    "pooled",
    "stream",
    "tiles",
]

Image = npt.NDArray[np.float32]

_TILE = _BATCH = 64
_BLOCK_BYTES = 16 * 2**20
KEPT_BYTES = 128 * 2**20
_MOST_POOLED = 2**15
"""Samples of a region: as many as fits look at."""


# --- the image ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Overall:
    """The image, and maps that are by-products of its mean.

    Attributes
    ----------
    mean
        Mean radiance of the good samples, shape (y, x, channel), float32; NaN without any.
    null_share
        Share of nulls among the good samples, shape (y, x).
    good_count, bad_count
        Good and bad samples, shape (y, x): while an image is drawn, some pixels have more.
    variance
        Unbiased variance of luminance, squared radiance, shape (y, x).
    variation
        Standard deviation of luminance over its mean, shape (y, x).
    extreme, others
        The sample that is farthest from 0 and the sum of the others, averaged over channels,
        radiance, shape (y, x).
    """

    mean: Image
    null_share: Image
    good_count: Image
    bad_count: Image
    variance: Image
    variation: Image
    extreme: Image
    others: Image

    @property
    def relative_error(self) -> Image:
        """Standard error of the mean luminance over that mean, shape (y, x)."""
        good = np.where(self.good_count > 0, self.good_count, np.nan)
        return np.asarray(self.variation / np.sqrt(good))

    @property
    def unit(self) -> float:
        """Mean radiance of the image, which a few fireflies do not move."""
        return mean_of_pixels(self.extreme, self.others, self.good_count)

    @cached_property
    def exposure(self) -> float:
        """Stops that show the image well."""
        return display_stops(self.mean)

    @classmethod
    def empty(cls, height: int, width: int, channels: int) -> Overall:
        """Return the image of no samples."""
        mean = np.full((height, width, channels), np.nan, np.float32)
        return cls(mean, *np.full((7, height, width), np.nan, np.float32))

    def put(self, ys: slice, xs: slice, part: Overall) -> None:
        """Write a part of the image."""
        for field in fields(self):
            getattr(self, field.name)[ys, xs] = getattr(part, field.name)


class ImageAccumulator:
    """Sums over blocks (y, x, channel, sample) of the same pixels, in constant memory."""

    def __init__(self, height: int, width: int) -> None:
        self._moments: Moments | None = None
        self._sums = RadianceSums((height, width))
        self._nulls, self._bads = np.zeros((2, height, width), np.int64)

    def add(self, block: Image) -> None:
        """Count more samples."""
        bad = np.asarray(is_bad(block).any(axis=-2))
        self._sums.add(block)
        self._nulls += np.count_nonzero(is_null(block) & ~bad, axis=-1)
        self._bads += np.count_nonzero(bad, axis=-1)
        with np.errstate(invalid="ignore", over="ignore"):
            rows = np.concatenate([block, luminance(block)[..., np.newaxis, :]], axis=-2)
        found = Moments.of(rows, ~bad[..., np.newaxis, :] if bad.any() else None)
        self._moments = found if self._moments is None else self._moments.merge(found)

    def overall(self) -> Overall:
        """Return the image of the samples so far."""
        moments, sums = self._moments, self._sums
        assert moments is not None, "add samples first"
        mean, variance = moments.seen(moments.mean), moments.variance[..., -1]
        count = moments.count[..., 0]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            variation = np.where(mean[..., -1] > 0, np.sqrt(variance) / mean[..., -1], np.nan)
            share = self._nulls / count
            found = (mean[..., :-1], share, count, self._bads, variance, variation)
            maps = [part.astype(np.float32) for part in (*found, sums.extreme, sums.others)]
        return Overall(*maps)


# --- a store ------------------------------------------------------------------------------------


class StoreSource:
    """Samples of an image in a store or in memory; only the selected parts are read.

    Blocks of 16 x 16 pixels are kept for a while, as neighbours are often selected next.

    Attributes
    ----------
    samples
        The samples.
    size
        (height, width) in pixels.
    channels
        Names of the channels.
    name
        Name of the store, or of the scene where it is in memory.
    title
        The same with the name of the scene.
    complete
        Whether every pixel has as many samples as were asked for.
    """

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        self.size = samples.shape[:2]
        self.channels = samples.channels
        self.name = samples.path.name if samples.path else samples.name
        self.title = " · ".join(dict.fromkeys((self.name, samples.name)))
        self._asked_spp = int(samples.attrs.get("spp", samples.spp))
        self.complete = samples.spp >= self._asked_spp
        self._block_bytes = 4 * BLOCK**2 * samples.shape[2] * samples.spp
        self._blocks: dict[Pixel, Future[Image]] = {}
        self._lock = threading.Lock()

    def describe(self) -> str:
        """Return size, samples per pixel, integrator and depth in one line."""
        height, width, _, spp = self.samples.shape
        of = "" if self.complete else f" of {self._asked_spp} (not finished)"
        depth, integrator = (self.samples.attrs.get(name) for name in ("max_depth", "integrator"))
        kind = integrator.get("type") if isinstance(integrator, dict) else integrator
        deep = "" if depth is None else f"depth {depth}"
        length = sequence_of(self.samples.attrs)
        sampler = self.samples.attrs.get("sampler", "")
        said = f"{sampler} sequences of {length}: errors and p-values do not hold".lstrip()
        spread = said if length > 1 else ""
        parts = (f"{width} × {height} px", f"{spp}{of} spp", spread, str(kind or ""), deep)
        return " · ".join(part for part in parts if part)

    @property
    def origin(self) -> dict[str, str | int]:
        """Scene, samples per pixel and seed; without a seed, none is named."""
        seed = self.samples.attrs.get("seed")
        found: dict[str, str | int] = {"scene": self.samples.name, "spp": self.samples.spp}
        return found if seed is None else {**found, "seed": int(seed)}

    def refreshed(self) -> StoreSource | None:
        """Return the source with the samples that were added since, None where there are none."""
        if self.samples.path is None:
            return None
        try:
            samples = open_store(self.samples.path)
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
        check_pixel(y, x, *self.size)
        if self._block_bytes > _BLOCK_BYTES:
            return np.asarray(self.read(slice(y, y + 1), slice(x, x + 1))[0, 0])
        block = self._block((y // BLOCK, x // BLOCK))
        self._check()
        return np.asarray(block[y % BLOCK, x % BLOCK])

    def some(self, pixels: Sequence[Pixel], spp: int) -> Image:
        """Return the first samples of several pixels, shape (pixel, channel, sample)."""
        parts = [self.read(slice(y, y + 1), slice(x, x + 1), slice(0, spp)) for y, x in pixels]
        return np.concatenate(parts)[:, 0]

    def around(
        self, y: int, x: int, spp: int, *, radius: int
    ) -> tuple[Image, Pixel, tuple[slice, slice]]:
        """Return the first samples of the pixels within `radius` of one, its place, and theirs."""
        height, width = self.size
        ys = slice(max(0, y - radius), min(height, y + radius + 1))
        xs = slice(max(0, x - radius), min(width, x + radius + 1))
        return self.read(ys, xs, slice(0, spp)), (y - ys.start, x - xs.start), (ys, xs)

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
            return self.samples.read(ys, xs, ss)
        finally:
            self._check()

    def _block(self, key: Pixel) -> Image:
        """Return a block of 16 x 16 pixels, read once even if two threads ask for it."""
        with self._lock:
            mine = key not in self._blocks
            block = self._blocks.setdefault(key, Future())
        if mine:
            ys, xs = (slice(BLOCK * i, BLOCK * (i + 1)) for i in key)
            try:
                block.set_result(self.read(ys, xs))
            except Exception as error:  # noqa: BLE001 - raised in all threads that wait for it
                block.set_exception(error)
            with self._lock:
                if block.exception():
                    self._blocks.pop(key, None)
                while len(self._blocks) * self._block_bytes > KEPT_BYTES:
                    del self._blocks[next(iter(self._blocks))]
        return block.result()

    def _check(self) -> None:
        path = self.samples.path
        if path is not None and not is_store(path):
            message = f"the store {path} is gone: it was deleted or moved; open it again"
            raise StoreError(message)


def tiles(size: tuple[int, int], edge: int) -> list[tuple[slice, slice]]:
    """Return rows and columns of the tiles of an image, row by row."""
    return [(ys, xs) for ys in spans(size[0], edge) for xs in spans(size[1], edge)]


def stream(
    source: StoreSource, step: Callable[[float], None] = lambda _: None, *, spp: int | None = None
) -> Overall:
    """Return the image of the first `spp` samples, None for all, in constant memory.

    `step` is called with the share that is done; whatever it raises ends the pass.
    """
    spp = min(source.samples.spp, spp or source.samples.spp)
    whole = Overall.empty(*source.size, len(source.channels))
    places, batches = tiles(source.size, _TILE), list(spans(spp, _BATCH))
    for i, (ys, xs) in enumerate(places):
        sums = ImageAccumulator(ys.stop - ys.start, xs.stop - xs.start)
        for j, ss in enumerate(batches):
            step((i + j / len(batches)) / len(places))
            sums.add(source.read(ys, xs, ss))
        whole.put(ys, xs, sums.overall())
    return whole


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
