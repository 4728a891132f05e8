"""Panels: the table of plots of a selection, what each of them draws, and their Bokeh figures.

`PANELS` is the table; `panels` draws all of them for a view, as plain arrays. One place shows its
channels; several places show luminance or one channel, each in its colour, and their densities
stand above each other. The density of a fit is that of the positive samples, as histograms are.

Colours contrast with the dark ground, and those of `LIGHT` with the light one, by 4.5 to 1 or more
(WCAG 2.2, AA). The ranges of the axes are computed here, since Bokeh's own data ranges send each of
their changes to the server, eighteen messages a click.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from bokeh import models
from bokeh.plotting import figure
from matplotlib.ticker import MaxNLocator

from chdstat._core.arrays import Array, luminance, take_rows
from chdstat._core.display import as_p, number, percent
from chdstat._core.resampling import Z_95
from chdstat.explorer.address import View, row_of
from chdstat.explorer.image_sources import BINS, Overall
from chdstat.fit.families import FAMILIES
from chdstat.fit.tail import TailIndex
from chdstat.inference.averages import NormalityOfMeans
from chdstat.patterns import Pixel
from chdstat.summary.histograms import Histogram, Scale, shared_ranges, shown_range
from chdstat.viz.chd import outside_in_words
from chdstat.viz.styling import called

BLENDED = "#d0d3d6"
"""Colour of luminance, and of everything that is not a channel."""
CHANNEL_COLORS = {"R": "#ff7b72", "G": "#56d18b", "B": "#79b8ff"}
PIXEL_COLORS = ("#f0b429", "#62c4f5", "#3fd0a4", "#e39ac8", "#f4ea5c", "#ff8f5e")
"""After Okabe and Ito (2008), lightened: colour-blind readers tell them apart."""
RENDER_COLORS = tuple(PIXEL_COLORS[i] for i in (3, 2, 5, 4, 1, 0))
"""Colours of several renders; their pixels are all marked in `BLENDED` then, and have numbers."""
LIGHT = {
    BLENDED: "#4a4f55",
    **dict(zip(CHANNEL_COLORS.values(), ("#b3261e", "#0f7039", "#1257b0"), strict=True)),
    **dict(
        zip(
            PIXEL_COLORS,
            ("#855700", "#0a6390", "#006b56", "#9a3577", "#655f00", "#a83e0b"),
            strict=True,
        )
    ),
}
"""Colours on a light background instead of these."""
_PATTERNS = ("solid", "6 6", "2 4 6 4", "2 4", "12 4", "6 4 2 4 2 4", "12 4 2 4")
DASHES = {**dict(zip(FAMILIES, cycle(_PATTERNS), strict=False)), "mixture": "6 4 2 4"}
"""Line dashes of fits by name: lengths of lines and gaps, as Bokeh and SVG read them."""

GROUND = "#1c1e21"
TEXT = "#e8e9ea"
FAINT = "#b4b8bd"
_LINES = "#3a3e44"

_Extent = tuple[float, float]


_POINTS = 160
_QUANTILES = (np.arange(100) + 0.5) / 100
_ROW_HEIGHT, _OF_AXIS = 0.78, 0.24
"""Height of a density, and of a row's own axis, relative to the distance between rows."""


@dataclass(frozen=True)
class Trace:
    """A line.

    Attributes
    ----------
    x, y
        Vertices, shape (point,).
    color
        As "#rrggbb".
    dash
        Line dash in Bokeh's words.
    width
        In screen pixels; 0 for none but the area.
    fill
        Whether the area that it goes around is filled.
    """

    x: Array
    y: Array
    color: str
    dash: str = "solid"
    width: float = 1.3
    fill: bool = False


@dataclass(frozen=True)
class PanelData:
    """What one panel draws.

    Attributes
    ----------
    lines
        What is drawn.
    texts
        Side ("left" or "right") or x, y, text and colour of labels inside the panel.
    notes
        Text beside the title.
    rows
        How many pixels stand above each other, each over its own peak; 0 for one common axis.
    own_x
        Whether each of the rows has its own range of x, which a label states.
    y
        Label of the vertical axis, where it is not that of the panel's kind.
    """

    lines: Sequence[Trace] = ()
    texts: Sequence[tuple[str | float, float, str, str]] = ()
    notes: Sequence[str] = ()
    rows: int = 0
    own_x: bool = False
    y: str = ""


