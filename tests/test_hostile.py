"""Hostile scenes and recipes: what is read of them is right, or an error that a user can act on.

They are known bad cases, and mutations of good files; `pytest -m slow` tries many of these.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, SceneError
from chdstat.rendering.recipes import load_recipe
from tests.rendering.test_recipes import GOOD

SCENE = b"""<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
  <default name="depth" value="3"/>
  <integrator type="path"><integer name="max_depth" value="$depth"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0, 0, -4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm">
      <integer name="width" value="6"/><integer name="height" value="4"/>
      <rfilter type="gaussian"/>
    </film>
    <sampler type="independent"/>
  </sensor>
  <bsdf type="twosided" id="wall">
    <bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.4, 0.6"/></bsdf>
  </bsdf>
  <shape type="sphere"><ref id="wall"/></shape>
  <emitter type="constant"><rgb name="radiance" value="1"/></emitter>
</scene>
"""
RECIPE = GOOD.encode()


def mutations(good: bytes, count: int, seed: int) -> Iterator[tuple[str, bytes]]:
    """Yield mutations of a file, each with its kind."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        kind = str(rng.choice(["flip", "cut", "drop", "repeat", "insert", "number"]))
        start, stop = np.sort(rng.integers(0, len(good), 2))
        data = bytearray(good)
        if kind == "flip":
            for at in rng.integers(0, len(good), 3):
                data[at] ^= 1 << int(rng.integers(8))
        elif kind == "cut":
            del data[start:]
        elif kind == "drop":
            del data[start : min(stop, start + 40)]
        elif kind == "repeat":
            data[start:start] = good[start : min(stop, start + 200)]
        elif kind == "insert":
            data[start:start] = rng.bytes(int(rng.integers(1, 9)))
        else:
            digits = [i for i, c in enumerate(good) if chr(c).isdigit()]
            at = int(rng.choice(digits))
            data[at : at + 1] = rng.choice([b"-1", b"1e39", b"nan", b"99999999999", b"", b"x"])
        yield kind, bytes(data)


def scenes() -> Iterator[tuple[str, bytes]]:
    """Yield known bad scenes, each with its name."""
    end = b"</scene>"

    def film(width: bytes) -> bytes:
        return SCENE.replace(b'name="width" value="6"', b'name="width" value="' + width + b'"')

    def more(text: bytes) -> bytes:
        return SCENE.replace(end, text + end)

    deep = 200_000
    yield "nested", more(b"<bsdf type='twosided'>" * deep + b"</bsdf>" * deep)
    yield "nested, open", b"<scene version='3.0.0'>" + b"<shape type='a'>" * deep
    yield "nested transforms", more(b"<transform name='a'>" * deep + b"</transform>" * deep)
    for width in (b"x", b"0", b"-3", b"7.5", b"99999999999", b"9" * 6000, b""):
        yield f"width {width[:12].decode()}", film(width)
    yield (
        "width text",
        SCENE.replace(b'<integer name="width" value="6"', b'<string name="width" value="x"'),
    )
    yield "utf-16, cut", SCENE.decode().encode("utf-16")[:-31]
    yield "zero bytes", SCENE.replace(b"path", b"pa\0th")
    yield (
        "laughs",
        (
            b'<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "ha">'
            + b"".join(b'<!ENTITY %c "%s">' % (98 + i, b"&%c;" % (97 + i) * 20) for i in range(12))
            + b"]><scene version='3.0.0'><string name='a' value='&m;'/></scene>"
        ),
    )
    yield "includes itself", more(b"<include filename='scene.xml'/>")
    yield "no include", more(b"<include filename='nothing.xml'/>")
    for name in (b"no.png", b".", b"scene.xml", b"a/" * 100_000, b"/dev/null"):
        file = b"<string name='filename' value='" + name + b"'/>"
        texture = b"<texture type='bitmap' name='radiance'>" + file + b"</texture>"
        light = b"<emitter type='area'>" + texture + b"</emitter>"
        yield f"texture {name[:9].decode()}", more(b"<shape type='cube'>" + light + b"</shape>")
        yield f"mesh {name[:9].decode()}", more(b"<shape type='ply'>" + file + b"</shape>")
    yield "no parameter", more(b"<float name='a' value='$b'/>")
    yield "parameter of itself", more(b"<default name='b' value='$b'/><float name='a' value='$b'/>")
    yield "no version", SCENE.replace(b' version="3.0.0"', b"", 1)
    yield "version x", SCENE.replace(b'version="3.0.0"', b'version="x"', 1)
    yield "empty", b""
    yield "other root", b"<html version='3.0.0'/>"
    yield "two integrators", more(b"<integrator type='path'/>")
    yield "integrator in itself", more(b"<integrator type='aov' id='a'><ref id='a'/></integrator>")


