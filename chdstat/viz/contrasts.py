"""Contrasts of two renders: both images, where they differ, and which is more efficient."""

from __future__ import annotations

from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from chdstat._core.image_scales import display_stops
from chdstat.inference import Contrast
from chdstat.viz.maps import image_map, value_map
from chdstat.viz.styling import PALETTE, WIDTH, grid, page, style, verbatim

__all__ = ["contrast"]

_LETTERS = 96
"""Of a line of text across the page."""


@style()
def contrast(found: Contrast, *, fig: Figure | None = None) -> Figure:
    """Draw the two images, where their means differ, p-values and efficiency, with the verdict.

    A rectangle marks the most significant window, solid where there is a difference. p-values of
    renders with one mean lie below the line of their histogram, or on it.

    Parameters
    ----------
    found
        What `chdstat.contrast` found.
    fig
        Where to draw; None makes a figure.
    """
    maps = found.maps
    bands = maps.sizes["channel"]
    shown = slice(1, None) if bands == 4 else slice(0, 1)
    height, width = maps["reason"].shape
    figure = page(fig, WIDTH / 3 * (0.86 * height / width + 0.24) * 2 + 0.7)
    axes = grid(figure, 6, 3)
    means = [maps[f"mean_{name}"].to_numpy()[..., shown] for name in ("a", "b")]
    exposure = display_stops(means[0])
    for ax, mean, letter, name in zip(axes, means, "AB", found.names, strict=False):
        short = name if len(name) <= 24 else f"...{name[-22:]}"
        image_map(mean, title=f"{letter}: {verbatim(short)}", exposure=exposure, ax=ax)
    _mark(axes[1], found)
    level = np.abs(maps["mean_a"].to_numpy()[..., 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = maps["difference"].to_numpy()[..., 0] / np.where(level > 0, level, np.nan)
        significance = -np.log10(maps["p_value"].min("channel").to_numpy())
        efficiency = np.log2(maps["efficiency"].to_numpy())
    value_map(100 * relative, title="B − A over A", unit="%", diverging=True, ax=axes[2])
    _mark(axes[2], found)
    value_map(significance, title="Significance", unit="−log10 p", limits=(0, 4), ax=axes[3])
    _p_values(axes[4], found)
    if np.isfinite(efficiency).any():
        value_map(
            efficiency, title="Efficiency of B over A", unit="log2", diverging=True, ax=axes[5]
        )
    else:
        axes[5].set_axis_off()
    figure.suptitle(fill(found.verdict, _LETTERS), x=0.01, ha="left", fontsize=8.5)
    return figure


def _mark(ax: Axes, found: Contrast) -> None:
    y, x, height, width = found.window
    ax.add_patch(
        Rectangle(
            (x - 0.5, y - 0.5), width, height, fill=False, edgecolor=PALETTE[5],
            linewidth=1.2, linestyle="-" if found.outcome == "differ" else ":",
        )
    )  # fmt: skip


def _p_values(ax: Axes, found: Contrast) -> None:
    p = found.p_value.to_numpy().ravel()
    p = p[np.isfinite(p)]
    ax.hist(p, bins=20, range=(0, 1), color=PALETTE[1], weights=np.full(p.size, 1 / max(1, p.size)))
    ax.axhline(1 / 20, color="#444444", linewidth=0.8, linestyle=":")
    ax.set(xlabel="p-value", title="Pixels by p-value", yticks=[], box_aspect=0.8)
    ax.spines["left"].set_visible(False)
