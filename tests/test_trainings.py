"""Trainings: the spread of measures over the random numbers that networks are trained with."""

from __future__ import annotations

import json

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import MEASURES
from chdstat.errors import InputError
from chdstat.estimators import MLP, registry

SEEDS: list[int] = []


class Biased:
    """A model whose estimate is the mean times a factor that its seed gives."""

    def __init__(self, seed, pixels, shape):
        self.name, self.train_pixels, self.train_shape = "biased", pixels, shape
        self.factor = (1.0, 1.2, 0.9)[seed - 7]

    def predict(self, x):
        return self.factor * np.asarray(x).mean(axis=-1)


def train(samples, *, seed, pixels, progress, sizes):
    SEEDS.append(seed)
    return Biased(seed, pixels, samples.shape[:2])


@pytest.fixture(autouse=True)
def biased(monkeypatch):
    SEEDS.clear()
    entry = registry.LearnedEstimator("biased", train, "this test", inputs=None, pixels=20)
    monkeypatch.setitem(registry._ENTRIES, "biased", entry)


def picture():
    return chd.Samples.from_array(np.random.default_rng(0).gamma(2.0, size=(8, 8, 3, 64)))


def test_the_spread_is_that_of_comparisons_with_each_seed():
    found = chd.compare(picture(), ["mean", "biased"], n=16, seed=7, training_seeds=3, cost=False)
    assert SEEDS == [7, 8, 9]
    models = [Biased(seed, found.models["biased"].train_pixels, (8, 8)) for seed in (7, 8, 9)]
    alone = [
        chd.compare(picture(), ["mean", "biased"], n=16, seed=7, model=model, cost=False)
        for model in models
    ]
    for measure in MEASURES:
        values = [other.measures[measure].value for other in alone]
        expected = np.std(values, axis=0, ddof=1)[1]
        assert found.over_trainings[measure][1] == pytest.approx(expected, rel=1e-9, nan_ok=True)
        # The measures themselves are those of the first training.
        assert found.measures[measure].value == pytest.approx(values[0], nan_ok=True)


def test_bias_varies_as_the_factors_do():
    found = chd.compare(picture(), ["biased"], n=16, seed=7, training_seeds=3, cost=False)
    row = found.table()[0]
    assert row["bias_sd_over_trainings"] == pytest.approx(np.std([1, 1.2, 0.9], ddof=1), rel=1e-6)


def test_what_learns_nothing_has_no_spread():
    found = chd.compare(picture(), ["mean", "biased"], n=16, seed=7, training_seeds=2, cost=False)
    assert np.isnan(found.table()[0]["mse_sd_over_trainings"])
    none = chd.compare(picture(), ["mean"], n=16, training_seeds=2, cost=False)
    assert np.isnan(none.over_trainings["mse"]).all()
    assert SEEDS == [7, 8]
    json.dumps(found.to_dict(), allow_nan=False)
    assert found.to_dataset()["mse_sd_over_trainings"].dims == ("estimator", "part")


def test_one_training_has_none():
    found = chd.compare(picture(), ["biased"], n=16, seed=7, cost=False)
    assert found.over_trainings == {}
    assert "mse_sd_over_trainings" not in found.table()[0]


def test_networks_differ_from_training_to_training(monkeypatch):
    def quick(samples, **options):
        return MLP.preset("elek2019").train(samples, iterations=20, **options)

    own = registry.LearnedEstimator("elek2019", quick, "this test", inputs=32, pixels=32)
    monkeypatch.setitem(registry._ENTRIES, "elek2019", own)
    found = chd.compare(picture(), ["elek2019"], training_seeds=2, cost=False)
    assert found.table()[0]["mse_sd_over_trainings"] > 0
    assert list(found.reusable_models) == ["elek2019"]


def test_a_model_is_not_trained_anew():
    model = Biased(7, np.array([[0, 0]]), (8, 8))
    with pytest.raises(InputError, match="trains anew"):
        chd.compare(picture(), ["biased"], n=16, model=model, training_seeds=2)
    with pytest.raises(InputError, match="training_seeds must be at least 1"):
        chd.compare(picture(), ["biased"], n=16, training_seeds=0)


def test_models_come_by_the_name_of_the_estimator_that_they_are():
    model = Biased(8, np.array([[0, 0]]), (8, 8))
    found = chd.compare(picture(), ["biased"], n=16, model={"biased": model}, cost=False)
    assert found.models == {"biased": model}
    assert found.reusable_models == {}
    with pytest.raises(InputError, match="'elek2019', which is not among"):
        chd.compare(picture(), ["biased"], n=16, model={"elek2019": model})
