"""Results: the figure that each result draws when it is asked for its plot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from chdstat._core.display import percent
from chdstat._core.doors import draw
from chdstat.comparison.comparisons import Breakdown, Comparison, ErrorCurve, PixelEstimates
from chdstat.fit.families import Fit
from chdstat.fit.tail import Tail
from chdstat.inference.contrasts import Contrast, Contrasts
from chdstat.inference.modes import Modality
from chdstat.patterns.pixel import Pixel, Regions
from chdstat.viz.chd import Panel, chd_pair, fit_curve, mode_stems, tail_curve
from chdstat.viz.estimators import (
    error_curves,
    estimator_measures,
    pattern_breakdown,
    pixel_estimates,
)
from chdstat.viz.image import Mark, region_study
from chdstat.viz.several_renders import contrast

_AROUND = 2
"""Pixels around that of a region that are marked with it."""


def panel_of(pixel: Pixel, title: str, *, family: str = "best") -> Panel:
    """Return a pixel as `chdstat.viz.chd_grid` draws it: histograms, curves and means."""
    curves = [pixel.curve(row, family) for row in range(len(pixel.names))] if family else []
    return Panel.of_pixel(title, pixel, fits=curves, note=f"{percent(pixel.null_share)} null")


def _pixel(pixel: Pixel, **options: Any) -> Figure:
    return chd_pair(panel_of(pixel, f"{pixel.scene}, y {pixel.y}, x {pixel.x}"), **options)


def _regions(found: Regions, **options: Any) -> Figure:
    height, width = found.samples.shape[:2]
    marks = []
    for name, pixel in found.pixels.items():
        ys, xs = (
            slice(max(0, at - _AROUND), min(size, at + _AROUND + 1))
            for at, size in ((pixel.y, height), (pixel.x, width))
        )
        marks.append(Mark(name, ys, xs, (pixel.y, pixel.x)))
    panels = [panel_of(pixel, name) for name, pixel in found.pixels.items()]
    notes = [pixel.label for pixel in found.pixels.values()]
    return region_study(found.image, marks, panels, notes=notes, **options)


def _alone(
    panel: Callable[..., Axes], result: object, *, fig: Figure | None = None, **how: Any
) -> Figure:
    """Draw a result of one panel."""
    ax = None if fig is None else fig.subplots()
    return cast("Figure", panel(result, ax=ax, **how).figure)


_PANELS: Mapping[type, Callable[..., Axes]] = {
    Breakdown: pattern_breakdown,
    Fit: fit_curve,
    Modality: mode_stems,
    PixelEstimates: pixel_estimates,
    Tail: tail_curve,
}
_FIGURES: Mapping[type, Callable[..., Figure]] = {
    Comparison: estimator_measures,
    Contrast: contrast,
    Contrasts: contrast,
    ErrorCurve: error_curves,
    Pixel: _pixel,
    Regions: _regions,
}
for _kind, _panel in _PANELS.items():
    draw.register(_kind, partial(_alone, _panel))
for _kind, _figure in _FIGURES.items():
    draw.register(_kind, _figure)
