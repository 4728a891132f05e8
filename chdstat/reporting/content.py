"""Content of the report: from datasets and results to words, tables and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat import viz
from chdstat.analysis import Overview, pooled_shares
from chdstat.comparison import Comparison, ErrorCurve
from chdstat.estimators import MLP
from chdstat.patterns import PATTERNS, Atlas
from chdstat.reporting import figures
from chdstat.reporting.claims import chips, finding_content, plot_findings, remake_note
from chdstat.reporting.findings import findings
from chdstat.reporting.scene_figures import SelfTraining, panels_of, scene_figures
from chdstat.reporting.typst import NAMES, Document, between, number, percent
from chdstat.samples import Samples
from chdstat.studies.claims import FINDINGS, Finding, SceneData

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["ReportData", "document"]


@dataclass(frozen=True)
class ReportData:
    """What is known about a scene.

    Parameters
    ----------
    evidence
        The samples with their regions and their analysis, and estimators side by side; without
        these where the samples cannot judge them.
    overview
        The analysis in a few numbers.
    claims
        Findings on the paper's claims.
    chosen
        Whether the library chose the regions.
    atlas
        Shapes that recur; None where no pixel has one.
    curve
        Errors against the number of samples; None where there are too few.
    self_training
        An estimate without a reference; None where ours did not take part, or of few samples.
    why_not
        Why no estimators were compared.
    """

    evidence: SceneData
    overview: Overview
    claims: tuple[Finding, ...]
    chosen: bool
    atlas: Atlas | None
    curve: ErrorCurve | None
    self_training: SelfTraining | None
    why_not: str = ""

    @property
    def samples(self) -> Samples:
        """The samples of the scene."""
        return self.evidence.samples

    @property
    def dataset(self) -> xr.Dataset:
        """What `chdstat.analyze` says of them."""
        return self.evidence.analysis

    @property
    def comparison(self) -> Comparison | None:
        """Estimators side by side."""
        return self.evidence.comparison


def document(data: ReportData) -> Document:
    """Return the report on a scene, ready to typeset."""
    panels = panels_of(data.evidence)
    content: dict[str, Any] = {
        "title": data.samples.name,
        "regions_chosen": data.chosen,
        "regions": [_region(data, i) for i in range(len(panels))],
        "provenance": _provenance(data.samples),
        "findings": [
            vars(finding)
            for finding in findings(data.overview, data.atlas, data.comparison, data.self_training)
        ],
        "alpha": percent(float(data.dataset.attrs["false_discovery_rate"])),
        "thresholds": _thresholds(data.dataset),
        "families": _families(data.dataset),
        "patterns": _patterns(data.overview),
        "n_means": int(data.dataset.attrs.get("n_means", 0)),
        "spp": data.samples.spp,
        "no_estimators": data.why_not,
        "verdicts": chips(),
        "claims": [finding_content(finding) for finding in data.claims],
        "unasked": _unasked(data.claims),
        "remake": remake_note([data.samples]),
    }
    drawn: dict[str, Figure] = {
        "maps": figures.maps(data.dataset),
        **scene_figures(data.evidence, panels, atlas=data.atlas),
    }
    if panels:
        drawn["chds"] = figures.chds(panels)
    else:
        drawn["image"] = viz.with_marks(data.dataset["mean"].values)
    shown = plot_findings({f"{f.number} {f.name}": f for f in data.claims})
    if shown is not None:
        drawn["exhibits"] = shown
    if data.atlas is not None:
        content["atlas"] = _atlas(data.atlas)
    if data.overview.averages:
        drawn["averages"] = figures.averages(data.dataset, data.overview)
    if data.comparison is not None:
        content["estimators"] = _estimators(data.comparison)
        drawn |= figures.of_comparison(data.comparison, data.curve)
        if data.self_training is not None:
            content["self_training"] = data.self_training.content()
            drawn["self_training"] = data.self_training.figure()
    return Document("report.typ", content, drawn)


def _provenance(samples: Samples) -> list[tuple[str, str]]:
    """Return what one needs to know to render the same samples again."""
    attrs = samples.attrs
    height, width, channels, spp = samples.shape
    integrator = dict(attrs.get("integrator") or {})
    kind = integrator.pop("type", "")
    settings = ", ".join(f"{name} {value}" for name, value in integrator.items())
    seconds = float(attrs.get("render_seconds") or 0)
    rows = {
        "Scene": f"{samples.name} ({attrs.get('scene_source', 'samples given')})",
        "Scene hash": str(attrs.get("scene_hash", ""))[:16],
        "Integrator": f"{kind} ({settings})" if settings else kind,
        "Image": f"{width} × {height} pixels, {channels} channels, {spp} samples per pixel",
        "Random numbers": f"{attrs['sampler']} sampler, seed {attrs['seed']}"
        if "seed" in attrs
        else "",
        "Filter": str(attrs.get("filter", "")),
        "Renderer": f"Mitsuba {attrs['mitsuba_version']}, {attrs['backend']}"
        if "mitsuba_version" in attrs
        else "",
        "Rendering time": f"{seconds:.0f} s" if seconds else "",
        "Note": "; ".join(attrs.get("notes") or []),
    }
    return [(name, value) for name, value in rows.items() if value]


def _unasked(claims: Sequence[Finding]) -> list[str]:
    """Return the claims that were not asked of the scene."""
    asked = {finding.number for finding in claims}
    return [f"{claim.number} ({claim.name})" for claim in FINDINGS if claim.number not in asked]


def _region(data: ReportData, index: int) -> dict[str, Any]:
    """Return one row of the table of regions."""
    region, (height, width) = data.evidence.regions[index], data.samples.shape[:2]
    pixel = dict(zip("yx", region.center(height, width), strict=True))
    found = data.dataset.isel(pixel)
    return {
        "name": region.name,
        "phenomenon": region.phenomenon,
        "pixel": f"({pixel['x']}, {pixel['y']})",
        "note": region.note,
        "color": figures.color_of(index),
        "radiance": [number(v) for v in np.atleast_1d(found["mean"].values)],
        "nulls": percent(float(found["null_share"])),
        "variation": number(float(found["coefficient_of_variation"])),
        "tail": between(float(found["long_tail_statistic"]), 2 * float(found["long_tail_se"])),
        "family": _named(found["luminance_family"]),
        "label": _named(found["label"]),
    }


def _named(code: xr.DataArray) -> str:
    name = figures.names_of(code)[int(code)]
    return NAMES.get(name, name)


def _families(found: xr.Dataset) -> list[dict[str, str]]:
    """Return the rows of the table of families: shares by both criteria, over all channels."""
    columns = [
        pooled_shares(found, variable)
        for variable in ("best_family", "held_out_best_family")
        if variable in found
    ]
    return [
        {
            "name": NAMES.get(name, name),
            **{
                key: f"{percent(column[name].share)} [{percent(column[name].low)}, "
                f"{percent(column[name].high)}]"
                for key, column in zip(("bic", "held_out"), columns, strict=False)
            },
        }
        for name in columns[0]
    ]


def _patterns(scene: Overview) -> list[dict[str, str]]:
    """Return the rows of the table of patterns, the most frequent first."""
    order = sorted(PATTERNS, key=lambda p: -scene.patterns[p.name])
    return [
        {
            "name": NAMES.get(p.name, p.name),
            "share": percent(scene.patterns[p.name]),
            "meaning": p.meaning,
            "statistic": p.statistic,
            "rule": p.rule,
        }
        for p in order
    ]


def _atlas(shapes: Atlas) -> dict[str, Any]:
    return {
        "count": len(shapes.share),
        "repeatable": percent(shapes.repeatable),
        "stability": number(shapes.stability),
    }


def _thresholds(dataset: xr.Dataset) -> dict[str, str]:
    prefix = "threshold_"
    return {
        str(name).removeprefix(prefix): number(float(value))
        for name, value in dataset.attrs.items()
        if str(name).startswith(prefix)
    }


def _estimators(comparison: Comparison) -> dict[str, Any]:
    rows = [
        {
            "name": NAMES.get(row["estimator"], row["estimator"]),
            "mse": number(row["mse"]),
            "mse_ratio": _with_interval(row, "mse_ratio"),
            "relmse_ratio": _with_interval(row, "relmse_ratio"),
            "improved": "" if row["estimator"] == "mean" else percent(row["improved"]),
            "bias": percent(row["bias"], sign=True),
            "fireflies": number(row["fireflies_left"]),
        }
        for row in comparison.table()
    ]
    trained = [m for m in comparison.models.values() if isinstance(m, MLP)]
    return {
        "rows": rows,
        "n": comparison.n,
        "batches": comparison.batches,
        "excluded": comparison.excluded,
        "test_pixels": int(comparison.test_pixels.sum()),
        "iterations": int(trained[0].history.iteration[-1]) if trained else 0,
        "train_pixels": len(trained[0].train_pixels) if trained else 0,
        "fewer_pixels": bool(trained) and len(trained[0].train_pixels) < trained[0].config.pixels,
    }


def _with_interval(row: Mapping[str, Any], name: str) -> str:
    low, high = number(row[f"{name}_low"]), number(row[f"{name}_high"])
    return f"{number(row[name])} [{low}, {high}]"
