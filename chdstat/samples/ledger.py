"""Ledger: how many samples each pixel should have, and which chunks of them there are.

In most renders, all pixels have as many samples as each other. An adaptive render decides a
*density*, the samples of each pixel over their mean, from the first samples, which all pixels have;
`counts_of` makes whole numbers of it. As the mean grows, no pixel loses samples, so that a chunk
only ever lacks samples at the end of some of its pixels: `missing_of` says which.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, block_sums
from chdstat.samples.tiles import ALL, BATCH, TILE, Chunk, chunk_grid

PixelCounts = npt.NDArray[np.int32]
"""A number of samples for each pixel, shape (y, x)."""
_GOLDEN = (5**0.5 - 1) / 2


def counts_of(density: Image, spp: float, least: int) -> PixelCounts:
    """Return the number of samples of each pixel, shape (y, x): `spp` times its density, rounded.

    The offsets of the rounding are a sequence of low discrepancy, so that the mean is `spp`. They
    do not depend on `spp`, so that no pixel loses samples when `spp` grows.

    Examples
    --------
    >>> counts_of(np.array([[0.25, 1.75]], np.float32), 10, least=4)
    array([[ 4, 18]], dtype=int32)
    """
    offsets = (np.arange(density.size) + 0.5) * _GOLDEN % 1
    wanted = density.astype(np.float64) * spp + offsets.reshape(density.shape)
    return np.maximum(wanted, least).astype(np.int32)


def missing_of(held: Image, counts: PixelCounts) -> npt.NDArray[np.bool_]:
    """Return which of the first `counts` samples of each pixel are missing, shape (y, x, sample).

    The samples of a pixel end with its last sample that is not NaN. A bad one at the end is drawn
    again.
    """
    number = np.arange(held.shape[-1])
    known = (~np.isnan(held).all(axis=2) * (number + 1)).max(axis=-1, keepdims=True)
    return np.asarray((number >= known) & (number < counts[..., np.newaxis]))


class Ledger:
    """The chunks of a store, and how many of their samples there are.

    Parameters
    ----------
    shape
        Room of the store, (y, x, channel, sample).
    counts
        Samples that each pixel should have, shape (y, x), in an adaptive render; None if all should
        have as many.

    Attributes
    ----------
    full, held
        Samples that a chunk should hold and that it holds, shape (tile_y, tile_x, batch): of each
        of its pixels, or with `counts` of all its pixels together.
    """

    def __init__(self, shape: tuple[int, int, int, int], counts: PixelCounts | None) -> None:
        self.shape, self.counts = shape, counts
        starts = np.arange(0, shape[3], BATCH)
        grid = -(-shape[0] // TILE), -(-shape[1] // TILE), len(starts)
        self.full = np.zeros(grid, np.int32)
        self.full[...] = np.minimum(BATCH, shape[3] - starts)
        if counts is not None:
            for i, start in enumerate(starts):
                own = np.clip(counts - start, 0, BATCH)[..., np.newaxis]
                self.full[..., i] = block_sums(own, TILE)[..., 0]
        self.held = np.zeros_like(self.full)

    def chunks(self, ys: slice = ALL, xs: slice = ALL, ss: slice = ALL) -> Iterator[Chunk]:
        """Yield the chunks of a part of the samples, in the order of rendering."""
        height, width, _, spp = self.shape
        return chunk_grid(height, width, spp, ys=ys, xs=xs, ss=ss)

    def note(self, chunk: Chunk, samples: int | None = None) -> None:
        """Count a chunk as stored, with all its samples or some."""
        full = self.full[chunk.index]
        self.held[chunk.index] = full if samples is None else min(samples, full)

    def note_first(self, spp: int) -> None:
        """Count the first samples of every pixel as stored."""
        starts = np.arange(0, self.shape[3], BATCH)
        if self.counts is None:
            self.held = np.asarray(np.clip(spp - starts, 0, self.full), np.int32)
        else:  # of a batch in part, the counts are in its labels
            whole = (starts + BATCH <= spp) | (spp >= self.shape[3])
            self.held = np.where(whole, self.full, 0)

    def pending(self) -> list[Chunk]:
        """Return the chunks that are not all there, in the order of rendering."""
        return [c for c in self.chunks() if self.held[c.index] < self.full[c.index]]

    @property
    def lacking(self) -> int:
        """Samples that will be drawn, over all pixels."""
        if self.counts is None:  # a chunk is drawn as a whole
            return sum(chunk.size for chunk in self.pending())
        return int(self.full.sum()) - int(self.held.sum())

    @property
    def complete_spp(self) -> int:
        """Leading samples that every pixel has, out of those it should have.

        In an adaptive render, only whole batches count.
        """
        short = (self.held < self.full).any(axis=(0, 1))
        if not short.any():
            return int(self.shape[3])
        batch = int(short.argmax())
        stored = 0 if self.counts is not None else int(self.held[..., batch].min())
        return int(BATCH * batch + stored)

    def to_draw(self, chunk: Chunk, read: Callable[[Chunk], Image]) -> Chunk:
        """Return a chunk with its missing samples marked, if counts differ on purpose.

        `read` returns the samples that a chunk holds, NaN for the others.
        """
        if self.counts is None:
            return chunk
        height, width, samples = chunk.shape
        held = np.full((height, width, 1, samples), np.nan, np.float32)
        if self.held[chunk.index]:
            held = read(chunk)
        wanted = self.counts[chunk.ys, chunk.xs] - chunk.ss.start
        return replace(chunk, missing=missing_of(held, wanted))

    def grown(self, shape: tuple[int, int, int, int], counts: PixelCounts | None) -> Ledger:
        """Return the ledger of a store with more room, in which as much is stored."""
        found = Ledger(shape, counts)
        found.held[..., : self.held.shape[2]] = self.held
        return found
