"""Estimates of samples and of renderings: one call to an image, and the file of it."""

from __future__ import annotations

import itertools
import json
import logging
import re
import sys

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import MLP
from chdstat.estimators.estimates import CombinationStream, estimate
from chdstat.estimators.training import train_model
from chdstat.io import read_exr, write_estimates
from chdstat.rendering import render_batches

QUICK = {"iterations": 5, "progress": False}


def image(spp=16, channels=3, features=False):
    rng = np.random.default_rng(0)
    x = rng.lognormal(size=(16, 20, 1, 1)) * rng.gamma(0.7, size=(16, 20, channels, spp))
    known = {"albedo": np.full((16, 20, 3), 0.5)} if features else None
    return chd.Samples.from_array(x, features=known, axes="yxcs", scene="made up")


@pytest.fixture(scope="module")
def model():
    return train_model(image(spp=64), **QUICK)


def test_samples_beyond_memory_are_refused(monkeypatch, model):
    samples = image(spp=64)
    monkeypatch.setattr("chdstat._core.work.memory", lambda: 1.5 * samples.nbytes)
    with pytest.raises(InputError, match="64 spp.*--spp"):
        estimate(samples, model)
    estimate(samples, model, spp=32)


@pytest.fixture
def doubling(monkeypatch):
    monkeypatch.setattr(
        "chdstat._core.denoiser.run_network", lambda images, **_: 2 * images["color"]
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


def test_the_file_holds_what_belongs_to_it(tmp_path, model, doubling):
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


def test_a_refused_estimate_leaves_no_file(tmp_path, model, monkeypatch):
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


# --- estimates of a rendering ---------------------------------------------------------------------


def rendering(spp=16, **options):
    asked = {"spp": spp, "batch": 8, "size": (10, 8), "backend": "scalar", "progress": False}
    return render_batches("cornell-box", **(asked | options))


@pytest.fixture(scope="module")
def box() -> chd.Samples:
    return chd.render("cornell-box", spp=16, size=(10, 8), backend="scalar", progress=False)


def test_the_file_holds_what_that_of_samples_holds(tmp_path, box):
    found, expected = (
        read_exr(write_estimates(tmp_path / f"{name}.exr", source))
        for name, source in (("streamed", rendering()), ("stored", box))
    )
    assert found.image.shape == (8, 10, 3)
    assert found.extra.keys() == expected.extra.keys()
    assert np.array_equal(found.image, expected.image)
    assert np.array_equal(found.extra["high"], expected.extra["high"])
    assert (found.attributes["scene"], found.attributes["spp"]) == ("cornell-box", "16")


def test_a_black_scene_is_black():
    dark = {"type": "scene", "sensor": {"type": "perspective"}, "ball": {"type": "sphere"}}
    found = estimate(render_batches(dark, spp=4, size=(6, 5), backend="scalar", progress=False))
    assert (found.radiance == 0).all()


def test_a_model_needs_samples(model, monkeypatch):
    asked = rendering()
    monkeypatch.setattr(type(asked), "passes", None)
    with pytest.raises(InputError, match="none are kept"):
        estimate(asked, model)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"spp": 8}, "set where it is made: 16, got 8 here"),
        ({"level": 0}, "level must lie between 0 and 1"),
    ],
)
def test_refusals_come_before_rendering(monkeypatch, options, match):
    asked = rendering()
    monkeypatch.setattr(type(asked), "passes", None)
    with pytest.raises(InputError, match=match):
        estimate(asked, **options)


def test_too_few_samples_are_not_rendered(monkeypatch):
    asked = rendering(spp=3)
    monkeypatch.setattr(type(asked), "passes", None)
    with pytest.raises(InputError, match="at least 4"):
        estimate(asked)


def test_it_gets_better_as_samples_come():
    found = list(CombinationStream.passes(rendering(spp=72)))
    assert [image.spp for image in found] == [16, 32, 64, 72]
    assert found[-1].relative_error < found[0].relative_error
    assert [image.spp for image in CombinationStream.passes(rendering(spp=4096), seconds=1e-6)] == [
        4
    ]


def test_it_stops_when_the_error_is_sure(tmp_path, caplog):
    caplog.set_level(logging.INFO, "chdstat")
    first = next(CombinationStream.passes(rendering(spp=4096)))
    wanted = first.relative_error / 1.5
    passes = list(CombinationStream.passes(rendering(spp=4096), error=wanted))
    *before, reached = (image.error.reaches(wanted) for image in passes)
    assert reached
    assert not any(before)
    numbers = [image.spp for image in passes]
    assert all(1.25 * n <= next_n <= 2 * n for n, next_n in itertools.pairwise(numbers))
    file = write_estimates(tmp_path / "a.exr", rendering(spp=4096), relative_error=wanted)
    assert read_exr(file).attributes["spp"] == str(numbers[-1])
    told = [message.replace("\N{NO-BREAK SPACE}", " ") for message in caplog.messages]
    assert re.fullmatch(
        r"16 spp: relative error \d+ % \[\d+ %, \d+ %\]; \d+ % takes about \d+ spp, .+ more",
        told[0],
    )
    assert re.fullmatch(rf"{numbers[-1]} spp: relative error [\d.]+ % \[.+\]", told[-1])


def test_an_error_not_reached_is_said(tmp_path, caplog):
    write_estimates(tmp_path / "a.exr", rendering(spp=16), relative_error=1e-4)
    assert "the relative error of 0.0001 was not reached in all samples" in caplog.messages


def test_what_is_there_already_is_not_stopped(tmp_path, box):
    with pytest.raises(InputError, match="rendering"):
        write_estimates(tmp_path / "a.exr", box, seconds=1)
    with pytest.raises(InputError, match="seconds .*0"):
        next(CombinationStream.passes(rendering(), seconds=0))
    with pytest.raises(InputError, match="error .*0"):
        next(CombinationStream.passes(rendering(), error=0))
