"""Identity of a scene: every file that it reads, its parameters, and the code of its plugins."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, SceneError, StoreError
from chdstat.io import write_exr
from chdstat.rendering.backend import activate, probe
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.scenes import Scene, load_scene
from chdstat.scenes.parsing import ParsedScene
from tests.matrices import look_at, scale, translate

SETTINGS: dict[str, Any] = {"size": (4, 4), "backend": "scalar"}


def write(path: Path, value: float) -> None:
    """Write a constant texture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, np.full((4, 8, 3), value, np.float32))


def scene(folder: Path, body: str) -> Path:
    """Write an XML scene in a folder of its own."""
    path = folder / "rooms" / "scene.xml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f"<scene version='3.0.0'><sensor type='perspective'/>{textwrap.dedent(body)}</scene>"
    )
    return path


ENVMAP = "<emitter type='envmap'><string name='filename' value='{}'/></emitter>"


@pytest.mark.parametrize(
    ("name", "body"),
    [
        ("../tex.exr", ENVMAP.format("../tex.exr")),
        ("{root}/tex.exr", ENVMAP.format("{root}/tex.exr")),
        ("rooms/maps/tex.exr", ENVMAP.format("maps/tex.exr")),
        (
            "../tex.exr",
            "<default name='t' value='no'/><default name='te' value='../tex'/>"
            + ENVMAP.format("$te.exr"),
        ),
        ("skies/tex.exr", "<path value='../skies'/>" + ENVMAP.format("tex.exr")),
        ("../tex.exr", "<include filename='../parts/sky.xml'/>"),
    ],
)
def test_samples_of_two_textures_are_not_mixed(tmp_path, name, body):
    root = tmp_path / "a b"
    texture = root / "rooms" / name.format(root=root)
    texture = root / name if name.startswith(("rooms", "skies")) else texture
    write(texture, 1.0)
    (root / "parts").mkdir()
    sky = f"<scene version='3.0.0'>{ENVMAP.format('../tex.exr')}</scene>"
    (root / "parts/sky.xml").write_text(sky)
    source = scene(root, body.format(root=root))
    out = tmp_path / "s.zarr"
    assert chd.render(source, spp=64, out=out, **SETTINGS).read().mean() == pytest.approx(1)
    assert chd.render(source, spp=70, out=out, **SETTINGS).spp == 70
    before = load_scene(source).hash
    write(texture, 5.0)
    assert load_scene(source).hash != before
    with pytest.raises(StoreError, match=r"tex\.exr"):
        chd.render(source, spp=128, out=out, **SETTINGS)
    assert chd.open(out).read().mean() == pytest.approx(1)
    write(texture, 1.0)
    assert load_scene(source).hash == before


def test_includes_and_spectra_are_files_of_the_scene(tmp_path, monkeypatch):
    (tmp_path / "parts").mkdir()
    spectrum, part = tmp_path / "parts/glow.spd", tmp_path / "parts/light.xml"
    spectrum.write_text("400 1.0\n700 1.0\n")
    radiance = "<spectrum name='radiance' filename='../parts/glow.spd'/>"
    shine = f"<emitter type='constant'>{radiance}</emitter>"
    part.write_text("<scene version='3.0.0'><shape type='sphere'/></scene>")
    source = scene(tmp_path, f"<include filename='../parts/light.xml'/>{shine}")
    monkeypatch.chdir("/")
    loaded = load_scene(source)
    assert loaded.files().keys() == {"scene.xml", "../parts/light.xml", "../parts/glow.spd"}
    hashes = {loaded.hash}
    chd.render(loaded, spp=1, **SETTINGS)
    spectrum.write_text("400 2.0\n700 2.0\n")
    hashes.add(loaded.hash)
    part.write_text("<scene version='3.0.0'><shape type='cube'/></scene>")
    hashes.add(loaded.hash)
    assert len(hashes) == 3


def test_an_include_is_the_one_file_that_mitsuba_takes(tmp_path):
    """That beside the file that includes it; folders that it adds are forgotten behind it."""
    write(tmp_path / "rooms/tex.exr", 1.0)
    write(tmp_path / "parts/skies/tex.exr", 2.0)
    source = scene(tmp_path, "<include filename='../parts/a.xml'/>" + ENVMAP.format("tex.exr"))
    part = "<scene version='3.0.0'>{}</scene>"
    include = "<path value='skies'/><include filename='b.xml'/>"
    (tmp_path / "parts/a.xml").write_text(part.format(include))
    (tmp_path / "parts/b.xml").write_text(part.format("<shape type='disk'/>"))
    (tmp_path / "rooms/b.xml").write_text("this is no XML, and nobody reads it")
    assert load_scene(source).described() == {
        "scene.xml": source,
        "../parts/a.xml": tmp_path / "parts/a.xml",
        "b.xml": tmp_path / "parts/b.xml",
        "tex.exr": tmp_path / "rooms/tex.exr",
    }
    assert chd.render(source, spp=1, **SETTINGS).read().max() == 1
    (tmp_path / "parts/b.xml").unlink()
    assert load_scene(source).described()["b.xml"] == tmp_path / "rooms/b.xml"
    with pytest.raises(SceneError, match=r"rooms/b\.xml"):
        chd.render(source, spp=1, **SETTINGS)


