"""Reports: the commands that say or show what samples are like, and what there is here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from chdstat.cli import output
from chdstat.cli import program as cli
from chdstat.rendering.seeds import SamplerName

__all__ = ["analyze", "doctor", "explore", "list_names", "report", "study"]


@cli.app.command(epilog="Example: chdstat analyze bathroom.zarr -o bathroom-maps.zarr")
def analyze(
    store: cli.StorePath,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="New zarr store for all maps.", show_default="none"),
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
    scheduler: cli.Scheduler = None,
    workers: cli.Workers = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Describe the sample distributions of a store: nulls, families, tails, modes, averages."""
    import chdstat
    from chdstat._core.files import unused
    from chdstat._core.work import client_of, kept_until_written
    from chdstat.analysis import overview, save

    if out is not None:
        unused(out)  # refused before the work, not after
    thresholds, samples = cli.thresholds_of(threshold), chdstat.open(store)
    with client_of(scheduler, workers) as client, kept_until_written(out) as checkpoint:
        dataset = chdstat.analyze(
            samples,
            thresholds=thresholds,
            resamples=resamples,
            progress=not quiet,
            client=client,
            checkpoint=checkpoint,
        )
        if out is not None:
            save(dataset, out)
    if as_json:
        output.print_json(overview(dataset).to_dict())
    else:
        from chdstat.reporting.content import analysis_content

        found = analysis_content(samples, dataset)
        output.print_sentences(found["sentences"])
        typer.echo()
        output.print_sentences(found["findings"], bullet="- ")
        typer.echo()
        columns = {"name": "pattern", "share": "pixels", "meaning": "meaning"}
        output.print_rows(found["patterns"], columns, text=["meaning"])
        typer.echo()
        columns = {"name": "best family", "bic": "by BIC", "held_out": "by held-out likelihood"}
        output.print_rows(found["families"], columns)
    output.say_next(quiet, f"chdstat explore {store}", f"chdstat compare {store}")


@cli.app.command(epilog="Example: chdstat report bathroom -o report.pdf")
def report(
    source: cli.SceneOrStore,
    out: Annotated[Path, typer.Option("--out", "-o", help="The PDF to write.")],
    estimator: cli.Compared = None,
    iterations: cli.Iterations = None,
    spp: Annotated[
        int | None,
        typer.Option(
            "--spp",
            help="Number of samples per pixel; of a store, the first ones.",
            show_default="the recipe's, or 512; all of a store",
        ),
    ] = None,
    size: cli.RecipeSize = None,
    seed: Annotated[
        int | None,
        typer.Option(
            help="Random seed, a non-negative integer.", show_default="the recipe's, or 0"
        ),
    ] = None,
    max_depth: cli.Depth = None,
    backend: cli.BackendName = "auto",
    define: cli.Defines = None,
    plugin: cli.Plugins = None,
    recipe: Annotated[
        Path | None,
        typer.Option(help="Recipe with the regions to show.", show_default="the scene's own"),
    ] = None,
    store: cli.StoreKept = None,
    as_published: Annotated[
        bool,
        typer.Option(
            "--as-published",
            help="Render 800 x 800 pixels at 2000 spp and train as long as the paper did: hours.",
        ),
    ] = False,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Render, analyse, train, compare and typeset: a PDF on the sample distributions of a scene."""
    import chdstat
    from chdstat.reporting.typst import pages_of
    from chdstat.scenes import Scene

    cli.load_plugins(plugin)
    given = cli.source_of(source, define)
    if as_published and isinstance(given, Scene):
        from chdstat.reporting.scene_report import published_seconds

        hours = published_seconds(given, recipe, backend=backend) / 3600
        kept = store or out.with_suffix(".zarr")
        typer.echo(
            f"rendering as published takes about {hours:.1f} h here, the rest about as long; "
            f"samples are kept in {kept}, and the same command resumes",
            err=True,
        )
    path = chdstat.report(
        given,
        out,
        spp=spp,
        size=cli.size_of(size),
        seed=seed,
        max_depth=max_depth,
        recipe=recipe,
        store=store,
        estimators=estimator or None,
        iterations=iterations,
        as_published=as_published,
        backend=backend,
        progress=not quiet,
    )
    output.say_written(path, as_json=as_json, pages=pages_of(path))
    output.say_next(quiet, f"chdstat explore {store or source}")


@cli.app.command(epilog="Example: chdstat study bathroom fog -o study.pdf")
def study(
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME|PATH]...",
            help="Built-in names, Mitsuba XML files, recipes (.toml) or finished stores; "
            "all study scenes without any.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The PDF to write.", show_default="none")
    ] = None,
    store: Annotated[
        Path,
        typer.Option(metavar="FOLDER", help="Folder of stores that are kept, and resumed from."),
    ] = Path("renders/out"),
    spp: Annotated[
        int | None,
        typer.Option(help="Number of samples per pixel.", show_default="the recipe's, or 1024"),
    ] = None,
    size: cli.RecipeSize = None,
    seed: Annotated[
        int | None,
        typer.Option(
            help="Random seed, a non-negative integer.", show_default="the recipe's, or 1"
        ),
    ] = None,
    max_depth: cli.Depth = None,
    sampler: Annotated[
        SamplerName,
        typer.Option(
            help="Sampler of one more render of each scene, for the claim on correlated samples; "
            "of independent ones, there is none."
        ),
    ] = "independent",
    integrators: Annotated[
        bool,
        typer.Option("--integrators", help="Render built-in scenes by five more integrators, too."),
    ] = False,
    backend: cli.BackendName = "auto",
    estimator: cli.Compared = None,
    plugin: cli.Plugins = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Test the claims of the paper on scenes: verdicts, figures, a PDF."""
    import chdstat
    from chdstat._core.files import checked_target
    from chdstat.reporting.typst import pages_of

    cli.load_plugins(plugin)
    if out:
        checked_target(out, ".pdf")  # refused before the work, not after
    found = chdstat.study(
        scenes or None,
        folder=store,
        spp=spp,
        size=cli.size_of(size),
        seed=seed,
        max_depth=max_depth,
        estimators=estimator or None,
        sampler=sampler,
        integrators=integrators,
        backend=backend,
        progress=not quiet,
    )
    if as_json:
        output.print_json(found.to_dict())
    else:
        rows = found.table()
        columns = {key: key for key in rows[0]} | {"number": ""}
        output.print_rows(rows, columns, text=["claim"])
    if out:
        found.save_pdf(out)
        typer.echo(f"wrote {out}, {pages_of(out)} pages", err=as_json)
    first = found.scenes[0].name
    output.say_next(quiet, f"chdstat report {first} -o {first}.pdf")


@cli.app.command(epilog="Example: chdstat explore bathroom.zarr")
def explore(
    source: cli.SceneOrStore,
    other: Annotated[
        Path | None, typer.Option(help="A second store to compare with.", show_default="none")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Store that errors are measured against.", show_default="the source's own samples"
        ),
    ] = None,
    model: Annotated[
        list[Path] | None, typer.Option(help="A trained estimator to show; can be repeated.")
    ] = None,
    maps: Annotated[
        Path | None,
        typer.Option(help="Maps that 'chdstat analyze -o' wrote, to show.", show_default="none"),
    ] = None,
    port: Annotated[int, typer.Option(help="Port to listen on; 0 takes a free one.")] = 5006,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
    size: cli.Size = None,
    seed: cli.Seed = 0,
    max_depth: cli.Depth = None,
    define: cli.Defines = None,
    plugin: cli.Plugins = None,
) -> None:
    """Show the distribution of any pixel on a page in the browser, served on localhost only."""
    import chdstat

    cli.load_plugins(plugin)
    explorer = chdstat.explore(
        cli.source_of(source, define),
        other=other,
        reference=reference,
        models=model or (),
        maps=maps,
        port=port,
        browser=browser,
        size=cli.size_of(size),
        seed=seed,
        max_depth=max_depth,
    )
    typer.echo(f"{explorer.url} (Ctrl-C stops)")
    explorer.wait()


