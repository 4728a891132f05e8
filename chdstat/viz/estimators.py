"""Comparisons of estimators, and errors against the number of samples.

`pattern_breakdown` draws relMSE by pattern, `estimator_measures` all measures side by side,
`pixel_estimates` a few pixels one by one, and `error_curves` errors against the number of samples.
`training` draws losses, `averages` how averages become Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from chdstat._core.arrays import Array, luminance
from chdstat._core.display import Width
from chdstat._core.resampling import Interval
from chdstat.comparison import Breakdown, Comparison, ErrorCurve, PixelEstimates
from chdstat.comparison.metrics import WORSE
from chdstat.errors import InputError
from chdstat.estimators.training import History
from chdstat.viz.chd import Channels, chosen, one_of
from chdstat.viz.styling import (
    CHANNELS,
    MISSING,
    PALETTE,
    UNIT,
    axes_in,
    called,
    fitting,
    inches,
    name_ticks,
    narrow,
    panels_in,
    per_cent,
    plain_log,
    qualitative,
    style,
    verbatim,
)

_GREY = "#888888"
_TITLES = {
    "mse_ratio": "MSE ratio",
    "relmse_ratio": "relMSE ratio",
    "improved": "better, same, worse",
    "bias": "bias",
    "fireflies_left": "fireflies left",
}
_EXTREME = 8.0
"""Largest ratio of the colour scale; the smallest is its inverse."""
_FEW = 3.0
"""Log range of numbers below which there is room for several ticks per decade."""
_STARRED = "* uses neighbouring pixels"


@style()
def pattern_breakdown(found: Breakdown, *, width: Width = "page", ax: Axes | None = None) -> Axes:
    """Draw the ratio of relMSE to that of the mean, by pattern and estimator, as a coloured table.

    A frame marks the smallest error of each pattern among the estimators of single pixels. Numbers
    are pale if their interval contains 1, the value of the sample mean; bold ones with a sign are
    surely worse. Patterns without an error
    of the mean, such as constant pixels, have no row.

    Parameters
    ----------
    found
        The measures by label.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.
    """
    share = found.pixels / max(1, found.pixels.sum())
    ratio, best = found.measures["relmse_ratio"], np.array(found.best("relmse"))
    known = np.isfinite(ratio.value).any(axis=1)
    known |= ~known.any()  # if nothing is known, show all rows
    ratio, best, share = ratio[known], best[known], share[known]
    labels = [found.labels[k] for k in np.flatnonzero(known)]
    ax = axes_in(ax, 1.45 + 0.24 * len(labels), width)
    with np.errstate(divide="ignore", invalid="ignore"):
        shade = np.ma.masked_invalid(np.log(ratio.value) / np.log(_EXTREME))
    colors = TwoSlopeNorm(0, -1.4, 1.4)
    ax.imshow(shade.clip(-1, 1), cmap="BrBG_r", norm=colors, aspect="auto")
    ax.set_facecolor(MISSING)
    for row, column in np.argwhere(np.isfinite(ratio.value)):
        at = ratio[row, column]
        text = f"{at.value:.{2 if at.value < 9.95 else 0}f}"
        ink = "#111111" if at.low > 1 or at.high < 1 else "#999999"
        heavy = "normal"
        if at.low > 1:
            text, heavy = f"{text} {WORSE}", "bold"
        ax.text(column, row, text, ha="center", va="center", color=ink, fontweight=heavy)
        if found.estimators[column] == best[row]:
            corner = (column - 0.47, row - 0.45)
            frame: dict[str, Any] = {"fill": False, "edgecolor": "#111111", "linewidth": 1.3}
            ax.add_patch(Rectangle(corner, 0.94, 0.9, **frame))
    names = [
        f"{called(label)}, {per_cent(part)}" if part >= 0.005 else f"{called(label)}, {count} px"
        for label, part, count in zip(labels, share, found.pixels[known].tolist(), strict=True)
    ]
    ax.set_yticks(np.arange(len(names)), names)
    columns = _marked(found)
    cell = (inches("page", ax.get_figure(root=False)) - 1.4) / len(columns)  # beside the patterns
    slanted: dict[str, Any] = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
    ax.set_xticks(
        np.arange(len(columns)), columns, **slanted if max(map(len, columns)) > 17 * cell else {}
    )
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    if found.uses_neighbours.any():
        ax.set_xlabel(_STARRED)
    ax.set_title("relMSE ratio for each pattern", loc="left")
    return ax


def _marked(found: Breakdown | Comparison) -> list[str]:
    """Return the names of the estimators, with a star behind those that use neighbours."""
    around = found.uses_neighbours
    return [called(n) + " *" * bool(k) for n, k in zip(found.estimators, around, strict=True)]


@style()
def estimator_measures(
    found: Comparison,
    *,
    channels: Channels = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw all measures of all estimators; a star marks those that use neighbours.

    Ratios are to the sample mean, on a logarithmic scale; intervals are over blocks.

    Parameters
    ----------
    found
        Result of `chdstat.compare`.
    channels
        The channel whose measures are drawn: its name, "red", "green" or "blue"; None for the
        average over channels.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.
    """
    of = -1 if channels is None else found.channels.index(one_of(found.channels, channels))
    rows = np.arange(len(found.estimators))
    columns = fitting(inches(width, fig), len(_TITLES), 1.3)
    height = (0.75 + 0.165 * len(rows)) * -(-len(_TITLES) // columns)
    figure, axes = panels_in(fig, len(_TITLES), columns, height, width, sharey=True)
    for ax, (measure, title) in zip(axes, _TITLES.items(), strict=True):
        ax.set_title(title)
        ax.set_axisbelow(True)
        ax.grid(axis="x", linewidth=0.4, color="#DDDDDD")
        ax.tick_params(axis="y", length=0)
        if measure == "improved":
            _draw_shares(ax, rows, found, of)
        else:
            _draw_intervals(ax, rows, found.measures[measure][:, of], measure)
    axes[0].set_yticks(rows, _marked(found))
    axes[0].set_ylim(len(rows) - 0.4, -0.6)
    if found.uses_neighbours.any():
        figure.supxlabel(_STARRED)
    return figure


def _draw_intervals(ax: Axes, rows: Array, values: Interval[Array], measure: str) -> None:
    if not np.isfinite(values.value).any():
        middle: dict[str, Any] = {"transform": ax.transAxes, "ha": "center", "va": "center"}
        ax.text(0.5, 0.5, "cannot tell", color=_GREY, **middle)
        ax.set_xticks([])
        return
    ax.hlines(rows, values.low, values.high, color=PALETTE[4], linewidth=1.6)
    ax.plot(values.value, rows, "o", color=PALETTE[4], markersize=3)
    ax.axvline(0 if measure == "bias" else 1, color=_GREY, linewidth=0.9, linestyle="--")
    if measure == "bias":
        ax.xaxis.set_major_formatter(per_cent)
    elif measure != "fireflies_left":
        seen = np.append(values.value, 1.0)
        seen = seen[np.isfinite(seen) & (seen > 0)]
        ax.set(xscale="log", xlim=(seen.min() / 1.25, seen.max() * 1.25))
        span = np.ptp(np.log(seen))
        plain_log(ax.xaxis, (1, 2, 4, 6, 8) if span < 1 else (1, 2, 5) if span < _FEW else (1,))


def _draw_shares(ax: Axes, rows: Array, found: Comparison, of: int) -> None:
    """Draw the shares of estimates that got better, stayed, and got worse, as one bar.

    Between better and the rest, those are hatched of which the reference cannot tell.
    """
    improved, same = found.measures["improved"][:, of], found.measures["unchanged"].value[:, of]
    untold = np.isnan(improved.value)
    better = np.where(untold, improved.low, improved.value)
    unknown = np.where(untold, improved.high - improved.low, 0).clip(0, 1 - better - same)
    worse = 1 - better - unknown - same
    look: dict[str, Any] = {"height": 0.7}
    ax.barh(rows, better, color=PALETTE[2], **look)
    hatched: dict[str, Any] = {"color": "white", "edgecolor": PALETTE[2], "hatch": "/////"}
    ax.barh(rows, unknown, left=better, linewidth=0, **hatched, **look)
    ax.barh(rows, same, left=better + unknown, color="#E4E4E4", **look)
    ax.barh(rows, worse, left=1 - worse, color=PALETTE[5], alpha=0.55, **look)
    ax.axvline(0.5, color="#444444", linewidth=0.9, linestyle="--")
    ax.set_xlim(0, 1)
    ax.xaxis.set_major_formatter(per_cent)
    ax.set_xticks([0, 0.5, 1])


@style()
def pixel_estimates(
    found: PixelEstimates,
    *,
    channels: Channels = None,
    width: Width = "page",
    ax: Axes | None = None,
) -> Axes:
    """Draw a few pixels one by one: reference, sample mean and estimates of one channel.

    This is the numerical evaluation of Elek, Thomas and Forbes 2019. Thin lines connect the sample
    mean to the reference: an estimate is better than the mean if it is closer to the black bar. The
    scale is linear near 0 and logarithmic beyond, so that it includes black pixels.

    Parameters
    ----------
    found
        Pixels and estimates, from `Comparison.draw_pixels`.
    channels
        The channel to draw: its name, "red", "green", "blue" or "luminance"; None for luminance, or
        the first channel if there are not three.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no pixel, or the channel is unknown.
    """
    if not len(found.pixels):
        message = "pixel_estimates needs at least one pixel, got none"
        raise InputError(message)
    shown = np.stack([found.reference, found.mean, *found.estimates]).astype(np.float64)
    names = [*found.channels]
    if len(names) == 3:
        names.append("luminance")
        light = luminance(shown, channel_axis=-1)
        shown = np.concatenate([shown, light[..., np.newaxis]], axis=-1)
    which = one_of(names, channels or ("luminance" if len(names) == 4 else names[0]))
    light = shown[..., names.index(which)]
    reference, mean, *estimates = light[:, np.argsort(light[0], kind="stable")]
    drawn = [(name, estimates[k]) for k, name in enumerate(found.estimators) if name != "mean"]
    places = np.arange(1, len(mean) + 1)
    ax = axes_in(ax, 2.9, width)
    across = inches("page", ax.get_figure(root=False))
    ax.vlines(places, reference, mean, color="#BBBBBB", linewidth=0.8)
    bar: dict[str, Any] = {"color": "#111111", "linewidth": 1.6, "label": "reference"}
    ax.hlines(reference, places - 0.42, places + 0.42, **bar)
    mark: dict[str, Any] = {"facecolors": "white", "edgecolors": "#555555", "linewidths": 0.9}
    ax.scatter(places, mean, s=20, label=f"mean of {found.n}", zorder=3, **mark)
    colors = [PALETTE[4], PALETTE[5], PALETTE[2], PALETTE[3], *qualitative(len(drawn))]
    # The marks of a pixel lie side by side.
    offsets = np.linspace(-0.22, 0.22, len(drawn)) if len(drawn) > 1 else [0.0]
    for k, (name, values) in enumerate(drawn):
        label = called(name)
        look: dict[str, Any] = {"marker": "DsP^vX"[k % 6], "color": colors[k], "linewidths": 0}
        ax.scatter(places + offsets[k], values, s=11, label=label, zorder=4, **look)
    _set_radiance_axis(ax, light)
    ax.set(xlim=(0.3, len(mean) + 0.7), xticks=[])
    ax.set_xlabel(f"{len(mean)} random pixels, from dark to bright")
    ax.set_ylabel(f"{verbatim(which)}, {UNIT}")
    ax.legend(
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=fitting(across, min(4, 2 + len(drawn)), 1.6),
    )
    return ax


def _set_radiance_axis(ax: Axes, values: Array) -> None:
    """Make the y axis linear near 0 and logarithmic beyond, with few readable ticks."""
    positive = values[np.isfinite(values) & (values > 0)]
    knee = float(np.quantile(positive, 0.05)) / 2 if positive.size else 1.0
    ax.set_yscale("asinh", linear_width=knee)
    if (values > 0).all() and positive.max() < 10 * positive.min():
        # Without two powers of ten in range, tick labels would have six digits.
        ax.yaxis.set_major_locator(MaxNLocator(6))
    # Tick labels between 0 and the knee would overlap.
    ax.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: "" if 0 < abs(value) < knee else f"{value:g}")
    )
    ax.yaxis.set_minor_locator(NullLocator())
    ax.grid(axis="y", linewidth=0.4, color="#DDDDDD")


