"""Permutations of two groups of samples: whether variances or distributions of pixels differ.

The samples of both renders are exchanged, at random between the groups or within pairs, and one set
of shuffles serves all pixels, as matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

from chdstat._core.arrays import spans
from chdstat._core.positive import Floats

__all__ = ["Shuffles", "p_of_tail"]

_COUNT = 199
_EXCEEDING = 10
"""Fewer shuffles beyond the statistic say little: the tail is fitted."""
_TAIL = 0.2
"""Share of the shuffles that the tail is fitted to."""
_ROWS = 2048
"""Rows that are shuffled at once."""
_COMPONENTS = 6

Singles = npt.NDArray[np.floating[Any]]


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

    def p_of_variances(self, a: Singles, b: Singles) -> Floats:
        """Return p-values of equal variances of rows (row, sample), two-sided.

        The statistic is the log of the ratio of the variances; of pairs, the correlation of sum and
        difference, which is 0 where variances are equal (Pitman 1939, Biometrika 31).
        """
        found = np.empty(len(a))
        for rows in spans(len(a), _ROWS):
            here = self._of_pairs if self.paired else self._ratio
            found[rows] = p_of_tail(*(np.abs(x) for x in here(a[rows], b[rows])))
        return found

    def p_of_distributions(self, a: Singles, b: Singles) -> Floats:
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

    def _of_pairs(self, a: Singles, b: Singles) -> tuple[Singles, Singles]:
        total, apart = a + b, a - b
        total = total - total.mean(axis=1, keepdims=True)
        product = (total * apart).astype(np.float32)
        with np.errstate(all="ignore"):
            scale = np.sqrt(np.square(total).sum(axis=1) * np.square(apart).sum(axis=1))
            moved = (product @ self.weights) / scale[:, np.newaxis]
            return _finite(product.sum(axis=1) / scale), _finite(moved)

    def _ratio(self, a: Singles, b: Singles) -> tuple[Singles, Singles]:
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

    def _distance(self, a: Singles, b: Singles) -> tuple[Floats, Singles]:
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


def p_of_tail(statistic: Singles, shuffled: Singles) -> Floats:
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


def _beyond(statistic: Singles, shuffled: Singles) -> Floats:
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


def _finite(x: Singles) -> Singles:
    """Return what does not vary as no difference."""
    return np.nan_to_num(x, nan=0.0)
