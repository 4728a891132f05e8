"""Program: the application, options that several commands take, and how it ends."""

from __future__ import annotations

import json
import logging
import re
import reprlib
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from chdstat import __version__
from chdstat._core.files import is_path, place_of
from chdstat.errors import (
    ChdstatError,
    InputError,
    InputWarning,
    LeftOutWarning,
    OtherSceneWarning,
)

if TYPE_CHECKING:
    from chdstat.patterns import Thresholds
    from chdstat.rendering.backend import Backend
    from chdstat.samples import Samples
    from chdstat.scenes import Scene
else:
    Backend = str  # the library knows which there are; it is imported when a command runs

__all__ = [
    "SEED",
    "SPP",
    "BackendName",
    "Compared",
    "Defines",
    "Depth",
    "Iterations",
    "Json",
    "Plugins",
    "Quiet",
    "RecipeSize",
    "SceneName",
    "SceneOrStore",
    "Scheduler",
    "Seed",
    "Size",
    "Spp",
    "StoreKept",
    "StorePath",
    "Workers",
    "app",
    "crop_of",
    "integrator_of",
    "load_plugins",
    "main",
    "samples_of",
    "scene_of",
    "size_of",
    "source_of",
    "thresholds_of",
]

SPP = 256
"""Samples per pixel of a render where none are asked for, as in `chdstat.render`."""
_INTERRUPTED = 130

# --- options ------------------------------------------------------------------------------------

SEED = "Random seed, a non-negative integer."


def _scene_names(begun: str) -> list[tuple[str, str]]:
    """Return the built-in scenes that begin so, with what each shows, for the shell."""
    from chdstat.scenes import BUILTIN

    return [row for row in BUILTIN.items() if row[0].startswith(begun)]


def _estimator_names(begun: str) -> list[str]:
    """Return the estimators that begin so, for the shell."""
    from chdstat.estimators.registry import names

    return [name for name in names() if name.startswith(begun)]


SceneName = Annotated[
    str,
    typer.Argument(
        metavar="SCENE", help="Built-in name or Mitsuba XML file.", autocompletion=_scene_names
    ),
]
SceneOrStore = Annotated[
    str,
    typer.Argument(
        metavar="SCENE|STORE",
        help="Built-in name, Mitsuba XML file or finished store.",
        autocompletion=_scene_names,
    ),
]
StorePath = Annotated[
    Path, typer.Argument(metavar="STORE", help="A finished store, or its URL.", parser=place_of)
]
Spp = Annotated[
    int | None,
    typer.Option(
        "--spp",
        help="Number of samples per pixel; of a store, the first ones.",
        show_default=f"{SPP} of a scene, all of a store",
    ),
]
Compared = Annotated[
    list[str] | None,
    typer.Option(
        "-e",
        "--estimator",
        metavar="NAME",
        help="An estimator to compare, trained here if it learns; can be repeated. "
        '" + OIDN" behind a name denoises its estimate.',
        show_default="the default estimate, the mean and a few more",
        autocompletion=_estimator_names,
    ),
]
Size = Annotated[
    str | None,
    typer.Option(
        "--size", metavar="WxH", help="Image size in pixels.", show_default="the scene's own"
    ),
]
RecipeSize = Annotated[
    str | None,
    typer.Option(
        "--size",
        metavar="WxH",
        help="Image size in pixels.",
        show_default="the recipe's, or 128 along the longer edge",
    ),
]
Seed = Annotated[int, typer.Option("--seed", help=SEED)]
Depth = Annotated[
    int | None,
    typer.Option(
        "--max-depth", help="Maximum path length in segments.", show_default="the scene's own"
    ),
]
BackendName = Annotated[
    Backend,
    typer.Option("--backend", help="auto, scalar, llvm or cuda.", metavar="NAME", parser=str),
]
Defines = Annotated[
    list[str] | None,
    typer.Option("-D", metavar="KEY=VALUE", help="Parameter of an XML scene; can be repeated."),
]
Plugins = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugin",
        metavar="FILE",
        help="Python file that registers integrators or materials with Mitsuba, or estimators; can "
        "be repeated.",
        show_default="none",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Show no progress, and not what to do next.")
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Dask scheduler whose workers do the work.",
        show_default="none: this process",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Worker processes of this machine that do the work.",
        show_default="none: threads",
    ),
]
Iterations = Annotated[
    int | None, typer.Option(help="Number of training minibatches.", show_default="as many as pay")
]
StoreKept = Annotated[
    Path | None,
    typer.Option(
        "--store",
        metavar="PATH",
        parser=place_of,
        help="Store in which the samples are kept, and resumed from.",
        show_default="none: in memory",
    ),
]


def load_plugins(files: list[Path] | None) -> None:
    """Load plugins, so that scenes and options may name what they register."""
    from chdstat.scenes import load_plugin

    for file in files or ():
        load_plugin(file)


def scene_of(name: str, define: list[str] | None) -> Scene:
    """Return a scene by name or file, with its parameters."""
    from chdstat.scenes import load_scene

    return load_scene(name, **pairs_of("-D", define))


def source_of(source: str, define: list[str] | None) -> Path | Scene:
    """Return the path of a finished store, or a scene by name or file, with its parameters."""
    from chdstat.rendering import refuse_render
    from chdstat.samples import is_store

    if not is_store(source):
        return scene_of(source, define)
    refuse_render(source, {"-D": define or None})
    return place_of(source)


