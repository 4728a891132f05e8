"""Tables: the numbers of a selection as text, ready for a page.

Of one place, a table has a column for each channel; of several pixels, one for each pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat import inference
from chdstat._core.arrays import Array, Floats
from chdstat._core.display import number, percent
from chdstat.comparison import DEFAULT_ESTIMATORS
from chdstat.errors import Reason
from chdstat.explorer.estimators import ScoredEstimate
from chdstat.explorer.statistics import MOST_TESTED, RESAMPLES, PlaceStatistics
from chdstat.inference.differences import Difference
from chdstat.patterns import PATTERNS, Label, Pattern, Thresholds
from chdstat.viz.estimators import called

__all__ = [
    "Column",
    "Table",
    "columns_of",
    "compared_table",
    "estimates_table",
    "goodness_table",
    "headline",
    "light_table",
    "patterns_table",
    "statistics_table",
]

_ERROR = 0.01
"""Relative error of the mean that the headline counts the samples for."""
_VARIANCE = {
    "yes": "the variance looks finite",
    "suspect": "variance suspect",
    "not identified": "variance not identified",
}
_FIRST = 7
"""Rows of the table of estimates that are shown at once: the default ones and the best others."""

Column = tuple[str, PlaceStatistics, int]
"""Title, place and row of a column."""
Table = dict[str, Any]
"""``columns``: titles; ``rows``: cells of text, and one more where a row has a tooltip; ``title``;
``note``: a line below; ``first``: how many rows are shown at once, where not all are."""


def columns_of(places: Sequence[PlaceStatistics], channel: str) -> list[Column]:
    """Return the rows of one place, or one row of each of several."""
    if len(places) == 1:
        return [(name, places[0], i) for i, name in enumerate(places[0].names)]
    row = "luminance" if channel == "all" else channel
    return [(f"pixel {i + 1}", place, place.row(row)) for i, place in enumerate(places)]


def headline(place: PlaceStatistics) -> list[tuple[str, str, str]]:
    """Return title, value and detail of the five numbers that matter most, of luminance."""
    moments, tail, modes = place.moments, place.fits.tail, place.fits.modes
    mean, error = (float(values[-1]) for values in (moments.mean, moments.standard_error))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.divide(error, mean) if mean > 0 else np.nan
    needed = float(place.spp * (share / _ERROR) ** 2)
    constant, trusted = bool(place.constant[-1]), _finite_variance(place, -1)
    verdict = "constant samples" if constant else _VARIANCE.get(trusted, "too few samples")
    clear = {"suspect": "at least: the tail is heavy", "not identified": "if the tail allows it"}
    count = int(modes.modes[-1])
    wilson = place.patterns.intervals["null_heavy"]
    return [
        ("Mean luminance", f"{number(mean)} ± {number(error)}", f"standard error {percent(share)}"),
        ("Null samples", percent(place.null_share), _between(percent, wilson)),
        ("Tail index", "—" if constant else number(tail.xi[-1]), verdict + _without_largest(place)),
        (
            "Modes",
            "—" if constant or not count else str(count),
            "constant samples" if constant else f"p of a single one {_p(modes.dip_p_value[-1])}",
        ),
        ("Samples for 1 % error", _count(needed), clear.get(trusted, f"{place.spp} are here")),
    ]


def statistics_table(columns: Sequence[Column]) -> Table:
    """Return moments, parameters, tail, dip and tests."""

    def row(title: str, of: Callable[[PlaceStatistics], Any], text: Any = number) -> list[str]:
        return [title, *(text(float(of(place)[i])) for _, place, i in columns)]

    def words(title: str, of: Callable[[PlaceStatistics, int], str]) -> list[str]:
        return [title, *(of(place, i) for _, place, i in columns)]

    def fitted(of: Callable[[PlaceStatistics, int], str]) -> Callable[[PlaceStatistics, int], str]:
        return lambda place, i: "—" if place.constant[i] else of(place, i)

    rows = [
        row("mean", lambda p: p.moments.seen(p.moments.mean)),
        row("standard error", lambda p: p.moments.standard_error),
        row("standard deviation", lambda p: np.sqrt(p.moments.variance)),
        row("skewness", lambda p: p.moments.skewness),
        row("excess kurtosis", lambda p: p.moments.kurtosis),
        row("largest", lambda p: p.moments.seen(p.moments.maximum)),
        words("null samples", lambda p, _: percent(p.null_share)),
        words("bad samples", lambda p, _: str(int(p.bad.sum()))),
        words("best family by BIC", _family),
        words("parameters", _parameters),
        words("BIC margin", fitted(lambda p, i: number(p.fits.selection.margin[i]))),
        words(
            "tail index ξ",
            fitted(lambda p, i: _with_interval(p.fits.tail.xi[i], p.fits.tail.interval[i])),
        ),
        words("p of a gamma tail", fitted(lambda p, i: _p(p.fits.tail.p_exponential[i]))),
        words("finite variance", fitted(_finite_variance)),
        words("modes", fitted(lambda p, i: str(p.fits.modes.modes[i] or "—"))),
        words("dip of log radiance", fitted(lambda p, i: number(p.fits.modes.dip[i]))),
        words("p of one mode (dip test)", fitted(lambda p, i: _p(p.fits.modes.dip_p_value[i]))),
        words("p of log-normal (Anderson–Darling)", fitted(_p_normal(0))),
        words("p of normal (Anderson–Darling)", fitted(_p_normal(1))),
        words(
            "p of gamma against log-normal (Vuong)",
            fitted(lambda p, i: _p(p.fits.selection.vuong_p_value[i])),
        ),
        words("N for Gaussian averages", _needed),
    ]
    place = max((place for _, place, _ in columns), key=lambda p: p.spp)
    cut = place.fitted_spp < place.spp
    note = f"fits and tests: the first {place.fitted_spp} of {place.spp} samples" if cut else ""
    return _table("Statistics", ["statistic", *(title for title, _, _ in columns)], rows, note)


def patterns_table(columns: Sequence[Column]) -> Table:
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
            tip += f" p of its absence: {_p(float(p))}."
        rows.append([name, *says, *values, limit, tip])
    if len(places) == 1:
        titles, label = ["what it says", "value"], f"Patterns: {_label(places[0])}"
    else:
        titles, label = [title for title, _, _ in columns], "Patterns"
    note = "of luminance; ● is set, ○ is not, each at the 5 % level of one pixel"
    if any(map(_is_firefly, places)):
        note += "; tails, modes and families without the largest sample where it dominates"
    return {**_table(label, ["pattern", *titles, "threshold"], rows, note), "words": True}


def _label(place: PlaceStatistics) -> str:
    return called(Label(int(place.patterns.label)).name.lower())


def _is_firefly(place: PlaceStatistics) -> bool:
    return bool(place.patterns.flags["firefly_dominated"])


def _without_largest(place: PlaceStatistics) -> str:
    """Name the tail index of the table of patterns where a firefly is left out of it."""
    xi = float(place.patterns.statistics["long_tail"])
    named = _is_firefly(place) and np.isfinite(xi)
    return f"; {number(xi)} without the largest sample" if named else ""


def _pattern_value(pattern: Pattern, place: PlaceStatistics, *, alone: bool) -> str:
    found, text = place.patterns, percent if "%" in pattern.limit else number
    value = float(found.statistics[pattern.name])
    interval = found.intervals.get(pattern.name) if alone else None
    hidden = place.constant[-1] and pattern.name not in {"null_heavy", "constant"}
    shown = "—" if hidden else _with_interval(value, interval, text)
    return f"{'●' if found.flags[pattern.name] else '○'}\N{NO-BREAK SPACE}{shown}"


def estimates_table(
    found: Sequence[ScoredEstimate], channels: Sequence[str], n: int, note: str
) -> Table:
    """Return the estimate and the error of every estimator.

    The default estimators come first, in their order, then the trained ones that the page was
    opened with, then the best of the others. `note` says what is the reference.
    """
    rows = []
    for e in sorted(found, key=_rank):
        name = called(e.name)
        if np.isfinite(e.certainty):
            name = f"{name}, {percent(e.certainty)} certain"
        values = [number(float(value)) for value in e.value]
        if e.low is not None and e.high is not None:
            ends = np.stack([e.low, e.high], axis=-1)
            for i in np.flatnonzero(np.isfinite(ends).all(axis=-1)):
                values[i] = _with_interval(e.value[i], ends[i])
        bias = 0.0 if abs(e.bias) < 5e-4 else e.bias  # of the mean, rounding
        scores = number(e.mse_ratio), percent(bias, sign=True), percent(e.improved)
        rows.append([name, *scores, *values])
    columns = ["estimator", "MSE / mean's", "bias", "improved", *channels]
    note = note if rows else f"too few samples for batches of {n}"
    return {**_table(f"Estimates from {n} samples", columns, rows, note), "first": _FIRST}


def _rank(estimate: ScoredEstimate) -> tuple[int, bool, bool, float]:
    # An image without features has the denoised mean without them.
    order = [name.removesuffix(" features") for name in DEFAULT_ESTIMATORS]
    name, known = estimate.name.removesuffix(" features"), np.isfinite(estimate.mse_ratio)
    place = order.index(name) if name in order else len(order)
    return place, not estimate.given, not known, float(estimate.mse_ratio) if known else 0.0


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


_WHY = {
    Reason.ALL_NULL: "all samples are null",
    Reason.TOO_FEW: "too few samples",
    Reason.CONSTANT: "the samples are constant",
    Reason.NOT_CONVERGED: "the fit did not converge",
    Reason.ALL_BAD: "all samples are bad",
    Reason.AT_LIMIT: "no maximum of the likelihood",
    Reason.NONE_POSITIVE: "no sample is positive",
    Reason.TIED: "too many equal samples",
    Reason.FEW_REPLICATES: "too few replicates could be fitted",
}


def _goodness(p: float, distance: float, reason: int) -> str:
    if np.isfinite(p):
        return f"{_p(p)} (D {number(distance)})"
    return _WHY.get(Reason(int(reason)), "not tested")


def compared_table(found: Difference, channels: Sequence[str], names: tuple[str, str]) -> Table:
    """Return the distances between the CHDs of two stores, and their significance."""
    rows = [
        _row("Kolmogorov–Smirnov distance", found.distance),
        _row("Wasserstein distance", found.wasserstein),
        _row("difference of means", found.mean_difference),
        _row("  over its standard error", found.mean_t),
        _row("  p of equal means", found.mean_p_value, _p),
    ]
    samples = f"{found.n[0]} and {found.n[1]} samples"
    if found.paired:
        samples = f"{found.n[0]} pairs of samples with the same random numbers"
    p = _p(float(found.p_value))
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


def _row(title: str, values: Array, text: Callable[[float], str] = number) -> list[str]:
    return [title, *(text(float(v)) for v in values)]


def _family(place: PlaceStatistics, row: int) -> str:
    if place.constant[row]:
        return "constant"
    selection = place.fits.selection
    name = str(selection.names[row])
    reason = Reason(int(selection.reason[row])).name.lower().replace("_", " ")
    return called(name) or reason


def _parameters(place: PlaceStatistics, row: int) -> str:
    fit = place.fit("best", row)
    if fit is None:
        return "—"
    return "\n".join(f"{name} {number(float(v))}" for name, v in fit.parameters.items())


def _finite_variance(place: PlaceStatistics, row: int) -> str:
    tail = place.fits.tail
    if tail.reason[row] != Reason.OK:
        return "—"
    if tail.variance_trusted[row]:
        return "yes"
    return "not identified" if tail.variance_unidentified[row] else "suspect"


def _p_normal(scale: int) -> Callable[[PlaceStatistics, int], str]:
    return lambda place, i: _p(place.gaussianity.p_value[i, scale, 0])


def _needed(place: PlaceStatistics, row: int) -> str:
    means = place.means
    if means is None:
        return "—"
    needed = int(means.n_needed[row])
    beyond = {inference.MORE_THAN_TESTED: f"> {int(means.sizes[-1])}", 0: "—"}
    return beyond.get(needed, str(needed))


def _with_interval(
    value: float, interval: Array | None, text: Callable[[float], str] = number
) -> str:
    if not np.isfinite(value):
        return "—"
    return text(float(value)) + ("" if interval is None else f" [{_between(text, interval, ', ')}]")


def _between(text: Callable[[float], str], interval: Array, between: str = " to ") -> str:
    low, high = (text(float(v)) for v in interval)
    return f"{low}{between}{high}"


def _count(value: float) -> str:
    """Return a number of samples with two digits."""
    if not np.isfinite(value):
        return "—"
    rounded = float(f"{max(value, 1):.2g}")
    return f"{rounded:,.0f}".replace(",", "\u2009") if rounded < 1e7 else f"{rounded:.1e}"


def _p(value: float) -> str:
    """Return a p-value; below 0.001 as a power of ten."""
    if not np.isfinite(value):
        return "—"
    if value == 0:  # too small for a float
        return "≈\u00a00"
    if value < 1e-3:
        return f"{value:.0e}".replace("-", "−").replace("e−0", "e−")
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}"
