"""Normality: how far samples, their logarithms and their averages are from Gaussian.

Use `gaussianity` on the positive samples of a CHD, `gaussianity_of_means` on pixel estimates: it
shows how fast the averages of N samples become Gaussian, which is what error bars and most
denoisers assume. At 2048 spp nearly every p-value is tiny: read skewness and kurtosis beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import numpy.typing as npt

from chdstat._arrays import as_samples, is_bad
from chdstat._moments import Moments
from chdstat._multiplicity import q_values
from chdstat._normality_tests import TESTS, NormalityTest, run_test
from chdstat._positive import CONSTANT_SPREAD, Counts, Floats, Mask, PositivePart
from chdstat._reasons import Reason, flag_attributes
from chdstat.errors import InputError
from chdstat.samples import Mapped, Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "TESTS",
    "TRANSFORMS",
    "Gaussianity",
    "GaussianityOfMeans",
    "TestName",
    "Transform",
    "gaussianity",
    "gaussianity_of_means",
]

Transform = Literal["log", "linear", "sqrt"]
TestName = Literal["anderson-darling", "dagostino"]


@dataclass(frozen=True)
class Gaussianity:
    """A test of normality with its effect sizes; arrays of the batch's shape.

    Attributes
    ----------
    test, transform
        What was tested, and on what.
    statistic, p_value
        Of the test; NaN where `reason` says why.
    skewness, kurtosis
        Of the transformed samples, the kurtosis excess: both 0 for a Gaussian.
    n
        Samples that were tested.
    reason
        `Reason` codes.
    """

    test: str
    transform: str
    statistic: Floats
    p_value: Floats
    skewness: Floats
    kurtosis: Floats
    n: Counts
    reason: npt.NDArray[np.int8]


@dataclass(frozen=True)
class GaussianityOfMeans:
    """Normality of averages of N samples, for several N; arrays of shape (..., size).

    Attributes
    ----------
    test, n_means
        What was tested, and on how many averages for every N.
    sizes
        The N, shape (size,).
    statistic, p_value
        Of the test; NaN where `reason` says why.
    skewness, kurtosis
        Of all complete averages, not only of the tested ones. Few averages bias both towards 0.
    predicted_skewness, predicted_kurtosis
        What independent samples predict: ``skewness / sqrt(N)`` and ``kurtosis / N`` of all.
    reason
        `Reason` codes.
    """

    test: str
    n_means: int
    sizes: Counts
    statistic: Floats
    p_value: Floats
    skewness: Floats
    kurtosis: Floats
    predicted_skewness: Floats
    predicted_kurtosis: Floats
    reason: npt.NDArray[np.int8]


@overload
def gaussianity(
    x: Samples,
    *,
    transform: Transform = ...,
    test: TestName = ...,
    alpha: float = ...,
    progress: bool | None = None,
) -> xr.Dataset: ...
@overload
def gaussianity(
    x: npt.ArrayLike,
    *,
    transform: Transform = ...,
    test: TestName = ...,
    null: npt.ArrayLike | None = None,
) -> Gaussianity: ...
def gaussianity(
    x: Samples | npt.ArrayLike,
    *,
    transform: Transform = "log",
    test: TestName = "anderson-darling",
    null: npt.ArrayLike | None = None,
    alpha: float = 0.05,
    progress: bool | None = None,
) -> Gaussianity | xr.Dataset:
    """Test whether the positive samples, transformed, are Gaussian.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`. Nulls, zeros and bad samples take no part, whatever the transform.
    transform
        'log' asks whether the CHD is log-normal; 'sqrt', 'linear'.
    test
        'anderson-darling' (mean and variance estimated from the samples) weighs the tails of the
        distribution function; 'dagostino' combines skewness and kurtosis.
    alpha
        For `Samples`: false discovery rate of ``rejected``.

    Returns
    -------
    Gaussianity or xarray.Dataset
        `Gaussianity` for an array. For `Samples`, its fields over (y, x, channel), the q-value of
        Benjamini and Hochberg over the image, and ``rejected`` where it is at most `alpha`.

    Raises
    ------
    InputError
        If an option is unknown.

    References
    ----------
    D'Agostino and Stephens, "Goodness-of-fit techniques", 1986, chapter 4 (p-values of
    Anderson-Darling). D'Agostino and Pearson, "Tests for departure from normality", 1973,
    doi:10.1093/biomet/60.3.613.

    Examples
    --------
    >>> x = np.random.default_rng(1).lognormal(size=1000)
    >>> bool(gaussianity(x).p_value > 0.05), bool(gaussianity(x, transform="linear").p_value < 1e-9)
    (True, True)
    """
    _check(transform, TRANSFORMS, "transform")
    _check(test, TESTS, "test")
    if not isinstance(x, Samples):
        return _of_part(PositivePart.of(x, null=null), transform, TESTS[test])
    dataset = x.map(
        lambda block: _variables(
            _of_part(PositivePart.of_pixels(block), transform, TESTS[test]), ("channel",)
        ),
        description="testing normality",
        progress=progress,
    )
    return _finish(dataset, f"{test} on {transform} samples", alpha)


@overload
def gaussianity_of_means(
    x: Samples,
    *,
    sizes: Sequence[int] | None = None,
    n_means: int = ...,
    test: TestName = ...,
    alpha: float = ...,
    progress: bool | None = None,
) -> xr.Dataset: ...
@overload
def gaussianity_of_means(
    x: npt.ArrayLike,
    *,
    sizes: Sequence[int] | None = None,
    n_means: int = ...,
    test: TestName = ...,
) -> GaussianityOfMeans: ...
def gaussianity_of_means(
    x: Samples | npt.ArrayLike,
    *,
    sizes: Sequence[int] | None = None,
    n_means: int = 32,
    test: TestName = "anderson-darling",
    alpha: float = 0.05,
    progress: bool | None = None,
) -> GaussianityOfMeans | xr.Dataset:
    """Test whether pixel estimates, the averages of N samples, are Gaussian, for N = 1, 2, 4, ...

    The samples are cut into batches of N in stored order, without overlap, and the first `n_means`
    averages are tested: the same number for every N, so that the test has the same power and a
    falling share of rejections means that the averages, not the test, have changed. Nulls belong to
    an estimate and are averaged; bad samples are left out of their batch.

    Parameters
    ----------
    x, progress
        As for `chdstat.fit.fit`.
    sizes
        The N; by default the powers of 2 up to spp / n_means.
    n_means
        Averages to test.
    test, alpha
        As for `gaussianity`.

    Returns
    -------
    GaussianityOfMeans or xarray.Dataset
        `GaussianityOfMeans` for an array, with (..., size). For `Samples`, its fields over (y, x,
        channel, size), q-value and ``rejected`` as of `gaussianity` for every N apart, and
        ``rejected_share`` over (channel, size): the share of rejected pixels among those tested.

    Raises
    ------
    InputError
        If an option is unknown, or some N leaves fewer than `n_means` averages.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(1.0, size=4096)
    >>> means = gaussianity_of_means(x, sizes=[1, 128])
    >>> means.predicted_skewness.round(2)
    array([1.95, 0.17])
    >>> means.p_value < 0.05
    array([ True, False])
    """
    _check(test, TESTS, "test")
    if isinstance(x, Samples):
        chosen = _check_sizes(sizes, n_means, x.spp, TESTS[test].minimum)
        return _means_of_image(x, chosen, n_means, TESTS[test], alpha, progress)
    array = as_samples(x)
    chosen = _check_sizes(sizes, n_means, array.shape[-1], TESTS[test].minimum)
    return _of_means(array, is_bad(array), chosen, n_means, TESTS[test])


def _of_part(part: PositivePart, transform: str, test: NormalityTest) -> Gaussianity:
    reason = part.reason(test.minimum)
    tested = run_test(part.sorted, part.n, TRANSFORMS[transform], test)
    return Gaussianity(
        test=test.name,
        transform=transform,
        **_where(reason == Reason.OK, tested),
        n=part.n,
        reason=reason,
    )


def _of_means(
    x: npt.NDArray[Any], bad: Mask, sizes: Counts, n_means: int, test: NormalityTest
) -> GaussianityOfMeans:
    shape = (*x.shape[:-1], len(sizes))
    samples = np.where(bad, 0, x).astype(np.float64)
    fields = {name: np.empty(shape) for name in ("statistic", "p_value", "skewness", "kurtosis")}
    reason = np.empty(shape, dtype=np.int8)
    for i, size in enumerate(sizes):
        means, formed = _averages(samples, bad, int(size))
        tested = np.sort(np.where(formed, means, np.inf)[..., :n_means], axis=-1)
        n = np.count_nonzero(formed[..., :n_means], axis=-1)
        reason[..., i] = _reason_of_means(tested, n)
        results = run_test(tested, n, TRANSFORMS["linear"], test)
        shapes = _moments(means, formed)
        results[2:] = shapes.skewness, shapes.kurtosis
        for name, values in _where(reason[..., i] == Reason.OK, results).items():
            fields[name][..., i] = values
    moments = _moments(x, ~bad)
    return GaussianityOfMeans(
        test=test.name,
        n_means=n_means,
        sizes=sizes,
        **fields,
        predicted_skewness=moments.skewness[..., np.newaxis] / np.sqrt(sizes),
        predicted_kurtosis=moments.kurtosis[..., np.newaxis] / sizes,
        reason=reason,
    )


def _averages(samples: Floats, bad: Mask, size: int) -> tuple[Floats, Mask]:
    """Return the averages of all complete batches, bad samples left out, and which hold any."""
    batches = (*samples.shape[:-1], samples.shape[-1] // size, size)
    used = math.prod(batches[-2:])
    # A product with ones adds short batches up faster than a sum over a short axis does.
    ones = np.ones(size)
    sums = samples[..., :used].reshape(batches) @ ones
    if not bad.any():
        return sums / size, np.ones(sums.shape, dtype=bool)
    counts = (~bad[..., :used]).reshape(batches) @ ones
    return sums / np.maximum(counts, 1), counts > 0


def _moments(x: npt.NDArray[Any], good: Mask) -> Moments:
    # Without a mask, this takes a fraction of the time.
    return Moments.of(x, None if good.all() else good)


def _means_of_image(
    samples: Samples,
    sizes: Counts,
    n_means: int,
    test: NormalityTest,
    alpha: float,
    progress: bool | None,
) -> xr.Dataset:
    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        bad = np.broadcast_to(is_bad(block).any(axis=-2, keepdims=True), block.shape)
        return _variables(_of_means(block, bad, sizes, n_means, test), ("channel", "size"))

    dataset = samples.map(of_block, description="testing normality of means", progress=progress)
    dataset = _finish(dataset, f"{test.name} on averages of N samples", alpha)
    tested = dataset["p_value"].notnull().sum(("y", "x"))
    rejected = dataset["rejected"].sum(("y", "x")) / tested.where(tested > 0)
    dataset["rejected_share"] = rejected.assign_attrs(
        long_name="share of pixels whose averages are not Gaussian", units="1"
    )
    size = ("size", sizes, {"long_name": "samples per average", "units": "1"})
    return dataset.assign_coords(size=size).assign_attrs(n_means=n_means)


def _where(ok: Mask, results: Floats) -> dict[str, Floats]:
    names = ("statistic", "p_value", "skewness", "kurtosis")
    return {name: np.where(ok, values, np.nan) for name, values in zip(names, results, strict=True)}


def _reason_of_means(ascending: Floats, n: Counts) -> npt.NDArray[np.int8]:
    first, last = ascending[..., 0], ascending[..., -1]
    with np.errstate(invalid="ignore"):
        cases = {
            Reason.ALL_BAD: n == 0,
            Reason.TOO_FEW: n < ascending.shape[-1],
            Reason.ALL_NULL: last == 0,
            Reason.CONSTANT: last - first <= CONSTANT_SPREAD * last,
        }
    codes = [np.int8(code) for code in cases]
    return np.asarray(np.select(list(cases.values()), codes, np.int8(Reason.OK)), dtype=np.int8)


def _check(choice: str, table: Mapping[str, Any], name: str) -> None:
    if choice not in table:
        message = f"{name} must be one of {', '.join(table)}, got {choice!r}"
        raise InputError(message)


def _check_sizes(sizes: Sequence[int] | None, n_means: int, spp: int, minimum: int) -> Counts:
    if n_means < minimum:
        message = f"n_means must be at least {minimum} for this test, got {n_means}"
        raise InputError(message)
    largest = spp // n_means
    if sizes is None:
        sizes = [2**i for i in range(largest.bit_length())]
    if not sizes or min(sizes) < 1 or max(sizes) > largest:
        message = (
            f"sizes must lie between 1 and spp / n_means = {spp} / {n_means}, got {list(sizes)}; "
            "render more spp or test fewer averages"
        )
        raise InputError(message)
    return np.asarray(sizes, dtype=np.int64)


def _variables(result: Gaussianity | GaussianityOfMeans, dims: tuple[str, ...]) -> Mapped:
    names = [name for name in _LABELS if hasattr(result, name)]
    return {name: (dims, getattr(result, name)) for name in (*names, "reason")}


def _finish(dataset: xr.Dataset, title: str, alpha: float) -> xr.Dataset:
    p_value = dataset["p_value"]
    q_value = p_value.copy(data=q_values(p_value.to_numpy()))
    dataset = dataset.assign(q_value=q_value, rejected=q_value <= alpha)
    for name in dataset.data_vars:
        if name in _LABELS:
            dataset[name].attrs.update(long_name=_LABELS[str(name)], units="1")
    dataset["reason"].attrs.update(long_name="why there is no test", units="1", **flag_attributes())
    return dataset.assign_attrs(test=title, false_discovery_rate=alpha)


_LABELS = {
    "statistic": "test statistic of normality",
    "p_value": "p-value of normality",
    "skewness": "skewness of what was tested",
    "kurtosis": "excess kurtosis of what was tested",
    "predicted_skewness": "skewness of averages of independent samples",
    "predicted_kurtosis": "excess kurtosis of averages of independent samples",
    "n": "samples that were tested",
    "q_value": "q-value of normality over the image",
    "rejected": "not Gaussian, at the false discovery rate of the dataset",
}

TRANSFORMS: Mapping[str, Callable[[Floats], Floats]] = {
    "log": np.log,
    "linear": np.asarray,
    "sqrt": np.sqrt,
}
"""What the samples may be turned into before a test; increasing, on positive numbers."""
