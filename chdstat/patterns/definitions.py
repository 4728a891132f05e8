"""The table of patterns: what each means, how it is measured, and when it counts.

`PATTERNS` is the table; a new pattern is a new row. Its rules compare `_PixelStatistics` with
`Thresholds`. A firefly must not decide how the rest of a pixel looks. If one sample
carries too much of the mean, tail, modes and families are therefore measured without it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special, stats

from chdstat._core.arrays import Counts, Floats, Mask
from chdstat._core.positive import PositivePart
from chdstat._core.resampling import Z_95, wilson
from chdstat.errors import InputError
from chdstat.fit.error_bars import FAILS, Bar, ErrorBars
from chdstat.fit.selection import FamilySelection, Selection
from chdstat.fit.tail import Tail, TailIndex, effective_tail_index, is_infinite
from chdstat.inference.modes import SEPARATE, Modality, Modes
from chdstat.summary.runner import measured

_POINTS = 32
"""Quantiles at which a family is compared with the samples; at 512 samples, the error is 1/64."""
_BODIES = ("gamma", "lognormal")
_TOP = 0.1
"""Share of the samples whose excesses define the tail index of a body."""


@dataclass(frozen=True)
class Thresholds:
    """Limits from which a pattern counts.

    Attributes
    ----------
    alpha
        False discovery rate of every tested flag over an image; for a single pixel, level of the
        test.
    null_share
        A pixel is null-heavy if more than this share of its samples is null.
    misses
        A tail is long if more than this share of the error bars of so many samples misses the mean.
        The bars are those of 95 %.
    tail_index
        A body whose tail index is at least this, and significantly above a gamma tail's, is neither
        gamma-like nor log-normal-like; a log-normal body not even if its own index is.
    ashman_d
        Neighbouring modes count as two from this separation on.
    firefly_share, firefly_samples
        A sample is a firefly if it carries more than this share of the sum of all samples, and more
        than this many average samples do.
    misfit
        A family describes a pixel if the Kolmogorov-Smirnov distance to the samples is at most
        this, or no larger than chance makes it in 95 % of all cases.
    constant
        A pixel is constant if the standard deviation of the natural logarithm of its luminance is
        at most this: float32 leaves 1e-7 for each product along a path.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    alpha: float = 0.05
    null_share: float = 0.5
    misses: float = 1 - FAILS
    tail_index: float = 0.2
    ashman_d: float = SEPARATE
    firefly_share: float = 0.1
    firefly_samples: float = 8.0
    misfit: float = 0.05
    constant: float = 1e-4

    def __post_init__(self) -> None:
        shares = (self.alpha, self.null_share, self.misses, self.firefly_share)
        others = self.tail_index, self.ashman_d, self.firefly_samples, self.misfit, self.constant
        if not all(0 < share < 1 for share in shares) or not all(v >= 0 for v in others):
            message = (
                "thresholds need alpha, null_share, misses and firefly_share in (0, 1), and "
                "tail_index, ashman_d, firefly_samples, misfit and constant >= 0; got "
                f"{self}"
            )
            raise InputError(message)


@dataclass(frozen=True)
class _PixelStatistics:
    """Scores per pixel; arrays with the batch's shape, NaN where there is nothing to measure.

    Attributes
    ----------
    part
        All positive samples.
    largest_share
        Share of the sum in the largest sample.
    error_bars
        How often error bars of so many samples hold.
    tail, modes
        Tail and modes without a sample that dominates; all fields below are without it, too.
    vuong_z
        Vuong's statistic of gamma against log-normal, positive for gamma.
    family
        Index of the best family in `chdstat.fit.families.FAMILIES`, -1 for none.
    misfit
        Kolmogorov-Smirnov distance between the samples and the better of the two.
    body_index, body_index_se
        Tail index that excesses over the 0.9 quantile of the better of the two would show (the
        penultimate index: Smith 1987, doi:10.1214/aos/1176350499), and its standard error.
    """

    part: PositivePart
    largest_share: Floats
    error_bars: ErrorBars
    tail: Tail
    modes: Modality
    vuong_z: Floats
    family: npt.NDArray[np.int8]
    misfit: Floats
    body_index: Floats
    body_index_se: Floats

    @cached_property
    def widest(self) -> tuple[Floats, Floats]:
        """Separations of neighbouring modes, shape (..., 2), widest first, and standard errors."""
        d, error = self.modes.ashman_d, self.modes.ashman_d_se
        order = np.argsort(-np.nan_to_num(d), axis=-1)
        return np.take_along_axis(d, order, axis=-1), np.take_along_axis(error, order, axis=-1)


