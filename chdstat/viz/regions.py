"""Study figures: the regions of a scene, averages that become Gaussian, and training curves.

`region_study` follows the case study of Elek et al. 2019: an image with its regions in colours
and, for each of them, an inset and the linear and logarithmic histograms of its channels in the
colour of the region.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator

from chdstat.errors import InputError
from chdstat.viz.chd import Curve, Panel
from chdstat.viz.image import Mark, tonemap
from chdstat.viz.styling import CHANNELS, PALETTE, WIDTH, qualitative, style, verbatim

__all__ = ["averages", "region_study", "training"]

Array = npt.NDArray[Any]

_DASHES: tuple[Any, ...] = ("-", (0, (3, 1)), (0, (1, 0.8)))
"""Of the channels: colour is that of the region."""
_COLUMNS = 2
_ROW = 0.8
"""Height of a row of regions, in inches."""


def region_study(
    image: npt.ArrayLike,
    marks: Sequence[Mark],
    panels: Sequence[Panel],
    *,
    notes: Sequence[str] = (),
    exposure: float | None = None,
) -> Figure:
    """Draw an image with its regions, and the CHD of one pixel of each.

    Parameters
    ----------
    image
        Linear radiance, shape (y, x, channel).
    marks
        Regions, each with the pixel whose distribution is shown.
    panels
        CHDs of these pixels, in the same order; fits are not drawn.
    notes
        A line of text for each region, beside the image.
    exposure
        As in `chdstat.viz.tonemap`.

    Raises
    ------
    InputError
        If there is no region, or not a panel for each.
    """
    if not marks or len(panels) != len(marks):
        message = f"expected a panel for each region, got {len(panels)} for {len(marks)}"
        raise InputError(message)
    shown = tonemap(image, exposure=exposure)
    colors = qualitative(len(marks))
    rows = -(-len(marks) // _COLUMNS)
    aspect = shown.shape[0] / shown.shape[1]
    top = min(0.38 * WIDTH * aspect, 0.5 * WIDTH)
    with style():
        figure = Figure(figsize=(WIDTH, top + _ROW * rows + 0.3), layout="constrained")
        figure.get_layout_engine().set(wspace=0.01, hspace=0.02)  # type: ignore[union-attr,call-arg]
        upper, lower = figure.subfigures(
            2, 1, squeeze=False, height_ratios=[top, _ROW * rows + 0.3]
        ).ravel()
        _overview(upper, shown, marks, colors, notes)
        ratios = [1, 1.45, 1.45] * _COLUMNS
        axes = lower.subplots(rows, 3 * _COLUMNS, squeeze=False, width_ratios=ratios)
        for i, (mark, panel) in enumerate(zip(marks, panels, strict=True)):
            row, column = i % rows, i // rows
            cells = axes[row, 3 * column : 3 * column + 3]
            _inset(cells[0], shown, mark, colors[i], f"{i + 1} {verbatim(mark.name)}")
            _chds(cells[1], cells[2], panel, colors[i])
        for i in range(len(marks), rows * _COLUMNS):
            for cell in axes[i % rows, 3 * (i // rows) : 3 * (i // rows) + 3]:
                cell.set_axis_off()
        _legend(lower, panels[0])
    return figure


def _overview(
    figure: Any, shown: Array, marks: Sequence[Mark], colors: Sequence[str], notes: Sequence[str]
) -> None:
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.0])
    left.imshow(shown, interpolation="nearest")
    for i, (mark, color) in enumerate(zip(marks, colors, strict=True)):
        _frame(left, mark, color, str(i + 1))
    left.set(xticks=[], yticks=[])
    left.spines[:].set_visible(False)
    right.set_axis_off()
    step = 1 / max(len(marks), 6)
    for i, (mark, color) in enumerate(zip(marks, colors, strict=True)):
        y = 1 - (i + 0.5) * step
        right.text(
            0.01, y, str(i + 1), fontsize=7.5, fontweight="bold", ha="center", va="center",
            bbox={"boxstyle": "round,pad=0.2", "facecolor": color, "edgecolor": "none"},
        )  # fmt: skip
        right.text(0.06, y, verbatim(mark.name), fontsize=8, fontweight="bold", va="center")
        if i < len(notes):
            right.text(0.40, y, notes[i], fontsize=7.5, va="center", color="#333333")
    right.set(xlim=(0, 1), ylim=(0, 1))


def _frame(axes: Axes, mark: Mark, color: str, number: str) -> None:
    corner = (mark.xs.start - 0.5, mark.ys.start - 0.5)
    extent = (mark.xs.stop - mark.xs.start, mark.ys.stop - mark.ys.start)
    for edge, width in (("black", 2.4), (color, 1.4)):
        axes.add_patch(Rectangle(corner, *extent, fill=False, edgecolor=edge, linewidth=width))
    axes.annotate(
        number, corner, xytext=(-1, 1), textcoords="offset points", ha="right", va="bottom",
        fontsize=6.5, fontweight="bold", annotation_clip=True,
        bbox={"boxstyle": "round,pad=0.12", "facecolor": color, "edgecolor": "none"},
    )  # fmt: skip


def _inset(axes: Axes, shown: Array, mark: Mark, color: str, title: str) -> None:
    """Show a region and what is around it, with the pixel whose distribution is beside it."""
    y, x = mark.pixel
    half = max(4, mark.ys.stop - mark.ys.start, mark.xs.stop - mark.xs.start)
    axes.imshow(shown, interpolation="nearest")
    axes.set(xlim=(x - half - 0.5, x + half + 0.5), ylim=(y + half + 0.5, y - half - 0.5))
    axes.set(xticks=[], yticks=[], facecolor="#EEEEEE")
    axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, fill=False, edgecolor=color, linewidth=1.2))
    axes.spines[:].set(visible=True, color=color, linewidth=2)
    axes.set_title(title, fontsize=7, loc="left", pad=2, fontweight="bold")


def _chds(linear: Axes, log: Axes, panel: Panel, color: str) -> None:
    _lines(linear, panel.linear, color)
    _lines(log, panel.log, color)
    log.set_xscale("log")
    _limit(linear, panel.linear, log=False)
    _limit(log, panel.log, log=True)
    for axes in (linear, log):
        axes.set(yticks=[])
        axes.set_ylim(bottom=0)
        axes.spines["left"].set_visible(False)
        axes.spines["bottom"].set(color=color, linewidth=2)
        axes.tick_params(labelsize=6, pad=1.5)
    linear.locator_params(axis="x", nbins=3)
    log.set_title(panel.note, fontsize=6.5, loc="right", pad=2, color="#444444")


def _lines(axes: Axes, curves: Mapping[str, Curve], color: str) -> None:
    dark = tuple(0.6 * part for part in to_rgb(color))
    drawn = False
    for i, curve in enumerate(curves.values()):
        if np.isfinite(curve.edges).all() and np.isfinite(curve.density).all():
            axes.stairs(curve.density, curve.edges, fill=True, color=color, alpha=0.25)
            axes.stairs(
                curve.density, curve.edges, color=dark, linewidth=0.7, linestyle=_DASHES[i % 3]
            )
            drawn = True
    if not drawn:
        axes.annotate(
            "no positive samples",
            (0.5, 0.5),
            xycoords="axes fraction",
            ha="center",
            fontsize=6,
        )


def _limit(axes: Axes, curves: Mapping[str, Curve], *, log: bool) -> None:
    """Show where samples are."""
    spans = []
    for curve in curves.values():
        filled = np.flatnonzero(np.nan_to_num(curve.density) > 0)
        if filled.size and np.isfinite(curve.edges).all():
            spans.append((curve.edges[filled[0]], curve.edges[filled[-1] + 1]))
    if not spans:
        axes.set_xlim(*((1e-5, 1e5) if log else (0, 1)))
        return
    low, high = min(s[0] for s in spans), max(s[1] for s in spans)
    if log:
        low, high = 10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high))
    axes.set_xlim(low if log else min(0.0, float(low)), high)


def _legend(figure: Any, panel: Panel) -> None:
    if len(panel.log) < 2:
        return
    handles = [
        Line2D(
            [], [], color="#333333", linewidth=0.9, linestyle=_DASHES[i % 3], label=verbatim(name)
        )
        for i, name in enumerate(panel.log)
    ]
    title = "densities of radiance in W sr$^{-1}$ m$^{-2}$, linear and logarithmic; channels:"
    handles.insert(0, Line2D([], [], linestyle="", label=title))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles), fontsize=7, handlelength=2
    )


def averages(
    sizes: npt.ArrayLike,
    rejected: Mapping[str, npt.ArrayLike],
    skewness: npt.ArrayLike,
    predicted: npt.ArrayLike,
    *,
    alpha: float,
    scale: Literal["linear", "log"] = "linear",
) -> Figure:
    """Draw how far averages of N samples are from Gaussian.

    What the central limit theorem promises of skewness falls as 1 / sqrt(N): on a logarithmic scale
    it is a straight line of slope -1/2, and samples that depend on each other depart from it.

    Parameters
    ----------
    sizes
        N, shape (size,).
    rejected
        By name of the subject, the share of pixels whose averages are told from Gaussian,
        shape (size,).
    skewness
        Quartiles over the pixels of the skewness of averages, shape (3, size).
    predicted
        Median over the pixels of the skewness that the central limit theorem promises, (size,).
    alpha
        The false-discovery rate, drawn as a line.
    scale
        Of skewness. "log" leaves out what is not positive.
    """
    n = np.asarray(sizes)
    low, middle, high = np.asarray(skewness, dtype=float)
    with style():
        figure = Figure(figsize=(WIDTH, 2.3), layout="constrained")
        left, right = figure.subplots(1, 2)
        for i, (name, share) in enumerate(rejected.items()):
            color, marker = CHANNELS.get(name, PALETTE[4 + i % 4]), "os^D"[i % 4]
            label = verbatim(name)
            left.plot(n, np.asarray(share), marker=marker, markersize=3.5, color=color, label=label)
        left.axhline(alpha, color="#888888", linewidth=0.8, linestyle=":")
        left.set(ylim=(0, 1.02), ylabel="share told from Gaussian")
        left.legend(loc="best")
        right.fill_between(n, low, high, color=PALETTE[1], alpha=0.35, linewidth=0)
        right.plot(n, middle, marker="o", markersize=3.5, color=PALETTE[4], label="measured")
        right.plot(
            n, np.asarray(predicted), color=PALETTE[5], linestyle="--", label=r"CLT: $1/\sqrt{N}$"
        )
        right.set(ylabel="skewness of averages")
        right.legend(loc="lower left" if scale == "log" else "upper right")
        if scale == "log":
            right.set_yscale("log", nonpositive="mask")
            right.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            right.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        for axes in (left, right):
            axes.set_xscale("log", base=2)
            axes.set_xticks(n, [str(v) for v in n])
            axes.minorticks_off()
            axes.set_xlabel("samples in an average, N")
    return figure


def training(
    iterations: npt.ArrayLike,
    losses: Mapping[str, npt.ArrayLike],
    baseline: Mapping[str, float],
) -> Figure:
    """Draw a model's loss over its training against the error of the sample mean.

    Parameters
    ----------
    iterations
        Shape (record,).
    losses
        Squared error by name ("training", "validation"), shape (record,).
    baseline
        Squared error of the sample mean on the same batches, by the same names.
    """
    with style():
        figure = Figure(figsize=(WIDTH * 0.49, 2.3), layout="constrained")
        axes = figure.subplots()
        for i, (name, values) in enumerate(losses.items()):
            color = (PALETTE[1], PALETTE[4])[i % 2]
            axes.plot(np.asarray(iterations), np.asarray(values), color=color, label=name)
            if name in baseline:
                label = f"sample mean, {name}"
                axes.axhline(baseline[name], color=color, linewidth=0.9, ls="--", label=label)
        axes.set(xlabel="iteration", ylabel="squared error", yscale="log")
        axes.set_xlim(left=0)
        if baseline:  # a few spikes of the optimiser must not squeeze the rest
            axes.set_ylim(top=3 * max(baseline.values()))
        figure.legend(loc="outside upper center", ncols=2)
    return figure
