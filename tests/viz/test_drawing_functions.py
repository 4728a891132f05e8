"""What holds for every drawing function: where it draws, what it returns, what it leaves alone."""

from __future__ import annotations

import inspect
import io
from dataclasses import replace
from functools import partial

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import chdstat as chd
from chdstat import viz
from chdstat.comparison import Interval, error_curve
from chdstat.errors import InputError
from chdstat.estimators.training import History
from chdstat.patterns import film_split
from chdstat.samples.tiles import FILM
from chdstat.studies.claims import ClaimTest, PlotData
from chdstat.viz.styling import verbatim
from tests.viz.figures import clashes, texts

NAME = "a $x^$ b"
"""No formula: Matplotlib cannot parse it as one."""
RNG = np.random.default_rng(0)
IMAGE = RNG.random((12, 16, 3))
MARK = viz.Mark(NAME, slice(2, 6), slice(2, 6), (4, 4))
LINEAR, LOG = (chd.histogram(RNG.gamma(1.0, size=(3, 64)), scale=s) for s in ("linear", "log"))
ONE = {s: chd.histogram(RNG.gamma(1.0, size=64), scale=s) for s in ("linear", "log")}
PANEL = viz.Panel(NAME, LINEAR, LOG)


@pytest.fixture(scope="module")
def examples():
    """Return a call of each drawing function that lacks only where to draw."""
    samples = chd.Samples.from_array(RNG.gamma(1.0, size=(8, 8, 3, 64)))
    labels = np.zeros((8, 8), int)
    compared = chd.compare(samples, ["mean", "median"], labels=labels, progress=False)
    test = ClaimTest("share", Interval(0.5, 0.4, 0.6), least=0.3)
    two = {name: RNG.gamma(1.0, size=64) for name in (NAME, "b")}
    pair = {NAME: (5, 5), "b": (4, 5)}
    bars = PlotData("bars", {NAME: (np.zeros(1), np.ones(1))})
    fell = RNG.random((8, 8, 2, 64)).astype(np.float32)
    film = chd.Samples(samples.read(), attrs={}, parts={FILM: chd.Samples.from_array(fell)})
    return {
        "atlas": partial(viz.atlas, chd.atlas(samples, clusters=2, progress=False)),
        "averages": partial(
            viz.averages, [1, 2], {NAME: [1, 0.5]}, np.ones((3, 2)), [2, 1], alpha=0.05
        ),
        "batch_histograms": partial(viz.batch_histograms, {NAME: RNG.gamma(1.0, size=(8, 4))}),
        "batches_of_pixels": partial(
            viz.batches_of_pixels, IMAGE, [MARK], [RNG.gamma(1.0, size=(8, 4))]
        ),
        "categorical_map": partial(viz.categorical_map, labels, {0: NAME}),
        "chd_axes": partial(viz.chd_axes, LOG),
        "chd_grid": partial(viz.chd_grid, [PANEL]),
        "chd_pair": partial(viz.chd_pair, PANEL),
        "claim_intervals": partial(viz.claim_intervals, {NAME: [test]}),
        "contrast": partial(viz.contrast, chd.contrast(samples, samples.read() * 0.9)),
        "error_curves": partial(
            viz.error_curves, error_curve(samples, ["mean"], sizes=[4, 8], progress=False)
        ),
        "estimator_measures": partial(viz.estimator_measures, compared),
        "finding_plots": partial(viz.finding_plots, {NAME: bars}),
        "film_split": partial(viz.film_split, film_split(film, progress=False)),
        "firefly_pair": partial(viz.firefly_pair, IMAGE, pair, two),
        "fit_curve": partial(viz.fit_curve, chd.fit.mixture(RNG.gamma(2.0, size=64))),
        "mode_stems": partial(viz.mode_stems, chd.modality(RNG.gamma(2.0, size=(2, 64)))),
        "tail_curve": partial(viz.tail_curve, chd.fit.tail_index(RNG.pareto(2.0, size=256))),
        "fits": partial(viz.fits, ONE["linear"], ONE["log"], {NAME: np.ones_like}),
        "image_map": partial(viz.image_map, IMAGE),
        "map_grid": partial(viz.map_grid, 2),
        "n_needed": partial(viz.n_needed, labels + 1, [1, 2]),
        "pattern_breakdown": partial(viz.pattern_breakdown, compared.breakdown),
        "pixel_estimates": partial(viz.pixel_estimates, compared.draw_pixels(4)),
        "pixel_by_place": partial(viz.pixel_by_place, replace(film.pixel(1, 1), scene=NAME)),
        "region_study": partial(viz.region_study, IMAGE, [MARK], [PANEL]),
        "renders_contrasted": partial(
            viz.renders_contrasted,
            {NAME: IMAGE, "b": 2 * IMAGE},
            {NAME: [np.ones((3, 4))]},
            [MARK],
            difference=(NAME, "b"),
        ),
        "side_by_side": partial(viz.side_by_side, {NAME: IMAGE, "b": IMAGE}),
        "training": partial(viz.training, History(*np.array([[1, 2], *4 * [[2, 1]]]))),
        "value_map": partial(viz.value_map, IMAGE[..., 0]),
        "verdict_matrix": partial(viz.verdict_matrix, {"nulls": {NAME: "supported"}}),
        "with_marks": partial(viz.with_marks, IMAGE, [MARK]),
    }


