"""Maps: one value, label or colour per pixel, with the scale that reads them.

`atlas` draws the recurring distributions, as a map and as small multiples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter

from chdstat.patterns import Atlas
from chdstat.viz.image import tonemap
from chdstat.viz.styling import HEIGHT, MISSING, PALETTE, WIDTH, qualitative, sequential, style

__all__ = ["atlas", "categorical_map", "coverage", "image_map", "map_grid", "n_needed", "value_map"]

_TOO_MANY = "#D55E00"
"""Apart from all colours of `sequential`: vermillion of Okabe and Ito."""

Draw = Callable[[Axes], None]


def value_map(
    values: npt.ArrayLike,
    *,
    title: str,
    unit: str = "",
    limits: tuple[float, float] | None = None,
) -> Draw:
    """Return a drawing of one number per pixel, for `map_grid`.

    Parameters
    ----------
    values
        Shape (y, x); NaN is shown in grey.
    title, unit
        What is shown, and its unit for the colour bar.
    limits
        Ends of the colour scale; None takes the 1st and 99th percentile. Values beyond an end
        have its colour.
    """
    array = np.asarray(values, dtype=float)

    def draw(axes: Axes) -> None:
        low, high = limits or _percentiles(array)
        image = axes.imshow(array, cmap=sequential(), vmin=low, vmax=high, interpolation="nearest")
        _bare(axes, title)
        bar = axes.figure.colorbar(image, ax=axes, fraction=0.046, pad=0.03)
        bar.outline.set_visible(False)
        if unit:
            bar.set_label(unit, fontsize=7)

    return draw


def categorical_map(
    codes: npt.ArrayLike,
    names: Mapping[int, str],
    *,
    title: str,
    colors: Sequence[str] | None = None,
    columns: int = 2,
) -> Draw:
    """Return a drawing of one label per pixel, for `map_grid`.

    Parameters
    ----------
    codes
        Integer labels, shape (y, x).
    names
        Name of each label; those that occur are in the legend with their share of the pixels.
    title
        What is shown.
    colors
        One colour for each label, in the order of `names`; None takes those of
        `chdstat.viz.PALETTE`, and darker ones beyond its eighth.
    columns
        Of the legend.
    """
    array = np.asarray(codes)
    order = list(names)
    palette = qualitative(len(order)) if colors is None else colors

    def draw(axes: Axes) -> None:
        rank = np.full(array.shape, np.nan)
        for i, code in enumerate(order):
            rank[array == code] = i
        shades = [palette[i % len(palette)] for i in range(len(order))]
        cmap = ListedColormap(shades).with_extremes(bad=MISSING)
        norm = BoundaryNorm(np.arange(len(order) + 1) - 0.5, len(order))
        axes.imshow(rank, cmap=cmap, norm=norm, interpolation="nearest")
        _bare(axes, title)
        patches = [
            Patch(color=shades[i], label=f"{names[code]} {_percent(share)}")
            for i, code in enumerate(order)
            if (share := float((array == code).mean())) > 0
        ]
        axes.legend(
            handles=patches, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=columns,
            fontsize=6.5, handlelength=0.9, columnspacing=0.9, borderaxespad=0.2,
        )  # fmt: skip

    return draw


def n_needed(
    needed: npt.ArrayLike, sizes: npt.ArrayLike, *, title: str = "Samples per average needed"
) -> Draw:
    """Return a drawing of the samples that an average needs to look Gaussian, for `map_grid`.

    Parameters
    ----------
    needed
        As ``n_needed`` of `chdstat.gaussianity_of_means`, shape (y, x): one of the sizes, -1 for
        more than the largest, 0 where it is unknown.
    sizes
        The sizes that were tested, shape (size,).
    title
        What is shown.
    """
    tested = [int(n) for n in np.sort(np.asarray(sizes).ravel())]
    shades = [to_hex(shade) for shade in sequential()(np.linspace(0.05, 1, len(tested)))]
    names = {n: f"{n}:" for n in tested} | {-1: f"> {tested[-1]}:"}
    colors = [*shades, _TOO_MANY]
    return categorical_map(needed, names, title=title, colors=colors, columns=3)


def image_map(image: npt.ArrayLike, *, title: str, exposure: float | None = None) -> Draw:
    """Return a drawing of an image, for `map_grid`.

    Parameters
    ----------
    image, exposure
        As in `tonemap`.
    title
        What is shown.
    """
    shown = tonemap(image, exposure=exposure)

    def draw(axes: Axes) -> None:
        axes.imshow(shown, interpolation="nearest")
        _bare(axes, title)

    return draw


def coverage(levels: npt.ArrayLike, measured: Mapping[str, Sequence[float]], *, title: str) -> Draw:
    """Return a drawing of how often intervals hold the truth, for `map_grid`.

    Parameters
    ----------
    levels
        Probabilities that the intervals state, shape (level,).
    measured
        By name, the shares that were measured, shape (level,).
    title
        What is shown.
    """
    stated = np.asarray(levels, float)

    def draw(axes: Axes) -> None:
        low = min(float(np.nanmin([stated, *measured.values()])), 0.5) - 0.04
        axes.plot([low, 1], [low, 1], color="#888888", linewidth=0.9, linestyle="--")
        for k, (name, shares) in enumerate(measured.items()):
            axes.plot(
                stated,
                shares,
                marker="os^D"[k % 4],
                markersize=3.5,
                color=(PALETTE[4], PALETTE[5], PALETTE[2])[k % 3],
                label=name,
            )
        axes.set(xlim=(low, 1), ylim=(low, 1), xlabel="stated", ylabel="measured", title=title)
        axes.set_aspect("equal")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:.0f} %"))
        axes.legend(loc="upper left", fontsize=6.5)

    return draw


def map_grid(maps: Sequence[Draw], *, columns: int = 3, aspect: float = 1.0) -> Figure:
    """Arrange maps in a grid that fills the width of a page.

    Parameters
    ----------
    maps
        Drawings made by `value_map`, `categorical_map` and the others here.
    columns
        Maps in a row.
    aspect
        Height of the image over its width.
    """
    rows = -(-len(maps) // columns)
    with style():
        height = WIDTH / columns * (0.86 * aspect + 0.2) * rows
        figure = Figure(figsize=(WIDTH, min(height, HEIGHT)), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
        for cell in axes.flat[len(maps) :]:
            cell.set_axis_off()
        for cell, draw in zip(axes.flat, maps, strict=False):
            draw(cell)
    return figure


def _bare(axes: Axes, title: str) -> None:
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title)


def _percentiles(array: npt.NDArray[Any]) -> tuple[float, float]:
    finite = array[np.isfinite(array)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, (1, 99))
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


def _percent(share: Any) -> str:
    return f"{100 * float(share):.0f} %" if share >= 0.01 or share == 0 else "< 1 %"


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
