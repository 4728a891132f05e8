"""Render two scenes with Mitsuba, Cycles and LuxCore, and compare the distributions of samples.

    python tools/three_renderers.py FOLDER

Each scene is described once, in plain data, and written for each renderer into FOLDER, with its
samples (`RUNS`). What the comparisons find (`PAIRS`) goes to ``docs/understand/renderers.npz``,
from which a page of the documentation is drawn, together with the recipe and its digest. All paths
have at most `DEPTH` segments, and pixels a box filter.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

RESULTS = Path(__file__).parents[1] / "docs" / "understand" / "renderers.npz"
DEPTH = 8
SIZE = 32
SPP = 512
NEVER = 1000
"""Segments before Russian roulette begins, if it never shall."""
Triple = tuple[float, float, float]
BLACK: Triple = (0.0, 0.0, 0.0)


# --- scenes as plain data -------------------------------------------------------------------------


@dataclass(frozen=True)
class Surface:
    """What all three renderers express alike: "diffuse", an ideal "mirror", smooth "glass"."""

    kind: str
    color: Triple = (1.0, 1.0, 1.0)
    radiance: Triple = BLACK
    """Of the front, to which normals point: corners run counterclockwise there."""


@dataclass(frozen=True)
class Mesh:
    """Triangles of one surface."""

    vertices: list[list[float]]
    faces: list[list[int]]
    surface: str


@dataclass(frozen=True)
class View:
    """A scene and its camera. The sky is a constant environment; the angle is that of the width."""

    name: str
    surfaces: dict[str, Surface]
    meshes: dict[str, Mesh]
    origin: Triple
    target: Triple
    up: Triple
    angle: float
    sky: Triple = BLACK


def _quad(surface: str, *corners: Triple) -> Mesh:
    return Mesh([[*corner] for corner in corners], [[0, 1, 2], [0, 2, 3]], surface)


def cornell_box() -> View:
    """Return the built-in scene: one lamp, diffuse surfaces."""
    import chdstat.scenes

    folder = Path(chdstat.scenes.__file__).parent / "builtin"
    scene = json.loads((folder / "cornell-box.json").read_text("utf-8"))
    arrays = np.load(folder / "arrays.npz")
    surfaces, meshes = {}, {}
    for name, shape in scene.items():
        if not isinstance(shape, dict) or "bsdf" not in shape:
            continue
        color = tuple(shape["bsdf"]["reflectance"]["value"])
        light = shape.get("emitter", {"radiance": {"value": BLACK}})["radiance"]["value"]
        surfaces[name] = Surface("diffuse", color, tuple(light))
        if shape["type"] == "mesh":
            held = (arrays[f"{shape['data']}.{part}"].tolist() for part in ("vertices", "faces"))
            meshes[name] = Mesh(*held, name)
        else:
            unit = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]])
            corners = (np.array(shape["to_world"]) @ unit.T).T[:, :3]
            meshes[name] = _quad(name, *map(tuple, corners.tolist()))
    axes = np.array(scene["sensor"]["to_world"])
    origin = axes[:3, 3]
    places = (tuple(x.tolist()) for x in (origin, origin + axes[:3, 2], axes[:3, 1]))
    return View("cornell-box", surfaces, meshes, *places, scene["sensor"]["fov"])


def _box(surface: str, low: Triple, high: Triple) -> Mesh:
    corners = [
        [x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])
    ]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(corners, [[*t] for a, b, c, d in sides for t in ((a, b, c), (a, c, d))], surface)


def _ball(surface: str, center: Triple, radius: float, rings: int = 32) -> Mesh:
    """Return a sphere of flat triangles, which are the same to all renderers."""
    polar, around = np.pi * np.arange(rings + 1) / rings, np.pi * np.arange(2 * rings) / rings
    z, turn = np.repeat(np.cos(polar), 2 * rings), np.tile(around, rings + 1)
    flat = np.repeat(np.sin(polar), 2 * rings)
    points = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1) * radius + center
    faces = []
    for ring in range(rings):
        for i in range(2 * rings):
            a, b = ring * 2 * rings + i, ring * 2 * rings + (i + 1) % (2 * rings)
            c, d = a + 2 * rings, b + 2 * rings
            faces += [[a, c, d]] * (ring < rings - 1) + [[a, d, b]] * (ring > 0)
    return Mesh(points.tolist(), faces, surface)


def room() -> View:
    """Return a room with a lamp, a window to a constant sky, a mirror and a ball of glass."""
    w, d, h = 4.0, 5.0, 2.6
    left, right, sill, top = 2.2, 3.8, 0.9, 2.1
    surfaces = {
        "wall": Surface("diffuse", (0.7, 0.68, 0.62)),
        "floor": Surface("diffuse", (0.35, 0.22, 0.13)),
        "red": Surface("diffuse", (0.6, 0.12, 0.1)),
        "table": Surface("diffuse", (0.25, 0.3, 0.45)),
        "mirror": Surface("mirror", (0.9, 0.9, 0.9)),
        "glass": Surface("glass"),
        "lamp": Surface("diffuse", (0.5, 0.5, 0.5), (9.0, 8.0, 6.5)),
    }
    meshes = {
        "floor": _quad("floor", (0, 0, 0), (w, 0, 0), (w, d, 0), (0, d, 0)),
        "ceiling": _quad("wall", (0, 0, h), (0, d, h), (w, d, h), (w, 0, h)),
        "back": _quad("wall", (0, d, 0), (w, d, 0), (w, d, h), (0, d, h)),
        "front": _quad("wall", (0, 0, 0), (0, 0, h), (w, 0, h), (w, 0, 0)),
        "right": _quad("red", (w, 0, 0), (w, 0, h), (w, d, h), (w, d, 0)),
        "left-near": _quad("wall", (0, 0, 0), (0, left, 0), (0, left, h), (0, 0, h)),
        "left-far": _quad("wall", (0, right, 0), (0, d, 0), (0, d, h), (0, right, h)),
        "left-low": _quad("wall", (0, left, 0), (0, right, 0), (0, right, sill), (0, left, sill)),
        "left-top": _quad("wall", (0, left, top), (0, right, top), (0, right, h), (0, left, h)),
        "lamp": _quad(
            "lamp", (2.2, 2.6, 2.58), (2.2, 3.2, 2.58), (2.8, 3.2, 2.58), (2.8, 2.6, 2.58)
        ),
        "table": _box("table", (1.2, 2.5, 0.7), (2.8, 3.7, 0.76)),
        "leg": _box("table", (1.9, 3.0, 0), (2.1, 3.2, 0.699)),
        "mirror": _quad(
            "mirror", (2.2, 4.99, 0.9), (3.4, 4.99, 0.9), (3.4, 4.99, 2), (2.2, 4.99, 2)
        ),
        "ball": _ball("glass", (1.75, 2.95, 1.011), 0.25),
        "block": _box("wall", (2.3, 3.1, 0.761), (2.6, 3.4, 1.1)),
    }
    eye, target = (2.3, 0.25, 1.5), (1.75, 4.5, 1.05)
    return View("room", surfaces, meshes, eye, target, (0, 0, 1), 60.0, (2.0, 2.6, 3.4))


VIEWS = {"cornell-box": cornell_box, "room": room}


# --- the same scene for each renderer -------------------------------------------------------------


def _write_ply(mesh: Mesh, path: Path) -> None:
    faces = np.empty(len(mesh.faces), [("n", "u1"), ("corners", "<u4", 3)])
    faces["n"], faces["corners"] = 3, mesh.faces
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
    path.write_bytes(head.encode() + np.array(mesh.vertices, "<f4").tobytes() + faces.tobytes())


def _words(values: tuple[float, ...], between: str = " ") -> str:
    return between.join(repr(float(x)) for x in values)


def write_mitsuba(view: View, path: Path, roulette: int = NEVER, **weights: float) -> None:
    """Write XML. `weights` say how often the lamp and the sky are picked, next to each other."""
    kinds = {
        "diffuse": '<bsdf type="diffuse"><rgb name="reflectance" value="{}"/></bsdf>',
        "mirror": '<bsdf type="conductor"><string name="material" value="none"/>'
        '<rgb name="specular_reflectance" value="{}"/></bsdf>',
        "glass": '<bsdf type="dielectric"><float name="int_ior" value="1.5"/>'
        '<float name="ext_ior" value="1"/></bsdf>',
    }
    look = " ".join(
        f'{name}="{_words(value, ", ")}"'
        for name, value in (("origin", view.origin), ("target", view.target), ("up", view.up))
    )
    lines = [
        '<scene version="3.0.0"><integrator type="path">'
        f'<integer name="max_depth" value="{DEPTH}"/><integer name="rr_depth" value="{roulette}"/>'
        f'</integrator><sensor type="perspective"><float name="fov" value="{view.angle}"/>'
        f'<transform name="to_world"><lookat {look}/></transform><film type="hdrfilm">'
        f'<integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>'
        '<rfilter type="box"/></film><sampler type="independent"/></sensor>'
    ]

    def emitter(kind: str, radiance: Triple, name: str) -> str:
        return (
            f'<emitter type="{kind}"><rgb name="radiance" value="{_words(radiance)}"/>'
            f'<float name="sampling_weight" value="{weights.get(name, 1.0)}"/></emitter>'
        )

    for name, mesh in view.meshes.items():
        surface = view.surfaces[mesh.surface]
        shines = emitter("area", surface.radiance, "lamp") if any(surface.radiance) else ""
        bsdf = kinds[surface.kind].format(_words(surface.color))
        lines.append(
            f'<shape type="ply"><string name="filename" value="{view.name}-{name}.ply"/>'
            f'<boolean name="face_normals" value="true"/>{bsdf}{shines}</shape>'
        )
    lines += [emitter("constant", view.sky, "sky")] if any(view.sky) else []
    path.write_text("\n".join([*lines, "</scene>"]), "utf-8")


def write_luxcore(view: View, path: Path, roulette: int = NEVER, lights: str = "UNIFORM") -> None:
    """Write a .cfg and its .scn. `lights` is how lights are picked."""
    # LuxCore draws a pixel what lies one row above it: the window of the screen makes up for it.
    row = 2 / SIZE
    lines = [
        "scene.camera.type = perspective",
        f"scene.camera.lookat.orig = {_words(view.origin)}",
        f"scene.camera.lookat.target = {_words(view.target)}",
        f"scene.camera.up = {_words(view.up)}",
        f"scene.camera.fieldofview = {view.angle}",
        f"scene.camera.screenwindow = -1 1 {-1 - row} {1 - row}",
        "scene.camera.lensradius = 0",
        "scene.camera.autofocus.enable = 0",
        "scene.camera.cliphither = 0.0001",
    ]
    kinds = {
        "diffuse": ("type = matte", "kd = {}"),
        "mirror": ("type = mirror", "kr = {}"),
        "glass": (
            "type = glass",
            "kr = 1 1 1",
            "kt = 1 1 1",
            "interiorior = 1.5",
            "exteriorior = 1",
        ),
    }
    for name, surface in view.surfaces.items():
        key = f"scene.materials.{name}"
        lines += [f"{key}.{line.format(_words(surface.color))}" for line in kinds[surface.kind]]
        if any(surface.radiance):
            lines += [
                f"{key}.emission = {_words(surface.radiance)}",
                f"{key}.emission.gain = 1 1 1",
            ]
            off = ("power", "efficency", "normalizebycolor")  # so that emission is radiance
            lines += [f"{key}.emission.{name} = 0" for name in off]
    for name, mesh in view.meshes.items():
        key = f"scene.objects.{name}"
        file = path.with_name(f"{view.name}-{name}.ply")
        lines += [f'{key}.ply = "{file}"', f"{key}.material = {mesh.surface}"]
    if any(view.sky):
        key = "scene.lights.sky"
        lines += [f"{key}.type = constantinfinite", f"{key}.color = {_words(view.sky)}"]
    path.with_suffix(".scn").write_text("\n".join([*lines, ""]), "utf-8")
    settings = {
        "scene.file": f'"{path.with_suffix(".scn")}"',
        "renderengine.type": "PATHCPU",
        "sampler.type": "RANDOM",
        "film.filter.type": "NONE",
        "film.width": SIZE,
        "film.height": SIZE,
        **{f"path.pathdepth.{kind}": DEPTH for kind in ("total", "diffuse", "glossy", "specular")},
        "path.russianroulette.depth": roulette,
        "path.clamping.variance.maxvalue": 0,
        "lightstrategy.type": lights,
    }
    path.write_text("".join(f"{name} = {value}\n" for name, value in settings.items()), "utf-8")


def write_blender(view: View, path: Path, roulette: int = NEVER, light_tree: bool = True) -> None:
    """Write a .blend, in a process of its own."""
    wanted = {"view": asdict(view), "roulette": roulette, "light_tree": light_tree}
    path.with_suffix(".json").write_text(json.dumps(wanted), "utf-8")
    command = [sys.executable, "-W", "ignore", __file__, "blend", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if not path.is_file():
        raise RuntimeError(done.stdout + done.stderr)


def _material(bpy: Any, name: str, surface: dict[str, Any]) -> Any:
    """Return a material of Blender whose emission, if any, is that of the front."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, link = material.node_tree.nodes, material.node_tree.links.new
    nodes.clear()
    kind = {"diffuse": "Diffuse", "mirror": "Glossy", "glass": "Glass"}[surface["kind"]]
    bsdf = nodes.new(f"ShaderNodeBsdf{kind}")
    bsdf.inputs["Color"].default_value = (*surface["color"], 1)
    bsdf.inputs["Roughness"].default_value = 0
    if kind == "Glass":
        bsdf.inputs["IOR"].default_value = 1.5
    shader = bsdf.outputs[0]
    if any(surface["radiance"]):
        glow, both = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeAddShader")
        glow.inputs["Color"].default_value = (*surface["radiance"], 1)
        glow.inputs["Strength"].default_value = 1
        side, one = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeMixShader")
        link(both.inputs[0], shader)
        link(both.inputs[1], glow.outputs[0])
        link(one.inputs[0], side.outputs["Backfacing"])
        link(one.inputs[1], both.outputs[0])
        link(one.inputs[2], shader)
        material.cycles.emission_sampling = "FRONT"
        shader = one.outputs[0]
    link(nodes.new("ShaderNodeOutputMaterial").inputs["Surface"], shader)
    return material


