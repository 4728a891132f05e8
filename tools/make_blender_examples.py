"""Make the Blender scenes of the page on noisy scenes, and what it shows of them.

    python tools/make_blender_examples.py scenes FOLDER
    python tools/make_blender_examples.py data [--spp 512]

The first writes monkey.blend and three rooms, each as it is and with a setting changed; it needs a
Python with bpy. The second renders the rooms with Cycles and writes docs/how-to/blender/noise.npz.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "how-to" / "blender" / "noise.npz"
SIZE, SHOWN = (72, 48), 64
SEEDS = 7919
"""Seed of each pass over that of the one before."""
EXAMPLES = {
    "glass": ("as it is", "Filter Glossy 0", "caustics off", "clear to shadow rays, caustics off"),
    "lamps": ("Light Tree off", "Light Tree on"),
    "window": ("as it is", "Portal"),
}
"""The rooms, and their variants: what is changed in each."""


# --- scenes ---------------------------------------------------------------------------------------


def monkey() -> None:
    """Suzanne and a glass ball on a glossy floor, under an area lamp."""
    parts = _room()
    parts.lamp("AREA", 400, (2.5, -3, 5), size=1.5)
    _suzanne(parts, (-0.8, 0, 1))
    parts.ball(1.4, _glass(parts), size=0.8, z=0.8, y=-0.8)
    floor = parts.material("NodeBsdfPrincipled", Base_Color=(0.5, 0.5, 0.5, 1), Roughness=0.15)
    parts.bpy.data.objects["Floor"].data.materials[0] = floor


def glass(variant: str) -> None:
    """Suzanne below a pane of glass, through which no path can aim at the small lamp above."""
    parts = _room()
    bpy = parts.bpy
    parts.sky(0.05)
    _suzanne(parts, (0, 0, 1))
    parts.lamp("AREA", 600, (1, -1, 6), size=0.5)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 4))
    pane = bpy.context.object
    pane.scale = 14, 14, 0.05
    surface = _glass(parts)
    pane.data.materials.append(surface)
    if variant.endswith("caustics off"):
        bpy.context.scene.cycles.caustics_reflective = False
        bpy.context.scene.cycles.caustics_refractive = False
    if variant == "Filter Glossy 0":
        bpy.context.scene.cycles.blur_glossy = 0
    if variant.startswith("clear"):
        _clear_for_shadow_rays(surface.node_tree)


def lamps(variant: str) -> None:
    """Suzanne among sixty-four small lamps."""
    parts = _room()
    _suzanne(parts, (0, 0, 1))
    for i in range(64):
        row, column = divmod(i, 8)
        place = 1.6 * column - 5.6, 1.1 * row - 5.5, 0.4 + 0.5 * ((3 * i) % 7)
        parts.lamp("POINT", 8, place, shadow_soft_size=0.03)
    parts.bpy.context.scene.cycles.use_light_tree = variant == "Light Tree on"


def window(variant: str) -> None:
    """Suzanne in a closed room with one window to a bright sky."""
    parts = _room()
    parts.sky(20.0)
    _suzanne(parts, (0, 0, 1))
    wall = parts.material("NodeBsdfDiffuse", Color=(0.7, 0.7, 0.7, 1))
    _quad(parts, wall, [(-4, -8, 4.5), (4, -8, 4.5), (4, 3, 4.5), (-4, 3, 4.5)])
    _quad(parts, wall, [(4, -8, 0), (4, 3, 0), (4, 3, 4.5), (4, -8, 4.5)])
    _quad(parts, wall, [(-4, -8, 0), (4, -8, 0), (4, -8, 4.5), (-4, -8, 4.5)])
    # The wall on the left leaves a window: y from -0.6 to 0.6, z from 1.8 to 3.
    for y0, y1, z0, z1 in (
        (-8, -0.6, 0, 4.5),
        (0.6, 3, 0, 4.5),
        (-0.6, 0.6, 0, 1.8),
        (-0.6, 0.6, 3, 4.5),
    ):
        _quad(parts, wall, [(-4, y0, z0), (-4, y1, z0), (-4, y1, z1), (-4, y0, z1)])
    if variant == "Portal":
        made = parts.lamp("AREA", 10, (-4, 0, 2.4), size=1.2)
        made.rotation_euler = 0, -math.pi / 2, 0
        made.data.cycles.is_portal = True


def _room() -> Any:
    sys.path.insert(0, str(ROOT / "tests" / "recording"))
    import blender_scenes

    blender_scenes.room()
    return blender_scenes


def _suzanne(parts: Any, place: tuple[float, float, float]) -> None:
    parts.bpy.ops.mesh.primitive_monkey_add(size=1.8, location=place)
    made = parts.bpy.context.object
    made.data.materials.append(parts.material("NodeBsdfDiffuse", Color=(0.7, 0.35, 0.2, 1)))
    for face in made.data.polygons:
        face.use_smooth = True


def _glass(parts: Any) -> Any:
    return parts.material("NodeBsdfGlass", Roughness=0.0, IOR=1.5)


def _clear_for_shadow_rays(tree: Any) -> None:
    """Mix a Transparent BSDF into a material where Light Path says that a ray is a shadow ray."""
    out = next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")
    before = out.inputs["Surface"].links[0].from_node
    clear, path, mix = (
        tree.nodes.new(f"ShaderNode{kind}")
        for kind in ("BsdfTransparent", "LightPath", "MixShader")
    )
    tree.links.new(path.outputs["Is Shadow Ray"], mix.inputs[0])
    tree.links.new(before.outputs[0], mix.inputs[1])
    tree.links.new(clear.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], out.inputs["Surface"])


def _quad(parts: Any, surface: Any, corners: Sequence[tuple[float, float, float]]) -> None:
    mesh = parts.bpy.data.meshes.new("Wall")
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    mesh.materials.append(surface)
    made = parts.bpy.data.objects.new("Wall", mesh)
    parts.bpy.context.scene.collection.objects.link(made)


def write_scenes(folder: Path) -> None:
    """Write monkey.blend, and ROOM-NUMBER.blend of each variant."""
    import bpy

    folder.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[str], None]] = {"glass": glass, "lamps": lamps, "window": window}
    monkey()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "monkey.blend"))
    for room, variants in EXAMPLES.items():
        for number, variant in enumerate(variants):
            makers[room](variant)
            bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{room}-{number}.blend"))


# --- what the page shows --------------------------------------------------------------------------


def samples_of(path: Path, spp: int) -> Any:
    """Return samples that Cycles draws of a file."""
    import numpy as np

    import chdstat as chd
    from chdstat.recording.cycles import CyclesSource

    source = CyclesSource(path, size=SIZE)
    drawn = np.stack([np.asarray(source(SEEDS * (i + 1)).image) for i in range(spp)], axis=-1)
    attrs = {"renderer": source.attrs["renderer"]}
    source.close()
    return chd.Samples.from_array(drawn, name=path.stem, **attrs)


def described(samples: Any) -> dict[str, Any]:
    """Return what the page shows: image, labels, samples of one pixel, and three numbers.

    The numbers are the mean, the share of black samples, and the variance over the squared mean.
    """
    import numpy as np

    import chdstat as chd

    x = samples.read()
    gray = x.mean(axis=2)
    mean = gray.mean()
    return {
        "image": x[..., :SHOWN].mean(axis=-1).astype(np.float16),
        "labels": chd.classify(samples)["label"].to_numpy().astype(np.uint8),
        "pixel": gray[-4, SIZE[0] // 2, :SHOWN].astype(np.float32),
        "numbers": np.array([mean, (gray == 0).mean(), gray.var(axis=-1).mean() / mean**2]),
    }


def write_data(spp: int) -> None:
    """Render every variant of every room, and write what the page shows."""
    import subprocess

    import numpy as np

    found = {}
    with TemporaryDirectory() as folder:
        # Blender runs in a process of its own.
        command = [sys.executable, __file__, "scenes", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # noqa: S603
        for room, variants in EXAMPLES.items():
            for number, variant in enumerate(variants):
                samples = samples_of(Path(folder) / f"{room}-{number}.blend", spp)
                about = described(samples)
                found |= {f"{room}/{number}/{name}": value for name, value in about.items()}
                print(room, variant, about["numbers"])  # noqa: T201
    OUT.parent.mkdir(exist_ok=True)
    np.savez_compressed(OUT, **found)


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("scenes", "data"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--spp", type=int, default=512)
    asked = parser.parse_args()
    if asked.what == "scenes":
        write_scenes(asked.folder)
    else:
        write_data(asked.spp)


if __name__ == "__main__":
    main()
