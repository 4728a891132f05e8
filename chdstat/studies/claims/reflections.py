"""Noisy reflections: one shape of the CHD, though the estimates scatter (finding 4)."""

from __future__ import annotations

import numpy as np

from chdstat._core.moments import Moments
from chdstat._core.positive import Floats
from chdstat._core.resampling import Blocks, Interval, interval_of, median_of
from chdstat.studies.log_chds import WIDTH, LogChds, aligned, same_shape, shape_plot
from chdstat.studies.outcomes import ClaimTest, Outcome, level_of
from chdstat.studies.scene_data import SceneData

__all__ = ["measure", "shape_spread"]

_NOISY = 1.0
"""Deviation over mean of the samples from which a pixel is noisy: that of an exponential
distribution, whose average of 32 samples scatters by 18 %."""


def measure(data: SceneData) -> Outcome:
    """Measure how far the shapes in a reflection differ, and how noisy it is."""
    patch, level = data.patch("noisy-reflection", "with a noisy reflection"), level_of(2)
    x = data.light(patch)
    shapes, good = aligned(x), np.isfinite(x)
    moments = Moments.of(np.where(good, x, 0), good)
    with np.errstate(invalid="ignore", divide="ignore"):
        # NaN where the mean is not positive.
        mean = np.where(moments.mean > 0, moments.mean, np.nan)
        variation = np.asarray(np.sqrt(moments.variance) / mean)
    spread = shape_spread(shapes, patch.blocks, level=level)
    noise = median_of(variation, patch.blocks, level=level)
    some = shapes.whole[shapes.known][:64]
    return Outcome(
        (
            same_shape("distance of a pixel's shape to that of the region", spread),
            ClaimTest("deviation over mean of the samples", noise, least=_NOISY),
        ),
        details={"deviation_over_mean": patch.by_region(variation)},
        plot_data=shape_plot({f"pixel {i + 1}": shape for i, shape in enumerate(some)}),
    )


def shape_spread(shapes: LogChds, blocks: Blocks, *, level: float) -> Interval[float]:
    """Return the root mean square distance of shapes to the mean of their region, without noise.

    The mean of products of halves less the product of the means is the covariance of the halves
    over pixels: the variance of the true shapes, of n - 1 degrees of freedom in each region.
    """
    known = shapes.known
    if np.count_nonzero(known) < 2:
        return Interval.unknown(level=level)
    kept, halves = blocks[known], shapes.halves[known]
    product = kept.sums((halves[:, 0] * halves[:, 1]).sum(axis=-1) * WIDTH)
    sums, count = kept.sums(halves), kept.sums(np.ones(len(halves)))

    def spread(weights: Floats) -> Floats:
        squares, degrees = weights @ product, np.zeros(len(weights))
        for region in np.unique(kept.region):
            here = kept.region == region
            n = weights[:, here] @ count[here]
            total = np.tensordot(weights[:, here], sums[here], 1)
            squares -= (total[:, 0] * total[:, 1]).sum(axis=-1) * WIDTH / n
            degrees += n - 1
        return np.asarray(np.sqrt(np.maximum(squares / degrees, 0)))

    return interval_of(spread, kept, level=level, bounds=(0.0, np.inf))
