"""The obvious loop: characterise one distribution after the other with the well-known libraries.

It is what `chdstat.analyze` is measured against: the same questions, asked of SciPy, statsmodels,
scikit-learn and diptest as their documentation shows, one pixel and channel at a time, and no
bootstrap. It leaves out what these libraries do not have: standard errors of the families, gamma
mixtures, calibrated tests of normality, a data-driven tail threshold, the pattern flags.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import diptest
import numpy as np
from scipy import stats
from sklearn.mixture import GaussianMixture

FAMILIES = (stats.gamma, stats.lognorm, stats.weibull_min, stats.burr12)
COMPONENTS = (1, 2, 3)
AVERAGES = 32


def characterize(x: np.ndarray) -> None:
    """Ask everything of the samples of one pixel and channel."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        positive = x[x > 0].astype(np.float64)
        if len(positive) < 30 or np.ptp(positive) < 1e-6 * positive.max():
            return
        stats.describe(x)
        np.histogram(np.log10(positive), bins=100, range=(-5, 5))
        families(positive)
        mixtures(positive)
        normality(positive)
        averages(x)
        tail(positive)
        diptest.diptest(np.log(positive))


def families(positive: np.ndarray) -> None:
    for family in FAMILIES:
        try:
            fitted = family(*family.fit(positive, floc=0))
        except (ValueError, RuntimeError, FloatingPointError):
            continue
        fitted.logpdf(positive).sum()
        stats.ks_1samp(positive, fitted.cdf, mode="asymp")
        stats.cramervonmises(positive, fitted.cdf)
        counts, edges = np.histogram(positive, np.quantile(positive, np.linspace(0, 1, 17)))
        expected = np.diff(fitted.cdf(edges))
        stats.chisquare(counts, expected / expected.sum() * counts.sum())
        for one, other in ((positive[::2], positive[1::2]), (positive[1::2], positive[::2])):
            family(*family.fit(one, floc=0)).logpdf(other).sum()


def mixtures(positive: np.ndarray) -> None:
    log = np.log(positive)[:, np.newaxis]
    for k in COMPONENTS:
        GaussianMixture(k, random_state=0).fit(log).bic(log)


def normality(positive: np.ndarray) -> None:
    for transform in (np.log, np.sqrt, np.asarray):
        y = transform(positive)
        for test in TESTS:
            test(y)
        stats.skew(y), stats.kurtosis(y)


def averages(x: np.ndarray) -> None:
    size = 1
    while size * AVERAGES <= len(x):
        means = x[: len(x) // size * size].reshape(-1, size).mean(axis=1)
        stats.anderson(means[:AVERAGES])
        stats.skew(means), stats.kurtosis(means)
        size *= 2


def tail(positive: np.ndarray) -> None:
    threshold = np.quantile(positive, 0.9)
    excess = positive[positive > threshold] - threshold
    if len(excess) > 1 and np.ptp(excess) > 0:
        stats.genpareto.fit(excess, floc=0)
        np.log1p(excess / threshold).mean()


TESTS: tuple[Callable[[np.ndarray], object], ...] = (
    stats.anderson,
    stats.shapiro,
    stats.normaltest,
)
