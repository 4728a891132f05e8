"""Scenes of many materials and meshes render: none of them ends the process.

Scenes of the well-known collections have hundreds of materials, most with several meshes. Each
render has a process of its own, so that one that ends is a failing test.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.matrices import translate

_CHILD = """
import json, sys
import numpy as np
import mitsuba as mi
import chdstat as chd
from tests.scenes.test_many_parts import WRITTEN

materials, meshes, form, folder = sys.argv[1:]
scene = WRITTEN[form](int(materials), int(meshes), folder)
samples = chd.render(scene, spp=1, size=(4, 3), seed=1, backend="scalar", progress=False)
mi.set_variant("scalar_rgb")
faces = [shape.face_count() for shape in chd.load_scene(scene).load().shapes()]
print(json.dumps([samples.read().ravel().tolist(), faces]))
"""


def as_dict(materials: int, meshes: int, folder: str = "") -> dict[str, Any]:
    """Return a scene of some materials, no two alike, each of some cubes."""
    del folder
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {"type": "perspective", "to_world": translate(0.0, 0.0, -4.0)},
        "sky": {"type": "constant"},
    }
    for i in range(materials):
        share = (i + 1) / (materials + 1)
        scene[f"material_{i}"] = {"type": "diffuse", "id": f"m{i}", "reflectance": share}
        for j in range(meshes):
            place = translate(3.0 * j - 1.5, 2.0 * share, 5.0 * share)
            scene[f"cube_{i}_{j}"] = {
                "type": "cube",
                "to_world": place,
                "bsdf": {"type": "ref", "id": f"m{i}"},
            }
    return scene


def as_xml(materials: int, meshes: int, folder: str) -> str:
    """Write the same scene as XML, and return its path."""
    lines = [
        "<scene version='3.0.0'><integrator type='path'>",
        "<integer name='max_depth' value='3'/></integrator><sensor type='perspective'>",
        "<transform name='to_world'><translate z='-4'/></transform></sensor>",
        "<emitter type='constant'/>",
    ]
    for i in range(materials):
        share = (i + 1) / (materials + 1)
        reflectance = f"<spectrum name='reflectance' value='{share}'/>"
        lines.append(f"<bsdf type='diffuse' id='m{i}'>{reflectance}</bsdf>")
        for j in range(meshes):
            place = f"<translate x='{3.0 * j - 1.5}' y='{2.0 * share}' z='{5.0 * share}'/>"
            place = f"<transform name='to_world'>{place}</transform>"
            lines.append(f"<shape type='cube'>{place}<ref id='m{i}'/></shape>")
    path = Path(folder, "many.xml")
    path.write_text("\n".join([*lines, "</scene>"]), encoding="utf-8")
    return str(path)


WRITTEN = {"dict": as_dict, "xml": as_xml}


@pytest.mark.parametrize(
    ("materials", "meshes"),
    [
        (10, 200),
        (2000, 2),
        *(pytest.param(*few, marks=pytest.mark.slow) for few in [(10, 2), (24, 3), (40, 2)]),
    ],
)
def test_scenes_of_many_parts_render(tmp_path, materials, meshes):
    # Mitsuba's own loader makes one mesh of each material, too.
    drawn = {}
    for form in WRITTEN:
        command = [sys.executable, "-c", _CHILD, str(materials), str(meshes), form, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (form, done.returncode, done.stderr[-2000:])
        drawn[form], faces = json.loads(done.stdout)
        assert faces == [12 * meshes] * materials
    assert max(drawn["dict"]) > 0
    np.testing.assert_allclose(drawn["dict"], drawn["xml"], rtol=1e-5)
