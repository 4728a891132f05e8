from __future__ import annotations

import errno
import itertools
from pathlib import Path

import numpy as np
import pytest
import zarr

import chdstat as chd
from chdstat._store import BATCH, SCHEMA_VERSION, TILE, Store, chunk_grid
from chdstat.errors import StoreError

ALL = slice(None)


def radiance(height: int, width: int, spp: int, *, channels: int = 3) -> np.ndarray:
    rng = np.random.default_rng(7)
    x = rng.gamma(0.5, size=(height, width, channels, spp)).astype(np.float32)
    return x * (rng.random((height, width, 1, spp)) < 0.7).astype(np.float32)


def create(path: Path, x: np.ndarray, **options: object) -> Store:
    height, width, channels, spp = x.shape
    attrs = {"scene": "test", "spp": spp}
    return Store.create(
        path, height=height, width=width, channels=channels, spp=spp, attrs=attrs, **options
    )


def fill(store: Store, x: np.ndarray, *, at_most: int | None = None) -> Store:
    for chunk in itertools.islice(store.pending(), at_most):
        store.write(chunk, x[chunk.ys, chunk.xs, :, chunk.ss])
    return store


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


# --- the grid -----------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1, 1), (64, 64, 64), (65, 130, 200), (16, 7, 63)])
def test_chunks_cover_every_sample_once(shape):
    count = np.zeros(shape, int)
    for chunk in chunk_grid(*shape):
        count[chunk.ys, chunk.xs, chunk.ss] += 1
        assert chunk.size == count[chunk.ys, chunk.xs, chunk.ss].size
    assert (count == 1).all()


def test_chunks_come_batch_by_batch():
    batches = [chunk.batch for chunk in chunk_grid(130, 70, 3 * BATCH)]
    assert batches == sorted(batches)


# --- round trip ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "shape", [(1, 1, 1), (16, 16, 64), (17, 5, 65), (64, 64, 64), (70, 130, 66)]
)
def test_what_is_written_is_read_to_the_bit(tmp_path, shape):
    x = radiance(*shape)
    fill(create(tmp_path / "s.zarr", x), x)
    store = Store.open(tmp_path / "s.zarr")
    assert store.complete_spp() == shape[2]
    assert store.pending() == []
    assert store.read(ALL, ALL, ALL).tobytes() == x.tobytes()


@pytest.mark.parametrize("channels", [1, 4])
def test_any_number_of_channels(tmp_path, channels):
    x = radiance(5, 6, 7, channels=channels)
    store = fill(create(tmp_path / "s.zarr", x), x)
    assert np.array_equal(store.read(ALL, ALL, ALL), x)


def test_parts_are_read_across_the_borders_of_chunks(tmp_path):
    x = radiance(70, 70, 70)
    store = fill(create(tmp_path / "s.zarr", x), x)
    for part in ((15, 17), (60, 68), (63, 65), (69, 70)):
        s = slice(*part)
        assert np.array_equal(store.read(s, s, s), x[s, s, :, s])


def test_nulls_and_bad_samples_stay_as_they_are(tmp_path):
    x = radiance(TILE, 2 * TILE, BATCH)
    x[:, :TILE] = 0
    x[:, TILE:] = np.nan
    x[3, 3, :, 5] = np.inf, -np.inf, -1
    fill(create(tmp_path / "s.zarr", x), x)
    store = Store.open(tmp_path / "s.zarr")
    assert store.complete_spp() == BATCH
    assert store.damaged() == []
    assert np.array_equal(store.read(ALL, ALL, ALL), x, equal_nan=True)


def test_features_come_with_the_store(tmp_path):
    x = radiance(4, 6, 2)
    depth = np.arange(24, dtype=np.float32).reshape(4, 6)
    normal = np.arange(72, dtype=np.float32).reshape(4, 6, 3)
    create(tmp_path / "s.zarr", x, features={"depth": depth, "normal": normal})
    read = Store.open(tmp_path / "s.zarr").read_features()
    assert read.keys() == {"depth", "normal"}
    assert np.array_equal(read["depth"], depth)
    assert np.array_equal(read["normal"], normal)


# --- stopping and growing -----------------------------------------------------------------------


