"""Statistics of one place, computed when first used, and the tables that show them.

A place is a pixel, or a region whose samples are pooled. Luminance goes along as one more channel,
so that each fit, test and mode is found once for all of them. A table is text ready for a page.
`goodness` tests by bootstrap whether each family describes a place. It takes seconds, not the time
of a click: it reports its progress, and its caller may end it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat import inference
from chdstat._core.arrays import generator, is_bad, is_null, luminance, spans, take_rows
from chdstat._core.moments import Moments
from chdstat._core.positive import PositivePart
from chdstat.errors import Reason
from chdstat.explorer.estimators import ScoredEstimate
from chdstat.fit import Fit, Mixture
from chdstat.fit.families import FAMILIES, SELECTED, get_family
from chdstat.fit.goodness_of_fit import goodness_of_part
from chdstat.fit.mle import fit_part
from chdstat.inference.differences import Difference
from chdstat.inference.normality import gaussianity_of_part
from chdstat.inference.normality_of_means import means_of_block
from chdstat.patterns import PATTERNS, Label, Patterns
from chdstat.patterns.classification import PixelFits
from chdstat.reporting.typst import NAMES, number, percent
from chdstat.summary.histograms import Histogram, histogram

__all__ = [
    "PlaceStatistics",
    "Table",
    "compared_table",
    "estimates_table",
    "goodness",
    "goodness_table",
    "patterns_table",
    "statistics_table",
]

MOST_FITTED = 2**15
"""Samples that fits, tests and modes look at; moments and histograms take all of them."""
_OF_FIRST = {"fits", "_further_fits", "_positive", "patterns", "gaussianity", "means"}
"""Attributes that depend on the first `MOST_FITTED` samples alone."""
_RESAMPLES = 199
_PIECE = 20
_POINTS = 96
_MOST_TESTED = 4096
"""Samples that are tested: replicates of a region's would take minutes."""

Floats = npt.NDArray[np.float64]
Array = npt.NDArray[Any]
Fitted = tuple[str, Callable[[Floats], Floats], Callable[[Floats], Floats]]
"""Name of a fit, and density and quantiles of its positive part."""

Table = dict[str, Any]
"""``columns``: titles; ``rows``: cells of text; ``title``; ``note``: a line below."""


