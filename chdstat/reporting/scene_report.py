"""Report on a scene: render, analyse, train, compare and typeset, with no other input.

Estimators are trained in processes of their own while the samples are analysed.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

from joblib import Parallel, delayed

from chdstat._core.files import checked_target, scratch
from chdstat._core.work import cores, kept_until_written, track
from chdstat.analysis import analyze
from chdstat.comparison import Comparison, ErrorCurve, compare, error_curve
from chdstat.comparison.entries import (
    DEFAULT_ESTIMATORS,
    Entry,
    entry_of,
    without_denoiser,
)
from chdstat.errors import InputError
from chdstat.estimators import LearnedEstimator
from chdstat.estimators.registry import Model
from chdstat.estimators.training import check_iterations, first_samples
from chdstat.estimators.validation import draw_pixels
from chdstat.patterns import atlas, choose_regions
from chdstat.rendering import refuse_render
from chdstat.rendering.backend import Backend
from chdstat.rendering.capture import render
from chdstat.rendering.options import RenderSettings
from chdstat.rendering.recipes import (
    Recipe,
    Region,
    check_integrator,
    load_recipe,
    recipe_of,
    regions_of,
)
from chdstat.reporting import content, figures
from chdstat.reporting.typst import Document, typeset
from chdstat.samples import Samples, check_equal_counts, is_store
from chdstat.samples import open as open_samples
from chdstat.scenes import Scene, load_scene
from chdstat.studies.claims import FINDINGS, SceneData
from chdstat.studies.run import SceneStudy
from chdstat.viz import VERDICTS

__all__ = ["published_seconds", "report"]

_SPP = 512
_IN_MEMORY = 2**29
"""Samples up to this many bytes are read once and held; larger ones are walked on disk."""
_PILOT = 32
"""Samples per pixel from which the time of many is told."""
_BATCH = 32
"""Samples of one estimate, as in Elek et al. 2019."""
_ITERATIONS = {"elek2019": 10_000, "progressive": 1200}
"""Minibatches of each training unless all is as published; more take longer and gain little."""
_CURVE_SPP, _CURVE_BATCHES = 256, 2
"""Samples from which errors are shown against N, and batches per pixel for each N."""


def report(
    source: str | Path | dict[str, Any] | Scene | Samples,
    path: str | Path,
    *,
    recipe: str | Path | None = None,
    store: str | Path | None = None,
    estimators: Sequence[str | Entry] | None = None,
    iterations: int | None = None,
    as_published: bool = False,
    progress: bool | None = None,
    **settings: Unpack[RenderSettings],
) -> Path:
    """Write a PDF report on the sample distributions of a scene.

    Parameters
    ----------
    source
        What `chdstat.load_scene` takes, the path of a finished store, or `Samples`.
    path
        The PDF to write.
    recipe
        A recipe file; None takes the scene's own where there is one in the same proportions.
        Without a recipe, the library chooses a region for each pattern that it finds.
    store
        Where to keep the rendered samples, so that the next report resumes from them; None keeps
        them in memory.
    estimators
        As for `chdstat.compare`; those that learn are trained on these samples.
    iterations
        Minibatches of each training; None takes as many as pay in a report.
    as_published
        Render and train as Elek et al. 2019 did: 2000 spp, 800 pixels along the longer edge, 30,000
        minibatches, unless told otherwise. It takes hours; the samples are kept beside the PDF, so
        that the work resumes.
    progress
        Show progress bars; None shows them on a terminal.
    **settings
        As for `chdstat.render`: ``spp``, ``size``, ``seed``, ``max_depth``, ``backend`` and the
        others; the samples must be independent. What is not given is the recipe's, or 512 spp and
        128 pixels along the longer edge.
        Of samples that are already there, `spp` takes the first, and the others have no place.

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
    for name in estimators or ():
        entry_of(name)  # an unknown one is refused before the work
    check_iterations(iterations)
    given: dict[str, Any] = {n: value for n, value in settings.items() if value is not None}
    named = load_recipe(recipe) if recipe else None
    finished = open_samples(source) if is_store(source) else source
    if isinstance(finished, Samples):
        refuse_render(finished, given | {"spp": None, "store": store})
        samples = first_samples(finished, given.get("spp"))
        check_equal_counts(samples)
    else:
        scene = load_scene(finished)
        if named is not None:
            check_integrator(named, scene)
        given = _settings_of(scene, named, as_published=as_published) | given
        if as_published:
            store = store or target.with_suffix(".zarr")
        samples = render(scene, **given, out=store, progress=progress)
    if samples.nbytes <= _IN_MEMORY:
        samples = samples.load()
    regions = named.regions if named else regions_of(samples)
    trained = _trainings(samples, estimators, iterations, as_published=as_published)
    # What is analysed is in files beside the report until that is there: it may not fit in memory.
    with kept_until_written(target) as checkpoint:
        document = _document(samples, regions, estimators, trained, progress, checkpoint)
        with scratch() as folder:
            return typeset(document, folder, target)