@dataclass(frozen=True)
class _Series:
    """One row of samples that panels show.

    Attributes
    ----------
    place, row
        Where it comes from.
    color
        Of the channel or of the pixel.
    name
        As in the legend.
    pixel
        Number of the pixel, from 1, where there are several; else 0.
    dash
        Of its lines, but for those of fits.
    mark
        Colour of the mark of the pixel.
    """

    place: Pixel
    row: int
    color: str
    name: str
    pixel: int = 0
    dash: str = "solid"
    mark: str = BLENDED

    @property
    def constant(self) -> float | None:
        """Value of samples that are nearly equal, None where they are not."""
        if not self.place.constant[self.row]:
            return None
        return float(self.place.moments.maximum[self.row])


def mark_colors(images: int) -> tuple[str, ...]:
    """Return the colours of the marks of pixels, of which renders of so many have none."""
    return PIXEL_COLORS if images == 1 else (BLENDED,) * len(PIXEL_COLORS)


def render_color(index: int) -> str:
    """Return the colour of one of several renders."""
    return RENDER_COLORS[index % len(RENDER_COLORS)]


def series_of(view: View, places: Mapping[str, Sequence[Pixel]]) -> list[_Series]:
    """Return what the panels show of the selected places, by the name of the store or scene.

    One place of one store shows its channels; else each has one row: luminance or the channel of
    the view, in the colour of the pixel, or of the store where there are several.
    """
    (place, *others), several = next(iter(places.values())), len(places) > 1
    if not others and not several:
        one = [row_of(view.channel, place.names)]
        rows = [*range(len(place.channels))] if view.channel == "all" else one
        named = [(i, place.names[i]) for i in rows]
        return [_Series(place, i, CHANNEL_COLORS.get(name, BLENDED), name) for i, name in named]
    found = []
    for k, (name, those) in enumerate(places.items()):
        color, dash = render_color(k), "solid" if k < len(RENDER_COLORS) else "dashed"
        for i, place in enumerate(those):
            pixel = i + 1 if len(those) > 1 else 0
            own = (color, name) if several else (PIXEL_COLORS[i], f"pixel {pixel}")
            mark, row = mark_colors(len(places))[i], row_of(view.channel, place.names)
            found.append(_Series(place, row, *own, pixel, dash, mark))
    return found


# --- densities ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _SeriesCurve:
    """Density of one series.

    Attributes
    ----------
    outline
        x and height of the outline of its histogram; None without one.
    curves
        Fitted densities.
    mean
        Where it is marked; NaN for no mark.
    value
        The one value of samples that are nearly equal, else None.
    note
        What else is said of it.
    beyond
        Share of the samples beyond the end of the outline.
    """

    outline: tuple[Array, Array] | None = None
    curves: Sequence[Trace] = ()
    mean: float = float("nan")
    value: float | None = None
    note: str = ""
    beyond: float = 0.0


def _densities(
    series: Sequence[_Series],
    density: Callable[[_Series], _SeriesCurve],
    name: Scale | Literal["averages"],
) -> PanelData:
    """Draw densities upon each other, or each pixel in a row of its own."""
    found = [(s, density(s)) for s in series]
    rows = max((s.pixel for s in series), default=0)
    if not rows:
        notes = _uncounted(series, name) if name != "averages" else []
        notes += dict.fromkeys(d.note for _, d in found if d.note)
        beyond = max((d.beyond for _, d in found), default=0.0)
        notes += [f"{percent(beyond)} beyond"] if beyond > 0 else []
        values = [f"{s.name} {number(d.value)}" for s, d in found if d.value is not None]
        notes += [f"constant: {', '.join(values)}"] if values else []
        return PanelData(_upon_each_other(found), notes=notes)
    lines, texts, own_x = list[Trace](), list[Any](), name != "log"
    for pixel in range(1, rows + 1):
        group = [(s, d) for s, d in found if s.pixel == pixel]
        base, color, ends = rows - pixel, group[0][0].mark, _ends([d for _, d in group])
        nulls = dict.fromkeys(percent(s.place.null_share) for s, _ in group)
        note = f"{' / '.join(nulls)} null"
        lines += _in_row(_upon_each_other(group), base, ends if own_x else None)
        texts.append(("left", base, str(pixel), color))
        if ends and own_x:
            axis, labels = _own_axis(base, ends)
            lines += axis
            texts += labels
        elif not own_x:  # above the upper tail, where there is room
            texts.append(("right", base + 0.7 * _ROW_HEIGHT, note, color))
    note = "each density over its peak" + (", on an axis of its own" if own_x else "")
    return PanelData(lines, texts, [note], rows=rows, own_x=own_x)


