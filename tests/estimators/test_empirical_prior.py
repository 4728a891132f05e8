"""The empirical prior: posteriors that are known in closed form, its laws, and its hard pixels."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators._sample_bins import SampleBins
from chdstat.estimators._topics import topic_histograms
from chdstat.estimators.empirical_prior import EmpiricalPrior
from chdstat.estimators.heldout import draw_pixels

SIDE, SPP = 20, 512


def coins(levels, spp=4096):
    """Return pixels of one channel whose samples are 1 with the given probabilities, exactly."""
    lit = np.arange(spp) < np.round(levels * spp)[..., np.newaxis]
    return chd.Samples.from_array(np.random.default_rng(0).permuted(lit.astype(float), axis=-1))


def batch_of(successes, n=32):
    """Return samples (batch, channel, n) of which so many are 1, the others null."""
    return (np.arange(n) < np.asarray(successes)[:, np.newaxis]).astype(float)[:, np.newaxis]


def picture(seed=0, side=SIDE, spp=SPP):
    """Return coloured pixels of many brightnesses, half of their samples null."""
    rng = np.random.default_rng(seed)
    level = rng.lognormal(size=(side, side, 1, 1)) * rng.choice(
        [[1.0, 0.8, 0.3], [0.5, 0.8, 1.0]], size=(side, side)
    ).reshape(side, side, 3, 1)
    lit = rng.random((side, side, 1, spp)) < 0.5
    return level * lit * rng.gamma(2.0, size=(side, side, 1, spp))


@pytest.fixture(scope="module")
def prior():
    return EmpiricalPrior.of(chd.Samples.from_array(picture()), strength=1000)


@pytest.fixture(scope="module")
def batches():
    return picture()[:8, :8, :, :32]


@pytest.fixture(scope="module")
def beta_prior():
    """Return a prior whose pixels are lit with a probability that is Beta(2, 3) distributed."""
    levels = stats.beta(2, 3).ppf((np.arange(400) + 0.5) / 400).reshape(20, 20)
    return EmpiricalPrior.of(coins(levels), strength=0, between=0)


def test_of_beta_distributed_null_shares_the_posterior_is_beta(beta_prior):
    k = np.array([0, 1, 5, 16, 24])
    found = beta_prior.posterior(batch_of(k), shares=[0.05, 0.5, 0.95])
    truth = stats.beta(2 + k, 3 + 32 - k)
    assert found.mean[:, 0] == pytest.approx(truth.mean(), abs=0.003)
    assert found.sd[:, 0] == pytest.approx(truth.std(), rel=0.05)
    expected = truth.ppf([[0.05], [0.5], [0.95]]).T
    assert found.quantiles[:, 0] == pytest.approx(expected, abs=0.01)


def test_the_evidence_is_beta_binomial(beta_prior):
    k = np.array([0, 5, 16, 24])
    found = beta_prior.posterior(batch_of(k)).log_evidence
    one_order = stats.betabinom(32, 2, 3).logpmf(k) - np.log(stats.binom(32, 0.5).pmf(k) * 2.0**32)
    assert found == pytest.approx(one_order, abs=0.05)


def test_without_samples_to_tell_the_posterior_is_the_prior(beta_prior):
    found = beta_prior.posterior(np.array([[[1.0]], [[0.0]]]))
    assert found.mean[:, 0] == pytest.approx([3 / 6, 2 / 6], abs=0.003)


@pytest.mark.parametrize("relative", [0.0, 0.5, 1.0])
def test_the_mean_minimises_the_expected_loss(beta_prior, relative):
    k = np.array([3])
    found = beta_prior.posterior(batch_of(k), relative=relative).mean[0, 0]
    p = np.linspace(0.0005, 0.9995, 1000)
    weight = stats.beta(2 + 3, 3 + 29).pdf(p) / (p**2 + 0.01 * 0.4**2) ** relative
    candidates = np.linspace(0, 1, 2001)
    loss = ((candidates[:, np.newaxis] - p) ** 2 * weight).sum(axis=-1)
    assert found == pytest.approx(candidates[loss.argmin()], abs=0.003)


def test_gamma_distributed_brightness_of_poisson_samples():
    """Poisson samples with a Gamma(3, scale 2) level have a Gamma(3 + sum, 2 / (1 + 2 n)) one.

    Histograms of 4000 samples are the only noise: the bound is five times what was seen.
    """
    rng = np.random.default_rng(1)
    levels = stats.gamma(3, scale=2).ppf((np.arange(400) + 0.5) / 400).reshape(20, 20, 1)
    scene = chd.Samples.from_array(rng.poisson(levels, size=(20, 20, 4000)).astype(float))
    x = rng.poisson(5.0, size=(50, 1, 8)).astype(float)
    found = EmpiricalPrior.of(scene, strength=0, between=0).posterior(x).mean[:, 0]
    truth = (3 + x.sum(axis=(1, 2))) * 2 / (1 + 2 * 8)
    assert found == pytest.approx(truth, rel=0.05)


def test_it_beats_the_mean_on_other_pixels_of_its_scene():
    """Errors are about half of the mean's; that they are not below 0.8 has a chance < 1e-6."""
    x = np.sqrt(picture())
    pixels = draw_pixels((SIDE, SIDE), 200, seed=0)
    prior = EmpiricalPrior.of(chd.Samples.from_array(x), pixels=pixels)
    test = np.ones((SIDE, SIDE), bool)
    test[tuple(pixels.T)] = False
    y, x = x[test].mean(axis=-1), x[test][..., :8]
    for relative in (0.0, 1.0):
        weight = (y**2 + 0.01 * y.mean(axis=0) ** 2) ** -relative
        found = prior.posterior(x, relative=relative).mean
        error = (weight * (found - y) ** 2).mean()
        assert error < 0.8 * (weight * (x.mean(axis=-1) - y) ** 2).mean()


