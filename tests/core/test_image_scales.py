"""Scales of an image: its mean radiance is the mean, whatever its shape and a few fireflies."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import Progressive, mean_radiance

SIDES = (*range(1, 20), 63, 64, 65, 100, 127, 128, 129, 200)


def columns(y, x, height, width):
    return np.where(x / width < 0.3, 10.0, 0.1)


def rows(y, x, height, width):
    return columns(x, y, width, height)


def checkerboard(y, x, height, width):
    return np.where((y + x) % 2, 5.0, 0.01)


def gradient(y, x, height, width):
    return 0.01 + (x / width) ** 4 * 20


def lamps(y, x, height, width):
    return np.where((7 * x + 11 * y) % 33 == 0, 8.0, 0.3)


def one_lamp(y, x, height, width):
    return np.where((y == height // 2) & (x == width // 3), 1000.0, 0.3)


PATTERNS = (columns, rows, checkerboard, gradient, lamps, one_lamp)


def noise_free(pattern, height, width, spp=2):
    y, x = np.mgrid[:height, :width]
    radiance = pattern(y, x, height, width).astype(np.float32)[..., np.newaxis, np.newaxis]
    return np.broadcast_to(radiance, (height, width, 1, spp))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_without_noise_it_is_the_mean_at_every_width_and_height(pattern):
    """The median of means of every 64th pixel was .10 and 5.05 of columns of 3.1, 64 and 128 wide.

    All that it may differ by is rounding: no sample of a pixel differs from the others.
    """
    shapes = [(height, side) for side in SIDES for height in (1, 64)]
    for shape in [*shapes, *(shape[::-1] for shape in shapes), (200, 200)]:
        image = noise_free(pattern, *shape)
        assert mean_radiance(image) == pytest.approx(image.mean(dtype=np.float64), rel=1e-9)


@pytest.mark.parametrize("spp", [1, 2, 16])
@pytest.mark.parametrize("shape", [(1, 1024), (32, 32), (64, 65), (200, 128)])
@pytest.mark.parametrize("brighter", [1e4, 1e30])
def test_one_firefly_hardly_moves_it_and_seven_little(shape, spp, brighter):
    """One is limited to 4 % of the sum, seven to 4 / (100 - 7 * 4) each."""
    rng = np.random.default_rng(0)
    x = rng.lognormal(size=(*shape, 1, 1)) * rng.exponential(size=(*shape, 1, spp))
    before = mean_radiance(x)
    assert before == pytest.approx(x.mean(), rel=0.03)
    for fireflies, most in ((1, 0.045), (7, 0.4)):
        wild = x.copy()
        wild.reshape(-1)[rng.permutation(x.size)[:fireflies]] = brighter * x.mean()
        assert 1 < mean_radiance(wild) / before < 1 + most
    assert wild.mean() > 1.1 * before  # the plain mean, the negative control


def test_a_lamp_is_told_from_a_firefly_by_its_other_samples():
    x = np.full((32, 32, 3, 4), 0.3)
    lamp, firefly, alone = x.copy(), x.copy(), x[..., :1].copy()
    lamp[5, 6], firefly[5, 6, :, 2], alone[5, 6] = 1000, 4000, 1000
    assert mean_radiance(lamp) == pytest.approx(lamp.mean(), rel=1e-9)
    assert lamp.mean() == pytest.approx(firefly.mean(), rel=1e-3)
    assert mean_radiance(firefly) == pytest.approx(0.3, rel=0.05)
    # One sample of each pixel tells nothing: it counts as a firefly.
    assert mean_radiance(alone) == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize(("nulls", "spp"), [(0.0, 4), (0.9, 64), (0.99, 4)])
def test_light_that_comes_seldom_does_not_bias_it(nulls, spp):
    """The mean over 20 images of 64 x 64; its standard error is below 1 % but for 4 % at least spp.

    Limits of three of them: a false failure is an event of 1 in 300, and the seed is fixed.
    """
    rng = np.random.default_rng(1)
    found = []
    for _ in range(20):
        lit = rng.random((64, 64, 1, spp)) >= nulls
        found.append(mean_radiance(lit * rng.exponential(size=lit.shape) / (1 - nulls)))
    tolerance = 3 * np.sqrt(2 / (1 - nulls) / (20 * 64 * 64 * spp))
    assert np.mean(found) == pytest.approx(1, abs=tolerance + 0.002)


@pytest.mark.parametrize("factor", [2.0**-60, 2.0**80])
def test_it_follows_the_unit_of_radiance_to_the_bit(factor):
    x = np.random.default_rng(0).lognormal(size=(40, 32, 3, 4))
    x[3, 4, :, 1] = 1e6
    assert mean_radiance(factor * x) == factor * mean_radiance(x)


def test_it_does_not_depend_on_the_order_of_samples_pixels_or_tiles():
    rng = np.random.default_rng(0)
    x = rng.lognormal(sigma=2, size=(80, 70, 3, 8)).astype(np.float32)
    whole = mean_radiance(x)
    mixed = rng.permutation(rng.permutation(x.reshape(-1, 3, 8)), axis=2)
    assert mean_radiance(mixed) == pytest.approx(whole, rel=1e-12)
    # `Samples` are walked tile by tile, and batch by batch within a tile.
    long = rng.lognormal(sigma=2, size=(80, 70, 3, 96)).astype(np.float32)
    assert mean_radiance(chd.Samples.from_array(long)) == pytest.approx(
        mean_radiance(long), rel=1e-12
    )
    turned = chd.Samples.from_array(np.ascontiguousarray(x[::-1, ::-1]))
    assert mean_radiance(turned) == pytest.approx(whole, rel=1e-12)


def test_a_black_or_unknown_image_is_measured_in_ones():
    lone = np.zeros((32, 32, 1, 4))
    lone[5, 5, 0, 1] = 4096.0  # whose mean is 1
    for x in (np.zeros((40, 40, 3, 2)), np.full((4, 4, 3, 2), np.nan), lone):
        assert mean_radiance(x) == 1


def test_bad_samples_and_pixels_are_left_out():
    x = np.random.default_rng(0).exponential(size=(32, 32, 3, 8))
    known = x[::2].mean()
    x[::2, ::3, 1, 4] = np.nan
    x[1::2] = np.inf
    assert mean_radiance(x) == pytest.approx(known, rel=0.05)


@pytest.mark.parametrize("level", [1e-60, 1e60])
def test_it_can_be_held_in_single_precision(level):
    unit = np.float32(mean_radiance(np.full((20, 20, 3, 2), level)))
    assert 0 < unit < np.inf


def test_samples_without_channels_are_refused():
    with pytest.raises(InputError, match=r"\(..., channel, sample\), got \(8,\)"):
        mean_radiance(np.ones(8))


def test_training_measures_an_image_in_it():
    x = noise_free(columns, 16, 129, spp=16)
    expected = pytest.approx(x.mean(dtype=np.float64), rel=1e-6)
    model = Progressive().train(chd.Samples.from_array(x), sizes=[4], iterations=1, progress=False)
    assert model.unit == expected
