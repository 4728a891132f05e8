"""Resampling: p-values of divisions and of signs, intervals from blocks, and many p-values.

Seeds are fixed. For other seeds, each test that counts would fail with a probability below 1e-3:
its bound lies more than three standard errors of a binomial share from what is expected.
"""

from __future__ import annotations

import itertools
from math import comb

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

from chdstat._core.resampling import (
    Blocks,
    Shuffles,
    holm,
    interval_of,
    largest_of,
    mean_of,
    p_of_means,
    p_of_signs,
    q_values,
    quantile_of,
)

# --- divisions ------------------------------------------------------------------------------------


def counted(a, b):
    """Return twice the share of all divisions with a sum of the first group as far on its side."""
    pool = np.concatenate([a, b])
    pool = pool - pool.mean()
    sums = np.array([sum(c) for c in itertools.combinations(pool, len(a))])
    seen = pool[: len(a)].sum()
    as_far = sums * np.sign(seen) >= abs(seen) - 1e-9
    return min(1.0, 2 * as_far.mean())


def few(rng, size):
    """Return nulls and a few samples."""
    return rng.lognormal(0, 2, size) * (rng.random(size) < 0.2)


@pytest.mark.parametrize(("n", "m"), [(4, 12), (9, 5)])
def test_divisions_of_a_few_samples_are_counted(n, m):
    rng = np.random.default_rng(n)
    a, b = few(rng, (40, n)), few(rng, (40, m))
    p = p_of_means(a, b)
    known = np.isfinite(p) & (np.median(np.concatenate([a, b], axis=1), axis=1) == 0)
    assert known.mean() > 0.5
    expected = [counted(x, y) for x, y in zip(a[known], b[known], strict=True)]
    np.testing.assert_allclose(p[known], expected, rtol=1e-6)
    np.testing.assert_allclose(p_of_means(b, a)[known], p[known])


