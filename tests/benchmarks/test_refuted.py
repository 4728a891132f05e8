"""Images whose detail is no noise, so that a learned prior is wrong: errors and intervals.

For each image, law of the samples and number of samples, without features and with an albedo that
has nothing to do with the image: MSE and relMSE of the default estimate over those of the mean, and
the share of 90 % intervals that hold the truth by thirds of brightness. Then the same where the
left half of an image has little noise and the right half has much. Run with ``--benchmark-only
-s``; CHDSTAT_SEEDS images are drawn of each kind, CHDSTAT_FILM is their edge.
"""

from __future__ import annotations

import itertools
import os
import zlib
from collections.abc import Iterator

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage

from chdstat.estimators import combine

SEEDS = int(os.environ.get("CHDSTAT_SEEDS", "1"))
SIZE = int(os.environ.get("CHDSTAT_FILM", "64"))
NUMBERS = 16, 64, 256, 1024
LAWS = ("exponential", 0), ("gamma", 0.5), ("lognormal", 0.8), ("pareto", 0), ("exponential", 0.95)
"""Laws of the samples that are not null, and shares of nulls."""


def images(rng: np.random.Generator) -> Iterator[tuple[str, np.ndarray]]:
    """Yield names and truths, shape (y, x)."""
    y, x = np.indices((SIZE, SIZE))
    for factor, share in ((3, 0.1), (3, 5), (30, 0.5), (300, 1), (1000, 0.1)):
        glint = rng.random(x.shape) < share / 100
        yield f"glints x{factor}, {share} %", np.where(glint, 0.1 * factor, 0.1)
    for edge in (1, 2, 4):
        yield f"checker of {edge}", np.where((x // edge + y // edge) % 2, 1.0, 0.1)
    for edge in (1, 3, 5, 10):
        near = (abs(x - SIZE // 2) < (edge + 1) // 2) & (abs(y - SIZE // 3) < (edge + 1) // 2)
        yield f"lamp of {edge} x {edge}", np.where(near, 30.0, 0.1)
    for scale in (0.5, 1, 2, 4):
        smooth = ndimage.gaussian_filter(rng.normal(size=x.shape), scale, mode="wrap")
        yield f"texture of {scale}", 0.3 * np.exp(0.7 * smooth / smooth.std())
    lines = np.full(x.shape, 0.1)
    for angle, a, b in zip(*rng.uniform(0, (np.pi, SIZE, SIZE), (12, 3)).T, strict=True):
        lines[abs((y - a) * np.cos(angle) + (x - b) * np.sin(angle)) < 0.5] = 1.0
    yield "lines", lines
    page = Image.new("L", x.shape, 255)
    for row in range(0, SIZE, 12):
        ImageDraw.Draw(page).text((0, row), "samples of a pixel are draws", fill=0)
    yield "text", 0.05 + np.asarray(page) / 255
    yield "white noise", rng.uniform(0.05, 1, x.shape)
    yield "gradient", np.outer(np.linspace(0.02, 1, SIZE), np.linspace(0.5, 1, SIZE))
    yield "constant", np.full(x.shape, 0.1)


def drawn(truth: np.ndarray, law: str, null: float, rng: np.random.Generator) -> np.ndarray:
    """Return samples (y, x, channel, sample) of means `truth` (y, x, channel)."""
    shape = (*truth.shape[:2], 1, max(NUMBERS))
    of_one = {
        "exponential": lambda: rng.exponential(size=shape),
        "gamma": lambda: rng.gamma(0.5, 2, shape),
        "lognormal": lambda: rng.lognormal(-0.5, 1, shape),
        "pareto": lambda: (1 + rng.pareto(2.5, shape)) * 0.6,
    }[law]()
    light = np.where(rng.random(shape) < null, 0, of_one / (1 - null))
    return (truth[..., np.newaxis] * light).astype(np.float32)


def errors(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    squared = (image - truth) ** 2
    weight = 1 / (truth**2 + 0.01 * truth.mean() ** 2)
    return np.array([squared.mean(), (squared * weight).mean()])


def judged(x: np.ndarray, features: dict, truth: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Return both errors over the mean's, and the share of intervals that hold by thirds."""
    found, mean = combine(x, features=features), x.mean(axis=-1, dtype=np.float64)
    inside = ((found.low <= truth) & (truth <= found.high)).mean(axis=-1).ravel()
    order = np.argsort(truth[..., 0], axis=None, kind="stable")
    held = [inside[part].mean() for part in np.array_split(order, 3)]
    return errors(found.radiance, truth) / errors(mean, truth), held


def test_errors_over_the_mean_and_intervals(as_benchmark):
    table, shares = [], []
    for seed in range(SEEDS):
        for name, grey in images(np.random.default_rng(seed)):
            truth = grey[..., np.newaxis] * np.array((1, 0.8, 0.6))
            for law, null in LAWS:
                rng = np.random.default_rng((seed, zlib.crc32(f"{name} {law} {null}".encode())))
                x = drawn(truth, law, null, rng)
                unrelated = {"albedo": rng.uniform(size=truth.shape).astype(np.float32)}
                for features in ({}, unrelated):
                    row = [judged(x[..., :n], features, truth) for n in NUMBERS]
                    table.append([ratios for ratios, _ in row])
                    shares.append([held for _, held in row])
                    shown = "  ".join(f"{mse:6.2f} {rel:6.2f}" for mse, rel in table[-1])
                    print(f"{name:20s} {law:12s} {null:4.2f} {len(features)}  {shown}", flush=True)
    ratios, held = np.array(table), np.array(shares)
    above = (ratios.max(axis=-1) > np.where(np.array(NUMBERS) == min(NUMBERS), 1.15, 1.05)).mean(0)
    print(f"geometric means {np.exp(np.log(ratios).mean(axis=0)).round(2).tolist()} at {NUMBERS}")
    print(f"largest {ratios.max(axis=0).round(2).tolist()}; share above the limit {above.round(3)}")
    for n, of in zip(NUMBERS, held.swapaxes(0, 1), strict=True):
        print(
            f"{n:4d} spp: intervals hold {of.mean(axis=0).round(3)} by thirds, of which "
            f"{(of < 0.85).mean():.0%} less than 85 %, {(of > 0.96).mean():.0%} more than 96 %"
        )


def test_detail_with_little_noise_beside_much(as_benchmark):
    print(f"\nleft half: MSE over the mean's, share of intervals that hold, at {NUMBERS}")
    left, kinds = slice(SIZE // 2), ("texture of 1", "white noise", "constant")
    for name, noise in itertools.product(kinds, (0.01, 0.05, 0.2)):
        table = np.zeros((len(NUMBERS), 2))
        for seed in range(SEEDS):
            rng = np.random.default_rng(seed)
            grey = dict(images(rng))[name]
            truth = grey[..., np.newaxis] * np.array((1, 0.8, 0.6))
            x = drawn(truth, "exponential", 0, rng)
            quiet = 1 + noise * rng.normal(size=(SIZE, SIZE // 2, 1, max(NUMBERS)))
            x[:, left] = truth[:, left, :, np.newaxis] * quiet
            truth = truth[:, left]
            for row, n in zip(table, NUMBERS, strict=True):
                found = combine(x[..., :n])
                low, high = found.low[:, left], found.high[:, left]
                ratio, _ = errors(found.radiance[:, left], truth) / errors(
                    found.mean[:, left], truth
                )
                row += ratio / SEEDS, ((low <= truth) & (truth <= high)).mean() / SEEDS
        shown = "  ".join(f"{mse:6.2f} {held:.2f}" for mse, held in table)
        print(f"{name:14s} {noise:4.2f}  {shown}", flush=True)
