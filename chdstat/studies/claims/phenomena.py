"""Claims on the regions of a scene: what the CHDs of a phenomenon look like.

Most claims of the case study are rows of `CASE_STUDY`: a statistic of the pixels of a region that
shows a phenomenon, or its difference from another region or from the image, and the range that the
paper's words mean. Where those name no number, a tail is long, and a spread wide, beyond the
exponential distribution's; "more" and "less" are above and below 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import ndimage, special, stats

from chdstat._core.arrays import Counts, Floats, Mask, luminance
from chdstat._core.moments import Moments
from chdstat._core.resampling import Blocks, Interval, interval_of
from chdstat.fit.distributions import gamma_shape
from chdstat.inference import modality
from chdstat.inference.findings import ClaimTest, Finding, PlotData, level_of, require, required
from chdstat.patterns import Thresholds
from chdstat.studies.claim import Claim, claim
from chdstat.studies.claims.assumptions import growing, with_room
from chdstat.studies.log_chds import (
    aligned,
    centred_logs,
    counts_by_row,
    mean_shapes,
    same_shape,
    shape_plot,
    visible,
)
from chdstat.studies.scene_data import (
    QUANTILES_NEED,
    PixelSet,
    SceneData,
    largest_interval,
    logs,
    means_by_region,
    positive_quantiles,
)
from chdstat.studies.shape_distances import (
    SHAPE_NEEDS,
    between_channels,
    channel_shift,
    log_skewness,
    pooled_distance,
    shape_spread,
    standard_logs,
)
from chdstat.summary.histograms import linear_support

_MAJORITY = 0.5
_TAIL = float(np.log(100) / np.log(2))
"""Quantile at 99 % over the median, of the exponential distribution: 6.6. Beyond it, a tail is
long."""
_LOG_TAIL = math.log10(math.log(100) / math.log(2))
_LOG_DARK = math.log10(math.log(2) / -math.log1p(-0.01))
"""Decades from the median of an exponential distribution to its quantiles at 99 % and 1 %."""
_SHIFT = 0.1
"""Decades between the channels' log CHDs that count as a shift: a factor of 1.26 in radiance, the
width of a bin of the paper's log histograms."""
_BINS = 100
"""Bins of a tenth of a decade, as of the paper's log histograms."""


def _moments(x: Floats) -> Moments:
    """Return the moments of the samples (..., sample) that are not NaN."""
    return Moments.of(x, np.isfinite(x))


