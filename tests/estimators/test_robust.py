"""Buckets: definitions, the Gini coefficient, and how G-MoN lies between mean and MoN."""

import numpy as np
import pytest

from chdstat import estimators
from chdstat.errors import InputError
from chdstat.estimators.robust_means import bucket_means, gini


def test_buckets_are_dealt_round_robin():
    assert bucket_means(np.arange(8.0), 3).tolist() == [3.0, 4.0, 3.5]


@pytest.mark.parametrize("n", [11, 31, 32, 64])
@pytest.mark.parametrize("buckets", [1, 2, 5, 11])
def test_median_of_means_follows_its_definition(n, buckets):
    x = np.random.default_rng(n).gamma(0.5, size=(6, n))
    expected = [np.median([row[j::buckets].mean() for j in range(buckets)]) for row in x]
    assert estimators.median_of_means(x, buckets=buckets) == pytest.approx(expected)


def test_one_bucket_is_the_mean_and_one_sample_per_bucket_is_the_median():
    x = np.random.default_rng(0).gamma(0.5, size=(20, 15))
    assert estimators.median_of_means(x, buckets=1) == pytest.approx(x.mean(axis=-1))
    assert estimators.median_of_means(x, buckets=15) == pytest.approx(np.median(x, axis=-1))


@pytest.mark.parametrize("buckets", [0, 33])
def test_buckets_must_be_fillable(buckets):
    with pytest.raises(InputError, match="between 1 and the number of samples, 32"):
        estimators.median_of_means(np.ones((2, 32)), buckets=buckets)


def test_gini_coefficient_is_half_the_relative_mean_difference():
    x = np.sort(np.random.default_rng(2).gamma(0.5, size=(50, 11)))
    difference = np.abs(x[:, :, np.newaxis] - x[:, np.newaxis]).mean(axis=(1, 2))
    assert gini(x) == pytest.approx(difference / (2 * x.mean(axis=-1)), rel=1e-12)


def test_gini_coefficient_of_nothing_and_of_equal_numbers_is_zero():
    assert gini(np.array([[0.0, 0.0, 0.0], [0.1, 0.1, 0.1]])).tolist() == [0.0, 0.0]


def test_binary_gmon_is_the_mean_or_the_median_of_means_as_the_gini_coefficient_says():
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


def test_clean_buckets_give_adaptive_gmon_their_mean_and_not_their_median():
    # The negative control for 1 - G in place of G, which a public package has.
    x = np.random.default_rng(6).gamma(50, size=(50, 55))
    assert estimators.gmon_adaptive(x) == pytest.approx(estimators.mean(x), rel=1e-12)
    assert estimators.gmon_adaptive(x) != pytest.approx(estimators.median_of_means(x), rel=1e-12)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", ["median_of_means", "gmon_binary", "gmon_adaptive"])
def test_a_bucket_without_a_good_sample_is_left_out(name):
    x = np.random.default_rng(7).gamma(2, size=(4, 33))
    holes = x.copy()
    holes[:, 10::11] = np.nan
    estimate = estimators.lookup(name)
    kept = np.delete(x, np.s_[10::11], axis=-1)
    assert estimate(holes) == pytest.approx(estimate(kept, buckets=10), rel=1e-12)
