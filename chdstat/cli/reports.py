"""Reports: the commands that say or show what samples are like, and what there is here."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from chdstat.cli import output
from chdstat.cli.arguments import (
    OUTPUT,
    VIEW,
    CommonOptions,
    FromOne,
    OptionalWords,
    Place,
    ScenesOrStores,
    StorePath,
    Words,
    pairs_of,
    renders_beside,
)
from chdstat.cli.program import command
from chdstat.errors import InputError, check_option
from chdstat.rendering.seeds import SamplerName

if TYPE_CHECKING:
    from chdstat.patterns import Thresholds

_RECIPE_SIZE = "the recipe's, or 128 along the longer edge"


@command(
    "analyze bathroom.zarr -o bathroom-maps.zarr", "scheduler", "workers", "overwrite", *OUTPUT
)
def analyze(
    store: StorePath,
    asked: CommonOptions,
    out: Path | None = None,
    threshold: list[str] | None = None,
    resamples: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Describe the sample distributions of a store: nulls, families, tails, modes, averages.

    Parameters
    ----------
    out : path
        New zarr store for all maps.
    threshold : NAME=VALUE
        Threshold of a pattern, such as tail_index=0.3; can be repeated.
    resamples : int
        Bootstrap replicates of goodness of fit: minutes for an image.
    """
    import chdstat
    from chdstat._core.files import kept_until_written
    from chdstat.analysis import overview, save
    from chdstat.samples.dependence import check_distribution

    if out is not None:
        asked.target(out)  # refused before the work, not after
    thresholds, samples = _thresholds_of(threshold), chdstat.open(store)
    check_distribution(samples.spp)
    with asked.client() as client, kept_until_written(out) as checkpoint:
        dataset = chdstat.analyze(
            samples,
            thresholds=thresholds,
            resamples=resamples,
            progress=asked.progress,
            client=client,
            checkpoint=checkpoint,
        )
        if out is not None:
            save(dataset, asked.replaced(out))
    if asked.as_json:
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
    output.say_next(asked.quiet, ("explore", store), ("compare", store))


def _thresholds_of(given: list[str] | None) -> Thresholds:
    """Return thresholds of patterns from ``NAME=VALUE``."""
    from chdstat.patterns import Thresholds

    known = [field.name for field in fields(Thresholds)]
    values = {}
    for name, value in pairs_of("--threshold", given).items():
        check_option("--threshold", name, known)
        try:
            values[name] = float(value)
        except ValueError:
            message = f"--threshold {name} takes a number, got {value!r}"
            raise InputError(message) from None
    return Thresholds(**values)


@command(
    "report bathroom -o report.pdf",
    *("estimator", "iterations", *VIEW, "store", "overwrite", *OUTPUT),
    spp="the recipe's, or 512; all of a store",
    size=_RECIPE_SIZE,
    seed="the recipe's, or 0",
)
def report(
    sources: ScenesOrStores,
    out: Path,
    asked: CommonOptions,
    recipe: Path | None = None,
    full: bool = False,
    claims: bool = False,
) -> None:
    """Render, analyse, compare and typeset: a PDF on what is noisy in a scene, and what helps.

    Of several stores of one view, it says which is noisier, where in the image, and why.

    Parameters
    ----------
    out : path
        The PDF to write.
    recipe : path, default the scene's own
        Recipe with the regions to show.
    full : bool
        Add the case study, the claims of the paper, averages and trainings.
    claims : bool
        Only test the claims of the paper.
    """
    import chdstat
    from chdstat.reporting.documents import pages_of

    asked.target(out, ".pdf")
    if full and claims:
        message = "--full has the claims, too: give it or --claims"
        raise InputError(message)
    if len(sources) > 1 and (full or claims):
        message = f"{'--full' if full else '--claims'} is for a report on one render: leave it out"
        raise InputError(message)
    given = [asked.source(one) for one in sources]
    path = chdstat.report(
        given if len(given) > 1 else given[0],
        out,
        contents="full" if full else "claims" if claims else "short",
        recipe=recipe,
        store=asked.store,
        estimators=asked.estimator or None,
        iterations=asked.iterations,
        progress=asked.progress,
        **asked.settings,
    )
    output.say_written(path, as_json=asked.as_json, pages=pages_of(path))
    output.say_next(asked.quiet, ("explore", *([asked.store] if asked.store else sources)))


