"""Assumptions: what denoisers take for granted of noise and radiance, tested (finding 13).

The paper holds that four assumptions fail: that noise is spatially uniform and additive, that
averages are Gaussian, that variance follows feature buffers, that radiance is regular.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator, luminance
from chdstat._moments import Moments
from chdstat.findings._explained import explained_by_features
from chdstat.findings._growth import growing, with_room
from chdstat.findings._uniformity import uniformity
from chdstat.findings.conclusions import Conclusion, level_of
from chdstat.findings.evidence import Evidence
from chdstat.findings.resampling import Blocks, Spread, interval_of, median_of
from chdstat.findings.results import Exhibit, Part
from chdstat.findings.slopes import logs, slope_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["AVERAGED", "IRREGULAR", "MULTIPLICATIVE", "SKEWED", "UNEXPLAINED", "measure"]

Floats = npt.NDArray[np.float64]

MULTIPLICATIVE = 1.0
"""Slope of log variance on log mean: 0 for additive noise, 2 for multiplicative; half way."""
AVERAGED = 32
"""Samples of an average, as many as the paper's model sees."""
SKEWED = 0.5
"""Skewness of averages from which they are not even fairly symmetric (Bulmer, "Principles of
Statistics", 1979, page 63)."""
UNEXPLAINED = 0.5
"""Share of the variation of log variance that features explain, up to which most is left."""
IRREGULAR = 0.5
"""Share of all squared steps of log radiance that the largest steps hold:"""
STEPS = 0.05
"""share of the steps that are the largest; of Gaussian steps, they would hold 0.28."""
_GROWING = 1024
"""Pixels that are asked how much skewness grows with the number of samples."""
LEAST = 12
"""Batches of samples that the parts of the data need."""
_PARTS = 4


@dataclass(frozen=True)
class _Batches:
    """Luminance of batch means, shape (pixel, batch), split into parts that share no sample."""

    values: Floats
    height: int

    @classmethod
    def of(cls, evidence: Evidence) -> _Batches:
        means = evidence.summary["batch_means"].to_numpy().astype(np.float64)
        light = luminance(means).astype(np.float64)
        return cls(light.reshape(-1, light.shape[-1]), light.shape[0])

    def part(self, start: int, step: int) -> Floats:
        return self.values[:, start::step]


def measure(evidence: Evidence) -> Conclusion:
    """Test the four assumptions; each part says that one fails."""
    batches = _Batches.of(evidence)
    if batches.values.shape[1] < LEAST:
        return Conclusion(missing=(f"needs {LEAST * 32} spp, has {evidence.samples.spp}",))
    blocks, level = evidence.whole().blocks, level_of(_PARTS)
    tests = uniformity(batches.values, blocks)
    explained = explained_by_features(evidence, batches.values, level=level)
    parts = _of_samples(evidence, batches, blocks, level)
    missing = ("needs first-hit albedo, normal and depth",) if explained is None else ()
    if explained is not None:
        name = "share of log variance that features explain"
        parts = (*parts, Part.of(name, explained.share, most=UNEXPLAINED))
    return Conclusion(
        parts,
        missing,
        p_value=tests["breusch_pagan"],
        details={
            **tests,
            "null_hypothesis": "variance is uniform over the image (Breusch-Pagan, Holm-adjusted)",
            "reliability_of_log_variance": explained.reliability if explained else None,
            "averages_told_from_gaussian": _told(evidence.summary),
        },
        exhibit=_exhibit(batches),
    )


def _of_samples(
    evidence: Evidence, batches: _Batches, blocks: Blocks, level: float
) -> tuple[Part, ...]:
    """Return the parts that need nothing but samples."""
    return (
        Part.of(
            "slope of log variance on log mean",
            _slope(batches, blocks, level),
            least=MULTIPLICATIVE,
        ),
        Part.of(
            f"skewness of averages of {AVERAGED}",
            _skewness(evidence, blocks, level),
            least=SKEWED,
        ),
        Part.of(
            f"share of squared steps of log radiance in the largest {STEPS:.0%}",
            _concentration(batches, blocks, level),
            least=IRREGULAR,
        ),
    )


def _skewness(evidence: Evidence, blocks: Blocks, level: float) -> Spread:
    """Return the median skewness of averages; how it grows is asked of some pixels."""

    def of_averages(moments: Moments) -> Floats:
        return np.asarray(moments.skewness / np.sqrt(AVERAGED))

    skewness = evidence.summary["skewness"].to_numpy() / np.sqrt(AVERAGED)
    found = median_of(skewness.reshape(-1, skewness.shape[-1]), blocks, level=level)
    some = (evidence.radiance(patch) for patch in evidence.scattered(_GROWING))
    parts = [growing(np.nan_to_num(x), np.isfinite(x), of_averages) for x in some]
    quarter, half, whole = (np.concatenate(values) for values in zip(*parts, strict=True))
    return with_room(found, (quarter, half, whole))


def _told(summary: xr.Dataset) -> dict[int, float] | None:
    """Return, by N, the share of pixel channels whose averages of N are told from Gaussian."""
    if "averages_rejected_share" not in summary:
        return None
    shares = summary["averages_rejected_share"].mean("channel")
    return dict(zip(shares["size"].to_numpy().tolist(), shares.to_numpy().tolist(), strict=True))


def _slope(batches: _Batches, blocks: Blocks, level: float) -> Spread:
    """Return the slope of log variance on log mean, with an instrument against noisy means.

    Variance, mean and instrument are of different samples, so that their noise has nothing in
    common.
    """
    y = logs(batches.part(0, 2).var(axis=1, ddof=1))
    x, z = (logs(batches.part(i, 4).mean(axis=1)) for i in (1, 3))
    return slope_of(x, y, blocks, instrument=z, level=level)


def _concentration(batches: _Batches, blocks: Blocks, level: float) -> Spread:
    """Return the share of squared steps to the right-hand neighbour in the largest steps.

    A third of the samples says which steps are large; the product of the steps of the two other
    thirds is their square without noise. A uniform image has no steps at all, and no interval.
    """
    thirds = [logs(batches.part(i, 3).mean(axis=1)).reshape(batches.height, -1) for i in range(3)]
    steps = [np.pad(np.diff(t, axis=1), ((0, 0), (0, 1)), constant_values=np.nan) for t in thirds]
    chosen, one, two = (s.ravel() for s in steps)
    known = np.isfinite(chosen + one + two)
    if not known.any():
        return Spread.unknown(level=level)
    kept, square = blocks[known], (one * two)[known]
    size = np.abs(chosen[known])
    # Of equal steps, chance decides which are the largest.
    order = np.lexsort((generator(0).random(len(size)), size))
    large = np.zeros(len(size), dtype=bool)
    large[order[len(size) - max(1, round(STEPS * len(size))) :]] = True
    above, below = kept.sums(np.where(large, square, 0)), kept.sums(square)
    return interval_of(lambda w: (w @ above) / (w @ below), kept, level=level)


def _exhibit(batches: _Batches) -> Exhibit:
    mean, variance = logs(batches.values.mean(axis=1)), logs(batches.values.var(axis=1, ddof=1))
    return Exhibit("points", {"pixels": (mean, variance)}, "log10 mean", "log10 variance of a mean")
