"""Simulation: images and populations of CHDs whose patterns are known, and flags scored on them.

`truth` says which patterns a known CHD has, and None within the indifference zone of a pattern.
`simulate` draws an image whose regions have given CHDs, `random_chds` CHDs with every pattern and
combination, outside of these zones; `flag_scores` counts how often `classify` is right about them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import LUMINANCE, Seed, generator, spans
from chdstat._core.display import Shown
from chdstat._core.positive import PositivePart
from chdstat._core.reasons import flag_attributes
from chdstat._core.statistic import RADIANCE
from chdstat.errors import InputError, check_option
from chdstat.patterns.classification import Classification, Label
from chdstat.patterns.definitions import PATTERNS, Thresholds, firefly_limit
from chdstat.patterns.known_chds import CHD, CHDS, Component, Kind, random_chd
from chdstat.samples import Samples
from chdstat.summary.runner import measured

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "FIREFLY_ZONE",
    "INDISTINCT_SPREAD",
    "NULL_ZONE",
    "SEPARATION_ZONE",
    "TAIL_ZONE",
    "FlagScore",
    "Truth",
    "flag_scores",
    "random_chds",
    "simulate",
    "truth",
    "truth_of",
]

NULL_ZONE = (0.45, 0.55)
"""Shares of nulls that are neither heavy nor light."""
TAIL_ZONE = (0.1, 0.3)
"""Tail indices that are neither long nor short."""
SEPARATION_ZONE = (1.5, 2.5)
"""Ashman's D at which two components are neither two modes nor one."""
INDISTINCT_SPREAD = 0.365
"""Standard deviation of log x below which gamma and log-normal are nearly the same."""
FIREFLY_ZONE = (0.0, 0.2)
"""Planted shares of the sum that neither dominate a pixel nor leave it alone."""


@dataclass(frozen=True, repr=False)
class Truth(Shown):
    """The true properties of a simulated CHD.

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
    mean
        Expectation of radiance, a planted firefly left out, in W sr-1 m-2.
    """

    flags: Mapping[str, bool | None]
    label: Label
    tail_index: float
    modes: int
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
      (`INDISTINCT_SPREAD`), that of a gamma distribution of shape 8, are described by both; with
      a light grafted tail, a body is neither.
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
        mean=chd.mean(),
    )


def _flags(chd: CHD, tail_index: float) -> dict[str, bool | None]:
    if chd.null_share == 1:
        return {pattern.name: pattern.name == "null_heavy" for pattern in PATTERNS}
    first, count = chd.body[0], len(chd.body)
    modes: bool | None = count > 1
    if modes and (chd.separations().min() < SEPARATION_ZONE[1] or chd.maxima() != count):
        modes = None
    exponential = chd.tail_index is None and all(c.family == "gamma" for c in chd.body)
    long_tail = False if chd.is_constant or exponential else _above(tail_index, TAIL_ZONE)
    plain = count == 1 and not chd.is_constant and not long_tail
    either = long_tail is None or first.log_deviation < INDISTINCT_SPREAD

    def is_like(family: Kind) -> bool | None:
        if plain and (either or chd.tail_index is not None):
            return None
        return plain and first.family == family

    return {
        "null_heavy": _above(chd.null_share, NULL_ZONE),
        "constant": chd.is_constant and not chd.firefly_share,
        "firefly_dominated": chd.firefly_share > 0 and _above(chd.firefly_share, FIREFLY_ZONE),
        "long_tail": long_tail,
        "bimodal": modes and count == 2,
        "multimodal": modes and count > 2,
        "gamma_like": is_like("gamma"),
        "lognormal_like": is_like("lognormal"),
    }


def _above(value: float, zone: tuple[float, float]) -> bool | None:
    """Say whether a value is above a zone; None inside."""
    return None if zone[0] < value < zone[1] else value >= zone[1]


def _label(flags: Mapping[str, bool | None]) -> Label:
    for label in Label:
        holds = flags.get(label.name.lower(), False)
        if holds is None or holds:
            return Label.UNDETERMINED if holds is None else label
    return Label.UNDETERMINED


