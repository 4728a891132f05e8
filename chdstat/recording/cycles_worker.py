"""Blender's side of `chdstat.recording.cycles`: it opens a scene and draws passes of it.

It runs in Blender's own Python (see `chdstat.recording.worker_loop`), and only in the copy of the
scene in its memory; no file is written.
"""

from __future__ import annotations

import fnmatch
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING or __name__ == "chdstat_worker":  # only Blender's Python has these
    import bpy
    import cycles

if TYPE_CHECKING:
    from chdstat.recording.worker_loop import SceneFault

_MAGICS = (b"BLENDER", b"\x1f\x8b", b"\x28\xb5\x2f\xfd")
"""Begin of a file of Blender: as it is, or compressed by gzip or Zstandard."""
_FEATURE_SAMPLES = 16
_MISS = 1e9
"""Depth from which on nothing was met; Cycles writes 1e10."""
_DIRECT = ("Diffuse", "Glossy", "Transmission")
_SHOWN = 5
"""Names that a note shows."""

_OLD_NAMES = {
    "Emit": "Emission",
    "Env": "Environment",
    "VolumeDir": "Volume Direct",
    "DiffDir": "Diffuse Direct",
    "DiffCol": "Diffuse Color",
    "GlossDir": "Glossy Direct",
    "GlossCol": "Glossy Color",
    "TransDir": "Transmission Direct",
    "TransCol": "Transmission Color",
}
"""Names of passes before Blender 5."""

# What makes samples independent, unclamped and linear: each setting with its value, and the words
# of a note where the scene has another one, into which that value goes.
_CYCLES = {
    "device": ("CPU", "the CPU renders, not the {}, whose samples are not the same to the bit"),
    "use_adaptive_sampling": (False, "adaptive sampling is off: pixels have equal samples"),
    "use_denoising": (False, "the denoiser is off"),
    "sample_clamp_direct": (0.0, "clamping of direct light ({:g}) is off"),
    "sample_clamp_indirect": (0.0, "clamping of indirect light ({:g}) is off"),
    "pixel_filter_type": ("BOX", "the pixel filter is a box of one pixel, not {}"),
    "sampling_pattern": (
        "TABULATED_SOBOL",
        "the sampling pattern {} is off: samples do not depend on other pixels or passes",
    ),
    "auto_scrambling_distance": (False, "automatic scrambling distance is off"),
    "scrambling_distance": (1.0, "the scrambling distance ({:g}) is 1"),
    "use_guiding": (False, "path guiding is off: it learns from earlier samples"),
    "film_exposure": (1.0, "the exposure of the film ({:g}) is 1: samples are radiance"),
    "use_animated_seed": (False, ""),
    "use_layer_samples": ("IGNORE", ""),
    "time_limit": (0.0, "the time limit ({:g} s) is off"),
    "use_auto_tile": (False, ""),
    # The first sample of Cycles lies at the centre of the pixel, lens and shutter instead of at
    # random, so that passes draw the second one. The table of random numbers is that of a long
    # render: the one of a short render repeats sooner.
    "samples": (4096, ""),
    "use_sample_subset": (True, ""),
    "sample_offset": (1, ""),
    "sample_subset_length": (1, ""),
}
_RENDER = {
    "use_persistent_data": (True, ""),
    "use_sequencer": (False, ""),
    "use_compositing": (False, ""),
    "use_freestyle": (False, "Freestyle lines are not drawn"),
    "use_multiview": (False, "stereo is off: the camera itself renders"),
    "use_border": (False, "the render region of the file is off; give a crop"),
    "use_simplify_normals": (False, ""),
}
# What stays although it changes the mean: whether it applies, and the words.
_BIASES = (
    ("blur_glossy", "Filter Glossy ({:g}) is kept: glossy caustics are blurred"),
    ("use_fast_gi", "Fast GI is kept: light of late bounces is an approximation"),
    ("volume_biased", "biased volumes are kept"),
    ("film_transparent_glass", "transparent glass is kept"),
)
_ESTIMATOR = (
    "max_bounces",
    "diffuse_bounces",
    "glossy_bounces",
    "transmission_bounces",
    "volume_bounces",
    "transparent_max_bounces",
    "min_light_bounces",
    "min_transparent_bounces",
    "caustics_reflective",
    "caustics_refractive",
    "blur_glossy",
    "use_light_tree",
    "light_sampling_threshold",
    "direct_light_sampling_type",
    "use_fast_gi",
    "volume_biased",
    "volume_step_rate",
    "sampling_pattern",
)

