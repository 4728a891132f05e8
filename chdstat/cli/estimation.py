"""Estimation: the commands that train, estimate and compare estimators, or renders."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from chdstat._core.files import place_of
from chdstat.cli import output
from chdstat.cli import program as cli
from chdstat.errors import InputError

if TYPE_CHECKING:
    from chdstat.comparison import Comparison, ErrorCurve

__all__ = ["bench", "compare", "contrast", "estimate", "train"]

_ENDLESS = 2**20
"""Samples of a pixel of a render that time or an error stops."""
_COMPARED = {
    "estimator": "estimator",
    "mse_ratio": "MSE / mean's",
    "relmse_ratio": "relMSE / mean's",
    "improved": "improved",
    "bias": "bias",
    "fireflies": "fireflies left",
}
"""Columns of the tables of estimators."""


@cli.app.command(epilog="Example: chdstat train bathroom.zarr -o bathroom.safetensors")
def train(
    source: cli.SceneOrStore,
    out: Annotated[Path, typer.Option("--out", "-o", help="The model to write, .safetensors.")],
    estimator: Annotated[
        str,
        typer.Option("-e", "--estimator", metavar="NAME", help="The learned estimator to train."),
    ] = "progressive",
    features: Annotated[
        bool, typer.Option("--features", help="Use first-hit features as inputs.")
    ] = False,
    iterations: cli.Iterations = None,
    spp: cli.Spp = None,
    size: cli.Size = None,
    seed: cli.Seed = 0,
    max_depth: cli.Depth = None,
    backend: cli.BackendName = "auto",
    define: cli.Defines = None,
    plugin: cli.Plugins = None,
    store: cli.StoreKept = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Train an estimator on a scene and write it to a file."""
    from chdstat._core.files import checked_target
    from chdstat.estimators.training import check_choice, train_model

    cli.load_plugins(plugin)
    target = checked_target(out, ".safetensors")  # refused before the work, not after
    check_choice(estimator, with_features=features)
    samples = cli.samples_of(
        source,
        spp=spp,
        size=size,
        seed=seed,
        max_depth=max_depth,
        backend=backend,
        define=define,
        store=store,
        quiet=quiet,
    )
    trained = train_model(
        samples,
        estimator,
        with_features=features,
        spp=spp,
        seed=seed,
        iterations=iterations,
        progress=not quiet,
    )
    trained.save(target)
    about = {"estimator": estimator, "iterations": int(trained.history.iteration[-1])}
    output.say_written(target, as_json=as_json, **(about if as_json else {}))
    image = target.with_suffix(".exr")
    output.say_next(quiet, f"chdstat estimate {source} --model {target} -o {image}")


