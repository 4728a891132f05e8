"""Estimation: the commands that train, estimate and compare."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chdstat.cli.options import (
    BackendName,
    Defines,
    Depth,
    Iterations,
    Json,
    Quiet,
    SceneOrStore,
    Seed,
    Size,
    Spp,
    StoreKept,
    StorePath,
    batches_of,
    given,
    progress_of,
    samples_of,
)
from chdstat.cli.program import app, print_json, print_rows

if TYPE_CHECKING:
    from chdstat.estimators.progressive.inputs import Input

__all__ = ["compare", "estimate", "train"]

_COMPARED = {
    "estimator": "estimator",
    "mse_ratio": "MSE ratio",
    "relmse_ratio": "relMSE ratio",
    "improved": "improved",
    "unchanged": "unchanged",
    "bias": "bias",
    "fireflies_left": "fireflies left",
}
"""Columns of the tables of estimators."""


@app.command(epilog="Example: chdstat train bathroom.zarr -o bathroom.safetensors")
def train(
    source: SceneOrStore,
    out: Annotated[Path, typer.Option("--out", "-o", help="The model to write, .safetensors.")],
    model: Annotated[
        str, typer.Option("--model", metavar="NAME", help="Which estimator that learns.")
    ] = "progressive",
    features: Annotated[
        bool, typer.Option("--features", help="Look at what the camera rays hit.")
    ] = False,
    direct: Annotated[
        bool, typer.Option("--direct", help="Look at direct and indirect light apart.")
    ] = False,
    no_reference: Annotated[
        bool,
        typer.Option("--no-reference", help="Learn from splits of the samples; look around, too."),
    ] = False,
    iterations: Iterations = None,
    spp: Spp = None,
    size: Size = None,
    seed: Seed = None,
    max_depth: Depth = None,
    backend: BackendName = "auto",
    define: Defines = None,
    store: StoreKept = None,
    quiet: Quiet = False,
) -> None:
    """Train an estimator on a scene and keep it; of a store, --spp takes the first samples."""
    from chdstat._core.files import checked_target
    from chdstat.estimators.models import check_choice, train_model

    target = checked_target(out, ".safetensors")  # refused before the work, not after
    wanted: dict[Input, bool] = {"features": features, "direct": direct}
    inputs = [name for name, given in wanted.items() if given]
    check_choice(model, inputs=inputs, reference=not no_reference)
    samples = samples_of(
        source,
        define=define,
        size=size,
        store=store,
        quiet=quiet,
        spp=spp,
        seed=seed,
        max_depth=max_depth,
        backend=backend,
        direct=direct or None,
    )
    trained = train_model(
        samples,
        model,
        inputs=inputs,
        reference=not no_reference,
        spp=spp,
        **given(seed=seed, iterations=iterations),
        progress=progress_of(quiet),
    )
    trained.save(target)
    typer.echo(f"wrote {target}")


@app.command(epilog="Example: chdstat estimate bathroom.zarr -o bathroom.exr --denoise")
def estimate(
    source: SceneOrStore,
    out: Annotated[Path, typer.Option("--out", "-o", help="The image to write, .exr.")],
    model: Annotated[
        Path | None,
        typer.Option(
            "--model", help="A trained model, in place of training one here.", show_default=False
        ),
    ] = None,
    balance: Annotated[
        float | None,
        typer.Option(help="From 0, least MSE, to 1, least relMSE.", show_default=False),
    ] = None,
    level: Annotated[
        float | None, typer.Option(help="Probability of the interval.", show_default=False)
    ] = None,
    denoise: Annotated[
        bool, typer.Option("--denoise", help="Put the image through Open Image Denoise.")
    ] = False,
    while_rendering: Annotated[
        bool,
        typer.Option(
            "--while-rendering", help="Learn batch by batch as a scene renders; keep no samples."
        ),
    ] = False,
    iterations: Iterations = None,
    spp: Spp = None,
    size: Size = None,
    seed: Seed = None,
    max_depth: Depth = None,
    backend: BackendName = "auto",
    define: Defines = None,
    store: StoreKept = None,
    quiet: Quiet = False,
) -> None:
    """Make a better image of the samples there are; of a store, --spp takes the first samples.

    Trains on these very samples, without a reference; with --while-rendering between the batches
    of a render, in memory that does not grow with --spp. The file holds the estimate, and as layers
    its certainty, the ends of its interval, and the mean of the samples.
    """
    from chdstat._core.files import checked_target
    from chdstat.estimators import Progressive
    from chdstat.estimators.estimates import write_estimates
    from chdstat.estimators.models import load_model

    target = checked_target(out, ".exr")  # refused before the work, not after
    trained = None if model is None else load_model(model)
    drawn = batches_of if while_rendering else samples_of
    seen = isinstance(trained, Progressive) and trained.inputs.direct
    extra = {"direct": True} if seen and not while_rendering else {}
    samples = drawn(
        source,
        define=define,
        size=size,
        store=store,
        quiet=quiet,
        spp=spp,
        seed=seed,
        max_depth=max_depth,
        backend=backend,
        **extra,  # what such a model looks at is rendered with the rest
    )
    path = write_estimates(
        target,
        samples,
        trained,
        denoise=denoise,
        spp=None if while_rendering else spp,
        **given(balance=balance, level=level, seed=seed, iterations=iterations),
        progress=progress_of(quiet),
    )
    typer.echo(f"wrote {path}")


@app.command(epilog="Example: chdstat compare bathroom.zarr -e mean -e catoni --patterns -o found")
def compare(
    store: StorePath,
    estimator: Annotated[
        list[str] | None,
        typer.Option("--estimator", "-e", metavar="NAME", help="What to compare; repeat for more."),
    ] = None,
    n: Annotated[int | None, typer.Option("--n", help="Samples per estimate.")] = None,
    seed: Seed = None,
    max_batches: Annotated[
        int | None, typer.Option(help="Batches per pixel that estimate.", show_default=False)
    ] = None,
    patterns: Annotated[
        bool, typer.Option("--patterns", help="Say which estimator for which pattern, too.")
    ] = False,
    denoise: Annotated[
        bool, typer.Option("--denoise", help="Judge each with Open Image Denoise after it, too.")
    ] = False,
    curve: Annotated[
        bool, typer.Option("--curve", help="Measure errors against the number of samples, too.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for figures and numbers.", show_default=False),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Compare estimators on held-out pixels: errors, bias and fireflies."""
    import chdstat
    from chdstat._core.files import unused
    from chdstat.reporting.figures import save_comparison

    if out is not None:
        unused(out)  # refused before the work, not after
    samples = chdstat.open(store)
    settings = given(estimators=estimator, seed=seed, max_batches=max_batches)
    sizes = chdstat.comparison.curve_sizes(samples, **given(estimators=estimator)) if curve else ()
    found = chdstat.compare(
        samples,
        **settings,
        **given(n=n, labels="classify" if patterns else None),
        denoise=denoise,
        progress=progress_of(quiet),
    )
    errors = None
    if curve:
        errors = chdstat.comparison.error_curve(
            samples,
            **settings,
            sizes=sizes,
            model=found.reusable_models,
            progress=progress_of(quiet),
        )
    if out is not None:
        save_comparison(found, out, curve=errors)
    if as_json:
        print_json(found.to_dict() | ({} if errors is None else {"curve": errors.to_dict()}))
        return
    print_rows(found.table(), _COMPARED, separate="uses_neighbours")
    if found.breakdown is not None:
        print_rows(found.breakdown.table(), {"label": "pattern", "pixels": "pixels", **_COMPARED})
    if errors is not None:
        print_rows(errors.table(), {"n": "N", **_COMPARED})