def _variation(moments: Moments) -> Floats:
    """Return the deviation over the mean; NaN where the mean is not positive."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(moments.mean > 0, np.sqrt(moments.variance) / moments.mean, np.nan)


def _cast(data: SceneData, patch: PixelSet, x: Floats) -> ClaimTest:
    """Test that the channels of samples (pixel, channel, sample) are shifted."""
    require(data.samples.shape[2] > 1, "several channels")
    shift = channel_shift(x, patch)
    return ClaimTest("shift between channels", shift, least=_SHIFT, unit="decade")


def _density(x: Floats) -> tuple[Floats, Floats]:
    """Return the density of log10 radiance over all pixels, at the middles of 100 bins."""
    log = logs(x[x > 0])
    counts, edges = np.histogram(log[np.isfinite(log)], _BINS, range=(-5, 5))
    return (edges[1:] + edges[:-1]) / 2, counts * 10 / max(counts.sum(), 1)


# --- nulls and indirect light ---------------------------------------------------------------------

_NEAR = (0.45, 0.75)
"""Indirect light: "around 60 %" (Elek et al. 2019, section 5.1), give or take 15 points."""
_EXPECTED = {
    "night-room": (0.5, 1.0),
    "day-room": (0.0, 0.2),
    "white-room": (0.0, 0.2),
    "gallery": (0.0, 0.2),
}
"""Share over the image by scene: "often exceeding 50 %" by night, "typically under 20 %" in the
gallery, "low numbers" in the white room by day, for which the paper gives no figure."""


@claim(
    1,
    "nulls",
    "The share of null samples is near 60 % in indirect light, above half by night, and low "
    "where large sources light the scene.",
    spp=32,
)
def nulls(data: SceneData) -> Finding:
    """Compare the share of nulls with what the paper reports of such a scene."""
    expected, where = _EXPECTED.get(data.name.removeprefix("real-")), "the image"
    if expected is None:
        expected, where = _NEAR, "the indirect regions"
        patch = data.patch("indirect", "of indirect light")
    else:
        patch = data.whole()
    image = data.summary["null_share"].to_numpy()
    by_region: dict[str, float] = {}
    if data.regions:
        every = PixelSet.of(data.regions, *data.samples.shape[:2])
        by_region = every.by_region(every.take(image))
    return Finding(
        (ClaimTest(f"share of nulls in {where}", patch.mean(patch.take(image)), *expected),),
        plot_data=PlotData.bars(by_region, "share of nulls"),
    )


@claim(
    5,
    "indirect light",
    "CHDs of indirect light have long tails, high kurtosis, negative skew in the log domain, "
    "and many nulls.",
)
def indirect(data: SceneData) -> Finding:
    """Measure tail, kurtosis, skewness of logarithms and nulls in indirect light."""
    patch = data.patch("indirect", "of indirect light", tests=4)
    x = data.light(patch)
    middle, high = positive_quantiles(x, (0.5, 0.99))
    tail, skewness = high / middle, log_skewness(x)
    share = np.count_nonzero(x > 0) / x.size
    enough = f", about {2 ** math.ceil(math.log2(QUANTILES_NEED / share))} spp" if share > 0 else ""
    require(np.isfinite(tail).any(), f"{QUANTILES_NEED} positive samples in a pixel{enough}")
    grown = growing(x, x > 0, lambda moments: moments.kurtosis)
    kurtosis = with_room(patch.median(grown[-1]), grown)
    nulls = patch.take(data.summary["null_share"].to_numpy())
    ordered = np.sort(skewness[np.isfinite(skewness)])
    rank = (np.arange(len(ordered)) + 0.5) / max(len(ordered), 1)
    curve = {"pixels": (ordered, rank)}
    return Finding(
        (
            ClaimTest("quantile at 99 % over median", patch.median(tail), least=_TAIL),
            # That of the exponential distribution. Nulls would add to it; they have a test of their
            # own.
            ClaimTest("excess kurtosis of positive samples", kurtosis, least=6.0),
            ClaimTest("skewness of log radiance", patch.mean(skewness), most=0.0),
            ClaimTest("share of nulls", patch.mean(nulls), least=Thresholds().null_share),
        ),
        plot_data=PlotData("curves", curve, "skewness of log radiance", "share below"),
    )


# --- diffuse objects ------------------------------------------------------------------------------

_DISTANCE = 0.1
"""Kolmogorov's distance to a family that counts as near: no probability is wrong by more than 10
points. That is twice the misfit that `chdstat.classify` allows: the paper says "close to" and
"resembling", not "is"."""
_Z = np.linspace(-8, 8, 641)
_RATIO = np.linspace(0, 8, 641)
"""Edges of bins of standardised logarithms, and of radiance over the mean of its pixel."""


@claim(
    2,
    "diffuse objects",
    "CHDs of diffuse objects are symmetric and close to Gaussian in the log domain, and "
    "gamma-like with a mode below the mean in the linear one.",
)
def diffuse(data: SceneData) -> Finding:
    """Measure skewness and distance to Gaussian of logarithms, and likeness to gamma."""
    patch = data.patch("diffuse", "of diffuse objects", tests=4)
    x = visible(data.light(patch))
    skewness = log_skewness(x)
    known = np.isfinite(skewness)
    require(known.any(), f"{SHAPE_NEEDS} different positive samples in a pixel")
    x, used = x[known], patch[known]
    ratio = _ratios(x)
    with np.errstate(divide="ignore"):
        log_ratio = np.log(np.where(ratio > 0, ratio, np.nan))
    gaps = np.stack([np.nansum(log_ratio, axis=-1), np.isfinite(log_ratio).sum(axis=-1)], axis=-1)
    log_counts, ratio_counts, log_ratios = map(
        used.blocks.sums, (_counts(standard_logs(x), _Z), _counts(ratio, _RATIO), gaps)
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
        # 17 bins are a fifth of the mean.
        smooth = ndimage.uniform_filter1d((weights @ ratio_counts)[:, :-1], 17, axis=1)
        return np.asarray(((_RATIO[1:] + _RATIO[:-1]) / 2)[smooth.argmax(axis=1)])

    mean, gaussian = used.mean(skewness[known]), used.interval(to_gaussian, (0.0, 1.0))
    gamma, highest = used.interval(to_gamma, (0.0, 1.0)), used.interval(mode, (0.0, np.inf))
    counts, centers = log_counts.sum(axis=0), (_Z[1:] + _Z[:-1]) / 2
    curves = {
        "diffuse": (centers, counts / (counts.sum() * (_Z[1] - _Z[0]))),
        "Gaussian": (centers, np.exp(-(centers**2) / 2) / np.sqrt(2 * np.pi)),
    }
    return Finding(
        (
            # Fairly symmetric (Bulmer, "Principles of Statistics", 1979, page 63).
            ClaimTest("skewness of log radiance", mean, -0.5, 0.5),
            ClaimTest("distance of log radiance to a Gaussian", gaussian, most=_DISTANCE),
            ClaimTest("distance of radiance to a gamma distribution", gamma, most=_DISTANCE),
            ClaimTest("mode over mean", highest, most=1.0),
        ),
        plot_data=PlotData("curves", curves, "standardised log radiance", "density"),
    )


def _ratios(x: Floats) -> Floats:
    """Return positive samples over their mean, shape (..., sample); NaN for others."""
    positive = np.where(x > 0, x, np.nan)
    n = np.maximum((x > 0).sum(axis=-1, keepdims=True), 1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        unit = positive / np.nanmax(positive, axis=-1, keepdims=True)
        return np.asarray(unit / (np.nansum(unit, axis=-1, keepdims=True) / n))


def _counts(values: Floats, edges: Floats) -> Floats:
    """Count values of each row in bins, shape (row, bin); what lies outside goes to the ends."""
    bins = np.clip(np.searchsorted(edges, values, "right") - 1, 0, len(edges) - 2)
    return counts_by_row(bins, np.isfinite(values), len(edges) - 1).astype(np.float64)


def _distance(counts: Floats, distribution: Floats) -> Floats:
    """Return the largest distance of counts (replicate, bin) to a distribution function.

    That is given at the inner edges, shape (bin - 1,) or (replicate, bin - 1).
    """
    total = np.cumsum(counts, axis=1)
    return np.asarray(np.abs(total[:, :-1] / total[:, -1:] - distribution).max(axis=1))


# --- glossy objects and noisy reflections ---------------------------------------------------------


@claim(
    3,
    "glossy objects",
    "CHDs of glossy objects have the shape of diffuse ones, with channels moved apart and a "
    "spread that follows their radiance.",
)
def glossy(data: SceneData) -> Finding:
    """Compare glossy with diffuse shapes, and the channels with each other."""
    which = "of glossy and one of diffuse objects"
    patches = {name: data.patch(name, which, tests=3) for name in ("glossy", "diffuse")}
    require(data.samples.shape[2] > 1, "several channels")
    glossy = patches["glossy"]
    x = data.radiance(glossy)
    shapes = {name: aligned(data.light(patch)) for name, patch in patches.items()}
    blocks = [patch.blocks for patch in patches.values()]
    distance = pooled_distance(list(shapes.values()), blocks, level=glossy.level)
    slope = _spread_slope(x, glossy)
    return Finding(
        (
            same_shape("distance between glossy and diffuse shapes", distance),
            _cast(data, glossy, x),
            # 0 for additive noise, 1 for multiplicative; from half way on, the spread follows
            # radiance.
            ClaimTest("slope of log deviation on log mean over channels", slope, least=0.5),
        ),
        plot_data=mean_shapes(shapes),
    )


def _spread_slope(x: Floats, pixels: PixelSet) -> Interval[float]:
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
    return pixels.ratio((s1 * m2 + s2 * m1).sum(axis=1), (2 * m1 * m2).sum(axis=1))


@claim(
    4,
    "noisy reflections",
    "All pixels of a noisy reflection share one shape of the CHD, though their estimates vary.",
)
def reflections(data: SceneData) -> Finding:
    """Measure how far the shapes in a reflection differ, and how noisy it is."""
    patch = data.patch("noisy-reflection", "with a noisy reflection", tests=2)
    x = data.light(patch)
    shapes, grown = aligned(x), growing(np.nan_to_num(x), np.isfinite(x), _variation)
    spread, noise = shape_spread(shapes, patch), with_room(patch.median(grown[-1]), grown)
    some = shapes.whole[shapes.known][:64]
    return Finding(
        (
            same_shape("distance of a pixel's shape to that of the region", spread),
            # That of an exponential distribution, whose average of 32 samples scatters by 18 %.
            ClaimTest("deviation over mean of the samples", noise, least=1.0),
        ),
        plot_data=shape_plot({f"pixel {i + 1}": shape for i, shape in enumerate(some)}),
    )


# --- penumbrae ------------------------------------------------------------------------------------


@claim(
    6,
    "penumbrae",
    "CHDs in a penumbra are bimodal, with weights of the modes that follow the position across it.",
)
def penumbrae(data: SceneData) -> Finding:
    """Count bimodal pixels, and correlate the weight of the bright mode with the position.

    One half of the samples says where the border between the modes is and which way the penumbra
    runs, the other half what the weights are: noise cannot make them agree.
    """
    patch = data.patch("penumbra", "in a penumbra", tests=2)
    x = data.light(patch)
    bimodal = patch.mean(_several(x))
    ranks, (places, weights) = np.full((2, 2, len(patch)), np.nan)
    points = {}
    for i, name in enumerate(patch.names):
        here = patch.region == i
        one, two = x[here, 0::2], x[here, 1::2]
        border = _border(one)
        yx = np.stack([patch.y[here], patch.x[here]], axis=1).astype(np.float64)
        places[here] = _along(_bright(one, border), yx - yx.mean(axis=0))
        weights[here] = _bright(two, border)
        points[name] = places[here], weights[here]
        for rank, values in zip(ranks, (places, weights), strict=True):
            known = np.flatnonzero(here & np.isfinite(values))
            rank[known] = stats.rankdata(values[known]) / max(len(known), 1)
    follows, name = patch.correlation(*ranks), "weight of the bright mode"
    return Finding(
        (
            ClaimTest("share of bimodal pixels", bimodal, least=_MAJORITY),
            # Half of the variance of the ranks.
            ClaimTest(f"rank correlation of the {name} with position", follows, least=0.7),
        ),
        plot_data=PlotData("points", points, "position across the penumbra in pixels", name),
    )


def _border(x: Floats) -> float:
    """Return the radiance between dark and bright samples of a region (Otsu 1979, of logarithms).

    Otsu, "A threshold selection method from gray-level histograms", 1979,
    doi:10.1109/TSMC.1979.4310076.
    """
    logarithms = np.log(x[x > 0])
    # In a smaller range of log radiance, there are no two modes to be parted.
    if not logarithms.size or np.ptp(logarithms) < 1e-3:
        return np.nan
    counts, edges = np.histogram(logarithms, 400)
    centers = (edges[1:] + edges[:-1]) / 2
    below, moment = np.cumsum(counts)[:-1], np.cumsum(counts * centers)[:-1]
    n, total = counts.sum(), (counts * centers).sum()
    with np.errstate(invalid="ignore", divide="ignore"):
        between = (total * below - moment * n) ** 2 / (below * (n - below))
    return float(np.exp(edges[1:-1][np.nanargmax(between)]))


def _bright(x: Floats, border: float) -> Floats:
    """Return the share of the samples of each row above the border, nulls counted."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((x > border).sum(axis=1) / np.isfinite(x).sum(axis=1))


