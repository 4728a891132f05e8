"""Shrinkage: Stein's promise, where it does not hold, and the means that are pulled to."""

import numpy as np
import pytest

import chdstat as chd
from chdstat import estimators
from chdstat.errors import InputError
from chdstat.estimators import james_stein, lognormal_shrinkage, mixture_shrinkage


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


ALL = ["gmon_shrinkage", "gamma_shrinkage", "lognormal_shrinkage", "mixture_shrinkage"]


@pytest.mark.parametrize("name", ALL)
def test_one_channel_alone_is_not_shrunk(name):
    x = np.random.default_rng(8).lognormal(0, 2, size=(20, 1, 32))
    assert estimators.lookup(name)(x) == pytest.approx(x.mean(axis=-1), rel=1e-12)


def two_kinds(rng, shape, spread=1.5):
    """Draw from nulls and two log-normal components, and return their expectation, too."""
    bright, lit = rng.random(shape) < 0.4, rng.random(shape) < 0.7
    x = np.exp(np.where(bright, 4.0, 0.0) + spread * rng.normal(size=shape)) * lit
    return x, 0.7 * (0.6 + 0.4 * np.exp(4)) * np.exp(spread**2 / 2)


def test_the_mean_of_a_fitted_gamma_is_the_sample_mean():
    rng = np.random.default_rng(5)
    x = rng.lognormal(0, 2, size=(50, 3, 32)) * (rng.random((50, 1, 32)) < 0.6)
    assert estimators.gamma_shrinkage(x) == pytest.approx(x.mean(axis=-1), rel=1e-9)


def test_log_normal_shrinkage_uses_the_plug_in_mean():
    rng = np.random.default_rng(6)
    x = rng.lognormal(0, 1, size=(50, 3, 32)) * (rng.random((50, 1, 32)) < 0.6)
    log, lit = np.log(np.where(x > 0, x, 1)), x > 0
    n = lit.sum(axis=-1)
    mu = log.sum(axis=-1) / n
    variance = (((log - mu[..., np.newaxis]) ** 2) * lit).sum(axis=-1) / n
    plug_in = n / 32 * np.exp(mu + variance / 2)
    expected = james_stein(x.mean(axis=-1), plug_in, x.var(axis=-1, ddof=1) / 32)
    found = estimators.lognormal_shrinkage(x)
    assert found == pytest.approx(expected, rel=1e-9)
    assert found != pytest.approx(x.mean(axis=-1), rel=1e-3)


def test_mixture_shrinkage_uses_the_plug_in_mean():
    x, _ = two_kinds(np.random.default_rng(10), (40, 3, 64))
    found = chd.fit.mixture(x, effort="fast")
    mu, sigma = found.parameters["mu"], found.parameters["sigma"]
    plug_in = (x > 0).mean(axis=-1) * np.nansum(found.weights * np.exp(mu + sigma**2 / 2), axis=-1)
    expected = james_stein(x.mean(axis=-1), plug_in, x.var(axis=-1, ddof=1) / 64)
    # Components of a width of 1e-3 make much of the rounding of logarithms.
    assert mixture_shrinkage(x) == pytest.approx(expected, rel=1e-6)
    assert mixture_shrinkage(x) != pytest.approx(x.mean(axis=-1), rel=1e-3)


def test_one_component_is_a_log_normal():
    x, _ = two_kinds(np.random.default_rng(11), (40, 3, 24))
    assert mixture_shrinkage(x, max_k=1) == pytest.approx(lognormal_shrinkage(x), rel=1e-6)


def test_where_the_mixture_is_true_most_estimates_improve():
    """False failure: other seeds improve 72 % of 300 pixels; 60 % is 4.6 deviations less, 2e-6."""
    x, truth = two_kinds(np.random.default_rng(12), (300, 3, 2048), spread=2.0)
    gain = ((x.mean(axis=-1) - truth) ** 2 - (mixture_shrinkage(x) - truth) ** 2).sum(axis=-1)
    assert (gain > 0).mean() > 0.6


def test_where_components_lie_apart_one_log_normal_is_misled():
    """Negative control: the plug-in of a family that is wrong is not near the expectation.

    False failure: the standard error of a mean is 2.6 %; 15 % is more than five of them, 1e-7.
    """
    x, truth = two_kinds(np.random.default_rng(13), (3, 4096), spread=0.3)
    assert chd.fit.mixture(x).mean() == pytest.approx(np.full(3, truth), rel=0.15)
    assert (chd.fit.lognormal(x).mean() > 1.3 * truth).all()


def test_a_mixture_of_gamma_components_has_the_sample_mean():
    """Why the components are log-normal: the scores of the scales vanish only there."""
    x, _ = two_kinds(np.random.default_rng(14), (40, 3, 64))
    assert chd.fit.mixture(x, family="gamma").mean() == pytest.approx(x.mean(axis=-1), rel=1e-2)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize(
    "row",
    [
        [0.0, 0.0, 0.0, 0.0],
        [2.0, 2.0, 2.0, 2.0],
        [0.0, 0.0, 0.0, 5.0],
        [0.0, np.nan, np.nan, 5.0],
        [3.0, np.nan, np.inf, -np.inf],
    ],
)
def test_where_no_mixture_can_be_fitted_it_is_the_mean(row):
    x = np.tile(row, (3, 1))
    good = x[:, np.isfinite(row) & (np.array(row) >= 0)]
    assert mixture_shrinkage(x) == pytest.approx(good.mean(axis=-1), rel=1e-12)
