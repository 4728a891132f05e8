"""What a scene asks for: crops of its film, sensors and wrappers, given or refused in words.

The statistical tests compare pixels with Mitsuba's own average of the same scene; seeds are fixed.
With a new seed each fails falsely with a probability below 1e-4 (five standard errors, at most 400
pixels), and each has a negative control.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.io import write_exr
from chdstat.rendering import render_pixels
from chdstat.rendering.backend import activate, probe
from chdstat.rendering.jobs import scene_integrator, scene_size
from chdstat.scenes import load_scene
from tests.luminance import LUMINANCE
from tests.matrices import look_at, translate

WHOLE, CROP = (
    (48, 32),
    {"crop_width": 16, "crop_height": 12, "crop_offset_x": 20, "crop_offset_y": 9},
)


def box(**film: Any) -> dict[str, Any]:
    """Return the Cornell box with another film."""
    source = dict(load_scene("cornell-box").source)
    plain = {"type": "hdrfilm", "width": WHOLE[0], "height": WHOLE[1], "rfilter": {"type": "box"}}
    return {**source, "sensor": {**source["sensor"], "film": {**plain, **film}}}


def render(scene: Any, **options: Any) -> chd.Samples:
    return chd.render(scene, **{"backend": "scalar", "spp": 64, **options})


def by_mitsuba(source: dict[str, Any], spp: int, sensor: int = 0) -> np.ndarray:
    """Return the luminance that Mitsuba renders of a scene."""
    with activate(probe("scalar")) as mi:
        image = mi.render(load_scene(source).load(), sensor=sensor, spp=spp, seed=100_000)
        return np.array(image, np.float64) @ LUMINANCE


def errors(samples: chd.Samples, image: np.ndarray) -> np.ndarray:
    """Return by how many of its standard errors each pixel differs from an exact image."""
    x = LUMINANCE @ samples.read().astype(np.float64)
    return (x.mean(-1) - image) / (x.std(-1, ddof=1) / np.sqrt(x.shape[-1]) + 1e-6)


def test_a_crop_of_the_film_is_the_image(tmp_path):
    out = tmp_path / "s.zarr"
    samples = render(box(**CROP), spp=256, out=out)
    assert samples.shape[:2] == (12, 16)
    assert scene_size(box(**CROP)) == (16, 12)
    assert samples.attrs["crop"] == [20, 9, 48, 32]
    assert samples.attrs["notes"] == []
    image = by_mitsuba(box(**CROP), 4096)
    assert abs(errors(samples, image)).max() < 5
    # The middle of the film is another part of it.
    assert abs(errors(samples, by_mitsuba(box(), 64)[10:22, 16:32])).max() > 5
    whole = render(box(), spp=1)
    assert whole.shape[:2] == (32, 48)
    assert whole.attrs["crop"] is None
    depth = whole.features["depth"][9:21, 20:36]
    assert np.median(abs(samples.features["depth"] - depth) / depth) < 0.01
    assert chd.render(box(**CROP), out=out, spp=260, backend="scalar").spp == 260


def test_single_pixels_of_a_crop_are_those_of_its_image():
    pixels = [(0, 0), (6, 8), (11, 15)]
    single = render_pixels(box(**CROP), pixels, spp=512)
    image = by_mitsuba(box(**CROP), 4096)
    x = LUMINANCE @ single.astype(np.float64)
    error = x.std(-1, ddof=1) / np.sqrt(512)
    assert (abs(x.mean(-1) - [image[p] for p in pixels]) < 5 * error).all()


@pytest.mark.parametrize(
    ("size", "film", "notes"), [((32, 24), [40, 18, 96, 64], 0), ((8, 8), [10, 6, 24, 21], 1)]
)
def test_another_size_enlarges_the_crop(size, film, notes):
    samples = render(box(**CROP), size=size, spp=2)
    assert samples.shape[:2] == size[::-1]
    assert samples.attrs["crop"] == film
    assert len(samples.attrs["notes"]) == notes


# --- sensors ------------------------------------------------------------------------------------


def two_sensors() -> dict[str, Any]:
    source = box(width=12, height=10)
    film = {"type": "hdrfilm", "width": 20, "height": 16, "rfilter": {"type": "gaussian"}}
    other = {
        "type": "perspective",
        "fov": 100,
        "to_world": source["sensor"]["to_world"],
        "film": film,
    }
    return {**source, "wide": other}


def test_the_sensor_that_is_asked_for_sees_the_image(tmp_path, caplog):
    out = tmp_path / "s.zarr"
    with caplog.at_level(logging.WARNING, logger="chdstat"):
        first = render(two_sensors(), spp=4)
    (note,) = first.attrs["notes"]
    assert note == "the scene has 2 sensors; sensor 0 ('sensor') is used"
    assert [record.getMessage() for record in caplog.records] == [f"scene: {note}"]
    assert first.shape[:2] == (10, 12)
    second = render(two_sensors(), sensor=1, spp=256, out=out)
    assert second.shape[:2] == (16, 20)
    assert "gaussian filter" in second.attrs["notes"][1]
    boxed = two_sensors()
    boxed["wide"]["film"]["rfilter"] = {"type": "box"}
    assert abs(errors(second, by_mitsuba(boxed, 2048, sensor=1))).max() < 5
    narrow = render(box(width=20, height=16), spp=256)
    assert abs(errors(narrow, by_mitsuba(boxed, 64, sensor=1))).max() > 5
    with pytest.raises(StoreError, match="sensor: stored 1, asked for 0"):
        render(two_sensors(), out=out, spp=300)
    with pytest.raises(InputError, match="below 2.*got 2"):
        render(two_sensors(), sensor=2)


# --- wrappers -----------------------------------------------------------------------------------


PATH = {"type": "path", "max_depth": 4}
AOV = {"type": "aov", "aovs": "d:depth", "within": PATH}


@pytest.mark.parametrize("wrapper", [AOV, *({"type": "moment", "nested": n} for n in (PATH, AOV))])
def test_wrappers_draw_what_lies_within(wrapper):
    plain = render({**box(), "integrator": PATH}, spp=3)
    samples = render({**box(), "integrator": wrapper}, spp=3)
    assert np.array_equal(samples.read(), plain.read())
    assert samples.attrs["integrator"] == {"type": "path", "max_depth": 4}
    assert samples.attrs["notes"][-1].endswith(
        "the path integrator within it is used, whose samples are kept"
    )
    assert scene_integrator({**box(), "integrator": wrapper}) == "path"


# --- what Mitsuba's loader makes of a scene -------------------------------------------------------


PLAIN_FILM = {"type": "hdrfilm", "width": 6, "height": 4, "rfilter": {"type": "box"}}
ABOVE = {"type": "orthographic", "to_world": look_at([0, 0, 2], [0, 0, 0], up=[0, 1, 0])}


def floor(**parts: Any) -> dict[str, Any]:
    """Return a floor of reflectance .5 below a sky of 1, seen from above."""
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {**ABOVE, "film": PLAIN_FILM},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
        "sky": {"type": "constant"},
        **parts,
    }
    return {name: part for name, part in scene.items() if part is not None}


def test_files_are_found_in_resources(tmp_path):
    (tmp_path / "maps").mkdir()
    texture = {"type": "bitmap", "filename": "grey.exr", "raw": True}
    scene = floor(
        resources={"type": "resources", "path": str(tmp_path / "maps")},
        floor={"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
    )
    hashes = []
    for grey in (0.25, 0.75):
        write_exr(tmp_path / "maps/grey.exr", np.full((2, 2, 3), grey, np.float32))
        samples = render(scene, spp=16)
        assert samples.features["albedo"] == pytest.approx(grey)
        hashes.append(samples.attrs["scene_hash"])
        assert list(samples.attrs["scene_files"]) == ["grey.exr"]
    assert hashes[0] != hashes[1]


def test_settings_not_used_are_named():
    bands = {"type": "specfilm", "red": {"type": "spectrum", "value": [(400, 0.0), (700, 1.0)]}}
    bands |= {"filter": {"type": "box", "id": "of_its_own"}}
    film = {k: v for k, v in PLAIN_FILM.items() if k != "rfilter"}
    scene = floor(
        sensor={**ABOVE, "film": {**film, **bands}},
        integrator={"type": "path", "timeout": 5.0, "samples_per_pass": 2},
    )
    for color in ("rgb", "spectral"):
        samples = render(scene, spp=4, color=color)
        assert samples.attrs["notes"] == [
            "the scene asks for the specfilm film and its red: samples are linear sRGB",
            "samples_per_pass, timeout of the path integrator: not used",
        ]
        assert samples.shape == (4, 6, 3, 4)
    grey = render(floor(sensor={**ABOVE, "film": {**PLAIN_FILM, "pixel_format": "luminance"}}))
    assert grey.attrs["notes"] == ["the film's pixel_format luminance: samples are linear sRGB"]


def test_some_sensors_show_all_in_any_crop(tmp_path):
    half = {**ABOVE, "to_world": ABOVE["to_world"] @ translate(2.0, 0.0, 0.0)}
    film = {**PLAIN_FILM, "width": 140, "height": 2}
    scene = floor(sensor={"type": "batch", "floor": ABOVE, "sky": half, "film": film})
    wide = render(scene, spp=8)  # more than one tile
    seen = wide.features["depth"] > 0
    assert seen[:, :70].all()
    assert not seen[:, 70:].any()
    assert (wide.read()[:, 70:] == 1).all()
    assert wide.read()[:, :70].mean() == pytest.approx(0.5, abs=0.02)
    out = tmp_path / "s.zarr"
    render(scene, spp=70, out=out)
    assert np.array_equal(render(scene, spp=80, out=out).read(), render(scene, spp=80).read())
    with pytest.raises(InputError, match="batch"):
        render(scene, crop=(0, 0, 8, 2))
    meter = {"type": "irradiancemeter", "film": PLAIN_FILM}
    lit = {"type": "rectangle", "to_world": translate(0, 0, 1), "sensor": meter}
    irradiance = render(floor(sensor=None, meter=lit), spp=8)
    assert irradiance.read() == pytest.approx(np.pi, rel=1e-5)


def test_sensors_have_the_numbers_of_mitsuba():
    """Mitsuba's loader puts meshes and what merges hold behind all others."""

    def film(width: int) -> dict[str, Any]:
        return {"film": {**PLAIN_FILM, "width": width, "height": 1}}

    def meter(width: int, kind: str) -> dict[str, Any]:
        return {"type": kind, "sensor": {"type": "irradiancemeter", **film(width)}}

    inner = {"type": "merge", "a": meter(5, "sphere"), "b": meter(6, "sphere")}
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "_merged_0": meter(7, "cube"),
        "several": {"type": "merge", "ball": meter(4, "sphere"), "inner": inner},
        "one": {"type": "merge", "ball": meter(1, "sphere")},
        "ball": meter(2, "sphere"),
        "last": {"type": "orthographic", **film(3)},
        "a": {"type": "cube", "bsdf": {"type": "null"}},
        "b": {"type": "cube", "bsdf": {"type": "null"}},
    }
    with activate(probe("scalar")) as mi:
        sensors = mi.load_dict(scene).sensors()
    assert [sensor.film().size()[0] for sensor in sensors] == [1, 2, 3, 4, 5, 6, 7]
    for number, width in enumerate(range(1, 8)):
        assert render(scene, sensor=number, spp=1).shape[:2] == (1, width)
