"""The renderer in a process of its own."""

from __future__ import annotations

import base64
import io
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

import chdstat as chd
from chdstat.errors import RenderError, SceneError
from chdstat.explorer.image_sources import SceneSource
from chdstat.explorer.render_process import RenderProcess
from chdstat.explorer.server import Startup
from chdstat.rendering.backend import activate
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer

PIXELS = np.array([[8, 12], [3, 5]])


@pytest.fixture
def job():
    return Job.of("cornell-box", size=(24, 16), backend="scalar")


def test_it_draws_what_the_renderer_draws(job):
    render = RenderProcess(job)
    try:
        assert render.described == ((24, 16), "path")
        drawn = [render("pixels", PIXELS, 8, seed=seed) for seed in (None, 3)]
    finally:
        render.close()
    with activate(job.backend):
        expected = MitsubaRenderer(job)
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
        _ = RenderProcess(Job.of(wrong, backend="scalar")).described


def test_the_coarse_image_is_whole_and_told_as_it_is_drawn(job):
    """From one sample per pixel, then four: both have the mean of the image within 6 errors."""
    job = replace(job, options=job.options | {"size": (300, 200)})
    render, startup = RenderProcess(job), Startup("box")
    assert startup.text == "loading box"
    texts = []

    class Told:
        described = render.described

        def __call__(self, *arguments, **options):
            texts.append(startup.text)
            return render(*arguments, **options)

    try:
        coarse = startup.draw(Told())
        source = SceneSource(render, coarse)
        seen = source.overall().mean
        next(source.passes())
        better = source.overall().mean
    finally:
        render.close()
    assert coarse.shape == (85, 128, 3)
    assert texts == [f"drawing box: {share} % of the coarse image" for share in (0, 25, 50, 75)]
    image = imread(io.BytesIO(base64.b64decode(startup.image)))
    assert image.shape == (85, 128, 3)
    for image in (seen, better):
        assert image.shape == (200, 300, 3)
        assert np.isfinite(image).all()
        assert 100 < len(np.unique(image.reshape(-1, 3), axis=0)) <= 128 * 85
    assert (seen != better).any()
    error = 6 * coarse.std() / np.sqrt(128 * 85)
    assert abs(seen.mean() - better.mean()) < error


def test_the_child_loads_the_renderer_and_little_else():
    code = "import sys, chdstat.explorer.render_process; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"bokeh", "torch", "scipy", "matplotlib", "sklearn", "tornado"} & set(loaded)
