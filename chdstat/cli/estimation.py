"""Estimation: the commands that train, estimate and compare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from chdstat.cli import program as cli
from chdstat.errors import InputError

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


@cli.app.command(epilog="Example: chdstat train bathroom.zarr -o bathroom.safetensors")
def train(
    source: cli.SceneOrStore,
    out: Annotated[Path, typer.Option("--out", "-o", help="The model to write, .safetensors.")],
    model: Annotated[
        str, typer.Option("--model", metavar="NAME", help="Name of the learned estimator.")
    ] = "progressive",
    features: Annotated[
        bool, typer.Option("--features", help="Use first-hit features as inputs.")
    ] = False,
    direct: Annotated[
        bool, typer.Option("--direct", help="Use direct and indirect light separately as inputs.")
    ] = False,
    no_reference: Annotated[
        bool,
        typer.Option(
            "--no-reference", help="Learn from splits of the samples, with neighbouring pixels."
        ),
    ] = False,
    iterations: cli.Iterations = None,
    spp: cli.Spp = None,
    size: cli.Size = None,
    seed: cli.Seed = 0,
    max_depth: cli.Depth = None,
    backend: cli.BackendName = "auto",
    define: cli.Defines = None,
    store: cli.StoreKept = None,
    quiet: cli.Quiet = False,
) -> None:
    """Train an estimator on a scene and keep it; of a store, --spp takes the first samples."""
    from chdstat._core.files import checked_target
    from chdstat.estimators.models import check_choice, train_model
    from chdstat.estimators.progressive.inputs import Input

    target = checked_target(out, ".safetensors")  # refused before the work, not after
    wanted: dict[Input, bool] = {"features": features, "direct": direct}
    inputs = [name for name, chosen in wanted.items() if chosen]
    check_choice(model, inputs=inputs, reference=not no_reference)
    samples = cli.samples_of(
        source,
        spp=spp,
        size=size,
        seed=seed,
        max_depth=max_depth,
        backend=backend,
        direct=direct,
        define=define,
        store=store,
        quiet=quiet,
    )
    trained = train_model(
        samples,
        model,
        inputs=inputs,
        reference=not no_reference,
        spp=spp,
        seed=seed,
        iterations=iterations,
        progress=cli.progress_of(quiet),
    )
    trained.save(target)
    typer.echo(f"wrote {target}")


@cli.app.command(epilog="Example: chdstat estimate bathroom.zarr -o bathroom.exr --denoise")
def estimate(
    source: cli.SceneOrStore,
    out: Annotated[Path, typer.Option("--out", "-o", help="The image to write, .exr.")],
    model: Annotated[
        Path | None, typer.Option(help="A trained model, in place of training one here.")
    ] = None,
    loss_weight: Annotated[
        float, typer.Option(help="From 0, least MSE, to 1, least relMSE.")
    ] = 0.5,
    level: Annotated[float, typer.Option(help="Probability of the interval.")] = 0.9,
    denoise: Annotated[
        bool, typer.Option("--denoise", help="Denoise the estimate with Open Image Denoise.")
    ] = False,
    while_rendering: Annotated[
        bool,
        typer.Option(
            "--while-rendering", help="Train between batches of a render; keep no samples."
        ),
    ] = False,
    iterations: cli.Iterations = None,
    spp: cli.Spp = None,
    size: cli.Size = None,
    seed: cli.Seed = 0,
    max_depth: cli.Depth = None,
    backend: cli.BackendName = "auto",
    define: cli.Defines = None,
    store: cli.StoreKept = None,
    quiet: cli.Quiet = False,
) -> None:
    """Estimate the radiance of every pixel; of a store, --spp takes the first samples.

    Trains on these very samples, without a reference; with --while-rendering between the batches
    of a render, in memory that does not grow with --spp. The file holds the estimate, and as layers
    its certainty, the ends of its interval, and the mean of the samples.
    """
    from chdstat._core.files import checked_target
    from chdstat.estimators import Progressive
    from chdstat.estimators.estimates import write_estimates
    from chdstat.estimators.models import load_model
    from chdstat.rendering import Rendering, render_batches
    from chdstat.samples import Samples, is_store

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
        samples = render_batches(
            cli.scene_of(source, define),
            spp=cli.SPP if spp is None else spp,
            size=cli.size_of(size),
            seed=seed,
            max_depth=max_depth,
            backend=backend,
            progress=cli.progress_of(quiet),
        )
    else:
        samples = cli.samples_of(
            source,
            spp=spp,
            size=size,
            seed=seed,
            max_depth=max_depth,
            backend=backend,
            direct=isinstance(trained, Progressive) and trained.inputs.direct,
            define=define,
            store=store,
            quiet=quiet,
        )
    path = write_estimates(
        target,
        samples,
        trained,
        spp=None if while_rendering else spp,
        loss_weight=loss_weight,
        level=level,
        denoise=denoise,
        seed=seed,
        iterations=iterations,
        progress=cli.progress_of(quiet),
    )
    typer.echo(f"wrote {path}")


@cli.app.command(
    epilog="Example: chdstat compare bathroom.zarr -e mean -e catoni --patterns -o found"
)
def compare(
    store: cli.StorePath,
    estimator: Annotated[
        list[str] | None,
        typer.Option("-e", "--estimator", metavar="NAME", help="An estimator; can be repeated."),
    ] = None,
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
        Path | None, typer.Option("--out", "-o", help="Folder for figures and numbers.")
    ] = None,
    quiet: cli.Quiet = False,
    as_json: cli.Json = False,
) -> None:
    """Compare estimators on held-out pixels: errors, bias and fireflies."""
    import chdstat
    from chdstat._core.files import unused
    from chdstat.comparison.candidates import DEFAULT
    from chdstat.reporting.figures import save_comparison

    if out is not None:
        unused(out)  # refused before the work, not after
    samples, estimators = chdstat.open(store), estimator or DEFAULT
    sizes = chdstat.comparison.curve_sizes(samples, estimators) if curve else None
    found = chdstat.compare(
        samples,
        estimators,
        n=n,
        seed=seed,
        max_batches=max_batches,
        denoise=denoise,
        labels="classify" if patterns else None,
        progress=cli.progress_of(quiet),
    )
    errors = None
    if curve:
        errors = chdstat.comparison.error_curve(
            samples,
            estimators,
            sizes=sizes,
            seed=seed,
            max_batches=max_batches,
            model=found.reusable_models,
            progress=cli.progress_of(quiet),
        )
    if out is not None:
        save_comparison(found, out, curve=errors)
    if as_json:
        cli.print_json(found.to_dict() | ({} if errors is None else {"curve": errors.to_dict()}))
        return
    cli.print_rows(found.table(), _COMPARED, separate="uses_neighbours")
    if found.breakdown is not None:
        columns = {"label": "pattern", "pixels": "pixels", **_COMPARED}
        cli.print_rows(found.breakdown.table(), columns)
    if errors is not None:
        cli.print_rows(errors.table(), {"n": "N", **_COMPARED})
