"""Statistics behind the findings: intervals that cover, distances without noise, fair p-values.

Seeds are fixed. For other seeds, each test that counts would fail with a probability below 1e-3:
its bound lies more than three standard errors of a binomial share from what is expected.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

import chdstat as chd
from chdstat._core.resampling import (
    Blocks,
    Interval,
    holm,
    interval_of,
    largest_of,
    mean_of,
    median_of,
    q_values,
)
from chdstat.studies.claims import FINDINGS, ClaimTest, SceneData
from chdstat.studies.claims.assumptions import explained_by_features, growing, uniformity, with_room
from chdstat.studies.claims.learning import early_gain
from chdstat.studies.claims.modes import rank_correlation, scene_complexity
from chdstat.studies.claims.scene_shapes import permuted, squares, squares_of_pairs
from chdstat.studies.claims.surfaces import log_skewness, shape_spread
from chdstat.studies.log_chds import EDGES, aligned, of_histograms, squared_distance
from chdstat.studies.outcomes import Outcome, PlotData, level_of
from chdstat.studies.scene_data import correlation_of, slope_of

# --- intervals ----------------------------------------------------------------------------------


def field(rng, blocks):
    """Draw pixels whose neighbours share most of what they are."""
    shared = rng.normal(size=len(blocks))
    return shared[blocks.of_pixel] + 0.5 * rng.normal(size=len(blocks.of_pixel))


@pytest.mark.parametrize("statistic", [mean_of, median_of])
def test_intervals_cover_where_neighbours_resemble_each_other(statistic):
    rng, blocks = np.random.default_rng(0), Blocks.grid(12, 12)
    found = [statistic(field(rng, blocks), blocks) for _ in range(150)]
    assert np.mean([f.low <= 0 <= f.high for f in found]) > 0.9


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


def test_few_blocks_have_no_interval():
    found = mean_of(np.arange(4.0), Blocks.grid(2, 2))
    assert found.value == 1.5
    assert np.isnan([found.low, found.high]).all()


def test_missing_pixels_take_no_part():
    blocks, values = Blocks.grid(8, 8), np.random.default_rng(0).normal(size=(64, 3))
    values[::2] = np.nan
    assert mean_of(values, blocks).value == pytest.approx(np.nanmean(values))
    assert np.isnan(mean_of(values * np.nan, blocks).value)
    assert np.isnan(median_of(values * np.nan, blocks).value)


def test_more_sure_is_wider():
    blocks, values = Blocks.grid(8, 8), np.random.default_rng(0).normal(size=64)
    narrow, wide = (mean_of(values, blocks, level=level) for level in (0.8, 0.99))
    assert wide.low < narrow.low < narrow.high < wide.high


def test_blocks_of_some_pixels_keep_their_company():
    blocks = Blocks.grid(4, 4, across=2)
    some = blocks[np.array([0, 1, 15])]
    assert some.of_pixel.tolist() == [0, 0, 1]
    assert len(some) == 2


def test_a_statistic_without_a_number_has_no_interval():
    found = interval_of(lambda w: np.full(len(w), np.nan), Blocks.grid(8, 8))
    assert np.isnan(found.low)


TIES = {2: (0.5, 0.5), 4: (0.25, 0.25, 0.25, 0.25)}


@pytest.mark.parametrize("ways", TIES)
def test_the_least_of_equal_numbers_is_not_told_from_them(ways):
    """A verdict that is wrong in 2.5 % is so in more than 11 of 150 with a probability of 1e-3."""
    rng, blocks, worlds = np.random.default_rng(ways), Blocks.grid(24, 24, across=8), 150

    def lead(weights, sums):
        shares = weights @ sums / 576
        return shares[:, :1] - shares[:, 1:]

    below, naive = 0, 0
    for _ in range(worlds):
        best = np.eye(ways)[rng.choice(ways, p=TIES[ways], size=576)]
        sums = blocks.sums(best)
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


# --- log CHDs -----------------------------------------------------------------------------------


def test_equal_chds_have_no_distance_on_average():
    x = np.random.default_rng(0).lognormal(size=(800, 128))
    chds = aligned(x)
    square = squared_distance(chds[::2], chds[1::2])
    naive = ((chds.whole[::2] - chds.whole[1::2]) ** 2).sum(axis=-1) * 0.05
    assert abs(square.mean()) < 4 * square.std() / np.sqrt(len(square))
    assert naive.mean() > 20 * abs(square.mean())


def test_the_distance_of_log_normals_is_the_integral():
    rng = np.random.default_rng(0)
    x, y = (rng.lognormal(0, sigma, size=(200, 1024)) for sigma in (0.5, 1.0))
    grid = np.linspace(-4, 4, 4001)
    apart = [stats.norm.cdf(grid * np.log(10) / sigma) for sigma in (0.5, 1.0)]
    exact = ((apart[0] - apart[1]) ** 2).sum() * (grid[1] - grid[0])
    assert squared_distance(aligned(x), aligned(y)).mean() == pytest.approx(exact, rel=0.03)


def test_shapes_do_not_know_of_scale_nulls_and_what_is_out_of_sight():
    x = np.random.default_rng(0).lognormal(size=(1, 512))
    out = np.concatenate([x, np.full((1, 2), 1e-17), np.zeros((1, 60))], axis=1)
    np.testing.assert_allclose(aligned(x).halves, aligned(1e20 * x).halves)
    np.testing.assert_allclose(aligned(x).whole, aligned(out).whole, atol=1e-12)
    assert log_skewness(out) == pytest.approx(log_skewness(x))


def test_constants_and_few_samples_have_no_shape():
    assert np.isnan(log_skewness(np.full(100, 0.1)))
    assert not aligned(np.ones((1, 20))).known.any()


def test_log_skewness_is_that_of_scipy():
    x = np.random.default_rng(0).gamma(2, size=400)
    assert log_skewness(x) == pytest.approx(stats.skew(np.log(x)))


def test_histograms_count_nulls_below_every_edge():
    x = np.where(np.arange(400) % 4, 1.0, 0.0) * np.ones((2, 2, 3, 1))
    chds = of_histograms(chd.summarize(chd.Samples.from_array(x), progress=False))
    assert chds.whole[..., 0] == pytest.approx(0.25, abs=0.08)
    assert chds.halves[..., -1] == pytest.approx(1)
    assert len(EDGES) == 161


# --- tests and correlations ---------------------------------------------------------------------


def lit(rng, sigma, spp, share):
    """Return log histograms of log-normal radiance with a share of nulls, by pixel of its shape."""
    x = np.exp(sigma * rng.normal(size=(8, 8, 1, spp)))
    x *= rng.random((8, 8, 1, spp)) < share
    return chd.summarize(chd.Samples.from_array(x), progress=False)


def test_integrators_of_equal_shapes_are_seldom_told_apart():
    """30 p-values: the chance that 7 or more are below 0.05 is 6e-4, of a mean off by 0.18 7e-4.

    Numbers of samples and shares of nulls differ: they are not shape.
    """
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.5, 2, size=(8, 8, 1, 1))
    found = [
        permuted([squares(lit(rng, sigma, 256, 0.5), lit(rng, sigma, 96, 0.8))]) for _ in range(30)
    ]
    assert np.sum(np.array(found) < 0.05) < 7
    assert abs(np.mean(found) - 0.5) < 0.18


def test_integrators_of_other_shapes_are_told_apart():
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.5, 2, size=(8, 8, 1, 1))
    squared = squares(lit(rng, sigma, 256, 0.5), lit(rng, 1.3 * sigma, 96, 0.8))
    assert permuted([squared]) == 0.001
    # Of log-normals, at the mean of their spreads in decades: nearly quadratic in their difference.
    expected = 0.3**2 * sigma.mean() / np.log(10) / (4 * np.sqrt(np.pi))
    assert np.nanmean(squared) == pytest.approx(expected, rel=0.35)


def sharing(rng, sigmas, correlation, spp=256, edge=12):
    """Return two renders of log-normal samples with the same random numbers, and one seed."""
    shared, *both = rng.normal(size=(3, edge, edge, 1, spp))
    logs = [np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * own for own in both]
    return [
        chd.Samples.from_array(np.exp(sigma * x), seed=1)
        for sigma, x in zip(sigmas, logs, strict=True)
    ]


def test_integrators_that_share_random_numbers_are_compared_in_pairs():
    """30 p-values as above; of halves drawn apart, squared distances are far below 0."""
    rng = np.random.default_rng(1)
    p, wrong = [], []
    for _ in range(30):
        one, two = sharing(rng, (0.8, 0.8), 0.8)
        p.append(permuted([squares_of_pairs(one, two)]))
        summaries = (chd.summarize(x, progress=False) for x in (one, two))
        wrong.append(permuted([squares(*summaries)]))
    assert np.sum(np.array(p) < 0.05) < 7
    assert abs(np.mean(p) - 0.5) < 0.18
    assert np.mean(wrong) > 0.9
    squared = squares_of_pairs(*sharing(rng, (0.8, 1.04), 0.8))
    assert permuted([squared]) == 0.001
    expected = 0.3**2 * 0.8 / np.log(10) / (4 * np.sqrt(np.pi))
    assert np.nanmean(squared) == pytest.approx(expected, rel=0.35)


@pytest.mark.parametrize("what", ["integrator", "shorter"])
def test_the_finding_on_integrators_reads_the_seeds(what):
    one, two = sharing(np.random.default_rng(2), (0.8, 0.8), 0.9)
    apart = chd.Samples.from_array(two.read(), seed=2)
    claim = FINDINGS[11]
    same = claim.find(SceneData("one", one, **{what: two}), [])
    assert 0.01 < same.p_value < 0.99
    assert claim.find(SceneData("one", one, **{what: apart}), []).p_value > 0.99  # told wrongly


def test_what_has_no_shape_is_no_difference():
    dark = chd.summarize(chd.Samples.from_array(np.zeros((4, 4, 3, 64))), progress=False)
    assert np.isnan(squares(dark, dark)).all()
    assert np.isnan(permuted([squares(dark, dark)]))
    assert np.isnan(permuted([]))


def uniform_noise(rng, spread):
    mean = np.repeat(np.linspace(1, 4, 20), 20)
    return mean[:, np.newaxis] + spread(mean)[:, np.newaxis] * rng.normal(size=(400, 12))


def test_uniform_noise_is_seldom_told_from_uniform():
    rng, blocks = np.random.default_rng(0), Blocks.grid(20, 20)
    found = [uniformity(uniform_noise(rng, np.ones_like), blocks) for _ in range(150)]
    assert np.mean([min(p.values()) < 0.05 for p in found]) < 0.11


def test_noise_that_grows_with_radiance_is_told():
    rng, blocks = np.random.default_rng(0), Blocks.grid(20, 20)
    found = uniformity(uniform_noise(rng, lambda mean: mean), blocks)
    assert 0 < found["breusch_pagan"] < 1e-6
    assert 0 < found["levene"] < 1e-6


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


def test_what_cannot_be_tested_has_no_p_value_and_adjusts_none():
    rng = np.random.default_rng(0)
    single = uniformity(rng.normal(4, 1, (64, 12)), Blocks.grid(8, 8, across=8))
    assert np.isnan(single["levene"])
    # Breusch-Pagan alone: a fifth of the p-values of no effect is below 0.2, were it adjusted for
    # two, a tenth; of 200, chance makes 27 or less 0.4 % of the time.
    found = [
        uniformity(rng.normal(4, 1, (64, 12)), Blocks.grid(8, 8, across=8)) for _ in range(200)
    ]
    assert np.sum([p["breusch_pagan"] < 0.2 for p in found]) > 27
    assert all(np.isnan(p) for p in uniformity(np.ones((64, 12)), Blocks.grid(8, 8)).values())


def test_features_that_fix_the_variance_explain_all_but_noise():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0, 1, size=(40, 40)).astype(np.float32)
    flat = np.zeros((40, 40, 3), dtype=np.float32)
    features = {"albedo": flat, "normal": flat, "depth": depth}
    samples = chd.Samples.from_array(np.ones((40, 40, 1, 4)), features=features)
    batches = np.exp(2 * depth).reshape(-1, 1) * rng.normal(size=(1600, 16))
    share, reliability = explained_by_features(SceneData("x", samples), batches, level=0.95)
    assert 0.9 < share.value < 1.05
    assert reliability < 0.95


def test_rank_correlation_is_that_of_scipy():
    x, y = np.random.default_rng(0).normal(size=(2, 9))
    found, p = rank_correlation(x, y)
    exact = stats.spearmanr(x, y, alternative="greater")
    assert found.value == pytest.approx(exact.statistic)
    assert p == pytest.approx(exact.pvalue, abs=0.03)


def test_equal_values_have_no_rank_correlation():
    found, p = rank_correlation(np.ones(6), np.arange(6.0))
    assert np.isnan(found.value)
    assert p == 1


def test_complexity_is_what_the_camera_sees():
    depth = np.ones((8, 8), dtype=np.float32)
    features = {"normal": np.tile([0.0, 0, 1], (8, 8, 1)), "albedo": np.ones((8, 8, 3))}
    x = np.ones((8, 8, 1, 2))
    wall = SceneData("wall", chd.Samples.from_array(x, features={**features, "depth": depth}))
    checks = depth + np.indices((8, 8)).sum(axis=0) % 2
    leaves = SceneData("leaves", chd.Samples.from_array(x, features={**features, "depth": checks}))
    assert scene_complexity(wall) == 0
    assert scene_complexity(leaves) == 1
    assert np.isnan(scene_complexity(SceneData("bare", chd.Samples.from_array(x))))


def history(gain):
    n = len(gain)
    return SimpleNamespace(
        iteration=np.arange(1.0, n + 1), validation_loss=1 - gain, validation_baseline=np.ones(n)
    )


def test_early_gain_is_a_share_of_the_last_one():
    noise = np.random.default_rng(0).normal(0, 0.01, size=100)
    early = early_gain(history(np.minimum(np.arange(100) / 18, 1) + noise), level=0.95)
    assert early.low < 0.5 < early.high
    assert early_gain(history(noise - 0.1), level=0.95).high == 0
    assert np.isnan(early_gain(history(noise), level=0.95).value)
    assert np.isnan(early_gain(history(noise[:5]), level=0.95).value)


def test_an_open_interval_supports_and_refutes_nothing_above():
    test = ClaimTest("tail", Interval(4.0, 3.5, np.inf), least=6)
    assert test.verdict == "cannot tell"
    assert "3.5 or more" in str(test)
    reason = Outcome((test,)).reason(512)
    assert "512 spp do not show how far its tail reaches" in reason
    assert ClaimTest("tail", Interval(8.0, 7.5, np.inf), least=6).verdict == "supported"


def test_advice_looks_at_the_side_that_reaches_over_the_border():
    """The interval would not reach the border with a third of its upper arm; the lower is short."""
    test = ClaimTest("share", Interval(0.3, 0.29, 0.51), most=0.5)
    assert test.margin == pytest.approx(0.2 / 0.21)
    assert "about 1024 spp would decide" in Outcome((test,)).reason(512)


# --- statistics that grow with the number of samples --------------------------------------------


def skewness(moments):
    return moments.skewness


@pytest.mark.parametrize(
    ("draw", "spp", "truth"),
    [
        (lambda rng, size: rng.lognormal(0, 0.75, size), 256, 3.26),
        (lambda rng, size: rng.lognormal(0, 0.75, size), 1024, 3.26),
        (lambda rng, size: rng.lognormal(0, 1.2, size), 512, 11.2),
        (lambda rng, size: rng.gamma(0.8, size=size), 128, 2.236),
        (lambda rng, size: rng.normal(8, 1, size), 256, 0.0),
        (lambda rng, size: rng.uniform(1, 2, size), 256, 0.0),
    ],
)
def test_room_is_left_for_the_samples_that_are_missing(draw, spp, truth):
    rng = np.random.default_rng(0)
    for pixels in (64, 2000):
        x = draw(rng, (pixels, spp))
        grown = growing(x, x > 0, skewness)
        found = with_room(median_of(grown[-1], Blocks.grid(8, pixels // 8)), grown)
        assert found.high > truth
        if truth == 0:  # what does not grow is known
            assert found.high < 0.5


def test_parts_of_the_samples_have_their_own_moments():
    x = np.random.default_rng(0).gamma(1, size=(3, 40))
    quarters, halves, whole = growing(x, x > 0, skewness)
    assert whole == pytest.approx(stats.skew(x, axis=1))
    assert halves[3:] == pytest.approx(stats.skew(x[:, 1::2], axis=1))
    assert quarters[6:9] == pytest.approx(stats.skew(x[:, 2::4], axis=1))


# --- verdicts -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.2, 0.4, "supported"),
        (0.0, 0.05, "not supported"),
        (0.6, 0.7, "not supported"),
        (0.05, 0.4, "cannot tell"),
        (0.0, 0.9, "cannot tell"),
        (np.nan, np.nan, "cannot tell"),
    ],
)
def test_the_whole_interval_has_to_be_on_one_side(low, high, verdict):
    assert ClaimTest("x", Interval(0.3, low, high), least=0.1, most=0.5).verdict == verdict


def test_a_claim_is_as_strong_as_its_weakest_part():
    good, bad, open_ = (
        ClaimTest("x", Interval(0.5, low, high), least=0.0)
        for low, high in ((0.1, 1.0), (-1.0, -0.1), (-1.0, 1.0))
    )
    assert Outcome((good, good)).verdict == "supported"
    assert Outcome((good, open_)).verdict == "cannot tell"
    assert Outcome((good, open_, bad)).verdict == "not supported"
    assert Outcome((good,), ("needs light",)).verdict == "cannot tell"
    assert Outcome((bad,), ("needs light",)).verdict == "not supported"
    assert Outcome((good, open_)).deciding is open_
    assert Outcome().deciding is None


def test_parts_share_what_may_go_wrong():
    assert 1 - level_of(4) == pytest.approx(0.05 / 4)


def test_json_has_no_numbers_that_are_none():
    found = ClaimTest("nothing", Interval.unknown()).to_dict()
    assert (found["value"], found["least"], found["most"], found["level"]) == (
        None,
        None,
        None,
        0.95,
    )
    assert PlotData("curves").series == {}


# --- several regions ----------------------------------------------------------------------------


def test_regions_of_different_shape_are_each_of_one_shape():
    rng = np.random.default_rng(0)
    sigma = np.where(np.arange(16) < 8, 0.4, 1.5)[:, np.newaxis]
    x = rng.lognormal(0, sigma, size=(8, 16, 512))
    one, two = (Blocks.grid(8, 8) for _ in range(2))
    shapes = aligned(np.concatenate([x[:, :8].reshape(64, -1), x[:, 8:].reshape(64, -1)]))
    apart = shape_spread(shapes, Blocks.join([one, two]), level=0.95)
    together = shape_spread(shapes, Blocks.grid(16, 8), level=0.95)
    assert apart.high < 0.05 < 0.1 < together.low


def test_slopes_with_an_instrument_are_not_flattened_by_noise():
    rng = np.random.default_rng(0)
    true = rng.normal(size=1600)
    x, z = true + rng.normal(size=(2, 1600))
    blocks = Blocks.grid(40, 40, across=8)
    fair = slope_of(x, 2 * true, blocks, instrument=z, level=0.999)
    flat = slope_of(x, 2 * true, blocks, level=0.999)
    assert fair.low < 2 < fair.high
    assert flat.high < 1.5
    assert correlation_of(x, z, blocks, level=0.95).value == pytest.approx(np.corrcoef(x, z)[0, 1])
