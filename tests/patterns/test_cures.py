"""Cures: every pattern has one for every renderer, and every setting that they name exists."""

import importlib.util
import json
import re
import string
import subprocess
import sys

import numpy as np
import pytest

import chdstat as chd
from chdstat.patterns import PATTERNS, Label
from chdstat.patterns.clamping import clamped_share
from chdstat.patterns.cures import CURES, SETTINGS, NoiseSetting, cure_in, renderer_of

_IN_BLENDER = """
import json, bpy
data = bpy.data
owners = (
    bpy.context.scene, data.worlds.new("w"), data.materials.new("m"),
    data.lights.new("l", "AREA"), data.objects.new("o", None),
)
known = {o.cycles.bl_rna.identifier: list(o.cycles.bl_rna.properties.keys()) for o in owners}
for name in ("PointLight", "AreaLight", "ShaderNodeLightPath", "ShaderNodeBsdfTransparent"):
    known[name] = list(getattr(bpy.types, name).bl_rna.properties.keys())
labels = {getattr(getattr(bpy.types, name), "bl_label", "") for name in dir(bpy.types)}
print("FOUND" + json.dumps([known, sorted(labels)]))
"""
_IN_LUXCORE = """
import json, sys, numpy, pyluxcore
pyluxcore.Init()
scene, props, config = pyluxcore.Scene(), pyluxcore.Properties(), pyluxcore.Properties()
props.SetFromString("scene.camera.type = perspective\\nscene.lights.l.type = constantinfinite")
scene.Parse(props)
config.SetFromString("renderengine.type = PATHCPU")
settings = pyluxcore.RenderConfig(config, scene)

def defined(name):
    try:
        settings.GetProperty(name).Get()
    except RuntimeError as error:
        return "Undefined" not in str(error)
    return True

print("FOUND" + json.dumps({name: defined(name) for name in sys.argv[1:]}))
"""


def _asked(module, script, *arguments):
    """Return what a script in a process of its own prints; such modules do not mix with others."""
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"no {module}")
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "FOUND" in done.stdout, done.stderr[-2000:]
    return json.loads(done.stdout.split("FOUND", 1)[1].splitlines()[0])


def _all_settings(renderer):
    return {p for s in SETTINGS[renderer].values() for p in s.properties}


@pytest.mark.parametrize("renderer", CURES)
def test_no_pattern_lacks_a_cure(renderer):
    needed = {p.name for p in PATTERNS} | {"other", "black"}
    assert needed - {"constant"} <= CURES[renderer].keys() <= needed  # which asks for no setting
    for pattern in needed:
        cure = cure_in(renderer, pattern, otherwise=Label[pattern.upper()].cure)
        assert cure, pattern
        assert not re.search(r"[{}]|\.$|  ", cure), cure


@pytest.mark.parametrize("renderer", CURES)
def test_cures_name_known_settings(renderer):
    parsed = (string.Formatter().parse(text) for text in CURES[renderer].values())
    named = {name for text in parsed for _, name, _, _ in text if name}
    assert named <= SETTINGS[renderer].keys()


def test_every_setting_has_a_cost():
    assert all(s.does and s.cost for known in SETTINGS.values() for s in known.values())


def test_settings_of_cycles_exist():
    known, labels = _asked("bpy", _IN_BLENDER)
    for setting in _all_settings("Cycles"):
        owner, _, name = setting.partition(".")
        assert owner in known, setting
        assert not name or name in known[owner], setting
    for setting in SETTINGS["Cycles"].values():
        for place in filter(None, setting.where.split("; ")):
            tab, *panels = place.split(" > ")
            assert tab in {"Render", "Light", "World", "Material", "Object"}
            assert set(panels) <= set(labels), place


def test_settings_of_luxcore_exist():
    named = _all_settings("LuxCore")
    found = _asked("pyluxcore", _IN_LUXCORE, *named, "path.nonsense")
    assert found == dict.fromkeys(named, True) | {"path.nonsense": False}


@pytest.mark.parametrize(
    ("attrs", "name"),
    [
        ({"renderer": "Cycles 5.0.1"}, "Cycles"),
        ({"renderer": "cycles"}, "Cycles"),
        ({"renderer": "LuxCore 2.11.2"}, "LuxCore"),
        ({"renderer": "Mitsuba 3.8.0"}, "Mitsuba"),
        ({"mitsuba_version": "3.8.0"}, "Mitsuba"),
        ({"renderer": "Cyclesque 1"}, ""),
        ({"renderer": "pbrt"}, ""),
        ({"renderer": None}, ""),
        ({}, ""),
    ],
)
def test_renderer_is_the_first_word(attrs, name):
    assert renderer_of(attrs) == name


def test_others_get_the_general_cure():
    for label in Label:
        assert label.cure_by({"renderer": "mine 1"}) == label.cure_by({}) == label.cure
    assert Label.UNDETERMINED.cure_by({"renderer": "Cycles 5"}) == Label.UNDETERMINED.cure


def test_pixel_card_speaks_of_the_renderer():
    x = np.random.default_rng(0).gamma(2, size=(2, 2, 1, 512))
    texts = [
        repr(chd.Samples.from_array(x, renderer=renderer).pixel(0, 0))
        for renderer in ("Cycles 5.0.1", "mine")
    ]
    assert ["Max Samples" in text for text in texts] == [True, False]


def test_setting_says_where_it_is():
    assert str(NoiseSetting("Portal", "", "", "Light > Settings")) == "Portal (Light > Settings)"
    assert str(NoiseSetting("rr_depth", "", "")) == "rr_depth"


@pytest.mark.parametrize(
    ("notes", "level"),
    [
        (["the denoiser is off", "clamping of indirect light (10) is off"], 10),
        (["clamping of indirect light (10) is off", "clamping of direct light (2.5) is off"], 2.5),
        (["clamping of indirect light (1e+06) is off"], 1e6),
    ],
)
def test_clamp_takes_what_is_above_it(notes, level):
    x = np.random.default_rng(1).pareto(1.5, (3, 4, 3, 64))
    x[0, 0, 0, :3] = np.nan, np.inf, -np.inf
    good = x.mean(axis=2)[np.isfinite(x.mean(axis=2))]
    found = clamped_share(chd.Samples.from_array(x, notes=notes))
    assert found == (level, pytest.approx(1 - np.minimum(good, level).sum() / good.sum()))


@pytest.mark.parametrize("attrs", [{}, {"notes": None}, {"notes": ["the denoiser is off"]}])
def test_no_clamp_takes_nothing(attrs):
    assert clamped_share(chd.Samples.from_array(np.ones((2, 2, 3, 4)), **attrs)) is None


def test_black_image_has_no_share():
    notes = ["clamping of direct light (1) is off"]
    assert clamped_share(chd.Samples.from_array(np.zeros((2, 2, 3, 4)), notes=notes)) is None
