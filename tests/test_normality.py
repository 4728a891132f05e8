"""Normality: published answers, calibrated p-values, and averages that turn Gaussian."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.diagnostic import normal_ad

import chdstat as chd
from chdstat._multiplicity import q_values
from chdstat._reasons import Reason
from chdstat.errors import InputError
from chdstat.normality import TESTS, gaussianity_of_means

BOTH = sorted(TESTS)


def test_dagostino_equals_scipy():
    x = np.random.default_rng(1).gamma(3.0, size=(6, 200))
    result = chd.gaussianity(x, transform="sqrt", test="dagostino")
    expected = stats.normaltest(np.sqrt(x), axis=-1)
    np.testing.assert_allclose(result.statistic, expected.statistic)
    np.testing.assert_allclose(result.p_value, expected.pvalue)
    np.testing.assert_allclose(result.skewness, stats.skew(np.sqrt(x), axis=-1))
    np.testing.assert_allclose(result.kurtosis, stats.kurtosis(np.sqrt(x), axis=-1))


@pytest.mark.parametrize("sigma", [0.2, 1.0])
def test_anderson_darling_equals_statsmodels(sigma):
    x = np.random.default_rng(2).lognormal(0, sigma, size=(4, 100))
    result = chd.gaussianity(x, transform="linear")
    expected = np.array([normal_ad(row) for row in x])
    np.testing.assert_allclose(result.statistic, expected[:, 0], rtol=1e-10)
    small = result.statistic < 8
    np.testing.assert_allclose(result.p_value[small], expected[small, 1], rtol=1e-8)


def test_anderson_darling_has_its_published_quantiles():
    # D'Agostino and Stephens 1986 for both parameters fitted; 20 000 rows leave errors below 2 %.
    x = np.random.default_rng(3).lognormal(size=(20_000, 200))
    statistic = chd.gaussianity(x).statistic * (1 + 0.75 / 200 + 2.25 / 200**2)
    quantiles = np.quantile(statistic, [0.5, 0.75, 0.85, 0.9, 0.95, 0.975, 0.99])
    expected = [0.339, 0.467, 0.564, 0.633, 0.736, 0.858, 1.036]
    np.testing.assert_allclose(quantiles, expected, rtol=0.04)


@pytest.mark.parametrize("test", BOTH)
@pytest.mark.parametrize("level", [0.01, 0.05, 0.2])
def test_level(test, level):
    # 4 sigma of the share of 4000 rows, plus 0.8 % for the approximations of both p-values.
    x = np.random.default_rng(4).lognormal(size=(4000, 128))
    share = (chd.gaussianity(x, test=test).p_value < level).mean()
    assert abs(share - level) < 4 * np.sqrt(level / 4000) + 0.008


@pytest.mark.parametrize("test", BOTH)
def test_power(test):
    x = np.random.default_rng(5).exponential(size=(500, 256))
    assert (chd.gaussianity(x, test=test).p_value < 0.05).mean() > 0.98


@pytest.mark.parametrize("test", BOTH)
def test_nulls_and_bad_samples_take_no_part(test):
    rng = np.random.default_rng(6)
    x = rng.lognormal(size=80)
    mixed = rng.permutation(np.concatenate([x, np.zeros(40), [np.nan, np.inf, -2.0]]))
    batch = np.stack([mixed, rng.lognormal(size=mixed.size)])
    alone, both = chd.gaussianity(x, test=test), chd.gaussianity(batch, test=test)
    assert int(both.n[0]) == 80
    for name in ("statistic", "p_value", "skewness", "kurtosis"):
        assert getattr(both, name)[0] == pytest.approx(float(getattr(alone, name)))


def test_radiance_scales_nothing():
    x = np.random.default_rng(7).gamma(0.7, size=(3, 200))
    for transform in ("log", "sqrt", "linear"):
        one, many = (chd.gaussianity(s * x, transform=transform) for s in (1, 1e4))
        np.testing.assert_allclose(many.statistic, one.statistic, rtol=1e-8)


def test_unusable_pixels_are_data():
    x = np.array([[0.0] * 30, [np.nan] * 30, [1.0] * 3 + [0.0] * 27, [5.0] * 30])
    result = chd.gaussianity(x)
    expected = [Reason.ALL_NULL, Reason.ALL_BAD, Reason.TOO_FEW, Reason.CONSTANT]
    np.testing.assert_array_equal(result.reason, expected)
    assert np.isnan([result.statistic, result.p_value, result.skewness]).all()


def test_far_outliers_do_not_overflow():
    x = np.concatenate([np.random.default_rng(8).random(5000) + 1, [1e30]])
    assert 0 < float(chd.gaussianity(x, transform="linear").p_value) < 1e-20


def test_averages_turn_gaussian_at_the_predicted_rate():
    # Mean skewness of 32 averages is biased low, the same way at every N: compare their ratios.
    x = np.random.default_rng(9).exponential(size=(2000, 2048))
    means = gaussianity_of_means(x)
    np.testing.assert_array_equal(means.sizes, [1, 2, 4, 8, 16, 32, 64])
    rejected = (means.p_value < 0.05).mean(axis=0)
    assert rejected[0] > 0.9
    assert rejected[-1] < 0.15
    assert (np.diff(rejected) < 0).all()
    np.testing.assert_allclose(means.predicted_skewness[:, 2], means.predicted_skewness[:, 0] / 2)
    np.testing.assert_allclose(means.predicted_kurtosis[:, 2], means.predicted_kurtosis[:, 0] / 4)
    long = gaussianity_of_means(x[:, :1024], sizes=[16], n_means=64)
    assert long.skewness.mean() == pytest.approx(long.predicted_skewness.mean(), rel=0.1)


def test_gaussian_averages_are_rejected_at_the_level():
    # Negative control: Gaussian samples far from 0 stay Gaussian at every N.
    x = np.random.default_rng(10).normal(100, 1, size=(2000, 256))
    rejected = (gaussianity_of_means(x).p_value < 0.05).mean(axis=0)
    np.testing.assert_allclose(rejected, 0.05, atol=0.025)


def test_averages_hold_nulls_but_no_bad_samples():
    rng = np.random.default_rng(11)
    x = np.where(rng.random(128) < 0.5, 0, rng.gamma(2.0, size=128))
    x[5] = np.nan
    means = gaussianity_of_means(x, sizes=[4])
    batches = np.nanmean(x.reshape(32, 4), axis=-1)
    assert means.skewness[0] == pytest.approx(stats.skew(batches))
    good = x[~np.isnan(x)]
    assert means.predicted_skewness[0] == pytest.approx(stats.skew(good) / 2)
    x[:4] = np.nan
    assert gaussianity_of_means(x, sizes=[4]).reason[0] == Reason.TOO_FEW
    assert gaussianity_of_means(np.zeros(64), sizes=[2]).reason[0] == Reason.ALL_NULL
    assert gaussianity_of_means(np.ones(64), sizes=[2]).reason[0] == Reason.CONSTANT


def test_q_values_control_the_false_discoveries():
    rng = np.random.default_rng(12)
    p = np.concatenate([rng.random(900), rng.random(100) * 1e-6]).reshape(20, 50)
    p[0, 0] = np.nan
    q = q_values(p)
    assert np.isnan(q[0, 0])
    assert (q.ravel()[900:] < 0.05).all()
    assert (q.ravel()[:900] < 0.05).sum() < 20
    stacked = q_values(np.stack([p, np.ones_like(p)], axis=-1))
    np.testing.assert_array_equal(stacked[..., 0], q)


@pytest.mark.parametrize("transform", ["log", "linear"])
def test_image(transform):
    radiance = np.random.default_rng(13).lognormal(size=(6, 6, 3, 256))
    radiance[0, 0] = 0
    samples = chd.Samples.from_array(radiance)
    dataset = chd.gaussianity(samples, transform=transform, progress=False)
    assert np.isnan(dataset["q_value"][0, 0]).all()
    assert not dataset["rejected"][0, 0].any()
    share = float(dataset["rejected"].mean())
    assert share < 0.05 if transform == "log" else share > 0.95
    for variable in dataset.data_vars.values():
        assert {"long_name", "units"} <= set(variable.attrs)


def test_image_of_means():
    radiance = np.random.default_rng(14).exponential(size=(8, 8, 3, 512))
    radiance[0, 0] = 0
    dataset = gaussianity_of_means(chd.Samples.from_array(radiance), progress=False)
    assert dataset["p_value"].dims == ("y", "x", "channel", "size")
    np.testing.assert_array_equal(dataset["size"], [1, 2, 4, 8, 16])
    share = dataset["rejected_share"].mean("channel").to_numpy()
    assert share[0] > 0.9 > 0.3 > share[-1]


def test_wrong_options_are_refused():
    with pytest.raises(InputError, match="transform must be one of log, linear, sqrt"):
        chd.gaussianity([1.0, 2.0], transform="cube")
    with pytest.raises(InputError, match="test must be one of"):
        chd.gaussianity([1.0, 2.0], test="shapiro")
    with pytest.raises(InputError, match="render more spp"):
        gaussianity_of_means(np.ones(16))
    with pytest.raises(InputError, match="n_means must be at least 8"):
        gaussianity_of_means(np.ones(64), n_means=4)
