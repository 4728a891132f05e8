"""Families: their limits, where a maximum does not exist, and histograms instead of samples."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat._core.positive import PositivePart
from chdstat.errors import Reason
from chdstat.fit import FAMILIES
from chdstat.fit.families import FamilyFit, estimate_part
from chdstat.fit.family import blocks
from chdstat.summary.runner import measured
from tests.fit import families_by_scipy as by_scipy

FAMILY_NAMES = sorted(FAMILIES)


@pytest.mark.parametrize("family", FAMILY_NAMES)
def test_log_density_is_scipys(family):
    rng = np.random.default_rng(1)
    parameters = by_scipy.random_parameters(family, rng, 4)
    x = FAMILIES[family].distribution(parameters).rvs((4, 50), random_state=rng)
    part = PositivePart.of(x)
    flat = {name: value[:, 0] for name, value in parameters.items()}
    ascending = np.sort(x, axis=-1)
    expected = by_scipy.log_density(family, ascending, parameters)
    for points in blocks(part, np.ones(4, dtype=bool)):
        here = {name: value[points.rows] for name, value in flat.items()}
        density = FAMILIES[family].log_density(points, here) - np.log(ascending[points.rows])
        np.testing.assert_allclose(density, expected[points.rows], rtol=1e-9, atol=1e-9)
    total = FAMILIES[family].log_likelihood(part, flat)
    np.testing.assert_allclose(total, expected.sum(axis=-1), rtol=1e-9)


def test_burr_ends_where_weibull_begins():
    """About half of Weibull samples, n large, are likeliest at the limit: 150 to 250 of 400.

    False failure: 5 standard deviations of a binomial, below 1e-6.
    """
    x = np.random.default_rng(3).weibull(1.3, size=(400, 2000))
    burr, weibull = chd.fit.burr(x), chd.fit.weibull(x)
    at_limit = burr.reason == Reason.AT_LIMIT
    assert 150 < at_limit.sum() < 250
    # A small d, larger than nothing, must be likelier than the limit; what has none says nothing.
    assert (burr.log_likelihood > weibull.log_likelihood - 1e-9)[~at_limit].all()
    assert np.isnan(burr.parameters["d"][at_limit]).all()
    # The likelihood rises from the limit exactly where w = (x / scale)^shape is more spread out
    # than an exponential variable.
    w = (x / weibull.parameters["scale"][:, np.newaxis]) ** weibull.parameters["shape"][:, None]
    assert (((w**2).mean(axis=-1) <= 2) == at_limit).mean() > 0.97


def test_burr_ends_where_a_power_law_has_an_edge():
    """Samples from 1 on, likeliest at 1: no Burr distribution is as likely as that jump.

    That limit has a code of its own: there, the Weibull fit is not the answer.
    """
    x = 1 + np.random.default_rng(4).pareto(2.0, size=(50, 512))
    assert (chd.fit.burr(x).reason == Reason.AT_PARETO_LIMIT).all()
    assert (_power_law(x) - chd.fit.weibull(x).log_likelihood > 200).all()


def _power_law(x):
    """Return the likelihood of Pareto's distribution above the smallest sample, the limit."""
    index = 1 / np.log(x / x.min(axis=-1, keepdims=True)).mean(axis=-1)
    return x.shape[-1] * (np.log(index) - 1) - np.log(x).sum(axis=-1)


@pytest.mark.parametrize("samples", [10, 512])
@pytest.mark.parametrize("law", ["floor", "lognormal", "gamma", "heaps"])
def test_burr_is_told_from_both_its_limits(law, samples):
    """OK only where no limit is likelier, and each limit only where the other one is not."""
    rng = np.random.default_rng(8)
    size = (200, samples)
    x = {
        "floor": lambda: 1 + rng.exponential(size=size),
        "lognormal": lambda: rng.lognormal(size=size),
        "gamma": lambda: rng.gamma(2, size=size),
        "heaps": lambda: rng.gamma(20, size=size) * np.where(rng.random(size) < 0.5, 1, 50),
    }[law]()
    burr, weibull, power_law = chd.fit.burr(x), chd.fit.weibull(x), _power_law(x)
    fine, light, edge = (
        burr.reason == r for r in (Reason.OK, Reason.AT_LIMIT, Reason.AT_PARETO_LIMIT)
    )
    limits = np.maximum(power_law, weibull.log_likelihood)
    assert (burr.log_likelihood >= limits - 1e-6)[fine].all()
    assert (weibull.log_likelihood >= power_law - 1e-3 * samples)[light].all()
    assert (power_law >= weibull.log_likelihood - 1e-3 * samples)[edge].all()
    if samples == 10 or law == "floor":
        assert light.any() or edge.any()


