"""Samples: every radiance sample of an image, in memory or in a store on disk."""

from __future__ import annotations

from chdstat.samples.access import (
    Blocks,
    cache_key,
    checked,
    inspect,
    is_store,
    open,  # noqa: A004 - chdstat.open reads like open
    reduce_tiles,
)
from chdstat.samples.samples import Mapped, Samples

__all__ = [
    "Blocks",
    "Mapped",
    "Samples",
    "cache_key",
    "checked",
    "inspect",
    "is_store",
    "open",
    "reduce_tiles",
]