def samples_of(
    source: str,
    *,
    spp: int | None,
    size: str | None,
    seed: int,
    max_depth: int | None,
    backend: Backend,
    define: list[str] | None,
    store: Path | None,
    quiet: bool,
) -> Samples:
    """Return the samples of a finished store, or render those of a scene."""
    from chdstat.rendering import refuse_render, render
    from chdstat.samples import open as open_store

    found = source_of(source, define)
    if is_path(found):
        # A seed may be that of a training, and spp the number of first samples.
        asked = {"size": size, "store": store, "max_depth": max_depth, "backend": backend}
        refuse_render(source, asked)
        return open_store(found)
    return render(
        found,
        spp=SPP if spp is None else spp,
        size=size_of(size),
        seed=seed,
        max_depth=max_depth,
        out=store,
        backend=backend,
        progress=not quiet,
    )


def thresholds_of(given: list[str] | None) -> Thresholds:
    """Return thresholds of patterns from ``NAME=VALUE``."""
    from chdstat.patterns import Thresholds

    known = [field.name for field in fields(Thresholds)]
    values = {}
    for name, value in pairs_of("--threshold", given).items():
        if name not in known:
            message = f"--threshold takes one of {', '.join(known)}, got {name!r}"
            raise InputError(message)
        try:
            values[name] = float(value)
        except ValueError:
            message = f"--threshold {name} takes a number, got {value!r}"
            raise InputError(message) from None
    return Thresholds(**values)


def pairs_of(option: str, given: list[str] | None) -> dict[str, str]:
    """Return what was given as ``KEY=VALUE``."""
    pairs = {}
    for text in given or []:
        key, equals, value = text.partition("=")
        if not equals or not key:
            message = f"{option} takes KEY=VALUE, got {text!r}"
            raise InputError(message)
        pairs[key] = value
    return pairs


def size_of(text: str | None) -> tuple[int, int] | None:
    """Return width and height from ``WxH``."""
    if text is None:
        return None
    size = re.fullmatch("([0-9]{1,9})x([0-9]{1,9})", text.lower())
    if size is None:
        message = f"--size takes WIDTHxHEIGHT such as 128x128, got {reprlib.repr(text)}"
        raise InputError(message)
    return int(size[1]), int(size[2])


def crop_of(text: str | None) -> tuple[int, int, int, int] | None:
    """Return x, y, width and height from ``X,Y,WxH``."""
    if text is None:
        return None
    crop = re.fullmatch("([0-9]{1,9}),([0-9]{1,9}),([0-9]{1,9})x([0-9]{1,9})", text.lower())
    if crop is None:
        message = f"--crop takes X,Y,WIDTHxHEIGHT such as 16,8,64x32, got {reprlib.repr(text)}"
        raise InputError(message)
    x, y, width, height = map(int, crop.groups())
    return x, y, width, height


def integrator_of(text: str | None) -> str | dict[str, Any] | None:
    """Return an integrator by name, or its settings from JSON."""
    if text is None or not text.lstrip().startswith("{"):
        return text
    try:
        return dict(json.loads(text))
    except ValueError as error:
        message = f"--integrator takes a name or JSON, got {reprlib.repr(text)}: {error}"
        raise InputError(message) from error


# --- the application ----------------------------------------------------------------------------

app = typer.Typer(
    help="Look at the sample distributions behind a Monte Carlo image.",
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"chdstat {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")] = False,
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version.", is_eager=True, callback=_say_version),
    ] = False,
) -> None:
    del debug, version  # main and the callback have seen to them
    if context.invoked_subcommand is None:
        _show_flow(context)


_FLOW = (
    "render",
    "info",
    "analyze",
    "contrast",
    "compare",
    "bench",
    "train",
    "estimate",
    "report",
    "explore",
    "study",
)


def _show_flow(context: typer.Context) -> None:
    """Print the commands in the order of the work, each with its example and first sentence."""
    commands: Any = context.command
    typer.echo("From a scene to its sample distributions, step by step:\n")
    for name in _FLOW:
        command = commands.commands[name]
        example = command.epilog.removeprefix("Example: ")
        typer.echo(f"  {example}\n      {command.get_short_help_str(200)}")
    typer.echo(
        "\nStart with 'chdstat report cornell-box -o report.pdf', which does most of it. Names of "
        "scenes and\nestimators: chdstat list. Options: chdstat COMMAND --help. What works here: "
        "chdstat doctor."
    )


def main() -> None:
    """Run the command line; errors that a user can act on end without a traceback."""
    logging.basicConfig(format="chdstat: %(message)s", level=logging.WARNING)
    warnings.showwarning = _shown_once()
    try:
        app()
    except ChdstatError as error:
        if "--debug" in sys.argv:
            raise
        _fail(str(error), 1)
    except SystemExit as ended:
        if ended.code == _INTERRUPTED:  # what typer makes of Ctrl-C
            _fail("stopped; what renders to a store resumes where it was", _INTERRUPTED)
        raise
    except OSError as error:  # such as a name that is too long, or a folder that may not be read
        if "--debug" in sys.argv:
            raise
        name = reprlib.repr(error.filename) if error.filename else ""
        _fail(f"{error.strerror or error}: {name}".rstrip(": "), 1)
    except MemoryError:
        _fail("out of memory; use a smaller --size or --spp, or keep samples in a store", 1)


def _shown_once() -> Callable[..., None]:
    """Return what prints warnings, once each, those of ours without the place of their code."""
    shown: set[str] = set()

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        text = warnings.formatwarning(message, category, filename, lineno, line).rstrip()
        if issubclass(category, LeftOutWarning | InputWarning | OtherSceneWarning):
            text = f"chdstat: {message}"
        if text not in shown:
            typer.echo(text, file=file, err=True)
        shown.add(text)

    return show


def _fail(message: str, code: int) -> None:
    typer.echo(f"chdstat: {message}", err=True)
    sys.exit(code)
