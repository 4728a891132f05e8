"""Averages of samples: their tests for several sizes at once, and what follows from these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat._positive import CONSTANT_SPREAD, Counts, Floats, Mask, PositivePart
from chdstat._reasons import Reason
from chdstat.fit.tail import Tail, tail_of_part
from chdstat.normality._cascade import Averages, cascade, shapes
from chdstat.normality._predicted import predict
from chdstat.normality._tests import NormalityTest, TestName, run_tests

__all__ = [
    "MORE_THAN_TESTED",
    "UNTESTED",
    "TestedAverages",
    "n_needed",
    "run_on_averages",
    "skewness_ratio",
]

MORE_THAN_TESTED = -1
"""As N needed: the averages of the largest N tested are still told from Gaussian."""
UNTESTED = 0
"""As N needed: no answer, since samples are equal, null, bad or too few for every N."""

_CHUNK = 2**17
"""Samples worked on at once: their float64 copies stay in the cache."""


@dataclass(frozen=True)
class GaussianityOfMeans:
    """Normality of averages of N samples, for several N; arrays of shape (..., size) or (...).

    Attributes
    ----------
    test, n_means, alpha
        What was tested, on how many averages for every N, and the level of `n_needed`.
    sizes
        The N in ascending order, shape (size,).
    statistic, p_value
        Of the test, shape (..., size); NaN where `reason` says why.
    skewness, kurtosis
        Of all complete averages, not only of the tested ones, shape (..., size). Few averages bias
        both towards 0.
    predicted_skewness, predicted_kurtosis
        What independent samples predict: ``skewness / sqrt(N)`` and ``kurtosis / N`` of all,
        shape (..., size).
    skewness_ratio
        ``skewness / predicted_skewness``, shape (..., size): 1 where the central limit theorem is
        at work. NaN where the samples' skewness is below two of its standard errors under
        normality, ``2 sqrt(6 / n)``.
    n_needed
        Smallest N tested from which on no test rejects, shape (...); -1 where the averages of the
        largest N still are told from Gaussian, 0 where there is no answer. Where all averages are
        Gaussian, it is 1 with a probability of at least 1 - `alpha`: the level of each test is
        `alpha` over the number of sizes.
    n_predicted, n_predicted_interval
        Smallest N, tested or not, at which the predicted skewness and kurtosis fall below two
        standard errors of those of `n_means` Gaussian averages, ``2 sqrt(6 / n_means)`` and
        ``2 sqrt(24 / n_means)``, shape (...), and its 95 % interval, shape (..., 2). NaN where
        there is no answer, or where the samples do not identify their kurtosis.
    n_predicted_reason
        `Reason` codes of these two, shape (...).
    reason
        `Reason` codes, shape (..., size).
    """

    test: TestName
    n_means: int
    alpha: float
    sizes: Counts
    statistic: Floats
    p_value: Floats
    skewness: Floats
    kurtosis: Floats
    predicted_skewness: Floats
    predicted_kurtosis: Floats
    skewness_ratio: Floats
    n_needed: Counts
    n_predicted: Floats
    n_predicted_interval: Floats
    n_predicted_reason: npt.NDArray[np.int8]
    reason: npt.NDArray[np.int8]


@dataclass(frozen=True)
class TestedAverages:
    """What is found of averages, shape (..., size), and of the samples themselves, shape (...).

    NaN where there is no answer: for averages, `reason` says why; samples are then equal or bad.
    """

    statistic: Floats
    p_value: Floats
    skewness: Floats
    kurtosis: Floats
    reason: npt.NDArray[np.int8]
    skewness_of_samples: Floats
    kurtosis_of_samples: Floats
    n: Floats

    @property
    def varied(self) -> Mask:
        """Where the samples are not all equal."""
        return np.isfinite(self.skewness_of_samples)


def gaussianity_of_rows(
    x: npt.NDArray[Any],
    bad: Mask,
    sizes: Counts,
    n_means: int,
    test: NormalityTest,
    alpha: float,
    tail: Tail | None = None,
) -> GaussianityOfMeans:
    """Test averages of samples, shape (..., sample), and tell the N needed and predicted."""
    predictions = predict(x, bad, tail or tail_of_part(PositivePart.of(x, bad=bad)), n_means)
    found = run_on_averages(x, bad, sizes, n_means, test)
    root = np.sqrt(sizes)
    predicted = found.skewness_of_samples[..., np.newaxis] / root
    return GaussianityOfMeans(
        test=test.name,
        n_means=n_means,
        alpha=alpha,
        sizes=sizes,
        statistic=found.statistic,
        p_value=found.p_value,
        skewness=found.skewness,
        kurtosis=found.kurtosis,
        predicted_skewness=predicted,
        predicted_kurtosis=found.kurtosis_of_samples[..., np.newaxis] / sizes,
        skewness_ratio=skewness_ratio(found, predicted),
        # Bonferroni over the sizes: else each further one would be a chance to fail.
        n_needed=n_needed(found.p_value * len(sizes) <= alpha, found.reason, found.varied, sizes),
        n_predicted=predictions.n,
        n_predicted_interval=predictions.interval,
        n_predicted_reason=predictions.reason,
        reason=found.reason,
    )


def run_on_averages(
    x: npt.NDArray[Any], bad: Mask, sizes: Counts, n_means: int, test: NormalityTest
) -> TestedAverages:
    """Test the first `n_means` averages of each ascending size; `x` has shape (..., sample)."""
    samples, batch = x.shape[-1], x.shape[:-1]
    rows, masks = x.reshape(-1, samples), bad.reshape(-1, samples)
    found = np.empty((4, len(rows), len(sizes)))
    reason = np.empty((len(rows), len(sizes)), dtype=np.int8)
    whole = np.empty((3, len(rows)))
    # Rows that have no answer are computed, too, and masked by their reason.
    with np.errstate(all="ignore"):
        for part in spans(len(rows), max(1, _CHUNK // samples)):
            levels = list(cascade(rows[part], masks[part], np.union1d(1, sizes)))
            whole[:, part] = _of_samples(levels[0])
            wanted = [level for level in levels if level.size in sizes]
            found[:, part], reason[part] = _of_averages(wanted, n_means, test)
    statistic, p_value, skewness, kurtosis = found.reshape(4, *batch, len(sizes))
    whole_skewness, whole_kurtosis, n = whole.reshape(3, *batch)
    return TestedAverages(
        statistic=statistic,
        p_value=p_value,
        skewness=skewness,
        kurtosis=kurtosis,
        reason=reason.reshape(*batch, len(sizes)),
        skewness_of_samples=whole_skewness,
        kurtosis_of_samples=whole_kurtosis,
        n=n,
    )


def skewness_ratio(found: TestedAverages, predicted: Floats) -> Floats:
    """Return measured over predicted skewness, where that of the samples is clear."""
    with np.errstate(all="ignore"):
        clear = np.abs(found.skewness_of_samples) > 2 * np.sqrt(6 / found.n)
        return np.where(clear[..., np.newaxis], found.skewness / predicted, np.nan)


def n_needed(told: Mask, reason: npt.NDArray[np.int8], varied: Mask, sizes: Counts) -> Counts:
    """Return the smallest size tested from which on none is told from Gaussian, shape (...).

    Tested averages that are all equal, of samples that are not, are told from Gaussian.
    """
    equal = np.isin(reason, [Reason.ALL_NULL, Reason.CONSTANT])
    answered = equal | (reason == Reason.OK)
    told_from_here_on = np.maximum.accumulate((told | equal)[..., ::-1], axis=-1)[..., ::-1]
    candidates = ~told_from_here_on & answered
    first = np.where(candidates.any(axis=-1), sizes[candidates.argmax(axis=-1)], MORE_THAN_TESTED)
    return np.where(varied & answered.any(axis=-1), first, UNTESTED).astype(np.int64)


def _of_averages(
    levels: list[Averages], n_means: int, test: NormalityTest
) -> tuple[Floats, npt.NDArray[np.int8]]:
    """Return test and shape, (4, row, size), and reasons, (row, size)."""
    tested, n = _first(levels, n_means)
    reason = _reasons(tested, n)
    usable = reason == Reason.OK
    results = run_tests(tested, n, usable, ("linear",), (test,))
    # Skewness and kurtosis are those of all averages, which say more than the tested ones.
    moments = np.array([shapes(level) for level in levels]).transpose(1, 2, 0)
    found = np.stack([results.statistic[..., 0, 0], results.p_value[..., 0, 0], *moments])
    found[:, ~usable] = np.nan
    return found, reason


def _first(levels: list[Averages], n_means: int) -> tuple[Floats, Counts]:
    """Return the first averages of each size, shape (row, size, average), sorted, and how many."""
    tested = np.stack([level.values[:, :n_means] for level in levels], axis=1)
    if levels[0].formed is None:
        return np.sort(tested, axis=-1), np.full(tested.shape[:-1], n_means)
    formed = np.stack([np.asarray(level.formed)[:, :n_means] for level in levels], axis=1)
    return np.sort(np.where(formed, tested, np.inf), axis=-1), np.count_nonzero(formed, axis=-1)


def _reasons(ascending: Floats, n: Counts) -> npt.NDArray[np.int8]:
    first, last = ascending[..., 0], ascending[..., -1]
    cases = {
        Reason.ALL_BAD: n == 0,
        Reason.TOO_FEW: n < ascending.shape[-1],
        Reason.ALL_NULL: last == 0,
        Reason.CONSTANT: last - first <= CONSTANT_SPREAD * last,
    }
    codes = [np.int8(code) for code in cases]
    return np.asarray(np.select(list(cases.values()), codes, np.int8(Reason.OK)), dtype=np.int8)


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
