"""Comparison: same batches, held-out references and pixels, and what happens at the edges."""

import json
import re
import tracemalloc
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import chdstat as chd
from chdstat.comparison import MEASURES, curve_sizes, error_curve
from chdstat.comparison.estimator_choice import estimate_by
from chdstat.comparison.judges import Judge
from chdstat.comparison.judging import Units
from chdstat.comparison.metrics import SUMS, errors_of, measures_of
from chdstat.errors import InputError
from chdstat.estimators import MLP, Estimator, registry
from chdstat.estimators.registry import title_of
from chdstat.patterns import Label

THREE = ("mean", "median_of_means", "elek2019")


def own(name, function, **options):
    return Estimator(name, function, source="this test", **options)


def image(height=20, width=16, spp=160, seed=0):
    rng = np.random.default_rng(seed)
    brightness = rng.lognormal(0, 1, size=(height, width, 1, 1)) * np.array([1, 0.8, 0.5])[:, None]
    x = brightness * rng.gamma(0.7, size=(height, width, 3, spp))
    return chd.Samples.from_array(x, scene="made up", max_depth=8)


@pytest.fixture(scope="module")
def model():
    return MLP.preset("elek2019").train(image(), iterations=200)


@pytest.fixture(scope="module")
def found(model):
    return chd.compare(image(), THREE, model=model)


def expected_measures(x, n, estimator, batches=None):
    """Compute the measures the long way round, from all pairs of parts of the other samples."""
    errors, numbers = {"p": [], "mean": []}, np.arange(x.shape[-1])
    bias, truth = [], []
    for first in [*range(0, x.shape[-1] - n + 1, n)][:batches]:
        batch = (numbers >= first) & (numbers < first + n)
        parts = [
            x[..., ~batch & (numbers % 4 == k)].mean(axis=-1, dtype=np.float64) for k in range(4)
        ]
        of_batch = {"p": estimator(x[..., batch]), "mean": x[..., batch].mean(axis=-1)}
        for name, p in of_batch.items():
            pairs = [(p - a) * (p - b) for a, b in combinations(parts, 2)]
            errors[name].append(np.mean(pairs, axis=0))
        truth.append(np.mean(parts, axis=0))
        bias.append(of_batch["p"] - truth[-1])
    mse, of_mean, bias, truth = (
        np.mean(e, axis=(0, 1)) for e in (errors["p"], errors["mean"], bias, truth)
    )
    return {"mse": mse, "bias": bias / truth, "mse_ratio": mse / of_mean}


@pytest.mark.parametrize("name", ["mean", "median_of_means", "elek2019"])
def test_measures_follow_their_definition(found, model, name):
    samples = image()
    function = model.predict if name == "elek2019" else getattr(chd.estimators, name)
    expected = expected_measures(samples.read()[found.test_pixels], 32, function)
    k = found.estimators.index(name)
    for measure, value in expected.items():
        got = found.measures[measure].value[k, :3]
        assert got == pytest.approx(value, rel=1e-4, abs=1e-6)


def test_only_pixels_that_trained_nothing_count(found, model):
    assert not found.test_pixels[tuple(model.train_pixels.T)].any()
    assert (found.test_pixels.sum(), found.batches, found.excluded) == (160, 160 * 5, 0)
    elsewhere = chd.compare(image(height=8, width=8, seed=1), ["elek2019"], model=model)
    assert elsewhere.test_pixels.all()


def test_the_mean_is_the_unit_of_the_ratios(found):
    row = found.table()[0]
    assert row["estimator"] == "mean"
    assert (row["mse_ratio"], row["relmse_ratio"], row["improved"]) == (1, 1, 0)
    mse = found.measures["mse"]
    assert mse.value.shape == (3, 4)
    assert mse.value[:, 3] == pytest.approx(mse.value[:, :3].mean(axis=1))
    assert ((mse.low < mse.value) & (mse.value < mse.high)).all()
    # Without "mean" among them, the others are still measured against it.
    alone, both = (chd.compare(image(), names) for names in (THREE[1:2], THREE[:2]))
    assert alone.table()[0]["mse_ratio"] == both.table()[1]["mse_ratio"] > 1


