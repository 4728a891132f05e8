"""Learning: what the learned model is worth, and to whom (finding 15).

The claim is about the model of the paper, `PAPER`, and so is the verdict. Other estimators that
learned are asked the same, and stand beside it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._core.resampling import Interval, interval_of
from chdstat.comparison import Comparison
from chdstat.comparison.metrics import relative_squared_error
from chdstat.errors import ChdstatError
from chdstat.io.denoiser import denoise
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData

__all__ = ["EARLY", "GAINED", "MAJORITY", "PAPER", "SUPPRESSED", "measure"]

Floats = npt.NDArray[np.float64]

PAPER = "elek2019"
"""Name of the estimator that the claim is about."""
MAJORITY = 0.5
"""Share of estimates that a majority exceeds."""
SUPPRESSED = 0.5
"""Fireflies left, below which a majority of them is suppressed, as the paper says."""
EARLY = 0.1
"""Share of the iterations that is early; the paper's curves are flat after the first records."""
GAINED = 0.5
"""Share of the final gain that early training has to reach: most of it."""
_PARTS = 4
_RECORDS = 10
"""Records of a training that say how far its losses scatter, at least."""


def measure(data: SceneData) -> Outcome:
    """Read majority, fireflies, training and denoising off a comparison."""
    comparison = data.comparison
    if comparison is None:
        return Outcome(missing=("needs a comparison of estimators",))
    found = {
        name: _of_model(data, comparison, name)
        for name in comparison.estimators
        if name in comparison.models
    }
    asked = found.pop(PAPER, None)
    if asked is None:
        asked = Outcome(missing=(f"needs the paper's model, {PAPER}, in the comparison",))
    return replace(asked, beside=found)


def _of_model(data: SceneData, comparison: Comparison, name: str) -> Outcome:
    """Ask one estimator that learned."""
    index, level = comparison.estimators.index(name), level_of(_PARTS)
    parts = [
        ClaimTest.of(
            "share of improved estimates",
            _read(comparison, "improved", index, level),
            least=MAJORITY,
        ),
        ClaimTest.of(
            "share of fireflies left",
            _read(comparison, "fireflies_left", index, level),
            most=SUPPRESSED,
        ),
    ]
    history: Any = getattr(comparison.models[name], "history", None)
    missing = [] if history is not None else ["needs the history of a training"]
    if history is not None:
        gain = f"share of the gain after {EARLY:.0%} of the training"
        parts.append(ClaimTest.of(gain, early_gain(history, level=level), least=GAINED))
    try:
        start = _better_start(data, comparison, index, level)
        parts.append(
            ClaimTest.of("error of its denoised estimates over that of the mean's", start, most=1.0)
        )
    except ChdstatError as error:
        missing.append(f"needs a denoiser: {error}")
    return Outcome(
        tuple(parts),
        tuple(missing),
        details={"estimator": name, "n": comparison.n, "bias": _value(comparison, "bias", index)},
        plot_data=_plot_data(history),
        subject=f"for {name}",
    )


def early_gain(history: Any, *, level: float) -> Interval[float]:
    """Return the gain over the mean early in training, over that at its end.

    A gain is the validation baseline less the validation loss. What is early is the first record
    after a tenth of the iterations, the end the mean of the last tenth of the records. The interval
    takes the scatter of records for independent, with the deviation that successive differences
    have (von Neumann 1941, doi:10.1214/aoms/1177731677). Where the end is worse than the mean, the
    share is 0; where it may be better or worse, it is not known.
    """
    gain = np.asarray(history.validation_baseline - history.validation_loss, dtype=np.float64)
    if len(gain) < _RECORDS or not np.isfinite(gain).all():
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
    share = float(gain[int((iterations >= EARLY * iterations[-1]).argmax())]) / end
    half = reach * deviation / end * math.sqrt(1 + share**2 / last)
    return Interval(share, share - half, share + half, level)


def _value(comparison: Comparison, measure: str, index: int) -> float:
    return float(comparison.measures[measure].value[index, -1])


def _read(comparison: Comparison, measure: str, index: int, level: float) -> Interval[float]:
    """Return a measure with a normal interval over blocks and batches, of standard errors added.

    A single batch has no spread of its own: that of the blocks holds most of it. What has none over
    blocks, such as fireflies that all lie in one, is not known.
    """
    value = _value(comparison, measure, index)
    over_blocks, over_batches = (
        float(intervals[measure].standard_error[index, -1])
        for intervals in (comparison.measures, comparison.over_batches)
    )
    if not math.isfinite(over_blocks):
        return Interval.unknown(value, level=level)
    error = math.hypot(over_blocks, over_batches if math.isfinite(over_batches) else 0.0)
    half = float(stats.norm.ppf((1 + level) / 2)) * error
    return Interval(value, value - half, value + half, level)


def _better_start(
    data: SceneData, comparison: Comparison, index: int, level: float
) -> Interval[float]:
    """Return relMSE of the denoised learned estimates over that of the denoised means."""
    albedo = data.feature("albedo")
    normal = None if albedo is None else data.feature("normal")
    reference = comparison.first_reference
    scene_mean = np.nanmean(comparison.reference, axis=(0, 1))
    denoised = (
        denoise(start, albedo=albedo, normal=normal)
        for start in (comparison.estimates[index], comparison.first_mean)
    )
    ours, theirs = (
        relative_squared_error(d, reference, scene_mean=scene_mean).mean(axis=-1).ravel()
        for d in denoised
    )
    used = comparison.test_pixels.ravel() & np.isfinite(ours + theirs)
    if not used.any():
        return Interval.unknown(level=level)
    blocks = data.whole().blocks[used]
    above, below = blocks.sums(ours[used]), blocks.sums(theirs[used])
    return interval_of(
        lambda w: (w @ above) / (w @ below), blocks, level=level, bounds=(0.0, np.inf)
    )


def _plot_data(history: Any) -> PlotData:
    if history is None:
        return PlotData("curves")
    series = {
        "validation": (history.iteration, history.validation_loss),
        "sample mean": (history.iteration, history.validation_baseline),
    }
    return PlotData("curves", series, "iteration", "squared error in (W sr-1 m-2)^2")
