"""Reports: the commands that make a PDF, and that say what runs on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from chdstat.cli._app import app
from chdstat.cli._options import (
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
    is_store,
    progress_of,
    scene_of,
    size_of,
)
from chdstat.cli._output import print_json, print_table

__all__ = ["doctor", "report"]


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
        source if is_store(source) else scene_of(source, define),
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
        print_json(found)
    else:
        print_table(found)
