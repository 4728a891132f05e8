"""Passes that repeat each other: how often they are found, and how often others are accused.

Images are random: sizes, passes, nulls, heavy tails, surfaces without noise, averages, rounding.
"""

from __future__ import annotations

import time
import warnings

import numpy as np
import pytest

import chdstat as chd
from chdstat.samples.dependence import warn_of_repeats

pytestmark = pytest.mark.usefixtures("as_benchmark")

IMAGES = 200


def image(rng):
    """Return passes of a random image, where at least a quarter of the pixels has noise."""
    height, width, spp = (int(n) for n in rng.integers([16, 16, 3], [120, 120, 40]))
    channels = int(rng.choice([1, 3]))
    shape = height, width, channels, spp
    base = np.exp(rng.normal(size=(height // 8 + 1, width // 8 + 1)) * rng.uniform(0, 3))
    base = np.kron(base, np.ones((8, 8)))[:height, :width, np.newaxis, np.newaxis]
    averaged = int(rng.choice([1, 16, 256]))
    noise = rng.gamma(rng.uniform(0.1, 2) * averaged, size=shape) / averaged
    noise *= rng.random((height, width, 1, spp)) >= rng.choice([0, 0.5, 0.9])
    still = np.arange(height)[:, np.newaxis, np.newaxis, np.newaxis] < height * rng.uniform(0, 0.75)
    smooth = base * (1 + 0.1 * np.linspace(0, 1, width)[:, np.newaxis, np.newaxis])
    x = np.where(still, smooth * rng.choice([0, 1]), base * noise)
    kind = rng.choice([np.float32, np.float16])
    return np.clip(x, 0, 6e4).astype(kind).astype(np.float32)


def warned(x):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of_repeats(lambda y, column, s: x[y, column, :, s], x.shape, "x")
    return bool(caught)


def repeated(x, kind, rng):
    """Return the passes as a renderer would write them that repeats its random numbers."""
    x, height, spp = x.copy(), x.shape[0], x.shape[3]
    if kind == "all passes":
        return np.repeat(x[..., :1], spp, axis=-1)
    if kind == "one pass":
        copy, first = rng.choice(spp, 2, replace=False)
        x[..., copy] = x[..., first]
    elif kind == "half of the passes":
        x[..., spp - spp // 2 :] = x[..., : spp // 2]
    elif kind == "tiles of the lower half":
        x[height // 32 * 16 :] = x[height // 32 * 16 :, :, :, :1]
    return x


KINDS = ("none", "all passes", "one pass", "half of the passes", "tiles of the lower half")


def test_repeats_are_found_and_others_not_accused():
    print()
    for kind in KINDS:
        hits = np.array(
            [
                warned(
                    repeated(image(np.random.default_rng(seed)), kind, np.random.default_rng(seed))
                )
                for seed in range(IMAGES)
            ]
        )
        error = np.sqrt(hits.mean() * (1 - hits.mean()) / IMAGES)
        print(f"repeated: {kind:32} warned {100 * hits.mean():6.2f} % +- {100 * error:.2f}")
        assert hits.mean() == 0 if kind == "none" else hits.mean() > 0.9


def test_the_look_costs_a_small_share_of_a_summary():
    print()
    for shape in ((128, 128, 3, 64), (512, 512, 3, 64), (256, 256, 3, 512)):
        x = np.random.default_rng(0).gamma(0.5, size=shape).astype(np.float32)
        samples, shares = chd.Samples.from_array(x), []
        for _ in range(3):
            start = time.process_time()
            warned(x)
            looked = time.process_time()
            chd.summarize(samples, progress=False)
            shares.append((looked - start) / (time.process_time() - looked))
        print(f"{shape}: {100 * np.median(shares):.1f} % of summarize")
        assert np.median(shares) < 0.2