DRAWING = [name for name in viz.__all__ if name.islower() and name not in {"style", "tonemap"}]


@pytest.mark.parametrize("name", DRAWING)
def test_it_draws_where_it_is_told_to_and_returns_that(examples, name):
    given = inspect.signature(getattr(viz, name)).parameters.keys() & {"ax", "fig"}
    if given == {"ax"}:
        figure = Figure()
        first, second = figure.subplots(1, 2)
        assert examples[name](ax=second) is second
        assert not first.has_data()
    else:
        assert given == {"fig"}
        figure = Figure(layout="constrained")
        assert examples[name](fig=figure) is figure
        assert figure.axes
    figure.draw_without_rendering()


UNNAMED = {"atlas", "chd_axes", "contrast", "error_curves", "estimator_measures", "film_split",
           "fit_curve", "image_map", "map_grid", "mode_stems", "n_needed", "pattern_breakdown",
           "pixel_estimates", "tail_curve", "training", "value_map"}  # fmt: skip
"""Those that are given no names of things."""


@pytest.mark.parametrize("name", DRAWING)
def test_figures_have_room_for_names(examples, name, monkeypatch):
    """In a column of a paper, for a notebook and with TrueType fonts; settings stay as they are."""
    import matplotlib.pyplot as plt

    before, stream = dict(mpl.rcParams), io.BytesIO()
    drawn = examples[name](width="column")
    figure = drawn.figure if isinstance(drawn, Axes) else drawn
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert dict(mpl.rcParams) == before
    assert plt.get_fignums() == []
    assert figure.get_figwidth() <= 3.4
    assert clashes(figure, monkeypatch) == []
    written = {text for text in texts(figure) if "x^" in text}
    assert bool(written) == (name not in UNNAMED)
    assert all(verbatim(NAME) in text for text in written)
    figure.axes[0].set_title("radiance")
    figure.savefig(stream, format="pdf")  # outside of the style
    assert b"/FontFile2" in stream.getvalue()
    assert b"/Type3" not in stream.getvalue()


LONG = "the wall beside the window, at night"
MARKS = [replace(MARK, ys=slice(y, y + 2), xs=slice(y, y + 2)) for y in (1, 5, 9)]
_NOISE = RNG.gamma(1.0, size=(3, 16, 16, 3, 16)) * np.reshape([1, 1.5, 2], (3, 1, 1, 1, 1))
RANKED = chd.contrast({LONG: _NOISE[0], "b": _NOISE[1], NAME: 1.01 * _NOISE[2]})
CROWDED = {
    "batches": lambda w: viz.batch_histograms({LONG + i: np.ones((8, 4)) for i in "abcd"}, width=w),
    "images": lambda w: viz.side_by_side({LONG: IMAGE, "b": IMAGE, "reference": IMAGE}, width=w),
    "findings": lambda w: viz.finding_plots(
        {
            LONG: PlotData("bars", {LONG: ([0], [1])}),
            "b": PlotData("curves", {"b": ([0], [1])}, "x"),
        },
        width=w,
    ),
    "fits": lambda w: viz.fits(*ONE.values(), {LONG: np.ones_like, "b": np.ones_like}, width=w),
    "ranking": lambda w: viz.contrast(RANKED, width=w),
    "regions": lambda w: viz.region_study(
        IMAGE, [replace(MARK, name=LONG)], [replace(PANEL, note="48 % null, gamma")], width=w
    ),
    "renders": lambda w: viz.renders_contrasted(
        {LONG: IMAGE, "b": IMAGE}, {LONG: [RNG.random((3, 64))] * 3}, MARKS, width=w
    ),
    "verdicts": lambda w: viz.verdict_matrix(
        {"a": dict.fromkeys((LONG, "b"), "supported")}, width=w
    ),
}


