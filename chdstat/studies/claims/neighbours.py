"""Neighbours: CHDs are continuous, and a blend of two across an edge (finding 10)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator
from chdstat._core.resampling import Blocks, Interval, interval_of
from chdstat.studies.log_chds import SAME_SHAPE, LogChds, squared_distance
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData

__all__ = ["BLEND", "CONTINUOUS", "measure"]

Floats = npt.NDArray[np.float64]

CONTINUOUS = 0.25
"""Squared distance of neighbours over that of any two pixels: from a quarter on, they are not half
as far apart. It is Geary's c of the CHDs, 1 without any order in space."""
BLEND = 0.75
"""Share of the squared distance to the nearer side that blending both sides explains: 1 of a blend,
0.5 of a CHD that moves from the one to the other as a whole; half way."""
EDGE = (3 * SAME_SHAPE) ** 2
"""Squared distance between the pixels on both sides from which there is an edge."""
MIXED = (0.2, 0.8)
"""Weights between which a pixel is a blend; beyond, it lies on one side."""
LEAST = 30
"""Pixels on edges that are needed."""
_BIN = 0.1
_PARTS = 2


def measure(data: SceneData) -> Outcome:
    """Compare neighbours with other pixels, and pixels on edges with blends of both sides."""
    chds, level = data.chds, level_of(_PARTS)
    blocks = data.whole().blocks
    near, far = _near(chds), _far(chds)
    ratio = ClaimTest.of(
        "squared distance of neighbours over that of any two pixels",
        _ratio(near, far, blocks, level),
        most=CONTINUOUS,
    )
    left, nearest, pixels = _edges(chds)
    parts, missing = [ratio], []
    if len(left) < LEAST:
        missing = [f"needs {LEAST} pixels on edges between different CHDs, found {len(left)}"]
    else:
        spread = _explained(left, nearest, blocks[pixels], level)
        parts.append(ClaimTest.of("share explained by a blend of both sides", spread, least=BLEND))
    image = np.sqrt(np.maximum(near, 0)).reshape(chds.halves.shape[:2])
    return Outcome(
        tuple(parts),
        tuple(missing),
        details={"edge_pixels": len(left)},
        plot_data=PlotData("map", {"distance to neighbours": (np.empty(0), image)}),
    )


def _near(chds: LogChds) -> Floats:
    """Return mean squared distances to the pixels below and to the right, shape (pixel,)."""
    height, width = chds.halves.shape[:2]
    found = np.full((2, height, width), np.nan)
    found[0, :-1] = squared_distance(chds[:-1], chds[1:], width=_BIN)
    found[1, :, :-1] = squared_distance(chds[:, :-1], chds[:, 1:], width=_BIN)
    known = np.isfinite(found)
    with np.errstate(invalid="ignore"):
        mean = np.where(known, found, 0).sum(axis=0) / known.sum(axis=0)
    return np.asarray(mean.ravel())


def _far(chds: LogChds) -> Floats:
    """Return squared distances to a pixel drawn at random, shape (pixel,)."""
    flat = chds.halves.reshape(-1, *chds.halves.shape[2:])
    other = generator(0).permutation(len(flat))
    return squared_distance(LogChds(flat), LogChds(flat[other]), width=_BIN)


def _ratio(near: Floats, far: Floats, blocks: Blocks, level: float) -> Interval[float]:
    known = np.isfinite(near + far)
    if not known.any():
        return Interval.unknown(level=level)
    kept = blocks[known]
    above, below = kept.sums(near[known]), kept.sums(far[known])
    return interval_of(lambda w: (w @ above) / (w @ below), kept, level=level)


def _edges(chds: LogChds) -> tuple[Floats, Floats, npt.NDArray[np.int64]]:
    """Return, of pixels on edges, what a blend leaves, the distance to the nearer side, and which.

    A pixel is F = G + w (H - G) with G and H on both sides. Each half of the samples has a weight w
    of its own, so that their residuals are independent and the product of these is the squared
    residual without noise.
    """
    height, width = chds.halves.shape[:2]
    number = np.arange(height * width).reshape(height, width)
    found = [
        _across(chds[:, :-2], chds[:, 1:-1], chds[:, 2:], number[:, 1:-1]),
        _across(chds[:-2], chds[1:-1], chds[2:], number[1:-1]),
    ]
    left, nearest, pixels = (np.concatenate(v) for v in zip(*found, strict=True))
    return left, nearest, pixels.astype(np.int64)


def _across(
    one: LogChds, here: LogChds, two: LogChds, number: npt.NDArray[np.int64]
) -> tuple[Floats, Floats, Floats]:
    apart = squared_distance(one, two, width=_BIN)
    edge = apart >= EDGE
    g, f, h, number = one.halves[edge], here.halves[edge], two.halves[edge], number[edge]
    step, rise = h - g, f - g
    weights = (rise * step).sum(axis=-1) / (step * step).sum(axis=-1)
    mixed = (weights.mean(axis=-1) > MIXED[0]) & (weights.mean(axis=-1) < MIXED[1])
    rest = rise - weights[..., np.newaxis] * step
    left = (rest[:, 0] * rest[:, 1]).sum(axis=-1) * _BIN
    sides = [squared_distance(LogChds(f), LogChds(side), width=_BIN) for side in (g, h)]
    return left[mixed], np.minimum(*sides)[mixed], number[mixed].astype(np.float64)


def _explained(left: Floats, nearest: Floats, blocks: Blocks, level: float) -> Interval[float]:
    rest, whole = blocks.sums(left), blocks.sums(nearest)
    return interval_of(lambda w: 1 - (w @ rest) / (w @ whole), blocks, level=level)
