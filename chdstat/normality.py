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

from chdstat._arrays import as_samples, is_bad
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
    array = None if isinstance(x, Samples) else as_samples(x)
    spp = x.spp if isinstance(x, Samples) else array.shape[-1]  # type: ignore[union-attr]
    chosen = _check_sizes(sizes, n_means, spp, TESTS[test].minimum)
    if not isinstance(x, Samples):
        assert_free = np.asarray(array)
        return _of_means(assert_free, is_bad(assert_free), chosen, n_means, TESTS[test])

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        bad = np.broadcast_to(is_bad(block).any(axis=-2, keepdims=True), block.shape)
        return _variables(
            _of_means(block, bad, chosen, n_means, TESTS[test]), ("channel", "size")
        )

    dataset = x.map(of_block, description="testing normality of means", progress=progress)
    dataset = _finish(dataset, f"{test} on averages of N samples", alpha)
    tested = dataset["p_value"].notnull().sum(("y", "x"))
    dataset["rejected_share"] = dataset["rejected"].sum(("y", "x")) / tested.where(tested > 0)
    dataset["rejected_share"].attrs = {
        "long_name": "share of pixels whose averages are not Gaussian",
        "units": "1",
    }
    size = ("size", chosen, {"long_name": "samples per average", "units": "1"})
    return dataset.assign_coords(size=size).assign_attrs(n_means=n_means)


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
    skewness, kurtosis = _overall(x, bad)
    return GaussianityOfMeans(
        test=test.name,
        n_means=n_means,
        sizes=sizes,
        **fields,
        predicted_skewness=skewness[..., np.newaxis] / np.sqrt(sizes),
        predicted_kurtosis=kurtosis[..., np.newaxis] / sizes,
        reason=reason,
    )
