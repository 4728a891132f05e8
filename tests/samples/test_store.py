from __future__ import annotations

import errno
import itertools
import json
import os
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import StoreError
from chdstat.samples import inspect, is_store, layout
from chdstat.samples.layout import SCHEMA_VERSION
from chdstat.samples.store import Store
from chdstat.samples.tiles import BATCH, TILE, chunk_grid
from tests.stops import counted, stopped

ALL = slice(None)


def radiance(height: int, width: int, spp: int, *, channels: int = 3) -> np.ndarray:
    rng = np.random.default_rng(7)
    x = rng.gamma(0.5, size=(height, width, channels, spp)).astype(np.float32)
    return x * (rng.random((height, width, 1, spp)) < 0.7).astype(np.float32)


def create(path: Path, x: np.ndarray, **options: object) -> Store:
    height, width, channels, spp = x.shape
    options = {"attrs": {"scene": "test", "spp": spp}, **options}
    return Store.create(path, shape=(height, width, channels, spp), **options)


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
    batches = [chunk.batch for chunk in chunk_grid(*shape)]
    assert batches == sorted(batches)  # whole images first


# --- round trip ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "channels"), [((1, 1, 1), 1), ((17, 5, 64), 4), ((70, 130, 66), 3)]
)
def test_what_is_written_is_read_to_the_bit(tmp_path, shape, channels):
    x = radiance(*shape, channels=channels)
    fill(create(tmp_path / "s.zarr", x), x)
    store = Store.open(tmp_path / "s.zarr")
    assert store.ledger.complete_spp == shape[2]
    assert store.pending() == []
    assert store.read(ALL, ALL, ALL).tobytes() == x.tobytes()
    for part in map(slice, (0, 15, 60, 63), (1, 17, 68, 65)):  # across the borders of chunks
        assert np.array_equal(store.read(part, part, part), x[part, part, :, part])


# --- stopping and growing -----------------------------------------------------------------------


def test_only_batches_that_all_pixels_have_count(tmp_path):
    x = radiance(TILE, 2 * TILE, 2 * BATCH)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x), x, at_most=1)
    assert store.ledger.complete_spp == 0
    with pytest.raises(StoreError, match="resume"):
        chd.open(path)
    fill(store, x, at_most=2)
    assert len(store.pending()) == 1
    samples = chd.open(path)
    assert samples.spp == BATCH
    assert np.array_equal(samples.read(), x[..., :BATCH])


@pytest.mark.parametrize(("old", "new"), [(64, 128), (40, 41), (65, 200)])
def test_growing_keeps_what_is_stored(tmp_path, old, new):
    x = radiance(20, 70, new)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x[..., :old]), x[..., :old])
    store.extend(new)
    assert store.ledger.complete_spp == old
    assert np.array_equal(store.read(ALL, ALL, slice(0, old)), x[..., :old])
    assert np.array_equal(Store.open(path).read(ALL, ALL, slice(0, old)), x[..., :old])
    assert all(chunk.ss.stop > old for chunk in store.pending())
    fill(store, x).extend(10)  # it does not shrink
    assert np.array_equal(Store.open(path).read(ALL, ALL, ALL), x)


def test_a_growth_stopped_halfway_goes_on(tmp_path):
    x = radiance(4, 4, 100)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x[..., :10]), x[..., :10])
    with stopped(layout, "put", when=lambda file, _: file.parent.name == "radiance"):
        store.extend(100)
    store.close()
    assert Store.open(path).damaged() == [path / "radiance/zarr.json"]
    again = Store.open(path, writable=True)
    assert (again.ledger.complete_spp, again.shape) == (10, x.shape)
    assert again.damaged() == []
    assert np.array_equal(fill(again, x).read(ALL, ALL, ALL), x)


def test_leftovers_of_a_killed_writer_are_removed(tmp_path):
    x = radiance(10, 10, 70)
    path = tmp_path / "s.zarr"
    path.mkdir()
    (path / ".lock").touch()
    (path / ".zarr.0123456789ab.partial.json").write_text("{")
    store = fill(create(path, x), x, at_most=1)
    left = [path / "radiance/c/0/0/0/.1.0123456789ab.partial", path / ".zarr.01.partial.json"]
    for file in left:
        file.write_bytes(b"half")
    store.close()
    with Store.open(path, writable=True) as again:
        assert np.array_equal(fill(again, x).read(ALL, ALL, ALL), x)
        assert again.damaged() == []
    assert not any(".partial" in p.name or p.name == ".lock" for p in path.rglob("*"))


@pytest.mark.parametrize("stop", ["zarr.json", "features/depth/c/0/0"])
def test_what_a_stopped_maker_left_is_completed(tmp_path, stop):
    path = tmp_path / "s.zarr"
    x, features = radiance(4, 4, 4), {"depth": np.ones((4, 4), np.float32)}
    put = counted(layout, "put", most=0, when=lambda file, _: file == path / stop)
    with put, pytest.raises(KeyboardInterrupt) as error:
        create(path, x, features=features)
    assert error.tb is not None  # a notebook keeps it, and with it the store that was made
    assert is_store(path) == (stop != "zarr.json")
    store = Store.open(path, writable=True) if is_store(path) else create(path, x)
    with store:
        store.restore(features)
        assert store.damaged() == []
        assert store.read_features()["depth"].all()
        assert np.array_equal(fill(store, x).read(ALL, ALL, ALL), x)


# --- two writers --------------------------------------------------------------------------------


def test_a_second_writer_is_refused(tmp_path):
    path = tmp_path / "s.zarr"
    x = radiance(4, 4, 70)
    with create(path, x) as store:
        for second in (lambda: Store.open(path, writable=True), lambda: create(path, x)):
            with pytest.raises(StoreError, match=f"process {os.getpid()} on|another process"):
                second()
        fill(store, x, at_most=1)
        assert chd.open(path).spp == BATCH  # who reads is not kept out
    with Store.open(path, writable=True) as store:
        assert len(store.pending()) == 1


