"""Simulated CHDs: what is drawn is what is said, and the truth is what the numbers imply."""

import itertools

import numpy as np
import pytest
from scipy import integrate, stats

from chdstat import patterns
from chdstat.errors import InputError
from chdstat.patterns import CHD, CHDS, Component, Label
from tests.luminance import LUMINANCE
from tests.patterns.flag_scores import (
    FlagScore,
    flag_scores,
    penultimate_index,
    random_chds,
    separations,
    truth,
)

TWO = (Component("lognormal", 0.5, 0.02, 0.4), Component("lognormal", 0.4, 1.0, 0.6))
CONTINUOUS = {
    "gamma": CHD((Component("gamma", 0.5, 2.0),)),
    "lognormal": CHD((Component("lognormal", 1.2, 3.0),), null_share=0.4),
    "two": CHD(TWO, null_share=0.7),
    "heavy tail": CHD((Component("gamma", 2.0),), tail_index=0.6, tail_share=0.2),
    "exponential tail": CHD(TWO, tail_index=0.0, tail_share=0.25),
}


@pytest.fixture(params=CONTINUOUS.values(), ids=CONTINUOUS)
def chd(request):
    return request.param


def test_the_density_integrates_to_the_distribution(chd):
    edges = chd.ppf(chd.null_share + (1 - chd.null_share) * np.array([0.01, 0.3, 0.7, 0.99]))

    def density(y):
        return float(chd.pdf(np.exp(y))) * np.exp(y)

    for low, high in itertools.pairwise(edges):
        kinks = [np.log(chd.threshold)] if low < chd.threshold < high else None
        mass = integrate.quad(density, np.log(low), np.log(high), points=kinks, epsabs=1e-11)[0]
        expected = (chd.cdf(high) - chd.cdf(low)) / (1 - chd.null_share)
        assert mass == pytest.approx(expected, abs=1e-9)


def test_quantiles_invert_the_distribution(chd):
    q = np.linspace(0.01, 0.99, 50)
    np.testing.assert_allclose(chd.cdf(chd.ppf(q)), np.maximum(q, chd.null_share), atol=1e-12)
    assert chd.ppf(chd.null_share / 2) == 0


def test_draws_follow_the_distribution(chd):
    # Kolmogorov-Smirnov and the binomial share of nulls, five CHDs: false failure below 1e-3.
    x = chd.draw((3,), samples=20_000, seed=1)
    assert x.shape == (3, 20_000)
    nulls = np.count_nonzero(x == 0)
    assert stats.binomtest(nulls, x.size, chd.null_share).pvalue > 1e-4

    def positive(x):
        return (chd.cdf(x) - chd.null_share) / (1 - chd.null_share)

    assert stats.kstest(x[x > 0], positive).pvalue > 1e-4


def test_draws_of_another_distribution_are_told_apart():
    # Negative control: a tail index of 0.3 instead of 0.6.
    heavy, other = CONTINUOUS["heavy tail"], CHD((Component("gamma", 2.0),), 0.3, 0.2)
    x = other.draw(samples=60_000, seed=1)
    assert stats.kstest(x, heavy.cdf).pvalue < 1e-4


def test_components_are_those_of_scipy():
    x = np.geomspace(0.01, 100, 30)
    gamma, lognormal = Component("gamma", 1.7, 2.0), Component("lognormal", 0.8, 2.0)
    for one, other in (
        (gamma, stats.gamma(1.7, scale=2 / stats.gamma(1.7).median())),
        (lognormal, stats.lognorm(0.8, scale=2.0)),
    ):
        np.testing.assert_allclose(one.pdf(x), other.pdf(x), rtol=1e-10)
        np.testing.assert_allclose(one.cdf(x), other.cdf(x), rtol=1e-10)
        assert one.mean_below(np.inf) == pytest.approx(other.mean())
        assert one.mean_below(3.0) == pytest.approx(other.expect(lb=0, ub=3.0), rel=1e-6)


def test_the_mean_is_that_of_the_density(chd):
    top = chd.ppf(1 - 1e-6 * (1 - chd.null_share))
    pieces = np.log([top * 1e-12, min(chd.threshold, top / 2), top])
    below = sum(
        integrate.quad(lambda y: np.exp(2 * y) * float(chd.pdf(np.exp(y))), a, b, limit=200)[0]
        for a, b in itertools.pairwise(pieces)
    )
    assert (1 - chd.null_share) * below == pytest.approx(chd.mean(), rel=0.01)
    assert chd.mean() > (1 - chd.null_share) * below
    assert CHD((Component("gamma"),), tail_index=1.0).mean() == np.inf


def test_penultimate_index_of_known_distributions():
    # Exponential: 0 everywhere. Log-normal: z M(z) - 1 + sigma M(z), M being Mills' ratio, at the
    # quantile z of the threshold. Grafted tails: their own index.
    assert penultimate_index(CHD((Component("gamma", 1.0),))) == pytest.approx(0, abs=1e-8)
    z = stats.norm.isf(0.1)
    mills = 0.1 / stats.norm.pdf(z)
    expected = z * mills - 1 + 1.2 * mills
    found = penultimate_index(CHD((Component("lognormal", 1.2),)))
    assert found == pytest.approx(expected, rel=1e-6)
    assert penultimate_index(CONTINUOUS["heavy tail"]) == 0.6


