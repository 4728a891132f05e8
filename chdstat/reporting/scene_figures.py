"""Figures of one scene, after the case study of Elek et al. 2019: for its report and in a study.

Regions with their CHDs, batches and their means, the brightest firefly, shorter paths, shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._arrays import is_bad, luminance
from chdstat.atlases import Atlas
from chdstat.findings import Evidence
from chdstat.findings.fireflies import BRIGHTER
from chdstat.histograms import histogram
from chdstat.recipes import Region
from chdstat.reporting.figures import marks_of, panel_of
from chdstat.reporting.text import number, percent
from chdstat.samples import Samples

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["panels_of", "scene_figures"]

Floats = npt.NDArray[np.float64]

_BATCH, _BATCHES = 32, 64
"""As in the first figure of Elek et al. 2019."""
_PIXELS = 5
_BINS = 40
_USUAL = 3
"""Batches that tell what is usual for a pixel."""
_ALIKE = 1.5
"""Ratio up to which two pixels are about the same."""
_DECADES = np.linspace(-5, 5, 101)


def panels_of(evidence: Evidence) -> list[viz.Panel]:
    """Return the CHD of the pixel in the middle of each region."""
    return [panel_of(evidence.samples, mark) for mark in _marks(evidence)]


def scene_figures(
    evidence: Evidence, panels: Sequence[viz.Panel], *, atlas: Atlas | None = None
) -> dict[str, Figure]:
    """Draw the study figures of a scene, by name; what it has not is left out.

    Parameters
    ----------
    evidence
        The scene.
    panels
        `panels_of` it.
    atlas
        Shapes that recur.
    """
    marks = _marks(evidence)
    drawn: dict[str, Figure] = {}
    if marks:
        drawn["regions"] = viz.region_study(
            evidence.summary["mean"].values,
            marks,
            panels,
            notes=[_note(region, evidence.summary) for region in evidence.regions],
        )
    drawn["batches"] = _batches(evidence.samples, marks[:_PIXELS])
    firefly = _firefly(evidence)
    if firefly is not None:
        drawn["firefly"] = firefly
    if evidence.shorter is not None:
        drawn["paths"] = _paths(evidence)
    if atlas is not None:
        drawn["atlas"] = viz.atlas(atlas)
    return drawn


def _marks(evidence: Evidence) -> list[viz.Mark]:
    return marks_of(evidence.regions, evidence.samples)


def _note(region: Region, summary: xr.Dataset) -> str:
    null = summary["null_share"].values
    here = float(null[region.pixels(*null.shape)].mean())
    kind = region.phenomenon.replace("-", " ")
    return f"{kind}, {percent(here)} null" if kind != region.name else f"{percent(here)} null"


def _batches(samples: Samples, marks: Sequence[viz.Mark]) -> Figure:
    height, width = samples.shape[:2]
    middle = viz.Mark("middle of the image", slice(0), slice(0), (height // 2, width // 2))
    panels = [_batch_panel(samples, mark) for mark in (marks or [middle])]
    size, number_ = _batch_shape(samples)
    return viz.batch_histograms(panels, number=number_, size=size)


def _batch_shape(samples: Samples) -> tuple[int, int]:
    """Return size and number of batches: 64 of 32 samples, or as many as there are."""
    size = min(_BATCH, samples.spp)
    return size, min(_BATCHES, samples.spp // size)


def _batch_panel(samples: Samples, mark: viz.Mark) -> viz.BatchPanel:
    """Count the luminance of each batch of a pixel, and of their means."""
    x = samples[mark.pixel].astype(np.float64)
    light = np.where(is_bad(x).any(axis=0), 0.0, np.asarray(luminance(np.where(is_bad(x), 0, x))))
    size, count = _batch_shape(samples)
    rows = light[: size * count].reshape(count, size)
    means = rows.mean(axis=1)
    # A firefly must not squeeze all others into the first bin; the axis says where it ends.
    top = float(np.quantile(rows, 0.99)) or float(rows.max()) or 1.0
    edges = np.linspace(0, max(top, 1.5 * float(light.mean())), _BINS + 1)
    counts = np.stack([np.histogram(row, edges)[0] for row in rows])
    low, high = float(means.min()), float(means.max())
    mean_edges = np.linspace(low, high if high > low else low + 1, _BINS // 2 + 1)
    mean_counts = np.histogram(means, mean_edges)[0]
    return viz.BatchPanel(mark.name, edges, counts, mean_edges, mean_counts, float(light.mean()))


def _firefly(evidence: Evidence) -> Figure | None:
    """Draw the brightest firefly and the pixel above it, which sees about the same."""
    summary, samples = evidence.summary, evidence.samples
    batches = np.asarray(luminance(summary["batch_means"].values.astype(np.float64)))
    found = _brightest(batches)
    if found is None:
        return None
    y, x, batch = found
    pixels = {"firefly": (y, x), "neighbour": (y - 1, x)}
    x_of = {name: samples[pixel] for name, pixel in pixels.items()}
    channel = x_of["firefly"].shape[0] // 2
    linear, log = (
        {n: _curve(v[channel], scale) for n, v in x_of.items()} for scale in ("linear", "log")
    )
    estimate = summary["batch_means"].values[..., batch]
    notes = {n: number(float(batches[pixel][batch])) for n, pixel in pixels.items()}
    return viz.firefly_pair(estimate, pixels, linear, log, notes=notes)


def _brightest(batches: Floats) -> tuple[int, int, int] | None:
    """Return row, column and batch of the brightest firefly; None without any.

    A firefly is an estimate well above what is usual for its pixel and for the pixel above it,
    which are about the same: else it is an edge.
    """
    if batches.shape[0] < 2 or batches.shape[2] < _USUAL or not np.isfinite(batches).all():
        return None
    usual = np.median(batches, axis=-1)
    lower, upper = usual[1:], usual[:-1]
    high, low = np.maximum(lower, upper), np.minimum(lower, upper)
    alike = (low > 0) & (high <= _ALIKE * low)
    ratio = np.where(alike, batches[1:].max(axis=-1) / np.where(alike, high, 1), 0)
    if ratio.max() < BRIGHTER:
        return None
    y, x = (int(i) for i in np.unravel_index(int(ratio.argmax()), ratio.shape))
    return y + 1, x, int(batches[y + 1, x].argmax())


def _curve(x: npt.NDArray[Any], scale: Any) -> viz.Curve:
    counted = histogram(x, scale=scale)
    return viz.Curve(counted.edges, counted.density)


def _paths(evidence: Evidence) -> Figure:
    long, short = evidence.summary, evidence.shorter_summary
    if short is None or evidence.shorter is None:
        message = "expected a scene with shorter paths"
        raise ValueError(message)
    names = [f"up to {_depth(s)} segments" for s in (evidence.shorter, evidence.samples)]
    images = dict(zip(names, (short["mean"].values, long["mean"].values), strict=True))
    log = {
        region.name: {
            name: _pooled(found, region) for name, found in zip(names, (short, long), strict=True)
        }
        for region in evidence.regions
    }
    return viz.view_pair(images, log)


def _depth(samples: Samples) -> str:
    depth = int(dict(samples.attrs["integrator"]).get("max_depth", -1))
    return "∞" if depth < 0 else str(depth)


def _pooled(found: xr.Dataset, region: Region) -> viz.Curve:
    """Return the density per decade of the positive samples of a region, all channels together."""
    counts = found["log_counts"].values
    here = counts[region.pixels(*counts.shape[:2])].sum(axis=(0, 1, 2), dtype=np.float64)
    width = _DECADES[1] - _DECADES[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return viz.Curve(10**_DECADES, here / (here.sum() * width))
