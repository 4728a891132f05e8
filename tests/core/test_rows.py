"""Rows: a part of a result is what the same part of the samples gives."""

from __future__ import annotations

import numpy as np
import pytest

from chdstat._core.arrays import take_rows
from chdstat._core.positive import PositivePart
from chdstat.fit.families import FAMILIES
from chdstat.fit.selection import select_part


@pytest.fixture(scope="module")
def x():
    return np.random.default_rng(4).gamma(2.0, size=(2, 3, 4, 64))


@pytest.mark.parametrize("rows", [1, slice(0, 3)])
def test_a_result_is_that_of_the_rows(x, rows):
    families = [FAMILIES["gamma"], FAMILIES["lognormal"]]
    whole = take_rows(select_part(PositivePart.of(x), families), rows, axis=2)
    part = select_part(PositivePart.of(x[:, :, rows]), families)
    np.testing.assert_array_equal(whole.values, part.values)
    np.testing.assert_array_equal(whole.best, part.best)
    np.testing.assert_array_equal(
        whole.fits["gamma"].parameters["shape"], part.fits["gamma"].parameters["shape"]
    )
    assert whole.families == part.families


def test_what_is_cached_goes_along(x):
    part = PositivePart.of(x)
    part.sorted, part.log_statistics  # noqa: B018 - computed here, to be taken over
    taken = take_rows(part, 3, axis=2)
    assert vars(taken)["sorted"].base is part.sorted
    np.testing.assert_array_equal(taken.sorted, np.sort(x[:, :, 3], axis=-1))
    np.testing.assert_array_equal(taken.log_statistics.n, part.n[:, :, 3])
    assert part.sorted.shape == x.shape