class PlaceStatistics:
    """Statistics of the samples of one place.

    Parameters
    ----------
    x
        Linear radiance, shape (channel, sample), with 1 or 3 channels.
    channels
        Their names.

    Attributes
    ----------
    rows
        The channels, then luminance where there are several of them, shape (row, sample), float32.
    names
        Of the rows.
    null, bad
        Which samples are null and which are bad as a whole, shape (sample,).
    spp, fitted_spp
        Samples, good or bad, and how many of them fits look at.
    """

    def __init__(self, x: npt.NDArray[np.float32], channels: tuple[str, ...]) -> None:
        self.channels = channels
        self._positive: dict[tuple[str, int], Fitted | None] = {}
        self._further_fits: dict[str, Fit] = {}
        self.bad = np.asarray(is_bad(x).any(axis=0))
        self.null = is_null(x) & ~self.bad
        self.names = channels
        self.rows = x
        if len(x) > 1:
            with np.errstate(invalid="ignore", over="ignore"):
                self.rows = np.concatenate([x, luminance(x)[np.newaxis]])
            self.names = (*channels, "luminance")
        self.spp = int(x.shape[1])
        self.fitted_spp = min(self.spp, MOST_FITTED)

    @property
    def samples(self) -> npt.NDArray[np.float32]:
        """Samples without luminance, shape (channel, sample)."""
        return self.rows[: len(self.channels)]

    def row(self, channel: str) -> int:
        """Return the row of 'luminance' or of the number of a channel."""
        if channel == "luminance":
            return len(self.names) - 1
        return min(int(channel), len(self.channels) - 1)

    @cached_property
    def null_share(self) -> float:
        """Share of nulls among the good samples; NaN without any."""
        good = self.spp - int(self.bad.sum())
        return float(self.null.sum() / good) if good else float("nan")

    @cached_property
    def moments(self) -> Moments:
        """Moments of the good samples, of each row."""
        return Moments.of(self.rows, ~self.bad)

    @cached_property
    def fits(self) -> PixelFits:
        """Fits, tails and modes of each row, of the samples that are fitted."""
        x = self.samples[:, : self.fitted_spp]
        return PixelFits(PositivePart.of_pixels(x, rows="both"))

    @cached_property
    def histograms(self) -> dict[str, Histogram]:
        """Linear and log10 histogram of each row, by scale."""
        null, bad = (np.broadcast_to(mask, self.rows.shape) for mask in (self.null, self.bad))
        scales: tuple[Literal["linear", "log"], ...] = ("linear", "log")
        return {s: histogram(self.rows, scale=s, null=null, bad=bad) for s in scales}

    @cached_property
    def patterns(self) -> Patterns:
        """Patterns of luminance, at the level of a single pixel."""
        return self.fits.patterns()

    @cached_property
    def gaussianity(self) -> inference.Gaussianity:
        """Anderson-Darling's test of the logarithms and of the samples, shape (row, 2, 1)."""
        return gaussianity_of_part(self.fits.part, ("log", "linear"))

    @cached_property
    def means(self) -> inference.GaussianityOfMeans | None:
        """Normality of averages, of each row; None with fewer samples than averages to test."""
        if self.fitted_spp < inference.N_MEANS:
            return None
        block = np.where(self.bad, np.float32(np.nan), self.rows)[:, : self.fitted_spp]
        return means_of_block(block, inference.sizes_of_means(self.fitted_spp))

    def averages(self, n: int) -> Floats:
        """Return the averages of consecutive good samples, n each, shape (row, average)."""
        good = self.rows if not self.bad.any() else self.rows[:, ~self.bad]
        count = good.shape[1] // n
        cut = good[:, : count * n].reshape(len(good), count, n)
        return np.asarray(cut.mean(axis=-1, dtype=np.float64))

    @cached_property
    def running(self) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
        """Spp, running means and their standard errors, shapes (point,) and (row, point)."""
        good = np.flatnonzero(~self.bad)
        if good.size < 2:
            return np.empty(0, np.int64), *np.empty((2, len(self.rows), 0))
        at = np.unique(np.geomspace(2, good.size, min(_POINTS, good.size)).astype(np.int64))
        x = self.rows[:, good].astype(np.float64)
        # Deviations from the mean of all keep the sum of squares from cancelling.
        center = x.mean(axis=-1, keepdims=True)
        x -= center
        with np.errstate(over="ignore", invalid="ignore"):
            total, squares = np.cumsum(x, axis=-1)[:, at - 1], np.cumsum(x * x, axis=-1)[:, at - 1]
            mean = total / at
            variance = np.maximum(squares / at - mean**2, 0) * at / (at - 1)
        return at, mean + center, np.sqrt(variance / at)

    def fit(self, family: str, row: int) -> Fit | Mixture | None:
        """Return a fit of one row by the name of its family, 'best' or 'mixture'."""
        selection = self.fits.selection
        if family == "best":
            family = str(selection.names[row])
        if not family:
            return None
        if family == "mixture":
            return take_rows(self.fits.mixture, row, axis=0)
        fits = selection.fits if family in selection.fits else self._further_fits
        if family not in fits:
            self._further_fits[family] = fit_part(self.fits.part, FAMILIES[family])
        return take_rows(fits[family], row, axis=0)

    def positive(self, family: str, row: int) -> Fitted | None:
        """Return name, density and quantiles of the positive part of a fit, None without a fit.

        They are kept: histograms and quantiles need the same, and SciPy takes longer to make a
        distribution than to evaluate it.
        """
        if (family, row) not in self._positive:
            found = self.fit(family, row)
            if isinstance(found, Fit):
                frozen = get_family(found.family).distribution(found.parameters)
                self._positive[family, row] = found.family, frozen.pdf, frozen.ppf
            elif found is not None:
                quantiles = partial(_positive_quantiles, found)
                self._positive[family, row] = "mixture", found.pdf, quantiles
            else:
                self._positive[family, row] = None
        return self._positive[family, row]

    def take_over(self, earlier: PlaceStatistics) -> None:
        """Keep what was found of the first samples of this place, where they are the same."""
        if earlier.fitted_spp == self.fitted_spp:
            vars(self).update({k: v for k, v in vars(earlier).items() if k in _OF_FIRST})


