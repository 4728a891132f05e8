"""Sources: a store, never loaded as a whole, a scene, sampled where it is clicked, or an image."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import TypeVar

import numpy as np

from chdstat._core.arrays import (
    Counts,
    Floats,
    Image,
    generator,
    is_bad,
    luminance,
    seed_number,
    spans,
)
from chdstat._core.image_scales import display_stops
from chdstat._core.moments import PixelMoments
from chdstat.errors import ChdstatError, SceneError, StoreError
from chdstat.explorer.address import Box, PixelIndex, check_pixel
from chdstat.explorer.render_process import COARSE, RenderProcess
from chdstat.io.exr import read_exr
from chdstat.samples import Samples, is_store
from chdstat.samples import open as open_store
from chdstat.samples.dependence import sequence_of
from chdstat.samples.layout import BLOCK
from chdstat.samples.tiles import TILE, Chunk
from chdstat.summary.histograms import StreamingHistogram, sample_masks

K = TypeVar("K")
V = TypeVar("V")

MOST_POOLED = 2**15
"""Samples of a region, and samples of any place that fits, tests and modes look at."""
_BLOCK_BYTES, _KEPT_BYTES = 16 * 2**20, 128 * 2**20


BINS = np.geomspace(1e-12, 1e12, 481)
"""Edges of the bins of an image's histogram, twenty for each decade."""


def drop_oldest(held: dict[K, V], size: Callable[[V], int]) -> None:
    """Drop the first entries of a dictionary that holds more than 128 MiB, but not the last."""
    total = sum(map(size, held.values()))
    while len(held) > 1 and total > _KEPT_BYTES:
        total -= size(held.pop(next(iter(held))))


# --- the image ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Overall:
    """The image, and the maps that are computed along with its mean.

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
    histogram
        Good, non-null samples of all pixels by the logarithm of radiance, for each channel and
        luminance: those below `BINS`, in each bin, and above, shape (row, bin + 2).
    """

    mean: Image
    null_share: Image
    good_count: Image
    bad_count: Image
    variance: Image
    variation: Image
    extreme: Image
    others: Image
    histogram: Counts = field(kw_only=True)

    @property
    def relative_error(self) -> Image:
        """Standard error of the mean luminance over that mean, shape (y, x)."""
        good = np.where(self.good_count > 0, self.good_count, np.nan)
        return np.asarray(self.variation / np.sqrt(good))

    @cached_property
    def exposure(self) -> float:
        """Stops that show the image well."""
        return display_stops(self.mean)

    @classmethod
    def empty(cls, height: int, width: int, channels: int) -> Overall:
        """Return the image of no samples."""
        mean = np.full((height, width, channels), np.nan, np.float32)
        maps = np.full((7, height, width), np.nan, np.float32)
        return cls(mean, *maps, histogram=np.zeros((channels + 1, len(BINS) + 1), np.int64))

    def put(self, ys: slice, xs: slice, part: Overall) -> None:
        """Write a part of the image, which must not be there yet."""
        for own in fields(self):
            if own.name != "histogram":
                getattr(self, own.name)[ys, xs] = getattr(part, own.name)
        self.histogram[:] += part.histogram


class ImageAccumulator:
    """Sums over blocks (y, x, channel, sample) of the same pixels, in constant memory."""

    def __init__(self, height: int, width: int) -> None:
        self._pixels = PixelMoments()
        self._extreme, self._others = np.zeros((2, height, width))
        self._histogram = StreamingHistogram(support=(BINS[0], BINS[-1]), bins=len(BINS) - 1)

    def add(self, block: Image) -> None:
        """Count more samples."""
        for row, extreme, others in zip(block, self._extreme, self._others, strict=True):
            _add_grey(row, extreme, others)
        with np.errstate(invalid="ignore", over="ignore"):
            rows = np.concatenate([block, luminance(block)[..., np.newaxis, :]], axis=-2)
        masks = sample_masks(block)
        self._pixels.update(rows, *masks)
        pooled = np.moveaxis(rows, -2, 0).reshape(rows.shape[-2], -1)
        null, bad = (None if m is None else np.resize(m, pooled.shape) for m in masks)
        self._histogram.update(pooled, null=null, bad=bad)

    def overall(self) -> Overall:
        """Return the image of the samples so far."""
        moments, counts = self._pixels.moments, self._pixels.counts
        assert moments is not None, "add samples first"
        mean, variance = moments.seen(moments.mean), moments.variance[..., -1]
        count = moments.count[..., 0]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            variation = np.where(mean[..., -1] > 0, np.sqrt(variance) / mean[..., -1], np.nan)
            share = counts["null_count"] / count
            found = (mean[..., :-1], share, count, counts["bad_count"], variance, variation)
            maps = [part.astype(np.float32) for part in (*found, self._extreme, self._others)]
        counted = self._histogram.read()
        inside = counted.underflow[:, np.newaxis], counted.counts, counted.overflow[:, np.newaxis]
        return Overall(*maps, histogram=np.concatenate(inside, axis=-1))


