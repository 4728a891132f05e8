"""Averages of N samples: how many samples a pixel needs until its estimate is like a Gaussian.

Error bars and most denoisers assume that averages are Gaussian. `gaussianity_of_means` averages N
samples for several N, tests the averages, and returns the N that is needed and the N that the
central limit theorem predicts.

Samples are divided by the largest of their row, so that their powers neither overflow nor vanish.

The prediction rests on skewness and kurtosis, which rest on rare bright samples. The samples that
were seen give a lower bound of both. The others lie in the tail. A generalised Pareto distribution,
with the largest index that the samples allow, therefore replaces the samples beyond the threshold.
It has a kurtosis only if that index is below 1/4; otherwise, N is not identified. If the logarithms
may be Gaussian, the samples may also be log-normal, with a kurtosis that hardly depends on the tail
that was seen. Bright light without a single sample leaves no trace. A prediction therefore needs
enough samples, beside nulls, for such light to be a small part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import comb
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, as_samples, chunks, first_of, is_bad
from chdstat._core.moments import Moments
from chdstat._core.positive import CONSTANT_SPREAD, PositivePart
from chdstat._core.resampling import Z_95
from chdstat._core.statistic import MapKind, Quantity, Result, Statistic, result, variable
from chdstat.errors import InputError, Reason, check_option, check_probability
from chdstat.fit.tail import Tail, TailIndex
from chdstat.inference.normality import TESTS, NormalityTest, TestName, run_tests
from chdstat.samples import ImageLike, Samples, opened
from chdstat.summary.runner import Source, measured, of_source, run

if TYPE_CHECKING:
    import xarray as xr

MORE_THAN_TESTED = -1
"""N needed if normality is still rejected for averages of the largest N tested."""
UNTESTED = 0
"""N needed if there is no answer: samples are equal, null, bad or too few for every N."""

N_MEANS = 32
"""Averages tested for each N by default: 512 spp then reach N = 16.

Twice as many detect smaller departures, but halve the largest N. Rejections by Shapiro-Wilk at
level 0.05, for averages of N samples of an exponential CHD (skewness 2):

