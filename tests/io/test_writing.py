"""Maps of results: written as EXR layers and netCDF, read from zarr, by functions and command."""

import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat.cli import main
from chdstat.errors import InputError

RADIANCE = np.random.default_rng(2).gamma(0.3, 3.0, size=(5, 6, 3, 24)).astype(np.float32)
SAMPLES = chd.Samples.from_array(RADIANCE, scene="x")


def test_maps_are_layers(tmp_path):
    found = chd.summarize(SAMPLES)
    image = chd.io.read_exr(chd.io.write_maps(found, tmp_path / "x.exr"))
    np.testing.assert_array_equal(image.image, found["mean"].to_numpy().astype(np.float32))
    variance = found["variance"].to_numpy().astype(np.float32)
    np.testing.assert_array_equal(image.extra["variance"], variance)
    assert image.attributes["image"] == "mean"
    with pytest.raises(InputError, match="has no map of dims"):
        chd.io.write_maps(found.mean(["y", "x"]), tmp_path / "x.exr")


def test_results_are_netcdf(tmp_path):
    found = chd.summarize(SAMPLES)
    path = chd.io.write_netcdf(found, tmp_path / "x.nc")
    with xr.open_dataset(path) as again:
        assert set(again) == set(found)
        np.testing.assert_array_equal(again["mean"], found["mean"])
        assert list(again["channel"].to_numpy()) == ["R", "G", "B"]


def test_attributes_that_netcdf_has_no_type_for_are_json(tmp_path):
    found = chd.summarize(SAMPLES).assign_attrs(
        files=[["a", 1]], none=None, yes=True, size=[6, 5], seed=2**40
    )
    found["mean"].attrs["of"] = {"a": [1.5]}
    with xr.open_dataset(chd.io.write_netcdf(found, tmp_path / "x.nc")) as again:
        held = again.attrs
        assert (held["files"], held["none"], held["yes"]) == ('[["a", 1]]', "null", "true")
        assert (list(held["size"]), held["seed"]) == ([6, 5], str(2**40))
        assert again["mean"].attrs["of"] == '{"a": [1.5]}'
    assert found.attrs["none"] is None


def test_the_command_exports_maps(tmp_path, monkeypatch, capsys):
    def export(source, kind, name):
        line = ["chdstat", "export", source, "--as", kind, "-o", tmp_path / name]
        monkeypatch.setattr("sys.argv", [*map(str, line)])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    store, found = SAMPLES.save(tmp_path / "x.zarr").path, tmp_path / "maps.zarr"
    chd.summarize(SAMPLES).to_zarr(found, consolidated=False)
    for kind, name in {"exr": "d.exr", "netcdf": "e.nc"}.items():
        assert export(found, kind, name) == 0
        assert (tmp_path / name).exists()
    assert "d.exr" in capsys.readouterr().out
    assert export(store, "exr", "f.exr") == 1
    assert "holds samples, not maps" in capsys.readouterr().err
