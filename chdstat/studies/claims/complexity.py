"""Complexity: whether CHDs have more modes where the scene is more complex (finding 11).

Modes are counted among equally many samples everywhere: the more there are, the more can be told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

from chdstat._core.positive import Floats
from chdstat._core.resampling import LEVEL, Interval, mean_of
from chdstat.inference import modality
from chdstat.studies.claims.scene_shapes import common_count, drawn
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, require
from chdstat.studies.scene_data import SceneData

__all__ = ["measure", "rank_correlation", "scene_complexity"]

_LEAST = 5
"""Scenes that a rank correlation needs: of fewer, even perfect order has p above 1/100."""
_LEAST_SAMPLES = 64
"""Positive samples of a pixel among which modes are looked for, at least:"""
_PIXELS = 1024
"""in that many pixels of a scene."""
_TURN, _STEP, _PAINT = 0.9, 0.1, 0.1
"""Cosine between normals, difference of log depth, and of albedo, from which surfaces differ."""


def measure(scenes: Sequence[SceneData]) -> Outcome:
    """Correlate the mean number of modes of the scenes with their complexity."""
    require(len(scenes) >= _LEAST, f"{_LEAST} scenes to rank, there are {len(scenes)}")
    complexity = np.array([scene_complexity(data) for data in scenes])
    n = common_count(scenes, least=_LEAST_SAMPLES)
    means = []
    for data in scenes:
        x, blocks = drawn(data, n, pixels=_PIXELS)
        count = modality(x).modes.astype(np.float64)
        means.append(mean_of(count[count > 0], blocks[count > 0]))
    modes = np.array([mean.value for mean in means])
    known = np.isfinite(complexity + modes)
    enough = np.count_nonzero(known) >= _LEAST
    require(enough, f"first-hit features or a complexity of {_LEAST} scenes")
    correlation, p_value = rank_correlation(complexity[known], modes[known])
    names = [data.name for data in scenes]
    points = np.stack([complexity, modes], axis=-1)[..., np.newaxis]
    return Outcome(
        (ClaimTest("rank correlation of modes with scene complexity", correlation, least=0.0),),
        p_value=p_value,
        details={
            "positive_samples": n,
            "modes": {
                name: {"value": mean.value, "low": mean.low, "high": mean.high}
                for name, mean in zip(names, means, strict=True)
            },
            "complexity": dict(zip(names, complexity, strict=True)),
            "null_hypothesis": "modes and complexity have no common order (one-sided)",
        },
        plot_data=PlotData(
            "points",
            {name: (x, y) for name, (x, y) in zip(names, points, strict=True)},
            "complexity of the scene",
            "mean number of modes",
        ),
        few="scenes",
    )


def scene_complexity(data: SceneData) -> float:
    """Return the given complexity, or the share of neighbours that see different surfaces.

    That is what a camera can tell: 0 for a bare wall, near 1 for foliage. NaN without features.
    """
    if data.complexity is not None:
        return float(data.complexity)
    normal, depth, albedo = (data.feature(name) for name in ("normal", "depth", "albedo"))
    if normal is None or depth is None or albedo is None:
        return math.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        log_depth = np.nan_to_num(np.log(depth), posinf=0, neginf=0)
    differ = []
    for one, two in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        turned = (normal[one] * normal[two]).sum(axis=-1) < _TURN
        behind = np.abs(log_depth[one] - log_depth[two]) > _STEP
        painted = np.abs(albedo[one] - albedo[two]).max(axis=-1) > _PAINT
        differ.append((turned | behind | painted).ravel())
    every = np.concatenate(differ)
    return float(every.mean()) if every.size else math.nan


def rank_correlation(x: Floats, y: Floats) -> tuple[Interval[float], float]:
    """Return Spearman's correlation with its interval, and its one-sided p-value.

    The interval is that of Fisher's z, of variance (1 + r^2 / 2) / (n - 3); p is of 9999 random
    permutations.

    References
    ----------
    Bonett and Wright, "Sample size requirements for estimating Pearson, Kendall and Spearman
    correlations", 2000, doi:10.1007/BF02294183.

    Examples
    --------
    >>> correlation, p = rank_correlation(np.arange(9.0), np.arange(9.0) ** 2)
    >>> correlation.value, correlation.low > 0.9, p < 0.001
    (1.0, True, True)
    """
    a, b = (stats.rankdata(v) for v in (x, y))
    if not np.ptp(a) or not np.ptp(b):
        return Interval.unknown(), 1.0
    r = float(np.corrcoef(a, b)[0, 1])
    # Perfect order has an infinite z; a little less than one swap of ranks is its resolution.
    z = math.atanh(float(np.clip(r, -1 + 1e-3, 1 - 1e-3)))
    half = stats.norm.ppf((1 + LEVEL) / 2) * math.sqrt((1 + r**2 / 2) / (len(x) - 3))
    rng = np.random.default_rng(0)
    shuffled = rng.permuted(np.tile(b, (9999, 1)), axis=1)
    as_large = (shuffled - b.mean()) @ (a - a.mean()) >= (b - b.mean()) @ (a - a.mean()) - 1e-9
    p = (1 + np.count_nonzero(as_large)) / 10000
    return Interval(round(r, 12), math.tanh(z - half), math.tanh(z + half)), float(p)
