"""Denoised estimators: what the denoiser is given, who shares a training, what is refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import denoised
from chdstat.errors import InputError
from chdstat.estimators import Estimator, Progressive, lookup, registry


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

    monkeypatch.setattr("chdstat.io.denoiser.run_network", double)
    return seen


@pytest.fixture(scope="module")
def model():
    return Progressive().train(image(), sizes=[16], iterations=10, progress=False)


def test_names_say_what_the_denoiser_is_given():
    assert denoised("mean").name == "mean + OIDN"
    assert denoised("progressive", with_features=True).name == "progressive + OIDN features"
    assert denoised(lookup("progressive"), with_certainty=True).name.endswith("OIDN certainty")
    assert denoised("mean").uses_neighbours


def test_the_denoiser_is_given_the_estimate_and_its_image_is_judged(network):
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


def test_what_is_certain_stays(network, model):
    samples = image()
    asked = [denoised("progressive_mse", with_certainty=True)]
    found = chd.compare(samples, asked, n=16, model=model)
    said = model.estimate(samples.read(ss=slice(0, 16)), loss_weight=0)
    expected = said.radiance * (2 - said.certainty[..., np.newaxis])
    assert found.estimates[0] == pytest.approx(expected, rel=1e-4)


def test_every_estimator_is_compared_in_every_way(network, model):
    found = chd.compare(image(), ["mean", "progressive"], n=16, model=model, denoise=True)
    assert found.estimators == (
        "mean",
        "progressive",
        "mean + OIDN",
        "mean + OIDN features",
        "progressive + OIDN",
        "progressive + OIDN features",
        "progressive + OIDN certainty",
        "progressive + OIDN features certainty",
    )
    alone = chd.compare(image(), ["mean", "progressive"], n=16, model=model)
    assert [row["mse"] for row in alone.table()] == [row["mse"] for row in found.table()[:2]]


def test_without_features_none_are_given(network):
    found = chd.compare(image(features=False), ["mean"], n=16, denoise=True)
    assert found.estimators == ("mean", "mean + OIDN")


def test_a_denoised_estimator_shares_the_training_of_its_own(network, monkeypatch):
    calls = []

    def train(samples, **options):
        calls.append(options)
        return Progressive().train(samples, iterations=5, **options)

    entry = registry.LearnedEstimator("mine", train, "this test", inputs=None, pixels=64)
    monkeypatch.setitem(registry.ENTRIES, "mine", entry)
    found = chd.compare(image(), ["mine", denoised("mine")], n=16)
    assert len(calls) == 1
    assert list(found.models) == ["mine"]
    assert not found.test_pixels[tuple(found.models["mine"].train_pixels.T)].any()
    # Alone, it trains what it needs.
    assert list(chd.compare(image(), [denoised("mine")], n=16).models) == ["mine"]


def test_curves_take_them_too(network):
    curve = chd.comparison.error_curve(image(), [denoised("mean")], sizes=[8, 16])
    assert curve.estimators == ("mean + OIDN",)


def test_what_cannot_be_denoised_is_refused_before_any_work(monkeypatch, network):
    with pytest.raises(InputError, match="needs the albedo"):
        chd.compare(image(features=False), [denoised("mean", with_features=True)], n=16)
    with pytest.raises(InputError, match="'mean' does not"):
        denoised("mean", with_certainty=True)
    with pytest.raises(InputError, match="at least 11 samples"):
        chd.compare(image(), [denoised("median_of_means")], n=8)
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(InputError, match="cannot be loaded"):
        chd.compare(image(), ["mean"], n=16, denoise=True)
    with pytest.raises(InputError, match="cannot be loaded"):
        chd.compare(image(), [denoised("mean")], n=16)


def test_a_model_without_certainty_is_refused(network):
    samples = image()
    with pytest.raises(InputError, match="elek2019 says no certainty"):
        chd.compare(
            samples,
            [denoised("elek2019", with_certainty=True)],
            model=chd.estimators.MLP.preset("elek2019").train(samples, iterations=5),
        )


def test_open_image_denoise_makes_a_noisy_wall_smooth():
    """The noise of a flat image falls to less than half; negative control: the mean itself."""
    rng = np.random.default_rng(1)
    wall = chd.Samples.from_array(rng.gamma(0.7, size=(32, 32, 3, 64)))
    mean, smooth = chd.compare(wall, ["mean"], n=16, denoise=True).table()
    assert mean["mse_ratio"] == 1
    assert smooth["mse_ratio"] < 0.7
