"""CHDs of pixels: histograms with their fits, and histograms of batches and their means.

`chd_grid` and `chd_axes` draw linear and log10 histograms per channel. `batch_histograms` follows
the first figure of Elek et al. 2019: many batches of samples superimposed, and below them the
histogram of their means.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from chdstat.errors import InputError
from chdstat.summary.histograms import Histogram
from chdstat.viz.styling import CHANNELS, PALETTE, WIDTH, qualitative, style, verbatim

__all__ = ["BatchPanel", "Curve", "Panel", "batch_histograms", "chd_axes", "chd_grid", "fits"]

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class BatchPanel:
    """Batches of samples of one pixel and channel.

    Parameters
    ----------
    name
        Title.
    edges
        Edges of the bins of radiance, shape (bin + 1,).
    counts
        Samples of each batch in each bin, shape (batch, bin).
    mean_edges, mean_counts
        The same of the means of the batches, shapes (bin + 1,) and (bin,).
    expected
        Mean of all samples, drawn as a dashed line.
    """

    name: str
    edges: Array
    counts: Array
    mean_edges: Array
    mean_counts: Array
    expected: float


def batch_histograms(panels: Sequence[BatchPanel], *, number: int, size: int) -> Figure:
    """Draw superimposed histograms of batches and, below, those of their means.

    Parameters
    ----------
    panels
        Pixels, side by side.
    number, size
        How many batches there are, and samples in each.

    Raises
    ------
    InputError
        If there is no panel.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(0).gamma(0.5, size=(64, 32))
    >>> edges = np.linspace(0, 5, 41)
    >>> counts = np.stack([np.histogram(batch, edges)[0] for batch in x])
    >>> means = np.histogram(x.mean(axis=1), 20)
    >>> panel = BatchPanel("wall", edges, counts, means[1], means[0], 0.5)
    >>> len(batch_histograms([panel], number=64, size=32).axes)
    2
    """
    if not panels:
        message = "batch_histograms needs at least one pixel, got none"
        raise InputError(message)
    colors = qualitative(len(panels))
    with style():
        width = WIDTH * min(1.0, 0.26 * len(panels))
        figure = Figure(figsize=(width, 2.1), layout="constrained")
        axes = figure.subplots(2, len(panels), squeeze=False)
        for (upper, lower), panel, color in zip(axes.T, panels, colors, strict=True):
            alpha = min(0.5, max(0.03, 2.5 / len(panel.counts)))
            outlines = [*_outlines(panel)]
            upper.add_collection(PolyCollection(outlines, facecolor=color, lw=0, alpha=alpha))
            upper.stairs(panel.counts.mean(axis=0), panel.edges, color="#222222", linewidth=0.6)
            lower.stairs(panel.mean_counts, panel.mean_edges, fill=True, color=color)
            for cell in (upper, lower):
                cell.axvline(panel.expected, color="black", linewidth=0.9, linestyle="--")
                cell.set(yticks=[])
                cell.set_xlim(left=min(0.0, float(np.min(panel.edges))))
                cell.locator_params(axis="x", nbins=3)
                cell.spines["left"].set_visible(False)
            top = float(np.max(panel.counts[:, 1:], initial=0))
            upper.set_ylim(0, 1.15 * top or 1.0)
            upper.set_title(verbatim(panel.name), fontsize=8)
        axes[0, 0].set_ylabel(f"{number} batches\nof {size} samples")
        axes[1, 0].set_ylabel(f"their {number}\nmeans")
        figure.supxlabel("radiance in W sr$^{-1}$ m$^{-2}$", fontsize=8)
    return figure


def _outlines(panel: BatchPanel) -> npt.NDArray[np.float64]:
    """Return the outline of each batch's histogram, shape (batch, corner, 2): drawn as one."""
    counts = np.asarray(panel.counts, dtype=np.float64)
    x = np.repeat(panel.edges, 2)
    y = np.pad(np.repeat(counts, 2, axis=1), ((0, 0), (1, 1)))
    return np.stack([np.broadcast_to(x, y.shape), y], axis=-1)


_UNIT = r"W$\,$sr$^{-1}\,$m$^{-2}$"

_POINTS = 400
_LINES = (PALETTE[4], PALETTE[5], PALETTE[2], PALETTE[3], PALETTE[0], "black")
_DASHES = ("-", "--", "-.", (0, (4, 1, 1, 1, 1, 1)), ":", (0, (1, 1)))
Scale = Literal["linear", "log"]
Density = Callable[[Array], Array]


@dataclass(frozen=True)
class Curve:
    """A histogram as densities, with the fit that goes over it.

    Parameters
    ----------
    edges
        Edges of the bins in radiance, shape (bin + 1,).
    density
        Share of the samples per unit of radiance (linear) or per decade (log), shape (bin,).
    fit
        Density of the fitted family in the same unit, shape (bin,); None draws none.
    """

    edges: Array
    density: Array
    fit: Array | None = None


