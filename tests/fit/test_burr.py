"""Burr XII: what its density does where others would overflow."""

import numpy as np

from chdstat._core.positive import PositivePart
from chdstat.fit._burr import BURR
from chdstat.fit.weighted_samples import blocks


def test_a_row_without_a_fit_does_not_make_another_overflow():
    rows = np.array([[1e-3, 1.0, 2.0, 1e3], [1.0, 2.0, 3.0, 4.0]])
    (points,) = blocks(PositivePart.of(rows), np.ones(2, bool))
    parameters = {
        name: np.array([known, np.nan])
        for name, known in (("c", 400.0), ("d", 1.0), ("scale", 1e-3))
    }
    density = BURR.log_density(points, parameters)
    assert np.isfinite(density[0]).all()
    assert np.isnan(density[1]).all()
