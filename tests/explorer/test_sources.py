"""Where samples come from, and the images and maps made of them."""

from __future__ import annotations

import itertools
import shutil
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import chdstat as chd
from chdstat.errors import InputError, SceneError, StoreError
from chdstat.explorer import workspace
from chdstat.explorer.address import View
from chdstat.explorer.bokeh_document import rgba
from chdstat.explorer.image_sources import (
    FIRST_SPP,
    ImageAccumulator,
    Overall,
    SceneSource,
    StoreSource,
    pooled,
    stream,
)
from chdstat.explorer.overlays import COST, IMAGES, MAPS, OF_FILM, map_kind, map_of_view, walk
from chdstat.explorer.render_process import RenderProcess
from chdstat.patterns import classify, film_split
from chdstat.rendering import render_pixels
from chdstat.rendering.jobs import Job
from chdstat.samples import Samples
from chdstat.samples.tiles import FILM
from tests.luminance import LUMINANCE

ARRAYS = dict[str, npt.NDArray[Any]]


def ended(work):
    """Return what a pass yields in the end."""
    *_, (share, found) = work
    assert share == 1
    return found


@pytest.fixture(scope="module")
def source(store_path):
    return StoreSource(chd.open(store_path))


@pytest.fixture
def flames():
    """Samples in memory with nulls, bad ones and all shapes, 20 x 12 pixels."""
    rng = np.random.default_rng(1)
    x = rng.lognormal(sigma=rng.uniform(0.2, 2, (12, 20, 1, 1)), size=(12, 20, 3, 256))
    x *= rng.random((12, 20, 1, 256)) < 0.7
    x[0, 0], x[0, 1], x[0, 2, 1, ::3] = np.nan, 0, -1
    return chd.Samples.from_array(x, scene="flames")


# --- stores -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("y", "x"), [(0, 0), (31, 31), (15, 16), (16, 15)])
def test_a_pixel_is_what_the_store_holds(source, y, x):
    expected = source.samples[y, x]
    for _ in range(2):  # read, then remembered
        np.testing.assert_array_equal(source.pixel(y, x), expected)


@pytest.mark.parametrize(("y", "x"), [(-1, 0), (0, 32), (32, 0)])
def test_a_pixel_outside_is_refused(source, y, x):
    with pytest.raises(InputError, match="32 x 32"):
        source.pixel(y, x)


def test_a_region_pools_as_many_samples_of_each_pixel(source):
    found = source.region((4, 6, 8, 9))
    assert found.shape == (3, 4 * 3 * 64)
    expected = source.samples.read(slice(4, 8), slice(6, 9))
    whole = expected.transpose(2, 0, 1, 3).reshape(3, -1)
    # Whole samples, in another order: consecutive ones are of different pixels.
    order = np.lexsort(found), np.lexsort(whole)
    np.testing.assert_array_equal(found[:, order[0]], whole[:, order[1]])
    assert (found != whole).any()
    np.testing.assert_array_equal(found, source.region((4, 6, 8, 9)))


