"""Cycles, Blender's path tracer, as a source of passes.

It runs in a Blender of its own (`chdstat.recording.cycles_worker`), found by `blender`. What makes
samples of a scene independent, unclamped and linear is set in its memory and named in notes; the
file is left as it is.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from chdstat._core.arrays import Image, whole
from chdstat.errors import InputError, RenderError, SceneError
from chdstat.recording.pass_sources import DrawnPass
from chdstat.recording.processes import RendererProcess
from chdstat.samples.tiles import DIRECT_DEPTH, LightPart
from chdstat.scenes.scene import digest_of

_VARIABLE = "CHDSTAT_BLENDER"
"""Environment variable with the path of a `blender`, or of a Python that has bpy."""
_WORKER = Path(__file__).with_name("cycles_worker.py")
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


def works() -> str:
    """Return whether Cycles works here, and which one, or why not; tried in a process of its own.

    Examples
    --------
    >>> works().startswith(("works: Cycles", "does not work: "))
    True
    """
    try:
        command = blender()
        process = RendererProcess(command, _WORKER, renderer="Cycles")
    except RenderError as error:
        return f"does not work: {error}"
    found, _ = process.call("version")
    process.close()
    return f"works: Cycles {found['version']} ({command[0]})"


class CyclesSource:
    """Draws passes of a Blender scene by Cycles.

    Parameters
    ----------
    path
        A .blend file.
    size
        (width, height) in pixels; None for the scene's own.
    crop
        (x, y, width, height): only this part of the image.
    max_depth
        Longest path in segments, at least 2; None for the scene's own.
    direct
        Also return emission and direct light of each sample.
    by_light
        Names of lights and light groups, or patterns such as ``"Lamp*"``, whose light is also
        returned by itself.
    **parameters
        frame, camera, view_layer and scene: which of those in the file.

    Raises
    ------
    InputError
        If there is no such parameter, or it or the size has a wrong value.
    """

    def __init__(
        self,
        path: str | Path,
        size: tuple[int, int] | None = None,
        crop: tuple[int, int, int, int] | None = None,
        max_depth: int | None = None,
        direct: bool = False,
        by_light: Sequence[str] = (),
        **parameters: Any,
    ) -> None:
        if unknown := sorted(parameters.keys() - set(_PARAMETERS)):
            message = (
                f"a Blender scene has no parameter {unknown[0]!r}; it has {', '.join(_PARAMETERS)}"
            )
            raise InputError(message)
        if parameters.get("frame") is not None:
            parameters["frame"] = whole("frame", parameters["frame"], least=-(2**20))
        if max_depth is not None:
            max_depth = whole("max_depth", max_depth, least=DIRECT_DEPTH)
        self._path = Path(path).absolute()
        self._parameters = {n: v for n, v in parameters.items() if v is not None}
        self._image: dict[str, Any] = {
            "size": size and [whole("size", n, least=1) for n in size],
            "crop": crop and [whole("crop", n, least=0) for n in crop],
            "max_depth": max_depth,
            "direct": direct,
            "by_light": [*by_light],
        }
        self._process: RendererProcess | None = None

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self._path.stem

    @property
    def attrs(self) -> dict[str, Any]:
        """Provenance, ready for JSON."""
        self._started()
        return dict(self._attrs)

    @property
    def notes(self) -> list[str]:
        """What of the scene was set otherwise, or cannot be told, in words."""
        return list(self.attrs["notes"])

    def __call__(self, seed: int) -> DrawnPass:
        """Draw one sample of every pixel.

        Raises
        ------
        SceneError, RenderError
            If the scene cannot be read, or Blender ends.
        """
        _, arrays = self._started().call("draw", seed=seed)
        image = arrays.pop("image")
        parts: dict[LightPart, Image] = {
            DIRECT_DEPTH if name == "direct" else name.removeprefix("light "): array
            for name, array in arrays.items()
        }
        return DrawnPass(image, self._features, parts)

    def close(self) -> None:
        """End Blender; the next pass starts it again."""
        if self._process is not None:
            self._process.close()
        self._process = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the process behind: who is sent elsewhere starts another one."""
        return {n: v for n, v in self.__dict__.items() if n in ("_path", "_parameters", "_image")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._process = None

    def _started(self) -> RendererProcess:
        if self._process is not None and self._process.is_running:
            return self._process
        if not self._path.is_file():
            message = f"there is no file {self._path}"
            raise SceneError(message)
        process = RendererProcess(blender(), _WORKER, renderer="Cycles")
        try:
            about, _ = process.call("load", path=str(self._path), **self._parameters)
            image, _ = process.call("frame", **self._image)
            self._check_crop(*image["size"])
            _, self._features = process.call("features")
        except BaseException:
            process.close()
            raise
        self._attrs = self._described(about, image["size"])
        self._process = process
        return process

    def _check_crop(self, width: int, height: int) -> None:
        crop = self._image["crop"]
        if crop is None:
            return
        x, y, w, h = crop
        if min(w, h) < 1 or x + w > width or y + h > height:
            message = (
                f"crop must be (x, y, width, height) within the image of {width} x {height} "
                f"pixels, got {tuple(crop)}"
            )
            raise InputError(message)

    def _described(self, about: dict[str, Any], size: list[int]) -> dict[str, Any]:
        files = {path.name: digest_of(path) for path in map(Path, about["files"])}
        files[self._path.name] = digest_of(self._path)
        parts = json.dumps([files, about["parameters"]], sort_keys=True)
        depth = self._image["max_depth"]
        integrator = {"type": "cycles", **about["integrator"]}
        if depth is not None:
            integrator["max_bounces"] = min(integrator["max_bounces"], depth - DIRECT_DEPTH)
        return {
            "scene": self.name,
            "renderer": f"Cycles {about['version']}",
            "scene_source": str(self._path),
            "scene_hash": hashlib.sha256(parts.encode()).hexdigest(),
            "scene_files": {name: digest[:16] for name, digest in sorted(files.items())},
            "size": size,
            "crop": self._image["crop"],
            "integrator": integrator,
            "filter": "box",
            "units": "linear radiance",
            "notes": about["notes"],
            "parameters": about["parameters"],
        }