# --- what is not a store ------------------------------------------------------------------------


@pytest.mark.parametrize("version", [SCHEMA_VERSION - 1, SCHEMA_VERSION + 1, "new"])
def test_another_schema_is_refused(tmp_path, version):
    path = tmp_path / "s.zarr"
    create(path, radiance(4, 4, 4))
    for file in (path / "zarr.json", path / "radiance/zarr.json"):
        held = json.loads(file.read_text())
        held["attributes"]["schema_version"] = version
        file.write_text(json.dumps(held))
    with pytest.raises(StoreError, match=f"version {version}.* 2$"):
        chd.open(path)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_nothing_is_overwritten(tmp_path, kind):
    path = tmp_path / "mine"
    if kind == "file":
        path.write_text("mine")
    else:
        path.mkdir()
        (path / "notes.txt").write_text("mine")
    with pytest.raises(StoreError, match="mine"):
        create(path, radiance(4, 4, 4))
    assert (path if kind == "file" else path / "notes.txt").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


# --- damage -------------------------------------------------------------------------------------


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def stump(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:10])


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 3] ^= 0x10
    file.write_bytes(bytes(data))


def fold(file: Path) -> None:
    file.unlink()
    file.mkdir()


def swap(file: Path) -> None:
    other = file.with_name("0")
    content = file.read_bytes()
    file.write_bytes(other.read_bytes())
    other.write_bytes(content)


HARMS = [truncate, stump, flip, fold, swap, Path.unlink]


@pytest.mark.parametrize("harm", HARMS)
def test_damage_is_found_named_and_repaired(tmp_path, harm):
    x = radiance(TILE, 2 * TILE, 2 * BATCH)
    path = tmp_path / "s.zarr"
    fill(create(path, x), x).close()
    sound = contents(path)
    harmed = path / "radiance/c/0/1/0/1"
    harm(harmed)
    damaged = [harmed.with_name("0"), harmed] if harm is swap else [harmed]
    store = Store.open(path)
    assert store.damaged() == damaged
    named = ", ".join(map(str, damaged))
    with pytest.raises(StoreError, match=rf"{named} \("):
        store.read(ALL, ALL, ALL)
    assert np.array_equal(store.read(ALL, slice(0, TILE), ALL), x[:, :TILE])
    if harm is not swap:
        assert np.array_equal(store.read(ALL, ALL, slice(0, BATCH)), x[..., :BATCH])
    assert chd.open(path).spp == 2 * BATCH  # what is gone is not fewer samples
    with Store.open(path, writable=True) as writer:
        assert [writer.chunk_file(c) for c in writer.pending()] == damaged
        fill(writer, x)
    assert contents(path) == sound


@pytest.mark.parametrize(
    "name",
    ["zarr.json", "radiance/zarr.json", "features/depth/zarr.json", "features/depth/c/0/0"],
)
@pytest.mark.parametrize("harm", [truncate, fold, Path.unlink])
def test_unsound_metadata_is_not_used(tmp_path, name, harm):
    x, features = radiance(5, 6, 70), {"depth": np.ones((5, 6), np.float32)}
    path = tmp_path / "s.zarr"
    fill(create(path, x, features=features), x).close()
    sound = contents(path)
    harm(path / name)
    store = Store.open(path)
    assert np.array_equal(store.read(ALL, ALL, ALL), x)
    if name.endswith(".json"):
        assert store.damaged() == [path / name]
        assert store.read_features()["depth"].all()
    else:
        assert store.damaged() == [path / "features/depth"]
        with pytest.raises(StoreError, match="features/depth/c/0/0"):
            store.read_features()
    with Store.open(path, writable=True) as writer:
        writer.restore(features)
    assert contents(path) == sound


def test_a_foreign_or_older_chunk_is_refused(tmp_path):
    x = radiance(4, 4, 70)
    ours, theirs = tmp_path / "ours.zarr", tmp_path / "theirs.zarr"
    fill(create(theirs, x, attrs={"scene": "other"}), x)
    store = fill(create(ours, x[..., :68]), x[..., :68])
    chunk = ours / "radiance/c/0/0/0/1"
    older = chunk.read_bytes()
    store.extend(70)
    fill(store, x).close()
    for content, why in (
        ((theirs / "radiance/c/0/0/0/1").read_bytes(), "it is of other samples"),
        (older, "it is an older one, with fewer samples"),
    ):
        chunk.write_bytes(content)
        with pytest.raises(StoreError, match=why):
            Store.open(ours).read(ALL, ALL, ALL)


@pytest.mark.parametrize(
    "change",
    [
        {"shape": [4, 4, 3, 10**9]},
        {"shape": [1, 4, 3, 70]},
        {"data_type": "uint32"},
        {"fill_value": 0},
        {"codecs": []},
    ],
)
def test_metadata_of_arrays_changes_nothing(tmp_path, change):
    x = radiance(4, 4, 70)
    path = tmp_path / "s.zarr"
    fill(create(path, x), x).close()
    file = path / "radiance/zarr.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    assert np.array_equal(chd.open(path).read(), x)
    assert inspect(path)["damaged"] == [str(file)]


def test_a_store_that_cannot_be_written_is_read(tmp_path, monkeypatch):
    x = radiance(4, 4, 4)
    path = tmp_path / "s.zarr"
    fill(create(path, x), x).close()

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(StoreError, match="Read-only file system"):
        Store.open(path, writable=True)
    assert np.array_equal(chd.open(path).read(), x)
