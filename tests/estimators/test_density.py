"""Density: the samples that stay are those with a close k-th neighbour."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from chdstat import estimators
from chdstat.errors import InputError


def image(seed=0, shape=(6, 7, 3, 5)):
    return np.random.default_rng(seed).lognormal(0, 1.5, size=shape)


@pytest.mark.parametrize("radius", [0, 1, 2, 3])
@pytest.mark.parametrize("neighbours", [1, 4])
def test_estimate_is_the_mean_of_the_samples_whose_kth_neighbour_is_near(radius, neighbours):
    x = image(shape=(6, 7, 3, 8))
    y, column, _ = np.indices((6, 7, 8))
    colours = np.log(np.moveaxis(x, 2, -1) + 0.01) / (1.2 * np.sqrt(3))
    places = np.stack([y, column], axis=-1) / (radius + 1)
    points = np.concatenate([places, colours], axis=-1).reshape(-1, 5)
    near = (cdist(points, points) < 1).sum(axis=1) > neighbours
    stays = near.reshape(6, 7, 8)
    assert 0 < stays.mean() < 1
    some = stays.any(axis=-1)
    expected = (x * stays[:, :, np.newaxis]).sum(axis=-1)[some] / stays.sum(axis=-1)[some][:, None]
    found = estimators.decoro2010(x, neighbours=neighbours, bandwidth=1.2, radius=radius, unit=1.0)
    assert found[some] == pytest.approx(expected, rel=1e-12)
    assert found[~some] == pytest.approx(x[~some].mean(axis=-1), rel=1e-12)


def test_an_outlier_goes_and_one_that_the_pixels_around_confirm_stays():
    x = np.ones((3, 3, 3, 8))
    x[1, 1, :, 0] = 900.0
    assert estimators.decoro2010(x) == pytest.approx(1)
    x[[0, 0, 1, 2], [0, 1, 0, 1], :, 0] = 900.0
    assert estimators.decoro2010(x)[1, 1] == pytest.approx((900 + 7) / 8)


def test_an_outlier_in_hue_alone_goes():
    x = np.ones((3, 3, 3, 8))
    x[1, 1, :, 0] = 0.02, 0.02, 30.0
    assert estimators.decoro2010(x)[1, 1] == pytest.approx(1)


def test_dim_samples_are_no_outliers():
    x = np.ones((3, 3, 3, 8))
    x[..., :4] = 0
    x[1, 1, :, 0] = 1e-4
    expected = x.mean(axis=-1)
    assert estimators.decoro2010(x) == pytest.approx(expected, rel=1e-12)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_bad_samples_confirm_nothing_and_are_left_out():
    x = np.ones((3, 3, 3, 8))
    x[1, 1, :, 0] = 900.0
    x[:, :, 1, 1] = np.nan
    assert estimators.decoro2010(x) == pytest.approx(1)


def test_all_alone_gives_the_mean():
    x = np.array([1.0, 100.0, 1e4]).reshape(1, 1, 1, 3)
    assert estimators.decoro2010(x) == pytest.approx(x.mean())


@pytest.mark.parametrize("options", [{"neighbours": 0}, {"bandwidth": 0.0}, {"radius": -1}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InputError, match="got"):
        estimators.decoro2010(image(), **options)