def test_a_pixel_that_is_left_out_does_not_count():
    levels = np.full((6, 6), 0.25)
    levels[2, 3] = 0.75
    prior = EmpiricalPrior.of(coins(levels), strength=0)
    x = batch_of([24])
    assert prior.posterior(x).mean[0, 0] == pytest.approx(0.75, abs=0.01)
    # Neither the pixel nor what lies between it and its neighbours.
    without = prior.posterior(x, exclude=2 * 6 + 3)
    assert without.mean[0, 0] == pytest.approx(0.25, abs=1e-6)
    assert without.sd[0, 0] == pytest.approx(0, abs=1e-6)
    assert without.effective_atoms[0] <= 35 + 1e-6
    other = prior.posterior(x, exclude=0)
    assert other.mean[0, 0] == pytest.approx(0.75, abs=0.01)


def test_leaving_out_is_the_same_as_never_having_had_the_pixel(batches):
    samples = chd.Samples.from_array(picture())
    pixels = np.argwhere(np.ones((SIDE, SIDE)))
    options = {"strength": 0, "between": 0}
    whole = EmpiricalPrior.of(samples, **options)
    less = EmpiricalPrior.of(samples, pixels=pixels[1:], **options)
    found, expected = whole.posterior(batches[0, 0], exclude=0), less.posterior(batches[0, 0])
    assert found.mean == pytest.approx(expected.mean, rel=0.02)
    # The unit of the bins is that of the scene and hardly moves, but some samples change bins.
    assert found.effective_atoms == pytest.approx(expected.effective_atoms, rel=0.3)


def test_edges_of_light_have_atoms_between():
    levels = np.full((8, 8), 0.1)
    levels[:, 4:] = 0.9
    without, with_ = (EmpiricalPrior.of(coins(levels), between=b) for b in (0.0, 0.2))
    x = batch_of([16])
    assert abs(without.posterior(x).mean[0, 0] - 0.5) > 0.05 or without.posterior(x).sd[0, 0] > 0.3
    assert with_.posterior(x).mean[0, 0] == pytest.approx(0.5, abs=0.02)
    assert with_.posterior(x).log_evidence > without.posterior(x).log_evidence


def test_the_order_of_samples_does_not_matter(prior, batches):
    shuffled = np.random.default_rng(3).permutation(batches, axis=-1)
    assert prior.posterior(shuffled).mean == pytest.approx(prior.posterior(batches).mean, rel=1e-9)


def test_scaling_the_radiance_scales_the_posterior(prior, batches):
    for scale in (2.0**-80, 2.0**90):
        scaled = EmpiricalPrior.of(chd.Samples.from_array(scale * picture()), strength=1000)
        found = scaled.posterior(scale * batches, relative=1.0, shares=[0.5])
        expected = prior.posterior(batches, relative=1.0, shares=[0.5])
        assert found.mean == pytest.approx(scale * expected.mean, rel=1e-5)
        assert found.sd == pytest.approx(scale * expected.sd, rel=1e-5)
        assert found.quantiles == pytest.approx(scale * expected.quantiles, rel=1e-5)


