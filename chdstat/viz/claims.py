"""Claims: verdicts by scene, intervals against the ranges that claims state, and plots of findings.

`verdict_matrix` draws the verdicts, `claim_intervals` the measured values, `displays` what the
findings show, as small figures side by side.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from chdstat.errors import InputError
from chdstat.viz.styling import PALETTE, WIDTH, qualitative, sequential, style, verbatim

__all__ = ["VERDICTS", "Display", "Measured", "claim_intervals", "displays", "verdict_matrix"]

Array = npt.NDArray[Any]

VERDICTS = {
    "supported": ("#0072B2", "✓"),
    "not supported": ("#D55E00", "✗"),
    "cannot tell": ("#BBBBBB", "?"),
}
"""Colour and symbol of each verdict; either tells it."""


@dataclass(frozen=True)
class Measured:
    """One part of a claim, measured in several scenes.

    Parameters
    ----------
    name, unit
        Of the number; "1" for pure ones.
    value, low, high
        By scene, shape (scene,); NaN where unknown.
    least, most
        Range that the claim states; infinite where it is open.
    """

    name: str
    value: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    least: float = -np.inf
    most: float = np.inf
    unit: str = "1"


def verdict_matrix(verdicts: Mapping[str, Mapping[str, str]]) -> Figure:
    """Draw verdicts, a row for each claim and a column for each scene.

    Parameters
    ----------
    verdicts
        By claim, then by scene: "supported", "not supported" or "cannot tell"; where a scene is
        missing or has "", nothing was tested. A trailing "*" marks what another seed repeated.

    Raises
    ------
    InputError
        If there is no claim, or a verdict is another word.

    Examples
    --------
    >>> figure = verdict_matrix({"nulls": {"bathroom": "supported", "fog": "cannot tell"}})
    >>> [text.get_text() for text in figure.axes[0].texts]
    ['✓', '?']
    """
    scenes = list(dict.fromkeys(scene for row in verdicts.values() for scene in row))
    if not scenes:
        message = "verdict_matrix needs at least one claim and one scene, got none"
        raise InputError(message)
    with style():
        figure = Figure(figsize=(WIDTH, 0.215 * len(verdicts) + 1.25), layout="constrained")
        axes = figure.subplots()
        for y, row in enumerate(verdicts.values()):
            for x, scene in enumerate(scenes):
                _verdict(axes, x, y, row.get(scene, ""))
        axes.set(xlim=(-0.5, len(scenes) - 0.5), ylim=(len(verdicts) - 0.5, -0.5))
        axes.set_xticks(
            range(len(scenes)), map(verbatim, scenes), rotation=28, ha="left", fontsize=8
        )
        axes.set_yticks(range(len(verdicts)), list(verdicts), fontsize=8.5, ha="left")
        axes.tick_params(length=0, labeltop=True, labelbottom=False)
        axes.tick_params(axis="y", pad=95)
        axes.spines[:].set_visible(False)
        handles = [
            Line2D([], [], color=color, marker="s", markersize=9, linestyle="", label=f"{mark} {v}")
            for v, (color, mark) in VERDICTS.items()
        ]
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=3,
            prop={"family": "DejaVu Sans", "size": 7},
        )
    return figure


def _verdict(axes: Axes, x: int, y: int, verdict: str) -> None:
    word = verdict.removesuffix("*")
    if not word:
        return
    if word not in VERDICTS:
        message = f"expected a verdict of {', '.join(VERDICTS)}, got {verdict!r}"
        raise InputError(message)
    color, mark = VERDICTS[word]
    axes.add_patch(Rectangle((x - 0.46, y - 0.42), 0.92, 0.84, color=color, linewidth=0))
    dark = word == "cannot tell"
    axes.text(
        x, y, mark, ha="center", va="center", fontsize=9, family="DejaVu Sans",
        color="#222222" if dark else "white",
    )  # fmt: skip
    if verdict.endswith("*"):
        axes.plot(x + 0.38, y - 0.27, ".", color="#222222" if dark else "white", markersize=3)


def claim_intervals(
    parts: Sequence[Measured], scenes: Sequence[str], *, columns: int = 2
) -> Figure:
    """Draw the intervals of a claim's parts over the range that the claim states, by scene.

    Parameters
    ----------
    parts
        What was measured; each has a panel.
    scenes
        Names, in the order of the values.
    columns
        Panels side by side.

    Raises
    ------
    InputError
        If there is no part, or one does not have a value for each scene.
    """
    if not parts or any(len(part.value) != len(scenes) for part in parts):
        got = [len(part.value) for part in parts]
        message = f"expected parts with a value for each of {len(scenes)} scenes, got {got}"
        raise InputError(message)
    columns = min(columns, len(parts))
    rows = -(-len(parts) // columns)
    with style():
        width = WIDTH if columns > 1 else 0.66 * WIDTH
        figure = Figure(figsize=(width, rows * (0.155 * len(scenes) + 0.62)), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for cell in axes.flat[len(parts) :]:
            cell.set_axis_off()
        for cell, part in zip(axes.flat, parts, strict=False):
            _intervals(cell, part)
        for row in axes:
            row[0].set_yticks(range(len(scenes)), map(verbatim, scenes))
            row[0].set_ylim(len(scenes) - 0.4, -0.6)
            for cell in row[1:]:
                cell.tick_params(labelleft=False)
    return figure


def _intervals(axes: Axes, part: Measured) -> None:
    value, low, high = (np.asarray(v, dtype=float) for v in (part.value, part.low, part.high))
    span = _span(np.concatenate([value, low, high]), part)
    axes.axvspan(
        max(part.least, span[0]), min(part.most, span[1]), color=PALETTE[1], alpha=0.2, linewidth=0
    )
    for end in (part.least, part.most):
        if np.isfinite(end):
            axes.axvline(end, color=PALETTE[4], linewidth=0.7)
    for i in range(len(value)):
        color = VERDICTS[_of_interval(low[i], high[i], part)][0]
        shade = "#777777" if color == VERDICTS["cannot tell"][0] else color
        ends = np.clip([low[i], high[i]], *span)  # one may be open
        axes.plot(ends, [i, i], color=shade, linewidth=1.6, solid_capstyle="butt")
        full = not np.isnan(ends).any()
        axes.plot(
            value[i], i, "o", color=shade, markersize=3.6, fillstyle="full" if full else "none"
        )
        if not np.isfinite(value[i]):
            axes.annotate(
                "—", (0.02, i), xycoords=("axes fraction", "data"), va="center", color="#999999"
            )
    axes.set_xlim(*span)
    unit = "" if part.unit == "1" else f" ({part.unit.replace('^1/2', '$^{1/2}$')})"
    axes.set_title(part.name + unit, loc="left", fontsize=7.5, wrap=True)
    axes.tick_params(axis="y", length=0)


def _of_interval(low: float, high: float, part: Measured) -> str:
    if low >= part.least and high <= part.most:
        return "supported"
    return "not supported" if high < part.least or low > part.most else "cannot tell"


def _span(values: Array, part: Measured) -> tuple[float, float]:
    """Return ends of an axis that shows all values and the border of the claim."""
    shown = np.concatenate([values, [part.least, part.most]])
    shown = shown[np.isfinite(shown)]
    if not shown.size:
        return 0.0, 1.0
    low, high = float(shown.min()), float(shown.max())
    margin = 0.08 * (high - low) or max(0.1 * abs(high), 0.1)
    return low - margin, high + margin


_DASHES = ("-", "--", "-.", ":")
_MARKERS = "os^Dv<>P"
_MOST_POINTS = 4000
_LONG = 26
_LABEL = 28
"""Letters of a label along one panel."""
_LINE = 40
"""Points of a line that has peaks at all."""


@dataclass(frozen=True)
class Display:
    """A small figure of a finding.

    Parameters
    ----------
    kind
        "curves", "points", "bars" or "map".
    series
        By name: x and y, each of shape (point,); a bar has its value in y; a map its image (y, x).
    x_label, y_label
        With their units.
    title
        What is shown.
    """

    kind: Literal["curves", "points", "bars", "map"]
    series: Mapping[str, tuple[npt.ArrayLike, npt.ArrayLike]] = field(default_factory=dict)
    x_label: str = ""
    y_label: str = ""
    title: str = ""


def displays(shown: Sequence[Display], *, columns: int = 4, height: float = 1.45) -> Figure:
    """Draw the exhibits of several findings, or of one finding in several scenes, side by side.

    Parameters
    ----------
    shown
        What to draw; a legend is drawn once where all have the same series.
    columns
        Panels side by side.
    height
        Of a panel, in inches.

    Raises
    ------
    InputError
        If there is nothing to draw.

    Examples
    --------
    >>> figure = displays([Display("bars", {"wall": ([0], [0.2])}, y_label="share of nulls")])
    >>> len(figure.axes)
    1
    """
    if not shown:
        message = "displays needs at least one panel, got none"
        raise InputError(message)
    columns = min(columns, len(shown))
    rows = -(-len(shown) // columns)
    shared = _shared_series(shown)
    with style():
        width = WIDTH if columns > 2 else WIDTH * (0.42 + 0.29 * (columns - 1))
        figure = Figure(figsize=(width, height * rows + 0.42), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
        for cell in axes.flat[len(shown) :]:
            cell.set_axis_off()
        for cell, display in zip(axes.flat, shown, strict=False):
            _DRAW[display.kind](cell, display)
            cell.set_title(verbatim(display.title), loc="left", fontsize=8)
            if not shared and _has_legend(display, len(shown)):
                cell.legend(fontsize=5.5, handlelength=1.3, labelspacing=0.2, borderaxespad=0.1)
        _labels(figure, shown)
        if shared:
            figure.legend(
                handles=_handles(shared, shown[0].kind),
                loc="outside upper center",
                ncols=len(shared),
            )
    return figure


def _has_legend(display: Display, panels: int) -> bool:
    """Say whether there is room to name the series of a panel."""
    lines = display.kind in {"curves", "points"}
    return lines and 1 < len(display.series) <= (4 if panels > 1 else 10)


def _shared_series(shown: Sequence[Display]) -> list[str]:
    """Return names of series that all panels share, if they need a legend."""
    names = {tuple(display.series) for display in shown}
    kinds = {display.kind for display in shown}
    if len(names) != 1 or not kinds <= {"curves", "points"}:
        return []
    found = list(names.pop())
    return found if 1 < len(found) <= 6 else []


def _handles(names: Sequence[str], kind: str) -> list[Line2D]:
    return [
        Line2D([], [], label=verbatim(name), **_look(i, len(names), kind))
        for i, name in enumerate(names)
    ]


def _labels(figure: Figure, shown: Sequence[Display]) -> None:
    """Label the axes: once where all panels have the same labels."""
    labels = {(display.x_label, display.y_label) for display in shown}
    if len(labels) == 1:
        x, y = labels.pop()
        figure.supxlabel(_raised(x), fontsize=8)
        figure.supylabel(_raised(y), fontsize=8)
        return
    for axes, display in zip(figure.axes, shown, strict=False):
        axes.set_xlabel(_raised(textwrap.fill(display.x_label, _LABEL)))
        axes.set_ylabel(_raised(textwrap.fill(display.y_label, _LABEL)))


def _raised(label: str) -> str:
    """Return a label with the exponents of its units, as in "m-2" or ")^2", raised."""
    return re.sub(r"(?<=[a-z])(-\d+)|\^(\d+)", lambda m: f"$^{{{m[1] or m[2]}}}$", label)


def _look(place: int, number: int, kind: str) -> dict[str, Any]:
    color = PALETTE[4] if number == 1 else qualitative(number)[place]
    if kind == "points":
        return {"color": color, "marker": _MARKERS[place % len(_MARKERS)], "linestyle": ""}
    return {"color": color, "linestyle": _DASHES[place % len(_DASHES)]}


def _curves(axes: Axes, display: Display) -> None:
    for i, (name, (x, y)) in enumerate(display.series.items()):
        axes.plot(
            x, y, label=verbatim(name), linewidth=1.1, **_look(i, len(display.series), "curves")
        )
    _crop(axes, display)
    _lower(axes, display)


def _lower(axes: Axes, display: Display) -> None:
    """Let no few peaks squeeze all else: they leave the panel at the top."""
    y = np.concatenate([np.asarray(y, dtype=float) for _, y in display.series.values()])
    y = y[np.isfinite(y)]
    if y.size >= _LINE and float(y.max()) > 4 * (usual := float(np.quantile(y, 0.95))) > 0:
        axes.set_ylim(top=1.6 * usual)


def _crop(axes: Axes, display: Display) -> None:
    """Leave out the ends of the axis over which all curves are flat."""
    spans = []
    for x, y in display.series.values():
        a, b = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        if b.size < 2:
            continue
        moved = np.flatnonzero(np.abs(np.diff(b)) > 2e-3 * np.ptp(b))
        if moved.size:
            spans.append((a[moved[0]], a[moved[-1] + 1]))
    if spans and min(s[0] for s in spans) < max(s[1] for s in spans):
        axes.set_xlim(min(s[0] for s in spans), max(s[1] for s in spans))


def _points(axes: Axes, display: Display) -> None:
    number = len(display.series)
    for i, (name, (x, y)) in enumerate(display.series.items()):
        a, b = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        step = max(1, -(-len(a) // _MOST_POINTS))
        few = len(a) < 50
        axes.plot(
            a[::step],
            b[::step],
            label=verbatim(name),
            markersize=4.5 if few else 1.3,
            alpha=1.0 if few else 0.45,
            markeredgewidth=0,
            rasterized=len(a) > 500,
            **_look(i, number, "points"),
        )


def _bars(axes: Axes, display: Display) -> None:
    names = list(display.series)
    values = [float(np.asarray(y, dtype=float)[0]) for _, y in display.series.values()]
    axes.barh(range(len(names)), values, color=PALETTE[1], height=0.7)
    axes.axvline(0, color="#444444", linewidth=0.6)
    short = [n if len(n) <= _LONG else f"{n[: _LONG - 1]}…" for n in names]
    axes.set_yticks(range(len(names)), [verbatim(n) for n in short], fontsize=6)
    axes.invert_yaxis()
    axes.tick_params(axis="y", length=0)


def _map(axes: Axes, display: Display) -> None:
    for _, image in display.series.values():
        values = np.asarray(image, dtype=float)
        finite = values[np.isfinite(values)]
        top = float(np.percentile(finite, 99)) if finite.size else 1.0
        shown = axes.imshow(values, cmap=sequential(), vmin=0, vmax=top or 1.0)
        bar = axes.figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.03)
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=6)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


_DRAW = {"curves": _curves, "points": _points, "bars": _bars, "map": _map}
