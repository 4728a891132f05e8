"""Learning: how good the learned model is, and whether it is the mean if there is no pattern.

The claims (15, 16, and 32 on guided samples) and verdicts are about the model of the paper,
`_PAPER`. Other learned estimators are tested in the same way. Elek et al. 2019, section 6: without
identifiable patterns, such a model "should gracefully reduce to the baseline solution", the sample
average.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._core.arrays import Array, Floats, generator, is_bad
from chdstat._core.denoiser import denoise
from chdstat._core.image_scales import relative_scale
from chdstat._core.resampling import Interval
from chdstat.comparison import Comparison, compare
from chdstat.comparison.estimator_choice import entry_of, estimate_by
from chdstat.errors import ChdstatError
from chdstat.estimators import names
from chdstat.inference.findings import ClaimTest, Finding, PlotData, level_of, require, required
from chdstat.samples import Samples
from chdstat.studies.claim import claim
from chdstat.studies.scene_data import SceneData

_EstimateOf = Callable[[Array], Floats]

_PAPER = "elek2019"
"""Name of the estimator that the claims are about."""
_EARLY = 0.1
"""Share of the iterations that is early; the paper's curves are flat after the first records."""


@claim(
    15,
    "learned model",
    "The learned model improves a majority of the estimates, suppresses fireflies, gains early "
    "in training, and gives a denoiser a better start.",
    subject="this training on this image, judged on its other pixels: other scenes may differ",
    once=True,
)
def learned_model(data: SceneData) -> Finding:
    """Read majority, fireflies, training and denoising off a comparison."""
    comparison = required(data.comparison, "a comparison of estimators")
    learned = [name for name in comparison.estimators if name in comparison.models]
    return _papers({name: _worth(data, comparison, name) for name in learned})


def _papers(measured: dict[str, Finding]) -> Finding:
    """Return the finding on the paper's model, with those of the others."""
    missing = Finding(missing=(f"needs the paper's model, {_PAPER}, in the comparison",))
    return replace(measured.pop(_PAPER, missing), other_models=measured)


def _worth(data: SceneData, comparison: Comparison, name: str) -> Finding:
    """Test what one estimator that learned is worth."""
    index, level = comparison.estimators.index(name), level_of(4)
    improved, left = (_read(comparison, m, index, level) for m in ("improved", "fireflies_left"))
    tests = [
        ClaimTest("share of improved estimates", improved, least=0.5),
        ClaimTest("share of fireflies left", left, most=0.5),
    ]
    missing, plot_data = list[str](), PlotData()
    history: Any = getattr(comparison.models[name], "history", None)
    if history is None:
        missing.append("needs the history of a training")
    else:
        gain = f"share of the gain after {100 * _EARLY:.0f} % of the training"
        tests.append(ClaimTest(gain, early_gain(history, level=level), least=0.5))
        series = {
            "validation": (history.iteration, history.validation_loss),
            "sample mean": (history.iteration, history.validation_baseline),
        }
        plot_data = PlotData("curves", series, "iteration", "squared error in (W sr-1 m-2)^2")
    try:
        start = _better_start(data, comparison, index)
        ratio = "error of its denoised estimates over that of the mean's"
        tests.append(ClaimTest(ratio, start, most=1.0))
    except ChdstatError as error:
        missing.append(f"needs a denoiser: {error}")
    return Finding(tuple(tests), tuple(missing), plot_data=plot_data, model=name)


