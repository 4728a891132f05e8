"""Scene: what is rendered, independent of any Mitsuba variant.

A scene is described without Mitsuba, by a file and its parameters or by a dict of plain values. It
can therefore be hashed, pickled and sent to another process; `chdstat.scenes.parsing` lets Mitsuba
read it. A scene that Mitsuba has already built is rendered as it is, in this process.

`load_scene` finds a scene by its name, file or description. `chdstat.scenes.builtin` has the names
of the built-in scenes.

Samples depend on the files of a scene, besides the description. An XML scene is read as Mitsuba
reads it, with parameters and includes in the same order. That shows which files it names, and in
which folders Mitsuba looks for them. A scene is refused if it is nested so deeply that Mitsuba's
own parser, which has no limit, would crash.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import html
import itertools
import re
import reprlib
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from chdstat._core.display import Card, Shown
from chdstat._core.files import is_file
from chdstat.errors import InputError, SceneError, did_you_mean
from chdstat.scenes.builtin import BUILTIN, built_in
from chdstat.scenes.plugins import code_of

SceneLike = str | Path | Mapping[str, Any] | Any
"""A built-in name, a scene file, a dict in Mitsuba's form, a `Scene`, or a ``mi.Scene``."""
MITSUBA = "Mitsuba"
RENDERERS = {".xml": MITSUBA, ".blend": "Cycles", ".cfg": "LuxCore", ".scn": "LuxCore"}
"""The renderer of a scene file, by its suffix."""
_NO_NAME = re.compile(r"scene([-_]?v?[0-9.]+)?")
"""Names of scene files that tell nothing: that of their folder does."""
_PLAIN = (str, bytes, int, float, complex, np.generic, Path, type(None))
"""Types whose values are equal if they print the same."""
_LISTED = 1000
"""Most files of a folder that a misspelt name is compared with."""


@dataclass(frozen=True, repr=False)
class Scene(Shown):
    """A scene that Mitsuba or another renderer can render.

    Parameters
    ----------
    name
        A short name: of a built-in scene, or what `scene_name` makes of a file's path.
    source
        A scene file of one of `RENDERERS`, a scene dict in Mitsuba's form, or a scene that Mitsuba
        has built. Values in a dict are plain: matrices are (4, 4) or (3, 3) arrays, ``{"type":
        "mesh", "vertices", "faces", "uv", "bsdf"}`` is a triangle mesh, and ``{"type": "bitmap",
        "data": array}`` is an image texture (see `chdstat.scenes.parsing`).
    parameters
        Values for the ``$name`` parameters of an XML file, or for those of a ``.blend`` file.
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
    def renderer(self) -> str:
        """Name of the renderer whose scene it is."""
        file = self.source if isinstance(self.source, Path) else Path("scene.xml")
        return RENDERERS[file.suffix.lower()]

    @property
    def origin(self) -> str:
        """Origin of the scene: its file, or 'chdstat' if it was described in Python."""
        if isinstance(self.source, LiveScene):
            return "mitsuba"
        return str(self.source) if isinstance(self.source, Path) else "chdstat"

    @property
    def hash(self) -> str:
        """SHA-256 of everything that the image depends on: description, parameters, files.

        It is computed now: it changes with the content of any file that the scene reads. It does
        not include the code of Python plugins, see `MitsubaRenderer.code`.
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
        """Return the SHA-256 of each file that the scene reads, by its name in the scene.

        Raises
        ------
        SceneError
            If a file cannot be read, or the description is nested too deep.
        """
        return {name: digest_of(path) for name, path in self.described().items()}

    def described(self) -> dict[str, Path]:
        """Return the files that the scene reads, by their names in the scene.

        Of another renderer than Mitsuba, it is the scene file alone.
        """
        if isinstance(self.source, LiveScene):
            return {}
        if self.renderer != MITSUBA:
            assert isinstance(self.source, Path), "others have files"
            return {self.source.name: self.source}
        with _bounded(self.name):
            return described(self.name, self.source, self.parameters)

    def load(self) -> Any:
        """Return the scene as Mitsuba's loader makes it in the current variant.

        Raises
        ------
        SceneError
            If Mitsuba cannot load it; its message is passed on.
        """
        from chdstat.scenes.parsing import parse

        return parse(self).make(parallel=True)

    def description(self) -> Path | Mapping[str, Any]:
        """Return the file, or a dict; for a scene that Mitsuba has built, its sensors only."""
        return self.source.sensors() if isinstance(self.source, LiveScene) else self.source


