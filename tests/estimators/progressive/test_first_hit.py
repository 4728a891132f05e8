"""First hits as numbers: of unit size, finite whatever comes, and none where there are none."""

import numpy as np
import pytest

from chdstat.errors import InputError
from chdstat.estimators.progressive.inputs import describe


def features(height=8, width=10, seed=0):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(height, width, 3))
    return {
        "albedo": rng.random((height, width, 3)),
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "depth": rng.lognormal(size=(height, width)),
        "position": 100 * rng.normal(size=(height, width, 3)),
    }


def test_all_features_are_of_about_unit_size():
    found = describe(features(), (8, 10))
    assert found.shape == (8, 10, 6 + 3 + 1 + 21)
    assert found.dtype == np.float32
    assert np.abs(found).max() < 10


def test_those_that_are_missing_are_left_out():

    assert describe({}, (8, 10)).shape == (8, 10, 0)
    assert describe({"depth": np.ones((8, 10))}, (8, 10)).shape == (8, 10, 1)
    assert describe({"uv": np.ones((8, 10))}, (8, 10)).shape == (8, 10, 0)


def test_the_unit_of_length_and_the_place_of_the_world_do_not_matter():
    here = features()
    there = here | {"depth": 1000 * here["depth"], "position": 1000 * here["position"] + 5e4}
    assert describe(there, (8, 10)) == pytest.approx(describe(here, (8, 10)), abs=1e-3)


@pytest.mark.parametrize("name", ["albedo", "normal", "depth", "position"])
def test_what_is_not_finite_gives_finite_numbers(name):
    holes = features()
    holes[name][0, 0] = np.nan
    holes[name][1, 1] = np.inf
    holes[name][2, 2] = -np.inf
    assert np.isfinite(describe(holes, (8, 10))).all()


def test_an_image_of_one_surface_is_described():
    flat = {name: np.ones_like(field) for name, field in features().items()}
    assert np.isfinite(describe(flat, (8, 10))).all()


@pytest.mark.parametrize("shape", [(8, 9, 3), (10, 8, 3), (8, 10, 1, 3), (80,)])
def test_a_feature_of_another_shape_is_refused(shape):
    with pytest.raises(InputError, match=r"'albedo' must have shape \(8, 10\)"):
        describe({"albedo": np.ones(shape)}, (8, 10))
