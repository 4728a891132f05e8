from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from chdstat.errors import InputError
from chdstat.scenes.scene import look_at, rotate, scale, translate

# Laws: rotations are rigid. Known answers: Mitsuba 3's own transforms, float32.


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_rotation_is_rigid_and_adds_up(axis):
    turn = rotate(axis, 33.0)
    np.testing.assert_allclose(turn @ turn.T, np.eye(4), atol=1e-15)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    np.testing.assert_allclose(turn @ rotate(axis, 57.0), rotate(axis, 90.0), atol=1e-15)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_rotation_agrees_with_mitsuba(axis):
    mi.set_variant("scalar_rgb")
    direction = [float(axis == name) for name in "xyz"]
    expected = np.array(mi.ScalarTransform4f().rotate(direction, 25.0).matrix)
    np.testing.assert_allclose(rotate(axis, 25.0), expected, atol=1e-6)


def test_look_at_agrees_with_mitsuba():
    mi.set_variant("scalar_rgb")
    arguments = [1.0, 2.0, 3.0], [0.0, 5.0, 1.0]
    expected = np.array(mi.ScalarTransform4f().look_at(*arguments, [0.0, 0.0, 1.0]).matrix)
    np.testing.assert_allclose(look_at(*arguments), expected, atol=1e-6)


def test_look_at_refuses_a_view_along_up():
    with pytest.raises(InputError, match="up must not be parallel"):
        look_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0))


def test_the_rightmost_matrix_acts_first():
    point = translate(1.0, 0.0, 0.0) @ scale(2.0, 2.0, 2.0) @ [1.0, 1.0, 1.0, 1.0]
    np.testing.assert_array_equal(point, [3.0, 2.0, 2.0, 1.0])
