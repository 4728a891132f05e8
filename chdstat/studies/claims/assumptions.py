"""Assumptions that denoisers make about noise and radiance, tested (finding 13).

The paper holds that four of them fail: that noise is spatially uniform and additive, that averages
are Gaussian, that variance follows feature buffers, that radiance is regular.

`uniformity` tests whether the noise of pixels has one variance. `explained_by_features` measures
how much of the variance map first-hit features predict. `growing` and `with_room` allow for samples
that are missing: skewness and kurtosis rest on the rare bright samples of a tail, most of which a
pixel has not seen. Both are too small, and grow with the number of samples, so that it is safe to
say that they lie above a limit, but not that they lie below one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._core.arrays import generator, luminance
from chdstat._core.moments import Moments
from chdstat._core.resampling import Blocks, Interval, holm, interval_of, median_of
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData, fold_of, logs, slope_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "AVERAGED",
    "IRREGULAR",
    "MULTIPLICATIVE",
    "SKEWED",
    "UNEXPLAINED",
    "Explained",
    "explained_by_features",
    "growing",
    "measure",
    "uniformity",
    "with_room",
]

Floats = npt.NDArray[np.float64]

_FOLDS = 4
_ACROSS = 8
_FEATURES = ("albedo", "normal", "depth")
_ROUNDS = 60
_RELIABLE = 0.2
"""Share of the variation that must repeat between halves of the samples, to be explained at all."""


@dataclass(frozen=True)
class Explained:
    """What features explain of log variance.

    Attributes
    ----------
    share
        Cross-validated R^2 over the share that is not noise; below 0 where features mislead.
    reliability
        That share: correlation between two halves of the samples, stepped up to all of them.
    """

    share: Interval[float]
    reliability: float


def explained_by_features(data: SceneData, batches: Floats, *, level: float) -> Explained | None:
    """Predict log variance from albedo, normal and depth in blocks that are held out.

    Parameters
    ----------
    data
        With the features; None is returned without them.
    batches
        Means of batches, shape (pixel, batch).
    level
        Coverage of the interval.

    References
    ----------
    Roberts et al., "Cross-validation strategies for data with temporal, spatial, hierarchical, or
    phylogenetic structure", 2017, doi:10.1111/ecog.02881: blocks. Spearman, "The proof and
    measurement of association between two things", 1904, doi:10.2307/1412159: attenuation. Ke et
    al., "LightGBM", 2017: the boosted trees that scikit-learn follows.
    """
    features = _features(data)
    if features is None:
        return None
    halves = [_log_variance(batches[:, i::2]) for i in (0, 1)]
    target = (halves[0] + halves[1]) / 2
    known = np.isfinite(target) & np.isfinite(features).all(axis=1)
    if np.count_nonzero(known) < 100 or not np.ptp(target[known]):
        return Explained(Interval.unknown(level=level), float("nan"))
    r = float(np.corrcoef(halves[0][known], halves[1][known])[0, 1])
    reliability = 2 * r / (1 + r)
    if not reliability > _RELIABLE:
        return Explained(Interval.unknown(level=level), reliability)
    whole = data.whole(across=_ACROSS).blocks
    fold = fold_of(whole, across=_ACROSS, folds=_FOLDS)[known]
    y, blocks = target[known], whole[known]
    left, right = _errors(features[known], y, fold)
    error, total = blocks.sums(left), blocks.sums(right)
    share = interval_of(
        lambda w: (1 - (w @ error) / (w @ total)) / reliability, blocks, level=level
    )
    return Explained(share, reliability)


def _features(data: SceneData) -> Floats | None:
    found = [data.feature(name) for name in _FEATURES]
    if any(f is None for f in found):
        return None
    columns = [f.reshape(len(data.whole()), -1) for f in found if f is not None]
    return np.concatenate(columns, axis=1)


def _log_variance(batches: Floats) -> Floats:
    with np.errstate(divide="ignore"):
        logs = np.log(batches.var(axis=1, ddof=1))
    return np.asarray(np.where(np.isfinite(logs), logs, np.nan))


def _errors(x: Floats, y: Floats, fold: npt.NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return squared errors of predictions, and those of the mean of the same training pixels."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    left, right = np.zeros_like(y), np.zeros_like(y)
    for k in range(_FOLDS):
        if (held := fold == k).any():
            model = HistGradientBoostingRegressor(
                max_iter=_ROUNDS, min_samples_leaf=20, early_stopping=False, random_state=0
            )
            guess = model.fit(x[~held], y[~held]).predict(x[held])
            left[held], right[held] = (y[held] - guess) ** 2, (y[held] - y[~held].mean()) ** 2
    return left, right


Growing = tuple[Floats, Floats, Floats]

_SLOWEST = 0.8
"""Ratio of successive gains that is believed, at least: with gamma and log-normal samples it lies
between 0.6 and 0.9, and smaller where noise makes it so."""
_REACH = 2.0
"""Standard errors up to which a gain may be noise."""


def growing(
    x: npt.NDArray[np.floating], good: npt.NDArray[np.bool_], statistic: Callable[[Moments], Floats]
) -> Growing:
    """Return a moment of quarters, of halves and of all of the samples.

    Parameters
    ----------
    x, good
        Samples, shape (pixel, ..., sample), and those that count.
    statistic
        Reads it off the moments.

    Returns
    -------
    tuple
        Shapes (4 pixel, ...), (2 pixel, ...) and (pixel, ...).
    """
    quarters = [Moments.of(x[..., i::4], good[..., i::4]) for i in range(4)]
    halves = [quarters[0].merge(quarters[2]), quarters[1].merge(quarters[3])]
    levels = (quarters, halves, [reduce(Moments.merge, halves)])
    first, second, third = (np.concatenate([statistic(m) for m in level]) for level in levels)
    return first, second, third


def with_room(found: Interval[float], grown: Growing) -> Interval[float]:
    """Return a median over pixels with room above for the samples that are missing.

    Of a quarter, half and all of the samples, the median gains d1 and then d2. If each doubling
    gains d2 / d1 = r of the one before, all that are to come gain d2 r / (1 - r): Aitken's
    extrapolation ("On Bernoulli's numerical solution of algebraic equations", 1926,
    doi:10.1017/S0370164600022070). Where gains do not shrink, there is no upper end. The noise of
    the median counts as a gain, too.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.lognormal(0, 0.75, size=(2000, 384))
    >>> grown = growing(x, x > 0, lambda moments: moments.skewness)
    >>> found = with_room(Interval(np.median(grown[-1]), 2.6, 2.7, 0.95), grown)
    >>> found.high > 3.26 > 2.7  # the skewness of that distribution
    True
    """
    quarter, half, whole = (_median(values) for values in grown)
    before, gain = half - quarter, whole - half
    if not math.isfinite(before + gain):
        return found
    noise = _REACH * _error(grown[-1])
    ratio = _SLOWEST
    if gain > noise:
        ratio = max(gain / before, ratio) if before > 0 else math.inf
    room = (max(gain, 0.0) + noise) * ratio / (1 - ratio) if ratio < 1 else math.inf
    return replace(found, high=found.high + room)


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def _error(values: Floats) -> float:
    """Return the standard error of the median of independent normal values, shape (pixel, ...)."""
    known = values[np.isfinite(values)]
    deviation = stats.median_abs_deviation(known, scale="normal")
    return float(deviation * math.sqrt(math.pi / 2 / len(values)))


_TINY = float(np.finfo(np.float64).tiny)
"""What underflows is no proof: p-values are never 0."""


def uniformity(batches: Floats, blocks: Blocks) -> dict[str, float]:
    """Return p-values of equal variance, Holm-adjusted, from one batch of each pixel.

    Parameters
    ----------
    batches
        Means of batches, shape (pixel, batch). The noise of the last one, its distance from the
        mean of the others, is what is tested: pixels are rendered independently.
    blocks
        Groups of pixels for Levene's test.

    Returns
    -------
    dict
        ``breusch_pagan``: variance does not depend on log mean (Breusch and Pagan 1979,
        doi:10.2307/1911963, without normality: Koenker 1981, doi:10.1016/0304-4076(81)90062-2).
        ``levene``: variance is the same in all blocks, around medians (Brown and Forsythe 1974,
        doi:10.1080/01621459.1974.10482955). NaN where there is nothing to test.
    """
    rest = batches[:, :-1].mean(axis=1)
    noise = batches[:, -1] - rest
    known = np.isfinite(noise) & (rest > 0)
    noise, level, block = noise[known], np.log(rest[known]), blocks.of_pixel[known]
    p = {"breusch_pagan": _breusch_pagan(noise, level), "levene": _levene(noise, block)}
    return dict(zip(p, holm(np.array(list(p.values()))).tolist(), strict=True))


def _breusch_pagan(noise: Floats, level: Floats) -> float:
    from statsmodels.stats.diagnostic import het_breuschpagan

    if len(noise) < 3 or not np.ptp(level) or not np.ptp(noise):
        return float("nan")
    # A scale of 1 keeps fourth powers within range.
    _, p, _, _ = het_breuschpagan(
        noise / np.abs(noise).max(), np.stack([np.ones_like(level), level], axis=1), robust=True
    )
    return max(float(p), _TINY)


def _levene(noise: Floats, block: npt.NDArray[np.int64]) -> float:
    groups = [noise[block == i] for i in np.unique(block)]
    groups = [group for group in groups if len(group) > 2]
    if len(groups) < 2 or not np.ptp(noise):
        return float("nan")
    return max(float(stats.levene(*groups, center="median").pvalue), _TINY)


MULTIPLICATIVE = 1.0
"""Slope of log variance on log mean: 0 for additive noise, 2 for multiplicative; half way."""
AVERAGED = 32
"""Samples of an average, as many as the paper's model sees."""
SKEWED = 0.5
"""Skewness of averages from which they are not even fairly symmetric (Bulmer, "Principles of
Statistics", 1979, page 63)."""
UNEXPLAINED = 0.5
"""Share of the variation of log variance that features explain, up to which most is left."""
IRREGULAR = 0.5
"""Share of all squared steps of log radiance that the largest steps hold:"""
STEPS = 0.05
"""share of the steps that are the largest; of Gaussian steps, they would hold 0.28."""
_GROWING = 1024
"""Pixels that are asked how much skewness grows with the number of samples."""
LEAST = 12
"""Batches of samples that the parts of the data need."""
_PARTS = 4