def test_burr_with_the_shape_of_weibull_has_its_tail():
    x = stats.burr12(2.0, 50.0).rvs((3, 50_000), random_state=4)
    fit = chd.fit.burr(x)
    tail = 1 / (fit.parameters["c"] * fit.parameters["d"])
    assert (fit.reason == Reason.OK).all()
    np.testing.assert_allclose(tail, 0.01, atol=0.02)


@pytest.mark.parametrize("family", FAMILY_NAMES)
def test_fewer_samples_than_parameters(family):
    count = len(FAMILIES[family].units)
    x = np.zeros((count + 1, 8))
    for row in range(count + 1):
        x[row, :row] = 1.0 + np.arange(row) ** 2
    reasons = chd.fit.fit(x, family).reason
    np.testing.assert_array_equal(reasons[1:count], Reason.TOO_FEW)
    assert reasons[count] != Reason.TOO_FEW


@pytest.mark.parametrize("family", FAMILY_NAMES)
def test_histogram_route_agrees_with_samples(family):
    """Parameters of the histogram make the samples as likely, to 1e-2 per sample.

    Wherever the log deviation is at least a bin (0.1 decades) and the samples lie in the support.
    """
    rng = np.random.default_rng(6)
    parameters = by_scipy.random_parameters(family, rng, 300)
    x = FAMILIES[family].distribution(parameters).rvs((300, 512), random_state=rng)
    inside = ((x > 1e-5) & (x < 1e5)).all(axis=-1) & (np.log10(x).std(axis=-1) >= 0.1)
    x = x[inside]
    assert len(x) > 100
    part = PositivePart.of(x)
    of_samples, of_bins = (
        measured(part, FamilyFit(FAMILIES[family])),
        chd.fit.fit(chd.histogram(x), family),
    )
    both = (of_samples.reason == Reason.OK) & (of_bins.reason == Reason.OK)
    assert both.mean() > 0.95
    likelihood = FAMILIES[family].log_likelihood(part, of_bins.parameters)
    best = FAMILIES[family].log_likelihood(part, of_samples.parameters)
    loss = (best - likelihood)[both] / 512
    assert loss.min() > -1e-9
    assert loss.max() < 1e-2


@pytest.mark.parametrize("n", [20, 100, 160, 300])
def test_one_sample_apart_from_all_others_is_enough(n):
    lone = np.full((2, n), 2.0)
    lone[0, 3], lone[1, 3] = 0.5, 7.0
    assert (chd.fit.weibull(lone).reason == Reason.OK).all()


@pytest.mark.parametrize("family", ["weibull", "burr"])
@np.errstate(all="ignore")
def test_where_the_search_begins_makes_no_difference(family):
    rng = np.random.default_rng(10)
    x = by_scipy.draw(family, rng, 100, 200)
    part, other = PositivePart.of(x), PositivePart.of(x[:, ::2])
    away = estimate_part(other, FAMILIES[family])[0].parameters
    (one, _), (two, _) = (estimate_part(part, FAMILIES[family], near) for near in (None, away))
    both = one.converged & two.converged
    assert both.mean() > 0.9
    for name, values in one.parameters.items():
        np.testing.assert_allclose(two.parameters[name][both], values[both], rtol=1e-6)


@np.errstate(all="ignore")
def test_an_unfitted_row_overflows_no_other():
    rows = np.array([[1e-3, 1.0, 2.0, 1e3], [1.0, 2.0, 3.0, 4.0]])
    (points,) = blocks(PositivePart.of(rows), np.ones(2, bool))
    parameters = {
        name: np.array([known, np.nan])
        for name, known in (("c", 400.0), ("d", 1.0), ("scale", 1e-3))
    }
    density = FAMILIES["burr"].log_density(points, parameters)
    assert np.isfinite(density[0]).all()
    assert np.isnan(density[1]).all()


@pytest.mark.parametrize("family", FAMILY_NAMES)
def test_a_row_without_a_fit_has_no_density(family):
    """Nor does it warn, or change that of another."""
    known = by_scipy.parameters_at(family, 0.5)
    x = FAMILIES[family].distribution(known).ppf([0.2, 0.4, 0.6, 0.8])
    (points,) = blocks(PositivePart.of(np.stack([x, x])), np.ones(2, bool))
    parameters = {name: np.array([float(value), np.nan]) for name, value in known.items()}
    density = FAMILIES[family].log_density(points, parameters)
    assert np.isfinite(density[0]).all()
    assert np.isnan(density[1]).all()


@pytest.mark.parametrize("family", ["gamma", "lognormal", "weibull"])
def test_nearly_equal_samples_have_near_quantiles(family):
    x = 1 + 1e-5 * np.random.default_rng(0).random(400)
    found, q = chd.fit.fit(x, family), np.array([0.01, 0.5, 0.99])
    np.testing.assert_allclose(found.cdf(found.ppf(q)), q, rtol=1e-6)
