"""Drawing: figures come out, carry what they should, and leave the user's settings alone."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest

from chdstat import viz
from chdstat.errors import InputError


@pytest.fixture
def image():
    return np.random.default_rng(0).random((20, 30, 3))


def texts(figure):
    figure.canvas.draw()
    return {t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_visible()}


def curve(low=0.1, high=10.0, scale="log"):
    space = np.geomspace if scale == "log" else np.linspace
    edges = space(low, high, 101)
    return viz.Curve(edges, np.ones(100), np.full(100, 0.5))


def test_tonemap_is_srgb():
    # IEC 61966-2-1: linear 0.5 encodes to 0.7354, values from 1 on are white.
    value = viz.tonemap(np.array([[[0.0], [0.5], [1.0], [7.0]]]), exposure=0)[0, :, 0]
    np.testing.assert_allclose(value, [0, 0.735357, 1, 1], atol=1e-6)
    doubled = viz.tonemap(np.full((1, 1, 3), 0.25), exposure=1)
    np.testing.assert_allclose(doubled, 0.735357, atol=1e-6)


def test_pixels_that_are_no_radiance_are_seen(image):
    image[3, 4, 1] = np.nan
    np.testing.assert_array_equal(viz.tonemap(image)[3, 4], [1, 0, 1])
    assert np.isfinite(viz.tonemap(image)).all()


@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 2), (4,)])
def test_a_picture_of_another_shape_is_refused(shape):
    with pytest.raises(InputError, match=r"shape \(y, x, 1\) or \(y, x, 3\), got"):
        viz.tonemap(np.zeros(shape))


def test_marks_are_numbered_and_magnified(image):
    marks = [viz.Mark(f"m{i}", slice(2, 5), slice(3 * i, 3 * i + 3), (3, 3 * i)) for i in range(8)]
    figure = viz.with_marks(image, marks)
    assert len(figure.axes) == 9
    assert {f"{i + 1} m{i}" for i in range(8)} <= texts(figure)


def test_chd_grid_shows_every_panel():
    panels = [
        viz.Panel(f"p{i}", {"R": curve(0, 1, "linear")}, {"R": curve()}, {"R": 0.4}, f"note {i}")
        for i in range(3)
    ]
    found = texts(viz.chd_grid(panels))
    assert {"1 p0", "2 p1", "3 p2", "note 0", "note 2", "R"} <= found
    with pytest.raises(InputError, match="at least one panel"):
        viz.chd_grid([])


def test_a_pixel_without_samples_says_so():
    nothing = viz.Curve(np.full(101, np.nan), np.full(100, np.nan))
    figure = viz.chd_grid([viz.Panel("dark", {"R": nothing}, {"R": nothing})])
    assert "no positive samples" in texts(figure)


def test_maps_have_scales_and_legends(image):
    codes = np.zeros((20, 30), int)
    codes[:, :6] = 2
    figure = viz.map_grid(
        [
            viz.value_map(image[..., 0], title="values", unit="radiance"),
            viz.categorical_map(codes, {0: "one", 1: "never", 2: "two"}, title="labels"),
        ],
        columns=2,
    )
    found = texts(figure)
    assert {"values", "labels", "radiance", "one 80 %", "two 20 %"} <= found
    assert not any("never" in t for t in found)


@pytest.mark.parametrize("value", [np.nan, 3.0])
def test_a_map_without_spread_is_drawn(value):
    viz.map_grid([viz.value_map(np.full((4, 4), value), title="flat")]).canvas.draw()


def test_pictures_share_an_exposure_and_show_errors(image):
    error = np.abs(image - 0.5).mean(axis=-1)
    figure = viz.pictures({"a": image, "reference": image * 2}, errors={"a": error})
    assert {"a", "reference", "log10 squared error"} <= texts(figure)
    with pytest.raises(InputError, match="at least one image"):
        viz.pictures({})


def test_curves_draw_what_they_are_given():
    figure = viz.averages([1, 2], {"R": [1, 0.5]}, np.ones((3, 2)), [2, 1], alpha=0.05)
    assert {"R", "measured", "CLT"} <= texts(figure)
    figure = viz.training([1, 2, 3], {"training": [3, 2, 1]}, {"training": 2.0})
    assert "sample mean, training" in texts(figure)
    intervals = ([1.0, 0.8], [0.9, 0.7], [1.1, np.nan])
    figure = viz.error_bars(["mean", "other"], {"MSE": intervals}, references={"MSE": 1})
    assert {"MSE", "mean", "other"} <= texts(figure)


def test_drawing_leaves_settings_and_pyplot_alone(image):
    import matplotlib.pyplot as plt

    before = dict(mpl.rcParams)
    viz.with_marks(image)
    assert dict(mpl.rcParams) == before
    assert plt.get_fignums() == []
