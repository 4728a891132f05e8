"""Noise rankings: which of several renders of a view is noisier, where in the image, and why.

Noise is the relative variance of the luminance of a sample, weighted as in relMSE, over one image
for all renders. At equal time, it is multiplied by the time of a sample. Of two renders, the ratio
of these sums over the image has an interval of a bootstrap over blocks of pixels. All intervals of
a ranking hold together (Bonferroni). Times are single measurements: intervals at equal time hold if
their ratio is wrong by a factor of up to `TIMING`.

Where in the image a render is the least noisy is tested in square cells of pixels. Let x and y be
samples k of two renders in a pixel, and m the mean of both renders there. If both have one
distribution, (x - m)^2 - (y - m)^2 is as likely to have either sign, and its sum over the samples
is the difference of the variances. So the test of equal means by flips of signs is one of equal
variances, too, with any tails.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from chdstat._core.arrays import (
    Array,
    Floats,
    Image,
    Mask,
    block_sums,
    flag_names,
    is_bad,
    label_variables,
    plain,
)
from chdstat._core.display import Tabled, capital, percent
from chdstat._core.doors import classified, untrusted
from chdstat._core.image_scales import relative_scale
from chdstat._core.resampling import LEVEL, Blocks, Interval, interval_of, mean_of, q_values
from chdstat._core.statistic import RADIANCE
from chdstat.errors import InputError
from chdstat.inference.permutations import p_of_signs
from chdstat.inference.render_pairs import light_of
from chdstat.samples import Samples
from chdstat.samples.layout import differing
from chdstat.samples.samples import provenance
from chdstat.samples.tiles import tiles

At = Literal["equal spp", "equal time"]

_TERMS = 256
"""Most terms of a cell; of more samples, several make a term."""
_CELLS, _LEAST_CELL = 32, 4
"""Most cells along the longer edge of the image, and least edge of a cell in pixels."""
TIMING = 1.7
"""Factor by which a ratio of times may be wrong: a single time has no interval. Three renders of
each of five scenes, on a busy machine, differed by up to 1.6."""
_PICK = 8
"""Least samples that tell patterns, and as many others that tell what they hold."""
_TELLING = 2**14
"""Most pixels that tell patterns: of a larger image, those of every second, third... row and
column."""
_PATTERNS = 3
"""Most patterns by which the noise of a render is explained."""
_APART = 4
"""Examples are this part of the longer edge of the image away from each other."""
_PIXELS = 2
"""Pixels whose samples are kept as examples."""


def cost_ratio(
    one: Array, other: Array, blocks: Blocks, *, level: float = LEVEL, least: float = 0
) -> Interval[float]:
    """Return the sum of costs (pixel,) over that of others, with its interval over blocks.

    Examples
    --------
    >>> cost = np.arange(1.0, 17.0)
    >>> str(cost_ratio(2 * cost, cost, Blocks.grid(4, 4)))
    '2.00'
    """
    a, b = blocks.sums(one), blocks.sums(other)
    return interval_of(lambda w: (w @ a) / (w @ b), blocks, level=level, bounds=(least, np.inf))


@dataclass(frozen=True)
class RankedRender:
    """A render that is ranked by its noise.

    Parameters
    ----------
    name
        What it is called.
    samples
        Its samples, independent of each other, or averages that are.
    mean, variance
        Mean, shape (y, x, channel), and variance of the luminance of a sample, shape (y, x).
    seconds
        Rendering time of one sample in every pixel; NaN if it is unknown.
    """

    name: str
    samples: Samples
    mean: Floats
    variance: Floats
    seconds: float

    @property
    def light(self) -> Floats:
        """Mean luminance, or the mean of channels other than R, G and B, shape (y, x)."""
        return np.asarray(light_of(self.mean[..., np.newaxis])[..., 0])

    def noise(self, scale: Array) -> Floats:
        """Return the relative variance of a sample, shape (y, x).

        Where pixels have different numbers of samples, it is the variance of the mean of a pixel
        times the samples of an average one.
        """
        counts = self.samples.counts if self.samples.unequal else np.ones((1, 1))
        with np.errstate(all="ignore"):
            return np.asarray(self.variance / scale * (counts.mean() / counts))


@dataclass(frozen=True)
class NoiseOrder:
    """Renders in the order of their noise, at equal spp or at equal time.

    Attributes
    ----------
    at
        "equal spp" or "equal time".
    names
        Names of the renders, the least noisy first.
    noise
        Relative variance of a sample, the mean over the image, by name; at equal time, times the
        seconds of a sample in every pixel.
    ratios
        Noise of one render over that of one behind it, by their names, with intervals that hold
        together for all pairs of the ranking.
    doubtful
        Pairs whose order does not hold without the pixels whose variance cannot be trusted.
    """

    at: At
    names: tuple[str, ...]
    noise: Mapping[str, float]
    ratios: Mapping[tuple[str, str], Interval[float]]
    doubtful: frozenset[tuple[str, str]] = frozenset()

    def surely(self, one: str, other: str) -> bool:
        """Return whether one render is less noisy than another: its whole interval says so."""
        return (one, other) in self.ratios and self.ratios[one, other].high < 1

    def rank(self, name: str) -> tuple[int, int]:
        """Return the best and the worst rank that a render may have."""
        better = sum(self.surely(other, name) for other in self.names)
        worse = sum(self.surely(name, other) for other in self.names)
        return 1 + better, len(self.names) - worse

    @property
    def conclusion(self) -> str:
        """The order in words: each render with the next one, and other pairs that are sure.

        It leaves out pairs around one that is sure.
        """
        cost = "variance × time" if self.at == "equal time" else "variance"
        parts, told = [], [*itertools.pairwise(range(len(self.names)))]
        pairs = itertools.combinations(range(len(self.names)), 2)
        sure = [(i, j) for i, j in pairs if self.surely(self.names[i], self.names[j])]
        inner = [
            (i, j)
            for i, j in sure
            if not any((i, j) != (k, m) and i <= k and m <= j for k, m in sure)
        ]
        for i, j in [*told, *(pair for pair in inner if pair not in told)]:
            one, other = self.names[i], self.names[j]
            ratio = self.ratios[one, other].shown(beside=[1])
            if self.surely(one, other):
                parts.append(f"{one} has {ratio} of the {cost} of {other}")
            else:
                parts.append(f"{one} and {other} cannot be told apart, ratio {ratio}")
        return f"At {self.at}, {'; '.join(parts)}."


@dataclass(frozen=True)
class NoiseCause:
    """A pattern that holds some of what a render has more noise than the least noisy one.

    Attributes
    ----------
    name, least
        Names of the render, and of the least noisy one at equal spp.
    pattern
        Primary pattern of its samples, by `chdstat.classify`.
    pixels
        Share of the image in pixels with this pattern.
    share
        Share of the additional variance in these pixels. More than 1 if the render has less noise
        elsewhere.
    ratio
        Variance over that of the least noisy render in these pixels.
    null_share, least_null_share
        Share of null samples there, in both renders.

    Notes
    -----
    Every other sample of the render tells the patterns, and the others tell the numbers: of pixels
    that are picked by their own fireflies, all numbers would be too large.
    """

    name: str
    least: str
    pattern: str
    pixels: float
    share: Interval[float]
    ratio: Interval[float]
    null_share: Interval[float]
    least_null_share: float

    @property
    def without_nulls(self) -> bool:
        """Whether neither render has null samples there."""
        return not (self.null_share.value or self.least_null_share)

    @property
    def details(self) -> str:
        """The numbers of the pixels in words."""
        share = self.share.shown(percent)
        null = ""
        if not self.without_nulls:
            null = (
                f", {self.null_share.shown(percent)} of the samples null "
                f"({percent(self.least_null_share)} in {self.least})"
            )
        return (
            f"{share} is in {_worded(self.pattern)} pixels, {percent(self.pixels)} of the image: "
            f"variance {self.ratio} times as large{null}"
        )


@dataclass(frozen=True)
class ExamplePixel:
    """A pixel that shows what the renders differ in.

    Attributes
    ----------
    y, x
        Its place.
    least
        Name of the render that is the least noisy around it.
    samples
        Its samples, shape (channel, sample), by the name of the render.
    """

    y: int
    x: int
    least: str
    samples: Mapping[str, Image]


@dataclass(frozen=True, repr=False)
class NoiseRanking(Tabled):
    """Which of several renders of a view is noisier, where in the image, and why.

    Attributes
    ----------
    orders
        The renders in the order of their noise, by "equal spp" and, if all times are known, by
        "equal time". A black render beside others has no place in them.
    maps
        ``mean`` of each render, (render, y, x, channel), and ``relative_variance`` of a sample,
        (render, y, x), on one scale. ``least_noisy``, (at, y, x): the render that is the least
        noisy in the cell of the pixel, as its number in ``render``, -1 where that cannot be told at
        a false discovery rate of `alpha`; and its ``q_value``.
    spp
        Samples per pixel, by name, in words.
    seconds
        Rendering time of one sample in every pixel, by name; NaN if it is unknown.
    causes
        What the additional noise of each render comes from that is surely noisier than the least
        noisy one at equal spp; empty if patterns were not asked for, or cannot be told.
    doubtful
        Share of the variance of each render in pixels whose variance cannot be trusted, since their
        error bars fail or one sample decides them; empty without patterns.
    examples
        Pixels that show the difference.
    settings
        What differs in how the renders were made: the values of each by the name of the setting.
    level
        Coverage of all intervals of the ratios together.
    alpha
        False discovery rate of the map.
    """

    orders: Mapping[At, NoiseOrder]
    maps: Any
    spp: Mapping[str, str]
    seconds: Mapping[str, float]
    causes: tuple[NoiseCause, ...]
    doubtful: Mapping[str, float]
    examples: tuple[ExamplePixel, ...]
    settings: Mapping[str, tuple[str, ...]]
    level: float
    alpha: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the renders, in the order in which they were given."""
        return tuple(self.spp)

    @property
    def unlit(self) -> tuple[str, ...]:
        """Names of renders without light, beside others with some; noise does not rank them."""
        with np.errstate(invalid="ignore"):
            lit = (self.maps["mean"] > 0).any(("y", "x", "channel")).to_numpy()
        return tuple(n for n, seen in zip(self.names, lit, strict=True) if not seen and lit.any())

    @property
    def order(self) -> NoiseOrder:
        """The order at equal spp."""
        return self.orders["equal spp"]

    def wins(self, at: At = "equal spp") -> dict[str, tuple[float, float]]:
        """Return where each render is the least noisy: shares of the pixels, and of the noise.

        The noise is that of all renders together.
        """
        least = self.maps["least_noisy"].sel(at=at).to_numpy()
        ranked = [name not in self.unlit for name in self.names]
        noise = self.maps["relative_variance"].to_numpy()[ranked]
        noise = np.where(np.isfinite(noise).all(axis=0), noise, 0).sum(axis=0)
        total = noise.sum() or np.nan
        return {
            name: (float((least == i).mean()), float(noise[least == i].sum() / total))
            for i, name in enumerate(self.names)
        }

    @property
    def conclusion(self) -> str:
        """What was found, in words."""
        return " ".join(self.sentences())

    def sentences(self) -> list[str]:
        """Return what was found, sentence by sentence."""
        found = [order.conclusion for order in self.orders.values()]
        return found + [f"{capital(name)}: {text}." for name, text in self.facts().items()]

    def facts(self, *, brief: bool = False) -> dict[str, str]:
        """Return what there is to know beside the order, by what it is about."""
        found = {}
        if self.unlit:
            found["not ranked"] = f"{', '.join(self.unlit)}, without any light in its samples"
        if "equal time" not in self.orders:
            found["equal time"] = "no ranking, since rendering times are unknown"
        pairs = sorted({pair for order in self.orders.values() for pair in order.doubtful})
        if pairs:
            which = ", ".join(f"{one} before {other}" for one, other in pairs)
            found["doubt"] = (
                f"{which} only by pixels whose variance cannot be trusted, since error bars fail "
                "or one sample decides"
            )
        found["where"] = self._where()
        for name in self.order.names:
            if causes := [cause for cause in self.causes if cause.name == name]:
                found[f"{'excess of' if brief else 'why'} {name}"] = _why(causes, brief=brief)
        if self.settings and not brief:
            found["settings that differ"] = ", ".join(self.settings).lower()
        return found

    def _where(self) -> str:
        won = {name: shares for name, shares in self.wins().items() if shares[0]}
        if not won:
            return "no part of the image tells which render is the least noisy there"
        parts = [
            f"{name} is the least noisy in {percent(pixels)} of the pixels, with "
            f"{percent(noise)} of the noise"
            for name, (pixels, noise) in sorted(won.items(), key=lambda item: -item[1][0])
        ]
        rest = max(0.0, 1 - sum(pixels for pixels, _ in won.values()))
        rate = percent(self.alpha)
        return f"{', '.join(parts)}; {percent(rest)} undecided (false discovery rate {rate})"

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, without maps, ready for JSON."""
        orders = {
            at: {
                "names": order.names,
                "noise": order.noise,
                "ratios": [
                    {"render": one, "other": other, **ratio.to_dict()}
                    for (one, other), ratio in order.ratios.items()
                ],
                "doubtful": sorted(order.doubtful),
            }
            for at, order in self.orders.items()
        }
        causes = [
            {n: v.to_dict() if isinstance(v, Interval) else v for n, v in vars(cause).items()}
            for cause in self.causes
        ]
        wins = {at: self.wins(at) for at in self.orders}
        about = {"orders": orders, "least_noisy": wins, "causes": causes, "table": self.table()}
        more = {"doubtful": self.doubtful, "settings": self.settings, "level": self.level}
        return dict(plain(about | more))

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each render, the least noisy at equal spp first.

        Ratios are those to the first one.
        """
        rows = []
        won, first = self.wins(), self.order.names[0]
        for name in self.order.names:
            row: dict[str, Any] = {"render": name, "spp": self.spp[name]}
            for at, order in self.orders.items():
                key = at.replace("equal ", "at_equal_")
                ratio = _to_first(order, name, first)
                row |= {
                    f"best_rank_{key}": order.rank(name)[0],
                    f"worst_rank_{key}": order.rank(name)[1],
                    f"noise_{key}": order.noise[name],
                    f"ratio_{key}": ratio.value,
                    f"ratio_{key}_low": ratio.low,
                    f"ratio_{key}_high": ratio.high,
                }
            row |= {"seconds_per_sample": self.seconds[name]}
            row |= {"least_noisy_pixels": won[name][0], "least_noisy_noise": won[name][1]}
            rows.append(row | {"doubtful_noise": self.doubtful.get(name, np.nan)})
        return rows

    def in_words(self) -> list[dict[str, str]]:
        """Return the rows of the table as text, by the titles of the columns."""
        rows = []
        won, first = self.wins(), self.order.names[0]
        for name in self.order.names:
            row = {"render": name, "spp": self.spp[name]}
            for at, order in self.orders.items():
                low, high = order.rank(name)
                ratio = _to_first(order, name, first).shown(beside=[1])
                row[at] = f"{low}" if low == high else f"{low} to {high}"
                row["variance" if at == "equal spp" else "variance × time"] = ratio
            row["least noisy in"] = percent(won[name][0])
            rows.append(row)
        return rows


