"""Figures of a scene and of a comparison: results laid out for `chdstat.viz`.

`region_figure` and `scene_figures` follow the case study of Elek et al. 2019: regions with their
CHDs; batches and their means, the brightest firefly, shorter paths, shapes. `save_comparison`
writes a comparison to a folder, as numbers, maps and figures.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._core.arrays import is_bad, luminance
from chdstat._core.display import number, percent
from chdstat._core.files import replacing, unused, writing
from chdstat.analysis import Overview, save
from chdstat.comparison import Comparison, ErrorCurve
from chdstat.errors import StoreError
from chdstat.estimators import MLP, Progressive
from chdstat.inference import MORE_THAN_TESTED
from chdstat.patterns import Atlas
from chdstat.rendering.recipes import Region
from chdstat.reporting.content import with_others
from chdstat.samples import Samples
from chdstat.studies.claims import Finding, SceneData
from chdstat.studies.claims.whole_image import brightest_firefly
from chdstat.studies.run import SceneStudy
from chdstat.summary.histograms import Histogram, histogram
from chdstat.viz.styling import spelt

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = [
    "analysis_figures",
    "claim_figures",
    "depth_of",
    "of_comparison",
    "panels_of",
    "plot_findings",
    "region_figure",
    "report_figures",
    "save_comparison",
    "save_figure",
    "scene_figures",
]

_BATCH, _BATCHES = 32, 64
"""Samples of a batch, and batches of a pixel, as in the first figure of Elek et al. 2019."""
_SHOWN = {14, 15}
"""Claims whose plots would repeat the table of families and the figure of the training."""
_PIXELS = 5
"""Pixels whose batches are shown."""


# --- one scene ----------------------------------------------------------------------------------


def report_figures(found: SceneStudy, curve: ErrorCurve | None) -> dict[str, Figure]:
    """Draw the figures of a report, by name, as far as the scene has what they show."""
    data = found.data
    panels = panels_of(data)
    drawn = scene_figures(data, atlas=found.atlas)
    drawn["image"] = viz.with_marks(data.summary["mean"].values, _marks(data))
    if panels:
        drawn["chds"] = viz.chd_grid(panels)
    drawn |= analysis_figures(data.analysis, found.overview)
    shown = {f"{f.number} {f.name}": f for f in found.findings if f.number not in _SHOWN}
    plots = plot_findings(shown)
    if plots is not None:
        drawn["plots"] = plots
    if found.comparison is not None:
        drawn |= of_comparison(found.comparison, curve)
    return drawn


def panels_of(data: SceneData) -> list[viz.Panel]:
    """Return the CHD of the pixel in the middle of each region: histograms and best fits.

    Beside those of three channels the luminance of this pixel and of those in the corners.
    """
    samples, panels = data.samples, []
    for mark in _marks(data):
        panel = samples.pixel(*mark.pixel).panel(mark.name)
        if samples.shape[2] == 3:
            corners = itertools.product(*((s.start, s.stop - 1) for s in (mark.ys, mark.xs)))
            pixels = dict.fromkeys((mark.pixel, *corners))
            panel = panel.with_luminance(np.stack([samples[pixel] for pixel in pixels]))
        panels.append(panel)
    return panels


def _marks(data: SceneData) -> list[viz.Mark]:
    shape = data.samples.shape[:2]
    return [viz.Mark(r.name, *r.pixels(*shape), r.center(*shape)) for r in data.regions]


def region_figure(data: SceneData) -> Figure:
    """Draw the regions of a scene, each with the CHD of the pixel in its middle."""
    notes = [_note(region, data.summary) for region in data.regions]
    image = data.summary["mean"].values
    return viz.region_study(image, _marks(data), panels_of(data), notes=notes)


def scene_figures(data: SceneData, *, atlas: Atlas | None = None) -> dict[str, Figure]:
    """Draw the figures of a scene, by name, as far as it has what they show.

    Parameters
    ----------
    data
        The scene.
    atlas
        Shapes that recur.
    """
    marks = _marks(data)
    drawn: dict[str, Figure] = {}
    height, width = data.samples.shape[:2]
    pixels = {mark.name: mark.pixel for mark in marks[:_PIXELS]} or {
        "middle of the image": (height // 2, width // 2)
    }
    drawn["batches"] = viz.batch_histograms(
        {name: _batches(data.samples[pixel]) for name, pixel in pixels.items()}
    )
    firefly = _firefly(data)
    if firefly is not None:
        drawn["firefly"] = firefly
    if data.shorter is not None and data.shorter_summary is not None:
        drawn["paths"] = _paths(data, data.shorter, data.shorter_summary)
    if atlas is not None:
        drawn["atlas"] = viz.atlas(atlas)
    return drawn


def _note(region: Region, summary: xr.Dataset) -> str:
    null = summary["null_share"].values
    here = f"{percent(float(null[region.pixels(*null.shape)].mean()))} null"
    kind = region.phenomenon.replace("-", " ")
    return f"{kind}, {here}" if kind != region.name else here


def _batches(x: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the luminance of the first batches of a pixel (channel, sample); 0 for bad ones."""
    light = np.asarray(luminance(np.where(is_bad(x).any(axis=0), 0.0, x.astype(np.float64))))
    size = min(_BATCH, len(light))
    count = min(_BATCHES, len(light) // size)
    return light[: size * count].reshape(count, size)


def _firefly(data: SceneData) -> Figure | None:
    """Draw the brightest firefly and the pixel above it, which sees about the same."""
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
    linear, log = (
        {name: _histogram(values, scale) for name, values in samples.items()}
        for scale in ("linear", "log")
    )
    return viz.firefly_pair(means[..., batch], pixels, linear, log)


def _histogram(x: npt.NDArray[np.float32], scale: Any = "log") -> Histogram:
    return histogram(x, scale=scale, bad=is_bad(x))


def _paths(data: SceneData, shorter: Samples, summary: xr.Dataset) -> Figure:
    """Draw the view with shorter and with all paths; regions with all their samples together."""
    renders = {f"up to {depth_of(s)} segments": s for s in (shorter, data.samples)}
    means = (summary["mean"].values, data.summary["mean"].values)
    log = {
        region.name: {
            name: _histogram(samples.read(*region.pixels(*samples.shape[:2])).ravel())
            for name, samples in renders.items()
        }
        for region in data.regions
    }
    return viz.view_pair(dict(zip(renders, means, strict=True)), log)


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
    # What is about all scenes, or the only one, needs no title.
    titles = found if len(found) > 1 else [""] * len(found)
    shown = plot_findings(dict(zip(titles, found.values(), strict=True)))
    if shown is not None:
        drawn[f"plots{claim}"] = shown
    return drawn


def plot_findings(found: Mapping[str, Finding]) -> Figure | None:
    """Draw what findings show, each under its title; None where none has anything to show."""
    shown = {
        title: finding.plot_data
        for title, finding in found.items()
        if any(np.isfinite(np.asarray(y)).any() for _, y in finding.plot_data.series.values())
    }
    return viz.finding_plots(shown) if shown else None


# --- the analysis of an image -------------------------------------------------------------------


def analysis_figures(found: xr.Dataset, scene: Overview) -> dict[str, Figure]:
    """Draw the maps of the image, and how averages become Gaussian where there are enough."""
    drawn = {"maps": _maps(found)}
    if scene.averages:
        shares = found["averages_rejected_share"]
        names = found["channel"].values
        drawn["averages"] = viz.averages(
            list(scene.averages),
            {str(name): shares.sel(channel=name).values for name in names},
            scene.skewness,
            scene.predicted_skewness,
            alpha=float(found.attrs["false_discovery_rate"]),
        )
    return drawn


def _maps(found: xr.Dataset) -> Figure:
    skewness = found["normality_skewness"].sel(transform="log").mean("channel")
    misfit = found["best_goodness_effect"].sel(fit_test="kolmogorov-smirnov").mean("channel")
    shown: dict[str, tuple[xr.DataArray, tuple[float, float] | None]] = {
        "Share of null samples": (found["null_share"], (0, 1)),
        "Coefficient of variation": (found["coefficient_of_variation"], None),
        "Tail index ξ without fireflies": (found["long_tail_statistic"], (-0.5, 1.0)),
        "Best family": (found["luminance_family"], None),
        "Misfit of the best family": (misfit, (0, 0.2)),
        "Skewness of log samples": (skewness, None),
        "Primary pattern": (found["label"], None),
        "Agreement with neighbours": (found["label_agreement"], (0, 1)),
    }
    averaged = "averages_n_needed" in found
    aspect = found.sizes["y"] / found.sizes["x"]
    figure = viz.map_grid(len(shown) + averaged, aspect=aspect)
    axes = figure.axes
    for ax, (title, (values, limits)) in zip(axes, shown.items(), strict=False):
        if "flag_meanings" in values.attrs:
            # Tables have the shares, of channels and of all patterns that a pixel shows.
            viz.categorical_map(values, title=title, shares=False, ax=ax)
        else:
            signed = title.startswith("Skewness")
            viz.value_map(values.values, title=title, limits=limits, diverging=signed, ax=ax)
    if averaged:
        # Of the channel that needs most: -1 where that is more than was tested.
        n = found["averages_n_needed"].transpose("y", "x", "channel").values
        more = (n == MORE_THAN_TESTED).any(axis=-1)
        slowest = np.where(more, MORE_THAN_TESTED, n.max(axis=-1))
        viz.n_needed(slowest, found["size"], ax=axes[-1])
    return figure


# --- a comparison -------------------------------------------------------------------------------


def of_comparison(found: Comparison, curve: ErrorCurve | None = None) -> dict[str, Figure]:
    """Draw everything that a comparison found, by name, as far as it has been measured."""
    names = found.estimators
    images: dict[str, npt.ArrayLike] = dict(zip(names, found.estimates, strict=True))
    squares = [error.mean(axis=-1) for error in found.squared_error]
    drawn: dict[str, Any] = {
        "estimates": viz.side_by_side(
            images | {"reference": found.reference}, errors=dict(zip(names, squares, strict=True))
        ),
        "measures": viz.estimator_measures(found),
        "pixels": viz.pixel_estimates(found.draw_pixels()).figure,
    }
    if found.breakdown is not None:
        drawn["breakdown"] = viz.pattern_breakdown(found.breakdown).figure
    if curve is not None:
        drawn["curve"] = viz.error_curves(curve)
    for model in found.models.values():
        if isinstance(model, MLP):
            drawn["training"] = viz.training(model.history).figure
        if isinstance(model, Progressive):
            drawn["training_progressive"] = viz.training(model.history).figure
    return drawn


def save_comparison(
    found: Comparison, folder: str | Path, *, curve: ErrorCurve | None = None
) -> list[Path]:
    """Write a comparison to a new folder, which is there when it is complete.

    ``comparison.json`` holds every measure, ``comparison.zarr`` the estimates and errors as maps,
    one PDF each figure, ``<name>.safetensors`` each estimator that was trained.

    Parameters
    ----------
    found
        What `chdstat.compare` found.
    folder
        Where to; nothing may be there.
    curve
        What `chdstat.comparison.error_curve` found, to go with it.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    StoreError
        If something is there already, or cannot be written.
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
                for name, figure in of_comparison(found, curve).items():
                    figure.savefig(partial / f"{name}.pdf", metadata={"CreationDate": None})
            for name, model in found.models.items():
                if isinstance(model, (MLP, Progressive)):
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
