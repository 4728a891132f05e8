"""Reduction: whether the learned model is the mean where there is no pattern (finding 16).

Elek et al. 2019, section 6: without identifiable patterns, such a model "should gracefully reduce
to the baseline solution", the sample average. The verdict is that of the paper's model; other
estimators that learned are asked the same, and stand beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator, is_bad
from chdstat._core.resampling import Interval
from chdstat.comparison import Comparison
from chdstat.comparison.candidates import options_of
from chdstat.estimators import Progressive, lookup, names
from chdstat.studies.claims.learning import PAPER
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData

__all__ = ["FACTORS", "LEVELS", "ROUNDING", "measure"]

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]
Estimate = Callable[[Array, Array | None], Floats]

LEVELS = tuple(float(f"1e{power}") for power in range(-4, 5))
"""Radiance of the constant images."""
FACTORS = (2.0**-10, 2.0**10)
"""Units of radiance: powers of two, which round no sample."""
ROUNDING = 1e-4
"""Relative change up to which estimates are the same: single precision leaves 1e-7 to 1e-6."""
_ORDERS = ("reversed", "drawn")
_PARTS = 3
_EDGE, _EDGE_OF_CONSTANTS, _EDGE_TO_LEARN = 64, 16, 16
"""Edge in pixels of what is estimated, at most: of the image, of constant ones, and by those that
learn anew with every call, which takes them minutes."""
_FEWER_LEVELS = (LEVELS[0], 1.0, LEVELS[-1])
_DARK = 0.01
"""Share of the squared mean of the image that counts in the scale of a pixel, as in relMSE."""
_LEAST_SHOWN = -8.0


def measure(data: SceneData) -> Outcome:
    """Give the model constant images, the samples in another order, and in another unit."""
    comparison = data.comparison
    if comparison is None:
        return Outcome(missing=("needs a comparison of estimators",))
    found = {
        name: _of_estimator(data, comparison, name)
        for name in comparison.estimators
        if name in comparison.models or name in names("learned")
    }
    curves = {k: v for told in found.values() for k, v in told.plot_data.series.items()}
    asked = found.pop(PAPER, None)
    if asked is None:
        asked = Outcome(missing=(f"needs the paper's model, {PAPER}, in the comparison",))
    labels = "log10 radiance in W sr-1 m-2", "log10 of the relative deviation"
    return replace(asked, beside=found, plot_data=PlotData("curves", curves, *labels))


def _of_estimator(data: SceneData, comparison: Comparison, name: str) -> Outcome:
    """Ask one estimator that learned."""
    anew = name not in comparison.models
    edge = _EDGE_TO_LEARN if anew else _EDGE
    x, direct, features = _middle(data, comparison.n, edge)
    estimate = _function(comparison, name, features)
    small = min(_EDGE_OF_CONSTANTS, *x.shape[:2])
    few = _function(comparison, name, {k: v[:small, :small] for k, v in features.items()})
    levels = _FEWER_LEVELS if anew else LEVELS
    constants = {level: _of_constants(few, (small, small, *x.shape[2:]), level) for level in levels}
    good = ~is_bad(x).any(axis=(-2, -1))
    if not good.any():
        return Outcome(missing=("needs pixels without bad samples",), subject=f"for {name}")
    first = estimate(x, direct)[good]
    scale, step = _scale(x[good], first), first - x[good].mean(axis=-1, dtype=np.float64)
    moved = {
        order: estimate(_ordered(x, order), None if direct is None else _ordered(direct, order))
        for order in _ORDERS[: 1 if anew else None]
    }
    moved = {order: found[good] - first for order, found in moved.items()}
    # What falls out of single precision is no other unit any more.
    factors = [f for f in FACTORS if _fits(x, f)]
    scaled = {
        f: estimate(x * np.float32(f), None if direct is None else direct * np.float32(f))
        for f in factors
    }
    scaled = {factor: found[good] / factor - first for factor, found in scaled.items()}
    parts = [
        _part(
            "largest deviation of the estimate of equal samples, over their value",
            max(constants.values()),
        ),
        _part(
            "largest change of an estimate with the order of its samples, over the pixel's scale",
            max(_largest(change, scale) for change in moved.values()),
        ),
    ]
    if scaled:
        name_of = "largest change of an estimate with the unit of radiance, over the pixel's scale"
        parts.append(_part(name_of, max(_largest(change, scale) for change in scaled.values())))
    return Outcome(
        tuple(parts),
        () if scaled else ("needs radiance that may be 1024 times as bright or dark",),
        details={
            "estimator": name,
            "n": comparison.n,
            "deviation_by_radiance": {f"{level:g}": v for level, v in constants.items()},
            "change_over_step_by_order": {k: _over(v, step) for k, v in moved.items()},
            "change_over_step_by_factor": {f"{k:g}": _over(v, step) for k, v in scaled.items()},
        },
        plot_data=_plot_data(name, constants),
        subject=f"for {name}",
    )


def _part(name: str, value: float) -> ClaimTest:
    """Return a part of a number that is known exactly: nothing is drawn in it."""
    return ClaimTest.of(name, Interval(value, value, value, level_of(_PARTS)), most=ROUNDING)


def _middle(
    data: SceneData, n: int, edge: int
) -> tuple[Array, Array | None, dict[str, npt.NDArray[np.float32]]]:
    """Return samples in the middle of the image, their direct part, and features there."""
    starts = [max(0, (length - edge) // 2) for length in data.samples.shape[:2]]
    ys, xs = (slice(start, start + edge) for start in starts)
    direct = data.samples.direct
    part = None
    if direct is not None and direct.spp >= n:
        part = direct.read(ys, xs, slice(0, n))
    features = {name: image[ys, xs] for name, image in data.samples.features.items()}
    return data.samples.read(ys, xs, slice(0, n)), part, features


def _function(
    comparison: Comparison, name: str, features: dict[str, npt.NDArray[np.float32]]
) -> Estimate:
    """Return an estimator as a function of samples (y, x, channel, sample) and direct part."""
    entry = lookup(name) if name in names() else None
    model = comparison.models.get(name)
    function: Any = entry if model is None else model.predict
    options = {} if entry is None else options_of(entry, features)
    if isinstance(model, Progressive):
        options["trust"] = 1.0  # the network itself is asked

    def estimate(x: Array, direct: Array | None) -> Floats:
        more = {"direct": direct} if entry is not None and entry.uses_direct else {}
        return np.asarray(function(x, **options, **more), dtype=np.float64)

    return estimate


def _of_constants(estimate: Estimate, shape: tuple[int, ...], level: float) -> float:
    """Return the largest deviation of estimates from a constant image, over its radiance."""
    x = np.full(shape, level, np.float32)
    return _largest(estimate(x, x) - float(np.float32(level)), np.full(shape[:-1], level))


def _ordered(x: Array, order: str) -> Array:
    """Return the samples of each pixel in another order, the same for all arrays of a shape."""
    if order == "reversed":
        return np.ascontiguousarray(x[..., ::-1])
    height, width, _, n = x.shape
    places = generator(0).random((height, width, 1, n)).argsort(axis=-1)
    return np.take_along_axis(x, places, axis=-1)


def _fits(x: Array, factor: float) -> bool:
    """Say whether all samples, times a factor, are normal numbers of single precision."""
    size = np.abs(x[np.isfinite(x) & (x != 0)]).astype(np.float64) * factor
    bounds = np.finfo(np.float32)
    return bool(((size >= bounds.tiny) & (size <= bounds.max)).all())


def _scale(x: Array, estimate: Floats) -> Floats:
    """Return how bright each pixel is, its estimate among it, shape (pixel, 1).

    As in relMSE, a pixel counts as no darker than a tenth of the image.
    """
    size = np.maximum(np.abs(x).mean(axis=-1, dtype=np.float64), np.nan_to_num(np.abs(estimate)))
    bright = size.max(axis=-1, keepdims=True)
    return np.asarray(np.sqrt(bright**2 + _DARK * bright.mean() ** 2))


def _largest(change: Floats, scale: Floats) -> float:
    """Return the largest change over its scale: of no change 0, of a lost estimate infinity."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(change == 0, 0, np.abs(change) / np.broadcast_to(scale, change.shape))
    return float(np.where(np.isnan(relative), np.inf, relative).max(initial=0))


def _over(change: Floats, step: Floats) -> float:
    """Return the root mean square of changes over that of the way from mean to estimate."""
    size = float(np.sqrt(np.mean(step**2)))
    return float(np.sqrt(np.mean(change**2))) / size if size > 0 else float("nan")


def _plot_data(name: str, constants: dict[float, float]) -> PlotData:
    """Return the deviation by radiance; what is exact lies at the lower border."""
    deviations = np.maximum(list(constants.values()), 10**_LEAST_SHOWN)
    return PlotData("curves", {name: (np.log10(list(constants)), np.log10(deviations))})