def _add_grey(x: Image, extreme: Floats, others: Floats) -> None:
    """Add good samples (pixel, channel, sample), averaged over channels, to sums of pixels.

    `extreme` is the sample that is farthest from 0. `others` is the sum of the others, kept
    separately since a firefly takes all digits of a sum.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        grey = x.mean(axis=-2, dtype=np.float64)
    grey[is_bad(x).any(axis=-2) | ~np.isfinite(grey)] = 0
    # The previous farthest sample is added as one more sample.
    grey = np.concatenate([grey, extreme[:, np.newaxis]], axis=-1)
    high, low = grey.argmax(axis=-1)[:, np.newaxis], grey.argmin(axis=-1)[:, np.newaxis]
    highest, lowest = (np.take_along_axis(grey, i, axis=-1) for i in (high, low))
    far = np.where(highest >= -lowest, high, low)
    extreme[:] = np.take_along_axis(grey, far, axis=-1)[:, 0]
    np.put_along_axis(grey, far, 0, axis=-1)
    others += grey.sum(axis=-1)


def stream(source: StoreSource, *, spp: int | None = None) -> Iterator[tuple[float, Overall]]:
    """Yield the share that is done and the image so far, of the first `spp` samples, None for all.

    It takes constant memory.

    Examples
    --------
    >>> from chdstat.samples import Samples
    >>> *_, (share, whole) = stream(StoreSource(Samples.from_array(np.ones((2, 2, 3, 8)))))
    >>> share, whole.mean.shape
    (1.0, (2, 2, 3))
    """
    spp = min(source.samples.spp, spp or source.samples.spp)
    whole = Overall.empty(*source.size, len(source.channels))
    places = list(product(*(spans(length, TILE) for length in source.size)))
    batches = list(spans(spp, TILE))
    for i, (ys, xs) in enumerate(places):
        sums = ImageAccumulator(ys.stop - ys.start, xs.stop - xs.start)
        for j, ss in enumerate(batches):
            yield (i + j / len(batches)) / len(places), whole
            sums.add(source.read(ys, xs, ss))
        whole.put(ys, xs, sums.overall())
    yield 1.0, whole


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
        self._counts = samples.counts if samples.unequal else None
        self.channels = _named(samples.channels)
        self.name = samples.path.name if samples.path else samples.name
        self.title = " · ".join(dict.fromkeys((self.name, samples.name)))
        self._asked_spp = int(samples.attrs.get("spp", samples.spp))
        self.complete = samples.spp >= self._asked_spp
        self._block_bytes = 4 * BLOCK**2 * samples.shape[2] * samples.spp
        self._block = lru_cache(max(1, _KEPT_BYTES // self._block_bytes))(self._read_block)

    def describe(self) -> str:
        """Return size, samples per pixel and integrator in one line."""
        height, width, _, spp = self.samples.shape
        attrs = self.samples.attrs
        of = "" if self.complete else f" of {self._asked_spp} (not finished)"
        kind = (attrs.get("integrator") or {}).get("type", "")
        length = sequence_of(attrs)
        said = f"{attrs.get('sampler', '')} sequences of {length}: errors and p-values do not hold"
        spread = said.lstrip() if length > 1 else ""
        number = spp if self._counts is None else f"{self._counts.min()} to {spp}"
        parts = (f"{width} × {height} px", f"{number}{of} spp", spread, kind)
        return " · ".join(part for part in parts if part)

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
        """Return all samples that a pixel has, shape (channel, sample).

        Raises
        ------
        InputError
            If it is outside the image.
        StoreError
            If the store is damaged or gone.
        """
        check_pixel(y, x, *self.size)
        has = slice(None if self._counts is None else int(self._counts[y, x]))
        if self._block_bytes > _BLOCK_BYTES:
            return np.asarray(self.read(slice(y, y + 1), slice(x, x + 1), has)[0, 0])
        block = self._block(y // BLOCK, x // BLOCK)
        self._check()
        return np.asarray(block[y % BLOCK, x % BLOCK, :, has])

    def some(self, pixels: Sequence[PixelIndex], spp: int) -> Image:
        """Return the first samples of several pixels, shape (pixel, channel, sample)."""
        parts = [self.read(slice(y, y + 1), slice(x, x + 1), slice(0, spp)) for y, x in pixels]
        return np.concatenate(parts)[:, 0]

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
            if self._counts is not None:
                counts = self._counts[rows, left:right][::step, ::step, np.newaxis]
                part = np.moveaxis(part, 3, 2)[np.arange(part.shape[3]) < counts][..., np.newaxis]
            parts.append(part.reshape(-1, *part.shape[-2:]))
        return _mixed(np.concatenate(parts))

    def held(self, box: Box) -> int:
        """Return how many samples a region has."""
        top, left, bottom, right = box
        if self._counts is None:
            return (bottom - top) * (right - left) * self.samples.spp
        return int(self._counts[top:bottom, left:right].sum())

    def read(self, ys: slice, xs: slice, ss: slice = slice(None)) -> Image:
        """Read a part, and make sure that it was there: what is gone reads as NaN."""
        try:
            return self.samples.read(ys, xs, ss)
        finally:
            self._check()

    def _read_block(self, row: int, column: int) -> Image:
        return self.read(*(slice(BLOCK * i, BLOCK * (i + 1)) for i in (row, column)))

    def _check(self) -> None:
        path = self.samples.path
        if path is not None and not is_store(path):
            message = f"the store {path} is gone: it was deleted or moved; open it again"
            raise StoreError(message)


def _mixed(x: Image) -> Image:
    """Return samples of several pixels, (pixel, channel, sample), as those of one place.

    They are shuffled, always in the same way: what looks at consecutive samples, such as averages
    of N, is to see the region and not one pixel after the other.
    """
    pool = np.ascontiguousarray(x.swapaxes(0, 1)).reshape(x.shape[1], -1)
    return np.asarray(pool[:, generator(0).permutation(pool.shape[1])])


def pooled(height: int, width: int, spp: int) -> tuple[int, int]:
    """Return how many samples to pool of every `step`-th pixel of a region, and `step`.

    Examples
    --------
    >>> pooled(8, 8, 1024), pooled(512, 512, 1024)
    ((512, 1), (2, 4))
    """
    step = max(1, math.ceil(math.sqrt(height * width / (MOST_POOLED / 2))))
    pixels = -(-height // step) * -(-width // step)
    return max(1, min(spp, MOST_POOLED // pixels)), step


# --- a scene ------------------------------------------------------------------------------------

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
        self._seed, self._render = seed_number(render.job.options["seed"]), render
        (width, height), self._integrator = self._render.described
        self.size: tuple[int, int] = (height, width)
        self.name = self.title = render.job.scene.name
        self._coarse = coarse
        self._preview = np.full((height, width, len(self.channels)), np.nan, np.float32)
        if coarse is not None:
            self._preview = self._enlarged(coarse)
        self._pixels: dict[PixelIndex, Image] = {}
        self._tiles = [
            (ys, xs, ImageAccumulator(ys.stop - ys.start, xs.stop - xs.start))
            for ys, xs in product(*(spans(length, TILE) for length in self.size))
        ]
        self._drawn = 0

    def describe(self) -> str:
        """Return size and integrator in one line."""
        height, width = self.size
        return f"{width} × {height} px · {self._integrator} · sampled where you click"

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

    def some(self, pixels: Sequence[PixelIndex], spp: int) -> Image:
        """Draw samples of several pixels, shape (pixel, channel, sample)."""
        drawn: Image = self._render("pixels", np.array(pixels), spp)
        return drawn

    def region(self, box: Box) -> Image:
        """Return pooled samples of a region, as many of each pixel, shape (channel, sample)."""
        top, left, bottom, right = box
        each, step = pooled(bottom - top, right - left, 64)
        at = [(y, x) for y in range(top, bottom, step) for x in range(left, right, step)]
        return _mixed(self._render("pixels", np.array(at), each))

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
        drop_oldest(self._pixels, lambda held: held.nbytes)


# --- an image -----------------------------------------------------------------------------------


class ImageSource:
    """An image without samples, such as an EXR file.

    Attributes
    ----------
    size, channels, name
        As of a store.
    """

    def __init__(self, path: Path) -> None:
        found = read_exr(path)
        self.channels, self._image = _named(found.channels), found.image
        self.size: tuple[int, int] = (found.image.shape[0], found.image.shape[1])
        self.name = self.title = path.name

    def describe(self) -> str:
        """Return its size in one line."""
        height, width = self.size
        return f"{width} × {height} px · an image without samples"

    def overall(self) -> Overall:
        """Return the image."""
        return replace(Overall.empty(*self.size, len(self.channels)), mean=self._image)


def _named(channels: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of channels; a single one is luminance, whatever files call it."""
    return channels if len(channels) > 1 else ("luminance",)


Sampled = StoreSource | SceneSource
AnySource = Sampled | ImageSource
