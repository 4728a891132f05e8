"""Penumbrae: two modes, whose weights follow the position across (finding 6)."""

from __future__ import annotations

import numpy as np
from scipy import stats

from chdstat._core.positive import Floats
from chdstat._core.resampling import mean_of
from chdstat.inference import modality
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData, correlation_of

__all__ = ["measure"]

_MAJORITY = 0.5
"""Share of bimodal pixels from which a penumbra is bimodal; its ends are fully lit, or not."""
_FOLLOWS = 0.7
"""Rank correlation of position and weight from which one follows the other: half of the variance of
the ranks."""
_BINS = 400
_DISTINCT = 1e-3
"""Range of log radiance below which there are no two modes to be parted."""


def measure(data: SceneData) -> Outcome:
    """Count bimodal pixels, and correlate the weight of the bright mode with the position.

    One half of the samples says where the border between the modes is and which way the penumbra
    runs, the other half what the weights are: noise cannot make them agree.
    """
    patch = data.patch("penumbra", "in a penumbra")
    x, level = data.light(patch), level_of(2)
    modes = modality(x).modes
    several = np.where(modes > 0, modes > 1, np.nan)
    ranks = np.full((2, len(patch)), np.nan)
    places, weights = np.full((2, len(patch)), np.nan)
    for i in range(len(patch.names)):
        here = patch.region == i
        one, two = x[here, 0::2], x[here, 1::2]
        border = _border(one)
        yx = np.stack([patch.y[here], patch.x[here]], axis=1).astype(np.float64)
        places[here] = _along(_bright(one, border), yx - yx.mean(axis=0))
        weights[here] = _bright(two, border)
        for rank, values in zip(ranks, (places, weights), strict=True):
            known = np.flatnonzero(here & np.isfinite(values))
            rank[known] = stats.rankdata(values[known]) / max(len(known), 1)
    follows = correlation_of(ranks[0], ranks[1], patch.blocks, level=level)
    points = {
        name: (places[patch.region == i], weights[patch.region == i])
        for i, name in enumerate(patch.names)
    }
    return Outcome(
        (
            ClaimTest(
                "share of bimodal pixels",
                mean_of(several, patch.blocks, level=level),
                least=_MAJORITY,
            ),
            ClaimTest(
                "rank correlation of the weight of the bright mode with position",
                follows,
                least=_FOLLOWS,
            ),
        ),
        details={"bright_weight": patch.by_region(weights)},
        plot_data=PlotData(
            "points",
            points,
            "position across the penumbra in pixels",
            "weight of the bright mode",
        ),
    )


def _border(x: Floats) -> float:
    """Return the radiance between dark and bright samples of a region (Otsu 1979, of logarithms).

    Otsu, "A threshold selection method from gray-level histograms", 1979,
    doi:10.1109/TSMC.1979.4310076.
    """
    logs = np.log(x[x > 0])
    if not logs.size or np.ptp(logs) < _DISTINCT:
        return np.nan
    counts, edges = np.histogram(logs, _BINS)
    centers = (edges[1:] + edges[:-1]) / 2
    below, moment = np.cumsum(counts)[:-1], np.cumsum(counts * centers)[:-1]
    n, total = counts.sum(), (counts * centers).sum()
    with np.errstate(invalid="ignore", divide="ignore"):
        between = (total * below - moment * n) ** 2 / (below * (n - below))
    return float(np.exp(edges[1:-1][np.nanargmax(between)]))


def _bright(x: Floats, border: float) -> Floats:
    """Return the share of the samples of each row above the border, nulls counted."""
    good = np.isfinite(x).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((x > border).sum(axis=1) / good)


def _along(values: Floats, yx: Floats) -> Floats:
    """Return positions along the direction in which values rise, in pixels, from (y, x)."""
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(values), np.nan)
    rise = values[known] - values[known].mean()
    slope = np.linalg.lstsq(yx[known] - yx[known].mean(axis=0), rise, rcond=None)[0]
    length = float(np.linalg.norm(slope))
    return np.asarray(yx @ slope / length if length > 0 else np.zeros(len(values)))
