"""Fireflies: an accident of few samples, not another CHD than next to it (finding 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import luminance
from chdstat._core.resampling import Blocks, Interval, interval_of, median_of
from chdstat.studies.log_chds import SAME_SHAPE, squared_distance
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData

__all__ = ["BRIGHTER", "LEAST", "SAME_MEAN", "brightest_firefly", "measure"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

BRIGHTER = 4.0
"""An estimate this many times as bright as the pixel next to it is a firefly: two stops, as for the
fireflies of `chdstat.compare`. That of the paper is 8 times as bright in green."""
SAME_MEAN = 2.0
"""True mean over that of the neighbour up to which both are about the same: a stop, half
of what makes a firefly."""
LEAST = 12
"""Fireflies that a median over them needs."""
_USUAL = 3
"""Batches that show what is usual for a pixel."""
_SIMILAR = 1.5
"""Ratio up to which two medians are about the same."""
_PARTS = 2
_FOLDS = 4
_BIN = 0.1
_STEPS = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Above, below, left, right: of equally good neighbours the one above, as in the paper."""


def measure(data: SceneData) -> Outcome:
    """Compare CHDs of pixels with a firefly with those next to them: distances, and true means.

    A distance of distribution functions hardly sees rare bright samples, though these make a
    firefly: the means tell of them. A firefly is chosen by one batch of samples, and half of those
    of its neighbour; the means are of all other batches, and so tell nothing of the choice.
    """
    partner = _partners(data)
    batches = np.asarray(luminance(data.summary["batch_means"].to_numpy().astype(np.float64)))
    pairs = _pairs(batches.reshape(-1, batches.shape[-1]), partner.ravel())
    found = pairs.count > 0
    if np.count_nonzero(found) < LEAST:
        count = int(np.count_nonzero(found))
        return Outcome(missing=(f"needs {LEAST} fireflies, there are {count}",))
    whole, level = data.whole(), level_of(_PARTS)
    square = _squares(data, partner).ravel()
    blocks = whole.blocks[found]
    ordinary = square[~found & np.isfinite(square)]
    return Outcome(
        (
            ClaimTest.of(
                "distance between the CHDs of a firefly and its neighbour",
                median_of(square[found], blocks, level=level).root(),
                most=SAME_SHAPE,
                unit="decade^1/2",
            ),
            ClaimTest.of(
                "mean radiance of a firefly over its neighbour's, in other samples",
                _ratio_of_means(pairs, found, blocks, level),
                most=SAME_MEAN,
            ),
        ),
        details={
            "fireflies": int(np.count_nonzero(found)),
            "median_ratio_of_estimates": float(np.median(pairs.ratio[found])),
            "distance_of_other_neighbours": float(np.sqrt(max(np.median(ordinary), 0)))
            if ordinary.size
            else None,
        },
        plot_data=_plot_data(data, partner, np.where(found, square, np.nan)),
    )


def brightest_firefly(batches: Floats) -> tuple[int, int, int] | None:
    """Return row, column and batch of the brightest firefly; None without any.

    It is an estimate at least `BRIGHTER` times the median of its pixel and of the pixel above it,
    where these medians are about the same: elsewhere there is an edge.

    Parameters
    ----------
    batches
        Luminance of the mean of each batch, shape (y, x, batch).
    """
    if batches.shape[0] < 2 or batches.shape[2] < _USUAL or not np.isfinite(batches).all():
        return None
    usual = np.median(batches, axis=-1)
    high, low = np.maximum(usual[1:], usual[:-1]), np.minimum(usual[1:], usual[:-1])
    similar = (low > 0) & (high <= _SIMILAR * low)
    ratio = np.where(similar, batches[1:].max(axis=-1) / np.where(similar, high, 1), 0)
    if ratio.max() < BRIGHTER:
        return None
    y, x = (int(i) for i in np.unravel_index(int(ratio.argmax()), ratio.shape))
    return y + 1, x, int(batches[y + 1, x].argmax())


@dataclass(frozen=True)
class _Pairs:
    """Pixels beside their neighbours, each of shape (pixel,).

    Attributes
    ----------
    count
        Batches whose estimate is a firefly.
    ratio
        Brightest estimate over the mean of the neighbour.
    own, beside
        Mean of the other batches of the pixel and of its neighbour, added up over its fireflies.
    excess
        What one more such firefly would add to `own`, added up over the fireflies of the pixel.
    """

    count: Ints
    ratio: Floats
    own: Floats
    beside: Floats
    excess: Floats


