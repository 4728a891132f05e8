"""Images: tone-mapped radiance with regions and their CHDs.

`with_marks` shows the regions of an image, `region_study` adds their CHDs, as in the case study of
Elek et al. 2019. `side_by_side` shows estimates, `firefly_pair` a firefly and its neighbour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from chdstat._core.arrays import Array, luminance
from chdstat._core.display import Width, channel_names
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.errors import InputError
from chdstat.fit.curves import Curve
from chdstat.summary.histograms import Scale, histogram
from chdstat.viz.chd import (
    MEAN,
    SCALES,
    Channels,
    Panel,
    batch_histograms,
    colors_of,
    draw_fit,
    draw_histograms,
    draw_means,
    one_of,
    panel_ranges,
    scales_of,
)
from chdstat.viz.styling import (
    HEIGHT,
    PALETTE,
    UNIT,
    bare,
    called,
    fitting,
    inches,
    ink_on,
    narrow,
    page,
    panels_in,
    qualitative,
    style,
    swatches,
    two_parts,
    upright,
    verbatim,
    within,
)

_PAIR = (PALETTE[5], PALETTE[4])
"""Colours of two things that are compared."""
_DASHES: tuple[Any, ...] = ("-", (0, (3, 1)), (0, (1, 0.8)))
"""Line styles of the channels if colours mark regions."""
_FRAMES = (PALETTE[0], PALETTE[1], PALETTE[2])
"""Colours of parts that are magnified."""
_OF_IMAGE = 0.43
"""Share of the width that the image of a study takes."""
_ROW, _ROWS = 0.68, 4.1
"""Largest height of a region, and of all of them, in inches."""
_FILLED = 0.55
"""Opacity of the histogram of a region."""
_NOTE = 17
"""Letters of a note per inch."""
_MARGIN = 7
"""Pixels shown around a firefly."""


_BESIDE = 0.24
"""Share of the width that an image beside batches takes."""


@dataclass(frozen=True)
class Mark:
    """A region to mark in an image.

    Parameters
    ----------
    name
        Label of the region.
    ys, xs
        Rows and columns of the region, in pixels.
    pixel
        (y, x) of the pixel in the region whose distribution is shown.
    color
        Of its frame; None takes that of its place in `chdstat.viz.PALETTE`.
    """

    name: str
    ys: slice
    xs: slice
    pixel: tuple[int, int]
    color: str | None = None


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
        Regions, coloured by `chdstat.viz.PALETTE` in order.
    exposure
        As in `tonemap`; image and insets share it.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.
    """
    shown, across = tonemap(image, exposure=exposure), inches(width, fig)
    aspect = upright(*shown.shape[:2])
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
        draw_inset(figure.add_subplot(cell), shown, mark, i, letters=letters)
    return figure


