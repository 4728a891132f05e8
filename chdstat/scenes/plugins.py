"""Plugins: Python files that register parts of scenes with Mitsuba, or estimators with chdstat.

Mitsuba registers a plugin for one variant, and Python classes derive from those of the current
variant. So the file of a plugin is run once for each variant that a scene is rendered in, in each
process that renders. The file is sent there as text: workers need no copy of it.

Samples depend on the code of Python plugins, as they do on textures. `code_of` digests the classes
of the plugins that Mitsuba made while it built a scene: their bytecode; that of the functions,
classes and values that they reach; the file of their module; and what their constructors set. The
digest belongs to one version of Python. Imports from installed packages count by name only.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import re
import sys
import sysconfig
import traceback
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chdstat.errors import ChdstatError, InputError

_PREFIX = "chdstat_plugin_"
"""Prefix of the names of their modules, so that no other module is hidden."""
_CODE = "__chdstat_code__"
"""Name under which their modules hold their code."""


@dataclass(frozen=True)
class Plugin:
    """A Python file that registers parts of scenes with Mitsuba, or estimators with chdstat.

    Attributes
    ----------
    path
        The file.
    code
        Its content.
    """

    path: Path
    code: bytes = field(repr=False)

    @property
    def name(self) -> str:
        """Name of the file, without its folders."""
        return self.path.name

    @property
    def digest(self) -> str:
        """SHA-256 of the code, the first 16 digits."""
        return hashlib.sha256(self.code).hexdigest()[:16]

    @property
    def module(self) -> str:
        """Name of the module that the file is run as."""
        return _PREFIX + self.path.stem


@dataclass
class _Registration:
    """What a plugin has registered in one variant."""

    plugin: Plugin
    parts: set[str] = field(default_factory=set)
    estimators: set[str] = field(default_factory=set)


_LOADED: dict[str, Plugin] = {}
"""Plugins of this process, by the name of their file."""
_REGISTERED: dict[tuple[str, str], _Registration] = {}
"""Registrations by Mitsuba's variant and the name of the file."""


def load_plugin(path: str | Path) -> Plugin:
    """Run a Python file that registers parts of scenes with Mitsuba, or estimators with chdstat.

    Later renders know what it registers, in any variant, and also in the processes of the explorer
    and of a Dask cluster. A store records the plugins that its scene or integrator names, and
    continues with the same code only. Loading a file again takes its changes.

    The file may import modules that lie beside it. Mitsuba classes must be in the file itself,
    since it is run again in other variants. `mitsuba.set_variant` does nothing in it: the variant
    is that of the render.

    Parameters
    ----------
    path
        The file, such as ``my_integrator.py``. Two files must not have the same name.

    Returns
    -------
    Plugin

    Raises
    ------
    InputError
        If there is no such file, it raises an error, registers nothing, or takes a name of
        Mitsuba's or of another plugin.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> import chdstat as chd
    >>> code = '''
    ... import mitsuba as mi
    ...
    ... class White(mi.BSDF):
    ...     pass
    ...
    ... mi.register_bsdf("white", White)
    ... '''
    >>> path = pathlib.Path(tempfile.mkdtemp(), "white.py")
    >>> _ = path.write_text(code)
    >>> chd.scenes.load_plugin(path).name
    'white.py'
    """
    import mitsuba as mi

    path = Path(path)
    try:
        plugin = Plugin(path.resolve(), path.read_bytes())
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        message = f"cannot read the plugin {str(path)!r}: {reason}; give a Python file"
        raise InputError(message) from error
    other = _LOADED.get(plugin.name)
    if other is not None and other.path != plugin.path:
        message = (
            f"plugin {path} has the name of {other.path}, which is loaded already; rename one of "
            "them, as stores know plugins by their names"
        )
        raise InputError(message)
    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    register([plugin], str(mi.variant()))
    _LOADED[plugin.name] = plugin
    return plugin


