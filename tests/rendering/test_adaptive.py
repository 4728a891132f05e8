"""Adaptive sampling: more samples where noise is, none of which decides how many there are."""

import math

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import StoreError
from chdstat.rendering.adaptive import (
    Adaptive,
    Look,
    classes_of,
    decided,
    density_of,
    error_of,
    expected_error,
    more,
)
from chdstat.samples.ledger import counts_of, missing_of
from chdstat.samples.store import Store
from tests.rendering.noise import patterns
from tests.stops import stopped

VIEW = {"size": (70, 12), "seed": 3, "progress": False}
"""Two tiles."""
HOW = Adaptive("relMSE", 8)
UP_TO = Adaptive("relMSE", 16, error=0.1)
NOISE = patterns(32, 32)


def glints(rng, shape):
    """Return samples of mean 1 that are 0 but for one in 50."""
    return np.where(rng.random(shape) < 0.02, 50, 0).astype(np.float32)


def of_each(samples):
    """Return which samples each pixel has, shape (y, x, channel, sample)."""
    held = np.arange(samples.spp) < samples.counts[..., np.newaxis, np.newaxis]
    return np.broadcast_to(held, samples.shape)


def look_at(x):
    """Return the look at samples (y, x, channel, sample)."""
    return Look.of_blocks(x.shape[:3], [((slice(None),), x)])


# --- what is decided ----------------------------------------------------------------------------


def test_counts_follow_the_noise():
    """Of two halves with 1 and 16 times the noise, the error falls nearly as Neyman says.

    Of the mean noise, 8.5, a fiftieth is added.
    """
    needs = np.ones((16, 32, 2))
    needs[:, 16:, 0] = 16
    density = density_of(needs)
    assert density.mean() == pytest.approx(1)
    assert density[:, 16:] / density[:, :16] == pytest.approx((16.17 / 1.17) ** 0.35, rel=1e-6)
    assert 1 < (needs[..., 0] / density).mean() / np.sqrt(needs[..., 0]).mean() ** 2 < 1.04


def test_of_equal_noise_the_darker_gets_more():
    """It is better known where it is bright: a pixel that looks noisy may have met one bright path.

    For the absolute error, the bright one gets more.
    """
    needs = np.ones((16, 32, 2))
    needs[:, 16:, 1] = 8
    for powers, ratio in (((0.35, -0.12), 8**-0.12), ((0.2, 0.2), 8**0.2)):
        density = density_of(needs, powers)
        assert density[:, 16:] / density[:, :16] == pytest.approx(ratio, rel=0.03)


@pytest.mark.parametrize("needs", [np.zeros((8, 8, 2)), np.ones((1, 1, 2)), np.ones((1, 5, 2))])
def test_pixels_that_are_alike_get_as_many(needs):
    assert density_of(needs) == pytest.approx(1)


def test_no_pixel_gets_nothing_and_none_gets_all():
    for noisy, most in ((2, 16), (8, 16), (24, 4.06)):
        needs = np.zeros((64, 64, 1))
        needs[:noisy, :noisy] = 1e9
        density = density_of(needs, (1.0,), least=0.5)
        assert density.min() >= 0.5
        assert density.max() == pytest.approx(most, rel=0.01)
        assert density.mean() == pytest.approx(1)


@pytest.mark.parametrize("measure", ["relMSE", "MSE"])
def test_a_pixel_does_not_decide_for_itself(measure):
    """Nor does its class, by the numbers that a class has on average."""
    x = glints(np.random.default_rng(0), (9, 12, 1, 8))
    changed = x.copy()
    changed[4, 5] = [[0, 0, 1e5, 0, 0, 0, 0, 7]]
    one, two = (decided(look_at(a), Adaptive(measure, 8), {})[0] for a in (x, changed))
    classes = classes_of(9, 12)
    assert np.array_equal(one[classes == classes[4, 5]], two[classes == classes[4, 5]])
    assert not np.isclose(one[4, 6], two[4, 6], rtol=1e-6)