def _along(values: Floats, yx: Floats) -> Floats:
    """Return positions along the direction in which values rise, in pixels, from (y, x)."""
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(values), np.nan)
    rise = values[known] - values[known].mean()
    slope = np.linalg.lstsq(yx[known] - yx[known].mean(axis=0), rise, rcond=None)[0]
    length = float(np.linalg.norm(slope))
    return np.asarray(yx @ slope / length if length > 0 else np.zeros(len(values)))


# --- coloured textures ----------------------------------------------------------------------------

_CONTRAST = 0.1
"""Deviation of log10 albedo within a region, over pixels and channels, that a slope needs."""


@claim(
    7,
    "coloured textures",
    "A coloured texture moves the log CHD but does not change its shape, and albedo does not "
    "tell the relative variance.",
)
def textures(data: SceneData) -> Finding:
    """Compare shapes of channels, of dark and pale surfaces, and relative variance with albedo."""
    needed = "first-hit albedo of each channel"
    albedo = required(data.feature("albedo"), needed)
    require(data.samples.shape[2] == albedo.shape[-1], needed)
    require(albedo.shape[-1] > 1, "several channels")
    pair = _dark_and_pale(data, albedo)
    patch = _textured(data, albedo, level_of(4 if pair else 3))
    x = data.radiance(patch)
    log_albedo = _less_region(patch, logs(patch.take(albedo)))
    moments = _moments(x)
    relative_variance = logs(moments.variance) - 2 * logs(np.abs(moments.mean))
    log_variance = _less_region(patch, relative_variance)
    # Albedo has next to no noise that could flatten the slope.
    slope = patch.slope(log_albedo, log_variance)
    name = "slope of log relative variance on log albedo"
    tests = [
        _cast(data, patch, x),
        same_shape("distance between the shapes of channels", between_channels(aligned(x), patch)),
        # -2 is that of additive noise, 0 that of radiance times albedo; a quarter of the way does
        # not matter.
        ClaimTest(name, slope, -0.5, 0.5),
    ]
    if pair:
        shapes, blocks = [aligned(data.light(side)) for side in pair], [p.blocks for p in pair]
        distance = pooled_distance(shapes, blocks, level=patch.level)
        tests.append(same_shape("distance between the shapes of dark and pale", distance))
    channels = enumerate(data.samples.channels)
    return Finding(
        tuple(tests),
        plot_data=PlotData(
            "points",
            {channel: (log_albedo[:, i], log_variance[:, i]) for i, channel in channels},
            "log10 albedo around its region's mean",
            "log10 relative variance around its region's mean",
        ),
    )


