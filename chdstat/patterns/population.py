"""Population of random CHDs whose patterns are known, and flags scored on it.

`truth` says which patterns a known CHD has, and None within the indifference zone of a pattern.
`random_chds` draws CHDs with every pattern and combination, outside of these zones; `flag_scores`
counts how often `classify` is right about them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, generator, spans
from chdstat._core.positive import PositivePart
from chdstat.errors import InputError
from chdstat.patterns.classification import Label, Patterns, patterns_of_part
from chdstat.patterns.known_chds import CHD, Component, Kind
from chdstat.patterns.pixel_statistics import firefly_limit
from chdstat.patterns.table import PATTERNS, Thresholds

__all__ = [
    "ALIKE",
    "FIREFLY_ZONE",
    "NULL_ZONE",
    "SEPARATION_ZONE",
    "TAIL_ZONE",
    "FlagScore",
    "Truth",
    "flag_scores",
    "random_chds",
    "truth",
]

NULL_ZONE = (0.45, 0.55)
"""Shares of nulls that are neither heavy nor light."""
TAIL_ZONE = (0.1, 0.3)
"""Tail indices that are neither long nor short."""
SEPARATION_ZONE = (1.5, 2.5)
"""Ashman's D at which two components are neither two modes nor one."""
ALIKE = 0.365
"""Standard deviation of log x below which gamma and log-normal are nearly the same."""
FIREFLY_ZONE = (0.0, 0.2)
"""Planted shares of the sum that neither dominate a pixel nor leave it alone."""


@dataclass(frozen=True)
class Truth:
    """What is true of a CHD.

    Attributes
    ----------
    flags
        By the name of each flag of `chdstat.patterns`: whether it holds, None where the CHD lies in
        the indifference zone of the flag.
    label
        First `Label` that holds; UNDETERMINED where one that would come first is None.
    tail_index
        Of the excesses over the quantile 0.9 of what is not null; NaN for a constant.
    modes
        Components; 0 for a black pixel.
    separations
        Ashman's D of neighbouring components, shape (components - 1,).
    mean
        Expectation of radiance, a planted firefly left out, in W sr-1 m-2.
    """

    flags: Mapping[str, bool | None]
    label: Label
    tail_index: float
    modes: int
    separations: npt.NDArray[np.float64]
    mean: float


def truth(chd: CHD) -> Truth:
    """Say what is true of a CHD.

    A label is true or false only outside of an indifference zone around the threshold that decides
    it; inside, its flag is None:

    * null-heavy: a share of nulls within 0.05 of 1/2 (`NULL_ZONE`: 512 samples do not decide).
    * long tail: a tail index in (0.1, 0.3), `TAIL_ZONE`. That of a body without a grafted tail is
      the penultimate one at its quantile 0.9, so that a log-normal body of sigma 1 or more is
      long-tailed, one of sigma 0.65 or less is not, and what lies between is left out. A gamma
      body is not, whatever its shape.
    * modes: neighbouring components with Ashman's D below 2.5, the end of `SEPARATION_ZONE`, or
      components that do not show as many maxima of the density of log x.
    * gamma-like and log-normal-like: bodies whose logarithm has a standard deviation below 0.365
      (`ALIKE`), that of a gamma distribution of shape 8, are described by both; with a light
      grafted tail, a body is neither.
    * firefly-dominated: a planted share of the sum below 0.2, `FIREFLY_ZONE`. A heavy tail may grow
      a firefly by chance: the label is one of the samples, and those that are drawn decide.

    References
    ----------
    Smith, "Estimating tails of probability distributions", 1987, doi:10.1214/aos/1176350499.
    Ashman, Bird and Zepf, "Detecting bimodality in astronomical datasets", 1994,
    doi:10.1086/117248.

    Examples
    --------
    >>> from chdstat.patterns import Component
    >>> found = truth(CHD((Component("gamma", 2.0),), tail_index=0.5, null_share=0.7))
    >>> found.label.name, found.flags["null_heavy"], found.flags["bimodal"]
    ('LONG_TAIL', True, False)
    """
    black = chd.null_share == 1
    tail_index = np.nan if black else chd.penultimate_index()
    flags = _flags(chd, tail_index)
    return Truth(
        flags=flags,
        label=Label.BLACK if black else _label(flags),
        tail_index=tail_index,
        modes=0 if black else len(chd.body),
        separations=chd.separations(),
        mean=chd.mean(),
    )


