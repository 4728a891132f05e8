"""Stacks of EXR images: samples in their order, layers as features, averages known as such."""

import contextlib

import numpy as np
import OpenEXR
import pytest

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, StoreError
from chdstat.io import frames

IMAGES = np.random.default_rng(3).gamma(0.5, size=(130, 7, 9, 3)).astype(np.float32)
RADIANCE = np.moveaxis(IMAGES, 0, -1)
ALBEDO = np.random.default_rng(4).random((130, 7, 9, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """Return a folder of images of one sample each, with layers."""
    folder = tmp_path_factory.mktemp("stack")
    for number, (image, albedo) in enumerate(zip(IMAGES, ALBEDO, strict=True)):
        layers = {"albedo": albedo, "A": albedo[..., 0], "depth": albedo[..., 1]}
        chd.io.write_exr(folder / f"{number:04}.exr", image, extra=layers)
    return folder


def written(path, parts):
    """Write a file of parts: name, header, channels."""
    layout = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    found = [
        OpenEXR.Part(layout | header, {n: np.ascontiguousarray(p) for n, p in planes.items()}, name)
        for name, header, planes in parts
    ]
    OpenEXR.File(found).write(str(path))


def test_each_file_is_a_sample(stack, tmp_path):
    samples = chd.io.read(stack)
    assert np.array_equal(samples.read(), RADIANCE)
    part = slice(1, 5, 2), slice(2, 9), slice(60, 129, 7)
    assert np.array_equal(samples.read(*part), RADIANCE[part[0], part[1], :, part[2]])
    assert samples.attrs.get("averaged", 1) == 1
    assert np.array_equal(samples.save(tmp_path / "x.zarr").read(), RADIANCE)


def test_what_was_decoded_before_may_be_gone(stack, monkeypatch):
    monkeypatch.setattr(frames, "_KEPT", 1)
    samples = chd.io.read(stack, features={"albedo": "albedo"})
    for ss in (slice(0, 10), slice(128, 130), slice(None), slice(3, 4)):
        assert np.array_equal(samples.read(ss=ss), RADIANCE[..., ss])
    np.testing.assert_allclose(samples.features["albedo"], ALBEDO.mean(axis=0), rtol=1e-6)


def test_features_are_averages_of_layers(stack):
    found = chd.io.read(stack, features={"albedo": "albedo", "depth": "depth"}).features
    np.testing.assert_allclose(found["albedo"], ALBEDO.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found["depth"], ALBEDO[..., 1].mean(axis=0), rtol=1e-6)


def test_the_samples_may_be_a_layer(stack):
    assert np.array_equal(
        chd.io.read(stack, variable="depth").read()[:, :, 0, 7], ALBEDO[7, ..., 1]
    )
    found = chd.io.read(stack, variable="albedo").read()
    assert np.array_equal(found, np.moveaxis(ALBEDO, 0, -1))


def test_parts_are_layers(tmp_path):
    half = IMAGES[:2].astype(np.float16)
    for number, image in enumerate(half):
        beauty = dict(zip("RGB", np.moveaxis(image, -1, 0), strict=True))
        normal = dict(zip("XYZ", np.moveaxis(IMAGES[5], -1, 0), strict=True))
        written(tmp_path / f"{number}.exr", [("beauty", {}, beauty), ("N", {}, normal)])
    samples = chd.io.read(tmp_path, features={"normal": "N"})
    assert np.array_equal(samples.read(), np.moveaxis(half, 0, -1).astype(np.float32))
    assert np.array_equal(samples.features["normal"], IMAGES[5])


@pytest.mark.parametrize("name", ["samplesPerPixel", "cycles.View Layer.samples"])
def test_averages_are_known_by_what_renderers_write(tmp_path, name):
    count = 16 if name.startswith("samples") else "16"
    for number in range(2):
        one = [("one", {name: count}, {"Y": IMAGES[number, ..., 0]})]
        written(tmp_path / f"{number}.exr", one)
    samples = chd.io.read(tmp_path)
    assert samples.attrs.get("averaged", 1) == 16
    with pytest.raises(InputError, match="averages of 16"):
        chd.gaussianity(samples)
    assert chd.io.read(tmp_path, averaged=1).attrs["averaged"] == 1


def test_faults_are_named(stack, tmp_path):
    chd.io.write_exr(tmp_path / "small.exr", IMAGES[0, 1:])
    chd.io.write_exr(tmp_path / "grey.exr", IMAGES[0, ..., :1])
    for count in (4, 8):
        one = [("one", {"samplesPerPixel": count}, {"Y": IMAGES[0, ..., 0]})]
        written(tmp_path / f"of-{count}.exr", one)
    written(tmp_path / "other.exr", [("one", {}, {"u.P": IMAGES[0, ..., 0]})])
    first = stack / "0000.exr"
    cases = [
        ([first, tmp_path / "small.exr"], {}, InputError, r"small.exr has \(6, 9\) pixels"),
        ([first, tmp_path / "grey.exr"], {}, InputError, "has channels Y, but the first file R"),
        (
            [tmp_path / "of-4.exr", tmp_path / "of-8.exr"],
            {},
            InputError,
            "of-8.exr is an average of 8 samples, of-4.exr of 4",
        ),
        ([tmp_path / "other.exr"], {}, InputError, "as variable, one of u"),
        ([first], {"variable": "x"}, InputError, "has no layer 'x', but the channels"),
        ([first], {"features": {"normal": "x"}}, InputError, "has no layer 'x'"),
    ]
    for paths, options, error, told in cases:
        with pytest.raises(error, match=told):
            chd.io.read(*paths, **options).read()


def test_no_room_for_what_is_decoded_is_said(stack, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(frames.tempfile, "TemporaryFile", full)
    samples = chd.io.read(stack)
    with pytest.raises(StoreError, match="No space left on device; TMPDIR names another"):
        samples.read()


def test_hostile_files_are_refused(stack, tmp_path):
    whole, rng = (stack / "0000.exr").read_bytes(), np.random.default_rng(0)
    path = tmp_path / "x.exr"
    for number in range(40):
        mutated = bytearray(whole[: rng.integers(len(whole))] if number % 2 else whole)
        for place in rng.integers(min(len(mutated), 600), size=4) if mutated else ():
            mutated[place] = rng.integers(256)
        path.write_bytes(mutated)
        with contextlib.suppress(ChdstatError):
            assert chd.io.read(path).read().shape[3] == 1