def _textured(data: SceneData, albedo: Floats, level: float) -> PixelSet:
    """Return the textures, or else other surfaces, that have contrast enough."""
    shape, contrasty = albedo.shape[:2], []
    for region in data.regions:
        known = albedo[region.pixels(*shape)]
        known = known[known > 0]
        if known.size > 1 and np.log10(known).std() >= _CONTRAST:
            contrasty.append(region)
    textures = [r for r in contrasty if r.phenomenon == "texture"]
    surfaces = textures or [r for r in contrasty if r.phenomenon in ("glossy", "diffuse")]
    require(surfaces, f"a region whose log10 albedo varies by {_CONTRAST} or more")
    return PixelSet.of(surfaces, *shape, level=level)


def _dark_and_pale(data: SceneData, albedo: Floats) -> list[PixelSet]:
    """Return dark surfaces and the pale ones beside them; nothing without a pair of regions.

    They lie so close together that about the same light falls on both.
    """
    chosen = [region for region in data.regions if region.phenomenon == "albedo-contrast"]
    shape = albedo.shape[:2]
    pairs = [
        sorted(pair, key=lambda region: float(albedo[region.pixels(*shape)].mean()))
        for pair in zip(chosen[::2], chosen[1::2], strict=False)
    ]
    return [PixelSet.of(side, *shape) for side in zip(*pairs, strict=True)]


