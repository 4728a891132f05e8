"""Trials of our estimator: judged by others' samples, left out where there is nothing to judge."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import Progressive
from chdstat.estimators.progressive import Estimates
from chdstat.reporting.findings import _trials
from chdstat.reporting.trial_pages import trial_content, trial_figures
from chdstat.reporting.trials import BALANCES, LEVELS, Trials, _coverage


def noise(spp=128, channels=3, side=12):
    rng = np.random.default_rng(3)
    brightness = rng.lognormal(size=(side, side, 1, 1))
    x = brightness * rng.gamma(0.5, size=(side, side, channels, spp))
    return chd.Samples.from_array(x.astype(np.float32))


def trials_of(samples):
    model = Progressive().train(samples, iterations=10, sizes=(8,), progress=False)
    names = ("mean", "progressive")
    found = chd.compare(samples, names, n=8, max_batches=2, model=model, cost=False, progress=False)
    return Trials.of(samples, found, iterations=5, progress=False), found


@pytest.fixture(scope="module")
def tried():
    return trials_of(noise())


def test_the_knob_is_judged_on_pixels_that_trained_nothing(tried):
    trials, found = tried
    assert np.array_equal(trials.knob.test_pixels, found.test_pixels)
    assert trials.along("mse_ratio").value.shape == (len(BALANCES),)
    assert trials.iterations == 10


def test_the_middle_of_the_knob_is_what_is_compared(tried):
    trials, _ = tried
    place = trials.knob.estimators.index("progressive")
    middle = trials.along("mse").value[BALANCES.index(0.5)]
    assert trials.knob.measures["mse"].value[place, -1] == pytest.approx(middle)


def test_the_limit_for_relative_errors_is_the_darker_one(tried):
    """Weights that fall with radiance lower a mean (Chebyshev's inequality), in every pixel."""
    knob = tried[0].knob
    square, relative = (
        knob.estimates[knob.estimators.index(f"limit_{e}")] for e in ("mse", "relmse")
    )
    assert (relative <= square * (1 + 1e-5)).all()
    assert (relative < square).mean() > 0.5


def test_without_a_reference_all_pixels_judge_the_same_samples(tried):
    alone = tried[0].alone
    assert alone.comparison.n == 64
    assert alone.comparison.test_pixels.all()
    assert alone.comparison.estimators[:2] == ("mean", "self_trained")
    denoised = importlib.util.find_spec("pyoidn") is not None
    assert ("oidn" in alone.comparison.estimators) == denoised
    assert alone.iterations == 5


def test_coverage_counts_the_pixels_that_judge(tried):
    _, found = tried
    reference = found.first_reference.astype(np.float32)

    def estimate(level):
        half = np.where(found.test_pixels[..., np.newaxis], 0.0, np.nan)
        low = np.where(level > 0.85, reference - half, reference + 1)
        return Estimates(reference, reference[..., 0], low, reference + 2, level)

    counted = _coverage(estimate, found)
    assert counted.measured == (0.0, 0.0, 1.0, 1.0)
    assert counted.at_90 == 1.0
    assert counted.estimates.level == 0.9
    assert len(counted.measured) == len(LEVELS)


def test_words_and_figures_come_of_them(tried):
    trials, found = tried
    content = trial_content(trials)
    assert content["limit_mse"] != "—"
    assert content["alone"]["n"] == 64
    assert set(trial_figures(trials, found)) == {"knob", "confidence", "alone"}
    questions = [row.question for row in _trials(trials)]
    assert any("64 samples without a reference" in question for question in questions)
    assert any("how sure" in question for question in questions)


def test_two_channels_have_no_limit_and_no_denoiser():
    trials, _ = trials_of(noise(channels=2, side=8))
    assert np.isnan(trials.limit("mse"))
    assert trials.alone.comparison.estimators == ("mean", "self_trained")
    assert trial_content(trials)["limit_mse"] == "—"
    assert len(list(_trials(trials))) == 2


def test_few_samples_are_not_split_further():
    assert trials_of(noise(spp=64, side=8))[0].alone is None


def test_nothing_is_asked_of_those_who_did_not_take_part():
    samples = noise(spp=32)
    found = chd.compare(samples, ["mean"], n=8, cost=False, progress=False)
    assert Trials.of(samples, found, iterations=5, progress=False) is None