def test_images_are_one_estimate_of_the_first_samples(found, model):
    x = image().read()
    assert found.estimates.shape == (3, 20, 16, 3)
    assert found.estimates[0] == pytest.approx(x[..., :32].mean(axis=-1), rel=1e-5)
    assert found.estimates[2] == pytest.approx(model.predict(x[..., :32]), rel=1e-4, abs=1e-5)
    assert found.reference == pytest.approx(x.mean(axis=-1), rel=1e-5)
    assert found.first_mean == pytest.approx(x[..., :32].mean(axis=-1), rel=1e-5)
    assert found.first_reference.mean == pytest.approx(x[..., 32:].mean(axis=-1), rel=1e-4)


def test_the_result_is_ready_for_json_and_netcdf(found, labelled):
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert content["table"][2]["estimator"] == "elek2019"
    assert set(content["per_channel"]["mean"]["mse"]) == {"R", "G", "B"}
    dataset = found.to_dataset()
    assert set(MEASURES) <= set(dataset)
    assert dataset["mse"].sel(estimator="mean", part="mean") == found.table()[0]["mse"]
    assert all({"long_name", "units"} <= set(v.attrs) for v in dataset.data_vars.values())
    assert all(isinstance(v, str | int) for v in dataset.attrs.values())
    split = chd.compare(image(), ["mean", "median"], labels=labelled).to_dataset()
    assert split["label_relmse"].dims == ("label", "estimator")
    assert split["label_pixels"].sel(label="null_heavy") == 12
    assert all({"long_name", "units"} <= set(v.attrs) for v in split.data_vars.values())


def test_a_missing_model_is_trained(monkeypatch):
    calls = []

    def train(samples, *, seed, pixels, progress):
        calls.append((seed, len(pixels)))
        return MLP.preset("elek2019").train(samples, seed=seed, pixels=pixels, iterations=5)

    entry = registry.lookup("elek2019")
    quick = registry.LearnedEstimator("elek2019", train, entry.source, entry.inputs, entry.pixels)
    monkeypatch.setitem(registry.ENTRIES, "elek2019", quick)
    found = chd.compare(image(), ["elek2019"], seed=4)
    assert calls == [(4, 160)]
    assert not found.test_pixels[tuple(found.models["elek2019"].train_pixels.T)].any()


def test_no_row_depends_on_who_else_is_compared(monkeypatch):
    """Who wants more pixels trains nobody else on more, and takes none from those that judge."""
    entry = registry.lookup("elek2019")
    for name, few in (("elek2019", 40), ("mine", 100)):
        quick = replace(entry, name=name, train=partial(entry.train, iterations=20), pixels=few)
        monkeypatch.setitem(registry.ENTRIES, name, quick)
    alone = chd.compare(image(), ["mean", "elek2019"], seed=4)
    beside = chd.compare(image(), ["mean", "elek2019", "mine"], seed=4)
    assert [len(m.train_pixels) for m in beside.models.values()] == [40, 100]
    again = chd.compare(image(), ["mean", "elek2019"], seed=4, model=alone.models)
    assert again.to_dict()["table"] == alone.to_dict()["table"]
    for other in (beside, again):
        for row, same in zip(alone.table(), other.table(), strict=False):
            assert same.pop("estimator") == row["estimator"]
            expected = {key: value for key, value in row.items() if key != "estimator"}
            assert same == pytest.approx(expected, rel=1e-12, nan_ok=True)


def test_bad_batches_are_left_out_and_counted():
    x = image(spp=96).read().copy()
    x[3, 4, 1, 40] = np.nan
    x[5, 5, 2, 80] = -np.inf
    found = chd.compare(chd.Samples.from_array(x), ["mean", "median_of_means"])
    assert found.excluded == 2
    assert found.batches == 20 * 16 * 3 - 2
    for row in found.table():
        numbers = [row[f"{m}{end}"] for m in ("mse", "mse_ratio", "bias") for end in ("", "_low")]
        assert np.isfinite(numbers).all()


