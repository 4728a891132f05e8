"""Diffuse objects: symmetric in the log domain, gamma-like in the linear one (finding 2)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage, special

from chdstat._core.resampling import Blocks, Interval, interval_of, mean_of
from chdstat.fit._gamma import gamma_shape
from chdstat.studies.log_chds import visible
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData

__all__ = ["DISTANCE", "SYMMETRIC", "log_skewness", "measure"]

Floats = npt.NDArray[np.float64]

SYMMETRIC = 0.5
"""Skewness up to which a distribution is fairly symmetric (Bulmer, "Principles of Statistics",
1979, page 63)."""
DISTANCE = 0.1
"""Kolmogorov's distance to a family that counts as near: no probability is wrong by more than 10
points. That is twice the misfit that `chdstat.classify` allows: the paper says "close to" and
"resembling", not "is"."""
LEAST = 32
"""Positive samples that the shape of a pixel needs."""
_PARTS = 4
_Z = np.linspace(-8, 8, 641)
_RATIO = np.linspace(0, 8, 641)
"""Edges of bins of standardised logarithms, and of radiance over the mean of its pixel."""
_SMOOTH = 17
"""Bins that the histogram is averaged over before its mode is taken, a fifth of the mean."""


def measure(data: SceneData) -> Outcome:
    """Measure skewness and distance to Gaussian of logarithms, and likeness to gamma."""
    patch = data.patch("diffuse")
    if patch is None:
        return Outcome(missing=("needs a region of diffuse objects",))
    x = visible(data.light(patch))
    enough = np.isfinite(log_skewness(x))
    if not enough.any():
        return Outcome(missing=(f"needs {LEAST} different positive samples in a pixel",))
    x, blocks = x[enough], patch.blocks[enough]
    z, skewness = blocks.sums(_counts(_standard_logs(x), _Z)), log_skewness(x)
    return Outcome(
        (*_in_logs(skewness, z, blocks), *_in_radiance(x, blocks)),
        details={"log_skewness": patch.by_region(_spread(skewness, enough))},
        plot_data=_plot_data(z.sum(axis=0)),
    )


def log_skewness(x: Floats) -> Floats:
    """Return the skewness of log radiance in sight, shape (...); NaN below 32 samples.

    NaN, too, where all are equal.
    """
    z = _standard_logs(visible(x))
    n = np.isfinite(z).sum(axis=-1)
    return np.asarray(np.where(n >= LEAST, np.nansum(z**3, axis=-1) / np.maximum(n, 1), np.nan))


def _in_logs(skewness: Floats, z: Floats, blocks: Blocks) -> tuple[ClaimTest, ...]:
    level = level_of(_PARTS)
    return (
        ClaimTest.of(
            "skewness of log radiance",
            mean_of(skewness, blocks, level=level),
            least=-SYMMETRIC,
            most=SYMMETRIC,
        ),
        ClaimTest.of(
            "distance of log radiance to a Gaussian",
            interval_of(lambda w: _to_gaussian(w @ z), blocks, level=level, bounds=(0.0, 1.0)),
            most=DISTANCE,
        ),
    )


def _in_radiance(x: Floats, blocks: Blocks) -> tuple[ClaimTest, ...]:
    level = level_of(_PARTS)
    ratio, gaps = blocks.sums(_counts(_ratios(x), _RATIO)), blocks.sums(_log_ratios(x))
    return (
        ClaimTest.of(
            "distance of radiance to a gamma distribution",
            interval_of(
                lambda w: _to_gamma(w @ ratio, w @ gaps), blocks, level=level, bounds=(0.0, 1.0)
            ),
            most=DISTANCE,
        ),
        ClaimTest.of("mode over mean", _mode(ratio, blocks, level), most=1.0),
    )


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
    positive = np.where(x > 0, x, np.nan)
    n = np.maximum((x > 0).sum(axis=-1, keepdims=True), 1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        scale = np.nanmax(positive, axis=-1, keepdims=True)
        unit = positive / scale
        return np.asarray(unit / (np.nansum(unit, axis=-1, keepdims=True) / n))


def _log_ratios(x: Floats) -> Floats:
    """Return sums of log ratios and their number; their mean is minus the gap of `gamma_shape`."""
    ratio = _ratios(x)
    with np.errstate(divide="ignore"):
        log = np.log(np.where(ratio > 0, ratio, np.nan))
    return np.stack([np.nansum(log, axis=-1), np.isfinite(log).sum(axis=-1)], axis=-1)


def _counts(values: Floats, edges: Floats) -> Floats:
    """Count values of each row in bins, shape (row, bin); what lies outside goes to the ends."""
    known = np.isfinite(values)
    bins = np.clip(np.searchsorted(edges, values[known], "right") - 1, 0, len(edges) - 2)
    row = np.nonzero(known)[0] * (len(edges) - 1)
    counts = np.bincount(row + bins, minlength=len(values) * (len(edges) - 1))
    return np.asarray(counts.reshape(len(values), -1), dtype=np.float64)


def _below(counts: Floats) -> Floats:
    """Return the distribution function at the inner edges, shape (replicate, bin - 1)."""
    total = np.cumsum(counts, axis=1)
    return np.asarray(total[:, :-1] / total[:, -1:])


def _to_gaussian(counts: Floats) -> Floats:
    return np.asarray(np.abs(_below(counts) - special.ndtr(_Z[1:-1])).max(axis=1))


def _to_gamma(counts: Floats, gaps: Floats) -> Floats:
    """Return the distance to the gamma distribution of maximum likelihood, of mean 1."""
    k = gamma_shape(-gaps[:, 0] / gaps[:, 1])[0][:, np.newaxis]
    return np.asarray(np.abs(_below(counts) - special.gammainc(k, k * _RATIO[1:-1])).max(axis=1))


def _mode(counts: Floats, blocks: Blocks, level: float) -> Interval[float]:
    """Return the highest place of the smoothed histogram of radiance over the mean."""
    centers = (_RATIO[1:] + _RATIO[:-1]) / 2

    def highest(weights: Floats) -> Floats:
        # The last bin holds all that lies beyond, and is no mode.
        smooth = ndimage.uniform_filter1d((weights @ counts)[:, :-1], _SMOOTH, axis=1)
        return np.asarray(centers[smooth.argmax(axis=1)])

    return interval_of(highest, blocks, level=level, bounds=(0.0, np.inf))


def _spread(values: Floats, where: npt.NDArray[np.bool_]) -> Floats:
    found = np.full(len(where), np.nan)
    found[where] = values
    return found


def _plot_data(counts: Floats) -> PlotData:
    centers, width = (_Z[1:] + _Z[:-1]) / 2, _Z[1] - _Z[0]
    series = {
        "diffuse": (centers, counts / (counts.sum() * width)),
        "Gaussian": (centers, np.exp(-(centers**2) / 2) / np.sqrt(2 * np.pi)),
    }
    return PlotData("curves", series, "standardised log radiance", "density")