@style()
def training(history: History, *, width: Width = "column", ax: Axes | None = None) -> Axes:
    """Draw a model's loss over its training against the error of the sample mean.

    Parameters
    ----------
    history
        History of a trained model: its losses, and the error of the sample mean on the same
        batches.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.
    """
    ax = axes_in(ax, 2.3, width)
    lines = {
        "training": (history.train_loss, float(history.train_baseline[-1]), PALETTE[1]),
        "validation": (history.validation_loss, float(history.validation_baseline[-1]), PALETTE[4]),
    }
    for name, (loss, baseline, color) in lines.items():
        ax.plot(history.iteration, loss, color=color, label=name)
        label = f"sample mean, {name}"
        ax.axhline(baseline, color=color, linewidth=0.9, ls="--", label=label)
    ax.set(xlabel="iteration", ylabel="squared error", yscale="log")
    ax.set_xlim(left=0)
    # A few spikes may leave the axes, so that they do not squeeze the rest.
    ax.set_ylim(top=3 * max(baseline for _, baseline, _ in lines.values()))
    name_ticks(ax.yaxis)
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return ax


# --- against the number of samples --------------------------------------------------------------

_COLORS = [PALETTE[i] for i in (4, 5, 2, 3, 0, 1, 7)] + ["#222222"]
_MARKERS = "osD^vP*X"


