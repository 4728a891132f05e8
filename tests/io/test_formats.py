"""Formats of other programs: their bytes as the programs write them, and files that are none."""

import contextlib
import struct

import numcodecs
import numpy as np
import pytest
import zarr

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, StoreError

RADIANCE = np.random.default_rng(8).gamma(0.5, size=(6, 5, 3, 11)).astype(np.float32)


def rawls(path, image, *, samples=1, by_pixel=True):
    """Write as pbrt does, or as the Python package does."""
    height, width, channels = image.shape
    size = struct.pack("<3I", width, height, channels)
    spaced = b" ".join(size[i : i + 4] for i in (0, 4, 8))
    text = b"IHDR\n12\n" + (spaced if by_pixel else size) + b"\nCOMMENTS\n"
    text += b'#Samples %d\n#Filter box\n  #params "float xwidth"\n#Integrator path\n' % samples
    values = image.nbytes
    text += b"DATA\n" + (b"%d" % values if by_pixel else struct.pack("<i", values)) + b"\n"
    for row in image:
        lines = row if by_pixel else [row]
        text += b"".join(line.tobytes() + b"\n" for line in lines)
    path.write_bytes(text)


def bcd(path, radiance):
    height, width, channels, spp = radiance.shape
    header = np.array([1, width, height, spp, channels], "<i4")
    data = np.ascontiguousarray(np.moveaxis(radiance, -1, -2), "<f4")
    path.write_bytes(header.tobytes() + data.tobytes())


def write_rawls(folder):
    for number in range(RADIANCE.shape[3]):
        rawls(folder / f"{number:02}.rawls", RADIANCE[..., number])


def write_bcd(folder):
    bcd(folder / "x.raw", RADIANCE)


def noisebase(path, radiance, *, frames=None):
    """Write encoded radiance (y, x, channel, sample), and return what it stands for."""
    rng = np.random.default_rng(1)
    positive = np.log(radiance[radiance > 0])
    low, high = np.float32(positive.min()), np.float32(positive.max())
    brightest = np.log(np.maximum(radiance.max(axis=2), np.exp(low)))
    exponent = np.minimum((brightest - low) / (high - low) * 256, 255).astype(np.uint8)
    unit = np.exp((exponent.astype(np.float32) + 1) / 256 * (high - low) + low)[:, :, np.newaxis]
    colour = np.floor(radiance / unit * 255 + rng.random(radiance.shape)).astype(np.uint8)
    encoded = np.moveaxis(np.concatenate([colour, exponent[:, :, np.newaxis]], axis=2), 2, 0)
    vectors = np.moveaxis(radiance, 2, 0)
    arrays = {
        "color": encoded,
        "exposure": np.array([low, high]),
        "position": vectors,
        "normal": vectors.astype(np.float16),
        "diffuse": (vectors / 2).astype(np.float16),
    }
    with zarr.storage.ZipStore(path, mode="w") as store:
        group = zarr.create_group(store, zarr_format=2)
        for name, array in arrays.items():
            held = array if frames is None else np.stack([np.zeros_like(array)] * frames + [array])
            chunks = (*(1,) * (held.ndim - array.ndim), *array.shape[:-1], min(4, array.shape[-1]))
            group.create_array(
                name,
                data=held,
                chunks=chunks,
                compressors=numcodecs.Blosc(cname="lz4hc", clevel=9),
            )
    return colour / np.float32(255) * unit


def write_noisebase(folder):
    noisebase(folder / "x.zip", RADIANCE)


WRITERS = {"rawls": write_rawls, "bcd": write_bcd, "noisebase": write_noisebase}


@pytest.fixture(params=WRITERS)
def folder(request, tmp_path):
    (tmp_path / "files").mkdir()
    WRITERS[request.param](tmp_path / "files")
    return tmp_path / "files"


def test_samples_are_read_as_they_are(folder, tmp_path):
    samples = chd.io.read(folder)
    # Colours of noisebase have 8 bits.
    bound = {"atol": 0, "rtol": 0} if "zip" not in str(list(folder.iterdir())) else {"atol": 0.1}
    np.testing.assert_allclose(samples.read(), RADIANCE, **bound)
    part = slice(1, 5, 2), slice(2, 5), slice(3, 11, 4)
    whole = samples.read()
    assert np.array_equal(samples.read(*part), whole[part[0], part[1], :, part[2]])
    assert samples.attrs.get("averaged", 1) == 1
    assert np.array_equal(samples.save(tmp_path / "own.zarr").read(), whole)


