"""Shapes of CHDs compared: between pixels, regions, channels, scenes and integrators.

`permuted` tests whether two integrators differ at all in the shapes that they give the pixels of a
scene; `squares` measures by how much, with an interval of its own. `drawn` draws equally many
positive samples from every pixel of every scene: with more samples, a distribution function is
smoother and shows more modes, so scenes with different shares of nulls would differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, permutations
from typing import TYPE_CHECKING

import numpy as np

from chdstat._core.arrays import Counts, Floats, Image, generator
from chdstat._core.resampling import Blocks, Interval, interval_of, largest_of
from chdstat.inference.permutations import p_of_signs
from chdstat.patterns.atlases import WIDTH as ATLAS_WIDTH
from chdstat.patterns.atlases import of_histograms
from chdstat.samples import Samples
from chdstat.studies.log_chds import WIDTH, LogChds, squared_distance, visible
from chdstat.studies.scene_data import PixelSet, SceneData
from chdstat.summary.histograms import LOG_VARIABLES
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

SHAPE_NEEDS = 32
"""Fewest positive samples for the shape of a pixel."""


# --- in one image ---------------------------------------------------------------------------------


def log_skewness(x: Floats) -> Floats:
    """Return the skewness of log radiance in sight, shape (...); NaN below 32 samples.

    NaN, too, where all are equal.
    """
    z = standard_logs(visible(x))
    n = np.isfinite(z).sum(axis=-1)
    third = np.nansum(z**3, axis=-1) / np.maximum(n, 1)
    return np.asarray(np.where(n >= SHAPE_NEEDS, third, np.nan))


def standard_logs(x: Floats) -> Floats:
    """Return standardised logarithms; NaN where x is not positive."""
    log = np.log(np.where(x > 0, x, np.nan))
    n = np.maximum((x > 0).sum(axis=-1, keepdims=True), 1)
    log -= np.nansum(log, axis=-1, keepdims=True) / n
    deviation = np.sqrt(np.nansum(log**2, axis=-1, keepdims=True) / n)
    with np.errstate(invalid="ignore", divide="ignore"):
        # The deviation of equal radiance is rounding: there is no shape.
        return np.asarray(np.where(deviation > 1e-6, log / deviation, np.nan))


def channel_shift(x: Floats, pixels: PixelSet) -> Interval[float]:
    """Return the range of the channels' mean log10 radiance, over samples positive in all."""
    lit = np.asarray((x > 0).all(axis=1))
    log = np.log10(np.where(lit[:, np.newaxis], x, 1)).sum(axis=-1)
    sums, count = pixels.blocks.sums(log), pixels.blocks.sums(lit.sum(axis=-1))
    one, two = np.array(list(permutations(range(x.shape[1]), 2))).T

    def shifts(weights: Floats) -> Floats:
        means = (weights @ sums) / (weights @ count)[:, np.newaxis]
        return np.asarray(means[:, one] - means[:, two])

    return largest_of(shifts, pixels.blocks, level=pixels.level)


def _mean_shape(shapes: LogChds, blocks: Blocks) -> Callable[[Floats], LogChds]:
    """Return a function from weights of blocks to the mean of shapes (pixel, ...)."""
    sums, count = blocks.sums(shapes.halves), blocks.sums(np.ones(len(shapes.halves)))

    def mean(weights: Floats) -> LogChds:
        n = (weights @ count).reshape(-1, *(1,) * (sums.ndim - 1))
        return LogChds(np.tensordot(weights, sums, 1) / n)

    return mean


def pooled_distance(
    shapes: Sequence[LogChds], blocks: Sequence[Blocks], *, level: float
) -> Interval[float]:
    """Return the distance between the mean shapes of two patches, unbiased by halves."""
    known = [of_patch[chds.known] for chds, of_patch in zip(shapes, blocks, strict=True)]
    first = len(known[0])
    means = [_mean_shape(s[s.known], of_patch) for s, of_patch in zip(shapes, known, strict=True)]

    def distance(weights: Floats) -> Floats:
        one, two = means[0](weights[:, :first]), means[1](weights[:, first:])
        # Noise may make the square negative.
        return np.sqrt(np.maximum(squared_distance(one, two), 0))

    return interval_of(distance, Blocks.join(known), level=level, bounds=(0.0, np.inf))


