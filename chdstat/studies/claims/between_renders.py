"""Claims that compare renders: longer paths, integrators, spread samples, and other scenes.

For integrators: the skewness of an average of n samples is that of one sample divided by the root
of n. So the n that makes it nearly Gaussian is proportional to the squared skewness. This n times
the time of a sample is the time until averages are Gaussian. Only the ratio of two integrators
matters.

For spread samples: equation 4 of the paper bounds the variance of an average by that of independent
samples, because samples that are spread over a pixel have negative covariances. Sequences of such a
sampler are replications of one average, and their samples have the same distribution as independent
ones. So one render shows both variances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from chdstat._core.arrays import Floats, Image, generator, is_bad, luminance
from chdstat._core.image_scales import relative_scale
from chdstat._core.resampling import LEVEL, Blocks, Interval, interval_of, mean_of
from chdstat.inference import modality
from chdstat.inference.findings import ClaimTest, Finding, PlotData, level_of, require, required
from chdstat.inference.noise_rankings import TIMING
from chdstat.samples import Samples
from chdstat.samples.dependence import sequence_of
from chdstat.samples.tiles import tiles
from chdstat.studies.claim import claim
from chdstat.studies.log_chds import aligned, shape_plot
from chdstat.studies.scene_data import (
    BSDF_SAMPLING,
    DIRECT,
    QUANTILES_NEED,
    PixelSet,
    SceneData,
    fold_of,
    known_mean,
    largest_interval,
    logs,
    means_by_region,
)
from chdstat.studies.shape_distances import (
    SHAPE_NEEDS,
    common_count,
    drawn,
    permuted,
    squares,
    squares_of_pairs,
)
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

# --- longer paths ---------------------------------------------------------------------------------

_LEVELS = (0.01, 0.5, 0.99)
_NO_TIMES = "needs times of the renders, by the scalar backend"


@claim(
    9,
    "path lengths",
    "Longer paths give CHDs of wider support, longer tail, more skew and more variance.",
    paired=True,
)
def lengths(data: SceneData) -> Finding:
    """Compare pixel by pixel with an image of the same view with shorter paths."""
    _, short = _shorter(data)
    whole, changes = data.whole(tests=4), _changes(data.summary, short)
    tests = tuple(
        ClaimTest(
            f"mean change of {name}",
            whole.mean(change.reshape(len(whole), -1)),
            # 2 % of radiance, or a hundredth of a skewness that lies between -1 and 1; below it,
            # nothing grew.
            least=0.01,
            unit="1" if name == "skewness" else "decade",
        )
        for name, change in changes.items()
    )
    bars = {n: m for n, v in changes.items() if np.isfinite(m := known_mean(v))}
    return Finding(tests, plot_data=PlotData.bars(bars, "change with longer paths"))


def _shorter(data: SceneData) -> tuple[Samples, xr.Dataset]:
    """Return the render with shorter paths, and its statistics."""
    needed = "the same scene rendered with shorter paths"
    shorter, short = required(data.shorter, needed), required(data.shorter_summary, needed)
    same = data.summary["null_share"].shape == short["null_share"].shape
    require(same, "shorter paths in the same size")
    return shorter, short


def _changes(long: xr.Dataset, short: xr.Dataset) -> dict[str, Floats]:
    """Return what longer paths add, each of shape (y, x, channel).

    Support is the distance between the quantiles at 1 % and 99 % of positive radiance, tail the
    distance between the median and 99 %, both in decades. Unlike extremes and moments, they do not
    grow with the number of positive samples, of which shorter paths have fewer. Variance includes
    nulls. Skewness is (high + low - 2 median) / (high - low) of radiance, in [-1, 1] (Hinkley, "On
    power transformations to symmetry", 1975, doi:10.1093/biomet/62.1.101).
    """
    after, before = _quantiles(long), _quantiles(short)
    low, middle, high = np.moveaxis(after - before, -1, 0)
    skewness = []
    for quantiles in (after, before):
        a, b, c = np.moveaxis(10**quantiles, -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            skewness.append((c + a - 2 * b) / (c - a))
    return {
        "support": high - low,
        "tail": high - middle,
        "skewness": skewness[0] - skewness[1],
        "log variance": logs(long["variance"].to_numpy()) - logs(short["variance"].to_numpy()),
    }


def _quantiles(dataset: xr.Dataset) -> Floats:
    """Return quantiles of log10 of positive radiance from histograms, shape (y, x, channel, 3)."""
    counts = dataset["log_counts"].to_numpy()
    total = np.cumsum(counts, axis=-1, dtype=np.float64)
    n = total[..., -1:]
    edges = np.linspace(-5, 5, counts.shape[-1] + 1)
    quantiles = np.full((*counts.shape[:-1], len(_LEVELS)), np.nan)
    for i, level in enumerate(_LEVELS):
        place = (total < level * n).sum(axis=-1, keepdims=True).clip(max=counts.shape[-1] - 1)
        inside = np.maximum(np.take_along_axis(counts, place, -1), 1)
        start = np.take_along_axis(total, place, -1) - inside
        part = np.clip((level * n - start) / inside, 0, 1)
        quantiles[..., i] = (edges[place] + part * (edges[1] - edges[0]))[..., 0]
    return np.asarray(np.where(n >= QUANTILES_NEED, quantiles, np.nan))


def _seconds_per_sample(samples: Samples) -> float | None:
    """Return the time to render and store one sample, in s, all cores together.

    The time of a render does not include loading the scene. But it includes compilation, which
    cannot be separated: None for all but the scalar backend.
    """
    seconds: Any = samples.attrs.get("render_seconds")
    if not seconds or samples.attrs.get("backend") != "scalar":
        return None
    height, width, _, spp = samples.shape
    return float(seconds) / (height * width * spp)


@claim(
    28,
    "cost of longer paths",
    "Images of longer paths are visibly brighter, and take longer to render.",
    spp=32,
    paired=True,
)
def cost(data: SceneData) -> Finding:
    """Compare mean radiance and time with those of the same view with shorter paths."""
    (shorter, short), long = _shorter(data), data.summary
    whole = data.whole(tests=2)
    means = (s["mean"].to_numpy().astype(np.float64)[..., np.newaxis] for s in (long, short))
    after, before = (np.asarray(luminance(mean)).ravel() for mean in means)
    ratio = whole.ratio(after, before)
    # Visible, after Weber's law.
    tests = [ClaimTest("mean radiance over that of shorter paths", ratio, least=1.02)]
    seconds = [_seconds_per_sample(samples) for samples in (data.samples, shorter)]
    if seconds[0] and seconds[1]:
        slower = seconds[0] / seconds[1]
        time = Interval(slower, slower / TIMING, slower * TIMING, whole.level)
        tests.append(ClaimTest("time per sample over that of shorter paths", time, least=1.0))
    values = {test.name.split(" over")[0]: test.interval.value for test in tests}
    return Finding(
        tuple(tests),
        () if len(tests) > 1 else (_NO_TIMES,),
        plot_data=PlotData.bars(values, "over that of shorter paths"),
        few="renders on a quiet machine",
    )


# --- integrators ----------------------------------------------------------------------------------

_SLOWEST, _FASTEST = "time until averages are Gaussian", "samples until averages are Gaussian"
_DIFFERENT = 0.02
"""Cramér distance, root of its mean square over pixels, from which shapes are different.

Two log-normal CHDs are this far apart if the spread of one is a tenth larger, at a third of a
decade. It then needs a fifth more samples for the same error in the logarithm. A test with enough
samples would find smaller differences, too, but they do not matter in practice.
"""


@claim(
    29,
    "integrators",
    "CHDs depend on how paths are sampled; where lights are sampled, too, averages are "
    "Gaussian sooner, at equal time, than where surfaces alone are.",
    paired=True,
    once=True,
)
def integrators(data: SceneData) -> Finding:
    """Compare the shapes of integrators, and the time until their averages are Gaussian."""
    require(
        data.integrators,
        "the same scene by other integrators, as a study does with integrators=True",
    )
    sizes = {samples.shape[:3] for samples in data.integrators.values()}
    require(sizes == {data.samples.shape[:3]}, "other integrators in the same size")
    renders = {"": data.samples, **data.integrators}
    # Sample skewness grows with the number of samples: each integrator has as many.
    least = min(samples.spp for samples in renders.values())
    summaries = {
        name: summarize(s if s.spp == least else s.isel(sample=slice(0, least)))
        for name, s in renders.items()
    }
    pairs = {
        name: DIRECT if name.startswith("direct light") and DIRECT in renders else ""
        for name in data.integrators
        if name != DIRECT
    }
    whole = data.whole(tests=2)
    together = replace(whole, level=1 - (1 - whole.level) / max(len(pairs), 1))
    distances, sooner, fewer = list[Interval[float]](), {}, {}
    for name, base in pairs.items():
        both = summaries[name], summaries[base]
        distances.append(together.mean(squares(*both)).root())
        fewer[name] = samples_ratio(*both, whole)
        seconds = [_seconds_per_sample(renders[n]) for n in (name, base)]
        if seconds[0] and seconds[1]:
            log, by = fewer[name], math.log10(seconds[0] / seconds[1])
            room = math.log10(TIMING)
            low, high = log.low + by - room, log.high + by + room
            sooner[name] = Interval(log.value + by, low, high, log.level)
    needed = "positive samples enough for shapes"
    largest = largest_interval(distances, needed, level=whole.level)
    name = "largest distance between the shapes of two integrators"
    tests, missing = [ClaimTest(name, largest, least=_DIFFERENT, unit="decade^1/2")], list[str]()
    if BSDF_SAMPLING not in pairs:
        missing.append("needs lights that sampling BSDFs can find")
    elif BSDF_SAMPLING not in sooner:
        missing.append(_NO_TIMES)
    else:
        name = f"log {_SLOWEST}, {BSDF_SAMPLING} over lights, too"
        tests.append(ClaimTest(name, sooner[BSDF_SAMPLING], least=0.0, unit="decade"))
    bars = {name: i.value for name, i in (sooner or fewer).items()}
    return Finding(
        tuple(tests),
        tuple(missing),
        plot_data=PlotData.bars(bars, f"decades of {_SLOWEST if sooner else _FASTEST}"),
        few="renders on a quiet machine",
    )


def samples_ratio(one: xr.Dataset, two: xr.Dataset, whole: PixelSet) -> Interval[float]:
    """Return the median log ratio of the samples that averages need to be Gaussian."""
    log = [logs(np.abs(d["skewness"].to_numpy().astype(np.float64))) for d in (one, two)]
    return whole.median((2 * (log[0] - log[1])).reshape(len(whole), -1))


# --- correlated samples ---------------------------------------------------------------------------

_SEQUENCES = 8
"""Fewest sequences for a variance of averages."""
_SHUFFLES = 999


@claim(
    17,
    "correlated samples",
    "The average of samples that a sampler spreads over the pixel varies no more than that of "
    "as many independent samples.",
    spp=32,
    paired=True,
    once=True,
)
def correlated(data: SceneData) -> Finding:
    """Compare the variance of averages of spread samples with that of as many independent ones."""
    spread = required(
        data.spread,
        "the same scene rendered by a sampler that spreads samples, as a study does with sampler=",
    )
    length = sequence_of(spread.attrs)
    require(length > 1, "samples in sequences, which are marked by attrs['sequence']")
    count = spread.spp // length
    require(count >= _SEQUENCES, f"{_SEQUENCES} sequences of {length} samples, has {count}")
    require(spread.shape[:3] == data.samples.shape[:3], "spread samples in the same size")
    found, whole = variances(spread), data.whole()

    def ratio_in(pixels: PixelSet) -> Interval[float]:
        of_means, single = found[:, pixels.y * data.samples.shape[1] + pixels.x]
        return pixels.ratio(of_means, single, (0.0, np.inf))

    ratio = ratio_in(whole)
    by_region = {
        region.name: ratio_in(PixelSet.of((region,), *data.samples.shape[:2])).value
        for region in data.regions
    }
    first, some = spread.isel(sample=slice(min(count, 32) * length)), data.scattered(512)
    x = SceneData(data.name, first).light(some)
    sampler = spread.attrs.get("sampler", "spreading")
    name = f"variance of an average of {length} over that of independent samples ({sampler})"
    return Finding(
        (ClaimTest(name, ratio, most=1.0),),
        p_value=p_of_independence(x.reshape(len(some), -1, length)),
        null_hypothesis="samples of a sequence are independent in every pixel (shuffled within "
        "pixels, alike in all)",
        plot_data=PlotData.bars({"image": ratio.value, **by_region}, "ratio of variances"),
        few="sequences",
    )


def variances(spread: Samples) -> Floats:
    """Return variances of the luminance of a pixel, relative to its squared mean.

    Let B be n times the variance of averages of n samples, and W the variance within sequences.
    Then (B + (n - 1) W) / n is an unbiased variance of a single sample, whatever the correlation;
    for independent samples, B is, too. A firefly adds equally to both.

    Parameters
    ----------
    spread
        Samples in sequences.

    Returns
    -------
    ndarray
        B and the variance of a single sample, shape (2, pixel); NaN in pixels with a bad sample.

    Examples
    --------
    >>> x = np.random.default_rng(0).random((4, 4, 1, 4096))
    >>> averages, single = variances(Samples.from_array(x, sequence=16)).mean(axis=1)
    >>> bool(abs(averages / single - 1) < 0.1)
    True
    """
    length = sequence_of(spread.attrs)
    count = spread.spp // length
    height, width = spread.shape[:2]
    of_means, single, mean = np.empty((3, height, width))
    for ys, xs in tiles(spread.shape):
        x = _sequences(spread.read(ys, xs, slice(0, count * length)), length)
        with np.errstate(invalid="ignore", over="ignore"):
            means = x.mean(axis=-1)
            mean[ys, xs] = means.mean(axis=-1)
            of_means[ys, xs] = length * means.var(axis=-1, ddof=1)
            within = x.var(axis=-1, ddof=1).mean(axis=-1)
        single[ys, xs] = (of_means[ys, xs] + (length - 1) * within) / length
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        found = np.stack([of_means, single]) / relative_scale(mean)
    return np.where(np.isfinite(found), found, np.nan).reshape(2, -1)


def p_of_independence(x: Floats) -> float | None:
    """Return the p-value that samples of a sequence are independent, from both sides.

    Independent samples may be grouped into sequences in any order. So the variance of the averages
    is compared with that of shuffled samples. All pixels are shuffled in the same way, so that the
    p-value is exact, with any tail and with nulls.

    Parameters
    ----------
    x
        Samples, shape (pixel, sequence, sample).

    Returns
    -------
    float
        p-value of the sum, over pixels, of the ratios of both variances. Pixels whose samples are
        all equal, or of which one is bad, do not count; None without others.

    References
    ----------
    Phipson and Smyth, "Permutation p-values should never be zero", 2010,
    doi:10.2202/1544-6115.1585.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> strata = rng.permuted(np.tile(np.arange(16), (2, 8, 1)), axis=-1)
    >>> p_of_independence(strata / 16), p_of_independence(rng.random((2, 8, 16))) > 0.01
    (0.002, True)
    """
    rng, flat = generator(0), x.reshape(len(x), -1)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        flat = flat - flat.mean(axis=1, keepdims=True)
        flat = flat / np.abs(flat).max(axis=1, keepdims=True, initial=0)  # no square is too large
        flat = flat / np.sqrt((flat**2).sum(axis=1, keepdims=True))
    known = np.isfinite(flat).all(axis=1)
    if not known.any():
        return None
    flat, shape = flat[known], x[known].shape

    def spread_of(values: Floats) -> float:
        return float((values.reshape(shape).sum(axis=-1) ** 2).sum())

    own = spread_of(flat)
    orders = (rng.permutation(flat.shape[1]) for _ in range(_SHUFFLES))
    others = np.array([spread_of(flat[:, order]) for order in orders])
    room = 1e-9 * max(own, 1)
    lower, higher = np.count_nonzero([others <= own + room, others >= own - room], axis=1)
    return min(2 * (1 + int(min(lower, higher))) / (_SHUFFLES + 1), 1.0)


def _sequences(block: Image, length: int) -> Floats:
    """Return the luminance of samples (..., channel, sample) by sequence; bad ones are NaN."""
    with np.errstate(invalid="ignore", over="ignore"):
        light = np.asarray(luminance(block.astype(np.float64)))
    light[is_bad(block).any(axis=-2)] = np.nan
    return light.reshape(*light.shape[:-1], -1, length)


# --- complexity of scenes -------------------------------------------------------------------------

# Modes are counted among equally many samples everywhere: with more samples, more modes are found.
_SCENES = 5
"""Scenes that a rank correlation needs: of fewer, even perfect order has p above 1/100."""
_MODES_PIXELS = 1024
"""in that many pixels of a scene."""
_TURN, _STEP, _PAINT = 0.9, 0.1, 0.1
"""Cosine between normals, difference of log depth, and of albedo, from which surfaces differ."""


@claim(
    11,
    "complexity",
    "CHDs have more modes in more complex scenes.",
    across=True,
)
def complexity(scenes: Sequence[SceneData]) -> Finding:
    """Correlate the mean number of modes of the scenes with their complexity."""
    require(len(scenes) >= _SCENES, f"{_SCENES} scenes to rank, there are {len(scenes)}")
    complexity = np.array([scene_complexity(data) for data in scenes])
    n, counted = common_count(scenes, least=64), list[float]()
    for data in scenes:
        count = modality(drawn(data, n, pixels=_MODES_PIXELS)[0]).modes
        counted.append(float(count[count > 0].mean()) if count.any() else math.nan)
    modes = np.array(counted)
    known = np.isfinite(complexity + modes)
    enough = np.count_nonzero(known) >= _SCENES
    require(enough, f"first-hit features or a complexity of {_SCENES} scenes")
    correlation, p_value = rank_correlation(complexity[known], modes[known])
    points = {data.name: (complexity[[i]], modes[[i]]) for i, data in enumerate(scenes)}
    return Finding(
        (ClaimTest("rank correlation of modes with scene complexity", correlation, least=0.0),),
        p_value=p_value,
        null_hypothesis="modes and complexity have no common order (one-sided)",
        plot_data=PlotData("points", points, "complexity of the scene", "mean number of modes"),
        few="scenes",
    )


def scene_complexity(data: SceneData) -> float:
    """Return the given complexity, or the share of neighbours that see different surfaces.

    It is 0 for a bare wall and near 1 for foliage. NaN without features.
    """
    if data.complexity is not None:
        return float(data.complexity)
    normal, depth, albedo = (data.feature(name) for name in ("normal", "depth", "albedo"))
    if normal is None or depth is None or albedo is None:
        return math.nan
    differ = []
    for one, two in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        turned = (normal[one] * normal[two]).sum(axis=-1) < _TURN
        behind = np.abs(data.log_depth[one] - data.log_depth[two]) > _STEP
        painted = np.abs(albedo[one] - albedo[two]).max(axis=-1) > _PAINT
        differ.append((turned | behind | painted).ravel())
    return known_mean(np.concatenate(differ))


def rank_correlation(x: Floats, y: Floats) -> tuple[Interval[float], float]:
    """Return Spearman's correlation with its interval, and its one-sided p-value.

    The interval is that of Fisher's z, of variance (1 + r^2 / 2) / (n - 3); p is of 9999 random
    permutations, or of all where there are fewer.

    References
    ----------
    Bonett and Wright, "Sample size requirements for estimating Pearson, Kendall and Spearman
    correlations", 2000, doi:10.1007/BF02294183.

    Examples
    --------
    >>> correlation, p = rank_correlation(np.arange(9.0), np.arange(9.0) ** 2)
    >>> correlation.value, correlation.low > 0.9, p < 0.001
    (1.0, True, True)
    """
    a, b = (stats.rankdata(v) for v in (x, y))
    if not np.ptp(a) or not np.ptp(b):
        return Interval.unknown(), 1.0
    r = float(np.corrcoef(a, b)[0, 1])
    # Perfect order has an infinite z; a little less than one swap of ranks is its resolution.
    z = math.atanh(float(np.clip(r, -1 + 1e-3, 1 - 1e-3)))
    half = stats.norm.ppf((1 + LEVEL) / 2) * math.sqrt((1 + r**2 / 2) / (len(x) - 3))
    orders = stats.PermutationMethod(n_resamples=9999, random_state=generator(0))
    p = stats.pearsonr(a, b, alternative="greater", method=orders).pvalue
    return Interval(round(r, 12), math.tanh(z - half), math.tanh(z + half)), float(p)


# --- shapes of scenes -----------------------------------------------------------------------------

_NULL = "both integrators give each pixel a CHD of the same shape (permutations within pixels)"
_FOLDS = 4
_ACROSS = 4
_LEAST = 64


@claim(
    12,
    "scene-specific shapes",
    "Shapes of CHDs are specific to the scene, and depend on the integrator.",
    across=True,
)
def scenes(scenes: Sequence[SceneData]) -> Finding:
    """Classify scenes by shapes, and compare shapes of integrators pixel by pixel."""
    level, tests, missing = level_of(2), list[ClaimTest](), list[str]()
    n = common_count(scenes, least=SHAPE_NEEDS)
    shapes = [_shapes(data, n) for data in scenes]
    if len(scenes) < 2:
        missing.append("needs a second scene")
    elif min(len(of_scene) for of_scene, _ in shapes) < _LEAST:
        missing.append(f"needs {_LEAST} pixels of each scene with {n} positive samples")
    else:
        accuracy = _scene_accuracy(shapes, level)
        least = (1 + 1 / len(scenes)) / 2
        tests.append(ClaimTest("accuracy of telling scenes apart", accuracy, least=least))
    p_value = None
    if changed := [data for data in scenes if data.integrator or data.shorter]:
        squared = [(data, v) for data in changed if (v := _squares(data)) is not None]
        distance = Interval.unknown(level=level)
        if squared:
            blocks = Blocks.join([data.whole().blocks for data, _ in squared])
            every = np.concatenate([values for _, values in squared])
            distance = mean_of(every, blocks, level=level).root()
        name = "distance between the shapes of two integrators"
        tests.append(ClaimTest(name, distance, least=_DIFFERENT, unit="decade^1/2"))
        p = permuted([values for _, values in squared])
        p_value = None if math.isnan(p) else p
    else:
        missing.append("needs a scene rendered by another integrator, or with shorter paths")
    means = {
        data.name: of_scene.mean(axis=0)
        for data, (of_scene, _) in zip(scenes, shapes, strict=True)
        if len(of_scene)
    }
    about: Any = {"null_hypothesis": _NULL if changed else "", "plot_data": shape_plot(means)}
    return Finding(tuple(tests), tuple(missing), p_value, **about)


def _scene_accuracy(scenes: Sequence[tuple[Floats, Blocks]], level: float) -> Interval[float]:
    """Return the accuracy of a classifier of shapes.

    For each scene, there are shapes (pixel, edge) and the blocks of its pixels.

    Extremely randomised trees (Geurts, Ernst and Wehenkel 2006, doi:10.1007/s10994-006-6226-1) see
    shapes without place or scale, each of as many positive samples: of more, a shape is smoother,
    which would tell of nulls and spp. Each image is cut into 16 blocks; a quarter of
    them is held out at a time, as neighbours resemble each other (Roberts et al. 2017,
    doi:10.1111/ecog.02881). Every scene has the same weight.

    Half-way between chance and certainty, the claim's border, is a choice of ours.
    """
    from sklearn.ensemble import ExtraTreesClassifier
    from sklearn.model_selection import PredefinedSplit, cross_val_predict

    shapes, blocks = zip(*scenes, strict=True)
    x = np.concatenate(shapes)
    scene = np.repeat(np.arange(len(shapes)), [len(s) for s in shapes])
    fold = np.concatenate([fold_of(b, across=_ACROSS, folds=_FOLDS) for b in blocks])
    trees = ExtraTreesClassifier(30, min_samples_leaf=3, class_weight="balanced", random_state=0)
    predicted = cross_val_predict(trees, x, scene, cv=PredefinedSplit(fold))
    joined = Blocks.join([b[:] for b in blocks])  # without blocks that have no pixel
    hits = means_by_region((predicted == scene).astype(float), joined)
    return interval_of(lambda w: hits(w).mean(axis=1), joined, level=level, bounds=(0.0, 1.0))


def _shapes(data: SceneData, n: int) -> tuple[Floats, Blocks]:
    """Return shapes of `n` samples, shape (pixel, edge), and the blocks that the pixels lie in."""
    x, blocks = drawn(data, n, pixels=1500, across=_ACROSS)
    chds = aligned(x)
    # Blocks keep their numbers, which say where they lie.
    return chds.whole[chds.known], Blocks(blocks.of_pixel[chds.known], blocks.region)


def _squares(data: SceneData) -> Floats | None:
    """Return squared distances to the other render of the view; None where sizes differ."""
    other = data.integrator or data.shorter
    if other is None or other.shape[:2] != data.samples.shape[:2]:
        return None
    if data.samples.shares_numbers_with(other):
        return squares_of_pairs(data.samples, other)
    theirs = data.shorter_summary if other is data.shorter else None
    if theirs is None:
        theirs = summarize(other)
    return squares(data.summary, theirs)