def _upon_each_other(found: Iterable[tuple[_Series, _SeriesCurve]]) -> list[Trace]:
    """Draw densities on one axis, with their curves and a dashed line at their means.

    Nearly equal samples have no density to speak of: a spike says where they are.
    """
    known = [(s, d) for s, d in found if d.outline is not None or d.value is not None]
    outlines = [Trace(*d.outline, s.color, s.dash, 1.2, fill=True) for s, d in known if d.outline]
    curves = [curve for _, d in known for curve in d.curves]
    peak = max((float(t.y.max()) for t in outlines), default=1.0) or 1.0
    top = max([peak, *(float(np.nanmax(t.y)) for t in curves)])
    lines = [*outlines, *curves]
    for s, d in known:
        if d.value is not None:
            lines.append(Trace(np.full(2, d.value), np.array([0, peak]), s.color, s.dash, 3.0))
        elif np.isfinite(d.mean):
            lines.append(Trace(np.full(2, d.mean), np.array([0, top]), s.color, "dashed", 1.0))
    return lines


def _ends(densities: Sequence[_SeriesCurve]) -> _Extent | None:
    """Return the least and the largest radiance of densities; None where there is none."""
    known = [d.value for d in densities if d.value is not None]
    known += [float(d.outline[0][i]) for d in densities if d.outline for i in (0, -1)]
    return (min(known), max(known)) if known else None


def _in_row(lines: Sequence[Trace], base: int, ends: _Extent | None) -> list[Trace]:
    """Return lines above a base, over their peak, and from one end to the other if there are."""
    peak = max((float(t.y.max()) for t in lines if t.fill), default=1.0) or 1.0
    found, height = [], _ROW_HEIGHT if ends is None else _ROW_HEIGHT - _OF_AXIS
    for line in lines:
        x, y = line.x, base + height * np.minimum(line.y / peak, 1.2)
        if ends is not None:
            low, high = ends
            inside = (x >= low) & (x <= high)
            x, y = x[inside], y[inside]
            x = (x - low) / (high - low) if high > low else np.full(len(x), 0.5)
        found.append(replace(line, x=x, y=y))
    return found


def _own_axis(base: int, ends: _Extent) -> tuple[list[Trace], list[tuple[float, float, str, str]]]:
    """Return a row's own axis from 0 to 1, with a mark and a number at a few round values."""
    low, high = ends
    span = high - low
    ticks = (
        [v for v in MaxNLocator(4).tick_values(low, high) if low <= v <= high] if span else [low]
    )
    places = [float((v - low) / span) if span else 0.5 for v in ticks]
    lines = [Trace(np.array([0.0, 1.0]), np.full(2, base), BLENDED, width=0.8)]
    mark = np.array([base - 0.05, base])
    lines += [Trace(np.full(2, at), mark, BLENDED, width=0.8) for at in places]
    labels = [f"{v:.6g}".replace("-", "−") for v in ticks]
    return lines, [
        (at, base - _OF_AXIS, label, BLENDED) for at, label in zip(places, labels, strict=True)
    ]


def _histograms(scale: Scale, view: View, series: Sequence[_Series]) -> PanelData:
    # Several pixels have linear axes of their own.
    keys = [s.pixel if scale == "linear" else 0 for s in series]
    groups = {key: [s for s, k in zip(series, keys, strict=True) if k == key] for key in keys}
    ranges = {key: _range(scale, those) for key, those in groups.items()}
    limits = {id(s): ranges[key] for s, key in zip(series, keys, strict=True)}
    found = _densities(series, lambda s: _histogram(view, scale, s, limits[id(s)]), scale)
    words = [outside_in_words([_counted(s, scale) for s in those], *ranges[key] or (0, np.inf))
             for key, those in groups.items()]  # fmt: skip
    named = _named(view, series) if scale == "log" else []
    return replace(found, notes=[*found.notes, *filter(None, words[0]), *named])


