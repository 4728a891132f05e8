"""Cycles, Blender's path tracer, as a source of passes.

It runs in a Blender of its own (`chdstat.recording.cycles_worker`), found by `blender`. What makes
samples of a scene independent, unclamped and linear is set in its memory and named in notes; the
file is left as it is.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from chdstat._core.arrays import whole
from chdstat.errors import InputError, RenderError
from chdstat.recording.scene_files import SceneFileSource

_VARIABLE = "CHDSTAT_BLENDER"
"""Environment variable with the path of a `blender`, or of a Python that has bpy."""
_PARAMETERS = ("frame", "camera", "view_layer", "scene")


def blender() -> list[str]:
    """Return the command that runs a Python file in Blender.

    It is the one that `_VARIABLE` names, or this Python if it has bpy, or `blender`.

    Raises
    ------
    RenderError
        If there is none.
    """
    named = os.environ.get(_VARIABLE)
    if not named and importlib.util.find_spec("bpy"):
        return [sys.executable]
    program = named or shutil.which("blender")
    if program is None:
        message = (
            f"Blender scenes need Blender: set ${_VARIABLE} to the path of a blender program, or "
            "install its module for Python 3.11: pip install 'chdstat[blender]'"
        )
        raise RenderError(message)
    if Path(program).name.startswith("python"):
        return [program]
    return [program, "--background", "--factory-startup", "--disable-autoexec", "--python"]


class CyclesSource(SceneFileSource):
    """Draws passes of a Blender scene by Cycles.

    It takes what `SceneFileSource` takes. Names in `by_light` may be light groups of the file, too.
    Parameters are frame, camera, view_layer and scene: which of those in the file.
    """

    renderer, worker = "Cycles", Path(__file__).with_name("cycles_worker.py")
    command = staticmethod(blender)

    @staticmethod
    def checked(parameters: dict[str, Any]) -> dict[str, Any]:
        """Return the parameters of a scene; InputError if there are no such."""
        if unknown := sorted(parameters.keys() - set(_PARAMETERS)):
            message = (
                f"a Blender scene has no parameter {unknown[0]!r}; it has {', '.join(_PARAMETERS)}"
            )
            raise InputError(message)
        if "frame" not in parameters:
            return parameters
        text = parameters["frame"]
        number = int(text) if isinstance(text, str) and text.lstrip("-").isdecimal() else text
        return parameters | {"frame": whole("frame", number, least=-(2**20))}
