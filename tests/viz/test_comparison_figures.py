"""Figures of a comparison: they show what was found, whoever took part and whatever failed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.patches import Rectangle

import chdstat as chd
from chdstat.comparison import error_curve
from chdstat.errors import InputError
from chdstat.estimators import Estimator
from chdstat.patterns import Label
from chdstat.viz import (
    error_curves,
    estimator_measures,
    pattern_breakdown,
    pixel_estimates,
)
from tests.luminance import LUMINANCE
from tests.viz.figures import texts

NAMES = ["mean", "median", "median_of_means", "zirr2018"]


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    x = rng.lognormal(size=(12, 10, 1, 1)) * rng.gamma(0.7, size=(12, 10, 3, 128))
    x[:2] = 0
    return chd.Samples.from_array(x)


@pytest.fixture(scope="module")
def found(samples):
    labels = np.full((12, 10), int(Label.GAMMA_LIKE))
    labels[:2] = Label.BLACK
    return chd.compare(samples, NAMES, labels=labels)


@pytest.fixture(scope="module")
def curve(samples):
    return error_curve(samples, NAMES, sizes=[4, 8, 16])


def test_all_measures_are_shown_and_a_star_marks_those_that_use_neighbours(found, samples):
    figure = estimator_measures(found)
    seen = texts(figure)
    assert {"sample mean", "median", "median of means", "Zirr et al. 2018 *"} <= seen
    assert {"MSE ratio", "relMSE ratio", "bias", "fireflies left"} <= seen
    assert any("neighbouring pixels" in text for text in seen)
    ratios = figure.axes[0].lines[0].get_xdata()
    assert ratios == pytest.approx(found.measures["mse_ratio"].value[:, -1])
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert [name.endswith(" *") for name in names] == found.uses_neighbours.tolist()
    alone = estimator_measures(chd.compare(samples, ["mean", "median"]))
    assert not any("neighbouring pixels" in text for text in texts(alone))


def test_better_same_and_worse_fill_the_bar(found):
    bars = [p for p in estimator_measures(found).axes[2].patches if isinstance(p, Rectangle)]
    widths = np.array([bar.get_width() for bar in bars]).reshape(4, 4)
    assert widths.sum(axis=0) == pytest.approx(1)
    assert widths[2, 0] == 1  # the mean is the mean
    assert (widths[1] > 0.1).any()  # of some, the reference cannot tell


def test_an_estimator_without_a_measure_leaves_a_gap(samples):
    fails = Estimator("fails", lambda x: np.full(x.shape[:-1], np.nan), source="this test")
    texts(estimator_measures(chd.compare(samples, ["mean", fails])))
    black = chd.Samples.from_array(np.zeros((4, 4, 3, 64)))
    texts(estimator_measures(chd.compare(black, ["mean"])))


def test_a_breakdown_has_a_row_a_pattern_and_frames_the_best(found):
    ax = pattern_breakdown(found.breakdown)
    value = found.breakdown.measures["relmse_ratio"].value
    seen = texts(ax.figure)
    assert {"gamma-like, 83 %", "median of means", f"{value[1, 1]:.2f}"} <= seen
    assert not any(text.startswith("black") for text in seen)  # its mean is right
    assert np.isnan(value[0]).all()
    frames = [p for p in ax.patches if isinstance(p, Rectangle)]
    assert len(frames) == 1  # nothing is better or worse than no error at all


def test_a_curve_has_a_line_an_estimator(curve):
    figure = error_curves(curve)
    assert {"sample mean", "MSE", "relMSE"} <= texts(figure)
    for ax in figure.axes:
        assert [line.get_linestyle() for line in ax.lines] == ["-", "-", "-", "--"]


def test_pixels_are_drawn_by_their_luminance_with_reference_mean_and_estimates(found):
    drawn = found.draw_pixels(9)
    ax = pixel_estimates(drawn)
    means = ax.collections[2].get_offsets()[:, 1]
    assert sorted(means) == pytest.approx(sorted(drawn.mean @ LUMINANCE))
    assert ax.get_ylabel().startswith("luminance,")
    seen = texts(ax.figure)
    assert {"reference", "mean of 32", "median of means", "Zirr et al. 2018"} <= seen
    assert "9 random pixels, from dark to bright" in seen
    with pytest.raises(InputError, match="at least one pixel"):
        pixel_estimates(replace(drawn, pixels=drawn.pixels[:0]))


def test_one_channel_and_black_pixels_can_be_drawn():
    gray = chd.compare(chd.Samples.from_array(np.zeros((3, 3, 64))), ["mean"])
    assert "channel0" in pixel_estimates(gray.draw_pixels()).get_ylabel()


def test_pixels_that_are_alike_have_short_labels():
    x = np.random.default_rng(0).gamma(1.0, size=(5, 5, 1, 256)) + 0.3
    drawn = chd.compare(chd.Samples.from_array(x), ["mean"]).draw_pixels()
    axes = pixel_estimates(drawn)
    axes.figure.draw_without_rendering()
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert len(labels) >= 3
    assert max(map(len, labels)) <= 4
