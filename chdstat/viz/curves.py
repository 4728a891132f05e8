"""Curves against the number of samples, on a logarithmic axis.

`curves` draws any quantity, `averages` how averages of N samples become Gaussian, `error_curves`
how the errors of estimators fall with N.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from chdstat.comparison import ErrorCurve
from chdstat.viz.estimators import called
from chdstat.viz.styling import (
    CHANNELS,
    PALETTE,
    grid,
    page,
    per_cent,
    plain_log,
    qualitative,
    style,
    verbatim,
)

__all__ = ["averages", "curves", "error_curves"]

_GREY = "#888888"
_COLORS = [PALETTE[i] for i in (4, 5, 2, 3, 0, 1, 7)] + ["#222222"]
_MARKERS = "osD^vP*X"


def _by_number(ax: Axes, numbers: npt.ArrayLike) -> None:
    """Make the x axis logarithmic, with a tick at each number of samples."""
    ax.set_xscale("log", base=2)
    ax.set_xticks(np.asarray(numbers), [str(n) for n in np.asarray(numbers).tolist()])
    ax.minorticks_off()


@style()
def curves(
    numbers: npt.ArrayLike,
    panels: Mapping[str, Mapping[str, npt.ArrayLike]],
    *,
    ylabel: str = "",
    level: float | None = None,
    columns: int = 2,
    log: bool = False,
    fig: Figure | None = None,
) -> Figure:
    """Draw shares, or other quantities, against the number of samples.

    Parameters
    ----------
    numbers
        Numbers of samples, shape (number,).
    panels
        By title, what a panel shows: by name, a curve of shape (number,). A curve has the same
        colour and mark in all panels.
    ylabel
        What is drawn.
    level
        Drawn as a dotted line.
    columns
        Panels side by side.
    log
        Give each panel a logarithmic axis of its own, as errors need; otherwise all share one from
        0 to 1.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no panel.

    Examples
    --------
    >>> figure = curves([8, 16], {"gamma": {"one test": [0.2, 0.4], "another": [0.3, 0.5]}})
    >>> len(figure.axes)
    1
    """
    names = list(dict.fromkeys(name for panel in panels.values() for name in panel))
    labels = [verbatim(called(name)) for name in names]
    looks = [
        {"color": _COLORS[i % len(_COLORS)], "marker": _MARKERS[i % len(_MARKERS)]}
        for i in range(len(names))
    ]
    rows, alone = -(-len(panels) // columns), len(panels) == 1
    figure = page(fig, 2.8 if alone else 1.85 * rows + 0.4)
    axes = grid(figure, len(panels), 1 if alone else columns, sharey=not log)
    for ax, (title, panel) in zip(axes, panels.items(), strict=True):
        for name, values in panel.items():
            i = names.index(name)
            look: dict[str, Any] = {**looks[i], "markersize": 3.5, "label": labels[i]}
            ax.plot(np.asarray(numbers), np.asarray(values), **look)
        if level is not None:
            ax.axhline(level, color=_GREY, linewidth=0.8, linestyle=":")
        ax.set_title(verbatim(title))
        if log:
            ax.set_yscale("log", nonpositive="mask")
        else:
            ax.set_ylim(0, 1.03)
        _by_number(ax, numbers)
    for ax in axes[-columns:]:
        ax.set_xlabel("samples")
    for ax in axes[::columns]:
        ax.set_ylabel(ylabel)
    lines = {str(line.get_label()): line for ax in axes for line in ax.lines}
    handles = [lines[label] for label in labels]
    if alone:
        figure.legend(handles=handles, loc="outside right center")
    else:
        figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


@style()
def averages(
    sizes: npt.ArrayLike,
    rejected: Mapping[str, npt.ArrayLike],
    skewness: npt.ArrayLike,
    predicted: npt.ArrayLike,
    *,
    alpha: float,
    fig: Figure | None = None,
) -> Figure:
    """Draw how far averages of N samples are from Gaussian.

    By the central limit theorem, skewness falls as 1 / sqrt(N): on a logarithmic scale this is a
    straight line of slope -1/2, from which samples that depend on each other depart. Skewness that
    is not positive is left out.

    Parameters
    ----------
    sizes
        N, shape (size,).
    rejected
        By name of the channel, the share of pixels for whose averages normality is rejected,
        shape (size,).
    skewness
        Quartiles over the pixels of the skewness of averages, shape (3, size).
    predicted
        Median over the pixels of the skewness that the central limit theorem predicts, (size,).
    alpha
        The false-discovery rate, drawn as a dotted line.
    fig
        Where to draw; None makes a figure.
    """
    n = np.asarray(sizes)
    low, middle, high = np.asarray(skewness, dtype=float)
    figure = page(fig, 2.3)
    left, right = grid(figure, 2, 2)
    for i, (name, share) in enumerate(rejected.items()):
        color, marker = CHANNELS.get(name, PALETTE[4 + i % 4]), "os^D"[i % 4]
        label = verbatim(name)
        left.plot(n, np.asarray(share), marker=marker, markersize=3.5, color=color, label=label)
    left.axhline(alpha, color="#888888", linewidth=0.8, linestyle=":")
    left.set(ylim=(0, 1.02), ylabel="normality rejected, share of pixels")
    left.yaxis.set_major_formatter(per_cent)
    left.legend(loc="best")
    right.fill_between(n, low, high, color=PALETTE[1], alpha=0.35, linewidth=0)
    right.plot(n, middle, marker="o", markersize=3.5, color=PALETTE[4], label="measured")
    theorem = r"CLT: $1/\sqrt{N}$"
    right.plot(n, np.asarray(predicted), color=PALETTE[5], linestyle="--", label=theorem)
    right.set(ylabel="skewness of averages")
    right.legend(loc="lower left")
    right.set_yscale("log", nonpositive="mask")
    plain_log(right.yaxis)
    for ax in (left, right):
        _by_number(ax, n)
        ax.set_xlabel("samples in an average, N")
    return figure


@style()
def error_curves(found: ErrorCurve, *, fig: Figure | None = None) -> Figure:
    """Draw MSE and relMSE against the number of samples, on logarithmic scales.

    Bands are intervals over blocks of pixels; dashed lines are estimators that use neighbours. A
    dotted line is the noise of the reference, below which no error can be seen.

    Parameters
    ----------
    found
        What `chdstat.comparison.error_curve` found.
    fig
        Where to draw; None makes a figure.
    """
    figure = page(fig, 2.3 + 0.17 * -(-len(found.estimators) // 4))
    axes = grid(figure, 2, 2)
    for ax, (measure, title) in zip(axes, (("mse", "MSE"), ("relmse", "relMSE")), strict=True):
        _draw_errors(ax, found, measure, [called(name) for name in found.estimators])
        ax.set(xlabel="samples in an estimate, N", ylabel=title, yscale="log")
        _by_number(ax, found.sizes)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _draw_errors(ax: Axes, found: ErrorCurve, measure: str, names: Sequence[str]) -> None:
    """Draw one measure of all estimators, the mean in black above the others."""
    colors = iter(qualitative(len(names)))
    for k, name in enumerate(found.estimators):
        color = "#111111" if name == "mean" else next(colors)
        values = found.measures[measure][:, k]
        if not np.isfinite(values.value).any():
            continue
        band: dict[str, Any] = {"color": color, "alpha": 0.18, "linewidth": 0}
        ax.fill_between(found.sizes, values.low, values.high, **band)
        dashes = "--" if found.uses_neighbours[k] else "-"
        look: dict[str, Any] = {"color": color, "marker": "o", "markersize": 2.5}
        order = 2.5 if name == "mean" else 2
        ax.plot(found.sizes, values.value, dashes, label=names[k], zorder=order, **look)
    noise = found.reference_noise[measure]
    ax.plot(found.sizes, noise, ":", color=_GREY, linewidth=1, label="noise of the reference")
