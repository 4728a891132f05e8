"""Pictures of the built-in scenes: they are of today's scenes, small, and made by today's tool."""

from __future__ import annotations

import hashlib
import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import chdstat as chd
from chdstat.scenes import BUILTIN, load_scene

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "scenes"
RECIPE = json.loads((FOLDER / "recipe.json").read_text("utf-8"))
FILES = [FOLDER / name for made in RECIPE["scenes"].values() for name in made["files"]]


def test_every_scene_has_pictures_and_a_place_on_the_page():
    assert set(RECIPE["scenes"]) == set(BUILTIN)
    page = (FOLDER / "index.rst").read_text("utf-8")
    assert [name for name in BUILTIN if f".. scene:: {name}\n" not in page] == []
    assert {file.name for file in FOLDER.glob("*.webp")} == {file.name for file in FILES}


@pytest.mark.parametrize("name", BUILTIN)
def test_pictures_are_of_todays_scene_and_tool(name):
    made = RECIPE["scenes"][name]
    assert made["scene_hash"] == load_scene(name).hash
    tool = runpy.run_path(str(ROOT / "tools" / "make_scene_pictures.py"))
    settings = {key: made[key] for key in tool["SETTINGS"]}
    assert settings == tool["SETTINGS"] | {"size": [*tool["SETTINGS"]["size"]]}
    for file, digest in made["files"].items():
        assert hashlib.sha256((FOLDER / file).read_bytes()).hexdigest() == digest


def test_pictures_are_large_to_look_at_and_small_to_keep():
    sizes = [file.stat().st_size for file in FILES]
    assert max(sizes) < 61_000
    assert sum(sizes) < 600_000
    for file in FILES:
        with Image.open(file) as image:
            assert min(image.size) >= 256


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILTIN)
def test_numbers_are_those_of_the_scene(name):
    """Fails by accident once in 100 000 runs: the share is a mean of independent samples."""
    told = RECIPE["scenes"][name]["numbers"]["null_share"]
    null = chd.summarize(chd.render(name, spp=32, size=(64, 64), seed=5))["null_share"].values
    share, count = null.mean(), 32 * null.size
    assert abs(share - told) < 4.5 * np.sqrt(share * (1 - share) / count) + 1 / count
