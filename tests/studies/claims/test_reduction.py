"""Reduction to the mean: known answers of estimators that keep it, and of some that do not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import MLP, LearnedEstimator, Progressive, lookup, mean_radiance, names
from chdstat.estimators.progressive import errors, learning
from chdstat.studies.claims import CLAIMS, SceneData
from chdstat.studies.claims.learned_models import FACTORS, LEVELS, ROUNDING

CLAIM = CLAIMS[15]
N, EDGE = 32, 16


def pixels(seed=0, n=N, edge=EDGE):
    """Return an image of null-heavy exponential samples, brighter from row to row."""
    rng = np.random.default_rng(seed)
    light = np.geomspace(0.05, 20, edge)[:, None, None, None] * np.array([[1.0], [0.6], [0.3]])
    x = light * rng.exponential(size=(edge, edge, 1, n)) * (rng.random((edge, edge, 1, n)) < 0.6)
    return x.astype(np.float32)


def features(edge=EDGE):
    rng = np.random.default_rng(5)
    vectors = {name: rng.random((edge, edge, 3)) for name in ("albedo", "normal", "position")}
    found = vectors | {"depth": rng.uniform(1, 2, (edge, edge))}
    return {name: image.astype(np.float32) for name, image in found.items()}


@pytest.fixture(scope="module")
def samples():
    x = pixels(n=128)
    return chd.Samples.from_array(x, features=features())


@pytest.fixture(scope="module")
def comparison(samples):
    return chd.compare(samples, ["mean", "median_of_means"], n=N, progress=False)


@pytest.fixture(scope="module")
def ask(samples, comparison):
    """Return what asks functions of samples (y, x, channel, sample), as models by name."""

    def asked(functions, using=samples):
        models = {
            name: SimpleNamespace(predict=lambda x, *, call=function, **_: call(x))
            for name, function in functions.items()
        }
        found = replace(comparison, estimators=("mean", *models), models=models)
        return CLAIM.find(SceneData("noise", using, comparison=found))

    return asked


def mean(x):
    return x.mean(axis=-1, dtype=np.float64)


def first_weighs_more(x):
    return np.average(x, axis=-1, weights=np.where(np.arange(x.shape[-1]) == 0, 2, 1))


KNOWN = {
    # what it is, whether constants are kept, order and unit do not matter
    "mean": (mean, (True, True, True)),
    "largest": (lambda x: x.max(axis=-1), (True, True, True)),
    "dark": (lambda x: 0.999 * mean(x), (False, True, True)),
    "dark where it is bright": (lambda x: np.minimum(mean(x), 5e3), (False, True, False)),
    "reads the order": (first_weighs_more, (True, False, True)),
    "reads the unit": (lambda x: np.log(np.exp(np.minimum(x, 50)).mean(axis=-1)), (0, 1, 0)),
    "trained in one unit": (lambda x: mean(x) + 0.1, (False, True, False)),
    "lost": (lambda x: mean(x) * np.nan, (False, False, False)),
}


@pytest.mark.parametrize("name", KNOWN)
def test_an_estimator_of_which_the_answer_is_known(ask, name):
    function, expected = KNOWN[name]
    found = ask({"elek2019": function})
    verdicts = [test.verdict == "supported" for test in found.tests]
    assert verdicts == [bool(kept) for kept in expected], found.reason
    assert found.verdict == ("supported" if all(expected) else "not supported")


def test_changes_are_the_ones_that_were_made(ask):
    found = ask({"elek2019": lambda x: 1.25 * mean(x)})
    assert found.tests[0].interval.value == pytest.approx(0.25)
    assert found.details["deviation_by_radiance"].keys() == {f"{level:g}" for level in LEVELS}
    # Of two times the mean less the first sample, reversing moves the last in its place.
    found = ask({"elek2019": lambda x: 2 * mean(x) - x[..., 0]})
    assert 0.5 < found.details["change_over_step_by_order"]["reversed"] < 2
    assert found.tests[0].verdict == "supported"
    assert found.tests[1].verdict == "not supported"


def test_the_verdict_is_of_the_papers_model_and_others_stand_beside_it(ask):
    found = ask({"elek2019": first_weighs_more, "progressive": mean})
    assert (found.verdict, found.other_models["progressive"].verdict) == (
        "not supported",
        "supported",
    )
    assert found.reason.startswith("For elek2019: ")
    assert set(found.plot_data.series) == {"elek2019", "progressive"}
    alone = ask({"progressive": mean})
    assert alone.verdict == "cannot tell"
    assert "needs the paper's model" in alone.reason.lower()
    assert alone.other_models["progressive"].verdict == "supported"


def test_without_a_comparison_or_good_samples_there_is_no_telling(ask, samples):
    assert "comparison" in CLAIM.find(SceneData("noise", samples)).reason
    bad = chd.Samples.from_array(samples.read() * np.nan)
    assert "bad samples" in ask({"elek2019": mean}, using=bad).reason
    both = samples.read() * np.where(np.arange(EDGE) % 2, 1e36, 1e-37)[:, None, None]
    wide = ask({"elek2019": mean}, using=chd.Samples.from_array(both))
    assert "1024" in wide.reason
    assert len(wide.tests) == 2
    # Bad samples in some pixels do not decide.
    x = samples.read().copy()
    x[3, 4, :, 5] = np.nan
    found = ask({"elek2019": lambda x: np.nanmean(x, axis=-1)}, using=chd.Samples.from_array(x))
    assert found.verdict == "supported"


# --- the estimators that are there --------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(samples):
    """Return all learned estimators of the registry, trained a little, and the paper's network."""
    models, by_training = {}, {}
    for name in names("learned"):
        entry = lookup(name)
        if not isinstance(entry, LearnedEstimator):
            continue
        train = entry.train
        if train not in by_training:  # those of the same inputs share one
            options = (
                {"iterations": 200} if name == "elek2019" else {"iterations": 30, "sizes": [N]}
            )
            by_training[train] = train(samples, **options, progress=False)
        models[name] = by_training[train]
    return models


