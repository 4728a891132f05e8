"""Modes: the dip of known samples, a calibrated test, a mixture that agrees with scikit-learn."""

import numpy as np
import pytest
from scipy import stats
from sklearn.mixture import GaussianMixture

import chdstat as chd
from chdstat._bimodal import BINS, fit_two, log_histogram
from chdstat._reasons import Reason


def two_lights(rng, shape, share=0.3):
    indirect = rng.lognormal(-4, 0.8, size=shape)
    return np.where(rng.random(shape) < share, indirect, rng.lognormal(0, 0.5, size=shape))


def test_dip_of_two_equal_spikes_is_a_quarter():
    # Hartigan and Hartigan 1985: the dip of (1, 1, 2, 2), and its limit for any number of each.
    result = chd.modality(np.repeat([1.0, 2.0], 20))
    assert float(result.dip) == pytest.approx(0.25, abs=1e-5)
    assert float(result.tied_share) == 1
    assert int(result.modes) == 2


def test_dip_of_evenly_spaced_samples_is_the_least():
    result = chd.modality(np.logspace(-2, 2, 50))
    assert float(result.dip) == pytest.approx(1 / 100)
    assert float(result.dip_p_value) > 0.99


@pytest.mark.parametrize("spp", [64, 512])
def test_level_where_it_is_hardest(spp):
    # Log-uniform samples are the null distribution of the table: nominal 5 %, 4 sigma = 2 %.
    x = 10 ** np.random.default_rng(1).random((2000, spp))
    assert (chd.modality(x).dip_p_value < 0.05).mean() == pytest.approx(0.05, abs=0.02)


@pytest.mark.parametrize("draw", ["gamma", "lognormal", "pareto"])
def test_one_mode_is_not_flagged(draw):
    rng = np.random.default_rng(2)
    x = {
        "gamma": rng.gamma(0.3, size=(500, 512)),
        "lognormal": rng.lognormal(0, 2, size=(500, 512)),
        "pareto": rng.pareto(1.0, size=(500, 512)),
    }[draw]
    result = chd.modality(x)
    assert (result.dip_p_value < 0.05).mean() < 0.01
    assert (result.modes == 1).mean() > 0.99


def test_two_modes_are_found():
    result = chd.modality(two_lights(np.random.default_rng(3), (300, 512)))
    assert (result.dip_p_value < 1e-3).mean() > 0.99
    assert (result.modes == 2).mean() > 0.99
    assert (result.ashman_d > 2).all()
    assert (result.delta_bic > 10).all()


def test_mixture_recovers_what_was_drawn():
    result = chd.modality(two_lights(np.random.default_rng(4), (200, 2048)))
    decades = 1 / np.log(10)
    np.testing.assert_allclose(result.weights.mean(axis=0), [0.3, 0.7], atol=0.01)
    np.testing.assert_allclose(result.means.mean(axis=0), [-4 * decades, 0], atol=0.02)
    np.testing.assert_allclose(
        result.deviations.mean(axis=0), [0.8, 0.5] * np.array(decades), atol=0.01
    )
    np.testing.assert_allclose(result.weights.sum(axis=-1), 1)


def test_binned_mixture_agrees_with_one_of_samples():
    x = two_lights(np.random.default_rng(5), 1000)
    mixture = GaussianMixture(2, random_state=0, tol=1e-6).fit(np.log10(x)[:, np.newaxis])
    order = np.argsort(mixture.means_[:, 0])
    result = chd.modality(x)
    np.testing.assert_allclose(result.means, mixture.means_[order, 0], atol=0.02)
    np.testing.assert_allclose(result.weights, mixture.weights_[order], atol=0.01)
    deviations = np.sqrt(mixture.covariances_[order, 0, 0])
    np.testing.assert_allclose(result.deviations, deviations, atol=0.02)
    data = np.log10(x)[:, np.newaxis]
    one = GaussianMixture(1).fit(data)
    assert float(result.delta_bic) == pytest.approx(one.bic(data) - mixture.bic(data), rel=0.03)


