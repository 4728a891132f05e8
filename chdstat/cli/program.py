"""Program: the application, how commands enter it, and how it ends."""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import reprlib
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from inspect import Signature, signature
from typing import Annotated, Any

import typer
import typer.core

from chdstat import __version__
from chdstat._core.files import place_of
from chdstat.cli.arguments import (
    SHARED,
    SHARED_TEXTS,
    CommonOptions,
    as_typed,
    described,
    parameter,
    renders_beside,
    typed_names,
)
from chdstat.errors import ChdstatError, InputWarning, LeftOutWarning
from chdstat.scenes import load_plugin

_INTERRUPTED = 130
_TO_MEND = 2
"""Exit code of errors that a user can act on, as of wrong options; a crash ends with 1."""
_RESUMED = ("render", "import", "study", "paper", "--store")
"""Commands and options for which the same command line resumes after an interruption."""
_PLACES = ("-o", "--out", "--store")
"""Options that name what such a command line writes."""
_MEANT = {
    "classify": "analyze",
    "fit": "analyze",
    "summarize": "analyze",
    "denoise": "estimate --denoise",
    "plot": "explore",
    "view": "explore",
    "diff": "contrast",
    "rank": "contrast",
    "benchmark": "bench",
    "version": "--version",
}
"""Commands by other names that users may try."""
_OF_ONE = {
    "compare": "Estimators are compared, renders are contrasted: 'chdstat contrast {}'.",
    "analyze": "It takes one store. 'chdstat report {} -o report.pdf' says which is noisier.",
}
"""Commands that take one store, and what to do with several."""


_typed: dict[str, str] = {}
"""The options of this call, by the names of the library's parameters."""


class _Commands(typer.core.TyperGroup):
    """The commands, with ``help`` for ``--help``, and hints for other names of commands."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line."""
        return super().parse_args(ctx, [*args[1:], "--help"] if args[:1] == ["help"] else args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return a command; for an unknown name, suggest the command that is meant."""
        name = args[0]
        if name in _OF_ONE:
            from chdstat.samples import is_store

            given = (one for before, one in itertools.pairwise(args) if before[:1] != "-")
            stores = [one for one in given if is_store(one)]
            if len(stores) > 1:
                ctx.fail(_OF_ONE[name].format(shlex.join(stores)))
        if name not in self.commands and name in _MEANT:
            ctx.fail(f"No such command {name!r}. It is what 'chdstat {_MEANT[name]}' does.")
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=_Commands,
    help="Look at the sample distributions behind a Monte Carlo image.",
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def command(
    example: str, *shared: str, name: str | None = None, **unset: str
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function as a command of the application.

    The command takes the parameters of the function except `asked`, and the `shared` options, which
    the function gets as `asked`. `unset` maps options to the defaults that the help shows.
    """

    def enter(function: Callable[..., None]) -> Callable[..., None]:
        own = signature(function, eval_str=True).parameters
        taken = [SHARED[key] for key in shared] + [own[key] for key in own if key != "asked"]

        @functools.wraps(function)
        def run(**given: Any) -> None:
            _typed.clear()
            _typed.update(typed)
            asked = CommonOptions.of({key: given.pop(key) for key in shared})
            for file in asked.plugin or ():  # scenes and options may name what they register
                load_plugin(file)
            function(**given, asked=asked)

        about, texts = described(function)
        told = {key: SHARED_TEXTS[key] for key in shared} | texts
        options = [parameter(one, told, unset.get(one.name)) for one in taken]
        typed = typed_names(options)
        run.__signature__ = Signature(options)  # type: ignore[attr-defined]
        return app.command(name, help=about, epilog=f"Example: chdstat {example}")(run)

    return enter


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
        typer.Option(
            "--version", "-v", help="Print the version.", is_eager=True, callback=_say_version
        ),
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
    "paper",
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
    to_stderr = logging.StreamHandler()
    to_stderr.setFormatter(_AsTyped("chdstat: %(message)s"))
    logging.basicConfig(handlers=[to_stderr], level=logging.WARNING)
    warnings.showwarning = _shown_once()
    try:
        app()
    except (ChdstatError, OSError, MemoryError) as error:
        if "--debug" in sys.argv:
            raise
        _fail(_told(error), _TO_MEND)
    except (SystemExit, KeyboardInterrupt) as ended:  # typer makes the first of most of the second
        if getattr(ended, "code", _INTERRUPTED) == _INTERRUPTED:
            resumed = "; the same command goes on from here" * _is_begun(sys.argv)
            _fail(f"stopped{resumed}", _INTERRUPTED)
        raise


def _told(error: Exception) -> str:
    """Return what an error says that a user can act on."""
    if isinstance(error, MemoryError):
        return "out of memory; use a smaller --size or --spp, or keep samples in a store"
    if isinstance(error, OSError):  # such as a name that is too long, or a folder not to be read
        name = reprlib.repr(error.filename) if error.filename else ""
        return f"{error.strerror or error}: {name}".rstrip(": ")
    return as_typed(str(error), _typed)


class _AsTyped(logging.Formatter):
    """Names the options of a command where the library names its parameters."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - as logging calls it
        """Return the line of a message."""
        return as_typed(super().formatMessage(record), _typed)


def _is_begun(line: Sequence[str]) -> bool:
    """Return whether a command line has written something from which it would go on."""
    words = [part for word in line for part in word.split("=", 1)]
    named = [text for name, text in itertools.pairwise(words) if name in _PLACES]
    resumed = any(word in _RESUMED for word in words)
    with contextlib.suppress(ChdstatError, OSError):
        places = [place_of(text) for text in named]
        return resumed and any(one.exists() or renders_beside(one).exists() for one in places)
    return False


def _shown_once() -> Callable[..., None]:
    """Return what prints warnings, once each, those of ours without the place of their code."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
        text = warnings.formatwarning(message, category, *place[:2]).rstrip()
        if issubclass(category, LeftOutWarning | InputWarning):
            text = f"chdstat: {as_typed(str(message), _typed)}"
        if text not in shown:
            typer.echo(text, err=True)
        shown.add(text)

    return show


def _fail(message: str, code: int) -> None:
    typer.echo(f"chdstat: {message}", err=True)
    sys.exit(code)
