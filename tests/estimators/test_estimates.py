"""Estimates: one call from samples to an image, and the file of it."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import MLP
from chdstat.estimators.estimates import estimate
from chdstat.estimators.training import train_model
from chdstat.io import read_exr, write_estimates

QUICK = {"iterations": 5, "progress": False}


def image(spp=16, channels=3, features=False):
    rng = np.random.default_rng(0)
    x = rng.lognormal(size=(16, 20, 1, 1)) * rng.gamma(0.7, size=(16, 20, channels, spp))
    known = {"albedo": np.full((16, 20, 3), 0.5)} if features else None
    return chd.Samples.from_array(x, features=known, axes="yxcs", scene="made up")


@pytest.fixture(scope="module")
def model():
    return train_model(image(spp=64), **QUICK)


def test_samples_that_memory_cannot_hold_are_refused_in_words(monkeypatch, model):
    samples = image(spp=64)
    monkeypatch.setattr("chdstat._core.work.memory", lambda: 1.5 * samples.nbytes)
    with pytest.raises(InputError, match="64 spp.*--spp"):
        estimate(samples, model)
    estimate(samples, model, spp=32)


@pytest.fixture
def doubling(monkeypatch):
    monkeypatch.setattr(
        "chdstat.estimators.denoiser.run_network", lambda images, **_: 2 * images["color"]
    )


def test_it_is_the_same_every_time():
    first, again = (estimate(image(features=True), progress=False) for _ in range(2))
    assert first.radiance.shape == first.low.shape == (16, 20, 3)
    assert first.level == 0.9
    assert (first.radiance == again.radiance).all()
    assert (first.low <= first.high).all()


def test_only_the_first_samples_count():
    whole, part = image(), chd.Samples.from_array(image().read(ss=slice(0, 8)))
    assert (estimate(whole, spp=8).radiance == estimate(part).radiance).all()


def test_a_model_is_taken_as_it_is_or_from_its_file(model, tmp_path):
    model.save(tmp_path / "a.safetensors")
    expected = model.estimate(image(spp=32).read(), level=0.5)
    for given in (model, tmp_path / "a.safetensors", str(tmp_path / "a.safetensors")):
        found = estimate(image(spp=32), given, level=0.5)
        assert (found.radiance == expected.radiance).all()
        assert (found.high == expected.high).all()


def test_a_network_that_says_no_more_than_an_estimate(tmp_path, model, monkeypatch):
    expected = model.predict(image(spp=64).read(ss=slice(0, 32)))
    monkeypatch.delattr(MLP, "estimate")
    found = estimate(image(spp=64), model, spp=32)
    assert (found.radiance == expected).all()
    assert np.isnan([found.level, found.certainty.mean(), found.low.mean()]).all()
    file = write_estimates(tmp_path / "a.exr", image(spp=32), model)
    assert set(read_exr(file).extra) == {"mean"}
    with pytest.raises(InputError, match="32"):
        estimate(image(), model)


def test_the_denoiser_comes_last(doubling, model):
    plain, smooth = (estimate(image(spp=32), model, denoise=way) for way in (False, True))
    assert smooth.radiance == pytest.approx(2 * plain.radiance.clip(min=0), rel=1e-5)
    assert (smooth.low == plain.low).all()


def test_the_file_holds_the_estimate_and_what_belongs_to_it(tmp_path, model, doubling):
    samples = image(spp=32)
    file = write_estimates(tmp_path / "a.exr", samples, model, denoise=True)
    found, expected = read_exr(file), estimate(samples, model)
    assert set(found.extra) == {"certainty", "low", "high", "mean", "estimate"}
    assert (found.extra["estimate"] == expected.radiance).all()
    assert (found.extra["certainty"] == expected.certainty).all()
    assert found.extra["mean"] == pytest.approx(samples.read().mean(axis=-1), rel=1e-5)
    said = found.attributes
    assert (said["scene"], said["spp"], said["level"]) == ("made up", "32", "0.9")
    assert said["denoiser"] == "Open Image Denoise"
    assert json.loads(said["model"])["iterations"] == 5


@pytest.mark.parametrize("channels", [1, 2])
def test_images_of_other_channels_have_a_file_too(tmp_path, channels, model):
    samples = image(spp=32, channels=channels)
    file = write_estimates(tmp_path / "a.exr", samples, model)
    names = None if channels == 1 else samples.channels
    assert read_exr(file, channels=names).image.shape == (16, 20, channels)


def test_where_the_mean_is_finite_so_is_the_estimate(tmp_path):
    x = image().read().copy()
    x[0, 0, 0, 3], x[1, 1, 2, 5], x[2, 2, :, 0] = np.nan, np.inf, -1
    x[3, 3], x[5, 5] = 0, np.nan
    found = read_exr(write_estimates(tmp_path / "a.exr", chd.Samples.from_array(x)))
    finite = np.isfinite(found.extra["mean"])
    assert finite.sum() == 3 * (16 * 20 - 1)
    assert np.isfinite(found.image[finite]).all()


def test_what_cannot_be_estimated_is_refused_and_leaves_no_file(tmp_path, model, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="32"):
        write_estimates("a.exr", image(), model)
    (tmp_path / "b.exr").mkdir()
    with pytest.raises(InputError, match="b.exr"):
        write_estimates("b.exr", image(), model)
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(InputError, match="pyoidn"):
        write_estimates("a.exr", image(), denoise=True)
    assert [path.name for path in tmp_path.iterdir()] == ["b.exr"]
