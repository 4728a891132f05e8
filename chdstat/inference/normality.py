"""Normality: how far samples and their logarithms are from Gaussian.

Use `gaussianity` on the positive samples of a CHD, `gaussianity_of_means` on pixel estimates. At
2048 spp nearly every p-value is tiny: read skewness and kurtosis beside it.

Which test? Shapiro-Wilk is among the most powerful against every shape that CHDs have, and best
with few samples. Anderson-Darling looks at the whole distribution function, which suits modes.
D'Agostino's K^2 looks at skewness and kurtosis alone. The gallery has the power curves.

`TESTS` is the table of tests; `run_tests` runs them on many rows at once, each with its own number
of samples, and transforms and standardises sorted rows once for each transform.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, spans
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import Result, Statistic, result, variable
from chdstat.errors import InputError, Reason, check_option, check_probability
from chdstat.inference import statistics
from chdstat.inference.statistics import Standardised, standardise
from chdstat.summary.runner import Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "TESTS",
    "TRANSFORMS",
    "Gaussianity",
    "Normality",
    "NormalityTest",
    "TestName",
    "Transform",
    "gaussianity",
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
    statistic: Callable[[Standardised], Floats]
    p_value: Callable[[Floats, Counts], Floats]


TESTS: Mapping[TestName, NormalityTest] = {
    test.name: test
    for test in (
        NormalityTest(
            "anderson-darling",
            8,
            statistics.anderson_darling,
            partial(statistics.simulated_p, "anderson_darling"),
        ),
        NormalityTest("shapiro-wilk", 8, statistics.shapiro_wilk, statistics.shapiro_wilk_p),
        NormalityTest(
            "dagostino", 20, statistics.dagostino, partial(statistics.simulated_p, "dagostino")
        ),
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


def run_tests(
    ascending: npt.NDArray[Any],
    n: Counts,
    usable: Mask,
    transforms: Sequence[Transform],
    tests: Sequence[NormalityTest],
) -> dict[str, Floats]:
    """Test rows of shape (..., sample) in ascending order, of which the first `n` of each count.

    What stands behind them does not matter. Rows that are not `usable`, or have too few samples for
    a test, get NaN. Returns statistic and p_value, shape (..., transform, test), and skewness and
    kurtosis, shape (..., transform), by name.
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
    found = {"statistic": statistic, "p_value": p_value}
    found |= {"skewness": moments[0], "kurtosis": moments[1]}
    return {name: values.reshape(*n.shape, *values.shape[1:]) for name, values in found.items()}


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


@result
class Gaussianity(Result):
    """Tests of normality with their effect sizes; arrays of the batch's shape, (...).

    Where several transforms or tests were asked for, they are further axes, in this order.

    Attributes
    ----------
    test, transform
        What was tested, and on what: a name, or the names along the axis.
    statistic, p_value
        Of the test, shape (... [, transform] [, test]); NaN where `reason` says why.
    skewness, kurtosis
        Of the transformed samples, the kurtosis excess: both 0 for a Gaussian; (... [, transform]).
    n
        Samples that were tested, shape (...).
    reason
        `Reason` codes, shape (... [, test]), since the tests need different numbers of samples.
    """

    test: TestName | tuple[TestName, ...]
    transform: Transform | tuple[Transform, ...]
    statistic: Floats = variable("test statistic of normality", "transform", "test")
    p_value: Floats = variable(
        "p-value of normality",
        "transform",
        "test",
        pooled=True,
        rejected="1 where not Gaussian, at the false discovery rate of the dataset",
    )
    skewness: Floats = variable("skewness of what was tested", "transform")
    kurtosis: Floats = variable("excess kurtosis of what was tested", "transform")
    n: Counts = variable("samples that were tested")
    reason: npt.NDArray[np.int8] = variable("why there is no test", "test")


