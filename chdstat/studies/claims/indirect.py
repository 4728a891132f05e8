"""Indirect light: long tails, dark samples, many nulls (finding 5)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from chdstat._core.resampling import mean_of, median_of
from chdstat.fit import tail_index
from chdstat.patterns import Thresholds
from chdstat.studies.claims.assumptions import growing, with_room
from chdstat.studies.claims.diffuse import log_skewness
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData

__all__ = ["KURTOSIS", "TAIL", "measure"]

Floats = npt.NDArray[np.float64]

TAIL = float(np.log(100) / np.log(2))
"""Quantile at 99 % over the median, of the exponential distribution: 6.6. Beyond it, a tail is
long."""
KURTOSIS = 6.0
"""Excess kurtosis of the exponential distribution; beyond it, that of positive samples is high.
Nulls would add to it, but are a part of the claim of their own."""
LEAST = 100
"""Positive samples that a quantile at 99 % needs."""
_PARTS = 4


def measure(data: SceneData) -> Outcome:
    """Measure tail, kurtosis, skewness of logarithms and nulls in indirect light."""
    patch = data.patch("indirect")
    if patch is None:
        return Outcome(missing=("needs a region of indirect light",))
    summary, level = data.summary, level_of(_PARTS)
    null = patch.take(summary["null_share"].to_numpy())
    x = data.light(patch)
    tail, skewness = _tail(x), log_skewness(x)
    if not np.isfinite(tail).any():
        return Outcome(missing=(_needed(x),))
    blocks = patch.blocks
    grown = growing(x, x > 0, lambda moments: moments.kurtosis)
    kurtosis = grown[-1]
    parts = (
        ClaimTest.of(
            "quantile at 99 % over median", median_of(tail, blocks, level=level), least=TAIL
        ),
        ClaimTest.of(
            "excess kurtosis of positive samples",
            with_room(median_of(kurtosis, blocks, level=level), grown),
            least=KURTOSIS,
        ),
        ClaimTest.of("skewness of log radiance", mean_of(skewness, blocks, level=level), most=0.0),
        ClaimTest.of(
            "share of nulls", mean_of(null, blocks, level=level), least=Thresholds().null_share
        ),
    )
    measured = {
        "tail": tail,
        "tail_index": tail_index(x).xi,
        "excess_kurtosis": kurtosis,
        "excess_kurtosis_with_nulls": patch.take(summary["kurtosis"].to_numpy()),
        "log_skewness": skewness,
    }
    ordered = np.sort(skewness[np.isfinite(skewness)])
    rank = (np.arange(len(ordered)) + 0.5) / max(len(ordered), 1)
    return Outcome(
        parts,
        details={name: patch.by_region(values) for name, values in measured.items()},
        plot_data=PlotData(
            "curves", {"pixels": (ordered, rank)}, "skewness of log radiance", "share below"
        ),
    )


def _needed(x: Floats) -> str:
    """Say how many samples would give enough positive ones."""
    share = float(np.count_nonzero(x > 0)) / x.size
    text = f"needs {LEAST} positive samples in a pixel"
    return f"{text}, about {2 ** math.ceil(math.log2(LEAST / share))} spp" if share > 0 else text


def _tail(x: Floats) -> Floats:
    """Return the quantile at 99 % over the median of positive samples, shape (pixel,)."""
    ordered = np.sort(np.where(x > 0, x, np.inf), axis=1)
    n = (x > 0).sum(axis=1)
    middle, high = (
        np.take_along_axis(ordered, np.clip(np.ceil(q * n) - 1, 0, None).astype(int)[:, None], 1)
        for q in (0.5, 0.99)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(n >= LEAST, (high / middle)[:, 0], np.nan))