@pytest.mark.parametrize(("n", "m"), [(5, 14), (8, 10)])
def test_divisions_of_more_are_approximated(n, m):
    rng = np.random.default_rng(m)
    a, b = rng.gamma(1.0, size=(25, n)) + 0.5, rng.gamma(1.0, size=(25, m))
    expected = [counted(x, y) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(p_of_means(a, b), expected, rtol=0.2, atol=3 / comb(n + m, n))


def test_two_values_give_fishers_test():
    rng = np.random.default_rng(2)
    a, b = (rng.random((60, 40)) < 0.5), (rng.random((60, 90)) < 0.3)
    tables = [[[x.sum(), 40 - x.sum()], [y.sum(), 90 - y.sum()]] for x, y in zip(a, b, strict=True)]
    side = ["greater" if x.mean() > y.mean() else "less" for x, y in zip(a, b, strict=True)]
    exact = [stats.fisher_exact(t, s).pvalue for t, s in zip(tables, side, strict=True)]
    found = p_of_means(a.astype(float), b.astype(float))
    np.testing.assert_allclose(found, np.minimum(2 * np.array(exact), 1), rtol=0.2)


def test_p_values_do_not_depend_on_scale_place_or_what_does_not_count():
    rng = np.random.default_rng(3)
    a, b = rng.gamma(1.0, size=(20, 16)), rng.gamma(1.0, size=(20, 60))
    p = p_of_means(a, b)
    np.testing.assert_allclose(p_of_means(1e30 * a, 1e30 * b), p, rtol=1e-6)
    np.testing.assert_allclose(p_of_means(a - 7, b - 7), p, rtol=1e-6)
    good_a, good_b = rng.random(a.shape) < 0.8, rng.random(b.shape) < 0.8
    found = p_of_means(np.where(good_a, a, np.nan), b, good_a, good_b)
    alone = [
        p_of_means(x[k][np.newaxis], y[j][np.newaxis])[0]
        for x, y, k, j in zip(a, b, good_a, good_b, strict=True)
    ]
    np.testing.assert_allclose(found, alone, rtol=1e-6)
    assert np.isnan(p_of_means(np.ones((2, 5)), np.ones((2, 9)))).all()
    assert np.isnan(p_of_means(a, b, np.zeros_like(good_a), good_b)).all()


def fireflies(rng, size):
    return rng.gamma(1.0, size=size) + 1000 * (rng.random(size) < 0.01)


@pytest.mark.parametrize("law", [fireflies, few, lambda rng, size: rng.gamma(0.5, size=size)])
@pytest.mark.parametrize(("n", "m"), [(8, 200), (64, 200)])
def test_p_values_hold_their_level_at_unequal_sizes(law, n, m):
    """Where p-values are a tenth too small, as where few samples are lumps, .071 and .02 of 2000
    would happen in 1 of 1000 runs.
    """
    rng = np.random.default_rng(n)
    p = p_of_means(law(rng, (2000, n)), law(rng, (2000, m)))
    assert np.nanmean(p <= 0.05) <= 0.071
    assert np.nanmean(p <= 0.01) <= 0.02


def test_far_tails_are_those_of_the_normal_distribution():
    rng = np.random.default_rng(4)
    a, b = rng.normal(0.5, 1, (50, 300)), rng.normal(0, 1, (50, 900))
    pool = np.concatenate([a, b], axis=1)
    z = (a.mean(axis=1) - b.mean(axis=1)) / pool.std(axis=1, ddof=1) / np.sqrt(1 / 300 + 1 / 900)
    assert p_of_means(a, b).min() < 1e-12
    np.testing.assert_allclose(
        np.log(p_of_means(a, b)), np.log(2 * stats.norm.sf(np.abs(z))), rtol=0.06
    )


def test_variances_of_few_samples_beside_nulls_differ_as_rarely_as_they_should():
    rng = np.random.default_rng(5)
    lit = rng.exponential(size=(2, 20_000, 12)) * (rng.random((2, 20_000, 12)) < 0.2)
    p = Shuffles.draw((12, 12), 0, paired=False).p_of_variances(*lit)
    assert (p <= 1e-3).mean() <= 1.5e-3  # 2.2 standard deviations
    assert (p <= 1e-4).mean() <= 3e-4


@pytest.mark.parametrize(("paired", "least"), [(False, 2 / comb(8, 4)), (True, 2 / 2**4)])
def test_no_p_value_is_below_the_share_of_one_division(paired, least):
    a, b = np.random.default_rng(6).lognormal(size=(2, 500, 4))
    shuffles = Shuffles.draw((4, 4), 0, paired=paired)
    for test in (shuffles.p_of_variances, shuffles.p_of_distributions):
        assert test(a, b).min() >= least * (1 - 1e-9)


# --- signs ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("terms", [6, 11, 14])
def test_p_values_are_those_of_all_flips(terms):
    rng = np.random.default_rng(terms)
    d = rng.normal(0.3, 1, (40, terms))
    signs = np.array(list(itertools.product([-1, 1], repeat=terms)))
    sums = np.abs(np.abs(d) @ signs.T)
    exact = (sums >= np.abs(d.sum(axis=1))[:, np.newaxis] - 1e-12).mean(axis=1)
    found = p_of_signs(d)
    if terms <= 10:
        np.testing.assert_allclose(found, exact)
    else:  # the saddlepoint lies between the steps of what is discrete
        np.testing.assert_allclose(found, exact, rtol=0.25, atol=4 / 2**terms)


def test_many_terms_give_the_p_value_of_the_normal_distribution():
    d = np.random.default_rng(1).normal(0.02, 1, (200, 4096))
    z = d.sum(axis=1) / np.sqrt((d**2).sum(axis=1))
    np.testing.assert_allclose(p_of_signs(d), 2 * stats.norm.sf(np.abs(z)), rtol=0.1)


def test_zeros_have_no_sign_and_scale_is_none():
    d = np.random.default_rng(2).normal(0.5, 1, (30, 40))
    p = p_of_signs(d)
    padded = np.concatenate([d, np.zeros((30, 25))], axis=1)
    np.testing.assert_allclose(p_of_signs(padded), p, rtol=1e-6)
    for scale in (1e-30, -1e30):
        np.testing.assert_allclose(p_of_signs(scale * d), p, rtol=1e-6)
    # Of a term far above the others, half of all flips are as far out as the others' sum is.
    for firefly in (1e3, 1e12, 1e30):
        with_it = np.concatenate([d, np.full((len(d), 1), firefly)], axis=1)
        assert (p_of_signs(with_it) > 0.4 * p).all()
    assert p_of_signs(np.ones((1, 9)))[0] == 2**-8
    assert p_of_signs(np.ones((1, 300)))[0] == 2.0**-299
    assert np.isnan(p_of_signs(np.zeros((1, 9)))[0])


# --- intervals ------------------------------------------------------------------------------------


def field(rng, blocks):
    """Draw pixels whose neighbours share most of what they are."""
    shared = rng.normal(size=len(blocks))
    return shared[blocks.of_pixel] + 0.5 * rng.normal(size=len(blocks.of_pixel))


@pytest.mark.parametrize("statistic", [mean_of, quantile_of])
def test_intervals_cover_where_neighbours_resemble_each_other(statistic):
    rng, blocks = np.random.default_rng(0), Blocks.grid(12, 12)
    found = [statistic(field(rng, blocks), blocks) for _ in range(150)]
    assert np.mean([f.low <= 0 <= f.high for f in found]) > 0.9


@pytest.mark.parametrize("common", [False, True])
def test_intervals_cover_a_share_that_no_block_may_show(common):
    """A share of .02 of the blocks is in none of 16 in .72 of the draws."""
    rng, blocks = np.random.default_rng(0), Blocks.grid(4, 4)
    for _ in range(20):
        few = rng.random(16) < 0.02
        found = mean_of((few != common).astype(float), blocks)
        assert found.low <= (0.98 if common else 0.02) <= found.high


def test_pixels_taken_for_independent_would_not_cover():
    rng, blocks = np.random.default_rng(0), Blocks.grid(12, 12)
    alone = Blocks(np.arange(144), np.zeros(144, dtype=np.int64))
    found = [mean_of(field(rng, blocks), alone) for _ in range(50)]
    assert np.mean([f.low <= 0 <= f.high for f in found]) < 0.75


def test_regions_are_given_and_their_differences_are_no_noise():
    two = Blocks.join([Blocks.grid(8, 8), Blocks.grid(8, 8)])
    values = np.repeat([0.0, 100.0], 64) + np.random.default_rng(0).normal(size=128)
    found = mean_of(values, two)
    assert found.high - found.low < 1


def test_few_blocks_have_no_interval_and_missing_pixels_take_no_part():
    found = mean_of(np.arange(4.0), Blocks.grid(2, 2))
    assert found.value == 1.5
    assert np.isnan([found.low, found.high]).all()
    blocks, values = Blocks.grid(8, 8), np.random.default_rng(0).normal(size=(64, 3))
    values[::2] = np.nan
    assert mean_of(values, blocks).value == pytest.approx(np.nanmean(values))
    for statistic in (mean_of, quantile_of):
        assert np.isnan(statistic(values * np.nan, blocks).value)
    assert np.isnan(interval_of(lambda w: np.full(len(w), np.nan), blocks).low)


def test_more_sure_is_wider():
    blocks, values = Blocks.grid(8, 8), np.random.default_rng(0).normal(size=64)
    narrow, wide = (mean_of(values, blocks, level=level) for level in (0.8, 0.99))
    assert wide.low < narrow.low < narrow.high < wide.high


def test_blocks_of_some_pixels_keep_their_company():
    some = Blocks.grid(4, 4, across=2)[np.array([0, 1, 15])]
    assert some.of_pixel.tolist() == [0, 0, 1]
    assert len(some) == 2


@pytest.mark.parametrize("ways", [2, 4])
def test_the_least_of_equal_numbers_is_not_told_from_them(ways):
    """A verdict that is wrong in 2.5 % is so in more than 11 of 150 with a probability of 1e-3."""
    rng, blocks = np.random.default_rng(ways), Blocks.grid(24, 24, across=8)

    def lead(weights, sums):
        shares = weights @ sums / 576
        return shares[:, :1] - shares[:, 1:]

    below, naive = 0, 0
    for _ in range(150):
        sums = blocks.sums(np.eye(ways)[rng.choice(ways, size=576)])
        below += interval_of(lambda w, s=sums: lead(w, s), blocks).high < 0
        if ways == 4:
            naive += interval_of(lambda w, s=sums: lead(w, s).min(axis=1), blocks).high < 0
    assert below <= 11
    assert naive > 11 or ways < 4  # expected 21: the least of equal numbers is biased


def test_a_true_lead_is_seen():
    rng, blocks = np.random.default_rng(0), Blocks.grid(24, 24, across=8)
    values = np.array([0.0, 0.1, 0.1]) + 0.3 * rng.normal(size=(576, 3))
    sums = blocks.sums(values) / 576
    found = interval_of(lambda w: w @ sums, blocks)
    assert found.value == pytest.approx(0, abs=0.04)
    assert interval_of(lambda w: w @ sums + 0.1, blocks).low > 0
    assert interval_of(lambda w: w @ sums - 0.1, blocks).high < 0
    largest = largest_of(lambda w: -(w @ sums), blocks)
    assert (largest.low, largest.high) == (-found.high, -found.low)


# --- many p-values --------------------------------------------------------------------------------


def test_adjusted_p_values_are_those_of_statsmodels():
    p = np.random.default_rng(0).random(9) ** 3
    np.testing.assert_allclose(holm(p), multipletests(p, method="holm")[1])
    with_nan = holm(np.insert(p, 4, np.nan))
    assert np.isnan(with_nan[4])
    np.testing.assert_array_equal(np.delete(with_nan, 4), holm(p))


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