@dataclass(frozen=True)
class Normality(Statistic[Gaussianity]):
    """Tests of normality of the positive samples; options as of `gaussianity`."""

    result: ClassVar = Gaussianity
    description: ClassVar = "testing normality"

    transform: Transform | tuple[Transform, ...] = "log"
    test: TestName | tuple[TestName, ...] = "anderson-darling"
    alpha: float = 0.05

    def __post_init__(self) -> None:
        tables: dict[str, Iterable[str]] = {"transform": TRANSFORMS, "test": TESTS}
        for name, table in tables.items():
            choice = getattr(self, name)
            choices = (choice,) if isinstance(choice, str) else choice
            if not choices or len(set(choices)) < len(choices):
                message = f"{name} must be a name or several different ones, got {choice!r}"
                raise InputError(message)
            for each in choices:
                check_option(name, each, table)
        check_probability(alpha=self.alpha)

    def coordinates(self) -> dict[str, tuple[str, ...] | None]:
        """Return the transforms and the tests, where there are several of them."""
        choices = {"transform": self.transform, "test": self.test}
        return {n: None if isinstance(choice, str) else choice for n, choice in choices.items()}

    def attrs(self) -> dict[str, Any]:
        """Return what was tested, and the level of ``rejected``."""
        tests, transforms = (
            choice if isinstance(choice, str) else ", ".join(choice)
            for choice in (self.test, self.transform)
        )
        return {"test": f"{tests} on {transforms} samples", "false_discovery_rate": self.alpha}

    def measure(self, part: PositivePart) -> Gaussianity:
        """Test each row; an option of which there is only a name has no axis."""
        transforms = (self.transform,) if isinstance(self.transform, str) else self.transform
        names = (self.test,) if isinstance(self.test, str) else self.test
        tests = [TESTS[name] for name in names]
        reason = np.stack([part.reason(test.minimum) for test in tests], axis=-1)
        usable = (reason == Reason.OK).any(axis=-1)
        found = run_tests(part.sorted, part.n, usable, transforms, tests)
        i, j = (0 if isinstance(c, str) else slice(None) for c in (self.transform, self.test))
        return Gaussianity(
            test=self.test,
            transform=self.transform,
            statistic=found["statistic"][..., i, j],
            p_value=found["p_value"][..., i, j],
            skewness=found["skewness"][..., i],
            kurtosis=found["kurtosis"][..., i],
            n=part.n,
            reason=reason[..., j],
        )


@of_source
def gaussianity(
    x: Source,
    *,
    transform: Transform | Sequence[Transform] = "log",
    test: TestName | Sequence[TestName] = "anderson-darling",
    null: npt.ArrayLike | None = None,
    alpha: float = 0.05,
    progress: bool | None = None,
) -> Gaussianity | xr.Dataset:
    """Test whether the positive samples, transformed, are Gaussian, mean and variance unknown.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`. Nulls, zeros and bad samples take no part, whatever the transform.
    transform
        'log' asks whether the CHD is log-normal; 'sqrt', 'linear'; or several of them.
    test
        One of the tests below, or several: they share most of the work.
    alpha
        For `Samples`: false discovery rate of ``rejected``.

    Returns
    -------
    Gaussianity or xarray.Dataset
        `Gaussianity` for an array. For `Samples`, its fields over (y, x, channel [, transform]
        [, test]), the q-value of Benjamini and Hochberg over the image for every channel, transform
        and test separately, and ``rejected``: 1 where it is at most `alpha`, 0 where it is not, NaN
        where nothing was tested.

    Raises
    ------
    InputError
        If an option is unknown.

    Notes
    -----
    ================  ============================================================  =======
    test              statistic                                                     samples
    ================  ============================================================  =======
    anderson-darling  A^2: squared distance of the distribution functions, tails    8
                      weighted up
    shapiro-wilk      W: squared correlation with Gaussian order statistics         8
    dagostino         K^2: sum of the squared normal scores of skewness, kurtosis   20
    ================  ============================================================  =======

    All p-values are those of estimated mean and variance and of the number of samples at hand:
    uniform under the null, within 0.015. They are interpolated between quantiles simulated for 8 to
    5000 samples (Shapiro-Wilk: up to 32 000; from 30 to 2000 samples, Royston's formulas serve).
    Below 1e-4 they are extrapolated, on the side of too large a p, and none is below 1e-16.

    References
    ----------
    D'Agostino and Stephens, "Goodness-of-fit techniques", 1986, chapter 4
    (Anderson-Darling). Royston, "Remark AS R94: a remark on algorithm AS 181: the W-test for
    normality", 1995, doi:10.2307/2986146. D'Agostino and Pearson, "Tests for departure from
    normality", 1973, doi:10.1093/biomet/60.3.613.

    Examples
    --------
    >>> x = np.random.default_rng(1).lognormal(size=1000)
    >>> bool(gaussianity(x).p_value > 0.05), bool(gaussianity(x, transform="linear").p_value < 1e-9)
    (True, True)
    >>> both = gaussianity(x, transform=("log", "sqrt"), test=("shapiro-wilk", "dagostino"))
    >>> both.p_value > 0.05
    array([[ True,  True],
           [False, False]])
    """
    transforms = transform if isinstance(transform, str) else tuple(transform)
    tests = test if isinstance(test, str) else tuple(test)
    return run(Normality(transforms, tests, alpha), x, null=null, progress=progress)
