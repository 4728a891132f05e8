"""Learned estimators of users: what their training and their models are given."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import denoised, error_curve
from chdstat.errors import InputError
from chdstat.estimators import LearnedEstimator, names, register_learned, registry, train_model
from chdstat.explorer.batch_estimates import batches_of, estimates_of_model


def image(spp=64):
    rng = np.random.default_rng(0)
    x = rng.lognormal(size=(16, 12, 1, 1)) * rng.gamma(0.7, size=(16, 12, 3, spp))
    return chd.Samples.from_array(x, features={"depth": np.full((16, 12), 2.0)})


class Share:
    """The mean of any number of samples, times the depth where it is given."""

    name = "share"

    def __init__(self, pixels, shape):
        self.train_pixels, self.train_shape = pixels, shape

    def predict(self, x, features=None):
        scale = 1.0 if features is None else features["depth"].mean()
        return np.asarray(x).mean(axis=-1) * scale


@pytest.fixture
def calls():
    """Register the estimator, and return what its trainings are given."""
    made = []

    def train(samples, **options):
        made.append(options)
        return Share(options.get("pixels"), samples.shape[:2])

    for name, uses in (("share", False), ("share_features", True)):
        entry = LearnedEstimator(
            name, train, "this test", inputs=None, pixels=64, uses_features=uses
        )
        register_learned(entry)
    yield made
    registry.forget("share")
    registry.forget("share_features")


def test_training_is_told_the_pixels_and_the_numbers_of_samples(calls):
    found = chd.compare(image(), ["mean", "share"], n=8, seed=3, progress=False)
    ((told),) = calls
    assert told.keys() == {"seed", "pixels", "progress", "sizes"}
    assert (told["seed"], told["sizes"], told["pixels"].shape) == (3, (8,), (64, 2))
    assert not found.test_pixels[tuple(told["pixels"].T)].any()
    assert found.table()[1]["mse_ratio"] == pytest.approx(1, rel=1e-6)
    curve = error_curve(image(), ["mean", "share"], sizes=[4, 16], progress=False)
    assert calls[1]["sizes"] == (4, 16)
    assert curve.measures["mse_ratio"].value[:, 1] == pytest.approx([1, 1], rel=1e-6)


def test_features_reach_those_who_look_at_them(calls):
    found = chd.compare(image(), ["mean", "share", "share_features"], n=8, progress=False)
    mean, plain, twice = found.estimates
    assert plain == pytest.approx(mean, rel=1e-5)
    assert twice == pytest.approx(2 * mean, rel=1e-5)


def test_a_denoised_estimator_shares_the_training_of_its_own(calls, monkeypatch):
    monkeypatch.setattr(
        "chdstat.estimators.denoiser.run_network", lambda images, **_: images["color"]
    )
    found = chd.compare(image(), ["share", denoised("share")], n=16, progress=False)
    assert len(calls) == 1
    assert list(found.models) == ["share"]
    # Alone, it trains what it needs.
    alone = chd.compare(image(), [denoised("share")], n=16, progress=False)
    assert list(alone.models) == ["share"]


def test_its_model_estimates_an_image_of_any_number_of_samples(calls):
    assert "share" in names("learned")
    model = Share(np.zeros((0, 2), int), (16, 12))
    for spp in (5, 32):
        found = chd.estimate(image(), model, spp=spp)
        assert found.radiance == pytest.approx(image().first(spp).read().mean(axis=-1), rel=1e-5)
        assert np.isnan(found.level)
    batches = batches_of(image(2048)[3, 4], 16)
    (found,) = estimates_of_model("share", model, batches)
    assert found.values == pytest.approx(batches.mean(axis=-1), rel=1e-5)


def test_what_cannot_be_saved_is_not_trained_alone(calls):
    with pytest.raises(InputError, match="share .*Share"):
        train_model(image(), "share", progress=False)
    assert calls == [{"seed": 0, "iterations": None, "progress": False}]
