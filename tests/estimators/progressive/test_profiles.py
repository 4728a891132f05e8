"""Profiles: they keep the mean, and know no order."""

import numpy as np
import pytest

from chdstat.errors import InputError
from chdstat.estimators.progressive.inputs import OCTAVES, Profile


def samples(shape=(6, 5, 3, 40), seed=0):
    rng = np.random.default_rng(seed)
    lit = rng.random((*shape[:-2], 1, shape[-1])) < 0.6
    return (lit * rng.lognormal(0, 3, size=shape)).astype(np.float32)


def same(found, expected, rel=1e-5):
    assert (found.count == expected.count).all()
    # Round-off is that of the largest sum that enters.
    assert found.bins == pytest.approx(expected.bins, rel=rel, abs=rel * float(expected.bins.max()))


def test_every_lit_sample_weighs_one_and_a_null_nothing():
    x = samples()
    found = Profile.of(x, unit=1.0)
    assert found.bins[..., 0].sum(axis=-1) == pytest.approx((x > 0).any(axis=-2).sum(axis=-1))
    assert (found.count == 40).all()


def test_a_sample_lies_between_the_two_octaves_of_its_luminance():
    shares = Profile.of([[2.0**1.25]], unit=1.0).bins[:, 0]
    assert np.flatnonzero(shares).tolist() == [13, 14]
    assert shares[[13, 14]] == pytest.approx([0.75, 0.25])
    far = Profile.of([[1e-20, 1e20]], unit=1.0).bins[:, 0]
    assert far[0] == 1
    assert far[-1] == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("pixels", [1, 7, 300])
def test_pixels_have_the_same_profiles_among_few_and_among_many(pixels):
    """So many samples are counted in several blocks, of other pixels where they are fewer."""
    x = samples((900, 3, 512))
    found = Profile.of(x, unit=1.0)
    for first in range(0, 900, 300):
        part = slice(first, first + pixels)
        expected = Profile.of(x[part], unit=1.0)
        assert (found.bins[part] == expected.bins).all()
        assert (found.count[part] == expected.count).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_sample_with_one_bad_channel_is_left_out_as_a_whole(bad):
    x = samples((4, 3, 8))
    spoilt = x.copy()
    spoilt[:, 1, 7] = bad
    same(Profile.of(spoilt, unit=1.0), Profile.of(x[..., :7], unit=1.0))


def test_no_good_sample_has_no_mean():
    found = Profile.of(np.full((2, 3, 4), np.nan), unit=1.0)
    assert (found.count == 0).all()
    assert np.isnan(found.mean()).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("level", [0.0, 1e-42, 1e-30, 1e30, 3e38])
def test_no_radiance_is_too_small_or_too_large(dtype, level):
    found = Profile.of(np.full((1, 3, 4), level, dtype), unit=1.0)
    assert found.count.tolist() == [4]
    assert not np.isnan(found.bins).any()
    assert found.bins[..., 0].sum() == pytest.approx(4 if level else 0)


def test_other_channels_than_three_weigh_alike():
    x = np.array([[1.0, 2.0], [3.0, 6.0]])
    assert Profile.of(x, unit=2.0).bins[12:14, 0] == pytest.approx([1, 1])
    assert Profile.of(np.tile(x[:1], (5, 1)), unit=1.0).bins.shape == (OCTAVES, 6)


@pytest.mark.parametrize("unit", [0.0, -1.0, np.nan, np.inf, 1e-50, 1e300])
def test_units_that_measure_nothing_are_refused(unit):
    with pytest.raises(InputError, match="unit must be a positive radiance"):
        Profile.of(np.ones((3, 4)), unit=unit)
