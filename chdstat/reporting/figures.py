"""Figures of a scene's analysis and of a comparison: results handed to `chdstat.viz`.

`save_comparison` writes a comparison to a folder, as numbers, maps and figures.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._core.arrays import is_bad, is_null
from chdstat._core.files import replacing, unused
from chdstat.analysis import Overview, save
from chdstat.comparison import Comparison, ErrorCurve
from chdstat.errors import StoreError
from chdstat.estimators import MLP, Progressive
from chdstat.fit import select
from chdstat.inference import MORE_THAN_TESTED
from chdstat.rendering.recipes import Region
from chdstat.reporting.typst import NAMES, percent
from chdstat.samples import Samples
from chdstat.summary.histograms import Histogram, histogram
from chdstat.viz.styling import qualitative, spelt

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

    from chdstat.estimators.training import History
    from chdstat.fit import Fit

__all__ = [
    "averages",
    "chds",
    "color_of",
    "estimates",
    "maps",
    "marks_of",
    "names_of",
    "of_comparison",
    "panel_of",
    "save_comparison",
    "training",
]

_LABEL_COLORS = {
    "none": "#DDDDDD",
    "undetermined": "#DDDDDD",
    "black": "#222222",
    "constant": "#999999",
    "bimodal": "#CC79A7",
    "long tail": "#D55E00",
    "null heavy": "#0072B2",
    "gamma like": "#56B4E9",
    "lognormal like": "#009E73",
    "multimodal": "#882255",
    "firefly dominated": "#F0E442",
    "other": "#BBBBBB",
}


def color_of(index: int) -> str:
    """Return the colour of a region by its place."""
    return qualitative(index + 1)[index]


def names_of(variable: xr.DataArray) -> dict[int, str]:
    """Return the names of an integer-coded variable's values."""
    names = str(variable.attrs["flag_meanings"]).split()
    return {
        int(code): name.replace("_", " ")
        for code, name in zip(variable.attrs["flag_values"], names, strict=True)
    }


def marks_of(regions: Sequence[Region], samples: Samples) -> list[viz.Mark]:
    """Return the marks of regions in the image."""
    height, width = samples.shape[:2]
    return [viz.Mark(r.name, *r.pixels(height, width), r.center(height, width)) for r in regions]


def panel_of(samples: Samples, mark: viz.Mark) -> viz.Panel:
    """Return the CHD of a mark's pixel: histograms, best fits, share of nulls."""
    x = samples[mark.pixel]
    null = np.broadcast_to(is_null(x), x.shape)
    bad = np.broadcast_to(is_bad(x).any(axis=0), x.shape)
    selection = select(x, null=null)
    fits = [selection.fits[name] if name else None for name in np.atleast_1d(selection.names)]
    linear = histogram(x, scale="linear", null=null, bad=bad)
    log = histogram(x, scale="log", null=null, bad=bad)
    named = dict.fromkeys(NAMES.get(n, n) for n in np.atleast_1d(selection.names) if n)
    with np.errstate(invalid="ignore"):
        mean = np.where(bad, 0, x).sum(axis=-1) / np.maximum((~bad).sum(axis=-1), 1)
    return viz.Panel(
        name=mark.name,
        linear=_curves(linear, fits, samples.channels),
        log=_curves(log, fits, samples.channels),
        mean=dict(zip(samples.channels, mean.tolist(), strict=True)),
        note=f"{percent(float(null[0].mean()))} null, {' / '.join(named) or 'no fit'}",
    )


def _curves(
    counted: Histogram, fits: Sequence[Fit | None], channels: Sequence[str]
) -> dict[str, viz.Curve]:
    curves = {}
    bins = counted.counts.shape[-1]
    edges = np.broadcast_to(counted.edges, (len(channels), bins + 1))
    centers = np.broadcast_to(counted.centers, (len(channels), bins))
    for i, (channel, fit) in enumerate(zip(channels, fits, strict=True)):
        density = None if fit is None else _density(fit, i, centers[i], counted.scale)
        curves[channel] = viz.Curve(edges[i], counted.density[i], density)
    return curves


def _density(fit: Fit, channel: int, x: npt.NDArray[Any], scale: str) -> npt.NDArray[Any]:
    """Return a fit's density per unit of radiance, or per decade."""
    with np.errstate(all="ignore"):
        density = np.where(x > 0, fit.pdf(np.where(x > 0, x, 1))[channel], 0)
    return density * x * np.log(10) if scale == "log" else density


