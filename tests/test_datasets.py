"""Every dataset that the library returns can be written as netCDF and zarr and read as it was."""

from importlib.util import find_spec

import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat.inference import gaussianity_of_means
from chdstat.patterns import attribute

X = np.random.default_rng(8).gamma(0.6, size=(4, 5, 3, 96)).astype(np.float32)
X[X < 0.05] = 0
ODD = {"seed": 2**40, "crop": None, "noise": {"value": 0.1, "of": None}, "flag": True,
       "notes": ["a", "b"], "none": [], "size": [5, 4], "rate": np.float32(0.5)}  # fmt: skip
ENGINES = ["scipy", *(["h5netcdf"] if find_spec("h5netcdf") else [])]

DATASETS = {
    "summarize": chd.summarize,
    "analyze": lambda s: chd.analyze(s, held_out=False),
    "analyze a summary": lambda s: chd.analyze(chd.summarize(s)),
    "classify": chd.classify,
    "tail index": chd.fit.tail_index,
    "gamma": chd.fit.gamma,
    "gamma of a summary": lambda s: chd.fit.gamma(chd.summarize(s)),
    "mixture": chd.fit.mixture,
    "select": lambda s: chd.fit.select(s, criterion="held_out"),
    "goodness": lambda s: chd.fit.goodness(s, "gamma", resamples=19),
    "gaussianity": chd.gaussianity,
    "gaussianity of means": gaussianity_of_means,
    "modality": chd.modality,
    "histogram": chd.histogram,
    "samples": lambda s: s.to_dataset(),
    "contrast": lambda s: chd.contrast(s, other(), distributions=True).maps,
    "compare": lambda s: chd.compare(s, ["mean", "trimmed_mean"], n=8).to_dataset(),
}


def other():
    return chd.Samples.from_array(np.roll(X, 1, axis=-1))


@pytest.fixture(scope="module")
def images(stored):
    return {
        "odd": chd.Samples(X, attrs=ODD | {"scene": "odd"}),
        "adaptive": chd.open(stored(size=(5, 4), spp=128, error=0.2)),
    }


def check(found, folder):
    """Check that a dataset is read as it was written, with its attributes."""
    found.to_zarr(folder / "x.zarr", consolidated=False)
    same(xr.open_zarr(folder / "x.zarr", consolidated=False), found)
    for engine in ENGINES:
        found.to_netcdf(folder / f"{engine}.nc", engine=engine)
        with xr.open_dataset(folder / f"{engine}.nc", engine=engine) as again:
            same(again, found)


def same(again, found):
    assert set(again.variables) == set(found.variables)
    for name, variable in found.variables.items():
        if variable.dtype.kind == "O":
            assert again[name].to_numpy().tolist() == variable.to_numpy().tolist()
        else:
            np.testing.assert_array_equal(again[name], variable)
    for one, other in [(again, found), *((again[n], found[n]) for n in found.variables)]:
        assert one.attrs.keys() == other.attrs.keys()
        for key, value in other.attrs.items():
            np.testing.assert_array_equal(one.attrs[key], value)


@pytest.mark.parametrize("image", ["odd", "adaptive"])
@pytest.mark.parametrize("name", DATASETS)
@pytest.mark.filterwarnings("ignore::chdstat.errors.InputWarning")
def test_a_dataset_is_written_and_read(tmp_path, images, name, image):
    check(DATASETS[name](images[image]), tmp_path)


def test_shares_are_written_and_read(tmp_path, stored):
    check(attribute(chd.open(stored(size=(4, 5), spp=64, by_depth=2))), tmp_path)


def test_what_is_unknown_of_samples_is_no_attribute(images):
    held = chd.summarize(images["odd"]).attrs
    assert "crop" not in held
    assert held["noise"] == '{"value": 0.1, "of": null}'
    assert (held["size"], held["rate"]) == ([5, 4], 0.5)
