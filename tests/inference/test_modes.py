"""Modes: the dip of known samples, a calibrated test, modes of mixtures whose number is known."""

import diptest
import numpy as np
import pytest
from scipy import special, stats

import chdstat as chd
from chdstat.inference.modes import dips

DECADES = 1 / np.log(10)


def two_lights(rng, shape, share=0.3):
    indirect = rng.lognormal(-4, 0.8, size=shape)
    return np.where(rng.random(shape) < share, indirect, rng.lognormal(0, 0.5, size=shape))


def lights(rng, rows, spp, *, modes, family="lognormal"):
    """Components of Ashman's D 2.5 to 6 between neighbours and of weights within a factor of 3."""
    weight = rng.uniform(0.25, 0.75, size=(rows, modes))
    which = rng.random((rows, spp, 1)) * weight.sum(axis=-1)[:, np.newaxis, np.newaxis]
    which = (which > np.cumsum(weight, axis=-1)[:, np.newaxis]).sum(axis=-1)
    shape = rng.uniform(1, 8, size=(rows, modes))
    spread = rng.uniform(0.3, 1.0, size=(rows, modes))
    if family == "gamma":
        spread = np.sqrt(special.polygamma(1, shape))
    apart = rng.uniform(2.5, 6, size=(rows, modes - 1))
    apart *= np.sqrt((spread[:, 1:] ** 2 + spread[:, :-1] ** 2) / 2)
    mean = np.concatenate([np.zeros((rows, 1)), np.cumsum(apart, axis=-1)], axis=-1)
    mean, spread, shape = (np.take_along_axis(v, which, axis=-1) for v in (mean, spread, shape))
    if family == "gamma":
        return rng.gamma(shape) * np.exp(mean - special.digamma(shape))
    return np.exp(rng.normal(mean, spread))


def gamma_with_a_tail(rng, rows, spp):
    """Gamma bodies whose top 10 to 25 % are generalised Pareto, xi to 0.75, without a jump."""
    shape, share = rng.uniform(0.5, 6, (rows, 1)), rng.uniform(0.1, 0.25, (rows, 1))
    xi, u = rng.uniform(0.3, 0.75, (rows, 1)), rng.random((rows, spp))
    start = stats.gamma(shape).ppf(1 - share)
    scale = share / stats.gamma(shape).pdf(start)
    excess = scale / xi * (np.maximum((1 - u) / share, 1e-12) ** -xi - 1)
    return np.where(u < 1 - share, stats.gamma(shape).ppf(u), start + excess)


ONE_MODE = {
    "gamma": lambda rng, size: rng.gamma(rng.uniform(0.3, 6, (size[0], 1)), size=size),
    "lognormal": lambda rng, size: rng.lognormal(0, rng.uniform(0.3, 2, (size[0], 1)), size=size),
    "weibull": lambda rng, size: rng.weibull(rng.uniform(0.5, 3, (size[0], 1)), size=size),
    "burr": lambda rng, size: stats.burr12(rng.uniform(1, 5, (size[0], 1)), 1.5).ppf(
        rng.random(size)
    ),
    "pareto": lambda rng, size: rng.pareto(1.0, size=size),
    "tail": lambda rng, size: gamma_with_a_tail(rng, *size),
}
FLAT = {
    "uniform": lambda rng, size: rng.uniform(0, 2, (size[0], 1)) + rng.random(size),
    "log-uniform": lambda rng, size: np.exp(rng.uniform(0.5, 3, (size[0], 1)) * rng.random(size)),
}


# --- the dip ------------------------------------------------------------------------------------


def test_dip_of_two_equal_spikes_is_a_quarter():
    # Hartigan and Hartigan 1985: the dip of (1, 1, 2, 2), and its limit for any number of each.
    result = chd.modality(np.repeat([1.0, 2.0], 20))
    assert float(result.dip) == pytest.approx(0.25, abs=1e-5)
    assert float(result.tied_share) == 1
    assert int(result.modes) == 2
    np.testing.assert_allclose(result.places[:2], np.log10([1, 2]), atol=1e-6)
    np.testing.assert_allclose(result.weights[:2], 0.5, atol=1e-6)


