from __future__ import annotations

import numpy as np
import pytest

from chdstat.scenes.props import textures

DARK, LIGHT = (0.1, 0.05, 0.02), (0.4, 0.25, 0.1)

IMAGES = {
    "wood": lambda: textures.wood(DARK, LIGHT, seed=3),
    "planks": lambda: textures.planks(DARK, LIGHT, seed=3),
    "tiles": lambda: textures.tile_colors([DARK, LIGHT], columns=5, seed=3),
    "checks": lambda: textures.checks(DARK, LIGHT, rows=4, columns=6),
    "gradient": lambda: textures.gradient([(0.0, DARK), (1.0, LIGHT)]),
    "panes": lambda: textures.panes([[DARK, LIGHT], [LIGHT, LIGHT]]),
    "bands": lambda: textures.bands(DARK, LIGHT, edges=[(0.25, 0.5)]),
}


@pytest.mark.parametrize("name", IMAGES)
def test_textures_are_reflectances_and_repeat(name):
    image = IMAGES[name]()
    assert image.dtype == np.float32
    assert image.shape[2] == 3
    assert image.min() >= 0
    assert image.max() <= 1
    np.testing.assert_array_equal(image, IMAGES[name]())


def test_wood_lies_between_its_colours_and_differs_by_seed():
    image = textures.wood(DARK, LIGHT, seed=1)
    assert (image >= np.float32(DARK) - 1e-3).all()
    assert (image <= np.float32(LIGHT) + 1e-3).all()
    assert not np.array_equal(image, textures.wood(DARK, LIGHT, seed=2))


def test_wood_varies_across_the_grain_more_than_along_it():
    red = textures.wood(DARK, LIGHT, seed=1)[..., 0]
    assert np.abs(np.diff(red, axis=0)).mean() > 5 * np.abs(np.diff(red, axis=1)).mean()


def test_planks_keep_the_size_asked_for_when_boards_do_not_divide_it():
    assert textures.planks(DARK, LIGHT, rows=7, size=(100, 64)).shape == (100, 64, 3)


def test_a_band_covers_its_share_of_the_height():
    image = textures.bands((0, 0, 0), (1, 1, 1), edges=[(0.25, 0.5)])
    assert (image[..., 0] > 0).mean() == pytest.approx(0.25)


def test_tile_colours_stay_within_their_spread():
    image = textures.tile_colors([DARK, LIGHT], columns=200, spread=0.1, seed=0)
    ratio = image / np.float32([DARK, LIGHT])[:, None]
    assert 0.89 < ratio.min() < 0.95
    assert 1.05 < ratio.max() < 1.11


def test_checks_alternate_and_begin_dark():
    image = textures.checks((0, 0, 0), (1, 1, 1), rows=2, columns=3)[..., 0]
    np.testing.assert_array_equal(image, [[0, 1, 0], [1, 0, 1]])


def test_a_gradient_passes_through_its_stops():
    image = textures.gradient([(0.0, (0, 0, 0)), (0.5, (1, 0, 0)), (1.0, (1, 1, 0))], rows=400)
    np.testing.assert_allclose(
        image[[0, 200, 399], 0], [[0, 0, 0], [1, 0, 0], [1, 1, 0]], atol=0.01
    )
    assert (np.diff(image[:, 0].sum(axis=-1)) >= 0).all()


def test_light_is_a_gradient_that_may_exceed_one():
    entry = textures.light([(0.0, (0.5, 0.5, 0.5)), (1.0, (1, 1, 1))], 8.0)
    assert entry["raw"]
    assert entry["data"].max() == pytest.approx(8.0, rel=0.01)
