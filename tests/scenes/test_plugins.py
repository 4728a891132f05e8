"""Plugins: files of one's own that register integrators, materials and estimators."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, StoreError
from chdstat.estimators import registry
from chdstat.explorer.render_process import RenderProcess
from chdstat.rendering import render_pixels
from chdstat.rendering.jobs import Job
from chdstat.scenes import load_plugin, plugins

VIEW: dict[str, Any] = {"spp": 4, "size": (12, 8), "progress": False}
SCALAR: dict[str, Any] = {**VIEW, "backend": "scalar", "integrator": "constant_radiance"}

INTEGRATOR = """
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")  # as scripts do; the variant is that of the render


class Constant(mi.SamplingIntegrator):
    def __init__(self, props):
        super().__init__(props)
        self.value = props.get("value", 2.0)

    def sample(self, scene, sampler, ray, medium=None, active=True):
        return mi.Color3f(self.value), True, []


mi.register_integrator("constant_radiance", lambda props: Constant(props))
"""
MATERIAL = """
import mitsuba as mi
from colours import COLOUR


class Coloured(mi.BSDF):
    def __init__(self, props):
        super().__init__(props)
        self.inside = mi.load_dict(
            {"type": "diffuse", "reflectance": {"type": "rgb", "value": COLOUR}}
        )
        self.m_flags, self.m_components = self.inside.flags(), [self.inside.flags(0)]

    def sample(self, ctx, si, sample1, sample2, active=True):
        return self.inside.sample(ctx, si, sample1, sample2, active)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.inside.eval_pdf(ctx, si, wo, active)


mi.register_bsdf("coloured", lambda props: Coloured(props))
"""
ESTIMATOR = """
from chdstat.estimators import registry


@registry.register("largest_of_mine", source="a test")
def largest(x):
    return x.max(axis=-1)
"""


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Leave no plugin to other tests."""
    for name in ("_LOADED", "_REGISTERED"):
        monkeypatch.setattr(plugins, name, {})
    before = registry.names()
    yield
    for name in set(registry.names()) - set(before):
        registry.forget(name)


@pytest.fixture
def write(tmp_path):
    def written(code: str, name: str = "mine.py") -> Path:
        path = tmp_path / name
        path.write_text(code)
        return path

    return written


def test_a_plugin_s_integrator_renders(write, tmp_path):
    path = write(INTEGRATOR)
    plugin = load_plugin(path)
    samples = chd.render("cornell-box", **SCALAR, out=tmp_path / "a.zarr")
    assert (samples.read() == 2).all()
    assert samples.attrs["plugins"] == {"mine.py": plugin.digest}
    expected = subprocess.run(["sha256sum", path], capture_output=True, text=True, check=True)
    assert expected.stdout.startswith(plugin.digest)
    assert "mine.py" in repr(chd.open(tmp_path / "a.zarr").attrs)
    drawn = render_pixels("cornell-box", (1, 1), integrator="constant_radiance", size=(4, 4), spp=3)
    assert (drawn == 2).all()


def test_scenes_that_do_not_use_a_plugin_do_not_know_it(write, tmp_path):
    out = tmp_path / "a.zarr"
    settings = {**SCALAR, "integrator": "path"}
    assert chd.render("cornell-box", **settings, out=out).attrs["plugins"] == {}
    load_plugin(write(INTEGRATOR))
    grown = chd.render("cornell-box", **{**settings, "spp": 8}, out=out)
    assert grown.attrs["plugins"] == {}


def test_a_store_goes_on_with_the_same_code_only(write, tmp_path):
    out = tmp_path / "a.zarr"
    load_plugin(write(INTEGRATOR))
    chd.render("cornell-box", **SCALAR, out=out)
    load_plugin(write(INTEGRATOR))
    assert chd.render("cornell-box", **{**SCALAR, "spp": 6}, out=out).spp == 6
    load_plugin(write(INTEGRATOR.replace("2.0", "3.0")))
    with pytest.raises(StoreError, match=r"mine\.py"):
        chd.render("cornell-box", **{**SCALAR, "spp": 8}, out=out)
    assert (chd.render("cornell-box", **SCALAR).read() == 3).all()


