from __future__ import annotations

import functools
import importlib
import subprocess
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from chdstat.scenes import BUILTIN, load_scene


def leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            assert isinstance(key, str)
            yield from leaves(item)
    elif isinstance(value, list):
        for item in value:
            yield from leaves(item)
    else:
        yield value


@functools.cache
def source_of(name: str) -> Any:
    return load_scene(name).source


@pytest.mark.parametrize("name", BUILTIN)
def test_scenes_are_plain_values(name):
    plain = (str, bool, int, float, np.ndarray, type(None))
    assert {type(leaf) for leaf in leaves(source_of(name))} <= set(plain)


@pytest.mark.parametrize("name", BUILTIN)
def test_meshes_are_finite_and_their_normals_are_unit(name):
    for key, entry in source_of(name).items():
        if isinstance(entry, Mapping) and entry["type"] == "mesh":
            assert np.isfinite(entry["vertices"]).all(), key
            assert entry["faces"].max() < len(entry["vertices"]), key
            if entry["normals"] is not None:
                lengths = np.linalg.norm(entry["normals"], axis=-1)
                np.testing.assert_allclose(lengths, 1.0, atol=1e-5, err_msg=key)


@pytest.mark.parametrize("name", BUILTIN)
def test_every_build_has_the_same_identity(name):
    module = importlib.import_module(f"chdstat.scenes.builtin.{name.replace('-', '_')}")
    again = module.build()
    assert again is not source_of(name)
    assert load_scene(again).hash == load_scene(source_of(name)).hash


def test_the_identity_is_the_same_in_another_process():
    code = "from chdstat.scenes import load_scene; print(load_scene('bathroom').hash)"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == load_scene("bathroom").hash


def test_the_identity_changes_with_any_vertex():
    description = load_scene("cornell-box").source
    block = description["short-block"]
    moved = {**block, "vertices": block["vertices"] + np.float32(1e-3)}
    changed = load_scene({**description, "short-block": moved})
    assert changed.hash != load_scene("cornell-box").hash


@pytest.mark.parametrize("name", BUILTIN)
def test_every_scene_renders_with_light_in_it(name, draw):
    x = draw(source_of(name), size=16, spp=16)
    assert np.isfinite(x).all()
    assert (x >= 0).all()
    assert (x.max(axis=(2, 3)) > 0).mean() > 0.8
    assert 0.05 < x.mean() < 1.0


def test_the_cornell_box_is_red_at_the_left_and_green_at_the_right(draw):
    x = draw(load_scene("cornell-box").source, size=16, spp=32).mean(axis=-1)
    left, right = x[4:12, 1:3].mean(axis=(0, 1)), x[4:12, 13:15].mean(axis=(0, 1))
    assert left[0] > 3 * left[1]
    assert right[1] > right[0]
