"""Sampling: the commands that render, import, export and describe samples."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from chdstat._core.display import percent
from chdstat._core.files import is_remote
from chdstat.cli import output
from chdstat.cli.arguments import (
    OUTPUT,
    VIEW,
    CommonOptions,
    FromOne,
    Location,
    Place,
    SceneName,
    StorePath,
    Words,
)
from chdstat.cli.program import command
from chdstat.errors import ChdstatError, InputError, StoreError
from chdstat.rendering.jobs import SETTINGS

_NOT_REACHED = 3
"""Exit code of a render whose error is larger than what was asked for."""


@command(
    "render bathroom -o bathroom.zarr --spp 512 --size 128x128",
    *dict.fromkeys((*VIEW, *SETTINGS)),
    *("error", "scheduler", "workers", "overwrite"),
    *OUTPUT,
    spp="256",
    error="--spp samples",
)
def render(
    scene: SceneName,
    out: Place,
    asked: CommonOptions,
    direct: bool = False,
    light: list[str] | None = None,
    by_depth: int | None = None,
    film: bool = False,
    cost: bool = False,
    adaptive: bool = False,
    percentile: float | None = None,
    time: float | None = None,
    summary_only: bool = False,
) -> None:
    """Render a scene and keep every sample.

    A store that was stopped half-way is resumed; a larger --spp appends to it. With --summary-only,
    no samples are kept: PATH gets maps of statistics, histograms and families, as of 'analyze -o'.
    The exit code is 3 if the --error was not reached, and 2 if nothing could be rendered.

    Parameters
    ----------
    out : PATH
        Store to write, resume or append to.
    direct : bool
        Also store the direct light of each sample.
    light : NAME
        Also store the part of each sample from this light; a pattern such as 'lamp-*' is a group of
        lights. Can be repeated.
    by_depth : SEGMENTS
        Also store the light of each sample by the length of its path, up to this.
    film : bool
        Also store where in its pixel each sample fell.
    cost : bool
        Also store how long samples of each pixel take, with --backend scalar.
    adaptive : bool
        Draw samples where they are needed. --spp is their mean number; a quarter of them measures
        how noisy the image is. --error does so, too, with --spp as the most.
    percentile : PERCENT
        Reach the --error in this percentage of the pixels, such as 95, not in the image.
    time : SECONDS, default all samples
        Stop after this time, once every pixel has samples; --spp is then the most.
    summary_only : bool
        Keep no samples: write maps of statistics, histograms and families instead.
    """
    import chdstat
    from chdstat._core.files import kept_until_written
    from chdstat.analysis import save
    from chdstat.rendering import render_batches

    if not is_remote(out) and not out.parent.exists():
        typer.echo(f"chdstat: making the folder {out.parent}", err=True)
    described = asked.scene(scene)
    if summary_only:
        decided = asked.error, percentile, time
        of_samples = direct, by_depth, light, film, cost, adaptive
        if any(of_samples) or decided != (None, None, None):
            message = (
                "--summary-only keeps no samples, which --direct, --by-depth, --light, --film, "
                "--cost, --adaptive, --error and --time need"
            )
            raise InputError(message)
        asked.target(out)
        with asked.client() as client, kept_until_written(out) as checkpoint:
            rendering = render_batches(described, progress=False, **asked.settings)
            work: dict[str, Any] = {"client": client, "progress": asked.progress}
            maps = chdstat.analyze(rendering, checkpoint=checkpoint, **work)
            save(maps, asked.replaced(out))
        output.say_written(out, as_json=asked.as_json)
        return
    if asked.overwrite:
        message = "--overwrite is for --summary-only: a store of samples is resumed or appended to"
        raise InputError(message)
    with asked.client() as client:
        samples = chdstat.render(
            described,
            direct=direct,
            by_depth=by_depth,
            by_light=light or (),
            film=film,
            cost=cost,
            adaptive=adaptive,
            error=asked.error,
            percentile=percentile,
            seconds=time,
            out=out,
            client=client,
            progress=asked.progress,
            **asked.settings,
        )
    output.say_samples(samples, as_json=asked.as_json, quiet=asked.quiet)
    if not samples.attrs.get("error", {}).get("reached", True):
        raise typer.Exit(_NOT_REACHED)


@command("import frames/*.exr -o own.zarr --scene kitchen", *OUTPUT, name="import")
def import_samples(
    sources: Words,
    out: Place,
    asked: CommonOptions,
    format: str | None = None,  # noqa: A002 - what users call it
    axes: str | None = None,
    variable: str | None = None,
    albedo: str | None = None,
    normal: str | None = None,
    depth: str | None = None,
    position: str | None = None,
    counts: Path | None = None,
    averaged: FromOne = None,
    sequence: FromOne = None,
    scene: str | None = None,
    renderer: str | None = None,
    seed: int | None = None,
    unit: str | None = None,
    append: bool = False,
) -> None:
    """Write samples of another renderer to a store, which every command takes.

    An import that was stopped goes on when it is repeated.

    Parameters
    ----------
    sources : SOURCE...
        Files of samples in their order, or a folder.
    out : PATH
        Store to write or append to.
    format : NAME, default by the names of the files
        Format, one that 'chdstat list formats' names.
    axes : LETTERS, default yxcs, or by name
        Order of the axes of arrays: y, x, c (channel) and s (sample), such as syxc.
    variable : NAME, default the largest; R, G, B
        Array (GROUP/NAME) or layer of samples.
    albedo : NAME|FILE
        First-hit albedo: a layer of the files, or a file of it.
    normal : NAME|FILE
        First-hit normal: a layer of the files, or a file of it.
    depth : NAME|FILE
        First-hit depth: a layer of the files, or a file of it.
    position : NAME|FILE
        First-hit position: a layer of the files, or a file of it.
    counts : FILE, default all of each
        Samples of each pixel, where they differ: .npy.
    averaged : int, default the files' own
        Number of samples that each value averages.
    sequence : N, default none: independent
        Number of samples of a pixel that depend on each other, as stratified ones do.
    scene : str, default the files', or OUT's of several files
        Name of the scene.
    renderer : str, default unknown
        Name of the renderer.
    seed : int, default unknown
        Seed of the render.
    unit : str, default W sr-1 m-2
        Unit of radiance.
    append : bool
        Add the samples to those of the store.
    """
    import chdstat

    samples = chdstat.io.read(
        *sources,
        format=format,
        axes=axes,
        variable=variable,
        features=_given(albedo=albedo, normal=normal, depth=depth, position=position),
        counts=counts,
        **_given(
            scene=scene, renderer=renderer, seed=seed, unit=unit, averaged=averaged,
            sequence=sequence,
        ),
    )  # fmt: skip
    about = samples.attrs
    if about["files"] > 1 and scene is None and samples.name == Path(about["scene_source"]).stem:
        # One of many frames is no name for all of them.
        samples = chdstat.Samples(
            samples.source or samples.read(),
            attrs=about | {"scene": out.stem},
            features=samples.features,
            counts=samples.counts,
        )
    saved = samples.save(out, append=append, progress=asked.progress)
    output.say_samples(saved, as_json=asked.as_json, quiet=asked.quiet)


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that were given."""
    return {name: value for name, value in options.items() if value is not None}


