"""Scene sources: what draws passes of a scene file, by a renderer in a process of its own."""

from __future__ import annotations

import hashlib
import itertools
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from chdstat._core.arrays import Image, whole
from chdstat.errors import InputError, RenderError, SceneError
from chdstat.recording.pass_sources import DrawnPass
from chdstat.recording.processes import RendererProcess
from chdstat.samples.tiles import DIRECT_DEPTH, LightPart
from chdstat.scenes.scene import digest_of, scene_name


class SceneFileSource(ABC):
    """Draws passes of a scene file by functions of a worker file.

    The worker has ``load(path, **parameters)``, which returns the ``version``, ``notes`` and
    ``files``, ``frame(size, crop, max_depth, direct, by_light)``, which returns the ``size`` and
    the settings of the ``integrator``, ``features()`` and ``draw(seed)``.

    Parameters
    ----------
    path
        The scene file.
    size
        (width, height) in pixels; None for the scene's own.
    crop
        (x, y, width, height): only this part of the image.
    max_depth
        Longest path in segments, at least 2; None for the scene's own.
    direct
        Also return emission and direct light of each sample.
    by_light
        Names of lights, or patterns of them, whose light is also returned by itself.
    **parameters
        Parameters of the scene.

    Raises
    ------
    InputError
        If there is no such parameter, or it or the size has a wrong value.
    """

    renderer: ClassVar[str]
    worker: ClassVar[Path]

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
        if max_depth is not None:
            max_depth = whole("max_depth", max_depth, least=DIRECT_DEPTH)
        self._path = Path(path).absolute()
        self._parameters = self.checked({n: v for n, v in parameters.items() if v is not None})
        self._image: dict[str, Any] = {
            "size": size and [whole("size", n, least=1) for n in size],
            "crop": crop and [whole("crop", n, least=0) for n in crop],
            "max_depth": max_depth,
            "direct": direct,
            "by_light": [*by_light],
        }
        self._process: RendererProcess | None = None
        self._features: dict[str, Image] | None = None

    @staticmethod
    @abstractmethod
    def command() -> list[str]:
        """Return the command that runs a Python file where the renderer is; RenderError if none."""

    @staticmethod
    @abstractmethod
    def checked(parameters: dict[str, Any]) -> dict[str, Any]:
        """Return the parameters of a scene; InputError if there are no such."""

    @classmethod
    def works(cls) -> str:
        """Return whether the renderer works here, and which one, or why not; tried in a process."""
        try:
            command = cls.command()
            process = RendererProcess(command, cls.worker, renderer=cls.renderer)
        except RenderError as error:
            return f"does not work: {error}"
        found, _ = process.call("version")
        process.close()
        return f"works: {cls.renderer} {found['version']} ({command[0]})"

    @property
    def name(self) -> str:
        """Name of the scene."""
        return scene_name(self._path)

    @property
    def attrs(self) -> dict[str, Any]:
        """Provenance, ready for JSON."""
        self._started()
        return dict(self._attrs)

    def __call__(self, seed: int) -> DrawnPass:
        """Draw one sample of every pixel.

        Raises
        ------
        SceneError, RenderError
            If the scene cannot be read, or the renderer ends.
        """
        process = self._started()
        if self._features is None:  # whoever asks for attributes alone does not wait for them
            _, self._features = process.call("features")
        _, arrays = process.call("draw", seed=seed)
        image = arrays.pop("image")
        parts: dict[LightPart, Image] = {
            DIRECT_DEPTH if name == "direct" else name.removeprefix("light "): array
            for name, array in arrays.items()
        }
        return DrawnPass(image, self._features, parts)

    def close(self) -> None:
        """End the renderer; the next pass starts it again."""
        if self._process is not None:
            self._process.close()
        self._process = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the process behind: who is sent elsewhere starts another one."""
        return {n: v for n, v in self.__dict__.items() if n in ("_path", "_parameters", "_image")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._process = self._features = None

    def _started(self) -> RendererProcess:
        if self._process is not None and self._process.is_running:
            return self._process
        if not self._path.is_file():
            message = f"there is no file {self._path}"
            raise SceneError(message)
        process = RendererProcess(self.command(), self.worker, renderer=self.renderer)
        try:
            about, _ = process.call("load", path=str(self._path), **self._parameters)
            image, _ = process.call("frame", **self._image)
            self._check_crop(*image["size"])
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
        files: dict[str, str] = {}
        for path in (self._path, *sorted({*map(Path, about["files"])} - {self._path})):
            names = itertools.chain([path.name], (f"{path.name} ({i})" for i in itertools.count(2)))
            files[next(name for name in names if name not in files)] = digest_of(path)
        parameters = about.get("parameters", {})
        parts = json.dumps([files, parameters], sort_keys=True)
        return {
            "scene": self.name,
            "renderer": f"{self.renderer} {about['version']}",
            "scene_source": str(self._path),
            "scene_hash": hashlib.sha256(parts.encode()).hexdigest(),
            "scene_files": {name: digest[:16] for name, digest in sorted(files.items())},
            "size": image["size"],
            "crop": self._image["crop"],
            "integrator": {"type": self.renderer.lower(), **image["integrator"]},
            "filter": "box",
            "units": "linear radiance",
            "notes": about["notes"],
            "parameters": parameters,
        }
