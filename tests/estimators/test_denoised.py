"""Denoised estimators: what the denoiser is given, who shares a training, what is refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import denoised
from chdstat.errors import InputError
from chdstat.estimators import Estimator, train_model


def image(*, height=16, width=12, spp=64, features=True):
    rng = np.random.default_rng(0)
    brightness = rng.lognormal(size=(height, width, 1, 1))
    known = {"albedo": np.full((height, width, 3), 0.5), "normal": np.zeros((height, width, 3))}
    return chd.Samples.from_array(
        brightness * rng.gamma(0.7, size=(height, width, 3, spp)),
        features=known if features else None,
    )


@pytest.fixture
def network(monkeypatch):
    """Take the place of the denoiser: it doubles an image and notes what it was given."""
    seen = []

    def double(images, *, hdr):
        seen.append((images["color"].copy(), sorted(images.keys() - {"color"})))
        return 2 * images["color"]

    monkeypatch.setattr("chdstat._core.denoiser.run_network", double)
    return seen


def test_names_say_what_the_denoiser_is_given():
    assert denoised("mean").name == "mean + OIDN"
    assert denoised("elek2019", with_features=True).name == "elek2019 + OIDN features"
    assert denoised("mean").uses_neighbours


def test_the_denoised_estimate_is_judged(network):
    samples = image()
    found = chd.compare(samples, ["mean", denoised("median")], n=16)
    assert found.estimators == ("mean", "median + OIDN")
    assert found.uses_neighbours.tolist() == [False, True]
    median = chd.estimators.median(samples.read(ss=slice(0, 16)))
    assert found.estimates[1] == pytest.approx(2 * median, rel=1e-5)
    assert all(guides == [] for _, guides in network)


def test_features_are_given_where_they_are_asked_for(network):
    chd.compare(image(), [denoised("mean", with_features=True)], n=16)
    assert {tuple(guides) for _, guides in network[1:]} == {("albedo", "normal")}


def test_what_is_negative_counts_as_black(network):
    below = Estimator("below", lambda x: x.mean(axis=-1) - 1e6, source="this test")
    found = chd.compare(image(), [denoised(below)], n=16)
    assert (found.estimates == 0).all()


def test_every_estimator_is_compared_in_every_way(network):
    model = train_model(image(), iterations=5, progress=False)
    found = chd.compare(image(), ["mean", "elek2019"], model=model, denoise=True)
    assert found.estimators == (
        "mean",
        "elek2019",
        "mean + OIDN",
        "mean + OIDN features",
        "elek2019 + OIDN",
        "elek2019 + OIDN features",
    )
    alone = chd.compare(image(), ["mean", "elek2019"], model=model)
    assert [row["mse"] for row in alone.table()] == [row["mse"] for row in found.table()[:2]]


def test_without_features_none_are_given(network):
    found = chd.compare(image(features=False), ["mean"], n=16, denoise=True)
    assert found.estimators == ("mean", "mean + OIDN")


def test_curves_take_them_too(network):
    curve = chd.comparison.error_curve(image(), [denoised("mean")], sizes=[8, 16])
    assert curve.estimators == ("mean + OIDN",)


def test_what_cannot_be_denoised_is_refused(monkeypatch, network):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(InputError, match="pyoidn"):
        chd.compare(image(), ["mean"], n=16, denoise=True)
    with pytest.raises(InputError, match="pyoidn"):
        chd.compare(image(), [denoised("mean")], n=16)


def test_open_image_denoise_makes_a_noisy_wall_smooth():
    """The noise of a flat image falls to less than half; negative control: the mean itself."""
    rng = np.random.default_rng(1)
    wall = chd.Samples.from_array(rng.gamma(0.7, size=(32, 32, 3, 64)))
    mean, smooth = chd.compare(wall, ["mean"], n=16, denoise=True).table()
    assert mean["mse_ratio"] == 1
    assert smooth["mse_ratio"] < 0.7