def _named(view: View, series: Sequence[_Series]) -> list[str]:
    """Return what the curves are: in full of one row, else by name, as the table has the rest."""
    if not view.families:
        return []
    curves = {s.name: s.place.curve(s.row, view.families[0]) for s in series}
    if len(curves) == 1:
        return [curve.words for curve in curves.values()]
    names: dict[str, list[str]] = {}
    for row, curve in curves.items():
        names.setdefault(curve.name or curve.reason, []).append(row)
    alone = len(names) == 1
    return [words if alone else f"{', '.join(rows)}: {words}" for words, rows in names.items()]


def _counted(s: _Series, scale: Scale) -> Histogram:
    return take_rows(s.place.histograms[scale], s.row, axis=0)


def _range(scale: Scale, series: Sequence[_Series]) -> _Extent | None:
    """Return what an axis of histograms shows: of several pixels, what they share."""
    means = [[float(s.place.moments.mean[s.row])] for s in series]
    found = [[_counted(s, scale)] for s in series]
    if scale == "linear" or not any(s.pixel for s in series):
        return shown_range([h for those in found for h in those], [m for (m,) in means])
    ends = [span for span in shared_ranges(found, means) if span]
    return (min(span[0] for span in ends), max(span[1] for span in ends)) if ends else None


def _histogram(view: View, scale: Scale, s: _Series, limits: _Extent | None) -> _SeriesCurve:
    if s.constant is not None:
        return _SeriesCurve(value=s.constant)
    counted = _counted(s, scale)
    x, y = _steps(counted.edges, counted.density, limits)
    if not x.size or limits is None:
        return _SeriesCurve()
    mean = float(s.place.moments.mean[s.row])
    mean = mean if limits[0] <= mean <= limits[1] else float("nan")
    return _SeriesCurve((x, y), _curves(view, s, counted, limits), mean)


def _steps(edges: Array, heights: Array, limits: _Extent | None = None) -> tuple[Array, Array]:
    """Return the outline of the occupied bins, from the axis up and down to it again."""
    low, high = limits or (-np.inf, np.inf)
    middle = (edges[1:] + edges[:-1]) / 2
    filled = np.flatnonzero((np.nan_to_num(heights) > 0) & (middle >= low) & (middle <= high))
    if not filled.size:
        return np.empty(0), np.empty(0)
    bins = slice(filled[0], filled[-1] + 1)
    x = np.repeat(edges[filled[0] : filled[-1] + 2], 2)
    return x, np.concatenate([[0.0], np.repeat(heights[bins], 2), [0.0]])


def _curves(view: View, s: _Series, counted: Histogram, limits: _Extent) -> list[Trace]:
    low, high = max(limits[0], _TINY), limits[1]
    space = np.geomspace if counted.scale == "log" else np.linspace
    x, lines = space(low, high, _POINTS), []
    for family in view.families:
        curve = s.place.curve(s.row, family)
        y = curve.density(x, float(counted.bin_width), counted.scale)
        if np.isfinite(y).any():
            lines.append(Trace(x, y, s.color, DASHES[curve.family], 2.0))
    return lines


def _uncounted(series: Sequence[_Series], scale: Scale) -> list[str]:
    """Return what is in no histogram: nulls and bad samples."""
    if not series:
        return []
    place = series[0].place
    if series[-1].place is not place:
        return [f"{s.name}: {_counts(s.place)}" for s in series if scale == "log"]
    return [_counts(place)]


def _counts(place: Pixel) -> str:
    return f"{percent(place.null_share)} null · {int(place.bad.sum())} bad"


# --- quantiles, averages ------------------------------------------------------------------------


