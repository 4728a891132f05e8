"""Files of a scene: what its samples depend on besides the description.

An XML scene is read as Mitsuba reads it, with parameters and includes in the same order. That shows
which files it names, and in which folders Mitsuba looks for them. A scene is refused if it is
nested so deeply that Mitsuba's own parser, which has no limit, would crash.
"""

from __future__ import annotations

import functools
import hashlib
import html
import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from chdstat._core.files import is_file
from chdstat.errors import SceneError

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
