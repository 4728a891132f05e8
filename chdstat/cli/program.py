"""Program: the application, options that several commands take, its output, and how it ends."""

from __future__ import annotations

import contextlib
import importlib
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
from chdstat.errors import ChdstatError, InputError, LeftOutWarning

if TYPE_CHECKING:
    from distributed import Client

    from chdstat.patterns import Thresholds
    from chdstat.rendering.backend import Backend
    from chdstat.samples import Samples
    from chdstat.scenes import Scene
else:
    Backend = str  # the library knows which there are; it is imported when a command runs

__all__ = [
    "SPP",
    "BackendName",
    "Defines",
    "Depth",
    "Iterations",
    "Json",
    "Quiet",
    "SceneName",
    "SceneOrStore",
    "Seed",
    "SeedOrNone",
    "Size",
    "Spp",
    "StoreKept",
    "StorePath",
    "app",
    "client_of",
    "main",
    "print_json",
    "print_rows",
    "print_table",
    "progress_of",
    "samples_of",
    "say_samples",
    "scene_of",
    "size_of",
    "source_of",
    "thresholds_of",
]

SPP = 256
"""Samples per pixel of a render where none are asked for, as in `chdstat.render`."""
_WIDE = 200
_INTERRUPTED = 130

# --- options ------------------------------------------------------------------------------------

_SEED = typer.Option("--seed", help="Random seed, a non-negative integer.")

SceneName = Annotated[
    str, typer.Argument(metavar="SCENE", help="Built-in name or Mitsuba XML file.")
]
SceneOrStore = Annotated[
    str,
    typer.Argument(
        metavar="SCENE|STORE", help="Built-in name, Mitsuba XML file or finished store."
    ),
]
StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="A finished store.")]
Spp = Annotated[int | None, typer.Option("--spp", help="Number of samples per pixel.")]
Size = Annotated[str | None, typer.Option("--size", metavar="WxH", help="Image size in pixels.")]
Seed = Annotated[int, _SEED]
SeedOrNone = Annotated[int | None, _SEED]
Depth = Annotated[int | None, typer.Option("--max-depth", help="Maximum path length in segments.")]
BackendName = Annotated[
    Backend,
    typer.Option("--backend", help="auto, scalar, llvm or cuda.", metavar="NAME", parser=str),
]
Defines = Annotated[
    list[str] | None,
    typer.Option("-D", metavar="KEY=VALUE", help="Parameter of an XML scene; can be repeated."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress bars.")]
Iterations = Annotated[int | None, typer.Option(help="Number of training minibatches.")]
StoreKept = Annotated[
    Path | None,
    typer.Option("--store", help="Store in which the samples are kept, and resumed from."),
]


def scene_of(name: str, define: list[str] | None) -> Scene:
    """Return a scene by name or file, with its parameters."""
    from chdstat.scenes import load_scene

    return load_scene(name, **_pairs_of("-D", define))


def source_of(source: str, define: list[str] | None) -> Path | Scene:
    """Return the path of a finished store, or a scene by name or file, with its parameters."""
    from chdstat.rendering import refuse_render
    from chdstat.samples import is_store

    if not is_store(source):
        return scene_of(source, define)
    refuse_render(source, {"-D": define or None})
    return Path(source)


def samples_of(
    source: str,
    *,
    spp: int | None,
    size: str | None,
    seed: int,
    max_depth: int | None,
    backend: Backend,
    direct: bool,
    define: list[str] | None,
    store: Path | None,
    quiet: bool,
) -> Samples:
    """Return the samples of a finished store, or render those of a scene."""
    from chdstat.rendering import refuse_render, render
    from chdstat.samples import open as open_store

    found = source_of(source, define)
    if isinstance(found, Path):
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
        direct=direct,
        out=store,
        backend=backend,
        progress=progress_of(quiet),
    )


def thresholds_of(given: list[str] | None) -> Thresholds:
    """Return thresholds of patterns from ``NAME=VALUE``."""
    from chdstat.patterns import Thresholds

    known = [field.name for field in fields(Thresholds)]
    values = {}
    for name, value in _pairs_of("--threshold", given).items():
        if name not in known:
            message = f"--threshold takes one of {', '.join(known)}, got {name!r}"
            raise InputError(message)
        try:
            values[name] = float(value)
        except ValueError:
            message = f"--threshold {name} takes a number, got {value!r}"
            raise InputError(message) from None
    return Thresholds(**values)


def _pairs_of(option: str, given: list[str] | None) -> dict[str, str]:
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


def progress_of(quiet: bool) -> bool | None:
    """Return whether to show progress: None leaves it to the terminal."""
    return False if quiet else None


def client_of(address: str | None) -> contextlib.AbstractContextManager[Client | None]:
    """Return a context with a Dask client, or with None."""
    if address is None:
        return contextlib.nullcontext()
    distributed: Any = importlib.import_module("distributed")
    try:
        return contextlib.closing(distributed.Client(address, timeout="10s"))
    except (OSError, ValueError) as error:
        message = f"cannot reach a Dask scheduler at {address}: {error}"
        raise InputError(message) from error


# --- output -------------------------------------------------------------------------------------


def say_samples(samples: Samples, as_json: bool) -> None:
    """Say what samples there are."""
    if as_json:
        print_json({**samples.attrs, "path": str(samples.path), "spp": samples.spp})
    else:
        typer.echo(repr(samples))


def print_json(content: dict[str, Any]) -> None:
    """Print numbers for scripts."""
    typer.echo(json.dumps(content, indent=2, allow_nan=False))


def print_table(content: dict[str, Any]) -> None:
    """Print names and values."""
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in content.items():
        table.add_row(name.replace("_", " "), _readable(value))
    Console(highlight=False).print(table)


def print_rows(
    rows: list[dict[str, Any]], columns: dict[str, str], *, separate: str | None = None
) -> None:
    """Print rows with the columns that they have; a line before the first that is `separate`."""
    from rich.console import Console
    from rich.table import Table

    shown = {key: title for key, title in columns.items() if key in rows[0]}
    table = Table(box=None, padding=(0, 2, 0, 0))
    for key, title in shown.items():
        side: Any = "left" if isinstance(rows[0][key], str) else "right"
        table.add_column(title, justify=side, no_wrap=True)
    before = False
    for row in rows:
        if separate is not None and row[separate] and not before:
            before = True
            table.add_row("with neighbours:", style="bold")
        table.add_row(*(_readable(row[key]) for key in shown))
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _WIDE  # whole lines for a pipe or a file
    console.print(table)


def _readable(value: Any) -> str:
    if isinstance(value, dict):
        return "\n".join(f"{k}: {_readable(v)}" for k, v in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        nested = any(isinstance(v, (list, tuple)) for v in value)
        return ("\n" if nested else ", ").join(_readable(v) for v in value) or "none"
    if isinstance(value, float):
        return f"{value:.4g}"
    return "unknown" if value is None else str(value)


# --- the application ----------------------------------------------------------------------------

app = typer.Typer(
    help="Look at the sample distributions behind a Monte Carlo image.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"chdstat {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")] = False,
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version.", is_eager=True, callback=_say_version),
    ] = False,
) -> None:
    del debug, version  # main and the callback have seen to them


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
        if issubclass(category, LeftOutWarning):
            text = f"chdstat: {message}"
        if text not in shown:
            typer.echo(text, file=file, err=True)
        shown.add(text)

    return show


def _fail(message: str, code: int) -> None:
    typer.echo(f"chdstat: {message}", err=True)
    sys.exit(code)
