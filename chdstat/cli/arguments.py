"""Arguments: what commands take, declared by functions and docstrings, and made of it in a call.

An option is a parameter of the command's function. What the help says of it stands in the docstring
of the function, as ``name : METAVAR, default TEXT`` and its sentences: numpydoc's form.
"""

from __future__ import annotations

import json
import re
import reprlib
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from copy import copy
from dataclasses import dataclass, field
from inspect import Parameter, cleandoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args, get_origin

import typer
from typer.models import OptionInfo

from chdstat._core.files import checked_target, is_path, local, place_of, remove
from chdstat.errors import InputError, StoreError
from chdstat.rendering import RenderSettings
from chdstat.rendering.jobs import SETTINGS, TYPED

if TYPE_CHECKING:
    from distributed import Client

    from chdstat.samples import Samples
    from chdstat.scenes import Scene


def _scene_names(begun: str) -> list[tuple[str, str]]:
    """Return the built-in scenes that begin so, with what each shows, for the shell."""
    from chdstat.scenes import BUILTIN

    return [row for row in BUILTIN.items() if row[0].startswith(begun)]


def _estimator_names(begun: str) -> list[str]:
    """Return the estimators that begin so, for the shell."""
    from chdstat.estimators.registry import names

    return [name for name in names() if name.startswith(begun)]


_SCENE: Any = typer.Argument(autocompletion=_scene_names)
_PLACE: Any = typer.Argument(parser=place_of)
# Behind the types of arguments that several commands take: metavar, and what the help says.
SceneName = Annotated[str, _SCENE, "SCENE", "Built-in name or scene file."]
SceneOrStore = Annotated[str, _SCENE, "SCENE|STORE", "Built-in name, scene file or finished store."]
ScenesOrStores = Annotated[
    list[str],
    _SCENE,
    "SCENE|STORE...",
    "Built-in name, scene file or finished store; or several stores of one view.",
]
StorePath = Annotated[Path, _PLACE, "STORE", "A finished store, or its URL."]
Location = Annotated[Path, _PLACE]
"""An argument that is a path or a URL."""
Words = Annotated[list[str], typer.Argument()]
OptionalWords = Annotated[list[str] | None, typer.Argument()]
Place = Annotated[Path, typer.Option(parser=place_of)]
"""An option that is a path or a URL."""
FromOne = Annotated[int | None, typer.Option(min=1)]

