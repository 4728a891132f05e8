"""The brightest firefly of a scene."""

from __future__ import annotations

import numpy as np

from chdstat.studies.claims.neighbours import brightest_firefly


def test_a_firefly_is_an_estimate_that_its_pixel_and_the_one_above_do_not_share():
    rng = np.random.default_rng(0)
    batches = rng.gamma(50.0, 0.02, size=(8, 8, 6))
    assert brightest_firefly(batches) is None
    batches[:4] *= 100  # an edge is none
    assert brightest_firefly(batches) is None
    batches[6, 2, 3] = 40
    assert brightest_firefly(batches) == (6, 2, 3)
    assert brightest_firefly(batches * 0) is None
    assert brightest_firefly(batches * np.nan) is None
    assert brightest_firefly(batches[..., :1]) is None
