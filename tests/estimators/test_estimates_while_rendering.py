"""Estimates of a rendering: as those of samples, of which none is kept."""

from __future__ import annotations

import itertools
import logging
import re

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators.estimates import CombinationStream, estimate
from chdstat.io import read_exr, write_estimates
from chdstat.rendering import render_batches


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
def test_what_cannot_be_estimated_is_refused_before_it_renders(monkeypatch, options, match):
    asked = rendering()
    monkeypatch.setattr(type(asked), "passes", None)
    with pytest.raises(InputError, match=match):
        estimate(asked, **options)


def test_too_few_samples_are_refused_before_they_are_rendered(monkeypatch):
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
        r"16 spp: relative error \d+ %; \d+ % takes about \d+ spp, .+ more", told[0]
    )
    assert re.fullmatch(rf"{numbers[-1]} spp: relative error [\d.]+ %", told[-1])


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
