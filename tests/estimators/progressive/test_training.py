"""Training: it repeats, learns what it claims to, and its loss has the minimiser that it states."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import Progressive, mean_radiance

pytestmark = pytest.mark.filterwarnings("ignore::chdstat.errors.OtherSceneWarning")


def test_it_beats_the_mean_on_pixels_that_it_has_not_seen(trained, image):
    """With 4800 estimates of a fixed seed, errors of 0.8 of the mean's stray by less than 0.1."""
    for n in (8, 32):
        fresh = image(40, n, seed=7)
        assert (
            fresh.error(trained.predict(fresh.x, loss_weight=0.0, unit=mean_radiance(fresh.x)))
            < 0.95
        )
    worse = fresh.error(
        np.roll(trained.predict(fresh.x, loss_weight=0.0, unit=mean_radiance(fresh.x)), 1, axis=0)
    )
    assert worse > 1  # negative control: the measure tells estimates of other pixels


def test_losses_fall_in_units_of_the_means_and_are_recorded(trained):
    history = trained.history
    assert history.iteration[-1] == 150
    assert (np.diff(history.iteration) > 0).all()
    late = history.validation_loss[-10:].mean() / history.validation_baseline[-10:].mean()
    early = history.validation_loss[0] / history.validation_baseline[0]
    assert late < min(early, 1)


def test_intervals_contain_the_radiance_as_often_as_stated(image):
    """Of 90 % intervals 88 to 97 % contain it: what chance may have is added on both sides.

    410 pixels calibrate, in about five levels of brightness: by chance that is a standard error of
    2 to 3 % in each tail, half of which is added. Of five seeds, 93 to 96 % contain it.
    """
    samples = image(64, 512, seed=0).samples
    trained = Progressive().train(samples, sizes=(8, 32), iterations=150, progress=False)
    fresh = image(40, 32, seed=11)
    for loss_weight in (0.0, 0.5, 1.0):
        found = trained.estimate(fresh.x, loss_weight=loss_weight, unit=mean_radiance(fresh.x))
        within = (found.low <= fresh.radiance) & (fresh.radiance <= found.high)
        assert 0.88 < within.mean() < 0.97
        half = trained.estimate(
            fresh.x, loss_weight=loss_weight, unit=mean_radiance(fresh.x), level=0.5
        )
        within = (half.low <= fresh.radiance) & (fresh.radiance <= half.high)
        assert 0.45 < within.mean() < 0.65


def test_pixels_that_trained_are_exposed_and_others_left(image):
    source = image(16, 16, seed=0)
    pixels = np.array([[3, 4], [0, 0], [15, 15], [3, 4]])
    model = Progressive().train(
        source.samples, sizes=(8,), iterations=2, pixels=pixels, progress=False
    )
    assert model.train_pixels.tolist() == [[0, 0], [3, 4], [15, 15]]
    assert model.train_shape == (16, 16)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_pixels_with_a_bad_sample_do_not_train_and_are_counted(image):
    x = image(8, 16, seed=0).x.copy()
    x[2:4, :, 1, 5] = np.nan
    samples = chd.Samples.from_array(x)
    model = Progressive().train(samples, sizes=(8,), iterations=2, progress=False)
    assert not np.isin(model.train_pixels[:, 0], (2, 3)).any()
    assert model.provenance["pixels_excluded"] + model.provenance["pixels_used"] == 32
    assert model.provenance["pixels_excluded"] > 0


@pytest.mark.parametrize(
    ("with_features", "options", "match"),
    [
        (False, {"iterations": 0}, "iterations must be at least 1, got 0"),
        (False, {"pixels": [[0, 8]]}, "lie in the image of 8 x 8"),
        (False, {"sizes": []}, "sizes must be one or more"),
        (False, {"sizes": [0]}, "sizes must be one or more"),
        (False, {"sizes": [64]}, "at least 128 spp, got 16"),
        (True, {}, "no first-hit features"),
    ],
)
def test_it_refuses_what_it_cannot_use(image, with_features, options, match):
    samples = chd.Samples.from_array(image(8, 16, seed=0).x)
    with pytest.raises(InputError, match=match):
        Progressive(with_features=with_features).train(samples, progress=False, **options)


def test_it_says_how_many_samples_it_needs():
    few = chd.Samples.from_array(np.ones((8, 8, 3, 3)))
    with pytest.raises(InputError, match=r"at least \d spp, got 3"):
        Progressive().train(few, progress=False)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("x", [np.full((4, 4, 3, 16), np.nan), np.ones((1, 1, 3, 16))])
def test_it_says_that_too_few_pixels_are_good(x):
    with pytest.raises(InputError, match="at least 2 pixels|pixels"):
        Progressive().train(chd.Samples.from_array(x), progress=False)


def test_intervals_of_an_image_that_is_negative_everywhere_contain_its_radiance():
    x = -np.random.default_rng(0).exponential(size=(12, 12, 3, 64))
    found = Progressive().train(x, iterations=20, progress=False).estimate(x[..., :8])
    assert ((found.low <= -1) & (found.high >= -1)).mean() > 0.8
