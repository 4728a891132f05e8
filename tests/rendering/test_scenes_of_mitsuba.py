"""Every plugin of the installed Mitsuba, and Mitsuba's own test scenes: equal means, or refused.

For each plugin there is a small scene. The mean luminance of its 48 pixels is compared with
Mitsuba's own average of four times the samples. Seeds are fixed; with new ones, a scene differs by
chance with a probability of 1e-5 over all pixels (Sidak), more often where tails are heavy.

``pytest -n0 -s --benchmark-only tests/benchmarks/test_scenes.py`` prints the table; given a
checkout of Mitsuba's data repository, ``CHDSTAT_MITSUBA_DATA=FOLDER``, it compares its scenes.
"""

from __future__ import annotations

import struct
import zlib
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
from chdstat.scenes.plugins import own_names
from chdstat.scenes.scene import look_at, rotate, scale, translate

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


def sampler(name: str) -> Change:
    return {"sensor": {**CAMERA, "sampler": {"type": name, "sample_count": 16}}}


def filtered(name: str) -> Change:
    return {"sensor": {**CAMERA, "film": {**FILM, "rfilter": {"type": name}}}}


def shape(name: str, **settings: Any) -> Change:
    return {"thing": {"type": name, "bsdf": {"type": "diffuse", "reflectance": 0.3}, **settings}}


def spectrum(name: str, **settings: Any) -> Change:
    return {"sky": {"type": "constant", "radiance": {"type": name, **settings}}}


def integrator(name: str, **settings: Any) -> Change:
    return {"integrator": {"type": name, **settings}}


POINTS = np.array([[0, 0, 0.2], [1, 0, 0.2], [0, 1, 0.9]], np.float32)


