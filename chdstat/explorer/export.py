"""Export: the selection as a file.

Samples are exported as CSV, figures as PNG or SVG, both together as a PDF page; of several images,
their comparison as one figure.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from chdstat import viz
from chdstat._core.arrays import Image
from chdstat._core.files import scratch
from chdstat.explorer.address import Box, PixelIndex
from chdstat.explorer.selection import SelectionPlots
from chdstat.explorer.tables import columns_of, patterns_table, statistics_table
from chdstat.reporting.documents import Document, typeset
from chdstat.viz.results import panel_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXPORTS = {
    "csv": "text/csv",
    "png": "image/png",
    "svg": "image/svg+xml",
    "pdf": "application/pdf",
}
"""Media types of the formats of exports."""
_MOST_ROWS = 2**17
"""Lines of a CSV file, as many as a spreadsheet takes."""


def exported(
    format: str,  # noqa: A002
    plots: SelectionPlots,
    images: Mapping[str, Image],
    exposure: float,
) -> tuple[str, bytes]:
    """Return name and content of a file with the selection.

    Parameters
    ----------
    format
        One of `EXPORTS`.
    plots
        The selection.
    images
        Mean radiance (y, x, channel) of each source by its name.
    exposure
        Stops that the images are shown with.
    """
    kept = "".join(c if c.isalnum() or c in "._" else "-" for c in plots.name)
    keys = ("_".join(map(str, key)) for key in plots.keys)
    stem = "-".join([kept.removesuffix(".zarr") or "selection", *keys])[:80]
    stream = io.BytesIO()
    if format == "csv":
        stream.write(_csv(plots).encode("ascii"))
    elif format == "pdf" and len(images) == 1:
        stream.write(_pdf(plots, images[plots.name], exposure))
    else:
        figure = _figure(plots) if len(images) == 1 else _compared(plots, images, exposure)
        metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(format)
        figure.savefig(stream, format=format, metadata=metadata)
    return f"{stem}.{format}", stream.getvalue()


def _compared(plots: SelectionPlots, images: Mapping[str, Image], exposure: float) -> Figure:
    names = list(images)
    shown, reference = plots.view.of_images(len(names))
    samples = {names[i]: [p.radiance for p in those] for i, those in plots.found.items()}
    return viz.renders_compared(
        images, samples, [_mark(key) for key in plots.keys], exposure=exposure,
        difference=(names[shown], names[reference]) if shown != reference else None,
    )  # fmt: skip


def _csv(plots: SelectionPlots) -> str:
    """Return one line for each sample."""
    most = max(1, _MOST_ROWS // len(plots.places))
    parts = []
    for key, place in zip(plots.keys, plots.places, strict=True):
        y, x = key if len(key) == 2 else ("", "")
        part = {"y": y, "x": x, "sample": np.arange(min(most, place.spp))}
        part |= dict(zip(place.channels, place.radiance[:, :most], strict=True))
        flags = {"null": place.null[:most], "bad": place.bad[:most]}
        parts.append(pd.DataFrame(part | {n: flag.astype(int) for n, flag in flags.items()}))
    return str(pd.concat(parts).to_csv(index=False, lineterminator="\n", na_rep="nan"))


def _figure(plots: SelectionPlots) -> Figure:
    family = plots.view.families[0] if plots.view.families else ""
    drawn = [
        panel_of(place, _mark(key).name, family=family)
        for key, place in zip(plots.keys, plots.places, strict=True)
    ]
    return viz.chd_grid(drawn, columns=1 if len(drawn) == 1 else 2)


def _mark(key: PixelIndex | Box) -> viz.Mark:
    if len(key) == 2:
        y, x = key
        return viz.Mark(f"y {y}, x {x}", slice(y, y + 1), slice(x, x + 1), key)
    top, left, bottom, right = key
    center = ((top + bottom - 1) // 2, (left + right - 1) // 2)
    name = f"y {top} to {bottom - 1}, x {left} to {right - 1}"
    return viz.Mark(name, slice(top, bottom), slice(left, right), center)


def _pdf(plots: SelectionPlots, mean: Image, exposure: float) -> bytes:
    image = np.nan_to_num(mean, nan=0.0, posinf=0.0, neginf=0.0)
    marks = [_mark(key) for key in plots.keys]
    figures = {"image": viz.with_marks(image, marks, exposure=exposure), "chds": _figure(plots)}
    columns, count = columns_of([plots.place], "all"), len(plots.places)
    content = {
        "title": plots.name,
        "place": plots.title,
        "rows": -(-count // (1 if count == 1 else 2)),
        "statistics": statistics_table(columns),
        "patterns": patterns_table(columns),
    }
    with scratch() as folder:
        document = Document("selection.typ", content, figures)
        return typeset(document, folder / "selection.pdf").read_bytes()