def test_counts_that_differ_share_batches():
    x = image(spp=96).read()
    counts = np.broadcast_to(np.where(np.arange(16) < 8, 64, 96), (20, 16))
    found = chd.compare(chd.Samples.from_array(x, counts=counts), ["mean"])
    errors = []
    for half, spp in ((x[:, :8], 64), (x[:, 8:], 96)):
        pixels = half.reshape(-1, 3, 96)[..., :spp]
        errors.append(expected_measures(pixels, 32, chd.estimators.mean, batches=2)["mse"])
    assert found.batches == 2 * 320
    assert found.table()[0]["mse"] == pytest.approx(np.mean(errors))
    with pytest.raises(InputError, match="80 spp, got 64"):
        chd.compare(chd.Samples.from_array(x, counts=counts), ["mean"], n=40)


def test_max_batches_limits_estimates_alone():
    few, whole = (chd.compare(image(), ["mean"], max_batches=k) for k in (1, None))
    assert few.batches == 320
    assert whole.batches == 5 * 320
    assert (few.reference == whole.reference).all()


def test_an_all_null_image_has_no_error_and_no_ratio():
    black = chd.Samples.from_array(np.zeros((6, 6, 3, 64)))
    model = MLP.preset("elek2019").train(black, iterations=5)
    found = chd.compare(black, THREE, model=model)
    for row in found.table():
        assert row["mse"] == row["relmse"] == row["improved"] == 0
        assert np.isnan([row["mse_ratio"], row["relmse_ratio"], row["bias"]]).all()
    json.dumps(found.to_dict(), allow_nan=False)
    one = chd.compare(chd.Samples.from_array(np.ones((3, 3, 64))), ["mean"])
    assert one.channels == ("channel0",)
    assert one.measures["mse"].value.shape == (1, 2)


def test_a_model_that_nobody_asked_for_is_refused(model):
    with pytest.raises(InputError, match="not among"):
        chd.compare(image(), ["mean"], model=model)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_what_cannot_judge_is_refused():
    samples = image(height=4, width=4)
    pixels = np.stack(np.indices((4, 4)), axis=-1).reshape(-1, 2)
    model = MLP.preset("elek2019").train(samples, pixels=pixels, iterations=5)
    with pytest.raises(InputError, match="none is left"):
        chd.compare(samples, ["elek2019"], model=model)
    with pytest.raises(InputError, match="every sample"):
        chd.compare(chd.Samples.from_array(np.full((2, 2, 3, 64), np.nan)), ["mean"])
    x = np.ones((2, 2, 3, 64))
    x[..., ::32] = np.inf
    with pytest.raises(InputError, match="every batch"):
        chd.compare(chd.Samples.from_array(x), ["mean"])


# --- what is measured ---------------------------------------------------------------------------


def errors(p, mean, y, scene_mean=1.0, *, error=0.0):
    p, mean, y = (np.array(a, float)[:, np.newaxis] for a in (p, mean, y))
    parts = np.broadcast_to(y[:, np.newaxis], (4, len(y), 1, 1))
    reference = Judge.of_image(parts, np.full(parts.shape[1:], error), np.array([scene_mean]))
    found = errors_of(p, mean, reference[:, 0], scene_mean=np.array([scene_mean]))
    return dict(zip(SUMS, found[..., 0].T, strict=True))


def test_a_firefly_is_two_stops_too_bright():
    # Around y = 1 in a scene of mean 1, the limit is y + 3 sqrt(1 + 0.01) = 4.0150; in a black
    # pixel it is 3 sqrt(0.01) = 0.3; what is too dark is none.
    found = errors([4.01, 4.02, 0.29, 0.31, 0.0], [0] * 5, [1, 1, 0, 0, 100])
    assert found["firefly"].tolist() == [0, 1, 0, 1, 0]
    # A brightness that the reference may have is none either.
    assert not errors([4.02], [0], [1], error=0.1)["firefly"].any()
    for scale in (1e-30, 1e30):
        p = np.array([4.01, 4.02]) * scale
        assert errors(p, [0, 0], [scale, scale], scale)["firefly"].tolist() == [0, 1]