def between_channels(shapes: LogChds, pixels: PixelSet) -> Interval[float]:
    """Return the largest distance between the mean shapes of two channels."""
    known = shapes.known.all(axis=1)
    kept = pixels.blocks[known]
    mean = _mean_shape(shapes[known], kept)

    def squared(weights: Floats) -> Floats:
        means = mean(weights)
        pairs = combinations(range(shapes.halves.shape[1]), 2)
        return np.stack([squared_distance(means[:, a], means[:, b]) for a, b in pairs], axis=-1)

    return largest_of(squared, kept, level=pixels.level).root()


def shape_spread(shapes: LogChds, pixels: PixelSet) -> Interval[float]:
    """Return the root mean square distance of shapes to the mean of their region, without noise.

    The mean of products of halves less the product of the means is the covariance of the halves
    over pixels: the variance of the true shapes, of n - 1 degrees of freedom in each region.
    """
    known = shapes.known
    if np.count_nonzero(known) < 2:
        return Interval.unknown(level=pixels.level)
    kept, halves = pixels[known], shapes.halves[known]
    blocks = kept.blocks
    product = blocks.sums((halves[:, 0] * halves[:, 1]).sum(axis=-1) * WIDTH)
    sums, count = blocks.sums(halves), blocks.sums(np.ones(len(halves)))

    def spread(weights: Floats) -> Floats:
        squared, degrees = weights @ product, np.zeros(len(weights))
        for region in np.unique(blocks.region):
            here = blocks.region == region
            n = weights[:, here] @ count[here]
            total = np.tensordot(weights[:, here], sums[here], 1)
            squared -= (total[:, 0] * total[:, 1]).sum(axis=-1) * WIDTH / n
            degrees += n - 1
        return np.asarray(np.sqrt(np.maximum(squared / degrees, 0)))

    return kept.interval(spread, (0.0, np.inf))


# --- in several scenes ----------------------------------------------------------------------------


def common_count(scenes: Sequence[SceneData], *, least: int) -> int:
    """Return a number of positive samples that half of the pixels of every scene have.

    Only pixels with positive samples count, in the middle channel; at least `least`.
    """
    counts = [_positive(data) for data in scenes]
    middles = [np.median(n[n > 0]) if n.any() else 0 for n in counts]
    return max(least, int(min(middles, default=0)))