def test_a_class_does_not_decide_whether_it_goes_on():
    classes = classes_of(32, 32)
    x = NOISE["diagonals, every 16 pixels"].samples(np.random.default_rng(0), 64)
    changed = x.copy()
    changed[classes == 3] = np.random.default_rng(1).exponential(9, (128, 1, 64))
    one, two = (more(look_at(a), UP_TO, {}) for a in (x, changed))
    assert np.array_equal(one[classes == 3], two[classes == 3])
    assert (one[classes != 3] != two[classes != 3]).all()


def test_one_noisy_pixel_makes_no_other_go_on():
    x, how = np.ones((32, 32, 1, 64)), Adaptive("relMSE", 16, error=0.002)
    x[5, 6] = np.random.default_rng(0).exponential(1, (1, 64))
    assert error_of(look_at(x)).value > 1.5 * how.error
    assert more(look_at(x), how, {}) is None
    x[:, 6] = np.random.default_rng(1).exponential(1, (32, 1, 64))
    assert more(look_at(x), how, {}).min() > 1


@pytest.mark.parametrize("name", ["checker, 1 pixel", "diagonals, every 16 pixels"])
def test_a_chessboard_is_no_way_to_hide(name):
    """Noisy pixels get as many samples as calm ones, or more, if others decide."""
    pattern, ratios = NOISE[name], []
    noisy = pattern.variance > 0
    for seed in range(4):
        look = look_at(pattern.samples(np.random.default_rng(seed), 32))
        density, _ = decided(look, Adaptive("relMSE", 32), {})
        ratios.append(density[noisy].mean() / density[~noisy].mean())
    assert np.mean(ratios) > 0.95


@pytest.mark.parametrize("name", ["checker, 1 pixel", "one diagonal", "single pixel", "corner"])
def test_trial_samples_find_the_noisy_pixels(name):
    pattern = NOISE[name]
    noisy = pattern.variance > 0
    look = look_at(pattern.samples(np.random.default_rng(0), 128))
    density, _ = decided(look, Adaptive("relMSE", 16, error=pattern.asked), {})
    assert np.median(density[noisy]) > 2.5 * np.median(density[~noisy])


def test_trials_and_classes_make_no_bias():
    """Going on where the kept samples themselves look noisy would make the mean too dark.

    So it does if each pixel goes on by its own: the negative control.
    """
    rng, means, gone_on = np.random.default_rng(2), {"others": [], "own": []}, 0
    how = Adaptive("relMSE", 8, error=0.35)
    for _ in range(150):
        x = glints(rng, (8, 8, 1, 512))
        density, _ = decided(look_at(glints(rng, (8, 8, 1, 16))), how, {})
        counts = counts_of(density, 24, 8)
        kept = np.where(np.arange(512) < counts[..., np.newaxis, np.newaxis], x, np.nan)
        factors = more(Look.of(chd.Samples.from_array(x, counts=counts)), how, {})
        gone_on += factors is not None
        others = np.ones((8, 8)) if factors is None else np.minimum(factors, 16)
        own = np.where(np.nanvar(kept, axis=(2, 3)) > 0, 4, 1)
        for name, each in (("others", others), ("own", own)):
            numbers = np.maximum(counts_of(density * each, 24, 8), counts)
            held = np.arange(512) < numbers[..., np.newaxis, np.newaxis]
            means[name].append((x * held).sum(axis=(2, 3)) / numbers)
    assert gone_on > 50
    found = {n: (np.mean(m), np.std(np.mean(m, axis=(1, 2))) / 150**0.5) for n, m in means.items()}
    assert abs(found["others"][0] - 1) < 3 * found["others"][1]  # fails by chance once in 370 times
    assert found["own"][0] < 1 - 5 * found["own"][1]