def gather(part: PositivePart, thresholds: Thresholds) -> _PixelStatistics:
    """Measure every pixel, without a sample that dominates it, except for that sample's share."""
    found = _measure(part)
    rows = np.asarray(found.largest_share > firefly_limit(part.n, thresholds))
    if not rows.any():
        return found
    rest = _measure(_without_largest(part, rows))
    names = {f.name for f in fields(found)} - {"part", "largest_share", "error_bars"}
    return replace(found, **{n: _put(getattr(found, n), getattr(rest, n), rows) for n in names})


def _put(found: Any, rest: Any, rows: Mask) -> Any:
    """Return a result, array or dataclass of arrays, with the `rest` in some rows."""
    if is_dataclass(found) and not isinstance(found, type):
        names = [f.name for f in fields(found)]
        return replace(found, **{n: _put(getattr(found, n), getattr(rest, n), rows) for n in names})
    if not isinstance(found, np.ndarray | np.generic):
        return found
    values = np.array(found)
    values[rows] = rest
    return values


def firefly_limit(n: npt.NDArray[np.int64], thresholds: Thresholds) -> Floats:
    """Return the share of the sum above which a sample is a firefly."""
    return np.maximum(thresholds.firefly_share, thresholds.firefly_samples / np.maximum(n, 1))


def _without_largest(part: PositivePart, rows: Mask) -> PositivePart:
    """Return some rows of a part, shape (row, sample), each without its largest sample."""
    x, positive = part.x[rows], part.positive[rows].copy()
    largest = np.where(positive, x, -np.inf).argmax(axis=-1)
    positive[np.arange(len(x)), largest] = False
    others = part.n_null, part.n_zero, part.n_negative, part.n_bad
    return PositivePart(x, positive, part.n[rows] - 1, *(count[rows] for count in others))


def _measure(part: PositivePart) -> _PixelStatistics:
    families = measured(part, FamilySelection())
    body_index, body_index_se = _body_index(families)
    return _PixelStatistics(
        part=part,
        largest_share=part.largest_share,
        error_bars=measured(part, Bar()),
        tail=measured(part, TailIndex()),
        modes=measured(part, Modes()),
        vuong_z=families.vuong_z,
        family=families.best,
        misfit=_misfit(part, families),
        body_index=body_index,
        body_index_se=body_index_se,
    )


def _misfit(part: PositivePart, families: Selection) -> Floats:
    """Return the largest distance of the distribution functions, at some of the samples."""
    misfit, z = np.full(part.n.shape, np.nan), families.vuong_z
    gamma, lognormal = (families.fits[name].parameters for name in _BODIES)
    for rows, one in ((z > 0, "gamma"), (z <= 0, "lognormal")):
        n = part.n[rows][:, np.newaxis]
        rank = ((np.arange(_POINTS) + 0.5) / _POINTS * n).astype(np.intp)
        log = np.take_along_axis(part.log_sorted[rows], rank, axis=-1)
        if one == "gamma":
            shape, scale = (gamma[name][rows][:, np.newaxis] for name in ("shape", "scale"))
            cdf = special.gammainc(shape, np.exp(log - np.log(scale)))
        else:
            mu, sigma = (lognormal[name][rows][:, np.newaxis] for name in ("mu", "sigma"))
            cdf = special.ndtr((log - mu) / sigma)
        misfit[rows] = np.maximum(cdf - rank / n, (rank + 1) / n - cdf).max(axis=-1)
    return misfit


def _body_index(families: Selection) -> tuple[Floats, Floats]:
    """Return the penultimate tail index of the better family, and its standard error.

    The index ``-1 - (1 - F) f' / f^2`` at the 0.9 quantile depends on the shape alone. Its error
    follows from that of the shape (delta method).
    """
    gamma, lognormal = (families.fits[name] for name in _BODIES)
    is_gamma = families.vuong_z > 0
    index, error = np.full(is_gamma.shape, np.nan), np.full(is_gamma.shape, np.nan)
    shape = gamma.parameters["shape"][is_gamma]
    log_shapes, indices, slopes = _gamma_table()
    index[is_gamma] = np.interp(np.log(shape), log_shapes, indices)
    slope = np.interp(np.log(shape), log_shapes, slopes) / shape
    error[is_gamma] = np.abs(slope) * gamma.standard_errors["shape"][is_gamma]
    # For a log-normal: z M - 1 + sigma M, where M is the Mills ratio at the Gaussian quantile z.
    z = special.ndtri(1 - _TOP)
    mills = _TOP * np.sqrt(2 * np.pi) * np.exp(z**2 / 2)
    other = ~is_gamma
    index[other] = z * mills - 1 + mills * lognormal.parameters["sigma"][other]
    error[other] = mills * lognormal.standard_errors["sigma"][other]
    return index, error


