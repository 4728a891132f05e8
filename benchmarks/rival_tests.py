"""Tests of renders that others use, each as one score: the larger, the less alike.

`SCORES` are functions of a render and its reference, `PUBLISHED` the limits that their authors
give. All get what is best for them: the noise of the reference counts where a test knows noise, and
where a test has a share of values that may fail, its score is that quantile, so that the limit of
each can be tuned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special, stats
from scipy.ndimage import gaussian_filter

XYZ = np.array(
    [
        [0.412453, 0.357580, 0.180423],
        [0.212671, 0.715160, 0.072169],
        [0.019334, 0.119193, 0.950227],
    ]
)
"""Of linear R, G and B, ITU-R BT.709."""
TILE = 8


@dataclass(frozen=True)
class Means:
    """Means of batches of a render.

    Attributes
    ----------
    batches
        Shape (y, x, channel, batch).
    size
        Samples of a batch.
    """

    batches: np.ndarray
    size: int

    @cached_property
    def mean(self) -> np.ndarray:
        return np.asarray(self.batches.mean(axis=-1, dtype=float))

    @cached_property
    def error(self) -> np.ndarray:
        """Variance of the mean."""
        return np.asarray(self.batches.var(axis=-1, ddof=1, dtype=float) / self.number)

    @property
    def number(self) -> int:
        return self.batches.shape[-1]

    @cached_property
    def xyz(self) -> Means:
        return Means(np.einsum("ij,yxjk->yxik", XYZ, self.batches, optimize=True), self.size)

    @cached_property
    def luminance(self) -> Means:
        light = np.einsum("c,yxck->yxk", XYZ[1], self.batches, optimize=True)
        return Means(light[:, :, np.newaxis], self.size)

    @cached_property
    def tiles(self) -> Means:
        """Means of tiles of 8 x 8 pixels."""
        x = self.batches
        y, u = (n // TILE for n in x.shape[:2])
        return Means(x.reshape(y, TILE, u, TILE, *x.shape[2:]).mean(axis=(1, 3)), self.size)


def mitsuba(a: Means, b: Means) -> float:
    """Return the z of which .25 % are larger: of X, Y and Z, from the reference's variance."""
    sample = np.maximum(b.xyz.error * b.number * b.size, 1e-4)
    error = sample * (1 / (a.number * a.size) + 1 / (b.number * b.size))
    z = np.sort((np.abs((a.mean - b.mean) @ XYZ.T) / np.sqrt(error)).ravel())
    return float(z[int(np.ceil(0.9975 * z.size)) - 1])


def _welch(a: Means, b: Means) -> np.ndarray:
    """Return p-values of equal means, two-sided; 1 where nothing varies and the means agree."""
    one, other = a.error, b.error
    with np.errstate(all="ignore"):
        freedom = (one + other) ** 2 / (one**2 / (a.number - 1) + other**2 / (b.number - 1))
        t = np.abs(a.mean - b.mean) / np.sqrt(one + other)
    p = 2 * special.stdtr(freedom, -t)
    near = np.abs(a.mean - b.mean) <= 1e-5 * np.abs(b.mean)
    return np.where(one + other > 0, p, np.where(near, 1, 1e-300))


def _smallest(p: np.ndarray) -> float:
    """Return the smallest p-value times the number of p-values, as a score."""
    return float(-np.log10(max(p.min() * p.size, 1e-300)))


def welch(a: Means, b: Means) -> float:
    """Return Bonferroni's p-value over pixels and channels."""
    return _smallest(_welch(a, b))


def welch_tiles(a: Means, b: Means) -> float:
    """Return Bonferroni's p-value over tiles of 8 x 8 pixels and channels."""
    return _smallest(_welch(a.tiles, b.tiles))


def welch_histogram(a: Means, b: Means) -> float:
    """Return the p-value of a uniform histogram of p-values of luminance, of 20 bins."""
    p = _welch(a.luminance, b.luminance)
    counts = np.histogram(p[p < 1], bins=20, range=(0, 1))[0]
    if not counts.any():
        return 0.0
    return float(-np.log10(max(stats.chisquare(counts).pvalue, 1e-300)))


def _display(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    srgb = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.round(255 * srgb) / 255


def blender(a: Means, b: Means) -> float:
    """Return the difference of 8-bit values that 1 % of the pixels exceed in a channel."""
    apart = np.abs(_display(a.mean) - _display(b.mean)).max(axis=-1)
    return float(np.quantile(apart, 0.99))


def rmse(a: Means, b: Means) -> float:
    """Return the root of the mean squared error."""
    return float(np.sqrt(np.mean((a.mean - b.mean) ** 2)))


def relmse(a: Means, b: Means) -> float:
    """Return the relative mean squared error, with .01 in the denominator."""
    return float(np.mean((a.mean - b.mean) ** 2 / (b.mean**2 + 0.01)))


def blurred_rmse(a: Means, b: Means) -> float:
    """Return the RMSE of images blurred by a Gaussian of 4 pixels."""
    return float(np.sqrt(np.mean(gaussian_filter(a.mean - b.mean, (4, 4, 0)) ** 2)))


def flip(a: Means, b: Means) -> float:
    """Return the mean of FLIP of images of display, at 67 pixels a degree."""
    from flip_evaluator import evaluate

    images = (np.clip(x.mean, 0, 1).astype(np.float32) for x in (b, a))
    return float(evaluate(*images, "LDR", inputsRGB=False, applyMagma=False)[1])


Score = Callable[[Means, Means], float]
SCORES: dict[str, Score] = {
    "Mitsuba z": mitsuba,
    "Welch pixel": welch,
    "Welch histogram": welch_histogram,
    "Welch tiles": welch_tiles,
    "Blender": blender,
    "RMSE": rmse,
    "relMSE": relmse,
    "blurred RMSE": blurred_rmse,
    "FLIP": flip,
}


def published(alpha: float, pixels: int) -> dict[str, float]:
    """Return the limits of scores that have some: those of tests of a session, at its alpha."""
    each = 1 - (1 - 0.01) ** (1 / pixels)
    return {
        "Mitsuba z": float(stats.norm.isf(each / 2)),  # its own alpha, .01 of an image
        "Welch pixel": -np.log10(alpha),
        "Welch histogram": -np.log10(alpha),
        "Welch tiles": -np.log10(alpha),
        "Blender": 4 / 255,
    }
