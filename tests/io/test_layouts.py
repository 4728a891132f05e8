"""Arrays as zarr-python, xarray, h5py, h5netcdf and NumPy write them: equal to the bit, or refused.

``pytest -v tests/io/test_layouts.py`` prints the table, a layout in each line.
"""

import pickle
import re
import warnings
from functools import partial

import numpy as np
import pytest
import xarray as xr
import zarr
import zarr.codecs as to

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, InputWarning, StoreError

RNG = np.random.default_rng(17)
X = (RNG.gamma(0.7, size=(6, 9, 3, 24)) * (RNG.random((6, 9, 1, 24)) > 0.4)).astype(np.float32)
X[2, 3] = 0  # a black pixel
X[0, 0, :, :3] = 1, -1, 2**-140
ALBEDO = np.where(RNG.random((6, 9, 3)) > 0.5, 0, RNG.random((6, 9, 3))).astype(np.float32)
WHOLE = np.round(4 * X)  # whole numbers
GAPS = np.where(RNG.random(X.shape) < 0.1, np.float32(np.nan), WHOLE)
DIMS = ("y", "x", "channel", "sample")
OTHER = ("row", "col", "rgb", "frame")
SCALE, OFFSET = 2.0**-6, 0.5  # exact in every precision
PACKED = WHOLE * np.float32(SCALE)
SHIFTED = PACKED + np.float32(OFFSET)
PACK = {"scale_factor": SCALE, "dtype": "int16"}


# --- writers --------------------------------------------------------------------------------------


def by_zarr(path, x, *, form, dims=None, name="light", attrs=None, albedo=True, **options):
    """Write a group of arrays as zarr-python does."""
    group = zarr.open_group(path, mode="w", zarr_format=form)
    for at, data in {name: x, **({"albedo": ALBEDO} if albedo else {})}.items():
        how = options if at == name else {}
        named = {"dimension_names": dims[: data.ndim]} if dims and form == 3 else {}
        parent = group.require_group(at.rpartition("/")[0]) if "/" in at else group
        array = parent.create_array(at.rpartition("/")[2], data=data, **how, **named)
        if dims and form == 2:
            array.attrs["_ARRAY_DIMENSIONS"] = list(dims[: data.ndim])
        if at == name:
            array.attrs.update(attrs or {})


def lone(path, x, *, form, **options):
    zarr.create_array(path, data=x, zarr_format=form, **options)


def by_xarray(path, x, *, encoding=None, attrs=None, group=None, names=False, **options):
    """Write a dataset as xarray does, in the format of the suffix."""
    data = xr.Dataset({"light": (DIMS, x, attrs), "albedo": (DIMS[:3], ALBEDO)})
    if names:
        data = data.assign_coords(channel=["R", "G", "B"], sample=np.arange(x.shape[3]))
    encoding = {"light": encoding or {}}
    if path.suffix == ".zarr":
        data.to_zarr(path, group=group, encoding=encoding, **options)
    else:
        data.to_netcdf(path, group=group, encoding=encoding, **options)


def tree(path, x, **options):
    at = {"frames/left": xr.Dataset({"beauty": (DIMS, x)}), "features": xr.Dataset({"a": 1.0})}
    kept = xr.DataTree.from_dict(at)
    (kept.to_zarr if path.suffix == ".zarr" else kept.to_netcdf)(path, **options)


def by_h5py(path, x, *, name="light", dims=None, scales=False, attrs=None, names=False, albedo=True,
            **options):  # fmt: skip
    import h5py

    with h5py.File(path, "w") as file:
        array = file.create_dataset(name, data=x, **options)
        if albedo:
            file["albedo"] = ALBEDO
        array.attrs.update(attrs or {})
        for axis, dim in enumerate(dims or ()):
            array.dims[axis].label = "" if scales else dim
            if scales:
                file[dim] = np.arange(x.shape[axis])
                file[dim].make_scale(dim)
                array.dims[axis].attach_scale(file[dim])
        if names:
            file["channels"] = np.array(["R", "G", "B"], dtype=h5py.string_dtype())
            file.attrs["who"] = h5py.Empty("f4")


