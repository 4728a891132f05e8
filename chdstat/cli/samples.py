"""Samples: the commands that render, describe, convert and analyse them."""

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
    SceneName,
    Scheduler,
    Seed,
    Size,
    Spp,
    StorePath,
    client_of,
    given,
    progress_of,
    scene_of,
    size_of,
    thresholds_of,
)
from chdstat.cli.program import app, print_json, print_table, say_samples
from chdstat.errors import ChdstatError

__all__ = ["analyze", "convert", "info", "render"]


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
    sensor: Annotated[
        int, typer.Option("--sensor", help="Which sensor of the scene, counted from 0.")
    ] = 0,
    direct: Annotated[
        bool, typer.Option("--direct", help="Keep the direct light of each sample apart, too.")
    ] = False,
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

    with client_of(scheduler) as client:
        samples = chdstat.render(
            scene_of(scene, define),
            out=out,
            client=client,
            direct=direct,
            sensor=sensor,
            progress=progress_of(quiet),
            **given(spp=spp, size=size_of(size), seed=seed, max_depth=max_depth, backend=backend),
        )
    say_samples(samples, as_json)


@app.command(epilog="Example: chdstat info bathroom.zarr --json")
def info(
    store: StorePath,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Read everything, and list the files that are damaged."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Say what a store holds, and whether it is complete and sound."""
    from chdstat.samples import inspect

    found = inspect(store, verify=verify)
    if as_json:
        print_json(found)
    else:
        print_table(found | {"scene_files": len(found.get("scene_files", ()))})
    if found.get("damaged"):
        message = (
            f"{len(found['damaged'])} damaged file(s) in {store}, listed above; "
            "run the same 'chdstat render' again to repair them"
        )
        raise ChdstatError(message)


@app.command(epilog="Example: chdstat convert old.zarr -o new.zarr --scene bathroom")
def convert(
    store: StorePath,
    out: Annotated[Path, typer.Option("--out", "-o", help="New store to write.")],
    scene: Annotated[
        str | None,
        typer.Option(
            "--scene",
            help="What it was rendered of, needed to append if that was an XML file: some samples "
            "of it are rendered again, and must be the same.",
        ),
    ] = None,
    define: Defines = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write the samples of a store of an earlier schema into a new one, which can be appended to.

    The old store stays as it is.
    """
    from chdstat.rendering.conversion import convert as converted

    of = None if scene is None else scene_of(scene, define)
    say_samples(converted(store, out, scene=of, progress=progress_of(quiet)), as_json)


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
    from chdstat._core.files import unused
    from chdstat.analysis import overview, save

    if out is not None:
        unused(out)  # refused before the work, not after
    thresholds = thresholds_of(threshold)
    dataset = chdstat.analyze(
        chdstat.open(store),
        thresholds=thresholds,
        resamples=resamples,
        progress=progress_of(quiet),
    )
    if out is not None:
        save(dataset, out)
    numbers = overview(dataset).to_dict()
    if as_json:
        print_json(numbers)
    else:
        print_table(numbers)
