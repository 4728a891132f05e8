"""Tables: the numbers of a selection as text, ready for a page.

For one place, a table has a column per channel; for several pixels, a column per pixel.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat import inference
from chdstat._core.arrays import Floats
from chdstat._core.display import number, percent, reasons, with_error, with_interval
from chdstat.comparison import DEFAULT_ESTIMATORS
from chdstat.errors import Reason
from chdstat.explorer.estimators import PlaceEstimates
from chdstat.explorer.place import (
    HOLDS,
    MOST_TESTED,
    RESAMPLES,
    PlaceStatistics,
    error_bar,
)
from chdstat.inference.differences import Difference
from chdstat.patterns import PATTERNS, Label, Pattern, Thresholds
from chdstat.viz.styling import called, estimator_name

_ERROR = 0.01
"""Relative error of the mean that the headline counts the samples for."""
_UNKNOWN = np.full(2, np.nan)
"""Ends of an interval that is not known."""
_FIRST = 7
"""Rows of the table of estimates that are shown at once: the default ones and some others."""

_Column = tuple[str, PlaceStatistics, int]
"""Title, place and row of a column."""
Table = dict[str, Any]
"""``columns``: titles; ``rows``: cells of text, and one more where a row has a tooltip; ``title``;
``note``: a line below; ``first``: how many rows are shown at once, where not all are."""


def columns_of(places: Sequence[PlaceStatistics], channel: str) -> list[_Column]:
    """Return the rows of one place, or one row of each of several."""
    if len(places) == 1:
        return [(name, places[0], i) for i, name in enumerate(places[0].names)]
    row = "luminance" if channel == "all" else channel
    return [(f"pixel {i + 1}", place, place.row(row)) for i, place in enumerate(places)]


def headline(place: PlaceStatistics) -> list[tuple[str, str, str]]:
    """Return title, value and detail of the five numbers that matter most, of luminance."""
    moments, tail, modes = place.moments, place.tail, place.modes
    mean, error = (float(values[-1]) for values in (moments.mean, moments.standard_error))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.divide(error, mean) if mean > 0 else np.nan
    needed = float(place.spp * (share / _ERROR) ** 2)
    constant, holds = bool(place.constant[-1]), _error_bar(place, -1)
    told = f"error bar of {place.fitted_spp} spp: {holds}"
    if constant or holds == "—":
        told = "constant samples" if constant else "too few samples"
    clear = {"fails": "at least: the error bar fails", "cannot tell": "if the error bar holds"}
    count = int(modes.modes[-1])
    low, high = map(percent, map(float, place.patterns.intervals["null_heavy"]))
    xi = float(tail.xi[-1])
    return [
        ("Mean luminance", number(mean), f"standard error {number(error)} ({percent(share)})"),
        ("Null samples", percent(place.null_share), f"{low} to {high}"),
        ("Tail index", "—" if constant else number(xi), told),
        (
            "Modes",
            "—" if constant or not count else str(count),
            "constant samples" if constant else f"p of one mode {as_p(modes.dip_p_value[-1])}",
        ),
        ("Spp for 1 % error", _count(needed), clear.get(holds, f"{place.spp} are here")),
    ]


def why(place: PlaceStatistics) -> tuple[str, str]:
    """Return the first pattern of a place, and what causes it."""
    label = Label(int(place.patterns.label))
    return called(label.name.lower()), label.meaning


def statistics_table(columns: Sequence[_Column]) -> Table:
    """Return moments, parameters, tail, dip and tests."""
    rows = [
        [title, *("—" if fitted and p.constant[i] else text(p, i) for _, p, i in columns)]
        for title, text, fitted in _STATISTICS
    ]
    place = max((place for _, place, _ in columns), key=lambda p: p.spp)
    cut = place.fitted_spp < place.spp
    note = f"fits and tests: the first {place.fitted_spp} of {place.spp} samples" if cut else ""
    return _table("Statistics", ["statistic", *(title for title, _, _ in columns)], rows, note)


def patterns_table(columns: Sequence[_Column]) -> Table:
    """Return every pattern with its threshold and its value, filled where its flag is set.

    Each row has one cell more than there are columns: what is measured, and its test.
    """
    places = list({id(place): place for _, place, _ in columns}.values())
    rows = []
    for pattern in PATTERNS:
        name = called(pattern.name)
        limit = pattern.limit.format(**vars(Thresholds())).replace("%", "\u00a0%")
        values = [_pattern_value(pattern, place, alone=len(places) == 1) for place in places]
        says = [pattern.meaning] if len(places) == 1 else []
        tip = f"{pattern.statistic}. Set where {pattern.rule}."
        p = places[0].patterns.p_values.get(pattern.name)
        if p is not None and len(places) == 1:
            tip += f" p of its absence: {as_p(float(p))}."
        rows.append([name, *says, *values, limit, tip])
    if len(places) == 1:
        titles, label = ["what it says", "value"], f"Patterns: {why(places[0])[0]}"
    else:
        titles, label = [title for title, _, _ in columns], "Patterns"
    note = "of luminance; ● is set, ○ is not, each at the 5 % level of one pixel"
    if any(place.is_firefly for place in places):
        note += "; tails, modes and families without the largest sample where it dominates"
    return {**_table(label, ["pattern", *titles, "threshold"], rows, note), "words": True}


def _pattern_value(pattern: Pattern, place: PlaceStatistics, *, alone: bool) -> str:
    found, text = place.patterns, percent if "%" in pattern.limit else number
    value = float(found.statistics[pattern.name])
    interval = found.intervals.get(pattern.name, _UNKNOWN) if alone else _UNKNOWN
    hidden = place.constant[-1] and pattern.name not in {"null_heavy", "constant"}
    low, high = map(float, interval)
    shown = "—" if hidden else with_interval(value, low, high, text)
    return f"{'●' if found.flags[pattern.name] else '○'}\N{NO-BREAK SPACE}{shown}"


def estimates_table(
    found: Sequence[PlaceEstimates],
    channels: Sequence[str],
    n: int,
    note: str = "",
    *,
    given: Sequence[str] = (),
) -> Table:
    """Return what every estimator gives: the mean over the batches, and how far these scatter.

    The default estimators come first, in their order, then the `given` ones, with which the page
    was opened, then the others.
    """
    rows = []
    for estimates in sorted(found, key=partial(_rank, given)):
        name, values = estimator_name(estimates.name), estimates.values.astype(np.float64)
        if estimates.certainty is not None:
            name = f"{name}, {percent(float(np.nanmean(estimates.certainty)))} certain"
        of_channels = ([v for v in channel if np.isfinite(v)] for channel in values.T)
        rows.append([name, *map(_mean_and_scatter, of_channels)])
    about = "mean over the batches ± their standard deviation"
    note = "; ".join(filter(None, (about, note))) if rows else f"too few samples for batches of {n}"
    table = _table(f"Estimates from {n} samples", ["estimator", *channels], rows, note)
    return {**table, "first": _FIRST}


def _mean_and_scatter(values: Sequence[float]) -> str:
    if not values:
        return "—"
    return with_error(float(np.mean(values)), statistics.stdev(values) if values[1:] else math.nan)


def _rank(given: Sequence[str], estimates: PlaceEstimates) -> int:
    # An image without features has the denoised mean without them.
    order = [name.removesuffix(" features") for name in DEFAULT_ESTIMATORS]
    order += given
    name = estimates.name.removesuffix(" features")
    return order.index(name) if name in order else len(order)


def goodness_table(
    place: PlaceStatistics, found: Mapping[str, tuple[Floats, Floats, npt.NDArray[np.int8]]]
) -> Table:
    """Return the p-value and the misfit of every family, one column for each row of the place."""
    rows = []
    for family, (p_value, distance, reason) in found.items():
        reason = np.where(place.constant, Reason.CONSTANT, reason)
        p_value = np.where(place.constant, np.nan, p_value)
        cells = map(_goodness, p_value, distance, reason)
        rows.append([called(family), *cells])
    note = (
        f"p-values of A² from {RESAMPLES} replicates, fitted as the samples were, and the "
        f"largest gap D; the first {min(place.spp, MOST_TESTED)} samples"
    )
    return _table("Goodness of fit", ["family", *place.names], rows, note)


def _goodness(p: float, distance: float, reason: int) -> str:
    if np.isfinite(p):
        return f"{as_p(p)} (D {number(distance)})"
    return reasons(reason)


def compared_table(found: Difference, channels: Sequence[str], names: tuple[str, str]) -> Table:
    """Return the distances between the CHDs of two stores, and their significance."""
    measures = {
        "Kolmogorov–Smirnov distance": (found.distance, number),
        "Wasserstein distance": (found.wasserstein, number),
        "difference of means": (found.mean_difference, number),
        "  over its standard error": (found.mean_t, number),
        "  p of equal means": (found.mean_p_value, as_p),
    }
    rows = [[title, *map(text, map(float, values))] for title, (values, text) in measures.items()]
    samples = f"{found.n[0]} and {found.n[1]} samples"
    if found.paired:
        samples = f"{found.n[0]} pairs of samples with the same random numbers"
    p = as_p(float(found.p_value))
    note = f"p of equal CHDs, all channels together: {p} (permutation test; {samples})"
    return _table(f"{names[1]} against {names[0]}", ["measure", *channels], rows, note)


def light_table(title: str, rows: Sequence[Mapping[str, str | float]]) -> Table:
    """Return the shares of light by the length of paths or by light, as `Pixel` has them."""
    columns = ["of the luminance", *list(rows[0])[1:]]
    cells = [
        [str(row["of"]), *(percent(float(share)) for share in list(row.values())[1:])]
        for row in rows
    ]
    return _table(title, columns, cells, "")


# --- cells --------------------------------------------------------------------------------------


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], note: str) -> Table:
    return {"title": title, "columns": columns, "rows": rows, "note": note}


def _family(place: PlaceStatistics, row: int) -> str:
    if place.constant[row]:
        return "constant"
    if place.fit("best", row) is None:
        return reasons(place.selection.reason[row] or Reason.TOO_FEW)
    return called(str(place.selection.names[row]))


def _parameters(place: PlaceStatistics, row: int) -> str:
    fit = place.fit("best", row)
    if fit is None:
        return "—"
    return "\n".join(f"{name} {number(float(v))}" for name, v in fit.parameters.items())


def _error_bar(place: PlaceStatistics, row: int) -> str:
    code = float(error_bar(place.tail)[row])
    return HOLDS[int(code)] if np.isfinite(code) else "—"


def _coverage(place: PlaceStatistics, row: int) -> str:
    tail = place.tail
    low, high = tail.coverage_own_interval[row]
    return with_interval(tail.coverage_own[row], low, high, percent)


def _needed(place: PlaceStatistics, row: int) -> str:
    means = place.means
    if means is None:
        return "—"
    needed = int(means.n_needed[row])
    beyond = {inference.MORE_THAN_TESTED: f"> {int(means.sizes[-1])}", 0: "—"}
    return beyond.get(needed, str(needed))


def _count(value: float) -> str:
    """Return a number of samples with two digits."""
    if not np.isfinite(value):
        return "—"
    rounded = float(f"{max(value, 1):.2g}")
    return f"{rounded:,.0f}".replace(",", "\u2009") if rounded < 1e7 else f"{rounded:.1e}"


def as_p(value: float) -> str:
    """Return a p-value; below 0.001 as a power of ten."""
    if not np.isfinite(value):
        return "—"
    if value == 0:  # too small for a float
        return "≈\u00a00"
    if value < 1e-3:
        return f"{value:.0e}".replace("-", "−").replace("e−0", "e−")
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}"


_STATISTICS: tuple[tuple[str, Callable[[PlaceStatistics, int], str], bool], ...] = (
    ("mean", lambda p, i: number(p.moments.seen(p.moments.mean)[i]), False),
    ("standard error", lambda p, i: number(p.moments.standard_error[i]), False),
    ("standard deviation", lambda p, i: number(np.sqrt(p.moments.variance[i])), False),
    ("skewness", lambda p, i: number(p.moments.skewness[i]), False),
    ("excess kurtosis", lambda p, i: number(p.moments.kurtosis[i]), False),
    ("largest", lambda p, i: number(p.moments.seen(p.moments.maximum)[i]), False),
    ("null samples", lambda p, _: percent(p.null_share), False),
    ("bad samples", lambda p, _: str(int(p.bad.sum())), False),
    ("best family by BIC", _family, False),
    ("parameters", _parameters, False),
    ("BIC margin", lambda p, i: number(p.selection.margin[i]), True),
    (
        "tail index ξ of all samples",
        lambda p, i: with_interval(p.tail.xi[i], *p.tail.interval[i]),
        True,
    ),
    ("p of a gamma tail", lambda p, i: as_p(p.tail.p_exponential[i]), True),
    ("error bar of so many spp", _error_bar, True),
    ("such 95 % error bars that hold", _coverage, True),
    ("modes", lambda p, i: str(p.modes.modes[i] or "—"), True),
    ("dip of log radiance", lambda p, i: number(p.modes.dip[i]), True),
    ("p of one mode (dip test)", lambda p, i: as_p(p.modes.dip_p_value[i]), True),
    (
        "p of log-normal (Anderson–Darling)",
        lambda p, i: as_p(p.gaussianity.p_value[i, 0, 0]),
        True,
    ),
    ("p of normal (Anderson–Darling)", lambda p, i: as_p(p.gaussianity.p_value[i, 1, 0]), True),
    (
        "p of gamma against log-normal (Vuong)",
        lambda p, i: as_p(p.selection.vuong_p_value[i]),
        True,
    ),
    ("N for Gaussian averages", _needed, False),
)
"""Title and text of each statistic of a row of a place, and whether constant samples have none."""