def _qq(view: View, series: Sequence[_Series]) -> PanelData:
    """Draw quantiles of the positive samples against those of the first family that is switched on.

    Both axes are logarithmic, since the tails decide.
    """
    lines, ends, reasons = [], [], []
    families: dict[str, None] = {}
    for s in series:
        curve = s.place.curve(s.row, view.families[0] if view.families else "best")
        fit, part = curve.fit, s.place.part
        n = int(part.n[s.row])
        if fit is None:
            reasons.append(curve.reason)
            continue
        levels = _QUANTILES if n >= 100 else (np.arange(n) + 0.5) / n
        with np.errstate(all="ignore"):
            zero = np.float64(fit.zero_share)
            expected = fit.ppf(zero + (1 - zero) * levels)
        ordered = part.sorted[s.row, :n].astype(np.float64)
        seen = ordered[np.minimum((levels * n).astype(int), n - 1)]
        keep = np.isfinite(expected) & (expected > 0) & (seen > 0)
        if keep.any():
            families[curve.family] = None
            lines.append(Trace(expected[keep], seen[keep], s.color, s.dash, 2.2))
            ends += [seen[keep].min(), seen[keep].max()]
    if not lines:
        return PanelData(notes=[*dict.fromkeys(reasons)])
    diagonal = np.array([min(ends), max(ends)])
    lines.insert(0, Trace(diagonal, diagonal, BLENDED, "dotted", 1.2))
    return PanelData(lines=lines, notes=[f"against {', '.join(map(called, families))}"])


def _running(_: View, series: Sequence[_Series]) -> PanelData:
    lines, tails = [], []
    several = any(s.pixel for s in series)
    for s in series:
        at, means, errors = s.place.running
        if not at.size:
            continue
        mean, error = means[s.row], Z_95 * errors[s.row]
        if several and mean[-1] > 0:
            mean, error = mean / mean[-1], error / mean[-1]
        band = np.concatenate([mean - error, (mean + error)[::-1]])
        around = np.concatenate([at, at[::-1]])
        lines.append(Trace(around, band, s.color, width=0.0, fill=True))
        lines.append(Trace(at, mean, s.color, s.dash, 1.6))
        tails += [(s.name, s.place.measured(TailIndex()), s.row)] if s.constant is None else []
    caution = ""
    heavy = [name for name, tail, row in tails if tail.variance_suspect[row]]
    if heavy:
        of = f" of {', '.join(dict.fromkeys(heavy))}" if len(heavy) < len(series) else ""
        caution = f" · the error bar{of} fails at so many samples: do not trust it"
    elif any(tail.variance_unidentified[row] for _, tail, row in tails):
        caution = " · the samples do not tell whether it holds"
    y = "over the mean of all" if several else ""
    return PanelData(lines, notes=[f"95 % interval of the mean{caution}"], y=y)


def _averages(view: View, series: Sequence[_Series]) -> PanelData:
    return _densities(series, partial(_averaged, view.batch), "averages")


def _averaged(n: int, s: _Series) -> _SeriesCurve:
    """Return the distribution of averages of N samples, with the Gaussian of the same moments."""
    averages = s.place.averages(n)[s.row]
    averages = averages[np.isfinite(averages)]
    if len(averages) < 4:
        return _SeriesCurve(note=f"too few samples for averages of {n}")
    if averages.min() == averages.max() or (s.constant is not None and not s.place.null.any()):
        return _SeriesCurve(value=float(averages[0]))
    # Bins go up to the largest average, or to where few fireflies begin.
    bins = int(np.clip(np.sqrt(len(averages)), 8, 40))
    low, usual, high = averages.min(), np.quantile(averages, 0.99), averages.max()
    end = min(high, usual + (usual - low)) if usual > low else high
    edges = np.linspace(low, end, bins + 1)
    heights = np.histogram(averages, edges)[0] / (len(averages) * (edges[1] - edges[0]))
    outline = np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])
    tests, note = NormalityOfMeans.of_pixel(s.place.fitted_spp), ""
    if tests is not None and n in tests.sizes:
        means = s.place.measured(tests)
        p = float(means.p_value[s.row, list(means.sizes).index(n)])
        note = f"{s.name} p = {as_p(p)}" if np.isfinite(p) else ""
    beyond = float((averages > end).mean())
    return _SeriesCurve(outline, [_gaussian(averages, edges, s.color)], note=note, beyond=beyond)


