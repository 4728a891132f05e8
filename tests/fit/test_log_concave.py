"""Log-concave densities: against a general optimiser, families that are log-concave, and laws."""

import numpy as np
import pytest
from scipy import optimize, stats

from chdstat.fit.log_concave import log_concave_likelihood


def likelihood(x):
    x = np.sort(np.atleast_2d(x), axis=-1)
    return log_concave_likelihood(x, np.full(len(x), x.shape[-1]))


def by_slsqp(x):
    """Maximise over concave log densities whose knots are the samples."""
    x, n = np.sort(x), len(x)
    step = np.diff(x)

    def loss(p):
        slope = np.diff(p)
        mass = np.where(
            np.abs(slope) < 1e-6, 1 + slope / 2, np.expm1(slope) / np.where(slope, slope, 1)
        )
        return -p.sum() / n + (step * np.exp(p[:-1]) * mass).sum()

    concave = {"type": "ineq", "fun": lambda p: -np.diff(np.diff(p) / step)}
    start = stats.norm(x.mean(), 1.5 * x.std()).logpdf(x)
    found = optimize.minimize(
        loss, start, constraints=[concave], method="SLSQP", options={"maxiter": 500, "ftol": 1e-10}
    )
    return n * (1 - found.fun)


@pytest.mark.parametrize("draw", ["normal", "exponential", "uniform", "laplace"])
def test_maximum_is_that_of_a_general_optimiser(draw):
    x = getattr(np.random.default_rng(1), draw)(size=(3, 33))
    expected = [by_slsqp(row) for row in x]
    np.testing.assert_allclose(likelihood(x), expected, atol=0.05)


@pytest.mark.parametrize("n", [40, 300, 4000])
def test_it_is_likelier_than_log_concave_families(n):
    rng = np.random.default_rng(2)
    x = rng.exponential(size=(50, n))
    edge = -n * (np.log((x - x.min(axis=-1, keepdims=True)).mean(axis=-1)) + 1)
    assert (likelihood(x) > edge - 0.1).all()
    x = rng.normal(size=(50, n))
    normal = -n / 2 * (np.log(2 * np.pi * x.var(axis=-1)) + 1)
    assert (likelihood(x) > normal - 0.1).all()
    # How much more likely grows slowly: by 3 to 17 here, not by a share of n.
    assert (likelihood(x) < normal + 25).all()


def test_spikes_of_equal_samples_are_climbed_to_the_top():
    """The search gave up on some, up to 45 below, and how far depended on the other rows."""
    x = np.log(np.random.default_rng(6).gamma(2.0, size=(20, 96)))
    x[:, ::2] = 0
    both = likelihood(x)
    np.testing.assert_allclose(likelihood(-x), both, atol=0.1)
    alone = [likelihood(row)[0] for row in x]
    np.testing.assert_allclose(alone, both, rtol=1e-12)