def _by_number(ax: Axes, numbers: npt.ArrayLike) -> None:
    """Make the x axis logarithmic, with a tick at each number of samples."""
    ax.set_xscale("log", base=2)
    ax.set_xticks(np.asarray(numbers), [str(n) for n in np.asarray(numbers).tolist()])
    ax.minorticks_off()


@style()
def averages(
    sizes: npt.ArrayLike,
    rejected: Mapping[str, npt.ArrayLike],
    skewness: npt.ArrayLike,
    predicted: npt.ArrayLike,
    *,
    alpha: float,
    channels: Channels = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw how far averages of N samples are from Gaussian.

    By the central limit theorem, skewness falls as 1 / sqrt(N), a straight line of slope -1/2 on
    logarithmic scales. Dependent samples deviate from it. Skewness that is not positive is left
    out.

    Parameters
    ----------
    sizes
        N, shape (size,).
    rejected
        Share of pixels whose averages are not normal by the test, shape (size,), by name of the
        channel.
    skewness
        Quartiles, over pixels, of the skewness of averages, shape (3, size).
    predicted
        Median, over pixels, of the skewness that the central limit theorem predicts, shape (size,).
    alpha
        The false-discovery rate, drawn as a dotted line.
    channels
        Channels to draw: names, "red", "green", "blue" or "luminance"; None for all but luminance.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.
    """
    n = np.asarray(sizes)
    low, middle, high = np.asarray(skewness, dtype=float)
    columns = 1 if narrow(inches(width, fig)) else 2
    figure, (left, right) = panels_in(fig, 2, columns, 4.6 / columns, width)
    for i, name in enumerate(chosen([*rejected], channels)):
        color, marker = CHANNELS.get(name, PALETTE[4 + i % 4]), "os^D"[i % 4]
        label = verbatim(name)
        left.plot(
            n, np.asarray(rejected[name]), marker=marker, markersize=3.5, color=color, label=label
        )
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
def error_curves(found: ErrorCurve, *, width: Width = "page", fig: Figure | None = None) -> Figure:
    """Draw MSE and relMSE against the number of samples, on logarithmic scales.

    Bands are intervals over blocks of pixels. Dashed lines are estimators that use neighbours.

    Parameters
    ----------
    found
        Result of `chdstat.comparison.error_curve`.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.
    """
    across = inches(width, fig)
    columns, names = 1 if narrow(across) else 2, fitting(across, 4, 1.6)
    height = 4.4 / columns + 0.1 + 0.17 * -(-len(found.estimators) // names)
    figure, axes = panels_in(fig, 2, columns, height, width)
    for ax, (measure, title) in zip(axes, (("mse", "MSE"), ("relmse", "relMSE")), strict=True):
        _draw_error_curves(ax, found, measure, [called(name) for name in found.estimators])
        ax.set(xlabel="samples in an estimate, N", ylabel=title, yscale="log")
        name_ticks(ax.yaxis)
        _by_number(ax, found.sizes)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=names)
    return figure


def _draw_error_curves(ax: Axes, found: ErrorCurve, measure: str, names: Sequence[str]) -> None:
    """Draw one measure of all estimators, with the mean in black on top."""
    colors = iter(qualitative(len(names)))
    for k, name in enumerate(found.estimators):
        color = "#111111" if name == "mean" else next(colors)
        values = found.measures[measure][:, k]
        if not np.isfinite(values.value).any():
            continue
        band: dict[str, Any] = {"color": color, "alpha": 0.18, "linewidth": 0}
        ax.fill_between(found.sizes, values.low, values.high, **band)
        dashes = "--" if found.uses_neighbours[k] else "-"
        look: dict[str, Any] = {"color": color, "marker": _MARKERS[k % 8], "markersize": 3}
        order = 2.5 if name == "mean" else 2
        ax.plot(found.sizes, values.value, dashes, label=names[k], zorder=order, **look)
