"""Program: the command line application, its own options, its output, and how it ends."""

from __future__ import annotations

import json
import logging
import reprlib
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any, TextIO

import typer

from chdstat import __version__
from chdstat.errors import ChdstatError, LeftOutWarning

__all__ = ["app", "main", "print_json", "print_rows", "print_table", "say_samples"]

_WIDE = 200


def say_samples(samples: Any, as_json: bool) -> None:
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


app = typer.Typer(
    help="Look at the sample distributions behind a Monte Carlo image.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_INTERRUPTED = 130


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
