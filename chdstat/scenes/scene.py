"""Scene: what is to be rendered, independent of any Mitsuba variant.

A scene is described without Mitsuba (a file and its parameters, or a dict of plain values), so it
can be hashed, pickled and sent to another process. `Scene.parse` turns the description into
Mitsuba's parser state, in which the capture code replaces film, sampler and integrator settings.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chdstat.errors import SceneError

__all__ = ["Scene"]


@dataclass(frozen=True)
class Scene:
    """A scene that Mitsuba can render.

    Parameters
    ----------
    name
        A short name: of a built-in scene, or the stem of the file.
    source
        A Mitsuba XML file, or a scene dict in Mitsuba's form. In a dict, values are plain:
        matrices are (4, 4) arrays, ``{"type": "mesh", "vertices", "faces", "uv", "bsdf"}`` is a
        triangle mesh, and ``{"type": "bitmap", "data": array}`` an image texture (see
        `chdstat.scenes.plain`).
    parameters
        Values for the ``$name`` parameters of an XML file.
    """

    name: str
    source: Path | Mapping[str, Any]
    parameters: Mapping[str, str] = field(default_factory=dict)

    @property
    def origin(self) -> str:
        """Where the scene comes from: its file, or 'chdstat' for one described in Python."""
        return str(self.source) if isinstance(self.source, Path) else "chdstat"

    @functools.cached_property
    def hash(self) -> str:
        """SHA-256 of everything the picture depends on: description, parameters, files."""
        digest = hashlib.sha256()
        if isinstance(self.source, Path):
            _hash_file_scene(digest, self.source)
        else:
            _hash_value(digest, self.source)
        _hash_value(digest, dict(sorted(self.parameters.items())))
        return digest.hexdigest()

    def parse(self, variant: str) -> Any:
        """Return Mitsuba's parser state of this scene for a variant that is set.

        Raises
        ------
        SceneError
            If Mitsuba cannot parse the description.
        """
        from chdstat.scenes import plain

        return plain.parse(self, variant)

    def build(self, state: Any) -> Any:
        """Return the Mitsuba scene of a parser state that `parse` gave.

        Raises
        ------
        SceneError
            If a plugin, a model or a texture is missing or broken.
        """
        from chdstat.scenes import plain

        return plain.instantiate(self, state)


def _hash_file_scene(digest: Any, path: Path) -> None:
    """Hash an XML file and, by content, the models and textures in the folders beside it.

    Only files that the XML mentions count, so that notes or renders beside a scene do not
    change its identity.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        message = f"cannot read scene file {path}: {error.strerror}"
        raise SceneError(message) from error
    digest.update(text)
    for candidate in sorted(path.parent.rglob("*")):
        if candidate == path or not candidate.is_file():
            continue
        relative = candidate.relative_to(path.parent).as_posix()
        if relative.encode() in text:
            digest.update(relative.encode())
            with candidate.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())


def _hash_value(digest: Any, value: Any) -> None:
    """Feed a plain value to the digest, unambiguously and independent of the platform."""
    if isinstance(value, Mapping):
        digest.update(f"dict{len(value)}".encode())
        for key, item in value.items():
            digest.update(f"key:{key};".encode())
            _hash_value(digest, item)
    elif isinstance(value, np.ndarray):
        digest.update(f"array{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, (list, tuple)):
        digest.update(f"list{len(value)}".encode())
        for item in value:
            _hash_value(digest, item)
    else:
        digest.update(f"{type(value).__name__}:{value!r};".encode())
