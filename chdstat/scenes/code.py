"""Code of a scene: what tells a plugin written in Python from its next version.

The samples depend on it as on the textures. Its digest covers the classes of the plugins that
Mitsuba made while it built the scene: their bytecode and that of the functions, classes and values
that they reach, the file of their module, and what their constructors set. It belongs to one
version of Python. What a plugin imports from installed packages counts by name only.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import sys
import sysconfig
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["code_of", "plugins_made"]

_INSTALLED = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
_PLAIN = (str, bytes, int, float, complex, np.generic, type(None), type(Ellipsis))
_OWN = ("__dict__", "__weakref__", "__doc__", "__firstlineno__", "__static_attributes__")


@contextlib.contextmanager
def plugins_made(mi: Any, names: set[str]) -> Iterator[list[Any]]:
    """Collect the objects of Python plugins that are made while the context lasts.

    Mitsuba does not say which class a name was registered for, and its own objects do not lead to
    all that they hold, so these are looked for among all objects of the process; not where every
    plugin is one of the compiled ones.
    """
    made: list[Any] = []
    compiled = {path.stem for path in (Path(mi.__file__).parent / "plugins").iterdir()}
    if names <= compiled:
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
        file = getattr(sys.modules.get(kind.__module__), "__file__", None)
        if file and kind.__module__ != "__main__":
            with contextlib.suppress(OSError):
                self._hash.update(Path(file).read_bytes())

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
