"""Scenes of plain values: meshes, bitmaps and transforms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from chdstat.errors import SceneError
from chdstat.scenes import Scene
from tests.matrices import look_at

# Below a sky of radiance 1, a diffuse plane that sees all of it has its reflectance as radiance.


def plane_below_sky(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {
            "type": "perspective",
            "fov": 10.0,
            # Seen from above with y upwards, x runs to the right.
            "to_world": look_at((0.5, 0.5, 5.0), (0.5, 0.5, 0.0), up=(0, 1, 0)),
            "film": {"type": "hdrfilm", "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
        "sky": {"type": "constant"},
        "plane": {
            "type": "mesh",
            "vertices": np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
            "faces": np.uint32([[0, 1, 2], [0, 2, 3]]),
            "uv": np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]),
            "bsdf": bsdf,
        },
    }


def test_bitmaps_are_linear_and_upright(draw):
    image = np.float32([[[0.8, 0.2, 0.1], [0.1, 0.7, 0.3]], [[0.5, 0.5, 0.5], [0.05, 0.1, 0.2]]])
    bitmap = {"type": "bitmap", "data": image, "filter_type": "nearest"}
    x = draw(plane_below_sky({"type": "diffuse", "reflectance": bitmap}), size=4, spp=1024)
    # Rows of the image run along v, which is upwards here. All channels share one random factor
    # of mean 1, whose standard error at 4 x 1024 samples is below 0.02: 5 of them.
    quarters = x.mean(axis=-1).reshape(2, 2, 2, 2, 3).mean(axis=(1, 3))[::-1]
    np.testing.assert_allclose(quarters, image, rtol=0.1)
    ratio = quarters / quarters[..., :1]
    np.testing.assert_allclose(ratio, image / image[..., :1], rtol=1e-4)


def test_a_mesh_can_shine(draw):
    scene = plane_below_sky({"type": "diffuse"})
    del scene["sky"]
    radiance = {"type": "rgb", "value": [1.0, 2.0, 3.0]}
    scene["plane"] |= {"emitter": {"type": "area", "radiance": radiance}}
    x = draw(scene, size=4, spp=2)
    np.testing.assert_allclose(x, np.broadcast_to([[1.0], [2.0], [3.0]], x.shape), rtol=1e-6)


def test_shading_normals_reach_the_renderer(draw):
    # Normals tilted away from the only light (a distant one, straight above) darken by the cosine.
    scene = plane_below_sky({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}})
    scene["sky"] = {"type": "directional", "direction": [0.0, 0.0, -1.0]}
    flat = draw(scene, size=2, spp=1)
    tilt = np.deg2rad(60.0)
    normals = np.tile(np.float32([np.sin(tilt), 0.0, np.cos(tilt)]), (4, 1))
    scene["plane"] |= {"normals": normals}
    np.testing.assert_allclose(draw(scene, size=2, spp=1), flat / 2, rtol=1e-5)


def test_a_failed_scene_leaves_no_lone_light(draw):
    # While an error is held, as notebooks do, such a light would end the process in later renders.
    from chdstat.scenes.parsing import parse

    scene = plane_below_sky({"type": "diffuse"})
    scene["lamp"] = {"type": "sphere", "emitter": {"type": "area"}}
    scene["plane"] = {"type": "ply", "filename": "missing.ply"}
    parsed = parse(Scene("broken", scene))
    held = [parsed.references(i) for i in range(len(parsed.nodes))]
    with pytest.raises(SceneError, match="missing.ply"):
        parsed.make()
    assert held == [parsed.references(i) for i in range(len(parsed.nodes))]