def _gaussian(averages: Array, edges: Array, color: str) -> Trace:
    mean, sd = averages.mean(), averages.std(ddof=1)
    low, high = edges[0], edges[-1]
    x = np.linspace(max(low - sd, min(0.0, low)), min(high + sd, 2 * high - low), 120)
    y = np.exp(-(((x - mean) / sd) ** 2) / 2) / (sd * np.sqrt(2 * np.pi))
    return Trace(x, y, color, "dotted", 1.8)


# --- the whole image ----------------------------------------------------------------------------

_RARE = 0.0025
"""Share of the samples below which the axis of an image begins."""


def image_panel(view: View, overalls: Mapping[str, Overall], channels: Sequence[str]) -> PanelData:
    r"""Return the densities of all samples of each image, and of the means of its pixels.

    Examples
    --------
    >>> from chdstat.explorer.image_sources import StoreSource, stream
    >>> from chdstat.samples import Samples
    >>> x = np.random.default_rng(1).gamma(2.0, size=(4, 4, 1, 8)) * np.array([0.0, 1] * 4)
    >>> *_, (_, whole) = stream(StoreSource(Samples.from_array(x)))
    >>> image_panel(View(), {"noise": whole}, ["Y"]).notes
    ['50\xa0% null · filled: samples, dashed: means of pixels']
    """
    lines, notes = list[Trace](), list[str]()
    for k, (name, overall) in enumerate(overalls.items()):
        color = RENDER_COLORS[k % 6] if len(overalls) > 1 else BLENDED
        outline = _image_outline(view.channel, overall, len(channels))
        if outline[0].size:
            lines.append(Trace(*outline, color, fill=True))
            good = float(np.nansum(overall.good_count))
            nulls = float(np.nansum(overall.null_share * overall.good_count)) / good
            notes.append(f"{f'{name}: ' if len(overalls) > 1 else ''}{percent(nulls)} null")
        row = row_of(view.channel, (*channels, "luminance") if len(channels) > 1 else channels)
        mean = overall.mean if row < len(channels) else luminance(overall.mean, channel_axis=-1)
        mean = mean[..., row] if row < len(channels) else mean
        counts = np.histogram(mean[np.isfinite(mean) & (mean > 0)], BINS)[0]
        means = _per_decade(counts)
        if means[0].size:
            lines.append(Trace(*means, color, "6 4", 1.6))
    if len(lines) > 1:
        notes.append("filled: samples, dashed: means of pixels")
    return PanelData(lines, notes=[" · ".join(notes)] if notes else ["no samples of the image yet"])


def _image_outline(channel: str, overall: Overall, channels: int) -> tuple[Array, Array]:
    """Return the outline of the density of all samples of an image; empty without any."""
    row = -1 if channel in ("all", "luminance") or channels == 1 else int(channel)
    return _per_decade(overall.histogram[row, 1:-1])


def _per_decade(counts: Array) -> tuple[Array, Array]:
    total = counts.sum()
    if not total:
        return np.empty(0), np.empty(0)
    # Few samples close to 0 would make an axis of many decades.
    density = np.where(counts.cumsum() > _RARE * total, counts / total, 0) * (len(counts) / 24)
    return _steps(BINS, density)


def beside(panel: PanelData, overall: Overall, series: Sequence[_Series]) -> PanelData:
    """Return the log histogram of a region with that of the whole image, dotted."""
    around, own = [], np.concatenate([np.empty(0), *(line.x for line in panel.lines)])
    low, high = own.min(initial=np.inf), own.max(initial=0.0)
    for s in {s.row: s for s in series}.values():
        channel = str(s.row) if s.row < len(s.place.channels) else "luminance"
        x, y = _image_outline(channel, overall, len(s.place.channels))
        inside = (x >= low) & (x <= high)
        around.append(Trace(x[inside], y[inside], s.color, "2 4", 1.4))
    return replace(panel, lines=[*panel.lines, *around], notes=[*panel.notes, "dotted: the image"])


# --- the table ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _PanelKind:
    """A row of `PANELS`.

    Attributes
    ----------
    title, x, y
        Text above the panel and along its axes.
    draw
        Returns what it draws of the series of a view; None for what draws the whole image.
    x_scale, y_scale
        Scales of the axes.
    from_zero
        Whether it stands on the axis, as densities do.
    """

    title: str
    x: str
    y: str
    draw: Callable[[View, Sequence[_Series]], PanelData] | None
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"
    from_zero: bool = False


