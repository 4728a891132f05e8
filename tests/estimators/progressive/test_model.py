"""The progressive estimator: scale, order and number of samples, bad input, files."""

import pickle

import numpy as np
import pytest
import torch

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.estimators import Progressive
from chdstat.estimators.training import read_model, write_model

pytestmark = pytest.mark.filterwarnings("ignore::chdstat.errors.OtherSceneWarning")


@pytest.fixture(scope="module")
def fresh(image):
    """An image that trained nothing."""
    return image(16, 32, seed=5)


@pytest.fixture(scope="module")
def smooth(image):
    """An image with features, for those who look at them."""
    return image(24, 32, seed=1, smooth=True)


@pytest.mark.parametrize("factor", [2.0**-40, 2.0**60])
def test_powers_of_two_scale_the_estimate_to_the_bit(trained, fresh, factor):
    found, scaled = (trained.estimate(x) for x in (fresh.x, fresh.x * np.float32(factor)))
    assert (scaled.radiance == found.radiance * np.float32(factor)).all()
    assert (scaled.certainty == found.certainty).all()
    assert (scaled.high == found.high * np.float32(factor)).all()


@pytest.mark.parametrize("factor", [1e-6, 7e5])
def test_any_factor_scales_the_estimate(trained, fresh, factor):
    scaled = trained.predict(fresh.x * np.float32(factor)) / np.float32(factor)
    assert scaled == pytest.approx(trained.predict(fresh.x), rel=1e-5, abs=1e-7)


def test_the_order_of_samples_does_not_matter(trained, fresh):
    shuffled = np.random.default_rng(0).permutation(fresh.x, axis=-1)
    assert trained.predict(shuffled) == pytest.approx(trained.predict(fresh.x), rel=1e-4, abs=1e-6)


def test_pixels_are_on_their_own_within_an_image(trained, fresh):
    whole = trained.predict(fresh.x, unit=1.0)
    one = trained.predict(fresh.x[3, 4], unit=1.0)
    assert one.shape == (3,)
    assert one == pytest.approx(whole[3, 4], rel=1e-5)
    assert trained.predict(np.empty((0, 3, 8)), unit=1.0).shape == (0, 3)


@pytest.mark.parametrize("n", [1, 2, 7, 4096])
def test_any_number_of_samples(trained, n):
    x = np.random.default_rng(n).gamma(0.5, size=(4, 5, 3, n))
    found = trained.estimate(x)
    assert found.radiance.shape == found.low.shape == found.high.shape == (4, 5, 3)
    assert found.certainty.shape == (4, 5)
    assert np.isfinite(found.radiance).all()
    assert (found.radiance >= 0).all()
    assert (found.low <= found.high).all()
    assert ((found.certainty >= 0) & (found.certainty <= 1)).all()


def test_it_tends_to_the_mean(trained):
    x = np.random.default_rng(0).gamma(0.5, size=(8, 8, 3, 4096)).astype(np.float32)
    distances = []
    for n in (16, 256, 4096):
        few = x[..., :n]
        found = trained.estimate(few, unit=0.5)
        mean = few.mean(axis=-1)
        distances.append(np.abs(found.radiance - mean).mean() / mean.mean())
        assert found.certainty.max() <= 1 / (1 + n / 2**12) + 1e-6
    assert distances[2] < 0.25 * distances[0]
    many = np.tile(x[:1, :1], 64)
    far = np.abs(trained.predict(many, unit=0.5) - many.mean(axis=-1)).max()
    assert far < 0.02


def test_the_loss_weight_goes_from_one_estimate_to_the_other(trained, fresh):
    ends = [trained.predict(fresh.x, loss_weight=b, unit=1.0) for b in (0.0, 1.0)]
    middle = trained.predict(fresh.x, loss_weight=0.25, unit=1.0)
    assert middle == pytest.approx(0.75 * ends[0] + 0.25 * ends[1], rel=1e-4, abs=1e-6)
    assert np.abs(ends[1] - ends[0]).max() > 0


def test_intervals_widen_with_their_probability(trained, fresh):
    widths = []
    for level in (0.5, 0.9, 0.98):
        found = trained.estimate(fresh.x, level=level)
        assert found.level == level
        widths.append((found.high - found.low).mean())
    assert widths == sorted(widths)


def wild(x):
    """Return an image with every kind of bad and extreme pixel, one a column."""
    x = np.array(x[:, :12])
    x[:, 0] = 0
    x[:, 1, 1, 3] = np.nan
    x[:, 2, :, ::2] = np.inf
    x[:, 3, 0] = -1
    x[:, 4] = np.nan
    x[:, 5] = 1e30
    x[:, 6] = 1e-42
    x[:, 7, :, 0] = 3e38
    x[:, 8] = 3e38
    x[:, 9, 0, ::2] = np.nan
    x[:, 9, 1, 1::2] = np.nan
    x[:, 10, :, 1:] = -np.inf
    return x


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize(
    ("unit", "dtype", "loss_weight"),
    [(None, np.float32, 0.0), (1.0, np.float64, 0.5), (1e-30, np.float32, 1.0)],
)
def test_no_estimate_is_nan_where_the_mean_is_finite(trained, fresh, unit, dtype, loss_weight):
    x = wild(fresh.x).astype(dtype)
    found = trained.estimate(x, loss_weight=loss_weight, unit=unit)
    mean = chd.estimators.mean(x)
    assert (np.isfinite(found.radiance) == np.isfinite(mean)).all()
    for end in (found.low, found.high):
        assert (np.isnan(end) == np.isnan(mean)).all()
    assert (found.radiance[mean >= 0] >= 0).all()
    assert (found.certainty[:, 4] == 0).all()