@pytest.mark.parametrize("spp", [20, 75, 300, 1500])
def test_p_values_are_those_of_diptest(spp):
    # It interpolates linearly between quantiles that are up to 10 % apart.
    rng = np.random.default_rng(20)
    apart = rng.uniform(0, 3, (100, 1))
    x = np.exp(rng.random((100, spp)) + apart * (rng.random((100, spp)) < 0.5))
    result = chd.modality(x)
    expected = [diptest.diptest(np.log(row))[1] for row in x]
    np.testing.assert_allclose(result.dip_p_value, expected, atol=0.012)


@pytest.mark.parametrize("row", [[1.0], [1.0, 1.0, 1.0], [1.0, 2.0], [0.5, 1.5, 2.5, 3.5]])
def test_the_least_dip(row):
    padded = np.array([[*row, np.inf]])
    assert dips(padded, np.array([len(row)])) == 1 / (2 * len(row))
    assert dips(np.empty((0, 4)), np.empty(0, int)).shape == (0,)


def test_p_values_are_uniform_under_the_null():
    """Kolmogorov-Smirnov at 0.001 for each of four sizes: fails by chance in 0.4 % of cases."""
    rng = np.random.default_rng(21)
    for spp, rows in ((20, 2000), (60, 2000), (500, 1000), (5000, 200)):
        p = chd.modality(np.exp(rng.random((rows, spp)))).dip_p_value
        assert stats.kstest(p, "uniform").pvalue > 0.001


def test_dip_of_more_samples_than_any_table_has():
    rng = np.random.default_rng(22)
    x = np.exp(rng.random((2, 100_000)))
    x[1, ::3] *= 30
    result = chd.modality(x)
    assert result.dip_p_value[0] > 0.01
    assert result.dip_p_value[1] == 1e-5


# --- one mode, two, three -----------------------------------------------------------------------


@pytest.mark.parametrize("spp", [128, 512])
@pytest.mark.parametrize("name", ONE_MODE)
def test_one_mode_is_one_mode(name, spp):
    """At least 97 % of 150 rows; 99 % were measured: 5 or more of 150 fail by chance with 2 %."""
    result = chd.modality(ONE_MODE[name](np.random.default_rng(2), (150, spp)))
    assert (result.dip_p_value < 0.05).mean() < 0.01
    assert (result.modes == 1).mean() >= 0.97


@pytest.mark.parametrize("spp", [128, 512])
@pytest.mark.parametrize("name", FLAT)
def test_flat_distributions_have_one_mode(name, spp):
    """At least 90 % of 200 rows; 95 % were measured: the dip test rejects 5 % of log-uniform ones.

    Without the uniform distributions among the rivals, it was 0 to 16 %. 21 or more of 200 fail by
    chance with 0.2 %.
    """
    result = chd.modality(FLAT[name](np.random.default_rng(14), (200, spp)))
    assert (result.modes == 1).mean() >= 0.9


HARD_EDGED = {
    "floor and exponential": lambda rng, size: 1 + rng.exponential(size=size),
    "floor and pareto": lambda rng, size: 1 + rng.pareto(2, size),
    "floor and gamma": lambda rng, size: 0.3 + rng.gamma(0.4, size=size),
    "triangular": lambda rng, size: np.exp(rng.triangular(0, 0.5, 2, size)),
    "semicircle": lambda rng, size: np.exp(2 * rng.beta(1.5, 1.5, size)),
    "ceiling": lambda rng, size: rng.beta(5, 1, size),
    "skew-normal": lambda rng, size: np.exp(stats.skewnorm.rvs(8, size=size, random_state=rng)),
    "half-cauchy": lambda rng, size: 1 + np.abs(rng.standard_cauchy(size)),
}


