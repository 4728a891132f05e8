"""Samples: the commands that render, import, export and describe them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from chdstat._core.files import is_remote, place_of
from chdstat.cli import output
from chdstat.cli import program as cli
from chdstat.errors import ChdstatError, InputError
from chdstat.rendering.backend import Color
from chdstat.rendering.seeds import SamplerName

__all__ = ["export", "import_samples", "include", "info", "render"]


@cli.app.command(
    epilog="Example: chdstat render bathroom -o bathroom.zarr --spp 512 --size 128x128"
)
def render(
    scene: cli.SceneName,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="PATH",
            parser=place_of,
            help="Store to write, resume or append to.",
        ),
    ],
    spp: Annotated[int, typer.Option("--spp", help="Number of samples per pixel.")] = cli.SPP,
    size: cli.Size = None,
    seed: cli.Seed = 0,
    max_depth: cli.Depth = None,
    sensor: Annotated[int, typer.Option(help="Number of the scene's sensor, from 0.")] = 0,
    integrator: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|JSON",
            help="Integrator in place of the scene's: its name, or JSON with its settings, such as "
            '{"type": "path", "rr_depth": 100}.',
            show_default="the scene's own",
        ),
    ] = None,
    crop: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,WxH",
            help="Part of the image to render, in pixels.",
            show_default="all of it",
        ),
    ] = None,
    color: Annotated[
        Color, typer.Option(help="What light is transported as; samples are linear sRGB.")
    ] = "rgb",
    sampler: Annotated[
        SamplerName,
        typer.Option(
            help="Mitsuba's sampler. Of all but independent, samples of a sequence depend on each "
            "other: only averages of sequences have standard errors."
        ),
    ] = "independent",
    sequence: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Samples that such a sampler spreads together, of which --spp is a multiple.",
            show_default="16",
        ),
    ] = None,
    direct: Annotated[
        bool, typer.Option("--direct", help="Also store the direct light of each sample.")
    ] = False,
    light: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Also store what each sample has by this light alone; a pattern such as 'lamp-*' "
            "is a group of them. Repeat it for several.",
            show_default="none",
        ),
    ] = None,
    by_depth: Annotated[
        int | None,
        typer.Option(
            metavar="SEGMENTS",
            help="Also store the light of each sample by the length of its path, up to this.",
            show_default="none",
        ),
    ] = None,
    summary_only: Annotated[
        bool,
        typer.Option(
            "--summary-only",
            help="Keep no samples: write maps of statistics, histograms and families instead.",
        ),
    ] = False,
    backend: cli.BackendName = "auto",
    define: cli.Defines = None,
    plugin: cli.Plugins = None,
    scheduler: cli.Scheduler = None,
    workers: cli.Workers = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Render a scene and keep every sample.

    A store that was stopped half-way is resumed; a larger --spp appends to it. With --summary-only,
    nothing is kept but maps, as 'analyze -o' writes them, of what needs no samples at once.
    """
    import chdstat
    from chdstat._core.files import unused
    from chdstat._core.work import client_of, kept_until_written
    from chdstat.analysis import save
    from chdstat.rendering import render_batches

    cli.load_plugins(plugin)
    if not is_remote(out) and not out.parent.exists():
        typer.echo(f"chdstat: making the folder {out.parent}", err=True)
    settings: dict[str, Any] = {
        "spp": spp,
        "size": cli.size_of(size),
        "seed": seed,
        "max_depth": max_depth,
        "sensor": sensor,
        "integrator": cli.integrator_of(integrator),
        "crop": cli.crop_of(crop),
        "color": color,
        "sampler": sampler,
        "sequence": sequence,
        "backend": backend,
    }
    described = cli.scene_of(scene, define)
    if summary_only:
        if direct or by_depth or light:
            message = "--summary-only keeps no samples, which --direct, --by-depth and --light need"
            raise InputError(message)
        unused(out)
        with client_of(scheduler, workers) as client, kept_until_written(out) as checkpoint:
            rendering = render_batches(described, progress=False, **settings)
            work: dict[str, Any] = {"client": client, "progress": not quiet}
            save(chdstat.analyze(rendering, checkpoint=checkpoint, **work), out)
        output.say_written(out, as_json=as_json)
        return
    with client_of(scheduler, workers) as client:
        samples = chdstat.render(
            described,
            direct=direct,
            by_depth=by_depth,
            by_light=light or (),
            out=out,
            client=client,
            progress=not quiet,
            **settings,
        )
    output.say_samples(samples, as_json=as_json, quiet=quiet)


def _feature(name: str) -> Any:
    what = f"First-hit {name}: a layer of the files, or a file of it."
    return typer.Option(metavar="NAME|FILE", help=what, show_default="none")


