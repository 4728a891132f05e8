"""Scenes of Mitsuba's plugins have the mean that Mitsuba renders, or are refused in words.

Mitsuba itself tests what plugins do; here are those that meet code of chdstat: lights, media, files
and instances, integrators, sensors and films. For each there is a small scene, whose mean luminance
in 48 pixels is compared with Mitsuba's own average of four times the samples; wrappers, films and
filters are in `test_scene_settings`, which compares samples. Seeds are fixed; with new ones, a
scene differs by chance with a probability of 1e-5 over all pixels (Sidak), more often where tails
are heavy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import ChdstatError
from chdstat.rendering.backend import activate, probe
from tests.luminance import LUMINANCE
from tests.matrices import look_at, scale, translate

Change = dict[str, Any]

RGB = {"type": "rgb", "value": [0.7, 0.4, 0.2]}
FILM = {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}}
VIEW = {
    "type": "perspective",
    "fov": 40,
    "to_world": look_at([0.0, -4.0, 2.0], [0.0, 0.0, 0.3]),
}
CAMERA = {**VIEW, "film": FILM}
BASE: Change = {
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 4},
    "sensor": CAMERA,
    "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": RGB}},
    "sky": {"type": "constant", "radiance": 0.5},
}
BALL = {"type": "sphere", "center": [0.0, 0.0, 0.5], "radius": 0.5}
FOG = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 1.5}
INTEGRATOR = {"type": "path", "max_depth": 4}


def bsdf(name: str, **settings: Any) -> Change:
    return {"ball": {**BALL, "bsdf": {"type": name, **settings}}}


def texture(name: str, **settings: Any) -> Change:
    reflectance = {"type": name, **settings}
    return {"floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}}}


def emitter(name: str, **settings: Any) -> Change:
    return {"sky": {"type": name, **settings}}


def medium(**settings: Any) -> Change:
    box = {"type": "cube", "bsdf": {"type": "null"}, "interior": {**FOG, **settings}}
    return {"box": {**box, "to_world": scale(0.6, 0.6, 0.6)}, "integrator": {"type": "volpath"}}


def sensor(name: str, **settings: Any) -> Change:
    return {"sensor": {"type": name, "to_world": CAMERA["to_world"], "film": FILM, **settings}}


def shape(name: str, **settings: Any) -> Change:
    return {"thing": {"type": name, "bsdf": {"type": "diffuse", "reflectance": 0.3}, **settings}}


def integrator(name: str, **settings: Any) -> Change:
    return {"integrator": {"type": name, **settings}}


POINTS = np.array([[0, 0, 0.2], [1, 0, 0.2], [0, 1, 0.9]], np.float32)


def written(folder: Path, name: str) -> str:
    """Write a file that a plugin reads, and return its path."""
    import mitsuba as mi

    path, rng = folder / name, np.random.default_rng(1)
    if name == "mesh.ply":
        properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "r", "g", "b"))
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}element face 1\n"
            "property list uchar int vertex_indices\nend_header\n"
            + "".join(f"{x} {y} {z} {x} {y} 0.5\n" for x, y, z in POINTS)
            + "3 0 1 2\n"
        )
    elif name == "image.exr":
        mi.Bitmap(rng.random((4, 8, 3), dtype=np.float32)).write(str(path))
    elif name == "grid.vol":
        mi.VolumeGrid(rng.random((4, 4, 4, 1), dtype=np.float32)).write(str(path))
    elif name == "ball.vol":  # the distance to it
        z, y, x = np.mgrid[:8, :8, :8] / 7 - 0.5
        distance = np.sqrt(x**2 + y**2 + z**2) - 0.4
        mi.VolumeGrid(distance[..., np.newaxis].astype(np.float32)).write(str(path))
    return str(path)


SCENES: dict[str, Callable[[Path], Change]] = {
    # materials
    "blendbsdf": lambda _: bsdf(
        "blendbsdf", weight=0.3, a={"type": "diffuse"}, b={"type": "conductor"}
    ),
    "bumpmap": lambda d: bsdf(
        "bumpmap",
        bump={"type": "bitmap", "filename": written(d, "image.exr"), "raw": True},
        inner={"type": "diffuse"},
    ),
    "mask": lambda _: bsdf("mask", opacity=0.4, inner={"type": "diffuse"}),
    "measured": lambda d: bsdf("measured", filename=str(d / "none.bsdf")),
    "null": lambda _: bsdf("null"),
    # textures and spectra
    "bitmap": lambda d: texture("bitmap", filename=written(d, "image.exr")),
    "mesh_attribute": lambda d: {
        "thing": {
            "type": "ply",
            "filename": written(d, "mesh.ply"),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "mesh_attribute", "name": "vertex_color"},
            },
        }
    },
    "volume": lambda _: texture("volume", volume={"type": "constvolume", "value": 0.4}),
    "blackbody": lambda _: emitter(
        "constant", radiance={"type": "blackbody", "temperature": 5000.0}
    ),
    # lights
    "area": lambda _: {"lamp": {**BALL, "emitter": {"type": "area", "radiance": RGB}}, "sky": None},
    "envmap": lambda d: emitter("envmap", filename=written(d, "image.exr")),
    "point": lambda _: emitter("point", position=[0.0, 0.0, 2.0], intensity=3.0),
    "projector": lambda d: emitter(
        "projector",
        to_world=look_at([0.0, 1.0, 3.0], [0.0, 0.0, 0.0]),
        irradiance={"type": "bitmap", "filename": written(d, "image.exr")},
        fov=60,
    ),
    "sunsky": lambda _: emitter(
        "sunsky", to_world=np.eye(4)[[0, 2, 1, 3]] * [1, 1, -1, 1], sun_aperture=5.0
    ),
    # shapes
    "blender": lambda _: shape("blender"),
    "instance": lambda _: {
        "group": {"type": "shapegroup", "ball": BALL},
        "copy": {"type": "instance", "ref": {"type": "ref", "id": "group"}},
    },
    "merge": lambda _: {"both": {"type": "merge", "a": BALL, "b": {"type": "cube"}}},
    "ply": lambda d: shape("ply", filename=written(d, "mesh.ply")),
    "sdfgrid": lambda d: shape(
        "sdfgrid", filename=written(d, "ball.vol"), to_world=translate(-0.5, -0.5, 0)
    ),
    # media
    "homogeneous": lambda _: medium(),
    "heterogeneous": lambda d: {
        "box": {
            "type": "cube",
            "bsdf": {"type": "null"},
            "to_world": scale(0.6, 0.6, 0.6),
            "interior": {
                "type": "heterogeneous",
                "albedo": 0.8,
                "sigma_t": {
                    "type": "gridvolume",
                    "filename": written(d, "grid.vol"),
                    "to_world": translate(-0.6, -0.6, -0.6) @ scale(1.2, 1.2, 1.2),
                },
                "scale": 2.0,
            },
        },
        "integrator": {"type": "volpath"},
    },
    # integrators
    "depth": lambda _: integrator("depth"),
    "direct": lambda _: integrator("direct"),
    "ptracer": lambda _: integrator("ptracer"),
    "stokes": lambda _: integrator("stokes", inner=INTEGRATOR),
    "volpath": lambda _: integrator("volpath", max_depth=4),
    "volpathmis": lambda _: {**medium(), **integrator("volpathmis", max_depth=4)},
    "direct_projective": lambda _: integrator("direct_projective"),
    "prb": lambda _: integrator("prb", max_depth=4),
    "prbvolpath": lambda _: {**medium(), **integrator("prbvolpath", max_depth=4)},
    # sensors
    "batch": lambda _: {
        "sensor": {"type": "batch", "film": FILM, "a": VIEW, "b": {**VIEW, "fov": 80}}
    },
    "distant": lambda _: {
        "sensor": {
            "type": "distant",
            "direction": [0.2, 0.1, -1.0],
            "target": [0.0, 0.0, 0.0],
            "film": {**FILM, "width": 1, "height": 1},
        }
    },
    "irradiancemeter": lambda _: {
        "sensor": None,
        "ball": {**BALL, "sensor": {"type": "irradiancemeter", "film": FILM}},
    },
    "orthographic": lambda _: sensor("orthographic"),
    "radiancemeter": lambda _: sensor("radiancemeter", film={**FILM, "width": 1, "height": 1}),
    "thinlens": lambda _: sensor("thinlens", fov=40, aperture_radius=0.2, focus_distance=4.0),
}


def scene_of(name: str, folder: Path) -> Change:
    """Return the scene of a plugin."""
    changed = {**BASE, **SCENES[name](folder)}
    return {key: part for key, part in changed.items() if part is not None}


# --- the comparison -----------------------------------------------------------------------------

SPP, LEVEL = 128, 1e-5
IMAGES, EACH = 64, 8
"""Images by Mitsuba, and samples of each pixel in each."""
REFUSED = {
    "blender": "blender",
    "ptracer": "does not sample pixel by pixel",
    "stokes": "wraps another integrator",
}
"""Plugins that are refused, though Mitsuba may render them, and what is said."""
SPECTRAL = {"blackbody"}
"""Plugins that only spectral variants can evaluate."""
NEED_FILES = {"measured"}
"""Plugins that read files of a kind that is not written here: Mitsuba's message is passed on."""
IN_PYTHON = {"direct_projective", "prb", "prbvolpath"}
"""Integrators that no scalar variant has."""


