"""CHDs: linear and logarithmic histograms of radiance, with luminance, fits and means.

`chd_axes` draws the channels of a pixel, `fits` several fits of one channel. A `Panel` is the CHD
of one pixel. `chd_pair` draws one panel. `chd_grid` draws several: pixels of an image, or the same
pixels of several renderings side by side. `batch_histograms` follows the first figure of Elek et
al. 2019: superimposed histograms of many batches, and below them the histogram of their means.

Without samples, `fit_curve` draws the density of fits and mixtures, `tail_curve` how a tail falls,
`mode_stems` where modes are: a curve for each of a few pixels or channels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, get_args

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from chdstat._core.arrays import Array, take_rows
from chdstat._core.display import Width, channel_names, number, percent
from chdstat.errors import InputError, check_option
from chdstat.fit import Fit, Mixture, Tail
from chdstat.fit.curves import Curve
from chdstat.inference.modes import Modality
from chdstat.patterns.pixel import Pixel
from chdstat.summary.histograms import (
    Histogram,
    Scale,
    histogram,
    shared_ranges,
    shown_range,
)
from chdstat.viz.styling import (
    CHANNELS,
    NAMES,
    PALETTE,
    UNIT,
    axes_in,
    called,
    fitting,
    grid,
    inches,
    name_ticks,
    narrow,
    page,
    panels_in,
    per_cent,
    plain_log,
    qualitative,
    style,
    swatches,
    verbatim,
    within,
)

Density = Callable[[Array], Array] | Curve
"""Density of the positive samples, per unit of radiance, or what `Pixel.curve` returns."""

Channels = str | Sequence[str] | None
"""Channels to draw: names, "red", "green", "blue" or "luminance"; None for all but luminance."""

SCALES: tuple[Scale, ...] = get_args(Scale)
"""Scales of radiance: "linear" and "log"."""

_CURVE_POINTS = 400
_LINES = (PALETTE[4], PALETTE[5], PALETTE[2], PALETTE[3], PALETTE[0], "black")
DASHES = ("-", "--", "-.", (0, (4, 1, 1, 1, 1, 1)), ":", (0, (1, 1)))
"""Colours and line styles of curves, in turn."""
MEAN: Any = (0, (3, 2))
"""Dashes of the line of a mean."""
_ROOM = 1.35
"""Height of a panel with fits relative to its histogram: a density may be infinite at 0."""
_MARGIN = 0.02
"""Room at either end of an axis of radiance, relative to its length."""
_LINE = 0.14
"""Height of a line of a legend in inches."""
_BINS = 40
_VECTOR = 256
"""Most batches that are drawn as outlines; more are drawn as an image inside the figure."""
_LUMINANCE = "luminance"
_COLORS = {**CHANNELS, _LUMINANCE: "#333333"}
_WORDS = {"red": "R", "green": "G", "blue": "B"}
_LETTERS = 13
"""Letters of a title per inch."""


@style()
def chd_axes(
    found: Histogram,
    *,
    names: Sequence[str] | None = None,
    channels: Channels = None,
    fits: Sequence[Density | None] = (),
    limits: tuple[float, float] | None = None,
    outside: bool = True,
    width: Width = "column",
    ax: Axes | None = None,
) -> Axes:
    """Draw the histograms of the channels of a pixel over each other.

    Parameters
    ----------
    found
        What `chdstat.histogram` returns for one pixel, of shape (channel, bin) or (bin,). A log
        histogram has a log axis of radiance.
    names
        Names of its channels; channels called R, G and B, as three channels are by default, have
        these colours.
    channels
        Names of the channels to draw; "red", "green" and "blue" are R, G and B. None draws all.
    fits
        For each channel of the histogram, a density of its positive samples per unit of radiance,
        such as ``fit.pdf`` of a `chdstat.fit.Fit`; None draws none.
    limits
        Radiance at both ends of the axis; None for the range that holds 99.5 % of the samples.
    outside
        Whether to say how many samples the axis leaves out.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If the histogram is not of a single pixel, has another number of channels, or lacks a
        channel to draw.

    Examples
    --------
    >>> import chdstat as chd
    >>> samples = np.random.default_rng(0).gamma(1.0, size=(3, 256))
    >>> ax = chd_axes(chd.histogram(samples, scale="log"))
    >>> ax.get_xscale()
    'log'
    """
    rows = by_channel(found, names)
    fitted = dict(zip(rows, fits, strict=False))
    colors = dict(zip(rows, colors_of(rows), strict=True))
    shown = {name: rows[name] for name in chosen([*rows], channels)}
    alone = ax is None
    spine = ax is not None and ax.spines["left"].get_visible()  # the user's own spines stay
    ax = axes_in(ax, 1.8, width)
    look: dict[str, Any] = {"limits": limits, "outside": outside}
    draw_histograms(ax, shown, colors=[colors[name] for name in shown], **look)
    ax.spines["left"].set_visible(spine)
    if alone:
        ax.set_xlabel(_axis_name(_quantity([*shown]), found.scale))
        ax.set_ylabel("density")
        if len(shown) > 1 and ax.patches:
            ax.legend(handlelength=1)
    for name, counted in shown.items():
        if (density := fitted.get(name)) is not None:
            draw_fit(ax, counted, density, color=colors[name], linewidth=1.3)
    return ax


def chosen(names: Sequence[str], channels: Channels) -> list[str]:
    """Return the names of the channels to draw.

    Raises
    ------
    InputError
        If one of the channels is missing.

    Examples
    --------
    >>> chosen(["R", "G", "B", "luminance"], None), chosen(["R", "G", "B"], ["blue", "G"])
    (['R', 'G', 'B'], ['B', 'G'])
    """
    if channels is None:
        return [name for name in names if name != _LUMINANCE] or [*names]
    known = {word: name for word, name in _WORDS.items() if name in names}
    known |= {name: name for name in names}
    wanted = [channels] if isinstance(channels, str) else channels
    for name in wanted:
        check_option("channel", name, known)
    return [known[name] for name in wanted]


def one_of(names: Sequence[str], channels: Channels) -> str:
    """Return the name of the one channel to draw.

    Raises
    ------
    InputError
        If it is missing, or there are several.

    Examples
    --------
    >>> one_of(["R", "G", "B", "luminance"], "green")
    'G'
    """
    found = chosen(names, channels)
    if len(found) != 1:
        message = f"expected one channel, such as {names[0]!r}, got {channels!r}"
        raise InputError(message)
    return found[0]


def scales_of(scales: Scale | Sequence[Scale]) -> list[Scale]:
    """Return the scales to draw."""
    wanted: Sequence[Scale] = [scales] if isinstance(scales, str) else scales
    for scale in wanted:
        check_option("scale", scale, SCALES)
    if not wanted:
        message = "expected at least one scale, 'linear' or 'log', got none"
        raise InputError(message)
    return [*wanted]


def by_channel(found: Histogram, channels: Sequence[str] | None = None) -> dict[str, Histogram]:
    """Return the histogram of each channel of one pixel, by the name of the channel.

    Raises
    ------
    InputError
        If the histogram is not of a single pixel, or the number of names is wrong.
    """
    shape = found.counts.shape
    count = 1 if len(shape) == 1 else shape[0]
    names = channels or channel_names(count)
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
    opacity: float = 0.22,
    limits: tuple[float, float] | None = None,
    outside: bool = True,
) -> None:
    """Draw histograms of one scale over each other, and say how many samples the axis leaves out.

    Parameters
    ----------
    ax
        Where to draw.
    found
        Histograms of shape (bin,), by name in the legend.
    colors, outlines
        Colours of the areas, and of the outlines if they differ.
    dashes
        Line styles of the outlines, in turn.
    opacity
        Opacity of the areas.
    limits
        Radiance at both ends of the axis; None for `shown_range`. A linear axis begins at 0 or
        below; a log axis has a decade or more.
    outside
        Whether to say what the axis leaves out.
    """
    those = [*found.values()]
    scale, known = those[0].scale, limits or shown_range(those)
    for i, (name, counted) in enumerate(found.items()):
        density, edges = counted.density, counted.edges
        if not counted.counts.any():
            continue
        ax.stairs(density, edges, fill=True, color=colors[i], alpha=opacity)
        look = {"color": (outlines or colors)[i], "linestyle": dashes[i % len(dashes)]}
        ax.stairs(density, edges, linewidth=0.7, label=verbatim(name), **look)
    if not any(counted.counts.any() for counted in those):
        beyond = any((h.underflow + h.overflow).any() for h in those)
        words = "no samples in the bins" if beyond else "no positive samples"
        ax.annotate(words, (0.5, 0.5), xycoords="axes fraction", ha="center", va="center")
    ax.set_xscale(scale)
    if scale == "log":
        low, high = known or (1e-5, 1e5)
        room = max((high / low) ** _MARGIN, (10 * low / high) ** 0.5)
        ax.set_xlim(low / room, high * room)
        ax.xaxis.set_minor_formatter(NullFormatter())
        if 20 * low < high < 200 * low:  # powers of ten alone would be one label or two
            plain_log(ax.xaxis, (1, 3))
    else:
        low, high = known or (0.0, 1.0)
        ax.set_xlim(min(0.0, low), high + _MARGIN * (high - min(0.0, low)))
    name_ticks(ax.xaxis)
    ax.set_ylim(bottom=0)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    if known and outside:
        _tell_outside(ax, those)


def _tell_outside(ax: Axes, found: Sequence[Histogram]) -> None:
    """Write at both ends of the axis how many samples lie beyond: of the row with the most."""
    look: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6.5, "color": "#555555"}
    look |= {"xycoords": "axes fraction", "va": "top"}
    look["bbox"] = {"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.5}
    line = 0
    for side, words in enumerate(outside_in_words(found, *ax.get_xlim())):
        if words:  # below that of the other end, since there may be no room beside it
            ax.annotate(
                words, (side, 0.98), (3 - 6 * side, -8 * line), ha=("left", "right")[side], **look
            )
            line += 1


def outside_in_words(found: Sequence[Histogram], low: float, high: float) -> tuple[str, str]:
    """Return how many samples lie below and above a range of radiance; "" where none does.

    Of several rows, it is that with the most.

    Examples
    --------
    >>> import chdstat as chd
    >>> outside_in_words([chd.histogram([1e-12, 0.3, 0.4, 2.0])], 1e-5, 1.0)
    ('1 sample below 1e−5', '1 sample above 1.0')
    """
    words = []
    for side, (name, end) in enumerate((("below", low), ("above", high))):
        counts = {int(h.outside(low, high)[side]) for h in found}
        most = max(counts)
        up_to, many = "up to " * (len(counts) > 1), "s" * (most > 1)
        at = number(end, 2).replace("1.0e", "1e").replace("e−0", "e−")
        words.append(f"{up_to}{most} sample{many} {name} {at}" if most else "")
    return words[0], words[1]


def draw_fit(ax: Axes, counted: Histogram, density: Density, **look: Any) -> None:
    """Draw a density over a histogram, per unit of radiance or per decade like its bins."""
    space = np.geomspace if counted.scale == "log" else np.linspace
    x = space(*ax.get_xlim(), _CURVE_POINTS)
    y = np.full(x.shape, np.nan)
    with np.errstate(all="ignore"):
        if isinstance(density, Curve):
            y[x > 0] = density.density(x[x > 0], float(counted.bin_width), counted.scale)
        else:
            y[x > 0] = density(x[x > 0])
            y = y * x * np.log(10) if counted.scale == "log" else y
    if not np.isfinite(y).any():
        return
    # A density may be infinite at 0; what a histogram counts is finite.
    peak = float(np.nanmax(y if isinstance(density, Curve) else counted.density, initial=0))
    top = max(ax.get_ylim()[1], peak * (1 + _MARGIN if isinstance(density, Curve) else _ROOM))
    ax.plot(x, y, **look)
    ax.set_ylim(0, top)


def draw_means(
    ax: Axes, means: Sequence[float], colors: Sequence[Any], *, dashes: Any = MEAN
) -> None:
    """Draw dashed lines at positive means."""
    for mean, color in zip(means, colors, strict=False):
        if mean > 0:  # and no NaN
            ax.axvline(mean, 0, 0.92, color=color, linewidth=0.9, linestyle=dashes)


def colors_of(channels: Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Return the colours of channels."""
    return [_COLORS.get(name, PALETTE[i % len(PALETTE)]) for i, name in enumerate(channels)]


