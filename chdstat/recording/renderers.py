"""Renderers other than Mitsuba, by the names that `chdstat.scenes.scene.RENDERERS` has for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from chdstat.recording.cycles import CyclesSource
from chdstat.recording.luxcore import LuxCoreSource
from chdstat.recording.pass_sources import PassSource
from chdstat.scenes import Scene

_SOURCES: dict[str, Callable[..., PassSource]] = {
    "Cycles": CyclesSource,
    "LuxCore": LuxCoreSource,
}


def source_of(scene: Scene, **options: Any) -> PassSource:
    """Return what draws the passes of a scene of another renderer; its process is started.

    Parameters
    ----------
    scene
        Scene of a file in the form of another renderer.
    **options
        As for `chdstat.render`: `size`, `crop`, `max_depth`, `direct` and `by_light`.

    Raises
    ------
    InputError, SceneError, RenderError
        If the scene cannot be read or drawn so, or the renderer is not there.
    """
    return _SOURCES[scene.renderer](scene.source, **options, **scene.parameters)