def test_hostile_files_are_refused(folder, tmp_path):
    found = next(folder.iterdir())
    whole, rng = found.read_bytes(), np.random.default_rng(0)
    path = tmp_path / found.name
    for number in range(40):
        mutated = bytearray(whole[: rng.integers(len(whole))] if number % 2 else whole)
        for place in rng.integers(min(len(mutated), 150), size=3) if mutated else ():
            mutated[place] = rng.integers(256)
        path.write_bytes(mutated)
        with contextlib.suppress(ChdstatError):
            assert chd.io.read(path).read().shape[2] <= 4


def test_rawls_files_of_both_kinds_are_read(tmp_path):
    for by_pixel in (True, False):
        rawls(tmp_path / "x.rawls", RADIANCE[..., 0], samples=20, by_pixel=by_pixel)
        samples = chd.io.read(tmp_path / "x.rawls")
        assert np.array_equal(samples.read(), RADIANCE[..., :1])
        assert (samples.attrs["averaged"], samples.attrs["integrator"]) == (20, "path")


@pytest.mark.parametrize("frames", [None, 2])
def test_noisebase_is_decoded_as_it_is_encoded(tmp_path, frames):
    radiance = RADIANCE * (np.random.default_rng(0).random((*RADIANCE.shape[:2], 1, 11)) < 0.6)
    right = noisebase(tmp_path / "x.zip", radiance, frames=frames)
    samples = chd.io.read(tmp_path / "x.zip", variable=frames and str(frames))
    np.testing.assert_allclose(samples.read(), right, rtol=1e-5)
    assert np.array_equal(samples.read() == 0, right == 0)
    means = radiance.mean(axis=-1)
    np.testing.assert_allclose(samples.features["position"], means, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(samples.features["normal"], means, rtol=1e-2, atol=1e-5)
    np.testing.assert_allclose(samples.features["albedo"], means / 2, rtol=1e-2, atol=1e-5)


def test_alpha_of_bcd_is_left_out(tmp_path):
    bcd(tmp_path / "x.raw", np.concatenate([RADIANCE, RADIANCE[:, :, :1]], axis=2))
    assert np.array_equal(chd.io.read(tmp_path / "x.raw").read(), RADIANCE)


def test_faults_are_named(tmp_path):
    rawls(tmp_path / "x.rawls", RADIANCE[..., 0])
    rawls(tmp_path / "y.rawls", RADIANCE[1:, ..., 0])
    rawls(tmp_path / "z.rawls", RADIANCE[..., 0], samples=4)
    bcd(tmp_path / "x.raw", RADIANCE)
    (tmp_path / "cut.raw").write_bytes((tmp_path / "x.raw").read_bytes()[:-1])
    small, wide = struct.pack("<I", 5), struct.pack("<I", 2**31)
    large = (tmp_path / "x.rawls").read_bytes().replace(small, wide, 1)
    (tmp_path / "large.rawls").write_bytes(large)
    noisebase(tmp_path / "x.zip", RADIANCE)
    noisebase(tmp_path / "y.zip", RADIANCE, frames=2)
    with zarr.storage.ZipStore(tmp_path / "z.zip", mode="w") as store:
        group = zarr.create_group(store, zarr_format=2)
        group.create_array("color", shape=(4, 10**6, 10**6, 8), chunks=(4, 9, 9, 8), dtype="u1")
    cases = [
        (["x.zip", "y.zip"], {}, InputError, "one by one"),
        (["y.zip"], {"variable": "3"}, InputError, "has the frames 0 to 2"),
        (["x.zip"], {"features": {"depth": "z"}}, StoreError, "cannot read .* 'z'"),
        (["x.zip"], {"features": {"depth": "exposure"}}, InputError, "must hold numbers of shape"),
        (["z.zip"], {}, StoreError, r"cannot hold the 3.2e\+13"),
        (["x.rawls", "y.rawls"], {}, InputError, r"y.rawls holds averages of 1 samples of shape"),
        (["x.rawls", "z.rawls"], {}, InputError, r"z.rawls holds averages of 4 samples"),
        (["large.rawls"], {}, StoreError, "cannot hold 2147483648 x 6 pixels"),
        (["cut.raw"], {}, StoreError, "its header claims 5 x 6 pixels of 11 samples"),
        (["x.raw"], {"features": {"albedo": "a"}}, InputError, "come without features"),
        (["x.rawls"], {"variable": "a"}, InputError, "leave variable out"),
    ]
    for names, options, error, told in cases:
        with pytest.raises(error, match=told):
            chd.io.read(*(tmp_path / name for name in names), **options)
