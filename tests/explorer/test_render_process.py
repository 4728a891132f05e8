"""The renderer in a process of its own."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import RenderError, SceneError
from chdstat.explorer.render_process import RenderProcess
from chdstat.explorer.scene_source import SceneSource
from chdstat.rendering.job import Job
from chdstat.rendering.renderer import Renderer

PIXELS = np.array([[8, 12], [3, 5]])


@pytest.fixture
def job():
    return Job.of(chd.load_scene("cornell-box"), size=(24, 16), backend="scalar")


def test_it_draws_what_the_renderer_draws(job):
    render = RenderProcess(job)
    try:
        assert render.size == (24, 16)
        assert render.integrator == "path"
        drawn = [render("pixels", PIXELS, 8, seed=seed) for seed in (None, 3)]
    finally:
        render.close()
    expected = Renderer(job)
    np.testing.assert_array_equal(drawn[0], expected.pixels(PIXELS, 8))
    np.testing.assert_array_equal(drawn[1], expected.pixels(PIXELS, 8, seed=3))


def test_a_process_that_has_ended_says_so(job):
    render = RenderProcess(job)
    render.close()
    with pytest.raises(RenderError, match="has ended"):
        render("pixels", PIXELS, 8)


def test_a_scene_that_cannot_be_read_is_an_error_here():
    wrong = chd.load_scene({"type": "scene", "shape": {"type": "no such shape"}})
    with pytest.raises((SceneError, RenderError)):
        RenderProcess(Job.of(wrong, backend="scalar"))


def test_the_first_image_of_a_scene_is_coarse_and_whole():
    source = SceneSource(chd.load_scene("cornell-box"), size=(300, 200))
    try:
        source.preview()
        seen = source.overall().mean
    finally:
        source.close()
    assert seen.shape == (200, 300, 3)
    assert np.isfinite(seen).all()
    colors = np.unique(seen.reshape(-1, 3), axis=0)
    assert 100 < len(colors) <= 128 * 85
