from __future__ import annotations

import errno
import hashlib
import itertools
import json
import os
import shutil
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

import chdstat as chd
from chdstat.cli import main
from chdstat.errors import StoreError
from chdstat.rendering.conversion import convert
from chdstat.samples import inspect, is_store, layout
from chdstat.samples.layout import BATCH, SCHEMA_VERSION, TILE, chunk_grid
from chdstat.samples.store import Store

ALL = slice(None)
BALL = [
    "70189d9781890fa471d07c01cfffc8d787c87a346739411b22fe76b72a799387",
    "fd4c260a7f60afb70852a108f036197104f5a6825053ce9be82beb6e59a10ee8",
]
"""SHA-256 of all samples, and of their direct part, as read by the version that rendered them."""


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
    put = layout.put

    def stop_before_radiance(file: Path, content: bytes) -> None:
        if file.parent.name == "radiance":
            raise KeyboardInterrupt
        put(file, content)

    with monkeypatch.context() as patch:
        patch.setattr(layout, "put", stop_before_radiance)
        with pytest.raises(KeyboardInterrupt):
            store.extend(100)
    store.close()
    assert Store.open(path).damaged() == [path / "radiance/zarr.json"]
    again = Store.open(path, writable=True)
    assert (again.complete_spp(), again.shape) == (10, x.shape)
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
def test_what_a_stopped_maker_left_is_completed(tmp_path, monkeypatch, stop):
    path, put = tmp_path / "s.zarr", layout.put
    x, features = radiance(4, 4, 4), {"depth": np.ones((4, 4), np.float32)}

    def stopped(file: Path, content: bytes) -> None:
        if file == path / stop:
            raise KeyboardInterrupt
        put(file, content)

    with monkeypatch.context() as patch:
        patch.setattr(layout, "put", stopped)
        with pytest.raises(KeyboardInterrupt):
            create(path, x, features=features)
    assert is_store(path) == (stop != "zarr.json")
    store = Store.open(path, writable=True) if is_store(path) else create(path, x)
    with store:
        store.restore(features)
        assert store.damaged() == []
        assert store.read_features()["depth"].all()
        assert np.array_equal(fill(store, x).read(ALL, ALL, ALL), x)


# --- two writers --------------------------------------------------------------------------------


def test_a_second_writer_is_refused_until_the_first_is_done(tmp_path):
    path = tmp_path / "s.zarr"
    x = radiance(4, 4, 70)
    with create(path, x) as store:
        for second in (lambda: Store.open(path, writable=True), lambda: create(path, x)):
            with pytest.raises(StoreError, match=f"process {os.getpid()} on|run the command again"):
                second()
        fill(store, x, at_most=1)
        assert chd.open(path).spp == BATCH  # who reads is not kept out
    with Store.open(path, writable=True) as store:
        assert len(store.pending()) == 1


def test_of_two_makers_one_is_refused(tmp_path):
    path = tmp_path / "s.zarr"
    with create(path, radiance(4, 4, 4)):
        (path / "zarr.json").unlink()
        shutil.rmtree(path / "radiance")  # as of a maker that has only begun
        with pytest.raises(StoreError, match=f"{path} is being .* by process {os.getpid()} on"):
            create(path, radiance(4, 4, 4))
    create(path, radiance(4, 4, 4))


# --- what is not a store ------------------------------------------------------------------------


def test_missing_store(tmp_path):
    with pytest.raises(StoreError, match=r"no store at .*nowhere; render one with"):
        chd.open(tmp_path / "nowhere")


def test_a_file_is_not_a_store(tmp_path):
    file = tmp_path / "notes.txt"
    file.write_text("mine")
    with pytest.raises(StoreError, match=r"notes\.txt is a file; a store is a folder"):
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
    create(path, radiance(4, 4, 4))
    for file in (path / "zarr.json", path / "radiance/zarr.json"):
        held = json.loads(file.read_text())
        held["attributes"]["schema_version"] = version
        file.write_text(json.dumps(held))
    with pytest.raises(StoreError, match=f"schema version {version}, this chdstat reads 1 and 2"):
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
    with pytest.raises(StoreError, match=r"cannot write to .*s\.zarr: "):
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


