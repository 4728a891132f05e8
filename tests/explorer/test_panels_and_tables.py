"""What is computed of a place, and what panels and tables make of it."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import Reason
from chdstat.estimators import registry
from chdstat.explorer import tables
from chdstat.explorer.address import FITS, View
from chdstat.explorer.batch_estimates import batches_of, estimates, estimates_around
from chdstat.explorer.image_sources import MOST_POOLED, StoreSource
from chdstat.explorer.panels import PanelData, Trace, encode_panels, extent, panels, series_of
from chdstat.fit.families import FAMILIES
from chdstat.fit.tail import TailIndex
from chdstat.inference.differences import difference
from chdstat.patterns import PATTERNS, Pixel
from chdstat.reporting.figures import FIGURES, ReportData
from chdstat.samples import Region
from chdstat.studies.scene_data import SceneData
from chdstat.studies.studies import SceneStudy

RGB = ("R", "G", "B")


def pixel(x):
    return Pixel(0, 0, x, RGB, "noise", most_fitted=MOST_POOLED)


def gamma(spp=512, seed=1, null=0.3):
    rng = np.random.default_rng(seed)
    x = rng.gamma(2.0, size=(3, spp)).astype(np.float32)
    x[:, rng.random(spp) < null] = 0
    return x


def hard():
    """Return samples that break formulas, by what they are."""
    x = gamma()
    spoilt = x.copy()
    spoilt[0, ::7], spoilt[1, 1::7], spoilt[2, 2::7] = np.nan, np.inf, -1
    firefly = x.copy()
    firefly[:, 5] = 1e6
    return {
        "null": np.zeros((3, 64), np.float32),
        "bad": np.full((3, 64), np.nan, np.float32),
        "constant": np.full((3, 64), 0.25, np.float32),
        "one": x[:, :1],
        "two": x[:, :2],
        "few": x[:, :9],
        "spoilt": spoilt,
        "huge": x * np.float32(1e30),
        "subnormal": x * np.float32(1e-40),
        "firefly": firefly,
        "one channel null": np.concatenate([np.zeros((1, 512), np.float32), x[1:]]),
        "two values": np.where(x > 1, 1, 2).astype(np.float32),
    }


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", hard())
@pytest.mark.parametrize("channel", ["all", "1"])
def test_no_sample_breaks_panels_or_tables(name, channel):
    place = pixel(hard()[name])
    view = View(families=FITS, batch=4, channel=channel)
    drawn = panels(view, series_of(view, {"a": [place, place]}))
    for panel in [
        *drawn.values(),
        *panels(view, series_of(view, {"a": [place], "b": [place]})).values(),
    ]:
        for trace in panel.lines:
            assert len(trace.x) == len(trace.y)
    encode_panels(drawn)
    assert len(tables.headline(place)) == 5
    shown = []
    for places in ([place], [place, place]):
        columns = tables.columns_of(places, channel)
        shown += [tables.statistics_table(columns), tables.patterns_table(columns)]
    shown.append(tables.estimates_table(estimates(batches_of(place.radiance, 8)), RGB, 8))
    found = difference(place.radiance, place.radiance)
    shown.append(tables.compared_table(found, RGB, ("a", "b")))
    for table in shown:
        assert all(isinstance(cell, str) for row in table["rows"] for cell in row)
        assert not [c for row in table["rows"] for c in row if re.search(r"\b(nan|inf)\b", c)]


def test_nulls_and_bad_samples_are_apart():
    x = gamma(null=0.0)
    x[:, :128] = 0
    x[1, 128:192] = np.nan
    place = pixel(x)
    assert place.null_share == pytest.approx(128 / 448)
    assert int(place.bad.sum()) == 64
    assert int(place.histograms["log"].counts.sum(axis=-1)[0]) == 512 - 128 - 64
    notes = panels(View(), series_of(View(), {"a": [place]}))["log"].notes
    assert notes[0] == "29\u00a0% null · 64 bad"
    assert notes[-2:] == ["R, G: gamma", "B: Weibull"]


def test_a_pixel_without_a_good_sample_has_no_numbers():
    place = pixel(hard()["bad"])
    assert np.isnan(place.moments.mean).all()
    assert {tuple(row[1:]) for row in tables.headline(place)} == {("—", "all 64 samples are bad")}
    assert tables.why(place)[1].startswith("all samples are bad")


def test_flags_that_a_value_sets_are_said_to_be():
    note = tables.patterns_table(tables.columns_of([pixel(gamma())], "all"))["note"]
    assert "by the value, even where its interval holds the threshold" in note
    assert {p.name for p in PATTERNS if p.decisive} == {"null_heavy"}
    assert "null-heavy where a test at the 5 % level" in note


def test_all_draw_the_same_curve():
    """The explorer, a notebook and a report: the mixture of what has two humps."""
    rng = np.random.default_rng(11)
    bright = np.where(rng.random(512) < 0.4, 60.0, 1.0)
    x = (rng.lognormal(-1.0, 0.5, (3, 512)) * bright).astype(np.float32)
    samples = chd.Samples.from_array(np.tile(x, (8, 8, 1, 1)))
    place = samples.pixel(1, 1)
    curves = [place.curve(row) for row in range(4)]
    assert {curve.family for curve in curves} == {"mixture"}

    def agree(those, lines):
        for curve, (at, drawn) in zip(those, lines, strict=True):
            assert drawn.max() > 0
            np.testing.assert_allclose(curve.density(at, 0.1, "log"), drawn)

    def on(figure):
        (ax,) = (ax for ax in figure.axes if ax.get_xscale() == "log")
        return [line.get_data() for line in ax.lines if len(line.get_xdata()) > 2]

    view = View()
    lines = panels(view, series_of(view, {"a": [place]}))["log"].lines
    agree(curves[:3], [(t.x, t.y) for t in lines if not t.fill and len(t.x) > 2])
    agree(curves[:3], on(samples.plot(1, 1)))
    agree(curves[3:], on(samples.regions({"wall": (1, 1)}).plot()))
    region = Region("wall", "bimodal", (0, 0, 0.5, 0.5))
    study = SceneStudy(SceneData("hall", samples, (region,)), ())
    (of_report,) = (figure for figure in FIGURES if figure.name == "regions")
    agree(curves[3:], on(of_report.draw(ReportData(study))))


def test_label_modes_and_curve_agree_in_words():
    """How many modes stand out, and what keeps the likelier family from a pixel."""
    rng = np.random.default_rng(13)
    two = rng.lognormal(-1.0, 0.5, 512) * np.where(rng.random(512) < 0.4, 60.0, 1.0)
    found = chd.modality(two[np.newaxis])
    assert found.in_words(0) == "2"
    three = replace(found, modes=np.array([3]), ashman_d=np.array([[3.0, 1.2]]))
    assert three.in_words(0) == "3, 2 of them clear"
    assert replace(three, ashman_d=np.array([[1.0, 1.2]])).in_words(0) == "3 that overlap"
    square = np.exp(rng.uniform(-3.0, 3.0, 512))  # one mode with edges that no family has
    words = {}
    for name, x in (("two", two), ("square", square)):
        place = pixel(np.broadcast_to(x, (3, 512)).astype(np.float32))
        table = tables.patterns_table(tables.columns_of([place], "all"))
        words[name] = " ".join(row[2] for row in table["rows"] if "-like" in row[0])
    assert ", but bimodal" in words["two"]
    assert ", but misfit 0." in words["square"]


def test_nearly_constant_samples_are_a_spike_without_fits():
    rng = np.random.default_rng(1)
    x = (2.5 * (1 + 1e-6 * rng.normal(size=(3, 512)))).astype(np.float32)
    place = pixel(x)
    view = View(families=FITS)
    drawn = panels(view, series_of(view, {"a": [place]}))
    assert place.constant.all()
    assert place.curve(0).fit is None
    spikes = [float(line.x[0]) for line in drawn["linear"].lines]
    np.testing.assert_allclose(spikes, x.max(axis=-1))
    assert drawn["qq"].notes == ["constant samples"]
    columns = tables.columns_of([place], "all")
    table = {row[0]: row[1] for row in tables.statistics_table(columns)["rows"]}
    assert table["best family by BIC"] == "—"
    assert table["tail index ξ of all samples"] == "—"
    assert tables.patterns_table(columns)["title"] == "Patterns: constant"
    spread = pixel((x - 2.5) * 1e4 + 2.5)  # the control: 1 % of the mean
    assert not spread.constant.any()


def test_rows_of_several_pixels_stay_apart_and_keep_their_shape():
    places = [pixel(k * gamma(seed=i)) for i, k in enumerate((1, 1e3))]
    drawn = panels(View(), series_of(View(), {"a": places}))
    for name in ("linear", "log", "averages"):
        assert drawn[name].rows == 2
        first, second = (t for t in drawn[name].lines if t.fill)
        assert second.y.min() == pytest.approx(0)
        assert first.y.min() == pytest.approx(1)
        assert second.y.max() < 1
    one, two = (a.x for a in drawn["linear"].lines if a.fill)
    assert (one.min(), one.max()) == (two.min(), two.max()) == (0, 1)


def test_the_same_pixel_of_several_stores_stands_in_one_plot():
    """A row of luminance for each store, in its colour; of several pixels, the rows stay apart."""
    one, two = (pixel(k * gamma(seed=k)) for k in (1, 2))
    found = series_of(View(), {"a": [one], "b": [two]})
    assert [(s.name, s.place.names[s.row]) for s in found] == [
        ("a", "luminance"),
        ("b", "luminance"),
    ]
    areas = [t for t in panels(View(), found)["log"].lines if t.fill]
    assert [a.color for a in areas] == [s.color for s in found]
    assert len({s.color for s in found}) == 2
    drawn = panels(View(), series_of(View(), {"a": [one, two], "b": [two, one]}))["linear"]
    assert drawn.rows == 2
    dark = pixel(gamma(null=0.6))
    texts = panels(View(), series_of(View(), {"a": [one, two], "b": [dark, one]}))["log"].texts
    nulls = [f"{100 * p.null_share:.0f}\N{NO-BREAK SPACE}%" for p in (one, dark, two)]
    assert texts[1][2] == f"{nulls[0]} / {nulls[1]} null"  # of both stores, in their order
    assert texts[3][2] == f"{nulls[2]} / {nulls[0]} null"
    assert [a.y.max() >= 1 for a in drawn.lines if a.fill] == [True, True, False, False]


def test_the_place_says_what_the_library_says():
    x = gamma()
    place = pixel(x)
    null = np.broadcast_to((x == 0).all(axis=0), x.shape)
    assert place.selection.best.tolist() == chd.fit.select(x, null=null).best.tolist()
    np.testing.assert_allclose(place.tail.xi, chd.fit.tail_index(x, null=null).xi)
    np.testing.assert_allclose(place.moments.mean[:3], x.mean(axis=-1), rtol=1e-6)
    assert int(place.patterns.label) == int(chd.classify(x).label)


def test_the_running_mean_ends_at_the_mean_and_its_error():
    place = pixel(gamma())
    at, means, errors = place.running
    assert at[-1] == 512
    np.testing.assert_allclose(means[:, -1], place.moments.mean, rtol=1e-9)
    np.testing.assert_allclose(errors[:, -1], place.moments.standard_error, rtol=1e-9)


def test_averages_leave_bad_samples_out():
    x = gamma(64)
    x[0, 3] = np.inf
    averages = pixel(x).averages(9)
    assert averages.shape == (4, 7)
    np.testing.assert_allclose(averages[1, 0], np.delete(x[1], 3)[:9].mean(), rtol=1e-6)


def test_later_samples_keep_what_was_found_of_the_first():
    x = gamma(MOST_POOLED + 64)
    first = pixel(x[:, :-32])
    patterns = first.patterns
    second = first.grown(x)
    assert second.patterns is patterns
    assert second.moments.count[0] == x.shape[1]
    few = pixel(x[:, :100])
    assert few.grown(x).fitted_spp > few.fitted_spp
    assert few.patterns is not few.grown(x).patterns


def test_quantiles_of_the_true_family_lie_on_the_diagonal():
    """Quantiles of 4096 gamma samples; 20 % is beyond 6 standard errors away from the ends."""
    place = pixel(gamma(4096, null=0.4))
    view = View(families=("gamma",))
    _, *lines = panels(view, series_of(view, {"a": [place]}))["qq"].lines
    for line in lines:
        middle = slice(20, 80)
        np.testing.assert_allclose(line.y[middle], line.x[middle], rtol=0.2)
    few = pixel(gamma(60, null=0))
    _, *lines = panels(view, series_of(view, {"a": [few]}))["qq"].lines
    assert [len(line.y) for line in lines] == [60, 60, 60]


def test_the_curve_of_averages_is_gaussian():
    place, view = pixel(gamma()), View(batch=8)
    drawn = panels(view, series_of(view, {"a": [place]}))["averages"]
    curves = [line for line in drawn.lines if line.dash == "dotted"]
    for line, averages in zip(curves, place.averages(8)[:3], strict=True):
        right = stats.norm(averages.mean(), averages.std(ddof=1))
        np.testing.assert_allclose(line.y, right.pdf(line.x))
        assert line.x[0] <= max(0, right.ppf(0.05)) < right.ppf(0.95) <= line.x[-1]


def test_few_fireflies_among_the_averages_squeeze_nothing():
    x = np.random.default_rng(0).gamma(2.0, size=(3, 32 * 500)).astype(np.float32)
    x[:, 7] = 1e5
    drawn = panels(View(batch=32), series_of(View(batch=32), {"a": [pixel(x)]}))["averages"]
    assert drawn.notes[-1] == "0.2\u00a0% beyond"
    for area in (t for t in drawn.lines if t.fill):
        assert area.x.max() < 10
        assert np.trapezoid(area.y, area.x) == pytest.approx(0.998, abs=1e-6)


def test_a_p_value_below_all_floats_is_said_to_be():
    p = np.array([0.0, 2e-5, 0.02, 0.5, np.nan])
    place = pixel(gamma())
    reasons = np.array([0, 0, 0, 0, Reason.TIED])

    def test_of(p, reason):
        p_value, effect = (np.stack([v, v], axis=-1) for v in (p, np.ones(4)))
        about = {"statistic": effect, "resamples": 199, "reason": reason[:, np.newaxis]}
        return {"gamma": SimpleNamespace(p_value=p_value, effect=effect, **about)}

    found = test_of(p[1:], reasons[1:])
    (row,) = tables.goodness_table(place, found)["rows"]
    cells = [cell.partition(" (D")[0] for cell in row[1:]]
    assert cells == ["2e−5", "0.020", "0.50", "tied"]
    found = test_of(p[:4], reasons[:4])
    (row,) = tables.goodness_table(place, found)["rows"]
    assert row[1].startswith("≈\u00a00")


def test_p_values_of_the_true_family_are_not_small():
    """Gamma samples; the least p that 40 replicates can give happens to 1 of 10 seeds: not here."""
    found = dict(pixel(gamma(256)).goodness(resamples=40))
    assert (found["gamma"].p_value[:, 0] > 1.5 / 41).all()
    assert found["lognormal"].p_value[:, 0].min() == pytest.approx(1 / 41)  # the control


def test_extents_hold_all_that_is_drawn():
    place = pixel(gamma())
    for name, panel in panels(View(), series_of(View(), {"a": [place]})).items():
        (left, right), (bottom, top) = extent(name, panel)
        for trace in panel.lines:
            y = trace.y[np.isfinite(trace.y)]
            assert left < trace.x.min()
            assert trace.x.max() < right
            assert bottom <= y.min()
            assert y.max() < top
    assert extent("log", PanelData()) is None
    alone = Trace(np.array([2.0]), np.array([3.0]), "#ffffff")
    assert extent("qq", PanelData(lines=[alone])) == (
        pytest.approx((1.0, 4.0)),
        pytest.approx((1.5, 6.0)),
    )


# --- estimators ---------------------------------------------------------------------------------


def test_estimates_are_of_the_batches_and_tell_which_are_biased():
    x = gamma(4096)
    found = {e.name: e.values for e in estimates(batches_of(x, 32))}
    assert set(found) == {
        name for name in registry.names("fixed") if not registry.lookup(name).uses_neighbours
    }
    np.testing.assert_allclose(found["mean"][1], x[:, 32:64].mean(axis=-1), rtol=1e-6)
    assert (found["median"].mean(axis=0) < 0.9 * found["mean"].mean(axis=0)).all()  # skewed
    row = next(
        row for row in tables.estimates_table(estimates(batches_of(x, 32)), RGB, 32)["rows"]
        if row[0] == "sample mean"
    )  # fmt: skip
    mean, scatter = found["mean"].mean(axis=0), found["mean"].std(axis=0, ddof=1)
    assert row[1].startswith(f"{mean[0]:.2f} ± {scatter[0]:.3f}")


def test_estimators_that_look_around_see_the_pixels_around():
    x = np.random.default_rng(1).gamma(2.0, size=(21, 21, 3, 128)).astype(np.float32)
    found = estimates_around(StoreSource(chd.Samples.from_array(x)), (10, 10), 32)
    entries = (registry.lookup(name) for name in registry.names("fixed"))
    around = {e.name for e in entries if e.uses_neighbours and not e.learns}
    assert {e.name for e in found} == around | {"combination", "mean + OIDN"}
    # All pixels share one distribution: averaging over them must help.
    patches = {e.name: e.values for e in found}["shared_patches"]
    alone = batches_of(x[10, 10], 32).mean(axis=-1)
    assert patches.std(axis=0).mean() < 0.5 * alone.std(axis=0).mean()


def test_too_few_samples_have_no_estimate():
    assert len(batches_of(gamma(16), 32)) == 0
    table = tables.estimates_table([], RGB, 32)
    assert table["rows"] == []
    assert "too few" in table["note"]


def test_a_pixel_has_one_answer_about_its_error_bar():
    x = gamma()
    x[:, int(np.argmax(x[0]))] = x.sum()
    for values, holds in ((x, False), (gamma(), True)):
        place = pixel(values)
        assert place.patterns.flags["long_tail"] == (not holds)
        told = tables.headline(place)[2][2]
        assert told.startswith(f"error bar of {place.spp} spp")
        assert told.endswith("fails") == (not holds)
        rows = {
            row[0]: row
            for row in tables.statistics_table(tables.columns_of([place], "all"))["rows"]
        }
        assert (rows["error bar of so many spp"][-1] == "fails") == (not holds)
        misses = float(place.patterns.statistics["long_tail"])
        assert misses == pytest.approx(1 - float(place.measured(TailIndex()).coverage_own[-1]))


@pytest.mark.parametrize("name", ["null", "bad", "constant", "one", "few", "huge", "subnormal"])
def test_no_sample_breaks_the_test_of_fits(name):
    place = pixel(hard()[name])
    found = dict(place.goodness(resamples=2))
    p_values = np.stack([test.p_value[:, 0] for test in found.values()])
    assert p_values.shape == (len(FAMILIES), 4)
    known = p_values[np.isfinite(p_values)]
    assert ((known > 0) & (known <= 1)).all()
    assert len(tables.goodness_table(place, found)["rows"]) == len(FAMILIES)