def test_rounding_is_no_improvement():
    # 1 + 1e-7 is closer to 2 than 1 is, by rounding alone; 1 + 1e-4 means it.
    found = errors([1 + 1e-7, 1 + 1e-4, 1 - 1e-4, 0.0], [1, 1, 1, 0], [2, 2, 2, 0])
    assert found["unchanged"].tolist() == [1, 0, 0, 1]
    assert found["improved"].tolist() == [0, 1, 0, 0]
    # What is as near as the mean, as far as the reference tells, is not decided.
    found = errors([3, 3, 3], [1, 1, 1], [1.9, 2.5, 2.1], error=0.1)
    assert found["improved"].tolist() == [0, 1, 0]
    assert found["undecided"].tolist() == [1, 0, 1]
    # What is no number improves nothing.
    found = errors([np.nan, np.inf], [1, 1], [2, 2])
    assert not (found["improved"] + found["unchanged"] + found["firefly"]).any()
    assert np.isnan(found["squared"]).all()


def test_own_estimators_spoil_no_other():
    backwards = own("backwards", lambda x: x[..., ::-1].mean(axis=-1))
    brighter = own("brighter", lambda x: 1.001 * x.mean(axis=-1))
    fails = own("fails", lambda x: np.full(x.shape[:-1], np.inf))
    same, bright, none, mean = chd.compare(image(), [backwards, brighter, fails, "mean"]).table()
    assert (same["unchanged"], same["improved"]) == (1, 0)
    assert bright["unchanged"] == 0
    assert bright["improved_low"] < 0.4 < 0.6 < bright["improved_high"]
    assert np.isnan([none["mse"], none["mse_high"], none["bias"]]).all()
    assert mean["mse_ratio"] == 1
    wrong = own("wrong", lambda x: x[..., 0, 0])
    with pytest.raises(InputError, match=r"wrong .*\(20, 16\)"):
        chd.compare(image(), [wrong])


def test_fireflies_left_are_over_the_mean_s():
    x = np.ones((8, 8, 1, 1024), np.float32)
    x[:, :4, 0, 0] = 1000  # half of the pixels have one in the first of 32 batches
    found = chd.compare(chd.Samples.from_array(x), ["mean", "median"], max_batches=None)
    mean, median = found.table()
    # In the other batches of these pixels, the reference is too bright, and no estimate is.
    assert mean["fireflies"] == pytest.approx(1 / 2 / 32)
    # Of fewer samples, a firefly may be light that others missed.
    few = chd.compare(chd.Samples.from_array(x[..., :128]), ["mean"]).table()[0]
    assert few["fireflies"] == 0
    assert np.isnan(few["fireflies_left"])
    assert median["fireflies"] == 0
    assert (mean["fireflies_left"], median["fireflies_left"]) == (1, 0)


# --- who takes part -----------------------------------------------------------------------------


def test_rows_are_in_the_order_asked_for():
    found = chd.compare(image(), ["zirr2018", "mean", "zirr2018_pixel"])
    assert found.estimators == ("zirr2018", "mean", "zirr2018_pixel")
    assert found.uses_neighbours.tolist() == [True, False, False]
    assert [row["uses_neighbours"] for row in found.table()] == [True, False, False]
    assert found.to_dataset()["uses_neighbours"].values.tolist() == [True, False, False]
    assert found.notes["use neighbours"] == "Zirr et al. 2018"


# --- how sure it is -----------------------------------------------------------------------------


def test_every_pixel_is_in_one_unit():
    rng = np.random.default_rng(1)
    test = rng.random((40, 50)) < 0.7
    labels = rng.integers(0, 3, size=test.shape)
    blocks = np.arange(40)[:, np.newaxis] // 5 * 8 + np.arange(50) * 8 // 50
    units = Units.of(test, labels)
    assert sorted(zip(units.ys, units.xs, strict=True)) == sorted(map(tuple, np.argwhere(test)))
    assert len({*zip(units.label.tolist(), units.block.tolist(), strict=True)}) == len(units.starts)
    pixels = units.sum(np.ones(test.sum(), int))
    assert (np.repeat(units.label, pixels) == units(labels)).all()
    assert (np.repeat(units.block, pixels) == units(blocks)).all()
    assert pixels.sum() == test.sum()
    few = Units.of(np.ones((3, 4), bool))  # units of their own, in order
    assert (few.ys * 4 + few.xs).tolist() == list(range(12))
    assert (few.sum(np.ones(12)) == 1).all()


