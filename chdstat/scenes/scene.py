"""Scene: what is to be rendered, independent of any Mitsuba variant.

A scene is described without Mitsuba (a file and its parameters, or a dict of plain values), so it
can be hashed, pickled and sent to another process. `Scene.parse` turns the description into
Mitsuba's parser state, in which the capture code replaces film, sampler and integrator settings.

Transforms for the built-in scenes: (4, 4) matrices that act on columns, in NumPy alone.

Chain them with ``@``: the rightmost acts first.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.display import Card, Shown
from chdstat.errors import InputError, SceneError
from chdstat.scenes.files import Description, described, digest_of
from chdstat.scenes.live import LiveScene

__all__ = ["Axis", "Scene", "Vector", "look_at", "rotate", "scale", "translate"]

_PLAIN = (str, bytes, int, float, complex, np.generic, Path, type(None))
"""Types of which two values are the same if they print the same."""


@dataclass(frozen=True, repr=False)
class Scene(Shown):
    """A scene that Mitsuba can render.

    Parameters
    ----------
    name
        A short name: of a built-in scene, or the stem of the file.
    source
        A Mitsuba XML file, or a scene dict in Mitsuba's form. In a dict, values are plain:
        matrices are (4, 4) arrays, ``{"type": "mesh", "vertices", "faces", "uv", "bsdf"}`` is a
        triangle mesh, and ``{"type": "bitmap", "data": array}`` an image texture (see
        `chdstat.scenes.loading`). Or a scene that Mitsuba has built.
    parameters
        Values for the ``$name`` parameters of an XML file.
    """

    name: str
    source: Path | Mapping[str, Any] | LiveScene
    parameters: Mapping[str, str] = field(default_factory=dict)

    def _card(self) -> Card:
        facts: dict[str, Any] = {"source": self.origin, "parameters": self.parameters}
        if isinstance(self.source, Mapping):
            parts = {name: part for name, part in self.source.items() if isinstance(part, Mapping)}
            facts["parts"] = f"{len(parts)}: {', '.join(parts)}"
        return Card(f"Scene {self.name}", facts)

    @property
    def origin(self) -> str:
        """Where the scene comes from: its file, or 'chdstat' for one described in Python."""
        if isinstance(self.source, LiveScene):
            return "mitsuba"
        return str(self.source) if isinstance(self.source, Path) else "chdstat"

    @property
    def hash(self) -> str:
        """SHA-256 of everything that the image depends on: description, parameters, files.

        It is that of now: it changes with the content of any file that the scene reads. The code
        of plugins written in Python is not in it; `Renderer.code` has that.
        """
        digest = hashlib.sha256()
        with _bounded(self.name):
            if isinstance(self.source, LiveScene):
                parts = sorted(map(_digest_of, self.source.parts()))
                _hash_value(digest, [*parts, self.source.code])
            elif not isinstance(self.source, Path):
                _hash_value(digest, self.source)
            _hash_value(digest, dict(sorted(self.parameters.items())))
        for name, content in sorted(self.files().items()):
            _hash_value(digest, (name, content))
        return digest.hexdigest()

    def files(self) -> dict[str, str]:
        """Return the SHA-256 of the content of each file that the scene reads, by its name there.

        Raises
        ------
        SceneError
            If a file cannot be read, or the description is no XML or nested too deep.
        """
        return {name: digest_of(path) for name, path in self.described().files.items()}

    def described(self) -> Description:
        """Return the files that the scene reads, and the folders where they are looked for."""
        if isinstance(self.source, LiveScene):
            return Description()
        with _bounded(self.name):
            return described(self.name, self.source, self.parameters)

    def parse(self, variant: str) -> Any:
        """Return Mitsuba's parser state of this scene for a variant that is set.

        Raises
        ------
        SceneError
            If Mitsuba cannot parse the description.
        """
        from chdstat.scenes import loading

        return loading.parse(self, variant)

    def build(self, state: Any) -> Any:
        """Return the Mitsuba scene of a parser state that `parse` gave.

        Raises
        ------
        SceneError
            If a plugin, a model or a texture is missing or broken.
        """
        from chdstat.scenes import loading

        return loading.instantiate(self, state)


@contextlib.contextmanager
def _bounded(name: str) -> Iterator[None]:
    """Refuse a scene dict that is nested so deep that walking through it overflows the stack."""
    try:
        yield
    except RecursionError as error:
        message = f"the description of scene {name!r} is nested too deep, or holds itself"
        raise SceneError(message) from error


def _digest_of(value: Any) -> str:
    digest = hashlib.sha256()
    _hash_value(digest, value)
    return digest.hexdigest()


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
    elif isinstance(value, _PLAIN):
        digest.update(f"{type(value).__name__}:{value!r};".encode())
    else:
        _hash_value(digest, _plain(value))


def _plain(value: Any) -> Any:
    """Return the content of a value of Mitsuba's that holds nothing but numbers."""
    kind = type(value)
    if kind.__module__.split(".")[0] in ("drjit", "mitsuba"):
        numbers = value.matrix if "Transform" in kind.__name__ else value
        with contextlib.suppress(TypeError, ValueError, RuntimeError):
            array = np.array(numbers)
            if array.dtype != object:
                return str(value), array
    message = (
        f"a scene dict holds a {kind.__module__}.{kind.__qualname__}, which cannot be told from "
        "another one; describe it by plain values (see chdstat.scenes.Scene)"
    )
    raise SceneError(message)


Array = npt.NDArray[np.float64]
Vector = Sequence[float] | Array
Axis = Literal["x", "y", "z"]

_AXES: dict[str, int] = {"x": 0, "y": 1, "z": 2}


def translate(x: float, y: float, z: float) -> Array:
    """Return the matrix that moves by (x, y, z)."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def scale(x: float, y: float, z: float) -> Array:
    """Return the matrix that stretches by (x, y, z)."""
    return np.diag([x, y, z, 1.0])


def rotate(axis: Axis, degrees: float) -> Array:
    """Return the matrix that turns counterclockwise about a coordinate axis.

    Examples
    --------
    >>> (rotate("z", 90.0) @ [1.0, 0.0, 0.0, 1.0]).round(6)
    array([0., 1., 0., 1.])
    """
    first, second = ((_AXES[axis] + k) % 3 for k in (1, 2))
    angle = np.deg2rad(degrees)
    matrix = np.eye(4)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[second, first] = np.sin(angle)
    matrix[first, second] = -matrix[second, first]
    return matrix


def look_at(origin: Vector, target: Vector, *, up: Vector = (0.0, 0.0, 1.0)) -> Array:
    """Return the matrix that places a camera or an emitter, whose own view is along +z.

    Raises
    ------
    InputError
        If the view is parallel to `up`.
    """
    forward = np.subtract(target, origin)
    left = np.cross(up, forward)
    if not left.any():
        message = f"up must not be parallel to the view {forward.tolist()}, got {up}"
        raise InputError(message)
    matrix = np.eye(4)
    matrix[:3, 0] = _unit(left)
    matrix[:3, 1] = _unit(np.cross(forward, left))
    matrix[:3, 2] = _unit(forward)
    matrix[:3, 3] = origin
    # Rounded like mesh vertices: it takes part in the scene's identity.
    return matrix.round(9)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))
