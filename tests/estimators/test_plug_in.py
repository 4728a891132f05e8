"""Plug-in means of fitted families: what the sample mean is pulled towards, and how far."""

import numpy as np
import pytest

import chdstat as chd
from chdstat import estimators
from chdstat.errors import InputError
from chdstat.estimators import james_stein, lognormal_shrinkage, mixture_shrinkage


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


def test_the_number_of_components_is_checked():
    with pytest.raises(InputError, match="max_k must be a whole number from 1 to 8, got 9"):
        mixture_shrinkage(np.ones((3, 8)), max_k=9)