@pytest.mark.parametrize(("spp", "most"), [(128, 0.065), (1024, 0.03)])
@pytest.mark.parametrize("name", HARD_EDGED)
def test_a_hard_edge_is_no_mode(name, spp, most):
    """At most 4 and 1 % were measured (benchmarks/test_modes.py); before, 10 to 100 %.

    More than 6.5 % of 300 rows where 4 % are expected: 2 %. The dip test does not object to these
    distributions, and mixtures follow an edge only with a narrow component beside it.
    """
    x = HARD_EDGED[name](np.random.default_rng(23), (300, spp))
    assert (chd.modality(x).modes > 1).mean() <= most


def cut_off(law, top=1.0, floor=0.0, at=None):
    """Draw from a law, clamped at a quantile on either side, or at a value."""
    low, high = law.ppf(floor), law.ppf(top) if at is None else at
    return lambda rng, size: np.clip(law.ppf(rng.random(size)), low, high)


def as_half(draw):
    return lambda rng, size: draw(rng, size).astype(np.float16)


def as_eight_bits(draw, top):
    return lambda rng, size: np.round(255 * np.minimum(draw(rng, size) / top, 1)) / 255


LAWS = {
    "exponential": stats.expon(),
    "gamma": stats.gamma(2),
    "gamma below 1": stats.gamma(0.5),
    "log-normal": stats.lognorm(1),
}
CLAMPED = {
    f"{name}, {top}": cut_off(law, top) for name, law in LAWS.items() for top in (0.5, 0.9, 0.99)
} | {
    "exponential at 2": cut_off(LAWS["exponential"], at=2.0),
    "log-normal, both ends": cut_off(LAWS["log-normal"], 0.9, 0.1),
    "exponential, floor": cut_off(LAWS["exponential"], floor=0.1),
    "halves": as_half(cut_off(LAWS["log-normal"], at=3.5)),
    "eight bits": as_eight_bits(cut_off(LAWS["log-normal"]), 3.5),
}


@pytest.mark.parametrize(("n", "most"), [(256, 0.065), (2048, 0.03)])
@pytest.mark.parametrize("name", CLAMPED)
def test_a_clamp_is_no_mode(name, n, most):
    """At most 3 and 0.5 % were measured (benchmarks/test_modes.py); it were up to 100 %.

    More than 6.5 % of 200 rows where 3 % are expected: 0.4 %. The dip test rejected at most 1.5 %;
    more than 5 %: below 1e-3.
    """
    result = chd.modality(CLAMPED[name](np.random.default_rng(n + 40), (200, n)))
    assert (result.modes > 1).mean() <= most
    assert (result.dip_p_value <= 0.05).mean() <= 0.05
    np.testing.assert_allclose(np.nansum(result.weights, axis=-1), 1)


@pytest.mark.parametrize("samples", [1, 2, 3, 20])
def test_rows_of_few_samples_have_a_reason(samples):
    result = chd.modality(np.ones((4, samples)))
    np.testing.assert_array_equal(result.modes, 0)
    assert (result.reason != 0).all()


@pytest.mark.parametrize("clamp", [4.0, 5.0])
@pytest.mark.parametrize("kind", ["float", "half"])
def test_two_modes_are_found_below_a_clamp(kind, clamp):
    """All of 100 rows were found to have more than one, four sigma apart; 97 fail below 1e-6."""
    rng = np.random.default_rng(45)
    high = rng.random((100, 512)) < 0.5
    x = np.exp(0.5 * np.minimum(rng.normal(size=high.shape) + 4 * high, clamp))
    result = chd.modality(x.astype(np.float16) if kind == "half" else x)
    assert (result.modes > 1).mean() >= 0.97
    assert (result.dip_p_value <= 0.05).all()
    dark = result.weights[result.modes == 2, 0]
    np.testing.assert_allclose(dark.mean(), 0.5, atol=0.03)


def test_modes_three_sigma_apart_are_found():
    """At least 95 % of 400 rows of 512 samples; 99 % were measured: fails by chance below 1e-6."""
    rng = np.random.default_rng(24)
    x = np.exp(rng.normal(size=(400, 512)) + 3 * (rng.random((400, 512)) < 0.5))
    result = chd.modality(x)
    assert (result.modes == 2).mean() >= 0.95
    assert (result.delta_bic[result.modes == 2] > 0).all()


