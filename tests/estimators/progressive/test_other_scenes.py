"""Other scenes: a model warns, and is mixed with the mean as far as the samples confirm it."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import OtherSceneWarning
from chdstat.estimators import Progressive, mean_radiance
from chdstat.estimators.progressive.errors import share_of

others = pytest.mark.filterwarnings("ignore::chdstat.errors.OtherSceneWarning")


def world(name, rng, shape=(48, 48, 1, 512)):
    """Return samples whose radiance is known, mostly nulls or with rare lamps."""
    independent = rng.lognormal(size=shape[:3])
    lamps = np.where(rng.random(shape[:3]) < 0.01, 30, 0.3)
    radiance, samples = {
        "nulls": (independent, 10 * (rng.random(shape) < 0.1) * rng.exponential(size=shape)),
        "lamps": (lamps, rng.exponential(size=shape)),
    }[name]
    return chd.Samples.from_array(radiance[..., np.newaxis] * samples)


def errors(found, truth):
    """Return MSE and relMSE."""
    floor = 0.01 * truth.mean() ** 2
    return np.array([((found - truth) ** 2 / (truth**2 + floor) ** p).mean() for p in (0, 1)])


@pytest.fixture(scope="module")
def of_lamps():
    """Return a model of an image whose pixels have one of two radiances."""
    samples = world("lamps", np.random.default_rng(0))
    return Progressive().train(samples, sizes=(8, 16, 32), iterations=300, progress=False)


@pytest.fixture(scope="module")
def unrelated():
    """Return an image of another kind, which refutes that model, and its radiance."""
    rng = np.random.default_rng(2)
    radiance = rng.lognormal(sigma=1.5, size=(64, 64, 1))
    x = radiance[..., np.newaxis] * rng.gamma(2.0, 0.5, size=(64, 64, 1, 16))
    return x.astype(np.float32), radiance


@pytest.mark.parametrize("loss_weight", [0.0, 0.5, 1.0])
@others
def test_a_model_of_another_scene_is_not_worse_than_the_mean(of_lamps, unrelated, loss_weight):
    """The model alone is the negative control."""
    x, truth = unrelated
    mean = errors(x.mean(axis=-1, dtype=np.float64), truth)
    alone = of_lamps.predict(x, loss_weight=loss_weight, unit=mean_radiance(x))
    assert (errors(alone, truth) > 1.1 * mean).any()
    assert (errors(of_lamps.predict(x, loss_weight=loss_weight), truth) < 1.02 * mean).all()


@others
def test_a_model_of_a_scene_of_the_same_kind_is_followed(of_lamps):
    fresh = world("lamps", np.random.default_rng(1), (64, 64, 1, 16)).read()
    truth = np.where(fresh.mean(axis=-1) > 5, 30, 0.3)
    mean = errors(fresh.mean(axis=-1, dtype=np.float64), truth)
    assert (errors(of_lamps.predict(fresh), truth) < 0.7 * mean).all()


def test_it_warns_of_its_scene_and_says_its_weights(of_lamps, unrelated):
    with pytest.warns(OtherSceneWarning, match=r"trained on 'samples'.* image is 0\.\d\d, 0\.\d\d"):
        of_lamps.predict(unrelated[0])


def test_the_scene_that_trained_it_is_known_by_its_hash_and_its_samples_by_themselves():
    rng = np.random.default_rng(0)
    x, fresh = (rng.exponential(size=(8, 8, 1, 32)).astype(np.float32) for _ in range(2))

    def samples(values, scene):
        return chd.Samples.from_array(values, scene_hash=scene)

    model = Progressive().train(samples(x, "one"), sizes=(8,), iterations=2, progress=False)
    model.predict(samples(fresh, "one"))
    model.predict(x[..., :8])
    with pytest.warns(OtherSceneWarning):
        model.predict(samples(fresh, "two"))


@others
def test_estimates_lie_between_the_mean_and_the_model_and_intervals_hold_the_means(of_lamps):
    x = world("nulls", np.random.default_rng(3), (32, 32, 1, 16)).read()
    mean, unit = x.mean(axis=-1, dtype=np.float64), mean_radiance(x)
    alone, found = of_lamps.estimate(x, unit=unit), of_lamps.estimate(x)
    lowest, highest = np.minimum(mean, alone.radiance), np.maximum(mean, alone.radiance)
    assert (found.radiance >= lowest * (1 - 1e-5)).all()
    assert (found.radiance <= highest * (1 + 1e-5)).all()
    assert (found.certainty <= alone.certainty + 1e-6).all()
    assert (found.low <= mean * (1 + 1e-5)).all()
    assert (found.high >= mean * (1 - 1e-5)).all()


@others
@pytest.mark.parametrize("n", [1, 2, 3])
def test_too_few_samples_to_compare_halves_are_averaged(of_lamps, n):
    x = world("nulls", np.random.default_rng(3), (8, 8, 1, n)).read()
    assert of_lamps.predict(x) == pytest.approx(x.mean(axis=-1), rel=1e-6)


@others
def test_the_interval_of_a_mean_of_few_skewed_samples_holds_the_truth(of_lamps):
    x = np.random.default_rng(5).exponential(size=(64, 64, 1, 3)).astype(np.float32)
    found = of_lamps.estimate(x)
    assert np.mean((found.low <= 1) & (found.high >= 1)) > 0.88


def test_the_share_of_a_move_is_what_pays():
    rng = np.random.default_rng(0)
    move = rng.normal(size=(2000, 3))
    for share in (0.4, 1.0):
        wanted = share * move + rng.normal(size=move.shape)
        assert share_of(np.arange(2000), move, wanted) == pytest.approx(share, abs=0.06)
    assert share_of(np.arange(2000), move, -move) == 0
    assert share_of(np.zeros(2000, int), move, move) == 0  # one pixel is no evidence
    assert share_of(np.arange(2000), 0 * move, move) == 0


@others
def test_a_pixel_of_one_light_keeps_it(featured, image):
    source = image(24, 32, seed=1, smooth=True)
    x = source.x.copy()
    x[3, 4], x[5, 6] = np.array([7.0, 8.0, 0.0])[:, np.newaxis], 0.0
    x[7, 8], x[7, 8, :, 0] = 2.0, 3.0
    features, unit = source.samples.features, mean_radiance(x)
    found = featured.estimate(x, features=features, unit=unit)
    assert found.radiance[3, 4].tolist() == [7, 8, 0]
    assert found.certainty[3, 4] == 0
    assert (found.low[3, 4] <= [7, 8, 0]).all()
    assert (found.high[3, 4] >= [7, 8, 0]).all()
    assert (found.radiance[5, 6] != 0).any()
    assert (found.radiance[7, 8] != x[7, 8].mean(axis=-1)).any()