@cli.app.command(
    "import", epilog="Example: chdstat import frames/*.exr -o own.zarr --scene kitchen"
)
def import_samples(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="SOURCE...", help="Files of samples in their order, or a folder."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="PATH", parser=place_of, help="Store to write or append to."
        ),
    ],
    format: Annotated[  # noqa: A002 - what users call it
        str | None,
        typer.Option(metavar="NAME", help="Format.", show_default="by the names of the files"),
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="LETTERS",
            help="Order of the axes of arrays: y, x, c (channel) and s (sample), such as syxc.",
            show_default="yxcs, or by name",
        ),
    ] = None,
    variable: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Array or layer of the samples.",
            show_default="the largest; R, G, B",
        ),
    ] = None,
    albedo: Annotated[str | None, _feature("albedo")] = None,
    normal: Annotated[str | None, _feature("normal")] = None,
    depth: Annotated[str | None, _feature("depth")] = None,
    position: Annotated[str | None, _feature("position")] = None,
    counts: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Samples of each pixel, where they differ: .npy.",
            show_default="all of each",
        ),
    ] = None,
    averaged: Annotated[
        int | None,
        typer.Option(
            min=1, help="Samples that each value is the average of.", show_default="the files' own"
        ),
    ] = None,
    sequence: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Samples of a pixel that depend on each other, as stratified ones do.",
            show_default="none: independent",
        ),
    ] = None,
    scene: Annotated[
        str | None, typer.Option(help="Name of the scene.", show_default="that of the first file")
    ] = None,
    renderer: Annotated[
        str | None, typer.Option(help="What rendered it.", show_default="unknown")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed that it was rendered with.", show_default="unknown")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of radiance.", show_default="W sr-1 m-2")
    ] = None,
    append: Annotated[
        bool, typer.Option("--append", help="Add the samples to those of the store.")
    ] = False,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Write samples of another renderer to a store, which every command takes.

    An import that was stopped goes on when it is repeated.
    """
    import chdstat

    features = {"albedo": albedo, "normal": normal, "depth": depth, "position": position}
    about: dict[str, Any] = {
        "scene": scene,
        "renderer": renderer,
        "seed": seed,
        "unit": unit,
        "averaged": averaged,
        "sequence": sequence,
    }
    samples = chdstat.io.read(
        *sources,
        format=format,
        axes=axes,
        variable=variable,
        features={name: value for name, value in features.items() if value is not None},
        counts=counts,
        **{name: value for name, value in about.items() if value is not None},
    )
    saved = samples.save(out, append=append, progress=not quiet)
    output.say_samples(saved, as_json=as_json, quiet=quiet)


@cli.app.command(epilog="Example: chdstat include")
def include(as_json: cli.Json = False) -> None:
    """Print the folder of chdstat_writer.h, with which a C++ renderer writes its samples.

    A compiler is told it as -I$(chdstat include); 'chdstat import' reads what is written.
    """
    import chdstat

    folder = str(chdstat.io.get_include())
    if as_json:
        output.print_json({"include": folder})
    else:
        typer.echo(folder)


@cli.app.command(epilog="Example: chdstat export maps.zarr --as exr -o maps.exr")
def export(
    source: Annotated[
        Path,
        typer.Argument(metavar="MAPS", parser=place_of, help="What 'chdstat analyze -o' wrote."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    kind: Annotated[
        Literal["exr", "netcdf"],
        typer.Option("--as", help="Layers of an EXR file (.exr), or netCDF (.nc)."),
    ],
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Write maps in the formats of other programs."""
    import chdstat
    from chdstat.io.writing import open_maps

    write = chdstat.io.write_maps if kind == "exr" else chdstat.io.write_netcdf
    file = write(open_maps(source), out)
    if as_json:
        output.print_json({"files": [str(file)]})
    elif not quiet:
        output.say_written(file, as_json=False)


@cli.app.command(epilog="Example: chdstat info bathroom.zarr")
def info(
    store: cli.StorePath,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read everything and list damaged files.")
    ] = False,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Describe a store, and say whether it is complete and sound."""
    from chdstat.samples import inspect
    from chdstat.samples.samples import provenance

    found = inspect(store, verify=verify)
    if as_json:
        output.print_json(found)
    else:
        output.print_table({**provenance(found, [*found["shape"].values()]), **_state(found)})
    if found.get("damaged"):
        message = (
            f"{len(found['damaged'])} damaged file(s) in {store}, listed above; "
            "run the same 'chdstat render' again to repair them"
        )
        raise ChdstatError(message)
    if found["pending_chunks"]:
        output.say_next(quiet, "the same 'chdstat render' again, which resumes")
    else:
        output.say_next(quiet, *output.after_render(found, store))


def _state(found: Mapping[str, Any]) -> dict[str, str]:
    """Return what there is of a store, in words."""
    from chdstat._core.display import byte_size
    from chdstat.samples.samples import BIASED

    wanted, there = found["shape"]["sample"], found["complete_spp"]
    state = "complete"
    if found["pending_chunks"]:
        state = (
            f"stopped: every pixel has {there} of {wanted} samples, and "
            f"{found['pending_chunks']} chunks are missing"
        )
    files = "all there; --verify reads them, too"
    if "damaged" in found:
        files = "damaged: " + ", ".join(found["damaged"]) if found["damaged"] else "sound, all read"
    also = [", ".join(found["features"]) + " of the first hit"] if found["features"] else []
    if found["direct_spp"]:
        also.append(f"direct light of {found['direct_spp']} samples")
    if len(found["depths"]) > bool(found["direct_spp"]):
        also.append(f"light by length of path, up to {max(map(int, found['depths']))} segments")
    if found["lights"]:
        also.append(f"light from {', '.join(found['lights'])} alone")
    numbers = {}
    if found["counts"]:
        fewest, most = found["counts"]
        numbers["Samples"] = f"{fewest} to {most} in a pixel; {BIASED}"
    return {
        **numbers,
        "Also stored": ", ".join(also) or "nothing",
        "State": state,
        "Files": files,
        "On disk": byte_size(found["bytes"]),
        "Written by": f"chdstat {found['chdstat_version']}, schema {found['schema_version']}",
    }
