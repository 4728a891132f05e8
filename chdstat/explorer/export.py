"""Export: the selection as a file.

Samples are exported as CSV or npz, figures as PNG or SVG, both together as a PDF page.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from chdstat import viz
from chdstat._core.arrays import take_rows
from chdstat._core.display import percent
from chdstat._core.files import scratch
from chdstat.explorer.selection import SelectionPlots
from chdstat.explorer.sources import Overall
from chdstat.explorer.tables import columns_of, patterns_table, statistics_table
from chdstat.explorer.view import Box, Pixel
from chdstat.reporting.typst import Document, typeset
from chdstat.viz.estimators import called

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
        stream.write(_csv(plots).encode("ascii"))
    elif format == "npz":
        arrays: dict[str, Any] = {"selection": np.array([str(key) for key in plots.keys])}
        arrays |= {name: np.array(value) for name, value in origin.items()}
        for i, p in enumerate(plots.places):
            arrays |= {f"radiance_{i}": p.samples, f"null_{i}": p.null, f"bad_{i}": p.bad}
        np.savez_compressed(stream, **arrays)
    elif format == "pdf":
        stream.write(_pdf(source, plots, overall, exposure))
    else:
        metadata = {"Date": None} if format == "svg" else None
        _figure(plots).savefig(stream, format=format, metadata=metadata)
    return f"{stem}.{format}", stream.getvalue()


def _csv(plots: SelectionPlots) -> str:
    """Return one line for each sample."""
    most = max(1, _MOST_ROWS // len(plots.places))
    parts = []
    for key, place in zip(plots.keys, plots.places, strict=True):
        y, x = key if len(key) == 2 else ("", "")
        part = {"y": y, "x": x, "sample": np.arange(min(most, place.spp))}
        part |= dict(zip(place.channels, place.samples[:, :most], strict=True))
        flags = {"null": place.null[:most], "bad": place.bad[:most]}
        parts.append(pd.DataFrame(part | {n: flag.astype(int) for n, flag in flags.items()}))
    return str(pd.concat(parts).to_csv(index=False, lineterminator="\n", na_rep="nan"))


def _figure(plots: SelectionPlots) -> Figure:
    family = plots.view.families[0] if plots.view.families else ""
    drawn = []
    for key, place in zip(plots.keys, plots.places, strict=True):
        count = len(place.channels)
        fits = [place.positive(family, row) if family else None for row in range(count)]
        named = dict.fromkeys(called(fit[0]) for fit in fits if fit is not None)
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
        "statistics": statistics_table(columns),
        "patterns": patterns_table(columns),
    }
    with scratch() as folder:
        document = Document("selection.typ", content, figures)
        return typeset(document, folder, folder / "selection.pdf").read_bytes()
