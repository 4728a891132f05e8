"""Permutations: p-values of divisions into two groups, and of flips of signs.

Seeds are fixed. For other seeds, each test that counts would fail with a probability below 1e-3:
its bound lies more than three standard errors of a binomial share from what is expected.
"""

from __future__ import annotations

import itertools
from math import comb

import numpy as np
import pytest
from scipy import stats

from chdstat.inference.permutations import Shuffles, p_of_means, p_of_signs

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


def test_p_values_depend_on_no_scale_or_place():
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


def test_variances_beside_nulls_hold_their_level():
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


def test_many_terms_have_normal_p_values():
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