def test_a_plugin_serves_every_variant(write, wavefront):
    load_plugin(write(INTEGRATOR))
    for backend in ("scalar", wavefront, "scalar"):
        samples = chd.render("cornell-box", **{**SCALAR, "backend": backend})
        assert (samples.read() == 2).all()
        assert list(samples.attrs["plugins"]) == ["mine.py"]


def test_a_material_imports_what_lies_beside_it(write, tmp_path):
    write("COLOUR = [0.2, 0.4, 0.6]", "colours.py")
    load_plugin(write(MATERIAL))
    facing = np.diag([9.0, 9.0, -1.0, 1.0])
    facing[2, 3] = 3.0
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective"},
        "light": {"type": "constant"},
        "wall": {"type": "rectangle", "to_world": facing, "bsdf": {"type": "coloured"}},
    }
    samples = chd.render(scene, spp=64, size=(4, 4), backend="scalar", progress=False)
    np.testing.assert_allclose(samples.read().mean(axis=(0, 1, 3)), [0.2, 0.4, 0.6], rtol=1e-3)
    assert list(samples.attrs["plugins"]) == ["mine.py"]


def test_the_process_of_the_explorer_has_the_plugin(write):
    path = write(INTEGRATOR)
    load_plugin(path)
    path.unlink()  # the code travels, not the name of a file
    own = "constant_radiance"
    job = Job.of("cornell-box", size=(8, 8), integrator=own, backend="scalar")
    render = RenderProcess(job)
    try:
        assert render._child is not None, "rendered in this process"
        assert (render("pixels", np.array([[1, 1]]), 3) == 2).all()
    finally:
        render.close()


def test_an_estimator_of_a_plugin_is_found_by_name(write):
    load_plugin(write(ESTIMATOR))
    x = np.array([1.0, 5.0, 3.0])
    assert registry.lookup("largest_of_mine")(x) == 5
    load_plugin(write(ESTIMATOR.replace("max", "min")))
    assert registry.lookup("largest_of_mine")(x) == 1
    with pytest.raises(InputError, match="largest_of_mine"):
        load_plugin(write(ESTIMATOR, "other.py"))
    with pytest.raises(InputError, match="largest_of_mine"):
        registry.register("largest_of_mine", source="not a plugin")(np.max)


def test_two_plugins_have_names_of_their_own(write, tmp_path):
    load_plugin(write(INTEGRATOR))
    with pytest.raises(InputError, match=r"other\.py.*mine\.py"):
        load_plugin(write(INTEGRATOR, "other.py"))
    (tmp_path / "below").mkdir()
    with pytest.raises(InputError, match="rename"):
        load_plugin(write(INTEGRATOR.replace("constant", "same"), "below/mine.py"))


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [("(self.value)", "(self.valu)", 13), ('props.get("value", 2.0)', "valu", 10)],
)
def test_a_mistake_in_a_class_is_told_by_its_line(write, old, new, line, backend):
    load_plugin(write(INTEGRATOR.replace(old, new)))
    with pytest.raises(ChdstatError, match=rf"mine\.py, line {line}: "):
        chd.render("cornell-box", **{**SCALAR, "backend": backend})


def test_the_command_loads_them(write, tmp_path):
    out = tmp_path / "a.zarr"
    settings = ("--spp", "4", "--size", "12x8", "--backend", "scalar", "-q")
    asked = ("--plugin", str(write(INTEGRATOR)), "--plugin", str(write(ESTIMATOR, "own.py")))
    line = ["render", "cornell-box", "-o", str(out), *settings, *asked]
    done = subprocess.run(
        [sys.executable, "-m", "chdstat", *line, "--integrator", "constant_radiance"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    samples = chd.open(out)
    assert (samples.read() == 2).all()
    assert list(samples.attrs["plugins"]) == ["mine.py"]
