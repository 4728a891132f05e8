"""What is written for other programs: their layouts, their numbers, by obvious loops."""

import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat.cli import main
from chdstat.errors import InputError, StoreError

RADIANCE = np.random.default_rng(2).gamma(0.3, 3.0, size=(5, 6, 3, 24)).astype(np.float32)
SAMPLES = chd.Samples.from_array(RADIANCE, scene="x")


def pfm(path):
    """Read a portable float map as its description says: lowest row first, little endian."""
    kind, size, scale, data = path.read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    assert float(scale) == -1
    image = np.frombuffer(data, "<f4").reshape(height, width, 3 if kind == b"PF" else 1)
    return image[::-1]


def planes(path, names):
    return np.moveaxis(chd.io.read_exr(path, channels=names).image, -1, 0)


# --- Bayesian collaborative denoising -------------------------------------------------------------


def of_bcd(samples):
    """Return mean, covariance and histogram of samples (sample, 3), accumulated one by one."""
    mean, histogram = samples.mean(axis=0), np.zeros((3, 20))
    covariance = np.cov(samples.T)
    for sample in samples:
        for channel, value in enumerate(sample):
            scaled = min(max(value, 0) ** (1 / 2.2) / 2.5, 2)
            place = scaled * 18
            low = int(place) if place < 18 else 18
            high = place - low if place < 18 else scaled - 1
            histogram[channel, low] += 1 - high
            histogram[channel, low + 1] += high
    x, y, z = range(3)
    pairs = [(x, x), (y, y), (z, z), (y, z), (x, z), (x, y)]
    return mean, np.array([covariance[p] for p in pairs]), histogram.ravel()


def test_bcd_takes_means_covariances_and_histograms(tmp_path):
    bright = RADIANCE * np.float32(30)
    colours, histogram, covariance = chd.io.write_bcd(bright, tmp_path / "x.exr")
    counted = planes(histogram, [f"Bin_{i:04}" for i in range(61)])
    spread = planes(covariance, [f"Bin_{i:04}" for i in range(6)])
    assert (counted[60] == 24).all()
    assert (counted[19] > 0).any()  # beyond the brightness of the last bin but one
    for y, x in [(0, 0), (4, 5), (2, 1)]:
        mean, pairs, bins = of_bcd(bright[y, x].T.astype(np.float64))
        np.testing.assert_allclose(chd.io.read_exr(colours).image[y, x], mean, rtol=1e-5)
        np.testing.assert_allclose(spread[:, y, x], pairs, rtol=1e-4)
        np.testing.assert_allclose(counted[:60, y, x], bins, rtol=1e-4, atol=1e-4)


def test_bad_samples_are_left_out_for_bcd(tmp_path):
    x = RADIANCE.copy()
    x[1, 2, 0, :3] = np.nan
    x[0, 0] = np.inf
    with pytest.warns(chd.errors.LeftOutWarning, match="are bad and were left out"):
        colours, histogram, _ = chd.io.write_bcd(x, tmp_path / "x.exr")
    number = planes(histogram, ["Bin_0060"])[0]
    assert (number[1, 2], number[0, 0], number[3, 3]) == (21, 0, 24)
    np.testing.assert_allclose(
        chd.io.read_exr(colours).image[1, 2], x[1, 2, :, 3:].mean(axis=-1), rtol=1e-5
    )
    assert np.isfinite(chd.io.read_exr(colours).image).all()


# --- cascades -------------------------------------------------------------------------------------