@dataclass(frozen=True)
class _BatchMeans:
    """Luminance of batch means, shape (pixel, batch), split into parts that share no sample."""

    values: Floats
    height: int

    @classmethod
    def of(cls, data: SceneData) -> _BatchMeans:
        means = data.summary["batch_means"].to_numpy().astype(np.float64)
        light = luminance(means).astype(np.float64)
        return cls(light.reshape(-1, light.shape[-1]), light.shape[0])

    def part(self, start: int, step: int) -> Floats:
        return self.values[:, start::step]


def measure(data: SceneData) -> Outcome:
    """Test the four assumptions; each part says that one fails."""
    batches = _BatchMeans.of(data)
    if batches.values.shape[1] < LEAST:
        return Outcome(missing=(f"needs {LEAST * 32} spp, has {data.samples.spp}",))
    blocks, level = data.whole().blocks, level_of(_PARTS)
    tests = uniformity(batches.values, blocks)
    explained = explained_by_features(data, batches.values, level=level)
    parts = _of_samples(data, batches, blocks, level)
    missing = ("needs first-hit albedo, normal and depth",) if explained is None else ()
    if explained is not None:
        name = "share of log variance that features explain"
        parts = (*parts, ClaimTest.of(name, explained.share, most=UNEXPLAINED))
    return Outcome(
        parts,
        missing,
        p_value=tests["breusch_pagan"],
        details={
            **tests,
            "null_hypothesis": "variance is uniform over the image (Breusch-Pagan, Holm-adjusted)",
            "reliability_of_log_variance": explained.reliability if explained else None,
            "averages_told_from_gaussian": _told(data.summary),
        },
        plot_data=_plot_data(batches),
    )


