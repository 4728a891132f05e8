"""Glossy objects: the shape of diffuse ones, with separated channels (finding 3)."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import numpy.typing as npt

from chdstat._core.resampling import Blocks, Interval, interval_of, largest_of
from chdstat.studies.log_chds import EDGES, SAME_SHAPE, LogChds, aligned, squared_distance
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import PixelSet, SceneData

__all__ = ["FOLLOWS", "SHIFT", "channel_shift", "measure", "pooled_distance", "spread_slope"]

Floats = npt.NDArray[np.float64]

SHIFT = 0.1
"""Decades between the channels' log CHDs that count as a shift: a factor of 1.26 in radiance, the
width of a bin of the paper's log histograms."""
FOLLOWS = 0.5
"""Slope of log deviation on log mean: 0 for additive noise, 1 for multiplicative; from half way on,
the spread is a function of radiance."""
_PARTS = 3


def measure(data: SceneData) -> Outcome:
    """Compare glossy with diffuse shapes, and the channels with each other."""
    glossy, diffuse = data.patch("glossy"), data.patch("diffuse")
    if glossy is None or diffuse is None:
        return Outcome(missing=("needs a region of glossy and one of diffuse objects",))
    if data.samples.shape[2] < 2:
        return Outcome(missing=("needs several channels",))
    x = data.radiance(glossy)
    shapes = aligned(data.light(glossy)), aligned(data.light(diffuse))
    level = level_of(_PARTS)
    parts = (
        ClaimTest.of(
            "distance between glossy and diffuse shapes",
            pooled_distance(*shapes, glossy.blocks, diffuse.blocks, level=level),
            most=SAME_SHAPE,
            unit="decade^1/2",
        ),
        ClaimTest.of(
            "shift between channels",
            channel_shift(x, glossy.blocks, level=level),
            least=SHIFT,
            unit="decade",
        ),
        ClaimTest.of(
            "slope of log deviation on log mean over channels",
            spread_slope(x, glossy.blocks, level=level),
            least=FOLLOWS,
        ),
    )
    return Outcome(
        parts,
        details={"log_mean": _by_channel(data, glossy, x)},
        plot_data=_plot_data(*shapes),
    )


def pooled_distance(
    one: LogChds, two: LogChds, blocks: Blocks, others: Blocks, *, level: float
) -> Interval[float]:
    """Return the distance between the mean shapes of two patches, with halves against noise."""
    both = (
        Blocks.join([blocks[one.known], others[two.known]])
        if one.known.any() and two.known.any()
        else None
    )
    if both is None:
        return Interval.unknown(level=level)
    first = len(blocks[one.known])
    sums = both.sums(np.concatenate([one.halves[one.known], two.halves[two.known]]))
    count = both.sums(np.ones(len(both.of_pixel)))

    def distance(weights: Floats) -> Floats:
        means = [
            np.tensordot(weights[:, s], sums[s], 1) / (weights[:, s] @ count[s])[:, None, None]
            for s in (slice(None, first), slice(first, None))
        ]
        return _root(LogChds(means[0]), LogChds(means[1]))

    return interval_of(distance, both, level=level, bounds=(0.0, np.inf))


def _root(one: LogChds, two: LogChds) -> Floats:
    """Return Cramér distances; 0 where noise makes the square negative."""
    return np.sqrt(np.maximum(squared_distance(one, two), 0))


def channel_shift(x: Floats, blocks: Blocks, *, level: float) -> Interval[float]:
    """Return the range of the channels' mean log10 radiance, over samples positive in all."""
    lit = np.asarray((x > 0).all(axis=1))
    logs = np.log10(np.where(lit[:, np.newaxis], x, 1)).sum(axis=-1)
    sums, count = blocks.sums(logs), blocks.sums(lit.sum(axis=-1))
    one, two = np.array(list(permutations(range(x.shape[1]), 2))).T

    def shifts(weights: Floats) -> Floats:
        means = (weights @ sums) / (weights @ count)[:, np.newaxis]
        return np.asarray(means[:, one] - means[:, two])

    return largest_of(shifts, blocks, level=level)


def spread_slope(x: Floats, blocks: Blocks, *, level: float) -> Interval[float]:
    """Return the slope of log deviation on log mean over the channels of each pixel.

    Means are noisy, and noise in what explains flattens a slope. The mean of the one half of the
    samples is therefore the instrument of that of the other, and the deviation is that of the other
    half, too, so that its noise has nothing in common with the instrument's:
    ``sum(d(log s1) d(log m2)) / sum(d(log m1) d(log m2))``, both ways added up.

    References
    ----------
    Durbin, "Errors in variables", 1954, doi:10.2307/1401917.
    """
    halves = [x[..., i::2] for i in (0, 1)]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log([f(h) for f in (_mean, _deviation) for h in halves])
    logs = np.where(np.isfinite(logs), logs, np.nan)
    centered = logs - logs.mean(axis=-1, keepdims=True)
    known = np.isfinite(centered).all(axis=(0, 2))
    m1, m2, s1, s2 = (v[known] for v in centered)
    if not known.any():
        return Interval.unknown(level=level)
    kept = blocks[known]
    above = kept.sums((s1 * m2 + s2 * m1).sum(axis=1))
    below = kept.sums((2 * m1 * m2).sum(axis=1))
    return interval_of(lambda w: (w @ above) / (w @ below), kept, level=level)


def _mean(x: Floats) -> Floats:
    good = np.isfinite(x)
    return np.asarray(np.where(good, x, 0).sum(axis=-1) / good.sum(axis=-1))


def _deviation(x: Floats) -> Floats:
    good = np.isfinite(x)
    square = np.where(good, x - _mean(x)[..., np.newaxis], 0) ** 2
    return np.asarray(np.sqrt(square.sum(axis=-1) / (good.sum(axis=-1) - 1)))


def _by_channel(data: SceneData, patch: PixelSet, x: Floats) -> dict[str, dict[str, float]]:
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log10(_mean(x))
    names = data.samples.channels
    return {name: patch.by_region(logs[:, c]) for c, name in enumerate(names)}


def _plot_data(glossy: LogChds, diffuse: LogChds) -> PlotData:
    series = {
        name: (EDGES, chds.whole[chds.known].mean(axis=0))
        for name, chds in (("glossy", glossy), ("diffuse", diffuse))
        if chds.known.any()
    }
    return PlotData("curves", series, "log10 radiance around its mean", "share below")