def test_a_firefly_carries_its_share():
    x = CHDS["firefly"].draw((100,), samples=64, seed=2)
    np.testing.assert_allclose(x.max(axis=-1) / x.sum(axis=-1), 0.5)
    many = CHD((Component("gamma"),), null_share=0.9, firefly_share=0.3)
    x = many.draw((100,), samples=256, seed=2)
    np.testing.assert_allclose(x.max(axis=-1) / x.sum(axis=-1), 0.3)


def test_truth_of_named_chds():
    labels = {name: truth(chd).label.name.lower() for name, chd in CHDS.items()}
    like = {"gamma": "gamma_like", "lognormal": "lognormal_like", "firefly": "firefly_dominated"}
    assert labels == {name: like.get(name, name.replace("-", "_")) for name in CHDS}


def test_truth_is_open_inside_the_zones():
    def flags(*body, **options):
        return truth(CHD(body, **options)).flags

    gamma = Component("gamma", 2.0)
    assert flags(gamma, null_share=0.48)["null_heavy"] is None
    assert flags(gamma, tail_index=0.2)["long_tail"] is False
    assert flags(gamma, tail_index=0.7)["long_tail"] is None
    assert flags(gamma, tail_index=1.0)["long_tail"] is True
    assert flags(Component("lognormal", 0.8))["lognormal_like"] is None
    assert flags(Component("lognormal", 1.1))["lognormal_like"] is False
    assert flags(Component("lognormal", 0.3))["lognormal_like"] is None
    assert flags(gamma, tail_index=0.0)["gamma_like"] is None
    assert flags(gamma, tail_index=0.5)["gamma_like"] is False
    near = (Component("lognormal", 0.5), Component("lognormal", 0.5, 2.5))
    assert flags(*near)["bimodal"] is None
    assert flags(gamma, firefly_share=0.1)["firefly_dominated"] is None
    assert truth(CHD(near)).label == Label.UNDETERMINED


def test_the_population_avoids_the_zones():
    chds = random_chds(300, seed=1)
    assert chds == random_chds(300, seed=1)
    found = [truth(chd) for chd in chds]
    for name in found[0].flags:
        values = [t.flags[name] for t in found]
        assert values.count(True) >= 10
        light_tail = {None} if name in ("gamma_like", "lognormal_like") else set()
        assert set(values) <= {True, False} | light_tail
    for chd, true in zip(chds, found, strict=True):
        assert not 0.5 < true.tail_index < 1, chd.is_constant
        apart = separations(chd)
        assert ((apart >= 2.5 - 1e-9) & (apart <= 6 + 1e-9)).all()


def test_an_image_of_regions():
    names = ["gamma", "bimodal", "null-heavy", "constant", "black"]
    samples = patterns.simulate(names, shape=(6, 9), spp=256, seed=3)
    assert samples.shape == (6, 9, 3, 256)
    # Three channels of one colour, which is the luminance of the CHD. 256 samples of 9 pixels.
    x = samples.read()
    for name, y, x0 in zip(names, (0, 0, 0, 3, 3), (0, 3, 6, 0, 3), strict=True):
        here = x[y : y + 3, x0 : x0 + 3, 0]
        assert here.mean() == pytest.approx(CHDS[name].mean(), rel=0.1), name
    assert x[3:, 6:].max() == 0
    again = patterns.simulate(names, shape=(6, 9), spp=256, seed=3)
    np.testing.assert_array_equal(samples.read(), again.read())


def test_color_leaves_luminance_alone():
    red = CHD((Component("gamma", 2.0),), color=(1.0, 0.2, 0.1))
    x = patterns.simulate(red, shape=(4, 4), spp=64).read()
    np.testing.assert_allclose(x[..., 1, :] / x[..., 0, :], 0.2, rtol=1e-5)
    gray = patterns.simulate(CHD((Component("gamma", 2.0),)), shape=(4, 4), spp=64).read()
    np.testing.assert_allclose(LUMINANCE @ x, gray[..., 0, :], rtol=1e-5)


def test_scores_count_what_they_say():
    score = FlagScore(hits=6, false=2, missed=4)
    assert (score.precision, score.recall, score.f1) == (0.75, 0.6, pytest.approx(2 / 3))
    chds = [CHDS["constant"]] * 3 + [CHDS["null-heavy"]] * 5
    scores = flag_scores(chds, 256)
    assert scores["constant"] == FlagScore(3, 0, 0)
    assert scores["null_heavy"] == FlagScore(5, 0, 0)


def test_wrong_input_is_refused():
    gamma = Component("gamma")
    for message, call in (
        ("family", lambda: Component("weibull")),
        ("above 0", lambda: Component("gamma", -1.0)),
        ("stands alone", lambda: CHD((gamma, Component("constant")))),
        ("null_share", lambda: CHD((gamma,), null_share=1.5)),
        ("color", lambda: CHD((gamma,), color=(0.0, 0.0, 0.0))),
        ("one of", lambda: patterns.simulate("caustic")),
        ("regions", lambda: patterns.simulate(["gamma"] * 9, shape=(2, 2))),
        ("a shape", lambda: patterns.simulate("gamma", shape=(0, 2))),
    ):
        with pytest.raises(InputError, match=message):
            call()