def loaded() -> tuple[Plugin, ...]:
    """Return the plugins of this process, in the order in which they were loaded."""
    return tuple(_LOADED.values())


def register(plugins: Iterable[Plugin], variant: str) -> None:
    """Run plugins in the current variant, unless they were run in it before.

    Raises
    ------
    InputError
        As for `load_plugin`.
    """
    for plugin in plugins:
        there = _REGISTERED.get((variant, plugin.name))
        if there is None or there.plugin != plugin:
            _REGISTERED[variant, plugin.name] = _run(plugin, variant)


def used(
    plugins: Sequence[Plugin], variant: str, names: set[str], made: Iterable[Any]
) -> dict[str, str]:
    """Return the digests of the plugins that a scene uses, by the names of their files.

    A scene uses a plugin that has registered one of the scene's `names` of Mitsuba plugins, or the
    class of an object that was made.
    """
    modules = {type(thing).__module__ for thing in made}
    return {
        plugin.name: plugin.digest
        for plugin in plugins
        if plugin.module in modules or _REGISTERED[variant, plugin.name].parts & names
    }


def _own_names(mi: Any) -> set[str]:
    """Return the names of Mitsuba's own plugins."""
    folder = Path(mi.__file__).parent
    files = (*(folder / "plugins").iterdir(), *(folder / "python/ad/integrators").glob("*.py"))
    return {file.stem for file in files}


def known_names() -> set[str]:
    """Return the names of all plugins of the current variant: Mitsuba's, and registered ones."""
    import mitsuba as mi

    here = (r for (variant, _), r in _REGISTERED.items() if variant == mi.variant())
    return _own_names(mi).union(*(r.parts for r in here))


def failure(plugins: Iterable[Plugin], error: BaseException) -> BaseException:
    """Return an error that names the line of a plugin where another was raised, else that one.

    Where the plugin was called by Mitsuba's loader, the traceback is text in Mitsuba's message.
    """
    cause = error.__cause__ or error
    frames = [(f.filename, f.lineno) for f in traceback.extract_tb(cause.__traceback__)]
    told = f"{type(cause).__name__}: {cause}"
    if isinstance(cause, SyntaxError):
        frames.append((str(cause.filename), cause.lineno))
        told = f"SyntaxError: {cause.msg}"
    if quoted := re.findall(r'File "([^"]+)", line (\d+)', str(cause)):
        frames += quoted
        told = str(cause).strip().splitlines()[-1]
    names = {str(plugin.path) for plugin in plugins}
    where = [f"{name}, line {line}" for name, line in frames if name in names]
    if isinstance(cause, ChdstatError) or not where:
        return error
    return InputError(f"plugin {where[-1]}: {told}; correct it there")


def _run(plugin: Plugin, variant: str) -> _Registration:
    """Run the code that a plugin travels with, and return what it has registered."""
    from chdstat.estimators.registry import registered_by

    registration, module = _Registration(plugin), types.ModuleType(plugin.module)
    module.__file__, vars(module)[_CODE] = str(plugin.path), plugin.code
    previous = sys.modules.get(plugin.module)
    sys.modules[plugin.module] = module
    try:
        with (
            _recorded(registration, variant),
            registered_by(plugin.name) as registration.estimators,
            _beside(plugin),
        ):
            exec(compile(plugin.code, plugin.path, "exec"), vars(module))  # noqa: S102
    except (Exception, SystemExit) as error:
        sys.modules.pop(plugin.module)
        if previous is not None:
            sys.modules[plugin.module] = previous
        raise failure([plugin], error) from error
    if not registration.parts | registration.estimators:
        message = (
            f"plugin {plugin.path} registers nothing; end it with a line such as "
            "mitsuba.register_integrator('my_integrator', MyIntegrator)"
        )
        raise InputError(message)
    return registration


