"""Command line: parse, call, report, exit code. No work is done here."""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from chdstat import __version__
from chdstat.errors import ChdstatError, InputError

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
_COMPARED = {
    "estimator": "estimator",
    "mse_ratio": "MSE ratio",
    "relmse_ratio": "relMSE ratio",
    "improved": "improved",
    "unchanged": "unchanged",
    "bias": "bias",
    "fireflies_left": "fireflies left",
    "time": "time, s",
    "peak_memory": "memory, bytes",
}
"""Columns of the tables of estimators."""
_WIDE = 200

SceneName = Annotated[
    str,
    typer.Argument(metavar="SCENE", help="Built-in name or Mitsuba XML file.", show_default=False),
]
StorePath = Annotated[
    Path, typer.Argument(metavar="STORE", help="A finished store.", show_default=False)
]
Spp = Annotated[int | None, typer.Option("--spp", help="Samples per pixel.", show_default=False)]
Size = Annotated[
    str | None,
    typer.Option("--size", metavar="WxH", help="Image size in pixels.", show_default=False),
]
Seed = Annotated[int | None, typer.Option("--seed", help="Any integer from 0.", show_default=False)]
Depth = Annotated[
    int | None, typer.Option("--max-depth", help="Longest path in segments.", show_default=False)
]
BackendName = Annotated[
    str, typer.Option("--backend", help="auto, scalar, llvm or cuda.", metavar="NAME")
]
Defines = Annotated[
    list[str] | None,
    typer.Option("-D", metavar="KEY=VALUE", help="Parameter of an XML scene; repeat for more."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bars.")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Dask scheduler whose workers render.", show_default=False
    ),
]


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


@app.command(
    epilog="Example: chdstat render bathroom -o bathroom.zarr --spp 512 --size 128x128",
)
def render(
    scene: SceneName,
    out: Annotated[Path, typer.Option("--out", "-o", help="Store to write, resume or append to.")],
    spp: Spp = None,
    size: Size = None,
    seed: Seed = None,
    max_depth: Depth = None,
    backend: BackendName = "auto",
    define: Defines = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Render a scene and keep every sample.

    A store that was stopped half-way is resumed; a larger --spp appends to it.
    """
    import chdstat

    with _client(scheduler) as client:
        samples = chdstat.render(
            _scene(scene, define),
            out=out,
            client=client,
            progress=_progress(quiet),
            **_given(spp=spp, size=_size(size), seed=seed, max_depth=max_depth, backend=backend),
        )
    _say_samples(samples, as_json)


@app.command(epilog="Example: chdstat info bathroom.zarr --json")
def info(
    store: StorePath,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read everything and check its checksums.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Say what a store holds, and whether it is complete and sound."""
    from chdstat.samples import inspect

    found = inspect(store, verify=verify)
    if as_json:
        _print_json(found)
    else:
        _print_table(found)
    if found.get("damaged"):
        message = (
            f"{len(found['damaged'])} damaged chunk(s) in {store}; delete the files listed above "
            "and run the same 'chdstat render' again to repair them"
        )
        raise ChdstatError(message)


@app.command(epilog="Example: chdstat analyze bathroom.zarr -o bathroom-maps.zarr")
def analyze(
    store: StorePath,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Write all maps to this new zarr store.", show_default=False
        ),
    ] = None,
    threshold: Annotated[
        list[str] | None,
        typer.Option(
            "--threshold",
            metavar="NAME=VALUE",
            help="When a pattern counts, such as tail_index=0.3; repeat for more.",
        ),
    ] = None,
    resamples: Annotated[
        int,
        typer.Option(min=0, help="Bootstrap replicates of goodness of fit: minutes for an image."),
    ] = 0,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Say what the sample distributions of a store are: nulls, families, tails, modes, averages."""
    import chdstat
    from chdstat.analysis import save, unused
    from chdstat.overviews import overview

    if out is not None:
        unused(out)  # refused before the work, not after
    thresholds = _thresholds(threshold)
    dataset = chdstat.analyze(
        chdstat.open(store),
        thresholds=thresholds,
        resamples=resamples,
        progress=_progress(quiet),
    )
    if out is not None:
        save(dataset, out)
    numbers = overview(dataset).to_dict()
    if as_json:
        _print_json(numbers)
    else:
        _print_table(numbers)


@app.command(epilog="Example: chdstat compare bathroom.zarr -e mean -e catoni --patterns -o found")
def compare(
    store: StorePath,
    estimator: Annotated[
        list[str] | None,
        typer.Option("--estimator", "-e", metavar="NAME", help="What to compare; repeat for more."),
    ] = None,
    n: Annotated[int | None, typer.Option("--n", help="Samples per estimate.")] = None,
    seed: Seed = None,
    max_batches: Annotated[
        int | None, typer.Option(help="Batches per pixel that estimate.", show_default=False)
    ] = None,
    patterns: Annotated[
        bool, typer.Option("--patterns", help="Say which estimator for which pattern, too.")
    ] = False,
    curve: Annotated[
        bool, typer.Option("--curve", help="Measure errors against the number of samples, too.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for figures and numbers.", show_default=False),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Compare estimators on held-out pixels: errors, bias, fireflies, time and memory."""
    import chdstat
    from chdstat.reporting.comparison_files import save_comparison, unused_folder

    if out is not None:
        unused_folder(out)  # refused before the work, not after
    samples = chdstat.open(store)
    settings = _given(estimators=estimator, seed=seed, max_batches=max_batches)
    found = chdstat.compare(
        samples,
        **settings,
        **_given(n=n, labels="classify" if patterns else None),
        progress=_progress(quiet),
    )
    errors = None
    if curve:
        model = next(iter(found.models.values()), None)
        errors = chdstat.error_curve(
            samples, **settings, **_given(model=model), progress=_progress(quiet)
        )
    if out is not None:
        save_comparison(found, out, curve=errors)
    if as_json:
        _print_json(found.to_dict() | ({} if errors is None else {"curve": errors.to_dict()}))
        return
    _print_rows(found.table(), _COMPARED, apart="uses_neighbours")
    if found.breakdown is not None:
        _print_rows(found.breakdown.table(), {"label": "pattern", "pixels": "pixels", **_COMPARED})
    if errors is not None:
        _print_rows(errors.table(), {"n": "N", **_COMPARED})


