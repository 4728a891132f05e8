"""Figures of a comparison: they show what was found, whoever took part and whatever failed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Rectangle

import chdstat as chd
from chdstat import viz
from chdstat.comparison import Interval, error_curve
from chdstat.errors import InputError
from chdstat.estimators import Estimator
from chdstat.patterns import Label
from chdstat.studies.claims import ClaimTest, PlotData
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


def test_a_star_marks_those_that_use_neighbours(found, samples):
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


def test_a_breakdown_frames_the_best(found):
    ax = pattern_breakdown(found.breakdown)
    value = found.breakdown.measures["relmse_ratio"].value
    seen = texts(ax.figure)
    assert {"gamma-like, 83 %", "median of means", f"{value[1, 1]:.2f} ▲"} <= seen
    assert not any(text.startswith("black") for text in seen)  # its mean is right
    assert np.isnan(value[0]).all()
    frames = [p for p in ax.patches if isinstance(p, Rectangle)]
    assert len(frames) == 1  # nothing is better or worse than no error at all


def test_a_curve_has_a_line_an_estimator(curve):
    figure = error_curves(curve)
    assert {"sample mean", "MSE", "relMSE"} <= texts(figure)
    for ax in figure.axes:
        assert [line.get_linestyle() for line in ax.lines] == ["-", "-", "-", "--"]


def test_pixels_are_drawn_by_luminance(found):
    drawn = found.draw_pixels(9)
    ax = pixel_estimates(drawn)
    means = ax.collections[2].get_offsets()[:, 1]
    assert sorted(means) == pytest.approx(sorted(drawn.mean @ LUMINANCE))
    assert ax.get_ylabel().startswith("luminance,")
    seen = texts(ax.figure)
    assert {"reference", "mean of 32", "median of means", "Zirr et al. 2018"} <= seen
    assert "9 random pixels, from dark to bright" in seen
    with pytest.raises(InputError, match="one pixel"):
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


# --- study figures --------------------------------------------------------------------------------


def claim_test(value, low, high, *, name="share", unit="1", least=-np.inf, most=np.inf):
    return ClaimTest(name, Interval(value, low, high), least, most, unit)


@pytest.fixture
def image():
    return np.random.default_rng(0).random((12, 16, 3))


@pytest.fixture
def marks():
    return [viz.Mark(f"region {i}", slice(i, i + 2), slice(2, 5), (i + 1, 3)) for i in range(9)]


# --- claims -------------------------------------------------------------------------------------


def test_a_verdict_is_told_by_colour_and_by_symbol():
    axes = viz.verdict_matrix(
        {"nulls": {"a": "supported", "b": "not supported*"}, "modes": {"a": "cannot tell"}}
    )
    symbols = [t.get_text() for t in axes.texts]
    colors = [to_hex(p.get_facecolor()).upper() for p in axes.findobj(Rectangle)[:3]]
    assert symbols == ["✓", "✗", "?"]
    assert colors == [viz.VERDICTS[v][0] for v in ("supported", "not supported", "cannot tell")]
    assert len(set(colors)) == len(set(symbols)) == 3
    assert {"nulls", "modes", "a", "b"} <= texts(axes.figure)


def test_intervals_stand_over_the_range_of_the_claim():
    figure = viz.claim_intervals(
        {"a": [claim_test(0.7, 0.6, 0.8, least=0.5, unit="m")], "b": [], "c": [claim_test(1, 2, 3)]}
    )
    low, high = figure.axes[0].get_xlim()
    assert low < 0.5 < 0.8 < high
    assert {"share (m)", "share", "a", "b", "c", "—"} <= texts(figure)
    assert len(figure.axes) == 2  # the same statistic with another range is another claim


def test_an_interval_has_the_colour_of_its_verdict():
    intervals = {"in": (0.0, -0.1, 0.1), "out": (2.0, 1.9, 2.1), "across": (1.0, 0.5, 1.5)}
    tests = {name: [claim_test(*interval, most=1.0)] for name, interval in intervals.items()}
    lines = viz.claim_intervals(tests).axes[0].lines
    colors = [to_hex(line.get_color()).upper() for line in lines if len(line.get_xdata()) == 2]
    yes, no = viz.VERDICTS["supported"][0], viz.VERDICTS["not supported"][0]
    assert colors[-3:-1] == [yes, no]
    assert colors[-1] not in {yes, no}


@pytest.mark.parametrize("kind", ["curves", "points", "bars", "map"])
def test_every_kind_of_plot_is_drawn(kind):
    x = np.linspace(0, 1, 50)
    y = np.outer(x, x) if kind == "map" else x**2
    series = {"one": (x, y)} if kind == "map" else {"one": (x, y), "two": (x, 2 * y)}
    plot = PlotData(kind, series, "x", "y")
    figure = viz.finding_plots({"scene 0": plot, "scene 1": plot})
    assert {"scene 0", "scene 1", "x", "y"} <= texts(figure)


def test_a_peak_does_not_squeeze_a_curve():
    y = np.ones(100)
    y[3] = 1e6
    figure = viz.finding_plots({"": PlotData("curves", {"loss": (np.arange(100), y)})})
    assert figure.axes[0].get_ylim()[1] < 10
    empty = PlotData("curves", {"loss": (np.arange(100), np.full(100, np.nan))})
    viz.finding_plots({"": empty}).draw_without_rendering()


# --- scenes -------------------------------------------------------------------------------------


def test_regions_stand_on_one_axis_of_radiance(image, marks):
    light = np.random.default_rng(0).gamma(1.0, size=(1, 64))
    panels = [
        viz.Panel.of(m.name, light * 10.0**i, channels=["luminance"]) for i, m in enumerate(marks)
    ]
    figure = viz.region_study(image, marks, panels, notes=["note"] * 9)
    found = texts(figure)
    assert {f"{i + 1} region {i}" for i in range(9)} <= found
    assert {"note", "samples that are not null, luminance", "mean"} <= found
    assert "fitted family or mixture" not in found
    _, *others = figure.axes
    insets, chds = others[::2], others[1::2]
    assert len({to_hex(ax.spines["top"].get_edgecolor()) for ax in insets}) == 9
    assert len({ax.get_xlim() for ax in chds}) == 1
    figure.draw_without_rendering()
    for inset, ax in zip(insets, chds, strict=True):
        of_crop, of_chd = inset.get_window_extent(), ax.get_window_extent()
        assert of_crop.x1 < of_chd.x0
        assert of_crop.y0 < (of_chd.y0 + of_chd.y1) / 2 < of_crop.y1


def test_all_batches_and_their_means_are_drawn():
    x = np.random.default_rng(0).gamma(0.5, size=(64, 32))
    figure = viz.batch_histograms({"wall": x})
    upper, lower = figure.axes
    (batches,) = upper.collections
    assert len(batches.get_paths()) == 64
    means, bins = x.mean(axis=1), lower.patches
    assert [p.get_height() for p in bins] == np.histogram(means, len(bins))[0].tolist()
    assert [a.lines[0].get_xdata()[0] for a in (upper, lower)] == pytest.approx([x.mean()] * 2)
    assert {"64 batches\nof 32 samples", "their 64\nmeans"} <= texts(figure)


def test_renders_of_a_view_share_one_exposure(image):
    mark = viz.Mark("wall", slice(0, 2), slice(0, 2), (1, 1))
    x = {name: [np.full((3, 8), level)] for name, level in (("long", 2.0), ("short", 1.0))}
    figure = viz.renders_contrasted({"long": image, "short": image / 2}, x, [mark])
    bright, dark = (a.images[0].get_array().mean() for a in figure.axes if a.images)
    assert dark < 0.85 * bright
    assert {"1 wall", "long", "short"} <= texts(figure)
