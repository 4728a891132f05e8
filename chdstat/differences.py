"""Differences: how far two CHDs are apart, and whether chance alone would do that.

Use it for two pixels, or for one pixel in two stores: of another integrator, path length or spp.
`chdstat.compare` is about estimators.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._arrays import generator, is_bad
from chdstat.errors import InputError

__all__ = ["Difference", "difference"]

_MOST = 4096
_REPLICATES = 199

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Difference:
    """How two sets of samples of the same channels differ; nulls belong to both.

    Attributes
    ----------
    distance
        Kolmogorov-Smirnov's distance of the distribution functions, shape (channel,).
    wasserstein
        Wasserstein's distance, the mean shift of radiance, shape (channel,), radiance.
    p_value
        Of the hypothesis that both are of one distribution: by permutation of whole samples, of the
        largest distance over the channels. NaN without samples.
    mean_difference
        Mean of the second minus that of the first, shape (channel,), radiance.
    mean_t
        That difference over its standard error, shape (channel,); NaN without scatter.
    mean_p_value
        Two-sided p-values of the differences by Welch's test, shape (channel,), each for itself.
    n
        Good samples of both that distances look at.
    """

    distance: Floats
    wasserstein: Floats
    p_value: float
    mean_difference: Floats
    mean_t: Floats
    mean_p_value: Floats
    n: tuple[int, int]


def difference(
    a: npt.ArrayLike, b: npt.ArrayLike, *, replicates: int = _REPLICATES, seed: int = 0
) -> Difference:
    """Compare two CHDs, each given by the samples of a pixel.

    ``D = max |F_a - F_b|``. Ties, such as nulls, make the textbook's p-values of D wrong, so that
    the samples are shuffled between the two sets: ``p = (b + 1) / (B + 1)`` where b of B shuffles
    are as far apart. Whole samples are shuffled, so that dependent channels stay together and no
    correction for their number is needed.

    Parameters
    ----------
    a, b
        Linear radiance, shapes (channel, sample). Bad samples are left out; distances look at
        4096 samples at most, means at all.
    replicates, seed
        Shuffles B, and the seed of them.

    Returns
    -------
    Difference
        Distances and differences of each channel, and one p-value for all of them.

    Raises
    ------
    InputError
        If the numbers of channels differ, or B is less than 1.

    References
    ----------
    Kolmogorov-Smirnov by permutation: Praestgaard, "Permutation and bootstrap Kolmogorov-Smirnov
    tests for the equality of two distributions", 1995, Scandinavian Journal of Statistics 22.
    Means: Welch, "The generalization of 'Student's' problem when several different population
    variances are involved", 1947, doi:10.1093/biomet/34.1-2.28.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> same = difference(rng.gamma(2.0, size=(3, 500)), rng.gamma(2.0, size=(3, 500)))
    >>> other = difference(rng.gamma(2.0, size=(3, 500)), rng.gamma(3.0, size=(3, 500)))
    >>> same.p_value > 0.05, other.p_value
    (True, 0.005)
    """
    one, two = (_good(x) for x in (a, b))
    if one.shape[0] != two.shape[0]:
        message = f"expected as many channels in both, got {one.shape[0]} and {two.shape[0]}"
        raise InputError(message)
    if replicates < 1:
        message = f"replicates must be at least 1, got {replicates}"
        raise InputError(message)
    delta, t, p = _means(one, two)
    one, two = one[:, :_MOST], two[:, :_MOST]
    n = (one.shape[1], two.shape[1])
    if min(n) == 0:
        nan = np.full(len(one), np.nan)
        return Difference(nan, nan, float("nan"), delta, t, p, n)
    pool = np.concatenate([one, two], axis=1)
    order = np.argsort(pool, axis=-1, kind="stable")
    ordered = np.take_along_axis(pool, order, axis=-1)
    last = np.append(ordered[:, 1:] > ordered[:, :-1], np.ones((len(pool), 1), bool), axis=1)
    first = np.arange(pool.shape[1]) < n[0]
    gaps = _gaps(first, order, n)
    distance = np.where(last, gaps, 0).max(axis=-1)
    wasserstein = (gaps[:, :-1] * np.diff(ordered)).sum(axis=-1)
    rng, farther = generator(seed), 0
    for _ in range(replicates):
        shuffled = np.where(last, _gaps(rng.permutation(first), order, n), 0)
        farther += bool(shuffled.max() >= distance.max() - 1e-12)
    p_value = (farther + 1) / (replicates + 1)
    return Difference(distance, wasserstein, p_value, delta, t, p, n)


def _good(x: npt.ArrayLike) -> Floats:
    array = np.atleast_2d(np.asarray(x, np.float64))
    return np.asarray(array[:, ~is_bad(array).any(axis=0)])


def _gaps(first: npt.NDArray[np.bool_], order: npt.NDArray[np.intp], n: tuple[int, int]) -> Floats:
    """Return |F_a - F_b| after each of the ordered samples, of each channel."""
    steps = np.where(first, 1 / n[0], -1 / n[1])
    return np.asarray(np.abs(np.cumsum(steps[order], axis=-1)))


def _means(a: Floats, b: Floats) -> tuple[Floats, Floats, Floats]:
    if min(a.shape[1], b.shape[1]) < 2:
        nan = np.full(len(a), np.nan)
        return nan, nan, nan
    delta = b.mean(axis=-1) - a.mean(axis=-1)
    scale = np.maximum(a.max(axis=-1), b.max(axis=-1))  # so that 1e30 to the fourth is a number
    with np.errstate(divide="ignore", invalid="ignore", under="ignore"):
        errors = [(x / scale[:, np.newaxis]).var(axis=-1, ddof=1) / x.shape[1] for x in (a, b)]
        squared = errors[0] + errors[1]
        t = delta / scale / np.sqrt(squared)
        # Welch (1947), equation 28: the degrees of freedom of the sum of two variances.
        parts = (e**2 / (x.shape[1] - 1) for e, x in zip(errors, (a, b), strict=True))
        p = 2 * special.stdtr(squared**2 / sum(parts), -np.abs(t))
    # Without scatter, there is nothing to measure a difference by; rounding is none.
    constant = (np.ptp(a, axis=-1) == 0) & (np.ptp(b, axis=-1) == 0)
    return delta, np.where(constant, np.nan, t), np.where(constant, np.nan, p)
