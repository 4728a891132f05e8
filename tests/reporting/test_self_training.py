"""An estimate without a reference in the report: judged by the other samples, or left out."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison.side_by_side import SelfTraining, coverage, train_alone
from chdstat.estimators import Progressive
from chdstat.estimators.progressive import Estimates
from chdstat.reporting import figures, result_tables


def samples(spp=128, side=12):
    rng = np.random.default_rng(3)
    brightness = rng.lognormal(size=(side, side, 1, 1))
    x = brightness * rng.gamma(0.5, size=(side, side, 3, spp))
    return chd.Samples.from_array(x.astype(np.float32))


def compared(given):
    model = Progressive().train(given, iterations=10, sizes=(8,), progress=False)
    return chd.compare(
        given, ("mean", "progressive"), n=8, max_batches=2, model=model, progress=False
    )


@pytest.fixture(scope="module")
def found():
    return compared(samples())


@pytest.fixture(scope="module")
def trained(found):
    alone = train_alone(samples(), iterations=5, progress=False)
    return SelfTraining.of(samples(), found, alone, progress=False)


def test_all_pixels_judge_the_same_samples(trained):
    assert trained.comparison.n == 64
    assert trained.comparison.test_pixels.all()
    assert trained.comparison.estimators == ("mean", "self_trained")
    assert trained.iterations == 5


def test_coverage_counts_the_pixels_that_judge(found):
    reference = found.first_reference.astype(np.float32)

    half = np.where(found.test_pixels[..., np.newaxis], 0.0, np.nan)
    estimates = [
        Estimates(reference, reference[..., 0], low, reference + 2, 0.9)
        for low in (reference + 1, reference - half)
    ]
    assert coverage(estimates, found) == (0.0, 1.0)


def test_words_and_a_figure_come_of_it(trained, found):
    told = result_tables.self_training_content(trained)
    assert told["n"] == 64
    assert told["mse_ratio"] != "—"
    figure = figures.self_training(trained)
    figure.draw_without_rendering()
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles[:3] == ["Mean of 64 samples", "Self-trained", "Reference"]
    assert titles[3:] == [
        "Certainty",
        "Width of the interval ÷ estimate",
        "Intervals that contain the reference",
    ]


def test_few_samples_are_not_split_further():
    assert train_alone(samples(spp=64, side=8), iterations=5, progress=False) is None
