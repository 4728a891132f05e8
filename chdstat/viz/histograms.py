"""Histograms of samples: of the channels of a pixel, under several fits, and of batches.

`chd_axes` draws one linear or log10 histogram per channel, `fits` several fits of one channel.
`batch_histograms` follows the first figure of Elek et al. 2019: many batches of samples
superimposed, and below them the histogram of their means.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from chdstat._core.arrays import Array, take_rows
from chdstat.errors import InputError
from chdstat.summary.histograms import Histogram
from chdstat.viz.styling import (
    CHANNELS,
    PALETTE,
    UNIT,
    WIDTH,
    axes_in,
    grid,
    page,
    qualitative,
    style,
    verbatim,
)

__all__ = [
    "Density",
    "batch_histograms",
    "by_channel",
    "chd_axes",
    "colors_of",
    "draw_histograms",
    "fits",
]

Density = Callable[[Array], Array]
"""Of the positive samples, per unit of radiance."""

_CURVE_POINTS = 400
_LINES = (PALETTE[4], PALETTE[5], PALETTE[2], PALETTE[3], PALETTE[0], "black")
_DASHES = ("-", "--", "-.", (0, (4, 1, 1, 1, 1, 1)), ":", (0, (1, 1)))
_ROOM = 1.35
"""Height of a panel with fits over that of its histogram: a density may be infinite at 0."""
_BINS = 40


@style()
def chd_axes(
    found: Histogram,
    *,
    channels: Sequence[str] | None = None,
    fits: Sequence[Density | None] = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw the histograms of all channels of a pixel over each other.

    Parameters
    ----------
    found
        What `chdstat.histogram` returns for one pixel, of shape (channel, bin) or (bin,). A log
        histogram has a log axis of radiance.
    channels
        Their names; those called R, G and B, as three channels are by default, have these colours.
    fits
        For each channel the density of its positive samples per unit of radiance, such as
        ``fit.pdf`` of a `chdstat.fit.Fit` of the channel; None draws none.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If the histogram is not one of a single pixel, or has another number of channels.

    Examples
    --------
    >>> import chdstat as chd
    >>> samples = np.random.default_rng(0).gamma(1.0, size=(3, 256))
    >>> ax = chd_axes(chd.histogram(samples, scale="log"))
    >>> ax.get_xscale()
    'log'
    """
    rows = by_channel(found, channels)
    colors = colors_of(rows)
    spine = ax is not None and ax.spines["left"].get_visible()  # those of one's own stay
    ax = axes_in(ax, 1.8)
    draw_histograms(ax, rows, colors=colors)
    ax.spines["left"].set_visible(spine)
    for counted, density, color in zip(rows.values(), fits, colors, strict=False):
        if density is not None:
            _draw_fit(ax, counted, density, color=color, linewidth=1.3)
    return ax


def by_channel(found: Histogram, channels: Sequence[str] | None = None) -> dict[str, Histogram]:
    """Return the histogram of each channel of one pixel, by the name of the channel.

    Raises
    ------
    InputError
        If the histogram is not one of a single pixel, or there are not as many names.
    """
    shape = found.counts.shape
    count = 1 if len(shape) == 1 else shape[0]
    names = channels or ("RGB" if count == 3 else [f"channel{i}" for i in range(count)])
    if len(shape) > 2 or len(names) != count:
        message = (
            f"expected the histogram of one pixel, of shape (channel, bin), and {len(names)} "
            f"channels, got one of shape {shape}"
        )
        raise InputError(message)
    if len(shape) == 1:
        return {names[0]: found}
    return {name: take_rows(found, i, axis=0) for i, name in enumerate(names)}


def draw_histograms(
    ax: Axes,
    found: Mapping[str, Histogram],
    *,
    colors: Sequence[Any],
    outlines: Sequence[Any] | None = None,
    dashes: Sequence[Any] = ("-",),
) -> tuple[float, float]:
    """Draw histograms of one scale over each other, over the radiance that holds samples.

    Parameters
    ----------
    ax
        Where to draw.
    found
        Histograms of shape (bin,), by their names in the legend.
    colors, outlines
        Colours of their areas and, where these are not the same, of their outlines.
    dashes
        Line styles of their outlines, in turn.

    Returns
    -------
    tuple of float
        Ends of the bins that hold samples. The axis goes on to a whole decade, or to 0.
    """
    scale = next(iter(found.values())).scale
    ends: list[float] = []
    for i, (name, counted) in enumerate(found.items()):
        density, edges = counted.density, counted.edges
        filled = np.flatnonzero(np.nan_to_num(density) > 0)
        if not filled.size:
            continue
        ends += [edges[filled[0]], edges[filled[-1] + 1]]
        ax.stairs(density, edges, fill=True, color=colors[i], alpha=0.22)
        look = {"color": (outlines or colors)[i], "linestyle": dashes[i % len(dashes)]}
        ax.stairs(density, edges, linewidth=0.7, label=verbatim(name), **look)
    if not ends:
        where = (0.5, 0.5)
        ax.annotate("no positive samples", where, xycoords="axes fraction", ha="center")
    ax.set_xscale(scale)
    if scale == "log":
        low, high = min(ends, default=1e-5), max(ends, default=1e5)
        ax.set_xlim(10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high)))
    else:
        low, high = min(ends, default=0.0), max(ends, default=1.0)
        ax.set_xlim(min(0.0, low), high)
    ax.set_ylim(bottom=0)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    return low, high


