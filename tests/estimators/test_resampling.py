"""Bootstrap: balanced resamples, and what their centre comes to."""

import numpy as np
import pytest

from chdstat import estimators
from chdstat.errors import InputError
from chdstat.estimators.robust_means import bootstrap_counts


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


def test_it_tends_to_the_mean_with_the_samples_and_lies_below_where_they_are_skewed():
    x = np.random.default_rng(3).lognormal(0, 1.5, size=(2000, 32))
    assert estimators.jung2015(x).mean() < 0.99 * x.mean()
    x = np.random.default_rng(3).gamma(2, size=(4, 4096))
    assert estimators.jung2015(x) == pytest.approx(x.mean(axis=-1), rel=5e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resamples": 0}, "resamples must be at least 1, got 0"),
        ({"resamples": 9.5}, "resamples must be a whole number, got 9.5"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"seed": 0.5}, "seed must be a whole number, got 0.5"),
        ({"location": "mode"}, "'median' or 'huber'"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        estimators.jung2015(np.ones(32), **options)
