"""The learned estimator: it learns, repeats, never says NaN, and survives a round trip to disk."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.estimators import MLP, PRESETS, Preset
from chdstat.estimators.elek2019 import RECORD_EVERY, evaluate, initial_weights
from chdstat.estimators.held_out import draw_pixels
from chdstat.estimators.training import write_model


def image(height=24, width=24, spp=128, seed=0):
    """Return pixels of many brightnesses, half of their samples null: far from Gaussian."""
    rng = np.random.default_rng(seed)
    brightness = rng.lognormal(0, 1, size=(height, width, 1, 1)) * np.array([1, 0.8, 0.5])[:, None]
    lit = rng.random((height, width, 1, spp)) < 0.5
    return chd.Samples.from_array(
        brightness * lit * rng.gamma(0.7, size=(height, width, 1, spp)), scene="made up"
    )


@pytest.fixture(scope="module")
def trained():
    return MLP.preset("elek2019").train(image(), seed=0, iterations=600)


def test_the_preset_is_the_published_one():
    preset = PRESETS["elek2019"]
    assert preset.sizes == (32, 32, 32, 32, 1)
    assert (preset.pixels, preset.iterations) == (6400, 30_000)
    assert (preset.learning_rate, preset.validation_share) == (0.005, 0.1)


def test_the_network_computes_what_its_layers_say():
    rng = np.random.default_rng(0)
    weights = initial_weights((5, 4, 1), rng)
    x = rng.normal(size=(7, 5)).astype(np.float32)
    expected = np.maximum(x @ weights[0] + weights[1], 0) @ weights[2] + weights[3]
    assert evaluate(weights, x) == pytest.approx(expected[:, 0], rel=1e-5, abs=1e-6)


def test_training_beats_the_mean_where_half_of_the_samples_are_null(trained):
    history = trained.history
    assert (history.iteration == np.arange(100, 601, RECORD_EVERY)).all()
    assert history.train_loss[-1] < history.train_loss[0]
    assert history.validation_baseline[0] > 0
    # The baseline is in squared radiance: the error of a 32-sample mean of this image.
    x = image().read()
    noise = x.var(axis=-1).mean() / 32
    assert history.validation_baseline[0] == pytest.approx(noise * (1 + 32 / 96), rel=0.5)


def test_training_with_patience_takes_the_weights_of_the_least_validation_error(trained):
    patient = MLP.preset("elek2019").train(image(), seed=0, patience=300)
    history = patient.history
    best = history.iteration[history.validation_loss.argmin()]
    assert history.iteration[-1] == best + 300 < 30_000
    assert patient.provenance["patience"] == 300
    until = MLP.preset("elek2019").train(image(), seed=0, iterations=int(best))
    x = image(seed=5).read()[..., :32]
    assert (patient.predict(x) == until.predict(x)).all()
    assert "patience" not in trained.provenance


def test_pixels_that_trained_are_exposed_and_at_most_half(trained):
    assert len(trained.train_pixels) == 24 * 24 // 2
    assert trained.train_shape == (24, 24)
    assert trained.provenance["pixels_wanted"] == 6400
    assert trained.provenance["pixels_used"] == 288
    assert (trained.train_pixels == draw_pixels((24, 24), 6400, seed=0)).all()


def test_scaling_the_radiance_scales_the_estimate():
    dim = image(spp=64)
    bright = chd.Samples.from_array(1024 * dim.read())
    x = dim.read()[..., :32]
    models = [MLP.preset("elek2019").train(s, iterations=200) for s in (dim, bright)]
    assert models[1].predict(1024 * x) == pytest.approx(1024 * models[0].predict(x), rel=1e-3)


def test_leading_axes_are_a_batch(trained):
    x = image().read()[..., :32]
    whole = trained.predict(x)
    assert whole.shape == (24, 24, 3)
    assert whole.dtype == np.float32
    assert trained.predict(x[3, 4, 1]) == pytest.approx(whole[3, 4, 1], rel=1e-4, abs=1e-5)
    assert trained.predict(np.empty((0, 32))).shape == (0,)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_a_bad_sample_counts_as_the_mean_of_the_others(trained):
    x = np.random.default_rng(0).gamma(1, size=32)
    filled = x.copy()
    filled[5] = np.delete(x, 5).mean()
    for bad in (np.nan, np.inf, -np.inf):
        x[5] = bad
        assert trained.predict(x) == pytest.approx(trained.predict(filled))
    assert np.isnan(trained.predict(np.full(32, np.nan)))


def test_an_estimate_that_overflows_is_the_mean(trained):
    x = np.full(32, 3e38, np.float32)
    assert np.isfinite(trained.predict(x))
    faint = image(spp=64).read() * np.float32(1e-42)
    model = MLP.preset("elek2019").train(chd.Samples.from_array(faint), iterations=100)
    assert model.predict(faint[..., :32]) == pytest.approx(faint[..., :32].mean(-1), abs=3e-45)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_batches_with_bad_samples_do_not_train_and_are_counted():
    x = image(spp=64).read().copy()
    x[:, :, 1, 40] = np.nan
    model = MLP.preset("elek2019").train(chd.Samples.from_array(x), iterations=10)
    assert model.provenance["batches_used"] == model.provenance["batches_excluded"] == 288


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"iterations": 0}, "at least 1"),
        ({"pixels": [[0.5, 0]]}, "integer rows"),
        ({"pixels": [[0, 24]]}, "within|lie in"),
        ({"pixels": [0, 1]}, "integer rows"),
    ],
)
def test_training_refuses_what_it_cannot_use(options, match):
    with pytest.raises(InputError, match=match):
        MLP.preset("elek2019").train(image(spp=64), **options)


def test_training_says_how_many_samples_it_needs():
    with pytest.raises(InputError, match="at least 64 spp, got 63"):
        MLP.preset("elek2019").train(image(spp=63))
    with pytest.raises(InputError, match="at least 2 batches"):
        MLP.preset("elek2019").train(chd.Samples.from_array(np.ones((1, 1, 3, 64))))


def test_untrained_and_misfed_networks_say_so(trained):
    with pytest.raises(InputError, match="not trained yet"):
        MLP.preset("elek2019").predict(np.ones(32))
    with pytest.raises(InputError, match="exactly 32 samples"):
        trained.predict(np.ones((4, 31)))
    with pytest.raises(InputError, match="elek2019"):
        MLP.preset("elek")


def test_a_file_with_parts_missing_or_of_the_wrong_shape_is_refused(tmp_path):
    path = tmp_path / "model"
    about = {
        "kind": "mlp",
        "preset": {"name": "x", "source": "y", "hidden": [4]},
        "train_shape": [2, 2],
    }
    write_model(path, {"weight0": np.zeros((32, 4))}, about)
    with pytest.raises(StoreError, match="whole network"):
        MLP.load(path)
    about |= {"scale": 1.0, "provenance": {}}
    arrays = {f"weight{i}": np.full((4, 4), np.nan, np.float32) for i in range(4)}
    arrays |= {"history": np.zeros((0, 5)), "train_pixels": np.zeros((0, 2), np.int64)}
    write_model(path, arrays, about)
    with pytest.raises(StoreError, match="finite weights"):
        MLP.load(path)


def test_a_model_cannot_be_written_where_there_is_no_folder(trained, tmp_path):
    with pytest.raises(StoreError, match="cannot write"):
        trained.save(tmp_path / "nowhere" / "model")


def test_presets_are_open_to_other_networks():
    small = Preset(name="small", source="this test", inputs=8, hidden=(4,), iterations=20)
    model = MLP(small).train(image(spp=32))
    assert model.predict(np.ones((3, 8))).shape == (3,)