def _worded(pattern: str) -> str:
    # It is so in the samples that pick the pixels, and not in others.
    seeming = pattern in ("black", "constant")
    return f"{'seemingly ' * seeming}{pattern.replace('_', '-')}"


def _why(causes: Sequence[NoiseCause], *, brief: bool) -> str:
    """Return in words where what a render has more variance than the least noisy one is."""
    first, *others = causes
    if brief:
        parts = [f"{percent(of.share.value)} in {_worded(of.pattern)}" for of in causes]
        return f"{', '.join(parts)} pixels"
    more = "".join(f"; {percent(of.share.value)} in {_worded(of.pattern)} pixels" for of in others)
    return f"of what it has more variance than {first.least}, {first.details}{more}"


def _to_first(order: NoiseOrder, name: str, first: str) -> Interval[float]:
    """Return the noise of a render over that of the first one at equal spp."""
    if name == first:
        return Interval.unknown(1.0)
    if (name, first) in order.ratios:
        return order.ratios[name, first]
    ratio = order.ratios[first, name]
    with np.errstate(all="ignore"):
        value, low, high = (
            float(np.divide(1.0, end)) for end in (ratio.value, ratio.low, ratio.high)
        )
    return Interval(value, high, low, ratio.level)


def noise_ranking(
    renders: Sequence[RankedRender],
    *,
    alpha: float = 0.05,
    patterns: bool = True,
    progress: bool = True,
) -> NoiseRanking:
    """Rank renders of one view by their noise.

    Parameters
    ----------
    renders
        Two renders or more, of one size.
    alpha
        Chance that any interval of the ranking does not hold, and false discovery rate of the map.
    patterns
        Say which patterns hold the noise, too.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.
    """
    seen = [render for render in renders if np.nanmax(render.light, initial=0) > 0]
    lit = seen if len(seen) > 1 else [*renders]
    names = [render.name for render in lit]
    light = np.stack([render.light for render in lit])
    weights = np.array([render.samples.spp for render in lit], float)
    known = np.isfinite(light).all(axis=0)
    mean = np.where(known, np.tensordot(weights / weights.sum(), np.nan_to_num(light), 1), np.nan)
    scale = relative_scale(mean)
    noise = np.stack([render.noise(scale) for render in lit])
    suspect = {
        render.name: untrusted(render.samples, progress=progress)
        for render in lit
        if patterns and _has_patterns(render.samples)
    }
    seconds = {render.name: render.seconds for render in renders}
    timed = all(np.isfinite(each) for each in seconds.values())
    ats: list[At] = ["equal spp", "equal time"] if timed else ["equal spp"]
    edge = _cell_edge(*scale.shape)
    terms = _cell_terms(lit, scale, ats, edge)
    if len(seen) == 1:  # that others are black tells nothing of its noise
        terms = {pair: 0 * d for pair, d in terms.items()}
    orders = _orders(ats, lit, noise, suspect, terms, alpha)
    least, q = _least_noisy(lit, noise, terms, ats, alpha, edge)
    if edge >= max(scale.shape):  # one cell says what the order does, and not more
        for a, order in enumerate(orders.values()):
            least[a][order.rank(order.names[0]) != (1, 1)] = -1
    with np.errstate(all="ignore"):
        doubtful = {
            name: float(
                np.nansum(noise[names.index(name)][there]) / np.nansum(noise[names.index(name)])
            )
            for name, there in suspect.items()
        }
    return NoiseRanking(
        orders=orders,
        maps=_dataset(renders, scale, _numbered(least, lit, renders), q, ats),
        spp={render.name: render.samples.spp_range for render in renders},
        seconds=seconds,
        causes=tuple(_explanations(lit, noise, scale, orders["equal spp"], {*suspect}, progress)),
        doubtful=doubtful,
        examples=_examples(lit, noise, least[0], orders["equal spp"]),
        settings=_settings(renders),
        level=1 - alpha,
        alpha=alpha,
    )


