"""Renderers other than Mitsuba, by the names that `chdstat.scenes.scene.RENDERERS` has for them."""

from __future__ import annotations

from typing import Any

from chdstat.recording.cycles import CyclesSource
from chdstat.recording.luxcore import LuxCoreSource
from chdstat.recording.pass_sources import PassSource
from chdstat.recording.scene_files import SceneFileSource
from chdstat.scenes import Scene

_SOURCES: dict[str, type[SceneFileSource]] = {"Cycles": CyclesSource, "LuxCore": LuxCoreSource}


def works() -> dict[str, str]:
    """Return by renderer whether it works here; each is tried in a process of its own.

    Examples
    --------
    >>> [*works()]
    ['Cycles', 'LuxCore']
    """
    return {name: source.works() for name, source in _SOURCES.items()}


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
    source: Any = _SOURCES[scene.renderer]
    found: PassSource = source(scene.source, **options, **scene.parameters)
    return found
