"""What is refused: by which error, and that its sentence names what was given or expected.

Each row of the tables is a call, and what its error names. Sentences are read here alone: how long
they are, that they state what was expected or what is wrong, and that they begin and end as all
others. What is refused beside a law of its own stands with that law.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat._core.denoiser import run_network
from chdstat.comparison import error_curve
from chdstat.errors import ChdstatError, InputError, RenderError, SceneError, StoreError
from chdstat.estimators import MLP, CombinationStream
from chdstat.estimators.training import load_model, write_model
from chdstat.inference import difference, gaussianity_of_means
from chdstat.inference.references import Reference
from chdstat.io import (
    denoise,
    read_exr,
    write_estimates,
    write_exr,
    write_image,
    write_reference,
)
from chdstat.patterns import Thresholds, agreement, attribute, film_split
from chdstat.recording import DrawnPass
from chdstat.recording.cycles import CyclesSource
from chdstat.recording.luxcore import LuxCoreSource
from chdstat.render_tests.checks import verdict_on
from chdstat.render_tests.verdicts import RenderCheck
from chdstat.rendering import render_batches, render_pixels
from chdstat.rendering.backend import activate, probe, resolve
from chdstat.rendering.jobs import scene_size
from chdstat.rendering.recipes import check_integrator, load_recipe
from chdstat.rendering.seeds import max_spp
from chdstat.samples import Region
from chdstat.scenes import load_plugin, load_scene
from chdstat.summary.histograms import Histogram, StreamingHistogram
from chdstat.summary.statistics import Summary
from tests.io.writers import exr, planes_of, window
from tests.rendering.test_recipes import GOOD
from tests.rendering.test_scene_settings import box, floor
from tests.scenes.test_plugins import ESTIMATOR, INTEGRATOR

Table = dict[tuple[type[ChdstatError], Callable[..., Any]], list[tuple[Any, ...]]]
"""By error and call: what is given, as options if it is a dict, and what the error names."""


# --- rendering ----------------------------------------------------------------------------------

SKY = {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
AOV = {"type": "aov", "aovs": "d:depth"}
TWO = {**AOV, "a": {"type": "path"}, "b": {"type": "direct"}}

render = partial(
    chd.render, scene="cornell-box", out="out.zarr", backend="scalar", size=(8, 8), spp=4
)
spread = partial(render, spp=64, sampler="stratified")
pixels = partial(render_pixels, "cornell-box", spp=1, size=(8, 8))


def recipe(old: str, new: str) -> Any:
    Path("recipe.toml").write_text(GOOD.replace(old, new))
    return load_recipe("recipe.toml")


def other_recipe(old: str, new: str) -> Any:
    return check_integrator(recipe(old, new), load_scene("bathroom"))


def xml(inside: str, **parameters: Any) -> Any:
    Path("bad.xml").write_text(f"<scene version='3.0.0'>{inside}</scene>")
    return render(scene=load_scene("bad.xml", **parameters))


SENSOR = "<sensor type='perspective'/>"
MINE = "<integrator type='mine'><integrator type='path'/></integrator>"
GLOW = {"type": "constant", "radiance": {"type": "blackbody", "temperature": 5000.0}}
LIT = SKY | {"sky": GLOW, "lamp": {"type": "point", "intensity": 1.0}}
FILMS = [
    ({"width": "x"}, "width", "from 1 to 1048576", "'x'"),
    ({"height": 0}, "height", "got 0"),
    ({"width": 7.5}, "width", "7.5"),
    ({"crop_width": 40, "crop_offset_x": 20}, "40 x 32", "(20, 0)"),
    ({"crop_offset_y": -1}, "crop_offset_y", "got -1"),
]
noisy = partial(
    chd.record, lambda seed: np.random.default_rng(seed).gamma(0.5, size=(4, 4, 3)), spp=4
)


def passes_of(first: Any) -> Any:
    return chd.record(lambda _: first, spp=4)


def of_blender(**options: Any) -> Any:
    Path("room.blend").write_bytes(b"BLENDER")
    return chd.render("room.blend", **options)


def built(**options: Any) -> Any:
    """Render a scene that Mitsuba has built."""
    with activate(probe("scalar")) as mi:
        return render(scene=mi.load_dict(mi.cornell_box()), **options)


RECORDING: Table = {
    (InputError, noisy): [
        ({"spp": 0}, "spp", "got 0"),
        ({"spp": 2**30}, "spp", "1073741824"),
        ({"seed": -1}, "seed", "got -1"),
        ({"seed": 2**30}, "seed", "1073741824"),
        ({"seconds": -1}, "seconds", "got -1"),
    ],
    (InputError, chd.record): [(3, "function of a seed", "int")],
    (InputError, passes_of): [
        (None, "NoneType"),
        ("image", "str"),
        (np.zeros(4), "(4,)"),
        (np.zeros((4, 4, 3), np.uint8), "uint8"),
        ((DrawnPass(np.zeros((4, 4)), film=np.zeros((4, 4))),), "film", "(4, 4, 2)", "(4, 4)"),
        ((DrawnPass(np.zeros((4, 4)), film=np.full((4, 4, 2), 1.7)),), "0 to 1", "1.7"),
    ],
    (InputError, of_blender): [({"film": True}, "Cycles", "film")],
    (InputError, partial(CyclesSource, "room.blend")): [
        ({"layer": "Top"}, "'layer'", "view_layer"),
        ({"frame": 1.5}, "frame", "1.5"),
        ({"size": (0, 4)}, "size", "got 0"),
        ({"max_depth": 1}, "max_depth", "got 1"),
    ],
    (InputError, partial(LuxCoreSource, "room.cfg")): [
        ({"frame": 3}, "no parameters", "'frame'"),
        ({"max_depth": 1}, "max_depth", "got 1"),
    ],
    (SceneError, partial(load_scene)): [("room.usd", "room.usd")],
    (InputError, partial(render, spp=64, seconds=1.0)): [
        ({"adaptive": True}, "seconds", "adaptive"),
        ({"direct": True}, "seconds", "direct"),
    ],
}

RENDERING: Table = {
    (InputError, render): [
        ({"spp": 0}, "spp", "got 0"),
        ({"seed": -1}, "seed", "got -1"),
        ({"seed": 2**31}, "seed", "2147483648"),
        ({"size": (0, 8)}, "width", "got 0"),
        ({"size": 8}, "size", "got 8"),
        ({"size": (8, 4.5)}, "height", "4.5"),
        ({"max_depth": 0}, "max_depth", "-1", "got 0"),
        ({"spp": max_spp("scalar", 8, 8) + 1}, "spp", "8 x 8", "llvm"),
        ({"size": (100_000, 100_000), "spp": 1}, "100000 x 100000", "scalar", "llvm"),
        ({"backend": "metal"}, "backend", "auto, scalar", "'metal'"),
        ({"backend": "scaler"}, "did you mean 'scalar'"),
        ({"color": "grey"}, "color", "rgb, spectral, mono", "'grey'"),
        ({"color": "spectal"}, "did you mean 'spectral'"),
        ({"color": "mono"}, "mono", "llvm"),
        ({"sampler": "sobol"}, "sampler", "independent, stratified"),
        ({"sampler": "statified"}, "did you mean 'stratified'"),
        ({"sequence": 16}, "sequence", "16", "stratified"),
        ({"spp": 8, "adaptive": True}, "16 spp", "8"),
        ({"spp": 64, "adaptive": "relmse"}, "relMSE", "'relmse'"),
        ({"spp": 64, "error": 0.0}, "0.02", "0.0"),
        ({"spp": 64, "error": 2}, "0.02", "2"),
        ({"spp": 64, "percentile": 95}, "percentile", "error"),
        ({"spp": 64, "percentile": 100, "error": 0.1}, "percentile", "100"),
        ({"spp": 64, "percentile": 0.95, "error": 0.1}, "percentile", "0.95"),
        ({"spp": 64, "adaptive": True, "sampler": "stratified"}, "independent", "stratified"),
        ({"crop": (8, 0, 8, 8)}, "crop", "(8, 0)"),
        ({"crop": (0, 0, 0, 4)}, "crop", "width", "got 0"),
        ({"crop": (0, 0, 4)}, "crop", "(0, 0, 4)"),
        ({"crop": "abcd"}, "crop", "abcd"),
        ({"crop": (-1, 0, 2, 2)}, "crop", "x", "got -1"),
        ({"integrator": {"max_depth": 3}}, "max_depth"),
        ({"integrator": {"type": "path", "max_depth": [1]}}, "max_depth", "[1]"),
        ({"integrator": 3}, "'path'", "a int"),
        ({"scene": box(), "sensor": 2}, "sensor", "below 1", "got 2"),
        (
            {
                "scene": floor(sensor={"type": "batch", "a": {"type": "orthographic"}}),
                "crop": (0, 0, 8, 2),
            },
            "batch",
        ),
        ({"by_light": ["lihgt"]}, "did you mean 'light'"),
    ],
    (InputError, spread): [
        ({"sequence": 20}, "square", "20", "16 and 25"),
        ({"sampler": "multijitter", "sequence": 17}, "full grid", "17", "16 and 20"),
        ({"sampler": "orthogonal"}, "square of a prime", "16", "9 and 25"),
        ({"sampler": "ldsampler", "sequence": 32}, "power of 4", "32", "16 and 64"),
        ({"sampler": "ldsampler", "sequence": 4096}, "1024", "4096"),
        ({"sequence": 1}, "sequence", "1"),
        ({"spp": 2**28}, "spp", str(2**28)),
        ({"spp": 40}, "16", "40", "32 and 48"),
        ({"by_light": ["light"]}, "by_light", "'stratified'"),
        ({"direct": True}, "direct", "'stratified'"),
    ],
    (InputError, partial(render_batches, "cornell-box")): [
        ({"batch": 0}, "batch", "got 0"),
        ({"size": (10**6, 10**6), "spp": 1, "backend": "scalar"}, "1000000 x 1000000"),
    ],
    (InputError, pixels): [
        ([(8, 0)], "(y=8, x=0)", "8 x 8"),
        ([(0, 0), (0, -1)], "(y=0, x=-1)"),
        ([(0.5, 1.0)], "integers"),
        ([(1, 2, 3)], "(pixel, 2)", "(1, 3)"),
    ],
    (InputError, resolve): [("metal", "scalar, llvm, cuda", "'metal'")],
    (InputError, probe): [("metal", "'metal'")],
    (SceneError, render): [
        ({"scene": "nowhere/scene.xml"}, "'nowhere/scene.xml'"),
        ({"scene": {"shape": {"type": "sphere"}}}, "'type': 'scene'", "None"),
        ({"integrator": {"type": "path", "max_dpth": 3}}, "max_dpth"),
        ({"integrator": "pth"}, "pth", "'path'"),
        ({"integrator": "gided"}, "did you mean 'guided'"),
        ({"scene": floor(sensor={"type": "perspective", "fovv": 40})}, "fovv"),
        *(
            ({"scene": floor(**{part: {"type": "fisheye"}})}, "'fisheye'")
            for part in ("sensor", "floor", "sky", "integrator")
        ),
        *(({"scene": box(**film)}, *named) for film, *named in FILMS),
    ],
    (SceneError, lambda **film: scene_size(box(**film))): [*FILMS],
    (SceneError, scene_size): [((floor(sensor={"type": "fisheye"}),), "'fisheye'")],
    (SceneError, xml): [
        ("", "'bad'", "sensor"),
        ({"inside": SENSOR, "glitter": 1}, "glitter"),
    ],
    (SceneError, partial(load_scene, "cornell-box")): [({"glitter": 1}, "glitter")],
    (RenderError, render): [
        ({"integrator": "diffuse"}, "diffuse"),
        ({"integrator": "guided"}, "llvm and cuda"),
        ({"scene": {**box(), "sensor": {"type": "irradiancemeter"}}}, "'irradiancemeter'"),
        ({"scene": SKY | {"integrator": {"type": "direct"}}, "direct": True}, "'direct'"),
        ({"scene": SKY | {"integrator": AOV}}, "'aov'", "got 0"),
        ({"scene": SKY | {"integrator": TWO}}, "'aov'", "got 2"),
        ({"scene": LIT, "color": "spectral", "by_light": ["lamp"]}, "'sky'"),
    ],
    (RenderError, built): [({"film": True}, "film", "integrator=")],
    (RenderError, xml): [(MINE + SENSOR, "'mine'")],
    (InputError, recipe): [
        (("schema = 1", "schema = 7"), "schema", "got 7"),
        (("spp = 64", ""), "spp", "None"),
        (("[128, 96]", "[128]"), "size"),
        (("[0.5, 0.25, 0.75, 0.5]", "[0.5, 0.25, 0.5, 0.5]"), "'wall'"),
        (('"diffuse"', '"glow"'), "phenomenon", "diffuse, ", "'glow'"),
        (("schema = 1", "schema = "), "TOML"),
        (("spp = 64", "spp = true"), "spp", "True"),
        (("spp = 64", "spp = 0"), "spp", "got 0"),
        (("max_depth = 9", "max_depth = 0"), "max_depth"),
        (("max_depth = 9", "depth = 9"), "integrator.depth", "type, max_depth"),
        (("seed = 3", "seeds = 3"), "schema, ", "'seeds'"),
        (("[[regions]]", "[regions]"), "[[regions]]"),
        (('name = "wall"', ""), "regions[0].name", "None"),
        (("[[regions]]", GOOD[GOOD.index("[[regions]]") :] + "[[regions]]"), "regions"),
        (('scene = "bathroom"', 'scene = "$ATTICS/a.xml"'), "'$ATTICS/a.xml'"),
    ],
    (InputError, other_recipe): [(('"path"', '"volpath"'), "'path'", "'volpath'")],
    (InputError, load_recipe): [("none.toml", "none.toml")],
    (InputError, lambda *rectangle: Region("wall", "diffuse", rectangle)): [
        ((0, 0, 1, 1.5), "1.5"),
        ((0.5, 0, 0.5, 1), "0.5"),
        ((0, -0.1, 1, 1), "-0.1"),
        (("a", 0, 1, 1), "'a'"),
        ((0, 1), "(0, 1)"),
        ((np.nan, 0, 1, 1), "nan"),
    ],
}

# --- files --------------------------------------------------------------------------------------

BLOCK = np.ones((4, 4, 3))
written = partial(write_exr, path="out.exr", image=BLOCK)
denoised = partial(denoise, estimate=2 * BLOCK)


def content(change: Callable[[bytes], bytes]) -> Any:
    """Read a file of 64 x 64 pixels whose bytes are changed."""
    image = np.round(np.random.default_rng(0).lognormal(0, 3, size=(64, 64, 3)), 0)
    path = write_exr(Path("x.exr"), image.astype(np.float32))
    path.write_bytes(change(path.read_bytes()))
    return read_exr(path)


def claimed(whole: bytes) -> bytes:
    start = whole.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    return (
        whole[:start]
        + np.array([0, 0, 10**6 - 1, 10**6 - 1], "<i4").tobytes()
        + whole[start + 16 :]
    )


def window_of(data: Any, shown: Any = (0, 0, 13, 10)) -> Any:
    left, top, right, bottom = data
    planes = planes_of(np.ones((bottom - top + 1, right - left + 1, 3), np.float32))
    header = {"dataWindow": window(*data), "displayWindow": window(*shown)}
    return read_exr(exr("x.exr", planes, **header))


def referred(images: dict[str, Any], header: dict[str, str] | None = None, **options: Any) -> Any:
    """Write images, and read the first one as a reference."""
    paths = [
        write_image(name, image, attributes=header if name.endswith(".exr") else None)
        for name, image in images.items()
    ]
    return Reference.read(paths[0], **options)


OWN = {"chdstatReference": "1", "spp": "48"}

FILES: Table = {
    (InputError, written): [
        ({"image": np.ones((4, 4))}, "(y, x, channel)", "(4, 4)"),
        ({"image": np.ones((0, 4, 3))}, "(0, 4, 3)"),
        ({"image": np.ones((4, 4, 3), complex)}, "image", "complex"),
        ({"image": np.ones((4, 4, 2))}, "2 channels", "channels="),
        ({"channels": ("R", "G")}, "3 different names"),
        ({"channels": ("R", "G", "G")}, "3 different names"),
        ({"channels": ("a.R", "a.G", "a.B")}, "dot"),
        ({"channels": ("R", "G", "")}, "1 to 255", "''"),
        ({"extra": {"a": np.ones((4, 3))}}, "'a'", "(4, 4, 3)", "(4, 3)"),
        ({"extra": {"a": np.full((4, 4), "x")}}, "a must", "real numbers"),
        ({"extra": {"a": np.ones((4, 4, 3)), "a.G": np.ones((4, 4))}}, "'a.G'"),
        ({"extra": {"x" * 256: np.ones((4, 4))}}, "1 to 255"),
        ({"extra": {"a\0b": np.ones((4, 4))}}, "1 to 255"),
        ({"extra": {"a": np.full((4, 4), -1e39)}}, "'a'", "3.40282e+38", "1e+39"),
        ({"attributes": {"": "x"}}, "1 to 255"),
        ({"attributes": {"name": "x"}}, "'name'"),
        ({"attributes": {"spp": 32}}, "'spp'", "int"),
        ({"image": np.full((4, 4, 3), 7e4), "pixel_type": "half"}, "65504"),
        ({"pixel_type": "double"}, "float, half", "'double'"),
    ],
    (StoreError, written): [
        *(({"path": path}, path) for path in ("none/x.exr", "x.txt/x.exr", "folder"))
    ],
    (StoreError, read_exr): [
        ("x.exr", "x.exr"),
        ("folder", "no EXR file at folder"),
    ],
    (StoreError, content): [
        (lambda _: b"", "x.exr", "not an EXR file"),
        (lambda _: b"v/", "not an EXR file"),
        (lambda _: b"\x89PNG\r\n" + bytes(100), "not an EXR file"),
        *((lambda b, s=s: b[: max(4, int(s * len(b)))], "cut off") for s in (0.001, 0.3, 0.999)),
        (lambda b: b[: len(b) // 2] + bytes(64) + b[len(b) // 2 + 64 :], "damaged"),
        (claimed, "1.2e+13"),
    ],
    (StoreError, window_of): [
        (((14, 0, 27, 10),), "display window"),
        (((0, -20, 13, -1),), "display window"),
        (((0, 0, 13, 10), (0, 0, 2**20, 2**20)), "header claims"),
    ],
    (InputError, referred): [
        ({"images": {"a.exr": BLOCK, "a_var.exr": BLOCK[:3]}}, "(4, 4, 3)", "(3, 4, 3)", "a_var"),
        ({"images": {"a.exr": BLOCK, "a_var.exr": -BLOCK}}, "a_var.exr", "negative values"),
        ({"images": {"a.exr": BLOCK}, "spp": 0}, "spp", "got 0"),
        ({"images": {"a.exr": BLOCK}, "precision": 1}, "precision", "1"),
        ({"images": {"a.exr": BLOCK}, "header": OWN, "spp": 64}, "a.exr", "leave out spp"),
        (
            {
                "images": dict.fromkeys(("a-t0-b0-film-mean.pfm", "a-t0-b0-film-m2.pfm"), BLOCK)
                | {"a-t0-b0-n.pfm": BLOCK[..., :1]}
            },
            "at least 2 samples",
            "t0-b0-n.pfm",
        ),
    ],
    (StoreError, referred): [
        ({"images": {"a.exr": BLOCK}, "variance": "none.exr"}, "none.exr"),
        ({"images": {"a-t0-b0-film-mean.exr": BLOCK}}, "film-m2", "t0-b0-n.exr"),
        ({"images": {"a.exr": BLOCK}, "header": OWN | {"batches": "8"}}, "a.exr", "batchScale"),
        ({"images": {"a.exr": BLOCK}, "header": {"chdstatReference": "3"}}, "layout 3", "reads 1"),
    ],
    (StoreError, Reference.read): [
        ("none.exr", "none.exr"),
        ("none.pfm", "none.pfm"),
        ("x.txt", "x.txt", "not an EXR file"),
        ("folder", "folder", "empty"),
    ],
    (InputError, partial(write_reference, Reference(BLOCK))): [("out.png", ".exr", "out.png")],
    (InputError, write_reference): [((Reference(1e39 * BLOCK), "out.exr"), "3.40282e+38")],
    (InputError, denoised): [
        ({"estimate": np.ones((4, 4))}, "(4, 4)"),
        ({"estimate": np.ones((4, 4, 2))}, "1 or 3", "(4, 4, 2)"),
        ({"estimate": np.ones((0, 4, 3))}, "(0, 4, 3)"),
        ({"estimate": np.ones((4, 4, 3), complex)}, "real numbers"),
        ({"hdr": False}, "display values"),
        ({"normal": np.zeros((4, 4, 3))}, "albedo"),
        ({"albedo": np.zeros((4, 4))}, "albedo", "(4, 4, 3)"),
        ({"albedo": np.full((4, 4, 3), -2.0)}, "albedo", "0.0 and inf"),
        ({"albedo": np.zeros((4, 4, 3)), "normal": np.full((4, 4, 3), -2.0)}, "normal"),
        ({"certainty": np.zeros((4, 3))}, "certainty", "shape"),
        ({"certainty": np.full((4, 4), 1.5)}, "certainty", "1"),
        ({"certainty": np.full((4, 4), np.nan)}, "certainty", "1"),
    ],
    (ChdstatError, lambda **images: run_network(images, hdr=True)): [
        (
            {"color": np.ones((32, 32, 3), np.float32), "albedo": np.ones((8, 8, 3), np.float32)},
            "(32, 32, 3)",
            "size",
        )
    ],
}

# --- samples ------------------------------------------------------------------------------------

SAMPLES = chd.Samples.from_array(np.ones((5, 6, 3, 8)))
DIMS = ("y", "x", "channel", "sample")


array = partial(chd.Samples.from_array, array=np.ones((4, 6, 3, 32)))


def beyond(value: float) -> Any:
    x = np.ones((4, 6, 3, 32))
    x[1, 2, 0, 3] = value
    return x


def opened(name: Any) -> Any:
    Path("radiance").mkdir()
    return chd.open(name)


IN_ROOM: Table = {
    (InputError, array): [
        ({"film": np.zeros((4, 6, 32))}, "film", "(4, 6, 2, 32)", "(4, 6, 32)"),
        ({"film": np.full((4, 6, 2, 32), -0.5)}, "film", "0 to 1", "-0.5"),
        ({"film": np.full((4, 6, 2, 32), "x")}, "film", "numbers"),
        *(({"axes": axes}, "axes", "once") for axes in ("yxc", "yxss", "yxcz", "", "YXCS", 3)),
        ({"array": np.ones((4, 6, 3, 2))}, "'yxcs'"),
        ({"array": np.ones((4, 6, 31, 64))}, "'yxcs'"),
        ({"array": np.ones((4, 6, 3))}, "image"),
        ({"array": xr.DataArray(np.ones((4, 6, 3, 32)))}, "'sample'"),
        (
            {"array": xr.DataArray(np.ones((4, 6, 3, 32)), dims=("time", "y", "x", "sample"))},
            "y, x, sample",
        ),
        ({"array": xr.DataArray(np.ones((4, 6, 3, 32)), dims=DIMS), "axes": "yxcs"}, "axes='yxcs'"),
        ({"features": {"depth": np.ones((6, 4), np.float32)}}, "depth", "(4, 6)"),
        ({"features": {"counts": np.ones((4, 6), np.float32)}}, "counts="),
        ({"features": {"costs": np.ones((4, 6), np.float32)}}, "seconds="),
        ({"seconds": np.ones((6, 4))}, "(4, 6)", "(6, 4)"),
        ({"seconds": -np.ones((4, 6))}, "below 0", "-1"),
        ({"direct": np.ones((4, 6, 3, 16))}, "(4, 6, 3, 32)"),
        *(({"array": beyond(value)}, f"{value:g}") for value in (1e-50, -1e-50, 1e39, -1e39)),
        *(({"direct": beyond(value)}, "direct", f"{value:g}") for value in (1e-50, -1e39)),
        ({"counts": np.full((4, 6), 33)}, "0 to 32"),
        ({"counts": np.full((4, 6), -1)}, "0 to 32"),
        ({"counts": np.ones((4, 6))}, "whole numbers"),
        ({"counts": np.ones((6, 4), int)}, "(4, 6)"),
        ({"averaged": 0}, "averaged", "got 0"),
        ({"averaged": "x"}, "averaged", "'x'"),
        ({"sequence": 2.5}, "sequence", "2.5"),
        ({"integrator": 5}, "integrator", "dict", "got 5"),
        ({"render_seconds": "long"}, "render_seconds", "float", "'long'"),
    ],
    (InputError, SAMPLES.isel): [
        ({"y": slice(5, 5)}, "y", "forward"),
        ({"x": 6}, "x", "-6 to 5", "got 6"),
        ({"y": -6}, "y", "-5 to 4", "got -6"),
        ({"sample": slice(None, None, -1)}, "sample", "forward"),
    ],
    (InputError, SAMPLES.__getitem__): [
        (((5, 0),), "y", "-5 to 4", "got 5"),
        (((0, -7),), "x", "-6 to 5", "got -7"),
        *((index, "(y, x)") for index in (0, ((0, 1, 2),), ..., ((0.5, 1),))),
    ],
    (InputError, SAMPLES.pixel): [((6, 0), "y", "-5 to 4", "got 6")],
    (InputError, SAMPLES.save): [("out.exr", "out.zarr", "out.exr", "images")],
    (InputError, opened): [
        (None, "path", "None"),
        (5, "path", "5"),
        ("a\0b", "path", "a\\x00b"),
        ((["a.zarr"],), "path", "['a.zarr']"),
        ("tape://box.zarr", "tape://box.zarr"),
    ],
    (StoreError, opened): [
        ("nowhere", "nowhere", "chdstat render"),
        ("x" * 300, "no store at xxx"),
        ("x.txt", "x.txt", "folder"),
        (".", "zarr.json"),
        ("maps.zarr", "maps.zarr", "--maps"),
        ("memory://nothing/here.zarr", "memory://nothing/here.zarr"),
    ],
    (StoreError, SAMPLES.save): [("http://127.0.0.1:9/own.zarr", "http://127.0.0.1:9", "read")],
}

# --- scenes and plugins -------------------------------------------------------------------------


def scene(**parts: Any) -> Any:
    return load_scene({"type": "scene", "sensor": {"type": "perspective"}, **parts}).load()


def plugin(code: str) -> Any:
    Path("mine.py").write_text(code)
    return load_plugin("mine.py")


LOOP: dict[str, Any] = {"type": "scene"}
LOOP["again"] = LOOP

SCENES: Table = {
    (InputError, plugin): [
        ("x = 1\ny = 1 / 0\n", "mine.py, line 2", "ZeroDivisionError"),
        ("x = 1\n\ndef f(:\n", "mine.py, line 3", "SyntaxError"),
        ("import no_such_module", "mine.py, line 1", "no_such_module"),
        ("raise SystemExit", "mine.py, line 1", "SystemExit"),
        ("x = 1", "mine.py", "registers nothing"),
        (INTEGRATOR.replace('"constant_radiance"', '"path"'), "'path'"),
        (ESTIMATOR.replace("largest_of_mine", "mean"), "'mean'"),
    ],
    (InputError, load_plugin): [*((name, "plugin") for name in ("no_such.py", ".", "\0"))],
    (InputError, load_scene): [(5, "int")],
    (SceneError, scene): [
        ({"ball": {"type": "sphere", "bsdf": {"type": "no-such-material"}}}, "no-such-material"),
        ({"ball": {"type": "sphere", "bsdf": None}}, "'bsdf'"),
        ({"m": {"type": "mesh", "vertices": np.zeros((3, 3))}}, "'m'", "faces"),
        ({"ball": {"type": "sphere", "bsdf": {"type": "difuse"}}}, "'ball.bsdf'", "'diffuse'"),
    ],
    (SceneError, lambda part: load_scene({"type": "scene", "ball": part}).hash): [
        (object(), "object")
    ],
    (SceneError, render): [({"scene": LOOP}, "itself")],
}

# --- statistics ---------------------------------------------------------------------------------

MEANS = partial(gaussianity_of_means, np.ones(64))
LINEAR = chd.histogram(chd.Samples.from_array(np.ones((2, 2, 1, 64))), scale="linear")
FIVE_CHANNELS = chd.Samples.from_array(np.ones((8, 8, 5, 64)), axes="yxcs")
TWO_CHANNELS = chd.Samples.from_array(np.ones((2, 2, 2, 64)))
TIMED = chd.Samples.from_array(np.ones((4, 4, 3, 48)), render_seconds=4.8)
FOUR = chd.Samples.from_array(np.random.default_rng(0).gamma(2.0, size=(2, 2, 3, 64)))
FALLEN, DEPENDENT = (
    chd.Samples.from_array(FOUR, film=np.random.default_rng(1).random((2, 2, 2, 64)), **about)
    for about in ({}, {"sequence": 16})
)
UP = np.arange(1.0, 30)


def stream(*batches: Any, **options: Any) -> StreamingHistogram:
    found = StreamingHistogram(**options)
    for batch in batches:
        found.update(batch)
    return found


def summary(*batches: Any, **options: Any) -> Summary:
    found = Summary(**options)
    for batch in batches:
        found.update(batch)
    return found


STATISTICS: Table = {
    (InputError, partial(chd.gaussianity, [1.0, 2.0])): [
        ({"transform": "cube"}, "transform", "log, linear, sqrt", "'cube'"),
        ({"test": "shapiro"}, "test", "'shapiro'"),
        ({"test": ("dagostino", "dagostino")}, "several different"),
        ({"transform": ()}, "several different"),
        ({"alpha": 5}, "alpha", "got 5"),
    ],
    (InputError, gaussianity_of_means): [(np.ones(16), "spp")],
    (InputError, MEANS): [
        ({"n_means": 4}, "n_means", "at least 8", "got 4"),
        ({"n_means": 8, "test": "dagostino"}, "n_means", "at least 20", "got 8"),
        ({"test": "shapiro"}, "test", "anderson-darling, shapiro-wilk", "'shapiro'"),
        ({"alpha": 0}, "alpha", "got 0"),
    ],
    (InputError, partial(chd.contrast, TIMED)): [
        (np.ones((6, 6, 3, 48)), "4 x 4", "6 x 6"),
        (np.ones((4, 4, 1, 48)), "channels"),
        ({"b": TIMED, "alpha": 1.5}, "alpha", "1.5"),
        ({"b": TIMED, "seconds": 9}, "9.00 s", "90", "48"),
        ({"b": TIMED, "seconds": 0.01}, "seconds"),
        ({"b": TIMED, "seconds": -1}, "seconds", "above 0"),
        ({"b": np.ones((4, 4, 3, 48)), "seconds": 1}, "B"),
    ],
    (InputError, Reference): [
        (np.ones((4, 4)), "(y, x, channel)", "(4, 4)"),
        ((np.ones((4, 4, 3)), np.ones((4, 4, 1))), "shape", "(4, 4, 1)"),
        ({"mean": np.ones((4, 4, 3)), "spp": 0}, "spp", "got 0"),
        ({"mean": np.ones((4, 4, 3)), "precision": 1.0}, "precision", "1"),
        ({"mean": np.ones((4, 4, 3)), "bad": np.zeros((4, 3))}, "bad", "(4, 4)", "(4, 3)"),
        ({"mean": np.ones((4, 4, 3)), "spp": 16, "batches": np.ones((4, 4, 3, 4))}, "8 batches"),
        ({"mean": np.ones((4, 4, 3)), "spp": 9, "batches": np.ones((4, 4, 3, 8))}, "multiple"),
    ],
    (InputError, difference): [
        ((SAMPLES, SAMPLES[:2, :]), "pixels"),
        ((SAMPLES, np.ones((5, 6, 3, 8))), "one of each"),
        ((np.ones((4, 3, 8)), np.ones((4, 1, 8))), "channels"),
        ({"a": np.ones((3, 8)), "b": np.ones((3, 5)), "paired": True}, "8 and 5"),
        ({"a": np.ones((3, 8)), "b": np.ones((3, 8)), "replicates": 0}, "replicates", "got 0"),
        ({"a": np.ones((3, 8)), "b": np.ones((3, 8)), "replicates": 9.5}, "replicates", "9.5"),
    ],
    (InputError, partial(chd.fit.goodness, np.ones(100))): [
        ("normal", "normal"),
        (chd.fit.select(np.ones(100)), "gamma, lognormal", "'Selection'"),
        ({"fit": "gamma", "tests": ("lilliefors",)}, "'lilliefors'"),
        ({"fit": "gamma", "tests": "chi-square"}, "chi-square"),
        ({"fit": "gamma", "resamples": -1}, "resamples", "got -1"),
        ({"fit": "gamma", "resamples": 9.5}, "resamples", "9.5"),
        ({"fit": "gamma", "seed": -1}, "seed", "got -1"),
        ({"fit": "gamma", "alpha": 2}, "alpha", "2"),
    ],
    (InputError, partial(chd.fit.mixture, UP)): [
        ({"family": "weibull"}, "lognormal, gamma", "'weibull'"),
        ({"effort": "much"}, "effort", "'much'"),
        (0, "k", "1 to 8", "0"),
        (9, "k", "1 to 8", "9"),
        (2.5, "k", "1 to 8", "2.5"),
        ({"max_k": 0}, "max_k", "0"),
    ],
    (InputError, partial(chd.fit.fit, UP)): [("cauchy", "gamma, lognormal", "'cauchy'")],
    (InputError, partial(chd.fit.gamma, [1.0, 2.0])): [({"null": [True] * 3}, "broadcastable")],
    (InputError, partial(chd.fit.gamma, chd.histogram(UP))): [({"null": [False]}, "null")],
    (InputError, partial(chd.fit.select, [1.0, 2.0])): [
        ({"criterion": "r2"}, "criterion", "'r2'"),
        ({"families": "gamma"}, "families"),
    ],
    (InputError, partial(chd.fit.select, chd.histogram(UP))): [({"held_out": True}, "samples")],
    (InputError, partial(chd.fit.tail_index, np.ones(300))): [
        ({"share": 1.5}, "share", "1.5"),
        ({"share": "all"}, "share", "'all'"),
        ({"tested": -1}, "tested", "-1"),
        ({"level": 1.0}, "level", "1"),
    ],
    (InputError, partial(chd.histogram, [[1.0, 2.0], [3.0, 4.0]])): [
        ({"scale": "sqrt"}, "scale", "'sqrt'"),
        ({"bins": 0}, "bins", "0"),
        ({"support": (2, 1)}, "low < high"),
        ({"support": (0, 1)}, "0 < low"),
        ({"support": (np.nan, 1)}, "finite"),
        ({"support": ([1, 2, 3], 4)}, "batch shape"),
        ({"null": np.array([True, False])}, "exactly 0"),
        ({"bad": np.array([True, False, False])}, "(2, 2)", "(3,)"),
    ],
    (InputError, partial(chd.histogram, SAMPLES)): [({"null": np.zeros(8, bool)}, "null")],
    (InputError, Histogram.of_dataset): [(LINEAR, "log_counts")],
    (InputError, chd.fit.gamma): [(chd.histogram([1.0, 2.0], scale="linear"), "linear")],
    (InputError, StreamingHistogram.merge): [
        ((stream([1.0, 2.0], scale="linear"), stream([1.0, 3.0], scale="linear")), "support"),
        ((stream(scale="linear", support=(0, 9)), stream([1.0, 2.0], scale="linear")), "support"),
        ((stream([1.0, 2.0], scale="linear"), stream(scale="log")), "bins"),
    ],
    (InputError, stream): [(([1.0, 2.0], [[1.0, 2.0], [3.0, 4.0]]), "batch shape")],
    (InputError, lambda made: made().read()): [
        (StreamingHistogram, "update"),
        (Summary, "update"),
    ],
    (InputError, summary): [
        ({"batch_size": 0}, "batch_size", "0"),
        ({"max_batches": 7}, "max_batches", "7"),
        ([1.0, 2.0], "channel"),
        ((np.ones((3, 4)), np.ones((1, 4))), "shape"),
    ],
    (InputError, Summary.merge): [
        ((summary(np.ones((3, 4))), summary(np.ones((1, 4)))), "shape"),
        ((summary(np.ones((3, 4))), summary(2 * np.ones((3, 4)))), "support"),
        ((Summary(), summary(np.ones((3, 4)), batch_size=9)), "batch_size"),
    ],
    (InputError, partial(chd.summarize, SAMPLES)): [({"max_batches": 1}, "max_batches", "1")],
    (InputError, partial(chd.atlas, SAMPLES)): [
        ({"clusters": 0}, "clusters", "got 0"),
        ({"max_clusters": 0}, "max_clusters", "got 0"),
        ({"min_share": 1.0}, "min_share", "1.0"),
    ],
    (InputError, partial(chd.atlas, FOUR)): [({"clusters": 5}, "5 clusters", "got 4")],
    (InputError, chd.atlas): [
        (({},), "dict"),
        (LINEAR, "log_counts"),
        (TWO_CHANNELS, "1 or 3"),
    ],
    (InputError, Thresholds): [
        ({"alpha": 2}, "alpha", "2"),
        ({"misfit": -1}, "misfit", "-1"),
    ],
    (InputError, chd.classify): [
        (np.ones(30), "channel, sample"),
        (np.ones((2, 30)), "1 or 3 channels", "2"),
    ],
    (InputError, agreement): [(np.zeros(4, int), "shape")],
    (InputError, attribute): [(np.ones((2, 2, 3, 8)), "--by-depth")],
    (InputError, partial(film_split, progress=False)): [
        (FOUR, "film=True", "--film"),
        ({"samples": FALLEN, "cells": 3}, "2, 4, 8, 16", "3"),
        ({"samples": FALLEN, "cells": 8}, "128 samples", "64"),
        (DEPENDENT, "sequence_means"),
    ],
    (InputError, SAMPLES.regions): [(({},), "at least one region")],
    (InputError, partial(render, scene="bathroom")): [
        ({"by_light": ["lamp"]}, "'lamp'", "sky, sun"),
        ({"by_light": ["s*", "sun"]}, "several groups"),
    ],
}

# --- estimators and comparisons -----------------------------------------------------------------

PLAIN = chd.Samples.from_array(np.random.default_rng(0).gamma(0.7, size=(12, 10, 3, 160)))
TRUTH = {"a": PLAIN.read().mean(axis=-1)}


def benched(**change: Any) -> Any:
    given = {"scenes": {"a": PLAIN}, "estimators": ["mean"], "spp": [16], "progress": False}
    return chd.bench(**given | change)


def saved(about: Any) -> Any:
    return load_model(write_model(Path("model"), {"a": np.zeros(3)}, about) or "model")


ESTIMATORS: Table = {
    (InputError, partial(chd.compare, PLAIN)): [
        (["mean", "mean"], "different names"),
        ([], "different names"),
        (["men"], "'men'"),
        (["men + OIDN"], "'men'"),
        ([np.mean], "names"),
        (["mean + OIDN features"], "albedo"),
        ({"estimators": ["median_of_means"], "n": 8}, "at least 11", "n=8"),
        ({"estimators": ["median_of_means + OIDN"], "n": 8}, "at least 11"),
        ({"estimators": ["elek2019"], "n": 16}, "exactly 32", "n=16"),
        ({"estimators": ["mean"], "n": 81}, "162", "160"),
        ({"estimators": ["mean"], "n": 0}, "n must", "0"),
        ({"estimators": ["mean"], "max_batches": 0}, "max_batches", "0"),
        ({"estimators": ["mean"], "labels": "patterns"}, "'classify'", "'patterns'"),
        ({"estimators": ["mean"], "labels": np.zeros((3, 3), int)}, "(12, 10)", "(3, 3)"),
        ({"estimators": ["mean"], "labels": np.zeros((12, 10))}, "integers"),
        ({"estimators": ["mean"], "labels": np.full((12, 10), 99)}, "[99]"),
        ({"estimators": ["mean"], "labels": LINEAR}, "'label'"),
    ],
    (InputError, partial(error_curve, PLAIN)): [
        ("mean", "names", "'mean'"),
        ({"estimators": [np.mean], "sizes": [8]}, "names"),
        ({"estimators": ["mean"], "sizes": []}, "different numbers"),
        ({"estimators": ["mean"], "sizes": [4, 4]}, "different numbers"),
        ({"estimators": ["mean"], "sizes": [0, 4]}, "size", "got 0"),
        ({"estimators": ["mean"], "sizes": [4.5]}, "size", "4.5"),
        ({"estimators": ["mean"], "sizes": 8}, "sizes", "got 8"),
        ({"estimators": ["mean"], "sizes": [4, 81]}, "162", "160"),
        ({"estimators": ["mean"], "max_batches": 0}, "max_batches", "0"),
        ({"estimators": ["median_of_means"], "sizes": [4, 8]}, "at least 11", "(4, 8)"),
        ({"estimators": ["elek2019"], "sizes": [4]}, "exactly 32", "n=4"),
    ],
    (InputError, benched): [
        ({"estimators": ["elek2019"], "spp": [32]}, "reference"),
        ({"estimators": ["nonsense"]}, "'nonsense'"),
        ({"baseline": "median"}, "baseline", "mean"),
        ({"images": {"mean": {}}}, "different names"),
        ({"spp": [512], "references": TRUTH}, "160"),
        ({"spp": [140]}, "too few"),
        ({"scenes": []}, "none"),
        ({"references": {"a": TRUTH["a"][:4]}}, "(4, 10, 3)"),
    ],
    (InputError, chd.estimate): [
        *((np.ones(shape), "1 or 3", "4") for shape in ((8, 8, 3, 3), (8, 8, 2, 16)))
    ],
    (InputError, lambda shape: CombinationStream(shape).estimate()): [(((4, 4, 3),), "at least 4")],
    (InputError, chd.estimators.zirr2018_pixel): [(np.ones((2, 8)), "1 or 3", "2")],
    (InputError, chd.estimators.lookup): [("men", "'men'", "mean")],
    (InputError, lambda film: chd.estimators.sakai2025(np.ones((3, 3, 3, 8)), film=film)): [
        (np.zeros((3, 3, 8)), "(3, 3, 2, 8)", "(3, 3, 8)"),
        (np.zeros((3, 3, 2, 4)), "(3, 3, 2, 4)"),
    ],
    (InputError, partial(chd.estimators.train_model, PLAIN)): [
        ("mean", "mean", "elek2019"),
        ("nobody", "'nobody'"),
        *(({"spp": spp}, "1 to 160", str(spp)) for spp in (0, 161, -1)),
    ],
    (InputError, MLP.preset("elek2019").train): [
        (PLAIN.isel(sample=slice(63)), "64", "63"),
        (chd.Samples.from_array(np.ones((1, 1, 3, 64))), "at least 2 batches"),
        ({"samples": PLAIN, "iterations": 0}, "iterations", "0"),
        ({"samples": PLAIN, "pixels": [[0.5, 0]]}, "integer"),
        ({"samples": PLAIN, "pixels": [[0, 24]]}, "10 x 12"),
        ({"samples": PLAIN, "pixels": [0, 1]}, "integer"),
    ],
    (InputError, MLP.preset("elek2019").predict): [(np.ones(32), "train")],
    (InputError, MLP.preset): [("elek", "elek2019", "'elek'")],
    (StoreError, saved): [
        ({"about": {"kind": "other"}}, "'other'", "'mlp'"),
        ({"about": []}, "None", "'mlp'"),
        ({"about": {"kind": ["mlp"]}}, "['mlp']", "'mlp'"),
    ],
    (InputError, partial(write_estimates, "out.exr", PLAIN)): [
        ({"level": 1.0}, "level", "1"),
        ({"spp": 161}, "spp", "1 to 160", "161"),
        ({"spp": 2}, "at least 4"),
        ({"seconds": 1}, "rendering"),
    ],
    (InputError, partial(write_estimates, samples=PLAIN)): [
        ("out.jpg", ".exr, .npy, .pfm, .png"),
        ("nowhere/out.exr", "nowhere"),
        ("folder", ".exr"),
    ],
    (StoreError, partial(write_estimates, "out.exr", PLAIN)): [("nowhere.safetensors", "nowhere")],
}

# --- figures and reports ------------------------------------------------------------------------

REPORTS: Table = {
    (InputError, partial(chd.report, path="out.pdf")): [
        ({"source": FIVE_CHANNELS}, "one or three")
    ],
    (InputError, partial(chd.report, SAMPLES)): [
        ("out.html", ".pdf"),
        ({"path": "out.pdf", "contents": "long"}, "short, full, claims", "'long'"),
        ("nowhere/out.pdf", "nowhere"),
    ],
    (InputError, partial(chd.study, folder=None)): [
        ([], "at least one scene"),
        (["cornell-box", "cornell-box"], "'cornell-box'"),
        ({"scenes": "cornell-box", "estimators": ["elek2020"]}, "'elek2020'"),
        ({"scenes": "cornell-box", "sampler": "sobol"}, "sampler", "'sobol'"),
        ({"scenes": PLAIN, "sampler": "multijitter", "estimators": ["mean"]}, "sampler"),
    ],
    (InputError, chd.studies.paper): [
        ({"changed": ["tagets"]}, "'tagets'", "targets"),
        ({"only": ["Kitchen"]}, "'Kitchen'", "Bathroom"),
        ({"spp": 32}, "at least 64", "32"),
        ({"edge": 0}, "edge", "0"),
        ({"scenes": "nowhere"}, "one of the paper's scenes", "nowhere/bathroom/scene.xml"),
    ],
    (SceneError, partial(chd.study, folder=None)): [("cornel-box", "did you mean 'cornell-box'")],
    (StoreError, partial(chd.study, "cornell-box", size=(4, 4), spp=64)): [
        ({"folder": "x.txt"}, "x.txt")
    ],
}

# --- render tests -------------------------------------------------------------------------------


def answered(render: Any = PLAIN, spp: int | None = None, **asked: Any) -> Any:
    """Ask whether a render has the light of a reference."""
    about = {"name": "box", "reference": Path("box.exr"), "page": "box", "test": "t", "alpha": 0.01}
    return verdict_on(render, RenderCheck(**{**about, "spp": spp, **asked}))


RENDER_TESTS: Table = {
    (StoreError, answered): [({}, "no reference", "box.exr", "pytest --render-update")],
    (InputError, answered): [
        ({"seed": -1}, "seed", "0", "-1"),
        ({"spp": 0}, "spp", "1", "0"),
        ({"finds": 1.5}, "finds", "1.5"),
        ({"render": np.ones((4, 4, 3))}, "shape (4, 4, 3)", "function of a seed"),
        ({"render": []}, "no pass"),
        ({"render": [np.ones((4, 4, 3)), np.ones((4, 5, 3))]}, "(4, 5, 3, 1)"),
    ],
    (InputError, partial(answered, update=True)): [
        ({"spp": 4}, "spp=4", "functions and scenes"),
        (lambda _: np.ones((4, 4, 3)), "box", "spp="),
        ((lambda _: np.ones((4, 4, 3), int), 4), "whole numbers", "int64"),
        ((lambda _: np.ones((4, 4)), 4), "(y, x, channel)", "(4, 4)"),
        ((lambda _: [[1.0], [1.0, 2.0]], 4), "no array"),
        ((lambda seed: np.ones((4, 4 + seed % 2, 3)), 4), "another seed"),
        ((lambda _: np.ones((3, 64, 64)), 4), "(3, 64, 64)", "(y, x, channel)"),
    ],
    (SceneError, answered): [("cornel-box", "did you mean 'cornell-box'")],
}


# --- the sentences ------------------------------------------------------------------------------

TABLES = {
    "recording": RECORDING,
    "rendering": RENDERING,
    "files": FILES,
    "samples": IN_ROOM,
    "scenes": SCENES,
    "statistics": STATISTICS,
    "estimators": ESTIMATORS,
    "reports": REPORTS,
    "render tests": RENDER_TESTS,
}
STATES = re.compile(
    r"\b(must|expected|needs?|cannot|can|not?|none|only|got|outside|takes?|holds?|has|is|are|names|failed)\b"
)
"""Words that say what was expected, or what is wrong; else, behind a semicolon, what to do."""


@pytest.mark.parametrize(
    ("error", "call", "given", "named"),
    [
        pytest.param(error, call, given, named, id=f"{table}: {', '.join(named)[:40]}")
        for table, refused in TABLES.items()
        for (error, call), rows in refused.items()
        for given, *named in rows
    ],
)
def test_a_refusal_names_what_was_given(tmp_path, monkeypatch, error, call, given, named):
    """What was asked for and what was expected, in one sentence; and nothing is left behind."""
    options = given if isinstance(given, dict) else {}
    given = () if isinstance(given, dict) else given if isinstance(given, tuple) else (given,)
    (tmp_path / "x.txt").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "maps.zarr").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error) as refused:
        call(*given, **options)
    said = str(refused.value)
    assert [word for word in named if word not in said] == [], said
    assert 12 < len(said) < 700
    assert STATES.search(said) or "; " in said, said
    assert not said[0].isspace()
    assert not said.endswith((".", " ", "\n"))
    assert not list(tmp_path.glob("out*"))
