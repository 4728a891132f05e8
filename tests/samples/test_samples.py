from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

import chdstat as chd
from chdstat import Samples
from chdstat.errors import InputError, StoreError
from chdstat.samples.store import Store

SHAPE = (70, 66, 3, 70)


@pytest.fixture(scope="module")
def x() -> np.ndarray:
    return np.random.default_rng(3).gamma(0.5, size=SHAPE).astype(np.float32)


@pytest.fixture(scope="module")
def depth() -> np.ndarray:
    return np.arange(70 * 66, dtype=np.float32).reshape(70, 66)


@pytest.fixture(scope="module", params=["memory", "disk"])
def samples(request, x, depth, tmp_path_factory) -> Samples:
    """Return the same samples, once in memory and once on disk."""
    if request.param == "memory":
        return Samples.from_array(x, features={"depth": depth}, scene="test", seed=5)
    held = Samples.from_array(x, features={"depth": depth}, scene="test", seed=5)
    return held.save(tmp_path_factory.mktemp("samples") / "s.zarr", progress=False)


def test_what_samples_say_of_themselves(samples):
    assert samples.shape == SHAPE
    assert samples.spp == 70
    assert samples.channels == ("R", "G", "B")
    assert samples.name == "test"
    samples.attrs["seed"] = 6  # which changes a copy
    assert samples.attrs["seed"] == 5
    where = f"at {samples.path}" if samples.path else "in memory"
    assert repr(samples) == f"<Samples 'test' 66 x 70 pixels, 3 channels, 70 spp, {where}>"


@pytest.mark.parametrize("pixel", [(0, 0), (-1, -66), (64, 63)])
def test_a_pixel_is_channel_by_sample(samples, x, pixel):
    assert np.array_equal(samples[pixel], x[pixel])


CUTS = [
    (slice(60, 99), slice(-3, None), slice(63, 65)),
    (slice(None, None, 3), slice(1, 66, 7), slice(5, None, 2)),
    (slice(-1, None), slice(65, 66), slice(3, 4)),
]


@pytest.mark.parametrize("cut", CUTS)
def test_a_cut_is_that_of_the_array(samples, x, depth, cut):
    """So are a cut of a cut, and what is loaded."""
    ys, xs, ss = cut
    found = samples.isel(y=ys, x=xs, sample=ss)
    for part in (
        found,
        found.load(),
        samples.isel(sample=ss)[ys, xs],
        samples[ys, xs].isel(sample=ss),
    ):
        assert np.array_equal(part.read(), x[ys, xs, :, ss])
        assert part.shape == x[ys, xs, :, ss].shape
        assert part.attrs["spp"] == part.spp
        assert np.array_equal(part.features["depth"], depth[ys, xs])
        assert np.array_equal(part.to_dataset()["radiance"], part.read())
        assert np.array_equal(part[0, -1], x[ys, xs][0, -1][:, ss])
    assert found.path is None  # nothing that is kept of the store is of this part of it
    assert ("part of" in repr(found)) == (samples.path is not None)


@pytest.mark.parametrize(
    ("cut", "dims"),
    [
        ({"y": -1}, "x channel sample"),
        ({"x": 3, "sample": slice(5)}, "y channel sample"),
        ({"y": 2, "x": np.int64(4), "sample": 6}, "channel"),
        ({"sample": 69}, "y x channel"),
    ],
)
def test_an_integer_drops_its_axis_as_in_xarray(samples, cut, dims):
    expected = samples.to_dataset()["radiance"].isel(cut)
    assert expected.dims == tuple(dims.split())
    assert np.array_equal(samples.isel(**cut), expected)


def test_a_cut_of_a_store_reads_only_its_part(x, tmp_path):
    path = Samples.from_array(x).save(tmp_path / "s.zarr", progress=False).path
    file = path / "radiance/c/1/0/0/0"
    file.unlink()
    samples = chd.open(path)
    assert np.array_equal(samples[:64, 3], x[:64, 3])
    lazily = samples.to_dataset()["radiance"]
    assert np.array_equal(lazily[:64].values, x[:64])
    for damaged in (samples[60:65, 3:4].read, lambda: samples[64, 3], lazily.load):
        with pytest.raises(StoreError, match=f"cannot read {file}"):
            damaged()