def _settings_of(scene: Scene, recipe: Recipe | None, *, as_published: bool) -> dict[str, Any]:
    """Return what a scene is rendered with; as published, with the size and spp of the paper."""
    settings = (recipe or recipe_of(scene, spp=_SPP, seed=0)).settings()
    if as_published:
        scale = content.PUBLISHED_SIZE / max(settings["size"])
        width, height = (round(length * scale) for length in settings["size"])
        settings |= {"spp": content.PUBLISHED_SPP, "size": (width, height)}
    return settings


def published_seconds(
    scene: Scene, recipe: str | Path | None = None, *, backend: Backend = "auto"
) -> float:
    """Return about how long it takes to render a scene as published, from a small render of it."""
    named = load_recipe(recipe) if recipe else None
    whole = _settings_of(scene, named, as_published=True)
    size = tuple(max(1, length // 8) for length in whole["size"])
    small = render(scene, **whole | {"size": size, "spp": _PILOT}, backend=backend, progress=False)
    height, width, _, spp = small.shape
    part = (width * height * spp) / (math.prod(whole["size"]) * whole["spp"])
    return float(small.attrs["render_seconds"] / part)


def _trainings(
    samples: Samples,
    estimators: Sequence[str | Entry] | None,
    iterations: int | None,
    *,
    as_published: bool,
) -> dict[str, Any]:
    """Return what has to be trained, by name, to be called in a process of its own."""

    def number_of(name: str) -> int | None:
        return iterations or (None if as_published else _ITERATIONS.get(name))

    calls = {}
    for name in DEFAULT_ESTIMATORS if estimators is None else estimators:
        entry = without_denoiser(entry_of(name))
        if entry.name in _ITERATIONS and isinstance(entry, LearnedEstimator):
            calls[entry.name] = delayed(_train)(samples, entry, number_of(entry.name))
    return calls


def _train(samples: Samples, entry: LearnedEstimator, iterations: int | None) -> Model | None:
    """Train an estimator on the pixels that a comparison draws.

    Return None where the samples are too few: the comparison then says why.
    """
    pixels = draw_pixels(samples.shape[:2], entry.pixels, seed=0)
    try:
        return entry.train(samples, seed=0, pixels=pixels, iterations=iterations, progress=False)
    except InputError:
        return None


def _document(
    samples: Samples,
    regions: tuple[Region, ...],
    estimators: Sequence[str | Entry] | None,
    trainings: Mapping[str, Any],
    progress: bool | None,
    checkpoint: Path | None,
) -> Document:
    """Compute everything that the report shows, and return it ready to typeset."""
    jobs = max(1, min(len(trainings), cores()))
    training = Parallel(n_jobs=jobs, return_as="generator")(trainings.values())
    with contextlib.closing(training) as results:
        dataset = analyze(samples, progress=progress, checkpoint=checkpoint)
        shapes = atlas(samples, progress=progress)
        models = _trained(trainings, results, progress)
    comparison, curve, why_not = None, None, ""
    try:
        comparison = compare(
            samples,
            estimators,
            n=_BATCH,
            labels=dataset["label"],
            model=models,
            progress=progress,
        )
    except InputError as error:
        why_not = str(error)
    if comparison is not None:
        curve = _curve(samples, comparison, progress)
    data = SceneData(
        samples.name,
        samples,
        regions or choose_regions(dataset),
        given=dataset,
        comparison=comparison,
    )
    found = SceneStudy(
        data,
        tuple(claim.find(data) for claim in FINDINGS if claim.alone),
        chosen=not regions,
        atlas=shapes if len(shapes.share) else None,
    )
    entries = content.scene_content(found) | {
        "regions_chosen": found.chosen,
        "no_estimators": why_not,
        "verdicts": VERDICTS,
        "untested": [f"{claim.number} ({claim.name})" for claim in FINDINGS if not claim.alone],
    }
    return Document("report.typ", entries, figures.report_figures(found, curve))


def _trained(
    names: Iterable[str], results: Iterator[Any], progress: bool | None
) -> dict[str, Model]:
    """Return the trained models by name."""
    names, models = list(names), {}
    with track("training", len(names), unit="models", show=progress) as advance:
        for name in names:
            model = next(results)
            advance(1)
            if model is not None:
                models[name] = model
    return models


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
