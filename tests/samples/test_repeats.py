"""Passes that repeat each other are told, as a whole and in tiles; what has no noise is not.

The noise is continuous: that independent passes are equal in a tile has no chance to happen.
"""

import shutil
import warnings

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputWarning
from chdstat.samples.dependence import warn_of_repeats


def noise(*shape, seed=0, nulls=0.0):
    rng = np.random.default_rng(seed)
    x = rng.gamma(0.5, size=shape).astype(np.float32)
    return x * (rng.random((*shape[:2], 1, *shape[3:])) >= nulls).astype(np.float32)


def told(array, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        chd.Samples.from_array(array, axes="yxcs", **options)
    assert {w.category for w in caught} <= {InputWarning}
    assert {w.filename for w in caught} <= {__file__}
    assert len(caught) <= 1
    return str(caught[0].message) if caught else ""


def with_copies(x, **copies):
    """Return samples of which some are those of another number, ``_5=1``."""
    x = x.copy()
    for copy, first in copies.items():
        x[..., int(copy[1:])] = x[..., first]
    return x


SHAPES = [(64, 48, 3, 16), (33, 17, 3, 5), (6, 9, 1, 8)]


# --- whole passes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("nulls", [0, 0.6])
def test_copies_are_named(shape, nulls):
    x = noise(*shape, nulls=nulls)
    assert not told(x)
    assert "(1: pass 2 of pass 0)" in told(with_copies(x, _2=0))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_renderer_that_ignores_its_seed(shape):
    spp = shape[-1]
    said = told(np.repeat(noise(*shape)[..., :1], spp, axis=-1))
    assert f"all {spp} passes that were compared are equal" in said
    assert "Unless nothing in the image is random" in said


def test_a_renderer_with_few_seeds():
    x = noise(64, 48, 3, 8)
    assert "(8: pass 8 of pass 0, pass 9 of pass 1" in told(np.tile(x, 2))
    assert "(6: " in told(with_copies(x, **{f"_{i}": 0 for i in range(1, 7)}))


# --- tiles ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("edge", "nulls", "averaged"), [(16, 0, 1), (32, 0.5, 1), (20, 0.5, 64)])
def test_tiles_that_are_equal_in_all_passes(edge, nulls, averaged):
    shape = (96, 80, 3, 6)
    x = sum(noise(*shape, seed=seed, nulls=nulls) for seed in range(averaged)) / averaged
    y, x0 = 2 * 16, 16
    x[y : y + edge, x0 : x0 + edge] = x[y : y + edge, x0 : x0 + edge, :, :1]
    said = told(x)
    assert f"equal in {(edge // 16) ** 2} of 30 tiles" in said
    assert "y = 32, x = 16" in said


def test_a_tile_that_two_passes_share():
    x = noise(96, 80, 3, 16)
    x[16:32, 48:64, :, 9] = x[16:32, 48:64, :, 4]
    assert "equal in 1 of 30 tiles of 16 x 16 pixels, such as pass 4 and pass 9" in told(x)


def test_tiles_that_have_the_seeds_of_passes_cycle():
    x = noise(96, 80, 3, 12)
    x[:48, :, :, 6:] = x[:48, :, :, :6]
    assert "equal in 15 of 30 tiles" in told(x)


# --- what is no evidence --------------------------------------------------------------------------


def ramp(height=64, width=48):
    return np.linspace(1, 3, height * width).reshape(height, width, 1, 1).astype(np.float32)


CLEAN = {
    "black": np.zeros((64, 48, 3, 16), np.float32),
    "white": np.ones((64, 48, 3, 16), np.float32),
    "a lamp before noise": np.where(np.arange(48)[:, None, None] < 30, 7, noise(64, 48, 3, 16)),
    "a sky before noise": np.where(
        np.arange(64)[:, None, None, None] < 30, ramp(), noise(64, 48, 3, 16)
    ),
    "a sky before some noise in each tile": np.where(
        np.arange(27)[:, None, None, None] < 14, ramp(27, 100), noise(27, 100, 1, 8)
    ),
    "half black": noise(64, 48, 3, 16) * (np.arange(64) < 32)[:, None, None, None],
    "rare light": noise(64, 48, 3, 64, nulls=0.999),
    "fireflies over what has no noise": ramp() + noise(64, 48, 3, 64, nulls=0.998),
    "one of two lights": ramp() * (np.random.default_rng(0).random((64, 48, 1, 16)) < 0.5),
    "few levels": np.round(noise(64, 48, 3, 16) * 3),
    "nothing else": noise(64, 48, 3, 1),
    "two by two": noise(2, 2, 3, 16),
    "bad": np.where(noise(64, 48, 3, 16, seed=1) > 0.1, np.nan, 1.0),
}


@pytest.mark.parametrize("name", CLEAN)
def test_passes_without_repeats_are_taken_in_silence(name):
    assert not told(np.ascontiguousarray(CLEAN[name], np.float32))


def test_splats_of_a_wide_filter_are_no_copies():
    """Pixels beside each other share a sample, over an image that has no noise."""
    rng = np.random.default_rng(4)
    x = np.repeat(np.repeat(ramp(), 3, axis=2), 64, axis=3)
    for number in range(64):
        y, column = rng.integers(60), rng.integers(44)
        x[y : y + 5, column : column + 5, :, number] += rng.gamma(1.0, size=(5, 5, 1))
    assert not told(x)


def test_samples_that_a_pixel_lacks_are_no_copies():
    counts = np.full((64, 48), 16)
    counts[:, 20:] = 3
    assert not told(noise(64, 48, 3, 16), counts=counts)


@pytest.mark.parametrize("seed", range(8))
def test_no_false_alarm_by_chance(seed):
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 80)), int(rng.integers(1, 80)), int(rng.choice([1, 3])))
    shape = (*shape, int(rng.integers(1, 40)))
    base = rng.random((*shape[:3], 1)) ** rng.uniform(0, 3)
    x = base * noise(*shape, seed=seed, nulls=rng.random())
    assert not told(np.round(x, int(rng.integers(0, 4))).astype(np.float32) if seed % 2 else x)


