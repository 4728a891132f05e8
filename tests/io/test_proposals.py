"""What a message of the readers proposes works: each proposal is followed here.

A case returns the message and what follows it. The last test holds them against all the messages in
the code.
"""

import ast
import re
import tempfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import xarray as xr

import chdstat as chd
from chdstat.errors import ChdstatError, InputWarning
from chdstat.io.writing import open_maps
from tests.io.writers import (
    WRITERS,
    bcd,
    block,
    deep,
    end,
    exr,
    netcdf,
    noisebase,
    planes_of,
    samples_block,
    start,
    stream,
)

RNG = np.random.default_rng(7)
X = RNG.gamma(0.5, size=(6, 9, 3, 32)).astype(np.float32)
IMAGE = X[..., 0]
SYXC = np.ascontiguousarray(np.moveaxis(X, -1, 0))


def refused(call, *arguments, **options):
    with pytest.raises(ChdstatError) as error:
        call(*arguments, **options)
    return str(error.value)


def told(call, *arguments, **options):
    with pytest.warns(InputWarning) as caught:
        call(*arguments, **options)
    return str(caught[0].message)


def quoted(message, pattern=r"'(\w+)'"):
    return re.findall(pattern, message)


# --- axes -----------------------------------------------------------------------------------------


def axes_of_arrays(folder, shape, *, from_file):
    """Follow each axes='...' of a message, in memory or from a file."""
    array = RNG.random(shape).astype(np.float32)
    if from_file:
        np.save(folder / "x.npy", array)
        call, arguments = chd.io.read, (folder / "x.npy",)
    else:
        call, arguments = chd.Samples.from_array, (array,)
    message = refused(call, *arguments)
    proposed = quoted(message)
    assert proposed
    for axes in proposed:
        found = call(*arguments, axes=axes)
        order = [axes.index(letter) for letter in "yxcs" if letter in axes]
        expected = array.transpose(order)
        np.testing.assert_array_equal(found.read().squeeze(), expected.squeeze())
    return message


AXES = [
    (6, 9, 32, 3),
    (32, 6, 9, 3),
    (3, 6, 9, 32),
    (32, 3, 6, 9),
    (7, 9, 8, 6),
    (6, 9, 3),
    (2, 9, 8, 1),
]


@pytest.mark.parametrize("from_file", [False, True])
@pytest.mark.parametrize("shape", AXES)
def test_axes_that_are_proposed_are_taken(tmp_path, shape, from_file):
    axes_of_arrays(tmp_path, shape, from_file=from_file)


@pytest.mark.parametrize("shape", [(4,), (5, 6), (2, 3, 4, 5, 6), (0, 4, 3, 8)])
def test_no_axes_are_proposed_where_there_are_none(tmp_path, shape):
    np.save(tmp_path / "x.npy", np.ones(shape))
    for call, given in (
        (chd.io.read, tmp_path / "x.npy"),
        (chd.Samples.from_array, np.ones(shape)),
    ):
        for options in ({}, {"axes": "yxcs"}):
            assert "'yx" not in refused(call, given, **options).replace("got 'yxcs'", "")


def letters(folder):
    message = refused(chd.Samples.from_array, X, axes="yxc")
    assert chd.Samples.from_array(X.swapaxes(2, 3), axes=quoted(message)[0]).shape == X.shape
    message = refused(chd.Samples.from_array, X[:, :, 0], axes="yxcs")
    assert chd.Samples.from_array(X[:, :, 0], axes=quoted(message)[0]).shape == (6, 9, 1, 32)
    return message


def plausible(folder):
    return axes_of_arrays(folder, (7, 9, 8, 6), from_file=False)


def one_channel(folder):
    return axes_of_arrays(folder, (6, 9, 3), from_file=False)


def named_dims(folder):
    array = xr.DataArray(X, dims=("y", "x", "channel", "sample"))
    message = refused(chd.Samples.from_array, array, axes="yxcs")
    assert chd.Samples.from_array(array).shape == X.shape
    return message


