"""Recognised samples: those that trained a network, in any order and unit, and no others."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import Progressive


@pytest.fixture(scope="module", params=[1, 3])
def known(request):
    """Return a model and the samples that trained it, nine in ten of them nulls."""
    rng = np.random.default_rng(0)
    x = rng.exponential(size=(24, 20, request.param, 256))
    x *= rng.random((24, 20, 1, 256)) < 0.1
    samples = chd.Samples.from_array(x.astype(np.float32), axes="yxcs")
    return Progressive().train(samples, sizes=(8,), iterations=2, progress=False), samples.read()


def knows(model, x):
    return model.state.recognises(x)


@pytest.mark.parametrize("factor", [1, 2.0**-30, 1e4, np.pi])
def test_samples_that_trained_are_known(known, factor):
    model, x = known
    for part in (x, x[..., 8:40], x[..., ::-7], x[..., :4]):
        assert knows(model, part * np.float32(factor))
    order = np.random.default_rng(1).permutation(256)[:64]
    assert knows(model, x[..., order])


def test_a_small_image_is_known_too():
    x = np.random.default_rng(4).exponential(size=(8, 8, 3, 16)).astype(np.float32)
    model = Progressive().train(chd.Samples.from_array(x), sizes=(8,), iterations=2, progress=False)
    assert knows(model, 7 * x[..., :8])
    assert not knows(model, x[::-1])


def test_other_samples_are_not(known):
    model, x = known
    rng = np.random.default_rng(2)
    for other in (
        rng.exponential(size=x.shape),
        x[::-1],
        np.roll(x, 1, axis=1),
        x[:12],
        np.zeros_like(x),
        np.ones_like(x),
        np.full_like(x, np.nan),
        np.round(255 * x / x.max()),
    ):
        assert not knows(model, other.astype(np.float32))


def test_values_that_many_pixels_share_tell_nothing():
    rng = np.random.default_rng(3)
    one, two = (rng.integers(0, 9, size=(16, 16, 1, 64)).astype(np.float32) for _ in range(2))
    model = Progressive().train(
        chd.Samples.from_array(one), sizes=(8,), iterations=2, progress=False
    )
    assert not knows(model, two)
