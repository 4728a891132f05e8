"""Integrators and crops that are asked for in place of the scene's own."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, RenderError, StoreError
from chdstat.rendering import render_batches, render_pixels
from chdstat.rendering.backend import activate, probe

VIEW = {"spp": 4, "size": (12, 8), "backend": "scalar", "progress": False}


def render(**change):
    return chd.render("cornell-box", **{**VIEW, **change})


def test_an_integrator_takes_the_place_of_the_scene_s():
    direct = render(integrator="direct")
    assert direct.attrs["integrator"]["type"] == "direct"
    assert direct.read().sum() < render().read().sum()
    (batch,) = render_batches("cornell-box", **VIEW, integrator="direct")
    assert np.array_equal(batch, direct.read())


def test_its_settings_and_the_longest_path_count():
    short = render(integrator={"type": "path", "max_depth": 2})
    assert np.array_equal(short.read(), render(integrator="path", max_depth=2).read())
    assert short.attrs["integrator"]["max_depth"] == 2
    assert not np.array_equal(short.read(), render(integrator="path", max_depth=5).read())
    assert list(render(integrator={"type": "path", "max_depth": 6}, by_depth=3).depths) == [2, 3]


def test_settings_of_any_kind_are_stored(tmp_path):
    with activate(probe("scalar")) as mi:

        class Lit(mi.SamplingIntegrator):
            def __init__(self, props):
                super().__init__(props)
                self.tint = props["tint"]
                for name in ("direction", "to_world", "limit", "texture"):
                    props[name]

            def sample(self, scene, sampler, ray, medium=None, active=True):
                return mi.Color3f(self.tint), True, []

        mi.register_integrator("lit", Lit)
        lit = {
            "type": "lit",
            "tint": mi.ScalarColor3f(0.5, 0.25, 1.0),
            "direction": [0, 0, 1],
            "to_world": 2 * np.eye(4),
            "limit": np.inf,
            "texture": {"type": "checkerboard"},
        }
        scene = {**chd.load_scene("cornell-box").source, "integrator": lit}
        for out in (tmp_path / "a.zarr", None):
            samples = chd.render(scene, **VIEW, out=out)
    settings = chd.open(tmp_path / "a.zarr").attrs["integrator"]
    assert samples.attrs["integrator"] == settings
    assert settings["tint"] == [0.5, 0.25, 1.0]
    assert settings["direction"] == [0, 0, 1]
    assert np.array_equal(settings["to_world"], 2 * np.eye(4))
    assert settings["limit"] == "inf"


def test_a_crop_shows_a_part_of_the_image(tmp_path):
    many = {"spp": 256, "size": (16, 16)}
    whole, part = render(**many).read(), render(**many, crop=(4, 2, 8, 6))
    assert part.shape == (6, 8, 3, 256)
    mean, other = whole[2:8, 4:12].mean(axis=-1), part.read().mean(axis=-1)
    assert np.abs(mean - other).mean() < 0.3 * mean.mean()
    assert np.abs(mean - other).mean() < np.abs(whole[:6, :8].mean(axis=-1) - other).mean()
    kept = render(**many, crop=(4, 2, 8, 6), out=tmp_path / "part.zarr")
    assert np.array_equal(kept.read(), part.read())


@pytest.mark.parametrize(
    ("raised", "told"),
    [
        (KeyError("speed"), "KeyError: 'speed' .in .*Failing.eval_pdf of .*test_integrators.py"),
        (RuntimeError("too fast"), "by integrator 'path': too fast .in .*Failing.eval_pdf"),
    ],
)
def test_errors_of_a_class_name_it_once(backend, raised, told):
    """Dr.Jit calls the materials of all scenes that are alive: an error must keep none alive."""
    with activate(probe(backend)) as mi:

        class Failing(mi.BSDF):
            def __init__(self, props):
                super().__init__(props)
                self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
                self.m_components = [self.m_flags]

            def eval_pdf(self, ctx, si, wo, active=True):
                raise raised

        mi.register_bsdf("failing", Failing)
    ball = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "failing"}}
    scene = {**chd.load_scene("cornell-box").source, "ball": ball}
    view = {**VIEW, "backend": backend}
    with pytest.raises(RenderError, match=told) as kept:
        chd.render(scene, **view)
    assert np.isfinite(chd.render("cornell-box", **view).read()).all()
    assert kept.value.__cause__ is raised


# --- integrators of scenes that Mitsuba has built -----------------------------------------------


@pytest.fixture
def mi():
    with activate(probe("scalar")) as module:
        yield module


def own(mi, value):
    """Return an integrator of a class that no plugin registers."""

    class Constant(mi.SamplingIntegrator):
        def __init__(self, value):
            super().__init__(mi.Properties())
            self.value = value

        def sample(self, scene, sampler, ray, medium=None, active=True):
            return mi.Color3f(self.value), True, []

        def to_string(self):
            return "Constant"

    return Constant(value)


def built(integrator):
    """Return the Cornell box, which Mitsuba builds with an integrator object."""
    return {**chd.load_scene("cornell-box").source, "integrator": integrator}


def test_a_built_scene_draws_its_own_settings(mi):
    settings = {"type": "path", "max_depth": 3}
    scene, few, pixels = (
        built(mi.load_dict(settings)),
        {"spp": 70, "size": (12, 8)},
        [(2, 3), (6, 6)],
    )
    expected = render_pixels("cornell-box", pixels, **few, integrator=settings)
    assert np.array_equal(render_pixels(scene, pixels, **few), expected)
    given = chd.render(scene, **VIEW)
    assert np.array_equal(given.read(), chd.render(scene, **VIEW).read())
    assert given.attrs["integrator"] == {"type": "PathIntegrator", "max_depth": 3, "rr_depth": 5}
    assert given.attrs["scene_code"] == {}


def test_an_own_class_is_known_again(mi, tmp_path):
    out, view = tmp_path / "a.zarr", {**VIEW, "backend": "auto"}
    samples = chd.render(built(own(mi, 2.0)), **view, out=out)
    assert samples.attrs["backend"] == "scalar"
    assert samples.attrs["integrator"] == {"type": samples.attrs["integrator"]["type"], "value": 2}
    assert [name.split(".")[-1] for name in samples.attrs["scene_code"]] == ["Constant"]
    assert (samples.read() == 2).all()
    assert chd.render(built(own(mi, 2.0)), **{**view, "spp": 6}, out=out).spp == 6
    with pytest.raises(StoreError, match="Constant"):
        chd.render(built(own(mi, 3.0)), **{**view, "spp": 8}, out=out)


def test_a_built_scene_keeps_its_variant(wavefront):
    with activate(probe(wavefront)) as mi:
        scene = built(own(mi, mi.Float(2.0)))
        samples = chd.render(scene, **{**VIEW, "backend": "auto"})
        with pytest.raises(InputError, match="_ad_rgb.*scalar"):
            chd.render(scene, **VIEW)
    assert samples.attrs["backend"] == wavefront
    assert (samples.read() == 2).all()
    assert samples.attrs["integrator"]["value"] == [2.0]


def test_a_wavefront_s_integrator_is_taken(wavefront):
    """Mitsuba says "Unknown" of its kind, and "path" would take its place."""
    with activate(probe(wavefront)) as mi:

        class Two(mi.SamplingIntegrator):
            def sample(self, scene, sampler, ray, medium=None, active=True):
                return mi.Color3f(2.0), True, []

        mi.register_integrator("two_in_a_wavefront", Two)
    source = chd.load_scene("cornell-box").source
    scene = {**source, "integrator": {"type": "two_in_a_wavefront"}}
    assert (chd.render(scene, **{**VIEW, "backend": wavefront}).read() == 2).all()


def test_limits_of_a_built_scene_are_told(mi):
    path = mi.load_dict({"type": "path"})
    with pytest.raises(InputError, match="max_depth=3.*PathIntegrator"):
        chd.render(built(path), **VIEW, max_depth=3)
    with pytest.raises(RenderError, match="max_depth"):
        chd.render(built(path), **VIEW, by_depth=3)
    for kind in ({"type": "ptracer"}, {"type": "moment", "within": {"type": "path"}}):
        with pytest.raises(RenderError, match="does not sample pixel by pixel"):
            chd.render(built(mi.load_dict(kind)), **VIEW)


def test_objects_are_dicts_or_names_of_plugins(mi):
    with pytest.raises(InputError, match=r"got a MonteCarloIntegrator; .*scenes\.load_plugin"):
        render(integrator=mi.load_dict({"type": "path"}))
