"""Neighbours: CHDs are continuous, and a blend of two across an edge (finding 10)."""

from __future__ import annotations

import numpy as np

from chdstat._core.arrays import generator
from chdstat._core.positive import Counts, Floats
from chdstat._core.resampling import interval_of
from chdstat.studies.log_chds import SAME_SHAPE, LogChds, squared_distance
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData, ratio_of

__all__ = ["measure"]

_CONTINUOUS = 0.25
"""Squared distance of neighbours over that of any two pixels: from a quarter on, they are not half
as far apart. It is Geary's c of the CHDs, 1 without any order in space."""
_BLEND = 0.75
"""Share of the squared distance to the nearer side that blending both sides explains: 1 of a blend,
0.5 of a CHD that moves from the one to the other as a whole; half way."""
_EDGE = (3 * SAME_SHAPE) ** 2
"""Squared distance between the pixels on both sides from which there is an edge."""
_MIXED = (0.2, 0.8)
"""Weights between which a pixel is a blend; beyond, it lies on one side."""
_LEAST = 30
"""Pixels on edges that are needed."""
_BIN = 0.1


def measure(data: SceneData) -> Outcome:
    """Compare neighbours with other pixels, and pixels on edges with blends of both sides."""
    chds, blocks, level = data.chds, data.whole().blocks, level_of(2)
    near = _near(chds)
    # Distances to a pixel drawn at random.
    other = generator(0).permutation(near.size)
    far = squared_distance(chds.flat, chds.flat[other], width=_BIN)
    ratio = ratio_of(near.ravel(), far, blocks, level=level)
    name = "squared distance of neighbours over that of any two pixels"
    tests, missing = [ClaimTest(name, ratio, most=_CONTINUOUS)], list[str]()
    left, nearest, pixels = _edges(chds)
    if len(left) < _LEAST:
        missing = [f"needs {_LEAST} pixels on edges between different CHDs, found {len(left)}"]
    else:
        on_edges = blocks[pixels]
        rest, whole = on_edges.sums(left), on_edges.sums(nearest)
        blend = interval_of(lambda w: 1 - (w @ rest) / (w @ whole), on_edges, level=level)
        tests.append(ClaimTest("share explained by a blend of both sides", blend, least=_BLEND))
    image = np.sqrt(np.maximum(near, 0))
    return Outcome(
        tuple(tests),
        tuple(missing),
        details={"edge_pixels": len(left)},
        plot_data=PlotData("map", {"distance to neighbours": (np.empty(0), image)}),
    )


def _near(chds: LogChds) -> Floats:
    """Return mean squared distances to the pixels below and to the right, shape (y, x)."""
    squares = np.full((2, *chds.halves.shape[:2]), np.nan)
    squares[0, :-1] = squared_distance(chds[:-1], chds[1:], width=_BIN)
    squares[1, :, :-1] = squared_distance(chds[:, :-1], chds[:, 1:], width=_BIN)
    known = np.isfinite(squares)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, squares, 0).sum(axis=0) / known.sum(axis=0))


def _edges(chds: LogChds) -> tuple[Floats, Floats, Counts]:
    """Return, of pixels on edges, what a blend leaves, the distance to the nearer side, and which.

    A pixel is F = G + w (H - G) with G and H on both sides. Each half of the samples has a weight w
    of its own, so that their residuals are independent and the product of these is the squared
    residual without noise.
    """
    height, width = chds.halves.shape[:2]
    number = np.arange(height * width).reshape(height, width)
    edges = []
    for before, here, after in (
        (np.s_[:, :-2], np.s_[:, 1:-1], np.s_[:, 2:]),
        (np.s_[:-2], np.s_[1:-1], np.s_[2:]),
    ):
        edge = squared_distance(chds[before], chds[after], width=_BIN) >= _EDGE
        g, f, h = (chds[place].halves[edge] for place in (before, here, after))
        step, rise = h - g, f - g
        weights = (rise * step).sum(axis=-1) / (step * step).sum(axis=-1)
        mixed = (weights.mean(axis=-1) > _MIXED[0]) & (weights.mean(axis=-1) < _MIXED[1])
        rest = rise - weights[..., np.newaxis] * step
        left = (rest[:, 0] * rest[:, 1]).sum(axis=-1) * _BIN
        nearest = np.minimum(
            *(squared_distance(LogChds(f), LogChds(side), width=_BIN) for side in (g, h))
        )
        edges.append((left[mixed], nearest[mixed], number[here][edge][mixed]))
    left, nearest, pixels = (np.concatenate(v) for v in zip(*edges, strict=True))
    return left, nearest, pixels
