"""Bounds: how large squared errors may be, as far as pixels tell that trained nothing.

Without a reference, products of what is left over tell squared errors without bias, but with so
much noise that few pixels cannot tell six weights apart, and a picture whose rare bright samples
have not come yet seems to have no errors. So the weights keep the proportions `USUAL`, and one
scale k is measured,

    k = sum w s / sum w v,    w = v / (v + n)^2,

s being the products, v what the usual weights expect, and n the noise of the target: the weights of
a ratio whose terms have the variance ``2 (v + n)^2``. Then the upper end of its one-sided 95 %
confidence interval is taken in place of k, with the standard error of a ratio of sums over pixels
(Cochran 1977, Sampling Techniques, 6.4): an interval that is too wide claims less than one that is
too narrow. The noise of a pixel that has not had its bright samples yet is underestimated, its
weight is too large, and its distance from the target, too: this also errs on the side of width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat.estimators.progressive.trials import Trial

__all__ = ["USUAL", "bounded_weights", "ratio"]

USUAL = np.array([0.03, 0.03, 0.17, 0.05, 0.3, 0.0])
"""Weights of the causes, up to their scale: about what errors against references have on simulated
and on rendered pictures, scaled to 1."""
_CONFIDENCE = 0.95
_LEAST = 1e-3
"""Scale that no measurement falls below, so that an interval is never a point."""

Floats = npt.NDArray[np.floating[Any]]


def bounded_weights(trials: Sequence[Trial], aim: int) -> Floats:
    """Return weights of the causes under which squared errors are hardly larger than expected."""
    expected = [trial.causes[aim] @ USUAL for trial in trials]
    weights = [v / (v + n) ** 2 for v, n in zip(expected, _noise(trials), strict=True)]
    rows = np.concatenate([trial.rows for trial in trials])
    above, below = (
        np.bincount(rows, np.concatenate([(w * x).sum(axis=-1) for w, x in pairs]))
        for pairs in (
            zip(weights, (trial.squared[aim] for trial in trials), strict=True),
            zip(weights, expected, strict=True),
        )
    )
    scale, error = ratio(above, below)
    bound = max(scale, 0.0) + special.ndtri(_CONFIDENCE) * error
    # One pixel alone has no standard error: then what is usual is all that is known.
    return USUAL * max(bound if np.isfinite(bound) else 1.0, _LEAST)


def ratio(above: npt.NDArray[Any], below: npt.NDArray[Any]) -> tuple[float, float]:
    """Return a ratio of sums over pixels and its standard error; inf for fewer than two pixels.

    Parameters
    ----------
    above, below
        One of each a pixel; pixels with neither count for nothing.
    """
    total, pixels = float(below.sum()), int(np.count_nonzero(below))
    if not total > 0 or pixels < 2:
        return 0.0, np.inf
    found = float(above.sum()) / total
    squares = float(np.sum((above - found * below) ** 2))
    return found, float(np.sqrt(squares * pixels / (pixels - 1))) / total


def _noise(trials: Sequence[Trial]) -> list[Floats]:
    """Return the variances of the targets, each averaged over all trials of a pixel and size."""
    found: dict[int, Floats] = {}
    for size in {trial.size for trial in trials}:
        alike = [trial for trial in trials if trial.size == size]
        rows = np.concatenate([trial.rows for trial in alike])
        noise = np.concatenate([trial.noise for trial in alike])
        count = np.maximum(np.bincount(rows), 1)
        sums = [np.bincount(rows, column) / count for column in noise.T]
        found[size] = np.stack(sums, axis=-1)
    return [found[trial.size][trial.rows] for trial in trials]