def written(folder: Path, name: str) -> str:
    """Write a file that a plugin reads, and return its path."""
    path = folder / name
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "r", "g", "b"))
    ply = (
        f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}element face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
        + "".join(f"{x} {y} {z} {x} {y} 0.5\n" for x, y, z in POINTS)
        + "3 0 1 2\n"
    )
    texts = {
        "curve.txt": "0 0 0 0.1\n0.3 0 0.4 0.1\n0.3 0.3 0.8 0.1\n0 0.3 1 0.1\n",
        "mesh.obj": "\n".join(f"v {x} {y} {z}" for x, y, z in POINTS) + "\nf 1 2 3\n",
        "mesh.ply": ply,
    }
    if name in texts:
        path.write_text(texts[name])
    elif name == "mesh.serialized":
        body = struct.pack("<I", 0x1000) + b"mesh\0" + struct.pack("<QQ", 3, 1)
        body += POINTS.tobytes() + np.arange(3, dtype=np.uint32).tobytes()
        head = struct.pack("<HH", 0x041C, 4)
        path.write_bytes(head + zlib.compress(body) + struct.pack("<QI", 0, 1))
    elif name == "image.exr":
        import mitsuba as mi

        rng = np.random.default_rng(1)
        mi.Bitmap(rng.random((4, 8, 3), dtype=np.float32)).write(str(path))
    elif name.endswith(".vol"):
        import mitsuba as mi

        values = np.random.default_rng(1).random((4, 4, 4, 1), dtype=np.float32)
        if name == "ball.vol":  # the distance to it
            z, y, x = np.mgrid[:8, :8, :8] / 7 - 0.5
            values = (np.sqrt(x**2 + y**2 + z**2) - 0.4)[..., np.newaxis].astype(np.float32)
        if name == "six.vol":  # the upper triangle of a matrix
            values = np.broadcast_to(np.float32([0.4, 0.3, 0.2, 0, 0, 0]), (4, 4, 4, 6)).copy()
        mi.VolumeGrid(values).write(str(path))
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
    "circular": lambda _: bsdf("circular"),
    "conductor": lambda _: bsdf("conductor"),
    "dielectric": lambda _: bsdf("dielectric"),
    "diffuse": lambda _: bsdf("diffuse"),
    "hair": lambda _: bsdf("hair"),
    "mask": lambda _: bsdf("mask", opacity=0.4, inner={"type": "diffuse"}),
    "measured": lambda d: bsdf("measured", filename=str(d / "none.bsdf")),
    "measured_polarized": lambda d: bsdf("measured_polarized", filename=str(d / "none.pbsdf")),
    "normalmap": lambda d: bsdf(
        "normalmap",
        normalmap={"type": "bitmap", "filename": written(d, "image.exr"), "raw": True},
        inner={"type": "diffuse"},
    ),
    "null": lambda _: bsdf("null"),
    "plastic": lambda _: bsdf("plastic"),
    "polarizer": lambda _: bsdf("polarizer"),
    "pplastic": lambda _: bsdf("pplastic"),
    "principled": lambda _: bsdf("principled", roughness=0.4, spec_trans=0.5),
    "principledthin": lambda _: bsdf("principledthin", spec_trans=0.5),
    "retarder": lambda _: bsdf("retarder"),
    "roughconductor": lambda _: bsdf("roughconductor", alpha=0.3),
    "roughdielectric": lambda _: bsdf("roughdielectric", alpha=0.3),
    "roughplastic": lambda _: bsdf("roughplastic", alpha=0.3),
    "thindielectric": lambda _: bsdf("thindielectric"),
    "twosided": lambda _: bsdf("twosided", inner={"type": "diffuse"}),
    # textures and spectra
    "bitmap": lambda d: texture("bitmap", filename=written(d, "image.exr")),
    "checkerboard": lambda _: texture("checkerboard"),
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
    "blackbody": lambda _: spectrum("blackbody", temperature=5000.0),
    "d65": lambda _: spectrum("d65", scale=0.5),
    "irregular": lambda _: spectrum(
        "irregular", wavelengths="400, 600, 700", values="0.2, 0.5, 0.4"
    ),
    "rawconstant": lambda _: texture("rawconstant", value=0.4),
    "regular": lambda _: spectrum(
        "regular", wavelength_min=400.0, wavelength_max=700.0, values="0.2, 0.5, 0.4"
    ),
    "srgb": lambda _: texture("srgb", color=[0.3, 0.6, 0.2]),
    "uniform": lambda _: spectrum("uniform", value=0.5),
    # lights
    "area": lambda _: {"lamp": {**BALL, "emitter": {"type": "area", "radiance": RGB}}, "sky": None},
    "constant": lambda _: {},
    "directional": lambda _: emitter("directional", direction=[0.3, 0.2, -1.0]),
    "directionalarea": lambda _: {
        "lamp": {
            "type": "rectangle",
            "to_world": translate(0, 0, 2) @ rotate("x", 180) @ scale(0.5, 0.5, 0.5),
            "emitter": {"type": "directionalarea", "radiance": 2.0},
        }
    },
    "envmap": lambda d: emitter("envmap", filename=written(d, "image.exr")),
    "point": lambda _: emitter("point", position=[0.0, 0.0, 2.0], intensity=3.0),
    "projector": lambda d: emitter(
        "projector",
        to_world=look_at([0.0, 1.0, 3.0], [0.0, 0.0, 0.0]),
        irradiance={"type": "bitmap", "filename": written(d, "image.exr")},
        fov=60,
    ),
    "spot": lambda _: emitter(
        "spot", to_world=look_at([0.0, 1.0, 3.0], [0.0, 0.0, 0.0]), intensity=9.0
    ),
    "sunsky": lambda _: emitter("sunsky", to_world=rotate("x", 90), sun_aperture=5.0),
    "timed_sunsky": lambda _: emitter(
        "timed_sunsky", to_world=rotate("x", 90), sun_aperture=5.0, start_year=2025, start_month=6
    ),
    # shapes
    "blender": lambda _: shape("blender"),
    "bsplinecurve": lambda d: shape("bsplinecurve", filename=written(d, "curve.txt")),
    "linearcurve": lambda d: shape("linearcurve", filename=written(d, "curve.txt")),
    "cube": lambda _: shape("cube", to_world=scale(0.4, 0.4, 0.4)),
    "cylinder": lambda _: shape("cylinder", radius=0.3),
    "disk": lambda _: shape("disk", to_world=translate(0, 0, 0.5) @ scale(0.5, 0.5, 0.5)),
    "ellipsoids": lambda d: shape("ellipsoids", filename=str(d / "none.ply")),
    "ellipsoidsmesh": lambda d: shape("ellipsoidsmesh", filename=str(d / "none.ply")),
    "instance": lambda _: {
        "group": {"type": "shapegroup", "ball": BALL},
        "copy": {"type": "instance", "ref": {"type": "ref", "id": "group"}},
    },
    "merge": lambda _: {"both": {"type": "merge", "a": BALL, "b": {"type": "cube"}}},
    "obj": lambda d: shape("obj", filename=written(d, "mesh.obj")),
    "ply": lambda d: shape("ply", filename=written(d, "mesh.ply")),
    "rectangle": lambda _: {},
    "sdfgrid": lambda d: shape(
        "sdfgrid", filename=written(d, "ball.vol"), to_world=translate(-0.5, -0.5, 0)
    ),
    "serialized": lambda d: shape("serialized", filename=written(d, "mesh.serialized")),
    "shapegroup": lambda _: SCENES["instance"](_),
    "sphere": lambda _: {"ball": BALL},
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
    "gridvolume": lambda d: SCENES["heterogeneous"](d),
    "constvolume": lambda _: medium(albedo={"type": "constvolume", "value": 0.6}),
    "hg": lambda _: medium(phase={"type": "hg", "g": 0.6}),
    "isotropic": lambda _: medium(phase={"type": "isotropic"}),
    "rayleigh": lambda _: medium(phase={"type": "rayleigh"}),
    "sggx": lambda d: medium(
        phase={"type": "sggx", "S": {"type": "gridvolume", "filename": written(d, "six.vol")}}
    ),
    "tabphase": lambda _: medium(phase={"type": "tabphase", "values": "0.5, 1.0, 1.5"}),
    "blendphase": lambda _: medium(
        phase={"type": "blendphase", "weight": 0.3, "a": {"type": "hg"}, "b": {"type": "isotropic"}}
    ),
    # integrators
    "aov": lambda _: integrator("aov", aovs="d:depth", inner=INTEGRATOR),
    "depth": lambda _: integrator("depth"),
    "direct": lambda _: integrator("direct"),
    "moment": lambda _: integrator("moment", inner=INTEGRATOR),
    "path": lambda _: {},
    "ptracer": lambda _: integrator("ptracer"),
    "stokes": lambda _: integrator("stokes", inner=INTEGRATOR),
    "volpath": lambda _: integrator("volpath", max_depth=4),
    "volpathmis": lambda _: {**medium(), **integrator("volpathmis", max_depth=4)},
    "direct_projective": lambda _: integrator("direct_projective"),
    "prb": lambda _: integrator("prb", max_depth=4),
    "prb_basic": lambda _: integrator("prb_basic", max_depth=4),
    "prb_projective": lambda _: integrator("prb_projective", max_depth=4),
    "prbvolpath": lambda _: {**medium(), **integrator("prbvolpath", max_depth=4)},
    "volprim_rf_basic": lambda _: integrator("volprim_rf_basic"),
    # sensors, films, filters, samplers
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
    "perspective": lambda _: {},
    "radiancemeter": lambda _: sensor("radiancemeter", film={**FILM, "width": 1, "height": 1}),
    "thinlens": lambda _: sensor("thinlens", fov=40, aperture_radius=0.2, focus_distance=4.0),
    "hdrfilm": lambda _: {},
    "specfilm": lambda _: {
        "sensor": {
            **CAMERA,
            "film": {
                **FILM,
                "type": "specfilm",
                "band": {"type": "spectrum", "value": [(400, 1.0), (700, 0.5)]},
            },
        }
    },
    "box": lambda _: {},
    "catmullrom": lambda _: filtered("catmullrom"),
    "gaussian": lambda _: filtered("gaussian"),
    "lanczos": lambda _: filtered("lanczos"),
    "mitchell": lambda _: filtered("mitchell"),
    "tent": lambda _: filtered("tent"),
    "independent": lambda _: sampler("independent"),
    "stratified": lambda _: sampler("stratified"),
    "multijitter": lambda _: sampler("multijitter"),
    "orthogonal": lambda _: sampler("orthogonal"),
    "ldsampler": lambda _: sampler("ldsampler"),
}