ROUNDED = {
    "integers": lambda rng, size: np.ceil(rng.gamma(2.0, size=size)),
    "eight bits": lambda rng, size: (1 + np.round(255 * rng.beta(2, 3, size))) / 255,
    "sixteen bits": lambda rng, size: rng.lognormal(size=size).astype(np.float16),
    "nearly constant": lambda rng, size: 1 + 1e-5 * rng.normal(size=size),
    "decades": lambda rng, size: 10 ** (np.round(3 * rng.normal(size=size)) / 3),
}


@pytest.mark.parametrize("name", ROUNDED)
def test_rounding_makes_no_modes(name):
    """Nor does the dip test reject: it saw steps in all rows. Fails by chance below 1e-3."""
    x = ROUNDED[name](np.random.default_rng(25), (100, 512)).astype(np.float32)
    result = chd.modality(x)
    assert result.tied_share.mean() > 0.05
    assert (result.modes == 1).mean() >= 0.97
    assert (result.dip_p_value < 0.05).mean() <= 0.03


@pytest.mark.parametrize("n", [21, 24, 32])
def test_a_few_equal_samples_are_rounded_ones(n):
    """Of 200 rows of five bits, 93 to 97 % have one mode (measured), as if not rounded; it were 63.

    Fewer than 87 %: below 1e-3.
    """
    mantissa, exponent = np.frexp(np.random.default_rng(34).gamma(2.0, size=(200, n)))
    x = np.ldexp(np.round(32 * mantissa) / 32, exponent)
    assert (chd.modality(x).modes == 1).mean() >= 0.87


def on_levels(rng, rows, spp, levels, *, decades=True):
    """Radiance of lights or of a texture: values with unequal gaps, of unequal shares."""
    value = np.cumsum(rng.exponential(size=(rows, levels)), axis=-1)
    value = 10 ** (3 * value / value[:, -1:] - 2) if decades else value
    share = np.cumsum(rng.dirichlet(np.full(levels, 3.0), rows), axis=-1)[:, np.newaxis, :-1]
    which = (rng.random((rows, spp, 1)) > share).sum(axis=-1)
    return np.take_along_axis(value, which, axis=-1)


def beside(rng, size, levels, body):
    return np.where(rng.random(size) < 0.5, 10 * on_levels(rng, *size, levels), body)


STEPPED = {
    "two clusters": lambda rng, size: rng.choice([1, 1.05, 1.1, 10, 10.5, 11.0], size),
    "four lights": lambda rng, size: on_levels(rng, *size, 4),
    "nine lights": lambda rng, size: on_levels(rng, *size, 9),
    "texture": lambda rng, size: 3 * on_levels(rng, *size, 25, decades=False),
    "lights and log-normal": lambda rng, size: beside(rng, size, 5, rng.lognormal(size=size)),
    "lights and gamma": lambda rng, size: beside(rng, size, 8, rng.gamma(2, 0.1, size)),
    "narrow lobes": lambda rng, size: on_levels(rng, *size, 5) * rng.lognormal(0, 0.01, size),
    "clamped": lambda rng, size: np.minimum(rng.lognormal(size=size), 2),
    **ROUNDED,
}


@pytest.mark.parametrize("spp", [40, 400])
@pytest.mark.parametrize("name", STEPPED)
def test_modes_lie_where_samples_do(name, spp):
    """All of them, by construction; two modes share a value in 1 of 100 rows (measured).

    Of the lights, up to 98 % of rows had a mode 0.02 decades or more from any sample. More than 5
    of 100 rows: below 1e-3.
    """
    rng = np.random.default_rng(32)
    x = STEPPED[name](rng, (100, spp)).astype(np.float32)
    x[rng.random(x.shape) < 0.2] = 0
    places = chd.modality(x).places[..., np.newaxis]
    with np.errstate(divide="ignore"):
        away = np.abs(np.log10(x, dtype=np.float64)[:, np.newaxis] - places).min(axis=-1)
    assert np.nanmax(away) < 1e-9
    assert (np.diff(places[..., 0], axis=-1) <= 0).any(axis=-1).mean() <= 0.05


