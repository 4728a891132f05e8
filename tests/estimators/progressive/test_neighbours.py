"""Neighbours: others than the pixel itself, and only those that are similar."""

import numpy as np
import pytest

from chdstat.estimators import Profile
from chdstat.estimators.progressive.inputs import BANDS, RADII, pool_around


def profiles(seed=0, shape=(12, 14, 3, 16)):
    return Profile.of(np.random.default_rng(seed).exponential(size=shape), unit=1.0)


def test_shapes_and_sizes():
    bands, weight = pool_around(profiles(), None)
    assert bands.shape == (12, 14, len(RADII), BANDS, 4)
    assert weight.shape == (12, 14, len(RADII))
    assert (bands >= 0).all()
    assert (np.diff(weight, axis=-1) > 0).all()


def test_what_is_pooled_is_an_average():
    same = Profile.of(np.full((12, 14, 3, 4), 0.3), unit=1.0)
    bands, _ = pool_around(same, None)
    assert bands[..., 0].sum(axis=-1) == pytest.approx(1, rel=1e-5)
    assert bands[..., 1:].sum(axis=-2) == pytest.approx(0.3, rel=1e-5)


def test_the_pixel_itself_is_left_out():
    x = np.random.default_rng(0).exponential(size=(12, 14, 3, 16))
    changed = x.copy()
    changed[5, 6] *= 7
    before, after = (pool_around(Profile.of(a, unit=1.0), None)[0] for a in (x, changed))
    assert after[5, 6] == pytest.approx(before[5, 6], abs=1e-5)
    assert np.abs(after[5, 7] - before[5, 7]).max() > 1e-3


@pytest.mark.parametrize("name", ["albedo", "normal"])
def test_nothing_crosses_an_edge(name):
    x = np.full((8, 8, 3, 4), 0.1)
    x[:, 4:] = 5.0
    field = np.zeros((8, 8, 3))
    field[:, :4, 0] = field[:, 4:, 1] = 1
    bands, _ = pool_around(Profile.of(x, unit=1.0), {name: field})
    found = bands[..., 1:].sum(axis=-2)
    assert found[:, :4] == pytest.approx(0.1, rel=1e-2)
    assert found[:, 4:] == pytest.approx(5.0, rel=1e-2)


def test_a_step_in_depth_is_an_edge_and_a_tilted_plane_is_none():
    normal = np.zeros((9, 9, 3))
    normal[..., 2] = 1
    y, x = np.mgrid[:9, :9] / 9.0
    flat = {"normal": normal, "depth": np.ones((9, 9)), "position": np.dstack([x, y, 0 * x])}
    step = flat | {"position": np.dstack([x, y, (x > 0.5) * 1.0])}
    image = profiles(shape=(9, 9, 3, 4))
    on_plane, over_step = (pool_around(image, f)[1] for f in (flat, step))
    alone = pool_around(image, {"normal": normal})[1]
    assert on_plane == pytest.approx(alone, rel=1e-4)
    assert (over_step[:, 4, 0] < 0.8 * on_plane[:, 4, 0]).all()


def test_pixels_without_good_samples_lend_nothing():
    x = np.full((6, 6, 3, 4), 2.0)
    x[:, :3] = np.nan
    bands, _ = pool_around(Profile.of(x, unit=1.0), None)
    assert bands[:, 3:, :, :, 1:].sum(axis=-2) == pytest.approx(2, rel=1e-4)


def test_one_pixel_has_no_neighbours():
    bands, weight = pool_around(profiles(shape=(1, 1, 3, 4)), None)
    assert (bands == 0).all()
    assert (weight == 0).all()
