"""Small Blender scenes, and images of them by Cycles itself; run in a Python that has bpy.

python blender_scenes.py make FOLDER
python blender_scenes.py images SCENE FOLDER WIDTH HEIGHT SPP COUNT
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

MAKERS: dict[str, Callable[[Any], None]] = {}


def scene(maker: Callable[[Any], None]) -> Callable[[Any], None]:
    """Register a maker, which adds to a floor, a wall and a camera."""
    MAKERS[maker.__name__] = maker
    return maker


# --- parts ----------------------------------------------------------------------------------------


def material(kind: str = "BsdfPrincipled", **inputs: Any) -> Any:
    """Return a material of one node, with values of its inputs by name, ``_`` for a space."""
    made = bpy.data.materials.new(kind)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    node = tree.nodes.new(f"Shader{kind}")
    out = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(node.outputs[0], out.inputs["Surface"])
    for name, value in inputs.items():
        node.inputs[name.replace("_", " ")].default_value = value
    return made


def ball(x: float, surface: Any, z: float = 1.0, y: float = 0.0, size: float = 1.0) -> Any:
    bpy.ops.mesh.primitive_uv_sphere_add(
        segments=24, ring_count=12, radius=size, location=(x, y, z)
    )
    made = bpy.context.object
    made.data.materials.append(surface)
    for face in made.data.polygons:
        face.use_smooth = True
    return made


def lamp(kind: str, energy: float, place: tuple[float, float, float], **settings: Any) -> Any:
    """Add a light that points at the origin."""
    data = bpy.data.lights.new(kind, kind)
    data.energy = energy
    for name, value in settings.items():
        setattr(data, name, value)
    made = bpy.data.objects.new(kind.title(), data)
    made.location = place
    aim(made)
    bpy.context.scene.collection.objects.link(made)
    return made


def aim(thing: Any, at: tuple[float, float, float] = (0, 0, 0.7)) -> None:
    from mathutils import Vector

    direction = Vector(at) - thing.location
    thing.rotation_euler = direction.to_track_quat("-Z", "Y").to_euler()


def sky(strength: float, color: tuple[float, float, float] = (0.6, 0.8, 1.0)) -> Any:
    node = bpy.context.scene.world.node_tree.nodes["Background"]
    node.inputs["Color"].default_value = (*color, 1)
    node.inputs["Strength"].default_value = strength
    return node


def room() -> Any:
    """Return a new scene with a camera, a floor and a wall, all black around."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    made = bpy.context.scene
    made.render.engine = "CYCLES"
    made.render.resolution_x, made.render.resolution_y = 48, 32
    made.world = bpy.data.worlds.new("World")
    made.world.use_nodes = True
    sky(0.0)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0, -7, 2.5)
    aim(camera)
    made.collection.objects.link(camera)
    made.camera = camera
    for name, turn, place, color in (
        ("Floor", 0.0, (0, 0, 0), (0.6, 0.5, 0.4, 1)),
        ("Wall", 1.5708, (0, 3, 0), (0.3, 0.5, 0.7, 1)),
    ):
        bpy.ops.mesh.primitive_plane_add(size=14, rotation=(turn, 0, 0), location=place)
        bpy.context.object.name = name
        bpy.context.object.data.materials.append(material("NodeBsdfDiffuse", Color=color))
    return made


# --- scenes ---------------------------------------------------------------------------------------


@scene
def materials(_: Any) -> None:
    lamp("AREA", 300, (2, -3, 5), size=2)
    ball(-2.2, material("NodeBsdfPrincipled", Metallic=1.0, Roughness=0.2))
    subsurface = {"Subsurface_Weight": 1.0, "Subsurface_Radius": (0.5, 0.2, 0.1)}
    ball(0, material("NodeBsdfPrincipled", **subsurface))
    ball(2.2, material("NodeBsdfPrincipled", Roughness=0.4, Coat_Weight=1.0, Sheen_Weight=0.5))


@scene
def glass(_: Any) -> None:
    lamp("AREA", 300, (2, -1, 5), size=1)
    ball(-1.2, material("NodeBsdfGlass", Roughness=0.0, IOR=1.5))
    ball(1.2, material("NodeBsdfGlass", Roughness=0.3, Color=(0.8, 1, 0.8, 1)))


@scene
def lights(_: Any) -> None:
    lamp("POINT", 60, (-2, -1, 2), shadow_soft_size=0.1)
    lamp("SPOT", 300, (2, -3, 4), spot_size=0.6, color=(1, 0.5, 0.3))
    lamp("SUN", 0.3, (0, -2, 5), angle=0.05)
    lamp("AREA", 40, (0, 2, 3), shape="DISK", color=(0.3, 0.5, 1))
    ball(0, material("NodeEmission", Color=(1, 0.9, 0.3, 1), Strength=4.0), size=0.3)


@scene
def volume(made: Any) -> None:
    lamp("SPOT", 500, (3, -2, 4), spot_size=0.8)
    bpy.ops.mesh.primitive_cube_add(size=3, location=(0, 0, 1.5))
    fog = bpy.data.materials.new("Fog")
    fog.use_nodes = True
    tree = fog.node_tree
    tree.nodes.clear()
    scatter = tree.nodes.new("ShaderNodeVolumeScatter")
    scatter.inputs["Density"].default_value = 0.4
    scatter.inputs["Anisotropy"].default_value = 0.3
    out = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(scatter.outputs[0], out.inputs["Volume"])
    bpy.context.object.data.materials.append(fog)
    made.cycles.volume_bounces = 2


