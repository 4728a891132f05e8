"""Goodness of fit: statistics of SciPy, p-values that are uniform, power, and false discoveries."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat._core.positive import PositivePart
from chdstat.errors import InputError, Reason
from chdstat.fit import FAMILIES, goodness, select
from chdstat.fit.distributions import Gamma
from chdstat.fit.goodness_of_fit import FIT_TESTS, GoodnessOfFit
from chdstat.summary.runner import measured
from tests.fit import families_by_scipy as by_scipy

RESAMPLES = 19


def draw(family, shape, seed):
    return by_scipy.typical(family).rvs(size=shape, random_state=np.random.default_rng(seed))


def least_uniformity(p_value, resamples, seed):
    """Spread discrete p-values evenly over their steps; return the p-value of uniformity."""
    fitted = np.isfinite(p_value)
    # Of 100 Burr samples, 2 % look like Weibull ones, which are no Burr distribution.
    assert fitted.mean() > 0.95
    u = np.random.default_rng(seed).random(fitted.sum())
    spread = p_value[fitted] - u / (resamples[fitted] + 1)
    return stats.kstest(spread, "uniform").pvalue


@pytest.mark.parametrize("route", ["samples", "histogram"])
@pytest.mark.parametrize("family", FAMILIES)
def test_p_values_are_uniform(family, route):
    """Of 40 tests of uniformity, one fails by chance at 1e-4 once in 250 runs."""
    x = draw(family, (300, 100), 71)
    source = x if route == "samples" else chd.histogram(x)
    result = goodness(source, family, resamples=RESAMPLES, seed=72)
    for test in range(len(FIT_TESTS)):
        uniformity = least_uniformity(result.p_value[:, test], result.resamples[:, test], test)
        assert uniformity > 1e-4


def test_textbook_tables_would_not_be():
    """Negative control: with estimated parameters, tables of known ones reject almost nothing."""
    x = draw("lognormal", (300, 100), 73)
    result = goodness(x, "lognormal", resamples=0)
    naive = stats.kstwo.sf(result.statistic[:, 0], 100)
    assert (naive < 0.05).mean() < 0.005


@pytest.mark.parametrize("family", FAMILIES)
def test_statistics_are_those_of_scipy(family):
    x = draw(family, 200, 74)
    result = goodness(x, family, resamples=0)
    fitted = chd.fit.fit(x, family)
    distribution = FAMILIES[family].distribution(fitted.parameters)
    expected = stats.ks_1samp(x, distribution.cdf).statistic
    assert result.statistic[0] == pytest.approx(expected, rel=1e-9)
    expected = stats.cramervonmises(x, distribution.cdf).statistic
    assert result.statistic[1] == pytest.approx(expected, rel=1e-9)
    below, i = distribution.cdf(np.sort(x)), np.arange(1, 201)
    terms = (2 * i - 1) * (np.log(below) + np.log1p(-below[::-1]))
    assert result.statistic[2] == pytest.approx(-200 - terms.sum() / 200, rel=1e-7)
    cells = int(2 * 200**0.4)
    observed = np.histogram(below, bins=cells, range=(0, 1))[0]
    assert result.statistic[3] == pytest.approx(stats.chisquare(observed).statistic, rel=1e-9)


def test_statistics_of_bins_by_their_formulas():
    x = draw("gamma", 2000, 75)
    histogram = chd.histogram(x)
    fitted = chd.fit.gamma(histogram)
    result = goodness(histogram, "gamma", resamples=0)
    distribution = FAMILIES["gamma"].distribution(fitted.parameters)
    edges = histogram.edges
    gap = np.searchsorted(np.sort(x), edges) / 2000 - distribution.cdf(edges)
    assert result.statistic[0] == pytest.approx(np.abs(gap).max(), abs=1e-9)
    weight = np.diff(distribution.cdf(edges))
    assert result.statistic[1] == pytest.approx(2000 * np.sum(gap[1:] ** 2 * weight), rel=1e-6)
    fine = goodness(x, "gamma", resamples=0)
    np.testing.assert_allclose(result.effect[1:3], fine.effect[1:3], rtol=0.3)
    assert result.effect[0] <= fine.effect[0]


def test_effects_do_not_grow_with_the_number_of_samples():
    rng = np.random.default_rng(76)
    few, many = rng.lognormal(0, 1, size=(100, 500)), rng.lognormal(0, 1, size=(100, 8000))
    small, large = (goodness(x, "gamma", resamples=0) for x in (few, many))
    np.testing.assert_allclose(
        large.effect.mean(axis=0)[:3], small.effect.mean(axis=0)[:3], rtol=0.2
    )
    assert (large.statistic[:, 1:].mean(axis=0) > 5 * small.statistic[:, 1:].mean(axis=0)).all()
    n = large.n[:, np.newaxis]
    np.testing.assert_allclose(large.effect[:, 1:], np.sqrt(large.statistic[:, 1:] / n))


@pytest.mark.parametrize(
    ("family", "wrong"),
    [("lognormal", "gamma"), ("gamma", "lognormal"), ("weibull", "lognormal"), ("burr", "weibull")],
)
@pytest.mark.parametrize("route", ["samples", "histogram"])
def test_wrong_families_are_rejected(family, wrong, route):
    x = draw(family, (40, 2000), 77)
    source = x if route == "samples" else chd.histogram(x)
    result = goodness(source, wrong, resamples=RESAMPLES)
    power = (result.p_value <= 0.05).mean(axis=0)
    assert (power[:3] > 0.9).all()
    assert power[3] > 0.5


def test_false_discoveries_over_an_image():
    """80 % of the pixels are log-normal: of those that are rejected, 4 % are false on average.

    There are about 75: that more than 13 % are false has a probability below 1e-3.
    """
    rng = np.random.default_rng(78)
    truth = rng.random((15, 25)) < 0.8
    lognormal, other = (
        rng.lognormal(size=(*truth.shape, 120)),
        rng.gamma(1, size=(*truth.shape, 120)),
    )
    samples = chd.Samples.from_array(np.where(truth[..., np.newaxis], lognormal, other))
    tests = ("anderson-darling",)
    dataset = goodness(samples, "lognormal", tests=tests, resamples=199, progress=False)
    rejected = dataset["lognormal_goodness_rejected"].to_numpy()[..., 0, 0] == 1
    assert (rejected & truth).sum() / rejected.sum() < 0.13
    assert rejected[~truth].mean() > 0.7
    uncorrected = dataset["lognormal_goodness_p_value"].to_numpy()[..., 0, 0] <= 0.05
    assert (uncorrected & truth).sum() > (rejected & truth).sum()


def test_image_has_coordinates_and_its_level():
    rng = np.random.default_rng(79)
    samples = chd.Samples.from_array(rng.gamma(2.0, size=(2, 3, 3, 64)))
    tests = ("kolmogorov-smirnov", "chi-square")
    dataset = goodness(samples, "gamma", tests=tests, resamples=9, alpha=0.1, progress=False)
    assert tuple(dataset["fit_test"].to_numpy()) == tests
    assert dataset["gamma_goodness_rejected"].attrs["false_discovery_rate"] == 0.1
    assert set(np.unique(dataset["gamma_goodness_rejected"])) <= {0, 1}


def test_a_fit_stands_for_its_family():
    x = draw("weibull", (3, 200), 81)
    by_name = goodness(x, "weibull", resamples=9)
    by_fit = goodness(x, chd.fit.weibull(x), resamples=9)
    np.testing.assert_array_equal(by_name.p_value, by_fit.p_value)
    with pytest.raises(InputError, match="family"):
        goodness(x, chd.fit.mixture(x, 2))


def test_a_family_of_ones_own():
    class Own(Gamma):
        name = "own"

    x = draw("gamma", (2, 100), 89)
    ours, theirs = goodness(x, Own(), resamples=9), goodness(x, "gamma", resamples=9)
    assert ours.family == "own"
    np.testing.assert_array_equal(ours.p_value, theirs.p_value)


def test_replicates_are_independent_and_seeded():
    # The same samples in another unit have the same distances, but replicates of their own: their
    # p-values differ as binomial numbers do.
    x = draw("gamma", 100, 82) * np.linspace(1, 2, 50)[:, np.newaxis]
    one, same, other = (goodness(x, "gamma", resamples=19, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.p_value, same.p_value)
    assert (one.p_value != other.p_value).any()
    more = 20 * one.p_value[:, 0] - 1
    share = more.mean() / 19
    assert 0.4 < more.var() / (19 * share * (1 - share)) < 2.2


@pytest.mark.parametrize("route", ["samples", "histogram"])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_row_has_the_p_value_that_it_has_alone(family, route):
    x = draw(family, (12, 100), 91)
    x[3, :40] = 0
    of = chd.histogram if route == "histogram" else np.asarray
    together = goodness(of(x), family, resamples=19)
    np.testing.assert_array_equal(
        goodness(of(x[2:6]), family, resamples=19).p_value, together.p_value[2:6]
    )
    alone = goodness(of(np.random.default_rng(1).permutation(x[5])), family, resamples=19)
    np.testing.assert_array_equal(alone.p_value, together.p_value[5])


def test_what_was_not_tested_has_no_verdict():
    x = draw("gamma", (2, 3, 1, 64), 92)
    alone = goodness(x, "gamma", resamples=0)
    assert (alone.reason == Reason.UNTESTED).all()
    assert np.isnan(alone.p_value).all()
    assert np.isfinite(alone.effect).all()
    x[0, 0] = 0
    samples = chd.Samples.from_array(x)
    untested = goodness(samples, "gamma", resamples=0, progress=False)
    assert {n.removeprefix("gamma_goodness_") for n in untested.data_vars} == {
        "statistic",
        "effect",
        "reason",
    }
    tested = goodness(samples, "gamma", resamples=9, progress=False)
    rejected = tested["gamma_goodness_rejected"]
    np.testing.assert_array_equal(rejected.isnull(), tested["gamma_goodness_p_value"].isnull())
    assert np.isnan(rejected[0, 0]).all()


def test_few_replicates_are_no_p_value():
    """Of 8 Burr samples, fewer than half of the replicates can often be fitted."""
    x = stats.burr12(1.5, 1.5).rvs((60, 8), random_state=np.random.default_rng(93))
    found = goodness(x, "burr", tests=["anderson-darling"], resamples=39)
    few = found.reason == Reason.FEW_REPLICATES
    assert few.any()
    np.testing.assert_array_equal(few, np.isfinite(found.statistic) & np.isnan(found.p_value))
    assert (2 * found.resamples[few] < 39).all()
    assert (2 * found.resamples[found.reason == Reason.OK] >= 39).all()


def test_replicates_are_not_the_draws_that_are_tested():
    """The default seed may be that of the samples; 500 p-values, of which 5 % are as small."""
    x = np.random.default_rng(0).lognormal(size=(500, 200))
    p = goodness(x, "lognormal", tests=["kolmogorov-smirnov"], resamples=19).p_value
    assert 0.02 < np.mean(p <= 0.05) < 0.09


def test_a_dozen_samples_fill_no_four_cells():
    result = goodness(np.random.default_rng(84).gamma(2.0, size=12), "gamma", resamples=9)
    assert result.reason.tolist() == [Reason.OK] * 3 + [Reason.TOO_FEW]
    np.testing.assert_array_equal(np.isnan(result.p_value), [False] * 3 + [True])


def test_ties_and_extremes_warn_of_nothing():
    rng = np.random.default_rng(85)
    x = rng.pareto(0.5, size=(4, 200)) + 1e-6
    x[0, 0], x[1, :50], x[2, 100:] = 1e300, 1e-310, x[2, 0]
    x[3] = np.round(x[3], 1) + 0.1
    for family in FAMILIES:
        result = goodness(x, family, resamples=5)
        ok = result.reason == Reason.OK
        assert np.isfinite(result.statistic[ok]).all()
        np.testing.assert_array_equal(result.p_value > 0, result.resamples > 2)
        assert (result.resamples[~ok] == 0).all()


def test_the_best_family_of_each_pixel_is_tested():
    rng = np.random.default_rng(41)
    x = np.stack([rng.gamma(0.7, size=400), rng.lognormal(sigma=1.0, size=400), np.zeros(400)])
    found = measured(PositivePart.of(x), GoodnessOfFit())
    assert found.family == "best"
    for row, name in enumerate(select(x[:2]).names):
        alone = goodness(x[row], str(name), resamples=0)
        np.testing.assert_allclose(found.statistic[row], alone.statistic, rtol=1e-9)
    assert (found.reason[2] == Reason.ALL_NULL).all()
