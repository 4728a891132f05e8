"""Report on a benchmark: its tables, errors against the number of samples, and images, as a PDF."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat import viz
from chdstat._core.display import duration, number, percent, with_interval
from chdstat._core.image_scales import display_stops
from chdstat.comparison.benchmark import Bench, Case
from chdstat.reporting.typst import Document, typeset
from chdstat.viz.estimators import called
from chdstat.viz.styling import verbatim

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["document", "save_pdf"]

_PANELS = 3
"""Scenes side by side."""
_IMAGES = 5
"""Most images side by side."""
_LETTERS = 22
"""Of a name above an image in one line."""


def save_pdf(found: Bench, target: Path) -> Path:
    """Typeset a benchmark; see `Bench.save`."""
    return typeset(document(found), target)


def document(found: Bench) -> Document:
    """Return a benchmark, ready to typeset."""
    shown = [case for case in found.cases if case.images]
    drawn = {name: _curves(found, name) for name in ("mse", "relmse")}
    drawn |= {f"images{i}": _images(case) for i, case in enumerate(shown)}
    rows, table = found.shown(), found.table()
    for row, values in zip(rows, found.summary(), strict=True):
        row["estimator"] = called(row["estimator"])
        row["rank"] += f" [{values['rank_low']:.1f}, {values['rank_high']:.1f}]"
    content = {
        "baseline": called(found.baseline),
        "scenes": list(dict.fromkeys(case.scene for case in found.cases)),
        "spp": [str(n) for n in _numbers(found)],
        "summary": [[*rows[0]], *([*row.values()] for row in rows)],
        "cases": [
            {
                "scene": case.scene,
                "spp": case.spp,
                "rows": [
                    _case(row)
                    for row in table
                    if (row["scene"], row["spp"]) == (case.scene, case.spp)
                ],
            }
            for case in found.cases
        ],
        "images": [{"scene": case.scene, "spp": case.spp} for case in shown],
        "flip": "FLIP" in rows[0],
        "notes": found.notes,
    }
    return Document("bench.typ", content, drawn)


def _numbers(found: Bench) -> list[int]:
    return sorted({case.spp for case in found.cases})


def _curves(found: Bench, measure: str) -> Figure:
    """Draw an error of all estimators, a panel for each scene."""
    errors = {(r["scene"], r["estimator"], r["spp"]): r[measure] for r in found.table()}
    numbers = _numbers(found)
    panels = {
        scene: {
            name: [errors.get((scene, name, n), np.nan) for n in numbers]
            for name in found.estimators
        }
        for scene in dict.fromkeys(case.scene for case in found.cases)
    }
    title = {"mse": "MSE", "relmse": "relMSE"}[measure]
    return viz.curves(numbers, panels, ylabel=title, columns=_PANELS, log=True)


def _images(case: Case) -> Figure:
    """Draw what is kept of the estimates of a scene, under the exposure of its reference."""
    stops = display_stops(case.images["reference"])
    height, width = case.images["reference"].shape[:2]
    columns = min(_IMAGES, max(_PANELS, len(case.images)))
    figure = viz.map_grid(len(case.images), columns=columns, aspect=height / width)
    for ax, (name, image) in zip(figure.axes, case.images.items(), strict=True):
        title = fill(verbatim(called(name)), _LETTERS)
        viz.image_map(image, title=title, exposure=stops, ax=ax)
    return figure


def _case(row: dict[str, Any]) -> list[str]:
    """Return the numbers of an estimator in a case as text."""
    ratios = (
        with_interval(*(row[f"{measure}_ratio{end}"] for end in ("", "_low", "_high")))
        for measure in ("mse", "relmse")
    )
    seconds = float(row["seconds"])
    return [
        called(row["estimator"]),
        *ratios,
        percent(row["bias"], sign=True),
        percent(row["fireflies"]),
        duration(seconds) if np.isfinite(seconds) else "—",
        number(row["mse_equal_time"]),
    ]
