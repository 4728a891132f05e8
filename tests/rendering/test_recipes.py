"""Recipes: what is read, what is refused, and where the library looks by itself."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.rendering.recipes import (
    PHENOMENA,
    find_recipe,
    load_recipe,
    regions_of,
)
from chdstat.samples import Region
from chdstat.scenes import BUILTIN, load_scene

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
    assert recipe.integrator == "path"
    assert recipe.regions == (Region("wall", "diffuse", (0.5, 0.25, 0.75, 0.5)),)


def test_what_is_not_said_is_the_scene_s(tmp_path):
    recipe = load_recipe(write(tmp_path, GOOD.replace("integrator =", "# integrator =")))
    assert (recipe.integrator, recipe.max_depth) == (None, None)


def test_a_scene_is_found_beside_its_recipe(tmp_path, monkeypatch):
    scene = tmp_path / "attic" / "scene.xml"
    scene.parent.mkdir()
    scene.write_text("<scene version='3.0.0'/>")
    named = re.sub(r'scene = "[^"]*"', 'scene = "attic/scene.xml"', GOOD)
    path = write(tmp_path, named)
    monkeypatch.chdir("/")
    assert Path(load_recipe(path).scene) == scene
    scene.unlink()
    assert load_recipe(path).scene == "attic/scene.xml"


def test_a_scene_in_a_folder_that_the_environment_names(tmp_path, monkeypatch):
    named = re.sub(r'scene = "[^"]*"', 'scene = "$ATTICS/a.xml"\nname = "attic"', GOOD)
    monkeypatch.setenv("ATTICS", "/scenes")
    recipe = load_recipe(write(tmp_path, named))
    assert (recipe.scene, recipe.name) == ("/scenes/a.xml", "attic")
    monkeypatch.delenv("ATTICS")
    with pytest.raises(InputError, match=r"'\$ATTICS/a.xml'"):
        load_recipe(write(tmp_path, named))


STUDY = {name: recipe for name in BUILTIN if (recipe := find_recipe(name))}


def test_the_recipe_of_every_study_scene_fits_it():
    shown = set()
    for name, recipe in STUDY.items():
        assert recipe.scene == name
        integrator = load_scene(name).source["integrator"]
        assert (recipe.integrator, recipe.max_depth) == (
            integrator["type"],
            integrator["max_depth"],
        )
        width, height = recipe.size
        for region in recipe.regions:
            ys, xs = region.pixels(height, width)
            assert 0 <= ys.start < ys.stop <= height, region.name
            assert 0 <= xs.start < xs.stop <= width, region.name
            assert (ys.stop - ys.start) * (xs.stop - xs.start) >= 12, region.name
            assert region.note, region.name
        pairs = [r.name for r in recipe.regions if r.phenomenon == "albedo-contrast"]
        assert sorted(n.rpartition("-")[2] for n in pairs) in ([], ["dark", "pale"])
        shown |= {region.phenomenon for region in recipe.regions}
    assert shown == set(PHENOMENA)


def test_regions_cover_at_least_a_pixel():
    ys, xs = Region("dot", "diffuse", (0.99, 0.99, 1.0, 1.0)).pixels(4, 4)
    assert (ys, xs) == (slice(3, 4), slice(3, 4))


def test_regions_belong_to_the_view():
    x = np.ones((32, 32, 3, 2), dtype=np.float32)
    assert find_recipe("no-such-scene") is None
    known = find_recipe("bathroom")
    assert known is not None

    def regions(x, **attrs):
        return regions_of(chd.Samples.from_array(x, axes="yxcs", **attrs))

    assert regions(x, scene="bathroom", scene_source="chdstat") == known.regions
    assert regions(x[:20], scene="bathroom", scene_source="chdstat") == ()
    assert regions(x, scene="bathroom", scene_source="other.xml") == ()
    assert regions(x, scene="attic", scene_source="chdstat") == ()
