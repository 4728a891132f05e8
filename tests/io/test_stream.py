"""Streams of chdstat_writer.h: what a renderer wrote is read, whole, in parts, stopped or damaged.

The writer in Python, after the page of the format, stands in `writers`.
"""

import contextlib
import shutil
import struct
import subprocess
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
from google_crc32c import value as checksum

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, StoreError
from tests.io.writers import block, dense, end, entries, samples_block, start

DOCS = Path(__file__).parents[2] / "docs"
HEADER = chd.io.get_include() / "chdstat_writer.h"
STRICT = ("-Wall", "-Wextra", "-Werror", "-pthread")


RADIANCE = np.random.default_rng(3).gamma(2.0, size=(70, 90, 12, 3)).astype(np.float32)
COUNT = RADIANCE[..., 0].size
BLOCKS = [*dense(RADIANCE[:, :, :5]), *dense(RADIANCE[:, :, 5:])]
WHOLE = start(90, 70) + block(3, b"seed", b"7") + b"".join(BLOCKS) + end(COUNT)


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a stream."""

    def write(content, name="x.chds"):
        (tmp_path / name).write_bytes(content)
        return tmp_path / name

    return write


def test_samples_are_read_whole_and_in_parts(written, tmp_path, monkeypatch):
    expected = np.moveaxis(RADIANCE, 2, 3)
    samples = chd.io.read(written(WHOLE))
    assert np.array_equal(samples.read(), expected)
    assert np.array_equal(samples.save(tmp_path / "own.zarr").read(), expected)
    for window in (2**25, 1):
        monkeypatch.setattr("chdstat.io.stream._HELD", window)
        samples = chd.io.read(written(WHOLE))
        for part in ((slice(3, 80, 5), slice(60, 70), slice(2, 11, 4)), (slice(64), slice(64))):
            ys, xs, ss = (*part, slice(None))[:3]
            assert np.array_equal(samples.read(ys, xs, ss), expected[ys, xs, :, ss])
    assert samples.attrs["seed"] == 7


@pytest.mark.parametrize("window", [2**25, 1])
def test_pixels_have_any_number_of_samples_in_any_order(written, monkeypatch, window):
    monkeypatch.setattr("chdstat.io.stream._HELD", window)  # of 64 samples of each pixel
    rng, found, blocks, count = np.random.default_rng(4), {}, [], 0
    for number in range(60):
        x, y = 64 * (number % 2), 64 * (number // 2 % 2)
        shape = (min(64, 70 - y), min(64, 90 - x))
        pixels = {
            (int(row), int(column)): rng.normal(size=(rng.integers(1, 20), 2)).astype(np.float32)
            for row, column in zip(*(rng.integers(n // 4, size=200) for n in shape), strict=True)
        }
        blocks.append(samples_block(x, y, pixels))
        for (row, column), of in pixels.items():
            found.setdefault((y + row, x + column), []).append(of)
            count += len(of)
    samples = chd.io.read(written(start(90, 70, 2) + b"".join(blocks) + end(count)))
    assert samples.counts.sum() == count
    assert samples.spp > 64
    radiance = samples.read()
    for pixel, of in found.items():
        own = np.concatenate(of).T
        assert np.array_equal(samples[pixel], own)
        assert np.isnan(radiance[pixel][:, own.shape[1] :]).all()


def test_features_are_averages(written):
    sums = np.array([[2, 4, 6, 10], [1, 1, 1, 3]], "<f4")
    again = np.array([[1, 1, 1, 8]], "<f4")
    blocks = block(2, entries([0, 65], [2, 1]), sums.tobytes())
    blocks += block(2, entries([0], [1]), again.tobytes()) + BLOCKS[0] + end(64 * 64 * 5)
    features = chd.io.read(written(start(64, 64, 3, b"albedo depth") + blocks)).features
    assert features["albedo"].shape == (64, 64, 3)
    assert np.allclose(features["albedo"][0, 0], [1, 5 / 3, 7 / 3])
    assert features["depth"][0, 0] == 6
    assert features["depth"][1, 1] == 3
    assert features["depth"][5, 5] == 0


def test_provenance_is_what_the_files_say(written):
    told = {"renderer": "mine 1.2", "seed": "-3", "averaged": "x", "size": "evil", "note": "ü"}
    attributes = b"".join(block(3, k.encode(), v.encode()) for k, v in told.items())
    path = written(start(90, 70) + attributes + b"".join(BLOCKS) + end(COUNT))
    attrs = chd.io.read(path, unit="W").attrs
    assert attrs["renderer"] == "mine 1.2"
    assert attrs["seed"] == -3
    assert attrs["unit"] == "W"
    assert attrs["renderer_settings"] == {"averaged": "x", "size": "evil", "note": "ü"}


def test_files_of_one_image_are_read_together(written):
    halves = [b"".join(BLOCKS[:4]) + end(70 * 90 * 5), b"".join(BLOCKS[4:]) + end(70 * 90 * 7)]
    seeds = [block(3, b"seed", b"1"), block(3, b"seed", b"2")]
    paths = [
        written(start(90, 70) + seed + half, f"{number}.chds")
        for number, (seed, half) in enumerate(zip(seeds, halves, strict=True))
    ]
    samples = chd.io.read(*paths)
    assert np.array_equal(samples.read(), np.moveaxis(RADIANCE, 2, 3))
    assert "seed" not in samples.attrs
    again = written(start(90, 70) + seeds[0] + halves[1], "again.chds")
    with pytest.raises(InputError, match=r"again\.chds.*seed 1"):
        chd.io.read(paths[0], again)
    other = written(start(90, 71) + halves[0], "other.chds")
    with pytest.raises(InputError, match=r"other\.chds"):
        chd.io.read(paths[0], other)
    parts = [written(start(90, 70) + seeds[0] + b + end(n), f"part-{n}.chds") for b, n in PARTS]
    assert np.array_equal(chd.io.read(*parts).counts > 0, np.arange(90) < [[90]] * 64 + [[64]] * 6)


PARTS = [(b"".join(BLOCKS[:2]), 64 * 90 * 5), (BLOCKS[2], 6 * 64 * 5)]


def test_a_stopped_renderer_leaves_what_it_wrote(written):
    rest = len(WHOLE) - len(end(0))
    path = written(WHOLE[: rest - 1])
    with pytest.warns(UserWarning, match="has no end: its renderer was stopped") as caught:
        samples = chd.io.read(path)
    assert caught[0].filename == __file__
    last = 6 * 26 * 7
    assert samples.counts.sum() == COUNT - last
    assert np.array_equal(samples.read()[:, :, :, :5], np.moveaxis(RADIANCE[:, :, :5], 2, 3))
    first = len(WHOLE) - sum(map(len, BLOCKS)) - len(end(0))
    path = written(WHOLE[: first + 100])
    with pytest.warns(UserWarning, match="no end"), pytest.raises(StoreError, match="no samples"):
        chd.io.read(path)


def test_faults_are_named(written):
    def flipped(place):
        return WHOLE[:place] + bytes([WHOLE[place] ^ 1]) + WHOLE[place + 1 :]

    first = len(WHOLE) - sum(map(len, BLOCKS)) - len(end(0))
    tile, one = RADIANCE[:2, :2], {(0, 0): RADIANCE[0, 0]}
    cases = [
        (b"no stream", "no stream of samples"),
        (start(90, 70, version=2), "version 2, this chdstat reads 1"),
        (start(90, 70, order=0x04030201), "another order of bytes"),
        (flipped(16), "damaged at byte 0: its header is not"),
        (start(0, 70) + WHOLE[40:], "describes no image"),
        (start(90, 70, 3, b"colour"), "describes no image"),
        (flipped(first), f"damaged at byte {first}: there is no block"),
        (flipped(first + 8), f"damaged at byte {first}: a block is not what was written"),
        (flipped(first + 40), f"damaged at byte {first}: a block is not what was written"),
        (WHOLE + b"more", "does not end with its"),
        (WHOLE[: -len(end(0))] + end(3), "does not end with its"),
        (start(90, 70) + samples_block(0, 128, one), "does not fit the image"),
        (start(90, 70) + samples_block(1, 0, one), "does not fit the image"),
        (start(90, 70) + samples_block(64, 64, {(0, 63): tile[0, 0]}) + end(12), "outside"),
        (start(90, 70) + block(1, entries([5000], [1]), bytes(12)), "fit its pixels"),
        (start(90, 70) + block(1, entries([5, 5], [1, 1]), bytes(24)), "fit its pixels"),
        (start(90, 70) + block(1, b"abc", bytes(12)), "does not fit the image"),
        (start(90, 70) + end(0), "no samples"),
    ]
    for content, told in cases:
        with pytest.raises(StoreError, match=told):
            chd.io.read(written(content))
    samples = chd.io.read(written(flipped(len(WHOLE) - 5000)))
    with pytest.raises(StoreError, match="written"):
        samples.read()


def test_hostile_files_are_refused(written):
    whole = start(90, 70, 3, b"albedo") + block(3, b"seed", b"1")
    whole += block(2, entries([0], [2]), bytes(12)) + b"".join(BLOCKS[:2]) + end(64 * 90 * 5)
    rng, places = np.random.default_rng(0), [m for m in range(len(whole)) if m < 400]
    for number in range(200):
        mutated = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            place = int(rng.choice(places) if number % 2 else rng.integers(len(whole)))
            mutated[place] = rng.integers(256)
        if number % 5 == 0:
            del mutated[rng.integers(len(mutated)) :]
        if number % 7 == 0:  # a header that somebody signed
            mutated[8:38] = rng.bytes(30)
            mutated[38:42] = struct.pack("<I", checksum(bytes(mutated[:38])))
        with contextlib.suppress(ChdstatError), warnings.catch_warnings(action="ignore"):
            chd.io.read(written(bytes(mutated))).read()


def test_memory_is_bounded(written):
    rng = np.random.default_rng(0)
    tile = rng.normal(size=(64, 64, 64, 3)).astype(np.float32)
    one = next(dense(tile)), 64 * 64 * 64
    moved = [
        block(1, one[0][32 : 32 + 4 * 4096], one[0][32 + 4 * 4096 :], x, y)
        for y in range(0, 256, 64)
        for x in range(0, 256, 64)
    ]
    path = written(start(256, 256) + b"".join(moved) + end(16 * one[1]))
    tracemalloc.start()
    try:
        for *_, part in chd.io.read(path).blocks():
            assert part.nbytes == 64**3 * 12
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < path.stat().st_size / 3


# --- in C++ -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Return a function that compiles C++ and returns the program."""
    if shutil.which("g++") is None:
        pytest.skip("g++ is not there")
    folder = tmp_path_factory.mktemp("cpp")

    def build(source, *options):
        program = folder / source.stem
        command = ["g++", "-O2", *STRICT, *options, f"-I{HEADER.parent}", source, "-o", program]
        subprocess.run(command, check=True)
        return program

    return build


