"""Scenes that Mitsuba has built: rendered as they are, known again, and what they cannot do."""

from dataclasses import replace

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, RenderError, StoreError
from chdstat.rendering.backend import activate, probe
from tests.matrices import look_at

VIEW = {"spp": 4, "size": (24, 24), "seed": 3, "progress": False}
PATH = {"type": "path", "max_depth": 8}
BALL = {
    "type": "scene",
    "sensor": {
        "type": "thinlens",
        "aperture_radius": 0.05,
        "focus_distance": 2.0,
        "fov": 50,
        "fov_axis": "diagonal",
        "near_clip": 0.1,
        "film": {
            "type": "hdrfilm",
            "width": 32,
            "height": 20,
            "crop_offset_x": 4,
            "crop_width": 20,
        },
    },
    "ball": {"type": "sphere", "center": [0, 0, 4]},
    "sky": {"type": "constant"},
}
FLOOR = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
LOOKING_DOWN = look_at([0, 0, 2], [0, 0, 0], up=[0, 1, 0])
METER = {"type": "radiancemeter", "film": {"type": "hdrfilm", "width": 1, "height": 1}}


@pytest.fixture
def mi():
    with activate(probe("scalar")) as module:
        yield module


@pytest.mark.parametrize("source", ["cornell box", "ball"])
def test_it_draws_what_its_description_draws(mi, source):
    described = mi.cornell_box() if source == "cornell box" else BALL
    view = {**VIEW, "integrator": PATH} | ({} if source == "cornell box" else {"size": None})
    live = chd.render(mi.load_dict(described), **view)
    expected = chd.render(described, **view, backend="scalar")
    assert np.array_equal(live.read(), expected.read())
    assert live.features.keys() == expected.features.keys()
    assert all(np.array_equal(live.features[k], v) for k, v in expected.features.items())
    assert "filter" in live.attrs["notes"][0]


def test_a_wavefront_draws_its_description(wavefront):
    with activate(probe(wavefront)) as mi:
        live = chd.render(mi.load_dict(mi.cornell_box()), **VIEW)
        expected = chd.render(mi.cornell_box(), **VIEW, backend=wavefront)
    assert np.array_equal(live.read(), expected.read())


def test_dicts_of_objects_are_built_alike(mi):
    grey = {"type": "diffuse", "reflectance": 0.2}
    film, floor = BALL["sensor"]["film"], {**FLOOR, "bsdf": grey}
    plain = {**BALL, "floor": floor, "integrator": PATH}
    objects = {
        "floor": {**floor, "bsdf": mi.load_dict(grey)},
        "ball": mi.load_dict(BALL["ball"]),
        "sensor": {**BALL["sensor"], "film": mi.load_dict(film)},
        "integrator": mi.load_dict(PATH),
    }
    expected = chd.render(mi.load_dict(plain), spp=2, progress=False).read()
    for name, held in objects.items():
        found = chd.render({**plain, name: held}, spp=2, progress=False)
        assert np.array_equal(found.read(), expected), name


@pytest.mark.parametrize("kind", ["TensorXf", "VolumeGrid"])
def test_data_of_mitsuba_are_of_no_variant_and_stay(mi, kind, wavefront):
    grid = np.arange(8, dtype=np.float32).reshape(2, 2, 2, 1) / 8
    volume = {"type": "gridvolume", "raw": True, "grid" if kind == "VolumeGrid" else "data": None}
    held = getattr(mi, kind)(grid)
    volume = {name: held if value is None else value for name, value in volume.items()}
    texture = {"type": "volume", "volume": volume}
    ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}}
    scene = {**BALL, "ball": ball, "integrator": PATH}
    means = [
        chd.render(scene, spp=16, backend=backend, progress=False).read().mean()
        for backend in ("scalar", wavefront, "scalar")
    ]
    assert means[0] == means[2] == pytest.approx(means[1], rel=0.05)
    assert (np.array(held).ravel() == grid.ravel()).all()


def test_a_store_goes_on_with_it_until_it_is_changed(mi, tmp_path):
    out, built = tmp_path / "a.zarr", mi.load_dict(mi.cornell_box())
    chd.render(built, **VIEW, out=out)
    again = mi.load_dict(mi.cornell_box())  # elsewhere in memory
    assert chd.render(again, **{**VIEW, "spp": 6}, out=out).spp == 6
    parameters = mi.traverse(again)
    parameters["white.reflectance.value"] = [0.1, 0.1, 0.1]
    parameters.update()
    with pytest.raises(StoreError, match="other samples"):
        chd.render(again, **{**VIEW, "spp": 8}, out=out)
    assert chd.open(out).spp == 6


