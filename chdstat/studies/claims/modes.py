"""Modes and families: penumbrae, complex scenes, gamma-like CHDs (findings 6, 11 and 14)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

from chdstat._core.arrays import Floats
from chdstat._core.resampling import LEVEL, Interval, interval_of, mean_of
from chdstat.inference import modality
from chdstat.studies.claims.scene_shapes import common_count, drawn
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of, require
from chdstat.studies.scene_data import SceneData, correlation_of, ratio_of

__all__ = ["measure_complexity", "measure_families", "measure_penumbrae"]


# --- penumbrae ------------------------------------------------------------------------------------

_MAJORITY = 0.5
"""Share of bimodal pixels from which a penumbra is bimodal; its ends are fully lit, or not."""
_FOLLOWS = 0.7
"""Rank correlation of position and weight from which one follows the other: half of the variance of
the ranks."""
_BINS = 400
_DISTINCT = 1e-3
"""Range of log radiance below which there are no two modes to be parted."""


def measure_penumbrae(data: SceneData) -> Outcome:
    """Count bimodal pixels, and correlate the weight of the bright mode with the position.

    One half of the samples says where the border between the modes is and which way the penumbra
    runs, the other half what the weights are: noise cannot make them agree.
    """
    patch = data.patch("penumbra", "in a penumbra")
    x, level = data.light(patch), level_of(2)
    modes = modality(x).modes
    several = np.where(modes > 0, modes > 1, np.nan)
    bimodal = mean_of(several, patch.blocks, level=level)
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
            ClaimTest("share of bimodal pixels", bimodal, least=_MAJORITY),
            ClaimTest(
                "rank correlation of the weight of the bright mode with position",
                follows,
                least=_FOLLOWS,
            ),
        ),
        details={"bright_weight": patch.by_region(weights)},
        plot_data=PlotData(
            "points", points, "position across the penumbra in pixels", "weight of the bright mode"
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


# --- complexity of scenes -------------------------------------------------------------------------

# Modes are counted among equally many samples everywhere: the more there are, the more are seen.
_LEAST = 5
"""Scenes that a rank correlation needs: of fewer, even perfect order has p above 1/100."""
_LEAST_SAMPLES = 64
"""Positive samples of a pixel among which modes are looked for, at least:"""
_PIXELS = 1024
"""in that many pixels of a scene."""
_TURN, _STEP, _PAINT = 0.9, 0.1, 0.1
"""Cosine between normals, difference of log depth, and of albedo, from which surfaces differ."""


def measure_complexity(scenes: Sequence[SceneData]) -> Outcome:
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
            "modes": {name: mean.to_dict() for name, mean in zip(names, means, strict=True)},
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


# --- families -------------------------------------------------------------------------------------


def measure_families(data: SceneData) -> Outcome:
    """Compare the share of gamma among the best families with that of the next frequent one.

    The details have other readings of "gamma-like": gamma and Weibull together are the generalised
    gamma distributions of one shape (Stacy 1962, doi:10.1214/aoms/1177704481).
    """
    analysis, blocks = data.analysis, data.whole().blocks
    about = analysis["best_family"].attrs
    codes = np.atleast_1d(about["flag_values"]).tolist()
    flags = dict(zip(str(about["flag_meanings"]).split(), codes, strict=True))
    names = [name for name, code in flags.items() if code >= 0]
    require("gamma" in names, "fits of gamma distributions")

    def counts_of(variable: str) -> Floats:
        """Return in how many channels of each pixel each family is best, (pixel, family)."""
        best = analysis[variable].to_numpy()[..., np.newaxis] == [flags[name] for name in names]
        return np.asarray(best.sum(axis=2).reshape(-1, len(names)), dtype=np.float64)

    def share_of(families: list[str], counts: Floats) -> Interval[float]:
        chosen = counts[:, [names.index(family) for family in families]].sum(axis=1)
        return ratio_of(chosen, counts.sum(axis=1), blocks, bounds=(0.0, 1.0))

    def lead(weights: Floats) -> Floats:
        """Return the lead of gamma over each other family."""
        total = weights @ sums
        shares = total / total.sum(axis=1, keepdims=True)
        gamma = names.index("gamma")
        return np.asarray(shares[:, [gamma]] - np.delete(shares, gamma, axis=1))

    counts = counts_of("best_family")
    require(counts.sum(), "pixels with enough positive samples to fit")
    sums = blocks.sums(counts)
    least = interval_of(lead, blocks, bounds=(-1.0, 1.0))
    shares = {name: share_of([name], counts) for name in names}
    level = {"level": LEVEL}
    kin = [name for name in names if name in ("gamma", "weibull")]
    others = {"gamma_or_weibull": share_of(kin, counts)}
    if "held_out_best_family" in analysis:
        held_out = counts_of("held_out_best_family")
        others["gamma_by_held_out_likelihood"] = share_of(["gamma"], held_out)
    return Outcome(
        (ClaimTest("share of gamma less that of the next family", least, least=0.0),),
        details={
            "shares": {name: share.to_dict() | level for name, share in shares.items()},
            **{name: share.to_dict() | level for name, share in others.items()},
            "pixels_that_gamma_describes": float(analysis["gamma_like"].mean()),
        },
        plot_data=PlotData.bars(
            {name: share.value for name, share in shares.items()}, "share of pixel channels"
        ),
    )