@dataclass(frozen=True)
class Panel:
    """The CHD of one pixel.

    Parameters
    ----------
    name
        Title.
    linear, log
        What `chdstat.histogram` returns for the pixel on each scale, of shape (channel, bin).
    channels
        Names of the channels; None for R, G and B, or for numbers if there are not three. A channel
        called "luminance" is only drawn on request.
    fits
        Density of the positive samples of each channel, as for `chd_axes`.
    mean
        Mean radiance of each channel, drawn as a dashed line.
    note
        A line of text in the log panel, such as the share of nulls and the fitted family.
    whole
        Whether axes show all bins and nothing else; otherwise they end where hardly any sample is,
        and say how many are beyond.
    """

    name: str
    linear: Histogram
    log: Histogram
    channels: Sequence[str] | None = None
    fits: Sequence[Density | None] = ()
    mean: Sequence[float] = ()
    note: str = ""
    whole: bool = False

    @classmethod
    def as_printed(
        cls, name: str, x: npt.ArrayLike, *, channels: Sequence[str] | None = None
    ) -> Self:
        """Return the CHD of a pixel with the bins that Elek et al. 2019 print, and all of them.

        They are 100: linear ones on the range of the first 50 samples, padded by a quarter at both
        ends; logarithmic ones from 1e-5 to 1e5. Nulls are in none.

        Parameters
        ----------
        name, channels
            As above.
        x
            Linear radiance, shape (channel, sample).

        Examples
        --------
        >>> panel = Panel.as_printed("wall", [[0, 1, 2, 3], [0, 2, 4, 6]])
        >>> panel.limits("linear"), panel.limits("log")
        ((0.5, 7.0), (1e-05, 100000.0))
        """
        samples = np.asarray(x)
        null = (samples == 0).all(axis=0)
        found = {
            scale: histogram(samples, scale=scale, null=np.broadcast_to(null, samples.shape))
            for scale in SCALES
        }
        names = channels or channel_names(len(samples))
        note, means = f"{per_cent(float(null.mean()))} nulls", np.nanmean(samples, axis=1).tolist()
        return cls(name, found["linear"], found["log"], names, (), means, note, whole=True)

    @classmethod
    def of(
        cls,
        name: str,
        x: npt.ArrayLike,
        *,
        channels: Sequence[str] | None = None,
        fits: Sequence[Density | None] = (),
        note: str | None = None,
    ) -> Panel:
        """Return the CHD of a pixel from its samples; three channels get their luminance, too.

        Parameters
        ----------
        name, channels, fits
            As above.
        x
            Linear radiance, shape (channel, sample); samples with a bad channel are left out.
        note
            As above; None for the share of nulls.

        Examples
        --------
        >>> Panel.of("wall", [[0, 1, 2, 3], [0, 2, 4, 6]]).note
        '25 % nulls'
        """
        samples = np.asarray(x)
        names = tuple(channels or channel_names(len(samples)))
        pixel = Pixel(0, 0, samples, names, "")
        note = f"{per_cent(pixel.null_share)} nulls" if note is None else note
        return cls.of_pixel(name, pixel, fits=fits, note=note)

    @classmethod
    def of_pixel(
        cls, name: str, pixel: Pixel, *, fits: Sequence[Density | None] = (), note: str = ""
    ) -> Panel:
        """Return the CHD of a pixel; parameters as above."""
        linear, log = pixel.histograms.values()
        mean = () if pixel.bad.all() else pixel.moments.mean.tolist()
        return cls(name, linear, log, pixel.names, fits, mean, note)

    def histograms(self, scale: Scale) -> dict[str, Histogram]:
        """Return the histogram of each channel on a scale, by the name of the channel."""
        return by_channel(self.linear if scale == "linear" else self.log, self.channels)

    @property
    def told(self) -> str:
        """The note, and what the curves are, or why there are none."""
        curves = [fit for fit in self.fits if isinstance(fit, Curve)]
        names = dict.fromkeys(curve.name or curve.reason for curve in curves)
        return ", ".join(filter(None, [self.note, " / ".join(names)]))

    def limits(self, scale: Scale) -> tuple[float, float] | None:
        """Return the range of radiance that holds its samples and means, or all bins."""
        if self.whole:
            found = self.linear if scale == "linear" else self.log
            known = np.isfinite(found.low)
            return (
                (float(found.low[known].min()), float(found.high[known].max()))
                if known.any()
                else None
            )
        return shown_range([*self.histograms(scale).values()], self.mean)

    def select(self, channels: Channels) -> Self:
        """Return the panel with some of its channels, as `chd_pair` takes them.

        Raises
        ------
        InputError
            If one of them is missing.

        Examples
        --------
        >>> Panel.of("wall", [[0, 1, 2], [0, 2, 4], [1, 1, 1]]).select("luminance").channels
        ['luminance']
        """
        names = [*self.histograms("log")]
        found = chosen(names, channels)
        rows = np.array([names.index(name) for name in found])
        fits, means = ([v[i] for i in rows if i < len(v)] for v in (self.fits, self.mean))
        linear, log = (
            h if h.counts.ndim == 1 else take_rows(h, rows, axis=0) for h in (self.linear, self.log)
        )
        return replace(self, linear=linear, log=log, channels=found, fits=fits, mean=means)