def test_intervals_know_of_neighbours():
    """The spread over 40 images of other blocks; with pixels for units it would be 3 times as
    large as claimed."""
    rng = np.random.default_rng(3)
    rows = []
    for _ in range(40):
        tailed = np.repeat(np.repeat(rng.random((8, 8)) < 0.5, 4, axis=0), 4, axis=1)
        sigma = np.where(tailed, 1.0, 0.3)[..., np.newaxis, np.newaxis]
        samples = chd.Samples.from_array(rng.lognormal(sigma=sigma, size=(32, 32, 1, 64)))
        rows.append(chd.compare(samples, ["median_of_means"], n=32).table()[0])
    spread = np.std([row["bias"] for row in rows], ddof=1)
    claimed = np.mean([row["bias_se"] for row in rows])
    assert 1 / 1.5 < claimed / spread < 1.5


@pytest.mark.parametrize("units", [2, 6, 64])
def test_intervals_hold_what_they_say_with_few_units(units):
    """Of 150 intervals of 95 % hold 142, and a tenth fewer where gamma samples are but two."""
    rng, held = np.random.default_rng(units), 0
    for _ in range(150):
        sums = np.zeros((units, len(SUMS), 2, 1))
        sums[:, SUMS.index("squared"), 1] = rng.gamma(4, size=(units, 1))
        sums[:, SUMS.index("reference")] = sums[:, SUMS.index("count")] = 1
        with np.errstate(divide="ignore", invalid="ignore"):
            found = measures_of(sums, seed=0)["mse"]
        held += found.low[0, 0] <= 4 <= found.high[0, 0]
    assert 127 < held < 150


def test_no_interval_goes_beyond_what_a_measure_can_be():
    sums = np.zeros((3, len(SUMS), 2, 1))
    sums[:, -2:] = 1  # reference and count
    sums[:, :7, 0], sums[0, :7, 1] = 1, [[9], [9], [9], [1], [0], [1], [1]]
    for name, found in measures_of(sums, seed=0).items():
        if name != "bias":
            assert not (found.low < 0).any()
        if name in {"improved", "unchanged", "fireflies"}:
            assert not (found.high > 1).any()


class Half:
    """A model whose estimate is half of the mean."""

    def __init__(self, pixels, shape):
        self.name, self.train_pixels, self.train_shape = "half", pixels, shape

    def predict(self, x):
        return np.asarray(x).mean(axis=-1) / 2


def test_models_come_by_name(monkeypatch):
    entry = registry.LearnedEstimator(
        "half", lambda *_, **__: 1 / 0, "this test", inputs=None, pixels=20
    )
    monkeypatch.setitem(registry.ENTRIES, "half", entry)
    model = Half(np.array([[0, 0]]), (20, 16))
    found = chd.compare(image(), ["half"], n=16, model={"half": model})
    assert found.models == {"half": model}
    assert found.reusable_models == {}
    with pytest.raises(InputError, match="'elek2019'"):
        chd.compare(image(), ["half"], n=16, model={"elek2019": model})


# --- memory -------------------------------------------------------------------------------------


def test_memory_grows_with_nothing():
    samples = image(height=64, width=64, spp=256)

    def peak(names, batches):
        tracemalloc.start()
        try:
            chd.compare(samples, names, n=16, max_batches=batches)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    few = peak(["mean", "median"], 2)
    assert peak(["mean", "median"], 16) < 1.1 * few
    # Each more takes its image, its error, and its sums over units: not those of every batch.
    each = 64 * 64 * 3 * (4 + 4 + 3 * 6 * 8)
    assert peak(["mean", "median", "huber", "trimmed_mean"], 16) < few + 2 * each + 2**23


