"""Intervals: how far from an estimate the radiance of a pixel may be.

An interval has three parts: that of the mean and that of the proposal, each as far as the estimate
consists of it, and that of the light that is given back. The first two are what is expected of a
pixel with such samples. What held-out halves show makes them wider or narrower, so that they hold
on average over pixels that are alike, whatever was expected (Armstrong, Kolesar and
Plagborg-Moller 2022, "Robust empirical Bayes confidence intervals", doi:10.3982/ECTA18597, bound
the second moment of a bias to this end).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from chdstat._core.arrays import Reals
from chdstat.estimators.default_estimate.weights import Proposal

_MARGIN = 0.5
"""Standard errors within which what held-out halves show may be noise."""
_KEPT = 0.95
"""Weight of the mean from which an estimate is the mean."""
_RANGE = 0.05, 100.0
"""Least and largest factor of a squared error."""


def interval_around(
    radiance: Reals,
    weight: Reals,
    reach: Sequence[Reals],
    half: Reals,
    light: Reals,
    proposals: Sequence[Proposal],
    halves: Sequence[Reals],
    level: float,
) -> tuple[Reals, Reals]:
    """Return the lower and upper end of the intervals of an estimate, shape (y, x, channel).

    Parameters
    ----------
    radiance, weight
        The estimate, and the weight of the mean in it.
    reach
        How far the interval of the mean reaches below and above it.
    half
        Half of the width of the interval of the proposal.
    light
        How far the light that is given back may be from what is lost.
    proposals
        Proposals of all samples, of one half of them and of the other.
    halves
        Estimates of the halves.
    level
        Probability of the interval.
    """
    # The best weight of a mean of variance v leaves the variance weight v (James and Stein 1961).
    normal = stats.norm.ppf(0.5 + level / 2)
    # Few samples that are all equal, as of visibility, may be equal by chance where others vary.
    chance = np.where(proposals[0].known, normal * proposals[0].around, 0)
    sides = [
        np.hypot((1 - weight) * half, np.sqrt(weight) * np.maximum(side, chance)) for side in reach
    ]
    factor = _shown_over_expected(sum(sides) / (2 * normal), weight, proposals, halves)
    below, above = (np.hypot(factor * side, normal * light) for side in sides)
    return radiance - below, radiance + above


def _shown_over_expected(
    error: Reals, weight: Reals, proposals: Sequence[Proposal], halves: Sequence[Reals]
) -> Reals:
    """Return the error that held-out halves show over the one that is expected of each pixel.

    The product of what the estimates of the halves differ in from the means of the same halves is,
    on average, the square of their bias; see `default_estimate.error`. With half of the squared
    difference of the estimates, their noise, it is averaged over pixels of the same channel, place
    and noise. As long as its own noise explains it, what is expected stands.
    """
    whole, one, other = proposals
    grid, unit = whole.groups, whole.unit
    # The error of a pixel that keeps its mean is known from its samples.
    counted = (weight < _KEPT) / unit**2
    bias = counted * (halves[0] - one.mean) * (halves[1] - other.mean)
    noise = counted * np.square(halves[0] - halves[1]) / 4
    bias, squares, noise, expected = grid.sums(bias, bias**2, noise, counted * error**2)
    margin = _MARGIN * np.sqrt(squares)
    least, most = np.maximum(bias - margin, 0) + noise, np.maximum(bias, 0) + margin + noise
    shown = np.clip(expected, least, most)
    found = np.divide(shown, expected, out=np.ones_like(shown), where=expected > 0)
    return np.asarray(np.where(weight < _KEPT, np.sqrt(grid.at(np.clip(found, *_RANGE))), 1))
