"""Cameras of the built-in scenes, as plain scene entries."""

from __future__ import annotations

from chdstat.scenes.materials import Entry
from chdstat.scenes.transforms import Vector, look_at

__all__ = ["camera"]


def camera(origin: Vector, target: Vector, *, fov: float) -> Entry:
    """Return a camera that looks from `origin` at `target`; `fov` is in degrees across."""
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.01,
        "far_clip": 100.0,
        "to_world": look_at(origin, target),
        "film": {"type": "hdrfilm", "width": 512, "height": 512, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }
