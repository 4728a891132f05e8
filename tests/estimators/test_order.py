"""The mean, order statistics, M-estimators and buckets: against SciPy, statsmodels, definitions."""

import numpy as np
import pytest
from scipy import optimize, stats
from statsmodels.robust import norms, scale

from chdstat import estimators
from chdstat.estimators.robust_means import balance, bootstrap_counts, bucket_means, gini


def test_dtype_stays_and_rounding_does_not_add_up():
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
def test_trimmed_means_are_those_of_scipy(name, n, share):
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


def test_huber_reaches_median_and_mean():
    x = draw(1)
    assert estimators.huber(x, c=1e-9) == pytest.approx(np.median(x, axis=-1), rel=1e-6)
    assert estimators.huber(x, c=1e9) == pytest.approx(x.mean(axis=-1), rel=1e-9)


@pytest.mark.parametrize("name", NORMS)
def test_without_a_scale_the_commonest_value_wins(name):
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


def test_a_root_is_found_where_newton_fails():
    rows = np.array([[0.0, 0.5, 1.0], [0.0, 0.1, 1.0]])

    def stiff(rows, theta, centre):
        # Slopes that are far too small send each of Newton's steps out of the bracket.
        return np.tanh(50 * (centre - theta)), np.full(len(theta), 1e-9)

    centre = np.array([0.123, 0.987])
    assert balance(stiff, rows, np.array([0.5, 0.5]), centre) == pytest.approx(centre, rel=1e-9)


# --- buckets, reweighting and resampling ----------------------------------------------------------


@pytest.mark.parametrize("n", [11, 31, 32, 64])
@pytest.mark.parametrize("buckets", [1, 2, 5, 11])
def test_median_of_means_follows_its_definition(n, buckets):
    x = np.random.default_rng(n).gamma(0.5, size=(6, n))
    expected = [np.median([row[j::buckets].mean() for j in range(buckets)]) for row in x]
    assert estimators.median_of_means(x, buckets=buckets) == pytest.approx(expected)


def test_gini_is_half_the_mean_difference():
    x = np.sort(np.random.default_rng(2).gamma(0.5, size=(50, 11)))
    difference = np.abs(x[:, :, np.newaxis] - x[:, np.newaxis]).mean(axis=(1, 2))
    assert gini(x) == pytest.approx(difference / (2 * x.mean(axis=-1)), rel=1e-12)


def test_gini_of_equal_numbers_is_zero():
    assert gini(np.array([[0.0, 0.0, 0.0], [0.1, 0.1, 0.1]])).tolist() == [0.0, 0.0]


def test_binary_gmon_chooses_by_gini():
    x = np.random.default_rng(3).gamma(1.5, size=(500, 32))
    agree = gini(np.sort(bucket_means(x, 11))) <= 0.25
    assert 0.2 < agree.mean() < 0.8
    expected = np.where(agree, estimators.mean(x), estimators.median_of_means(x))
    assert estimators.gmon_binary(x) == pytest.approx(expected, rel=1e-14)


def test_adaptive_gmon_follows_its_definition():
    x = np.random.default_rng(5).lognormal(0, 1.5, size=(200, 32))
    for row, estimate in zip(x, estimators.gmon_adaptive(x), strict=True):
        m = np.sort(bucket_means(row, 11))
        g = 2 * np.sum(np.arange(1, 12) * m) / (11 * m.sum()) - 12 / 11
        cut = int(g * 5)
        assert estimate == pytest.approx(m[cut : 11 - cut].mean(), rel=1e-12)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", ["median_of_means", "gmon_binary", "gmon_adaptive"])
def test_a_bucket_without_a_good_sample_is_left_out(name):
    x = np.random.default_rng(7).gamma(2, size=(4, 33))
    holes = x.copy()
    holes[:, 10::11] = np.nan
    estimate = estimators.lookup(name)
    kept = np.delete(x, np.s_[10::11], axis=-1)
    assert estimate(holes) == pytest.approx(estimate(kept, buckets=10), rel=1e-12)


def draw_skewed(seed, shape=(100, 32)):
    return np.random.default_rng(seed).lognormal(0, 1.5, size=shape)