def _has_patterns(samples: Samples) -> bool:
    """Return whether the patterns of a render can be told: not of averages, or odd channels."""
    return samples.attrs.get("averaged", 1) == 1 and samples.shape[2] in (1, 3)


def _orders(
    ats: Sequence[At],
    renders: Sequence[RankedRender],
    noise: Floats,
    suspect: Mapping[str, Mask],
    terms: Mapping[tuple[int, int], Floats],
    alpha: float,
) -> dict[At, NoiseOrder]:
    """Return the orders at equal spp and, if times are known, at equal time."""
    names = [render.name for render in renders]
    level = 1 - alpha / (len(terms) * len(ats))
    known = np.isfinite(noise).all(axis=0)
    trusted = {name: (known & ~suspect.get(name, ~known)).ravel() for name in names}
    ratio = partial(_ratio_over, Blocks.strata(*known.shape), level)
    found = {}
    for a, at in enumerate(ats):
        factor = [render.seconds if at == "equal time" else 1.0 for render in renders]
        costs = {n: of.ravel() * f for n, of, f in zip(names, noise, factor, strict=True)}
        image = {pair: d.sum(axis=(1, 2))[:, np.newaxis, np.newaxis] for pair, d in terms.items()}
        p = _p_less_noisy(image, len(names))[a, :, :, 0, 0]
        surely = {
            (names[i], names[j]): bool(p[i, j] <= 1 - level)
            for i, j in itertools.permutations(range(len(names)), 2)
        }
        found[at] = _order(at, costs, known.ravel(), trusted, surely, ratio)
    return found