def npy(path, x):
    np.save(path, x)


def npz(path, x, *, save=np.savez, name="light", albedo=True):
    beside = {"albedo": ALBEDO} if albedo else {}
    save(path, **{name: x, "channels": np.array(["R", "G", "B"])}, **beside)


v2, v3 = partial(by_zarr, form=2), partial(by_zarr, form=3)
x2, x3 = partial(by_xarray, zarr_format=2), partial(by_xarray, zarr_format=3)
nc4 = partial(by_xarray, engine="h5netcdf")
BLOSC, GZIP = to.BloscCodec(cname="lz4"), to.GzipCodec()
CUT = {"chunks": (4, 5, 2, 7)}
MISSING = {"attrs": {"missing_value": -9.0}}

# name: suffix, writer, what it is given, what is read; options of the reader
LAYOUTS = {
    # zarr 2 of zarr-python
    "v2": (".zarr", partial(v2, dims=DIMS), X, X),
    "v2, other dims": (".zarr", partial(v2, dims=OTHER), X, X),
    "v2, no dims": (".zarr", v2, X, X),
    "v2, fill None": (".zarr", partial(v2, dims=DIMS, fill_value=None), X, X),
    "v2, fill nan": (".zarr", partial(v2, dims=DIMS, fill_value=np.nan), X, X),
    "v2, no dims, fill 1": (".zarr", partial(v2, fill_value=1), X, X),
    "v2, int16": (".zarr", partial(v2, dims=DIMS), WHOLE.astype("i2"), WHOLE),
    "v2, >i4": (".zarr", partial(v2, dims=DIMS), WHOLE.astype(">i4"), WHOLE),
    "v2, float16": (".zarr", partial(v2, dims=DIMS), WHOLE.astype("f2"), WHOLE),
    "v2, >f4": (".zarr", partial(v2, dims=DIMS), X.astype(">f4"), X),
    "v2, >f8": (".zarr", partial(v2, dims=OTHER), X.astype(">f8"), X),
    "v2, ragged chunks": (".zarr", partial(v2, dims=DIMS, **CUT), X, X),
    "v2, chunks in folders": (
        ".zarr",
        partial(v2, dims=DIMS, **CUT, chunk_key_encoding={"name": "v2", "separator": "/"}),
        X,
        X,
    ),
    "v2, order F": (".zarr", partial(v2, dims=DIMS, order="F"), X, X),
    "v2, uncompressed": (".zarr", partial(v2, dims=DIMS, compressors=None), X, X),
    "v2, consolidated": (
        ".zarr",
        lambda path, x: (v2(path, x, dims=DIMS), zarr.consolidate_metadata(path)),
        X,
        X,
    ),
    "v2, groups": (".zarr", partial(v2, dims=DIMS, name="frames/beauty"), X, X),
    "v2, packed": (".zarr", partial(v2, dims=DIMS, attrs={"scale_factor": SCALE}),
                   WHOLE.astype("i2"), PACKED),
    "v2, packed, no dims": (".zarr", partial(v2, attrs={"scale_factor": SCALE}),
                            WHOLE.astype("i2"), PACKED),
    "v2, lone": ("", partial(lone, form=2), X, X),
    # zarr 3 of zarr-python
    "v3": (".zarr", partial(v3, dims=DIMS), X, X),
    "v3, other dims": (".zarr", partial(v3, dims=OTHER), X, X),
    "v3, no dims": (".zarr", v3, X, X),
    "v3, fill 1": (".zarr", partial(v3, dims=DIMS, fill_value=1), X, X),
    "v3, fill nan": (".zarr", partial(v3, dims=DIMS, fill_value=np.nan), X, X),
    "v3, int32": (".zarr", partial(v3, dims=DIMS), WHOLE.astype("i4"), WHOLE),
    "v3, float16": (".zarr", partial(v3, dims=DIMS), WHOLE.astype("f2"), WHOLE),
    "v3, float64": (".zarr", partial(v3, dims=DIMS), X.astype("f8"), X),
    "v3, big endian": (".zarr", partial(v3, serializer=to.BytesCodec(endian="big")), X, X),
    "v3, blosc": (".zarr", partial(v3, dims=DIMS, compressors=BLOSC, **CUT), X, X),
    "v3, gzip": (".zarr", partial(v3, dims=DIMS, compressors=GZIP, **CUT), X, X),
    "v3, transposed": (".zarr", partial(v3, filters=to.TransposeCodec(order=(3, 0, 1, 2))), X, X),
    "v3, sharded": (".zarr", partial(v3, dims=DIMS, chunks=(2, 3, 1, 8), shards=(4, 6, 3, 16)),
                    X, X),
    "v3, consolidated": (
        ".zarr",
        lambda path, x: (v3(path, x, dims=DIMS), zarr.consolidate_metadata(path)),
        X,
        X,
    ),
    "v3, groups": (".zarr", partial(v3, name="frames/left/beauty"), X, X),
    "v3, packed": (".zarr", partial(v3, dims=DIMS, attrs={"scale_factor": SCALE,
                   "add_offset": OFFSET}), WHOLE.astype("i2"), SHIFTED),
    "v3, packed, no dims": (".zarr", partial(v3, attrs={"scale_factor": SCALE,
                            "add_offset": OFFSET}), WHOLE.astype("i2"), SHIFTED),
    "v3, lone": ("", partial(lone, form=3), X, X),
    # zarr of xarray
    "xarray v2": (".zarr", x2, X, X),
    "xarray v2, named channels": (".zarr", partial(x2, names=True), X, X),
    "xarray v2, integers": (".zarr", x2, WHOLE.astype("i4"), WHOLE),
    "xarray v2, _FillValue": (".zarr", partial(x2, encoding={"_FillValue": -9.0}), GAPS, GAPS),
    "xarray v2, missing_value": (".zarr", partial(x2, **MISSING),
                                 np.where(np.isnan(GAPS), np.float32(-9), GAPS), GAPS),
    "xarray v2, packed": (".zarr", partial(x2, encoding={**PACK, "_FillValue": -9}),
                          GAPS * np.float32(SCALE), GAPS * np.float32(SCALE)),
    "xarray v2, packed, unsigned": (
        ".zarr",
        partial(x2, encoding={"scale_factor": SCALE, "dtype": "u2", "_FillValue": 65535}),
        abs(GAPS) * np.float32(SCALE),
        abs(GAPS) * np.float32(SCALE),
    ),
    "xarray v2, packed, offset": (
        ".zarr",
        partial(x2, encoding={**PACK, "add_offset": OFFSET, "_FillValue": -999}),
        GAPS * np.float32(SCALE),
        GAPS * np.float32(SCALE),
    ),
    "xarray v2, offset, fill 0": (
        ".zarr",
        partial(x2, encoding={**PACK, "add_offset": -1.0, "_FillValue": 0}),
        abs(GAPS) * np.float32(SCALE),
        abs(GAPS) * np.float32(SCALE),
    ),
    "xarray v2, group": (".zarr", partial(x2, group="frames", consolidated=False), X, X),
    "xarray v2, tree": (".zarr", partial(tree, zarr_format=2), X, X),
    "xarray v3": (".zarr", x3, X, X),
    "xarray v3, unconsolidated": (".zarr", partial(x3, consolidated=False), X, X),
    "xarray v3, integers": (".zarr", x3, WHOLE.astype("i4"), WHOLE),
    "xarray v3, _FillValue": (".zarr", partial(x3, encoding={"_FillValue": -9.0}), GAPS, GAPS),
    "xarray v3, packed": (".zarr", partial(x3, encoding={**PACK, "_FillValue": -9}),
                          GAPS * np.float32(SCALE), GAPS * np.float32(SCALE)),
    "xarray v3, sharded": (".zarr", partial(x3, encoding={"chunks": (2, 3, 1, 8),
                           "shards": (4, 6, 3, 16)}), X, X),
    "xarray v3, tree": (".zarr", partial(tree, zarr_format=3), X, X),
    # netCDF 3
    "netCDF 3": (".nc", partial(by_xarray, engine="scipy"), X, X),
    "netCDF 3, 64 bit": (".nc", partial(by_xarray, engine="scipy", format="NETCDF3_64BIT"), X, X),
    "netCDF 3, integers": (".nc", partial(by_xarray, engine="scipy"), WHOLE.astype("i2"), WHOLE),
    "netCDF 3, packed": (".nc", partial(by_xarray, engine="scipy",
                         encoding={**PACK, "_FillValue": -9}),
                         GAPS * np.float32(SCALE), GAPS * np.float32(SCALE)),
    "netCDF 3, missing_value": (".nc", partial(by_xarray, engine="scipy", **MISSING),
                                np.where(np.isnan(GAPS), np.float32(-9), GAPS), GAPS),
    "netCDF 3, both missing": (
        ".nc",
        partial(by_xarray, engine="scipy", encoding={"_FillValue": -1.0}, **MISSING),
        np.where(np.isnan(GAPS), np.float32(-9), GAPS),
        np.where(GAPS == -1, np.float32(np.nan), GAPS),
    ),
    # netCDF 4 of h5netcdf, which xarray calls
    "netCDF 4": (".nc", nc4, X, X),
    "netCDF 4, named channels": (".nc4", partial(nc4, names=True), X, X),
    "netCDF 4, packed": (".nc", partial(nc4, encoding={**PACK, "_FillValue": -9, "zlib": True}),
                         GAPS * np.float32(SCALE), GAPS * np.float32(SCALE)),
    "netCDF 4, group": (".nc", partial(nc4, group="frames"), X, X),
    "netCDF 4, tree": (".nc", partial(tree, engine="h5netcdf"), X, X),
    # HDF5 of h5py
    "HDF5": (".h5", by_h5py, X, X),
    "HDF5, chunks": (".h5", partial(by_h5py, chunks=(4, 5, 2, 7), compression="gzip",
                     shuffle=True, fletcher32=True), X, X),
    "HDF5, lzf": (".hdf5", partial(by_h5py, compression="lzf"), X, X),
    "HDF5, growing": (".h5", partial(by_h5py, maxshape=(None,) * 4), X, X),
    "HDF5, fill 1": (".h5", partial(by_h5py, fillvalue=1.0), X, X),
    "HDF5, >f4": (".h5", by_h5py, X.astype(">f4"), X),
    "HDF5, float16": (".h5", by_h5py, WHOLE.astype("f2"), WHOLE),
    "HDF5, float64": (".h5", by_h5py, X.astype("f8"), X),
    "HDF5, >i2": (".h5", by_h5py, WHOLE.astype(">i2"), WHOLE),
    "HDF5, labels": (".h5", partial(by_h5py, dims=DIMS), X, X),
    "HDF5, scales": (".h5", partial(by_h5py, dims=DIMS, scales=True), X, X),
    "HDF5, other scales": (".h5", partial(by_h5py, dims=OTHER, scales=True), X, X),
    "HDF5, groups": (".h5", partial(by_h5py, name="frames/left/beauty"), X, X),
    "HDF5, packed": (".h5", partial(by_h5py, attrs={"scale_factor": SCALE, "add_offset": OFFSET}),
                     WHOLE.astype("i2"), SHIFTED),
    "HDF5, named channels": (".h5", partial(by_h5py, names=True), X, X),
    # NumPy
    "npy": (".npy", npy, X, X),
    "npy, order F": (".npy", npy, np.asfortranarray(X), X),
    "npy, >f4": (".npy", npy, X.astype(">f4"), X),
    "npy, float16": (".npy", npy, WHOLE.astype("f2"), WHOLE),
    "npy, int64": (".npy", npy, WHOLE.astype("i8"), WHOLE),
    "npz": (".npz", npz, X, X),
    "npz, compressed": (".npz", partial(npz, save=np.savez_compressed), X, X),
    "npz, >f8": (".npz", npz, X.astype(">f8"), X),
    "npz, order F": (".npz", npz, np.asfortranarray(X), X),
    "npz, >i2": (".npz", npz, WHOLE.astype(">i2"), WHOLE),
    "npz, groups": (".npz", partial(npz, name="frames/beauty"), X, X),
}  # fmt: skip


