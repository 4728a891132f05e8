"""Tone-mapped average: the formula, its limits, and where it is listed."""

import numpy as np
import pytest

from chdstat import estimators


def test_the_average_is_that_of_the_formula():
    x = np.random.default_rng(0).gamma(0.5, size=(4, 5, 1, 16))
    weight = 1 / (1 + x / 0.7)
    expected = (x * weight).sum(axis=-1) / weight.sum(axis=-1)
    assert estimators.karis2013(x, unit=0.7) == pytest.approx(expected, rel=1e-12)


def test_in_a_dark_unit_it_is_harmonic_and_in_a_bright_one_the_mean():
    x = np.random.default_rng(1).uniform(1, 9, size=(3, 1, 16))
    harmonic = 16 / (1 / x).sum(axis=-1)
    assert estimators.karis2013(x, unit=1e-9) == pytest.approx(harmonic, rel=1e-6)
    assert estimators.karis2013(x, unit=1e9) == pytest.approx(x.mean(axis=-1), rel=1e-6)


def test_all_channels_of_a_sample_have_one_weight():
    x = np.array([[1.0, 900.0], [1.0, 0.0], [1.0, 0.0]])
    red, green, blue = estimators.karis2013(x, unit=1.0)
    assert green == blue < 1 < red