def _ratio_over(blocks: Blocks, level: float, one: Floats, other: Floats, use: Mask) -> Any:
    """Return the ratio of two costs over some pixels."""
    return cost_ratio(one[use], other[use], blocks[use], level=level)


def _order(
    at: At,
    costs: Mapping[str, Floats],
    known: Mask,
    trusted: Mapping[str, Mask],
    surely: Mapping[tuple[str, str], bool],
    ratio: Callable[[Floats, Floats, Mask], Interval[float]],
) -> NoiseOrder:
    """Return renders in the order of their costs (pixel,) over the known pixels.

    Blocks do not show how rare the brightest samples are: an interval holds 1 unless the flips of
    signs, too, tell the two renders apart.
    """
    number, timing = known.sum() or np.nan, TIMING if at == "equal time" else 1.0
    total = {name: float(cost[known].sum() / number) for name, cost in costs.items()}
    ordered = tuple(sorted(costs, key=lambda name: total[name]))
    ratios: dict[tuple[str, str], Interval[float]] = {}
    doubtful = set()
    for one, other in itertools.combinations(ordered, 2):
        found = ratio(costs[one], costs[other], known)
        found = replace(found, low=found.low / timing, high=found.high * timing)
        if not surely[one, other]:
            found = replace(found, high=max(found.high, 1.0))
        ratios[one, other] = found
        both = trusted[one] & trusted[other]
        if found.high < 1 and (both != known).any():
            again = ratio(costs[one], costs[other], both)
            if not again.high * timing < 1:
                doubtful.add((one, other))
    return NoiseOrder(at, ordered, total, ratios, frozenset(doubtful))


