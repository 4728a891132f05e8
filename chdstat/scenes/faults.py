"""Faults of a scene: those that would end the process, and what Mitsuba says of all others.

Mitsuba trusts some of what it is given. It follows the numbers of vertices in PLY and serialized
files, and reads the first value of an image or a grid, wherever they may lie. So scenes with such
faults are refused before Mitsuba builds them.

`in_words` says what to do about Mitsuba's errors. Their texts name lines of its own source. What is
wrong, and where in the scene, is taken from them; a name that Mitsuba does not have is compared
with those that it has.
"""

from __future__ import annotations

import functools
import math
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image
from chdstat._core.files import is_file
from chdstat.errors import SceneError, brief, did_you_mean
from chdstat.scenes.plugins import known_names
from chdstat.scenes.scene import digest_of
from chdstat.scenes.settings import GUIDED

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


# --- errors of Mitsuba in words -------------------------------------------------------------------


_MARK = re.compile(r"(?<!\S)\[(?:\w+\.(?:cpp|h):\d+|[A-Z]\w*)\]\s*")
"""Where in Mitsuba's source an error was raised."""
_PLACE = re.compile(
    r"(?:While loading|Error while loading|At) "
    r"(?:dictionary node \"(?P<node>[^\"]*)\"|(?P<file>.+?) \(line (?P<line>\d+), col \d+\)): "
)
"""Where in the scene it is."""
_NO_FILE = re.compile(r"\bnot found\b|does not exist|No such file")
_SHOWN = 5
"""Names of missing files that are shown."""
_LONGEST = 200
"""Letters of a name that are shown."""


def in_words(error: BaseException, missing: Sequence[str] = ()) -> str:
    """Return what an error says: its place in the scene, what is wrong, and what to do.

    Parameters
    ----------
    error
        Mitsuba's error.
    missing
        Files that the scene names and that are not there.

    Examples
    --------
    >>> text = '[a.cpp:1] At s.xml (line 3, col 5): failed to instantiate bsdf plugin of type '
    >>> in_words(RuntimeError(text + '"difuse": [PluginManager] Plugin "difuse" not found!'))
    " (s.xml, line 3): Mitsuba has no bsdf 'difuse'; did you mean 'diffuse'?"
    """
    why, place = _MARK.sub("", " ".join(str(error).split())), ""
    for found in _PLACE.finditer(why):  # the last one is that of an included file
        place = f" ({Path(found['file']).name}, line {found['line']})" if found["file"] else ""
        place = place or ("" if found["node"] == "root" else f" (at {found['node']!r})")
    why = _PLACE.split(why)[-1]
    for pattern, words in _CAUSES:
        if match := pattern.search(why):
            return f"{place}: {words(match)}"
    if missing and _NO_FILE.search(why):
        return f"{place}: {_of_files(missing)}"
    why = brief(RuntimeError(why)) if why else brief(error)
    return f"{place}: {why.rstrip('.!')}; correct {'it there' if place else 'the scene'}"


def _of_plugin(match: re.Match[str]) -> str:
    kind, name = match["kind"], match["name"]
    kind = "plugin" if kind == "unknown" else kind
    advice = "; correct the name, or load the plugin that registers it"
    if kind == "integrator":
        advice = "; give another integrator, such as path, or load the plugin that registers it"
    near = did_you_mean(name, {*known_names(), *GUIDED})
    return f"Mitsuba has no {kind} {name!r}{near or advice}"


def _of_properties(match: re.Match[str]) -> str:
    names = ", ".join(re.findall(r"- \w+ \"([^\"]+)\"", match["list"]))
    return f"the {match['kind']} {match['name']!r} takes no {names}; correct the name or remove it"


def _of_parameter(match: re.Match[str]) -> str:
    name = match["name"]
    return (
        f"its parameter {name!r} has no value; give one: load_scene(file, {name}=...), or on the "
        f"command line -D {name}=VALUE"
    )


def _of_unused(match: re.Match[str]) -> str:
    names = ", ".join(re.findall(r"\$(\w+)", match["list"]))
    return f"the scene has no parameter {names}; leave it out, or correct the name"


def _of_metal(match: re.Match[str]) -> str:
    import mitsuba

    tables = Path(str(mitsuba.__file__)).parent.glob("data/ior/*.eta.spd")
    near = did_you_mean(match["name"], [table.name.split(".")[0] for table in tables])
    return f"Mitsuba has no material {match['name']!r}{near or '; give one of its metals'}"


def _of_files(missing: Sequence[str]) -> str:
    names = (n if len(n) <= _LONGEST else f"...{n[3 - _LONGEST :]}" for n in missing[:_SHOWN])
    shown = ", ".join(names)
    more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
    files = "a file" if len(missing) == 1 else f"{len(missing)} files"
    return (
        f"it names {files} that cannot be found: {shown}{more}; put them where the scene names "
        "them, or correct the names"
    )


_CAUSES: Sequence[tuple[re.Pattern[str], Callable[[re.Match[str]], str]]] = (
    (
        re.compile(
            r"failed to instantiate (?P<kind>\w+) plugin of type \"(?P<name>.*?)\": "
            r"Plugin \"(?P=name)\" not found"
        ),
        _of_plugin,
    ),
    (
        re.compile(
            r"unreferenced propert\w+ in (?P<kind>\w+) plugin of type \"(?P<name>.*?)\":"
            r"(?P<list>.*)"
        ),
        _of_properties,
    ),
    (re.compile(r"undefined parameter: \$(?P<name>\w+)"), _of_parameter),
    (re.compile(r"unused parameter\w*:?(?P<list>.*)"), _of_unused),
    (re.compile(r"\"data/ior/(?P<name>.+?)\.\w+\.spd\": file does not exist"), _of_metal),
)