SKY = '<emitter type="envmap"><string name="filename" value="{}"/></emitter>'


@pytest.mark.parametrize(
    ("image", "before", "sky", "encoding"),
    [
        ("t&x.exr", "", "<!-- -- a ---- caf\xe9 ---->" + SKY.format("t&x.exr"), "latin-1"),
        ("t<>'x.exr", "", "<!-- <path value='no'/> -->" + SKY.format("t<>'x.exr"), "utf-8"),
        (
            "t&x.exr",
            "",
            "<path value =\n'skies' ></path >" + SKY.format("t&amp;&#120;.exr"),
            "utf-8",
        ),
        (
            "t\xe9.exr",
            "<?xml version='1.0' encoding='Latin1'?>",
            SKY.format("t\xe9.exr"),
            "latin-1",
        ),
        (
            "t\u65e5.exr",
            "",
            SKY.format("t\u65e5.exr") + "<integrator type='path' type='x'/>",
            "utf-16",
        ),
    ],
)
def test_files_are_found_in_all_that_mitsuba_takes(tmp_path, image, before, sky, encoding):
    """Which is more than well-formed XML."""
    write(tmp_path / image, 2.0)
    write(tmp_path / "skies" / image, 1.0)
    source = tmp_path / "scene.xml"
    body = f"<path value='skies'></path><sensor type='perspective'/>{sky}</scene> more"
    source.write_bytes(f"{before}<scene version='3.0.0'>{body}".encode(encoding))
    assert load_scene(source).described() == {
        "scene.xml": source,
        image: tmp_path / "skies" / image,
    }
    assert chd.render(source, spp=1, **SETTINGS).read().max() == 1


def test_links_are_followed_as_mitsuba_does(tmp_path, monkeypatch):
    """As Mitsuba does it, for scenes and includes."""
    sky = ENVMAP.format("tex.exr")
    include = "<include filename='a.xml'/>"
    for folder, value in (("parts", 2.0), ("rooms", 1.0)):
        write(tmp_path / folder / "tex.exr", value)
        (tmp_path / folder / "b.xml").write_text("<scene version='3.0.0'/>")
    target = scene(tmp_path, include + sky)
    target.rename(tmp_path / "parts/scene.xml")
    again = "<scene version='3.0.0'><include filename='b.xml'/></scene>"
    (tmp_path / "parts/a.xml").write_text(again)
    for name in ("scene.xml", "a.xml"):
        (tmp_path / "rooms" / name).symlink_to(f"../parts/{name}")
    monkeypatch.chdir(tmp_path / "rooms")
    found = load_scene("scene.xml")
    assert found.name == "rooms"
    assert found.described() == {
        "scene.xml": tmp_path / "parts/scene.xml",
        "a.xml": tmp_path / "parts/a.xml",
        "b.xml": tmp_path / "rooms/b.xml",
        "tex.exr": tmp_path / "rooms/tex.exr",
    }
    assert chd.render(found, spp=1, **SETTINGS).read().max() == 1


def test_the_tables_of_a_metal_are_files_of_the_scene(tmp_path):
    body = (
        "<shape type='sphere'><bsdf type='conductor'><string name='material' value='{}'/>"
        "</bsdf></shape><emitter type='constant'/>"
    )
    own = load_scene(scene(tmp_path, body.format("mine")))
    hashes = []
    for index in (0.5, 1.5):
        for part in ("eta", "k"):
            table = tmp_path / f"rooms/data/ior/mine.{part}.spd"
            table.parent.mkdir(parents=True, exist_ok=True)
            table.write_text(f"400 {index}\n700 {index}\n")
        tables = {"data/ior/mine.eta.spd", "data/ior/mine.k.spd"}
        assert set(own.files()) == {"scene.xml"} | tables
        hashes.append(own.hash)
        chd.render(own, spp=1, **SETTINGS)
    assert hashes[0] != hashes[1]
    # Those of Mitsuba, also where it is not loaded yet.
    gold = load_scene({"type": "scene", "ball": {"bsdf": {"type": "conductor", "material": "Au"}}})
    assert len(gold.files()) == 2
    code = f"import chdstat; print(chdstat.load_scene({dict(gold.source)}).hash)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == gold.hash


