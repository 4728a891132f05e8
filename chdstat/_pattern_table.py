"""The table of patterns: what each means, how it is measured, and when it counts.

`chdstat.patterns` applies it; a new pattern is a new row of `PATTERNS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special

from chdstat._positive import Floats, Mask, PositivePart
from chdstat._reasons import Reason
from chdstat.errors import InputError
from chdstat.fit.selection import Selection
from chdstat.fit.tail import Tail
from chdstat.modes import Modality

__all__ = ["PATTERNS", "Pattern", "Scores", "Thresholds"]


@dataclass(frozen=True)
class Thresholds:
    """When a pattern counts as one.

    Attributes
    ----------
    alpha
        False discovery rate of every flag over the image; level of the test for a single pixel.
    null_share
        A pixel is null-heavy where more than this share of its samples is null.
    tail_index
        A tail is long where its index is above this.
    ashman_d
        Modes count only where the two Gaussians are this far apart.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    alpha: float = 0.05
    null_share: float = 0.5
    tail_index: float = 0.25
    ashman_d: float = 2.0

    def __post_init__(self) -> None:
        inside = 0 < self.alpha < 1 and 0 < self.null_share < 1
        if not inside or self.tail_index < 0 or self.ashman_d < 0:
            message = (
                "thresholds need alpha and null_share in (0, 1), tail_index and ashman_d >= 0; "
                f"got {self}"
            )
            raise InputError(message)


@dataclass(frozen=True)
class Scores:
    """What the rules look at, per pixel: the answers of the modules upstream."""

    part: PositivePart
    tail: Tail
    modes: Modality
    families: Selection


@dataclass(frozen=True)
class Pattern:
    """A row of `PATTERNS`.

    Attributes
    ----------
    name
        Of the flag.
    meaning
        What it says about light transport.
    statistic
        What is measured, and on which scale; computed by `measure`.
    rule
        When the flag is set, in words.
    source
        Where the pattern or its threshold comes from.
    measure
        Statistic of every pixel.
    test
        p-value of the hypothesis that the pattern is absent, or None where it is no random matter.
    large_enough
        Whether the effect counts, however significant it is.
    """

    name: str
    meaning: str
    statistic: str
    rule: str
    source: str
    measure: Callable[[Scores], Floats]
    test: Callable[[Scores, Thresholds], Floats] | None
    large_enough: Callable[[Scores, Thresholds], Mask]


def _null_share(scores: Scores) -> Floats:
    with np.errstate(invalid="ignore"):
        return np.asarray(scores.part.n_null / scores.part.n_good)


def _null_p_value(scores: Scores, thresholds: Thresholds) -> Floats:
    """Return P(as many nulls or more) were their share the threshold: the exact binomial test."""
    n, nulls = scores.part.n_good, scores.part.n_null
    p = special.betainc(np.maximum(nulls, 1), n - nulls + 1, thresholds.null_share)
    return np.where(n == 0, np.nan, np.where(nulls == 0, 1.0, p))


def _spread(scores: Scores) -> Floats:
    return np.asarray(np.sqrt(scores.part.log_statistics.log_variance))


def _is_constant(scores: Scores, _: Thresholds) -> Mask:
    return np.asarray(scores.part.reason() == Reason.CONSTANT)


PATTERNS: tuple[Pattern, ...] = (
    Pattern(
        name="null_heavy",
        meaning="most paths find no light: small or hidden emitters, occlusion",
        statistic="share of null samples",
        rule="the share is above the threshold (exact binomial test)",
        source="Elek, Thomas and Forbes 2019: often more than 50 % in enclosed scenes",
        measure=_null_share,
        test=_null_p_value,
        large_enough=lambda s, t: _null_share(s) > t.null_share,
    ),
    Pattern(
        name="long_tail",
        meaning="rare bright paths carry the variance: fireflies",
        statistic="generalised Pareto tail index",
        rule="the tail index is above the threshold (one-sided)",
        source="Zhang and Stephens 2009, doi:10.1198/tech.2009.08017; above 1/4 the fourth "
        "moment, and with it the error of the sample variance, is infinite",
        measure=lambda s: s.tail.xi,
        test=lambda s, _: s.tail.p_value,
        large_enough=lambda s, t: s.tail.xi > t.tail_index,
    ),
    Pattern(
        name="bimodal",
        meaning="two kinds of paths at once: direct and indirect, lit and shadowed",
        statistic="Hartigan's dip of log10 luminance",
        rule="the dip rejects one mode, and Ashman's D is at least the threshold",
        source="Hartigan and Hartigan 1985, doi:10.1214/aos/1176346577; Ashman, Bird and Zepf "
        "1994, doi:10.1086/117248",
        measure=lambda s: s.modes.dip,
        test=lambda s, _: s.modes.dip_p_value,
        large_enough=lambda s, t: s.modes.ashman_d >= t.ashman_d,
    ),
    Pattern(
        name="constant",
        meaning="every path that finds light brings the same: emitters and backgrounds seen",
        statistic="standard deviation of the logarithm of luminance",
        rule="no larger than rounding leaves",
        source="a definition, not a test",
        measure=_spread,
        test=None,
        large_enough=_is_constant,
    ),
)
"""The patterns, in no order; `Label` has the order."""
