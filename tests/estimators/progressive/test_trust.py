"""Trust without a reference: a network that learned nothing of use leaves the means alone."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import Progressive
from chdstat.estimators.progressive.error_model import between_sizes
from chdstat.estimators.progressive.shrinkage import (
    GROUPS,
    checked_shares,
    own_shares,
    shares_keeping_mean,
    shrinkage_factor,
)


def moves(rng, share, *, pixels=300, draws=4):
    """Return moves from the mean of which `share` of their length would be best."""
    mean = rng.lognormal(size=(pixels, 3))
    move = 0.5 * mean * rng.normal(size=mean.shape)
    noise = [0.5 * mean * rng.normal(size=mean.shape) for _ in range(draws)]
    return (
        np.tile(np.arange(pixels), draws),
        np.tile(mean, (draws, 1)),
        np.tile(np.maximum(mean + move, 0), (draws, 1)),
        np.concatenate([mean + share * move + one for one in noise]),
        np.tile((0.5 * mean) ** 2, (draws, 1)),
    )


def test_what_pays_is_followed_and_what_does_not_is_not():
    rng = np.random.default_rng(0)
    assert min(own_shares(*moves(rng, 1.0))) > 0.9
    assert own_shares(*moves(rng, 0.4)) == pytest.approx((0.45, 0.45), abs=0.2)
    assert shrinkage_factor([moves(rng, 0.4)]) == pytest.approx(0.35, abs=0.2)
    for none in (0.0, -1.0):
        assert own_shares(*moves(rng, none)) == (0, 0)
        assert shrinkage_factor([moves(rng, none)]) == 0


def test_one_pixel_and_no_move_are_no_evidence():
    rng = np.random.default_rng(1)
    rows, mean, _, *others = moves(rng, 1.0)
    for none in (moves(rng, 1.0, pixels=1), (rows, mean, mean, *others)):
        assert own_shares(*none) == (0, 0)
        assert shrinkage_factor([none]) == 0


@pytest.mark.parametrize("scatter", [0.0, 1.0])
def test_dark_pixels_are_not_brightened_to_the_mean_of_their_like(scatter):
    """The truths are log-normal about an estimate that is right on average.

    Where they scatter by 1 in the logarithm, the relative error of their mean is larger than that
    of sample means that scatter by half as much: this is seen in noisy targets alone.
    """
    rng = np.random.default_rng(2)
    truth = np.exp(scatter * rng.normal(size=(20000, 1)) - scatter**2 / 2)
    mean, target = (truth * rng.gamma(4, 1 / 4, size=truth.shape) for _ in range(2))
    noise = truth**2 / 4
    share, _ = own_shares(np.arange(len(truth)), mean, np.ones_like(truth), target, noise)
    error = (((mean + share * (1 - mean)) - truth) ** 2 / (truth**2 + 0.01)).mean()
    of_mean = ((mean - truth) ** 2 / (truth**2 + 0.01)).mean()
    assert error <= 1.02 * of_mean
    assert share > 0.9 if scatter == 0 else share < 0.7


def test_sizes_are_interpolated_along_the_logarithm():
    below, above, part = between_sizes(np.array([4.0, 64.0]), np.array([0, 4, 16, 64, 1000]))
    assert below.tolist() == [0, 0, 0, 1, 1]
    assert above.tolist() == [1, 1, 1, 1, 1]
    assert part.tolist() == [0, 0, 0.5, 0, 0]


@pytest.mark.parametrize("wrong", [np.full((1, 2, GROUPS), -0.1), np.zeros((2, 2, GROUPS))])
def test_shares_that_are_none_are_refused(wrong):
    with pytest.raises(ValueError, match="shares must lie|shares must have shape"):
        checked_shares(np.ones(1), wrong)


def test_brightened_and_darkened_pixels_are_in_balance():
    rng = np.random.default_rng(3)
    mean = rng.exponential(size=(5000, 3))
    change = np.where(mean > 1, -0.3 * (mean - 1), 0.1 * (1 - mean))
    for given in ((0.8, 0.8), (0.2, 0.9), (1.0, 0.1)):
        shares = shares_keeping_mean(*given, change)
        up, down = shares[0], shares[-1]
        radiance = change.sum(axis=-1)
        gained, lost = radiance[radiance > 0].sum(), -radiance[radiance < 0].sum()
        assert up * gained == pytest.approx(down * lost)
        assert up == pytest.approx(given[0]) or down == pytest.approx(given[1])
        assert up <= given[0] + 1e-9
        assert down <= given[1] + 1e-9
    assert not shares_keeping_mean(0.8, 0.8, -0.5 * mean).any()
    assert not shares_keeping_mean(0.8, 0.0, change).any()


def test_an_estimate_from_the_samples_that_trained_it_keeps_the_mean_of_the_image():
    for seed, n in enumerate((4, 16, 64)):
        samples = world("nulls", np.random.default_rng(seed), (32, 32, 1, n))
        found = chd.estimate(samples, iterations=60, progress=False).radiance
        assert found.mean() == pytest.approx(samples.read().mean(), rel=1e-4)


def world(name, rng, shape=(48, 48, 1, 512)):
    """Return samples whose radiance is known, without nulls or mostly nulls, with rare light."""
    width = shape[1]
    ramp = np.geomspace(0.1, 2, width)[np.newaxis, :, np.newaxis]
    independent = rng.lognormal(size=shape[:3])
    lamps = np.where(rng.random(shape[:3]) < 0.01, 30, 0.3)
    radiance, samples = {
        "nulls": (independent, 10 * (rng.random(shape) < 0.1) * rng.exponential(size=shape)),
        "fireflies": (ramp, 0.5 * rng.exponential(size=shape) + 250 * (rng.random(shape) < 0.002)),
        "lamps": (lamps, rng.exponential(size=shape)),
    }[name]
    return chd.Samples.from_array(radiance[..., np.newaxis] * samples)


@pytest.mark.parametrize("name", ["nulls", "fireflies", "lamps"])
def test_with_a_reference_no_error_is_above_the_means_and_the_image_keeps_its_mean(name):
    """Of one training the image's mean drifts by about as much as its few splits scatter."""
    samples = world(name, np.random.default_rng(4))
    trainings = [
        Progressive().train(samples, iterations=300, seed=seed, progress=False) for seed in range(3)
    ]
    truth = samples.read().mean(axis=-1, dtype=np.float64)
    for n in (4, 16, 64):
        drift = []
        for first in range(0, 512 - n, max(n, 32)):
            x = samples.read(ss=slice(first, first + n))
            mean = x.mean(axis=-1, dtype=np.float64)
            for model in trainings:
                found = model.predict(x, trust=1.0).astype(np.float64)
                drift.append((found.sum() - mean.sum()) / truth.sum())
                for power in (0, 1):
                    weight = (truth**2 + 0.01 * truth.mean() ** 2) ** -power
                    excess = weight * ((found - truth) ** 2 - (mean - truth) ** 2)
                    error = 2 * excess.std() * np.sqrt(excess.size)
                    assert excess.sum() <= 0.02 * (weight * (mean - truth) ** 2).sum() + error
        error = 2 * np.std(drift, ddof=1) / np.sqrt(len(drift))
        assert abs(np.mean(drift)) <= max(0.02, error)