def chds(panels: Sequence[viz.Panel]) -> Figure:
    """Draw the CHDs of all regions."""
    return viz.chd_grid(panels)


def maps(found: xr.Dataset) -> Figure:
    """Draw the maps of the image."""
    height, width = found.sizes["y"], found.sizes["x"]
    skewness = found["normality_skewness"].sel(transform="log").mean("channel")
    misfit = found["best_goodness_effect"].sel(fit_test="kolmogorov-smirnov").mean("channel")
    draw = [
        viz.value_map(found["null_share"], title="Share of null samples", limits=(0, 1)),
        viz.value_map(found["coefficient_of_variation"], title="Coefficient of variation"),
        viz.value_map(found["long_tail_statistic"], title="Tail index ξ", limits=(-0.5, 1.0)),
        _categories(found["luminance_family"], "Best family"),
        viz.value_map(misfit, title="Misfit of the best family", limits=(0, 0.2)),
        viz.value_map(skewness, title="Skewness of log samples"),
        _categories(found["label"], "Primary pattern"),
        viz.value_map(found["label_agreement"], title="Agreement with neighbours", limits=(0, 1)),
    ]
    if "averages_n_needed" in found:
        draw.append(viz.n_needed(_slowest(found["averages_n_needed"]), found["size"]))
    return viz.map_grid(draw, columns=3, aspect=height / width)


def _slowest(needed: xr.DataArray) -> npt.NDArray[np.int64]:
    """Return the N of the channel that needs most, -1 for more than tested in any channel."""
    n = needed.transpose("y", "x", "channel").values
    return np.where((n == MORE_THAN_TESTED).any(axis=-1), MORE_THAN_TESTED, n.max(axis=-1))


def _categories(variable: xr.DataArray, title: str) -> Any:
    names = names_of(variable)
    shown = {code: NAMES.get(name, name) for code, name in names.items()}
    palette = [_LABEL_COLORS.get(name, viz.PALETTE[i % 8]) for i, name in enumerate(names.values())]
    return viz.categorical_map(variable.values, shown, title=title, colors=palette)


def averages(found: xr.Dataset, scene: Overview) -> Figure:
    """Draw how averages become Gaussian."""
    shares = found["averages_rejected_share"]
    by_channel = {str(c): shares.sel(channel=c).values for c in found["channel"].values}
    return viz.averages(
        list(scene.averages),
        by_channel,
        scene.skewness,
        scene.predicted_skewness,
        alpha=float(found.attrs["false_discovery_rate"]),
        scale="log",
    )


def estimates(comparison: Comparison) -> Figure:
    """Draw every estimate of the image, and its error, beside the reference."""
    names = [NAMES.get(name, name) for name in comparison.estimators]
    images: dict[str, npt.ArrayLike] = dict(zip(names, comparison.estimates, strict=True))
    errors: dict[str, npt.ArrayLike] = {
        name: error.mean(axis=-1)
        for name, error in zip(names, comparison.squared_error, strict=True)
    }
    return viz.side_by_side(images | {"reference": comparison.reference}, errors=errors)


def of_comparison(found: Comparison, curve: ErrorCurve | None = None) -> dict[str, Figure]:
    """Draw everything that a comparison found, by name; what it has not is left out."""
    drawn = {
        "estimates": estimates(found),
        "measures": viz.estimator_measures(found, names=NAMES),
        "pixels": viz.pixel_estimates(found.draw_pixels(), names=NAMES),
    }
    if found.breakdown is not None:
        drawn["breakdown"] = viz.pattern_breakdown(found.breakdown, names=NAMES)
    if curve is not None:
        drawn["curve"] = viz.error_curves(curve, names=NAMES)
    for model in found.models.values():
        if isinstance(model, MLP):
            drawn["training"] = training(model.history)
        if isinstance(model, Progressive):
            drawn["training_progressive"] = training(model.history)
    return drawn


def training(history: History) -> Figure:
    """Draw a training curve against the error of the sample mean."""
    return viz.training(
        history.iteration,
        {"training": history.train_loss, "validation": history.validation_loss},
        {
            "training": float(history.train_baseline[-1]),
            "validation": float(history.validation_baseline[-1]),
        },
    )


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
        What `chdstat.error_curve` found, to go with it.

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
