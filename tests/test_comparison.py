"""Comparison: same batches, held-out references and pixels, and what happens at the edges."""

import json

import numpy as np
import pytest

import chdstat as chd
from chdstat import metrics
from chdstat._tally import MEASURES
from chdstat.errors import InputError
from chdstat.estimators import MLP, Estimator, registry


def picture(height=20, width=16, spp=160, seed=0):
    rng = np.random.default_rng(seed)
    brightness = rng.lognormal(0, 1, size=(height, width, 1, 1)) * np.array([1, 0.8, 0.5])[:, None]
    x = brightness * rng.gamma(0.7, size=(height, width, 3, spp))
    return chd.Samples.from_array(x, scene="made up", max_depth=8)


@pytest.fixture(scope="module")
def model():
    return MLP.preset("elek2019").train(picture(), iterations=200)


@pytest.fixture(scope="module")
def found(model):
    return chd.compare(picture(), model=model)


def expected_measures(x, n, estimator, keep):
    """Compute the measures the long way round: one list of all estimates, one of all references."""
    x = x[keep]
    p, y, m = [], [], []
    for first in range(0, x.shape[-1] - n + 1, n):
        batch = np.s_[first : first + n]
        p.append(estimator(x[..., batch]))
        m.append(x[..., batch].mean(axis=-1))
        y.append(np.delete(x, batch, axis=-1).mean(axis=-1, dtype=np.float64))
    return np.stack(p), np.stack(y), np.stack(m)


@pytest.mark.parametrize("name", ["mean", "median_of_means", "elek2019"])
def test_measures_are_those_of_metrics_on_held_out_batches_and_pixels(found, model, name):
    samples = picture()
    function = model.predict if name == "elek2019" else getattr(chd.estimators, name)
    p, y, m = expected_measures(samples.read(), 32, function, found.test_pixels)
    scene_mean = samples.read().mean(axis=(0, 1, 3), dtype=np.float64)
    k = found.estimators.index(name)
    got = {measure: interval.value[k, :3] for measure, interval in found.measures.items()}
    assert got["mse"] == pytest.approx(metrics.mse(p, y), rel=1e-4)
    assert got["relmse"] == pytest.approx(metrics.relmse(p, y, scene_mean=scene_mean), rel=1e-4)
    assert got["bias"] == pytest.approx(metrics.bias(p, y), abs=1e-6)
    assert got["mse_ratio"] == pytest.approx(metrics.mse(p, y) / metrics.mse(m, y), rel=1e-4)
    if name != "mean":
        assert got["improved"] == pytest.approx(metrics.improved(p, y, m), abs=1e-3)


def test_only_pixels_that_trained_nothing_count(found, model):
    assert not found.test_pixels[tuple(model.train_pixels.T)].any()
    assert found.test_pixels.sum() == 160
    assert found.batches == 160 * 5
    assert found.excluded == 0


def test_the_mean_is_the_unit_of_the_ratios(found):
    row = found.table()[0]
    assert row["estimator"] == "mean"
    assert (row["mse_ratio"], row["relmse_ratio"], row["improved"]) == (1, 1, 0)
    # Without "mean" among them, the others are still measured against it.
    alone = chd.compare(picture(), ["median_of_means"])
    both = chd.compare(picture(), ["mean", "median_of_means"])
    assert alone.table()[0]["mse_ratio"] == both.table()[1]["mse_ratio"] > 1


def test_channel_average_is_the_last_place(found):
    mse = found.measures["mse"]
    assert mse.value.shape == (3, 4)
    assert mse.value[:, 3] == pytest.approx(mse.value[:, :3].mean(axis=1))
    assert (mse.low < mse.value).all()
    assert (mse.value < mse.high).all()


def test_an_estimate_that_holds_the_reference_of_a_leaky_protocol_is_not_free_of_error():
    # The mean of all samples of a pixel is what a leaky protocol takes for the reference, so there
    # its error would be 0. Here, with two batches of means a and b, (a + b)/2 is judged by b: half
    # of the error a - b of the sample mean, a quarter when squared.
    samples = picture(spp=64)
    truth = samples.read().mean(axis=-1)
    leak = Estimator("leak", lambda x: truth[: x.shape[0]], source="this test")
    row = chd.compare(samples, [leak]).table()[0]
    assert row["mse_ratio"] == pytest.approx(0.25, rel=1e-4)


def test_pictures_are_one_estimate_of_the_first_samples(found, model):
    x = picture().read()
    assert found.estimates.shape == (3, 20, 16, 3)
    assert found.estimates[0] == pytest.approx(x[..., :32].mean(axis=-1), rel=1e-5)
    assert found.estimates[2] == pytest.approx(model.predict(x[..., :32]), rel=1e-4, abs=1e-5)
    assert found.reference == pytest.approx(x.mean(axis=-1), rel=1e-5)
    rest = x[..., 32:].mean(axis=-1)
    assert found.squared_error[0] == pytest.approx(
        (x[..., :32].mean(axis=-1) - rest) ** 2, rel=1e-3
    )


