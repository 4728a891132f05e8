"""Predicted N: how many samples an average needs by the central limit theorem, with its interval.

Skewness and kurtosis rest on rare bright samples. Those that were seen say how large both are at
least. Those that were not are in the tail: beyond its threshold, a generalised Pareto distribution
of the largest index that the samples allow takes their place, which has a kurtosis only if that
index is below 1/4. Otherwise the N is not identified.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat._positive import CONSTANT_SPREAD, Floats, Mask
from chdstat._reasons import Reason
from chdstat.fit.tail import Tail

__all__ = ["Prediction", "predict"]

_Z = 1.959963984540054
_LARGEST_INDEX = 0.25
"""From this tail index on, the kurtosis is infinite."""
_CHUNK = 2**16
"""Samples worked on at once: their float64 copies stay in the cache."""


@dataclass(frozen=True)
class Prediction:
    """Predicted N of some pixels, shape (...).

    Attributes
    ----------
    n, interval
        N, and its 95 % interval, shape (..., 2); NaN where `reason` says why.
    reason
        `Reason` codes.
    """

    n: Floats
    interval: Floats
    reason: npt.NDArray[np.int8]


def predict(x: npt.NDArray[Any], bad: Mask, tail: Tail, n_means: int) -> Prediction:
    """Predict N from samples, shape (..., sample), of which some are bad, and from their tails."""
    samples, batch = x.shape[-1], x.shape[:-1]
    rows, good = x.reshape(-1, samples), ~bad.reshape(-1, samples)
    threshold, highest = tail.threshold.reshape(-1), tail.interval[..., 1].reshape(-1)
    found = np.empty((3, len(rows)))
    reason = np.empty(len(rows), dtype=np.int8)
    # Rows that have no answer are computed, too, and masked by their reason.
    with np.errstate(all="ignore"):
        for part in spans(len(rows), max(1, _CHUNK // samples)):
            relative, reason[part] = _relative(rows[part], good[part])
            excess = good[part] & (rows[part] > threshold[part, np.newaxis])
            shapes = _shapes(relative, good[part], excess, highest[part])
            found[:, part] = [_needed(*shape, n_means) for shape in shapes]
    # Of clamped samples, or of a lamp's among nulls, nothing larger is missing.
    known = np.isin(tail.reason, [Reason.OK, Reason.TIED, Reason.CONSTANT])
    of_tail = np.where(tail.reason == Reason.OK, Reason.UNIDENTIFIED, tail.reason)
    identified = (tail.interval[..., 1] < _LARGEST_INDEX) & tail.variance_trusted
    missing = ~known | (tail.reason == Reason.OK) & ~identified
    own = reason.reshape(batch)
    codes = np.asarray(np.where((own == Reason.OK) & missing, of_tail, own), dtype=np.int8)
    low, n, high = np.where(codes == Reason.OK, found.reshape(3, *batch), np.nan)
    return Prediction(n=n, interval=np.stack([low, high], axis=-1), reason=codes)


def _needed(skewness: Floats, kurtosis: Floats, n_means: int) -> Floats:
    """Return the N at which both lie within two standard errors of those of Gaussian averages.

    Under normality, the variances are 6 / n_means and 24 / n_means (Cramer 1946, section 29.3).
    """
    by_skewness = skewness**2 / (4 * 6 / n_means)
    by_kurtosis = kurtosis / (2 * np.sqrt(24 / n_means))
    return np.asarray(np.maximum(1, np.ceil(np.maximum(by_skewness, by_kurtosis))))


def _relative(x: npt.NDArray[Any], good: Mask) -> tuple[Floats, npt.NDArray[np.int8]]:
    """Return good samples as deviations from their mean, others as 0, and `Reason` codes.

    They are in units of their standard deviation, and no power of them overflows.
    """
    values = np.where(good, x, 0).astype(np.float64)
    n = np.count_nonzero(good, axis=-1)
    largest = np.abs(values).max(axis=-1)
    values /= np.where(largest > 0, largest, 1)[:, np.newaxis]
    low = np.where(good, values, np.inf).min(axis=-1)
    high = np.where(good, values, -np.inf).max(axis=-1)
    cases = {
        Reason.ALL_BAD: n == 0,
        Reason.ALL_NULL: largest == 0,
        Reason.CONSTANT: high - low <= CONSTANT_SPREAD,
    }
    reason = np.select(list(cases.values()), [np.int8(code) for code in cases], np.int8(Reason.OK))
    values -= (values.sum(axis=-1) / n)[:, np.newaxis]
    values *= good
    values /= np.sqrt(np.vecdot(values, values) / n)[:, np.newaxis]
    return values, np.asarray(reason, dtype=np.int8)


def _shapes(z: Floats, good: Mask, excess: Mask, highest: Floats) -> list[tuple[Floats, Floats]]:
    """Return absolute skewness and excess kurtosis: at least, as they are, and at most.

    The errors are those of the influence functions; at most, too, what `_with_tail` makes of the
    largest tail index.
    """
    n = np.count_nonzero(good, axis=-1).astype(np.float64)
    square = z * z
    cube, fourth = square * z, square * square
    skewness, fourth_moment = cube.sum(axis=-1) / n, fourth.sum(axis=-1) / n
    a, b = skewness[:, np.newaxis], fourth_moment[:, np.newaxis]
    of_skewness = cube - a - 3 * z - 1.5 * a * (square - 1)
    of_kurtosis = fourth - b - 4 * a * z - 2 * b * (square - 1)
    errors = [
        _Z * np.sqrt(np.sum(v * v, axis=-1, where=good)) / n for v in (of_skewness, of_kurtosis)
    ]
    found = [np.abs(skewness), np.abs(fourth_moment - 3)]
    low = [np.maximum(value - error, 0) for value, error in zip(found, errors, strict=True)]
    more = _with_tail([z, square, cube, fourth], n, excess, highest)
    high = [
        np.fmax(value + error, np.abs(other))
        for value, error, other in zip(found, errors, more, strict=True)
    ]
    return [(low[0], low[1]), (found[0], found[1]), (high[0], high[1])]


def _with_tail(
    powers: list[Floats], n: Floats, excess: Mask, index: Floats
) -> tuple[Floats, Floats]:
    """Return skewness and excess kurtosis with a generalised Pareto tail of the same mean excess.

    Its moments are ``E Y^j = j! s^j / prod_i (1 - i xi)`` for i = 1 to j.
    """
    k = np.count_nonzero(excess, axis=-1)
    z = powers[0]
    threshold = np.where(k > 0, np.min(z, axis=-1, where=excess, initial=np.inf), 0.0)
    mean_excess = np.sum(z - threshold[:, np.newaxis], axis=-1, where=excess) / np.maximum(k, 1)
    scale = mean_excess * (1 - index)
    of_excess = [np.ones_like(scale)]
    for j in range(1, 5):
        of_excess.append(of_excess[-1] * j * scale / (1 - j * index))
    moments = []
    for j, power in enumerate(powers, start=1):
        body = np.sum(power, axis=-1, where=~excess)
        tail = sum(comb(j, i) * threshold ** (j - i) * of_excess[i] for i in range(j + 1))
        moments.append((body + np.where(k > 0, k * tail, 0)) / n)
    first, second, third, fourth = moments
    variance = second - first**2
    third = third - 3 * first * second + 2 * first**3
    fourth = fourth - 4 * first * moments[2] + 6 * first**2 * second - 3 * first**4
    return third / variance**1.5, fourth / variance**2 - 3
