"""Differences between two CHDs: SciPy's distances, and p-values that chance alone sets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.inference.differences import difference


def gamma(spp=512, seed=1, null=0.3):
    rng = np.random.default_rng(seed)
    x = rng.gamma(2.0, size=(3, spp)).astype(np.float32)
    x[:, rng.random(spp) < null] = 0
    return x


def test_distances_are_those_of_scipy():
    a, b = gamma(300, seed=1).astype(float), 1.2 * gamma(500, seed=2).astype(float)
    found = difference(a, b)
    for i in range(3):
        assert found.distance[i] == pytest.approx(stats.ks_2samp(a[i], b[i]).statistic, abs=1e-9)
        assert found.wasserstein[i] == pytest.approx(stats.wasserstein_distance(a[i], b[i]))
        welch = stats.ttest_ind(b[i], a[i], equal_var=False)
        assert found.mean_t[i] == pytest.approx(welch.statistic)
        assert welch.pvalue * 0.999 <= found.mean_p_value[i] <= 2 * welch.pvalue
    small, large = difference(a[:, :5], b[:, :7]), difference(a[:, :5] * 1e30, b[:, :7] * 1e30)
    welch = stats.ttest_ind(b[:, :7], a[:, :5], axis=1, equal_var=False)
    assert (small.mean_p_value >= welch.pvalue * 0.999).all()
    np.testing.assert_allclose(large.mean_p_value, small.mean_p_value, rtol=1e-5)


def many_nulls(rng, size):
    return rng.lognormal(size=size) * (rng.random(size) < 0.05)


@pytest.mark.parametrize(("n", "m"), [(64, 200), (200, 64), (16, 512)])
def test_p_values_of_means_hold_their_level(n, m):
    """Of 2000, more than 6.6 % would happen in 1 of 1000 runs; Welch's test has 8 to 50 %."""
    rng = np.random.default_rng(n)
    a, b = many_nulls(rng, (2000, 1, n)), many_nulls(rng, (2000, 1, m))
    found = difference(a, b, replicates=1)
    assert (found.mean_p_value <= 0.05).mean() <= 0.066
    tested = np.isfinite(found.mean_p_value[:, 0])
    welch = stats.ttest_ind(b[tested, 0], a[tested, 0], axis=-1, equal_var=False)
    assert (welch.pvalue <= 0.05).mean() > 0.075


def test_means_without_scatter_have_no_significance():
    # The mean of as many 0.1 is not 0.1, but for which no two are different.
    one, two = np.full((3, 7), 0.1), np.full((3, 10), 0.3)
    found = difference(one, two)
    np.testing.assert_allclose(found.mean_difference, 0.2)
    assert np.isnan([found.mean_t, found.mean_p_value]).all()
    assert np.isnan(difference(0 * one, 0 * one).mean_p_value).all()


def test_equal_distributions_differ_by_chance_only():
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


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
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


# --- renders that share random numbers ----------------------------------------------------------


def renders(rng, shape=(24, 24), channels=1, spp=128, correlation=0.9, null=0.3):
    """Return log-normal samples of two images with nulls, of which those of a pixel are pairs."""
    size = (*shape, channels, spp)
    shared, *both = rng.normal(size=(3, *size))
    found = [
        np.exp(0.5 * (np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * own))
        for own in both
    ]
    dark = rng.random((*shape, 1, spp)) < null
    return [np.where(dark, 0, x).astype(np.float32) for x in found]


def stores(arrays, *seeds, **attrs):
    return [chd.Samples.from_array(x, seed=s, **attrs) for x, s in zip(arrays, seeds, strict=True)]


def distance_to_uniform(p, **options):
    return float(stats.kstest(np.ravel(p), "uniform", **options).statistic)


def test_pairs_are_compared_by_students_test():
    a, b = (x[3, 4] for x in renders(np.random.default_rng(0), channels=3, spp=200))
    found = difference(a, b, paired=True)
    exact = stats.ttest_rel(b.astype(float), a.astype(float), axis=1)
    np.testing.assert_allclose(found.mean_t, exact.statistic)
    np.testing.assert_allclose(found.mean_p_value, exact.pvalue)
    assert found.paired
    assert not difference(a, b).paired  # arrays do not say their seeds
    for name in ("distance", "wasserstein", "mean_difference"):
        np.testing.assert_allclose(getattr(found, name), getattr(difference(a, b), name))


