"""Files and plugin code of a scene: what its samples depend on beside the description.

An XML scene is read as Mitsuba reads it, parameters and includes in the same order, to learn which
files it names and in which folders they are looked for. A scene that would crash Mitsuba's own
parser, which knows no limit, is refused here.

The samples depend on the code of Python plugins as on the textures. Its digest covers the classes
of the plugins that Mitsuba made while it built the scene: their bytecode and that of the functions,
classes and values that they reach, the file of their module, and what their constructors set. It
belongs to one version of Python. What a plugin imports from installed packages counts by name only.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import itertools
import re
import sys
import sysconfig
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from chdstat.errors import SceneError
from chdstat.scenes.plugins import own_names

__all__ = ["code_of", "described", "digest_of", "is_file", "plugins_made"]

_DEEPEST = 100
"""Elements within each other; real scenes have ten, and Mitsuba's parser overflows its stack."""
_MOST_INCLUDES = 15
"""Includes within each other, as in Mitsuba."""


def described(
    scene: str, source: Path | Mapping[str, Any], parameters: Mapping[str, str]
) -> dict[str, Path]:
    """Return every file that a scene reads, by the name that it has for it.

    `scene` is what errors call it; another file of the same name is numbered.

    Raises
    ------
    SceneError
        If a file of the description cannot be read, is no XML, or is nested without end.
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
    # Only now are all folders known: Mitsuba opens most files after it has read the description.
    for name in filter(None, names):
        _note(files, name, _find(name, folders))
    return files


def _find(name: str, folders: list[Path]) -> Path | None:
    """Return the file that Mitsuba takes for a name: of these folders, or where it looks itself."""
    own = (folder / name for folder in folders)
    places = itertools.chain(own, map(_found_by_mitsuba, [name]))
    return next((place.resolve() for place in places if is_file(place)), None)


def _search(folders: list[Path], name: str, beside: Path) -> None:
    """Look for files in another folder first, which is in one of some places."""
    places = [place / name for place in (beside, *folders, Path())]
    folders.insert(0, next(filter(Path.is_dir, places), places[0]))


def _note(files: dict[str, Path], name: str, path: Path | None) -> None:
    """Note a file; another one of the same name is numbered."""
    if path is not None:
        names = itertools.chain([name], (f"{name} ({i})" for i in itertools.count(2)))
        next(n for n in names if files.setdefault(n, path) == path)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, read again only where the file has changed.

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
    """Return the names of the files that the text of a property may stand for."""
    tables = [f"data/ior/{text}.{part}.spd" for part in ("eta", "k")]  # of a metal
    return [text, *tables] if key == "material" else [text]


def is_file(path: Path) -> bool:
    """Return whether there is a file; text that cannot be a path is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long for a name, or with a zero byte
        return False


def _found_by_mitsuba(name: str) -> Path:
    """Return where the user's own search path has a name: the current folder, or in Mitsuba's."""
    import mitsuba

    mi: Any = mitsuba
    return Path(str(mi.file_resolver().resolve(name)))


