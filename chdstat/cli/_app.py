"""App: the program itself, its own options, and how it ends."""

from __future__ import annotations

import logging
import reprlib
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, TextIO

import typer

from chdstat import __version__
from chdstat.errors import ChdstatError, LeftOutWarning

__all__ = ["app", "main"]

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
