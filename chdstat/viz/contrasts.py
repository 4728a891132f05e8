"""Contrasts: two pixels side by side, or one view rendered in two ways."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from chdstat._image_scales import display_stops
from chdstat.errors import InputError
from chdstat.viz.chd import Curve
from chdstat.viz.image import tonemap
from chdstat.viz.lettering import verbatim
from chdstat.viz.style import PALETTE, WIDTH, style

__all__ = ["firefly_pair", "view_pair"]

Array = npt.NDArray[Any]

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
        said = notes or {}
        labels = {name: f"{name}{': ' * (name in said)}{said.get(name, '')}" for name in pixels}
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
