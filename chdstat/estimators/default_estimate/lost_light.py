"""Lost light: the light by which the mean of an image exceeds the image that is proposed.

Denoisers and limits of fireflies take rare bright samples away, and with them light that belongs to
the image. A single pixel cannot tell how much it lost. All pixels together can, since the sum of
the image is known from its samples. `lost_light` gives the missing part of that sum back, in
proportion to radiance.

That is right only if all pixels lost light in proportion to radiance. The light of a lamp or a
caustic that few samples have found belongs to a few pixels, and the others must not get it. So the
image is cut into blocks of several sizes, down to the pixel. What a block lacks according to one
half of the samples is multiplied by what it lacks according to the other half, whose noise is
independent. Where light is equally rare everywhere, the mean of these products is the square of
what the image lacks. If the largest blocks differ, each gets more or less, as far as its own noise
allows. The more the smaller blocks differ, the less is given back. Empirical Bayes estimates of
rates in regions use the same moments (Marshall 1991, "Mapping disease and mortality rates using
empirical Bayes estimators", doi:10.2307/2347593): there cases are counted and the unit is a
population, here it is radiance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage, special

from chdstat._core.arrays import Reals
from chdstat.estimators.default_estimate.mean_weights import Proposal

__all__ = ["lost_light"]

_BLOCKS = (32, 16, 8, 4, 2, 1)
"""Edges of the blocks in pixels."""
_NOISE = 2.0
"""Variances of what the image lacks, and standard errors of the products, that may be noise."""
_AROUND = 2.0
"""Standard deviation in pixels of the window that the spread of samples is pooled over."""


def lost_light(proposed: Sequence[Proposal], count: Reals, moved: Reals, level: float) -> Reals:
    """Return the light that each pixel gets back, and how far its interval reaches to each side.

    Parameters
    ----------
    proposed
        Proposals of all samples, of one half of them and of the other.
    count
        Samples of each pixel, shape (y, x, channel).
    moved
        Weight of the proposal beside the mean, from 0 to 1, shape (y, x, 1) or (y, x, channel). A
        pixel of weight 0 stays the mean and has lost nothing.
    level
        Probability of the interval. The light that pixels lack, divided by their radiance, counts
        as gamma distributed; its variance is that of the image's mean plus that between blocks.

    Returns
    -------
    ndarray
        The light given back, and how far the interval reaches below and above it, shape (3, y, x,
        channel).

    Examples
    --------
    An image that is too dark by .3 everywhere gets that back. One that lacks as much in a corner
    gets hardly anything:

    >>> image, corner = 0.7 * np.ones((32, 32, 1)), np.zeros((32, 32, 1))
    >>> corner[:4, :4] = 0.3 * 64
    >>> for lost in (0.3, corner):
    ...     parts = [Proposal(image, image + lost, 0.3 * image, image) for _ in range(3)]
    ...     given, *_ = lost_light(parts, 16 + 0 * image, 1 + 0 * image, 0.9)
    ...     print(given.mean().round(2))
    0.3
    0.0
    """
    whole = proposed[0]
    # Where samples hardly vary, the light is known.
    spread = ndimage.gaussian_filter(np.square(whole.error) * count, (_AROUND, _AROUND, 0))
    share = np.minimum(np.abs(whole.image), np.sqrt(spread)) * moved
    # The channels of a sample vary together: add their errors, not their variances.
    lacking, *halves = (((p.mean - p.image) * moved).mean(axis=-1) for p in proposed)
    unit, noise = share.mean(axis=-1), np.square((whole.error * moved).mean(axis=-1))
    total, doubt = unit.sum(dtype=np.float64), noise.sum(dtype=np.float64)
    if not (total > 0 and doubt > 0):
        return np.zeros((3, *share.shape))
    rate, variance = lacking.sum(dtype=np.float64) / total, doubt / total**2
    of_halves = np.prod([half.sum(dtype=np.float64) for half in halves]) / total**2
    alike, agreed = max(rate**2, of_halves), min(rate**2, of_halves)
    found, sure = alike, [alike]
    for edge in _BLOCKS:
        one, other, radiance = (_sums(image, edge) for image in (*halves, unit))
        products, norm = np.vdot(one, other), np.square(radiance).sum()
        found = max(found, products / norm)
        sure.append((products - _NOISE * 2 * edge * doubt / np.sqrt(unit.size)) / norm)
    # The largest blocks have rates of their own, shrunk towards that of the image.
    explained = max(sure[:2])
    lit = np.maximum(_sums(unit, _BLOCKS[0]), 1e-12 * total)
    own = np.maximum(variance * total / lit, _sums(noise, _BLOCKS[0]) / lit**2)
    trusted = (explained - alike) / (explained - alike + own)
    apart = trusted * (_sums(lacking, _BLOCKS[0]) / lit - rate)
    # Light that only one half has found may be the light of a single pixel.
    significant = rate * (1 - _NOISE * variance / agreed) if agreed > _NOISE * variance else 0.0
    given = (significant + apart) * (explained / max(sure) if explained else 0)
    likely = np.maximum(rate + apart, np.sqrt(variance))
    shape = likely**2 / (variance + trusted * own + found - explained)
    low, high = (special.gammaincinv(shape, 0.5 + p / 2) * likely / shape for p in (-level, level))
    maps = (given, np.maximum(given - low, 0), np.maximum(high - given, 0))
    places = np.meshgrid(
        *((np.arange(n) + 0.5) / _BLOCKS[0] - 0.5 for n in unit.shape), indexing="ij"
    )
    smooth = (ndimage.map_coordinates(x, places, order=1, mode="nearest") for x in maps)
    return np.stack([x[..., np.newaxis] * share for x in smooth])


def _sums(image: Reals, edge: int) -> Reals:
    """Return the sums of an image (y, x) over blocks; those at its far edges may be smaller."""
    rows, columns = (np.arange(0, size, edge) for size in image.shape)
    image = image.astype(np.float64)
    return np.asarray(np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1))