def _less_region(patch: PixelSet, values: Floats) -> Floats:
    """Return values less the mean of their region: light differs from region to region."""
    means = np.array(list(patch.by_region(values).values()))
    return np.asarray(values - means[patch.region, np.newaxis])


# --- statistics of pixels -------------------------------------------------------------------------


def _modes(x: Floats) -> Floats:
    """Return the number of modes in the log domain; NaN where they cannot be counted."""
    modes = modality(x).modes
    return np.where(modes > 0, modes, np.nan)


def _several(x: Floats) -> Floats:
    modes = _modes(x)
    return np.where(np.isfinite(modes), modes > 1, np.nan)


def _quantiles(x: Floats) -> Floats:
    """Return log10 of the quantiles at 1 %, 50 % and 99 % of positive samples, (3, pixel)."""
    return logs(positive_quantiles(x, (0.01, 0.5, 0.99)))


def _tail(x: Floats) -> Floats:
    _, middle, high = _quantiles(x)
    return np.asarray(high - middle)


def _width(x: Floats) -> Floats:
    low, _, high = _quantiles(x)
    return np.asarray(high - low)


def _reach(x: Floats) -> Floats:
    """Return how far the longer tail reaches beyond that of an exponential distribution."""
    low, middle, high = _quantiles(x)
    return np.asarray(np.maximum(high - middle - _LOG_TAIL, middle - low - _LOG_DARK))


