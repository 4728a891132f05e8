"""Mixtures: known answers, scikit-learn's likelihood, laws of likelihood, pixels that have none."""

import numpy as np
import pytest
from scipy import integrate, stats
from sklearn.mixture import GaussianMixture

import chdstat as chd
from chdstat._core.positive import PositivePart
from chdstat.errors import Reason
from chdstat.fit import mixture
from chdstat.fit.atoms import split
from chdstat.fit.em import COMPONENTS, bound_at, penalty, run
from chdstat.fit.groups import groups_of_each, groups_of_samples
from chdstat.fit.search import segmentations, sums_below

FAMILIES = ("lognormal", "gamma")


def two_lights(rng, shape, share=0.3):
    indirect = rng.lognormal(-4, 0.8, size=shape)
    return np.where(rng.random(shape) < share, indirect, rng.lognormal(0, 0.5, size=shape))


def two_gammas(rng, shape, share=0.4):
    return np.where(
        rng.random(shape) < share, 0.01 * rng.gamma(2.0, size=shape), rng.gamma(5.0, size=shape)
    )


def renders(rng, rows, spp):
    """Rows as renders have them: lobes of any width, spikes, far outliers, few samples."""
    x = np.empty((rows, spp))
    for row in x:
        k = rng.integers(1, 5)
        which = rng.choice(k, size=spp, p=rng.dirichlet(np.ones(k)))
        spread = 10.0 ** rng.uniform(-2.5, 0.3, size=k)
        row[:] = np.exp(rng.normal(rng.normal(scale=2.5, size=k)[which], spread[which]))
    x[1::4, :2] *= 1e-9
    x[2::4, : spp // 2] = 0
    return rng.permuted(x, axis=-1)


def logarithms(x):
    """Return the logarithms of the positive samples of each row, ascending, and their number."""
    x = np.where(x > 0, x, np.inf)
    return np.log(np.sort(x, axis=-1)), np.isfinite(x).sum(axis=-1)


def density(result, row, x, family):
    mixed = np.zeros_like(x)
    for j in range(int(result.k[row])):
        at = {name: values[row, j] for name, values in result.parameters.items()}
        one = (
            stats.lognorm(at["sigma"], scale=np.exp(at["mu"]))
            if family == "lognormal"
            else stats.gamma(at["shape"], scale=at["scale"])
        )
        mixed += result.weights[row, j] * one.pdf(x)
    return mixed


# --- known answers ------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_one_component_is_the_fit_of_the_family(family):
    x = np.random.default_rng(1).gamma(1.7, size=(20, 300))
    x[:, ::3] = 0
    one, expected = mixture(x, 1, family=family), chd.fit.fit(x, family)
    np.testing.assert_allclose(one.log_likelihood, expected.log_likelihood, rtol=1e-9)
    np.testing.assert_allclose(one.bic, expected.bic, rtol=1e-9)
    np.testing.assert_allclose(one.aic, expected.aic, rtol=1e-9)
    for name, values in expected.parameters.items():
        np.testing.assert_allclose(one.parameters[name][:, 0], values, rtol=1e-6)
    np.testing.assert_array_equal(one.weights, 1)


TRUTH = {
    "lognormal": (two_lights, {"mu": (-4, 0), "sigma": (0.8, 0.5), "weight": (0.3, 0.7)}),
    "gamma": (two_gammas, {"shape": (2, 5), "scale": (0.01, 1), "weight": (0.4, 0.6)}),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_parameters_of_two_components_are_recovered(family):
    """Z-scores over 300 rows: median within 5/sqrt(300), sd within 25 % (by chance: < 1e-3)."""
    draw, truth = TRUTH[family]
    result = mixture(draw(np.random.default_rng(3), (300, 1024)), 2, family=family)
    known = result.error_reason == Reason.OK
    assert known.mean() > 0.9
    for name, values in truth.items():
        found = result.weights if name == "weight" else result.parameters[name]
        z = ((found - values) / result.standard_errors[name])[known]
        np.testing.assert_allclose(np.median(z, axis=0), 0, atol=0.35)
        np.testing.assert_allclose(z.std(axis=0), 1, atol=0.25)


@pytest.mark.parametrize("k", [2, 3])
def test_likelihood_is_at_least_that_of_scikit_learn(k):
    """On 99 % of the pixels; here 60 made-up ones, so one miss is allowed.

    Theirs may have a component of a single sample, which ours may not.
    """
    x = renders(np.random.default_rng(4), 60, 256)
    gain = mixture(x, k).log_likelihood - mixture(x, 1).log_likelihood
    missed = 0
    for row, of_all in zip(x, gain, strict=True):
        y = np.log(row[row > 0])[:, np.newaxis]
        theirs = GaussianMixture(k, n_init=5, random_state=0).fit(y)
        best = theirs.score(y) if theirs.weights_.min() * len(y) > 1.5 else -np.inf
        one = stats.norm(y.mean(), y.std()).logpdf(y).mean()
        missed += of_all / len(y) < best - one - 1e-3
    assert missed <= 1


def test_bic_chooses_the_number_of_components():
    """Rows with the right number: at least 90 %."""
    x = two_lights(np.random.default_rng(5), (100, 512))
    assert (mixture(x).k == 2).mean() > 0.9
    one = np.random.default_rng(6).lognormal(size=(100, 512))
    assert (mixture(one).k == 1).mean() > 0.9


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("n", [16, 64])
def test_one_law_has_one_component(n, family):
    """More are found in at most 5 %: 9 % of 500 rows by chance with less than 1e-4.

    The control: two lights are told apart.
    """
    rng = np.random.default_rng(27)
    x = rng.lognormal(size=(500, n)) if family == "lognormal" else rng.gamma(2, size=(500, n))
    assert (mixture(x, family=family).k > 1).mean() < 0.09
    null = np.zeros((500, 15 * n))
    assert (mixture(np.c_[x, null], family=family).k > 1).mean() < 0.09
    assert (mixture(two_lights(rng, (100, 64)), family="lognormal").k > 1).mean() > 0.9


@pytest.mark.parametrize(
    ("n", "share", "distance"), [(512, 0.3, 3), (512, 0.3, 5), (128, 0.3, 5), (2048, 0.1, 5)]
)
def test_errors_hold_or_are_missing(n, share, distance):
    """Intervals of 95 % hold in 90 to 99 % where they are known; 4 deviations of 300 rows are 7 %.

    The control: of components that overlap, few have errors.
    """
    rng = np.random.default_rng(28)

    def drawn(n, share, distance):
        return np.exp(rng.normal(size=(300, n)) + distance * (rng.random((300, n)) < share))

    result = mixture(drawn(n, share, distance))
    for name, truth in (("mu", (0, distance)), ("sigma", (1, 1)), ("weight", (1 - share, share))):
        values = result.weights if name == "weight" else result.parameters[name]
        error = result.standard_errors[name][:, :2]
        known = np.isfinite(error) & (result.k == 2)[:, np.newaxis]
        held = (np.abs(values[:, :2] - truth) < 1.96 * error)[known]
        assert held.size < 40 or held.mean() > 0.83
        assert held.size > 40 or (name == "sigma" and n == 128)
    overlapping = mixture(drawn(128, share, 3))
    missing = np.isnan(overlapping.standard_errors["mu"]).all(axis=-1)
    assert (overlapping.error_reason[missing] > 0).all()
    assert (overlapping.error_reason[overlapping.k == 2] == 0).mean() < 0.2


# --- laws ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_the_likelihood_is_that_of_the_density(family):
    x = two_lights(np.random.default_rng(8), (5, 200))
    x[:, :50] = 0
    result = mixture(x, family=family)
    for row in range(5):
        positive = np.log(density(result, row, x[row, 50:], family)).sum()
        zeros = 50 * np.log(0.25) + 150 * np.log(0.75)
        assert result.log_likelihood[row] == pytest.approx(positive + zeros, rel=1e-9)
    # Components beyond the first cost as if there were 160 samples at least.
    penalty = 2 * np.log(150) + 3 * (result.k - 1) * np.log(160) + np.log(200)
    np.testing.assert_allclose(result.bic, penalty - 2 * result.log_likelihood)
    at = result.k[:, np.newaxis] - 1
    np.testing.assert_allclose(result.bic, np.take_along_axis(result.bics, at, -1)[:, 0])


@pytest.mark.parametrize("family", FAMILIES)
def test_more_components_are_never_less_likely(family):
    x = renders(np.random.default_rng(9), 40, 200)
    likelihoods = [mixture(x, k, family=family).log_likelihood for k in (1, 2, 3)]
    assert (np.diff(likelihoods, axis=0) > -1e-4 * x.shape[-1]).all()


@pytest.mark.parametrize("family", FAMILIES)
@np.errstate(all="ignore")
def test_every_cycle_raises_the_penalised_bound(family):
    ascending = logarithms(renders(np.random.default_rng(10), 40, 300))
    kind = COMPONENTS[family]
    for groups in (groups_of_samples(*ascending), groups_of_each(*ascending)):
        state = next(segmentations(groups, kind, sums_below(groups, kind), 3))

        def penalised(state, groups=groups):
            bound = bound_at(groups, kind, state)
            return bound + penalty(kind, state, groups.spacing)

        before = penalised(state)
        for _ in range(10):
            state = run(groups, kind, state, cycles=1, tolerance=0.0).state
            after = penalised(state)
            assert (after >= before - 1e-7 * np.abs(before)).all()
            before = after


def test_cells_bound_the_likelihood_from_below():
    x = two_lights(np.random.default_rng(11), (30, 2000))
    ascending, n = logarithms(x)
    kind = COMPONENTS["lognormal"]
    groups, singles = groups_of_samples(ascending, n), groups_of_each(ascending, n)
    np.testing.assert_allclose(groups.n, n)
    np.testing.assert_allclose((groups.count * groups.log).sum(axis=0), singles.log.sum(axis=0))
    np.testing.assert_allclose(
        (groups.count * groups.square).sum(axis=0), singles.square.sum(axis=0)
    )
    state = next(segmentations(groups, kind, sums_below(groups, kind), 2))
    loss = (bound_at(singles, kind, state) - bound_at(groups, kind, state)) / n
    assert (loss > 0).all()
    assert loss.max() < 5e-3
    assert len(groups.count) < 80


@pytest.mark.parametrize("family", FAMILIES)
def test_methods_agree_with_each_other(family):
    """Mean of 2e4 draws within 4.5 standard errors: fails by chance with 1e-5."""
    x = np.concatenate([two_lights(np.random.default_rng(14), 700), np.zeros(300)])
    result = mixture(x, family=family)
    assert result.zero_share == pytest.approx(0.3)
    total = integrate.quad(lambda t: float(result.pdf(np.exp(t)) * np.exp(t)), -15, 6, limit=200)
    assert total[0] == pytest.approx(1, abs=1e-6)
    q = np.array([0.31, 0.5, 0.9, 0.999])
    np.testing.assert_allclose(result.cdf(result.ppf(q)), q, rtol=1e-9)
    np.testing.assert_array_equal(result.ppf([0.0, 0.2, 1.0]), [0, 0, np.inf])
    assert result.cdf(-1.0) == 0
    drawn = result.rvs(20_000, seed=1)
    assert drawn.mean() == pytest.approx(
        float(result.mean()), abs=4.5 * drawn.std() / np.sqrt(drawn.size)
    )
    assert stats.kstest(drawn[drawn > 0], lambda v: (result.cdf(v) - 0.3) / 0.7).pvalue > 1e-4


def test_batches_come_in_any_shape():
    x = two_lights(np.random.default_rng(15), (2, 3, 300))
    result = mixture(x)
    assert result.weights.shape == (2, 3, 3)
    assert result.pdf(np.ones((4, 5))).shape == (2, 3, 4, 5)
    assert result.ppf([0.1, 0.2]).shape == (2, 3, 2)
    assert result.rvs(7, seed=1).shape == (2, 3, 7)
    np.testing.assert_allclose(result.bic[1, 2], mixture(x[1, 2]).bic)


# --- histograms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_bins_nearly_keep_the_likelihood(family):
    """Within 1e-2 per sample, where components are no narrower than a bin (0.23 in log x)."""
    rng = np.random.default_rng(16)
    x = np.concatenate([two_lights(rng, (15, 1000)), two_gammas(rng, (15, 1000))])
    of_samples = mixture(x, 2, family=family)
    of_bins = mixture(chd.histogram(x), 2, family=family)
    for row in range(len(x)):
        lost = np.log(density(of_samples, row, x[row], family)).mean()
        lost -= np.log(density(of_bins, row, x[row], family)).mean()
        assert lost < 1e-2
    np.testing.assert_allclose(
        of_bins.log_likelihood / 1000, of_samples.log_likelihood / 1000, atol=0.03
    )


def test_a_component_in_one_bin_gets_the_width_of_a_bin():
    rng = np.random.default_rng(17)
    x = np.where(rng.random(2000) < 0.5, 1.06, rng.lognormal(-5, 0.7, size=2000))
    result = mixture(chd.histogram(x))
    bin_width = 0.1 * np.log(10)
    assert result.k == 2
    assert result.parameters["sigma"][1] == pytest.approx(0.275 * bin_width, rel=0.01)


# --- hard pixels --------------------------------------------------------------------------------


def test_an_atom_is_no_component():
    rng = np.random.default_rng(18)
    x = np.where(rng.random((20, 300)) < 0.4, 1.0, rng.lognormal(-3, 0.5, size=(20, 300)))
    x[:, :30] = 0
    result = mixture(x.astype(np.float32))
    np.testing.assert_array_equal(result.k, 1)
    np.testing.assert_array_equal(result.atoms[:, 0], 1)
    np.testing.assert_allclose(result.atom_weights[:, 0], (x == 1).sum(axis=-1) / 270)
    assert np.isnan(result.atoms[:, 1:]).all()
    np.testing.assert_allclose(result.parameters["mu"][:, 0], -3, atol=0.25)


def test_atoms_belong_to_the_model():
    """Mean of 2e4 draws within 4.5 standard errors: fails by chance with 1e-5."""
    rng = np.random.default_rng(19)
    x = np.where(rng.random(1000) < 0.2, 5.0, two_lights(rng, 1000))
    x[:200] = 0
    result = mixture(x)
    share = (x == 5).sum() / 800
    assert float(result.cdf(5.0) - result.cdf(np.nextafter(5, 0))) == pytest.approx(0.8 * share)
    total = integrate.quad(lambda t: float(result.pdf(np.exp(t)) * np.exp(t)), -15, 6, limit=200)
    assert total[0] == pytest.approx(1 - share, abs=1e-6)
    middle = float(result.cdf(5.0)) - 0.4 * share
    assert float(result.ppf(middle)) == pytest.approx(5, rel=1e-12)
    assert float(result.ppf(1.0)) == np.inf
    drawn = result.rvs(20_000, seed=1)
    assert (drawn == 5).mean() == pytest.approx(0.8 * share, abs=0.02)
    assert float(result.mean()) == pytest.approx(
        drawn.mean(), abs=4.5 * drawn.std() / np.sqrt(drawn.size)
    )
    rest = mixture(x[x != 5])
    for name, values in rest.parameters.items():
        np.testing.assert_array_equal(result.parameters[name], values)


def test_the_likelihood_tells_atoms_from_the_rest():
    rng = np.random.default_rng(20)
    x = np.where(rng.random(400) < 0.1, 2.0, rng.lognormal(size=400))
    result, rest = mixture(x, 1), mixture(x[x != 2], 1)
    n, held = 400, (x == 2).sum()
    among = held * np.log(held / n) + (n - held) * np.log(1 - held / n)
    assert result.log_likelihood == pytest.approx(float(rest.log_likelihood) + among)


@pytest.mark.parametrize(
    "round_",
    [
        lambda x: rounded(x, 5),
        lambda x: rounded(x, 8) * 0.7,
        lambda x: np.ceil(20 * x) / 20,
        lambda x: np.round(255 * np.minimum(x / 30, 1) ** (1 / 2.2)) ** 2.2 + 1e-3,
        lambda x: np.exp(np.round(np.log(x), 1)),
    ],
    ids=["5 bits", "8 bits, scaled", "even steps", "8-bit gamma", "even in the logarithm"],
)
def test_rounding_makes_neither_components_nor_atoms(round_):
    """At most 15 % of 100 rows: with a chance of 5 % or less each, fails in 2e-4 at most."""
    x = round_(np.random.default_rng(22).lognormal(0.3, 0.5, size=(100, 600)))
    result = mixture(x, effort="fast")
    assert (result.k > 1).mean() <= 0.15
    assert (result.k == 1).mean() > 0.8
    assert np.isfinite(result.atoms[:, 0]).mean() <= 0.15


def rounded(x, bits):
    mantissa, exponent = np.frexp(x)
    return np.ldexp(np.round(mantissa * 2.0**bits) / 2.0**bits, exponent)


def test_rounding_keeps_components():
    x = two_lights(np.random.default_rng(23), (40, 512))
    one, other = mixture(x, 2), mixture(rounded(x, 7), 2)
    np.testing.assert_allclose(other.weights, one.weights, atol=5e-3)
    np.testing.assert_allclose(
        other.parameters["mu"][:, :2], one.parameters["mu"][:, :2], atol=0.03
    )
    np.testing.assert_array_equal(mixture(rounded(x, 7)).k, mixture(x).k)


def test_spread_values_stay_in_order():
    x = rounded(np.random.default_rng(24).lognormal(size=(30, 400)), 6)
    x[:, ::7] = 0
    atoms = split(PositivePart.of(x))
    assert atoms.tied.all()
    rest = atoms.rest
    assert ((x > 0) >= rest.positive).all()
    np.testing.assert_array_equal(rest.n + atoms.counts.sum(axis=-1), (x > 0).sum(axis=-1))
    for row in range(30):
        kept = rest.positive[row]
        was, now = x[row, kept], rest.x[row, kept]
        order = np.argsort(now)
        assert (np.diff(was[order]) >= 0).all()
        assert len(np.unique(now)) == len(now)


FEW_VALUES = {
    "two": np.repeat([1.0, 2.0], 20),
    "three": np.repeat([1.0, 2.0, 2.5], 20),
    "uneven": np.repeat([1.0, 1.05, 1.3, 4.0, 4.1, 9.0], 30),
    "ten uneven": np.repeat(np.random.default_rng(26).lognormal(size=10), 25),
}


@pytest.mark.parametrize("name", FEW_VALUES)
@pytest.mark.parametrize("family", FAMILIES)
def test_a_few_values_have_no_components(name, family):
    x = FEW_VALUES[name]
    result = mixture(x, family=family)
    assert result.reason == Reason.TIED
    assert result.k == 0
    values = np.unique(x)
    if len(values) <= 8:
        np.testing.assert_array_equal(np.sort(result.atoms[: len(values)]), values)
        assert result.atom_weights.sum() == pytest.approx(1)


def test_three_samples_tell_no_components():
    x = np.r_[1.0, 2.0, 4.0, np.zeros(60)]
    assert mixture(x).reason == Reason.TOO_FEW
    assert mixture(x).k == 0
    assert mixture(x, 1).k == 1
    assert mixture(x, max_k=1).k == 1


def test_more_components_than_samples_or_values():
    assert mixture([1.0, 2.0, 3.0, 4.0], 2).reason == Reason.TOO_FEW
    assert mixture(np.r_[np.linspace(1, 2, 7), 0, 0], 3).reason == Reason.TOO_FEW
    assert mixture(np.r_[np.linspace(1, 2, 8), 0, 0], 3).reason == Reason.OK


@pytest.mark.parametrize("family", FAMILIES)
def test_a_histogram_of_few_bins(family):
    x = np.repeat([1.0, 10.0, 20.0], 20)
    x[:20] = np.linspace(1, 1.2, 20)
    result = mixture(chd.histogram(np.stack([x, np.repeat([1.0, 10.0], 30)])), family=family)
    np.testing.assert_array_equal(result.reason, Reason.OK)
    assert np.isfinite(result.log_likelihood).all()
    assert np.isnan(result.bics[1, 2])
    alone = mixture(chd.histogram(np.repeat([1.0, 10.0], 30)), family=family)
    assert alone.k == 2