VIEW = ("spp", "size", "seed", "max_depth", "backend", "define", "frame", "plugin")
"""Options of commands that render a scene."""
OUTPUT = ("quiet", "as_json")
"""Options of commands that print."""


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options that several commands share, with their values in this call; None if not given.

    Each command names the options that it takes: those of `RenderSettings`, and these.

    Parameters
    ----------
    given
        Given settings of a render, by name.
    estimator : NAME, default the default estimate, the mean and a few more
        An estimator to compare, trained here if it learns; can be repeated. " + OIDN" after a name
        denoises its estimate.
    iterations : int, default as many as help
        Number of training minibatches.
    error : ERROR
        Relative error of the image at which to stop: the root of its relMSE, .02 for 2 %.
    define : KEY=VALUE
        Parameter of a scene file: of an XML file, or camera, view_layer, scene or frame of a .blend
        file; can be repeated.
    frame : int, default the file's own
        Frame of a .blend file.
    plugin : FILE
        Python file that registers integrators or materials with Mitsuba, or estimators; can be
        repeated.
    store : PATH, default none: in memory
        Store that keeps the samples, and from which a stopped render resumes.
    scheduler : ADDRESS, default none: this process
        Dask scheduler whose workers do the work.
    workers : N, default none: threads
        Worker processes of this machine that do the work.
    overwrite : bool
        Replace an output that is there already.
    quiet : bool
        Show neither progress nor next steps.
    as_json : bool
        Print JSON for scripts.
    """

    given: Mapping[str, Any] = field(default_factory=dict)
    estimator: Annotated[list[str] | None, typer.Option(autocompletion=_estimator_names)] = None
    iterations: int | None = None
    error: float | None = None
    define: list[str] | None = None
    frame: int | None = None
    plugin: list[Path] | None = None
    store: Annotated[Path | None, typer.Option(parser=place_of)] = None
    scheduler: str | None = None
    workers: FromOne = None
    overwrite: bool = False
    quiet: bool = False
    as_json: bool = False

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> CommonOptions:
        """Return the options of a call from the values of all that it may take."""
        others = {name: value for name, value in given.items() if name not in SETTINGS}
        settings = {name: given[name] for name in given.keys() & SETTINGS.keys()}
        return cls(given=settings, **others)

    @property
    def settings(self) -> dict[str, Any]:
        """The given settings of a render."""
        get = self.given.get
        parsed = {
            "size": _numbers_in("--size", get("size"), "WxH", "128x128"),
            "crop": _numbers_in("--crop", get("crop"), "X,Y,WxH", "16,8,64x32"),
            "integrator": _integrator_of(get("integrator")),
        }
        known = {**self.given, **parsed}
        return {name: known[name] for name in SETTINGS if known.get(name) is not None}

    @property
    def seed(self) -> int | None:
        """The seed, if one is given."""
        return self.given.get("seed")

    @property
    def spp(self) -> int | None:
        """The number of samples per pixel, if it is given."""
        return self.given.get("spp")

    @property
    def progress(self) -> bool:
        """Whether to show progress bars."""
        return not self.quiet

    def scene(self, name: str) -> Scene:
        """Return a scene by name or file, with its parameters."""
        from chdstat.scenes import load_scene

        parameters = pairs_of("-D", self.define)
        if self.frame is not None:
            if Path(name).suffix.lower() != ".blend":
                message = f"--frame is for .blend files, got {name}; leave it out"
                raise InputError(message)
            parameters["frame"] = str(self.frame)
        return load_scene(name, **parameters)

    def source(self, name: str) -> Path | Scene:
        """Return the path of a finished store, or a scene by name or file."""
        from chdstat.rendering import refuse_render
        from chdstat.samples import is_store

        if not is_store(name):
            return self.scene(name)
        refuse_render(name, {"-D": self.define or None, "--frame": self.frame})
        return place_of(name)

    def samples(self, name: str, *, seed: int | None) -> Samples:
        """Return the samples of a finished store, or render those of a scene.

        `seed` is the seed of the render; None if the seed is also used for the work on a store.
        """
        from chdstat.rendering import refuse_render, render
        from chdstat.samples import open as open_store

        found = self.source(name)
        if is_path(found):
            # spp is the number of first samples.
            settings = {**self.settings, "spp": None, "seed": seed, "store": self.store}
            refuse_render(name, settings)
            return open_store(found)
        return render(found, **self.settings, out=self.store, progress=self.progress)

    def target(self, out: Path, *suffixes: str) -> Path:
        """Return a file to write, with one of the suffixes; without suffixes, a folder.

        Raises
        ------
        InputError, StoreError
            If it cannot be written, or exists and may not be replaced.
        """
        path = checked_target(out, *suffixes) if suffixes else local(out)
        if not path.exists():
            return path
        if not self.overwrite:
            message = f"{path} exists; nothing was overwritten. Give another path, or --overwrite"
            raise StoreError(message)
        written = any((path / name).exists() for name in ("zarr.json", "comparison.json"))
        if path.is_dir() and (not written or (path / "radiance").exists()):  # others', or samples
            message = f"{path} is no output of this command; remove it yourself, or give another"
            raise StoreError(message)
        return path

    def replaced(self, folder: Path) -> Path:
        """Return a folder that `target` allows to write, after removing an existing one."""
        if self.overwrite:
            remove(folder)
        return folder

    def client(self) -> AbstractContextManager[Client | None]:
        """Yield a client of the requested workers, None for threads."""
        from chdstat._core.work import client_of

        return client_of(self.scheduler, self.workers)


# --- how arguments are declared -----------------------------------------------------------------

_NAMES = {
    "out": ("--out", "-o"),
    "estimator": ("-e", "--estimator"),
    "define": ("-D",),
    "quiet": ("--quiet", "-q"),
    "as_json": ("--json",),
}
"""Names of options that are not those of their parameters."""


class _Described(NamedTuple):
    """What a docstring says of a parameter."""

    metavar: str | None = None
    default: str | None = None
    about: str | None = None


def described(thing: Any) -> tuple[str, dict[str, _Described]]:
    """Return the paragraphs of a docstring, a line each, and what it says of its parameters."""
    text, _, listed = cleandoc(thing.__doc__ or "").partition("\n\nParameters\n----------\n")
    form = r"^(\w+) : (.+?)(?:, default (.+))?\n((?:    .*(?:\n|$))+)"
    found = {
        name: _Described(None if kind.islower() else kind, default or None, " ".join(about.split()))
        for name, kind, default, about in re.findall(form, listed, re.MULTILINE)
    }
    # Typer would keep the line breaks of the docstring.
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n")), found


def _typed(kind: Any) -> Any:
    """Return the type of an option for a setting: a number, a choice, or a text of it."""
    if int in (kind, *get_args(kind)):
        return int | None
    return (kind if get_origin(kind) is Literal else str) | None


SHARED = {
    name: p.replace(annotation=_typed(TYPED[name]), default=None) for name, p in SETTINGS.items()
}
SHARED |= signature(CommonOptions, eval_str=True).parameters
"""The options that commands share, by name."""
SHARED_TEXTS = described(RenderSettings)[1] | described(CommonOptions)[1]
"""What the help says of them."""


def parameter(declared: Parameter, told: Mapping[str, _Described], unset: str | None) -> Parameter:
    """Return a parameter as typer takes it, with what a docstring tells of it.

    `unset` is the default as the help shows it. A truth value is an option without its negation,
    unless it holds by default.
    """
    name, kind, how = declared.name, declared.annotation, typer.Option()
    says = told.get(name, _Described())
    if get_origin(kind) is Annotated:
        kind, how, *texts = get_args(kind)
        says = _Described(texts[0], None, texts[1]) if texts else says
    how = copy(how)
    how.help, how.metavar = says.about, says.metavar
    default = unset or says.default
    if isinstance(how, OptionInfo):
        flag = (f"--{name.replace('_', '-')}",) if declared.default is False else ()
        how.param_decls = _NAMES.get(name, flag)
        default = default or ("none" if declared.default is None else None)
    how.show_default = default or how.show_default
    return declared.replace(kind=Parameter.KEYWORD_ONLY, annotation=Annotated[kind, how])


_ALIASES = {
    "seconds": "time",
    "relative_error": "error",
    "by_light": "light",
    "estimators": "estimator",
    "references": "reference",
    "images": "image",
    "changed": "change",
}
"""Parameters of the library whose options have other names, unless a command has that name."""


def typed_names(options: Iterable[Parameter]) -> dict[str, str]:
    """Return the options of a command by the names of the library's parameters."""
    hows = {one.name: get_args(one.annotation)[1] for one in options}
    found = {
        name: max(how.param_decls or (f"--{name.replace('_', '-')}",), key=len)
        for name, how in hows.items()
        if isinstance(how, OptionInfo)
    }
    return {name: found[own] for name, own in _ALIASES.items() if own in found} | found