PANELS = {
    "log": _PanelKind(
        "Log10 histogram", "radiance", "density per decade", partial(_histograms, "log"), "log",
        from_zero=True,
    ),
    "linear": _PanelKind(
        "Linear histogram", "radiance", "density", partial(_histograms, "linear"), from_zero=True
    ),
    "qq": _PanelKind("Quantiles", "quantiles of the family", "of the samples", _qq, "log", "log"),
    "running": _PanelKind("Running mean", "spp", "radiance", _running, "log"),
    "averages": _PanelKind(
        "Averages of N samples", "radiance", "density", _averages, from_zero=True
    ),
    "image": _PanelKind(
        "Histogram of the image", "radiance", "density per decade", None, "log", from_zero=True
    ),
}  # fmt: skip


def panels(
    view: View, series: Sequence[_Series], step: Callable[[], None] = lambda: None
) -> dict[str, PanelData]:
    """Return all panels by name; `step` is called before each, and may raise to end it."""
    found = {}
    for name, kind in PANELS.items():
        step()
        if kind.draw:
            found[name] = kind.draw(view, series)
    return found


# --- figures, and how what they draw travels to the page ----------------------------------------

_TEXTS = ("x", "y", "text", "color", "align", "offset")
"""Columns of labels."""
_LETTERS = 42
"""Characters that there is room for at most along a logarithmic axis."""


def panel_plot(name: str) -> tuple[Any, list[models.Model]]:
    """Return a plot of areas, lines and labels, and what the shell fills of it.

    That is: the sources of these three, the ranges across and up, axes, grids, and the plot.
    """
    kind = PANELS[name]
    ranges = models.Range1d(0.1, 1), models.Range1d(0.1, 1)
    plot: Any = figure(
        name=name,
        x_axis_type=kind.x_scale,
        y_axis_type=kind.y_scale,
        x_range=ranges[0],
        y_range=ranges[1],
        x_axis_label=kind.x,
        y_axis_label=kind.y,
        tools="",
        toolbar_location=None,
        sizing_mode="stretch_both",
        min_border_left=48,
        min_border_right=12,
        min_border_top=4,
        min_border_bottom=40,  # of an axis and its labels, which long ones may cut off else
        background_fill_color=GROUND,
        border_fill_color=None,
        outline_line_color=_LINES,
    )
    _style(plot)
    columns = (("xs", "ys", "color"), ("xs", "ys", "color", "dash", "width"), _TEXTS)
    sources = [models.ColumnDataSource({name: [] for name in names}) for names in columns]
    areas, lines, texts = sources
    plot.patches("xs", "ys", source=areas, color="color", fill_alpha=0.2, line_alpha=0)
    plot.multi_line(
        "xs", "ys", source=lines, line_color="color", line_dash="dash", line_width="width"
    )
    plot.text(
        "x", "y", "text", source=texts, text_color="color", text_align="align", x_offset="offset",
        text_font_size="11px", y_offset=-1,
    )  # fmt: skip
    return plot, [*sources, *ranges, plot.xaxis[0], plot.yaxis[0], *plot.grid, plot]


def _style(plot: Any) -> None:
    """Give both axes our look; what their labels are, ``page.js`` says."""
    plot.grid.grid_line_color = "#2c2f34"
    for axis, ticks, most in ((plot.xaxis[0], 5, 6), (plot.yaxis[0], 4, 8)):
        across = axis is plot.xaxis[0]
        args: dict[str, Any] = {"across": across, "most": most}
        axis.ticker.desired_num_ticks = ticks
        if isinstance(axis, models.LogAxis):
            args["most"] = _LETTERS
            code = "return window.chdstat.logTicks(cb_data, plot, across)"
            given = {"across": across, "plot": plot}
            axis.ticker = models.CustomJSTicker(major_code=code, args=given)
        label = "return window.chdstat.tickLabel(tick, index, ticks, across, most)"
        axis.update(
            formatter=models.CustomJSTickFormatter(code=label, args=args),
            axis_label_text_color=FAINT,
            axis_label_text_font_size="11px",
            axis_label_text_font_style="normal",
            axis_label_standoff=2,
            major_label_text_color=TEXT,
            major_label_text_font="monospace",
            major_label_text_font_size="10.5px",
            major_tick_line_color=FAINT,
            minor_tick_line_color=None,
            axis_line_color=_LINES,
        )


