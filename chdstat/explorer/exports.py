"""Exports: the selection as a file: samples as CSV or npz, figures as PNG or SVG, a page as PDF."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from chdstat import viz
from chdstat._core.arrays import take_rows
from chdstat._core.files import scratch
from chdstat.explorer import tables
from chdstat.explorer.images import Overall
from chdstat.explorer.statistics import PlaceStatistics
from chdstat.explorer.view import View
from chdstat.fit import Fit
from chdstat.reporting.typst import NAMES, Document, percent, typeset
from chdstat.viz.styling import spelt

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["File", "Format", "Shown", "exported"]

Format = Literal["csv", "npz", "png", "svg", "pdf"]

_TYPES = {
    "csv": "text/csv",
    "npz": "application/octet-stream",
    "png": "image/png",
    "svg": "image/svg+xml",
    "pdf": "application/pdf",
}
_MOST_ROWS = 2**17
_TEMPLATE = "selection.typ"


@dataclass(frozen=True)
class File:
    """A file to be saved by the browser.

    Attributes
    ----------
    name, type
        Its name and media type.
    content
        Its bytes.
    """

    name: str
    type: str
    content: bytes


@dataclass(frozen=True)
class Shown:
    """What is selected.

    Attributes
    ----------
    source
        Name of the store or scene.
    keys
        (y, x) of pixels, or (top, left, bottom, right) of a region.
    places
        What was measured at each.
    active
        Index of the one that tables describe.
    """

    source: str
    keys: Sequence[tuple[int, ...]]
    places: Sequence[PlaceStatistics]
    active: int


def exported(format: str, shown: Shown, view: View, overall: Overall, exposure: float) -> File:  # noqa: A002
    """Return the selection as a file.

    Parameters
    ----------
    format
        One of `Format`.
    shown, view
        What is selected, and how it is looked at.
    overall, exposure
        The image, and the stops that it is shown with.
    """
    stem = "-".join([_plain(shown.source), *("_".join(map(str, key)) for key in shown.keys)])[:80]
    if format == "csv":
        content = _csv(shown)
    elif format == "npz":
        content = _npz(shown)
    elif format == "pdf":
        content = _pdf(shown, view, overall, exposure)
    else:
        content = _image(_figure(shown, view), format)
    return File(f"{stem}.{format}", _TYPES[format], content)


def _plain(text: str) -> str:
    kept = "".join(c if c.isalnum() or c in "._" else "-" for c in text)
    return kept.removesuffix(".zarr") or "selection"


def _npz(shown: Shown) -> bytes:
    arrays: dict[str, Any] = {"selection": np.array([str(key) for key in shown.keys])}
    for i, place in enumerate(shown.places):
        arrays |= {f"{name}_{i}": array for name, array in place.arrays().items()}
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _csv(shown: Shown) -> bytes:
    """Return one line for each sample, as many as a spreadsheet takes."""
    channels = shown.places[0].channels
    lines = [",".join(["y", "x", "sample", *channels, "null", "bad"])]
    each = max(1, _MOST_ROWS // len(shown.places))
    for key, place in zip(shown.keys, shown.places, strict=True):
        y, x = (key[0], key[1]) if len(key) == 2 else ("", "")
        arrays = place.arrays()
        values = arrays["radiance"][:, :each].T
        flags = zip(arrays["null"], arrays["bad"], strict=True)
        for i, (row, (null, bad)) in enumerate(zip(values, flags, strict=False)):
            numbers = ",".join(np.format_float_scientific(v, trim="-") for v in row)
            lines.append(f"{y},{x},{i},{numbers},{int(null)},{int(bad)}")
    return ("\n".join(lines) + "\n").encode("ascii")


def _image(figure: Figure, kind: str) -> bytes:
    stream = io.BytesIO()
    with viz.style(), spelt():
        figure.savefig(stream, format=kind, metadata={"Date": None} if kind == "svg" else None)
    return stream.getvalue()


def _figure(shown: Shown, view: View) -> Figure:
    panels = [_panel(key, place, view) for key, place in zip(shown.keys, shown.places, strict=True)]
    return viz.chd_grid(panels, columns=1 if len(panels) == 1 else 2)


def _panel(key: tuple[int, ...], place: PlaceStatistics, view: View) -> viz.Panel:
    family, count = view.families[0] if view.families else "", len(place.channels)
    fits = [place.fit(family, row) if family else None for row in range(count)]
    names = [fit.family if isinstance(fit, Fit) else "mixture" for fit in fits if fit is not None]
    named = dict.fromkeys(NAMES.get(name, name) for name in names)
    return viz.Panel(
        name=_named(key),
        linear=take_rows(place.linear, slice(count), axis=0),
        log=take_rows(place.log, slice(count), axis=0),
        channels=place.channels,
        fits=[None if fit is None else fit.pdf for fit in fits],
        mean=place.moments.mean[:count].tolist(),
        note=f"{percent(place.null_share)} null, {' / '.join(named) or 'no fit'}",
    )


def _named(key: tuple[int, ...]) -> str:
    if len(key) == 2:
        return f"y {key[0]}, x {key[1]}"
    top, left, bottom, right = key
    return f"y {top} to {bottom - 1}, x {left} to {right - 1}"


def _pdf(shown: Shown, view: View, overall: Overall, exposure: float) -> bytes:
    marks = [_mark(key) for key in shown.keys]
    image = np.nan_to_num(overall.mean, nan=0.0, posinf=0.0, neginf=0.0)
    figures = {
        "image": viz.with_marks(image, marks, exposure=exposure),
        "chds": _figure(shown, view),
    }
    place = shown.places[shown.active]
    content = {
        "title": shown.source,
        "place": _named(shown.keys[shown.active]),
        "rows": -(-len(shown.places) // (1 if len(shown.places) == 1 else 2)),
        "tables": [tables.statistics(place), tables.patterns(place)],
    }
    with scratch() as folder:
        (folder / _TEMPLATE).write_text(_SELECTION, encoding="utf-8")
        target = folder / "selection.pdf"
        typeset(Document(_TEMPLATE, content, figures), folder, target)
        return target.read_bytes()


def _mark(key: tuple[int, ...]) -> viz.Mark:
    if len(key) == 2:
        y, x = key
        return viz.Mark(_named(key), slice(y, y + 1), slice(x, x + 1), (y, x))
    top, left, bottom, right = key
    center = ((top + bottom - 1) // 2, (left + right - 1) // 2)
    return viz.Mark(_named(key), slice(top, bottom), slice(left, right), center)


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
#align(center, image("image.svg", height: 66mm, fit: "contain"))
#let tall = calc.min(100mm, 36mm * data.rows + 8mm)
#align(center, image("chds.svg", width: 100%, height: tall, fit: "contain"))
#text(9pt)[What follows is about #data.place.]

#grid(columns: (1.7fr, 1fr), column-gutter: 6mm, of(data.tables.at(0)), of(data.tables.at(1)))
"""
