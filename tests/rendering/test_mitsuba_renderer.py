"""Random streams of the renderer, and its samples against Mitsuba's own averages.

Statistical tests compare many pixels at once: with the Sidak correction each of them fails falsely
with probability `ALPHA`, if it were run with a new seed. Seeds are fixed, so they fail never or
always; each has a negative control that must fail.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats

import chdstat as chd
from chdstat.rendering import render_pixels, seeds
from chdstat.rendering.backend import activate, probe
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.rendering.seeds import max_spp
from chdstat.samples.tiles import TILE, chunk_grid
from chdstat.scenes import load_scene
from tests.luminance import LUMINANCE
from tests.rendering.numbers import ALPHA, NUMBERS, register_numbers

SIZE = (16, 16)


@pytest.fixture(scope="module")
def streams(backend) -> str:
    """Make the integrator of `NUMBERS` known to a backend and return its name."""
    register_numbers(backend)
    return backend


@pytest.fixture(scope="module")
def box() -> chd.Samples:
    """Return 1024 spp of the Cornell box."""
    return chd.render("cornell-box", spp=1024, size=SIZE, backend="scalar")


def vectors(x: np.ndarray) -> np.ndarray:
    """Return samples (..., channel, sample) as rows of three channels."""
    return np.moveaxis(x, -2, -1).reshape(-1, 3)


def repeats(x: np.ndarray) -> int:
    rows = vectors(x)
    return len(rows) - len(np.unique(rows, axis=0))


def agree(p: np.ndarray) -> bool:
    """Tell whether no p-value is too small for so many of them (Sidak)."""
    return bool(p.min() > -np.expm1(np.log1p(-ALPHA) / p.size))


def p_of_variance(z: np.ndarray) -> float:
    """Return the p-value that numbers have the variance 1 around 0, from both sides."""
    p = scipy.stats.chi2.cdf((z**2).sum(), z.size)
    return float(2 * min(p, 1 - p))


# --- numbering ----------------------------------------------------------------------------------


@pytest.mark.parametrize("span", [seeds.CHUNKS, seeds.PIXELS])
@pytest.mark.parametrize("seed", [0, 1, 12345, 2**40])
def test_numbers_are_one_to_one(span, seed):
    index = np.array([0, 1, 2, span // 2, span - 1])
    number = np.array([seeds.number_of(seed, int(i), span) for i in index])
    assert ((number >= 0) & (number < span)).all()
    assert np.array_equal((number - number[0]) % span, index)


def test_passes_are_shuffled_one_to_one():
    """Of as many numbers drawn at random from 983 040, thousands would come twice."""
    first, rest = (
        np.array([seeds.shuffled(i, seed=7) for i in range(start, stop)])
        for start, stop in ((0, 2**13), (983_040, seeds.PASSES))
    )
    assert len(np.unique(first)) == len(first)
    assert np.array_equal(np.sort(rest), np.arange(983_040, seeds.PASSES))
    # Of a random order, ranks of neighbours do not correlate: standard errors .011 and .004. What
    # earlier versions could draw keeps its order, and the rest has one of its own.
    for part, most in ((first, 0.044), (rest, 0.016)):
        assert abs(np.corrcoef(part[1:], part[:-1])[0, 1]) < most
    assert 0.99 * 983_040 < first.max() < 983_040


def test_no_two_passes_of_an_image_share_a_stream():
    """Mitsuba seeds pixel i of a pass with the seed times the pixels of the tile, plus i."""
    size, spp = (150, 130), 40
    streams = seeds.Streams(size, 3)
    owned = [
        (streams.of_pass(chunk, sample) * chunk.shape[0] * chunk.shape[1] + i) % 2**32
        for chunk in chunk_grid(size[1], size[0], spp)
        for sample in range(chunk.ss.start, chunk.ss.stop)
        for i in (0, TILE**2 - 1)
    ]
    assert len(set(owned)) == len(owned) == 2 * 9 * spp
    assert max(owned) < 2**32 - seeds.PIXELS


def test_the_last_passes_vary_as_independent_ones(streams):
    """Means of 1024 samples from the passes that earlier versions could not draw."""
    if streams != "scalar":
        pytest.skip("a wavefront has no passes")
    with activate(probe("scalar")):
        renderer = MitsubaRenderer(Job.of(NUMBERS, size=SIZE, seed=5, backend="scalar"))
        last = max_spp("scalar", *SIZE)
        chunk = replace(next(chunk_grid(16, 16, 64)), ss=slice(last - 2048, last))
        x = renderer.chunk(chunk)
    z = (x.reshape(16, 16, 3, 2, 1024).mean(axis=-1, dtype=np.float64) - 0.5) * np.sqrt(12 * 1024)
    each = np.moveaxis(z, 2, 0).reshape(3, -1)
    assert agree(np.array([p_of_variance(row) for row in each]))
    assert not agree(np.array([p_of_variance(np.sqrt(0.8) * row) for row in each]))


def test_seeds_shuffle_passes_independently():
    # 20 000 of 983 040 numbers for each of two seeds: 407 in common by chance, give or take 20.
    numbers = [{seeds.shuffled(i, seed) for i in range(20_000)} for seed in (0, 1, 2, 3, 2**40)]
    for one, two in itertools.combinations(numbers, 2):
        assert 300 < len(one & two) < 510


def test_a_pass_owns_its_streams():
    # Mitsuba multiplies the seed by the number of pixels, modulo 2^32.
    last = seeds.PASSES - 1
    for pixels in {h * w for h in range(1, 65) for w in range(1, 65)}:
        for number in (0, 1, 77_777, last):
            seed = seeds.pass_seed(number, pixels)
            assert 0 <= seed < 2**32
            assert seed * pixels % 2**32 == number * TILE**2


def test_numbers_are_shared_by_none():
    assert seeds.PASSES * TILE**2 <= 2**32 - seeds.PIXELS
    assert seeds.CHUNKS <= 2**32 - seeds.PIXELS
    for seed in (0, 1, 55, 10_945):
        renderer = MitsubaRenderer(Job.of("cornell-box", size=(8, 8), seed=seed, backend="scalar"))
        numbers = [renderer._streams.of_pixel(y, x) for y in range(8) for x in range(8)]
        assert len(set(numbers)) == 64
        assert 2**32 - seeds.PIXELS <= min(numbers) <= max(numbers) < 2**32


def test_the_most_samples_before_streams_repeat():
    assert max_spp("scalar", 64, 64) == seeds.PASSES
    assert max_spp("scalar", 65, 64) == seeds.PASSES // 2
    assert max_spp("llvm", 1024, 1024) >= 2**28
    # Enough for a film frame at the 2048 spp of the paper's histograms.
    assert max_spp("scalar", 1920, 1080) == 2048
    assert max_spp("scalar", 3840, 2160) == 512
    # But for what single pixels own, each of the 2^32 numbers is one pixel's sample.
    assert max_spp("scalar", 1024, 1024) * 2**20 > 0.99 * 2**32


# --- streams ------------------------------------------------------------------------------------


def test_no_random_number_is_drawn_twice(streams):
    # 100 000 triples of 23 random bits each: two are equal by chance with probability 1e-11.
    drawn = [
        chd.render(NUMBERS, spp=66, size=(72, 10), seed=seed, backend=streams).read()
        for seed in (0, 1)
    ]
    pixels = [(y, x) for y in range(10) for x in (0, 40, 71)]
    single = render_pixels(NUMBERS, pixels, spp=100, size=(72, 10), backend=streams)
    rows = np.concatenate([vectors(x) for x in (*drawn, single)])
    assert repeats(rows.T) == 0
    assert repeats(np.concatenate([rows, rows[:1]]).T) == 1


def test_random_numbers_are_uniform_and_independent(streams):
    x = chd.render(NUMBERS, spp=128, size=(24, 24), seed=3, backend=streams).read()
    p = scipy.stats.kstest(x.reshape(24 * 24, -1), "uniform", axis=-1).pvalue
    assert agree(p)
    centred = (x - 0.5) * np.sqrt(12)
    neighbours = {
        "pixel": centred[:, 1:] * centred[:, :-1],
        "row": centred[1:] * centred[:-1],
        "sample": centred[..., 1:] * centred[..., :-1],
        "batch": centred[..., 64:] * centred[..., :64],
        "channel": centred[:, :, 1:] * centred[:, :, :-1],
    }
    z = np.array([v.mean() * np.sqrt(v.size) for v in neighbours.values()])
    assert agree(2 * scipy.stats.norm.sf(abs(z)))
    itself = (centred * centred).mean() * np.sqrt(x.size)
    assert not agree(2 * scipy.stats.norm.sf(np.array([itself])))


@functools.cache
def random_numbers(backend: str, seed: int) -> np.ndarray:
    options: dict[str, Any] = {"spp": 2048, "size": (12, 12), "seed": seed, "backend": backend}
    return chd.render(NUMBERS, **options).read()


@pytest.mark.parametrize("size", [32, 1024])
def test_means_vary_as_independent_ones(streams, size):
    """The variance of the mean of n is 1 / 12 n, for each random number and in each pixel."""
    drawn = np.stack([random_numbers(streams, seed) for seed in range(3)])
    means = drawn.reshape(3, 12, 12, 3, -1, size).mean(axis=-1, dtype=np.float64)
    z = (means - 0.5) * np.sqrt(12 * size)
    each = np.moveaxis(z, 3, 0).reshape(3, -1)
    assert agree(np.array([p_of_variance(row) for row in each]))
    neighbours = np.moveaxis(z[:, :, 1:] * z[:, :, :-1], 3, 0).reshape(3, -1)
    side_by_side = neighbours.mean(axis=1) * np.sqrt(neighbours.shape[1])
    assert agree(2 * scipy.stats.norm.sf(abs(side_by_side)))


def batch_spread(x: np.ndarray, size: int) -> float:
    """Return how far batch means spread beyond independent ones, in standard errors.

    The variance of means of n independent samples is 1/n of the samples' variance; the excess,
    relative to it, is averaged over pixels, whose scatter gives its standard error.
    """
    means = x.reshape(*x.shape[:-1], -1, size).mean(axis=-1)
    variance = x.var(axis=-1, ddof=1)
    excess = (size * means.var(axis=-1, ddof=1) / variance - 1).ravel()
    return float(excess.mean() / (excess.std() / np.sqrt(excess.size)))


def test_samples_are_independent(box):
    # A fresh seed would fail with probability 7e-6 (4.5 standard errors, 256 pixels).
    x = LUMINANCE @ box.read().astype(np.float64)
    assert abs(batch_spread(x, 32)) < 4.5
    assert batch_spread(np.repeat(x[..., :512], 2, axis=-1), 32) > 4.5


# --- agreement with Mitsuba's averages ----------------------------------------------------------


@pytest.fixture(scope="module")
def moments() -> tuple[np.ndarray, np.ndarray, int]:
    """Mean and second moment of luminance by Mitsuba's `moment` integrator, and its spp."""
    spp = 1024
    source = dict(load_scene("cornell-box").source)
    film = {**source["sensor"]["film"], "width": SIZE[0], "height": SIZE[1]}
    scene = load_scene({**source, "sensor": {**source["sensor"], "film": film}})
    with activate(probe("scalar")) as mi:
        built = scene.load()
        moment = mi.load_dict({"type": "moment", "nested": source["integrator"]})
        # Layers: R, G, B, X, Y, Z, then the second moments of X, Y, Z.
        image = np.array(moment.render(built, seed=100_000, spp=spp), np.float64)
    return image[..., 4], image[..., 7], spp