def test_the_same_seed_gives_the_same_prior(prior, batches):
    again = EmpiricalPrior.of(chd.Samples.from_array(picture()), strength=1000, seed=0)
    other = EmpiricalPrior.of(chd.Samples.from_array(picture()), strength=1000, seed=1)
    assert (again.posterior(batches).mean == prior.posterior(batches).mean).all()
    assert (other.posterior(batches).mean != prior.posterior(batches).mean).any()


def test_a_batch_alone_and_among_others(prior, batches):
    many = prior.posterior(batches, shares=[0.1, 0.9])
    one = prior.posterior(batches[2, 3], shares=[0.1, 0.9])
    assert many.mean.shape == many.sd.shape == (8, 8, 3)
    assert many.quantiles.shape == (8, 8, 3, 2)
    assert many.effective_atoms.shape == many.log_evidence.shape == (8, 8)
    assert one.mean == pytest.approx(many.mean[2, 3], rel=1e-5)
    assert one.quantiles == pytest.approx(many.quantiles[2, 3], rel=1e-5)
    assert prior.posterior(np.ones((0, 3, 32))).mean.shape == (0, 3)


@pytest.mark.parametrize("n", [1, 2, 300])
def test_any_number_of_samples(prior, n):
    found = prior.posterior(picture(seed=4)[..., :n])
    assert np.isfinite(found.mean).all()
    assert (found.effective_atoms >= 1 - 1e-6).all()


def test_samples_that_no_pixel_ever_showed_still_have_a_posterior(prior):
    x = np.full((2, 3, 4), 1e30)
    x[1] = 5e-324
    found = prior.posterior(x)
    assert np.isfinite(found.mean).all()
    assert np.isfinite(found.log_evidence).all()


def test_null_batches_are_explained_by_dark_pixels(prior):
    dark = np.zeros((SIDE, SIDE, 3, SPP))
    dark[::2] = picture()[::2]
    found = EmpiricalPrior.of(chd.Samples.from_array(dark)).posterior(np.zeros((3, 32)))
    assert (found.mean < 1e-3).all()
    black = EmpiricalPrior.of(chd.Samples.from_array(np.zeros((3, 3, 3, 64))))
    assert (black.posterior(np.zeros((3, 8)), relative=1.0).mean == 0).all()


def test_bad_samples_are_left_out_whole(prior, batches):
    x = np.concatenate([batches, np.ones((8, 8, 3, 3))], axis=-1)
    x[..., 0, -1], x[..., 1, -2], x[..., 2, -3] = np.nan, -1.0, np.inf
    assert prior.posterior(x).mean == pytest.approx(prior.posterior(batches).mean, rel=1e-5)


def test_where_no_whole_sample_is_good_the_mean_of_a_channel_stands_in(prior):
    x = np.ones((3, 4))
    x[0] = np.nan
    found = prior.posterior(x, shares=[0.5])
    for values in (found.mean, found.sd, found.quantiles, found.effective_atoms):
        assert np.isnan(values).all()
    assert np.isnan(found.log_evidence)
    assert prior.predict(x)[1:] == pytest.approx([1, 1])
    assert np.isnan(prior.predict(x)[0])


def test_pixels_with_bad_samples_are_atoms_of_their_good_ones(batches):
    x = picture().astype(np.float32)
    x[0, 0] = np.nan
    x[1, 1, 2, :100] = -1
    prior = EmpiricalPrior.of(chd.Samples.from_array(x), strength=1000)
    assert len(prior.train_pixels) == SIDE**2 - 1
    assert prior.train_pixels[0].tolist() == [0, 1]
    assert np.isfinite(prior.posterior(batches).mean).all()


def test_the_only_pixel_left_out_leaves_nothing():
    prior = EmpiricalPrior.of(chd.Samples.from_array(np.ones((1, 1, 3, 8))))
    assert np.isnan(prior.posterior(np.ones((3, 4)), exclude=0).mean).all()
    assert prior.posterior(np.ones((3, 4))).mean == pytest.approx([1, 1, 1], rel=1e-6)