def test_the_direct_part_is_cut_alike():
    x = np.random.default_rng(0).exponential(size=(4, 5, 3, 8)).astype(np.float32)
    samples = Samples.from_array(x, direct=x / 2)
    assert np.array_equal(samples[:, 2:3].isel(sample=slice(1, 4)).direct, x[:, 2:3, :, 1:4] / 2)
    few = Samples(x, attrs={}, parts={2: samples.direct.isel(sample=slice(3))})
    assert np.array_equal(few.isel(sample=slice(2, 8)).direct, x[..., 2:3] / 2)
    assert few.isel(sample=slice(3, 8)).direct is None


def test_parts_of_one_place_share_their_random_numbers():
    one, other = (Samples.from_array(np.ones((4, 4, 8)), seed=0) for _ in range(2))
    assert one.first(5).shares_numbers_with(other)
    assert one[2:, 1:].shares_numbers_with(other[2:, 1:].load())
    assert not one[2:, :].shares_numbers_with(other[:2, :])
    assert not one.isel(sample=slice(4, 8)).shares_numbers_with(other.isel(sample=slice(4)))


def test_blocks_give_every_sample_once_in_stored_order(samples, x):
    assert np.array_equal(np.asarray(samples, np.float64), x)
    seen = np.zeros(SHAPE, int)
    order = []
    for ys, xs, ss, block in samples.blocks():
        assert np.array_equal(block, x[ys, xs, :, ss])
        seen[ys, xs, :, ss] += 1
        order.append((ys.start, xs.start, ss.start))
    assert (seen == 1).all()
    assert order == sorted(order)


def test_map_assembles_tiles_into_named_images(samples, x):
    def function(block):
        return {
            "mean": (("channel",), block.mean(axis=-1)),
            "range": (("end",), np.stack([block.min((2, 3)), block.max((2, 3))], axis=-1)),
            "count": ((), np.full(block.shape[:2], block.shape[-1], np.int32)),
        }

    result = samples.map(function)
    assert result["mean"].dims == ("y", "x", "channel")
    assert np.array_equal(result["mean"], x.mean(axis=-1))
    assert np.array_equal(result["range"].isel(end=1), x.max((2, 3)))
    assert result["count"].dtype == np.int32
    assert (result["count"] == 70).all()
    assert list(result["channel"].values) == ["R", "G", "B"]
    assert result["y"].size == 70
    assert result.attrs["scene"] == "test"


def test_walking_a_store_takes_no_memory(tmp_path):
    peaks = []
    for spp in (64, 640):
        store = Store.create(tmp_path / f"{spp}.zarr", shape=(16, 64, 3, spp), attrs={})
        for chunk in store.pending():
            store.write(chunk, np.ones((16, 64, 3, 64), np.float32))
        samples = chd.open(store.path)
        tracemalloc.start()
        assert all(block.all() for *_, block in samples.blocks())
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]
    # A reader that held the image would hold ten blocks more.
    assert peaks[1] < 10 * 16 * 64 * 3 * 64 * 4


def test_as_a_labelled_dataset(samples, x, depth):
    dataset = samples.to_dataset()
    assert dataset["radiance"].dims == ("y", "x", "channel", "sample")
    assert np.array_equal(dataset["radiance"], x)
    assert dataset["radiance"].attrs.keys() == {"long_name", "units"}
    assert np.array_equal(dataset["depth"], depth)
    # On disk it is lazy.
    assert (dataset["radiance"].chunks is not None) == (samples.path is not None)


# --- from an array ------------------------------------------------------------------------------


def test_arrays_are_held_in_single_precision():
    samples = Samples.from_array(np.ones((4, 6, 32)))  # grey images gain a channel
    assert (samples.shape, samples.channels) == ((4, 6, 1, 32), ("channel0",))
    assert (samples.read().dtype, samples.features) == (np.float32, {})
    x = np.ones((2, 2, 3, 4), np.float32)
    x[0, 0, 0] = np.nan, np.inf, -1, 1
    assert np.shares_memory(Samples.from_array(x).read(), x)
    assert np.array_equal(Samples.from_array(x)[0, 0], x[0, 0], equal_nan=True)


def test_a_read_beyond_memory_is_refused(tmp_path, monkeypatch):
    held = Samples.from_array(np.random.default_rng(0).random((2, 2, 3, 70)))
    samples = held.save(tmp_path / "s.zarr", progress=False)
    monkeypatch.setattr("chdstat.samples.samples._ALWAYS_READ", 0)
    monkeypatch.setattr("chdstat._core.work.memory", lambda: samples.nbytes - 1)
    with pytest.raises(InputError, match=r"blocks\(\)"):
        samples.read()
    assert samples.read(slice(0, 1)).shape == (1, 2, 3, 70)
    assert samples[1, 1].shape == (3, 70)
