"""Reweighting: the definitions, and the limits at which nothing is left of the correction."""

import numpy as np
import pytest
from scipy import stats

from chdstat import estimators
from chdstat.errors import InputError


def draw(seed, shape=(100, 32)):
    return np.random.default_rng(seed).lognormal(0, 1.5, size=shape)


@pytest.mark.parametrize("alpha", [0.5, 1.0, 3.0])
def test_bayesian_median_of_means_follows_its_definition(alpha):
    x = draw(0)
    correction = x.std(axis=-1) * stats.skew(x, axis=-1) / (3 * (32 * alpha + 2))
    expected = x.mean(axis=-1) - correction
    found = estimators.bayesian_median_of_means(x, alpha=alpha)
    assert found == pytest.approx(expected, rel=1e-12)


def test_bayesian_median_of_means_is_the_median_of_means_with_dirichlet_weights():
    """Of 100 000 draws, whose median errs by 0.004 of their spread; the bound is 0.03 of it."""
    rng = np.random.default_rng(1)
    x = rng.gamma(2, size=32)
    means = rng.dirichlet(np.ones(32), size=100_000) @ x
    spread = means.std()
    drawn = np.median(means)
    assert estimators.bayesian_median_of_means(x) == pytest.approx(drawn, abs=0.03 * spread)
    assert abs(estimators.mean(x) - drawn) > 0.03 * spread


def test_symmetric_samples_and_a_large_alpha_leave_the_mean():
    assert estimators.bayesian_median_of_means([1.0, 2.0, 3.0]) == pytest.approx(2.0, rel=1e-15)
    x = draw(2)
    found = estimators.bayesian_median_of_means(x, alpha=1e12)
    assert found == pytest.approx(x.mean(axis=-1), rel=1e-9)


@pytest.mark.parametrize("delta", [0.9, 0.2, 0.01, 1e-6])
@pytest.mark.parametrize("buckets", [1, 11])
def test_lee_valiant_takes_its_amount_of_weight_off(delta, buckets):
    amount = np.log(1 / delta) / 3
    x = draw(3)
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


def test_lee_valiant_has_as_many_buckets_as_the_authors_set():
    x = draw(4)
    expected = estimators.lee_valiant(x, buckets=5)
    assert estimators.lee_valiant(x) == pytest.approx(expected, rel=1e-15)
    expected = estimators.lee_valiant(x, delta=1e-6, buckets=14)
    assert estimators.lee_valiant(x, delta=1e-6) == pytest.approx(expected, rel=1e-15)


def test_fewer_deviating_samples_than_the_amount_lose_all_of_their_weight():
    x = np.r_[np.full(31, 0.5), 1e6]
    assert estimators.lee_valiant(x) == 0.5


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("lee_valiant", {"delta": 0.0}),
        ("lee_valiant", {"delta": 1.0}),
        ("lee_valiant", {"buckets": 33}),
        ("bayesian_median_of_means", {"alpha": 0.0}),
    ],
)
def test_options_out_of_range_are_refused(name, options):
    with pytest.raises(InputError, match="got"):
        estimators.lookup(name)(np.ones(32), **options)