_drawn: dict[str, Any] = {}
_opened: dict[str, Any] = {}


def _keep_passes() -> None:
    """Keep the passes of every render, which Blender shows to its engines only."""
    render_as_before = cycles.CyclesRender.render

    def render(self: Any, depsgraph: Any) -> None:
        render_as_before(self, depsgraph)
        result = self.get_result()
        width, height = result.resolution_x, result.resolution_y
        for one in result.layers[0].passes:
            pixels = np.empty(width * height * one.channels, np.float32)
            one.rect.foreach_get(pixels)
            _drawn[_OLD_NAMES.get(one.name, one.name)] = pixels.reshape(
                height, width, one.channels
            )[::-1]

    cycles.CyclesRender.render = render


if __name__ == "chdstat_worker":
    _keep_passes()


# --- the file -------------------------------------------------------------------------------------


def version() -> dict[str, Any]:
    """Return what renders."""
    return {"version": bpy.app.version_string}


def load(path: str, **parameters: Any) -> dict[str, Any]:
    """Open a scene, choose what is rendered, and return what is to be said of it."""
    with Path(path).open("rb") as stream:
        head = stream.read(8)
    if not head.startswith(_MAGICS):
        what = f"begins with {head!r}" if head else "is empty"
        message = f"{path} is no file of Blender: it {what}; save it in Blender again"
        raise SceneFault(message)
    try:
        bpy.ops.wm.open_mainfile(filepath=path, load_ui=False, use_scripts=False)
    except RuntimeError as error:
        why = " ".join(str(error).replace("Error:", "").split())
        message = (
            f"Blender {bpy.app.version_string} cannot open {path}: {why}; if a newer one has saved "
            "it, set $CHDSTAT_BLENDER to the path of that one"
        )
        raise SceneFault(message) from error
    notes: list[str] = []
    scene = _named(bpy.data.scenes, "scene", parameters.get("scene"), bpy.context.scene)
    if scene is None:
        message = f"{path} holds no scene"
        raise SceneFault(message)
    _choose(scene, parameters, notes)
    notes += [*_code(), *_missing()]
    _opened.clear()
    _opened.update(scene=scene, layer=_layer(scene, parameters.get("view_layer"), notes))
    _set(scene.cycles, _CYCLES, notes)
    _set(scene.render, _RENDER, notes)
    notes += _kept(scene)
    return {
        "notes": notes,
        "files": _files(),
        "parameters": {
            "frame": scene.frame_current,
            "camera": scene.camera.name,
            "view_layer": _opened["layer"].name,
            "scene": scene.name,
        },
        "version": bpy.app.version_string,
    }


def _plain(settings: Any, name: str) -> Any:
    """Return a setting; Blender's floats as they were typed."""
    value = getattr(settings, name)
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _named(things: Any, kind: str, name: str | None, otherwise: Any) -> Any:
    """Return the thing of a name."""
    if name is None:
        return otherwise
    if (found := things.get(name)) is None:
        names = ", ".join(repr(one.name) for one in list(things)[:20]) or "none"
        message = f"there is no {kind} {name!r} in the file; there is {names}"
        raise SceneFault(message)
    return found