def load_scene(source: SceneLike, **parameters: object) -> Scene:
    """Return a scene by its name, file or description, or as Mitsuba has built it.

    Parameters
    ----------
    source
        A name in `BUILTIN`; the path of a scene file: Mitsuba's XML, ``.blend`` of Blender's
        Cycles, or ``.cfg`` or ``.scn`` of LuxCore, of which ``bathroom/scene.xml`` is named after
        its folder; a dict in Mitsuba's form; or a ``mi.Scene``,
        which is rendered as it is, in this process; so is a dict that holds Mitsuba objects, such
        as shapes or materials. A `Scene` is returned as it is.
    **parameters
        Values for the ``$name`` parameters of an XML file, like Mitsuba's option ``-D``; of a
        ``.blend`` file, ``frame``, ``camera``, ``view_layer`` and ``scene``.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If it is none of these.
    SceneError
        If the name is unknown (the message suggests the nearest one), the file is missing or of
        none of these kinds, or parameters are given to a scene without parameters.

    Examples
    --------
    >>> from chdstat import load_scene
    >>> load_scene("cornell-box").name
    'cornell-box'
    >>> load_scene("cornel-box")
    Traceback (most recent call last):
    chdstat.errors.SceneError: no built-in scene is called 'cornel-box'; did you mean 'cornell-box'?
    """
    if isinstance(source, Scene):
        scene = source
    elif LiveScene.fits(source):
        scene = Scene("scene", LiveScene(source))
    elif not isinstance(source, str | Path | Mapping):
        kind = f"{type(source).__module__}.{type(source).__qualname__}"
        message = (
            "scene must be a name, the path of a scene file, a dict, a chdstat Scene or a "
            f"mi.Scene, got a {kind}"
        )
        raise InputError(message)
    elif isinstance(source, Mapping):
        if source.get("type") != "scene":
            message = f"a scene dict needs 'type': 'scene', got 'type': {source.get('type')!r}"
            raise SceneError(message)
        scene = Scene("scene", source)
        with _bounded("scene"):
            if _holds_objects(source):  # which belong to this process and variant
                scene = Scene("scene", LiveScene(scene.load()))
    elif str(source) in BUILTIN:
        scene = Scene(str(source), built_in(str(source)))
    else:
        return Scene(*_checked_file(Path(source)), {k: str(v) for k, v in parameters.items()})
    if parameters:
        message = (
            f"scene {scene.name!r} takes no parameters (only files do), "
            f"got {', '.join(sorted(parameters))}"
        )
        raise SceneError(message)
    return scene


def _checked_file(path: Path) -> tuple[str, Path]:
    """Return the name and the absolute path of a scene file that exists."""
    if is_file(path / "scene.xml"):
        path = path / "scene.xml"
    if not is_file(path):
        raise SceneError(_nothing_at(path))
    if path.suffix.lower() not in RENDERERS:
        message = (
            "a scene file must be Mitsuba's (*.xml), Blender's (*.blend) or LuxCore's (*.cfg, "
            f"*.scn), got {str(path)!r}; 'chdstat import' makes a store of the samples of another "
            "renderer"
        )
        raise SceneError(message)
    path = path.absolute()  # of a link as of a file: Mitsuba looks for others beside the link
    return scene_name(path), path


