"""The unit of a picture follows its radiance, and little else."""

import numpy as np
import pytest

from chdstat.estimators.progressive.exposure import picture_unit


def means(seed=0):
    return np.random.default_rng(seed).lognormal(size=(32, 32, 3))


@pytest.mark.parametrize("factor", [2.0**-60, 0.25, 2.0**80])
def test_it_scales_with_the_radiance_to_the_bit(factor):
    assert picture_unit(factor * means()) == factor * picture_unit(means())


def test_it_is_near_the_mean_and_fireflies_hardly_change_it():
    calm = picture_unit(means())
    assert calm == pytest.approx(means().mean(), rel=0.1)
    wild = means()
    wild[3, 4] = wild[20, 9] = 1e9
    assert picture_unit(wild) == pytest.approx(calm, rel=0.1)


def test_pixels_that_are_not_known_are_left_out():
    holes = means()
    holes[::2, ::3] = np.nan, np.inf, 1
    assert picture_unit(holes) == pytest.approx(means().mean(), rel=0.1)


@pytest.mark.parametrize("picture", [np.zeros((4, 4, 3)), np.full((4, 4, 3), np.nan)])
def test_a_black_or_unknown_picture_is_measured_in_ones(picture):
    assert picture_unit(picture) == 1


def test_a_picture_that_is_black_but_for_one_pixel_has_its_mean():
    lone = np.zeros((32, 32, 1))
    lone[5, 5] = 1024.0
    assert picture_unit(lone) == 1


@pytest.mark.parametrize("level", [1e-60, 1e-42, 1e60])
def test_it_can_be_held_in_single_precision(level):
    unit = np.float32(picture_unit(np.full((4, 4, 3), level)))
    assert 0 < unit < np.inf