def _choose(scene: Any, parameters: dict[str, Any], notes: list[str]) -> None:
    """Set engine, frame and camera."""
    if scene.render.engine != "CYCLES":
        notes.append(f"Cycles renders the scene, which is set up for {scene.render.engine}")
        scene.render.engine = "CYCLES"
    frame = parameters.get("frame")
    scene.frame_set(scene.frame_current if frame is None else frame)
    if moved := _stilled(scene):
        notes.append(
            f"animated settings stay as they are at frame {scene.frame_current}: "
            f"{', '.join(moved[:_SHOWN])}"
        )
    cameras = {o.name: o for o in scene.objects if o.type == "CAMERA"}
    if (name := parameters.get("camera")) is not None:
        if name not in cameras:
            names = ", ".join(map(repr, sorted(cameras))) or "none"
            message = f"there is no camera {name!r} in scene {scene.name!r}; it has {names}"
            raise SceneFault(message)
        for marker in scene.timeline_markers:
            marker.camera = None  # it would bind the frame to another camera
        scene.camera = cameras[name]
    if scene.camera is None:
        names = f"; name one of {', '.join(map(repr, sorted(cameras)))}" if cameras else ""
        message = f"scene {scene.name!r} has no camera to render with{names or '; add one'}"
        raise SceneFault(message)


def _stilled(scene: Any) -> list[str]:
    """Take animation and drivers from the settings of the render, and return their names.

    Each render would set them again, and a seed that follows the frame would never change.
    """
    data = scene.animation_data
    if data is None:
        return []
    groups = [data.drivers]
    if data.action is not None and hasattr(data.action, "layers"):  # since Blender 4.4
        strips = [strip for layer in data.action.layers for strip in layer.strips]
        groups += [bag.fcurves for strip in strips for bag in strip.channelbags]
    elif data.action is not None:
        groups.append(data.action.fcurves)
    names = set()
    for curves in groups:
        for curve in list(curves):
            if curve.data_path.startswith(("cycles.", "render.")):
                names.add(curve.data_path)
                curves.remove(curve)
    return sorted(names)


def _layer(scene: Any, name: str | None, notes: list[str]) -> Any:
    """Return the view layer to render, the only one in use."""
    used = [one for one in scene.view_layers if one.use] or list(scene.view_layers)
    layer = _named(scene.view_layers, "view layer", name, used[0])
    if name is None and len(used) > 1:
        others = ", ".join(repr(one.name) for one in used[1:])
        notes.append(f"view layer {layer.name!r} is rendered; others by their names: {others}")
    for one in scene.view_layers:
        one.use = one == layer
    if layer.material_override is not None:
        notes.append(f"the view layer overrides all materials by {layer.material_override.name!r}")
    return layer


def _set(where: Any, settings: dict[str, Any], notes: list[str]) -> None:
    """Change settings, and note what that changes; versions lack some of them."""
    for name, (value, words) in settings.items():
        if not hasattr(where, name):
            continue
        before = getattr(where, name)
        if before != value:
            setattr(where, name, value)
            if words:
                notes.append(words.format(before))


def _kept(scene: Any) -> list[str]:
    """Return notes on what stays or is left out, although users may not expect it."""
    c, render = scene.cycles, scene.render
    notes = [
        words.format(getattr(c, name))
        for name, words in _BIASES
        if getattr(c, name, 0) not in (0, 0.0)
    ]
    compositor = "compositing_node_group" if bpy.app.version >= (5,) else "use_nodes"
    if getattr(scene, compositor):
        notes.append("the compositor is off")
    strips = getattr(scene.sequence_editor, "strips_all", ()) if scene.sequence_editor else ()
    if len(strips):
        notes.append("the sequencer is off")
    if render.film_transparent:
        notes.append("the film is transparent: the background adds no light; alpha is not kept")
    if render.use_simplify:
        notes.append("Simplify is kept, as the file says")
        if getattr(c, "texture_limit_render", "OFF") != "OFF":
            notes.append(f"textures are limited to {c.texture_limit_render} pixels")
    working = getattr(bpy.data, "colorspace", None)
    space = getattr(working, "working_space", "Linear Rec.709")
    if space != "Linear Rec.709":
        notes.append(f"radiance is in the working space of the file, {space}")
    if c.shading_system:
        notes.append("Open Shading Language is on, as the file says")
    return notes


def _code() -> list[str]:
    """Return a note on Python code in the file, which is not run."""
    if getattr(bpy.app, "autoexec_fail", False):
        what = bpy.app.autoexec_fail_message or "scripts"
        return [f"Python code in the file is not run: {what}"]
    if scripts := [text.name for text in bpy.data.texts if text.use_module]:
        return [f"Python code in the file is not run: {', '.join(scripts[:_SHOWN])}"]
    return []


