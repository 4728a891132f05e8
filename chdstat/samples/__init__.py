"""Samples: every radiance sample of an image, in memory or in a store on disk."""

from __future__ import annotations

from chdstat.samples.access import checked, inspect, open  # noqa: A004 - chdstat.open reads like open
from chdstat.samples.samples import Samples

__all__ = ["Samples", "checked", "inspect", "open"]
