"""Images: linear radiance as a person would see it, with regions, CHDs of these, and errors.

`with_marks` and `region_study` show the regions of an image, the latter with their CHDs, as in the
case study of Elek et al. 2019; `side_by_side` shows estimates and their errors, `firefly_pair` two
pixels, `view_pair` one view that was rendered in two ways.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from chdstat._core.arrays import Array, luminance
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.errors import InputError
from chdstat.summary.histograms import Histogram, Scale
from chdstat.viz.chd import SCALES, Channels, Panel, by_channel, chosen, draw_histograms, scales_of
from chdstat.viz.estimators import called
from chdstat.viz.styling import (
    PALETTE,
    UNIT,
    Width,
    bare,
    blocks,
    fitting,
    grid,
    inches,
    ink_on,
    narrow,
    page,
    panels_in,
    qualitative,
    style,
    verbatim,
)

__all__ = [
    "Mark",
    "draw_marked",
    "firefly_pair",
    "one_channel",
    "region_study",
    "side_by_side",
    "tonemap",
    "view_pair",
    "with_marks",
]


_PAIR = (PALETTE[5], PALETTE[4])
"""Colours of two things that are compared."""
_DASHES: tuple[Any, ...] = ("-", (0, (3, 1)), (0, (1, 0.8)))
"""Of the channels, where the colour is that of the region."""
_ROW = 0.8
"""Height of a row of regions in a study, in inches."""
_LINE = 0.17
"""Height of a line of its list."""
_MARGIN = 7
"""Pixels shown around a firefly."""


@dataclass(frozen=True)
class Mark:
    """A region to mark in an image.

    Parameters
    ----------
    name
        What is written beside it.
    ys, xs
        Rows and columns of the region, in pixels.
    pixel
        (y, x) of the pixel in it whose distribution is shown.
    """

    name: str
    ys: slice
    xs: slice
    pixel: tuple[int, int]


@style()
def with_marks(
    image: npt.ArrayLike,
    marks: Sequence[Mark] = (),
    *,
    exposure: float | None = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw an image with coloured marks and, beside or below it, each marked region magnified.

    Parameters
    ----------
    image
        Linear radiance, shape (y, x, channel).
    marks
        Regions; each has its colour of `chdstat.viz.PALETTE`, in order.
    exposure
        As in `tonemap`; image and insets share it.
    width
        Of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.
    """
    shown, across = tonemap(image, exposure=exposure), inches(width, fig)
    aspect = shown.shape[0] / shown.shape[1]
    if narrow(across):
        columns = fitting(across, max(1, len(marks)), 1.1)
        letters = int(14 * across / columns)
        rows = -(-len(marks) // columns)
        high = across * aspect
        figure = page(fig, high + 1.2 * across / columns * rows, width)
        ratios = [high, *[1.2 * across / columns] * rows]
        cells = figure.add_gridspec(1 + rows, columns, height_ratios=ratios)
        main, places = (
            cells[0, :],
            [cells[1 + i // columns, i % columns] for i in range(len(marks))],
        )
    else:
        rows, letters = max(1, -(-len(marks) // 2)), int(14 * across / 6.2)
        share, columns = (0.64, 2) if marks else (1.0, 0)
        figure = page(fig, max(across * share * aspect, 1.05 * rows), width)
        cells = figure.add_gridspec(rows, 1 + columns, width_ratios=[4.2, *[1] * columns])
        main, places = cells[:, 0], [cells[i % rows, 1 + i // rows] for i in range(len(marks))]
    draw_marked(figure.add_subplot(main), shown, marks)
    for i, (mark, cell) in enumerate(zip(marks, places, strict=True)):
        _inset(figure.add_subplot(cell), shown, mark, i, letters=letters)
    return figure


def one_channel(image: npt.ArrayLike, channels: Channels) -> Array:
    """Return a channel of an image by its name, or its luminance, of shape (y, x, 1).

    Raises
    ------
    InputError
        If it has no such channel, or several are asked for.
    """
    array = np.asarray(image, np.float64)
    names = ["R", "G", "B"] if array.shape[-1] == 3 else ["channel0"]
    found = chosen([*names, "luminance"], channels)
    if len(found) != 1:
        message = f"an image is drawn in colours, or one channel in grey, got {channels!r}"
        raise InputError(message)
    if found == ["luminance"]:
        return luminance(array, channel_axis=-1)[..., np.newaxis]
    return array[..., [names.index(found[0])]]


def draw_marked(ax: Axes, shown: Array, marks: Sequence[Mark]) -> None:
    """Show an image with the frames and numbers of its marks."""
    ax.imshow(shown, interpolation="nearest")
    bare(ax)
    for i, (mark, color) in enumerate(zip(marks, qualitative(len(marks)), strict=True)):
        corner = (mark.xs.start - 0.5, mark.ys.start - 0.5)
        extent = (mark.xs.stop - mark.xs.start, mark.ys.stop - mark.ys.start)
        for edge, width in (("black", 2.4), (color, 1.4)):
            ax.add_patch(Rectangle(corner, *extent, fill=False, edgecolor=edge, linewidth=width))
        ax.annotate(
            str(i + 1), corner, xytext=(-1, 1), textcoords="offset points", ha="right", va="bottom",
            fontweight="bold", color=ink_on(color), annotation_clip=True,
            bbox={"boxstyle": "round,pad=0.12", "facecolor": color, "edgecolor": "none"},
        )  # fmt: skip


def _inset(ax: Axes, shown: Array, mark: Mark, place: int, *, letters: int = 99) -> None:
    """Show a region and what is around it, with the pixel whose distribution is of interest."""
    color = qualitative(place + 1)[place]
    half = max(4, mark.ys.stop - mark.ys.start, mark.xs.stop - mark.xs.start)
    _magnify(ax, shown, mark.pixel, half)
    _frame(ax, mark.pixel, color, linewidth=1.2)
    ax.spines[:].set(visible=True, color=color, linewidth=2)
    title = fill(f"{place + 1} {verbatim(mark.name)}", letters)
    ax.set_title(title, loc="left", pad=2, fontweight="bold")


def _magnify(ax: Axes, shown: Array, pixel: tuple[int, int], half: int) -> None:
    """Show the pixels at most `half` away from one."""
    y, x = pixel
    ax.imshow(shown, interpolation="nearest")
    ax.set(xlim=(x - half - 0.5, x + half + 0.5), ylim=(y + half + 0.5, y - half - 0.5))
    ax.set(xticks=[], yticks=[], facecolor="#EEEEEE")


def _frame(ax: Axes, pixel: tuple[int, int], color: str, *, linewidth: float) -> None:
    y, x = pixel
    corner = (x - 0.5, y - 0.5)
    ax.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor=color, linewidth=linewidth))


@style()
def region_study(
    image: npt.ArrayLike,
    marks: Sequence[Mark],
    panels: Sequence[Panel],
    *,
    notes: Sequence[str] = (),
    channels: Channels = None,
    scales: Scale | Sequence[Scale] = SCALES,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw an image with its regions, and the CHD of one pixel of each.

    Parameters
    ----------
    image
        Linear radiance, shape (y, x, channel).
    marks
        Regions, each with the pixel whose distribution is shown.
    panels
        CHDs of these pixels, in the same order; fits are not drawn.
    notes
        A line of text for each region, beside or below the image.
    channels, scales
        Of the CHDs, as for `chd_pair`.
    width
        Of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no region, not a panel for each, or an option is unknown.
    """
    if not marks or len(panels) != len(marks):
        message = f"expected a panel for each region, got {len(panels)} for {len(marks)}"
        raise InputError(message)
    shown, across, kinds = tonemap(image), inches(width, fig), scales_of(scales)
    panels = [panel.select(channels) for panel in panels]
    aspect = shown.shape[0] / shown.shape[1]
    columns = 1 if narrow(across) else 2
    rows = -(-len(marks) // columns)
    bottom = _ROW * rows + 0.3
    if columns == 1:
        high, listed = min(across * aspect, 0.9 * across), _LINE * len(marks)
        top = high + listed
    else:
        top = min(0.38 * across * aspect, 0.5 * across)
    figure = page(fig, top + bottom, width, wspace=0.01, hspace=0.02)
    upper, lower = figure.subfigures(2, 1, height_ratios=[top, bottom], squeeze=False).flat
    if columns == 1:
        overview, names = upper.subplots(2, 1, height_ratios=[high, listed])
    else:
        overview, names = upper.subplots(1, 2)
    draw_marked(overview, shown, marks)
    _list_regions(names, marks, notes, least=1 if columns == 1 else 6)
    each = 1 + len(kinds)
    ratios = [1, *[2.9 / len(kinds)] * len(kinds)] * columns
    axes = lower.subplots(rows, each * columns, squeeze=False, width_ratios=ratios)
    # Regions are numbered down the columns.
    cells = np.concatenate(np.split(axes, columns, axis=1))
    for i, (mark, panel) in enumerate(zip(marks, panels, strict=True)):
        inset, *own = cells[i]
        _inset(inset, shown, mark, i)
        _region_chds(own, panel, kinds, qualitative(len(marks))[i])
    for empty in cells[len(marks) :].flat:
        empty.set_axis_off()
    _name_dashes(lower, list(by_channel(panels[0].log, panels[0].channels)), kinds, across)
    return figure


def _name_dashes(
    figure: FigureBase, channels: Sequence[str], kinds: Sequence[Scale], across: float
) -> None:
    """Say below the CHDs of regions what they show, and which line is which channel."""
    scales = " and ".join("logarithmic" if scale == "log" else scale for scale in kinds)
    quantity = channels[0] if channels == ["luminance"] else "radiance"
    title = f"densities of {quantity} in {UNIT}, {scales}"
    handles = []
    if len(channels) > 1:
        look: dict[str, Any] = {"color": "#333333", "linewidth": 0.9}
        handles = [
            Line2D([], [], linestyle=_DASHES[i % 3], label=verbatim(name), **look)
            for i, name in enumerate(channels)
        ]
    if narrow(across):
        below: dict[str, Any] = {"title": title, "title_fontsize": 8, "ncols": max(1, len(handles))}
    else:
        handles.insert(
            0, Line2D([], [], linestyle="", label=f"{title}; channels:" if handles else title)
        )
        below = {"ncols": len(handles)}
    figure.legend(handles=handles, loc="outside lower center", handlelength=2, **below)


def _list_regions(ax: Axes, marks: Sequence[Mark], notes: Sequence[str], *, least: int) -> None:
    """List numbers and names of regions with their notes."""
    ax.set_axis_off()
    ax.set(xlim=(0, 1), ylim=(0, 1))
    for i, (mark, color) in enumerate(zip(marks, qualitative(len(marks)), strict=True)):
        y = 1 - (i + 0.5) / max(len(marks), least)
        ax.text(
            0.01, y, str(i + 1), fontweight="bold", color=ink_on(color), ha="center", va="center",
            bbox={"boxstyle": "round,pad=0.2", "facecolor": color, "edgecolor": "none"},
        )  # fmt: skip
        ax.text(0.06, y, verbatim(mark.name), fontweight="bold", va="center")
        if i < len(notes):
            ax.text(0.40, y, notes[i], va="center", color="#333333")


def _region_chds(axes: Sequence[Axes], panel: Panel, kinds: Sequence[Scale], color: str) -> None:
    """Draw the CHD of a region's pixel in the colour of the region."""
    dark = tuple(0.6 * part for part in to_rgb(color))
    for ax, scale in zip(axes, kinds, strict=True):
        found = by_channel(panel.linear if scale == "linear" else panel.log, panel.channels)
        several = len(found)
        draw_histograms(
            ax, found, colors=[color] * several, outlines=[dark] * several, dashes=_DASHES
        )
        ax.spines["bottom"].set(color=color, linewidth=2)
        ax.tick_params(pad=1.5)
        if scale == "linear":
            ax.locator_params(axis="x", nbins=3)
    axes[-1].set_title(panel.note, loc="right", pad=2, color="#444444")


@style()
def side_by_side(
    images: Mapping[str, npt.ArrayLike],
    *,
    errors: Mapping[str, npt.ArrayLike] | None = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw images side by side under one exposure, each with its squared error below.

    Parameters
    ----------
    images
        Linear radiance (y, x, channel) by title, or by the name of an estimator; the last sets the
        exposure.
    errors
        Squared error (y, x) by the same titles; drawn on one logarithmic colour scale.
    width
        Of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no image.
    """
    if not images:
        message = "expected at least one image, got none"
        raise InputError(message)
    last = np.asarray(list(images.values())[-1])
    exposure = display_stops(last)
    count, rows, across = len(images), 2 if errors else 1, inches(width, fig)
    columns = fitting(across, count, 1.0)
    parts = -(-count // columns)
    aspect = last.shape[0] / last.shape[1]
    figure = page(fig, parts * (rows * 0.92 * across / columns * aspect + 0.35), width)
    seen, *below = blocks(figure, count, columns, rows)
    for ax, (title, image) in zip(seen, images.items(), strict=True):
        ax.imshow(tonemap(image, exposure=exposure), interpolation="nearest")
        bare(ax, verbatim(called(title)))
    if errors:
        for ax in below[0]:
            bare(ax)
        _draw_errors(figure, dict(zip(images, below[0], strict=True)), errors)
    return figure


def _draw_errors(
    figure: Figure, axes: Mapping[str, Axes], errors: Mapping[str, npt.ArrayLike]
) -> None:
    """Draw squared errors as decades on one colour scale."""
    with np.errstate(divide="ignore"):
        decades = {title: np.log10(np.asarray(v, dtype=float)) for title, v in errors.items()}
    finite = np.concatenate([d[np.isfinite(d)] for d in decades.values()])
    low, high = np.percentile(finite, (2, 99.5)) if finite.size else (-1.0, 0.0)
    for title, values in decades.items():
        shown = np.maximum(values, low)  # no error at all is as dark as the least
        drawn = axes[title].imshow(shown, vmin=low, vmax=high, cmap="magma")
    below = list(axes.values())
    bar = figure.colorbar(drawn, ax=below, orientation="vertical", fraction=0.03, pad=0.01)
    bar.set_label("log10 squared error")


@style()
def firefly_pair(
    image: npt.ArrayLike,
    pixels: Mapping[str, tuple[int, int]],
    linear: Mapping[str, Histogram],
    log: Mapping[str, Histogram],
    *,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw an estimate around a firefly, and the CHDs of the firefly and its neighbour.

    Parameters
    ----------
    image
        The estimate in which the firefly is seen: linear radiance, shape (y, x, channel).
    pixels
        (y, x) by name: the firefly, then its neighbour.
    linear, log
        Histograms of one channel, shape (bin,), by the same names.
    width
        Of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there are not two pixels.
    """
    if len(pixels) != 2:
        message = f"expected a firefly and its neighbour, got {len(pixels)} pixels"
        raise InputError(message)
    tight = narrow(inches(width, fig))
    figure, (seen, left, right) = panels_in(fig, 3, 3, 1.6, width, width_ratios=[1, 1.6, 1.6])
    _magnify(seen, tonemap(image), next(iter(pixels.values())), _MARGIN)
    for color, pixel in zip(_PAIR, pixels.values(), strict=True):
        _frame(seen, pixel, color, linewidth=1.5)
    for ax, counted in ((left, linear), (right, log)):
        ax.set_xlim(draw_histograms(ax, counted, colors=_PAIR, dashes=_DASHES))
    left.set_xlabel(f"radiance\n({UNIT})" if tight else f"radiance ({UNIT})")
    right.set_xlabel("radiance,\nlog scale" if tight else "the same on a logarithmic scale")
    if left.patches and tight:
        handles, names = left.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper center", ncols=2)
    elif left.patches:
        left.legend(loc="upper right")
    return figure


@style()
def view_pair(
    images: Mapping[str, npt.ArrayLike],
    log: Mapping[str, Mapping[str, Histogram]],
    *,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw one view rendered in two ways under one exposure, and CHDs of its regions.

    Parameters
    ----------
    images
        Linear radiance (y, x, channel) by name; the last sets the exposure.
    log
        By region, then by the names of the images: log histograms of shape (bin,). The first four
        are drawn.
    width
        Of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there are not two images.
    """
    if len(images) != 2:
        message = f"expected two images of one view, got {len(images)}"
        raise InputError(message)
    first, second = images.values()
    across, aspect = inches(width, fig), np.shape(first)[0] / np.shape(first)[1]
    if narrow(across):
        high = 0.47 * across * aspect + 0.25
        figure = page(fig, high + 2.0, width)
        left, right = figure.subfigures(2, 1, height_ratios=[high, 2.0], squeeze=False).flat
    else:
        figure = page(fig, max(0.225 * across * aspect, 1.5) + 0.35, width)
        left, right = figure.subfigures(1, 2, width_ratios=[1.05, 1], squeeze=False).flat
    exposure = display_stops(second)
    for ax, (name, image), color in zip(grid(left, 2, 2), images.items(), _PAIR, strict=True):
        ax.imshow(tonemap(image, exposure=exposure), interpolation="nearest")
        bare(ax)
        ax.set_title(verbatim(name), color=color, fontweight="bold")
    shown = dict(list(log.items())[:4])
    for ax, (region, found) in zip(right.subplots(2, 2).flat, shown.items(), strict=False):
        ax.set_xlim(draw_histograms(ax, found, colors=_PAIR, dashes=_DASHES))
        ax.set_title(verbatim(region), loc="left", pad=2)
        ax.tick_params(pad=1.5)
    for empty in right.axes[len(shown) :]:
        empty.set_axis_off()
    right.supxlabel(f"radiance in {UNIT}")
    return figure
