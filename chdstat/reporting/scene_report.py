"""Report on a scene: render, analyse, train, compare and typeset, with no other input."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chdstat import viz
from chdstat._core.files import checked_target, scratch
from chdstat.analysis import analyze, overview
from chdstat.comparison import Comparison, ErrorCurve, compare, error_curve
from chdstat.comparison.candidates import DEFAULT
from chdstat.comparison.self_training import SelfTraining
from chdstat.errors import InputError
from chdstat.estimators import LearnedEstimator, Progressive, lookup
from chdstat.estimators.models import first_samples
from chdstat.estimators.validation import draw_pixels
from chdstat.patterns import atlas
from chdstat.rendering import refuse_render
from chdstat.rendering.backend import Backend
from chdstat.rendering.capture import render
from chdstat.rendering.recipes import (
    Region,
    check_integrator,
    choose_regions,
    load_recipe,
    recipe_of,
    regions_of,
)
from chdstat.reporting import content, figures
from chdstat.reporting.claims import finding_content, plot_findings
from chdstat.reporting.typst import Document, typeset
from chdstat.samples import Samples, is_store
from chdstat.samples import open as open_samples
from chdstat.scenes import Scene, load_scene
from chdstat.studies.claims import FINDINGS, SceneData
from chdstat.viz import VERDICTS

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["report"]

_SPP = 512
_IN_MEMORY = 2**29
"""Samples up to this many bytes are read once and held; larger ones are walked on disk."""
_BATCH = 32
"""Samples of one estimate, as in Elek et al. 2019."""
_SHOWN = {14, 15}
"""Claims whose plots would repeat the table of families and the figure of the training."""
_CURVE_SPP, _CURVE_BATCHES = 256, 2
"""Samples from which errors are shown against N, and batches per pixel for each N."""


def report(
    source: str | Path | dict[str, Any] | Scene | Samples,
    path: str | Path,
    *,
    spp: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int | None = None,
    max_depth: int | None = None,
    recipe: str | Path | None = None,
    store: str | Path | None = None,
    estimators: Sequence[str] = DEFAULT,
    iterations: int | None = 1200,
    backend: Backend = "auto",
    progress: bool | None = None,
) -> Path:
    """Write a PDF report on the sample distributions of a scene.

    Parameters
    ----------
    source
        What `chdstat.load_scene` takes, the path of a finished store, or `Samples`.
    path
        The PDF to write.
    spp, size, seed, max_depth, backend
        As for `chdstat.render`; None takes the recipe's, or 512 spp and 128 pixels along the
        longer edge. Of samples that are already there, `spp` takes the first, and the others have
        no place.
    recipe
        A recipe file; None takes the scene's own where there is one in the same proportions.
        Without a recipe, the library chooses a region for each pattern that it finds.
    store
        Where to keep the rendered samples, so that the next report resumes from them; None keeps
        them in memory.
    estimators
        Names of the estimators to compare; those that learn are trained on these samples. With
        "progressive" among them, what it learns without a reference is shown, too, with its
        certainty and its intervals.
    iterations
        Minibatches that "progressive" learns from; None takes its own number, which takes longer
        and ends a few per cent lower.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    Path
        The PDF.

    Raises
    ------
    InputError
        If the output cannot be a PDF or an option is out of range.
    SceneError, RenderError, StoreError
        As for `chdstat.render` and `chdstat.open`.
    """
    target = checked_target(path, ".pdf")
    for name in estimators:
        lookup(name)  # an unknown one is refused before the work
    if iterations is not None and iterations < 1:
        message = f"iterations must be at least 1, got {iterations}"
        raise InputError(message)
    asked = {"spp": spp, "size": size, "seed": seed, "max_depth": max_depth}
    given = {name: value for name, value in asked.items() if value is not None}
    named = load_recipe(recipe) if recipe else None
    finished = open_samples(source) if is_store(source) else source
    if isinstance(finished, Samples):
        refuse_render(finished, asked | {"spp": None, "store": store, "backend": backend})
        samples = first_samples(finished, spp)
    else:
        scene = load_scene(finished)
        if named is not None:
            check_integrator(named, scene)
        settings = (named or recipe_of(scene, spp=_SPP, seed=0)).settings() | given
        samples = render(scene, **settings, out=store, backend=backend, progress=progress)
    if samples.nbytes <= _IN_MEMORY:
        samples = samples.load()
    regions = named.regions if named else regions_of(samples)
    document = _document(samples, regions, estimators, iterations, progress)
    with scratch() as folder:
        return typeset(document, folder, target)


def _document(
    samples: Samples,
    regions: tuple[Region, ...],
    estimators: Sequence[str],
    iterations: int | None,
    progress: bool | None,
) -> Document:
    """Compute everything that the report shows, and return it ready to typeset."""
    dataset = analyze(samples, progress=progress)
    comparison, why_not = _compare(samples, estimators, dataset["label"], iterations, progress)
    chosen = regions or choose_regions(dataset)
    data = SceneData(samples.name, samples, chosen, given=dataset, comparison=comparison)
    scene, found = overview(dataset), atlas(samples, progress=progress)
    shapes = found if len(found.share) else None
    panels = figures.panels_of(data)
    claims = [claim.find(data) for claim in FINDINGS if claim.alone]
    entries = content.scene_content(data, scene) | {
        "regions_chosen": not regions,
        "no_estimators": why_not,
        "verdicts": VERDICTS,
        "claims": [finding_content(finding) for finding in claims],
        "untested": [f"{claim.number} ({claim.name})" for claim in FINDINGS if not claim.alone],
    }
    drawn = figures.scene_figures(data, panels, atlas=shapes)
    drawn |= figures.analysis_figures(dataset, scene)
    if panels:
        drawn["chds"] = viz.chd_grid(panels)
    else:
        drawn["image"] = viz.with_marks(dataset["mean"].values)
    shown = plot_findings({f"{f.number} {f.name}": f for f in claims if f.number not in _SHOWN})
    if shown is not None:
        drawn["plots"] = shown
    if shapes is not None:
        entries["atlas"] = content.atlas_content(shapes)
    trained = None
    if comparison is not None:
        trained = SelfTraining.of(samples, comparison, iterations=iterations, progress=progress)
        entries["estimators"] = content.estimator_table(comparison)
        drawn |= figures.of_comparison(comparison, _curve(samples, comparison, progress))
    if trained is not None:
        entries["self_training"] = content.self_training_content(trained)
        drawn["self_training"] = figures.self_training(trained)
    rows = content.findings(scene, shapes, comparison, trained)
    entries["findings"] = [row._asdict() for row in rows]
    return Document("report.typ", entries, drawn)


def _compare(
    samples: Samples,
    estimators: Sequence[str],
    labels: xr.DataArray,
    iterations: int | None,
    progress: bool | None,
) -> tuple[Comparison | None, str]:
    """Compare the estimators; where these samples are too few, return the reason instead.

    Ours is trained for many numbers of samples, on the pixels that a comparison draws.
    """
    model = None
    try:
        if "progressive" in estimators:
            entry = lookup("progressive")
            wanted = entry.pixels if isinstance(entry, LearnedEstimator) else None
            pixels = None if wanted is None else draw_pixels(samples.shape[:2], wanted, seed=0)
            model = Progressive().train(
                samples, iterations=iterations, pixels=pixels, progress=progress
            )
        found = compare(
            samples, estimators, n=_BATCH, labels=labels, model=model, progress=progress
        )
    except InputError as error:
        return None, str(error)
    return found, ""


def _curve(samples: Samples, comparison: Comparison, progress: bool | None) -> ErrorCurve | None:
    """Return errors of the compared estimators against N; None where there is only one N."""
    if samples.spp < _CURVE_SPP:
        return None
    model = comparison.models.get("progressive", next(iter(comparison.models.values()), None))
    # Another that learns would have to learn again, and takes one N only.
    others = comparison.models.keys() - {"" if model is None else model.name}
    return error_curve(
        samples,
        [name for name in comparison.estimators if name not in others],
        max_batches=_CURVE_BATCHES,
        model=model,
        progress=progress,
    )