def _positive_quantiles(mixture: Mixture, level: Floats) -> Floats:
    zero = np.float64(mixture.zero_share)
    return mixture.ppf(zero + (1 - zero) * level)


def goodness(
    place: PlaceStatistics, step: Callable[[float], None], *, resamples: int = _RESAMPLES
) -> dict[str, tuple[Floats, Floats]]:
    """Test every family by the parametric bootstrap, see `chdstat.fit.goodness`.

    Parameters
    ----------
    place
        The place to test; of more than 4096 samples, the first.
    step
        Called with the share that is done before each piece; whatever it raises ends the test.
    resamples
        Replicates B.

    Returns
    -------
    dict
        By family, p-values by Anderson and Darling's A², NaN where it could not be fitted, and
        Kolmogorov's D, the largest gap of the distribution functions, both of shape (row,).
    """
    part = PositivePart.of_pixels(place.samples[:, :_MOST_TESTED], rows="both")
    # One generator for all pieces: their replicates are as independent as those of one call.
    rng = generator(0)
    pieces = list(spans(resamples, _PIECE))
    result = {}
    for i, name in enumerate(SELECTED):
        farther, drawn = np.zeros((2, *part.n.shape))
        fit = fit_part(part, FAMILIES[name])
        for j, piece in enumerate(pieces):
            step((i + j / len(pieces)) / len(SELECTED))
            found = goodness_of_part(
                part,
                fit,
                tests=("anderson-darling", "kolmogorov-smirnov"),
                resamples=piece.stop - piece.start,
                seed=rng,
            )
            # p = (b + 1) / (B + 1) of the piece gives its b back.
            replicates = found.resamples[:, 0]
            farther += np.nan_to_num(found.p_value[:, 0] * (replicates + 1) - 1)
            drawn += replicates
        p_value = np.where(drawn > 0, (farther + 1) / (drawn + 1), np.nan)
        result[name] = p_value, found.effect[:, 1]
    return result


# --- tables -------------------------------------------------------------------------------------


def statistics_table(place: PlaceStatistics) -> Table:
    """Return moments, parameters, tail, dip and tests, one column for each channel."""
    moments, normal, means = place.moments, place.gaussianity, place.means
    selection, tail, modes = place.fits.selection, place.fits.tail, place.fits.modes
    finite = np.where(tail.variance_trusted, "yes", "suspect")
    finite = np.where(tail.variance_unidentified, "not identified", finite)
    finite = np.where(tail.reason == Reason.OK, finite, "—")
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
        ["tail index ξ", *map(_with_interval, tail.xi, tail.interval)],
        _row("p of a gamma tail", tail.p_exponential, _p),
        ["finite variance", *finite.tolist()],
        _row("modes", modes.modes, lambda m: f"{m:.0f}" if m else "—"),
        _row("dip of log", modes.dip),
        _row("p of one mode (dip)", modes.dip_p_value, _p),
        _row("p of log-normal (A²)", normal.p_value[:, 0, 0], _p),
        _row("p of normal (A²)", normal.p_value[:, 1, 0], _p),
        _row("Vuong's p, gamma / log-normal", selection.vuong_p_value, _p),
    ]
    if means is not None:
        beyond = {inference.MORE_THAN_TESTED: f"> {int(means.sizes[-1])}", 0: "—"}
        needed = [beyond.get(int(n), str(n)) for n in means.n_needed]
        rows.append(["N needed (Gaussian averages)", *needed])
    cut = place.fitted_spp < place.spp
    note = f"fits and tests: the first {place.fitted_spp} of {place.spp} samples" if cut else ""
    counts = f"{percent(place.null_share)} null · {int(place.bad.sum())} bad"
    table = _table("Statistics", ["", *place.names], rows, note)
    return {**table, "summary": f"{place.spp} samples · {counts}"}


