"""Regions that the library chooses: one for each pattern of an image, where it is purest."""

from __future__ import annotations

import numpy as np
import xarray as xr

from chdstat.patterns import Label, choose_regions

FLAGS = {
    "flag_values": [int(label) for label in Label],
    "flag_meanings": " ".join(label.name.lower() for label in Label),
}


def test_the_library_chooses_one_pure_region_for_each_pattern():
    label = np.full((32, 32), Label.GAMMA_LIKE, dtype=np.int8)
    label[20:28, 4:12] = Label.BIMODAL
    label[2, 30] = Label.LONG_TAIL
    dataset = xr.Dataset({"label": (("y", "x"), label, FLAGS)})
    regions = choose_regions(dataset)
    assert [r.name for r in regions] == ["gamma-like", "bimodal", "long-tail"]
    for region, code in zip(regions[:2], (Label.GAMMA_LIKE, Label.BIMODAL), strict=True):
        assert (label[region.pixels(32, 32)] == code).all()
    assert (label[regions[2].pixels(32, 32)] == Label.LONG_TAIL).any()


def test_choosing_works_on_a_single_pixel():
    label = xr.DataArray(np.full((1, 1), Label.BLACK), dims=("y", "x"), attrs=FLAGS)
    (region,) = choose_regions(xr.Dataset({"label": label}))
    assert region.pixels(1, 1) == (slice(0, 1), slice(0, 1))