@style()
def batches_of_pixels(
    image: npt.ArrayLike,
    marks: Sequence[Mark],
    batches: Sequence[npt.ArrayLike],
    *,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw an image with marked pixels, and beside it their batches, as `batch_histograms` does.

    Parameters
    ----------
    image
        Linear radiance, shape (y, x, channel).
    marks
        The pixels.
    batches
        Radiance of each, shape (batch, sample).
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.
    """
    shown, across = tonemap(image), inches(width, fig)
    high = across * upright(*shown.shape[:2])
    figure, left, right = two_parts(fig, width, 2.1, _BESIDE, (high, 4.2))
    ax = left.subplots()
    draw_marked(ax, shown, marks)
    ax.set_anchor("N")
    named = {f"{i} {m.name}": x for i, (m, x) in enumerate(zip(marks, batches, strict=True), 1)}
    beside: Any = right  # a part of a figure is as good as one
    batch_histograms(named, fig=beside)
    return figure


def one_channel(image: npt.ArrayLike, channels: Channels) -> Array:
    """Return a channel of an image by name, or its luminance, of shape (y, x, 1).

    Raises
    ------
    InputError
        If it has no such channel, or there are several.
    """
    array = np.asarray(image, np.float64)
    names = channel_names(array.shape[-1])
    found = one_of([*names, "luminance"], channels)
    if found == "luminance":
        return luminance(array, channel_axis=-1)[..., np.newaxis]
    return array[..., [names.index(found)]]


def draw_marked(ax: Axes, shown: Array, marks: Sequence[Mark]) -> None:
    """Show an image with the frames and numbers of its marks."""
    ax.imshow(shown, interpolation="nearest")
    bare(ax)
    for i, (mark, usual) in enumerate(zip(marks, qualitative(len(marks)), strict=True)):
        color = mark.color or usual
        _outline(ax, mark.ys, mark.xs, color)
        ax.annotate(
            str(i + 1), (mark.xs.start - 0.5, mark.ys.start - 0.5), xytext=(-1, 1),
            textcoords="offset points", ha="right", va="bottom",
            fontweight="bold", color=ink_on(color), annotation_clip=True,
            bbox={"boxstyle": "round,pad=0.12", "facecolor": color, "edgecolor": "none"},
        )  # fmt: skip


def draw_inset(
    ax: Axes, shown: Array, mark: Mark, place: int, *, letters: int = 99, titled: bool = True
) -> None:
    """Show a region and its surroundings, with the pixel whose distribution is shown."""
    color = mark.color or qualitative(place + 1)[place]
    half = max(4, mark.ys.stop - mark.ys.start, mark.xs.stop - mark.xs.start)
    _magnify(ax, shown, mark.pixel, half)
    _frame(ax, mark.pixel, color, linewidth=1.2)
    ax.spines[:].set(visible=True, color=color, linewidth=2)
    title = fill(f"{place + 1} {verbatim(mark.name)}", letters) if titled else ""
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
    scales: Scale | Sequence[Scale] = "log",
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw an image with its regions, and each region with the CHD of its pixel.

    The log CHDs share one axis of radiance. Areas are histograms of the samples that are not null;
    with one channel, they have the colour of the region.

    Parameters
    ----------
    image
        Linear radiance, shape (y, x, channel).
    marks
        Regions, each with the pixel whose distribution is shown.
    panels
        CHDs of these pixels, in the same order, with their fits and means.
    notes
        A few words above the CHD of each region; None takes those of the panels.
    channels, scales
        Channels and scales of the CHDs, as for `chd_pair`; None takes luminance if it is known.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no region, a panel is missing, or an option is unknown.
    """
    if not marks or len(panels) != len(marks):
        message = f"expected a panel for each region, got {len(panels)} for {len(marks)}"
        raise InputError(message)
    shown, across, kinds = tonemap(image), inches(width, fig), scales_of(scales)
    lit = all("luminance" in panel.histograms("log") for panel in panels)
    wanted = "luminance" if channels is None and lit else channels
    panels = [panel.select(wanted) for panel in panels]
    rows, high = len(marks), across * upright(*shown.shape[:2])
    # Linear axes have ticks of their own, and take room from the image.
    (row, most), share = (_ROW, _ROWS), _OF_IMAGE
    if len(kinds) > 1:
        (row, most), share = (1.3 * _ROW, HEIGHT - 0.4), 0.8 * _OF_IMAGE
    listed, explained = min(row * rows, most) + 0.4, 0.2 * (1 + len(panels[0].log.counts)) + 0.3
    height = max(listed, share * high + explained)
    figure, left, right = two_parts(fig, width, height, share, (high + explained, listed))
    whole = left.subplots()
    draw_marked(whole, shown, marks)
    whole.set_anchor("N")
    ratios = [0.2, *[0.8 / len(kinds)] * len(kinds)]
    cells = right.subplots(rows, 1 + len(kinds), squeeze=False, width_ratios=ratios)
    colors = qualitative(rows)
    ranges = [None] * rows if panels[0].whole else panel_ranges(panels)
    for i, (mark, panel) in enumerate(zip(marks, panels, strict=True)):
        inset, *axes = cells[i]
        draw_inset(inset, shown, mark, i, titled=False)
        for ax, scale in zip(axes, kinds, strict=True):
            shared = scale == "log" and ranges[i] in ranges[i + 1 :]  # all bins are the same, too
            _draw_region(ax, panel, scale, colors[i], ranges[i] if scale == "log" else None)
            ax.tick_params(pad=1.5, labelbottom=not shared)
        note = notes[i] if i < len(notes) else panel.told
        room = (across if narrow(across) else across * (1 - share)) * ratios[1]
        title = within(f"{i + 1} {mark.name}", room - len(note) / _NOTE * (len(axes) == 1))
        axes[0].set_title(title, loc="left", pad=2, fontweight="bold")
        axes[-1].set_title(note, loc="right", pad=2, color="#444444")
    for column, scale in zip(cells.T[1:], kinds, strict=True):
        column[-1].set_xlabel(f"radiance in {UNIT}" + ", log scale" * (scale == "log"))
    whole.legend(
        handles=_explained(panels, colors[0]), loc="upper left", bbox_to_anchor=(-0.01, -0.01),
        borderaxespad=0.2, handlelength=1.6,
    )  # fmt: skip
    return figure


def _draw_region(
    ax: Axes, panel: Panel, scale: Scale, color: str, limits: tuple[float, float] | None
) -> None:
    """Draw the histograms, curves and means of a pixel, in the colour of its region or channels."""
    found = panel.histograms(scale)
    alone = len(found) == 1
    dark = tuple(0.6 * part for part in to_rgb(color))
    lines = [dark] if alone else colors_of(found)
    draw_histograms(
        ax, found, colors=[color] if alone else lines, outlines=lines, opacity=_FILLED * alone,
        limits=limits or panel.limits(scale), outside=not panel.whole,
    )  # fmt: skip
    curves = zip(found.values(), panel.fits, ["#111111"] if alone else lines, strict=False)
    for counted, fit, line in curves:
        if fit is not None:
            draw_fit(ax, counted, fit, color=line, linewidth=1.3)
    ax.spines["bottom"].set(color=color, linewidth=2)
    if scale == "linear":
        ax.locator_params(axis="x", nbins=3)
    draw_means(ax, panel.mean, lines)


def _explained(panels: Sequence[Panel], color: str) -> list[Artist]:
    """Return the swatches for the legend of `region_study`."""
    names, seen = [*panels[0].histograms("log")], "samples that are not null"
    handles: list[Artist] = [
        Patch(color=color, alpha=_FILLED, label=f"{seen}, {names[0]}".removesuffix(", channel0"))
    ]
    if len(names) > 1:
        shades = zip(names, colors_of(names), strict=True)
        handles = swatches({f"{seen}, {name}": shade for name, shade in shades})
    fits = [fit for panel in panels for fit in panel.fits]
    if any(fit.fit if isinstance(fit, Curve) else fit for fit in fits):
        handles += swatches({"fitted family or mixture": "#111111"}, linewidth=1.3)
    if any(panel.mean for panel in panels):
        handles += swatches({"mean": "#444444"}, linestyle=MEAN)
    return handles


@style()
def side_by_side(
    images: Mapping[str, npt.ArrayLike],
    *,
    insets: Sequence[tuple[slice, slice]] = (),
    notes: Mapping[str, str] | None = None,
    columns: int | None = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw images side by side with one exposure, with magnified parts below.

    Parameters
    ----------
    images
        Linear radiance (y, x, channel) by title or name of an estimator; the last one sets the
        exposure.
    insets
        Rows and columns of parts to magnify below each image; frames mark them in the image.
    notes
        A line below each title, by the same titles, such as an error.
    columns
        Most images in a row; None takes as many as have an inch each.
    width
        Width of the figure: "column", "page" or inches.
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
    exposure, across = display_stops(last), inches(width, fig)
    columns = fitting(across, min(columns or len(images), len(images)), 1.0)
    rows, aspect = -(-len(images) // columns), upright(*last.shape[:2])
    parts = [aspect, max(map(_aspect, insets)) / len(insets)] if insets else [aspect]
    each = 0.92 * across / columns * sum(parts) + 0.35
    figure = page(fig, rows * each, width, hspace=0.02, wspace=0.02)
    cells = figure.add_gridspec(rows, columns)
    for i, (title, image) in enumerate(images.items()):
        shown = tonemap(image, exposure=exposure)
        own = cells[i // columns, i % columns].subgridspec(
            len(parts), max(1, len(insets)), height_ratios=parts
        )
        ax = figure.add_subplot(own[0, :])
        ax.imshow(shown, interpolation="nearest")
        note = (notes or {}).get(title, "")
        bare(ax, within(called(title), across / columns) + (f"\n{note}" if note else ""))
        for k, (ys, xs) in enumerate(insets):
            color = _FRAMES[k % len(_FRAMES)]
            _outline(ax, ys, xs, color)
            part = figure.add_subplot(own[1, k])
            part.imshow(shown[ys, xs], interpolation="nearest")
            part.set(xticks=[], yticks=[])
            part.spines[:].set(visible=True, color=color, linewidth=1.6)
    return figure


def _aspect(part: tuple[slice, slice]) -> float:
    ys, xs = part
    return float((ys.stop - ys.start) / (xs.stop - xs.start))


def _outline(ax: Axes, ys: slice, xs: slice, color: str) -> None:
    """Frame a part of an image, visible on any background."""
    corner = (xs.start - 0.5, ys.start - 0.5)
    extent = (xs.stop - xs.start, ys.stop - ys.start)
    for edge, width in (("black", 2.4), (color, 1.4)):
        ax.add_patch(Rectangle(corner, *extent, fill=False, edgecolor=edge, linewidth=width))


@style()
def firefly_pair(
    image: npt.ArrayLike,
    pixels: Mapping[str, tuple[int, int]],
    samples: Mapping[str, npt.ArrayLike],
    *,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw an estimate around a firefly, and the CHDs of the firefly and its neighbour.

    Parameters
    ----------
    image
        The estimate with the firefly: linear radiance, shape (y, x, channel).
    pixels
        (y, x) of the firefly, then of its neighbour, by name.
    samples
        Of one channel of them, shape (sample,), by the same names.
    width
        Width of the figure: "column", "page" or inches.
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
    for ax, scale in zip((left, right), SCALES, strict=True):
        counted = {n: histogram(x, scale=scale, bad=~np.isfinite(x)) for n, x in samples.items()}
        draw_histograms(ax, counted, colors=_PAIR, dashes=_DASHES)
    left.set_xlabel(f"radiance\n({UNIT})" if tight else f"radiance ({UNIT})")
    right.set_xlabel("radiance,\nlog scale" if tight else "the same on a logarithmic scale")
    if left.patches and tight:
        handles, names = left.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper center", ncols=2)
    elif left.patches:
        left.legend(loc="upper right")
    return figure
