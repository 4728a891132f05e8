"""Certified numbers of laws whose answers are known.

Seeds are fixed; a bound of 4.5 standard errors fails by accident in 1 of 150,000 comparisons.
"""

import numpy as np
import pytest
from scipy import stats

from chdstat.certification.reduction import (
    AVERAGED,
    BANDWIDTHS,
    LEAST,
    MOST_MODES,
    QUANTILES,
    SIZES,
    TAIL_SHARES,
    TOPS,
    Numbers,
    reduce,
)
from chdstat.errors import InputError, Reason

N = 2**17


def of(x):
    """Return the numbers of one channel, without the dims of pixel and channel."""
    found = reduce(np.asarray(x, np.float32)[np.newaxis, np.newaxis])
    named = {name: np.asarray(getattr(found, own)) for name, (own, _) in Numbers.declared().items()}
    return {name: value[0] if value.ndim == 1 else value[0, 0] for name, value in named.items()}


@pytest.fixture(scope="module")
def exponential():
    return of(np.random.default_rng(1).exponential(size=N))


def near(found, name, true, errors=4.5):
    return np.all(np.abs(found[name] - true) <= errors * found[f"{name}_se"])


def test_moments_of_an_exponential(exponential):
    for name, true in (("mean", 1), ("variance", 1), ("skewness", 2), ("kurtosis", 6)):
        assert near(exponential, name, true), name
        assert exponential[f"{name}_se"] < 0.1 * true
    assert near(exponential, "quantile", stats.expon.ppf(QUANTILES))
    assert exponential["null_share"] == 0


def test_share_of_the_variance_in_the_largest(exponential):
    # The integral of (x - 1)^2 exp(-x) beyond t is (t^2 + 1) exp(-t), and exp(-t) is the share.
    true = [share * (np.log(share) ** 2 + 1) for share in TOPS]
    assert abs(exponential["tail_variance_share"][0] - true[0]) < 0.02
    assert exponential["tail_variance_share_se"][0] < 0.005
    # Of so many samples, the second share is 13: too few.
    assert np.isnan(exponential["tail_variance_share"][1])


def test_coverage_of_error_bars_of_an_exponential(exponential):
    rng = np.random.default_rng(2)
    for i, size in enumerate(SIZES[:3]):
        x = rng.exponential(size=(20_000, size))
        half = 1.96 * x.std(axis=1, ddof=1) / np.sqrt(size)
        mean = x.mean(axis=1)
        low, high = (mean + half < 1).mean(), (mean - half > 1).mean()
        error = np.hypot(exponential["coverage_se"][i], np.sqrt(0.1 / 20_000))
        assert abs(exponential["coverage"][i] - (1 - low - high)) < 4.5 * error
        assert abs(exponential["missed_low"][i] - low) < 4.5 * error
        assert abs(exponential["missed_high"][i] - high) < 4.5 * error


def test_averages_of_an_exponential(exponential):
    # Skewness 2 / sqrt(N) falls below 2 sqrt(6 / 32) at N = 5.33.
    assert exponential["n_gaussian"] == pytest.approx(6, abs=1)
    # Simulated: 10.4 % of the sets are rejected for averages of 32, and 8.3 % for 48.
    low, high = exponential["n_passing_interval"]
    assert low <= 64 <= high
    assert 16 <= exponential["n_passing"] <= 128
    # Power of Shapiro and Wilk's test, from chdstat.inference.averages.N_MEANS.
    for size, share in ((1, 0.98), (2, 0.79), (4, 0.46), (8, 0.25)):
        i = AVERAGED.index(size)
        error = np.hypot(exponential["rejected_se"][i], 0.01)
        assert abs(exponential["rejected"][i] - share) < 4.5 * error


@pytest.mark.parametrize("xi", [-0.2, 0.0, 0.3])
def test_tail_index_at_every_depth(xi):
    x = stats.genpareto(xi).rvs(N, random_state=np.random.default_rng(3))
    found = of(x)
    known = found["tail_index_reason"] == Reason.OK
    assert known[: TAIL_SHARES.index(0.001) + 1].all()
    assert np.all(np.abs(found["tail_index"] - xi)[known] <= 4 * found["tail_index_se"][known])
    assert found["tail_index_se"][TAIL_SHARES.index(0.1)] < 0.03


@pytest.mark.parametrize(
    ("places", "masses"), [([0], [1]), ([-2, 1], [0.3, 0.7]), ([-2, 0, 2], [0.2, 0.5, 0.3])]
)
def test_modes_of_log_normal_mixtures(places, masses):
    rng = np.random.default_rng(4)
    which = rng.choice(len(places), N, p=masses)
    found = of(np.exp(np.array(places)[which] * np.log(10) + rng.normal(0, 0.4, N)))
    assert found["modes"].tolist() == [len(places)] * len(BANDWIDTHS)
    order = np.argsort(found["mode_place"][: len(places)])
    np.testing.assert_allclose(found["mode_place"][order], places, atol=0.1)
    np.testing.assert_allclose(found["mode_mass"][order], masses, atol=0.01)
    # Far apart, the excess mass of a mode is nearly its mass; that of the highest is 1.
    lower = found["mode_excess"][1 : len(places)]
    expected = sorted(masses, reverse=True)[1:]
    np.testing.assert_allclose(lower, expected, atol=0.01)
    assert found["mode_excess"][0] == 1


