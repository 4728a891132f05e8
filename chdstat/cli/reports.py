"""Reports: the commands that make a PDF or a page, and describe what works on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from chdstat.cli import program as cli

__all__ = ["doctor", "explore", "report", "study"]


@cli.app.command(epilog="Example: chdstat report bathroom -o report.pdf")
def report(
    source: cli.SceneOrStore,
    out: Annotated[Path, typer.Option("--out", "-o", help="The PDF to write.")],
    spp: cli.Spp = None,
    size: cli.Size = None,
    seed: cli.SeedOrNone = None,
    max_depth: cli.Depth = None,
    backend: cli.BackendName = "auto",
    define: cli.Defines = None,
    recipe: Annotated[Path | None, typer.Option(help="Recipe with the regions to show.")] = None,
    store: cli.StoreKept = None,
    quiet: cli.Quiet = False,
) -> None:
    """Render, analyse, train, compare and typeset: a PDF on the sample distributions of a scene."""
    import chdstat

    path = chdstat.report(
        cli.source_of(source, define),
        out,
        spp=spp,
        size=cli.size_of(size),
        seed=seed,
        max_depth=max_depth,
        recipe=recipe,
        store=store,
        backend=backend,
        progress=cli.progress_of(quiet),
    )
    typer.echo(f"wrote {path}")


@cli.app.command(epilog="Example: chdstat study bathroom fog -o study.pdf --json findings.json")
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
    spp: cli.Spp = None,
    size: cli.Size = None,
    seed: cli.SeedOrNone = None,
    max_depth: cli.Depth = None,
    backend: cli.BackendName = "auto",
    estimator: Annotated[
        list[str],
        typer.Option(
            "-e",
            "--estimator",
            metavar="NAME",
            help="An estimator to compare, trained on each scene if it learns; can be repeated.",
        ),
    ] = ["mean", "elek2019"],  # noqa: B006 - Typer takes lists
    quiet: cli.Quiet = False,
) -> None:
    """Test the claims of the paper on scenes: verdicts, figures, a PDF."""
    import chdstat
    from chdstat._core.files import checked_target

    for path, suffix in ((out, ".pdf"), (json_out, ".json")):
        if path:
            checked_target(path, suffix)
    found = chdstat.study(
        scenes or None,
        folder=folder,
        spp=spp,
        size=cli.size_of(size),
        seed=seed,
        max_depth=max_depth,
        estimators=estimator,
        backend=backend,
        progress=cli.progress_of(quiet),
    )
    rows = found.table()
    cli.print_rows(rows, {key: key for key in rows[0]})
    if json_out:
        found.save_json(json_out)
    if out:
        found.save_pdf(out)


@cli.app.command(epilog="Example: chdstat explore bathroom.zarr")
def explore(
    source: cli.SceneOrStore,
    other: Annotated[Path | None, typer.Option(help="A second store to compare with.")] = None,
    reference: Annotated[
        Path | None, typer.Option(help="Store that errors are measured against.")
    ] = None,
    model: Annotated[
        list[Path] | None, typer.Option(help="A trained estimator to show; can be repeated.")
    ] = None,
    port: Annotated[int, typer.Option(help="Port to listen on; 0 takes a free one.")] = 5006,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
    size: cli.Size = None,
    seed: cli.Seed = 0,
    max_depth: cli.Depth = None,
    define: cli.Defines = None,
) -> None:
    """Serve a page that shows the distribution of any pixel, to this machine alone."""
    import chdstat

    explorer = chdstat.explore(
        cli.source_of(source, define),
        other=other,
        reference=reference,
        models=model or (),
        port=port,
        browser=browser,
        size=cli.size_of(size),
        seed=seed,
        max_depth=max_depth,
    )
    typer.echo(f"{explorer.url} (Ctrl-C stops)")
    explorer.wait()


@cli.app.command(epilog="Example: chdstat doctor --json")
def doctor(
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Test again what was tested before.")
    ] = False,
    as_json: cli.Json = False,
) -> None:
    """Describe what works on this machine: Mitsuba backends, LLVM, torch, memory, versions."""
    from chdstat.rendering.backend import examine

    found = examine(fresh=fresh)
    if as_json:
        cli.print_json(found)
    else:
        cli.print_table(found)
