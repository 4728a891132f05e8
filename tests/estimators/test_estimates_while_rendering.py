"""Estimates of a rendering: as those of samples, of which none is kept."""

from __future__ import annotations

import json

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import Progressive
from chdstat.estimators.estimates import estimate, write_estimates
from chdstat.estimators.models import train_model
from chdstat.io import read_exr
from chdstat.rendering import render_batches


def rendering(spp=16, **options):
    asked = {"spp": spp, "batch": 8, "size": (10, 8), "backend": "scalar", "progress": False}
    return render_batches("cornell-box", **(asked | options))


@pytest.fixture(scope="module")
def box() -> chd.Samples:
    return chd.render("cornell-box", spp=16, size=(10, 8), backend="scalar")


def test_the_file_holds_what_that_of_samples_holds(tmp_path, box):
    file = write_estimates(tmp_path / "a.exr", rendering(), iterations=4)
    found = read_exr(file)
    assert found.image.shape == (8, 10, 3)
    assert set(found.extra) == {"certainty", "low", "high", "mean"}
    assert found.extra["mean"] == pytest.approx(box.read().mean(axis=-1), rel=1e-4, abs=1e-6)
    said, model = found.attributes, json.loads(found.attributes["model"])
    assert (said["scene"], said["spp"]) == ("cornell-box", "16")
    assert said["training"] == "while rendering, without a reference"
    assert (model["iterations"], model["inputs"], model["on_the_fly"]) == (4, ["features"], True)
    assert model["samples"]["scene"] == "cornell-box"


def test_a_model_is_taken_as_it_is(box):
    model = train_model(box, reference=False, iterations=2, progress=False)
    assert model.inputs.neighbours
    with pytest.raises(InputError, match="look neither at neighbours"):
        estimate(rendering(), model)
    alone = Progressive(inputs=["features"]).train(
        box, reference=False, iterations=2, progress=False
    )
    expected = alone.estimate(box.read(), features=box.features, unit=1.0)
    found = estimate(rendering(), alone)
    # The unit is that of the first batch.
    assert found.radiance == pytest.approx(expected.radiance, rel=0.2, abs=0.02)


def test_a_black_scene_is_black():
    dark = {"type": "scene", "sensor": {"type": "perspective"}, "ball": {"type": "sphere"}}
    found = estimate(render_batches(dark, spp=4, size=(6, 5), backend="scalar"), iterations=2)
    assert (found.radiance == 0).all()
    assert np.isnan(found.level)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"spp": 8}, "set where it is made: 16, got 8 here"),
        ({"loss_weight": 2}, "loss_weight must lie between 0"),
        ({"level": 0}, "level must lie between 0 and 1"),
        ({"iterations": 0}, "iterations must be at least 1"),
    ],
)
def test_what_cannot_be_estimated_is_refused_before_it_renders(monkeypatch, options, match):
    asked = rendering()
    monkeypatch.setattr(type(asked), "__iter__", None)
    with pytest.raises(InputError, match=match):
        estimate(asked, **options)


def test_too_few_samples_are_refused_before_they_are_rendered(monkeypatch):
    asked = rendering(spp=3)
    monkeypatch.setattr(type(asked), "__iter__", None)
    with pytest.raises(InputError, match="at least 4 spp, got 3"):
        estimate(asked)