class _Reader:
    """Reads one XML scene and its includes."""

    def __init__(self, scene: str, parameters: dict[str, str]) -> None:
        self._scene, self._parameters = scene, parameters
        self.files: dict[str, Path] = {}
        self.names: list[str] = []

    def read(self, path: Path, name: str, folders: list[Path], level: int) -> None:
        """Read one file, which the scene calls by a name, and add the folders that it names."""
        if level > _MOST_INCLUDES:
            raise self._unreadable(path, f"included more than {_MOST_INCLUDES} files deep")
        _note(self.files, name, path)
        depth = 0

        def start(tag: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            depth += 1
            if depth > _DEEPEST:
                line = parser.CurrentLineNumber
                raise self._unreadable(path, f"nested over {_DEEPEST} elements deep, line {line}")
            filled = {k: self._filled(v) for k, v in attributes.items()}
            if tag == "include":
                # From here on Mitsuba looks beside this file first, and then as before.
                within, included = [path.parent, *folders], filled.get("filename", "")
                if (found := _find(included, within)) is not None:
                    self.read(found, included, within, level + 1)
            else:
                self._element(tag, filled, path.parent, folders)

        def end(_: str) -> None:
            nonlocal depth
            depth -= 1

        parser = expat.ParserCreate()
        parser.StartElementHandler, parser.EndElementHandler = start, end
        try:
            with path.open("rb") as stream:
                parser.ParseFile(stream)
        except OSError as error:
            raise self._unreadable(path, error.strerror) from error
        except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two: its encoding
            raise self._unreadable(path, f"no well-formed XML in UTF-8, {error}") from error

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
        """Put the values of parameters in place, the longest name first, as Mitsuba does."""
        if "$" not in text:
            return text
        for name in sorted(filter(None, self._parameters), key=len, reverse=True):
            value = self._parameters[name]
            text = value.join(re.split(rf"(?<!\\)\${re.escape(name)}", text))
        return text.replace(r"\$", "$")


_INSTALLED = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
_PLAIN = (str, bytes, int, float, complex, np.generic, type(None), type(Ellipsis))
_OWN = ("__dict__", "__weakref__", "__doc__", "__firstlineno__", "__static_attributes__")


@contextlib.contextmanager
def plugins_made(mi: Any, names: set[str]) -> Iterator[list[Any]]:
    """Collect the objects of Python plugins that are made while the context lasts.

    Mitsuba does not say which class a name was registered for, and its own objects do not lead to
    all that they hold, so these are looked for among all objects of the process; not where every
    plugin is one of Mitsuba's own.
    """
    made: list[Any] = []
    if names <= own_names(mi):
        yield made
        return
    before = list(_plugins(mi))
    known = {id(plugin) for plugin in before}
    yield made
    made += [plugin for plugin in _plugins(mi) if id(plugin) not in known]


def _plugins(mi: Any) -> Iterator[Any]:
    for thing in gc.get_objects():
        kind = type(thing)
        if issubclass(kind, mi.Object) and _package(kind) != "mitsuba":
            yield thing


def code_of(plugins: list[Any]) -> dict[str, str]:
    """Return a digest of the code of each class of the plugins, by its name."""
    found: dict[str, list[str]] = {}
    for plugin in plugins:
        kind = type(plugin)
        content = _Content(_package(kind))
        content.add(kind)
        content.add_module(kind)
        content.add(vars(plugin) if hasattr(plugin, "__dict__") else {})
        found.setdefault(f"{kind.__module__}.{kind.__qualname__}", []).append(content.digest())
    # Objects of a class, such as two materials, are made in any order.
    return {
        name: hashlib.sha256("".join(sorted(set(digests))).encode()).hexdigest()
        for name, digests in sorted(found.items())
    }


class _Content:
    """A digest of Python values and the code that they reach; each is taken once."""

    def __init__(self, package: str) -> None:
        self._package, self._hash = package, hashlib.sha256()
        self._seen: dict[int, Any] = {}

    def digest(self) -> str:
        return self._hash.hexdigest()

    def add_module(self, kind: type) -> None:
        """Add the file of a class's module; that of a script changes with what it asks for."""
        module = sys.modules.get(kind.__module__)
        file = getattr(module, "__file__", None)
        if file and kind.__module__ != "__main__":
            loader: Any = getattr(module, "__loader__", None)
            with contextlib.suppress(OSError):
                known = hasattr(loader, "get_data")  # there, though its file may not be
                self._hash.update(loader.get_data(file) if known else Path(file).read_bytes())

    def add(self, value: Any) -> None:
        """Add a value, and what it leads to."""
        self._hash.update(f"{type(value).__name__};".encode())
        if isinstance(value, _PLAIN):
            self._hash.update(f"{value!r};".encode())
        elif isinstance(value, (tuple, types.CodeType)):  # may be shared or not, and hold no circle
            self._add_reached(value)
        elif id(value) not in self._seen:
            self._seen[id(value)] = value
            self._add_reached(value)

    def _add_reached(self, value: Any) -> None:
        if isinstance(value, np.ndarray):
            self._hash.update(f"{value.dtype.str}{value.shape}".encode() + value.tobytes())
        elif isinstance(value, Mapping):
            self._add_named({str(key): item for key, item in value.items()})
        elif isinstance(value, (tuple, list)):
            for item in value:
                self.add(item)
        elif isinstance(value, (set, frozenset)):
            self._hash.update(repr(sorted(map(repr, value))).encode())
        elif isinstance(value, types.CodeType):
            self.add((value.co_code, value.co_consts, value.co_names, value.co_varnames))
        elif isinstance(value, types.FunctionType):
            self._add_function(value)
        elif isinstance(value, (staticmethod, classmethod, types.MethodType)):
            self.add(value.__func__)
        elif isinstance(value, property):
            self.add((value.fget, value.fset))
        elif isinstance(value, type):
            self._add_class(value)
        elif isinstance(value, types.ModuleType):
            if self._follows(value.__name__):
                self._hash.update(Path(str(value.__file__)).read_bytes())
        elif self._follows(type(value).__module__) and hasattr(value, "__dict__"):
            self.add(type(value))
            self._add_named(vars(value))

    def _add_named(self, items: Mapping[str, Any]) -> None:
        for name, item in sorted(items.items()):
            self._hash.update(f"{name}=".encode())
            self.add(item)

    def _add_function(self, function: types.FunctionType) -> None:
        self._hash.update(function.__qualname__.encode())
        if not self._follows(function.__module__):
            return
        self.add(function.__code__)
        self.add((function.__defaults__, function.__kwdefaults__))
        for cell in function.__closure__ or ():
            with contextlib.suppress(ValueError):  # not set yet
                self.add(cell.cell_contents)
        names = set(_names(function.__code__)) & function.__globals__.keys()
        self._add_named({name: function.__globals__[name] for name in names})

    def _add_class(self, kind: type) -> None:
        self._hash.update(kind.__qualname__.encode())
        if self._follows(kind.__module__):
            for base in kind.__bases__:
                self.add(base)
            self._add_named({k: v for k, v in vars(kind).items() if k not in _OWN})

    def _follows(self, module: str | None) -> bool:
        """Return whether a module is the user's: of the plugin's package, or not installed."""
        package = (module or "").split(".")[0]
        if package == self._package:
            return True
        file = getattr(sys.modules.get(package), "__file__", None)
        return file is not None and not any(file.startswith(f"{at}/") for at in _INSTALLED)


def _names(code: types.CodeType) -> Iterator[str]:
    """Yield the names that a function, and those within it, look up."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)


def _package(kind: type) -> str:
    return str(kind.__module__).split(".")[0]
