"""Report on a scene: render, analyse, compare and typeset.

The short report needs the patterns of luminance and estimators without training. The full report
also tests the paper's claims, which need the families of all channels and the network of the paper.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, cast, get_args

import numpy as np

from chdstat._core.arrays import whole
from chdstat._core.files import checked_target, kept_until_written, trim
from chdstat._core.progress import track
from chdstat.analysis import NoiseShares, noise_of, patterns_of
from chdstat.comparison import Comparison, ErrorCurve, compare, error_curve
from chdstat.comparison.estimator_choice import (
    DEFAULT_ESTIMATORS,
    Entry,
    choose,
    entry_of,
    without_denoiser,
)
from chdstat.errors import InputError, check_option
from chdstat.estimators import Combination, LearnedEstimator, estimate
from chdstat.estimators.held_out import draw_pixels
from chdstat.estimators.registry import Model
from chdstat.estimators.training import first_samples
from chdstat.inference import contrast
from chdstat.patterns import atlas, choose_regions
from chdstat.rendering import refuse_render
from chdstat.rendering.jobs import RenderSettings
from chdstat.rendering.recipes import (
    check_integrator,
    load_recipe,
    recipe_of,
    regions_of,
)
from chdstat.rendering.renders import render
from chdstat.reporting import content, figures
from chdstat.reporting.content import Contents
from chdstat.reporting.documents import Document, typeset
from chdstat.reporting.headlines import FEW_PIXELS
from chdstat.samples import Region, Samples, is_store
from chdstat.samples import open as open_samples
from chdstat.samples.dependence import check_distribution
from chdstat.scenes import Scene, load_scene
from chdstat.scenes.scene import MITSUBA
from chdstat.studies.claims import CLAIMS, SceneData
from chdstat.studies.stores import at_hand
from chdstat.studies.studies import SceneStudy
from chdstat.viz import VERDICTS

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

_SPP = 512
_BATCH = 32
"""Samples of one estimate, as in Elek et al. 2019."""
_ESTIMATES, _BATCHES = 2**15, (2, 4, 16)
"""Enough estimates in all; fewest estimates per pixel in a short and in a full report, and most."""
_TRAINING: dict[str, dict[str, Any]] = {"elek2019": {"patience": 2000}}
"""How long the network trains: more takes long and gains little."""
_CURVE_SPP = 256
"""Fewest samples for showing errors against N."""
_REGIONS = 6
"""Most regions of a short report."""


def report(
    source: str | Path | dict[str, Any] | Scene | Samples | Sequence[Any],
    path: str | Path,
    *,
    contents: Contents = "short",
    recipe: str | Path | None = None,
    store: str | Path | None = None,
    estimators: Sequence[str | Entry] | None = None,
    iterations: int | None = None,
    progress: bool = True,
    **settings: Unpack[RenderSettings],
) -> Path:
    """Write a PDF report on the sample distributions of a scene, or on several renders of it.

    Parameters
    ----------
    source
        What `chdstat.load_scene` takes, the path of a finished store, or `Samples`. Or a list of
        stores or `Samples` of one view, for a report on which is noisier, where and why, as
        ``chdstat.contrast(source).report(path)``; no option is for it.
    path
        The PDF to write.
    contents
        "short": three or four pages on what is noisy, why, and what helps by how much. "full" adds
        the case study of the paper, its claims, families, averages, error curves and trainings.
        "claims": only the claims of the paper.
    recipe
        A recipe file; None takes the recipe of the scene if it has one with the same aspect ratio.
        Without a recipe, the library chooses a region for each pattern that it finds.
    store
        Store for the rendered samples, from which the next report resumes; None keeps them in
        memory.
    estimators
        As for `chdstat.compare`; learned estimators are trained on these samples. None takes the
        default estimators; a short report leaves out learned ones.
    iterations
        Minibatches of each training. With None, the network of the paper stops when its validation
        error no longer falls.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.
    **settings
        As for `chdstat.render`: ``spp``, ``size``, ``seed``, ``max_depth``, ``backend`` and others;
        the samples must be independent. The defaults are those of the recipe, or 512 spp and 128
        pixels along the longer edge. With a store or `Samples`, only `spp` may be given: it takes
        the first samples.

    Returns
    -------
    Path
        The PDF.

    Raises
    ------
    InputError
        If the output cannot be a PDF, an option is out of range, or pixels have one sample each.
    SceneError, RenderError, StoreError
        As for `chdstat.render` and `chdstat.open`.
    """
    target = checked_target(path, ".pdf")
    check_option("contents", contents, get_args(Contents))
    for name in estimators or ():
        entry_of(name)  # an unknown one is refused before the work
    if iterations is not None:
        whole("iterations", iterations, least=1)
    given: dict[str, Any] = {n: value for n, value in settings.items() if value is not None}
    named = load_recipe(recipe) if recipe else None
    if isinstance(source, list | tuple):
        options = {"recipe": recipe, "store": store, "estimators": estimators, **given}
        options |= {"iterations": iterations}
        options |= {"contents": None if contents == "short" else contents}
        return _of_several(source, target, options, progress)
    finished = open_samples(source) if is_store(source) else source
    if isinstance(finished, Samples):
        refuse_render(finished, given | {"spp": None, "store": store})
        samples = first_samples(finished, given.get("spp"))
    else:
        scene = load_scene(finished)
        if named is not None:
            check_integrator(named, scene)
        given = (named or recipe_of(scene, spp=_SPP, seed=0)).settings() | given
        film = scene.renderer == MITSUBA  # others do not say where samples fall
        samples = render(scene, **given, film=film, out=store, progress=progress)
    check_distribution(samples.spp)
    samples = at_hand(samples)
    training = {name: {"iterations": iterations} for name in _TRAINING} if iterations else _TRAINING
    report_ = _Report(samples, contents, estimators, training, progress)
    # The analysis may not fit in memory: keep it in files beside the report while it is made.
    with (
        kept_until_written(target) as checkpoint,
        track(f"writing {target.name}", 0, show=progress),
    ):
        document = report_.document(named.regions if named else regions_of(samples), checkpoint)
        return typeset(document, target)


def _of_several(
    sources: Sequence[Any], target: Path, options: Mapping[str, Any], progress: bool
) -> Path:
    """Write the report on several renders."""
    if others := [name for name, value in options.items() if value not in (None, "auto")]:
        named = ", ".join(f"{name}=" for name in others)
        message = f"a report on several renders takes no {named}: leave it out"
        raise InputError(message)
    for one in sources:
        if isinstance(one, Scene) or not (isinstance(one, Samples) or is_store(one)):
            message = (
                "a report on several renders takes finished stores of one view, got "
                f"{one.name if isinstance(one, Scene) else one}: render it first, with -o or out="
            )
            raise InputError(message)
    return contrast(sources, progress=progress).report(target)


@dataclass(frozen=True)
class _Report:
    """A report on samples, with its options; as for `report`.

    Attributes
    ----------
    training
        Options of trainings, by the name of what is trained.
    """

    samples: Samples
    contents: Contents
    estimators: Sequence[str | Entry] | None
    training: Mapping[str, dict[str, Any]]
    progress: bool

    def document(self, regions: tuple[Region, ...], checkpoint: Path | None) -> Document:
        """Compute everything for the report, and return it ready to typeset."""
        samples, full, short = self.samples, self.contents == "full", self.contents == "short"
        about: Any = {"progress": self.progress, "checkpoint": checkpoint}
        dataset = patterns_of(samples, families=not short, **about)
        trim()
        noise = noise_of(dataset)
        comparison, why_not = self.compared(dataset, noise)
        if samples.shape[0] * samples.shape[1] < FEW_PIXELS:
            regions = ()  # which share their pixels
        shown = regions or _by_noise(choose_regions(dataset), noise)
        data = SceneData(
            samples.name,
            samples,
            (_some(regions, dataset) or shown[:_REGIONS]) if short else shown,
            given=dataset,
            comparison=comparison,
        )
        shapes = atlas(samples, progress=self.progress) if full else None
        found = SceneStudy(
            data,
            () if short else tuple(claim.find(data) for claim in CLAIMS if claim.alone),
            chosen=not regions,
            atlas=shapes if shapes is not None and len(shapes.share) else None,
        )
        estimated = self.estimated() if noise and self.contents != "claims" else None
        entries = content.report_content(found, self.contents, estimated)
        entries |= {"verdicts": VERDICTS, "no_estimators": why_not, "drawn": []}
        drawn: Mapping[str, Figure] = {}
        if self.contents != "claims":
            curve = self.curve(comparison) if full and comparison is not None else None
            of_report = figures.ReportData(found, comparison, estimated, curve, full=full)
            drawn, entries["drawn"] = figures.report_figures(of_report)
        return Document("scene_report.typ", entries, drawn)

    def compared(self, dataset: xr.Dataset, noise: NoiseShares) -> tuple[Comparison | None, str]:
        """Return the comparison of estimators, or why they cannot be compared."""
        samples, estimators = self.samples, self.estimators
        if not noise:
            return None, ""
        if samples.shape[0] * samples.shape[1] < FEW_PIXELS:
            return None, "There are too few pixels to compare estimators."
        try:
            if self.contents == "short" and estimators is None:
                entries = choose(None, (_BATCH,), samples=samples).entries.values()
                estimators = [e for e in entries if not isinstance(e, LearnedEstimator)]
            found = compare(
                samples,
                estimators,
                n=_BATCH,
                max_batches=self.batches,
                labels=dataset["label"],
                model=self.trained(estimators),
                progress=self.progress,
            )
        except InputError as error:
            return None, f"Estimators were not compared: {error}."
        return found, ""

    @property
    def batches(self) -> int:
        """Largest number of estimates of each pixel."""
        height, width = self.samples.shape[:2]
        short, full, most = _BATCHES
        least = short if self.contents == "short" else full
        return max(least, min(-(-_ESTIMATES // (height * width)), most))

    def trained(self, estimators: Sequence[str | Entry] | None) -> dict[str, Model]:
        """Return models that are not trained in the way of a comparison."""
        models, samples = {}, self.samples
        for name in DEFAULT_ESTIMATORS if estimators is None else estimators:
            entry = without_denoiser(entry_of(name))
            if isinstance(entry, LearnedEstimator) and entry.name in self.training:
                pixels = draw_pixels(samples.shape[:2], entry.pixels, seed=0)
                options = self.training[entry.name] | {"progress": self.progress}
                with contextlib.suppress(InputError):  # the comparison reports why
                    models[entry.name] = entry.train(samples, seed=0, pixels=pixels, **options)
        return models

    def estimated(self) -> Combination | None:
        """Return the default estimate from all samples; None if it cannot take them."""
        with contextlib.suppress(InputError):
            return cast("Combination", estimate(self.samples, progress=self.progress))
        return None

    def curve(self, comparison: Comparison) -> ErrorCurve | None:
        """Return errors of the compared estimators against N; None if there is only one N."""
        if self.samples.spp < _CURVE_SPP:
            return None
        model = next(iter(comparison.models.values()), None)
        # Other learned estimators would need another training, and take only one N.
        others = comparison.models.keys() - {"" if model is None else model.name}
        return error_curve(
            self.samples,
            [name for name in comparison.estimators if name not in others],
            max_batches=1,
            model=model,
            progress=self.progress,
        )


def _by_noise(regions: tuple[Region, ...], noise: NoiseShares) -> tuple[Region, ...]:
    """Order regions that are named after patterns by the noise of their pattern."""
    rank = {label.replace("_", "-"): i for i, label in enumerate(noise.share)}
    return tuple(sorted(regions, key=lambda region: rank.get(region.name, len(rank))))


def _some(regions: tuple[Region, ...], dataset: xr.Dataset) -> tuple[Region, ...]:
    """Return some of many regions, from the calmest to the noisiest, in their order.

    Regions in the same pixel count as one.
    """
    spread = dataset["coefficient_of_variation"].values
    regions = tuple({region.center(*spread.shape): region for region in regions}.values())
    calm = sorted(regions, key=lambda region: spread[region.center(*spread.shape)])
    places = np.linspace(0, len(calm) - 1, min(len(calm), _REGIONS)).round().astype(int)
    kept = [calm[i] for i in places]
    return tuple(region for region in regions if region in kept)
