"""The learned estimator: it learns, repeats, never says NaN, and survives a round trip to disk."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.estimators import MLP, PRESETS, Preset
from chdstat.estimators.elek2019 import RECORD_EVERY, _validated, evaluate, initial_weights
from chdstat.estimators.held_out import draw_pixels
from chdstat.estimators.training import read_model, write_model


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


def test_training_beats_the_mean_of_nulls(trained):
    history = trained.history
    assert (history.iteration == np.arange(100, 601, RECORD_EVERY)).all()
    assert history.train_loss[-1] < history.train_loss[0]
    assert history.validation_baseline[0] > 0
    # The baseline is in squared radiance: the error of a 32-sample mean of this image.
    x = image().read()
    noise = x.var(axis=-1).mean() / 32
    assert history.validation_baseline[0] == pytest.approx(noise * (1 + 32 / 96), rel=0.5)


def test_patience_keeps_the_best_weights(trained):
    patient = MLP.preset("elek2019").train(image(), seed=0, patience=300)
    history = patient.history
    best = history.iteration[history.validation_loss.argmin()]
    assert history.iteration[-1] == best + 300 < 30_000
    assert patient.provenance["patience"] == 300
    until = MLP.preset("elek2019").train(image(), seed=0, iterations=int(best))
    x = image(seed=5).read()[..., :32]
    assert (patient.predict(x) == until.predict(x)).all()
    assert "patience" not in trained.provenance


# --- certainty ----------------------------------------------------------------------------------


def of_one_radiance(spp=128):
    rng = np.random.default_rng(3)
    return chd.Samples.from_array(rng.exponential(size=(64, 64, 1, spp)))


def test_where_the_network_is_right_it_is_followed():
    """All pixels have the radiance 1, which a network learns; the mean of 32 does not know it."""
    samples = of_one_radiance()
    model = MLP.preset("elek2019").train(samples, iterations=1500)
    found = model.estimate(samples.read(ss=slice(0, 32)))
    assert found.certainty.min() > 0.9
    mean = samples.read(ss=slice(0, 32)).mean(axis=-1)
    assert np.square(found.radiance - 1).mean() < 0.2 * np.square(mean - 1).mean()


def test_a_network_of_noise_falls_back_to_the_mean():
    """Samples hardly vary, so that the mean is right, and the network has learned nothing."""
    rng = np.random.default_rng(3)
    x = rng.lognormal(size=(24, 24, 3, 1)) * rng.normal(1, 0.01, size=(24, 24, 3, 64))
    model = MLP.preset("elek2019").train(chd.Samples.from_array(x), iterations=1)
    found, mean = model.estimate(x[..., :32]), x[..., :32].mean(axis=-1)
    assert found.certainty.max() < 0.02
    assert found.radiance == pytest.approx(mean, rel=0.02)
    assert not np.allclose(model.predict(x[..., :32]), mean, rtol=0.2)


def test_certainty_is_the_mean_s_share_of_noise():
    """Of means with variance v and networks with variance w, it is v / (v + w), in each octave."""
    rng = np.random.default_rng(0)
    truth = np.repeat([0.35, 1.4, 5.6], 20_000)  # far from the ends of their octaves
    v, w = (np.repeat(parts, 20_000) * truth for parts in ([0.03, 0.03, 0.04], [0.01, 0.03, 0.08]))
    mean, network = (rng.normal(truth, deviation) for deviation in (v, w))
    target = rng.normal(truth, 0.02 * truth)
    certainty, residuals = _validated(mean, network, target)
    assert certainty[[3, 5, 7]] == pytest.approx([0.9, 0.5, 0.2], abs=0.02)
    # Classes without a row take that of all.
    assert certainty[0] == certainty[9]
    # The residuals are those of the mixture and of the target; the octave of 1.4 begins at 1.
    deviation = 1.4 * np.sqrt(0.03**2 / 2 + 0.02**2)
    assert residuals[5, [20, 380]] == pytest.approx(
        [-1.645 * deviation, 1.645 * deviation], rel=0.03
    )


def test_one_row_does_not_decide_for_its_class():
    truth = np.ones(5000)
    mean = np.random.default_rng(0).normal(1, 0.05, 5000)
    mean[0], network = 30, truth.copy()
    network[0], truth[0] = 90, 30  # a firefly, which the network makes worse
    certainty, _ = _validated(mean, network, truth)
    assert certainty[5] == pytest.approx(1, abs=0.05)
    assert certainty[9] > 0.5
    assert _validated(truth, truth, truth)[0].tolist() == [0] * 10  # nowhere to go


def test_intervals_hold_pixels_that_did_not_train(trained):
    """The training is small, so that its quantiles are, too: wide limits, with the fixed seeds."""
    x = image(height=64, width=64, spp=32 + 4096, seed=9).read()
    truth = x[..., 32:].mean(axis=-1, dtype=np.float64)
    for level in (0.5, 0.9):
        found = trained.estimate(x[..., :32], level=level)
        assert found.level == level
        held = ((found.low <= truth) & (truth <= found.high)).mean()
        assert level - 0.03 < held < level + 0.05
        assert (found.low <= found.radiance).all()
        assert (found.radiance <= found.high).all()
        assert found.low.min() >= min(0, found.radiance.min())


def test_certainty_mixes_mean_and_network(trained):
    x = image(seed=5).read()[..., :1, :32]  # of one channel, whose certainty is the pixel's
    found, network = trained.estimate(x), trained.predict(x)
    mean, certainty = x.mean(axis=-1, dtype=np.float64), found.certainty[..., np.newaxis]
    assert found.radiance == pytest.approx(mean + certainty * (network - mean), rel=1e-5, abs=1e-6)
    assert 0 <= certainty.min() < certainty.max() <= 1


def test_without_certainty_there_is_no_interval(trained, tmp_path):
    path, x = tmp_path / "old.safetensors", image(seed=5).read()[..., :32]
    trained.save(path)
    whole = MLP.load(path).estimate(x)
    for name, array in vars(trained.estimate(x)).items():
        np.testing.assert_array_equal(getattr(whole, name), array)
    arrays, about = read_model(path)
    assert arrays.pop("certainty").shape == arrays.pop("residuals").shape[:1]
    write_model(path, arrays, about)
    found = MLP.load(path).estimate(x)
    assert found.radiance == pytest.approx(trained.predict(x), rel=1e-6, abs=1e-7)
    assert (found.certainty == 1).all()
    assert np.isnan([found.level, found.low.max(), found.high.max()]).all()


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_bad_black_and_signed_have_estimates(trained):
    x = image(seed=5).read()[:3, :4, :, :32].copy()
    x[0, 0], x[0, 1, 2, 3], x[1], x[2, 0] = np.nan, np.inf, 0, -1
    found = trained.estimate(x)
    assert np.isnan(found.radiance[0, 0]).all()
    rest = np.delete(found.radiance.reshape(12, 3), 0, axis=0)
    assert np.isfinite(rest).all()
    assert (found.low.reshape(12, 3)[1:] <= rest).all()
    dark = chd.Samples.from_array(np.zeros((4, 4, 3, 64)))
    black = MLP.preset("elek2019").train(dark, iterations=50)
    assert not black.estimate(np.zeros((2, 3, 32))).radiance.any()
    for wrong, told in ((np.ones(32), "channel"), (np.ones((3, 31)), "exactly 32")):
        with pytest.raises(InputError, match=told):
            trained.estimate(wrong)
    with pytest.raises(InputError, match="level"):
        trained.estimate(x, level=1)


# --- what it was trained on ---------------------------------------------------------------------


def test_trained_pixels_are_at_most_half(trained):
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
def test_bad_batches_do_not_train():
    x = image(spp=64).read().copy()
    x[:, :, 1, 40] = np.nan
    model = MLP.preset("elek2019").train(chd.Samples.from_array(x), iterations=10)
    assert model.provenance["batches_used"] == model.provenance["batches_excluded"] == 288


def test_untrained_and_misfed_networks_say_so(trained):
    with pytest.raises(InputError, match="32"):
        trained.predict(np.ones((4, 31)))


def test_incomplete_model_files_are_refused(tmp_path):
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


def test_a_model_needs_a_folder(trained, tmp_path):
    with pytest.raises(StoreError, match="cannot write"):
        trained.save(tmp_path / "nowhere" / "model")


def test_presets_are_open_to_other_networks():
    small = Preset(name="small", source="this test", inputs=8, hidden=(4,), iterations=20)
    model = MLP(small).train(image(spp=32))
    assert model.predict(np.ones((3, 8))).shape == (3,)
