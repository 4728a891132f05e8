"""Statistics behind the findings: slopes, distances without noise, fair p-values, verdicts.

Seeds are fixed. For other seeds, each test that counts would fail with a probability below 1e-3:
its bound lies more than three standard errors of a binomial share from what is expected.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat._core.resampling import (
    Blocks,
    Interval,
    quantile_of,
)
from chdstat.inference.findings import Finding, level_of
from chdstat.studies.claims import CLAIMS, ClaimTest, SceneData
from chdstat.studies.claims.assumptions import (
    explained_by_features,
    growing,
    p_of_uniform_noise,
    with_room,
)
from chdstat.studies.claims.between_renders import rank_correlation, scene_complexity
from chdstat.studies.claims.learned_models import early_gain
from chdstat.studies.log_chds import EDGES, aligned, of_histograms, squared_distance
from chdstat.studies.scene_data import PixelSet, positive_quantiles
from chdstat.studies.shape_distances import (
    log_skewness,
    permuted,
    shape_spread,
    squares,
    squares_of_pairs,
)

# --- slopes -------------------------------------------------------------------------------------


def pixels(blocks, level=0.95):
    none = np.zeros(len(blocks.of_pixel), dtype=np.int64)
    return PixelSet(("image",), none, none, none, blocks, level)


def test_an_instrument_keeps_slopes_steep():
    rng = np.random.default_rng(0)
    true = rng.normal(size=1600)
    x, z = true + rng.normal(size=(2, 1600))
    image = pixels(Blocks.grid(40, 40, across=8), 0.999)
    fair, flat = image.slope(x, 2 * true, instrument=z), image.slope(x, 2 * true)
    assert fair.low < 2 < fair.high
    assert flat.high < 1.5
    assert image.slope(x, 3 * x + 1).value == pytest.approx(3)
    assert image.correlation(x, z).value == pytest.approx(np.corrcoef(x, z)[0, 1])


@pytest.mark.parametrize("n", [110, 128, 199, 200])
def test_few_samples_keep_their_quantiles(n):
    """The tail of an exponential distribution is as long in 110 samples as in 200, to 6 %."""
    x = np.random.default_rng(n).exponential(size=(4000, n))
    middle, high = positive_quantiles(x, (0.5, 0.99))
    assert np.median(high / middle) == pytest.approx(np.log(100) / np.log(2), rel=0.06)
    expected = np.quantile(x[:9], (0.5, 0.99), axis=1, method="median_unbiased")
    np.testing.assert_allclose([middle[:9], high[:9]], expected)


# --- log CHDs -----------------------------------------------------------------------------------


def test_equal_chds_have_no_distance_on_average():
    chds = aligned(np.random.default_rng(0).lognormal(size=(800, 128)))
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


def test_shapes_know_no_scale_or_nulls():
    x = np.random.default_rng(0).lognormal(size=(1, 512))
    out = np.concatenate([x, np.full((1, 2), 1e-17), np.zeros((1, 60))], axis=1)
    np.testing.assert_allclose(aligned(x).halves, aligned(1e20 * x).halves)
    np.testing.assert_allclose(aligned(x).whole, aligned(out).whole, atol=1e-12)
    assert log_skewness(out) == pytest.approx(log_skewness(x))
    assert log_skewness(x)[0] == pytest.approx(stats.skew(np.log(x[0])))
    # Constants and few samples have no shape.
    assert np.isnan(log_skewness(np.full(100, 0.1)))
    assert not aligned(np.ones((1, 20))).known.any()


def test_histograms_count_nulls_below_every_edge():
    x = np.where(np.arange(400) % 4, 1.0, 0.0) * np.ones((2, 2, 3, 1))
    chds = of_histograms(chd.summarize(chd.Samples.from_array(x), progress=False))
    assert chds.whole[..., 0] == pytest.approx(0.25, abs=0.08)
    assert chds.halves[..., -1] == pytest.approx(1)
    assert len(EDGES) == 161


def test_different_regions_have_one_shape_each():
    sigma = np.repeat([0.4, 1.5], 64)[:, np.newaxis]
    shapes = aligned(np.random.default_rng(0).lognormal(0, sigma, size=(128, 512)))
    apart = shape_spread(shapes, pixels(Blocks.join([Blocks.grid(8, 8), Blocks.grid(8, 8)])))
    together = shape_spread(shapes, pixels(Blocks.grid(16, 8)))
    assert apart.high < 0.05 < 0.1 < together.low


# --- integrators --------------------------------------------------------------------------------


def lit(rng, sigma, spp, share):
    """Return log histograms of log-normal radiance with a share of nulls, by pixel of its shape."""
    x = np.exp(sigma * rng.normal(size=(8, 8, 1, spp)))
    x *= rng.random((8, 8, 1, spp)) < share
    return chd.summarize(chd.Samples.from_array(x), progress=False)


def sharing(rng, sigmas, correlation, spp=256, edge=12):
    """Return two renders of log-normal samples with the same random numbers, and one seed."""
    shared, *both = rng.normal(size=(3, edge, edge, 1, spp))
    logs = [np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * own for own in both]
    return [
        chd.Samples.from_array(np.exp(sigma * x), seed=1)
        for sigma, x in zip(sigmas, logs, strict=True)
    ]


def test_integrators_are_told_apart_by_shape():
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
    squared = squares(lit(rng, sigma, 256, 0.5), lit(rng, 1.3 * sigma, 96, 0.8))
    assert permuted([squared]) < 0.001
    # Of log-normals, at the mean of their spreads in decades: nearly quadratic in their difference.
    expected = 0.3**2 * sigma.mean() / np.log(10) / (4 * np.sqrt(np.pi))
    assert np.nanmean(squared) == pytest.approx(expected, rel=0.35)


def test_shared_numbers_are_compared_in_pairs():
    """20 p-values: 6 or more are below 0.05 with a probability of 3e-4, their mean is off by 0.2
    with one of 2e-3; of halves drawn separately, squared distances are far below 0."""
    rng = np.random.default_rng(1)
    p, wrong = [], []
    for _ in range(20):
        one, two = sharing(rng, (0.8, 0.8), 0.8)
        p.append(permuted([squares_of_pairs(one, two)]))
        if len(wrong) < 5:
            summaries = (chd.summarize(x, progress=False) for x in (one, two))
            wrong.append(permuted([squares(*summaries)]))
    assert np.sum(np.array(p) < 0.05) < 6
    assert abs(np.mean(p) - 0.5) < 0.2
    assert np.mean(wrong) > 0.9
    squared = squares_of_pairs(*sharing(rng, (0.8, 1.04), 0.8))
    assert permuted([squared]) < 0.001
    expected = 0.3**2 * 0.8 / np.log(10) / (4 * np.sqrt(np.pi))
    assert np.nanmean(squared) == pytest.approx(expected, rel=0.35)


@pytest.mark.parametrize("what", ["integrator", "shorter"])
def test_the_finding_on_integrators_reads_the_seeds(what):
    one, two = sharing(np.random.default_rng(2), (0.8, 0.8), 0.9)
    apart = chd.Samples.from_array(two.read(), seed=2)
    claim = CLAIMS[11]
    same = claim.find(SceneData("one", one, **{what: two}), [])
    assert 0.01 < same.p_value < 0.99
    assert claim.find(SceneData("one", one, **{what: apart}), []).p_value > 0.99  # told wrongly


def test_what_has_no_shape_is_no_difference():
    dark = chd.summarize(chd.Samples.from_array(np.zeros((4, 4, 3, 64))), progress=False)
    assert np.isnan(squares(dark, dark)).all()
    assert np.isnan([permuted([squares(dark, dark)]), permuted([])]).all()


# --- tests and correlations ---------------------------------------------------------------------


def uniform_noise(rng, spread):
    mean = np.repeat(np.linspace(1, 4, 20), 20)
    return mean[:, np.newaxis] + spread(mean)[:, np.newaxis] * rng.normal(size=(400, 12))


def test_growing_noise_is_told_from_uniform():
    """Of 200 p-values of no effect, more than 22 are below 0.05 once in 5000 runs."""
    rng = np.random.default_rng(0)
    found = [p_of_uniform_noise(uniform_noise(rng, np.ones_like)) for _ in range(200)]
    assert np.sum(np.array(found) < 0.05) <= 22
    assert 0 < p_of_uniform_noise(uniform_noise(rng, lambda mean: mean)) < 1e-3


def test_what_cannot_be_tested_has_no_p_value():
    assert p_of_uniform_noise(np.ones((64, 12))) is None


def test_features_explain_all_but_noise():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0, 1, size=(40, 40)).astype(np.float32)
    flat = np.zeros((40, 40, 3), dtype=np.float32)
    features = {"albedo": flat, "normal": flat, "depth": depth}
    data = SceneData("x", chd.Samples.from_array(np.ones((40, 40, 1, 4)), features=features))
    batches = np.exp(2 * depth).reshape(-1, 1) * rng.normal(size=(1600, 16))
    assert 0.9 < explained_by_features(data, batches, data.whole()).value < 1.05


def test_rank_correlation_is_that_of_scipy():
    x, y = np.random.default_rng(0).normal(size=(2, 9))
    found, p = rank_correlation(x, y)
    exact = stats.spearmanr(x, y, alternative="greater")
    assert found.value == pytest.approx(exact.statistic)
    assert p == pytest.approx(exact.pvalue, abs=0.03)
    found, p = rank_correlation(np.ones(6), np.arange(6.0))
    assert np.isnan(found.value)
    assert p == 1


def test_complexity_is_what_the_camera_sees():
    depth = np.ones((8, 8), dtype=np.float32)
    checks = depth + np.indices((8, 8)).sum(axis=0) % 2
    flat = {"normal": np.tile([0.0, 0, 1], (8, 8, 1)), "albedo": np.ones((8, 8, 3))}
    found = [
        scene_complexity(
            SceneData("scene", chd.Samples.from_array(np.ones((8, 8, 1, 2)), features=features))
        )
        for features in ({**flat, "depth": depth}, {**flat, "depth": checks}, None)
    ]
    assert found[:2] == [0, 1]
    assert np.isnan(found[2])


def test_early_gain_is_a_share_of_the_last_one():
    def gained(gain):
        loss, iteration = {"validation_loss": 1 - gain}, np.arange(1.0, len(gain) + 1)
        history = SimpleNamespace(iteration=iteration, validation_baseline=1 + 0 * gain, **loss)
        return early_gain(history, level=0.95)

    noise = np.random.default_rng(0).normal(0, 0.01, size=100)
    early = gained(np.minimum(np.arange(100) / 18, 1) + noise)
    assert early.low < 0.5 < early.high
    assert gained(noise - 0.1).high == 0
    assert np.isnan([gained(noise).value, gained(noise[:5]).value]).all()


# --- statistics that grow with the number of samples --------------------------------------------


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
    for count in (64, 2000):
        x = draw(rng, (count, spp))
        grown = growing(x, x > 0, lambda moments: moments.skewness)
        found = with_room(quantile_of(grown[-1], Blocks.grid(8, count // 8)), grown)
        assert found.high > truth
        if truth == 0:  # what does not grow is known
            assert found.high < 0.5


def test_parts_of_the_samples_have_their_own_moments():
    x = np.random.default_rng(0).gamma(1, size=(3, 40))
    quarters, halves, whole = growing(x, x > 0, lambda moments: moments.skewness)
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


def test_an_open_interval_refutes_nothing_above():
    test = ClaimTest("tail", Interval(4.0, 3.5, np.inf), least=6)
    assert test.verdict == "cannot tell"
    assert "3.50 or more" in str(test)
    reason = Finding((test,), spp=512).reason
    assert "512 spp do not show how far its tail reaches" in reason
    assert ClaimTest("tail", Interval(8.0, 7.5, np.inf), least=6).verdict == "supported"


def test_advice_looks_at_the_side_of_the_border():
    """The interval would not reach the border with a third of its upper arm; the lower is short."""
    test = ClaimTest("share", Interval(0.3, 0.29, 0.51), most=0.5)
    assert test.margin == pytest.approx(0.2 / 0.21)
    assert "about 1024 spp would decide" in Finding((test,), spp=512).reason


def test_a_claim_is_as_strong_as_its_weakest_part():
    good, bad, open_ = (
        ClaimTest("x", Interval(0.5, low, high), least=0.0)
        for low, high in ((0.1, 1.0), (-1.0, -0.1), (-1.0, 1.0))
    )
    assert Finding((good, good)).verdict == "supported"
    assert Finding((good, open_)).verdict == "cannot tell"
    assert Finding((good, open_, bad)).verdict == "not supported"
    assert Finding((good,), ("needs light",)).verdict == "cannot tell"
    assert Finding((bad,), ("needs light",)).verdict == "not supported"
    assert Finding((good, open_)).test is open_
    assert Finding().test is None
    assert 1 - level_of(4) == pytest.approx(0.05 / 4)


def test_json_has_no_numbers_that_are_none():
    found = ClaimTest("nothing", Interval.unknown()).to_dict()
    assert [found[name] for name in ("value", "least", "most", "level")] == [None, None, None, 0.95]
