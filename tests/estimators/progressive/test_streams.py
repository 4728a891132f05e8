"""Streams: what is fed in parts gives what all samples give, in memory that does not grow."""

import copy

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import Progressive, Stream, mean_radiance
from chdstat.patterns import CHD, Component, truth_of


def parts(x, *ends):
    return np.split(x, list(ends), axis=-1)


def test_a_stream_gives_the_estimate_of_all_samples(trained, image):
    x = image(12, 64, seed=4).x
    stream = Stream(trained, unit=0.3)
    for part in parts(x, 1, 9, 32):
        stream.update(part)
    expected = trained.estimate(x, unit=0.3)
    found = stream.estimate()
    for name in ("radiance", "certainty", "low", "high"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-3, abs=1e-5)
    assert stream.mean() == pytest.approx(x.mean(axis=-1), rel=1e-5)
    assert (stream.count == 64).all()


@pytest.mark.parametrize("ends", [(1, 9), ()])
def test_lamps_keep_their_light(trained, image, ends):
    x = image(12, 32, seed=4).x.copy()
    x[0, 0], x[1, 1, 0], x[2, 2] = 7.0, 7.0, 3.0
    x[2, 2, 1, 20] = 3.5
    stream = Stream(trained, unit=0.3)
    for part in parts(x, *ends):
        stream.update(part)
    found, expected = stream.estimate(), trained.estimate(x, unit=0.3)
    assert (found.radiance[0, 0] == 7).all()
    assert found.certainty[0, 0] == 0
    assert (found.radiance[2, 2] != 3).all()
    assert found.radiance == pytest.approx(expected.radiance, rel=1e-3, abs=1e-5)