@style()
def chd_grid(
    panels: Sequence[Panel] | Mapping[str, Sequence[Panel]],
    *,
    columns: int | None = None,
    channels: Channels = None,
    scales: Scale | Sequence[Scale] = SCALES,
    colors: Sequence[str] | None = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw linear and log10 CHDs of several pixels, each framed in the colour of its region.

    Parameters
    ----------
    panels
        Panels in the order of the marks in the image, so that colours agree. Or a mapping from
        renderings of one view, such as day and night, to panels of the same pixels: a row then
        shows one pixel in all renderings, on one axis of radiance, without linear histograms.
    columns
        Pixels side by side; each takes a panel for each scale. None takes as many as fit, at most
        two; with several renderings, as many as there are renderings.
    channels, scales
        As for `chd_pair`.
    colors
        Colour of each pixel, as of its mark; None takes those of `chdstat.viz.PALETTE`.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no panel, renderings have different numbers of them, or an option is unknown.

    Examples
    --------
    >>> x = np.random.default_rng(0).gamma(1.0, size=(2, 4, 3, 64))  # rendering, pixel
    >>> panels = [[Panel.of("wall", one[0])] for one in x]
    >>> len(chd_grid({"day": panels[0], "night": panels[1]}).axes)
    2
    """
    named = panels if isinstance(panels, Mapping) else {"": panels}
    renderings = list(named.values())
    numbers = {name: len(those) for name, those in named.items()}
    if len(set(numbers.values())) > 1:
        message = f"expected the same pixels of each rendering, got numbers of panels {numbers}"
        raise InputError(message)
    several, across = len(renderings) > 1, inches(width, fig)
    columns = len(renderings) if several else columns or (1 if narrow(across) else 2)
    kinds: list[Scale] = ["log"] if several else scales_of(scales)
    # All renderings of a pixel, pixel by pixel.
    shown = [(i, name, those[i].select(channels)) for i in range(max(numbers.values(), default=0))
             for name, those in named.items()]  # fmt: skip
    each = len(kinds)
    height = 1.27 * -(-len(shown) // columns) + 0.3
    figure = page(fig, height, width, wspace=0.02, hspace=0.04)
    axes = grid(figure, each * len(shown), each * columns)
    colors = colors or qualitative(len(renderings[0]))
    ranges: list[tuple[float, float] | None] = [None] * len(shown)
    for row in range(0, len(shown), columns) if several else ():
        ranges[row : row + columns] = panel_ranges([p for *_, p in shown[row : row + columns]])
    for k, (i, name, panel) in enumerate(shown):
        own = axes[each * k : each * (k + 1)]
        title = f"{i + 1} {panel.name}" + (f", {name}" if name else "")
        below = k + columns >= len(shown)
        _draw_pixel(
            own, panel, title, kinds, below=below, leftmost=k % columns == 0,
            room=across / (each * columns), limits=ranges[k],
        )  # fmt: skip
        for ax in own:
            ax.spines["bottom"].set(color=colors[i], linewidth=2.2)
    names = [*shown[0][2].histograms("log")]
    _add_legend(figure, dict(zip(names, colors_of(names), strict=True)), columns=len(names))
    return figure


@style()
def chd_pair(
    panel: Panel,
    *,
    channels: Channels = None,
    scales: Scale | Sequence[Scale] = SCALES,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw the linear and the log10 CHD of one pixel side by side, with fits and means.

    Parameters
    ----------
    panel
        The pixel.
    channels
        Channels to draw: names, "red", "green", "blue" or "luminance"; None for all but luminance.
    scales
        "linear", "log" or both.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If a channel, a scale or the width is unknown.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=(3, 500))
    >>> len(chd_pair(Panel.of("wall", x)).axes)
    2
    >>> (ax,) = chd_pair(Panel.of("wall", x), channels="luminance", scales="log").axes
    >>> ax.get_xscale()
    'log'
    """
    kinds, across, panel = scales_of(scales), inches(width, fig), panel.select(channels)
    number = len(kinds)
    named = _named(panel)
    height = 1.7 if narrow(across) else 2.2
    figure, axes = panels_in(fig, number, number, height + _LINE * len(named), width)
    _draw_pixel(axes, panel, panel.name, kinds, below=True, room=across / number)
    _add_legend(figure, named, columns=1 if any(" " in words for words in named) else len(named))
    return figure


def _draw_pixel(
    axes: Sequence[Axes],
    panel: Panel,
    title: str,
    scales: Sequence[Scale],
    *,
    below: bool,
    room: float,
    leftmost: bool = True,
    limits: tuple[float, float] | None = None,
) -> None:
    """Draw a pixel into its axes; they get axis labels if no axes are below them."""
    names = [*panel.histograms("log")]
    for ax, scale in zip(axes, scales, strict=False):
        counted = panel.linear if scale == "linear" else panel.log
        look: dict[str, Any] = {"limits": limits or panel.limits(scale), "outside": not panel.whole}
        chd_axes(counted, names=names, channels=names, fits=panel.fits, ax=ax, **look)
        draw_means(ax, panel.mean, colors_of(names))
        ax.set_xlabel(_axis_name(_quantity(names), scale, room) if below else "")
    # Without room for both in a line, the title is above the note.
    pad = 13 if len(title) + len(panel.told) > _LETTERS * room * len(axes) else 3
    axes[0].set_title(verbatim(title), loc="left", fontweight="bold", pad=pad)
    axes[-1].set_title(panel.told, loc="right", pad=3, color="#444444")
    axes[0].set_ylabel("density" if leftmost else "")


def _quantity(names: Sequence[str]) -> str:
    return _LUMINANCE if [*names] == [_LUMINANCE] else "radiance"


def _axis_name(quantity: str, scale: Scale, room: float = math.inf) -> str:
    """Return the label of an axis of radiance or luminance, `room` inches wide."""
    if scale == "linear":
        return f"{quantity} ({UNIT})" if room > 1.4 else f"{quantity}\n({UNIT})"
    if room > 1.9:
        return f"{quantity} ({UNIT}), log scale"
    return f"{quantity}, log scale" if room > 1.3 else f"{quantity},\nlog scale"


def panel_ranges(panels: Sequence[Panel]) -> list[tuple[float, float] | None]:
    """Return the range of radiance of each of several panels that share a log axis."""
    found = [[*panel.histograms("log").values()] for panel in panels]
    return shared_ranges(found, [panel.mean for panel in panels])


def _named(panel: Panel) -> dict[str, str]:
    """Return the colours of channels by what a legend says of them and of their curves."""
    names = [*panel.histograms("log")]
    curves = dict(zip(names, panel.fits, strict=False))
    known = {n: c for n, c in curves.items() if isinstance(c, Curve)}
    if not any(curve.fit for curve in known.values()):
        return dict(zip(names, colors_of(names), strict=True)) if len(names) > 1 else {}
    return {
        (f"{name}: {known[name].words}" if names[1:] else known[name].words): color
        for name, color in zip(names, colors_of(names), strict=True)
        if name in known
    }


def _add_legend(figure: Figure, named: Mapping[str, str], *, columns: int) -> None:
    """Write below the panels what each colour is."""
    if [*named] not in ([], [_LUMINANCE]):  # the label of the axis says so
        handles = swatches(named, linewidth=1.3)
        look: dict[str, Any] = {"handlelength": 1.2, "labelspacing": 0.25, "borderaxespad": 0}
        figure.legend(handles=handles, loc="outside lower left", ncols=columns, fontsize=7, **look)


@style()
def fits(
    linear: Histogram,
    log: Histogram,
    fitted: Mapping[str, Density],
    *,
    title: str = "",
    scales: Scale | Sequence[Scale] = SCALES,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw several fits of one pixel over its linear and its log10 histogram.

    Parameters
    ----------
    linear, log
        Histograms of the same samples, for one pixel and channel.
    fitted
        Densities of the positive samples per unit of radiance, by name: ``pdf`` of a
        `chdstat.fit.Fit`, of a mixture, or of a SciPy distribution.
    title
        What is shown.
    scales
        "linear", "log" or both.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If a histogram is of several pixels or channels, or an option is unknown.

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
    kinds, across = scales_of(scales), inches(width, fig)
    figure, axes = panels_in(fig, len(kinds), len(kinds), 1.9 if narrow(across) else 2.2, width)
    for ax, scale in zip(axes, kinds, strict=True):
        counted = linear if scale == "linear" else log
        draw_histograms(ax, by_channel(counted, ["samples"]), colors=["#AAAAAA"])
        for i, (name, density) in enumerate(fitted.items()):
            look = {"color": _LINES[i % len(_LINES)], "linestyle": DASHES[i % len(DASHES)]}
            draw_fit(ax, counted, density, label=verbatim(NAMES.get(name, name)), **look)
        ax.set_xlabel(_axis_name("radiance", scale, across / len(kinds)))
        per = "unit of radiance" if scale == "linear" else "decade"
        ax.set_ylabel(f"density per {per}")
    if narrow(across):
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center")
    elif axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(loc="upper right", handlelength=1.6)
    axes[0].set_title(title, loc="left")
    return figure


@style()
def batch_histograms(
    batches: Mapping[str, npt.ArrayLike],
    *,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw superimposed histograms of batches and, below, the histogram of their means.

    The axis of the batches ends at the 99th percentile of the samples: otherwise a firefly would
    squeeze all others into the first bin.

    Parameters
    ----------
    batches
        Radiance of shape (batch, sample) by the name of the pixel, equally many for each. A dashed
        line is the mean.
    width
        Width of the figure: "column", "page" or inches; a figure of few pixels is narrower.
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
    count, across = len(batches), inches(width, fig)
    columns = fitting(across, count, 1.0)
    rows = -(-count // columns)
    figure = page(fig, 2.1 * rows, min(across, 1.74 * max(1, columns)))
    # Below each row of batches there is a row of their means.
    cells = np.array(grid(figure, 2 * rows * columns, columns)).reshape(rows, 2, columns)
    upper_row, lower_row = cells.swapaxes(0, 1).reshape(2, -1)
    for empty in (*upper_row[count:], *lower_row[count:]):
        empty.remove()
    for i, (name, samples) in enumerate(batches.items()):
        x, color = np.asarray(samples, dtype=np.float64), qualitative(count)[i]
        means, expected = x.mean(axis=1), float(x.mean())
        top = float(np.quantile(x, 0.99)) or float(x.max()) or 1.0
        edges = np.linspace(0, max(top, 1.5 * expected), _BINS + 1)
        row = np.repeat(np.arange(len(x)), x.shape[1])
        counts = np.histogram2d(row, x.ravel(), [np.arange(len(x) + 1), edges])[0]
        # The outlines of all batches, shape (batch, corner, 2), are drawn as one collection.
        y = np.pad(np.repeat(counts, 2, axis=1), ((0, 0), (1, 1)))
        outlines = np.stack([np.broadcast_to(np.repeat(edges, 2), y.shape), y], axis=-1)
        upper, lower = upper_row[i], lower_row[i]
        alpha = min(0.5, max(0.03, 2.5 / len(x)))
        look: dict[str, Any] = {
            "facecolor": color,
            "lw": 0,
            "alpha": alpha,
            "rasterized": len(x) > _VECTOR,
        }
        upper.add_collection(PolyCollection([*outlines], **look))
        upper.stairs(counts.mean(axis=0), edges, color="#222222", linewidth=0.6)
        upper.set_ylim(0, 1.15 * float(np.max(counts[:, 1:])) or 1.0)
        upper.set_title(within(name, across / columns - 0.15))
        lower.hist(means, bins=_BINS // 2, color=color)
        for ax in (upper, lower):
            ax.axvline(expected, color="black", linewidth=0.9, linestyle="--")
            ax.set(yticks=[], xlim=(min(0.0, float(means.min())), None))
            ax.locator_params(axis="x", nbins=3)
            ax.spines["left"].set_visible(False)
    for above, below in cells[:, :, 0]:
        above.set_ylabel(f"{len(x)} batches\nof {x.shape[1]} samples")
        below.set_ylabel(f"their {len(x)}\nmeans")
    figure.supxlabel(f"radiance in {UNIT}")
    return figure


# --- fits, tails and modes without samples --------------------------------------------------------


_HEIGHT = 1.7
_MOST = 6
"""Most rows of a result in one panel."""
_POINTS = 300
_SEEN = 1e-3
"""Share of a fit beyond each end of its curve, and of positive samples beyond the end of a tail."""


def _rows(count: int) -> list[dict[str, Any]]:
    """Return the style of each row's curve, with a label if there are several.

    Raises
    ------
    InputError
        If there are too many.
    """
    if count > _MOST:
        message = f"expected a result of at most {_MOST} rows to draw, got {count}; take some"
        raise InputError(message)
    return [
        {
            "color": _LINES[i],
            "linestyle": DASHES[i],
            "label": f"row {i}" if count > 1 else None,
        }
        for i in range(count)
    ]


def _finished(ax: Axes, looks: Sequence[Any]) -> Axes:
    """Name the rows, or write that nothing could be drawn."""
    if not ax.has_data():
        ax.annotate("not fitted", (0.5, 0.5), xycoords="axes fraction", ha="center")
        ax.set_axis_off()
    elif len(looks) > 1:
        ax.legend(handlelength=1.8)
    return ax


@style()
def fit_curve(found: Fit, *, width: Width = "column", ax: Axes | None = None) -> Axes:
    """Draw the density of a fit or a mixture per decade of radiance, and the share of zeros.

    The area below the curve is 1 minus the share of zeros. The components of a single mixture are
    dotted; atoms are stems with their share as height.

    Parameters
    ----------
    found
        A fit of one or a few rows.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If the fit has more than six rows.

    Examples
    --------
    >>> import chdstat as chd
    >>> x = np.random.default_rng(0).gamma(2.0, size=500)
    >>> fit_curve(chd.fit.gamma(x)).get_xlabel().startswith("radiance")
    True
    """
    zero = np.atleast_1d(found.zero_share).ravel()
    looks = _rows(zero.size)
    ax = axes_in(ax, _HEIGHT, width)
    share, rows = (1 - zero)[:, np.newaxis], np.arange(zero.size)
    inside = zero[:, np.newaxis] + share * np.array([_SEEN, 1 - _SEEN])
    ends = found.ppf(inside.ravel()).reshape(zero.size, zero.size, 2)[rows, rows]
    known = np.isfinite(ends).all(axis=1) & (ends > 0).all(axis=1)
    ax.set_xscale("log")
    if known.any():
        x = np.geomspace(ends[known].min(), ends[known].max(), _POINTS)
        scale = x * np.log(10)
        density = share * found.pdf(x).reshape(zero.size, -1) * scale
        for i in np.flatnonzero(known):
            ax.plot(x, density[i], **looks[i])
        if isinstance(found, Mixture) and zero.size == 1:
            _draw_parts(ax, found, x, scale * share[0])
        ax.set_ylim(bottom=0)
    note = f"{percent(float(zero[0]))} at 0" if zero.size == 1 and known.any() else ""
    ax.set_title(note, loc="right", color="#444444")
    ax.set(xlabel=f"radiance ({UNIT})", ylabel="density per decade", title=called(found.name))
    return _finished(ax, looks)


def _draw_parts(ax: Axes, found: Mixture, x: Array, scale: Array) -> None:
    """Draw the components and the atoms of a mixture of one row."""
    for part in found.component_pdf(x):
        ax.plot(x, part * scale, color="#777777", linewidth=0.8, linestyle=":")
    atoms, shares = (np.ravel(v) for v in (found.atoms, found.atom_weights))
    at = np.isfinite(atoms) & (atoms > 0)
    if at.any():
        other = ax.twinx()
        other.vlines(atoms[at], 0, shares[at], color="#444444", linewidth=1.4)
        other.set(ylim=(0, None), ylabel="share of atoms")


@style()
def tail_curve(found: Tail, *, width: Width = "column", ax: Axes | None = None) -> Axes:
    """Draw the share of the positive samples above each radiance of a tail, on log scales.

    A power law is a straight line. Thin lines are exponential tails with the same start.

    Parameters
    ----------
    found
        Tails of one or a few rows.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there are more than six rows.

    Examples
    --------
    >>> import chdstat as chd
    >>> x = np.random.default_rng(0).pareto(1.5, size=2000)
    >>> tail_curve(chd.fit.tail_index(x)).get_yscale()
    'log'
    """
    rows = (found.xi, found.scale, found.threshold, found.share)
    xis, scales, thresholds, shares = (np.atleast_1d(v).ravel() for v in rows)
    looks = _rows(xis.size)
    ax = axes_in(ax, _HEIGHT, width)
    ax.set(xscale="log", yscale="log")
    for xi, scale, start, share, look in zip(xis, scales, thresholds, shares, looks, strict=True):
        if not (np.isfinite(xi) and scale > 0 and start > 0):
            continue
        left = np.geomspace(1, _SEEN, _POINTS)  # share of the samples in the tail
        excess = -np.log(left) if abs(xi) < 1e-9 else (left**-xi - 1) / xi
        ax.plot(start + scale * excess, share * left, **look)
        faint: dict[str, Any] = {"color": look["color"], "linewidth": 0.6, "linestyle": ":"}
        ax.plot(start - scale * np.log(left), share * left, **faint)
    name_ticks(ax.xaxis)
    one = f"tail index {number(xis[0])}" if xis.size == 1 else "tails"
    ax.set(xlabel=f"radiance ({UNIT})", ylabel="share above it", title=one)
    return _finished(ax, looks)


@style()
def mode_stems(found: Modality, *, width: Width = "column", ax: Axes | None = None) -> Axes:
    """Draw a stem at each mode, with its share of the samples as height.

    Parameters
    ----------
    found
        Modes of one or a few rows.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there are more than six rows.

    Examples
    --------
    >>> import chdstat as chd
    >>> x = np.random.default_rng(0).lognormal(np.repeat([0, 5], 200))
    >>> len(mode_stems(chd.modality(x)).collections)
    1
    """
    places, weights = (v.reshape(-1, v.shape[-1]) for v in (found.places, found.weights))
    looks = _rows(len(places))
    ax = axes_in(ax, _HEIGHT, width)
    ax.set_xscale("log")
    for place, weight, look in zip(places, weights, looks, strict=True):
        at = np.isfinite(place)
        if at.any():
            ax.vlines(10 ** place[at], 0, weight[at], linewidth=1.6, **look)
            ax.plot(10 ** place[at], weight[at], "o", color=look["color"], markersize=3.5)
    if ax.has_data():
        low, high = ax.get_xlim()
        ax.set(xlim=(low / 3, 3 * high), ylim=(0, 1.05))
    modes = int(np.ravel(found.modes)[0]) if len(places) == 1 else 0
    title = f"{modes} mode{'s' * (modes != 1)}" if modes else "modes"
    ax.set(xlabel=f"radiance ({UNIT})", ylabel="share", title=title)
    return _finished(ax, looks)
