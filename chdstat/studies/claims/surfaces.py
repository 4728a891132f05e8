"""Surfaces: CHDs of diffuse, glossy, reflecting and textured objects (findings 2, 3, 4 and 7)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np
from scipy import ndimage, special

from chdstat._core.arrays import Floats
from chdstat._core.moments import Moments
from chdstat._core.resampling import Blocks, Interval, interval_of, largest_of, mean_of, median_of
from chdstat.fit._gamma import gamma_shape
from chdstat.studies.log_chds import (
    WIDTH,
    LogChds,
    aligned,
    same_shape,
    shape_plot,
    squared_distance,
    visible,
)
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of, require, required
from chdstat.studies.scene_data import PixelSet, SceneData, logs, ratio_of, slope_of

__all__ = [
    "SHIFT",
    "between_channels",
    "channel_shift",
    "log_skewness",
    "measure_diffuse",
    "measure_glossy",
    "measure_reflections",
    "measure_textures",
    "pooled_distance",
]


# --- diffuse objects ------------------------------------------------------------------------------

_SYMMETRIC = 0.5
"""Skewness up to which a distribution is fairly symmetric (Bulmer, "Principles of Statistics",
1979, page 63)."""
_DISTANCE = 0.1
"""Kolmogorov's distance to a family that counts as near: no probability is wrong by more than 10
points. That is twice the misfit that `chdstat.classify` allows: the paper says "close to" and
"resembling", not "is"."""
_LEAST = 32
"""Positive samples that the shape of a pixel needs."""
_Z = np.linspace(-8, 8, 641)
_RATIO = np.linspace(0, 8, 641)
"""Edges of bins of standardised logarithms, and of radiance over the mean of its pixel."""
_SMOOTH = 17
"""Bins that the histogram is averaged over before its mode is taken, a fifth of the mean."""


def measure_diffuse(data: SceneData) -> Outcome:
    """Measure skewness and distance to Gaussian of logarithms, and likeness to gamma."""
    patch = data.patch("diffuse", "of diffuse objects")
    x = visible(data.light(patch))
    skewness = log_skewness(x)
    known = np.isfinite(skewness)
    require(known.any(), f"{_LEAST} different positive samples in a pixel")
    x, blocks, level = x[known], patch.blocks[known], level_of(4)
    ratio = _ratios(x)
    with np.errstate(divide="ignore"):
        log_ratio = np.log(np.where(ratio > 0, ratio, np.nan))
    gaps = np.stack([np.nansum(log_ratio, axis=-1), np.isfinite(log_ratio).sum(axis=-1)], axis=-1)
    log_counts, ratio_counts, log_ratios = (
        blocks.sums(of_pixel)
        for of_pixel in (_counts(_standard_logs(x), _Z), _counts(ratio, _RATIO), gaps)
    )

    def to_gaussian(weights: Floats) -> Floats:
        return _distance(weights @ log_counts, special.ndtr(_Z[1:-1]))

    def to_gamma(weights: Floats) -> Floats:
        """Return the distance to the gamma distribution of maximum likelihood, of mean 1."""
        sums = weights @ log_ratios
        k = gamma_shape(-sums[:, 0] / sums[:, 1])[0][:, np.newaxis]
        return _distance(weights @ ratio_counts, special.gammainc(k, k * _RATIO[1:-1]))

    def mode(weights: Floats) -> Floats:
        """Return the highest place of the smoothed histogram of radiance over the mean."""
        # The last bin holds all that lies beyond, and is no mode.
        smooth = ndimage.uniform_filter1d((weights @ ratio_counts)[:, :-1], _SMOOTH, axis=1)
        return np.asarray(((_RATIO[1:] + _RATIO[:-1]) / 2)[smooth.argmax(axis=1)])

    unit, positive = (0.0, 1.0), (0.0, np.inf)
    gaussian = interval_of(to_gaussian, blocks, level=level, bounds=unit)
    gamma = interval_of(to_gamma, blocks, level=level, bounds=unit)
    highest = interval_of(mode, blocks, level=level, bounds=positive)
    mean = mean_of(skewness[known], blocks, level=level)
    counts, centers = log_counts.sum(axis=0), (_Z[1:] + _Z[:-1]) / 2
    curves = {
        "diffuse": (centers, counts / (counts.sum() * (_Z[1] - _Z[0]))),
        "Gaussian": (centers, np.exp(-(centers**2) / 2) / np.sqrt(2 * np.pi)),
    }
    return Outcome(
        (
            ClaimTest("skewness of log radiance", mean, least=-_SYMMETRIC, most=_SYMMETRIC),
            ClaimTest("distance of log radiance to a Gaussian", gaussian, most=_DISTANCE),
            ClaimTest("distance of radiance to a gamma distribution", gamma, most=_DISTANCE),
            ClaimTest("mode over mean", highest, most=1.0),
        ),
        details={"log_skewness": patch.by_region(skewness)},
        plot_data=PlotData("curves", curves, "standardised log radiance", "density"),
    )


def log_skewness(x: Floats) -> Floats:
    """Return the skewness of log radiance in sight, shape (...); NaN below 32 samples.

    NaN, too, where all are equal.
    """
    z = _standard_logs(visible(x))
    n = np.isfinite(z).sum(axis=-1)
    return np.asarray(np.where(n >= _LEAST, np.nansum(z**3, axis=-1) / np.maximum(n, 1), np.nan))


def _standard_logs(x: Floats) -> Floats:
    """Return logarithms less their mean over their deviation; NaN where x is not positive."""
    log = np.log(np.where(x > 0, x, np.nan))
    n = np.maximum((x > 0).sum(axis=-1, keepdims=True), 1)
    log -= np.nansum(log, axis=-1, keepdims=True) / n
    deviation = np.sqrt(np.nansum(log**2, axis=-1, keepdims=True) / n)
    with np.errstate(invalid="ignore", divide="ignore"):
        # Equal radiance has rounding errors for a deviation, and no shape.
        return np.asarray(np.where(deviation > 1e-6, log / deviation, np.nan))


def _ratios(x: Floats) -> Floats:
    """Return positive samples over their mean, shape (..., sample); NaN for others."""
    positive = np.where(x > 0, x, np.nan)
    n = np.maximum((x > 0).sum(axis=-1, keepdims=True), 1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        scale = np.nanmax(positive, axis=-1, keepdims=True)
        unit = positive / scale
        return np.asarray(unit / (np.nansum(unit, axis=-1, keepdims=True) / n))


def _counts(values: Floats, edges: Floats) -> Floats:
    """Count values of each row in bins, shape (row, bin); what lies outside goes to the ends."""
    known = np.isfinite(values)
    bins = np.clip(np.searchsorted(edges, values[known], "right") - 1, 0, len(edges) - 2)
    row = np.nonzero(known)[0] * (len(edges) - 1)
    counts = np.bincount(row + bins, minlength=len(values) * (len(edges) - 1))
    return np.asarray(counts.reshape(len(values), -1), dtype=np.float64)


def _distance(counts: Floats, distribution: Floats) -> Floats:
    """Return the largest distance of counts (replicate, bin) to a distribution function.

    That is given at the inner edges, shape (bin - 1,) or (replicate, bin - 1).
    """
    total = np.cumsum(counts, axis=1)
    return np.asarray(np.abs(total[:, :-1] / total[:, -1:] - distribution).max(axis=1))


# --- glossy objects -------------------------------------------------------------------------------

SHIFT = 0.1
"""Decades between the channels' log CHDs that count as a shift: a factor of 1.26 in radiance, the
width of a bin of the paper's log histograms."""
_FOLLOWS = 0.5
"""Slope of log deviation on log mean: 0 for additive noise, 1 for multiplicative; from half way on,
the spread is a function of radiance."""