def test_ours_reduces_to_the_mean_and_the_papers_network_does_not(samples, comparison, trained):
    both = replace(comparison, estimators=("mean", *trained), models=trained)
    found = CLAIM.find(SceneData("noise", samples, comparison=both))
    assert found.verdict == "not supported"
    assert [test.verdict for test in found.tests] == ["not supported"] * 3
    assert set(found.other_models) == set(trained) - {"elek2019"}
    for name, ours in found.other_models.items():
        assert ours.verdict == "supported", (name, ours.reason)
        assert ours.tests[0].interval.value == 0
        assert isinstance(trained[name], Progressive)


@pytest.fixture(scope="module", params=[False, True], ids=["samples", "features"])
def model(request, samples):
    """Return each configuration of our estimator, trained a little and followed all the way.

    Whether it pays to follow so short a training is by chance; where it does not, the estimate is
    the mean, of which these laws ask nothing.
    """
    model = Progressive(with_features=request.param)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning, "reference_shares", lambda *_: errors.FULL)
        return model.train(samples, sizes=[N], iterations=30, progress=False)


def test_pixels_of_one_light_are_kept_among_noisy_ones(model):
    x = pixels(3)
    x[::2] = np.geomspace(1e-4, 1e4, EDGE)[:, None, None]
    expected = np.broadcast_to(x[::2, :, :, 0], (EDGE // 2, EDGE, 3))
    for loss_weight in (0.0, 0.5, 1.0):
        found = model.estimate(
            x, features=features(), unit=mean_radiance(x), loss_weight=loss_weight
        )
        np.testing.assert_array_equal(found.radiance[::2], expected)


@pytest.mark.filterwarnings("ignore::chdstat.errors.OtherSceneWarning")
def test_the_weight_beside_the_mean_reads_no_order_and_no_unit(model):
    """It is measured between halves of the samples, which are the same halves in any order.

    The ends of intervals are cubes of what the network says, times quantiles of up to 18 after so
    short a training: rounding grows with them.
    """
    x = pixels(7)
    first = model.estimate(x, features=features())
    ends = ("radiance", "radiance", 1), ("low", "high", 20), ("high", "high", 20)
    for other, factor in ((x[..., ::-1], 1.0), *((x * np.float32(f), f) for f in FACTORS)):
        found = model.estimate(other, features=features())
        for name, size, times in ends:
            change = np.abs(getattr(found, name) - getattr(first, name) * np.float32(factor))
            most = 2e-5 * times * (factor == 1) * np.abs(getattr(first, size))
            assert (change <= most).all(), name


def test_the_control_moves_and_the_tolerance_is_tight():
    """A network that reads the order is not within the tolerance by chance."""
    assert ROUNDING < 1e-3
    model = MLP.preset("elek2019")
    model.train(chd.Samples.from_array(pixels(n=128)), iterations=200, progress=False)
    x = pixels(3)
    assert np.abs(model.predict(x[..., ::-1]) - model.predict(x)).max() > 1e-2