@pytest.mark.parametrize("gap", [3.0, 10.0, 1e4])
def test_ties_are_not_spread_across_a_gap(gap):
    """What modes below and above the gap weigh is what there are samples; it was 0.31 for 0.5."""
    rng = np.random.default_rng(33)
    low = rng.random((50, 400)) < 0.4
    value = rng.choice([1, 1.02, 1.05, 1.1, 1.11, 1.2], low.shape)
    result = chd.modality(np.where(low, value, gap * value))
    assert (result.modes >= 2).all()
    of_low = np.where(result.places < np.log10(1.3), result.weights, 0).sum(axis=-1)
    np.testing.assert_allclose(of_low, low.mean(axis=-1), atol=1e-3)


def test_modes_of_rounded_samples_are_found():
    rng = np.random.default_rng(26)
    x = np.round(np.where(rng.random((50, 300)) < 0.4, rng.gamma(50, size=(50, 300)), 200))
    x = np.where(x == 200, np.round(rng.gamma(50, 4, size=(50, 300))), x)
    result = chd.modality(x)
    assert (result.modes == 2).all()
    np.testing.assert_allclose(result.places[:, :2].mean(axis=0), np.log10([50, 200]), atol=0.02)


@pytest.mark.parametrize("family", ["lognormal", "gamma"])
@pytest.mark.parametrize("modes", [2, 3])
def test_modes_that_stand_apart_are_counted(modes, family):
    """At least 88 % of 150 rows; 93 % to 99 % were measured, so that chance fails it below 1 %."""
    x = lights(np.random.default_rng(3), 150, 512, modes=modes, family=family)
    result = chd.modality(x)
    assert (result.modes == modes).mean() >= 0.88
    assert (result.delta_bic[result.modes > 1] > 0).all()


def test_of_few_samples_most_modes_are_found():
    x = lights(np.random.default_rng(4), 150, 128, modes=2)
    assert (chd.modality(x).modes == 2).mean() >= 0.85


def test_a_few_outliers_are_no_mode():
    x = np.random.default_rng(5).lognormal(size=(50, 512))
    x[:, :10] = 1e6 * x[:, :10]
    result = chd.modality(x)
    assert (result.modes == 1).all()
    assert (result.delta_bic > 0).mean() > 0.9


def test_places_weights_and_separation_of_two():
    """Medians and spread of z-scores over 300 rows: fails by chance below 1e-3."""
    result = chd.modality(two_lights(np.random.default_rng(6), (300, 1024)))
    assert (result.modes == 2).all()
    np.testing.assert_allclose(np.median(result.places, axis=0)[:2], [-4 * DECADES, 0], atol=0.02)
    np.testing.assert_allclose(result.weights[:, :2].mean(axis=0), [0.3, 0.7], atol=0.01)
    np.testing.assert_allclose(np.nansum(result.weights, axis=-1), 1)
    assert np.isnan(result.places[:, 2]).all()
    assert np.isnan(result.ashman_d[:, 1]).all()
    true_d = np.sqrt(2) * 4 / np.hypot(0.8, 0.5)
    z = (result.ashman_d[:, 0] - true_d) / result.ashman_d_se[:, 0]
    assert np.isnan(z).mean() < 0.01
    z = z[np.isfinite(z)]
    assert np.median(z) == pytest.approx(0, abs=0.4)
    assert z.std() == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize(("separation", "weight"), [(4.0, 0.5), (4.0, 0.1), (3.0, 0.5)])
