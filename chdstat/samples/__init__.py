"""Samples: every radiance sample of an image, in memory or in a store on disk."""

from __future__ import annotations

from chdstat.samples.access import (
    Blocks,
    ImageLike,
    cache_key,
    check_equal_counts,
    checkpoint_key,
    inspect,
    is_store,
    open,  # noqa: A004 - chdstat.open reads like open
    opened,
    reduce_tiles,
    samples_of,
)
from chdstat.samples.samples import Samples
from chdstat.samples.tiles import Mapped

__all__ = [
    "Blocks",
    "ImageLike",
    "Mapped",
    "Samples",
    "cache_key",
    "check_equal_counts",
    "checkpoint_key",
    "inspect",
    "is_store",
    "open",
    "opened",
    "reduce_tiles",
    "samples_of",
]
