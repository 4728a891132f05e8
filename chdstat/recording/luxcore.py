"""LuxCore's path tracer as a source of passes.

It runs in a process of its own (`chdstat.recording.luxcore_worker`). What makes samples of a scene
independent, unclamped and linear is set there and named in notes; files are left as they are.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
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

_WORKER = Path(__file__).with_name("luxcore_worker.py")


class LuxCoreSource:
    """Draws passes of a LuxCore scene by its path engine on the CPU.

    A pass is drawn by one thread, so that equal seeds give equal samples, to the bit.

    Parameters
    ----------
    path
        A .scn file, or a .cfg file with settings, whose scene.file lies beside it or in a folder
        above.
    size
        (width, height) in pixels; None for the settings' own.
    crop
        (x, y, width, height): only this part of the image.
    max_depth
        Longest path in segments, at least 2; None for the settings' own.
    direct
        Refused: LuxCore counts some direct light, which paths find by chance, as indirect.
    by_light
        Light groups as ``"group-1"``, or patterns of names of lights (and of materials that emit)
        that share their light groups with no other, whose light is also returned by itself.
    **parameters
        A LuxCore scene has none.

    Raises
    ------
    InputError
        If there is a parameter, `direct`, or the size has a wrong value.
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
        if parameters:
            message = f"a LuxCore scene has no parameters, got {sorted(parameters)[0]!r}"
            raise InputError(message)
        if direct:
            message = (
                "LuxCore cannot tell direct light apart: it counts what a path finds by chance at "
                "its second point as indirect; leave direct out, or render with max_depth=2"
            )
            raise InputError(message)
        if max_depth is not None:
            max_depth = whole("max_depth", max_depth, least=DIRECT_DEPTH)
        self._path = Path(path).absolute()
        self._image: dict[str, Any] = {
            "size": size and [whole("size", n, least=1) for n in size],
            "crop": crop and [whole("crop", n, least=0) for n in crop],
            "max_depth": max_depth,
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
            If the scene cannot be read, or LuxCore ends.
        """
        _, arrays = self._started().call("draw", seed=seed)
        image = arrays.pop("image")
        parts: dict[LightPart, Image] = {n.removeprefix("light "): a for n, a in arrays.items()}
        return DrawnPass(image, self._features, parts)

    def close(self) -> None:
        """End LuxCore; the next pass starts it again."""
        if self._process is not None:
            self._process.close()
        self._process = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the process behind: who is sent elsewhere starts another one."""
        return {"_path": self._path, "_image": self._image}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._process = None

    def _started(self) -> RendererProcess:
        if self._process is not None and self._process.is_running:
            return self._process
        if not self._path.is_file():
            message = f"there is no file {self._path}"
            raise SceneError(message)
        if importlib.util.find_spec("pyluxcore") is None:
            message = "LuxCore scenes need LuxCore: pip install 'chdstat[luxcore]'"
            raise RenderError(message)
        process = RendererProcess([sys.executable], _WORKER, renderer="LuxCore")
        try:
            about, _ = process.call("load", path=str(self._path))
            image, _ = process.call("frame", **self._image)
            self._check_crop(*image["size"])
            _, self._features = process.call("features")
        except BaseException:
            process.close()
            raise
        self._attrs = self._described(about, image)
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

    def _described(self, about: dict[str, Any], image: dict[str, Any]) -> dict[str, Any]:
        files = {path.name: digest_of(path) for path in map(Path, about["files"])}
        files[self._path.name] = digest_of(self._path)
        return {
            "scene": self.name,
            "renderer": f"LuxCore {about['version']}",
            "scene_source": str(self._path),
            "scene_hash": hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest(),
            "scene_files": {name: digest[:16] for name, digest in sorted(files.items())},
            "size": image["size"],
            "crop": self._image["crop"],
            "integrator": {"type": "luxcore", **image["integrator"]},
            "filter": "box",
            "units": "linear radiance",
            "notes": about["notes"],
            "parameters": {},
        }
