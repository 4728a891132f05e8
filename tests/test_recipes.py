"""Recipes: what is read, what is refused, and where the library looks by itself."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from chdstat._reasons import flag_attributes
from chdstat.errors import InputError
from chdstat.patterns import Label
from chdstat.recipes import Region, choose_regions, find_recipe, load_recipe
from chdstat.scenes import BUILTIN

GOOD = """
schema = 1
scene = "bathroom"
integrator = { type = "path", max_depth = 9 }
size = [128, 96]
spp = 64
seed = 3
[[regions]]
name = "wall"
phenomenon = "diffuse"
rectangle = [0.5, 0.25, 0.75, 0.5]
"""


def write(tmp_path, text):
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    return path


def test_a_recipe_is_read(tmp_path):
    recipe = load_recipe(write(tmp_path, GOOD))
    assert recipe.settings() == {"size": (128, 96), "spp": 64, "seed": 3, "max_depth": 9}
    assert recipe.regions == (Region("wall", "diffuse", (0.5, 0.25, 0.75, 0.5)),)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 7", "schema must be 1, got 7"),
        ("spp = 64", "", "spp must be a int, got None"),
        ("[128, 96]", "[0, 96]", r"size must be \[width, height\]"),
        (
            "[0.5, 0.25, 0.75, 0.5]",
            "[0.5, 0.25, 1.75, 0.5]",
            r"regions\[0\].rectangle must be 0 <=",
        ),
        ("[0.5, 0.25, 0.75, 0.5]", "[0.5, 0.25, 0.5, 0.5]", r"regions\[0\].rectangle must be 0 <="),
        ('"diffuse"', '"glow"', "phenomenon must be one of diffuse, .*, got 'glow'"),
        ("schema = 1", "schema = ", "not valid TOML"),
    ],
)
def test_a_broken_recipe_names_file_and_key(tmp_path, old, new, message):
    path = write(tmp_path, GOOD.replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        load_recipe(path)
    assert str(path) in str(caught.value)


def test_a_missing_recipe_is_an_error_and_an_unknown_scene_has_none(tmp_path):
    with pytest.raises(InputError, match="cannot read recipe"):
        load_recipe(tmp_path / "none.toml")
    assert find_recipe("no-such-scene") is None


def test_built_in_recipes_fit_their_scene():
    found = {name: find_recipe(name) for name in BUILTIN}
    assert found["bathroom"] is not None
    for name, recipe in found.items():
        if recipe is not None:
            assert recipe.scene == name
            for region in recipe.regions:
                ys, xs = region.pixels(recipe.size[1], recipe.size[0])
                assert ys.start < ys.stop <= recipe.size[1]
                assert xs.start < xs.stop <= recipe.size[0]


def test_regions_cover_at_least_a_pixel():
    ys, xs = Region("dot", "diffuse", (0.99, 0.99, 1.0, 1.0)).pixels(4, 4)
    assert (ys, xs) == (slice(3, 4), slice(3, 4))


def test_the_library_chooses_one_pure_region_for_each_pattern():
    label = np.full((32, 32), Label.GAMMA_LIKE, dtype=np.int8)
    label[20:28, 4:12] = Label.BIMODAL
    label[2, 30] = Label.LONG_TAIL
    dataset = xr.Dataset({"label": (("y", "x"), label, flag_attributes(Label))})
    regions = choose_regions(dataset)
    assert [r.name for r in regions] == ["gamma-like", "bimodal", "long-tail"]
    for region, code in zip(regions[:2], (Label.GAMMA_LIKE, Label.BIMODAL), strict=True):
        assert (label[region.pixels(32, 32)] == code).all()
    assert (label[regions[2].pixels(32, 32)] == Label.LONG_TAIL).any()


def test_choosing_works_on_a_single_pixel():
    label = xr.DataArray(
        np.full((1, 1), Label.BLACK), dims=("y", "x"), attrs=flag_attributes(Label)
    )
    (region,) = choose_regions(xr.Dataset({"label": label}))
    assert region.pixels(1, 1) == (slice(0, 1), slice(0, 1))