@contextlib.contextmanager
def _recorded(registration: _Registration, variant: str) -> Iterator[None]:
    """Note what is registered with Mitsuba while the context lasts, and keep its variant."""
    import mitsuba

    mi: Any = mitsuba
    functions = {name: getattr(mi, name) for name in dir(mi) if name.startswith("register_")}
    set_variant, own = mi.set_variant, _own_names(mi)

    def recording(function: Callable[..., Any]) -> Callable[..., Any]:
        def recorded(name: str, constructor: Callable[..., Any]) -> Any:
            _check_name(name, registration.plugin, variant, own)
            registration.parts.add(name)
            return function(name, constructor)

        return recorded

    for name, function in functions.items():
        setattr(mi, name, recording(function))
    mi.set_variant = lambda *_: None
    try:
        yield
    finally:
        mi.set_variant = set_variant
        for name, function in functions.items():
            setattr(mi, name, function)


def _check_name(name: str, plugin: Plugin, variant: str, own: set[str]) -> None:
    """Refuse a name that would take the place of another part."""
    others = (r for (v, _), r in _REGISTERED.items() if v == variant)
    owners = [r.plugin.name for r in others if name in r.parts and r.plugin.name != plugin.name]
    if name in own or owners:
        message = (
            f"plugin {plugin.path} registers {name!r}, which is {[*owners, 'Mitsuba'][0]}'s own; "
            "choose another name"
        )
        raise InputError(message)


@contextlib.contextmanager
def _beside(plugin: Plugin) -> Iterator[None]:
    """Let modules be imported that lie beside a plugin."""
    folder = str(plugin.path.parent)
    sys.path.append(folder)
    try:
        yield
    finally:
        sys.path.remove(folder)


# --- code of plugins ----------------------------------------------------------------------------

_INSTALLED = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
_PLAIN = (str, bytes, int, float, complex, np.generic, type(None), type(Ellipsis))
_OWN = ("__dict__", "__weakref__", "__doc__", "__firstlineno__", "__static_attributes__")


@contextlib.contextmanager
def plugins_made(mi: Any, names: set[str]) -> Iterator[list[Any]]:
    """Collect the objects of Python plugins that are made while the context lasts.

    Mitsuba does not say which class a name was registered for, and its own objects do not lead to
    everything they hold. The objects are therefore searched among all objects of the process,
    unless all plugins are Mitsuba's own.
    """
    made: list[Any] = []
    if names <= _own_names(mi):
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
    """Return a digest of the code of each class of the plugins, by name."""
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


def digest_of(function: Callable[..., Any]) -> str:
    """Return a digest of the code of a function, and of what it reaches.

    Examples
    --------
    >>> digest_of(lambda x: x) == digest_of(lambda x: x + 1)
    False
    """
    content = _Content(str(getattr(function, "__module__", "")).split(".")[0])
    content.add(function)
    return content.digest()[:16]


class _Content:
    """A digest of Python values and the code that they reach; each counts once."""

    def __init__(self, package: str) -> None:
        self._package, self._hash = package, hashlib.sha256()
        self._seen: dict[int, Any] = {}

    def digest(self) -> str:
        return self._hash.hexdigest()

    def add_module(self, kind: type) -> None:
        """Add the file of a class's module; a script's file changes with what it asks for."""
        module = sys.modules.get(kind.__module__)
        file = getattr(module, "__file__", None)
        if file and kind.__module__ != "__main__":
            with contextlib.suppress(OSError):  # that of a plugin need not be there
                self._hash.update(vars(module).get(_CODE) or Path(file).read_bytes())

    def add(self, value: Any) -> None:
        """Add a value and everything that it leads to."""
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
        """Return whether a module is the user's: in the plugin's package, or not installed."""
        package = (module or "").split(".")[0]
        if package == self._package:
            return True
        file = getattr(sys.modules.get(package), "__file__", None)
        return file is not None and not any(file.startswith(f"{at}/") for at in _INSTALLED)


def _names(code: types.CodeType) -> Iterator[str]:
    """Yield the names that a function, and functions within it, look up."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)


def _package(kind: type) -> str:
    return str(kind.__module__).split(".")[0]
