"""Rendering: a scene to samples through Mitsuba, keeping every sample or none.

`render` keeps all samples, in memory or in a store. `render_batches` yields them as they are
rendered. `render_pixels` renders only a few pixels.
"""

from __future__ import annotations

from chdstat.rendering.batches import Rendering, render_batches
from chdstat.rendering.jobs import RenderSettings, refuse_render
from chdstat.rendering.renders import render, render_pixels

__all__ = [
    "RenderSettings",
    "Rendering",
    "refuse_render",
    "render",
    "render_batches",
    "render_pixels",
]


def __dir__() -> list[str]:
    return sorted(__all__)