# --- by label -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def labelled():
    codes = np.full((20, 16), int(Label.OTHER))
    codes[:5], codes[5:8, :4] = Label.LONG_TAIL, Label.NULL_HEAVY
    return codes


def test_measures_by_label_add_up_to_those_of_all(model, labelled):
    found = chd.compare(image(), THREE, model=model, labels=labelled)
    parts = found.breakdown
    assert parts.labels == ("long_tail", "null_heavy", "other")
    assert parts.pixels.sum() == found.test_pixels.sum() == 160
    plain = chd.compare(image(), THREE, model=model)
    assert plain.breakdown is None
    assert plain.to_dict()["per_label"] == []
    for measure, interval in plain.measures.items():
        for end in ("value", "low"):
            expected = getattr(found.measures[measure], end)
            assert getattr(interval, end) == pytest.approx(expected, nan_ok=True)
    for measure in ("mse", "relmse", "unchanged", "fireflies"):
        whole = (parts.pixels[:, None] * parts.measures[measure].value).sum(axis=0) / 160
        assert whole == pytest.approx(found.measures[measure].value[:, -1])


def test_one_label_is_a_comparison_of_its_pixels(labelled):
    found = chd.compare(image(), ["mean", "median_of_means"], labels=labelled)
    pixels = image().read()[:5].reshape(-1, 3, 160)
    expected = expected_measures(pixels, 32, chd.estimators.median_of_means)["mse"].mean()
    assert found.breakdown.measures["mse"].value[0, 1] == pytest.approx(expected, rel=1e-4)
    row = found.breakdown.table()[1]
    assert (row["label"], row["estimator"], row["pixels"]) == ("long_tail", "median_of_means", 80)
    assert row["mse_low"] < row["mse"] < row["mse_high"]


def test_the_best_of_a_label_has_the_smallest_error(labelled):
    # The truth is best, be it of neighbours or not; the mean is best where nothing else is.
    truth = image().read().mean(axis=-1)
    oracle = own("oracle", lambda _: truth, uses_neighbours=True)
    found = chd.compare(image(), ["mean", "median", oracle], labels=labelled)
    assert found.breakdown.best() == ("mean",) * 3
    assert found.breakdown.best("mse", neighbours=True) == ("oracle",) * 3
    with pytest.raises(InputError, match="mse, relmse, got 'bias'"):
        found.breakdown.best("bias")


def test_labels_come_in_four_ways():
    samples = image(height=6, width=5, spp=128)
    classified = chd.classify(samples)
    ways = [classified, classified["label"], classified["label"].values, "classify"]
    rows = [chd.compare(samples, ["mean"], labels=labels).to_dict()["per_label"] for labels in ways]
    assert rows[0]
    assert all(row == rows[0] for row in rows)


def test_a_map_of_other_codes_brings_its_names():
    attrs = {"flag_values": [0, 7], "flag_meanings": "wall lamp"}
    where = xr.DataArray(np.where(np.eye(6, 6, dtype=bool), 7, 0), dims=("y", "x"), attrs=attrs)
    found = chd.compare(image(height=6, width=6), ["mean"], labels=where)
    assert found.breakdown.labels == ("wall", "lamp")
    assert found.breakdown.pixels.tolist() == [30, 6]


# --- pixels one by one --------------------------------------------------------------------------


def test_pixels_are_drawn_from_those_that_judge(found, model):
    drawn = found.draw_pixels(25, seed=2)
    ys, xs = drawn.pixels.T
    assert found.test_pixels[ys, xs].all()
    assert len(set(zip(ys, xs, strict=True))) == 25
    assert (np.diff(drawn.reference.sum(axis=-1)) >= 0).all()
    x = image().read()[ys, xs]
    assert drawn.mean == pytest.approx(x[..., :32].mean(axis=-1), rel=1e-5)
    assert drawn.reference == pytest.approx(x[..., 32:].mean(axis=-1), rel=1e-4)
    assert drawn.estimates[2] == pytest.approx(model.predict(x[..., :32]), rel=1e-4, abs=1e-5)
    assert (drawn.pixels == found.draw_pixels(25, seed=2).pixels).all()
    assert (drawn.pixels != found.draw_pixels(25, seed=3).pixels).any()


