"""Doubt: how much of what an estimator proposes pays on the picture at hand, without a reference.

The samples of every pixel are cut in two halves. From one come the mean m and the estimate g; the
mean t of the other is independent of both and unbiased. So the share of the move from m to g that
has the least squared error against t,

    alpha = sum w (t - m) (g - m) / sum w (g - m)^2,

is also that with the least expected error against the truth, as in the cross-validated combination
of estimators (Stein 1956's shrinkage with a known target; Rousselle et al. 2012,
doi:10.1145/2366145.2366214, choose between filters by the two halves alike).

It is measured at half the samples, where the mean is worse and trust is larger. That is safe: with
an estimate g = y + b of constant bias b and a mean of variance v at all samples,
alpha = 2 v / (2 v + b^2), and the mixture has the squared error v (1 - 4 / (b^2 / v + 2)^2) < v.
What remains is the noise of alpha over the pixels: one standard error is taken off, so that what
only seems to pay is left alone (the rule of Breiman et al. 1984, doi:10.1201/9781315139470).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from chdstat.estimators.classical import mean_of_good
from chdstat.estimators.progressive.network import Answer, Network, Sight

__all__ = ["Doubted", "paying_share"]

_SAME = 1e-6
"""Relative difference below which an estimate is the mean, summed in another order."""

Array = npt.NDArray[Any]


class Doubted(nn.Module):
    """A network whose proposals are believed in part; its certainty falls likewise.

    Parameters
    ----------
    network
        The network.
    share
        How far to move from the mean to its estimate, 0 to 1.
    """

    def __init__(self, network: Network, share: float) -> None:
        super().__init__()
        self.network = network
        self.share = share
        self.shape = network.shape

    def forward(self, sight: Sight) -> Answer:
        """Estimate under every aim."""
        found = self.network(sight)
        mean = found.mean[:, None].expand_as(found.estimate)
        estimate = torch.lerp(mean, found.estimate, self.share)
        return Answer(estimate, found.mean, found.certainty * self.share)


def paying_share(
    samples: Array,
    estimate: Callable[[Array], Array],
    *,
    powers: Sequence[float],
    floor: float,
    unit: float,
) -> float:
    """Return the share of the move from the mean to the estimate that pays, 0 to 1.

    Both halves take either part, and all pixels and channels add up to one share. Pixels weigh
    ``1 / (s^2 + floor)^power``, s being the smaller of the mean and the estimate: neither has seen
    the other half, so that the share remains unbiased for errors of this weight. That of relMSE
    has the truth for s; the smaller of the two weighs most where either may be far too bright.
    One standard error over pixels is taken off.

    Parameters
    ----------
    samples
        Shape (..., channel, sample), at least 2.
    estimate
        Returns radiance (..., channel) from some of the samples.
    powers
        The errors to guard, 0 for the squared and 1 for the relative one: of several shares, the
        smallest pays under each.
    floor
        Of squared radiance, in squared units of `unit`.
    unit
        Mean radiance of the picture.
    """
    halves = samples[..., 0::2], samples[..., 1::2]
    means = [mean_of_good(half).astype(np.float64) / unit for half in halves]
    found = [estimate(half).astype(np.float64) / unit for half in halves]
    shares = []
    for power in powers:
        sums = [
            _sums(mean, one, target, power, floor)
            for mean, one, target in zip(means, found, means[::-1], strict=True)
        ]
        shares.append(_share(*(sum(parts) for parts in zip(*sums, strict=True))))
    return min(shares)


def _sums(mean: Array, found: Array, target: Array, power: float, floor: float) -> tuple[Any, Any]:
    """Return numerator and denominator of the share, one of each a pixel."""
    weight = (np.minimum(found, mean) ** 2 + floor) ** -power
    move = np.where(np.abs(found - mean) <= _SAME * mean, 0, found - mean)
    along, across = weight * move * (target - mean), weight * move**2
    usable = np.isfinite(along) & np.isfinite(across)
    return np.where(usable, along, 0).sum(axis=-1), np.where(usable, across, 0).sum(axis=-1)


def _share(along: Any, across: Any) -> float:
    total = float(across.sum())
    if not total > 0:
        return 0.0
    share = float(along.sum()) / total
    # The standard error of a ratio of sums over pixels (Cochran 1977, Sampling Techniques, 6.4).
    error = float(np.sqrt(np.sum((along - share * across) ** 2))) / total
    return float(np.clip(share - error, 0, 1))
