"""Report on a study: its figures, words and tables, and these as a PDF."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chdstat import viz
from chdstat._core.display import number, percent
from chdstat.rendering.recipes import remake_of
from chdstat.reporting.content import atlas_content, claim_content, remake_note
from chdstat.reporting.figures import claim_figures, depth_of, region_figure, scene_figures
from chdstat.reporting.typst import Document, typeset
from chdstat.scenes import BUILTIN
from chdstat.studies.claims import CLAIMS
from chdstat.studies.stores import ROULETTE
from chdstat.studies.studies import ACROSS, SceneStudy, Study
from chdstat.viz import VERDICTS
from chdstat.viz.estimators import called
from chdstat.viz.styling import qualitative, verbatim

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["document", "overview", "save_pdf", "verdicts"]


def verdicts(study: Study) -> Axes:
    """Draw the table of verdicts; a dot marks those that another seed repeats."""
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
    """Draw all images, each under an exposure of its own."""
    columns = min(4, len(study.scenes))
    figure = viz.map_grid(len(study.scenes), columns=columns, aspect=0.2 * columns)
    for ax, scene in zip(figure.axes, study.scenes, strict=True):
        viz.image_map(scene.data.summary["mean"].values, title=verbatim(scene.name), ax=ax)
    return figure


def save_pdf(study: Study, target: Path) -> Path:
    """Typeset a study; see `Study.save_pdf`."""
    return typeset(document(study), target)


def document(study: Study) -> Document:
    """Return a study, ready to typeset."""
    drawn: dict[str, Any] = {"verdicts": verdicts(study).figure, "overview": overview(study)}
    claims = {}
    for claim in CLAIMS:
        columns = {name: study.finding(claim.number, name) for name in study.names}
        columns[ACROSS] = study.finding(claim.number)
        claims[claim] = {name: finding for name, finding in columns.items() if finding is not None}
        drawn |= claim_figures(claim.number, claims[claim])
    for i, scene in enumerate(study.scenes):
        shown = scene_figures(scene.data, atlas=scene.atlas)
        if scene.data.regions:
            shown["regions"] = region_figure(scene.data)
        drawn |= {f"scene{i}-{name}": figure for name, figure in shown.items()}
    words = [v for row in study.table() for k, v in row.items() if k not in {"number", "claim"}]
    content = {
        "scenes": [_scene(scene, i) for i, scene in enumerate(study.scenes)],
        "claims": [claim_content(claim, found) for claim, found in claims.items()],
        "verdicts": VERDICTS,
        "counts": {verdict: words.count(verdict) for verdict in VERDICTS},
        "provenance": {k: str(v) for k, v in study.provenance.items()},
        "repeated": any(scene.repeated for scene in study.scenes),
        "remakes": remake_note(scene.data.samples for scene in study.scenes),
    }
    return Document("study.typ", content, drawn)


# --- scenes -------------------------------------------------------------------------------------


def _scene(scene: SceneStudy, index: int) -> dict[str, Any]:
    samples, seen = scene.data.samples, scene.overview
    seconds = samples.attrs.get("render_seconds")
    height, width, _, spp = samples.shape
    regions = scene.data.regions
    family, share = max(seen.families.items(), key=lambda item: item[1])
    paths = next((f for f in scene.findings if f.number == 9), None)
    ratio = None if paths is None else paths.details.get("time_ratio")
    return {
        "name": scene.name,
        "about": BUILTIN.get(scene.name, ""),
        "remake_of": remake_of(samples),
        "prefix": f"scene{index}-",
        "size": f"{width} × {height}",
        "spp": spp,
        "integrator": str((samples.attrs.get("integrator") or {}).get("type", "—")),
        "depth": depth_of(samples),
        "null_share": percent(seen.null_share),
        "variation": number(seen.variation[1]),
        "family": f"{called(family)} {percent(share)}" if share > 0 else "—",
        "time": f"{float(seconds):.0f} s" if seconds else "—",
        "chosen": scene.chosen,
        "regions": [
            {
                "name": r.name,
                "phenomenon": r.phenomenon.replace("-", " "),
                "note": r.note,
                "color": color,
            }
            for r, color in zip(regions, qualitative(len(regions)), strict=True)
        ],
        "renders": list(_renders(scene)),
        "notes": list(scene.notes),
        "atlas": None if scene.atlas is None else atlas_content(scene.atlas),
        "time_ratio": "" if ratio is None else number(float(ratio)),
    }


def _renders(scene: SceneStudy) -> Iterator[str]:
    """Yield the other renders of the view, in words."""
    shorter, other, again = scene.data.shorter, scene.data.integrator, scene.again
    if shorter is not None:
        yield f"paths of up to {depth_of(shorter)} segments, {shorter.spp} spp"
    if other is not None:
        yield f"Russian roulette from segment {ROULETTE} on, {other.spp} spp"
    if scene.data.spread is not None:
        attrs = scene.data.spread.attrs
        yield f"{attrs['sampler']} sequences of {attrs['sequence']}, {scene.data.spread.spp} spp"
    if again is not None:
        yield f"seed {again.attrs['seed']}, {again.spp} spp"
