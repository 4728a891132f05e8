from __future__ import annotations

import numpy as np
import pytest

from chdstat.scenes.props import furniture, living_room
from chdstat.scenes.props.furniture import camera, paving
from chdstat.scenes.props.shapes import quad
from chdstat.scenes.props.textures import matte, rgb
from chdstat.scenes.scene import look_at, rotate, scale, translate

# Known answers are irradiances from the geometry of the source: what a white matte floor under it
# reflects in all directions is E / pi (Pharr, Jakob, Humphreys 2023, section 4.1).

WHITE = matte(rgb(1.0, 1.0, 1.0))


def floor_under(draw, light, *, spp: int = 64) -> np.ndarray:
    """Mean radiance of a small patch of white floor at the origin, seen from aside."""
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": camera((3.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov=0.05),
        "floor": quad((-5, -5, 0), (10, 0, 0), (0, 10, 0)).shape(WHITE),
        "light": light,
    }
    return draw(scene, size=8, spp=spp).mean(axis=(0, 1, 3))


def test_a_spot_lights_what_it_looks_at(draw):
    """E of a disk of radius r at height h on its axis is pi L r^2 / (r^2 + h^2); 1 in 1e6 fails."""
    light = furniture.spot((0.0, 1e-3, 2.0), (0.0, 0.0, 0.0), 0.5, rgb(4.0, 2.0, 1.0))
    np.testing.assert_allclose(floor_under(draw, light), np.array([4, 2, 1]) / 17, rtol=0.03)


def test_a_bulb_lights_all_round(draw):
    """E of a ball of radius r at distance d overhead is pi L (r / d)^2."""
    light = furniture.bulb((0.0, 0.0, 2.0), 0.2, rgb(100.0, 100.0, 100.0))
    np.testing.assert_allclose(floor_under(draw, light), 1.0, rtol=0.03)


def test_a_panel_shines_to_one_side(draw):
    panel = quad((-0.5, 0.5, 2.0), (1, 0, 0), (0, -1, 0))
    assert floor_under(draw, furniture.glow(panel, rgb(1.0, 1.0, 1.0)), spp=4).min() > 0.01
    away = panel.moved(translate(0, 0, 4.0) @ rotate("x", 180))
    assert floor_under(draw, furniture.glow(away, rgb(1.0, 1.0, 1.0)), spp=4).max() == 0


def test_a_lamp_without_light_has_no_emitter():
    shade = rgb(0.9, 0.8, 0.6)
    parts = [
        furniture.lamp(translate(1, 2, 3), "lamp", height=1.5, shade=shade, light=light)
        for light in (None, rgb(9.0, 8.0, 7.0))
    ]
    assert parts[0].keys() == parts[1].keys()
    assert "emitter" not in parts[0]["lamp-bulb"]
    assert parts[1]["lamp-bulb"]["center"] == pytest.approx([1.0, 2.0, 4.35])


def test_a_camera_stands_where_it_is_put():
    entry = camera((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), fov=40.0)
    np.testing.assert_array_equal(entry["to_world"], look_at((1, 2, 3), (4, 5, 6)))
    assert entry["film"]["rfilter"] == {"type": "box"}


def test_paving_covers_its_place_less_the_joints():
    colors = (0.1, 0.1, 0.1), (0.6, 0.6, 0.6)
    entry = paving((-1.0, 2.0), (4, 6), colors, edge=0.5, roughness=0.1)
    low, high = entry["vertices"].min(axis=0), entry["vertices"].max(axis=0)
    np.testing.assert_allclose(low, [-1 + 0.006, 2 + 0.006, 0], atol=1e-6)
    np.testing.assert_allclose(high, [1 - 0.006, 5 - 0.006, 0.004], atol=1e-6)


def test_a_pad_is_a_block_with_its_edges_taken_off():
    mesh = living_room.pad(0.6, 0.5, 0.2, radius=0.05)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.6, 0.5, 0.2], atol=1e-9)
    assert 0.85 * 0.06 < mesh.volume < 0.06
    smaller = mesh.moved(scale(0.5, 0.5, 0.5))
    assert smaller.volume == pytest.approx(mesh.volume / 8)