def p_of_equal_means(x: np.ndarray, mean: np.ndarray, spp: int) -> np.ndarray:
    """Return p-values of a Z-test per pixel: samples against another mean of `spp` samples."""
    error = x.std(axis=-1, ddof=1) * np.sqrt(1 / x.shape[-1] + 1 / spp)
    return 2 * scipy.stats.norm.sf(abs(x.mean(axis=-1) - mean) / error)


def test_moments_agree_with_mitsuba(box, moments):
    x = LUMINANCE @ box.read().astype(np.float64)
    mean, second, spp = moments
    assert agree(p_of_equal_means(x, mean, spp))
    assert agree(p_of_equal_means(x**2, second, spp))
    # A tenth more light is noticed.
    assert not agree(p_of_equal_means(1.1 * x, mean, spp))
    assert not agree(p_of_equal_means((1.1 * x) ** 2, second, spp))


# --- single pixels ------------------------------------------------------------------------------

PIXELS = [(0, 0), (3, 12), (8, 8), (12, 4), (15, 15)]


def test_single_pixels_are_those_of_the_image(box, backend):
    single = render_pixels("cornell-box", PIXELS, spp=1024, size=SIZE, backend=backend)
    stored = np.stack([box[pixel] for pixel in PIXELS])
    a, b = (LUMINANCE @ x.astype(np.float64) for x in (single, stored))
    assert agree(p_of_equal_means(a, b.mean(axis=-1), 1024))
    assert agree(scipy.stats.ks_2samp(a, b, axis=-1, method="asymp").pvalue)
    lit = vectors(np.concatenate([single, stored]))
    lit = lit[(lit > 0).any(axis=1)]
    assert repeats(lit.T) == 0
    # Other pixels have other distributions.
    assert not agree(scipy.stats.ks_2samp(a, b[::-1], axis=-1, method="asymp").pvalue)


