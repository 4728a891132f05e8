"""The sample mean, the baseline of all estimators, and robust locations.

Order statistics: `median`, `trimmed_mean` and `winsorized_mean` treat both ends equally. As
radiance is skewed to the right, they are too dark. Where at least half of the samples are null, the
median is black; where all but the trimmed samples are, so is the trimmed mean.

M-estimators solve ``sum_i psi((x_i - theta) / s) = 0`` with an influence function psi that is
bounded or grows slowly. `huber` limits the influence of far samples, `tukey` removes it. With more
samples, both tend to a centre of the distribution below its mean. `catoni` tends to the mean, as
its influence function widens with the number of samples.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from chdstat._core.arrays import Floats, Reals, as_samples
from chdstat.errors import InputError, check_probability
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
        total = row_sums(deviation)
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
        slope = a * row_sums((1 + size) / inner)
        return row_sums(np.copysign(np.log(inner), t)), slope

    def kernel(rows: Floats) -> Floats:
        n = rows.shape[-1]
        mean = row_sums(rows) / n
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


def row_sums(rows: Floats) -> Floats:
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
        inner = row_sums(rows[:, cut : m - cut])
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
        total = row_sums(weight)
        there = np.divide(np.vecdot(weight, rows), total, out=here.copy(), where=total > 0)
        return there, rows, reach

    return registry.converge(update, start, _TUKEY_TOLERANCE * reach, rows, reach)