def _of_samples(
    data: SceneData, batches: _BatchMeans, blocks: Blocks, level: float
) -> tuple[ClaimTest, ...]:
    """Return the parts that need nothing but samples."""
    return (
        ClaimTest.of(
            "slope of log variance on log mean",
            _slope(batches, blocks, level),
            least=MULTIPLICATIVE,
        ),
        ClaimTest.of(
            f"skewness of averages of {AVERAGED}",
            _skewness(data, blocks, level),
            least=SKEWED,
        ),
        ClaimTest.of(
            f"share of squared steps of log radiance in the largest {STEPS:.0%}",
            _concentration(batches, blocks, level),
            least=IRREGULAR,
        ),
    )


def _skewness(data: SceneData, blocks: Blocks, level: float) -> Interval[float]:
    """Return the median skewness of averages; how it grows is asked of some pixels."""

    def of_averages(moments: Moments) -> Floats:
        return np.asarray(moments.skewness / np.sqrt(AVERAGED))

    skewness = data.summary["skewness"].to_numpy() / np.sqrt(AVERAGED)
    found = median_of(skewness.reshape(-1, skewness.shape[-1]), blocks, level=level)
    some = (data.radiance(patch) for patch in data.scattered(_GROWING))
    parts = [growing(np.nan_to_num(x), np.isfinite(x), of_averages) for x in some]
    quarter, half, whole = (np.concatenate(values) for values in zip(*parts, strict=True))
    return with_room(found, (quarter, half, whole))


