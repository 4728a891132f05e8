"""Samples: the commands that render, describe, convert and analyse them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from chdstat.cli import program as cli
from chdstat.errors import ChdstatError

__all__ = ["analyze", "convert", "info", "render"]


@cli.app.command(
    epilog="Example: chdstat render bathroom -o bathroom.zarr --spp 512 --size 128x128"
)
def render(
    scene: cli.SceneName,
    out: Annotated[Path, typer.Option("--out", "-o", help="Store to write, resume or append to.")],
    spp: Annotated[int, typer.Option("--spp", help="Number of samples per pixel.")] = cli.SPP,
    size: cli.Size = None,
    seed: cli.Seed = 0,
    max_depth: cli.Depth = None,
    sensor: Annotated[int, typer.Option(help="Number of the scene's sensor, from 0.")] = 0,
    direct: Annotated[
        bool, typer.Option("--direct", help="Also store the direct light of each sample.")
    ] = False,
    backend: cli.BackendName = "auto",
    define: cli.Defines = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers render.")
    ] = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Render a scene and keep every sample.

    A store that was stopped half-way is resumed; a larger --spp appends to it.
    """
    import chdstat

    with cli.client_of(scheduler) as client:
        samples = chdstat.render(
            cli.scene_of(scene, define),
            spp=spp,
            size=cli.size_of(size),
            seed=seed,
            max_depth=max_depth,
            sensor=sensor,
            direct=direct,
            out=out,
            backend=backend,
            client=client,
            progress=cli.progress_of(quiet),
        )
    cli.say_samples(samples, as_json)


@cli.app.command(epilog="Example: chdstat info bathroom.zarr --json")
def info(
    store: cli.StorePath,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read everything and list damaged files.")
    ] = False,
    as_json: cli.Json = False,
) -> None:
    """Describe a store, and say whether it is complete and sound."""
    from chdstat.samples import inspect

    found = inspect(store, verify=verify)
    if as_json:
        cli.print_json(found)
    else:
        cli.print_table(found | {"scene_files": len(found.get("scene_files", ()))})
    if found.get("damaged"):
        message = (
            f"{len(found['damaged'])} damaged file(s) in {store}, listed above; "
            "run the same 'chdstat render' again to repair them"
        )
        raise ChdstatError(message)


@cli.app.command(epilog="Example: chdstat convert old.zarr -o new.zarr --scene bathroom")
def convert(
    store: cli.StorePath,
    out: Annotated[Path, typer.Option("--out", "-o", help="New store to write.")],
    scene: Annotated[
        str | None,
        typer.Option(
            "--scene",
            help="Scene of the samples, needed to append if it was an XML file: some samples "
            "are rendered again, and must be the same.",
        ),
    ] = None,
    define: cli.Defines = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Write the samples of a store of an earlier schema into a new one, which can be appended to.

    The old store stays as it is.
    """
    from chdstat.rendering.conversion import convert as converted

    of = None if scene is None else cli.scene_of(scene, define)
    samples = converted(store, out, scene=of, progress=cli.progress_of(quiet))
    cli.say_samples(samples, as_json)


@cli.app.command(epilog="Example: chdstat analyze bathroom.zarr -o bathroom-maps.zarr")
def analyze(
    store: cli.StorePath,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="New zarr store to write all maps to.")
    ] = None,
    threshold: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Threshold of a pattern, such as tail_index=0.3; can be repeated.",
        ),
    ] = None,
    resamples: Annotated[
        int,
        typer.Option(min=0, help="Bootstrap replicates of goodness of fit: minutes for an image."),
    ] = 0,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Describe the sample distributions of a store: nulls, families, tails, modes, averages."""
    import chdstat
    from chdstat._core.files import unused
    from chdstat.analysis import overview, save

    if out is not None:
        unused(out)  # refused before the work, not after
    thresholds = cli.thresholds_of(threshold)
    dataset = chdstat.analyze(
        chdstat.open(store),
        thresholds=thresholds,
        resamples=resamples,
        progress=cli.progress_of(quiet),
    )
    if out is not None:
        save(dataset, out)
    numbers = overview(dataset).to_dict()
    if as_json:
        cli.print_json(numbers)
    else:
        cli.print_table(numbers)