def fold(file: Path) -> None:
    file.unlink()
    file.mkdir()


def swap(file: Path) -> None:
    other = file.with_name("0")
    content = file.read_bytes()
    file.write_bytes(other.read_bytes())
    other.write_bytes(content)


HARMS = [truncate, stump, flip, fold, swap, Path.unlink, lambda file: file.write_bytes(b"")]


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
    with pytest.raises(StoreError, match=rf"cannot read {named} \(.*render' again to repair"):
        store.read(ALL, ALL, ALL)
    assert np.array_equal(store.read(ALL, slice(0, TILE), ALL), x[:, :TILE])
    if harm is not swap:
        assert np.array_equal(store.read(ALL, ALL, slice(0, BATCH)), x[..., :BATCH])
    assert chd.open(path).spp == 2 * BATCH  # what is gone is not fewer samples
    with Store.open(path, writable=True) as writer:
        assert [writer.chunk_file(c) for c in writer.pending()] == damaged
        fill(writer, x)
    assert contents(path) == sound


@pytest.mark.parametrize("name", ["zarr.json", "radiance/zarr.json", "features/depth/zarr.json"])
@pytest.mark.parametrize("harm", [truncate, flip, fold, Path.unlink])
def test_metadata_is_believed_only_where_it_is_sound(tmp_path, name, harm):
    x, features = radiance(5, 6, 70), {"depth": np.ones((5, 6), np.float32)}
    path = tmp_path / "s.zarr"
    fill(create(path, x, features=features), x).close()
    sound = contents(path)
    harm(path / name)
    store = Store.open(path)
    assert store.damaged() == [path / name]
    assert np.array_equal(store.read(ALL, ALL, ALL), x)
    assert store.read_features()["depth"].all()
    Store.open(path, writable=True).close()
    assert contents(path) == sound


@pytest.mark.parametrize("harm", [truncate, flip, fold, Path.unlink])
def test_damaged_features_are_named_and_repaired(tmp_path, harm):
    x, features = radiance(5, 6, 70), {"depth": np.ones((5, 6), np.float32)}
    path = tmp_path / "s.zarr"
    fill(create(path, x, features=features), x).close()
    sound = contents(path)
    harm(path / "features/depth/c/0/0")
    store = Store.open(path)
    assert store.damaged() == [path / "features/depth"]
    assert np.array_equal(store.read(ALL, ALL, ALL), x)
    with pytest.raises(StoreError, match="cannot read .*features/depth/c/0/0 .*render' again"):
        store.read_features()
    with Store.open(path, writable=True) as writer:
        writer.restore(features)
    assert contents(path) == sound


def test_a_chunk_of_another_store_or_of_fewer_samples_is_refused(tmp_path):
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
def test_what_the_metadata_of_an_array_says_changes_nothing(tmp_path, change):
    x = radiance(4, 4, 70)
    path = tmp_path / "s.zarr"
    fill(create(path, x), x).close()
    file = path / "radiance/zarr.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    assert np.array_equal(chd.open(path).read(), x)
    assert inspect(path)["damaged"] == [str(file)]


def test_a_full_disk_keeps_what_is_stored(tmp_path, monkeypatch):
    x = radiance(8, 8, 3 * BATCH)
    path = tmp_path / "s.zarr"
    store = fill(create(path, x), x, at_most=1)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(layout, "put", full)
        with pytest.raises(StoreError, match="cannot write to .*No space left.*resume"):
            fill(store, x)
    store.close()
    assert chd.open(path).spp == BATCH
    with Store.open(path, writable=True) as again:
        assert np.array_equal(fill(again, x).read(ALL, ALL, ALL), x)