@cli.app.command("list", epilog="Example: chdstat list estimators")
def list_names(
    kind: Annotated[
        Literal["scenes", "estimators", "families", "patterns", "formats"] | None,
        typer.Argument(help="What to list.", show_default="all five"),
    ] = None,
    as_json: cli.Json = False,
) -> None:
    """List scenes, estimators, families, patterns and formats to import, a sentence for each."""
    from chdstat.estimators import lookup, names
    from chdstat.fit.families import FAMILIES
    from chdstat.io.reading import FORMATS
    from chdstat.patterns import PATTERNS
    from chdstat.scenes import BUILTIN

    formats = {f.name: f"{f.title}: {' '.join(f.suffixes)}." for f in FORMATS}
    families = {
        name: (family.documentation or "").partition("\n")[0] for name, family in FAMILIES.items()
    }
    found: dict[str, dict[str, str]] = {
        "scenes": BUILTIN,
        "estimators": {name: lookup(name).about for name in names()},
        "families": families,
        "patterns": {p.name: f"{p.meaning[0].upper()}{p.meaning[1:]}." for p in PATTERNS},
        "formats": formats,
    }
    shown = found if kind is None else {kind: found[kind]}
    if as_json:
        output.print_json(found if kind is None else found[kind])
        return
    for number, (title, rows) in enumerate(shown.items()):
        if kind is None:
            typer.echo("\n" * (number > 0) + f"{title}:")
        output.print_table(rows)
    output.say_next(False, "chdstat render SCENE -o s.zarr", "chdstat compare s.zarr -e ESTIMATOR")


@cli.app.command(epilog="Example: chdstat doctor")
def doctor(
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Ignore cached results and test the backends again.")
    ] = False,
    as_json: cli.Json = False,
) -> None:
    """Describe what works here: Mitsuba backends, LLVM, torch, denoiser, memory, versions."""
    from chdstat.io import denoiser
    from chdstat.rendering.backend import examine

    found = examine(fresh=fresh) | {"denoiser": denoiser.library()}
    if as_json:
        output.print_json(found)
    else:
        memory = found.pop("memory_gib")
        named = {name.replace("_", " "): value for name, value in found.items()}
        output.print_table(named | {"memory": None if memory is None else f"{memory} GiB"})
    output.say_next(False, "chdstat render cornell-box -o box.zarr")
