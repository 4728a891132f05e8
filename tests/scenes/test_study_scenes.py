from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from diptest import diptest

from chdstat.rendering.recipes import Recipe, find_recipe
from chdstat.scenes import load_scene
from chdstat.scenes.props.living_room import WINDOWS

BT_709 = np.array([0.212671, 0.715160, 0.072169])
"""Weights of linear sRGB in luminance."""

# What the study scenes were made for, on fixed seeds and few samples. The bounds lie far outside
# what another seed gives, unless a docstring says how far, so a failure means a changed scene.

NULL_SHARES = {
    "caustic": (0.08, 0.2),
    "day-room": (0.1, 0.2),
    "fog": (0.0, 0.1),
    "gallery": (0.1, 0.2),
    "many-lights": (0.0, 0.1),
    "night-room": (0.6, 0.75),
}


def recipe_of(name: str) -> Recipe:
    recipe = find_recipe(name)
    assert recipe is not None
    return recipe


@functools.cache
def source_of(name: str) -> Mapping[str, Any]:
    source = load_scene(name).source
    assert isinstance(source, Mapping)
    return source


@pytest.fixture
def region(draw):
    """Draw samples of a named region of a recipe, shape (y, x, channel, sample)."""

    def render(scene: str, name: str, *, spp: int) -> np.ndarray:
        recipe = recipe_of(scene)
        (found,) = (r for r in recipe.regions if r.name == name)
        ys, xs = found.pixels(recipe.size[1], recipe.size[0])
        crop = (xs.start, ys.start, xs.stop, ys.stop)
        return draw(source_of(scene), size=recipe.size[0], spp=spp, crop=crop)

    return render


@pytest.mark.parametrize(("name", "bounds"), NULL_SHARES.items())
def test_the_share_of_nulls_is_as_promised(draw, name, bounds):
    """Of 24 576 samples; the means of pixels vary more than they, but less than 0.01 over seeds."""
    x = draw(source_of(name), size=32, spp=24)
    assert np.isfinite(x).all()
    assert (x >= 0).all()
    assert bounds[0] < (x == 0).all(axis=-2).mean() < bounds[1]


def test_day_and_night_share_the_room_and_its_camera():
    day, night = (source_of(name) for name in ("day-room", "night-room"))
    outside = {"sun", "night", *(f"sky-{i}" for i in range(len(WINDOWS)))}
    bulbs = {"floor-lamp-bulb", "table-lamp-bulb"}
    assert set(day) ^ set(night) == outside
    alike = set(day) - outside - bulbs
    rooms = [load_scene({"type": "scene", **{k: s[k] for k in alike}}) for s in (day, night)]
    assert rooms[0].hash == rooms[1].hash
    assert {"emitter"} == set(night["floor-lamp-bulb"]) - set(day["floor-lamp-bulb"])


def test_the_day_has_a_red_cast(draw):
    x = draw(source_of("day-room"), size=16, spp=12)
    red, green, blue = np.median(x.mean(axis=-1), axis=(0, 1))
    assert red > 1.5 * green > 1.5 * blue


def test_by_night_all_light_comes_from_the_lamps(draw):
    night = source_of("night-room")
    dark = {k: {**v} if isinstance(v, dict) else v for k, v in night.items()}
    for name in ("floor-lamp-bulb", "table-lamp-bulb"):
        del dark[name]["emitter"]
    assert (draw(dark, size=16, spp=16) == 0).all()


def test_shades_are_bright_and_the_wall_behind_them_has_the_longer_tail(region):
    shade, wall = (
        BT_709 @ region("night-room", name, spp=64) for name in ("floor-lamp", "shaded-wall")
    )
    assert shade.mean() > 10 * wall.mean()
    assert wall.std() / wall.mean() > 2 * shade.std() / shade.mean()


def test_the_gallery_is_symmetric_and_neutral_but_for_its_lamps(draw):
    gallery = source_of("gallery")
    white = {k: v for k, v in gallery.items() if not k.startswith("lamp-")}
    x = draw(white, size=32, spp=32).mean(axis=-1)
    np.testing.assert_allclose(x[:, :16].mean(), x[:, 16:].mean(), rtol=0.1)
    assert np.ptp(x.mean(axis=(0, 1))) < 0.1 * x.mean()


def test_yellow_lamps_are_rare_and_bright(region):
    x = region("gallery", "under-lamps", spp=192)
    light = BT_709 @ x
    yellow = (x[:, :, 0] > 3 * x[:, :, 2]) & (light > 20 * light.mean())
    assert 1e-4 < yellow.mean() < 1e-2


def test_the_terrace_has_a_hundred_lights_and_more():
    entries = source_of("many-lights").values()
    lights = [e for e in entries if isinstance(e, dict) and "emitter" in e]
    colors = {tuple(e["emitter"]["radiance"]["value"]) for e in lights}
    assert len(lights) > 100
    assert len(colors) >= 8


@pytest.mark.parametrize(("scene", "pair"), [("day-room", "pane"), ("caustic", "field")])
def test_a_dark_and_a_pale_field_differ_in_radiance_not_in_relative_spread(region, scene, pair):
    dark, pale = (BT_709 @ region(scene, f"{pair}-{tone}", spp=64) for tone in ("dark", "pale"))
    assert pale.mean() > 8 * dark.mean()
    quartiles = [np.quantile(x[x > 0], [0.25, 0.75]) for x in (dark, pale)]
    ratio = [high / low for low, high in quartiles]
    np.testing.assert_allclose(ratio[0], ratio[1], rtol=0.35)


def test_the_caustic_is_made_of_few_bright_samples(region):
    """Half of the light in fewer than a twelfth of the samples; on the open cloth in a third."""
    share = {}
    for name in ("crystal-focus", "field-pale"):
        x = np.sort(BT_709 @ region("caustic", name, spp=128), axis=None)[::-1]
        share[name] = np.searchsorted(np.cumsum(x), x.sum() / 2) / x.size
    assert share["crystal-focus"] < 1 / 12
    assert share["field-pale"] > 1 / 6


def test_the_shadow_of_the_ring_ends_in_a_penumbra(region):
    """Dip test (Hartigan 1985) of log luminance; the open cloth is the negative control."""
    edge = BT_709 @ region("caustic", "ring-shadow", spp=128)
    assert diptest(np.log(edge[edge > 0]))[1] < 1e-3


def test_fog_scatters_light_where_clear_air_has_none(draw):
    fog = source_of("fog")
    unlit = {"dawn", "sky"}
    lamps = {k: v for k, v in fog.items() if k not in unlit}
    haze = {**fog["haze"], "sigma_t": 1e-6}
    above = (12, 0, 20, 8)
    foggy = draw(lamps, size=32, spp=32, crop=above)
    clear = draw({**lamps, "haze": haze}, size=32, spp=32, crop=above)
    assert foggy.mean() > 20 * clear.mean()