@pytest.mark.parametrize("size", [(1, 2), (8, 8), (300, 500), (4000, 4000)])
@pytest.mark.parametrize("spp", [1, 64, 10**6])
def test_a_pooled_region_is_never_too_much(size, spp):
    each, step = pooled(*size, spp)
    pixels = -(-size[0] // step) * -(-size[1] // step)
    assert 1 <= each <= spp
    assert pixels * each <= 2**15


def test_a_store_that_grows_is_seen_to_grow(own_store):
    shutil.rmtree(own_store)
    chd.render("cornell-box", spp=64, size=(16, 16), out=own_store, backend="scalar")
    source = StoreSource(chd.open(own_store))
    assert source.complete
    assert source.refreshed() is None
    chd.render("cornell-box", spp=96, size=(16, 16), out=own_store, backend="scalar")
    grown = source.refreshed()
    assert grown is not None
    assert grown.samples.spp == 96


def test_memory_does_not_grow_with_the_store():
    """8 MB of samples, 1 MB at a time: whole blocks are read, the image is never held."""
    rng = np.random.default_rng(1)
    source = StoreSource(chd.Samples.from_array(rng.random((64, 64, 3, 640), np.float32)))
    peaks = []
    for spp in (192, 640):
        part = chd.Samples.from_array(source.samples.read(ss=slice(0, spp)))
        tracemalloc.start()
        ended(stream(StoreSource(part)))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


# --- images and maps --------------------------------------------------------------------------


def test_the_streamed_image_is_the_summary(flames):
    found, expected = ended(stream(StoreSource(flames))), chd.summarize(flames, progress=False)
    np.testing.assert_allclose(found.mean, expected["mean"], rtol=1e-5)
    np.testing.assert_allclose(found.null_share, expected["null_share"], rtol=1e-6)
    np.testing.assert_array_equal(found.bad_count, expected["bad_count"])
    assert np.isnan(found.mean[0, 0]).all()


@pytest.mark.parametrize("name", [n for n in MAPS if n not in {"pattern", COST.name, *OF_FILM}])
def test_every_map_covers_the_image(flames, name):
    source = StoreSource(flames)
    if name in IMAGES:
        found = IMAGES[name].filled(getattr(ended(stream(source, spp=64)), name))
    else:
        found = replace(map_kind(name, 256), values=ended(walk(source, name)))
    assert found.values.shape == (12, 20)
    assert np.isfinite(found.values[1:]).any()
    low, high = found.limits
    assert low < high
    if found.names:
        assert set(np.unique(found.values[np.isfinite(found.values)])) <= set(found.names)


def test_maps_of_film_need_to_know_where_samples_fell(flames):
    for name in OF_FILM:
        with pytest.raises(InputError, match="--film"):
            ended(walk(StoreSource(flames), name))


def test_the_map_of_costs_is_what_was_measured(flames):
    with pytest.raises(InputError, match="--cost"):
        ended(walk(StoreSource(flames), COST.name))
    seconds = 1e-6 * np.arange(1.0, 241).reshape(12, 20)
    timed = Samples.from_array(flames.read(), seconds=seconds)
    found = ended(walk(StoreSource(timed), COST.name))
    np.testing.assert_allclose(found, np.maximum(1e6 * seconds, 120.5 / 20), rtol=1e-5)


def test_the_map_of_film_is_the_split():
    rng = np.random.default_rng(1)
    places = rng.random((9, 20, 2, 64))
    x = rng.gamma(2.0, size=(9, 20, 3, 64))
    x[:, :9] += 9 * (places[:, :9, :1] > 0.5)
    film = Samples.from_array(places)
    samples = Samples(x.astype(np.float32), attrs={}, parts={FILM: film})
    found = ended(walk(StoreSource(samples), "film"))
    np.testing.assert_allclose(found, film_split(samples, progress=False)["share_told"], rtol=1e-6)


def test_maps_say_what_the_library_says(flames):
    source = StoreSource(flames)
    labels = classify(flames, progress=False)["label"]
    np.testing.assert_array_equal(ended(walk(source, "pattern")), labels)
    tail = chd.fit.tail_index(np.einsum("yxcs,c->yxs", flames.read()[3:5], LUMINANCE))
    found = ended(walk(source, "tail_index"))
    np.testing.assert_allclose(found[3:5], tail.xi, atol=1e-5)
    holds = ended(walk(source, "error_bar"))[3:5]
    np.testing.assert_array_equal(holds == 2, tail.variance_trusted)
    np.testing.assert_array_equal(holds == 1, tail.variance_unidentified)
    np.testing.assert_array_equal(holds == 0, tail.variance_suspect)


def test_a_walk_has_values_of_every_tile_that_is_done(flames):
    """Coarse ones first: after half of it, the rest of the image is not empty either."""
    (early, _), *_, (late, values) = itertools.islice(walk(StoreSource(flames), "tail_index"), 4)
    assert 0 == early < late < 1
    assert np.isfinite(values[1:]).any()


def test_passes_are_kept_and_forgotten_when_store_or_code_change(own_store, monkeypatch):
    samples, calls = chd.open(own_store), []

    def compute():
        calls.append(1)
        yield 0.5, {"v": np.arange(2)}
        yield 1.0, {"v": np.arange(3)}

    def asked(samples, name):
        return ended(workspace.kept(samples, name, ARRAYS, compute()))

    next(workspace.kept(samples, "x", ARRAYS, compute()))  # what is not ended is not kept
    for _ in range(2):
        np.testing.assert_array_equal(asked(samples, "x")["v"], np.arange(3))
    assert len(calls) == 2
    asked(samples, "y")
    with monkeypatch.context() as patch:
        patch.setattr("chdstat._core.files.code_digest", lambda: "another")
        asked(samples, "x")
    shutil.rmtree(own_store)
    again = chd.render("cornell-box", spp=samples.spp, size=(8, 8), seed=9, out=own_store)
    in_memory = chd.Samples.from_array(np.ones((2, 2, 3, 4)))
    for one in (again, in_memory, in_memory):
        asked(one, "x")
    assert len(calls) == 7


@pytest.mark.parametrize("tone", ["srgb", "reinhard", "filmic"])
def test_tones_rise_with_radiance_and_show_what_is_not_finite(tone):
    ramp = np.geomspace(1e-6, 1e30, 200, dtype=np.float32)
    shown = rgba(np.repeat(ramp[np.newaxis, :, np.newaxis], 3, axis=2), 0.0, tone)
    red = shown[0] & 0xFF
    assert (np.diff(red.astype(int)) >= 0).all()
    assert red[-1] == 255
    broken = rgba(np.array([[[np.nan, 1, 1], [np.inf, 0, 0]]], np.float32), 0.0, tone)
    assert [hex(v) for v in broken[0]] == ["0xffff00ff"] * 2  # magenta


# --- scenes -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene():
    return SceneSource(RenderProcess(Job.of("cornell-box", size=(24, 16), backend="scalar")))


def test_more_samples_of_a_pixel_are_new_ones(scene):
    first = scene.pixel(8, 12)
    assert first.shape == (3, FIRST_SPP)
    second = scene.more(8, 12)
    third = scene.more(8, 12)
    assert third.shape == (3, 4 * FIRST_SPP)
    np.testing.assert_array_equal(third[:, :FIRST_SPP], first)
    np.testing.assert_array_equal(third[:, : second.shape[1]], second)
    lit = third[0][third[0] > 0]
    assert len(np.unique(lit)) > 0.98 * len(lit)


def test_samples_of_a_scene_have_the_mean_that_a_render_has(scene):
    """Two means of 4096 samples or more: 6 standard errors are exceeded once in 5e8 runs."""
    mine = scene.more(8, 12)[1]
    theirs = render_pixels("cornell-box", [(8, 12)], spp=4096, size=(24, 16), seed=7)[0, 1]
    error = np.hypot(*(x.std() / np.sqrt(x.size) for x in (mine, theirs)))
    assert abs(mine.mean() - theirs.mean()) < 6 * error


def test_the_image_of_a_scene_gets_better(scene):
    shares = list(scene.passes())
    assert shares[-1] == 1
    assert np.isfinite(scene.overall().mean).all()


def test_a_scene_without_emitters_says_so():
    dark = {"type": "scene", "shape": {"type": "sphere"}, "sensor": {"type": "perspective"}}
    source = SceneSource(RenderProcess(Job.of(dark, size=(8, 8), backend="scalar")))
    with pytest.raises(SceneError, match="emitter"):
        list(source.passes())


def test_half_drawn_pixels_have_their_own_errors():
    x = np.random.default_rng(0).gamma(2.0, size=(1, 2, 3, 64)).astype(np.float32)
    whole = Overall.empty(1, 2, 3)
    for i, n in enumerate((64, 16)):
        accumulator = ImageAccumulator(1, 1)
        accumulator.add(x[:, i : i + 1, :, :n])
        whole.put(slice(0, 1), slice(i, i + 1), accumulator.overall())
    light = np.einsum("yxcs,c->yxs", x.astype(float), LUMINANCE)[0]
    own = light[0], light[1, :16]
    expected = [y.std(ddof=1) / y.mean() / np.sqrt(len(y)) for y in own]
    assert whole.relative_error[0] == pytest.approx(expected, rel=1e-5)


def test_the_brightest_sample_is_kept_apart():
    x = np.random.default_rng(0).gamma(2.0, size=(2, 3, 3, 12))
    x[1, 2, :, 7], x[0, 0, :, 3], x[0, 1, 1, 2], x[0, 2] = 1e9, -1e3, np.nan, 0
    grey = np.where(np.isnan(x).any(axis=2), 0, np.nan_to_num(x).mean(axis=2))
    expected = np.take_along_axis(grey, np.abs(grey).argmax(axis=-1)[..., np.newaxis], axis=-1)
    for order in (np.arange(12), np.arange(12)[::-1]):
        accumulator = ImageAccumulator(2, 3)
        for batch in np.split(x[..., order], 4, axis=-1):
            accumulator.add(batch.astype(np.float32))
        found = accumulator.overall()
        np.testing.assert_allclose(found.extreme, expected[..., 0], rtol=1e-6)
        others = grey.sum(axis=-1) - expected[..., 0]
        np.testing.assert_allclose(found.others, others, rtol=1e-6, atol=1e-6)


def test_a_store_that_is_gone_is_an_error_not_bad_samples(own_store):
    source = StoreSource(chd.open(own_store))
    before = source.pixel(3, 3)
    assert np.isfinite(before).all()
    shutil.rmtree(own_store)
    for y in (3, 20):  # remembered, and not
        with pytest.raises(StoreError, match="is gone"):
            source.pixel(y, 3)


def test_pixels_without_noise_do_not_stretch_the_colours():
    values = np.full((10, 10), 1e-1, np.float32)
    values[:2] = 1e-17
    values[2:4] = 10
    assert replace(MAPS["variance"], values=values).limits == pytest.approx((1e-7, 10))
    assert MAPS["variance"].unit == ""  # samples of others may have any
    assert replace(MAPS["bad_count"], values=np.zeros((2, 2))).limits == (0, 1)
    share = replace(map_of_view(View(brush=(1.0, 2.0))), values=np.ones((2, 2), np.float32))
    assert share.limits == pytest.approx((0.5**0.5, 1))
    assert replace(share, values=np.full((2, 2), np.nan)).limits == (0.5, 1)  # none yet


def test_a_pixel_shows_the_samples_that_it_has():
    x = np.arange(2 * 3 * 8, dtype=np.float32).reshape(2, 3, 1, 8)
    source = StoreSource(chd.Samples.from_array(x, counts=np.array([[8, 3, 5], [2, 8, 1]])))
    assert source.pixel(0, 1).tolist() == x[0, 1, :, :3].tolist()
    assert "1 to 8 spp" in source.describe()
    pool = source.region((0, 1, 2, 3), 4)
    assert sorted(pool[0]) == sorted(
        [*x[0, 1, 0, :3], *x[0, 2, 0, :4], *x[1, 1, 0, :4], x[1, 2, 0, 0]]
    )
