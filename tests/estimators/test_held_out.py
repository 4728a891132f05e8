"""Held-out protocol: references know nothing of their batch, and bad batches have none."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators.held_out import (
    Totals,
    batches,
    check_spp,
    draw_pixels,
    judging_pixels,
    training_batches,
)


@pytest.fixture
def samples():
    rng = np.random.default_rng(0)
    return chd.Samples.from_array(rng.gamma(0.7, size=(6, 5, 3, 75)))


def test_the_reference_is_the_mean_of_all_other_samples(samples):
    totals, x = Totals.of(samples), samples.read()
    assert totals.mean() == pytest.approx(x.mean(axis=-1), rel=1e-6)
    for k, batch in enumerate(batches(samples, 10)):
        others = np.delete(x, np.s_[10 * k : 10 * k + 10], axis=-1)
        assert totals.mean_without(batch) == pytest.approx(others.mean(axis=-1), rel=1e-6)
    assert k == 6


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_sample_leaves_no_reference(samples, bad):
    x = samples.read().copy()
    x[2, 3, 1, 15] = bad
    spoilt = chd.Samples.from_array(x)
    totals = Totals.of(spoilt)
    assert totals.count[2, 3] == 74
    first, second = list(batches(spoilt, 10))[:2]
    assert np.isnan(totals.mean_without(second)[2, 3]).all()
    others = np.delete(x[2, 3], [*range(10), 15], axis=-1).mean(axis=-1)
    assert totals.mean_without(first)[2, 3] == pytest.approx(others, rel=1e-6)
    assert np.isfinite(totals.mean_without(second)).sum() == 6 * 5 * 3 - 3


def test_training_batches_are_those_of_the_pixels_named(samples):
    x = samples.read()
    found, references = training_batches(samples, np.array([[0, 0], [5, 4]]), 25)
    assert found.shape == (6, 3, 25)
    assert references.shape == (6, 3)
    assert (found[1] == x[5, 4, :, :25]).all()
    assert references[1] == pytest.approx(x[5, 4, :, 25:].mean(axis=-1), rel=1e-6)


def test_pixels_are_drawn_once_each_and_leave_half_of_the_image():
    drawn = draw_pixels((9, 7), 6400, seed=0)
    assert len(np.unique(drawn, axis=0)) == len(drawn) == 31
    assert (drawn >= 0).all()
    assert (drawn < (9, 7)).all()
    assert len(draw_pixels((9, 7), 4, seed=0)) == 4
    assert (draw_pixels((9, 7), 31, seed=0) == drawn).all()
    assert (draw_pixels((9, 7), 31, seed=1) != drawn).any()


@pytest.mark.parametrize(
    ("side", "trained"), [(64, 2048), (92, 4232), (93, 6400), (113, 6400), (114, 6400), (128, 6400)]
)
def test_training_leaves_a_quarter_to_judge(side, trained):
    drawn = draw_pixels((side, side), 6400, seed=2)
    judging = judging_pixels((side, side), seed=2)
    assert len(drawn) == trained
    assert not judging[tuple(drawn.T)].any()
    assert judging.sum() == max(side * side - max(trained, side * side // 2), 0)
    more = draw_pixels((side, side), 8192, seed=2)
    assert not judging[tuple(more.T)].any()
    assert set(map(tuple, drawn.tolist())) <= set(map(tuple, more.tolist()))


def test_too_few_samples_are_refused_with_what_is_needed(samples):
    check_spp(samples, 37)
    with pytest.raises(InputError, match="76 spp, got 75"):
        check_spp(samples, 38)
