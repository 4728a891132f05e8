"""Mitsuba's parser state of scene descriptions, and the scenes built from it.

With `chdstat.rendering` the only part of the library that imports Mitsuba.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import mitsuba.parser
import numpy as np

from chdstat.errors import SceneError, brief
from chdstat.scenes.scene import LiveScene

if TYPE_CHECKING:
    from chdstat.scenes.scene import Scene

__all__ = ["instantiate", "parse"]


def parse(scene: Scene, variant: str) -> Any:
    """Return Mitsuba's parser state of a scene; the variant must be the one that is set."""
    config, folders = _config(variant), scene.described().folders
    with _naming(scene, "read"), _resolving(folders):
        source = scene.source
        if isinstance(source, LiveScene):
            source = source.description()
        if isinstance(source, Mapping):
            state = mi.parser.parse_dict(config, _to_mitsuba(source))
        else:
            state = mi.parser.parse_file(config, str(source), **dict(scene.parameters))
        mi.parser.transform_all(config, state)
    return state


def instantiate(scene: Scene, state: Any) -> Any:
    """Return the Mitsuba scene of a parser state, its models and textures read."""
    if isinstance(scene.source, LiveScene):
        return scene.source.value
    folders = scene.described().folders
    with _naming(scene, "build"), _resolving(folders):
        return mi.parser.instantiate(_config(str(mi.variant())), state)


def _config(variant: str) -> Any:
    """Return how strict to be: an unknown property is worth a warning, as in Mitsuba itself."""
    config = mi.parser.ParserConfig(variant)
    config.unused_properties = mi.LogLevel.Warn
    return config


@contextlib.contextmanager
def _naming(scene: Scene, doing: str) -> Iterator[None]:
    """Turn what Mitsuba says of a scene that it cannot use into an error that names the scene."""
    try:
        yield
    except (RuntimeError, ValueError, TypeError) as error:  # ValueError: text that is no UTF-8
        message = f"Mitsuba cannot {doing} the scene {scene.name!r}: {brief(error)}"
        raise SceneError(message) from error


@contextlib.contextmanager
def _resolving(folders: Sequence[Path]) -> Iterator[None]:
    """Let Mitsuba look for files in these folders first while the context lasts.

    A ``<path>`` of the scene is forgotten afterwards, too, which Mitsuba would keep for the next.
    """
    # Mitsuba's names belong to the variant that is set, so a type checker cannot know them.
    mitsuba_now: Any = mi
    previous = mitsuba_now.file_resolver()
    resolver = mitsuba_now.FileResolver(previous)
    for folder in reversed(folders):
        resolver.prepend(str(folder))
    mitsuba_now.set_file_resolver(resolver)
    try:
        yield
    finally:
        mitsuba_now.set_file_resolver(previous)


def _to_mitsuba(value: Any, *, key: str = "") -> Any:
    """Convert one plain value, and what is in it, to what Mitsuba's dict parser takes."""
    if isinstance(value, Mapping):
        if value.get("type") == "mesh":
            return _mesh(value, name=key)
        if value.get("type") == "bitmap" and isinstance(value.get("data"), np.ndarray):
            return _bitmap(value)
        return {name: _to_mitsuba(item, key=name) for name, item in value.items()}
    if isinstance(value, np.ndarray) and value.shape == (4, 4):
        return mi.ScalarTransform4f(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def _mesh(spec: Mapping[str, Any], *, name: str) -> Any:
    """Return a mesh object: Mitsuba's dict has no plugin that takes vertices from memory."""
    vertices = np.ascontiguousarray(spec["vertices"], dtype=np.float32)
    faces = np.ascontiguousarray(spec["faces"], dtype=np.uint32)
    properties = mi.Properties()
    for part in ("bsdf", "emitter"):
        if part in spec:
            properties[part] = mi.load_dict(_to_mitsuba(spec[part]))
    uv, normals = spec.get("uv"), spec.get("normals")
    mesh = mi.Mesh(
        name,
        len(vertices),
        len(faces),
        props=properties,
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=uv is not None,
    )
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = vertices.ravel()
    arrays["faces"] = faces.ravel()
    if normals is not None:
        arrays["vertex_normals"] = np.ascontiguousarray(normals, dtype=np.float32).ravel()
    if uv is not None:
        arrays["vertex_texcoords"] = np.ascontiguousarray(uv, dtype=np.float32).ravel()
    arrays.update()
    return mesh


def _bitmap(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a bitmap texture; `data` is linear, so it must not be taken for sRGB."""
    rest = {k: _to_mitsuba(v, key=k) for k, v in spec.items() if k != "data"}
    image = mi.Bitmap(np.ascontiguousarray(spec["data"], dtype=np.float32))
    return {**rest, "bitmap": image, "raw": bool(spec.get("raw", image.channel_count() == 1))}
