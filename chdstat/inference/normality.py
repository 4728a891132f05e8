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

A table of quantiles has a row for each of `LEVELS`, the probability above the quantile. The row
holds the coefficients of the quantile as a polynomial in 1 / sqrt(n), so that it holds for any
number of samples. The tables of `TESTS` are simulated by tools/make_normality_tables.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import Counts, Floats, Mask, rows_by_count, spans
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import Result, Statistic, result, variable
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
    quantiles
        Coefficients of the scaled quantiles, shape (level, power of 1 / sqrt(n)).
    """

    name: TestName
    minimum: int
    statistic: Callable[[_Standardised], Floats]
    scaled: Callable[[Floats, Floats], Floats]
    quantiles: Floats

    def p_value(self, statistic: Floats, n: Counts) -> Floats:
        """Return p-values by simulation.

        For Anderson-Darling, the statistic is A*^2 (D'Agostino and Stephens 1986, chapter 4). For
        K^2, the two normal scores are uncorrelated but not independent.
        """
        scaled = self.scaled(statistic, n.astype(np.float64))
        return interpolated_p(scaled, n, self.quantiles, _FLOOR)


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
    progress: bool | None = None,
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


# fmt: off
LEVELS = np.array([
    0.9999, 0.999, 0.995, 0.99, 0.975, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25,
    0.2, 0.15, 0.1, 0.075, 0.05, 0.035, 0.025, 0.0175, 0.01, 0.007, 0.005, 0.0035, 0.0025,
    0.00175, 0.001, 0.0005, 0.00025, 0.0001
])
"""Probabilities above the quantiles."""

TESTS: Mapping[TestName, NormalityTest] = {
    test.name: test for test in (
        NormalityTest(
            "anderson-darling",
            8,
            anderson_darling,
            # Stephens 1974, doi:10.1080/01621459.1974.10480196: hardly depends on n.
            scaled=lambda a, n: a * (1 + 0.75 / n + 2.25 / n**2),
            quantiles=np.array([
            [0.0817946, 0.00322623, -0.034499, 0.740138, -1.05358, 3.25275],
            [0.0998943, -0.0311267, 0.567306, -3.42278, 11.2687, -10.929],
            [0.118622, -0.0137829, 0.243678, -1.10935, 3.98589, -3.28269],
            [0.129731, -0.00969978, 0.132327, -0.365886, 1.90233, -1.38162],
            [0.148698, -0.0164066, 0.232064, -1.15811, 4.44903, -4.46172],
            [0.167986, -0.020873, 0.30424, -1.77218, 6.43928, -6.78772],
            [0.194203, -0.0175279, 0.234345, -1.12111, 3.66711, -2.98272],
            [0.214539, 0.000895243, -0.0104777, 0.308813, -0.261386, 0.990632],
            [0.23306, 0.0069229, -0.100132, 0.846488, -1.81198, 2.62269],
            [0.267709, 0.00958487, -0.0766702, 0.441205, -0.320548, 0.777908],
            [0.302335, 0.0230802, -0.269199, 1.65074, -3.80833, 4.39185],
            [0.340016, 0.0108822, -0.0439122, 0.198063, 0.0405596, 0.699022],
            [0.383022, 0.0191519, -0.205352, 1.41323, -3.75372, 4.73109],
            [0.435875, 0.025433, -0.231251, 1.19608, -2.21718, 2.2019],
            [0.468032, 0.0527775, -0.657445, 4.02742, -10.4325, 10.6989],
            [0.508375, 0.0201116, -0.186103, 1.13839, -2.4874, 2.51543],
            [0.558431, 0.0445082, -0.543599, 3.25189, -7.78954, 7.04733],
            [0.628886, 0.063245, -0.890252, 5.86547, -16.16, 16.2978],
            [0.677917, 0.115517, -1.61433, 10.0405, -26.9826, 26.5227],
            [0.750059, 0.0508045, -0.583835, 2.89299, -5.5094, 3.10655],
            [0.812744, 0.0492588, -0.666288, 3.88466, -9.87909, 9.18873],
            [0.873513, -0.0167214, 0.124462, -0.459521, 1.3329, -2.30643],
            [0.940732, -0.205287, 2.73869, -16.3021, 44.4445, -46.0116],
            [1.04347, -0.368682, 4.93018, -29.7059, 81.4064, -84.2664],
            [1.11038, -0.469836, 5.77706, -33.2459, 90.1659, -95.0601],
            [1.16763, -0.34184, 3.7376, -20.2701, 53.7531, -58.2095],
            [1.23407, -0.370897, 3.58305, -17.2342, 40.5472, -41.1442],
            [1.28918, -0.275418, 3.04835, -15.8289, 36.9828, -35.9886],
            [1.35039, -0.229782, 2.82587, -16.4813, 42.6924, -45.7369],
            [1.47777, -1.26876, 17.29, -104.46, 281.468, -286.018],
            [1.60361, -1.04642, 11.9521, -63.3011, 146.758, -130.047],
            [1.74172, -1.6676, 23.6467, -152.085, 426.692, -443.432],
            [1.87369, -0.300492, 6.98706, -65.0651, 212.961, -243.353],
        ]),
        ),
        _ShapiroWilk(
            "shapiro-wilk",
            8,
            _shapiro_wilk,
            # A smaller W is less Gaussian; n (1 - W) grows slowly.
            scaled=lambda w, n: np.log(n * (1 - w)),
            quantiles=np.array([
            [-0.430591, -20.2782, 226.729, -1839.76, 7692, -15963.9, 12640],
            [-0.248478, -18.7749, 187.416, -1328.63, 4938.81, -9290.34, 6755.5],
            [-0.0780595, -18.8648, 197.952, -1395.1, 5144.29, -9588.67, 6985.32],
            [0.0001535, -18.3227, 188.857, -1294.05, 4659.38, -8529.18, 6148.67],
            [0.115882, -17.7203, 184.812, -1265.77, 4589.92, -8494.77, 6228.51],
            [0.215582, -16.8984, 173.372, -1158.24, 4105.22, -7430.17, 5336.25],
            [0.334609, -16.2802, 170.176, -1148.06, 4125.46, -7569.24, 5525.48],
            [0.410369, -15.4264, 158.582, -1053.53, 3735.12, -6768.48, 4893.66],
            [0.472794, -14.8968, 153.88, -1031.77, 3709.22, -6832.59, 5038.45],
            [0.574803, -13.9818, 144.695, -976.063, 3537.71, -6568.35, 4886.71],
            [0.665166, -13.3127, 136.269, -905.241, 3227.77, -5888.31, 4303.4],
            [0.748271, -12.488, 124.914, -813.539, 2843.24, -5082.26, 3641.11],
            [0.834871, -11.9196, 120.923, -804.737, 2885.48, -5299.75, 3905.43],
            [0.930234, -11.3936, 116.201, -775.034, 2779.75, -5100.31, 3753.37],
            [0.979849, -10.8265, 108.144, -712.143, 2522.49, -4572.18, 3324.94],
            [1.03725, -10.3721, 103.418, -684.453, 2438.56, -4448.63, 3258.29],
            [1.10359, -9.76419, 96.5183, -642.209, 2306.1, -4247.46, 3144.03],
            [1.18993, -9.20935, 91.5093, -614.866, 2219.98, -4096.36, 3027.88],
            [1.24523, -8.76441, 86.8804, -588.156, 2137.43, -3968.89, 2951.77],
            [1.31853, -8.29935, 82.9065, -570.255, 2100.13, -3947.21, 2968.73],
            [1.37822, -7.93647, 76.5091, -500.973, 1737.96, -3066.87, 2162.92],
            [1.42678, -7.30063, 69.0323, -454.332, 1575.82, -2768.04, 1934.02],
            [1.47329, -6.50905, 56.7892, -355.613, 1159.13, -1894.56, 1215.39],
            [1.54565, -5.58077, 44.3225, -270.493, 863.578, -1403.19, 907.639],
            [1.59003, -5.05499, 36.8124, -211.638, 615.779, -882.787, 479.03],
            [1.62382, -4.14109, 22.4583, -100.885, 172.205, 0.274158, -213.737],
            [1.68417, -5.16714, 44.089, -279.334, 884.287, -1377.74, 821.491],
            [1.71797, -4.65609, 39.6181, -266.528, 903.973, -1545.22, 1047.6],
            [1.75074, -4.18742, 35.1886, -242.33, 824.525, -1408.11, 952.408],
            [1.79933, -2.57387, 0.929497, 86.9499, -731.242, 2124.9, -2137.98],
            [1.86618, -2.6455, 0.402138, 147.13, -1227.66, 3585.94, -3611.52],
            [1.96569, -5.57075, 76.1344, -609.221, 2356.33, -4533.37, 3460.07],
            [1.99865, -1.84767, 18.0912, -191.882, 808.129, -1663.18, 1347.15],
        ]),
        ),
        NormalityTest(
            "dagostino",
            20,
            dagostino,
            scaled=lambda k2, _n: np.sqrt(k2),
            quantiles=np.array([
            [0.014161, 0.0592733, -1.01207, -9.67846, 334.922, -2897.72, 10772.7, -14988.9],
            [0.0447582, -0.149624, 12.2496, -341.964, 4393.55, -28637.5, 92235, -116644],
            [0.100144, -0.128779, 10.2131, -297.77, 3970.23, -26599.2, 87537.9, -112725],
            [0.141766, -0.163646, 10.739, -292.254, 3783.01, -24890.1, 80691.2, -102360],
            [0.225029, -0.0863306, 2.3634, -44.8693, 479.207, -2613.98, 6876.98, -6840.56],
            [0.320257, -0.0266047, -2.70821, 81.9442, -1012.65, 6431.06, -20339.8, 25274.4],
            [0.459021, 0.0331755, -7.09034, 162.902, -1649.32, 8586.53, -22250.2, 22550.6],
            [0.57012, 0.00567267, -6.17078, 125.525, -1002.46, 3406, -2918.18, -4773.75],
            [0.668057, -0.0269249, -7.59868, 194.341, -2094.36, 11439.9, -31027.4, 33046.6],
            [0.844578, 0.109484, -18.2589, 432.011, -4661.61, 25966.9, -72703.4, 80994],
            [1.01073, 0.0694182, -14.8247, 301.469, -2755.34, 12444.1, -26354.2, 19490.1],
            [1.17739, -0.0850915, -7.41175, 129.057, -790.857, 423.469, 11125.8, -27154.9],
            [1.35369, 0.127386, -21.7431, 455.23, -4566.73, 23592.8, -61013.3, 62549.8],
            [1.5517, -0.0431606, -12.2139, 239.927, -2226.35, 9888.48, -19738.8, 12499.7],
            [1.66504, -0.207553, -1.44024, -11.0224, 580.019, -6612.04, 29291.9, -45525.9],
            [1.79407, -0.322473, 8.41231, -262.601, 3641.72, -26010.5, 90913.2, -122972],
            [1.94782, -0.380638, 15.1566, -414.255, 5319.48, -35567.4, 117835, -152655],
            [2.14589, -0.589555, 31.3957, -709.466, 8198.17, -50984.4, 160847, -201867],
            [2.27594, -0.817152, 50.0371, -1086.74, 12363.6, -76062.1, 237676, -295649],
            [2.4476, -0.501443, 45.5886, -975.475, 11761.9, -78032.8, 260974, -343208],
            [2.58918, -0.443521, 55.8438, -1091.18, 12390, -79862.5, 262915, -341657],
            [2.71603, -0.444114, 64.8651, -1053.14, 10043.6, -57540.2, 174788, -212997],
            [2.84446, -0.474138, 83.0789, -1293.47, 11892.2, -68535.8, 216382, -278062],
            [3.03489, -0.061901, 94.8726, -1221.92, 7874.07, -31197.2, 75253.6, -83443.7],
            [3.15031, -0.2355, 136.802, -2056.85, 16195.1, -78135.7, 217160, -260866],
            [3.25527, -0.444684, 179.275, -2727.59, 19903.6, -78992.8, 161120, -128667],
            [3.3631, 0.349801, 165.207, -2062.79, 7567.43, 22183, -220955, 414960],
            [3.46174, 0.0464055, 226.985, -3435.32, 22061, -60087.2, 20195.4, 128169],
            [3.56313, 0.870164, 208.122, -2751.39, 12022.2, 6956.09, -189663, 379159],
            [3.71683, 0.670579, 326.106, -5578.67, 41913.9, -156148, 257700, -109295],
            [3.89878, -3.05195, 662.619, -12983.6, 119411, -588665, 1.50177e+06, -1.56204e+06],
            [4.0722, -2.69096, 726.987, -13911.3, 122826, -579269, 1.41584e+06, -1.41625e+06],
            [4.28984, -7.29759, 1148.17, -22876.3, 213433, -1.0728e+06, 2.81866e+06, -3.05304e+06],
        ]),
        ),
    )
}
"""Tests of normality by name. `tools/make_normality_tables.py` makes the quantiles of a new row."""
