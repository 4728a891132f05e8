"""Analysis: the dataset of everything, its numbers for the scene, and how it is kept."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat._core import statistic
from chdstat._core.statistic import Quantity, Result, Statistic, result, variable
from chdstat.analysis import noise_of, overview, patterns_of, save
from chdstat.errors import StoreError
from chdstat.samples import tiles
from tests.luminance import LUMINANCE


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(11)
    x = rng.gamma(1.5, size=(6, 8, 3, 256)) * (rng.random((6, 8, 1, 256)) < 0.4)
    return chd.Samples.from_array(x, scene="synthetic")


@pytest.fixture(scope="module")
def found(samples):
    return chd.analyze(samples)


def test_statistics_agree_with_numpy(samples, found):
    x = samples.read().astype(float)
    np.testing.assert_allclose(found["mean"], x.mean(axis=-1), rtol=1e-6)
    np.testing.assert_allclose(found["variance"], x.var(axis=-1, ddof=1), rtol=1e-6)
    y = np.moveaxis(x, 2, -1) @ LUMINANCE
    expected = y.std(axis=-1, ddof=1) / y.mean(axis=-1)
    np.testing.assert_allclose(found["coefficient_of_variation"], expected, rtol=1e-5)


def test_cuts_change_no_pixel(samples, found, monkeypatch):
    monkeypatch.setattr(tiles, "_AT_ONCE", 7 * samples[0, 0].nbytes)
    monkeypatch.setattr(tiles, "_MOST_BYTES", 20 * samples[0, 0].nbytes)
    xr.testing.assert_allclose(chd.analyze(samples), found, rtol=1e-6)  # sums in other orders


@pytest.mark.parametrize("spp", [1, 64, 512, 2048, 6144, 2**16, 2**20])
def test_no_tile_is_larger_with_more_samples(spp):
    cut = [*tiles.tiles((100, 90, 3, spp))]
    assert sum((y.stop - y.start) * (x.stop - x.start) for y, x in cut) == 9000
    most = max((y.stop - y.start) * (x.stop - x.start) for y, x in cut)
    assert most * 3 * spp * 4 <= max(2**23, 3 * spp * 4)
    taken = []
    pixels = np.zeros((1, most, 3, 1), np.float32)
    block = np.lib.stride_tricks.as_strided(pixels, (1, most, 3, spp), (*pixels.strides[:3], 0))
    tiles.by_pixels(lambda x: taken.append(x.nbytes) or {}, block)
    assert max(taken) <= max(3 * 2**20, 3 * spp * 4)


def test_what_is_found_at_once_is_what_is_found_alone(samples, found):
    """Patterns are of luminance, of which the analysis makes a row beside the channels."""
    for alone, prefix, names in (
        (chd.classify(samples), "", ("label", "dip", "misfit", "long_tail_q_value")),
        (chd.modality(samples), "modality_", ("modes", "places", "dip_q_value")),
        (chd.fit.select(samples), "", ("best_family", "margin", "gamma_shape", "burr_c_se")),
    ):
        for name in names:
            values = found[f"{prefix}{name}"]
            np.testing.assert_allclose(values, alone[name], rtol=1e-9, err_msg=name)


def test_a_statistic_that_tables_show_is_in_an_analysis(samples, found, monkeypatch):
    """With no line about it in `analyze`, and with every other number as before."""
    monkeypatch.setattr(statistic, "_SHOWN", [*statistic.shown_statistics()])

    @result
    class Largest(Result):
        value: np.ndarray = variable("largest positive sample")

    @dataclass(frozen=True)
    class LargestSample(Statistic[Largest]):
        result: ClassVar = Largest
        prefix: ClassVar = "largest_"
        quantities: ClassVar = (Quantity("largest", lambda found, i: str(found.value[i])),)

        @classmethod
        def of_pixel(cls, spp):
            return cls() if spp >= 100 else None

        def measure(self, part):
            return Largest(np.where(np.isfinite(part.sorted), part.sorted, 0).max(axis=-1))

    grown = chd.analyze(samples)
    np.testing.assert_array_equal(grown["largest_value"], samples.read().max(axis=-1))
    assert grown["largest_value"].attrs["long_name"] == "largest positive sample"
    xr.testing.assert_identical(grown.drop_vars("largest_value"), found)
    few = chd.analyze(samples.read()[:1, :1, :, :64])
    assert "largest_value" not in few


def test_patterns_alone_are_those_of_the_analysis(samples, found):
    """So is the overview of what both have; of what one lacks, there is none."""
    patterns = patterns_of(samples, progress=False)
    of_luminance = ("luminance_logarithms_", "luminance_averages_")  # which an analysis has not
    assert all(any(str(n).startswith(prefix) for n in patterns) for prefix in of_luminance)
    for name, values in patterns.data_vars.items():
        if str(name).startswith(of_luminance):
            continue
        np.testing.assert_allclose(values, found[name], rtol=1e-9, err_msg=name)
    some, whole = (overview(dataset).to_dict() for dataset in (patterns, found))
    for name in ("null_share", "variation", "patterns", "label_agreement"):
        assert some[name] == whole[name]
    assert whole["decided"] is not None
    assert (some["decided"], some["misfit"], some["modes"]) == (None, [None] * 3, {})
    with_families = overview(patterns_of(samples, families=True, progress=False)).to_dict()
    assert with_families == whole | {"modes": {}}
    noise = noise_of(patterns)
    assert sum(noise.pixels.values()) == pytest.approx(1)
    assert sum(noise.share.values()) == pytest.approx(1)


def test_the_overview_counts_what_was_put_in(found):
    numbers = overview(found)
    assert numbers.pixels == 48
    assert numbers.spp == 256
    # 12288 draws at p = 0.6: five standard errors, false failure below 1e-6.
    assert numbers.null_share == pytest.approx(0.6, abs=5 * np.sqrt(0.24 / 12288))
    # Some hundred samples of gamma(1.5) may pass for Weibull ones, but not for log-normal ones.
    assert numbers.families["gamma"] == max(numbers.families.values())
    assert numbers.families["lognormal"] < 0.1
    assert numbers.bad_samples == 0
    assert sum(numbers.families.values()) == pytest.approx(1)


def test_the_overview_is_always_json():
    numbers = overview(chd.analyze(chd.Samples.from_array(np.zeros((2, 2, 3, 4)))))
    text = json.dumps(numbers.to_dict(), allow_nan=False)
    assert json.loads(text)["null_share"] == 1
    assert json.loads(text)["variation"] == [None, None, None]


def test_maps_are_kept_and_never_overwritten(found, tmp_path):
    path = save(found, tmp_path / "maps.zarr")
    with xr.open_zarr(path, consolidated=False) as back:
        assert set(back.data_vars) == set(found.data_vars)
        np.testing.assert_array_equal(back["mean"], found["mean"])
        assert back["label"].attrs["flag_meanings"] == found["label"].attrs["flag_meanings"]
    with pytest.raises(StoreError, match="overwritten"):
        save(found, path)


def test_maps_are_written_as_memory_allows(found, tmp_path, monkeypatch):
    writes, write = [], xr.Dataset.to_zarr
    some = found[list(found)[:12]]

    def counted(self, *places, **options):
        writes.append(sum(maps.nbytes for maps in self.data_vars.values()))
        return write(self, *places, **options)

    monkeypatch.setattr(xr.Dataset, "to_zarr", counted)
    save(some, tmp_path / "small.zarr")
    assert len(writes) == 1
    writes.clear()
    largest = max(maps.nbytes for maps in some.data_vars.values())
    monkeypatch.setattr("chdstat.analysis._AT_ONCE", largest)
    path = save(some, tmp_path / "large.zarr")
    assert len(writes) > 2
    assert max(writes) <= largest
    assert xr.open_zarr(path, consolidated=False).identical(some)
