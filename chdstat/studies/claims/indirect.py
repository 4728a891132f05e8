"""Indirect light: long tails, dark samples, many nulls (finding 5); nulls by region (finding 1)."""

from __future__ import annotations

import math

import numpy as np

from chdstat._core.positive import Floats
from chdstat._core.resampling import mean_of, median_of
from chdstat.fit import tail_index
from chdstat.patterns import Thresholds
from chdstat.studies.claims.assumptions import growing, with_room
from chdstat.studies.claims.diffuse import log_skewness
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of, require
from chdstat.studies.scene_data import PixelSet, SceneData

__all__ = ["measure", "measure_nulls"]

_TAIL = float(np.log(100) / np.log(2))
"""Quantile at 99 % over the median, of the exponential distribution: 6.6. Beyond it, a tail is
long."""
_KURTOSIS = 6.0
"""Excess kurtosis of the exponential distribution; beyond it, that of positive samples is high.
Nulls would add to it, but are a part of the claim of their own."""
_LEAST = 100
"""Positive samples that a quantile at 99 % needs."""


_NEAR = (0.45, 0.75)
"""Indirect light: "around 60 %" (Elek et al. 2019, section 5.1), give or take 15 points."""
_EXPECTED = {
    "night-room": (0.5, 1.0),
    "day-room": (0.0, 0.2),
    "white-room": (0.0, 0.2),
    "gallery": (0.0, 0.2),
}
"""Share over the image by scene: "often exceeding 50 %" by night, "typically under 20 %" in the
gallery, "low numbers" in the white room by day, for which the paper gives no figure."""


def measure_nulls(data: SceneData) -> Outcome:
    """Compare the share of nulls with what the paper reports of such a scene."""
    expected, where = _EXPECTED.get(data.name), "the image"
    if expected is None:
        expected, where = _NEAR, "the indirect regions"
        patch = data.patch("indirect", "of indirect light")
    else:
        patch = data.whole()
    image = data.summary["null_share"].to_numpy()
    share = mean_of(patch.take(image), patch.blocks)
    by_region: dict[str, float] = {}
    if data.regions:
        every = PixelSet.of(data.regions, *data.samples.shape[:2])
        by_region = every.by_region(every.take(image))
    known = image[np.isfinite(image)]
    return Outcome(
        (ClaimTest(f"share of nulls in {where}", share, *expected),),
        details={"by_region": by_region, "image": float(known.mean()) if known.size else None},
        plot_data=PlotData.bars(by_region, "share of nulls"),
    )


def measure(data: SceneData) -> Outcome:
    """Measure tail, kurtosis, skewness of logarithms and nulls in indirect light."""
    patch = data.patch("indirect", "of indirect light")
    summary, blocks, level = data.summary, patch.blocks, level_of(4)
    x = data.light(patch)
    tail, skewness = _tail(x), log_skewness(x)
    share = np.count_nonzero(x > 0) / x.size
    enough = f", about {2 ** math.ceil(math.log2(_LEAST / share))} spp" if share > 0 else ""
    require(np.isfinite(tail).any(), f"{_LEAST} positive samples in a pixel{enough}")
    grown = growing(x, x > 0, lambda moments: moments.kurtosis)
    kurtosis = with_room(median_of(grown[-1], blocks, level=level), grown)
    nulls = mean_of(patch.take(summary["null_share"].to_numpy()), blocks, level=level)
    tests = (
        ClaimTest(
            "quantile at 99 % over median", median_of(tail, blocks, level=level), least=_TAIL
        ),
        ClaimTest("excess kurtosis of positive samples", kurtosis, least=_KURTOSIS),
        ClaimTest("skewness of log radiance", mean_of(skewness, blocks, level=level), most=0.0),
        ClaimTest("share of nulls", nulls, least=Thresholds().null_share),
    )
    measured = {
        "tail": tail,
        "tail_index": tail_index(x).xi,
        "excess_kurtosis": grown[-1],
        "excess_kurtosis_with_nulls": patch.take(summary["kurtosis"].to_numpy()),
        "log_skewness": skewness,
    }
    ordered = np.sort(skewness[np.isfinite(skewness)])
    rank = (np.arange(len(ordered)) + 0.5) / max(len(ordered), 1)
    return Outcome(
        tests,
        details={name: patch.by_region(values) for name, values in measured.items()},
        plot_data=PlotData(
            "curves", {"pixels": (ordered, rank)}, "skewness of log radiance", "share below"
        ),
    )


def _tail(x: Floats) -> Floats:
    """Return the quantile at 99 % over the median of positive samples, shape (pixel,)."""
    ordered = np.sort(np.where(x > 0, x, np.inf), axis=1)
    n = (x > 0).sum(axis=1)
    middle, high = (
        np.take_along_axis(ordered, np.clip(np.ceil(q * n) - 1, 0, None).astype(int)[:, None], 1)
        for q in (0.5, 0.99)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(n >= _LEAST, (high / middle)[:, 0], np.nan))
