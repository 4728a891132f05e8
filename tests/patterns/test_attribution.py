"""Attribution: shares of paths by their length, of known light and of real scenes."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import Reason
from chdstat.patterns.attribution import attribute
from chdstat.reporting.content import analysis_content
from chdstat.samples import Samples
from tests.matrices import look_at, scale, translate

RNG = np.random.default_rng(2)


def known(*light):
    """Return samples of one channel with parts of light that add up, the first of them direct."""
    cumulative = [Samples.from_array(x) for x in np.cumsum(light, axis=0, dtype=np.float32)]
    depths = {2 + i: part for i, part in enumerate(cumulative[:-1])}
    return Samples(cumulative[-1].read(), attrs={}, parts=depths)


def test_independent_light_has_its_own_variance():
    one, two, three = (RNG.gamma(1.0, s, size=(3, 4, 20000)) for s in (1.0, 2.0, 3.0))
    found = attribute(known(one, two, three))
    assert found["segments"].to_numpy().tolist() == [2, 3, np.inf]
    for name, expected in (("variance_share", [1, 4, 9]), ("mean_share", [1, 2, 3])):
        right = np.array(expected) / np.sum(expected)
        assert np.allclose(found[name].mean(("y", "x")), right, atol=0.01), name
        assert np.allclose(found[name].sum("segments"), 1, atol=1e-5), name


def test_the_brightest_hold_rare_light():
    rare = 1000 * (np.arange(4096) % 256 == 7) * np.ones((2, 2, 1))
    found = attribute(known(np.ones((2, 2, 4096)), rare))
    assert (found["brightest_share"][..., 1] > 0.99).all()
    assert np.allclose(found["variance_share"][..., 1], 1, atol=1e-5)


def test_opposite_lights_lower_the_variance():
    x = RNG.uniform(1, 2, size=(1, 1, 5000))
    found = attribute(known(x, 3 * (2 - x)))
    assert float(found["variance_share"][0, 0, 0]) == pytest.approx(-0.5, abs=1e-3)


def test_pixels_without_light_say_why():
    x = RNG.gamma(2.0, size=(1, 4, 64))
    x[0, 0], x[0, 1], x[0, 2, 5] = 0, np.nan, np.nan
    x[0, 3] = 1
    found = attribute(known(x / 2, x / 2))
    assert found["reason"].to_numpy()[0].tolist() == [
        Reason.ALL_NULL,
        Reason.ALL_BAD,
        Reason.OK,
        Reason.CONSTANT,
    ]
    assert np.isfinite(found["mean_share"].to_numpy()[0, 2]).all()
    assert np.isnan(found["mean_share"].to_numpy()[0, [0, 1, 3]]).all()


def test_modes_and_tail_have_paths_of_their_own():
    dark = RNG.lognormal(-4, 0.3, size=4096)
    bright = RNG.lognormal(2, 0.3, size=4096) * (RNG.random(4096) < 0.4)
    pixel = known(*(x.reshape(1, 1, -1) for x in (bright, dark))).pixel(0, 0)
    rows = {row["of"]: row for row in pixel.light}
    assert rows["mode 1"]["more than 2 segments"] > 0.99
    assert rows["mode 2"]["emitted and direct"] > 0.99
    assert rows["mode 1"]["share of the samples"] == pytest.approx(0.6, abs=0.03)
    assert rows["variance"]["emitted and direct"] > 0.99
    assert len(repr(pixel).splitlines()) <= 12


def test_samples_of_unknown_depth_are_refused():
    assert Samples.from_array(np.ones((2, 2, 3, 8))).pixel(0, 0).light == []


@pytest.mark.parametrize("scene", ["cornell-box", "fog"])
def test_shares_are_those_of_each_depth_alone(scene):
    settings = {"size": (12, 12), "spp": 128, "backend": "scalar", "progress": False}
    samples = chd.render(scene, **settings, seed=1, by_depth=4)
    found = attribute(samples)
    whole = [  # of one seed, or their differences would be noise
        chd.render(scene, **settings, seed=2, max_depth=depth).read().mean(dtype=np.float64)
        for depth in (2, 3, 4, None)
    ]
    right = np.diff(whole, prepend=0) / whole[-1]
    weight = samples.read() @ np.ones(128) @ np.array([0.2126, 0.7152, 0.0722])
    shares = (found["mean_share"].to_numpy() * weight[..., np.newaxis]).sum((0, 1)) / weight.sum()
    assert np.allclose(shares, right, atol=0.05)


def lit(whole, **lights):
    """Return samples of one channel of which the light from some lights is known."""
    parts = {name: Samples.from_array(x) for name, x in lights.items()}
    return Samples(Samples.from_array(whole).read(), attrs={}, parts=parts)


def test_light_of_each_source_has_its_own_variance():
    one, two = (RNG.gamma(1.0, s, size=(3, 4, 20000)).astype(np.float32) for s in (1.0, 2.0))
    found = attribute(lit(one + two, lamp=one), by="light")
    assert found["light"].to_numpy().tolist() == ["lamp", "other lights"]
    assert np.allclose(found["variance_share"].mean(("y", "x")), [0.2, 0.8], atol=0.01)
    whole = attribute(lit(one + two, lamp=one, sun=two), by="light")
    assert float(np.abs(whole["mean_share"][..., 2]).max()) < 1e-6


GROUPS = {
    "day-room": ["sky-*", "sun"],
    "fog": ["dawn", "sky", "globe-*"],
}


@pytest.mark.parametrize("scene", GROUPS)
def test_lights_alone_add_up_to_the_samples(scene):
    settings = {"size": (8, 8), "spp": 16, "backend": "scalar", "progress": False}
    samples = chd.render(scene, **settings, by_light=GROUPS[scene])
    assert list(samples.lights) == GROUPS[scene]
    alone = [part.read() for part in samples.lights.values()]
    assert min(part.min() for part in alone) == 0
    assert np.allclose(sum(alone), samples.read(), rtol=1e-4, atol=1e-6)
    found = attribute(samples, by="light")
    assert (np.abs(found["mean_share"][..., -1].fillna(0)) < 1e-3).all()
    assert np.array_equal(chd.render(scene, **settings).read(), samples.read())


def test_lights_that_share_textures_add_up(backend):
    grey = {"type": "rgb", "value": 0.6}
    pattern = {"type": "checkerboard", "color0": grey, "color1": grey}
    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": pattern}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {"type": "perspective", "to_world": look_at([0, -4, 1], [0, 0, 0.3])},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": pattern}},
    }
    for i in range(3):
        scene[f"lamp-{i}"] = {**lamp, "to_world": translate(i - 1, 0, 2) @ scale(1, -1, -1)}
    names = ["lamp-0", "lamp-1", "lamp-2"]
    settings = {"size": (6, 6), "spp": 32, "backend": backend, "progress": False}
    samples = chd.render(scene, **settings, by_light=names)
    alone = [samples.lights[name].read() for name in names]
    assert min(part.max() for part in alone) > 0.1
    assert np.allclose(sum(alone), samples.read(), rtol=1e-4, atol=1e-6)


def test_lights_are_stored_resumed_and_opened(tmp_path):
    settings = {"size": (8, 8), "backend": "scalar", "progress": False}
    path = tmp_path / "a.zarr"
    chd.render("fog", spp=4, out=path, by_light=["globe-*"], **settings)
    samples = chd.render("fog", spp=8, out=path, direct=True, **settings)
    opened = chd.open(path)
    whole = chd.render("fog", spp=8, by_light=["globe-*"], **settings)
    for found in (samples, opened.load(), opened.save(tmp_path / "b.zarr")):
        assert list(found.depths) == [2]
        assert np.array_equal(found.lights["globe-*"].read(), whole.lights["globe-*"].read())
    assert [row["of"] for row in opened.pixel(4, 4).lights[:2]] == ["mean", "variance"]
    assert chd.samples.inspect(path, verify=True)["lights"] == {"globe-*": 8}


def test_parts_are_stored_resumed_and_opened(tmp_path):
    settings = {"size": (8, 8), "backend": "scalar", "progress": False}
    path = tmp_path / "a.zarr"
    chd.render("cornell-box", spp=4, out=path, **settings)
    rendered = chd.render("cornell-box", spp=8, out=path, by_depth=4, **settings)
    opened = chd.open(path)
    for samples in (rendered, opened, opened.load(), opened.save(tmp_path / "b.zarr")):
        assert list(samples.depths) == [2, 3, 4]
        assert samples.direct is samples.depths[2]
        parts = [part.read() for part in samples.depths.values()]
        for shorter, longer in zip(parts, [*parts[1:], samples.read()], strict=True):
            assert (longer >= shorter).all()
    fresh = chd.render("cornell-box", spp=8, max_depth=3, **settings)
    assert np.array_equal(opened.depths[3].read(), fresh.read())
    assert chd.samples.inspect(path, verify=True)["depths"] == {"2": 8, "3": 8, "4": 8}


def test_analyses_say_which_paths_make_the_variance():
    samples = chd.render(
        "cornell-box", spp=64, size=(16, 16), backend="scalar", by_depth=3, progress=False
    )
    said = analysis_content(samples, chd.analyze(samples, progress=False))["findings"]
    (told,) = [finding for finding in said if "largest part of the variance" in finding]
    shares = chd.patterns.attribute(samples)["variance_share"].mean(("y", "x")).to_numpy()
    assert f"{100 * shares.max():.0f}\xa0%" in told
    assert [found for found in said if "of the light" in found] == [told]