@cli.app.command(epilog="Example: chdstat estimate bathroom.zarr -o bathroom.exr --denoise")
def estimate(
    source: cli.SceneOrStore,
    out: Annotated[Path, typer.Option("--out", "-o", help="The image to write, .exr.")],
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A trained model, as 'train' writes it.",
            show_default="candidates are combined",
        ),
    ] = None,
    loss_weight: Annotated[
        float, typer.Option(help="Of a model: from 0, least MSE, to 1, least relMSE.")
    ] = 0.5,
    level: Annotated[float, typer.Option(help="Probability of the interval.")] = 0.9,
    denoise: Annotated[
        bool, typer.Option("--denoise", help="Denoise the estimate with Open Image Denoise.")
    ] = False,
    while_rendering: Annotated[
        bool,
        typer.Option("--while-rendering", help="Estimate from a render; keep no samples."),
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--time",
            help="While rendering: stop after so many seconds.",
            show_default="all samples",
        ),
    ] = None,
    relative_error: Annotated[
        float | None,
        typer.Option(
            "--error",
            help="While rendering: stop at this estimated relative error.",
            show_default="all samples",
        ),
    ] = None,
    spp: cli.Spp = None,
    size: cli.Size = None,
    seed: cli.Seed = 0,
    max_depth: cli.Depth = None,
    backend: cli.BackendName = "auto",
    define: cli.Defines = None,
    plugin: cli.Plugins = None,
    store: cli.StoreKept = None,
    scheduler: cli.Scheduler = None,
    workers: cli.Workers = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Estimate the radiance of every pixel, with its certainty and its interval.

    Combines the mean and denoised images, pixel by pixel, by their errors on held-out samples, or
    lets a trained model estimate. The file holds the estimate, and as layers its certainty, the
    ends of its interval, and the mean of the samples. With --while-rendering it is written whenever
    the number of samples has doubled.
    """
    from chdstat._core.files import checked_target
    from chdstat._core.work import client_of, kept_until_written
    from chdstat.estimators.estimates import write_estimates
    from chdstat.estimators.training import load_model
    from chdstat.rendering import Rendering, render_batches
    from chdstat.samples import Samples, is_store

    cli.load_plugins(plugin)
    target = checked_target(out, ".exr")  # refused before the work, not after
    trained = None if model is None else load_model(model)
    samples: Samples | Rendering
    if while_rendering and (is_store(source) or store is not None):
        message = (
            "--while-rendering keeps no samples: it takes a scene, not a store such as "
            f"{source if store is None else store}"
        )
        raise InputError(message)
    if while_rendering:
        endless = (seconds, relative_error) != (None, None)
        samples = render_batches(
            cli.scene_of(source, define),
            spp=spp or (_ENDLESS if endless else cli.SPP),
            size=cli.size_of(size),
            seed=seed,
            max_depth=max_depth,
            backend=backend,
            progress=not quiet,
        )
    else:
        samples = cli.samples_of(
            source,
            spp=spp,
            size=size,
            seed=seed,
            max_depth=max_depth,
            backend=backend,
            define=define,
            store=store,
            quiet=quiet,
        )
    with client_of(scheduler, workers) as client, kept_until_written(out) as checkpoint:
        path = write_estimates(
            target,
            samples,
            trained,
            spp=None if while_rendering else spp,
            loss_weight=loss_weight,
            level=level,
            denoise=denoise,
            progress=not quiet,
            client=client,
            checkpoint=checkpoint,
            seconds=seconds,
            relative_error=relative_error,
        )
    output.say_written(path, as_json=as_json)
    output.say_next(quiet, f"open {path} in an EXR viewer; certainty, low, high, mean are layers")


@cli.app.command(
    epilog="Example: chdstat compare bathroom.zarr -e mean -e catoni --patterns -o found"
)
def compare(
    store: cli.StorePath,
    estimator: cli.Compared = None,
    n: Annotated[int, typer.Option("--n", help="Number of samples per estimate.")] = 32,
    seed: cli.Seed = 0,
    max_batches: Annotated[
        int, typer.Option(help="Largest number of batches per pixel that are estimated from.")
    ] = 16,
    patterns: Annotated[
        bool, typer.Option("--patterns", help="Also compare for each pattern of pixels.")
    ] = False,
    denoise: Annotated[
        bool, typer.Option("--denoise", help="Also compare after Open Image Denoise.")
    ] = False,
    curve: Annotated[
        bool, typer.Option("--curve", help="Also measure errors against the number of samples.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="New folder for figures and numbers.", show_default="none"
        ),
    ] = None,
    plugin: cli.Plugins = None,
    scheduler: cli.Scheduler = None,
    workers: cli.Workers = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Compare estimators on held-out pixels: errors, bias and fireflies."""
    import chdstat
    from chdstat._core.files import unused
    from chdstat._core.work import client_of
    from chdstat.reporting.figures import save_comparison

    cli.load_plugins(plugin)
    if out is not None:
        unused(out)  # refused before the work, not after
    samples = chdstat.open(store)
    sizes = chdstat.comparison.curve_sizes(samples, estimator or None) if curve else None
    errors = None
    with client_of(scheduler, workers) as client:
        found = chdstat.compare(
            samples,
            estimator or None,
            n=n,
            seed=seed,
            max_batches=max_batches,
            denoise=denoise,
            labels="classify" if patterns else None,
            progress=not quiet,
            client=client,
        )
        if curve:
            errors = chdstat.comparison.error_curve(
                samples,
                estimator or None,
                sizes=sizes,
                seed=seed,
                max_batches=max_batches,
                model=found.reusable_models,
                progress=not quiet,
                client=client,
            )
    if out is not None:
        save_comparison(found, out, curve=errors)
    if as_json:
        curves = {} if errors is None else {"curve": errors.to_dict()}
        output.print_json(found.to_dict() | curves)
    else:
        _print_comparison(found, errors)
    output.say_next(quiet, f"chdstat estimate {store} -o {store.with_suffix('.exr')}")