@scene
def motion(made: Any) -> None:
    lamp("AREA", 300, (2, -3, 5), size=2)
    moving = ball(0, material("NodeBsdfPrincipled", Roughness=0.3))
    for number, x in ((1, -2.0), (3, 2.0)):
        moving.location.x = x
        moving.keyframe_insert("location", frame=number)
    made.frame_set(2)
    made.render.use_motion_blur = True


@scene
def focus(made: Any) -> None:
    lamp("AREA", 300, (2, -3, 5), size=2)
    for x, y in ((-2, -3), (0, 0), (2, 2)):
        ball(x, material("NodeBsdfPrincipled", Roughness=0.3), y=y)
    made.camera.data.dof.use_dof = True
    made.camera.data.dof.focus_distance = 7.0
    made.camera.data.dof.aperture_fstop = 0.2


@scene
def transparent(_: Any) -> None:
    lamp("SUN", 2, (2, -3, 5), angle=0.1)
    for n in range(12):
        kind = ("NodeBsdfTransparent", "NodeBsdfDiffuse", "NodeBsdfTranslucent")[n % 3]
        bpy.ops.mesh.primitive_plane_add(
            size=2, location=(0.5 * n - 2.7, -0.1 * n, 1), rotation=(1.5708, 0, 0.4)
        )
        bpy.context.object.scale.x = 0.02 if n % 3 == 1 else 0.2
        bpy.context.object.data.materials.append(material(kind, Color=(0.9, 0.5, 0.5, 1)))


@scene
def sky_light(made: Any) -> None:
    tree = made.world.node_tree
    node = tree.nodes.new("ShaderNodeTexSky")
    node.sun_size, node.sun_intensity = 0.1, 0.1
    tree.links.new(node.outputs[0], tree.nodes["Background"].inputs["Color"])
    sky(0.2)
    ball(-1, material("NodeBsdfPrincipled", Metallic=1.0, Roughness=0.1))
    ball(1.2, material("NodeBsdfDiffuse"))


@scene
def light_groups(made: Any) -> None:
    placed = {"key": (3.0, -3.0, 4.0), "fill": (-3.0, -2.0, 3.0)}
    for name, place in placed.items():
        lit = lamp("AREA", 150, place)
        made.view_layers[0].lightgroups.add(name=name)
        lit.lightgroup, lit.name = name, f"Lamp.{name}"
    sky(0.2)
    ball(-1, material("NodeBsdfPrincipled", Roughness=0.2))
    ball(1.2, material("NodeEmission", Strength=2.0), size=0.4)


@scene
def instances(made: Any) -> None:
    lamp("AREA", 300, (2, -3, 5), size=2)
    group = bpy.data.collections.new("Balls")
    first = ball(0, material("NodeBsdfPrincipled", Roughness=0.3), z=0.3, size=0.3)
    made.collection.objects.unlink(first)
    group.objects.link(first)
    for x in range(-3, 4):
        for y in range(-2, 3):
            copy = bpy.data.objects.new("Copy", None)
            copy.instance_type, copy.instance_collection = "COLLECTION", group
            copy.location = (x, y, 0)
            made.collection.objects.link(copy)


@scene
def texture(_: Any) -> None:
    lamp("POINT", 300, (2, -3, 4), shadow_soft_size=0.3)
    image = bpy.data.images.new("Checks", 32, 32, float_buffer=False)
    image.generated_type = "COLOR_GRID"
    image.filepath_raw = str(Path(sys.argv[-1], "checks.png"))
    image.file_format = "PNG"
    image.save()
    found = bpy.data.images.load(image.filepath_raw)
    surface = material("NodeBsdfPrincipled", Roughness=0.5)
    tree = surface.node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = found
    target = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
    tree.links.new(node.outputs["Color"], target.inputs["Base Color"])
    ball(-1, surface)
    ball(1.2, surface)


@scene
def displacement(_: Any) -> None:
    lamp("SUN", 3, (3, -3, 3), angle=0.02)
    surface = material("NodeBsdfPrincipled", Roughness=0.5)
    tree = surface.node_tree
    noise, raised = (tree.nodes.new(f"ShaderNode{n}") for n in ("TexNoise", "Displacement"))
    noise.inputs["Scale"].default_value = 3.0
    tree.links.new(noise.outputs[0], raised.inputs["Height"])
    out = next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")
    tree.links.new(raised.outputs[0], out.inputs["Displacement"])
    surface.displacement_method = "BOTH"
    ball(0, surface, size=1.5, z=1.5)


def make(folder: Path) -> None:
    """Write all scenes."""
    for name, maker in MAKERS.items():
        made = room()
        maker(made)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{name}.blend"), relative_remap=True)


# --- Cycles by itself -----------------------------------------------------------------------------


def images(path: str, folder: str, width: int, height: int, spp: int, count: int) -> None:
    """Render images of several seeds as users do, apart from what changes their mean."""
    bpy.ops.wm.open_mainfile(filepath=path)
    made = bpy.context.scene
    c, render = made.cycles, made.render
    c.samples, c.use_adaptive_sampling, c.use_denoising = spp, False, False
    c.sample_clamp_direct = c.sample_clamp_indirect = 0
    c.pixel_filter_type = "BOX"
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_depth = "32"
    for seed in range(count):
        c.seed = 1000 + seed
        render.filepath = f"{folder}/{Path(path).stem}-{seed}.exr"
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    what, *words = sys.argv[sys.argv.index("--") + 1 :]
    if what == "make":
        make(Path(words[0]))
    else:
        images(*words[:2], *map(int, words[2:]))