def test_no_more_pixels_are_drawn_than_have_a_reference():
    x = np.ones((2, 3, 1, 64), np.float32)
    x[0, 0, 0, 3] = np.nan
    found = chd.compare(chd.Samples.from_array(x), ["mean"])
    assert len(found.draw_pixels().pixels) == 5
    with pytest.raises(InputError, match="got 0"):
        found.draw_pixels(0)


def test_data_frames_rank_what_one_reads(found, labelled):
    pair = ["mean", "median_of_means"]
    parts = chd.compare(image(), pair, labels=labelled).breakdown
    curve = chd.comparison.error_curve(image(), pair, sizes=[4, 16])
    for result, lead in ((found, ""), (parts, "label"), (curve, "n")):
        frame, rows = result.to_dataframe(), result.table()
        assert len(frame) == len(rows)
        assert len(frame.columns) <= 15
        known = {(row.get(lead), row["estimator"]): row for row in rows}
        for row in frame.to_dict("records"):
            whole = known[row.get(lead), row["name"]]
            assert row["estimator"] == title_of(row["name"])
            for name in row.keys() - {"estimator", "name"}:
                np.testing.assert_equal(row[name], whole[name])
        for _, part in frame.groupby(lead or (lambda _: 0)):
            assert part["relmse_ratio"].is_monotonic_increasing


def test_a_file_has_every_measure(found, tmp_path):
    table = pd.read_csv(found.save(tmp_path / "a.csv"))
    assert [*table.columns] == [*found.table()[0]]
    assert [*table["estimator"]] == [*found.estimators]


def test_latex_has_a_line_for_each_estimator(found):
    begin, top, head, middle, *rows, bottom, end = found.to_latex().splitlines()
    assert (begin, end) == (r"\begin{tabular}{lrrrrr}", r"\end{tabular}")
    assert (top, middle, bottom) == (r"\toprule", r"\midrule", r"\bottomrule")
    assert len(rows) == len(THREE)
    columns = head.count(" & ")
    for row in rows:
        assert row.endswith(r" \\")
        assert row.count(" & ") == columns
        assert not re.search(r"(?<!\\)[%_#]", row)
    assert rows[0].startswith("sample mean & 1.00 & ")


def test_an_error_that_is_rounding_divides_nothing():
    """Of equal samples, the mean is exact but for rounding: nothing is better or worse."""
    x = image(height=6, width=6).read().copy()
    x[:3] = np.random.default_rng(0).uniform(0.1, 0.9, size=(3, 6, 3, 1))
    labels = np.where(np.arange(6) < 3, Label.CONSTANT, Label.LONG_TAIL)[:, None] + np.zeros(6, int)
    brighter = own("brighter", lambda x: 1.001 * x.mean(axis=-1))
    found = chd.compare(chd.Samples.from_array(x), [brighter], labels=labels).breakdown
    rows = {row["label"]: row for row in found.table()}
    assert 0 < rows["constant"]["relmse"] < 1e-5
    assert np.isnan([rows["constant"][name] for name in ("mse_ratio", "relmse_ratio")]).all()
    assert rows["long_tail"]["mse_ratio"] == pytest.approx(1, abs=0.1)


# --- error curves ---------------------------------------------------------------------------------


def falling_image(spp=160):
    rng = np.random.default_rng(0)
    brightness = rng.lognormal(0, 1, size=(16, 12, 1, 1)) * np.array([1, 0.8, 0.5])[:, None]
    return chd.Samples.from_array(brightness * rng.gamma(0.7, size=(16, 12, 3, spp)))


@pytest.fixture(scope="module")
def quick_model():
    return MLP.preset("elek2019").train(falling_image(), iterations=20)