========  =====  =====  =====  =====
Averages  N = 1  N = 2  N = 4  N = 8
========  =====  =====  =====  =====
16        72 %   41 %   22 %   14 %
32        98 %   79 %   46 %   25 %
128       100 %  100 %  98 %   81 %
========  =====  =====  =====  =====
"""


@result
class GaussianityOfMeans(Result):
    """Normality of averages of N samples, for several N; arrays of shape (..., size) or (...).

    Attributes
    ----------
    test, n_means, alpha
        Name of the test, number of averages tested for every N, and level of `n_needed`.
    sizes
        The N in ascending order, shape (size,).
    statistic, p_value
        Statistic and p-value of the test, shape (..., size); NaN where `reason` says why.
    skewness, kurtosis
        Skewness and kurtosis of all complete averages, tested or not, shape (..., size). With few
        averages, both are biased towards 0.
    predicted_skewness, predicted_kurtosis
        Prediction for independent samples: ``skewness / sqrt(N)`` and ``kurtosis / N`` of all
        samples, shape (..., size).
    skewness_ratio
        ``skewness / predicted_skewness``, shape (..., size); 1 where the central limit theorem is
        at work. NaN where the samples' skewness is below two standard errors under normality,
        ``2 sqrt(6 / n)``.
    n_needed
        Smallest N tested from which on no test rejects, shape (...); -1 where the averages of the
        largest N are still not Gaussian, 0 where there is no answer. The level of each test is
        `alpha` over the number of sizes: if all averages are Gaussian, `n_needed` is 1 with a
        probability of at least 1 - `alpha`.
    n_predicted, n_predicted_interval
        Smallest N, tested or not, at which predicted skewness and kurtosis are below two standard
        errors for `n_means` Gaussian averages, ``2 sqrt(6 / n_means)`` and
        ``2 sqrt(24 / n_means)``, shape (...); and its 95 % interval, shape (..., 2). NaN where
        there is no answer, or where the samples do not identify their kurtosis.
    n_predicted_reason
        `Reason` codes of the prediction, shape (...).
    reason
        `Reason` codes, shape (..., size).
    """

    test: TestName
    n_means: int
    alpha: float
    sizes: Counts
    statistic: Floats = variable("test statistic of normality", "size")
    p_value: Floats = variable(
        "p-value of normality",
        "size",
        pooled=True,
        rejected="1 where not Gaussian, at the false discovery rate of the dataset",
    )
    skewness: Floats = variable("skewness of what was tested", "size")
    kurtosis: Floats = variable("excess kurtosis of what was tested", "size")
    predicted_skewness: Floats = variable("skewness of averages of independent samples", "size")
    predicted_kurtosis: Floats = variable(
        "excess kurtosis of averages of independent samples", "size"
    )
    skewness_ratio: Floats = variable(
        "skewness of averages over what independent samples predict", "size"
    )
    n_needed: Counts
    n_predicted: Floats = variable(
        "samples per average of a predicted shape that is nearly Gaussian"
    )
    n_predicted_interval: Floats = variable("95 % interval of n_predicted", "bound")
    n_predicted_reason: npt.NDArray[np.int8] = variable("why there is no n_predicted")
    reason: npt.NDArray[np.int8] = variable("why there is no test", "size")


def _n_in_words(found: GaussianityOfMeans, row: int) -> str:
    n = int(found.n_needed[row])
    return {MORE_THAN_TESTED: f"> {found.sizes[-1]}", UNTESTED: "—"}.get(n, str(n))


def _n_among(found: GaussianityOfMeans) -> Floats:
    needed, sizes = found.n_needed, found.sizes
    place = np.where(needed == UNTESTED, np.nan, np.searchsorted(sizes, needed))
    return np.where(needed == MORE_THAN_TESTED, len(sizes), place)


@dataclass(frozen=True)
class NormalityOfMeans(Statistic[GaussianityOfMeans]):
    """Tests of averages of N samples; options as in `gaussianity_of_means`, all N in `sizes`."""

    result: ClassVar = GaussianityOfMeans
    description: ClassVar = "testing normality of means"
    logarithms: ClassVar = False
    quantities: ClassVar = (Quantity("N for Gaussian averages", _n_in_words, of_constant=True),)

    sizes: tuple[int, ...]
    n_means: int = N_MEANS
    test: TestName = "shapiro-wilk"
    alpha: float = 0.05

    def maps(self) -> tuple[MapKind, ...]:
        """Return the N needed, as its place among those tested; one more where it is larger."""
        names = {i: f"N = {n}" for i, n in enumerate(self.sizes)}
        names[len(names)] = f"N > {self.sizes[-1]}"
        title = "N needed for Gaussian averages"
        return (MapKind("n_needed", title, "samples, luminance", _n_among, names, ordered=True),)

    @classmethod
    def of_pixel(cls, spp: int) -> Self | None:
        """Return the tests of all N that so many samples allow; None where they allow none."""
        return cls(tuple(sizes_of_means(spp).tolist())) if spp >= N_MEANS else None

    def attrs(self) -> dict[str, Any]:
        """Return what was tested, and the level of ``rejected``."""
        title = f"{self.test} on averages of N samples"
        return {"test": title, "false_discovery_rate": self.alpha, "n_means": self.n_means}

    def measure(self, part: PositivePart) -> GaussianityOfMeans:
        """Test averages of all samples of each row; return the N needed and predicted, too."""
        x, bad, sizes = part.x, is_bad(part.x), np.array(self.sizes)
        n_predicted, interval, reason = _predict(x, bad, measured(part, TailIndex()), self.n_means)
        found, (skewness, kurtosis, n) = _tested(x, bad, sizes, self.n_means, TESTS[self.test])
        predicted = skewness[..., np.newaxis] / np.sqrt(sizes)
        # Bonferroni over the sizes: otherwise each further size would be a chance to fail.
        rejected = found["p_value"] * len(sizes) <= self.alpha
        clear = np.abs(skewness) > 2 * np.sqrt(6 / n)
        ratio = np.where(clear[..., np.newaxis], found["skewness"] / predicted, np.nan)
        return GaussianityOfMeans(
            test=self.test,
            n_means=self.n_means,
            alpha=self.alpha,
            sizes=sizes,
            **found,
            predicted_skewness=predicted,
            predicted_kurtosis=kurtosis[..., np.newaxis] / sizes,
            skewness_ratio=ratio,
            n_needed=_needed(rejected, found["reason"], np.isfinite(skewness), sizes),
            n_predicted=n_predicted,
            n_predicted_interval=interval,
            n_predicted_reason=reason,
        )

    def finish(self, dataset: xr.Dataset) -> xr.Dataset:
        """Add q-values, the share of rejections, and the N needed, which follow from them."""
        dataset, pixels = super().finish(dataset), ("y", "x")
        tested, rejected = dataset["p_value"].notnull().sum(pixels), dataset["rejected"]
        share = rejected.sum(pixels) / tested.where(tested > 0)
        dataset["rejected_share"] = share.assign_attrs(
            long_name="share of pixels whose averages are not Gaussian", units="1"
        )
        varied = dataset["predicted_skewness"].notnull().any("size")
        needed = _needed(
            (rejected == 1).to_numpy(), dataset["reason"].to_numpy(), varied.to_numpy(), self.sizes
        )
        about = {
            "long_name": "samples per average from which on normality is not rejected",
            "units": "1",
            "flag_values": [MORE_THAN_TESTED, UNTESTED],
            "flag_meanings": "more_than_tested untested",
        }
        dataset["n_needed"] = varied.dims, needed, about
        for name in ("predicted_skewness", "predicted_kurtosis", "skewness_ratio"):
            dataset[name].attrs["comment"] = (
                "assumes finite moments; not to be trusted where the tail index is 1/2 or more"
            )
        dataset["n_predicted"].attrs["comment"] = "NaN where n_predicted_reason says why"
        about = {"long_name": "samples per average", "units": "1"}
        return dataset.assign_coords(size=("size", np.array(self.sizes), about))


@of_source
def gaussianity_of_means(
    x: Source,
    *,
    sizes: Sequence[int] | None = None,
    n_means: int = N_MEANS,
    test: TestName = "shapiro-wilk",
    alpha: float = 0.05,
    progress: bool = True,
) -> GaussianityOfMeans | xr.Dataset:
    """Test whether pixel estimates, the averages of N samples, are Gaussian, for N = 1, 2, 4, ...

    The samples are cut into batches of N in stored order, without overlap. The first `n_means`
    averages are tested. Their number is the same for every N, so that all tests have the same
    power, and a falling share of rejections means that the averages have changed. Nulls belong to
    an estimate and are averaged. Bad samples are left out of their batch.

    The N needed answers the question "can `n_means` of these averages reject normality?". For more
    averages, the N needed is larger. If the tested averages are all equal although the samples are
    not, they count as not Gaussian.

    Parameters
    ----------
    x, progress
        As for `chdstat.fit.fit`.
    sizes
        The N; by default, the powers of 2 up to spp / n_means.
    n_means
        Number of averages to test for every N. With 32, 512 spp reach N = 16.
    test
        As for `chdstat.gaussianity`. The default has the greatest power for few averages.
    alpha
        For an array: level of all tests behind `n_needed` together. For `Samples`: false discovery
        rate of ``rejected``, from which `n_needed` follows.

    Returns
    -------
    GaussianityOfMeans or xarray.Dataset
        `GaussianityOfMeans` for an array. For `Samples`, its fields over (y, x, channel, size),
        with `n_needed` and `n_predicted` over (y, x, channel); q-value and ``rejected`` as in
        `chdstat.gaussianity`, for every channel and N separately; and ``rejected_share`` over
        (channel, size), the share of the tested pixels that are rejected.

    Raises
    ------
    InputError
        If an option is unknown, or some N leaves fewer than `n_means` averages.

    Notes
    -----
    Skewness and kurtosis of the samples assume finite moments:

    ===========================================  ==================================================
    Tail index (see `chdstat.fit.tail_index`)    What is infinite
    ===========================================  ==================================================
    1/2 or more                                  the variance: averages never become Gaussian
    1/3 or more                                  the skewness
    1/4 or more                                  the kurtosis
    ===========================================  ==================================================

    For smaller indices, skewness and kurtosis are finite, but mostly too small, since they rest on
    rare bright samples. So N is predicted only where these samples can be judged:

    - At least 1379 samples are not null (else `TOO_FEW`). Nearly every pixel has then seen each
      kind of light that makes 0.5 % of these samples.
    - The variance is trusted, the tail index is below 1/4 by 2.81 standard errors, and the fourth
      moment does not rest on a few samples (else `UNIDENTIFIED`).

    The upper end of the interval of N takes the tail to be as heavy as that largest index allows,
    and as that of a log-normal distribution if the logarithms may be Gaussian.

    With 2048 samples, this share of the pixels has a prediction:

    =============================  =========
    Samples                        Predicted
    =============================  =========
    gamma, shape 5                 99 %
    exponential                    89 %
    log-normal, sigma = 0.5        69 %
    log-normal, sigma = 1          about 0
    =============================  =========

    With 2048 and 4096 samples, the interval misses the N of the distribution in 0 to 5 % of the
    pixels with a prediction: for exponential, gamma, log-normal, Weibull and uniform samples, for
    mixtures of two, and for these beside nulls. Light that is rarer than 0.5 %, and power laws with
    an index close to 1/4, may hide in pixels with a prediction.

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
    given = opened(cast("ImageLike | npt.ArrayLike", x))
    spp = given.spp if isinstance(given, Samples) else as_samples(given).shape[-1]
    chosen = sizes_of_means(spp, n_means, sizes=sizes, test=test)
    statistic = NormalityOfMeans(tuple(chosen.tolist()), n_means, test, alpha)
    return run(statistic, given, progress=progress)