def _blend(path: Path) -> None:
    """Save the scene that a .json describes, in Blender's Python."""
    import bpy
    from mathutils import Matrix, Vector

    wanted = json.loads(path.with_suffix(".json").read_text("utf-8"))
    view = wanted["view"]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    materials = {name: _material(bpy, name, of) for name, of in view["surfaces"].items()}
    for name, mesh in view["meshes"].items():
        data = bpy.data.meshes.new(name)
        data.from_pydata(mesh["vertices"], [], mesh["faces"])
        data.materials.append(materials[mesh["surface"]])
        scene.collection.objects.link(bpy.data.objects.new(name, data))
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit, camera.angle = "HORIZONTAL", np.radians(view["angle"])
    camera.clip_start = 1e-4
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.collection.objects.link(scene.camera)
    back = (Vector(view["origin"]) - Vector(view["target"])).normalized()
    right = Vector(view["up"]).cross(back).normalized()
    placed = Matrix((right, back.cross(right), back)).transposed().to_4x4()
    placed.translation = Vector(view["origin"])
    scene.camera.matrix_world = placed
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (*view["sky"], 1)
    scene.render.engine = "CYCLES"
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    bounces = ("max", "diffuse", "glossy", "transmission")
    settings = {f"{kind}_bounces": DEPTH - 2 for kind in bounces} | {
        "blur_glossy": 0,
        "min_light_bounces": wanted["roulette"],
        "use_light_tree": wanted["light_tree"],
        "light_sampling_threshold": 0,
        "pixel_filter_type": "BOX",
        "sample_clamp_indirect": 0,
    }
    for name, value in settings.items():
        setattr(scene.cycles, name, value)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))