def encode_panels(panels: Mapping[str, PanelData]) -> dict[str, Any]:
    """Return panels as one piece of text: a hundred small arrays would be as many messages.

    All numbers are one array of float64 in base64; traces say how many of them are theirs, x before
    y.
    """
    numbers: list[npt.NDArray[np.float64]] = [np.empty(0)]
    found = {}
    for name, panel in panels.items():
        (left, right), (bottom, top) = extent(name, panel) or ((0, 1), (0, 1))
        ends = {"left": (left, 4), "right": (right, -4)}
        texts = [
            (ends[at][0], y, text, color, at, ends[at][1])
            if isinstance(at, str)
            else (at, y, text, color, "center", 0)
            for at, y, text, color in panel.texts
        ]
        numbers += [np.asarray(v, np.float64) for t in panel.lines for v in (t.x, t.y)]
        found[name] = {
            "lines": [
                {"n": len(t.x), "color": t.color, "dash": t.dash, "width": t.width, "fill": t.fill}
                for t in panel.lines
            ],
            "texts": {column: [row[i] for row in texts] for i, column in enumerate(_TEXTS)},
            "extent": ((left, right), (bottom, top)),
            "empty": not panel.lines,
            "rows": panel.rows,
            "own_x": panel.own_x,
            "y": panel.y or PANELS[name].y,
        }
    whole = np.concatenate(numbers).tobytes()
    return {"panels": found, "numbers": base64.b64encode(whole).decode("ascii")}


_MARGIN = 0.04
_NUMBERS, _LABELS, _BELOW = 0.06, 0.36, 0.15
"""Room for the numbers of rows and for their labels, of the room for the densities, and below."""
_TINY = 1e-300


def extent(name: str, panel: PanelData) -> tuple[_Extent, _Extent] | None:
    """Return what a panel shows across and up: all that it draws, and a margin; None for nothing.

    Examples
    --------
    >>> line = Trace(np.array([0.0, 10.0]), np.array([1.0, 2.0]), "#ffffff")
    >>> extent("linear", PanelData(lines=[line]))
    ((0.0, 10.4), (0.0, 2.08))
    """
    kind = PANELS[name]
    across = _span([t.x for t in panel.lines], kind.x_scale)
    up = _span([t.y for t in panel.lines], kind.y_scale)
    if across is None or up is None:
        return None
    if panel.own_x:
        return (-_NUMBERS, 1 + _NUMBERS), (-_BELOW - _OF_AXIS, panel.rows)
    if panel.rows:  # room for labels at both sides
        low, high = np.log10(_padded(across, "log"))
        ends = low - _NUMBERS * (high - low), high + _LABELS * (high - low) / 2
        return (float(10.0 ** ends[0]), float(10.0 ** ends[1])), (-_BELOW, panel.rows)
    vertical = (0.0, up[1] * (1 + _MARGIN)) if kind.from_zero else _padded(up, kind.y_scale)
    left, right = _padded(across, kind.x_scale)
    return (max(left, 0.0) if across[0] >= 0 else left, right), vertical


def _span(parts: Iterable[npt.ArrayLike], scale: str) -> _Extent | None:
    whole = np.concatenate([np.empty(0), *(np.asarray(part, np.float64) for part in parts)])
    shown = whole[np.isfinite(whole) & ((whole > _TINY) if scale == "log" else True)]
    return (float(shown.min()), float(shown.max())) if shown.size else None


def _padded(span: _Extent, scale: str) -> _Extent:
    """Return a span with a margin; one value alone gets a tenth, or a factor of two, around it."""
    low, high = np.log10(span) if scale == "log" else span
    alone = np.log10(2) if scale == "log" else 0.1 * abs(low) or 1.0
    margin = _MARGIN * (high - low) if high > low else alone
    ends = np.array([low - margin, high + margin])
    start, end = 10.0**ends if scale == "log" else ends
    return float(start), float(end)
