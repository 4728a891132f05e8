"""The mean, order statistics and M-estimators: against NumPy, SciPy and statsmodels."""

import numpy as np
import pytest
from scipy import optimize, stats
from statsmodels.robust import norms, scale

from chdstat import estimators
from chdstat.estimators.order import balance


def test_dtype_of_the_samples_is_kept_and_its_rounding_is_not_added_up():
    x = np.full(2**22, 0.1, np.float32)
    x[0] = 1e6
    assert estimators.mean(x).dtype == np.float32
    assert estimators.mean(x) == pytest.approx(x.astype(np.float64).mean(), rel=1e-7)


@pytest.mark.parametrize("n", [1, 2, 31, 32])
def test_median_is_that_of_numpy(n):
    x = np.random.default_rng(n).gamma(0.5, size=(40, 3, n))
    assert estimators.median(x) == pytest.approx(np.median(x, axis=-1), rel=1e-15)


def winsorized(x, share):
    return np.asarray(stats.mstats.winsorize(x, (share, share), axis=-1)).mean(axis=-1)


BY_SCIPY = {
    "trimmed_mean": lambda x, share: stats.trim_mean(x, share, axis=-1),
    "winsorized_mean": winsorized,
}


@pytest.mark.parametrize("name", BY_SCIPY)
@pytest.mark.parametrize("share", [0.0, 0.05, 0.1, 0.25, 0.49])
@pytest.mark.parametrize("n", [7, 32])
def test_means_without_a_share_of_the_ends_are_those_of_scipy(name, n, share):
    x = np.random.default_rng(n).gamma(0.5, size=(40, n))
    expected = BY_SCIPY[name](x, share)
    assert estimators.lookup(name)(x, share=share) == pytest.approx(expected, rel=1e-13)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_a_share_counts_the_good_samples_only():
    x = np.array([np.nan, 0.0, 1.0, 2.0, 30.0, np.inf])
    assert estimators.trimmed_mean(x, share=0.25) == 1.5
    assert estimators.winsorized_mean(x, share=0.25) == 1.5


NORMS = {"huber": norms.HuberT, "tukey": norms.TukeyBiweight}


def draw(seed, shape=(60, 32)):
    return np.random.default_rng(seed).lognormal(0, 1.5, size=shape)


@pytest.mark.parametrize("name", NORMS)
@pytest.mark.parametrize("c", [0.8, None, 6.0])
@pytest.mark.parametrize("n", [9, 32])
def test_location_is_that_of_statsmodels(name, c, n):
    x = draw(n, (60, n))
    norm = NORMS[name]() if c is None else NORMS[name](c)
    expected = [
        norms.estimate_location(row, scale.mad(row), norm, maxiter=5000, tol=1e-12) for row in x
    ]
    options = {} if c is None else {"c": c}
    assert estimators.lookup(name)(x, **options) == pytest.approx(expected, rel=1e-7)


def test_huber_lies_between_median_and_mean_and_reaches_both():
    x = draw(1)
    assert estimators.huber(x, c=1e-9) == pytest.approx(np.median(x, axis=-1), rel=1e-6)
    assert estimators.huber(x, c=1e9) == pytest.approx(x.mean(axis=-1), rel=1e-9)


@pytest.mark.parametrize("name", NORMS)
def test_without_a_scale_the_value_that_most_samples_have_is_the_estimate(name):
    x = np.r_[np.full(17, 0.3), np.geomspace(1e-3, 1e6, 15)]
    assert estimators.lookup(name)(x) == pytest.approx(0.3, rel=1e-12)


@pytest.mark.parametrize("delta", [0.01, 0.05, 0.5])
def test_catoni_solves_his_equation(delta):
    level = np.log(1 / delta)
    x = draw(3)
    for row, estimate in zip(x, estimators.catoni(x, delta=delta), strict=True):
        n, v = len(row), row.var()
        a = np.sqrt(2 * level / (n * (v + 2 * v * level / (n - 2 * level))))

        def influence(theta, row=row, a=a):
            t = a * (row - theta)
            return np.sum(np.sign(t) * np.log(1 + np.abs(t) + t**2 / 2))

        expected = optimize.brentq(influence, row.min(), row.max(), xtol=1e-14, rtol=1e-13)
        assert estimate == pytest.approx(expected, rel=1e-9)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_catoni_of_few_good_samples_is_their_mean():
    x = np.r_[np.arange(9.0), np.full(5, np.nan)]
    assert estimators.catoni(x) == 4.0


def test_a_root_is_found_where_newton_alone_would_run_away():
    rows = np.array([[0.0, 0.5, 1.0], [0.0, 0.1, 1.0]])

    def stiff(rows, theta, centre):
        # Slopes that are far too small send each of Newton's steps out of the bracket.
        return np.tanh(50 * (centre - theta)), np.full(len(theta), 1e-9)

    centre = np.array([0.123, 0.987])
    assert balance(stiff, rows, np.array([0.5, 0.5]), centre) == pytest.approx(centre, rel=1e-9)
