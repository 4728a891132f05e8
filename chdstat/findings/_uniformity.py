"""Uniformity: tests of whether the noise of pixels has one variance."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._multiplicity import holm
from chdstat.findings.resampling import Blocks

__all__ = ["uniformity"]

Floats = npt.NDArray[np.float64]

_TINY = float(np.finfo(np.float64).tiny)
"""What underflows is no proof: p-values are never 0."""


def uniformity(batches: Floats, blocks: Blocks) -> dict[str, float]:
    """Return p-values of equal variance, Holm-adjusted, from one batch of each pixel.

    Parameters
    ----------
    batches
        Means of batches, shape (pixel, batch). The noise of the last one, its distance from the
        mean of the others, is what is tested: pixels are rendered independently.
    blocks
        Groups of pixels for Levene's test.

    Returns
    -------
    dict
        ``breusch_pagan``: variance does not depend on log mean (Breusch and Pagan 1979,
        doi:10.2307/1911963, without normality: Koenker 1981, doi:10.1016/0304-4076(81)90062-2).
        ``levene``: variance is the same in all blocks, around medians (Brown and Forsythe 1974,
        doi:10.1080/01621459.1974.10482955). NaN where there is nothing to test.
    """
    rest = batches[:, :-1].mean(axis=1)
    noise = batches[:, -1] - rest
    known = np.isfinite(noise) & (rest > 0)
    noise, level, block = noise[known], np.log(rest[known]), blocks.of_pixel[known]
    p = {"breusch_pagan": _breusch_pagan(noise, level), "levene": _levene(noise, block)}
    return dict(zip(p, holm(np.array(list(p.values()))).tolist(), strict=True))


def _breusch_pagan(noise: Floats, level: Floats) -> float:
    from statsmodels.stats.diagnostic import het_breuschpagan

    if len(noise) < 3 or not np.ptp(level) or not np.ptp(noise):
        return float("nan")
    # A scale of 1 keeps fourth powers within range.
    _, p, _, _ = het_breuschpagan(
        noise / np.abs(noise).max(), np.stack([np.ones_like(level), level], axis=1), robust=True
    )
    return max(float(p), _TINY)


def _levene(noise: Floats, block: npt.NDArray[np.int64]) -> float:
    groups = [noise[block == i] for i in np.unique(block)]
    groups = [group for group in groups if len(group) > 2]
    if len(groups) < 2 or not np.ptp(noise):
        return float("nan")
    return max(float(stats.levene(*groups, center="median").pvalue), _TINY)