@cache
def _gamma_table() -> tuple[Floats, Floats, Floats]:
    """Return log shapes, the index of gamma distributions, and its slope over the log shape.

    The quantile of a gamma distribution costs as much as a whole fit. Between the points of this
    table, the index is right to 1e-4.
    """
    log_shapes = np.linspace(np.log(0.02), np.log(1e4), 800)
    indices = effective_tail_index(stats.gamma(np.exp(log_shapes)), _TOP)
    return log_shapes, indices, np.gradient(indices, log_shapes)


_CHANCE = 0.895
"""Kolmogorov-Smirnov distance times sqrt(n) that 5 % of Gaussian samples exceed (Stephens 1974)."""


@dataclass(frozen=True)
class Pattern:
    """A row of `PATTERNS`.

    Attributes
    ----------
    name
        Name of the flag.
    meaning
        What it means for light transport.
    cure
        What helps against it.
    typical
        A typical pixel: where it lies in a built-in scene, and what its samples look like.
    statistic
        The measured quantity and its scale; computed by `measure`.
    rule
        Rule for the flag, in words.
    limit
        The threshold in short, formatted with the fields of `Thresholds`.
    source
        Where the pattern or its threshold comes from.
    measure
        Returns the statistic of every pixel.
    large_enough
        Returns whether the effect counts, however significant it is.
    test
        Returns the p-value of the hypothesis that the pattern is absent; None if there is no test.
    decisive
        Whether the flag needs a significant p-value; otherwise, the p-value is only reported.
    interval
        Returns the 95 % interval of the statistic, shape (..., 2); None if there is none.
    excluded_by
        Flags that exclude this one.
    """

    name: str
    meaning: str
    cure: str
    typical: str
    statistic: str
    rule: str
    limit: str
    source: str
    measure: Callable[[_PixelStatistics], Floats]
    large_enough: Callable[[_PixelStatistics, Thresholds], Mask]
    test: Callable[[_PixelStatistics, Thresholds], Floats] | None = None
    decisive: bool = False
    interval: Callable[[_PixelStatistics], Floats] | None = None
    excluded_by: tuple[str, ...] = ()

    @property
    def page(self) -> str:
        """Where the documentation shows a typical pixel, relative to its root."""
        return f"understand/noise.html#{self.name.replace('_', '-')}"


def _null_share(e: _PixelStatistics) -> Floats:
    return np.asarray(e.part.n_null / e.part.n_good)


def _null_p_value(e: _PixelStatistics, t: Thresholds) -> Floats:
    """Return P(as many nulls or more) if their share is the threshold: the exact binomial test."""
    n, nulls = e.part.n_good, e.part.n_null
    p = special.betainc(np.maximum(nulls, 1), n - nulls + 1, t.null_share)
    return np.where(n == 0, np.nan, np.where(nulls == 0, 1.0, p))


def _clear_modes(e: _PixelStatistics, t: Thresholds) -> Counts:
    """Count modes that are far enough from their neighbours; 0 where modes are not known."""
    return e.modes.clear(t.ashman_d)


def _separation_interval(e: _PixelStatistics, widest: int) -> Floats:
    separation, error = (values[..., widest] for values in e.widest)
    ends = separation - Z_95 * error, separation + Z_95 * error
    return np.maximum(np.stack(ends, axis=-1), 0)


def _is_described(e: _PixelStatistics, t: Thresholds) -> Mask:
    """Return where there is one mode that gamma or log-normal describes."""
    return np.asarray((e.misfit <= largest_misfit(e.part.n, t)) & (_clear_modes(e, t) == 1))


def largest_misfit(n: npt.NDArray[np.int64], thresholds: Thresholds) -> Floats:
    """Return the largest misfit of a family that describes n positive samples."""
    return np.maximum(thresholds.misfit, _CHANCE / np.sqrt(np.maximum(n, 1)))


