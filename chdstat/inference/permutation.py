"""Permutations of two groups of samples: whether means, variances or distributions differ.

If both groups are of one distribution, every division of all samples into groups of these sizes is
as likely as that which was drawn, whatever the tails, the nulls and the sizes. Of means, the tail
of all divisions is approximated, so that p-values are as small as those of many pixels need; of
the rest, random divisions or exchanges within pairs serve all pixels alike, as matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special
from scipy.stats import rankdata

from chdstat._core.arrays import Counts, Floats, Mask, Reals, spans

__all__ = ["Shuffles", "p_of_means", "p_of_tail"]

_AT_ONCE = 2**20
"""Samples of the rows whose means are compared together."""
_ENUMERATED = 10
"""Rows with up to so many samples that differ from all others have all their divisions counted."""
_STEPS, _HALVINGS, _TOLERANCE = 60, 30, 1e-6
_NEAR_MEAN = 0.1
"""Likelihood ratios below which the saddlepoint is too close to the mean."""
_EQUAL = 1e-6
"""Of the largest distance from the mean: smaller differences are rounding."""

_COUNT = 199
_EXCEEDING = 10
"""Fewer shuffles beyond the statistic say little: the tail is fitted."""
_TAIL = 0.2
"""Share of the shuffles that the tail is fitted to."""
_ROWS = 2048
"""Rows that are shuffled at once."""
_COMPONENTS = 6


@dataclass(frozen=True)
class Shuffles:
    """Random divisions of samples into two groups, or changes of sides within pairs.

    Attributes
    ----------
    n
        Samples in each group.
    paired
        Whether the two of a pair change sides.
    weights
        Of pairs, 1 and -1, shape (pair, shuffle); else 1 for those of the first group, shape
        (sample, shuffle).
    """

    n: tuple[int, int]
    paired: bool
    weights: npt.NDArray[np.float32]

    @classmethod
    def draw(cls, n: tuple[int, int], seed: int, *, paired: bool, count: int = _COUNT) -> Shuffles:
        """Draw shuffles; of pairs, both groups have as many samples."""
        rng = np.random.default_rng(seed)
        if paired:
            signs = rng.integers(0, 2, size=(n[0], count), dtype=np.int8)
            return cls(n, True, (2 * signs - 1).astype(np.float32))
        order = rng.random((sum(n), count), dtype=np.float32).argsort(axis=0)
        return cls(n, False, (order < n[0]).astype(np.float32))

    def p_of_variances(self, a: Reals, b: Reals) -> Floats:
        """Return p-values of equal variances of rows (row, sample), two-sided.

        The statistic is the log of the ratio of the variances; of pairs, the correlation of sum and
        difference, which is 0 where variances are equal (Pitman 1939, Biometrika 31).
        """
        found = np.empty(len(a))
        for rows in spans(len(a), _ROWS):
            here = self._of_pairs if self.paired else self._ratio
            found[rows] = p_of_tail(*(np.abs(x) for x in here(a[rows], b[rows])))
        return found

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
        found = np.empty(len(a))
        for rows in spans(len(a), _ROWS):
            found[rows] = p_of_tail(*self._distance(a[rows], b[rows]))
        return found

    def _of_pairs(self, a: Reals, b: Reals) -> tuple[Reals, Reals]:
        total, apart = a + b, a - b
        total = total - total.mean(axis=1, keepdims=True)
        product = (total * apart).astype(np.float32)
        with np.errstate(all="ignore"):
            scale = np.sqrt(np.square(total).sum(axis=1) * np.square(apart).sum(axis=1))
            moved = (product @ self.weights) / scale[:, np.newaxis]
            return _finite(product.sum(axis=1) / scale), _finite(moved)

    def _ratio(self, a: Reals, b: Reals) -> tuple[Reals, Reals]:
        z = np.concatenate([a, b], axis=1).astype(np.float32)
        z -= z.mean(axis=1, keepdims=True)
        scale = np.sqrt(np.square(z).mean(axis=1, keepdims=True))
        z = np.divide(z, scale, out=np.zeros_like(z), where=scale > 0)
        squares = np.square(z)
        own = np.zeros((z.shape[1], 1), np.float32)
        own[: self.n[0]] = 1
        weights = np.concatenate([own, self.weights], axis=1)
        of_first = z @ weights, squares @ weights
        of_second = (
            x.sum(axis=1, keepdims=True) - one
            for x, one in zip((z, squares), of_first, strict=True)
        )
        one, other = (
            np.maximum(square / k - (total / k) ** 2, 0) * k / max(k - 1, 1)
            for (total, square), k in zip((of_first, tuple(of_second)), self.n, strict=True)
        )
        with np.errstate(all="ignore"):
            found = _finite(np.log(one / other))
        return found[:, 0], found[:, 1:]

    def _distance(self, a: Reals, b: Reals) -> tuple[Floats, Reals]:
        pooled = np.concatenate([a, b], axis=1)
        ranks = (rankdata(pooled, axis=1) - 0.5) / pooled.shape[1]
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


def p_of_tail(statistic: Reals, shuffled: Reals) -> Floats:
    """Return p-values of statistics of which large ones speak against the hypothesis.

    Parameters
    ----------
    statistic
        Shape (row,).
    shuffled
        Shape (row, shuffle), under the hypothesis.

    Returns
    -------
    ndarray
        (b + 1) / (B + 1) where b of B shuffles are as large. That is too coarse for thousands of
        pixels: where b < 10, it is the share of a generalised Pareto distribution beyond the
        statistic, fitted to the largest fifth of the shuffles, if that is smaller. A tail lighter
        than an exponential counts as one.

    References
    ----------
    Knijnenburg, Wessels, Reinders and Shmulevich, "Fewer permutations, more accurate P-values",
    2009, doi:10.1093/bioinformatics/btp211. Hosking and Wallis, "Parameter and quantile estimation
    for the generalized Pareto distribution", 1987, doi:10.1080/00401706.1987.10488243: the fit, by
    probability-weighted moments.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> p = p_of_tail(np.array([0.5, 12.0]), rng.exponential(size=(2, 999)))
    >>> round(float(p[0]), 2), bool(1e-7 < p[1] < 1e-4)
    (0.64, True)
    """
    # What is equal but for rounding is as large.
    exceeding = (shuffled >= (statistic * (1 - 1e-5))[:, np.newaxis]).sum(axis=1)
    p = np.asarray((exceeding + 1) / (shuffled.shape[1] + 1), np.float64)
    few = np.flatnonzero(exceeding < _EXCEEDING)
    if len(few):
        p[few] = np.minimum(p[few], _beyond(statistic[few], shuffled[few]))
    return p


def _beyond(statistic: Reals, shuffled: Reals) -> Floats:
    """Return the share of fitted tails beyond statistics."""
    count = shuffled.shape[1]
    kept = max(_EXCEEDING, int(_TAIL * count))
    largest = -np.partition(-shuffled, kept, axis=1)[:, : kept + 1].astype(np.float64)
    largest.sort(axis=1)
    excess, over = largest[:, 1:] - largest[:, :1], statistic - largest[:, 0]
    rank = (np.arange(kept) + 0.65) / kept
    first, second = excess.mean(axis=1), (excess * (1 - rank)).mean(axis=1)
    with np.errstate(all="ignore"):
        # Hosking and Wallis' k is minus the tail index.
        k = first / (first - 2 * second) - 2
        scale = np.where(k < 0, 2 * first * second / (first - 2 * second), first)
        heavy = np.minimum(k, -1e-6)
        found = kept / count * (1 - heavy * over / scale) ** (1 / heavy)
    return np.where(np.isfinite(found) & (over > 0), found, 1.0)


def _finite(x: Reals) -> Reals:
    """Return what does not vary as no difference."""
    return np.nan_to_num(x, nan=0.0)


def p_of_means(
    a: Reals, b: Reals, good_a: Mask | None = None, good_b: Mask | None = None
) -> Floats:
    """Return p-values of equal means of rows (row, sample), under all divisions into two groups.

    Twice the share of divisions with a sum of the first group as far out on its side. It is
    approximated by a double saddlepoint: of independent choices with the probability that logistic
    regression of the group on the sample predicts, given how many are chosen. All divisions are
    counted where at most 10 samples differ from the others, which are equal, as nulls are.

    Parameters
    ----------
    a, b
        Samples of both groups, shapes (row, n) and (row, m).
    good_a, good_b
        Which of them count, of the same shapes; None for all.

    Returns
    -------
    ndarray
        Shape (row,); NaN where a group is empty or all samples are equal.

    References
    ----------
    Robinson, "Saddlepoint approximations for permutation tests and confidence intervals", 1982,
    doi:10.1111/j.2517-6161.1982.tb01191.x. Booth and Butler, "Randomization distributions and
    saddlepoint approximations in generalized linear models", 1990, doi:10.1093/biomet/77.4.787.
    Skovgaard, "Saddlepoint expansions for conditional distributions", 1987, doi:10.2307/3214212.

    Examples
    --------
    >>> p_of_means(np.array([[3.0, 4.0], [0.0, 1.0]]), np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]))
    array([0.2, 1. ])
    """
    if good_a is None:
        good_a = np.ones(a.shape, bool)
    if good_b is None:
        good_b = np.ones(b.shape, bool)
    step = max(1, _AT_ONCE // (a.shape[1] + b.shape[1]))
    found = []
    for rows in spans(len(a), step):
        pool = np.concatenate([a[rows], b[rows]], axis=1)
        good = np.concatenate([good_a[rows], good_b[rows]], axis=1)
        found.append(_p_of_divisions(pool, good, a.shape[1]))
    return np.concatenate(found) if found else np.zeros(0)


def _p_of_divisions(x: Reals, good: Mask, first: int) -> Floats:
    """Return p-values of rows whose first samples are one group."""
    n, count = good[:, :first].sum(axis=1), good.sum(axis=1)
    x = np.where(good, x, 0)
    z = np.where(good, x - (x.sum(axis=1, dtype=float) / np.maximum(count, 1))[:, np.newaxis], 0)
    scale = np.abs(z).max(axis=1)
    known = (n > 0) & (n < count) & (scale > _EQUAL**2 * np.abs(x).max(axis=1))
    p = np.full(len(x), np.nan)
    z, good, n, count = (
        (z[known] / scale[known, np.newaxis]).astype(x.dtype),
        good[known],
        n[known],
        count[known],
    )
    total = z[:, :first].sum(axis=1, dtype=float)
    z *= np.where(total < 0, -1, 1).astype(x.dtype)[:, np.newaxis]
    total = np.abs(total)
    ordered = np.sort(np.where(good, z, np.inf), axis=1)
    middle = np.take_along_axis(ordered, count[:, np.newaxis] // 2, axis=1)
    apart = np.where(good, np.abs(z - middle), 0)
    few = (apart > _EQUAL).sum(axis=1) <= _ENUMERATED
    share = np.ones(len(z))
    share[few] = _counted(z[few] - middle[few], apart[few], good[few], n[few], count[few], first)
    rest = ~few
    # Sums of equal steps apart, as of atoms: half a step is the correction for continuity.
    with np.errstate(invalid="ignore"):
        gaps = np.diff(ordered, axis=1)
    step = np.where((gaps > _EQUAL) & np.isfinite(gaps), gaps, np.inf).min(axis=1, initial=np.inf)
    total = np.maximum(total - np.where(np.isfinite(step), step, 0) / 2, 0)
    share[rest] = _beyond_saddlepoint(z[rest], good[rest], total[rest], n[rest], count[rest])
    share[rest] = np.maximum(share[rest], _of_largest(ordered[rest], n[rest], count[rest]))
    p[known] = np.minimum(2 * share, 1)
    return p


def _log_choices(n: npt.NDArray[Any], k: npt.NDArray[Any]) -> Floats:
    """Return log(n choose k), -inf where there is no choice."""
    possible = (k >= 0) & (k <= n)
    k = np.where(possible, k, 0)
    found = special.gammaln(n + 1) - special.gammaln(k + 1) - special.gammaln(n - k + 1)
    return np.where(possible, found, -np.inf)


def _counted(x: Reals, apart: Reals, good: Mask, n: Counts, count: Counts, first: int) -> Floats:
    """Return the share of divisions whose sum is as large, of a few samples that are not 0."""
    width = min(_ENUMERATED, x.shape[1])
    at = np.argpartition(-np.where(good, apart, -1), width - 1, axis=1)[:, :width]
    real = np.take_along_axis(good, at, axis=1)
    value = np.where(real, np.take_along_axis(x, at, axis=1), 0).astype(float)
    chosen = (np.arange(2**width)[:, np.newaxis] >> np.arange(width) & 1).astype(float)
    seen = np.where(at < first, value, 0).sum(axis=1, keepdims=True)
    as_far = value @ chosen.T >= seen - 1e-5 * np.abs(value).max(axis=1, keepdims=True)
    # The other samples are equal: only how many of them are chosen counts.
    others = count - real.sum(axis=1)
    left = n[:, np.newaxis] - np.arange(width + 1)
    weight = np.exp(
        _log_choices(others[:, np.newaxis], left) - _log_choices(count, n)[:, np.newaxis]
    )
    weight = weight[:, chosen.sum(axis=1).astype(int)] * ~((~real).astype(float) @ chosen.T > 0)
    return np.asarray((weight * as_far).sum(axis=1))


def _of_largest(ordered: Reals, n: Counts, count: Counts) -> Floats:
    """Return the share of divisions that choose the largest of samples in order."""
    border = np.take_along_axis(ordered, (count - n)[:, np.newaxis], axis=1)
    last = np.arange(ordered.shape[1]) < count[:, np.newaxis]
    above = (last & (ordered > border + _EQUAL)).sum(axis=1)
    tied = (last & (np.abs(ordered - border) <= _EQUAL)).sum(axis=1)
    return np.exp(_log_choices(tied, n - above) - _log_choices(count, n))


def _beyond_saddlepoint(z: Reals, good: Mask, total: Floats, n: Counts, count: Counts) -> Floats:
    """Return the share of divisions with such a sum, 0 or more, or a larger one.

    The saddlepoint (tilt, level) is the maximum of the log-likelihood of a logistic regression.
    """
    share = n / count
    start = np.log(n / (count - n))
    tilt, level = np.zeros(len(z)), start.copy()
    base = -count * np.log1p(np.exp(start)) + n * start
    height = base.copy()
    bend = np.zeros((3, len(z)))
    active = np.arange(len(z))
    for _ in range(_STEPS):
        gradient, bend[:, active] = _slopes(z[active], good[active], tilt[active], level[active])
        by_tilt, by_level = total[active] - gradient[0], n[active] - gradient[1]
        ss, st, tt = bend[:, active]
        area = np.maximum(ss * tt - st**2, 1e-12 * ss * tt + 1e-300)
        steps = (tt * by_tilt - st * by_level) / area, (ss * by_level - st * by_tilt) / area
        gain = steps[0] * by_tilt + steps[1] * by_level
        moving = gain > _TOLERANCE
        active = active[moving]
        if not len(active):
            break
        steps = steps[0][moving], steps[1][moving]
        left = np.arange(len(active))
        for halving in range(_HALVINGS):
            rows, part = active[left], 0.5**halving
            to = tilt[rows] + part * steps[0][left], level[rows] + part * steps[1][left]
            there = to[0] * total[rows] + to[1] * n[rows] - _cumulant(z[rows], good[rows], *to)
            higher = there >= height[rows]
            done = rows[higher]
            tilt[done], level[done], height[done] = to[0][higher], to[1][higher], there[higher]
            left = left[~higher]
            if not len(left):
                break
        active = np.delete(active, left)  # no step leads higher: as high as rounding allows
    ss, st, tt = bend
    r = np.sqrt(2 * np.maximum(height - base, 0))
    u = tilt * np.sqrt(np.maximum(ss * tt - st**2, 0) / (count * share * (1 - share)))
    squares = np.einsum("ij,ij->i", z, z, dtype=float)
    normal = total / np.sqrt(share * (1 - share) * squares * count / (count - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        star = np.where(r > _NEAR_MEAN, r + np.log(np.maximum(u, 1e-30) / r) / r, normal)
    return np.asarray(special.ndtr(-np.maximum(star, 0)))


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
    return np.asarray(
        ((np.maximum(x, 0) + np.log1p(np.exp(-np.abs(x)))) * good).sum(1, dtype=float)
    )
