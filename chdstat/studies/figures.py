"""Figures of a study: results handed to `chdstat.viz`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._arrays import is_bad, luminance
from chdstat.findings import Finding, Part
from chdstat.findings.fireflies import BRIGHTER
from chdstat.histograms import histogram
from chdstat.recipes import Region
from chdstat.reporting.figures import marks_of, panel_of
from chdstat.reporting.text import number, percent
from chdstat.samples import Samples
from chdstat.studies.results import ACROSS, SceneStudy, Study

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["of_claim", "of_scene", "overview", "verdicts"]

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


def verdicts(study: Study) -> Figure:
    """Draw the table of verdicts; a dot marks what another seed repeats."""
    rows = {}
    repeated = {scene.name: scene.repeated for scene in study.scenes}
    for row in study.table():
        cells = {}
        for name in (*study.names, ACROSS):
            verdict = row[name]
            same = verdict and repeated.get(name, {}).get(int(row["number"])) == verdict
            cells[name] = f"{verdict}*" if same else verdict
        rows[f"{row['number']}  {row['claim']}"] = cells
    return viz.verdict_matrix(rows)


def overview(study: Study) -> Figure:
    """Draw all pictures, each under an exposure of its own."""
    from matplotlib.figure import Figure

    shown = [(s.name, viz.tonemap(s.evidence.summary["mean"].values)) for s in study.scenes]
    columns = min(4, len(shown))
    rows = -(-len(shown) // columns)
    with viz.style():
        figure = Figure(figsize=(6.7, 1.5 * rows if columns > 1 else 3.2), layout="constrained")
        cells = figure.subplots(rows, columns, squeeze=False).ravel()
        for cell in cells[len(shown) :]:
            cell.set_axis_off()
        for cell, (name, picture) in zip(cells, shown, strict=False):
            cell.imshow(picture, interpolation="nearest")
            cell.set(xticks=[], yticks=[])
            cell.spines[:].set_visible(False)
            cell.set_title(name, fontsize=8)
    return figure


# --- claims -------------------------------------------------------------------------------------


def of_claim(study: Study, claim: int) -> dict[str, Figure]:
    """Draw what was found on one claim: intervals by scene, and what the findings exhibit."""
    found = {name: study.finding(claim, name) for name in study.names}
    known = {name: f for name, f in found.items() if f is not None}
    whole = study.finding(claim)
    if whole is not None:
        known = {ACROSS: whole}
    drawn = {}
    measured = _measured(known)
    if measured:
        names = [name for name, f in known.items() if f.parts]
        drawn[f"claim{claim}"] = viz.claim_intervals(measured, names)
    shown = [_display(name, f) for name, f in known.items() if _has_exhibit(f)]
    if shown:
        drawn[f"exhibit{claim}"] = viz.displays(shown)
    return drawn


def _measured(findings: Mapping[str, Finding]) -> list[viz.Measured]:
    """Return the parts of a claim with their values by scene."""
    known = [f for f in findings.values() if f.parts]
    kinds: dict[tuple[str, float, float], Part] = {}
    for finding in known:
        for part in finding.parts:
            kinds.setdefault(_kind(part), part)
    return [_part(kind, part, known) for kind, part in kinds.items()]


def _kind(part: Part) -> tuple[str, float, float]:
    return part.statistic.name, part.least, part.most


def _part(kind: tuple[str, float, float], part: Part, findings: Sequence[Finding]) -> viz.Measured:
    each = [next((p for p in f.parts if _kind(p) == kind), None) for f in findings]
    return viz.Measured(
        part.statistic.name,
        [np.nan if p is None else p.statistic.value for p in each],
        [np.nan if p is None else p.low for p in each],
        [np.nan if p is None else p.high for p in each],
        part.least,
        part.most,
        part.statistic.unit,
    )


def _has_exhibit(finding: Finding) -> bool:
    return any(np.isfinite(np.asarray(y)).any() for _, y in finding.exhibit.series.values())


def _display(name: str, finding: Finding) -> viz.Display:
    shown = finding.exhibit
    title = "" if name == ACROSS else name
    return viz.Display(shown.kind, shown.series, shown.x_label, shown.y_label, title)


# --- one scene ----------------------------------------------------------------------------------


def of_scene(scene: SceneStudy) -> dict[str, Figure]:
    """Draw the study figures of a scene, by name; what it has not is left out."""
    evidence = scene.evidence
    marks = marks_of(evidence.regions, evidence.samples)
    drawn: dict[str, Figure] = {}
    if marks:
        drawn["regions"] = viz.region_study(
            evidence.summary["mean"].values,
            marks,
            [panel_of(evidence.samples, mark) for mark in marks],
            notes=[_note(region, evidence.summary) for region in evidence.regions],
        )
    drawn["batches"] = _batches(scene, marks[:_PIXELS])
    firefly = _firefly(scene)
    if firefly is not None:
        drawn["firefly"] = firefly
    if evidence.shorter is not None:
        drawn["paths"] = _paths(scene)
    if scene.atlas is not None:
        drawn["atlas"] = viz.atlas(scene.atlas)
    return drawn


def _note(region: Region, summary: xr.Dataset) -> str:
    null = summary["null_share"].values
    here = float(null[region.pixels(*null.shape)].mean())
    kind = region.phenomenon.replace("-", " ")
    return f"{kind}, {percent(here)} null" if kind != region.name else f"{percent(here)} null"


def _batches(scene: SceneStudy, marks: Sequence[viz.Mark]) -> Figure:
    samples = scene.evidence.samples
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


def _firefly(scene: SceneStudy) -> Figure | None:
    """Draw the brightest firefly and the pixel above it, which sees about the same."""
    summary, samples = scene.evidence.summary, scene.evidence.samples
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


def _paths(scene: SceneStudy) -> Figure:
    evidence = scene.evidence
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
