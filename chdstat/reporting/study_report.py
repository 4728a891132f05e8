"""Report on a study: its figures, words and tables, and these as a PDF."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chdstat import viz
from chdstat._core.files import scratch
from chdstat.rendering.recipes import remake_of
from chdstat.reporting.claims import chips, claim_content, claim_figures, remake_note
from chdstat.reporting.scene_figures import panels_of, scene_figures
from chdstat.reporting.typst import Document, number, percent, typeset
from chdstat.scenes import BUILTIN
from chdstat.studies.claims import FINDINGS, Claim, Finding
from chdstat.studies.run import ACROSS, SceneStudy, Study
from chdstat.studies.stores import ROULETTE
from chdstat.viz.styling import qualitative, verbatim

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["document", "overview", "save_pdf", "verdicts"]


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
    """Draw all images, each under an exposure of its own."""
    from matplotlib.figure import Figure

    shown = [(s.name, viz.tonemap(s.data.summary["mean"].values)) for s in study.scenes]
    columns = min(4, len(shown))
    rows = -(-len(shown) // columns)
    with viz.style():
        figure = Figure(figsize=(6.7, 1.5 * rows if columns > 1 else 3.2), layout="constrained")
        cells = figure.subplots(rows, columns, squeeze=False).ravel()
        for cell in cells[len(shown) :]:
            cell.set_axis_off()
        for cell, (name, image) in zip(cells, shown, strict=False):
            cell.imshow(image, interpolation="nearest")
            cell.set(xticks=[], yticks=[])
            cell.spines[:].set_visible(False)
            cell.set_title(verbatim(name), fontsize=8)
    return figure


def save_pdf(study: Study, target: Path) -> Path:
    """Typeset a study; see `Study.save_pdf`."""
    with scratch() as folder:
        return typeset(document(study), folder, target)


def document(study: Study) -> Document:
    """Return a study, ready to typeset."""
    drawn: dict[str, Figure] = {
        "verdicts": verdicts(study),
        "overview": overview(study),
    }
    claims = {claim: _found(study, claim) for claim in FINDINGS}
    for claim, found in claims.items():
        drawn |= claim_figures(claim.number, found)
    for i, scene in enumerate(study.scenes):
        shown = scene_figures(scene.data, panels_of(scene.data), atlas=scene.atlas)
        drawn |= {f"scene{i}-{name}": figure for name, figure in shown.items()}
    content = {
        "scenes": [_scene(scene, i) for i, scene in enumerate(study.scenes)],
        "claims": [claim_content(claim, found) for claim, found in claims.items()],
        "verdicts": chips(),
        "counts": _counts(study),
        "provenance": {k: str(v) for k, v in study.provenance.items()},
        "repeated": any(scene.repeated for scene in study.scenes),
        "remakes": remake_note(scene.data.samples for scene in study.scenes),
    }
    return Document("study.typ", content, drawn)


def _counts(study: Study) -> dict[str, int]:
    words = [v for row in study.table() for k, v in row.items() if k not in {"number", "claim"}]
    return {verdict: words.count(verdict) for verdict in chips()}


def _found(study: Study, claim: Claim) -> dict[str, Finding]:
    """Return what was found on a claim, by scene."""
    found = {name: study.finding(claim.number, name) for name in study.names}
    found[ACROSS] = study.finding(claim.number)
    return {name: finding for name, finding in found.items() if finding is not None}


# --- scenes -------------------------------------------------------------------------------------


def _scene(scene: SceneStudy, index: int) -> dict[str, Any]:
    samples, seen = scene.data.samples, scene.overview
    seconds = samples.attrs.get("render_seconds")
    integrator = dict(samples.attrs.get("integrator") or {})
    height, width, _, spp = samples.shape
    regions = scene.data.regions
    return {
        "name": scene.name,
        "about": BUILTIN.get(scene.name, ""),
        "remake_of": remake_of(samples),
        "prefix": f"scene{index}-",
        "size": f"{width} × {height}",
        "spp": spp,
        "integrator": str(integrator.get("type", "—")),
        "depth": _depth(integrator),
        "null_share": percent(seen.null_share),
        "variation": number(seen.variation[1]),
        "family": _leading(seen.families),
        "time": f"{float(seconds):.0f} s" if seconds else "—",
        "chosen": scene.chosen,
        "regions": [
            {
                "name": r.name,
                "phenomenon": r.phenomenon.replace("-", " "),
                "note": r.note,
                "color": c,
            }
            for r, c in zip(regions, qualitative(len(regions)), strict=True)
        ],
        "verdicts": [
            {"number": f.number, "name": f.name, "verdict": f.verdict} for f in scene.findings
        ],
        "renders": list(_renders(scene)),
        "notes": list(scene.notes),
        "atlas": _atlas(scene),
        "time_ratio": _time_ratio(scene),
    }


def _depth(integrator: Mapping[str, Any]) -> str:
    depth = int(integrator.get("max_depth", 0))
    return "∞" if depth < 0 else str(depth or "—")


def _leading(families: Mapping[str, float]) -> str:
    if not any(share > 0 for share in families.values()):
        return "—"
    name, share = max(families.items(), key=lambda item: item[1])
    return f"{name} {percent(share)}"


def _renders(scene: SceneStudy) -> Iterator[str]:
    """Say what else was rendered of the view."""
    shorter, other, again = scene.data.shorter, scene.data.integrator, scene.again
    if shorter is not None:
        depth = _depth(dict(shorter.attrs["integrator"]))
        yield f"paths of up to {depth} segments, {shorter.spp} spp"
    if other is not None:
        yield f"Russian roulette from segment {ROULETTE} on, {other.spp} spp"
    if again is not None:
        yield f"seed {again.attrs['seed']}, {again.spp} spp"


def _atlas(scene: SceneStudy) -> dict[str, str] | None:
    found = scene.atlas
    if found is None:
        return None
    return {
        "count": str(len(found.share)),
        "repeatable": percent(found.repeatable),
        "stability": number(found.stability),
    }


def _time_ratio(scene: SceneStudy) -> str:
    found = next((f for f in scene.findings if f.number == 9), None)
    ratio = None if found is None else found.details.get("time_ratio")
    return "" if ratio is None else number(float(ratio))
