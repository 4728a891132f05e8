"""Two Gaussians or one: expectation-maximisation on log histograms, all rows at once.

The cost depends on the bins, not on spp. Bins lie between the smallest and the largest sample of
each row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat._positive import Counts, Floats

__all__ = ["BINS", "TwoGaussians", "fit_two", "log_histogram"]

BINS = 100
"""Bins of a log histogram, as many as in the paper."""

_ITERATIONS = 100
_TOLERANCE = 3e-3
"""Change per step, in bins, at which a row has converged."""
_ROWS = 512
"""Rows worked on at once: their bins stay in the cache."""
_LEAST = 1e-3
"""A component that holds a smaller share is no component: its row has one."""


@dataclass(frozen=True)
class TwoGaussians:
    """Two components, the lower mean first; all in units of bins, and of shape (row, 2).

    ``log_likelihood`` and ``log_likelihood_of_one``, shape (row,), are of the binned data, of two
    components and of one.
    """

    weights: Floats
    means: Floats
    deviations: Floats
    log_likelihood: Floats
    log_likelihood_of_one: Floats


def log_histogram(
    ascending: npt.NDArray[Any], n: Counts
) -> tuple[npt.NDArray[np.float32], Floats, Floats]:
    """Return counts in bins of log10, shape (row, bin), and where each row begins and how wide.

    `ascending` holds the positive samples, shape (row, sample), of which the first `n` count.
    """
    counts = np.empty((len(ascending), BINS), dtype=np.float32)
    last = np.maximum(n - 1, 0)
    ends = np.take_along_axis(ascending, np.stack([0 * last, last], axis=-1), axis=-1)
    low, high = np.log10(ends.astype(np.float64)).T
    width = np.maximum((high - low) / BINS, np.finfo(np.float64).tiny)
    for part in spans(len(ascending), _ROWS):
        counts[part] = _count(ascending[part], n[part], low[part], width[part])
    return counts, low, width


def fit_two(counts: npt.NDArray[np.float32]) -> TwoGaussians:
    """Fit one and two Gaussians to binned data, shape (row, bin), by maximum likelihood."""
    result = np.empty((8, len(counts)))
    for part in spans(len(counts), _ROWS):
        result[:, part] = _fit_piece(counts[part].astype(np.float64))
    weights, means, deviations = result[:6].reshape(3, 2, -1).transpose(0, 2, 1)
    return TwoGaussians(weights, means, deviations, *result[6:])


def _count(
    ascending: npt.NDArray[Any], n: Counts, low: Floats, width: Floats
) -> npt.NDArray[np.int64]:
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    place = np.log10(np.where(valid, ascending, 1)).astype(np.float64)
    place -= low[:, np.newaxis]
    place /= width[:, np.newaxis]
    row = np.arange(len(ascending))[:, np.newaxis]
    # One slot more per row takes what is no sample.
    slot = np.where(valid, np.clip(place, 0, BINS - 1).astype(np.int64), BINS) + row * (BINS + 1)
    flat = np.bincount(slot.ravel(), minlength=len(ascending) * (BINS + 1))
    return flat.reshape(len(ascending), BINS + 1)[:, :BINS]


def _fit_piece(counts: Floats) -> Floats:
    """Return weights, means, deviations (two each) and both log-likelihoods, shape (8, row)."""
    moments = counts @ _POWERS
    one = _components(moments)
    state = _otsu(counts)
    active = np.arange(len(counts))
    for _ in range(_ITERATIONS):
        new = _step(counts[active], moments[active], state[:, active])
        # Both the places and the widths are in bins, and the weight is scaled to compare.
        change = np.abs(new - state[:, active]).max(axis=0) > _TOLERANCE
        state[:, active] = new
        active = active[change]
        if not active.size:
            break
    weight = state[0] / BINS
    pairs = np.stack([np.stack([1 - weight, weight]), state[1:3], state[3:5]])
    darker_first = np.argsort(pairs[1], axis=0)
    weights, means, deviations = np.take_along_axis(pairs, darker_first[np.newaxis], axis=1)
    log_likelihoods = _log_likelihood(counts, state), _log_likelihood_of_one(counts, *one)
    return np.concatenate([weights, means, deviations, log_likelihoods])


def _otsu(counts: Floats) -> Floats:
    """Start from the cut between the bins that separates the means best (Otsu 1979)."""
    sums = np.cumsum(counts[:, :, np.newaxis] * _POWERS, axis=1)
    total = sums[:, -1:]
    n, first = sums[..., 0], sums[..., 1]
    inside = n * (total[..., 0] - n)
    between = (first * total[..., 0] - n * total[..., 1]) ** 2 / np.maximum(inside, 1)
    cut = np.where(inside > 0, between, -1).argmax(axis=-1)
    lower = np.take_along_axis(sums, cut[:, np.newaxis, np.newaxis], axis=1)[:, 0]
    return _state(lower, total[:, 0] - lower)


def _step(counts: Floats, moments: Floats, state: Floats) -> Floats:
    upper = (counts * _responsibility(state)) @ _POWERS
    return _state(moments - upper, upper)


def _responsibility(state: Floats) -> Floats:
    """Return the probability that a sample of a bin is of the upper component.

    Its log odds are a parabola in the bin, so that one exponential is enough.
    """
    weight, mean_a, mean_b, sd_a, sd_b = state
    precision_a, precision_b = 0.5 / sd_a**2, 0.5 / sd_b**2
    odds = np.log(weight / (BINS - weight) * sd_a / sd_b)
    coefficients = np.stack(
        [
            odds + precision_a * mean_a**2 - precision_b * mean_b**2,
            2 * (precision_b * mean_b - precision_a * mean_a),
            precision_a - precision_b,
        ],
        axis=-1,
    )
    return np.asarray(1 / (1 + np.exp(-np.clip(coefficients @ _POWERS.T, -700, 700))))


def _state(lower: Floats, upper: Floats) -> Floats:
    """Return weight of the upper component (in bins), means and deviations, shape (5, row)."""
    mean_a, sd_a = _components(lower)
    mean_b, sd_b = _components(upper)
    share = upper[:, 0] / (lower[:, 0] + upper[:, 0])
    weight = BINS * np.clip(share, _LEAST, 1 - _LEAST)
    return np.stack([weight, mean_a, mean_b, sd_a, sd_b])


def _components(moments: Floats) -> tuple[Floats, Floats]:
    n = np.maximum(moments[:, 0], 1e-12)
    mean = moments[:, 1] / n
    variance = moments[:, 2] / n - mean**2
    # A component narrower than a bin would be infinitely likely, and nobody could tell.
    return mean, np.sqrt(np.maximum(variance, 1.0))


def _log_likelihood_of_one(counts: Floats, mean: Floats, sd: Floats) -> Floats:
    return np.asarray(np.vecdot(counts, _log_normal(mean, sd)))


def _log_likelihood(counts: Floats, state: Floats) -> Floats:
    weight, mean_a, mean_b, sd_a, sd_b = state
    lower = np.log(1 - weight / BINS)[:, np.newaxis] + _log_normal(mean_a, sd_a)
    upper = np.log(weight / BINS)[:, np.newaxis] + _log_normal(mean_b, sd_b)
    return np.asarray(np.vecdot(counts, np.logaddexp(lower, upper)))


def _log_normal(mean: Floats, sd: Floats) -> Floats:
    z = (_CENTRES - mean[:, np.newaxis]) / sd[:, np.newaxis]
    return np.asarray(-0.5 * (z**2 + np.log(2 * np.pi)) - np.log(sd)[:, np.newaxis])


_CENTRES = np.arange(BINS) + 0.5
_POWERS = np.stack([np.ones(BINS), _CENTRES, _CENTRES**2], axis=-1)
