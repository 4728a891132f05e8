"""Splits: what is learned from and what is learned share no sample, and both are fair."""

import numpy as np
import pytest

from chdstat.estimators.progressive.learning import TrainingSet


def splits():
    rng = np.random.default_rng(0)
    return TrainingSet(samples=rng.exponential(size=(50, 3, 24)).astype(np.float32))


def test_both_parts_together_are_all_samples():
    made = splits()
    rows, drawn = made.draw(np.arange(50), 6, 40, np.random.default_rng(1))
    profile, _, target = made.minibatch(rows, drawn)
    assert rows.shape == (40,)
    assert len(set(drawn.tolist())) == 6
    both = (6 * profile.mean() + 18 * target) / 24
    assert both == pytest.approx(made.mean[rows], rel=1e-5)


def test_uneven_halves_tell_the_variance_of_the_target_without_bias():
    """Three samples are left, in halves of two and one: 40,000 pixels, within five deviations."""
    rng = np.random.default_rng(0)
    x = rng.normal(8, 1, size=(40_000, 1, 7)).astype(np.float32)
    made = TrainingSet(samples=x)
    noise = made.noise(*made.draw(np.arange(40_000), 4, 40_000, rng), rng)
    assert abs(noise.mean() - 1 / 3) < 5 * noise.std() / np.sqrt(noise.size)


def test_mean_and_variance_are_those_of_the_samples():
    x = np.random.default_rng(0).exponential(size=(50, 3, 24)).astype(np.float32)
    assert splits().mean == pytest.approx(x.mean(axis=-1), rel=1e-5)
    assert splits().variance == pytest.approx(x.var(axis=-1, ddof=1), rel=1e-4)
    constant = TrainingSet(samples=np.full((2, 1, 9), 0.1, np.float32))
    assert constant.variance == pytest.approx(0, abs=1e-8)
