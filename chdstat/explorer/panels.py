"""Panels: what each plot draws of a selection, as plain arrays.

The density of a fit is that of the positive samples, as the histograms are. Densities of several
pixels stand above each other, one row for each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from chdstat._core.arrays import Array
from chdstat._core.display import number
from chdstat._core.resampling import Z_95
from chdstat.explorer.plots import BLENDED, DASHES, PanelData, Series, Trace
from chdstat.explorer.statistics import PlaceStatistics
from chdstat.explorer.view import View
from chdstat.viz.estimators import NAMES

__all__ = ["panels"]


_POINTS = 160
_QUANTILES = (np.arange(100) + 0.5) / 100
_ROW_HEIGHT = 0.78
"""Of a density among others, of the distance between rows."""


def panels(view: View, series: Sequence[Series]) -> dict[str, PanelData]:
    """Return all panels by name: linear, log, qq, running, averages.

    Densities of several pixels stand above each other, each over its own peak: on one axis the
    narrowest would flatten the others to a line.
    """
    return {
        "linear": _densities(series, partial(_histogram, view, "linear"), "linear"),
        "log": _densities(series, partial(_histogram, view, "log"), "log"),
        "qq": _qq(view, series),
        "running": _running(series),
        "averages": _densities(series, partial(_averages, view.batch), "averages"),
    }


# --- densities ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Density:
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
    series: Sequence[Series], density: Callable[[Series], Density], name: str
) -> PanelData:
    """Draw densities upon each other, or each pixel in a row of its own."""
    found = [(s, density(s)) for s in series]
    rows = max((s.pixel for s in series), default=0)
    own_x = rows > 0 and name != "log"
    if not rows:
        notes = _uncounted(series, name) if name != "averages" else []
        notes += dict.fromkeys(d.note for _, d in found if d.note)
        beyond = max((d.beyond for _, d in found), default=0.0)
        notes += [f"{_percent(beyond)} beyond"] if beyond > 0 else []
        values = [f"{s.name} {number(d.value)}" for s, d in found if d.value is not None]
        notes += [f"constant: {', '.join(values)}"] if values else []
        return replace(_row(found, None, own_x=False), notes=notes)
    parts = [
        _row([f for f in found if f[0].pixel == i + 1], rows - 1 - i, own_x=own_x)
        for i in range(rows)
    ]
    note = "each density over its peak" + (", on an axis of its own" if own_x else "")
    return PanelData(
        [area for part in parts for area in part.areas],
        [line for part in parts for line in part.lines],
        [mark for part in parts for mark in part.marks],
        [text for part in parts for text in part.texts],
        notes=[note],
        rows=rows,
        own_x=own_x,
    )


def _row(group: Sequence[tuple[Series, Density]], base: int | None, *, own_x: bool) -> PanelData:
    """Draw densities with a common axis, above a base line where there are several rows."""
    outlines = [(s, *d.outline) for s, d in group if d.outline is not None]
    peak = max((float(y.max()) for _, _, y in outlines), default=1.0) or 1.0
    spikes = [(s, d.value) for s, d in group if d.value is not None]
    ends = [x for _, x, _ in outlines] + [np.array([value]) for _, value in spikes]
    if not ends:
        return PanelData(texts=_labels(group, base, None))
    whole = np.concatenate(ends)
    low, high = float(whole.min()), float(whole.max())

    def across(x: Array) -> Array:
        return (x - low) / (high - low) if high > low else np.full_like(x, 0.5)

    def put(x: Array, y: Array, *look: Any) -> Trace:
        x = across(x) if own_x else x
        return Trace(x, y if base is None else base + _ROW_HEIGHT * y / peak, *look)

    areas, lines, marks = [], [], []
    for s, x, y in outlines:
        lines.append(put(x, y, s.color, s.dash, 1.2))
        areas += [] if s.other else [put(x, y, s.color)]
    for s, d in group:
        top = 1.2 * peak if base is not None else np.inf
        for curve in d.curves:
            inside = (curve.x >= low) & (curve.x <= high) | (not own_x)
            height = np.minimum(curve.y, top)[inside]
            lines.append(put(curve.x[inside], height, s.color, curve.dash, curve.width))
        if np.isfinite(d.mean) and d.value is None:
            at = float(across(np.array(d.mean))) if own_x else d.mean
            feet = (None, None) if base is None else (base, base + _ROW_HEIGHT)
            marks.append((at, *feet, s.color))
    # Nearly equal samples have no density to speak of: a spike says where they are.
    for s, value in spikes:
        lines.append(put(np.full(2, value), np.array([0.0, peak]), s.color, s.dash, 3.0))
    return PanelData(areas, lines, marks, _labels(group, base, (low, high) if own_x else None))


def _labels(
    group: Sequence[tuple[Series, Density]], base: int | None, span: tuple[float, float] | None
) -> list[tuple[str, float, str, str]]:
    """Return the number of a pixel, and the range of its row or the share of its nulls."""
    if base is None or not group:
        return []
    s = group[0][0]
    note = f"{_percent(s.place.null_share)} null"
    if span is not None:
        note = " – ".join(dict.fromkeys(number(end) for end in span))
    # Above the upper tail, where there is room.
    above = base + 0.7 * _ROW_HEIGHT
    return [("left", base, str(s.pixel), s.color), ("right", above, note, s.color)]


def _histogram(view: View, scale: str, s: Series) -> Density:
    if s.constant is not None:
        return Density(value=s.constant)
    counted = s.place.histograms[scale]
    x, y = _steps(counted.edges, counted.density, s.row)
    if not x.size:
        return Density()
    if s.other:
        return Density((x, y))
    mean = float(s.place.moments.mean[s.row])
    mean = mean if scale == "linear" or mean > 0 else float("nan")
    return Density((x, y), _fits(view, s, scale, x[0], x[-1], 1.3 * y.max()), mean)


def _steps(edges: Array, density: Array, row: int) -> tuple[Array, Array]:
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


def _fits(view: View, s: Series, scale: str, low: float, high: float, top: float) -> list[Trace]:
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


def _uncounted(series: Sequence[Series], scale: str) -> list[str]:
    """Return what is not in the bins: nulls, bad samples, those beyond the support."""
    if not series:
        return []
    place, second = series[0].place, series[-1]
    if second.other:
        return [f"{_counts(place)} (second: {_counts(second.place)})"]
    counted, rows = place.histograms[scale], [s.row for s in series]
    outside = (counted.underflow + counted.overflow)[rows].sum() / (len(rows) * place.spp)
    return [f"{_counts(place)} · {_percent(outside)} outside the bins"]


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
        constant = all(s.constant is not None for s in series)
        return PanelData(notes=["constant samples" if constant else "no family could be fitted"])
    diagonal = np.array([min(ends), max(ends)])
    lines.insert(0, Trace(diagonal, diagonal, BLENDED, "dotted", 1.2))
    names = [NAMES.get(family, family) for family in families]
    return PanelData(lines=lines, notes=[f"against {', '.join(names)}"])


def _running(series: Sequence[Series]) -> PanelData:
    areas, lines, tails = [], [], []
    several = any(s.pixel for s in series)
    for s in series:
        at, means, errors = s.place.running
        if not at.size:
            continue
        mean, error = means[s.row], Z_95 * errors[s.row]
        if several and mean[-1] > 0:
            mean, error = mean / mean[-1], error / mean[-1]
        if not s.other:
            band = np.concatenate([mean - error, (mean + error)[::-1]])
            areas.append(Trace(np.concatenate([at, at[::-1]]), band, s.color))
        lines.append(Trace(at, mean, s.color, s.dash, 1.6))
        tails += [(s.place.fits.tail, s.row)] if s.constant is None else []
    caution = ""
    if any(tail.variance_suspect[row] for tail, row in tails):
        caution = " · tail index ≥ ½: do not trust it"
    elif any(tail.variance_unidentified[row] for tail, row in tails):
        caution = " · too few samples to say whether the variance is finite"
    y = "over the mean of all" if several else ""
    return PanelData(areas, lines, notes=[f"95 % interval of the mean{caution}"], y=y)


def _averages(n: int, s: Series) -> Density:
    """Return the distribution of averages of N samples, with the Gaussian of the same moments."""
    averages = s.place.averages(n)[s.row]
    averages = averages[np.isfinite(averages)]
    if len(averages) < 4:
        return Density(note=f"too few samples for averages of {n}")
    if averages.min() == averages.max() or (s.constant is not None and not s.place.null.any()):
        return Density(value=float(averages[0]))
    # Bins go up to the largest average, or to where few fireflies begin.
    bins = int(np.clip(np.sqrt(len(averages)), 8, 40))
    low, usual, high = averages.min(), np.quantile(averages, 0.99), averages.max()
    end = min(high, usual + (usual - low)) if usual > low else high
    edges = np.linspace(low, end, bins + 1)
    heights = np.histogram(averages, edges)[0] / (len(averages) * (edges[1] - edges[0]))
    outline = np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])
    if s.other:
        return Density(outline)
    means, note = s.place.means, ""
    if means is not None and n in means.sizes:
        p = float(means.p_value[s.row, list(means.sizes).index(n)])
        note = f"{s.name} p = {p:.2g}" if np.isfinite(p) else ""
    beyond = float((averages > end).mean())
    return Density(outline, [_gaussian(averages, edges, s.color)], note=note, beyond=beyond)


def _gaussian(averages: Array, edges: Array, color: str) -> Trace:
    mean, sd = averages.mean(), averages.std(ddof=1)
    low, high = edges[0], edges[-1]
    x = np.linspace(max(low - sd, min(0.0, low)), min(high + sd, 2 * high - low), 120)
    y = np.exp(-(((x - mean) / sd) ** 2) / 2) / (sd * np.sqrt(2 * np.pi))
    return Trace(x, y, color, "dotted", 1.8)
