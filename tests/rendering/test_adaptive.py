"""Adaptive sampling: more samples where noise is, none of which decides how many there are."""

import math

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.rendering.adaptive import Adaptive, decided, density_of, error_of, expected_error
from chdstat.samples.layout import counts_of, missing_of
from chdstat.samples.store import Store
from tests.stops import stopped

VIEW = {"size": (70, 12), "seed": 3, "progress": False}
"""Two tiles."""
HOW = Adaptive("relMSE", 8)


def glints(rng, shape):
    """Return samples of mean 1 that are 0 but for one in 50."""
    return np.where(rng.random(shape) < 0.02, 50, 0).astype(np.float32)


def of_each(samples):
    """Return which samples each pixel has, shape (y, x, channel, sample)."""
    held = np.arange(samples.spp) < samples.counts[..., np.newaxis, np.newaxis]
    return np.broadcast_to(held, samples.shape)


# --- what is decided ----------------------------------------------------------------------------


def test_counts_follow_the_noise():
    """Of two halves with 1 and 16 times the noise, the error falls nearly as Neyman says.

    Of the mean noise, 8.5, a fiftieth is added.
    """
    noise, albedo = np.ones((16, 32)), np.zeros((16, 32, 3), np.float32)
    noise[:, 16:], albedo[:, 16:] = 16, 1
    density = density_of(noise, np.ones((16, 32)), {"albedo": albedo})
    assert density.mean() == pytest.approx(1)
    assert density[:, 16:] / density[:, :16] == pytest.approx(14**0.35, rel=0.02)
    assert 1 < (noise / density).mean() / np.sqrt(noise).mean() ** 2 < 1.04


def test_of_equal_noise_the_darker_gets_more():
    """It is better known where it is bright: a pixel that looks noisy may have met one bright path.

    For the absolute error, the bright one gets more.
    """
    bright = np.where(np.arange(32) < 16, 1.0, 8.0) * np.ones((16, 1))
    for powers, ratio in (((0.35, -0.12), 8**-0.12), ((0.2, 0.2), 8**0.2)):
        density = density_of(np.ones((16, 32)), bright, {"depth": bright}, powers)
        assert density[:, 16:] / density[:, :16] == pytest.approx(ratio, rel=0.03)


@pytest.mark.parametrize("noise", [np.zeros((8, 8)), np.ones((1, 1)), np.ones((1, 5))])
def test_pixels_that_are_alike_get_as_many(noise):
    assert density_of(noise, noise, {}) == pytest.approx(1)


def test_dark_pixels_are_looked_at_and_none_gets_all():
    for noisy, ends in ((8, (0.65, 8)), (24, (0.5, 4.25))):
        noise = np.zeros((64, 64))
        noise[:noisy, :noisy] = 1e9
        density = density_of(noise, noise, {}, (0.5, 0.5), least=0.5)
        assert (density.min(), density.max()) == pytest.approx(ends, rel=0.02)
        assert density.mean() == pytest.approx(1)


@pytest.mark.parametrize(
    "how",
    [
        HOW,
        Adaptive("MSE", 8),
        Adaptive("MSE", 8, error=0.1),
        Adaptive("relMSE", 8, error=0.1),
        Adaptive("relMSE", 8, error=0.1, percentile=80),
    ],
)
def test_a_pixel_does_not_decide_for_itself(how):
    x = glints(np.random.default_rng(0), (9, 12, 1, 8))
    changed = x.copy()
    changed[4, 5] = [[0, 0, 1e5, 0, 0, 0, 0, 7]]
    found = []
    for radiance in (x, changed):
        density, noise = decided(chd.Samples.from_array(radiance), how)
        found.append(density * (noise["value"] if how.error else 1))
    same = np.isclose(*found, rtol=1e-6)
    assert same[4, 5]
    assert not same[4, 6]


def test_means_of_rare_light_have_no_bias():
    """The mean of all pixels and seeds is 1; where pixels decide for themselves, it is lower."""
    rng, means = np.random.default_rng(1), {"other": [], "own": []}
    for _ in range(100):
        x = glints(rng, (8, 8, 1, 256))
        first = x[..., :8]
        density, _ = decided(chd.Samples.from_array(first), Adaptive("MSE", 8))
        own = np.sqrt(first.var(axis=(2, 3)))
        own = np.clip(own / own.mean(), 0.25, 8) if own.any() else np.ones((8, 8))
        for name, each in (("other", density), ("own", own)):
            counts = counts_of(each, 32, 8)
            kept = np.arange(256) < counts[..., np.newaxis, np.newaxis]
            means[name].append((x * kept).sum(axis=(2, 3)) / counts)
    found = {n: (np.mean(m), np.std(np.mean(m, axis=(1, 2))) / 100**0.5) for n, m in means.items()}
    assert abs(found["other"][0] - 1) < 3 * found["other"][1]  # fails by chance once in 370 times
    assert found["own"][0] < 1 - 5 * found["own"][1]


