"""CHDs of pixels: histograms of radiance, linear and logarithmic, with luminance and fits.

A `Panel` is the CHD of one pixel. `chd_pair` draws one, `chd_grid` several: pixels of an image, or
the same pixels of several renderings side by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from chdstat._core.arrays import is_bad, is_null, luminance, take_rows
from chdstat.errors import InputError
from chdstat.summary.histograms import Histogram, histogram
from chdstat.viz.histograms import Density, by_channel, chd_axes, colors_of, draw_histograms
from chdstat.viz.styling import PALETTE, UNIT, grid, page, per_cent, qualitative, style, verbatim

__all__ = ["Panel", "chd_grid", "chd_pair"]

_LUMINANCE = "#333333"


@dataclass(frozen=True)
class Panel:
    """The CHD of one pixel.

    Parameters
    ----------
    name
        Title.
    linear, log
        What `chdstat.histogram` returns for the pixel on either scale, of shape (channel, bin).
    channels
        Names of the channels; None for R, G and B, or for numbers where there are not three.
    fits
        Density of the positive part of each channel, as for `chd_axes`.
    mean
        Mean radiance of each channel, drawn as a dashed line.
    note
        A line of text in the log panel, such as the share of nulls and the fitted family.
    luminance
        Log histograms of the luminance of the pixel and, after it, of others of its region, of
        shape (pixel, bin), drawn beside the radiance; None for none. See `with_luminance`.
    """

    name: str
    linear: Histogram
    log: Histogram
    channels: Sequence[str] | None = None
    fits: Sequence[Density | None] = ()
    mean: Sequence[float] = ()
    note: str = ""
    luminance: Histogram | None = None

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
        """Return the CHD of a pixel given by its samples.

        Parameters
        ----------
        name, channels, fits
            As above.
        x
            Linear radiance, shape (channel, sample); a sample with a bad channel is left out.
        note
            As above; None for the share of nulls.

        Examples
        --------
        >>> Panel.of("wall", [[0, 1, 2, 3], [0, 2, 4, 6]]).note
        '25 % nulls'
        """
        samples = np.asarray(x)
        null, bad = is_null(samples), np.asarray(is_bad(samples).any(axis=0))
        linear = histogram(samples, scale="linear", null=null, bad=bad)
        log = histogram(samples, scale="log", null=null, bad=bad)
        mean = samples[:, ~bad].astype(np.float64).mean(axis=-1).tolist() if not bad.all() else ()
        note = f"{per_cent(null.mean())} nulls" if note is None else note
        return cls(name, linear, log, channels, fits, mean, note)

    def with_luminance(self, x: npt.ArrayLike) -> Self:
        """Return the panel with luminance beside the radiance.

        Parameters
        ----------
        x
            Linear radiance, shape (pixel, channel, sample): of the pixel and, after it, of others
            of its region; a sample with a bad channel is left out.

        Raises
        ------
        InputError
            If there are not three axes, or neither 1 nor 3 channels.

        Examples
        --------
        >>> x = np.random.default_rng(0).gamma(1.0, size=(5, 3, 64))
        >>> Panel.of("wall", x[0]).with_luminance(x).luminance.counts.shape
        (5, 100)
        """
        samples = np.asarray(x, np.float64)
        if samples.ndim != 3:
            message = f"expected samples of shape (pixel, channel, sample), got {samples.shape}"
            raise InputError(message)
        bad, null = np.asarray(is_bad(samples).any(axis=1)), is_null(samples)
        light = np.asarray(luminance(np.where(bad[:, np.newaxis], 0.0, samples)))
        return replace(self, luminance=histogram(light, scale="log", null=null, bad=bad))


@style()
def chd_grid(
    panels: Sequence[Panel] | Mapping[str, Sequence[Panel]],
    *,
    columns: int | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Draw linear and log10 CHDs of several pixels, each framed in the colour of its region.

    A panel that has luminance is followed by it: the pixel in black, others of its region as lines.

    Parameters
    ----------
    panels
        In the order of the marks in the image, so that colours agree. By the names of several
        renderings of one view, such as its day and its night, the same pixels of each: these stand
        side by side, without the linear histograms, and a row has one axis of radiance.
    columns
        Pixels side by side; each takes two panels, three with luminance. None takes two pixels,
        and as many as there are renderings.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no panel, or renderings have different numbers of them.

    Examples
    --------
    >>> x = np.random.default_rng(0).gamma(1.0, size=(2, 4, 3, 64))  # rendering, pixel
    >>> panels = [[Panel.of("wall", one[0]).with_luminance(one)] for one in x]
    >>> len(chd_grid({"day": panels[0], "night": panels[1]}).axes)
    4
    """
    named = panels if isinstance(panels, Mapping) else {"": panels}
    renderings = list(named.values())
    numbers = {name: len(those) for name, those in named.items()}
    if len(set(numbers.values())) > 1:
        message = f"expected the same pixels of each rendering, got numbers of panels {numbers}"
        raise InputError(message)
    several = len(renderings) > 1
    columns = len(renderings) if several else columns or 2
    # Pixel by pixel, and of each all renderings.
    shown = [(i, name, those[i]) for i in range(max(numbers.values(), default=0))
             for name, those in named.items()]  # fmt: skip
    each = (1 if several else 2) + any(panel.luminance is not None for _, _, panel in shown)
    figure = page(fig, 1.27 * -(-len(shown) // columns) + 0.3, wspace=0.02, hspace=0.04)
    axes = grid(figure, each * len(shown), each * columns)
    colors = qualitative(len(renderings[0]))
    for k, (i, name, panel) in enumerate(shown):
        own = axes[each * k : each * (k + 1)]
        title = f"{i + 1} {panel.name}" + (f", {name}" if name else "")
        below = k + columns >= len(shown)
        _draw_pixel(
            own, panel, title, below=below, leftmost=k % columns == 0, linear=not several,
            color=colors[i],
        )  # fmt: skip
        for ax in own:
            ax.spines["bottom"].set(color=colors[i], linewidth=2.2)
    if several:
        for row in range(0, len(axes), each * columns):
            _share_radiance(axes[row : row + each * columns])
    _name_channels(figure, axes[0], shown[0][2])
    return figure


@style()
def chd_pair(panel: Panel, *, fig: Figure | None = None) -> Figure:
    """Draw the linear and the log10 CHD of one pixel side by side, with fits and means.

    Parameters
    ----------
    panel
        The pixel; if it has luminance, that stands beside them.
    fig
        Where to draw; None makes a figure.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=(3, 500))
    >>> len(chd_pair(Panel.of("wall", x)).axes)
    2
    """
    figure = page(fig, 2.2)
    number = 2 + (panel.luminance is not None)
    axes = grid(figure, number, number)
    _draw_pixel(axes, panel, panel.name, below=True)
    _name_channels(figure, axes[0], panel)
    return figure


def _draw_pixel(
    axes: Sequence[Axes],
    panel: Panel,
    title: str,
    *,
    below: bool,
    leftmost: bool = True,
    linear: bool = True,
    color: str = PALETTE[4],
) -> None:
    """Draw a pixel into its axes, which are named if nothing stands below them."""
    scales = [panel.linear, panel.log] if linear else [panel.log]
    for ax, counted in zip(axes, scales, strict=False):
        chd_axes(counted, channels=panel.channels, fits=panel.fits, ax=ax)
        for mean, shade in zip(panel.mean, colors_of(panel.channels or "RGB"), strict=False):
            if np.isfinite(mean) and mean > 0:
                ax.axvline(mean, 0, 0.92, color=shade, linewidth=0.8, linestyle=(0, (3, 2)))
        narrow = len(axes) > 2
        log = "radiance, log scale" if narrow else f"radiance ({UNIT}), log scale"
        name = f"radiance ({UNIT})" if counted.scale == "linear" else log
        ax.set_xlabel(name if below else "")
    if panel.luminance is not None:
        _draw_luminance(axes[-1], panel.luminance, color)
        axes[-1].set_xlabel("luminance, log scale" if below else "")
        _share_radiance(axes[-2:])
    elif len(axes) > len(scales):
        axes[-1].set_axis_off()
    axes[0].set_title(verbatim(title), loc="left", fontweight="bold", pad=3)
    axes[-1].set_title(panel.note, loc="right", pad=3, color="#444444")
    axes[0].set_ylabel("density" if leftmost else "")


def _draw_luminance(ax: Axes, found: Histogram, color: str) -> None:
    """Draw the luminance of a pixel, and over it that of others of its region as lines."""
    first, *others = (take_rows(found, i, axis=0) for i in range(len(found.counts)))
    draw_histograms(ax, {"": first}, colors=[_LUMINANCE])
    for other in others:
        ax.stairs(other.density, other.edges, color=color, linewidth=0.7, zorder=0.9)
    ax.set_ylim(0, 1.05 * float(np.nanmax(found.density, initial=0)) or 1.0)
    ax.spines["left"].set_visible(True)


def _share_radiance(axes: Sequence[Axes]) -> None:
    """Give axes with samples one range of radiance."""
    ends = [ax.get_xlim() for ax in axes if ax.patches]
    if ends:
        lows, highs = zip(*ends, strict=True)
        for ax in axes:
            ax.set_xlim(min(lows), max(highs))


def _name_channels(figure: Figure, ax: Axes, panel: Panel) -> None:
    """Name the colours: in the axes where these are of radiance alone, else above all."""
    names = list(by_channel(panel.log, panel.channels))
    handles = [
        Line2D([], [], color=color, label=verbatim(name))
        for name, color in zip(names, colors_of(names), strict=True)
    ]
    if panel.luminance is None:
        ax.legend(handles=handles, loc="upper right", handlelength=1, borderaxespad=0)
        return
    handles.append(Line2D([], [], color=_LUMINANCE, label="luminance"))
    if len(panel.luminance.counts) > 1:
        others = "in the colour of the region: its other pixels"
        handles.append(Line2D([], [], linestyle="", label=others))
    figure.legend(handles=handles, loc="outside upper center", ncols=5, handlelength=1)
