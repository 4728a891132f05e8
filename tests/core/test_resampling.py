"""Resampling: intervals from blocks, and many p-values.

Seeds are fixed. For other seeds, each test that counts would fail with a probability below 1e-3:
its bound lies more than three standard errors of a binomial share from what is expected.
"""

from __future__ import annotations

import numpy as np
import pytest

from chdstat._core.resampling import (
    Blocks,
    interval_of,
    largest_of,
    mean_of,
    q_values,
    quantile_of,
)

# --- intervals ------------------------------------------------------------------------------------


def field(rng, blocks):
    """Draw pixels whose neighbours share most of what they are."""
    shared = rng.normal(size=len(blocks))
    return shared[blocks.of_pixel] + 0.5 * rng.normal(size=len(blocks.of_pixel))


@pytest.mark.parametrize("statistic", [mean_of, quantile_of])
def test_intervals_cover_where_neighbours_are_alike(statistic):
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


def test_regions_are_no_noise():
    two = Blocks.join([Blocks.grid(8, 8), Blocks.grid(8, 8)])
    values = np.repeat([0.0, 100.0], 64) + np.random.default_rng(0).normal(size=128)
    found = mean_of(values, two)
    assert found.high - found.low < 1


def test_few_blocks_have_no_interval():
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
def test_the_least_of_equals_is_not_told(ways):
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
    assert (naive > 11) == (ways == 4)  # expected 21: the least of equal numbers is biased


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