def measure_glossy(data: SceneData) -> Outcome:
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
    log_mean = logs(_moments(x).mean)
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
    log = np.log10(np.where(lit[:, np.newaxis], x, 1)).sum(axis=-1)
    sums, count = blocks.sums(log), blocks.sums(lit.sum(axis=-1))
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
    halves = [_moments(x[..., i::2]) for i in (0, 1)]
    log = logs(np.stack([h.mean for h in halves] + [np.sqrt(h.variance) for h in halves]))
    m1, m2, s1, s2 = log - log.mean(axis=-1, keepdims=True)
    above, below = (s1 * m2 + s2 * m1).sum(axis=1), (2 * m1 * m2).sum(axis=1)
    return ratio_of(above, below, blocks, level=level)


def _moments(x: Floats) -> Moments:
    """Return the moments of the samples (..., sample) that are not NaN."""
    return Moments.of(x, np.isfinite(x))


# --- noisy reflections ----------------------------------------------------------------------------

_NOISY = 1.0
"""Deviation over mean of the samples from which a pixel is noisy: that of an exponential
distribution, whose average of 32 samples scatters by 18 %."""


def measure_reflections(data: SceneData) -> Outcome:
    """Measure how far the shapes in a reflection differ, and how noisy it is."""
    patch, level = data.patch("noisy-reflection", "with a noisy reflection"), level_of(2)
    x = data.light(patch)
    shapes, moments = aligned(x), _moments(x)
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


# --- coloured textures ----------------------------------------------------------------------------