def _noise(x: Floats) -> Floats:
    """Return log10 of the deviation over the mean of all samples, nulls among them."""
    moments = _moments(x)
    return np.asarray(logs(moments.variance) / 2 - logs(np.abs(moments.mean)))


def _spike(x: Floats) -> Floats:
    """Return the share of positive samples in the fullest tenth of a decade."""
    return _fullest(*_log_bins(x))


def _linear_spike(x: Floats) -> Floats:
    """Return the share of positive samples in the fullest bin of the paper's linear histogram."""
    positive = x > 0
    support = linear_support(x, null=x == 0, bad=~np.isfinite(x))
    low, high = support.low[:, np.newaxis], support.high[:, np.newaxis]
    with np.errstate(invalid="ignore", divide="ignore"):
        bins = np.floor(_BINS * (np.where(positive, x, 0) - low) / (high - low))
        inside = positive & (bins >= 0) & (bins < _BINS)
    found = _fullest(np.where(inside, bins, 0).astype(np.int64), inside)
    return np.asarray(found * inside.sum(axis=1) / np.maximum(positive.sum(axis=1), 1))


def _jagged(x: Floats) -> Floats:
    """Return the share of the log histogram that differs between both halves of the samples.

    Pixels of few positive samples are the noisiest; NaN only where a half has none.
    """
    with np.errstate(invalid="ignore"):
        one, two = (half / half.sum(axis=1, keepdims=True) for half in _halves(*_log_bins(x)))
    return np.asarray(np.abs(one - two).sum(axis=1) / 2)


def _log_bins(x: Floats) -> tuple[Counts, Mask]:
    """Return the bin of each sample around its pixel's mean log radiance, and which have one."""
    log, positive = centred_logs(visible(x))
    bins = np.floor(10 * log).astype(int) + _BINS // 2
    return np.clip(bins, 0, _BINS - 1), positive


def _halves(bins: Counts, counted: Mask) -> list[Counts]:
    """Return the histograms of both halves of the samples, each of shape (pixel, bin)."""
    return [counts_by_row(bins[:, i::2], counted[:, i::2], _BINS) for i in (0, 1)]


def _fullest(bins: Counts, counted: Mask) -> Floats:
    """Return the share of the fullest bin.

    One half of the samples says which that is, the other half how many it has: the fullest of
    noisy bins is too full.
    """
    one, two = _halves(bins, counted)
    row, total = np.arange(len(bins)), counted.sum(axis=1)
    found = one[row, two.argmax(axis=1)] + two[row, one.argmax(axis=1)]
    return np.where(total >= QUANTILES_NEED, found / np.maximum(total, 1), np.nan)


# --- statements of the case study -----------------------------------------------------------------


