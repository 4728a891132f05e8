"""Exports of a selection: its samples (CSV, npz), its figures (PNG, SVG) or a page (PDF)."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat import viz
from chdstat._core.arrays import take_rows
from chdstat._core.display import percent
from chdstat._core.files import scratch
from chdstat.explorer.selection import SelectionPlots
from chdstat.explorer.sources import Overall
from chdstat.explorer.tables import Table, columns_of, patterns_table, statistics_table
from chdstat.explorer.view import Box, Pixel
from chdstat.reporting.typst import Document, typeset
from chdstat.viz.estimators import NAMES
from chdstat.viz.styling import spelt

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["EXPORTS", "exported"]

EXPORTS = {
    "csv": "text/csv",
    "npz": "application/octet-stream",
    "png": "image/png",
    "svg": "image/svg+xml",
    "pdf": "application/pdf",
}
"""Media types of the formats of exports."""
_MOST_ROWS = 2**17
"""Lines of a CSV file, as many as a spreadsheet takes."""
_TEMPLATE = "selection.typ"


def exported(
    format: str,  # noqa: A002
    source: str,
    plots: SelectionPlots,
    overall: Overall,
    exposure: float,
    origin: Mapping[str, str | int],
) -> tuple[str, bytes]:
    """Return name and content of a file with the selection.

    Parameters
    ----------
    format
        One of `EXPORTS`.
    source
        Name of the store or scene.
    plots
        The selection.
    overall, exposure
        The image, and the stops that it is shown with.
    origin
        Where the samples come from, as the npz file says: scene, spp, seed.
    """
    kept = "".join(c if c.isalnum() or c in "._" else "-" for c in source)
    keys = ("_".join(map(str, key)) for key in plots.keys)
    stem = "-".join([kept.removesuffix(".zarr") or "selection", *keys])[:80]
    stream = io.BytesIO()
    if format == "csv":
        stream.write(_csv(plots))
    elif format == "npz":
        arrays: dict[str, Any] = {"selection": np.array([str(key) for key in plots.keys])}
        arrays |= {name: np.array(value) for name, value in origin.items()}
        for i, p in enumerate(plots.places):
            arrays |= {f"radiance_{i}": p.samples, f"null_{i}": p.null, f"bad_{i}": p.bad}
        np.savez_compressed(stream, **arrays)
    elif format == "pdf":
        stream.write(_pdf(source, plots, overall, exposure))
    else:
        with viz.style(), spelt():
            metadata = {"Date": None} if format == "svg" else None
            _figure(plots).savefig(stream, format=format, metadata=metadata)
    return f"{stem}.{format}", stream.getvalue()


def _csv(plots: SelectionPlots) -> bytes:
    """Return one line for each sample."""
    lines = [",".join(["y", "x", "sample", *plots.place.channels, "null", "bad"])]
    most = max(1, _MOST_ROWS // len(plots.places))
    for key, place in zip(plots.keys, plots.places, strict=True):
        start = f"{key[0]},{key[1]}" if len(key) == 2 else ","
        for i, values in enumerate(place.samples[:, :most].T):
            numbers = ",".join(np.format_float_scientific(v, trim="-") for v in values)
            lines.append(f"{start},{i},{numbers},{int(place.null[i])},{int(place.bad[i])}")
    return ("\n".join(lines) + "\n").encode("ascii")


def _figure(plots: SelectionPlots) -> Figure:
    family = plots.view.families[0] if plots.view.families else ""
    drawn = []
    for key, place in zip(plots.keys, plots.places, strict=True):
        count = len(place.channels)
        fits = [place.positive(family, row) if family else None for row in range(count)]
        named = dict.fromkeys(NAMES.get(fit[0], fit[0]) for fit in fits if fit is not None)
        panel = viz.Panel(
            name=_mark(key).name,
            linear=take_rows(place.histograms["linear"], slice(count), axis=0),
            log=take_rows(place.histograms["log"], slice(count), axis=0),
            channels=place.channels,
            fits=[None if fit is None else fit[1] for fit in fits],
            mean=place.moments.mean[:count].tolist(),
            note=f"{percent(place.null_share)} null, {' / '.join(named) or 'no fit'}",
        )
        drawn.append(panel)
    return viz.chd_grid(drawn, columns=1 if len(drawn) == 1 else 2)


def _narrow(table: Table) -> Table:
    """Return a table without its second column, which takes the room of the others on paper."""
    rows = [[row[0], *row[2:]] for row in table["rows"]]
    return {**table, "columns": [table["columns"][0], *table["columns"][2:]], "rows": rows}


def _mark(key: Pixel | Box) -> viz.Mark:
    if len(key) == 2:
        y, x = key
        return viz.Mark(f"y {y}, x {x}", slice(y, y + 1), slice(x, x + 1), key)
    top, left, bottom, right = key
    center = ((top + bottom - 1) // 2, (left + right - 1) // 2)
    name = f"y {top} to {bottom - 1}, x {left} to {right - 1}"
    return viz.Mark(name, slice(top, bottom), slice(left, right), center)


def _pdf(source: str, plots: SelectionPlots, overall: Overall, exposure: float) -> bytes:
    image = np.nan_to_num(overall.mean, nan=0.0, posinf=0.0, neginf=0.0)
    marks = [_mark(key) for key in plots.keys]
    figures = {"image": viz.with_marks(image, marks, exposure=exposure), "chds": _figure(plots)}
    columns, count = columns_of([plots.place], "all"), len(plots.places)
    content = {
        "title": source,
        "place": plots.title,
        "rows": -(-count // (1 if count == 1 else 2)),
        "tables": [statistics_table(columns), _narrow(patterns_table(columns))],
    }
    with scratch() as folder:
        (folder / _TEMPLATE).write_text(_SELECTION, encoding="utf-8")
        target = folder / "selection.pdf"
        typeset(Document(_TEMPLATE, content, figures), folder, target)
        return target.read_bytes()


_SELECTION = """\
#let data = json("content.json")
#set document(title: data.title, author: "chdstat")
#set page(paper: "a4", margin: (x: 16mm, top: 12mm, bottom: 10mm))
#set text(font: ("Libertinus Serif",), size: 8.5pt, lang: "en")
#set table(stroke: none, inset: (x: 3pt, y: 1.4pt))
#show table.cell.where(y: 0): set text(weight: "semibold")
#let of(t) = [
  #text(9.5pt, weight: "bold")[#t.title] \\
  #text(6.5pt, t.note)
  #set text(6.5pt)
  #table(
    columns: t.columns.len(),
    table.hline(stroke: 0.4pt),
    ..t.columns.map(c => [#c]),
    table.hline(stroke: 0.4pt),
    ..t.rows.map(r => r.slice(0, t.columns.len())).flatten().map(c => [#c]),
    table.hline(stroke: 0.4pt),
  )
]
#text(13pt, weight: "bold")[#data.title]
#v(-2mm)
#align(center, image("image.svg", height: if data.rows < 2 { 96mm } else { 66mm }, fit: "contain"))
#let tall = calc.min(100mm, 36mm * data.rows + 8mm)
#align(center, image("chds.svg", width: 100%, height: tall, fit: "contain"))
#text(10pt, weight: "bold")[#data.place]

#grid(columns: (1.7fr, 1fr), column-gutter: 6mm, of(data.tables.at(0)), of(data.tables.at(1)))
"""