_CONTRAST = 0.1
"""Deviation of log10 albedo within a region, over pixels and channels, that a slope needs."""
_NO_SLOPE = 0.5
"""Slope of log relative variance on log albedo that counts as none: -2 is that of additive noise,
0 that of radiance times albedo; a quarter of the way does not matter."""


def measure_textures(data: SceneData) -> Outcome:
    """Compare shapes of channels, of dark and pale surfaces, and relative variance with albedo."""
    needed = "first-hit albedo of each channel"
    albedo = required(data.feature("albedo"), needed)
    require(data.samples.shape[2] == albedo.shape[-1], needed)
    require(albedo.shape[-1] > 1, "several channels")
    patch, pair = _textured(data, albedo), _dark_and_pale(data, albedo)
    x, level = data.radiance(patch), level_of(4 if pair else 3)
    log_albedo = _less_region(patch, logs(patch.take(albedo)))
    moments = _moments(x)
    relative_variance = logs(moments.variance) - 2 * logs(np.abs(moments.mean))
    log_variance = _less_region(patch, relative_variance)
    shift = channel_shift(x, patch.blocks, level=level)
    # Albedo has next to no noise that could flatten the slope.
    slope = slope_of(log_albedo, log_variance, patch.blocks, level=level)
    channels = between_channels(aligned(x), patch.blocks, level)
    tests = [
        ClaimTest("shift between channels", shift, least=SHIFT, unit="decade"),
        same_shape("distance between the shapes of channels", channels),
        ClaimTest(
            "slope of log relative variance on log albedo", slope, least=-_NO_SLOPE, most=_NO_SLOPE
        ),
    ]
    if pair:
        shapes, blocks = [aligned(data.light(side)) for side in pair], [p.blocks for p in pair]
        distance = pooled_distance(shapes, blocks, level=level)
        tests.append(same_shape("distance between the shapes of dark and pale", distance))
    return Outcome(
        tuple(tests),
        details={"regions": list(patch.names), "pixels": len(patch)},
        plot_data=PlotData(
            "points",
            {
                channel: (log_albedo[:, i], log_variance[:, i])
                for i, channel in enumerate(data.samples.channels)
            },
            "log10 albedo around its region's mean",
            "log10 relative variance around its region's mean",
        ),
    )


def _textured(data: SceneData, albedo: Floats) -> PixelSet:
    """Return the textures, or else other surfaces, that have contrast enough."""
    shape, contrasty = albedo.shape[:2], []
    for region in data.regions:
        known = albedo[region.pixels(*shape)]
        known = known[known > 0]
        if known.size > 1 and np.log10(known).std() >= _CONTRAST:
            contrasty.append(region)
    textures = tuple(r for r in contrasty if r.phenomenon == "texture")
    surfaces = textures or tuple(r for r in contrasty if r.phenomenon in ("glossy", "diffuse"))
    require(surfaces, f"a region whose log10 albedo varies by {_CONTRAST} or more")
    return PixelSet.of(surfaces, *shape)


def _dark_and_pale(data: SceneData, albedo: Floats) -> tuple[PixelSet, ...]:
    """Return dark surfaces and the pale ones beside them; nothing without a pair of regions.

    They lie so close together that about the same light falls on both.
    """
    chosen = [region for region in data.regions if region.phenomenon == "albedo-contrast"]
    shape = albedo.shape[:2]
    pairs = [
        sorted(pair, key=lambda region: float(albedo[region.pixels(*shape)].mean()))
        for pair in zip(chosen[::2], chosen[1::2], strict=False)
    ]
    return tuple(PixelSet.of(side, *shape) for side in zip(*pairs, strict=True))


def _less_region(patch: PixelSet, values: Floats) -> Floats:
    """Return values less the mean of their region: light differs from region to region."""
    means = np.array(list(patch.by_region(values).values()))
    return np.asarray(values - means[patch.region, np.newaxis])


def between_channels(shapes: LogChds, blocks: Blocks, level: float) -> Interval[float]:
    """Return the largest distance between the mean shapes of two channels."""
    known = shapes.known.all(axis=1)
    kept = blocks[known]
    sums, count = kept.sums(shapes.halves[known]), kept.sums(np.ones(np.count_nonzero(known)))

    def squares(weights: Floats) -> Floats:
        n = (weights @ count)[:, np.newaxis, np.newaxis, np.newaxis]
        means = LogChds(np.tensordot(weights, sums, 1) / n)
        pairs = combinations(range(sums.shape[1]), 2)
        return np.stack([squared_distance(means[:, a], means[:, b]) for a, b in pairs], axis=-1)

    return largest_of(squares, kept, level=level).root()
