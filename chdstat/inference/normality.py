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
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, spans
from chdstat._core.display import Shown
from chdstat._core.positive import PositivePart
from chdstat._core.reasons import label_variables
from chdstat._core.resampling import q_values, rejections
from chdstat.errors import InputError, Reason, check_option, check_probability
from chdstat.inference import statistics
from chdstat.inference.statistics import Rows, standardise
from chdstat.samples import ImageLike, Mapped, Samples, opened
from chdstat.summary.dispatch import of_image

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "TESTS",
    "TRANSFORMS",
    "Gaussianity",
    "NormalityTest",
    "TestName",
    "Transform",
    "finish_gaussianity",
    "finish_tests",
    "gaussianity",
    "gaussianity_of_part",
    "gaussianity_variables",
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


@dataclass(frozen=True, repr=False)
class Gaussianity(Shown):
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
    statistic: Floats
    p_value: Floats
    skewness: Floats
    kurtosis: Floats
    n: Counts
    reason: npt.NDArray[np.int8]


@of_image
def gaussianity(
    x: ImageLike | npt.ArrayLike,
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
    _check_names(transform, TRANSFORMS, "transform")
    _check_names(test, TESTS, "test")
    check_probability(alpha=alpha)
    given = opened(x)
    if not isinstance(given, Samples):
        return _of_part(PositivePart.given(given, null=null), transform, test)

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        return gaussianity_variables(_of_part(PositivePart.of_pixels(block), transform, test))

    dataset = given.map(
        of_block, logarithms=True, description="testing normality", progress=progress
    )
    return finish_gaussianity(dataset, transform=transform, test=test, alpha=alpha)


def gaussianity_of_part(
    part: PositivePart,
    transforms: Sequence[Transform] = ("log",),
    tests: Sequence[TestName] = ("anderson-darling",),
) -> Gaussianity:
    """Test samples that are already split; the result has both axes, whatever their lengths."""
    rows = [TESTS[name] for name in tests]
    reason = np.stack([part.reason(test.minimum) for test in rows], axis=-1)
    usable = (reason == Reason.OK).any(axis=-1)
    found = run_tests(part.sorted, part.n, usable, transforms, rows)
    return Gaussianity(
        test=tuple(tests), transform=tuple(transforms), **found, n=part.n, reason=reason
    )


def gaussianity_variables(result: Gaussianity) -> Mapped:
    """Return the variables of a block with the names of the dims that follow (y, x)."""
    transform = () if isinstance(result.transform, str) else ("transform",)
    test = () if isinstance(result.test, str) else ("test",)
    dims = {
        "statistic": (*transform, *test),
        "p_value": (*transform, *test),
        "skewness": transform,
        "kurtosis": transform,
        "n": (),
        "reason": test,
    }
    return {name: (("channel", *after), getattr(result, name)) for name, after in dims.items()}


def finish_gaussianity(
    dataset: xr.Dataset,
    *,
    transform: Transform | Sequence[Transform],
    test: TestName | Sequence[TestName],
    alpha: float = 0.05,
) -> xr.Dataset:
    """Add q-values, ``rejected``, coordinates and the names and units of all variables."""
    for name, choice in {"transform": transform, "test": test}.items():
        if not isinstance(choice, str):
            dataset = dataset.assign_coords({name: np.array(choice, dtype=object)})
    tests, transforms = (c if isinstance(c, str) else ", ".join(c) for c in (test, transform))
    return finish_tests(dataset, f"{tests} on {transforms} samples", alpha)


_LABELS = {
    "statistic": "test statistic of normality",
    "p_value": "p-value of normality",
    "skewness": "skewness of what was tested",
    "kurtosis": "excess kurtosis of what was tested",
    "predicted_skewness": "skewness of averages of independent samples",
    "predicted_kurtosis": "excess kurtosis of averages of independent samples",
    "skewness_ratio": "skewness of averages over what independent samples predict",
    "n_predicted": "samples per average of a predicted shape that is nearly Gaussian",
    "n_predicted_interval": "95 % interval of n_predicted",
    "n_predicted_reason": "why there is no n_predicted",
    "n": "samples that were tested",
    "q_value": "q-value of normality over the image",
    "rejected": "1 where not Gaussian, at the false discovery rate of the dataset",
    "reason": "why there is no test",
}


def finish_tests(dataset: xr.Dataset, title: str, alpha: float) -> xr.Dataset:
    """Add q-value and ``rejected`` for every axis beyond (y, x) separately, and set names."""
    p_value = dataset["p_value"]
    q_value = p_value.copy(data=q_values(p_value.to_numpy()))
    dataset = dataset.assign(q_value=q_value, rejected=rejections(q_value, alpha))
    labelled = label_variables(dataset, _LABELS)
    return labelled.assign_attrs(test=title, false_discovery_rate=alpha)


def _of_part(
    part: PositivePart,
    transform: Transform | Sequence[Transform],
    test: TestName | Sequence[TestName],
) -> Gaussianity:
    """Test, without the axis of an option of which there is only a name."""
    transforms = (transform,) if isinstance(transform, str) else transform
    tests = (test,) if isinstance(test, str) else test
    result = gaussianity_of_part(part, transforms, tests)
    one_transform, one_test = (0 if isinstance(c, str) else slice(None) for c in (transform, test))
    return replace(
        result,
        test=test if isinstance(test, str) else result.test,
        transform=transform if isinstance(transform, str) else result.transform,
        statistic=result.statistic[..., one_transform, one_test],
        p_value=result.p_value[..., one_transform, one_test],
        skewness=result.skewness[..., one_transform],
        kurtosis=result.kurtosis[..., one_transform],
        reason=result.reason[..., one_test],
    )


def _check_names(choice: str | Sequence[str], table: Iterable[str], name: str) -> None:
    choices = (choice,) if isinstance(choice, str) else tuple(choice)
    if not choices or len(set(choices)) < len(choices):
        message = f"{name} must be a name or several different ones, got {choice!r}"
        raise InputError(message)
    for each in choices:
        check_option(name, each, table)
