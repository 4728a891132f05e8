"""Normality of samples: transforms, bad input, images and their false discoveries."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import InputError, Reason
from chdstat.inference import TESTS, TRANSFORMS

ALL = tuple(TESTS)


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


@pytest.mark.parametrize("test", ALL)
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


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_unusable_pixels_are_data():
    x = np.array([[0.0] * 30, [np.nan] * 30, [1.0] * 3 + [0.0] * 27, [5.0] * 30])
    result = chd.gaussianity(x)
    expected = [Reason.ALL_NULL, Reason.ALL_BAD, Reason.TOO_FEW, Reason.CONSTANT]
    np.testing.assert_array_equal(result.reason, expected)
    assert np.isnan([result.statistic, result.p_value, result.skewness]).all()


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


@pytest.mark.parametrize("transform", ["log", "linear"])
def test_image(transform):
    radiance = np.random.default_rng(13).lognormal(size=(6, 6, 3, 256))
    radiance[0, 0] = 0
    samples = chd.Samples.from_array(radiance)
    dataset = chd.gaussianity(samples, transform=transform, progress=False)
    assert np.isnan(dataset["q_value"][0, 0]).all()
    # Nothing was tested there: neither rejected nor not.
    assert np.isnan(dataset["rejected"][0, 0]).all()
    share = float(dataset["rejected"].mean())
    assert share < 0.05 if transform == "log" else share > 0.95
    for variable in dataset.data_vars.values():
        assert {"long_name", "units"} <= set(variable.attrs)


def test_image_of_everything():
    radiance = np.random.default_rng(16).lognormal(size=(4, 4, 3, 64))
    samples = chd.Samples.from_array(radiance)
    dataset = chd.gaussianity(samples, transform=tuple(TRANSFORMS), test=ALL, progress=False)
    assert dataset["p_value"].dims == ("y", "x", "channel", "transform", "test")
    assert dataset["skewness"].dims == ("y", "x", "channel", "transform")
    assert dataset["reason"].dims == ("y", "x", "channel", "test")
    one = chd.gaussianity(samples, transform="sqrt", test="shapiro-wilk", progress=False)
    same = dataset.sel(transform="sqrt", test="shapiro-wilk")
    for name in one.data_vars:
        np.testing.assert_array_equal(one[name], same[name])


def test_wrong_options_are_refused():
    with pytest.raises(InputError, match="transform must be one of log, linear, sqrt"):
        chd.gaussianity([1.0, 2.0], transform="cube")
    with pytest.raises(InputError, match="test must be one of"):
        chd.gaussianity([1.0, 2.0], test="shapiro")
    with pytest.raises(InputError, match="several different ones"):
        chd.gaussianity([1.0, 2.0], test=("dagostino", "dagostino"))
    with pytest.raises(InputError, match="several different ones"):
        chd.gaussianity([1.0, 2.0], transform=())
    with pytest.raises(InputError, match="alpha must lie between 0 and 1, got 5"):
        chd.gaussianity([1.0, 2.0], alpha=5)
