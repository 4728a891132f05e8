"""Trained estimators beside the fixed ones: what is asked, and what cannot be."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.explorer.estimators import batches_of, score_model
from chdstat.explorer.sources import StoreSource

PLACE = (5, 7)


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(1)
    return chd.Samples.from_array(
        rng.gamma(2.0, size=(24, 24, 3, 64)).astype(np.float32), scene_hash="a"
    )


@pytest.fixture(scope="module")
def model(samples):
    """Return an estimator that looks at one pixel."""
    return chd.estimators.train_model(samples, iterations=5, progress=False)


def scored(model, samples, n=16, place=PLACE):
    x = samples[PLACE]
    batches = batches_of(x, n)
    return score_model("mine", model, batches, StoreSource(samples), place, 2.0)


def test_one_of_this_scene_says_what_it_says_elsewhere(samples, model):
    found = scored(model, samples)
    direct = model.estimate(batches_of(samples[PLACE], 16).x, unit=2.0)
    np.testing.assert_allclose(found.value, direct.radiance.mean(axis=0), rtol=1e-6)
    assert found.certainty == pytest.approx(float(direct.certainty.mean()), rel=1e-6)
    assert (found.low <= found.high).all()
    assert np.isfinite([found.mse_ratio, found.bias, found.improved]).all()


def test_one_with_features_is_asked_about_an_image_that_has_them(samples):
    known = chd.Samples.from_array(
        samples.read(), features={"depth": np.ones((24, 24))}, scene_hash="a"
    )
    model = chd.estimators.train_model(known, with_features=True, iterations=5, progress=False)
    found = scored(model, known)
    assert found.given
    assert found.value.shape == (3,)
    assert np.isfinite(found.value).all()
    assert scored(model, known, place=(0, 0, 4, 4)) is None  # a region is no image
    assert scored(model, samples) is None


def test_one_of_another_scene_is_mixed_with_the_mean_as_its_image_says(samples):
    rng = np.random.default_rng(2)
    other = chd.Samples.from_array(rng.gamma(0.1, size=(24, 24, 3, 64)).astype(np.float32))
    model = chd.estimators.train_model(other, iterations=5, progress=False)
    found = scored(model, samples)
    assert found.given
    assert (found.low <= found.value).all()
    assert (found.value <= found.high).all()


def test_one_for_another_number_of_samples_is_left_out(samples):
    model = chd.estimators.train_model(samples, "elek2019", iterations=5, progress=False)
    assert scored(model, samples, n=16) is None
    found = scored(model, samples, n=model.inputs)
    assert np.isnan(found.certainty)
