"""Built-in scenes: what they are made of, and what they were made to show.

Shares and spreads are of fixed seeds and few samples. The bounds lie far outside what another seed
gives, so that a failure means a changed scene.
"""

from __future__ import annotations

import functools
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diptest import diptest

from chdstat.rendering.recipes import find_recipe
from chdstat.scenes import BUILTIN, builtin, load_scene
from tests.luminance import LUMINANCE

IDENTITIES = {
    "bathroom": "f799da4d",
    "caustic": "4eb7885b",
    "cornell-box": "fde6f84c",
    "day-room": "1332d35a",
    "fog": "ab44f1d3",
    "gallery": "21ccb0d1",
    "many-lights": "0dc7bc90",
    "night-room": "c4569b7d",
}
"""The first digits of hashes of scenes that stores, and figures in the documentation, are of."""
NULL_SHARES = {
    "bathroom": (0.52, 0.62),
    "caustic": (0.08, 0.2),
    "day-room": (0.1, 0.2),
    "fog": (0.0, 0.1),
    "gallery": (0.1, 0.2),
    "many-lights": (0.0, 0.1),
    "night-room": (0.6, 0.75),
}


@functools.cache
def source_of(name: str) -> Any:
    return load_scene(name).source


@pytest.fixture
def region(draw):
    """Draw samples of a named region of a recipe, shape (y, x, channel, sample)."""

    def render(name: str, part: str, *, spp: int) -> np.ndarray:
        recipe = find_recipe(name)
        assert recipe is not None
        (found,) = (r for r in recipe.regions if r.name == part)
        ys, xs = found.pixels(recipe.size[1], recipe.size[0])
        crop = (xs.start, ys.start, xs.stop, ys.stop)
        return draw(source_of(name), size=recipe.size[0], spp=spp, crop=crop)

    return render


def test_scenes_are_what_they_were():
    assert {name: load_scene(name).hash[:8] for name in IDENTITIES} == IDENTITIES


def test_the_tool_makes_their_meshes_and_textures(monkeypatch):
    tools = Path(__file__).parents[2] / "tools"
    monkeypatch.syspath_prepend(tools)
    made = runpy.run_path(str(tools / "make_scenes.py"))["made"]()
    with np.load(Path(builtin.__file__).parent / "arrays.npz") as held:
        assert list(made) == held.files
        for name in held.files:
            np.testing.assert_array_equal(made[name], held[name], err_msg=name)


@pytest.mark.parametrize("name", BUILTIN)
def test_every_scene_renders_with_light_and_its_share_of_nulls(name, draw):
    """Of 24 576 samples; the means of pixels vary more than they, but less than 0.01 over seeds."""
    x = draw(source_of(name), size=32, spp=24)
    assert np.isfinite(x).all()
    assert (x >= 0).all()
    assert (x.max(axis=(2, 3)) > 0).mean() > 0.8
    assert 0.05 < x.mean() < 1.0
    low, high = NULL_SHARES.get(name, (0, 1))
    assert low <= (x == 0).all(axis=-2).mean() < high


def test_all_light_comes_through_the_window_of_the_bathroom(draw):
    """A black shutter before it leaves the room dark."""
    place = np.array([[0, 0, 1, 0.001], [1, 0, 0, 2.4], [0, 0.8, 0, 1.6], [0, 0, 0, 1]], float)
    black = {"type": "diffuse", "reflectance": 0.0}
    shutter = {"type": "rectangle", "to_world": place, "bsdf": black}
    assert (draw({**source_of("bathroom"), "shutter": shutter}, size=64, spp=32) == 0).all()


def test_the_penumbra_is_bimodal_and_the_wall_is_not(region):
    """Dip test (Hartigan 1985) of log luminance: the penumbra's p stays below 1e-6 over seeds."""
    x = {name: LUMINANCE @ region("bathroom", name, spp=256) for name in ("floor-shadow", "wall")}
    found = {name: diptest(np.log10(values[values > 0]))[1] for name, values in x.items()}
    assert found["floor-shadow"] < 1e-3
    assert found["wall"] > 0.05


def test_day_and_night_share_the_room_and_its_camera():
    day, night = (source_of(name) for name in ("day-room", "night-room"))
    outside = {"sun", "night", "sky-0", "sky-1", "sky-2"}
    bulbs = {"floor-lamp-bulb", "table-lamp-bulb"}
    assert set(day) ^ set(night) == outside
    alike = set(day) - outside - bulbs
    rooms = [load_scene({"type": "scene", **{k: s[k] for k in alike}}) for s in (day, night)]
    assert rooms[0].hash == rooms[1].hash
    assert {"emitter"} == set(night["floor-lamp-bulb"]) - set(day["floor-lamp-bulb"])


def test_fog_scatters_light_where_clear_air_has_none(draw):
    fog = source_of("fog")
    lamps = {k: v for k, v in fog.items() if k not in ("dawn", "sky")}
    above = (12, 0, 20, 8)
    foggy = draw(lamps, size=32, spp=32, crop=above)
    clear = draw({**lamps, "haze": {**fog["haze"], "sigma_t": 1e-6}}, size=32, spp=32, crop=above)
    assert foggy.mean() > 20 * clear.mean()
