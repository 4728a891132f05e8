"""How often the flags of `chdstat.classify` are right about CHDs whose patterns are known.

`truth` says which patterns a CHD has, with None within the indifference zone of a pattern.
`random_chds` draws CHDs with every pattern and combination, outside these zones. `flag_scores`
counts how often `classify` is right about them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from chdstat._core.positive import PositivePart
from chdstat.fit.tail import effective_tail_index
from chdstat.patterns import CHD, PATTERNS, Component, Label, Thresholds
from chdstat.patterns.classification import Classification
from chdstat.patterns.definitions import firefly_limit
from chdstat.summary.runner import measured

_GRID, _WIDE = 1000, 5.0
"""Points at which maxima of the density are counted, and standard deviations that they reach."""


def log_moments(component):
    """Return expectation and standard deviation of log x."""
    if component.family == "gamma":
        mean = np.log(component.scale) + special.digamma(component.shape)
        return float(mean), float(np.sqrt(special.polygamma(1, component.shape)))
    return math.log(component.median), component.shape if component.family == "lognormal" else 0.0


def separations(chd):
    """Return Ashman's D of neighbouring components, for logarithms."""
    mean, deviation = np.transpose(sorted(log_moments(component) for component in chd.body))
    return np.sqrt(2) * np.diff(mean) / np.sqrt(deviation[1:] ** 2 + deviation[:-1] ** 2)


def maxima(chd):
    """Count the maxima of the density of log x."""
    if chd.is_constant:
        return 1
    mean, deviation = np.transpose([log_moments(component) for component in chd.body])
    ends = (mean - _WIDE * deviation).min(), (mean + _WIDE * deviation).max()
    x = np.exp(np.linspace(*ends, _GRID))
    rising = np.diff(x * chd.pdf(x)) > 0
    return int(np.count_nonzero(rising[:-1] & ~rising[1:]))


def penultimate_index(chd, share=0.1):
    """Return the tail index that excesses over the quantile ``1 - share`` show.

    Within a grafted tail, it is the tail index itself.
    """
    if chd.is_constant:
        return np.nan
    if chd.tail_index is not None and share <= chd.tail_share:
        return chd.tail_index
    body = replace(chd, tail_index=None, null_share=0.0)
    return float(effective_tail_index(body, share))


NULL_ZONE = (0.45, 0.55)
"""Shares of nulls that are neither heavy nor light: 512 samples do not decide."""
TAIL_ZONE = (0.5, 1.0)
"""Tail indices with a mean but no variance, whose error bars hold or fail."""
BODY_ZONE = (0.1, 0.3)
"""Tail indices of a body that is neither plain nor not."""
SEPARATION_ZONE = (1.5, 2.5)
"""Ashman's D at which two components are neither two modes nor one."""
INDISTINCT_SPREAD = 0.365
"""Standard deviation of log x below which gamma and log-normal are nearly the same."""
FIREFLY_ZONE = (0.0, 0.2)
"""Planted shares of the sum that neither dominate a pixel nor leave it alone."""


@dataclass(frozen=True)
class Truth:
    """The flags of a CHD, None in an indifference zone, and the first label that holds.

    The label is UNDETERMINED if one before it is None.
    """

    flags: Mapping[str, bool | None]
    label: Label
    tail_index: float


def truth(chd):
    """Return what is true of a CHD.

    A body without a grafted tail has its penultimate index at its 0.9 quantile. A planted firefly
    is a long tail. A heavy tail may grow a firefly by chance: in `flag_scores`, samples decide.
    """
    black = chd.null_share == 1
    tail_index = np.nan if black else penultimate_index(chd)
    flags = _flags(chd, tail_index)
    return Truth(flags, Label.BLACK if black else _label(flags), tail_index)


def _flags(chd, tail_index):
    if chd.null_share == 1:
        return {pattern.name: pattern.name == "null_heavy" for pattern in PATTERNS}
    first, count = chd.body[0], len(chd.body)
    modes = count > 1
    if modes and (separations(chd).min() < SEPARATION_ZONE[1] or maxima(chd) != count):
        modes = None
    exponential = chd.tail_index is None and all(c.family == "gamma" for c in chd.body)
    light = chd.is_constant or exponential
    firefly = chd.firefly_share > 0 and _above(chd.firefly_share, FIREFLY_ZONE)
    heavy = False if light else _above(tail_index, BODY_ZONE)
    plain = count == 1 and not chd.is_constant and not heavy
    either = heavy is None or log_moments(first)[1] < INDISTINCT_SPREAD

    def is_like(family):
        if plain and (either or chd.tail_index is not None):
            return None
        return plain and first.family == family

    return {
        "null_heavy": _above(chd.null_share, NULL_ZONE),
        "constant": chd.is_constant and not chd.firefly_share,
        "firefly_dominated": firefly,
        "long_tail": firefly if firefly is not False or light else _above(tail_index, TAIL_ZONE),
        "bimodal": modes and count == 2,
        "multimodal": modes and count > 2,
        "gamma_like": is_like("gamma"),
        "lognormal_like": is_like("lognormal"),
    }


def _above(value, zone):
    """Return whether a value is above a zone; None inside."""
    return None if zone[0] < value < zone[1] else value >= zone[1]


def _label(flags):
    for label in Label:
        holds = flags.get(label.name.lower(), False)
        if holds is None or holds:
            return Label.UNDETERMINED if holds is None else label
    return Label.UNDETERMINED


