"""Scenes of LuxCore, and images that its path engine renders of them by itself.

As a script, ``-- make FOLDER`` writes the scenes, and ``-- images SCENE FOLDER WIDTH HEIGHT SPP
COUNT`` .npy files of linear radiance.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

CAMERA = """
scene.camera.type = perspective
scene.camera.lookat.orig = 0 -6 2
scene.camera.lookat.target = 0 0 0.8
scene.camera.fieldofview = 45
"""
ROOM = """
scene.materials.white.type = matte
scene.materials.white.kd = 0.7 0.7 0.6
scene.objects.floor.material = white
scene.objects.floor.vertices = -3 -3 0 3 -3 0 3 3 0 -3 3 0
scene.objects.floor.faces = 0 1 2 0 2 3
scene.objects.wall.material = white
scene.objects.wall.vertices = -3 3 0 3 3 0 3 3 4 -3 3 4
scene.objects.wall.faces = 0 1 2 0 2 3
"""
LAMP = """
scene.materials.shine.type = matte
scene.materials.shine.kd = 0 0 0
scene.materials.shine.emission = 9 8 7
scene.objects.lamp.material = shine
scene.objects.lamp.vertices = -0.7 -0.7 3.5 -0.7 0.7 3.5 0.7 0.7 3.5 0.7 -0.7 3.5
scene.objects.lamp.faces = 0 1 2 0 2 3
"""
BALL = """
scene.objects.ball.material = stuff
scene.objects.ball.ply = ball.ply
"""
MATTE = "scene.materials.stuff.type = matte\nscene.materials.stuff.kd = 0.8 0.3 0.1\n"
MOVED = "1 0 0 0  0 1 0 0  0 0 1 0  {} 0 0 1"
SCENES = {
    "matte": MATTE + BALL + LAMP,
    "glossy": """
scene.materials.stuff.type = glossy2
scene.materials.stuff.kd = 0.2 0.3 0.6
scene.materials.stuff.ks = 0.3 0.3 0.3
scene.materials.stuff.uroughness = 0.1
scene.materials.stuff.vroughness = 0.1
""" + BALL + LAMP,
    "glass": """
scene.materials.stuff.type = glass
scene.materials.stuff.interiorior = 1.5
""" + BALL + LAMP,
    "metal_mix": """
scene.materials.metal.type = metal2
scene.materials.metal.preset = copper
scene.materials.metal.uroughness = 0.1
scene.materials.metal.vroughness = 0.1
scene.materials.dull.type = matte
scene.materials.dull.kd = 0.2 0.5 0.2
scene.materials.stuff.type = mix
scene.materials.stuff.amount = 0.4
scene.materials.stuff.material1 = metal
scene.materials.stuff.material2 = dull
""" + BALL + LAMP,
    "lights": MATTE + BALL + """
scene.lights.dot.type = point
scene.lights.dot.position = -2 -1 3
scene.lights.dot.gain = 20 20 20
scene.lights.dot.id = 0
scene.lights.beam.type = spot
scene.lights.beam.position = 2 -2 4
scene.lights.beam.target = 0 0 1
scene.lights.beam.gain = 300 200 100
scene.lights.beam.coneangle = 25
scene.lights.beam.id = 1
scene.lights.dome.type = constantinfinite
scene.lights.dome.color = 0.1 0.12 0.2
scene.lights.dome.id = 2
scene.lights.dome.visibilitymapcache.enable = 0
""",
    "sky": MATTE + BALL + """
scene.lights.sun.type = sun
scene.lights.sun.dir = 0.4 -0.5 0.7
scene.lights.sun.gain = 0.00002 0.00002 0.00002
scene.lights.sky.type = sky2
scene.lights.sky.dir = 0.4 -0.5 0.7
scene.lights.sky.gain = 0.00002 0.00002 0.00002
""",
    "volume": """
scene.volumes.smoke.type = homogeneous
scene.volumes.smoke.absorption = 0.1 0.2 0.4
scene.volumes.smoke.scattering = 1 1 1
scene.volumes.smoke.multiscattering = 1
scene.materials.stuff.type = null
scene.materials.stuff.volume.interior = smoke
""" + BALL + LAMP,
    "focus": MATTE + BALL + LAMP + """
scene.camera.lensradius = 0.3
scene.camera.focaldistance = 4
scene.camera.autofocus.enable = 0
""",
    "motion": MATTE + BALL + LAMP + f"""
