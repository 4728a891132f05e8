"""Brushing: which pixels hold the samples of a range of radiance, and how much light these carry.

A brush is a range, whose ends belong to it and may be open, or the null samples. `brushed` goes
through a store a chunk at a time: the first samples of all pixels, then the others, tile by tile.
Its memory grows with the image, not with the samples. Null and bad samples are in no range.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Image, is_bad, is_null, luminance, spans
from chdstat._core.display import number, percent
from chdstat.explorer.address import NULLS, Brush
from chdstat.explorer.image_sources import StoreSource
from chdstat.samples.tiles import BATCH, TILE


@dataclass(frozen=True)
class Brushed:
    """What is known of the samples of a brush, so far.

    Attributes
    ----------
    count, good
        Samples of the brush and all good samples, shape (y, x).
    light, total
        Luminance of those and of these, summed, shape (y, x).
    share
        `count` over `good`, NaN for none, shape (y, x).
    """

    count: npt.NDArray[np.int32]
    good: npt.NDArray[np.int32]
    light: Floats
    total: Floats
    share: Image

    @classmethod
    def empty(cls, height: int, width: int) -> Brushed:
        """Return what is known before there are samples."""
        count, good = np.zeros((2, height, width), np.int32)
        light, total = np.zeros((2, height, width))
        return cls(count, good, light, total, np.full((height, width), np.nan, np.float32))

    def add(self, ys: slice, xs: slice, block: Image, brush: Brush, channel: str) -> None:
        """Count further samples, (y, x, channel, sample), of some pixels."""
        good = ~is_bad(block).any(axis=-2)
        light = np.where(good, luminance(block), 0)
        if brush == NULLS:
            found = is_null(block) & good
        else:
            single = block.shape[-2] == 1 or channel in ("all", "luminance")
            found = _within(luminance(block) if single else block[..., int(channel), :], brush)
            found &= good & ~is_null(block)
        self.count[ys, xs] += found.sum(axis=-1, dtype=np.int32)
        self.good[ys, xs] += good.sum(axis=-1, dtype=np.int32)
        self.light[ys, xs] += (light * found).sum(axis=-1, dtype=np.float64)
        self.total[ys, xs] += light.sum(axis=-1, dtype=np.float64)
        count = self.count[ys, xs]
        with np.errstate(divide="ignore", invalid="ignore"):
            self.share[ys, xs] = np.where(count > 0, count / self.good[ys, xs], np.nan)

    def told(self, brush: Brush, channel: str) -> str:
        """Return it in one sentence.

        Examples
        --------
        >>> found = Brushed.empty(1, 2)
        >>> block = np.array([[[[0.0, 1.0, 3.0]], [[0.0, 0.0, 4.0]]]], np.float32)
        >>> found.add(slice(1), slice(2), block, (0.5, 2.0), "all")
        >>> found.told((0.5, 2.0), "luminance").replace(chr(160), " ")
        '1 pixel holds 1 sample with luminance from 0.500 to 2.00: 25 % of its light, 12 % of all'
        """
        holds = self.count > 0
        pixels, samples = int(holds.sum()), int(self.count.sum())
        kind = "null samples" if brush == NULLS else f"samples {_named(brush, channel)}"
        if not pixels:
            return f"No pixel holds {kind}"
        kind = kind if samples > 1 else kind.replace("samples", "sample", 1)
        verb, whose = ("pixels hold", "their") if pixels > 1 else ("pixel holds", "its")
        begin = f"{grouped(pixels)} {verb} {grouped(samples)} {kind}"
        with np.errstate(divide="ignore", invalid="ignore"):
            if brush == NULLS:
                of, whole = self.good[holds].sum(), self.good.sum()
                theirs, everything = (percent(float(samples / n)) for n in (of, whole))
                return f"{begin}: {everything} of all samples, {theirs} of {whose} samples"
            light = self.light.sum()
            shares = (light / self.total[holds].sum(), light / self.total.sum())
        theirs, everything = map(percent, map(float, shares))
        return f"{begin}: {theirs} of {whose} light, {everything} of all"


def brushed(source: StoreSource, brush: Brush, channel: str) -> Iterator[tuple[float, Brushed]]:
    """Yield the share that is done, and what is known so far.

    Parameters
    ----------
    source
        The store.
    brush, channel
        As in a view: which samples, and by which number.

    Examples
    --------
    >>> from chdstat.samples import Samples
    >>> x = np.arange(8, dtype=np.float32).reshape(1, 2, 1, 4)
    >>> *_, (share, found) = brushed(StoreSource(Samples.from_array(x)), (3, 5), "all")
    >>> share, found.count.tolist()
    (1.0, [[1, 2]])
    """
    found = Brushed.empty(*source.size)
    tiles = list(product(*(spans(length, TILE) for length in source.size)))
    first, *others = spans(source.samples.spp, BATCH)
    parts = [*product(tiles, [first]), *product(tiles, others)]
    for i, ((ys, xs), ss) in enumerate(parts):
        yield i / len(parts), found
        found.add(ys, xs, source.read(ys, xs, ss), brush, channel)
    yield 1.0, found


def _within(values: Image, brush: tuple[float | None, float | None]) -> npt.NDArray[np.bool_]:
    """Return which values lie in a range, its ends included; None for no end."""
    low, high = brush
    inside = np.ones(values.shape, np.bool_)
    if low is not None:
        inside &= values >= np.float32(low)
    if high is not None:
        inside &= values <= np.float32(high)
    return inside


def _named(brush: tuple[float | None, float | None], channel: str) -> str:
    low, high = brush
    if high is None:
        return f"with {channel} of {number(low or 0)} or more"
    if low is None:
        return f"with {channel} of {number(high)} or less"
    wide = (high - low) / max(abs(low), abs(high), 1e-300)  # a narrow range needs more digits
    digits = min(max(3, 2 + math.ceil(-math.log10(max(wide, 1e-9)))), 9) if wide else 3
    return f"with {channel} from {number(low, digits)} to {number(high, digits)}"


def grouped(value: int) -> str:
    """Return a count with a thin space between thousands."""
    return f"{value:,}".replace(",", "\u2009")
