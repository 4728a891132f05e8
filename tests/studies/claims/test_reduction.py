"""Reduction to the mean: known answers of estimators that keep it, and of some that do not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import MLP
from chdstat.studies.claims import CLAIMS, SceneData
from chdstat.studies.claims.learned_models import LEVELS, ROUNDING

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
    ((radiance, _),) = found.plot_data.series.values()
    np.testing.assert_allclose(10**radiance, LEVELS)
    # Of two times the mean less the first sample, reversing moves the last in its place.
    found = ask({"elek2019": lambda x: 2 * mean(x) - x[..., 0]})
    assert found.tests[0].verdict == "supported"
    assert found.tests[1].verdict == "not supported"


def test_the_verdict_is_of_the_paper_s_model(ask):
    found = ask({"elek2019": first_weighs_more, "mine": mean})
    assert (found.verdict, found.other_models["mine"].verdict) == (
        "not supported",
        "supported",
    )
    assert found.reason.startswith("For elek2019: ")
    assert set(found.plot_data.series) == {"elek2019", "mine"}
    alone = ask({"mine": mean})
    assert alone.verdict == "cannot tell"
    assert "needs the paper's model" in alone.reason.lower()
    assert alone.other_models["mine"].verdict == "supported"


def test_without_good_samples_nothing_is_told(ask, samples):
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


def test_the_papers_network_does_not_reduce_to_the_mean(samples, comparison):
    model = MLP.preset("elek2019").train(samples, iterations=200, progress=False)
    found = replace(comparison, estimators=("mean", "elek2019"), models={"elek2019": model})
    found = CLAIM.find(SceneData("noise", samples, comparison=found))
    assert found.verdict == "not supported"
    assert [test.verdict for test in found.tests] == ["not supported"] * 3


def test_the_control_moves_and_the_tolerance_is_tight():
    """A network that reads the order is not within the tolerance by chance."""
    assert ROUNDING < 1e-3
    model = MLP.preset("elek2019")
    model.train(chd.Samples.from_array(pixels(n=128)), iterations=200, progress=False)
    x = pixels(3)
    assert np.abs(model.predict(x[..., ::-1]) - model.predict(x)).max() > 1e-2
