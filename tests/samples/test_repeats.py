"""Passes that repeat each other are told, as a whole and in tiles; what has no noise is not.

The noise is continuous: that independent passes are equal in a tile has no chance to happen.
"""

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
    with warnings.catch_warnings(record=True, action="always") as caught:
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


SHAPES = [(64, 48, 3, 16), (33, 17, 3, 5)]


# --- whole passes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("nulls", [0, 0.6])
def test_copies_are_named(shape, nulls):
    x = noise(*shape, nulls=nulls)
    assert not told(x)
    assert "(1: pass 2 of pass 0)" in told(with_copies(x, _2=0))


def test_copies_without_detail_are_named():
    """Equal passes that are even show no noise of their own; that other passes differ tells."""
    x = np.ones((32, 32, 1, 16), np.float32) * np.random.default_rng(0).random(16, np.float32)
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


@pytest.mark.parametrize("seed", range(4))
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


@pytest.mark.parametrize("suffix", [".exr", ".npy"])
def test_files_given_twice_are_named(tmp_path, suffix):
    def write(name, image):
        path = tmp_path / f"{name}{suffix}"
        if suffix == ".exr":
            return chd.io.write_exr(path, image, attributes={"frame": name})
        np.save(path, image[..., np.newaxis])
        return path

    axes = {} if suffix == ".exr" else {"axes": "yxcs"}
    passes = [write(str(seed), noise(24, 20, 3, seed=seed)) for seed in range(4)]
    chd.io.read(*passes, **axes)
    with pytest.warns(InputWarning, match=rf"0\{suffix} is given 2 times") as caught:
        chd.io.read(*passes, passes[0], **axes)
    assert caught[0].filename == __file__
    again = write("4", noise(24, 20, 3, seed=1))
    with pytest.warns(InputWarning, match=rf"\(1: 4\{suffix} of 1\{suffix}\)"):
        chd.io.read(*passes, again, **axes)
