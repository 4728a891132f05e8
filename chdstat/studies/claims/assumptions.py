"""Assumptions that denoisers make about noise and radiance, tested (claim 13).

The paper claims that four of them fail: noise is spatially uniform and additive, averages are
Gaussian, variance follows feature buffers, and radiance is regular.

`p_of_uniform_noise` tests whether the noise of pixels has one variance. `explained_by_features`
measures how much of the variance map first-hit features predict. `growing` and `with_room` allow
for missing samples: skewness and kurtosis depend on the rare bright samples of a tail, most of
which a pixel has not seen. Both are underestimated and grow with the number of samples. So it is
safe to say that they lie above a limit, but not below one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import reduce

import numpy as np
from scipy import stats

from chdstat._core.arrays import Floats, Mask, Reals, generator
from chdstat._core.moments import Moments
from chdstat._core.resampling import Interval
from chdstat.inference.findings import ClaimTest, Finding, PlotData, require
from chdstat.studies.claim import claim
from chdstat.studies.scene_data import PixelSet, SceneData, fold_of, logs

_FOLDS = 4
_ACROSS = 8


def explained_by_features(
    data: SceneData, batches: Floats, whole: PixelSet
) -> Interval[float] | None:
    """Predict log variance from albedo, normal and depth in blocks that are held out.

    Parameters
    ----------
    data
        Scene with features; None is returned without them.
    batches
        Means of batches, shape (pixel, batch).
    whole
        All pixels, in 8 x 8 blocks.

    Returns
    -------
    Interval
        Cross-validated R^2 divided by the share that is not noise, below 0 if features mislead.
        That share follows from the correlation between two halves of the samples, corrected to all
        samples.

    References
    ----------
    Roberts et al., "Cross-validation strategies for data with temporal, spatial, hierarchical, or
    phylogenetic structure", 2017, doi:10.1111/ecog.02881: blocks. Spearman, "The proof and
    measurement of association between two things", 1904, doi:10.2307/1412159: attenuation. Ke et
    al., "LightGBM", 2017: the boosted trees that scikit-learn follows.
    """
    from sklearn.dummy import DummyRegressor
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.model_selection import PredefinedSplit, cross_val_predict

    images = [data.feature(name) for name in ("albedo", "normal", "depth")]
    columns = [image.reshape(len(batches), -1) for image in images if image is not None]
    if len(columns) < len(images):
        return None
    features = np.concatenate(columns, axis=1)
    with np.errstate(divide="ignore"):
        halves = np.log([batches[:, i::2].var(axis=1, ddof=1) for i in (0, 1)])
    halves[~np.isfinite(halves)] = np.nan
    target = (halves[0] + halves[1]) / 2
    known = np.isfinite(target) & np.isfinite(features).all(axis=1)
    x, y = features[known], target[known]
    if len(y) < 100 or not np.ptp(y):
        return Interval.unknown(level=whole.level)
    r = float(np.corrcoef(halves[0][known], halves[1][known])[0, 1])
    reliability = 2 * r / (1 + r)
    if not reliability > 0.2:
        return Interval.unknown(level=whole.level)
    folds = PredefinedSplit(fold_of(whole.blocks, across=_ACROSS, folds=_FOLDS)[known])
    trees = HistGradientBoostingRegressor(
        max_iter=60, min_samples_leaf=20, early_stopping=False, random_state=0
    )
    errors, of_mean = (
        (y - cross_val_predict(model, x, y, cv=folds)) ** 2 for model in (trees, DummyRegressor())
    )
    used = whole[known]
    error, total = used.blocks.sums(errors), used.blocks.sums(of_mean)
    return used.interval(lambda w: (1 - (w @ error) / (w @ total)) / reliability)


_Growing = tuple[Floats, Floats, Floats]

_SLOWEST = 0.8
"""Smallest assumed ratio of successive gains: for gamma and log-normal samples it lies between 0.6
and 0.9; noise may make it smaller."""


def growing(x: Reals, good: Mask, statistic: Callable[[Moments], Floats]) -> _Growing:
    """Return a moment of the quarters, of the halves and of all samples.

    Parameters
    ----------
    x, good
        Samples, shape (pixel, ..., sample), and a mask of those that count.
    statistic
        Computes the statistic from the moments.

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


def with_room(median: Interval[float], grown: _Growing) -> Interval[float]:
    """Return a median over pixels, with the upper end raised for missing samples.

    From a quarter to half of the samples the median gains d1, and from half to all it gains d2. If
    each doubling gains r = d2 / d1 times the gain before, all further doublings gain d2 r / (1 -
    r): Aitken's extrapolation ("On Bernoulli's numerical solution of algebraic equations", 1926,
    doi:10.1017/S0370164600022070). If gains do not shrink, there is no upper end. The noise of the
    median counts as a gain, too.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.lognormal(0, 0.75, size=(2000, 384))
    >>> grown = growing(x, x > 0, lambda moments: moments.skewness)
    >>> median = with_room(Interval(np.median(grown[-1]), 2.6, 2.7, 0.95), grown)
    >>> median.high > 3.26 > 2.7  # the skewness of that distribution
    True
    """
    quarter, half, whole = (_median(values) for values in grown)
    before, gain = half - quarter, whole - half
    if not math.isfinite(before + gain):
        return median
    # The standard error of the median of independent normal values.
    known = grown[-1][np.isfinite(grown[-1])]
    deviation = stats.median_abs_deviation(known, scale="normal")
    noise = 2.0 * float(deviation * math.sqrt(math.pi / 2 / len(grown[-1])))
    ratio = _SLOWEST
    if gain > noise:
        ratio = max(gain / before, ratio) if before > 0 else math.inf
    room = (max(gain, 0.0) + noise) * ratio / (1 - ratio) if ratio < 1 else math.inf
    return replace(median, high=median.high + room)


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


