"""Estimators compared: their errors, and what they estimate for a few pixels.

`pattern_breakdown` draws a measure for each pattern, `error_curves` how errors fall with N,
`estimator_measures` all measures side by side, `pixel_estimates` a few pixels one by one.
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
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from chdstat._core.arrays import luminance
from chdstat._core.resampling import Interval
from chdstat.comparison import Breakdown, Comparison, ErrorCurve, PixelEstimates
from chdstat.errors import InputError
from chdstat.viz.styling import MISSING, PALETTE, WIDTH, qualitative, style, verbatim

__all__ = [
    "GREY",
    "TITLES",
    "Names",
    "called",
    "error_curves",
    "estimator_measures",
    "pattern_breakdown",
    "pixel_estimates",
]

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
    axes: Axes, value: Interval[Array], place: tuple[int, int], measure: str, *, neutral: float
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


Names = Mapping[str, str] | None

GREY = "#888888"
TITLES = {
    "mse": "MSE",
    "relmse": "relMSE",
    "mse_ratio": "MSE ratio",
    "relmse_ratio": "relMSE ratio",
    "fireflies_left": "fireflies left",
    "bias": "bias",
    "improved": "improved",
}


def estimator_measures(found: Comparison, *, names: Names = None) -> Figure:
    """Draw all measures of all estimators, those that use neighbours separately, below a line.

    Ratios are those to the sample mean, on a logarithmic scale; intervals are over blocks.

    Parameters
    ----------
    found
        What `chdstat.compare` found.
    names
        What to call the estimators; those not among them by their own name.
    """
    rows = np.arange(len(found.estimators)) + 0.6 * found.uses_neighbours
    titles = ["mse_ratio", "relmse_ratio", "improved", "bias", "fireflies_left"]
    with style():
        height = 0.75 + 0.165 * (rows.max() + 1)
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        panels = figure.subplots(1, len(titles), sharey=True, squeeze=False)[0]
        for axes, measure in zip(panels, titles, strict=True):
            axes.set_title(TITLES[measure])
            if measure == "improved":
                _shares(axes, rows, found)
            else:
                _points(axes, rows, found.measures[measure][:, -1], measure)
        for axes in panels:
            axes.set_axisbelow(True)
            axes.grid(axis="x", linewidth=0.4, color="#DDDDDD")
            axes.tick_params(axis="y", length=0)
            if found.uses_neighbours.any():
                line = rows[found.uses_neighbours].min() - 0.8
                axes.axhline(line, color=GREY, linewidth=0.6)
        panels[0].set_yticks(rows, called(found.estimators, names))
        panels[0].set_ylim(rows.max() + 0.6, -0.6)
        if found.uses_neighbours.any():
            figure.supxlabel("below the line: those that look at the pixels around", fontsize=7)
    return figure


def _points(axes: Axes, rows: Array, values: Interval[Array], measure: str) -> None:
    axes.hlines(rows, values.low, values.high, color=PALETTE[4], linewidth=1.6)
    axes.plot(values.value, rows, "o", color=PALETTE[4], markersize=3)
    axes.axvline(0 if measure == "bias" else 1, color=GREY, linewidth=0.9, linestyle="--")
    if measure == "bias":
        _percent_axis(axes)
    elif measure != "fireflies_left":
        _log_axis(axes, np.append(values.value, 1.0))
    axes.tick_params(axis="x", labelsize=6)


def _shares(axes: Axes, rows: Array, found: Comparison) -> None:
    """Draw the shares of estimates that got better, stayed, and got worse, as one bar each."""
    better, same = (found.measures[m].value[:, -1] for m in ("improved", "unchanged"))
    axes.barh(rows, better, height=0.7, color=PALETTE[2])
    axes.barh(rows, same, left=better, height=0.7, color="#E4E4E4")
    axes.barh(rows, 1 - better - same, left=better + same, height=0.7, color=PALETTE[5], alpha=0.55)
    axes.set_title("better, same, worse", fontsize=7.5)
    axes.axvline(0.5, color="#444444", linewidth=0.9, linestyle="--")
    axes.set_xlim(0, 1)
    _percent_axis(axes)
    axes.set_xticks([0, 0.5, 1])
    axes.tick_params(axis="x", labelsize=6)


def _percent_axis(axes: Axes) -> None:
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:.0f} %"))


def _log_axis(axes: Axes, values: Array) -> None:
    """Show positive values on a logarithmic scale whose ticks are few and readable."""
    axes.set_xscale("log")
    seen = values[np.isfinite(values) & (values > 0)]
    low, high = seen.min() / 1.25, seen.max() * 1.25
    steps = (1, 2, 5) if high / low < 30 else (1,)
    ticks = [m * 10.0**k for k in range(-6, 10) for m in steps]
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlim(low, high)
    axes.set_xticks([t for t in ticks if low <= t <= high])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def pixel_estimates(
    found: PixelEstimates, *, channel: str | None = None, names: Names = None
) -> Figure:
    """Draw a few pixels one by one: reference, sample mean and estimates.

    This is the numerical evaluation of Elek, Thomas and Forbes 2019. Thin lines join the sample
    mean to the reference: an estimate improves where it ends up closer to the black bar. The scale
    is linear near 0 and logarithmic beyond, so that black pixels have a place.

    Parameters
    ----------
    found
        Pixels and estimates, of `Comparison.draw_pixels`.
    channel
        Which channel; None draws the luminance where there are three, else the first.
    names
        What to call the estimators; those not among them by their own name.

    Raises
    ------
    InputError
        If there is no such channel, or no pixel.
    """
    if not len(found.pixels):
        message = "pixel_estimates needs at least one pixel, got none"
        raise InputError(message)
    reference, mean, *estimates = (
        _of_channel(values, found.channels, channel)
        for values in (found.reference, found.mean, *found.estimates)
    )
    order = np.argsort(reference, kind="stable")
    drawn = [(name, estimates[k]) for k, name in enumerate(found.estimators) if name != "mean"]
    places = np.arange(1, len(order) + 1)
    with style():
        figure = Figure(figsize=(WIDTH, 2.9), layout="constrained")
        axes = figure.subplots()
        axes.vlines(places, reference[order], mean[order], color="#BBBBBB", linewidth=0.8)
        axes.hlines(
            reference[order],
            places - 0.42,
            places + 0.42,
            color="#111111",
            linewidth=1.6,
            label="reference",
        )
        mark: dict[str, Any] = {"facecolors": "white", "edgecolors": "#555555", "linewidths": 0.9}
        axes.scatter(places, mean[order], s=20, label=f"mean of {found.n}", zorder=3, **mark)
        colors = qualitative(len(drawn))
        for k, ((name, values), at) in enumerate(zip(drawn, _offsets(len(drawn)), strict=True)):
            axes.scatter(
                places + at,
                values[order],
                s=11,
                marker="DsP^vX"[k % 6],
                color=[PALETTE[4], PALETTE[5], PALETTE[2], PALETTE[3], *colors][k],
                label=called([name], names)[0],
                zorder=4,
                linewidths=0,
            )
        _pixel_axes(axes, np.concatenate([reference, mean, *(v for _, v in drawn)]), found, channel)
        figure.legend(loc="outside upper center", ncols=min(6, 2 + len(drawn)))
    return figure


def _of_channel(values: Array, channels: tuple[str, ...], channel: str | None) -> Array:
    """Return one channel, or the luminance, of radiance (pixel, channel)."""
    if channel is None:
        data = values.astype(np.float64)
        return luminance(data, channel_axis=-1) if len(channels) == 3 else data[:, 0]
    if channel not in channels:
        message = f"channel must be one of {', '.join(channels)}, got {channel!r}"
        raise InputError(message)
    return values[:, channels.index(channel)].astype(np.float64)


def _pixel_axes(axes: Axes, values: Array, found: PixelEstimates, channel: str | None) -> None:
    positive = values[np.isfinite(values) & (values > 0)]
    knee = float(np.quantile(positive, 0.05)) / 2 if positive.size else 1.0
    axes.set_yscale("asinh", linear_width=knee)
    if (values > 0).all() and positive.max() < 10 * positive.min():
        # Without two powers of ten among them, the scale has ticks of six digits.
        axes.yaxis.set_major_locator(MaxNLocator(6))
    # Numbers between 0 and the knee would be written over each other.
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: "" if 0 < abs(value) < knee else f"{value:g}")
    )
    axes.yaxis.set_minor_locator(NullLocator())
    shown = verbatim(channel or ("luminance" if len(found.channels) == 3 else found.channels[0]))
    axes.set(xlim=(0.3, len(found.pixels) + 0.7), ylabel=f"{shown}, W sr$^{{-1}}$ m$^{{-2}}$")
    axes.set_xlabel(f"{len(found.pixels)} random pixels, from dark to bright")
    axes.set_xticks([])
    axes.grid(axis="y", linewidth=0.4, color="#DDDDDD")


def _offsets(count: int) -> Array:
    """Return where to put marks beside each other within a pixel's place."""
    return np.linspace(-0.22, 0.22, count) if count > 1 else np.zeros(count)


def called(names: Sequence[str], known: Names) -> list[str]:
    """Return what to write for names: what is known for them, or themselves in words."""
    return [(known or {}).get(name, name.replace("_", " ")) for name in names]
