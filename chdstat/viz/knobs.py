"""Knobs: what an estimator trades between two errors, and how often its intervals are right.

`tradeoff` draws errors, bias and improved share along a knob; `coverage` is a panel for `map_grid`,
beside maps of a certainty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from chdstat.errors import InputError
from chdstat.metrics import Interval
from chdstat.viz.style import PALETTE, WIDTH, style

__all__ = ["coverage", "tradeoff"]

_GREY = "#888888"
_MARKS = "sD^vP*"


def tradeoff(
    balances: npt.ArrayLike,
    measures: Mapping[str, Interval],
    *,
    others: Mapping[str, tuple[float, float]] | None = None,
    limits: tuple[float, float] | None = None,
) -> Figure:
    """Draw what an estimator trades along its knob.

    Left: relMSE against MSE, each point one place of the knob; middle: bias; right: share of
    estimates that improve. Bars and bands are intervals.

    Parameters
    ----------
    balances
        Places of the knob, shape (place,).
    measures
        "mse_ratio", "relmse_ratio", "bias" and "improved" at these places, each of shape (place,).
    others
        By name, MSE ratio and relMSE ratio of other estimators.
    limits
        MSE and relMSE ratio that nothing is known to fall below, drawn as dotted lines.

    Raises
    ------
    InputError
        If there is no place.

    Examples
    --------
    >>> import numpy as np
    >>> from chdstat.metrics import Interval
    >>> def sure(*values):
    ...     return Interval(*4 * [np.array(values)])
    >>> measures = {
    ...     "mse_ratio": sure(0.6, 0.7),
    ...     "relmse_ratio": sure(0.3, 0.2),
    ...     "bias": sure(0.0, -0.05),
    ...     "improved": sure(0.65, 0.67),
    ... }
    >>> len(tradeoff([0, 1], measures, limits=(0.5, 0.15)).axes)
    3
    """
    places = np.asarray(balances, float)
    if not places.size:
        message = "tradeoff needs at least one place of the knob, got none"
        raise InputError(message)
    with style():
        figure = Figure(figsize=(WIDTH, 2.2), layout="constrained")
        left, middle, right = figure.subplots(1, 3, width_ratios=(1.5, 1, 1))
        _errors(left, places, measures["mse_ratio"], measures["relmse_ratio"])
        for k, (name, (x, y)) in enumerate((others or {}).items()):
            left.plot(x, y, _MARKS[k % 6], color=PALETTE[(k + 1) % 8], label=name, markersize=4)
        if limits is not None:
            left.axvline(limits[0], color=_GREY, linestyle=":", linewidth=0.9, label="limit")
            left.axhline(limits[1], color=_GREY, linestyle=":", linewidth=0.9)
        if left.get_legend_handles_labels()[1]:
            left.legend(loc="best", fontsize=6.5)
        _band(middle, places, measures["bias"], "bias", neutral=0)
        _band(right, places, measures["improved"], "improved", neutral=0.5)
    return figure


def _errors(axes: Axes, places: npt.NDArray[Any], mse: Interval, relmse: Interval) -> None:
    axes.errorbar(
        mse.value,
        relmse.value,
        xerr=_arms(mse),
        yerr=_arms(relmse),
        color=PALETTE[4],
        marker="o",
        markersize=3,
        elinewidth=0.7,
    )
    for place, x, y in zip(places, mse.value, relmse.value, strict=True):
        axes.annotate(f"{place:g}", (x, y), xytext=(4, 3), textcoords="offset points", fontsize=6.5)
    axes.set(xlabel="MSE ratio", ylabel="relMSE ratio")


def _arms(values: Interval) -> npt.NDArray[Any]:
    return np.maximum([values.value - values.low, values.high - values.value], 0)


def _band(
    axes: Axes, places: npt.NDArray[Any], values: Interval, title: str, *, neutral: float
) -> None:
    axes.fill_between(places, values.low, values.high, color=PALETTE[1], alpha=0.35, linewidth=0)
    axes.plot(places, values.value, marker="o", markersize=3, color=PALETTE[4])
    axes.axhline(neutral, color=_GREY, linewidth=0.9, linestyle="--")
    axes.set(xlabel="balance", title=title)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:.3g} %"))


def coverage(
    levels: npt.ArrayLike, measured: Mapping[str, Sequence[float] | npt.NDArray[Any]], *, title: str
) -> Callable[[Axes], None]:
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
        axes.plot([low, 1], [low, 1], color=_GREY, linewidth=0.9, linestyle="--")
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
