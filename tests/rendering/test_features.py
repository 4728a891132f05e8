"""First-hit features: of what samples see, whatever a ray passes through."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.scenes.plugins import load_plugin
from tests.matrices import look_at, scale, translate

FILM = {"type": "hdrfilm", "width": 6, "height": 6, "rfilter": {"type": "box"}}
CAMERA = {
    "type": "perspective",
    "fov": 20,
    "to_world": look_at([0.0, 0.0, 5.0], [0.0, 0.0, 0.0], up=[0.0, 1.0, 0.0]),
    "film": FILM,
}
FINE = {**CAMERA, "film": {**FILM, "width": 40, "height": 40}}
GREY = {"type": "diffuse", "reflectance": 0.25}
FLOOR = {"type": "rectangle", "to_world": scale(3, 3, 3), "bsdf": GREY}
SCENE = {"type": "scene", "integrator": {"type": "path"}, "sensor": CAMERA, "floor": FLOOR}
SKY = {"type": "constant"}
LAMP = {
    "type": "rectangle",
    "to_world": translate(0, 0, 2) @ scale(2, 2, 1),
    "emitter": {"type": "area", "radiance": 1.0},
}


def features(backend: str = "scalar", **parts: Any) -> dict[str, np.ndarray]:
    samples = chd.render({**SCENE, "sky": SKY, **parts}, spp=2, backend=backend, progress=False)
    return {name: np.asarray(image) for name, image in samples.features.items()}


def sheet(**bsdf: Any) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": translate(0, 0, 2) @ scale(2, 2, 1), "bsdf": bsdf}


def foggy(extinction: Any) -> dict[str, Any]:
    fog = {"type": "homogeneous", "albedo": 0.9, "sigma_t": extinction, "sample_emitters": True}
    place = translate(0, 0, 1.5) @ scale(2, 2, 1)
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": fog}


def is_floor(found: dict[str, np.ndarray], reflectance: float = 0.25) -> bool:
    assert found["depth"] == pytest.approx(5.05, abs=0.07)
    assert found["position"][..., 2] == pytest.approx(0, abs=1e-5)
    assert found["normal"] == pytest.approx(np.broadcast_to([0, 0, 1], (6, 6, 3)), abs=1e-5)
    return bool(np.allclose(found["albedo"], reflectance, atol=1e-5))


@pytest.mark.parametrize("name", ["path", "volpath", "direct"])
def test_hidden_lamps_are_passed(backend, name):
    hiding = {"type": name, "hide_emitters": True}
    assert is_floor(features(backend, lamp=LAMP, integrator=hiding))
    shown = features(backend, lamp=LAMP)
    assert shown["depth"] == pytest.approx(3.03, abs=0.05)
    # Of a plain scene, following rays one by one gives what Mitsuba's own integrator gives.
    plain = features(backend, integrator=hiding)
    assert is_floor(plain)


def test_null_materials_and_masks_are_passed(backend):
    assert is_floor(features(backend, sheet=sheet(type="null")))
    veil = sheet(type="mask", opacity=0.5, inner={"type": "diffuse", "reflectance": 0.75})
    half = features(backend, sheet=veil, sensor=FINE)
    # 25,600 rays: four standard errors of a half are .0125.
    assert (half["albedo"].mean() - 0.25) / 0.5 == pytest.approx(0.5, abs=0.0125)
    assert (half["depth"].mean() - 3.03) / 2.02 == pytest.approx(0.5, abs=0.02)
    # What lets a ray through says nothing of what comes next.
    second = {**veil, "to_world": translate(0, 0, 1) @ scale(2, 2, 1)}
    twice = features(backend, sheet=veil, second=second, sensor=FINE)
    assert (twice["albedo"].mean() - 0.25) / 0.5 == pytest.approx(0.75, abs=0.0125)


@pytest.mark.parametrize(("name", "depth"), [("path", 4.0), ("volpath", 5.0)])
def test_hidden_lamps_show_behind_what_is_passed(backend, name, depth):
    hiding = {"type": name, "hide_emitters": True}
    lamp = {**LAMP, "to_world": translate(0, 0, 1) @ scale(2, 2, 1)}
    found = features(backend, sheet=sheet(type="null"), lamp=lamp, integrator=hiding)
    assert found["depth"] == pytest.approx(depth, abs=0.1)


def test_a_medium_ends_rays_where_it_scatters(backend):
    parts = {"box": foggy(0.5), "sensor": FINE}
    assert features(backend, **parts)["albedo"].mean() == pytest.approx(0.25, abs=1e-4)
    through = np.exp(-0.5 * 2)  # two units of fog, of which the path integrator knows nothing
    found = features(backend, integrator={"type": "volpath"}, **parts)
    share = (0.9 - found["albedo"].mean()) / 0.65
    assert share == pytest.approx(through, abs=0.0125)
    assert np.linalg.norm(found["normal"].mean(axis=(0, 1))) == pytest.approx(through, abs=0.0125)


def test_a_camera_stands_in_its_medium(backend):
    camera = {**FINE, "fog": foggy(0.1)["interior"]}
    found = features(backend, integrator={"type": "volpath"}, sensor=camera)
    share = (0.9 - found["albedo"].mean()) / 0.65
    assert share == pytest.approx(np.exp(-0.1 * 5.05), abs=0.0125)


def test_a_medium_may_be_clear_in_a_channel(backend):
    clear = {"type": "rgb", "value": [0.5, 0.5, 0.0]}
    found = features(backend, integrator={"type": "volpath"}, box=foggy(clear))
    assert np.isfinite(found["albedo"]).all()
    assert found["albedo"][..., 0].mean() > 0.3


def test_instances_are_passed_like_materials(backend):
    copy = {"type": "instance", "shapes": {"type": "ref", "id": "group"}}
    for opacity in (0.0, 1.0):
        inner = {"type": "diffuse", "reflectance": 0.75}
        group = {"type": "shapegroup", "sheet": sheet(type="mask", opacity=opacity, inner=inner)}
        found = features(backend, group=group, copy=copy)
        assert is_floor(found) if opacity == 0 else found["albedo"] == pytest.approx(0.75)


def test_thin_glass_shows_what_is_behind_it(backend):
    found = features(backend, sheet=sheet(type="thindielectric"))
    assert 3.0 < np.median(found["depth"]) < 5.1
    assert found["depth"].mean() > 4.5  # it reflects less than a tenth


def test_what_cannot_be_said_leaves_its_samples(tmp_path):
    code = """
import mitsuba as mi


class Mute(mi.BSDF):
    def __init__(self, props):
        super().__init__(props)
        self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
        self.m_flags = self.m_components[0]

    def sample(self, ctx, si, sample1, sample2, active=True):
        bs = mi.BSDFSample3f()
        bs.pdf = 0.0
        return bs, mi.Color3f(0.0)

    def eval_pdf(self, ctx, si, wo, active=True):
        return mi.Color3f(0.0), 0.0

    def eval_diffuse_reflectance(self, si, active=True):
        raise ValueError("no such thing")


mi.register_bsdf("mute", Mute)
"""
    path = tmp_path / "mute.py"
    path.write_text(code)
    load_plugin(path)
    scene = {**SCENE, "sky": SKY, "floor": {**FLOOR, "bsdf": {"type": "mute"}}}
    out = tmp_path / "s.zarr"
    samples = chd.render(scene, spp=4, backend="scalar", out=out, progress=False)
    assert samples.spp == 4
    assert samples.features == {}
    assert "no such thing" in samples.attrs["why_no_features"]
    again = chd.render(scene, spp=8, backend="scalar", out=out, progress=False)
    assert again.spp == 8
    assert "no such thing" in chd.open(out).attrs["why_no_features"]