# --- wavefronts ---------------------------------------------------------------------------------


def test_a_wavefront_agrees_with_scalar(box, wavefront):
    x, y = (
        LUMINANCE @ s.read().astype(np.float64)
        for s in (box, chd.render("cornell-box", spp=1024, size=SIZE, seed=9, backend=wavefront))
    )
    assert agree(p_of_equal_means(x, y.mean(axis=-1), y.shape[-1]))
    assert agree(p_of_equal_means(x**2, (y**2).mean(axis=-1), y.shape[-1]))
    assert abs(batch_spread(y, 32)) < 4.5
    assert not agree(p_of_equal_means(x, 1.1 * y.mean(axis=-1), y.shape[-1]))


def test_a_wavefront_repeats_to_the_bit(wavefront):
    draw = {"size": (72, 20), "seed": 4, "backend": wavefront}
    most = chd.render("cornell-box", spp=100, **draw).read()
    assert np.array_equal(chd.render("cornell-box", spp=100, **draw).read(), most)
    for spp in (7, 64, 65):
        assert np.array_equal(chd.render("cornell-box", spp=spp, **draw).read(), most[..., :spp])


def test_a_wavefront_ignores_other_scenes(wavefront):
    alone = chd.render("cornell-box", spp=8, size=SIZE, backend=wavefront).read()
    with activate(probe(wavefront)) as mi:
        other = mi.load_dict(mi.cornell_box())
        beside = chd.render("cornell-box", spp=8, size=SIZE, backend=wavefront).read()
        assert np.isfinite(np.array(mi.render(other, spp=1))).all()
    assert np.array_equal(beside, alone)
