"""Figures of a scene and of a comparison, drawn by `chdstat.viz`.

`FIGURES` is the table of the figures of a report on a scene. Most follow the case study of Elek et
al. 2019: regions with their CHDs, batches and their means, the brightest firefly, shorter paths,
and shapes. `save_comparison` writes a comparison to a folder, as numbers, maps and figures.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._core.arrays import is_bad, luminance
from chdstat._core.display import number, percent
from chdstat._core.files import replacing, unused, writing
from chdstat._core.image_scales import worst_parts
from chdstat.analysis import save
from chdstat.comparison import Comparison, ErrorCurve
from chdstat.comparison.estimator_choice import DEFAULT_ESTIMATE
from chdstat.comparison.metrics import shown_ratio
from chdstat.errors import StoreError
from chdstat.estimators.registry import Estimates
from chdstat.estimators.training import TrainedModel
from chdstat.inference import MORE_THAN_TESTED
from chdstat.reporting.content import with_others
from chdstat.reporting.headlines import FEW_PIXELS, FEW_SAMPLES
from chdstat.samples import Samples
from chdstat.studies.claims import Finding, SceneData
from chdstat.studies.claims.whole_image import brightest_firefly
from chdstat.studies.studies import SceneStudy
from chdstat.viz.results import panel_of
from chdstat.viz.styling import NAMES, estimator_name, spelt, upright

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BATCH, _BATCHES = 32, 64
"""Samples of a batch, and batches of a pixel, as in the first figure of Elek et al. 2019."""
_PIXELS = 5
"""Pixels whose batches are shown."""
_COMPARED = 4
"""Most regions whose CHDs of shorter and of longer paths are compared."""
_PAIR = 5.2
"""Width of a figure of two images, in inches."""
_TITLE = 52
"""Most letters above the distribution of a region."""


# --- what figures show ----------------------------------------------------------------------------


@dataclass(frozen=True)
class ReportData:
    """What the figures of a report show; of a comparison alone, there is no study.

    Attributes
    ----------
    study
        The scene.
    comparison
        Estimators compared on it.
    estimate
        The default estimate from all samples, shown without a comparison.
    curve
        Errors against the number of samples.
    full
        Whether the report is a full one.
    """

    study: SceneStudy | None = None
    comparison: Comparison | None = None
    estimate: Estimates | None = None
    curve: ErrorCurve | None = None
    full: bool = True

    @property
    def data(self) -> SceneData:
        """Samples, regions and analysis of the scene."""
        assert self.study is not None, "figures of a scene need one"
        return self.study.data

    @property
    def small(self) -> bool:
        """Whether there are too few pixels for maps."""
        height, width = self.data.samples.shape[:2]
        return height * width < FEW_PIXELS

    @property
    def noisy(self) -> bool:
        """Whether there is noise to be mapped."""
        return not self.small and bool(self.study and self.study.noise)

    @property
    def enough(self) -> bool:
        """Whether there are enough samples for distributions."""
        return self.data.samples.spp >= FEW_SAMPLES


@dataclass(frozen=True)
class ReportFigure:
    """A row of `FIGURES`.

    Attributes
    ----------
    name, part
        Of the figure, which the text refers to by it, and of the part of the report where it is.
    draw
        Returns the figure; None if there is nothing to show.
    caption
        In the markup of Typst, where ``data`` has the entries of the report, and ``has`` tells
        whether there is a figure.
    full
        Whether only a full report has it.
    """

    name: str
    part: str
    draw: Callable[[ReportData], Figure | None]
    caption: str
    full: bool = False


def drawn(shown: ReportData, figures: Iterable[ReportFigure]) -> dict[str, Figure]:
    """Draw figures that there is something to show of, by name."""
    found = {figure.name: figure.draw(shown) for figure in figures}
    return {name: figure for name, figure in found.items() if figure is not None}


def report_figures(shown: ReportData) -> tuple[dict[str, Figure], list[dict[str, str]]]:
    """Draw the figures of a report; return them, and where they go with which caption."""
    parts = [figure for figure in FIGURES if shown.noisy or figure.part == "regions"]
    figures = drawn(shown, [figure for figure in parts if shown.full or not figure.full])
    placed = [
        {"name": figure.name, "part": figure.part, "caption": figure.caption}
        for figure in FIGURES
        if figure.name in figures
    ]
    return figures, placed


def scene_figures(study: SceneStudy) -> dict[str, Figure]:
    """Draw the figures of a scene of a study that it has data for, by name.

    A study shows the regions that claims are about, however few their samples are.
    """
    of_scene = ("case study", "shapes")
    found = drawn(ReportData(study), [figure for figure in FIGURES if figure.part in of_scene])
    return ({"regions": _region_study(study.data)} if study.data.regions else {}) | found


# --- one scene ------------------------------------------------------------------------------------


def marks_of(data: SceneData) -> list[viz.Mark]:
    """Return the regions of a scene with the pixels that they show."""
    shape = data.samples.shape[:2]
    return [
        viz.Mark(NAMES.get(r.name, r.name), *r.pixels(*shape), r.center(*shape))
        for r in data.regions
    ]


def _alone(shown: ReportData) -> Figure | None:
    """Draw the few pixels of a small image."""
    if not (shown.small and shown.enough):
        return None
    data = shown.data
    panels = [panel_of(data.samples.pixel(*mark.pixel), mark.name) for mark in marks_of(data)]
    return viz.chd_pair(panels[0]) if len(panels) == 1 else viz.chd_grid(panels, columns=2)


def _regions(shown: ReportData) -> Figure | None:
    """Draw the regions of a scene, if there is enough to see."""
    data = shown.data
    seen = bool((data.summary["mean"].values > 0).any())
    if shown.small or not shown.enough or not data.regions or not seen:
        return None
    return _region_study(data)


def _region_study(data: SceneData) -> Figure:
    """Draw the regions of a scene, each with the CHD of its central pixel."""
    marks, notes = marks_of(data), []
    pixels = [data.samples.pixel(*mark.pixel) for mark in marks]
    for mark, pixel in zip(marks, pixels, strict=True):
        spread = number(float(data.analysis["coefficient_of_variation"][mark.pixel]))
        note = f"{percent(pixel.null_share)} null" + f", SD/mean {spread}" * (spread != "—")
        curve = pixel.curve(-1)
        words = curve.name or curve.reason
        room = len(mark.name) + len(note) + len(words) < _TITLE
        notes.append(note + f", {words}" * (bool(words) and room))
    panels = [panel_of(pixel, mark.name) for mark, pixel in zip(marks, pixels, strict=True)]
    return viz.region_study(data.summary["mean"].values, marks, panels, notes=notes)


def _noise_maps(shown: ReportData) -> Figure | None:
    """Draw the noise and the primary pattern of each pixel."""
    if not shown.enough:
        return None
    found = shown.data.analysis
    aspect = upright(found.sizes["y"], found.sizes["x"])
    figure = viz.map_grid(2, columns=2, aspect=aspect)
    figure.set_figheight(0.43 * figure.get_figwidth() * aspect + 0.3)  # there is no legend
    left, right = figure.axes
    title = "Standard deviation over mean"
    viz.value_map(found["coefficient_of_variation"].values, title=title, ax=left)
    viz.categorical_map(found["label"], title="Pattern", ax=right)
    right.legend_ = None  # the table below has the colours
    return figure


def _estimates(shown: ReportData) -> Figure | None:
    """Draw estimates from the first samples, with magnified parts where the mean is far off.

    The mean comes first, the default estimate second; others follow in a full report. Without a
    comparison, these two are from all samples.
    """
    found = shown.comparison
    if found is None:
        if shown.estimate is None:
            return None
        image, spp = shown.data.summary["mean"].values, shown.data.samples.spp_range
        both = {f"mean of {spp}": image, "default estimate": shown.estimate.radiance}
        parts = worst_parts(*both.values())
        return viz.side_by_side(both, insets=parts, width=_PAIR)
    names = found.estimators[: None if shown.full else 2]
    images = dict(zip(found.estimators, found.estimates, strict=True))
    order = ["mean", DEFAULT_ESTIMATE, *images]
    chosen = [n for n in dict.fromkeys(order) if n in names]
    notes = {
        estimator_name(row["estimator"]): f"relMSE {shown_ratio(row, 'relmse_ratio')} × the mean's"
        for row in found.table()
        if row["estimator"] != "mean" and np.isfinite(row["relmse_ratio"])
    }
    named: dict[str, npt.ArrayLike] = {estimator_name(name): images[name] for name in chosen}
    return viz.side_by_side(
        named | {"reference": found.reference},
        insets=worst_parts(found.first_mean, found.reference),
        notes=notes | {"reference": "mean of all samples"},
        columns=3,
    )


def _batch_histograms(shown: ReportData) -> Figure:
    data = shown.data
    height, width = data.samples.shape[:2]
    pixels = {mark.name: mark.pixel for mark in marks_of(data)[:_PIXELS]} or {
        "middle of the image": (height // 2, width // 2)
    }
    return viz.batch_histograms({n: batches_of(data.samples[pixel]) for n, pixel in pixels.items()})


def batches_of(x: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the luminance of the first batches of a pixel (channel, sample); 0 for bad ones."""
    light = np.asarray(luminance(np.where(is_bad(x).any(axis=0), 0.0, x.astype(np.float64))))
    size = min(_BATCH, len(light))
    count = min(_BATCHES, len(light) // size)
    return light[: size * count].reshape(count, size)


def _firefly(shown: ReportData) -> Figure | None:
    """Draw the brightest firefly and the pixel above it, which shows about the same."""
    data = shown.data
    means, batches = data.summary["batch_means"].values, data.batch_light
    found = brightest_firefly(batches)
    if found is None:
        return None
    y, x, batch = found
    pixels = {
        f"{name}: {number(float(batches[pixel][batch]))}": pixel
        for name, pixel in (("firefly", (y, x)), ("neighbour", (y - 1, x)))
    }
    middle = data.samples.shape[2] // 2
    samples = {name: data.samples[pixel][middle] for name, pixel in pixels.items()}
    return viz.firefly_pair(means[..., batch], pixels, samples)


def _paths(shown: ReportData) -> Figure | None:
    """Draw the view with shorter and with all paths, and regions with all samples pooled."""
    data = shown.data
    shorter, summary = data.shorter, data.shorter_summary
    if shorter is None or summary is None:
        return None
    renders = {f"up to {depth_of(s)} segments": s for s in (data.samples, shorter)}
    means = (data.summary["mean"].values, summary["mean"].values)
    marks = marks_of(data)[:_COMPARED]
    pooled = {
        name: [np.concatenate(np.concatenate(samples.read(m.ys, m.xs)), axis=-1) for m in marks]
        for name, samples in renders.items()
    }
    return viz.renders_contrasted(dict(zip(renders, means, strict=True)), pooled, marks)


def _atlas(shown: ReportData) -> Figure | None:
    found = None if shown.study is None else shown.study.atlas
    return None if found is None else viz.atlas(found)


def _curve(shown: ReportData) -> Figure | None:
    return None if shown.curve is None else viz.error_curves(shown.curve)


def depth_of(samples: Samples) -> str:
    """Return the maximum path length of samples in words."""
    depth = int(dict(samples.attrs.get("integrator") or {}).get("max_depth", 0))
    return "∞" if depth < 0 else str(depth or "—")


# --- claims -------------------------------------------------------------------------------------


def claim_figures(claim: int, found: Mapping[str, Finding]) -> dict[str, Figure]:
    """Draw findings on one claim, by scene: intervals, and what the findings show."""
    drawn = {}
    tests = {name: finding.tests for name, finding in with_others(found).items() if finding.tests}
    if tests:
        drawn[f"claim{claim}"] = viz.claim_intervals(tests)
    # A finding on all scenes, or on the only one, needs no title.
    titles = found if len(found) > 1 else [""] * len(found)
    shown = {
        title: finding.plot_data
        for title, finding in zip(titles, found.values(), strict=True)
        if any(np.isfinite(np.asarray(y)).any() for _, y in finding.plot_data.series.values())
    }
    if shown:
        drawn[f"plots{claim}"] = viz.finding_plots(shown)
    return drawn


def _averages(shown: ReportData) -> Figure | None:
    """Draw how averages become Gaussian, if there are enough samples."""
    if shown.study is None or not shown.study.overview.averages:
        return None
    found, scene = shown.data.analysis, shown.study.overview
    shares = found["averages_rejected_share"]
    return viz.averages(
        list(scene.averages),
        {str(name): shares.sel(channel=name).values for name in found["channel"].values},
        scene.skewness,
        scene.predicted_skewness,
        alpha=float(found.attrs["false_discovery_rate"]),
    )


def _maps(shown: ReportData) -> Figure:
    """Draw nulls, error bars and families, and the samples that an average needs to be Gaussian."""
    found = shown.data.analysis
    averaged = "averages_n_needed" in found
    figure = viz.map_grid(3 + averaged, columns=2, aspect=found.sizes["y"] / found.sizes["x"])
    nulls, tails, families, *needed = figure.axes
    viz.value_map(
        found["null_share"].values, title="Share of null samples", limits=(0, 1), ax=nulls
    )
    title = "Error bars of 95 % that miss"
    viz.value_map(found["long_tail_statistic"].values, title=title, limits=(0, 0.5), ax=tails)
    named = found["luminance_family"]
    viz.categorical_map(named, title="Best family", shares=False, columns=3, ax=families)
    if averaged:
        # The channel that needs most samples; -1 if more than tested.
        n = found["averages_n_needed"].transpose("y", "x", "channel").values
        more = (n == MORE_THAN_TESTED).any(axis=-1)
        slowest = np.where(more, MORE_THAN_TESTED, n.max(axis=-1))
        viz.n_needed(slowest, found["size"], ax=needed[0])
    return figure


def _within_pixels(shown: ReportData) -> Figure | None:
    """Draw how much of the variance is the picture changing within the pixel, where known."""
    split = shown.data.film_split
    if split is None:
        return None
    figure = viz.map_grid(1, columns=1, aspect=split.sizes["y"] / split.sizes["x"], width=_PAIR / 2)
    viz.film_split(split, ax=figure.axes[0])
    return figure


# --- a comparison ---------------------------------------------------------------------------------


def _pixel_estimates(shown: ReportData) -> Figure | None:
    if shown.comparison is None:
        return None
    return cast("Figure", viz.pixel_estimates(shown.comparison.draw_pixels()).figure)


def _breakdown(shown: ReportData) -> Figure | None:
    found = None if shown.comparison is None else shown.comparison.breakdown
    return None if found is None else cast("Figure", viz.pattern_breakdown(found).figure)


def _training(shown: ReportData) -> Figure | None:
    models = [] if shown.comparison is None else shown.comparison.models.values()
    trained = [model for model in models if isinstance(model, TrainedModel)]
    return cast("Figure", viz.training(trained[-1].history).figure) if trained else None


# --- the table ------------------------------------------------------------------------------------

FIGURES = (
    ReportFigure("regions", "regions", _regions, """
*Regions of the image, and what is averaged there.* Beside each region the luminance of all samples
of its framed pixel. #if data.regions_chosen [The library chose the regions: a pixel of each
pattern, those that hold most of the noise first.] A mean far to the right of the hump rests on rare
bright samples and needs many of them; two humps are two kinds of paths. Null samples, whose
channels are all 0, are counted in the title; SD/mean is the standard deviation of all samples over
their mean."""),
    ReportFigure("alone", "regions", _alone, """
*The samples*, channel by channel, on a linear (left) and a logarithmic scale, without nulls. Curves
are the family or the mixture that describes the samples, dashed lines the means."""),
    ReportFigure("noise", "noise", _noise_maps, """
*Noise and patterns.* Left: standard deviation of the samples over their mean, of luminance; the
scale covers 98 % of the pixels. Right: the pattern of each pixel, in the colours of
@patterns, found at a false-discovery rate of #data.alpha over the image; of several, the first of
#data.order."""),
    ReportFigure("estimates", "estimates", _estimates, """
*The image from #if "estimators" in data [#data.estimators.n samples, by estimators, beside the
reference] else [#data.spp samples: their mean, and the default estimate]*, under one exposure. The
frames mark where the mean is furthest #if "estimators" in data [too bright] else [above the
estimate]: compare which fireflies are gone there, and how much light with them."""),
    ReportFigure("batches", "case study", _batch_histograms, """
*Pixels: batches and their means*, after the first figure of @elek2019: luminance of single samples
in superimposed batches (black: their average; the axis ends where 1 % of the samples are brighter),
and of the batch means. Dashed: the mean of all batches.""", full=True),
    ReportFigure("firefly", "case study", _firefly, """
*Fireflies: the brightest firefly and its neighbour.* Left: the estimate from 32 samples in which it
is seen; right: the distributions of all samples of both pixels, in the middle channel. The numbers
are luminances in that estimate.""", full=True),
    ReportFigure("paths", "case study", _paths, """
*Path lengths.* The view with all and with shorter paths under one exposure, and the log histograms
of the luminance of regions.""", full=True),
    ReportFigure("maps", "maps", _maps, """
*What else varies over the image.* Share of null samples; share of 95 % error bars of so many
samples that miss, by the pixel and those around it (above #data.thresholds.misses the tail is
long); family of luminance with the smallest BIC#if has("averages") [; and the least N at which
normality of averages is not rejected, in the channel that needs most]. Grey pixels have too few
usable samples.""", full=True),
    ReportFigure("within", "maps", _within_pixels, """
*The picture within pixels.* Share of the variance of luminance that is between places in the pixel,
as at an edge, where it is significant at a false-discovery rate of 5 %; strata over the pixel take
it away. The rest is of paths.""", full=True),
    ReportFigure("atlas", "shapes", _atlas, """
*Atlas of shapes*: histograms of log luminance, aligned by the mean of log10 radiance so that
brightness does not count, and grouped by k-means in Cramér's distance @cramer1928. Left: the shape
of each pixel; numbers mark the most typical one. Right: density of each shape with the quartiles
over its pixels. Shapes are learned from one half of the samples and tested on the other:
#data.atlas.repeatable of the variation between pixels repeats; labels from the two halves agree
with an adjusted Rand index of #data.atlas.stability. Where this is well below 1, the shapes are
landmarks in a continuum.""", full=True),
    ReportFigure("averages", "averages", _averages, """
*Averages of N samples against the central limit theorem.* Left: share of the pixels, by channel,
for whose averages normality is rejected; the dotted line is the false-discovery rate. Right:
skewness of the averages (median and quartiles over the pixels) and the $gamma_1 \\/ sqrt(N)$ that
the theorem predicts (dashed). The fewer averages there are, the more their measured skewness is
biased towards 0.""", full=True),
    ReportFigure("breakdown", "estimators", _breakdown, """
*Which estimator for which pattern.* Relative squared error over that of the mean, for the pixels of
each first pattern; the smallest of those that look at one pixel is framed, pale numbers cannot be
distinguished from the mean, and bold ones with a sign are surely worse. Labels come from the same
samples: where one batch made a pixel firefly-dominated, any robust estimator gains.""", full=True),
    ReportFigure("curve", "estimators", _curve, """
*Error against the number of samples*, with 95 % intervals over blocks of pixels.""", full=True),
    ReportFigure("pixels", "estimators", _pixel_estimates, """
*Pixels one by one*, after @elek2019: the reference as a bar, the mean as a ring, and the estimates.
An estimate improves where it ends up closer to the bar.""", full=True),
    ReportFigure("training", "estimators", _training, """
*Training* of the network of the paper: loss on the training and validation batches against the
error of the sample mean on the same batches (dashed). Below its line the network beats the mean; a
validation curve that turns upwards is overfitting.""", full=True),
)  # fmt: skip
"""Figures of a report on a scene. A further one is a row here, and a function in `chdstat.viz`."""
_OF_COMPARISON = ("estimates", "estimators")


def save_comparison(
    found: Comparison, folder: str | Path, *, curve: ErrorCurve | None = None
) -> list[Path]:
    """Write a comparison to a new folder, which appears when it is complete.

    ``comparison.json`` holds all measures, ``comparison.zarr`` the estimates and errors as maps.
    Each figure is a PDF, each trained estimator ``<name>.safetensors``.

    Parameters
    ----------
    found
        Result of `chdstat.compare`.
    folder
        The folder; it must not exist.
    curve
        Result of `chdstat.comparison.error_curve`, written too.

    Returns
    -------
    list of Path
        The written files.

    Raises
    ------
    StoreError
        If the folder exists or cannot be written.
    """
    target = unused(folder)
    content = found.to_dict() | ({} if curve is None else {"curve": curve.to_dict()})
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with replacing(target, folder=True) as partial:
            text = json.dumps(content, indent=2, allow_nan=False)
            (partial / "comparison.json").write_text(text, encoding="utf-8")
            save(found.to_dataset(), partial / "comparison.zarr")
            with spelt():
                compared = [figure for figure in FIGURES if figure.part in _OF_COMPARISON]
                figures = drawn(ReportData(comparison=found, curve=curve), compared)
                for name, figure in ({"measures": viz.estimator_measures(found)} | figures).items():
                    figure.savefig(partial / f"{name}.pdf", metadata={"CreationDate": None})
            for name, model in found.models.items():
                if isinstance(model, TrainedModel):
                    model.save(partial / f"{name}.safetensors")
    except OSError as error:
        message = f"cannot write to {target}: {error.strerror or error}"
        raise StoreError(message) from error
    return sorted(target.iterdir())


def save_figure(figure: Figure, target: Path) -> Path:
    """Write a figure to a file, whose suffix is its format.

    Raises
    ------
    StoreError
        If it cannot be written.
    """
    metadata = {"CreationDate": None} if target.suffix.lower() == ".pdf" else None
    with writing(target) as partial:
        figure.savefig(partial, metadata=metadata)
    return target