# --- samples --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """Samples of a view: which renderer draws them, from which seed, with which settings."""

    renderer: str
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)


_ALIKE = {
    f"{name}{' again' * seed}": Run(name, seed)
    for name in ("mitsuba", "cycles", "luxcore")
    for seed in (0, 1)
}
_ROULETTE = {
    # The depths at which each begins by default.
    f"{name}, roulette": Run(name, 2, {"roulette": depth})
    for name, depth in (("mitsuba", 5), ("cycles", 0), ("luxcore", 3))
}
RUNS = {
    "cornell-box": _ALIKE | _ROULETTE,
    "room": _ALIKE
    | _ROULETTE
    | {
        "mitsuba, lamp twice as often": Run("mitsuba", 3, {"lamp": 2.0}),
        "mitsuba, sky never": Run("mitsuba", 4, {"sky": 0.0}),
        "cycles, no light tree": Run("cycles", 3, {"light_tree": False}),
        "luxcore, by power": Run("luxcore", 3, {"lights": "POWER"}),
    },
}
_BOTH = [
    *((name, f"{name} again") for name in ("mitsuba", "cycles", "luxcore")),
    ("mitsuba", "cycles"),
    ("mitsuba", "luxcore"),
    ("cycles", "luxcore"),
    *((name, f"{name}, roulette") for name in ("mitsuba", "cycles", "luxcore")),
]
PAIRS = {
    "cornell-box": _BOTH,
    "room": [
        *_BOTH,
        ("mitsuba, lamp twice as often", "luxcore"),
        ("mitsuba, sky never", "cycles"),
        ("cycles", "cycles, no light tree"),
        ("luxcore", "luxcore, by power"),
    ],
}


