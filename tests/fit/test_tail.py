"""Tail index: right on generalised Pareto samples, quiet on gamma ones, loud on power laws."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat._reasons import Reason
from chdstat.errors import InputError

ROWS, SPP = 1500, 1024


@pytest.mark.parametrize("xi", [-0.2, 0.0, 0.25, 0.5, 1.0])
def test_index_of_generalised_pareto_samples(xi):
    # Bias below 0.03 (measured); the mean over the rows has a deviation below 0.006. The asymptotic
    # error is up to 16 % too small for bounded tails.
    x = stats.genpareto.rvs(xi, scale=3.0, size=(ROWS, SPP), random_state=31)
    tail = chd.fit.tail_index(x)
    assert tail.xi.mean() == pytest.approx(xi, abs=0.05)
    assert tail.standard_error.mean() / tail.xi.std() == pytest.approx(1, abs=0.2)
    np.testing.assert_array_equal(tail.n, SPP // 10)
    np.testing.assert_array_equal(tail.variance_suspect, tail.xi >= 0.5)


def test_level_at_the_tested_index():
    # Nominal 5 %, measured 4.6 to 5.6 %; 4 sigma of 1500 rows is 2.3 %.
    x = stats.genpareto.rvs(0.25, size=(ROWS, SPP), random_state=32)
    assert (chd.fit.tail_index(x).p_value < 0.05).mean() < 0.08


@pytest.mark.parametrize("shape", [0.5, 1.0, 5.0])
def test_gamma_tails_are_not_flagged(shape):
    x = np.random.default_rng(33).gamma(shape, size=(ROWS, SPP))
    assert (chd.fit.tail_index(x).p_value < 0.05).mean() < 0.005


@pytest.mark.parametrize(("sigma", "low", "high"), [(0.5, 0.0, 0.01), (2.0, 0.8, 1.0)])
def test_lognormal_tails_depend_on_sigma(sigma, low, high):
    x = np.random.default_rng(34).lognormal(0, sigma, size=(ROWS, SPP))
    assert low <= (chd.fit.tail_index(x).p_value < 0.05).mean() <= high


def test_power_laws_are_flagged():
    x = np.random.default_rng(35).pareto(1.0, size=(ROWS, SPP))
    tail = chd.fit.tail_index(x)
    assert (tail.p_value < 0.05).mean() > 0.98
    assert tail.variance_suspect.mean() > 0.95


def test_hill_by_its_formula():
    x = np.random.default_rng(36).pareto(1.5, size=500) + 1
    tail = chd.fit.tail_index(x, share=0.2)
    top = np.sort(x)[::-1]
    assert float(tail.hill) == pytest.approx(np.log(top[:100] / top[100]).mean())
    assert float(tail.threshold) == top[100]


def test_radiance_scales_the_tail():
    x = np.random.default_rng(37).pareto(1.5, size=(4, 600))
    one, thousand = chd.fit.tail_index(x), chd.fit.tail_index(1000 * x)
    np.testing.assert_allclose(thousand.xi, one.xi, rtol=1e-9)
    np.testing.assert_allclose(thousand.scale, 1000 * one.scale, rtol=1e-9)


def test_nulls_and_bad_samples_take_no_part():
    rng = np.random.default_rng(38)
    x = rng.pareto(1.5, size=600)
    mixed = rng.permutation(np.concatenate([x, np.zeros(300), [np.nan, np.inf, -1.0]]))
    padded = np.stack([mixed, np.resize(x, mixed.size)])
    alone, both = chd.fit.tail_index(x), chd.fit.tail_index(padded)
    assert both.xi[0] == pytest.approx(float(alone.xi), abs=0.02)
    assert both.n[0] == alone.n == 60


def test_unusable_pixels_are_data():
    rng = np.random.default_rng(39)
    few = np.where(np.arange(400) < 150, rng.exponential(size=400), 0)
    tied = np.where(np.arange(400) < 300, rng.random(400), 7.0)
    tail = chd.fit.tail_index(np.stack([np.zeros(400), few, np.ones(400), tied]))
    expected = [Reason.ALL_NULL, Reason.TOO_FEW, Reason.CONSTANT, Reason.CONSTANT]
    np.testing.assert_array_equal(tail.reason, expected)
    for values in (tail.xi, tail.p_value, tail.standard_error):
        assert np.isnan(values).all()
    assert not tail.variance_suspect.any()


def test_image():
    radiance = np.random.default_rng(40).pareto(1.5, size=(2, 3, 3, 300))
    dataset = chd.fit.tail_index(chd.Samples.from_array(radiance), progress=False)
    assert dataset["tail_index"].dims == ("y", "x", "channel")
    alone = chd.fit.tail_index(radiance[1, 2].astype(np.float32))
    np.testing.assert_allclose(dataset["tail_index"][1, 2], alone.xi)


def test_wrong_options_are_refused():
    with pytest.raises(InputError, match="share"):
        chd.fit.tail_index(np.ones(300), share=1.5)
