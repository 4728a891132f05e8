"""Documents: text, tables and figures as a PDF, by Typst; of scenes and of studies."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

from chdstat import viz
from chdstat._core.display import duration, number, percent
from chdstat._core.doors import report
from chdstat._core.files import scratch, writing
from chdstat.errors import ChdstatError
from chdstat.rendering.recipes import remake_of
from chdstat.reporting.content import atlas_content, claim_content, remake_note
from chdstat.reporting.figures import claim_figures, depth_of, scene_figures
from chdstat.scenes import BUILTIN
from chdstat.studies.claims import CLAIMS
from chdstat.studies.stores import ROULETTE
from chdstat.studies.studies import ACROSS, SceneStudy, Study
from chdstat.viz import VERDICTS
from chdstat.viz.styling import called, qualitative, spelt, verbatim

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TEMPLATES = resources.files("chdstat.reporting") / "templates"
_FONTS = Path(mpl.get_data_path(), "fonts", "ttf")
"""Fonts of the text: the same as in figures, from Matplotlib."""


_STEPS, _FILLED = (0, 1, 2, 3, -1, -2), 0.55
"""Sizes that are tried, and how much of the last page has to be filled."""


@dataclass(frozen=True)
class Document:
    """Content for a template.

    Parameters
    ----------
    template
        Name of a file in ``templates/``.
    content
        Text, numbers and tables, ready for JSON.
    figures
        Figures by name; the template finds them as ``<name>.svg``.
    """

    template: str
    content: Mapping[str, Any]
    figures: Mapping[str, Figure]


def typeset(document: Document, target: Path) -> Path:
    """Write a document as PDF.

    Parameters
    ----------
    document
        The document.
    target
        The PDF; an existing one is replaced when the new one is complete.

    Raises
    ------
    ChdstatError
        If Typst refuses the document, or the PDF cannot be written.
    """
    import typst

    with scratch() as folder:
        for part in _TEMPLATES.iterdir():
            (folder / part.name).write_text(part.read_text(encoding="utf-8"), encoding="utf-8")
        content = {**document.content, "figures": sorted(document.figures)}
        (folder / "content.json").write_text(json.dumps(content), encoding="utf-8")
        with spelt():
            for name, figure in document.figures.items():
                figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        try:
            template = folder / document.template
            how: Any = {"font_paths": [_FONTS], "sys_inputs": {"tight": _tightness(template)}}
            with writing(target) as partial:
                typst.compile(template, output=partial, **how)
        except (RuntimeError, typst.TypstError) as error:
            message = f"typesetting the report failed: {error}"
            raise ChdstatError(message) from error
    return target


def _tightness(template: Path) -> str:
    """Return how much smaller to set a document, so that its last page is at least half full.

    The template says where it ends; one that does not is set as it is, and so is a single page.
    """
    import typst

    filled = {}
    for tight in map(str, _STEPS):
        asked: Any = {"font_paths": [_FONTS], "sys_inputs": {"tight": tight}}
        ends = json.loads(typst.query(template, "<end>", field="value", **asked))
        if not ends or ends[0]["pages"] == 1:
            return tight
        filled[tight] = ends[0]["filled"]
        if filled[tight] >= _FILLED:
            break
    return max(filled, key=filled.__getitem__)


def pages_of(path: Path) -> int:
    """Return the number of pages of a PDF that `typeset` has written."""
    return len(re.findall(rb"/Type\s*/Page\b", path.read_bytes()))


# --- a study --------------------------------------------------------------------------------------


def verdicts(study: Study) -> Axes:
    """Draw the table of verdicts; a dot marks verdicts that another seed repeats."""
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
    """Draw all images, each with its own exposure."""
    columns = min(4, len(study.scenes))
    figure = viz.map_grid(len(study.scenes), columns=columns, aspect=0.2 * columns)
    for ax, scene in zip(figure.axes, study.scenes, strict=True):
        viz.image_map(scene.data.summary["mean"].values, title=verbatim(scene.name), ax=ax)
    return figure


def study_document(study: Study) -> Document:
    """Return a study, ready to typeset."""
    drawn: dict[str, Any] = {"verdicts": verdicts(study).figure, "overview": overview(study)}
    claims, untested = [], dict[tuple[str, ...], list[str]]()
    for claim in CLAIMS:
        columns = {name: study.finding(claim.number, name) for name in study.names}
        columns[ACROSS] = study.finding(claim.number)
        found = {name: finding for name, finding in columns.items() if finding is not None}
        told, figures = claim_content(claim, found), claim_figures(claim.number, found)
        drawn |= figures
        if figures:
            claims.append(told)
            continue
        for row in told["rows"]:
            why = row["reason"], *row["scenes"]
            untested.setdefault(why, []).append(f"{claim.number} {claim.name}")
    for i, scene in enumerate(study.scenes):
        drawn |= {f"scene{i}-{name}": figure for name, figure in scene_figures(scene).items()}
    words = [v for row in study.table() for k, v in row.items() if k not in {"number", "claim"}]
    content = {
        "scenes": [_scene(scene, i) for i, scene in enumerate(study.scenes)],
        "number": len(CLAIMS),
        "claims": claims,
        "untested": [
            {"scenes": scenes, "reason": reason, "claims": ", ".join(names)}
            for (reason, *scenes), names in untested.items()
        ],
        "verdicts": VERDICTS,
        "counts": {verdict: words.count(verdict) for verdict in VERDICTS},
        "provenance": {k: str(v) for k, v in study.provenance.items()},
        "repeated": any(scene.repeated for scene in study.scenes),
        "remakes": remake_note(scene.data.samples for scene in study.scenes),
    }
    return Document("study.typ", content, drawn)


def _scene(scene: SceneStudy, index: int) -> dict[str, Any]:
    samples, seen = scene.data.samples, scene.overview
    seconds = samples.attrs.get("render_seconds")
    height, width, _, spp = samples.shape
    regions = scene.data.regions
    family, share = max(seen.families.items(), key=lambda item: item[1])
    cost = next((f.tests for f in scene.findings if f.name == "cost of longer paths"), ())
    slower = [test.interval.value for test in cost if test.name.startswith("time")]
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
        "time": duration(float(seconds)) if seconds else "—",
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
        "time_ratio": number(slower[0]) if slower else "",
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


report.register(Study, lambda study, target: typeset(study_document(study), target))