def draw(scene: str, run: Run, folder: Path, spp: int) -> npt.NDArray[np.float32]:
    """Return samples of a run, shape (y, x, channel, sample); its scene is written to `folder`."""
    import chdstat as chd

    view, path = VIEWS[scene](), folder / f"{scene}-{run.renderer}"
    for name, mesh in view.meshes.items():
        _write_ply(mesh, folder / f"{scene}-{name}.ply")
    options: dict[str, Any] = {"spp": spp, "seed": run.seed, "progress": False}
    if run.renderer == "mitsuba":
        file, options["backend"] = path.with_suffix(".xml"), "scalar"
        write_mitsuba(view, file, **run.settings)
    elif run.renderer == "luxcore":
        file = path.with_suffix(".cfg")
        write_luxcore(view, file, **run.settings)
    else:
        file = path.with_suffix(".blend")
        file.unlink(missing_ok=True)
        write_blender(view, file, **run.settings)
    return np.asarray(chd.render(file, **options).read())


# --- comparisons ----------------------------------------------------------------------------------

LUMINANCE = (0.2126, 0.7152, 0.0722)


def luminance(x: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the luminance of samples, shape (y, x, sample)."""
    return np.einsum("yxcs,c->yxs", x.astype(np.float64), LUMINANCE)


def maps_of(x: npt.NDArray[np.float32]) -> dict[str, npt.NDArray[Any]]:
    """Return what is told of the distributions of an image, each (y, x) or (y, x, channel)."""
    import chdstat as chd

    y = np.sort(luminance(x), axis=-1)
    squared = (y - y.mean(axis=-1, keepdims=True)) ** 2
    total = squared.sum(axis=-1)
    largest = squared[..., -max(1, y.shape[-1] // 100) :].sum(axis=-1)
    with np.errstate(invalid="ignore"):
        share = largest / total
    samples = chd.Samples.from_array(x)
    return {
        "mean": x.mean(axis=-1).astype(np.float16),
        "variance": (total / (y.shape[-1] - 1)).astype(np.float32),
        "nulls": (y == 0).mean(axis=-1).astype(np.float16),
        "top": share.astype(np.float16),
        "tail": chd.fit.tail_index(y).xi.astype(np.float16),
        "label": chd.classify(samples, progress=False)["label"].to_numpy().astype(np.int8),
    }


def compared(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> dict[str, Any]:
    """Return how the means and the distributions of two images differ."""
    import chdstat as chd

    means = chd.contrast(a, b)
    each = chd.difference(a, b)
    return {
        "conclusion": means.conclusion,
        "outcome": means.outcome,
        "image_p_value": means.image_p_value,
        "loss": [means.loss.value, means.loss.low, means.loss.high],
        "detectable": means.detectable,
        "p_value": np.asarray(each.p_value, np.float16),
        "distance": each.distance.max(axis=-1).astype(np.float16),
    }


PIXELS = {"cornell-box": {"wall": (16, 16)}, "room": {"ceiling": (3, 10), "back wall": (14, 13)}}
"""Pixels whose samples are kept, (y, x)."""


def recipe() -> dict[str, Any]:
    """Return all that the results depend on, apart from versions."""
    runs = {scene: {name: asdict(run) for name, run in of.items()} for scene, of in RUNS.items()}
    views = {name: asdict(view()) for name, view in VIEWS.items()}
    whole = {"depth": DEPTH, "size": SIZE, "spp": SPP, "runs": runs, "views": views}
    digest = hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
    return {"depth": DEPTH, "size": SIZE, "spp": SPP, "runs": runs, "digest": digest}


def main() -> None:
    """Render, compare, and write the results."""
    from importlib.metadata import version

    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, npt.NDArray[Any]] = {}
    pairs: dict[str, dict[str, Any]] = {}
    for scene, runs in RUNS.items():
        drawn = {}
        for name, run in runs.items():
            file = folder / f"{scene} {name}.npy"
            if not file.is_file():
                np.save(file, draw(scene, run, folder, SPP))
            x = drawn[name] = np.load(file)
            arrays |= {f"{scene}/{name}/{kind}": of for kind, of in maps_of(x).items()}
            for pixel, at in PIXELS[scene].items():
                of = luminance(x[at[0] : at[0] + 1, at[1] : at[1] + 1])[0, 0]
                arrays[f"{scene}/{name}/{pixel}"] = of.astype(np.float16)
            sys.stdout.write(f"{scene}, {name}: mean {x.mean():.5f}\n")
            sys.stdout.flush()
        for a, b in PAIRS[scene]:
            found = compared(drawn[a], drawn[b])
            for kind in ("p_value", "distance"):
                arrays[f"{scene}/{a} | {b}/{kind}"] = found.pop(kind)
            pairs[f"{scene}/{a} | {b}"] = found
            p = arrays[f"{scene}/{a} | {b}/p_value"]
            sys.stdout.write(
                f"{scene}, {a} | {b}: {(p <= 0.05).mean():.3f} of p <= .05; {found['conclusion']}\n"
            )
            sys.stdout.flush()
    told = recipe() | {
        "pairs": pairs,
        "versions": {name: version(name) for name in ("mitsuba", "bpy", "pyluxcore")},
    }
    np.savez_compressed(RESULTS, about=json.dumps(told), **arrays)


if __name__ == "__main__":
    if sys.argv[1] == "blend":
        _blend(Path(sys.argv[2]))
    else:
        main()