def test_layers_of_a_cascade_are_those_of_the_estimator(tmp_path):
    files = chd.io.write_cascades(SAMPLES, tmp_path / "x.exr")
    assert files[-1].name == "x.24.light_min32768.exr"
    found = np.stack([chd.io.read_exr(file).image for file in files])
    cascade = chd.estimators.Cascade.of(RADIANCE, unit=1.0)
    np.testing.assert_allclose(found, cascade.layers, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(found.sum(axis=0), RADIANCE.mean(axis=-1), rtol=1e-5)


def test_a_cascade_may_start_elsewhere(tmp_path):
    one = chd.io.write_cascades(SAMPLES, tmp_path / "x.exr")
    other = chd.io.write_cascades(RADIANCE / 4, tmp_path / "y.exr", start=0.25)
    assert other[1].name == "y.24.light_min2.exr"
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(chd.io.read_exr(a).image / 4, chd.io.read_exr(b).image, 1e-6)
    with pytest.raises(InputError, match="start must be a luminance"):
        chd.io.write_cascades(SAMPLES, tmp_path / "x.exr", start=0)


# --- StatMC ---------------------------------------------------------------------------------------


def test_moments_are_of_transformed_samples(tmp_path):
    files = chd.io.write_moments(SAMPLES, tmp_path / "x.pfm")
    found = {file.stem.removeprefix("x-24-"): pfm(file) for file in files}
    y = 2 * (np.sqrt(RADIANCE.astype(np.float64)) - 1)
    away, mean = y - y.mean(axis=-1, keepdims=True), RADIANCE.mean(axis=-1)
    right = {
        "film": mean,
        "t0-b0-n": np.full((5, 6, 1), 24),
        "t0-b0-mean": y.mean(axis=-1),
        "t0-b0-m2": (away**2).sum(axis=-1),
        "t0-b0-m3": (away**3).sum(axis=-1),
        "t0-b0-film-mean": mean,
        "t0-b0-film-m2": RADIANCE.var(axis=-1, dtype=np.float64) * 24,
    }
    assert found.keys() == right.keys()
    for name, values in right.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-4, atol=1e-4)


def test_negative_samples_have_no_moments(tmp_path):
    with pytest.raises(InputError, match="square roots of samples, and there are negative ones"):
        chd.io.write_moments(RADIANCE - 1, tmp_path / "x.pfm")


# --- maps -----------------------------------------------------------------------------------------


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


# --- the command and faults -----------------------------------------------------------------------


@pytest.fixture
def run(monkeypatch):
    """Return a function that runs a command, and returns its exit code."""

    def command(*arguments: object) -> int:
        monkeypatch.setattr("sys.argv", ["chdstat", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    return command


def test_the_command_exports_samples_and_maps(tmp_path, run, capsys):
    store, maps = tmp_path / "x.zarr", tmp_path / "maps.zarr"
    SAMPLES.save(store)
    chd.analyze(store, progress=False).to_zarr(maps, consolidated=False)
    kinds = {"bcd": "a.exr", "cascades": "b.exr", "moments": "c.pfm"}
    for kind, name in kinds.items():
        assert run("export", store, "--as", kind, "-o", tmp_path / name) == 0
    for kind, name in {"exr": "d.exr", "netcdf": "e.nc"}.items():
        assert run("export", maps, "--as", kind, "-o", tmp_path / name) == 0
        assert (tmp_path / name).exists()
    assert "a_cov.exr" in capsys.readouterr().out
    assert run("export", store, "--as", "exr", "-o", tmp_path / "f.exr") == 1
    assert "holds samples, not maps" in capsys.readouterr().err


def test_faults_are_named(tmp_path):
    two = RADIANCE[:, :, :2]
    averages = chd.Samples.from_array(RADIANCE, averaged=4)
    for write, suffix in [
        (chd.io.write_bcd, ".exr"),
        (chd.io.write_cascades, ".exr"),
        (chd.io.write_moments, ".pfm"),
    ]:
        with pytest.raises(InputError, match="1 (or|nor) 3|1 or 3|neither 1"):
            write(chd.Samples.from_array(two, axes="yxcs"), tmp_path / f"x{suffix}")
        with pytest.raises(InputError, match="averages of 4"):
            write(averages, tmp_path / f"x{suffix}")
        with pytest.raises(InputError, match=f"must end in {suffix}"):
            write(SAMPLES, tmp_path / "x.png")
    with pytest.raises(InputError, match="at least 2 samples"):
        chd.io.write_bcd(chd.Samples.from_array(RADIANCE[..., :1], axes="yxcs"), tmp_path / "x.exr")
    with pytest.raises(StoreError, match="no maps at"):
        chd.io.maps.open_maps(tmp_path)
