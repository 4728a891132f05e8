"""Population: CHDs at random with every pattern and combination, and flags scored on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator, spans
from chdstat._positive import PositivePart
from chdstat.errors import InputError
from chdstat.patterns import PATTERNS, Patterns, Thresholds, patterns_of_part
from chdstat.patterns._evidence import firefly_limit
from chdstat.simulation._chd import CHD
from chdstat.simulation._component import Component, Kind
from chdstat.simulation._truth import truth

__all__ = ["FlagScore", "flag_scores", "random_chds"]

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


def random_chds(count: int, *, seed: int | np.random.Generator | None = None) -> tuple[CHD, ...]:
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

    Numbers are uniform where nothing else is said. What falls in an indifference zone of the module
    is drawn again; a light grafted tail alone leaves the family of the body open.

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
    seed: int | np.random.Generator | None = 0,
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