def test_features_are_looked_at(image):
    source = image(12, 32, seed=4)
    features = source.samples.features
    model = Progressive(inputs=["features"]).train(source.samples, iterations=3, progress=False)
    stream = Stream(model, features=features, unit=1.0)
    stream.update(source.x)
    expected = model.predict(source.x, features=features, unit=1.0)
    assert stream.estimate().radiance == pytest.approx(expected, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize(("unit", "profiles"), [(1.0, 1), (None, 3)])
def test_memory_does_not_grow(trained, unit, profiles):
    """Where trust is measured, two halves of the samples are kept beside all of them."""
    stream = Stream(trained, unit=unit)
    assert stream.nbytes == 0
    sizes = set()
    for seed in range(4):
        stream.update(np.random.default_rng(seed).exponential(size=(4, 5, 3, 64)))
        sizes.add(stream.nbytes)
    assert sizes == {profiles * 20 * (24 * 4 + 1) * 8 + 20 * (3 * 8 + 1)}


def test_the_unit_is_that_of_the_first_samples(trained):
    x = np.random.default_rng(0).exponential(size=(8, 8, 3, 32)).astype(np.float32)
    stream, bright = Stream(trained), Stream(trained)
    for part in parts(x, 8):
        stream.update(part)
        bright.update(part * 256)
    assert (bright.estimate().radiance == 256 * stream.estimate().radiance).all()


def test_black_batches_say_nothing_of_the_unit(trained):
    x = 1e-4 * np.random.default_rng(0).exponential(size=(8, 8, 3, 32)).astype(np.float32)
    dark = np.zeros((8, 8, 3, 4), np.float32)
    stream, expected = Stream(trained), Stream(trained, unit=mean_radiance(x))
    for part in (dark, dark, x):
        stream.update(part)
        expected.update(part)
    found, given = (one.estimate(trust=1.0).radiance for one in (stream, expected))
    assert found == pytest.approx(given, rel=1e-6)
    pupil = Stream(Progressive(), learns=True)
    for part in (dark, x):
        pupil.update(part)
    pupil.learn(iterations=4)
    assert pupil.model.provenance["scenes"][0]["unit"] == pytest.approx(1e-4, rel=0.2)


def test_certainty_rests_less_on_experience_with_every_sample(trained):
    """The worth of experience is answered anew each time, but is bounded."""
    stream = Stream(trained)
    for seed in range(3):
        stream.update(np.random.default_rng(seed).exponential(size=(2, 2, 3, 4096)))
    assert (stream.estimate().certainty <= 2**12 / (2**12 + 3 * 4096) + 1e-6).all()


def test_bad_samples_are_left_out_and_a_pixel_of_none_else_is_unknown(trained):
    x = np.random.default_rng(0).exponential(size=(4, 4, 3, 8))
    x[0, 0] = np.nan
    x[1, 1, 2, 3] = -np.inf
    stream = Stream(trained, unit=1.0)
    stream.update(x)
    assert stream.count[0, 0] == 0
    assert stream.count[1, 1] == 7
    found = stream.estimate()
    for values in (found.radiance, found.low, found.high):
        assert np.isnan(values[0, 0]).all()
        assert np.isfinite(values[1:]).all()
    assert found.certainty[0, 0] == 0
    stream.update(np.ones((4, 4, 3, 1)))
    assert np.isfinite(stream.estimate().radiance).all()


def test_a_first_batch_without_a_good_sample_can_be_followed(trained):
    stream = Stream(trained)
    stream.update(np.full((2, 2, 3, 4), np.nan))
    assert np.isnan(stream.estimate().radiance).all()
    stream.update(np.ones((2, 2, 3, 4)))
    assert np.isfinite(stream.estimate().radiance).all()


def test_before_the_first_samples_there_is_nothing_to_say(trained):
    for call in (Stream(trained).mean, Stream(trained).estimate, lambda: Stream(trained).count):
        with pytest.raises(InputError, match="no samples yet"):
            call()


@pytest.mark.parametrize("shape", [(4, 5, 3, 8), (4, 4, 1, 8), (16, 3, 8)])
def test_other_pixels_are_refused(trained, shape):
    stream = Stream(trained)
    stream.update(np.ones((4, 4, 3, 8)))
    with pytest.raises(InputError, match="the stream holds pixels"):
        stream.update(np.ones(shape))


def test_samples_without_channels_are_refused(trained):
    with pytest.raises(InputError, match=r"\(..., channel, sample\)"):
        Stream(trained).update(np.ones(8))


def test_one_that_looks_at_neighbours_needs_the_samples(alone):
    with pytest.raises(InputError, match="neighbours, which need the samples"):
        Stream(alone)


# --- learning while they arrive -----------------------------------------------------------------


def learner(source, *, batch=16, iterations=(), **options):
    """Return a stream that was fed batch by batch, and learned after the last ones."""
    features = source.samples.features
    stream = Stream(Progressive(inputs=["features"]), features=features, learns=True, **options)
    batches = np.split(source.x, range(batch, source.x.shape[-1], batch), axis=-1)
    times = [0] * (len(batches) - len(iterations)) + list(iterations)
    for x, count in zip(batches, times, strict=True):
        stream.update(x)
        if count:
            stream.learn(iterations=count)
    return stream


@pytest.fixture(scope="module")
def source(image):
    return image(24, 64, seed=7)


@pytest.fixture(scope="module")
def taught(source):
    """Return a stream of 64 samples that learned from 32 of them, and then from all."""
    return learner(source, iterations=(20, 0, 60), attrs={"scene": "made up"})


def test_before_it_has_learned_the_estimate_is_the_mean(source):
    stream = learner(source)
    found = stream.estimate()
    assert found.radiance == pytest.approx(source.x.mean(axis=-1), rel=1e-4, abs=1e-6)
    assert (found.certainty == 0).all()
    assert np.isnan([found.level, *found.low.ravel(), *found.high.ravel()]).all()
    with pytest.raises(InputError, match="not trained yet"):
        _ = stream.model.provenance


def test_learning_brings_it_nearer_to_the_truth():
    """Nulls and long tails, all pixels alike; the truth is known, and the mean has an error of 1.

    The network begins at the mean. Of 1024 pixels, errors below 0.9 by chance alone would be a
    matter of less than one seed in a thousand: the mean's squared error varies by 1 in 20.
    """
    similar = CHD((Component("lognormal", 1.0, 0.8),), tail_index=0.3, null_share=0.6)
    samples = chd.simulate([similar], shape=(32, 32), spp=64, seed=3)
    truth = truth_of(samples)["mean"].to_numpy()[..., np.newaxis]
    stream = Stream(Progressive(), learns=True)
    for part in np.split(samples.read(), 4, axis=-1):
        stream.update(part)
    stream.learn(iterations=300)
    errors = [((p - truth) ** 2).mean() for p in (stream.estimate().radiance, stream.mean())]
    assert errors[0] < 0.9 * errors[1]


def test_the_interval_holds_the_truth(source, taught):
    found = taught.estimate()
    inside = (found.low <= source.radiance) & (source.radiance <= found.high)
    assert found.level == 0.9
    assert inside.mean() > 0.75


def test_constant_pixels_stay_where_they_are():
    """The negative control: where samples do not differ, there is nothing to improve."""
    level = np.random.default_rng(0).lognormal(size=(16, 16, 3, 1))
    stream = Stream(Progressive(), learns=True)
    for _ in range(4):
        stream.update(np.broadcast_to(level, (16, 16, 3, 8)).astype(np.float32))
        stream.learn(iterations=8)
    assert stream.estimate().radiance == pytest.approx(level[..., 0], rel=1e-5)
    assert stream.iterations == 0
    # Once they differ, there is something to learn.
    stream.update(np.random.default_rng(1).exponential(size=(16, 16, 3, 8)))
    stream.learn(iterations=1)
    assert stream.iterations == 1


def test_a_black_image_stays_black():
    stream = Stream(Progressive(), learns=True)
    stream.update(np.zeros((8, 8, 3, 8)))
    stream.learn(iterations=5)
    assert (stream.estimate().radiance == 0).all()


def test_learning_goes_on_from_where_it_was(source):
    stream = learner(source, iterations=(30,))
    before = stream.model
    first = before.history.validation_loss[-1]
    weights = before.state.network.to_arrays()
    stream.learn(iterations=1)
    history = stream.model.history
    assert stream.iterations == 31
    assert (np.diff(history.iteration) > 0).all()
    # One step of a new network would be near the loss of the mean.
    assert abs(history.validation_loss[-1] - first) < abs(history.validation_baseline[-1] - first)
    after = stream.model.state.network.to_arrays()
    assert any((after[name] != w).any() for name, w in weights.items())


def test_memory_does_not_grow_where_it_learns(source):
    stream, sizes = Stream(Progressive(), learns=True), set()
    for seed in range(4):
        stream.update(np.random.default_rng(seed).exponential(size=(4, 5, 3, 64)))
        sizes.add(stream.nbytes)
    assert sizes == {20 * (24 * 4 + 1) * 8 + 20 * 8 * (24 * 4 * 4 + 3 * 8 + 8) + 20 * 25}


def test_the_same_seed_learns_the_same(source):
    first, again, other = (
        learner(source, iterations=(4,), seed=seed).model.state.network.to_arrays()
        for seed in (1, 1, 2)
    )
    assert all((first[name] == again[name]).all() for name in first)
    assert any((first[name] != other[name]).any() for name in first)


def test_what_was_learned_is_a_model_like_any_other(source, taught, tmp_path):
    taught.model.save(tmp_path / "a.safetensors")
    loaded = Progressive.load(tmp_path / "a.safetensors")
    features = source.samples.features
    ours = taught.model.predict(source.x, features=features)
    assert (loaded.predict(source.x, features=features) == ours).all()
    told = loaded.provenance
    assert (told["scene"], told["on_the_fly"], told["reference"]) == ("made up", True, False)
    assert (told["iterations"], told["samples_shape"]) == (80, [24, 24, 3, 64])
    assert told["pixels_used"] == len(loaded.train_pixels) == 24 * 24
    assert loaded.train_shape == (24, 24)


def test_one_that_was_trained_before_learns_on(source, trained):
    start = trained.predict(source.x)
    stream = Stream(copy.copy(trained), learns=True, unit=1.0)
    stream.update(source.x)
    expected = trained.predict(source.x, unit=1.0)
    assert stream.estimate().radiance == pytest.approx(expected, rel=1e-3, abs=1e-5)
    before = stream.iterations
    stream.learn(iterations=3)
    assert stream.iterations == before + 3
    assert stream.model.provenance["began_from"]["scene"] == trained.provenance["scene"]
    assert (trained.predict(source.x) == start).all()


def test_bad_samples_are_left_out_where_it_learns(source):
    x = source.x.copy()
    x[0, 0], x[1, 1, 2, 3], x[2, 2, :, 0], x[3, 3, 0, 0] = np.nan, -np.inf, np.inf, 1e30
    stream = Stream(Progressive(), learns=True)
    stream.update(x)
    stream.learn(iterations=3)
    assert stream.model.provenance["pixels_excluded"] == 4
    radiance = stream.estimate().radiance
    assert np.isnan(radiance[0, 0]).all()
    assert np.isfinite(radiance).sum() == 3 * (24 * 24 - 1)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"model": Progressive(inputs=["neighbours"])}, "neighbours, which need the samples"),
        ({"model": Progressive(inputs=["features"])}, "looks at first-hit features"),
    ],
)
def test_models_that_cannot_learn_from_a_stream_are_refused(options, match):
    with pytest.raises(InputError, match=match):
        Stream(options["model"], learns=True)