def _flags(chd: CHD, tail_index: float) -> dict[str, bool | None]:
    if chd.null_share == 1:
        absent = ("constant", "firefly_dominated", "long_tail", "bimodal", "multimodal")
        return {
            "null_heavy": True,
            **dict.fromkeys((*absent, "gamma_like", "lognormal_like"), False),
        }
    several = _has_modes(chd)
    exponential = chd.tail_index is None and all(c.family == "gamma" for c in chd.body)
    long_tail = False if chd.is_constant or exponential else _above(tail_index, TAIL_ZONE)
    return {
        "null_heavy": _above(chd.null_share, NULL_ZONE),
        "constant": chd.is_constant and not chd.firefly_share,
        "firefly_dominated": chd.firefly_share > 0 and _above(chd.firefly_share, FIREFLY_ZONE),
        "long_tail": long_tail,
        "bimodal": several and len(chd.body) == 2,
        "multimodal": several and len(chd.body) > 2,
        "gamma_like": _is_like(chd, "gamma", long_tail),
        "lognormal_like": _is_like(chd, "lognormal", long_tail),
    }


def _above(value: float, zone: tuple[float, float]) -> bool | None:
    """Say whether a value is above a zone; None inside."""
    return None if zone[0] < value < zone[1] else value >= zone[1]


def _has_modes(chd: CHD) -> bool | None:
    """Say whether every component shows as a mode; None where it is hard to decide."""
    if len(chd.body) == 1:
        return False
    separated = chd.separations().min() >= SEPARATION_ZONE[1]
    return True if separated and chd.maxima() == len(chd.body) else None


def _is_like(chd: CHD, family: Kind, long_tail: bool | None) -> bool | None:
    if len(chd.body) > 1 or chd.is_constant or long_tail:
        return False
    either = chd.body[0].log_deviation < ALIKE
    if long_tail is None or chd.tail_index is not None or either:
        return None
    return chd.body[0].family == family


def _label(flags: Mapping[str, bool | None]) -> Label:
    for label in Label:
        holds = flags.get(label.name.lower(), False)
        if holds is None:
            return Label.UNDETERMINED
        if holds:
            return label
    return Label.UNDETERMINED


_ROWS = 256
"""CHDs drawn and classified at once."""