def _paths() -> list[Path]:
    """Return the external files that the scene names, apart from Blender's own."""
    own = Path(bpy.utils.resource_path("LOCAL")), Path(bpy.utils.system_resource("DATAFILES"))
    named = {Path(p) for p in bpy.utils.blend_paths(absolute=True) if p}
    return sorted(p for p in named if not any(p.is_relative_to(folder) for folder in own))


def _tiles(path: Path) -> list[Path]:
    """Return the files of a path, of which a tiled texture has many."""
    return sorted(path.parent.glob(re.sub("<(UDIM|UVTILE)>", "*", path.name)))


def _missing() -> list[str]:
    gone = [path.name for path in _paths() if not path.exists() and not _tiles(path)]
    if not gone:
        return []
    names = ", ".join(gone[:_SHOWN]) + f" and {len(gone) - _SHOWN} more" * (len(gone) > _SHOWN)
    return [f"missing files, which Cycles renders pink or leaves out: {names}"]


def _files() -> list[str]:
    """Return the external files of the scene that exist."""
    found = {file for path in _paths() for file in [path, *_tiles(path)] if file.is_file()}
    return sorted(map(str, found))


# --- the image ------------------------------------------------------------------------------------


def frame(
    size: list[int] | None,
    crop: list[int] | None,
    max_depth: int | None,
    direct: bool,
    by_light: list[str],
) -> dict[str, Any]:
    """Set the image and the parts of its light, and return the size of the whole image."""
    scene, layer = _opened["scene"], _opened["layer"]
    if max_depth is not None:
        # A path of two segments goes from the camera to a surface to a light: no bounce.
        scene.cycles.max_bounces = min(scene.cycles.max_bounces, max_depth - 2)
    for where in (layer, layer.cycles):
        for name in dir(where):
            if name.startswith("use_pass_"):
                setattr(where, name, name == "use_pass_combined")
    layer.cycles.pass_debug_sample_count = False
    for aov in list(layer.aovs):
        layer.aovs.remove(aov)
    _opened["parts"] = _light_groups(scene, layer, by_light)
    _opened["direct"] = direct
    used = {n: _plain(scene.cycles, n) for n in _ESTIMATOR if hasattr(scene.cycles, n)}
    return {"size": _sized(scene.render, size, crop), "integrator": used}


def _sized(render: Any, size: list[int] | None, crop: list[int] | None) -> list[int]:
    """Set size and crop, and return the size of the whole image."""
    if size is not None:
        render.resolution_x, render.resolution_y = size
        render.resolution_percentage = 100
        if [render.resolution_x, render.resolution_y] != list(size):
            message = f"Blender draws images of 4 x 4 pixels or more, got {size[0]} x {size[1]}"
            raise SceneFault(message)
    part = render.resolution_percentage / 100
    width, height = (max(1, int(n * part)) for n in (render.resolution_x, render.resolution_y))
    if crop is not None:
        x, y, w, h = crop
        left, bottom = x, height - y - h
        render.use_border = render.use_crop_to_border = True
        # A quarter of a pixel more: whether it is rounded or cut off, it is the pixel meant.
        render.border_min_x, render.border_max_x = (
            n / width for n in (left + 0.25, left + w + 0.25)
        )
        render.border_min_y, render.border_max_y = (
            n / height for n in (bottom + 0.25, bottom + h + 0.25)
        )
    return [width, height]


