"""Application: a trained network on many pixels, block by block on all cores."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat._workers import in_order
from chdstat.estimators.classical import mean_of_good
from chdstat.estimators.progressive.lessons import Scenery
from chdstat.estimators.progressive.profiles import Profile
from chdstat.estimators.progressive.results import Estimates, Learned
from chdstat.estimators.progressive.shapes import AIMS
from chdstat.estimators.progressive.spread import causes_of

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Answer

__all__ = ["apply", "with_means"]

_ROWS = 2048
"""Pixels at once: their profiles and hidden layers stay in the cache."""

Array = npt.NDArray[np.float32]


def apply(
    learned: Learned,
    profile_of: Callable[[slice], Profile],
    scenery: Scenery,
    asked: Array | None,
    *,
    shape: tuple[int, ...],
    balance: float,
    level: float | None,
) -> Estimates:
    """Estimate from profiles.

    Parameters
    ----------
    learned
        The network.
    profile_of
        Returns the profiles of some of the rows.
    scenery
        What is known of the rows beside.
    asked
        What alike pixels say, shape (row, channel), in units of the profiles'.
    shape
        Of the pixels that the rows are.
    balance
        0 for the first of the aims, 1 for the second.
    level
        Probability of the interval; None leaves it out (NaN).
    """
    import torch

    from chdstat.estimators.progressive.network import device
    from chdstat.estimators.progressive.training import look, threads

    rows, channels = int(np.prod(shape)), learned.network.shape.channels
    radiance = np.empty((rows, channels), np.float32)
    low, high = (np.full_like(radiance, np.nan) for _ in range(2))
    certainty = np.empty(rows, np.float32)
    place = device()
    network = learned.network.to(place)

    def enter(part: slice) -> None:
        profile = profile_of(part)
        here = np.zeros((len(profile.count), 0), np.float32) if asked is None else asked[part]
        with torch.inference_mode():
            answer = network(look(profile, scenery[part], here, place))
            estimate = torch.lerp(answer.estimate[:, 0], answer.estimate[:, 1], balance)
            trust = torch.lerp(answer.certainty[:, 0], answer.certainty[:, 1], balance)
        unit = np.float32(profile.unit)
        with np.errstate(over="ignore", invalid="ignore"):
            radiance[part] = estimate.cpu().numpy() * unit
        certainty[part] = trust.cpu().numpy()
        if level is not None:
            ends = _interval(learned, answer, profile, balance, level)
            low[part], high[part] = (end * unit for end in ends)

    with threads(1):
        for _ in in_order(enter, spans(rows, _ROWS)):
            pass
    return Estimates(
        radiance=radiance.reshape(*shape, channels),
        certainty=certainty.reshape(shape),
        low=low.reshape(*shape, channels),
        high=high.reshape(*shape, channels),
        level=np.nan if level is None else level,
    )


def with_means(found: Estimates, samples: npt.NDArray[Any]) -> Estimates:
    """Put the mean of the good samples where the network overflows, NaN where none is good."""
    lost = ~np.isfinite(found.radiance).all(axis=-1)
    lost |= np.isnan(_any_good(samples))
    if lost.any():
        mean = mean_of_good(samples[lost]).astype(np.float32)
        found.radiance[lost] = found.low[lost] = found.high[lost] = mean
        found.certainty[lost] = 0
    return found


def _any_good(samples: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return something that is NaN where no sample of a pixel is good."""
    total = samples.sum(axis=(-2, -1))
    if np.isfinite(total).all() and samples.min(initial=0) >= 0:
        return np.asarray(total)
    return mean_of_good(np.where(np.isfinite(samples) & (samples >= 0), samples, np.nan).sum(-2))


def _interval(
    learned: Learned, answer: Answer, profile: Profile, balance: float, level: float
) -> tuple[Array, Array]:
    """Return the ends of the interval, mixed as the estimates are."""
    ends = np.zeros((2, *answer.mean.shape))
    for aim, share in zip(range(len(AIMS)), (1 - balance, balance), strict=True):
        if share == 0:
            continue
        variance = learned.spread.variance(causes_of(answer, profile, aim), aim)
        estimate = answer.estimate[:, aim].cpu().numpy().astype(np.float64)
        for end, tail in enumerate(((1 - level) / 2, (1 + level) / 2)):
            ends[end] += share * learned.spread.quantile(
                estimate, variance, profile.count, aim=aim, level=tail
            )
    return ends[0].astype(np.float32), ends[1].astype(np.float32)
