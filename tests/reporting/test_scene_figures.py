"""Figures of a scene: what they pick out of it."""

from __future__ import annotations

import numpy as np

from chdstat.reporting.scene_figures import _brightest


def test_a_firefly_is_an_estimate_that_its_pixel_and_the_one_above_do_not_share():
    rng = np.random.default_rng(0)
    batches = rng.gamma(50.0, 0.02, size=(8, 8, 6))
    assert _brightest(batches) is None
    batches[:4] *= 100  # an edge is none
    assert _brightest(batches) is None
    batches[6, 2, 3] = 40
    assert _brightest(batches) == (6, 2, 3)
    assert _brightest(batches * 0) is None
    assert _brightest(batches * np.nan) is None
    assert _brightest(batches[..., :1]) is None
