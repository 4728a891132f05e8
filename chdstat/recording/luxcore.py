"""LuxCore's path tracer as a source of passes.

It runs in a process of its own (`chdstat.recording.luxcore_worker`). What makes samples of a scene
independent, unclamped and linear is set there and named in notes; files are left as they are.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

from chdstat.errors import InputError, RenderError
from chdstat.recording.scene_files import SceneFileSource


class LuxCoreSource(SceneFileSource):
    """Draws passes of a LuxCore scene by its path engine on the CPU.

    It takes what `SceneFileSource` takes, but no parameters and no `direct`. The file is a scene,
    .scn, or settings, .cfg, whose scene.file lies beside it or in a folder above. Names in
    `by_light` are light groups as ``"group-1"``, or patterns of names of lights (and of materials
    that emit) that share their light groups with no other. A pass is drawn by one thread, so that
    equal seeds give equal samples, to the bit.
    """

    renderer, worker = "LuxCore", Path(__file__).with_name("luxcore_worker.py")

    @staticmethod
    def command() -> list[str]:
        """Return the command that runs a Python file where the renderer is; RenderError if none."""
        if importlib.util.find_spec("pyluxcore") is None:
            message = "LuxCore scenes need LuxCore: pip install 'chdstat[luxcore]'"
            raise RenderError(message)
        return [sys.executable]

    @staticmethod
    def checked(parameters: dict[str, Any]) -> dict[str, Any]:
        """Return the parameters of a scene; InputError if there are no such."""
        if parameters:
            message = f"a LuxCore scene has no parameters, got {min(parameters)!r}"
            raise InputError(message)
        return parameters