# --- where in the image -----------------------------------------------------------------------


def _cell_edge(height: int, width: int) -> int:
    """Return the edge of cells: a power of two, as that of tiles."""
    edge = _LEAST_CELL
    while edge * _CELLS < max(height, width):
        edge *= 2
    return edge


def _least_noisy(
    renders: Sequence[RankedRender],
    noise: Floats,
    terms: Mapping[tuple[int, int], Floats],
    ats: Sequence[At],
    alpha: float,
    edge: int,
) -> tuple[Array, Floats]:
    """Return which render is the least noisy in the cell of each pixel, and q-values, (at, y, x).

    A render is the least noisy if it is less noisy than each other one, an intersection-union test.
    Its p-value is the largest over the others, times half the number of renders: if several are
    equally noisy, each of them may win by accident, in one direction of its tests.
    """
    (height, width), p = noise.shape[1:], _p_less_noisy(terms, len(renders))
    known = np.where(np.isfinite(noise).all(axis=0), noise, 0)
    winners, qs = [], []
    for a, at in enumerate(ats):
        factor = [render.seconds if at == "equal time" else 1.0 for render in renders]
        costs = [
            block_sums(f * cost[..., np.newaxis], edge)[..., 0]
            for f, cost in zip(factor, known, strict=True)
        ]
        best = np.argmin(costs, axis=0)
        others = np.moveaxis(np.take_along_axis(p[a], best[np.newaxis, np.newaxis], 0)[0], 0, -1)
        with np.errstate(all="ignore"):
            largest = np.nanmax(np.where(np.isfinite(others), others, -1), axis=-1)
        missing = np.isnan(others).sum(axis=-1) > 1  # that against itself is always missing
        combined = np.where(missing, np.nan, np.minimum(1, largest * len(renders) / 2))
        q = q_values(combined)
        winners.append(_spread(np.where(q <= alpha, best, -1), edge)[:height, :width])
        qs.append(_spread(q, edge)[:height, :width])
    return np.array(winners, np.int8), np.array(qs)