@pytest.mark.parametrize("alpha", [0.5, 1.0, 3.0])
def test_bayesian_median_follows_its_definition(alpha):
    x = draw_skewed(0)
    correction = x.std(axis=-1) * stats.skew(x, axis=-1) / (3 * (32 * alpha + 2))
    expected = x.mean(axis=-1) - correction
    found = estimators.bayesian_median_of_means(x, alpha=alpha)
    assert found == pytest.approx(expected, rel=1e-12)


def test_bayesian_median_has_dirichlet_weights():
    """Of 100 000 draws, whose median errs by 0.004 of their spread; the bound is 0.03 of it."""
    rng = np.random.default_rng(1)
    x = rng.gamma(2, size=32)
    means = rng.dirichlet(np.ones(32), size=100_000) @ x
    spread = means.std()
    drawn = np.median(means)
    assert estimators.bayesian_median_of_means(x) == pytest.approx(drawn, abs=0.03 * spread)
    assert abs(estimators.mean(x) - drawn) > 0.03 * spread


@pytest.mark.parametrize("delta", [0.9, 0.2, 0.01, 1e-6])
@pytest.mark.parametrize("buckets", [1, 11])
def test_lee_valiant_takes_its_amount_of_weight_off(delta, buckets):
    amount = np.log(1 / delta) / 3
    x = draw_skewed(3)
    centre = estimators.median_of_means(x, buckets=buckets)
    for row, middle, found in zip(
        x, centre, estimators.lee_valiant(x, delta=delta, buckets=buckets), strict=True
    ):
        square = (row - middle) ** 2
        # Bisection in log a: the sum of the weights grows with a.
        low, high = -100.0, 100.0
        for _ in range(200):
            half = (low + high) / 2
            reached = np.minimum(np.exp(half) * square, 1).sum() >= amount
            low, high = (low, half) if reached else (half, high)
        weight = np.minimum(np.exp(high) * square, 1)
        assert weight.sum() == pytest.approx(amount, rel=1e-9)
        expected = middle + np.mean((row - middle) * (1 - weight))
        assert found == pytest.approx(expected, rel=1e-9)


def test_lee_valiant_has_the_authors_buckets():
    x = draw_skewed(4)
    expected = estimators.lee_valiant(x, buckets=5)
    assert estimators.lee_valiant(x) == pytest.approx(expected, rel=1e-15)
    expected = estimators.lee_valiant(x, delta=1e-6, buckets=14)
    assert estimators.lee_valiant(x, delta=1e-6) == pytest.approx(expected, rel=1e-15)


def test_few_deviating_samples_lose_all_weight():
    x = np.r_[np.full(31, 0.5), 1e6]
    assert estimators.lee_valiant(x) == 0.5


def test_resamples_are_balanced():
    counts = bootstrap_counts(32, 128, 0)
    assert (counts.sum(axis=0) == 32).all()
    assert (counts.sum(axis=1) == 128).all()
    assert counts.max() > 1


def test_counts_are_binomial():
    """The share of zeros, (1 - 1/n)^n for independent draws, within five standard errors."""
    share = (bootstrap_counts(32, 2000, 1) == 0).mean()
    assert share == pytest.approx((1 - 1 / 32) ** 32, abs=5 * np.sqrt(0.23 / 64_000))


def test_estimate_is_the_median_of_the_resampled_means():
    x = np.random.default_rng(2).lognormal(0, 1.5, size=(30, 32))
    means = np.array([[np.dot(row, c) / 32 for c in bootstrap_counts(32, 100, 5).T] for row in x])
    found = estimators.jung2015(x, resamples=100, seed=5)
    assert found == pytest.approx(np.median(means, axis=-1), rel=1e-12)
    found = estimators.jung2015(x, resamples=100, seed=5, location="huber")
    assert found == pytest.approx(estimators.huber(means), rel=1e-9)


def test_jung_tends_to_the_mean_from_below():
    x = np.random.default_rng(3).lognormal(0, 1.5, size=(2000, 32))
    assert estimators.jung2015(x).mean() < 0.99 * x.mean()
    x = np.random.default_rng(3).gamma(2, size=(4, 4096))
    assert estimators.jung2015(x) == pytest.approx(x.mean(axis=-1), rel=5e-3)