def scene_name(path: Path) -> str:
    """Return a short name for a scene file: its own without ending, or that of its folder.

    Scenes are shared as folders whose file is called ``scene.xml`` or, by version of the renderer,
    ``scene_v3.xml``: the folder then names the scene.

    Examples
    --------
    >>> [scene_name(Path(file)) for file in ("w/kitchen.xml", "bathroom/scene_v3.xml")]
    ['kitchen', 'bathroom']
    """
    return (_NO_NAME.fullmatch(path.stem) and path.absolute().parent.name) or path.stem


def _nothing_at(path: Path) -> str:
    """Return the message about a scene or store that does not exist, by what it seems to be."""
    name = reprlib.repr(str(path))
    if is_file(path / "zarr.json"):
        return f"{name} is a store, of samples that are rendered already; give the scene"
    if path.suffix == ".zarr":
        return f"no store at {name}; render one with: chdstat render SCENE -o {path}"
    if path.suffix or len(path.parts) > 1:
        return f"no scene file at {name}{_beside(path)}"
    near = did_you_mean(path, BUILTIN) or f"; there are {', '.join(sorted(BUILTIN))}"
    return f"no built-in scene is called {name}{near}"


def _beside(path: Path) -> str:
    """Return the end of a message about a missing file: the nearest names in its folder."""
    try:
        held = [other.name for other in itertools.islice(path.parent.iterdir(), _LISTED)]
    except (OSError, ValueError):  # no such folder, or text that is no path
        return f"; there is no folder {reprlib.repr(str(path.parent))}"
    return did_you_mean(path.name, held) or "; give a scene file, such as *.xml of Mitsuba"


@contextlib.contextmanager
def _bounded(name: str) -> Iterator[None]:
    """Refuse a scene dict so deeply nested that walking through it overflows the stack."""
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
            digest.update(f"key:{key};".encode(errors="surrogatepass"))
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
    """Return the content of a Mitsuba value that holds only numbers."""
    kind = type(value)
    if kind.__module__.split(".")[0] in ("drjit", "mitsuba"):
        numbers = value.matrix if "Transform" in kind.__name__ else value
        with contextlib.suppress(TypeError, ValueError, RuntimeError):
            array = np.array(numbers)
            if array.dtype != object:
                return str(value), array
    message = (
        f"a scene dict holds a {kind.__module__}.{kind.__qualname__}, which cannot be told from "
        "another one; describe it by plain values or arrays of NumPy (mitsuba.load_dict "
        "empties tensors)"
    )
    raise SceneError(message)


# --- scenes that Mitsuba has built --------------------------------------------------------------

_SENSORS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic",
}
"""Plugins by the names of their classes."""
_SETTINGS = (
    "near_clip",
    "far_clip",
    "shutter_open",
    "aperture_radius",
    "focus_distance",
    "principal_point_offset_x",
    "principal_point_offset_y",
)
_ADDRESS = re.compile(r"\b(?:object_|0x)[0-9a-f]+\b")
"""Mitsuba's names for objects without a name: their place in memory."""
_ELSEWHERE = (
    "a scene that Mitsuba has built can only be rendered in this process; for other ones, give the "
    "file or dict that it was made of"
)


def _is_built(value: object) -> bool:
    """Return whether a value is a Mitsuba object."""
    mi: Any = sys.modules.get("mitsuba")
    return mi is not None and mi.variant() is not None and isinstance(value, mi.Object)


def _holds_objects(value: object) -> bool:
    """Return whether a scene dict holds Mitsuba objects, apart from data."""
    if isinstance(value, Mapping):
        return any(map(_holds_objects, value.values()))
    return _is_built(value) and type(value).__name__ not in ("Bitmap", "VolumeGrid")


