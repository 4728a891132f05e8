"""Positive part: what counts, what is left out, and the sums and sorted samples that all share."""

import numpy as np
import pytest

from chdstat._core.arrays import take_rows
from chdstat._core.positive import PositivePart
from chdstat.errors import Reason
from chdstat.fit.families import FAMILIES
from chdstat.fit.selection import FamilySelection
from chdstat.summary.runner import measured
from tests.luminance import LUMINANCE

X = np.array(
    [
        [0.0, 2.0, 1.0, np.nan, 4.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3.0, 3.0, 3.0, 3.0, 3.0, 3.0],
        [np.inf, -np.inf, np.nan, np.nan, np.nan, np.nan],
        [-1.0, 0.0, np.nan, -2.0, -1e-9, 0.0],
        [-1.0, 0.5, 2.0, -2.0, 1.0, 0.0],
    ]
)


def test_samples_add_up():
    part = PositivePart.of(X)
    total = part.n + part.n_null + part.n_zero + part.n_negative + part.n_bad
    np.testing.assert_array_equal(total, X.shape[-1])
    np.testing.assert_array_equal(part.n, [3, 0, 6, 0, 0, 3])
    np.testing.assert_array_equal(part.n_negative, [0, 0, 0, 0, 3, 2])
    np.testing.assert_array_equal(part.n_good, [5, 6, 6, 0, 5, 6])


def test_reasons():
    expected = [Reason.OK, Reason.ALL_NULL, Reason.CONSTANT, Reason.ALL_BAD]
    expected += [Reason.NONE_POSITIVE, Reason.OK]
    np.testing.assert_array_equal(PositivePart.of(X).reason(), expected)
    np.testing.assert_array_equal(PositivePart.of(X[:1]).reason(4), [Reason.TOO_FEW])


def test_rows_are_channels_luminance_or_both():
    block = np.random.default_rng(0).gamma(0.5, size=(2, 3, 8))
    block[0, :, 0], block[0, 1, 1], block[1, 2, 2] = 0, 0, np.nan
    channels, light, both = (
        PositivePart.of_pixels(block, rows=rows) for rows in ("channels", "luminance", "both")
    )
    bad = np.isnan(block).any(axis=1, keepdims=True)
    np.testing.assert_array_equal(channels.x, np.where(bad, np.nan, block))
    expected = LUMINANCE @ block
    assert light.x == pytest.approx(expected, rel=1e-6, nan_ok=True)
    np.testing.assert_array_equal(both.x, np.concatenate([channels.x, light.x[:, None]], axis=1))
    for name in ("positive", "n", "n_null", "n_zero", "n_negative", "n_bad"):
        parts = [getattr(channels, name), getattr(light, name)[:, None]]
        np.testing.assert_array_equal(getattr(both, name), np.concatenate(parts, axis=1))
    # Of the zeros of one channel alone, the luminance knows nothing.
    assert (light.n_null.tolist(), light.n_zero.tolist(), light.n_bad.tolist()) == (
        [1, 0],
        [0, 0],
        [0, 1],
    )
    assert channels.n_zero.tolist() == [[0, 1, 0], [0, 0, 0]]


def test_a_single_channel_is_its_own_luminance():
    block = np.random.default_rng(1).gamma(0.5, size=(2, 1, 8))
    np.testing.assert_array_equal(PositivePart.of_pixels(block, rows="both").x, block)
    np.testing.assert_array_equal(PositivePart.of_pixels(block, rows="luminance").x, block[:, 0])


# --- rows: a part of a result is what the same part of the samples gives ------------------------


@pytest.fixture(scope="module")
def x():
    return np.random.default_rng(4).gamma(2.0, size=(2, 3, 4, 64))


@pytest.mark.parametrize("rows", [1, slice(0, 3)])
def test_a_part_of_a_result_is_that_of_the_rows(x, rows):
    selection = FamilySelection((FAMILIES["gamma"], FAMILIES["lognormal"]))
    whole = take_rows(measured(PositivePart.of(x), selection), rows, axis=2)
    part = measured(PositivePart.of(x[:, :, rows]), selection)
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