def test_pairs_change_sides_in_every_way():
    """Of four pairs, eight ways of sixteen are as far apart as all on one side."""
    a = np.array([[1.0, 2, 3, 4]])
    found = difference(a, a + 10, paired=True, replicates=4000)
    assert found.p_value == pytest.approx(2 / 16, abs=0.02)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.95])
def test_equal_seeds_are_told_and_p_values_are_uniform(correlation):
    """Of 576 pixels: a KS distance above .068 has a probability of 1 %.

    Those of distances are in steps, the coarser the more pairs are equal: none may be too small.
    """
    a, b = renders(np.random.default_rng(8), correlation=correlation)
    found = difference(*stores((a, b), 0, 0))
    assert found.paired
    assert distance_to_uniform(found.mean_p_value) < 0.068
    assert distance_to_uniform(found.p_value, alternative="greater") < 0.068


def test_other_seeds_are_independent():
    rng = np.random.default_rng(9)
    (a, _), (b, _) = renders(rng), renders(rng)
    found = difference(*stores((a, b), 0, 7))
    assert not found.paired
    assert distance_to_uniform(found.mean_p_value) < 0.068
    assert distance_to_uniform(found.p_value, alternative="greater") < 0.068


def test_pairs_find_smaller_differences():
    """The control: taken for independent, the same samples are never told apart."""
    a, b = renders(np.random.default_rng(8), correlation=0.95)
    alone = difference(*stores((a, b), 0, 0), paired=False, replicates=99)
    assert distance_to_uniform(alone.mean_p_value) > 0.2
    assert (alone.p_value < 0.05).mean() < 0.01
    one, two = stores((a, 1.03 * b), 0, 0)
    powers = [
        (difference(one, two, paired=p, replicates=1).mean_p_value < 0.05).mean()
        for p in (None, False)
    ]
    assert powers[0] > 3 * powers[1]


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("paired", [False, True])
def test_an_image_is_compared_as_its_pixels_are(paired):
    """Also where some samples are bad, and whatever the other pixels are."""
    a, b = renders(np.random.default_rng(1), shape=(3, 5), channels=3, spp=40)
    a[1, 2, 0, 7], b[0, 3, 2, :4], a[2, 2] = np.nan, np.inf, np.nan
    found = difference(*stores((a, b), 0, 0), paired=paired, replicates=50)
    assert found.distance.shape == found.mean_p_value.shape == (3, 5, 3)
    assert found.p_value.shape == found.n[0].shape == (3, 5)
    assert np.isnan(found.p_value[2, 2])
    for y, x in np.ndindex(3, 5):
        alone = difference(a[y, x], b[y, x], paired=paired, replicates=50)
        for name in ("distance", "wasserstein", "p_value", "mean_t", "mean_p_value"):
            np.testing.assert_allclose(getattr(found, name)[y, x], getattr(alone, name), 1e-9)
        assert (found.n[0][y, x], found.n[1][y, x]) == alone.n


def test_of_unequal_numbers_the_common_ones_are_pairs():
    a, b = renders(np.random.default_rng(1), shape=(2, 3), spp=64)
    found = difference(*stores((a[..., :48], b), 0, 0))
    assert (found.n[0] == 48).all()
    np.testing.assert_allclose(
        found.mean_t, difference(*stores((a[..., :48], b[..., :48]), 0, 0)).mean_t
    )


def test_a_render_compared_with_itself_is_not_different():
    a, _ = renders(np.random.default_rng(1), shape=(2, 3))
    found = difference(*stores((a, a), 0, 0))
    assert (found.distance == 0).all()
    assert (found.p_value == 1).all()
    assert np.isnan(found.mean_p_value).all()  # without scatter there is nothing to test


def test_shared_numbers_are_known_by_seed_and_size():
    x = np.ones((4, 4, 8))
    one = chd.Samples.from_array(x, seed=3, backend="llvm")
    for shares, other in (
        (True, chd.Samples.from_array(x, seed=3, backend="cuda", scene="other")),
        (True, chd.Samples.from_array(x[..., :5], seed=3, backend="llvm")),
        (False, chd.Samples.from_array(x, seed=4, backend="llvm")),
        (False, chd.Samples.from_array(x, seed=3, backend="scalar")),
        (False, chd.Samples.from_array(x[:2], seed=3, backend="llvm")),
        (False, chd.Samples.from_array(x, backend="llvm")),
        (False, chd.Samples.from_array(x, seed=3, backend="llvm", streams=1)),
    ):
        assert one.shares_numbers_with(other) == other.shares_numbers_with(one) == shares
