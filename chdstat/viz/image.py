"""Images: linear radiance as a person would see it, with marks, insets and errors.

`firefly_pair` shows two pixels side by side, `view_pair` one view that was rendered in two ways.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from chdstat._core.image_scales import display_stops
from chdstat.errors import InputError
from chdstat.viz.chd import Curve
from chdstat.viz.styling import HEIGHT, PALETTE, WIDTH, style, verbatim

__all__ = ["Mark", "firefly_pair", "side_by_side", "tonemap", "view_pair", "with_marks"]

Array = npt.NDArray[Any]


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


def tonemap(image: npt.ArrayLike, *, exposure: float | None = None) -> npt.NDArray[np.float64]:
    """Return display values for linear radiance: exposure, then the sRGB curve, clipped to [0, 1].

    Parameters
    ----------
    image
        Linear radiance, shape (y, x, channel) with 1 or 3 channels.
    exposure
        Stops. None puts the 90th percentile near white, which suits interiors, or up to three stops
        above it where windows or lamps would leave all else dark.

    Returns
    -------
    ndarray
        Shape (y, x, 3), in [0, 1]; pixels that are not finite are magenta, to be seen.

    Raises
    ------
    InputError
        If the shape is not (y, x, 1) or (y, x, 3).

    Examples
    --------
    >>> import numpy as np
    >>> tonemap(np.full((1, 1, 3), 1.0), exposure=-1).round(3)
    array([[[0.735, 0.735, 0.735]]])
    """
    linear = np.asarray(image, dtype=np.float64)
    if linear.ndim != 3 or linear.shape[2] not in {1, 3}:
        message = f"an image must have shape (y, x, 1) or (y, x, 3), got {linear.shape}"
        raise InputError(message)
    linear = np.broadcast_to(linear, (*linear.shape[:2], 3))
    finite = np.asarray(np.isfinite(linear).all(axis=-1))
    stops = display_stops(linear[finite]) if exposure is None else exposure
    value = np.clip(np.where(finite[..., None], linear, 0) * 2.0**stops, 0, 1)
    curve = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.where(finite[..., None], curve, (1.0, 0.0, 1.0))


def with_marks(
    image: npt.ArrayLike, marks: Sequence[Mark] = (), *, exposure: float | None = None
) -> Figure:
    """Draw an image with coloured marks and, beside it, each marked region magnified.

    Parameters
    ----------
    image
        Linear radiance, shape (y, x, channel).
    marks
        Regions; each has its colour of `chdstat.viz.PALETTE`, in order.
    exposure
        As in `tonemap`; image and insets share it.
    """
    shown = tonemap(image, exposure=exposure)
    columns = 2 if marks else 0
    rows = max(1, -(-len(marks) // 2))
    share = 0.64 if marks else 1.0
    aspect = shown.shape[0] / shown.shape[1]
    with style():
        height = max(WIDTH * share * aspect, 1.05 * rows)
        figure = Figure(figsize=(WIDTH, min(height, HEIGHT)), layout="constrained")
        grid = figure.add_gridspec(rows, 1 + columns, width_ratios=[4.2, *[1] * columns])
        main = figure.add_subplot(grid[:, 0])
        _show(main, shown)
        for i, mark in enumerate(marks):
            color = PALETTE[i % len(PALETTE)]
            _mark(main, mark, color, number=i + 1)
            _inset(figure.add_subplot(grid[i % rows, 1 + i // rows]), shown, mark, color, i + 1)
    return figure


def _show(axes: Axes, shown: Array) -> None:
    axes.imshow(shown, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def _mark(axes: Axes, mark: Mark, color: str, *, number: int) -> None:
    height, width = mark.ys.stop - mark.ys.start, mark.xs.stop - mark.xs.start
    corner = (mark.xs.start - 0.5, mark.ys.start - 0.5)
    axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor="black", linewidth=2.4))
    axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=color, linewidth=1.4))
    axes.annotate(
        str(number),
        (mark.xs.start - 0.5, mark.ys.start - 0.5),
        xytext=(-1, 1),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=7,
        fontweight="bold",
        color="black",
        bbox={"boxstyle": "round,pad=0.15", "facecolor": color, "edgecolor": "none"},
        annotation_clip=True,
    )


def _inset(axes: Axes, shown: Array, mark: Mark, color: str, number: int) -> None:
    """Show the surroundings of a mark, about three times its size, with its pixel."""
    y, x = mark.pixel
    half = max(4, mark.ys.stop - mark.ys.start, mark.xs.stop - mark.xs.start)
    axes.imshow(shown, interpolation="nearest")
    axes.set(
        xlim=(x - half - 0.5, x + half + 0.5),
        ylim=(y + half + 0.5, y - half - 0.5),
        xticks=[],
        yticks=[],
        facecolor="#EEEEEE",
    )
    axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, fill=False, edgecolor=color, linewidth=1.2))
    axes.spines[:].set(visible=True, color=color, linewidth=2)
    axes.set_title(f"{number} {verbatim(mark.name)}", fontsize=7.5, pad=4)


def side_by_side(
    images: Mapping[str, npt.ArrayLike],
    *,
    errors: Mapping[str, npt.ArrayLike] | None = None,
    exposure: float | None = None,
    crop: tuple[slice, slice] | None = None,
) -> Figure:
    """Draw images side by side under one exposure, each with its squared error below.

    Parameters
    ----------
    images
        Linear radiance (y, x, channel) by title; the last sets the exposure where none is given.
    errors
        Squared error (y, x) by the same titles; drawn on one logarithmic colour scale.
    exposure
        As in `tonemap`.
    crop
        Rows and columns to show.

    Raises
    ------
    InputError
        If there is no image.
    """
    if not images:
        message = "side_by_side needs at least one image, got none"
        raise InputError(message)
    window = crop or (slice(None), slice(None))
    exposed = np.asarray(list(images.values())[-1])[window]
    if exposure is None:
        exposure = display_stops(exposed)
    rows = 2 if errors else 1
    with style():
        height, width = np.shape(exposed)[:2]
        each = 0.92 * WIDTH / len(images) * height / width
        figure = Figure(figsize=(WIDTH, min(rows * each + 0.35, HEIGHT)), layout="constrained")
        axes = figure.subplots(rows, len(images), squeeze=False)
        for column, (title, image) in zip(axes.T, images.items(), strict=True):
            _show(column[0], tonemap(np.asarray(image)[window], exposure=exposure))
            column[0].set_title(title)
        if errors:
            _error_row(figure, list(axes[1]), list(images), errors, window)
    return figure


def _error_row(
    figure: Figure,
    axes: list[Axes],
    titles: list[str],
    errors: Mapping[str, npt.ArrayLike],
    crop: tuple[slice, slice],
) -> None:
    """Draw squared errors as decades on one colour scale."""
    with np.errstate(divide="ignore"):
        decades = {k: np.log10(np.asarray(v, dtype=float)[crop]) for k, v in errors.items()}
    finite = np.concatenate([d[np.isfinite(d)] for d in decades.values()] or [np.zeros(0)])
    low, high = np.percentile(finite, (2, 99.5)) if finite.size else (-1.0, 0.0)
    drawn = None
    for ax, title in zip(axes, titles, strict=True):
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
        if title in decades:
            shown = np.maximum(decades[title], low)  # no error at all is as dark as the least
            drawn = ax.imshow(shown, vmin=low, vmax=high, cmap="magma")
    if drawn is not None:
        bar = figure.colorbar(drawn, ax=axes, orientation="vertical", fraction=0.03, pad=0.01)
        bar.set_label("log10 squared error")


_COLORS = (PALETTE[5], PALETTE[4])
_DASHES = ("-", "--")


def firefly_pair(
    image: npt.ArrayLike,
    pixels: Mapping[str, tuple[int, int]],
    linear: Mapping[str, Curve],
    log: Mapping[str, Curve],
    *,
    notes: Mapping[str, str] | None = None,
    margin: int = 7,
) -> Figure:
    """Draw an estimate around a firefly, and the CHDs of the firefly and its neighbour.

    Parameters
    ----------
    image
        The estimate in which the firefly is seen: linear radiance, shape (y, x, channel).
    pixels
        (y, x) by name: the firefly, then its neighbour.
    linear, log
        Histograms of one channel by the same names.
    notes
        A few words on each, by the same names.
    margin
        Pixels shown around the firefly.

    Raises
    ------
    InputError
        If there are not two pixels.
    """
    if len(pixels) != 2:
        message = f"expected a firefly and its neighbour, got {len(pixels)} pixels"
        raise InputError(message)
    shown = tonemap(image)
    with style():
        figure = Figure(figsize=(WIDTH, 1.6), layout="constrained")
        axes = figure.subplots(1, 3, width_ratios=[1, 1.6, 1.6])
        axes[0].imshow(shown, interpolation="nearest")
        y, x = next(iter(pixels.values()))
        axes[0].set(
            xlim=(x - margin - 0.5, x + margin + 0.5), ylim=(y + margin + 0.5, y - margin - 0.5)
        )
        axes[0].set(xticks=[], yticks=[], facecolor="#EEEEEE")
        for color, (row, column) in zip(_COLORS, pixels.values(), strict=True):
            corner = (column - 0.5, row - 0.5)
            axes[0].add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor=color, linewidth=1.5))
        known = notes or {}
        labels = {name: f"{name}{': ' * (name in known)}{known.get(name, '')}" for name in pixels}
        _overlay(axes[1], {labels[n]: c for n, c in linear.items()})
        _overlay(axes[2], {labels[n]: c for n, c in log.items()}, log=True)
        axes[1].set_xlabel("radiance in W sr$^{-1}$ m$^{-2}$")
        axes[2].set_xlabel("the same on a logarithmic scale")
        if axes[1].patches:
            axes[1].legend(loc="upper right", fontsize=7)
    return figure


def view_pair(
    images: Mapping[str, npt.ArrayLike],
    log: Mapping[str, Mapping[str, Curve]],
) -> Figure:
    """Draw one view rendered in two ways under one exposure, and CHDs of its regions.

    Parameters
    ----------
    images
        Linear radiance (y, x, channel) by name; the last sets the exposure.
    log
        By region, then by the names of the images: histograms on the logarithmic scale. The first
        four are drawn.

    Raises
    ------
    InputError
        If there are not two images.
    """
    if len(images) != 2:
        message = f"expected two images of one view, got {len(images)}"
        raise InputError(message)
    exposure = display_stops(list(images.values())[1])
    with style():
        height = 0.225 * WIDTH * np.shape(next(iter(images.values())))[0]
        height /= np.shape(next(iter(images.values())))[1]
        figure = Figure(figsize=(WIDTH, max(height, 1.5) + 0.35), layout="constrained")
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.05, 1])[0]
        for i, (cell, (name, image)) in enumerate(
            zip(left.subplots(1, 2), images.items(), strict=True)
        ):
            cell.imshow(tonemap(image, exposure=exposure), interpolation="nearest")
            cell.set(xticks=[], yticks=[])
            cell.spines[:].set_visible(False)
            cell.set_title(verbatim(name), fontsize=8, color=_COLORS[i], fontweight="bold")
        cells = right.subplots(2, 2, squeeze=False).ravel()
        shown = list(log.items())[:4]
        for cell, (region, curves) in zip(cells, shown, strict=False):
            _overlay(cell, {n: curves[n] for n in images if n in curves}, log=True)
            cell.set_title(verbatim(region), fontsize=7, loc="left", pad=2)
            cell.tick_params(labelsize=6, pad=1.5)
        for cell in cells[len(shown) :]:
            cell.set_axis_off()
        right.supxlabel("radiance in W sr$^{-1}$ m$^{-2}$", fontsize=7)
    return figure


def _overlay(axes: Axes, curves: Mapping[str, Curve], *, log: bool = False) -> None:
    spans = []
    for color, dash, (name, curve) in zip(_COLORS, _DASHES, curves.items(), strict=False):
        if not (np.isfinite(curve.edges).all() and np.isfinite(curve.density).all()):
            continue
        axes.stairs(curve.density, curve.edges, fill=True, color=color, alpha=0.2)
        axes.stairs(
            curve.density, curve.edges, color=color, linewidth=0.9, linestyle=dash, label=name
        )
        filled = np.flatnonzero(curve.density > 0)
        spans += [(curve.edges[filled[0]], curve.edges[filled[-1] + 1])] if filled.size else []
    if log:
        axes.set_xscale("log")
    else:
        axes.locator_params(axis="x", nbins=4)
    if spans:
        axes.set_xlim(min(s[0] for s in spans), max(s[1] for s in spans))
    axes.set(yticks=[])
    axes.set_ylim(bottom=0)
    axes.spines["left"].set_visible(False)
