"""Pixels that are worth a first look."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.explorer.image_sources import StoreSource, stream
from chdstat.explorer.workspace import first_pixel, suggest


def ended(work):
    """Return what a pass yields in the end."""
    *_, (_, found) = work
    return found


def test_the_first_pixel_is_the_brightest_firefly():
    x = np.random.default_rng(1).gamma(2.0, size=(9, 11, 3, 64)).astype(np.float32)
    assert first_pixel(ended(stream(StoreSource(chd.Samples.from_array(x))))) == (4, 5)  # none
    x[2, 3, :, 7], x[6, 1, :, 9] = 1e3, 1e4
    assert first_pixel(ended(stream(StoreSource(chd.Samples.from_array(x))))) == (6, 1)


@pytest.mark.parametrize("wanted", [("long-tail", "long tail"), ("bimodal", "bimodal")])
def test_a_pattern_is_found_where_it_is(wanted):
    """Half of the pixels have the pattern, the others have none of those that are suggested."""
    kind, name = wanted
    samples = chd.simulate([kind, "gamma"], shape=(24, 24), spp=512, seed=1)
    found = dict(ended(suggest(StoreSource(samples))))
    assert name in found
    labels = chd.classify(samples, progress=False)
    flag = labels[name.replace(" ", "_")].to_numpy()
    assert flag[found[name]]


def test_nothing_is_suggested_of_a_plain_image():
    x = np.ones((8, 8, 3, 64), np.float32)
    assert ended(suggest(StoreSource(chd.Samples.from_array(x)))) == []
