"""Models, of the library and of users: trained by name, saved, and read whatever they are."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

import chdstat as chd
from chdstat.comparison import denoised, error_curve
from chdstat.errors import InputError, StoreError
from chdstat.estimators import MLP, LearnedEstimator, names, register_learned, registry, train_model
from chdstat.estimators.training import (
    Trained,
    TrainedModel,
    first_samples,
    load_model,
    read_model,
    threads,
)
from chdstat.explorer.batch_estimates import batches_of, estimates_of_model


def image(spp=64, features=False):
    rng = np.random.default_rng(0)
    x = rng.lognormal(size=(16, 16, 1, 1)) * rng.gamma(0.7, size=(16, 16, 3, spp))
    known = {"albedo": np.full((16, 16, 3), 0.5)} if features else None
    return chd.Samples.from_array(x, features=known, scene="made up")


def trained(x, iterations=5, **options):
    samples = chd.Samples.from_array(x, axes="yxcs")
    return train_model(samples, iterations=iterations, progress=False, **options)


def test_seeds_decide_the_network(tmp_path):
    files = [tmp_path / f"{i}.safetensors" for i in range(3)]
    for path, seed in zip(files, (0, 0, 1), strict=True):
        trained(image().read(), seed=seed).save(path)
    assert files[0].read_bytes() == files[1].read_bytes()
    one, other = (read_model(path)[0] for path in files[1:])
    weights = [part for part in one if "weight" in part]
    assert all((one[part] != other[part]).any() for part in weights if one[part].size > 1)


def test_training_leaves_the_global_state_alone():
    state = torch.random.get_rng_state()
    numbers = np.random.get_state()[1].copy()  # noqa: NPY002 - the state that must not change
    x = image().read()
    with threads(2):
        trained(x, iterations=1).predict(x[..., :32])
        assert torch.get_num_threads() == 2
    assert torch.equal(torch.random.get_rng_state(), state)
    assert (np.random.get_state()[1] == numbers).all()  # noqa: NPY002


ODD = {
    **{f"{level:g} everywhere": lambda x, v=level: v + 0 * x for level in (0, 1.0, 1e30)},
    "black and dark channels": lambda x: x * np.array([1, 0, 1e-20])[:, np.newaxis],
    "fireflies": lambda x: np.where(np.arange(64) == 7, 1e30, x),
}


@pytest.mark.parametrize("what", ODD)
def test_any_image_trains_a_finite_network(what):
    x = ODD[what](image().read().astype(np.float64)).astype(np.float32)
    model = trained(x)
    found = model.predict(x[..., :32])
    assert np.isfinite(found).all()
    assert found.any() == x.any()
    assert np.isfinite(model.history.train_loss).all()


def test_what_is_saved_is_read_as_what_it_is(tmp_path):
    model = train_model(image(), iterations=5, progress=False)
    model.save(tmp_path / "a.safetensors")
    again = load_model(tmp_path / "a.safetensors")
    assert type(model) is type(again) is MLP
    x = image().read(ss=slice(0, 32))
    assert (again.predict(x) == model.predict(x)).all()
    assert again.provenance == json.loads(json.dumps(model.provenance))
    np.testing.assert_equal(vars(again.history), vars(model.history))
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]
    again.save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_truncated_and_foreign_files_are_refused(tmp_path):
    path = tmp_path / "model"
    with pytest.raises(StoreError, match="no model at"):
        MLP.load(path)
    train_model(image(), iterations=1, progress=False).save(path)
    whole = path.read_bytes()
    for size in (0, 7, 500, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(StoreError, match="chdstat model"):
            MLP.load(path)
    torch.save({"weights": torch.zeros(3)}, path)
    with pytest.raises(StoreError, match="chdstat model"):
        MLP.load(path)
    save_file({"a": np.zeros(3)}, path)
    with pytest.raises(StoreError, match="chdstat model"):
        MLP.load(path)


def test_options_reach_the_training():
    model = train_model(image(spp=80), iterations=5, seed=3, spp=64, progress=False)
    provenance = model.provenance
    assert (provenance["seed"], provenance["iterations"]) == (3, 5)
    assert provenance["samples_shape"] == [16, 16, 3, 64]


def test_the_first_samples_are_the_first():
    samples = image(features=True)
    part = first_samples(samples, 5)
    assert (part.read() == samples.read(ss=slice(0, 5))).all()
    assert (part.name, part.features.keys()) == ("made up", samples.features.keys())
    assert first_samples(samples, None) is first_samples(samples, 64) is samples


def test_one_bit_of_a_model_is_enough_to_refuse_it(tmp_path):
    path = tmp_path / "a.safetensors"
    train_model(image(), "elek2019", iterations=2, progress=False).save(path)
    sound = path.read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.integers(len(sound), size=64):
        broken = bytearray(sound)
        broken[place] ^= 1 << rng.integers(8)
        path.write_bytes(broken)
        with pytest.raises(StoreError, match="damaged|chdstat model"):
            load_model(path)
    nested = tmp_path / "nested.safetensors"
    for text in ("[" * 100_000, "0 " + "[" * 100_000):
        save_file({"a": np.zeros(3)}, nested, metadata={"chdstat": text})
        with pytest.raises(StoreError, match="damaged"):
            load_model(nested)


# --- learned estimators of users ------------------------------------------------------------------


def deep_image(spp=64):
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


def test_training_is_told_pixels_and_sizes(calls):
    found = chd.compare(deep_image(), ["mean", "share"], n=8, seed=3, progress=False)
    ((told),) = calls
    assert told.keys() == {"seed", "pixels", "progress", "sizes"}
    assert (told["seed"], told["sizes"], told["pixels"].shape) == (3, (8,), (64, 2))
    assert not found.test_pixels[tuple(told["pixels"].T)].any()
    assert found.table()[1]["mse_ratio"] == pytest.approx(1, rel=1e-6)
    curve = error_curve(deep_image(), ["mean", "share"], sizes=[4, 16], progress=False)
    assert calls[1]["sizes"] == (4, 16)
    assert curve.measures["mse_ratio"].value[:, 1] == pytest.approx([1, 1], rel=1e-6)


def test_features_reach_those_who_look_at_them(calls):
    found = chd.compare(deep_image(), ["mean", "share", "share_features"], n=8, progress=False)
    mean, plain, twice = found.estimates
    assert plain == pytest.approx(mean, rel=1e-5)
    assert twice == pytest.approx(2 * mean, rel=1e-5)


def test_denoised_shares_the_training(calls, monkeypatch):
    monkeypatch.setattr("chdstat._core.denoiser.run_network", lambda images, **_: images["color"])
    found = chd.compare(deep_image(), ["share", denoised("share")], n=16, progress=False)
    assert len(calls) == 1
    assert list(found.models) == ["share"]
    # Alone, it trains what it needs.
    alone = chd.compare(deep_image(), [denoised("share")], n=16, progress=False)
    assert list(alone.models) == ["share"]


def test_a_model_takes_any_number_of_samples(calls):
    assert "share" in names("learned")
    model = Share(np.zeros((0, 2), int), (16, 12))
    for spp in (5, 32):
        found = chd.estimate(deep_image(), model, spp=spp)
        assert found.radiance == pytest.approx(
            deep_image().first(spp).read().mean(axis=-1), rel=1e-5
        )
        assert np.isnan(found.level)
    batches = batches_of(deep_image(2048)[3, 4], 16)
    (found,) = estimates_of_model("share", model, batches)
    assert found.values == pytest.approx(batches.mean(axis=-1), rel=1e-5)


def test_what_cannot_be_saved_is_not_trained_alone(calls):
    with pytest.raises(InputError, match="share .*Share"):
        train_model(deep_image(), "share", progress=False)
    assert calls == [{"seed": 0, "iterations": None, "progress": False}]


class Factor(TrainedModel[Trained]):
    """A factor of the mean, as a learned estimator of one file would be."""

    kind = name = "factor"

    def __init__(self, factor, state):
        self.factor, self._trained = factor, state

    @classmethod
    def train(cls, samples, *, pixels=((0, 0),), **_):
        found = {"train_pixels": np.array(pixels), "train_shape": samples.shape[:2]}
        return cls(2.0, Trained(history=np.ones((1, 5)), provenance={"scene": "any"}, **found))

    def predict(self, x):
        return (self.factor * np.asarray(x).mean(axis=-1)).astype(np.float32)

    def _to_file(self, _):
        return {"factor": np.array(self.factor)}, {}

    @classmethod
    def _from_file(cls, arrays, _, common):
        return cls(arrays["factor"], Trained(**common))


def test_a_class_and_its_entry_make_a_learned_estimator(tmp_path):
    register_learned(LearnedEstimator("factor", Factor.train, "this test", inputs=None, pixels=64))
    try:
        train_model(image(), "factor", progress=False).save(tmp_path / "a.safetensors")
        model = load_model(tmp_path / "a.safetensors")
        twice = 2 * image().first(8).read().mean(axis=-1)
        assert chd.estimate(image(), model, spp=8).radiance == pytest.approx(twice, rel=1e-5)
        found = chd.compare(image(), ["factor"], n=8, progress=False)
        assert found.estimates[0] == pytest.approx(twice, rel=1e-5)
        assert len(found.models["factor"].train_pixels) == 64
    finally:
        registry.forget("factor")
        del TrainedModel.kinds["factor"]