def small_range(folder, power):
    return refused(chd.Samples.from_array, X.astype(float) * 10.0**power)


def scaled(folder):
    for power in (-50, -80, -200, 40, 90, 250):
        message = small_range(folder, power)
        factor = float(re.search(r"such as by (1e[-+\d]+)", message)[1])
        found = chd.Samples.from_array(X.astype(float) * 10.0**power * factor).read()
        assert np.isfinite(found).all()
        assert (found != 0).all()
    return message


def zeroed(folder):
    x = X.astype(float)
    x[0, 0] = 1e-200
    message = refused(chd.Samples.from_array, x)
    chd.Samples.from_array(np.where(x < 1e-44, 0, x))
    return message


def scaled_and_zeroed(folder):
    x = X.astype(float)
    x[0, 0], x[1, 1] = 1e-200, 1e100
    message = refused(chd.Samples.from_array, x)
    y = x * float(re.search(r"by (1e[-+\d]+)", message)[1])
    chd.Samples.from_array(np.where(y < 1e-44, 0, y))
    return message


def counts(folder):
    number = np.full((6, 9), 7)
    message = refused(chd.Samples.from_array, X, features={"counts": number})
    assert chd.Samples.from_array(X, counts=number).counts.sum() == number.sum()
    return message


# --- readers --------------------------------------------------------------------------------------


def options_that_are_not_taken(folder):
    np.save(folder / "a.npy", X)
    np.save(folder / "f.npy", IMAGE)
    exr(folder / "b.exr", planes_of(IMAGE))
    noisebase(folder / "c.zip", X)
    bcd(folder / "d.raw", X)
    stream(folder / "e.chds", X)
    choices = {"axes": "yxsc", "variable": "x", "features": {"albedo": "albedo"}}
    wrong = {
        "a.npy": ("variable", "features"),
        "b.exr": ("axes",),
        "c.zip": ("axes",),
        "d.raw": ("axes", "variable", "features"),
        "e.chds": ("axes", "variable"),
    }
    for name, options in wrong.items():
        for option in options:
            message = refused(chd.io.read, folder / name, **{option: choices[option]})
            assert f"leave {option} out" in message
            found = chd.io.read(folder / name, **({"axes": "yxcs"} if name == "a.npy" else {}))
            if option == "features" and name == "a.npy":
                for feature in (IMAGE, folder / "f.npy"):
                    found = chd.io.read(folder / name, features={"albedo": feature})
                    assert np.array_equal(found.features["albedo"], IMAGE)
                told_of_features = message
    return told_of_features


def other_suffixes(folder):
    """Each file of a format is read under another name, where the format is named."""
    files = {}
    for name, (suffix, write) in WRITERS.items():
        write(folder / f"{name}{suffix}", X[..., :2])
        found = folder / f"{name}{suffix}"
        found = min(found.iterdir()) if found.is_dir() else found
        files[name] = found.rename(folder / f"{name}.x")
    message = refused(chd.io.read, files["bcd"])
    proposed = re.findall(r"(\w+) \(\.", message)
    assert sorted(proposed) == sorted(files)
    for name in proposed:
        axes = {"axes": "yxcs"} if name in ("npy", "npz") else {}
        assert chd.io.read(files[name], format=name, **axes).spp >= 1
    return message


def several_kinds(folder):
    exr(folder / "0.exr", planes_of(IMAGE))
    exr(folder / "1.exr", planes_of(IMAGE * 2))
    (folder / "notes.txt").write_text("rendered on Monday")
    message = refused(chd.io.read, folder)
    assert chd.io.read(*sorted(folder.glob("*.exr"))).spp == 2
    return message


def twice(folder):
    path, other = (
        exr(folder / "0.exr", planes_of(IMAGE)),
        exr(folder / "1.exr", planes_of(X[..., 1])),
    )
    message = told(chd.io.read, path, other, path)
    assert chd.io.read(path, other).spp == 2
    return message


