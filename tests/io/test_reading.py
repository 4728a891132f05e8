"""Samples read from files: every axis in its place, features, counts, provenance, and faults.

What messages propose is followed in `test_proposals`.
"""

import contextlib
import gc
import os
import runpy
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, StoreError
from chdstat.io import sources
from chdstat.io.reading import FORMATS
from chdstat.viz import tonemap
from tests.io.writers import WRITERS, exr

FRAMES = np.random.default_rng(5).gamma(2.0, size=(40, 6, 9, 3)).astype(np.float32)
RADIANCE = np.moveaxis(FRAMES, 0, -1)
IMAGES = np.random.default_rng(3).gamma(0.5, size=(130, 7, 9, 3)).astype(np.float32)
ALBEDO = np.random.default_rng(4).random((130, 7, 9, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """Return a folder of images of one sample each, with layers."""
    folder = tmp_path_factory.mktemp("stack")
    for number, (image, albedo) in enumerate(zip(IMAGES, ALBEDO, strict=True)):
        layers = {"albedo": albedo, "A": albedo[..., 0], "depth": albedo[..., 1]}
        chd.io.write_exr(folder / f"{number:04}.exr", image, extra=layers)
    return folder


def refused(cases, folder):
    """Check that files, read with options, are refused by an error that tells something."""
    for names, options, error, told in cases:
        with pytest.raises(error, match=told):
            chd.io.read(*(folder / name for name in names), **options).read()


# --- every format ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", WRITERS)
def test_samples_are_read_as_they_are(tmp_path, name):
    suffix, write = WRITERS[name]
    write(tmp_path / f"x{suffix}", RADIANCE)
    samples = chd.io.read(tmp_path / f"x{suffix}")
    assert samples.shape == RADIANCE.shape
    assert np.array_equal(samples.read(), RADIANCE)
    part = slice(1, 5, 2), slice(2, 9), slice(3, 40, 5)
    assert np.array_equal(samples.read(*part), RADIANCE[part[0], part[1], :, part[2]])
    assert samples.attrs.get("averaged", 1) == 1
    saved = samples.save(tmp_path / "own.zarr")
    assert np.array_equal(saved.read(), RADIANCE)
    assert saved.attrs["scene"] == samples.attrs["scene"]


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.filterwarnings("ignore::chdstat.errors.InputWarning")
def test_hostile_files_are_refused(tmp_path, name):
    suffix, write = WRITERS[name]
    write(tmp_path / f"x{suffix}", RADIANCE[..., :4])
    found = tmp_path / f"x{suffix}"
    found = next(found.iterdir()) if found.is_dir() else found
    whole, rng = found.read_bytes(), np.random.default_rng(0)
    path = tmp_path / f"mutated{found.suffix}"
    for number in range(40):
        mutated = bytearray(whole[: rng.integers(len(whole))] if number % 2 else whole)
        for place in rng.integers(min(len(mutated), 400), size=4) if mutated else ():
            mutated[place] = rng.integers(256)
        path.write_bytes(mutated)
        with contextlib.suppress(ChdstatError), warnings.catch_warnings(action="ignore"):
            assert chd.io.read(path).read().ndim == 4
    with warnings.catch_warnings(action="ignore"):
        gc.collect()  # SciPy leaves what it cannot read open, which would fail some later test


def test_every_reader_says_its_fate():
    assert {known.name for known in FORMATS} == WRITERS.keys()
    docs = Path(__file__).parents[2] / "docs"
    fate = runpy.run_path(str(docs / "_ext" / "formats.py"))["fate"]
    for known in FORMATS:
        assert [*fate(known)] == ["Read", "Converted", "Warned of", "Ignored", "Refused"]
        assert all(text.endswith(".") for text in fate(known).values())
    page = (docs / "reference" / "formats.rst").read_text(encoding="utf-8")
    assert ".. formats:: details" in page


# --- arrays ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", ["yxcs", "yxsc", "syxc", "scyx", "cxys"])
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_axes_are_brought_in_order(tmp_path, axes, suffix):
    array = RADIANCE.transpose(["yxcs".index(a) for a in axes])
    (np.save if suffix == ".npy" else np.savez)(tmp_path / f"x{suffix}", array)
    assert np.array_equal(chd.io.read(tmp_path / f"x{suffix}", axes=axes).read(), RADIANCE)


def test_one_channel_and_zarr_dims_are_read(tmp_path):
    np.save(tmp_path / "x.npy", RADIANCE[:, :, 0])
    assert np.array_equal(chd.io.read(tmp_path / "x.npy").read(), RADIANCE[:, :, :1])
    dataset = xr.Dataset({"light": (("sample", "y", "x", "channel"), FRAMES)})
    dataset.to_zarr(tmp_path / "x.zarr", consolidated=False)
    assert np.array_equal(chd.io.read(tmp_path / "x.zarr").read(), RADIANCE)


def test_arrays_of_zarr_need_no_names_of_dims(tmp_path):
    zarr.save_array(tmp_path / "array.zarr", FRAMES)
    zarr.open_group(tmp_path / "group", mode="w").create_array("light", data=FRAMES)
    for path in tmp_path.iterdir():
        assert np.array_equal(chd.io.read(path, axes="syxc").read(), RADIANCE)
    chd.Samples.from_array(RADIANCE).save(tmp_path / "own.zarr")
    with pytest.raises(InputError, match=r"own\.zarr.*chdstat\.open"):
        chd.io.read(tmp_path / "own.zarr")


def test_what_lies_beside_samples_is_left_out(tmp_path):
    np.savez(tmp_path / "x.npz", samples=RADIANCE, about=np.array([{"seed": 3}], object))
    with zipfile.ZipFile(tmp_path / "x.npz", "a") as archive:
        archive.writestr("notes.txt", "rendered on Monday")
    assert np.array_equal(chd.io.read(tmp_path / "x.npz").read(), RADIANCE)


def test_a_file_of_several_arrays_is_refused(tmp_path):
    with (tmp_path / "x.npy").open("wb") as file:
        np.save(file, RADIANCE)
        np.save(file, RADIANCE)
    with pytest.raises(StoreError, match="one array"):
        chd.io.read(tmp_path / "x.npy")
    (tmp_path / "x.npy").write_bytes(b"pickled or not")
    with pytest.raises(StoreError, match="magic string"):
        chd.io.read(tmp_path / "x.npy")


def test_files_are_read_from_where_they_were(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("x.npy", RADIANCE)
    chd.Samples.from_array(RADIANCE).save("x.zarr")
    opened = [chd.io.read("x.npy"), chd.open("x.zarr")]
    assert [repr(samples).split()[-1] for samples in opened] == ["x.npy>", "x.zarr>"]
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    for samples in opened:
        assert np.array_equal(samples.read(), RADIANCE)
    assert opened[1].path == tmp_path / "x.zarr"


def test_netcdf_says_its_unit(tmp_path):
    """Packed variables are rows of `test_layouts`."""
    light = (("sample", "y", "x", "channel"), FRAMES, {"units": "cd m-2"})
    xr.Dataset({"light": light}).to_netcdf(tmp_path / "x.nc", engine="scipy")
    assert chd.io.read(tmp_path / "x.nc").attrs["unit"] == "cd m-2"


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


def test_faults_of_arrays_are_named(tmp_path):
    (tmp_path / "bad.npy").write_bytes(b"no array")
    (tmp_path / "empty").mkdir()
    np.save(tmp_path / "bytes.npy", (FRAMES * 10).astype(np.uint8))
    np.save(tmp_path / "x.npy", FRAMES)
    np.save(tmp_path / "small.npy", FRAMES[:, 1:])
    np.savez(tmp_path / "x.npz", FRAMES)
    np.savez(tmp_path / "complex.npz", FRAMES * 1j)
    means = xr.Dataset({"mean": (("channel", "y", "x"), FRAMES[0].transpose(2, 0, 1))})
    means.to_zarr(tmp_path / "means.zarr", consolidated=False)
    os.mkfifo(tmp_path / "pipe.npy")
    cases = [
        (["bad.npy"], {}, StoreError, "cannot read"),
        (["empty"], {}, StoreError, "empty folder"),
        (["none.npy"], {}, StoreError, "no file or folder at"),
        (["pipe.npy"], {}, StoreError, "a pipe: write what it gives to a file"),
        (["complex.npz"], {}, StoreError, "no real numbers .*; its arrays: arr_0 complex64"),
        (["means.zarr"], {}, InputError, r"x and s \(sample\), .*; got 'cyx'"),
        (["bytes.npy"], {}, InputError, "unsigned integers"),
        (["x.npy", "small.npy"], {"axes": "syxc"}, InputError, "small.npy holds samples of shape"),
        (["x.npz"], {"axes": "syxc", "features": {"albedo": "a"}}, InputError, "no array 'a'"),
    ]
    refused(cases, tmp_path)


# --- the command ----------------------------------------------------------------------------------


def test_the_command_imports_and_appends(tmp_path, run):
    np.save(tmp_path / "x.npy", FRAMES)
    np.save(tmp_path / "y.npy", FRAMES + 1)
    where = ("-o", tmp_path / "own.zarr", "--axes", "syxc", "-q")
    line = ("import", tmp_path / "x.npy", *where, "--renderer", "mine 1.2", "--seed", "4")
    assert run(*line)[0] == 0
    assert run("import", tmp_path / "y.npy", *where, "--append", "--seed", "5")[0] == 0
    samples = chd.open(tmp_path / "own.zarr")
    assert np.array_equal(samples.read(ss=slice(40)), RADIANCE)
    assert np.array_equal(samples.read(ss=slice(40, 80)), RADIANCE + 1)
    assert samples.attrs["renderer"] == "mine 1.2"
    assert str(tmp_path) not in str(samples.attrs)
    assert samples.name == "x"


def test_frames_are_named_after_their_store(stack, tmp_path, run):
    frames = sorted(stack.glob("*.exr"))[:3]
    assert run("import", *frames, "-o", tmp_path / "kitchen.zarr", "-q")[0] == 0
    assert run("import", *frames, "-o", tmp_path / "own.zarr", "--scene", "attic", "-q")[0] == 0
    assert chd.open(tmp_path / "kitchen.zarr").name == "kitchen"
    assert chd.open(tmp_path / "own.zarr").name == "attic"


# --- stacks of EXR images -------------------------------------------------------------------------


def test_what_was_decoded_before_may_be_gone(stack, monkeypatch):
    monkeypatch.setattr(sources, "_KEPT", 1)
    samples = chd.io.read(stack, features={"albedo": "albedo"})
    for ss in (slice(0, 10), slice(128, 130), slice(None), slice(3, 4)):
        assert np.array_equal(samples.read(ss=ss), np.moveaxis(IMAGES, 0, -1)[..., ss])
    np.testing.assert_allclose(samples.features["albedo"], ALBEDO.mean(axis=0), rtol=1e-6)


def test_features_are_averages_of_layers(stack):
    found = chd.io.read(stack, features={"albedo": "albedo", "depth": "depth"}).features
    np.testing.assert_allclose(found["albedo"], ALBEDO.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found["depth"], ALBEDO[..., 1].mean(axis=0), rtol=1e-6)
    depth = chd.io.read(stack, variable="depth").read()
    assert np.array_equal(depth[:, :, 0], np.moveaxis(ALBEDO[..., 1], 0, -1))
    albedo = chd.io.read(stack, variable="albedo").read()
    assert np.array_equal(albedo, np.moveaxis(ALBEDO, 0, -1))


@pytest.mark.parametrize("name", ["samplesPerPixel", "cycles.View Layer.samples"])
def test_averages_are_known_by_what_renderers_write(tmp_path, name):
    count = 16 if name.startswith("samples") else "16"
    for number in range(2):
        exr(tmp_path / f"{number}.exr", {"Y": IMAGES[number, ..., 0]}, **{name: count})
    samples = chd.io.read(tmp_path)
    assert samples.attrs.get("averaged", 1) == 16
    with pytest.raises(InputError, match="averages of 16"):
        chd.gaussianity(samples)
    assert chd.io.read(tmp_path, averaged=1).attrs["averaged"] == 1


def test_faults_of_stacks_are_named(stack, tmp_path):
    chd.io.write_exr(tmp_path / "small.exr", IMAGES[0, 1:])
    chd.io.write_exr(tmp_path / "grey.exr", IMAGES[0, ..., :1])
    first = stack / "0000.exr"
    cases = [
        ([first, "small.exr"], {}, InputError, r"small.exr has \(6, 9\) pixels"),
        ([first, "grey.exr"], {}, InputError, "has channels Y, but the first file R"),
        ([first], {"features": {"normal": "x"}}, InputError, "has no layer 'x'"),
    ]
    refused(cases, tmp_path)


def test_no_room_for_what_is_decoded_is_said(stack, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(sources.tempfile, "TemporaryFile", full)
    with pytest.raises(StoreError, match="No space left.*TMPDIR"):
        chd.io.read(stack).read()


@pytest.mark.parametrize("kind", ["npz", "nc"])
def test_order_chooses_no_array(tmp_path, kind):
    diffuse, glossy = np.random.default_rng(0).random((2, 4, 5, 3, 8), dtype=np.float32)

    def read(variable=None, **arrays):
        path = tmp_path / f"both.{kind}"
        if kind == "npz":
            np.savez(path, **arrays)
        else:
            dims = {4: ("y", "x", "channel", "sample"), 3: ("y", "x", "sample")}
            xr.Dataset({n: (dims[a.ndim], a) for n, a in arrays.items()}).to_netcdf(path)
        return chd.io.read(path, variable=variable).read()

    with pytest.raises(InputError, match="diffuse, glossy"):
        read(diffuse=diffuse, glossy=glossy)
    assert (read("glossy", diffuse=diffuse, glossy=glossy) == glossy).all()
    assert (read(diffuse=diffuse, samples=glossy) == glossy).all()
    assert (read(diffuse=diffuse[:, :, 0], glossy=glossy) == glossy).all()


# --- images by the suffix of their file, and maps of results, by functions and command ------------


SMALL = np.random.default_rng(2).gamma(0.3, 3.0, size=(5, 6, 3, 24)).astype(np.float32)
SAMPLES = chd.Samples.from_array(SMALL, scene="x")


def test_maps_are_layers(tmp_path):
    found = chd.summarize(SAMPLES)
    image = chd.io.read_exr(chd.io.write_maps(found, tmp_path / "x.exr"))
    np.testing.assert_array_equal(image.image, found["mean"].to_numpy().astype(np.float32))
    variance = found["variance"].to_numpy().astype(np.float32)
    np.testing.assert_array_equal(image.extra["variance"], variance)
    assert image.attributes["image"] == "mean"
    with pytest.raises(InputError, match="map"):
        chd.io.write_maps(found.mean(["y", "x"]), tmp_path / "x.exr")


def test_results_are_netcdf(tmp_path):
    found = chd.summarize(SAMPLES)
    path = chd.io.write_netcdf(found, tmp_path / "x.nc")
    with xr.open_dataset(path) as again:
        assert set(again) == set(found)
        np.testing.assert_array_equal(again["mean"], found["mean"])
        assert list(again["channel"].to_numpy()) == ["R", "G", "B"]


def test_attributes_without_a_type_are_json(tmp_path):
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
        (store, "f.exr", "a reference of 48 batches needs as many samples"),
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