# --- large images and files -----------------------------------------------------------------------


def test_large_images_are_looked_at_in_part():
    read: list[int] = []

    def counted(ys, xs, ss):
        shape = ys.stop - ys.start, xs.stop - xs.start, 3, ss.stop
        read.append(int(np.prod(shape)))
        return np.random.default_rng(len(read)).random(shape, dtype=np.float32)

    warn_of_repeats(counted, (2160, 3840, 3, 1000), "film")
    assert sum(read) < 3 * 2**23

    def few(ys, xs, ss):
        return counted(ys, xs, slice(1)).repeat(ss.stop, axis=-1)

    with pytest.warns(InputWarning, match="film: all 1000 passes"):
        warn_of_repeats(few, (2160, 3840, 3, 1000), "film")


PASSES = [noise(24, 20, 3, seed=seed) for seed in range(6)]


def exr(path, image, **attributes):
    return chd.io.write_exr(path, image, attributes=attributes)


def test_one_file_given_several_times(tmp_path):
    path = exr(tmp_path / "a.exr", PASSES[0])
    other = exr(tmp_path / "b.exr", PASSES[1])
    (tmp_path / "link.exr").symlink_to(path)
    for given, times in (([path] * 8, 8), ([path, other, tmp_path / "link.exr"], 2)):
        with pytest.warns(InputWarning, match=rf"a\.exr is given {times} times") as caught:
            chd.io.read(*given)
        assert len(caught) == 1
        assert caught[0].filename == __file__
    chd.io.read(path, other)


def test_copies_of_files(tmp_path):
    for number, image in enumerate(PASSES[:5]):
        exr(tmp_path / f"{number}.exr", image, frame=f"{number}")
    shutil.copy(tmp_path / "1.exr", tmp_path / "5.exr")
    exr(tmp_path / "6.exr", PASSES[3], frame="6, rendered later")
    with pytest.warns(InputWarning, match=r"\(2: 5.exr of 1.exr, 6.exr of 3.exr\)"):
        chd.io.read(tmp_path)
    # What the message says: leave them out.
    chd.io.read(*(tmp_path / f"{number}.exr" for number in range(5)))


def test_a_renderer_that_ignores_its_seed_writes_other_headers(tmp_path):
    for number in range(4):
        exr(tmp_path / f"{number}.exr", PASSES[0], date=f"12:00:{number}")
    with pytest.warns(InputWarning, match=r"all 4 passes .* are equal, 0.exr to 3.exr"):
        chd.io.read(tmp_path)


def stacked(copies):
    return np.stack([*PASSES, *PASSES[:copies]])


def npy(folder, images):
    np.save(folder / "x.npy", images)
    return [folder / "x.npy"], {"axes": "syxc"}


def several_npy(folder, images):
    for number, image in enumerate(images):
        np.save(folder / f"{number}.npy", image[..., np.newaxis])
    return sorted(folder.glob("*.npy")), {"axes": "yxcs"}


@pytest.mark.parametrize("write", [npy, several_npy], ids=lambda f: f.__name__)
def test_what_reads_arrays_tells_of_copies(tmp_path, write):
    files, options = write(tmp_path, stacked(0))
    assert chd.io.read(*files, **options).spp == 6
    (tmp_path / "again").mkdir()
    files, options = write(tmp_path / "again", stacked(2))
    with pytest.warns(InputWarning, match=r"copies among 8 passes that were compared \(2: "):
        chd.io.read(*files, **options)
