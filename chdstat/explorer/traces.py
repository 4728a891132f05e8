"""Traces: what each panel draws of a selection, as plain arrays.

The density of a fit is that of the positive samples, as the histograms are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat.explorer.measured import Measured
from chdstat.explorer.palette import BLENDED, DASHES
from chdstat.explorer.series import Panel, Series, Trace
from chdstat.explorer.view import View
from chdstat.reporting.text import NAMES

__all__ = ["panels"]

_POINTS = 160
_QUANTILES = (np.arange(100) + 0.5) / 100
_Z = float(special.ndtri(0.975))

Floats = npt.NDArray[Any]
Scale = Literal["linear", "log"]


def panels(view: View, series: Sequence[Series]) -> dict[str, Panel]:
    """Return all panels by name: linear, log, qq, running, averages."""
    return {
        "linear": _histogram(view, series, "linear"),
        "log": _histogram(view, series, "log"),
        "qq": _qq(view, series),
        "running": _running(series),
        "averages": _averages(view, series),
    }


# --- histograms ---------------------------------------------------------------------------------


def _histogram(view: View, series: Sequence[Series], scale: Scale) -> Panel:
    areas, lines, marks = [], [], []
    for s in series:
        counted = s.measured.log if scale == "log" else s.measured.linear
        x, y = _steps(counted.edges, counted.density, s.row)
        if not x.size:
            continue
        if not s.other:
            areas.append(Trace(x, y, s.color, name=s.name))
            marks.append((float(s.measured.moments.mean[s.row]), s.color))
        lines.append(Trace(x, y, s.color, "dashed" if s.other else "solid", 1.2, s.name))
        if not s.other:
            lines += _fits(view, s, scale, x[0], x[-1], 1.3 * y.max())
    if scale == "log":
        marks = [mark for mark in marks if mark[0] > 0]
    return Panel(areas, lines, marks, _apart(series, scale))


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
        found = s.measured.positive(family, s.row)
        if found is None:
            continue
        with np.errstate(all="ignore"):
            y = found.pdf(x) * (x * np.log(10) if scale == "log" else 1)
        # A density may be infinite at 0: the histogram sets the height.
        y = np.where(np.isfinite(y), np.minimum(y, top), np.nan)
        if np.isfinite(y).any():
            dash = DASHES.get(found.family, "solid")
            lines.append(Trace(x, y, s.color, dash, 2.0, f"{s.name} {found.family}"))
    return lines


def _apart(series: Sequence[Series], scale: Scale) -> list[str]:
    """Return what is not in the bins: nulls, bad samples, those beyond the support."""
    groups = [
        list(dict.fromkeys(s.measured for s in series if s.other is other))
        for other in (False, True)
    ]
    if len(groups[0]) == 1 and not groups[1]:
        place = groups[0][0]
        return [f"{_counts(place)} · {_percent(_outside(series, scale))} outside"]
    notes = []
    for i, place in enumerate(groups[0]):
        text = f"{i + 1}: {_counts(place)}" if len(groups[0]) > 1 else _counts(place)
        notes.append(f"{text} (second: {_counts(groups[1][i])})" if groups[1] else text)
    return notes


def _counts(place: Measured) -> str:
    return f"{_percent(place.null_share)} null · {int(place.bad.sum())} bad"


def _outside(rows: Sequence[Series], scale: Scale) -> float:
    """Return the share of the samples that lie beyond the support of their histogram."""
    place = rows[0].measured
    counted = place.log if scale == "log" else place.linear
    outside = counted.underflow + counted.overflow
    return float(outside[[s.row for s in rows]].sum() / (len(rows) * place.spp))


def _percent(share: float) -> str:
    if not np.isfinite(share):
        return "—"
    return f"{100 * share:.3g} %"


# --- quantiles, averages ------------------------------------------------------------------------


def _qq(view: View, series: Sequence[Series]) -> Panel:
    """Draw quantiles of the positive samples against those of the first family that is switched on.

    Both axes are logarithmic, since the tails decide.
    """
    lines, ends = [], []
    families: dict[str, None] = {}
    for s in series:
        found = s.measured.positive(view.families[0] if view.families else "best", s.row)
        part, n = s.measured.part, int(s.measured.part.n[s.row])
        if found is None or n < 2:
            continue
        levels = _QUANTILES if n >= 100 else (np.arange(n) + 0.5) / n
        with np.errstate(all="ignore"):
            expected = np.asarray(found.ppf(levels), np.float64)
        ordered = part.sorted[s.row, :n].astype(np.float64)
        seen = ordered[np.minimum((levels * n).astype(int), n - 1)]
        keep = np.isfinite(expected) & (expected > 0) & (seen > 0)
        if keep.any():
            families[found.family] = None
            lines.append(
                Trace(
                    expected[keep],
                    seen[keep],
                    s.color,
                    "dashed" if s.other else "solid",
                    2.2,
                    s.name,
                )
            )
            ends += [seen[keep].min(), seen[keep].max()]
    if not lines:
        return Panel(notes=["no family could be fitted"])
    diagonal = np.array([min(ends), max(ends)])
    lines.insert(0, Trace(diagonal, diagonal, BLENDED, "dotted", 1.2, "equal"))
    names = [NAMES.get(family, family) for family in families]
    return Panel(lines=lines, notes=[f"against {', '.join(names)}"])


def _running(series: Sequence[Series]) -> Panel:
    areas, lines = [], []
    tails = []
    for s in series:
        at, means, errors = s.measured.running()
        if not at.size:
            continue
        mean, error = means[s.row], _Z * errors[s.row]
        if not s.other:
            band = np.concatenate([mean - error, (mean + error)[::-1]])
            areas.append(Trace(np.concatenate([at, at[::-1]]), band, s.color, name=s.name))
        lines.append(Trace(at, mean, s.color, "dashed" if s.other else "solid", 1.6, s.name))
        tails.append((s.measured.tail, s.row))
    doubt = ""
    if any(tail.variance_suspect[row] for tail, row in tails):
        doubt = " · tail index ≥ ½: do not trust it"
    elif any(tail.variance_unidentified[row] for tail, row in tails):
        doubt = " · samples cannot tell whether the variance is finite"
    return Panel(areas, lines, notes=[f"95 % interval of the mean{doubt}"])


def _averages(view: View, series: Sequence[Series]) -> Panel:
    """Draw the distribution of averages of N samples, with the Gaussian of the same moments."""
    areas, lines, notes = [], [], []
    beyond = 0.0
    for s in series:
        averages = s.measured.averages(view.batch)[s.row]
        averages = averages[np.isfinite(averages)]
        if len(averages) < 4:
            continue
        if averages.min() == averages.max():
            notes.append(f"{s.name}: all equal")
            continue
        edges = _edges_of_averages(averages)
        heights = np.histogram(averages, edges)[0] / (len(averages) * (edges[1] - edges[0]))
        beyond = max(beyond, float((averages > edges[-1]).mean()))
        x, y = np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])
        if not s.other:
            areas.append(Trace(x, y, s.color, name=s.name))
        lines.append(Trace(x, y, s.color, "dashed" if s.other else "solid", 1.2, s.name))
        if not s.other:
            lines.append(_gaussian(averages, edges, s))
            notes.append(_normality(s, view.batch))
    if not lines:
        notes = notes or [f"too few samples for averages of {view.batch}"]
    if beyond > 0:
        notes.append(f"{_percent(beyond)} beyond")
    return Panel(areas, lines, notes=[n for n in notes if n])


def _edges_of_averages(averages: Floats) -> Floats:
    """Return edges of bins up to the largest average, or to where few fireflies begin."""
    bins = int(np.clip(np.sqrt(len(averages)), 8, 40))
    low, usual, high = averages.min(), np.quantile(averages, 0.99), averages.max()
    end = min(high, usual + (usual - low)) if usual > low else high
    return np.linspace(low, end, bins + 1)


def _gaussian(averages: Floats, edges: Floats, s: Series) -> Trace:
    mean, sd = averages.mean(), averages.std(ddof=1)
    low, high = edges[0], edges[-1]
    x = np.linspace(max(low - sd, min(0.0, low)), min(high + sd, 2 * high - low), 120)
    y = np.exp(-(((x - mean) / sd) ** 2) / 2) / (sd * np.sqrt(2 * np.pi))
    return Trace(x, y, s.color, "dotted", 1.8, f"{s.name} Gaussian")


def _normality(s: Series, n: int) -> str:
    means = s.measured.means
    if means is None or n not in means.sizes:
        return ""
    p = float(means.p_value[s.row, list(means.sizes).index(n)])
    return f"{s.name} p = {p:.2g}" if np.isfinite(p) else ""
