"""Samples: every radiance sample of an image, in memory or in a store on disk."""

from __future__ import annotations

from chdstat._core.arrays import Mapped
from chdstat.samples.assembly import reduce_tiles
from chdstat.samples.layout import is_store
from chdstat.samples.samples import ImageLike, Samples
from chdstat.samples.store import (
    cache_key,
    checkpoint_key,
    inspect,
    open,  # noqa: A004 - chdstat.open reads like open
    opened,
    samples_of,
)
from chdstat.samples.tiles import Region, SampleBlocks

__all__ = [
    "ImageLike",
    "Mapped",
    "Region",
    "SampleBlocks",
    "Samples",
    "cache_key",
    "checkpoint_key",
    "inspect",
    "is_store",
    "open",
    "opened",
    "reduce_tiles",
    "samples_of",
]
