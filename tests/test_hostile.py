"""Hostile scenes and recipes: what is read of them is right, or an error that a user can act on.

A cheap part of `tests/benchmarks/test_hostile.py`, which tries many in processes of their own.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

import chdstat as chd
from chdstat.cli import main
from chdstat.errors import ChdstatError, InputError, SceneError
from chdstat.rendering.recipes import load_recipe


def _hostile() -> Any:
    """Import what lies beside this file: tests are no package."""
    spec = importlib.util.spec_from_file_location("hostile", Path(__file__).with_name("hostile.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hostile = _hostile()


@pytest.mark.parametrize("name", [name for name, _ in hostile.scenes()])
def test_bad_scenes_are_refused_in_words(tmp_path, name):
    path = tmp_path / "scene.xml"
    path.write_bytes(dict(hostile.scenes())[name])
    with pytest.raises(ChdstatError) as caught:
        chd.render(path, spp=1, backend="scalar")
    assert 20 < len(str(caught.value)) < 2000
    assert list(tmp_path.iterdir()) == [path]


def test_mutated_scenes_render_or_are_refused_in_words(tmp_path):
    path, outcomes = tmp_path / "scene.xml", []
    for _, data in [("", hostile.SCENE), *hostile.mutations(hostile.SCENE, 80, seed=1)]:
        path.write_bytes(data)
        try:
            outcomes.append(chd.render(path, spp=1, size=(3, 2), backend="scalar").shape)
        except ChdstatError as error:
            outcomes.append(type(error).__name__)
    assert outcomes[0] == (2, 3, 3, 1)
    assert {(2, 3, 3, 1), "SceneError"} <= set(outcomes) <= {
        (2, 3, 3, 1), "SceneError", "InputError", "RenderError",
    }  # fmt: skip


@pytest.mark.parametrize("name", [name for name, _ in hostile.recipes()])
def test_bad_recipes_are_refused_in_words(tmp_path, name):
    path = tmp_path / "recipe.toml"
    path.write_bytes(dict(hostile.recipes())[name])
    with pytest.raises((InputError, SceneError)) as caught:
        chd.load_scene(load_recipe(path).scene)
    assert 20 < len(str(caught.value)) < 2000


def test_mutated_recipes_are_read_or_refused_in_words(tmp_path):
    path, read = tmp_path / "recipe.toml", []
    for _, data in [("", hostile.RECIPE), *hostile.mutations(hostile.RECIPE, 300, seed=1)]:
        path.write_bytes(data)
        try:
            read.append(load_recipe(path).spp)
        except InputError:
            read.append(None)
    assert read[0] == 64
    assert read.count(None) > 100


@pytest.mark.parametrize(
    "arguments",
    [
        ["render", "x" * 100_000, "-o", "a.zarr"],
        ["render", "x\0y", "-o", "a.zarr"],
        ["render", "cornell-box", "-o", "x" * 5000],
        ["render", "cornell-box", "-o", "a.zarr", "--size", "9" * 6000 + "x1"],
        ["render", "cornell-box", "-o", "a.zarr", "--size", "9" * 30 + "x1"],
        ["render", "cornell-box", "-o", "a.zarr", "--seed", "9" * 30],
        ["render", "cornell-box", "-o", "a.zarr", "--spp", "9" * 30],
        ["render", "cornell-box", "-o", "a.zarr", "--max-depth", "9" * 30],
        ["render", "cornell-box", "-o", "a.zarr", "--sensor", "3"],
        ["render", "cornell-box", "-o", "."],
        ["analyze", "x" * 100_000],
        ["info", "x" * 100_000],
    ],
    ids=lambda a: " ".join(a)[:60],
)
def test_commands_end_without_a_traceback(tmp_path, monkeypatch, capsys, arguments):
    (tmp_path / "notes.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["chdstat", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in (1, 2)
    assert capsys.readouterr().err