def copies(folder):
    x = X.copy()
    x[..., 4] = x[..., 2]
    message = told(chd.Samples.from_array, x)
    copy = int(re.search(r": pass (\d+) of", message)[1])
    assert chd.Samples.from_array(np.delete(x, copy, axis=-1)).spp == 31
    return message


def arrays_by_name(folder):
    np.savez(folder / "x.npz", light=X, dark=X * 2, name=np.array("kitchen"), n=np.arange(4))
    message = refused(chd.io.read, folder / "x.npz", variable="y")
    for name in message.partition("but ")[2].split(", "):
        assert chd.io.read(folder / "x.npz", variable=name).shape == X.shape
    return message


def hdf5(folder):
    (folder / "x.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    message = refused(chd.io.read, folder / "x.nc")
    assert "engine" not in message  # what xarray proposes has no place here
    netcdf(folder / "x.nc", X)
    data = xr.Dataset({"light": (("y", "x", "channel", "sample"), X)})
    data.to_zarr(folder / "x.zarr", consolidated=False)
    for name in ("x.nc", "x.zarr"):
        assert np.array_equal(chd.io.read(folder / name).read(), X)
    return message


def frames_of_noisebase(folder):
    noisebase(folder / "x.zip", X, frames=2)
    message = refused(chd.io.read, folder / "x.zip", variable="3")
    first, last = re.search(r"frames (\d) to (\d)", message).groups()
    for number in (first, last):
        assert chd.io.read(folder / "x.zip", variable=number).spp == 32
    return message


def noisebase_one_by_one(folder):
    for name in "ab":
        noisebase(folder / f"{name}.zip", X)
    message = refused(chd.io.read, folder)
    assert [chd.io.read(file).spp for file in folder.iterdir()] == [32, 32]
    return message


# --- EXR ------------------------------------------------------------------------------------------


def layers(folder):
    names = {"diffuse": IMAGE, "gloss.direct": IMAGE * 2}
    planes = {
        k: v for n, image in names.items() for k, v in planes_of(image, prefix=f"{n}.").items()
    }
    planes |= {"N.X": IMAGE[..., 0].copy(), "id": np.ones((6, 9), np.uint32)}
    exr(folder / "x.exr", planes)
    message = refused(chd.io.read, folder / "x.exr")
    proposed = message.partition("one of ")[2].split(", ")
    assert proposed == ["diffuse", "gloss.direct"]
    for name in proposed:
        assert np.array_equal(
            chd.io.read(folder / "x.exr", variable=name).read()[..., 0], names[name]
        )
    return message


def layers_of_other_names(folder):
    exr(folder / "x.exr", {"u.P": IMAGE[..., 0].copy(), "v": IMAGE[..., 1].copy()})
    message = refused(chd.io.read, folder / "x.exr")
    for name in message.partition("one of ")[2].split(", "):
        assert chd.io.read(folder / "x.exr", variable=name).shape == (6, 9, 1, 1)
    return message


def channels_by_name(folder):
    path = exr(folder / "x.exr", planes_of(IMAGE) | {"Z": IMAGE[..., 0].copy()})
    message = refused(chd.io.read, path, variable="depth")
    for name in message.partition("but the channels ")[2].split(", "):
        assert chd.io.read(path, variable=name).shape == (6, 9, 1, 1)
    return message


def features_of_a_stream(folder):
    content = start(90, 70, 3, b"albedo") + samples_block(0, 0, {(0, 0): X[0, 0].T}) + end(32)
    (folder / "x.chds").write_bytes(content)
    message = refused(chd.io.read, folder / "x.chds", features={"albedo": "a"})
    name = message.rpartition("it has ")[2]
    assert "albedo" in chd.io.read(folder / "x.chds", features={"albedo": name}).features
    return message


def layers_of_an_image(folder):
    exr(folder / "x.exr", planes_of(IMAGE, prefix="a.") | planes_of(IMAGE * 2, prefix="b."))
    message = refused(chd.io.read_exr, folder / "x.exr")
    for scale, name in enumerate(message.partition("out of ")[2].split(", "), 1):
        image = chd.io.read_exr(folder / "x.exr", channels=[name]).image
        assert np.array_equal(image, IMAGE * scale)
    return message


def layers_of_a_feature(folder):
    path = exr(folder / "x.exr", planes_of(IMAGE, prefix="a.") | planes_of(IMAGE * 2, prefix="b."))
    np.save(folder / "x.npy", X)
    message = refused(chd.io.read, folder / "x.npy", features={"albedo": path})
    for name in message.partition("channels=) of ")[2].split(", "):
        image = chd.io.read_exr(path, channels=[name]).image
        assert "albedo" in chd.io.read(folder / "x.npy", features={"albedo": image}).features
    renamed = exr(
        folder / "y.exr", planes_of(IMAGE, prefix="albedo.") | planes_of(IMAGE * 2, prefix="b.")
    )
    found = chd.io.read(folder / "x.npy", features={"albedo": renamed}).features["albedo"]
    assert np.array_equal(found, IMAGE)
    return message


def luminance_and_chroma(folder):
    y = X[:, :8, 0, 0].copy()
    chroma = {n: OpenEXR.Channel(n, y, 2, 2) for n in ("RY", "BY")}
    path = exr(folder / "x.exr", {"Y": y} | chroma)
    message = refused(chd.io.read, path)
    assert "as variable" in message
    assert np.array_equal(chd.io.read(path, variable="Y").read()[:, :, 0, 0], y)
    assert "channels=" in refused(chd.io.read_exr, path)
    with pytest.warns(InputWarning, match="is left out"):
        assert np.array_equal(chd.io.read_exr(path, channels=["Y"]).image[..., 0], y)
    assert chd.io.read(exr(folder / "y.exr", planes_of(IMAGE))).spp == 1
    return message


def deep_images(folder):
    held, layout = deep((6, 9)), {"compression": OpenEXR.ZIPS_COMPRESSION}
    path = exr(folder / "x.exr", dict.fromkeys("RGB", held), kind=OpenEXR.deepscanline, **layout)
    message = refused(chd.io.read, path)
    flat = np.vectorize(np.sum)(held).astype(np.float32)
    assert chd.io.read(exr(folder / "y.exr", dict.fromkeys("RGB", flat))).spp == 1
    return message


def half(folder):
    image = (IMAGE + 7e4).astype(np.float32)
    path = exr(folder / "x.exr", planes_of(np.clip(image, 0, 65504).astype(np.float16)))
    message = told(chd.io.read, path)
    assert np.array_equal(
        chd.io.read(exr(folder / "y.exr", planes_of(image))).read()[..., 0], image
    )
    return message


def averages(folder):
    files = [exr(folder / f"{n}.exr", planes_of(X[..., n]), samplesPerPixel=n + 1) for n in (0, 1)]
    message = refused(chd.io.read, *files)
    assert [chd.io.read(file).spp for file in files] == [1, 1]
    return message


def temporary_folder(folder):
    files = [exr(folder / f"{n}.exr", planes_of(X[..., n])) for n in (0, 1)]
    (folder / "elsewhere").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder / "nowhere"))
        message = refused(chd.io.read(*files).read)
        patch.setattr(tempfile, "tempdir", None)
        patch.setenv("TMPDIR", str(folder / "elsewhere"))
        assert chd.io.read(*files).read().shape == (6, 9, 3, 2)
        assert tempfile.gettempdir() == str(folder / "elsewhere")
    return message


