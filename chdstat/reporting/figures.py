"""Figures of a scene and of a comparison, drawn by `chdstat.viz`.

`region_figure` and `scene_figures` follow the case study of Elek et al. 2019: regions with their
CHDs, batches and their means, the brightest firefly, shorter paths, and shapes. `save_comparison`
writes a comparison to a folder, as numbers, maps and figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
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
from chdstat.comparison.entries import DEFAULT_ESTIMATE
from chdstat.errors import StoreError
from chdstat.estimators.registry import Estimates
from chdstat.estimators.training import TrainedModel
from chdstat.inference import MORE_THAN_TESTED
from chdstat.patterns import Atlas
from chdstat.reporting.content import FEW_PIXELS, FEW_SAMPLES, with_others
from chdstat.samples import Samples
from chdstat.studies.claims import Finding, SceneData
from chdstat.studies.claims.whole_image import brightest_firefly
from chdstat.studies.studies import SceneStudy
from chdstat.viz.results import panel_of
from chdstat.viz.styling import NAMES, called, estimator_name, spelt, upright

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

_BATCH, _BATCHES = 32, 64
"""Samples of a batch, and batches of a pixel, as in the first figure of Elek et al. 2019."""
_PIXELS = 5
"""Pixels whose batches are shown."""
_COMPARED = 4
"""Most regions whose CHDs of shorter and of longer paths are compared."""
_PAIR = 5.2
"""Width of a figure of two images, in inches."""
_TITLE = 46
"""Most letters above the distribution of a region."""
_INSETS, _INSET = 2, 6
"""Number of magnified parts; their edge is this fraction of the image's shorter edge."""


# --- one scene ----------------------------------------------------------------------------------


def report_figures(
    found: SceneStudy, estimate: Estimates | None, curve: ErrorCurve | None, *, full: bool
) -> dict[str, Figure]:
    """Draw the figures of a report that the scene has data for, by name.

    Parameters
    ----------
    found
        The scene.
    estimate
        The default estimate from all samples, shown without a comparison.
    curve
        Errors against the number of samples.
    full
        Whether to draw all figures.
    """
    data = found.data
    drawn: dict[str, Figure] = {}
    height, width, _, spp = data.samples.shape
    small, image = height * width < FEW_PIXELS, data.summary["mean"].values
    if spp >= FEW_SAMPLES and small:
        panels = [panel_of(data.samples.pixel(*mark.pixel), mark.name) for mark in _marks(data)]
        alone = len(panels) == 1
        drawn["alone"] = viz.chd_pair(panels[0]) if alone else viz.chd_grid(panels, columns=2)
    elif spp >= FEW_SAMPLES and (image > 0).any():
        drawn["regions"] = region_figure(data)
    if small or not found.noise:
        return drawn
    if spp >= FEW_SAMPLES:
        drawn["noise"] = _noise_maps(data.analysis)
    if full:
        drawn |= scene_figures(data, atlas=found.atlas)
        drawn |= _analysis_figures(data.analysis, found.overview)
    if found.comparison is not None:
        if full:
            drawn |= _of_comparison(found.comparison, curve)
        else:
            drawn["estimates"] = _estimates_of(found.comparison, found.comparison.estimators[:2])
    elif estimate is not None:
        images = {f"mean of {data.samples.spp_range}": image, "default estimate": estimate.radiance}
        parts = _noisy_parts(*images.values())
        drawn["estimates"] = viz.side_by_side(images, insets=parts, width=_PAIR)
    return drawn


def _marks(data: SceneData) -> list[viz.Mark]:
    shape = data.samples.shape[:2]
    return [
        viz.Mark(NAMES.get(r.name, r.name), *r.pixels(*shape), r.center(*shape))
        for r in data.regions
    ]


def region_figure(data: SceneData) -> Figure:
    """Draw the regions of a scene, each with the CHD of its central pixel."""
    marks, notes = _marks(data), []
    pixels = [data.samples.pixel(*mark.pixel) for mark in marks]
    for mark, pixel in zip(marks, pixels, strict=True):
        spread = number(float(data.analysis["coefficient_of_variation"][mark.pixel]))
        note = f"{percent(pixel.null_share)} null" + f", SD/mean {spread}" * (spread != "—")
        words = "" if pixel.curve is None else called(pixel.curve.name)
        room = len(mark.name) + len(note) + len(words) < _TITLE
        notes.append(note + f", {words}" * (bool(words) and room))
    panels = [panel_of(pixel, mark.name) for mark, pixel in zip(marks, pixels, strict=True)]
    return viz.region_study(data.summary["mean"].values, marks, panels, notes=notes)


def _noise_maps(found: xr.Dataset) -> Figure:
    """Draw the noise and the primary pattern of each pixel."""
    aspect = upright(found.sizes["y"], found.sizes["x"])
    figure = viz.map_grid(2, columns=2, aspect=aspect)
    figure.set_figheight(0.43 * figure.get_figwidth() * aspect + 0.3)  # there is no legend
    left, right = figure.axes
    title = "Standard deviation over mean"
    viz.value_map(found["coefficient_of_variation"].values, title=title, ax=left)
    viz.categorical_map(found["label"], title="First pattern", ax=right)
    right.legend_ = None  # the table below has the colours
    return figure


