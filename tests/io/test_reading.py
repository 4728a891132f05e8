"""Samples read from files: every axis in its place, features, counts, provenance, and faults."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat.cli import main
from chdstat.errors import ChdstatError, InputError, StoreError
from chdstat.io.reading import FORMATS

FRAMES = np.random.default_rng(5).gamma(2.0, size=(40, 6, 9, 3)).astype(np.float32)
RADIANCE = np.moveaxis(FRAMES, 0, -1)


def npy(folder):
    np.save(folder / "x.npy", FRAMES)
    return chd.io.read(folder / "x.npy", axes="syxc")


def npz(folder):
    np.savez_compressed(folder / "x.npz", radiance=FRAMES, other=np.zeros(3))
    return chd.io.read(folder / "x.npz", axes="syxc")


def zarr(folder):
    dataset = xr.Dataset({"light": (("sample", "y", "x", "channel"), FRAMES)})
    dataset.to_zarr(folder / "x.zarr", consolidated=False)
    return chd.io.read(folder / "x.zarr")


def netcdf(folder):
    xr.Dataset({"light": (("sample", "y", "x", "channel"), FRAMES)}).to_netcdf(
        folder / "x.nc", engine="scipy"
    )
    return chd.io.read(folder / "x.nc")


@pytest.fixture
def run(monkeypatch):
    """Return a function that runs a command, which must succeed."""

    def command(*arguments: object) -> None:
        monkeypatch.setattr("sys.argv", ["chdstat", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert not ended.value.code

    return command


@pytest.mark.parametrize("write", [npy, npz, zarr, netcdf])
def test_samples_are_read_as_they_are(tmp_path, write):
    samples = write(tmp_path)
    assert samples.shape == RADIANCE.shape
    assert np.array_equal(samples.read(), RADIANCE)
    part = slice(1, 5, 2), slice(2, 9), slice(3, 40, 5)
    assert np.array_equal(samples.read(*part), RADIANCE[part[0], part[1], :, part[2]])
    saved = samples.save(tmp_path / "own.zarr")
    assert np.array_equal(saved.read(), RADIANCE)
    assert saved.attrs["scene"] == "x"


@pytest.mark.parametrize("axes", ["yxcs", "yxsc", "syxc", "scyx", "cxys"])
def test_axes_are_brought_in_order(tmp_path, axes):
    np.save(tmp_path / "x.npy", RADIANCE.transpose(["yxcs".index(a) for a in axes]))
    assert np.array_equal(chd.io.read(tmp_path / "x.npy", axes=axes).read(), RADIANCE)


def test_one_channel_gains_an_axis(tmp_path):
    np.save(tmp_path / "x.npy", RADIANCE[:, :, 0])
    assert np.array_equal(chd.io.read(tmp_path / "x.npy").read(), RADIANCE[:, :, :1])


def test_netcdf_is_unpacked_and_says_its_unit(tmp_path):
    packed = np.round(FRAMES / 0.01).astype(np.int16)
    packed[0, 0, 0, 0] = -1
    about = {"scale_factor": 0.01, "_FillValue": np.int16(-1), "units": "cd m-2"}
    data = xr.Dataset({"light": (("sample", "y", "x", "channel"), packed, about)})
    data.to_netcdf(tmp_path / "x.nc", engine="scipy")
    samples = chd.io.read(tmp_path / "x.nc")
    assert samples.attrs["unit"] == "cd m-2"
    found = samples.read()
    assert np.isnan(found[0, 0, 0, 0])
    assert np.isnan(found).sum() == 1
    np.testing.assert_allclose(found[1:], RADIANCE[1:], atol=0.006)


def test_files_follow_each_other(tmp_path):
    for number in range(4):
        np.save(tmp_path / f"{number}.npy", FRAMES[10 * number : 10 * number + 10])
    for given in ([tmp_path], sorted(tmp_path.glob("*.npy"))):
        samples = chd.io.read(*given, axes="syxc")
        assert np.array_equal(samples.read(), RADIANCE)
        assert np.array_equal(samples.read(ss=slice(5, 39, 7)), RADIANCE[..., 5:39:7])


def test_features_are_arrays_files_or_names(tmp_path):
    albedo, depth = FRAMES[0], FRAMES[0, :, :, 0]
    np.savez(tmp_path / "x.npz", radiance=FRAMES, a=albedo)
    np.save(tmp_path / "depth.npy", depth)
    chd.io.write_exr(tmp_path / "normal.exr", albedo)
    features = {"albedo": "a", "depth": tmp_path / "depth.npy", "normal": tmp_path / "normal.exr"}
    found = chd.io.read(tmp_path / "x.npz", axes="syxc", features=features).features
    assert np.array_equal(found["albedo"], albedo)
    assert np.array_equal(found["normal"], albedo)
    assert np.array_equal(found["depth"], depth)


def test_counts_cut_what_a_pixel_has(tmp_path):
    counts = np.random.default_rng(1).integers(0, 41, size=(6, 9))
    np.save(tmp_path / "x.npy", FRAMES)
    np.save(tmp_path / "n.npy", counts)
    samples = chd.io.read(tmp_path / "x.npy", axes="syxc", counts=tmp_path / "n.npy")
    saved = samples.save(tmp_path / "own.zarr")
    assert np.array_equal(saved.counts, counts)
    assert np.array_equal(np.isfinite(saved.read()[:, :, 0]).sum(axis=-1), counts)


def test_the_command_imports_and_appends(tmp_path, run):
    np.save(tmp_path / "x.npy", FRAMES)
    np.save(tmp_path / "y.npy", FRAMES + 1)
    where = ("-o", tmp_path / "own.zarr", "--axes", "syxc", "-q")
    run("import", tmp_path / "x.npy", *where, "--renderer", "mine 1.2", "--seed", "4")
    run("import", tmp_path / "y.npy", *where, "--append", "--seed", "5")
    samples = chd.open(tmp_path / "own.zarr")
    assert np.array_equal(samples.read(ss=slice(40)), RADIANCE)
    assert np.array_equal(samples.read(ss=slice(40, 80)), RADIANCE + 1)
    assert samples.attrs["renderer"] == "mine 1.2"
    assert str(tmp_path) not in str(samples.attrs)


@pytest.mark.filterwarnings("default::chdstat.errors.InputWarning")
def test_the_command_tells_of_copies_in_a_line(tmp_path, run, capsys):
    for number in range(3):
        chd.io.write_exr(tmp_path / f"{number}.exr", FRAMES[number % 2])
    run("import", *sorted(tmp_path.glob("*.exr")), "-o", tmp_path / "own.zarr", "-q")
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith("chdstat: ")
    assert "(1: 2.exr of 0.exr)" in said[0]


def test_the_documentation_says_of_every_format_what_becomes_of_its_files():
    page = Path(__file__).parents[2] / "docs" / "reference" / "formats.rst"
    text = page.read_text(encoding="utf-8").partition("What becomes of what is in the files")[2]
    tables = text.partition("EXR stacks")[0].split(".. list-table:: ")[1:]
    names = [re.search(r"\w+", table)[0] for table in tables]
    assert names == ["arrays", *(known.name for known in FORMATS)]
    for table in tables:
        rows = re.findall(r"\* - (.+)\n     - \S", table)
        assert rows == ["Read", "Converted", "Warned of", "Ignored", "Refused"]


def test_faults_are_named(tmp_path):
    (tmp_path / "bad.npy").write_bytes(b"no array")
    (tmp_path / "x.txt").write_text("1 2 3")
    (tmp_path / "empty").mkdir()
    np.save(tmp_path / "bytes.npy", (FRAMES * 10).astype(np.uint8))
    np.save(tmp_path / "x.npy", FRAMES)
    np.save(tmp_path / "small.npy", FRAMES[:, 1:])
    np.savez(tmp_path / "x.npz", FRAMES)
    cases = [
        (["bad.npy"], {}, StoreError, "cannot read"),
        (["x.txt"], {}, InputError, "known formats are npy"),
        (["empty"], {}, StoreError, "empty folder"),
        (["none.npy"], {}, StoreError, "nothing at"),
        (["bytes.npy"], {}, InputError, "unsigned integers"),
        (["x.npy"], {}, InputError, "say what the axes are"),
        (["x.npy"], {"axes": "yxc"}, InputError, "name each axis"),
        (["x.npy", "small.npy"], {"axes": "syxc"}, InputError, "small.npy holds samples of shape"),
        (["x.npz"], {"axes": "syxc", "variable": "y"}, InputError, "holds no array 'y'"),
        (["x.npz"], {"axes": "syxc", "features": {"albedo": "a"}}, InputError, "no array 'a'"),
        (["x.npy"], {"axes": "syxc", "features": {"counts": FRAMES[0]}}, InputError, "counts="),
    ]
    for names, options, error, told in cases:
        with pytest.raises(error, match=told):
            chd.io.read(*(tmp_path / name for name in names), **options)


@pytest.mark.parametrize("name", ["x.npy", "x.npz", "x.nc"])
def test_hostile_files_are_refused(tmp_path, name):
    np.save(tmp_path / "x.npy", FRAMES)
    np.savez_compressed(tmp_path / "x.npz", FRAMES)
    xr.Dataset({"light": (("sample", "y", "x", "channel"), FRAMES)}).to_netcdf(
        tmp_path / "x.nc", engine="scipy"
    )
    whole, rng = (tmp_path / name).read_bytes(), np.random.default_rng(0)
    for number in range(40):
        mutated = bytearray(whole[: rng.integers(len(whole))] if number % 2 else whole)
        for place in rng.integers(min(len(mutated), 400), size=4) if mutated else ():
            mutated[place] = rng.integers(256)
        (tmp_path / f"mutated-{name}").write_bytes(mutated)
        with contextlib.suppress(ChdstatError):
            chd.io.read(tmp_path / f"mutated-{name}", axes="syxc").read(ss=slice(1))