def test_the_error_is_predicted():
    """Of light-tailed samples, within a tenth; so is the one that is reached."""
    rng, scale = np.random.default_rng(2), np.linspace(1, 3, 32)[:, np.newaxis, np.newaxis]
    x = (10 + scale * rng.normal(size=(24, 32, 1, 256))).astype(np.float32)
    density, noise = decided(look_at(x[..., :16]), HOW, {})
    counts = counts_of(density, 64, 16)
    samples = chd.Samples.from_array(x, counts=counts)
    mean = np.nanmean(samples.read(), axis=-1)
    truth = np.sqrt(((mean - 10) ** 2).mean()) / math.sqrt(101)
    predicted = expected_error({"noise": noise, "spp": 64})
    assert predicted.value == pytest.approx(truth, rel=0.1)
    assert error_of(samples).value == pytest.approx(truth, rel=0.1)
    assert predicted.low < predicted.value < predicted.high


@pytest.mark.parametrize("name", sorted(NOISE.keys() - {"single pixel", "five pixels"}))
def test_the_error_is_estimated_whatever_the_pattern(name):
    """On average over renders, within 6 % of what is expected: of 400 samples, and enough light."""
    pattern, found, held = NOISE[name], [], 0
    expected = pattern.error(pattern.variance / 400)
    for seed in range(8):
        x = pattern.samples(np.random.default_rng(seed), 400)
        told = error_of(look_at(x))
        found.append(told.value)
        held += told.low < pattern.error((x[:, :, 0].mean(-1) - pattern.mean) ** 2) < told.high
    assert np.mean(found) == pytest.approx(expected, rel=0.06)
    assert held >= 5  # of 8 intervals of 95 %: by chance once in 2000 times


def test_a_bright_sample_hides_no_error():
    """Fireflies of 50 times the mean, in one pixel of 200, decide the error of the image.

    Relative to means that hold them, it would seem less than half as large.
    """
    rng = np.random.default_rng(1)
    x = 1 + np.where(rng.random((32, 32, 1, 64)) < 0.005 / 64, 64 * 50.0, 0)
    truth = math.sqrt((np.square(x.mean(axis=-1) - 1.25) / (1.01 * 1.25**2)).mean())
    found = error_of(chd.Samples.from_array(x.astype(np.float32)))
    assert found.value == pytest.approx(truth, rel=0.3)


def test_dots_are_no_fireflies():
    """Each has met its light 6 times on average."""
    pattern = NOISE["dots, 8 over 0.2"]
    looks = [look_at(pattern.samples(np.random.default_rng(seed), 64)) for seed in range(8)]
    found = [error_of(look).value for look in looks]
    assert np.mean(found) == pytest.approx(pattern.error(pattern.variance / 64), rel=0.2)


def test_a_percentile_is_that_of_the_pixels():
    """Nine pixels of ten have an error of 1 in 8, the others of 5 in 8."""
    rng = np.random.default_rng(5)
    scale = np.where(np.arange(40) < 36, 1.0, 5.0) * np.ones((40, 1))
    x = 100 + scale[..., np.newaxis, np.newaxis] * rng.normal(size=(40, 40, 1, 64))
    samples = chd.Samples.from_array(x.astype(np.float32))
    found = {share: error_of(samples, "MSE", share).value for share in (50, 95)}
    assert found[50] == pytest.approx(1 / 8, rel=0.1)
    assert found[95] == pytest.approx(5 / 8, rel=0.1)
    how = Adaptive("relMSE", 64, error=0.001, percentile=95)
    density, noise = decided(Look.of(samples), how, {})
    reached = np.percentile(scale**2 / density, 95) / noise["value"] / (1.01 * 100**2)
    assert reached == pytest.approx(1, rel=0.15)


def test_the_budget_reaches_the_error():
    how = Adaptive("MSE", 16, error=0.1)
    assert how.spp({"value": 1.5}, most=1000) == 150
    assert how.spp({"value": 1e-3}, most=1000) == 16
    assert how.spp({"value": 1.5}, most=100) == 100
    assert how.spp({"value": 1.5, "trials": 32}, most=100) == 68
    assert how.spp({"value": 1.5, "surely": 3.0, "trials": 32}, most=1000) == 300


