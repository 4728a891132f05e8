"""Dual-buffer non-local means and clamped samples: their formulas, and what they do to an image."""

import itertools

import numpy as np
import pytest

from chdstat import estimators
from chdstat.errors import InputError
from chdstat.estimators.validation import reordered


def obvious(x, k, radius, patch, cancelled):
    """Filter pixel by pixel, as the paper writes it, away from the border."""
    ordered = reordered(x)[0]
    halves = [ordered[..., i::2] for i in (0, 1)]
    mean = [h.mean(axis=-1) for h in halves]
    error = [h.var(axis=-1, ddof=1) / h.shape[-1] for h in halves]
    steps = list(itertools.product(range(-patch, patch + 1), repeat=2))
    y, xx = x.shape[0] // 2, x.shape[1] // 2

    def distance(u, v, p, q):
        square = (u[p] - u[q]) ** 2 - cancelled * (v[p] + np.minimum(v[p], v[q]))
        return (square / (k**2 * (v[p] + v[q]))).mean()

    def apart(u, v, p, q):
        return np.mean([distance(u, v, add(p, s), add(q, s)) for s in steps])

    def add(p, s):
        return p[0] + s[0], p[1] + s[1]

    found = []
    for values, u, v in ((mean[0], mean[1], error[1]), (mean[1], mean[0], error[0])):
        total, weights = values[y, xx].copy(), 1.0
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                if dy or dx:
                    steps = [
                        (i, j) for i in range(-patch, patch + 1) for j in range(-patch, patch + 1)
                    ]
                    p, q = (y, xx), (y + dy, xx + dx)
                    each = [np.exp(-max(0, apart(u, v, add(p, s), add(q, s)))) for s in steps]
                    w = np.mean(each) if np.mean(each) >= 0.05 else 0
                    total += w * values[q]
                    weights += w
        found.append(total / weights)
    return np.mean(found, axis=0)


def test_it_is_the_filter_of_the_paper():
    x = np.random.default_rng(0).gamma(0.7, size=(15, 15, 3, 12))
    x[:, 8:] *= 4
    found = estimators.rousselle2012(x, radius=2, patch=1)
    assert found[7, 7] == pytest.approx(obvious(x, 0.45, 2, 1, 1.0), rel=1e-9)


def test_noise_goes_and_edges_stay():
    rng = np.random.default_rng(1)
    truth = np.ones((32, 32, 3))
    truth[:, 16:] = 20
    x = truth[..., np.newaxis] * rng.exponential(size=(*truth.shape, 32))
    found, mean = estimators.rousselle2012(x), x.mean(axis=-1)
    assert np.square(found / truth - 1).mean() < 0.1 * np.square(mean / truth - 1).mean()
    assert abs(found[:, 15] - 1).max() < 0.5


def test_bad_and_constant_pixels_are_as_they_are():
    x = np.random.default_rng(2).exponential(size=(12, 12, 1, 8))
    x[3, 3], x[5, 5, 0, 2], x[:, 8:] = np.nan, np.inf, 7.0
    found = estimators.rousselle2012(x, radius=3)
    assert np.isnan(found[3, 3])
    assert np.isfinite(np.delete(found.ravel(), 3 * 12 + 3)).all()
    assert found[6, 10] == pytest.approx(7)
    with pytest.raises(InputError, match="damping"):
        estimators.rousselle2012(x, damping=0)


def test_samples_above_the_limit_keep_their_colour():
    x = np.array([[1.0, 40.0], [1.0, 20.0], [1.0, 0.0]])
    assert estimators.clamped(x, unit=1.0) == pytest.approx([5.5, 3.0, 0.5])
    assert estimators.clamped(x, unit=1.0, limit=100) == pytest.approx(x.mean(axis=-1))
    assert estimators.clamped(3 * x, unit=3.0) == pytest.approx([16.5, 9.0, 1.5])
    with pytest.raises(InputError, match="limit"):
        estimators.clamped(x, limit=0)
