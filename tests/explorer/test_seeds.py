"""Seeds: stores that share random numbers are compared in pairs."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.explorer.address import View
from chdstat.explorer.selection import SelectionResults
from chdstat.explorer.workspace import opened

EDGE = 8


def noise(seed, spp=128):
    return np.random.default_rng(seed).gamma(1.0, size=(EDGE, EDGE, 3, spp)).astype(np.float32)


def held(x, seed):
    return chd.Samples.from_array(x, axes="yxcs", seed=seed, scene="noise")


@pytest.fixture
def told():
    """Return what tells the tables of a view of two stores."""
    shared = []

    def asked(view, source, other):
        shared.append(opened([other, source]))
        results = SelectionResults(shared[-1])
        return results.describe(results.plots(view))[0]

    yield asked
    for one in shared:
        one.stop()


PIXEL, REGION = View(pixels=((3, 4),)), View(region=(1, 1, 6, 7))


@pytest.mark.parametrize(
    ("view", "spp", "seed", "paired"),
    [(PIXEL, 128, 0, True), (PIXEL, 96, 0, True), (PIXEL, 128, 7, False), (REGION, 96, 0, True),
     (REGION, 128, 7, False)],
)  # fmt: skip
def test_stores_of_one_seed_are_compared_in_pairs(told, view, seed, paired, spp):
    x = noise(1)
    other = (x * noise(2) ** 0.1)[..., :spp]
    table = told(view, held(x, 0), held(other, seed))["compared"]
    assert ("pairs of samples with the same random numbers" in table["note"]) == paired
    if paired:
        pairs = spp if view is PIXEL else spp * 30
        assert f"{pairs} pairs" in table["note"]


def test_pairs_of_a_region_are_of_one_pixel_and_one_sample(told):
    """Twice as bright in every sample: pairs differ by less than their samples do."""
    x = np.exp(noise(1))
    t = {}
    for seed in (0, 7):
        table = told(REGION, held(x, 0), held(1.01 * x[..., :96], seed))["compared"]
        row = next(row for row in table["rows"] if "standard error" in row[0])
        t[seed] = abs(float(row[1].replace("−", "-")))
    assert t[0] > 10 * t[7]