def _told(summary: xr.Dataset) -> dict[int, float] | None:
    """Return, by N, the share of pixel channels whose averages of N are not Gaussian."""
    if "averages_rejected_share" not in summary:
        return None
    shares = summary["averages_rejected_share"].mean("channel")
    return dict(zip(shares["size"].to_numpy().tolist(), shares.to_numpy().tolist(), strict=True))


def _slope(batches: _BatchMeans, blocks: Blocks, level: float) -> Interval[float]:
    """Return the slope of log variance on log mean, with an instrument against noisy means.

    Variance, mean and instrument are of different samples, so that their noise has nothing in
    common.
    """
    y = logs(batches.part(0, 2).var(axis=1, ddof=1))
    x, z = (logs(batches.part(i, 4).mean(axis=1)) for i in (1, 3))
    return slope_of(x, y, blocks, instrument=z, level=level)


def _concentration(batches: _BatchMeans, blocks: Blocks, level: float) -> Interval[float]:
    """Return the share of squared steps to the right-hand neighbour in the largest steps.

    A third of the samples says which steps are large; the product of the steps of the two other
    thirds is their square without noise. A uniform image has no steps at all, and no interval.
    """
    thirds = [logs(batches.part(i, 3).mean(axis=1)).reshape(batches.height, -1) for i in range(3)]
    steps = [np.pad(np.diff(t, axis=1), ((0, 0), (0, 1)), constant_values=np.nan) for t in thirds]
    chosen, one, two = (s.ravel() for s in steps)
    known = np.isfinite(chosen + one + two)
    if not known.any():
        return Interval.unknown(level=level)
    kept, square = blocks[known], (one * two)[known]
    size = np.abs(chosen[known])
    # Of equal steps, chance decides which are the largest.
    order = np.lexsort((generator(0).random(len(size)), size))
    large = np.zeros(len(size), dtype=bool)
    large[order[len(size) - max(1, round(STEPS * len(size))) :]] = True
    above, below = kept.sums(np.where(large, square, 0)), kept.sums(square)
    return interval_of(lambda w: (w @ above) / (w @ below), kept, level=level)


def _plot_data(batches: _BatchMeans) -> PlotData:
    mean, variance = logs(batches.values.mean(axis=1)), logs(batches.values.var(axis=1, ddof=1))
    return PlotData(
        "points", {"pixels": (mean, variance)}, "log10 mean", "log10 variance of a mean"
    )
