"""Shrinkage: Stein's promise, where it does not hold, and what is shrunk."""

import numpy as np
import pytest

from chdstat import estimators
from chdstat.errors import InputError
from chdstat.estimators import james_stein


def test_formula():
    rng = np.random.default_rng(0)
    y, b, variance = rng.normal(size=(50, 7)), rng.normal(size=(50, 7)), 0.3
    distance = ((y - b) ** 2).sum(axis=-1, keepdims=True)
    rho = np.maximum(0, 1 - 5 * variance / distance)
    assert james_stein(y, b, variance) == pytest.approx(b + rho * (y - b), rel=1e-12)
    swapped = james_stein(y.T, b.T, variance, axis=0)
    assert swapped == pytest.approx(james_stein(y, b, variance).T, rel=1e-15)


@pytest.mark.parametrize("distance", [0.0, 1.0, 3.0, 10.0])
def test_independent_errors_never_lose_by_it(distance):
    """False failure: 20 000 trials, risk within five standard errors; probability below 1e-5."""
    rng = np.random.default_rng(2)
    truth = np.full(10, distance / np.sqrt(10))
    y = truth + rng.normal(size=(20_000, 10))
    gain = ((y - truth) ** 2 - (james_stein(y, 0.0, 1.0) - truth) ** 2).sum(axis=-1)
    assert gain.mean() > -5 * gain.std() / np.sqrt(20_000)
    if distance < 4:
        assert gain.mean() > 5 * gain.std() / np.sqrt(20_000)


def test_three_errors_that_are_one_do_lose():
    """Negative control: channels with one common error are not what Stein's theorem is about."""
    rng = np.random.default_rng(3)
    y = 3 + np.repeat(rng.normal(size=(20_000, 1)), 3, axis=1)
    loss = ((james_stein(y, 0.0, 1.0) - 3) ** 2 - (y - 3) ** 2).sum(axis=-1)
    assert loss.mean() > 5 * loss.std() / np.sqrt(20_000)


@pytest.mark.parametrize("k", [1, 2])
def test_fewer_than_three_values_stay(k):
    y = np.arange(1.0, k + 1)
    assert james_stein(y, np.zeros(k), 100.0).tolist() == y.tolist()


def test_without_noise_the_unbiased_and_with_much_the_biased_one_stays():
    y, b = np.array([1.0, 2.0, 3.0]), np.array([3.0, 3.0, 1.0])
    assert james_stein(y, b, 0.0).tolist() == y.tolist()
    assert james_stein(y, b, 1e9) == pytest.approx(b)
    assert james_stein(y, y, 1.0).tolist() == y.tolist()


def test_values_without_a_biased_estimate_stay_and_do_not_count():
    y = np.array([1.0, 2.0, 3.0, 4.0])
    found = james_stein(y, [0.0, np.nan, 0.0, 0.0], [1.0, 50.0, 1.0, 1.0])
    expected = james_stein(y[[0, 2, 3]], 0.0, 1.0)
    assert found[1] == 2
    assert found[[0, 2, 3]] == pytest.approx(expected, rel=1e-15)
    assert james_stein(y, np.inf, 1.0).tolist() == y.tolist()


def test_shapes_must_fit():
    with pytest.raises(InputError, match=r"shape \(3,\), got \(2,\)"):
        james_stein(np.ones(3), np.ones(2), 1.0)


def test_the_variance_that_shrinks_is_the_square_of_the_standard_error():
    x = np.random.default_rng(4).gamma(0.5, size=(5, 3, 32))
    error = x.std(axis=-1, ddof=1) / np.sqrt(32)
    expected = james_stein(x.mean(axis=-1), estimators.gmon_adaptive(x), error**2)
    assert estimators.gmon_shrinkage(x) == pytest.approx(expected, rel=1e-12)
    # A single sample has no error, and is its own estimate.
    assert estimators.gmon_shrinkage(x[..., :1], buckets=1) == pytest.approx(x[..., 0])


def test_gmon_shrinkage_lies_between_mean_and_gmon():
    x = np.random.default_rng(7).lognormal(0, 2, size=(200, 3, 32))
    mean, robust = estimators.mean(x), estimators.gmon_adaptive(x)
    share = (estimators.gmon_shrinkage(x) - mean) / (robust - mean)
    assert (share >= -1e-9).all()
    assert (share <= 1 + 1e-9).all()
    # One share for all channels of a pixel.
    assert share == pytest.approx(np.repeat(share[:, :1], 3, axis=1), rel=1e-6)


ALL = ["gmon_shrinkage", "gamma_shrinkage", "lognormal_shrinkage", "mixture_shrinkage"]


@pytest.mark.parametrize("name", ALL)
def test_one_channel_alone_is_not_shrunk(name):
    x = np.random.default_rng(8).lognormal(0, 2, size=(20, 1, 32))
    assert estimators.lookup(name)(x) == pytest.approx(x.mean(axis=-1), rel=1e-12)
