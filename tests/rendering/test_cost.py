"""What samples take: the map of a render, kept beside samples, and what it decides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.rendering import sample_clock
from chdstat.rendering.adaptive import Adaptive, Look, decided
from chdstat.samples.costs import SampleCosts
from chdstat.samples.store import Store
from tests.stops import stopped


def render(**options: Any) -> chd.Samples:
    given = {"size": (70, 34), "spp": 20, "backend": "scalar", "cost": True, "progress": False}
    return chd.render("cornell-box", **given | options)


@pytest.mark.parametrize("camera", ["perspective", "thinlens"])
def test_a_timed_pass_draws_the_same_samples(camera):
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": camera, "shutter_open": 0.0, "shutter_close": 0.5},
        "light": {"type": "constant"},
        "ball": {"type": "sphere", "center": [0, 0, 4]},
    }
    if camera == "thinlens":
        scene["sensor"] |= {"aperture_radius": 0.3, "focus_distance": 4.0}
    drawn = [
        chd.render(scene, size=(40, 33), spp=3, backend="scalar", cost=cost) for cost in (0, 1)
    ]
    assert (drawn[0].read() == drawn[1].read()).all()
    assert drawn[0].costs is None
    assert (drawn[1].costs.count == 1).mean() > 0.95  # others may be interrupted


def slow_down(monkeypatch: pytest.MonkeyPatch, takes: Callable[[Any, Any], Any]) -> None:
    """Stop the clock, but for what a sample of a pixel x, y of 40 x 36 takes."""
    clock, watching = [0.0], sample_clock._watching
    monkeypatch.setattr(sample_clock, "now", lambda: clock[0])

    def slow(base: type) -> type:
        class Slow(watching(base)):  # type: ignore[misc]
            def sample_ray_differential(self, *arguments: Any) -> Any:
                found = super().sample_ray_differential(*arguments)
                clock[0] += takes(*np.floor(np.array(arguments[2]).ravel() * [40, 36]))
                return found

        return Slow

    monkeypatch.setattr(sample_clock, "_watching", slow)


def test_each_time_belongs_to_its_pixel(monkeypatch):
    """A sensor that takes long in one pixel makes that pixel costly, and no other."""
    slow_down(monkeypatch, lambda x, y: 1 + 1e-3 * (40 * y + x))
    costs = render(size=(40, 36), spp=2).costs
    assert costs.mean.mean() == pytest.approx(0, abs=1e-9)  # others take no time
    away = costs.mean - 1e-3 * np.arange(40 * 36).reshape(36, 40)
    away -= np.median(away)
    # The first two pixels of each block and the last one have the time of their neighbours.
    assert (np.abs(away) > 1e-6).sum() <= 3 * 4
    assert np.abs(away).max() < 0.1


def test_cold_caches_at_the_beginning_of_a_block_are_no_cost_of_a_pixel(monkeypatch):
    slow_down(monkeypatch, lambda x, y: 3 if x % 32 == 0 and y % 32 == 0 else 1)
    mean = render(size=(40, 36), spp=2).costs.mean
    assert np.ptp(mean) == pytest.approx(0, abs=1e-9)


def test_stores_keep_times_and_go_on_with_them(tmp_path):
    with stopped(Store, "write", 1):
        render(out=tmp_path / "a.zarr", size=(70, 3))
    counts = Store.open(tmp_path / "a.zarr").read_features()["costs"][..., 0]
    assert sorted(part.max() for part in (counts[:, :64], counts[:, 64:])) == [0, 2]
    render(out=tmp_path / "a.zarr", size=(70, 3))
    more = render(out=tmp_path / "a.zarr", size=(70, 3), spp=72, cost=False)
    assert more.costs.count.max() > 4
    assert (more.costs.count > 2).all()
    found = chd.open(tmp_path / "a.zarr")
    np.testing.assert_array_equal(found.costs.seconds, more.costs.seconds)
    assert "costs" not in found.features
    part = found.isel(y=slice(1, 2), x=slice(5, 9), sample=slice(7))
    np.testing.assert_array_equal(part.costs.count, found.costs.count[1:2, 5:9])
    assert chd.samples.inspect(tmp_path / "a.zarr", verify=True)["costs"]


def test_times_are_no_part_of_what_samples_are(tmp_path):
    for name, cost in (("a", True), ("b", False)):
        render(out=tmp_path / f"{name}.zarr", size=(8, 8), cost=cost)
    one, two = (tmp_path / f"{name}.zarr/radiance" for name in "ab")
    for file in ("zarr.json", "c/0/0/0/0"):
        assert (one / file).read_bytes() == (two / file).read_bytes()


def test_damaged_times_are_measured_again(tmp_path):
    path = tmp_path / "a.zarr"
    render(out=path, size=(8, 8))
    (path / "features/costs/c/0/0/0").write_bytes(b"?")
    assert len(chd.samples.inspect(path)["damaged"]) == 1
    assert render(out=path, size=(8, 8), spp=24).costs is not None
    assert "damaged" not in chd.samples.inspect(path)


def test_times_of_others_are_kept_and_merged(tmp_path):
    x, rng = np.ones((2, 3, 1, 8)), np.random.default_rng(0)
    times = rng.random((2, 3, 8))
    times[1, 2] = np.nan
    samples = chd.Samples.from_array(x, seconds=times)
    np.testing.assert_allclose(samples.costs.seconds[0], times[0].mean(axis=-1), rtol=1e-6)
    np.testing.assert_allclose(
        samples.costs.error[0], times[0].std(axis=-1, ddof=1) / np.sqrt(8), rtol=1e-5
    )
    assert np.isnan(samples.costs.seconds[1, 2])
    assert samples.save(tmp_path / "a.zarr").costs is not None
    again = chd.Samples.from_array(2 * x, seconds=times)
    both = again.save(tmp_path / "a.zarr", append=True).costs
    assert (both.count[0] == 16).all()
    np.testing.assert_allclose(both.seconds, samples.costs.seconds)
    assert chd.analyze(samples, progress=False)["sample_seconds"].dims == ("y", "x")


def test_a_clock_that_reads_zero_tells_no_efficiency():
    x = np.random.default_rng(5).gamma(2.0, size=(2, 8, 8, 1, 16))
    still, timed = (
        chd.Samples.from_array(one, seconds=of * np.ones((8, 8)))
        for one, of in zip(x, (0.0, 1.0), strict=True)
    )
    assert np.isnan(still.costs.seconds).all()
    assert np.isnan(still.costs.median)
    assert still.pixel(1, 1).seconds is None
    found = chd.contrast(still, timed, progress=False)
    assert np.isnan(found.efficiency_ratio.value)
    assert found.timed == ""


def test_merging_equals_concatenating():
    times = np.random.default_rng(1).random((3, 4, 9))
    one, two = SampleCosts.of(times[..., :2]), SampleCosts.of(times[..., 2:])
    found, whole = one.merge(two), SampleCosts.of(times)
    for name in ("count", "mean", "squares"):
        np.testing.assert_allclose(getattr(found, name), getattr(whole, name))


def test_an_interruption_is_no_time_of_a_sample():
    times = np.random.default_rng(2).gamma(4.0, size=(100, 100))
    times[3, 5] = 1000.0
    found = sample_clock.uninterrupted(times)
    assert np.isnan(found[3, 5])
    assert np.isfinite(found).sum() == times.size - 1


# --- numbers of samples -------------------------------------------------------------------------


@pytest.mark.parametrize("error", [None, 0.02])
def test_numbers_follow_the_root_of_variance_over_cost(error):
    """With equal noise everywhere, pixels that cost 4 times as much get half as many samples."""
    x = np.random.default_rng(3).gamma(2.0, size=(48, 48, 1, 64))
    seconds = np.where(np.arange(48) < 24, 1.0, 4.0) * np.ones((48, 1))
    costs = chd.Samples.from_array(x, seconds=seconds).costs
    how = Adaptive("relMSE", 16, error=error)
    look = Look.of(chd.Samples.from_array(x))
    density, _ = decided(look, how, {}, costs)
    plain, _ = decided(look, how, {})
    ratio = (density / plain)[:, 8:16].mean() / (density / plain)[:, 32:40].mean()
    assert ratio == pytest.approx(2, rel=0.05)
    noisy = x * (1 + (np.arange(48) < 24))[:, np.newaxis, np.newaxis]  # 4 times the variance
    of_mse, _ = decided(
        Look.of(chd.Samples.from_array(noisy)), Adaptive("MSE", 16, error=0.02), {}, costs
    )
    assert of_mse[:, 8:16].mean() / of_mse[:, 32:40].mean() == pytest.approx(4, rel=0.1)


def test_adaptive_renders_time_their_samples():
    samples = render(size=(16, 12), spp=16, adaptive=True)
    assert samples.unequal
    assert (samples.costs.count > 0).all()


def test_backends_that_draw_all_pixels_at_once_are_refused():
    with pytest.raises(InputError, match="'llvm'"):
        render(backend="llvm")
    with pytest.raises(InputError, match="cluster"):
        render(client=object())