@app.command(epilog="Example: chdstat report bathroom -o report.pdf")
def report(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SCENE|STORE",
            help="Built-in name, Mitsuba XML file or finished store.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The PDF to write.")],
    spp: Spp = None,
    size: Size = None,
    seed: Seed = None,
    max_depth: Depth = None,
    backend: BackendName = "auto",
    define: Defines = None,
    recipe: Annotated[
        Path | None, typer.Option(help="Recipe with the regions to show.", show_default=False)
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option(help="Keep the samples here, and resume from them.", show_default=False),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Render, analyse, train, compare and typeset: a PDF on the sample distributions of a scene."""
    import chdstat

    is_store = (Path(source) / "zarr.json").is_file()
    path = chdstat.report(
        source if is_store else _scene(source, define),
        out,
        spp=spp,
        size=_size(size),
        seed=seed,
        max_depth=max_depth,
        recipe=recipe,
        store=store,
        backend=backend,
        progress=_progress(quiet),
    )
    typer.echo(f"wrote {path}")


@app.command(epilog="Example: chdstat doctor --json")
def doctor(
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Try again what was tried before.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Say what runs on this machine and why: Mitsuba backends, LLVM, torch, memory, versions."""
    from chdstat.doctor import examine

    found = examine(fresh=fresh)
    if as_json:
        _print_json(found)
    else:
        _print_table(found)


# --- arguments ----------------------------------------------------------------------------------


def _scene(name: str, define: list[str] | None) -> Any:
    from chdstat.scenes import load_scene

    return load_scene(name, **_pairs("-D", define))


def _thresholds(given: list[str] | None) -> Any:
    from dataclasses import fields

    from chdstat.patterns import Thresholds

    pairs = _pairs("--threshold", given)
    known = [field.name for field in fields(Thresholds)]
    for name, value in pairs.items():
        if name not in known:
            message = f"--threshold takes one of {', '.join(known)}, got {name!r}"
            raise InputError(message)
        try:
            float(value)
        except ValueError:
            message = f"--threshold {name} takes a number, got {value!r}"
            raise InputError(message) from None
    return Thresholds(**{name: float(value) for name, value in pairs.items()})


def _pairs(option: str, given: list[str] | None) -> dict[str, str]:
    pairs = {}
    for text in given or []:
        key, equals, value = text.partition("=")
        if not equals or not key:
            message = f"{option} takes KEY=VALUE, got {text!r}"
            raise InputError(message)
        pairs[key] = value
    return pairs


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, x, height = text.lower().partition("x")
    if not (x and width.isdecimal() and height.isdecimal()):
        message = f"--size takes WIDTHxHEIGHT such as 128x128, got {text!r}"
        raise InputError(message)
    return int(width), int(height)


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that were given: the library has the defaults."""
    return {name: value for name, value in options.items() if value is not None}


def _progress(quiet: bool) -> bool | None:
    return False if quiet else None


def _client(address: str | None) -> Any:
    """Return a context with a Dask client, or with None."""
    import contextlib

    if address is None:
        return contextlib.nullcontext()
    from distributed import Client

    try:
        return Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        message = f"cannot reach a Dask scheduler at {address}: {error}"
        raise InputError(message) from error


# --- output -------------------------------------------------------------------------------------


def _say_samples(samples: Any, as_json: bool) -> None:
    if as_json:
        _print_json({**samples.attrs, "path": str(samples.path), "spp": samples.spp})
    else:
        typer.echo(repr(samples))


def _print_json(content: dict[str, Any]) -> None:
    typer.echo(json.dumps(content, indent=2, allow_nan=False))


def _print_table(content: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in content.items():
        table.add_row(name.replace("_", " "), _readable(value))
    Console(highlight=False).print(table)


def _print_rows(
    rows: list[dict[str, Any]], columns: dict[str, str], *, apart: str | None = None
) -> None:
    """Print rows with the columns that they have; a line before the first that is `apart`."""
    from rich.console import Console
    from rich.table import Table

    shown = {key: title for key, title in columns.items() if key in rows[0]}
    table = Table(box=None, padding=(0, 2, 0, 0))
    for key, title in shown.items():
        side: Any = "left" if isinstance(rows[0][key], str) else "right"
        table.add_column(title, justify=side, no_wrap=True)
    before = False
    for row in rows:
        if apart is not None and row[apart] and not before:
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


def main() -> None:
    """Run the command line; errors that a user can act on end without a traceback."""
    logging.basicConfig(format="chdstat: %(message)s", level=logging.WARNING)
    try:
        app()
    except ChdstatError as error:
        if "--debug" in sys.argv:
            raise
        _fail(str(error), 1)
    except SystemExit as ended:
        if ended.code == _INTERRUPTED:  # what typer makes of Ctrl-C
            _fail("stopped; with a store, the same command resumes where it was", _INTERRUPTED)
        raise
    except MemoryError:
        _fail("out of memory; use a smaller --size or --spp, or keep samples in a store", 1)


def _fail(message: str, code: int) -> None:
    typer.echo(f"chdstat: {message}", err=True)
    sys.exit(code)
