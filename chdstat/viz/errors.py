"""Errors: which estimator errs how much, for each pattern and against the number of samples.

`pattern_breakdown` draws a measure for each pattern, `error_curves` how errors fall with N.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from chdstat.comparison import Breakdown, ErrorCurve
from chdstat.errors import InputError
from chdstat.metrics import Interval
from chdstat.viz.estimates import GREY, TITLES, Names, called
from chdstat.viz.style import MISSING, WIDTH, qualitative, style

__all__ = ["error_curves", "pattern_breakdown"]

Array = npt.NDArray[Any]

_EXTREME = 8.0
"""Ratios beyond this, or its inverse, have the colour of this."""
_LEVEL = 6
"""Estimators whose names have room beside each other."""
_NEUTRAL = {"mse_ratio": 1.0, "relmse_ratio": 1.0, "bias": 0.0}
"""What can be broken down, and what the sample mean has."""


def pattern_breakdown(
    found: Breakdown,
    *,
    measure: Literal["mse_ratio", "relmse_ratio", "bias"] = "relmse_ratio",
    names: Names = None,
) -> Figure:
    """Draw one measure for each pattern and estimator as a table with colours.

    The frame marks the smallest error of each pattern among the estimators that look at one pixel.
    Pale numbers are those whose interval holds what the sample mean has: 1, or 0 for bias, which is
    in per cent.

    Parameters
    ----------
    found
        The measures by label.
    measure
        Which one to draw.
    names
        What to call estimators and labels; those not among them by their own name.

    Raises
    ------
    InputError
        If there is no such measure to draw.
    """
    if measure not in _NEUTRAL:
        message = f"measure must be one of {', '.join(_NEUTRAL)}; got {measure!r}"
        raise InputError(message)
    values = found.measures[measure]
    error: Literal["mse", "relmse"] = "mse" if measure == "mse_ratio" else "relmse"
    best = found.best(error)
    with style():
        size = (WIDTH, 1.45 + 0.24 * len(found.labels))
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots()
        axes.imshow(
            _shade(values.value, measure),
            cmap="PuOr" if measure == "bias" else "BrBG_r",
            norm=TwoSlopeNorm(0, -1.4, 1.4),
            aspect="auto",
        )
        axes.set_facecolor(MISSING)
        for row in range(len(found.labels)):
            for column, name in enumerate(found.estimators):
                at = values[row, column]
                _number(axes, at, (column, row), measure, neutral=_NEUTRAL[measure])
                if name == best[row] and np.isfinite(at.value):
                    axes.add_patch(_frame(column, row))
        _label_table(axes, found, names)
        unit = ", %" if measure == "bias" else ""
        axes.set_title(f"{TITLES[measure]} for each pattern{unit}", loc="left")
    return figure


def _shade(values: Array, measure: str) -> Array:
    """Return values from -1 to 1 around what the sample mean has."""
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = 2 * values if measure == "bias" else np.log(values) / np.log(_EXTREME)
    return np.ma.masked_invalid(np.clip(scaled, -1, 1))


def _number(
    axes: Axes, value: Interval, place: tuple[int, int], measure: str, *, neutral: float
) -> None:
    if not np.isfinite(value.value):
        return
    number = float(value.value)
    if measure == "bias":
        text = f"{round(100 * number):+d}".replace("+0", "0").replace("-", "−")
    else:
        text = f"{number:.{2 if number < 9.95 else 0}f}"
    decided = bool(value.low > neutral or value.high < neutral)
    color = "#111111" if decided else "#999999"
    axes.text(*place, text, ha="center", va="center", fontsize=6, color=color)


def _frame(column: int, row: int) -> Rectangle:
    return Rectangle(
        (column - 0.47, row - 0.45), 0.94, 0.9, fill=False, edgecolor="#111111", linewidth=1.3
    )


def _label_table(axes: Axes, found: Breakdown, names: Names) -> None:
    """Name rows and columns; a line parts the estimators that use neighbours."""
    share = found.pixels / max(1, found.pixels.sum())
    rows = [
        f"{label}, {100 * part:.0f} %" if part >= 0.005 else f"{label}, {count} px"
        for label, part, count in zip(
            called(found.labels, names), share, found.pixels.tolist(), strict=True
        )
    ]
    axes.set_yticks(np.arange(len(rows)), rows)
    columns = called(found.estimators, names)
    axes.set_xticks(np.arange(len(columns)), columns)
    if len(columns) > _LEVEL:
        axes.tick_params(axis="x", rotation=40)
        for text in axes.get_xticklabels():
            text.set(ha="right", rotation_mode="anchor")
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    if found.uses_neighbours.any():
        first = int(np.flatnonzero(found.uses_neighbours)[0])
        axes.axvline(first - 0.5, color="#111111", linewidth=1)


def error_curves(
    found: ErrorCurve,
    *,
    measures: Sequence[Literal["mse", "relmse", "mse_ratio", "relmse_ratio", "fireflies_left"]] = (
        "mse",
        "relmse",
    ),
    names: Names = None,
) -> Figure:
    """Draw errors against the number of samples, both on logarithmic scales.

    Bands are intervals over blocks of pixels; dashed lines are estimators that use neighbours. A
    dotted line is the noise of the reference, below which no error can be seen.

    Parameters
    ----------
    found
        What `chdstat.error_curve` found.
    measures
        One panel each.
    names
        What to call the estimators; those not among them by their own name.

    Raises
    ------
    InputError
        If there is no measure to draw.
    """
    if not measures:
        message = "error_curves needs at least one measure, got none"
        raise InputError(message)
    colors = dict(zip(found.estimators, _line_colors(found.estimators), strict=True))
    rows = -(-len(found.estimators) // 4)
    with style():
        figure = Figure(figsize=(WIDTH, 2.3 + 0.17 * rows), layout="constrained")
        panels = figure.subplots(1, len(measures), squeeze=False)[0]
        for axes, measure in zip(panels, measures, strict=True):
            _lines(axes, found, measure, colors, called(found.estimators, names))
            axes.set(xlabel="samples in an estimate, N", ylabel=TITLES[measure])
            axes.set_xscale("log", base=2)
            axes.set_xticks(found.sizes, [str(n) for n in found.sizes])
            axes.minorticks_off()
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=6.5)
    return figure


def _lines(
    axes: Axes, found: ErrorCurve, measure: str, colors: Mapping[str, str], called: list[str]
) -> None:
    interval = found.measures[measure]
    axes.set_yscale("linear" if measure == "fireflies_left" else "log")
    for k, name in enumerate(found.estimators):
        values = interval[:, k]
        if not np.isfinite(values.value).any():
            continue
        dashed = "--" if found.uses_neighbours[k] else "-"
        axes.fill_between(
            found.sizes, values.low, values.high, color=colors[name], alpha=0.18, linewidth=0
        )
        axes.plot(
            found.sizes,
            values.value,
            dashed,
            marker="o",
            markersize=2.5,
            color=colors[name],
            label=called[k],
            zorder=2.5 if name == "mean" else 2,  # what all others are measured against
        )
    if measure in found.reference_noise:
        axes.plot(
            found.sizes,
            found.reference_noise[measure],
            ":",
            color=GREY,
            linewidth=1,
            label="noise of the reference",
        )


def _line_colors(estimators: Sequence[str]) -> list[str]:
    """Return a colour for each estimator, black for the mean."""
    colors = iter(qualitative(len(estimators)))
    return ["#111111" if name == "mean" else next(colors) for name in estimators]
