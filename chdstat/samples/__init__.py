"""Samples: every radiance sample of an image, in memory or in a store on disk."""

from __future__ import annotations

from chdstat.samples.samples import Samples, checked, inspect, open  # noqa: A004 - chdstat.open reads like open

__all__ = ["Samples", "checked", "inspect", "open"]