def test_hashes_depend_on_no_order(mi):
    built = [mi.load_dict(mi.cornell_box()) for _ in range(40)]  # a fifth in another order
    assert len({chd.load_scene(scene).hash for scene in built}) == 1
    for change in ("white.reflectance.value", "light.to_world", "sensor.x_fov"):
        scene = mi.load_dict(mi.cornell_box())
        parameters = mi.traverse(scene)
        value = parameters[change]
        parameters[change] = value @ value if change == "light.to_world" else 0.9 * value
        parameters.update()
        assert chd.load_scene(scene).hash != chd.load_scene(built[0]).hash
    glass = {**mi.cornell_box(), "large-box": {"type": "cube", "bsdf": {"type": "dielectric"}}}
    assert chd.load_scene(mi.load_dict(glass)).hash != chd.load_scene(built[0]).hash


def test_what_instances_are_made_of_belongs_to_the_hash(mi):
    def hashed(radius, grey):
        ball = {"type": "sphere", "radius": radius}
        ball["bsdf"] = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": grey}}
        group = {"type": "shapegroup", "ball": ball, "cube": {"type": "cube"}}
        copy = {"type": "instance", "shapes": {"type": "ref", "id": "group"}}
        built = mi.load_dict({**BALL, "group": group, "copy": copy})
        return chd.load_scene(built).hash

    assert len({hashed(1.0, 0.5) for _ in range(10)}) == 1
    assert len({hashed(1.0, 0.5), hashed(2.0, 0.5), hashed(1.0, 0.2)}) == 3


def test_an_odd_sensor_is_used_as_it_is(mi):
    down = mi.ScalarTransform4f(LOOKING_DOWN)
    sky = {"type": "scene", "sky": {"type": "constant", "radiance": 0.5}, "floor": FLOOR}
    view = {**VIEW, "size": None, "integrator": PATH}
    spot = chd.render(mi.load_dict({**sky, "sensor": METER}), **view)
    assert spot.shape == (1, 1, 3, 4)
    assert (spot.read() == 0.5).all()
    assert (spot.features["depth"] == 0).all()
    above = {"type": "orthographic", "to_world": down, "film": METER["film"]}
    pair = {"type": "batch", "a": above, "b": above, "film": {**METER["film"], "width": 70}}
    both = chd.render(mi.load_dict({**sky, "sensor": pair}), **view)
    assert both.shape == (1, 70, 3, 4)
    mean = both.read().mean(axis=(0, 2, 3))
    assert mean[:35].mean() == pytest.approx(mean[35:].mean(), abs=0.05)
    assert both.features["depth"] == pytest.approx(1.99, abs=1e-3)  # from the near clip


def test_the_spectral_response_is_kept():
    with activate(replace(probe("scalar"), color="spectral")) as mi:

        def built(response):
            sensor = {"type": "perspective", "film": METER["film"], **response}
            parts = {"sensor": sensor, "sky": {"type": "constant"}, "integrator": PATH}
            return mi.load_dict({"type": "scene", **parts})

        red = {"type": "regular", "wavelength_min": 600.0, "wavelength_max": 700.0}
        scenes = [
            built({"srf": {**red, "values": v}} if v else {}) for v in ("0, 1, 0", "1, 1", "")
        ]
        narrow, _, plain = scenes
        assert len({chd.load_scene(scene).hash for scene in scenes}) == 3
        view = {"spp": 64, "color": "spectral", "progress": False}
        means = [chd.render(scene, **view).read().mean(axis=(0, 1, 3)) for scene in scenes]
        expected = [np.array(mi.render(scene, spp=4096)).ravel() for scene in scenes]
        for mean, exact in zip(means, expected, strict=True):
            np.testing.assert_allclose(mean, exact, rtol=0.2, atol=0.05 * exact.max())
        assert np.ptp(means[2]) < np.ptp(means[0])
        with pytest.raises(RenderError, match="1 x 1"):
            chd.render(narrow, **view, size=(4, 4))
        assert chd.render(plain, **view, size=(4, 4)).shape[:2] == (4, 4)


def test_what_it_cannot_do_is_told(mi):
    built = mi.load_dict(mi.cornell_box())
    with pytest.raises(InputError, match="scalar_rgb"):
        chd.render(built, **VIEW, color="spectral")
    with pytest.raises(InputError, match="change the scene"):
        chd.render(built, **VIEW, by_light=["light"])
    with pytest.raises(InputError, match="this process"):
        chd.render(built, **VIEW, integrator=PATH, client=object())
    spot = mi.load_dict({"type": "scene", "sensor": METER})
    with pytest.raises(RenderError, match="RadianceMeter.*1 x 1"):
        chd.render(spot, **VIEW, integrator=PATH)
    with pytest.raises(InputError, match="got a mitsuba"):
        chd.render(built.sensors()[0], **VIEW)