def test_counts_grow_by_what_is_missing():
    density = np.random.default_rng(0).uniform(0.5, 1.5, (7, 9)).astype(np.float32)
    density /= density.mean()
    few, many = counts_of(density, 50, 16), counts_of(density, 100, 16)
    assert few.mean() == pytest.approx(50, abs=0.5)
    assert (many >= few).all()
    held = np.where(np.arange(64) < few[..., np.newaxis, np.newaxis], 1.0, np.nan)
    missing = missing_of(held.astype(np.float32), many)
    assert (missing.sum(axis=-1) == np.minimum(many, 64) - np.minimum(few, 64)).all()


# --- renders ------------------------------------------------------------------------------------


def test_its_samples_are_the_first_ones_of_a_render(wavefront):
    found = chd.render("cornell-box", spp=32, adaptive=True, backend=wavefront, **VIEW)
    most = int(found.counts.max())
    equal = chd.render("cornell-box", spp=most, backend=wavefront, **VIEW)
    held, x = of_each(found), found.read()
    assert found.counts.mean() == pytest.approx(32, abs=0.5)
    assert found.counts.min() == 16 < most
    assert np.array_equal(x[held], equal.read()[held])
    assert np.isnan(x[~held]).all()
    assert found.shares_numbers_with(equal)


def test_stores_hold_what_is_in_memory_and_go_on(backend, tmp_path):
    settings = VIEW | {"backend": backend}
    held = chd.render("cornell-box", spp=16, adaptive=True, **settings)
    some = chd.render("cornell-box", spp=16, adaptive=True, out=tmp_path / "a.zarr", **settings)
    assert np.array_equal(held.read(), some.read(), equal_nan=True)
    assert "density" not in some.features
    assert Store.open(tmp_path / "a.zarr").damaged() == []
    before = some.read()
    more = chd.render("cornell-box", spp=40, direct=True, out=tmp_path / "a.zarr", **settings)
    assert more.counts.mean() == pytest.approx(40, abs=0.5)
    assert np.array_equal(more.read()[..., : some.spp][of_each(some)], before[of_each(some)])
    assert np.isfinite(more.read()[of_each(more)]).all()
    assert np.array_equal(more.direct.counts, more.counts)
    assert chd.open(tmp_path / "a.zarr").counts.tolist() == more.counts.tolist()
    again = chd.render("cornell-box", spp=40, out=tmp_path / "a.zarr", **settings)
    assert np.array_equal(again.read(), more.read(), equal_nan=True)


@pytest.mark.parametrize("writes", [1, 3])
def test_what_was_stopped_goes_on(wavefront, tmp_path, writes):
    """It stops among the first samples, or among those that were decided."""
    settings = VIEW | {"spp": 96, "adaptive": True, "backend": wavefront}
    whole = chd.render("cornell-box", **settings)
    with stopped(Store, "write", writes):
        chd.render("cornell-box", out=tmp_path / "a.zarr", **settings)
    assert Store.open(tmp_path / "a.zarr").pending()
    found = chd.render("cornell-box", out=tmp_path / "a.zarr", **settings)
    assert np.array_equal(found.read(), whole.read(), equal_nan=True)


def test_a_damaged_density_is_told_and_decided_again(wavefront, tmp_path):
    settings = VIEW | {
        "spp": 32,
        "adaptive": True,
        "backend": wavefront,
        "out": tmp_path / "a.zarr",
    }
    x = chd.render("cornell-box", **settings).read()
    (file,) = tmp_path.glob("a.zarr/features/density/c/*/*")
    file.write_bytes(b"")
    with pytest.raises(StoreError, match="density"):
        chd.open(tmp_path / "a.zarr")
    assert np.array_equal(chd.render("cornell-box", **settings).read(), x, equal_nan=True)
    assert chd.open(tmp_path / "a.zarr").unequal