@pytest.fixture(scope="module")
def tracer(compiled):
    return compiled(DOCS / "how-to/cpp/tracer.cpp", "-std=c++17")


def test_the_header_is_shipped_and_short():
    text = HEADER.read_text(encoding="utf-8")
    code = [line for line in text.splitlines() if line.strip() and "//" not in line.split()[0]]
    assert len(code) < 320
    assert all("<" in line for line in text.splitlines() if line.startswith("#include"))


def test_a_path_tracer_is_analysed(tracer, tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    subprocess.run([tracer, "box.chds", "80", "70", "32", "5", "image.f32"], check=True)
    assert run("import", "box.chds", "-o", "box.zarr", "-q")[0] == 0
    samples = chd.open("box.zarr")
    assert samples.shape == (70, 80, 3, 32)
    assert samples.attrs["renderer"] == "tracer.cpp"
    assert samples.attrs["seed"] == 5
    image = np.fromfile("image.f32", "<f4").reshape(70, 80, 3)
    means = samples.read().astype(np.float64).mean(axis=-1)
    assert np.allclose(means, image, rtol=1e-6, atol=1e-7)
    assert np.allclose(samples.features["albedo"][35, 40], 0.7)
    assert np.allclose(samples.features["normal"][35, 40], [0, 0, 1])
    assert 4.9 < samples.features["depth"][35, 40] < 5.1
    part = samples.isel(y=slice(30, 38), x=slice(30, 38)).load()
    found = chd.analyze(part)
    assert np.allclose(found["mean"], image[30:38, 30:38], rtol=1e-4, atol=1e-6)


THREADS = """
#include "chdstat_writer.h"

int main(int, char **given) {
    chdstat::Writer writer(given[1], 150, 70, 2, "depth normal", 1250);
    writer.set("renderer", "threads"), writer.set("seed", 0), writer.set("note", 12);
    std::vector<std::thread> threads;
    for (int id = 0; id < 4; ++id)
        threads.emplace_back([&writer, id] {
            std::uint64_t state = std::uint64_t(id) + 1;
            for (int s = 0; s < 10000; ++s) {
                state = state * 6364136223846793005u + 1442695040888963407u;
                const int x = int(state >> 33) % 150, y = int(state >> 40) % 70;
                const double radiance[] = {double(y * 150 + x), double(id * 10000 + s)};
                const float features[] = {float(x), float(y), 1, 2};
                writer.add(x, y, radiance);
                writer.add_features(x, y, features);
            }
            const std::vector<float> tile(2 * 3 * 4 * 5, float(-id));
            writer.add_tile(10, 20, 3, 4, 5, tile.data());
            if (id == 2) writer.flush();
        });
    for (std::thread &thread : threads) thread.join();
    writer.close();
    chdstat::Writer pixel(given[2], 1, 1, 1);
    for (int s = 0; s < 150000; ++s) {
        const float number = float(s);
        pixel.add(0, 0, &number);
    }
}
"""


def test_threads_add_samples_of_any_pixel(compiled, tmp_path):
    (tmp_path / "threads.cpp").write_text(THREADS)
    program = compiled(tmp_path / "threads.cpp", "-std=c++11")
    subprocess.run([program, tmp_path / "x.chds", tmp_path / "pixel.chds"], check=True)
    assert np.array_equal(chd.io.read(tmp_path / "pixel.chds")[0, 0], [np.arange(150000)])
    samples = chd.io.read(tmp_path / "x.chds")
    assert samples.counts.sum() == 4 * 10000 + 4 * 60
    assert samples.attrs["renderer_settings"] == {"note": "12"}
    pixel, number = np.moveaxis(samples.read(), 2, 0)
    tile = pixel <= 0
    tile[0, 0] = False
    assert np.argwhere(tile.any(axis=-1)).min(axis=0).tolist() == [20, 10]
    assert tile.sum() == 4 * 60
    scattered = np.isfinite(pixel) & ~tile
    assert (scattered <= (pixel == np.arange(70 * 150).reshape(70, 150, 1))).all()
    assert np.array_equal(np.sort(number[scattered]), np.arange(40000))
    depth, normal = samples.features["depth"], samples.features["normal"]
    hit = scattered.any(axis=-1)
    assert np.array_equal(depth, np.where(hit, np.arange(150), 0))
    assert np.array_equal(normal[..., 0], np.where(hit, np.arange(70)[:, None], 0))


FAULTS = """
#include "chdstat_writer.h"

template <class Action> void told(const Action &action) {
    try {
        action();
    } catch (const std::exception &error) {
        std::puts(error.what());
    }
}

int main(int, char **given) {
    chdstat::Writer writer(given[1], 8, 6);
    told([&] { writer.add(8, 0, 1, 1, 1); });
    told([&] { writer.add(0, -1, 1, 1, 1); });
    told([&] { writer.close(); });
    told([&] { writer.add(0, 0, 1, 1, 1); });
    told([&] { chdstat::Writer("/nowhere/x.chds", 8, 6); });
    told([&] { chdstat::Writer(given[1], 0, 6); });
    told([&] { chdstat::Writer(given[1], 8, 6, 3, "colour"); });
    const float numbers[] = {1};
    told([&] { chdstat::Writer(given[1], 8, 6).add_features(0, 0, numbers); });
    told([&] {
        chdstat::Writer full("/dev/full", 8, 6);
        full.add(0, 0, 1, 1, 1);
        full.close();
    });
}
"""


def test_the_header_says_what_is_wrong(compiled, tmp_path):
    (tmp_path / "faults.cpp").write_text(FAULTS)
    program = compiled(tmp_path / "faults.cpp", "-std=c++20")
    done = subprocess.run([program, tmp_path / "x.chds"], check=True, capture_output=True)
    expected = [
        "pixel (x = 8, y = 0) added to an image of 8 x 6",
        "pixel (x = 0, y = -1) added to an image of 8 x 6",
        "pixel (x = 0, y = 0) added to a closed file of 8 x 6",
        "cannot write /nowhere/x.chds: No such file or directory",
        "width and height must be 1 to 65536, at most 2^28 pixels in all, and channels 1 to 64",
        "features are albedo, normal, position and depth, each once; not colour",
        "no features were named",
        "cannot write /dev/full: No space left on device",
    ]
    assert done.stdout.decode().splitlines() == [f"chdstat::Writer: {text}" for text in expected]
