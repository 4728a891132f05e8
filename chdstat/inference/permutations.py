"""Permutations: tests of many rows at once, by flips of signs and by divisions into two groups.

`p_of_signs` flips the signs of terms; `p_of_means` and `Shuffles` divide the samples of two groups.
If both groups have one distribution, every division of all samples into groups of these sizes is as
likely as the real one, for any tails, nulls and sizes. For sums, the tail of all flips or divisions
is approximated, so that p-values can be as small as many pixels need. For other statistics, the
same random shuffles serve all rows, as matrix products.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from chdstat._core.arrays import Array, Counts, Floats, Image, Mask, Reals, spans

_ENUMERATED = 10
"""Rows are enumerated if at most this many terms are not 0, or samples differ from most."""
_TERMS_AT_ONCE = 2**20
"""Terms or samples of the rows that are worked on together."""
_NEAR_MEAN = 0.1
"""Likelihood ratio below which a saddlepoint is too close to the mean."""
_ROUNDING = 1e-9
_EQUAL = 1e-6
"""Share of the largest distance from the mean below which a difference is rounding."""
_FLIP_STEPS, _DIVISION_STEPS, _HALVINGS, _TOLERANCE = 40, 60, 30, 1e-6


def _by_rows(test: Callable[..., Floats], step: int, *arrays: Array) -> Floats:
    """Apply a test to the rows of arrays, `step` at a time, and return its p-values."""
    parts = spans(len(arrays[0]), max(1, step))
    with np.errstate(all="ignore"):
        return np.concatenate([np.zeros(0), *(test(*(x[rows] for x in arrays)) for rows in parts)])


def _subsets(count: int) -> Floats:
    """Return all subsets of `count` items, as rows of 0 and 1; even rows lack the first item."""
    return (np.arange(2**count)[:, np.newaxis] >> np.arange(count) & 1).astype(float)


def _beyond(r: Floats, u: Floats, normal: Floats) -> Floats:
    """Return the normal tail beyond Barndorff-Nielsen's r*, beyond `normal` near the mean."""
    star = np.where(r > _NEAR_MEAN, r + np.log(np.maximum(u, 1e-30) / r) / r, normal)
    return np.asarray(special.ndtr(-np.maximum(star, 0)))


