"""Tests of normality on many rows at once, each with its own number of samples.

`TESTS` is the table; `run_test` transforms and standardises sorted rows and runs one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._arrays import spans
from chdstat._positive import Counts, Floats, Mask

__all__ = ["TESTS", "NormalityTest", "Rows", "run_test"]

_CHUNK = 2**16
"""Samples worked on at once: their float64 copies stay in the cache."""


@dataclass(frozen=True)
class Rows:
    """Samples in ascending order, shape (row, sample), of which the first `n` of each row count.

    ``z`` are the standardised samples, 0 behind the last; skewness and kurtosis are those of
    the sample (divisor n), the kurtosis excess.
    """

    z: Floats
    n: Counts
    valid: Mask
    skewness: Floats
    kurtosis: Floats


@dataclass(frozen=True)
class NormalityTest:
    """A row of `TESTS`: a statistic and a p-value for every row, and the samples it needs."""

    name: str
    minimum: int
    run: Callable[[Rows], tuple[Floats, Floats]]


def run_test(
    ascending: npt.NDArray[Any],
    n: Counts,
    transform: Callable[[Floats], Floats],
    test: NormalityTest,
) -> Floats:
    """Return statistic, p-value, skewness and kurtosis of transformed rows, shape (4, ...).

    `ascending` has shape (..., sample), of which the first `n` of each row count; what stands
    behind them does not matter.
    """
    samples = ascending.shape[-1]
    rows, counts = ascending.reshape(-1, samples), n.reshape(-1)
    results = np.empty((4, len(rows)))
    # Rows that cannot be tested are computed, too, and masked by their reason.
    with np.errstate(all="ignore"):
        for part in spans(len(rows), max(1, _CHUNK // samples)):
            standard = _standardise(rows[part], counts[part], transform)
            results[:, part] = (*test.run(standard), standard.skewness, standard.kurtosis)
    return results.reshape(4, *n.shape)


def _standardise(
    ascending: npt.NDArray[Any], n: Counts, transform: Callable[[Floats], Floats]
) -> Rows:
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    y = ascending.astype(np.float64)
    np.copyto(y, 1, where=~valid)
    y = transform(y)
    np.copyto(y, 0, where=~valid)
    y -= (y.sum(axis=-1) / n)[:, np.newaxis]
    np.copyto(y, 0, where=~valid)
    y /= np.sqrt(np.vecdot(y, y) / (n - 1))[:, np.newaxis]
    square = y * y
    variance = (n - 1) / n
    return Rows(
        z=y,
        n=n,
        valid=valid,
        skewness=np.vecdot(y, square) / n / variance**1.5,
        kurtosis=np.vecdot(square, square) / n / variance**2 - 3,
    )


def _anderson_darling(rows: Rows) -> tuple[Floats, Floats]:
    n = rows.n[:, np.newaxis]
    rank = np.arange(1, rows.z.shape[-1] + 1)
    # Of each sample, the smaller of Phi and 1 - Phi carries the digits.
    smaller = np.maximum(special.ndtr(-np.abs(rows.z)), np.finfo(np.float64).tiny)
    near, far = np.log(smaller), np.log1p(-smaller)
    # The two weights of a sample, 2 i - 1 for Phi and 2 (n - i) + 1 for 1 - Phi, add up to 2 n.
    weight = np.where(rows.z < 0, 2 * rank - 1, 2 * (n - rank) + 1)
    terms = weight * (near - far) + 2 * n * far
    statistic = -rows.n - np.where(rows.valid, terms, 0).sum(axis=-1) / rows.n
    return statistic, _anderson_darling_p(statistic * (1 + 0.75 / rows.n + 2.25 / rows.n**2))


def _anderson_darling_p(a: Floats) -> Floats:
    """Return p-values of A*^2 (D'Agostino and Stephens 1986, table 4.9)."""
    # Beyond 10 the fit is extrapolated: its answer there, 4e-24, is a bound.
    a = np.minimum(a, 10)
    return np.select(
        [a >= 0.6, a >= 0.34, a >= 0.2],
        [
            np.exp(1.2937 - 5.709 * a + 0.0186 * a**2),
            np.exp(0.9177 - 4.279 * a - 1.38 * a**2),
            1 - np.exp(-8.318 + 42.796 * a - 59.938 * a**2),
        ],
        1 - np.exp(-13.436 + 101.14 * a - 223.73 * a**2),
    )


def _dagostino(rows: Rows) -> tuple[Floats, Floats]:
    n = rows.n.astype(np.float64)
    statistic = _skewness_z(rows.skewness, n) ** 2 + _kurtosis_z(rows.kurtosis + 3, n) ** 2
    return statistic, np.exp(-statistic / 2)


def _skewness_z(skewness: Floats, n: Floats) -> Floats:
    """Return the normal score of a skewness (D'Agostino 1970, doi:10.1093/biomet/57.3.679)."""
    y = skewness * np.sqrt((n + 1) * (n + 3) / (6 * (n - 2)))
    beta = 3 * (n**2 + 27 * n - 70) * (n + 1) * (n + 3) / ((n - 2) * (n + 5) * (n + 7) * (n + 9))
    w2 = np.sqrt(2 * (beta - 1)) - 1
    return np.asarray(np.arcsinh(y * np.sqrt((w2 - 1) / 2)) / np.sqrt(0.5 * np.log(w2)))


def _kurtosis_z(b2: Floats, n: Floats) -> Floats:
    """Return the normal score of a kurtosis (Anscombe and Glynn 1983, doi:10.2307/2335960)."""
    expected = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    x = (b2 - expected) / np.sqrt(variance)
    root_beta = (6 * (n**2 - 5 * n + 2) / ((n + 7) * (n + 9))) * np.sqrt(
        6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3))
    )
    a = 6 + 8 / root_beta * (2 / root_beta + np.sqrt(1 + 4 / root_beta**2))
    cube = (1 - 2 / a) / (1 + x * np.sqrt(2 / (a - 4)))
    return np.asarray((1 - 2 / (9 * a) - np.cbrt(cube)) / np.sqrt(2 / (9 * a)))


TESTS: Mapping[str, NormalityTest] = {
    test.name: test
    for test in (
        NormalityTest("anderson-darling", 8, _anderson_darling),
        NormalityTest("dagostino", 20, _dagostino),
    )
}
"""Tests of normality by name. A new one is a new row."""
