"""Maps: one value, label or colour per pixel, with its scale.

`map_grid` makes a grid for several maps. `atlas` draws the recurring distributions as a map and as
small multiples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import (
    BoundaryNorm,
    Colormap,
    ListedColormap,
    LogNorm,
    Normalize,
    to_hex,
)
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from chdstat._core.arrays import flag_names
from chdstat._core.display import Width, percent
from chdstat._core.image_scales import tonemap
from chdstat.errors import InputError
from chdstat.patterns import Atlas
from chdstat.patterns.pixel import Pixel
from chdstat.viz.chd import Channels, Panel, chd_pair, one_of
from chdstat.viz.image import one_channel
from chdstat.viz.styling import (
    MISSING,
    PALETTE,
    UNIT,
    axes_in,
    bar_ticks,
    bare,
    called,
    color_limits,
    color_map,
    fitting,
    grid,
    grow,
    inches,
    narrow,
    page,
    per_cent,
    qualitative,
    style,
    two_parts,
    upright,
    verbatim,
)

if TYPE_CHECKING:
    import xarray as xr

LABEL_COLORS = {
    "none": "#DDDDDD",
    "undetermined": "#DDDDDD",
    "black": "#222222",
    "constant": "#777777",
    "bimodal": "#CC79A7",
    "long tail": "#D55E00",
    "null-heavy": "#0072B2",
    "gamma-like": "#56B4E9",
    "log-normal-like": "#009E73",
    "multimodal": "#882255",
    "firefly-dominated": "#F0E442",
    "other": "#B5B5B5",
}

_MORE = "#D55E00"
"""Colour of more samples than were tested: vermillion of Okabe and Ito, not among `MAGNITUDES`."""
_VISIBLE = 0.01
"""Density, relative to the highest, at which panels end."""
_OF_MAP = 0.4
"""Share of the width that the map takes: the figure then fits below others on a page."""
_TWO_NAMES = 2.0
"""Width of a map, in inches, from which two names of labels fit side by side."""
_LINE, _LINES = 0.16, 3
"""Height of a line of a legend, in inches, and number of lines that fit."""
_HEIGHT = 2.4
"""Height of a figure with a single map, in inches."""


@style()
def map_grid(
    number: int,
    *,
    columns: int = 3,
    aspect: float = 1.0,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Make room for maps in a grid that fills the width of a column or a page.

    Parameters
    ----------
    number
        Number of maps.
    columns
        Maps in a row; fewer if they would be narrower than 1.6 inches.
    aspect
        Height of the image over its width.
    width
        Width of the figure: of a column or of a page.
    fig
        Where to draw; None makes a figure.

    Returns
    -------
    Figure
        Pass its ``axes`` to `value_map`, `categorical_map` and the other functions here.

    Raises
    ------
    InputError
        If there is no map.

    Examples
    --------
    >>> figure = map_grid(2, columns=2)
    >>> for ax, title in zip(figure.axes, ("mean", "variance"), strict=True):
    ...     _ = value_map(np.eye(4), title=title, ax=ax)
    """
    across = inches(width, fig)
    columns = fitting(across, columns, 1.6)
    rows = -(-number // columns)
    height = across / columns * (0.86 * upright(aspect, 1) + 0.2) * rows
    figure = page(fig, height, width, wspace=0.06)
    grid(figure, number, columns)
    return figure


@style()
def value_map(
    values: npt.ArrayLike,
    *,
    title: str = "",
    unit: str = "",
    limits: tuple[float, float] | None = None,
    diverging: bool = False,
    log: bool = False,
    cmap: str | Colormap | None = None,
    width: Width = "column",
    ax: Axes | None = None,
) -> Axes:
    """Draw one number per pixel.

    Parameters
    ----------
    values
        Shape (y, x); NaN is shown in grey.
    title, unit
        Title of the map, and unit for the colour bar.
    limits
        Ends of the colour scale; None takes the 1st and 99th percentile. Values beyond an end have
        its colour.
    diverging
        Use different colours below and above 0, or 1 if `log`, as far to both sides.
    log
        Let colours follow the logarithm; the colour bar says values. What is not above 0 is grey.
    cmap
        One of Matplotlib's colour maps, or its name; None for viridis, or PuOr if diverging.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no such colour map, or a limit of a logarithmic scale is not above 0.

    Examples
    --------
    >>> ax = value_map([[0.25, 1.0], [2.0, 4.0]], log=True, diverging=True)
    >>> [text.get_text() for text in ax.figure.axes[1].get_yticklabels()]
    ['1/4', '1/2', '1', '2', '4']
    """
    array = np.asarray(values, dtype=float)
    array = np.where(array > 0, array, np.nan) if log else array
    low, high = limits or color_limits(array, diverging=diverging, log=log)
    if log and not 0 < low < high:
        message = f"limits of a logarithmic scale must be above 0, the smaller first; got {limits}"
        raise InputError(message)
    if diverging:
        high = max(high, 1 / low) if log else max(abs(low), abs(high))
        low = 1 / high if log else -high
    ax = axes_in(ax, _HEIGHT, width)
    image = ax.imshow(
        array, cmap=color_map(cmap, diverging=diverging), interpolation="nearest",
        norm=LogNorm(low, high) if log else Normalize(low, high),
    )  # fmt: skip
    bare(ax, title)
    bar = ax.figure.colorbar(image, ax=ax, fraction=0.046, pad=0.03)
    bar.outline.set_visible(False)
    bar.set_label(unit, labelpad=2)
    if log:
        places, texts = zip(*bar_ticks(low, high, log=True), strict=True)
        bar.set_ticks(places, labels=texts)
        bar.minorticks_off()
    return ax


def names_of(variable: xr.DataArray | npt.ArrayLike) -> dict[int, str]:
    """Return the names of the values of an integer-coded variable, for text.

    Raises
    ------
    InputError
        If it has no attributes ``flag_values`` and ``flag_meanings``.
    """
    attrs = getattr(variable, "attrs", {})
    if not {"flag_values", "flag_meanings"} <= set(attrs):
        message = (
            "expected labels with the attributes flag_values and flag_meanings, as those of "
            f"chdstat.classify, got a {type(variable).__name__} without; pass names={{code: name}}"
        )
        raise InputError(message)
    return {code: called(name) for code, name in flag_names(attrs).items()}


@style()
def categorical_map(
    codes: npt.ArrayLike | xr.DataArray,
    names: Mapping[int, str] | None = None,
    *,
    title: str = "",
    colors: Sequence[str] | None = None,
    columns: int | None = None,
    shares: bool = True,
    width: Width = "column",
    ax: Axes | None = None,
) -> Axes:
    """Draw one label per pixel.

    Parameters
    ----------
    codes
        Integer labels, shape (y, x).
    names
        Name of each label; the legend shows those that occur. None takes the names from the
        attributes of `codes`, as those of ``label`` of `chdstat.classify`, with the colours of the
        report.
    title
        What is shown.
    colors
        A colour for each label, in the order of `names`; None takes `chdstat.viz.PALETTE`, then
        darker versions of it.
    columns
        Columns of the legend; None for 2, or 1 if the map is narrow.
    shares
        Write the share of pixels after each name.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there are no names, and `codes` has no attributes ``flag_values`` and ``flag_meanings``.
    """
    if names is None:
        names = names_of(codes)
        colors = colors or [
            LABEL_COLORS.get(name, PALETTE[i % 8]) for i, name in enumerate(names.values())
        ]
    array = np.asarray(codes)
    shades = qualitative(len(names)) if colors is None else colors
    ax = axes_in(ax, _HEIGHT, width)
    rank = np.full(array.shape, -1)
    patches = []
    for i, (code, name) in enumerate(names.items()):
        rank[array == code] = i
        if (array == code).any():
            share = f" {_percent(float((array == code).mean()))}" if shares else ""
            patches.append(Patch(color=shades[i], label=f"{verbatim(name)}{share}"))
    draw_labels(ax, rank, shades[: len(names)], title)
    if columns is None:
        columns = 2 if _room(ax) >= _TWO_NAMES else 1
        grow(ax.get_figure(), _LINE * (-(-len(patches) // columns) - _LINES))
    ax.legend(
        handles=patches, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=columns,
        handlelength=0.9, columnspacing=0.9, borderaxespad=0.2,
    )  # fmt: skip
    return ax


def _room(ax: Axes) -> float:
    """Return the width of axes, in inches, within the grid of their figure."""
    spec = ax.get_subplotspec()
    across = inches("page", ax.get_figure(root=False))
    return across / spec.get_gridspec().ncols if spec else across * ax.get_position().width


def draw_labels(
    ax: Axes, labels: npt.NDArray[np.integer[Any]], colors: Sequence[str], title: str
) -> None:
    """Draw the labels 0, 1, 2 and so on in their colours; negative labels are grey."""
    shades = ListedColormap(list(colors)).with_extremes(bad=MISSING)
    norm = BoundaryNorm(np.arange(len(colors) + 1) - 0.5, len(colors))
    shown = np.ma.masked_less(labels, 0)
    ax.imshow(shown, cmap=shades, norm=norm, interpolation="nearest")
    bare(ax, title)


def _percent(share: float) -> str:
    return per_cent(share) if share >= 0.01 or share == 0 else "< 1 %"


def n_needed(
    needed: npt.ArrayLike,
    sizes: npt.ArrayLike,
    *,
    title: str = "Samples per average needed",
    width: Width = "column",
    ax: Axes | None = None,
) -> Axes:
    """Draw the number of samples from which the averages of each pixel look Gaussian.

    Parameters
    ----------
    needed
        ``n_needed`` of `chdstat.inference.gaussianity_of_means`, shape (y, x): one of the sizes, -1
        for more than the largest, 0 if unknown.
    sizes
        The sizes that were tested, shape (size,).
    title
        What is shown.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.
    """
    tested = [int(n) for n in np.sort(np.asarray(sizes).ravel())]
    shades = [to_hex(shade) for shade in color_map()(np.linspace(0.05, 1, len(tested)))]
    names = {n: f"{n}:" for n in tested} | {-1: f"> {tested[-1]}:"}
    look: dict[str, Any] = {"colors": [*shades, _MORE], "columns": 3, "width": width}
    return categorical_map(needed, names, title=title, ax=ax, **look)


@style()
def image_map(
    image: npt.ArrayLike,
    *,
    title: str = "",
    exposure: float | None = None,
    channels: Channels = None,
    width: Width = "column",
    ax: Axes | None = None,
) -> Axes:
    """Draw an image.

    Parameters
    ----------
    image, exposure
        As in `tonemap`.
    channels
        A channel to draw in grey: "red", "green", "blue" or "luminance"; None draws colours.
    title
        What is shown.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.
    """
    ax = axes_in(ax, _HEIGHT, width)
    if channels is not None:
        image = one_channel(image, channels)
    ax.imshow(tonemap(image, exposure=exposure), interpolation="nearest")
    bare(ax, title)
    return ax


@style()
def atlas(found: Atlas, *, width: Width = "page", fig: Figure | None = None) -> Figure:
    """Draw where the shapes of an atlas occur, and what each looks like.

    Numbers in the map mark the most typical pixel of each shape. The panels show the mean density
    of log10 radiance, relative to the scale of each pixel, and its quartiles over pixels as a band.

    Parameters
    ----------
    found
        Result of `chdstat.atlas`.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.
    """
    number = len(found.share)
    columns = 2 if number <= 8 else 3
    rows = max(2, -(-number // columns))
    aspect = upright(*found.labels.shape)
    across, listed = inches(width, fig), 0.8 * rows + 0.3
    height = max(_OF_MAP * across * aspect + 0.2, listed)
    below = (min(across * aspect, 3.4) + 0.2, listed)
    figure, left, right = two_parts(fig, width, height, _OF_MAP, below)
    missing = float((found.labels < 0).mean())
    note = f"   (grey: none, {_percent(missing)})" if missing else ""
    colors = qualitative(number)
    ax = left.subplots()
    draw_labels(ax, found.labels, colors or [MISSING], f"Shape of each pixel{note}")
    for k, (y, x) in enumerate(found.medoids):
        ring = {"boxstyle": "circle,pad=0.18", "facecolor": "white", "edgecolor": colors[k]}
        ax.annotate(
            str(k + 1), (x, y), ha="center", va="center", fontweight="bold",
            bbox={**ring, "lw": 1.4},
        )  # fmt: skip
    panels = right.subplots(rows, columns, squeeze=False).flat
    for k, ax in enumerate(panels):
        if k < number:
            _draw_shape(ax, found, k, colors[k])
            ax.tick_params(labelbottom=k + columns >= number)
        else:
            ax.set_axis_off()
    right.supxlabel("decades from the mean of log10 radiance")
    return figure


def _draw_shape(ax: Axes, found: Atlas, k: int, color: str) -> None:
    """Draw the density of one shape, over the decades in which any shape is visible."""
    inner = slice(1, -1)  # the outer bins are open: no density
    low, high = np.moveaxis(found.density_band[k, inner], -1, 0)
    ax.fill_between(found.positions[inner], low, high, color=color, alpha=0.35, linewidth=0)
    ax.plot(found.positions[inner], found.density[k, inner], color=color, linewidth=1.4)
    ax.axvline(0, color="#888888", linewidth=0.6, linestyle=":")
    tops = found.density.max(axis=-1, keepdims=True)
    seen = found.positions[(found.density > _VISIBLE * tops).any(axis=0)]
    ax.set(xlim=(float(seen.min()) - 0.1, float(seen.max()) + 0.1), yticks=[])
    ax.set_ylim(bottom=0)
    ax.spines["left"].set_visible(False)
    shares = f"{_percent(found.share[k])}, nulls {_percent(found.null_share[k])}"
    ax.set_title(f"$\\bf{{{k + 1}}}$  {shares}", loc="left", pad=2)
    y, x = found.medoids[k]
    ax.text(
        0.99, 0.93, f"y {y}\nx {x}", transform=ax.transAxes, ha="right", va="top",
        color="#555555",
    )  # fmt: skip


@style()
def film_split(
    found: xr.Dataset,
    *,
    title: str = "Variation within the pixel",
    width: Width = "column",
    ax: Axes | None = None,
) -> Axes:
    """Draw how much of each pixel's variance is the picture changing within it.

    Parameters
    ----------
    found
        Dataset of `chdstat.patterns.film_split`, or of `chdstat.analyze`. Where the share is not
        significant over the image, pixels are light grey; those without variance are dark grey.
    title
        What is shown.
    width
        Width of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If the dataset has no such share.
    """
    prefix = "" if "share_told" in found else "film_"
    if f"{prefix}share_told" not in found:
        message = (
            "expected a dataset of chdstat.patterns.film_split, with share_told, got one of "
            f"{', '.join(map(str, found.data_vars))}"
        )
        raise InputError(message)
    told = found[f"{prefix}share_told"].to_numpy()
    unit = "share of the variance of luminance"
    ax = value_map(np.maximum(told, 0), title=title, unit=unit, limits=(0, 1), width=width, ax=ax)
    rejected, still = found[f"{prefix}rejected"].to_numpy(), LABEL_COLORS["constant"]
    known = {
        "not significant": (rejected == 0, MISSING),
        "nothing to split": (np.isnan(rejected), still),
    }
    patches = [
        Patch(color=color, label=f"{name} {_percent(float(here.mean()))}")
        for name, (here, color) in known.items()
        if here.any()
    ]
    without = np.ma.masked_array(np.zeros(told.shape), ~np.isnan(rejected))
    ax.imshow(without, cmap=ListedColormap([still]), interpolation="nearest")
    ax.legend(
        handles=patches, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2,
        handlelength=0.9, columnspacing=0.9, borderaxespad=0.2,
    )  # fmt: skip
    return ax


@style()
def pixel_by_place(
    pixel: Pixel, *, channel: str = "luminance", width: Width = "page", fig: Figure | None = None
) -> Figure:
    """Draw the mean radiance by place within a pixel, and how samples fell, beside its CHD.

    An edge that runs through the pixel is seen at once. Numbers are samples in each cell.

    Parameters
    ----------
    pixel
        A pixel of samples that say where they fell.
    channel
        A channel by its name, or "luminance".
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If the samples do not say where they fell, or there is no such channel.
    """
    if pixel.means_by_place is None:
        message = "these samples do not say where they fell; render them with film=True (--film)"
        raise InputError(message)
    means, counts = pixel.means_by_place
    name = one_of(pixel.names, channel) if len(pixel.names) > 1 else pixel.names[0]
    height = 1.1 + 0.9 * (not narrow(inches(width, fig)))
    figure, left, right = two_parts(fig, width, height + 0.6, 0.4, (height + 0.6, height + 0.6))
    shown = means[pixel.names.index(name)]
    ax = value_map(shown, title="Mean by place, number of samples", unit=UNIT, ax=left.subplots())
    middle = np.nanmean([np.nanmin(shown), np.nanmax(shown)])
    for (y, x), count in np.ndenumerate(counts):
        shade = "black" if shown[y, x] > middle else "white"
        ax.text(x, y, str(count), ha="center", va="center", fontsize=6, color=shade)
    title = f"{pixel.scene}, y {pixel.y}, x {pixel.x}"
    panel = Panel.of_pixel(title, pixel, note=f"{percent(pixel.null_share)} null")
    right_figure: Any = right
    chd_pair(panel, channels=name, scales="log", width=width, fig=right_figure)
    return figure
