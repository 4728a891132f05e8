"""Normality of averages: how many samples a pixel estimate needs until it behaves like a Gaussian.

`gaussianity_of_means` averages N samples for several N, tests the averages, and returns the N that
is needed beside the one that the central limit theorem predicts. Error bars and most denoisers
assume that the averages are Gaussian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, as_samples, is_bad, warn_left_out
from chdstat._core.display import Shown
from chdstat._core.positive import PositivePart
from chdstat.errors import InputError, check_option, check_probability
from chdstat.fit.tail import Tail, tail_of_part
from chdstat.inference import averages
from chdstat.inference.averages import MORE_THAN_TESTED, UNTESTED
from chdstat.inference.normality import (
    TESTS,
    NormalityTest,
    TestName,
    finish_tests,
)
from chdstat.samples import ImageLike, Mapped, Samples, opened
from chdstat.summary.dispatch import of_image

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "MORE_THAN_TESTED",
    "N_MEANS",
    "UNTESTED",
    "GaussianityOfMeans",
    "finish_means",
    "gaussianity_of_means",
    "means_of_block",
    "means_variables",
    "sizes_of_means",
]

N_MEANS = 32
"""Averages tested for each N by default: 512 spp then reach N = 16.

Twice as many detect smaller departures, but halve the largest N. Of averages of an exponential CHD
(skewness 2), at level 0.05, Shapiro-Wilk rejects for N = 1, 2, 4, 8 with 16 averages 72, 41, 22,
14 %, with 32 98, 79, 46, 25 %, with 128 100, 100, 98, 81 %.
"""


@dataclass(frozen=True, repr=False)
class GaussianityOfMeans(Shown):
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
        largest N still are not Gaussian, 0 where there is no answer. Where all averages are
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


@of_image
def gaussianity_of_means(
    x: ImageLike | npt.ArrayLike,
    *,
    sizes: Sequence[int] | None = None,
    n_means: int = N_MEANS,
    test: TestName = "shapiro-wilk",
    alpha: float = 0.05,
    progress: bool | None = None,
) -> GaussianityOfMeans | xr.Dataset:
    """Test whether pixel estimates, the averages of N samples, are Gaussian, for N = 1, 2, 4, ...

    The samples are cut into batches of N in stored order, without overlap, and the first `n_means`
    averages are tested: the same number for every N, so that the test has the same power and a
    falling share of rejections means that the averages, not the test, have changed. Nulls belong to
    an estimate and are averaged; bad samples are left out of their batch.

    The N needed is an answer to "can `n_means` of these averages reject normality?",
    for so many averages; more of them need a larger N. Where the
    tested averages are all equal although the samples are not, they count as not Gaussian.

    Skewness and kurtosis of the samples assume finite moments. Where the tail index is 1/2 or more
    (`chdstat.fit.tail_index`), the variance of the CHD is infinite: averages then never turn
    Gaussian. Skewness is infinite from 1/3 on, kurtosis from 1/4 on. Below, both are mostly too
    small, for they rest on rare bright samples. So N is predicted only from 1379 samples on that
    are not null: nearly every pixel then has seen each part of 0.5 % of them; of fewer, the reason
    is `TOO_FEW`. The reason is `UNIDENTIFIED` unless the variance is trusted, the tail index is
    below 1/4 by 2.81 standard errors, and no few samples make up all of the fourth moment. The
    upper end of the interval of N counts the tail as heavy as that largest index allows, and as
    that of a log-normal distribution if the logarithms may be Gaussian.

    Of exponential pixels, 89 % have a prediction with 2048 samples, of gamma ones with shape 5, 99
    %, of log-normal ones with sigma = 0.5, 69 %, and of those with sigma = 1, next to none. Of the
    pixels with a prediction, its interval misses the N of the distribution in 0 to 5 %, with 2048
    and 4096 samples, for exponential, gamma, log-normal, Weibull and uniform samples, mixtures of
    two, and those beside nulls. Parts of the light that are rarer than 0.5 %, and power laws of an
    index close to 1/4, may hide in pixels with a prediction.

    Parameters
    ----------
    x, progress
        As for `chdstat.fit.fit`.
    sizes
        The N; by default the powers of 2 up to spp / n_means.
    n_means
        Averages to test, for every N the same number. 512 spp reach N = 16 with 32.
    test
        As for `chdstat.gaussianity`. The default has the greatest power with few averages.
    alpha
        For an array: level of all tests behind `n_needed` together. For `Samples`: false discovery
        rate of ``rejected``, on which `n_needed` rests.

    Returns
    -------
    GaussianityOfMeans or xarray.Dataset
        `GaussianityOfMeans` for an array. For `Samples`, its fields over (y, x, channel, size),
        `n_needed` and `n_predicted` over (y, x, channel), q-value and ``rejected`` as of
        `chdstat.gaussianity` for every channel and N separately, and ``rejected_share`` over
        (channel, size): the share of rejected pixels among those tested.

    Raises
    ------
    InputError
        If an option is unknown, or some N leaves fewer than `n_means` averages.

    References
    ----------
    Skewness and kurtosis of averages, and their standard errors under normality: Cramer,
    "Mathematical methods of statistics", 1946, sections 15.8, 27.7 and 29.3. Test: see
    `chdstat.gaussianity`. Elek, Thomas and Forbes, "Learning patterns in sample distributions for
    Monte Carlo variance reduction", 2019.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(1.0, size=4096)
    >>> means = gaussianity_of_means(x, sizes=[1, 2, 4, 8, 16, 32])
    >>> means.predicted_skewness.round(2)
    array([1.95, 1.38, 0.98, 0.69, 0.49, 0.34])
    >>> means.p_value < 0.01
    array([ True,  True,  True, False, False, False])
    >>> int(means.n_needed), float(means.n_predicted)
    (8, 6.0)
    """
    check_option("test", test, TESTS)
    check_probability(alpha=alpha)
    given = opened(x)
    if isinstance(given, Samples):
        chosen = sizes_of_means(given.spp, n_means, sizes=sizes, test=test)

        def of_block(block: npt.NDArray[np.float32]) -> Mapped:
            return means_variables(means_of_block(block, chosen, n_means=n_means, test=test))

        found = given.map(of_block, description="testing normality of means", progress=progress)
        return finish_means(found, chosen, n_means=n_means, test=test, alpha=alpha)
    array = as_samples(given)
    warn_left_out(array)
    chosen = sizes_of_means(array.shape[-1], n_means, sizes=sizes, test=test)
    return _gaussianity_of_rows(array, is_bad(array), chosen, n_means, TESTS[test], alpha)


def sizes_of_means(
    spp: int,
    n_means: int = N_MEANS,
    *,
    sizes: Sequence[int] | None = None,
    test: TestName = "shapiro-wilk",
) -> Counts:
    """Return the N to test in ascending order, or raise InputError if there is none such."""
    if n_means < TESTS[test].minimum:
        message = f"n_means must be at least {TESTS[test].minimum} for this test, got {n_means}"
        raise InputError(message)
    largest = spp // n_means
    if sizes is None:
        sizes = [2**i for i in range(largest.bit_length())]
    if not len(sizes) or min(sizes) < 1 or max(sizes) > largest:
        message = (
            f"sizes must lie between 1 and spp / n_means = {spp} / {n_means}, got {list(sizes)}; "
            "render more spp or test fewer averages"
        )
        raise InputError(message)
    return np.unique(np.asarray(sizes, dtype=np.int64))


def means_of_block(
    block: npt.NDArray[np.floating[Any]],
    sizes: Counts,
    *,
    n_means: int = N_MEANS,
    test: TestName = "shapiro-wilk",
    tail: Tail | None = None,
) -> GaussianityOfMeans:
    """Test the averages of pixels, shape (..., channel, sample); a bad channel spoils a sample.

    `tail` is that of the same samples, if it is there.
    """
    bad = np.broadcast_to(is_bad(block).any(axis=-2, keepdims=True), block.shape)
    return _gaussianity_of_rows(block, bad, sizes, n_means, TESTS[test], 0.05, tail)


def _gaussianity_of_rows(
    x: npt.NDArray[Any],
    bad: Mask,
    sizes: Counts,
    n_means: int,
    test: NormalityTest,
    alpha: float,
    tail: Tail | None = None,
) -> GaussianityOfMeans:
    """Test averages of samples, shape (..., sample), with the N needed and predicted."""
    tail = tail or tail_of_part(PositivePart.of(x, bad=bad))
    n_predicted, interval, reason = averages.predict(x, bad, tail, n_means)
    found, (skewness, kurtosis, n) = averages.run_on_averages(x, bad, sizes, n_means, test)
    predicted = skewness[..., np.newaxis] / np.sqrt(sizes)
    # Bonferroni over the sizes: else each further one would be a chance to fail.
    rejected = found["p_value"] * len(sizes) <= alpha
    with np.errstate(all="ignore"):
        clear = np.abs(skewness) > 2 * np.sqrt(6 / n)
        ratio = np.where(clear[..., np.newaxis], found["skewness"] / predicted, np.nan)
    return GaussianityOfMeans(
        test=test.name,
        n_means=n_means,
        alpha=alpha,
        sizes=sizes,
        **found,
        predicted_skewness=predicted,
        predicted_kurtosis=kurtosis[..., np.newaxis] / sizes,
        skewness_ratio=ratio,
        n_needed=averages.n_needed(rejected, found["reason"], np.isfinite(skewness), sizes),
        n_predicted=n_predicted,
        n_predicted_interval=interval,
        n_predicted_reason=reason,
    )


def means_variables(result: GaussianityOfMeans) -> Mapped:
    """Return the variables of a block; `finish_means` adds `n_needed`, which needs the image."""
    dims: dict[str, tuple[str, ...]] = dict.fromkeys(_BY_SIZE, ("channel", "size"))
    dims |= dict.fromkeys(("n_predicted", "n_predicted_reason"), ("channel",))
    dims["n_predicted_interval"] = ("channel", "bound")
    return {name: (after, getattr(result, name)) for name, after in dims.items()}


def finish_means(
    dataset: xr.Dataset, sizes: Counts, *, n_means: int, test: TestName, alpha: float = 0.05
) -> xr.Dataset:
    """Add q-values, what follows from them, the N, and the names and units of all variables."""
    tested = dataset["p_value"].notnull().sum(("y", "x"))
    dims = ("y", "x", "channel")
    dataset = finish_tests(dataset, f"{test} on averages of N samples", alpha)
    rejected = dataset["rejected"]
    share = rejected.sum(("y", "x")) / tested.where(tested > 0)
    dataset["rejected_share"] = share.assign_attrs(
        long_name="share of pixels whose averages are not Gaussian", units="1"
    )
    needed = averages.n_needed(
        (rejected == 1).transpose(*dims, "size").to_numpy(),
        dataset["reason"].transpose(*dims, "size").to_numpy(),
        dataset["predicted_skewness"].notnull().any("size").transpose(*dims).to_numpy(),
        sizes,
    )
    dataset["n_needed"] = (
        dims,
        needed,
        {
            "long_name": "samples per average from which on normality is not rejected",
            "units": "1",
            "flag_values": [MORE_THAN_TESTED, UNTESTED],
            "flag_meanings": "more_than_tested untested",
        },
    )
    for name in ("predicted_skewness", "predicted_kurtosis", "skewness_ratio"):
        dataset[name].attrs["comment"] = _ASSUMES
    dataset["n_predicted"].attrs["comment"] = "NaN where n_predicted_reason says why"
    size = ("size", sizes, {"long_name": "samples per average", "units": "1"})
    return dataset.assign_coords(size=size).assign_attrs(n_means=n_means)


_ASSUMES = "assumes finite moments; not to be trusted where the tail index is 1/2 or more"

_BY_SIZE = (
    "statistic",
    "p_value",
    "skewness",
    "kurtosis",
    "predicted_skewness",
    "predicted_kurtosis",
    "skewness_ratio",
    "reason",
)