def written(path, writer, x):
    """Write samples; what libraries say of it does not matter here."""
    if writer not in (npy, npz):
        needs = str(getattr(writer, "keywords", {})) + getattr(writer, "__name__", "")
        if path.suffix in (".h5", ".hdf5") or "h5netcdf" in needs:
            pytest.importorskip("h5netcdf")
    with warnings.catch_warnings(action="ignore"):
        writer(path, x)
    return path


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_is_read_to_the_bit(tmp_path, name):
    suffix, writer, x, expected = LAYOUTS[name]
    path = written(tmp_path / f"file{suffix}", writer, x)
    featured = not re.search(r"lone|tree|npy|xarray v., group|4, group", name)
    read = chd.io.read(path, features={"albedo": "albedo"} if featured else None)
    assert read.read().tobytes() == expected.tobytes()
    part = slice(1, 5, 2), slice(2, 9), slice(3, 20, 5)
    assert read.read(*part).tobytes() == expected[part[0], part[1], :, part[2]].tobytes()
    assert all(image.tobytes() == ALBEDO.tobytes() for image in read.features.values())
    moved = pickle.loads(pickle.dumps(read))  # to the worker of a cluster
    assert moved.read(*part).tobytes() == expected[part[0], part[1], :, part[2]].tobytes()


