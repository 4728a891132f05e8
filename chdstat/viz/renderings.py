"""Renders: several of one view, where two of them differ, and the same pixels' CHDs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from chdstat._core.arrays import luminance
from chdstat._core.display import Width
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.errors import InputError
from chdstat.viz.chd import Panel, draw_histograms, draw_means
from chdstat.viz.image import Mark, draw_marked
from chdstat.viz.maps import value_map
from chdstat.viz.styling import (
    UNIT,
    bare,
    fitting,
    inches,
    page,
    qualitative,
    style,
    swatches,
    upright,
    verbatim,
)

__all__ = ["renders_compared"]


@style()
def renders_compared(
    images: Mapping[str, npt.ArrayLike],
    samples: Mapping[str, Sequence[npt.ArrayLike]] | None = None,
    marks: Sequence[Mark] = (),
    *,
    difference: tuple[str, str] | None = None,
    exposure: float | None = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw renders of one view, how two of them differ, and CHDs of the same places.

    The CHDs of a place stand over each other: log histograms of luminance, dashed at the mean. A
    render without samples has a dotted line at its luminance.

    Parameters
    ----------
    images
        Linear radiance (y, x, channel) by the name of the render.
    samples
        Of some of them, the samples (channel, sample) of each of the marks.
    marks
        Places; each has a number in the images, and a CHD.
    difference
        Names of two renders: the luminance of the first minus that of the second is drawn, too.
    exposure
        As in `tonemap`; all images share it. None suits the first.
    width
        Of a new figure: "column" or "page" of a paper, or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no image, or a render has not as many samples as there are marks.

    Examples
    --------
    >>> x = np.random.default_rng(0).gamma(1.0, size=(2, 8, 8, 3, 64))
    >>> mark = Mark("wall", slice(3, 4), slice(4, 5), (3, 4))
    >>> images = dict(zip("ab", x.mean(axis=-1)))
    >>> figure = renders_compared(images, {"a": [x[0, 3, 4]]}, [mark], difference=("a", "b"))
    >>> len(figure.axes)  # with the colour bar
    5
    """
    samples = samples or {}
    if not images or any(len(those) != len(marks) for those in samples.values()):
        message = "expected at least one image, and samples of as many places as there are marks"
        raise InputError(message)
    arrays = {name: np.asarray(image, float) for name, image in images.items()}
    first = next(iter(arrays.values()))
    exposure = display_stops(first) if exposure is None else exposure
    count, wide = len(arrays) + (difference is not None), inches(width, fig)
    across, places = fitting(wide, min(count, 4), 1.6), len(marks) if samples else 0
    columns = fitting(wide, min(places, 2), 2.5)
    height = wide / across * upright(*first.shape[:2]) + 0.25
    rows, below = -(-count // across), -(-places // columns)
    figure = page(fig, rows * height + 1.5 * below + 0.3, width)
    ratios = [rows * height, 1.5 * below] if places else [1]
    parts = figure.add_gridspec(len(ratios), 1, height_ratios=ratios)
    cells = parts[0].subgridspec(rows, across)
    axes = [figure.add_subplot(cells[i // across, i % across]) for i in range(count)]
    for ax, (name, image) in zip(axes, arrays.items(), strict=False):
        draw_marked(ax, tonemap(image, exposure=exposure), marks)
        bare(ax, verbatim(name))
    if difference is not None:
        one, two = (luminance(arrays[name], channel_axis=-1) for name in difference)
        title = verbatim(" − ".join(difference))
        value_map(one - two, title=title, unit="luminance", diverging=True, ax=axes[-1])
    colors = dict(zip(arrays, qualitative(len(arrays)), strict=True))
    for i, mark in enumerate(marks if places else ()):
        cells = parts[1].subgridspec(below, columns, wspace=0.12)
        ax = figure.add_subplot(cells[i // columns, i % columns])
        panels = {name: Panel.of(name, those[i]) for name, those in samples.items()}
        found = {name: [*panel.histograms("log").values()][-1] for name, panel in panels.items()}
        draw_histograms(ax, found, colors=[colors[name] for name in found])
        for name, color in colors.items():
            if name in panels:
                draw_means(ax, panels[name].mean[-1:], [color])
            else:
                seen = luminance(arrays[name][mark.ys, mark.xs], channel_axis=-1)
                draw_means(ax, [float(np.nanmean(seen))], [color], dashes=":")
        ax.set_title(verbatim(f"{i + 1} {mark.name}"), loc="left", fontweight="bold", pad=3)
        ax.set_xlabel(f"luminance ({UNIT}), log scale")
        ax.set_ylabel("" if i % columns else "density")
    if places:
        look: Any = {"loc": "outside lower center", "ncols": 2 * columns, "handlelength": 1}
        figure.legend(handles=swatches(colors), **look)
    return figure
