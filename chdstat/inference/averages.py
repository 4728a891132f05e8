"""Averages of N samples for several N: their tests of normality, and the N that is predicted.

`nested_averages` forms the averages of N samples from those of a divisor of N, `shapes` measures
their skewness and kurtosis, and `run_on_averages` tests them. Samples are relative to the largest
of their row, so that no power of them overflows or vanishes.

`predict` returns how many samples an average needs by the central limit theorem, with an interval.
Skewness and kurtosis rest on rare bright samples: those that were seen give a lower bound of both.
Those that were not seen lie in the tail: beyond its threshold, a generalised Pareto distribution of
the largest index that the samples allow takes their place. It has a kurtosis only if that index is
below 1/4; otherwise N is not identified. Where the logarithms may be Gaussian, the samples may be
log-normal, too, which have a kurtosis that hardly depends on what was seen of the tail. A bright
part of which no sample was seen leaves no trace at all, so that there have to be enough samples,
beside nulls, for it to be a small one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, spans
from chdstat._core.positive import CONSTANT_SPREAD
from chdstat._core.reasons import first_of
from chdstat._core.resampling import Z_95
from chdstat.errors import Reason
from chdstat.fit.tail import Tail
from chdstat.inference.normality import NormalityTest, run_tests

__all__ = [
    "MORE_THAN_TESTED",
    "UNTESTED",
    "Averages",
    "n_needed",
    "nested_averages",
    "predict",
    "run_on_averages",
    "shapes",
]


@dataclass(frozen=True)
class Averages:
    """Averages of complete batches of `size` samples, shape (row, batch), bad samples left out.

    ``formed`` marks batches with a good sample, None where all are; others average to 0. The last
    good sample of a row ends it: what is bad behind it may be what a pixel lacks.
    """

    size: int
    values: Floats
    formed: Mask | None


def nested_averages(x: npt.NDArray[Any], bad: Mask, sizes: Counts) -> Iterator[Averages]:
    """Yield the averages of samples, shape (row, sample), for ascending sizes."""
    spoilt = bool(bad.any())
    samples = x.astype(np.float64)
    if spoilt:
        np.copyto(samples, 0, where=bad)
    largest = samples.max(axis=-1, keepdims=True, initial=0)
    samples /= np.where(largest > 0, largest, 1)
    sums = {1: samples}
    counts = {1: np.subtract(1.0, bad)} if spoilt else {}
    length = samples.shape[-1] - (~bad[:, ::-1]).argmax(axis=-1, keepdims=True)
    for size in map(int, sizes):
        divisor = max(known for known in sums if size % known == 0)
        sums[size] = _grouped(sums[divisor], size // divisor)
        if not spoilt:
            yield Averages(size, sums[size] / size, None)
            continue
        counts[size] = _grouped(counts[divisor], size // divisor)
        ends = size * np.arange(1, counts[size].shape[-1] + 1)
        formed = (counts[size] > 0) & (ends <= length)
        yield Averages(size, formed * sums[size] / np.maximum(counts[size], 1), formed)


def _grouped(values: Floats, count: int) -> Floats:
    """Add up every `count` neighbours; what is left over is dropped."""
    if count == 1:
        return values
    groups = values.shape[-1] // count
    if count == 2:
        return np.asarray(values[:, : 2 * groups : 2] + values[:, 1 : 2 * groups : 2])
    batches = values[:, : count * groups].reshape(len(values), groups, count)
    # A product with ones adds short batches up faster than a sum over a short axis does.
    return np.asarray(batches @ np.ones(count))


def shapes(averages: Averages) -> tuple[Floats, Floats]:
    """Return skewness and excess kurtosis, divisor n, not finite for equal averages."""
    formed, values = averages.formed, averages.values
    n = values.shape[-1] if formed is None else np.count_nonzero(formed, axis=-1)
    deviation = values - (values.sum(axis=-1) / n)[:, np.newaxis]
    if formed is not None:
        deviation *= formed
    square = deviation * deviation
    variance = np.vecdot(deviation, deviation) / n
    skewness = np.vecdot(deviation, square) / n / variance**1.5
    return skewness, np.vecdot(square, square) / n / variance**2 - 3


_LEAST = 1379
"""Samples other than 0. Of so many, all but one pixel in 1000 have some of a part of 0.5 %, as
``0.995^1379 = 0.001``; without them, their skewness and kurtosis are those of the rest."""
_LARGEST_INDEX = 0.25
"""From this tail index on, the kurtosis is infinite."""
_CERTAIN = 2.81
"""Standard errors of an estimate up to its upper end: two-sided, 99.5 %. A pixel has an answer
because its tail looks light: an end of 97.5 % is too low for up to a quarter of those that do."""
_SHARING = 4.0
"""Least samples that a fourth moment rests on: one sample alone tells no moment."""
_GAUSSIAN = 4.0
"""Standard errors within which skewness and kurtosis of logarithms are those of a Gaussian."""
_CHUNK = 2**16
"""Samples worked on at once: their float64 copies stay in the cache."""


def predict(
    x: npt.NDArray[Any], bad: Mask, tail: Tail, n_means: int
) -> tuple[Floats, Floats, npt.NDArray[np.int8]]:
    """Predict N from samples, shape (..., sample), of which some are bad, and from their tails.

    Returns N, shape (...), its 95 % interval, shape (..., 2), and `Reason` codes where both are
    NaN.
    """
    samples, batch = x.shape[-1], x.shape[:-1]
    rows, good = x.reshape(-1, samples), ~bad.reshape(-1, samples)
    index, threshold = tail.xi + _CERTAIN * tail.standard_error, tail.threshold.reshape(-1)
    few = np.count_nonzero(good & (rows != 0), axis=-1).reshape(batch) < _LEAST
    # Of clamped samples, or of a lamp's among nulls, nothing larger is missing.
    ends = np.isin(tail.reason, [Reason.TIED, Reason.CONSTANT])
    heavy = (tail.reason == Reason.OK) & ~((index < _LARGEST_INDEX) & tail.variance_trusted)
    codes = [Reason.TOO_FEW, Reason.OK, Reason.UNIDENTIFIED]
    reason = np.select([few, ends, heavy], codes, tail.reason).reshape(-1).astype(np.int8)
    index = index.reshape(-1)
    found = np.full((3, len(rows)), np.nan)
    with np.errstate(all="ignore"):
        for part in spans(len(rows), max(1, _CHUNK // samples)):
            relative, own = _relative(rows[part], good[part])
            reason[part] = np.where(own == Reason.OK, reason[part], own)
            known = np.flatnonzero(reason[part] == Reason.OK)
            at = np.arange(len(rows))[part][known]
            excess = good[at] & (rows[at] > threshold[at, np.newaxis])
            shapes, sharing = _shapes(relative[known], good[at], excess, index[at])
            reason[at[sharing < _SHARING]] = Reason.UNIDENTIFIED
            shapes[2] = np.fmax(shapes[2], _of_lognormal(rows[at], good[at]))
            needed = np.stack([_needed(*shape, n_means=n_means) for shape in shapes])
            found[:, at] = np.where(sharing < _SHARING, np.nan, needed)
    low, n, high = found.reshape(3, *batch)
    return n, np.stack([low, high], axis=-1), reason.reshape(batch)


def _needed(skewness: Floats, kurtosis: Floats, *, n_means: int) -> Floats:
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
    reason = first_of(
        {
            Reason.ALL_BAD: n == 0,
            Reason.ALL_NULL: largest == 0,
            Reason.CONSTANT: high - low <= CONSTANT_SPREAD,
        }
    )
    values -= (values.sum(axis=-1) / n)[:, np.newaxis]
    values *= good
    values /= np.sqrt(np.vecdot(values, values) / n)[:, np.newaxis]
    return values, reason


def _shapes(z: Floats, good: Mask, excess: Mask, highest: Floats) -> tuple[Floats, Floats]:
    """Return absolute skewness and excess kurtosis, shape (3, 2, row): least, as they are, most.

    The errors are those of the influence functions, on a logarithmic scale towards more: of a
    bright part that a few samples are of, there may be much less. At most, they are what
    `_with_tail` makes of the largest tail index. Also returns how many equal samples would give the
    fourth moment the error that it has, shape (row,).
    """
    n = np.count_nonzero(good, axis=-1).astype(np.float64)
    square = z * z
    cube, fourth = square * z, square * square
    skewness, fourth_moment = cube.sum(axis=-1) / n, fourth.sum(axis=-1) / n
    a, b = skewness[:, np.newaxis], fourth_moment[:, np.newaxis]
    of_skewness = cube - a - 3 * z - 1.5 * a * (square - 1)
    of_kurtosis = fourth - b - 4 * a * z - 2 * b * (square - 1)
    errors = np.stack(
        [np.sqrt(np.sum(v * v, axis=-1, where=good)) / n for v in (of_skewness, of_kurtosis)]
    )
    found = np.abs([skewness, fourth_moment - 3])
    wider = (1 + found) * np.exp(_CERTAIN * errors / (1 + found)) - 1
    more = np.abs(_with_tail([z, square, cube, fourth], n, excess, highest))
    ends = np.stack([np.maximum(found - Z_95 * errors, 0), found, np.fmax(wider, more)])
    return ends, n * n * fourth_moment**2 / np.vecdot(fourth, fourth)


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
    return _standardised(*moments)


def _of_lognormal(x: npt.NDArray[Any], good: Mask) -> Floats:
    """Return skewness and excess kurtosis of log-normal samples among nulls, shape (2, row).

    They are those of the largest variance of log x that the samples allow, and NaN where log x is
    clearly not Gaussian. Up to the largest of a few thousand samples, a log-normal distribution may
    look like one of a light tail, of which most of its kurtosis lies beyond.
    """
    positive = good & (x > 0)
    n, of = np.count_nonzero(positive, axis=-1), np.count_nonzero(good, axis=-1)
    log = np.log(np.where(positive, x, 1), dtype=np.float64)
    log -= (log.sum(axis=-1) / n)[:, np.newaxis]
    log *= positive
    square = log * log
    variance = np.vecdot(log, log) / n
    skewness = np.vecdot(log, square) / n / variance**1.5
    kurtosis = np.vecdot(square, square) / n / variance**2 - 3
    clear = np.abs([skewness / np.sqrt(6 / n), kurtosis / np.sqrt(24 / n)]).max(axis=0) > _GAUSSIAN
    most = variance * (1 + _CERTAIN * np.sqrt(2 / n))
    moments = [n / of * np.exp(j * j * most / 2) for j in range(1, 5)]
    return np.where(clear, np.nan, np.abs(_standardised(*moments)))


def _standardised(
    first: Floats, second: Floats, third: Floats, fourth: Floats
) -> tuple[Floats, Floats]:
    """Return skewness and excess kurtosis from moments about 0."""
    variance = second - first**2
    about_mean = third - 3 * first * second + 2 * first**3
    fourth = fourth - 4 * first * third + 6 * first**2 * second - 3 * first**4
    return about_mean / variance**1.5, fourth / variance**2 - 3


MORE_THAN_TESTED = -1
"""As N needed: in averages of the largest N tested, normality is still rejected."""
UNTESTED = 0
"""As N needed: no answer, since samples are equal, null, bad or too few for every N."""

_CHUNK_OF_MEANS = 2**17
"""Samples worked on at once: their float64 copies stay in the cache."""


def run_on_averages(
    x: npt.NDArray[Any], bad: Mask, sizes: Counts, n_means: int, test: NormalityTest
) -> tuple[dict[str, npt.NDArray[Any]], Floats]:
    """Test the first `n_means` averages of each ascending size; `x` has shape (..., sample).

    Returns statistic, p-value, skewness, kurtosis and reason of the averages by name, each of shape
    (..., size), NaN where the reason is not OK; and skewness, kurtosis and number of the samples
    themselves, shape (3, ...), NaN where these are equal or bad.
    """
    samples, batch = x.shape[-1], x.shape[:-1]
    rows, masks = x.reshape(-1, samples), bad.reshape(-1, samples)
    found = np.empty((4, len(rows), len(sizes)))
    reason = np.empty((len(rows), len(sizes)), dtype=np.int8)
    whole = np.empty((3, len(rows)))
    # Rows that have no answer are computed, too, and masked by their reason.
    with np.errstate(all="ignore"):
        for part in spans(len(rows), max(1, _CHUNK_OF_MEANS // samples)):
            levels = list(nested_averages(rows[part], masks[part], np.union1d(1, sizes)))
            whole[:, part] = _of_samples(levels[0])
            wanted = [level for level in levels if level.size in sizes]
            found[:, part], reason[part] = _of_averages(wanted, n_means, test)
    names = ("statistic", "p_value", "skewness", "kurtosis")
    tested = dict(zip(names, found.reshape(4, *batch, len(sizes)), strict=True))
    return {**tested, "reason": reason.reshape(*batch, len(sizes))}, whole.reshape(3, *batch)


def n_needed(rejected: Mask, reason: npt.NDArray[np.int8], varied: Mask, sizes: Counts) -> Counts:
    """Return the smallest size tested from which on normality is not rejected, shape (...).

    Tested averages that are all equal, of samples that are not, are not Gaussian.
    """
    equal = np.isin(reason, [Reason.ALL_NULL, Reason.CONSTANT])
    answered = equal | (reason == Reason.OK)
    rejected_from_here_on = np.maximum.accumulate((rejected | equal)[..., ::-1], axis=-1)[..., ::-1]
    candidates = ~rejected_from_here_on & answered
    first = np.where(candidates.any(axis=-1), sizes[candidates.argmax(axis=-1)], MORE_THAN_TESTED)
    return np.where(varied & answered.any(axis=-1), first, UNTESTED).astype(np.int64)


def _of_averages(
    levels: list[Averages], n_means: int, test: NormalityTest
) -> tuple[Floats, npt.NDArray[np.int8]]:
    """Return test and shape, (4, row, size), and reasons, (row, size)."""
    tested = np.stack([level.values[:, :n_means] for level in levels], axis=1)
    n = np.full(tested.shape[:-1], n_means)
    if levels[0].formed is not None:
        formed = np.stack([np.asarray(level.formed)[:, :n_means] for level in levels], axis=1)
        tested, n = np.where(formed, tested, np.inf), np.count_nonzero(formed, axis=-1)
    tested = np.sort(tested, axis=-1)
    first, last = tested[..., 0], tested[..., -1]
    reason = first_of(
        {
            Reason.ALL_BAD: n == 0,
            Reason.TOO_FEW: n < n_means,
            Reason.ALL_NULL: last == 0,
            Reason.CONSTANT: last - first <= CONSTANT_SPREAD * last,
        }
    )
    usable = reason == Reason.OK
    results = run_tests(tested, n, usable, ("linear",), (test,))
    # Skewness and kurtosis are those of all averages, of which there are more than the tested ones.
    moments = np.array([shapes(level) for level in levels]).transpose(1, 2, 0)
    found = np.stack([results["statistic"][..., 0, 0], results["p_value"][..., 0, 0], *moments])
    found[:, ~usable] = np.nan
    return found, reason


def _of_samples(samples: Averages) -> Floats:
    """Return skewness, kurtosis and number of the samples themselves, shape (3, row)."""
    values, formed = samples.values, samples.formed
    n = np.full(len(values), float(values.shape[-1]))
    smallest = values
    if formed is not None:
        n = np.count_nonzero(formed, axis=-1).astype(np.float64)
        smallest = np.where(formed, values, 1)
    # The largest is 1, unless all are 0.
    varied = (values.max(axis=-1) > 0) & (smallest.min(axis=-1) < 1 - CONSTANT_SPREAD)
    skewness, kurtosis = (np.where(varied, shape, np.nan) for shape in shapes(samples))
    return np.stack([skewness, kurtosis, n])