def _draw_fit(ax: Axes, counted: Histogram, density: Density, **look: Any) -> None:
    """Draw a density over a histogram, per unit of radiance or per decade as its bins are."""
    space = np.geomspace if counted.scale == "log" else np.linspace
    x = space(*ax.get_xlim(), _CURVE_POINTS)
    y = np.full(x.shape, np.nan)
    with np.errstate(all="ignore"):
        y[x > 0] = density(x[x > 0])
    y = y * x * np.log(10) if counted.scale == "log" else y
    if not np.isfinite(y).any():
        return
    top = max(ax.get_ylim()[1], _ROOM * float(np.nanmax(counted.density, initial=0)))
    ax.plot(x, y, **look)
    ax.set_ylim(0, top)


def colors_of(channels: Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Return the colours of channels by their names."""
    return [CHANNELS.get(name, PALETTE[i % len(PALETTE)]) for i, name in enumerate(channels)]


@style()
def fits(
    linear: Histogram,
    log: Histogram,
    fitted: Mapping[str, Density],
    *,
    title: str = "",
    fig: Figure | None = None,
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
    fig
        Where to draw; None makes a figure.

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
    figure = page(fig, 2.2)
    axes = grid(figure, 2, 2)
    for ax, counted in zip(axes, (linear, log), strict=True):
        draw_histograms(ax, by_channel(counted, ["samples"]), colors=["#AAAAAA"])
        for i, (name, density) in enumerate(fitted.items()):
            look = {"color": _LINES[i % len(_LINES)], "linestyle": _DASHES[i % len(_DASHES)]}
            _draw_fit(ax, counted, density, label=name, **look)
    axes[0].set_xlabel(f"radiance ({UNIT})")
    axes[0].set_ylabel("density per unit of radiance")
    axes[1].set_xlabel(f"radiance ({UNIT}), log scale")
    axes[1].set_ylabel("density per decade")
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(loc="upper right")
    axes[0].set_title(title, loc="left")
    return figure


@style()
def batch_histograms(batches: Mapping[str, npt.ArrayLike], *, fig: Figure | None = None) -> Figure:
    """Draw superimposed histograms of batches and, below, the histogram of their means.

    The axis of the batches ends where 1 % of the samples are brighter: a firefly must not squeeze
    all others into the first bin.

    Parameters
    ----------
    batches
        Samples by the name of their pixel, radiance of shape (batch, sample), as many of each. A
        dashed line is their mean.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no pixel.

    Examples
    --------
    >>> x = np.random.default_rng(0).gamma(0.5, size=(64, 32))
    >>> len(batch_histograms({"wall": x}).axes)
    2
    """
    count = len(batches)
    figure = page(fig, 2.1, WIDTH * min(1.0, 0.26 * count))
    axes = grid(figure, 2 * count, max(1, count))
    for i, (name, samples) in enumerate(batches.items()):
        x, color = np.asarray(samples, dtype=np.float64), qualitative(count)[i]
        means, expected = x.mean(axis=1), float(x.mean())
        top = float(np.quantile(x, 0.99)) or float(x.max()) or 1.0
        edges = np.linspace(0, max(top, 1.5 * expected), _BINS + 1)
        counts = np.stack([np.histogram(row, edges)[0] for row in x])
        # The outlines of all batches, shape (batch, corner, 2), are drawn as one.
        y = np.pad(np.repeat(counts, 2, axis=1), ((0, 0), (1, 1)))
        outlines = np.stack([np.broadcast_to(np.repeat(edges, 2), y.shape), y], axis=-1)
        upper, lower = axes[i], axes[count + i]
        alpha = min(0.5, max(0.03, 2.5 / len(x)))
        upper.add_collection(PolyCollection([*outlines], facecolor=color, lw=0, alpha=alpha))
        upper.stairs(counts.mean(axis=0), edges, color="#222222", linewidth=0.6)
        upper.set_ylim(0, 1.15 * float(np.max(counts[:, 1:])) or 1.0)
        upper.set_title(verbatim(name))
        lower.hist(means, bins=_BINS // 2, color=color)
        for ax in (upper, lower):
            ax.axvline(expected, color="black", linewidth=0.9, linestyle="--")
            ax.set(yticks=[], xlim=(min(0.0, float(means.min())), None))
            ax.locator_params(axis="x", nbins=3)
            ax.spines["left"].set_visible(False)
    axes[0].set_ylabel(f"{len(x)} batches\nof {x.shape[1]} samples")
    axes[count].set_ylabel(f"their {len(x)}\nmeans")
    figure.supxlabel(f"radiance in {UNIT}")
    return figure
