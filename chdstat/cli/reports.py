"""Reports: the commands that make a PDF, and that say what runs on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from chdstat.cli.options import (
    BackendName,
    Defines,
    Depth,
    Json,
    Quiet,
    SceneOrStore,
    Seed,
    Size,
    Spp,
    StoreKept,
    given,
    progress_of,
    size_of,
    source_of,
)
from chdstat.cli.program import app, print_json, print_rows, print_table

__all__ = ["doctor", "explore", "report", "study"]


@app.command(epilog="Example: chdstat report bathroom -o report.pdf")
def report(
    source: SceneOrStore,
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
    store: StoreKept = None,
    quiet: Quiet = False,
) -> None:
    """Render, analyse, train, compare and typeset: a PDF on the sample distributions of a scene."""
    import chdstat

    path = chdstat.report(
        source_of(source, define),
        out,
        spp=spp,
        size=size_of(size),
        seed=seed,
        max_depth=max_depth,
        recipe=recipe,
        store=store,
        backend=backend,
        progress=progress_of(quiet),
    )
    typer.echo(f"wrote {path}")


@app.command(epilog="Example: chdstat study bathroom fog -o study.pdf --json findings.json")
def study(
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME|PATH]...",
            help="Built-in names, Mitsuba XML files, recipes (.toml) or finished stores; "
            "all study scenes without any.",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The PDF to write.")] = None,
    json_out: Annotated[Path | None, typer.Option("--json", help="The JSON to write.")] = None,
    folder: Annotated[Path, typer.Option(help="Where renders are kept.")] = Path("renders/out"),
    spp: Spp = None,
    size: Size = None,
    seed: Seed = None,
    max_depth: Depth = None,
    backend: BackendName = "auto",
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            "--estimator",
            "-e",
            metavar="NAME",
            help="What to compare; repeat for more. Those that learn are trained on each scene.",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Ask scenes for the claims of the paper: verdicts, figures, a PDF."""
    import chdstat
    from chdstat._core.files import checked_target

    for path, suffix in ((out, ".pdf"), (json_out, ".json")):
        if path:
            checked_target(path, suffix)
    found = chdstat.study(
        scenes or None,
        folder=folder,
        spp=spp,
        size=size_of(size),
        seed=seed,
        max_depth=max_depth,
        backend=backend,
        progress=progress_of(quiet),
        **given(estimators=estimator),
    )
    rows = found.table()
    print_rows(rows, {key: key for key in rows[0]})
    if json_out:
        found.save_json(json_out)
    if out:
        found.save_pdf(out)


@app.command(epilog="Example: chdstat explore bathroom.zarr")
def explore(
    source: SceneOrStore,
    other: Annotated[
        Path | None, typer.Option(help="A second store to compare with.", show_default=False)
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(help="Store that errors are measured against.", show_default=False),
    ] = None,
    model: Annotated[
        list[Path] | None,
        typer.Option(help="A trained estimator to show; repeat for more.", show_default=False),
    ] = None,
    port: Annotated[int, typer.Option(help="Where to listen; 0 takes a free port.")] = 5006,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
    size: Size = None,
    seed: Seed = None,
    max_depth: Depth = None,
    define: Defines = None,
) -> None:
    """Serve a page on which a click on a pixel shows its distribution, to this machine alone."""
    import chdstat

    explorer = chdstat.explore(
        source_of(source, define),
        other=other,
        reference=reference,
        models=model or (),
        port=port,
        browser=browser,
        **given(seed=seed, size=size_of(size), max_depth=max_depth),
    )
    typer.echo(f"{explorer.url} (Ctrl-C stops)")
    explorer.wait()


@app.command(epilog="Example: chdstat doctor --json")
def doctor(
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Try again what was tried before.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Say what runs on this machine and why: Mitsuba backends, LLVM, torch, memory, versions."""
    from chdstat.rendering.backend import examine

    found = examine(fresh=fresh)
    if as_json:
        print_json(found)
    else:
        print_table(found)
