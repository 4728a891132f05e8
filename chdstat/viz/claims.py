"""Claims: verdicts by scene, and intervals against the ranges that claims state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from chdstat.errors import InputError
from chdstat.viz.lettering import verbatim
from chdstat.viz.style import PALETTE, WIDTH, style

__all__ = ["VERDICTS", "Measured", "claim_intervals", "verdict_matrix"]

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
        missing or has "", nothing was asked. A trailing "*" marks what another seed repeated.

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