_TINY = float(np.finfo(np.float64).tiny)
"""Smallest p-value: an underflow does not make it 0."""


def p_of_uniform_noise(batches: Floats) -> float | None:
    """Return the p-value that variance does not depend on log mean, from one batch of each pixel.

    Parameters
    ----------
    batches
        Means of batches, shape (pixel, batch). The noise of the last batch, its distance from the
        mean of the others, is tested: pixels are rendered independently.

    Returns
    -------
    float
        None where there is nothing to test.

    References
    ----------
    Breusch and Pagan, "A simple test for heteroscedasticity and random coefficient variation",
    1979, doi:10.2307/1911963; without normality: Koenker, "A note on studentizing a test for
    heteroscedasticity", 1981, doi:10.1016/0304-4076(81)90062-2.
    """
    from statsmodels.stats.diagnostic import het_breuschpagan

    rest = batches[:, :-1].mean(axis=1)
    noise = batches[:, -1] - rest
    known = np.isfinite(noise) & (rest > 0)
    noise, log_mean = noise[known], np.log(rest[known])
    if len(noise) < 3 or not np.ptp(log_mean) or not np.ptp(noise):
        return None
    design = np.stack([np.ones_like(log_mean), log_mean], axis=1)
    # A scale of 1 keeps fourth powers within range.
    p = het_breuschpagan(noise / np.abs(noise).max(), design, robust=True)[1]
    return max(float(p), _TINY)


_AVERAGED = 32
"""Samples of an average, as many as the paper's model takes."""
_STEPS = 0.05
"""Share of steps that counts as the largest; of Gaussian steps, these would hold 0.28."""
_LEAST = 12
"""Batches of samples that are needed."""


@claim(
    13,
    "assumptions",
    "Noise is not uniform over the image, averages are not Gaussian, variance does not follow "
    "feature buffers, and radiance is not regular.",
    spp=384,
)
def broken_assumptions(data: SceneData) -> Finding:
    """Test the four assumptions; each part says that one fails."""
    light = data.batch_light
    batches = light.reshape(-1, light.shape[-1])
    require(batches.shape[1] >= _LEAST, f"{_LEAST * 32} spp, has {data.samples.spp}")
    whole = data.whole(tests=4)
    slope, skewness = _slope(batches, whole), _skewness(data, whole)
    steps = _concentration(light, whole)
    largest = f"share of squared steps of log radiance in the largest {100 * _STEPS:.0f} %"
    tests = [
        # 0 for additive noise, 2 for multiplicative; half way.
        ClaimTest("slope of log variance on log mean", slope, least=1.0),
        # Not even fairly symmetric (Bulmer, "Principles of Statistics", 1979, page 63).
        ClaimTest(f"skewness of averages of {_AVERAGED}", skewness, least=0.5),
        # Of Gaussian steps, the largest would hold 0.28.
        ClaimTest(largest, steps, least=0.5),
    ]
    missing = list[str]()
    if (share := explained_by_features(data, batches, whole)) is None:
        missing.append("needs first-hit albedo, normal and depth")
    else:
        tests.append(ClaimTest("share of log variance that features explain", share, most=0.5))
    pixels = {"pixels": (logs(batches.mean(axis=1)), logs(batches.var(axis=1, ddof=1)))}
    return Finding(
        tuple(tests),
        tuple(missing),
        p_value=p_of_uniform_noise(batches),
        null_hypothesis="variance is uniform over the image (Breusch-Pagan)",
        plot_data=PlotData("points", pixels, "log10 mean", "log10 variance of a mean"),
    )


def _skewness(data: SceneData, whole: PixelSet) -> Interval[float]:
    """Return the median skewness of averages; how it grows is measured in some pixels."""

    def of_averages(moments: Moments) -> Floats:
        return np.asarray(moments.skewness / np.sqrt(_AVERAGED))

    skewness = data.summary["skewness"].to_numpy() / np.sqrt(_AVERAGED)
    median = whole.median(skewness.reshape(len(whole), -1))
    x = data.radiance(data.scattered(1024))
    return with_room(median, growing(np.nan_to_num(x), np.isfinite(x), of_averages))


def _slope(batches: Floats, whole: PixelSet) -> Interval[float]:
    """Return the slope of log variance on log mean, with an instrument against noisy means.

    Variance, mean and instrument are of different samples, so that their noise has nothing in
    common.
    """
    y = logs(batches[:, ::2].var(axis=1, ddof=1))
    x, z = (logs(batches[:, i::4].mean(axis=1)) for i in (1, 3))
    return whole.slope(x, y, instrument=z)


def _concentration(light: Floats, whole: PixelSet) -> Interval[float]:
    """Return the share of squared steps to the right-hand neighbour in the largest steps.

    A third of the batches, shape (y, x, batch), says which steps are large; the product of the
    steps of the two other thirds is their square without noise. A uniform image has no steps at
    all, and no interval.
    """
    thirds = [logs(light[..., i::3].mean(axis=-1)) for i in range(3)]
    steps = [np.pad(np.diff(t, axis=1), ((0, 0), (0, 1)), constant_values=np.nan) for t in thirds]
    chosen, one, two = (s.ravel() for s in steps)
    known = np.isfinite(chosen + one + two)
    square, size = (one * two)[known], np.abs(chosen[known])
    # Of equal steps, chance decides which are the largest.
    order = np.lexsort((generator(0).random(len(size)), size))
    large = np.zeros(len(size), dtype=bool)
    large[order[len(size) - max(1, round(_STEPS * len(size))) :]] = True
    return whole[known].ratio(np.where(large, square, 0), square)