def test_log_normal_pixels_are_as_well_described_by_mixtures_as_by_histograms():
    """Both come within 10 % of the closed form on average, where samples are log-normal."""
    rng = np.random.default_rng(5)
    mu = stats.norm.ppf((np.arange(256) + 0.5) / 256).reshape(16, 16, 1)
    scene = chd.Samples.from_array(np.exp(rng.normal(mu, 1.0, size=(16, 16, 512))))
    y = rng.normal(0.5, 1.0, size=(64, 1, 8))
    post = y.sum(axis=(1, 2)) / 9
    truth = np.exp(post + 0.5 / 9 + 0.5)
    for density in ("histogram", "lognormal"):
        prior = EmpiricalPrior.of(scene, density=density, between=0)
        found = prior.posterior(np.exp(y)).mean[:, 0]
        assert np.mean(np.abs(np.log(found / truth))) < 0.1


def test_it_offers_what_a_model_does(prior, batches):
    assert prior.name == "empirical_prior"
    assert prior.train_shape == (SIDE, SIDE)
    assert (prior.train_pixels == np.argwhere(np.ones((SIDE, SIDE)))).all()
    assert prior.provenance["pixels_used"] == SIDE**2
    assert prior.provenance["strength"] == 1000
    assert (prior.predict(batches) == prior.posterior(batches).mean).all()
    assert repr(prior) == "<EmpiricalPrior scene 'samples', 400 pixels>"
    entry = chd.estimators.registry.lookup("empirical_prior")
    pixels = draw_pixels((SIDE, SIDE), 50, seed=0)
    model = entry.train(chd.Samples.from_array(picture()), seed=0, pixels=pixels, progress=False)
    assert (model.train_pixels == pixels).all()
    assert model.inputs == entry.inputs == 32


def test_bins_tell_luminance_and_hue_apart():
    bins = SampleBins(1.0, 3)
    x = np.array([[0, 1, 2, 1.0], [0, 1, 1, 1], [0, 1, 1, np.nan]]).reshape(1, 3, 4)
    counts = bins.counts(x)[0]
    assert counts[: bins.narrow].sum() == 3
    assert counts[0] == 1
    assert bins.by_cell(counts).sum() == 2
    assert np.count_nonzero(counts) == 5
    edges = bins.luminance_edges
    assert len(edges) == bins.narrow
    assert (np.diff(edges) > 0).all()
    single = SampleBins(1.0, 1).counts(np.array([[[0.0, 0.99, 1.01]]]))[0]
    assert np.flatnonzero(single).tolist() == [0, *(np.searchsorted(edges, [0.99, 1.01]))]


def test_topics_are_found_again():
    rng = np.random.default_rng(0)
    truth = rng.dirichlet(np.full(40, 0.1), size=3)
    share = rng.dirichlet(np.ones(3), size=300)
    counts = rng.multinomial(200, share @ truth).astype(np.float32)
    found = topic_histograms(counts, topics=3, iterations=100, rng=rng)
    assert found.sum(axis=-1) == pytest.approx(np.ones(300), rel=1e-5)
    assert (found[:, counts.sum(axis=0) > 0] > 0).all()
    error = np.abs(found - share @ truth).sum(axis=-1).mean()
    assert error < 0.5 * np.abs(counts / 200 - share @ truth).sum(axis=-1).mean()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"between": 1.0}, "between"),
        ({"strength": -1.0}, "strength"),
        ({"strength": np.nan}, "strength"),
        ({"density": "normal"}, "density"),
        ({"pixels": [[0, 99]]}, "outside"),
        ({"pixels": [[0, 0], [0, 0]]}, "differ"),
        ({"pixels": [0.5, 1]}, "rows"),
        ({"pixels": np.zeros((0, 2), int)}, "rows"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        EmpiricalPrior.of(chd.Samples.from_array(np.ones((2, 2, 3, 8))), **options)


def test_pictures_that_make_no_prior_are_refused():
    with pytest.raises(InputError, match="good sample"):
        EmpiricalPrior.of(chd.Samples.from_array(np.full((2, 2, 3, 8), np.nan)))
    with pytest.raises(InputError, match="1 or 3 channels"):
        EmpiricalPrior.of(chd.Samples.from_array(np.ones((2, 2, 4, 8))))


@pytest.mark.parametrize(
    ("x", "options", "message"),
    [
        (np.ones((2, 8)), {}, "shape"),
        (np.ones(8), {}, "shape"),
        (np.ones((3, 8)), {"relative": 1.5}, "relative"),
        (np.ones((3, 8)), {"shares": [2.0]}, "shares"),
        (np.ones((5, 3, 8)), {"exclude": [1, 2]}, "exclude"),
    ],
)
def test_batches_that_do_not_fit_are_refused(prior, x, options, message):
    with pytest.raises(InputError, match=message):
        prior.posterior(x, **options)