def as_typed(text: str, options: Mapping[str, str]) -> str:
    """Return a message with the options of a command in place of the library's parameters.

    Examples
    --------
    >>> options = {"axes": "--axes", "append": "--append", "size": "--size", "spp": "--spp"}
    >>> as_typed("give axes='syxc', append=True, size=(64, 32)", options)
    'give --axes syxc, --append, --size 64x32'
    >>> as_typed("spp must be at least 1, got 0", options)
    '--spp must be at least 1, got 0'
    >>> as_typed('by {"max_depth": 1}', {"max_depth": "--max-depth"})
    'by {"max_depth": 1}'
    """
    if not options:
        return text
    names = "|".join(sorted(options, key=len, reverse=True))
    long = "|".join(name for name in options if "_" in name) or "_"

    def option(found: re.Match[str]) -> str:
        name, value = options[found[1]], (found[2] or "").strip("'\"[]")
        if value in ("", "True"):
            return name
        size = re.fullmatch(r"\((\d+), (\d+)\)", value)
        return f"{name} {'x'.join(size.groups()) if size else value}"

    values = r"""('[^']*'|"[^"]*"|\[[^\]]*\]|\([^)]*\)|[-+\w.]*\w)?"""
    text = re.sub(rf"(?<![-\w.])({names})={values}", option, text)
    # A name alone may be a word of the sentence, unless it is none.
    free = r"""(?<![-\w./'"])"""  # of quotes, as those of a name in JSON
    alone = rf"{free}((?:{names})(?= must | above )|(?<=smaller )(?:{names})\b|(?:{long})\b)"
    return re.sub(alone, lambda found: options[found[1]], text)


def renders_beside(document: Path) -> Path:
    """Return the folder that keeps the renders of a document unless another one is named."""
    return document.with_name(f"{document.stem}-renders")


def pairs_of(option: str, given: list[str] | None) -> dict[str, str]:
    """Return options of the form ``KEY=VALUE``."""
    pairs = {}
    for text in given or []:
        key, equals, value = text.partition("=")
        if not equals or not key:
            message = f"{option} takes KEY=VALUE, got {text!r}"
            raise InputError(message)
        pairs[key] = value
    return pairs


def _numbers_in(option: str, text: str | None, form: str, example: str) -> tuple[int, ...] | None:
    """Return the numbers in a text; each capital letter of the form is one number."""
    if text is None:
        return None
    found = re.fullmatch(re.sub("[A-Z]", "([0-9]{1,9})", form), text.lower())
    if found is None:
        named = form.replace("WxH", "WIDTHxHEIGHT")
        message = f"{option} takes {named} such as {example}, got {reprlib.repr(text)}"
        raise InputError(message)
    return tuple(map(int, found.groups()))


def _integrator_of(text: str | None) -> str | dict[str, Any] | None:
    """Return an integrator by name, or its settings from JSON."""
    if text is None or not text.lstrip().startswith("{"):
        return text
    try:
        return dict(json.loads(text))
    except ValueError as error:
        message = f"--integrator takes a name or JSON, got {reprlib.repr(text)}: {error}"
        raise InputError(message) from error
