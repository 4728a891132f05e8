"""The table of patterns: what each means, how it is measured, and when it counts.

`chdstat.patterns` applies it; a new pattern is a new row of `PATTERNS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special

from chdstat._core.arrays import Counts, Floats, Mask
from chdstat._core.resampling import Z_95, wilson
from chdstat.patterns.pixel_statistics import PixelStatistics, Thresholds, firefly_limit

__all__ = ["PATTERNS", "Pattern"]

_CHANCE = 0.895
"""Kolmogorov's distance times sqrt(n) that 5 % of Gaussian samples exceed (Stephens 1974)."""


@dataclass(frozen=True)
class Pattern:
    """A row of `PATTERNS`.

    Attributes
    ----------
    name
        Of the flag.
    meaning
        What it means for light transport.
    statistic
        What is measured, and on which scale; computed by `measure`.
    rule
        When the flag is set, in words.
    limit
        The threshold in short, to be formatted with the fields of `Thresholds`.
    source
        Where the pattern or its threshold comes from.
    measure
        Statistic of every pixel.
    large_enough
        Whether the effect counts, however significant it is.
    test
        p-value of the hypothesis that the pattern is absent, or None where there is none.
    decisive
        Whether the flag needs that p-value to be significant; otherwise it stands beside.
    interval
        95 % interval of the statistic, shape (..., 2), or None where there is none.
    excluded_by
        Flags that rule this one out.
    """

    name: str
    meaning: str
    statistic: str
    rule: str
    limit: str
    source: str
    measure: Callable[[PixelStatistics], Floats]
    large_enough: Callable[[PixelStatistics, Thresholds], Mask]
    test: Callable[[PixelStatistics, Thresholds], Floats] | None = None
    decisive: bool = False
    interval: Callable[[PixelStatistics], Floats] | None = None
    excluded_by: tuple[str, ...] = ()


def _null_share(e: PixelStatistics) -> Floats:
    with np.errstate(invalid="ignore"):
        return np.asarray(e.part.n_null / e.part.n_good)


def _null_p_value(e: PixelStatistics, t: Thresholds) -> Floats:
    """Return P(as many nulls or more) were their share the threshold: the exact binomial test."""
    n, nulls = e.part.n_good, e.part.n_null
    p = special.betainc(np.maximum(nulls, 1), n - nulls + 1, t.null_share)
    return np.where(n == 0, np.nan, np.where(nulls == 0, 1.0, p))


def _clear_modes(e: PixelStatistics, t: Thresholds) -> Counts:
    """Count modes that are far enough from their neighbour; 0 where modes are not known."""
    clear = 1 + np.count_nonzero(e.widest[0] >= t.ashman_d, axis=-1)
    return np.where(e.modes.modes > 0, clear, 0)


def _separation_interval(e: PixelStatistics, widest: int) -> Floats:
    separation, error = (values[..., widest] for values in e.widest)
    ends = separation - Z_95 * error, separation + Z_95 * error
    return np.maximum(np.stack(ends, axis=-1), 0)


def _is_described(e: PixelStatistics, t: Thresholds) -> Mask:
    """Say where there is one mode that gamma or log-normal describes."""
    by_chance = _CHANCE / np.sqrt(np.maximum(e.part.n, 1))
    return np.asarray((e.misfit <= np.maximum(t.misfit, by_chance)) & (_clear_modes(e, t) == 1))


def _body_is_long(e: PixelStatistics, t: Thresholds) -> Mask:
    """Say where a pixel is log-normal with a long tail, and its largest samples do not object.

    The tail of a gamma distribution is exponential, however heavy it seems above its quantile 0.9.
    """
    is_lognormal = e.vuong_z <= 0
    objects = e.tail.interval[..., 1] < t.tail_index
    is_long = is_lognormal & (e.body_index >= t.tail_index)
    return np.asarray(_is_described(e, t) & is_long & ~objects)


def _tail_p_value(e: PixelStatistics, t: Thresholds) -> Floats:
    """Return the p-value of the tail, or of tail and body where it is the body's that is long.

    Every log-normal distribution has a long body, so that this one needs log-normal to be
    significantly better than gamma, too: of 32 exponential samples, it often is a little better. Of
    two tests, the smaller p-value counts twice (Bonferroni).
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        of_body = np.fmax(special.ndtr(-e.body_index / e.body_index_se), special.ndtr(e.vuong_z))
    both = np.minimum(2 * np.fmin(of_body, e.tail.p_exponential), 1.0)
    return np.where(_body_is_long(e, t), both, e.tail.p_exponential)


def _is_like(sign: int) -> Callable[[PixelStatistics, Thresholds], Mask]:
    """Say where gamma (1) or log-normal (-1) is the better one, of one mode with a short tail."""

    def large_enough(e: PixelStatistics, t: Thresholds) -> Mask:
        short = (sign > 0) | (e.body_index < t.tail_index)
        return np.asarray((sign * e.vuong_z > 0) & _is_described(e, t) & short)

    return large_enough


def _log_spread(e: PixelStatistics) -> Floats:
    return np.asarray(np.sqrt(e.part.log_statistics.log_variance))


_TAIL_SOURCE = (
    "Pickands 1975, doi:10.1214/aos/1176343003; Zhang and Stephens 2009, "
    "doi:10.1198/tech.2009.08017; Smith 1987, doi:10.1214/aos/1176350499"
)
_MODE_SOURCE = (
    "Ashman, Bird and Zepf 1994, doi:10.1086/117248; Hartigan and Hartigan 1985, "
    "doi:10.1214/aos/1176346577"
)
_FAMILY_SOURCE = (
    "Vuong 1989, doi:10.2307/1912557; Stephens 1974, doi:10.1080/01621459.1974.10480196"
)
_NO_BODY = ("constant", "bimodal", "multimodal", "long_tail")

PATTERNS: tuple[Pattern, ...] = (
    Pattern(
        name="null_heavy",
        meaning="most paths find no light: small or hidden emitters, occlusion",
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
        meaning="rare bright paths carry the variance: more samples help less than they should",
        statistic="generalised Pareto tail index, without a sample that dominates",
        rule="the index is at least the threshold and significantly above that of a gamma tail; or "
        "that of log-normal is, which describes the samples, and the former's interval reaches it",
        limit="≥ {tail_index:g}",
        source=_TAIL_SOURCE,
        measure=lambda e: e.tail.xi,
        large_enough=lambda e, t: (e.tail.xi >= t.tail_index) | _body_is_long(e, t),
        test=_tail_p_value,
        decisive=True,
        interval=lambda e: e.tail.interval,
    ),
    Pattern(
        name="bimodal",
        meaning="two kinds of paths at once: direct and indirect, lit and shadowed",
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
        statistic="Vuong's z of gamma against log-normal",
        rule="one mode, no long tail, gamma is likelier than log-normal and no misfit",
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
        statistic="Vuong's z of log-normal against gamma",
        rule="one mode, no long tail, log-normal is likelier than gamma and no misfit",
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
        statistic="standard deviation of the natural logarithm of luminance",
        rule="no larger than the threshold, about what rounding leaves",
        limit="≤ {constant:g}",
        source="a definition, not a test",
        measure=_log_spread,
        large_enough=lambda e, t: (_log_spread(e) <= t.constant) & (e.part.n > 1),
    ),
)
"""The patterns, in no order; `Label` has the order."""
