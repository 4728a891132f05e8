"""Faults of a scene that would end the process: they are refused before Mitsuba builds it.

Mitsuba trusts some of what it is given. It follows the numbers of vertices in PLY and serialized
files, and reads the first value of an image or a grid, wherever they may lie.
"""

from __future__ import annotations

import functools
import math
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image
from chdstat._core.files import is_file
from chdstat.errors import SceneError
from chdstat.scenes.scene_files import digest_of

if TYPE_CHECKING:
    from chdstat.scenes.parsing import ParsedScene

_DEEPEST = 1000
"""Most parts that may each hold the next one; Mitsuba's loader overflows the stack at 200,000."""
_MESHES = ("ply", "serialized")
"""Plugins whose files hold numbers of vertices that Mitsuba does not check."""
_HEAD = 4096
"""Bytes of a file in which its sizes stand."""
_IMAGE = re.compile(
    rb"P[Ff36]\s+(?:#.*\n)*(?P<width>-?\d+)\s+(?P<height>-?\d+)"
    rb"|#\?(?s:.*?)[-+][XY]\s+(?P<first>-?\d+)\s+[-+][XY]\s+(?P<second>-?\d+)"
)
"""Sizes in the headers of PFM, PPM and RGBE files."""
_FLOATS = 1
"""Kind of the values of a grid; Mitsuba refuses others."""
_GRID_HEADER = 48
"""Bytes before the values of a grid, with its bounding box."""


# --- what a scene dict holds --------------------------------------------------------------------


def filled(name: str, value: Any) -> None:
    """Refuse an array, a tensor, an image or a grid without values.

    Raises
    ------
    SceneError
        If it has none, or if a tensor has no dimension.
    """
    kind = type(value).__name__
    if isinstance(value, np.ndarray) or kind == "TensorXf":
        shape = tuple(map(int, value.shape))
    elif kind in ("Bitmap", "VolumeGrid"):
        shape = tuple(int(n) for n in np.ravel(np.array(value.size())))
    else:
        return
    if not math.prod(shape) or (kind == "TensorXf" and not shape):
        message = f"{name!r} of the scene dict must hold values, got a {kind} of shape {shape}"
        raise SceneError(message)


def checked_mesh(
    spec: Mapping[str, Any], name: str
) -> tuple[Image, npt.NDArray[np.uint32], Image | None, Image | None]:
    """Return vertices, faces, normals and texture coordinates of a mesh in a scene dict.

    They are copies: Dr.Jit would go on reading the arrays that were given.

    Raises
    ------
    SceneError
        If vertices or faces are missing, or an array has a wrong shape or numbers that are none of
        its vertices.
    """
    if missing := sorted({"vertices", "faces"} - spec.keys()):
        message = f"a mesh needs vertices and faces; {name!r} has no {' and no '.join(missing)}"
        raise SceneError(message)
    vertices = _rows(spec["vertices"], 3, f"vertices of the mesh {name!r}")
    count = len(vertices)
    faces = _rows(spec["faces"], 3, f"faces of the mesh {name!r}")
    if not ((faces >= 0) & (faces < count) & (faces % 1 == 0)).all():
        outside = faces[(faces < 0) | (faces >= count) | (faces % 1 != 0)][0]
        message = (
            f"faces of the mesh {name!r} must be numbers of its vertices, from 0 to {count - 1}, "
            f"got {outside:g}"
        )
        raise SceneError(message)
    found = []
    for part, columns in (("normals", 3), ("uv", 2)):
        rows = spec.get(part)
        if rows is not None:
            rows = _rows(rows, columns, f"{part} of the mesh {name!r}")
            if len(rows) != count:
                message = (
                    f"{part} of the mesh {name!r} must be one for each of its {count} vertices, "
                    f"got {len(rows)}"
                )
                raise SceneError(message)
            rows = rows.astype(np.float32)
        found.append(rows)
    return vertices.astype(np.float32), faces.astype(np.uint32), found[0], found[1]