@command(
    "study bathroom fog -o study.pdf",
    *("estimator", "spp", "size", "seed", "max_depth", "backend", "plugin"),
    *("overwrite", *OUTPUT),
    spp="the recipe's, or 1024",
    size=_RECIPE_SIZE,
    seed="the recipe's, or 1",
)
def study(
    asked: CommonOptions,
    scenes: OptionalWords = None,
    out: Path | None = None,
    store: Path = Path("renders/out"),
    sampler: SamplerName = "independent",
    integrators: bool = False,
) -> None:
    """Test the claims of the paper on scenes: verdicts, figures, a PDF.

    Parameters
    ----------
    scenes : [NAME|PATH]...
        Built-in names, Mitsuba XML files, recipes (.toml) or finished stores; without any, all
        built-in scenes with a recipe.
    out : path
        The PDF to write.
    store : FOLDER
        Folder that keeps the stores, from which the study resumes.
    sampler : NAME
        Sampler of one more render of each scene, for the claim on correlated samples: stratified,
        multijitter, orthogonal, ldsampler; with independent, there is no such render.
    integrators : bool
        Render scenes by path guiding and adaptively, and built-in ones by five more integrators,
        too.
    """
    import chdstat
    from chdstat.reporting.documents import pages_of

    if out:
        asked.target(out, ".pdf")  # refused before the work, not after
    found = chdstat.study(
        scenes or None,
        folder=store,
        estimators=asked.estimator or None,
        sampler=sampler,
        integrators=integrators,
        progress=asked.progress,
        **asked.settings,
    )
    if asked.as_json:
        output.print_json(found.to_dict())
    else:
        rows = found.table()
        columns = {key: key for key in rows[0]} | {"number": ""}
        output.print_rows(rows, columns, text=["claim"])
    if out:
        found.save_pdf(out)
        typer.echo(f"wrote {out}, {pages_of(out)} pages", err=asked.as_json)
    first = found.scenes[0].name
    output.say_next(asked.quiet, ("report", first, "-o", f"{first}.pdf"))


@command(
    "paper -o paper.pdf",
    *("spp", "iterations", "backend", "overwrite", *OUTPUT),
    spp="2048, the paper's 2k",
    iterations="30,000, as in the paper; 3000 if quick",
)
def paper(
    asked: CommonOptions,
    out: Path,
    scenes: Place | None = None,
    only: list[str] | None = None,
    change: list[str] | None = None,
    quick: bool = False,
    edge: FromOne = None,
    store: Place | None = None,
) -> None:
    """Repeat the paper's experiment: every figure and table of it over its scenes, in a PDF.

    The network is as published unless a choice is changed; ours stands beside it. A stopped run
    goes on where it was.

    Parameters
    ----------
    out : path
        The PDF to write.
    scenes : FOLDER, default built-in remakes
        Folder with the paper's own scenes, bathroom and white-room, as the recipes of real-*.toml
        name their files.
    only : NAME, default all four
        Bathroom, WhiteRoom, NightRoom or MeasureOne; can be repeated.
    change : NAME, default none: as published
        Choice that is not the paper's: targets, pixels, validation, judging, patience or channels;
        can be repeated.
    quick : bool
        Small images and a tenth of the training: minutes in place of half an hour.
    edge : N, default 128, or 40 if quick
        Pixels along the longer edge; the paper's images have 800.
    store : FOLDER, default beside the PDF
        Folder that keeps renders and networks.
    """
    from chdstat.reporting.documents import pages_of
    from chdstat.studies import paper as repeated

    asked.target(out, ".pdf")  # refused before the work, not after
    found = repeated(
        store or renders_beside(out),
        scenes=scenes,
        only=only,
        quick=quick,
        changed=change or (),
        edge=edge,
        spp=asked.spp,
        iterations=asked.iterations,
        backend=asked.settings.get("backend", "auto"),
        progress=asked.progress,
    )
    found.save_pdf(out)
    if asked.as_json:
        output.print_json(found.to_dict())
    else:
        rows = found.to_dataframe().to_dict("records")
        output.print_rows(rows, {key: key for key in rows[0]}, text=["network"])
    typer.echo(f"wrote {out}, {pages_of(out)} pages", err=asked.as_json)
    output.say_next(asked.quiet, ("study", "bathroom", "-o", "bathroom.pdf"))


