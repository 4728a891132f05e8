"""Error curves: what theory says of the sample mean, and what does not fall with N."""

import json

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import curve_sizes, error_curve
from chdstat.errors import InputError
from chdstat.estimators import MLP


def image(spp=160):
    rng = np.random.default_rng(0)
    brightness = rng.lognormal(0, 1, size=(16, 12, 1, 1)) * np.array([1, 0.8, 0.5])[:, None]
    return chd.Samples.from_array(brightness * rng.gamma(0.7, size=(16, 12, 3, spp)))


@pytest.fixture(scope="module")
def model():
    return MLP.preset("elek2019").train(image(), iterations=20)


@pytest.fixture(scope="module")
def curve():
    rng = np.random.default_rng(7)
    samples = chd.Samples.from_array(rng.exponential(size=(40, 40, 1, 256)))
    return error_curve(samples, ["mean", "median", "median_of_means"])


def test_default_sizes_hold_one_that_each_estimator_takes():
    names = ["mean", "median_of_means", "elek2019"]
    assert curve_sizes(image(spp=64), names) == (4, 8, 11, 32)
    assert curve_sizes(image(spp=1024), names) == (4, 8, 16, 32, 64, 128)
    with pytest.raises(InputError, match=r"32 samples.*\(4, 11"):
        curve_sizes(image(spp=48), names)


def test_sizes_double_up_to_an_eighth_of_the_samples(curve):
    assert curve.sizes == (4, 8, 16, 32)
    assert curve.batches.tolist() == [1600 * 16, 1600 * 16, 1600 * 16, 1600 * 8]


def test_the_error_of_the_mean_falls_as_theory_says(curve):
    """E = sigma^2 / N, without the noise of the reference: 4 sizes, within 5 standard errors, fails
    by 2e-6; with that noise, the largest N is off by 11 of these."""
    n = np.array(curve.sizes)
    mse = curve.measures["mse"][:, 0]
    assert (np.abs(mse.value - 1 / n) < 5 * mse.standard_error).all()


def test_the_bias_of_the_median_does_not_fall(curve):
    # The median of an exponential distribution is log 2.
    assert curve.measures["bias"].value[-1, 1] == pytest.approx(np.log(2) - 1, abs=0.02)
    ratio = curve.measures["mse_ratio"].value[:, 1]
    assert (np.diff(ratio) > 0).all()
    # median_of_means takes 11: where there are fewer, there is no number.
    assert np.isfinite(curve.measures["mse"].value[:, 2]).tolist() == [False, False, True, True]
    assert len(curve.table()) == 10


def test_a_point_of_the_curve_is_a_comparison():
    samples = image(spp=128)
    names = ["mean", "zirr2018", "trimmed_mean"]
    curve = error_curve(samples, names, sizes=[32, 8])
    assert curve.estimators == tuple(names)
    for row, n in enumerate((8, 32)):
        alone = chd.compare(samples, names, n=n)
        for measure, interval in alone.measures.items():
            whole = curve.measures[measure]
            assert whole.value[row] == pytest.approx(interval.value[:, -1], nan_ok=True)
            assert whole.low[row] == pytest.approx(interval.low[:, -1], nan_ok=True)


def test_what_learns_is_measured_at_its_own_size(model):
    curve = error_curve(image(), ["mean", "elek2019"], sizes=[16, 32], model=model)
    assert np.isfinite(curve.measures["relmse"].value).tolist() == [[True, False], [True, True]]
    assert curve.test_pixels == 96
    assert curve.batches.tolist() == [96 * 10, 96 * 5]


def test_the_curve_is_ready_for_json(curve):
    content = json.loads(json.dumps(curve.to_dict(), allow_nan=False))
    assert content["table"][0]["n"] == 4
