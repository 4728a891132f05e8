"""Images of a store or of a scene, and their pixels as a browser shows them.

`preview` and `stream` make the image of a store in constant memory. `SceneSource` renders a scene
that has no store: the image coarsely, tile by tile, and a pixel when it is picked, with more
samples for as long as it stays selected. Only the thread that owns the renderer draws.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._core.arrays import is_bad, is_null, luminance, spans
from chdstat._core.image_scales import RadianceSums, display_stops, mean_of_pixels
from chdstat._core.moments import Moments
from chdstat.errors import InputError, SceneError
from chdstat.explorer.sources import Box, StoreSource, mixed, pooled
from chdstat.explorer.view import check_pixel
from chdstat.rendering.backend import activate
from chdstat.rendering.jobs import job_of
from chdstat.rendering.renderer import Renderer
from chdstat.samples.layout import TILE, Chunk
from chdstat.scenes import Scene

__all__ = [
    "FIRST_SPP",
    "MOST_SPP",
    "ImageAccumulator",
    "Overall",
    "SceneSource",
    "preview",
    "rgba",
    "stream",
]

_PREVIEW_SPP = 64
_FILMIC = (0.15, 0.50, 0.10, 0.20, 0.02, 0.30)
_WHITE = 11.2
_TILE = 64
_BATCH = 64

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Overall:
    """The image and what comes with it for nothing.

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
    spp
        Samples per pixel behind them.
    """

    mean: Image
    null_share: Image
    good_count: Image
    bad_count: Image
    variance: Image
    variation: Image
    extreme: Image
    others: Image
    spp: int

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
        maps = np.full((7, height, width), np.nan, np.float32)
        return cls.of_maps(mean, maps)

    @classmethod
    def of_maps(cls, mean: Image, maps: Image) -> Overall:
        """Return the image of a mean and of the other maps, stacked in their order."""
        null, good, bad, variance, variation, extreme, others = maps
        return cls(mean, null, good, bad, variance, variation, extreme, others, 0)

    def put(self, ys: slice, xs: slice, part: Overall) -> None:
        """Write a part of the image."""
        for field in fields(self):
            if field.name != "spp":
                getattr(self, field.name)[ys, xs] = getattr(part, field.name)


def preview(source: StoreSource) -> Overall:
    """Return the image of the first samples, which takes a second where all take minutes."""
    spp = min(source.samples.spp, _PREVIEW_SPP)
    whole = Overall.empty(*source.size, len(source.channels))
    for ys, xs in source.tiles(_TILE):
        whole.put(ys, xs, _of_blocks(iter([source.read(ys, xs, slice(0, spp))])))
    return replace(whole, spp=spp)


def stream(source: StoreSource, step: Callable[[float], None]) -> Overall:
    """Return the image of all samples, in constant memory.

    Parameters
    ----------
    source
        The store.
    step
        Told the share that is done; whatever it raises ends the pass.
    """
    spp = source.samples.spp
    whole = Overall.empty(*source.size, len(source.channels))
    tiles = list(source.tiles(_TILE))
    batches = [slice(s, min(s + _BATCH, spp)) for s in range(0, spp, _BATCH)]

    for i, (ys, xs) in enumerate(tiles):

        def blocks(i: int = i, ys: slice = ys, xs: slice = xs) -> Iterator[Image]:
            for j, ss in enumerate(batches):
                step((i + j / len(batches)) / len(tiles))
                yield source.read(ys, xs, ss)

        whole.put(ys, xs, _of_blocks(blocks()))
    return replace(whole, spp=spp)


class ImageAccumulator:
    """Sums over blocks (y, x, channel, sample) of the same pixels, in constant memory."""

    def __init__(self) -> None:
        self._moments: Moments | None = None
        self._nulls: Any = 0
        self._bads: Any = 0
        self._sums: RadianceSums | None = None

    def add(self, block: Image) -> None:
        """Count more samples."""
        bad = np.asarray(is_bad(block).any(axis=-2))
        good = ~bad
        if self._sums is None:
            self._sums = RadianceSums(block.shape[:-2])
        self._sums.add(block)
        self._nulls = self._nulls + np.count_nonzero(is_null(block) & good, axis=-1)
        self._bads = self._bads + np.count_nonzero(bad, axis=-1)
        with np.errstate(invalid="ignore", over="ignore"):
            rows = np.concatenate([block, luminance(block)[..., np.newaxis, :]], axis=-2)
        found = Moments.of(rows, good[..., np.newaxis, :] if bad.any() else None)
        self._moments = found if self._moments is None else self._moments.merge(found)

    def overall(self) -> Overall:
        """Return the image of what was counted; `spp` is left to who knows it."""
        moments, sums = self._moments, self._sums
        if moments is None or sums is None:
            message = "no samples were counted yet"
            raise InputError(message)
        mean = moments.seen(moments.mean)
        variance = moments.variance[..., -1]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            share = self._nulls / moments.count[..., 0]
            variation = np.where(mean[..., -1] > 0, np.sqrt(variance) / mean[..., -1], np.nan)
            bads = np.broadcast_to(self._bads, share.shape)
            maps = np.stack([share, moments.count[..., 0], bads, variance, variation])
            maps = np.concatenate([maps, [sums.extreme, sums.others]]).astype(np.float32)
        image = mean[..., :-1].astype(np.float32)
        return Overall.of_maps(image, maps)


def _of_blocks(blocks: Iterator[Image]) -> Overall:
    accumulator = ImageAccumulator()
    for block in blocks:
        accumulator.add(block)
    return accumulator.overall()


# --- on the screen ------------------------------------------------------------------------------


def rgba(mean: Image, exposure: float, tone: str) -> npt.NDArray[np.uint32]:
    """Return an image as a browser wants it: packed RGBA, shape (y, x).

    Parameters
    ----------
    mean
        Linear radiance, shape (y, x, channel); what is not finite becomes magenta.
    exposure
        Stops.
    tone
        'srgb' clips, 'reinhard' maps v to v / (1 + v), 'filmic' is Hable's curve.

    References
    ----------
    Reinhard, Stark, Shirley and Ferwerda, "Photographic tone reproduction for digital images",
    2002, doi:10.1145/566654.566575, equation 3. Hable, "Uncharted 2: HDR lighting", Game Developers
    Conference 2010.

    Examples
    --------
    >>> hex(rgba(np.ones((1, 1, 3), np.float32), 0, "srgb")[0, 0])
    '0xffffffff'
    """
    with np.errstate(invalid="ignore", over="ignore"):
        value = mean * np.float32(2.0**exposure)
        if tone == "reinhard":
            value = np.where(np.isfinite(value), value / (1 + value), value)
        elif tone == "filmic":
            value = np.where(
                np.isfinite(value), _hable(2 * value) / _hable(np.float32(_WHITE)), value
            )
    shown = viz.tonemap(value, exposure=0)
    packed = np.full((*shown.shape[:2], 4), 255, np.uint8)
    packed[..., :3] = np.round(255 * shown)
    return packed.view(np.uint32)[..., 0]


def _hable(v: npt.NDArray[np.float32] | np.float32) -> npt.NDArray[np.float32]:
    a, b, c, d, e, f = _FILMIC
    v = np.minimum(v, np.float32(1e15))  # v squared stays within float32
    return np.asarray((v * (a * v + c * b) + d * e) / (v * (a * v + b) + d * f) - e / f, np.float32)


FIRST_SPP = 2048
MOST_SPP = 10**6
_PIECE = 4096
"""Samples drawn at once while one looks at a pixel: a tenth of a second, so that a click waits for
no more."""
_PASSES = (1, 1, 2, 2, 2, 2, 2, 2, 2)
"""Samples per pixel of the passes over the image."""
_KEPT_BYTES = 128 * 2**20


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
        self._accumulators: dict[tuple[int, int], tuple[slice, slice, ImageAccumulator]] = {}
        self._spp = 0

    def describe(self) -> str:
        """Say in one line what there is to see."""
        height, width = self.size
        kind = self._renderer.integrator["type"]
        return f"{width} × {height} px · {kind} · sampled where you click"

    def pixel(self, y: int, x: int) -> Image:
        """Return the samples that a pixel has; the first of them are drawn on the first call."""
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
        """Draw the image better and better; yield the share that is done after each tile."""
        height, width = self.size
        tiles = [(ys, xs) for ys in spans(height, TILE) for xs in spans(width, TILE)]
        start, done, total = 0, 0, len(tiles) * len(_PASSES)
        for spp in _PASSES:
            for i, (ys, xs) in enumerate(tiles):
                columns = -(-width // TILE)
                chunk = Chunk(0, i // columns, i % columns, ys, xs, slice(start, start + spp))
                with activate(self._job.verdict):
                    block = self._renderer.chunk(chunk)
                *_, accumulator = self._accumulators.setdefault(
                    (ys.start, xs.start), (ys, xs, ImageAccumulator())
                )
                accumulator.add(block)
                self._spp = start + spp
                done += 1
                yield done / total
            start += spp
        if not np.nan_to_num(self.overall().mean).any():
            message = f"the image of {self.name!r} is black: does it have an emitter?"
            raise SceneError(message)

    def overall(self) -> Overall:
        """Return the image as far as it is drawn."""
        whole = Overall.empty(*self.size, 3)
        for ys, xs, accumulator in self._accumulators.values():
            whole.put(ys, xs, accumulator.overall())
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
            while (
                len(self._pixels) > 1 and sum(x.nbytes for x in self._pixels.values()) > _KEPT_BYTES
            ):
                self._pixels.pop(next(iter(self._pixels)))
        return found
