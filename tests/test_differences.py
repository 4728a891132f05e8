"""Differences between two CHDs: SciPy's distances, and p-values that chance alone sets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from chdstat.differences import difference
from chdstat.errors import InputError


def gamma(spp=512, seed=1, null=0.3):
    rng = np.random.default_rng(seed)
    x = rng.gamma(2.0, size=(3, spp)).astype(np.float32)
    x[:, rng.random(spp) < null] = 0
    return x


def test_distances_are_those_of_scipy():
    a, b = gamma(300, seed=1), 1.2 * gamma(500, seed=2)
    found = difference(a, b)
    for i in range(3):
        assert found.distance[i] == pytest.approx(stats.ks_2samp(a[i], b[i]).statistic, abs=1e-9)
        assert found.wasserstein[i] == pytest.approx(stats.wasserstein_distance(a[i], b[i]))
        welch = stats.ttest_ind(b[i].astype(float), a[i].astype(float), equal_var=False)
        assert found.mean_t[i] == pytest.approx(welch.statistic)
        assert found.mean_p_value[i] == pytest.approx(welch.pvalue)
    small, large = difference(a[:, :5], b[:, :7]), difference(a[:, :5] * 1e30, b[:, :7] * 1e30)
    welch = stats.ttest_ind(b[:, :7].astype(float), a[:, :5].astype(float), axis=1, equal_var=False)
    np.testing.assert_allclose(small.mean_p_value, welch.pvalue)
    np.testing.assert_allclose(large.mean_p_value, welch.pvalue, rtol=1e-5)


def test_means_without_scatter_have_no_significance():
    # The mean of as many 0.1 is not 0.1, but for which no two are different.
    one, two = np.full((3, 7), 0.1), np.full((3, 10), 0.3)
    found = difference(one, two)
    np.testing.assert_allclose(found.mean_difference, 0.2)
    assert np.isnan([found.mean_t, found.mean_p_value]).all()
    assert np.isnan(difference(0 * one, 0 * one).mean_p_value).all()


def test_the_distance_of_equal_distributions_is_significant_by_chance_only():
    """Of 100 pairs, half of them nulls: more than 14 below 5 % happens in 1 of 8000 runs."""
    rng = np.random.default_rng(3)
    p = []
    for seed in range(100):
        a, b = (rng.gamma(2.0, size=(3, 80)) * (rng.random(80) < 0.5) for _ in range(2))
        p.append(difference(a, b, replicates=39, seed=seed).p_value)
    assert np.mean(np.array(p) <= 0.05) <= 0.14
    assert 0.3 < np.mean(p) < 0.7


def test_another_share_of_nulls_is_another_distribution():
    assert difference(gamma(600, null=0.2), gamma(600, seed=2, null=0.5)).p_value == 0.005


def test_channels_must_agree():
    with pytest.raises(InputError, match="as many channels"):
        difference(gamma(), gamma()[:1])


def test_without_good_samples_there_is_nothing_to_say():
    bad = np.full((3, 8), np.nan)
    found = difference(gamma(), bad)
    assert found.n == (512, 0)
    assert np.isnan([found.p_value, *found.distance, *found.wasserstein, *found.mean_t]).all()


def test_radiance_of_any_size_is_compared():
    for factor in (1e30, 1e-40):
        found = difference(gamma() * factor, 2 * gamma(seed=2) * factor)
        assert found.p_value == 0.005
        assert np.isfinite(found.mean_p_value).all()


def test_a_shuffle_is_needed():
    with pytest.raises(InputError, match="replicates must be at least 1, got 0"):
        difference(gamma(), gamma(), replicates=0)