def test_the_error_is_predicted():
    """Of light-tailed samples, within a tenth; so is the one that is reached."""
    rng, scale = np.random.default_rng(2), np.linspace(1, 3, 32)[:, np.newaxis, np.newaxis]
    x = (10 + scale * rng.normal(size=(24, 32, 1, 256))).astype(np.float32)
    density, noise = decided(chd.Samples.from_array(x[..., :16]), Adaptive("MSE", 16))
    counts = counts_of(density, 64, 16)
    samples = chd.Samples.from_array(x, counts=counts)
    mean = np.nanmean(samples.read(), axis=-1)
    truth = np.sqrt(((mean - 10) ** 2).mean())
    predicted = expected_error({"noise": noise, "spp": 64})
    assert predicted.value == pytest.approx(truth, rel=0.1)
    assert error_of(samples, "MSE").value == pytest.approx(truth, rel=0.1)
    assert predicted.low < predicted.value < predicted.high


def test_a_single_bright_sample_does_not_hide_its_own_error():
    """Fireflies of 50 times the mean, in one pixel of 200, decide the error of the image.

    Relative to means that hold them, it would seem less than half as large.
    """
    rng = np.random.default_rng(1)
    x = 1 + np.where(rng.random((32, 32, 1, 64)) < 0.005 / 64, 64 * 50.0, 0)
    truth = math.sqrt((np.square(x.mean(axis=-1) - 1.25) / (1.01 * 1.25**2)).mean())
    found = error_of(chd.Samples.from_array(x.astype(np.float32)))
    assert found.value == pytest.approx(truth, rel=0.3)


def test_a_percentile_is_that_of_the_pixels():
    """Nine pixels of ten have an error of 1 in 8, the others of 5 in 8."""
    rng = np.random.default_rng(5)
    scale = np.where(np.arange(40) < 36, 1.0, 5.0) * np.ones((40, 1))
    x = 100 + scale[..., np.newaxis, np.newaxis] * rng.normal(size=(40, 40, 1, 64))
    samples = chd.Samples.from_array(x.astype(np.float32))
    found = {share: error_of(samples, "MSE", share).value for share in (50, 95)}
    assert found[50] == pytest.approx(1 / 8, rel=0.1)
    assert found[95] == pytest.approx(5 / 8, rel=0.1)
    how = Adaptive("MSE", 64, error=0.1, percentile=95)
    density, noise = decided(samples, how)
    reached = np.percentile(scale**2 / density, 95) / noise["value"]
    assert reached == pytest.approx(1, rel=0.15)


def test_the_budget_reaches_the_error():
    how = Adaptive("MSE", 16, error=0.1)
    assert how.spp({"value": 1.5}, most=1000) == 150
    assert how.spp({"value": 1e-3}, most=1000) == 16
    assert how.spp({"value": 1.5}, most=100) == 100


def test_counts_grow_and_what_is_missing_is_what_they_grew_by():
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
    expected = expected_error(found.attrs)
    assert found.counts.min() == 64 < found.attrs["spp"] < 256
    assert expected.value == pytest.approx(0.05, rel=0.01)
    chd.render("cornell-box", spp=64, error=0.001, **settings)
    assert "takes about" in caplog.text
    assert math.isfinite(error_of(found).value)


def test_what_makes_no_sense_is_refused(stored):
    scene = "cornell-box"
    with pytest.raises(InputError, match="at least 16 spp"):
        chd.render(scene, spp=8, adaptive=True)
    with pytest.raises(InputError, match="relMSE"):
        chd.render(scene, adaptive="relmse")
    for error in (0.0, 2):  # two per cent are 0.02
        with pytest.raises(InputError, match=r"between 0 and 1, such as 0\.02 for 2 %"):
            chd.render(scene, error=error)
    for percentile, error in ((95, None), (100, 0.1), (0.95, 0.1)):
        with pytest.raises(InputError, match="percentile"):
            chd.render(scene, percentile=percentile, error=error)
    with pytest.raises(InputError, match="only independent"):
        chd.render(scene, adaptive=True, sampler="stratified")
    with pytest.raises(StoreError, match="adaptive: stored None"):
        chd.render(scene, size=(24, 16), spp=64, adaptive=True, out=stored())


@pytest.mark.parametrize("radiance", [0.0, 1.0])
def test_an_even_image_has_counts_too(radiance):
    scene = {"type": "scene", "sensor": {"type": "perspective"}}
    scene["sky"] = {"type": "constant", "radiance": radiance}
    samples = chd.render(scene, spp=16, size=(5, 4), adaptive=True, backend="scalar")
    assert samples.counts.shape == (4, 5)
    assert samples.counts.mean() == pytest.approx(16, rel=0.3)
    assert np.array_equal(np.isfinite(samples.read()[:, :, 0]).sum(-1), samples.counts)
