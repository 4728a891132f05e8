"""Case study: what the paper says of single regions of its scenes (findings 18 to 26).

Most of these claims are rows of `STATEMENTS`: a statistic of the pixels of a region that shows a
phenomenon, or its difference from another region or from the image, and the range that the
paper's words mean. Where those name no number, a tail is long, and a spread wide, beyond the
exponential distribution's, as in the claim on indirect light; "more" and "less" are above and
below 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from chdstat._core.arrays import Counts, Floats, Mask, luminance
from chdstat._core.moments import Moments
from chdstat._core.resampling import Blocks, Interval, interval_of, mean_of
from chdstat.inference import modality
from chdstat.studies.claims.surfaces import (
    SHIFT,
    between_channels,
    channel_shift,
    log_skewness,
    pooled_distance,
)
from chdstat.studies.log_chds import aligned, same_shape, shape_plot, visible
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of, require
from chdstat.studies.scene_data import (
    QUANTILES_NEED,
    PixelSet,
    SceneData,
    largest_interval,
    logs,
    positive_quantiles,
)
from chdstat.summary.bins import linear_support

__all__ = ["STATEMENTS", "measure_bounces", "measure_direct", "measure_similarity", "statement"]

_MAJORITY = 0.5
_TAIL = math.log10(math.log(100) / math.log(2))
_DARK = math.log10(math.log(2) / -math.log1p(-0.01))
"""Decades from the median of an exponential distribution to its quantiles at 99 % and 1 %."""
_PIXELS = 512
"""Pixels that stand for the image, about."""
_BINS = 100
"""Bins of a tenth of a decade, as of the paper's log histograms."""


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
    return np.asarray(np.maximum(high - middle - _TAIL, middle - low - _DARK))


def _noise(x: Floats) -> Floats:
    """Return log10 of the deviation over the mean of all samples, nulls among them."""
    moments = Moments.of(x, np.isfinite(x))
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
    """Return the share of the log histogram that differs between both halves of the samples."""
    one, two = _halves(*_log_bins(x))
    n = [half.sum(axis=1, keepdims=True) for half in (one, two)]
    apart = np.abs(one / np.maximum(n[0], 1) - two / np.maximum(n[1], 1)).sum(axis=1) / 2
    return np.where((n[0] + n[1])[:, 0] >= QUANTILES_NEED, apart, np.nan)


def _log_bins(x: Floats) -> tuple[Counts, Mask]:
    """Return the bin of each sample around its pixel's mean log radiance, and which have one."""
    seen = visible(x)
    positive = seen > 0
    log = np.log10(np.where(positive, seen, 1))
    middle = log.sum(axis=1) / np.maximum(positive.sum(axis=1), 1)
    bins = np.floor(10 * (log - middle[:, np.newaxis])).astype(int) + _BINS // 2
    return np.clip(bins, 0, _BINS - 1), positive


def _halves(bins: Counts, counted: Mask) -> tuple[Counts, Counts]:
    """Return the histograms of both halves of the samples, each of shape (pixel, bin)."""
    rows = np.arange(len(bins))[:, np.newaxis] * _BINS
    one, two = (
        np.bincount((bins + rows)[:, i::2][counted[:, i::2]], minlength=len(bins) * _BINS)
        for i in (0, 1)
    )
    return one.reshape(len(bins), _BINS), two.reshape(len(bins), _BINS)


def _fullest(bins: Counts, counted: Mask) -> Floats:
    """Return the share of the fullest bin.

    One half of the samples says which that is, the other half how many it has: the fullest of
    noisy bins is too full.
    """
    one, two = _halves(bins, counted)
    row, total = np.arange(len(bins)), counted.sum(axis=1)
    found = one[row, two.argmax(axis=1)] + two[row, one.argmax(axis=1)]
    return np.where(total >= QUANTILES_NEED, found / np.maximum(total, 1), np.nan)