def _pairs(batches: Floats, partner: Ints) -> _Pairs:
    """Find fireflies among estimates (pixel, batch), and what other batches say of them."""
    count, ratio, own, beside, excess = np.zeros((5, len(batches)))
    total, size = batches.sum(axis=1, keepdims=True), batches.shape[1]
    for fold in range(_FOLDS):
        here = batches[:, fold::_FOLDS]
        part = here.sum(axis=1, keepdims=True)
        same, others = part / here.shape[1], (total - part) / (size - here.shape[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            brighter = np.where(same[partner] > 0, here / same[partner], 0.0)
        firefly = brighter >= BRIGHTER
        ratio = np.fmax(ratio, np.fmax.reduce(brighter, axis=1, initial=0.0))
        count += firefly.sum(axis=1)
        own += np.where(firefly, (total - here) / (size - 1), 0.0).sum(axis=1)
        beside += np.where(firefly, others[partner], 0.0).sum(axis=1)
        excess += np.where(firefly, here - same[partner], 0.0).sum(axis=1) / (size - 1)
    return _Pairs(count.astype(np.int64), ratio, own, beside, excess)


def _ratio_of_means(
    pairs: _Pairs, found: npt.NDArray[np.bool_], blocks: Blocks, level: float
) -> Interval[float]:
    """Return the mean radiance of fireflies over that of their neighbours.

    What did not happen again in the other samples may be too rare to be seen in as many: up to
    ``-log((1 - level) / 2)`` such samples are expected where none is seen (Hanley and
    Lippman-Hand 1983, "If nothing goes wrong, is everything all right?",
    doi:10.1001/jama.1983.03330370053031). The upper end leaves room for them.
    """
    above, below = blocks.sums(pairs.own[found]), blocks.sums(pairs.beside[found])
    ratio = interval_of(lambda w: (w @ above) / (w @ below), blocks, level=level)
    unseen = -math.log((1 - level) / 2) * float(pairs.excess.sum() / pairs.count.sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        high = max(ratio.high, float(1 + unseen / below.sum()))
    return replace(ratio, high=high)


def _partners(data: SceneData) -> Ints:
    """Return the neighbour that sees the most similar surface, as an index of the flat image."""
    height, width = data.samples.shape[:2]
    features = [f for f in map(data.feature, ("albedo", "normal")) if f is not None]
    depth = data.feature("depth")
    if depth is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            features.append(np.nan_to_num(np.log(depth), posinf=0, neginf=0)[..., np.newaxis])
    seen = np.concatenate([*features, np.zeros((height, width, 1))], axis=-1)
    y, x = np.mgrid[:height, :width]
    best, partner = np.full((height, width), np.inf), y * width + x
    for dy, dx in _STEPS:
        ny, nx = np.clip(y + dy, 0, height - 1), np.clip(x + dx, 0, width - 1)
        apart = np.abs(seen - seen[ny, nx]).sum(axis=-1)
        better = ((ny != y) | (nx != x)) & (apart < best)
        best = np.where(better, apart, best)
        partner = np.where(better, ny * width + nx, partner)
    return np.asarray(partner)


def _squares(data: SceneData, partner: Ints) -> Floats:
    chds = data.chds
    beside = chds.halves.reshape(-1, *chds.halves.shape[2:])[partner]
    return squared_distance(chds, type(chds)(beside), width=_BIN)


def _plot_data(data: SceneData, partner: Ints, square: Floats) -> PlotData:
    """Return the CHDs of the firefly at the median distance and of its neighbour."""
    chds = data.chds.whole.reshape(square.size, -1)
    known = int(np.isfinite(square).sum())
    place = int(np.argsort(square, kind="stable")[known // 2])
    edges = -5 + _BIN * np.arange(chds.shape[1])
    pair = {"firefly": place, "neighbour": int(partner.ravel()[place])}
    return PlotData(
        "curves",
        {name: (edges, chds[i]) for name, i in pair.items()},
        "log10 radiance in W sr-1 m-2",
        "share below",
    )