@pytest.mark.parametrize("spp", [128, 512])
def test_interval_of_the_separation_holds_it(separation, weight, spp):
    """92 to 97 % of those found are held (measured); it were 68 to 92 %. 5 % fewer: below 1e-3."""
    rng = np.random.default_rng(29)
    x = np.exp(rng.normal(size=(400, spp)) + separation * (rng.random((400, spp)) < weight))
    result = chd.modality(x)
    two = result.modes == 2
    d, error = result.ashman_d[two, 0], result.ashman_d_se[two, 0]
    known = np.isfinite(error)
    assert known.mean() > 0.9
    assert (d > 0).all()
    assert (np.abs(d - separation)[known] < 1.96 * error[known]).mean() > 0.87


def test_one_mode_has_a_place_and_no_separation():
    result = chd.modality(np.random.default_rng(7).lognormal(2.0, 0.7, size=(20, 512)))
    np.testing.assert_allclose(result.places[:, 0], 2 * DECADES, atol=0.1)
    np.testing.assert_allclose(result.weights[:, 0], 1)
    assert np.isnan(result.ashman_d).all()
    assert (result.delta_bic < 0).mean() > 0.9


# --- mixtures from the same search, which takes over the fits of families -----------------------


def analysed(x):
    """Return the analysis of rows, as that of pixels of one channel."""
    found = chd.analyze(chd.Samples.from_array(x[:, np.newaxis, np.newaxis]), progress=False)
    return found.isel(x=0, channel=0)


def test_mixtures_of_an_analysis_are_those_alone():
    x = np.concatenate(
        [
            two_lights(np.random.default_rng(15), (60, 400)),
            ONE_MODE["gamma"](np.random.default_rng(15), (60, 400)),
        ]
    ).astype(np.float32)
    found, modes, alone = analysed(x), chd.modality(x), chd.fit.mixture(x, effort="fast")
    np.testing.assert_array_equal(found["modality_modes"], modes.modes)
    np.testing.assert_allclose(found["modality_delta_bic"], modes.delta_bic, rtol=1e-9)
    at_once = {
        name: found[f"lognormal_mixture_{name}"].to_numpy()
        for name in ("k", "bics", "weights", "mu_se")
    }
    np.testing.assert_array_equal(at_once["k"][:60], alone.k[:60])
    np.testing.assert_allclose(at_once["bics"][:, :2], alone.bics[:, :2], rtol=1e-9)
    np.testing.assert_allclose(at_once["weights"][:60], alone.weights[:60], rtol=1e-6)
    errors = alone.standard_errors["mu"][:60]
    np.testing.assert_allclose(at_once["mu_se"][:60], errors, rtol=1e-5)
    untried = np.isnan(at_once["bics"][:, 2])
    assert untried[60:].mean() > 0.9
    np.testing.assert_allclose(at_once["bics"][~untried, 2], alone.bics[~untried, 2], rtol=1e-9)


def test_mixtures_need_what_modes_need():
    x = np.stack([np.zeros(30), np.r_[np.zeros(15), np.arange(1, 16)], np.ones(30)])
    found = analysed(x)
    np.testing.assert_array_equal(found["lognormal_mixture_reason"], found["modality_reason"])
    np.testing.assert_array_equal(found["lognormal_mixture_k"], 0)
    assert np.isnan(found["lognormal_mixture_bics"]).all()


# --- laws ---------------------------------------------------------------------------------------


def test_a_spike_of_ties_beside_a_lobe_is_a_second_mode():
    rng = np.random.default_rng(10)
    x = np.where(rng.random((50, 400)) < 0.3, 1.0, rng.lognormal(-3, 0.5, size=(50, 400)))
    result = chd.modality(x.astype(np.float32))
    np.testing.assert_allclose(result.tied_share, (x == 1).mean(axis=-1), atol=0.02)
    assert (result.modes == 2).all()
    assert (result.dip_p_value < 1e-3).all()
    again = chd.modality(x.astype(np.float32))
    np.testing.assert_array_equal(again.dip, result.dip)
    beyond = chd.modality(2.0**300 * x[:5])  # the range of single precision
    np.testing.assert_array_equal(beyond.modes, 2)
    np.testing.assert_allclose(beyond.dip, result.dip[:5], rtol=1e-5)