def for_mitsuba(mi: Any, part: Any) -> Any:
    """Return a scene dict with Mitsuba's transforms, and box filters as chdstat has them."""
    if isinstance(part, dict):
        found = {key: for_mitsuba(mi, value) for key, value in part.items()}
        return {**found, "rfilter": {"type": "box"}} if "rfilter" in found else found
    return mi.ScalarTransform4f(part) if isinstance(part, np.ndarray) else part


def p_value(samples: chd.Samples, images: np.ndarray) -> float:
    """Return that of equal means in all pixels (Sidak), given some images by Mitsuba.

    What one of both has not seen, the other may have: variances are those of both together.
    """
    x, y = LUMINANCE @ samples.read().astype(np.float64), images @ LUMINANCE
    variance = np.maximum(x.var(-1, ddof=1), EACH * y.var(0, ddof=1))
    error = np.sqrt(variance * (1 / SPP + 1 / (EACH * IMAGES))) + 2e-5 * abs(y.mean(0)) + 1e-9
    p = 2 * stats.norm.sf(abs((x.mean(-1) - y.mean(0)) / error).max())
    return float(-np.expm1(error.size * np.log1p(-min(p, 0.999))))


def fate(source: Any, reference: Callable[[Any], Any], backend: str, **options: Any) -> str:
    """Return what becomes of a scene: its p-value, or in which words it is refused."""
    color = options.get("color", "rgb")
    with activate(replace(probe(backend), color=color)) as mi:
        try:
            loaded = reference(mi)
            drawn = [mi.render(loaded, spp=EACH, seed=7 + i) for i in range(IMAGES)]
            images: Any = np.array([np.array(d, np.float64)[..., :3] for d in drawn])
        except (RuntimeError, ValueError) as error:
            images = error
    try:
        samples = chd.render(source, spp=SPP, backend=backend, progress=False, **options)
    except ChdstatError as error:
        return f"refused: {error}"
    assert samples.features, samples.attrs["why_no_features"]
    if isinstance(images, Exception):
        return f"not by Mitsuba: {images}"
    return f"p {p_value(samples, images):.2g}"


def fate_of(name: str, folder: Path, backend: str) -> str:
    """Return what becomes of the scene of a plugin."""
    scene = scene_of(name, folder)
    options = {"color": "spectral"} if name in SPECTRAL else {}
    return fate(scene, lambda mi: mi.load_dict(for_mitsuba(mi, scene)), backend, **options)


@pytest.mark.parametrize("name", sorted(SCENES.keys() - IN_PYTHON))
def test_the_scene_of_a_plugin_has_the_mean_of_mitsuba(name, tmp_path):
    check(name, fate_of(name, tmp_path, "scalar"))


@pytest.mark.parametrize("name", sorted(IN_PYTHON))
def test_python_integrators_need_a_wavefront(name, tmp_path, wavefront):
    assert "llvm and cuda backends only" in fate_of(name, tmp_path, "scalar")
    check(name, fate_of(name, tmp_path, wavefront))


def check(name: str, found: str) -> None:
    if name in REFUSED:
        assert found.startswith("refused"), found
        assert REFUSED[name] in found
    elif found.startswith("refused"):  # by Mitsuba, whose message is passed on
        assert name in NEED_FILES, found
        assert "Mitsuba cannot build the scene" in found
    else:
        assert float(found.removeprefix("p ")) > LEVEL, found
