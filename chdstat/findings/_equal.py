"""Equal numbers: as many positive samples of every pixel of every scene, to compare what is left.

What one sees of a distribution depends on how many samples one has: a distribution function is the
smoother, and has the more modes that can be told, the more there are. Scenes with other shares of
nulls, or other spp, would differ by that alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator, is_bad
from chdstat.findings.evidence import Evidence
from chdstat.findings.resampling import Blocks

__all__ = ["common_count", "drawn"]

Floats = npt.NDArray[np.float64]


def common_count(evidences: Sequence[Evidence], *, least: int) -> int:
    """Return a number of positive samples that half of the pixels of every scene have.

    Of pixels that have any, and of the channel in the middle; not less than `least`.
    """
    middles = []
    for evidence in evidences:
        counts = evidence.summary["log_counts"].to_numpy()
        positive = counts[:, :, counts.shape[2] // 2].sum(axis=-1)
        middles.append(np.median(positive[positive > 0]) if positive.any() else 0)
    return max(least, int(min(middles, default=0)))


def drawn(
    evidence: Evidence, n: int, *, pixels: int, across: int = 8, seed: int = 0
) -> tuple[Floats, Blocks]:
    """Draw `n` positive samples of pixels spread over the image, of the channel in the middle.

    Parameters
    ----------
    evidence
        The scene.
    n
        Samples of each pixel; pixels with fewer are left out.
    pixels
        How many, at most, as many in each of `across` x `across` blocks of the image.
    across
        Blocks along each side.
    seed
        Of the draws.

    Returns
    -------
    tuple
        Radiance, shape (pixel, n), and the blocks that the pixels lie in.
    """
    rng, samples = generator(seed), evidence.samples
    height, width, channels, _ = samples.shape
    rows, columns = min(height, across), min(width, across)
    each = max(1, pixels // (rows * columns))
    found, places = [np.empty((0, n))], [np.empty(0, np.int64)]
    # A block at a time: all of an image may not fit in memory.
    for block in range(rows * columns):
        row, column = divmod(block, columns)
        ys = slice(-(-row * height // rows), -(-(row + 1) * height // rows))
        xs = slice(-(-column * width // columns), -(-(column + 1) * width // columns))
        x = samples.read(ys, xs)
        good = ~is_bad(x).any(axis=2).reshape(-1, samples.spp)
        light = x[:, :, channels // 2].reshape(-1, samples.spp)
        positive = good & (light > 0)
        able = np.flatnonzero(np.count_nonzero(positive, axis=-1) >= n)
        some = np.sort(rng.permutation(able)[:each])
        # Positive ones first, in an order drawn at random.
        rank = np.where(positive[some], rng.random((len(some), samples.spp)), 2)
        first = np.argpartition(rank, n - 1, axis=-1)[:, :n]
        found.append(np.take_along_axis(light[some], first, axis=-1).astype(np.float64))
        places.append(np.full(len(some), block))
    region = np.zeros(rows * columns, dtype=np.int64)
    return np.concatenate(found), Blocks(np.concatenate(places), region)