def _rows(values: Any, columns: int, what: str) -> npt.NDArray[np.float64]:
    """Return numbers of shape (n, columns), at least one row."""
    try:
        rows = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        message = f"{what} must be numbers, shape (n, {columns}): {error}"
        raise SceneError(message) from error
    if rows.ndim != 2 or rows.shape[1] != columns or not len(rows):
        message = f"{what} must be numbers, shape (n, {columns}), got shape {rows.shape}"
        raise SceneError(message)
    return np.ascontiguousarray(rows)


# --- what a parsed scene holds ------------------------------------------------------------------


def refuse_faults(parsed: ParsedScene) -> None:
    """Refuse a scene whose files or nesting would end the process.

    Mitsuba's resolver must be that of the scene. A missing file is left to Mitsuba, which says so.

    Raises
    ------
    SceneError
        If a file holds numbers out of range, or the parts of the scene are nested too deep.
    """
    import mitsuba

    mi: Any = mitsuba
    for index in range(len(parsed.nodes)):
        plugin = parsed.plugin(index)
        if plugin == "blender":
            message = (
                f"scene {parsed.name!r} has a shape 'blender', which reads the memory of Blender; "
                "export the mesh to a file, and name it by a shape 'ply' or 'obj'"
            )
            raise SceneError(message)
        if "filename" not in parsed.node(index).props:
            continue
        properties = mi.Properties(parsed.node(index).props)  # a copy: Mitsuba records what is read
        name, shape = properties["filename"], properties.get("shape_index", 0)
        path = Path(str(mi.file_resolver().resolve(name))).absolute()
        if not is_file(path):
            continue
        kind = plugin if plugin in _MESHES else ""
        if fault := _fault_of(path, kind, shape, str(mi.variant()), digest_of(path)):
            message = f"scene {parsed.name!r} names {path}, {fault}; write or copy the file again"
            raise SceneError(message)
    if _is_deep(parsed):
        message = f"the parts of scene {parsed.name!r} are nested more than {_DEEPEST} deep"
        raise SceneError(message)


@functools.lru_cache(maxsize=4096)
def _fault_of(path: Path, plugin: str, shape: Any, _variant: str, _digest: str) -> str:
    """Return what is wrong with a file that a plugin reads; "" if nothing is, or Mitsuba says it.

    It is read again only if its digest has changed.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    if plugin:
        return _fault_of_mesh(path, plugin, shape)
    if head.startswith(b"VOL") and len(head) >= _GRID_HEADER:
        kind, *sizes = struct.unpack_from("<5i", head, 4)
        needed = _GRID_HEADER + 4 * math.prod(sizes)
        if kind == _FLOATS and (min(sizes) < 1 or path.stat().st_size < needed):
            x, y, z, channels = sizes
            return f"whose header tells of {x} x {y} x {z} values in {channels} channels"
    if found := _IMAGE.match(head):
        width, height = (int(n) for n in found.groups() if n is not None)
        if min(width, height) < 1:
            return f"an image of {width} x {height} pixels"
    return ""


def _fault_of_mesh(path: Path, plugin: str, shape: Any) -> str:
    import mitsuba as mi

    about = {"type": plugin, "filename": str(path), "face_normals": True}  # which follow no number
    if plugin == "serialized":
        about["shape_index"] = shape
    try:
        mesh = mi.load_dict(about)
    except (RuntimeError, TypeError, ValueError):
        return ""
    faces, count = np.array(mi.traverse(mesh)["faces"]), mesh.vertex_count()
    if not len(faces) or faces.max() < count:
        return ""
    return f"whose faces name the vertex {faces.max()}, of {count} from 0 on"


def _is_deep(parsed: ParsedScene) -> bool:
    """Return whether a part holds another one, which holds another one, and so on, too often.

    Mitsuba has refused circles.
    """
    below: dict[int, int] = {}
    waiting = [0]
    while waiting:
        held = parsed.held(waiting[-1])
        if unknown := [index for index in held if index not in below]:
            waiting += unknown
        else:
            below[waiting.pop()] = max((below[index] + 1 for index in held), default=0)
    return below[0] > _DEEPEST