def simulate(
    chds: str | CHD | Sequence[str | CHD],
    *,
    shape: tuple[int, int] = (64, 64),
    spp: int = 512,
    seed: Seed = 0,
) -> Samples:
    """Draw an image whose regions have given CHDs.

    Regions are the cells of a grid that is as square as possible, in reading order; cells that are
    left over have the last CHD.

    Parameters
    ----------
    chds
        One `CHD` or several, or names of `CHDS`.
    shape
        (height, width) in pixels.
    spp
        Samples of each pixel, nulls included.
    seed
        Of the draws: the same seed, the same samples.

    Returns
    -------
    Samples
        In memory, three channels in the ratios of each CHD's colour, so that luminance is what the
        CHD says. `truth_of` returns what is true of each pixel.

    Raises
    ------
    InputError
        If a name is unknown, or the shape leaves a region without a pixel.

    Examples
    --------
    >>> samples = simulate(["gamma", "bimodal"], shape=(2, 4), spp=64)
    >>> samples
    <Samples 'simulated' 4 x 2 pixels, 3 channels, 64 spp, in memory>
    >>> truth_of(samples)["modes"].to_numpy()
    array([[1, 1, 2, 2],
           [1, 1, 2, 2]], dtype=int8)
    """
    given = [chds] if isinstance(chds, (str, CHD)) else list(chds)
    for name in given:
        if isinstance(name, str):
            check_option("CHD", name, CHDS)
    chosen = [CHDS[chd] if isinstance(chd, str) else chd for chd in given]
    if len(shape) != 2 or min(shape) < 1 or spp < 1 or not chosen:
        message = f"simulate needs a CHD, a shape (height, width) and spp >= 1; got {shape}, {spp}"
        raise InputError(message)
    region = _regions(len(chosen), shape)
    image = np.empty((*shape, 3, spp), dtype=np.float32)
    streams = generator(seed).spawn(len(chosen))
    for index, (chd, rng) in enumerate(zip(chosen, streams, strict=True)):
        here = region == index
        radiance = chd.draw(int(np.count_nonzero(here)), samples=spp, seed=rng)
        color = np.array(chd.color) / (LUMINANCE @ np.array(chd.color))
        image[here] = radiance[:, np.newaxis] * color[:, np.newaxis]
    described = json.dumps([asdict(chd) for chd in chosen])
    return Samples.from_array(image, axes="yxcs", scene="simulated", simulated_chds=described)


def truth_of(samples: Samples) -> xr.Dataset:
    """Return what is true of each pixel of an image that `simulate` made.

    Returns
    -------
    xarray.Dataset
        Over (y, x): ``region``; each flag by its name, 1, 0, or -1 in an indifference zone;
        ``label``; ``tail_index``; ``modes``; ``mean`` of luminance, a planted firefly left out.

    Raises
    ------
    InputError
        If the samples were not simulated.
    """
    if "simulated_chds" not in samples.attrs:
        message = f"truth_of needs samples made by chdstat.simulate, got {samples!r}"
        raise InputError(message)
    import xarray as xr

    truths = []
    for chd in json.loads(samples.attrs["simulated_chds"]):
        body = tuple(Component(**component) for component in chd.pop("body"))
        truths.append(truth(CHD(body, color=tuple(chd.pop("color")), **chd)))
    region = _regions(len(truths), samples.shape[:2])
    values: dict[str, npt.NDArray[Any]] = dict(_codes(truths))
    for field, kind in (("label", "i1"), ("tail_index", "f8"), ("modes", "i1"), ("mean", "f8")):
        values[field] = np.array([getattr(found, field) for found in truths], dtype=kind)
    maps = {"region": region, **{name: value[region] for name, value in values.items()}}
    dataset = xr.Dataset({name: (("y", "x"), value) for name, value in maps.items()})
    for name, variable in dataset.data_vars.items():
        variable.attrs.update(long_name=f"true {name}".replace("_", " "), units="1")
    dataset["mean"].attrs["units"] = RADIANCE
    dataset["label"].attrs.update(flag_attributes(Label))
    return dataset


def _regions(count: int, shape: tuple[int, int]) -> npt.NDArray[np.intp]:
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    if rows > shape[0] or columns > shape[1]:
        message = f"{count} regions need at least {rows} x {columns} pixels, got {shape}"
        raise InputError(message)
    y, x = (
        np.arange(edge) * cells // edge for edge, cells in zip(shape, (rows, columns), strict=True)
    )
    return np.asarray(np.minimum(y[:, np.newaxis] * columns + x, count - 1))


def _codes(truths: Sequence[Truth]) -> dict[str, npt.NDArray[np.int8]]:
    """Return by flag 1 where it holds, 0 where it does not, -1 in its indifference zone."""
    return {
        name: np.array([-1 if t.flags[name] is None else t.flags[name] for t in truths], np.int8)
        for name in truths[0].flags
    }


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
    chosen: list[CHD] = []
    while len(chosen) < count:
        chd = random_chd(rng)
        undecided = {name for name, holds in truth(chd).flags.items() if holds is None}
        if chd.tail_index is not None and len(chd.body) == 1:
            undecided -= {"gamma_like", "lognormal_like"}
        if not undecided:
            chosen.append(chd)
    return tuple(chosen)


def flag_scores(
    chds: Sequence[CHD], samples: int, *, thresholds: Thresholds | None = None, seed: Seed = 0
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
    limit = firefly_limit(np.array(samples), thresholds)
    for some in spans(len(chds), _ROWS):
        these = chds[some]
        draws = [replace(chd, null_share=0.0).draw(samples=samples, seed=rng) for chd in these]
        x = np.stack(draws)
        nulls = rng.negative_binomial(samples, [1 - chd.null_share for chd in these])
        none = np.zeros_like(nulls)
        part = PositivePart(x, np.asarray(x > 0), none + samples, nulls, none, none, none)
        patterns = measured(part, Classification(thresholds))
        wanted = _codes([truth(chd) for chd in these])
        ratio = patterns.statistics["firefly_dominated"] / limit
        wanted["firefly_dominated"] = np.select([ratio >= 2, ratio <= 0.5], [1, 0], -1)
        for name, code in wanted.items():
            flag = patterns.flags[name]
            cases = flag & (code == 1), flag & (code == 0), ~flag & (code == 1)
            totals[name] += [np.count_nonzero(case) for case in cases]
    return {name: FlagScore(*(int(count) for count in counts)) for name, counts in totals.items()}