def test_only_batches_that_all_pixels_have_count(tmp_path):
    x = radiance(TILE, 2 * TILE, 2 * BATCH)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x), x, at_most=1)
    assert store.complete_spp() == 0
    with pytest.raises(StoreError, match="holds no sample that every pixel has.*resume"):
        chd.open(path)
    fill(store, x, at_most=2)
    assert len(store.pending()) == 1
    samples = chd.open(path)
    assert samples.spp == BATCH
    assert np.array_equal(samples.read(), x[..., :BATCH])


@pytest.mark.parametrize(("old", "new"), [(64, 128), (40, 41), (40, 200), (65, 128)])
def test_growing_keeps_what_is_stored(tmp_path, old, new):
    x = radiance(20, 70, new)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x[..., :old]), x[..., :old])
    store.extend(new)
    assert store.complete_spp() == old
    assert np.array_equal(store.read(ALL, ALL, slice(0, old)), x[..., :old])
    assert np.array_equal(Store.open(path).read(ALL, ALL, slice(0, old)), x[..., :old])
    assert all(chunk.ss.stop > old for chunk in store.pending())
    fill(store, x)
    assert np.array_equal(Store.open(path).read(ALL, ALL, ALL), x)


def test_a_store_does_not_shrink(tmp_path):
    x = radiance(4, 4, 80)
    store = fill(create(tmp_path / "s.zarr", x), x)
    store.extend(10)
    assert store.shape == x.shape


def test_a_growth_stopped_halfway_goes_on(tmp_path, monkeypatch):
    x = radiance(4, 4, 100)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x[..., :10]), x[..., :10])

    resize = zarr.Array.resize

    def stop_before_radiance(array: zarr.Array, shape: tuple[int, ...]) -> None:
        if array.path == "radiance":
            raise KeyboardInterrupt
        resize(array, shape)

    with monkeypatch.context() as patch:
        patch.setattr(zarr.Array, "resize", stop_before_radiance)
        with pytest.raises(KeyboardInterrupt):
            store.extend(100)
    again = Store.open(path, writable=True)
    assert again.complete_spp() == 10
    again.extend(100)
    assert np.array_equal(fill(again, x).read(ALL, ALL, ALL), x)


def test_leftovers_of_a_killed_writer_do_not_disturb(tmp_path):
    x = radiance(10, 10, 70)
    path = tmp_path / "s.zarr"
    half_made = tmp_path / ".s.zarr.partial"
    half_made.mkdir()
    (half_made / "zarr.json").write_text("{")
    store = fill(create(path, x), x, at_most=1)
    assert not half_made.exists()
    for folder in (path, path / "radiance", path / "radiance/c/0/0/0", path / "ledger/c/0/0"):
        (folder / "1.0123456789abcdef.partial").write_bytes(b"half")
    assert np.array_equal(fill(store, x).read(ALL, ALL, ALL), x)
    assert Store.open(path).damaged() == []


def test_a_store_is_not_seen_before_it_is_whole(tmp_path, monkeypatch):
    path = tmp_path / "s.zarr"

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("chdstat._store._create_features", stop)
        with pytest.raises(KeyboardInterrupt):
            create(path, radiance(4, 4, 4))
    assert not path.exists()
    create(path, radiance(4, 4, 4))
    assert [p.name for p in tmp_path.iterdir()] == ["s.zarr"]


# --- what is not a store ------------------------------------------------------------------------


def test_missing_store(tmp_path):
    with pytest.raises(StoreError, match=r"no store at .*nowhere; render one with"):
        chd.open(tmp_path / "nowhere")


def test_a_file_is_not_a_store(tmp_path):
    file = tmp_path / "notes.txt"
    file.write_text("mine")
    with pytest.raises(StoreError, match=r"notes\.txt is not a complete chdstat store"):
        chd.open(file)


