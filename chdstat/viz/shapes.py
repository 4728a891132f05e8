"""Shapes: the atlas of recurring distributions, as a map and as small multiples."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from chdstat.atlases import Atlas
from chdstat.viz.style import HEIGHT, MISSING, WIDTH, qualitative, style

__all__ = ["atlas"]

_VISIBLE = 0.01
"""Density, relative to the highest, below which no panel needs to reach."""
_OF_MAP = 0.4
"""Share of the width that the map takes: the figure then fits below others on a page."""


def atlas(found: Atlas) -> Figure:
    """Draw where the shapes of an atlas are, and what each looks like.

    Numbers in the map mark the most typical pixel of each shape. The panels show the mean density
    of log10 radiance around the scale of a pixel, and its quartiles over the pixels as a band.

    Parameters
    ----------
    found
        What `chdstat.atlas` found.
    """
    number = len(found.share)
    columns = 2 if number <= 8 else 3
    rows = max(2, -(-number // columns))
    aspect = found.labels.shape[0] / found.labels.shape[1]
    with style():
        height = max(_OF_MAP * WIDTH * aspect + 0.2, 0.8 * rows + 0.3)
        figure = Figure(figsize=(WIDTH, min(height, HEIGHT)), layout="constrained")
        ratios = [_OF_MAP, 1 - _OF_MAP]
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=ratios)[0]
        _map(left.subplots(), found)
        panels = right.subplots(rows, columns, squeeze=False).ravel()
        for k, axes in enumerate(panels):
            if k < number:
                _panel(axes, found, k)
                axes.tick_params(labelbottom=k + columns >= number)
            else:
                axes.set_axis_off()
        right.supxlabel("decades from the mean of log10 radiance", fontsize=8)
    return figure


def _map(axes: Axes, found: Atlas) -> None:
    number = max(1, len(found.share))
    shades = ListedColormap(qualitative(number)).with_extremes(bad=MISSING)
    shown = np.ma.masked_less(found.labels, 0)
    norm = BoundaryNorm(np.arange(number + 1) - 0.5, number)
    axes.imshow(shown, cmap=shades, norm=norm, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    missing = float((found.labels < 0).mean())
    note = f"   (grey: none, {_percent(missing)})" if missing else ""
    axes.set_title(f"Shape of each pixel{note}")
    for k, (y, x) in enumerate(found.medoids):
        _badge(axes, str(k + 1), (x, y), qualitative(number)[k])


def _badge(axes: Axes, text: str, place: tuple[float, float], color: str) -> None:
    axes.annotate(
        text,
        place,
        ha="center",
        va="center",
        fontsize=6.5,
        fontweight="bold",
        bbox={"boxstyle": "circle,pad=0.18", "facecolor": "white", "edgecolor": color, "lw": 1.4},
    )


def _panel(axes: Axes, found: Atlas, k: int) -> None:
    color = qualitative(len(found.share))[k]
    inner = slice(1, -1)  # the outer bins hold all that lies beyond: no density
    low, high = np.moveaxis(found.density_band[k, inner], -1, 0)
    axes.fill_between(found.positions[inner], low, high, color=color, alpha=0.35, linewidth=0)
    axes.plot(found.positions[inner], found.density[k, inner], color=color, linewidth=1.4)
    axes.axvline(0, color="#888888", linewidth=0.6, linestyle=":")
    axes.set(xlim=_limits(found), yticks=[])
    axes.set_ylim(bottom=0)
    axes.spines["left"].set_visible(False)
    y, x = found.medoids[k]
    axes.set_title(
        f"$\\bf{{{k + 1}}}$  {_percent(found.share[k])}, nulls {_percent(found.null_share[k])}",
        loc="left",
        fontsize=7.5,
        pad=2,
    )
    axes.text(
        0.99,
        0.93,
        f"y {y}\nx {x}",
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize=6,
        color="#555555",
    )


def _limits(found: Atlas) -> tuple[float, float]:
    """Return the decades that the panels share: what holds the visible part of every shape."""
    tops = found.density.max(axis=-1, keepdims=True)
    seen = found.positions[(found.density > _VISIBLE * tops).any(axis=0)]
    return float(seen.min()) - 0.1, float(seen.max()) + 0.1


def _percent(share: Any) -> str:
    return f"{100 * float(share):.0f} %" if share >= 0.01 or share == 0 else "< 1 %"