@pytest.mark.parametrize("name", CROWDED)
@pytest.mark.parametrize("width", ["column", "page"])
def test_long_names_and_several_panels_have_room(name, width, monkeypatch):
    drawn = CROWDED[name](width)
    assert clashes(drawn.figure if isinstance(drawn, Axes) else drawn, monkeypatch) == []


def test_clashing_texts_are_seen(monkeypatch):
    figure = Figure()
    for x, text in ((0.5, "one"), (0.51, "two"), (0.99, "three")):
        figure.text(x, 0.5, text)
    assert clashes(figure, monkeypatch) == ["three", "two / one"]


@pytest.mark.parametrize("name", ["averages", "error_curves", "fits", "finding_plots"])
def test_series_differ_by_more_than_their_colour(examples, name):
    if name == "finding_plots":
        series = {str(i): (np.arange(3), np.arange(3)) for i in range(4)}
        figure = viz.finding_plots({k: PlotData(k, series) for k in ("curves", "points")})
    else:
        drawn = examples[name]()
        figure = drawn.figure if isinstance(drawn, Axes) else drawn
    for ax in figure.axes:
        lines = [line for line in ax.lines if not line.get_label().startswith("_")]
        looks = {(str(line._unscaled_dash_pattern), line.get_marker()) for line in lines}
        assert len(looks) == len(lines)


def test_channels_and_scales_are_drawn_as_asked_for():
    x = RNG.gamma(1.0, size=(3, 64))
    panel = viz.Panel.of("wall", x)
    log = chd.histogram(0.2126 * x[0] + 0.7152 * x[1] + 0.0722 * x[2], scale="log")
    (ax,) = viz.chd_pair(panel, channels="luminance", scales="log").axes
    filled = (values[values > 0] for values in (ax.patches[0].get_data().values, log.density))
    np.testing.assert_allclose(*filled, rtol=1e-6)
    first, second = viz.chd_pair(panel, channels=["blue", "R"], scales=["log", "linear"]).axes
    assert (first.get_xscale(), second.get_xscale()) == ("log", "linear")
    assert texts(first.figure) >= {"R", "B"}
    assert "G" not in texts(first.figure)
    assert panel.select("green").mean == [pytest.approx(x[1].mean())]
    shown = viz.image_map(IMAGE, channels="green", exposure=0).images[0].get_array()
    np.testing.assert_allclose(shown, viz.tonemap(IMAGE[..., [1]], exposure=0))
    samples = chd.Samples.from_array(np.stack([[x] * 2] * 2))
    assert samples.plot(1, 0, width=5, scales="linear").get_figwidth() == 5


def test_figures_draw_the_channel_asked_for(examples):
    figure = examples["contrast"](channels="blue")
    maps = examples["contrast"].args[0].maps.sel(channel="B")
    np.testing.assert_allclose(
        figure.axes[2].images[0].get_array(), 100 * maps["difference"] / np.abs(maps["mean_a"])
    )
    np.testing.assert_allclose(figure.axes[3].images[0].get_array(), maps["p_value"], rtol=1e-6)
    assert "B − A over A, blue" in texts(figure)
    compared = examples["estimator_measures"].args[0]
    ax = examples["estimator_measures"](channels="G").axes[0]
    np.testing.assert_array_equal(
        ax.lines[0].get_xdata(), compared.measures["mse_ratio"].value[:, 1]
    )
    pixels = examples["pixel_estimates"].args[0]
    drawn = examples["pixel_estimates"](channels="red")
    assert drawn.get_ylabel().startswith("R, ")
    heights = [path.vertices[0, 1] for path in drawn.collections[1].get_paths()]
    np.testing.assert_allclose(heights, np.sort(pixels.reference[:, 0]))
    shares = {"R": [1, 0.5], "B": [0.2, 0.1]}
    averages = viz.averages([1, 2], shares, np.ones((3, 2)), [2, 1], alpha=0.05, channels="blue")
    assert averages.axes[0].lines[0].get_ydata().tolist() == shares["B"]
    assert len(averages.axes[0].lines) == 2  # and the level


