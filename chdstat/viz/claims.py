"""Claims: verdicts by scene, intervals against the ranges that claims state, and plots of findings.

`verdict_matrix` draws the verdicts, `claim_intervals` the measured values, `finding_plots` the
small figures of findings side by side.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from chdstat._core.display import Width
from chdstat.errors import InputError
from chdstat.inference.findings import ClaimTest, PlotData
from chdstat.viz.maps import value_map
from chdstat.viz.styling import (
    PALETTE,
    axes_in,
    called,
    fitting,
    inches,
    narrow,
    panels_in,
    qualitative,
    style,
    verbatim,
    within,
)

VERDICTS = {
    "supported": ("#0072B2", "✓"),
    "not supported": ("#D55E00", "✗"),
    "cannot tell": ("#BBBBBB", "?"),
}
"""Colour and symbol of each verdict; either is enough to read it."""

_COLUMNS = 4
"""Plots of findings side by side; one less if each has its own labels."""
_DASHES = ("-", "--", "-.", ":")
_MARKERS = "os^Dv<>P"
_MANY_POINTS, _MOST_POINTS = 50, 4000
"""Number of points from which they are small and pale, and the most points that are drawn."""
_SEEN = 0.005, 0.995
"""A panel of many points shows the range between these quantiles, and a little more."""
_MOST_COLORS = 8
"""Most series with colours of their own; of more, only the scatter is visible."""
_LONG = 26
_LETTERS = 17
"""Letters of a title per inch."""
_LABEL = 28
"""Most letters of a label beside one panel."""
_LINE = 40
"""Fewest points of a line that may have peaks."""


@style()
def verdict_matrix(
    verdicts: Mapping[str, Mapping[str, str]], *, width: Width = "page", ax: Axes | None = None
) -> Axes:
    """Draw verdicts, a row for each claim and a column for each scene.

    Parameters
    ----------
    verdicts
        By claim, then by scene: "supported", "not supported" or "cannot tell"; a missing scene or
        "" means not tested. A trailing "*" marks a verdict that another seed repeated.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no claim, or a verdict is another word.

    Examples
    --------
    >>> ax = verdict_matrix({"nulls": {"bathroom": "supported", "fog": "cannot tell"}})
    >>> [text.get_text() for text in ax.texts]
    ['✓', '?']
    """
    scenes = list(dict.fromkeys(scene for row in verdicts.values() for scene in row))
    if not scenes:
        message = "verdict_matrix needs at least one claim and one scene, got none"
        raise InputError(message)
    ax = axes_in(ax, 0.215 * len(verdicts) + 1.25, width)
    for y, row in enumerate(verdicts.values()):
        for scene, verdict in row.items():
            if verdict:
                _draw_verdict(ax, scenes.index(scene), y, verdict)
    ax.set(xlim=(-0.5, len(scenes) - 0.5), ylim=(len(verdicts) - 0.5, -0.5))
    cell = inches("page", ax.get_figure(root=False)) / max(1, len(scenes))
    ax.set_xticks(
        range(len(scenes)),
        [within(scene, 1.3) for scene in scenes],
        rotation=28 if cell > 0.6 else 60,
        ha="left",
    )
    ax.set_yticks(range(len(verdicts)), list(verdicts), ha="left")
    ax.tick_params(length=0, labeltop=True, labelbottom=False)
    ax.tick_params(axis="y", pad=min(95, 4 * max(map(len, verdicts))))
    ax.spines[:].set_visible(False)
    handles = [
        Line2D([], [], color=color, marker="s", markersize=9, linestyle="", label=f"{mark} {v}")
        for v, (color, mark) in VERDICTS.items()
    ]
    ax.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(1, 0), columnspacing=1,
        ncols=1 if narrow(cell * len(scenes)) else 3,
        prop={"family": "DejaVu Sans", "size": 7},
    )  # fmt: skip
    return ax


def _draw_verdict(ax: Axes, x: int, y: int, verdict: str) -> None:
    word = verdict.removesuffix("*")
    if word not in VERDICTS:
        message = f"expected a verdict of {', '.join(VERDICTS)}, got {verdict!r}"
        raise InputError(message)
    color, mark = VERDICTS[word]
    ax.add_patch(Rectangle((x - 0.46, y - 0.42), 0.92, 0.84, color=color, linewidth=0))
    ink = "#222222" if word == "cannot tell" else "white"
    ax.text(x, y, mark, ha="center", va="center", fontsize=9, family="DejaVu Sans", color=ink)
    if verdict.endswith("*"):
        ax.plot(x + 0.38, y - 0.27, ".", color=ink, markersize=3)


@style()
def claim_intervals(
    tests: Mapping[str, Sequence[ClaimTest]],
    *,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw the intervals of a claim's statistics over the range that the claim states, by scene.

    Parameters
    ----------
    tests
        Tests of one claim, by scene. Each statistic has a panel; scenes without it have a dash.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no test.
    """
    known = {scene: {(t.name, t.least, t.most): t for t in found} for scene, found in tests.items()}
    kinds = list(dict.fromkeys(kind for row in known.values() for kind in row))
    across = inches(width, fig)
    columns = fitting(across, min(2, len(kinds)), 2.6)
    across = min(across, 2.2 * (1 + columns))  # a single panel is narrower than a page
    letters = int((_LETTERS * across - max(map(len, tests), default=0)) / columns)
    titles = [textwrap.fill(name, max(letters, _LABEL)) for name, *_ in kinds]
    lines = max((title.count("\n") for title in titles), default=0)
    height = -(-len(kinds) // columns) * (0.155 * (len(tests) + lines) + 0.62)
    figure, axes = panels_in(fig, len(kinds), columns, height, across, sharey=True)
    for i, (ax, kind) in enumerate(zip(axes, kinds, strict=True)):
        _draw_intervals(ax, [row.get(kind) for row in known.values()], titles[i])
        ax.tick_params(axis="y", length=0, labelleft=i % columns == 0)
    axes[0].set_yticks(range(len(tests)), map(verbatim, tests))
    axes[0].set_ylim(len(tests) - 0.4, -0.6)
    return figure


def _draw_intervals(ax: Axes, tests: Sequence[ClaimTest | None], title: str) -> None:
    """Draw the intervals of one statistic, each in the colour of its verdict."""
    test = next(t for t in tests if t is not None)
    intervals = [t.interval for t in tests if t is not None]
    span = _span([v for i in intervals for v in (i.value, i.low, i.high)], test)
    inside = max(test.least, span[0]), min(test.most, span[1])
    ax.axvspan(*inside, color=PALETTE[1], alpha=0.2, linewidth=0)
    for end in (test.least, test.most):
        if np.isfinite(end):
            ax.axvline(end, color=PALETTE[4], linewidth=0.7)
    for i, found in enumerate(tests):
        if found is None or not np.isfinite(found.interval.value):
            where: Any = ("axes fraction", "data")
            ax.annotate("—", (0.02, i), xycoords=where, va="center", color="#999999")
        if found is not None:
            undecided = found.verdict == "cannot tell"
            color = "#777777" if undecided else VERDICTS[found.verdict][0]
            ends = np.clip([found.interval.low, found.interval.high], *span)  # one may be open
            ax.plot(ends, [i, i], color=color, linewidth=1.6, solid_capstyle="butt")
            look: Any = {"markersize": 3.6, "fillstyle": "none" if np.isnan(ends).any() else "full"}
            ax.plot(found.interval.value, i, "o", color=color, **look)
    ax.set_xlim(*span)
    written = "" if test.unit == "1" else f" ({test.unit.replace('^1/2', '$^{1/2}$')})"
    ax.set_title(title + written, loc="left")


def _span(values: Sequence[float], test: ClaimTest) -> tuple[float, float]:
    """Return ends of an axis that shows all values and the border of the claim."""
    shown = [v for v in (*values, test.least, test.most) if np.isfinite(v)]
    if not shown:
        return 0.0, 1.0
    low, high = min(shown), max(shown)
    margin = 0.08 * (high - low) or max(0.1 * abs(high), 0.1)
    return low - margin, high + margin


@style()
def finding_plots(
    shown: Mapping[str, PlotData], *, width: Width = "page", fig: Figure | None = None
) -> Figure:
    """Draw small figures of several findings, or of one finding in several scenes, side by side.

    Parameters
    ----------
    shown
        ``plot_data`` of a `chdstat.studies.claims.Finding`, by title. The legend and the labels of
        the axes are drawn only once if all have the same.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is nothing to draw.

    Examples
    --------
    >>> from chdstat.studies.claims import PlotData
    >>> bars = PlotData("bars", {"wall": ([0], [0.2])}, y_label="share of nulls")
    >>> len(finding_plots({"bathroom": bars, "fog": bars}).axes)
    2
    """
    plots = list(shown.values())
    labels = {(plot.x_label, plot.y_label) for plot in plots}
    across = inches(width, fig)
    most = _COLUMNS if len(labels) == 1 else _COLUMNS - 1
    wordy = len(labels) > 1 or any(plot.kind == "bars" for plot in plots)
    columns = fitting(across, min(most, len(plots)), 2.2 if wordy else 1.6)
    height = 1.45 if len(labels) == 1 else 1.6
    rows = -(-len(plots) // columns)
    # Few panels are narrower than a page.
    wide = across if columns > 2 else min(across, 0.9 + 1.95 * columns)
    figure, axes = panels_in(fig, len(plots), columns, height * rows + 0.42, wide)
    for ax, (title, plot) in zip(axes, shown.items(), strict=True):
        series = {verbatim(called(name)): xy for name, xy in plot.series.items()}
        _DRAW[plot.kind](ax, replace(plot, series=series))
        ax.set_title(
            within(title, wide / columns - (1.2 if plot.kind == "bars" else 0.3)), loc="left"
        )
        if len(labels) > 1:
            x_label, y_label = _axis_labels(plot)
            ax.set_xlabel(_raised(textwrap.fill(x_label, _LABEL)))
            ax.set_ylabel(_raised(textwrap.fill(y_label, _LABEL)))
    if len(labels) == 1:
        x_label, y_label = _axis_labels(plots[0])
        figure.supxlabel(_raised(x_label))
        figure.supylabel(_raised(textwrap.fill(y_label, _LABEL * rows)))
    _draw_legends(figure, axes)
    return figure


def _draw_legends(figure: Figure, axes: Sequence[Axes]) -> None:
    """Name the series of each panel if there is room, and only once if all have the same."""
    named = [ax.get_legend_handles_labels() for ax in axes]
    handles, first = named[0]
    if 1 < len(first) <= 6 and all(names == first for _, names in named):
        columns = fitting(inches("page", figure), len(first), 1.0)
        _see_points(figure.legend(handles, first, loc="outside upper center", ncols=columns))
        return
    for ax, (_, names) in zip(axes, named, strict=True):
        if 1 < len(names) <= (4 if len(axes) > 1 else 10):
            _see_points(ax.legend(handlelength=1.3, labelspacing=0.2, borderaxespad=0.1))


def _see_points(legend: Legend) -> None:
    """Make the points of a legend large: with many points, they are small and pale."""
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D):
            handle.set(alpha=1, markersize=4.5)


def _axis_labels(plot: PlotData) -> tuple[str, str]:
    """Return the labels of both axes; bars are horizontal, so that there is room for names."""
    return (plot.y_label, plot.x_label) if plot.kind == "bars" else (plot.x_label, plot.y_label)


def _raised(label: str) -> str:
    """Return a label with the exponents of its units, as in "m-2" or ")^2", raised."""
    return re.sub(r"(?<=[a-z])(-\d+)|\^(\d+)", lambda m: f"$^{{{m[1] or m[2]}}}$", label)


def _look(place: int, number: int, kind: str) -> dict[str, Any]:
    color = PALETTE[4] if number == 1 else qualitative(number)[place]
    if number > _MOST_COLORS:
        return {"color": PALETTE[4], "alpha": 0.3}
    if kind == "points":
        return {"color": color, "marker": _MARKERS[place % len(_MARKERS)], "linestyle": ""}
    return {"color": color, "linestyle": _DASHES[place % len(_DASHES)]}


def _draw_curves(ax: Axes, plot: PlotData) -> None:
    """Draw a line for each series, over the part of the axis where they are not all flat."""
    spans, heights = [], []
    for i, (name, (x, y)) in enumerate(plot.series.items()):
        look = _look(i, len(plot.series), "curves")
        ax.plot(x, y, label=name, linewidth=1.1, **look)
        a, b = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        heights.append(b[np.isfinite(b)])
        moved = np.flatnonzero(np.abs(np.diff(b)) > 2e-3 * np.ptp(b)) if b.size else b
        if moved.size:
            spans.append((a[moved[0]], a[moved[-1] + 1]))
    if spans and min(s[0] for s in spans) < max(s[1] for s in spans):
        ax.set_xlim(min(s[0] for s in spans), max(s[1] for s in spans))
    known = np.concatenate(heights)
    # A few peaks may leave the panel at the top, so that they do not squeeze all else.
    if known.size >= _LINE and known.max() > 4 * (usual := np.quantile(known, 0.95)) > 0:
        ax.set_ylim(top=1.6 * usual)


def _draw_points(ax: Axes, plot: PlotData) -> None:
    for i, (name, (x, y)) in enumerate(plot.series.items()):
        a, b = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        step = max(1, -(-len(a) // _MOST_POINTS))
        look = _look(i, len(plot.series), "points") | {"markersize": 4.5}
        if len(a) >= _MANY_POINTS:
            look |= {"markersize": 1.3, "alpha": 0.45, "rasterized": True}
        ax.plot(a[::step], b[::step], label=name, markeredgewidth=0, **look)
    known = np.array([v for _, y in plot.series.values() for v in y], dtype=float)
    known = known[np.isfinite(known)]
    if known.size >= _MANY_POINTS:
        # A few outliers may leave the panel, so that they do not squeeze all else.
        low, high = np.quantile(known, _SEEN)
        ax.set_ylim(low - 0.15 * (high - low), high + 0.15 * (high - low))


def _draw_bars(ax: Axes, plot: PlotData) -> None:
    names = list(plot.series)
    values = [float(np.asarray(y, dtype=float)[0]) for _, y in plot.series.values()]
    ax.barh(range(len(names)), values, color=PALETTE[1], height=0.7)
    ax.axvline(0, color="#444444", linewidth=0.6)
    short = [n if len(n) <= _LONG else f"{n[: _LONG - 1]}…" for n in names]
    ax.set_yticks(range(len(names)), short)
    ax.invert_yaxis()
    ax.tick_params(axis="y", length=0)


def _draw_map(ax: Axes, plot: PlotData) -> None:
    ((name, (_, image)),) = plot.series.items()
    values = np.asarray(image, dtype=float)
    finite = values[np.isfinite(values)]
    top = float(np.percentile(finite, 99)) if finite.size else 1.0
    value_map(values, unit=name, limits=(0, top or 1.0), ax=ax)


_DRAW = {"curves": _draw_curves, "points": _draw_points, "bars": _draw_bars, "map": _draw_map}
