"""Export: the selection as a file.

Samples are exported as CSV, figures as PNG or SVG, both together as a PDF page; of several images,
their comparison as one figure.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from chdstat import viz
from chdstat._core.arrays import Image
from chdstat._core.files import scratch
from chdstat.explorer.address import Box, PixelIndex
from chdstat.explorer.overlays import Map
from chdstat.explorer.panels import LIGHT, mark_colors, render_color
from chdstat.explorer.selection import SelectionPlots
from chdstat.explorer.tables import columns_of, patterns_table, statistics_table
from chdstat.reporting.documents import Document, typeset
from chdstat.viz.results import panel_of
from chdstat.viz.styling import page, upright

if TYPE_CHECKING:
    from matplotlib.axes import Axes
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
    shown: Map | None = None,
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
    shown
        The map that is shown in place of the image.
    """
    kept = "".join(c if c.isalnum() or c in "._" else "-" for c in plots.name)
    keys = ("_".join(map(str, key)) for key in plots.keys)
    stem = "-".join([kept.removesuffix(".zarr") or "selection", *keys])[:80]
    stream = io.BytesIO()
    if format == "csv":
        stream.write(_csv(plots).encode("ascii"))
    elif format == "pdf" and len(images) == 1:
        stream.write(_pdf(plots, images, exposure, shown))
    else:
        figure = _drawn(plots, images, exposure, shown)
        metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(format)
        figure.savefig(stream, format=format, metadata=metadata)
    return f"{stem}.{format}", stream.getvalue()


def _drawn(
    plots: SelectionPlots, images: Mapping[str, Image], exposure: float, shown: Map | None
) -> Figure:
    if len(images) > 1:
        return _compared(plots, images, exposure, shown)
    return _figure(plots) if shown is None else _mapped(plots, images, exposure, shown)


def _compared(
    plots: SelectionPlots, images: Mapping[str, Image], exposure: float, shown: Map | None
) -> Figure:
    """Draw all images, the map or else the difference, and the CHDs, in the colours of the page."""
    names = list(images)
    front, reference = plots.view.of_images(len(names))
    samples = {names[i]: [p.radiance for p in those] for i, those in plots.found.items()}
    differ = shown is None and front != reference
    return viz.renders_contrasted(
        images, samples, _marks(plots, len(names)), exposure=exposure,
        difference=(names[front], names[reference]) if differ else None,
        maps=[partial(_draw_map, shown)] if shown else [],
        colors={name: LIGHT[render_color(i)] for i, name in enumerate(names)},
    )  # fmt: skip


def _draw_map(shown: Map, ax: Axes) -> None:
    """Draw a map as the page does."""
    if not shown.names:
        viz.value_map(
            shown.values, title=shown.title, unit=shown.unit, limits=shown.limits,
            diverging=shown.diverging, log=shown.log, cmap=shown.colors_by_name, ax=ax,
        )  # fmt: skip
        return
    unknown = min(shown.names) - 1
    codes = np.nan_to_num(shown.values, nan=unknown).astype(int)
    viz.categorical_map(codes, shown.names, title=shown.title, colors=shown.colors, ax=ax)


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


def _figure(plots: SelectionPlots, fig: Any = None) -> Figure:
    """Draw the CHDs of the selection."""
    family = plots.view.families[0] if plots.view.families else ""
    drawn = [
        panel_of(place, _mark(key).name, family=family)
        for key, place in zip(plots.keys, plots.places, strict=True)
    ]
    colors = mark_colors(1)[: len(drawn)]
    return viz.chd_grid(drawn, columns=1 if len(drawn) == 1 else 2, colors=colors, fig=fig)


def _mapped(
    plots: SelectionPlots, images: Mapping[str, Image], exposure: float, shown: Map
) -> Figure:
    """Draw the image beside the map, and the CHDs below."""
    height, width = next(iter(images.values())).shape[:2]
    rows = -(-len(plots.places) // (1 if len(plots.places) == 1 else 2))
    heights = 3.2 * upright(height, width) + 0.4, 1.27 * rows + 0.5
    figure = page(None, sum(heights))
    parts: Any = figure.subfigures(2, 1, height_ratios=heights)
    above, below = parts
    _image(plots, images, exposure, shown, fig=above)
    _figure(plots, fig=below)
    return figure


def _image(
    plots: SelectionPlots,
    images: Mapping[str, Image],
    exposure: float,
    shown: Map | None,
    fig: Any = None,
) -> Figure:
    """Draw the image with the marks of the page, beside the map if there is one."""
    marks = _marks(plots, 1)
    image = np.nan_to_num(images[plots.name], nan=0.0, posinf=0.0, neginf=0.0)
    if shown is None:
        return viz.with_marks(image, marks, exposure=exposure, fig=fig)
    maps = [partial(_draw_map, shown)]
    return viz.renders_contrasted(
        {plots.name: image}, None, marks, maps=maps, exposure=exposure, fig=fig
    )


def _marks(plots: SelectionPlots, images: int) -> list[viz.Mark]:
    """Return the marks of the selection, in the colours of the page."""
    colors = mark_colors(images)
    return [replace(_mark(key), color=colors[i]) for i, key in enumerate(plots.keys)]


def _mark(key: PixelIndex | Box) -> viz.Mark:
    if len(key) == 2:
        y, x = key
        return viz.Mark(f"y {y}, x {x}", slice(y, y + 1), slice(x, x + 1), key)
    top, left, bottom, right = key
    center = ((top + bottom - 1) // 2, (left + right - 1) // 2)
    name = f"y {top} to {bottom - 1}, x {left} to {right - 1}"
    return viz.Mark(name, slice(top, bottom), slice(left, right), center)


def _pdf(
    plots: SelectionPlots, images: Mapping[str, Image], exposure: float, shown: Map | None
) -> bytes:
    figures = {"image": _image(plots, images, exposure, shown), "chds": _figure(plots)}
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