def test_a_million_samples_make_a_small_file():
    x = RNG.gamma(0.5, size=(1, 2**20))
    fit = chd.fit.fit(x[0, :1000], "gamma").pdf
    for figure in (
        viz.chd_pair(viz.Panel.of("wall", x, channels=["Y"], fits=[fit])),
        viz.batch_histograms({"wall": x[0].reshape(-1, 256)}),
    ):
        stream = io.BytesIO()
        figure.savefig(stream, format="pdf")
        assert len(stream.getvalue()) < 200_000


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: viz.verdict_matrix({"nulls": {"a": "maybe"}}), "verdict of supp.*got 'maybe'"),
        (lambda: viz.verdict_matrix({}), "got none"),
        (lambda: viz.claim_intervals({"a": []}), "at least one panel"),
        (lambda: viz.finding_plots({}), "at least one panel"),
        (lambda: viz.batch_histograms({}), "at least one panel"),
        (lambda: viz.chd_grid([]), "at least one panel"),
        (lambda: viz.chd_grid({}), "at least one panel"),
        (lambda: viz.chd_grid({"a": [PANEL] * 2, "b": [PANEL]}), "'a': 2, 'b': 1"),
        (lambda: viz.region_study(IMAGE, [MARK], []), "got 0 for 1"),
        (lambda: viz.firefly_pair(IMAGE, {"firefly": (5, 5)}, {}), "got 1 pixels"),
        (lambda: viz.side_by_side({}), "at least one image"),
        (lambda: viz.renders_contrasted({}), "at least one image"),
        (lambda: viz.contrast(RANKED, channels="red"), "got red for several"),
        (lambda: viz.contrast(replace(RANKED, noise=None)), "ranked by their noise"),
        (lambda: viz.renders_contrasted({"a": IMAGE}, {"a": []}, [MARK]), "as many places"),
        (lambda: viz.chd_axes(LOG, names=["a", "b"]), "2 channels, got one of shape"),
        (lambda: viz.fits(LINEAR, LOG, {}), r"1 channels, got one of shape \(3, 100\)"),
        (lambda: viz.categorical_map(np.zeros((4, 4), int)), "flag_meanings.*pass names="),
        (lambda: viz.chd_pair(PANEL, channels="luminance"), "channel must be one of red, green"),
        (lambda: viz.chd_pair(PANEL, scales="cubic"), "scale must be one of linear, log, got 'cu"),
        (lambda: viz.chd_pair(PANEL, scales=[]), "at least one scale"),
        (lambda: viz.chd_pair(PANEL, width="colum"), "width must be.*; did you mean 'column'?"),
        (lambda: viz.chd_pair(PANEL, width=-1), "or a number of inches, got -1"),
        (lambda: viz.image_map(IMAGE, channels="RG"), "channel must be one of red"),
        (lambda: viz.value_map(IMAGE[..., 0], cmap="jett"), "colour maps, such as viridis.*'jett'"),
        (lambda: viz.value_map(IMAGE[..., 0], log=True, limits=(0, 1)), r"above 0.*got \(0, 1\)"),
        (
            lambda: viz.averages([1], {"R": [1]}, np.ones((3, 1)), [1], alpha=0.1, channels="X"),
            "channel must be one of",
        ),
        (lambda: viz.image_map(IMAGE, channels=["R", "G"]), "expected one channel, such as"),
        (lambda: viz.tonemap(np.ones((4, 4))), r"shape \(y, x, 1\) or \(y, x, 3\), got"),
        (lambda: viz.tonemap(np.ones((4, 4, 2))), r"shape \(y, x, 1\) or \(y, x, 3\), got"),
    ],
)
def test_what_cannot_be_drawn_is_refused(draw, message):
    with pytest.raises(InputError, match=message):
        draw()