@dataclass(frozen=True)
class Panel:
    """The CHD of one pixel.

    Parameters
    ----------
    name
        Title.
    linear, log
        Histograms by channel name.
    mean
        Mean radiance by channel name, drawn as a tick.
    note
        A line of text in the log panel, such as the share of nulls and the fitted family.
    """

    name: str
    linear: Mapping[str, Curve]
    log: Mapping[str, Curve]
    mean: Mapping[str, float] = field(default_factory=dict)
    note: str = ""


def chd_axes(axes: Axes, curves: Histogram | Mapping[str, Curve], *, scale: Scale) -> None:
    """Draw the histograms of all channels into one panel.

    Parameters
    ----------
    axes
        Where to draw.
    curves
        What `chdstat.histogram` returns for one pixel, of shape (channel, bin) or (bin,); or curves
        by channel name. R, G and B, which three channels are, have their colours.
    scale
        "linear", or "log" for a log10 axis of radiance.

    Raises
    ------
    InputError
        If a histogram has another scale, or is not one of a single pixel.

    Examples
    --------
    >>> from chdstat import histogram
    >>> samples = np.random.default_rng(0).gamma(1.0, size=(3, 256))
    >>> axes = Figure().subplots()
    >>> chd_axes(axes, histogram(samples, scale="log"), scale="log")
    """
    if isinstance(curves, Histogram):
        curves = _curves(curves, scale)
    for i, (channel, curve) in enumerate(curves.items()):
        color = _color(channel, i)
        if np.isfinite(curve.edges).all() and np.isfinite(curve.density).all():
            axes.stairs(curve.density, curve.edges, color=color, fill=True, alpha=0.22)
            axes.stairs(
                curve.density, curve.edges, color=color, linewidth=0.7, label=verbatim(channel)
            )
            if curve.fit is not None:
                axes.plot(_centers(curve.edges, scale), curve.fit, color=color, linewidth=1.3)
    if not axes.patches:
        center = (0.5, 0.5)
        axes.annotate(
            "no positive samples", center, xycoords="axes fraction", ha="center", fontsize=7
        )
    if scale == "log":
        axes.set_xscale("log")
    axes.set_xlim(*_limits(curves, scale))
    axes.set_ylim(bottom=0)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)


def _curves(histogram: Histogram, scale: Scale) -> dict[str, Curve]:
    """Return the curves of the channels of a pixel."""
    if histogram.scale != scale or histogram.counts.ndim > 2:
        message = (
            f"expected a {scale} histogram of one pixel, shape (channel, bin), got a "
            f"{histogram.scale} one of shape {histogram.counts.shape}"
        )
        raise InputError(message)
    parts = list(zip(np.atleast_2d(histogram.edges), np.atleast_2d(histogram.density), strict=True))
    names = "RGB" if len(parts) == 3 else [f"channel{i}" for i in range(len(parts))]
    return {name: Curve(*part) for name, part in zip(names, parts, strict=True)}


def _color(channel: str, place: int) -> str:
    return CHANNELS.get(channel, PALETTE[place % len(PALETTE)])


def _centers(edges: Array, scale: Scale) -> Array:
    low, high = edges[:-1], edges[1:]
    return np.asarray(np.sqrt(low * high) if scale == "log" else (low + high) / 2)


def _limits(curves: Mapping[str, Curve], scale: Scale) -> tuple[float, float]:
    """Return the span of radiance that holds samples, in whole decades on a log axis."""
    spans = []
    for curve in curves.values():
        filled = np.flatnonzero(np.nan_to_num(curve.density) > 0)
        if filled.size and np.isfinite(curve.edges).all():
            spans.append((curve.edges[filled[0]], curve.edges[filled[-1] + 1]))
    if not spans:
        return (1e-5, 1e5) if scale == "log" else (0.0, 1.0)
    low, high = min(s[0] for s in spans), max(s[1] for s in spans)
    if scale == "linear":
        return min(0.0, float(low)), float(high)
    return 10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high))