def test_an_edge_and_noise_make_no_mode():
    rng = np.random.default_rng(5)
    for x in (1 + rng.exponential(size=N), rng.pareto(2, N) + 1, rng.uniform(1, 2, N)):
        found = of(x)
        assert (found["modes"] == 1).all()


def test_excess_mass_of_overlapping_modes():
    """Two Gaussians in log radiance; the valley and the masses above it are known."""
    rng = np.random.default_rng(6)
    log = np.where(rng.random(N) < 0.4, rng.normal(0, 0.2, N), rng.normal(0.8, 0.2, N))
    found = of(10**log)
    x = np.linspace(-1, 2, 30_001)
    spread = np.hypot(0.2, BANDWIDTHS[1])
    density = 0.4 * stats.norm.pdf(x, 0, spread) + 0.6 * stats.norm.pdf(x, 0.8, spread)
    between = (x > 0) & (x < 0.8)
    valley = density[between].min()
    cut = x[between][density[between].argmin()]
    above = np.maximum(density - valley, 0)[x < cut].sum() * (x[1] - x[0])
    assert abs(found["mode_excess"][1] - above) < 4.5 * found["mode_excess_se"][1] + 0.002


def test_errors_are_as_large_as_they_say():
    """z of 30 replicates: a standard deviation of 30 is outside 0.5 to 1.6 in 1 of 10,000."""
    rng = np.random.default_rng(7)
    x = rng.gamma(4, size=(30, 1, LEAST)) * (rng.random((30, 1, LEAST)) < 0.5)
    found = reduce(x.astype(np.float32))
    for name, value in (("mean", 2), ("variance", 6), ("null_share", 0.5)):
        z = (getattr(found, name) - value)[:, 0] / getattr(found, f"{name}_se")[:, 0]
        assert abs(z.mean()) < 0.8, name
        assert 0.5 < z.std() < 1.6, name


def test_what_samples_do_not_determine_is_missing():
    rng = np.random.default_rng(8)
    heavy = of(rng.pareto(1.2, N))  # the variance is infinite
    assert heavy["variance_reason"] == heavy["kurtosis_reason"] == Reason.UNIDENTIFIED
    assert np.isnan(heavy["variance"])
    assert np.isnan(heavy["n_gaussian"])
    assert np.isnan(heavy["variance_seen"]).all()
    wide = of(rng.lognormal(0, 1, N))  # the variance is known, the kurtosis of 111 is not
    assert wide["variance_reason"] == Reason.OK
    assert near(wide, "variance", (np.e - 1) * np.e)
    assert wide["kurtosis_reason"] == Reason.UNIDENTIFIED


def test_scaling_the_radiance_scales_the_numbers():
    rng = np.random.default_rng(9)
    x = rng.gamma(2, size=N).astype(np.float32)
    one, large = of(x), of(x * np.float32(2**40))
    for name in ("skewness", "kurtosis", "coverage", "tail_variance_share", "modes", "n_gaussian"):
        np.testing.assert_allclose(one[name], large[name], rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(one["mean"] * 2.0**40, large["mean"])
    np.testing.assert_allclose(one["variance_se"] * 2.0**80, large["variance_se"])


def test_pixels_without_answers_have_reasons():
    x = np.zeros((3, 3, LEAST), np.float32)
    x[1] = 0.25
    x[2] = np.random.default_rng(10).gamma(4, size=(3, LEAST))
    x[2, 0, :5] = np.nan
    found = reduce(x)
    assert found.mean.shape == (3, 4)
    assert found.n.tolist() == [LEAST, LEAST, LEAST - 5]
    assert (found.mean_reason[0] == Reason.ALL_NULL).all()
    assert (found.null_share[0] == 1).all()
    assert np.isnan(found.mean[0]).all()
    assert (found.mean_reason[1] == Reason.OK).all()
    np.testing.assert_allclose(found.mean[1], 0.25)
    assert (found.variance_reason[1] == Reason.CONSTANT).all()
    assert (found.coverage_reason[1] == Reason.CONSTANT).all()
    assert (found.variance_reason[2] == Reason.OK).all()
    assert np.isfinite(found.mean[2]).all()
    x[0], x[1, 1, 100:] = np.inf, np.nan
    reasons = reduce(x[:2]).mean_reason
    assert (reasons[0] == Reason.ALL_BAD).all()
    assert (reasons[1] == Reason.TOO_FEW).all()


def test_the_shape_of_samples_is_checked():
    for shape in ((3, LEAST), (1, 2, LEAST), (1, 3, LEAST - 1)):
        with pytest.raises(InputError, match="8192"):
            reduce(np.zeros(shape))


def test_pixels_do_not_depend_on_each_other():
    rng = np.random.default_rng(11)
    x = rng.exponential(size=(2, 1, LEAST)).astype(np.float32)
    both, second = reduce(x), reduce(x[1:])
    lengths = {
        "q": len(QUANTILES),
        "top": 2,
        "size": len(SIZES),
        "averaged": len(AVERAGED),
        "bound": 2,
    }
    lengths |= {"share": len(TAIL_SHARES), "bandwidth": len(BANDWIDTHS), "mode": MOST_MODES}
    lengths["channel"] = 1
    for name, (own, about) in Numbers.declared().items():
        np.testing.assert_array_equal(getattr(both, own)[1:], getattr(second, own), err_msg=name)
        assert getattr(both, own).shape == (2, *(lengths[dim] for dim in about.dims)), name
