"""Absurd scenes are refused in words: Mitsuba, given them, would end the process.

All are rendered in one child process, so that one that ends is a failing test.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import ChdstatError
from chdstat.rendering.backend import activate, probe

Part = dict[str, Any]

CORNERS = np.array([[0, 0, 4], [1, 0, 4], [0, 1, 4]], np.float32)
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 4\n1 0 4\n0 1 4\n3 0 1 "
)


def mesh(**changes: Any) -> Part:
    return {"type": "mesh", "vertices": CORNERS, "faces": [[0, 1, 2]], **changes}


def lamp(shape: Part) -> Part:
    return {**shape, "emitter": {"type": "area"}}


def textured(**texture: Any) -> Part:
    reflectance = {"type": "bitmap", "raw": True, **texture}
    return {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def fog(**grid: Any) -> Part:
    medium = {"type": "heterogeneous", "sigma_t": {"type": "gridvolume", **grid}}
    return {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}


def serialized(indices: list[int]) -> bytes:
    """Return a file of one triangle."""
    body = struct.pack("<I", 0x1000) + b"name\0" + struct.pack("<QQ", 3, 1) + CORNERS.tobytes()
    packed = zlib.compress(body + np.array(indices, np.uint32).tobytes())
    return struct.pack("<HH", 0x041C, 4) + packed + struct.pack("<QI", 0, 1)


def grid(x: int, y: int, z: int, channels: int, values: int) -> bytes:
    box = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    header = b"VOL\3" + struct.pack("<5i6f", 1, x, y, z, channels, *box)
    return header + np.ones(values, np.float32).tobytes()


def chain(count: int) -> Part:
    """Return parts that each hold the one before."""
    parts: Part = {"m0": {"type": "diffuse", "id": "m0"}}
    for i in range(1, count):
        inner = {"type": "ref", "id": f"m{i - 1}"}
        parts[f"m{i}"] = {"type": "mask", "id": f"m{i}", "inner": inner}
    return {**parts, "ball": {"type": "sphere", "bsdf": {"type": "ref", "id": f"m{count - 1}"}}}


FILES = {
    "huge.ply": f"{PLY}2000000000\n".encode(),
    "beyond.ply": f"{PLY}3\n".encode(),
    "good.ply": f"{PLY}2\n".encode(),
    "huge.serialized": serialized([0, 1, 2_000_000_000]),
    "good.serialized": serialized([0, 1, 2]),
    "empty.vol": grid(0, 0, 0, 1, 0),
    "huge.vol": grid(2**30, 2**30, 2**30, 1, 1),
    "good.vol": grid(2, 2, 2, 1, 8),
    "empty.pfm": b"PF\n0 0\n-1.0\n",
    "empty.ppm": b"P6\n0 0\n255\n",
    "empty.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 0 +X 0\n",
    "good.pfm": b"Pf\n1 1\n-1.0\n" + np.float32(0.5).tobytes(),
}
GOOD = "rendered"


def scenes(mi: Any) -> dict[str, tuple[Part, str]]:
    """Return parts of scenes, and what is said of them."""
    nothing = np.zeros((0, 2, 3), np.float32)
    beyond = "numbers of its vertices, from 0 to 2, got "
    return {
        "faces beyond": ({"m": mesh(faces=[[0, 1, 3]])}, f"{beyond}3"),
        "faces below": ({"m": mesh(faces=[[0, 1, -1]])}, f"{beyond}-1"),
        "faces between": ({"m": mesh(faces=[[0, 1, 0.5]])}, f"{beyond}0.5"),
        "faces of four": ({"m": mesh(faces=[[0, 1, 2, 0]])}, "shape (n, 3), got shape (1, 4)"),
        "no faces": ({"m": mesh(faces=np.zeros((0, 3)))}, "shape (n, 3), got shape (0, 3)"),
        "flat vertices": ({"m": lamp(mesh(vertices=CORNERS[0]))}, "got shape (3,)"),
        "empty vertices": ({"m": lamp(mesh(vertices=CORNERS[:0]))}, "got shape (0, 3)"),
        "text": ({"m": mesh(vertices="x")}, "must be numbers"),
        "one normal": ({"m": mesh(normals=CORNERS[:1])}, "each of its 3 vertices, got 1"),
        "flat uv": ({"m": mesh(uv=[0.0] * 6)}, "shape (n, 2), got shape (6,)"),
        "mesh": ({"m": lamp(mesh(normals=CORNERS, uv=CORNERS[:, :2]))}, GOOD),
        "empty texture": (
            {"b": textured(data=nothing)},
            "got a ndarray of shape (0, 2, 3)",
        ),
        "empty bitmap": ({"b": textured(bitmap=mi.Bitmap(nothing))}, "a Bitmap of shape"),
        "empty sky": ({"e": {"type": "envmap", "bitmap": mi.Bitmap(nothing)}}, "a Bitmap of shape"),
        "empty tensor": ({"b": textured(data=mi.TensorXf(nothing))}, "TensorXf of shape (0, 2, 3)"),
        "empty grid": ({"f": fog(data=mi.TensorXf(nothing))}, "TensorXf of shape (0, 2, 3)"),
        "number": ({"m": {"type": "ellipsoids", "data": mi.TensorXf(1.0)}}, "TensorXf of shape ()"),
        "texture": ({"b": textured(data=np.ones((1, 1, 3)))}, GOOD),
        "blender": ({"m": {"type": "blender", "vertices": 1}}, "reads the memory of Blender"),
        "surrogate": ({"\ud800": {"type": "sphere"}}, "cannot read the scene"),
        "deep": (chain(20_000), "nested more than 1000 deep"),
        "as deep": (chain(100), GOOD),
        **{
            name: ({"m": lamp({"type": name.split(".")[1], "filename": name})}, words)
            for name, words in {
                "huge.ply": "faces name the vertex 2000000000, of 3 from 0 on",
                "beyond.ply": "faces name the vertex 3, of 3 from 0 on",
                "good.ply": GOOD,
                "huge.serialized": "faces name the vertex 2000000000, of 3 from 0 on",
                "good.serialized": GOOD,
            }.items()
        },
        "empty.vol": ({"f": fog(filename="empty.vol")}, "0 x 0 x 0 values in 1 channels"),
        "huge.vol": ({"f": fog(filename="huge.vol")}, "1073741824 x 1073741824 x 1073741824"),
        "empty.vol distances": ({"f": {"type": "sdfgrid", "filename": "empty.vol"}}, "0 x 0 x 0"),
        "good.vol": ({"f": fog(filename="good.vol")}, GOOD),
        "empty.pfm": ({"b": textured(filename="empty.pfm")}, "an image of 0 x 0 pixels"),
        "empty.ppm": ({"b": textured(filename="empty.ppm")}, "an image of 0 x 0 pixels"),
        "empty.hdr": ({"b": textured(filename="empty.hdr")}, "an image of 0 x 0 pixels"),
        "good.pfm": ({"b": textured(filename="good.pfm")}, GOOD),
    }


def tell_fates(folder: str, backend: str) -> None:
    """Print what is said of each scene."""
    with activate(probe(backend)) as mi:
        tried = scenes(mi)
    told = {}
    for name, (parts, _) in tried.items():
        scene = {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 3},
            "sensor": {"type": "perspective"},
            "files": {"type": "resources", "path": folder},
            **parts,
        }
        try:
            chd.render(scene, spp=1, size=(2, 2), backend=backend, progress=False)
            told[name] = GOOD
        except ChdstatError as error:
            told[name] = str(error)
    sys.stdout.write(json.dumps(told))


@pytest.fixture(scope="module")
def fates(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("files")
    for name, content in FILES.items():
        Path(folder, name).write_bytes(content)
    code = "import sys; from tests.scenes.test_faults import tell_fates; tell_fates(*sys.argv[1:])"
    command = [sys.executable, "-c", code, str(folder), "scalar"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.returncode, done.stderr[-3000:])
    return dict(json.loads(done.stdout))


def test_absurd_scenes_are_refused_in_words(fates):
    with activate(probe("scalar")) as mi:
        expected = {name: words for name, (_, words) in scenes(mi).items()}
    wrong = {n: (fates[n], words) for n, words in expected.items() if words not in fates[n]}
    assert not wrong


def test_a_scene_follows_no_later_changes(wavefront):
    vertices, faces = CORNERS.copy(), np.array([[0, 1, 2]], np.uint32)
    with activate(probe(wavefront)) as mi:
        built = chd.load_scene({"type": "scene", "m": mesh(vertices=vertices, faces=faces)}).load()
        vertices[:], faces[:] = 7, 0
        held = mi.traverse(built.shapes()[0])
        assert np.array_equal(np.array(held["vertex_positions"]), CORNERS.ravel())
        assert np.array_equal(np.array(held["faces"]), [0, 1, 2])
        del built, held