def sizes_of_means(
    spp: int,
    n_means: int = N_MEANS,
    *,
    sizes: Sequence[int] | None = None,
    test: TestName = "shapiro-wilk",
) -> Counts:
    """Return the N to test in ascending order, or raise InputError if there are none."""
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


@dataclass(frozen=True)
class Averages:
    """Averages of complete batches of `size` samples, shape (row, batch), without bad samples.

    ``formed`` marks the batches with a good sample; the others average to 0. It is None if all
    batches have one. A row ends at its last good sample, since pixels with fewer samples than
    others are padded with bad ones.
    """

    size: int
    values: Floats
    formed: Mask | None


def nested_averages(x: npt.NDArray[Any], bad: Mask, sizes: Counts) -> Iterator[Averages]:
    """Yield the averages of samples, shape (row, sample), for ascending sizes."""
    spoilt = bool(bad.any())
    samples = x.astype(np.float64)
    if spoilt:
        np.copyto(samples, 0, where=bad)
    highest, lowest = samples.max(axis=-1, keepdims=True), samples.min(axis=-1, keepdims=True)
    largest = np.maximum(highest, -lowest)
    samples /= np.where(largest > 0, largest, 1)
    sums = {1: samples}
    counts = {1: np.subtract(1.0, bad)} if spoilt else {}
    length = samples.shape[-1] - (~bad[:, ::-1]).argmax(axis=-1, keepdims=True)
    for size in map(int, sizes):
        divisor = max(known for known in sums if size % known == 0)
        sums[size] = _grouped(sums[divisor], size // divisor)
        if not spoilt:
            yield Averages(size, sums[size] / size, None)
            continue
        counts[size] = _grouped(counts[divisor], size // divisor)
        ends = size * np.arange(1, counts[size].shape[-1] + 1)
        formed = (counts[size] > 0) & (ends <= length)
        yield Averages(size, formed * sums[size] / np.maximum(counts[size], 1), formed)


def _grouped(values: Floats, count: int) -> Floats:
    """Add up every `count` neighbours; drop the rest."""
    if count == 1:
        return values
    groups = values.shape[-1] // count
    if count == 2:
        return np.asarray(values[:, : 2 * groups : 2] + values[:, 1 : 2 * groups : 2])
    batches = values[:, : count * groups].reshape(len(values), groups, count)
    # For short batches, a product with ones is faster than a sum over a short axis.
    return np.asarray(batches @ np.ones(count))


def shapes(averages: Averages) -> tuple[Floats, Floats]:
    """Return skewness and excess kurtosis, divisor n; not finite for equal averages."""
    formed, values = averages.formed, averages.values
    n = values.shape[-1] if formed is None else np.count_nonzero(formed, axis=-1)
    deviation = values - (values.sum(axis=-1) / n)[:, np.newaxis]
    if formed is not None:
        deviation *= formed
    square = deviation * deviation
    variance = np.vecdot(deviation, deviation) / n
    skewness = np.vecdot(deviation, square) / n / variance**1.5
    return skewness, np.vecdot(square, square) / n / variance**2 - 3


_LEAST = 1379
"""Fewest samples other than 0. With so many, 999 of 1000 pixels have samples of a part of 0.5 %, as
``0.995^1379 = 0.001``; without such samples, skewness and kurtosis are those of the rest."""
_LARGEST_INDEX = 0.25
"""Tail index from which on the kurtosis is infinite."""
_CERTAIN = 2.81
"""Standard errors between an estimate and its upper end: two-sided, 99.5 %. A pixel has an answer
because its tail looks light: for up to a quarter of such pixels, an end of 97.5 % is too low."""
_SHARING = 4.0
"""Fewest samples that a fourth moment rests on: a single sample tells no moment."""
_GAUSSIAN = 4.0
"""Standard errors within which skewness and kurtosis of logarithms may be a Gaussian's."""


def _predict(
    x: npt.NDArray[Any], bad: Mask, tail: Tail, n_means: int
) -> tuple[Floats, Floats, npt.NDArray[np.int8]]:
    """Predict N from samples, shape (..., sample), their bad ones, and their tails.

    Return N, shape (...), its 95 % interval, shape (..., 2), and `Reason` codes where both are NaN.
    """
    samples, batch = x.shape[-1], x.shape[:-1]
    rows, good = x.reshape(-1, samples), ~bad.reshape(-1, samples)
    index, threshold = tail.xi + _CERTAIN * tail.standard_error, tail.threshold.reshape(-1)
    few = np.count_nonzero(good & (rows != 0), axis=-1).reshape(batch) < _LEAST
    # With clamped samples, or those of a lamp among nulls, nothing larger is missing.
    ends = np.isin(tail.reason, [Reason.TIED, Reason.CONSTANT])
    heavy = (tail.reason == Reason.OK) & ~((index < _LARGEST_INDEX) & tail.variance_trusted)
    heavy |= tail.reason == Reason.EDGE
    codes = [Reason.TOO_FEW, Reason.OK, Reason.UNIDENTIFIED]
    reason = np.select([few, ends, heavy], codes, tail.reason).reshape(-1).astype(np.int8)
    index = index.reshape(-1)
    found = np.full((3, len(rows)), np.nan)
    for part in chunks(len(rows), samples):
        relative, own = _relative(rows[part], good[part])
        reason[part] = np.where(own == Reason.OK, reason[part], own)
        known = np.flatnonzero(reason[part] == Reason.OK)
        at = np.arange(len(rows))[part][known]
        excess = good[at] & (rows[at] > threshold[at, np.newaxis])
        bounds, sharing = _bounds(relative[known], good[at], excess, index[at])
        reason[at[sharing < _SHARING]] = Reason.UNIDENTIFIED
        bounds[2] = np.fmax(bounds[2], _of_lognormal(rows[at], good[at]))
        needed = np.stack([n_of_shape(*shape, n_means=n_means) for shape in bounds])
        found[:, at] = np.where(sharing < _SHARING, np.nan, needed)
    low, n, high = found.reshape(3, *batch)
    return n, np.stack([low, high], axis=-1), reason.reshape(batch)


def n_of_shape(skewness: Floats, kurtosis: Floats, *, n_means: int) -> Floats:
    """Return the N at which absolute skewness and excess kurtosis of averages are a Gaussian's.

    They lie within two standard errors of those of `n_means` Gaussian averages.

    Under normality, the variances are 6 / n_means and 24 / n_means (Cramer 1946, section 29.3).
    """
    by_skewness = skewness**2 / (4 * 6 / n_means)
    by_kurtosis = kurtosis / (2 * np.sqrt(24 / n_means))
    return np.asarray(np.maximum(1, np.ceil(np.maximum(by_skewness, by_kurtosis))))


def _relative(x: npt.NDArray[Any], good: Mask) -> tuple[Floats, npt.NDArray[np.int8]]:
    """Return good samples as deviations from their mean, others as 0, and `Reason` codes.

    Deviations are in units of their standard deviation, so that their powers do not overflow.
    """
    values = np.where(good, x, 0).astype(np.float64)
    n = np.count_nonzero(good, axis=-1)
    largest = np.abs(values).max(axis=-1)
    values /= np.where(largest > 0, largest, 1)[:, np.newaxis]
    low = np.where(good, values, np.inf).min(axis=-1)
    high = np.where(good, values, -np.inf).max(axis=-1)
    reason = first_of(
        {
            Reason.ALL_BAD: n == 0,
            Reason.ALL_NULL: largest == 0,
            Reason.CONSTANT: high - low <= CONSTANT_SPREAD,
        }
    )
    values -= (values.sum(axis=-1) / n)[:, np.newaxis]
    values *= good
    values /= np.sqrt(np.vecdot(values, values) / n)[:, np.newaxis]
    return values, reason


def _bounds(z: Floats, good: Mask, excess: Mask, highest: Floats) -> tuple[Floats, Floats]:
    """Return absolute skewness and excess kurtosis, shape (3, 2, row): lower end, value, upper end.

    The errors are those of the influence functions. Towards more, they are on a logarithmic scale,
    since bright light of a few samples may well be less. The upper end is at least that of
    `_with_tail` for the largest tail index. Also return the number of equal samples with the same
    relative error of the fourth moment, shape (row,).
    """
    n = np.count_nonzero(good, axis=-1).astype(np.float64)
    square = z * z
    cube, fourth = square * z, square * square
    skewness, fourth_moment = cube.sum(axis=-1) / n, fourth.sum(axis=-1) / n
    a, b = skewness[:, np.newaxis], fourth_moment[:, np.newaxis]
    of_skewness = cube - a - 3 * z - 1.5 * a * (square - 1)
    of_kurtosis = fourth - b - 4 * a * z - 2 * b * (square - 1)
    errors = np.stack(
        [np.sqrt(np.sum(v * v, axis=-1, where=good)) / n for v in (of_skewness, of_kurtosis)]
    )
    found = np.abs([skewness, fourth_moment - 3])
    wider = (1 + found) * np.exp(_CERTAIN * errors / (1 + found)) - 1
    more = np.abs(_with_tail([z, square, cube, fourth], n, excess, highest))
    ends = np.stack([np.maximum(found - Z_95 * errors, 0), found, np.fmax(wider, more)])
    return ends, n * n * fourth_moment**2 / np.vecdot(fourth, fourth)


def _with_tail(
    powers: list[Floats], n: Floats, excess: Mask, index: Floats
) -> tuple[Floats, Floats]:
    """Return skewness and excess kurtosis with a generalised Pareto tail of the same mean excess.

    The moments of the tail are ``E Y^j = j! s^j / prod_i (1 - i xi)``, with i from 1 to j.
    """
    k = np.count_nonzero(excess, axis=-1)
    z = powers[0]
    threshold = np.where(k > 0, np.min(z, axis=-1, where=excess, initial=np.inf), 0.0)
    mean_excess = np.sum(z - threshold[:, np.newaxis], axis=-1, where=excess) / np.maximum(k, 1)
    scale = mean_excess * (1 - index)
    of_excess = [np.ones_like(scale)]
    for j in range(1, 5):
        of_excess.append(of_excess[-1] * j * scale / (1 - j * index))
    moments = []
    for j, power in enumerate(powers, start=1):
        body = np.sum(power, axis=-1, where=~excess)
        tail = sum(comb(j, i) * threshold ** (j - i) * of_excess[i] for i in range(j + 1))
        moments.append((body + np.where(k > 0, k * tail, 0)) / n)
    return _standardised(*moments)


def _of_lognormal(x: npt.NDArray[Any], good: Mask) -> Floats:
    """Return skewness and excess kurtosis of log-normal samples among nulls, shape (2, row).

    The variance of log x is the largest that the samples allow. Rows whose log x is clearly not
    Gaussian are NaN. A few thousand log-normal samples may look as if their tail were light, since
    most of the kurtosis lies beyond the largest of them.
    """
    positive = good & (x > 0)
    log = Moments.of(np.log(np.where(positive, x, 1), dtype=np.float64), positive)
    n, of = log.count, np.count_nonzero(good, axis=-1)
    scores = [log.skewness / np.sqrt(6 / n), log.kurtosis / np.sqrt(24 / n)]
    clear = np.abs(scores).max(axis=0) > _GAUSSIAN
    most = log.m2 / n * (1 + _CERTAIN * np.sqrt(2 / n))
    moments = [n / of * np.exp(j * j * most / 2) for j in range(1, 5)]
    return np.where(clear, np.nan, np.abs(_standardised(*moments)))


def _standardised(
    first: Floats, second: Floats, third: Floats, fourth: Floats
) -> tuple[Floats, Floats]:
    """Return skewness and excess kurtosis from moments about 0."""
    variance = second - first**2
    about_mean = third - 3 * first * second + 2 * first**3
    fourth = fourth - 4 * first * third + 6 * first**2 * second - 3 * first**4
    return about_mean / variance**1.5, fourth / variance**2 - 3


def _tested(
    x: npt.NDArray[Any], bad: Mask, sizes: Counts, n_means: int, test: NormalityTest
) -> tuple[dict[str, npt.NDArray[Any]], Floats]:
    """Test the first `n_means` averages for each ascending size; `x` has shape (..., sample).

    Return statistic, p-value, skewness, kurtosis and reason of the averages by name, each of shape
    (..., size), NaN where the reason is not OK. Also return skewness, kurtosis and number of the
    samples themselves, shape (3, ...), NaN where they are equal or bad.
    """
    samples, batch = x.shape[-1], x.shape[:-1]
    rows, masks = x.reshape(-1, samples), bad.reshape(-1, samples)
    found = np.empty((4, len(rows), len(sizes)))
    reason = np.empty((len(rows), len(sizes)), dtype=np.int8)
    whole = np.empty((3, len(rows)))
    # Rows without an answer are computed, too, and masked by their reason.
    for part in chunks(len(rows), samples):
        levels = list(nested_averages(rows[part], masks[part], np.union1d(1, sizes)))
        whole[:, part] = _of_samples(levels[0])
        wanted = [level for level in levels if level.size in sizes]
        found[:, part], reason[part] = _of_averages(wanted, n_means, test)
    names = ("statistic", "p_value", "skewness", "kurtosis")
    tested = dict(zip(names, found.reshape(4, *batch, len(sizes)), strict=True))
    return {**tested, "reason": reason.reshape(*batch, len(sizes))}, whole.reshape(3, *batch)


def _needed(
    rejected: Mask, reason: npt.NDArray[np.int8], varied: Mask, sizes: npt.ArrayLike
) -> Counts:
    """Return the smallest size tested from which on normality is not rejected, shape (...).

    Averages that are all equal although the samples are not count as not Gaussian.
    """
    equal = np.isin(reason, [Reason.ALL_NULL, Reason.CONSTANT])
    answered = equal | (reason == Reason.OK)
    rejected_from_here_on = np.maximum.accumulate((rejected | equal)[..., ::-1], axis=-1)[..., ::-1]
    candidates = ~rejected_from_here_on & answered
    first = np.where(
        candidates.any(axis=-1), np.asarray(sizes)[candidates.argmax(axis=-1)], MORE_THAN_TESTED
    )
    return np.where(varied & answered.any(axis=-1), first, UNTESTED).astype(np.int64)


def _of_averages(
    levels: list[Averages], n_means: int, test: NormalityTest
) -> tuple[Floats, npt.NDArray[np.int8]]:
    """Return test and shape, (4, row, size), and reasons, (row, size)."""
    tested = np.stack([level.values[:, :n_means] for level in levels], axis=1)
    n = np.full(tested.shape[:-1], n_means)
    if levels[0].formed is not None:
        formed = np.stack([np.asarray(level.formed)[:, :n_means] for level in levels], axis=1)
        tested, n = np.where(formed, tested, np.inf), np.count_nonzero(formed, axis=-1)
    tested = np.sort(tested, axis=-1)
    first, last = tested[..., 0], tested[..., -1]
    largest = np.maximum(last, -first)
    reason = first_of(
        {
            Reason.ALL_BAD: n == 0,
            Reason.TOO_FEW: n < n_means,
            Reason.ALL_NULL: largest == 0,
            Reason.CONSTANT: last - first <= CONSTANT_SPREAD * largest,
        }
    )
    usable = reason == Reason.OK
    results = run_tests(tested, n, usable, ("linear",), (test,))
    # Skewness and kurtosis are those of all averages, of which only some are tested.
    moments = np.array([shapes(level) for level in levels]).transpose(1, 2, 0)
    found = np.stack([results["statistic"][..., 0, 0], results["p_value"][..., 0, 0], *moments])
    found[:, ~usable] = np.nan
    return found, reason


def _of_samples(samples: Averages) -> Floats:
    """Return skewness, kurtosis and number of the samples themselves, shape (3, row)."""
    values, formed = samples.values, samples.formed
    n = np.full(len(values), float(values.shape[-1]))
    high = low = values
    if formed is not None:
        n = np.count_nonzero(formed, axis=-1).astype(np.float64)
        high, low = (np.where(formed, values, end) for end in (-np.inf, np.inf))
    # The size of the largest is 1, unless all are 0.
    varied = high.max(axis=-1) - low.min(axis=-1) > CONSTANT_SPREAD
    skewness, kurtosis = (np.where(varied, shape, np.nan) for shape in shapes(samples))
    return np.stack([skewness, kurtosis, n])