# --- writing and denoising ------------------------------------------------------------------------


def write_exr(folder, image=IMAGE, **options):
    return chd.io.write_exr(folder / "x.exr", image, **options)


def denoise(_, **features):
    return chd.io.denoise(np.ones((64, 64, 3)), **features)


ONES = np.ones((64, 64, 3), np.float32)
OPTIONS = {
    "channel names": (write_exr, {"image": X[:, :, :2, 0]}, {"channels": ["u", "v"]}),
    "second channel": (
        write_exr,
        {"extra": {"R": IMAGE[..., 0]}},
        {"extra": {"red": IMAGE[..., 0]}},
    ),
    "header names": (write_exr, {"attributes": {"name": "a"}}, {"attributes": {"title": "a"}}),
    "normals beside albedo": (denoise, {"normal": ONES}, {"albedo": ONES}),
}
"""Calls, options that are refused, and what is changed or added after the message."""


def other_options(folder):
    heard = []
    for call, wrong, right in OPTIONS.values():
        heard.append(refused(call, folder, **wrong))
        assert PROPOSES.search(heard[-1])
        call(folder, **{**wrong, **right})
    return "; ".join(heard)


def too_large(folder):
    options = {"pixel_type": "half"}
    message = refused(chd.io.write_exr, folder / "x.exr", IMAGE + 7e4, **options)
    most = float(re.search("at most ([0-9.e+]+)", message)[1])
    with pytest.warns(InputWarning, match="half"):
        chd.io.read_exr(chd.io.write_exr(folder / "x.exr", np.full_like(IMAGE, most), **options))
    return message


