"""Tables: numbers beside the panels, as text ready for a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.reasons import Reason
from chdstat.explorer.estimators import ScoredEstimate
from chdstat.explorer.statistics import FamilyGoodness, PlaceStatistics
from chdstat.fit.tail_fits import Tail
from chdstat.inference import MORE_THAN_TESTED
from chdstat.inference.differences import Difference
from chdstat.patterns import PATTERNS, Label
from chdstat.reporting.typst import NAMES, number, percent

__all__ = ["Table", "compared", "estimates", "goodness", "patterns", "statistics"]

Table = dict[str, Any]
"""``columns``: titles; ``rows``: cells of text; ``title``; ``note``: a line below."""

Array = npt.NDArray[Any]


def statistics(place: PlaceStatistics) -> Table:
    """Return moments, parameters, tail, dip and tests, one column for each channel."""
    moments = place.moments
    selection, tail, modes = place.selection, place.tail, place.modes
    normal, means = place.gaussianity, place.means
    rows = [
        _row("mean", moments.seen(moments.mean)),
        _row("standard error", moments.standard_error),
        _row("standard deviation", np.sqrt(moments.variance)),
        _row("skewness", moments.skewness),
        _row("excess kurtosis", moments.kurtosis),
        _row("largest", moments.seen(moments.maximum)),
        ["family (BIC)", *(_family(place, i) for i in range(len(place.names)))],
        ["parameters", *(_parameters(place, i) for i in range(len(place.names)))],
        _row("BIC margin", selection.margin),
        [
            "tail index ξ",
            *(_with_interval(x, i) for x, i in zip(tail.xi, tail.interval, strict=True)),
        ],
        _row("p of a gamma tail", tail.p_exponential, _p),
        ["finite variance", *(_is_finite(tail, i) for i in range(len(place.names)))],
        ["modes", *(str(int(m)) if m else "—" for m in modes.modes)],
        _row("dip of log", modes.dip),
        _row("p of one mode (dip)", modes.dip_p_value, _p),
        _row("p of log-normal (A²)", normal.p_value[:, 0, 0], _p),
        _row("p of normal (A²)", normal.p_value[:, 1, 0], _p),
        _row("Vuong's p, gamma / log-normal", selection.vuong_p_value, _p),
    ]
    if means is not None:
        rows.append(
            ["N needed (Gaussian averages)", *(_needed(n, means.sizes) for n in means.n_needed)]
        )
    cut = place.fitted_spp < place.spp
    note = f"fits and tests: the first {place.fitted_spp} of {place.spp} samples" if cut else ""
    return {
        "title": "Statistics",
        "columns": ["", *place.names],
        "rows": rows,
        "note": note,
        "summary": f"{place.spp} samples · {percent(place.null_share)} null · "
        f"{int(place.bad.sum())} bad",
    }


def patterns(place: PlaceStatistics) -> Table:
    """Return every pattern with its flag, the statistic that set it, its interval and p-value.

    Each row has one cell more than there are columns: what is measured.
    """
    found = place.patterns
    rows = []
    for pattern in PATTERNS:
        p = found.p_values.get(pattern.name)
        interval = found.intervals.get(pattern.name)
        value = number(float(found.statistics[pattern.name]))
        if interval is not None:
            value = _with_interval(float(found.statistics[pattern.name]), interval)
        rows.append(
            [
                "●" if found.flags[pattern.name] else "○",
                NAMES.get(pattern.name, pattern.name.replace("_", " ")),
                value,
                "—" if p is None else _p(float(p)),
                pattern.statistic,
            ]
        )
    label = Label(int(found.label)).name.lower().replace("_", " ")
    return {
        "title": f"Patterns: {label}",
        "columns": ["", "pattern", "statistic", "p"],
        "rows": rows,
        "note": "of luminance, each at the 5 % level of one pixel",
    }


def estimates(
    found: Sequence[ScoredEstimate], channels: Sequence[str], n: int, reference: str
) -> Table:
    """Return the estimate and the error of every estimator."""
    rows = [
        [
            _estimator(e),
            *_values(e),
            number(e.mse_ratio),
            percent(e.bias, sign=True),
            percent(e.improved),
        ]
        for e in found
    ]
    return {
        "title": f"Estimates from N = {n}",
        "columns": ["estimator", *channels, "MSE ratio", "bias", "improved"],
        "rows": rows,
        "note": reference if rows else f"too few samples for batches of {n}",
    }


def goodness(found: FamilyGoodness, rows: Sequence[str]) -> Table:
    """Return the p-value and the misfit of every family, one column for each row of the place."""
    cells = [
        [
            NAMES.get(family, family),
            *(f"{_p(float(v))} (D {number(float(d))})" for v, d in zip(p, distance, strict=True)),
        ]
        for family, p, distance in zip(found.families, found.p_value, found.distance, strict=True)
    ]
    note = (
        f"p-values of A² from {found.resamples} replicates, fitted as the samples were, and the "
        f"largest gap D; the first {found.n} samples"
    )
    return {"title": "Goodness of fit", "columns": ["family", *rows], "rows": cells, "note": note}


def compared(found: Difference, channels: Sequence[str], names: tuple[str, str]) -> Table:
    """Return the distances between the CHDs of two stores, and their significance."""
    rows = [
        ["Kolmogorov–Smirnov distance", *(number(v) for v in found.distance)],
        ["Wasserstein distance", *(number(v) for v in found.wasserstein)],
        ["difference of means", *(number(v) for v in found.mean_difference)],
        ["  over its standard error", *(number(v) for v in found.mean_t)],
        ["  p of equal means", *(_p(v) for v in found.mean_p_value)],
    ]
    note = (
        f"p of equal CHDs, all channels together: {_p(float(found.p_value))} (permutation test; "
        + (
            f"{found.n[0]} pairs of samples with the same random numbers)"
            if found.paired
            else f"{found.n[0]} and {found.n[1]} samples)"
        )
    )
    return {
        "title": f"{names[1]} against {names[0]}",
        "columns": ["", *channels],
        "rows": rows,
        "note": note,
    }


def _estimator(found: ScoredEstimate) -> str:
    name = NAMES.get(found.name, found.name.replace("_", " "))
    sure = found.certainty
    return f"{name}, {percent(sure)} certain" if np.isfinite(sure) else name


def _values(found: ScoredEstimate) -> list[str]:
    """Return the estimate of each channel, with its interval where there is one."""
    if found.low is None or found.high is None:
        return [number(float(v)) for v in found.value]
    ends = np.stack([found.low, found.high], axis=-1)
    return [
        _with_interval(float(v), e) if np.isfinite(e).all() else number(float(v))
        for v, e in zip(found.value, ends, strict=True)
    ]


def _row(title: str, values: Array, text: Callable[[float], str] = number) -> list[str]:
    return [title, *(text(float(v)) for v in values)]


def _family(place: PlaceStatistics, row: int) -> str:
    name = str(place.selection.names[row])
    if name:
        return NAMES.get(name, name)
    return Reason(int(place.selection.reason[row])).name.lower().replace("_", " ")


def _is_finite(tail: Tail, row: int) -> str:
    if tail.reason[row] != Reason.OK:
        return "—"
    if tail.variance_unidentified[row]:
        return "not identified"
    return "yes" if tail.variance_trusted[row] else "suspect"


def _parameters(place: PlaceStatistics, row: int) -> str:
    fit = place.fit("best", row)
    if fit is None:
        return "—"
    return ", ".join(f"{name} {number(float(v))}" for name, v in fit.parameters.items())


def _with_interval(value: float, interval: Array) -> str:
    if not np.isfinite(value):
        return "—"
    low, high = (number(float(v)) for v in interval)
    return f"{number(float(value))} [{low}, {high}]"


def _needed(n: int, sizes: Array) -> str:
    if n == MORE_THAN_TESTED:
        return f"> {int(sizes[-1])}"
    return str(int(n)) if n else "—"


def _p(value: float) -> str:
    """Return a p-value; below 0.001 as a power of ten."""
    if not np.isfinite(value):
        return "—"
    if value == 0:  # too small for a float
        return "≈\u00a00"
    if value < 1e-3:
        return f"{value:.0e}".replace("-", "−").replace("e−0", "e−")
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}"
