"""Errors, energy and intervals by groups of pixels and channels.

An image that is better than its mean as a whole can be worse where it has little noise, or in a
block. A pixel and channel belongs to one group of each `Grouping`. Arrays have the shape (seed, y,
x, channel). Groups by noise take the noise from renders of other seeds: samples that choose the
groups of their own estimate would choose pixels whose mean happens to be good, and parts of the
reference those where the reference is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import chdstat as chd
from chdstat._core.arrays import block_numbers
from chdstat._core.image_scales import relative_scale
from chdstat.comparison import Judge
from chdstat.estimators import Combination

DECILES = 10
EDGE = 32
"""Edge of the blocks whose energy is measured, in pixels."""
UNITS = 16
"""Blocks along an edge whose errors count as independent: standard errors come from these. Larger
blocks would count what differs from place to place in the scene as chance."""
WORSE = 1.1
"""Error over the mean's that a group must not surely exceed."""
SURE = 2
"""Standard errors that are sure."""


@dataclass(frozen=True)
class Noise:
    """Noise of the renders of a scene.

    Attributes
    ----------
    variance
        Variance of a sample of each render, shape (seed, y, x, channel).
    mean
        Mean of each render, same shape.
    seeds
        Number of renders that are judged. There is at least one more.
    """

    variance: np.ndarray
    mean: np.ndarray
    seeds: int

    @classmethod
    def of(cls, renders: Sequence[chd.Samples], seeds: int) -> Noise:
        # In float64, equal samples of float32 have a variance of exactly 0.
        every = (samples.read().astype(np.float64) for samples in renders)
        found = [(x.var(axis=-1, ddof=1), x.mean(axis=-1)) for x in every]
        return cls(*map(np.stack, zip(*found, strict=True)), seeds)

    def groupings(self, reference: Judge) -> dict[str, np.ndarray]:
        """Return the group of each pixel and channel, by the name of the grouping.

        -1 is in no group: what has no noise in the other renders is exact, not quiet.
        """
        shape = self.variance[: self.seeds].shape
        variance, mean = (self._of_others(x) for x in (self.variance, self.mean))
        scale = relative_scale(mean, mean.mean(axis=(1, 2), keepdims=True))
        light = reference.mean.mean(axis=-1, keepdims=True)
        across = shape[1] // EDGE
        blocks = block_numbers(*shape[1:3], across=across)[..., np.newaxis]
        same = {
            "image": np.zeros(1, int),
            "block": blocks,
            "channel": np.arange(shape[-1]),
            "third": np.digitize(light, np.quantile(light, (1 / 3, 2 / 3))),
        }
        return {
            "noise": _deciles(variance),
            "relative noise": _deciles(variance / scale),
            **{name: np.broadcast_to(group, shape) for name, group in same.items()},
        }

    def exact(self) -> np.ndarray:
        """Return what all renders know exactly: samples that never vary, and have light."""
        known = (self.variance == 0).all(axis=0) & (self.mean != 0).any(axis=0)
        return np.broadcast_to(known, self.variance[: self.seeds].shape)

    def error_of_sum(self, group: np.ndarray, n: int) -> np.ndarray:
        """Return the standard error of the sum of the mean of n samples over each group.

        Channels of a pixel count as fully correlated, which they nearly are.
        """
        pixel = np.sqrt(self.variance.mean(axis=0) / n)
        return errors_of_sums(group[0], pixel)

    def _of_others(self, x: np.ndarray) -> np.ndarray:
        """Return the mean over all renders but the one that is judged."""
        return (x.sum(axis=0) - x[: self.seeds]) / (len(x) - 1)


def _deciles(value: np.ndarray) -> np.ndarray:
    """Return the decile of each value of a seed, -1 for 0."""
    group = np.full(value.shape, -1)
    for of, one in zip(group, value, strict=True):
        noisy = one > 0
        rank = np.argsort(np.argsort(one[noisy], kind="stable"))
        of[noisy] = rank * DECILES // max(len(rank), 1)
    return group


def sums(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the sum of the values of each group."""
    inside = group >= 0
    return np.bincount(group[inside], np.broadcast_to(value, group.shape)[inside])


def errors_of_sums(group: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the standard error of the sum over each group of an image (y, x, channel)."""
    every = range(group.max() + 1)
    return np.array(
        [np.sqrt(np.square(np.where(group == g, error, 0).sum(axis=-1)).sum()) for g in every]
    )


def means(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the mean of the values of each group."""
    return sums(group, value) / np.maximum(sums(group, np.ones(1)), 1)


def ratios(group: np.ndarray, errors: np.ndarray, of_mean: np.ndarray) -> np.ndarray:
    """Return errors over the mean's in each group, their standard errors, and a z.

    Shape (3, group). The ratio is NaN where the errors of the mean do not add up to more than 0. z
    is that of errors minus `WORSE` times the mean's, from 0. Standard errors are those of sums over
    blocks and seeds, which pairs both errors.
    """
    seeds, height, width = group.shape[:3]
    block = block_numbers(height, width, across=UNITS)
    unit = block[np.newaxis, ..., np.newaxis] + UNITS**2 * np.arange(seeds).reshape(-1, 1, 1, 1)
    unit = np.broadcast_to(unit, group.shape)
    found = np.full((3, group.max() + 1), np.nan)
    for g in range(group.max() + 1):
        inside = group == g
        own, mean, here = (
            np.bincount(unit[inside], x[inside]) for x in (errors, of_mean, np.ones(group.shape))
        )
        own, mean = own[here > 0], mean[here > 0]
        more = own - WORSE * mean
        found[2, g] = more.sum() / max(_error_of_sum(more), 1e-300)
        if mean.sum() > 0:
            ratio = own.sum() / mean.sum()
            found[:2, g] = ratio, _error_of_sum(own - ratio * mean) / mean.sum()
    return found


def _error_of_sum(values: np.ndarray) -> float:
    return float(np.sqrt(len(values)) * values.std(ddof=1)) if len(values) > 1 else np.inf


def holds(found: Combination, reference: Judge) -> np.ndarray:
    """Return whether intervals hold the truth, shape (y, x, channel): its mean is the share.

    As much noise again as the reference has tells what its noise takes from the share (simulation
    extrapolation: Cook and Stefanski 1994, doi:10.1080/01621459.1994.10476871).
    """
    rng = np.random.default_rng(0)
    noisier = reference.mean + reference.error * rng.standard_normal(reference.mean.shape)
    once, twice = ((found.low <= r) & (r <= found.high) for r in (reference.mean, noisier))
    return 2.0 * once - twice