def chd_grid(panels: Sequence[Panel], *, columns: int = 2) -> Figure:
    """Draw linear and log10 CHDs of several pixels, each framed in the colour of its region.

    Parameters
    ----------
    panels
        In the order of the marks in the image, so that colours agree.
    columns
        Pixels side by side; each takes two panels.

    Raises
    ------
    InputError
        If there is no panel.
    """
    if not panels:
        message = "chd_grid needs at least one panel, got none"
        raise InputError(message)
    rows = -(-len(panels) // columns)
    with style():
        figure = Figure(figsize=(WIDTH, 1.27 * rows + 0.3), layout="constrained")
        figure.get_layout_engine().set(wspace=0.02, hspace=0.04)  # type: ignore[union-attr,call-arg]
        axes = figure.subplots(rows, 2 * columns, squeeze=False)
        for cell in axes.flat[2 * len(panels) :]:
            cell.set_axis_off()
        for i, panel in enumerate(panels):
            row, column = divmod(i, columns)
            pair = axes[row, 2 * column : 2 * column + 2]
            _pair(pair[0], pair[1], panel, number=i + 1)
            if row == rows - 1 or i + columns >= len(panels):
                pair[0].set_xlabel(f"radiance ({_UNIT})")
                pair[1].set_xlabel(f"radiance ({_UNIT}), log scale")
            pair[0].set_ylabel("density", fontsize=7)
        channels = [
            Line2D([], [], color=_color(c, i), label=verbatim(c))
            for i, c in enumerate(panels[0].log)
        ]
        axes[0, 0].legend(handles=channels, loc="upper right", handlelength=1, borderaxespad=0)
    return figure


def fits(
    linear: Histogram, log: Histogram, fitted: Mapping[str, Density], *, title: str = ""
) -> Figure:
    """Draw several fits of one pixel over its linear and its log10 histogram.

    Parameters
    ----------
    linear, log
        Histograms of the same samples, for one pixel and channel.
    fitted
        By name, the density of the positive samples per unit of radiance: ``fit.pdf`` of a
        `chdstat.fit.Fit`, of a mixture, or of a SciPy distribution.
    title
        What is shown.

    Raises
    ------
    InputError
        If a histogram is one of several pixels or channels.

    Examples
    --------
    >>> import chdstat as chd
    >>> from chdstat import viz
    >>> x = np.random.default_rng(1).gamma(2.0, size=500)
    >>> histograms = chd.histogram(x, scale="linear"), chd.histogram(x, scale="log")
    >>> names = ("gamma", "lognormal")
    >>> figure = viz.fits(*histograms, {name: chd.fit.fit(x, name).pdf for name in names})
    >>> len(figure.axes)
    2
    """
    for counted in (linear, log):
        if counted.counts.ndim != 1:
            message = (
                "expected the histogram of one channel of one pixel, counts of shape (bin,), "
                f"got shape {counted.counts.shape}"
            )
            raise InputError(message)
    with style():
        figure = Figure(figsize=(WIDTH, 2.2), layout="constrained")
        axes = figure.subplots(1, 2)
        for ax, counted in zip(axes, (linear, log), strict=True):
            _overlay(ax, counted, fitted)
        axes[0].set_xlabel(f"radiance ({_UNIT})")
        axes[0].set_ylabel("density per unit of radiance", fontsize=7)
        axes[1].set_xlabel(f"radiance ({_UNIT}), log scale")
        axes[1].set_ylabel("density per decade", fontsize=7)
        if axes[0].get_legend_handles_labels()[0]:
            axes[0].legend(loc="upper right")
        axes[0].set_title(title, loc="left")
    return figure


def _overlay(axes: Axes, counted: Histogram, fitted: Mapping[str, Density]) -> None:
    curve = Curve(counted.edges, counted.density)
    low, high = _limits({"": curve}, counted.scale)
    x = (np.geomspace if counted.scale == "log" else np.linspace)(low, high, _POINTS)
    if np.isfinite(counted.density).all() and np.isfinite(counted.edges).all():
        axes.stairs(curve.density, curve.edges, color="#BBBBBB", fill=True, label="samples")
    else:
        axes.annotate("no positive samples", (0.5, 0.5), xycoords="axes fraction", ha="center")
    for i, (name, density) in enumerate(fitted.items()):
        y = _evaluated(density, x, counted.scale)
        if np.isfinite(y).any():
            axes.plot(
                x, y, color=_LINES[i % len(_LINES)], linestyle=_DASHES[i % len(_DASHES)], label=name
            )
    if counted.scale == "log":
        axes.set_xscale("log")
    # A density may be infinite at 0: the histogram sets the height.
    top = 1.35 * float(np.nanmax(counted.density, initial=0))
    axes.set(xlim=(low, high), ylim=(0, top or 1.0), yticks=[])


def _evaluated(density: Density, x: Array, scale: Scale) -> Array:
    """Return a density per unit of radiance, or per decade, where there is radiance."""
    y = np.full(x.shape, np.nan)
    with np.errstate(all="ignore"):
        y[x > 0] = density(x[x > 0])
    return np.asarray(y * x * np.log(10) if scale == "log" else y)


def _pair(linear: Axes, log: Axes, panel: Panel, *, number: int) -> None:
    color = qualitative(number)[number - 1]
    chd_axes(linear, panel.linear, scale="linear")
    chd_axes(log, panel.log, scale="log")
    for axes in (linear, log):
        axes.spines["bottom"].set(color=color, linewidth=2.2)
        _mean_ticks(axes, panel.mean)
    linear.set_title(
        f"{number} {verbatim(panel.name)}", loc="left", fontsize=8, fontweight="bold", pad=3
    )
    log.set_title(panel.note, loc="right", fontsize=7, pad=3, color="#444444")


def _mean_ticks(axes: Axes, means: Mapping[str, float]) -> None:
    for channel, mean in means.items():
        if np.isfinite(mean) and mean > 0:
            color = CHANNELS.get(channel, "black")
            axes.axvline(mean, 0, 0.92, color=color, linewidth=0.8, linestyle=(0, (3, 2)))
