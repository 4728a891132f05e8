"""Causes: what may make an estimate err, in squared units of the picture's radiance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat.estimators.progressive.profiles import Profile

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Answer

__all__ = ["CAUSES", "DARK", "causes_of"]

CAUSES = 6
DARK = 0.02
"""Radiance, in units of the picture's, below which errors no longer fall with it."""

Floats = npt.NDArray[np.floating[Any]]


def causes_of(answer: Answer, profile: Profile, aim: int) -> Floats:
    """Return what may cause squared errors, shape (row, channel, cause), float64.

    A constant for the dark, the square of the estimate, of its distance to the mean, the variance
    of the mean and what the estimate takes over of it, and the square of the mean where the
    estimate does not rest on it.
    """
    estimate, mean, certainty = (
        t.cpu().numpy().astype(np.float64)
        for t in (answer.estimate[:, aim], answer.mean, answer.certainty[:, aim, None])
    )
    noise = profile.variance_of_mean()
    causes = (
        np.full_like(estimate, DARK**2),
        estimate**2,
        (estimate - mean) ** 2,
        noise,
        (1 - certainty) ** 2 * noise,
        certainty**2 * mean**2,
    )
    return np.stack(causes, axis=-1)