scene.camera.shutteropen = 0
scene.camera.shutterclose = 1
scene.objects.ball.motion.0.time = 0
scene.objects.ball.motion.0.transformation = {MOVED.format(-1)}
scene.objects.ball.motion.1.time = 1
scene.objects.ball.motion.1.transformation = {MOVED.format(1)}
""",
    "transparent": MATTE + "scene.materials.stuff.transparency = 0.5\n" + BALL + LAMP,
    "texture": """
scene.textures.squares.type = checkerboard3d
scene.textures.squares.texture1 = 0.8 0.1 0.1
scene.textures.squares.texture2 = 0.1 0.1 0.8
scene.textures.squares.mapping.type = globalmapping3d
scene.materials.stuff.type = matte
scene.materials.stuff.kd = squares
""" + BALL + LAMP,
    "instances": MATTE + LAMP + "".join(
        f"scene.objects.b{n}.material = stuff\nscene.objects.b{n}.ply = ball.ply\n"
        f"scene.objects.b{n}.transformation = {MOVED.format(1.6 * n - 1.6)}\n"
        for n in range(3)
    ),
}  # fmt: skip
"""Scenes by name, in the room and with the camera of all of them."""
SETTINGS = """
scene.file = {}.scn
film.width = 32
film.height = 24
renderengine.type = PATHCPU
sampler.type = SOBOL
film.filter.type = BLACKMANHARRIS
path.clamping.variance.maxvalue = 10
path.pathdepth.total = 5
batch.haltspp = 100
film.imagepipelines.0.0.type = TONEMAP_LINEAR
film.imagepipelines.0.0.scale = 2
"""


def make(folder: Path) -> None:
    """Write all scenes, each with settings, and the mesh that they share."""
    folder.mkdir(exist_ok=True)
    (folder / "ball.ply").write_text(_ball())
    for name, text in SCENES.items():
        (folder / f"{name}.scn").write_text(CAMERA + ROOM + text)
        (folder / f"{name}.cfg").write_text(SETTINGS.format(name))


def _ball(turns: int = 16, rings: int = 8) -> str:
    """Return a ball of triangles as the text of a PLY file, standing on the floor."""
    phi = np.linspace(0, 2 * np.pi, turns, endpoint=False)
    theta = np.linspace(0, np.pi, rings + 1)[1:-1, np.newaxis]
    x, y = (np.sin(theta) * f(phi) for f in (np.cos, np.sin))
    points = np.stack([x, y, np.broadcast_to(np.cos(theta), x.shape)], -1).reshape(-1, 3)
    points = np.concatenate([points, [[0, 0, 1], [0, 0, -1]]]) * 0.7 + [0, 0, 0.9]
    top, bottom = len(points) - 2, len(points) - 1
    faces = []
    for n in range(turns):
        after = (n + 1) % turns
        faces += [(top, n, after)]
        for ring in range(rings - 2):
            a, b = ring * turns + n, ring * turns + after
            faces += [(a, a + turns, b), (b, a + turns, b + turns)]
        faces += [((rings - 2) * turns + n, bottom, (rings - 2) * turns + after)]
    head = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}", "property list uchar uint vertex_indices", "end_header"]
    lines = [" ".join(f"{v:.6f}" for v in point) for point in points]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    return "\n".join([*head, *lines]) + "\n"


def images(scene: str, folder: str, width: int, height: int, spp: int, count: int) -> None:
    """Render images by the path engine, unclamped and with independent samples."""
    import os

    import pyluxcore as lux

    lux.Init()
    os.chdir(Path(scene).parent)
    loaded = lux.Scene(scene)
    for n in range(count):
        settings = lux.Properties()
        settings.SetFromString(
            f"""
            renderengine.type = PATHCPU
            renderengine.seed = {2**31 + 977 * n}
            sampler.type = RANDOM
            sampler.random.adaptive.strength = 0
            film.filter.type = NONE
            film.width = {width}
            film.height = {height}
            path.pathdepth.total = 5
            path.clamping.variance.maxvalue = 0
            batch.haltspp = {spp}
            film.outputs.0.type = RGB
            film.outputs.0.filename = o.exr
            """
        )
        session = lux.RenderSession(lux.RenderConfig(settings, loaded))
        session.Start()
        while not session.HasDone():
            session.UpdateStats()
        session.Stop()
        image = np.empty((height, width, 3), np.float32)
        session.GetFilm().GetOutputFloat(lux.FilmOutputType.RGB, image, 0, False)
        np.save(Path(folder) / f"{Path(scene).stem}-{n}.npy", image[::-1])


if __name__ == "__main__":
    what, *words = sys.argv[sys.argv.index("--") + 1 :]
    if what == "make":
        make(Path(words[0]))
    else:
        images(*words[:2], *map(int, words[2:]))
