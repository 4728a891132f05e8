"""Glossy objects: the shape of diffuse ones, with separated channels (finding 3)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from chdstat._core.positive import Floats
from chdstat._core.resampling import Blocks, Interval, interval_of, largest_of
from chdstat.studies.log_chds import LogChds, aligned, same_shape, shape_plot, squared_distance
from chdstat.studies.outcomes import ClaimTest, Outcome, level_of, require
from chdstat.studies.scene_data import SceneData, ratio_of

__all__ = ["SHIFT", "channel_shift", "measure", "pooled_distance"]

SHIFT = 0.1
"""Decades between the channels' log CHDs that count as a shift: a factor of 1.26 in radiance, the
width of a bin of the paper's log histograms."""
_FOLLOWS = 0.5
"""Slope of log deviation on log mean: 0 for additive noise, 1 for multiplicative; from half way on,
the spread is a function of radiance."""


def measure(data: SceneData) -> Outcome:
    """Compare glossy with diffuse shapes, and the channels with each other."""
    which = "of glossy and one of diffuse objects"
    patches = {name: data.patch(name, which) for name in ("glossy", "diffuse")}
    require(data.samples.shape[2] > 1, "several channels")
    glossy, level = patches["glossy"], level_of(3)
    x = data.radiance(glossy)
    shapes = {name: aligned(data.light(patch)) for name, patch in patches.items()}
    blocks = [patch.blocks for patch in patches.values()]
    distance = pooled_distance(list(shapes.values()), blocks, level=level)
    shift, slope = (f(x, glossy.blocks, level=level) for f in (channel_shift, _spread_slope))
    with np.errstate(divide="ignore", invalid="ignore"):
        log_mean = np.log10(_mean(x))
    known = {name: chds[chds.known].whole for name, chds in shapes.items() if chds.known.any()}
    return Outcome(
        (
            same_shape("distance between glossy and diffuse shapes", distance),
            ClaimTest("shift between channels", shift, least=SHIFT, unit="decade"),
            ClaimTest("slope of log deviation on log mean over channels", slope, least=_FOLLOWS),
        ),
        details={
            "log_mean": {
                channel: glossy.by_region(log_mean[:, i])
                for i, channel in enumerate(data.samples.channels)
            }
        },
        plot_data=shape_plot({name: shape.mean(axis=0) for name, shape in known.items()}),
    )


def pooled_distance(
    shapes: Sequence[LogChds], blocks: Sequence[Blocks], *, level: float
) -> Interval[float]:
    """Return the distance between the mean shapes of two patches, with halves against noise."""
    if not all(chds.known.any() for chds in shapes):
        return Interval.unknown(level=level)
    known = [of_patch[chds.known] for chds, of_patch in zip(shapes, blocks, strict=True)]
    both, first = Blocks.join(known), len(known[0])
    sums = both.sums(np.concatenate([chds.halves[chds.known] for chds in shapes]))
    count = both.sums(np.ones(len(both.of_pixel)))

    def distance(weights: Floats) -> Floats:
        one, two = (
            LogChds(
                np.tensordot(weights[:, s], sums[s], 1) / (weights[:, s] @ count[s])[:, None, None]
            )
            for s in (slice(None, first), slice(first, None))
        )
        # Noise may make the square negative.
        return np.sqrt(np.maximum(squared_distance(one, two), 0))

    return interval_of(distance, both, level=level, bounds=(0.0, np.inf))


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


def _spread_slope(x: Floats, blocks: Blocks, *, level: float) -> Interval[float]:
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
    m1, m2, s1, s2 = centered
    above, below = (s1 * m2 + s2 * m1).sum(axis=1), (2 * m1 * m2).sum(axis=1)
    return ratio_of(above, below, blocks, level=level)


def _mean(x: Floats) -> Floats:
    good = np.isfinite(x)
    return np.asarray(np.where(good, x, 0).sum(axis=-1) / good.sum(axis=-1))


def _deviation(x: Floats) -> Floats:
    good = np.isfinite(x)
    square = np.where(good, x - _mean(x)[..., np.newaxis], 0) ** 2
    return np.asarray(np.sqrt(square.sum(axis=-1) / (good.sum(axis=-1) - 1)))