def test_an_error_is_reached_or_told(wavefront, caplog):
    settings = VIEW | {"backend": wavefront}
    found = chd.render("cornell-box", spp=256, error=0.05, **settings)
    told = found.attrs["error"]
    assert 16 <= found.counts.min() < found.attrs["spp"] < 256
    assert expected_error(found.attrs).value == pytest.approx(0.05, rel=0.01)
    assert told["reached"]
    assert told["low"] < told["value"] < told["high"]
    assert told["value"] == error_of(found).value == pytest.approx(0.05, rel=0.1)
    assert "asked" not in caplog.text
    found = chd.render("cornell-box", spp=64, error=0.001, **settings)
    assert not found.attrs["error"]["reached"]
    assert found.counts.mean() + found.attrs["noise"]["trials"] == pytest.approx(64, abs=0.5)
    assert "takes about" in caplog.text
    assert "more than the 0.001 asked for; spp above 64 goes on" in caplog.text


def test_trial_samples_are_not_kept(wavefront):
    """What is kept are the first samples of a render that is not adaptive."""
    found = chd.render("cornell-box", spp=96, error=0.07, backend=wavefront, **VIEW)
    equal = chd.render("cornell-box", spp=found.spp, backend=wavefront, **VIEW)
    held = of_each(found)
    assert np.array_equal(found.read()[held], equal.read()[held])


def test_a_render_goes_on_once(wavefront, tmp_path):
    """Diagonals of rare light: few trial samples have met any. Stores and memory hold the same."""
    pattern = NOISE["diagonals, every 16 pixels"]
    settings = {"size": (32, 32), "spp": 2048, "error": 0.12, "backend": wavefront}
    settings |= {"progress": False}
    for seed in range(6):
        whole = chd.render(pattern.scene, seed=seed, **settings)
        if "surely" not in whole.attrs["noise"]:
            break
    else:
        pytest.fail("no render went on")
    assert whole.attrs["noise"]["settled"]
    with stopped(Store, "write", 2):
        chd.render(pattern.scene, seed=seed, out=tmp_path / "a.zarr", **settings)
    kept = chd.render(pattern.scene, seed=seed, out=tmp_path / "a.zarr", **settings)
    assert np.array_equal(kept.read(), whole.read(), equal_nan=True)
    assert kept.attrs["error"] == whole.attrs["error"]
    assert Store.open(tmp_path / "a.zarr").damaged() == []
    settings |= {"error": 0.06}
    more_of_it = chd.render(pattern.scene, seed=seed, out=tmp_path / "a.zarr", **settings)
    assert (more_of_it.counts >= kept.counts).all()
    assert more_of_it.counts.mean() > 2 * kept.counts.mean()


@pytest.mark.parametrize("name", ["diagonals, every 16 pixels", "checker, 1 pixel", "five pixels"])
def test_a_real_render_reaches_the_error_or_says_so(wavefront, name):
    """`benchmarks/test_error_stop.py` tries all patterns, with more seeds."""
    pattern = NOISE[name]
    settings = {"size": (32, 32), "spp": 2048, "backend": wavefront, "progress": False}
    samples = chd.render(pattern.scene, error=pattern.asked, **settings)
    mean = np.nanmean(samples.read()[:, :, 0], axis=-1, dtype=np.float64)
    actual = pattern.error((mean - pattern.mean) ** 2)
    assert actual <= 1.15 * pattern.asked or not samples.attrs["error"]["reached"]
    expected = pattern.error(pattern.variance / samples.counts)
    assert samples.attrs["error"]["value"] == pytest.approx(expected, rel=0.25)


@pytest.mark.parametrize("radiance", [0.0, 1.0])
def test_an_even_image_has_counts_too(radiance):
    scene = {"type": "scene", "sensor": {"type": "perspective"}}
    scene["sky"] = {"type": "constant", "radiance": radiance}
    samples = chd.render(scene, spp=16, size=(5, 4), adaptive=True, backend="scalar")
    assert samples.counts.shape == (4, 5)
    assert samples.counts.mean() == pytest.approx(16, rel=0.3)
    assert np.array_equal(np.isfinite(samples.read()[:, :, 0]).sum(-1), samples.counts)