def test_what_is_not_named_is_not_touched(tmp_path, monkeypatch):
    write(tmp_path / "tex.exr", 1.0)
    source = scene(tmp_path, ENVMAP.format("../tex.exr"))
    before = load_scene(source).hash
    for name in ("notes.txt", "renders/a.exr"):
        path = source.parent / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("scene.xml")
    monkeypatch.setattr(os, "scandir", None)
    monkeypatch.setattr(os, "listdir", None)
    assert load_scene(source).hash == before


def test_a_moved_scene_is_the_same(tmp_path):
    for place in ("a", "b"):
        write(tmp_path / place / "tex.exr", 1.0)
    body = "<default name='f' value='tex'/>" + ENVMAP.format("../$f.exr")
    first, second = (scene(tmp_path / place, body) for place in ("a", "b"))
    assert load_scene(first).hash == load_scene(second).hash
    assert load_scene(first, f="tex").hash != load_scene(first, f="other").hash


def test_a_file_that_vanishes_is_named(tmp_path, monkeypatch):
    write(tmp_path / "tex.exr", 1.0)
    source = scene(tmp_path, ENVMAP.format("../tex.exr"))
    found = load_scene(source).described()
    (tmp_path / "tex.exr").unlink()
    monkeypatch.setattr(Scene, "described", lambda _: found)
    with pytest.raises(SceneError, match=r"tex\.exr"):
        _ = load_scene(source).hash


def test_files_that_change_meanwhile_are_noticed(tmp_path, monkeypatch):
    write(tmp_path / "tex.exr", 1.0)
    source, build = scene(tmp_path, ENVMAP.format("../tex.exr")), ParsedScene.make

    def slow(self: ParsedScene, **options: Any) -> Any:
        write(tmp_path / "tex.exr", 2.0)
        return build(self, **options)

    monkeypatch.setattr(ParsedScene, "make", slow)
    with pytest.raises(SceneError, match="changed"):
        chd.render(source, spp=1, **SETTINGS)


def test_a_path_tag_is_forgotten_with_its_scene(tmp_path):
    write(tmp_path / "skies/tex.exr", 1.0)
    source = scene(tmp_path, "<path value='../skies'/>" + ENVMAP.format("tex.exr"))
    chd.render(source, spp=1, **SETTINGS)
    with pytest.raises(SceneError, match="tex.exr"):
        chd.render(scene(tmp_path / "b", ENVMAP.format("tex.exr")), spp=1, **SETTINGS)


def test_files_and_values_of_a_dict_belong_to_it(tmp_path):
    texture = tmp_path / "tex.exr"
    write(texture, 1.0)
    source = {"type": "scene", "sky": {"type": "envmap", "filename": str(texture)}}
    before = load_scene(source).hash
    write(texture, 2.0)
    assert load_scene(source).hash != before
    with activate(probe("scalar")) as mi:
        moved = [mi.ScalarTransform4f().translate([0, 0, z]) for z in (1, 1, 1 + 1e-6)]
        hashes = [load_scene({**source, "ball": {"to_world": m}}).hash for m in moved]
        assert hashes[0] == hashes[1] != hashes[2]
        with pytest.raises(SceneError, match="object"):
            _ = load_scene({**source, "ball": object()}).hash
        with pytest.raises(InputError, match="mitsuba.Shape"):
            chd.render(mi.load_dict({"type": "sphere"}))
    with pytest.raises(InputError, match="int"):
        load_scene(5)


# --- plugins ------------------------------------------------------------------------------------

PLUGIN = """
import mitsuba as mi

{head}

class Glow(mi.{base}):
    def __init__(self, props):
        super().__init__(props)
        {more}

    {method}

def glow(strength=1):
    {use}

mi.register_{kind}("glow", lambda props: Glow(props))
"""
INTEGRATOR = {
    "base": "SamplingIntegrator",
    "kind": "integrator",
    "head": "FACTOR = 1",
    "more": "self.factor = 1",
    "method": (
        "def sample(self, scene, sampler, ray, medium=None, active=True):\n"
        "        return mi.Color3f(FACTOR * self.factor * glow()), True, []"
    ),
    "use": "return 1.0 * strength",
}


