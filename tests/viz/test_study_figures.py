"""Study figures: every verdict tells itself twice, intervals show their claim, nothing is lost."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Rectangle

from chdstat import viz
from chdstat.errors import InputError

EDGES = np.geomspace(1e-3, 10, 41)


def texts(figure):
    figure.draw_without_rendering()
    return {t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_visible()}


def curve(value=1.0):
    return viz.Curve(EDGES, np.full(40, value))


def panel(name):
    channels = {"R": curve(), "G": curve(2.0), "B": curve(3.0)}
    return viz.Panel(name, channels, channels, note="12 % null")


@pytest.fixture
def image():
    return np.random.default_rng(0).random((12, 16, 3))


@pytest.fixture
def marks():
    return [viz.Mark(f"region {i}", slice(i, i + 2), slice(2, 5), (i + 1, 3)) for i in range(9)]


# --- claims -------------------------------------------------------------------------------------


def test_a_verdict_is_told_by_colour_and_by_symbol():
    figure = viz.verdict_matrix(
        {"nulls": {"a": "supported", "b": "not supported*"}, "modes": {"a": "cannot tell"}}
    )
    axes = figure.axes[0]
    symbols = [t.get_text() for t in axes.texts]
    colors = [to_hex(p.get_facecolor()).upper() for p in axes.findobj(Rectangle)[:3]]
    assert symbols == ["✓", "✗", "?"]
    assert colors == [viz.VERDICTS[v][0] for v in ("supported", "not supported", "cannot tell")]
    assert len(set(colors)) == len(set(symbols)) == 3
    assert {"nulls", "modes", "a", "b"} <= texts(figure)


def test_an_unknown_verdict_or_none_at_all_is_refused():
    with pytest.raises(InputError, match="expected a verdict of supported.*got 'maybe'"):
        viz.verdict_matrix({"nulls": {"a": "maybe"}})
    with pytest.raises(InputError, match="got none"):
        viz.verdict_matrix({})


def test_intervals_stand_over_the_range_of_the_claim():
    part = viz.Measured("share", [0.7, np.nan], [0.6, np.nan], [0.8, np.nan], least=0.5, unit="m")
    figure = viz.claim_intervals([part], ["a", "b"])
    low, high = figure.axes[0].get_xlim()
    assert low < 0.5 < 0.8 < high
    assert {"share (m)", "a", "b", "—"} <= texts(figure)


def test_an_interval_has_the_colour_of_its_verdict():
    part = viz.Measured("x", [0.0, 2.0, 1.0], [-0.1, 1.9, 0.5], [0.1, 2.1, 1.5], most=1.0)
    lines = viz.claim_intervals([part], ["in", "out", "across"]).axes[0].lines
    colors = [to_hex(line.get_color()).upper() for line in lines if len(line.get_xdata()) == 2]
    yes, no = viz.VERDICTS["supported"][0], viz.VERDICTS["not supported"][0]
    assert colors[-3:-1] == [yes, no]
    assert colors[-1] not in {yes, no}


def test_a_part_without_a_value_for_each_scene_is_refused():
    with pytest.raises(InputError, match=r"each of 2 scenes, got \[1\]"):
        viz.claim_intervals([viz.Measured("x", [1], [0], [2])], ["a", "b"])


@pytest.mark.parametrize("kind", ["curves", "points", "bars", "map"])
def test_every_kind_of_exhibit_is_drawn(kind):
    x = np.linspace(0, 1, 50)
    y = np.outer(x, x) if kind == "map" else x**2
    series = {"one": (x, y)} if kind == "map" else {"one": (x, y), "two": (x, 2 * y)}
    figure = viz.displays([viz.Display(kind, series, "x", "y", f"scene {i}") for i in range(2)])
    assert {"scene 0", "scene 1", "x", "y"} <= texts(figure)
    with pytest.raises(InputError, match="at least one panel"):
        viz.displays([])


def test_a_peak_does_not_squeeze_a_curve_and_nan_draws_nothing():
    y = np.ones(100)
    y[3] = 1e6
    figure = viz.displays([viz.Display("curves", {"loss": (np.arange(100), y)})])
    assert figure.axes[0].get_ylim()[1] < 10
    empty = viz.Display("curves", {"loss": (np.arange(100), np.full(100, np.nan))})
    viz.displays([empty]).draw_without_rendering()


# --- scenes -------------------------------------------------------------------------------------


def test_every_region_has_an_inset_and_two_histograms_in_a_colour_of_its_own(image, marks):
    figure = viz.region_study(image, marks, [panel(m.name) for m in marks], notes=["note"] * 9)
    found = texts(figure)
    assert {f"{i + 1} region {i}" for i in range(9)} <= found
    assert "note" in found
    insets = [a for a in figure.axes if a.get_title("left").startswith(tuple("123456789"))]
    assert len({to_hex(a.spines["top"].get_edgecolor()) for a in insets}) == 9


def test_a_region_without_a_panel_is_refused(image, marks):
    with pytest.raises(InputError, match="got 1 for 9"):
        viz.region_study(image, marks, [panel("a")])


def test_all_batches_and_their_means_are_drawn():
    counts = np.ones((64, 40))
    one = viz.BatchPanel("wall", EDGES, counts, EDGES, counts[0], 0.5)
    upper, lower = viz.batch_histograms([one], number=64, size=32).axes
    (batches,) = upper.collections
    assert len(batches.get_paths()) == 64
    assert len(upper.patches) == len(lower.patches) == 1
    assert [line.get_xdata()[0] for line in (*upper.lines, *lower.lines)] == [0.5, 0.5]
    with pytest.raises(InputError, match="at least one pixel"):
        viz.batch_histograms([], number=64, size=32)


def test_a_firefly_and_its_neighbour_are_named(image):
    pixels = {"firefly": (5, 5), "neighbour": (4, 5)}
    curves = {name: curve(i + 1.0) for i, name in enumerate(pixels)}
    figure = viz.firefly_pair(image, pixels, curves, curves, notes={"firefly": "9.3"})
    assert {"firefly: 9.3", "neighbour"} <= texts(figure)
    with pytest.raises(InputError, match="got 1 pixels"):
        viz.firefly_pair(image, {"firefly": (5, 5)}, curves, curves)


def test_two_views_share_one_exposure(image):
    log = {f"region {i}": {"short": curve(), "long": curve(2.0)} for i in range(5)}
    figure = viz.view_pair({"short": image / 2, "long": image}, log)
    dark, bright = (a.images[0].get_array().mean() for a in figure.axes if a.images)
    assert dark < 0.85 * bright
    assert "region 3" in texts(figure)
    assert "region 4" not in texts(figure)
    with pytest.raises(InputError, match="got 1"):
        viz.view_pair({"short": image}, log)