def maps_of_a_store(folder):
    store = chd.Samples.from_array(X).save(folder / "x.zarr")
    message = refused(open_maps, store.path)
    found = chd.summarize(store)
    found.to_zarr(folder / "maps.zarr", consolidated=False)
    assert "mean" in open_maps(folder / "maps.zarr")
    return message


def another_seed(folder):
    def stream(name, seed):
        content = start(90, 70) + block(3, b"seed", seed)
        (folder / name).write_bytes(content + samples_block(0, 0, {(0, 0): X[0, 0].T}) + end(32))
        return folder / name

    first = stream("a.chds", b"1")
    message = refused(chd.io.read, first, stream("b.chds", b"1"))
    assert chd.io.read(first, stream("c.chds", b"2")).counts.max() == 64
    return message


CASES = [
    *(letters, plausible, one_channel, named_dims, scaled, zeroed, scaled_and_zeroed, counts),
    *(options_that_are_not_taken, other_suffixes, several_kinds, twice, copies, arrays_by_name),
    *(hdf5, frames_of_noisebase, noisebase_one_by_one, layers, layers_of_other_names),
    *(layers_of_an_image, layers_of_a_feature, luminance_and_chroma, deep_images, half, averages),
    *(channels_by_name, features_of_a_stream),
    *(temporary_folder, other_options, too_large, maps_of_a_store, another_seed),
]
PROPOSES = re.compile(
    r"\b([Gg]ive|[Ll]eave|[Nn]ame (one|those|the)|[Rr]ead (it|them|those|one)|[Ww]rite (it|float)|"
    r"[Ss]cale|rename|choose|[Rr]ender|flatten|TMPDIR|take them|must (be at most|name)|needs a|"
    r"say what|but the channels|no feature|pip install)\b"
)
CANNOT_BE_RUN = {
    "install it anew with: pip install --force-reinstall pyoidn": "installs a package",
    "is damaged or cut off; write or copy it again": "of damage",
    "render a part of them": "needs more pixels than memory holds",
    "Each pass needs a seed of its own": "is what all other passes here have",
    "read them in parts, such as read(ys, xs)": "needs more samples than memory holds",
    "summarize and contrast take them": "is followed in tests of dependent samples",
}


def test_every_proposal_in_the_code_is_followed_here(tmp_path):
    heard = []
    for case in CASES:
        (tmp_path / case.__name__).mkdir()
        heard.append(case(tmp_path / case.__name__))
        assert PROPOSES.search(heard[-1]) or case is arrays_by_name, case.__name__
    package = Path(chd.__file__).parent
    files = [*sorted((package / "io").glob("*.py"))]
    files += [package / "samples" / name for name in ("samples.py", "dependence.py")]
    followed, missing = [*heard, *CANNOT_BE_RUN], []
    for file in files:
        tree = ast.parse(file.read_text(encoding="utf-8"))
        silent = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        texts = [
            n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and id(n) not in silent
        ]
        proposals = [t for t in texts if isinstance(t, str) and PROPOSES.search(t)]
        missing += [t for t in proposals if not any(t in h or h in t for h in followed)]
    assert not missing