def _estimates_of(found: Comparison, names: Sequence[str] | None = None) -> Figure:
    """Draw estimates from the first samples, with magnified parts where the mean is far off.

    `names` None takes all estimators; the mean comes first, the default estimate second.
    """
    images = dict(zip(found.estimators, found.estimates, strict=True))
    order = ["mean", DEFAULT_ESTIMATE, *images]
    chosen = [n for n in dict.fromkeys(order) if n in images and (names is None or n in names)]
    notes = {
        estimator_name(row["estimator"]): f"relMSE {number(row['relmse'])}, "
        f"{number(row['relmse_ratio'])} × the mean's"
        for row in found.table()
        if np.isfinite(row["relmse_ratio"])
    }
    shown: dict[str, npt.ArrayLike] = {estimator_name(name): images[name] for name in chosen}
    return viz.side_by_side(
        shown | {"reference": found.reference},
        insets=_noisy_parts(found.first_mean, found.reference),
        notes=notes | {"reference": "mean of all samples"},
        columns=3,
    )


def _noisy_parts(image: npt.ArrayLike, better: npt.ArrayLike) -> list[tuple[slice, slice]]:
    """Return the parts of an image that exceed a better image most."""
    seen, truth = (np.asarray(i, np.float64).mean(axis=-1) for i in (image, better))
    level = float(np.nanmean(truth)) or 1.0  # of excess that is seen, not only in the dark
    excess = np.nan_to_num((seen - truth) / (np.abs(truth) + level))
    height, width = excess.shape
    edge = min(height, width, max(8, min(height, width) // _INSET))
    parts: list[tuple[slice, slice]] = []
    while len(parts) < _INSETS and excess.max() > 0:
        y, x = np.unravel_index(excess.argmax(), excess.shape)
        top = int(np.clip(y - edge // 2, 0, height - edge))
        left = int(np.clip(x - edge // 2, 0, width - edge))
        parts.append((slice(top, top + edge), slice(left, left + edge)))
        excess[max(0, top - edge // 2) : top + 3 * edge // 2,
               max(0, left - edge // 2) : left + 3 * edge // 2] = 0  # fmt: skip
    return parts


def scene_figures(data: SceneData, *, atlas: Atlas | None = None) -> dict[str, Figure]:
    """Draw the figures of a scene that it has data for, by name.

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


def _batches(x: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the luminance of the first batches of a pixel (channel, sample); 0 for bad ones."""
    light = np.asarray(luminance(np.where(is_bad(x).any(axis=0), 0.0, x.astype(np.float64))))
    size = min(_BATCH, len(light))
    count = min(_BATCHES, len(light) // size)
    return light[: size * count].reshape(count, size)


def _firefly(data: SceneData) -> Figure | None:
    """Draw the brightest firefly and the pixel above it, which shows about the same."""
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


def _paths(data: SceneData, shorter: Samples, summary: xr.Dataset) -> Figure:
    """Draw the view with shorter and with all paths, and regions with all samples pooled."""
    renders = {f"up to {depth_of(s)} segments": s for s in (data.samples, shorter)}
    means = (data.summary["mean"].values, summary["mean"].values)
    marks = _marks(data)[:_COMPARED]
    pooled = {
        name: [np.concatenate(np.concatenate(samples.read(m.ys, m.xs)), axis=-1) for m in marks]
        for name, samples in renders.items()
    }
    return viz.renders_compared(dict(zip(renders, means, strict=True)), pooled, marks)


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


# --- the analysis of an image -------------------------------------------------------------------


def _analysis_figures(found: xr.Dataset, scene: Overview) -> dict[str, Figure]:
    """Draw the maps of the image, and how averages become Gaussian if there are enough samples."""
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
    """Draw nulls, error bars and families, and the samples that an average needs to be Gaussian."""
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


# --- a comparison -------------------------------------------------------------------------------


def _of_comparison(found: Comparison, curve: ErrorCurve | None = None) -> dict[str, Figure]:
    """Draw all figures of a comparison, by name."""
    drawn: dict[str, Any] = {
        "estimates": _estimates_of(found),
        "pixels": viz.pixel_estimates(found.draw_pixels()).figure,
    }
    if found.breakdown is not None:
        drawn["breakdown"] = viz.pattern_breakdown(found.breakdown).figure
    if curve is not None:
        drawn["curve"] = viz.error_curves(curve)
    for model in found.models.values():
        if isinstance(model, TrainedModel):
            drawn["training"] = viz.training(model.history).figure
    return drawn


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
                measures = {"measures": viz.estimator_measures(found)}
                for name, figure in (measures | _of_comparison(found, curve)).items():
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