@cli.app.command(epilog="Example: chdstat contrast path.zarr changed.zarr -o contrast.pdf")
def contrast(
    a: Annotated[Path, typer.Argument(metavar="A", help="A finished store.", parser=place_of)],
    b: Annotated[
        Path,
        typer.Argument(metavar="B", help="Another store, or a converged EXR.", parser=place_of),
    ],
    alpha: Annotated[
        float, typer.Option(help="Probability of a difference found where there is none.")
    ] = 0.05,
    seconds: Annotated[
        float | None,
        typer.Option(help="Compare what each renders in this time.", show_default="all samples"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="A page with maps to write, .pdf.", show_default="none"),
    ] = None,
    distributions: Annotated[
        bool,
        typer.Option("--distributions", help="Test variances and distributions of pixels, too."),
    ] = False,
    seed: cli.Seed = 0,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Test whether two renders have the same mean, and which is more efficient.

    The exit code is 0 where no difference was found, 3 where one was, and 4 where one cannot tell,
    as with too few samples. Errors end with 1 or 2.
    """
    import chdstat
    from chdstat._core.files import checked_target
    from chdstat.reporting.figures import save_figure

    target = None if out is None else checked_target(out, ".pdf")  # refused before the work
    found = chdstat.contrast(
        a, b, alpha=alpha, seconds=seconds, distributions=distributions, seed=seed
    )
    if target is not None:
        save_figure(chdstat.viz.contrast(found), target)
    if as_json:
        output.print_json(found.to_dict())
    else:
        output.print_sentences([found.verdict])
        typer.echo()
        output.print_table(found.table())
    output.say_next(quiet, f"chdstat explore {a} --other {b}")
    if code := _CODES[found.outcome]:
        raise typer.Exit(code)


@cli.app.command(epilog="Example: chdstat bench cornell-box bathroom --spp 16 -o table.tex")
def bench(
    scenes: Annotated[
        list[str],
        typer.Argument(metavar="SCENE|STORE...", help="Built-in names, Mitsuba XML files, stores."),
    ],
    estimator: cli.Compared = None,
    spp: Annotated[
        list[int] | None,
        typer.Option(help="Samples per pixel to estimate from; repeat.", show_default="16 and 64"),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Renders of each scene, averaged over.")] = 1,
    seed: cli.Seed = 0,
    size: cli.Size = None,
    reference: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCENE=FILE",
            help="A converged EXR file, or a store of other samples; can be repeated.",
            show_default="rendered with another seed",
        ),
    ] = None,
    reference_spp: Annotated[
        int, typer.Option(help="Samples per pixel of a rendered reference.")
    ] = 2048,
    image: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME@SCENE=FILE",
            help="A finished image of another program, EXR; can be repeated.",
            show_default="none",
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(help="Where renders and references are kept.", show_default="none"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Table to write: .csv, .tex, .json, .pdf.", show_default="none"
        ),
    ] = None,
    plugin: cli.Plugins = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Compare estimators on several scenes against converged references, as a paper would."""
    import chdstat
    from chdstat._core.files import checked_target
    from chdstat.comparison.benchmark import FORMATS

    if out is not None:
        checked_target(out, *FORMATS)  # refused before the work
    cli.load_plugins(plugin)
    images: dict[str, dict[str, str]] = {}
    for key, file in cli.pairs_of("--image", image).items():
        name, _, scene = key.partition("@")
        images.setdefault(name, {})[scene] = file
    found = chdstat.bench(
        scenes,
        estimator or None,
        spp=spp or (16, 64),
        seeds=seeds,
        seed=seed,
        size=cli.size_of(size),
        references=cli.pairs_of("--reference", reference),
        reference_spp=reference_spp,
        images=images,
        folder=folder,
        progress=not quiet,
    )
    if out is not None:
        found.save(out)
    if as_json:
        output.print_json(found.to_dict())
    else:
        typer.echo(found)
    output.say_next(quiet, f"chdstat compare STORE -e {found.estimators[-1]} --patterns")


_CODES = {"no difference found": 0, "differ": 3, "cannot tell": 4}
"""Exit codes by what `chdstat contrast` found."""


def _print_comparison(found: Comparison, curve: ErrorCurve | None) -> None:
    """Print the tables of a comparison, with 95 % intervals in brackets."""
    typer.echo(
        f"{len(found.estimators)} estimators from {found.n} samples, on "
        f"{found.test_pixels.sum()} test pixels; 95 % intervals in brackets\n"
    )
    output.print_rows(_in_words(found.table()), _COMPARED)
    output.print_notes(found.notes)
    if found.breakdown is not None:
        typer.echo()
        columns = {"label": "pattern", "pixels": "pixels", **_COMPARED}
        output.print_rows(_in_words(found.breakdown.table()), columns, text=["estimator"])
    if curve is not None:
        typer.echo()
        columns = {"n": "N", **_COMPARED}
        output.print_rows(_in_words(curve.table()), columns, text=["estimator"])


def _in_words(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of measures as a report shows them, by the names that commands take."""
    from chdstat.comparison.tables import in_words

    return [row | in_words(row) for row in rows]