@dataclass(frozen=True)
class _Statement:
    """A statement of the paper about the pixels of a phenomenon.

    Attributes
    ----------
    name
        What the statistic is, in words.
    of
        Maps luminance, shape (pixel, sample), to the statistic, shape (pixel,).
    phenomenon
        Which regions it is about.
    against
        Phenomenon, or "image", whose mean is subtracted; "" for none.
    least, most
        Range of the mean over the pixels that the paper's words mean.
    unit
        "1" for pure numbers.
    """

    name: str
    of: Callable[[Floats], Floats]
    phenomenon: str
    against: str = ""
    least: float = -math.inf
    most: float = math.inf
    unit: str = "1"


def _claim(number: int, name: str, words: str, *statements: _Statement, cast: str = "") -> Claim:
    """Return the claim that all statements hold, and that a phenomenon has a colour cast."""

    def measure(data: SceneData) -> Finding:
        return _tested(data, statements, cast=cast)

    # Reports print the first line as the method.
    measured = [s.name for s in statements] + ["shift between channels"] * bool(cast)
    measure.__doc__ = f"Measure over the pixels: {'; '.join(measured)}."
    return claim(number, name, words)(measure)


CASE_STUDY = (
    _claim(18, "direct light",
        "CHDs of directly lit surfaces have several modes, a colour cast, and long tails.",
        _Statement("share of multimodal pixels", _several, "direct", least=_MAJORITY),
        _Statement("decades from median to 99 %", _tail, "direct", least=_LOG_TAIL, unit="decade"),
        cast="direct",
    ),
    _claim(19, "resolved direct light",
        "CHDs of directly lit surfaces are well resolved in spite of their spread and long tail.",
        _Statement(
            "noise of the log histogram less that of the image", _jagged, "direct", "image",
            most=0.0,
        ),
        _Statement(
            "decades between 1 % and 99 %", _width, "direct", least=_LOG_TAIL + _LOG_DARK,
            unit="decade",
        ),
        _Statement("decades from median to 99 %", _tail, "direct", least=_LOG_TAIL, unit="decade"),
    ),
    _claim(20, "direct and diffuse",
        "CHDs of diffuse objects that get more indirect light are less spiky in the log domain "
        "than those of directly lit surfaces, and have longer tails in the linear one.",
        _Statement(
            "fullest tenth of a decade, diffuse less direct", _spike, "diffuse", "direct", most=0.0
        ),
        _Statement(
            "decades from median to 99 %, diffuse less direct", _tail, "diffuse", "direct",
            least=0.0, unit="decade",
        ),
    ),
    _claim(22, "shadows",
        "CHDs in a shadow are skewed further to the dark in the log domain than in direct light, "
        "and vary more.",
        _Statement(
            "skewness of log radiance, shadow less direct", log_skewness, "shadow", "direct",
            most=0.0,
        ),
        _Statement(
            "log relative deviation, shadow less direct", _noise, "shadow", "direct", least=0.0,
            unit="decade",
        ),
    ),
    _claim(24, "virtual sources",
        "CHDs of translucent lamp shades have a very long, faint tail, and yet a low variance.",
        _Statement(
            "decades of the longer tail beyond an exponential's", _reach, "virtual-source",
            least=0.0, unit="decade",
        ),
        _Statement(
            "log relative deviation less that of the image", _noise, "virtual-source", "image",
            most=0.0, unit="decade",
        ),
    ),
    _claim(25, "fireplace",
        "The fireplace looks dull, but its CHD is wild in the log domain.",
        _Statement("modes less those of the image", _modes, "fireplace", "image", least=0.0),
        _Statement("share of multimodal pixels", _several, "fireplace", least=_MAJORITY),
    ),
    _claim(26, "hidden modes",
        "Most of a CHD of indirect light is one spike of the linear histogram; the log histogram "
        "shows several modes.",
        _Statement(
            "share of samples in the fullest linear bin", _linear_spike, "indirect",
            least=_MAJORITY,
        ),
        _Statement("share of multimodal pixels", _several, "indirect", least=_MAJORITY),
    ),
)  # fmt: skip
"""Claims on single regions; each is supported where all its statements are."""


