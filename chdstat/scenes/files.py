"""Files of a scene: what Mitsuba reads besides the description, found without Mitsuba.

An XML scene is read as Mitsuba reads it, parameters and includes in the same order, to learn which
files it names and in which folders they are looked for. A scene that would crash Mitsuba's own
parser, which knows no limit, is refused here.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from chdstat.errors import SceneError

__all__ = ["Description", "described", "digest_of", "is_file"]

_DEEPEST = 100
"""Elements within each other; real scenes have ten, and Mitsuba's parser overflows its stack."""
_MOST_INCLUDES = 15
"""Includes within each other, as in Mitsuba."""


@dataclass
class Description:
    """What a scene names.

    Parameters
    ----------
    folders
        Where relative names are looked for, first match first.
    files
        Every file that is read, by the name that the scene has for it.
    """

    folders: list[Path] = field(default_factory=list)
    files: dict[str, Path] = field(default_factory=dict)

    def find(self, name: str) -> list[Path]:
        """Return the files of a name, in the folders of the scene or else where Mitsuba looks."""
        own = [folder / name for folder in self.folders if is_file(folder / name)]
        found = own or [path for path in (_found_by_mitsuba(name),) if is_file(path)]
        return [path.resolve() for path in found]

    def add(self, name: str) -> None:
        """Note the files that a name may stand for; other text stands for none."""
        for path in self.find(name):
            self.note(name, path)

    def note(self, name: str, path: Path) -> None:
        """Note a file; another one of the same name is numbered."""
        names = itertools.chain([name], (f"{name} ({i})" for i in itertools.count(2)))
        next(n for n in names if self.files.setdefault(n, path) == path)


def described(
    scene: str, source: Path | Mapping[str, Any], parameters: Mapping[str, str]
) -> Description:
    """Return what a scene names; `scene` is what errors call it.

    Raises
    ------
    SceneError
        If a file of the description cannot be read, is no XML, or is nested without end.
    """
    found = Description()
    if isinstance(source, Path):
        reader = _Reader(scene, found, dict(parameters))
        reader.read(source, source.name, 0)
        names: Iterator[str] = iter(reader.names)
    else:
        names = _texts(source)
    # Only now are all folders known: Mitsuba opens most files after it has read the description.
    for name in filter(None, names):
        found.add(name)
    return found


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


def _texts(value: Any) -> Iterator[str]:
    """Yield the texts of a scene dict that may name a file."""
    if isinstance(value, str | Path):
        yield str(value)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            if key not in ("type", "id"):
                yield from _texts(item)


def is_file(path: Path) -> bool:
    """Return whether there is a file; text that cannot be a path is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long for a name, or with a zero byte
        return False


def _found_by_mitsuba(name: str) -> Path:
    """Return where the user's own search path has a name: the current folder, or in Mitsuba's."""
    mi = sys.modules.get("mitsuba")
    known = mi is not None and mi.variant() is not None
    return Path(str(mi.file_resolver().resolve(name)) if known else name)  # type: ignore[union-attr]


class _Reader:
    """Reads one XML scene and its includes."""

    def __init__(self, scene: str, found: Description, parameters: dict[str, str]) -> None:
        self._scene, self._found, self._parameters = scene, found, parameters
        self.names: list[str] = []

    def read(self, path: Path, name: str, level: int) -> None:
        """Read one file; `name` is what the scene calls it."""
        if level > _MOST_INCLUDES:
            raise self._unreadable(path, f"included more than {_MOST_INCLUDES} files deep")
        self._found.note(name, path)
        self._found.folders.append(path.parent)
        depth = 0

        def start(tag: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            depth += 1
            if depth > _DEEPEST:
                line = parser.CurrentLineNumber
                raise self._unreadable(path, f"nested over {_DEEPEST} elements deep, line {line}")
            self._element(tag, {k: self._filled(v) for k, v in attributes.items()}, level)

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

    def _element(self, tag: str, attributes: Mapping[str, str], level: int) -> None:
        value = attributes.get("value", "")
        if tag == "default":
            self._parameters.setdefault(attributes.get("name", ""), value)
        elif tag == "path":
            folders = [folder / value for folder in (*self._found.folders, Path())]
            self._found.folders[:0] = [next(filter(Path.is_dir, folders), folders[0])]
        elif tag == "include":
            name = attributes.get("filename", "")
            for path in self._found.find(name):
                self.read(path, name, level + 1)
        else:
            self.names.append(attributes.get("filename", value if tag == "string" else ""))

    def _filled(self, text: str) -> str:
        """Put the values of parameters in place, the longest name first, as Mitsuba does."""
        if "$" not in text:
            return text
        for name in sorted(filter(None, self._parameters), key=len, reverse=True):
            value = self._parameters[name]
            text = value.join(re.split(rf"(?<!\\)\${re.escape(name)}", text))
        return text.replace(r"\$", "$")