@dataclass(frozen=True)
class FlagScore:
    """Numbers of CHDs with pattern and flag; with the flag only; with the pattern only."""

    hits: int
    false: int
    missed: int

    @property
    def precision(self):
        """Share of the flags that are right; NaN without a flag."""
        return self.hits / (self.hits + self.false) if self.hits + self.false else math.nan

    @property
    def recall(self):
        """Share of the patterns that are found; NaN without a pattern."""
        return self.hits / (self.hits + self.missed) if self.hits + self.missed else math.nan

    @property
    def f1(self):
        """Harmonic mean of precision and recall; NaN with neither flag nor pattern."""
        total = 2 * self.hits + self.false + self.missed
        return 2 * self.hits / total if total else math.nan


def random_chds(count, *, seed):
    """Draw CHDs from a population that has every pattern and their combinations.

    ===============  ===============================================================================
    body             one component 56 %, two 17 %, three 17 %, constant 10 %; all of a CHD gamma or
                     all log-normal; brightness log-uniform over four decades
    one component    gamma shape 0.5 to 6, log-uniform; log-normal sigma 0.3 to 1.2
    two, three       gamma shape 1 to 6, log-uniform; log-normal sigma 0.3 to 0.8; Ashman's D of
                     neighbours 2.5 to 6; weights 0.25 to 0.75 of two, at least 0.2 of three
    tail             grafted to half of those with one component and a quarter of the others; xi 0
                     to 0.5, or 1 to 1.5; share 0.1 to 0.25, at most half the weight of the
                     brightest component
    nulls            none 40 %, a share below one half 30 %, from there to 0.95 30 %
    firefly          15 %, not of constants: carries 0.25 to 0.75 of the sum of a pixel
    ===============  ===============================================================================

    Numbers are uniform unless stated otherwise. CHDs in an indifference zone are drawn again,
    except that a light grafted tail alone leaves the family of the body open.
    """
    rng = np.random.default_rng(seed)
    chosen = []
    while len(chosen) < count:
        chd = _random_chd(rng)
        undecided = {name for name, holds in truth(chd).flags.items() if holds is None}
        if chd.tail_index is not None and len(chd.body) == 1:
            undecided -= {"gamma_like", "lognormal_like"}
        if not undecided:
            chosen.append(chd)
    return tuple(chosen)


def _random_chd(rng):
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
        tail_index=rng.choice([rng.uniform(0, 0.5), rng.uniform(1, 1.5)]) if has_tail else None,
        tail_share=rng.uniform(0.1, most),
        null_share=null_share,
        firefly_share=rng.uniform(0.25, 0.75) if rng.random() < 0.15 else 0.0,
    )


def _random_body(number, brightness, rng):
    """Draw components, the darkest first, with a drawn separation of neighbours."""
    family = "gamma" if rng.random() < 0.5 else "lognormal"
    weights = np.ones(1)
    if number > 1:
        least = 0.25 if number == 2 else 0.2
        weights = least + (1 - number * least) * rng.dirichlet(np.ones(number))
    body = []
    for weight in weights:
        if family == "gamma":
            shape = math.exp(rng.uniform(math.log(0.5 if number == 1 else 1.0), math.log(6)))
        else:
            shape = rng.uniform(0.3, 1.2 if number == 1 else 0.8)
        new = Component(family, shape, brightness, weight)
        if body:
            (low, spread), (mean, own) = log_moments(body[-1]), log_moments(new)
            place = low + rng.uniform(2.5, 6) * math.hypot(spread, own) / math.sqrt(2)
            new = replace(new, median=brightness * math.exp(place - mean))
        body.append(new)
    return tuple(body)


def flag_scores(chds, samples, *, seed=0):
    """Draw one pixel of each CHD, classify it, and return the `FlagScore` of each flag by name.

    A CHD in the indifference zone of a flag does not count for that flag. Whether a firefly
    dominates is decided by the samples: shares between half and twice the threshold do not count.
    Each pixel has so many `samples` that are not null, as if sampling went on until there are.
    """
    rng, thresholds = np.random.default_rng(seed), Thresholds()
    totals = {pattern.name: np.zeros(3, dtype=int) for pattern in PATTERNS}
    for start in range(0, len(chds), 256):
        these = chds[start : start + 256]
        draws = [replace(chd, null_share=0.0).draw(samples=samples, seed=rng) for chd in these]
        x = np.stack(draws)
        nulls = rng.negative_binomial(samples, [1 - chd.null_share for chd in these])
        none = np.zeros_like(nulls)
        part = PositivePart(x, np.asarray(x > 0), none + samples, nulls, none, none, none)
        patterns = measured(part, Classification(thresholds))
        true = [truth(chd).flags for chd in these]
        wanted = {n: np.array([-1 if t[n] is None else t[n] for t in true]) for n in totals}
        ratio = patterns.statistics["firefly_dominated"] / firefly_limit(samples, thresholds)
        wanted["firefly_dominated"] = np.select([ratio >= 2, ratio <= 0.5], [1, 0], -1)
        for name, code in wanted.items():
            flag = patterns.flags[name]
            cases = flag & (code == 1), flag & (code == 0), ~flag & (code == 1)
            totals[name] += [np.count_nonzero(case) for case in cases]
    return {name: FlagScore(*map(int, counts)) for name, counts in totals.items()}
