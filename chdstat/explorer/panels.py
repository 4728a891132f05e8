"""Panels: the lines and areas that each plot draws of a selection, as plain arrays.

One place shows its channels, several places show luminance or one channel in a colour each. The
density of a fit is that of the positive samples, as the histograms are. The ranges of the axes are
computed here, since Bokeh's own data ranges send each of their changes to the server, eighteen
messages a click. Colours contrast with the dark ground by 4.5 to 1 or more (WCAG 2.2, AA).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.resampling import Z_95
from chdstat.explorer.statistics import PlaceStatistics
from chdstat.explorer.view import View
from chdstat.fit.families import FAMILIES
from chdstat.reporting.typst import NAMES

__all__ = [
    "BLENDED",
    "DASHES",
    "PANELS",
    "PIXEL_COLORS",
    "PanelData",
    "Trace",
    "extent",
    "panels",
    "series_of",
]

BLENDED = "#d0d3d6"
"""Luminance, and whatever is no channel."""
CHANNEL_COLORS = {"R": "#ff7b72", "G": "#56d18b", "B": "#79b8ff"}
PIXEL_COLORS = ("#f0b429", "#62c4f5", "#3fd0a4", "#e39ac8", "#f4ea5c", "#ff8f5e")
"""After Okabe and Ito (2008), lightened: colour-blind readers tell them apart."""
_PATTERNS = ("solid", "6 6", "2 4 6 4", "2 4", "12 4", "6 4 2 4 2 4", "12 4 2 4")
DASHES = {**dict(zip(FAMILIES, cycle(_PATTERNS), strict=False)), "mixture": "6 4 2 4"}
"""Line dashes of fits by name: lengths of lines and gaps, as Bokeh and SVG read them."""

Floats = npt.NDArray[Any]
Scale = Literal["linear", "log"]
Extent = tuple[float, float]


@dataclass(frozen=True)
class PanelKind:
    """A row of `PANELS`.

    Attributes
    ----------
    title, x, y
        Text above the panel and along its axes.
    x_scale, y_scale
        Scales of the axes.
    from_zero
        Whether it stands on the axis, as densities do.
    """

    title: str
    x: str
    y: str
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"
    from_zero: bool = False


PANELS = {
    "linear": PanelKind("Linear histogram", "radiance", "density", from_zero=True),
    "log": PanelKind("Log10 histogram", "radiance", "density per decade", "log", from_zero=True),
    "qq": PanelKind("Quantiles", "quantiles of the family", "of the samples", "log", "log"),
    "running": PanelKind("Running mean", "spp", "radiance", "log"),
    "averages": PanelKind("Averages of N samples", "radiance", "density", from_zero=True),
}


@dataclass(frozen=True)
class Trace:
    """A line, or the outline of an area.

    Attributes
    ----------
    x, y
        Vertices, shape (point,).
    color
        As "#rrggbb".
    dash
        Line dash in Bokeh's words.
    width
        In screen pixels.
    """

    x: Floats
    y: Floats
    color: str
    dash: str = "solid"
    width: float = 1.3


@dataclass(frozen=True)
class PanelData:
    """What one panel draws.

    Attributes
    ----------
    areas, lines
        Filled and drawn.
    marks
        x and colour of vertical lines.
    notes
        Text beside the title.
    """

    areas: Sequence[Trace] = ()
    lines: Sequence[Trace] = ()
    marks: Sequence[tuple[float, str]] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Series:
    """One row of samples that panels show.

    Attributes
    ----------
    place, row
        Where it comes from.
    color
        Of the channel or of the pixel.
    name
        As in the legend.
    other
        Whether it belongs to the store that is compared with: drawn as dashed outlines.
    """

    place: PlaceStatistics
    row: int
    color: str
    name: str
    other: bool

    @property
    def dash(self) -> str:
        """Dash of its lines."""
        return "dashed" if self.other else "solid"


def series_of(
    view: View, places: Sequence[PlaceStatistics], others: Sequence[PlaceStatistics] = ()
) -> list[Series]:
    """Return what the panels show of the selected places, those of a second store beside them."""
    found = []
    several = len(places) > 1
    for is_other, group in ((False, places), (True, others)):
        for i, place in enumerate(group):
            rows = [place.row("luminance" if view.channel == "all" else view.channel)]
            if view.channel == "all" and not several:
                rows = list(range(len(place.channels)))
            for row in rows:
                name, color = f"pixel {i + 1}", PIXEL_COLORS[i]
                if not several:
                    name = place.names[row]
                    color = CHANNEL_COLORS.get(name, BLENDED)
                found.append(Series(place, row, color, name, is_other))
    return found


_POINTS = 160
_QUANTILES = (np.arange(100) + 0.5) / 100


def panels(view: View, series: Sequence[Series]) -> dict[str, PanelData]:
    """Return all panels by name: linear, log, qq, running, averages."""
    return {
        "linear": _histogram(view, series, "linear"),
        "log": _histogram(view, series, "log"),
        "qq": _qq(view, series),
        "running": _running(series),
        "averages": _averages(view, series),
    }


# --- histograms ---------------------------------------------------------------------------------


def _histogram(view: View, series: Sequence[Series], scale: Scale) -> PanelData:
    areas, lines, marks = [], [], []
    for s in series:
        counted = s.place.histograms[scale]
        x, y = _steps(counted.edges, counted.density, s.row)
        if not x.size:
            continue
        lines.append(Trace(x, y, s.color, s.dash, 1.2))
        if not s.other:
            areas.append(Trace(x, y, s.color))
            marks.append((float(s.place.moments.mean[s.row]), s.color))
            lines += _fits(view, s, scale, x[0], x[-1], 1.3 * y.max())
    if scale == "log":
        marks = [mark for mark in marks if mark[0] > 0]
    return PanelData(areas, lines, marks, _uncounted(series, scale))


def _steps(edges: Floats, density: Floats, row: int) -> tuple[Floats, Floats]:
    """Return the outline of the occupied bins, from the axis up and down to it again."""
    # All rows of a log histogram share their edges.
    edges = edges[row] if edges.ndim > 1 else edges
    heights = density[row]
    filled = np.flatnonzero(np.nan_to_num(heights) > 0)
    if not filled.size or not np.isfinite(edges).all():
        return np.empty(0), np.empty(0)
    bins = slice(filled[0], filled[-1] + 1)
    x = np.repeat(edges[filled[0] : filled[-1] + 2], 2)
    return x, np.concatenate([[0.0], np.repeat(heights[bins], 2), [0.0]])


def _fits(view: View, s: Series, scale: Scale, low: float, high: float, top: float) -> list[Trace]:
    low = max(low, 1e-300)
    x = np.geomspace(low, high, _POINTS) if scale == "log" else np.linspace(low, high, _POINTS)
    lines = []
    for family in view.families:
        found = s.place.positive(family, s.row)
        if found is None:
            continue
        name, pdf, _ = found
        with np.errstate(all="ignore"):
            y = pdf(x) * (x * np.log(10) if scale == "log" else 1)
        # A density may be infinite at 0: the histogram sets the height.
        y = np.where(np.isfinite(y), np.minimum(y, top), np.nan)
        if np.isfinite(y).any():
            lines.append(Trace(x, y, s.color, DASHES[name], 2.0))
    return lines


def _uncounted(series: Sequence[Series], scale: Scale) -> list[str]:
    """Return what is not in the bins: nulls, bad samples, those beyond the support."""
    groups = [
        list(dict.fromkeys(s.place for s in series if s.other is other)) for other in (False, True)
    ]
    if len(groups[0]) == 1 and not groups[1]:
        place, rows = groups[0][0], [s.row for s in series]
        counted = place.histograms[scale]
        outside = (counted.underflow + counted.overflow)[rows].sum() / (len(rows) * place.spp)
        return [f"{_counts(place)} · {_percent(outside)} outside"]
    notes = []
    for i, place in enumerate(groups[0]):
        text = f"{i + 1}: {_counts(place)}" if len(groups[0]) > 1 else _counts(place)
        notes.append(f"{text} (second: {_counts(groups[1][i])})" if groups[1] else text)
    return notes


def _counts(place: PlaceStatistics) -> str:
    return f"{_percent(place.null_share)} null · {int(place.bad.sum())} bad"


def _percent(share: float) -> str:
    if not np.isfinite(share):
        return "—"
    return f"{100 * share:.3g} %"


# --- quantiles, averages ------------------------------------------------------------------------


def _qq(view: View, series: Sequence[Series]) -> PanelData:
    """Draw quantiles of the positive samples against those of the first family that is switched on.

    Both axes are logarithmic, since the tails decide.
    """
    lines, ends = [], []
    families: dict[str, None] = {}
    for s in series:
        found = s.place.positive(view.families[0] if view.families else "best", s.row)
        part = s.place.fits.part
        n = int(part.n[s.row])
        if found is None or n < 2:
            continue
        name, _, ppf = found
        levels = _QUANTILES if n >= 100 else (np.arange(n) + 0.5) / n
        with np.errstate(all="ignore"):
            expected = np.asarray(ppf(levels), np.float64)
        ordered = part.sorted[s.row, :n].astype(np.float64)
        seen = ordered[np.minimum((levels * n).astype(int), n - 1)]
        keep = np.isfinite(expected) & (expected > 0) & (seen > 0)
        if keep.any():
            families[name] = None
            lines.append(Trace(expected[keep], seen[keep], s.color, s.dash, 2.2))
            ends += [seen[keep].min(), seen[keep].max()]
    if not lines:
        return PanelData(notes=["no family could be fitted"])
    diagonal = np.array([min(ends), max(ends)])
    lines.insert(0, Trace(diagonal, diagonal, BLENDED, "dotted", 1.2))
    names = [NAMES.get(family, family) for family in families]
    return PanelData(lines=lines, notes=[f"against {', '.join(names)}"])


def _running(series: Sequence[Series]) -> PanelData:
    areas, lines = [], []
    tails = []
    for s in series:
        at, means, errors = s.place.running
        if not at.size:
            continue
        mean, error = means[s.row], Z_95 * errors[s.row]
        if not s.other:
            band = np.concatenate([mean - error, (mean + error)[::-1]])
            areas.append(Trace(np.concatenate([at, at[::-1]]), band, s.color))
        lines.append(Trace(at, mean, s.color, s.dash, 1.6))
        tails.append((s.place.fits.tail, s.row))
    caution = ""
    if any(tail.variance_suspect[row] for tail, row in tails):
        caution = " · tail index ≥ ½: do not trust it"
    elif any(tail.variance_unidentified[row] for tail, row in tails):
        caution = " · samples cannot tell whether the variance is finite"
    return PanelData(areas, lines, notes=[f"95 % interval of the mean{caution}"])


def _averages(view: View, series: Sequence[Series]) -> PanelData:
    """Draw the distribution of averages of N samples, with the Gaussian of the same moments."""
    areas, lines, notes = [], [], []
    beyond = 0.0
    for s in series:
        averages = s.place.averages(view.batch)[s.row]
        averages = averages[np.isfinite(averages)]
        if len(averages) < 4:
            continue
        if averages.min() == averages.max():
            notes.append(f"{s.name}: all equal")
            continue
        # Bins go up to the largest average, or to where few fireflies begin.
        bins = int(np.clip(np.sqrt(len(averages)), 8, 40))
        low, usual, high = averages.min(), np.quantile(averages, 0.99), averages.max()
        end = min(high, usual + (usual - low)) if usual > low else high
        edges = np.linspace(low, end, bins + 1)
        heights = np.histogram(averages, edges)[0] / (len(averages) * (edges[1] - edges[0]))
        beyond = max(beyond, float((averages > edges[-1]).mean()))
        x, y = np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])
        lines.append(Trace(x, y, s.color, s.dash, 1.2))
        if not s.other:
            areas.append(Trace(x, y, s.color))
            lines.append(_gaussian(averages, edges, s.color))
            means = s.place.means
            if means is not None and view.batch in means.sizes:
                p = float(means.p_value[s.row, list(means.sizes).index(view.batch)])
                notes += [f"{s.name} p = {p:.2g}"] if np.isfinite(p) else []
    if not lines:
        notes = notes or [f"too few samples for averages of {view.batch}"]
    if beyond > 0:
        notes.append(f"{_percent(beyond)} beyond")
    return PanelData(areas, lines, notes=[n for n in notes if n])


def _gaussian(averages: Floats, edges: Floats, color: str) -> Trace:
    mean, sd = averages.mean(), averages.std(ddof=1)
    low, high = edges[0], edges[-1]
    x = np.linspace(max(low - sd, min(0.0, low)), min(high + sd, 2 * high - low), 120)
    y = np.exp(-(((x - mean) / sd) ** 2) / 2) / (sd * np.sqrt(2 * np.pi))
    return Trace(x, y, color, "dotted", 1.8)


_MARGIN = 0.04
_TINY = 1e-300


def extent(name: str, panel: PanelData) -> tuple[Extent, Extent] | None:
    """Return what a panel shows across and up: all that it draws, and a margin; None for nothing.

    Examples
    --------
    >>> line = Trace(np.array([0.0, 10.0]), np.array([1.0, 2.0]), "#ffffff")
    >>> extent("linear", PanelData(lines=[line]))
    ((-0.4, 10.4), (0.0, 2.08))
    """
    kind, traces = PANELS[name], (*panel.areas, *panel.lines)
    marks = np.array([mark[0] for mark in panel.marks])
    across = _span([*(t.x for t in traces), marks], kind.x_scale)
    up = _span([t.y for t in traces], kind.y_scale)
    if across is None or up is None:
        return None
    vertical = (0.0, up[1] * (1 + _MARGIN)) if kind.from_zero else _padded(up, kind.y_scale)
    return _padded(across, kind.x_scale), vertical


def _span(parts: Iterable[npt.ArrayLike], scale: Scale) -> Extent | None:
    whole = np.concatenate([np.empty(0), *(np.asarray(part, np.float64) for part in parts)])
    shown = whole[np.isfinite(whole) & ((whole > _TINY) if scale == "log" else True)]
    return (float(shown.min()), float(shown.max())) if shown.size else None


def _padded(span: Extent, scale: Scale) -> Extent:
    """Return a span with a margin; one value alone gets a tenth, or a factor of two, around it."""
    low, high = np.log10(span) if scale == "log" else span
    alone = np.log10(2) if scale == "log" else 0.1 * abs(low) or 1.0
    margin = _MARGIN * (high - low) if high > low else alone
    ends = np.array([low - margin, high + margin])
    start, end = 10.0**ends if scale == "log" else ends
    return float(start), float(end)