def _numbered(least: Array, some: Sequence[RankedRender], renders: Sequence[RankedRender]) -> Array:
    """Return numbers of some renders, -1 for none, as those of the same ones among all."""
    names = [render.name for render in renders]
    return np.array([*(names.index(render.name) for render in some), -1], np.int8)[least]


def _spread(cells: Array, edge: int) -> Array:
    """Return the value of its cell for each pixel."""
    return np.asarray(np.repeat(np.repeat(cells, edge, axis=0), edge, axis=1))


@np.errstate(all="ignore")
def _cell_terms(
    renders: Sequence[RankedRender], scale: Floats, ats: Sequence[At], edge: int
) -> dict[tuple[int, int], Floats]:
    """Return sums over cells of the terms of each pair of renders, (variant, y, x, term).

    Variants are one at equal spp and, at equal time, those where the first or the second render
    takes `TIMING` times as long as it says.

    A pair has equally many samples of both, since fewer are likelier to miss what is rare.
    """
    height, width = scale.shape
    rows, columns = -(-height // edge), -(-width // edge)
    sums = {}
    for i, j in itertools.combinations(range(len(renders)), 2):
        spp = min(renders[i].samples.spp, renders[j].samples.spp)
        variants = 2 * len(ats) - 1
        sums[i, j] = np.zeros((variants, rows, columns, spp // -(-spp // _TERMS)))
    most = max((render.samples.shape for render in renders), key=lambda shape: shape[3])
    for ys, xs in tiles(most):
        light = [_light_and_good(render.samples.read(ys, xs)) for render in renders]
        weight = np.nan_to_num(1 / scale[ys, xs], nan=0, posinf=0)
        at = tuple(slice(of.start // edge, -(-of.stop // edge)) for of in (ys, xs))
        for (i, j), total in sums.items():
            both = [(renders[i], *light[i]), (renders[j], *light[j])]
            for a, terms in enumerate(_terms(both, weight, ys, xs, ats)):
                total[a][at] += _folded(block_sums(terms, edge), total.shape[-1])
    return sums


def _p_less_noisy(terms: Mapping[tuple[int, int], Floats], number: int) -> Floats:
    """Return p-values that a render is less noisy than another, (at, render, other, y, x).

    NaN where nothing varies, and of a render against itself.
    """
    variants, rows, columns, _ = next(iter(terms.values())).shape
    # At equal time, either may be the slower one.
    of_first, of_second = ([0], [0]) if variants == 1 else ([0, 1], [0, 2])
    p = np.full((len(of_first), number, number, rows, columns), np.nan)
    for (i, j), d in terms.items():
        two_sided = p_of_signs(d.reshape(-1, d.shape[-1])).reshape(variants, rows, columns)
        no, total = np.where(np.isnan(two_sided), np.nan, 1), d.sum(axis=-1)
        p[:, i, j] = np.where(total < 0, two_sided, no)[of_first]
        p[:, j, i] = np.where(total > 0, two_sided, no)[of_second]
    return p


def _terms(
    both: Sequence[tuple[RankedRender, Image, Mask]],
    weight: Array,
    ys: slice,
    xs: slice,
    ats: Sequence[At],
) -> Iterator[Image]:
    """Yield terms (y, x, sample) that sum up to differences of the noise of two renders.

    At equal spp, both deviate from the mean of both, so that flips of signs are exact.
    """
    count = min(light.shape[-1] for _, light, _ in both)
    good = both[0][2][..., :count] & both[1][2][..., :count]
    number = np.maximum(good.sum(axis=-1, keepdims=True), 1)
    x = [np.where(good, light[..., :count], 0) for _, light, _ in both]
    means = [(part.sum(axis=-1, keepdims=True) / number).astype(np.float32) for part in x]
    middle = (means[0] + means[1]) / 2
    factors = []
    for render, _, _ in both:
        counts = render.samples.counts if render.samples.unequal else None
        share = 1.0 if counts is None else counts.mean() / counts[ys, xs]
        factors.append((weight * share)[..., np.newaxis].astype(np.float32))
    one, other = (factor * (part - middle) ** 2 for factor, part in zip(factors, x, strict=True))
    yield np.where(good, one - other, 0)
    if "equal time" in ats:
        one, other = (
            factor * (part - mean) ** 2
            for factor, part, mean in zip(factors, x, means, strict=True)
        )
        faster = both[0][0].seconds / both[1][0].seconds
        for ratio in (faster * TIMING, faster / TIMING):
            yield np.where(good, np.float32(ratio) * one - other, 0)


def _folded(sums: Array, count: int) -> Floats:
    """Return sums of samples k, k + count, k + 2 count..., shape (y, x, count)."""
    each = sums.shape[-1] // count
    whole = sums[..., : each * count].reshape(*sums.shape[:2], each, count)
    return np.asarray(whole.sum(axis=2, dtype=float))


def _light_and_good(x: Image) -> tuple[Image, Mask]:
    good = ~is_bad(x).any(axis=2)
    return np.asarray(light_of(x), np.float32), np.asarray(good)


# --- why ----------------------------------------------------------------------------------------


@np.errstate(all="ignore")
def _explanations(
    renders: Sequence[RankedRender],
    noise: Floats,
    scale: Floats,
    order: NoiseOrder,
    having_patterns: Set[str],
    progress: bool,
) -> Iterator[NoiseCause]:
    """Yield what the noise of each render comes from that is surely noisier than the first.

    A pattern is named if it surely holds some of the additional noise. Samples that pick the pixels
    do not measure them. Of a large image, `_TELLING` pixels tell.
    """
    least, names = order.names[0], [render.name for render in renders]
    noisier = [
        renders[names.index(name)]
        for name in order.names[1:]
        if order.surely(least, name)
        and {least, name} <= having_patterns
        and renders[names.index(name)].samples.spp >= 2 * _PICK
    ]
    if not noisier:
        return
    step = math.ceil(math.sqrt(scale.size / _TELLING))
    some = slice(0, None, step)
    of_first = noise[names.index(least)][some, some]
    _, null_of_first = _measured(renders[names.index(least)], scale, some)
    for render in noisier:
        half = render.samples.isel(y=some, x=some, sample=slice(0, None, 2))
        picked = classified(half, progress=progress)
        own, null = _measured(render, scale, some)
        known = (np.isfinite(own) & np.isfinite(of_first)).ravel()
        if not known.any():
            continue
        blocks = Blocks.strata(*own.shape)[known]
        own, null, first, first_null, labels = (
            of.ravel()[known]
            for of in (own, null, of_first, null_of_first, picked["label"].to_numpy())
        )
        more = own - first
        held = {code: more[labels == code].sum() for code in np.unique(labels)}
        for code in sorted(held, key=lambda label: -held[label])[:_PATTERNS]:
            here = labels == code
            share = cost_ratio(np.where(here, more, 0), more, blocks, least=-np.inf)
            if not share.low > 0:
                continue
            yield NoiseCause(
                name=render.name,
                least=least,
                pattern=flag_names(picked["label"].attrs)[int(code)],
                pixels=float(here.mean()),
                share=share,
                ratio=cost_ratio(own[here], first[here], blocks[here]),
                null_share=mean_of(null[here], blocks[here]),
                least_null_share=float(first_null[here].mean()),
            )


@np.errstate(all="ignore")
def _measured(render: RankedRender, scale: Floats, some: slice) -> tuple[Floats, Floats]:
    """Return noise and the share of null samples, by every other sample, in some pixels."""
    samples = render.samples.isel(sample=slice(1, None, 2))
    variance, null = np.full(scale.shape, np.nan), np.full(scale.shape, np.nan)
    for ys, xs in tiles(samples.shape):
        light, good = _light_and_good(samples.read(ys, xs))
        x, count = np.where(good, light, 0).astype(float), good.sum(axis=-1)
        mean = x.sum(axis=-1) / count
        squares = np.where(good, (x - mean[..., np.newaxis]) ** 2, 0).sum(axis=-1)
        variance[ys, xs] = squares / (count - 1)
        null[ys, xs] = (good & (light == 0)).sum(axis=-1) / count
    measured = replace(render, variance=variance).noise(scale)
    return measured[some, some], null[some, some]


def _examples(
    renders: Sequence[RankedRender], noise: Floats, least: Array, order: NoiseOrder
) -> tuple[ExamplePixel, ...]:
    """Return pixels that show what the renders differ in: where the first wins, and another."""
    names = [render.name for render in renders]
    gap = np.nan_to_num(noise.max(axis=0) - noise.min(axis=0), nan=-1, posinf=-1)
    found: list[ExamplePixel] = []
    winners = [names.index(name) for name in order.names]
    free = np.ones(gap.shape, bool)
    for winner in (*winners, *winners, -1):
        here = np.flatnonzero((least == winner) & (gap > 0) & free)
        if winner >= 0:
            # The winner of a cell should look like it in the pixel, too.
            here = here[noise.reshape(len(names), -1)[:, here].argmin(axis=0) == winner]
        if not len(here) or len(found) == _PIXELS:
            continue
        # The pixel in the middle of the additional noise, and not its most extreme one.
        by_gap = here[np.argsort(gap.ravel()[here])]
        total = np.cumsum(gap.ravel()[by_gap])
        y, x = divmod(int(by_gap[np.searchsorted(total, total[-1] / 2)]), least.shape[1])
        samples = {
            render.name: render.samples.read(slice(y, y + 1), slice(x, x + 1))[0, 0]
            for render in renders
        }
        of = names[winner] if winner >= 0 else ""
        far = max(gap.shape) // _APART
        free[max(0, y - far) : y + far + 1, max(0, x - far) : x + far + 1] = False
        found.append(ExamplePixel(y, x, of, samples))
    return tuple(found)


def _settings(renders: Sequence[RankedRender]) -> dict[str, tuple[str, ...]]:
    """Return what differs in how renders were made, in words, without a list of equal values."""
    # Sizes are equal, and numbers of samples stand beside the names.
    made = [provenance(render.samples.attrs, (*render.samples.shape[:3], 1)) for render in renders]
    names = {name: None for one in made for other in made for name in differing(one, other)}
    return {name: tuple(of.get(name, "—") for of in made) for name in names}


def _dataset(
    renders: Sequence[RankedRender], scale: Floats, least: Array, q: Floats, ats: Sequence[At]
) -> Any:
    import xarray as xr

    noise = np.stack([render.noise(scale) for render in renders])
    names = [render.name for render in renders]
    height, width, _ = renders[0].mean.shape
    coords = {
        "render": np.array(names, object),
        "y": np.arange(height),
        "x": np.arange(width),
        "channel": np.array(renders[0].samples.channels, object),
        "at": np.array(ats, object),
    }
    variables = {
        "mean": (("render", "y", "x", "channel"), np.stack([render.mean for render in renders])),
        "relative_variance": (("render", "y", "x"), noise),
        "least_noisy": (("at", "y", "x"), least),
        "q_value": (("at", "y", "x"), q),
    }
    labels: dict[str, str | tuple[str, str]] = {
        "mean": ("mean of the samples", RADIANCE),
        "relative_variance": ("relative variance of the luminance of a sample", "1"),
        "least_noisy": "number of the least noisy render, -1 where that cannot be told",
        "q_value": "q-value of the least noisy render of a cell",
    }
    return label_variables(xr.Dataset(variables, coords), labels)


def named_renders(renders: Sequence[Samples]) -> dict[str, Samples]:
    """Return renders by the names of their stores; by letters where these are missing or alike.

    Examples
    --------
    >>> [*named_renders([Samples.from_array(np.ones((4, 4, 8)))] * 2)]
    ['A', 'B']
    """
    names = ["" if render.path is None else render.path.stem for render in renders]
    if "" in names or len({*names}) < len(names):
        names = [chr(ord("A") + i) if i < 26 else f"{i + 1}" for i in range(len(renders))]
    return dict(zip(names, renders, strict=True))


def check_one_view(renders: Mapping[str, Samples]) -> None:
    """Refuse renders of different sizes, channels or scenes.

    Raises
    ------
    InputError
        If the renders are not of one view.
    """
    (first, one), *others = renders.items()
    for name, other in others:
        sizes = [
            f"{x.shape[1]} x {x.shape[0]} pixels of {x.shape[2]} channels" for x in (one, other)
        ]
        if one.shape[:3] != other.shape[:3]:
            message = (
                f"expected renders of one size, got {sizes[0]} in {first} and {sizes[1]} in "
                f"{name}: render all at one size"
            )
            raise InputError(message)
        scenes = [str(x.attrs.get("scene") or "") for x in (one, other)]
        hashes = [x.attrs.get("scene_hash") for x in (one, other)]
        # Samples of other programs have the name of their file, and no hash.
        if all(hashes) and hashes[0] != hashes[1] and scenes[0] != scenes[1]:
            message = (
                f"expected renders of one scene, got {scenes[0]} in {first} and {scenes[1]} in "
                f"{name}: noise of different scenes has no ranking; only their means can "
                "be contrasted, with one as the second argument, b"
            )
            raise InputError(message)