@pytest.mark.parametrize("level", [0.0, 1e-44, 1e-30, 1e30, 3e38])
def test_an_image_of_any_radiance(trained, level):
    x = np.full((4, 4, 3, 8), level, np.float32)
    found = trained.predict(x)
    assert np.isfinite(found).all()
    assert found == pytest.approx(np.full_like(found, level), rel=0.5, abs=0.01)


@pytest.mark.parametrize("level", [1e-60, 1e60])
def test_radiance_beyond_single_precision_warns_of_nothing(trained, level):
    assert not np.isnan(trained.predict(np.full((4, 4, 3, 8), level))).any()


def test_a_single_lit_sample_in_a_black_image(trained):
    x = np.zeros((16, 16, 3, 8), np.float32)
    x[3, 3, :, 0] = 1e-45
    assert np.isfinite(trained.predict(x)).all()


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda m: m.predict(np.ones((4, 4, 2, 8))), "with 3 channels, got 2"),
        (lambda m: m.predict(np.ones(8)), r"\(..., channel, sample\), got \(8,\)"),
        (lambda m: m.predict(np.ones((4, 4, 3, 0))), "at least 1 sample"),
        (
            lambda m: m.predict(np.ones((4, 3, 8)), loss_weight=1.1),
            "loss_weight must lie .* got 1.1",
        ),
        (
            lambda m: m.predict(np.ones((4, 3, 8)), loss_weight=np.nan),
            "loss_weight must lie .* got nan",
        ),
        (lambda m: m.estimate(np.ones((4, 3, 8)), level=1.0), "level must lie .* got 1.0"),
        (lambda m: m.estimate(np.ones((4, 3, 8)), level=0.0), "level must lie .* got 0.0"),
        (lambda m: m.predict(np.ones((4, 3, 8)), unit=0.0), "unit must be a positive radiance"),
    ],
)
def test_it_refuses_what_it_cannot_use(trained, call, match):
    with pytest.raises(InputError, match=match):
        call(trained)


def test_one_with_features_refuses_what_is_no_image(featured, smooth):
    features = smooth.samples.features
    with pytest.raises(InputError, match=r"belong to an image \(y, x, channel, sample\)"):
        featured.predict(smooth.x[0], features=features)
    with pytest.raises(InputError, match=r"must have shape \(24, 24\)"):
        featured.predict(smooth.x, features={"albedo": features["albedo"][:5]})
    with pytest.raises(InputError, match="sees 6 numbers .* give 0; pass features="):
        featured.predict(smooth.x)


def test_an_untrained_one_says_so(tmp_path):
    model = Progressive()
    assert repr(model) == "<Progressive untrained>"
    for call in (
        lambda: model.predict(np.ones((4, 3, 8))),
        lambda: model.save(tmp_path / "model"),
        lambda: model.train_pixels,
        lambda: model.history,
    ):
        with pytest.raises(InputError, match="not trained yet"):
            call()


def test_loading_unpickles_nothing(trained, tmp_path, monkeypatch):
    trained.save(tmp_path / "model")

    def refuse(*_args, **_options):
        raise AssertionError

    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler")):
        monkeypatch.setattr(module, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    assert Progressive.load(tmp_path / "model").channels == 3


def rewritten(path, change):
    """Write a model file anew with its arrays and description changed."""
    arrays, about = read_model(path)
    change(arrays, about)
    write_model(path, arrays, about)


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays, _: arrays.pop("network.answer.bias"),
        lambda arrays, _: arrays.pop("spread.weights"),
        lambda arrays, _: arrays.update({"spread.normal": np.zeros((2, 2, 11))}),
        lambda arrays, _: arrays.pop("history"),
        lambda arrays, _: arrays.update({"network.more": np.zeros(3, np.float32)}),
        lambda _, about: about["shape"].update(channels=1),
        lambda _, about: about["shape"].update(width="wide"),
        lambda _, about: about["shape"].update(legs=4),
        lambda _, about: about.pop("unit"),
        lambda _, about: about.update(train_shape=[3]),
    ],
)
def test_a_file_with_parts_missing_or_of_another_shape_is_refused(trained, tmp_path, change):
    trained.save(tmp_path / "model")
    rewritten(tmp_path / "model", change)
    with pytest.raises(StoreError, match="does not hold a whole network"):
        Progressive.load(tmp_path / "model")
