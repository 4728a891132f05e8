"""Silverman's test: the critical bandwidth as of SciPy's density, and its p-value."""

import numpy as np
import pytest
from scipy import stats

from chdstat.modes._silverman import count_modes, critical_bandwidth, silverman_p

ROWS, SAMPLES = 6, 300


def rows_of(name):
    rng = np.random.default_rng(61)
    shape = (ROWS, SAMPLES)
    two = rng.normal(size=shape)
    two[:, ::3] += 5
    samples = {
        "normal": rng.normal(size=shape),
        "log gamma": np.log(rng.gamma(0.5, size=shape)),
        "two": two,
    }
    return np.sort(samples[name])


def by_scipy(x, bandwidth):
    grid = np.linspace(x.min() - 0.1, x.max() + 0.1, 3001)
    density = stats.gaussian_kde(x, bw_method=bandwidth / x.std(ddof=1))(grid)
    rises = np.diff(density) > 0
    return np.count_nonzero(rises[:-1] & ~rises[1:])


@pytest.mark.parametrize("modes", [1, 2])
@pytest.mark.parametrize("name", ["normal", "log gamma", "two"])
def test_bandwidth_is_where_scipy_loses_a_mode(name, modes):
    x = rows_of(name)
    found = critical_bandwidth(x, np.full(ROWS, SAMPLES), modes)
    for row, bandwidth in zip(x, found, strict=True):
        assert by_scipy(row, 1.01 * bandwidth) <= modes < by_scipy(row, 0.99 * bandwidth)


def test_modes_are_those_of_scipy():
    x = rows_of("two")
    n = np.full(ROWS, SAMPLES)
    for bandwidth in (0.3, 1.0, 4.0):
        found = count_modes(x, n, np.full(ROWS, bandwidth))
        np.testing.assert_array_equal(found, [by_scipy(row, bandwidth) for row in x])


def test_two_atoms_merge_at_half_their_distance():
    atoms = np.sort(np.repeat([[0.0, 3.0]], 50, axis=1))
    assert critical_bandwidth(atoms, np.array([100]), 1) == pytest.approx(1.5, rel=0.01)


def test_more_modes_need_less_smoothing():
    x, n = rows_of("two"), np.full(ROWS, SAMPLES)
    one, two, three = (critical_bandwidth(x, n, modes) for modes in (1, 2, 3))
    assert (one > 2 * two).all()
    assert (two >= three).all()


def test_units_and_origin_of_the_samples():
    x, n = rows_of("two"), np.full(ROWS, SAMPLES)
    moved = critical_bandwidth(10 + 2.5 * x, n, 1)
    np.testing.assert_allclose(moved, 2.5 * critical_bandwidth(x, n, 1), rtol=1e-9)


def test_padding_takes_no_part():
    x = rows_of("two")
    padded = np.concatenate([x, np.full((ROWS, 50), np.inf)], axis=1)
    few = np.where(np.arange(SAMPLES) < 100, x, np.inf)
    n = np.full(ROWS, SAMPLES)
    alone = critical_bandwidth(x, n, 1)
    np.testing.assert_allclose(critical_bandwidth(padded, n, 1), alone, rtol=1e-12)
    cut = critical_bandwidth(x[:, :100], np.full(ROWS, 100), 2)
    np.testing.assert_allclose(critical_bandwidth(few, np.full(ROWS, 100), 2), cut, rtol=1e-12)
    assert np.isfinite(silverman_p(padded, n, 1, resamples=9)).all()


def test_rows_without_a_bandwidth():
    x = np.array([[1.0, 1.0, 1.0], [1.0, np.inf, np.inf], [np.inf] * 3])
    n = np.array([3, 1, 0])
    assert np.isnan(critical_bandwidth(x, n, 1)).all()
    assert np.isnan(silverman_p(x, n, 1)).all()


def test_two_modes_are_told_from_one_and_not_from_two():
    x, n = rows_of("two"), np.full(ROWS, SAMPLES)
    np.testing.assert_allclose(silverman_p(x, n, 1), 0.01)
    assert np.median(silverman_p(x, n, 2)) > 0.1


def test_one_mode_is_seldom_told_from_one():
    """5 % is 1.2 % of Gaussian samples (measured): 8 or more of 100 fail once in 20 000."""
    x = np.sort(np.random.default_rng(62).normal(size=(100, 200)))
    assert np.count_nonzero(silverman_p(x, np.full(100, 200), 1) <= 0.05) < 8


def test_seed_decides():
    x, n = rows_of("normal"), np.full(ROWS, SAMPLES)
    one, same, other = (silverman_p(x, n, 1, resamples=39, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()