def early_gain(history: Any, *, level: float) -> Interval[float]:
    """Return the gain over the mean early in training, over that at its end.

    A gain is the validation baseline minus the validation loss. "Early" is the first record after a
    tenth of the iterations, the end is the mean of the last tenth of the records. The interval
    assumes that records scatter independently, with the deviation of successive differences (von
    Neumann 1941, doi:10.1214/aoms/1177731677). If the end is worse than the mean, the share is 0;
    if it may be better or worse, the share is unknown.
    """
    gain = np.asarray(history.validation_baseline - history.validation_loss, dtype=np.float64)
    # Fewer than ten records do not say how far losses scatter.
    if len(gain) < 10 or not np.isfinite(gain).all():
        return Interval.unknown(level=level)
    iterations = np.asarray(history.iteration, dtype=np.float64)
    last = max(len(gain) // 10, 2)
    later = gain[len(gain) // 2 :]
    deviation = math.sqrt(float(np.mean(np.diff(later) ** 2)) / 2)
    end = float(gain[-last:].mean())
    reach = float(stats.t.ppf((1 + level) / 2, len(later) - 1))
    noise = reach * deviation / math.sqrt(last)
    if end <= -noise:
        return Interval(0.0, 0.0, 0.0, level)
    if end <= noise:
        return Interval.unknown(level=level)
    share = float(gain[int((iterations >= _EARLY * iterations[-1]).argmax())]) / end
    half = reach * deviation / end * math.sqrt(1 + share**2 / last)
    return Interval(share, share - half, share + half, level)


def _read(comparison: Comparison, measure: str, index: int, level: float) -> Interval[float]:
    """Return a measure with its interval at another level, which normal quantiles stretch.

    What has no interval, such as fireflies that all lie in one block, is not known.
    """
    found = comparison.measures[measure][index, -1]
    value, low, high = (float(x) for x in (found.value, found.low, found.high))
    middle = value if math.isfinite(value) else (low + high) / 2
    wider = float(stats.norm.ppf((1 + level) / 2) / stats.norm.ppf((1 + found.level) / 2))
    return Interval(value, middle - wider * (middle - low), middle + wider * (high - middle), level)


def _better_start(data: SceneData, comparison: Comparison, index: int) -> Interval[float]:
    """Return relMSE of the denoised learned estimates over that of the denoised means."""
    albedo = data.feature("albedo")
    normal = None if albedo is None else data.feature("normal")
    ours, theirs = (
        comparison.first_reference.relative(denoise(start, albedo=albedo, normal=normal))[0]
        .mean(axis=-1)
        .ravel()
        for start in (comparison.estimates[index], comparison.first_mean)
    )
    ours = np.where(comparison.test_pixels.ravel(), ours, np.nan)
    return data.whole(tests=4).ratio(ours, theirs, (0.0, np.inf))


# --- reduction to the mean ----------------------------------------------------------------------

LEVELS = tuple(float(f"1e{power}") for power in range(-4, 5))
"""Radiance of the constant images."""
_FACTORS = (2.0**-10, 2.0**10)
"""Units of radiance: powers of two, which round no sample."""
ROUNDING = 1e-4
"""Relative change up to which estimates are the same: single precision leaves 1e-7 to 1e-6."""
_EDGE, _EDGE_OF_CONSTANTS, _EDGE_TO_LEARN = 64, 16, 16
"""Largest edge, in pixels, of the estimated part: of the image, of constant images, and for
estimators that learn anew with every call, which takes minutes."""
_FEWER_LEVELS = (LEVELS[0], 1.0, LEVELS[-1])


@claim(
    16,
    "reduction to the mean",
    "Where samples show no pattern, the learned model gracefully reduces to their mean: equal "
    "samples keep their value, neither the order of samples nor the unit of radiance matters.",
    spp=32,
    subject="this training on this image: the network itself, whatever the scene shows",
    once=True,
)
def reduction(data: SceneData) -> Finding:
    """Give the model constant images, the samples in another order, and in another unit."""
    comparison = required(data.comparison, "a comparison of estimators")
    learned = [n for n in comparison.estimators if n in comparison.models or n in names("learned")]
    measured = {name: _reduction(data, comparison, name) for name in learned}
    series = {
        k: v for measurement in measured.values() for k, v in measurement.plot_data.series.items()
    }
    labels = "log10 radiance in W sr-1 m-2", "log10 of the relative deviation"
    return replace(_papers(measured), plot_data=PlotData("curves", series, *labels))


def _reduction(data: SceneData, comparison: Comparison, name: str) -> Finding:
    """Test whether one estimator that learned is the mean where there is no pattern."""
    anew = name not in comparison.models
    edge, levels = (_EDGE_TO_LEARN, _FEWER_LEVELS) if anew else (_EDGE, LEVELS)
    x, features = _middle(data.samples, comparison.n, edge)
    estimate = _function(comparison, name, features)
    small = min(_EDGE_OF_CONSTANTS, *x.shape[:2])
    few = _function(comparison, name, {k: v[:small, :small] for k, v in features.items()})
    constants = {}
    for level in levels:
        equal = np.full((small, small, *x.shape[2:]), level, np.float32)
        deviation = few(equal) - float(np.float32(level))
        constants[level] = _largest(deviation, np.full(deviation.shape, level))
    good = ~is_bad(x).any(axis=(-2, -1))
    if not good.any():
        return Finding(missing=("needs pixels without bad samples",))
    first = estimate(x)[good]

    def changes(convert: Callable[[Array], Array], factor: float = 1.0) -> Floats:
        """Return by how much estimates change with the samples, in their own unit."""
        other = estimate(convert(x))[good]
        return other / factor - first

    moved = [changes(lambda part: np.ascontiguousarray(part[..., ::-1]))]
    if not anew:
        moved.append(changes(_shuffled))
    # Values beyond single precision cannot be another unit.
    sizes = np.abs(x[np.isfinite(x) & (x != 0)]).astype(np.float64)
    tiny, huge = np.finfo(np.float32).tiny, np.finfo(np.float32).max
    factors = [f for f in _FACTORS if ((sizes * f >= tiny) & (sizes * f <= huge)).all()]
    scaled = [changes(partial(np.multiply, np.float32(f)), f) for f in factors]
    scale, change = _scale(x[good], first), "largest change of an estimate with the"
    largest = {
        "largest deviation of the estimate of equal samples, over their value": constants.values(),
        f"{change} order of its samples, over the pixel's scale": [
            _largest(by, scale) for by in moved
        ],
        f"{change} unit of radiance, over the pixel's scale": [
            _largest(by, scale) for by in scaled
        ],
    }
    # These values are known exactly: nothing is random.
    known = {name: max(values) for name, values in largest.items() if values}
    level = level_of(3)
    tests = (ClaimTest(n, Interval(v, v, v, level), most=ROUNDING) for n, v in known.items())
    # Deviations of 0 are drawn at the lower border.
    shown = np.log10(np.maximum(list(constants.values()), 1e-8))
    return Finding(
        tuple(tests),
        () if scaled else ("needs radiance that may be 1024 times as bright or dark",),
        plot_data=PlotData("curves", {name: (np.log10(list(constants)), shown)}),
        model=name,
    )


def _middle(
    samples: Samples, n: int, edge: int
) -> tuple[Array, dict[str, npt.NDArray[np.float32]]]:
    """Return samples in the middle of the image, and features there."""
    starts = [max(0, (length - edge) // 2) for length in samples.shape[:2]]
    ys, xs = (slice(start, start + edge) for start in starts)
    features = {name: image[ys, xs] for name, image in samples.features.items()}
    return samples.read(ys, xs, slice(0, n)), features


def _function(
    comparison: Comparison, name: str, features: dict[str, npt.NDArray[np.float32]]
) -> _EstimateOf:
    """Return an estimator as a function of samples (y, x, channel, sample)."""
    model: Any = comparison.models.get(name)

    def estimate(x: Array) -> Floats:
        # A model under a name that is not registered has no entry.
        if name not in names():
            return np.asarray(model.predict(x), dtype=np.float64)
        found = estimate_by(entry_of(name), x, features=features, model=model)
        return np.asarray(found, dtype=np.float64)

    return estimate


def _shuffled(x: Array) -> Array:
    """Return the samples of each pixel in an order drawn at random, the same for all channels."""
    height, width, _, n = x.shape
    places = generator(0).random((height, width, 1, n)).argsort(axis=-1)
    return np.take_along_axis(x, places, axis=-1)


def _scale(x: Array, estimate: Floats) -> Floats:
    """Return how bright each pixel is, its estimate among it, shape (pixel, 1).

    As in relMSE, a pixel counts as no darker than a tenth of the image.
    """
    size = np.maximum(np.abs(x).mean(axis=-1, dtype=np.float64), np.nan_to_num(np.abs(estimate)))
    bright = size.max(axis=-1, keepdims=True)
    return np.asarray(np.sqrt(relative_scale(bright)))


def _largest(change: Floats, scale: Floats) -> float:
    """Return the largest change over its scale: of no change 0, of a lost estimate infinity."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(change == 0, 0, np.abs(change) / np.broadcast_to(scale, change.shape))
    return float(np.where(np.isnan(relative), np.inf, relative).max(initial=0))


# --- guided samples -------------------------------------------------------------------------------

_SAME = 1.1
"""Factor by which the error over the mean's may grow on other samples."""


@claim(
    32,
    "guided estimates",
    "What learned from samples without path guiding holds on guided ones: its error over the "
    "mean's is not larger.",
    subject="this training on this image, judged on its other pixels: other scenes may differ",
    once=True,
)
def guided(data: SceneData) -> Finding:
    """Compare relMSE over the mean's on guided samples with that on as many of the image's."""
    pair = data.with_guided
    comparison = required(data.comparison, "a comparison of estimators")
    learned = [name for name in comparison.estimators if name in comparison.models]
    require(pair[0].samples.spp >= 2 * comparison.n, f"{2 * comparison.n} guided spp to judge")
    own, by_guide = (
        compare(
            scene.samples,
            ["mean", *learned],
            n=comparison.n,
            model={name: comparison.models[name] for name in learned},
        )
        for scene in pair
    )
    return _papers({name: _holds(own, by_guide, name) for name in learned})


def _holds(own: Comparison, guided: Comparison, name: str) -> Finding:
    """Compare what a model is worth in two comparisons, whose samples are independent."""
    index, level = own.estimators.index(name), level_of(1)
    errors = [_read(found, "relmse_ratio", index, level) for found in (own, guided)]
    before, after = (error.value for error in errors)
    ratio = Interval.unknown(level=level)
    if before > 0 and after > 0:
        reach = math.exp(math.hypot(*(error.high / error.value - 1 for error in errors)))
        larger = after / before
        ratio = Interval(larger, larger / reach, larger * reach, level)
    test = "error over the mean's, on guided samples over others"
    values = {"own": before, "guided": after}
    return Finding(
        (ClaimTest(test, ratio, most=_SAME),),
        plot_data=PlotData.bars(values, "relMSE over the mean's"),
        model=name,
    )
