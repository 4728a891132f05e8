"""Normality: how far samples and their logarithms are from Gaussian.

Use `gaussianity` on the positive samples of a CHD, and `gaussianity_of_means` on pixel estimates.
At 2048 spp, nearly every p-value is tiny: also read skewness and kurtosis.

Which test? Shapiro-Wilk is among the most powerful tests against every shape that CHDs have, and
the best one with few samples. Anderson-Darling looks at the whole distribution function, which
suits modes. D'Agostino's K^2 looks at skewness and kurtosis alone. The gallery has the power
curves.

`TESTS` is the table of tests. `run_tests` runs them on many rows at once, each with its own number
of samples. It transforms and standardises sorted rows once per transform.

P-values hold for estimated mean and variance. They are interpolated between simulated quantiles,
since the published approximations are not uniform under the null:

- D'Agostino and Pearson: for 100 samples, the chi-square approximation gives p = 0.001 in 0.004 of
  the cases.
- Anderson-Darling: Stephens' formulas are off by 0.03 near p = 0.6.
- Shapiro-Wilk: Royston's formulas are used for 30 to 2000 samples. They are within 0.013 of p, and
  within 7 % of it down to p = 0.01.

A table of `QUANTILES` has a row for each of `LEVELS`, the probability above the quantile. The row
holds the coefficients of the quantile as a polynomial in 1 / sqrt(n), so that it holds for any
number of samples.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import Counts, Floats, Mask, rows_by_count, spans
from chdstat._core.display import as_p
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import Quantity, Result, Statistic, result, variable
from chdstat.errors import InputError, Reason, check_option, check_probability
from chdstat.summary.runner import Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr

TestName = Literal["anderson-darling", "shapiro-wilk", "dagostino"]
Transform = Literal["log", "linear", "sqrt"]

_ROWS = 2**11
"""Rows whose p-values are computed together."""


@dataclass(frozen=True)
class _Standardised:
    """Samples in ascending order, shape (row, sample), of which the first `n` of each row count.

    ``z`` are the standardised samples (divisor n - 1), 0 after the last. Skewness and excess
    kurtosis are those of the sample (divisor n). ``left_out`` marks the places after the last
    sample; it is None if there are none.
    """

    z: Floats
    n: Counts
    left_out: Mask | None
    skewness: Floats
    kurtosis: Floats


def standardise(y: Floats, n: Counts, left_out: Mask | None) -> _Standardised:
    """Standardise ascending rows in place; values after the samples must be finite."""
    if left_out is not None:
        np.copyto(y, 0, where=left_out)
    y -= (y.sum(axis=-1) / n)[:, np.newaxis]
    if left_out is not None:
        np.copyto(y, 0, where=left_out)
    # Multiplication takes a fraction of the time of division.
    y *= (1 / np.sqrt(np.vecdot(y, y) / (n - 1)))[:, np.newaxis]
    square = y * y
    variance = (n - 1) / n
    return _Standardised(
        z=y,
        n=n,
        left_out=left_out,
        skewness=np.vecdot(y, square) / n / variance**1.5,
        kurtosis=np.vecdot(square, square) / n / variance**2 - 3,
    )


def anderson_darling(rows: _Standardised) -> Floats:
    """Return A^2 (Anderson and Darling 1954, doi:10.1080/01621459.1954.10501232)."""
    n = rows.n[:, np.newaxis].astype(np.float64)
    # The smaller of Phi(z) and 1 - Phi(z) carries the digits.
    smaller = np.maximum(special.ndtr(-np.abs(rows.z)), np.finfo(np.float64).tiny)
    near, far = np.log(smaller), np.log1p(-smaller)
    # Log Phi has the weight 2 i - 1, log(1 - Phi) the rest of 2 n.
    near -= far
    weight = (rows.z >= 0) * (2 * n)
    weight -= 2 * np.arange(rows.z.shape[-1]) + 1
    near *= np.abs(weight, out=weight)
    far *= 2 * n
    near += far
    if rows.left_out is not None:
        np.copyto(near, 0, where=rows.left_out)
    return np.asarray(-rows.n - near.sum(axis=-1) / rows.n)


def dagostino(rows: _Standardised) -> Floats:
    """Return K^2, the sum of two squared normal scores (D'Agostino and Pearson 1973)."""
    n = rows.n.astype(np.float64)
    scores = _skewness_score(rows.skewness, n), _kurtosis_score(rows.kurtosis + 3, n)
    return np.asarray(scores[0] ** 2 + scores[1] ** 2)


def _shapiro_wilk(rows: _Standardised) -> Floats:
    """Return W with the weights of Royston 1995, for rows in ascending order of `n`."""
    starts = np.flatnonzero(np.diff(rows.n, prepend=-1))
    statistic = np.empty(len(rows.n))
    for start, stop in zip(starts, [*starts[1:], len(rows.n)], strict=True):
        n = int(rows.n[start])
        statistic[start:stop] = (rows.z[start:stop, :n] @ _weights(n)) ** 2 / (n - 1)
    return np.minimum(statistic, 1)


@lru_cache(maxsize=512)
def _weights(n: int) -> Floats:
    """Return the weights of the ascending samples (Royston 1995, AS R94, for n > 5)."""
    half = special.ndtri((np.arange(1, n // 2 + 1) - 0.375) / (n + 0.25))
    total = 2 * float(half @ half)
    powers = n ** (-0.5 * np.arange(6))
    last = powers @ [0, 0.221157, -0.147981, -2.07119, 4.434685, -2.706056]
    next_to_last = powers @ [0, 0.042981, -0.293762, -1.752461, 5.682633, -3.582633]
    outer = half[:2] / np.sqrt(total) - [last, next_to_last]
    scale = (total - 2 * half[:2] @ half[:2]) / (1 - 2 * outer @ outer)
    weights = np.zeros(n)
    weights[: n // 2] = half / np.sqrt(scale)
    weights[:2] = outer
    weights[n - n // 2 :] = -weights[: n // 2][::-1]
    weights.flags.writeable = False
    return weights


def _skewness_score(skewness: Floats, n: Floats) -> Floats:
    """Return the normal score of a skewness (D'Agostino 1970, doi:10.1093/biomet/57.3.679)."""
    y = skewness * np.sqrt((n + 1) * (n + 3) / (6 * (n - 2)))
    beta = 3 * (n**2 + 27 * n - 70) * (n + 1) * (n + 3) / ((n - 2) * (n + 5) * (n + 7) * (n + 9))
    w2 = np.sqrt(2 * (beta - 1)) - 1
    return np.asarray(np.arcsinh(y * np.sqrt((w2 - 1) / 2)) / np.sqrt(0.5 * np.log(w2)))


def _kurtosis_score(b2: Floats, n: Floats) -> Floats:
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


_FLOOR = 1e-16
"""Smallest p-value that is returned."""


def interpolated_p(scaled: Floats, n: Counts, coefficients: Floats, floor: float) -> Floats:
    """Return P(larger statistic), but at least `floor`.

    The log odds of p are linear in the statistic between quantiles and beyond the table.

    Parameters
    ----------
    scaled
        Statistics, scaled as for the table, shape (row,).
    n
        Number of samples, shape (row,).
    coefficients
        Coefficients of the quantiles, shape (level, power of 1 / sqrt(n)).
    """
    powers = n[:, np.newaxis] ** (-0.5 * np.arange(coefficients.shape[-1]))
    quantiles = np.maximum.accumulate(powers @ coefficients.T, axis=-1)
    right = np.count_nonzero(quantiles <= scaled[:, np.newaxis], axis=-1)
    right = np.clip(right, 1, len(LEVELS) - 1)
    row = np.arange(len(right))
    low, high = quantiles[row, right - 1], quantiles[row, right]
    odds = special.logit(LEVELS)
    slope = (odds[right] - odds[right - 1]) / (high - low)
    p = special.expit(odds[right - 1] + slope * (scaled - low))
    return np.asarray(np.where(p < floor, floor, p))


@dataclass(frozen=True, eq=False)
class NormalityTest:
    """A row of `TESTS`.

    Attributes
    ----------
    name, minimum
        Name for users, and fewest samples.
    statistic
        Returns the statistic of standardised rows.
    scaled
        Returns the number whose quantiles were simulated, from the statistic and n; larger is less
        Gaussian.
    """

    name: TestName
    minimum: int
    statistic: Callable[[_Standardised], Floats]
    scaled: Callable[[Floats, Floats], Floats]

    def p_value(self, statistic: Floats, n: Counts) -> Floats:
        """Return p-values by simulation.

        For Anderson-Darling, the statistic is A*^2 (D'Agostino and Stephens 1986, chapter 4). For
        K^2, the two normal scores are uncorrelated but not independent.
        """
        scaled = self.scaled(statistic, n.astype(np.float64))
        return interpolated_p(scaled, n, QUANTILES[self.name], _FLOOR)


class _ShapiroWilk(NormalityTest):
    """The row of W, which has a formula for p-values."""

    def p_value(self, statistic: Floats, n: Counts) -> Floats:
        """Return p-values of W (Royston 1995, AS R94), simulated where his formulas are worse.

        At 5000 samples, his p is below 0.05 in 0.044 of the cases.
        """
        log_n = np.log(n)
        mean = np.polyval([0.0038915, -0.083751, -0.31082, -1.5861], log_n)
        deviation = np.exp(np.polyval([0.0030302, -0.082676, -0.4803], log_n))
        p = special.ndtr((mean - np.log1p(-statistic)) / deviation)
        p[p < _FLOOR] = _FLOOR
        outside = (n < 30) | (n > 2000)
        if outside.any():
            p[outside] = super().p_value(statistic[outside], n[outside])
        return np.asarray(p)


TRANSFORMS: Mapping[Transform, Callable[[Floats, Floats], Floats]] = {
    # Tests of location and scale do not see the unit. Relative to the largest of a row, shape (row,
    # 1), no power of a sample overflows and no row vanishes.
    "log": lambda x, _largest: np.log(x),
    "linear": lambda x, largest: np.divide(x, largest),
    "sqrt": lambda x, largest: np.sqrt(x / largest),
}
"""Transforms of the samples before a test; they increase on positive numbers."""


def run_tests(
    ascending: npt.NDArray[Any],
    n: Counts,
    usable: Mask,
    transforms: Sequence[Transform],
    tests: Sequence[NormalityTest],
) -> dict[str, Floats]:
    """Test rows of shape (..., sample) in ascending order, of which the first `n` of each count.

    Values after them do not matter. Rows that are not `usable`, or have too few samples for a test,
    are NaN. Return statistic and p_value, shape (..., transform, test), and skewness and kurtosis,
    shape (..., transform), by name.
    """
    rows, counts = ascending.reshape(-1, ascending.shape[-1]), n.reshape(-1)
    shape = (len(transforms), len(tests))
    statistic = np.full((len(rows), *shape), np.nan)
    p_value = np.full((len(rows), *shape), np.nan)
    moments = np.full((2, len(rows), len(transforms)), np.nan)
    for part in rows_by_count(counts, usable.reshape(-1), rows.shape[-1]):
        x, left_out, largest = _copied(rows, counts, part)
        for i, transform in enumerate(transforms):
            y = TRANSFORMS[transform](x, largest)
            standard = standardise(y, counts[part], left_out)
            moments[:, part, i] = standard.skewness, standard.kurtosis
            for j, test in enumerate(tests):
                enough = standard.n >= test.minimum
                statistic[part, i, j] = np.where(enough, test.statistic(standard), np.nan)
    # For many rows at once: a p-value takes many operations on few numbers.
    for span in spans(len(rows), _ROWS):
        for i, j in np.ndindex(shape):
            p_value[span, i, j] = tests[j].p_value(statistic[span, i, j], counts[span])
    found = {"statistic": statistic, "p_value": p_value}
    found |= {"skewness": moments[0], "kurtosis": moments[1]}
    return {name: values.reshape(*n.shape, *values.shape[1:]) for name, values in found.items()}


def _copied(
    rows: npt.NDArray[Any], n: Counts, part: npt.NDArray[np.intp]
) -> tuple[Floats, Mask | None, Floats]:
    """Return the samples, 1 after the last; the places after it; and the largest, (row, 1)."""
    count = n[part]
    x = rows[part, : count[-1]].astype(np.float64)
    largest = x[np.arange(len(x)), count - 1][:, np.newaxis]
    if count[-1] == count[0]:
        return x, None, largest
    left_out = np.arange(x.shape[-1]) >= count[:, np.newaxis]
    np.copyto(x, 1, where=left_out)
    return x, left_out, largest


@result
class Gaussianity(Result):
    """Tests of normality with their effect sizes; arrays of the batch's shape, (...).

    Several transforms or tests are further axes, in this order.

    Attributes
    ----------
    test, transform
        Name of the test and of the transform, or the names along their axis.
    statistic, p_value
        Statistic and p-value of the test, shape (... [, transform] [, test]); NaN where `reason`
        says why.
    skewness, kurtosis
        Skewness and excess kurtosis of the transformed samples, both 0 for a Gaussian; shape (...
        [, transform]).
    n
        Number of samples tested, shape (...).
    reason
        `Reason` codes, shape (... [, test]): the tests need different numbers of samples.
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
    """Tests of normality of the positive samples; options as in `gaussianity`."""

    result: ClassVar = Gaussianity
    description: ClassVar = "testing normality"
    quantities: ClassVar = (
        Quantity(
            "p of log-normal (Anderson–Darling)", lambda found, i: as_p(found.p_value[i, 0, 0])
        ),
        Quantity("p of normal (Anderson–Darling)", lambda found, i: as_p(found.p_value[i, 1, 0])),
    )

    transform: Transform | tuple[Transform, ...] = "log"
    test: TestName | tuple[TestName, ...] = "anderson-darling"
    alpha: float = 0.05

    @classmethod
    def of_pixel(cls, spp: int) -> Self:  # noqa: ARG003 - any number will do
        """Return the tests of the logarithms and of the samples."""
        return cls(("log", "linear"), ("anderson-darling",))

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
        """Return the transforms and the tests, if there are several of them."""
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
        """Test each row; an option that is a single name has no axis."""
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
    progress: bool = True,
) -> Gaussianity | xr.Dataset:
    """Test whether the transformed positive samples are Gaussian, with unknown mean and variance.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`. Nulls, zeros and bad samples are left out for every transform.
    transform
        'log', which asks whether the CHD is log-normal, 'sqrt' or 'linear'; or several of them.
    test
        One of the tests below, or several, which share most of the work.
    alpha
        For `Samples`: false discovery rate of ``rejected``.

    Returns
    -------
    Gaussianity or xarray.Dataset
        `Gaussianity` for an array. For `Samples`, its fields over (y, x, channel [, transform] [,
        test]). Added are q-values (Benjamini and Hochberg) over the image, for every channel,
        transform and test separately, and ``rejected``: 1 where the q-value is at most `alpha`, 0
        where it is not, NaN where nothing was tested.

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

    P-values account for the estimated mean and variance and for the number of samples: under the
    null, they are uniform within 0.015. They are interpolated between quantiles simulated for 8 to
    5000 samples (Shapiro-Wilk: up to 32 000, with Royston's formulas from 30 to 2000 samples).
    Below 1e-4 they are extrapolated, and rather too large. None is below 1e-16.

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


_TABLES: dict[str, list[Any]] = json.loads(
    Path(__file__).with_name("null_quantiles.json").read_text(encoding="utf-8")
)
QUANTILES = {name: np.array(rows) for name, rows in _TABLES.items()}
"""Coefficients of simulated quantiles by statistic, shape (level, power of 1 / sqrt(n)).

`tools/make_normality_tables.py` and `tools/make_dip_table.py` make them.
"""
LEVELS = QUANTILES.pop("levels")
"""Probabilities above the quantiles."""

TESTS: Mapping[TestName, NormalityTest] = {
    test.name: test
    for test in (
        # Stephens 1974, doi:10.1080/01621459.1974.10480196: hardly depends on n.
        NormalityTest(
            "anderson-darling", 8, anderson_darling, lambda a, n: a * (1 + 0.75 / n + 2.25 / n**2)
        ),
        # A smaller W is less Gaussian; n (1 - W) grows slowly.
        _ShapiroWilk("shapiro-wilk", 8, _shapiro_wilk, lambda w, n: np.log(n * (1 - w))),
        NormalityTest("dagostino", 20, dagostino, lambda k2, _n: np.sqrt(k2)),
    )
}
"""Tests of normality by name."""