@dataclass(frozen=True)
class FlagScore:
    """How often a flag is right.

    Attributes
    ----------
    hits, false, missed
        CHDs that have the pattern and the flag; the flag only; the pattern only.
    """

    hits: int
    false: int
    missed: int

    @property
    def precision(self) -> float:
        """Share of the flags that are right; NaN without a flag."""
        return self.hits / (self.hits + self.false) if self.hits + self.false else math.nan

    @property
    def recall(self) -> float:
        """Share of the patterns that are found; NaN without a pattern."""
        return self.hits / (self.hits + self.missed) if self.hits + self.missed else math.nan

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; NaN with neither flag nor pattern."""
        total = 2 * self.hits + self.false + self.missed
        return 2 * self.hits / total if total else math.nan


def random_chds(count: int, *, seed: Seed = None) -> tuple[CHD, ...]:
    """Draw CHDs from a population that has every pattern and their combinations.

    ===============  ===============================================================================
    body             one component 56 %, two 17 %, three 17 %, constant 10 %; all of a CHD gamma or
                     all log-normal; brightness log-uniform over four decades
    one component    gamma shape 0.5 to 6, log-uniform; log-normal sigma 0.3 to 1.2
    two, three       gamma shape 1 to 6, log-uniform; log-normal sigma 0.3 to 0.8; Ashman's D of
                     neighbours 2.5 to 6; weights 0.25 to 0.75 of two, at least 0.2 of three
    tail             grafted to half of those with one component and a quarter of the others; xi 0
                     to 0.75; share 0.1 to 0.25, at most half the weight of the brightest component
    nulls            none 40 %, a share below one half 30 %, from there to 0.95 30 %
    firefly          15 %, not of constants: carries 0.25 to 0.75 of the sum of a pixel
    ===============  ===============================================================================

    Numbers are uniform where nothing else is given. What falls in an indifference zone is
    drawn again; a light grafted tail alone leaves the family of the body open.

    Parameters
    ----------
    count
        How many.
    seed
        Of the draws.

    Examples
    --------
    >>> sorted({len(chd.body) for chd in random_chds(50, seed=1)})
    [1, 2, 3]
    """
    rng = generator(seed)
    return tuple(_random_chd(rng) for _ in range(count))


def flag_scores(
    chds: Sequence[CHD],
    samples: int,
    *,
    thresholds: Thresholds | None = None,
    seed: Seed = 0,
) -> Mapping[str, FlagScore]:
    """Draw one pixel of each CHD, classify it, and compare the flags with the truth.

    What lies in an indifference zone of a flag does not count for it. Whether a firefly dominates
    is asked of the samples: shares between half and twice the threshold do not count.

    Parameters
    ----------
    chds
        Distributions, such as those of `random_chds`.
    samples
        Samples of each pixel that are not null; the number of nulls is as random as it is where
        sampling goes on until there are so many.
    thresholds
        When a pattern counts; None for the defaults.
    seed
        Of the draws.

    Returns
    -------
    dict
        `FlagScore` by the name of the flag.

    Raises
    ------
    InputError
        If `samples` is not positive, or a CHD has nulls only.

    Examples
    --------
    >>> scores = flag_scores(random_chds(100, seed=1), 512)
    >>> scores["null_heavy"].f1 > 0.9
    True
    """
    if samples < 1 or any(chd.null_share == 1 for chd in chds):
        message = f"flag_scores needs samples >= 1 and CHDs that are not black, got {samples}"
        raise InputError(message)
    thresholds = thresholds or Thresholds()
    rng = generator(seed)
    totals = {pattern.name: np.zeros(3, dtype=int) for pattern in PATTERNS}
    for some in spans(len(chds), _ROWS):
        part = _draw(chds[some], samples, rng)
        patterns = patterns_of_part(part, thresholds)
        for name, wanted in _truths(chds[some], patterns, samples, thresholds).items():
            flag = patterns.flags[name]
            cases = flag & (wanted == 1), flag & (wanted == 0), ~flag & (wanted == 1)
            totals[name] += [np.count_nonzero(case) for case in cases]
    return {name: FlagScore(*(int(count) for count in counts)) for name, counts in totals.items()}


def _draw(chds: Sequence[CHD], samples: int, rng: np.random.Generator) -> PositivePart:
    rows = [replace(chd, null_share=0.0).draw(samples=samples, seed=rng) for chd in chds]
    share = np.array([chd.null_share for chd in chds])
    n = np.full(len(chds), samples)
    none = np.zeros_like(n)
    nulls = rng.negative_binomial(samples, 1 - share)
    x = np.stack(rows)
    return PositivePart(x, np.asarray(x > 0), n, nulls, none, none, none)


def _truths(
    chds: Sequence[CHD], patterns: Patterns, samples: int, thresholds: Thresholds
) -> dict[str, npt.NDArray[np.int8]]:
    """Return 1 where a flag should be set, 0 where it should not, -1 where either is fine."""
    known = [truth(chd).flags for chd in chds]
    wanted = {
        name: np.array([-1 if flags[name] is None else flags[name] for flags in known], np.int8)
        for name in known[0]
    }
    limit = firefly_limit(np.array(samples), thresholds.firefly_share, thresholds.firefly_samples)
    ratio = patterns.statistics["firefly_dominated"] / limit
    wanted["firefly_dominated"] = np.select([ratio >= 2, ratio <= 0.5], [1, 0], -1).astype(np.int8)
    return wanted


def _random_chd(rng: np.random.Generator) -> CHD:
    """Draw until the CHD lies outside of every zone."""
    while True:
        chd = _candidate(rng)
        found = truth(chd).flags
        undecided = {name for name, holds in found.items() if holds is None}
        light_tail = chd.tail_index is not None and len(chd.body) == 1
        if light_tail:
            undecided -= {"gamma_like", "lognormal_like"}
        if not undecided:
            return chd


def _candidate(rng: np.random.Generator) -> CHD:
    number = rng.choice(4, p=[0.1, 0.56, 0.17, 0.17])
    null_share = rng.choice([0.0, rng.uniform(0, 0.5), rng.uniform(0.5, 0.95)], p=[0.4, 0.3, 0.3])
    brightness = 10 ** rng.uniform(-3, 1)
    if number == 0:
        return CHD((Component("constant", median=brightness),), null_share=null_share)
    body = _random_body(int(number), brightness, rng)
    has_tail = rng.random() < (0.5 if number == 1 else 0.25)
    most = min(0.25, 0.5 * body[-1].weight)
    return CHD(
        body,
        tail_index=rng.uniform(0, 0.75) if has_tail else None,
        tail_share=rng.uniform(0.1, most),
        null_share=null_share,
        firefly_share=rng.uniform(0.25, 0.75) if rng.random() < 0.15 else 0.0,
    )


def _random_body(number: int, brightness: float, rng: np.random.Generator) -> tuple[Component, ...]:
    """Draw components, the darkest first, whose neighbours have a drawn separation."""
    family: Kind = "gamma" if rng.random() < 0.5 else "lognormal"
    body: list[Component] = []
    for weight in _random_weights(number, rng):
        if family == "gamma":
            shape = math.exp(rng.uniform(math.log(0.5 if number == 1 else 1.0), math.log(6)))
        else:
            shape = rng.uniform(0.3, 1.2 if number == 1 else 0.8)
        new = Component(family, shape, brightness, weight)
        if body:
            spread = math.hypot(body[-1].log_deviation, new.log_deviation) / math.sqrt(2)
            place = body[-1].log_mean + rng.uniform(2.5, 6) * spread
            new = Component(family, shape, brightness * math.exp(place - new.log_mean), weight)
        body.append(new)
    return tuple(body)


def _random_weights(number: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    if number == 1:
        return np.ones(1)
    least = 0.25 if number == 2 else 0.2
    return np.asarray(least + (1 - number * least) * rng.dirichlet(np.ones(number)))
