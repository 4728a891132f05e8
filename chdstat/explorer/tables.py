"""Tables: the numbers of a selection as text, ready for a page.

For one place, a table has a column per channel; for several pixels, a column per pixel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from chdstat._core.display import as_p, number, percent, reasons, with_error, with_interval
from chdstat.comparison import DEFAULT_ESTIMATORS, ImageErrors
from chdstat.errors import Reason
from chdstat.explorer.address import row_of
from chdstat.explorer.batch_estimates import PlaceEstimates
from chdstat.explorer.overlays import ramp
from chdstat.fit import Goodness
from chdstat.fit.tail import TailIndex
from chdstat.inference.differences import Difference
from chdstat.inference.modes import Modes
from chdstat.patterns import PATTERNS, Label, Pattern, Pixel, Thresholds
from chdstat.patterns.definitions import largest_misfit
from chdstat.viz.styling import called, estimator_name

_ERROR = 0.01
"""Relative error of the mean that the headline counts the samples for."""
_UNKNOWN = np.full(2, np.nan)
"""Ends of an interval that is not known."""
RESAMPLES, MOST_TESTED = 199, 4096
"""Replicates of the tests of fits, and most samples that are tested: more would take minutes."""
_FIRST = 7
"""Rows of the table of estimates that are shown at once: the default ones and some others."""

_Column = tuple[str, Pixel, int]
"""Title, place and row of a column."""
Table = dict[str, Any]
"""``columns``: titles; ``rows``: cells of text, and one more where a row has a tooltip; ``title``;
``note``: a line below; ``first``: how many rows are shown at once, where not all are."""


def columns_of(places: Sequence[Pixel], channel: str) -> list[_Column]:
    """Return the rows of one place, or one row of each of several."""
    if len(places) == 1:
        return [(name, places[0], i) for i, name in enumerate(places[0].names)]
    return [(f"pixel {i + 1}", one, row_of(channel, one.names)) for i, one in enumerate(places)]


def headline(place: Pixel) -> list[tuple[str, str, str]]:
    """Return title, value and detail of the five numbers that matter most, of luminance."""
    if place.bad.all():
        return _without_good(place)
    moments, tail, modes = place.moments, place.measured(TailIndex()), place.measured(Modes())
    mean, error = (float(values[-1]) for values in (moments.mean, moments.standard_error))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.divide(error, mean) if mean > 0 else np.nan
    needed = float(place.spp * (share / _ERROR) ** 2)
    constant, holds = bool(place.constant[-1]), tail.holds_in_words(-1)
    told = f"error bar of {place.fitted_spp} spp: {holds}"
    if constant or holds == "—":
        told = "constant samples" if constant else "too few samples"
    clear = {"fails": "at least: the error bar fails", "cannot tell": "if the error bar holds"}
    count, p = int(modes.modes[-1]), as_p(modes.dip_p_value[-1])
    of_modes = modes.in_words(-1).removeprefix(str(count)).lstrip(", ") if count else ""
    low, high = map(percent, map(float, place.patterns.intervals["null_heavy"]))
    xi = float(tail.xi[-1])
    return [
        ("Mean luminance", number(mean), f"standard error {number(error)} ({percent(share)})"),
        ("Null samples", percent(place.null_share), f"{low} to {high}"),
        ("Tail index", "—" if constant else number(xi), told),
        (
            "Modes",
            "—" if constant or not count else str(count),
            "constant samples"
            if constant
            else "; ".join(filter(None, [of_modes, f"p of one mode {p}"])),
        ),
        ("Spp for 1 % error", _count(needed), clear.get(holds, f"{place.spp} are here")),
    ]


def _without_good(place: Pixel) -> list[tuple[str, str, str]]:
    titles = "Mean luminance", "Null samples", "Tail index", "Modes", "Spp for 1 % error"
    return [(title, "—", f"all {place.spp} samples are bad") for title in titles]


def why(place: Pixel) -> tuple[str, str]:
    """Return the first pattern of a place, and what causes it."""
    label = Label(int(place.patterns.label))
    meaning = "all samples are bad: NaN or infinite" if place.bad.all() else label.meaning
    return called(label.name.lower()), meaning


def statistics_table(columns: Sequence[_Column]) -> Table:
    """Return moments, and what the statistics say."""
    told = [
        {**_moments(place, row), "curve": place.curve(row).words, **place.told(row)}
        for _, place, row in columns
    ]
    rows = [[title, *(of_column[title] for of_column in told)] for title in told[0]]
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
    note = (
        "of luminance; ● is set, ○ is not: by the value, even where its interval holds the "
        "threshold; null-heavy where a test at the 5 % level of one pixel says so, too"
    )
    if any(place.patterns.flags["firefly_dominated"] for place in places):
        note += "; tails, modes and families without the largest sample where it dominates"
    return {**_table(label, ["pattern", *titles, "threshold"], rows, note), "words": True}


def _pattern_value(pattern: Pattern, place: Pixel, *, alone: bool) -> str:
    found, text = place.patterns, percent if "%" in pattern.limit else number
    value = float(found.statistics[pattern.name])
    interval = found.intervals.get(pattern.name, _UNKNOWN) if alone else _UNKNOWN
    hidden = place.constant[-1] and pattern.name not in {"null_heavy", "constant"}
    low, high = map(float, interval)
    shown = "—" if hidden else with_interval(value, low, high, text)
    sign = "●" if found.flags[pattern.name] else "○"
    return f"{sign}\N{NO-BREAK SPACE}{shown}{_what_speaks_against(pattern, place)}"


def _what_speaks_against(pattern: Pattern, place: Pixel) -> str:
    """Return what keeps the likelier family from describing a pixel; "" where it does."""
    found = place.patterns
    family = pattern.name in {"gamma_like", "lognormal_like"}
    if not family or found.flags[pattern.name] or not found.statistics[pattern.name] > 0:
        return ""
    for name in pattern.excluded_by:
        if found.flags[name]:
            return f", but {called(name)}"
    if found.misfit > largest_misfit(place.part.n[-1], Thresholds()):
        return f", but misfit {number(float(found.misfit), 2)}"
    return ", but a heavy tail"


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
    return with_error(
        float(np.mean(values)), float(np.std(values, ddof=1)) if values[1:] else math.nan
    )


def _rank(given: Sequence[str], estimates: PlaceEstimates) -> int:
    # An image without features has the denoised mean without them.
    order = [name.removesuffix(" features") for name in DEFAULT_ESTIMATORS]
    order += given
    name = estimates.name.removesuffix(" features")
    return order.index(name) if name in order else len(order)


def goodness_table(place: Pixel, found: Mapping[str, Goodness]) -> Table:
    """Return the p-value and the misfit of every family, one column for each row of the place.

    `found` are tests by Anderson and Darling's A² and by Kolmogorov's D, the largest gap of the
    distribution functions.
    """
    rows = []
    for family, test in found.items():
        reason = np.where(place.constant, Reason.CONSTANT, test.reason[:, 0])
        p_value = np.where(place.constant, np.nan, test.p_value[:, 0])
        rows.append([called(family), *map(_goodness, p_value, test.effect[:, 1], reason)])
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


def errors_table(found: ImageErrors | None, reference: str, said: str) -> Table:
    """Return the errors of the images against one of them.

    `said` tells what becomes of errors that are not known, or of fewer samples; else it is "".
    """
    title, shown = f"Errors against {reference}", found.shown if found else []
    columns = list(shown[0]) if shown else ["image"]
    rows = [[row[column] for column in columns] for row in shown]
    old = f"of fewer samples: {said} anew" if found and said else ""
    note = "; ".join(filter(None, [old, *found.notes])) if found else said
    return {**_table(title, columns, rows, note), "old": old}


def errors_line(table: Table, image: str, reference: str) -> str:
    """Return the row of the image that is shown, of a table of errors, as one line.

    Examples
    --------
    >>> table = {"columns": ["image", "MSE"], "rows": [["a", "0.1"]]}
    >>> table |= {"note": "being measured", "old": ""}
    >>> errors_line(table, "a", "b"), errors_line(table, "c", "b")
    ('Against b: MSE 0.1', 'Errors against b: being measured')
    """
    if image == reference:
        return "This image is the reference."
    for name, *cells in table["rows"]:
        if name == image:
            errors = map(" ".join, zip(table["columns"][1:], cells, strict=True))
            return f"Against {reference}: {' · '.join(filter(None, [*errors, table['old']]))}"
    return f"Errors against {reference}: {table['note']}"


def light_table(title: str, rows: Sequence[Mapping[str, str | float]]) -> Table:
    """Return the shares of light by the length of paths or by light, as `Pixel` has them."""
    columns = ["of the luminance", *list(rows[0])[1:]]
    cells = [
        [str(row["of"]), *(percent(float(share)) for share in list(row.values())[1:])]
        for row in rows
    ]
    return _table(title, columns, cells, "")


def places_table(place: Pixel) -> Table:
    """Return the mean luminance by place in a pixel, of samples that say where they fell.

    ``shades`` has, for each cell, a colour that follows the mean, and one of text on it.
    """
    assert place.means_by_place is not None, "asked for where it is known"
    means, counts = place.means_by_place
    shown, k = means[-1], len(counts)
    low, high = np.nanmin(shown), np.nanmax(shown)
    level = np.nan_to_num((shown - low) / (high - low if high > low else 1.0))
    colors = ramp()
    shades = [[(colors[int(255 * v)], "#fff" if v < 0.6 else "#000") for v in row] for row in level]
    ends = ["left", *[""] * (k - 2), "right"]
    sides = ["top", *[""] * (k - 2), "bottom"]
    rows = [[side, *(number(v, 2) for v in row)] for side, row in zip(sides, shown, strict=True)]
    told = place.variance_by_place
    note = f"about {counts.mean():.0f} samples in each cell"
    note = f"{note}. Variance by place: {told}." if told else note
    return {**_table("Luminance by place in the pixel", ["", *ends], rows, note), "shades": shades}


# --- cells --------------------------------------------------------------------------------------


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], note: str) -> Table:
    return {"title": title, "columns": columns, "rows": rows, "note": note}


def _count(value: float) -> str:
    """Return a number of samples with two digits."""
    if not np.isfinite(value):
        return "—"
    rounded = float(f"{max(value, 1):.2g}")
    return f"{rounded:,.0f}".replace(",", "\u2009") if rounded < 1e7 else f"{rounded:.1e}"


def _moments(place: Pixel, row: int) -> dict[str, str]:
    moments = place.moments
    numbers = {
        "mean": moments.mean,
        "standard error": moments.standard_error,
        "standard deviation": np.sqrt(moments.variance),
        "skewness": moments.skewness,
        "excess kurtosis": moments.kurtosis,
        "largest": moments.seen(moments.maximum),
    }
    nulls = {"null samples": percent(place.null_share), "bad samples": str(int(place.bad.sum()))}
    return {title: number(values[row]) for title, values in numbers.items()} | nulls
