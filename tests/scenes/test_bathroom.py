from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from diptest import diptest

from chdstat.scenes import load_scene
from chdstat.scenes.props import shapes
from chdstat.scenes.props.textures import matte, rgb

BT_709 = np.array([0.212671, 0.715160, 0.072169])
"""Weights of linear sRGB in luminance."""

# What the scene was made for, on fixed seeds. Bounds lie far outside what another seed gives (the
# null share of 65 536 samples has a standard error of 0.002), so a failure means a changed scene.

RECIPE = tomllib.loads((Path(__file__).parents[2] / "renders" / "bathroom.toml").read_text())
REGIONS = {region["name"]: region for region in RECIPE["regions"]}
SIZE = RECIPE["size"][0]


@pytest.fixture
def region(draw):
    """Draw luminance samples of a named region of the recipe, shape (y, x, sample)."""

    def render(name: str, *, spp: int = 256) -> np.ndarray:
        rectangle = np.array(REGIONS[name]["rectangle"]) * SIZE
        crop = tuple(rectangle.round().astype(int).tolist())
        return BT_709 @ draw(load_scene("bathroom").source, size=SIZE, spp=spp, crop=crop)

    return render


def log_of_non_nulls(x: np.ndarray) -> np.ndarray:
    return np.log10(x[x > 0])


def test_more_than_half_of_the_samples_are_null(draw):
    x = draw(load_scene("bathroom").source, size=32, spp=64)
    assert 0.52 < (x == 0).all(axis=-2).mean() < 0.62
    assert np.isfinite(x).all()
    assert 0.2 < x.mean() < 0.5


def test_all_light_comes_through_the_window(draw):
    scene = load_scene("bathroom").source
    shutter = shapes.quad((0.001, 1.4, 0.8), (0, 2.0, 0), (0, 0, 1.6)).shape(matte(rgb(0, 0, 0)))
    assert (draw({**scene, "shutter": shutter}, size=64, spp=32) == 0).all()


def test_the_penumbra_is_bimodal_and_the_wall_is_not(region):
    # Dip test (Hartigan 1985) of log luminance; the wall is the negative control. Over seeds the
    # p-value of the penumbra stays below 1e-6.
    assert diptest(log_of_non_nulls(region("floor-shadow")))[1] < 1e-3
    assert diptest(log_of_non_nulls(region("wall")))[1] > 0.05


def test_indirect_light_is_null_more_often_than_direct(region):
    under, sunlit = (region(name) == 0 for name in ("under-vanity", "tub-sunlit"))
    assert under.mean() > 0.7
    assert sunlit.mean() < 0.5


def test_indirect_light_has_the_longer_tail(region):
    spread = {name: region(name) for name in ("under-vanity", "tub-sunlit")}
    relative = {name: x.std() / x.mean() for name, x in spread.items()}
    assert relative["under-vanity"] > 2 * relative["tub-sunlit"]


def test_wood_shifts_the_channels_apart(draw):
    crop = tuple((np.array(REGIONS["vanity"]["rectangle"]) * SIZE).round().astype(int).tolist())
    red, green, blue = draw(load_scene("bathroom").source, size=SIZE, spp=64, crop=crop).mean(
        axis=(0, 1, 3)
    )
    assert red > 1.5 * green > 1.5 * 1.5 * blue


def test_fireflies_are_rare_and_far_above_the_mean(region):
    share = {}
    for name in ("behind-tub", "wall"):
        x = region(name, spp=512)
        share[name] = (x > 100 * x.mean()).mean()
    assert 1e-4 < share["behind-tub"] < 1e-2
    assert share["wall"] < 1e-4


@pytest.mark.parametrize("name", REGIONS)
def test_regions_lie_inside_the_image_and_hold_some_pixels(name):
    left, top, right, bottom = REGIONS[name]["rectangle"]
    assert 0 <= left < right <= 1
    assert 0 <= top < bottom <= 1
    assert (right - left) * (bottom - top) * SIZE**2 >= 6


def test_region_names_are_unique():
    assert len(REGIONS) == len(RECIPE["regions"])