def test_em_never_ends_below_its_start_or_one_component():
    rng = np.random.default_rng(6)
    rows = np.sort(rng.gamma(0.5, size=(50, 400)), axis=-1)
    counts, _, _ = log_histogram(rows, np.full(50, 400))
    two = fit_two(counts)
    assert (two.log_likelihood >= two.log_likelihood_of_one).all()


def test_histogram_counts_every_sample_once():
    rows = np.sort(np.random.default_rng(7).lognormal(size=(3, 50)), axis=-1)
    rows[1, 30:] = np.inf
    counts, low, width = log_histogram(rows, np.array([50, 30, 50]))
    np.testing.assert_array_equal(counts.sum(axis=-1), [50, 30, 50])
    expected, _ = np.histogram(np.log10(rows[1, :30]), bins=BINS)
    np.testing.assert_array_equal(counts[1], expected)
    assert low[1] + BINS * width[1] == pytest.approx(np.log10(rows[1, 29]))


def test_radiance_scales_the_means_only():
    x = two_lights(np.random.default_rng(8), (4, 300))
    one, thousand = chd.modality(x), chd.modality(1000 * x)
    np.testing.assert_allclose(thousand.dip, one.dip, rtol=1e-9)
    np.testing.assert_allclose(thousand.means, one.means + 3, atol=1e-6)
    np.testing.assert_allclose(thousand.ashman_d, one.ashman_d, rtol=1e-6)


def test_a_spike_of_ties_beside_a_lobe_is_a_second_mode():
    rng = np.random.default_rng(9)
    x = np.where(rng.random((50, 400)) < 0.3, 1.0, rng.lognormal(-3, 0.5, size=(50, 400)))
    result = chd.modality(x.astype(np.float32))
    np.testing.assert_allclose(result.tied_share, (x == 1).mean(axis=-1), atol=0.02)
    assert (result.modes == 2).all()
    assert (result.dip_p_value < 1e-3).all()
    again = chd.modality(x.astype(np.float32))
    np.testing.assert_array_equal(again.dip, result.dip)


def test_nulls_and_bad_samples_take_no_part():
    rng = np.random.default_rng(10)
    x = two_lights(rng, 200)
    mixed = np.concatenate([x, np.zeros(77), [np.nan, np.inf, -1.0]])
    alone = chd.modality(x)
    both = chd.modality(np.stack([rng.permutation(mixed), rng.lognormal(size=280)]))
    assert both.n[0] == 200
    assert both.dip[0] == pytest.approx(float(alone.dip))
    assert both.ashman_d[0] == pytest.approx(float(alone.ashman_d))


def test_unusable_pixels_are_data():
    few = np.where(np.arange(40) < 10, np.linspace(1, 2, 40), 0)
    result = chd.modality(np.stack([np.zeros(40), np.full(40, np.nan), few, np.ones(40)]))
    expected = [Reason.ALL_NULL, Reason.ALL_BAD, Reason.TOO_FEW, Reason.CONSTANT]
    np.testing.assert_array_equal(result.reason, expected)
    np.testing.assert_array_equal(result.modes, 0)
    for values in (result.dip, result.dip_p_value, result.means, result.ashman_d):
        assert np.isnan(values).all()


def test_image():
    rng = np.random.default_rng(11)
    radiance = rng.lognormal(size=(4, 4, 3, 256))
    radiance[:2] = two_lights(rng, (2, 4, 3, 256))
    dataset = chd.modality(chd.Samples.from_array(radiance), progress=False)
    assert dataset["means"].dims == ("y", "x", "channel", "component")
    assert (dataset["dip_q_value"][:2] < 0.05).all()
    assert (dataset["dip_q_value"][2:] > 0.05).all()
    for variable in dataset.data_vars.values():
        assert {"long_name", "units"} <= set(variable.attrs)
    assert stats.false_discovery_control(dataset["dip_p_value"][:, :, 0].to_numpy().ravel())[
        0
    ] == pytest.approx(float(dataset["dip_q_value"][0, 0, 0]))