def drawn(data: SceneData, n: int, *, pixels: int, across: int = 8) -> tuple[Floats, Blocks]:
    """Draw `n` positive samples of pixels spread over the image, in the middle channel.

    Parameters
    ----------
    data
        The scene.
    n
        Samples of each pixel; pixels with fewer are left out.
    pixels
        Most pixels, equally many in each of `across` x `across` blocks of the image.
    across
        Blocks along each side.

    Returns
    -------
    tuple
        Radiance, shape (pixel, n), and the blocks that the pixels lie in.
    """
    patch = data.scattered(pixels, across=across, allowed=_positive(data) >= n)
    x = data.radiance(patch)
    light = x[:, x.shape[1] // 2]
    # Positive ones first, in an order drawn at random.
    rank = np.where(light > 0, generator(0).random(light.shape), 2)
    first = np.argpartition(rank, n - 1, axis=-1)[:, :n]
    return np.take_along_axis(light, first, axis=-1), patch.blocks


def _positive(data: SceneData) -> Counts:
    """Return how many positive samples each pixel has within its log histogram, shape (y, x)."""
    counts = data.summary["log_counts"]
    middle = counts.isel(channel=counts.sizes["channel"] // 2)
    return np.asarray(middle.sum("log_bin").to_numpy(), dtype=np.int64)


# --- in two renders -------------------------------------------------------------------------------


def squares(one: xr.Dataset, two: xr.Dataset) -> Floats:
    """Return squared distances between the shapes of two renders of a view, shape (pixel,).

    In each pixel, both renders use the same number of positive samples, the smaller of the two;
    from the other render they are drawn at random. If both have the same shape, their four halves
    are exchangeable, and the distance is as likely to be above 0 as below.

    Parameters
    ----------
    one, two
        Log histograms of the same size, as of `chdstat.summarize`; the channel in the middle
        counts.

    Returns
    -------
    ndarray
        In decades; NaN where either has too few samples for a shape. Twice that is the energy
        distance of the two distributions of log10 radiance.

    References
    ----------
    Székely and Rizzo, "Energy statistics: a class of statistics based on distances", 2013,
    doi:10.1016/j.jspi.2013.03.018.
    """
    rng = generator(0)
    middle = slice(one.sizes["channel"] // 2, one.sizes["channel"] // 2 + 1)
    datasets = [d[list(LOG_VARIABLES)].isel(channel=middle) for d in (one, two)]
    thin = _equally_many(datasets, rng)
    return _squared([of_histograms(dataset, rng).cumulative[..., 1:, :] for dataset in thin])


def squares_of_pairs(one: Samples, two: Samples) -> Floats:
    """Return squared distances of renders that share random numbers, shape (pixel,).

    Like `squares`, but the halves are alternating samples of both renders. If halves were drawn
    separately, the first half of one render would be correlated with the second half of the other,
    and distances would be too small.
    """
    rng, spp, middle = generator(0), min(one.spp, two.spp), one.shape[2] // 2
    halves = []
    for first in (0, 1):
        datasets = []
        for samples in (one, two):
            x = samples.read(ss=slice(0, spp))[:, :, middle : middle + 1, first::2]
            half = Samples.from_array(np.ascontiguousarray(x), axes="yxcs")
            datasets.append(summarize(half)[list(LOG_VARIABLES)])
        thin = _equally_many(datasets, rng)
        halves.append([of_histograms(dataset, rng).cumulative[..., 0, :] for dataset in thin])
    return _squared([np.stack(pair, axis=-2) for pair in zip(*halves, strict=True)])


def _equally_many(datasets: Sequence[xr.Dataset], rng: np.random.Generator) -> Iterator[xr.Dataset]:
    """Yield log histograms with equally many positive samples in each pixel."""
    counts = [dataset["log_counts"].to_numpy().astype(np.int64) for dataset in datasets]
    fewest = np.minimum(*(c.sum(axis=-1) for c in counts))
    for dataset, c in zip(datasets, counts, strict=True):
        # Multivariate hypergeometric: bin after bin, from the remaining samples.
        chosen, rest, left = np.empty_like(c), c.sum(axis=-1), fewest.copy()
        for i in range(c.shape[-1]):
            rest -= c[..., i]
            chosen[..., i] = rng.hypergeometric(c[..., i], rest, left)
            left -= chosen[..., i]
        yield dataset.assign(log_counts=(dataset["log_counts"].dims, chosen))


def _squared(renders: Sequence[Image]) -> Floats:
    """Return squared distances (pixel,) of two renders, each given as halves (y, x, half, edge)."""
    one, two = (LogChds(halves.astype(np.float64), ATLAS_WIDTH) for halves in renders)
    return squared_distance(one, two).ravel()


def permuted(squared: Sequence[Floats]) -> float:
    """Return the p-value of no difference between two integrators in any pixel.

    The statistic is the mean over the pixels of all scenes. Without a difference, one half of the
    samples of each pixel may be exchanged between the integrators, which changes the sign of its
    distance; pixels are rendered independently. So flips of signs give the null distribution.

    Parameters
    ----------
    squared
        `squares` of each scene.

    Returns
    -------
    float
        One-sided; NaN without a distance.

    Examples
    --------
    >>> permuted([np.full(10, 0.1)]) == 2**-10, permuted([np.tile([0.1, -0.1], 10)]) > 0.3
    (True, True)
    """
    values = np.concatenate([np.zeros(0), *squared])
    values = values[np.isfinite(values)]
    both_sides = float(p_of_signs(values[np.newaxis])[0])
    return both_sides / 2 if values.sum() > 0 else 1 - both_sides / 2