@pytest.fixture(scope="module")
def unrelated():
    """Return an image whose pixels tell nothing of each other, and its radiance."""
    rng = np.random.default_rng(2)
    radiance = rng.lognormal(sigma=1.5, size=(16, 16, 1))
    x = radiance[..., np.newaxis] * rng.gamma(2.0, 0.5, size=(16, 16, 1, 16))
    return x.astype(np.float32), radiance


@pytest.fixture(scope="module")
def doubted(unrelated):
    samples = chd.Samples.from_array(unrelated[0])
    return Progressive(inputs=["neighbours"]).train(
        samples, reference=False, iterations=150, progress=False
    )


def errors(found, radiance):
    return [(((found - radiance) ** 2) / (radiance**2 + 1e-2) ** p).mean() for p in (0, 1)]


def test_unrelated_pixels_are_not_worse_than_their_means(unrelated, doubted):
    """They are hardly moved, as what a network makes of the pixels around does not pay."""
    x, radiance = unrelated
    of_mean = errors(x.mean(axis=-1), radiance)
    for found, mean in zip(errors(doubted.predict(x, trust=1.0), radiance), of_mean, strict=True):
        assert found < 1.05 * mean
    assert 0 <= doubted.provenance["trust"] < 1


def test_trust_is_saved_and_said(doubted, unrelated, tmp_path):
    x, _ = unrelated
    doubted.save(tmp_path / "model.safetensors")
    again = Progressive.load(tmp_path / "model.safetensors")
    assert again.provenance["trust"] == doubted.provenance["trust"]
    first, second = (model.estimate(x, trust=1.0) for model in (doubted, again))
    for name in ("radiance", "certainty", "low", "high"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_pixel_of_one_light_keeps_it(alone, image):
    source = image(24, 32, seed=1, smooth=True)
    x = source.x.copy()
    x[3, 4], x[5, 6] = np.array([7.0, 8.0, 0.0])[:, np.newaxis], 0.0
    x[7, 8], x[7, 8, :, 0] = 2.0, 3.0
    found = alone.estimate(x, features=source.samples.features)
    assert found.radiance[3, 4].tolist() == [7, 8, 0]
    assert found.certainty[3, 4] == 0
    assert (found.low[3, 4] <= [7, 8, 0]).all()
    assert (found.high[3, 4] >= [7, 8, 0]).all()
    assert (found.radiance[5, 6] != 0).any()
    assert (found.radiance[7, 8] != x[7, 8].mean(axis=-1)).any()


def test_the_fewest_samples_that_can_train(image):
    source = image(12, 4, seed=3)
    model = Progressive(inputs=["neighbours"])
    model.train(chd.Samples.from_array(source.x), reference=False, iterations=2, progress=False)
    found = model.estimate(source.x)
    assert np.isfinite(found.radiance).all()
    assert (found.low <= found.high).all()
