"""Figures of a study: results handed to `chdstat.viz`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from chdstat import viz
from chdstat.studies.results import ACROSS, Study
from chdstat.viz.lettering import verbatim

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["overview", "verdicts"]


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
            cell.set_title(verbatim(name), fontsize=8)
    return figure