bare2, bare3 = partial(v2, albedo=False), partial(v3, albedo=False)
bare5, bare = partial(by_h5py, albedo=False), partial(npz, albedo=False)
REFUSED = {
    "unsigned": (".zarr", bare2, WHOLE.astype("u2"), "unsigned integers"),
    "unsigned, v3": (".zarr", bare3, abs(WHOLE).astype("u1"), "unsigned integers"),
    "unsigned, HDF5": (".h5", bare5, abs(WHOLE).astype("u1"), "unsigned integers"),
    "complex": (".zarr", bare3, X * 1j, "no real numbers"),
    "complex, HDF5": (".h5", bare5, X * 1j, "no real numbers"),
    "truth": (".zarr", bare2, X > 0, "no real numbers"),
    "truth, HDF5": (".h5", bare5, X > 0, "no real numbers"),
    "text": (".zarr", bare2, WHOLE.astype("U4"), "no real numbers"),
    "records": (".zarr", bare2, X.view([("a", "f4"), ("b", "f4")]), "no real numbers"),
    "records, HDF5": (".h5", bare5, X.view([("a", "f4"), ("b", "f4")]), "no real numbers"),
    "records, npz": (".npz", bare, X.view([("a", "f4"), ("b", "f4")]), "no real numbers"),
    "truth, npz": (".npz", bare, X > 0, "no real numbers"),
    "out of range": (".zarr", bare3, X.astype("f8") * 1e300, "kept in single precision"),
    "out of range, HDF5": (".h5", bare5, X.astype("f8") * 1e300, "kept in single precision"),
    "two of one size": (
        ".zarr",
        lambda path, x: zarr.save_group(path, diffuse=x, glossy=x),
        X,
        "give one as variable: diffuse, glossy",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_are_no_samples_is_refused_in_words(tmp_path, name):
    suffix, writer, x, told = REFUSED[name]
    path = written(tmp_path / f"file{suffix}", writer, x)
    with pytest.raises(ChdstatError, match=told):
        chd.io.read(path).read()


@pytest.mark.parametrize("suffix", [".zarr", ".h5"])
def test_an_array_in_a_group_is_named_by_its_path(tmp_path, suffix):
    if suffix == ".zarr":
        frames = zarr.open_group(tmp_path / "x.zarr", mode="w").create_group("frames")
        frames.create_array("beauty", data=X)
        frames.create_array("glossy", data=X / 2)
        frames.attrs["renderer"] = "mine 1.2"
    else:
        with pytest.importorskip("h5py").File(tmp_path / "x.h5", "w") as file:
            file["frames/beauty"], file["frames/glossy"] = X, X / 2
            file["frames"].attrs["renderer"] = np.bytes_("mine 1.2")
    path = tmp_path / f"x{suffix}"
    with pytest.raises(InputError, match="frames/beauty, frames/glossy"):
        chd.io.read(path)
    for variable in ("frames/glossy", "/frames/glossy"):
        found = chd.io.read(path, variable=variable)
        assert np.array_equal(found.read(), X / 2)
        assert found.attrs["renderer"] == "mine 1.2"
    with pytest.raises(InputError, match="'glossy'.*frames/"):
        chd.io.read(path, variable="glossy")


def test_an_unreadable_array_hides_behind_none(tmp_path):
    path = tmp_path / "x.zarr"
    v3(path, X, name="radiance")
    about = path / "radiance" / "zarr.json"
    about.write_text(about.read_text().replace("float32", "bfloat16"))
    zarr.open_group(path).create_array("variance", data=X)
    with pytest.raises(StoreError, match="'radiance'.*bfloat16.*variance"):
        chd.io.read(path)
    assert np.array_equal(chd.io.read(path, variable="variance").read(), X)


@pytest.mark.parametrize("form", [2, 3])
@pytest.mark.parametrize("fill", [0, np.nan])
@pytest.mark.parametrize("shards", [None, (4, 5, 3, 12)])
def test_a_chunk_that_is_lost_is_said(tmp_path, form, fill, shards):
    if shards and form == 2:
        pytest.skip("zarr 2 has no shards")
    by_zarr(tmp_path / "x.zarr", X, form=form, dims=DIMS, fill_value=fill, albedo=False,
            chunks=(shards and (2, 5, 3, 6)) or (4, 5, 3, 12), shards=shards)  # fmt: skip
    chunk = "0.1.0.1" if form == 2 else "c/0/1/0/1"
    (tmp_path / "x.zarr" / "light" / chunk).unlink()
    with pytest.warns(
        InputWarning, match=f"1 of 8 chunks of light are absent, .* value {float(fill)}:"
    ):
        found = chd.io.read(tmp_path / "x.zarr").read()
    expected = X.copy()
    expected[:4, 5:, :, 12:] = fill
    assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("chunks", [None, (4, 5, 3, 12)])
def test_a_chunk_of_hdf5_that_was_never_written_is_said(tmp_path, chunks):
    with pytest.importorskip("h5py").File(tmp_path / "x.h5", "w") as file:
        light = file.create_dataset("light", X.shape, "f4", chunks=chunks)
        if chunks:
            light[..., :12] = X[..., :12]
    told = "4 of 8 chunks" if chunks else "1 of 1 chunks"
    with pytest.warns(InputWarning, match=f"{told} of light are absent"):
        chd.io.read(tmp_path / "x.h5")


def test_a_fill_value_that_may_be_a_sample_is_said(tmp_path):
    v2(tmp_path / "x.zarr", X, dims=DIMS, fill_value=1)
    with pytest.warns(InputWarning, match=r"light marks missing .* is 1.0 reads as NaN"):
        found = chd.io.read(tmp_path / "x.zarr").read()
    assert np.array_equal(np.isnan(found), X == 1)