@command("explore path.zarr guided.zarr", "size", "seed", "max_depth", "define", "frame", "plugin")
def explore(
    sources: Words,
    asked: CommonOptions,
    model: list[Path] | None = None,
    maps: Path | None = None,
    port: int = 5006,
    browser: bool = True,
) -> None:
    """Show the distribution of any pixel on a page in the browser, served on localhost only.

    Parameters
    ----------
    sources : SCENE|STORE|EXR...
        Built-in name, scene file, store or EXR image; several are contrasted.
    model : path
        A trained estimator to show; can be repeated.
    maps : path
        Maps from 'chdstat analyze -o' to show.
    port : int
        Port to listen on; 0 takes a free one.
    browser : bool
        Open the page in the browser.
    """
    import chdstat

    explorer = chdstat.explore(
        [one if one.lower().endswith(".exr") else asked.source(one) for one in sources],
        models=model or (),
        maps=maps,
        port=port,
        browser=browser,
        **asked.settings,
    )
    typer.echo(f"{explorer.url} (Ctrl-C stops)")
    explorer.wait()


@command("list estimators", "as_json", name="list")
def list_names(
    asked: CommonOptions,
    kind: Annotated[
        Literal["scenes", "estimators", "families", "patterns", "formats"] | None,
        typer.Argument(),
    ] = None,
) -> None:
    """List scenes, estimators, families, patterns and formats to import, a sentence for each.

    Parameters
    ----------
    kind : str, default all five
        What to list.
    """
    from chdstat._core.display import capital
    from chdstat.estimators import lookup, names
    from chdstat.fit.families import FAMILIES
    from chdstat.io.reading import FORMATS
    from chdstat.patterns import PATTERNS
    from chdstat.scenes import BUILTIN

    formats = {f.name: f"{f.title}: {' '.join(f.suffixes)}." for f in FORMATS}
    families = {
        name: (family.__doc__ or "").partition("\n")[0] for name, family in FAMILIES.items()
    }
    found: dict[str, dict[str, str]] = {
        "scenes": BUILTIN,
        "estimators": {name: lookup(name).about for name in names()},
        "families": families,
        "patterns": {p.name: f"{capital(p.meaning)}." for p in PATTERNS},
        "formats": formats,
    }
    shown = found if kind is None else {kind: found[kind]}
    if asked.as_json:
        output.print_json(found if kind is None else found[kind])
        return
    for number, (title, rows) in enumerate(shown.items()):
        if kind is None:
            typer.echo("\n" * (number > 0) + f"{title}:")
        output.print_table(rows)
    output.say_next(
        False, ("render", "SCENE", "-o", "s.zarr"), ("compare", "s.zarr", "-e", "ESTIMATOR")
    )


@command("doctor", "as_json")
def doctor(asked: CommonOptions, fresh: bool = False) -> None:
    """Describe what works here: Mitsuba backends, other renderers, denoiser, memory, versions.

    Parameters
    ----------
    fresh : bool
        Ignore cached results and test the backends again.
    """
    from chdstat._core import denoiser
    from chdstat.recording.renderers import works
    from chdstat.rendering.backend import examine

    others = {"other_renderers": works(), "denoiser": denoiser.library()}
    found = examine(fresh=fresh) | others
    if asked.as_json:
        output.print_json(found)
    else:
        memory = found.pop("memory_gib")
        named = {name.replace("_", " "): value for name, value in found.items()}
        output.print_table(named | {"memory": None if memory is None else f"{memory} GiB"})
    output.say_next(False, ("render", "cornell-box", "-o", "box.zarr"))