@dataclass(frozen=True, eq=False)
class LiveScene:
    """A scene that Mitsuba has built, in its current state; it cannot be pickled.

    Attributes
    ----------
    value
        The object.
    """

    value: Any

    @staticmethod
    def fits(value: object) -> bool:
        """Return whether a value is a Mitsuba scene, of any variant."""
        scene: Any = value
        return _is_built(value) and bool(scene.class_name() == "Scene")

    def parts(self) -> list[Any]:
        """Return each object's text and parameters, which tell one scene from another.

        Mitsuba builds objects in parallel, so that their order changes.
        """
        import mitsuba as mi

        found = []
        for part in self._objects():
            held = [(_ADDRESS.sub("object", name), value) for name, value in mi.traverse(part)]
            found.append([_ADDRESS.sub("object", str(part)), sorted(held, key=itemgetter(0))])
        return [*found, *map(_wavelengths, self.value.sensors())]

    @property
    def code(self) -> dict[str, str]:
        """Digests of the classes of its objects that are written in Python, by name."""
        return code_of([p for p in self._objects() if not type(p).__module__.startswith("mitsuba")])

    def _objects(self) -> list[Any]:
        """Return all objects of the scene that Mitsuba leads to, each once."""
        import mitsuba as mi

        return [part for part in mi.traverse(self.value).hierarchy if part is not self.value]

    def sensors(self) -> dict[str, Any]:
        """Return a scene dict of its sensors and films, which are made anew for each tile.

        For a sensor that cannot be described (see `is_described`), only the film is right.
        """
        sensors = {f"sensor_{i}": _sensor(s) for i, s in enumerate(self.value.sensors())}
        return {"type": "scene", **sensors}

    def is_described(self, sensor: int) -> bool:
        """Return whether a copy of the sensor with this number can be made.

        The bands of a film are left out, but the sensor's own response function cannot be.
        """
        import mitsuba as mi

        built = self.value.sensors()[sensor]
        plain = mi.load_dict({"type": "perspective"})
        has_bands = built.film().class_name() == "SpecFilm"
        responds = not has_bands and _wavelengths(built) != _wavelengths(plain)
        return built.class_name() in _SENSORS and not responds

    def __reduce__(self) -> NoReturn:
        raise InputError(_ELSEWHERE)


def _wavelengths(sensor: Any) -> list[list[float]]:
    """Return some wavelengths that a sensor draws, and their weights.

    They reveal its response function, which Mitsuba does not tell.
    """
    import mitsuba as mi

    if not mi.is_spectral:
        return []
    nowhere = mi.SurfaceInteraction3f()
    drawn = [sensor.sample_wavelengths(nowhere, u) for u in np.linspace(0.05, 0.95, 10).tolist()]
    return [np.ravel(np.array(values)).tolist() for pair in drawn for values in pair]


def _sensor(sensor: Any) -> dict[str, Any]:
    import mitsuba as mi

    held, film = mi.traverse(sensor), sensor.film()

    def number(key: str) -> float:
        return float(np.ravel(np.array(held[key]))[0])

    size, crop, corner = film.size(), film.crop_size(), film.crop_offset()
    found: dict[str, Any] = {"type": _SENSORS.get(sensor.class_name(), "radiancemeter")}
    if found["type"] != "radiancemeter":
        found |= {key: number(key) for key in _SETTINGS if key in held}
        found["shutter_close"] = number("shutter_open") + number("shutter_open_time")
        found["to_world"] = np.array(held["to_world"].matrix, np.float64).reshape(4, 4)
    if "x_fov" in held:
        found |= {"fov": number("x_fov"), "fov_axis": "x"}
    found["film"] = {
        "type": "hdrfilm",
        "width": int(size[0]),
        "height": int(size[1]),
        "crop_width": int(crop[0]),
        "crop_height": int(crop[1]),
        "crop_offset_x": int(corner[0]),
        "crop_offset_y": int(corner[1]),
        "filter": {"type": film.rfilter().class_name().removesuffix("Filter").lower()},
    }
    return found


# --- files of a scene -----------------------------------------------------------------------------


