"""Images by the suffix of their file, and maps of results, by functions and command."""

import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat.errors import InputError
from chdstat.viz import tonemap

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


def test_the_command_exports_maps(tmp_path, run):
    store, found = SAMPLES.save(tmp_path / "x.zarr").path, tmp_path / "maps.zarr"
    chd.summarize(SAMPLES).to_zarr(found, consolidated=False)
    for name in ("d.exr", "e.nc"):
        code, out, _ = run("export", found, "-o", tmp_path / name)
        assert (code, (tmp_path / name).exists(), name in out) == (0, True, True)
    for given, name, message in (
        (store, "f.exr", "holds samples, not maps"),
        (found, "f.png", r"must end in .exr, .nc, got"),
    ):
        code, _, err = run("export", given, "-o", tmp_path / name)
        assert code == 2
        assert message in err


IMAGE = np.random.default_rng(3).gamma(0.5, size=(5, 7, 3)).astype(np.float32)


def test_an_array_and_a_float_map_hold_the_radiances(tmp_path):
    np.testing.assert_array_equal(np.load(chd.io.write_image(tmp_path / "a.NPY", IMAGE)), IMAGE)
    for image, kind in ((IMAGE, b"PF"), (IMAGE[..., :1], b"Pf")):
        head, size, scale, numbers = (
            chd.io.write_image(tmp_path / "a.pfm", image).read_bytes().split(b"\n", 3)
        )
        assert (head, size, scale) == (kind, b"7 5", b"-1.0")
        rows = np.frombuffer(numbers, "<f4").reshape(image.shape)
        np.testing.assert_array_equal(rows[::-1], image)  # the lowest row comes first
    found = chd.io.read_exr(chd.io.write_image(tmp_path / "a.exr", IMAGE, extra={"low": IMAGE / 2}))
    np.testing.assert_array_equal(found.extra["low"], IMAGE / 2)


def test_a_png_is_tone_mapped_and_says_so(tmp_path):
    from PIL import Image

    with Image.open(chd.io.write_image(tmp_path / "a.png", IMAGE, exposure=1.0)) as found:
        assert found.text["Comment"].startswith("tone-mapped by +1.00 stops and the sRGB curve")
        shown = np.asarray(found)[..., :3] / 255
    np.testing.assert_allclose(shown, tonemap(IMAGE, exposure=1.0), atol=0.5 / 255 + 1e-9)


def test_an_image_that_a_format_cannot_hold_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"\.png takes an image of 1 or 3 channels, got shape"):
        chd.io.write_image(tmp_path / "a.png", np.ones((4, 4, 5)))
    with pytest.raises(InputError, match=r"must end in \.exr, \.npy, \.pfm, \.png"):
        chd.io.write_image(tmp_path / "a.tiff", IMAGE)
    assert list(tmp_path.iterdir()) == []