def test_a_store_that_cannot_be_written_is_read(tmp_path, monkeypatch):
    x = radiance(4, 4, 4)
    path = tmp_path / "s.zarr"
    fill(create(path, x), x).close()

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(StoreError, match="cannot write to .*Read-only file system"):
        Store.open(path, writable=True)
    assert np.array_equal(chd.open(path).read(), x)


# --- stores of the first schema -----------------------------------------------------------------


def first_schema(path: Path, x: np.ndarray, features: dict[str, np.ndarray]) -> Path:
    """Write a store as chdstat did that had no manifest."""
    height, width, channels, spp = x.shape
    group = zarr.open_group(path, mode="w", zarr_format=3)
    with zarr.config.set({"array.write_empty_chunks": True}):
        group.create_array(
            "radiance",
            shape=x.shape,
            dtype="float32",
            chunks=(16, 16, channels, 64),
            shards=(64, 64, channels, 64),
            compressors=[BloscCodec(cname="zstd", clevel=1, shuffle="noshuffle"), Crc32cCodec()],
            fill_value=float("nan"),
            dimension_names=("y", "x", "channel", "sample"),
        )[...] = x
    grid = (-(-height // 64), -(-width // 64), -(-spp // 64))
    ledger = group.create_array(
        "ledger", shape=grid, dtype="int32", chunks=(*grid[:2], 1024), fill_value=0
    )
    ledger[...] = np.broadcast_to(np.minimum(64, spp - 64 * np.arange(grid[2])), grid)
    folder = group.create_group("features")
    for name, image in features.items():
        folder.create_array(name, data=image)
    about = {"schema_version": 1, "scene": "old", "size": [width, height], "spp": spp}
    group.attrs.update({**about, "integrator": {"type": "path", "max_depth": 8}})
    return path


@pytest.fixture
def run(monkeypatch):
    """Return a function that runs a command, which must succeed."""

    def command(*arguments: object) -> None:
        monkeypatch.setattr("sys.argv", ["chdstat", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert not ended.value.code

    return command


@pytest.fixture
def ball(tmp_path, monkeypatch):
    """Return the folder of a store that chdstat rendered at commit 078eeb6, and of its scene."""
    archive = Path(__file__).parent / "store_of_schema_1.zip"
    shutil.unpack_archive(archive, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def old(tmp_path):
    x, features = radiance(5, 70, 130), {"depth": np.ones((5, 70), np.float32)}
    return first_schema(tmp_path / "old.zarr", x, features), x


def test_the_first_schema_is_read(old):
    path, x = old
    before = contents(path)
    samples = chd.open(path)
    assert np.array_equal(samples.read(), x)
    assert samples.features["depth"].all()
    assert (inspect(path, verify=True)["damaged"], samples.attrs["schema_version"]) == ([], 1)
    assert np.array_equal(samples.to_dataset()["radiance"].values, x)
    with pytest.raises(StoreError, match=f"of schema 1.*chdstat convert {path} -o NEW"):
        Store.open(path, writable=True)
    assert contents(path) == before


def test_the_first_schema_is_converted_and_then_grows(old, tmp_path, run, capsys):
    path, x = old
    new = tmp_path / "new.zarr"
    first_schema(path / "direct", x / 2, {})
    run("convert", path, "-o", new)
    assert "130 samples per pixel" in capsys.readouterr().out
    samples = chd.open(new)
    assert np.array_equal(samples.read(), x)
    assert np.array_equal(samples.direct.read(), x / 2)
    assert samples.features["depth"].all()
    assert samples.attrs == chd.open(path).attrs | {"schema_version": 2}
    with Store.open(new, writable=True) as store:
        store.extend(140)
        assert store.complete_spp() == 130
    with pytest.raises(StoreError, match="of schema 2 already"):
        convert(new, tmp_path / "newer.zarr")
    with pytest.raises(StoreError, match="nothing was overwritten"):
        convert(path, new)


def test_a_store_that_was_really_of_the_first_schema_is_read(ball):
    samples = chd.open("ball.zarr")
    told = [hashlib.sha256(part.read().tobytes()).hexdigest() for part in (samples, samples.direct)]
    assert told == BALL
    assert samples.features["position"].mean() == pytest.approx(1.47096, abs=1e-4)
    assert inspect("ball.zarr", verify=True)["damaged"] == []
    found = chd.analyze(samples, progress=False)
    assert np.allclose(found["mean"], samples.read().mean(axis=-1), rtol=1e-6)
    estimate = chd.estimate(samples, progress=False)
    assert np.isfinite(estimate.radiance).all()


def test_a_store_that_was_really_of_the_first_schema_is_converted_and_appended_to(ball, run):
    before = contents(ball)
    more = {"spp": 130, "progress": False}
    with pytest.raises(StoreError, match="chdstat convert ball.zarr -o NEW --scene ball.xml"):
        chd.render("ball.xml", out="ball.zarr", **more)
    run("convert", "ball.zarr", "-o", "new.zarr", "--scene", "ball.xml", "-q")
    if chd.open("new.zarr").attrs["mitsuba_version"] == version("mitsuba"):
        found = chd.render("ball.xml", out="new.zarr", **more)
        fresh = chd.render("ball.xml", direct=True, backend="scalar", **more)
        for one, other in ((found, fresh), (found.direct, fresh.direct)):
            assert np.array_equal(one.read(), other.read())
    assert inspect("new.zarr", verify=True)["damaged"] == []
    assert {name: content for name, content in contents(ball).items() if name in before} == before


def test_a_store_is_not_converted_as_of_another_scene(ball):
    Path("ball.xml").write_text(Path("ball.xml").read_text().replace("0.8", "0.7"))
    with pytest.raises(StoreError, match="holds other samples than 'ball' gives now"):
        convert("ball.zarr", "new.zarr", scene="ball.xml", progress=False)
    convert("ball.zarr", "new.zarr")
    with pytest.raises(StoreError, match="'chdstat convert --scene' shows"):
        chd.render("ball.xml", out="new.zarr", spp=130, progress=False)


def test_a_conversion_that_stops_leaves_nothing(ball, monkeypatch):
    before = contents(ball)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(StoreError, match="cannot write to new.zarr: No space left .*nothing"):
            convert("ball.zarr", "new.zarr")
    assert contents(ball) == before
    convert("ball.zarr", "new.zarr")


def test_a_store_of_the_first_schema_that_was_killed_while_it_grew_is_read(old):
    path, x = old
    group = zarr.open_group(path, mode="r+")
    group.attrs["spp"] = 300
    group["ledger"].resize((1, 2, 5))
    assert np.array_equal(chd.open(path).read(), x)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("radiance/zarr.json", {"shape": [5, 70, 3, 10**9]}),
        ("radiance/zarr.json", {"shape": [5, 70, 4, 130]}),
        ("radiance/zarr.json", {"shape": [5, 70, 3, 60]}),
        ("radiance/zarr.json", {"shape": "?"}),
        ("ledger/zarr.json", {"shape": [1, 2]}),
        ("ledger/zarr.json", {"data_type": "?"}),
        ("zarr.json", {"attributes": {"schema_version": 1}}),
        ("zarr.json", {"attributes": []}),
    ],
)
def test_a_damaged_store_of_the_first_schema_is_an_error(old, name, change):
    path, _ = old
    file = path / name
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(StoreError):
        chd.open(path).read()


@pytest.mark.parametrize("harm", [truncate, flip])
def test_a_damaged_chunk_of_the_first_schema_is_named(old, harm):
    path, x = old
    harm(path / "radiance/c/0/1/0/1")
    assert Store.open(path).damaged() == [path / "radiance/c/0/1/0/1"]
    with pytest.raises(StoreError, match=r"cannot read .*radiance/c/0/1/0/1 \(.*convert"):
        chd.open(path).read()
    assert np.array_equal(chd.open(path).read(xs=slice(0, 64)), x[:, :64])