# --- statements -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Statement:
    """One thing that the paper says of the pixels of a phenomenon.

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


STATEMENTS: dict[str, tuple[Statement, ...]] = {
    "direct light": (
        Statement("share of multimodal pixels", _several, "direct", least=_MAJORITY),
        Statement("decades from median to 99 %", _tail, "direct", least=_TAIL, unit="decade"),
    ),
    "resolved direct light": (
        Statement(
            "noise of the log histogram less that of the image", _jagged, "direct", "image",
            most=0.0,
        ),
        Statement(
            "decades between 1 % and 99 %", _width, "direct", least=_TAIL + _DARK, unit="decade"
        ),
        Statement("decades from median to 99 %", _tail, "direct", least=_TAIL, unit="decade"),
    ),
    "direct and diffuse": (
        Statement(
            "fullest tenth of a decade, diffuse less direct", _spike, "diffuse", "direct", most=0.0
        ),
        Statement(
            "decades from median to 99 %, diffuse less direct", _tail, "diffuse", "direct",
            least=0.0, unit="decade",
        ),
    ),
    "shadows": (
        Statement(
            "skewness of log radiance, shadow less direct", log_skewness, "shadow", "direct",
            most=0.0,
        ),
        Statement(
            "log relative deviation, shadow less direct", _noise, "shadow", "direct", least=0.0,
            unit="decade",
        ),
    ),
    "virtual sources": (
        Statement(
            "decades of the longer tail beyond an exponential's", _reach, "virtual-source",
            least=0.0, unit="decade",
        ),
        Statement(
            "log relative deviation less that of the image", _noise, "virtual-source", "image",
            most=0.0, unit="decade",
        ),
    ),
    "hidden modes": (
        Statement(
            "share of samples in the fullest linear bin", _linear_spike, "indirect",
            least=_MAJORITY,
        ),
        Statement("share of multimodal pixels", _several, "indirect", least=_MAJORITY),
    ),
    "fireplace": (
        Statement("modes less those of the image", _modes, "fireplace", "image", least=0.0),
        Statement("share of multimodal pixels", _several, "fireplace", least=_MAJORITY),
    ),
}  # fmt: skip
"""What the paper says, by name of the claim, which is supported where all of it is."""


def statement(name: str) -> Callable[[SceneData], Outcome]:
    """Return what measures the statements of that name."""

    def measure(data: SceneData) -> Outcome:
        return _tested(data, STATEMENTS[name])

    # Reports print the first line as the method.
    measure.__doc__ = f"Measure over the pixels: {'; '.join(s.name for s in STATEMENTS[name])}."
    return measure


def measure_direct(data: SceneData) -> Outcome:
    """Count modes in direct light, and measure its tail and its colour cast."""
    return _tested(data, STATEMENTS["direct light"], cast="direct")


def _tested(data: SceneData, statements: Sequence[Statement], *, cast: str = "") -> Outcome:
    """Test statements, and that the channels of a phenomenon are shifted, if one is named."""
    level = level_of(len(statements) + bool(cast))
    names = {s.phenomenon for s in statements} | {s.against for s in statements} - {""}
    sets = {name: _pixels(data, name) for name in sorted(names)}
    x = {name: data.light(patch) for name, patch in sets.items()}
    tests, means = list[ClaimTest](), dict[str, float]()
    for s in statements:
        both = [name for name in (s.phenomenon, s.against) if name]
        values = [s.of(x[name]) for name in both]
        interval = _difference(values, [sets[name].blocks for name in both], level=level)
        tests.append(ClaimTest(s.name, interval, least=s.least, most=s.most, unit=s.unit))
        means |= {f"{name}: {s.name}": _mean(v) for name, v in zip(both, values, strict=True)}
    if cast:
        tests.append(_cast(data, sets[cast], level))
    curves = {name: _density(x[name]) for name in sets}
    return Outcome(
        tuple(tests),
        details={"means": means, "pixels": {name: len(patch) for name, patch in sets.items()}},
        plot_data=PlotData("curves", curves, "log10 radiance", "density"),
    )


def _pixels(data: SceneData, phenomenon: str) -> PixelSet:
    """Return the pixels of a phenomenon, or some from all over the image."""
    if phenomenon != "image":
        return data.patch(phenomenon, f"of phenomenon {phenomenon}")
    every = list(data.scattered(_PIXELS))
    y, x, block = (
        np.concatenate(parts)
        for parts in zip(*((p.y, p.x, p.blocks.of_pixel) for p in every), strict=True)
    )
    blocks = Blocks(block, every[0].blocks.region)[:]
    return PixelSet(("image",), y, x, np.zeros_like(y), blocks)


def _difference(
    values: Sequence[Floats], blocks: Sequence[Blocks], *, level: float
) -> Interval[float]:
    """Return the mean of the first values, less that of the second ones if there are any."""
    if len(values) == 1:
        return mean_of(values[0], blocks[0], level=level)
    known = [np.isfinite(v) for v in values]
    if not all(k.any() for k in known):
        return Interval.unknown(level=level)
    used = [b[k] for b, k in zip(blocks, known, strict=True)]
    joined, first = Blocks.join(list(used)), len(used[0])
    every = np.concatenate([v[k] for v, k in zip(values, known, strict=True)])
    sums, count = joined.sums(every), joined.sums(np.ones(len(every)))

    def mean(weights: Floats, part: slice) -> Floats:
        return np.asarray((weights[:, part] @ sums[part]) / (weights[:, part] @ count[part]))

    def difference(weights: Floats) -> Floats:
        return mean(weights, slice(None, first)) - mean(weights, slice(first, None))

    return interval_of(difference, joined, level=level)


def _cast(data: SceneData, patch: PixelSet, level: float) -> ClaimTest:
    require(data.samples.shape[2] > 1, "several channels")
    shift = channel_shift(data.radiance(patch), patch.blocks, level=level)
    return ClaimTest("shift between channels", shift, least=SHIFT, unit="decade")


def _mean(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _density(x: Floats) -> tuple[Floats, Floats]:
    """Return the density of log10 radiance over all pixels, at the middles of 100 bins."""
    log = logs(x[x > 0])
    counts, edges = np.histogram(log[np.isfinite(log)], _BINS, range=(-5, 5))
    return (edges[1:] + edges[:-1]) / 2, counts * 10 / max(counts.sum(), 1)


# --- indirect light and several bounces -----------------------------------------------------------


def measure_similarity(data: SceneData) -> Outcome:
    """Compare the shapes of indirect regions with each other, and their noise with direct light."""
    needed = "two regions of indirect light, far from each other"
    indirect, direct = data.patch("indirect", needed), _pixels(data, "direct")
    require(len(indirect.names) > 1, needed)
    x, level = data.light(indirect), level_of(2)
    shapes = aligned(x)
    parts = [indirect.region == i for i in range(len(indirect.names))]
    distances = {
        f"{indirect.names[i]} and {indirect.names[j]}": pooled_distance(
            [shapes[parts[i]], shapes[parts[j]]],
            [indirect.blocks[parts[i]], indirect.blocks[parts[j]]],
            level=1 - (1 - level) / math.comb(len(parts), 2),
        )
        for i, j in combinations(range(len(parts)), 2)
    }
    known = {name: d for name, d in distances.items() if math.isfinite(d.value)}
    require(known, "shapes of two regions of indirect light")
    farthest = replace(largest_interval([*known.values()]), level=level)
    noise = _difference(
        [_noise(x), _noise(data.light(direct))], [indirect.blocks, direct.blocks], level=level
    )
    means = {
        name: shapes.whole[part & shapes.known].mean(axis=0)
        for name, part in zip(indirect.names, parts, strict=True)
        if (part & shapes.known).any()
    }
    return Outcome(
        (
            same_shape("largest distance between the shapes of two regions", farthest),
            ClaimTest(
                "log relative deviation, indirect less direct", noise, least=0.0, unit="decade"
            ),
        ),
        details={"distances": {name: d.value for name, d in distances.items()}},
        plot_data=shape_plot(means),
    )


def measure_bounces(data: SceneData) -> Outcome:
    """Count modes where light comes by several bounces, and compare the channels' shapes."""
    patch, level = data.patch("multi-bounce", "lit by several bounces"), level_of(3)
    cast = _cast(data, patch, level)
    x = data.radiance(patch)
    several = mean_of(_several(np.asarray(luminance(x))), patch.blocks, level=level)
    distance = between_channels(aligned(x), patch.blocks, level)
    curves = {name: _density(x[:, i]) for i, name in enumerate(data.samples.channels)}
    return Outcome(
        (
            ClaimTest("share of multimodal pixels", several, least=_MAJORITY),
            same_shape("distance between the shapes of channels", distance),
            cast,
        ),
        plot_data=PlotData("curves", curves, "log10 radiance", "density"),
    )