def recipes() -> Iterator[tuple[str, bytes]]:
    """Yield known bad recipes, each with its name."""
    for size in (1000, 100_000):
        yield f"array {size} deep", RECIPE + b"x = " + b"[" * size + b"]" * size
        yield f"table {size} deep", RECIPE + b"[" + b"a." * size + b"b]"
        yield f"key of {size} parts", RECIPE + b"a." * size + b"b = 1"
    yield "inline tables", RECIPE + b"x = " + b"{a=" * 5000 + b"1" + b"}" * 5000
    yield "long integer", RECIPE.replace(b"64", b"9" * 6000)
    yield "long scene", RECIPE.replace(b"bathroom", b"x" * 60_000)
    yield "endless scene", RECIPE.replace(b"bathroom", b"x" * 100_000)
    yield "zero byte", RECIPE.replace(b"bathroom", b"x\\u0000y")
    yield "no text", b"\xff\xfe" + RECIPE
    yield "many regions", b"schema = 1\nregions = [" + b"1," * 30_000 + b"]"
    yield "empty", b""


@pytest.mark.parametrize("name", [name for name, _ in scenes()])
def test_bad_scenes_are_refused_in_words(tmp_path, name):
    path = tmp_path / "scene.xml"
    path.write_bytes(dict(scenes())[name])
    with pytest.raises(ChdstatError) as caught:
        chd.render(path, spp=1, backend="scalar")
    assert 20 < len(str(caught.value)) < 2000
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("count", [80, pytest.param(2000, marks=pytest.mark.slow)])
def test_mutated_scenes_render_or_are_refused_in_words(tmp_path, count):
    path, outcomes = tmp_path / "scene.xml", []
    for _, data in [("", SCENE), *mutations(SCENE, count, seed=1)]:
        path.write_bytes(data)
        try:
            outcomes.append(chd.render(path, spp=1, size=(3, 2), backend="scalar").shape)
        except ChdstatError as error:
            outcomes.append(type(error).__name__)
    assert outcomes[0] == (2, 3, 3, 1)
    assert {(2, 3, 3, 1), "SceneError"} <= set(outcomes) <= {
        (2, 3, 3, 1), "SceneError", "InputError", "RenderError",
    }  # fmt: skip


@pytest.mark.parametrize("name", [name for name, _ in recipes()])
def test_bad_recipes_are_refused_in_words(tmp_path, name):
    path = tmp_path / "recipe.toml"
    path.write_bytes(dict(recipes())[name])
    with pytest.raises((InputError, SceneError)) as caught:
        chd.load_scene(load_recipe(path).scene)
    assert 20 < len(str(caught.value)) < 2000


def test_mutated_recipes_are_read_or_refused_in_words(tmp_path):
    path, read = tmp_path / "recipe.toml", []
    for _, data in [("", RECIPE), *mutations(RECIPE, 300, seed=1)]:
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
def test_commands_end_without_a_traceback(tmp_path, monkeypatch, run, arguments):
    (tmp_path / "notes.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    code, _, err = run(*arguments)
    assert code in (1, 2)
    assert err
