"""Hartigan's dip: that of an independent implementation, and what holds whatever the samples."""

import diptest
import numpy as np
import pytest

from chdstat.inference.modes import dips


def of_rows(rows):
    """Return the dips of rows of different lengths, padded with infinity."""
    n = np.array([len(row) for row in rows])
    padded = np.full((len(rows), n.max()), np.inf)
    for i, row in enumerate(rows):
        padded[i, : n[i]] = np.sort(row)
    return dips(padded, n)


SAMPLES = {
    "one mode": lambda rng, n: rng.normal(size=n),
    "two modes": lambda rng, n: rng.normal(size=n) + 4 * (rng.random(n) < 0.4),
    "skewed": lambda rng, n: np.log(rng.gamma(0.3, size=n)),
    "heavy tails": lambda rng, n: rng.standard_t(1, size=n),
    "clusters": lambda rng, n: rng.integers(5, size=n) + rng.normal(0, 1e-9, n),
    "a lattice": lambda rng, n: rng.permutation(4 * n)[:n].astype(float),
    "ties": lambda rng, n: rng.integers(9, size=n).astype(float),
}


@pytest.mark.parametrize("name", SAMPLES)
@np.errstate(all="ignore")
def test_dips_are_those_of_diptest(name):
    rng = np.random.default_rng(1)
    rows = [SAMPLES[name](rng, n) for n in (*rng.integers(5, 400, size=60), 3000)]
    expected = [diptest.dipstat(row) for row in rows]
    np.testing.assert_allclose(of_rows(rows), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [lambda q: q, np.square, np.sqrt, np.exp, np.log1p])
@np.errstate(all="ignore")
def test_smooth_rows_of_any_length_are_those_of_diptest(shape):
    """Their curves have a vertex at every sample."""
    rows = [shape((np.arange(n) + 0.5) / n) for n in (17, 250, 4001)]
    rows += [np.append(row, 10) for row in rows]
    # Of evenly spaced samples, it returns 0 for some numbers of them, and 1 / (2 n) for others.
    expected = [max(diptest.dipstat(row), 1 / (2 * len(row))) for row in rows]
    np.testing.assert_allclose(of_rows(rows), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("row", [[1.0], [1.0, 1.0, 1.0], [1.0, 2.0]])
def test_the_least_dip(row):
    assert of_rows([row]) == 1 / (2 * len(row))
    assert dips(np.empty((0, 4)), np.empty(0, int)).shape == (0,)