_DEEPEST = 100
"""Deepest nesting of elements; real scenes have ten levels, and Mitsuba's parser overflows."""
_MOST_INCLUDES = 15
"""Deepest nesting of includes, as in Mitsuba."""


def described(
    scene: str, source: Path | Mapping[str, Any], parameters: Mapping[str, str]
) -> dict[str, Path]:
    """Return every file that a scene reads, by its name in the scene.

    `scene` is the name in errors. Another file with the same name is numbered.

    Raises
    ------
    SceneError
        If a file of the description cannot be read, is nested without end, or has attributes that
        are not UTF-8.
    """
    if isinstance(source, Path):
        reader = _Reader(scene, dict(parameters))
        folders = [source.parent]
        reader.read(source, source.name, folders, 0)
        files, names = reader.files, iter(reader.names)
    else:
        files, folders, names = {}, [], _texts(source)
        for part in source.values():
            if isinstance(part, Mapping) and part.get("type") == "resources":
                _search(folders, str(part.get("path", "")), Path())
    # Only now are all folders known: Mitsuba opens most files after reading the description.
    for name in filter(None, names):
        _note(files, name, _find(name, folders))
    return files


def _find(name: str, folders: list[Path]) -> Path | None:
    """Return the file that Mitsuba takes for a name: in these folders, or in its own places."""
    own = (folder / name for folder in folders)
    places = itertools.chain(own, map(_found_by_mitsuba, [name]))
    return next(filter(is_file, places), None)


def _search(folders: list[Path], name: str, beside: Path) -> None:
    """Search another folder first, which lies in one of some places."""
    places = [place / name for place in (beside, *folders, Path())]
    folders.insert(0, next(filter(Path.is_dir, places), places[0]))


def _note(files: dict[str, Path], name: str, path: Path | None) -> None:
    """Record a file, the one behind a link; another file with the same name is numbered."""
    if path is not None:
        file = path.resolve()
        names = itertools.chain([name], (f"{name} ({i})" for i in itertools.count(2)))
        next(n for n in names if files.setdefault(n, file) == file)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file, which is read again only if it has changed.

    Raises
    ------
    SceneError
        If it cannot be read.
    """
    try:
        now = path.stat()
        return _digest(path, now.st_ino, now.st_size, now.st_mtime_ns, now.st_ctime_ns)
    except OSError as error:
        message = f"cannot read {path}, which the scene names: {error.strerror}"
        raise SceneError(message) from error


@functools.lru_cache(maxsize=4096)
def _digest(path: Path, *_state: int) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _texts(value: Any, key: str = "") -> Iterator[str]:
    """Yield the texts of a scene dict that may name a file."""
    if isinstance(value, str | Path):
        yield from _named(key, str(value))
    elif isinstance(value, Mapping):
        for name, item in value.items():
            if name not in ("type", "id"):
                yield from _texts(item, name)


def _named(key: str, text: str) -> list[str]:
    """Return the names of the files that a property's text may stand for."""
    tables = [f"data/ior/{text}.{part}.spd" for part in ("eta", "k")]  # of a metal
    return [text, *tables] if key == "material" else [text]


def _found_by_mitsuba(name: str) -> Path:
    """Return the place of a name on the search path: the current folder, or Mitsuba's."""
    import mitsuba

    mi: Any = mitsuba
    return Path(str(mi.file_resolver().resolve(name)))


