"""Negative samples are samples: what is linear keeps them, what needs logarithms counts them out.

Control variates, spectral conversion and ratio estimators are unbiased because of them. The image
here has 57 % nulls, and zero-mean noise of 5 % of its mean on every sample of `NOISY`, as a control
variate leaves: more than half of its samples then have a negative channel.
"""

import numpy as np
import pytest

import chdstat as chd
from chdstat import estimators
from chdstat.errors import Reason
from chdstat.estimators.held_out import Totals
from chdstat.summary.histograms import linear_support

SIZE, SPP, N = 12, 128, 32


def _image():
    rng = np.random.default_rng(5)
    shape = (SIZE, SIZE, 3, SPP)
    clean = rng.gamma(0.5, size=shape) * (rng.random((SIZE, SIZE, 1, SPP)) > 0.57)
    noise = rng.standard_normal(shape)
    # Exactly zero-mean in every batch of N samples: nothing is left to chance.
    noise = noise.reshape(*shape[:-1], -1, N)
    noise = (noise - noise.mean(axis=-1, keepdims=True)).reshape(shape)
    return clean, clean + 0.05 * clean.mean() * noise


CLEAN, NOISY = _image()
FIXED = [name for name in estimators.names("fixed") if not estimators.lookup(name).learns]
LOCATIONS = (
    *("mean", "median", "trimmed_mean", "winsorized_mean", "huber", "tukey", "catoni"),
    *("median_of_means", "bayesian_median_of_means", "lee_valiant", "jung2015"),
)
ODD = (*LOCATIONS, "gmon_binary", "gmon_adaptive")
ENERGY = dict.fromkeys(FIXED, 0.002) | {
    # What they estimate is no mean: noise on nulls moves a median or a mode.
    "median": 0.1,
    "huber": 0.2,
    "tukey": 0.05,
    "trimmed_mean": 0.03,
    "decoro2010": 0.02,
    "winsorized_mean": 0.01,
    "median_of_means": 0.02,
    "gmon_binary": 0.02,
    "gmon_adaptive": 0.02,
    "shared_patches": 0.01,
    "sakai2024": 0.01,
    "sakai2025": 0.01,
}


def test_the_noise_is_what_it_is_said_to_be():
    assert (NOISY < 0).any(axis=2).mean() > 0.5
    assert pytest.approx(CLEAN.mean()) == NOISY.mean()


def test_the_summary_keeps_them():
    found = chd.summarize(chd.Samples.from_array(NOISY))
    assert found["mean"].to_numpy() == pytest.approx(CLEAN.mean(axis=-1), rel=1e-5)
    assert found["variance"].to_numpy() == pytest.approx(NOISY.var(axis=-1, ddof=1), rel=1e-5)
    assert found["minimum"].to_numpy() == pytest.approx(NOISY.min(axis=-1), rel=1e-6)
    assert found["bad_count"].sum() == 0
    np.testing.assert_array_equal(found["negative_count"], (NOISY < 0).any(axis=2).sum(axis=-1))
    np.testing.assert_array_equal(found["log_negative"], (NOISY < 0).sum(axis=-1))


@pytest.mark.parametrize("name", FIXED)
def test_noise_moves_no_estimate_of_the_image(name):
    clean, noisy = (estimators.lookup(name)(x[..., :N]).mean() for x in (CLEAN, NOISY))
    assert noisy == pytest.approx(clean, rel=0, abs=ENERGY[name] * CLEAN.mean())


@pytest.mark.parametrize("name", ODD)
def test_minus_the_samples_is_minus_the_estimate(name):
    x = NOISY[0, :, :, :33]
    function = getattr(estimators, name)
    assert function(-x) == pytest.approx(-function(x), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", LOCATIONS)
def test_a_location_moves_with_its_samples(name):
    x = NOISY[0, :, :, :33]
    function = getattr(estimators, name)
    assert function(x - 7.0) == pytest.approx(function(x) - 7.0, rel=1e-7)


@pytest.mark.parametrize("name", FIXED)
def test_samples_that_cancel_are_estimated(name):
    x = np.tile(np.repeat([1.0, -1.0], 16), (3, 3, 3, 1))
    assert np.isfinite(estimators.lookup(name)(x)).all()


def test_a_negative_channel_spoils_nothing():
    x = np.ones((3, 3, 3, N))
    x[1, 1, 0, 0] = -1.0
    for name in ("mean", "zirr2018_pixel"):
        expected = [x[1, 1, 0].mean(), 1.0, 1.0]
        assert estimators.lookup(name)(x)[1, 1] == pytest.approx(expected, rel=0.05), name


def test_references_keep_them():
    samples = chd.Samples.from_array(NOISY)
    totals = Totals.of(samples)
    assert totals.mean() == pytest.approx(CLEAN.mean(axis=-1), rel=1e-5)
    batch = samples.read(ss=slice(0, N))
    expected = CLEAN[..., N:].mean(axis=-1)
    assert totals.mean_without(batch) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_a_black_reference_is_no_rounding():
    x = np.zeros((1, 1, 1, 8))
    x[..., :4] = 0.1, 0.2, 0.3, 0.7
    totals = Totals.of(chd.Samples.from_array(x))
    assert totals.mean_without(x[..., :4].astype(np.float32)).tolist() == [[[0.0]]]


def test_a_comparison_leaves_no_batch_out():
    found = chd.compare(chd.Samples.from_array(NOISY), ["mean", "median_of_means"], n=N)
    assert found.excluded == 0
    assert found.table()[0]["bias"] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_negative_pixels_say_why_nothing_fits():
    assert chd.fit.lognormal([-1.0, -2.0, 0.0]).reason == Reason.NONE_POSITIVE
    assert chd.modality([-1.0] * 64).reason == Reason.NONE_POSITIVE


def test_linear_bins_hold_them_and_log_bins_do_not():
    x = np.array([-1.0, -0.5, 0.0, 0.5, 1.0, 1.0])
    linear = chd.histogram(x, scale="linear", bins=4, support=(-1.0, 1.5))
    assert linear.counts.tolist() == [2, 0, 1, 2]
    assert (int(linear.underflow), int(linear.null_count), int(linear.negative)) == (0, 1, 2)
    log = chd.histogram(x)
    assert (int(log.underflow), int(log.counts.sum()), int(log.negative)) == (2, 3, 2)


def test_the_linear_support_spans_them():
    support = linear_support([[-3.0, 1.0], [-2.0, -2.0], [-1.0, 0.0]])
    assert support.low.tolist() == [-4.0, -2.5, -1.25]
    assert support.high.tolist() == [2.0, -1.5, -0.75]


def test_without_a_support_all_lie_above_it():
    x = np.concatenate([np.zeros(50), [-1.0, -2.0, 3.0]])
    found = chd.histogram(x, scale="linear")
    assert (int(found.overflow), int(found.underflow), int(found.null_count)) == (3, 0, 50)