def _light_groups(scene: Any, layer: Any, wanted: list[str]) -> dict[str, str]:
    """Make a light group of each name or pattern, and return its name.

    A name is that of a group in the file, or else a pattern of lights' names.
    """
    existing = [group.name for group in layer.lightgroups]
    things = [*bpy.data.objects, *([scene.world] if scene.world else [])]
    lights = [one for one in things if _shines(one)]
    members = {
        name: [one for one in things if one.lightgroup == name]
        if name in existing
        else [one for one in lights if fnmatch.fnmatchcase(one.name, name)]
        for name in wanted
    }
    for name, held in members.items():
        if not held:
            names = ", ".join([*existing, *(one.name for one in lights)][:20]) or "none"
            message = f"there is no light or light group {name!r} in the scene; there is {names}"
            raise SceneFault(message)
        for other in wanted[: wanted.index(name)]:
            if both := [one.name for one in held if one in members[other]]:
                message = (
                    f"light {both[0]!r} belongs to {other!r} and to {name!r}, but Cycles counts "
                    "each light once; leave one of the two out"
                )
                raise SceneFault(message)
    for group in list(layer.lightgroups):
        layer.lightgroups.remove(group)
    groups = {
        name: str(layer.lightgroups.add(name=f"part {n}").name) for n, name in enumerate(members)
    }
    for name, held in members.items():
        for one in held:
            one.lightgroup = groups[name]
    return groups


def _shines(thing: Any) -> bool:
    """Return whether an object is a light or may hold emission; worlds do."""
    kind = getattr(thing, "type", "LIGHT")
    trees = [
        slot.material.node_tree for slot in getattr(thing, "material_slots", ()) if slot.material
    ]
    nodes = [node for tree in trees if tree for node in tree.nodes]
    return kind == "LIGHT" or any(node.type == "EMISSION" or _glows(node) for node in nodes)


def _glows(node: Any) -> bool:
    strength = node.inputs.get("Emission Strength")  # of a principled surface
    return strength is not None and (strength.is_linked or strength.default_value > 0)


def features() -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the first-hit features, which do not depend on seeds."""
    scene, layer = _opened["scene"], _opened["layer"]
    c = scene.cycles
    names = ("use_pass_z", "use_pass_normal", "use_pass_position")
    before = c.samples, c.sample_offset, c.seed
    for name in names:
        setattr(layer, name, True)
    layer.cycles.denoising_store_passes = True
    # Depth and position are those of the first sample only, at the centre of the pixel.
    c.samples, c.sample_offset, c.seed = _FEATURE_SAMPLES, 0, 0
    if hasattr(c, "use_sample_subset"):
        c.use_sample_subset = False
    try:
        found = _rendered()
    finally:
        for name in names:
            setattr(layer, name, False)
        layer.cycles.denoising_store_passes = False
        c.samples, c.sample_offset, c.seed = before
        if hasattr(c, "use_sample_subset"):
            c.use_sample_subset = True
    depth = found["Depth"][..., 0]
    arrays = {
        "albedo": found["Denoising Albedo"],
        "normal": found["Normal"],
        "position": found["Position"],
        "depth": np.where(depth < _MISS, depth, np.float32(0)),
    }
    _show_direct(layer)
    return {}, arrays


def _show_direct(layer: Any) -> None:
    for kind in _DIRECT:
        for what in ("direct", "color"):
            setattr(layer, f"use_pass_{kind.lower()}_{what}", _opened["direct"])
    layer.use_pass_emit = layer.use_pass_environment = _opened["direct"]
    layer.cycles.use_pass_volume_direct = _opened["direct"]


def draw(seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return one sample of every pixel: "image", and parts of its light."""
    _opened["scene"].cycles.seed = seed
    passes = _rendered()
    arrays = {"image": passes["Combined"][..., :3]}
    if _opened["direct"]:
        light = passes["Emission"] + passes["Environment"] + passes["Volume Direct"]
        for kind in _DIRECT:
            light += passes[f"{kind} Direct"] * passes[f"{kind} Color"]
        arrays["direct"] = light
    for name, group in _opened["parts"].items():
        arrays[f"light {name}"] = passes[f"Combined_{group}"]
    return {}, arrays


def _rendered() -> dict[str, Any]:
    """Return the passes of a render."""
    scene = _opened["scene"]
    scene.update_tag()  # persistent data would not see another seed
    _drawn.clear()
    bpy.ops.render.render(scene=scene.name, layer=_opened["layer"].name)
    if not _drawn:
        message = "Cycles has rendered nothing"
        raise RuntimeError(message)
    return _drawn
