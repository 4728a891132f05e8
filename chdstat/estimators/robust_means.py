"""The sample mean, the baseline of all estimators, and robust ones in its place.

**Robust means** group the samples into buckets, reweight the largest, or resample.

A firefly spoils one bucket only. `median_of_means` is the most robust and the darkest.
`gmon_binary` and `gmon_adaptive` measure by the Gini coefficient of the buckets how much robustness
a pixel needs; where the buckets agree, they are the mean.

`bayesian_median_of_means` corrects the mean by the skewness, smoothly and by little. `lee_valiant`
reduces the weight of samples far from the median of means, and tends to the mean as fast as any
estimator can. `jung2015` takes a robust location of the bootstrap means of a pixel.

**Robust locations.** Of order statistics, `median`, `trimmed_mean` and `winsorized_mean` treat both
ends equally. As radiance is skewed to the right, they are too dark. Where at least half of the
samples are null, the median is black; where all but the trimmed samples are, so is the trimmed
mean.

M-estimators solve ``sum_i psi((x_i - theta) / s) = 0`` with an influence function psi that is
bounded or grows slowly. `huber` limits the influence of far samples, `tukey` removes it. With more
samples, both tend to a centre of the distribution below its mean. `catoni` tends to the mean, as
its influence function widens with the number of samples.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Literal, get_args

import numpy as np

from chdstat._core.arrays import Floats, Reals, all_good, as_samples, is_bad, whole
from chdstat.errors import InputError, check_option, check_probability
from chdstat.estimators import registry
from chdstat.estimators.registry import register

_NORMAL_MAD = 0.6744897501960817
"""Median absolute deviation of the standard normal distribution."""
_TOLERANCE = 1e-12
"""Tolerance of a step, relative to the largest absolute sample of the row."""
_TUKEY_TOLERANCE = 1e-10
"""Tolerance of a step, relative to the scale."""


@register(
    "mean",
    "Metropolis and Ulam 1949, doi:10.1080/01621459.1949.10483310",
    label="sample mean",
    place=0,
)
def mean(x: Reals) -> Reals:
    """Sample mean, (1/N) sum x_i: unbiased, but sensitive to fireflies.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample.

    References
    ----------
    N. Metropolis and S. Ulam, "The Monte Carlo method", Journal of the American Statistical
    Association 44(247), 1949, doi:10.1080/01621459.1949.10483310.

    Examples
    --------
    >>> float(mean([0.0, 1.0, 5.0]))
    2.0
    """
    return registry.mean_of_good(x)


@register("median", "Hampel 1974, doi:10.1080/01621459.1974.10482962", place=1)
def median(x: Reals) -> Reals:
    """Median of the samples: robust to fireflies in less than half of them.

    It estimates the median of the distribution, not its mean, so its bias does not vanish with more
    samples. ``median_of_means`` tends to the mean.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample.

    References
    ----------
    F. R. Hampel, "The influence curve and its role in robust estimation", Journal of the American
    Statistical Association 69(346), 1974, doi:10.1080/01621459.1974.10482962.

    Examples
    --------
    >>> float(median([1.0, 2.0, 900.0]))
    2.0
    """
    return registry.estimate_rows(x, registry.median_of_sorted, ordered=True)


@register("trimmed_mean", "Tukey 1962, doi:10.1214/aoms/1177704711", place=1)
def trimmed_mean(x: Reals, *, share: float = 0.1) -> Reals:
    """Mean of the samples without the g smallest and the g largest, g = floor(share N).

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out; N counts the good ones.
    share
        Share of the samples to leave out at each end, 0 (the mean) to less than 0.5.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, or `share` leaves none.

    References
    ----------
    J. W. Tukey, "The future of data analysis", Annals of Mathematical Statistics 33(1), 1962,
    doi:10.1214/aoms/1177704711.

    Examples
    --------
    >>> float(trimmed_mean([0.0, 1.0, 2.0, 3.0, 900.0], share=0.2))
    2.0
    """
    return _without_ends(x, share, pulled_in=False)


@register("winsorized_mean", "Dixon 1960, doi:10.1214/aoms/1177705900", place=1)
def winsorized_mean(x: Reals, *, share: float = 0.1) -> Reals:
    """Mean of the samples, with the g smallest and g largest set to their nearest remaining sample.

    The mean of ``clip(x, x_(g+1), x_(N-g))``, where x_(i) is the i-th smallest sample and g =
    floor(share N).

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out; N counts the good ones.
    share
        Share of the samples to replace at each end, 0 (the mean) to less than 0.5.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, or `share` leaves none.

    References
    ----------
    W. J. Dixon, "Simplified estimation from censored normal samples", Annals of Mathematical
    Statistics 31(2), 1960, doi:10.1214/aoms/1177705900.

    Examples
    --------
    >>> float(winsorized_mean([0.0, 1.0, 2.0, 3.0, 900.0], share=0.2))
    2.0
    """
    return _without_ends(x, share, pulled_in=True)


@register("huber", "Huber 1964, doi:10.1214/aoms/1177703732", label="Huber", place=2)
def huber(x: Reals, *, c: float = 1.345) -> Reals:
    """Huber's location: samples farther than c scales count as if they were c scales away.

    Solves ``sum_i clip((x_i - theta) / s, -c, c) = 0`` with ``s = MAD / 0.6745``; MAD is the median
    absolute deviation from the median. Where more than half of the samples are equal, for example
    null, s is 0 and the estimate is their value.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.
    c
        Scales up to which a sample counts in full, larger than 0. The default costs 5 % efficiency
        on normal samples. The estimate tends to the mean for c to infinity and to the median for c
        to 0.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, or `c` is not positive.

    References
    ----------
    P. J. Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics
    35(1), 1964, doi:10.1214/aoms/1177703732.

    Examples
    --------
    >>> x = [1.0, 2.0, 3.0, 5.0, 900.0]
    >>> float(huber(x).round(3)), float(huber(x, c=1e9).round(3))
    (3.747, 182.2)
    """

    def influence(rows: Floats, theta: Floats, reach: Floats) -> tuple[Floats, Floats]:
        deviation = rows - theta[:, np.newaxis]
        limit = reach[:, np.newaxis]
        inside = np.count_nonzero(np.abs(deviation) < limit, axis=-1)
        np.minimum(deviation, limit, out=deviation)
        np.maximum(deviation, -limit, out=deviation)
        total = _row_sums(deviation)
        # Between two samples the sum may stay 0; rounding must not move the estimate there.
        total[np.abs(total) <= 1e-15 * rows.shape[-1] * reach] = 0
        return total, inside.astype(np.float64)

    return _by_deviation(x, partial(balance, influence), c)


@register(
    "tukey", "Beaton and Tukey 1974, doi:10.1080/00401706.1974.10489171", label="Tukey", place=2
)
def tukey(x: Reals, *, c: float = 4.685) -> Reals:
    """Tukey's biweight location: samples farther than c scales do not count.

    ``theta = sum_i w_i x_i / sum_i w_i`` with ``w_i = (1 - ((x_i - theta) / (c s))^2)^2`` within
    c scales and 0 beyond, ``s = MAD / 0.6745``; iterated from the median. Where more than half of
    the samples are equal, s is 0 and the estimate is their value.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.
    c
        Scales at which a sample stops counting, larger than 0; the default costs 5 % efficiency on
        normal samples.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, or `c` is not positive.

    References
    ----------
    A. E. Beaton and J. W. Tukey, "The fitting of power series, meaning polynomials, illustrated on
    band-spectroscopic data", Technometrics 16(2), 1974, doi:10.1080/00401706.1974.10489171.

    Examples
    --------
    >>> float(tukey([1.0, 2.0, 3.0, 4.0, 900.0]).round(3))
    2.5
    """
    return _by_deviation(x, _biweight, c)


@register(
    "catoni", "Catoni 2012, doi:10.1214/11-AIHP454", label="Catoni", place=2, minimum_samples=10
)
def catoni(x: Reals, *, delta: float = 0.01) -> Reals:
    """Catoni's mean: the influence of a sample grows only with the logarithm of its distance.

    Solves ``sum_i psi(a (x_i - theta)) = 0`` with ``psi(t) = sign(t) log(1 + |t| + t^2 / 2)``, ``l
    = log(1 / delta)`` and ``a^2 = 2 l / (N (v + 2 v l / (N - 2 l)))`` (Catoni's proposition 2.4).
    Catoni bounds the error with probability 1 - 2 delta for a known variance v. Here v is the
    sample variance, which fireflies inflate: a single firefly loses only a quarter of its
    influence.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out. A row with at most 2 l
        good samples gets their mean.
    delta
        Probability of a large error, between 0 and 1. N must exceed 2 l, 9.2 for the default.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds at most 2 l samples, or `delta` is not a probability.

    References
    ----------
    O. Catoni, "Challenging the empirical mean and empirical variance: a deviation study", Annales
    de l'Institut Henri Poincare 48(4), 2012, doi:10.1214/11-AIHP454.

    Examples
    --------
    >>> x = [1.0] * 31 + [900.0]
    >>> float(np.mean(x)), float(catoni(x).round(1))
    (29.09375, 22.3)
    """
    check_probability(delta=delta)
    level = float(np.log(1 / delta))
    as_samples(x, minimum=int(2 * level) + 1)

    def influence(rows: Floats, theta: Floats, width: Floats) -> tuple[Floats, Floats]:
        a = 1 / width
        t = (rows - theta[:, np.newaxis]) * a[:, np.newaxis]
        size = np.abs(t)
        inner = 1 + size + 0.5 * t * t
        slope = a * _row_sums((1 + size) / inner)
        return _row_sums(np.copysign(np.log(inner), t)), slope

    def kernel(rows: Floats) -> Floats:
        n = rows.shape[-1]
        mean = _row_sums(rows) / n
        if n <= 2 * level:
            return np.asarray(mean)
        deviation = rows - mean[:, np.newaxis]
        variance = np.vecdot(deviation, deviation) / n
        width = np.sqrt(n * variance * (1 + 2 * level / (n - 2 * level)) / (2 * level))
        return _where_spread(partial(balance, influence), rows, mean, width)

    return registry.estimate_rows(x, kernel)


def balance(
    influence: Callable[..., tuple[Floats, Floats]], rows: Floats, start: Floats, *beside: Floats
) -> Floats:
    """Solve sum_i psi(x_i - theta) = 0 for theta in each row.

    Newton's method inside a shrinking bracket, for M-estimators with a monotone influence function.

    Parameters
    ----------
    influence
        ``influence(rows, theta, *beside)`` returns the sum and minus its derivative by theta, shape
        (row,). The sum decreases with theta.
    rows, beside
        Samples, shape (row, m), and other values of each row, shape (row,).
    start
        First guesses, shape (row,), within the range of each row.
    """

    def update(
        here: Floats, rows: Floats, low: Floats, high: Floats, *beside: Floats
    ) -> tuple[Floats, ...]:
        total, slope = influence(rows, here, *beside)
        low, high = np.where(total > 0, here, low), np.where(total < 0, here, high)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            there = here + total / slope
        # The bracket also catches steps from a flat piece, which may land anywhere or be NaN.
        there = np.where((there >= low) & (there <= high), there, 0.5 * (low + high))
        return np.where(total == 0, here, there), rows, low, high, *beside

    low, high = rows.min(axis=-1), rows.max(axis=-1)
    near = _TOLERANCE * np.maximum(high, -low)
    return registry.converge(update, start, near, rows, low, high, *beside)


def _row_sums(rows: Floats) -> Floats:
    """Return the sums of rows; for short rows, a product with ones is faster than a sum."""
    return np.asarray(rows @ np.ones(rows.shape[-1]))


def _without_ends(x: Reals, share: float, *, pulled_in: bool) -> Reals:
    """Average the samples with a share at each end left out, or set to the nearest kept sample."""
    if not 0 <= share < 0.5:
        message = f"share must be at least 0 and less than 0.5, got {share}"
        raise InputError(message)

    def kernel(rows: Floats) -> Floats:
        m = rows.shape[-1]
        cut = int(share * m)
        inner = _row_sums(rows[:, cut : m - cut])
        if pulled_in:
            return np.asarray((inner + cut * (rows[:, cut] + rows[:, m - 1 - cut])) / m)
        return np.asarray(inner / (m - 2 * cut))

    return registry.estimate_rows(x, kernel, ordered=True)


def _by_deviation(x: Reals, solve: Callable[..., Floats], c: float) -> Reals:
    """Solve rows with the reach c times the normalised median absolute deviation of each row."""
    registry.check_positive(c=c)

    def kernel(rows: Floats) -> Floats:
        centre = registry.median_of_sorted(rows)
        deviation = np.sort(np.abs(rows - centre[:, np.newaxis]))
        scale = registry.median_of_sorted(deviation) / _NORMAL_MAD
        return _where_spread(solve, rows, centre, c * scale)

    return registry.estimate_rows(x, kernel, ordered=True)


def _where_spread(
    solve: Callable[..., Floats], rows: Floats, centre: Floats, scale: Floats
) -> Floats:
    """Solve the rows with a positive scale; the others keep their centre."""
    # A deviation below the spacing of doubles is rounding.
    some = np.flatnonzero(scale > 1e-15)
    result = centre.copy()
    result[some] = solve(rows[some], centre[some], scale[some])
    return result


def _biweight(rows: Floats, start: Floats, reach: Floats) -> Floats:
    def update(here: Floats, rows: Floats, reach: Floats) -> tuple[Floats, ...]:
        weight = (rows - here[:, np.newaxis]) / reach[:, np.newaxis]
        np.square(weight, out=weight)
        np.subtract(1, weight, out=weight)
        np.maximum(weight, 0, out=weight)
        np.square(weight, out=weight)
        # At least half of the samples lie within a MAD of the median, so the weights never vanish
        # for c >= 0.7. For smaller c they may all be 0; then the estimate stays.
        total = _row_sums(weight)
        there = np.divide(np.vecdot(weight, rows), total, out=here.copy(), where=total > 0)
        return there, rows, reach

    return registry.converge(update, start, _TUKEY_TOLERANCE * reach, rows, reach)


# --- the mean, order statistics and M-estimators --------------------------------------------------


_Location = Literal["median", "huber"]

_BUISINE = "Buisine et al. 2021, doi:10.2312/sr.20211296"


@register("median_of_means", "Nemirovsky and Yudin 1983", place=3, minimum_samples=11)
def median_of_means(x: Reals, buckets: int = 11) -> Reals:
    """Median of means: deal the samples into M buckets, take the median of the buckets' means.

    A firefly spoils one bucket, so fewer than M/2 fireflies do not move the estimate far. As
    radiance is skewed to the right, the estimate is too dark: by 5 % for gamma(2), by 40 % where
    most samples are null (32 samples, 11 buckets).

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out of their
        bucket; a bucket without a good sample is left out of the median.
    buckets
        M. Sample i belongs to bucket i mod M.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If there are fewer samples than buckets, or no bucket.

    References
    ----------
    A. Nemirovsky and D. Yudin, "Problem Complexity and Method Efficiency in Optimization", 1983.

    Examples
    --------
    >>> float(median_of_means([1.0, 1.0, 1.0, 1.0, 1.0, 900.0], buckets=3))
    1.0
    """
    return registry.estimate_rows(bucket_means(x, buckets), registry.median_of_sorted, ordered=True)


@register("gmon_binary", _BUISINE, label="G-MoN, binary", place=3, minimum_samples=11)
def gmon_binary(x: Reals, *, buckets: int = 11, threshold: float = 0.25) -> Reals:
    """Binary G-MoN: the mean where the buckets agree, else the median of means.

    The buckets agree if their Gini coefficient (`gini`) is at most the threshold. Formula and
    threshold follow the authors' code.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out of their
        bucket; a bucket without a good sample is left out.
    buckets
        M, see `median_of_means`.
    threshold
        Largest Gini coefficient that counts as agreement, 0 to 1.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If there are fewer samples than buckets, or no bucket.

    References
    ----------
    J. Buisine, S. Delepoulle and C. Renaud, "Firefly removal in Monte Carlo rendering with adaptive
    median of means", Eurographics Symposium on Rendering, 2021, doi:10.2312/sr.20211296.

    Examples
    --------
    >>> x = np.tile([1.0, 2.0], 6)
    >>> float(gmon_binary(x, buckets=3)), float(gmon_binary([*x, 900.0], buckets=3))
    (1.5, 1.5)
    """

    def kernel(means: Floats, mean: Floats) -> Floats:
        return np.where(gini(means) <= threshold, mean, registry.median_of_sorted(means))

    means, mean = bucket_means(x, buckets), registry.mean_of_good(x)
    return registry.estimate_rows(means, kernel, mean, ordered=True)


@register("gmon_adaptive", _BUISINE, label="G-MoN, adaptive", place=3, minimum_samples=11)
def gmon_adaptive(x: Reals, *, buckets: int = 11) -> Reals:
    """Adaptive G-MoN: leave out buckets at both ends, more of them the less the buckets agree.

    The mean of the ascending bucket means ``m_(c+1) .. m_(M-c)`` with ``c = floor(G floor(M /
    2))``, where G is their Gini coefficient (`gini`). It goes from the mean of all buckets (G = 0)
    towards the median of means (G = 1). The formula follows the authors' code.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out of their
        bucket; M counts the buckets with a good sample.
    buckets
        M, see `median_of_means`.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If there are fewer samples than buckets, or no bucket.

    References
    ----------
    J. Buisine, S. Delepoulle and C. Renaud, "Firefly removal in Monte Carlo rendering with adaptive
    median of means", Eurographics Symposium on Rendering, 2021, doi:10.2312/sr.20211296.

    Examples
    --------
    >>> float(gmon_adaptive([1.0, 1.0, 1.0, 1.0, 900.0], buckets=5))
    1.0
    """

    def kernel(means: Floats) -> Floats:
        buckets_left = means.shape[-1]
        cut = (gini(means) * (buckets_left // 2)).astype(np.int64)
        rank = np.arange(buckets_left)
        kept = (rank >= cut[:, np.newaxis]) & (rank < buckets_left - cut[:, np.newaxis])
        return np.asarray(np.vecdot(means, kept) / (buckets_left - 2 * cut))

    return registry.estimate_rows(bucket_means(x, buckets), kernel, ordered=True)


@register(
    "bayesian_median_of_means",
    "Orenstein 2019, doi:10.48550/arXiv.1906.01204",
    label="aBMM",
    place=4,
)
def bayesian_median_of_means(x: Reals, *, alpha: float = 1.0) -> Reals:
    """Approximate Bayesian median of means (aBMM): the mean, corrected by the skewness.

    ``mean - sigma g / (3 (N alpha + 2))`` with the standard deviation sigma (divisor N) and the
    skewness g of the samples. It approximates the median of the means with Dirichlet(alpha)
    weights, without drawing any. The correction vanishes as 1/N, faster than the error of the mean.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.
    alpha
        Concentration of the weights, larger than 0. For alpha to infinity the estimate is the mean.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`, within the range of the samples; NaN
        where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, or `alpha` is not positive.

    References
    ----------
    P. Orenstein, "Robust mean estimation with the Bayesian median of means", 2019,
    doi:10.48550/arXiv.1906.01204.

    Examples
    --------
    >>> x = [1.0] * 31 + [33.0]
    >>> float(np.mean(x)), round(float(bayesian_median_of_means(x)), 3)
    (2.0, 1.706)
    """
    registry.check_positive(alpha=alpha)

    def kernel(rows: Floats) -> Floats:
        mean = _row_sums(rows) / rows.shape[-1]
        deviation = rows - mean[:, np.newaxis]
        square = deviation * deviation
        second, third = _row_sums(square), np.vecdot(square, deviation)
        # sigma times skewness is M3 / M2. Both are 0 for equal samples.
        shift = np.divide(third, second, out=np.zeros_like(mean), where=second > 1e-30)
        # A tiny alpha would correct too much: weighted means lie within the range of the samples.
        found = mean - shift / (3 * (rows.shape[-1] * alpha + 2))
        return np.asarray(np.clip(found, rows.min(axis=-1), rows.max(axis=-1)))

    return registry.estimate_rows(x, kernel)


@register(
    "lee_valiant",
    "Lee and Valiant 2021, doi:10.1109/FOCS52979.2021.00071",
    label="Lee and Valiant",
    place=4,
    minimum_samples=5,
)
def lee_valiant(x: Reals, *, delta: float = 0.01, buckets: int | None = None) -> Reals:
    """Lee and Valiant's mean: remove a fixed amount of weight from the samples far from the centre.

    The estimate is ``kappa + (1/N) sum (x_i - kappa) (1 - w_i)``, where kappa is the
    `median_of_means`, ``w_i = min(a (x_i - kappa)^2, 1)``, and a is such that ``sum w_i = log(1 /
    delta) / 3``.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.
    delta
        Probability of a large error, between 0 and 1. A smaller delta removes more weight. If fewer
        samples differ from kappa than that amount, they lose all their weight.
    buckets
        Buckets of the median of means; None takes log(1 / delta), rounded up, as the authors do.

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If there are fewer samples than buckets, no bucket, or `delta` is not a probability.

    References
    ----------
    J. C. H. Lee and P. Valiant, "Optimal sub-Gaussian mean estimation in R", Foundations of
    Computer Science, 2021, doi:10.1109/FOCS52979.2021.00071.

    Examples
    --------
    >>> float(lee_valiant([1.0] * 31 + [900.0]))
    1.0
    """
    check_probability(delta=delta)
    amount = float(np.log(1 / delta)) / 3

    def kernel(rows: Floats, centre: Floats) -> Floats:
        deviation = rows - centre[:, np.newaxis]
        square = deviation * deviation
        weight = square * _strength(square, amount)[:, np.newaxis]
        np.minimum(weight, 1, out=weight)
        np.subtract(1, weight, out=weight)
        return np.asarray(centre + np.vecdot(deviation, weight) / rows.shape[-1])

    count = max(1, int(np.ceil(3 * amount))) if buckets is None else buckets
    return registry.estimate_rows(x, kernel, median_of_means(x, buckets=count))


def _strength(square: Floats, amount: float) -> Floats:
    """Solve sum_i min(a s_i, 1) = amount for a in each row."""
    ascending = np.sort(square)
    full = np.arange(min(int(np.ceil(amount)), square.shape[-1]))
    # If the `full` largest weights are 1, the others share the rest of the amount.
    largest, rest = (a[:, ::-1][:, full] for a in (ascending, ascending.cumsum(axis=-1)))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        strength = (amount - full) / rest
        fits = (rest > 0) & (strength * largest <= 1)
    first = np.take_along_axis(strength, fits.argmax(axis=-1)[:, np.newaxis], axis=-1)[:, 0]
    # If too few samples deviate, each of them loses all weight: a is as good as infinite.
    return np.where(fits.any(axis=-1), first, 1e300)


@register(
    "jung2015",
    "Jung, Meyer and DeLong 2015, Computer Graphics Forum 34(2), pages 585-596",
    label="Jung et al. 2015",
    place=4,
)
def jung2015(
    x: Reals, *, resamples: int = 128, location: _Location = "median", seed: int = 0
) -> Reals:
    """Robust location of the bootstrap distribution of the mean.

    ``location(mean_1 .. mean_B)``, the means of B resamples of the N samples, drawn with
    replacement. If a few samples dominate the mean, this distribution is skewed and its centre lies
    below the mean.

    Reconstructed from the paper's abstract, which names the two steps; number and kind of the
    resamples and the location are chosen here. Resamples are balanced (each sample occurs B times
    in all), so their overall mean is the sample mean. All pixels use the same resamples.

    Parameters
    ----------
    x
        Samples, shape (..., sample). NaN and infinite samples are left out.
    resamples
        B, at least 1.
    location
        'median', or 'huber' for Huber's location.
    seed
        Seed of the resamples. The estimate depends on it, and on the order of the samples, by about
        the standard error of the mean over sqrt(B).

    Returns
    -------
    ndarray
        Estimates, shape (...), in the unit and dtype of `x`; NaN where no sample is good.

    Raises
    ------
    InputError
        If `x` holds no sample, `resamples` is below 1, or there is no such location.

    References
    ----------
    J. W. Jung, G. Meyer and R. DeLong, "Robust statistical pixel estimation", Computer Graphics
    Forum 34(2), 2015. A. C. Davison, D. V. Hinkley and E. Schechtman, "Efficient bootstrap
    simulation", Biometrika 73(3), 1986, doi:10.1093/biomet/73.3.555.

    Examples
    --------
    >>> x = np.arange(8.0) ** 4
    >>> float(x.mean()), bool(jung2015(x) < x.mean())
    (584.5, True)
    """
    resamples, seed = whole("resamples", resamples, least=1), whole("seed", seed, least=0)
    check_option("location", location, get_args(_Location))

    def kernel(rows: Floats) -> Floats:
        m = rows.shape[-1]
        means = rows @ bootstrap_counts(m, resamples, seed) / m
        if location == "median":
            return registry.median_of_sorted(np.sort(means))
        return huber(means).astype(np.float64)

    return registry.estimate_rows(x, kernel)


@lru_cache(maxsize=64)
def bootstrap_counts(samples: int, resamples: int, seed: int) -> Floats:
    """Return how often each sample occurs in each balanced resample, shape (sample, resample).

    Each row adds up to the number of resamples, each column to the number of samples.

    Examples
    --------
    >>> counts = bootstrap_counts(4, 6, 0)
    >>> counts.sum(axis=0).tolist(), counts.sum(axis=1).tolist()
    ([4.0, 4.0, 4.0, 4.0, 4.0, 4.0], [6.0, 6.0, 6.0, 6.0])
    """
    deck = np.random.default_rng(seed).permutation(np.tile(np.arange(samples), resamples))
    counts = np.zeros((samples, resamples))
    np.add.at(counts, (deck, np.repeat(np.arange(resamples), samples)), 1)
    return counts


def gini(ascending: Floats) -> Floats:
    """Return the Gini coefficient of ascending numbers (..., M): 0 for equal, (M-1)/M for one.

    ``G = sum_j (2 j - M - 1) m_(j) / (M sum_j |m_j|)``, 0 where all are 0. The absolute values
    extend it to negative numbers (Raffinetti, Siletti and Vernizzi 2015,
    doi:10.1007/s10260-014-0293-4).

    Examples
    --------
    >>> gini(np.array([[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 4.0]])).tolist()
    [0.0, 0.75]
    """
    count = ascending.shape[-1]
    total = np.abs(ascending).sum(axis=-1)
    # Ranks around their mean: equal numbers cancel exactly, and G is never below 0.
    weighted = ascending @ (2 * np.arange(1, count + 1) - (count + 1.0))
    share = np.divide(weighted, count * total, out=np.zeros_like(total), where=total > 0)
    return np.asarray(np.clip(share, 0, 1))


def bucket_means(x: Reals, buckets: int) -> Floats:
    """Return the means of round-robin buckets, shape (..., bucket); NaN for an empty bucket.

    Raises
    ------
    InputError
        If there are fewer samples than buckets, or no bucket.
    """
    if not 1 <= buckets <= x.shape[-1]:
        message = (
            f"buckets must lie between 1 and the number of samples, {x.shape[-1]}; got {buckets}. "
            "Give more samples or fewer buckets"
        )
        raise InputError(message)
    rows = x.reshape(-1, x.shape[-1])
    dealt = np.eye(buckets)[np.arange(x.shape[-1]) % buckets]
    if all_good(rows):
        means = (rows @ dealt) / dealt.sum(axis=0)
    else:
        good = ~is_bad(rows)
        with np.errstate(invalid="ignore"):
            means = (np.where(good, rows, 0) @ dealt) / (good.astype(np.float64) @ dealt)
    return np.asarray(means.reshape(*x.shape[:-1], buckets))
