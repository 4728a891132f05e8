"""Diffuse objects: symmetric in the log domain, gamma-like in the linear one (finding 2)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, special

from chdstat._core.positive import Floats
from chdstat._core.resampling import interval_of, mean_of
from chdstat.fit._gamma import gamma_shape
from chdstat.studies.log_chds import visible
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of, require
from chdstat.studies.scene_data import SceneData

__all__ = ["log_skewness", "measure"]

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


def measure(data: SceneData) -> Outcome:
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
    logs, ratios, log_ratios = (
        blocks.sums(of_pixel)
        for of_pixel in (_counts(_standard_logs(x), _Z), _counts(ratio, _RATIO), gaps)
    )

    def to_gaussian(weights: Floats) -> Floats:
        return _distance(weights @ logs, special.ndtr(_Z[1:-1]))

    def to_gamma(weights: Floats) -> Floats:
        """Return the distance to the gamma distribution of maximum likelihood, of mean 1."""
        sums = weights @ log_ratios
        k = gamma_shape(-sums[:, 0] / sums[:, 1])[0][:, np.newaxis]
        return _distance(weights @ ratios, special.gammainc(k, k * _RATIO[1:-1]))

    def mode(weights: Floats) -> Floats:
        """Return the highest place of the smoothed histogram of radiance over the mean."""
        # The last bin holds all that lies beyond, and is no mode.
        smooth = ndimage.uniform_filter1d((weights @ ratios)[:, :-1], _SMOOTH, axis=1)
        return np.asarray(((_RATIO[1:] + _RATIO[:-1]) / 2)[smooth.argmax(axis=1)])

    unit, positive = (0.0, 1.0), (0.0, np.inf)
    gaussian = interval_of(to_gaussian, blocks, level=level, bounds=unit)
    gamma = interval_of(to_gamma, blocks, level=level, bounds=unit)
    highest = interval_of(mode, blocks, level=level, bounds=positive)
    mean = mean_of(skewness[known], blocks, level=level)
    counts, centers = logs.sum(axis=0), (_Z[1:] + _Z[:-1]) / 2
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
