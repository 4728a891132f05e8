"""Default estimators: one list, wherever estimators are judged, and the default estimate first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import DEFAULT_ESTIMATORS
from chdstat.comparison.estimator_choice import DEFAULT_ESTIMATE, choose, entry_of
from chdstat.errors import InputError
from chdstat.estimators import lookup, registry
from chdstat.explorer.batch_estimates import (
    batches_of,
    estimates,
    estimates_around,
    estimates_of_model,
)
from chdstat.explorer.image_sources import StoreSource
from chdstat.explorer.tables import estimates_table
from chdstat.viz.styling import called, estimator_name

N = 32


@pytest.fixture(autouse=True)
def quick_training(monkeypatch):
    """Train the network of the paper for a moment."""
    entry = lookup("elek2019")

    def train(samples, *, iterations=None, **options):
        return entry.train(samples, iterations=5, **options)

    monkeypatch.setitem(registry.ENTRIES, "elek2019", replace(entry, train=train))


def by_compare(samples):
    return chd.compare(samples, progress=False).estimators


def by_curve(samples):
    return chd.comparison.error_curve(samples, sizes=[N], progress=False).estimators


def by_bench(samples):
    truth = samples.read().mean(axis=-1)
    scenes, references = {"box": samples}, {"box": truth}
    found = chd.bench(scenes, spp=[N], references=references, progress=False)
    assert found.baseline == "mean"
    assert found.left_out == {"elek2019": "trains on each scene, against a reference"}
    return (*found.estimators, *found.left_out)


def by_explorer(samples):
    place = 8, 8
    batches, source = batches_of(samples[place], N), StoreSource(samples)
    model = lookup("elek2019").train(samples, progress=False)
    found = [*estimates_of_model(model.name, model, batches), *estimates(batches)]
    found += estimates_around(source, place, N)
    rows = estimates_table(found, samples.channels, N)["rows"]
    shown = {estimator_name(name): name for name in DEFAULT_ESTIMATORS}
    names = [row[0].partition(", ")[0] for row in rows]  # "Elek et al. 2019, 93 % certain"
    return [shown.get(name, name) for name in names][: len(DEFAULT_ESTIMATORS)]


@pytest.mark.parametrize("shown", [by_compare, by_curve, by_bench, by_explorer])
def test_one_list_is_judged_everywhere(shown, cornell):
    found = [called(name) for name in shown(cornell)]
    assert found == [called(name) for name in DEFAULT_ESTIMATORS]
    assert DEFAULT_ESTIMATORS[:2] == (DEFAULT_ESTIMATE, "mean")


def test_the_default_estimate_gets_batch_and_features(cornell):
    found = chd.compare(cornell, ["mean", "combination"], max_batches=1, progress=False)
    x = cornell.read(ss=slice(N))
    direct = chd.estimators.combination(x, features=cornell.features)
    np.testing.assert_array_equal(found.estimates[1], direct)
    mse, mean = (
        found.first_reference.squared(p).mean(axis=(0, 1)) for p in (direct, x.mean(axis=-1))
    )
    assert found.measures["mse"].value[1, :3] == pytest.approx(mse, rel=1e-5)
    # Its errors are over those of the mean of the same batches, in the same pixels.
    assert found.measures["mse_ratio"].value[1, :3] == pytest.approx(mse / mean, rel=1e-4)
    # A benchmark gives it the same.
    options = {"spp": [N], "references": {"box": np.ones(cornell.shape[:3])}, "progress": False}
    row = chd.bench({"box": cornell}, ["mean", "combination"], **options).table()[1]
    assert row["mse"] == pytest.approx(np.square(direct - 1.0).mean(), rel=1e-5)


def test_the_table_says_what_the_default_estimate_is(cornell):
    found = chd.compare(cornell, ["combination", "mean"], max_batches=1, progress=False)
    about = lookup(DEFAULT_ESTIMATE).about
    assert found.notes["default estimate"].lower() == f"combination: {about}".lower()
    assert found.notes["use neighbours"] == "combination"
    assert about[1:].split()[2] in repr(found)


def test_what_does_not_apply_is_left_out():
    rng = np.random.default_rng(0)
    two = chd.Samples.from_array(rng.exponential(size=(6, 6, 2, 40)))
    found = chd.compare(two, n=8, progress=False)
    assert found.estimators == ("mean",)
    assert list(found.provenance["left_out"]) == [
        "combination",
        "mean + OIDN",
        "median_of_means",
        "elek2019",
    ]
    assert "exactly 32 samples, got n=8" in found.notes["left out"]
    assert "median of means takes at least 11 samples" in found.notes["left out"]
    # Whoever names them is told so.
    with pytest.raises(InputError, match="channels"):
        chd.compare(two, ["combination"], n=8)


def test_an_untrainable_network_is_left_out(monkeypatch, cornell):
    def refuse(samples, **options):
        raise InputError("the image is too small")

    monkeypatch.setitem(registry.ENTRIES, "elek2019", replace(lookup("elek2019"), train=refuse))
    found = chd.compare(cornell, max_batches=1, progress=False)
    assert found.estimators == DEFAULT_ESTIMATORS[:-1]
    assert found.provenance["left_out"] == {"elek2019": "the image is too small"}
    with pytest.raises(InputError, match="too small"):
        chd.compare(cornell, ["elek2019"], progress=False)


def test_a_name_may_ask_for_a_denoiser():
    for name in ("mean + OIDN", "median + OIDN features"):
        assert entry_of(name).name == name
    without = chd.Samples.from_array(np.ones((8, 8, 3, 64)))
    assert "mean + OIDN" in choose(None, [N], samples=without).entries