def patterns_table(place: PlaceStatistics) -> Table:
    """Return every pattern with its flag, the statistic that set it, its interval and p-value.

    Each row has one cell more than there are columns: what is measured.
    """
    found = place.patterns
    rows = []
    for pattern in PATTERNS:
        p, interval = found.p_values.get(pattern.name), found.intervals.get(pattern.name)
        value = float(found.statistics[pattern.name])
        cells = [
            "●" if found.flags[pattern.name] else "○",
            NAMES.get(pattern.name, pattern.name.replace("_", " ")),
            number(value) if interval is None else _with_interval(value, interval),
            "—" if p is None else _p(float(p)),
            pattern.statistic,
        ]
        rows.append(cells)
    label = Label(int(found.label)).name.lower().replace("_", " ")
    note = "of luminance, each at the 5 % level of one pixel"
    return _table(f"Patterns: {label}", ["", "pattern", "statistic", "p"], rows, note)


def estimates_table(
    found: Sequence[ScoredEstimate], channels: Sequence[str], n: int, note: str
) -> Table:
    """Return the estimate and the error of every estimator; `note` says what is the reference."""
    rows = []
    for e in found:
        name = NAMES.get(e.name, e.name.replace("_", " "))
        if np.isfinite(e.certainty):
            name = f"{name}, {percent(e.certainty)} certain"
        values = [number(float(value)) for value in e.value]
        if e.low is not None and e.high is not None:
            ends = np.stack([e.low, e.high], axis=-1)
            for i in np.flatnonzero(np.isfinite(ends).all(axis=-1)):
                values[i] = _with_interval(e.value[i], ends[i])
        scores = number(e.mse_ratio), percent(e.bias, sign=True), percent(e.improved)
        rows.append([name, *values, *scores])
    columns = ["estimator", *channels, "MSE ratio", "bias", "improved"]
    note = note if rows else f"too few samples for batches of {n}"
    return _table(f"Estimates from N = {n}", columns, rows, note)


def goodness_table(place: PlaceStatistics, found: Mapping[str, tuple[Floats, Floats]]) -> Table:
    """Return the p-value and the misfit of every family, one column for each row of the place."""
    rows = []
    for family, (p_value, distance) in found.items():
        cells = (f"{_p(p)} (D {number(d)})" for p, d in zip(p_value, distance, strict=True))
        rows.append([NAMES.get(family, family), *cells])
    note = (
        f"p-values of A² from {_RESAMPLES} replicates, fitted as the samples were, and the "
        f"largest gap D; the first {min(place.spp, _MOST_TESTED)} samples"
    )
    return _table("Goodness of fit", ["family", *place.names], rows, note)


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
    return _table(f"{names[1]} against {names[0]}", ["", *channels], rows, note)


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], note: str) -> Table:
    return {"title": title, "columns": columns, "rows": rows, "note": note}


def _row(title: str, values: Array, text: Callable[[float], str] = number) -> list[str]:
    return [title, *(text(float(v)) for v in values)]


def _family(place: PlaceStatistics, row: int) -> str:
    selection = place.fits.selection
    name = str(selection.names[row])
    reason = Reason(int(selection.reason[row])).name.lower().replace("_", " ")
    return NAMES.get(name, name) or reason


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


def _p(value: float) -> str:
    """Return a p-value; below 0.001 as a power of ten."""
    if not np.isfinite(value):
        return "—"
    if value == 0:  # too small for a float
        return "≈\u00a00"
    if value < 1e-3:
        return f"{value:.0e}".replace("-", "−").replace("e−0", "e−")
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}"
