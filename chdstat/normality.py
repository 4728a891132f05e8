"""Normality: how far samples, their logarithms and their averages are from Gaussian.

Use `gaussianity` on the positive samples of a CHD, `gaussianity_of_means` on pixel estimates: it
shows how fast the averages of N samples become Gaussian, which is what error bars and most
denoisers assume. At 2048 spp nearly every p-value is tiny: read skewness and kurtosis beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._arrays import as_samples, is_bad, spans
from chdstat._moments import Moments
from chdstat._multiplicity import q_values
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
    "NormalityTest",
    "TestName",
    "Transform",
    "gaussianity",
    "gaussianity_of_means",
]

Transform = Literal["log", "linear", "sqrt"]
TestName = Literal["anderson-darling", "dagostino"]

_CHUNK = 2**16
"""Samples worked on at once: their float64 copies stay in the cache."""


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
        Of the averages.
    predicted_skewness, predicted_kurtosis
        What independent samples predict: ``skewness / sqrt(N)`` and ``kurtosis / N`` of all of them.
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
    array([1.96, 0.17])
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
    tested = _run(part.sorted, part.n, TRANSFORMS[transform], test)
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
    good = np.where(bad, 0, x)
    fields = {name: np.empty(shape) for name in ("statistic", "p_value", "skewness", "kurtosis")}
    reason = np.empty(shape, dtype=np.int8)
    for i, size in enumerate(sizes):
        used = (*x.shape[:-1], n_means, size)
        counts = np.count_nonzero(~bad[..., : n_means * size].reshape(used), axis=-1)
        sums = good[..., : n_means * size].reshape(used).sum(axis=-1, dtype=np.float64)
        means = np.sort(np.where(counts > 0, sums / np.maximum(counts, 1), np.inf), axis=-1)
        n = np.count_nonzero(counts, axis=-1)
        reason[..., i] = _reason_of_means(means, n)
        tested = _run(means, n, TRANSFORMS["linear"], test)
        for name, values in _where(reason[..., i] == Reason.OK, tested).items():
            fields[name][..., i] = values
    moments = Moments.of(x, ~bad)
    return GaussianityOfMeans(
        test=test.name,
        n_means=n_means,
        sizes=sizes,
        **fields,
        predicted_skewness=moments.skewness[..., np.newaxis] / np.sqrt(sizes),
        predicted_kurtosis=moments.kurtosis[..., np.newaxis] / sizes,
        reason=reason,
    )


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


def _run(
    ascending: npt.NDArray[Any],
    n: Counts,
    transform: Callable[[Floats], Floats],
    test: NormalityTest,
) -> Floats:
    """Return statistic, p-value, skewness and kurtosis of sorted rows, shape (4, ...)."""
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


def _where(ok: Mask, results: Floats) -> dict[str, Floats]:
    names = ("statistic", "p_value", "skewness", "kurtosis")
    return {
        name: np.where(ok, values, np.nan) for name, values in zip(names, results, strict=True)
    }


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
    dataset["reason"].attrs.update(
        long_name="why there is no test", units="1", **flag_attributes()
    )
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

TESTS: Mapping[str, NormalityTest] = {
    test.name: test
    for test in (
        NormalityTest("anderson-darling", 8, _anderson_darling),
        NormalityTest("dagostino", 20, _dagostino),
    )
}
"""Tests of normality by name. A new one is a new row."""