BODIES = ("gamma", "lognormal", "mixture", "neither")
"""What may describe the positive samples of a pixel, apart from one that dominates."""


def body_of(e: _PixelStatistics, t: Thresholds) -> npt.NDArray[np.int8]:
    """Return what describes the samples, as a place in `BODIES`; -1 where nothing is known.

    One mode has the likelier of gamma and log-normal, unless it misfits; several have a mixture.
    """
    one, known = _is_described(e, t), ~(_log_spread(e) <= t.constant)
    cases = one & (e.vuong_z > 0), one, _clear_modes(e, t) > 1, _clear_modes(e, t) == 1
    codes = [np.int8(code) for code in range(len(BODIES))]
    return np.asarray(np.where(known, np.select(cases, codes, np.int8(-1)), np.int8(-1)))


def _misses(e: _PixelStatistics) -> Floats:
    return np.asarray(1 - e.error_bars.coverage_own)


def _misses_interval(e: _PixelStatistics) -> Floats:
    return 1 - e.error_bars.coverage_own_interval[..., ::-1]


def _is_long(e: _PixelStatistics, t: Thresholds) -> Mask:
    """Return where error bars fail, or the variance is surely infinite."""
    return np.asarray((_misses(e) > t.misses) | is_infinite(e.tail))


def _is_like(sign: int) -> Callable[[_PixelStatistics, Thresholds], Mask]:
    """Return where gamma (1) or log-normal (-1) is better, with one mode and a short tail."""

    def large_enough(e: _PixelStatistics, t: Thresholds) -> Mask:
        short = (sign > 0) | (e.body_index < t.tail_index)
        # Stricter than alpha: of an image of plain pixels, only few may look heavy by chance.
        heavy = (e.tail.xi >= t.tail_index) & (e.tail.p_exponential <= t.alpha / 50)
        return np.asarray((sign * e.vuong_z > 0) & _is_described(e, t) & short & ~heavy)

    return large_enough


def _log_spread(e: _PixelStatistics) -> Floats:
    return np.asarray(np.sqrt(e.part.log_statistics.log_variance))


_TAIL_SOURCE = "calibrated on certified pixels; Smith 1987, doi:10.1214/aos/1176350499"
_MODE_SOURCE = (
    "Ashman, Bird and Zepf 1994, doi:10.1086/117248; Hartigan and Hartigan 1985, "
    "doi:10.1214/aos/1176346577"
)
_FAMILY_SOURCE = (
    "Vuong 1989, doi:10.2307/1912557; Stephens 1974, doi:10.1080/01621459.1974.10480196"
)
_NO_BODY = ("constant", "bimodal", "multimodal")

