"""Rendering: a scene to samples through Mitsuba, every sample kept or none of them.

`render` keeps all samples, in memory or in a store; `render_batches` hands them over as they are
rendered; `render_pixels` renders a few pixels alone.
"""

from __future__ import annotations

from chdstat.rendering.batches import Rendering, render_batches
from chdstat.rendering.options import RenderOptions, refuse_render
from chdstat.rendering.renders import render, render_pixels

__all__ = [
    "RenderOptions",
    "Rendering",
    "refuse_render",
    "render",
    "render_batches",
    "render_pixels",
]


def __dir__() -> list[str]:
    return sorted(__all__)