def scene_of(name: str, folder: Path) -> Change:
    """Return the scene of a plugin."""
    changed = {**BASE, **SCENES[name](folder)}
    return {key: part for key, part in changed.items() if part is not None}


# --- the comparison -----------------------------------------------------------------------------

SPP, LEVEL = 128, 1e-5
IMAGES, EACH = 64, 8
"""Images by Mitsuba, and samples of each pixel in each."""
BT_709 = np.array([0.212671, 0.715160, 0.072169])
"""Weights of linear sRGB in luminance."""
REFUSED = {
    "blender": "blender",
    "ptracer": "does not sample pixel by pixel",
    "stokes": "wraps another integrator",
}
"""Plugins that are refused, though Mitsuba may render them, and what is said."""
REPLACED = {"specfilm"}
"""Plugins that scenes of other variants may name, since others are used in their place."""
SPECTRAL = {"blackbody", "irregular", "regular"}
"""Plugins that only spectral variants can evaluate."""
NEED_FILES = {"ellipsoids", "ellipsoidsmesh", "measured", "measured_polarized"}
"""Plugins that read files of a kind that is not written here: Mitsuba's message is passed on."""
IN_PYTHON = {
    "direct_projective",
    "prb",
    "prb_basic",
    "prb_projective",
    "prbvolpath",
    "volprim_rf_basic",
}
"""Integrators that no scalar variant has."""


def plugins() -> set[str]:
    """Return the names of the plugins of the installed Mitsuba."""
    with activate(probe("scalar")) as mi:
        return own_names(mi) - {"__init__", "__pycache__", "common"}


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
    x, y = BT_709 @ samples.read().astype(np.float64), images @ BT_709
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


def test_there_is_a_scene_for_each_plugin():
    assert plugins() <= SCENES.keys()


@pytest.mark.parametrize("name", sorted(SCENES.keys() - IN_PYTHON))
def test_the_scene_of_a_plugin_has_the_mean_of_mitsuba(name, tmp_path):
    check(name, fate_of(name, tmp_path, "scalar"))


@pytest.mark.parametrize("name", sorted(IN_PYTHON))
def test_integrators_in_python_render_with_llvm_only(name, tmp_path, llvm):
    assert "llvm and cuda backends only" in fate_of(name, tmp_path, "scalar")
    check(name, fate_of(name, tmp_path, llvm))


def check(name: str, found: str) -> None:
    if name in REFUSED:
        assert found.startswith("refused"), found
        assert REFUSED[name] in found
    elif name in REPLACED:
        assert found.startswith("not by Mitsuba"), found
    elif found.startswith("refused"):  # by Mitsuba, whose message is passed on
        assert name in NEED_FILES, found
        assert "Mitsuba cannot build the scene" in found
    else:
        assert float(found.removeprefix("p ")) > LEVEL, found
