"""Drawing: figures come out, carry what they should, and leave the user's settings alone."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from scipy import stats

import chdstat as chd
from chdstat import viz
from chdstat.errors import InputError
from chdstat.estimators.training import History
from chdstat.inference import contrast
from chdstat.patterns import atlas, classify
from chdstat.samples import Samples
from chdstat.summary.histograms import histogram
from chdstat.viz import CHANNELS
from tests.viz.figures import texts


@pytest.fixture
def image():
    return np.random.default_rng(0).random((20, 30, 3))


def test_tonemap_is_srgb():
    # IEC 61966-2-1: linear 0.5 encodes to 0.7354, values from 1 on are white.
    value = viz.tonemap(np.array([[[0.0], [0.5], [1.0], [7.0]]]), exposure=0)[0, :, 0]
    np.testing.assert_allclose(value, [0, 0.735357, 1, 1], atol=1e-6)
    doubled = viz.tonemap(np.full((1, 1, 3), 0.25), exposure=1)
    np.testing.assert_allclose(doubled, 0.735357, atol=1e-6)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_chd_axes_draws_what_histogram_returns(scale):
    x = np.random.default_rng(1).gamma(1.0, size=(3, 64))
    found = histogram(x, scale=scale)
    ax = viz.chd_axes(found)
    assert ax.get_xscale() == scale
    areas, outlines = ax.patches[::2], ax.patches[1::2]
    for drawn in (areas, outlines):
        np.testing.assert_array_equal([p.get_data().values for p in drawn], found.density)
        np.testing.assert_array_equal([p.get_data().edges for p in drawn], found.edges)
    assert [to_hex(p.get_edgecolor()) for p in outlines] == [c.lower() for c in CHANNELS.values()]
    gray = viz.chd_axes(histogram(x[0], scale=scale), names=["G"])
    np.testing.assert_allclose(gray.patches[0].get_data().values, found.density[0])
    assert to_hex(gray.patches[1].get_edgecolor()) == CHANNELS["G"].lower()
    assert not ax.spines["left"].get_visible()
    own = Figure().subplots()
    assert viz.chd_axes(found, ax=own).spines["left"].get_visible()


def test_a_fit_is_a_curve_in_the_unit_of_its_histogram():
    x = np.random.default_rng(2).lognormal(size=400)
    density = stats.lognorm(1.0).pdf
    for scale in ("linear", "log"):
        found = histogram(x, scale=scale)
        (line,) = viz.chd_axes(found, fits=[density]).lines
        radiance, drawn = line.get_xydata()[line.get_xdata() > 0].T
        factor = radiance * np.log(10) if scale == "log" else 1.0
        np.testing.assert_allclose(drawn, density(radiance) * factor)
    assert not viz.chd_axes(found, fits=[None]).lines


def test_renderings_share_one_axis():
    x = np.random.default_rng(4).gamma(1.0, size=(2, 3, 64))
    day, night = ([viz.Panel.of(f"p{i}", s * x[i]) for i in range(2)] for s in (100, 1))
    figure = viz.chd_grid({"by day": day, "by night": night})
    assert [ax.get_title("left") for ax in figure.axes] == [
        f"{i + 1} p{i}, {name}" for i in range(2) for name in ("by day", "by night")
    ]
    for first, second in (figure.axes[:2], figure.axes[2:]):
        assert first.get_xscale() == "log"
        assert first.get_xlim() == second.get_xlim()
        starts = (ax.patches[0].get_data().edges[0] for ax in (first, second))
        decades = np.log10(np.divide(*starts))
        assert decades == pytest.approx(round(decades, 1))


def ends_of(*rows):
    """Return the ends of the linear and of the log axis of a pixel of rows of samples."""
    figure = viz.chd_pair(viz.Panel.of("wall", np.array(rows)))
    return figure, [ax.get_xlim() for ax in figure.axes]


def test_one_sample_moves_no_axis():
    """Neither far below nor far above the others, for few samples and for many."""
    for n in (64, 512):
        x = np.random.default_rng(n).lognormal(size=n)
        _, (_, (low, high)) = ends_of(x)
        for value, where in ((1e-15, "below"), (1e12, "above")):
            figure, (linear, log) = ends_of(np.append(x, value))
            assert low / 3 < log[0] < 3 * low
            assert high / 3 < log[1] < 3 * high
            assert 0 <= linear[0] < linear[1] < 3 * high
            assert any(re.match(rf"[12] samples? {where} ", t) for t in texts(figure))


def test_an_axis_holds_what_is_near_and_the_mean():
    x = np.random.default_rng(2).gamma(2.0, size=512)
    _, (linear, log) = ends_of(x)
    assert linear[0] == 0
    for low, high in (linear, log):
        assert (x >= low).mean() >= 0.995
        assert (x <= high).mean() >= 0.995
    heavy = np.append(x, 3e4)  # a mean 20 times as large: 1.3 decades above most samples
    _, (_, log) = ends_of(heavy)
    assert log[0] < heavy.mean() < log[1] < 3e4
    assert not any("sample" in t for t in texts(viz.chd_pair(viz.Panel.of("a", x[:12, None].T))))


def test_one_pixel_takes_no_room_from_the_others():
    rng = np.random.default_rng(3)
    x = rng.lognormal(size=(4, 1, 512))
    x[1] *= 1e-12  # apart: it has an axis of its own
    x[2, :, :40] = 10.0 ** rng.uniform(-15, -5, size=40)  # a tail that no other has
    mark = viz.Mark("wall", slice(0, 1), slice(0, 1), (0, 0))
    panels = [viz.Panel.of(f"p{i}", row) for i, row in enumerate(x)]
    figure = viz.region_study(np.ones((4, 4, 1)), [mark] * 4, panels)
    axes = [ax for ax in figure.axes if ax.get_xscale() == "log"]
    shared, (low, high) = {axes[i].get_xlim() for i in (0, 2, 3)}, axes[1].get_xlim()
    assert len(shared) == 1
    ((start, end),) = shared
    assert 1e-4 < start < end < 1e3
    assert 1e-15 < low < high < 1e-9
    assert axes[1].xaxis.get_tick_params()["labelbottom"]
    assert any("samples below 0." in t for t in texts(figure))


def test_maps_have_scales_and_legends(image):
    codes = np.zeros((20, 30), int)
    codes[:, :6] = 2
    figure = viz.map_grid(2, columns=2)
    left, right = figure.axes
    viz.value_map(image[..., 0], title="values", unit="radiance", ax=left)
    viz.categorical_map(codes, {0: "one", 1: "never", 2: "two"}, title="labels", ax=right)
    found = texts(figure)
    assert {"values", "labels", "radiance", "one 80 %", "two 20 %"} <= found
    assert not any("never" in t for t in found)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_contrast_shows_verdict_and_window(channels):
    rng = np.random.default_rng(1)
    a, b = rng.gamma(2.0, size=(2, 20, 30, channels, 32))
    same = contrast(a, b)
    figure = viz.contrast(same)
    assert {"A: samples", "B: samples", "Pixels by p-value"} <= texts(figure)
    assert figure.get_suptitle().startswith("No difference found")
    assert "Efficiency of B over A" not in texts(figure)
    b[4:12, 8:16] *= 0.3
    one, other = (Samples.from_array(x, render_seconds=1.0) for x in (a, b))
    figure = viz.contrast(contrast(one, other))
    assert figure.get_suptitle().startswith("The means differ")
    assert "Efficiency of B over A" in texts(figure)
    mark = figure.axes[1].patches[0]
    assert (mark.get_x() + 0.5, mark.get_y() + 0.5) == (8, 4)


def test_labels_of_a_dataset_bring_their_names():
    samples = Samples.from_array(np.random.default_rng(0).gamma(1.0, size=(4, 4, 3, 256)))
    label = classify(samples, progress=False)["label"]
    assert "gamma-like" in " ".join(texts(viz.categorical_map(label).figure))


def test_a_panel_counts_nulls_and_no_bad_samples():
    x = np.array([[0.0, 1.0, 3.0, np.nan], [0.0, 2.0, 2.0, 9.0]])
    panel = viz.Panel.of("wall", x, channels="ab")
    assert panel.note == "33 % nulls"
    assert panel.mean == pytest.approx([4 / 3, 4 / 3])
    for found in (panel.linear, panel.log):
        assert found.null_count.tolist() == [1, 1]
        assert found.bad_count.tolist() == [1, 1]
    assert viz.Panel.of("dark", np.full((1, 4), np.nan)).mean == ()


def test_parts_of_images_are_magnified_below_each(image):
    parts = [(slice(0, 2), slice(0, 2)), (slice(2, 4), slice(1, 3))]
    images = {name: image * k for k, name in enumerate("abcd", 1)}
    figure = viz.side_by_side(images, insets=parts, columns=2, notes={"a": "error 1"})
    figure.draw_without_rendering()
    first, one, two, second, *_ = figure.axes
    assert "a\nerror 1" in texts(figure)
    assert len(figure.axes) == 4 * 3
    assert one.images[0].get_array().shape[:2] == (2, 2)
    assert one.get_window_extent().y1 < first.get_window_extent().y0
    assert two.get_window_extent().x1 < second.get_window_extent().x0 + 1


def test_the_legend_of_a_training_is_beside_its_curves():
    rows = np.array([[1, 2, 3], [3, 2, 1], [3, 2.5, 2.2], [2.9] * 3, [3.0] * 3])
    ax = viz.training(History(*rows))
    ax.figure.draw_without_rendering()
    legend = ax.get_legend()
    assert "sample mean, training" in texts(ax.figure)
    assert len(legend.get_texts()) == 4
    assert legend.get_window_extent().y0 >= ax.get_window_extent().y1


@pytest.mark.parametrize("marks", [(), [viz.Mark("m", slice(0, 9), slice(0, 3), (4, 1))]])
def test_a_high_image_fits_the_page(marks):
    high = np.ones((90, 30, 3))
    for figure in (
        viz.with_marks(high, marks),
        viz.side_by_side({"a": high, "b": high}),
        viz.map_grid(9, aspect=3),
    ):
        assert figure.get_figheight() <= 8


def test_the_central_limit_theorem_is_a_line():
    n = np.array([1, 4, 16])
    skewness = np.array([[-0.1, 1, 3]]).T / np.sqrt(n)
    figure = viz.averages(n, {"R": 0 / n}, skewness, 1 / np.sqrt(n), alpha=0.05)
    right = figure.axes[1]
    (line,) = [drawn for drawn in right.lines if "CLT" in str(drawn.get_label())]
    np.testing.assert_allclose(np.diff(np.log(line.get_xydata()), axis=0) @ [1, 2], 0, atol=1e-12)
    figure.canvas.draw()
    assert {"0.5", "1"} <= {label.get_text() for label in figure.axes[1].get_yticklabels()}


def test_fits_are_drawn_over_both_histograms():
    x = np.random.default_rng(2).lognormal(size=400)
    linear, log = (histogram(x, scale=scale) for scale in ("linear", "log"))
    figure = viz.fits(linear, log, {"log-normal": stats.lognorm(1.0).pdf}, title="pixel")
    assert {"samples", "log-normal", "pixel", "density per decade"} <= texts(figure)
    (line,) = figure.axes[1].lines
    radiance, density = line.get_xydata().T
    # Per decade, a log-normal density is Gaussian in log10 of radiance.
    expected = stats.norm(scale=1 / np.log(10)).pdf(np.log10(radiance))
    np.testing.assert_allclose(density, expected, rtol=1e-9)


def test_the_map_of_n_needed_tells_two_kinds_apart():
    needed = np.array([[1, 1, 4, -1], [0, 1, 1, 1]])
    found = texts(viz.n_needed(needed, [1, 2, 4]).figure)
    assert {"1: 62 %", "4: 12 %", "> 4: 12 %"} <= found
    assert not any(t.startswith(("2:", "0")) for t in found)


def test_more_labels_than_colours_stay_apart():
    codes = np.arange(12).reshape(3, 4)
    (image,) = viz.categorical_map(codes, {i: f"f{i}" for i in range(12)}).images
    colors = image.cmap(image.norm(np.arange(12)))
    assert len(np.unique(colors, axis=0)) == 12


@pytest.fixture(scope="module")
def two_shapes():
    rng = np.random.default_rng(4)
    x = rng.gamma(2.0, size=(8, 12, 1, 256))
    x[:, :5] = rng.lognormal(sigma=2.0, size=(8, 5, 1, 256))
    x[0, 0] = 0
    return Samples.from_array(x)


@pytest.mark.parametrize("clusters", [None, 1, 9])
def test_an_atlas_is_a_map_and_a_panel_for_each_shape(two_shapes, clusters):
    found = atlas(two_shapes, clusters=clusters)
    figure = viz.atlas(found)
    shown = texts(figure)
    assert "Shape of each pixel   (grey: none, 1 %)" in shown
    for k, share in enumerate(found.share):
        assert any(t.startswith(f"$\\bf{{{k + 1}}}$  {100 * share:.0f} %") for t in shown)
        assert str(k + 1) in shown


@pytest.mark.parametrize("scale", [1e-9, 1e12])
def test_samples_beyond_the_usual_bins_are_drawn(scale):
    x = scale * np.random.default_rng(0).gamma(2.0, size=(3, 64))
    panel = viz.Panel.of("unit", x)
    assert panel.log.counts.sum(axis=-1).tolist() == [64] * 4
    assert not {"no positive samples", "no samples in the bins"} & texts(viz.chd_pair(panel))
    assert "no samples in the bins" in texts(viz.chd_axes(histogram(x)).figure)


def test_nothing_is_drawn_where_there_is_nothing():
    dark = [histogram(np.zeros((3, 8)), scale=scale) for scale in ("linear", "log")]
    assert "no positive samples" in texts(viz.chd_grid([viz.Panel("dark", *dark)]))
    nothing = [histogram(np.zeros(9), scale=scale) for scale in ("linear", "log")]
    viz.fits(*nothing, {"gamma": lambda x: np.full(x.shape, np.nan)}).canvas.draw()
    viz.atlas(atlas(Samples.from_array(np.zeros((4, 4, 1, 8))))).canvas.draw()
    for value in (np.nan, 3.0):
        for log in (False, True):
            viz.value_map(np.full((4, 4), value), log=log).figure.canvas.draw()


def test_logarithmic_maps_say_values_in_the_chosen_colours():
    values = np.array([[0.0, -1.0, 0.01], [0.1, 1.0, np.nan]])
    ax = viz.value_map(values, log=True, limits=(1e-3, 1), cmap="cividis")
    image, bar = ax.images[0], ax.figure.axes[1]
    assert image.get_cmap().name == "cividis"
    assert (~np.isfinite(image.get_array().filled(np.nan))).sum() == 3
    assert [t.get_text() for t in bar.get_yticklabels()] == ["0.001", "0.01", "0.1", "1"]
    np.testing.assert_allclose(bar.get_yticks(), [1e-3, 1e-2, 0.1, 1])
    diverging = viz.value_map(values, log=True, diverging=True, limits=(0.5, 8)).images[0]
    assert (diverging.norm.vmin, diverging.norm.vmax) == (1 / 8, 8)
    assert diverging.norm(1.0) == 0.5


# --- curves of results ----------------------------------------------------------------------------


RNG = np.random.default_rng(0)
TWO = np.where(RNG.random(800) < 0.25, 0, RNG.lognormal(np.repeat([0, 3], 400), 0.4))


@pytest.mark.parametrize("fit", [chd.fit.gamma, chd.fit.mixture])
def test_the_area_below_a_fit_is_its_share(fit):
    found = fit(TWO)
    ax = viz.fit_curve(found)
    x, y = ax.lines[0].get_data()
    assert np.trapezoid(y, np.log10(x)) == pytest.approx(1 - found.zero_share, rel=0.01)
    if fit is chd.fit.mixture:
        parts = np.nansum([line.get_ydata() for line in ax.lines[1:]], axis=0)
        np.testing.assert_allclose(parts, y)
    assert f"{100 * found.zero_share:.0f}\N{NO-BREAK SPACE}% at 0" in texts(ax.figure)


def test_a_power_law_is_a_line_of_its_slope():
    found = chd.fit.tail_index(RNG.pareto(1.25, size=(2, 4000)) + 1)
    ax = viz.tail_curve(found)
    for i, line in enumerate(ax.lines[::2]):
        x, y = np.log(line.get_data())
        slope = (y[-1] - y[-2]) / (x[-1] - x[-2])
        assert slope == pytest.approx(-1 / found.xi[i], rel=0.1)
        assert np.exp(y[0]) == pytest.approx(found.share[i])


def test_modes_stand_where_they_are():
    found = chd.modality(TWO)
    (stems,) = viz.mode_stems(found).collections
    places = [segment[0, 0] for segment in stems.get_segments()]
    np.testing.assert_allclose(places, 10 ** found.places[:2])


def test_a_notebook_shows_the_curves_of_few_rows():
    few = np.stack([TWO, 2 * TWO])
    for of in (chd.fit.lognormal, chd.fit.mixture, chd.fit.tail_index, chd.modality):
        assert "data:image/png" in of(few)._repr_html_()
    many = chd.fit.lognormal(np.stack([TWO] * 7))
    assert "data:image/png" not in many._repr_html_()
    with pytest.raises(InputError, match="6 rows.*got 7"):
        many.plot()
    dark = chd.fit.gamma(np.zeros(9))
    assert "not fitted" in texts(dark.plot())
    assert "scale       —\n" in repr(dark)


def test_numbers_have_their_units():
    assert "W sr-1 m-2" in repr(chd.fit.gamma(TWO))
    assert "ln(W sr-1 m-2)" in repr(chd.fit.lognormal(TWO))
    assert "W sr-1 m-2" in repr(chd.fit.tail_index(TWO))
    assert "at log10 of W sr-1 m-2" in repr(chd.modality(TWO))