@command("include", "as_json")
def include(asked: CommonOptions) -> None:
    """Print the folder of chdstat_writer.h, with which a C++ renderer writes its samples.

    Compile with -I$(chdstat include); 'chdstat import' reads what the renderer writes.
    """
    import chdstat

    folder = str(chdstat.io.get_include())
    if asked.as_json:
        output.print_json({"include": folder})
    else:
        typer.echo(folder)


@command("export bathroom.zarr -o bathroom.exr", "overwrite", *OUTPUT)
def export(source: Location, out: Path, asked: CommonOptions) -> None:
    """Write maps in the formats of other programs, or a store as a reference for tests.

    A reference is an EXR file that shows the mean, and holds what 'chdstat contrast' needs of the
    samples: means of 48 batches. It has a hundredth of the size of the store.

    Parameters
    ----------
    source : MAPS|STORE
        What 'chdstat analyze -o' wrote, or a finished store.
    out : path
        Layers of an EXR file (.exr); of maps, or netCDF (.nc).
    """
    import chdstat
    from chdstat.io.writing import open_maps
    from chdstat.samples import is_store

    target = asked.target(out, ".exr", ".nc")
    exr = target.suffix.lower() == ".exr"
    try:
        maps = open_maps(source)
    except StoreError as error:
        if not is_store(source):
            message = f"{error}, or a finished store"
            raise StoreError(message) from error
        _export_reference(source, asked.target(out, ".exr"), asked)
        return
    file = (chdstat.io.write_maps if exr else chdstat.io.write_netcdf)(maps, target)
    output.say_written(file, as_json=asked.as_json)


