"""Normality: statistics of SciPy, uniform p-values, transforms, discoveries."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import Reason
from chdstat.inference import TESTS
from chdstat.inference.normality import run_tests

ALL = tuple(TESTS)


def run(x, tests=ALL, transform="linear", n=None):
    x = np.sort(np.asarray(x, dtype=np.float64), axis=-1)
    n = np.full(x.shape[:-1], x.shape[-1]) if n is None else n
    tested = run_tests(x, n, np.ones(n.shape, dtype=bool), (transform,), [TESTS[t] for t in tests])
    return tested["statistic"][..., 0, :], tested["p_value"][..., 0, :]


def anderson_darling(x):
    """A^2 from the definition, with both tails of SciPy."""
    z = (np.sort(x) - x.mean()) / x.std(ddof=1)
    odd = 2 * np.arange(1, x.size + 1) - 1
    return -x.size - (odd * (stats.norm.logcdf(z) + stats.norm.logsf(z[::-1]))).sum() / x.size


PUBLISHED = {
    "anderson-darling": (anderson_darling, 1e-9),
    "shapiro-wilk": (lambda x: stats.shapiro(x).statistic, 1e-6),
    "dagostino": (lambda x: stats.normaltest(x).statistic, 1e-9),
}


@pytest.mark.parametrize("n", [20, 21, 5000])
@pytest.mark.parametrize("test", ALL)
def test_statistics_are_those_of_scipy(test, n):
    rng = np.random.default_rng(n)
    x = np.stack([rng.gamma(3.0, size=n), rng.lognormal(size=n), rng.normal(50, 2, size=n)])
    function, tolerance = PUBLISHED[test]
    found = run(x, [test])[0][..., 0]
    np.testing.assert_allclose(found, [function(row) for row in x], rtol=tolerance)


@pytest.mark.parametrize("n", [30, 100, 2000])
def test_shapiro_wilk_p_values_are_those_of_royston(n):
    x = np.random.default_rng(n).gamma([[50.0], [2.0]], size=(2, n))
    statistic, p_value = run(x, ["shapiro-wilk"])
    for i, row in enumerate(x):
        expected = stats.shapiro(row)
        assert statistic[i, 0] == pytest.approx(expected.statistic, rel=1e-6)
        # log(1 - W) magnifies what SciPy's single precision quantiles lose.
        assert p_value[i, 0] == pytest.approx(max(expected.pvalue, 1e-16), rel=1e-3)


def test_dagostino_is_chi_square_for_many_samples():
    statistic = np.array([0.5, 1.0, 2.0, 4.0, 6.0, 9.0])
    p = TESTS["dagostino"].p_value(statistic, np.full(6, 10**9))
    np.testing.assert_allclose(p, stats.chi2(2).sf(statistic), rtol=0.01)


def test_anderson_darling_has_published_quantiles():
    # D'Agostino and Stephens 1986, table 4.7, of A*^2 with mean and variance fitted.
    quantiles = np.array([0.631, 0.752, 0.873, 1.035, 1.159])
    for n in (20, 100, 5000):
        statistic = quantiles / (1 + 0.75 / n + 2.25 / n**2)
        p = TESTS["anderson-darling"].p_value(statistic, np.full(5, n))
        np.testing.assert_allclose(p, [0.1, 0.05, 0.025, 0.01, 0.005], rtol=0.05)


@pytest.mark.parametrize("name", ALL)
def test_p_values_fall_and_never_reach_0(name):
    statistic = np.array([0.5, 2.0, 10.0, 30.0, 100.0, 1e3, 1e12])
    if name == "shapiro-wilk":
        statistic = 1 - np.array([1e-4, 1e-3, 0.01, 0.1, 0.5, 0.9, 0.99])
    p = TESTS[name].p_value(statistic, np.full(7, 3000))
    assert (np.diff(p) <= 0).all()
    assert p[-1] == 1e-16


REPEATS = 4000


@pytest.mark.parametrize("n", [8, 20, 32, 100, 512, 5000])
def test_p_values_are_uniform(n):
    """Under the null, all three, by Kolmogorov-Smirnov and by the share at 0.05 and 0.01.

    For exact p-values, each of the 17 distances exceeds its bound with probability 1e-6, each share
    with 1e-5 or less (4.5 sigma, of a Poisson count of 20 or more): a false failure once in 1000
    seeds. The bounds leave 0.013 and 7 % of the level for Royston's approximation.
    """
    repeats = REPEATS if n < 3000 else 2000
    x = np.random.default_rng(100 + n).lognormal(size=(repeats, n))
    p_values = run(x, [t for t in ALL if TESTS[t].minimum <= n], "log")[1]
    ascending = np.sort(p_values, axis=0)
    rank = np.arange(1, repeats + 1)[:, np.newaxis] / repeats
    distance = np.maximum(rank - ascending, ascending - rank + 1 / repeats).max(axis=0)
    assert (distance < 2.7 / np.sqrt(repeats) + 0.013).all(), distance
    for level in (0.05, 0.01):
        share = (p_values < level).mean(axis=0)
        bound = 5 * np.sqrt(level / repeats) + 0.07 * level
        assert (np.abs(share - level) < bound).all(), (level, share)


def test_chi_square_p_values_would_be_found_out():
    # Negative control: the textbook p-value of Jarque-Bera, at 100 samples, is not uniform.
    x = np.random.default_rng(21).normal(size=(REPEATS, 100))
    p = np.sort(stats.jarque_bera(x, axis=-1).pvalue)
    distance = np.abs(p - np.arange(1, REPEATS + 1) / REPEATS).max()
    assert distance > 2.7 / np.sqrt(REPEATS) + 0.013


@np.errstate(all="ignore")
def test_rows_of_any_length_are_as_if_alone():
    rng = np.random.default_rng(6)
    n = rng.integers(8, 700, size=300)
    x = np.full((300, 700), np.inf)
    for row, count in zip(x, n, strict=True):
        row[:count] = np.sort(rng.gamma(5.0, size=count))
    together = run(x, n=n)
    for i in range(0, 300, 25):
        alone = run(x[i : i + 1, : n[i]])
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[i], b[0], rtol=1e-9)
    assert (np.isnan(together[1][:, ALL.index("dagostino")]) == (n < 20)).all()


def test_samples_are_transformed():
    x = np.random.default_rng(1).gamma(3.0, size=(6, 200))
    for transform, function in {"log": np.log, "sqrt": np.sqrt, "linear": np.asarray}.items():
        result = chd.gaussianity(x, transform=transform, test="dagostino")
        y = function(x)
        np.testing.assert_allclose(result.statistic, stats.normaltest(y, axis=-1).statistic)
        np.testing.assert_allclose(result.skewness, stats.skew(y, axis=-1))
        np.testing.assert_allclose(result.kurtosis, stats.kurtosis(y, axis=-1))


def test_several_at_once_are_as_if_apart():
    x = np.random.default_rng(2).lognormal(size=(3, 4, 60)).astype(np.float32)
    x[0, 0, 10:] = 0
    together = chd.gaussianity(x, transform=("sqrt", "log"), test=ALL)
    assert together.p_value.shape == (3, 4, 2, 3)
    assert together.skewness.shape == (3, 4, 2)
    assert together.reason.shape == (3, 4, 3)
    for i, transform in enumerate(together.transform):
        for j, test in enumerate(together.test):
            alone = chd.gaussianity(x, transform=transform, test=test)
            np.testing.assert_array_equal(together.p_value[..., i, j], alone.p_value)
            np.testing.assert_array_equal(together.statistic[..., i, j], alone.statistic)
            np.testing.assert_array_equal(together.reason[..., j], alone.reason)
    # 10 samples are enough for all but D'Agostino's.
    assert together.reason[0, 0].tolist() == [Reason.TOO_FEW * (t == "dagostino") for t in ALL]
    assert chd.gaussianity(x, test=["dagostino"]).p_value.shape == (3, 4, 1)


def test_far_outliers_do_not_overflow():
    x = np.concatenate([np.random.default_rng(8).random(5000) + 1, [1e30]])
    assert 0 < float(chd.gaussianity(x, transform="linear").p_value) < 1e-15


def _image_of_four_to_one(rng, repeats, n):
    """One channel is one repeat: 1600 pixels, 320 of which are not log-normal, in three ways."""
    radiance = rng.lognormal(-1, 1, size=(40, 40, repeats, n)).astype(np.float32)
    other = np.zeros((40, 40), dtype=bool)
    other[:8] = True
    radiance[:3] = rng.gamma(0.7, size=(3, 40, repeats, n))
    radiance[3:6] = np.exp(rng.standard_t(3, size=(3, 40, repeats, n)))
    radiance[6:8] *= np.exp(rng.choice([0, 4], size=(2, 40, repeats, n)))
    return radiance, other


def test_false_discoveries_keep_to_their_rate():
    """For every test: the false share of the discoveries, over 20 images, is at most 5 %.

    Benjamini and Hochberg promise 4 % here (5 % of the 80 % that are log-normal). The share of an
    image has a deviation of sqrt(0.04 * 0.96 / 300) = 0.011, the mean of 20 one of 0.0025: it
    exceeds 5 % with probability 4e-5, for three tests 1.2e-4.
    """
    radiance, other = _image_of_four_to_one(np.random.default_rng(15), 20, 200)
    samples = chd.Samples.from_array(radiance, axes="yxcs")
    found = chd.gaussianity(samples, test=ALL, progress=False)
    assert found["rejected"].dims == ("y", "x", "channel", "test")
    rejected = found["rejected"].to_numpy()
    discoveries = rejected.sum(axis=(0, 1))
    share = rejected[~other].sum(axis=0) / discoveries
    assert (share.mean(axis=0) <= 0.05).all(), share.mean(axis=0)
    # Most of the others are found, except by tests that look away from the middle.
    power = rejected[other].mean(axis=(0, 1))
    assert (power > 0.8).all(), power
    # Negative control: p-values at 5 % alone, without the correction.
    raw = found["p_value"].to_numpy() <= 0.05
    assert (raw[~other].sum(axis=(0, 1)) / raw.sum(axis=(0, 1, 2)) > 0.1).all()