@pytest.mark.parametrize(
    ("x", "match"),
    [
        (np.ones((4, 4, 3, 1)), "at least 4 samples of each pixel, got 1"),
        (np.full((4, 4, 3, 8), np.nan), "got 0 of 16: give a larger image"),
        (np.ones((1, 1, 3, 8)), "got 1 of 1: give a larger image"),
    ],
)
def test_too_little_to_learn_from_is_refused(x, match):
    stream = Stream(Progressive(), learns=True)
    stream.update(x)
    with pytest.raises(InputError, match=match):
        stream.learn(iterations=1)
    assert stream.estimate().radiance == pytest.approx(x.mean(axis=-1), nan_ok=True)


def test_learning_needs_a_stream_that_learns_an_image(trained, source):
    with pytest.raises(InputError, match="make it with learns=True"):
        Stream(trained).learn(iterations=1)
    fresh = Stream(Progressive(), learns=True)
    with pytest.raises(InputError, match="no samples yet"):
        fresh.learn(iterations=1)
    with pytest.raises(InputError, match="iterations must be at least 1, got 0"):
        fresh.learn(iterations=0)
    with pytest.raises(InputError, match=r"takes an image .*, got pixels \(9,\)"):
        fresh.update(np.ones((9, 3, 8)))
    fresh.update(source.x)
    with pytest.raises(InputError, match="the stream holds pixels"):
        fresh.update(source.x[1:])
    with pytest.raises(InputError, match="with 3 channels, got 1"):
        Stream(copy.copy(trained), learns=True).update(np.ones((4, 4, 1, 8)))