def _export_reference(store: Path, target: Path, asked: CommonOptions) -> None:
    """Write what tests need of the samples of a store."""
    import chdstat

    reference = chdstat.inference.Reference.of_samples(store)
    file = chdstat.io.write_reference(reference, target)
    about = {"spp": reference.spp, "kB": round(file.stat().st_size / 1000)}
    output.say_written(file, as_json=asked.as_json, **about)
    output.say_next(asked.quiet, ("contrast", "RENDER.zarr", file))


@command("info bathroom.zarr", *OUTPUT)
def info(store: StorePath, asked: CommonOptions, verify: bool = False) -> None:
    """Describe a store, and say whether it is complete and sound.

    Of a reference, an EXR or PFM file, it says what is known and what no test with it can show.

    Parameters
    ----------
    verify : bool
        Read everything and list damaged files.
    """
    from chdstat.inference.references import IMAGES
    from chdstat.samples import inspect
    from chdstat.samples.samples import provenance

    if store.suffix.lower() in IMAGES:
        _describe_reference(store, asked)
        return
    found = inspect(store, verify=verify)
    if asked.as_json:
        output.print_json(found)
    else:
        output.print_table({**provenance(found, [*found["shape"].values()]), **_state(found)})
    if found.get("damaged"):
        message = (
            f"{len(found['damaged'])} damaged file(s) in {store}, listed above; "
            "run the same 'chdstat render' or import again to repair them"
        )
        raise ChdstatError(message)
    if not found["pending_chunks"]:
        output.say_next(asked.quiet, *output.after_render(found, store))


def _describe_reference(path: Path, asked: CommonOptions) -> None:
    """Print what a reference holds, and what it cannot show."""
    from chdstat.inference import Reference

    found = Reference.read(path)
    height, width, channels = found.shape
    noise = {
        "exact": "unknown",
        "spp": "unknown, but for its spp",
        "variance": "by variances of a sample",
        "batches": f"by means of {0 if found.batches is None else found.batches.shape[-1]} batches",
    }
    about = {
        "size": f"{width} x {height} pixels, {channels} channels",
        "spp": found.spp,
        "noise": noise[found.known],
        "bad samples": None if found.bad is None else percent(float(found.bad.mean())),
        **found.attrs,
        "cannot show": list(found.cannot_show),
    }
    if asked.as_json:
        output.print_json(about)
    else:
        output.print_table(about | {"cannot show": " ".join(found.cannot_show) or "nothing known"})
        output.say_next(asked.quiet, ("contrast", "RENDER.zarr", path))


def _state(found: Mapping[str, Any]) -> dict[str, str]:
    """Return what there is of a store, in words."""
    from chdstat._core.display import byte_size
    from chdstat.samples.samples import different_counts

    wanted, there = found["shape"]["sample"], found["complete_spp"]
    state = "complete"
    if found["pending_chunks"]:
        state = (
            f"stopped: every pixel has {there} of {wanted} samples, and "
            f"{found['pending_chunks']} chunks are missing; the same 'chdstat render' or import "
            "resumes"
        )
    files = "all there; --verify reads them, too"
    if "damaged" in found:
        files = "damaged: " + ", ".join(found["damaged"]) if found["damaged"] else "sound, all read"
    has_depths = len(found["depths"]) > bool(found["direct_spp"])
    also = {
        "{} of the first hit": ", ".join(found["features"]),
        "direct light of {} samples": found["direct_spp"],
        "light by length of path, up to {} segments": has_depths and max(map(int, found["depths"])),
        "light from {} alone": ", ".join(found["lights"]),
        "where {} samples fell": found["film_spp"],
        "what samples take": found["costs"],
    }
    stored = [text.format(value) for text, value in also.items() if value]
    numbers = {}
    if found["counts"]:
        numbers["Samples"] = different_counts(found, "{} to {}".format(*found["counts"]))
    return {
        **numbers,
        "Also stored": ", ".join(stored) or "nothing",
        "State": state,
        "Files": files,
        "On disk": byte_size(found["bytes"]),
        "Written by": f"chdstat {found['chdstat_version']}, schema {found['schema_version']}",
    }
