"""What a message of the readers proposes works: each proposal is followed here."""

import re
import sys

import numpy as np
import OpenEXR
import pytest

import chdstat as chd
from chdstat.errors import ChdstatError
from chdstat.io.reading import FORMATS
from tests.io.writers import WRITERS, end, exr, netcdf, planes_of, samples_block, start

RNG = np.random.default_rng(7)
X = RNG.gamma(0.5, size=(6, 9, 3, 32)).astype(np.float32)
IMAGE = X[..., 0]
GREY = IMAGE[..., 0].copy()


def refused(call, *arguments, **options):
    """Return the message of an error."""
    with pytest.raises(ChdstatError) as error:
        call(*arguments, **options)
    return str(error.value)


# --- arrays ---------------------------------------------------------------------------------------

SHAPES = [
    *((6, 9, 32, 3), (32, 6, 9, 3), (3, 6, 9, 32), (32, 3, 6, 9)),
    *((7, 9, 8, 6), (6, 9, 3), (2, 9, 8, 1)),
]


@pytest.mark.parametrize("from_file", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_axes_that_are_proposed_are_taken(tmp_path, shape, from_file):
    array = RNG.random(shape).astype(np.float32)
    call, given = chd.Samples.from_array, array
    if from_file:
        np.save(tmp_path / "x.npy", array)
        call, given = chd.io.read, tmp_path / "x.npy"
    proposed = re.findall(r"'(\w+)'", refused(call, given))
    assert proposed
    for axes in proposed:
        order = [axes.index(letter) for letter in "yxcs" if letter in axes]
        found = call(given, axes=axes).read().squeeze()
        np.testing.assert_array_equal(found, array.transpose(order).squeeze())


@pytest.mark.parametrize("shape", [(4,), (5, 6), (2, 3, 4, 5, 6), (0, 4, 3, 8)])
def test_no_axes_are_proposed_where_there_are_none(shape):
    for options in ({}, {"axes": "yxcs"}):
        message = refused(chd.Samples.from_array, np.ones(shape), **options)
        assert "'yx" not in message.replace("got 'yxcs'", "")


@pytest.mark.parametrize("power", [-50, -80, -200, 40, 90, 250])
def test_radiance_is_scaled_as_proposed(power):
    x = X.astype(float) * 10.0**power
    message = refused(chd.Samples.from_array, x)
    factor = float(re.search(r"such as by (1e[-+\d]+)", message)[1])
    found = chd.Samples.from_array(x * factor).read()
    assert np.isfinite(found).all()
    assert (found != 0).all()


@pytest.mark.parametrize("largest", [1.0, 1e100])
def test_what_is_too_small_becomes_0_as_proposed(largest):
    x = X.astype(float)
    x[0, 0], x[1, 1] = 1e-200, largest
    message = refused(chd.Samples.from_array, x)
    assert "give 0" in message
    if factor := re.search(r"by (1e[-+\d]+)", message):
        x *= float(factor[1])
    chd.Samples.from_array(np.where(x < 1e-44, 0, x))


# --- files ----------------------------------------------------------------------------------------


def layers(**images):
    return {
        k: v for n, image in images.items() for k, v in planes_of(image, prefix=f"{n}.").items()
    }


def stream_of_albedo(path):
    block = samples_block(0, 0, {(0, 0): X[0, 0].T})
    path.write_bytes(start(90, 70, 3, b"albedo") + block + end(32))


CHROMA = {n: OpenEXR.Channel(n, X[:, :8, 0, 0].copy(), 2, 2) for n in ("RY", "BY")}
FILES = {
    "x.npy": lambda path: np.save(path, X),
    "x.npz": lambda path: np.savez(path, light=X, dark=2 * X, n=np.arange(4)),
    "x.chds": stream_of_albedo,
    "x.exr": lambda path: exr(path, planes_of(IMAGE) | {"Z": GREY}),
    "two.exr": lambda path: exr(path, layers(diffuse=IMAGE, gloss=2 * IMAGE) | {"N.X": GREY}),
    "odd.exr": lambda path: exr(path, {"u.P": GREY, "v": GREY}),
    "chroma.exr": lambda path: exr(path, {"Y": X[:, :8, 0, 0].copy()} | CHROMA),
}


@pytest.mark.parametrize(
    ("name", "wrong", "told", "right"),
    [
        ("x.npy", {"variable": "a"}, "leave variable out", {"axes": "yxcs"}),
        (
            "x.npy",
            {"features": {"depth": "a"}},
            "as arrays or files",
            {"features": {"depth": GREY}},
        ),
        ("x.npz", {"variable": "y"}, "but light, dark", {"variable": "dark"}),
        ("x.chds", {"axes": "yxsc"}, "leave axes out", {}),
        (
            "x.chds",
            {"features": {"albedo": "a"}},
            "it has albedo",
            {"features": {"albedo": "albedo"}},
        ),
        ("x.exr", {"axes": "yxsc"}, "leave axes out", {}),
        ("x.exr", {"variable": "depth"}, "but the channels B, G, R, Z", {"variable": "Z"}),
        ("two.exr", {}, "as variable, one of diffuse, gloss$", {"variable": "gloss"}),
        ("odd.exr", {}, "as variable, one of u, v$", {"variable": "u"}),
        ("chroma.exr", {}, "give the layer of the samples as variable.* Y", {"variable": "Y"}),
    ],
)
def test_a_file_is_read_as_proposed(tmp_path, name, wrong, told, right):
    FILES[name](tmp_path / name)
    assert re.search(told, refused(chd.io.read, tmp_path / name, **wrong))
    assert chd.io.read(tmp_path / name, **right).spp in (1, 32)


def test_layers_are_proposed(tmp_path):
    path = exr(tmp_path / "x.exr", layers(a=IMAGE, b=2 * IMAGE))
    assert refused(chd.io.read_exr, path).endswith("channels=, out of a, b")
    assert np.array_equal(chd.io.read_exr(path, channels=["b"]).image, 2 * IMAGE)
    np.save(tmp_path / "x.npy", X)
    message = refused(chd.io.read, tmp_path / "x.npy", features={"albedo": path})
    assert message.endswith("rename one to albedo, or give features the array of "
                            "read_exr(..., channels=) of a, b")  # fmt: skip
    renamed = exr(tmp_path / "y.exr", layers(albedo=IMAGE, b=2 * IMAGE))
    found = chd.io.read(tmp_path / "x.npy", features={"albedo": renamed}).features["albedo"]
    assert np.array_equal(found, IMAGE)


def test_a_format_is_named_where_the_suffix_is_another(tmp_path):
    for name, (suffix, write) in WRITERS.items():
        found = tmp_path / f"{name}{suffix}"
        write(found, X[..., :2])
        found = min(found.iterdir()) if found.is_dir() else found
        other = found.rename(tmp_path / f"{name}.x")
        message = refused(chd.io.read, other)
        assert name in re.findall(r"(\w+) \(\.", message)
        takes = next(known.takes for known in FORMATS if known.name == name)
        axes = {"axes": "yxcs"} if "axes" in takes else {}
        assert chd.io.read(other, format=name, **axes).spp >= 1


def test_what_is_no_path_or_too_long_for_one_is_told(tmp_path):
    np.save(tmp_path / "x.npy", X)
    assert "one by one as in read(*files)" in refused(chd.io.read, [tmp_path / "x.npy"])
    assert "no file or folder at 'xxx" in refused(chd.io.read, "x" * 5000)
    assert "only stores of samples may lie behind URLs" in refused(chd.io.read, "https://a.b/x.npy")


def test_files_that_do_not_fit_are_read_apart(tmp_path):
    files = [
        exr(tmp_path / f"{n}.exr", planes_of(X[..., n]), samplesPerPixel=n + 1) for n in (0, 1)
    ]
    assert "is an average of 2 samples, 0.exr of 1: read them apart" in refused(chd.io.read, *files)
    (tmp_path / "notes.txt").write_text("rendered on Monday")
    assert "several kinds, .exr, .txt: read those of one" in refused(chd.io.read, tmp_path)


def test_hdf5_asks_for_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "x.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    message = refused(chd.io.read, tmp_path / "x.nc")
    assert "pip install h5py, or write it as netCDF 3 or zarr" in message
    netcdf(tmp_path / "x.nc", X)
    assert np.array_equal(chd.io.read(tmp_path / "x.nc").read(), X)
