"""Lost light: what the mean of an image has more than the image that is proposed in its place.

Denoisers and limits of fireflies take rare bright samples away, and with them light that belongs to
the image. No pixel can tell what it lost, but all together they can: the sum of the image is known
from its samples. `lost_light` gives back what is missing of that sum, in proportion to radiance.

Whether that is right depends on where the light belongs. That of a lamp or a caustic which few
samples have found belongs to some pixels, and no other must get any. So the image is cut into
blocks of several sizes, down to the pixel, and what a block lacks by one half of the samples is
multiplied by what it lacks by the other half, of which the noise is independent. Where light is
equally rare everywhere, the mean of these products is the square of what the image lacks. Where the
largest blocks differ, each gets more or less, as far as its own noise allows; the more the smaller
ones differ, the less is given back. Empirical Bayes estimates of rates in regions use the same
moments (Marshall 1991, "Mapping disease and mortality rates using empirical Bayes estimators",
doi:10.2307/2347593): there cases are counted and the unit is a population, here it is radiance.
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
    """Return what is given back to each pixel, and how far an interval of it reaches to each side.

    Parameters
    ----------
    proposed
        Proposals of all samples, of one half of them and of the other.
    count
        Samples of each pixel, shape (y, x, channel).
    moved
        How far pixels are moved from the mean to the proposal, from 0 to 1, shape (y, x, 1) or (y,
        x, channel). What stays the mean has lost nothing.
    level
        Probability of the interval. What pixels lack, over their radiance, is taken for gamma
        distributed: its variance is that of the mean of all and that between blocks.

    Returns
    -------
    ndarray
        What is given back, and how far the interval reaches below and above it, shape (3, y, x,
        channel).

    Examples
    --------
    An image that is .3 too dark everywhere gets that back. One that lacks as much, but in a corner,
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
    # Light that no sample varies by is known.
    spread = ndimage.gaussian_filter(np.square(whole.error) * count, (_AROUND, _AROUND, 0))
    share = np.minimum(np.abs(whole.image), np.sqrt(spread)) * moved
    # The channels of a sample vary together: add their errors, not their variances.
    lacking, *halves = (((p.mean - p.image) * moved).mean(axis=-1) for p in proposed)
    unit, noise = share.mean(axis=-1), np.square((whole.error * moved).mean(axis=-1))
    total, doubt = unit.sum(dtype=np.float64), noise.sum(dtype=np.float64)
    if not (total > 0 and doubt > 0):
        return np.zeros((3, *share.shape))
    rate, variance = lacking.sum(dtype=np.float64) / total, doubt / total**2
    alike = max(rate**2, np.prod([half.sum(dtype=np.float64) for half in halves]) / total**2)
    found, sure = alike, [alike]
    for edge in _BLOCKS:
        one, other, radiance = (_sums(image, edge) for image in (*halves, unit))
        products, norm = np.vdot(one, other), np.square(radiance).sum()
        found = max(found, products / norm)
        sure.append((products - _NOISE * 2 * edge * doubt / np.sqrt(unit.size)) / norm)
    # The largest blocks have rates of their own, drawn to that of the image.
    explained = max(sure[:2])
    lit = np.maximum(_sums(unit, _BLOCKS[0]), 1e-12 * total)
    own = np.maximum(variance * total / lit, _sums(noise, _BLOCKS[0]) / lit**2)
    trusted = (explained - alike) / (explained - alike + own)
    apart = trusted * (_sums(lacking, _BLOCKS[0]) / lit - rate)
    significant = rate - _NOISE * variance / rate if rate**2 > _NOISE * variance else 0.0
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
