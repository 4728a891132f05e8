"""Plugins: Python files that register parts of scenes with Mitsuba, or estimators with chdstat.

Mitsuba keeps what is registered for one variant, and classes in Python derive from those of the
variant that is set. So the file of a plugin is run once for each variant that a scene is rendered
in, in each process that renders. It travels there as text: workers need no copy of the file.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.abc
import importlib.util
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from chdstat.errors import ChdstatError, InputError

__all__ = [
    "Plugin",
    "failure",
    "load_plugin",
    "loaded",
    "own_names",
    "owns_estimator",
    "register",
    "used",
]

_PREFIX = "chdstat_plugin_"
"""Of the names of their modules, so that no other module is hidden."""


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
"""By Mitsuba's variant and the name of the file."""
_ESTIMATORS: dict[str, str] = {}
"""Names of the files by that of the estimator that they have registered."""
_RUNNING: list[_Registration] = []
"""That of the plugin which is run now, if any."""


def load_plugin(path: str | Path) -> Plugin:
    """Run a Python file that registers parts of scenes with Mitsuba, or estimators with chdstat.

    Renders that follow know what it registers, in any variant and in the processes of the explorer
    and of a Dask cluster, too. A store records those plugins that its scene or integrator names,
    and goes on with the same code only. Loading a file again takes what has changed.

    The file may import modules that lie beside it; classes of Mitsuba belong into the file itself,
    for it is run again in other variants. There `mitsuba.set_variant` does nothing, as the variant
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
        If there is no such file, it raises an error, registers nothing, or takes a name that is
        Mitsuba's own or another plugin's.

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
    """Run plugins in the variant that is set, those that were not run in it yet.

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
    """Return the digests of those plugins that a scene uses, by the names of their files.

    They have registered one of the scene's `names` of Mitsuba plugins, or the class of an object
    that was made.
    """
    modules = {type(thing).__module__ for thing in made}
    return {
        plugin.name: plugin.digest
        for plugin in plugins
        if plugin.module in modules or _REGISTERED[variant, plugin.name].parts & names
    }


def owns_estimator(name: str, *, held: bool) -> bool:
    """Return whether an estimator of this name may be registered, and note the plugin that does.

    One that is `held` in the registry may only be registered again by the file that it comes from.
    """
    if not _RUNNING:
        return not held
    running = _RUNNING[-1]
    if held and _ESTIMATORS.get(name) != running.plugin.name:
        return False
    _ESTIMATORS[name] = running.plugin.name
    running.estimators.add(name)
    return True


def own_names(mi: Any) -> set[str]:
    """Return the names of Mitsuba's own plugins."""
    folder = Path(mi.__file__).parent
    files = (*(folder / "plugins").iterdir(), *(folder / "python/ad/integrators").glob("*.py"))
    return {file.stem for file in files}


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


class _Loader(importlib.abc.SourceLoader):
    """Gives the code that a plugin travels with, wherever its file is."""

    def __init__(self, plugin: Plugin) -> None:
        self._plugin = plugin

    def get_filename(self, fullname: str) -> str:
        del fullname
        return str(self._plugin.path)

    def get_data(self, path: str | bytes) -> bytes:
        if str(path) != str(self._plugin.path):  # compiled code is kept nowhere
            raise FileNotFoundError(path)
        return self._plugin.code


def _run(plugin: Plugin, variant: str) -> _Registration:
    """Run the code of a plugin, and return what it has registered."""
    registration, loader = _Registration(plugin), _Loader(plugin)
    spec = importlib.util.spec_from_loader(plugin.module, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    previous = sys.modules.get(plugin.module)
    sys.modules[plugin.module] = module
    _RUNNING.append(registration)
    try:
        with _recorded(registration, variant), _beside(plugin):
            loader.exec_module(module)
    except (Exception, SystemExit) as error:
        sys.modules.pop(plugin.module)
        if previous is not None:
            sys.modules[plugin.module] = previous
        raise failure([plugin], error) from error
    finally:
        _RUNNING.pop()
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
    set_variant, own = mi.set_variant, own_names(mi)

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