def p_of_signs(d: Reals) -> Floats:
    """Return two-sided p-values of the sums of rows (row, term) under all flips of their signs.

    The tail of ``sum +-|d|`` follows Daniels' saddlepoint approximation. If at most 10 terms are
    not 0, all flips are counted. p is at least the share of the most extreme flips. Rows of zeros
    have no p-value, NaN.

    References
    ----------
    Daniels, "Discussion of the paper by G.E.P. Box and S.L. Andersen", 1955, and "Tail probability
    approximations", 1987, doi:10.2307/1403269. Robinson, "Saddlepoint approximations for
    permutation tests and confidence intervals", 1982, doi:10.1111/j.2517-6161.1982.tb01191.x.

    Examples
    --------
    >>> p_of_signs(np.array([[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, 1.0, -1.0], [0, 0, 0, 0]]))
    array([0.125, 1.   ,   nan])
    """
    return _by_rows(_p_of_signs, _TERMS_AT_ONCE // max(1, d.shape[1]), d)


def _p_of_signs(d: Reals) -> Floats:
    size = np.abs(d)
    largest = size.max(axis=1, initial=0)
    known = largest > 0
    scale = np.where(known, largest, 1)[:, np.newaxis]
    size = size / scale
    total = np.abs((d / scale).sum(axis=1, dtype=float))
    top = size.sum(axis=1, dtype=float)
    # A term is ignored if flipping its sign does not change the sum in double precision.
    terms = (size > _ROUNDING * top[:, np.newaxis]).sum(axis=1)
    root = np.sqrt(np.einsum("ij,ij->i", size, size, dtype=float))
    few, many = known & (terms <= _ENUMERATED), known & (terms > _ENUMERATED)
    p = np.where(known, 1.0, np.nan)
    inner = many & (total > _ROUNDING * root) & (total < (1 - _ROUNDING) * top)
    p[inner] = 2 * _beyond_flips(size[inner], total[inner])
    p[many & (total >= (1 - _ROUNDING) * top)] = 0
    p = np.clip(p, np.exp2(1.0 - np.minimum(terms, 1000)), 1)
    # The first sign is fixed: the other half of the flips is equally far from 0.
    count = min(_ENUMERATED, d.shape[1])
    enumerated = size[few]
    if count < d.shape[1]:
        enumerated = -np.partition(-enumerated, count - 1, axis=1)[:, :count]
    sums = np.abs(enumerated.astype(float) @ (1.0 - 2.0 * _subsets(count)[::2]).T)
    slack = _ROUNDING + 1e-6 * total[few]  # float32 terms
    p[few] = (sums >= (total[few] - slack)[:, np.newaxis]).mean(axis=1)
    return p


def _beyond_flips(size: Reals, total: Floats) -> Floats:
    """Return the share of flips with at least this sum, for terms up to 1."""
    squares = np.einsum("ij,ij->i", size, size, dtype=float)
    tilt = total / squares
    active = np.arange(len(size))
    # The slope of the cumulant function is concave: Newton's steps from the left stay there.
    for _ in range(_FLIP_STEPS):
        x, at = size[active], tilt[active]
        tanh = np.tanh(at[:, np.newaxis].astype(x.dtype) * x)
        slope = np.einsum("ij,ij->i", x, tanh, dtype=float)
        tanh *= x
        bend = squares[active] - np.einsum("ij,ij->i", tanh, tanh, dtype=float)
        step = (total[active] - slope) / np.maximum(bend, _ROUNDING * squares[active])
        tilt[active] = np.maximum(at + step, at / 2)
        active = active[np.abs(step) > _TOLERANCE * at]
        if not len(active):
            break
    tilted = tilt[:, np.newaxis].astype(size.dtype) * size
    small = np.exp(-2 * tilted)
    cumulant = (tilted + np.log1p(small)).sum(axis=1, dtype=float) - np.log(2) * size.shape[1]
    bend = (small * (2 * size / (1 + small)) ** 2).sum(axis=1, dtype=float)
    r = np.sqrt(2 * np.maximum(tilt * total - cumulant, 1e-30))
    return _beyond(r, tilt * np.sqrt(np.maximum(bend, 1e-30)), total / np.sqrt(squares))


def p_of_means(
    a: Reals, b: Reals, good_a: Mask | None = None, good_b: Mask | None = None
) -> Floats:
    """Return p-values of equal means of rows (row, sample), under all divisions into two groups.

    It is twice the share of divisions whose first group has a sum as far out on the same side. A
    double saddlepoint approximates it: samples are chosen independently, with the probability that
    logistic regression of the group on the sample predicts, given the number that is chosen. All
    divisions are counted if at most 10 samples differ from the others, and these are equal, such as
    nulls.

    Parameters
    ----------
    a, b
        Samples of both groups, shapes (row, n) and (row, m).
    good_a, good_b
        Which samples count, same shapes; None for all.

    Returns
    -------
    ndarray
        P-values, shape (row,); NaN where a group is empty or all samples are equal.

    References
    ----------
    Pitman, "Significance tests which may be applied to samples from any populations", 1937,
    doi:10.2307/2984124. Booth and Butler, "Randomization distributions and saddlepoint
    approximations in generalized linear models", 1990, doi:10.1093/biomet/77.4.787. Skovgaard,
    "Saddlepoint expansions for conditional distributions", 1987, doi:10.2307/3214212.

    Examples
    --------
    >>> p_of_means(np.array([[3.0, 4.0], [0.0, 1.0]]), np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]))
    array([0.2, 1. ])
    """
    good_a, good_b = (
        np.ones(x.shape, bool) if good is None else good for x, good in ((a, good_a), (b, good_b))
    )

    def of_rows(a: Reals, b: Reals, *good: Mask) -> Floats:
        pool = np.concatenate([a, b], axis=1)
        return _p_of_divisions(pool, np.concatenate(good, axis=1), a.shape[1])

    return _by_rows(of_rows, _TERMS_AT_ONCE // (a.shape[1] + b.shape[1]), a, b, good_a, good_b)


def _p_of_divisions(x: Reals, good: Mask, first: int) -> Floats:
    """Return p-values of rows whose first samples are one group."""
    n, count = good[:, :first].sum(axis=1), good.sum(axis=1)
    x = np.where(good, x, 0)
    z = np.where(good, x - (x.sum(axis=1, dtype=float) / np.maximum(count, 1))[:, np.newaxis], 0)
    scale = np.abs(z).max(axis=1)
    known = (n > 0) & (n < count) & (scale > _EQUAL**2 * np.abs(x).max(axis=1))
    p = np.full(len(x), np.nan)
    good, n, count = good[known], n[known], count[known]
    z = (z[known] / scale[known, np.newaxis]).astype(x.dtype)
    total = z[:, :first].sum(axis=1, dtype=float)
    z *= np.where(total < 0, -1, 1).astype(x.dtype)[:, np.newaxis]
    total = np.abs(total)
    ordered = np.sort(np.where(good, z, np.inf), axis=1)
    centred = z - np.take_along_axis(ordered, count[:, np.newaxis] // 2, axis=1)
    few = (np.where(good, np.abs(centred), 0) > _EQUAL).sum(axis=1) <= _ENUMERATED
    share = np.ones(len(z))
    share[few] = _enumerated_divisions(centred[few], good[few], n[few], count[few], first)
    rest = ~few
    # Sums in equal steps, as of atoms: half a step is the correction for continuity.
    gaps = np.diff(ordered, axis=1)
    step = np.where((gaps > _EQUAL) & np.isfinite(gaps), gaps, np.inf).min(axis=1, initial=np.inf)
    total = np.maximum(total - np.where(np.isfinite(step), step, 0) / 2, 0)
    share[rest] = np.maximum(
        _beyond_divisions(z[rest], good[rest], total[rest], n[rest], count[rest]),
        _share_of_largest(ordered[rest], n[rest], count[rest]),
    )
    p[known] = np.minimum(2 * share, 1)
    return p


def log_choices(n: Array, k: Array) -> Floats:
    """Return log(n choose k), -inf where there is no choice."""
    possible = (k >= 0) & (k <= n)
    k = np.where(possible, k, 0)
    found = special.gammaln(n + 1) - special.gammaln(k + 1) - special.gammaln(n - k + 1)
    return np.where(possible, found, -np.inf)


def _enumerated_divisions(x: Reals, good: Mask, n: Counts, count: Counts, first: int) -> Floats:
    """Return the share of divisions with at least this sum, for few samples that are not 0."""
    width = min(_ENUMERATED, x.shape[1])
    at = np.argpartition(-np.where(good, np.abs(x), -1), width - 1, axis=1)[:, :width]
    real = np.take_along_axis(good, at, axis=1)
    value = np.where(real, np.take_along_axis(x, at, axis=1), 0).astype(float)
    chosen = _subsets(width)
    seen = np.where(at < first, value, 0).sum(axis=1, keepdims=True)
    as_far = value @ chosen.T >= seen - 1e-5 * np.abs(value).max(axis=1, keepdims=True)
    # The other samples are equal: only the number of chosen ones counts.
    others = count - real.sum(axis=1)
    left = n[:, np.newaxis] - np.arange(width + 1)
    weight = np.exp(log_choices(others[:, np.newaxis], left) - log_choices(count, n)[:, np.newaxis])
    weight = weight[:, chosen.sum(axis=1).astype(int)] * ~((~real).astype(float) @ chosen.T > 0)
    return np.asarray((weight * as_far).sum(axis=1))


def _share_of_largest(ordered: Reals, n: Counts, count: Counts) -> Floats:
    """Return the share of divisions that choose the largest of ordered samples."""
    border = np.take_along_axis(ordered, (count - n)[:, np.newaxis], axis=1)
    last = np.arange(ordered.shape[1]) < count[:, np.newaxis]
    above = (last & (ordered > border + _EQUAL)).sum(axis=1)
    tied = (last & (np.abs(ordered - border) <= _EQUAL)).sum(axis=1)
    return np.exp(log_choices(tied, n - above) - log_choices(count, n))


def _beyond_divisions(z: Reals, good: Mask, total: Floats, n: Counts, count: Counts) -> Floats:
    """Return the share of divisions with at least this sum, which is 0 or more.

    The saddlepoint (tilt, level) is the maximum of the log-likelihood of a logistic regression.
    """
    share = n / count
    level = np.log(n / (count - n))
    base = -count * np.log1p(np.exp(level)) + n * level
    tilt, height, bend = np.zeros(len(z)), base.copy(), np.zeros((3, len(z)))
    active = np.arange(len(z))
    for _ in range(_DIVISION_STEPS):
        gradient, bend[:, active] = _slopes(z[active], good[active], tilt[active], level[active])
        by_tilt, by_level = total[active] - gradient[0], n[active] - gradient[1]
        ss, st, tt = bend[:, active]
        area = np.maximum(ss * tt - st**2, 1e-12 * ss * tt + 1e-300)
        steps = np.stack([tt * by_tilt - st * by_level, ss * by_level - st * by_tilt]) / area
        moving = steps[0] * by_tilt + steps[1] * by_level > _TOLERANCE
        active, steps = active[moving], steps[:, moving]
        if not len(active):
            break
        left = np.arange(len(active))
        for halving in range(_HALVINGS):
            rows = active[left]
            to = np.stack([tilt[rows], level[rows]]) + 0.5**halving * steps[:, left]
            there = to[0] * total[rows] + to[1] * n[rows] - _cumulant(z[rows], good[rows], *to)
            higher = there >= height[rows]
            done = rows[higher]
            (tilt[done], level[done]), height[done] = to[:, higher], there[higher]
            left = left[~higher]
            if not len(left):
                break
        active = np.delete(active, left)  # no step leads higher: as high as rounding allows
    ss, st, tt = bend
    spread = count * share * (1 - share)
    u = tilt * np.sqrt(np.maximum(ss * tt - st**2, 0) / spread)
    squares = np.einsum("ij,ij->i", z, z, dtype=float)
    normal = total / np.sqrt(share * (1 - share) * squares * count / (count - 1))
    return _beyond(np.sqrt(2 * np.maximum(height - base, 0)), u, normal)


def _slopes(z: Reals, good: Mask, tilt: Floats, level: Floats) -> tuple[Floats, Floats]:
    """Return first (2, row) and second (3, row) derivatives of the cumulant function."""
    chance = special.expit((tilt[:, np.newaxis] * z + level[:, np.newaxis]).astype(z.dtype)) * good
    first = np.stack([np.einsum("ij,ij->i", chance, z, dtype=float), chance.sum(1, dtype=float)])
    chance *= 1 - chance
    weighted = chance * z
    second = np.einsum("ij,ij->i", weighted, z, dtype=float)
    return first, np.stack([second, weighted.sum(1, dtype=float), chance.sum(1, dtype=float)])


def _cumulant(z: Reals, good: Mask, tilt: Floats, level: Floats) -> Floats:
    """Return sums of log(1 + exp(tilt z + level)) over samples."""
    x = (tilt[:, np.newaxis] * z + level[:, np.newaxis]).astype(z.dtype)
    softplus = np.maximum(x, 0) + np.log1p(np.exp(-np.abs(x)))
    return np.asarray((softplus * good).sum(1, dtype=float))


_SHUFFLES = 199
_ROWS = 2048
"""Rows that are shuffled together."""
_COMPONENTS = 6
_EXCEEDING = 10
"""With fewer shuffles beyond the statistic, a distribution is fitted to the tail."""
_TAIL = 0.2
"""Share of the shuffles to which the tail is fitted."""


@dataclass(frozen=True)
class Shuffles:
    """Random divisions of samples into two groups, or swaps within pairs.

    Attributes
    ----------
    n
        Samples in each group.
    paired
        Whether the two samples of a pair are swapped.
    weights
        For pairs, 1 and -1, shape (pair, shuffle); otherwise 1 for the samples of the first group,
        shape (sample, shuffle).
    """

    n: tuple[int, int]
    paired: bool
    weights: Image

    @classmethod
    def draw(cls, n: tuple[int, int], seed: int, *, paired: bool) -> Shuffles:
        """Draw shuffles; with pairs, both groups have the same size."""
        rng = np.random.default_rng(seed)
        weights: Array
        if paired:
            weights = 2 * rng.integers(0, 2, size=(n[0], _SHUFFLES), dtype=np.int8) - 1
        else:
            weights = rng.random((sum(n), _SHUFFLES), dtype=np.float32).argsort(axis=0) < n[0]
        return cls(n, paired, weights.astype(np.float32))

    def p_of_variances(self, a: Reals, b: Reals) -> Floats:
        """Return p-values of equal variances of rows (row, sample), two-sided.

        The statistic is the log of the ratio of the variances. For pairs, it is the correlation of
        sum and difference, which is 0 for equal variances (Pitman 1939, Biometrika 31).
        """

        def of_rows(a: Reals, b: Reals) -> Floats:
            # In units of the largest sample, so that squares of 1e30 and 1e-30 are numbers.
            largest = np.maximum(*(np.abs(x).max(axis=1, initial=0) for x in (a, b)))
            unit = np.where(largest > 0, largest, 1)[:, np.newaxis]
            found = (self._correlation if self.paired else self._log_ratio)(a / unit, b / unit)
            # Samples that do not vary do not differ.
            return self._p_of(*(np.abs(np.nan_to_num(x, nan=0.0)) for x in found))

        return _by_rows(of_rows, _ROWS, a, b)

    def p_of_distributions(self, a: Reals, b: Reals) -> Floats:
        """Return p-values of equal distributions of rows (row, sample).

        The statistic is Cramer and von Mises' distance, the energy distance of the ranks
        (Baringhaus and Franz 2004, doi:10.1016/S0047-259X(03)00079-4), by the first components of
        its spectrum: differences of mean cosines of the ranks. Ties, such as nulls, share their
        mean rank.

        Examples
        --------
        >>> rng = np.random.default_rng(0)
        >>> a, b = rng.normal(size=(2, 2, 100))
        >>> b[1] *= 4
        >>> Shuffles.draw((100, 100), 0, paired=False).p_of_distributions(a, b).round(2) < 0.05
        array([False,  True])
        """
        return _by_rows(lambda a, b: self._p_of(*self._distance(a, b)), _ROWS, a, b)

    def _p_of(self, statistic: Reals, shuffled: Reals) -> Floats:
        """Return p-values, none below the share of one division, or of two that are mirrored."""
        n, m = map(np.asarray, self.n)
        mirrored = np.log(2) * (self.paired or n == m)
        choices = n * np.log(2) if self.paired else log_choices(n + m, n)
        return np.asarray(np.maximum(p_of_tail(statistic, shuffled), np.exp(mirrored - choices)))

    def _correlation(self, a: Reals, b: Reals) -> tuple[Reals, Reals]:
        total, apart = a + b, a - b
        total = total - total.mean(axis=1, keepdims=True)
        product = (total * apart).astype(np.float32)
        scale = np.sqrt(np.square(total).sum(axis=1) * np.square(apart).sum(axis=1))
        return product.sum(axis=1) / scale, (product @ self.weights) / scale[:, np.newaxis]

    def _log_ratio(self, a: Reals, b: Reals) -> tuple[Reals, Reals]:
        z = np.concatenate([a, b], axis=1).astype(np.float32)
        z -= z.mean(axis=1, keepdims=True)
        own = (np.arange(z.shape[1]) < self.n[0]).astype(np.float32)
        weights = np.concatenate([own[:, np.newaxis], self.weights], axis=1)
        powers = z, np.square(z)
        of_first = [x @ weights for x in powers]
        of_second = [
            x.sum(axis=1, keepdims=True) - one for x, one in zip(powers, of_first, strict=True)
        ]
        one, other = (
            np.maximum(square / k - (total / k) ** 2, 0) * k / max(k - 1, 1)
            for (total, square), k in zip((of_first, of_second), self.n, strict=True)
        )
        # One sample may decide a variance: none is told from less than a share of both.
        least = (one + other) / min(self.n)
        found = np.log((one + least) / (other + least))
        return found[:, 0], found[:, 1:]

    def _distance(self, a: Reals, b: Reals) -> tuple[Floats, Reals]:
        pooled = np.concatenate([a, b], axis=1)
        ranks = (stats.rankdata(pooled, axis=1) - 0.5) / pooled.shape[1]
        found = np.zeros(len(a))
        shuffled = np.zeros((len(a), self.weights.shape[1]), np.float32)
        first, second = self.n
        for j in range(1, _COMPONENTS + 1):
            wave = np.cos(j * np.pi * ranks).astype(np.float32)
            here = wave[:, :first].mean(axis=1) - wave[:, first:].mean(axis=1)
            if self.paired:
                moved = ((wave[:, :first] - wave[:, first:]) @ self.weights) / np.float32(first)
            else:
                total, one = wave.sum(axis=1, keepdims=True), wave @ self.weights
                moved = one / np.float32(first) - (total - one) / np.float32(second)
            found += np.square(here) / j**2
            shuffled += np.square(moved) / np.float32(j**2)
        return found, shuffled


@dataclass(frozen=True)
class PermutationTail:
    """What shuffles say of large statistics: an exponential or heavier tail beyond a border.

    A generalised Pareto distribution is fitted to the largest fifth of the shuffles. A tail lighter
    than an exponential counts as exponential.

    Attributes
    ----------
    border, scale, k
        Largest statistic below the tail, and the scale and shape of the excesses over it, shape
        (row,). `k` is minus the tail index, as by Hosking and Wallis.
    share
        Share of the shuffles in the tail.

    References
    ----------
    Knijnenburg, Wessels, Reinders and Shmulevich, "Fewer permutations, more accurate P-values",
    2009, doi:10.1093/bioinformatics/btp211. Hosking and Wallis, "Parameter and quantile estimation
    for the generalized Pareto distribution", 1987, doi:10.1080/00401706.1987.10488243: the fit, by
    probability-weighted moments.
    """

    border: Floats
    scale: Floats
    k: Floats
    share: float

    @classmethod
    @np.errstate(all="ignore")
    def of(cls, shuffled: Reals) -> PermutationTail:
        """Fit the tails of statistics under the hypothesis, shape (row, shuffle)."""
        count = shuffled.shape[1]
        kept = max(_EXCEEDING, int(_TAIL * count))
        largest = -np.partition(-shuffled, kept, axis=1)[:, : kept + 1].astype(np.float64)
        largest.sort(axis=1)
        excess = largest[:, 1:] - largest[:, :1]
        rank = (np.arange(kept) + 0.65) / kept
        first, second = excess.mean(axis=1), (excess * (1 - rank)).mean(axis=1)
        k = first / (first - 2 * second) - 2
        scale = np.where(k < 0, 2 * first * second / (first - 2 * second), first)
        return cls(largest[:, 0], scale, np.minimum(k, -1e-6), kept / count)

    @np.errstate(all="ignore")
    def beyond(self, statistic: Reals) -> Floats:
        """Return the share beyond statistics (row,); 1 where they are not in the tail."""
        over = statistic - self.border
        found = self.share * (1 - self.k * over / self.scale) ** (1 / self.k)
        return np.where(np.isfinite(found) & (over > 0), found, 1.0)

    def quantile(self, share: float) -> Floats:
        """Return the statistics beyond which such a share lies, one smaller than `self.share`."""
        more = 1 - (share / self.share) ** self.k
        return np.asarray(self.border + self.scale / self.k * more)


def p_of_tail(statistic: Reals, shuffled: Reals) -> Floats:
    """Return p-values of statistics that are large if the hypothesis is wrong.

    Parameters
    ----------
    statistic
        Statistics, shape (row,).
    shuffled
        Statistics under the hypothesis, shape (row, shuffle).

    Returns
    -------
    ndarray
        (b + 1) / (B + 1), where b of B shuffles are at least as large. That is too coarse for
        thousands of pixels, or for small levels. If b < 10, it is the share beyond the statistic in
        the `PermutationTail` of the shuffles, if that is smaller.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> p = p_of_tail(np.array([0.5, 12.0]), rng.exponential(size=(2, 999)))
    >>> round(float(p[0]), 2), bool(1e-7 < p[1] < 1e-4)
    (0.64, True)
    """
    # Values that are equal up to rounding count as equally large.
    exceeding = (shuffled >= (statistic * (1 - 1e-5))[:, np.newaxis]).sum(axis=1)
    p = np.asarray((exceeding + 1) / (shuffled.shape[1] + 1), np.float64)
    few = np.flatnonzero(exceeding < _EXCEEDING)
    p[few] = np.minimum(p[few], PermutationTail.of(shuffled[few]).beyond(statistic[few]))
    return p


def quantile_of_tail(shuffled: Reals, share: float) -> Floats:
    """Return the statistics whose p-values by `p_of_tail` are about `share`, shape (row,)."""
    if share * shuffled.shape[1] < _EXCEEDING:
        return PermutationTail.of(shuffled).quantile(share)
    return np.asarray(np.quantile(shuffled, 1 - share, axis=1))
