"""Brushing: which pixels hold the samples of a range, and what the histogram of an image counts."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

import chdstat as chd
from chdstat.explorer.address import NULLS, View, channel_name, parse_view
from chdstat.explorer.brushing import brushed
from chdstat.explorer.image_sources import BINS, ImageAccumulator, ImageSource, StoreSource, stream
from chdstat.explorer.panels import image_panel
from chdstat.explorer.selection import SelectionResults
from chdstat.explorer.workspace import Workspace
from chdstat.io import write_exr
from tests.luminance import LUMINANCE

SIZE, SPP = (70, 9), 130
"""More than one tile, and more than two batches."""


@pytest.fixture(scope="module")
def known():
    """Samples of luminance 1, but for ones of 10 at two pixels, nulls, and bad ones."""
    x = np.ones((*SIZE, 3, SPP), np.float32)
    x[68, 2, :, 100:110] = 10
    x[3, 4, :, 5] = 10
    x[..., 64:65][20:22] = 0  # a null in each of 18 pixels
    x[0, 0, 1, :] = np.nan
    return chd.Samples.from_array(x, scene="known")


def counted(samples, brush, channel="all"):
    *steps, (share, found) = brushed(StoreSource(samples), brush, channel)
    assert share == 1
    assert [s for s, _ in steps] == sorted(s for s, _ in steps)
    return found


def test_pixels_of_a_range_are_those_that_hold_its_samples(known):
    found = counted(known, (5, 20))
    assert {(int(y), int(x)): int(found.count[y, x]) for y, x in np.argwhere(found.count)} == {
        (68, 2): 10,
        (3, 4): 1,
    }
    assert found.share[68, 2] == pytest.approx(10 / SPP)
    assert np.isnan(found.share).sum() == found.share.size - 2
    assert found.good[0, 0] == 0
    light, theirs = 110, 110 + 2 * SPP - 11
    everything = (SIZE[0] * SIZE[1] - 1) * SPP - 18 + 11 * 9
    assert found.light.sum() == pytest.approx(light, rel=1e-6)
    assert found.total.sum() == pytest.approx(everything, rel=1e-6)
    said = found.told((5, 20), "luminance").replace("\N{NO-BREAK SPACE}", " ")
    assert said == (
        f"2 pixels hold 11 samples with luminance from 5.00 to 20.0: "
        f"{100 * light / theirs:.0f} % of their light, < 0.2 % of all"
    ).replace("< 0.2", f"{100 * light / everything:.1f}")


def test_nulls_have_a_brush_of_their_own(known):
    found = counted(known, NULLS)
    assert found.count.sum() == 18
    assert set(np.argwhere(found.count)[:, 0]) == {20, 21}
    assert "18 pixels hold 18 null samples: " in found.told(NULLS, "luminance")
    assert not counted(known, (-1, 0.5)).count.any()  # zeros that are nulls are in no range
    assert counted(known, (2, None)).count.sum() == 11
    assert counted(known, (None, 2)).count.sum() == (SIZE[0] * SIZE[1] - 1) * SPP - 18 - 11
    near = counted(known, (99.94, 100.02)).told((99.94, 100.02), "luminance")
    assert near.endswith("from 99.9400 to 100.020")
    assert counted(known, (11, 12)).told((11, 12), "R").startswith("No pixel holds samples with R")


def test_a_brush_counts_by_the_channel_that_is_shown():
    x = np.zeros((1, 2, 3, 4), np.float32)
    x[0, 0, 0], x[0, 1, 2] = 3, 3
    samples = chd.Samples.from_array(x)
    assert counted(samples, (2, 4), "0").count.tolist() == [[4, 0]]
    assert counted(samples, (2, 4), "2").count.tolist() == [[0, 4]]
    weights = [3 * LUMINANCE[0], 3 * LUMINANCE[2]]
    assert counted(samples, (0.9 * weights[1], 1.1 * weights[1])).count.tolist() == [[0, 4]]
    assert counted(samples, (0.9 * weights[0], 1.1 * weights[0])).count.tolist() == [[4, 0]]


def test_a_single_channel_is_luminance(tmp_path):
    source = StoreSource(chd.Samples.from_array(np.ones((2, 2, 1, 8), np.float32)))
    write_exr(tmp_path / "grey.exr", np.ones((2, 2, 1), np.float32))
    assert source.channels == ImageSource(tmp_path / "grey.exr").channels == ("luminance",)
    assert channel_name("all", source.channels) == "luminance"


def test_first_samples_of_all_pixels_come_first(known):
    for _, found in brushed(StoreSource(known), (0.5, 2), "all"):
        if found.good[69, 0] > 0:
            break
    assert found.good[1, 0] == 64


def test_memory_grows_with_the_image_and_not_with_the_samples():
    most = []
    for spp in (64, 1024):
        samples = chd.Samples.from_array(np.ones((64, 64, 1, spp), np.float32))
        source = StoreSource(samples)
        tracemalloc.start()
        for _ in brushed(source, (0.5, 2), "all"):
            pass
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert most[1] < 1.2 * most[0]


def test_the_address_holds_the_brush():
    for brush, text in (((0.5, 2.0), "0.5,2.0"), ((None, 2.0), ",2.0"), (NULLS, "null")):
        view = View().changed("brush", brush)
        assert view.overlay == "brushed"
        assert parse_view({"b": [text]}, 8, 8) == (view, [])
        assert dict(p.split("=") for p in view.query().split("&"))["b"].replace("%2C", ",") == text
    assert View().changed("brush", NULLS).changed("brush", None).overlay == "image"
    for wrong in ("2,1", ",", "nan,1", "1", "inf,", "wave"):
        view, notes = parse_view({"b": [wrong]}, 8, 8)
        assert view.brush is None
        assert "a range of radiance must be" in notes[0]
    assert parse_view({"b": ["2,1"]}, 8, 8)[1][0].endswith("got 2,1")


def test_an_image_that_has_no_samples_refuses_a_brush(known):
    shared = Workspace([StoreSource(known)])
    view = View(brush=(5.0, 20.0))
    shared.want("page", view)
    while (found := shared.map(view)) is None or found.done < 1:
        pass
    assert found.note.startswith("2 pixels hold 11 samples")
    other = View(brush=(5.0, 21.0))
    assert shared.key(view) != shared.key(other)
    shared.stop()


def test_the_histogram_of_an_image_counts_every_sample(known):
    *_, (_, whole) = stream(StoreSource(known))
    good = (SIZE[0] * SIZE[1] - 1) * SPP
    assert whole.histogram.sum(axis=-1).tolist() == [good - 18] * 4  # channels and luminance
    at = np.searchsorted(BINS, 10.0, side="right")
    assert whole.histogram[-1, at - 2 : at + 2].sum() == 11
    drawn = image_panel(View(), {"known": whole}, known.channels)
    samples, means = drawn.lines
    assert samples.fill
    assert not means.fill
    width = np.log10(samples.x[2::2] / samples.x[1:-1:2])
    heights = samples.y[1:-1:2]
    assert heights @ width == pytest.approx(1, abs=1e-6)  # a density per decade


def test_the_histogram_is_the_same_however_it_is_read(known):
    *_, (_, whole) = stream(StoreSource(known))
    sums = ImageAccumulator(*SIZE)
    for ss in (slice(0, 50), slice(50, SPP)):
        sums.add(known.read(ss=ss))
    np.testing.assert_array_equal(sums.overall().histogram, whole.histogram)


def test_a_region_stands_beside_the_image(known):
    shared = Workspace([StoreSource(known)])
    *_, (_, shared.overalls[0]) = stream(shared.sources[0])
    plots = SelectionResults(shared).plots(View(region=(60, 0, 70, 4), channel="luminance"))
    shared.stop()
    assert plots.title == "Region y 60–69, x 0–3 · 40 pixels · 5\u2009200 samples"
    own, *_, image = plots.panels["log"].lines
    assert own.fill
    assert image.dash == "2 4"
    assert image.color == own.color
    assert "dotted: the image" in plots.panels["log"].notes


def test_what_is_guessed_is_what_a_click_shows(known):
    """Work that a pointer at rest begins is that of the click; another view is computed anew."""
    results, calls = SelectionResults(Workspace([StoreSource(known)])), []
    view = View().pick(68, 2)
    results.guess(view, lambda: calls.append("step"))
    assert len(calls) > 5
    shown = []
    looked = view.changed("exposure", 2.0)  # does not matter to results
    plots, tables, _ = results.results(looked, shown.append)
    assert shown == [plots]
    anew, again, _ = SelectionResults(results._workspace).results(view, shown.append)
    assert plots.title == anew.title == "Pixel · y 68, x 2 · 130 samples"
    assert tables == again
    other, *_ = results.results(view.pick(3, 4), shown.append)
    assert other.title.startswith("Pixel · y 3, x 4")

    def ended():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        results.guess(view.pick(9, 5), ended)
    results._workspace.stop()