@pytest.fixture(scope="module")
def curve():
    rng = np.random.default_rng(7)
    samples = chd.Samples.from_array(rng.exponential(size=(40, 40, 1, 256)))
    return error_curve(samples, ["mean", "median", "median_of_means"])


def test_default_sizes_suit_each_estimator():
    names = ["mean", "median_of_means", "elek2019"]
    assert curve_sizes(falling_image(spp=64), names) == (4, 8, 11, 32)
    assert curve_sizes(falling_image(spp=1024), names) == (4, 8, 16, 32, 64, 128)
    with pytest.raises(InputError, match=r"32 samples.*\(4, 11"):
        curve_sizes(falling_image(spp=48), names)


def test_sizes_double_up_to_an_eighth_of_the_samples(curve):
    assert curve.sizes == (4, 8, 16, 32)
    assert curve.batches.tolist() == [1600 * 16, 1600 * 16, 1600 * 16, 1600 * 8]


def test_the_error_of_the_mean_falls_as_theory_says(curve):
    """E = sigma^2 / N, without the noise of the reference: 4 sizes, within 5 standard errors, fails
    by 2e-6; with that noise, the largest N is off by 11 of these."""
    n = np.array(curve.sizes)
    mse = curve.measures["mse"][:, 0]
    assert (np.abs(mse.value - 1 / n) < 5 * mse.standard_error).all()


def test_the_bias_of_the_median_does_not_fall(curve):
    # The median of an exponential distribution is log 2.
    assert curve.measures["bias"].value[-1, 1] == pytest.approx(np.log(2) - 1, abs=0.02)
    ratio = curve.measures["mse_ratio"].value[:, 1]
    assert (np.diff(ratio) > 0).all()
    # median_of_means takes 11: where there are fewer, there is no number.
    assert np.isfinite(curve.measures["mse"].value[:, 2]).tolist() == [False, False, True, True]
    assert len(curve.table()) == 10


def test_a_point_of_the_curve_is_a_comparison():
    samples = falling_image(spp=128)
    names = ["mean", "zirr2018", "trimmed_mean"]
    curve = error_curve(samples, names, sizes=[32, 8])
    assert curve.estimators == tuple(names)
    for row, n in enumerate((8, 32)):
        alone = chd.compare(samples, names, n=n)
        for measure, interval in alone.measures.items():
            whole = curve.measures[measure]
            assert whole.value[row] == pytest.approx(interval.value[:, -1], nan_ok=True)
            assert whole.low[row] == pytest.approx(interval.low[:, -1], nan_ok=True)


def test_what_learns_is_measured_at_its_own_size(quick_model):
    curve = error_curve(falling_image(), ["mean", "elek2019"], sizes=[16, 32], model=quick_model)
    assert np.isfinite(curve.measures["relmse"].value).tolist() == [[True, False], [True, True]]
    assert curve.test_pixels == 96
    assert curve.batches.tolist() == [96 * 10, 96 * 5]


def test_the_curve_is_ready_for_json(curve):
    content = json.loads(json.dumps(curve.to_dict(), allow_nan=False))
    assert content["table"][0]["n"] == 4


def test_places_on_the_film_reach_those_who_look_at_them():
    scene = {"scene": "cornell-box", "size": (8, 8), "spp": 64, "backend": "scalar"}
    samples = chd.render(**scene, film=True, progress=False)
    places, told = samples.film.read(), []

    def looking(x, film=None):
        told.append(film)
        return np.asarray(x).mean(axis=-1)

    looks = [own("looking", looking, uses_film=True), own("blind", lambda x: x[..., 0])]
    chd.compare(samples, looks, n=16, progress=False)
    chd.compare(chd.render(**scene, progress=False), looks, n=32, progress=False)
    chd.bench(samples, looks, spp=[32], progress=False)
    for k, film in enumerate(told[:4]):
        assert np.array_equal(film, places[..., 16 * k : 16 * k + 16])
    assert told[4:6] == [None, None]
    assert np.array_equal(told[-1], places[..., :32])
    estimate_by(looks[0], samples.read()[..., :32], film=samples.film)
    assert told[-1] is None  # places of other samples, as after an interrupted render