def plugin(folder: Path, name: str, **changes: str) -> None:
    """Write the module of a plugin and import it anew."""
    path = folder / f"{name}.py"
    path.write_text(PLUGIN.format(**{**INTEGRATOR, **changes}))
    code = compile(path.read_text(), str(path), "exec")
    exec(code, {"__name__": name})


GLOWING = {"type": "scene", "sensor": {"type": "perspective"}, "integrator": {"type": "glow"}}


def test_the_code_of_a_plugin_belongs_to_the_scene(tmp_path):
    out = tmp_path / "s.zarr"
    with activate(probe("scalar")):
        plugin(tmp_path, "my_plugin")
        assert chd.render(GLOWING, spp=4, out=out, **SETTINGS).read().mean() == 1
        plugin(tmp_path, "my_plugin")
        assert chd.render(GLOWING, spp=6, out=out, **SETTINGS).read().mean() == 1
        for change in (
            {"head": "FACTOR = 10"},
            {"more": "self.factor = 10"},
            {"use": "return 10.0 * strength"},
            {"method": INTEGRATOR["method"].replace("glow()", "glow(10)")},
        ):
            plugin(tmp_path, "my_plugin", **change)
            with pytest.raises(StoreError, match=r"my_plugin\.Glow"):
                chd.render(GLOWING, spp=8, out=out, **SETTINGS)
            assert chd.render(GLOWING, spp=4, **SETTINGS).read().mean() == 10, change


def test_other_values_make_another_plugin(tmp_path):
    def register(strength: float) -> None:
        class Around(mi.BSDF):  # type: ignore[misc, name-defined]
            def __init__(self, props):
                super().__init__(props)

            def sample(self, ctx, si, sample1, sample2, active):
                return mi.BSDFSample3f(), mi.Color3f(strength)

            def eval(self, ctx, si, wo, active):
                return mi.Color3f(strength)

            def pdf(self, ctx, si, wo, active):
                return 0.0

            def to_string(self) -> str:
                return "Around"

        mi.register_bsdf("around", lambda props: Around(props))

    # A material within another one, which Mitsuba does not lead to.
    inner = {"type": "twosided", "inner": {"type": "around"}}
    source = {**GLOWING, "integrator": {"type": "path"}, "ball": {"type": "cube", "bsdf": inner}}
    with activate(probe("scalar")) as mi:
        codes = []
        for strength in (1.0, 1.0, 2.0):
            register(strength)
            codes.append(MitsubaRenderer(Job.of(source, size=(4, 4), backend="scalar")).code)
    assert codes[0] == codes[1] != codes[2]
    assert [name.split(".")[-1] for name in codes[0]] == ["Around"]
    assert pickle.loads(pickle.dumps(load_scene(source))).hash == load_scene(source).hash


def test_scenes_of_compiled_plugins_have_no_code():
    assert chd.render("cornell-box", spp=1, **SETTINGS).attrs["scene_code"] == {}


@pytest.mark.external
def test_a_real_scene_names_all_its_files(scenes_folder):
    source = load_scene(scenes_folder / "bathroom" / "scene.xml")
    named = source.described()
    assert len(named) > 800
    text = source.source.read_text()
    folders = (scenes_folder / "bathroom" / kind for kind in ("models", "textures"))
    beside = [path for folder in folders for path in folder.iterdir()]
    assert {p.name for p in beside if p.name in text} <= {p.name for p in named.values()}


def test_lights_have_one_order():
    """Mitsuba merges meshes in the order of their addresses, lights among them."""
    cubes = {
        f"cube-{i}": {
            "type": "cube",
            "to_world": translate(i % 4 - 1.5, i // 4 - 1.0, -8.0) @ scale(0.2, 0.2, 0.2),
            "bsdf": {"type": "diffuse", "reflectance": 0.05 * (i + 1)},
            "emitter": {"type": "area", "radiance": float(i + 1)},
        }
        for i in range(12)
    }
    walls = {
        f"wall-{i}": {
            "type": "cube",
            "to_world": translate(i - 1.0, 0.0, -10.0) @ scale(0.4, 2.0, 0.5),
            "bsdf": {"type": "diffuse", "reflectance": 0.3},
        }
        for i in range(3)
    }
    camera = {"type": "perspective", "to_world": look_at([0, 0, 0], [0, 0, -1], up=[0, 1, 0])}
    scene = {"type": "scene", "integrator": {"type": "path"}, "sensor": camera, **cubes, **walls}
    drawn = [chd.render(scene, spp=2, **SETTINGS).read() for _ in range(5)]
    assert drawn[0].max() > 1
    assert all(np.array_equal(drawn[0], other) for other in drawn)