PATTERNS: tuple[Pattern, ...] = (
    Pattern(
        name="null_heavy",
        meaning="most paths find no light: small or hidden emitters, occlusion",
        cure="sample the emitters more directly, or guide paths to them; more samples help at the "
        "usual rate",
        typical="a dark corner beside the tub of the bathroom: a broad hump, and two thirds of "
        "the samples null",
        statistic="share of null samples",
        rule="the share is above the threshold (exact binomial test)",
        limit="> {null_share:.0%}",
        source="Elek, Thomas and Forbes 2019: often more than 50 % in enclosed scenes",
        measure=_null_share,
        large_enough=lambda e, t: _null_share(e) > t.null_share,
        test=_null_p_value,
        decisive=True,
        interval=lambda e: wilson(e.part.n_null, e.part.n_good),
    ),
    Pattern(
        name="long_tail",
        meaning="error bars of so many samples fail: rare bright paths carry light that they miss",
        cure="sample the bright paths more often; until then, trust no error bar of so many "
        "samples; the default estimate may be closer than the mean",
        typical="a dark place among many lamps: one narrow hump, and far to its right a few "
        "samples more than a hundred times as bright; the running mean jumps",
        statistic="share of 95 % error bars of so many samples that miss the mean",
        rule="the share is above the threshold: by the pixels around, too, in an image; in an "
        "array, by the pixel's own samples, or where the interval of the tail index is above 1/2",
        limit="> {misses:.0%}",
        source=_TAIL_SOURCE,
        measure=_misses,
        large_enough=_is_long,
        test=lambda e, _: e.tail.p_exponential,
        interval=_misses_interval,
    ),
    Pattern(
        name="bimodal",
        meaning="two kinds of paths at once: direct and indirect, lit and shadowed",
        cure="stratify or split the two kinds of paths; more samples help at the usual rate",
        typical="the edge of a shadow on the tub of the bathroom: two humps; the running mean "
        "settles soon",
        statistic="Ashman's D of the two modes with the largest separation, in log radiance",
        rule="two modes of the mixture are separated by the threshold (dip test beside it)",
        limit="D ≥ {ashman_d:g}",
        source=_MODE_SOURCE,
        measure=lambda e: e.widest[0][..., 0],
        large_enough=lambda e, t: _clear_modes(e, t) == 2,
        test=lambda e, _: e.modes.dip_p_value,
        interval=lambda e: _separation_interval(e, 0),
    ),
    Pattern(
        name="multimodal",
        meaning="three or more kinds of paths: several emitters, lobes or depths of reflection",
        cure="sample each kind of path on its own, such as one light at a time; more samples help "
        "at the usual rate",
        typical="a wooden board behind a glass: three humps",
        statistic="Ashman's D of the next pair of neighbouring modes, in log radiance",
        rule="three modes of the mixture are separated by the threshold (dip test beside it)",
        limit="D ≥ {ashman_d:g}",
        source=_MODE_SOURCE,
        measure=lambda e: e.widest[0][..., 1],
        large_enough=lambda e, t: _clear_modes(e, t) >= 3,
        test=lambda e, _: e.modes.dip_p_value,
        interval=lambda e: _separation_interval(e, 1),
    ),
    Pattern(
        name="gamma_like",
        meaning="many small contributions add up: one kind of paths with an exponential tail",
        cure="more samples, at the usual rate; averages are soon Gaussian",
        typical="a wall of the Cornell box: one hump, steeper on its right",
        statistic="Vuong's z of gamma against log-normal",
        rule="one mode, no heavy tail, gamma is likelier than log-normal and no misfit",
        limit="z > 0, misfit ≤ {misfit:g}",
        source=_FAMILY_SOURCE,
        measure=lambda e: e.vuong_z,
        large_enough=_is_like(1),
        test=lambda e, _: special.ndtr(-e.vuong_z),
        excluded_by=_NO_BODY,
    ),
    Pattern(
        name="lognormal_like",
        meaning="many factors multiply: one kind of paths of several reflections",
        cure="more samples, at the usual rate; averages become Gaussian later than in gamma-like "
        "pixels",
        typical="a coloured wall of the Cornell box: one symmetric hump in log radiance",
        statistic="Vuong's z of log-normal against gamma",
        rule="one mode, no heavy tail, log-normal is likelier than gamma and no misfit",
        limit="z > 0, misfit ≤ {misfit:g}",
        source=_FAMILY_SOURCE,
        measure=lambda e: -e.vuong_z,
        large_enough=_is_like(-1),
        test=lambda e, _: special.ndtr(e.vuong_z),
        excluded_by=_NO_BODY,
    ),
    Pattern(
        name="firefly_dominated",
        meaning="one sample decides the pixel: a firefly",
        cure="draw more samples of the pixel: if others are as bright, its tail is long; if none "
        "is, it had bad luck, and estimates that look at its neighbours may help",
        typical="a wall in a room by night: one sample far to the right of all others; the "
        "running mean jumps once",
        statistic="share of the sum of all samples that the largest one carries",
        rule="the share is above the threshold, and above that of some average samples",
        limit="> {firefly_share:.0%} and > {firefly_samples:g} mean samples",
        source="a definition, not a test",
        measure=lambda e: e.largest_share,
        large_enough=lambda e, t: e.largest_share > firefly_limit(e.part.n, t),
    ),
    Pattern(
        name="constant",
        meaning="every path that finds light brings the same: emitters and backgrounds seen",
        cure="samples that find light are equal: where none is null, one is enough; null samples "
        "are all the noise there is, as in null-heavy pixels",
        typical="the sky in a window: a single spike",
        statistic="standard deviation of the natural logarithm of luminance",
        rule="no larger than the threshold, about what rounding leaves",
        limit="≤ {constant:g}",
        source="a definition, not a test",
        measure=_log_spread,
        large_enough=lambda e, t: (_log_spread(e) <= t.constant) & (e.part.n > 1),
    ),
)
"""The patterns, in no order; `Label` has the order."""