def test_another_folder_is_not_a_store(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(StoreError, match="is not a complete chdstat store"):
        chd.open(tmp_path)


@pytest.mark.parametrize("kind", ["array", "group", "namesakes"])
def test_other_zarr_data_is_not_a_store(tmp_path, kind):
    path = tmp_path / "other.zarr"
    if kind == "array":
        zarr.create_array(path, shape=(4,), dtype="float32")
    else:
        group = zarr.open_group(path, mode="w")
        for name in ("radiance", "ledger") if kind == "namesakes" else ("image",):
            group.create_array(name, shape=(4,), dtype="float32")
    before = contents(path)
    with pytest.raises(StoreError, match=r"other\.zarr is not a complete chdstat store"):
        chd.open(path)
    assert contents(path) == before


@pytest.mark.parametrize("version", [SCHEMA_VERSION + 1, 0, "new"])
def test_another_schema_is_refused(tmp_path, version):
    path = tmp_path / "s.zarr"
    store = create(path, radiance(4, 4, 4))
    store.group.attrs["schema_version"] = version
    with pytest.raises(
        StoreError, match=f"schema version {version}, this chdstat reads {SCHEMA_VERSION}"
    ):
        chd.open(path)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_nothing_is_overwritten(tmp_path, kind):
    path = tmp_path / "mine"
    if kind == "file":
        path.write_text("mine")
    else:
        path.mkdir()
        (path / "notes.txt").write_text("mine")
    with pytest.raises(StoreError, match="exists and is not a chdstat store; nothing was overwr"):
        create(path, radiance(4, 4, 4))
    assert (path if kind == "file" else path / "notes.txt").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_an_empty_folder_is_filled(tmp_path):
    path = tmp_path / "empty"
    path.mkdir()
    x = radiance(4, 4, 4)
    assert np.array_equal(fill(create(path, x), x).read(ALL, ALL, ALL), x)


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"cannot create a store at .*s\.zarr: "):
        create(tmp_path / "file" / "s.zarr", radiance(4, 4, 4))


# --- damage -------------------------------------------------------------------------------------


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def stump(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:10])


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 3] ^= 0x10
    file.write_bytes(bytes(data))


@pytest.mark.parametrize("harm", [truncate, stump, flip])
def test_damage_is_found_named_and_repaired(tmp_path, harm):
    x = radiance(TILE, 2 * TILE, 2 * BATCH)
    path = tmp_path / "s.zarr"
    fill(create(path, x), x)
    harmed = path / "radiance/c/0/1/0/1"
    sound = harmed.read_bytes()
    harm(harmed)
    store = Store.open(path, writable=True)
    with pytest.raises(StoreError, match=rf"cannot read {harmed} .*delete.*render' again"):
        store.read(ALL, ALL, ALL)
    assert store.damaged() == [harmed]
    assert store.damaged(xs=slice(0, TILE)) == []
    assert np.array_equal(store.read(ALL, slice(0, TILE), ALL), x[:, :TILE])
    assert np.array_equal(store.read(ALL, ALL, slice(0, BATCH)), x[..., :BATCH])
    harmed.unlink()
    assert [store.chunk_file(c) for c in store.pending()] == [harmed]
    fill(store, x)
    assert harmed.read_bytes() == sound
    assert store.damaged() == []


@pytest.mark.parametrize("harm", [Path.unlink, lambda file: file.write_bytes(b"")])
def test_a_file_that_is_gone_or_empty_counts_as_not_rendered(tmp_path, harm):
    x = radiance(4, 4, 3 * BATCH)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x), x)
    harm(path / "radiance/c/0/0/0/1")
    assert store.damaged() == [path / "radiance/c/0/0/0/1"]
    assert chd.open(path).spp == BATCH
    assert np.array_equal(fill(store, x).read(ALL, ALL, ALL), x)


@pytest.mark.parametrize("what", ["radiance", "ledger"])
def test_a_full_disk_keeps_what_is_stored(tmp_path, monkeypatch, what):
    x = radiance(8, 8, 3 * BATCH)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x), x, at_most=1)
    write = zarr.Array.__setitem__

    def full(array: zarr.Array, *args: object) -> None:
        if array.path == what:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(array, *args)

    with monkeypatch.context() as patch:
        patch.setattr(zarr.Array, "__setitem__", full)
        with pytest.raises(StoreError, match="cannot write to .*No space left.*resume"):
            fill(store, x)
    assert chd.open(path).spp == BATCH
    assert np.array_equal(fill(Store.open(path, writable=True), x).read(ALL, ALL, ALL), x)
