"""Renders of one view: where their means differ, how noisy each is, and CHDs of the same places.

`contrast` draws what `chdstat.contrast` finds, of two renders or of several. `renders_contrasted`
draws several images and the CHDs of the same places.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from textwrap import fill
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from chdstat._core.arrays import Array, luminance
from chdstat._core.display import Width, colour, number, percent
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.errors import InputError
from chdstat.inference import Contrast, Contrasts
from chdstat.inference.noise_rankings import ExamplePixel, NoiseRanking
from chdstat.summary.histograms import shown_range
from chdstat.viz.chd import Channels, Panel, draw_histograms, draw_means, one_of
from chdstat.viz.image import Mark, draw_inset, draw_marked
from chdstat.viz.maps import draw_labels, image_map, value_map
from chdstat.viz.styling import (
    MISSING,
    PALETTE,
    UNIT,
    bare,
    color_map,
    fitting,
    grid,
    inches,
    narrow,
    page,
    qualitative,
    style,
    swatches,
    upright,
    verbatim,
    within,
)

_LETTERS = 16
"""Letters of a line of text per inch."""


@style()
def contrast(
    found: Contrast | Contrasts,
    *,
    channels: Channels = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw renders and how they differ: where their means do, or how noisy each is.

    Of two renders, it draws both images, where their means differ, p-values and efficiency, with
    the conclusion. A rectangle marks the most significant window; it is solid if there is a
    difference. The histogram of p-values has a line: for renders with the same mean, bars stay at
    or below it.

    Of a list of renders, it draws all images at one exposure, parts of them, their noise on one
    scale, which render is the least noisy where, and the CHDs of two pixels that show it.

    Parameters
    ----------
    found
        Result of `chdstat.contrast`.
    channels
        A channel to draw, with images in grey: its name, "red", "green", "blue" or "luminance".
        None draws images in colour, differences of luminance, and p-values of all channels.
        Efficiency is always for luminance.
    width
        Width of the figure: "column", "page" or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If several renders were contrasted and not ranked, or `channels` is given for them.
    """
    if isinstance(found, Contrasts):
        return _ranking(found, _noise_of(found, channels), width, fig)
    maps = found.maps
    names = [str(name) for name in maps["channel"].to_numpy()]
    shown, tested, of = slice(1, None) if len(names) == 4 else slice(0, 1), slice(None), ""
    if channels is not None:
        name = one_of(names, channels)
        shown = tested = slice(names.index(name), names.index(name) + 1)
        of = f", {verbatim(colour(name))}"  # a channel is not render B
    first = tested.start or 0
    across = inches(width, fig)
    columns, aspect = 2 if narrow(across) else 3, upright(maps.sizes["y"], maps.sizes["x"])
    conclusion = fill(found.conclusion, int(_LETTERS * across))
    rows = (0.8 * across / columns * aspect + 0.3) * 6 / columns
    height = rows + 0.16 * (1 + conclusion.count("\n")) + 0.3
    figure = page(fig, height, width, wspace=0.06)
    axes = grid(figure, 6, columns)
    means = [maps[f"mean_{name}"].to_numpy()[..., shown] for name in ("a", "b")]
    exposure = display_stops(means[0])
    for ax, mean, letter, name in zip(axes, means, "AB", found.names, strict=False):
        most = int(11 * across / columns)
        short = name if len(name) <= most else f"...{name[2 - most :]}"
        image_map(mean, title=f"{letter}: {verbatim(short)}", exposure=exposure, ax=ax)
    _mark(axes[1], found)
    level, p = (
        np.abs(maps["mean_a"].to_numpy()[..., first]),
        maps["p_value"].to_numpy()[..., tested],
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = maps["difference"].to_numpy()[..., first] / np.where(level > 0, level, np.nan)
    significance, efficiency = np.fmin.reduce(p, axis=-1), maps["efficiency"].to_numpy()
    value_map(100 * relative, title=f"B − A over A{of}", unit="%", diverging=True, ax=axes[2])
    _mark(axes[2], found)
    look: dict[str, Any] = {"log": True, "limits": (1e-4, 1), "cmap": "viridis_r"}
    value_map(significance, title="Significance", unit="p", **look, ax=axes[3])
    _p_values(axes[4], p)
    if np.isfinite(efficiency).any():
        value_map(efficiency, title="Efficiency of B over A", log=True, diverging=True, ax=axes[5])
    else:
        axes[5].set_axis_off()
    figure.suptitle(conclusion, x=0.01, ha="left", fontsize=8.5)
    return figure


def _mark(ax: Axes, found: Contrast) -> None:
    y, x, height, width = found.window
    ax.add_patch(
        Rectangle(
            (x - 0.5, y - 0.5), width, height, fill=False, edgecolor=PALETTE[5],
            linewidth=1.2, linestyle="-" if found.outcome == "differ" else ":",
        )
    )  # fmt: skip


def _p_values(ax: Axes, p: Array) -> None:
    p = p[np.isfinite(p)]
    ax.hist(p, bins=20, range=(0, 1), color=PALETTE[1], weights=np.full(p.size, 1 / max(1, p.size)))
    ax.axhline(1 / 20, color="#444444", linewidth=0.8, linestyle=":")
    ax.set(xlabel="p-value", title="Pixels by p-value", yticks=[], box_aspect=0.8)
    ax.spines["left"].set_visible(False)


@style()
def renders_contrasted(
    images: Mapping[str, npt.ArrayLike],
    samples: Mapping[str, Sequence[npt.ArrayLike]] | None = None,
    marks: Sequence[Mark] = (),
    *,
    difference: tuple[str, str] | None = None,
    maps: Sequence[Callable[..., Any]] = (),
    colors: Mapping[str, str] | None = None,
    exposure: float | None = None,
    width: Width = "page",
    fig: Figure | None = None,
) -> Figure:
    """Draw renders of one view, how two of them differ, and CHDs of the same places.

    The CHDs of a place are log histograms of luminance, drawn over each other, with a dashed line
    at the mean. A render without samples has a dotted line at its luminance.

    Parameters
    ----------
    images
        Linear radiance (y, x, channel) by the name of the render.
    samples
        For all or some renders, the samples (channel, sample) of each mark.
    marks
        Places; each has a number in the images, and a CHD.
    difference
        Names of two renders; the luminance of the first minus the second is drawn, too.
    maps
        Functions that draw a further panel into their ``ax``, such as a partial of `value_map`.
    colors
        Colour of the CHDs of each render; None takes those of `chdstat.viz.PALETTE`.
    exposure
        As in `tonemap`; all images share it. None exposes for the first image.
    width
        Of a new figure: "column" or "page" of a paper, or inches.
    fig
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there is no image, or a render does not have samples for each mark.

    Examples
    --------
    >>> x = np.random.default_rng(0).gamma(1.0, size=(2, 8, 8, 3, 64))
    >>> mark = Mark("wall", slice(3, 4), slice(4, 5), (3, 4))
    >>> images = dict(zip("ab", x.mean(axis=-1)))
    >>> figure = renders_contrasted(images, {"a": [x[0, 3, 4]]}, [mark], difference=("a", "b"))
    >>> len(figure.axes)  # with the colour bar
    5
    """
    samples = samples or {}
    if not images or any(len(those) != len(marks) for those in samples.values()):
        message = "expected at least one image, and samples of as many places as there are marks"
        raise InputError(message)
    arrays = {name: np.asarray(image, float) for name, image in images.items()}
    first = next(iter(arrays.values()))
    exposure = display_stops(first) if exposure is None else exposure
    if difference is not None:
        one, two = (luminance(arrays[name], channel_axis=-1) for name in difference)
        look: Any = {"title": " − ".join(difference), "unit": "luminance", "diverging": True}
        maps = [partial(value_map, one - two, **look), *maps]
    count, wide = len(arrays) + len(maps), inches(width, fig)
    across, places = fitting(wide, min(count, 4), 1.6), len(marks) if samples else 0
    columns = fitting(wide, min(places, 2), 2.5)
    height = wide / across * upright(*first.shape[:2]) + 0.25
    rows, below = -(-count // across), -(-places // columns)
    figure = page(fig, rows * height + 1.5 * below + 0.3, width)
    ratios = [rows * height, 1.5 * below] if places else [1]
    parts = figure.add_gridspec(len(ratios), 1, height_ratios=ratios)
    cells = parts[0].subgridspec(rows, across)
    axes = [figure.add_subplot(cells[i // across, i % across]) for i in range(count)]
    for ax, (name, image) in zip(axes, arrays.items(), strict=False):
        draw_marked(ax, tonemap(image, exposure=exposure), marks)
        bare(ax, within(name, wide / across))
    for ax, further in zip(axes[len(arrays) :], maps, strict=True):
        further(ax=ax)
        ax.set_title(within(ax.get_title(), wide / across))
    colors = {**dict(zip(arrays, qualitative(len(arrays)), strict=True)), **(colors or {})}
    cells = parts[-1].subgridspec(max(1, below), columns, wspace=0.12)
    for i, mark in enumerate(marks if places else ()):
        ax = figure.add_subplot(cells[i // columns, i % columns])
        means = {
            name: float(np.nanmean(luminance(image[mark.ys, mark.xs], channel_axis=-1)))
            for name, image in arrays.items()
            if name not in samples
        }
        of_place = {name: those[i] for name, those in samples.items()}
        _draw_place(ax, f"{i + 1} {mark.name}", of_place, means, colors)
        ax.set_ylabel("" if i % columns else "density")
    if places:
        where: Any = {"loc": "outside lower center", "ncols": 2 * columns, "handlelength": 1}
        figure.legend(handles=swatches(colors), **where)
    return figure


def _draw_place(
    ax: Axes,
    title: str,
    samples: Mapping[str, npt.ArrayLike],
    means: Mapping[str, float],
    colors: Mapping[str, str],
) -> None:
    """Draw the CHDs of one place in several renders; of those without samples, their means."""
    panels = {name: Panel.of(name, of) for name, of in samples.items()}
    found = {name: [*panel.histograms("log").values()][-1] for name, panel in panels.items()}
    marked = [mean for panel in panels.values() for mean in panel.mean[-1:]]
    limits = shown_range([*found.values()], [*marked, *means.values()]) if found else None
    draw_histograms(ax, found, colors=[colors[name] for name in found], limits=limits)
    for name, color in colors.items():
        if name in panels:
            draw_means(ax, panels[name].mean[-1:], [color])
        elif name in means:
            draw_means(ax, [means[name]], [color], dashes=":")
    ax.set_title(verbatim(title), loc="left", fontweight="bold", pad=3)
    ax.set_xlabel(f"luminance ({UNIT}), log scale")


# --- several renders by their noise ---------------------------------------------------------------

_INSET = 5
"""Pixels around an example that are magnified with it."""
_LEAST = 1.1
"""Least width of an image, in inches."""
_NAMED = 1.6
"""Width of an image from which the title says that a number is its noise."""
_UPPER = 0.15
"""Share of the image at whose marks there is no room for a title."""
_DECADES = 4
"""Most decades of the scale of noise."""


def _noise_of(found: Contrasts, channels: Channels) -> NoiseRanking:
    if channels is not None:
        message = f"channels are for two renders, got {channels} for several; leave it out"
        raise InputError(message)
    if found.noise is None:
        message = (
            "expected renders that are ranked by their noise, chdstat.contrast([a, b]), got "
            "contrasts of means alone: draw each, found[name].plot()"
        )
        raise InputError(message)
    return found.noise


def _ranking(contrasts: Contrasts, found: NoiseRanking, width: Width, fig: Figure | None) -> Figure:
    """Draw several renders, their noise, where each is the least noisy, and CHDs."""
    names, across = found.names, inches(width, fig)
    count = len(names)
    columns = fitting(across, count, _LEAST)
    rows, marks = -(-count // columns), [_mark_of(example) for example in found.examples]
    image = across / columns * upright(found.maps.sizes["y"], found.maps.sizes["x"])
    inset = 0.48 * across / columns if marks else 0
    below = _below(found, across)
    differ = _differing(contrasts, names[-1])
    titles = 0.3 if differ else 0.15
    heights = [rows * (image + inset + 0.15), rows * (image + titles) + 0.45, *below]
    figure = page(fig, sum(heights) + 0.2, width)
    parts = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    # Colours of renders are not those of the marks.
    colors = dict(zip(names, qualitative(len(marks) + count)[len(marks) :], strict=True))
    _draw_images(figure, parts[0], found, marks, columns, image / max(image + inset, 1e-9))
    _draw_noise(figure, parts[1], found, columns, differ)
    _draw_winners(figure, [parts[2 + i] for i in range(len(below))], found, colors, across)
    return figure


def _differing(contrasts: Contrasts, last: str) -> list[str]:
    """Return the renders whose means differ; the last one if all others differ from it."""
    differ = [name for name, of in contrasts.contrasts.items() if of.outcome == "differ"]
    if len(differ) < len(contrasts.contrasts):
        return differ
    return [last] if len(differ) > 1 else [*differ, last]


def _mark_of(example: ExamplePixel) -> Mark:
    y, x = example.y, example.x
    ys, xs = (slice(max(0, at - _INSET), at + _INSET + 1) for at in (y, x))
    return Mark(f"y {y}, x {x}", ys, xs, (y, x))


def _draw_images(
    figure: Figure, at: Any, found: NoiseRanking, marks: Sequence[Mark], columns: int, share: float
) -> None:
    """Draw all images at one exposure, each with the same parts magnified."""
    means = found.maps["mean"].to_numpy()
    means = means[..., :1] if means.shape[-1] not in (1, 3) else means
    exposure, rows = display_stops(means[0]), -(-len(means) // columns)
    cells = at.subgridspec(rows, columns, wspace=0.05)
    room = inches("page", figure) / columns
    for i, (name, mean) in enumerate(zip(found.names, means, strict=True)):
        parts = cells[i // columns, i % columns].subgridspec(
            2 if marks else 1, 1, height_ratios=[share, 1 - share] if marks else [1], hspace=0.04
        )
        shown = tonemap(mean, exposure=exposure)
        ax = figure.add_subplot(parts[0])
        draw_marked(ax, shown, marks)
        bare(ax)
        # Numbers of marks at the upper edge stand above the image.
        high = any(mark.ys.start < _UPPER * len(shown) for mark in marks)
        title = within(f"{name}, {found.spp[name]} spp", room)
        ax.set_title(title, pad=13 if high else None)
        insets = parts[-1].subgridspec(1, max(1, len(marks)), wspace=0.04)
        for k, mark in enumerate(marks):
            draw_inset(figure.add_subplot(insets[k]), shown, mark, k, titled=False)


def _draw_noise(
    figure: Figure, at: Any, found: NoiseRanking, columns: int, differ: Sequence[str]
) -> None:
    """Draw the relative variance of all renders on one logarithmic scale."""
    noise, order = found.maps["relative_variance"].to_numpy(), found.order
    seen = noise[np.isfinite(noise) & (noise > 0)]
    low, high = np.percentile(seen, (1, 99)) if seen.size else (0.1, 1.0)
    least = max(low, high / 10**_DECADES)
    norm = LogNorm(least, max(high, low * 1.01))
    rows = -(-len(noise) // columns)
    cells, axes = at.subgridspec(rows, columns, wspace=0.05), []
    room = inches("page", figure) / columns
    for i, (name, values) in enumerate(zip(found.names, noise, strict=True)):
        ax = figure.add_subplot(cells[i // columns, i % columns])
        shown = np.where(values > 0, values, np.where(np.isnan(values), np.nan, least))
        drawn = ax.imshow(shown, cmap=color_map(), norm=norm, interpolation="nearest")
        low_rank, high_rank = order.rank(name)
        to = " to " if room > _NAMED else "–"
        rank = f"{low_rank}" if low_rank == high_rank else f"{low_rank}{to}{high_rank}"
        title = f"{'noise ' * (room > _NAMED)}{number(order.noise.get(name, 0))}, rank {rank}"
        lines = ["no light" if name in found.unlit else title]
        lines += ["mean differs"] * (name in differ)
        bare(ax, "\n".join(within(line, room) for line in lines))
        axes.append(ax)
    look: Any = {"orientation": "horizontal", "shrink": 0.6, "aspect": 45, "pad": 0.02}
    bar = figure.colorbar(drawn, ax=axes, **look)
    bar.outline.set_visible(False)
    bar.set_label("relative variance of a sample")


def _below(found: NoiseRanking, across: float) -> list[float]:
    """Return the heights of the rows with the winners and the CHDs, in inches."""
    aspect = upright(found.maps.sizes["y"], found.maps.sizes["x"])
    maps, chds = len(found.orders), len(found.examples)
    if narrow(across):
        return [across / 2 * aspect + 0.5, *[1.3] * min(chds, 1)]
    return [max(across / (maps + 2) * aspect, 1.3) + 0.6] if chds + maps else []


def _draw_winners(
    figure: Figure,
    rows: Sequence[Any],
    found: NoiseRanking,
    colors: Mapping[str, str],
    across: float,
) -> None:
    """Draw which render is the least noisy where, and the CHDs of examples."""
    maps, small = list(found.orders), narrow(across)
    examples = found.examples[: 1 if small else None]
    columns = 2 if small else len(maps) + max(len(examples), 1)
    first = rows[0].subgridspec(1, columns, wspace=0.12)
    axes = [figure.add_subplot(first[i]) for i in range(len(maps))]
    for ax, order in zip(axes, maps, strict=True):
        least = found.maps["least_noisy"].sel(at=order).to_numpy()
        title = f"least noisy at {order}"
        won = [
            f"{within(name, across / columns - 0.4)} {percent(pixels)}"
            for name, (pixels, _) in found.wins(order).items()
            if pixels
        ]
        draw_labels(ax, least, [*colors.values()], title)
        ax.set_xlabel("\n".join(won) or "cannot be told")
    undecided = bool((found.maps["least_noisy"] < 0).any())
    shades = {**colors, **({"cannot be told": MISSING} if undecided else {})}
    across_legend = fitting(across, len(shades), 1.5)
    room = across / across_legend - 0.5
    handles = [Patch(color=shade, label=within(name, room)) for name, shade in shades.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=across_legend)
    for k, example in enumerate(examples):
        place = rows[1 + k] if small else first[len(maps) + k]
        ax = figure.add_subplot(place)
        _draw_place(ax, f"{k + 1}  y {example.y}, x {example.x}", example.samples, {}, colors)
