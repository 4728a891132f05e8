"""Streams: what is fed in parts gives what all samples give, in memory that does not grow."""

import numpy as np
import pytest

from chdstat.errors import InputError
from chdstat.estimators import Profile, Progressive, Stream


def parts(x, *ends):
    return np.split(x, list(ends), axis=-1)


def test_a_stream_gives_the_estimate_of_all_samples(trained, picture):
    x = picture(12, 64, seed=4).x
    stream = Stream(trained, unit=0.3)
    for part in parts(x, 1, 9, 32):
        stream.update(part)
    expected = trained.estimate(x, unit=0.3)
    found = stream.estimate()
    for name in ("radiance", "certainty", "low", "high"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-3, abs=1e-5)
    assert stream.mean() == pytest.approx(x.mean(axis=-1), rel=1e-5)
    assert (stream.count == 64).all()


def test_features_are_looked_at(picture):
    source = picture(12, 32, seed=4)
    features = source.samples.features
    model = Progressive(features=True).train(source.samples, iterations=3, progress=False)
    stream = Stream(model, features=features, unit=1.0)
    stream.update(source.x)
    expected = model.predict(source.x, features=features, unit=1.0)
    assert stream.estimate().radiance == pytest.approx(expected, rel=1e-3, abs=1e-5)


def test_memory_does_not_grow(trained):
    stream = Stream(trained)
    assert stream.nbytes == 0
    sizes = set()
    for seed in range(4):
        stream.update(np.random.default_rng(seed).exponential(size=(4, 5, 3, 64)))
        sizes.add(stream.nbytes)
    assert sizes == {20 * (24 * 4 + 1) * 8}


def test_the_unit_is_that_of_the_first_samples(trained):
    x = np.random.default_rng(0).exponential(size=(8, 8, 3, 32)).astype(np.float32)
    stream, bright = Stream(trained), Stream(trained)
    for part in parts(x, 8):
        stream.update(part)
        bright.update(part * 256)
    assert (bright.estimate().radiance == 256 * stream.estimate().radiance).all()


def test_certainty_rests_less_on_experience_with_every_sample(trained):
    """The worth of experience is answered anew each time, but is bounded."""
    stream = Stream(trained)
    for seed in range(3):
        stream.update(np.random.default_rng(seed).exponential(size=(2, 2, 3, 4096)))
    assert (stream.estimate().certainty <= 2**12 / (2**12 + 3 * 4096) + 1e-6).all()


def test_bad_samples_are_left_out_and_a_pixel_of_none_else_is_unknown(trained):
    x = np.random.default_rng(0).exponential(size=(4, 4, 3, 8))
    x[0, 0] = np.nan
    x[1, 1, 2, 3] = -1
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
    with pytest.raises(InputError, match="needs the samples"):
        alone.of_profile(Profile.of(np.ones((4, 4, 3, 8)), unit=1.0))
