"""Tests of normality on many rows at once, each with its own number of samples.

`TESTS` is the table; `run_tests` transforms and standardises sorted rows once for each transform,
and runs any of the tests on them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat._positive import Counts, Floats, Mask
from chdstat.normality import _p_values as p_values
from chdstat.normality import _statistics as statistics
from chdstat.normality._statistics import Rows, standardise

__all__ = [
    "TESTS",
    "TRANSFORMS",
    "NormalityTest",
    "TestName",
    "Tested",
    "Transform",
    "run_tests",
]

TestName = Literal["anderson-darling", "shapiro-wilk", "dagostino"]
Transform = Literal["log", "linear", "sqrt"]

_CHUNK = 2**17
"""Samples worked on at once: their float64 copies stay in the cache."""
_ROWS = 2**11
"""Rows whose p-values are computed at once."""


@dataclass(frozen=True)
class NormalityTest:
    """A row of `TESTS`: statistic of standardised rows, its p-value, and the samples it needs."""

    name: TestName
    minimum: int
    statistic: Callable[[Rows], Floats]
    p_value: Callable[[Floats, Counts], Floats]


TESTS: Mapping[TestName, NormalityTest] = {
    test.name: test
    for test in (
        NormalityTest(
            "anderson-darling", 8, statistics.anderson_darling, p_values.anderson_darling_p
        ),
        NormalityTest("shapiro-wilk", 8, statistics.shapiro_wilk, p_values.shapiro_wilk_p),
        NormalityTest("dagostino", 20, statistics.dagostino, p_values.dagostino_p),
    )
}
"""Tests of normality by name. A new one is a new row."""

TRANSFORMS: Mapping[Transform, Callable[[Floats, Floats], Floats]] = {
    # Tests of location and scale do not see the unit: relative to the largest of a row, shape
    # (row, 1), no power of a sample overflows and no row vanishes.
    "log": lambda x, _largest: np.log(x),
    "linear": lambda x, largest: np.divide(x, largest),
    "sqrt": lambda x, largest: np.sqrt(x / largest),
}
"""What the samples may be turned into before a test; increasing, on positive numbers."""


@dataclass(frozen=True)
class Tested:
    """Statistic and p-value, shape (..., transform, test); the moments, shape (..., transform)."""

    statistic: Floats
    p_value: Floats
    skewness: Floats
    kurtosis: Floats


def run_tests(
    ascending: npt.NDArray[Any],
    n: Counts,
    usable: Mask,
    transforms: Sequence[Transform],
    tests: Sequence[NormalityTest],
) -> Tested:
    """Test rows of shape (..., sample) in ascending order, of which the first `n` of each count.

    What stands behind them does not matter. Rows that are not `usable`, or have too few samples for
    a test, get NaN.
    """
    rows, counts = ascending.reshape(-1, ascending.shape[-1]), n.reshape(-1)
    shape = (len(transforms), len(tests))
    statistic = np.full((len(rows), *shape), np.nan)
    p_value = np.full((len(rows), *shape), np.nan)
    moments = np.full((2, len(rows), len(transforms)), np.nan)
    with np.errstate(all="ignore"):
        for part in _chunks(counts, usable.reshape(-1)):
            x, left_out, largest = _copied(rows, counts, part)
            for i, transform in enumerate(transforms):
                y = TRANSFORMS[transform](x, largest)
                standard = standardise(y, counts[part], left_out)
                moments[:, part, i] = standard.skewness, standard.kurtosis
                for j, test in enumerate(tests):
                    enough = standard.n >= test.minimum
                    statistic[part, i, j] = np.where(enough, test.statistic(standard), np.nan)
        # Of many rows at once: a p-value takes many operations on few numbers.
        for span in spans(len(rows), _ROWS):
            for i, j in np.ndindex(shape):
                p_value[span, i, j] = tests[j].p_value(statistic[span, i, j], counts[span])
    tested = (values.reshape(*n.shape, *values.shape[1:]) for values in (statistic, p_value))
    return Tested(*tested, *moments.reshape(2, *n.shape, shape[0]))


def _chunks(n: Counts, usable: Mask) -> Iterator[npt.NDArray[np.intp]]:
    """Yield rows of about the same number of samples, so that little is computed in vain."""
    order = np.flatnonzero(usable)
    order = order[np.argsort(-n[order], kind="stable")]
    start = 0
    while start < len(order):
        stop = start + max(1, _CHUNK // max(1, int(n[order[start]])))
        yield order[start:stop]
        start = stop


def _copied(
    rows: npt.NDArray[Any], n: Counts, part: npt.NDArray[np.intp]
) -> tuple[Floats, Mask | None, Floats]:
    """Return the samples, 1 behind the last; what stands there; and the largest, shape (row, 1)."""
    count = n[part]
    x = rows[part, : count[0]].astype(np.float64)
    largest = x[np.arange(len(x)), count - 1][:, np.newaxis]
    if count[-1] == count[0]:
        return x, None, largest
    left_out = np.arange(x.shape[-1]) >= count[:, np.newaxis]
    np.copyto(x, 1, where=left_out)
    return x, left_out, largest