_MARKUP = re.compile(
    r"<!--.*?(?:-->|\Z)|<!\[CDATA\[.*?(?:\]\]>|\Z)|<\?.*?(?:\?>|\Z)"
    r"|<(/?)([^\s<>/!?]+)((?:[^>\"']+|\"[^\"]*(?:\"|\Z)|'[^']*(?:'|\Z))*+)(?:>|\Z)",
    re.DOTALL,
)
"""The text between < and >; for a tag: a slash if it closes an element, its name, and the rest.

Mitsuba also accepts XML that is not well-formed, such as ``--`` in comments and bare ``&``."""
_ATTRIBUTE = re.compile(r"(?<![^\s\"'])([^\s=\"'/]++)\s*+=\s*(?:\"([^\"]*)\"|'([^']*)')")
_ENTITY = re.compile(r"&(?:#x?[0-9a-fA-F]+|lt|gt|amp|quot|apos);")
_LATIN = re.compile(rb"<\?xml[^>]*encoding\s*=\s*[\"'](?:iso-8859-1|latin1)[\"']", re.IGNORECASE)
_UTF16 = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"<\0": "utf-16-le", b"\0<": "utf-16-be"}


def _decoded(data: bytes) -> str:
    """Return the text of a file in the encoding that Mitsuba's parser uses."""
    if name := _UTF16.get(data[:2]):
        return data.decode(name, "replace")
    return data.decode("latin-1" if _LATIN.match(data) else "utf-8", "replace")


def _attributes(inside: str) -> Iterator[tuple[str, str]]:
    """Yield the names and values of a tag's attributes."""
    for name, double, single in _ATTRIBUTE.findall(inside):
        yield name, _ENTITY.sub(lambda found: html.unescape(found[0]), double or single)


class _Reader:
    """Reads one XML scene and its includes."""

    def __init__(self, scene: str, parameters: dict[str, str]) -> None:
        self._scene, self._parameters = scene, parameters
        self.files: dict[str, Path] = {}
        self.names: list[str] = []

    def read(self, path: Path, name: str, folders: list[Path], level: int) -> None:
        """Read one file by its name in the scene, and add the folders that it names."""
        if level > _MOST_INCLUDES:
            raise self._unreadable(path, f"included more than {_MOST_INCLUDES} files deep")
        _note(self.files, name, path)
        try:
            text = _decoded(path.read_bytes())
        except OSError as error:
            raise self._unreadable(path, error.strerror) from error
        depth = 0
        for found in _MARKUP.finditer(text):
            closes, tag, inside = found.groups()
            depth -= bool(closes)
            if closes or tag is None:
                continue
            depth += not inside.endswith("/")
            if depth > _DEEPEST or "\ufffd" in inside:
                why = "no text in UTF-8" if depth <= _DEEPEST else f"nested over {_DEEPEST} deep"
                line = text.count("\n", 0, found.start()) + 1
                raise self._unreadable(path, f"{why}, line {line}")
            filled = {k: self._filled(v) for k, v in _attributes(inside)}
            if tag == "include":
                # From here on, Mitsuba looks beside this file first, and then as before.
                within, included = [path.parent, *folders], filled.get("filename", "")
                if (target := _find(included, within)) is not None:
                    self.read(target, included, within, level + 1)
            else:
                self._element(tag, filled, path.parent, folders)

    def _unreadable(self, path: Path, why: str | None) -> SceneError:
        return SceneError(f"cannot read the scene {self._scene!r}: {path} ({why})")

    def _element(
        self, tag: str, attributes: Mapping[str, str], beside: Path, folders: list[Path]
    ) -> None:
        value, filename = attributes.get("value", ""), attributes.get("filename", "")
        if tag == "default":
            self._parameters.setdefault(attributes.get("name", ""), value)
        elif tag == "path":
            _search(folders, value, beside)
        elif tag == "spectrum" and filename:  # read at once
            _note(self.files, filename, _find(filename, folders))
        else:
            text = filename or (value if tag == "string" else "")
            self.names += _named(attributes.get("name", ""), text)

    def _filled(self, text: str) -> str:
        """Insert the values of parameters, the longest name first, as Mitsuba does."""
        if "$" not in text:
            return text
        for name in sorted(filter(None, self._parameters), key=len, reverse=True):
            value = self._parameters[name]
            text = value.join(re.split(rf"(?<!\\)\${re.escape(name)}", text))
        return text.replace(r"\$", "$")
