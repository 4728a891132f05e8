"""Equal numbers: as many positive samples of every pixel of every scene, to compare what is left.

What one sees of a distribution depends on how many samples one has: a distribution function is the
smoother, and has the more modes that can be told, the more there are. Scenes with other shares of
nulls, or other spp, would differ by that alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator
from chdstat.findings.evidence import Evidence
from chdstat.findings.resampling import Blocks

__all__ = ["common_count", "drawn"]

Floats = npt.NDArray[np.float64]


def common_count(evidences: Sequence[Evidence], *, least: int) -> int:
    """Return a number of positive samples that half of the pixels of every scene have.

    Of pixels that have any, and of the channel in the middle; not less than `least`.
    """
    counts = [_positive(evidence) for evidence in evidences]
    middles = [np.median(n[n > 0]) if n.any() else 0 for n in counts]
    return max(least, int(min(middles, default=0)))


def drawn(evidence: Evidence, n: int, *, pixels: int, across: int = 8) -> tuple[Floats, Blocks]:
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

    Returns
    -------
    tuple
        Radiance, shape (pixel, n), and the blocks that the pixels lie in.
    """
    rng, blocks = generator(0), evidence.whole(across).blocks
    found, places = [np.empty((0, n))], [np.empty(0, dtype=np.int64)]
    for patch in evidence.scattered(pixels, across=across, able=_positive(evidence) >= n):
        x = evidence.radiance(patch)
        light = x[:, x.shape[1] // 2]
        # Positive ones first, in an order drawn at random.
        rank = np.where(light > 0, rng.random(light.shape), 2)
        first = np.argpartition(rank, n - 1, axis=-1)[:, :n]
        found.append(np.take_along_axis(light, first, axis=-1))
        places.append(patch.blocks.of_pixel)
    return np.concatenate(found), Blocks(np.concatenate(places), blocks.region)


def _positive(evidence: Evidence) -> npt.NDArray[np.int64]:
    """Return how many positive samples each pixel has within its log histogram, shape (y, x)."""
    counts = evidence.summary["log_counts"]
    middle = counts.isel(channel=counts.sizes["channel"] // 2)
    return np.asarray(middle.sum("log_bin").to_numpy(), dtype=np.int64)