def _tested(data: SceneData, statements: Sequence[_Statement], *, cast: str) -> Finding:
    """Test statements, and that the channels of a phenomenon are shifted, if one is named."""
    count = len(statements) + bool(cast)
    used = {s.phenomenon for s in statements} | {s.against for s in statements} - {""}
    sets = {name: _pixels(data, name, count) for name in sorted(used)}
    x = {name: data.light(patch) for name, patch in sets.items()}
    tests = list[ClaimTest]()
    for s in statements:
        names = [name for name in (s.phenomenon, s.against) if name]
        interval = _difference([s.of(x[name]) for name in names], [sets[name] for name in names])
        tests.append(ClaimTest(s.name, interval, s.least, s.most, s.unit))
    if cast:
        tests.append(_cast(data, sets[cast], data.radiance(sets[cast])))
    curves = {name: _density(x[name]) for name in sets}
    plot = PlotData("curves", curves, "log10 radiance", "density")
    return Finding(tuple(tests), plot_data=plot)


def _pixels(data: SceneData, phenomenon: str, tests: int) -> PixelSet:
    """Return the pixels of a phenomenon, or some from all over the image."""
    if phenomenon == "image":
        return data.scattered(512, tests=tests)
    return data.patch(phenomenon, f"of phenomenon {phenomenon}", tests=tests)


def _difference(values: Sequence[Floats], sets: Sequence[PixelSet]) -> Interval[float]:
    """Return the mean of the first values, less that of the second ones if there are any."""
    if len(values) == 1:
        return sets[0].mean(values[0])
    known, level = [np.isfinite(v) for v in values], sets[0].level
    if not all(k.any() for k in known):
        return Interval.unknown(level=level)
    joined = Blocks.join([pixels.blocks[k] for pixels, k in zip(sets, known, strict=True)])
    means = means_by_region(np.concatenate(values)[np.concatenate(known)], joined)
    return interval_of(lambda weights: means(weights) @ [1, -1], joined, level=level)


@claim(
    21,
    "distant indirect light",
    "CHDs of indirect light have one shape all over a room, and vary more than those of "
    "direct light.",
)
def similarity(data: SceneData) -> Finding:
    """Compare the shapes of indirect regions with each other, and their noise with direct light."""
    which = "of indirect light and another far from it"
    indirect, direct = data.patch("indirect", which, tests=2), _pixels(data, "direct", 2)
    require(len(indirect.names) > 1, f"a region {which}")
    x, level = data.light(indirect), indirect.level
    shapes = aligned(x)
    parts = [indirect.region == i for i in range(len(indirect.names))]
    each = 1 - (1 - level) / math.comb(len(parts), 2)
    distances = [
        pooled_distance([shapes[p] for p in pair], [indirect.blocks[p] for p in pair], level=each)
        for pair in combinations(parts, 2)
    ]
    largest = largest_interval(distances, "shapes of two regions of indirect light", level=level)
    noise = _difference([_noise(x), _noise(data.light(direct))], [indirect, direct])
    name = "log relative deviation, indirect less direct"
    return Finding(
        (
            same_shape("largest distance between the shapes of two regions", largest),
            ClaimTest(name, noise, least=0.0, unit="decade"),
        ),
        plot_data=mean_shapes({n: shapes[p] for n, p in zip(indirect.names, parts, strict=True)}),
    )


@claim(
    23,
    "several bounces",
    "CHDs of light that comes by several bounces have several modes and one shape in all "
    "channels, in spite of a colour cast.",
)
def bounces(data: SceneData) -> Finding:
    """Count modes where light comes by several bounces, and compare the channels' shapes."""
    patch = data.patch("multi-bounce", "lit by several bounces", tests=3)
    require(data.samples.shape[2] > 1, "several channels")
    x = data.radiance(patch)
    several = patch.mean(_several(np.asarray(luminance(x))))
    curves = {name: _density(x[:, i]) for i, name in enumerate(data.samples.channels)}
    return Finding(
        (
            ClaimTest("share of multimodal pixels", several, least=_MAJORITY),
            same_shape(
                "distance between the shapes of channels", between_channels(aligned(x), patch)
            ),
            _cast(data, patch, x),
        ),
        plot_data=PlotData("curves", curves, "log10 radiance", "density"),
    )
