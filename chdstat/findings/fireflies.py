"""Fireflies: an accident of few samples, not another CHD than next to it (finding 8)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat._arrays import luminance
from chdstat.findings.conclusions import Conclusion
from chdstat.findings.evidence import Evidence
from chdstat.findings.log_chds import SAME_SHAPE, squared_distance
from chdstat.findings.resampling import median_of
from chdstat.findings.results import Exhibit, Part

__all__ = ["BRIGHTER", "LEAST", "measure"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

BRIGHTER = 4.0
"""An estimate this many times as bright as the pixel next to it is a firefly: two stops, as for the
fireflies of `chdstat.compare`. That of the paper is 8 times as bright in green."""
LEAST = 12
"""Fireflies that a median over them needs."""
_BIN = 0.1
_STEPS = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Above, below, left, right: of equally good neighbours the one above, as in the paper."""


def measure(evidence: Evidence) -> Conclusion:
    """Measure how far the CHDs of pixels with a firefly are from those next to them."""
    partner = _partners(evidence)
    ratio = _brightest(evidence, partner)
    found = ratio.ravel() >= BRIGHTER
    if np.count_nonzero(found) < LEAST:
        count = int(np.count_nonzero(found))
        return Conclusion(missing=(f"needs {LEAST} fireflies, there are {count}",))
    whole = evidence.whole()
    square = _squares(evidence, partner).ravel()
    spread = median_of(square[found], whole.blocks[found])
    ordinary = square[~found & np.isfinite(square)]
    return Conclusion(
        (
            Part.of(
                "distance between the CHDs of a firefly and its neighbour",
                spread.root(),
                most=SAME_SHAPE,
                unit="decade^1/2",
            ),
        ),
        details={
            "fireflies": int(np.count_nonzero(found)),
            "median_ratio_of_estimates": float(np.median(ratio.ravel()[found])),
            "distance_of_other_neighbours": float(np.sqrt(max(np.median(ordinary), 0)))
            if ordinary.size
            else None,
        },
        exhibit=_exhibit(evidence, partner, np.where(found, square, np.nan)),
    )


def _partners(evidence: Evidence) -> Ints:
    """Return the neighbour that sees the most similar surface, as an index of the flat image."""
    height, width = evidence.samples.shape[:2]
    features = [f for f in map(evidence.feature, ("albedo", "normal")) if f is not None]
    depth = evidence.feature("depth")
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


def _brightest(evidence: Evidence, partner: Ints) -> Floats:
    """Return the brightest estimate of a batch over the mean of the neighbour, shape (y, x)."""
    batches = evidence.summary["batch_means"].to_numpy().astype(np.float64)
    brightest = luminance(batches).max(axis=-1)
    mean = luminance(evidence.summary["mean"].to_numpy()[..., np.newaxis])[..., 0]
    beside = mean.ravel()[partner]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(beside > 0, brightest / beside, 0.0))


def _squares(evidence: Evidence, partner: Ints) -> Floats:
    chds = evidence.chds
    beside = chds.halves.reshape(-1, *chds.halves.shape[2:])[partner]
    return squared_distance(chds, type(chds)(beside), width=_BIN)


def _exhibit(evidence: Evidence, partner: Ints, square: Floats) -> Exhibit:
    """Return the CHDs of the firefly at the median distance and of its neighbour."""
    chds = evidence.chds.whole.reshape(square.size, -1)
    known = int(np.isfinite(square).sum())
    place = int(np.argsort(square, kind="stable")[known // 2])
    edges = -5 + _BIN * np.arange(chds.shape[1])
    pair = {"firefly": place, "neighbour": int(partner.ravel()[place])}
    return Exhibit(
        "curves",
        {name: (edges, chds[i]) for name, i in pair.items()},
        "log10 radiance in W sr-1 m-2",
        "share below",
    )