def test_the_result_is_ready_for_json_and_netcdf(found):
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert content["table"][2]["estimator"] == "elek2019"
    assert set(content["per_channel"]["mean"]["mse"]) == {"R", "G", "B"}
    dataset = found.to_dataset()
    assert set(MEASURES) <= set(dataset)
    assert dataset["mse"].sel(estimator="mean", part="mean") == found.table()[0]["mse"]
    assert all({"long_name", "units"} <= set(v.attrs) for v in dataset.data_vars.values())
    assert all(isinstance(v, str | int) for v in dataset.attrs.values())


def test_the_same_seed_compares_the_same():
    first, again = (chd.compare(picture(), ["median_of_means"], seed=3).table() for _ in range(2))
    assert first == again


def test_a_missing_model_is_trained_on_pixels_of_the_seed(monkeypatch):
    calls = []

    def train(samples, *, seed, pixels, progress):
        calls.append((seed, len(pixels)))
        return MLP.preset("elek2019").train(samples, seed=seed, pixels=pixels, iterations=5)

    entry = registry.lookup("elek2019")
    quick = registry.LearnedEstimator("elek2019", train, entry.source, entry.inputs, entry.pixels)
    monkeypatch.setitem(registry._ENTRIES, "elek2019", quick)
    found = chd.compare(picture(), ["elek2019"], seed=4)
    assert calls == [(4, 160)]
    assert not found.test_pixels[tuple(found.models["elek2019"].train_pixels.T)].any()


def test_a_model_of_another_picture_holds_no_pixel_back(model):
    found = chd.compare(picture(height=8, width=8, seed=1), ["elek2019"], model=model)
    assert found.test_pixels.all()


def test_batches_with_bad_samples_are_left_out_and_counted():
    x = picture(spp=96).read().copy()
    x[3, 4, 1, 40] = np.nan
    x[5, 5, 2, 80] = -1
    found = chd.compare(chd.Samples.from_array(x), ["mean", "median_of_means"])
    assert found.excluded == 2
    assert found.batches == 20 * 16 * 3 - 2
    assert all(np.isfinite(v) for row in found.table() for k, v in row.items() if k != "estimator")


def test_max_batches_limits_what_estimates_and_not_the_reference():
    few, whole = (chd.compare(picture(), ["mean"], max_batches=k) for k in (1, None))
    assert few.batches == 320
    assert whole.batches == 5 * 320
    assert (few.reference == whole.reference).all()


def test_an_all_null_picture_has_no_error_and_no_ratio():
    black = chd.Samples.from_array(np.zeros((6, 6, 3, 64)))
    model = MLP.preset("elek2019").train(black, iterations=5)
    for row in chd.compare(black, model=model).table():
        assert row["mse"] == row["relmse"] == row["improved"] == 0
        assert np.isnan([row["mse_ratio"], row["relmse_ratio"], row["bias"]]).all()
    json.dumps(chd.compare(black, ["mean"]).to_dict(), allow_nan=False)


def test_one_channel_is_enough():
    found = chd.compare(chd.Samples.from_array(np.ones((3, 3, 64))), ["mean"])
    assert found.channels == ("channel0",)
    assert found.measures["mse"].value.shape == (1, 2)


@pytest.mark.parametrize(
    ("estimators", "options", "match"),
    [
        (["mean", "mean"], {}, "different names"),
        ([], {}, "different names"),
        (["men"], {}, "no estimator is called 'men'"),
        (["median_of_means"], {"n": 8}, "at least 11 samples, got n=8"),
        (["elek2019"], {"n": 16}, "exactly 32 samples, got n=16"),
        (["mean"], {"n": 81}, "at least 162 spp, got 160"),
        (["mean"], {"n": 0}, "n must be"),
        (["mean"], {"max_batches": 0}, "max_batches must be"),
    ],
)
def test_what_cannot_be_compared_is_refused(estimators, options, match):
    with pytest.raises(InputError, match=match):
        chd.compare(picture(), estimators, **options)


def test_a_model_that_nobody_asked_for_is_refused(model):
    with pytest.raises(InputError, match="not among"):
        chd.compare(picture(), ["mean"], model=model)


def test_a_picture_that_trained_everywhere_cannot_judge():
    samples = picture(height=4, width=4)
    pixels = np.stack(np.indices((4, 4)), axis=-1).reshape(-1, 2)
    model = MLP.preset("elek2019").train(samples, pixels=pixels, iterations=5)
    with pytest.raises(InputError, match="none is left"):
        chd.compare(samples, ["elek2019"], model=model)


def test_a_picture_of_bad_samples_cannot_judge():
    with pytest.raises(InputError, match="every sample"):
        chd.compare(chd.Samples.from_array(np.full((2, 2, 3, 64), np.nan)), ["mean"])
    x = np.ones((2, 2, 3, 64))
    x[..., ::32] = np.inf
    with pytest.raises(InputError, match="every batch"):
        chd.compare(chd.Samples.from_array(x), ["mean"])
